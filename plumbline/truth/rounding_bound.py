"""The tolerance of the state level: a first-order rounding bound per body and quantity.

An engine that evaluates the Newton–Euler equations in double precision commits a few kinds of roundings.
Each kind is propagated through the inverse of the system (`plumbline.equations.responses`), and the results
are added:

    tolerance = 64 ε (tB + tS + tJ + d),    ε = 2⁻⁵³

    tB  every term of each equation of a body and of a joint, rounded once, and the result itself
    tS  elimination onto the joints: the terms of C M⁻¹ f
    tJ  joint-space engines: the terms of M q̈ + h, as torque pairs at turns and force pairs at slides
    d   accumulation of accelerations and forces along the branches; along a joint's own motions also what
        factors of the joint-space matrix leave of M q̈ = -h, √M_ii Σ √M_jj |q̈_j| (Higham, Accuracy and
        Stability of Numerical Algorithms, 2002, theorem 10.3): other branches fill zeros of M

Arms that an engine finds as differences of positions are off by a rounding of these: terms of tB count a
share of the position too, which is the larger one where it is above 32 arms (rods of 100 m and more).
Without tJ joint-space engines exceed the bound by 1e7, without tS maximal coordinates by 1e4 (needles).

Loops are cut open (`plumbline.model.loops`).  The dependent coordinates of a state are known only to rounding
over the smallest singular value σ of the rows that join the two parts of a body, which changes every term of
the equations by as much: the answer to their roundings (tB, and that of the rows that join parts) counts
1 + 1/σ times.  Steps start from an engine's own coordinates, dependent ones too, and the engine solves for
their accelerations and the forces of the rows together: there σ plays no part, tS is what the factors of
these equations round, and the rows have the roundings of the gaps x and of their rates, in a² x + 2 a ẋ.

Steps of an engine that multiplies by the inverse of its mass matrix have `Responses.errors_of_inverse`, too.

The torque of a joint's coordinate is e − k (x − x₀) − c ẋ − a ẍ.  Engines that hold positions find x and the
lengths of springs as differences: k multiplies their roundings, of the positions' size.

Every part is homogeneous in each unit, so the ratio of the bound to its quantity's scale does not change when
lengths, masses or times are measured in other units.  World frame throughout: A ω̇′ has the norm of ω̇′.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from plumbline.equations.responses import Responses
from plumbline.model.datatypes import JOINT_ELEMENTS, ZERO_INERTIA, Array, Model, State
from plumbline.model.kinematics import (
    ball_spring_turn,
    bodies_beyond,
    cross,
    cross_matrix,
    joint_vectors,
    rotate_vectors,
    rotation_matrix,
    spring_vectors,
    stack_states,
)
from plumbline.model.loops import cut_open, regular_rank, smallest_singular_values, wrench_length
from plumbline.model.step_methods import JointSpaceMethod
from plumbline.model.welding import BodyParts, part_offsets, undivided_bodies
from plumbline.processes.worker_pool import Pickled

EPS = 2.0**-53
OF_JOINTS = ("joint_reaction", "joint_moment")  # the other quantities are of bodies
TINY = float(np.finfo(float).tiny)  # replaces a bound of zero, so that an error of zero has the ratio 0
ROUNDING_FACTOR = 64  # state quantities; the worst error of a sound engine is about a sixth of it (tests)
SUM_ROUNDING_FACTOR = 256  # energies, momenta, entries of the mass matrix
MAX_RELATIVE_BOUND = 1e-8  # a tolerance above this fraction of its scale could hide a mistake
POSITION_SHARE = 1 / 32  # positions are rounded once or twice, where the bound counts 64 roundings of a term
INVERSE_SHARE = 1 / ROUNDING_FACTOR  # `Responses.errors_of_inverse` counts every rounding itself
MAX_ENTRIES = 3_000_000  # of the responses of a batch of states: more do not fit the processor's cache


def bound_over_scale(bound: Array, scale: Array) -> Array:
    """Divide bounds by their scales: infinite where a bound is no number or has no scale, unless it is 0."""
    has_scale, is_zero = scale > 0, bound == 0
    found: Array = np.where(has_scale, bound, np.inf) / np.where(has_scale, scale, 1.0)
    return np.where(is_zero, 0.0, np.where(np.isfinite(found), found, np.inf))


@dataclass(frozen=True, eq=False)
class RoundingBound:
    """Tolerances at one state; differences of 3-vectors are compared by their Euclidean norm.

    Those at many states (`bounds_at`) are arrays with a leading axis.

    ``scale`` holds per field what the tolerance is relative to: max(‖r̈‖, g), the largest moment in the body's
    Euler equation over |J|, max(‖F‖, m g), and the sums of magnitudes behind the scalars.
    """

    acceleration: Array  # (N,) m/s²
    angular_acceleration: Array  # (N,) rad/s²
    joint_reaction: Array  # (J,) N
    joint_moment: Array  # (J,) N m
    kinetic_energy: Array | float  # J
    potential_energy: Array | float  # J
    angular_momentum: Array | float  # kg m²/s
    mass_matrix: Array | float  # kg m², of each entry
    scale: dict[str, Array | float]
    kinematics: Array  # (4, N): of r [m], v [m/s], attitudes [rad] and ω [rad/s] that follow from coordinates
    of_gaps: Array  # (2, N) m/s² and rad/s², the part of both by the roundings of gaps that steps correct
    rod_torque: Array  # (N,) N m, of the torques at both ends of the rod that body k hangs by; 0 for a ball
    joint_terms: Array | float  # N m about the origin, of the terms of all joints
    joint_power: Array | float  # W, of the same with the joints' rates

    def __getitem__(self, s: int | NDArray[np.intp]) -> RoundingBound:
        """Take those at one of many states, or at some."""

        def at(some: Sequence[Any]) -> Any:
            one = np.asarray(some[0])[s]
            return one if np.ndim(one) else float(one)

        return _combined(at, [self])

    def tolerance(self, quantity: str) -> Array | float:
        """Look up a tolerance by the name of its quantity.

        Args:
            quantity: a field of `StateQuantities`.

        Returns:
            (N,) per body for vectors per body, else one number, in the unit of the quantity.

        """
        return cast("Array | float", getattr(self, quantity))

    def relative_bound(self, quantity: str) -> float:
        """Return the largest ratio of a tolerance to its scale.

        Args:
            quantity: a field of `StateQuantities`.

        Returns:
            The ratio; above `MAX_RELATIVE_BOUND` agreement would prove little.

        """
        tolerance, scale = np.asarray(self.tolerance(quantity)), np.asarray(self.scale[quantity])
        return float(np.max(tolerance / np.where(scale > 0, scale, 1.0), initial=0.0, where=scale > 0))

    def describe(self, quantity: str) -> str:
        """Explain in one sentence how a tolerance was derived.

        Args:
            quantity: a field of `StateQuantities`.

        Returns:
            The sentence, with the largest tolerance and its ratio to the scale.

        """
        if quantity in ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment"):
            how = (
                f"{ROUNDING_FACTOR} roundings (2^-53) of the largest terms of the Newton-Euler equations, of "
                "their elimination onto the joints and of the joint-space form, each propagated through the "
                "inverse"
            )
        else:
            how = f"{SUM_ROUNDING_FACTOR} roundings (2^-53) of the sum of the magnitudes of its terms"
        largest = float(np.max(self.tolerance(quantity)))
        return f"{how}: at most {largest:.1e}, {self.relative_bound(quantity):.1e} of its scale"


def _combined(combine: Callable[[Sequence[Any]], Any], bounds: Sequence[RoundingBound]) -> RoundingBound:
    """Apply one function to each tolerance, and each scale, of several bounds."""
    own, scale = (
        {name: combine([one[name] for one in some]) for name in some[0] if name != "scale"}
        for some in ([*map(vars, bounds)], [one.scale for one in bounds])
    )
    return RoundingBound(**own, scale=scale)


def remembered_rounding_bound(model: Model, state: State) -> RoundingBound:
    """Compute the bound of `state_rounding_bound`, or return that of an earlier call with the same numbers.

    Args:
        state: the state at which quantities are compared.

    Returns:
        The tolerances and their scales; not to be changed.

    """
    return _remembered(Pickled.of((model, state)))


@lru_cache(maxsize=64)  # a worker gets the integrators of a scenario in a row
def _remembered(arguments: Pickled) -> RoundingBound:
    return state_rounding_bound(*arguments.load())


def state_rounding_bound(model: Model, state: State, parts: BodyParts | None = None) -> RoundingBound:
    """Compute the rounding tolerances of every state quantity, as `rounding_bounds` at one state."""
    return rounding_bounds(model, [state], parts)[0]


def rounding_bounds(
    model: Model, states: Sequence[State], parts: BodyParts | None = None
) -> list[RoundingBound]:
    """Compute the rounding tolerances of every state quantity at many states.

    Args:
        model: the mechanism; where bodies can move, they have inertia.
        states: where quantities are compared.
        parts: the rigid parts that an engine welds each body from, where it does.  The terms are those of a
            part then: for a part whose centre is c away, levers are longer by ‖c‖ and accelerations by
            ‖c‖(‖ω̇‖ + ‖ω‖W), mass and least inertia are those of the lightest part, and the weld carries the
            weight and inertia of a part with the lever c.

    Returns:
        The tolerances, in SI units, and their scales.

    Raises:
        LinAlgError: the system is singular.

    """
    if not states:
        return []
    together = bounds_at(model, stack_states(states), parts)
    return [together[s] for s in range(len(states))]


def bounds_at(
    model: Model, states: State, parts: BodyParts | None = None, method: JointSpaceMethod | None = None
) -> RoundingBound:
    """Compute the tolerances of `rounding_bounds` at many states (S, ...), as arrays (S, ...).

    Args:
        method: of steps, by an engine with joint coordinates of its own that corrects gaps: then those of
            loops depend on no others, and nothing is eliminated onto the joints.

    """
    size = max(1, MAX_ENTRIES // (12 * len(model.kind)) ** 2)
    found: list[RoundingBound] = []
    for first in range(0, len(states.p), size):
        some = states[first : first + size]
        if model.has_loops:
            found.append(_of_loops(model, some, method))
        else:
            found.append(_bound(*_Terms(model, some, parts, method=method).bounds()))
    return _combined(np.concatenate, found)


def _of_loops(model: Model, states: State, method: JointSpaceMethod | None) -> RoundingBound:
    """Bounds of a mechanism with loops, cut open."""
    cut = cut_open(model)
    there = cut.state(states)
    terms = _Terms(cut.model, there, None, cut.ends, cut.row_scale, method)
    totals, scales, sums, rods, joints, motion = terms.bounds(is_eliminated=method is None)
    (of_welds, of_gaps), spread = terms.weld_errors(), np.ones(len(totals))
    if method is None:
        spread += 1 / smallest_singular_values(cut, there, regular_rank(model, states[0]))
    else:
        totals += terms.factor_errors() + of_gaps
    # what one body or joint has is found together with what all others of the loop have
    largest = {name: np.max(value, axis=1) for name, value in scales.items()}
    reaction = wrench_length(model) * largest["joint_reaction"]
    largest["joint_moment"] = np.maximum(largest["joint_moment"], reaction)
    sizes = np.stack([*largest.values()], -1)[:, None]
    total = totals + of_welds + sizes
    total = total + (terms.of_rows + of_welds + sizes) * (spread - 1)[:, None, None]
    counts = {name: len(model.kind) if name in OF_JOINTS else model.n for name in largest}
    scale = {name: np.repeat(value[:, None], counts[name], axis=1) for name, value in largest.items()}
    spread_sums = {name: size * spread for name, size in sums.items()}
    largest_motion = np.repeat(np.max(motion, axis=-1, keepdims=True), model.n, axis=-1)
    bodies = cut.place[: model.n]
    of_joints = spread[:, None] * joints, spread[:, None] * largest_motion
    return _bound(total[:, cut.place], scale, spread_sums, rods[:, bodies], *of_joints, of_gaps[:, cut.place])


def _bound(
    total: Array,
    scale: dict[str, Array],
    sums: dict[str, Array],
    rods: Array,
    joints: Array,
    motion: Array,
    of_gaps: Array | None = None,
) -> RoundingBound:
    """Tolerances by the sums of all sizes: (S, J, 4) of joints, of which the first hold the bodies."""
    total, n = ROUNDING_FACTOR * EPS * total, rods.shape[1]
    of_gaps = 0 * total if of_gaps is None else ROUNDING_FACTOR * EPS * of_gaps
    return RoundingBound(
        acceleration=total[:, :n, 0],
        angular_acceleration=total[:, :n, 1],
        joint_reaction=total[:, :, 2],
        joint_moment=total[:, :, 3],
        scale={**scale, **sums},
        kinematics=ROUNDING_FACTOR * EPS * np.moveaxis(motion, 0, 1),
        of_gaps=of_gaps[:, :n, :2].mT,
        rod_torque=ROUNDING_FACTOR * EPS * rods,
        joint_terms=ROUNDING_FACTOR * EPS * joints[:, 0],
        joint_power=ROUNDING_FACTOR * EPS * joints[:, 1],
        **{name: SUM_ROUNDING_FACTOR * EPS * size for name, size in sums.items()},
    )


class _Terms:
    """The sizes of all that is rounded in a tree at S states.

    Norms (S, N) are named as their vectors: a, alpha, F, moment (of the joint), arm (centre to near point),
    reach (centre of the far body to the near point).
    """

    def __init__(
        self,
        model: Model,
        states: Sequence[State] | State,
        parts: BodyParts | None = None,
        ends: Sequence[tuple[int, int]] = (),
        row_scale: Array | None = None,
        method: JointSpaceMethod | None = None,
    ) -> None:
        # 1/s, of the gaps of loops, and of slides that are held at a pitch
        self.correction = method.gap_correction if method else 0.0
        self.pitch_correction = self.correction if method and method.holds_pitches else 0.0
        self.inverts_mass_matrix = method is not None and method.inverts_mass_matrix
        self.responses = found = Responses(model, states, ends, row_scale)
        norm, self.model, self.state, self.n = np.linalg.norm, model, found.state, model.n
        state = found.state
        self.far = model.body[:, 0]
        self.children = self.far == np.arange(model.n)[:, None]  # [k, b]: body b is next beyond k
        self.below = bodies_beyond(model)
        self.d = joint_vectors(model, state.r, state.p)
        self.springs = spring_terms(model, state)
        self.elements = joint_elements(model, state, norm(found.velocity_terms(), axis=-1))
        self.element_size = np.zeros((len(state.p), model.n, 2))  # of each joint's slides and turns
        for element in self.elements:
            self.element_size[:, element.k, int(not element.is_slide)] += element.size
        self.g, self.m, self.J = float(norm(model.gravity)), model.mass, norm(model.inertia, axis=(1, 2))
        self.a, self.alpha, self.F, self.moment = np.moveaxis(norm(found.solution, axis=-1), -1, 0)
        self.arm = norm(found.arm, axis=-1)
        to_near = found.far_arm + np.where((model.rods & (self.far >= 0))[:, None], self.d, 0.0)
        self.reach = norm(to_near, axis=-1) + norm(self.d, axis=-1)
        spin = norm(state.omega, axis=-1)
        # arms that are differences of positions far from the origin, which some engines use
        self.place = POSITION_SHARE * norm(state.r, axis=-1)
        own = spin + norm(state.udot, axis=-1) + norm(state.xdot, axis=-1)
        # largest rate of any body or joint between the world and here, per body
        self.W = np.max(np.where(self.below.T, own[:, None], 0.0), axis=-1)
        self._measure_parts(parts, spin)
        self.speed = norm(state.v, axis=-1)
        self.transport, self.spin = spin * self.speed, self.J * spin * self.W
        self.load = norm(found.load, axis=-1) + self.springs.size
        self.torque = norm(found.torque, axis=-1) + self.springs.moment_size
        slides = np.array([bool(kind.slide_axes) for kind in model.kinds], float)
        self.pitch = np.where([kind.has_pitch for kind in model.kinds], np.abs(model.length), 0.0)
        self.slide_rate = np.sum(np.abs(state.xdot), -1) * (slides + self.pitch)
        self.F_children = self.F @ self.children.T
        self.moment_children = (self.moment + self.reach * self.F) @ self.children.T

    def _measure_parts(self, parts: BodyParts | None, spin: Array) -> None:
        """Offsets of the parts, masses and least inertias that divide, and the force of welds."""
        pieces = undivided_bodies(self.model) if parts is None else parts
        self.offset = part_offsets(pieces)
        self.lightest = np.array([min(part.mass for part in body) for body in pieces])
        principal = np.linalg.eigvalsh([[part.inertia for part in body] for body in pieces])  # (N, parts, 3)
        has_all = principal[..., 0] > ZERO_INERTIA * principal[..., 2]
        self.least_inertia = np.min(np.where(has_all, principal[..., 0], np.inf), axis=1)
        self.a = self.a + self.offset * (self.alpha + spin * self.W)
        self.arm, self.reach = self.arm + self.offset, self.reach + self.of_far(self.offset)
        self.weld = np.where(self.offset > 0, self.m * (self.a + self.g), 0.0)

    def of_far(self, x: Array) -> Array:
        """Value (..., N) at the far body of each joint, 0 at the world."""
        return np.where(self.far >= 0, x[..., self.far], 0.0)

    def _body_errors(self) -> tuple[Array, Array, Array, Array]:
        """Largest term of each Newton and Euler equation, and of each joint's relative accelerations."""
        # spatial algebra in a body's axes holds ω × ṙ and ṙ × m ṙ, which a moving free body makes large
        m, g, W, far_a, far_alpha = self.m, self.g, self.W, self.of_far(self.a), self.of_far(self.alpha)
        weight = np.broadcast_to(m * g, self.a.shape)
        forces = (m * self.a, weight, m * self.transport, self.F, self.F_children, self.load)
        # a body that slides or is free may have any speed; others move as fast as their levers turn
        drifting = [kind.is_unbounded for kind in self.model.kinds]
        drifts = np.any(self.below[drifting], axis=0)
        square = np.where(drifts, 1.0, POSITION_SHARE) * m * self.speed**2
        moments = (
            square, self.J * self.alpha, self.spin, self.arm * self.F, self.torque, self.moment,
            self.moment_children, self.offset * self.weld, self.place * self.F, self.place * self.F_children,
        )  # fmt: skip
        linear = (
            self.a, self.arm * self.alpha, self.arm * W**2, far_a, self.reach * far_alpha, self.reach * W**2,
            W * self.slide_rate, self.place * self.alpha, self.place * W**2, self._pitch_errors(),
        )  # fmt: skip
        sizes = (np.max(terms, 0) for terms in (forces, moments, linear, (self.alpha, far_alpha, W**2)))
        force, moment, push, turn = sizes
        return force, moment, push, turn

    def _pitch_errors(self) -> Array:
        """a² x + 2 a ẋ of the slides that equal pitches times turns."""
        a, (x, rate) = self.pitch_correction, (np.sum(np.abs(y), -1) for y in (self.state.x, self.state.xdot))
        return np.asarray(POSITION_SHARE * a * self.pitch * (a * x + 2 * rate))

    def _elimination_errors(self) -> tuple[Array, Array]:
        """Terms of C M⁻¹ f in the linear and angular rows of each joint; of a body with an M⁻¹."""
        free = (self.F + self.F_children + self.m * self.g + self.load + self.weld) / self.lightest
        turn = self.arm * self.F + self.moment + self.moment_children + self.spin + self.torque
        turn = turn / self.least_inertia
        far_free, far_turn = self.of_far(free), self.of_far(turn)
        return free + self.arm * turn + far_free + self.reach * far_turn, turn + far_turn

    def factor_errors(self) -> Array:
        """First-order change (S, N, 4) by the factors of the equations of all coordinates and rows together.

        Factors without pivoting leave up to √(K_ii K_jj) in an entry K_ij, K_ii of the mass matrix M and of
        J M⁻¹ Jᵀ (Higham, Accuracy and Stability of Numerical Algorithms, 2002, theorem 10.3).
        """
        responses, unknowns = self.responses.to_factors()
        size = np.sum(np.linalg.norm(responses, axis=3), axis=-1)
        return np.asarray(size * np.linalg.norm(unknowns, axis=-1)[:, None, None])

    def weld_errors(self) -> tuple[Array, Array]:
        """First-order change (S, N, 4) of r̈, α, F, M by errors in the rows that join parts of a body.

        Returns:
            By errors of their accelerations, and of a² x + 2 a ẋ of the gaps x, whose parts are rounded at
            every joint around the loop.

        """
        found, sizes, gaps, a = self.responses, list[Array](), list[Array](), self.correction
        place, speed = (np.linalg.norm(x, axis=-1) for x in (self.state.r, self.state.v))
        for pair in found.ends:
            around = np.any([self.below[:, k] for k in pair], axis=0)
            reach = np.sum((self.reach + self.arm)[:, around], -1)
            turning = np.max((self.W**2 + self.alpha)[:, around], -1)
            sizes += [np.max(self.a[:, around], -1) + reach * turning, turning]
            rate = np.max(self.W[:, around], -1)
            length = np.max((place + self.reach + self.arm)[:, around], -1)
            share = POSITION_SHARE * np.count_nonzero(around) * a
            moving = np.max(speed[:, around], -1) + rate * length
            gaps += [share * (a * length + 2 * moving), share * (a + 2 * rate)]
        response = found.to_gaps()  # (S, N, 4, 3, 6 L)
        norms = np.sqrt(np.sum(response.reshape(*response.shape[:4], -1, 3) ** 2, axis=(3, 5)))
        of_rows, of_gaps = ((norms @ np.stack(x, 1)[:, None, :, None])[..., 0] for x in (sizes, gaps))
        return of_rows, of_gaps

    def _norms_of_joints(self) -> Array:
        """Frobenius norms (S, N, 4, N, 2) of the responses to linear and angular accelerations of joints."""
        held, first = self.responses.held, 0
        squares = np.sum(self.responses.to_joints() ** 2, axis=3)
        found = np.zeros((*squares.shape[:-1], self.n, 2))
        for k, directions in enumerate(held):
            last = first + directions.shape[-1]
            linear = first + int(np.sum(np.any(directions[0, :3], axis=0)))
            found[..., k, 0] = np.sum(squares[..., first:linear], -1)
            found[..., k, 1] = np.sum(squares[..., linear:last], -1)
            first = last
        return np.asarray(np.sqrt(found))

    def bounds(
        self, is_eliminated: bool = True
    ) -> tuple[Array, dict[str, Array], dict[str, Array], Array, Array, Array]:
        """Sum the sizes of all roundings.

        Args:
            is_eliminated: whether tS is among them.

        Returns:
            tB + tS + tJ + d (S, N, 4) of r̈ [m/s²], α [rad/s²], F [N] and M [N m]; the scales of vectors; the
            sums (S,) behind the energies [J], the angular momentum and the mass matrix; torques of rods
            (S, N) [N m]; of all joints (S, 2) the moments [N m] and their power [W]; sizes (4, S, N) behind
            r, v, attitudes and ω.

        """
        t, model, state, joints = self, self.model, self.state, _JointSpace(self)
        force, moment, *rows = self._body_errors()
        to_wrenches = self.responses.to_wrenches()
        of_bodies = _errors(_norms(to_wrenches), np.stack([force, moment], -1))
        of_joints = self._norms_of_joints()
        self.of_rows = of_bodies + _errors(of_joints, np.stack(rows, -1))
        total = self.of_rows.copy()
        if is_eliminated:
            total += _errors(of_joints, np.stack(self._elimination_errors(), -1))
        total += np.einsum("sjnq,sj->snq", joints.responses(to_wrenches), joints.load)
        swing, turning = (
            (x.mT @ joints.acceleration[..., None])[..., 0] for x in (joints.lever, joints.turns)
        )
        tip = state.r + self.responses.arm
        carried = t.m * (t.a + swing + t.g + t.transport) + t.load
        lever = np.linalg.norm(state.r[:, None] - tip[:, :, None], axis=-1) * t.below
        carried_moment = (t.J * (t.alpha + turning) + t.spin + t.torque) @ t.below.T
        carried_moment += (lever @ carried[..., None])[..., 0]
        result = np.stack([np.maximum(t.a, t.g), t.alpha, t.F, t.moment], -1)
        total += result
        free = model.free  # its wrench is what rounding leaves
        total[:, free, 2:] += np.stack([force @ t.below.T, moment @ t.below.T], -1)[:, free]
        elements = t.element_size
        total[..., 2:] += np.sum(elements, -1, keepdims=True) * (elements > 0)
        total += np.stack([swing + t.a + t.transport, turning, carried @ t.below.T, carried_moment], -1)

        rate, speed = ((x.mT @ joints.rate[..., None])[..., 0] for x in (joints.turns, joints.lever))
        with_place = np.maximum(speed, t.place * rate)
        steps = np.sum(np.linalg.norm(model.point, axis=2), 1) + np.linalg.norm(t.d, axis=-1)
        steps += t.offset + t.of_far(t.offset) + np.linalg.norm(state.r, axis=-1) * free
        height = steps @ t.below
        kinetic, potential = (
            sum((getattr(element, name) for element in t.elements), np.zeros(len(total)))
            for name in ("kinetic", "potential")
        )
        sums = {
            "kinetic_energy": np.sum(t.m * speed * with_place + t.J * rate**2, -1) / 2 + kinetic,
            "potential_energy": t.g * np.sum(t.m * height, -1) + potential + t.springs.potential,
            "angular_momentum": np.sum(t.m * height * with_place + t.J * rate, -1),
            "mass_matrix": np.max(joints.mass_matrix, axis=(1, 2), initial=0.0),
        }
        inertia = np.where(t.J > 0, t.J, np.inf)
        weight, moments = np.broadcast_to(t.m * t.g, t.F.shape), (np.sum(elements, -1), lever @ (t.m * t.g))
        scale = {
            "acceleration": result[..., 0],
            "angular_acceleration": np.max([t.alpha, moment / inertia, turning], 0),
            "joint_reaction": np.max([t.F, weight, t.m * t.a], 0),
            "joint_moment": np.max([*moments, t.moment, t.arm * t.F, t.J * t.alpha, t.spin], 0),
        }
        rods, of_joints = np.zeros(t.a.shape), np.zeros((len(total), 2))
        for at, (what, k) in enumerate(joints.pairs):
            load, left = joints.load[:, at], joints.left[:, at]
            if what in ("upper", "lower"):
                total[:, k, 2] += left / model.length[k]
            else:
                total[:, k, 2 if what == "slide" else 3] += left
            rods[:, k] += load * (what in ("upper", "lower"))
            of_joints[:, 0] += load * (np.linalg.norm(tip[:, k], axis=-1) if what == "slide" else 1.0)
            of_joints[:, 1] += load * joints.rate[:, at]
        if t.inverts_mass_matrix:
            off = INVERSE_SHARE * self.responses.errors_of_inverse()
            total[..., :2] += off
            force, moment = t.m * off[..., 0], t.J * off[..., 1]
            of_joints[:, 0] += np.sum(np.linalg.norm(state.r, axis=-1) * force + moment, -1)
            of_joints[:, 1] += np.sum(t.speed * force + rate * moment, -1)
        depth = np.broadcast_to(np.sum(t.below, axis=0), height.shape)
        return total, scale, sums, rods, of_joints, np.stack([height, with_place, depth, rate])


def _norms(responses: Array) -> Array:
    """Frobenius norms (S, N, 4, N, 2) of 3×3 blocks (S, N, 4, 3, N, 2, 3)."""
    return np.asarray(np.sqrt(np.einsum("snqikcj,snqikcj->snqkc", responses, responses)))


def _errors(norms: Array, sizes: Array) -> Array:
    """First-order change (S, N, 4) for errors (S, N, 2) in the equations of bodies or joints."""
    flat = norms.reshape(*norms.shape[:3], -1)
    return np.asarray((flat @ sizes.reshape(len(sizes), 1, -1, 1))[..., 0])


class _JointSpace:
    """Joint coordinates of a tree: turns at near points (a rod's also at its far point), and slides.

    Per coordinate and body: ``lever`` (S, C, N) [m or 1] the size of the velocity of the centre per unit
    rate, ``turns`` (C, N) 1 where the body turns with it.
    """

    def __init__(self, terms: _Terms) -> None:
        self.terms, model, state, found = terms, terms.model, terms.state, terms.responses
        solution, norm = found.solution, np.linalg.norm
        self.pairs: list[tuple[str, int]] = []
        lever, turns, rates, accelerations = (list[Array]() for _ in range(4))
        relative = self._relative_accelerations()
        none = np.zeros((len(state.p), 3))

        def add(what: str, k: int, reach: Array, turn: bool, rate: Array, acceleration: Array) -> None:
            self.pairs.append((what, k))
            lever.append(terms.below[k] * reach)
            turns.append(terms.below[k] * float(turn))
            rates.append(norm(rate, axis=-1))
            accelerations.append(norm(acceleration, axis=-1))

        for k, kind in enumerate(model.kinds):
            far = terms.far[k]
            w, alpha, tip = found.omega[:, k], solution[:, k, 1], state.r[:, k] + found.arm[:, k]
            far_w, far_alpha = (found.omega[:, far], solution[:, far, 1]) if far >= 0 else (none, none)
            reach = norm(state.r - tip[:, None], axis=-1) + terms.offset
            if kind.holds_distance:
                u = state.u[:, k]
                spin, swing = cross(u, state.udot[:, k]), cross(u, relative[:, k]) / model.length[k]
                upper = norm(state.r - (tip - terms.d[:, k])[:, None], axis=-1) + terms.offset
                add("upper", k, upper, True, spin - far_w, swing - far_alpha)
                add("lower", k, reach, True, w - spin, alpha - swing)
                continue
            if kind.has_attitude or kind.turn_axes:
                add("turn", k, reach + terms.pitch[k], True, w - far_w, alpha - far_alpha)
            if kind.holds_nothing:
                add("slide", k, np.ones_like(reach), False, state.v[:, k], relative[:, k])
            elif kind.slide_axes:
                rate = terms.slide_rate[:, k, None]
                add("slide", k, np.ones_like(reach), False, rate, relative[:, k])
        shape = len(state.p), len(lever), terms.n
        self.lever = np.reshape(np.swapaxes(lever, 0, 1) if lever else [], shape)
        self.turns = np.reshape(turns, shape[1:])
        self.rate, self.acceleration = (np.reshape(x, shape[1::-1]).T for x in (rates, accelerations))
        m, J = terms.m, terms.J
        self.mass_matrix = (self.lever * m) @ self.lever.mT + (self.turns * J) @ self.turns.T
        h = (J * terms.W**2 + terms.torque) @ self.turns.T
        h += (self.lever @ (m * (terms.g + terms.a) + terms.load)[..., None])[..., 0]
        for element in terms.elements:
            row = self.pairs.index(("slide" if element.is_slide else "turn", element.k))
            self.mass_matrix[:, row, row] += element.armature
            h[:, row] += element.size
        self.load = (self.mass_matrix @ self.acceleration[..., None])[..., 0] + h  # N m or N
        root = np.sqrt(np.diagonal(self.mass_matrix, axis1=1, axis2=2))
        self.left = root * np.sum(root * self.acceleration, -1, keepdims=True)  # N m or N, by factors of M

    def _relative_accelerations(self) -> Array:
        """(S, N, 3) accelerations of near points against the points that far bodies carry."""
        t, found = self.terms, self.terms.responses
        a, alpha = np.moveaxis(found.solution[:, :, :2], 2, 0)
        w, far = found.omega, t.far
        near = a + cross(alpha, found.arm) + cross(w, cross(w, found.arm))
        arm, turn, spin = found.far_arm, alpha[:, far], w[:, far]
        carried = a[:, far] + cross(turn, arm) + cross(spin, cross(spin, arm))
        return np.asarray(near - np.where((far >= 0)[:, None], carried, 0.0))

    def responses(self, to_wrenches: Array) -> Array:
        """Norms (S, coordinates, N, 4) of the response to a unit torque or force pair at each coordinate."""
        t, found = self.terms, self.terms.responses
        force, moment = to_wrenches[..., 0, :], to_wrenches[..., 1, :]  # (S, N, 4, 3, N, 3)
        arm, far_arm = (cross_matrix(x)[:, None, None] for x in (found.arm, found.far_arm))
        pairs = list[Array]()
        for what, k in self.pairs:
            far = t.far[k]
            above = moment[..., far, :] if far >= 0 else 0.0
            if what == "turn":
                pair = moment[..., k, :] - above
            else:
                pair = force[..., k, :] + moment[..., k, :] @ arm[..., k, :, :]
                if far >= 0:
                    pair = pair - force[..., far, :] - moment[..., far, :] @ far_arm[..., k, :, :]
            if what in ("upper", "lower"):  # a torque on a massless rod is balanced by forces ∓(τ × u)/ℓ
                u = cross_matrix(t.state.u[:, k])[:, None, None]
                through = -pair @ u / t.model.length[k]
                pair = through - above if what == "upper" else moment[..., k, :] - through
            pairs.append(np.sqrt(np.einsum("snqij,snqij->snq", pair, pair)))
        return np.reshape(np.swapaxes(pairs, 0, 1) if pairs else [], (len(t.a), len(pairs), t.n, 4))


# -- rotors, springs, dampers and efforts: the sizes of what is rounded in their forces ---------------


@dataclass(frozen=True, eq=False)
class JointElement:
    """The elements along one coordinate of joint k, of a ball joint about one axis."""

    k: int
    is_slide: bool
    armature: float  # kg m² or kg, a
    size: Array  # (S,) N m or N, of the terms of the torque, and what their roundings amount to
    kinetic: Array  # (S,) J
    potential: Array  # (S,) J, of the terms


@dataclass(frozen=True, eq=False)
class SpringTerms:
    """Springs between points: sizes of what is rounded, summed over the bodies."""

    size: Array  # (S, N) N
    moment_size: Array  # (S, N) N m
    potential: Array  # (S,) J


def joint_elements(model: Model, state: State, bends: Array) -> list[JointElement]:
    """List the elements of all joints.

    Args:
        bends: (S, N) sizes of the relative accelerations that velocities alone cause.

    Returns:
        Those coordinates that have any, in the order of the joints.

    """
    found: list[JointElement] = []
    if not model.has_joint_elements:
        return found
    norm, lever = np.linalg.norm, 2 * float(np.max(np.abs(model.point)))
    spin = norm(state.omega, axis=-1)
    sizes = norm(state.r, axis=-1) + lever, norm(state.v, axis=-1) + lever * spin, spin
    for k, kind in enumerate(model.kinds[: model.n]):
        far = model.body[k, 0]
        reach, speed, rate = (x[:, k] + (x[:, far] if far >= 0 else 0.0) for x in sizes)
        bend = bends[:, k] + (spin[:, k] * spin[:, far] if far >= 0 else 0.0)
        coordinates = [(what, i, state.x[:, k, i]) for i, (what, _) in enumerate(kind.motions)]
        if kind.is_spherical:
            unloaded, turn = ball_spring_turn(model, k, state.p)
            turn = rotate_vectors(rotation_matrix(unloaded), turn)
            coordinates = [("turn", 0, angle) for angle in turn.T]
        for what, i, x in coordinates:
            a, c, stiffness, rest, effort = (float(getattr(model, name)[k, i]) for name in JOINT_ELEMENTS)
            if not (a or c or stiffness or effort):
                continue
            is_slide = what == "slide"
            pace = speed if is_slide else rate
            stretch = np.abs(x) + abs(rest) + (reach if is_slide else 1.0)  # what x is a difference of
            size = abs(effort) + stiffness * stretch + c * pace + a * bend
            found.append(JointElement(k, is_slide, a, size, a * pace**2 / 2, stiffness * stretch**2 / 2))
    return found


def spring_terms(model: Model, state: State) -> SpringTerms:
    """Measure what is rounded in the forces of springs between points."""
    norm, body, has_body = np.linalg.norm, model.spring_body, model.spring_body >= 0
    A = rotation_matrix(state.p)
    arm = np.where(has_body[..., None], rotate_vectors(A[:, body], model.spring_point), 0.0)
    omega = rotate_vectors(A, state.omega)[:, body]
    velocity = np.where(has_body[..., None], state.v[:, body] + cross(omega, arm), 0.0)
    d, d_rate = spring_vectors(model, state.r, state.p), velocity[:, :, 1] - velocity[:, :, 0]
    length, change = norm(d, axis=-1), norm(d_rate, axis=-1)
    k, c = model.spring_stiffness, model.spring_damping
    tension = k * (length - model.spring_length) + c * np.sum(d * d_rate, -1) / length
    # what d and its rate are differences of
    place = np.sum(norm(model.spring_point, axis=-1) + has_body * norm(state.r, axis=-1)[:, body], -1)
    pace = np.sum(has_body * norm(state.v, axis=-1)[:, body] + norm(omega, axis=-1) * norm(arm, axis=-1), -1)
    size = (k + (np.abs(tension) + c * change) / length) * place + k * model.spring_length + c * pace
    of_body = np.zeros((2, len(state.p), model.n))
    for spring, end in np.argwhere(has_body):
        of_body[0, :, body[spring, end]] += size[:, spring]
        of_body[1, :, body[spring, end]] += norm(arm[:, spring, end], axis=-1) * size[:, spring]
    potential = np.sum(k * (length + model.spring_length + place) ** 2, -1) / 2
    return SpringTerms(of_body[0], of_body[1], potential)
