"""Exudyn in minimal coordinates: one ObjectKinematicTree, a ball joint as three revolutes on massless links.

    ball   Z-Y-X revolutes, the last link being the body;   singular where the middle angle is ±90°
    rod    Z-Y revolutes and a massless link of length ℓ along x (u = Rz Ry eₓ), then the body's ball;
           singular where u comes parallel to the first axis.  The rod takes its axial spin from the
           body before it; it has no inertia, so that spin acts on nothing, and the mass matrix is regular

Axes are chosen by the initial state: all angles start at 0, and the first axis is that of the initial
relative rotation, along which the first angle may turn for ever.  At the start, with E the link's axes
in the world as columns and B = Aᵀ E the same in the body's frame:

    position of the centre of mass in the link  -Bᵀ s_prox;   inertia  Bᵀ J B;   ω′ = B ω_link
    q̇ = W ν,   ν = (u̇ of the rods, ω′ of all bodies);         M = Wᵀ M_engine W
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import remainder, tau
from typing import Any, ClassVar

import exudyn
import numpy as np

from adapters.exudyn_common import (
    SUPPORTED_VERSIONS,
    add_loads,
    items,
    make_settings,
    make_system,
    run_solver,
    set_linear_solver,
    set_rk44,
    silence_engine,
    version,
)
from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
    Unsupported,
)
from plumbline.model.kinematics import (
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    rotation_matrix,
)

Output = exudyn.OutputVariableType
# cosine of a middle angle, 84.3°: the other two angles' rates grow as its inverse
MIN_COS_MIDDLE_ANGLE = 0.1


@dataclass(frozen=True, eq=False)
class RevoluteGroup:
    """Two or three revolutes in a row (Z, Y and, for a ball, X) whose angles start at 0."""

    first_angle: int  # index of the first angle
    angle_count: int  # 2 for a rod, 3 for a ball
    axes: Array  # (3, 3) world axes of the link at the start, columns x, y, z
    body_axes: Array  # (3, 3) the same in the frame of the body that it turns (of the one before, for a rod)
    body: int  # the body it hangs, for messages


class KinematicTree:
    """The assembled tree at one state, and the maps between its angles and bodies."""

    def __init__(self, model: Model, state: State) -> None:
        self.model, self.state = model, state
        n, rods = model.n, int(np.sum(model.rods))
        A = rotation_matrix(state.p)
        nu = np.concatenate([state.udot[model.rods].ravel(), state.omega.ravel()])
        self.revolute_groups: list[RevoluteGroup] = []
        self.W = np.zeros((0, 3 * rods + 3 * n))  # q̇ = W ν
        links: list[tuple[Any, int, Array, Array, Array, Array, float]] = []
        before, hang = (
            np.eye(3),
            np.zeros(3),
        )  # axes of the link before (world), where the next one hangs on it
        spin = np.zeros((3, len(nu)))  # its angular velocity in the world, as a matrix on ν
        self.link_of_body: list[int] = []  # link of each body

        def add(count: int, axes: Array, at: Array, offset: Array, relative: Array, body: int) -> None:
            """Massless revolutes that turn ``axes`` against the link before at the rate ``relative`` ν."""
            nonlocal spin
            self.revolute_groups.append(RevoluteGroup(len(links), count, axes, at, body))
            for i, joint in enumerate(("RevoluteZ", "RevoluteY", "RevoluteX")[:count]):
                twist = before.T @ axes if i == 0 else np.eye(3)
                where = offset if i == 0 else np.zeros(3)
                kind = getattr(exudyn.JointType, joint)
                links.append((kind, len(links) - 1, twist, where, np.zeros(3), np.zeros((3, 3)), 0.0))
                axis = axes[:, 2 - i]
                self.W = np.vstack([self.W, axis @ relative])
                spin = spin + np.outer(axis, axis @ relative)

        rod = 0
        for k in range(n):
            fallback = _fallback_axis(A[k] @ model.proximal[k], model.gravity)
            if model.length[k] > 0:
                wanted = np.zeros_like(spin)  # the rod's u × u̇
                wanted[:, 3 * rod : 3 * rod + 3] = np.cross(state.u[k], np.eye(3)).T
                relative = wanted - spin
                fast = relative @ nu
                z = _unit_vector(
                    fast - state.u[k] * (state.u[k] @ fast), _fallback_axis(state.u[k], model.gravity)
                )
                axes = np.stack([state.u[k], np.cross(z, state.u[k]), z], axis=1)
                add(2, axes, A[k - 1].T @ axes if k else axes, hang, relative, k)
                before, hang = axes, np.array([model.length[k], 0.0, 0.0])
                rod += 1
            wanted = np.zeros_like(spin)
            wanted[:, 3 * (rods + k) : 3 * (rods + k) + 3] = A[k]
            relative = wanted - spin
            z = _unit_vector(relative @ nu, fallback)
            x = _perpendicular_unit(z)
            axes = np.stack([x, np.cross(z, x), z], axis=1)
            B = A[k].T @ axes
            add(3, axes, B, hang, relative, k)
            kind, parent, twist, where, *_ = links[-1]
            inertia = B.T @ model.inertia[k] @ B
            links[-1] = (kind, parent, twist, where, -B.T @ model.proximal[k], inertia, float(model.mass[k]))
            self.link_of_body.append(len(links) - 1)
            before, hang = axes, B.T @ (model.distal[k] - model.proximal[k])

        self.initial_angle_rates = self.W @ nu
        kinds, parents, twists, offsets, coms, inertias, masses = map(list, zip(*links, strict=True))
        self.mbs, self.container = make_system()
        mbs, zeros = self.mbs, [0.0] * len(links)
        matrices: Any = exudyn.Matrix3DList
        vectors: Any = exudyn.Vector3DList
        node = mbs.AddNode(
            items.NodeGenericODE2(
                referenceCoordinates=zeros,
                initialCoordinates=zeros,
                initialCoordinates_t=self.initial_angle_rates.tolist(),
                numberOfODE2Coordinates=len(links),
            )
        )
        self.tree = mbs.AddObject(
            items.ObjectKinematicTree(
                nodeNumber=node,
                gravity=model.gravity.tolist(),
                jointTypes=kinds,
                linkParents=parents,
                jointTransformations=matrices(twists),
                jointOffsets=vectors(offsets),
                linkInertiasCOM=matrices(inertias),
                linkCOMs=vectors(coms),
                linkMasses=masses,
            )
        )
        ground = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=mbs.AddObject(items.ObjectGround())))
        self.sensors: dict[Any, list[Any]] = {
            what: []
            for what in (
                Output.Position,
                Output.Velocity,
                Output.AngularVelocityLocal,
                Output.Acceleration,
                Output.AngularAccelerationLocal,
            )
        }
        self.body_axes_of_links = np.array(
            [turn.body_axes for turn in self.revolute_groups if turn.angle_count == 3]
        )  # (N, 3, 3) B
        for k, link in enumerate(self.link_of_body):
            place = {"objectNumber": self.tree, "linkNumber": link, "localPosition": coms[link].tolist()}
            marker = mbs.AddMarker(items.MarkerKinematicTreeRigid(**place))
            add_loads(mbs, model, k, marker, ground, self.body_axes_of_links[k].T @ model.moment[k])
            for what, found in self.sensors.items():
                sensor = items.SensorKinematicTree(**place, outputVariableType=what, writeToFile=False)
                found.append(mbs.AddSensor(sensor))
        mbs.Assemble()

    def read_sensors(self, output_type: Any) -> Array:
        """(N, 3) an output at every centre of mass; those of the link turned into the body's frame."""
        values = np.array([self.mbs.GetSensorValues(sensor) for sensor in self.sensors[output_type]])
        local = output_type in (Output.AngularVelocityLocal, Output.AngularAccelerationLocal)
        return np.einsum("kij,kj->ki", self.body_axes_of_links, values) if local else values

    def quaternions_at(self, angles: Array) -> Array:
        """(N, 4) quaternions at the angles: continuous, and the state's own at 0."""
        now = then = np.array([1.0, 0.0, 0.0, 0.0])  # of the frame before, which a rod turns along
        out = np.empty((self.model.n, 4))
        for turn in self.revolute_groups:
            half = 0.5 * angles[turn.first_angle : turn.first_angle + turn.angle_count]
            spun = np.array([1.0, 0.0, 0.0, 0.0])
            for i, h in enumerate(half):
                spun = quaternion_product(spun, np.array([np.cos(h), *(np.sin(h) * np.eye(3)[2 - i])]))
            spun[1:] = turn.body_axes @ spun[1:]
            if turn.angle_count == 2:
                now = quaternion_product(now, spun)
            else:
                start = self.state.p[turn.body]
                now = quaternion_product(
                    quaternion_product(now, quaternion_product(quaternion_conjugate(then), start)), spun
                )
                then = start
                out[turn.body] = now
        return out

    def check_singularity(self, t: float) -> None:
        """Unsupported once a middle angle is near ±90°."""
        angles = self.mbs.systemData.GetODE2Coordinates()
        for turn in self.revolute_groups:
            middle = float(angles[turn.first_angle + 1])
            if np.cos(middle) < MIN_COS_MIDDLE_ANGLE:
                what = "rod" if turn.angle_count == 2 else "ball joint"
                raise Unsupported(
                    f"the angles of the {what} of body {turn.body + 1} come near their singularity at "
                    f"t = {t:.6g} s (middle angle {np.degrees(remainder(middle, tau)):.1f}°)"
                )


def _unit_vector(wanted: Array, fallback: Array) -> Array:
    """(3,) the unit vector along ``wanted``, or the fallback where that is zero."""
    size = np.linalg.norm(wanted)
    return np.asarray(wanted / size if size > 0 else fallback)


def _fallback_axis(arm: Array, gravity: Array) -> Array:
    """(3,) the unit axis about which gravity will turn an arm at rest; any across it where there is none."""
    return _unit_vector(np.cross(gravity, arm), _perpendicular_unit(_unit_vector(arm, np.eye(3)[0])))


def _perpendicular_unit(unit: Array) -> Array:
    """(3,) a unit vector across a unit vector."""
    across = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    return np.asarray(across / np.linalg.norm(across))


class ExudynTree(MetamorphicHooks):
    """Minimal coordinates: nothing to drift, and angles that can become singular."""

    name = "exudyn-tree"
    title = "Exudyn (kinematic tree)"
    package = "exudyn"
    reproduction_template = "exudyn-tree"
    other_formulation = "exudyn"
    supported_versions = SUPPORTED_VERSIONS
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator("RK44", "step", 4, (4, 5, 6, 7, 8), note="classical Runge-Kutta on joint angles"),
    )
    usual_linear_solver = "EXUdense"
    linear_solvers = ("EigenSparse",)
    welding_unsupported_reason = (
        "a kinematic tree has revolute and prismatic joints, none that holds two links rigidly"
    )

    def version(self) -> str:
        """Version of the Exudyn that runs."""
        return version()

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        with silence_engine():
            return [evaluate_state(model, state) for state in states]

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        with silence_engine():
            tree = KinematicTree(model, state)
            solver = exudyn.MainSolverExplicit()

            def read() -> tuple[Array, Array, Array, Array]:
                p = tree.quaternions_at(tree.mbs.systemData.GetODE2Coordinates())
                omega = tree.read_sensors(Output.AngularVelocityLocal)
                return (
                    tree.read_sensors(Output.Position),
                    p,
                    tree.read_sensors(Output.Velocity),
                    quaternion_rate(p, omega),
                )

            chosen = rk44_settings()
            set_linear_solver(chosen, self.option or self.usual_linear_solver)
            rows = run_solver(solver, tree.mbs, chosen, times, resolution, read, tree.check_singularity)
        r, p, v, pdot = (np.array(column) for column in zip(*rows, strict=True))
        return Trajectory(times.copy(), r, p, v, pdot, round(float(times[-1] / resolution)))


def rk44_settings() -> Any:
    """Settings of RK44."""
    chosen = make_settings()
    set_rk44(chosen)
    return chosen


def evaluate_state(model: Model, state: State) -> StateQuantities:
    """All but joint forces, which minimal coordinates do not have, from the tree's own M, f and outputs.

        M q̈ = f,   T = ½ q̇ᵀ M q̇,   V = -Σ m g·r of its links,   μ = M q̇

    The momentum μ of an angle is the angular momentum of all beyond it about that angle's axis.  A ball at
    the pivot has three axes there; a rod has two, and along u the angular momentum about the pivot is that
    about the rod's end, where the ball's axes are.
    """
    tree = KinematicTree(model, state)
    chosen = rk44_settings()
    solver: Any = exudyn.MainSolverExplicit()
    if not solver.InitializeSolver(tree.mbs, chosen):
        raise EngineFailure(f"Exudyn could not initialise its solver: {solver.GetErrorString()}")
    try:
        solver.ComputeMassMatrix(tree.mbs)
        M = np.array(solver.GetSystemMassMatrix())
        solver.ComputeODE2RHS(tree.mbs)
        f = np.array(solver.GetSystemResidual())[: len(M)]
    finally:
        solver.FinalizeSolver(tree.mbs, chosen)
    tree.mbs.systemData.SetODE2Coordinates_tt(np.linalg.solve(M, f))
    momentum = M @ tree.initial_angle_rates
    first, *rest = tree.revolute_groups
    L = first.axes[:, ::-1][:, : first.angle_count] @ momentum[: first.angle_count]
    if first.angle_count == 2:
        beyond = rest[0].axes[:, ::-1] @ momentum[2:5]
        L = L + first.axes[:, 0] * (first.axes[:, 0] @ beyond)
    masses = np.array(tree.mbs.GetObjectParameter(tree.tree, "linkMasses"))[tree.link_of_body]
    gravity = np.array(tree.mbs.GetObjectParameter(tree.tree, "gravity"))
    return StateQuantities(
        acceleration=tree.read_sensors(Output.Acceleration),
        angular_acceleration=tree.read_sensors(Output.AngularAccelerationLocal),
        kinetic_energy=float(0.5 * tree.initial_angle_rates @ momentum),
        potential_energy=float(-masses @ (tree.read_sensors(Output.Position) @ gravity)),
        angular_momentum=L,
        mass_matrix=tree.W.T @ M @ tree.W,
    )
