"""The worked pages do what they say: their code blocks are run, in order, in a copy of the checkout.

A fenced block's info string names its use: ``file=PATH`` writes it there,
``into=PATH:NAME`` puts it below the line of that file that starts with NAME (a table that is added
to), ``bash run`` runs it (it must succeed), ``text output`` is what the run before it printed, where
``…`` stands for anything.  Other blocks are only shown.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from plumbline.cli.main import COMMANDS, main
from plumbline.scenario.field_docs import field_reference
from plumbline.scenario.schema import SCHEMA_VERSION
from tests.helpers import ROOT

PAGES = [
    "first-run.md", "add-a-scenario.md", "add-an-engine.md", "test-your-engine.md", "sweeps.md",
    "model-files.md", "test-your-robot.md", *(["test-your-engine-in-cpp.md"] if shutil.which("g++") else []),
]  # fmt: skip
BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
IGNORED = shutil.ignore_patterns(".*", "node_modules", "out")


def run_code_blocks(page, folder):
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
def test_a_worked_page_gives_the_printed_results(name, tmp_path):
    checkout = tmp_path / "check out"  # a path with a space in it
    shutil.copytree(ROOT, checkout, ignore=IGNORED)
    assert run_code_blocks((ROOT / "docs" / name).read_text(encoding="utf-8"), checkout) >= 3


def test_a_page_with_wrong_output_fails(tmp_path):
    right = "```text file=a/b.txt\nhello\n```\n```bash run\ncat a/b.txt\n```\n```text output\nhe…\n```\n"
    assert run_code_blocks(right, tmp_path) == 3
    (tmp_path / "table.py").write_text("OTHER = {\n}\nTABLE = {\n}\n")
    assert run_code_blocks("```python into=table.py:TABLE\n    1: 2,\n```\n", tmp_path) == 1
    assert (tmp_path / "table.py").read_text() == "OTHER = {\n}\nTABLE = {\n    1: 2,\n}\n"
    for old, new in (("he…", "hi…"), ("cat a/b.txt", "cat a/c.txt"), ("text output", "text output now")):
        with pytest.raises(AssertionError):
            run_code_blocks(right.replace(old, new), tmp_path)


def test_the_field_reference_is_up_to_date():
    written = (ROOT / "docs" / "scenario-files.md").read_text(encoding="utf-8")
    assert written == field_reference(), "run: python -m plumbline.scenario.field_docs"
    assert f"of schema version {SCHEMA_VERSION}." in written


DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_that_exist(page):
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name} links to {target}, which is not there"


COMMAND = re.compile(
    r"(?:^|[`(\s])(?:python -m plumbline|\.venv/bin/plumbline|plumbline) ((?:[a-z]+)\b[^`\n|&;>…]*)", re.M
)


def documented_commands():
    """Every command of this program in the documentation, as (page, words)."""
    for page in DOCUMENTS:
        for text in COMMAND.findall(page.read_text(encoding="utf-8")):
            words = shlex.split(
                text.split("#")[0].split("   ")[0].replace("[", " ").replace("]", " "), posix=True
            )
            if words[0] in COMMANDS:
                yield page, [word.strip(",") for word in words]


def test_documented_commands_and_options_exist():
    found = list(documented_commands())
    assert len(found) >= 20
    for page, (name, *words) in found:
        params = main.get_command(None, name).params
        options = {option for param in params for option in param.opts} | {"--help"}
        unknown = {word.split("=")[0] for word in words if word.startswith("--")} - options
        assert not unknown, f"{page.name}: {name} has no option {unknown}"


def test_documented_make_targets_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    for page in DOCUMENTS:
        named = set(re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text(encoding="utf-8"), re.M))
        assert named <= targets, f"{page.name}: no target {named - targets}"


def test_documented_files_of_the_project_exist():
    for page in DOCUMENTS:
        if page.name == "CHANGELOG.md":
            continue
        text = page.read_text(encoding="utf-8")
        for name in re.findall(
            r"`((?:plumbline|reference_impl|adapters|tests|tools|reports|bench|scenarios)/[\w/.-]+)`", text
        ):
            made = name.startswith(("reports/out", "adapters/newton_euler")) or "`file=" in text
            assert made or (ROOT / name).exists(), f"{page.name} names {name}, which does not exist"


def test_the_glossary_has_thirty_terms_in_order():
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^\| ([^|]+?) \|", text, re.M)[1:]
    assert len(terms) == 30 and terms == sorted(terms, key=str.lower)
