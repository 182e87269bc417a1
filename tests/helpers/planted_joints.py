"""Defects of joints and their elements, in trees and loops: to be reported, and most to be named.

Axes, frames and points of joints, springs, dampers, rotors and efforts, and closings of loops.  An engine in
joint coordinates has a wrong mechanism at the right coordinates, one in maximal coordinates the right bodies
on wrong joints; either evaluates a loop that is not closed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import (
    complete_state,
    elastic_energy,
    kinetic_energy_of_rotors,
    quaternion_conjugate,
    rotation_matrix,
)
from plumbline.model.loops import CutMechanism, cut_open, displaced, with_rates
from tests.helpers.planting import (
    EVERY_JOINT,
    Defect,
    Inputs,
    Patch,
    answer_change,
    model_change,
    number_change,
    recomputed,
    replaced_by,
    state_change,
    turned_by,
    with_row,
    without,
    without_gamma,
)

FAR, NEAR = 0, 1
BOTH = slice(None)
M, P, A, E, R = "mujoco", "pinocchio", "pinocchio-aba", "exudyn", "reference"


def exchanged(*axes: int) -> Callable[[Array], Array]:
    """Two axes exchanged, the third reversed."""
    along = np.zeros(3)
    along[list(axes)] = np.pi / np.sqrt(2)
    return turned_by(*along)


def plus(*amount: float) -> Callable[[Any], Any]:
    """Something added to a number or a vector."""
    return lambda value: value + (np.array(amount) if len(amount) > 1 else amount[0])


def _in_joint_axes(k: int) -> Inputs:
    def change(model: Model, _: State) -> dict[str, Array]:
        point = model.point.copy()
        point[k, 0] = rotation_matrix(model.turn[k, 0]) @ point[k, 0]
        return {"point": point}

    return model_change(change)


def _offset(k: int, size: float) -> Inputs:
    """The coordinate of a slide counts from another point."""
    return state_change(lambda _, s: {"x": s.x + size * (np.arange(len(s.x)) == k)[:, None] * [1, 0]})


JOINT_DEFECTS = [
    Defect(name, expected, engine, scenario, inputs=change)
    for name, engine, scenario, expected, change in (
        ("helical: the other hand", P, "sprung-helical", "the pitch of joint 2 had the opposite sign",
         number_change("length", 1, times=-1.0)),
        ("helical: pitch", P, "sprung-helical", "the pitch of joint 2 were 0.050000005 m/rad",
         number_change("length", 1, times=1 + 1e-7)),
        ("universal: axes exchanged", M, "sprung-universal", "x and y of joint 1 were exchanged",
         number_change("turn", 0, BOTH, to=exchanged(0, 1))),
        ("universal in a tree: axes exchanged", P, "loaded-tree", "x and y of joint 3 were exchanged",
         number_change("turn", 2, BOTH, to=exchanged(0, 1))),
        ("universal: second axis reversed", M, "tree-of-seven-sprung",
         "axis y of joint 3 had the opposite sign",
         number_change("turn", 2, BOTH, to=turned_by(np.pi, 0, 0))),
        ("universal: far frame turned the other way", P, "sprung-without-rotors",
         "axes of joint 4 in the far body were turned the other way",
         number_change("turn", 3, FAR, to=quaternion_conjugate)),
        ("universal: far frame turned by 0.3 rad", M, "universal-pendulum",
         "turn of the axes of joint 1 in the far body were",
         number_change("turn", 0, FAR, to=turned_by(0.2, -0.1, 0.2))),
        ("universal: near frame turned by 1e-5 rad", E, "tree-of-seven",
         "turn of the axes of joint 3 in the near body were",
         number_change("turn", 2, NEAR, to=turned_by(6e-6, 3e-6, -7e-6))),
        ("universal: near frame with the scalar last", M, "loaded-tree",
         "of joint 3 in the near body were given with the scalar last",
         number_change("turn", 2, NEAR, to=lambda q: np.roll(q, -1))),
        ("weld: frame left out", A, "tree-of-seven-sprung",
         "the axes of joint 4 in the far body were not turned",
         number_change("turn", 3, FAR, to=lambda q: np.eye(4)[0])),
        ("weld: frames exchanged", P, "loaded-tree",
         "the axes of joint 4 in the two bodies were exchanged",
         number_change("turn", 3, to=lambda pair: pair[::-1])),
        ("weld: turned by a quarter about a skew axis", M, "wrecking-ball",
         "turn of the axes of joint 2 in the far body were (0.942477796",
         number_change("turn", 1, FAR, to=turned_by(*(np.pi / 2 * np.array([0.6, 0.0, 0.8]))))),
        ("weld: turned by 1e-5 rad", P, "tree-of-seven-sprung",
         "turn of the axes of joint 4 in the far body were",
         number_change("turn", 3, FAR, to=turned_by(4e-6, -5e-6, 8e-6))),
        ("slide: axis reversed", M, "sprung-slider-on-arm", "axis z of joint 2 had the opposite sign",
         number_change("turn", 1, BOTH, to=turned_by(np.pi, 0, 0))),
        ("slide: along another axis", P, "loaded-tree", "x and z of joint 5 were exchanged",
         number_change("turn", 4, BOTH, to=exchanged(0, 2))),
        ("slide: another origin", M, "sprung-slider-on-arm",
         "the origin of the slide of joint 2 were 0.05 m", _offset(1, 0.05)),
        ("slide: another rest position, energies returned", P, "sprung-slide",
         "the rest position of joint 1 were", number_change("rest", 0, 0, by=0.03)),
        ("far point negated", P, "robot-arm", "far point of joint 3 had the opposite sign",
         number_change("point", 2, FAR, times=-1.0)),
        ("points exchanged", M, "tree-of-seven", "the points of joint 5 in the two bodies were exchanged",
         number_change("point", 4, to=lambda pair: pair[::-1])),
        ("near point moved askew", A, "open-governor", "near point of joint 2 were (0.01, -0.02, 0.305) m",
         number_change("point", 1, NEAR, to=plus(0.01, -0.02, 0.005))),
        ("far point in the joint's axes", M, "furuta",
         "the far point of joint 2 were given in the axes of the joint", _in_joint_axes(1)),
        ("hinge: turned by 0.7 rad", P, "double-hinge-skew",
         "turn of the axes of joint 2 in the far body were",
         number_change("turn", 1, FAR, to=turned_by(0.4, 0.5, -0.3))),
        ("cylindrical: near frame left out", M, "tree-of-seven",
         "the axes of joint 5 in the near body were not turned",
         number_change("turn", 4, NEAR, to=lambda q: np.eye(4)[0])),
        ("cylindrical: both frames turned the other way", P, "tree-of-seven-sprung",
         "the axes of joint 5 in both bodies were turned the other way",
         number_change("turn", 4, BOTH, to=quaternion_conjugate)),
        ("weld: turned by 1.2 rad", P, "loaded-tree",
         "turn of the axes of joint 4 in the far body were",
         number_change("turn", 3, FAR, to=turned_by(0.7, -0.8, 0.6))),
    )
]  # fmt: skip
JOINT_DEFECTS.append(
    Defect("slide: another rest position, no energies", "the rest position of joint 2", M,
           "sprung-slider-on-arm", inputs=number_change("rest", 1, 0, by=0.03),
           answers=without("potential_energy"), equal="the effort of joint 2")
)  # fmt: skip


# --- elements, and bodies of a tree -------------------------------------------------------------------

one = partial(Defect, mechanism=EVERY_JOINT)


def _elements() -> Iterator[Defect]:
    where = {
        (0, 0): "joint 1", (1, 0): "joint 2", (2, 0): "joint 3 x", (2, 1): "joint 3 y",
        (3, 0): "joint 4", (4, 0): "joint 5 slide", (4, 1): "joint 5 turn",
    }  # fmt: skip
    words = {"rest": "the rest position of", "effort": "the effort of"}
    for index, (at, joint) in enumerate(where.items()):
        for name in ("armature", "damping", "stiffness", "rest", "effort"):
            if at == (0, 0) and name in ("rest", "effort"):
                continue
            signed = name not in ("armature", "stiffness")  # an engine refuses negative ones
            factor = (0.0, 2.0, 1 + 1e-6, -1.0)[(index + len(name)) % (3 + signed)]
            expected = f"{words.get(name, f'the {name} of')} {joint} "
            yield one(f"{name} of {joint} × {factor:g}", expected, (M, P, A)[index % 3],
                      inputs=number_change(name, *at, times=factor))  # fmt: skip
    for name in ("stiffness", "damping", "length"):
        for i in range(2):
            words_ = f"the {name} of spring {i + 1}"
            yield one(f"{words_} × 1.1", words_, P,
                      inputs=number_change(f"spring_{name}", i, times=1.1))  # fmt: skip
    for name in ("armature", "damping", "stiffness", "effort"):
        every = number_change(name, ..., times=0.0)
        yield one(f"no {name}", f"the {name} of all joints were missing", inputs=every)


def _bodies() -> Iterator[Defect]:
    """Numbers of the bodies of a tree: mass, inertia, loads, drags, gravity."""
    yield one("mass of body 3", "the mass of body 3 were", P,
              inputs=number_change("mass", 2, times=1.001))  # fmt: skip
    yield one("inertia of body 2", "the inertia xx of body 2",
              inputs=number_change("inertia", 1, 0, 0, times=1.01))  # fmt: skip
    yield one("gravity", "gravity were", inputs=number_change("gravity", ..., times=1.001))
    for name, words in (("force", "applied force"), ("moment", "applied moment")):
        dropped = number_change(name, 1, times=0.0)
        yield one(f"no {name} on body 2", f"the {words} of body 2 were missing", inputs=dropped)
    for name in ("drag_force", "drag_moment"):
        words = f"the {name.replace('_', ' ')} of body 4 were"
        same = f"{words} taken with the angular velocity relative to its parent"  # body 4 is on a slide
        equal = same if name == "drag_moment" else ""
        yield one(f"{name} of body 4", words, P, inputs=number_change(name, 3, times=0.0), equal=equal)


def _arm_reversed(model: Model, state: State, found: StateQuantities) -> dict[str, Array]:
    """The moments of joints with the arm to the centre of mass of the whole reversed."""
    assert found.joint_moment is not None and found.joint_reaction is not None
    near = state.r + np.matvec(rotation_matrix(state.p), model.proximal)
    whole = model.mass @ state.r / np.sum(model.mass)
    return {"joint_moment": found.joint_moment + 2 * np.cross(near - whole, found.joint_reaction)}


def _rotor_in_force(model: Model, _: State, found: StateQuantities) -> dict[str, Array]:
    """The force of the slide's joint counts its rotor's force as carried by the joint."""
    reaction = np.asarray(found.joint_reaction)
    return {"joint_reaction": with_row(3, reaction, reaction + model.armature[3, 0] * found.acceleration)}


ELEMENT_DEFECTS = [
    *_bodies(),
    one("moments with the arm reversed",
        "joint moment with the arm of joints to the centre of mass of the whole multiplied by -1",
        answers=recomputed(_arm_reversed)),
    *_elements(),
    one("rest in degrees", "rest position of all joints were 0.0174532925",
        inputs=number_change("rest", ..., times=np.pi / 180)),
    one("axis in the far body", "turn about x of the axes of joint 2 in the far body were",
        inputs=number_change("turn", 1, FAR, to=turned_by(1e-6, 0, 0))),
    one("axis in the near body", "turn about y of the axes of joint 4 in the near body were",
        inputs=number_change("turn", 3, NEAR, to=turned_by(0, 1e-6, 0))),
    one("far point", "far point y of joint 5 were", P, inputs=number_change("point", 4, FAR, 1, by=1e-6)),
    one("near point", "near point z of joint 3 were", P, inputs=number_change("point", 2, NEAR, 2, by=1e-6)),
    one("rotor counted in a joint's force", answers=recomputed(_rotor_in_force)),
    one("kinetic energy of rotors", "kinetic energy without that of the rotors",
        answers=answer_change("kinetic_energy", lambda m, s, e: e - kinetic_energy_of_rotors(m, s))),
    one("energy of springs", "potential energy without all springs",
        answers=answer_change("potential_energy", lambda m, s, e: e - elastic_energy(m, s))),
    one("whole turns forgotten", inputs=model_change(
        lambda m, _: {"rest": m.rest + 2 * np.pi * (m.rest != 0)})),
]  # fmt: skip


# --- loops ------------------------------------------------------------------------------------------


def _loops_at_rest(right: Any) -> Any:
    """J q̈ = 0 where it is −J̇ q̇: the constraints are evaluated at rest."""

    def wrong(self: Any, q: Array, v: Array, torque: Array) -> Array:
        from adapters.pinocchio_engine import pin

        moving = pin.nonLinearEffects(self.pin_model, self.data, q, v)
        resting = pin.nonLinearEffects(self.pin_model, self.data, q, 0 * v)
        return np.asarray(right(self, q, 0 * v, torque - moving + resting))

    return wrong


def _without_row(k: int, row: int) -> Patch:
    """One of the axes that a joint holds is free."""
    return replaced_by(
        "adapters.exudyn_engine:ExudynChain", lambda chain: partial(chain, left_out=frozenset({(k, row)}))
    )


def _without_loop(loop: int) -> Patch:
    """The ends of one loop are not joined."""

    def cut(right: Callable[[Model], CutMechanism]) -> Callable[[Model], CutMechanism]:
        def wrong(model: Model) -> CutMechanism:
            whole = right(model)
            return replace(whole, ends=(*whole.ends[:loop], *whole.ends[loop + 1 :]))

        return wrong

    return replaced_by("adapters.pinocchio_engine:cut_open", cut)


def _other_branch(given: int, guess: Callable[[Array], Array]) -> Inputs:
    """The other coordinates that close the loops at the same coordinate of one joint, found from a guess."""
    return lambda model, state: (model, other_branch(model, state, given, guess))


def other_branch(model: Model, state: State, given: int, guess: Callable[[Array], Array]) -> State:
    """The state of another branch with one coordinate and its rate given."""
    cut = cut_open(model)
    x = guess(state.x)
    x[given] = state.x[given]
    there = cut.state(complete_state(model, replace(state, x=x)))
    place = cut.place[given]  # of hinges and slides alone
    free = np.arange(cut.model.n) != place
    for _ in range(60):
        step = np.zeros(cut.model.n)
        step[free] = np.linalg.lstsq(cut.jacobian(there)[:, free], -cut.gap(there), rcond=1e-9)[0]
        there = displaced(cut.model, there, step / max(1.0, 4 * float(np.max(np.abs(step)))))
    assert np.max(np.abs(cut.gap(there))) < 1e-12
    rates, J = np.zeros(cut.model.n), cut.jacobian(there)
    rates[place] = state.xdot[given, 0]
    rates[free] = np.linalg.lstsq(J[:, free], -J[:, place] * rates[place], rcond=1e-9)[0]
    return cut.source_state(with_rates(cut.model, there, rates))


AT_REST = replaced_by("adapters.pinocchio_engine:PinocchioChain._closed_acceleration", _loops_at_rest)
LOOPS = ("four-bar", "slider-crank", "flyball-governor", "squeezer", "bricard")
FOUR_BAR, CRANK, GOVERNOR, SQUEEZER, BRICARD = LOOPS
# By name of a defect of a body that moves in a plane: of its inertia one number acts.
PLANAR = {"inertia of a body": "the inertia of body 5 were 1.05 times as large"}

LOOP_DEFECTS = [
    *(
        Defect(name, expected, engine, scenario, inputs=change, equal=PLANAR.get(name, ""))
        for name, engine, scenario, expected, change in (
            ("mass of a body", P, FOUR_BAR, "the mass of body 2 were", number_change("mass", 1, times=1.01)),
            ("inertia of a body", E, SQUEEZER, "the inertia zz of body 5 were",
             number_change("inertia", 4, 2, 2, times=1.05)),
            ("an effort's sign", M, SQUEEZER, "the effort of joint 1 had the opposite sign",
             number_change("effort", 0, 0, times=-1.0)),
            ("a spring's length", P, SQUEEZER, "the length of spring 1 were",
             number_change("spring_length", 0, times=1.01)),
            ("a slide's damper", P, GOVERNOR, "the damping of joint 4 were doubled",
             number_change("damping", 3, 0, times=2.0)),
            ("a slide's spring left out", M, GOVERNOR, "the stiffness of joint 4 were missing",
             number_change("stiffness", 3, 0, times=0.0)),
            ("a slide's rest position", E, GOVERNOR, "the rest position of joint 4 were",
             number_change("rest", 3, 0, by=0.02)),
            ("length of a rod that closes a loop", M, GOVERNOR, "the length of joint 6 were",
             number_change("length", 5, times=1.001)),
            ("length of such a rod, in joint coordinates", P, GOVERNOR, "the length of joint 5 were",
             number_change("length", 4, times=1.0001)),
            ("a rotor that is not there", P, FOUR_BAR, "the armature of joint 2 were 0.01",
             number_change("armature", 1, 0, by=0.01)),
            ("a damper that is not there", E, CRANK, "the damping of joint 3 were 0.3",
             number_change("damping", 2, 0, by=0.3)),
            ("anchor of the closing joint", P, FOUR_BAR, "far point x of joint 4 were 0.251 m",
             number_change("point", 3, FAR, 0, by=1e-3)),
            ("anchor of the closing joint, bodies as they are", E, FOUR_BAR,
             "far point x of joint 4 were",
             number_change("point", 3, FAR, 0, by=1e-3, are_bodies_moved=False)),
            ("axis of a slide", P, CRANK, "", number_change("turn", 2, FAR, to=turned_by(1e-3, 0, 0))),
            ("near point of a hinge, bodies as they are", R, CRANK, "near point x of joint 2 were",
             number_change("point", 1, NEAR, 0, by=1e-3, are_bodies_moved=False)),
            ("point of an overconstrained loop, bodies as they are", E, BRICARD,
             "near point x of joint 3 were",
             number_change("point", 2, NEAR, 0, by=1e-5, are_bodies_moved=False)),
            ("axis of an overconstrained loop", P, BRICARD, "",
             number_change("turn", 2, FAR, to=turned_by(1e-7, 0, 0))),
            ("anchor of a spatial loop", P, GOVERNOR, "far point x of joint 2 were",
             number_change("point", 1, FAR, 0, by=1e-4)),
            ("the other branch", P, FOUR_BAR,
             "the loops were closed on another branch at the same coordinate of joint 1",
             _other_branch(0, lambda x: x * [[1], [-1], [-1]])),
            ("the other branch of a crank", M, CRANK,
             "the loops were closed on another branch at the same coordinate of joint 1",
             _other_branch(0, lambda x: x * [[1], [1], [-1]] + [[0], [np.pi], [0]])),
            ("gravity", E, BRICARD, "y component of gravity were -9.81981",
             number_change("gravity", ..., times=1.001)),
        )
    ),
    *(
        Defect(name, expected, engine, scenario, patch=change)
        for name, engine, scenario, expected, change in (
            ("velocity term of the closing joint missing", R, FOUR_BAR,
             "γ of the rows of joint 4 were missing", without_gamma(3)),
            ("velocity term of a joint of the tree missing", R, CRANK,
             "γ of the rows of joint 2 were missing", without_gamma(1)),
            ("velocity term of a rod missing", R, GOVERNOR,
             "γ of the rows of joint 5 were missing", without_gamma(4)),
            ("velocity terms of the loops missing", P, SQUEEZER,
             "the velocity terms of the rows that close loops were missing", AT_REST),
            ("velocity terms of a spatial loop missing", P, BRICARD,
             "the velocity terms of the rows that close loops were missing", AT_REST),
            ("a row of the closing joint left out", E, CRANK,
             "the row along x of joint 4 were left out", _without_row(3, 0)),
            ("another row of the closing joint left out", E, FOUR_BAR,
             "the row along y of joint 4 were left out", _without_row(3, 1)),
            ("a loop left open", P, GOVERNOR, "the loop of joint 6 were left open", _without_loop(1)),
            ("a loop of several left open", P, SQUEEZER,
             "the loop of joint 9 were left open", _without_loop(1)),
        )
    ),
]  # fmt: skip


# --- springs and dampers along a motion -----------------------------------------------------------------


def _principal_angles(torque: Any) -> Any:
    """Springs act on the angle between −π and π."""
    return lambda self, q, v: torque(self, np.remainder(q + np.pi, 2 * np.pi) - np.pi, v)


def _stale_velocity(torque: Any) -> Any:
    """Dampers feel the velocity of the evaluation before."""
    last: dict[int, Array] = {}

    def joint_torque(self: Any, q: Array, v: Array) -> Any:
        before = last.get(id(self), v)
        last[id(self)] = v.copy()
        return torque(self, q, before)

    return joint_torque


def _forgotten_turns(make: Any) -> Any:
    """Exudyn's spring takes the principal value: no node keeps its last angle."""
    return lambda **given: make(**{name: value for name, value in given.items() if name != "nodeNumber"})


hinge = partial(Defect, mechanism="sprung-hinge")  # wound up, it passes several half turns in a second
TORQUE = "adapters.pinocchio_engine:PinocchioChain.joint_torque"
SPRING = "adapters.exudyn_engine:items.ObjectConnectorTorsionalSpringDamper"
ELEMENT_MOTION_DEFECTS = (
    hinge("wrong spring rest", inputs=number_change("rest", ..., times=1.001)),
    hinge("wrong stiffness", engine=P, integrator="rkmk4",
          inputs=number_change("stiffness", ..., times=1.001)),
    hinge("no damping", inputs=number_change("damping", ..., times=0.0)),
    hinge("damping that drives", engine="exudyn-tree", integrator="RK44",
          inputs=number_change("damping", ..., times=-1.0)),
    hinge("principal angles", engine=P, integrator="rkmk4", patch=replaced_by(TORQUE, _principal_angles)),
    hinge("stale velocity", engine=P, integrator="rkmk4", patch=replaced_by(TORQUE, _stale_velocity)),
    hinge("forgotten turns", engine=E, integrator="trapezoidal", patch=replaced_by(SPRING, _forgotten_turns)),
)  # fmt: skip
