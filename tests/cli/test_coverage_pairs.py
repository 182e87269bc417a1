"""The command `coverage --pairs`."""

import json

from tests.helpers.commands import invoke


def test_pairs_that_are_not_covered_end_with_1():
    arguments = ["coverage", "--pairs", "furuta-motor", "slider-crank", "--jobs", "1"]
    result = invoke(*arguments, code=1)
    assert "legal pairs" in result.output and "covered by 2 scenarios" in result.output
    assert "not covered: " in result.output
    result = invoke(*arguments, "--json")
    found = json.loads(result.stdout)
    assert "armature 1 of a hinge alone on its parent" in found["shown"]["furuta-motor"]
    assert "mass of a slide in a loop" in found["shown"]["slider-crank"]
    assert 0 < len(found["lacking"]) < found["legal"]
