"""Steps by the equations of `plumbline.equations` against those of the equations that they replaced."""

from unittest.mock import patch

import numpy as np
import pytest

from plumbline.model.sampling import compared_states
from plumbline.model.step_methods import JointSpaceMethod, classical_runge_kutta
from plumbline.truth import step_formulas
from tests.helpers.catalogue import catalogue_scenarios
from tests.helpers.former_equations.closed_tree import ClosedTree
from tests.helpers.nightly_tests import slow

if not step_formulas.HAS_EXTENDED_PRECISION:
    pytest.skip("no extended precision on this machine", allow_module_level=True)

SAMPLE = ("double-loaded-rods", "light-cart-pole", "sprung-without-rotors", "slider-crank")
OTHERS = sorted(
    catalogue_scenarios().keys() - {*SAMPLE, "bricard"}
)  # whose rows depend on others when closed
STEP = 2.0**-9  # s
OF_LOOPS = (
    JointSpaceMethod(
        "semi-implicit Euler", "joint rotations", 1 / 3, free_coordinates="rigid motion", gap_correction=50.0
    ),
    classical_runge_kutta("joint rotations", 1 / 3, "rigid motion", 50.0),
)
OF_TREES = (
    *(
        JointSpaceMethod("semi-implicit Euler", "joint rotations", 0.01 / 3, implicit_forces=forces)
        for forces in ("joint dampers", "applied", "all")
    ),
    classical_runge_kutta("joint angles"),
)


def axes_of(scenario, state):
    """Axes of angles in place of rods, balls and free bodies; rods turn about axes across them."""
    axes = [np.zeros((0, 3))]
    for k, kind in enumerate(scenario.model.tree.kind):
        turn = np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))[0]
        if kind == "rod":
            first = np.cross(state.u[k], turn[0])
            axes.append(np.stack([first, np.cross(state.u[k], first)]) / np.linalg.norm(first))
        if kind in ("rod", "ball", "free"):
            axes.append(turn)
    return np.concatenate(axes)


def check_steps(name):
    scenario = catalogue_scenarios()[name]
    states = compared_states(scenario.model, scenario.state, scenario.seed, 1)
    axes = [axes_of(scenario, state) for state in states]
    for method in (*OF_LOOPS, *(() if scenario.model.has_loops else OF_TREES)):
        if method.coordinates == "joint angles" and scenario.model.has_elements:
            continue
        arguments = scenario.model, states, [STEP] * len(states), method, 2, axes
        after = step_formulas.joint_space_steps(*arguments)
        with patch.object(step_formulas, "StepCharts", ClosedTree):
            before = step_formulas.joint_space_steps(*arguments)
        for old, new in zip(before, after, strict=True):
            for quantity, true in vars(old).items():
                value = getattr(new, quantity)
                scale = max(1.0, np.max(np.abs(true), initial=0.0))
                error = np.max(np.abs(value - true), initial=0.0)
                assert error < 1e-14 * scale, (method, quantity, float(error / scale))


@pytest.mark.parametrize("name", SAMPLE)
def test_steps_are_those_of_the_former_equations(name):
    check_steps(name)


@slow
@pytest.mark.parametrize("name", OTHERS)
def test_steps_are_those_of_the_former_equations_everywhere(name):
    check_steps(name)
