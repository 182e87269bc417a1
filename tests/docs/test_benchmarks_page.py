"""docs/benchmarks.md is made from the stored figures; its values are computed again where that is cheap."""

import json

import pytest

from tests.helpers import ROOT
from tests.helpers.requirements import needs_truth_tools

STORED = json.loads((ROOT / "bench" / "results" / "classics.json").read_text(encoding="utf-8"))
GOALS = {("A01", "reference"): 1e-6, ("A01", "mujoco"): 1e-6, ("A01", "pinocchio"): 1e-6,
         ("A01", "exudyn-tree"): 1e-6, ("cart-pole", "reference"): 1e-9}  # fmt: skip


def test_the_page_is_made_from_the_stored_figures():
    from bench.classics_page import write_page

    assert (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8") == write_page(STORED)


@needs_truth_tools
@pytest.mark.parametrize("name", ["A01", "A02", "A03", "cart-pole", "NESC-2"])
def test_stored_values_are_computed_again(name):
    from bench.classics_values import VALUES

    found = VALUES[name]()
    assert [v["name"] for v in STORED[name]["values"]] == [v.name for v in found]
    for stored, again in zip(STORED[name]["values"], found, strict=True):
        assert stored["ours"] == pytest.approx(
            again.ours, abs=max(again.uncertainty, 4e-16 * abs(again.ours))
        )
        assert stored["published"] == again.published


def smallest_error(problem, engine):
    errors = []
    for motion in STORED[problem]["motions"]:
        if motion["engine"] == engine:
            errors += [run["error"] for run in motion["runs"] if "error" in run]
            errors += [motion["limit_error"]] if "limit_error" in motion else []
    return min(errors)


@pytest.mark.parametrize(("problem", "engine"), GOALS, ids=" ".join)
def test_the_goals_are_reached(problem, engine):
    assert smallest_error(problem, engine) <= GOALS[problem, engine]


@needs_truth_tools
@pytest.mark.parametrize("engine", ["mujoco", "exudyn-tree"])
def test_a_stored_limit_is_measured_again(engine):
    """The tumbling brick takes a tenth of a second of each engine."""
    from bench.classics import measure

    again = measure("NESC-2", engine, {})
    (motion,) = again["motions"]
    (stored,) = (m for m in STORED["NESC-2"]["motions"] if m["engine"] == engine)
    assert motion["limit_error"] < 1e-9
    assert motion["runs"][0]["error"] == pytest.approx(stored["runs"][0]["error"], rel=1e-3)
