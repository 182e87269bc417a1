"""Defects with known names and sizes, planted in real adapters: what the harness must report, and name.

A defect alters what a real engine is given (model, state), what it gives back, or how it steps in time;
the engine itself runs.  ``named`` are the words of which the diagnosis must use one; a defect without
them need only be reported.  Indices in names count from 1, as in the results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from plumbline.engines.adapter import Adapter
from plumbline.model.datatypes import Array, Integrator, Model, State, StateQuantities, Trajectory
from plumbline.model.kinematics import quaternion_conjugate, rotation_matrix, state_from_minimal
from reference_impl.direct import DirectSystem, Solution
from reference_impl.euler_parameters import angular_velocity

Inputs = Callable[[Model, State], tuple[Model, State]]
Answers = Callable[[Model, list[State], list[StateQuantities]], list[StateQuantities]]
Run = Callable[[Callable[..., Trajectory], Model, State, Array, Integrator, float], Trajectory]


@dataclass(frozen=True)
class Defect:
    """One planted defect. Exactly one of inputs, answers, gamma and run is given."""

    name: str
    size: str  # in words and numbers
    named: tuple[str, ...] = ()
    engine: str = "mujoco"
    joints: str = "balls"  # key of tests.helpers.pendulums.JOINTS
    loaded: bool = False  # with applied loads and drag
    level: Literal["state", "motion"] = "state"
    inputs: Inputs | None = None
    answers: Answers | None = None
    gamma: Callable[[Model, State], Array] | None = None  # (c,) added to γ, on the reference
    run: Run | None = None
    integrator: str = "RK4"


def plant(real: type[Adapter], defect: Defect) -> Adapter:
    """An instance of a subclass of the real adapter with the defect in it."""

    class Planted(real):  # type: ignore[misc, valid-type]
        def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
            given = [defect.inputs(model, s) if defect.inputs else (model, s) for s in states]
            said = [super(Planted, self)._evaluate(m, [s])[0] for m, s in given]
            return defect.answers(model, list(states), said) if defect.answers else said

        def _simulate(
            self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
        ) -> Trajectory:
            if defect.inputs:
                model, state = defect.inputs(model, state)
            real_run = super()._simulate
            if defect.run:
                return defect.run(real_run, model, state, times, integrator, resolution)
            return real_run(model, state, times, integrator, resolution)

    return Planted()


class Bent(DirectSystem):
    """The notes' system with something added to γ: patched into the reference's adapter."""

    model: Model
    defect: Callable[[Model, State], Array]

    def solve(self, r: Array, p: Array, v: Array, pdot: Array, gamma_defect: Any = 0.0) -> Solution:
        """Solve with the defect in γ."""
        d = joint_directions(self.model, r, p)
        ddot = joint_directions(self.model, v, p, angular_velocity(p, pdot))
        length = np.where(self.model.rods, self.model.length, 1.0)[:, None]
        state = State(p, angular_velocity(p, pdot), d / length, ddot / length, r, v)
        return super().solve(r, p, v, pdot, type(self).defect(self.model, state))


def joint_directions(model: Model, r: Array, p: Array, omega: Array | None = None) -> Array:
    """(N, 3) joint vectors d, or their rates where r is a velocity and ω′ is given."""
    a = rotation_matrix(p)

    def point(s: Array) -> Array:
        arm = s if omega is None else np.cross(omega, s)
        return np.asarray(r + (a @ arm[..., None])[..., 0])

    return point(model.proximal) - np.concatenate([np.zeros((1, 3)), point(model.distal)[:-1]])


# --- what is altered ----------------------------------------------------------------------------


def relifted(model: Model, state: State, **minimal: Array) -> State:
    """The state of a model from its minimal coordinates, some of them replaced."""
    parts = {k: minimal.get(k, getattr(state, k)) for k in ("p", "omega", "u", "udot")}
    return state_from_minimal(model, **parts)


def parameter(field: str, *index: int, by: float = 0.0, times: float = 1.0) -> Inputs:
    """One number of the model wrong (an inertia's product on both sides), or a whole field of it."""

    def alter(model: Model, state: State) -> tuple[Model, State]:
        value = getattr(model, field).copy()
        for at in {index, (*index[:1], *index[:0:-1])}:
            value[at] = value[at] * times + by
        wrong = replace(model, **{field: value})
        return wrong, relifted(wrong, state)

    return alter


def model_change(change: Callable[[Model, State], dict[str, Array]]) -> Inputs:
    """Fields of the model replaced, depending on the state or not."""

    def alter(model: Model, state: State) -> tuple[Model, State]:
        wrong = replace(model, **change(model, state))
        return wrong, relifted(wrong, state)

    return alter


def state_change(change: Callable[[Model, State], dict[str, Array]]) -> Inputs:
    """Minimal coordinates of the state replaced."""
    return lambda model, state: (model, relifted(model, state, **change(model, state)))


def world(state: State, vectors: Array) -> Array:
    """A x of each body."""
    return np.asarray((rotation_matrix(state.p) @ vectors[..., None])[..., 0])


def body(state: State, vectors: Array) -> Array:
    """Aᵀ x of each body."""
    return np.asarray((rotation_matrix(state.p).mT @ vectors[..., None])[..., 0])


def gyroscopic(model: Model, state: State) -> Array:
    """ω′ × J ω′ (N, 3)."""
    return np.cross(state.omega, (model.inertia @ state.omega[..., None])[..., 0])


def centre_moved(k: int, shift: Array) -> Inputs:
    """The centre of mass of body k at ``shift`` from where it is: its attachments move the other way."""

    def change(model: Model, _: State) -> dict[str, Array]:
        moved = np.where(np.arange(model.n)[:, None] == k, shift, 0.0)
        return {"proximal": model.proximal - moved, "distal": model.distal - moved}

    return model_change(change)


def about_proximal(model: Model, _: State) -> dict[str, Array]:
    """Inertia of every body about its proximal point (Huygens and Steiner)."""
    s = model.proximal
    square = np.sum(s * s, -1)[:, None, None] * np.eye(3) - s[:, :, None] * s[:, None, :]
    return {"inertia": model.inertia + model.mass[:, None, None] * square}


def tilted(k: int, angle: float) -> Inputs:
    """The attitude of body k turned by an angle about its own x axis."""

    def change(_: Model, state: State) -> dict[str, Array]:
        p = state.p.copy()
        w, x, y, z = p[k]
        c, s = np.cos(angle / 2), np.sin(angle / 2)
        p[k] = [w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s]
        return {"p": p / np.linalg.norm(p, axis=1, keepdims=True)}

    return state_change(change)


def single(x: Array) -> Array:
    """Rounded to single precision."""
    return np.asarray(x, np.float32).astype(float)


def unit(p: Array) -> Array:
    """Normalised."""
    return np.asarray(p / np.linalg.norm(p, axis=-1, keepdims=True))


def single_inside(model: Model, state: State) -> tuple[Model, State]:
    """Everything the engine is given passes through single precision."""
    wrong = replace(model, **{k: single(v) for k, v in vars(model).items()})
    rounded = {k: single(getattr(state, k)) for k in ("omega", "u", "udot")}
    return wrong, relifted(wrong, state, p=unit(single(state.p)), **rounded)


def field(name: str, change: Callable[[Model, State, Any], Any]) -> Answers:
    """One quantity of each answer altered."""

    def alter(model: Model, states: list[State], said: list[StateQuantities]) -> list[StateQuantities]:
        return [
            replace(a, **{name: change(model, s, getattr(a, name))})
            for s, a in zip(states, said, strict=True)
        ]

    return alter


def stale(*names: str) -> Answers:
    """Fields still hold what they were at the state before."""

    def alter(_: Model, __: list[State], said: list[StateQuantities]) -> list[StateQuantities]:
        before = [said[-1], *said[:-1]]
        return [replace(a, **{n: getattr(b, n) for n in names}) for a, b in zip(said, before, strict=True)]

    return alter


def spin_part(model: Model, state: State) -> Array:
    """½ ω′·J ω′ summed (J)."""
    return np.asarray(0.5 * np.einsum("ki,kij,kj", state.omega, model.inertia, state.omega))


def about_centre(model: Model, state: State, said: Array) -> Array:
    """Angular momentum about the common centre of mass instead of the pivot."""
    centre = model.mass @ state.r / np.sum(model.mass)
    return np.asarray(said - np.cross(centre, model.mass @ state.v))


def far_centripetal(model: Model, state: State) -> Array:
    """−(what the far body's ω × (ω × s) gives to a ball's γ)."""
    bent = world(state, np.cross(state.omega, np.cross(state.omega, model.distal)))
    return -np.concatenate([np.zeros((1, 3)), bent[:-1]]).ravel()


def all_gamma(model: Model, state: State) -> Array:
    """−γ of ball joints."""
    bent = world(state, np.cross(state.omega, np.cross(state.omega, model.proximal)))
    return bent.ravel() + far_centripetal(model, state)


def rod_bend(model: Model, state: State) -> Array:
    """−(−2 ḋᵀḋ) of the rods' γ."""
    return np.asarray(2 * model.length**2 * np.sum(state.udot**2, -1))


# --- in time ------------------------------------------------------------------------------------


def euler_inside(
    simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float
) -> Trajectory:
    """A first-order step under the name of RK4."""
    return simulate(model, state, times, replace(i, name="Euler"), h)


def richardson_inside(
    simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float
) -> Trajectory:
    """An order-2 step under the name of RK4: Euler extrapolated once."""
    coarse, fine = (simulate(model, state, times, replace(i, name="Euler"), step) for step in (h, h / 2))
    sign = np.where(np.sum(coarse.p * fine.p, -1, keepdims=True) < 0, -1.0, 1.0)
    return replace(
        fine,
        r=2 * fine.r - coarse.r,
        p=unit(2 * fine.p - sign * coarse.p),
        v=2 * fine.v - coarse.v,
        pdot=2 * fine.pdot - sign * coarse.pdot,
        steps=coarse.steps,
    )


def slow_clock(
    simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float
) -> Trajectory:
    """Time runs 1e-6 too fast; the clock shows what was asked."""
    off = 1 + 1e-6
    return replace(simulate(model, state, times * off, i, h * off), t=times)


def one_step_late(
    simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float
) -> Trajectory:
    """Samples are taken one step after their time."""
    late = np.concatenate([[0.0], times + h])
    run = simulate(model, state, late, i, h)
    kept = [0, *range(2, len(late))]
    return Trajectory(times, *(getattr(run, k)[kept] for k in ("r", "p", "v", "pdot")), run.steps)


def rows_of(rows: Callable[[int], list[int]]) -> Run:
    """Rows of the trajectory taken from others, the times as asked."""

    def alter(simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float) -> Trajectory:
        run, order = simulate(model, state, times, i, h), rows(len(times))
        return Trajectory(times, *(getattr(run, k)[order] for k in ("r", "p", "v", "pdot")), run.steps)

    return alter


def sampled(change: Callable[[Trajectory], dict[str, Array]]) -> Run:
    """Columns of the trajectory replaced."""

    def alter(simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float) -> Trajectory:
        run = simulate(model, state, times, i, h)
        return replace(run, **change(run))

    return alter


def early_stop(
    simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float
) -> Trajectory:
    """The run ends before the last samples."""
    return simulate(model, state, times[:-3], i, h)


def damped(simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float) -> Trajectory:
    """Drag of 1e-6 N m s on every body."""
    return simulate(replace(model, drag_moment=model.drag_moment + 1e-6), state, times, i, h)


M, P, E, R = "mujoco", "pinocchio", "exudyn", "reference"
X = np.array([1.0, 0.0, 0.0])

STATE_DEFECTS = (
    # numbers of the model
    Defect("inertia-yy-1e-4", "J_yy of body 2 × (1 + 1e-4)", ("inertia yy of body 2",), M,
           inputs=parameter("inertia", 1, 1, 1, times=1 + 1e-4)),
    Defect("inertia-xx-1e-6", "J_xx of body 1 × (1 + 1e-6)", ("inertia xx of body 1",), P,
           inputs=parameter("inertia", 0, 0, 0, times=1 + 1e-6)),
    Defect("inertia-yy-7-percent", "J_yy of body 2 × 0.93", ("inertia yy of body 2",), E, "rods",
           inputs=parameter("inertia", 1, 1, 1, times=0.93)),
    Defect("inertia-xy-sign", "J_xy of body 1 × -1", ("inertia xy of body 1",), M,
           inputs=parameter("inertia", 0, 0, 1, times=-1.0)),
    Defect("inertia-products-dropped", "all products of inertia 0", ("products of inertia",), P,
           inputs=model_change(lambda m, _: {"inertia": m.inertia * np.eye(3)})),
    Defect("inertia-about-proximal", "J + m (s² I - s sᵀ)", ("inertia about the proximal point",), E,
           inputs=model_change(about_proximal)),
    Defect("inertia-in-world-axes", "A J Aᵀ in place of J", ("inertia in world axes",), M,
           inputs=model_change(lambda m, s: {"inertia": (lambda x: (x + x.mT) / 2)(
               rotation_matrix(s.p).mT @ m.inertia @ rotation_matrix(s.p))})),
    Defect("centre-0.1mm", "centre of mass of body 1 by 0.1 mm in x", ("centre of mass of body 1",), M,
           inputs=centre_moved(0, 1e-4 * X)),
    Defect("proximal-1e-5", "proximal y of body 1 by 1e-5 m", ("proximal y of body 1",), P,
           inputs=parameter("proximal", 0, 1, by=1e-5)),
    Defect("distal-1e-5", "distal x of body 1 by 1e-5 m", ("distal x of body 1",), E,
           inputs=parameter("distal", 0, 0, by=1e-5)),
    Defect("rod-length-1e-5", "length of rod 2 × (1 + 1e-5)", ("length of rod 2",), M, "rods",
           inputs=parameter("length", 1, times=1 + 1e-5)),
    Defect("mass-1-1e-5", "mass of body 1 × (1 + 1e-5)", ("mass of body 1",), E,
           inputs=parameter("mass", 0, times=1 + 1e-5)),
    Defect("mass-2-1e-5", "mass of body 2 × (1 + 1e-5)", ("mass of body 2",), P, "rods",
           inputs=parameter("mass", 1, times=1 + 1e-5)),
    Defect("mass-and-inertia-together", "all masses and inertias × (1 + 1e-4)", ("all masses and inertias",),
           inputs=model_change(lambda m, _: {k: getattr(m, k) * (1 + 1e-4) for k in ("mass", "inertia")})),
    Defect("lengths-1e-5", "all offsets × (1 + 1e-5)", ("all lengths",), P,
           inputs=model_change(lambda m, _: {k: getattr(m, k) * (1 + 1e-5)
                                             for k in ("proximal", "distal", "length")})),
    Defect("gravity-1e-5", "gravity × (1 + 1e-5)", ("gravity's size",), P,
           inputs=model_change(lambda m, _: {"gravity": m.gravity * (1 + 1e-5)})),
    Defect("gravity-z", "gravity z by -1e-3 m/s²", ("gravity z",), E,
           inputs=parameter("gravity", 2, by=-1e-3)),
    Defect("gravity-sign", "gravity × -1", ("gravity reversed", "gravity's size"), M, "rods",
           inputs=model_change(lambda m, _: {"gravity": -m.gravity})),
    Defect("gravity-axes", "gravity's y and z exchanged", ("gravity's y and z",), P,
           inputs=model_change(lambda m, _: {"gravity": m.gravity[[0, 2, 1]]})),
    Defect("no-gravity", "gravity 0", ("gravity's size", "no gravity"), E,
           inputs=model_change(lambda m, _: {"gravity": 0 * m.gravity})),
    Defect("damping-1e-6", "c_r of every body by 1e-6 N m s", ("damping",), M,
           inputs=model_change(lambda m, _: {"drag_moment": m.drag_moment + 1e-6})),
    Defect("drag-ignored", "c_t 0", ("without drag on forces",), E, loaded=True,
           inputs=model_change(lambda m, _: {"drag_force": 0 * m.drag_force})),
    Defect("loads-ignored", "F and n′ 0", ("without applied loads",), P, loaded=True,
           inputs=model_change(lambda m, _: {"force": 0 * m.force, "moment": 0 * m.moment})),
    Defect("force-in-body-frame", "A F in place of F", ("applied force were taken in the body frame",), M,
           loaded=True, inputs=model_change(lambda m, s: {"force": world(s, m.force)})),
    Defect("moment-in-world-frame", "Aᵀ n′ in place of n′", ("applied moment were taken in the world frame",),
           E, loaded=True, inputs=model_change(lambda m, s: {"moment": body(s, m.moment)})),
    # numbers of the state
    Defect("rotation-transposed", "A → Aᵀ", ("rotation matrix were transposed",), M,
           inputs=state_change(lambda _, s: {"p": quaternion_conjugate(s.p)})),
    Defect("quaternion-order", "(x, y, z, w) read as (w, x, y, z)", ("quaternion order",), P,
           inputs=state_change(lambda _, s: {"p": np.roll(s.p, -1, axis=1)})),
    Defect("world-rate-for-body-rate", "A ω′ in place of ω′", ("world-frame angular velocity",), E,
           inputs=state_change(lambda _, s: {"omega": world(s, s.omega)})),
    Defect("rates-doubled", "ω′ × 2", ("angular rates",), P,
           inputs=state_change(lambda _, s: {"omega": 2 * s.omega})),
    Defect("rates-in-degrees", "ω′ × π/180", ("angular rates",), M,
           inputs=state_change(lambda _, s: {"omega": s.omega * np.pi / 180})),
    Defect("rod-rate-dropped", "u̇ = 0", ("rod rate",), M, "rods",
           inputs=state_change(lambda _, s: {"udot": 0 * s.udot})),
    Defect("tilt-1e-6", "body 2 turned by 1e-6 rad about its x", ("attitude of body 2",), E,
           inputs=tilted(1, 1e-6)),
    Defect("single-inside", "all inputs through single precision", (), M, inputs=single_inside),
    # terms of the equations
    Defect("gyroscopic-dropped", "8 L̇ᵀJL̇p × 0", ("gyroscopic term",), P,
           inputs=model_change(lambda m, s: {"moment": m.moment + gyroscopic(m, s)})),
    Defect("gyroscopic-doubled", "8 L̇ᵀJL̇p × 2", ("gyroscopic term",), M, "rods",
           inputs=model_change(lambda m, s: {"moment": m.moment - gyroscopic(m, s)})),
    Defect("gamma-far-dropped", "γ without the far body's term", ("distal term of γ",), R,
           gamma=far_centripetal),
    Defect("gamma-dropped", "γ = 0 (missing J̇v)", ("γ (J̇v)",), R, gamma=all_gamma),
    Defect("gamma-rod-dropped", "γ of rods without ḋᵀḋ", ("rod term of γ",), R, "rods", gamma=rod_bend),
    # what comes back
    Defect("spatial-acceleration", "r̈ - ω × ṙ in place of r̈", ("spatial acceleration",), P,
           answers=field("acceleration", lambda _, s, a: a - np.cross(world(s, s.omega), s.v))),
    Defect("proper-acceleration", "r̈ - g in place of r̈", ("acceleration minus gravity",), M,
           answers=field("acceleration", lambda m, _, a: a - m.gravity)),
    Defect("acceleration-in-body-frame", "Aᵀ r̈", ("acceleration in the body frame",), E,
           answers=field("acceleration", lambda _, s, a: body(s, a))),
    Defect("angular-acceleration-in-world-frame", "A ω̇′", ("angular acceleration in the world frame",), P,
           answers=field("angular_acceleration", lambda _, s, a: world(s, a))),
    Defect("reaction-sign", "-F", ("joint reaction with the opposite sign",), M, "rods",
           answers=field("joint_reaction", lambda _, __, f: -f)),
    Defect("reaction-on-wrong-body", "F of the next joint", ("joint reaction of another body",), E,
           answers=field("joint_reaction", lambda _, __, f: np.roll(f, -1, axis=0))),
    Defect("reaction-in-body-frame", "Aᵀ F", ("joint reaction in the body frame",), P,
           answers=field("joint_reaction", lambda _, s, f: body(s, f))),
    Defect("bodies-exchanged", "rows of the accelerations in reverse", ("another body",), M,
           answers=field("acceleration", lambda _, __, a: a[::-1])),
    Defect("potential-origin", "zero 0.1 m above the pivot", ("origin of the potential energy",), M,
           answers=field("potential_energy", lambda m, _, e: e + 0.1 * np.sum(m.mass) * 9.7)),
    Defect("potential-sign", "-V", ("potential energy with the opposite sign",), E,
           answers=field("potential_energy", lambda _, __, e: -e)),
    Defect("kinetic-without-spin", "T - ½ ω′·J ω′", ("kinetic energy without rotation",), P,
           answers=field("kinetic_energy", lambda m, s, e: e - float(spin_part(m, s)))),
    Defect("kinetic-twice", "2 T", ("kinetic energy",), M,
           answers=field("kinetic_energy", lambda _, __, e: 2 * e)),
    Defect("momentum-about-centre", "L about the centre of mass", ("about the centre of mass",), E,
           answers=field("angular_momentum", about_centre)),
    Defect("stale-reaction", "F of the state before", ("of the previous state",), P,
           answers=stale("joint_reaction")),
    Defect("stale-everything", "r̈, ω̇′ and F of the state before", ("of the previous state",), M, "rods",
           answers=stale("acceleration", "angular_acceleration", "joint_reaction")),
    Defect("single-precision-out", "r̈ rounded to single precision", ("single precision",), E,
           answers=field("acceleration", lambda _, __, a: single(a))),
)  # fmt: skip

MOTION_DEFECTS = (
    Defect("order-1-named-RK4", "Euler's step under the name RK4", level="motion", run=euler_inside),
    Defect("order-2-named-RK4", "an order-2 step under the name RK4", level="motion", run=richardson_inside),
    Defect("clock-1e-6", "time × (1 + 1e-6)", level="motion", run=slow_clock),
    Defect("one-step-late", "samples shifted by one step", level="motion", run=one_step_late),
    Defect("silent-reset", "the last third starts again", level="motion",
           run=rows_of(lambda n: [*range(n - n // 3), *range(n // 3)])),
    Defect("repeated-last-rows", "the last three rows repeat", level="motion",
           run=rows_of(lambda n: [*range(n - 2), n - 3, n - 3])),
    Defect("early-stop", "the last three samples missing", level="motion", run=early_stop),
    Defect("not-finite", "the last row NaN", level="motion",
           run=sampled(lambda run: {"r": np.where(np.arange(len(run.t))[:, None, None] == len(run.t) - 1,
                                                  np.nan, run.r)})),
    Defect("damping-1e-6-in-time", "drag of 1e-6 N m s on every body", level="motion", run=damped),
    Defect("single-precision-samples", "positions rounded to single precision", level="motion",
           run=sampled(lambda run: {"r": single(run.r)})),
    Defect("norm-1e-9", "quaternions × (1 + 1e-9) from the second row on", level="motion",
           run=sampled(lambda run: {"p": run.p * (1 + 1e-9 * (run.t > 0))[:, None, None]})),
    Defect("stale-velocity", "ṙ of the sample before", level="motion",
           run=sampled(lambda run: {"v": run.v[[0, *range(len(run.t) - 1)]]})),
    Defect("gravity-1e-5-in-time", "gravity × (1 + 1e-5)", level="motion",
           inputs=model_change(lambda m, _: {"gravity": m.gravity * (1 + 1e-5)})),
)  # fmt: skip

DEFECTS = STATE_DEFECTS + MOTION_DEFECTS

# Two causes with one effect on every quantity: the diagnosis must name both, or see neither.
PAIRS = (
    (
        Defect("centre-of-last-body", "centre of mass of body 2 by 1e-5 m in x",
               inputs=centre_moved(1, 1e-5 * X)),
        ("centre of mass of body 2", "proximal x of body 2"),
    ),
    (
        Defect("zeroth-sign", "-p for p: the same attitude", inputs=state_change(lambda _, s: {"p": -s.p})),
        (),
    ),
)  # fmt: skip
# Seen by nothing where an engine gives accelerations alone: masses and inertias scaled together.
BLIND = next(d for d in STATE_DEFECTS if d.name == "mass-and-inertia-together")
