"""Errors between two runs and invariants of one: energy, momentum, joint gaps, quaternion norms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial.legendre import legder, leggauss, legvander
from numpy.typing import NDArray

from plumbline.model.datatypes import ZERO_INERTIA, Array, Float, Model, State, Trajectory
from plumbline.model.kinematics import (
    angular_velocity,
    ball_spring_turn,
    coordinates_of_joints,
    cross,
    joint_vector_rates,
    joint_vectors,
    joints_with_elements,
    nearest_turn,
    quaternion_exponential,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
    spring_vector_rates,
    spring_vectors,
)

WINDOWS = 2, 4, 6, 8  # samples that the motion between two samples is interpolated from
RESOLVED_FALL = 4.0  # of the differences of two widths: polynomials converge
WINDOW_ROUNDING = 1600 * 2.0**-52  # of a polynomial through eight samples: the condition of its equations
GAUSS_NODES = 5
DEPARTURE = 1e-3  # m, beyond which a run has left the true motion


def position_error(a: Float[Array, "... bodies 3"], b: Float[Array, "... bodies 3"]) -> Float[Array, "..."]:
    """Return the largest distance between the same body's centre of mass in two runs.

    Args:
        a: positions [m].
        b: positions [m].

    Returns:
        Distances, the largest over the bodies [m].

    """
    return np.asarray(np.max(np.linalg.norm(a - b, axis=-1), axis=-1))


def motion_samples(run: Trajectory) -> dict[str, Array]:
    """Return what is compared of a motion, by the names of `MOTION_UNITS`.

    Returns:
        r (T, N, 3), p (T, N, 4), ṙ (T, N, 3) in the world frame and ω′ (T, N, 3) in the body frame.

    """
    omega = angular_velocity(run.p, run.pdot)
    return {"position": run.r, "attitude": run.p, "velocity": run.v, "angular_velocity": omega}


def motion_error(
    quantity: str, a: Float[Array, "... bodies _"], b: Float[Array, "... bodies _"]
) -> Float[Array, "..."]:
    """Return the largest difference of any body between two motions.

    Args:
        quantity: a name of `MOTION_UNITS`.
        a: samples of the first.
        b: samples of the second.

    Returns:
        Differences in the quantity's unit.

    """
    return attitude_error(a, b) if quantity == "attitude" else position_error(a, b)


def motion_errors(a: Trajectory, b: Trajectory) -> dict[str, Array]:
    """Return the largest difference of any body between two motions, up to each time.

    Returns:
        (T,) running maxima for each name of `MOTION_UNITS`, in its unit.

    """
    pairs, others = motion_samples(a), motion_samples(b)
    return {q: np.maximum.accumulate(motion_error(q, y, others[q])) for q, y in pairs.items()}


def motion_scales(model: Model, run: Trajectory, length: float) -> dict[str, float]:
    """Return the scales of rounding in a motion.

    Args:
        length: the length of the stretched mechanism [m].

    Returns:
        A scale for each name of `MOTION_UNITS`, in its unit.

    """
    speed = invariant_scales(model, run, length)["gap_rate"]
    return {"position": length, "attitude": 2.0, "velocity": speed, "angular_velocity": 2 * speed / length}


def first_departure(
    t: Float[Array, "samples"], error: Float[Array, "samples"], radius: float | Float[Array, "samples"]
) -> float | None:
    """Find when a run has provably left the true motion.

    Args:
        t: [s] sample times, ascending.
        error: [m] `position_error` of the run and the midpoints of an enclosure.
        radius: [m] of the enclosure, or of each sample.

    Returns:
        The first sample [s] at which the error less the radius is above `DEPARTURE`, or the error is not a
        number; None where there is none.

    """
    rounding = 1e-12  # relative, of the error: a few differences, squares and a root
    left = np.flatnonzero(~(error * (1 - rounding) - radius <= DEPARTURE))
    return float(t[left[0]]) if len(left) else None


def attitude_error(p: Float[Array, "... bodies 4"], q: Float[Array, "... bodies 4"]) -> Float[Array, "..."]:
    """Return the largest rotation angle between the same body's attitudes in two runs; q equals −q.

    Args:
        p: quaternions of the first run, normalised here.
        q: quaternions of the second run, normalised here.

    Returns:
        Angles, the largest over the bodies [rad].

    """
    p = p / np.linalg.norm(p, axis=-1, keepdims=True)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    sign = np.where(np.sum(p * q, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    # 4 asin(|p - q| / 2), exact for all angles and, unlike acos(p·q), accurate for small ones
    return np.asarray(np.max(4 * np.arcsin(np.linalg.norm(p - sign * q, axis=-1) / 2), axis=-1))


def kinetic_energy(
    model: Model, v: Float[Array, "... bodies 3"], omega: Float[Array, "... bodies 3"]
) -> Float[Array, "..."]:
    """Return Σ ½ m ṙ² + ½ ω′ᵀ J ω′.

    Args:
        model: the chain of N bodies.
        v: velocities of the centres of mass, world frame [m/s].
        omega: angular velocities, body frame [rad/s].

    Returns:
        Energies [J].

    """
    spin = np.einsum("...ki,kij,...kj->...", omega, model.inertia, omega)
    return np.asarray(0.5 * np.einsum("k,...ki,...ki->...", model.mass, v, v) + 0.5 * spin)


def potential_energy(model: Model, r: Float[Array, "... bodies 3"]) -> Float[Array, "..."]:
    """Return −Σ m g·r, which is zero at the pivot's height.

    Args:
        model: the chain of N bodies.
        r: centres of mass, world frame [m].

    Returns:
        Energies [J].

    """
    return np.asarray(-np.einsum("k,i,...ki->...", model.mass, model.gravity, r))


def angular_momentum(
    model: Model,
    r: Float[Array, "... bodies 3"],
    p: Float[Array, "... bodies 4"],
    v: Float[Array, "... bodies 3"],
    omega: Float[Array, "... bodies 3"],
) -> Float[Array, "... 3"]:
    """Return Σ m r × ṙ + A J ω′, the angular momentum about the pivot.

    Args:
        model: the chain of N bodies.
        r: centres of mass, world frame [m].
        p: quaternions, normalised here.
        v: velocities of the centres of mass, world frame [m/s].
        omega: angular velocities, body frame [rad/s].

    Returns:
        Angular momenta, world frame [kg m²/s].

    """
    spin = np.einsum("...kij,kjl,...kl->...i", rotation_matrix(p), model.inertia, omega)
    return np.asarray(np.einsum("k,...ki->...i", model.mass, cross(r, v)) + spin)


@dataclass(frozen=True, eq=False)
class Invariants:
    """Signed series (T, bodies or 1, components) of one run; each is zero in an exact motion."""

    energy_drift: Float[Array, "samples 1 1"]  # J: E - E(0) - W, W the work of loads and drag
    # kg m²/s: change of the angular momentum about the pivot along gravity; None if not conserved
    momentum_drift: Float[Array, "samples 1 1"] | None
    joint_gap: Float[Array, "samples joints 3"]  # m: d of a ball joint; (|d| - ℓ, 0, 0) of a rod
    gap_rate: Float[Array, "samples joints 3"]  # m/s: its rate
    norm_drift: Float[Array, "samples bodies 1"]  # |p| - 1
    # by invariant, in its unit: of W by quadrature over the samples, and of a limit of softer runs
    uncertainty: dict[str, float]


MOTION_UNITS = {"position": "m", "attitude": "rad", "velocity": "m/s", "angular_velocity": "rad/s"}
LIMITS = {f"{name}_limit": name for name in MOTION_UNITS}  # by a row's quantity, what it is the limit of
INVARIANT_UNITS = {
    "energy_drift": "J",
    "momentum_drift": "kg m²/s",
    "joint_gap": "m",
    "gap_rate": "m/s",
    "norm_drift": "1",
}
# what `Invariants.uncertainty` is of, in words
UNCERTAIN = "the work by quadrature, or the limit of softer runs"
ALL_LONG = "all_long"  # quantity of long runs that were refused or failed
LONG_RUN_QUANTITIES = frozenset(
    {ALL_LONG, "energy_drift_long_growth", *(f"{name}_long" for name in INVARIANT_UNITS)}
)


def work_of_loads(
    model: Model, run: Trajectory, omega: Float[Array, "samples bodies 3"]
) -> tuple[Float[Array, "samples"], float]:
    """Return the work of loads, drag, dampers and efforts since t = 0, and how uncertain its quadrature is.

    Constant world forces do the work F·Δr exactly.  Other power is integrated by Gauss's rule over the motion
    between samples, a polynomial through positions and rates of eight samples around each interval.

    Where the polynomials converge, their differences from four samples to six to eight fall by
    `RESOLVED_FALL` or more; the rest is then at most a third of the last one, and both are the uncertainty.

    Else the samples are too far apart, however many a polynomial passes through: of a motion that is analytic
    up to a distance d from real time, samples h apart leave an error of about C exp(−2πd/h), with C the work
    between two samples, and samples 2h apart leave e = C exp(−πd/h).  With every second sample left out the
    difference shows e; e²/C and all differences are the uncertainty.

    Args:
        omega: angular velocities of the run, body frame [rad/s].

    Returns:
        Work [J], and its uncertainty [J].

    """
    exact = np.einsum("ki,tki->t", model.force, run.r - run.r[0])
    if not np.any(_power(model, run, omega)) or len(run.t) < 2:
        return exact, 0.0
    work = np.array([_integrated_power(model, run, width) for width in WINDOWS])
    steps = np.diff(work)
    missing = np.sum(np.abs(np.diff(steps, axis=0)), axis=1)
    is_many = len(run.t) >= WINDOWS[-1]
    rounding = WINDOW_ROUNDING * float(np.sum(np.abs(steps[-1])))
    if is_many and missing[-1] <= max(missing[-2] / RESOLVED_FALL, rounding):
        return exact + work[-1], float(missing[-2] + missing[-1])
    apart, last = 0.0, len(run.t) - 1
    for first in (1, 2):
        kept = np.unique([0, *range(first, last, 2), last])
        half = run.at(kept)
        sparse = _integrated_power(model, half, WINDOWS[-1])
        apart = max(apart, float(np.max(np.abs(sparse - work[-1, kept]))))
    between = float(np.max(np.abs(steps[-1])))
    share = apart / between if is_many and between else 1.0
    return exact + work[-1], float(np.sum(missing) + share * apart)


def _power(model: Model, run: Trajectory, omega: Array) -> Array:
    """Power (T,) [W] of all that is not a constant force in the world."""
    power = (
        np.einsum("ki,tki->t", model.moment, omega)
        - np.einsum("k,tki,tki->t", model.drag_force, run.v, run.v)
        - np.einsum("k,tki,tki->t", model.drag_moment, omega, omega)
    )
    return np.asarray(power + element_energies(model, run, omega).power)


def _integrated_power(model: Model, run: Trajectory, width: int) -> Array:
    """Integral (T,) [J] of the power, over a motion that is known from ``width`` samples around."""
    _, weights = leggauss(GAUSS_NODES)
    half = np.diff(run.t)[:, None] / 2
    # p and −p are the same attitude: the one that the rates lead to
    omega = angular_velocity(run.p, run.pdot)
    turn = half[..., None] * (omega[1:] + omega[:-1]) / 2
    ahead = quaternion_product(run.p[:-1], quaternion_exponential(turn))
    sign = np.where(np.sum(ahead * run.p[1:], axis=-1, keepdims=True) < 0, -1.0, 1.0)
    sign = np.cumprod(np.concatenate([np.ones_like(sign[:1]), sign]), axis=0)
    place, motion = (np.concatenate([a, sign * b], -1) for a, b in ((run.r, run.p), (run.v, run.pdot)))
    times, window, *matrices = _interpolation(run.t.tobytes(), width)
    known = np.concatenate([x.reshape(len(run.t), -1)[window] for x in (place, motion)], axis=1)
    y, rate = ((part @ known).reshape(-1, *place.shape[1:]) for part in matrices)
    dense = Trajectory(times, y[..., :3], y[..., 3:], rate[..., :3], rate[..., 3:], run.steps, run.initial_x)
    power = _power(model, dense, angular_velocity(dense.p, dense.pdot)).reshape(half.size, -1)
    return np.concatenate([[0.0], np.cumsum(half[:, 0] * (power @ weights))])


@lru_cache(maxsize=32)  # the runs of a study have the same samples, and those of all engines
def _interpolation(samples: bytes, width: int) -> tuple[Array, NDArray[np.intp], Array, Array]:
    """Interpolate by polynomials through values and rates of samples.

    Args:
        samples: times [s] of T ≥ 2 samples.
        width: how many samples around an interval its polynomial passes through, all where there are fewer.

    Returns:
        Times of Gauss's nodes of all intervals, the samples (T − 1, width) of each, and the matrices that
        take their values and rates to values, and to rates, at its nodes.

    """
    times = np.frombuffer(samples)
    half, (nodes, _) = np.diff(times)[:, None] / 2, leggauss(GAUSS_NODES)
    at = times[:-1, None] + half + half * nodes
    count, width = len(times) - 1, min(width, len(times))
    first = np.clip(np.arange(count) - (width - 2) // 2, 0, len(times) - width)
    window = first[:, None] + np.arange(width)
    middle, scale = times[window].mean(axis=1)[:, None], np.ptp(times[window], axis=1)[:, None] / 2
    derivative = np.zeros((2 * width, 2 * width))
    derivative[:-1] = legder(np.eye(2 * width), axis=0)  # of the coefficients

    def basis(t: Array) -> tuple[Array, Array]:
        values = legvander((t - middle) / scale, 2 * width - 1)
        return values, values @ derivative / scale[..., None]

    equations, found = np.concatenate(basis(times[window]), axis=1), list[Array]()
    for wanted in basis(at):
        matrix = np.zeros_like(wanted)
        for _ in range(2):  # refined once
            missing = (wanted - matrix @ equations).swapaxes(-1, -2)
            matrix += np.linalg.solve(equations.swapaxes(-1, -2), missing).swapaxes(-1, -2)
        found.append(matrix)
    return at.ravel(), window, found[0], found[1]


def compute_invariants(model: Model, run: Trajectory) -> Invariants:
    """Compute the invariants of one run; its quaternions are not normalised before |p| is read.

    Args:
        model: the chain of N bodies.

    Returns:
        The series; ``momentum_drift`` is None with loads, drag or without gravity, and where a joint at the
        world has a moment about the vertical through the origin.

    """
    omega = angular_velocity(run.p, run.pdot)
    energy = kinetic_energy(model, run.v, omega) + potential_energy(model, run.r)
    elements = element_energies(model, run, omega)
    energy = energy + elements.rotors + elements.springs
    done, of_work = work_of_loads(model, run, omega)
    gravity = np.linalg.norm(model.gravity)
    momentum = None
    is_bare = not (model.has_loads or model.has_drag or model.has_elements)
    if gravity > 0 and is_bare and _turns_freely_about_gravity(model):
        about = angular_momentum(model, run.r, run.p, run.v, omega) @ (model.gravity / gravity)
        momentum = (about - about[0])[:, None, None]
    d = joint_vectors(model, run.r, run.p)
    ddot = joint_vector_rates(model, run.p, run.v, omega)
    distance = np.linalg.norm(d, axis=-1)
    stretch = np.zeros_like(d)
    stretch[..., 0] = distance - model.length
    stretching = np.zeros_like(d)
    stretching[..., 0] = np.sum(d * ddot, axis=-1) / np.where(distance > 0, distance, 1.0)
    rods = model.rods[:, None]
    d, ddot = _across_slides(model, run.p, omega, d, ddot)
    series = {
        "energy_drift": (energy - energy[0] - done)[:, None, None],
        "momentum_drift": momentum,
        "joint_gap": np.where(rods, stretch, d),
        "gap_rate": np.where(rods, stretching, ddot),
        "norm_drift": np.linalg.norm(run.p, axis=-1, keepdims=True) - 1,
    }
    uncertainty = dict.fromkeys(series, 0.0) | {"energy_drift": of_work}
    if run.softer is not None:
        other = compute_invariants(model, run.softer)
        for name, found in series.items():
            if found is not None:
                uncertainty[name] += float(np.max(np.linalg.norm(found - getattr(other, name), axis=-1)))
    return Invariants(**series, uncertainty=uncertainty)


@dataclass(frozen=True, eq=False)
class ElementEnergies:
    """What rotors, springs, dampers and efforts hold and do along a run of T samples; zeros without any."""

    rotors: Float[Array, "samples"]  # J
    springs: Float[Array, "samples"]  # J
    power: Float[Array, "samples"]  # W: of efforts, less what dampers take


def element_energies(
    model: Model, run: Trajectory, omega: Float[Array, "samples bodies 3"]
) -> ElementEnergies:
    """Compute the energies of passive elements and the power of efforts and dampers.

    Angles start near the run's ``initial_x``, and their rates choose their turn at each further sample.

    Args:
        omega: angular velocities of the run, body frame [rad/s].

    """
    rotors, springs, power = np.zeros((3, len(run.t)))
    if not model.has_elements:
        return ElementEnergies(rotors, springs, power)
    state = State(run.p, omega, r=run.r, v=run.v)
    spin = rotate_vectors(rotation_matrix(run.p), omega)
    joints = np.flatnonzero(joints_with_elements(model)).tolist()
    *_, coordinates, rates = coordinates_of_joints(model, state, joints)
    for at, k in enumerate(joints):
        far, near = model.body[k]
        if model.kinds[k].is_spherical:
            _, turn = ball_spring_turn(model, k, run.p)
            pairs = [(turn, spin[:, near] - (spin[:, far] if far >= 0 else 0.0))]
        else:
            pairs = []
            for i, (what, _) in enumerate(model.kinds[k].motions):
                x, rate = coordinates[:, at, i], rates[:, at, i]
                if what == "turn":
                    known = run.initial_x
                    start = x[0] if known is None or k >= model.n else known[k, i]
                    x = _unwrapped(x, rate, run.t, start)
                pairs.append(((x - model.rest[k, i])[:, None], rate[:, None]))
        for i, (stretch, rate) in enumerate(pairs):
            squares = np.sum(rate**2, axis=-1)
            rotors += model.armature[k, i] * squares / 2
            springs += model.stiffness[k, i] * np.sum(stretch**2, axis=-1) / 2
            power += model.effort[k, i] * rate[:, 0] - model.damping[k, i] * squares
    d, d_rate = spring_vectors(model, run.r, run.p), spring_vector_rates(model, run.p, run.v, omega)
    length = np.linalg.norm(d, axis=-1)
    change = _dot(d, d_rate) / np.where(length > 0, length, 1.0)
    springs += ((length - model.spring_length) ** 2) @ model.spring_stiffness / 2
    return ElementEnergies(rotors, springs, power - change**2 @ model.spring_damping)


def _unwrapped(angle: Array, rate: Array, times: Array, start: float) -> Array:
    """Add full turns to an angle (T,): near ``start`` at first, then near what its rate makes of it."""
    change = np.diff(times) * (rate[1:] + rate[:-1]) / 2
    turns = np.round(np.concatenate([[start - angle[0]], change - np.diff(angle)]) / (2 * np.pi))
    return np.asarray(angle + 2 * np.pi * np.cumsum(turns))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))


def _across_slides(model: Model, p: Array, omega: Array, d: Array, ddot: Array) -> tuple[Array, Array]:
    """Return d and ḋ (T, N, 3) without their part along slides, and 0 of free bodies."""
    d, ddot = d.copy(), ddot.copy()
    for k, (kind, far) in enumerate(zip(model.kinds, model.body[:, 0], strict=True)):
        if kind.holds_nothing:
            d[:, k] = ddot[:, k] = 0.0
        if not (kind.slide_axes or kind.has_pitch):
            continue
        axes, spin = rotation_matrix(model.turn[k, 0]) * np.ones((len(d), 1, 1)), np.zeros_like(d[:, k])
        if far >= 0:
            above = rotation_matrix(p[:, far])
            axes, spin = above @ axes, rotate_vectors(above, omega[:, far])
        ddot[:, k] -= cross(spin, d[:, k])
        if kind.has_pitch:
            near, pitch = int(model.body[k, 1]), model.length[k]
            own = rotation_matrix(p[:, near]) @ rotation_matrix(model.turn[k, 1])
            relative = axes.swapaxes(-1, -2) @ own
            turning = rotate_vectors(rotation_matrix(p[:, near]), omega[:, near]) - spin
            z, angle = axes[..., 2], np.arctan2(relative[:, 1, 0], relative[:, 0, 0])
            angle = nearest_turn(angle, _dot(z, d[:, k]), pitch)
            d[:, k] -= pitch * angle[:, None] * z
            ddot[:, k] -= pitch * _dot(z, turning)[:, None] * z
        for axis in (axes[..., i] for i in kind.slide_axes):
            for y in (d, ddot):
                y[:, k] -= axis * np.sum(axis * y[:, k], axis=-1, keepdims=True)
    return d, ddot


def _turns_freely_about_gravity(model: Model) -> bool:
    """Whether no joint at the world has a moment about the axis along gravity through the origin."""
    along = model.gravity / np.linalg.norm(model.gravity)
    for k in np.flatnonzero(model.body[:, 0] < 0):
        kind, at = model.kinds[k], model.point[k, 0]
        if kind.holds_nothing:
            continue
        axis = rotation_matrix(model.turn[k, 0])[:, 2]
        turns = kind.holds_no_turn or (kind.turn_axes == (2,) and np.linalg.norm(cross(axis, along)) < 1e-14)
        if not turns or np.linalg.norm(cross(at, along)) > 1e-14 * np.linalg.norm(at):
            return False
    return True


def invariant_scales(model: Model, run: Trajectory, length: float) -> dict[str, float]:
    """Return the size of the quantities that each invariant is a difference of.

    A pendulum at rest rounds too: speeds count at least as that of a fall through ``length``.

    Args:
        model: the chain of N bodies.
        length: the length of the stretched chain [m].

    Returns:
        A scale for each name of INVARIANT_UNITS, in its unit.

    """
    omega = angular_velocity(run.p, run.pdot)
    kinetic = float(np.max(kinetic_energy(model, run.v, omega)))
    potential = float(np.max(np.sum(model.mass * np.abs(run.r @ model.gravity), axis=-1)))
    elements = element_energies(model, run, omega)
    kinetic += float(np.max(elements.rotors))
    potential = max(potential, float(np.max(elements.springs)))
    swing = float(np.ptp(potential_energy(model, run.r)))
    fall = float(np.sqrt(np.linalg.norm(model.gravity) * length))
    speed = max(fall, float(np.max(np.linalg.norm(run.v, axis=-1))))
    spin = max(fall / length, float(np.max(np.linalg.norm(omega, axis=-1))))
    arm = float(np.max(np.linalg.norm(run.r, axis=-1)))
    inertia = float(np.sum(np.linalg.norm(model.inertia, axis=(1, 2))))
    return {
        "energy_drift": max(kinetic, potential, swing),
        "momentum_drift": float(np.sum(model.mass)) * arm * speed + inertia * spin,
        "joint_gap": max(length, arm),
        "gap_rate": max(speed, spin * length),
        "norm_drift": 1.0,
    }


def inertia_ratio(model: Model) -> float:
    """Return how strongly inertias differ along a chain, which algorithms that pass them inward feel.

    Returns:
        The largest, over the bodies, of (M |c − s|² + J_max) / J_min: M the mass of the bodies beyond, c − s
        the arm from its proximal to its distal point, J_max and J_min its extreme principal inertias; of
        bodies with inertia about every axis.

    """
    model = model.tree
    beyond = np.cumsum(model.mass[::-1])[::-1] - model.mass
    arm = np.linalg.norm(model.distal - model.proximal, axis=1)
    principal = np.linalg.eigvalsh(model.inertia)
    has_all = principal[:, 0] > ZERO_INERTIA * principal[:, 2]
    ratios = (beyond * arm**2 + principal[:, -1])[has_all] / principal[has_all, 0]
    return float(np.max(ratios, initial=1.0))
