"""The truth of what engines report besides the state quantities: formulas on the certified motion.

A quantity is an entry of `SURFACE_QUANTITIES`: its unit and a formula on `Motion`.  The formulas are written
in `Rounded` vectors, which carry with each value a bound of what an engine's rounding can change:

    error    of the inputs, propagated to first order: r, v, attitudes and ω by `RoundingBound.kinematics`,
             r̈ and ω̇ by their own tolerances, forces by theirs
    size     the sum of the magnitudes of the terms, each of which is rounded: 64 ε of it are tolerated
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from plumbline.model.datatypes import Array, Float, Model, State, StateQuantities
from plumbline.model.kinematics import (
    bodies_beyond,
    cross,
    minimal_rates,
    rotate_vectors,
    rotation_matrix,
    velocity_jacobian,
)
from plumbline.model.probe_frames import PROBE_TURN, anchor_point, probe_points
from plumbline.truth.rounding_bound import EPS, ROUNDING_FACTOR, RoundingBound


class Rounded(NamedTuple):
    """Vectors with the first-order bounds of their errors."""

    value: Float[Array, "... d"]
    error: Float[Array, "..."]
    size: Float[Array, "..."]

    def plus(self, other: Rounded, sign: float = 1.0) -> Rounded:
        """Add other vectors, or subtract them."""
        return Rounded(self.value + sign * other.value, self.error + other.error, self.size + other.size)

    def minus(self, other: Rounded) -> Rounded:
        """Subtract other vectors."""
        return self.plus(other, -1.0)

    def times(self, factor: Float[Array, "..."]) -> Rounded:
        """Multiply by exact factors, one per vector."""
        size = np.abs(factor)
        return Rounded(factor[..., None] * self.value, size * self.error, size * self.size)

    def cross(self, other: Rounded) -> Rounded:
        """Multiply by other vectors."""
        a, b = np.linalg.norm(self.value, axis=-1), np.linalg.norm(other.value, axis=-1)
        return Rounded(
            cross(self.value, other.value), a * other.error + b * self.error, self.size * other.size
        )

    def mapped(self, matrix: Float[Array, "... 3 3"], norm: Array, error: Array) -> Rounded:
        """Multiply by matrices of a norm, that are off by an error."""
        length = np.linalg.norm(self.value, axis=-1)
        value = rotate_vectors(matrix, self.value)
        return Rounded(value, norm * self.error + error * length, norm * self.size)

    def summed(self, weights: Float[Array, "sums bodies"]) -> Rounded:
        """Add up with weights: (N, 3) → (sums, 3)."""
        return Rounded(weights @ self.value, weights @ self.error, weights @ self.size)

    @property
    def tolerance(self) -> Array:
        """What an engine may be off by."""
        return np.asarray(self.error + ROUNDING_FACTOR * EPS * self.size)


class Motion:
    """The certified motion of all bodies and of their probe frames, in the world frame."""

    def __init__(self, model: Model, state: State, quantities: StateQuantities, bound: RoundingBound) -> None:
        """Take the motion from the state and its certified accelerations."""
        of_r, of_v, self.of_turn, of_w = bound.kinematics
        norm, self.model, self.state = np.linalg.norm, model, state
        A = self.attitude = rotation_matrix(state.p)
        self.mass, self.inertia = model.mass, np.asarray(model.inertia)
        self.inertia_norm = norm(self.inertia, axis=(1, 2))
        self.exact = self.spin_roundings = np.zeros(model.n)
        spin = rotate_vectors(A, state.omega)
        scale = bound.scale

        def given(value: Array, error: Array, size: Array) -> Rounded:
            return Rounded(value, error, np.maximum(size, norm(value, axis=-1)))

        roundings = ROUNDING_FACTOR * EPS
        self.r, self.v = given(state.r, of_r, of_r / roundings), given(state.v, of_v, of_v / roundings)
        self.w = given(spin, of_w, of_w / roundings)
        self.a = given(quantities.acceleration, bound.acceleration, np.asarray(scale["acceleration"]))
        turning, of_turning = bound.angular_acceleration, np.asarray(scale["angular_acceleration"])
        self.alpha = given(rotate_vectors(A, quantities.angular_acceleration), turning, of_turning)
        gravity = np.broadcast_to(model.gravity, (model.n, 3))
        self.gravity = given(gravity, self.exact, self.exact)
        points = probe_points(model)
        length = norm(points, axis=-1)
        self.arm = given(rotate_vectors(A, points), self.of_turn * length, length)
        proximal = model.proximal[: model.n]
        near = norm(proximal, axis=-1)
        self.near = given(rotate_vectors(A, proximal), self.of_turn * near, near)
        whole = ([quantities.potential_energy], bound.potential_energy, scale["potential_energy"])
        self.potential_energy = Rounded(np.array([whole[0]]), *(np.array([x], float) for x in whole[1:]))
        none, names = np.zeros((model.n, 3)), ("joint_reaction", "joint_moment")
        if quantities.mass_matrix is not None:  # of mechanisms without loops
            values = (getattr(quantities, name) for name in names)
            self.force, self.moment = (
                given(
                    none if value is None else value,
                    np.asarray(getattr(bound, name)),
                    np.asarray(scale[name]),
                )
                for name, value in zip(names, values, strict=True)
            )
            self.mass_matrix, self.mass_matrix_error = quantities.mass_matrix, bound.mass_matrix
        self.axes = A @ PROBE_TURN  # of the probe frames
        self.point = self.r.plus(self.arm)
        self.below = bodies_beyond(model).astype(float)
        self.velocity = self.v._replace(size=self.v.size + self._moved_velocities())
        self.point_velocity = self.velocity.plus(self.w.cross(self.arm))
        self.swing = swing = self.alpha.cross(self.arm).plus(self.w.cross(self.w.cross(self.arm)))
        self.point_acceleration = self.a.plus(swing)

    def _moved_velocities(self) -> Float[Array, "bodies"]:
        """Size of what cancels [m/s] where velocities are added up at the centre of mass of the tree."""
        far, place, spin = self.model.body[: self.model.n, 0], self.r.value, self.w.value
        path = self.below.T
        first = np.argmax(path, axis=1)  # of the tree: bodies come after those that carry them
        weights = self.below[first] * self.mass
        centre = weights @ place / np.sum(weights, axis=1, keepdims=True)
        relative = spin - np.where(far[:, None] >= 0, spin[far], 0.0)
        arms = (np.linalg.norm(x - centre, axis=1) for x in (place + self.near.value, place))
        of_joints, of_bodies = (
            np.linalg.norm(w, axis=1) * arm for w, arm in zip((relative, spin), arms, strict=True)
        )
        return np.asarray(path @ of_joints + of_bodies)

    def local(self, vectors: Rounded) -> Rounded:
        """Vectors in the axes of the probe frames."""
        return vectors.mapped(self.axes.mT, np.ones(self.model.n), self.of_turn)

    def centre(self, vectors: Rounded) -> Rounded:
        """Mean of all bodies by mass, (1, 3)."""
        return vectors.summed(self.mass[None] / np.sum(self.mass))

    def spin_momentum(self) -> Rounded:
        """A J ω′ of each body."""
        return self._of_inertia(self.w)

    def spin_momentum_rate(self) -> Rounded:
        """A (J ω̇′ + ω′ × J ω′) of each body."""
        rate = self._of_inertia(self.alpha).plus(self.w.cross(self.spin_momentum()))
        return rate._replace(size=rate.size + self.spin_roundings)

    def through_origin(self) -> Motion:
        """The same for algorithms by spatial vectors at the world's origin, whose terms cancel."""
        other, far = copy(self), np.linalg.norm(self.r.value, axis=-1)
        swing = far * (self.w.size**2 + np.linalg.norm(self.alpha.value, axis=-1))
        other.a = self.a._replace(size=self.a.size + swing)
        other.spin_roundings = self.mass * far * swing
        return other

    def _of_inertia(self, vectors: Rounded) -> Rounded:
        turned = self.attitude @ self.inertia @ self.attitude.mT
        return vectors.mapped(turned, self.inertia_norm, 2 * self.of_turn * self.inertia_norm)

    def generalized(self, force: Rounded, moment: Rounded | None) -> Rounded:
        """Forces at the centres and moments of all bodies as forces on ν, (nu, 1)."""
        jacobian = velocity_jacobian(self.model, self.state).reshape(self.model.n, 6, -1)
        maps = [(jacobian[:, :3], force, self.r.error)]
        if moment is not None:
            maps.append((self.attitude @ jacobian[:, 3:], moment, self.exact))
        found = list[Rounded]()
        for columns, given, off in maps:  # arms are off by as much as positions, axes by as much as attitudes
            norm, length = np.linalg.norm(columns, axis=1), np.linalg.norm(given.value, axis=-1)
            error = norm.T @ (given.error + self.of_turn * length) + np.sum(off * length)
            found.append(
                Rounded(np.einsum("kij,ki->j", columns, given.value)[:, None], error, norm.T @ given.size)
            )
        return found[0].plus(found[1]) if moment is not None else found[0]


def _exactly(numbers: Array) -> Rounded:
    """Vectors of one component, without errors."""
    return Rounded(numbers[:, None], np.zeros(len(numbers)), np.abs(numbers))


def _of_first(vectors: Rounded) -> Rounded:
    """The first body's vector for every body."""
    return Rounded(*(np.broadcast_to(x[:1], x.shape) for x in vectors))


def _about_centre(motion: Motion, weights: Array, moving: Rounded, spin: Rounded) -> Rounded:
    """Σ (r − c) × moving + spin with the weights (sums, N) of bodies, about their centre of mass c."""
    found = list[Rounded]()
    for row in weights:
        share = np.repeat((row * motion.mass / np.sum(row * motion.mass))[None], motion.model.n, axis=0)
        arm = motion.r.minus(motion.r.summed(share))
        found.append(arm.cross(moving).plus(spin).summed(row[None]))
    return Rounded(*(np.concatenate(some) for some in zip(*found, strict=True)))


def _subtree(motion: Motion, vectors: Rounded) -> Rounded:
    weights = motion.below * motion.mass
    return vectors.summed(weights / np.sum(weights, axis=1, keepdims=True))


def _momenta(motion: Motion) -> Rounded:
    return motion.v.times(motion.mass)


def _frame_axes(motion: Motion) -> Rounded:
    columns = motion.axes.mT.reshape(-1, 3)
    ones = np.ones(len(columns))
    return Rounded(columns, np.repeat(motion.of_turn, 3), ones)


def _frame_axes_by_angles(motion: Motion) -> Rounded:
    """By angles about x, y and z of the bodies; the outer two lose digits where the middle is near ±90°."""
    lost = np.repeat(1 / np.sqrt(np.maximum(1 - motion.attitude[:, 0, 2] ** 2, EPS)), 3)
    axes = _frame_axes(motion)
    return Rounded(axes.value, lost * axes.error, lost * axes.size)


def _from_anchor(motion: Motion) -> Rounded:
    place = np.broadcast_to(anchor_point(motion.model), (motion.model.n, 3))
    return motion.point.minus(Rounded(place, motion.exact, np.linalg.norm(place, axis=-1)))


def _frame_distance(motion: Motion) -> Rounded:
    """From the anchor point, (N, 1)."""
    away = _from_anchor(motion)
    return away._replace(value=np.linalg.norm(away.value, axis=-1)[:, None])


def _frame_distance_rate(motion: Motion) -> Rounded:
    away, velocity = _from_anchor(motion), motion.point_velocity
    length, speed = (np.linalg.norm(x.value, axis=-1) for x in (away, velocity))
    rate = np.sum(away.value * velocity.value, axis=-1) / length
    return Rounded(rate[:, None], velocity.error + away.tolerance * speed / length, velocity.size)


def _from_first(vectors: Rounded) -> Rounded:
    """The vectors less the first body's."""
    return vectors.minus(_of_first(vectors))


def _in_first(motion: Motion, vectors: Rounded) -> Rounded:
    """Vectors in the axes of the first probe frame."""
    turn = np.broadcast_to(motion.axes[:1].mT, motion.axes.shape)
    return vectors.mapped(turn, np.ones(motion.model.n), np.broadcast_to(motion.of_turn[:1], motion.model.n))


def _velocity_in_first(motion: Motion) -> Rounded:
    """As an observer sees it who turns with the first probe frame."""
    turned = _of_first(motion.w).cross(_from_first(motion.point))
    return _from_first(motion.point_velocity).minus(turned)


def _axes_in_first(motion: Motion) -> Rounded:
    columns = (motion.axes[:1].mT @ motion.axes).mT.reshape(-1, 3)
    return Rounded(columns, np.repeat(motion.of_turn + motion.of_turn[0], 3), np.ones(len(columns)))


def _weights(motion: Motion) -> Array:
    return np.ones((1, motion.model.n))


def _at_origin(motion: Motion, linear: Rounded, angular: Rounded) -> Rounded:
    """Move a spatial vector from the probe point to the world's origin."""
    return linear.minus(angular.cross(motion.point))


def _spatial(motion: Motion) -> Rounded:
    return motion.point_acceleration.minus(motion.w.cross(motion.point_velocity))


def _degrees_of_freedom(m: Motion) -> Rounded:
    """The rates of ν, less what the directions of rods have too many."""
    return _exactly(np.array([float(len(m.mass_matrix) - np.sum(m.model.rods))]))


def _generalized_momentum(m: Motion) -> Rounded:
    """M ν, with the rotors, which the bodies' momenta lack."""
    of_bodies, rates = m.generalized(_momenta(m), m.spin_momentum()), minimal_rates(m.model, m.state)
    total = np.sum(np.abs(rates))
    error = of_bodies.error + m.mass_matrix_error * total
    return Rounded((m.mass_matrix @ rates)[:, None], error, of_bodies.size)


def _momentum_through_inverse(m: Motion) -> Rounded:
    """M M⁻¹ M ν: what is rounded in M ν and in the inverse is multiplied by M⁻¹ and by M."""
    once = _generalized_momentum(m)
    through = np.abs(m.mass_matrix) @ np.abs(np.linalg.pinv(m.mass_matrix, hermitian=True))
    return once._replace(error=once.error + 2 * through @ once.tolerance)


def _total(vectors: Rounded, others: Rounded) -> Rounded:
    """Σ a · b over all rows, (1, 1)."""
    norms = [np.linalg.norm(x.value, axis=-1) for x in (vectors, others)]
    error = np.sum(norms[0] * others.error + norms[1] * vectors.error)
    size = np.sum(vectors.size * others.size)
    return Rounded(np.full((1, 1), np.sum(vectors.value * others.value)), np.full(1, error), np.full(1, size))


def _kinetic_energy(m: Motion) -> Rounded:
    """½ ν · M ν, with the rotors."""
    return _total(_generalized_momentum(m), _exactly(minimal_rates(m.model, m.state) / 2))


def _gravity_energy(m: Motion, rates: Rounded) -> Rounded:
    """Of positions −Σ m g · r, of accelerations its second rate."""
    return _total(m.gravity._replace(size=np.linalg.norm(m.gravity.value, axis=-1)).times(-m.mass), rates)


def _force_of_probe(m: Motion) -> Rounded:
    """Mass times r̈ − g, by the acceleration of the probe points: engines take it where their frames are."""
    return m.point_acceleration.minus(m.swing).minus(m.gravity).times(m.mass)


def _body_moment(m: Motion) -> Rounded:
    """Of forces on the bodies, about the probe points."""
    return m.spin_momentum_rate().minus(m.arm.cross(_force_of_probe(m)))


def _probe_moment(m: Motion) -> Rounded:
    """Moments of the joints about the probe points."""
    return m.moment.plus(m.near.minus(m.arm).cross(m.force))


# By name the unit and the formula: vectors of bodies, of the whole mechanism, or one number per entry of ν.
_FORMULAS: Mapping[str, tuple[str, Callable[[Motion], Rounded]]] = {
    "body_position": ("m", lambda m: m.r),
    "body_velocity": ("m/s", lambda m: m.velocity),
    "body_acceleration": ("m/s²", lambda m: m.a),
    "frame_position": ("m", lambda m: m.point),
    "frame_axes": ("1", _frame_axes),
    "frame_axes_by_angles": ("1", _frame_axes_by_angles),
    "frame_velocity": ("m/s", lambda m: m.point_velocity),
    "frame_velocity_local": ("m/s", lambda m: m.local(m.point_velocity)),
    "frame_velocity_at_origin": ("m/s", lambda m: _at_origin(m, m.point_velocity, m.w)),
    "frame_angular_velocity": ("rad/s", lambda m: m.w),
    "frame_angular_velocity_local": ("rad/s", lambda m: m.local(m.w)),
    "frame_position_from_anchor": ("m", _from_anchor),
    "frame_distance": ("m", _frame_distance),
    "frame_distance_rate": ("m/s", _frame_distance_rate),
    "frame_position_in_first": ("m", lambda m: _in_first(m, _from_first(m.point))),
    "frame_axes_in_first": ("1", _axes_in_first),
    "frame_velocity_in_first": ("m/s", lambda m: _in_first(m, _velocity_in_first(m))),
    "frame_angular_velocity_in_first": ("rad/s", lambda m: _in_first(m, _from_first(m.w))),
    "frame_acceleration": ("m/s²", lambda m: m.point_acceleration),
    "frame_acceleration_local": ("m/s²", lambda m: m.local(m.point_acceleration)),
    "frame_proper_acceleration": ("m/s²", lambda m: m.point_acceleration.minus(m.gravity)),
    "frame_proper_acceleration_local": (
        "m/s²", lambda m: m.local(m.point_acceleration.minus(m.gravity)),
    ),
    "frame_spatial_acceleration": ("m/s²", _spatial),
    "frame_spatial_acceleration_local": ("m/s²", lambda m: m.local(_spatial(m))),
    "frame_spatial_acceleration_at_origin": ("m/s²", lambda m: _at_origin(m, _spatial(m), m.alpha)),
    "frame_angular_acceleration": ("rad/s²", lambda m: m.alpha),
    "frame_angular_acceleration_local": ("rad/s²", lambda m: m.local(m.alpha)),
    "centre_of_mass": ("m", lambda m: m.centre(m.r)),
    "centre_of_mass_velocity": ("m/s", lambda m: m.centre(m.v)),
    "centre_of_mass_acceleration": ("m/s²", lambda m: m.centre(m.a)),
    "total_mass": ("kg", lambda m: _exactly(np.sum(m.mass, keepdims=True))),
    "degrees_of_freedom": ("1", _degrees_of_freedom),
    "momentum": ("kg m/s", lambda m: _momenta(m).summed(_weights(m))),
    "momentum_rate": ("N", lambda m: m.a.times(m.mass).summed(_weights(m))),
    "centroidal_angular_momentum": (
        "kg m²/s", lambda m: _about_centre(m, _weights(m), _momenta(m), m.spin_momentum()),
    ),
    "centroidal_angular_momentum_rate": (
        "N m", lambda m: _about_centre(m, _weights(m), m.a.times(m.mass), m.spin_momentum_rate()),
    ),
    "subtree_centre": ("m", lambda m: _subtree(m, m.r)),
    "subtree_velocity": ("m/s", lambda m: _subtree(m, m.v)),
    "subtree_acceleration": ("m/s²", lambda m: _subtree(m, m.a)),
    "subtree_angular_momentum": (
        "kg m²/s", lambda m: _about_centre(m, m.below, _momenta(m), m.spin_momentum()),
    ),
    "subtree_mass": ("kg", lambda m: _exactly(m.below @ m.mass)),
    "kinetic_energy": ("J", _kinetic_energy),
    "gravity_energy": ("J", lambda m: _gravity_energy(m, m.r)),
    "potential_energy": ("J", lambda m: m.potential_energy),
    "gravity_energy_second_rate": ("W/s", lambda m: _gravity_energy(m, m.a)),
    "mechanical_energy": ("J", lambda m: _kinetic_energy(m).plus(_gravity_energy(m, m.r))),
    "body_force_local": ("N", lambda m: m.local(_force_of_probe(m))),
    "body_moment_local": ("N m", lambda m: m.local(_body_moment(m))),
    "joint_force_local": ("N", lambda m: m.local(m.force)),
    "joint_moment_local": ("N m", lambda m: m.local(_probe_moment(m))),
    "generalized_momentum": ("kg m²/s", _generalized_momentum),
    "momentum_through_inverse": ("kg m²/s", _momentum_through_inverse),
    "generalized_gravity": ("N m", lambda m: m.generalized(m.gravity.times(-m.mass), None)),
    "inverse_dynamics": (
        "N m", lambda m: m.generalized(m.a.minus(m.gravity).times(m.mass), m.spin_momentum_rate()),
    ),
}  # fmt: skip
# The same by an algorithm that is compared by itself, because it can be wrong where others are right.
_BY_ALGORITHM = {
    "by_jacobian_rate": (
        "frame_acceleration", "frame_spatial_acceleration", "frame_spatial_acceleration_local",
        "frame_spatial_acceleration_at_origin", "frame_angular_acceleration",
        "frame_angular_acceleration_local",
    ),
    "by_derivative": (
        "frame_velocity", "frame_velocity_local", "frame_velocity_at_origin", "frame_angular_velocity",
        "frame_angular_velocity_local", "frame_acceleration", "frame_acceleration_local",
        "frame_spatial_acceleration", "frame_spatial_acceleration_local",
        "frame_spatial_acceleration_at_origin", "frame_angular_acceleration",
        "frame_angular_acceleration_local", "centre_of_mass_acceleration", "momentum_rate",
        "centroidal_angular_momentum_rate", "inverse_dynamics", "gravity_energy_second_rate",
    ),
    "by_tangent_operator": ("body_velocity", "frame_angular_velocity"),
    "by_whole_turns": ("frame_axes",),
    "from_start": ("frame_angular_velocity",),
    "by_map_rate": ("momentum_rate", "centroidal_angular_momentum_rate"),
    "by_coriolis_matrix": ("inverse_dynamics",),
    "of_composite_joints": ("frame_acceleration", "momentum_rate", "inverse_dynamics"),
    "by_constraint_solver": ("frame_acceleration", "frame_angular_acceleration"),
    "by_inverse": ("frame_acceleration", "frame_angular_acceleration"),
    "by_aba": (
        "inverse_dynamics", "momentum_through_inverse", "frame_acceleration", "frame_angular_acceleration",
    ),
}  # fmt: skip
# but for those of frames
_THROUGH_ORIGIN = ("by_derivative", "by_map_rate", "by_coriolis_matrix", "of_composite_joints")


def _by_algorithm(name: str, by: str) -> tuple[str, Callable[[Motion], Rounded]]:
    unit, formula = _FORMULAS[name]
    is_moved = by in _THROUGH_ORIGIN and not name.startswith("frame_")
    return unit, (lambda m: formula(m.through_origin())) if is_moved else formula


SURFACE_QUANTITIES: Mapping[str, tuple[str, Callable[[Motion], Rounded]]] = {
    **_FORMULAS,
    **{f"{name}_{by}": _by_algorithm(name, by) for by, names in _BY_ALGORITHM.items() for name in names},
}


# Of mechanisms without loops: their joints' wrenches, and what is on their rates.
OF_TREES = (
    "joint_force_local", "joint_moment_local", "generalized_momentum", "momentum_through_inverse",
    "generalized_gravity", "inverse_dynamics", "kinetic_energy", "mechanical_energy", "degrees_of_freedom",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SurfaceTruth:
    """The true values of one quantity at S states, and what an engine may be off by."""

    value: Float[Array, "states rows d"]
    tolerance: Float[Array, "states rows"]
    scale: Float[Array, "states rows"]


def surface_truth(
    model: Model,
    states: Sequence[State],
    quantities: Sequence[StateQuantities],
    bounds: Sequence[RoundingBound],
) -> dict[str, SurfaceTruth]:
    """Compute all quantities of `SURFACE_QUANTITIES`.

    Args:
        states: S states; without any there is no quantity, and of loops none of `OF_TREES`.
        quantities: certified, at these states or more.
        bounds: of an engine's rounding, at the same.

    """
    motions = [Motion(model, *one) for one in zip(states, quantities, bounds, strict=False)]
    found = dict[str, SurfaceTruth]()
    for name, (_, formula) in SURFACE_QUANTITIES.items() if motions else ():
        if model.has_loops and name.startswith(OF_TREES):
            continue
        results = [formula(motion) for motion in motions]
        parts = ([x.value for x in results], [x.tolerance for x in results], [x.size for x in results])
        found[name] = SurfaceTruth(*map(np.array, parts))
    return found
