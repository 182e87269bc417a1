"""Exudyn in minimal coordinates: one ObjectKinematicTree, a ball joint as three revolutes on massless links.

    ball   Z-Y-X revolutes, the last link being the body;   singular where the middle angle is ±90°
    rod    Z-Y revolutes and a massless link of length ℓ along x (u = Rz Ry eₓ), then the body's ball;
           singular where u comes parallel to the first axis.  The rod takes its axial spin from the
           body before it; it has no inertia, so that spin acts on nothing, and the mass matrix is regular

    hinge, universal, slide, cylindrical: revolutes and slides along the joint's own axes, the inner links
           massless; a welded body is merged into its far body's link; a free body is attached to three slides
           along the world's axes and a ball

    rotors, springs, dampers, efforts: an ObjectGenericODE2 on the coordinates of their joints; a ball joint's
           would be functions of its three angles, and are not built

Axes are chosen by the initial state: all angles start at 0, and the first axis is that of the initial
relative rotation, along which the first angle may turn without limit.  Frames and offsets: at the start,
with E the link's axes in the world as columns and B = Aᵀ E the same in the body's frame,

    position of the centre of mass in the link  -Bᵀ s_prox;   inertia  Bᵀ J B;   ω′ = B ω_link
    q̇ = W ν,   ν = (u̇ of the rods, ω′ of all bodies);         M = Wᵀ M_engine W

Attitudes are quaternions, scalar first, multiplied up along the chain from the angles (Exudyn has none):

    p_k = [turns of the angles of all links from the world to body k about their axes at the start] p_k(0)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import cos, remainder, tau
from typing import Any, ClassVar

import exudyn
import numpy as np

from adapters.exudyn_common import (
    ExudynAdapter,
    Output,
    add_loads,
    add_point_springs,
    initialized_solver,
    items,
    make_settings,
    make_system,
    mass_matrix_and_force,
    run_solver,
    set_explicit_method,
    set_linear_solver,
    silence_engine,
    written_items,
)
from adapters.exudyn_tree_variants import VARIANTS, TreeChange
from plumbline.engines.variants import names_of_column, names_of_steps
from plumbline.model.datatypes import (
    Array,
    Float,
    Integrator,
    Model,
    State,
    StateQuantities,
    StepRun,
    Trajectory,
    Unsupported,
)
from plumbline.model.kinematics import (
    JointFrame,
    cross,
    elastic_energy,
    minimal_rates,
    own_rates,
    quaternion_product,
    quaternion_rate,
    remembered_velocity_jacobian,
    rotate_vectors,
    rotation_matrix,
)
from plumbline.model.step_methods import JointSpaceMethod, classical_runge_kutta, runge_kutta

SENSOR_OUTPUTS = (
    Output.Position,
    Output.Velocity,
    Output.AngularVelocityLocal,
    Output.Acceleration,
    Output.AngularAccelerationLocal,
)
SLIDES = tuple(getattr(exudyn.JointType, name) for name in ("PrismaticX", "PrismaticY", "PrismaticZ"))
# cosine of a middle angle, 84.3°: the other two angles' rates grow as its inverse
MIN_COS_MIDDLE_ANGLE = 0.1


@dataclass(eq=False)
class _Link:
    """A link of the kinematic tree, on a revolute or a slide."""

    joint: Any
    parent: int  # −1: the world
    axes_in_parent: Float[Array, "3 3"]
    offset: Float[Array, "3"]  # m, in the parent
    axis: Float[Array, "3"]  # of the joint at the start, world frame
    start: float  # where its coordinate of 0 is, as `Trajectory` counts it
    centre: Array = field(default_factory=lambda: np.zeros(3))  # of mass, m
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))  # kg m², about the centre of mass
    mass: float = 0.0  # kg


class _Linkage:
    """The links of a mechanism at one state, and the matrix W of q̇ = W ν.

    Per body: its link, the link's axes in the body's frame (3, 3) as columns, and the link's origin there.
    """

    def __init__(self, model: Model, state: State) -> None:
        self.model, self.state = model, state
        self.attitude = rotation_matrix(state.p)
        self.nu = minimal_rates(model, state)
        self.links: list[_Link] = []
        self.middle_angles: list[tuple[int, int]] = []  # number of the link, and the body that hangs by it
        self.angle_axes: list[Array] = []  # of revolutes that carry balls and rods, world
        self.link_of_body: list[int] = []
        self.origins: list[Array] = []
        self.W, self._rates = np.zeros((0, len(self.nu))), np.eye(len(self.nu))  # rows of single rates of ν
        self.motions: list[tuple[int, int, int]] = []  # link, joint and its coordinate
        self.link_axes: list[Array] = []  # as `_axes`, at each body
        self._body_spins = (
            self.attitude @ remembered_velocity_jacobian(model, state).reshape(model.n, 6, -1)[:, 3:]
        )
        # Of the last link: its number, its axes in the world, the point in it where the next one hangs, and
        # its angular velocity in the world as a matrix on ν.
        self._last, self._axes, self._hang = -1, np.eye(3), np.zeros(3)
        self._spin = np.zeros((3, len(self.nu)))
        for k, (kind, own) in enumerate(zip(model.kinds, own_rates(model), strict=True)):
            self._go_to_far_body(k)
            if kind.is_rigid:
                far = model.body[k, 0]
                place = state.r[far] + self.attitude[far] @ self.origins[far]
                self._carry_body(k, self.attitude[k].T @ (place - state.r[k]))
                continue
            if kind.holds_distance:
                self._add_rod(k)
            if kind.holds_nothing:
                self._add_shifts(k, own)
            if kind.has_attitude:
                self._add_turned_body(k)
            else:
                self._add_jointed_body(k, own)
        self.body_axes = self.attitude.swapaxes(-1, -2) @ np.array(self.link_axes)

    def _go_to_far_body(self, k: int) -> None:
        """Continue from the link that joint k is attached to."""
        far, point = self.model.body[k, 0], self.model.point[k, 0]
        if far < 0:
            self._last, self._axes, self._hang, self._spin = -1, np.eye(3), point, 0 * self._spin
            return
        self._last, self._axes = self.link_of_body[far], self.link_axes[far]
        self._hang = self._axes.T @ self.attitude[far] @ (point - self.origins[far])
        self._spin = self._body_spins[far]

    def _add_rod(self, k: int) -> None:
        u = self.state.u[k]
        start = 3 * int(np.sum(self.model.rods[:k]))
        target = np.zeros_like(self._spin)  # the rod's u × u̇
        target[:, start : start + 3] = cross(u, np.eye(3)).T
        relative = target - self._spin
        turning = relative @ self.nu
        z = _unit_vector(turning - u * (u @ turning), _fallback_axis(u, self.model.gravity))
        axes = np.stack([u, cross(z, u), z], axis=1)
        self._add_revolutes(2, axes, relative, k)
        self._hang = np.array([self.model.length[k], 0.0, 0.0])

    def _add_shifts(self, k: int, own: slice) -> None:
        """Add three massless slides along the world's axes, for the centre of mass of a free body."""
        self._hang = self.state.r[k]
        for i, x in enumerate(self.state.r[k]):
            self._add_link(f"Prismatic{'XYZ'[i]}", np.eye(3), x, self._rates[own.start + i])

    def _add_turned_body(self, k: int) -> None:
        model, A = self.model, self.attitude[k]
        near = model.proximal[k] * (not model.free[k])
        relative = self._body_spins[k] - self._spin
        z = _unit_vector(relative @ self.nu, _fallback_axis(A @ near, model.gravity))
        x = _perpendicular_unit(z)
        axes = np.stack([x, cross(z, x), z], axis=1)
        self._add_revolutes(3, axes, relative, k)
        self._carry_body(k, near)

    def _add_jointed_body(self, k: int, own: slice) -> None:
        """Add one link per motion of a joint; all but the last are massless."""
        A, far = self.attitude[k], self.model.body[k, 0]
        above = self.attitude[far] if far >= 0 else np.eye(3)
        joint = JointFrame(self.model, k, above)
        (shift, _), _ = joint.motion(self.state.x[k], self.state.xdot[k])
        axes = A @ rotation_matrix(self.model.turn[k, 1])
        kind = self.model.kinds[k]
        if kind.exchanges_axes:  # the link between has x of the far and y of the near body
            x, y = joint.axes(self.state.x[k])[0].axis, axes[:, 1]
            axes = np.stack([x, y, cross(x, y)], axis=1)
        self._hang = self._hang + self._axes.T @ shift
        for i, (what, axis) in enumerate(joint.motions):
            name = ("Revolute" if what == "turn" else "Prismatic") + "XYZ"[axis]
            is_carried = what == "slide" and not kind.is_about_z  # by the far body, as the turn comes later
            link_axes = above @ rotation_matrix(self.model.turn[k, 0]) if is_carried else axes
            self._add_link(name, link_axes, self.state.x[k, i], self._rates[own.start + i])
            self.motions.append((self._last, k, i))
        self._carry_body(k, self.model.proximal[k])

    def _add_link(
        self, joint: str, axes: Array, start: float, row: Array, twist: Array | None = None
    ) -> None:
        """Add a massless link with these axes in the world on a joint, and its row of W.

        Args:
            start: where the joint's coordinate of 0 is.
            twist: of its axes in the link before, where they are known without rounding.

        """
        kind, along = getattr(exudyn.JointType, joint), axes[:, "XYZ".index(joint[-1])]
        twist = self._axes.T @ axes if twist is None else twist
        self.links.append(_Link(kind, self._last, twist, self._hang, along, start))
        self._last, self._axes, self._hang = len(self.links) - 1, axes, np.zeros(3)
        self.W = np.vstack([self.W, row])

    def _carry_body(self, k: int, origin: Array) -> None:
        """Give the last link, whose origin is there in body k, the mass of the body besides its own."""
        self.link_of_body.append(self._last)
        self.origins.append(origin)
        self.link_axes.append(self._axes)
        link, mass, B = self.links[self._last], float(self.model.mass[k]), self.attitude[k].T @ self._axes
        arm = -B.T @ origin - link.centre
        share = mass / (link.mass + mass)
        parallel = link.mass * share * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        link.inertia = link.inertia + B.T @ self.model.inertia[k] @ B + parallel
        link.centre = link.centre + share * arm
        link.mass += mass

    def _add_revolutes(self, count: int, axes: Array, relative: Array, body: int) -> None:
        """Add massless revolutes that turn ``axes`` against the link before at the rate ``relative`` ν."""
        self.middle_angles.append((len(self.links) + 1, body))
        for i, letter in enumerate("ZYX"[:count]):
            axis = axes[:, 2 - i]
            self._add_link(f"Revolute{letter}", axes, 0.0, axis @ relative, np.eye(3) if i else None)
            self.angle_axes.append(axis)
            self._spin = self._spin + np.outer(axis, axis @ relative)


class _KinematicTree:
    """The assembled tree at one state, and the maps between its angles and bodies."""

    def __init__(self, model: Model, state: State, change: TreeChange = TreeChange()) -> None:  # noqa: B008
        self.model, self.state, self.change = model, state, change
        self.linkage = _Linkage(model, state)
        self.initial_angle_rates = self.linkage.W @ self.linkage.nu
        self.mbs, self.container = make_system()
        given = self.linkage.links, model.gravity, self.initial_angle_rates
        self.node, self.tree = change.add_tree(self.mbs, *given)
        self._add_joint_elements()
        self.body_axes_of_links = self.linkage.body_axes  # (N, 3, 3) B
        self.sensors: dict[Any, list[Any]] = {output: [] for output in SENSOR_OUTPUTS}
        ground = self.mbs.AddObject(items.ObjectGround())
        pivot = self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground))
        for k in range(model.n):
            self._add_loads_and_sensors(k, pivot)
        add_point_springs(self.mbs, model, partial(self._point_marker, ground), change.ways)
        self.mbs.Assemble()

    @property
    def gravity(self) -> Array:
        """The engine's own [m/s²]."""
        return np.array(self.mbs.GetObjectParameter(self.tree, "gravity"))

    def _place(self, body: int, point: Array) -> dict[str, Any]:
        """Where a point of a body is, as markers and sensors have it."""
        local = self.body_axes_of_links[body].T @ (point - self.linkage.origins[body])
        link = self.linkage.link_of_body[body]
        return {"objectNumber": self.tree, "linkNumber": link, "localPosition": local.tolist()}

    def _point_marker(self, ground: Any, body: int, point: Array) -> Any:
        """Add a marker at a point of a body, or of the world."""
        if body < 0:
            return self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground, localPosition=point.tolist()))
        return self.mbs.AddMarker(items.MarkerKinematicTreeRigid(**self._place(body, point)))

    def _add_joint_elements(self) -> None:
        """Add rotors, dampers, springs and efforts, on coordinates that are x less the state's x."""
        model, count = self.model, len(self.linkage.links)
        a, c, k, force = np.zeros((4, count))
        for link, joint, i in self.linkage.motions:
            a[link], c[link], k[link] = (
                x[joint, i] for x in (model.armature, model.damping, model.stiffness)
            )
            force[link] = model.effort[joint, i] + k[link] * (model.rest[joint, i] - self.state.x[joint, i])
        if not (np.any(a) or np.any(c) or np.any(k) or np.any(force)):
            return
        self.change.add_elements(self.mbs, self.node, a, c, k, force)

    def _add_loads_and_sensors(self, k: int, ground: Any) -> None:
        place = self._place(k, np.zeros(3))
        marker = self.mbs.AddMarker(items.MarkerKinematicTreeRigid(**place))
        moment = self.body_axes_of_links[k].T @ self.model.moment[k]
        add_loads(self.mbs, self.model, k, marker, ground, moment, self.change.ways)
        for output, sensors in self.sensors.items():
            sensor = items.SensorKinematicTree(**place, outputVariableType=output, writeToFile=False)
            sensors.append(self.mbs.AddSensor(sensor))

    def read_sensors(self, output_type: Any) -> Array:
        """Return an output (N, 3) at every centre of mass; local ones in the body's frame."""
        values = np.array([self.mbs.GetSensorValues(sensor) for sensor in self.sensors[output_type]])
        local = output_type in (Output.AngularVelocityLocal, Output.AngularAccelerationLocal)
        return np.einsum("kij,kj->ki", self.body_axes_of_links, values) if local else values

    def quaternions_at(self, angles: Array) -> Array:
        """Return the quaternions (T, N, 4) at the angles (T, ·): continuous, and the state's own at 0."""
        turned: list[Array] = []
        for link, angle in zip(self.linkage.links, angles.T, strict=True):
            half = 0.5 * angle[:, None] * (link.joint not in SLIDES)
            turn = np.hstack([np.cos(half), np.sin(half) * link.axis])
            turned.append(quaternion_product(turned[link.parent], turn) if link.parent >= 0 else turn)
        links = self.linkage.link_of_body
        moved = [turned[link] if link >= 0 else np.array([1.0, 0.0, 0.0, 0.0]) for link in links]
        return np.stack([quaternion_product(q, p) for q, p in zip(moved, self.state.p, strict=True)], 1)

    def read_sample(self) -> tuple[Array, ...]:
        """Return the angles and their rates, and r, v and ω′ of all bodies."""
        return (
            np.array(self.mbs.systemData.GetODE2Coordinates()),
            np.array(self.mbs.systemData.GetODE2Coordinates_t()),
            self.read_sensors(Output.Position),
            self.read_sensors(Output.Velocity),
            self.read_sensors(Output.AngularVelocityLocal),
        )

    def check_singularity(self, t: float) -> None:
        """Raise Unsupported once a middle angle is near ±90°."""
        angles = self.mbs.systemData.GetODE2Coordinates()
        for number, body in self.linkage.middle_angles:
            middle = angles[number]
            if cos(middle) < MIN_COS_MIDDLE_ANGLE:
                raise Unsupported(
                    f"the angles of body {body + 1} come near their singularity at "
                    f"t = {t:.6g} s (middle angle {np.degrees(remainder(middle, tau)):.1f}°)",
                    "angles",
                )


def _unit_vector(wanted: Array, fallback: Array) -> Array:
    """Return the unit vector (3,) along ``wanted``, or the fallback where that is zero."""
    size = np.linalg.norm(wanted)
    return wanted / size if size > 0 else fallback


def _fallback_axis(arm: Array, gravity: Array) -> Array:
    """Return the axis (3,) about which gravity turns an arm at rest; if it does not, a perpendicular one."""
    return _unit_vector(cross(gravity, arm), _perpendicular_unit(_unit_vector(arm, np.eye(3)[0])))


def _perpendicular_unit(unit: Array) -> Array:
    """Return a unit vector (3,) perpendicular to a unit vector."""
    across = cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    return across / np.linalg.norm(across)


def _alone(name: str, order: int, method: str | JointSpaceMethod, note: str) -> Any:
    """An integrator that is compared by single steps alone, of a method or one with a tableau."""
    by = runge_kutta(method, **_SOLVED) if isinstance(method, str) else method
    names = f"DynamicSolverType.{name}", "TimeIntegrationSettings.absoluteTolerance"
    return {"order": order, "method": by, "note": note, "has_motions": False, "names": names}


# EXUdense, Exudyn's usual solver, keeps the inverse of a matrix in place of its factors.
_SOLVED: Any = {"coordinates": "joint angles", "inverts_mass_matrix": True}
_EULER = JointSpaceMethod("Runge-Kutta", **_SOLVED, stages=((),), weights=(1.0,))
_VERLET = JointSpaceMethod("velocity Verlet", **_SOLVED, reuses_acceleration=True)
_MIDPOINT, _HEUN = "the explicit midpoint rule (order 2)", "Heun's method of order 3"
_ODE23, _DOPRI5 = "Bogacki and Shampine's method of order 3", "Dormand and Prince's method of order 5"
_TO_SECOND = "velocity Verlet; of order 2 without terms of velocities"


class ExudynTree(ExudynAdapter):
    """Minimal coordinates: nothing to drift, and angles that can become singular."""

    name = "exudyn-tree"
    title = "Exudyn (kinematic tree)"
    reproduction_template = "exudyn-tree"
    other_formulation = "exudyn"
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator(
            "RK44",
            "step",
            4,
            (4, 5, 6, 7, 8),
            note="classical Runge-Kutta on joint angles",
            method=classical_runge_kutta(**_SOLVED),
            names=names_of_steps("exudyn-tree")["RK44"],
        ),
        Integrator("ExplicitEuler", "step", **_alone("ExplicitEuler", 1, _EULER, "explicit Euler")),
        Integrator("ExplicitMidpoint", "step", **_alone("ExplicitMidpoint", 2, _MIDPOINT, "midpoint rule")),
        Integrator("RK33", "step", **_alone("RK33", 3, _HEUN, "Heun, order 3")),
        Integrator("ODE23", "step", **_alone("ODE23", 3, _ODE23, "steps as given")),
        Integrator("DOPRI5", "step", **_alone("DOPRI5", 5, _DOPRI5, "steps as given")),
        Integrator("RK67", "step", **_alone("RK67", 6, "Butcher's method of order 6", "Butcher, order 6")),
        Integrator("VelocityVerlet", "step", **_alone("VelocityVerlet", 1, _VERLET, _TO_SECOND)),
    )
    unsupported: ClassVar[Mapping[str, str]] = {
        "joint_reaction": "minimal coordinates have no forces at the joints"
    }
    gaps: ClassVar[Mapping[str, str]] = {
        "ball elements": "a ball joint of Exudyn's kinematic tree is three revolutes, whose angles are not "
        "the rotation vector that springs, dampers and rotors of ball joints act on",
        "pitches": "Exudyn's kinematic tree has revolute and prismatic joints, none that turns and advances",
        "joint_moment": "minimal coordinates have no moments at the joints",
        "angles": "each ball of the tree is three revolute joints, each rod two: singular at a right angle",
    }
    builds_trees = builds_elements = True
    loops_unsupported_reason = "a kinematic tree of Exudyn has no joints that close loops"
    variants = VARIANTS
    column_names = names_of_column("exudyn-tree", {})
    usual_linear_solver = "EXUdense"
    linear_solvers = ("EigenSparse",)
    welding_unsupported_reason = (
        "a kinematic tree has revolute and prismatic joints, none that holds two links rigidly"
    )

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        with silence_engine():
            change = self.variant.change if self.variant else TreeChange()
            return [_evaluate_state(_KinematicTree(model, state, change)) for state in states]

    def written(self, model: Model, state: State, moves: bool = False) -> dict[str, Any]:
        """Return the items of the assembled system, and what the read-out needs, of one state."""
        with silence_engine():
            tree = _KinematicTree(model, state)
            fields = {"gravity": tree.gravity}
            found = written_items(tree.mbs)
        fields |= {"rates": tree.initial_angle_rates, "joint_rates": tree.linkage.W}
        fields |= {"frames": tree.body_axes_of_links, "A": tree.linkage.attitude}
        fields |= {"elastic": np.array(elastic_energy(model, state))}
        links = [(x.parent, None if x.joint in SLIDES else x.axis.tolist()) for x in tree.linkage.links]
        sensors = {str(output).split(".")[-1]: [*map(int, own)] for output, own in tree.sensors.items()}
        bodies = tree.linkage.link_of_body
        return {"items": found, "sensors": sensors, "links": links, "bodies": bodies, "fields": fields}

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        with silence_engine():
            tree = _KinematicTree(model, state)
            settings = _settings(integrator.name)
            set_linear_solver(settings, self.option or self.usual_linear_solver)
            solver = exudyn.MainSolverExplicit()
            samples, clock = run_solver(
                solver, tree.mbs, settings, times, resolution, tree.read_sample, tree.check_singularity
            )
        angles, rates, r, v, omega = (np.array(column) for column in zip(*samples, strict=True))
        p = tree.quaternions_at(angles)
        pdot, steps = quaternion_rate(p, omega), round(float(times[-1] / resolution))
        coordinates = angles + [link.start for link in tree.linkage.links]
        return Trajectory(clock, r, p, v, pdot, steps, coordinates=coordinates, velocities=rates)

    def _step(self, model: Model, state: State, times: Array, integrator: Integrator, step: float) -> StepRun:
        run = self._simulate(model, state, times, integrator, step)
        return StepRun(run, angle_axes=np.reshape(_Linkage(model, state).angle_axes, (-1, 3)))


def _settings(method: str = "RK44") -> Any:
    settings = make_settings()
    set_explicit_method(settings, method)
    return settings


def _evaluate_state(tree: _KinematicTree) -> StateQuantities:
    """Evaluate all but joint forces, which minimal coordinates do not have, from M, f and outputs.

    M q̈ = f,   T = ½ q̇ᵀ M q̇,   V = -Σ m g·r,   angular momentum Σ r × m v + A J ω′
    """
    solver: Any = exudyn.MainSolverExplicit()
    with initialized_solver(solver, tree.mbs, _settings()):
        M, f = mass_matrix_and_force(solver, tree.mbs)
    M, a = tree.change.matrices(tree, (M, np.asarray(np.linalg.solve(M, f))))
    tree.mbs.systemData.SetODE2Coordinates_tt(a)
    W, mass = tree.linkage.W, tree.model.mass  # links have the masses of several bodies where one is welded
    r, v, omega = (tree.read_sensors(output) for output in SENSOR_OUTPUTS[:3])
    spin = rotate_vectors(tree.linkage.attitude, rotate_vectors(tree.model.inertia, omega))
    return StateQuantities(
        acceleration=tree.read_sensors(Output.Acceleration),
        angular_acceleration=tree.read_sensors(Output.AngularAccelerationLocal),
        kinetic_energy=float(0.5 * tree.initial_angle_rates @ M @ tree.initial_angle_rates),
        potential_energy=elastic_energy(tree.model, tree.state)  # springs have no output of it
        - float(mass @ (r @ tree.gravity)),
        angular_momentum=np.sum(cross(r, mass[:, None] * v) + spin, axis=0),
        mass_matrix=W.T @ M @ W,
    )
