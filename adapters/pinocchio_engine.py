"""Pinocchio in minimal coordinates: a chain of spherical joints.

Pinocchio has no time integrator; the three here are built on its `integrate`, `dIntegrate` and
`tangentMapProduct`.  Accelerations come from `aba` in the two fixed-step integrators and from
`crba` with a dense solve in state evaluation and in dop853.  The two agree on short chains; on long
ones `aba` (4.1.0) loses digits that the problem does not ask for, because the articulated inertias
it passes to the parent lose their symmetry, about threefold a body: 5e-14 m/s² off on the
catalogue's ten balls, 2e-8 on thirty, 8e-3 on fifty, where crba is below 2e-11 throughout
(tests/adapters/test_pinocchio_engine.py).  An error-controlled integrator stalls on noise of that size.

The map.  Joint frame k sits at body k's proximal point with the body's axes, so in it the
centre of mass is at c = -proximal_k and the next joint at distal_k - proximal_k.  A rod is a
spherical joint too, its frame where the rod hangs, its z axis along u, the child's joint at
(0, 0, length).  Its body has no mass and inertia about its own axis only, which is exact while
the rod does not spin about that axis: it starts without, and gains none but the integrator's error.
With a, b the absolute attitudes of a joint's parent and of itself (quaternions) and W their angular
velocities, each in its own frame,

    q_j = (a⁻¹ b) as (x, y, z, w),        v_j = W_b - R(a⁻¹ b)ᵀ W_a,        W_rod = R(b)ᵀ (u × udot).

Applied loads enter as `fext`: force and moment on the joint's body, in and about its frame,

    f = Rᵀ (F - c_t ṙ),        n = n′ - c_r ω′ + c × f.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal, Self, cast

import numpy as np
import pinocchio as pin
from scipy.integrate import DOP853
from scipy.linalg import lapack

from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
)
from plumbline.model.kinematics import (
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    rotation_matrix,
)
from plumbline.model.welding import BodyParts, undivided_bodies

WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
MAX_DENSE_JOINTS = 10  # joints up to which their 3 × 3 blocks are solved faster as one matrix
Algorithm = Literal["aba", "aba-world", "crba", "cholesky", "forwardDynamics"]


class PinocchioChain:
    """A `Model` as Pinocchio's model and data, and the map between their coordinates.

    nj joints: one per body and one more per rod, each spherical, the parent of j being j - 1.
    q is (4 nj,), v is (3 nj,) in Pinocchio's conventions.
    """

    def __init__(self, model: Model, algorithm: Algorithm, parts: BodyParts | None = None):
        self.source_model, self.algorithm = model, algorithm
        parts = parts or undivided_bodies(model)
        self.pin_model = pin.Model()
        self.pin_model.gravity = pin.Motion(model.gravity, np.zeros(3))
        self.body_joints: list[int] = []  # joint of body k
        self.com_frames: list[int] = []  # frame at body k's centre of mass
        joint, hang = 0, np.zeros(3)
        for k in range(model.n):
            if model.length[k] > 0:
                joint = self._add_spherical_joint(joint, hang, f"rod {k}")
                # Any axial inertia does; this one keeps its place among the others when units change.
                axial = np.diag([0.0, 0.0, np.trace(model.inertia[k]) / 3])
                self.pin_model.appendBodyToJoint(
                    joint, pin.Inertia(0.0, np.zeros(3), axial), pin.SE3.Identity()
                )
                hang = np.array([0.0, 0.0, model.length[k]])
            joint = self._add_spherical_joint(joint, hang, f"body {k}")
            centre = pin.SE3(np.eye(3), -model.proximal[k])
            for part in parts[k]:  # the engine welds what is appended to one joint
                inertia = pin.Inertia(part.mass, np.zeros(3), part.inertia)
                place = pin.SE3(np.eye(3), part.centre - model.proximal[k])
                self.pin_model.appendBodyToJoint(joint, inertia, place)
            frame = pin.Frame(f"com {k}", joint, centre, pin.FrameType.OP_FRAME)
            self.com_frames.append(self.pin_model.addFrame(frame))
            self.body_joints.append(joint)
            hang = model.distal[k] - model.proximal[k]
        self.data = self.pin_model.createData()
        self.joint_count = self.pin_model.njoints - 1
        self.body_rows = np.array(self.body_joints) - 1  # rows of the bodies among the joints
        self.rod_rows = np.setdiff1d(np.arange(self.joint_count), self.body_rows)
        self.com_placements = [pin.SE3(np.eye(3), -s) for s in model.proximal]
        self.zero_torque = np.zeros(self.pin_model.nv)
        self.fext = pin.StdVec_Force()
        for _ in range(self.pin_model.njoints):
            self.fext.append(pin.Force.Zero())
        for k, j in enumerate(self.body_joints):
            self.fext[j] = pin.Force(np.zeros(3), model.moment[k])
        # A constant moment is constant in the joint's frame; the others change from stage to stage.
        changing = np.any(model.force != 0, axis=1) | (model.drag_force != 0) | (model.drag_moment != 0)
        self.bodies_with_varying_loads = [int(k) for k in np.flatnonzero(changing)]

    def _add_spherical_joint(self, parent: int, offset: Array, name: str) -> int:
        return int(
            self.pin_model.addJoint(parent, pin.JointModelSpherical(), pin.SE3(np.eye(3), offset), name)
        )

    def coordinates(self, state: State) -> tuple[Array, Array]:
        """(q, v) of a state."""
        attitude, spin = np.empty((self.joint_count, 4)), np.empty((self.joint_count, 3))
        attitude[self.body_rows], spin[self.body_rows] = state.p, state.omega
        for j, k in zip(self.rod_rows, np.flatnonzero(self.source_model.rods), strict=True):
            attitude[j] = rod_quaternion(state.u[k])
            spin[j] = rotation_matrix(attitude[j]).T @ np.cross(state.u[k], state.udot[k])
            spin[j, 2] = 0.0  # the rod does not spin about itself; here it is a rounding of zero
        relative = attitude.copy()
        relative[1:] = quaternion_product(quaternion_conjugate(attitude[:-1]), attitude[1:])
        v = spin.copy()
        v[1:] -= np.matvec(rotation_matrix(relative[1:]).mT, spin[:-1])
        return np.roll(relative, -1, axis=1).ravel(), v.ravel()

    def absolute_attitudes(self, q: Array) -> Array:
        """Attitudes (T, nj, 4) of the joints, scalar first, of configurations q (T, 4 nj)."""
        p = np.roll(q.reshape(len(q), self.joint_count, 4), 1, axis=2)
        for j in range(1, self.joint_count):
            p[:, j] = quaternion_product(p[:, j - 1], p[:, j])
        return p

    def update_loads(self, q: Array, v: Array) -> None:
        """Set `fext` to the loads at (q, v)."""
        if not self.bodies_with_varying_loads:
            return
        pin.forwardKinematics(self.pin_model, self.data, q, v)
        model = self.source_model
        for k in self.bodies_with_varying_loads:
            j, centre = self.body_joints[k], self.com_placements[k]
            motion = centre.actInv(self.data.v[j])  # of the centre of mass, body axes
            force = self.data.oMi[j].rotation.T @ model.force[k] - model.drag_force[k] * motion.linear
            moment = model.moment[k] - model.drag_moment[k] * motion.angular
            self.fext[j] = centre.act(pin.Force(force, moment))

    def acceleration(self, q: Array, v: Array) -> Array:
        """v̇ (3 nj,) under gravity and loads, by the chosen algorithm."""
        self.update_loads(q, v)
        if self.algorithm in ("crba", "cholesky", "forwardDynamics"):
            engine, data = self.pin_model, self.data
            bias = pin.rnea(engine, data, q, v, self.zero_torque, self.fext)
            if self.algorithm == "forwardDynamics":  # it counts the velocity terms and gravity itself
                force, no_rows = pin.nonLinearEffects(engine, data, q, v) - bias, np.zeros((0, engine.nv))
                return np.asarray(pin.forwardDynamics(engine, data, q, v, force, no_rows, np.zeros(0), 0.0))
            mass = pin.crba(engine, data, q)
            if self.algorithm == "crba":
                return np.linalg.solve(mass, -bias)
            pin.cholesky.decompose(engine, data)  # along the tree's branches: sparse
            return np.ravel(pin.cholesky.solve(engine, data, -bias))
        convention = pin.Convention.WORLD if self.algorithm == "aba-world" else pin.Convention.LOCAL
        return np.asarray(pin.aba(self.pin_model, self.data, q, v, self.zero_torque, self.fext, convention))

    def exponential_coordinate_rate(self, q: Array, theta: Array, v: Array) -> Array:
        """θ̇ (3 nj,) with d/dt integrate(q, θ) = v: dexp⁻¹ of θ applied to v, joint by joint."""
        dexp = pin.dIntegrate(self.pin_model, q, theta, pin.ArgumentPosition.ARG1)
        if self.joint_count <= MAX_DENSE_JOINTS:
            return np.asarray(lapack.dgesv(dexp, v)[2])
        each = np.arange(self.joint_count)
        blocks = dexp.reshape(self.joint_count, 3, self.joint_count, 3)[each, :, each, :]  # the rest is zero
        return np.linalg.solve(blocks, v.reshape(-1, 3, 1)).ravel()

    def quantities(self, state: State) -> StateQuantities:
        """All state quantities at one state."""
        engine, data = self.pin_model, self.data
        q, v = self.coordinates(state)
        a = self.acceleration(q, v)
        pin.forwardKinematics(engine, data, q, v, a)
        pin.updateFramePlacements(engine, data)
        acceleration = [
            pin.getFrameClassicalAcceleration(engine, data, f, WORLD_ALIGNED).linear for f in self.com_frames
        ]
        angular = [data.a[j].angular.copy() for j in self.body_joints]
        turn = [data.oMi[j].rotation.copy() for j in self.body_joints]
        pin.rnea(engine, data, q, v, a, self.fext)
        reaction = [r @ data.f[j].linear for r, j in zip(turn, self.body_joints, strict=True)]
        kinetic = pin.computeKineticEnergy(engine, data, q, v)
        potential = pin.computePotentialEnergy(engine, data, q)
        momentum = pin.computeCentroidalMomentum(engine, data, q, v)
        return StateQuantities(
            acceleration=np.array(acceleration),
            angular_acceleration=np.array(angular),
            joint_reaction=np.array(reaction),
            kinetic_energy=float(kinetic),
            potential_energy=float(potential),
            angular_momentum=momentum.angular + np.cross(data.com[0], momentum.linear),
            mass_matrix=self.mass_matrix(state, q),
        )

    def mass_matrix(self, state: State, q: Array) -> Array:
        """(nu, nu) mass matrix of ν = (udot of rods, ω′ of bodies): (T S)ᵀ M (T S).

        v = T W takes absolute rates W to joint rates, W = S ν takes ν to absolute rates.
        """
        relative = rotation_matrix(np.roll(q.reshape(-1, 4), 1, axis=1))
        t = np.eye(3 * self.joint_count)
        for j in range(1, self.joint_count):
            t[3 * j : 3 * j + 3, 3 * j - 3 : 3 * j] = -relative[j].T
        s = np.zeros((3 * self.joint_count, 3 * self.joint_count))
        for i, (j, k) in enumerate(zip(self.rod_rows, np.flatnonzero(self.source_model.rods), strict=True)):
            s[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = rotation_matrix(
                rod_quaternion(state.u[k])
            ).T @ pin.skew(state.u[k])
        for i, j in enumerate(self.body_rows, start=len(self.rod_rows)):
            s[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = np.eye(3)
        m, ts = pin.crba(self.pin_model, self.data, q), t @ s
        return np.asarray(ts.T @ m @ ts)

    def trajectory(self, times: Array, q: Array, v: Array, steps: int) -> Trajectory:
        """Samples of the bodies at configurations q (T, 4 nj) with rates v (T, 3 nj)."""
        shape = (len(times), self.source_model.n, 3)
        r, rdot, omega = np.empty(shape), np.empty(shape), np.empty(shape)
        for i in range(len(times)):
            pin.forwardKinematics(self.pin_model, self.data, q[i], v[i])
            for k, (j, centre) in enumerate(zip(self.body_joints, self.com_placements, strict=True)):
                pose, motion = self.data.oMi[j], centre.actInv(self.data.v[j])
                r[i, k] = pose.act(centre.translation)
                rdot[i, k] = pose.rotation @ motion.linear
                omega[i, k] = motion.angular
        p = self.absolute_attitudes(q)[:, self.body_rows]
        return Trajectory(t=times, r=r, p=p, v=rdot, pdot=quaternion_rate(p, omega), steps=steps)


def rod_quaternion(u: Array) -> Array:
    """A unit quaternion whose rotation takes e_z to the unit vector u: half a turn about e_z + u.

    Where u points down the shortest turn is from -e_z, after half a turn about x, to stay away from 0/0.
    """
    if u[2] >= 0:
        p = np.array([1 + u[2], -u[1], u[0], 0.0])
    else:
        p = quaternion_product(np.array([1 - u[2], u[1], -u[0], 0.0]), np.array([0.0, 1.0, 0.0, 0.0]))
    return np.asarray(p / np.linalg.norm(p))


def semi_implicit_euler(chain: PinocchioChain, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """v₁ = v + h a(q, v), q₁ = q ⊕ h v₁."""
    v = v + h * chain.acceleration(q, v)
    return pin.integrate(chain.pin_model, q, h * v), v


def rkmk4(chain: PinocchioChain, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """The classical Runge–Kutta step for θ̇ = dexp⁻¹(θ) v, v̇ = a(q ⊕ θ, v) from θ = 0.

    Munthe-Kaas, Appl. Numer. Math. 29 (1999) 115–127.  With θ̇ = v instead the order would be 2.
    """

    def slope(theta: Array, w: Array) -> tuple[Array, Array]:
        return chain.exponential_coordinate_rate(q, theta, w), chain.acceleration(
            pin.integrate(chain.pin_model, q, theta), w
        )

    a1, b1 = v, chain.acceleration(q, v)
    a2, b2 = slope(h / 2 * a1, v + h / 2 * b1)
    a3, b3 = slope(h / 2 * a2, v + h / 2 * b2)
    a4, b4 = slope(h * a3, v + h * b3)
    theta = h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return pin.integrate(chain.pin_model, q, theta), v + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)


def configuration_rate(model: pin.Model, q: Array, v: Array) -> Array:
    """q̇ (nq,) of a velocity v (nv,)."""
    if hasattr(pin, "tangentMapProduct"):
        return np.asarray(pin.tangentMapProduct(model, q, v[:, None])).ravel()
    p = np.roll(q.reshape(-1, 4), 1, axis=1)  # before 4.0: of spherical joints, ½ q v
    return np.roll(quaternion_rate(p, v.reshape(-1, 3)), -1, axis=1).ravel()


def dop853(chain: PinocchioChain, q: Array, v: Array, times: Array, rtol: float) -> tuple[Array, Array, int]:
    """Rows (T, 4 nj) and (T, 3 nj) and the number of steps of q̇ = tangentMap(q) v, v̇ = a(q, v).

    Steps end at every sample time.  The quaternions integrated are not normalised; the
    accelerations are taken at q/|q|, for `aba` takes any quaternion for a unit one.
    """
    nq = len(q)

    def field(_: float, y: Array) -> Array:
        q, v = y[:nq], y[nq:]
        a = chain.acceleration(pin.normalize(chain.pin_model, q), v)
        return np.concatenate([configuration_rate(chain.pin_model, q, v), a])

    y, steps = np.concatenate([q, v]), 0
    rows = [y]
    solver = DOP853(field, 0.0, y, times[-1], rtol=rtol, atol=rtol)
    for time in times[1:]:
        solver.t_bound, solver.status = time, "running"
        while solver.status == "running":
            message = solver.step()
            steps += 1
        if solver.status == "failed":
            raise EngineFailure(f"dop853 stopped at t = {solver.t} s: {message}")
        rows.append(solver.y.copy())
    return np.array(rows)[:, :nq], np.array(rows)[:, nq:], steps


class Pinocchio(MetamorphicHooks):
    """Pinocchio on a chain of spherical joints.

    ``algorithm`` chooses how state evaluation finds accelerations: "crba" solves with the engine's
    mass matrix densely, "cholesky" with its own sparse factors, "forwardDynamics" in its solver for
    constraints without any, "aba" and "aba-world" are its articulated-body algorithm in local and in world
    coordinates.  The integrators keep to the algorithm their note names.
    """

    name: ClassVar[str] = "pinocchio"
    title: ClassVar[str] = "Pinocchio"
    package: ClassVar[str] = "pin"
    reproduction_template = "pinocchio"
    other_formulation = "pinocchio-maximal"
    supported_versions = ">=3.3.1,<5"
    extra_requirements = (
        ("<4", "cmeel-urdfdom<5"),
        ("<4", "cmeel-tinyxml2<11"),
    )  # what those wheels were linked with
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator(
            "semi-implicit-euler",
            "step",
            1,
            error_exponents=(1, 2, 3, 4, 5),
            note="v += h a(q, v) by aba, then q = integrate(q, h v)",
        ),
        Integrator(
            "rkmk4",
            "step",
            4,
            error_exponents=(4, 5, 6, 7, 8),
            note="Munthe-Kaas form of the classical Runge–Kutta method, on aba, integrate and dIntegrate",
        ),
        Integrator("dop853", "tolerance", 8, note="SciPy's DOP853 on (q, v) with crba and the tangent map"),
    )

    options: ClassVar[tuple[Algorithm, ...]] = ("cholesky", "forwardDynamics")
    welding_unsupported_reason = ""

    def __init__(self, algorithm: Algorithm = "crba"):
        self.algorithm: Algorithm = algorithm

    def with_option(self, option: str) -> Self:
        """The same engine by another of its algorithms."""
        other = super().with_option(option)
        other.algorithm = cast(Algorithm, option)
        return other

    def version(self) -> str:
        """Version of the pin wheel."""
        return str(pin.__version__)

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        chain = PinocchioChain(model, self.algorithm, self.body_pieces(model))
        return [chain.quantities(state) for state in states]

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        chain = PinocchioChain(model, "crba" if integrator.kind == "tolerance" else "aba")
        q, v = chain.coordinates(state)
        if integrator.kind == "tolerance":
            return chain.trajectory(times, *dop853(chain, q, v, times, resolution))
        step = semi_implicit_euler if integrator.name == "semi-implicit-euler" else rkmk4
        at = np.rint(times / resolution).astype(int)
        rows = [(q, v)]
        for count in np.diff(at):
            for _ in range(count):
                q, v = step(chain, q, v, resolution)
            rows.append((q, v))
        qs, vs = (np.array(column) for column in zip(*rows, strict=True))
        return chain.trajectory(times, qs, vs, int(at[-1]))


class PinocchioAba(Pinocchio):
    """State quantities with accelerations by `aba`: the engine's other algorithm, a column of its own."""

    name = "pinocchio-aba"
    title = "Pinocchio (aba)"
    other_formulation = ""
    integrators: ClassVar[tuple[Integrator, ...]] = ()
    options = ("crba",)

    def __init__(self) -> None:
        super().__init__("aba")
