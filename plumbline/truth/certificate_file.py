"""Certificates of motions as files: compressed JSON with doubles as hexadecimal texts, read and validated.

This file imports numpy and the standard library only.  What it returns is what
`certificate_checker` proves a theorem about.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

FORMAT, VERSION = "plumbline enclosure certificate", 2
MAX_BITS, MAX_BODIES, MAX_TERMS = 2000, 100, 401
MAX_CLAIM = 200  # characters of the field `scenario`
JOINTS: dict[Any, tuple[int, int, int, tuple[int, ...]]] = {  # counts of u, p and slides; axes of turns
    "rod": (1, 1, 0, ()), "free": (1, 1, 0, ()), "ball": (0, 1, 0, ()), "weld": (0, 0, 0, ()),
    "slide": (0, 0, 1, ()), "cylindrical": (0, 0, 1, (2,)), "hinge": (0, 0, 0, (2,)),
    "universal": (0, 0, 0, (0, 1)),
}  # fmt: skip
SHAPES: dict[str, tuple[tuple[int, ...], int]] = {  # and power of seconds; per body or spring, but gravity
    "gravity": ((3,), -2), "mass": ((), 0), "inertia": ((3, 3), 0), "point": ((2, 3), 0), "force": ((3,), -2),
    "moment": ((3,), -2), "drag_force": ((), -1), "drag_moment": ((), -1), "length": ((), 0),
    "armature": ((2,), 0), "damping": ((2,), -1), "stiffness": ((2,), -2), "rest": ((2,), 0),
    "effort": ((2,), -2), "turn": ((2, 4), 0), "p": ((4,), 0), "omega": ((3,), -1), "u": ((3,), 0),
    "udot": ((3,), -1), "x": ((2,), 0), "xdot": ((2,), -1), "spring_point": ((2, 3), 0),
    "spring_stiffness": ((), -2), "spring_damping": ((), -1), "spring_length": ((), 0),
}  # fmt: skip
Array = np.ndarray[Any, Any]


@dataclass(frozen=True, eq=False)
class Certificate:
    """A candidate motion, and what it is a motion of."""

    kind: list[str]  # of the joints, by the names of JOINTS
    far: list[int]  # bodies, −1 the world
    springs: list[list[int]]  # the bodies of each spring
    data: dict[str, Array]  # the model and its initial state by the names of SHAPES; doubles, SI
    times: list[float]  # s, of the samples
    time_exponent: int  # the unit of time is 2**time_exponent s
    bits: int  # lengths and coefficients are integers times 2**-bits
    steps: list[Any]  # [length, then per coordinate (q, then v) its coefficients from the power 0 of s on]
    scenario: str = ""  # the digest of the scenario that it claims to be of: no part of the theorem

    @property
    def sizes(self) -> tuple[list[tuple[int, int, int, int]], ...]:
        """Of q, of v and of v̇ per joint the number of entries of p or ω, of u, of x and of functions of q."""
        springs = zip(self.kind, self.data["stiffness"][:, 0], strict=True)
        joints = [(*JOINTS[kind], kind == "ball" and k != 0) for kind, k in springs]
        q = [(4 * p, 3 * u, slide + len(t), 2 * (len(t) + bent)) for u, p, slide, t, bent in joints]
        v = [(3 * p, 3 * u, slide + len(t), 0) for u, p, slide, t, _ in joints]
        return q, v, v

    @property
    def nv(self) -> int:
        """Number of rates v."""
        return sum(map(sum, self.sizes[1]))

    @property
    def nq(self) -> int:
        """Number of coordinates q."""
        return sum(map(sum, self.sizes[0])) + len(self.springs)


def parse_certificate(raw: bytes) -> Certificate:
    """Validate a certificate.

    Args:
        raw: the file's bytes: gzip-compressed JSON, or JSON.

    Returns:
        The certificate, with every number finite and every shape as the model demands.

    Raises:
        MalformedCertificate: something is wrong with the file; the message says where and what is valid.

    """
    data = read_json(raw)
    _expect(isinstance(data, dict) and data.get("format") == FORMAT, "format", f"the text {FORMAT!r}")
    _expect(data.get("version") == VERSION, "version", str(VERSION))
    names = ("bits", "time_exponent", "steps", "kind", "far", "springs")
    bits, exponent, steps, kind, far, springs = (data.get(name) for name in names)
    _expect(type(bits) is int and 16 <= bits <= MAX_BITS, "bits", f"an integer from 16 to {MAX_BITS}")
    _expect(type(exponent) is int and abs(exponent) <= 60, "time_exponent", "an integer from -60 to 60")
    fits = isinstance(kind, list) and len(kind) <= MAX_BODIES and {*map(repr, kind)} <= {*map(repr, JOINTS)}
    _expect(fits and {*kind} - {"weld"}, "kind", f"1 to {MAX_BODIES} of {', '.join(JOINTS)}, not welds alone")
    fits = type(far) is list and len(far) == len(kind) and {*map(type, far)} == {int}
    fits = fits and all(-1 <= a < (k if kind[k] != "free" else 0) for k, a in enumerate(far))
    _expect(fits, "far", "of each joint -1 or a body before it, of free bodies -1")
    pairs = type(springs) is list and len(springs) <= MAX_BODIES  # which (F) needs
    pairs = pairs and all(type(x) is list and len(x) == 2 for x in springs)
    fits = pairs and all(type(b) is int and -1 <= b < len(far) for x in springs for b in x)
    _expect(fits, "springs", f"at most {MAX_BODIES} pairs of bodies, -1 the world")
    times, arrays = _doubles(data, "times", (-1,)), {}
    _expect(len(times) and times[0] >= 0 and np.all(np.diff(times) > 0), "times", "ascending numbers ≥ 0")
    for name, (shape, _) in SHAPES.items():
        count = () if name == "gravity" else (len(springs if name.startswith("spring") else far),)
        arrays[name] = _doubles(data, name, count + shape)
    _expect(np.all(arrays["mass"] > 0), "mass", "positive numbers")
    _expect(np.all(arrays["inertia"] == arrays["inertia"].mT), "inertia", "symmetric matrices")
    hung = np.array([JOINTS[name][0] for name in kind]) > 0
    for name in ("armature", "damping", "stiffness"):
        _expect(not np.any(arrays[name][hung]), name, "zeros of rods and free bodies")
    _expect(isinstance(steps, list) and len(steps) > 0, "steps", "a list of steps")
    scenario = data.get("scenario", "")
    _expect(isinstance(scenario, str) and len(scenario) <= MAX_CLAIM, "scenario", "a digest")
    found = Certificate(kind, far, springs, arrays, times.tolist(), exponent, bits, steps, scenario)
    size = found.nq + found.nv
    for k, step in enumerate(steps):
        fits = isinstance(step, list) and len(step) == 1 + size and type(step[0]) is int and step[0] > 0
        _expect(fits, f"steps[{k}]", f"a positive length, then {size} lists of coefficients")
        fits = all(type(x) is list and len(x) <= MAX_TERMS and {*map(type, x)} <= {int} for x in step[1:])
        _expect(fits, f"steps[{k}]", f"lists of at most {MAX_TERMS} integers")
    return found


def _expect(holds: Any, field: str, valid: str) -> None:
    if not holds:
        raise MalformedCertificate(f"{field}: expected {valid}")


def _doubles(data: dict[str, Any], field: str, shape: tuple[int, ...]) -> Array:
    """Array of doubles from nested lists of hexadecimal texts; the shape (-1,) stands for any length."""
    try:
        texts = np.array(data.get(field), dtype=object)
        numbers = np.array([float.fromhex(text) for text in texts.ravel()]).reshape(texts.shape)
    except (ValueError, TypeError, OverflowError):
        numbers = np.array(np.nan)
    numbers = np.zeros(shape) if not numbers.size and 0 in shape else numbers
    fits = numbers.ndim == 1 if shape == (-1,) else numbers.shape == shape
    sound = np.isfinite(numbers) & ((numbers == 0) | (np.abs(numbers) >= 1e-100))  # exact in any unit
    _expect(fits and np.all(sound), field, f"finite doubles as '0x1.8p+0', shape {shape}, not below 1e-100")
    return numbers


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
