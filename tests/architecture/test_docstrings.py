"""Docstrings of public functions are informative, and the check notices what is not."""

import pytest

from tools import check_docstrings

CASES = {
    "no docstring": "def f(x: int) -> None:\n    pass\n",
    "the first line repeats the name": 'def load_file() -> None:\n    """Load the file."""\n',
    "Args has 'y', which is no parameter": (
        'def f(x: int) -> None:\n    """Weigh it.\n\n    Args:\n        y: kg, at least 0.\n    """\n'
    ),
    "Args repeats the name 'mass'": (
        'def f(mass: int) -> None:\n    """Weigh it.\n\n    Args:\n        mass: the mass.\n    """\n'
    ),
    "an array without a shape": 'def f(x: Sequence[Array]) -> Float[Array, "3"]:\n    """Weigh it."""\n',
}  # fmt: skip


def test_the_docstring_of_every_public_function_is_informative(capsys):
    assert check_docstrings.main([]) == 0, capsys.readouterr().out


@pytest.mark.parametrize("problem", CASES)
def test_the_check_reports(problem, tmp_path, monkeypatch):
    monkeypatch.setattr(check_docstrings, "ROOT", tmp_path)
    file = tmp_path / "module.py"
    file.write_text(CASES[problem])
    assert [message.split(": ", 2)[2] for message in check_docstrings.problems_in_file(file)] == [problem]
