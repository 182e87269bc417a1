"""Defects of chains at one state and along a motion: what the harness must report, and name.

A name has the size; ``expected`` are words of the diagnosis, without which it need only be reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from plumbline.model import equivalent
from plumbline.model.datatypes import Array, Integrator, Model, State, StateQuantities, Trajectory
from plumbline.model.kinematics import (
    complete_state,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
)
from tests.helpers.planting import (
    Answers,
    Corrections,
    Defect,
    Inputs,
    Term,
    added_gamma,
    added_moment,
    answer_change,
    body_answer_change,
    body_change,
    body_spins,
    body_state_change,
    built_with,
    gyroscopic_moment,
    model_change,
    noise_growing,
    normalised,
    number_change,
    recomputed,
    rows_reordered,
    run_as,
    run_with_clock,
    sample_change,
    stale_answers,
    state_change,
    to_body,
    to_world,
    turned_by,
    when,
    without,
    without_gamma,
)
from tests.helpers.planting import plant as plant


def centre_of_mass_moved(k: int, shift: Array) -> Inputs:
    """The centre of mass of body k at ``shift`` from where it is: its points move the other way."""
    return model_change(lambda m, _: {"point": m.point - shift * (m.body == k)[..., None]})


def inertia_about_proximal(model: Model, _: State) -> Array:
    """Inertia of every body about its proximal point (Huygens and Steiner)."""
    s = model.proximal[: model.n]
    square = np.sum(s * s, -1)[:, None, None] * np.eye(3) - s[:, :, None] * s[:, None, :]
    return np.asarray(model.inertia + model.mass[:, None, None] * square)


def inertia_in_world_axes(model: Model, state: State) -> Array:
    """Aᵀ J A of every body."""
    turn = rotation_matrix(state.p)
    inertia = turn.mT @ model.inertia @ turn
    return np.asarray((inertia + inertia.mT) / 2)


def to_single_precision(x: Array) -> Array:
    """Rounded to single precision."""
    return np.asarray(x, np.float32).astype(float)


def inputs_in_single_precision(model: Model, state: State) -> tuple[Model, State]:
    """Everything the engine is given passes through single precision."""
    fields = {k: v for k, v in model.fields.items() if np.asarray(v).dtype == float}
    wrong = model.changed(**{k: to_single_precision(v) for k, v in fields.items()})
    rounded = {k: to_single_precision(getattr(state, k)) for k in ("omega", "u", "udot")}
    p = normalised(to_single_precision(state.p))
    return wrong, complete_state(wrong, replace(state, p=p, **rounded))


def rotational_energy(model: Model, state: State) -> Array:
    """½ ω′·J ω′ summed (J)."""
    return np.asarray(0.5 * np.einsum("ki,kij,kj", state.omega, model.inertia, state.omega))


def about_centre(model: Model, state: State, reported: Array) -> Array:
    """Angular momentum about the common centre of mass instead of the pivot."""
    centre = model.mass @ state.r / np.sum(model.mass)
    return np.asarray(reported - np.cross(centre, model.mass @ state.v))


def distal_gamma(model: Model, state: State) -> Array:
    """−(what the far body's ω × (ω × s) gives to a ball's γ)."""
    centripetal = to_world(state, np.cross(state.omega, np.cross(state.omega, model.distal)))
    return -np.concatenate([np.zeros((1, 3)), centripetal[:-1]]).ravel()


def rod_gamma(model: Model, state: State) -> Array:
    """−(−2 ḋᵀḋ) of the rods' γ."""
    return np.asarray(2 * model.length**2 * np.sum(state.udot**2, -1))


# --- in time ------------------------------------------------------------------------------------


def extrapolated_euler(
    simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float
) -> Trajectory:
    """An order-2 step under the name of RK4: Euler extrapolated once."""
    coarse, fine = (simulate(model, state, times, replace(i, name="Euler"), step) for step in (h, h / 2))
    sign = np.where(np.sum(coarse.p * fine.p, -1, keepdims=True) < 0, -1.0, 1.0)
    return replace(
        fine,
        r=2 * fine.r - coarse.r,
        p=normalised(2 * fine.p - sign * coarse.p),
        v=2 * fine.v - coarse.v,
        pdot=2 * fine.pdot - sign * coarse.pdot,
        steps=coarse.steps,
    )


def one_step_late(
    simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float
) -> Trajectory:
    """Samples are taken one step after their time."""
    run = simulate(model, state, np.concatenate([[0.0], times + h]), i, h)
    kept = [0, *range(2, len(run.t))]
    return replace(run, t=times, **{k: getattr(run, k)[kept] for k in ("r", "p", "v", "pdot")})


def short_run(simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float) -> Trajectory:
    """The run ends before the last samples."""
    return simulate(model, state, times[:-3], i, h)


# --- of one body, or in a rare branch ------------------------------------------------------------


def moment_of_force_at(point: str, force: Term) -> Term:
    """s × Aᵀ F: the moment of a world force that acts at a point of the body."""
    return lambda m, s: np.cross(getattr(m, point)[: m.n], to_body(s, force(m, s)))


def attitudes_before(state: State) -> Array:
    """Attitude of the body before each one; of the first the identity."""
    return np.concatenate([[[1.0, 0, 0, 0]], state.p[:-1]])


def relative_attitudes(_: Model, state: State) -> Array:
    """Attitudes relative to the body before: q₁* q₂."""
    return normalised(quaternion_product(quaternion_conjugate(attitudes_before(state)), state.p))


def reversed_product(model: Model, state: State) -> Array:
    """q₁ and q₁* q₂ multiplied in the other order."""
    return normalised(quaternion_product(relative_attitudes(model, state), attitudes_before(state)))


def relative_rates(_: Model, state: State) -> Array:
    """ω′ relative to the body before, in the body's own frame."""
    absolute = to_world(state, state.omega)
    return state.omega - to_body(state, np.concatenate([np.zeros((1, 3)), absolute[:-1]]))


def drag_from(kind: str, rate: Term) -> Inputs:
    """The drag force −c_t v or moment −c_r ω′ of another velocity."""
    drag = f"drag_{kind}"
    return model_change(
        lambda m, s: {drag: 0 * getattr(m, drag),
                      kind: getattr(m, kind) - getattr(m, drag)[:, None] * rate(m, s)}
    )  # fmt: skip


def proximal_velocity(model: Model, state: State) -> Array:
    """Velocity of each body's proximal point."""
    return state.v + to_world(state, np.cross(state.omega, model.proximal[: model.n]))


def stale_state(*names: str) -> Inputs:
    """Minimal coordinates of the state before; of the first state its own."""
    last: list[State] = []

    def alter(model: Model, state: State) -> tuple[Model, State]:
        before = last[-1] if last and last[-1].p.shape == state.p.shape else state
        last[:] = [state]
        return model, complete_state(model, replace(state, **{name: getattr(before, name) for name in names}))

    return alter


def at_identity(k: int) -> Callable[[Model, State], bool]:
    """Whether a body has the identity attitude."""
    return lambda _, state: bool(abs(state.p[k, 0]) == 1.0)


def rod_gamma_after_balls(model: Model, state: State) -> Array:
    """−(−2 ḋᵀḋ) of the rods that follow a ball joint, in the layout of `Bent`: 3 rows a ball, 1 a rod."""
    rows, before = [], False
    for k, rod in enumerate(model.rods):
        after_ball = bool(rod) and k > 0 and not before
        before = bool(rod)
        bend = 2 * model.length[k] ** 2 * np.sum(state.udot[k] ** 2)
        rows += [bend * after_ball] if rod else [0.0] * 3
    return np.array(rows)


def proximal_gamma(k: int) -> Term:
    """−(what ω × (ω × s) of body k gives to γ of its own ball joint)."""

    def defect(model: Model, state: State) -> Array:
        centripetal = to_world(state, np.cross(state.omega, np.cross(state.omega, model.proximal)))
        return np.where(np.arange(model.n)[:, None] == k, centripetal, 0.0).ravel()

    return defect


M, P, E, R = "mujoco", "pinocchio", "exudyn", "reference"
MUJOCO = "adapters.mujoco_engine:_MujocoChain"
X = np.array([1.0, 0.0, 0.0])

STATE_DEFECTS = (
    # numbers of the model
    Defect("inertia-yy-1e-4", "inertia yy of body 2", M,
           inputs=number_change("inertia", 1, 1, 1, times=1 + 1e-4)),
    Defect("inertia-xx-1e-6", "inertia xx of body 1", P,
           inputs=number_change("inertia", 0, 0, 0, times=1 + 1e-6)),
    Defect("inertia-yy-7-percent", "inertia yy of body 2", E, "rods",
           inputs=number_change("inertia", 1, 1, 1, times=0.93)),
    Defect("inertia-xy-sign", "inertia xy of body 1", M,
           inputs=number_change("inertia", 0, 0, 1, times=-1.0)),
    Defect("inertia-products-dropped", "products of inertia", P,
           inputs=model_change(lambda m, _: {"inertia": m.inertia * np.eye(3)})),
    Defect("inertia-about-proximal", "inertia of all bodies were that about its joint's point", E,
           inputs=model_change(lambda m, s: {"inertia": inertia_about_proximal(m, s)})),
    Defect("inertia-in-world-axes", "inertia of all bodies were taken in world axes", M,
           inputs=model_change(lambda m, s: {"inertia": inertia_in_world_axes(m, s)})),
    Defect("centre-0.1mm", "centre of mass x of body 1 were", M, inputs=centre_of_mass_moved(0, 1e-4 * X)),
    Defect("proximal-1e-5", "near point y of joint 1 were", P,
           inputs=number_change("proximal", 0, 1, by=1e-5)),
    Defect("distal-1e-5", "far point x of joint 2 were", E, inputs=number_change("distal", 0, 0, by=1e-5)),
    Defect("rod-length-1e-5", "length of joint 2 were", M, "rods",
           inputs=number_change("length", 1, times=1 + 1e-5)),
    Defect("mass-1-1e-5", "mass of body 1", E, inputs=number_change("mass", 0, times=1 + 1e-5)),
    Defect("mass-2-1e-5", "mass of body 2", P, "rods", inputs=number_change("mass", 1, times=1 + 1e-5)),
    Defect("mass-and-inertia-together", "mass and inertia of all bodies were",
           inputs=model_change(lambda m, _: {k: getattr(m, k) * (1 + 1e-4) for k in ("mass", "inertia")})),
    Defect("lengths-1e-5", "lengths of the mechanism were", P,
           inputs=model_change(lambda m, _: {k: getattr(m, k) * (1 + 1e-5) for k in ("point", "length")})),
    Defect("gravity-1e-5", "size of gravity were", P,
           inputs=number_change("gravity", ..., times=1 + 1e-05)),
    Defect("gravity-z", "z component of gravity were", E, inputs=number_change("gravity", 2, by=-1e-3)),
    Defect("gravity-sign", "size of gravity had the opposite sign", M, "rods",
           inputs=number_change("gravity", ..., times=-1.0)),
    Defect("gravity-axes", "components of gravity were taken with y and z exchanged", P,
           inputs=model_change(lambda m, _: {"gravity": m.gravity[[0, 2, 1]]})),
    Defect("no-gravity", "size of gravity were missing", E,
           inputs=number_change("gravity", ..., times=0.0)),
    Defect("damping-1e-6", "drag moment of all bodies were", M,
           inputs=model_change(lambda m, _: {"drag_moment": m.drag_moment + 1e-6})),
    Defect("drag-ignored", "drag force of all bodies were missing", E, loaded=True,
           inputs=number_change("drag_force", ..., times=0.0)),
    Defect("loads-ignored", "applied loads of all bodies were missing", P, loaded=True,
           inputs=model_change(lambda m, _: {"force": 0 * m.force, "moment": 0 * m.moment})),
    Defect("force-in-body-frame", "applied force of all bodies were taken in the body frame", M, loaded=True,
           inputs=model_change(lambda m, s: {"force": to_world(s, m.force)})),
    Defect("moment-in-world-frame", "applied moment of all bodies were taken in the world frame", E,
           loaded=True, inputs=model_change(lambda m, s: {"moment": to_body(s, m.moment)})),
    # numbers of the state
    Defect("rotation-transposed", "attitude of all bodies were turned the other way", M,
           inputs=state_change(lambda _, s: {"p": quaternion_conjugate(s.p)})),
    Defect("quaternion-order", "attitude of all bodies were given with the scalar last", P,
           inputs=state_change(lambda _, s: {"p": np.roll(s.p, -1, axis=1)})),
    Defect("world-rate-for-body-rate", "angular velocity of all bodies were in the world frame", E,
           inputs=state_change(lambda _, s: {"omega": to_world(s, s.omega)})),
    Defect("rates-doubled", "angular velocity ω′ of all bodies were doubled", P,
           inputs=state_change(lambda _, s: {"omega": 2 * s.omega})),
    Defect("rates-in-degrees", "angular velocity ω′ of all bodies were", M,
           inputs=state_change(lambda _, s: {"omega": s.omega * np.pi / 180})),
    Defect("rod-rate-dropped", "rod rate", M, "rods", inputs=state_change(lambda _, s: {"udot": 0 * s.udot})),
    Defect("tilt-1e-6", "attitude about x of body 2 were", E,
           inputs=body_state_change(1, p=lambda _, s: turned_by(1e-6, 0, 0)(s.p))),
    Defect("single-inside", "", M, inputs=inputs_in_single_precision),
    # terms of the equations
    Defect("gyroscopic-dropped", "gyroscopic term", P,
           inputs=model_change(lambda m, s: {"moment": m.moment + gyroscopic_moment(m, s)})),
    Defect("gyroscopic-doubled", "gyroscopic term", M, "rods",
           inputs=model_change(lambda m, s: {"moment": m.moment - gyroscopic_moment(m, s)})),
    Defect("gamma-far-dropped", "velocity term of the far body of joint 2 were missing", R,
           patch=added_gamma(distal_gamma)),
    Defect("gamma-dropped", "γ of the rows of all joints were missing", R, patch=without_gamma(0, 1)),
    Defect("gamma-rod-dropped", "velocity term of the joint's own motion of all joints were missing", R,
           "rods", patch=added_gamma(rod_gamma)),
    # what comes back
    Defect("spatial-acceleration", "spatial acceleration", P,
           answers=answer_change("acceleration", lambda _, s, a: a - np.cross(to_world(s, s.omega), s.v))),
    Defect("proper-acceleration", "acceleration minus gravity", M,
           answers=answer_change("acceleration", lambda m, _, a: a - m.gravity)),
    Defect("acceleration-in-body-frame", "acceleration in the body frame", E,
           answers=answer_change("acceleration", lambda _, s, a: to_body(s, a))),
    Defect("angular-acceleration-in-world-frame", "angular acceleration in the world frame", P,
           answers=answer_change("angular_acceleration", lambda _, s, a: to_world(s, a))),
    Defect("reaction-sign", "joint reaction with the opposite sign", M, "rods",
           answers=answer_change("joint_reaction", lambda _, __, f: -f)),
    Defect("reaction-on-wrong-body", "joint reaction of another joint, the next one", E,
           answers=answer_change("joint_reaction", lambda _, __, f: np.roll(f, -1, axis=0))),
    Defect("reaction-in-body-frame", "joint reaction in the body frame", P,
           answers=answer_change("joint_reaction", lambda _, s, f: to_body(s, f))),
    Defect("bodies-exchanged", "another body", M,
           answers=answer_change("acceleration", lambda _, __, a: a[::-1])),
    Defect("potential-origin", "potential energy with another origin, at every state larger by", M,
           answers=answer_change("potential_energy", lambda m, _, e: e + 0.1 * np.sum(m.mass) * 9.7)),
    Defect("potential-sign", "potential energy with the opposite sign", E,
           answers=answer_change("potential_energy", lambda _, __, e: -e)),
    Defect("kinetic-without-spin", "kinetic energy without the rotation of all bodies", P,
           answers=answer_change("kinetic_energy", lambda m, s, e: e - float(rotational_energy(m, s)))),
    Defect("kinetic-twice", "kinetic energy", M,
           answers=answer_change("kinetic_energy", lambda _, __, e: 2 * e)),
    Defect("momentum-about-centre", "about the centre of mass", E,
           answers=answer_change("angular_momentum", about_centre)),
    Defect("stale-reaction", "of the previous state", P, answers=stale_answers("joint_reaction")),
    Defect("stale-everything", "of the previous state", M, "rods",
           answers=stale_answers("acceleration", "angular_acceleration", "joint_reaction")),
    Defect("single-precision-out", "single precision", E,
           answers=answer_change("acceleration", lambda _, __, a: to_single_precision(a))),
)  # fmt: skip

# Of a single body, a single load, a rare branch: committed before any mechanism that names them.
BODY_DEFECTS = (
    # loads
    Defect("force-2-dropped", "applied force of body 2", M, loaded=True,
           inputs=number_change("force", 1, times=0.0)),
    Defect("force-1-0.1-percent", "applied force of body 1", P, "rods", loaded=True,
           inputs=number_change("force", 0, times=1.001)),
    Defect("force-2-sign", "applied force of body 2", E, loaded=True,
           inputs=number_change("force", 1, times=-1.0)),
    Defect("force-x-of-2-dropped", "applied force x of body 2", P, loaded=True,
           inputs=number_change("force", 1, 0, times=0.0)),
    Defect("moment-1-dropped", "applied moment of body 1", E, loaded=True,
           inputs=number_change("moment", 0, times=0.0)),
    Defect("moment-2-doubled", "applied moment of body 2", P, "rod-ball", loaded=True,
           inputs=number_change("moment", 1, times=2.0)),
    Defect("moment-1-sign", "applied moment of body 1", M, "rods", loaded=True,
           inputs=number_change("moment", 0, times=-1.0)),
    Defect("moment-z-of-1-dropped", "applied moment z of body 1", M, loaded=True,
           inputs=number_change("moment", 0, 2, times=0.0)),
    Defect("loads-2-dropped", "applied loads of body 2", M, loaded=True,
           inputs=body_change(1, force=lambda m, _: 0 * m.force, moment=lambda m, _: 0 * m.moment)),
    Defect("loads-3-dropped", "applied loads of body 3", P, "mixed", loaded=True,
           inputs=body_change(2, force=lambda m, _: 0 * m.force, moment=lambda m, _: 0 * m.moment)),
    Defect("load-where-none-is", "applied force y of body 1", E,
           inputs=number_change("force", 0, 1, by=1e-5)),
    Defect("force-1-in-body-frame", "force of body 1 were taken in the body frame", P, loaded=True,
           inputs=body_change(0, force=lambda m, s: to_world(s, m.force))),
    Defect("moment-2-in-world-frame", "moment of body 2 were taken in the world frame", M, loaded=True,
           inputs=body_change(1, moment=lambda m, s: to_body(s, m.moment))),
    Defect("force-turned-back", "applied force of all bodies were rotated with Aᵀ", E, loaded=True,
           inputs=model_change(lambda m, s: {"force": to_body(s, m.force)})),
    Defect("moment-turned-twice", "applied moment of all bodies were rotated with A", P, loaded=True,
           inputs=model_change(lambda m, s: {"moment": to_world(s, m.moment)})),
    Defect("loads-exchanged", "applied force of every body were that of the body counted from the other end",
           M, loaded=True, inputs=model_change(lambda m, _: {"force": m.force[::-1]})),
    Defect("force-1-at-proximal", "applied force of body 1 were applied at its joint's point", P,
           loaded=True, inputs=added_moment(moment_of_force_at("proximal", lambda m, _: m.force), 0)),
    Defect("forces-at-proximal", "applied force of all bodies were applied at its joint's point", M, "rods",
           loaded=True, inputs=added_moment(moment_of_force_at("proximal", lambda m, _: m.force))),
    Defect("force-1-at-distal", "applied force of body 1 were applied at joint 2's point", E, loaded=True,
           inputs=added_moment(moment_of_force_at("distal", lambda m, _: m.force), 0)),
    Defect("weight-2-at-proximal", "weight of body 2 were applied at its joint's point", M,
           inputs=added_moment(moment_of_force_at("proximal", lambda m, _: m.mass[:, None] * m.gravity), 1)),
    Defect("weight-at-distal", "weight of body 1 were applied at joint 2's point", P,
           inputs=added_moment(moment_of_force_at("distal", lambda m, _: m.mass[:, None] * m.gravity))),
    # drag
    Defect("drag-force-2-dropped", "drag force of body 2", M, loaded=True,
           inputs=number_change("drag_force", 1, times=0.0)),
    Defect("drag-force-1-1e-6", "drag force of body 1", P, loaded=True,
           inputs=number_change("drag_force", 0, times=1 + 1e-6)),
    Defect("drag-moment-1-dropped", "drag moment of body 1 were missing", E, loaded=True,
           inputs=number_change("drag_moment", 0, times=0.0)),
    Defect("drag-moment-2-sign", "drag moment of body 2", P, "rods", loaded=True,
           inputs=number_change("drag_moment", 1, times=-1.0)),
    Defect("drag-2-doubled", "drag of body 2", M, loaded=True,
           inputs=body_change(1, drag_force=lambda m, _: 2 * m.drag_force,
                          drag_moment=lambda m, _: 2 * m.drag_moment)),
    Defect("drag-exchanged", "drag force and drag moment of all bodies were exchanged", M, loaded=True,
           inputs=model_change(lambda m, _: {"drag_force": m.drag_moment, "drag_moment": m.drag_force})),
    Defect("drag-2-exchanged", "drag force and drag moment of body 2 were exchanged", P, loaded=True,
           inputs=body_change(1, drag_force=lambda m, _: m.drag_moment,
                                       drag_moment=lambda m, _: m.drag_force)),
    Defect("drag-ct-for-cr", "drag moment of all bodies were that of the drag force's coefficient", E,
           loaded=True, inputs=model_change(lambda m, _: {"drag_moment": m.drag_force})),
    Defect("drag-force-in-body-frame", "drag force of all bodies were taken with the body-frame velocity", M,
           loaded=True, inputs=drag_from("force", lambda _, s: to_body(s, s.v))),
    Defect("drag-moment-in-world-frame",
           "drag moment of all bodies were taken with the world-frame angular velocity", P, loaded=True,
           inputs=drag_from("moment", lambda _, s: to_world(s, s.omega))),
    Defect("drag-of-proximal-velocity",
           "drag force of all bodies were taken with the velocity of its joint's point", E, loaded=True,
           inputs=drag_from("force", proximal_velocity)),
    Defect("drag-at-proximal", "drag force of all bodies were applied at its joint's point", M, loaded=True,
           inputs=added_moment(moment_of_force_at("proximal", lambda m, s: -m.drag_force[:, None] * s.v))),
    Defect("damping-of-body-2", "drag moment of body 2 were", P,
           inputs=number_change("drag_moment", 1, by=1e-6)),
    Defect("joint-damping", "damping of all joints were", M,
           patch=built_with(MUJOCO, "m", "dof_damping", 1e-4)),
    Defect("armature", "armature", M, patch=built_with(MUJOCO, "m", "dof_armature", 1e-4)),
    Defect("armature-of-joint-2", "armature of joint 2", M,
           patch=built_with(MUJOCO, "m", "dof_armature", np.repeat([0.0, 1e-6], 3))),
    Defect("armature-of-three-percent", "armature", P,
           patch=built_with("adapters.pinocchio_engine:PinocchioChain", "pin_model", "armature", 1e-3)),
    # velocity terms
    Defect("gyroscopic-1-dropped", "gyroscopic term of body 1", P, inputs=added_moment(gyroscopic_moment, 0)),
    Defect("gyroscopic-2-dropped", "gyroscopic term of body 2", E, "rods",
           inputs=added_moment(gyroscopic_moment, 1)),
    Defect("gyroscopic-2-sign", "gyroscopic term of body 2", M, "rod-ball",
           inputs=added_moment(lambda m, s: 2 * gyroscopic_moment(m, s), 1)),
    Defect("gyroscopic-1-1e-6", "gyroscopic term of body 1", M,
           inputs=added_moment(lambda m, s: -1e-6 * gyroscopic_moment(m, s), 0)),
    Defect("gamma-2-proximal-dropped", "velocity term of the near body of joint 2 were missing", R,
           patch=added_gamma(proximal_gamma(1))),
    # attitude, rates, inertia and points of one body
    Defect("attitude-2-conjugated", "attitude of body 2 were turned the other way", M,
           inputs=body_state_change(1, p=lambda _, s: quaternion_conjugate(s.p))),
    Defect("attitude-1-conjugated", "attitude of body 1 were turned the other way", E, "rods",
           inputs=body_state_change(0, p=lambda _, s: quaternion_conjugate(s.p))),
    Defect("attitude-3-conjugated", "attitude of body 3 were turned the other way", P, "mixed",
           inputs=body_state_change(2, p=lambda _, s: quaternion_conjugate(s.p))),
    Defect("product-order-2", "attitude of body 2 were multiplied in the reverse order", P,
           inputs=body_state_change(1, p=reversed_product)),
    Defect("relative-attitude-2", "attitude of body 2 were that relative to its parent", E,
           inputs=body_state_change(1, p=relative_attitudes)),
    Defect("relative-rate-2", "angular velocity of body 2 were that relative to its parent", M,
           inputs=body_state_change(1, omega=relative_rates)),
    Defect("quaternion-order-1", "attitude of body 1 were given with the scalar last", M,
           inputs=body_state_change(0, p=lambda _, s: np.roll(s.p, -1, axis=1))),
    Defect("world-rate-2", "angular velocity of body 2 were in the world frame", P,
           inputs=body_state_change(1, omega=lambda _, s: to_world(s, s.omega))),
    Defect("rate-2-1e-6", "angular velocity ω′ of body 2 were", E,
           inputs=body_state_change(1, omega=lambda _, s: (1 + 1e-6) * s.omega)),
    Defect("rod-rate-2-dropped", "rod rate u̇ of joint 2 were missing", M, "rods",
           inputs=body_state_change(1, udot=lambda _, s: 0 * s.udot)),
    Defect("inertia-2-in-world-axes", "inertia of body 2 were taken in world axes", P,
           inputs=body_change(1, inertia=inertia_in_world_axes)),
    Defect("inertia-1-about-proximal", "inertia of body 1 were that about its joint's point", M,
           inputs=body_change(0, inertia=inertia_about_proximal)),
    Defect("products-2-dropped", "products of inertia of body 2", E,
           inputs=body_change(1, inertia=lambda m, _: m.inertia * np.eye(3))),
    Defect("products-1-sign", "products of inertia of body 1", P,
           inputs=body_change(0, inertia=lambda m, _: m.inertia * (2 * np.eye(3) - 1))),
    Defect("points-1-exchanged", "attachment points of body 1 were exchanged", M,
           inputs=body_change(0, proximal=lambda m, _: m.distal, distal=lambda m, _: m.proximal)),
    Defect("points-1-sign", "attachment points of body 1 had the opposite sign", P,
           inputs=body_change(0, proximal=lambda m, _: -m.proximal, distal=lambda m, _: -m.distal)),
    Defect("mass-and-inertia-2", "mass and inertia of body 2", M,
           inputs=body_change(1, mass=lambda m, _: (1 + 1e-5) * m.mass,
                             inertia=lambda m, _: (1 + 1e-5) * m.inertia)),
    # answers of one body
    Defect("acceleration-1-stale", "of body 1 of the previous state", M,
           answers=stale_answers("acceleration", body=0)),
    Defect("reaction-2-stale", "joint reaction of joint 2 of the previous state (a stale field)", P, "rods",
           answers=stale_answers("joint_reaction", body=1)),
    Defect("angular-1-for-2", "angular acceleration of another body, the one on which it hangs", E,
           answers=answer_change("angular_acceleration", lambda _, __, a: a[[0, 0, *range(2, len(a))]])),
    Defect("acceleration-4-for-3", "acceleration of body 3 of another body, the next one", P, "mixed",
           answers=answer_change("acceleration", lambda _, __, a: a[[0, 1, 3, *range(3, len(a))]])),
    Defect("reaction-2-sign", "joint reaction of joint 2 with the opposite sign", M,
           answers=body_answer_change(1, "joint_reaction", lambda _, __, f: -f)),
    Defect("angular-2-in-world", "angular acceleration of body 2 in the world frame", P,
           answers=body_answer_change(1, "angular_acceleration", lambda _, s, a: to_world(s, a))),
    Defect("reaction-1-in-body", "joint reaction of joint 1 in the body frame", E,
           answers=body_answer_change(0, "joint_reaction", lambda _, s, f: to_body(s, f))),
    Defect("reaction-without-loads", "joint reaction without the applied forces", M, loaded=True,
           answers=answer_change("joint_reaction",
                         lambda m, _, f: f + np.cumsum(m.force[::-1], axis=0)[::-1])),
    Defect("reaction-without-force-2", "joint reaction without the applied force of body 2", P, loaded=True,
           answers=answer_change("joint_reaction", lambda m, _, f: f + m.force[1])),
    Defect("reaction-without-drag", "joint reaction without the drag forces", E, loaded=True,
           answers=answer_change("joint_reaction", lambda m, s, f: f - np.cumsum(
               (m.drag_force[:, None] * s.v)[::-1], axis=0)[::-1])),
    Defect("kinetic-without-body-2", "kinetic energy without body 2", M,
           answers=answer_change("kinetic_energy", lambda m, s, e: e - float(0.5 * m.mass[1] * s.v[1] @ s.v[1]
                         + 0.5 * s.omega[1] @ m.inertia[1] @ s.omega[1]))),
    Defect("potential-without-body-1", "potential energy without the weight of body 1", P,
           answers=answer_change("potential_energy",
                                 lambda m, s, e: e + float(m.mass[0] * m.gravity @ s.r[0]))),
    Defect("momentum-spin-in-body-axes", "spin in body axes", E,
           answers=answer_change("angular_momentum", lambda m, s, x: x + np.sum(
               body_spins(m, s) - to_world(s, body_spins(m, s)), axis=0))),
    # rare branches
    Defect("n3-gyroscopic", "gyroscopic term of body 3", M, "mixed",
           inputs=when(lambda m, _: m.n >= 3, added_moment(gyroscopic_moment, 2))),
    Defect("rod-after-ball-length", "length of joint 4 were", P, "mixed",
           inputs=number_change("length", 3, times=1 + 1e-6)),
    Defect("rod-after-ball-gamma", "velocity term of the joint's own motion of joint 4 were missing", R,
           "mixed", patch=added_gamma(rod_gamma_after_balls)),
    Defect("loaded-mass", "mass of body 1", E, loaded=True,
           inputs=when(lambda m, _: m.has_loads, number_change("mass", 0, times=1 + 1e-5))),
    Defect("loaded-gravity", "size of gravity were missing", M, loaded=True,
           inputs=when(lambda m, _: m.has_loads, number_change("gravity", ..., times=0.0))),
    Defect("identity-gyroscopic", "", M, inputs=when(at_identity(0), added_moment(gyroscopic_moment, 0))),
    Defect("identity-inertia", "", P,
           inputs=when(at_identity(1), model_change(lambda m, _: {"inertia": m.inertia * np.eye(3)}))),
    Defect("identity-rate-lost", "", E,
           inputs=when(at_identity(0), body_state_change(0, omega=lambda _, s: 0 * s.omega))),
    Defect("fast-gyroscopic", "", P,
           inputs=when(lambda _, s: np.max(np.abs(s.omega)) > 12, added_moment(gyroscopic_moment))),
    Defect("rod-upward", "", M, "rods",
           inputs=state_change(lambda _, s: {"udot": np.where(s.u[:, 2:] > 0, -1.0, 1.0) * s.udot})),
    Defect("stale-rates", "", P, inputs=stale_state("omega")),
    Defect("stale-attitudes", "", M, inputs=stale_state("p")),
    # loss of digits
    Defect("digits-lost-along-chain", "lose digits", M, "balls-10",
           answers=answer_change("acceleration", noise_growing(10.0, 1e-15))),
    Defect("digits-of-reactions", "lose digits", P, "balls-10",
           answers=answer_change("joint_reaction", noise_growing(8.0, 1e-14))),
)  # fmt: skip
STATE_DEFECTS = (*STATE_DEFECTS, *BODY_DEFECTS)

MOTION_DEFECTS = (
    Defect("order-1-named-RK4", run=run_as("Euler")),
    Defect("order-2-named-RK4", run=extrapolated_euler),
    Defect("clock-1e-6", run=run_with_clock(1 + 1e-6)),
    Defect("one-step-late", run=one_step_late),
    Defect("silent-reset", run=rows_reordered(lambda n: [*range(n - n // 3), *range(n // 3)])),
    Defect("repeated-last-rows", run=rows_reordered(lambda n: [*range(n - 2), n - 3, n - 3])),
    Defect("early-stop", run=short_run),
    Defect("not-finite", run=sample_change(lambda run: {
               "r": np.where(np.arange(len(run.t))[:, None, None] == len(run.t) - 1, np.nan, run.r)})),
    Defect("damping-1e-6-in-time", inputs=model_change(lambda m, _: {"drag_moment": m.drag_moment + 1e-6})),
    Defect("single-precision-samples", run=sample_change(lambda run: {"r": to_single_precision(run.r)})),
    Defect("norm-1e-9",
           run=sample_change(lambda run: {"p": run.p * (1 + 1e-9 * (run.t > 0))[:, None, None]})),
    Defect("stale-velocity", run=sample_change(lambda run: {"v": run.v[[0, *range(len(run.t) - 1)]]})),
    Defect("gravity-1e-5-in-time", inputs=number_change("gravity", ..., times=1 + 1e-05)),
    Defect("force-2-dropped-in-time", loaded=True, inputs=number_change("force", 1, times=0.0)),
    Defect("drag-exchanged-in-time", loaded=True,
           inputs=model_change(lambda m, _: {"drag_force": m.drag_moment, "drag_moment": m.drag_force})),
    Defect("moment-1-at-the-start-only", loaded=True, engine=P, integrator="rkmk4",
           inputs=body_change(0, moment=lambda m, s: to_body(s, m.moment))),
    Defect("armature-in-time", patch=built_with(MUJOCO, "m", "dof_armature", 1e-4)),
    Defect("attitude-2-conjugated-in-time", run=sample_change(lambda run: {"p": np.stack(
               [run.p[:, 0], quaternion_conjugate(run.p[:, 1])], axis=1)})),
    Defect("row-of-another-body", run=sample_change(lambda run: {"v": run.v[:, [0, 0]]})),
    Defect("noise-1e-8-in-samples", run=sample_change(lambda run: {
               "r": run.r + 1e-8 * np.random.default_rng(5).normal(size=run.r.shape)})),
)  # fmt: skip

DEFECTS = STATE_DEFECTS + MOTION_DEFECTS

# Two causes with one effect on every quantity: the diagnosis must name both.
INDISTINGUISHABLE = Defect("centre-of-last-body", "centre of mass x of body 2",
                           inputs=centre_of_mass_moved(1, 1e-5 * X),
                           equal="near point x of joint 2")  # fmt: skip

# --- equivalent implementations, none of which may be accused -------------------------------------


def negated_quaternions(*bodies: int) -> Inputs:
    """−p for some bodies: the same attitudes."""
    return lambda m, s: (m, replace(s, p=np.where(np.isin(np.arange(m.n), bodies)[:, None], -s.p, s.p)))


def in_axes(
    q: Array,
    rotate: Callable[[Model, State, Array], tuple[Model, State]],
    vectors: Sequence[str],
) -> Defect:
    """Everything described in axes rotated by a unit quaternion, the answers rotated back."""

    def answers(_: Model, __: list[State], found: list[StateQuantities]) -> list[StateQuantities]:
        given = [{name: x for name, x in vars(a).items() if x is not None} for a in found]
        return [
            replace(a, **equivalent.unrotate(quantities, vectors, q))  # type: ignore[arg-type]
            for a, quantities in zip(found, given, strict=True)
        ]

    return Defect("", inputs=lambda model, state: rotate(model, state, q), answers=answers)


def other_units(mass: float, length: float) -> Defect:
    """The engine computes in other units of mass and length (of time the same)."""
    m, x = mass, length

    def inputs(model: Model, state: State) -> tuple[Model, State]:
        factors = {
            "mass": m, "inertia": m * x * x, "proximal": x, "distal": x, "length": x, "gravity": x,
            "force": m * x, "moment": m * x * x, "drag_force": m, "drag_moment": m * x * x,
        }  # fmt: skip
        other = model.changed(**{name: getattr(model, name) * f for name, f in factors.items()})
        return other, complete_state(other, state)

    def back(model: Model, states: list[State], reported: list[StateQuantities]) -> list[StateQuantities]:
        factors = {
            "acceleration": x, "joint_reaction": m * x, "kinetic_energy": m * x * x,
            "potential_energy": m * x * x, "angular_momentum": m * x * x, "mass_matrix": m * x * x,
        }  # fmt: skip
        return [
            replace(a, **{k: getattr(a, k) / f for k, f in factors.items() if getattr(a, k) is not None})
            for a in reported
        ]

    return Defect("", inputs=inputs, answers=back)


def both_changes(first: Answers | None, second: Answers) -> Answers:
    """Two changes of the answers in a row."""
    return lambda m, states, reported: second(m, states, first(m, states, reported) if first else reported)


def recomputed_reaction(order: int) -> Corrections:
    """Reactions from the accelerations, summed from the free end (1) or as total less the rest (-1)."""

    def change(m: Model, s: State, a: StateQuantities) -> dict[str, Any]:
        f = m.mass[:, None] * (a.acceleration - m.gravity) - m.force + m.drag_force[:, None] * s.v
        if order > 0:
            return {"joint_reaction": np.cumsum(f[::-1], axis=0)[::-1]}
        return {"joint_reaction": np.sum(f, axis=0) - np.cumsum(f, axis=0) + f}

    return change


def recomputed_sums(order: int) -> Corrections:
    """Energies and momentum summed anew, bodies in the given order."""

    def change(m: Model, s: State, _: StateQuantities) -> dict[str, Any]:
        at = range(m.n)[::order]
        spin, turned = body_spins(m, s), to_world(s, body_spins(m, s))
        kinetic = sum(m.mass[k] * (s.v[k] @ s.v[k]) + s.omega[k] @ spin[k] for k in at)
        return {
            "kinetic_energy": float(0.5 * kinetic),
            "potential_energy": float(-sum(m.mass[k] * (m.gravity @ s.r[k]) for k in at)),
            "angular_momentum": sum(np.cross(s.r[k], m.mass[k] * s.v[k]) + turned[k] for k in at),
        }

    return change


BODY_AXES = (equivalent.rotate_body_frames, equivalent.BODY_VECTORS)
WORLD_AXES = (equivalent.rotate_world, equivalent.WORLD_VECTORS)


def control(name: str, engine: str, like: Defect, joints: str = "balls", **kind: Any) -> Defect:
    """A control with the changes of another defect; its mass matrix is not judged."""
    answers = both_changes(like.answers, without("mass_matrix"))
    return Defect(name, "", engine, joints, inputs=like.inputs, answers=answers, **kind)


def through_rotation_matrix(_: Model, state: State) -> Array:
    """Attitudes by way of the rotation matrix."""
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(rotation_matrix(state.p)).as_quat()
    return normalised(np.roll(q, 1, axis=-1))


ANY, HALF = np.array([1.0, -3.0, 2.0, 5.0]) / np.sqrt(39.0), np.array([0.5, 0.5, 0.5, 0.5])
CONTROLS = (
    Defect("zeroth-sign", inputs=state_change(lambda _, s: {"p": -s.p})),
    Defect("minus-p-1", engine=M, inputs=negated_quaternions(0)),
    Defect("minus-p-all", engine=P, mechanism="rods", inputs=negated_quaternions(0, 1)),
    Defect("minus-p-2", engine=E, loaded=True, inputs=negated_quaternions(1)),
    control("frames-turned", M, in_axes(ANY, *BODY_AXES), loaded=True),
    control("frames-permuted", P, in_axes(HALF, *BODY_AXES), "rods", loaded=True),
    control("frames-turned-exudyn", E, in_axes(ANY, *BODY_AXES), "rod-ball"),
    control("world-turned", M, in_axes(ANY, *WORLD_AXES), "rods", loaded=True),
    control("world-permuted", P, in_axes(HALF, *WORLD_AXES), "balls", loaded=True),
    control("world-turned-exudyn", E, in_axes(ANY, *WORLD_AXES), "mixed"),
    control("grams", M, other_units(1e3, 1.0), loaded=True),
    control("millimetres", P, other_units(1.0, 1e3), "rods", loaded=True),
    control("pounds-and-feet", E, other_units(2.2, 3.3), loaded=True),
    control("tonnes-and-kilometres", R, other_units(1e-3, 1e-3), "rod-ball"),
    Defect("reactions-from-the-end", engine=M, loaded=True, answers=recomputed(recomputed_reaction(1))),
    Defect("reactions-as-rest", engine=E, mechanism="rods", loaded=True,
           answers=recomputed(recomputed_reaction(-1))),
    Defect("sums-forward", engine=P, mechanism="mixed", answers=recomputed(recomputed_sums(1))),
    Defect("sums-backward", engine=M, mechanism="mixed", loaded=True,
           answers=recomputed(recomputed_sums(-1))),
    Defect("by-rotation-matrix", engine=P, loaded=True,
           inputs=body_state_change(1, p=through_rotation_matrix)),
    Defect("rates-there-and-back", engine=E, loaded=True,
           inputs=state_change(lambda _, s: {"omega": to_body(s, to_world(s, s.omega))})),
    Defect("accelerations-there-and-back", engine=M, mechanism="rods",
           answers=answer_change("acceleration", lambda _, s, a: to_world(s, to_body(s, a)))),
    Defect("drag-as-load", engine=M, loaded=True, inputs=model_change(
        lambda m, s: {"force": m.force - m.drag_force[:, None] * s.v, "drag_force": 0 * m.drag_force,
                      "moment": m.moment - m.drag_moment[:, None] * s.omega,
                      "drag_moment": 0 * m.drag_moment})),
    Defect("weight-as-load", engine=P, loaded=True,
           inputs=model_change(lambda m, _: {"gravity": 0 * m.gravity,
                                             "force": m.force + m.mass[:, None] * m.gravity}),
           answers=recomputed(lambda m, s, a: recomputed_sums(1)(m, s, a))),
    Defect("one-ulp", engine=M, loaded=True,
           answers=answer_change("acceleration", noise_growing(1.0, 1e-16))),
    Defect("one-ulp-of-reactions", engine=E, mechanism="rods",
           answers=answer_change("joint_reaction", noise_growing(1.0, 2e-16))),
    Defect("spin-axis-moved", engine=M, mechanism="rods",
           inputs=state_change(lambda _, s: {"u": s.u / np.linalg.norm(s.u, axis=1, keepdims=True)})),
)  # fmt: skip
