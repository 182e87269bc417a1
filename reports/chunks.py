"""Compact encoding of numbers for one HTML file: decimation that keeps peaks, quantisation, compression.

A chunk is gzip(length of the header, header as JSON, arrays), in base64; the page inflates it when it
is first needed.  In the header {"$": [offset, length, type]} refers to an array.
"""

from __future__ import annotations

import base64
import gzip
import json
from itertools import pairwise
from typing import Any

import numpy as np

from plumbline.model.datatypes import AnyArray, Array, Float, Indices, Int, Shaped

STEPS_PER_DECADE = 500  # log-scale curves are rounded to 10^(1/500), 0.46 %
LOWEST_DECADE = -40.0  # decade of code 2; code 0 is "no number", code 1 an exact zero


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


def log_scale_codes(y: Float[Array, "n"]) -> Shaped[AnyArray, "n"]:
    """Encode magnitudes on a log scale, with a relative error of at most 0.24 %.

    Returns:
        uint16: 0 for not finite, 1 for exactly zero, else 2 + 500 (log10 |y| + 40).

    """
    size = np.abs(np.asarray(y, dtype=float))
    with np.errstate(divide="ignore", invalid="ignore"):
        codes = np.clip(np.round((np.log10(size) - LOWEST_DECADE) * STEPS_PER_DECADE), 0, 65000) + 2
    codes = np.where(size == 0, 1, np.where(np.isfinite(size), codes, 0))
    return codes.astype(np.uint16)


class ChunkBuilder:
    """Collects the arrays of one chunk."""

    def __init__(self) -> None:
        """Start without arrays."""
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, array: Shaped[AnyArray, "..."]) -> dict[str, list[Any]]:
        """Store an array.

        Args:
            array: of type float32, uint16, int16, uint8 or int8.

        Returns:
            The reference to the array, for the header.

        """
        kind = {"float32": "f4", "uint16": "u2", "int16": "i2", "uint8": "u1", "int8": "i1"}[array.dtype.name]
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        if kind in ("u2", "i2"):  # low bytes, then high bytes: the high ones hardly change and compress well
            data = data[0::2] + data[1::2]
        reference = {"$": [self._size, int(array.size), kind]}
        padding = bytes(-len(data) % 4)
        self._parts.append(data + padding)
        self._size += len(data) + len(padding)
        return reference

    def encode(self, header: Any) -> str:
        """Finish the chunk.

        Returns:
            The chunk, base64.

        """
        text = json.dumps(header, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        body = len(text).to_bytes(4, "little") + text + b"".join(self._parts)
        return base64.b64encode(gzip.compress(body, 9, mtime=0)).decode()
