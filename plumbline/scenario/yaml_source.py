"""YAML 1.2 text → plain data with the position of every key and value, and every problem on the way."""

from __future__ import annotations

import stat
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from plumbline.processes.user_cache import content_key, recall, remember
from plumbline.scenario.errors import Problem, ScenarioError, shorten

MAX_BYTES = 1_000_000
PathKey = str | int
Position = tuple[int, int]


@dataclass
class YamlSource:
    """Plain data of a YAML file and the position of each part (line and column, both from 1)."""

    file: str  # the name that problems show
    data: Any = None  # dicts, lists, texts, numbers, booleans, None
    value_positions: dict[tuple[PathKey, ...], Position] = field(default_factory=dict)
    key_positions: dict[tuple[PathKey, ...], Position] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)  # duplicate keys and tags

    def fatal_error(
        self, message: str, valid: str = "", at: Position = (0, 0), hint: str = ""
    ) -> ScenarioError:
        """Make the error of a file that cannot be read any further.

        Args:
            message: what is wrong.
            valid: what would be valid, a noun phrase.
            at: line and column of the mistake; (0, 0) for the whole file.
            hint: how to correct it.

        Returns:
            The error, to be raised by the caller.

        """
        return ScenarioError([Problem(self.file, *at, "", message, valid, hint)])

    def add_problem(self, at: Position, path: tuple[PathKey, ...], message: str, valid: str) -> None:
        """Note a problem that does not stop the parsing.

        Args:
            at: line and column of the mistake.
            path: the field.
            message: what is wrong.
            valid: what would be valid, a noun phrase.

        """
        self.problems.append(Problem(self.file, *at, dotted_path(path), message, valid))


def dotted_path(path: tuple[PathKey, ...]) -> str:
    """Write the path of a field as ``bodies[0].mass``.

    Args:
        path: the keys and indices from the file's top to the field, as ("bodies", 0, "mass").

    Returns:
        The path; keys that are longer than any field's are shortened.

    """
    return "".join(f"[{key}]" if isinstance(key, int) else f".{shorten(key)}" for key in path).lstrip(".")


def is_file(path: Path) -> bool:
    """Find out whether a path is that of a file; a text that cannot be a path is none.

    Args:
        path: any path, of any length.

    Returns:
        True where there is a regular file that can be looked at.

    """
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, without permission, or with a null character
        return False


def read_yaml(path: Path) -> YamlSource:
    """Read a YAML file.

    Args:
        path: a regular file of at most MAX_BYTES, UTF-8 with or without a byte order mark.

    Returns:
        Its data, positions and problems.

    Raises:
        ScenarioError: the file cannot be read or is not YAML text.

    """
    source = YamlSource(str(path))
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a pipe would wait, a device never end
            raise source.fatal_error("is not a regular file", "a YAML file")
        with path.open("rb") as handle:
            raw = handle.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        if isinstance(error, ScenarioError):
            raise
        raise source.fatal_error(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(raw) > MAX_BYTES:
        raise source.fatal_error(
            f"is larger than {MAX_BYTES} bytes", "a smaller file; `repeat` makes long chains"
        )
    try:
        content = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = raw[: error.start]
        at = before.count(b"\n") + 1, len(before.rpartition(b"\n")[2].decode("utf-8-sig", "replace")) + 1
        raise source.fatal_error(f"byte 0x{raw[error.start]:02x} is not UTF-8", "UTF-8 text", at) from None
    key = content_key("YAML", *_parser_code(), raw)
    if (parsed := recall(key)) is not None:
        source.data, source.value_positions, source.key_positions = parsed
        return source
    from plumbline.scenario.yaml_parser import parse_yaml  # only files that no run has read yet need it

    parse_yaml(source, content)
    if not source.problems:
        remember(key, (source.data, source.value_positions, source.key_positions))
    return source


@cache
def _parser_code() -> list[bytes]:
    return [path.read_bytes() for path in sorted(Path(__file__).parent.glob("yaml_*.py"))]
