"""Every listed survivor belongs to a function that exists and has a reason.

Not part of the default test run: a list must not stop a rename.  Run it beside ``make mutants``:
``python -m pytest tools/mutation``.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tools.mutation.mutation import TARGETS, target_files, target_tests
from tools.mutation.survivors import load_survivors

ROOT = Path(__file__).resolve().parents[2]
LISTED = load_survivors()


def qualified_names(node: ast.AST, prefix: str = "") -> set[str]:
    """Return the qualified names of all functions and classes inside a node."""
    names: set[str] = set()
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            name = f"{prefix}{child.name}"
            names |= {name} | qualified_names(child, f"{name}.")
        else:
            names |= qualified_names(child, prefix)
    return names


@pytest.mark.parametrize("file", sorted({key[0] for key in LISTED}))
def test_listed_survivors_belong_to_functions_that_exist(file: str) -> None:
    names = qualified_names(ast.parse((ROOT / file).read_text(encoding="utf-8"))) | {""}
    for (name, function, change, occurrence), reason in LISTED.items():
        if name == file:
            assert function in names, f"no function {function}: run the mutants of {file} again"
            assert occurrence >= 1 and "→" in change and len(reason) > 20, change


@pytest.mark.parametrize("target", [*TARGETS, "plumbline/judging/outlier.py", "reference_impl/direct.py"])
def test_every_target_has_files_and_tests(target: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen: ``judging``, the name of a target and of no folder, ended with a KeyError."""
    monkeypatch.chdir(ROOT)
    files = target_files(target)
    assert files
    assert all((ROOT / test).is_file() for test in target_tests(files))
    assert len(target_tests(files)) >= 1
