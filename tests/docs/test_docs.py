"""The worked pages do what they say: their code blocks are run, in order, in a copy of the checkout.

A fenced block's info string says what becomes of it: ``file=PATH`` writes it there,
``into=PATH:NAME`` puts it below the line of that file that starts with NAME (a table that is added
to), ``bash run`` runs it (it must succeed), ``text output`` is what the run before it printed, where
``…`` stands for anything.  Other blocks are only shown.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from plumbline.scenario.field_docs import field_reference

ROOT = Path(__file__).resolve().parents[2]
PAGES = ["add-a-scenario.md", "add-an-engine.md"]
BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LEFT_OUT = shutil.ignore_patterns(".*", "__pycache__", "node_modules", "out")


def play(page: str, folder: Path) -> int:
    """Do what the page's blocks say, in ``folder``; returns how many were checked."""
    environment = os.environ | {
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "200",
        "PYTHONPATH": "",
    }
    printed, done = "", 0
    for info, body in BLOCK.findall(page):
        target = re.search(r"\bfile=(\S+)", info)
        if target:
            path = folder / target[1]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(body, encoding="utf-8")
        elif place := re.search(r"\binto=([^\s:]+):(\w+)", info):
            path = folder / place[1]
            text, count = re.subn(
                rf"^{place[2]}\b.*\n",
                lambda line, new=body: line[0] + new,
                path.read_text("utf-8"),
                flags=re.M,
            )
            assert count == 1, f"{place[2]} starts {count} lines of {place[1]}"
            path.write_text(text, encoding="utf-8")
        elif info == "bash run":
            ran = subprocess.run(
                ["bash", "-e", "-c", body],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=240,
            )
            printed = ran.stderr + ran.stdout
            assert ran.returncode == 0, f"exit code {ran.returncode} of\n{body}\n{printed}"
        elif info == "text output":
            pattern = ".*".join(map(re.escape, body.strip().split("…")))
            assert re.fullmatch(pattern, printed.strip(), re.DOTALL), f"expected\n{body}\ngot\n{printed}"
        else:
            assert "run" not in info.split() and "output" not in info.split(), (
                f"unknown kind of block: {info}"
            )
            continue
        done += 1
    return done


@pytest.mark.skipif(shutil.which("bash") is None, reason="the pages' commands are for bash")
@pytest.mark.parametrize("name", PAGES)
def test_a_worked_page_does_what_it_says(name, tmp_path):
    if not (ROOT / "docs" / name).exists():
        pytest.skip(f"docs/{name} is not written")
    checkout = tmp_path / "check out"  # a path with a space in it
    shutil.copytree(ROOT, checkout, ignore=LEFT_OUT)
    assert play((ROOT / "docs" / name).read_text(encoding="utf-8"), checkout) >= 3


def test_the_player_sees_a_page_that_lies(tmp_path):
    right = "```text file=a/b.txt\nhello\n```\n```bash run\ncat a/b.txt\n```\n```text output\nhe…\n```\n"
    assert play(right, tmp_path) == 3
    (tmp_path / "table.py").write_text("OTHER = {\n}\nTABLE = {\n}\n")
    assert play("```python into=table.py:TABLE\n    1: 2,\n```\n", tmp_path) == 1
    assert (tmp_path / "table.py").read_text() == "OTHER = {\n}\nTABLE = {\n    1: 2,\n}\n"
    for old, new in (("he…", "hi…"), ("cat a/b.txt", "cat a/c.txt"), ("text output", "text output now")):
        with pytest.raises(AssertionError):
            play(right.replace(old, new), tmp_path)


def test_the_field_reference_is_up_to_date():
    written = (ROOT / "docs" / "scenario-files.md").read_text(encoding="utf-8")
    assert written == field_reference(), (
        "run: python -m plumbline.scenario.field_docs > docs/scenario-files.md"
    )


def test_links_between_the_pages_lead_somewhere():
    for page in (ROOT / "docs").glob("*.md"):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}, which is not there"
