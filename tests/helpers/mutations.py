"""Random damage to files and documents, and the time that reading one damaged example may take."""

from __future__ import annotations

import copy
import random
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

EXAMPLE_SECONDS = 5.0  # s of CPU time for one example
PUNCTUATION = b"[]{}:,-&*!|>'\"\n\t #x0.e\\\xff\x00"

HOSTILE_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, 2, -1, 10**30, -(10**400), 2**63, 0.5, 1e-320, 1e-9, 1e20, 1e308, -1e308,
    float("nan"), float("inf"), "", " ", "x", "nan", "1", "-", "\x00", "\u202e", "\ud800", "a" * 3000, "../x",
    "/", "[red]x[/nope]", "<script>", [], {}, [[]], [1, 2, 3], [0.0, None], {"": 1}, {"a": {"b": []}},
    [[[[[[]]]]]],
)  # fmt: skip


def damaged_bytes(data: bytes, draw: random.Random) -> bytes:
    """A few random edits of a file: bytes changed, removed, doubled or put in, or the file cut off."""
    found = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 4, 8))):
        at, size = draw.randrange(len(found) + 1), draw.choice((0, 1, 2, 8, 100))
        match draw.randrange(6):
            case 0:
                found[at : at + size] = bytes(draw.choices(PUNCTUATION, k=draw.randrange(4)))
            case 1:
                found[at : at + size] = draw.randbytes(size)
            case 2:
                del found[at : at + size]
            case 3:
                found[at:at] = found[at : at + size]
            case 4 if at < len(found):
                found[at] ^= 1 << draw.randrange(8)
            case 5 if draw.random() < 0.3:
                del found[at:]
    return bytes(found)


def damaged_document(document: Any, draw: random.Random) -> Any:
    """A copy of plain data in which one to three values, keys or entries are changed, doubled or removed."""
    found = copy.deepcopy(document)
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        every = list(places(found))
        if not every:
            return draw.choice(HOSTILE_VALUES)
        holder, key = draw.choice(every)
        match draw.randrange(5):
            case 0 | 1:
                holder[key] = copy.deepcopy(draw.choice(HOSTILE_VALUES))
            case 2:
                del holder[key]
            case 3 if isinstance(holder, dict):
                holder[draw.choice(("", "x", f"{key}s", str(key).upper()))] = holder.pop(key)
            case 3:
                holder.insert(key, copy.deepcopy(holder[key]))
            case 4:
                value, (_, other) = holder[key], draw.choice(every)
                holder[key] = {other: value} if draw.random() < 0.3 else _scaled(value, draw)
    return found


def places(document: Any) -> Iterator[tuple[Any, Any]]:
    """Every (holder, key) of a document; of long lists the first entries, so that all parts have a chance."""
    pairs = document.items() if isinstance(document, dict) else enumerate(document[:6])
    for key, value in pairs:
        yield document, key
        if isinstance(value, dict | list):
            yield from places(value)


def _scaled(value: Any, draw: random.Random) -> Any:
    if isinstance(value, int | float):
        return value * draw.choice((-1, 0, 2, 1e6, 1e-6))
    return [value] if not isinstance(value, str) else value * draw.choice((0, 2, 500))


@contextmanager
def limited_time(seconds: float = EXAMPLE_SECONDS) -> Iterator[None]:
    """Raise TimeoutError in the block after this much CPU time, which other processes do not change."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"more than {seconds:g} s of CPU time")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
