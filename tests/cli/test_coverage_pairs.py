"""The command `coverage --pairs`."""

import json

from click.testing import CliRunner

from plumbline.cli.main import main


def test_pairs_that_are_not_covered_end_with_1():
    arguments = ["coverage", "--pairs", "furuta-motor", "slider-crank", "--jobs", "1"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1, result.output
    assert "legal pairs" in result.output and "covered by 2 scenarios" in result.output
    assert "not covered: " in result.output
    result = CliRunner().invoke(main, [*arguments, "--json"])
    found = json.loads(result.stdout)
    assert "armature 1 of a hinge alone on its parent" in found["shown"]["furuta-motor"]
    assert "mass of a slide in a loop" in found["shown"]["slider-crank"]
    assert 0 < len(found["lacking"]) < found["legal"]
