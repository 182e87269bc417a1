"""The servers of this repository agree with certified truth, in the environment of `make importers`."""

import pytest

from plumbline.engines.registry import USER_ENGINES
from plumbline.execution.comparison import compare
from plumbline.judging.rows import Verdict
from tests.helpers import ROOT

PYTHON = ROOT / ".importers" / "bin" / "python"
SERVERS = sorted((ROOT / "servers").glob("*_server.py"))
SCENARIOS = (
    "tumbling-ball", "double-tumbling-balls", "double-hinge-skew", "universal-pendulum", "slider-on-arm",
)  # fmt: skip


@pytest.mark.full
@pytest.mark.skipif(
    not PYTHON.exists(), reason="the engine is not installed here; `make importers` installs it"
)
@pytest.mark.parametrize("server", SERVERS, ids=lambda path: path.stem)
def test_a_server_agrees_with_the_truth(server):
    found = compare(f"cmd:{PYTHON} {server}", SCENARIOS)
    USER_ENGINES.clear()
    agreeing = [row for row in found.rows if row.verdict == Verdict.AGREES]
    assert not found.problems and len(agreeing) >= 30, found.sentence
