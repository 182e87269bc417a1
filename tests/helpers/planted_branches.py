"""Defects in rarely taken branches: which inputs does a run need so that each of them is reported?

Each alters what a real engine is given, gives back or how it steps, where a condition on model and state
holds.  Conditions are those of real code: a fast path, a special case of zeros, of equal values, of one body.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from tests.helpers.planted_defects import E, M, P, at_identity
from tests.helpers.planted_steps import (
    CLASSICAL,
    WEIGHTS,
    Coordinates,
    Step,
    exchanged_halves,
    first_order_quaternion,
    runge_kutta,
    stale_velocity,
    step_defect,
)
from tests.helpers.planting import (
    Defect,
    Inputs,
    added_moment,
    body_change,
    body_state_change,
    gyroscopic_moment,
    model_change,
    number_change,
    state_change,
    to_body,
    to_world,
    when,
)

Condition = Callable[[Model, State], bool]


def fastest_rate(state: State) -> float:
    """The fastest angular velocity (rad/s)."""
    return float(np.max(np.linalg.norm(state.omega, axis=1)))


def at_least_bodies(count: int) -> Condition:
    """At least so many bodies."""
    return lambda m, _: m.n >= count


def on_last_body(change: Callable[[int], Inputs]) -> Inputs:
    """A change of the last body."""
    return lambda m, s: change(m.n - 1)(m, s)


def on_body(change: Callable[[int], Inputs], k: int) -> Inputs:
    """A change of body k (from 0), where there is one."""
    return when(at_least_bodies(k + 1), change(k))


def scaled(name: str, factor: float) -> Callable[[int], Inputs]:
    """A field of one body times a factor."""
    return lambda k: number_change(name, k, times=factor)


def mass_ratio(model: Model) -> float:
    """The largest ratio of neighbours' masses."""
    ratios = model.mass[1:] / model.mass[:-1]
    return float(np.max(np.maximum(ratios, 1 / ratios), initial=1.0))


def is_axisymmetric(model: Model) -> Array:
    """Which bodies have diagonal inertias with two equal entries."""
    d = np.diagonal(model.inertia, axis1=1, axis2=2)
    is_diagonal = np.all(model.inertia == model.inertia * np.eye(3), axis=(1, 2))
    return is_diagonal & ((d[:, 0] == d[:, 1]) | (d[:, 1] == d[:, 2]))


def rod_rates_scaled(which: Callable[[State], Array], factor: float) -> Inputs:
    """u̇ of the rods of a direction times a factor."""
    return state_change(lambda _, s: {"udot": np.where(which(s)[:, None], factor, 1.0) * s.udot})


SMALL = 1 + 1e-6
BRANCH_DEFECTS = (
    # the size of a rate
    Defect("above-30", engine=M,
           inputs=when(lambda _, s: fastest_rate(s) > 30, added_moment(gyroscopic_moment))),
    Defect("below-0.3", engine=P, inputs=when(lambda _, s: fastest_rate(s) < 0.3,
                       state_change(lambda _, s: {"omega": s.omega * SMALL}))),
    Defect("one-body-at-rest", engine=M,
           inputs=when(lambda _, s: bool(np.any(np.all(s.omega == 0, axis=1))),
                       model_change(lambda m, _: {"gravity": m.gravity * SMALL}))),
    Defect("component-at-rest", engine=E, inputs=state_change(lambda _, s: {
               "omega": np.where(np.any(s.omega == 0, axis=1, keepdims=True), -s.omega, s.omega)})),
    # one body
    Defect("third-inertia", engine=M, inputs=on_body(scaled("inertia", SMALL), 2)),
    Defect("fourth-moment", engine=P, inputs=on_body(scaled("moment", 0.0), 3)),
    Defect("fifth-distal", engine=E, inputs=on_body(scaled("distal", SMALL), 4)),
    Defect("last-of-three-force", engine=M,
           inputs=when(at_least_bodies(3), on_last_body(scaled("force", 0.0)))),
    Defect("last-force-in-body-frame", engine=P,
           inputs=on_last_body(lambda k: body_change(k, force=lambda m, s: to_world(s, m.force)))),
    Defect("second-drag", engine=M, inputs=on_body(scaled("drag_moment", 2.0), 1)),
    Defect("third-drag-force", engine=E, inputs=on_body(scaled("drag_force", 0.0), 2)),
    Defect("third-drags-exchanged", engine=M,
           inputs=on_body(lambda k: body_change(k, drag_force=lambda m, _: m.drag_moment,
                                          drag_moment=lambda m, _: m.drag_force), 2)),
    Defect("load-and-drag-together", engine=P, inputs=model_change(
        lambda m, _: {"force": np.where(m.drag_force[:, None] > 0, m.force * SMALL, m.force)})),
    Defect("moment-without-force", engine=E, inputs=model_change(
        lambda m, _: {"moment": np.where(np.any(m.force, axis=1, keepdims=True), m.moment, 0.0)})),
    Defect("force-without-moment", engine=M, inputs=model_change(
        lambda m, _: {"force": np.where(np.any(m.moment, axis=1, keepdims=True), m.force, 0.0)})),
    Defect("drag-without-force", engine=P,
           inputs=model_change(lambda m, _: {"drag_moment": m.drag_moment * np.any(m.moment != 0, axis=1)})),
    # attitudes
    Defect("negative-scalar", engine=M,
           inputs=state_change(lambda _, s: {"omega": np.where(s.p[:, :1] < 0, SMALL, 1.0) * s.omega})),
    Defect("zero-scalar", engine=P,
           inputs=state_change(lambda _, s: {"omega": np.where(s.p[:, :1] == 0, -1.0, 1.0) * s.omega})),
    Defect("identity-of-third", engine=M, inputs=when(lambda m, s: m.n > 2 and at_identity(2)(m, s),
                       body_state_change(2, omega=lambda _, s: 0 * s.omega))),
    Defect("identity-moment", engine=E, inputs=when(lambda m, s: m.n > 1 and at_identity(1)(m, s),
                       body_change(0, moment=lambda m, s: to_body(s, m.moment)))),
    Defect("same-attitude", engine=P,
           inputs=when(lambda m, s: m.n > 1 and bool(np.any(np.all(s.p[1:] == s.p[:-1], axis=1))),
                       model_change(lambda m, _: {"inertia": m.inertia * SMALL}))),
    # numbers of the model
    Defect("equal-masses", engine=M, inputs=when(lambda m, _: m.n > 1 and m.mass[0] == m.mass[1],
                       number_change("mass", 1, times=SMALL))),
    Defect("mass-ratio-300", engine=P,
           inputs=when(lambda m, _: mass_ratio(m) > 300, number_change("mass", 0, times=1 + 1e-4))),
    Defect("light-body", engine=E, inputs=model_change(
        lambda m, _: {"inertia": m.inertia * np.where(m.mass < 0.02, SMALL, 1.0)[:, None, None]})),
    Defect("heavy-body", engine=M,
           inputs=model_change(lambda m, _: {"mass": m.mass * np.where(m.mass > 100, SMALL, 1.0)})),
    Defect("symmetric-inertia", engine=P, inputs=model_change(
        lambda m, _: {"inertia": m.inertia * np.where(is_axisymmetric(m), SMALL, 1.0)[:, None, None]})),
    Defect("full-inertia-last", engine=M, inputs=on_last_body(lambda k: body_change(
               k, inertia=lambda m, _: m.inertia * (1 + 1e-5 * (1 - np.eye(3)))))),
    Defect("sideways-gravity", engine=E, inputs=when(lambda m, _: bool(np.any(m.gravity[:2])),
                       model_change(lambda m, _: {"gravity": m.gravity * SMALL}))),
    Defect("zero-offset", engine=P,
           inputs=model_change(lambda m, _: {"proximal": np.where(m.proximal == 0, 1e-7, m.proximal)})),
    # rods
    Defect("rod-along-axis", engine=M,
           inputs=rod_rates_scaled(lambda s: np.max(np.abs(s.u), axis=1) == 1, -1.0)),
    Defect("rod-straight-down", engine=P, inputs=rod_rates_scaled(lambda s: s.u[:, 2] == -1, 0.0)),
    Defect("long-rod", engine=E,
           inputs=model_change(lambda m, _: {"length": m.length * np.where(m.length > 1.5, SMALL, 1.0)})),
    Defect("rod-after-ball-after-rod", engine=M,
           inputs=when(lambda m, _: m.n > 2 and bool(m.rods[0] and not m.rods[1] and m.rods[2]),
                       lambda m, s: number_change("length", 2, times=SMALL)(m, s))),
    Defect("rod-last-drag", engine=P,
           inputs=when(lambda m, _: m.n > 1 and bool(m.rods[-1]), on_last_body(scaled("drag_force", 2.0)))),
)  # fmt: skip


# -- steps -----------------------------------------------------------------------------------------


def euler(system: object, q: Array, v: Array, h: float) -> Coordinates:
    """The declared semi-implicit step."""
    v = v + h * system.acceleration(q, v)  # type: ignore[attr-defined]
    return system.integrate(q, h * v), v  # type: ignore[attr-defined]


def rk4(system: object, q: Array, v: Array, h: float) -> Coordinates:
    """The declared classical step."""
    return runge_kutta(system, q, v, h, CLASSICAL, WEIGHTS)


def wrong_when(condition: Callable[[object, Array, Array, float], bool], wrong: Step, right: Step) -> Step:
    """A wrong step in a branch."""

    def step(system: object, q: Array, v: Array, h: float) -> Coordinates:
        return (wrong if condition(system, q, v, h) else right)(system, q, v, h)

    return step


def is_power_of_two(h: float) -> bool:
    """Whether multiplying by h is exact."""
    return float(np.frexp(h)[0]) == 0.5


def joint_scalar_parts(system: object, q: Array) -> Array:
    """Scalar parts of the joints' quaternions."""
    return np.asarray(system.quaternions(q)[:, 0])  # type: ignore[attr-defined]


def step_scaled(factor: float, right: Step) -> Step:
    """The right step of another size."""
    return lambda system, q, v, h: right(system, q, v, h * factor)


BRANCH_STEPS = (
    step_defect("not-power-of-two", M, "Euler",
                wrong_when(lambda _, q, v, h: not is_power_of_two(h), step_scaled(1 + 1e-7, euler), euler)),
    step_defect("not-power-of-two-rk4", P, "rkmk4",
                wrong_when(lambda _, q, v, h: not is_power_of_two(h), step_scaled(1 + 1e-7, rk4), rk4)),
    step_defect("long-steps", M, "Euler", wrong_when(lambda _, q, v, h: h > 0.02, stale_velocity, euler)),
    step_defect("fast-joint", P, "semi-implicit-euler",
                wrong_when(lambda _, q, v, h: np.max(np.abs(v)) > 15, stale_velocity, euler)),
    step_defect("slow-joint", M, "Euler",
                wrong_when(lambda _, q, v, h: np.max(np.abs(v)) < 0.5, exchanged_halves, euler)),
    step_defect("large-turn", M, "Euler",
                wrong_when(lambda _, q, v, h: h * np.max(np.abs(v)) > 0.1, first_order_quaternion, euler)),
    step_defect("negative-scalars", P, "semi-implicit-euler",
                wrong_when(lambda s, q, v, h: bool(np.all(joint_scalar_parts(s, q) < 0)),
                          stale_velocity, euler)),
    step_defect("identity-joint", M, "Euler",
                wrong_when(lambda s, q, v, h: bool(np.any(np.abs(joint_scalar_parts(s, q)) == 1)),
                          exchanged_halves, euler)),
    step_defect("three-joints", M, "Euler",
                wrong_when(lambda _, q, v, h: len(v) >= 9, stale_velocity, euler)),
    step_defect("rk4-one-body", M, "RK4",
                wrong_when(lambda _, q, v, h: len(v) == 3, lambda s, q, v, h: runge_kutta(
                   s, q, v, h, CLASSICAL, WEIGHTS, terms=0), rk4)),
)  # fmt: skip
