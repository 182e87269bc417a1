"""MuJoCo: a joint-space engine; every link and every massless rod is a body on a ball joint.

Frames, quaternion order and offsets (R_b: rotation of engine body b, body → world; a(b): its parent; z: a
rod's own axis):

    link k    body frame: the project's, at the centre of mass;  joint at s_prox(k)
              pos = s_dist(k−1) − s_prox(k), or (0, 0, −ℓ_k) − s_prox(k) where its joint is a rod
    hinge, universal, slide, cylindrical, weld, with (q_a, q_b) the joint's axes in its far and near body:
              quat = q_a conj(q_b);  pos = s_far − A(quat) s_near;  axis e of joint at s_near: A(q_b) e
              a cylindrical joint is a slide and a hinge, a universal joint two hinges, a weld none
    free k    qpos (r, p), qvel (ṙ, ω′);  these joints' qpos and qvel are x and ẋ
    rod k     body frame and joint at the point where the rod hangs, u_k = −R z;  pos = s_dist(k−1)
              mass 0, inertia diag(0, 0, J_z): exact for any J_z while the rod's axial spin is zero,
              which ball joints at both ends conserve
    qpos_b  = conj(q_a) q_b, scalar first
    qvel_b  = ω_b − R_bᵀ R_a ω_a,  ω in the body's own frame;  for a rod ω_b = R_bᵀ (u × u̇)
    qvel    = T ν,  ν = (u̇ of the rods, ω′ of the links);  M = Tᵀ M_engine T
    r̈       = objectAcceleration + g  (MuJoCo's base accelerates with −g)
    ω̇′      = R_kᵀ α
    L       = L_com + Σm r_com × v_com  of the whole tree

Loads act inside every integrator stage: the world force is `xfrc_applied`; n′ − c_r ω′ and −c_t ṙ
are actuators on a site at the centre of mass, a constant and a velocity bias along each axis.
`cfrc_int` counts actuator forces as if the joint carried them, so before it is read the drag
force and the moments that acted are declared as applied ones too; its moments are about the centre of mass of
the tree that is attached to the world, and are shifted to the near point.

Rotors are the engine's armature, springs and dampers its own, a ball's spring unloaded at qpos q_a conj(q_b);
efforts are `qfrc_applied`.  A spring between points is a spatial tendon over two sites.

Loops: each closing joint's near body is cut in two parts, one of them on that joint, and a weld holds
the parts together.  MuJoCo's constraints are soft: the forces solve (A + R) f = a_ref − a₀ with R > 0.  At a
closed state a_ref is 0 and all answers are linear in R to first order; they are extrapolated to R = 0, and
motions likewise.

The option "tendon equalities" makes bodies on rods free and each rod, also one that closes a loop, a spatial
tendon of constant length; "joint equalities" makes hinges, slides and welds cylindrical joints and holds the
coordinates that these have in addition at 0.  Both are soft, and extrapolated as loops are.  A joint with a
pitch, which MuJoCo lacks, is a cylindrical one whose slide an equality of joints holds at the pitch times
the turn; it is soft too.

Welded halves are bodies without a joint on a massless one in their body's place.  The option "dense mass
matrix" finds the accelerations by a dense solve with `mj_fullM`.  MuJoCo's solvers (PGS, CG, Newton) and
Jacobians (dense, sparse) concern active constraints: here there are none, and the answers are the same bit
for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations, pairwise
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from adapters.mujoco_common import (
    add_actuator,
    children_of,
    compiler_of,
    full_mass_matrix,
    member,
    principal_inertia,
    set_attributes,
    warnings_to,
)
from adapters.mujoco_probes import Probed
from adapters.mujoco_surface import add_probes, add_surface, pose_function
from adapters.mujoco_variants import (
    COLUMN_NAMES,
    HINGE_ANGLES,
    HINGE_RATES,
    HINGE_TURN,
    HINGES,
    VARIANTS,
    Change,
    is_constrained,
)
from adapters.pose_functions import add_pose_answers
from adapters.surface_record import Answer
from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model import kinematics
from plumbline.model.datatypes import (
    ROD,
    Array,
    EngineFailure,
    Float,
    Indices,
    Int,
    Integrator,
    Model,
    State,
    StateQuantities,
    StepRun,
    SurfaceAnswer,
    Trajectory,
    Unsupported,
)
from plumbline.model.loops import (
    PER_BODY,
    STABILISATION,
    cut_open,
    determinate_part,
    motion_without_inertia,
    wrench_length,
)
from plumbline.model.redescription import (
    HELD_KINDS,
    PITCHED_KINDS,
    Rearranged,
    added_motions,
    joints_as_cylinders,
    rods_taken_out,
    state_of_cylinders,
)
from plumbline.model.step_methods import JointSpaceMethod, classical_runge_kutta
from plumbline.model.welding import BodyParts, RigidPart, undivided_bodies

DENSE, TENDONS, HELD = "dense mass matrix", "tendon equalities", "joint equalities"  # options
TENDON_MOTIONS = (
    "motions on tendons are not compared: their equality lacks J̇ q̇, so that they stretch; the lack itself is "
    "computed and compared at states"
)
SINGULAR = (
    "MuJoCo solves for constraints with the mass matrix of the tree that they hold: here it is singular"
)
SOFTNESS = ("body_invweight0", "dof_invweight0", "tendon_invweight0")  # R is proportional to
JOINT_TYPES = {"turn": mujoco.mjtJoint.mjJNT_HINGE, "slide": mujoco.mjtJoint.mjJNT_SLIDE}
MAX_IMPEDANCE = 0.9999  # of soft constraints: the largest that MuJoCo accepts
# of MuJoCo's own R, which is made for the tree at its reference pose: the largest (the next where answers are
# not yet linear in it), how they fall, and how many
LARGEST_REGULARISATIONS, RATIO, REGULARISATIONS = (0.027, 2.7e-4, 2.7e-6), 3.0, 4
# Of them: factors of the largest.  Three are compared, of options all: iterative solvers err alike in some.
SEQUENCES = (1.0, 1.3, 1.7, 1.15, 1.5)
# Of motions: the error of smaller ones is rounding, and as 1/R what steps leave of gaps in dependent rows.
LARGEST_RUN_REGULARISATION, RUN_REGULARISATIONS = 2.7e-4, 3
# Of welds: MuJoCo divides by the impedance and by its square, and multiplies the stiffness by it again.
RUN_SOLREF = -MAX_IMPEDANCE * STABILISATION**2, -2 * MAX_IMPEDANCE * STABILISATION
RUN_ITERATIONS = 3  # of Newton's method on welds, a linear problem: the second and third remove rounding
# Of steps, two: rounding of forces falls as 1/R, where both have it alike their difference is 0.41 of it, and
# what three of a sequence leave of R is below rounding still.
STEP_REGULARISATIONS = tuple(factor * LARGEST_REGULARISATIONS[0] for factor in (SEQUENCES[0], SEQUENCES[2]))
# before and after a step, whose differences are of one size: a singular pose is passed in fewer
NEARBY_STEPS = 8
NO_SAME_FRAME = 0  # mjSAMEFRAME_NONE; the first versions have no enumeration
MAX_ORDER_ERROR = 0.1
MIN_SOFTNESS = 1e-9  # a smaller relative effect of R is rounding
MAX_NOISE = 1e-11  # relative, of differences that grow as R falls: more is too much to extrapolate
ROD_AXIAL_INERTIA = 0.01 / 3  # J_z of a rod over `kinematics.rod_inertias`
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
Run = tuple[Array, Integrator, float]  # times, and by what step
Turned = tuple[Array, Array]  # a vector, and the quaternion of axes
# of positions, attitudes, ṙ and ω′: |δp| of a unit quaternion is half the rotation angle
ERROR_UNITS = np.array([1.0, 2.0, 1.0, 1.0])
# of the equalities that close loops and hold pitches, in steps
HOLDING: Any = {
    "gap_correction": STABILISATION, "gap_form": "distance and quaternion", "holds_pitches": True,
}  # fmt: skip


def _euler(implicit_forces: Literal["joint dampers", "applied", "all"], note: str) -> Any:
    """An integrator of order 1."""
    method = JointSpaceMethod(
        "semi-implicit Euler", "joint rotations", ROD_AXIAL_INERTIA, implicit_forces=implicit_forces,
        **HOLDING,
    )  # fmt: skip
    return {"order": 1, "error_exponents": (1, 2, 3, 4, 5, 6), "note": note, "method": method}


PLAIN = "semi-implicit Euler, implicit in joint dampers"
FAST = "implicit in velocity without Coriolis terms: equals Euler bit for bit unless there is drag"


class Mujoco(MetamorphicHooks):
    """MuJoCo's forward dynamics and its fixed-step integrators."""

    name = "mujoco"
    title = "MuJoCo"
    package = "mujoco"
    reproduction_template = "mujoco"
    supported_versions = ">=3.2,<5"
    integrators = (
        Integrator("Euler", "step", **_euler("joint dampers", PLAIN)),
        Integrator("implicit", "step", **_euler("all", "Euler, implicit in velocity with Coriolis terms")),
        Integrator("implicitfast", "step", **_euler("applied", FAST), alias_of="Euler"),
        Integrator(
            "RK4",
            "step",
            4,
            (4, 5, 6, 7, 8),
            note="classical Runge–Kutta on the rotation group",
            method=classical_runge_kutta("joint rotations", ROD_AXIAL_INERTIA, **HOLDING),
        ),
    )
    options = loop_options = (DENSE,)
    joint_options = MappingProxyType({TENDONS: (ROD,), HELD: HELD_KINDS})
    # the matrices of implicit steps, in dampers too, depend on the coordinates
    motion_options = MappingProxyType({HELD: ("RK4",)})
    unmoved_options = MappingProxyType({TENDONS: TENDON_MOTIONS})
    gaps: ClassVar[Mapping[str, str]] = {
        "mass_matrix": "MuJoCo holds the pitch of a joint by an equality of a slide and a hinge: its mass "
        "matrix has both",
        "turns without inertia": SINGULAR,
    }
    builds_trees = builds_elements = moves_loops = True
    welding_unsupported_reason = ""
    variants = VARIANTS
    column_names = COLUMN_NAMES

    def version(self) -> str:
        """Return the version of the loaded library."""
        return str(mujoco.mj_versionString())

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        mechanism = self._mechanism(model)
        with _raise_on_warnings(mechanism.tree.d):
            if self.is_soft(model):
                return [_rigid_limit(mechanism, state) for state in states]
            return [mechanism.tree.quantities(state) for state in states]

    def written(self, model: Model, state: State, moves: bool = False) -> dict[str, Any]:
        """Return the MJCF, the numbers that it lacks, and what the read-out needs, of one state."""
        mechanism = _Mechanism(model, self.option, self.body_pieces(model), has_text=True)
        tree, there = mechanism.tree, mechanism.state(state)
        rates, loads = tree.set_state(there), ("proximal", "force", "moment", "drag_force", "drag_moment")
        fields = {name: getattr(tree.d, name).copy() for name in ("qpos", "qvel", "qfrc_applied")}
        fields |= {f"link_{name}": getattr(tree.model, name) for name in loads}
        fields |= {"link": np.array(tree.link_ids), "joint_rates": rates}
        if self.is_soft(model):
            largest, count = LARGEST_RUN_REGULARISATION, RUN_REGULARISATIONS
            if not moves:
                largest, count = _usable_regularisation(mechanism, state, there), REGULARISATIONS
            fields["scales"] = largest / RATIO ** np.arange(count)
        fields["bodies"], fields["joints"] = mechanism.places()
        constants = dict[str, Array]()
        if rods := mechanism.rods:
            along = kinematics.joint_coordinates(model, state)[0][rods]
            fields |= {"tied": np.array(rods), "along": along}
            constants = {name: getattr(tree.m, name) for name in ("tendon_length0", "tendon_invweight0")}
        settings = {"softness": SOFTNESS, "ratio": RATIO, "iterations": RUN_ITERATIONS, "solref": RUN_SOLREF}
        numbers = {"text": tree.text, "numbers": tree.numbers, "constants": constants}
        return settings | numbers | {"dense": self.option == DENSE, "fields": fields}

    def is_soft(self, model: Model) -> bool:
        """Whether constraints hold it: loops, options of joints, pitches."""
        return is_constrained(model) or self.option in self.joint_options

    def _mechanism(self, model: Model) -> _Mechanism:
        """The mechanism as the adapter is set; variants after compiling share what is compiled."""
        change = self.variant.change if self.variant else Change()
        if self.variant and change.is_after_compiling:
            return _compiled_mechanism(model, self.option).copied(change)
        return _Mechanism(model, self.option, self.body_pieces(model), change)

    def _surface(self, model: Model, states: Sequence[State]) -> Sequence[SurfaceAnswer]:
        if self.is_soft(model):
            return []
        chain, found = _MujocoChain(model, has_probes=True), list[Answer]()
        with _raise_on_warnings(chain.d):
            for state in states:
                rates = chain.evaluate_forward(state)
                s = Probed(chain.m, chain.d, chain.link_ids, rates)
                add_surface(s)
                found.append(s.found)
        add_pose_answers(found, states, "mujoco", pose_function)
        return found

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        if self.option == TENDONS:
            raise Unsupported(TENDON_MOTIONS)
        if self.is_soft(model):
            return self._rigid_run(model, state, times, integrator, resolution)
        chain = _compiled_mechanism(model, self.option).tree.copied(Change())
        return self._sampled_run(chain, state, (times, integrator, resolution))

    def _step(self, model: Model, state: State, times: Array, integrator: Integrator, step: float) -> StepRun:
        if is_constrained(model) and not self.option:
            return self._limit_of_steps(model, state, times, integrator, step)
        return super()._step(model, state, times, integrator, step)

    def _softened(self, model: Model, largest: float) -> list[_Mechanism]:
        """The mechanism at regularisations that fall from the largest."""
        compiled = _compiled_mechanism(model, self.option)
        found = [compiled.copied(Change()) for _ in range(RUN_REGULARISATIONS)]
        for k, soft in enumerate(found):
            soft.tree.soften(largest / RATIO**k)
            soft.tree.m.opt.iterations = RUN_ITERATIONS
            soft.tree.m.eq_solref[:] = RUN_SOLREF
        return found

    def _rigid_run(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        """Run at falling regularisations, extrapolate to none."""
        runs = list[Trajectory]()
        for soft in self._softened(model, LARGEST_RUN_REGULARISATION):
            run = self._sampled_run(soft.tree, soft.state(state), (times, integrator, resolution))
            runs.append(soft.cut.source_run(run))
        limit, before = dict[str, Any](), dict[str, Any]()
        for name in ("r", "p", "v", "pdot"):
            limit[name], change = _at_zero([getattr(run, name) for run in runs])
            before[name] = limit[name] - change
        return replace(runs[-1], **limit, softer=replace(runs[-1], **before))

    def _limit_of_steps(
        self, model: Model, state: State, times: Array, integrator: Integrator, step: float
    ) -> StepRun:
        """Extrapolate every step to no regularisation, and take the next one from there.

        The uncertainty of a step is three times the largest difference between the limits of two sequences in
        the steps around it: in one step alone both may be off alike by chance.
        """
        softs = [soft for largest in STEP_REGULARISATIONS for soft in self._softened(model, largest)]
        trees, start = [soft.tree for soft in softs], softs[0].state(state)
        first, errors = trees[0], [[0.0] * len(ERROR_UNITS)]
        for tree in trees:
            tree.prepare(start, integrator, step)

        def advance(_: int) -> None:
            q, v = first.d.qpos.copy(), first.d.qvel.copy()
            ends, samples = list[Array](), list[tuple[Array, ...]]()
            for tree in trees:
                tree.d.qpos, tree.d.qvel = q, v
                mujoco.mj_step(tree.m, tree.d)
                ends.append(np.concatenate([tree.d.qpos, tree.d.qvel]))
            for some in (ends[RUN_REGULARISATIONS:], ends[:RUN_REGULARISATIONS]):
                first.d.qpos, first.d.qvel = np.split(_at_zero(some)[0], [first.m.nq])
                mujoco.mj_normalizeQuat(first.m, first.d.qpos)
                samples.append(first.sample())
            errors.append([_largest_norm(x - y) for x, y in zip(*samples, strict=True)])

        run = softs[0].cut.source_run(self._sampled_run(first, start, (times, integrator, step), advance))
        around = np.pad(errors, ((NEARBY_STEPS, NEARBY_STEPS), (0, 0)), "edge")
        largest = np.max(sliding_window_view(around, 2 * NEARBY_STEPS + 1, axis=0), axis=-1)
        return StepRun(run, limit_error=3 * ERROR_UNITS * largest)

    def _sampled_run(
        self, chain: _MujocoChain, state: State, run: Run, advance: Callable[[int], None] | None = None
    ) -> Trajectory:
        times, integrator, resolution = run
        chain.prepare(state, integrator, resolution)
        counts = np.round(times / resolution).astype(int)
        rows = [chain.full_sample()]
        advance = advance or (lambda count: mujoco.mj_step(chain.m, chain.d, nstep=count))
        with _raise_on_warnings(chain.d):
            for done in np.diff(counts):
                advance(int(done))
                rows.append(chain.full_sample())
        t, r, p, v, omega, *joints = (np.array(column) for column in zip(*rows, strict=True))
        pdot = kinematics.quaternion_rate(p, omega)
        coordinates, velocities = chain.joint_samples(*joints)
        return Trajectory(t, r, p, v, pdot, int(counts[-1]), coordinates=coordinates, velocities=velocities)


HALF_TURN = np.array([0.0, 1.0, 0.0, 0.0])  # about x


@dataclass(frozen=True)
class _Tie:
    """A rod in the shape of a tendon of constant length."""

    bodies: Int[Indices, "2"]  # that it holds, −1 the world
    points: Float[Array, "2 3"]  # m, in these bodies
    length: float  # m
    softness: float  # 1/kg, what its R is proportional to


@dataclass(frozen=True)
class _Constraints:
    """What holds a tree besides its joints."""

    ends: tuple[tuple[int, int], ...] = ()  # bodies that stay together
    # of each body's joint the motions that are held, at pitches times the turns
    held: tuple[tuple[int, ...], ...] = ()
    pitches: tuple[float, ...] = ()  # m/rad, of each body's joint
    ties: tuple[_Tie, ...] = ()


class _MujocoChain:
    """A compiled chain and its data.

    Engine body ids: ``link_ids[k]`` of link k, ``ball_ids`` of all bodies on ball joints.
    """

    def __init__(
        self,
        model: Model,
        parts: BodyParts | None = None,
        dense: bool = False,
        constraints: _Constraints = _Constraints(),
        has_probes: bool = False,
        change: Change = Change(),  # noqa: B008
        has_text: bool = False,
    ) -> None:
        spec, self.change = mujoco.MjSpec(), change
        compiler_of(spec).autolimits = False
        self.model, self.use_dense_solve = model, dense
        # coordinates, velocities and T of states that regularisations, variants and runs follow each other at
        self.coordinates = dict[State, tuple[Array, Array, Array]]()
        self.link_ids: list[int] = []
        self.ball_ids: list[int] = []
        self.mass: list[float] = [0.0]
        self.inertia: list[Array] = [np.zeros(3)]
        links: list[Any] = []
        for k, (kind, far) in enumerate(zip(model.kinds, model.body[:, 0], strict=True)):
            parent, hang = links[far] if far >= 0 else spec.worldbody, model.point[k, 0]
            if kind.holds_distance:
                axial = np.array([0, 0, ROD_AXIAL_INERTIA * kinematics.rod_inertias(model)[k]])
                parent = self._add_body(parent, (hang, UNTURNED), 0.0, (axial, UNTURNED), np.zeros(3))
                hang = np.array([0, 0, -model.length[k]])
            pieces = (parts or undivided_bodies(model))[k]
            links.append(self._add_link(parent, k, hang, pieces))
            _add_load_actuators(spec, links[k], k, model)
        for i, (bodies, points) in enumerate(zip(model.spring_body, model.spring_point, strict=True)):
            _add_tendon(spec, links, f"spring {i}", bodies, points)
        _add_equalities(spec, links, constraints)
        if has_probes:
            add_probes(spec, links, model)
        if change.is_described:
            self._describe_elements(spec, links)
        spec = change.describe(spec)
        m = spec.compile()
        if not change.is_described:
            m.opt.gravity = model.gravity
        # 3.2.0 always resets, which the contract's checks report
        disabled = mujoco.mjtDisableBit
        no_reset = getattr(disabled, "mjDSBL_AUTORESET", 0)
        # From the accelerations of the step before, Newton's method may end before the second iteration.
        m.opt.disableflags = disabled.mjDSBL_CONTACT | disabled.mjDSBL_WARMSTART | no_reset
        # After compiling: the compiler refuses massless bodies, and cannot adjust what it does not see.
        is_own = change.has_own_inertia or change.is_described
        given = np.full(m.nbody, True) if not is_own else np.array(self.mass) == 0
        m.body_mass[given] = np.array(self.mass)[given]
        m.body_inertia[given] = np.array(self.inertia)[given]
        self.m = m
        self.effort = np.zeros(m.nv)
        self._set_elements()
        m.opt.tolerance, m.opt.solver = 0.0, mujoco.mjtSolver.mjSOL_NEWTON
        self.text, self.numbers = model_text(spec, m) if has_text else ("", {})
        d = mujoco.MjData(m)
        mujoco.mj_setConst(m, d)
        # The compiler takes axes of inertia that are turned by less than 1e-6 rad as those of the body.
        m.body_sameframe[~given] = NO_SAME_FRAME
        ties = constraints.ties
        m.tendon_length0[m.ntendon - len(ties) :] = [tie.length for tie in ties]
        # MuJoCo's own are of the reference pose, where free bodies are in one place
        m.tendon_invweight0[m.ntendon - len(ties) :] = [tie.softness for tie in ties]
        m, d = self.m, self.d = change.remake(m, d)
        self.softness = tuple(np.copy(getattr(m, name)) for name in SOFTNESS)
        self.applied_wrenches = np.zeros((m.nbody, 6))
        self.applied_wrenches[self.link_ids, :3] = model.force

    @cached_property
    def readout_data(self) -> Any:
        """Data that samples are read with."""
        return mujoco.MjData(self.m)

    def copied(self, change: Change) -> _MujocoChain:
        """The same, compiled alike, with data and numbers of its own that are changed."""
        other = copy(self)
        other.change = change
        other.m, other.d = change.remake(copy(self.m), copy(self.d))
        return other

    def _add_link(self, parent: Any, k: int, hang: Array, pieces: tuple[RigidPart, ...]) -> Any:
        """Add a body of one part, or a massless one with its parts welded to it, on its joint."""
        one = pieces[0] if len(pieces) == 1 else RigidPart(0.0, np.zeros(3), np.zeros((3, 3)))
        kind, near, inertia = self.model.kinds[k], self.model.proximal[k], _principal_inertia(one.inertia)
        if kind.holds_no_turn:
            link = self._add_body(parent, (hang - near, UNTURNED), one.mass, inertia, near)
        else:
            q_far, q_near = self.model.turn[k]
            quat = kinematics.quaternion_product(q_far, kinematics.quaternion_conjugate(q_near))
            pos = hang - kinematics.rotation_matrix(quat) @ near
            pose = (np.zeros(3), UNTURNED) if kind.holds_nothing else (pos, quat)
            link = self._add_body(parent, pose, one.mass, inertia)
            if kind.holds_nothing:
                for joint in self.change.free_joints:
                    set_attributes(link.add_joint(), **joint)
            for what, axis in kind.motions:
                along = kinematics.rotation_matrix(q_near)[:, axis]
                set_attributes(link.add_joint(), type=JOINT_TYPES[what], pos=near, axis=along)
        self.link_ids.append(len(self.mass) - 1)
        for piece in pieces if len(pieces) > 1 else ():  # before the next link: ids go depth first
            self._add_body(link, (piece.centre, UNTURNED), piece.mass, _principal_inertia(piece.inertia))
        return link

    def _add_body(
        self, parent: Any, pose: Turned, mass: float, inertia: Turned, joint: Array | None = None
    ) -> Any:
        """Add a body on a ball joint, or on none; of unit mass until mass and principal inertia are set."""
        (pos, quat), (moments, axes) = pose, inertia
        body = set_attributes(
            parent.add_body(),
            pos=pos, quat=quat, mass=1.0, inertia=np.ones(3), ipos=np.zeros(3), iquat=axes,
            explicitinertial=True,
        )  # fmt: skip
        if mass and self.change.has_own_inertia:
            turn = kinematics.rotation_matrix(axes)
            J = turn * moments @ turn.T
            full = J[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            set_attributes(body, mass=mass, inertia=np.zeros(3), iquat=UNTURNED, fullinertia=full)
        elif mass and self.change.is_described:
            set_attributes(body, mass=mass, inertia=moments)
        if joint is not None:
            for one in self.change.ball_joints:
                set_attributes(body.add_joint(), pos=joint, **one)
            self.ball_ids.append(len(self.mass))
        self.mass.append(mass)
        self.inertia.append(moments)
        return body

    def _describe_elements(self, spec: Any, links: list[Any]) -> None:
        """Write gravity, rotors, dampers and springs into the description, but no rest of a ball."""
        model, _ = self.model, mujoco.MjSpec.attach  # 3.2.0 lacks this, and cannot return a spec's option
        compiler_of(spec).degree = False
        spec.option.gravity = model.gravity
        for k, (kind, link) in enumerate(zip(model.kinds, links, strict=True)):
            for i, joint in enumerate(children_of(link, "joint")[: kind.element_count]):
                _set_springs(joint, model.stiffness[k, i], model.damping[k, i])
                joint.armature, joint.springref = model.armature[k, i], model.rest[k, i]
        numbers = zip(model.spring_stiffness, model.spring_damping, model.spring_length, strict=True)
        for i, (stiffness, damping, length) in enumerate(numbers):
            tendon = spec.tendon(f"spring {i}")
            _set_springs(tendon, stiffness, damping)
            tendon.springlength = [length, length]

    def _set_elements(self) -> None:
        """Set rotors, dampers, springs and efforts of the joints, and the springs between points."""
        m, model = self.m, self.model
        for k, (kind, b) in enumerate(zip(model.kinds, self.link_ids, strict=True)):
            for i in range(kind.element_count):
                joint = m.body_jntadr[b] + i
                dofs = m.jnt_dofadr[joint] + np.arange(3 if kind.is_spherical else 1)
                rest = (
                    kinematics.ball_spring_rest(model, k) if kind.is_spherical else model.rest[k, i : i + 1]
                )
                self.effort[dofs] = model.effort[k, i]
                if model.stiffness[k, i] and (kind.is_spherical or not self.change.is_described):
                    m.qpos_spring[m.jnt_qposadr[joint] + np.arange(len(rest))] = rest
                if not self.change.is_described:
                    m.dof_armature[dofs], m.dof_damping[dofs] = model.armature[k, i], model.damping[k, i]
                    m.jnt_stiffness[joint] = model.stiffness[k, i]
        if self.change.is_described:
            return
        springs = slice(len(model.spring_body))
        m.tendon_stiffness[springs], m.tendon_damping[springs] = model.spring_stiffness, model.spring_damping
        m.tendon_lengthspring[springs] = model.spring_length[:, None]

    def soften(self, scale: float) -> None:
        """Scale the regularisation R of all constraints: nothing else depends on these numbers."""
        for name, usual in zip(SOFTNESS, self.softness, strict=True):
            getattr(self.m, name)[:] = scale * usual

    def prepare(self, state: State, integrator: Integrator, step: float) -> None:
        """Set what a run starts with."""
        self.m.opt.timestep = step
        self.m.opt.integrator = member(f"mjtIntegrator.mjINT_{integrator.name.upper()}")
        self.set_state(state)

    def body_frames(self, state: State) -> tuple[Array, Array]:
        """Return the quaternions (nbody, 4) of all bodies and E (nbody, 3, nu): their ω = E ν, own frames."""
        rods = np.flatnonzero(self.model.rods)
        q = np.zeros((self.m.nbody, 4))
        q[0, 0] = 1
        E = np.zeros((self.m.nbody, 3, kinematics.rate_count(self.model)))
        q[self.link_ids] = state.p
        E[self.link_ids] = kinematics.remembered_velocity_jacobian(self.model, state).reshape(
            self.model.n, 6, -1
        )[:, 3:]
        for j, (b, u) in enumerate(zip(np.array(self.link_ids)[rods] - 1, state.u[rods], strict=True)):
            q[b] = kinematics.turn_of_z(-u)  # the rod's turn about its own axis has no effect
            q[b] /= np.linalg.norm(q[b])
            E[b, :, 3 * j : 3 * j + 3] = kinematics.rotation_matrix(q[b]).T @ kinematics.cross(u, np.eye(3)).T
        return q, E

    def set_state(self, state: State) -> Array:
        """Write a state into the engine's data; returns T (nv, nu)."""
        m, d = self.m, self.d
        self.change.reset(m, d)
        if state not in self.coordinates:
            if self.change.ball_joints is HINGES:  # whose turn is in the model
                self.coordinates.clear()
            T = self._set_coordinates(state)
            self.coordinates[state] = d.qpos.copy(), T @ kinematics.minimal_rates(self.model, state), T
        d.qpos, d.qvel, T = self.coordinates[state]
        d.xfrc_applied, d.qfrc_applied = self.applied_wrenches, self.effort
        return np.asarray(T)

    def _set_coordinates(self, state: State) -> Array:
        """Write the joints' coordinates at a state; returns T."""
        m, d = self.m, self.d
        q, E = self.body_frames(state)
        own, up = self.ball_ids, m.body_parentid[self.ball_ids]
        turn = kinematics.rotation_matrix(
            kinematics.quaternion_product(kinematics.quaternion_conjugate(q[own]), q[up])
        )  # R_bᵀ R_a
        first = m.body_jntadr[own]
        T = np.zeros((m.nv, E.shape[-1]))
        T[m.jnt_dofadr[first][:, None] + np.arange(3)] = E[own] - turn @ E[up]
        relative = kinematics.quaternion_product(kinematics.quaternion_conjugate(q[up]), q[own])
        if self.change.ball_joints is HINGES:
            self._turn_hinges(relative, T)
        else:
            d.qpos[m.jnt_qposadr[first][:, None] + np.arange(4)] = relative
        for k, (b, rates) in enumerate(zip(self.link_ids, kinematics.own_rates(self.model), strict=True)):
            kind, count = self.model.kinds[k], rates.stop - rates.start
            if kind.holds_no_turn or kind.is_rigid:
                continue
            at, dof = m.jnt_qposadr[m.body_jntadr[b]], m.body_dofadr[b]
            T[dof : dof + count, rates] = np.eye(count)
            x = np.concatenate([state.r[k], state.p[k]]) if kind.holds_nothing else state.x[k, :count]
            d.qpos[at : at + len(x)] = x
        return T

    def _turn_hinges(self, relative: Array, T: Array) -> None:
        """Set bodies on three hinges in place of a ball: the turn is the body's, the angles are constant."""
        m, own = self.m, self.ball_ids
        first = m.body_jntadr[own]
        turn = kinematics.quaternion_product(relative, kinematics.quaternion_conjugate(HINGE_TURN))
        before, near = kinematics.rotation_matrix(m.body_quat[own]), m.jnt_pos[first]
        hang = m.body_pos[own] + kinematics.rotate_vectors(before, near)
        m.body_quat[own] = turn
        m.body_pos[own] = hang - kinematics.rotate_vectors(kinematics.rotation_matrix(turn), near)
        self.d.qpos[m.jnt_qposadr[first][:, None] + np.arange(3)] = HINGE_ANGLES
        rows = m.jnt_dofadr[first][:, None] + np.arange(3)
        T[rows] = np.linalg.solve(HINGE_RATES, T[rows])

    def evaluate_forward(self, state: State) -> Array:
        """Evaluate the engine's forward dynamics, then declare its loads as applied ones; returns T."""
        m, d, link = self.m, self.d, self.link_ids
        T = self.set_state(state)
        m.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        self.change.forward(m, d)
        mujoco.mj_subtreeVel(m, d)
        if self.use_dense_solve:
            d.qacc = np.linalg.solve(full_mass_matrix(m, d), d.qfrc_smooth + d.qfrc_constraint)
        velocity = self._spatial_motion(mujoco.mj_objectVelocity, d)
        d.xfrc_applied[link, :3] -= self.model.drag_force[:, None] * velocity[:, 3:]
        moment = kinematics.rotate_vectors(d.xmat[link].reshape(-1, 3, 3), self.model.moment)
        d.xfrc_applied[link, 3:] = moment - self.model.drag_moment[:, None] * velocity[:, :3]
        mujoco.mj_rnePostConstraint(m, d)
        return T

    def quantities(self, state: State) -> StateQuantities:
        """Evaluate all state quantities at one state."""
        m, d, link = self.m, self.d, self.link_ids
        T = self.evaluate_forward(state)
        M = full_mass_matrix(m, d)
        acceleration = self._spatial_motion(mujoco.mj_objectAcceleration, d)
        com, momentum = d.subtree_com[0], m.body_subtreemass[0] * d.subtree_linvel[0]
        return StateQuantities(
            acceleration=acceleration[:, 3:] + self.model.gravity,
            angular_acceleration=_to_body_frame(d.xmat[link], acceleration[:, :3]),
            joint_reaction=d.cfrc_int[link, 3:].copy(),
            joint_moment=self._joint_moments(),
            kinetic_energy=float(d.energy[1]),
            potential_energy=float(d.energy[0]),
            angular_momentum=d.subtree_angmom[0] + kinematics.cross(com, momentum),
            mass_matrix=T.T @ M @ T,
        )

    def pushes(self) -> Array:
        """Return the forces of the ties [N], positive where they push."""
        d = self.d
        of_tie = np.isin(d.efc_id, np.flatnonzero(self.m.eq_type == mujoco.mjtEq.mjEQ_TENDON))
        return np.asarray(d.efc_force[of_tie & (d.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY)])

    def _joint_moments(self) -> Array:
        """Return the moments (N, 3) about the joints' near points, world frame."""
        m, d, link = self.m, self.d, self.link_ids
        near = d.xpos[link] + kinematics.rotate_vectors(d.xmat[link].reshape(-1, 3, 3), self.model.proximal)
        arm = d.subtree_com[m.body_rootid[link]] - near
        return np.asarray(d.cfrc_int[link, :3] + kinematics.cross(arm, d.cfrc_int[link, 3:]))

    def sample(self) -> tuple[Array, Array, Array, Array]:
        """Return r, p, v, ω′ of the links, read with a second data so that the run is not disturbed."""
        m, probe = self.m, self.readout_data
        probe.qpos, probe.qvel = self.d.qpos, self.d.qvel
        mujoco.mj_kinematics(m, probe)
        mujoco.mj_comPos(m, probe)
        mujoco.mj_comVel(m, probe)
        velocity = self._spatial_motion(mujoco.mj_objectVelocity, probe)
        p = probe.xquat[self.link_ids]
        omega = _to_body_frame(probe.xmat[self.link_ids], velocity[:, :3])
        return probe.xpos[self.link_ids], p, velocity[:, 3:], omega

    def full_sample(self) -> tuple[Any, ...]:
        """Return the time by the engine's clock, by which a reset is noticed, the sample, qpos and qvel."""
        return self.d.time, *self.sample(), self.d.qpos.copy(), self.d.qvel.copy()

    def joint_samples(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Reorder samples as `Trajectory` has them: rods point along z there, along −z here."""
        m = self.m
        for kind, b in zip(self.model.kinds, self.link_ids, strict=True):
            at, dof = m.jnt_qposadr[m.body_jntadr[b]], m.body_dofadr[b]
            if kind.holds_nothing:
                q[:, at : at + 7] = np.roll(q[:, at : at + 7], 4, axis=1)
            if kind.holds_distance:  # its rod is the body before
                q[:, at : at + 4] = kinematics.quaternion_product(-HALF_TURN, q[:, at : at + 4])
                q[:, at - 4 : at] = kinematics.quaternion_product(q[:, at - 4 : at], HALF_TURN)
                v[:, dof - 2 : dof] *= -1
        return q, v

    def _spatial_motion(self, mujoco_function: Callable[..., None], data: Any) -> Array:
        """Return mj_objectVelocity or mj_objectAcceleration of the links (N, 6), rotation first, world."""
        out = np.empty((self.model.n, 6))
        for k, b in enumerate(self.link_ids):
            mujoco_function(self.m, data, mujoco.mjtObj.mjOBJ_BODY, b, out[k], 0)
        return out


class _Mechanism:
    """A mechanism and the tree that MuJoCo makes of it, with soft constraints where the mechanism needs them.

    They close loops, tie bodies together in place of rods, or hold motions that joints have in addition.
    """

    def __init__(
        self,
        model: Model,
        option: str,
        parts: BodyParts | None = None,
        change: Change = Change(),  # noqa: B008
        has_text: bool = False,
    ) -> None:
        self.source, ties = model, list[_Tie]()
        self.rodless = rods_taken_out(model) if option == TENDONS else None
        rest = self.rodless.model if self.rodless else model
        self.cut = cut_open(rest)
        self.opened = self.cut.model
        self.rods = np.flatnonzero(model.rods).tolist() if self.rodless else []
        place = np.append(np.argsort(self.rodless.order), -1) if self.rodless else np.zeros(0, int)
        place = np.append(self.cut.place, -1)[place]
        for k in self.rods:
            softness = sum(1 / model.mass[b] for b in model.body[k] if b >= 0)
            ties.append(_Tie(place[model.body[k]], model.point[k], model.length[k], softness))
        some = PITCHED_KINDS + (HELD_KINDS if option == HELD else ())
        held = self.opened if set(some).isdisjoint(rest.kind) else joints_as_cylinders(self.opened, some)
        pairs = zip(self.opened.kinds, self.opened.length, strict=True)
        pitches = tuple(float(length) if kind.has_pitch else 0.0 for kind, length in pairs)
        added = tuple(added_motions(self.opened, held))
        constraints = _Constraints(self.cut.ends, added, pitches, tuple(ties))
        parts = None if self.cut.ends or self.rodless else parts  # whose bodies are in another order
        self.tree = _MujocoChain(held, parts, option == DENSE, constraints, change=change, has_text=has_text)

    def copied(self, change: Change) -> _Mechanism:
        """The same with a copy of its tree."""
        other = copy(self)
        other.tree = self.tree.copied(change)
        return other

    def state(self, state: State) -> State:
        """The state of the tree; refused where MuJoCo cannot solve for what holds it."""
        there = self.rodless.state(state) if self.rodless else state
        there = self.cut.state(there)
        if self.tree.model.kind != self.opened.kind:
            there = state_of_cylinders(self.opened, self.tree.model, there)
        if motion_without_inertia(self.tree.model, there) is not None:
            raise Unsupported(SINGULAR, "turns without inertia")
        return there

    def places(self) -> tuple[Int[Indices, "bodies"], Int[Indices, "joints"]]:
        """Which bodies of the tree are the mechanism's, and which hold its joints; −1 for a tie."""
        place = self.cut.place
        if not self.rodless:
            return place[: self.source.n], place
        return place[np.argsort(self.rodless.order)], np.append(place, -1)[self.rodless.joint]

    def quantities(self, state: State, there: State) -> StateQuantities:
        """Evaluate what is determinate, without a mass matrix; ``there`` is the state of the tree."""
        answer = self.cut.source_quantities(self.tree.quantities(there))
        if self.rodless:
            answer = self._with_rods(state, answer, self.rodless)
        if self.source.has_loops:
            return determinate_part(self.source, state, answer)
        return replace(answer, mass_matrix=None)

    def _with_rods(self, state: State, answer: StateQuantities, rodless: Rearranged) -> StateQuantities:
        """Bodies and joints in the order of the mechanism; rods push along themselves."""
        bodies, found = np.argsort(rodless.order), vars(answer) | {"mass_matrix": None}
        for name in PER_BODY:
            found[name] = found[name][bodies]
        for name in ("joint_reaction", "joint_moment"):
            found[name] = np.where(rodless.joint[:, None] < 0, 0.0, found[name][rodless.joint])
        u = kinematics.joint_coordinates(self.source, state)[0][self.rods]
        found["joint_reaction"][self.rods] = self.tree.pushes()[:, None] * u
        return StateQuantities(**found)


# Variants, steps and runs are of the same mechanisms in turn; these are not run themselves.
_compiled_mechanism = lru_cache(maxsize=16)(_Mechanism)


def _rigid_limit(soft: _Mechanism, state: State) -> StateQuantities:
    """Evaluate at falling regularisations R, check order 1, and extrapolate to none.

    Rounding of the forces grows with 1/R.  The limit's uncertainty, by rounding and by what is left of R, is
    three times the largest difference between the extrapolations of several sequences.
    """
    there = soft.state(state)
    for largest in LARGEST_REGULARISATIONS:
        try:
            limits = _limits(soft, state, there, largest)
            break
        except EngineFailure:
            if largest == LARGEST_REGULARISATIONS[-1]:
                raise
    errors = {
        name: 3 * max(_largest_norm(x[name] - y[name]) for x, y in combinations(limits, 2))
        for name in limits[0]
    }
    values: dict[str, Any] = {name: x if x.ndim else float(x) for name, x in limits[0].items()}
    return StateQuantities(**values, limit_error=errors)


def _usable_regularisation(soft: _Mechanism, state: State, there: State) -> float:
    """Find the largest from which the answers can be extrapolated."""
    for largest in LARGEST_REGULARISATIONS:
        with suppress(Unsupported, EngineFailure):
            _extrapolated(soft, state, there, largest)
            return largest
    raise Unsupported("no regularisation of MuJoCo's constraints can be extrapolated from")


def _limits(soft: _Mechanism, state: State, there: State, largest: float) -> list[dict[str, Array]]:
    """Extrapolate three sequences or more: rounding can spoil one, and is another in the next."""
    found, refusals = list[dict[str, Array]](), list[Unsupported | EngineFailure]()
    # An option's solver may lose digits in one sequence; of MuJoCo's own way a wrong order is a failure.
    is_usual = soft.tree.change == Change()
    lost = Unsupported if is_usual else (Unsupported, EngineFailure)
    for factor in SEQUENCES:
        try:
            found.append(_extrapolated(soft, state, there, factor * largest))
        except lost as refusal:
            refusals.append(refusal)
        if is_usual and len(found) == 3:
            break
    if len(found) < 3:
        raise refusals[0]
    return found


def _largest_norm(difference: Array) -> float:
    return float(np.max(np.linalg.norm(np.atleast_2d(difference), axis=-1)))


def _extrapolated(soft: _Mechanism, state: State, there: State, largest: float) -> dict[str, Array]:
    """Extrapolate all quantities from one sequence of regularisations."""
    found = list[dict[str, Array]]()
    for k in range(REGULARISATIONS):
        soft.tree.soften(largest / RATIO**k)
        answer = soft.quantities(state, there)
        found.append({name: np.asarray(x) for name, x in vars(answer).items() if x is not None})
    limit: dict[str, Array] = {}
    length = wrench_length(soft.source)
    size = max(
        float(np.max(np.abs(found[-1][name]))) * unit
        for name, unit in (("acceleration", 1.0), ("angular_acceleration", length))
    )
    force = max(size * float(np.max(soft.source.mass)), float(np.max(np.abs(found[-1]["joint_reaction"]))))
    # what rounding of the others leaves of each, where itself it is small
    sizes = {"joint_reaction": force, "joint_moment": length * force}
    sizes |= {"acceleration": size, "angular_acceleration": size / length}
    for name, last in found[-1].items():
        column = [answers[name] for answers in found]
        steps = [float(np.max(np.abs(x - y))) for x, y in pairwise(column)]
        size = max(float(np.max(np.abs(last))), sizes.get(name, 0.0))
        if steps[0] > MIN_SOFTNESS * size:
            order = np.log(steps[0] / steps[1]) / np.log(RATIO)
            if abs(order - 1) > MAX_ORDER_ERROR:
                raise EngineFailure(f"MuJoCo's {name} is of order {order:.2g} in its regularisation, not 1")
        if steps[-1] > max(steps[0], MAX_NOISE * size):
            raise Unsupported(f"rounding of MuJoCo's constraint forces changes the {name} by {steps[-1]:.1g}")
        limit[name], _ = _at_zero(column)
    return limit


def _at_zero(column: list[Array]) -> tuple[Array, Array]:
    """Extrapolate values at falling R to R = 0 (Neville's scheme); also what the last order changes."""
    before = column
    for power in range(1, len(column)):
        before, column = column, [(RATIO**power * x - y) / (RATIO**power - 1) for y, x in pairwise(column)]
    return column[0], column[0] - before[-1]


def _add_load_actuators(spec: Any, body: Any, k: int, model: Model) -> None:
    """Add n′ − c_r ω′ and −c_t ṙ of body k where they act: force = bias + rate · velocity along each axis."""
    set_attributes(body.add_site(), name=f"com{k}")
    biases = np.concatenate([np.zeros(3), model.moment[k]])
    rates = -np.repeat([model.drag_force[k], model.drag_moment[k]], 3)
    for gear, bias, rate in zip(np.eye(6), biases, rates, strict=True):
        if bias or rate:
            numbers = {"gainprm": np.zeros(10), "biasprm": [bias, 0, rate, 0, 0, 0, 0, 0, 0, 0]}
            affine = mujoco.mjtBias.mjBIAS_AFFINE
            add_actuator(spec, "", "SITE", f"com{k}", gear, biastype=affine, **numbers)


def _add_tendon(spec: Any, links: list[Any], name: str, bodies: NDArray[np.intp], points: Array) -> None:
    tendon = set_attributes(spec.add_tendon(), name=name)
    for side, (body, point) in enumerate(zip(bodies, points, strict=True)):
        owner = links[body] if body >= 0 else spec.worldbody
        set_attributes(owner.add_site(), name=f"{name} {side}", pos=point)
        tendon.wrap_site(f"{name} {side}")


def _set_springs(element: Any, stiffness: float, damping: float) -> None:
    """Set a linear spring and damper of a joint or tendon; later versions have polynomials of them."""
    for name, value in (("stiffness", stiffness), ("damping", damping)):
        setattr(element, name, np.append(value, [0.0, 0.0]) if np.ndim(getattr(element, name)) else value)


def _add_equalities(spec: Any, links: list[Any], constraints: _Constraints) -> None:
    """Add ties first: their numbers are those of their equalities."""
    for i, tie in enumerate(constraints.ties):
        _add_tendon(spec, links, f"tie {i}", tie.bodies, tie.points)
        _add_equality(spec, "TENDON", f"tie {i}")
    for k, motions in enumerate(constraints.held):
        joints = children_of(links[k], "joint") if motions else []
        for i in motions:
            joint = set_attributes(joints[i], name=f"held {k} {i}")
            if pitch := constraints.pitches[k]:  # slide = pitch × hinge
                turn = set_attributes(joints[1 - i], name=f"turn {k}")
                equality = _add_equality(spec, "JOINT", joint.name, turn.name)
                equality.data[:5] = 0.0, pitch, 0.0, 0.0, 0.0
            else:
                _add_equality(spec, "JOINT", joint.name)
    for loop, pair in enumerate(constraints.ends):
        names = [f"end {loop} {side}" for side in (1, 2)]
        for k, name in zip(pair, names, strict=True):
            set_attributes(links[k].add_site(), name=name)
        equality = _add_equality(spec, "WELD", *names)
        if not hasattr(equality, "objtype"):  # 3.2.0 welds bodies, at an anchor and in a pose
            for k, name in zip(pair, names, strict=True):
                links[k].name = name
            equality.data[:] = np.append([0.0] * 6 + [1.0] + [0.0] * 3, 1.0)


def _add_equality(spec: Any, kind: Literal["TENDON", "JOINT", "WELD"], name: str, other: str = "") -> Any:
    """Add a constraint at zero, as hard as MuJoCo accepts; of an other element only where there is one."""
    equality = set_attributes(
        spec.add_equality(), type=member(f"mjtEq.mjEQ_{kind}"),
        name1=name, name2=other, solref=[0.0, 0.0], solimp=[*[MAX_IMPEDANCE] * 2, 1, 0.5, 2],
    )  # fmt: skip
    if hasattr(equality, "objtype"):
        equality.objtype = member(f"mjtObj.mjOBJ_{'SITE' if kind == 'WELD' else kind}")
    return equality


def _principal_inertia(J: Array) -> tuple[Array, Array]:
    """Return principal inertias (3,) and the quaternion of their axes; a diagonal J is not rounded."""
    if not np.any(J - np.diag(np.diag(J))):
        return np.diag(J), UNTURNED
    return principal_inertia(J)


def _to_body_frame(xmat: Array, vector: Array) -> Array:
    """Return Rᵀ v of each body: xmat (N, 9), vector (N, 3)."""
    return np.asarray(np.einsum("kji,kj->ki", xmat.reshape(-1, 3, 3), vector))


@contextmanager
def _raise_on_warnings(d: Any) -> Iterator[None]:
    """Raise EngineFailure for any warning that MuJoCo counts, with its text, which no log file gets."""
    texts: list[str] = []
    with warnings_to(texts.append):
        yield
    if texts or any(warning.number for warning in d.warning):
        raise EngineFailure(f"MuJoCo warned by t = {d.time:g} s: {texts[0] if texts else 'no text'}")


def model_text(spec: Any, m: Any) -> tuple[str, dict[str, Any]]:
    """Return a spec as MJCF, and the numbers of its compiled model that the text does not give.

    Args:
        m: compiled, and changed since then.

    """
    text = spec.to_xml()
    other = mujoco.MjModel.from_xml_string(text)
    numbers: dict[str, Any] = {}
    for prefix, own, read in (("", m, other), ("opt.", m.opt, other.opt)):
        for name in dir(own):
            value = getattr(own, name)
            is_input = name[0] != "_" and (name[-1] != "0" or name == "qpos0")  # others: by mj_setConst
            if not is_input or not isinstance(value, int | float | np.ndarray):
                continue
            if not np.array_equal(value, getattr(read, name)):
                numbers[prefix + name] = np.array(value)
    return text, numbers
