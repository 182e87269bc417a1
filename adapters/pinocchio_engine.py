"""Pinocchio in minimal coordinates: a chain of spherical joints, or a tree with any joints.

Frames, quaternion order and offsets.  Joint frame k is at body k's proximal point with the body's axes, so
in it the centre of mass is at c = -proximal_k and the next joint at distal_k - proximal_k.  A rod is a
spherical joint too: its frame is where the rod hangs, its z axis along u, the child's joint at
(0, 0, length).  Its body has no mass, and inertia about its own axis only, which is exact while the rod does
not spin about that axis: it starts without, and gains none but the integrator's error.

With a, b the absolute attitudes of a joint's parent and of itself (quaternions, scalar first) and W their
angular velocities, each in its own frame, Pinocchio's coordinates of joint j are

    q_j = (a⁻¹ b) as (x, y, z, w),        v_j = W_b - R(a⁻¹ b)ᵀ W_a,        W_rod = R(b)ᵀ (u × udot).

Other joints have their frame at the near point too, its axes those of the joint, body axes = B × joint axes,
B = A(q_near)ᵀ (q_far, q_near: the joint's axes in its bodies), and q_j = x, v_j = ẋ: RZ for a hinge, PZ for a
slide, RX·RY for a universal, PZ·RZ for a cylindrical joint; a free body is a free flyer at its centre of
mass, a welded body is appended to the joint of its far body.

Loops: each closing joint's near body is cut in two parts, one of them on that joint, and the parts are
welded by a CONTACT_6D constraint in `constraintDynamics`, which takes loads as joint torques only; its
proximal iterations converge where rows depend on others too.  The constraint's forces are then `fext` of the
`rnea` that gives the joints' wrenches.

Applied loads enter as `fext`, force and moment on the joint's body, in and about its frame:

    f = Rᵀ (F - c_t ṙ),        n = n′ - c_r ω′ + c × f.

Rotors are the engine's armature.  Springs, dampers and efforts of joints enter as torques τ(q, v) of the
joints, springs between points as `fext`; their energy is not the engine's and is added.

Accelerations come from `crba` with a dense solve in state evaluation and in dop853, from `aba` in the two
fixed-step integrators (which are `plumbline.engines.integrators`: Pinocchio has none).  The two agree on
short chains.  On long ones `aba` (4.1.0) loses digits that the problem does not cost, because the
articulated inertias that it passes to the parent lose their symmetry, about threefold a body: 5e-14 m/s²
off on the catalogue's ten balls, 2e-8 on thirty, 8e-3 on fifty, where `crba` is below 2e-11 throughout
(tests/adapters/test_pinocchio_engine.py).  An error-controlled integrator stalls on noise of that size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
import pinocchio as pin
from scipy.linalg import block_diag, lapack

from adapters.pinocchio_common import (
    PinocchioAdapter,
    add_frame,
    append_parts,
    armature,
    composite,
    configuration_rate,
    energies_and_momentum,
    init_constraint_dynamics,
    point_acceleration,
    set_corrector,
    translation,
    with_single_joints,
)
from adapters.pinocchio_loops import Loops, closed_accelerations, welded
from adapters.pinocchio_probes import Probed, add_probe_frames
from adapters.pinocchio_surface import add_composites, add_surface, pose_function
from adapters.pinocchio_variants import VARIANTS, Change, Spelling
from adapters.pose_functions import add_pose_answers
from adapters.surface_record import Answer
from plumbline.engines.integrators import dop853, rkmk4, sample_steps, semi_implicit_euler
from plumbline.engines.missing_names import add_parts
from plumbline.engines.variants import Suits, names_of_column
from plumbline.model.datatypes import (
    Array,
    Float,
    Integrator,
    Model,
    State,
    StateQuantities,
    SurfaceAnswer,
    Trajectory,
    Unsupported,
)
from plumbline.model.kinematics import (
    cross_matrix,
    elastic_energy,
    minimal_rates,
    own_rates,
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    remembered_velocity_jacobian,
    rod_inertias,
    rotation_matrix,
    rotation_vector,
    turn_of_z,
)
from plumbline.model.loops import STABILISATION, CutMechanism, cut_open, motion_without_inertia
from plumbline.model.step_methods import SERIES_TURN, JointSpaceMethod, classical_runge_kutta
from plumbline.model.welding import BodyParts, undivided_bodies

ROD_AXIAL_INERTIA = 1 / 3  # of a rod about its own axis, over `rod_inertias`
# Of steps: coordinates of joints, and of free bodies and of gaps of loops.
ROTATIONS: tuple[Literal["joint rotations"], float] = "joint rotations", ROD_AXIAL_INERTIA
# exp3 and exp6 take series below the same turn.
RIGID: Any = {
    "free_coordinates": "rigid motion", "gap_correction": STABILISATION, "closed_form_turn": SERIES_TURN,
}  # fmt: skip
# Of constraintDynamics: accuracy, damping (any from 1e-12 to 1e-3 does), largest number of steps.
PROXIMAL_SETTINGS = 1e-15, 1e-8, 50
MAX_DENSE_JOINTS = 10  # joints up to which their 3 × 3 blocks are solved faster as one matrix
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
Motion = tuple[Array, Array, Array]  # q, v and v̇
Built = tuple[CutMechanism, "PinocchioChain"]
EARLY_STATES = 2  # at which loops are closed in all ways, and composite joints asked
FIXED_STEPS = {"semi-implicit-euler": semi_implicit_euler, "rkmk4": rkmk4}


class PinocchioChain:
    """A `Model` as Pinocchio's model and data, and the map between their coordinates.

    nj joints: one per body that is not welded and one more per rod.  Of a chain all are spherical, the parent
    of j being j - 1, q is (4 nj,) and v (3 nj,) in Pinocchio's conventions.  ``algorithm`` finds the
    accelerations: "crba" solves with the engine's mass matrix densely, "cholesky" with its own sparse
    factors, "forwardDynamics" in its solver for constraints, of which there are none, "aba" and "aba-world"
    are its articulated-body algorithm in local and in world coordinates.  ``ends``: pairs of bodies of a tree
    that are welded together, each at its centre of mass.
    """

    def __init__(
        self,
        model: Model,
        algorithm: str,
        parts: BodyParts | None = None,
        ends: Sequence[tuple[int, int]] = (),
        change: Change = Change(),  # noqa: B008
    ):
        self.source_model, self.algorithm = model, change.algorithm or algorithm
        self.last_state: State | None = None  # and its coordinates and T
        self.last_motion: tuple[Array, Array] = np.zeros(0), np.zeros((0, 0))
        self.parts = parts = parts or undivided_bodies(model)
        self.pin_model = pin.Model()
        self.pin_model.gravity = pin.Motion(model.gravity, np.zeros(3))
        self.body_joints: list[int] = []  # joint of body k
        self.placements: list[pin.SE3] = []  # of body k's frame in its joint's frame
        for k, (kind, far) in enumerate(zip(model.kinds, model.body[:, 0], strict=True)):
            joint, hang = self._end(far, model.point[k, 0])
            if kind.holds_no_turn:
                hang.rotation = np.eye(3)
            if kind.holds_distance:
                joint = self._add_joint(joint, pin.JointModelSpherical(), hang, f"rod {k}")
                massless = pin.Inertia(0.0, np.zeros(3), _axial_inertia(model, k))
                self.pin_model.appendBodyToJoint(joint, massless, pin.SE3.Identity())
                hang = translation(np.array([0.0, 0.0, model.length[k]]))
            joint = self._add_body(k, joint, hang)
            append_parts(self.pin_model, joint, parts[k], self.placements[k])
            add_frame(self.pin_model, f"com {k}", joint, translation(self.placements[k].translation))
            self.body_joints.append(joint)
        self._add_rotors()
        self.pin_model = change.remake(self.pin_model)
        self.com_frames = [self.pin_model.getFrameId(f"com {k}") for k in range(model.n)]
        self.renew_data()
        self.joint_count = self.pin_model.njoints - 1
        self.body_rows = [joint - 1 for joint in self.body_joints]  # of the bodies among the joints
        moved = [k for k, kind in enumerate(model.kinds) if not kind.is_rigid]
        self.body_of_row = {self.body_rows[k]: k for k in moved}
        self.rod_rows = [j for j in range(self.joint_count) if j not in self.body_rows]
        self.parent_rows = [int(parent) - 1 for parent in self.pin_model.parents][1:]
        self.joints = list(self.pin_model.joints)[1:]
        # whether dexp is solved as one matrix, and not by its 3 × 3 blocks
        is_small = self.joint_count <= MAX_DENSE_JOINTS
        self.has_dense_dexp = is_small or any(joint.nv != 3 for joint in self.joints)
        self.zero_torque = np.zeros(self.pin_model.nv)
        self._init_elements()
        self.ends = ends
        # without ends a solver without constraints
        self.has_constraints = bool(ends) or self.algorithm == "constraintDynamics"
        self.welds, self.weld_data = list[Any](), list[Any]()
        if self.has_constraints:
            places = [(self.body_joints[k], self.placements[k]) for k in range(model.n)]
            self.welds, self.weld_data = welded(self.pin_model, ((places[a], places[b]) for a, b in ends))
            init_constraint_dynamics(self.pin_model, self.data, self.welds, self.weld_data)
        self._init_loads()

    def renew_data(self) -> None:
        """Make a workspace, and keep what its functions write: poses, turns and velocities of the joints."""
        self.data, joints = self.pin_model.createData(), range(self.pin_model.njoints)
        self.poses = [self.data.oMi[j] for j in joints]
        self.turns = [pose.rotation for pose in self.poses]
        self.velocities = [self.data.v[j].vector for j in joints]

    def _end(self, body: int, point: Array) -> tuple[int, pin.SE3]:
        """Return the joint and the place in its frame of a point of a body, or of the world, joint 0."""
        place = self.placements[body] if body >= 0 else pin.SE3.Identity()
        return self.body_joints[body] if body >= 0 else 0, place * translation(point)

    def _add_joint(self, parent: int, joint: Any, placement: pin.SE3, name: str) -> int:
        return int(self.pin_model.addJoint(parent, joint, placement, name))

    def _add_body(self, k: int, parent: int, hang: pin.SE3) -> int:
        """Add the joint of body k, at ``hang`` with the far body's axes, and the body's placement in it."""
        model, kind = self.source_model, self.source_model.kinds[k]
        if kind.holds_no_turn:
            self.placements.append(translation(-model.proximal[k]))
            return self._add_joint(parent, pin.JointModelSpherical(), hang, f"body {k}")
        if kind.holds_nothing:
            self.placements.append(pin.SE3.Identity())
            return self._add_joint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"body {k}")
        far, near = (pin.SE3(rotation_matrix(q), np.zeros(3)) for q in model.turn[k])
        place = near.inverse() * translation(-model.proximal[k])
        if kind.is_rigid:
            self.placements.append(hang * far * place)
            return parent
        self.placements.append(place)
        pitch = (model.length[k],) if kind.has_pitch else ()
        letters = ["H" if kind.has_pitch else {"turn": "R", "slide": "P"}[what] for what, _ in kind.motions]
        names = [f"JointModel{x}{'XYZ'[axis]}" for x, (_, axis) in zip(letters, kind.motions, strict=True)]
        joints = [getattr(pin, name)(*pitch) for name in names]
        joint = joints[0] if len(joints) == 1 else composite(*joints)
        return self._add_joint(parent, joint, hang * far, f"body {k}")

    def _add_rotors(self) -> None:
        model = self.source_model
        for kind, rotors, j in zip(model.kinds, model.armature, self.body_joints, strict=True):
            if np.any(rotors):
                joint = self.pin_model.joints[j]
                own = rotors[: 1 if kind.is_spherical else joint.nv]
                self.pin_model.armature[joint.idx_v : joint.idx_v + joint.nv] += own

    def _init_elements(self) -> None:
        """Set the joints' dampers, springs and efforts, (nv,) each, and where springs read q."""
        model, nv = self.source_model, self.pin_model.nv
        self.damping, self.stiffness, self.effort, rest = np.zeros((4, nv))
        scalars: list[tuple[int, int]] = []  # places in q and in v
        balls: list[tuple[Array, Array]] = []  # quaternion, scalar first, and rates
        turns: list[Array] = []
        for k, row in enumerate(self.body_rows):
            if not model.kinds[k].element_count:
                continue
            joint = self.joints[row]
            is_ball = model.kinds[k].is_spherical
            at, own = slice(joint.idx_v, joint.idx_v + joint.nv), slice(1 if is_ball else joint.nv)
            self.damping[at], self.effort[at] = model.damping[k, own], model.effort[k, own]
            self.stiffness[at] = model.stiffness[k, own]
            if not is_ball:
                rest[at] = model.rest[k, own]
                scalars += [(joint.idx_q + i, joint.idx_v + i) for i in range(joint.nv)]
            elif model.stiffness[k, 0]:
                above = self._frame_in_joint(int(model.body[k, 0]), model.turn[k, 0])  # as q
                turns.append(quaternion_product(model.turn[k, 1], quaternion_conjugate(above)))
                balls.append((joint.idx_q + np.array([3, 0, 1, 2]), joint.idx_v + np.arange(3)))
        self.scalars = np.array(scalars, np.intp).reshape(-1, 2).T
        self.rest = rest[self.scalars[1]]
        self.sprung_balls = [np.array([pair[i] for pair in balls], np.intp) for i in range(2)]
        self.ball_rest = np.array(turns).reshape(-1, 4)

    def _init_loads(self) -> None:
        """Set `fext` to the constant loads; a moment is constant in the joint's frame, the others vary."""
        model = self.source_model
        self.fext = pin.StdVec_Force()
        self.fext.extend([pin.Force.Zero()] * self.pin_model.njoints)
        # the numbers of `fext` by body, and whether it is the first on its joint: welded ones share it
        self.joint_loads = [self.fext[j].vector for j in self.body_joints]
        self.is_first = [j not in self.body_joints[:k] for k, j in enumerate(self.body_joints)]
        self.constant_loads = [
            place.act(pin.Force(np.zeros(3), n)).vector.copy()
            for place, n in zip(self.placements, model.moment, strict=True)
        ]
        self.loads = list(self.constant_loads)
        self.has_force = np.any(model.force != 0, axis=1).tolist()
        self.has_body_drag = ((model.drag_force != 0) | (model.drag_moment != 0)).tolist()
        # in the joints' frames: wrenches by forces at the centres of mass in these axes, and by velocities
        self.pulls = [_pull(place) for place in self.placements]
        self.drags = [
            place.toDualActionMatrix() @ np.diag(np.repeat(sizes, 3)) @ place.toActionMatrixInverse()
            for place, *sizes in zip(self.placements, model.drag_force, model.drag_moment, strict=True)
        ]
        varying = np.logical_or(self.has_force, self.has_body_drag)
        varying[model.spring_body[model.spring_body >= 0]] = True
        self.spring_ends = [
            [self._end(*end) for end in zip(bodies, points, strict=True)]
            for bodies, points in zip(model.spring_body, model.spring_point, strict=True)
        ]
        self.spring_pulls = [[_pull(place) for _, place in ends] for ends in self.spring_ends]
        self.bodies_with_varying_loads = [int(k) for k in np.flatnonzero(varying)]
        self._add_up_loads()

    def _add_up_loads(self) -> None:
        """Set `fext` of every joint to the loads of its bodies: one, and those welded to it."""
        for total, is_first, load in zip(self.joint_loads, self.is_first, self.loads, strict=True):
            total[:] = load if is_first else total + load

    def coordinates(self, state: State) -> tuple[Float[Array, "nq"], Float[Array, "nv"]]:
        """Map a state to Pinocchio's coordinates q and v."""
        q, T = self._motion(state)
        return q, T @ minimal_rates(self.source_model, state)

    def _frames(self, state: State) -> tuple[Array, Array]:
        """Return the joints' frames, quaternions (nj + 1, 4), and S (nj + 1, 3, nu) of their ω = S ν.

        The world's, which stands still, are in a row behind them: the parent −1 of the first joints.
        """
        model, of_rods = self.source_model, np.flatnonzero(self.source_model.rods).tolist()
        jacobian = remembered_velocity_jacobian(model, state).reshape(model.n, 6, -1)
        rows = self.joint_count + 1
        frames, S = np.tile(UNTURNED, (rows, 1)), np.zeros((rows, 3, jacobian.shape[-1]))
        for k, (kind, row) in enumerate(zip(model.kinds, self.body_rows, strict=True)):
            if not kind.is_rigid:
                p, turn = state.p[k], model.turn[k, 1]
                frames[row] = p if kind.has_attitude else quaternion_product(p, turn)
                S[row] = self.placements[k].rotation @ jacobian[k, 3:]
        for i, (row, k) in enumerate(zip(self.rod_rows, of_rods, strict=True)):
            frames[row] = turn_of_z(state.u[k]) / np.linalg.norm(turn_of_z(state.u[k]))
            spin = rotation_matrix(frames[row]).T @ cross_matrix(state.u[k])
            S[row, :2, 3 * i : 3 * i + 3] = spin[:2]  # no rod spins about itself
        return frames, S

    def _motion(self, state: State) -> tuple[Array, Array]:
        """Return q, and T of v = T ν, ν = (udot of rods, ω′ of bodies or rates of joints)."""
        if state is not self.last_state:  # coordinates and rates are asked for in turn
            self.last_state, self.last_motion = state, self._motion_at(state)
        return self.last_motion

    def _motion_at(self, state: State) -> tuple[Array, Array]:
        model, (frames, S), up = self.source_model, self._frames(state), self.parent_rows
        relative = quaternion_product(quaternion_conjugate(frames[up]), frames[:-1])
        spin = S[:-1] - rotation_matrix(relative).swapaxes(-1, -2) @ S[up]
        q, T = pin.neutral(self.pin_model), np.zeros((self.pin_model.nv, S.shape[-1]))
        rates = own_rates(model)
        for j, joint in enumerate(self.joints):
            k = self.body_of_row.get(j, -1)
            at, to = slice(joint.idx_q, joint.idx_q + joint.nq), slice(joint.idx_v, joint.idx_v + joint.nv)
            if k < 0 or model.kinds[k].holds_no_turn:
                q[at], T[to] = np.roll(relative[j], -1), spin[j]
            elif model.free[k]:
                q[at] = *state.r[k], *np.roll(state.p[k], -1)
                T[to, rates[k]] = block_diag(rotation_matrix(state.p[k]).T, np.eye(3))
            else:
                q[at], T[to, rates[k]] = state.x[k, : joint.nq], np.eye(joint.nv)
        return q, T

    def rate_map(self, state: State) -> Float[Array, "nv nu"]:
        """Map ν to the engine's velocity."""
        return self._motion(state)[1]

    def _absolute_attitudes(self, q: Array) -> Array:
        """Return the attitudes (T, nj + 1, 4) of the joints' frames and of the world at q (T, nq)."""
        model, bodies = self.source_model, self.body_of_row
        frames = np.tile(UNTURNED, (len(q), self.joint_count + 1, 1))
        for j, joint in enumerate(self.joints):
            k = bodies.get(j, -1)
            if k >= 0 and model.kinds[k].motions:
                turn = _joint_turns(model, k, q[:, joint.idx_q :])
                above = self._frame_in_joint(model.body[k, 0], model.turn[k, 0])
                turn = quaternion_product(above, turn)
            else:
                turn = np.roll(q[:, joint.idx_q : joint.idx_q + joint.nq][:, -4:], 1, axis=1)
            frames[:, j] = quaternion_product(frames[:, self.parent_rows[j]], turn)
        return frames

    def _frame_in_joint(self, k: int, turn: Array) -> Array:
        """Return a quaternion given in body k, −1 the world, as one in the frame of the body's joint."""
        model = self.source_model
        while k >= 0 and model.kinds[k].is_rigid:
            far, near = model.turn[k]
            turn = quaternion_product(quaternion_product(far, quaternion_conjugate(near)), turn)
            k = int(model.body[k, 0])
        if k >= 0 and model.kinds[k].motions:
            turn = quaternion_product(quaternion_conjugate(model.turn[k, 1]), turn)
        return turn

    def update_loads(self, q: Float[Array, "nq"], v: Float[Array, "nv"]) -> None:
        """Set `fext` to the loads at a state."""
        if not self.bodies_with_varying_loads:
            return
        model = self.source_model
        pin.forwardKinematics(self.pin_model, self.data, q, v)
        for k in self.bodies_with_varying_loads:
            j, wrench = self.body_joints[k], self.constant_loads[k]
            if self.has_force[k]:
                wrench = wrench + self.pulls[k].dot(model.force[k].dot(self.turns[j]))  # Rᵀ F
            if self.has_body_drag[k]:
                wrench = wrench - self.drags[k].dot(self.velocities[j])
            self.loads[k] = wrench
        for i in range(len(model.spring_body)):
            self._add_spring(i)
        self._add_up_loads()

    def _add_spring(self, i: int) -> None:
        """Add to the loads of bodies what a spring between points does to them."""
        model, poses, (near_pull, far_pull) = self.source_model, self.poses, self.spring_pulls[i]
        (near, at), (far, there) = self.spring_ends[i]
        d = poses[far].act(there.translation) - poses[near].act(at.translation)
        # velocities of points are dual to forces on them
        near_rate = self.turns[near].dot(self.velocities[near].dot(near_pull))
        far_rate = self.turns[far].dot(self.velocities[far].dot(far_pull))
        length = math.sqrt(d.dot(d))
        tension = model.spring_stiffness[i] * (length - model.spring_length[i])
        tension += model.spring_damping[i] * d.dot(far_rate - near_rate) / length
        force = d * (tension / length)
        b, c = model.spring_body[i].tolist()
        if b >= 0:
            self.loads[b] = self.loads[b] + near_pull.dot(force.dot(self.turns[near]))
        if c >= 0:
            self.loads[c] = self.loads[c] - far_pull.dot(force.dot(self.turns[far]))

    def joint_torque(self, q: Float[Array, "nq"], v: Float[Array, "nv"]) -> Float[Array, "nv"]:
        """Evaluate springs, dampers and efforts of the joints."""
        if not self.source_model.has_joint_elements:
            return self.zero_torque
        torque: Array = self.effort - self.damping * v
        torque[self.scalars[1]] -= self.stiffness[self.scalars[1]] * (q[self.scalars[0]] - self.rest)
        if len(self.sprung_balls[0]):
            at, own = self.sprung_balls
            stretch = rotation_vector(quaternion_product(self.ball_rest, q[at]))  # body axes, as v
            torque[own] -= self.stiffness[own] * stretch
        return torque

    def acceleration(self, q: Float[Array, "nq"], v: Float[Array, "nv"]) -> Float[Array, "nv"]:
        """Evaluate the accelerations under gravity and loads, by the chosen algorithm."""
        torque = self._load(q, v)
        if self.has_constraints:
            return self._closed_acceleration(q, v, torque)
        if self.algorithm in ("crba", "cholesky", "forwardDynamics"):
            engine, data = self.pin_model, self.data
            bias = pin.rnea(engine, data, q, v, self.zero_torque, self.fext) - torque
            if self.algorithm == "forwardDynamics":  # it counts the velocity terms and gravity itself
                force, no_rows = pin.nonLinearEffects(engine, data, q, v) - bias, np.zeros((0, engine.nv))
                return np.asarray(pin.forwardDynamics(engine, data, q, v, force, no_rows, np.zeros(0), 0.0))
            mass = pin.crba(engine, data, q)
            if self.algorithm == "crba":
                return np.linalg.solve(mass, -bias)
            pin.cholesky.decompose(engine, data)  # along the tree's branches: sparse
            return np.ravel(pin.cholesky.solve(engine, data, -bias))
        name = "WORLD" if self.algorithm == "aba-world" else "LOCAL"
        has_both = hasattr(pin, "Convention") or self.algorithm != "aba"  # version 2 has the local one only
        conventions = [getattr(pin.Convention, name)] if has_both else []
        return np.asarray(pin.aba(self.pin_model, self.data, q, v, torque, self.fext, *conventions))

    def _load(self, q: Array, v: Array) -> Array:
        """Set the loads, and return the torques of the joints."""
        self.update_loads(q, v)
        return self.joint_torque(q, v)

    def loops(self, q: Float[Array, "nq"], v: Float[Array, "nv"]) -> Loops:
        """Return the tree with what closes and moves it."""
        return Loops(self.pin_model, self.welds, self.weld_data, self._push(q, v, self._load(q, v)))

    def _push(self, q: Array, v: Array, torque: Array) -> Array:
        """Return torques and loads as joint torques."""
        push = torque + pin.nonLinearEffects(self.pin_model, self.data, q, v)
        return np.asarray(push - pin.rnea(self.pin_model, self.data, q, v, self.zero_torque, self.fext))

    def _closed_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """Evaluate the accelerations with the loops closed."""
        engine, data = self.pin_model, self.data
        push = self._push(q, v, torque)
        settings = pin.ProximalSettings(*PROXIMAL_SETTINGS)
        a = pin.constraintDynamics(engine, data, q, v, push, self.welds, self.weld_data, settings)
        return np.array(a)

    def _add_forces_of_loops(self) -> None:
        """Add the forces that close the loops, of the last accelerations, to the loads."""
        for (b, c), solved in zip(self.ends, self.weld_data, strict=True):
            force = solved.contact_force  # on b, in the frame of b and c
            self.loads[b] = self.loads[b] + self.placements[b].act(force).vector
            self.loads[c] = self.loads[c] - self.placements[c].act(force).vector
        self._add_up_loads()

    def exponential_coordinate_rate(
        self, q: Float[Array, "nq"], theta: Float[Array, "nv"], v: Float[Array, "nv"]
    ) -> Float[Array, "nv"]:
        """Apply dexp⁻¹ of θ to a velocity, joint by joint.

        Args:
            theta: exponential coordinates θ of a configuration near q.

        Returns:
            θ̇ with d/dt integrate(q, θ) = v.

        """
        dexp = pin.dIntegrate(self.pin_model, q, theta, pin.ArgumentPosition.ARG1)
        if self.has_dense_dexp:
            return np.asarray(lapack.dgesv(dexp, v)[2])
        each = np.arange(self.joint_count)
        blocks = dexp.reshape(self.joint_count, 3, self.joint_count, 3)[each, :, each, :]  # the rest is zero
        return np.linalg.solve(blocks, v.reshape(-1, 3, 1)).ravel()

    def integrate(self, q: Float[Array, "nq"], displacement: Float[Array, "nv"]) -> Float[Array, "nq"]:
        """Move a configuration along a tangent vector, by the engine's `integrate`.

        Args:
            displacement: tangent vector [rad].

        Returns:
            The configuration reached.

        """
        return np.asarray(pin.integrate(self.pin_model, q, displacement))

    def configuration_rate(self, q: Float[Array, "nq"], v: Float[Array, "nv"]) -> Float[Array, "nq"]:
        """Map a velocity to the rate of the configuration."""
        return configuration_rate(self.pin_model, q, v)

    def normalize(self, q: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """Normalise the quaternions of a configuration; `aba` takes any quaternion for a unit one."""
        return np.asarray(pin.normalize(self.pin_model, q))

    def quantities(self, state: State) -> StateQuantities:
        """Evaluate all state quantities.

        Returns:
            The quantities, in the project's frames.

        """
        engine, data = self.pin_model, self.data
        q, v = self.coordinates(state)
        a = self.acceleration(q, v)
        self._add_forces_of_loops()
        pin.forwardKinematics(engine, data, q, v, a)
        pin.updateFramePlacements(engine, data)
        acceleration = [point_acceleration(engine, data, f) for f in self.com_frames]
        bodies = zip(self.body_joints, self.placements, strict=True)
        angular = [place.rotation.T @ data.a[j].angular for j, place in bodies]
        turn = [data.oMi[j].rotation.copy() for j in self.body_joints]
        pin.rnea(engine, data, q, v, a, self.fext)
        wrenches = [(r @ f.linear, r @ f.angular) for r, f in zip(turn, self._joint_wrenches(), strict=True)]
        reaction, moment = np.array(wrenches).swapaxes(0, 1)
        if self.ends:  # the next accelerations are without these forces
            self.loads = list(self.constant_loads)
            self._add_up_loads()
        rates = self.rate_map(state)
        return StateQuantities(
            acceleration=np.array(acceleration),
            angular_acceleration=np.array(angular),
            joint_reaction=reaction,
            joint_moment=moment,
            **energies_and_momentum(engine, data, q, v, elastic_energy(self.source_model, state)),
            mass_matrix=rates.T @ pin.crba(engine, data, q) @ rates,
        )

    def written(self, state: State) -> dict[str, Any]:
        """Return joints, bodies, springs and welds, and the state, as numbers."""
        engine, model, (q, v) = self.pin_model, self.source_model, self.coordinates(state)
        joints = [
            (int(engine.parents[j]), _joint_call(engine.joints[j]), _placed(engine.jointPlacements[j]))
            for j in range(1, engine.njoints)
        ]
        bodies = [(j, _placed(at)) for j, at in zip(self.body_joints, self.placements, strict=True)]
        masses = [
            (j, _placed(at * translation(part.centre)), float(part.mass), part.inertia)
            for j, at, own in zip(self.body_joints, self.placements, self.parts, strict=True)
            for part in own
        ]
        for k in np.flatnonzero(model.rods[: model.n]).tolist():
            at_joint = _placed(pin.SE3.Identity())
            masses.append((self.body_joints[k] - 1, at_joint, 0.0, _axial_inertia(model, k)))
        welds = [[bodies[k] for k in pair] for pair in self.ends]
        loads = ("force", "moment", "drag_force", "drag_moment")
        fields = {"q": q, "v": v, "armature": armature(engine)}
        fields |= {f"link_{name}": getattr(model, name) for name in loads}
        fields |= {name: getattr(self, name) for name in ("effort", "damping", "stiffness", "rest")}
        fields |= {"of_q": self.scalars[0], "of_v": self.scalars[1], "joint_rates": self.rate_map(state)}
        fields["elastic"] = np.array(elastic_energy(model, state))
        settings: dict[str, Any] = {"proximal": PROXIMAL_SETTINGS, "algorithm": self.algorithm}
        settings |= {"stabilisation": STABILISATION, "has_elements": model.has_joint_elements}
        balls = zip(*(at.tolist() for at in self.sprung_balls), self.ball_rest, strict=True)
        numbers = zip(model.spring_stiffness, model.spring_damping, model.spring_length, strict=True)
        springs = [
            ([(j, _placed(at)) for j, at in ends], [*map(float, own)])
            for ends, own in zip(self.spring_ends, numbers, strict=True)
        ]
        parts = {"joints": joints, "masses": masses, "bodies": bodies, "welds": welds}
        settings |= {"sprung_balls": list(balls), "springs": springs}
        reason = "scripts do not part the bodies that Pinocchio merges at a weld"
        if any(kind.is_rigid for kind in model.kinds):
            settings["missing"] = dict.fromkeys(("joint_reaction", "joint_moment"), reason)
        return parts | settings | {"fields": fields}

    def _joint_wrenches(self) -> list[pin.Force]:
        """Return each body's joint wrench after `rnea`, in its joint's axes and about its near point.

        The engine merges welded bodies: the wrench of a weld is what the bodies beyond it need.
        """
        data, model = self.data, self.source_model
        wrench = [data.f[j].copy() for j in self.body_joints]
        for k in reversed(range(model.n)):
            if not model.kinds[k].is_rigid:
                continue
            j = self.body_joints[k]
            inertia = self.placements[k].act(pin.Inertia(model.mass[k], np.zeros(3), model.inertia[k]))
            need = inertia * data.a_gf[j] + inertia.vxiv(data.v[j]) - pin.Force(self.loads[k])
            for child in np.flatnonzero(model.body[:, 0] == k):
                need = need + self._in_frame_of(j, self.body_joints[child], wrench[child])
            wrench[k] = need
        for k in range(model.n):
            if model.kinds[k].is_rigid:
                wrench[k] = translation(self.placements[k].act(model.proximal[k])).actInv(wrench[k])
        return wrench

    def _in_frame_of(self, joint: int, child: int, wrench: pin.Force) -> pin.Force:
        """Return a wrench given in the frame of a joint beyond another one, in the frame of that one."""
        while child != joint:
            wrench, child = self.data.liMi[child].act(wrench), self.pin_model.parents[child]
        return wrench

    def trajectory(
        self,
        times: Float[Array, "samples"],
        q: Float[Array, "samples nq"],
        v: Float[Array, "samples nv"],
        steps: int,
    ) -> Trajectory:
        """Map samples to the bodies' positions, attitudes and rates.

        Args:
            times: sample times [s].

        Returns:
            The trajectory in the project's frames.

        """
        r, rdot, omega = np.empty((3, len(times), self.source_model.n, 3))
        for i in range(len(times)):
            pin.forwardKinematics(self.pin_model, self.data, q[i], v[i])
            for k, (j, centre) in enumerate(zip(self.body_joints, self.placements, strict=True)):
                pose, motion = self.data.oMi[j], centre.actInv(self.data.v[j])
                r[i, k] = pose.act(centre.translation)
                rdot[i, k] = pose.rotation @ (centre.rotation @ motion.linear)
                omega[i, k] = motion.angular
        own = [self._frame_in_joint(k, UNTURNED) for k in range(self.source_model.n)]
        p = quaternion_product(self._absolute_attitudes(q)[:, self.body_rows], np.array(own))
        pdot, coordinates = quaternion_rate(p, omega), self._joint_coordinates(q)
        return Trajectory(times, r, p, rdot, pdot, steps, coordinates=coordinates, velocities=v)

    def _joint_coordinates(self, q: Array) -> Array:
        """Return q (T, nq) as `Trajectory` orders it: quaternions scalar first, in the bodies' axes."""
        found, model = q.copy(), self.source_model
        for k, (kind, row) in enumerate(zip(model.kinds, self.body_rows, strict=True)):
            if not kind.has_attitude:
                continue
            rows = [self.parent_rows[row]] * kind.holds_distance + [row]
            first, *_ = places = [slice(x.idx_q, x.idx_q + x.nq) for x in (self.joints[j] for j in rows)]
            for at in places:
                found[:, at] = q[:, at][:, [6, 3, 4, 5, 0, 1, 2] if kind.holds_nothing else [3, 0, 1, 2]]
            if (far := int(model.body[k, 0])) >= 0:
                far_joint = self._frame_in_joint(far, UNTURNED)
                turned = quaternion_product(quaternion_conjugate(far_joint), found[:, first])
                found[:, first] = turned
        return found


class _SpelledTree(PinocchioChain):
    """A tree whose joints are other models than usual, at one state."""

    def __init__(self, usual: PinocchioChain, change: Change, state: State) -> None:
        """Build it beside the usual one, which has the coordinates and what takes ν to velocities."""
        self.usual, self.spellings = usual, change.joints
        self.usual_q, self.usual_v = self.usual.coordinates(state)
        self.q, self.blocks = list[Array](), list[Array]()  # by joint
        super().__init__(usual.source_model, usual.algorithm, usual.parts)

    def _add_joint(self, parent: int, joint: Any, placement: pin.SE3, name: str) -> int:
        own, spelling = self.usual.joints[len(self.q)], self.spellings.get(joint.shortname(), Spelling())
        usual_q = self.usual_q[own.idx_q : own.idx_q + own.nq]
        made = spelling.make(joint)
        q = spelling.coordinates(usual_q) if spelling.angles is None else spelling.angles
        (turn, S), (turn_now, S_now) = _joint_motion(joint, usual_q), _joint_motion(made, q)
        if spelling.angles is not None:
            placement = placement * pin.SE3(turn @ turn_now.T, np.zeros(3))
        self.q.append(q)
        self.blocks.append(np.linalg.pinv(S_now) @ S)
        return super()._add_joint(parent, made, placement, name)

    def coordinates(self, state: State) -> tuple[Array, Array]:
        """Return those of its state."""
        return np.concatenate(self.q), block_diag(*self.blocks) @ self.usual_v

    def joint_torque(self, q: Array, v: Array) -> Array:
        """Evaluate springs, dampers and efforts: both velocities have the same power."""
        torque = self.usual.joint_torque(self.usual_q, self.usual_v)
        return np.linalg.solve(block_diag(*self.blocks).T, torque)

    def rate_map(self, state: State) -> Array:
        """Map ν to the velocity at its state."""
        return np.asarray(block_diag(*self.blocks) @ self.usual.rate_map(state))


def _joint_motion(joint: Any, q: Array) -> tuple[Array, Array]:
    """Return the turn and the motion subspace (6, nv) of a joint alone."""
    alone = pin.Model()
    number = alone.addJoint(0, joint, pin.SE3.Identity(), "joint")
    data = alone.createData()
    pin.forwardKinematics(alone, data, q)
    turn = data.oMi[number].rotation.copy()
    return turn, np.reshape(pin.computeJointJacobian(alone, data, q, number), (6, -1)).copy()


def _pull(place: pin.SE3) -> Float[Array, "6 3"]:
    """Return what takes a force at a place, in the axes of its joint's frame, to the wrench in that frame."""
    return np.asarray(place.toDualActionMatrix()[:, :3] @ place.rotation.T)


def _axial_inertia(model: Model, k: int) -> Float[Array, "3 3"]:
    """Return that of the rod that carries body k."""
    return np.diag([0.0, 0.0, ROD_AXIAL_INERTIA * rod_inertias(model)[k]])


def _placed(placement: pin.SE3) -> tuple[Array, Array]:
    """Return rotation and translation of a placement."""
    return placement.rotation.copy(), placement.translation.copy()


def _joint_call(joint: Any) -> str:
    """Return the call that makes a joint."""
    own = joint.extract()
    number = repr(own.pitch) if hasattr(own, "pitch") else ""
    calls = [f"pin.{joint.shortname()}({number})"]
    calls += [f".addJoint({_joint_call(part)})" for part in getattr(own, "joints", ())]
    return "".join(calls)


def _joint_turns(model: Model, k: int, x: Array) -> Array:
    """Return the quaternions (T, 4) of joint k at coordinates x (T, ≥ motions), its own axes."""
    turn = np.tile(UNTURNED, (len(x), 1))
    for i, (what, axis) in enumerate(model.kinds[k].motions):
        if what == "turn":
            half = np.zeros_like(turn)
            half[:, 0], half[:, 1 + axis] = np.cos(x[:, i] / 2), np.sin(x[:, i] / 2)
            turn = quaternion_product(turn, half)
    return turn


def _add_closed(s: Probed, loops: Loops) -> None:
    """Add accelerations by all ways to close loops."""
    for by_derivative, call, a in closed_accelerations(loops, s.q, s.v):
        s.add_accelerations(call, a, "by_derivative" if by_derivative else "by_constraint_solver")


def _has_joint(kind: str) -> Suits:
    """Whether a mechanism is built with such a joint."""

    def has(model: Model) -> bool:
        tree = PinocchioChain(cut_open(model).model, "crba")
        return any(joint.shortname() == f"JointModel{kind}" for joint in tree.joints)

    return has


USUAL_JOINTS = tuple(f"{kind}{axis}" for kind in "RPH" for axis in "XYZ")
COLUMN_NAMES = (
    *names_of_column("pinocchio", {"loops": lambda model: model.has_loops}),
    *(
        ((f"JointModel{kind}", f"JointData{kind}"), _has_joint(kind))
        for kind in (*USUAL_JOINTS, "Spherical", "FreeFlyer", "Composite")
    ),
)


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
            method=JointSpaceMethod("semi-implicit Euler", *ROTATIONS, **RIGID),
        ),
        Integrator(
            "rkmk4",
            "step",
            4,
            error_exponents=(4, 5, 6, 7, 8),
            note="Munthe-Kaas form of the classical Runge–Kutta method, on aba, integrate and dIntegrate",
            method=classical_runge_kutta(*ROTATIONS, **RIGID),
        ),
        Integrator("dop853", "tolerance", 8, note="SciPy's DOP853 on (q, v) with crba and the tangent map"),
    )
    builds_trees = builds_elements = moves_loops = True
    options: ClassVar[tuple[str, ...]] = ("cholesky", "forwardDynamics")
    variants = VARIANTS
    column_names = COLUMN_NAMES
    usual_algorithm: ClassVar[str] = "crba"  # for the accelerations of state evaluation
    gaps: ClassVar[Mapping[str, str]] = {
        "turns without inertia": "Pinocchio solves for constraints with the mass matrix of the tree that "
        "they hold: here it is singular"
    }

    def _opened(self, cut: CutMechanism, state: State) -> State:
        """The state of the tree; refused where Pinocchio cannot solve for what closes its loops."""
        there = cut.state(state)
        if cut.ends and motion_without_inertia(cut.model, there) is not None:
            raise Unsupported(self.gaps["turns without inertia"], "turns without inertia")
        return there

    def _built(self, model: Model, algorithm: str, change: Change = Change()) -> Built:  # noqa: B008
        """Build a mechanism, with its loops cut open."""
        cut = cut_open(model)
        parts = None if cut.ends else self.body_pieces(model)
        return cut, PinocchioChain(cut.model, algorithm, parts, cut.ends, change)

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        change = self.variant.change if self.variant else Change()
        cut, chain = self._built(model, self.option or self.usual_algorithm, change)
        if change.joints:
            return [_SpelledTree(chain, change, state).quantities(state) for state in states]
        return [cut.source_quantities(chain.quantities(self._opened(cut, state))) for state in states]

    def written(self, model: Model, state: State, moves: bool = False) -> dict[str, Any]:
        """Return the numbers of the engine's model at a state, see `PinocchioChain.written`."""
        algorithm = "aba" if moves and not model.has_loops else self.option or self.usual_algorithm
        cut, chain = self._built(model, algorithm)
        found = chain.written(self._opened(cut, state))
        found["fields"] |= {"bodies": cut.place[: model.n], "joints": cut.place}
        return found

    def _surface(self, model: Model, states: Sequence[State]) -> Sequence[SurfaceAnswer]:
        cut, chain = self._built(model, self.usual_algorithm)
        own = cut.place[: model.n]
        joints, placements = [chain.body_joints[k] for k in own], [chain.placements[k] for k in own]
        frames = add_probe_frames(chain.pin_model, joints, placements, model)
        chain.renew_data()
        if chain.has_constraints:
            init_constraint_dynamics(chain.pin_model, chain.data, chain.welds, chain.weld_data)
        inertias = [
            place.act(pin.Inertia(mass, np.zeros(3), inertia))
            for place, mass, inertia in zip(placements, model.mass, model.inertia, strict=True)
        ]
        motions, rates, loops = list[Motion](), list[Array | None](), list[Loops]()
        for state in states:
            q, v = chain.coordinates(cut.state(state))
            motions.append((q, v, chain.acceleration(q, v)))
            rates.append(None if cut.ends else chain.rate_map(state))
            if cut.ends and len(loops) < EARLY_STATES:
                loops.append(chain.loops(q, v))

        def ask(m: pin.Model, loops: Sequence[Loops], count: int) -> list[Probed]:
            asked = [Probed(m, frames, *given) for given in zip(motions, rates, strict=True)][:count]
            add_surface(asked, inertias)
            for s, own in zip(asked, loops, strict=False):
                add_parts(s.found, partial(_add_closed, s, own))
            return asked

        single, numbers = with_single_joints(chain.pin_model)
        probed = ask(single, [own.on(single, numbers) for own in loops], len(states))
        if single.njoints != chain.pin_model.njoints:
            for s, of_composites in zip(probed, ask(chain.pin_model, loops, EARLY_STATES), strict=False):
                add_composites(s, of_composites)
        found: list[Answer] = [s.found for s in probed]
        add_pose_answers(found, states, "pinocchio", pose_function)
        return found

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        cut, chain = self._built(model, "crba" if integrator.kind == "tolerance" else "aba")
        for weld in chain.welds:
            set_corrector(weld, STABILISATION)
        start = chain.coordinates(self._opened(cut, state))
        if integrator.kind == "tolerance":
            return cut.source_run(chain.trajectory(times, *dop853(chain, *start, times, resolution)))
        step = FIXED_STEPS[integrator.name]
        samples = sample_steps(lambda qv: step(chain, *qv, resolution), start, times, resolution)
        q, v = (np.array(column) for column in zip(*samples, strict=True))
        return cut.source_run(chain.trajectory(times, q, v, round(float(times[-1] / resolution))))


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
    variants = ()
    usual_algorithm = "aba"
    loops_unsupported_reason = "aba has no constraints; the column pinocchio closes loops"

    def _surface(self, model: Model, states: Sequence[State]) -> Sequence[SurfaceAnswer]:
        return []  # the column pinocchio has it
