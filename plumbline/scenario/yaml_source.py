"""YAML 1.2 text → plain data with the position of every key and value, and every problem on the way.

The node graph is walked here rather than by a constructor of ruamel.yaml: positions and all duplicate keys
are kept, tags build no objects, and the number of values that aliases make is limited.
"""

from __future__ import annotations

import re
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.scanner import Scanner

from plumbline.scenario.errors import Problem, ScenarioError, shorten

MAX_BYTES = 1_000_000
MAX_NODES = 50_000  # about 1,000 bodies in full, 6 s of reading; longer chains repeat
MAX_DEPTH = 20
MAX_TAG_LENGTH = 1000  # characters; ruamel.yaml needs time that grows with the square of it
NO_TAG = "a plain value without a tag"

_LIKELY_CAUSES = (  # part of the parser's message or context, and what most often causes it
    ("'\\t'", "indent with blanks: YAML allows no tabs there"),
    ("cannot start any token", "a text that starts with this character needs quotes"),
    ("mapping values are not allowed", "a colon inside a text needs quotes around the text"),
    ("flow sequence", "a bracket [ is not closed, or a comma is missing"),
    ("flow mapping", "a brace { is not closed, or a comma is missing"),
    ("quoted scalar", "a quote is not closed, or a backslash inside double quotes is not doubled"),
    (
        "could not find expected ':'",
        "a colon is missing, or the line belongs to a text that starts further up",
    ),
    ("<block end>", "the line is not indented like the lines of its block"),
    ("another document", "write one scenario per file: remove the line ---"),
    ("alias", "a text that starts with * needs quotes"),
    ("anchor", "a text that starts with & needs quotes"),
)

TOO_DEEP = "is nested too deeply", f"at most {MAX_DEPTH} levels"
TOO_MANY = f"has more than {MAX_NODES} values (aliases followed)", "fewer values; `repeat` makes long chains"

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


class _ParsingStopped(Exception):
    """Ends the parsing of a file; holds the message, what would be valid, and the mark."""


class _BoundedScanner(Scanner):  # type: ignore[misc,unused-ignore]
    """Stops at a tag that is too long to be decoded in reasonable time."""

    def scan_tag(self) -> Any:
        token = super().scan_tag()
        if len(token.value[1]) > MAX_TAG_LENGTH:
            raise _ParsingStopped(f"has a tag of {len(token.value[1])} characters", NO_TAG, token.start_mark)
        return token


class _BoundedComposer(Composer):  # type: ignore[misc,unused-ignore]
    """Stops the parser where a file is nested too deeply or has too many values for a scenario."""

    node_count = depth = 0

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader=loader)
        self.warn_double_anchors = False  # YAML 1.2 allows them; the last one counts

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.node_count += 1
        if self.node_count > MAX_NODES or self.depth > MAX_DEPTH:
            much, valid = TOO_DEEP if self.depth > MAX_DEPTH else TOO_MANY
            raise _ParsingStopped(much, valid, self.parser.peek_event().start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def dotted_path(path: tuple[PathKey, ...]) -> str:
    """Write the path of a field as ``bodies[0].mass``.

    Args:
        path: the keys and indices from the file's top to the field, as ("bodies", 0, "mass").

    Returns:
        The path; keys that are longer than any field's are shortened.

    """
    return "".join(f"[{key}]" if isinstance(key, int) else f".{shorten(key)}" for key in path).lstrip(".")


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
    return parse_yaml(source, content)


def parse_yaml(source: YamlSource, content: str) -> YamlSource:
    """Parse YAML text.

    Args:
        source: receives data, positions and problems.
        content: the text.

    Returns:
        ``source``.

    Raises:
        ScenarioError: the text is empty, is not YAML, or is too large or too deep for a scenario.

    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Scanner, yaml.Composer = _BoundedScanner, _BoundedComposer
    try:
        root = yaml.compose(content)
    except _ParsingStopped as stop:
        message, valid, mark = stop.args
        raise source.fatal_error(message, valid, (mark.line + 1, mark.column + 1)) from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        message = f"{error.problem or ''} {error.context or ''}"
        hint = next(
            (cause for part, cause in _LIKELY_CAUSES if part in message), "check quotes and indentation"
        )
        text = shorten(error.problem or error.context or "is not YAML", 100)
        raise source.fatal_error(text, at=at, hint=hint) from None
    except ReaderError as error:
        before = content[: error.position]
        at = before.count("\n") + 1, len(before.rpartition("\n")[2]) + 1
        char = ord(error.character) if isinstance(error.character, str) else error.character
        raise source.fatal_error(
            f"the character U+{char:04X} is not allowed in YAML", "printable text", at
        ) from None
    except (YAMLError, ValueError) as error:
        raise source.fatal_error(f"is not YAML: {shorten(str(error), 100)}", at=(1, 1)) from None
    if root is None or (isinstance(root, ScalarNode) and str(root.tag).endswith(":null")):
        raise source.fatal_error("is empty", "a mapping that starts with schema_version: 1", (1, 1))
    budget = [MAX_NODES]
    source.data = _plain_data(source, root, (), budget)
    return source


def _plain_data(source: YamlSource, node: Node, path: tuple[PathKey, ...], budget: list[int]) -> Any:
    at = node.start_mark.line + 1, node.start_mark.column + 1
    budget[0] -= 1
    if budget[0] < 0:
        raise source.fatal_error(*TOO_MANY, at)
    if len(path) > MAX_DEPTH:
        raise source.fatal_error(*TOO_DEEP, at)
    source.value_positions[path] = at
    if isinstance(node, MappingNode):
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = str(key_node.value) if isinstance(key_node, ScalarNode) else "?"
            key_at = key_node.start_mark.line + 1, key_node.start_mark.column + 1
            if key in mapping:
                first = source.key_positions[(*path, key)][0]
                source.add_problem(
                    key_at, (*path, key), f"is given twice, first on line {first}", "each field once"
                )
                continue
            source.key_positions[(*path, key)] = key_at
            mapping[key] = _plain_data(source, value_node, (*path, key), budget)
            if value_node.start_mark.index == value_node.end_mark.index:  # nothing stands there: show the key
                source.value_positions[(*path, key)] = key_at
        return mapping
    if isinstance(node, SequenceNode):
        return [_plain_data(source, item, (*path, index), budget) for index, item in enumerate(node.value)]
    return _scalar_value(source, node, path, at)


def _scalar_value(source: YamlSource, node: Node, path: tuple[PathKey, ...], at: Position) -> Any:
    written, kind = str(node.value), str(node.tag).rpartition(":")[2]
    if not str(node.tag).startswith("tag:yaml.org,2002:"):
        kind = "tag"
    if kind in ("int", "float"):
        try:
            return _parse_number(written)
        except ValueError:  # the tag says a number, the text does not
            return written
    if kind == "bool":
        return written.lower() == "true"
    if kind == "null":
        return None
    if kind not in ("str", "timestamp", "value", "merge"):
        source.add_problem(at, path, f"has the tag {shorten(str(node.tag))}", NO_TAG)
    return written


def _parse_number(written: str) -> int | float:
    """Parse a YAML 1.2 number; a whole one beyond 2^53 becomes a float, as in every field."""
    digits = written.replace("_", "").lower()
    if match := re.fullmatch(r"([-+]?)(0x[0-9a-f]+|0o[0-7]+)", digits):
        return int(match[1] + str(int(match[2], 0)))
    if digits.lstrip("+-") in (".inf", ".nan"):
        return float(digits.replace(".", ""))
    value = float(digits)
    return int(value) if re.fullmatch(r"[-+]?[0-9]+", digits) and abs(value) < 2**53 else value
