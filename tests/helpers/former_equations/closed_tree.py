"""A mechanism with loops in extended precision: the tree that it is when cut open, its ends held together.

The ends b and c of a loop are two parts of one body.  With the twists V, about the world's origin, their
biases β (V̇ at v̇ = 0), and the pose of c in the frame of b, the joint rates' derivatives solve

    M v̇ = f + Jᵀ λ,   J v̇ = −(β_b − β_c) − (V_b − V_c) × V_c − 2 a (V_b − V_c) + a² log(b⁻¹ c)

all in the frame of b, J v = V_b − V_c, with the correction of gaps a that the method declares.  The forces λ
of rows that depend on others are not unique, v̇ is: proximal iterations find it.  Of a tree there is nothing
to close.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from plumbline.model.datatypes import Model, State
from plumbline.model.kinematics import (
    cross,
    quaternion_conjugate,
    quaternion_product,
    rotate_vectors,
    rotation_vector,
)
from plumbline.model.loops import cut_open
from plumbline.model.step_methods import JointSpaceMethod
from tests.helpers.former_equations.link_tree import (
    BERNOULLI,
    Array,
    LinkStates,
    LinkTree,
    LongDouble,
    Pose,
    solve_definite,
    spatial_cross,
)

PROXIMAL_DAMPING = LongDouble(1e-10)  # of rows scaled to a unit diagonal of J M⁻¹ Jᵀ
PROXIMAL_STEPS = 10


class ClosedTree(LinkTree):
    """Coordinates and equations of motion of a mechanism; its bodies are the source's."""

    def __init__(
        self, model: Model, method: JointSpaceMethod, states: Sequence[State],
        angle_axes: Sequence[Array | None] = (),
    ) -> None:  # fmt: skip
        """Set up the links.

        Args:
            method: the declared coordinates, and its correction of gaps.
            states: B states, of loops closed or nearly.
            angle_axes: as of `LinkTree`.

        """
        self.cut = cut_open(model) if model.has_loops else None
        if self.cut:
            model, states = self.cut.model, [self.cut.state(state) for state in states]
        super().__init__(model, method, states, angle_axes)
        pairs = self.cut.ends if self.cut else ()
        self.ends = [(self.of_body[b], self.of_body[c]) for b, c in pairs]

    def total_forces(self, q: list[Array], pose: Pose, v: Array) -> Array:
        """Return M v̇: the generalised forces, and those that hold the loops closed.

        Args:
            v: (..., nv).

        Returns:
            (..., nv).

        """
        f = self.generalized_forces(q, pose, v)
        if not self.ends:
            return f
        J, right = self._rows(pose, v)
        M = self.mass_matrix(pose)[..., None, :, :]
        solved = solve_definite(M, np.concatenate([f[..., None, :], J], -2))
        K = J @ np.swapaxes(solved[..., 1:, :], -1, -2)
        missing = right - np.sum(J * solved[..., :1, :], -1)
        size = np.einsum("...ii->...i", K)
        # a row that is 0, as those out of a plane, is met anyway
        scale = 1 / np.sqrt(np.maximum(size, LongDouble(1e-30) * np.max(size, -1, keepdims=True)))
        K, missing = K * scale[..., None] * scale[..., None, :], missing * scale
        unit = np.eye(K.shape[-1], dtype=LongDouble)
        damped = (K + PROXIMAL_DAMPING * unit)[..., None, :, :]
        inverse = solve_definite(damped, np.broadcast_to(unit, K.shape))
        push = np.zeros_like(missing)
        for _ in range(PROXIMAL_STEPS):
            push = push + np.sum(inverse * (missing - np.sum(K * push[..., None, :], -1))[..., None, :], -1)
        return np.asarray(f + np.sum((scale * push)[..., None] * J, -2))

    def _rows(self, pose: Pose, v: Array) -> tuple[Array, Array]:
        """J (..., 6 L, nv) and J v̇ (..., 6 L), each loop in the frame of its end b."""
        twist, bias = self.twists(pose, v)
        rows, right, a = [], [], LongDouble(self.method.gap_correction)
        for b, c in self.ends:
            sign = np.zeros((self.nv, 1), LongDouble)
            sign[self.before[b]] += 1
            sign[self.before[c]] -= 1
            back, here = np.swapaxes(pose.A[b], -1, -2), pose.r[b]
            seen = _seen_from(back[..., None, :, :], here[..., None, :], sign * pose.S)
            rows.append(np.swapaxes(seen, -1, -2))
            apart = twist[b] - twist[c]
            change = -(bias[b] - bias[c]) - spatial_cross(apart, twist[c]) - 2 * a * apart
            turn = rotation_vector(quaternion_product(quaternion_conjugate(pose.p[b]), pose.p[c]))
            gap = np.concatenate([turn, _log_shift(turn, rotate_vectors(back, pose.r[c] - here))], -1)
            right.append(_seen_from(back, here, change) + a * a * gap)
        return np.concatenate(rows, -2), np.concatenate(right, -1)

    def bodies(self, q: list[Array], v: Array) -> LinkStates:
        """Return the motion of the mechanism's bodies.

        Args:
            v: (B, nv).

        Returns:
            Positions, attitudes, rates, and coordinates of joints.

        """
        found = super().bodies(q, v)
        if not self.cut:
            return found
        place = self.cut.place[: self.cut.source.n]
        return LinkStates(*(getattr(found, one.name)[..., place, :] for one in fields(found)))

    def body_accelerations(self) -> tuple[Array, Array]:
        """Return r̈ (B, N, 3), world axes, and ω̇′ (B, N, 3), body axes, at the states.

        Returns:
            Both [m/s², rad/s²].

        """
        found = super().body_accelerations()
        if not self.cut:
            return found
        place = self.cut.place[: self.cut.source.n]
        return found[0][..., place, :], found[1][..., place, :]


def _seen_from(back: Array, point: Array, twist: Array) -> Array:
    """Twists about the world's origin as those about a point, in axes that ``back`` turns to."""
    turning = twist[..., :3]
    moving = twist[..., 3:] + cross(turning, point)
    return np.concatenate([rotate_vectors(back, turning), rotate_vectors(back, moving)], -1)


def _log_shift(turn: Array, shift: Array) -> Array:
    """The linear part of log of a pose: Σ Bₖ/k! (turn ×)ᵏ shift, B₁ = −½; turns of less than 2 rad."""
    once = cross(turn, shift)
    total, power = shift - once / 2, once
    for weight in BERNOULLI:
        power = cross(turn, power)
        total, power = total + weight * power, cross(turn, power)
    return total
