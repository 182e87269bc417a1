"""Certificates of motions: candidates by Taylor's method, and their proof by `certificate_checker`.

Nothing here is trusted but the conversion of the model: of a wrong candidate the checker rejects the
certificate, or it proves a wider enclosure.  Proved motions are kept in the user's cache as doubles with a
radius, by what they are proved for.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.invariants import motion_samples
from plumbline.model.kinematics import quaternion_rate
from plumbline.processes.record_encoding import UnfitRecord, decode_record, encode_record
from plumbline.processes.user_cache import (
    CheckedFiles,
    DamagedFile,
    content_key,
    describe_failure,
    user_cache_folder,
)
from plumbline.truth import TruthUnavailable, import_truth_tool
from plumbline.truth.certificate_file import (
    FORMAT,
    JOINTS,
    SHAPES,
    VERSION,
    Certificate,
    MalformedCertificate,
    parse_certificate,
)
from plumbline.truth.taylor import taylor_series

if TYPE_CHECKING:
    from plumbline.truth.certificate_checker import Enclosure

CertificatePrecision = Literal["quad", "octuple"]
BITS: dict[CertificatePrecision, int] = {"quad": 110, "octuple": 230}  # after the binary point
ORDER_PER_BIT = 0.5  # of the series: a step is a quarter of their radius of convergence
LENGTH_BITS = 40  # after the binary point, of a step
MAX_STEPS = (0.5, 0.25, 0.125)  # tried in turn, in units of time; a motion at rest has infinite ones


def load_checker() -> Any:
    """Import the checker, which needs python-flint.

    Returns:
        The module `plumbline.truth.certificate_checker`.

    Raises:
        TruthUnavailable: python-flint is not installed.

    """
    import_truth_tool("flint")
    from plumbline.truth import certificate_checker

    return certificate_checker


def reason_not_provable(model: Model) -> str:
    """Say why motions of a mechanism cannot be proved.

    Returns:
        A sentence; empty where they can.

    """
    if model.has_loops:
        return "motions of closed loops are not proved: the checker has the equations of trees"
    if unknown := sorted({*model.kind} - JOINTS.keys()):
        return (
            f"motions of {' and '.join(unknown)} joints are not proved: the checker has no equations of them"
        )
    return ""


def prove_motion(
    model: Model,
    state: State,
    times: Array,
    scenario: str = "",
    precision: CertificatePrecision = "quad",
    on_step: Callable[[int, int], None] = lambda _done, _of: None,
) -> tuple[bytes, Enclosure]:
    """Find a candidate and prove it; where it is rejected, try shorter steps and octuple precision.

    Args:
        state: initial state, of which the minimal coordinates are used.
        times: (T,) [s] of the samples, ascending from 0 on.
        scenario: content hash of the scenario, written to the certificate.
        on_step: called after each proved step with the numbers of proved steps and of all.

    Returns:
        The certificate as the bytes of its file, and what it proves.

    Raises:
        Rejected: no candidate could be proved (of `plumbline.truth.certificate_checker`).
        TruthUnavailable: python-flint, heyoka (Linux only) or mpmath is not installed, or such motions are
            not proved.
        EngineFailure: heyoka stops, or was built without that precision.

    """
    if reason := reason_not_provable(model):
        raise TruthUnavailable(reason)
    checker = load_checker()
    tried = [(max_step, precision) for max_step in MAX_STEPS[:2]]
    for max_step, bits in dict.fromkeys([*tried, *((max_step, "octuple") for max_step in MAX_STEPS)]):
        raw = make_certificate(model, state, times, scenario, bits, max_step)
        try:
            return raw, checker.enclose_motion(parse_certificate(raw), on_step)
        except MalformedCertificate as error:  # too large
            rejection = checker.Rejected(f"the certificate {error}: a shorter duration needs less")
        except checker.Rejected as error:
            rejection = error
    raise rejection


def make_certificate(
    model: Model,
    state: State,
    times: Array,
    scenario: str = "",
    precision: CertificatePrecision = "quad",
    max_step: float = MAX_STEPS[0],
) -> bytes:
    """Write a candidate motion as a certificate, without proving it.

    Args:
        state: initial state, of which the minimal coordinates are used.
        times: (T,) [s] of the samples, ascending from 0 on.
        scenario: content hash of the scenario.
        max_step: longest step, in the certificate's unit of time.

    Returns:
        The bytes of the file, compressed; the same input gives the same bytes.

    Raises:
        TruthUnavailable: heyoka (Linux only), python-flint or mpmath is not installed.
        EngineFailure: heyoka stops, or was built without that precision.

    """
    bits, exponent = BITS[precision], time_exponent(model, state)
    document = {
        "format": FORMAT,
        "version": VERSION,
        "scenario": scenario,
        "time_exponent": exponent,
        "bits": bits,
        **checked_topology(model),
        **{name: _hexadecimal(x) for name, x in checked_numbers(model, state).items()},
        "times": _hexadecimal(times),
        "steps": _candidate_steps(model, state, float(times[-1]), precision, exponent, max_step),
    }
    return gzip.compress(json.dumps(document, separators=(",", ":")).encode(), mtime=0)


def checked_topology(model: Model) -> dict[str, Any]:
    """Return the integers and names of a certificate.

    Returns:
        The kinds of the joints, their far bodies, and the pairs of bodies of springs.

    """
    return {"kind": [*model.kind], "far": model.body[:, 0].tolist(), "springs": model.spring_body.tolist()}


def checked_numbers(model: Model, state: State) -> dict[str, Array]:
    """Return the numbers of a certificate by the checker's names: the one place that knows both records.

    Returns:
        Arrays of doubles as ``SHAPES`` of `certificate_file` lists them.

    """
    names = ("p", "omega", "u", "udot", "x", "xdot")
    found = {name: getattr(state if name in names else model, name) for name in SHAPES}
    free = model.free
    # u is the place of its centre of mass
    own: dict[str, Any] = {"u": state.r, "udot": state.v, "length": 1.0, "point": 0.0}
    return {
        name: np.where(free.reshape(-1, *[1] * (x.ndim - 1)), own[name], x) if name in own else x
        for name, x in found.items()
    }


def numbers_digest(model: Model, state: State) -> str:
    """Identify what a proof is about: the mechanism and its initial state, whatever they are called.

    Returns:
        The digest that `certificate_digest` gives of certificates with exactly these numbers.

    """
    return _digest(checked_topology(model), checked_numbers(model, state))


def certificate_digest(certificate: Certificate) -> str:
    """Identify what a certificate is about.

    Args:
        certificate: of any motion.

    Returns:
        SHA-256 of its joints, springs and numbers, hexadecimal; not of its duration and candidate motion.

    """
    topology = {"kind": certificate.kind, "far": certificate.far, "springs": certificate.springs}
    return _digest(topology, certificate.data)


def _digest(topology: dict[str, Any], numbers: dict[str, Array]) -> str:
    doubles = {name: _hexadecimal(x + 0.0) for name, x in numbers.items()}  # −0 is 0
    return hashlib.sha256(json.dumps([topology, doubles], sort_keys=True).encode()).hexdigest()


def time_exponent(model: Model, state: State) -> int:
    """Choose the unit of time 2**exponent s, in which the rates of the motion are about 1."""
    levers = np.linalg.norm(model.point[:, 1], axis=1) + model.length
    lever = float(np.min(levers, where=levers > 0, initial=np.inf))
    swing = math.sqrt(float(np.linalg.norm(model.gravity)) / lever)
    rates = (float(np.max(np.abs(x))) for x in (state.omega, state.udot, state.xdot))
    return -round(math.log2(max(*rates, swing, 2.0**-10)))


def _hexadecimal(x: Array) -> Any:
    """Nested lists of hexadecimal texts."""
    return [_hexadecimal(row) for row in x] if np.ndim(x) else float(x).hex()


def _candidate_steps(
    model: Model,
    state: State,
    duration: float,
    precision: CertificatePrecision,
    exponent: int,
    max_step: float,
) -> list[list[Any]]:
    """Steps of a certificate: each starts exactly where the one before ends.

    A Taylor coefficient c_j [1/sʲ] of a step of H seconds becomes the integer nearest to c_j Hʲ 2**bits, of a
    rate times the unit of time.
    """
    mp, bits, checker = import_truth_tool("mpmath"), BITS[precision], load_checker()
    grain = 1 << (bits - LENGTH_BITS)  # lengths are multiples of it
    steps: list[list[Any]] = []
    numbers, flint, working = checked_numbers(model, state), import_truth_tool("flint"), 2 * bits
    certificate = Certificate(
        **checked_topology(model), data=numbers, times=[], time_exponent=exponent, bits=bits, steps=[]
    )
    with mp.workprec(working), flint.ctx.workprec(working):
        mechanism = checker.Mechanism(certificate, flint.arb)
        left = max(1, math.ceil(math.ldexp(duration, LENGTH_BITS - exponent)))  # grains
        generator = taylor_series(model, state, round(ORDER_PER_BIT * bits), precision)
        own = next(generator)
        series = _add_functions(mechanism, own)
        start: list[int] = []
        while True:
            h = min(mp.ldexp(max_step, exponent), *(longest_step(row, bits) for row, _ in series))
            count = min(left, int(mp.ceil(mp.ldexp(h, LENGTH_BITS - exponent))))
            seconds = mp.ldexp(mp.mpf(count), exponent - LENGTH_BITS)
            rows = []
            for i, (taylor, is_rate) in enumerate(series):
                scale = bits + (exponent if is_rate else 0)
                row = [int(mp.nint(mp.ldexp(c * seconds**j, scale))) for j, c in enumerate(taylor)]
                if start:
                    row[0] = start[i]
                rows.append(row)
            steps.append([count * grain, *rows])
            start, left = [sum(row) for row in rows], left - count
            if not left:
                return steps
            values = [
                mp.ldexp(mp.mpf(value), -bits - (exponent if is_rate else 0))
                for value, (_, is_rate) in zip(start, series, strict=True)
            ]
            kept = {*map(id, own)}
            own = generator.send([x for x, row in zip(values, series, strict=True) if id(row) in kept])
            series = _add_functions(mechanism, own)


def _add_functions(mechanism: Any, series: list[Any]) -> list[Any]:
    """Add what makes the equations polynomial: cos x and sin x of turns, and 1/|d| of springs."""
    flint, mp, checker = import_truth_tool("flint"), import_truth_tool("mpmath"), load_checker()
    flint.ctx.cap = len(series[0][0])

    def balls(row: Any) -> Any:
        return flint.arb_series(row[0])

    def numbers(function: Any) -> tuple[list[Any], bool]:
        parts = (function[k].mid().man_exp() for k in range(flint.ctx.cap))
        return [mp.ldexp(int(mantissa), int(exponent)) for mantissa, exponent in parts], False

    rest, found = iter(series), list[Any]()
    for (_, _, _, _, turns), (*sizes, functions) in zip(mechanism.joints, mechanism.sizes[0], strict=True):
        found += islice(rest, sum(sizes))
        for angle in found[len(found) - len(turns) :]:
            found += [numbers(balls(angle).cos()), numbers(balls(angle).sin())]
        found += islice(rest, functions - 2 * len(turns))  # θ² and θ/(6 sin θ)
    rates = [*rest]
    if mechanism.springs:
        q, v = ([balls(row) for row in part] for part in (found, rates))
        motion = checker.Motion(mechanism, [*q, *q[:1] * len(mechanism.springs), *v], v)
        found += [numbers((d @ d).rsqrt()) for d in motion.spans(0)]
    return found + rates


def longest_step(taylor: list[Any], bits: int) -> Any:
    """The step [s] at which the last two terms of a Taylor series are 2**-(bits + 3)."""
    mp, last = import_truth_tool("mpmath"), len(taylor) - 1
    terms = ((k, abs(taylor[k])) for k in (last, last - 1))
    return min((mp.root(mp.ldexp(1 / c, -bits - 3), k) for k, c in terms if c), default=mp.inf)


MAX_BYTES = 50 * 2**20  # of all stored motions; one of 10 bodies and 41 samples takes 50 kB


@dataclass(frozen=True, eq=False)
class ProvedMotion:
    """The midpoints of an enclosure, rounded to double, and bounds of their error that hold for certain."""

    trajectory: Trajectory
    # by the names of `MOTION_UNITS` (T,) in its unit, largest of any body up to each time, with the rounding
    # to double
    radius: Mapping[str, Array]
    enclosure_radius: float  # m, largest of the enclosure's positions, without the rounding to double

    @property
    def method(self) -> str:
        """How the motion was found, in words."""
        return (
            f"proved: enclosed in ball arithmetic within {self.enclosure_radius:.2g} m; "
            "uncertainty: the rounding of the midpoints to double"
        )


def round_enclosure(enclosure: Enclosure) -> ProvedMotion:
    """Round an enclosure to doubles.

    Returns:
        The motion with its error bounds.

    """
    balls = [getattr(enclosure, name) for name in ("r", "p", "v", "omega")]
    r, p, v, omega = (np.frompyfunc(lambda x: float(x.mid()), 1, 1)(y).astype(float) for y in balls)
    run = Trajectory(np.array(enclosure.times), r, p, v, quaternion_rate(p, omega), 0)
    radius = {
        name: np.maximum.accumulate(_distance(of_name, rounded))
        for (name, rounded), of_name in zip(motion_samples(run).items(), balls, strict=True)
    }
    # unit quaternions at a distance d differ by a rotation of 4 asin(d / 2), others by 2 asin(d)
    radius["attitude"] = 2.1 * radius["attitude"]
    return ProvedMotion(run, radius, enclosure.radius("r"))


def _distance(balls: Array, rounded: Array) -> Array:
    """(T,) largest distance of any body's vector from its balls (T, N, …)."""
    arb = import_truth_tool("flint").arb
    distance = np.frompyfunc(lambda ball, x: float(abs(ball - arb(x)).upper()), 2, 1)(balls, rounded)
    up = 1 + 1e-12  # for the roundings here
    return np.asarray(np.max(np.linalg.norm(distance.astype(float), axis=-1), axis=-1) * up)


def store_proof(model: Model, state: State, times: Array, proof: ProvedMotion) -> str:
    """Keep a proved motion for later runs.

    Args:
        model: the mechanism that it is proved for.
        times: (T,) [s] of the samples.

    Returns:
        Why it is not kept; empty where it is.

    """
    files = _files()
    try:
        files.write(_name(model, state, times), encode_record(proof))
    except OSError as error:
        return f"the proved motion is not kept for later runs: {describe_failure(error, files.folder)}"
    files.trim(MAX_BYTES)
    return ""


def find_proof(model: Model, state: State, times: Array) -> ProvedMotion | None:
    """Read the proved motion of a model, if there is one by the present checker.

    Args:
        times: (T,) [s] of the samples.

    Returns:
        The motion; None where there is none, or none that can be read; motions of loops are not proved.

    """
    if model.has_loops:
        return None
    proof: ProvedMotion | None = None
    with contextlib.suppress(OSError, DamagedFile, UnfitRecord):
        if body := _files().read(_name(model, state, times)):
            proof = decode_record(body, ProvedMotion)
    return proof


def _files() -> CheckedFiles:
    return CheckedFiles(user_cache_folder() / "proofs")


def _name(model: Model, state: State, times: Array) -> str:
    """The content that a proof depends on: the numbers, the times, the checker and this file."""
    numbers: dict[str, Any] = checked_numbers(model, state) | {"times": times}
    arrays = [np.ascontiguousarray(x, dtype=float).tobytes() for x in numbers.values()]
    code = [
        Path(__file__).with_name(name).read_bytes()
        for name in ("certificate_checker.py", "certificate_file.py", Path(__file__).name)
    ]
    return f"{content_key(*code, repr(checked_topology(model)), *arrays)}.proof"
