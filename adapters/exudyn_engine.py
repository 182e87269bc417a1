"""Exudyn in maximal coordinates: one NodeRigidBodyEP per body, joints as constraints.

Frames, quaternion order and offsets.  Node coordinates are q_k = (r_k, p_k) and their rates (ṙ_k, ṗ_k), world
frame and scalar first as in the project, so nothing is converted.  Exudyn keeps displacements from a
reference; the reference is the initial state itself, so that the displacements start from an exact zero:

    q = q(0) + displacement,    ω′ = 2 L(p) ṗ,    Jω′ = ½ L(p) (∂T/∂ṗ).

The rod's constraint is ‖d‖ - ℓ, so its multiplier is the tension (2ℓ times the notes' λ); reactions are
read as -C_rᵀ λ, whatever the constraint's scale and sign.

Springs, dampers and efforts of a joint are torsional and linear spring-dampers between its markers: turned so
that the axis is the connector's z (turns) or given (slides); of a universal joint's second axis, fixed in the
near body, the markers are exchanged and the angle is −φ.  A node keeps the angle of the last step, near which
the next one is taken, so that it counts full turns.  Their forces are not in −C_qᵀλ and are added to it.

Welded halves are nodes of their own with a rigid joint between: the body hangs by its first half, the next
body on its last, and outputs of the body are read at the point on its first half where its centre is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import exudyn
import numpy as np
import scipy.linalg

from adapters.exudyn_common import (
    MAX_NEWTON_TOLERANCE,
    NEWTON_TOLERANCE,
    ExudynAdapter,
    Output,
    add_item,
    add_loads,
    add_point_springs,
    initialized_solver,
    items,
    kinetic_energy,
    make_evaluation_settings,
    make_settings,
    make_system,
    mass_matrix_and_force,
    run_solver,
    set_linear_solver,
    silence_engine,
    written_items,
)
from adapters.exudyn_surface import FEW_BODIES, Probes, pose_function
from adapters.exudyn_variants import VARIANTS, Change, Joint, Piece
from adapters.pose_functions import add_pose_answers
from adapters.surface_record import Answer
from plumbline.engines.variants import names_of_column, names_of_steps
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Float,
    Indices,
    Integrator,
    JointKind,
    Model,
    State,
    StateQuantities,
    StepRun,
    SurfaceAnswer,
    Trajectory,
)
from plumbline.model.kinematics import (
    JointFrame,
    cross,
    elastic_energy,
    joint_coordinates,
    remembered_velocity_jacobian,
    rotate_vectors,
    rotation_matrix,
)
from plumbline.model.loops import independent_rows
from plumbline.model.step_methods import ConstrainedMethod, generalized_alpha
from plumbline.model.welding import BodyParts, RigidPart, undivided_bodies

SECOND_AXIS = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # columns x, −z, y of the joint's axes
SPECTRAL_RADIUS = 0.9
NEWTON_ROUNDINGS = 32  # of the terms in a step's equations, as in the bounds of steps
GENERIC_ROWS = 6  # of a generic joint, free axes included
STEP_SETTINGS = {
    "solver_atol": NEWTON_TOLERANCE,
    "solver_rtol": NEWTON_TOLERANCE,
    # numericalDifferentiation: relativeEpsilon × minimumCoordinateSize, of displacements that start at zero
    "difference_step": 1e-7 * 1e-2,
}

NAMES_OF_STEPS = names_of_steps("exudyn")


class ExudynChain:
    """The assembled system at one state; the pieces of all bodies in a row.

    ``first_piece[k]``, ``last_piece[k]``: the pieces of body k with its proximal and with its distal point;
    ``body_of_piece[i]``, ``piece_centre[i]``: the body of piece i, and where in it the piece's own centre
    of mass is.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        parts: BodyParts | None = None,
        left_out: frozenset[tuple[int, int]] = frozenset(),
        has_probes: bool = False,
        change: Change = Change(),  # noqa: B008
    ) -> None:
        self.change = change
        self.model, self.state, self.left_out = model, state, left_out
        self.mbs, self.container = make_system()
        mbs, parts = self.mbs, parts or undivided_bodies(model)
        self.ground = mbs.AddObject(items.ObjectGround())
        pivot = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=self.ground))
        self.nodes: list[Any] = []
        self.piece_bodies: list[Any] = []
        self.joints: list[Any] = []
        self.welds: list[Any] = []
        counts = [len(pieces) for pieces in parts]
        self.body_of_piece = np.repeat(np.arange(model.n), counts)
        self.last_piece = np.cumsum(counts) - 1
        self.first_piece = self.last_piece - counts + 1
        self.piece_centre = np.array([part.centre for pieces in parts for part in pieces])
        # spring-dampers of joints: joint, connector, whether it pushes, and the axis in the world along which
        # the body below gets the opposite of the connector's force
        self.x = joint_coordinates(model, state)[2]
        self.connectors: list[tuple[int, Any, bool, Array]] = []
        # of the bodies, and behind them of the world, body −1
        self.turns = np.concatenate([rotation_matrix(state.p), [np.eye(3)]])
        motions = list[tuple[Array, Array]]()
        for k, (first, last) in enumerate(zip(self.first_piece, self.last_piece, strict=True)):
            motions += [self._add_piece(k, part) for part in parts[k]]
            self._add_joint(k)
            if last > first:
                middle = [self._add_marker(piece, np.zeros(3)) for piece in (first, last)]
                self.welds.append(mbs.AddObject(items.ObjectJointGeneric(markerNumbers=middle)))
            centre = self._add_marker(first, np.zeros(3))
            add_loads(mbs, model, k, centre, pivot, model.moment[k], change.ways)
        add_point_springs(mbs, model, self._end_marker, change.ways)
        for k in range(model.n, len(model.kind)):
            self._add_joint(k)
        self.probes = Probes(mbs, model, self.piece_bodies, self.nodes) if has_probes else None
        # q̇, and B of θ̇ = B ω′ of the nodes' attitudes
        self.qdot, self.rates = (np.array(column) for column in zip(*motions, strict=True))
        self.width = self.qdot.shape[1]
        change.assemble(mbs)

    def _add_piece(self, k: int, part: RigidPart) -> tuple[Array, Array]:
        """Add a piece of body k; return the rates q̇ of its node, and B of θ̇ = B ω′."""
        state, attitude = self.state, self.turns[k]
        arm, arm_rate = attitude @ part.centre, attitude @ cross(state.omega[k], part.centre)
        velocity, gravity = state.v[k] + arm_rate, self.model.gravity
        piece = Piece(part, state.r[k] + arm, velocity, state.p[k], state.omega[k], gravity)
        node, body, rates = self.change.add_body(self.mbs, piece)
        self.nodes.append(node)
        self.piece_bodies.append(body)
        return np.append(velocity, rates @ state.omega[k]), rates

    def _add_joint(self, k: int) -> None:
        model, kind, (far, near) = self.model, self.model.kinds[k], self.model.body[k]
        ends = [
            self._end_marker(far, model.point[k, 0]),
            self._add_marker(self.first_piece[near], model.proximal[k]),
        ]
        if kind.holds_nothing:
            self.joints.append(None)
            return
        held = enumerate(_constrained_axes(kind) or [1] * 3)
        rows = [int(is_held and (k, i) not in self.left_out) for i, is_held in held]
        A, turns = self.turns[near], rotation_matrix(model.turn[k])
        place = self.state.r[near] + A @ model.proximal[k]
        bodies = [self.piece_bodies[self.last_piece[far]] if far >= 0 else self.ground]
        bodies.append(self.piece_bodies[self.first_piece[near]])
        joint = Joint(
            kind, ends, bodies, model.point[k], turns, place, A @ turns[1], rows, float(model.length[k])
        )
        self.joints.append(self.change.add_joint(self.mbs, joint))
        self._add_joint_elements(k, ends)

    def _add_joint_elements(self, k: int, ends: list[Any]) -> None:
        """Add spring-dampers for the coordinates of joint k that have springs, dampers or efforts."""
        model, far = self.model, self.model.body[k, 0]
        if not any(np.any(one[k]) for one in (model.stiffness, model.damping, model.effort)):
            return
        axes = JointFrame(model, k, self.turns[far]).axes(self.x[k])
        for i, ((what, number), (axis, *_)) in enumerate(zip(model.kinds[k].motions, axes, strict=True)):
            stiffness, damping, effort = (x[k, i] for x in (model.stiffness, model.damping, model.effort))
            if not (stiffness or damping or effort):
                continue
            turns = rotation_matrix(model.turn[k])
            sign = -1 if what == "turn" and i and number == 1 else 1  # a universal joint's second axis
            given: dict[str, Any] = {"markerNumbers": ends[::sign], "offset": float(sign * model.rest[k, i])}
            given |= {"stiffness": float(stiffness), "damping": float(damping)}
            if what == "slide":
                kind, push = "ObjectConnectorLinearSpringDamper", "force"
                given["axisMarker0"] = turns[0][:, number]
            else:
                kind, push = "ObjectConnectorTorsionalSpringDamper", "torque"
                # the node keeps the angle of the last step, near which the next one is taken
                start = {"initialCoordinates": [sign * self.x[k, i]], "numberOfDataCoordinates": 1}
                given["nodeNumber"] = self.mbs.AddNode(items.NodeGenericData(**start))
                local = np.roll(np.eye(3), -number - 1, axis=1) if sign > 0 else SECOND_AXIS
                first, second = (turn @ local for turn in turns[::sign])
                given |= {"rotationMarker0": first, "rotationMarker1": second}
            given[push] = float(-sign * effort)
            connector = add_item(self.mbs, self.change.ways, kind, **given)
            self.connectors.append((k, connector, what == "slide", sign * axis))

    def _end_marker(self, body: int, point: Array) -> Any:
        """Add a marker at a point of a body on which others hang, or of the world."""
        if body >= 0:
            return self._add_marker(self.last_piece[body], point)
        return self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=self.ground, localPosition=point.tolist()))

    def joint_rows(self, k: int) -> list[int]:
        """List the rows of joint k that hold something; a generic joint has a row λ = 0 per free axis."""
        if self.joints[k] is None:
            return []
        rows = list(self.mbs.systemData.GetObjectLTGAE(self.joints[k]))
        held = _constrained_axes(self.model.kinds[k]) if len(rows) == GENERIC_ROWS else []
        held = held or [1] * len(rows)
        return [row for row, is_held in zip(rows, held, strict=True) if is_held]

    def _add_marker(self, piece: int, point: Array) -> Any:
        """Add a marker on a piece, at a point (3,) of its body."""
        local = (point - self.piece_centre[piece]).tolist()
        body = self.piece_bodies[piece]
        return self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=body, localPosition=local))

    def output_at(self, piece: int, output_type: Any, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Read an output of a piece at a point of its body.

        Args:
            piece: index of the piece.
            output_type: a member of ``exudyn.OutputVariableType``.
            point: the point [m] from the body's centre of mass, body frame.

        """
        local = (point - self.piece_centre[piece]).tolist()
        return np.array(self.mbs.GetObjectOutputBody(self.piece_bodies[piece], output_type, local))

    def body_outputs(self, output_type: Any) -> Float[Array, "bodies 3"]:
        """Read an output at every body's centre of mass.

        Args:
            output_type: a member of ``exudyn.OutputVariableType``.

        """
        return np.array([self.output_at(i, output_type, np.zeros(3)) for i in self.first_piece])

    def joint_output(self, k: int, output_type: Any) -> Float[Array, "3"]:
        """Read an output of joint k: at its near point, less that at its far point.

        Args:
            output_type: a member of ``exudyn.OutputVariableType``.

        """
        far, near = self.model.body[k]
        here = self.output_at(self.first_piece[near], output_type, self.model.proximal[k])
        if far < 0:
            return np.asarray(here - self.model.point[k, 0] * (output_type == Output.Position))
        return here - self.output_at(self.last_piece[far], output_type, self.model.point[k, 0])

    def multipliers(self) -> Float[Array, "bodies 4"]:
        """Read the constraints' multipliers.

        Returns:
            Of a rod or ball k three (of a rod's distance one, then zeros), then that of the node's |p| = 1.

        """
        data, found = self.mbs.systemData, np.zeros((self.model.n, 4))
        values = np.array(data.GetAECoordinates())
        for k, node in enumerate(self.nodes):
            if self.model.kinds[k].holds_no_turn:
                of_joint = values[data.GetObjectLTGAE(self.joints[k])]
                found[k, : len(of_joint)] = of_joint
            found[k, 3:] = values[data.GetNodeLTGAE(node)]
        return found


class Exudyn(ExudynAdapter):
    """Maximal coordinates with Euler parameters: the closest peer of the notes' own form."""

    name = "exudyn"
    title = "Exudyn"
    reproduction_template = "exudyn"
    other_formulation = "exudyn-tree"
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator(
            "trapezoidal",
            "step",
            2,
            (2, 4, 6, 8, 10, 12),
            is_symmetric=True,
            solver_rtol=NEWTON_TOLERANCE,
            note="TrapezoidalIndex2: implicit trapezoidal rule, constraints on velocities",
            method=ConstrainedMethod(0.5, 0.5, 0.25, 0.5, "velocity", **STEP_SETTINGS),
            names=NAMES_OF_STEPS["trapezoidal"],
        ),
        Integrator(
            "generalized-alpha",
            "step",
            2,
            (2, 3, 4, 5, 6),
            solver_rtol=NEWTON_TOLERANCE,
            note="generalized-α with spectral radius 0.9, constraints on positions (index 3)",
            method=generalized_alpha(SPECTRAL_RADIUS, **STEP_SETTINGS),
            names=NAMES_OF_STEPS["generalized-alpha"],
        ),
    )
    variants = VARIANTS
    column_names = names_of_column("exudyn", {})
    usual_linear_solver = "EigenSparse"
    linear_solvers = ("EXUdense", "EigenDense")
    gaps: ClassVar[Mapping[str, str]] = {
        "rotors": "Exudyn has no rotor between two bodies in maximal coordinates",
        "ball springs": "Exudyn has no spring along the rotation vector of a ball joint",
        "planar elements": "the force of Exudyn's linear spring acts along its axis at both points, which in "
        "a joint with two slides are not on one line",
        "pitches": "Exudyn has no joint whose turn advances along its axis",
        "universal springs": "the angle of Exudyn's torsional spring, atan2(-A01, A00) of the relative turn, "
        "is that of a joint with one turn, not of a universal joint",
    }
    builds_trees = builds_elements = moves_loops = True
    unwritten_ways = ("two welded halves",)
    welding_unsupported_reason = ""

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        with silence_engine():
            change = self.variant.change if self.variant else Change()
            parts = self.body_pieces(model)
            return [_evaluate_state(ExudynChain(model, at, parts, change=change)) for at in states]

    def written(self, model: Model, state: State, moves: bool = False) -> dict[str, Any]:
        """Return the items of the assembled system, and what the read-out needs, of one state."""
        with silence_engine():
            chain = _chain_that_moves(model, state) if moves else ExudynChain(model, state)
            system = written_items(chain.mbs)  # as it is before a solver has it
            C = _system_matrices(chain)[2]
        used = _used_rows(chain, C)
        rates = np.zeros((0, 0)) if model.has_loops else _coordinate_rate_map(chain)
        fields = {"qdot": chain.qdot.ravel(), "A": chain.turns[:-1], "used": used}
        fields |= {"elastic": np.array(elastic_energy(model, state)), "joint_rates": rates}
        fields |= {"proximal": model.proximal, "near": model.body[:, 1]}
        joints = [None if joint is None else int(joint) for joint in chain.joints]
        pushes = [(k, int(item), is_push, axis.tolist()) for k, item, is_push, axis in chain.connectors]
        held, bodies = [chain.joint_rows(k) for k in range(len(joints))], [*map(int, chain.piece_bodies)]
        parts = {"items": system, "joints": joints, "pushes": pushes, "held": held, "bodies": bodies}
        return parts | {"fields": fields}

    def _surface(self, model: Model, states: Sequence[State]) -> Sequence[SurfaceAnswer]:
        found, first = list[Answer](), next((k for k, state in enumerate(states) if np.any(state.omega)), 0)
        with silence_engine():
            for k, state in enumerate(states):
                chain = ExudynChain(model, state, has_probes=True)
                _evaluate_state(chain)
                assert chain.probes is not None
                chain.probes.add_all()
                found.append(chain.probes.found)
                if k <= first and model.n <= FEW_BODIES:  # where nothing turns, all would be 0 = 0
                    chain.probes.add_once(model, state)
            add_pose_answers(found, states, "exudyn", pose_function)
        return found

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        settings = self._settings(integrator)
        newton = settings.timeIntegration.newton
        with silence_engine():
            while True:
                chain = _chain_that_moves(model, state)
                try:
                    samples, clock = self._run_samples(chain, times, settings, resolution)
                    break
                except EngineFailure:
                    # The rounding of a step's equations can be above Newton's tolerance: of the positions of
                    # bodies far away (140 m), of accelerations and joint forces in a whip (140 m/s², 140 N).
                    data = chain.mbs.systemData
                    parts = data.GetODE2Coordinates(), data.GetODE2Coordinates_tt(), data.GetAECoordinates()
                    largest = max(float(np.max(np.abs(part), initial=0.0)) for part in parts)
                    is_rounding = NEWTON_ROUNDINGS * np.finfo(float).eps * largest > newton.relativeTolerance
                    if not is_rounding or newton.relativeTolerance > MAX_NEWTON_TOLERANCE / 2:
                        raise
                    newton.absoluteTolerance = newton.relativeTolerance = 10 * newton.relativeTolerance
        run = _trajectory(model, state, clock, samples, resolution)
        return replace(run, solver_rtol=newton.relativeTolerance)

    def _step(self, model: Model, state: State, times: Array, integrator: Integrator, step: float) -> StepRun:
        settings = self._settings(integrator)
        settings.timeIntegration.newton.useModifiedNewton = False  # full iterations
        with silence_engine():
            chain = _chain_that_moves(model, state)
            samples, clock = self._run_samples(chain, times, settings, step)
        shape = len(times), model.n, -1
        acceleration, multipliers = (np.array([x[i] for x in samples]).reshape(shape) for i in (2, 3))
        return StepRun(_trajectory(model, state, clock, samples, step), acceleration, multipliers)

    def _simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: Integrator, resolution: float
    ) -> Trajectory:
        initial, leg = exudyn.ConfigurationType.Initial, np.array([0.0, end])
        settings = self._settings(integrator)
        with silence_engine():
            chain = _chain_that_moves(model, state)
            data = chain.mbs.systemData
            there, _ = self._run_samples(chain, leg, settings, resolution)
            q, qdot, qddot, _ = there[-1]
            data.SetODE2Coordinates(q, initial)
            data.SetODE2Coordinates_t(-qdot, initial)
            data.SetODE2Coordinates_tt(qddot, initial)  # carried from step to step: a part of its state
            data.SetTime(0.0, initial)
            settings.timeIntegration.generalizedAlpha.computeInitialAccelerations = False
            back, _ = self._run_samples(chain, leg, settings, resolution)
        return _trajectory(model, state, np.array([0.0, end, 2 * end]), [*there, back[-1]], resolution)

    def _settings(self, integrator: Integrator) -> Any:
        settings = make_settings()
        set_linear_solver(settings, self.option or self.usual_linear_solver)
        alpha = settings.timeIntegration.generalizedAlpha
        alpha.computeInitialAccelerations = True
        if integrator.name == "trapezoidal":
            alpha.useNewmark = alpha.useIndex2Constraints = True
        else:
            alpha.spectralRadius = SPECTRAL_RADIUS
        return settings

    @staticmethod
    def _run_samples(
        chain: ExudynChain, times: Array, settings: Any, step: float
    ) -> tuple[list[tuple[Array, ...]], Array]:
        """Return displacements, rates and accelerations (7N,) and multipliers at ``times``; and the clock."""
        data, solver = chain.mbs.systemData, exudyn.MainSolverImplicitSecondOrder()
        parts = data.GetODE2Coordinates, data.GetODE2Coordinates_t, data.GetODE2Coordinates_tt
        read = lambda: (*(part() for part in parts), chain.multipliers())  # noqa: E731
        return run_solver(solver, chain.mbs, settings, times, step, read)


def _chain_that_moves(model: Model, state: State) -> ExudynChain:
    """Assemble a system; of a loop without rows that depend on others, at which the engine's solvers fail."""
    chain = ExudynChain(model, state)
    if not model.has_loops:
        return chain
    C = _system_matrices(chain)[2]
    for k in [k for k, kind in enumerate(model.kinds) if kind.holds_points and not kind.is_spherical]:
        # of some displacements the engine holds those along the joint's axes, of all those along the world's
        rows, above = chain.joint_rows(k)[:3], chain.turns[model.body[k, 0]]
        C[rows] = (above @ rotation_matrix(model.turn[k, 0])).T @ C[rows]
    used = np.flatnonzero(np.any(C != 0, axis=1))
    data = chain.mbs.systemData
    # Of joints that close loops: with one rotation left out the engine's row of another is a different one.
    weight = np.ones(len(C))
    for joint in chain.joints[model.n :]:
        weight[data.GetObjectLTGAE(joint)[:3]], weight[data.GetObjectLTGAE(joint)[3:]] = 1e-4, 1e-2
    scale = weight[used] / np.linalg.norm(C[used], axis=1)
    kept = set(used[independent_rows(C[used], scale)].tolist())
    left_out = frozenset(
        (k, i)
        for k, joint in enumerate(chain.joints)
        for i, row in enumerate(data.GetObjectLTGAE(joint) if joint is not None else ())
        if row not in kept
    )
    return ExudynChain(model, state, left_out=left_out)


def _trajectory(
    model: Model, state: State, clock: Array, samples: list[tuple[Array, ...]], step: float
) -> Trajectory:
    """Add the displacements of a run to its initial state."""
    start = np.concatenate([state.r, state.p], axis=1)
    q = start + np.array([sample[0] for sample in samples]).reshape(-1, model.n, 7)
    qdot = np.array([sample[1] for sample in samples]).reshape(-1, model.n, 7)
    steps = round(float(clock[-1] / step))
    return Trajectory(clock, q[..., :3], q[..., 3:], qdot[..., :3], qdot[..., 3:], steps)


def _evaluate_state(chain: ExudynChain) -> StateQuantities:
    """Evaluate Exudyn's own mass matrix M, right-hand side f, constraint Jacobian C and outputs.

    Its own initial accelerations are finite differences, wrong by some 1e-6, and are not used:

        ⎡ M  Cᵀ ⎤ ⎡ q̈ ⎤   ⎡ f ⎤
        ⎣ C  0  ⎦ ⎣ λ ⎦ = ⎣ γ ⎦,     γ from the accelerations Exudyn gives the attachments at q̈ = 0.
    """
    mbs, data, n, w = chain.mbs, chain.mbs.systemData, len(chain.piece_bodies), chain.width
    M, f, C, C_rate = _system_matrices(chain)
    gamma = _constraint_accelerations(chain, C, C_rate)
    used = _used_rows(chain, C)
    C_used, multiplier = C[used], np.zeros(len(C))
    x = _solve(
        np.block([[M, C_used.T], [C_used, np.zeros((len(used), len(used)))]]),
        np.concatenate([f, gamma[used]]),
    )
    data.SetODE2Coordinates_tt(x[: w * n])
    multiplier[used] = x[w * n :]
    pushes = []
    for k, piece in enumerate(chain.first_piece[chain.model.body[:, 1]]):
        rows, at = chain.joint_rows(k), w * piece
        halves = C[rows, at : at + 3], C[rows, at + 3 : at + w]
        pushes.append([-half.T @ multiplier[rows] for half in halves])
    reaction, turning = (np.array(half) for half in zip(*pushes, strict=True))
    elements = _element_wrenches(chain)
    momentum = (M @ chain.qdot.ravel()).reshape(n, w)  # of θ̇ = B ω′: Bᵀ (…) = J ω′
    spin = rotate_vectors(chain.rates.swapaxes(-1, -2), momentum[:, 3:])
    r = np.array([mbs.GetObjectOutputBody(body, Output.Position) for body in chain.piece_bodies])
    still = np.zeros(w - 3)
    weight = (M @ np.tile([*chain.model.gravity, *still], n)).reshape(n, w)[:, :3]
    kinetic = kinetic_energy(mbs, chain.piece_bodies, float(0.5 * np.sum(chain.qdot * momentum)))
    rates = None if chain.welds or chain.model.has_loops else _coordinate_rate_map(chain)
    return StateQuantities(
        acceleration=chain.body_outputs(Output.Acceleration),
        angular_acceleration=chain.body_outputs(Output.AngularAccelerationLocal),
        joint_reaction=reaction + elements[:, :3],
        joint_moment=_joint_moments(chain, reaction, turning) + elements[:, 3:],
        kinetic_energy=kinetic,
        # its own PotentialEnergy is always 0, and springs have none
        potential_energy=elastic_energy(chain.model, chain.state) - float(np.sum(weight * r)),
        angular_momentum=np.sum(cross(r, momentum[:, :3]), 0)
        + np.einsum("kij,kj->i", chain.turns[chain.body_of_piece], spin),
        # Of welded pieces the engine has no mass matrix on ν.
        mass_matrix=None if rates is None else rates.T @ M @ rates,
    )


def _element_wrenches(chain: ExudynChain) -> Array:
    """Return what spring-dampers do to the bodies below their joints: force and moment (J, 6), world axes."""
    total = np.zeros((len(chain.model.kind), 6))
    for k, connector, pushes, axis in chain.connectors:
        output = Output.ForceLocal if pushes else Output.TorqueLocal
        own = slice(3) if pushes else slice(3, 6)
        total[k, own] -= chain.mbs.GetObjectOutput(connector, output) * axis
    return total


def _joint_moments(chain: ExudynChain, force: Array, of_p: Array) -> Array:
    """Return the moments (J, 3) about the near points from the generalised forces on r and θ.

    With θ̇ = B ω′, A Bᵀ Q is the moment about the centre of the piece that the body hangs by.
    """
    near = chain.model.body[:, 1]
    A, pieces = chain.turns[near], chain.first_piece[near]
    about_centre = rotate_vectors(chain.rates[pieces].swapaxes(-1, -2), of_p)
    lever = rotate_vectors(A, chain.model.proximal - chain.piece_centre[pieces])
    return rotate_vectors(A, about_centre) - cross(lever, force)


def _system_matrices(chain: ExudynChain) -> tuple[Array, Array, Array, Array]:
    """Return M (7N, 7N), f (7N,), C (nc, 7N) and, where joints need it, d_t(C_q), else zeros."""
    solver: Any = chain.change.solver()
    with initialized_solver(solver, chain.mbs, make_evaluation_settings(), chain.change.initialize):
        M, f = mass_matrix_and_force(solver, chain.mbs)
        M = chain.change.mass_matrix(chain, M)

        def constraint_jacobian() -> Array:
            # ComputeJacobianAE adds to the Jacobian, which starts unset.
            solver.SetSystemJacobian(np.zeros_like(solver.GetSystemJacobian()))
            solver.ComputeJacobianAE(chain.mbs)
            return chain.change.jacobian(chain, np.array(solver.GetSystemJacobian())[len(M) :, : len(M)])

        C = constraint_jacobian()
        if all(kind.has_attitude for kind in chain.model.kinds):
            return M, f, C, np.zeros_like(C)
        return M, f, C, _rate_along_velocity(chain, constraint_jacobian)


def _used_rows(chain: ExudynChain, C: Array) -> Indices:
    """Return the rows of C to solve with: not the empty ones of free axes, nor those of loops that depend."""
    used = np.flatnonzero(np.any(C != 0, axis=1))
    return used[independent_rows(C[used])] if chain.model.has_loops else used


def _rate_along_velocity(chain: ExudynChain, jacobian: Callable[[], Array]) -> Array:
    """Return d_t(C_q) along q̇: of a polynomial of degree 4 at most in t, so that five points give it."""
    data, qdot = chain.mbs.systemData, chain.qdot.ravel()
    step = 0.5 / max(float(np.max(np.abs(qdot))), 1e-6)
    values = []
    for count in (-2, -1, 1, 2):
        data.SetODE2Coordinates(count * step * qdot)
        values.append(jacobian())
    data.SetODE2Coordinates(0 * qdot)
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)


def _constrained_axes(kind: JointKind) -> list[int]:
    """Of ObjectJointGeneric: three displacements and three rotations, in the joint's axes of the far body."""
    if kind.has_attitude:
        return []
    return [int(axis not in axes) for axes in (kind.slide_axes, kind.turn_axes) for axis in range(3)]


def _constraint_accelerations(chain: ExudynChain, C: Array, C_rate: Array) -> Array:
    """Return γ (nc,) of C q̈ = γ.

    Pieces of one body turn alike, so that γ of a weld's rotations is 0.
    """
    data, model = chain.mbs.systemData, chain.model
    gamma = np.zeros(len(C))
    data.SetODE2Coordinates_tt(np.zeros(C.shape[1]))
    for i, node in enumerate(chain.nodes):
        if len(rows := list(data.GetNodeLTGAE(node))):  # |p| = 1
            gamma[rows] = -2 * chain.qdot[i, 3:] @ chain.qdot[i, 3:]
    for k, joint in enumerate(chain.joints):
        if not model.kinds[k].holds_no_turn:
            rows = chain.joint_rows(k)
            gamma[rows] = -C_rate[rows] @ chain.qdot.ravel()
            continue
        bend = chain.joint_output(k, Output.Acceleration)
        if model.length[k] > 0:  # (‖d‖)¨ = (dᵀd̈ + ḋᵀḋ - (‖d‖˙)²) / ‖d‖, and ‖d‖˙ = 0 on the manifold
            d, ddot = (chain.joint_output(k, what) for what in (Output.Position, Output.Velocity))
            bend = (d @ bend + ddot @ ddot) / np.linalg.norm(d)
        gamma[data.GetObjectLTGAE(joint)[: np.size(bend)]] = -bend
    for weld, one, other in zip(chain.welds, chain.first_piece, chain.last_piece, strict=False):
        rows = data.GetObjectLTGAE(weld)[:3]
        there, here = (chain.output_at(piece, Output.Acceleration, np.zeros(3)) for piece in (other, one))
        gamma[rows] = -C[rows, chain.width * other : chain.width * other + 3] @ (there - here)
    return gamma


def _coordinate_rate_map(chain: ExudynChain) -> Array:
    """Return the matrix from ν = (u̇ of the rods, ω′ of all bodies) to (ṙ, θ̇) of all bodies."""
    rates = remembered_velocity_jacobian(chain.model, chain.state).reshape(chain.model.n, 6, -1)
    both = np.concatenate([rates[:, :3], chain.rates @ rates[:, 3:]], axis=1)
    return both.reshape(chain.width * chain.model.n, -1)


def _solve(S: Array, b: Array) -> Array:
    """Solve S x = b with a symmetric S, equilibrated, refined with extended-precision residuals."""
    scale = 1 / np.sqrt(np.max(np.abs(S), axis=1))
    factor = scipy.linalg.lu_factor(S * scale[:, None] * scale)
    x = scale * scipy.linalg.lu_solve(factor, scale * b)
    for _ in range(2):
        residual = np.asarray(b - S.astype(np.longdouble) @ x, dtype=float)
        x += scale * scipy.linalg.lu_solve(factor, scale * residual)
    return np.asarray(x)
