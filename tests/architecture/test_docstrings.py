"""Public functions document arguments, return values and exceptions, and the check notices gaps."""

import pytest

from tools import check_docstrings

CASES = {
    "no docstring": "def f(x: int) -> None:\n    pass\n",
    "the first line repeats the name": 'def load_file() -> None:\n    """Load the file."""\n',
    "Args lacks 'x'": 'def f(x: int) -> None:\n    """Do a thing that matters."""\n',
    "Args repeats the name 'mass'": (
        'def f(mass: int) -> None:\n    """Weigh it.\n\n    Args:\n        mass: the mass.\n    """\n'
    ),
    "no Returns": 'def f() -> int:\n    """Count the joints."""\n    return 1\n',
    "Raises lacks ValueError": 'def f() -> None:\n    """Refuse to work."""\n    raise ValueError("no")\n',
}  # fmt: skip


def test_every_public_function_is_documented(capsys):
    assert check_docstrings.main([]) == 0, capsys.readouterr().out


@pytest.mark.parametrize("problem", CASES)
def test_the_check_reports(problem, tmp_path, monkeypatch):
    monkeypatch.setattr(check_docstrings, "ROOT", tmp_path)
    file = tmp_path / "module.py"
    file.write_text(CASES[problem])
    assert [message.split(": ", 2)[2] for message in check_docstrings.problems_in_file(file)] == [problem]
