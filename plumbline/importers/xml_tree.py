"""XML of model files with line numbers; nothing outside the file is read, and entities are refused."""

from __future__ import annotations

import math
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

from plumbline.importers.neutral_model import MAX_MAGNITUDE, Source
from plumbline.scenario.line_and_column_errors import Problem, ScenarioError, shorten

MAX_BYTES = 64 * 2**20  # the largest robot of the known collections has 2 MB
MAX_DEPTH = 500  # nested elements; MuJoCo's own limit is 500 bodies deep
_DECLARATION = re.compile(rb"\A(?:\xef\xbb\xbf)?\s*<\?xml([^>]*)\?>")
_ENCODING = re.compile(rb"encoding\s*=\s*[\"']([A-Za-z][\w.-]*)[\"']")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\Z", re.ASCII)
_WORD = re.compile(r"[^ \t\r\n]+")  # XML has no other blanks


class ModelFileError(ScenarioError):
    """A model file that cannot be used; ``problems`` has every mistake that was found in it."""


@dataclass
class Element:
    """An element with its attributes, children and position."""

    tag: str
    attributes: dict[str, str]
    source: Source
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def walk(self) -> Iterator[Element]:
        """Go through this element and all below it, in the order of the file.

        Yields:
            Elements.

        """
        stack = [self]
        while stack:
            element = stack.pop()
            yield element
            stack.extend(reversed(element.children))

    def find_all(self, tag: str) -> list[Element]:
        """List the children of a tag.

        Returns:
            The children, in the order of the file.

        """
        return [child for child in self.children if child.tag == tag]

    def find(self, tag: str) -> Element | None:
        """Return the first child of a tag.

        Args:
            tag: of the child, as written in the file.

        Returns:
            The child, or None.

        """
        return next((child for child in self.children if child.tag == tag), None)

    def problem(self, message: str, attribute: str = "", valid: str = "", hint: str = "") -> Problem:
        """Make a problem at this element.

        Args:
            message: what is wrong.
            attribute: the attribute that it is about, if any.

        """
        name = self.attributes.get("name")
        where = f"<{self.tag} name={shorten(repr(name))}>" if name is not None else f"<{self.tag}>"
        return self.source.problem(message, valid, hint, f"{where} {attribute}".strip())


def parse_numbers(
    element: Element, attribute: str, count: int, problems: list[Problem], largest: float = MAX_MAGNITUDE
) -> list[float]:
    """Read the numbers of an attribute, each rounded to double once.

    Args:
        problems: gets what is wrong.
        largest: magnitude that none may exceed.

    Returns:
        ``count`` finite numbers; zeros where something is wrong.

    """
    words = _WORD.findall(element.attributes[attribute])
    valid = f"{count} finite number{'s' if count > 1 else ''}"
    values = [float(word) if _NUMBER.match(word) else math.nan for word in words]
    if len(words) != count:
        problems.append(element.problem(f"has {len(words)} numbers", attribute, valid))
    elif bad := [word for word, value in zip(words, values, strict=True) if not math.isfinite(value)]:
        problems.append(element.problem(f"{shorten(repr(bad[0]))} is no finite number", attribute, valid))
    elif large := [word for word, value in zip(words, values, strict=True) if abs(value) > largest]:
        message = f"{shorten(repr(large[0]))} is too large"
        problems.append(element.problem(message, attribute, f"{valid} up to {largest:g}"))
    else:
        return values
    return [0.0] * count


def read_xml(path: Path, shown: str) -> Element:
    """Parse a file.

    Raises:
        ModelFileError: the file cannot be read, is not well-formed, or declares entities.

    """
    try:
        if not stat.S_ISREG(kind := path.stat().st_mode):  # opening a pipe waits for its writer
            message = "is a folder" if stat.S_ISDIR(kind) else "is a pipe or a device"
            raise ModelFileError([Problem(shown, 0, 0, "", message, "a URDF or MJCF file")])
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except ModelFileError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        reason = getattr(error, "strerror", None) or error
        raise ModelFileError([Problem(shown, 0, 0, "", f"cannot be read: {reason}")]) from None
    if len(data) > MAX_BYTES:
        raise ModelFileError([Problem(shown, 0, 0, "", f"is larger than {MAX_BYTES >> 20} MB")])
    return parse_xml(data, shown)


def parse_xml(data: bytes, shown: str) -> Element:
    """Parse the content of a file.

    Args:
        data: the content.

    Raises:
        ModelFileError: it is not well-formed, or declares entities.

    """
    data, encoding = _without_declaration(data)
    handler = _Handler(shown)
    try:
        handler.parser = expat.ParserCreate(encoding)
        handler.connect()
        handler.parser.Parse(data, True)
    except expat.ExpatError as error:
        words = expat.ErrorString(error.code)
        is_scenario = shown.endswith((".yaml", ".yml"))
        hint = f"scenario files are for: plumbline run {shown}" if is_scenario else ""
        place, message = (error.lineno, error.offset + 1), f"is not well-formed XML: {words}"
        raise ModelFileError([Problem(shown, *place, "", message, hint=hint)]) from None
    except ModelFileError:  # of the handler
        raise
    except (ValueError, LookupError) as error:  # of an encoding that expat leaves to Python
        raise ModelFileError([Problem(shown, 1, 1, "", f"cannot be decoded: {error}")]) from None
    assert handler.root is not None
    return handler.root


def _without_declaration(data: bytes) -> tuple[bytes, str | None]:
    """Blank the XML declaration, whose version is wrong in some published files; keep its encoding."""
    match = _DECLARATION.match(data)
    if match is None:
        return data, None
    encoding = _ENCODING.search(match[1])
    blank = re.sub(rb"[^\n]", b" ", match[0])
    return blank + data[match.end() :], encoding[1].decode("ascii") if encoding else "utf-8"


class _Handler:
    """Builds the tree from the parser's calls."""

    def __init__(self, shown: str) -> None:
        self.shown, self.root = shown, None  # type: str, Element | None
        self.stack: list[Element] = []
        self.parser: Any = None

    def connect(self) -> None:
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = lambda _: self.stack.pop()
        self.parser.CharacterDataHandler = self.characters
        self.parser.EntityDeclHandler = self.refuse_entity
        self.parser.ExternalEntityRefHandler = self.refuse_entity

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        place = Source(self.shown, self.parser.CurrentLineNumber, self.parser.CurrentColumnNumber + 1)
        element = Element(tag, attributes, place)
        if len(self.stack) >= MAX_DEPTH:
            raise ModelFileError([element.problem(f"is nested more than {MAX_DEPTH} deep")])
        if self.stack:
            self.stack[-1].children.append(element)
        else:
            self.root = element
        self.stack.append(element)

    def characters(self, text: str) -> None:
        if self.stack and not text.isspace():
            self.stack[-1].text += text

    def refuse_entity(self, *_: object) -> None:
        line = self.parser.CurrentLineNumber
        problem = Problem(self.shown, line, 1, "", "declares or uses an entity", "a file without entities")
        raise ModelFileError([problem])


def write_xml_in_place(root: Element) -> tuple[str, dict[int, list[Element]]]:
    """Write a tree so that its elements are on the lines of their file, which messages of engines then name.

    Elements of an included file begin lines of their own; what follows in the file that includes it is then
    further down than in that file.

    Returns:
        The text, and which elements begin in each of its lines.

    """
    parts: list[str] = []
    line, file, begun = 1, root.source.file, dict[int, list[Element]]()
    stack: list[Element | str] = [root]
    while stack:
        item = stack.pop()
        if isinstance(item, str):
            parts.append(item)
            continue
        is_alone = item.source.file != root.source.file or file != root.source.file
        count = max(int(is_alone), item.source.line - line if item.source.file == root.source.file else 0)
        parts.append("\n" * count)
        line, file = line + count, item.source.file
        begun.setdefault(line, []).append(item)
        attributes = "".join(f" {k}={quoteattr(v)}" for k, v in item.attributes.items())
        text = " ".join(item.text.split("\n"))  # its line breaks would move what follows
        parts.append(f"<{item.tag}{attributes}>{escape(text)}")
        stack.append(f"</{item.tag}>")
        stack.extend(reversed(item.children))
    return "".join(parts) + "\n", begun


def write_xml(root: Element, width: int = 0) -> str:
    """Write a tree as text.

    Args:
        width: so many characters of a line are filled with whole elements; 0: an element per line.

    """
    lines: list[tuple[int, str, bool]] = []  # depth, text, whether it is whole elements
    stack: list[tuple[int, Element | str]] = [(0, root)]
    while stack:
        depth, item = stack.pop()
        if isinstance(item, str):
            lines.append((depth, item, False))
            continue
        head = f"<{item.tag}" + "".join(f" {k}={quoteattr(v)}" for k, v in item.attributes.items())
        flat = ""
        if not item.children:
            text = escape(item.text)
            flat = f"{head}>{text}</{item.tag}>" if text else f"{head}/>"
        elif depth and len(head) < width:
            whole = "".join(line.strip() for line in write_xml(item).splitlines())
            flat = whole if len(whole) + 2 * depth <= width else ""
        if flat:
            before = lines[-1] if lines else (-1, "", False)
            if before[0] == depth and before[2] and 2 * depth + len(before[1] + flat) <= width:
                flat = lines.pop()[1] + flat
            lines.append((depth, flat, True))
            continue
        lines.append((depth, head + ">" + escape(item.text), False))
        stack.append((depth, f"</{item.tag}>"))
        stack.extend((depth + 1, child) for child in reversed(item.children))
    return "\n".join("  " * depth + text for depth, text, _ in lines) + "\n"
