"""Proved motions as doubles with a radius, kept in the user's cache by what they are proved for."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from plumbline.truth import import_truth_tool
from plumbline.truth.certificate_proof import checked_numbers, checked_topology

if TYPE_CHECKING:
    from plumbline.truth.certificate_checker import Enclosure

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
        for name in (
            "certificate_checker.py",
            "certificate_file.py",
            "compressed_json.py",
            Path(__file__).name,
        )
    ]
    return f"{content_key(*code, repr(checked_topology(model)), *arrays)}.proof"
