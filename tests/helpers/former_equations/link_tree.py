"""A tree as links on elementary joints in extended precision: what declared steps are taken with.

A link has a joint to the link before it: a ball (coordinate: a quaternion; rate: the relative angular
velocity in its own frame), a turn about or a slide along an axis (a number), a rigid motion (an attitude and
a point; velocity and ω′ in its own frame), or a weld.  A rod is a massless link on a ball; universal and
cylindrical joints are two links, a free body is on three slides and a ball, a ball of "joint angles" is three
turns.  With twists V and wrenches about the world's origin (angular part first), S the motions of all joints,
I the links' inertias

    M = Sᵀ I_composite S + rotors,   f = τ − Sᵀ Σ (I (V × S v) + V ×* I V − applied),   M v̇ = f

Arrays have leading axes ``...`` for many states at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import KINDS, Model, State
from plumbline.model.kinematics import (
    ball_spring_rest,
    cross,
    cross_matrix,
    quaternion_conjugate,
    quaternion_exponential,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
    rotation_vector,
    turn_of_z,
)
from plumbline.model.step_methods import JointSpaceMethod

Array = NDArray[Any]  # in this module of extended precision, where nothing else is stated
LongDouble: Any = np.longdouble
Forces = Literal["all", "applied", "joint dampers"]
UNIT: Array = np.array([1, 0, 0, 0], LongDouble)
SIZES = {"ball": 3, "turn": 1, "slide": 1, "rigid motion": 6, "weld": 0}


@dataclass(frozen=True, eq=False)
class LinkStates:
    """Motion of the bodies of a tree, extended precision; leading axes as in the states it was made from."""

    r: Array  # (..., N, 3) m, world
    p: Array  # (..., N, 4) unit quaternions
    v: Array  # (..., N, 3) m/s, world
    omega: Array  # (..., N, 3) rad/s, body frame
    u: Array  # (..., N, 3) directions of the rods, world; zero for other joints
    udot: Array  # (..., N, 3) 1/s
    x: Array  # (..., N, 2) rad or m, coordinates of the other joints
    xdot: Array  # (..., N, 2)


@dataclass(frozen=True, eq=False)
class _Link:
    """A link and its joint."""

    joint: str
    parent: int  # link, −1 the world
    hang: Array  # (3,) m, of the joint in the parent's frame
    near: Array  # (3,) m, of the joint in its own
    axis: Array  # (3,) or (B, 3) of a turn or slide, parent's frame
    frame: Array  # (4,) or (B, 4): attitude in the parent's frame before the joint moves
    body: int  # −1 for massless links
    joint_of: int  # the mechanism's joint
    motion: int = -1  # which of the joint's coordinates moves it; −1 for balls, free bodies, angles of both


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the links are: lists over the links."""

    p: list[Array]  # (..., 4)
    A: list[Array]  # (..., 3, 3)
    P: list[Array]  # (..., 3) m, their joints
    r: list[Array]  # (..., 3) m, their centres of mass
    S: Array  # (..., nv, 6)
    inertias: list[Array]  # (..., 6, 6) about the world's origin; empty until they are needed


class LinkTree:
    """Coordinates and equations of motion of a tree; q is a list over the links, v is (..., nv)."""

    is_new_step = True  # for formulas that keep accelerations from step to step

    def __init__(
        self, model: Model, method: JointSpaceMethod, states: Sequence[State],
        angle_axes: Sequence[Array | None] = (),
    ) -> None:  # fmt: skip
        """Set up the links.

        Args:
            angle_axes: for "joint angles", the axes (angles, 3) of the turns of balls and rods at each state.

        """
        self.model, self.method, self.states = model, method, states
        self.links: list[_Link] = []
        self.of_body: list[int] = []
        self.of_rod: dict[int, int] = {}
        p, u, udot = (np.array([getattr(s, name) for s in states], LongDouble) for name in ("p", "u", "udot"))
        u = _unit(np.where(model.rods[:, None], u, UNIT[:3]))
        self.attitudes, self.rods, self.rod_spin = _unit(p), _unit(turn_of_z(u)), cross(u, udot)
        self.axes = np.array([a for a in angle_axes if a is not None], LongDouble).reshape(len(states), -1, 3)
        self._next_axis = 0
        for k in range(model.n):
            self._add_joint(k)
        ends = np.cumsum([SIZES[link.joint] for link in self.links])
        self.own = [slice(end - SIZES[link.joint], end) for end, link in zip(ends, self.links, strict=True)]
        self.nv = int(ends[-1])
        turns = {"ball": slice(3), "rigid motion": slice(3, 6)}  # places of ω among the coordinates
        self.turns = np.array(
            [
                range(own.start, own.stop)[turns[link.joint]]
                for own, link in zip(self.own, self.links, strict=True)
                if link.joint in turns
            ],
            np.intp,
        ).reshape(-1, 3)
        self.free = [
            own for own, link in zip(self.own, self.links, strict=True) if link.joint == "rigid motion"
        ]
        self.before: list[list[int]] = []  # columns of each link's joint and of those before it
        for link, own in zip(self.links, self.own, strict=True):
            earlier = self.before[link.parent] if link.parent >= 0 else []
            self.before.append([*earlier, *range(own.start, own.stop)])
        self._set_numbers()

    def _add_joint(self, k: int) -> None:
        model, kind = self.model, self.model.kind[k]
        parent = self.of_body[model.body[k, 0]] if model.body[k, 0] >= 0 else -1
        hang, near = (x.astype(LongDouble) for x in model.point[k])
        zero, far, own = np.zeros(3, LongDouble), *_unit(model.turn[k].astype(LongDouble))
        if kind == "rod":
            self._add_ball(parent, hang, zero, k, -1)
            parent = self.of_rod[k] = len(self.links) - 1
            hang = np.array([0, 0, model.length[k]], LongDouble)
        if kind in ("rod", "ball"):
            self._add_ball(parent, hang, near, k, k)
        elif kind == "free" and self.method.free_coordinates == "rigid motion":
            self.links.append(_Link("rigid motion", -1, zero, zero, zero, UNIT, k, k))
        elif kind == "free":
            for axis in np.eye(3, dtype=LongDouble):
                self.links.append(_Link("slide", parent, zero, zero, axis, UNIT, -1, k))
                parent = len(self.links) - 1
            self._add_ball(parent, zero, zero, k, k)
        else:
            last = max(0, len(KINDS[kind].motions) - 1)
            for i, (what, number) in enumerate(KINDS[kind].motions or (("weld", 0),)):
                before, after = far if i == 0 else UNIT, quaternion_conjugate(own) if i == last else UNIT
                axis = rotation_matrix(before)[:, number]
                frame, at = quaternion_product(before, after), near if i == last else zero
                body = k if i == last else -1
                self.links.append(_Link(what, parent, hang, at, axis, frame, body, k, i))
                parent, hang = len(self.links) - 1, zero
        self.of_body.append(len(self.links) - 1)

    def _add_ball(self, parent: int, hang: Array, near: Array, k: int, body: int) -> None:
        """Add a ball, or the turns that it is made of; two for a rod."""
        zero = np.zeros(3, LongDouble)
        if self.method.coordinates == "joint rotations":
            self.links.append(_Link("ball", parent, hang, near, zero, UNIT, body, k))
            return
        before, after, count = (
            self._start_attitude(parent),
            self._start_attitude(None, k, body),
            3 - (body < 0),
        )
        axes = self.axes[:, self._next_axis : self._next_axis + count]
        self._next_axis += count
        for i in range(count):
            is_last = i == count - 1
            axis = rotate_vectors(np.swapaxes(rotation_matrix(before), -1, -2), axes[:, i])
            frame = quaternion_product(quaternion_conjugate(before), after) if is_last else UNIT
            self.links.append(
                _Link(
                    "turn", parent, hang, near if is_last else zero, axis, frame, body if is_last else -1, k
                )
            )
            parent, hang = len(self.links) - 1, zero

    def _start_attitude(self, link: int | None, k: int = -1, body: int = -1) -> Array:
        """Attitude (B, 4) at the start: of a link that is a body or a rod, or of body or rod ``k``."""
        if link is not None:
            if link < 0 or self._is_of_free_body(link):  # along the world's axes
                return np.tile(UNIT, (len(self.states), 1))
            k, body = self.links[link].joint_of, self.links[link].body
        if body >= 0:
            return self.attitudes[:, body]
        return self.rods[:, k]

    def _set_numbers(self) -> None:
        """Take masses, inertias and elements from the model."""
        model, count = self.model, len(self.links)
        self.mass, self.inertia = np.zeros(count, LongDouble), np.zeros((count, 3, 3), LongDouble)
        self.mass[self.of_body], self.inertia[self.of_body] = model.mass, model.inertia
        for k, at in self.of_rod.items():
            if self.links[at].joint == "ball":
                trace = np.trace(model.inertia[k].astype(LongDouble))
                self.inertia[at, 2, 2] = LongDouble(self.method.rod_axial_inertia) * trace
        self.armature, self.damping, self.stiffness, self.rest, self.effort = np.zeros(
            (5, self.nv), LongDouble
        )
        self.ball_springs: list[tuple[int, int]] = []  # link, joint
        for j, (link, own) in enumerate(zip(self.links, self.own, strict=True)):
            k = link.joint_of
            if link.motion >= 0 and link.joint != "weld":
                for name in ("armature", "damping", "stiffness", "rest", "effort"):
                    getattr(self, name)[own] = getattr(model, name)[k, link.motion]
            elif link.joint == "ball" and link.body >= 0 and model.kind[k] == "ball":
                self.armature[own], self.damping[own] = model.armature[k, 0], model.damping[k, 0]
                if model.stiffness[k, 0]:
                    self.ball_springs.append((j, k))

    # -- coordinates ---------------------------------------------------------------------------------

    def start(self) -> tuple[list[Array], Array]:
        """Return the coordinates of the states.

        Returns:
            q, a list over the links, and v (B, nv).

        """
        q: list[Array] = []
        v = np.zeros((len(self.states), self.nv), LongDouble)
        r, rdot, x, xdot, omega = (
            np.array([getattr(s, name) for s in self.states], LongDouble)
            for name in ("r", "v", "x", "xdot", "omega")
        )
        spins = rotate_vectors(rotation_matrix(self.attitudes), omega)
        free_slides = dict.fromkeys(range(self.model.n), 0)
        for link, own in zip(self.links, self.own, strict=True):
            k = link.joint_of
            if link.joint == "weld":
                q.append(np.zeros((len(v), 0), LongDouble))
            elif link.joint == "rigid motion":
                q.append(np.concatenate([self.attitudes[:, k], r[:, k]], -1))
                back = np.swapaxes(rotation_matrix(self.attitudes[:, k]), -1, -2)
                v[:, own] = np.concatenate([rotate_vectors(back, rdot[:, k]), omega[:, k]], -1)
            elif link.joint == "ball":
                before, here = self._start_attitude(link.parent), self._start_attitude(None, k, link.body)
                q.append(quaternion_product(quaternion_conjugate(before), here))
                gained = self._start_spin(link, spins) - self._spin_before(link, spins)
                v[:, own] = rotate_vectors(np.swapaxes(rotation_matrix(here), -1, -2), gained)
            elif link.motion >= 0:
                q.append(x[:, k, link.motion : link.motion + 1])
                v[:, own] = xdot[:, k, link.motion : link.motion + 1]
            elif link.joint == "slide":
                i, free_slides[k] = free_slides[k], free_slides[k] + 1
                q.append(r[:, k, i : i + 1])
                v[:, own] = rdot[:, k, i : i + 1]
            else:
                q.append(np.zeros((len(v), 1), LongDouble))
        self._start_angle_rates(v, spins)
        return q, v

    def _start_spin(self, link: _Link, spins: Array) -> Array:
        """ω (B, 3) of a body or rod at the start, world axes."""
        return np.asarray(spins[:, link.body] if link.body >= 0 else self.rod_spin[:, link.joint_of])

    def _spin_before(self, link: _Link, spins: Array) -> Array:
        if link.parent < 0 or self._is_of_free_body(link.parent):
            return np.zeros_like(spins[:, 0])
        return self._start_spin(self.links[link.parent], spins)

    def _is_of_free_body(self, link: int) -> bool:
        """Whether a link is a slide of a free body."""
        return self.links[link].joint == "slide" and self.links[link].motion < 0

    def _start_angle_rates(self, v: Array, spins: Array) -> None:
        """Set the rates of the turns that balls and rods are made of.

        A rod without inertia takes its axial spin from the link before it; that spin acts on nothing.
        """
        at, left, j = 0, np.zeros((len(v), 3), LongDouble), 0
        while j < len(self.links):
            link = self.links[j]
            if link.joint != "turn" or link.motion >= 0:
                j += 1
                continue
            count = 2 if link.joint_of in self.of_rod and self.of_rod[link.joint_of] == j + 1 else 3
            last = self.links[j + count - 1]
            a, b = self.axes[:, at], self.axes[:, at + 1]
            third = -cross(a, b) if count == 2 else self.axes[:, at + 2]
            gained = self._start_spin(last, spins) - self._spin_before(link, spins)
            found = _solve3(a, b, third, gained - (left if count == 3 else 0))
            v[:, self.own[j].start : self.own[j].start + count] = found[:, :count]
            left = -third * found[:, 2:] if count == 2 else np.zeros_like(left)
            at, j = at + count, j + count

    def move(self, q: list[Array], displacement: Array) -> list[Array]:
        """Displace the coordinates.

        Args:
            displacement: (..., nv), joint by joint: rotation vectors, twists, numbers.

        """
        moved = []
        for link, own, at in zip(self.links, self.own, q, strict=True):
            change = displacement[..., own]
            if link.joint == "ball":
                moved.append(self._turned(at, change))
            elif link.joint == "rigid motion":
                turn = change[..., 3:]
                shift = rotate_vectors(_left_jacobian(turn), change[..., :3])
                point = at[..., 4:] + rotate_vectors(rotation_matrix(at[..., :4]), shift)
                moved.append(np.concatenate([self._turned(at[..., :4], turn), point], -1))
            else:
                moved.append(at + change)
        return moved

    def _turned(self, q: Array, turn: Array) -> Array:
        if self.method.is_rotation_exact:
            return quaternion_product(q, quaternion_exponential(turn / 2))
        return _unit(quaternion_product(q, np.concatenate([np.ones_like(turn[..., :1]), turn / 2], -1)))

    def bracket(self, a: Array, b: Array) -> Array:
        """Return the Lie bracket of displacements, joint by joint: a × b of balls, 0 of numbers.

        Args:
            a: (..., nv).
            b: (..., nv).

        Returns:
            (..., nv).

        """
        found = np.zeros(np.broadcast_shapes(a.shape, b.shape), LongDouble)
        found[..., self.turns] = cross(a[..., self.turns], b[..., self.turns])
        for own in self.free:
            x, y = a[..., own], b[..., own]
            shift = cross(x[..., 3:], y[..., :3]) + cross(x[..., :3], y[..., 3:])
            found[..., own.start : own.start + 3] = shift
        return found

    def displacement_rate(self, theta: Array, v: Array) -> Array:
        """Apply dexp⁻¹(θ) v = Σ Bₖ/k! adₖ(θ) v of displacements on the right (B₁ = ½).

        Args:
            theta: (..., nv), turns of less than 2 rad.
            v: (..., nv).

        Returns:
            θ̇ (..., nv).

        """
        if not len(self.turns):
            return v
        terms = self.method.correction_terms
        once = self.bracket(theta, v)
        total, power = v + (terms is None or terms > 0) * once / 2, once
        if terms is not None and terms < 2:
            return total
        for weight in BERNOULLI[: None if terms is None else 1]:
            power = self.bracket(theta, power)
            total, power = total + weight * power, self.bracket(theta, power)
        return total

    # -- equations -----------------------------------------------------------------------------------

    def pose(self, q: list[Array]) -> Pose:
        """Place the links.

        Returns:
            Their attitudes, points, and the motions of all joints.

        """
        found = Pose([], [], [], [], np.zeros((*q[0].shape[:-1], self.nv, 6), LongDouble), [])
        for link, own, at in zip(self.links, self.own, q, strict=True):
            if link.parent >= 0:
                before, above = found.p[link.parent], found.A[link.parent]
                P = found.r[link.parent] + rotate_vectors(above, link.hang)
            else:
                before, above, P = UNIT, np.eye(3, dtype=LongDouble), link.hang
            axis = rotate_vectors(above, link.axis)
            p = quaternion_product(before, link.frame)
            if link.joint == "turn":
                p = quaternion_product(
                    quaternion_product(before, quaternion_exponential(link.axis * at / 2)), link.frame
                )
            elif link.joint == "slide":
                P = P + axis * at
            elif link.joint in ("ball", "rigid motion"):
                p = quaternion_product(before, at[..., :4])
                P = P + at[..., 4:] if at.shape[-1] > 4 else P
            p = np.broadcast_to(p, (*at.shape[:-1], 4))
            A, P = rotation_matrix(p), np.broadcast_to(P, (*at.shape[:-1], 3))
            found.p.append(p)
            found.A.append(A)
            found.P.append(P)
            found.r.append(P - rotate_vectors(A, link.near))
            _set_columns(found.S[..., own, :], link.joint, axis, A, P)
        return found

    def twists(self, pose: Pose, v: Array) -> tuple[list[Array], list[Array]]:
        """Return the links' twists and what velocities alone add to their rates, (..., 6) each.

        Args:
            v: (..., nv).

        Returns:
            Twists and biases, lists over the links.

        """
        twist: list[Array] = []
        bias: list[Array] = []
        for link, own in zip(self.links, self.own, strict=True):
            gained = np.sum(pose.S[..., own, :] * v[..., own, None], axis=-2)
            before = twist[link.parent] if link.parent >= 0 else np.zeros_like(gained)
            change = spatial_cross(before, gained)
            twist.append(before + gained)
            bias.append(change + (bias[link.parent] if link.parent >= 0 else 0))
        return twist, bias

    def mass_matrix(self, pose: Pose) -> Array:
        """Return M (..., nv, nv), rotors included."""
        S = pose.S
        M = np.zeros((*S.shape[:-1], self.nv), LongDouble)
        total = self._inertias(pose).copy()
        for j in reversed(range(len(self.links))):
            parent, own = self.links[j].parent, self.own[j]
            F = np.swapaxes(total[j] @ np.swapaxes(S[..., own, :], -1, -2), -1, -2)  # (..., own, 6)
            before = self.before[j]
            block = S[..., before, :] @ np.swapaxes(F, -1, -2)
            M[..., before, own] = block
            M[..., own, before] = np.swapaxes(block, -1, -2)
            if parent >= 0:
                total[parent] = total[parent] + total[j]
        index = np.arange(self.nv)
        M[..., index, index] += self.armature
        return np.asarray(M)

    def _inertias(self, pose: Pose) -> list[Array]:
        """Spatial inertias (..., 6, 6) of the links about the world's origin."""
        if not pose.inertias:
            A, arm, mass = np.stack(pose.A), cross_matrix(np.stack(pose.r)), self.mass
            lead = (len(mass), *[1] * (A.ndim - 3))
            mass, inertia = mass.reshape(*lead, 1, 1), self.inertia.reshape(*lead, 3, 3)
            c = mass * arm
            found = np.zeros((*A.shape[:-2], 6, 6), LongDouble)
            found[..., :3, :3] = A @ inertia @ np.swapaxes(A, -1, -2) - c @ arm
            found[..., :3, 3:], found[..., 3:, :3] = c, -c
            found[..., 3:, 3:] = mass * np.eye(3, dtype=LongDouble)
            pose.inertias.extend(found)
        return pose.inertias

    def generalized_forces(self, q: list[Array], pose: Pose, v: Array, forces: Forces = "all") -> Array:
        """Return f (..., nv), or those parts of it that depend on v by drag and dampers.

        Args:
            v: (..., nv).
            forces: "all", "applied" (drag and dampers), or "joint dampers".

        """
        f: Array = -self.damping * v
        if forces == "joint dampers":
            return f
        twist, bias = self.twists(pose, v)
        wrench = [self._applied(pose, twist, j, forces) for j in range(len(self.links))]
        self._add_point_springs(pose, twist, wrench, forces)
        if forces == "all":
            weightless = np.concatenate([np.zeros(3), -self.model.gravity]).astype(LongDouble)
            for j, inertia in enumerate(self._inertias(pose)):
                momentum = rotate_vectors(inertia, twist[j])
                wrench[j] = (
                    wrench[j]
                    - rotate_vectors(inertia, bias[j] + weightless)
                    - _force_cross(twist[j], momentum)
                )
            f = f + self.effort + self._spring_torques(q)
        for j in reversed(range(len(self.links))):
            if self.links[j].parent >= 0:
                wrench[self.links[j].parent] = wrench[self.links[j].parent] + wrench[j]
            own = self.own[j]
            f[..., own] += np.sum(pose.S[..., own, :] * wrench[j][..., None, :], -1)
        return f

    def total_forces(self, q: list[Array], pose: Pose, v: Array) -> Array:
        """Return M v̇.

        Args:
            v: (..., nv).

        Returns:
            (..., nv), of a tree the generalised forces.

        """
        return self.generalized_forces(q, pose, v)

    def _applied(self, pose: Pose, twist: list[Array], j: int, forces: Forces) -> Array:
        """Loads and drag on a link (..., 6)."""
        model, k, r, omega = self.model, self.links[j].body, pose.r[j], twist[j][..., :3]
        if k < 0:
            return np.zeros_like(twist[j])
        force = -LongDouble(model.drag_force[k]) * (twist[j][..., 3:] + cross(omega, r))
        moment = -LongDouble(model.drag_moment[k]) * omega
        if forces == "all":
            force = force + model.force[k].astype(LongDouble)
            moment = moment + rotate_vectors(pose.A[j], model.moment[k].astype(LongDouble))
        return np.concatenate([moment + cross(r, force), force], -1)

    def _add_point_springs(self, pose: Pose, twist: list[Array], wrench: list[Array], forces: Forces) -> None:
        model = self.model
        for i, (bodies, points) in enumerate(zip(model.spring_body, model.spring_point, strict=True)):
            links = [self.of_body[b] if b >= 0 else -1 for b in bodies]
            places, rates = [], []
            for j, point in zip(links, points.astype(LongDouble), strict=True):
                at = pose.r[j] + rotate_vectors(pose.A[j], point) if j >= 0 else point
                places.append(at)
                rates.append(twist[j][..., 3:] + cross(twist[j][..., :3], at) if j >= 0 else 0 * point)
            d, rate = places[1] - places[0], rates[1] - rates[0]
            length = np.sqrt(np.sum(d * d, -1, keepdims=True))
            tension = LongDouble(model.spring_damping[i]) * np.sum(d * rate, -1, keepdims=True) / length
            if forces == "all":
                tension = tension + LongDouble(model.spring_stiffness[i]) * (
                    length - LongDouble(model.spring_length[i])
                )
            for j, at, sign in zip(links, places, (1, -1), strict=True):
                if j >= 0:
                    pull = sign * tension / length * d
                    wrench[j] = wrench[j] + np.concatenate([cross(at, pull), pull], -1)

    def _spring_torques(self, q: list[Array]) -> Array:
        """Torques (..., nv) of the springs of joints."""
        found = np.zeros((*q[0].shape[:-1], self.nv), LongDouble)
        for link, own, at in zip(self.links, self.own, q, strict=True):
            if link.motion >= 0 and link.joint != "weld":
                found[..., own] = -self.stiffness[own] * (at - self.rest[own])
        for j, k in self.ball_springs:
            rest = _unit(ball_spring_rest(self.model, k).astype(LongDouble))
            turn = rotation_vector(quaternion_product(quaternion_conjugate(rest), q[j]))
            found[..., self.own[j]] = -LongDouble(self.model.stiffness[k, 0]) * turn
        return found

    def acceleration(self, q: list[Array], v: Array) -> Array:
        """Return v̇.

        Args:
            v: (..., nv).

        Returns:
            (..., nv).

        """
        pose = self.pose(q)
        return solve_definite(self.mass_matrix(pose), self.total_forces(q, pose, v))

    def damped_acceleration(self, q: list[Array], v: Array, h: Array, forces: Forces) -> Array:
        """Return (M + h D)⁻¹ f with D = −∂f/∂v of some of the forces, in the sparsity of M.

        In "applied" forces, free bodies on which nothing moves have the derivatives of all.

        Args:
            v: (B, nv).
            h: (B, 1) [s].

        Returns:
            (B, nv).

        """
        own = self._standalone_columns() if forces == "applied" else []
        if forces != "all" and not own and not self._has_damping(forces):
            return self.acceleration(q, v)
        pose = self.pose(q)
        if forces == "joint dampers":
            step = h[..., None] * np.diag(LongDouble(self.method.damping_factor) * self.damping)
            return solve_definite(self.mass_matrix(pose) + step, self.total_forces(q, pose, v))
        every = list(range(self.nv))
        D = np.zeros((*v.shape, self.nv), LongDouble)
        if forces == "all" or self._has_damping(forces):
            D[:] = self._force_derivatives(q, pose, v, every, forces)
        if own:
            D[..., own, :] = 0
            D[..., np.array(own)[:, None], own] = self._force_derivatives(q, pose, v, own, "all")[..., own, :]
        D = LongDouble(self.method.damping_factor) * np.where(self._on_one_path(), D, 0)
        if self.method.is_damping_symmetric:
            D = (D + np.swapaxes(D, -1, -2)) / 2
        return solve_definite(self.mass_matrix(pose) + h[..., None] * D, self.total_forces(q, pose, v))

    def _force_derivatives(
        self, q: list[Array], pose: Pose, v: Array, columns: list[int], forces: Forces
    ) -> Array:
        """−∂f/∂v (B, nv, columns); f is quadratic in v: a central difference of any size is exact."""
        units = np.eye(self.nv, dtype=LongDouble)[columns, None]
        before, after = (self.generalized_forces(q, pose, v + sign * units, forces) for sign in (-1, 1))
        return np.asarray(np.moveaxis((before - after) / 2, 0, -1))

    def _has_damping(self, forces: Forces) -> bool:
        """Whether dampers of joints, or any applied forces, depend on velocities."""
        model, of_joints = self.model, bool(np.any(self.damping))
        parts = (model.drag_force, model.drag_moment, model.spring_damping)
        return of_joints or (forces == "applied" and any(np.any(part) for part in parts))

    def _on_one_path(self) -> Array:
        """(nv, nv) whether a branch of the tree has both coordinates: the sparsity of M."""
        found = np.zeros((self.nv, self.nv), bool)
        for own, before in zip(self.own, self.before, strict=True):
            found[own, before] = True
        return found | found.T

    def _standalone_columns(self) -> list[int]:
        """Columns of free bodies with nothing on them but welded bodies."""
        related = self._on_one_path()
        free = [
            self.before[j] for j, kind in zip(self.of_body, self.model.kind, strict=True) if kind == "free"
        ]
        return [i for own in free if np.sum(related[own[0]]) == len(own) for i in own]

    # -- bodies --------------------------------------------------------------------------------------

    def bodies(self, q: list[Array], v: Array) -> LinkStates:
        """Return the motion of the bodies.

        Args:
            v: (B, nv).

        Returns:
            Positions, attitudes, rates, and coordinates of joints.

        """
        pose, n = self.pose(q), self.model.n
        twist, _ = self.twists(pose, v)
        r, p = (np.stack([y[j] for j in self.of_body], -2) for y in (pose.r, pose.p))
        spin, origin = (
            np.stack([twist[j][..., part] for j in self.of_body], -2) for part in (slice(3), slice(3, 6))
        )
        u, udot, x, xdot = (np.zeros((*v.shape[:-1], n, size), LongDouble) for size in (3, 3, 2, 2))
        for k, j in self.of_rod.items():
            u[..., k, :] = pose.A[j][..., 2]
            udot[..., k, :] = cross(twist[j][..., :3], u[..., k, :])
        for link, own, at in zip(self.links, self.own, q, strict=True):
            if link.motion >= 0 and link.joint != "weld":
                x[..., link.joint_of, link.motion] = at[..., 0]
                xdot[..., link.joint_of, link.motion] = v[..., own.start]
        omega = rotate_vectors(np.swapaxes(rotation_matrix(p), -1, -2), spin)
        return LinkStates(r, p, origin + cross(spin, r), omega, u, udot, x, xdot)

    def body_accelerations(self) -> tuple[Array, Array]:
        """Return r̈ (B, N, 3), world axes, and ω̇′ (B, N, 3), body axes, at the states.

        Returns:
            Both [m/s², rad/s²].

        """
        q, v = self.start()
        pose = self.pose(q)
        rates = solve_definite(self.mass_matrix(pose), self.total_forces(q, pose, v))
        twist, bias = self.twists(pose, v)
        gained: list[Array] = []
        for link, own in zip(self.links, self.own, strict=True):
            change = np.sum(pose.S[..., own, :] * rates[..., own, None], axis=-2)
            gained.append(change + (gained[link.parent] if link.parent >= 0 else 0))
        linear, angular = [], []
        for j in self.of_body:
            total, w = gained[j] + bias[j], twist[j][..., :3]
            velocity = twist[j][..., 3:] + cross(w, pose.r[j])
            linear.append(total[..., 3:] + cross(total[..., :3], pose.r[j]) + cross(w, velocity))
            angular.append(rotate_vectors(np.swapaxes(pose.A[j], -1, -2), total[..., :3]))
        return np.stack(linear, -2), np.stack(angular, -2)


def _set_columns(columns: Array, joint: str, axis: Array, A: Array, P: Array) -> None:
    """Set the twists (..., size, 6) of a joint."""
    if joint == "slide":
        columns[..., 0, 3:] = axis
    elif joint == "turn":
        columns[..., 0, :3], columns[..., 0, 3:] = axis, cross(P, axis)
    elif joint in ("ball", "rigid motion"):
        axes, first = np.swapaxes(A, -1, -2), columns.shape[-2] - 3
        columns[..., first:, :3], columns[..., first:, 3:] = axes, cross(P[..., None, :], axes)
        columns[..., :first, 3:] = axes[..., :first, :]


# Bₖ/k! of even k from 2 on: 1/12, −1/720, …
BERNOULLI = [
    LongDouble(a) / b
    for a, b in (
        (1, 12), (-1, 720), (1, 30240), (-1, 1209600), (1, 47900160), (-691, 1307674368000),
        (1, 74724249600), (-3617, 10670622842880000),
    )
]  # fmt: skip


# -- algebra in extended precision -------------------------------------------------------------------


def spatial_cross(a: Array, b: Array) -> Array:
    """Return the rate of a twist that is carried by another.

    Args:
        a: (..., 6) the twist that carries.
        b: (..., 6) the carried one.

    Returns:
        (..., 6).

    """
    w, v = a[..., :3], a[..., 3:]
    return np.concatenate([cross(w, b[..., :3]), cross(w, b[..., 3:]) + cross(v, b[..., :3])], -1)


def _force_cross(a: Array, f: Array) -> Array:
    """Rate of a wrench f that is carried by the twist a."""
    w, v = a[..., :3], a[..., 3:]
    return np.concatenate([cross(w, f[..., :3]) + cross(v, f[..., 3:]), cross(w, f[..., 3:])], -1)


def _left_jacobian(t: Array) -> Array:
    """V (..., 3, 3) with exp(twist) = (exp(t), V ρ): 1 + (1 − cos θ)/θ² t̃ + (θ − sin θ)/θ³ t̃²."""
    square = np.sum(t * t, -1)[..., None, None]
    angle, small = np.sqrt(square), square < 1e-4
    safe = np.where(small, LongDouble(1), angle)
    first = np.where(
        small, 0.5 - square / 24 + square**2 / 720 - square**3 / 40320, (1 - np.cos(safe)) / safe**2
    )
    sixth = LongDouble(1) / 6
    second = np.where(
        small, sixth - square / 120 + square**2 / 5040 - square**3 / 362880, (safe - np.sin(safe)) / safe**3
    )
    skew = cross_matrix(t)
    return np.asarray(np.eye(3, dtype=LongDouble) + first * skew + second * (skew @ skew))


def _unit(x: Array) -> Array:
    return np.asarray(x / np.sqrt(np.sum(x * x, -1, keepdims=True)))


def solve_definite(S: Array, b: Array) -> Array:
    """Solve S x = b without pivoting.

    Args:
        S: (..., n, n), its symmetric part positive definite.
        b: (..., n).

    Returns:
        x (..., n).

    """
    S, b = S.copy(), b.copy()
    n = S.shape[-1]
    for k in range(n - 1):
        factor = S[..., k + 1 :, k] / S[..., k, k, None]
        S[..., k + 1 :, k + 1 :] -= factor[..., None] * S[..., k, None, k + 1 :]
        b[..., k + 1 :] -= factor * b[..., k, None]
    for k in reversed(range(n)):
        b[..., k] = (b[..., k] - np.sum(S[..., k, k + 1 :] * b[..., k + 1 :], -1)) / S[..., k, k]
    return b


def _solve3(a: Array, b: Array, c: Array, x: Array) -> Array:
    """Coefficients (..., 3) of x in three vectors: Cramer's rule."""
    bc = cross(b, c)
    parts = [np.sum(x * bc, -1), np.sum(x * cross(c, a), -1), np.sum(x * cross(a, b), -1)]
    return np.asarray(np.stack(parts, -1) / np.sum(a * bc, -1)[..., None])
