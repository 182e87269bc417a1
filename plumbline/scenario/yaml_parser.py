"""The parser of YAML 1.2 text; imported where a file was not parsed before, because ruamel.yaml loads slowly.

The node graph is walked here rather than by a constructor of ruamel.yaml: positions and all duplicate keys
are kept, tags build no objects, and the number of values that aliases make is limited.
"""

from __future__ import annotations

import re
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.scanner import Scanner

from plumbline.scenario.line_and_column_errors import shorten
from plumbline.scenario.yaml_source import FieldPath, Position, YamlSource

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


def parse_yaml(source: YamlSource, content: str) -> YamlSource:
    """Parse YAML text.

    Args:
        source: receives data, positions and problems.

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


def _plain_data(source: YamlSource, node: Node, path: FieldPath, budget: list[int]) -> Any:
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


def _scalar_value(source: YamlSource, node: Node, path: FieldPath, at: Position) -> Any:
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
