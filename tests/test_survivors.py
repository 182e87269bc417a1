"""The list of mutants that no test notices is of code that is there, each with its reason."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).parents[1]
SURVIVORS = YAML(typ="safe").load(ROOT / "tests/survivors.yaml")


@pytest.mark.parametrize("entry", SURVIVORS, ids=lambda entry: f"{entry['file']}: {entry['now']}"[:80])
def test_a_listed_survivor_is_of_code_that_is_there(entry: dict[str, str]) -> None:
    assert set(entry) == {"file", "was", "now", "why"}
    lines = [line.strip() for line in (ROOT / entry["file"]).read_text(encoding="utf-8").splitlines()]
    was = entry["was"].split("\n")
    assert any(lines[i : i + len(was)] == was for i in range(len(lines))), (
        "the code has changed: try it again"
    )
    assert entry["now"] != entry["was"] and len(entry["why"]) > 20


def test_none_is_listed_twice() -> None:
    keys = [(entry["file"], entry["was"], entry["now"]) for entry in SURVIVORS]
    assert len(set(keys)) == len(keys)
