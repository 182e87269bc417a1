"""Passive elements: rotors, dampers, springs and efforts of joints, springs and dampers between points.

A scalar coordinate φ of a joint turns about, or slides along, an axis w of the far or the near body.  With
the notation of `joints`, a and b from the centres of mass to the points, ω = 2 G ṗ and Ω = ω_near − ω_far,

    turn   φ̇ = wᵀΩ                       φ̈₀ = ẇᵀΩ                       (φ̈ at q̈ = 0)
    slide  φ  = wᵀd,  φ̇ = wᵀḋ + ẇᵀd     φ̈₀ = (wᵀd)¨ at q̈ = 0

and δφ = fᵀ(δr_near − δr_far) + n_nearᵀδθ_near − n_farᵀδθ_far, δθ = 2 G δp, with f = 0, n = w of a turn and
f = w, n_near = b × w, n_far = (a + d) × w of a slide: J_φ, and the wrench of a unit torque or force.

    spring, damper, effort   τ = e − k (φ − φ₀) − c φ̇              adds J_φᵀ τ to the right of (N5)
    rotor                    J_φ q̈ − μ/a = −φ̈₀,  μ = a φ̈           one row and one unknown more (L4)
    between points           t = k (l − l₀) + c l̇,  l̇ = dᵀḋ/l      pulls both points together, l = |d|

An angle is known from r and p up to full turns; a motion carries it on by ẋ = φ̇, which chooses the turn.

A ball joint has three coordinates about the near body's axes; φ is the rotation vector θ u of the turn from
the far to the near body, along whose axis the torque −k θ u acts: V = ½ k θ².  Exact on the constraints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy import vecdot

from reference_impl.arrays import Array, Float, Indices, Int, Motion
from reference_impl.euler_parameters import A, G, L, cross
from reference_impl.joints import ConstraintRows
from reference_impl.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class ElementForces:
    """The elements of a mechanism at one state; e joint coordinates that have some, in the joints' order."""

    joint: Int[Indices, "e"]  # of each coordinate
    r_near: Float[Array, "e 3"]  # J_φ of r of the near body; of the far body it is −r_near
    p_near: Float[Array, "e 4"]  # J_φ of p of the near body
    p_far: Float[Array, "e 4"]  # J_φ of p of the far body
    bias: Float[Array, "e"]  # φ̈₀
    stretch: Float[Array, "e"]  # rad or m, φ − φ₀
    rate: Float[Array, "e"]  # rad/s or m/s, φ̇
    torque: Float[Array, "e"]  # N m or N, τ
    force: Float[Array, "bodies 3"]  # N, of all elements but rotors, world frame
    p_force: Float[Array, "bodies 4"]  # N m, the generalised force on p of the same
    potential: float  # J, of the springs
    dissipation: float  # W, of the dampers


class _Motion(NamedTuple):
    """What elements act on, each quantity of a state once; pairs are of the near and the far end.

    The K springs between points follow the e coordinates that have elements.
    """

    p: Array  # (2, e, 4)
    axes: tuple[Array, Array]  # rows: of the far and the near body
    spin: Array  # (2, e, 3) rad/s, ω
    turning: Array  # (2, e, 3, 4) from ṗ to ω
    arm: Array  # (2, e + K, 3) m, b and a
    swing: Array  # (2, e + K, 3) m/s, their rates
    d: Array  # (e + K, 3) m
    d_rate: Array  # (e + K, 3) m/s
    axis: Array  # (e, 3) w
    push: Array  # (e, 3) f
    n_near: Array
    n_far: Array
    rate: Array  # (e,) φ̇


class Elements:
    """The elements of one mechanism; what they have in common at every state."""

    def __init__(self, mechanism: Mechanism) -> None:
        m = self.mechanism = mechanism
        found: list[tuple[int, int, int, bool, bool]] = []
        for k, kind in enumerate(m.kinds):
            balls = [("turn", 0), ("turn", 1), ("turn", 2)]
            for i, (what, axis) in enumerate(balls if kind.is_spherical else kind.motions):
                column = 0 if kind.is_spherical else i
                if any(x[k, column] for x in (m.armature, m.damping, m.stiffness, m.effort)):
                    is_far = not kind.is_spherical and (i == 0 or axis in kind.slide_axes[1:])
                    found.append((k, column, axis, what == "slide", is_far))
        table = np.array(found, np.intp).reshape(-1, 5).T
        self.joint, self.column, self.axis = table[:3]
        self.is_slide, self.is_far = table[3:].astype(bool)  # is_far: its axis is fixed in the far body
        self.is_ball = np.array([m.kinds[k].is_spherical for k in self.joint], bool)
        at = self.joint, self.column
        self.armature, self.damping, self.stiffness = m.armature[at], m.damping[at], m.stiffness[at]
        self.effort, self.rest = m.effort[at], m.rest[at]
        self.rotors = np.flatnonzero(self.armature)  # coordinates that have a row of their own
        self.bodies = m.body[self.joint, ::-1].T  # (2, e) near, far
        # both ends of the coordinates, then of the springs between points
        self._ends = np.concatenate([self.bodies, m.spring_body[:, ::-1].T], axis=1)
        points = np.concatenate([m.point[self.joint, ::-1], m.spring_point[:, ::-1]])
        self._points = np.moveaxis(points, 1, 0)
        self.turns = np.moveaxis(m.turn[self.joint, ::-1], 1, 0)
        self._axes, self._numbers = A(self.turns), np.arange(len(self.joint))
        self._in_turn = (self.axis + np.arange(3)[:, None]) % 3  # the axis of each and the two after it
        self.has_winding_angles = bool(np.any((self.stiffness != 0) & ~self.is_slide & ~self.is_ball))

    def coordinates(
        self, *motion: *Motion, x: Float[Array, "joints coordinates"] | None = None
    ) -> tuple[Float[Array, "joints coordinates"], Float[Array, "joints coordinates"]]:
        """Return the joint coordinates that have elements, and their rates.

        Args:
            motion: r, p, ṙ and ṗ.
            x: as for `evaluate`.

        Returns:
            [rad or m, and 1/s of it]; zeros where there are no elements.

        """
        found, values = self.evaluate(*motion, x=x), np.zeros((2, *self.mechanism.armature.shape))
        values[:, self.joint, self.column] = found.stretch + self.rest, found.rate
        return values[0], values[1]

    def evaluate(
        self, *motion: *Motion, x: Float[Array, "joints coordinates"] | None = None
    ) -> ElementForces:
        """Evaluate all elements.

        Args:
            motion: r, p, ṙ and ṗ.
            x: joint coordinates near which angles are taken [rad]; absent: principal values.

        """
        at, e = self._motion(motion), len(self.joint)
        (wb, wa), w, d, d_rate = at.spin, at.axis, at.d[:e], at.d_rate[:e]
        push, n_near, n_far, rate = at.push, at.n_near, at.n_far, at.rate
        w_rate = cross(np.where(self.is_far[:, None], wa, wb), w)
        bend_near, bend_far = cross(at.spin, at.swing[:, :e])
        slide_bias: Array = vecdot(w, bend_near - bend_far)
        slide_bias += 2 * vecdot(w_rate, d_rate) + vecdot(cross(wa, w_rate), d)
        stretch = np.where(self.is_slide, vecdot(w, d), self._angles(*at.axes, at.p, x)) - self.rest
        torque = self.effort - self.stiffness * stretch - self.damping * rate
        wrench = torque[:, None] * np.concatenate([[push, -push], [n_near, -n_far]], axis=2)
        potential = lost = 0.0
        # force, and moment about the centre of mass; the world last
        total = np.zeros((len(motion[0]) + 1, 6))
        np.add.at(total, self.bodies, wrench)
        if len(self.mechanism.spring_body):
            spring_wrench, potential, lost = self._point_springs(at)
            np.add.at(total, self._ends[:, e:], spring_wrench)
        return ElementForces(
            joint=self.joint,
            r_near=push,
            p_near=np.vecmat(n_near, at.turning[0]),
            p_far=-np.vecmat(n_far, at.turning[1]),
            bias=np.where(self.is_slide, slide_bias, vecdot(w_rate, wb - wa)),
            stretch=stretch,
            rate=rate,
            torque=torque,
            force=total[:-1, :3],
            p_force=np.vecmat(total[:-1, 3:], 2 * G(motion[1])),
            potential=potential + float(self.stiffness @ stretch**2) / 2,
            dissipation=lost + float(self.damping @ rate**2),
        )

    def rates(self, *motion: *Motion) -> Float[Array, "joints coordinates"]:
        """Return the rates of `coordinates` alone."""
        found = np.zeros(self.mechanism.armature.shape)
        found[self.joint, self.column] = self._motion(motion).rate
        return found

    def _motion(self, motion: Motion) -> _Motion:
        """What the state says of the coordinates that have elements, and of the springs."""
        bodies, e = np.empty((len(motion[0]) + 1, 14)), len(self.joint)
        np.concatenate(motion, axis=1, out=bodies[:-1])
        bodies[-1] = _WORLD  # where index −1 finds it
        ends = bodies[self._ends]  # (2, e + K, 14)
        r, p, v, pdot = ends[..., :3], ends[..., 3:7], ends[..., 7:10], ends[..., 10:]
        turn, turning = A(p), 2 * G(p)
        spin, arm = np.matvec(turning, pdot), np.matvec(turn, self._points)
        swing = cross(spin, arm)
        (near, far), (near_rate, far_rate) = r + arm, v + swing
        d, d_rate = near - far, near_rate - far_rate
        h, f = (turn[:, :e] @ self._axes).swapaxes(-1, -2)  # rows: the axes
        at, is_slide = (self._numbers, self.axis), self.is_slide[:, None]
        w = np.where(self.is_far[:, None], f[at], h[at])
        push, spin = w * is_slide, spin[:, :e]
        levers = np.array([arm[0, :e], arm[1, :e] + d[:e]])
        n_near, n_far = np.where(is_slide, cross(levers, w), w)
        rate = vecdot(push, v[0, :e] - v[1, :e]) + vecdot(n_near, spin[0]) - vecdot(n_far, spin[1])
        return _Motion(
            p[:, :e], (f, h), spin, turning[:, :e], arm, swing, d, d_rate, w, push, n_near, n_far, rate
        )

    def with_rotors(self, rows: ConstraintRows, found: ElementForces) -> ConstraintRows:
        """Append the rows of the rotors to those of the joints: they hold nothing, C counts as 0."""
        own = self.rotors
        near, far = self.bodies[:, own]
        p_far = np.where(far[:, None] < 0, 0.0, found.p_far[own])
        more = {"joint": self.joint[own], "near": near, "far": far, "C": np.zeros(len(own)), "p_far": p_far}
        more |= {"r_near": found.r_near[own], "p_near": found.p_near[own], "gamma": -found.bias[own]}
        return replace(rows, **{name: np.concatenate([getattr(rows, name), x]) for name, x in more.items()})

    def _angles(self, f: Array, h: Array, p: Array, x: Array | None) -> Array:
        """Angles (e,) of turns, and of balls the components of the rotation vector."""
        e, (i, j, k) = self._numbers, self._in_turn
        cosine = np.where(self.is_far, vecdot(f[e, j], h[e, j]), vecdot(f[e, k], h[e, k]))
        angle = np.arctan2(vecdot(f[e, k], h[e, j]), cosine)
        if x is not None:
            angle += 2 * np.pi * np.round((x[self.joint, self.column] - angle) / (2 * np.pi))
        if not self.is_ball.any():
            return angle
        near, far = self.turns[..., :1] * p + np.vecmat(self.turns[..., 1:], L(p))  # p ∘ turn
        scalar, vector = vecdot(far, near), np.matvec(L(far), near)
        size = np.sqrt(vecdot(vector, vector))
        theta = 2 * np.arctan2(size, np.abs(scalar)) * np.where(scalar < 0, -1, 1)
        ratio = np.divide(theta, size, out=np.full_like(size, 2.0), where=size > 0)
        return np.where(self.is_ball, ratio * vector[e, i], angle)

    def _point_springs(self, at: _Motion) -> tuple[Array, float, float]:
        """Wrenches (2, K, 6) on both bodies of each spring, its potential energy and dissipated power."""
        m, springs = self.mechanism, slice(len(self.joint), None)
        arm, d, d_rate = at.arm[:, springs], at.d[springs], at.d_rate[springs]
        length = np.sqrt(vecdot(d, d))
        rate, stretch = vecdot(d, d_rate) / length, length - m.spring_length
        tension = m.spring_stiffness * stretch + m.spring_damping * rate
        pull = (tension / length)[:, None] * d * np.array([-1.0, 1.0])[:, None, None]
        potential, lost = m.spring_stiffness @ stretch**2 / 2, m.spring_damping @ rate**2
        return np.concatenate([pull, cross(arm, pull)], axis=-1), float(potential), float(lost)


_WORLD = np.eye(14)[3]  # r, p = (1, 0, 0, 0), ṙ and ṗ
