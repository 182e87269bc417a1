"""Pinocchio in minimal coordinates: a chain of spherical joints.

Frames, quaternion order and offsets.  Joint frame k is at body k's proximal point with the body's axes, so
in it the centre of mass is at c = -proximal_k and the next joint at distal_k - proximal_k.  A rod is a
spherical joint too: its frame is where the rod hangs, its z axis along u, the child's joint at
(0, 0, length).  Its body has no mass, and inertia about its own axis only, which is exact while the rod does
not spin about that axis: it starts without, and gains none but the integrator's error.

With a, b the absolute attitudes of a joint's parent and of itself (quaternions, scalar first) and W their
angular velocities, each in its own frame, Pinocchio's coordinates of joint j are

    q_j = (a⁻¹ b) as (x, y, z, w),        v_j = W_b - R(a⁻¹ b)ᵀ W_a,        W_rod = R(b)ᵀ (u × udot).

Applied loads enter as `fext`, force and moment on the joint's body, in and about its frame:

    f = Rᵀ (F - c_t ṙ),        n = n′ - c_r ω′ + c × f.

Accelerations come from `crba` with a dense solve in state evaluation and in dop853, from `aba` in the two
fixed-step integrators (which are `plumbline.engines.integrators`: Pinocchio has none).  The two agree on
short chains.  On long ones `aba` (4.1.0) loses digits that the problem does not cost, because the
articulated inertias that it passes to the parent lose their symmetry, about threefold a body: 5e-14 m/s²
off on the catalogue's ten balls, 2e-8 on thirty, 8e-3 on fifty, where `crba` is below 2e-11 throughout
(tests/adapters/test_pinocchio_engine.py).  An error-controlled integrator stalls on noise of that size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import pinocchio as pin
from scipy.linalg import lapack

from adapters.pinocchio_common import (
    PinocchioAdapter,
    add_frame,
    append_parts,
    configuration_rate,
    energies_and_momentum,
    point_acceleration,
    translation,
)
from plumbline.engines.integrators import dop853, rkmk4, sample_steps, semi_implicit_euler
from plumbline.model.datatypes import Array, Integrator, Model, State, StateQuantities, Trajectory
from plumbline.model.kinematics import (
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    rotation_matrix,
)
from plumbline.model.step_methods import JointSpaceMethod, classical_runge_kutta
from plumbline.model.welding import BodyParts, undivided_bodies

ROD_AXIAL_INERTIA = 1 / 3  # of a rod about its own axis, over the trace of the inertia that it carries
MAX_DENSE_JOINTS = 10  # joints up to which their 3 × 3 blocks are solved faster as one matrix
FIXED_STEPS = {"semi-implicit-euler": semi_implicit_euler, "rkmk4": rkmk4}


class PinocchioChain:
    """A `Model` as Pinocchio's model and data, and the map between their coordinates.

    nj joints: one per body and one more per rod, each spherical, the parent of j being j - 1.
    q is (4 nj,), v is (3 nj,) in Pinocchio's conventions.  ``algorithm`` finds the accelerations: "crba"
    solves with the engine's mass matrix densely, "cholesky" with its own sparse factors, "forwardDynamics"
    in its solver for constraints, of which there are none, "aba" and "aba-world" are its articulated-body
    algorithm in local and in world coordinates.
    """

    def __init__(self, model: Model, algorithm: str, parts: BodyParts | None = None):
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
                axial = np.diag([0.0, 0.0, ROD_AXIAL_INERTIA * np.trace(model.inertia[k])])
                massless = pin.Inertia(0.0, np.zeros(3), axial)
                self.pin_model.appendBodyToJoint(joint, massless, pin.SE3.Identity())
                hang = np.array([0.0, 0.0, model.length[k]])
            joint = self._add_spherical_joint(joint, hang, f"body {k}")
            append_parts(self.pin_model, joint, parts[k], -model.proximal[k])
            self.com_frames.append(add_frame(self.pin_model, f"com {k}", joint, -model.proximal[k]))
            self.body_joints.append(joint)
            hang = model.distal[k] - model.proximal[k]
        self.data = self.pin_model.createData()
        self.joint_count = self.pin_model.njoints - 1
        self.body_rows = np.array(self.body_joints) - 1  # rows of the bodies among the joints
        self.rod_rows = np.setdiff1d(np.arange(self.joint_count), self.body_rows)
        self.com_placements = [translation(-s) for s in model.proximal]
        self.zero_torque = np.zeros(self.pin_model.nv)
        self._init_loads()

    def _add_spherical_joint(self, parent: int, offset: Array, name: str) -> int:
        return int(self.pin_model.addJoint(parent, pin.JointModelSpherical(), translation(offset), name))

    def _init_loads(self) -> None:
        """Set `fext` to the constant loads; a moment is constant in the joint's frame, the others vary."""
        model = self.source_model
        self.fext = pin.StdVec_Force()
        for _ in range(self.pin_model.njoints):
            self.fext.append(pin.Force.Zero())
        for k, j in enumerate(self.body_joints):
            self.fext[j] = pin.Force(np.zeros(3), model.moment[k])
        varying = np.any(model.force != 0, axis=1) | (model.drag_force != 0) | (model.drag_moment != 0)
        self.bodies_with_varying_loads = [int(k) for k in np.flatnonzero(varying)]

    def coordinates(self, state: State) -> tuple[Array, Array]:
        """Map a state to Pinocchio's coordinates.

        Args:
            state: a state of the model.

        Returns:
            q (4 nj,) and v (3 nj,).

        """
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

    def _absolute_attitudes(self, q: Array) -> Array:
        """Return the attitudes (T, nj, 4) of the joints, scalar first, at configurations q (T, 4 nj)."""
        p = np.roll(q.reshape(len(q), self.joint_count, 4), 1, axis=2)
        for j in range(1, self.joint_count):
            p[:, j] = quaternion_product(p[:, j - 1], p[:, j])
        return p

    def update_loads(self, q: Array, v: Array) -> None:
        """Set `fext` to the loads at a state.

        Args:
            q: configuration (4 nj,).
            v: velocity (3 nj,).

        """
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
        """Evaluate the accelerations under gravity and loads, by the chosen algorithm.

        Args:
            q: configuration (4 nj,).
            v: velocity (3 nj,).

        Returns:
            v̇ (3 nj,).

        """
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
        """Apply dexp⁻¹ of θ to a velocity, joint by joint.

        Args:
            q: configuration (4 nj,).
            theta: exponential coordinates θ (3 nj,) of a configuration near q.
            v: velocity (3 nj,) there.

        Returns:
            θ̇ (3 nj,) with d/dt integrate(q, θ) = v.

        """
        dexp = pin.dIntegrate(self.pin_model, q, theta, pin.ArgumentPosition.ARG1)
        if self.joint_count <= MAX_DENSE_JOINTS:
            return np.asarray(lapack.dgesv(dexp, v)[2])
        each = np.arange(self.joint_count)
        blocks = dexp.reshape(self.joint_count, 3, self.joint_count, 3)[each, :, each, :]  # the rest is zero
        return np.linalg.solve(blocks, v.reshape(-1, 3, 1)).ravel()

    def integrate(self, q: Array, displacement: Array) -> Array:
        """Move a configuration along a tangent vector, by the engine's `integrate`.

        Args:
            q: configuration (4 nj,).
            displacement: tangent vector (3 nj,) [rad].

        Returns:
            The configuration reached (4 nj,).

        """
        return np.asarray(pin.integrate(self.pin_model, q, displacement))

    def configuration_rate(self, q: Array, v: Array) -> Array:
        """Map a velocity to the rate of the configuration.

        Args:
            q: configuration (4 nj,).
            v: velocity (3 nj,).

        Returns:
            q̇ (4 nj,).

        """
        return configuration_rate(self.pin_model, q, v)

    def normalize(self, q: Array) -> Array:
        """Normalise the quaternions of a configuration; `aba` takes any quaternion for a unit one.

        Args:
            q: configuration (4 nj,).

        Returns:
            The same with quaternions of unit length.

        """
        return np.asarray(pin.normalize(self.pin_model, q))

    def quantities(self, state: State) -> StateQuantities:
        """Evaluate all state quantities.

        Args:
            state: a state of the model.

        Returns:
            The quantities, in the project's frames.

        """
        engine, data = self.pin_model, self.data
        q, v = self.coordinates(state)
        a = self.acceleration(q, v)
        pin.forwardKinematics(engine, data, q, v, a)
        pin.updateFramePlacements(engine, data)
        acceleration = [point_acceleration(engine, data, f) for f in self.com_frames]
        angular = [data.a[j].angular.copy() for j in self.body_joints]
        turn = [data.oMi[j].rotation.copy() for j in self.body_joints]
        pin.rnea(engine, data, q, v, a, self.fext)
        reaction = [r @ data.f[j].linear for r, j in zip(turn, self.body_joints, strict=True)]
        return StateQuantities(
            acceleration=np.array(acceleration),
            angular_acceleration=np.array(angular),
            joint_reaction=np.array(reaction),
            **energies_and_momentum(engine, data, q, v),
            mass_matrix=self._mass_matrix(state, q),
        )

    def _mass_matrix(self, state: State, q: Array) -> Array:
        """Return the mass matrix (nu, nu) of ν = (udot of rods, ω′ of bodies): (T S)ᵀ M (T S).

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
        """Map samples to the bodies' positions, attitudes and rates.

        Args:
            times: sample times (T,) [s].
            q: configurations (T, 4 nj).
            v: velocities (T, 3 nj).
            steps: number of steps taken.

        Returns:
            The trajectory in the project's frames.

        """
        shape = (len(times), self.source_model.n, 3)
        r, rdot, omega = np.empty(shape), np.empty(shape), np.empty(shape)
        for i in range(len(times)):
            pin.forwardKinematics(self.pin_model, self.data, q[i], v[i])
            for k, (j, centre) in enumerate(zip(self.body_joints, self.com_placements, strict=True)):
                pose, motion = self.data.oMi[j], centre.actInv(self.data.v[j])
                r[i, k] = pose.act(centre.translation)
                rdot[i, k] = pose.rotation @ motion.linear
                omega[i, k] = motion.angular
        p = self._absolute_attitudes(q)[:, self.body_rows]
        return Trajectory(t=times, r=r, p=p, v=rdot, pdot=quaternion_rate(p, omega), steps=steps)


def rod_quaternion(u: Array) -> Array:
    """Choose an attitude for a rod: half a turn about e_z + u, which takes e_z to u.

    Where u points down it is the shortest turn from -e_z after half a turn about x, to stay away from 0/0.

    Args:
        u: unit vector (3,), world frame.

    Returns:
        A unit quaternion (4,), scalar first, that turns e_z into u.

    """
    if u[2] >= 0:
        p = np.array([1 + u[2], -u[1], u[0], 0.0])
    else:
        p = quaternion_product(np.array([1 - u[2], u[1], -u[0], 0.0]), np.array([0.0, 1.0, 0.0, 0.0]))
    return np.asarray(p / np.linalg.norm(p))


class Pinocchio(PinocchioAdapter):
    """Pinocchio on a chain of spherical joints; each integrator uses the algorithm that its note names."""

    name = "pinocchio"
    title = "Pinocchio"
    reproduction_template = "pinocchio"
    other_formulation = "pinocchio-maximal"
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator(
            "semi-implicit-euler",
            "step",
            1,
            error_exponents=(1, 2, 3, 4, 5),
            note="v += h a(q, v) by aba, then q = integrate(q, h v)",
            method=JointSpaceMethod("semi-implicit Euler", "joint rotations", ROD_AXIAL_INERTIA),
        ),
        Integrator(
            "rkmk4",
            "step",
            4,
            error_exponents=(4, 5, 6, 7, 8),
            note="Munthe-Kaas form of the classical Runge–Kutta method, on aba, integrate and dIntegrate",
            method=classical_runge_kutta("joint rotations", ROD_AXIAL_INERTIA),
        ),
        Integrator("dop853", "tolerance", 8, note="SciPy's DOP853 on (q, v) with crba and the tangent map"),
    )
    options: ClassVar[tuple[str, ...]] = ("cholesky", "forwardDynamics")
    usual_algorithm: ClassVar[str] = "crba"  # for the accelerations of state evaluation

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        chain = PinocchioChain(model, self.option or self.usual_algorithm, self.body_pieces(model))
        return [chain.quantities(state) for state in states]

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        chain = PinocchioChain(model, "crba" if integrator.kind == "tolerance" else "aba")
        start = chain.coordinates(state)
        if integrator.kind == "tolerance":
            return chain.trajectory(times, *dop853(chain, *start, times, resolution))
        step = FIXED_STEPS[integrator.name]
        samples = sample_steps(lambda qv: step(chain, *qv, resolution), start, times, resolution)
        q, v = (np.array(column) for column in zip(*samples, strict=True))
        return chain.trajectory(times, q, v, round(float(times[-1] / resolution)))


class PinocchioAba(Pinocchio):
    """State quantities with accelerations by `aba`: the engine's other algorithm, a column of its own."""

    name = "pinocchio-aba"
    title = "Pinocchio (aba)"
    other_formulation = ""
    integrators = ()
    unsupported: ClassVar[Mapping[str, str]] = {
        "integrators": "another algorithm of Pinocchio is compared at state level only"
    }
    options = ("crba",)
    usual_algorithm = "aba"
