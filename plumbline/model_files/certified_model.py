"""Certified quantities of a neutral model (a URDF or MJCF file) at given states, with bounds of rounding.

On the joints of `plumbline.importers.neutral_model`, in ball arithmetic: composite rigid bodies for M,
recursive Newton–Euler for h.  The bound of an engine's rounding is made of the
magnitudes of the terms, so that it does not vanish where terms cancel: with ℓ_b the length of the path from
the world to the centre of mass of body b (offsets, anchors, displacements), W_b and V_b the sums of the rates
of rotations and of slides on that path, u_bi = ℓ_b for a rotation on the path and 1 for a slide, w_bi = 1 for
a rotation,

    |M|_ij = Σ_b m_b u_bi u_bj + ‖J_b‖ w_bi w_bj        |g|_i = Σ_b m_b u_bi g
    |h|_i  = |g|_i + Σ_b m_b u_bi (ℓ_b W_b² + 2 W_b V_b) + ‖J_b‖ w_bi W_b²
    |v̇|    = |M⁻¹| (|M| |v̇| + |h| + |f|)

Of the damping in |f|, a ball's or free joint's three rates have one magnitude, their norm: engines have them
in other axes.

The tolerance is `ROUNDING_FACTOR` ε (1 + depth) times these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from plumbline.importers.neutral_model import CanonicalState, ElementaryJoint, ModelQuantities, NeutralModel
from plumbline.model.datatypes import Array, Float
from plumbline.model.kinematics import quaternion_conjugate, quaternion_product
from plumbline.truth import import_truth_tool
from plumbline.truth.ball_geometry import entries, flatten, midpoints
from plumbline.truth.joint_tree import JointTree

ROUNDING_FACTOR = 16.0
EPSILON = 2.0**-53
ROUGH_BITS = 64
START_BITS, MAX_BITS = 192, 2048  # 128 are too few for a robot of 30 joints, and hardly faster
MAX_RELATIVE_RADIUS = 1e-22  # of the magnitudes of the terms
FLOOR = 2.0**-30  # of the largest entry, where the terms vanish exactly but not in an engine's frames
MAX_LOSS = 0.1  # of M v̇ by rounding: beyond it doubles do not determine v̇
MIN_MAGNITUDE = 1e-300  # so that terms that are all zero have a radius to compare with


@dataclass(frozen=True, eq=False)
class CertifiedModelQuantities:
    """Quantities of a model at one state, and how far rounding may put an engine from them."""

    quantities: ModelQuantities  # midpoints; acceleration is None where the mass matrix is singular
    tolerance: Mapping[str, Any]  # by quantity, arrays of its shape; poses: by body name


def certify_model(model: NeutralModel, state: CanonicalState) -> CertifiedModelQuantities:
    """Compute every quantity of a model at one state, correct to the last digit of a double.

    Args:
        model: a tree of bodies.
        state: canonical coordinates and velocities of its joints.

    Returns:
        The quantities in canonical velocities, with tolerances.

    Raises:
        TruthUnavailable: python-flint is not installed.

    """
    flint = import_truth_tool("flint")
    bits = START_BITS
    while True:
        with flint.ctx.workprec(bits):
            balls, poses = _enclose(_BallModel(flint, model, state))
            middle = {name: midpoints(ball) for name, ball in balls.items() if ball is not None}
        certified = _with_tolerances(model, state, poses, middle)
        sharp = all(
            float(x.rad()) <= MAX_RELATIVE_RADIUS * max(limit, MIN_MAGNITUDE)
            for name, ball in balls.items()
            if ball
            for x, limit in zip(flatten(ball), np.ravel(certified.tolerance[name]), strict=True)
        )
        if (sharp and balls["acceleration"] is not None) or bits >= MAX_BITS:
            return certified
        bits *= 4


def rough_quantities(model: NeutralModel, state: CanonicalState) -> ModelQuantities:
    """Compute poses and the mass matrix alone, about as exactly as doubles are, in a third of the time.

    Args:
        model: a tree of bodies.
        state: canonical coordinates and velocities of its joints.

    Raises:
        TruthUnavailable: python-flint is not installed.

    """
    flint = import_truth_tool("flint")
    with flint.ctx.workprec(ROUGH_BITS):
        balls = _BallModel(flint, model, state)
        n, (M, _) = model.velocity_count, balls.joint_mass_matrix()
        matrix = np.array(midpoints(M.tolist() if n else []), float).reshape(n, n)
    armatures = [armature for armature, _ in _armature_and_rate(model, state)]
    return ModelQuantities(_poses(balls), matrix + np.diag(np.array(armatures, float)))


class _BallModel(JointTree):
    """Model and state in balls; names as in `JointTree`, and per body: frame origin o, velocities, bias."""

    def __init__(self, flint: Any, model: NeutralModel, state: CanonicalState) -> None:
        super().__init__(flint)
        self.model, self.state, self.n = model, state, len(model.bodies)
        self.far = [body.parent for body in model.bodies]
        self.m = [self.arb(float(body.mass)) for body in model.bodies]
        self.J = [self.matrix(body.inertia) for body in model.bodies]
        self.g = self.vector(model.gravity)
        self.A, self.r, self.S = [], [], []
        self.o: list[Any] = []
        self.w: list[Any] = []
        self.v: list[Any] = []  # of the frame's origin
        self.alpha: list[Any] = []  # angular acceleration at ν̇ = 0
        self.a: list[Any] = []  # acceleration of the frame's origin at ν̇ = 0
        places = iter(model.joint_slices())
        for k, body in enumerate(model.bodies):
            self._place(k)
            columns = []
            for joint, x, v in (next(places) for _ in body.joints):
                columns.append(self._move(joint, state.coordinates[x], state.velocities[v]))
            twists = [self.twist_columns(P, part) for P, part in columns]
            self.S.append(
                self.mat([[M[i, j] for M in twists for j in range(M.ncols())] for i in range(6)])
                if twists
                else self.mat(6, 0)
            )
            self.r.append(self.o[k] + self.A[k] * self.vector(body.center))

    def _place(self, k: int) -> None:
        """Put body k where it is before its joints move it."""
        body, far = self.model.bodies[k], self.far[k]
        A, arm = self.rotation(body.attitude), self.vector(body.position)
        if far < 0:
            self._append(A, arm, self.zero, self.zero, self.zero, self.zero)
            return
        arm = self.A[far] * arm
        state = self._carried(arm, self.o[far], self.w[far], self.v[far], self.alpha[far], self.a[far])
        self._append(self.A[far] * A, *state)

    def _append(self, *state: Any) -> None:
        for values, value in zip((self.A, self.o, self.w, self.v, self.alpha, self.a), state, strict=True):
            values.append(value)

    def _carried(self, arm: Any, o: Any, w: Any, v: Any, alpha: Any, a: Any) -> tuple[Any, ...]:
        """Origin, rates and bias of the point at ``arm`` from a point of a rigid body."""
        spin = self.cross_matrix(w)
        return o + arm, w, v + spin * arm, alpha, a + self.cross_matrix(alpha) * arm + spin * (spin * arm)

    def _move(self, joint: ElementaryJoint, x: Array, rate: Array) -> tuple[Any, list[Any]]:
        """Move the last body by one joint; return a point and the motions there."""
        A, state = self.A[-1], tuple(q[-1] for q in (self.o, self.w, self.v, self.alpha, self.a))
        rates = [self.arb(float(r)) for r in rate]
        if joint.kind == "free":
            A = self.rotation(x[3:])
            w = A * self.mat(3, 1, rates[3:])
            P = self.vector(x[:3])
            state = P, w, self.mat(3, 1, rates[:3]), self.zero, self.zero
            columns = [(self.zero, e) for e in self.units] + [(A * e, self.zero) for e in self.units]
        elif joint.kind == "slide":
            axis = A * self.unit(joint.axis)
            shift = axis * (self.arb(float(x[0])) - self.arb(joint.reference))
            P, w, v, alpha, a = self._carried(shift, *state)
            cross = self.cross_matrix(w)
            state = P, w, v + axis * rates[0], alpha, a + cross * axis * (2 * rates[0])
            columns = [(self.zero, axis)]
        else:
            anchor = self.vector(joint.anchor)
            P, w, v, alpha, a = self._carried(A * anchor, *state)
            if joint.kind == "hinge":
                u = self.unit(joint.axis)
                spin = A * u * rates[0]
                columns = [(A * u, self.zero)]
                A = A * self.turn_about(u, self.arb(float(x[0])) - self.arb(joint.reference))
            else:
                A = A * self.rotation(x)
                spin = A * self.mat(3, 1, rates)
                columns = [(A * e, self.zero) for e in self.units]
            alpha, w = alpha + self.cross_matrix(w) * spin, w + spin
            state = self._carried(A * anchor * -1, P, w, v, alpha, a)
        for values, value in zip(
            (self.A, self.o, self.w, self.v, self.alpha, self.a), (A, *state), strict=True
        ):
            values[-1] = value
        return P, columns

    def unit(self, axis: Array) -> Any:
        """An axis as a vector of length one."""
        u = self.vector(axis)
        return u * (1 / self.dot(u, u).sqrt())

    def turn_about(self, u: Any, angle: Any) -> Any:
        """The rotation about a unit vector: 1 + ũ sin φ + ũ² (1 − cos φ)."""
        cross = self.cross_matrix(u)
        return self.eye + cross * angle.sin() + cross * cross * (1 - angle.cos())

    def bias(self, k: int) -> tuple[Any, Any, Any]:
        """Acceleration of the centre of mass at ν̇ = 0, its velocity, and the inertia in world axes."""
        arm = self.r[k] - self.o[k]
        _, _, v, _, a = self._carried(arm, self.o[k], self.w[k], self.v[k], self.alpha[k], self.a[k])
        return a, v, self.A[k] * self.J[k] * self.A[k].transpose()

    def wrench(self, k: int, moment: Any, force: Any) -> Any:
        """A moment and a force at the centre of mass, about the world's origin."""
        return self.mat(6, 1, [*entries(moment + self.cross_matrix(self.r[k]) * force), *entries(force)])


def _enclose(c: _BallModel) -> tuple[dict[str, Any], dict[str, Array]]:
    """Enclose every quantity; the acceleration is None where M has no inverse at this precision."""
    M, _ = c.joint_mass_matrix()
    wrenches, weights, kinetic, potential = [], [], c.arb(0), c.arb(0)
    moving = [False] * c.n
    for k in range(c.n):
        moving[k] = bool(c.S[k].ncols()) or (c.far[k] >= 0 and moving[c.far[k]])
        a, v, inertia = c.bias(k)
        spin = inertia * c.w[k]
        moment = inertia * c.alpha[k] + c.cross_matrix(c.w[k]) * spin
        wrenches.append(c.wrench(k, moment, (a - c.g) * c.m[k]))
        weights.append(c.wrench(k, c.zero, c.g * (-c.m[k])))
        kinetic += (c.m[k] * c.dot(v, v) + c.dot(c.w[k], spin)) / 2
        if moving[k]:
            potential -= c.m[k] * c.dot(c.g, c.r[k])
    h, gravity = (
        [x for k, sum_ in enumerate(c.subtree_sums(parts)) for x in entries(c.S[k].transpose() * sum_)]
        for parts in (wrenches, weights)
    )
    rates: list[Any] = []
    for i, (value, rate) in enumerate(_armature_and_rate(c.model, c.state)):
        M[i, i] = M[i, i] + c.arb(value)
        kinetic += c.arb(value) * c.arb(rate) * c.arb(rate) / 2
    passive = _passive(c)
    if gravity:
        try:
            rates = entries(M.solve(c.mat(len(h), 1, [f - b for f, b in zip(passive, h, strict=True)])))
        except ZeroDivisionError:
            rates = []
        rates = rates if all(rate.is_finite() for rate in rates) else []
    balls = {
        "mass_matrix": M.tolist() if gravity else [],
        "bias_force": h,
        "gravity_force": gravity,
        "passive_force": passive,
        "acceleration": rates if rates or not gravity else None,
        "kinetic_energy": [kinetic],
        "potential_energy": [potential],
    }
    return balls, _poses(c)


def _poses(c: _BallModel) -> dict[str, Array]:
    return {
        body.name: np.array(
            [[float(c.A[k][i, j].mid()) for j in range(3)] + [float(c.o[k][i, 0].mid())] for i in range(3)]
        )
        for k, body in enumerate(c.model.bodies)
    }


def _armature_and_rate(model: NeutralModel, state: CanonicalState) -> list[tuple[float, float]]:
    return [
        (joint.armature, float(state.velocities[i]))
        for joint, _, v in model.joint_slices()
        for i in range(v.start, v.stop)
    ]


def _passive(c: _BallModel) -> list[Any]:
    """Forces of dampers and springs."""
    force: list[Any] = []
    for joint, xs, vs in c.model.joint_slices():
        x, rate = c.state.coordinates[xs], c.state.velocities[vs]
        damping, stiffness = c.arb(joint.damping), c.arb(joint.stiffness)
        if joint.kind in ("hinge", "slide"):
            stretched = [c.arb(float(x[0])) - c.arb(joint.spring_reference)]
        elif joint.kind == "ball":
            stretched = _rotation_vector(c, x)
        else:
            body = next(body for body in c.model.bodies if joint in body.joints)
            turn = quaternion_product(quaternion_conjugate(body.attitude), x[3:])
            stretched = entries(c.vector(x[:3]) - c.vector(body.position)) + _rotation_vector(c, turn)
        force += [-damping * c.arb(float(v)) - stiffness * s for v, s in zip(rate, stretched, strict=True)]
    return force


def _rotation_vector(c: _BallModel, q: Array) -> list[Any]:
    """The rotation vector of a quaternion, of the rotation by at most π."""
    scalar, vector = c.arb(float(q[0])), c.vector(q[1:])
    if float(q[0]) < 0:
        scalar, vector = -scalar, vector * -1
    length = c.dot(vector, vector).sqrt()
    if not np.any(q[1:]):
        return entries(vector)
    return entries(vector * (2 * c.arb.atan2(length, scalar) / length))


@dataclass(frozen=True, eq=False)
class _Magnitudes:
    """Sums of the magnitudes of the terms of each quantity, as the module's docstring defines them."""

    length: Array  # (bodies,) m, with the way to centres of mass, by which engines place bodies
    turns: Array  # (bodies,) number of frames on the path, and the angles' sum
    mass_matrix: Float[Array, "n n"]
    bias_force: Float[Array, "n"]
    gravity_force: Array
    passive_force: Array
    potential: float  # J


def _magnitudes(model: NeutralModel, state: CanonicalState) -> _Magnitudes:
    count, n, g = len(model.bodies), model.velocity_count, float(np.linalg.norm(model.gravity))
    path, turns, rate, slide, reach = (np.zeros(count) for _ in range(5))
    over = np.zeros((count, n))  # 1 for rotations, −1 for slides on the path of a body
    M, h, gravity, passive, potential = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n), 0.0
    places = iter(model.joint_slices())
    for k, body in enumerate(model.bodies):
        if body.parent >= 0:
            for values in (path, turns, rate, slide, over):
                values[k] = values[body.parent]
        path[k] += float(np.linalg.norm(body.position))
        turns[k] += 1
        for joint, xs, vs in (next(places) for _ in body.joints):
            x, v = state.coordinates[xs], state.velocities[vs]
            is_slide = np.array(
                {"slide": [1], "free": [1, 1, 1, 0, 0, 0]}.get(joint.kind, [0] * len(v)), bool
            )
            over[k, vs] = np.where(is_slide, -1, 1)
            rate[k] += float(np.linalg.norm(v[~is_slide]))
            slide[k] += float(np.linalg.norm(v[is_slide]))
            path[k] += 2 * float(np.linalg.norm(joint.anchor))
            stretch = np.abs(x).max() + abs(joint.reference)
            if joint.kind in ("slide", "free"):
                path[k] += float(np.linalg.norm(x[:3])) + abs(joint.reference)
            turns[k] += 1 + (stretch if joint.kind == "hinge" else 0)
            speed = np.where(is_slide, np.linalg.norm(v[is_slide]), np.linalg.norm(v[~is_slide]))
            passive[vs] = joint.damping * speed + joint.stiffness * (
                stretch + abs(joint.spring_reference) + np.pi
            )
        ell, J = path[k] + float(np.linalg.norm(body.center)), float(np.linalg.norm(body.inertia))
        reach[k] = max(ell, reach[body.parent] if body.parent >= 0 else 0.0)
        u, w = np.where(over[k] > 0, ell, -over[k]), over[k] > 0
        M += body.mass * np.outer(u, u) + J * np.outer(w, w)
        gravity += body.mass * u * g
        h += body.mass * u * (g + ell * rate[k] ** 2 + 2 * rate[k] * slide[k]) + J * w * rate[k] ** 2
        potential += body.mass * g * ell
    for i, (armature, _) in enumerate(_armature_and_rate(model, state)):
        M[i, i] += armature
    sums = _with_fixed_parts(model, reach), M, h, gravity
    length, M, h, gravity = (terms + FLOOR * np.max(terms, initial=0.0) for terms in sums)
    return _Magnitudes(length, turns, M, h, gravity, passive, potential)


def _with_fixed_parts(model: NeutralModel, reach: Array) -> Array:
    """Let the way to a body go through what is fixed to it and to those below it: engines lump them."""
    found = reach.copy()
    for k, body in reversed([*enumerate(model.bodies)]):
        if body.parent >= 0 and not body.joints:
            found[body.parent] = max(found[body.parent], found[k])
    for k, body in enumerate(model.bodies):
        if body.parent >= 0:
            found[k] = max(found[k], found[body.parent])
    return found


def pose_tolerances(model: NeutralModel, state: CanonicalState) -> dict[str, Array]:
    """Bound how far rounding may put an engine's bodies from where they are.

    Args:
        model: a tree of bodies.
        state: canonical coordinates and velocities of its joints.

    Returns:
        By body name the bounds of rotation matrix and position (3, 4) [1 and m]; none is zero unless the
        whole model lies in the world's origin.

    """
    return _pose_tolerances(model, _magnitudes(model, state))


def _pose_tolerances(model: NeutralModel, size: _Magnitudes) -> dict[str, Array]:
    return {
        body.name: _unit(size) * np.tile([1.0, 1.0, 1.0, length], (3, 1))
        for body, length in zip(model.bodies, size.length, strict=True)
    }


def _unit(size: _Magnitudes) -> float:
    """The rounding of one sum of terms, relative to their magnitudes."""
    return ROUNDING_FACTOR * EPSILON * (1 + float(np.max(size.turns, initial=0.0)))


def _with_tolerances(
    model: NeutralModel, state: CanonicalState, poses: dict[str, Array], middle: dict[str, Array]
) -> CertifiedModelQuantities:
    """Attach the tolerances to the midpoints."""
    size = _magnitudes(model, state)
    unit = _unit(size)
    n, speed = model.velocity_count, np.abs(state.velocities)
    M, a = middle["mass_matrix"].reshape(n, n), middle.get("acceleration")
    tolerance: dict[str, Any] = {
        "poses": _pose_tolerances(model, size),
        "mass_matrix": unit * size.mass_matrix,
        "bias_force": unit * size.bias_force,
        "gravity_force": unit * size.gravity_force,
        "passive_force": unit * size.passive_force,
        "kinetic_energy": unit * float(speed @ size.mass_matrix @ speed),
        "potential_energy": 2 * unit * size.potential,
    }
    if a is not None:
        work = size.mass_matrix @ np.abs(a) + size.bias_force + size.passive_force
        scale = np.sqrt(np.maximum(np.diag(M), MIN_MAGNITUDE))  # slides and turns, long and short arms
        scales = np.outer(scale, scale)
        inverse = np.abs(np.linalg.pinv(M / scales)) if n else M
        tolerance["acceleration"] = unit * (inverse / scales @ work)
        loss = unit * np.max(inverse @ (size.mass_matrix / scales) @ np.ones(n), initial=0.0)
        a = a if loss <= MAX_LOSS else None
    quantities = ModelQuantities(
        poses=poses, mass_matrix=M, bias_force=middle["bias_force"], gravity_force=middle["gravity_force"],
        passive_force=middle["passive_force"], acceleration=a,
        kinetic_energy=float(middle["kinetic_energy"][0]),
        potential_energy=float(middle["potential_energy"][0]),
    )  # fmt: skip
    return CertifiedModelQuantities(quantities, tolerance)
