"""The JSON data of a certificate's bytes, compressed or not, within limits; the standard library only."""

from __future__ import annotations

import json
import zlib
from typing import Any

MAX_BYTES = 256 * 2**20  # of the text: 30 s of two rods in octuple precision
_INCOMPLETE = "not a complete gzip or JSON file"


class MalformedCertificate(ValueError):
    """The file is no certificate; the message names the field and what is valid."""


def read_json(raw: bytes) -> Any:
    """Decompress the one gzip member that the bytes may be, up to `MAX_BYTES`, and parse the JSON text.

    Raises:
        MalformedCertificate: the bytes are neither, too many, or followed by others.

    """
    stream = None
    try:
        if raw[:2] == b"\x1f\x8b":
            stream = zlib.decompressobj(47)
            raw = stream.decompress(raw, MAX_BYTES + 1)
        if len(raw) > MAX_BYTES:
            limit = f"{MAX_BYTES >> 20} MB, the largest size of a certificate"
            raise MalformedCertificate(f"holds more than {limit}")
        if stream is not None and not stream.eof:
            raise MalformedCertificate(f"{_INCOMPLETE}: the compressed data are cut off")
        if stream is not None and stream.unused_data:
            raise MalformedCertificate("not one gzip file: bytes follow the end of the compressed data")
        return json.loads(raw)
    except MalformedCertificate:
        raise
    except (zlib.error, ValueError, RecursionError) as error:
        raise MalformedCertificate(f"{_INCOMPLETE}: {error}") from None
