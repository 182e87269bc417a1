"""The list of mutants that no test notices is of code that is there, each with its reason."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.mutation.survivors import listed

ROOT = Path(__file__).resolve().parents[2]
LISTED = listed()


@pytest.mark.parametrize("file", sorted({file for file, _, _ in LISTED}))
def test_listed_survivors_are_of_code_that_is_there(file: str) -> None:
    lines = [line.strip() for line in (ROOT / file).read_text(encoding="utf-8").splitlines()]
    for (name, was, now), why in LISTED.items():
        if name == file:
            part = was.split("\n")
            assert any(lines[i : i + len(part)] == part for i in range(len(lines))), (
                f"the code has changed, try it again: {was}"
            )
            assert now.rstrip("\n") == now != was and len(why) > 20, was
