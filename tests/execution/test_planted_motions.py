"""Defects of springs, dampers and efforts that show along a motion: each is reported."""

from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest

from adapters.pinocchio_engine import PinocchioChain
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import RowContext
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.measurements.refinement_study import run_refinement_study
from plumbline.truth.ground_truth import motion_truth
from tests.helpers.catalogue import catalogue_scenarios

TIMES = np.arange(65) / 64  # s; a quarter as many samples do not resolve the work of the damper


@cache
def subject():
    """A wound-up spring with a damper on a hinge that passes several half turns in a second."""
    case = catalogue_scenarios()["sprung-hinge"]
    return case.model, case.state, motion_truth(case.model, case.state, TIMES, None)


def rows(engine, integrator):
    model, state, truth = subject()
    method = engine.integrator(integrator)
    steps = refinement_resolutions(method, model.n, float(TIMES[-1]))
    with patch("plumbline.engines.engine_calls.load_adapter", lambda _: engine):
        runs = run_refinement_study(engine.name, integrator, model, state, TIMES, steps)
    return judge_trajectory(RowContext("planted", "planted", *[engine.name] * 3), model, truth, method, runs)


def changed(engine, **factors):
    """The engine runs another mechanism: some fields multiplied."""
    adapter = load_adapter(engine)
    own = adapter._simulate

    def simulate(model, *rest):
        return own(replace(model, **{name: f * getattr(model, name) for name, f in factors.items()}), *rest)

    adapter._simulate = simulate
    return adapter, ExitStack()


def principal_angles():
    """Springs act on the angle between −π and π."""
    adapter, stack, torque = load_adapter("pinocchio"), ExitStack(), PinocchioChain.joint_torque
    stack.enter_context(
        patch.object(
            PinocchioChain,
            "joint_torque",
            lambda self, q, v: torque(self, np.remainder(q + np.pi, 2 * np.pi) - np.pi, v),
        )
    )
    return adapter, stack


def stale_velocity():
    """Dampers feel the velocity of the evaluation before."""
    adapter, stack, torque = load_adapter("pinocchio"), ExitStack(), PinocchioChain.joint_torque
    last = {}

    def joint_torque(self, q, v):
        before = last.get(id(self), v)
        last[id(self)] = v.copy()
        return torque(self, q, before)

    stack.enter_context(patch.object(PinocchioChain, "joint_torque", joint_torque))
    return adapter, stack


def forgotten_turns():
    """Exudyn's spring takes the principal value: no node keeps its last angle."""
    import adapters.exudyn_engine as exudyn_engine

    adapter, stack = load_adapter("exudyn"), ExitStack()
    make = exudyn_engine.items.ObjectConnectorTorsionalSpringDamper

    def without_node(**arguments):
        return make(**{name: value for name, value in arguments.items() if name != "nodeNumber"})

    stack.enter_context(
        patch.object(exudyn_engine.items, "ObjectConnectorTorsionalSpringDamper", without_node)
    )
    return adapter, stack


DEFECTS = {
    "wrong spring rest": ("RK4", lambda: changed("mujoco", rest=1.001)),
    "wrong stiffness": ("rkmk4", lambda: changed("pinocchio", stiffness=1.001)),
    "no damping": ("RK4", lambda: changed("mujoco", damping=0.0)),
    "damping that drives": ("RK44", lambda: changed("exudyn-tree", damping=-1.0)),
    "principal angles": ("rkmk4", principal_angles),
    "stale velocity": ("rkmk4", stale_velocity),
    "forgotten turns": ("trapezoidal", forgotten_turns),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_every_defect_of_a_motion_with_elements_is_reported(name):
    integrator, plant = DEFECTS[name]
    engine, stack = plant()
    with stack:
        found = rows(engine, integrator).rows
    assert any(row.verdict.needs_attention for row in found), [row.reason for row in found]


@pytest.mark.parametrize(
    ("engine", "integrator"),
    [("mujoco", "RK4"), ("pinocchio", "rkmk4"), ("exudyn-tree", "RK44"), ("exudyn", "trapezoidal")],
)
def test_the_same_engines_without_defect_are_not_reported(engine, integrator):
    found = rows(load_adapter(engine), integrator).rows
    assert not [row.reason for row in found if row.verdict.needs_attention]
