"""The plain data of a YAML file with the position of every key and value, and every problem on the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from plumbline.scenario.line_and_column_errors import Problem, ScenarioError, shorten

PathKey = str | int
FieldPath = tuple[PathKey, ...]  # keys and indices from the file's top to a field
Position = tuple[int, int]


@dataclass
class YamlSource:
    """Plain data of a YAML file and the position of each part (line and column, both from 1)."""

    file: str  # the name that problems show
    data: Any = None  # dicts, lists, texts, numbers, booleans, None
    value_positions: dict[FieldPath, Position] = field(default_factory=dict)
    key_positions: dict[FieldPath, Position] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)  # duplicate keys and tags

    def fatal_error(
        self, message: str, valid: str = "", at: Position = (0, 0), hint: str = ""
    ) -> ScenarioError:
        """Make the error of a file that cannot be read any further.

        Args:
            message: what is wrong.
            valid: what would be valid, a noun phrase.
            at: line and column of the mistake; (0, 0) for the whole file.

        Returns:
            The error, to be raised by the caller.

        """
        return ScenarioError([Problem(self.file, *at, "", message, valid, hint)])

    def position(self, path: FieldPath) -> Position:
        """Find the value of a field.

        Args:
            path: the field, which the file may leave out.

        Returns:
            Where its value begins, else that of the innermost field around it.

        """
        above = (path[:size] for size in range(len(path), -1, -1))
        return next((self.value_positions[p] for p in above if p in self.value_positions), (1, 1))

    def problem(self, path: FieldPath, message: str, valid: str) -> Problem:
        """Describe what is wrong with a field.

        Args:
            message: what is wrong.
            valid: what would be valid, a noun phrase.

        Returns:
            The problem, at the field's position.

        """
        return Problem(self.file, *self.position(path), dotted_path(path), message, valid)

    def add_problem(self, at: Position, path: FieldPath, message: str, valid: str) -> None:
        """Note a problem that does not stop the parsing.

        Args:
            at: line and column of the mistake.
            message: what is wrong.
            valid: what would be valid, a noun phrase.

        """
        self.problems.append(Problem(self.file, *at, dotted_path(path), message, valid))


def dotted_path(path: FieldPath) -> str:
    """Write the path of a field as ``bodies[0].mass``.

    Args:
        path: the keys and indices from the file's top to the field, as ("bodies", 0, "mass").

    Returns:
        The path; keys that are longer than any field's are shortened.

    """
    return "".join(f"[{key}]" if isinstance(key, int) else f".{shorten(key)}" for key in path).lstrip(".")
