"""The suite for an engine's own repository finds what is wrong, and expects what the engine's file lists."""

import os
import re
import sys

from tests.helpers import ROOT
from tests.helpers.commands import run_python

PYTEST = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull, "--rootdir")
TOY = ROOT / "tests" / "helpers" / "toy_server.py"


def outcomes(folder, server, *words):
    done = run_python(
        *PYTEST, folder, "-p", "plumbline.conformance.plugin", "--pyargs", "plumbline.conformance",
        "--plumbline-engine", f"cmd:{sys.executable} {server}",
        "-k", "state/tumbling-ball or state/double-tumbling-balls", *words, cwd=folder,
    )  # fmt: skip
    found = {what: int(n) for n, what in re.findall(r"(\d+) (passed|failed|skipped|xfailed)", done.stdout)}
    return done.stdout + done.stderr, found


def test_tests_pass_fail_skip_and_are_expected_to_fail(tmp_path):
    known, wrong = tmp_path / "plumbline-known.toml", tmp_path / "wrong.py"
    wrong.write_text(TOY.read_text().replace("omega, J @ omega", "omega, 1.001 * J @ omega"))
    known.write_text('"state/tumbling-ball/acceleration" = "the spin is off"\n')
    text, found = outcomes(tmp_path, wrong)
    assert found == {"xfailed": 1, "failed": 1, "skipped": 14} and "times the rounding bound" in text, text
    text, found = outcomes(tmp_path, TOY)
    assert found == {"passed": 1, "failed": 1, "skipped": 14} and "XPASS(strict)" in text
    known.write_text('"state/tumbling-bull/*" = "x"\n')
    assert "matches no test" in outcomes(tmp_path, TOY)[0]


CONTRACT = """
from adapters.mujoco_engine import Mujoco
from plumbline.conformance import contract_tests


class Wrong(Mujoco):
    name = "wrong"
    title = "Wrong"

    def _evaluate(self, model, states):
        return super()._evaluate(model.changed(gravity=1.001 * model.gravity), states)


RIGHT = "tests.helpers.renamed_engine:Renamed"
test_right = contract_tests(RIGHT, ["tumbling-ball"], "step")
test_wrong = contract_tests(Wrong, ["tumbling-ball"], "state")
"""


def test_an_adapter_is_tested_beside_its_own_tests(tmp_path):
    (tmp_path / "test_mine.py").write_text(CONTRACT)
    done = run_python(*PYTEST, tmp_path, cwd=tmp_path)
    assert "1 failed, 1 passed" in done.stdout, done.stdout + done.stderr
    assert "test_wrong[tumbling-ball]" in done.stdout and "gravity" in done.stdout


def test_levels_beyond_states_are_tests_of_their_own(tmp_path):
    text, found = outcomes(tmp_path, TOY, "--plumbline-level", "step", "-k", "step/tumbling-ball/")
    assert found == {"skipped": 1}, text  # it declares that it does not simulate
