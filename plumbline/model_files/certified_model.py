"""Certified quantities of a neutral model (a URDF or MJCF file) at given states, with bounds of rounding.

By `plumbline.equations` in balls, on the joints of `plumbline.importers.neutral_model`.  The bound of an
engine's rounding is made of the magnitudes of the terms, so that it does not vanish where terms cancel: with
ℓ_b the length of the path from the world to the centre of mass of body b (offsets, anchors, displacements),
W_b and V_b the sums of the rates of rotations and of slides on that path, u_bi = ℓ_b for a rotation on the
path and 1 for a slide, w_bi = 1 for a rotation,

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

from plumbline.equations.arithmetic import balls, entries, flatten, midpoints
from plumbline.equations.tree import Tree
from plumbline.importers.neutral_model import CanonicalState, ElementaryJoint, ModelQuantities, NeutralModel
from plumbline.model.datatypes import KINDS, WELD, Array, Float, Kind, Model
from plumbline.model.kinematics import quaternion_conjugate, quaternion_product
from plumbline.truth import import_truth_tool

ROUNDING_FACTOR = 16.0
EPSILON = 2.0**-53
ROUGH_BITS = 64
START_BITS, MAX_BITS = 192, 2048  # 128 are too few for a robot of 30 joints, and hardly faster
MAX_RELATIVE_RADIUS = 1e-22  # of the magnitudes of the terms
FLOOR = 2.0**-30  # of the largest entry, where the terms vanish exactly but not in an engine's frames
MAX_LOSS = 0.1  # of M v̇ by rounding: beyond it doubles do not determine v̇
FORCES = ("gravity_force", "bias_force", "passive_force")  # one number per velocity
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
            found, poses = _enclose(_BallModel(flint, model, state))
            middle = {name: midpoints(ball) for name, ball in found.items() if ball is not None}
        certified = _with_tolerances(model, state, poses, middle)
        sharp = all(
            float(x.rad()) <= MAX_RELATIVE_RADIUS * max(limit, MIN_MAGNITUDE)
            for name, ball in found.items()
            if ball
            for x, limit in zip(flatten(ball), np.ravel(certified.tolerance[name]), strict=True)
        )
        if (sharp and found["acceleration"] is not None) or bits >= MAX_BITS:
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
        there = _BallModel(flint, model, state)
        matrix = midpoints(there.full_mass_matrix().tolist()) if model.velocity_count else np.zeros((0, 0))
        return ModelQuantities(there.poses(), matrix)


class _BallModel(Tree):
    """A model at a state in balls, as a mechanism of links.

    Each elementary joint carries a link of its own, a body without joints a welded one; the last link of a
    body has its mass.  A free joint carries the body's frame, on which the body is welded.  Attitudes of
    bodies and axes of joints, which doubles would round, are balls.
    """

    def __init__(self, flint: Any, model: NeutralModel, state: CanonicalState) -> None:
        self.flint, self.neutral, self.at = flint, model, state
        links: list[tuple[Kind, int, ElementaryJoint | None]] = []  # kind, far link, joint
        self.owner: list[int] = []  # body of each link
        self.last: list[int] = []  # by body its last link
        for k, body in enumerate(model.bodies):
            far = self.last[body.parent] if body.parent >= 0 else -1
            joints: list[ElementaryJoint | None] = [*body.joints]
            if not body.joints or body.joints[-1].kind == "free":
                joints.append(None)
            for joint in joints:
                is_free = joint is not None and joint.kind == "free"
                kind: Kind = WELD if joint is None else joint.kind
                links.append((kind, -1 if is_free else far, joint))
                self.owner.append(k)
                far = len(links) - 1
            self.last.append(far)
        self.joint = [joint for _, _, joint in links]
        places = {id(joint): (x, v) for joint, x, v in model.joint_slices()}
        none = slice(0, 0)
        self.place = [places.get(id(joint), (none, none)) for joint in self.joint]
        count, is_last = len(links), np.isin(np.arange(len(links)), self.last)
        bodies = [model.bodies[k] for k in self.owner]
        mechanism = Model(
            mass=np.where(is_last, [body.mass for body in bodies], 0.0),
            inertia=np.array([body.inertia for body in bodies]).reshape(-1, 3, 3) * is_last[:, None, None],
            kind=tuple(kind for kind, _, _ in links),
            body=np.array([[far, k] for k, (_, far, _) in enumerate(links)], np.intp).reshape(-1, 2),
            point=np.zeros((count, 2, 3)), turn=np.zeros((count, 2, 4)), length=np.zeros(count),
            gravity=model.gravity, force=np.zeros((count, 3)), moment=np.zeros((count, 3)),
            drag_force=np.zeros(count), drag_moment=np.zeros(count),
        )  # fmt: skip
        super().__init__(balls(flint), mechanism, None)  # type: ignore[arg-type]

    def _is_first(self, k: int) -> bool:
        """Whether link k is the first of its body."""
        return k == 0 or self.owner[k - 1] != self.owner[k]

    def _center(self, k: int) -> Any:
        """From the origin of the body's frame to the centre of mass of link k."""
        return self.num.vector(self.neutral.bodies[self.owner[k]].center if k in self.last else np.zeros(3))

    def joint_point(self, k: int, side: int) -> Any:
        num, body, joint = self.num, self.neutral.bodies[self.owner[k]], self.joint[k]
        anchor = self.zero if joint is None else num.vector(joint.anchor)
        if side:
            return anchor - self._center(k)
        if self._is_first(k):
            anchor = num.vector(body.position) + num.mul(self.rotation(body.attitude), anchor)
        return anchor - self._center(self.far[k]) if self.far[k] >= 0 else anchor

    def joint_axes(self, k: int, side: int) -> Any:
        num, joint = self.num, self.joint[k]
        axes = self.one
        if joint is not None and np.any(joint.axis):
            across = np.eye(3)[int(np.argmin(np.abs(joint.axis)))]
            z = self._unit(num.vector(joint.axis))
            x = self._unit(num.cross(num.vector(across), z))
            axes = num.columns([x, num.cross(z, x), z])
        if side or not self._is_first(k):
            return axes
        return num.mul(self.rotation(self.neutral.bodies[self.owner[k]].attitude), axes)

    def _unit(self, v: Any) -> Any:
        return v * (1 / self.num.sqrt(self.num.dot(v, v)))

    def coordinate(self, k: int, i: int) -> tuple[Any, Any]:
        joint, num, (x, v) = self.joint[k], self.num, self.place[k]
        assert joint is not None
        return (num.scalar(self.at.coordinates[x][i]) - num.scalar(joint.reference),
                num.scalar(self.at.velocities[v][i]))  # fmt: skip

    def attitude(self, k: int) -> tuple[Any, Any]:
        num, (x, v), far = self.num, self.place[k], self.far[k]
        A, spin = self.rotation(self.at.coordinates[x][-4:]), num.vector(self.at.velocities[v][-3:])
        if KINDS[self.model.kind[k]].is_spherical:
            axes = self.joint_axes(k, 0)
            A = num.mul(axes if far < 0 else num.mul(self.A[far], axes), A)
        spin = num.mul(A, spin)
        return A, spin if far < 0 else self.w[far] + spin

    def free_point(self, k: int) -> tuple[Any, Any]:
        x, v = self.place[k]
        return self.num.vector(self.at.coordinates[x][:3]), self.num.vector(self.at.velocities[v][:3])

    def full_mass_matrix(self) -> Any:
        """M with armatures, empty where nothing moves."""
        if not self.neutral.velocity_count:
            return self.flint.arb_mat(0, 0)
        M = self.mass_matrix(is_relative=True)
        for i, (armature, _) in enumerate(_armature_and_rate(self.neutral, self.at)):
            M[i, i] = M[i, i] + self.num.scalar(armature)
        return M

    def forces(self) -> tuple[list[Any], list[Any]]:
        """The forces that the joints need at v̇ = 0, and those of gravity alone."""
        num, g, needed, weights = self.num, self.num.vector(self.model.gravity), [], []
        for k, (a, alpha) in enumerate(zip(*self.coasting(), strict=True)):
            m, w = num.scalar(self.model.mass[k]), self.w[k]
            J = num.mul(num.mul(self.A[k], self.inertia(k)), num.transpose(self.A[k]))
            moment = num.mul(J, alpha) + num.cross(w, num.mul(J, w))
            needed.append(((a - g) * m, moment))
            weights.append((-g * m, self.zero))
        h, gravity = (
            [x for part in self.joint_forces(each) for x in entries(part)] for each in (needed, weights)
        )
        return h, gravity

    def poses(self) -> dict[str, Array]:
        """Rotations and places of the bodies' frames, (3, 4)."""
        found = {}
        for body, k in zip(self.neutral.bodies, self.last, strict=True):
            origin = self.r[k] - self.num.mul(self.A[k], self._center(k))
            rows = zip(self.A[k].tolist(), origin.tolist(), strict=True)
            found[body.name] = midpoints([[*row, *place] for row, place in rows])
        return found


def _enclose(c: _BallModel) -> tuple[dict[str, Any], dict[str, Array]]:
    """Enclose every quantity; the acceleration is None where M has no inverse at this precision."""
    M, (h, gravity), passive = c.full_mass_matrix(), c.forces(), _passive(c)
    arb, mat, moving = c.flint.arb, c.flint.arb_mat, [False] * c.model.n
    potential = arb(0)
    for k, joint in enumerate(c.joint):
        moving[k] = joint is not None or (c.far[k] >= 0 and moving[c.far[k]])
        if moving[k]:
            potential -= arb(float(c.model.mass[k])) * c.num.dot(c.num.vector(c.model.gravity), c.r[k])
    speed = mat(len(h), 1, [arb(float(v)) for v in c.at.velocities])
    momentum = M * speed
    kinetic = sum((a * b for a, b in zip(entries(momentum), entries(speed), strict=True)), arb(0)) / 2
    rates: list[Any] = []
    if gravity:
        try:
            rates = entries(M.solve(mat(len(h), 1, [f - b for f, b in zip(passive, h, strict=True)])))
        except ZeroDivisionError:
            rates = []
        rates = rates if all(rate.is_finite() for rate in rates) else []
    found = {
        "mass_matrix": M.tolist() if gravity else [],
        "bias_force": h,
        "gravity_force": gravity,
        "passive_force": passive,
        "acceleration": rates if rates or not gravity else None,
        "kinetic_energy": [kinetic],
        "potential_energy": [potential],
    }
    return found, c.poses()


def _armature_and_rate(model: NeutralModel, state: CanonicalState) -> list[tuple[float, float]]:
    return [
        (joint.armature, float(state.velocities[i]))
        for joint, _, v in model.joint_slices()
        for i in range(v.start, v.stop)
    ]


def _passive(c: _BallModel) -> list[Any]:
    """Forces of dampers and springs."""
    force: list[Any] = []
    for joint, xs, vs in c.neutral.joint_slices():
        x, rate = c.at.coordinates[xs], c.at.velocities[vs]
        damping, stiffness = c.num.scalar(joint.damping), c.num.scalar(joint.stiffness)
        if joint.kind in ("hinge", "slide"):
            stretched = [c.num.scalar(x[0]) - c.num.scalar(joint.spring_reference)]
        elif joint.kind == "ball":
            stretched = _rotation_vector(c, x)
        else:
            body = next(body for body in c.neutral.bodies if joint in body.joints)
            turn = quaternion_product(quaternion_conjugate(body.attitude), x[3:])
            stretched = entries(c.num.vector(x[:3]) - c.num.vector(body.position)) + _rotation_vector(c, turn)
        force += [-damping * c.num.scalar(v) - stiffness * s for v, s in zip(rate, stretched, strict=True)]
    return force


def _rotation_vector(c: _BallModel, q: Array) -> list[Any]:
    """The rotation vector of a quaternion, of the rotation by at most π."""
    scalar, vector = c.num.scalar(abs(q[0])), c.num.vector(-q[1:] if q[0] < 0 else q[1:])
    if not np.any(q[1:]):
        return entries(vector)
    length = c.num.sqrt(c.num.dot(vector, vector))
    return entries(vector * (2 * c.flint.arb.atan2(length, scalar) / length))


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
        "kinetic_energy": unit * float(speed @ size.mass_matrix @ speed),
        "potential_energy": 2 * unit * size.potential,
    }
    tolerance |= {name: unit * getattr(size, name) for name in ("mass_matrix", *FORCES)}
    if a is not None:
        work = size.mass_matrix @ np.abs(a) + size.bias_force + size.passive_force
        scale = np.sqrt(np.maximum(np.diag(M), MIN_MAGNITUDE))  # slides and turns, long and short arms
        scales = np.outer(scale, scale)
        inverse = np.abs(np.linalg.pinv(M / scales)) if n else M
        tolerance["acceleration"] = unit * (inverse / scales @ work)
        loss = unit * np.max(inverse @ (size.mass_matrix / scales) @ np.ones(n), initial=0.0)
        a = a if loss <= MAX_LOSS else None
    found: dict[str, Any] = {name: middle[name] for name in FORCES}
    found |= {name: float(middle[name][0]) for name in ("kinetic_energy", "potential_energy")}
    return CertifiedModelQuantities(ModelQuantities(poses, M, acceleration=a, **found), tolerance)
