"""Read YAML 1.2 files; what was parsed once comes from the user's cache."""

from __future__ import annotations

import stat
from functools import cache
from pathlib import Path

from plumbline.processes.user_cache import content_key, recall, remember
from plumbline.scenario.line_and_column_errors import ScenarioError
from plumbline.scenario.yaml_source import YamlSource

MAX_BYTES = 1_000_000


def read_bytes(path: Path) -> bytes:
    """Read the content of a YAML file.

    Args:
        path: a regular file of at most MAX_BYTES.

    Raises:
        ScenarioError: the file cannot be read.

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
    return raw


def read_yaml(path: Path) -> YamlSource:
    """Read a YAML file.

    Args:
        path: as of `read_bytes`; UTF-8 with or without a byte order mark.

    Returns:
        Its data, positions and problems.

    Raises:
        ScenarioError: the file cannot be read or is not YAML text.

    """
    raw = read_bytes(path)
    source = YamlSource(str(path))
    try:
        content = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = raw[: error.start]
        at = before.count(b"\n") + 1, len(before.rpartition(b"\n")[2].decode("utf-8-sig", "replace")) + 1
        raise source.fatal_error(f"byte 0x{raw[error.start]:02x} is not UTF-8", "UTF-8 text", at) from None
    key = content_key("YAML", *_parser_code(), raw)
    if (parsed := recall(key, lambda found: len(found) == 3)) is not None:
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
