"""Compact encoding of numbers for one HTML file: decimation that keeps peaks, quantisation, compression.

A chunk is gzip(length of the header, header as JSON, arrays), 13 bits in two printable characters; the page
inflates it when it is first needed.  Its header lists the types and lengths of the arrays; {"$": k} refers to
array k, {"$rows": …} is a table of records by columns, {"$numbers": …} a list of numbers of a few digits,
{"$lists": …} one of lists, and {"$texts": …} one of texts, by their places in the list that all chunks share.
That list is stored as templates and the numbers in them.
"""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from plumbline.model.datatypes import AnyArray, Array, Float, Indices, Int, Shaped

STEPS_PER_DECADE = 500  # log-scale curves are rounded to 10^(1/500), 0.46 %
LOWEST_DECADE = -40.0  # decade of code 2; code 0 is "no number", code 1 an exact zero
COARSE = 40  # codes to which values are rounded that a plot alone shows: a pixel of its log scale
DIGITS = 3  # of numbers in tables
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")
# all that is printable but what HTML or an attribute might take for its own
ALPHABET = np.array([c for c in range(33, 127) if chr(c) not in '<&"'], np.uint8)
WIDTHS = {"f4": 4, "u4": 4, "u2": 2, "i2": 2, "u1": 1, "i1": 1}  # bytes
NO_NUMBER = -(2**15)


def bucket_edges(count: int, points: int) -> Int[Indices, "edges"]:
    """Divide samples into buckets of consecutive ones.

    Args:
        points: number of values that may remain; each bucket keeps two.

    Returns:
        The edges of at most ``points // 2`` buckets, or of one bucket per sample where they all fit.

    """
    if count <= points:
        return np.arange(count + 1)
    return np.unique(np.linspace(0, count, points // 2 + 1).astype(int))


def decimate_times(t: Float[Array, "n"], points: int) -> Float[Array, "m"]:
    """Return the times that go with the values of `decimate`: first and last of each bucket.

    Args:
        t: times [s].
        points: number of values that may remain.

    Returns:
        Times [s], m at most ``points``.

    """
    edges = bucket_edges(len(t), points)
    return t if len(edges) == len(t) + 1 else np.stack([t[edges[:-1]], t[edges[1:] - 1]], 1).ravel()


def decimate(y: Float[Array, "n"], points: int) -> Float[Array, "m"]:
    """Keep the minimum and maximum of each bucket, in the order they occur, so that no peak is lost.

    Args:
        points: number of values that may remain.

    Returns:
        Values, m at most ``points``; a bucket with a value that is not finite ends in NaN.

    """
    edges = bucket_edges(len(y), points)
    if len(edges) == len(y) + 1:
        return y
    out = np.empty((len(edges) - 1, 2))
    for k, (a, b) in enumerate(pairwise(edges)):
        part = y[a:b]
        finite = np.isfinite(part)
        if not finite.all():
            out[k] = part[finite].max() if finite.any() else np.nan, np.nan
            continue
        low, high = int(part.argmin()), int(part.argmax())
        out[k] = part[[low, high]] if low <= high else part[[high, low]]
    return out.ravel()


def log_scale_codes(y: Float[Array, "n"], coarse: int = 1) -> Shaped[AnyArray, "n"]:
    """Encode magnitudes on a log scale, with a relative error of at most 0.24 % times ``coarse``.

    Args:
        coarse: codes of numbers are multiples of it, plus 2; fewer different ones compress better.

    Returns:
        uint16: 0 for not finite, 1 for exactly zero, else 2 + 500 (log10 |y| + 40).

    """
    size = np.abs(np.asarray(y, dtype=float))
    with np.errstate(divide="ignore", invalid="ignore"):
        codes = (np.log10(size) - LOWEST_DECADE) * STEPS_PER_DECADE / coarse
        codes = np.clip(coarse * np.round(codes), 0, 65000) + 2
    codes = np.where(size == 0, 1, np.where(np.isfinite(size), codes, 0))
    return codes.astype(np.uint16)


class ChunkBuilder:
    """Collects the arrays of one chunk."""

    def __init__(self, texts: dict[str, int] | None = None) -> None:
        """Start without arrays.

        Args:
            texts: places of the texts in the list that all chunks share; new ones are added.

        """
        self._parts: list[bytes] = []
        self._arrays: list[tuple[str, int]] = []
        self._texts = {} if texts is None else texts

    def continued(self) -> ChunkBuilder:
        """Return another builder with the same arrays so far."""
        other = ChunkBuilder(self._texts)
        other._parts, other._arrays = [*self._parts], [*self._arrays]
        return other

    def add(self, array: Shaped[AnyArray, "..."]) -> dict[str, int]:
        """Store an array.

        Args:
            array: of type float32, uint32, uint16, int16, uint8 or int8.

        Returns:
            The reference to the array, for the header.

        """
        kind = f"{array.dtype.kind}{array.dtype.itemsize}"
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        # low bytes, then higher ones, which hardly change and compress well
        data = b"".join(data[i :: WIDTHS[kind]] for i in range(WIDTHS[kind]))
        self._parts.append(data)
        self._arrays.append((kind, int(array.size)))
        return {"$": len(self._parts) - 1}

    def add_table(self, records: Sequence[Mapping[str, Any]], exact: Collection[str] = ()) -> dict[str, Any]:
        """Store records by columns; what is None, and a number that is not finite, is absent in the page.

        Args:
            records: fields of one name are texts, numbers, records, or anything.
            exact: names of numbers that keep their digits.

        Returns:
            The table, for the header.

        """
        names = dict.fromkeys(name for record in records for name in record)
        values = {name: [record.get(name) for record in records] for name in names}
        columns = {name: some if name in exact else self._column(some) for name, some in values.items()}
        return {"$rows": len(records), "columns": columns}

    def add_texts(self, values: Sequence[str | None]) -> dict[str, Any]:
        """Store texts."""
        codes = [0 if x is None else 1 + self._texts.setdefault(x, len(self._texts)) for x in values]
        return {"$texts": self.add(np.array(codes, np.uint32))}

    def _column(self, values: list[Any]) -> Any:
        given = [x for x in values if x is not None]
        types = set(map(type, given))
        if types <= {str}:
            return self.add_texts(values)
        if types <= {dict} and not any("$" in x for x in given):
            return self.add_table([x or {} for x in values])
        if types <= {list} and {type(y) for x in given for y in x} <= {float, type(None)}:
            counts = np.array([len(x or ()) for x in values], np.uint16)
            return {"$lists": [self.add(counts), self._column([y for x in given for y in x])]}
        if not types <= {int, float, bool} or any(isinstance(x, int) and abs(x) >= 10**DIGITS for x in given):
            return [None if isinstance(x, float) and not np.isfinite(x) else x for x in values]
        # digits and exponent: of doubles −326 … 306
        found = np.full(len(values), NO_NUMBER, np.int16), np.zeros(len(values), np.int16)
        for i, x in enumerate(values):
            if x is not None and np.isfinite(x):
                first, _, exponent = f"{x:.{DIGITS - 1}e}".partition("e")
                found[0][i] = int(first.replace(".", ""))
                found[1][i] = int(exponent) - (DIGITS - 1) if found[0][i] else 0
        return {"$numbers": [self.add(some) for some in found]}

    def encode(self, header: Any) -> str:
        """Finish the chunk.

        Returns:
            The chunk: its length in bytes, a colon and its characters.

        """
        kinds, sizes = zip(*self._arrays, strict=True) if self._arrays else ((), ())
        header = {"kinds": " ".join(kinds), "sizes": sizes, "header": header}
        text = json.dumps(header, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
        body = len(text).to_bytes(4, "little") + text + b"".join(self._parts)
        packed = gzip.compress(body, 9, mtime=0)
        bits = np.unpackbits(np.frombuffer(packed, np.uint8))
        groups = np.pad(bits, (0, -len(bits) % 13)).reshape(-1, 13) @ (1 << np.arange(12, -1, -1))
        pairs = np.stack(np.divmod(groups, len(ALPHABET)), axis=1)
        return f"{len(packed)}:{ALPHABET[pairs].tobytes().decode()}"


def encode_texts(texts: Iterable[str]) -> str:
    """Encode the list of texts that all chunks share: of each its template, and by template its numbers."""
    packer, codes, templates = ChunkBuilder(), list[int](), dict[str, int]()
    numbers: list[list[list[str]]] = []
    for text in texts:
        template = NUMBER.sub("\0", text)
        code = templates.setdefault(template, len(templates))
        codes.append(code)
        numbers[code:] = numbers[code:] or [[]]
        numbers[code].append(NUMBER.findall(text))
    header = {
        "templates": list(templates),
        "codes": packer.add(np.array(codes, np.uint32)),
        "numbers": [[" ".join(slot) for slot in zip(*some, strict=True)] for some in numbers],
    }
    return packer.encode(header)
