"""Derivatives of the equations by jets, against differences in balls along each direction."""

from dataclasses import replace

import flint
import numpy as np
import pytest

from plumbline.equations.arithmetic import balls as ball_arithmetic
from plumbline.equations.jets import Jet, jets, with_slopes
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import KINDS
from plumbline.model.kinematics import stack_states
from plumbline.model.loops import cut_open, independent_rows
from plumbline.model.sampling import random_states
from plumbline.truth.parameters import derivative, list_parameters
from tests.equations.test_tree import sprung_tree
from tests.helpers.catalogue import catalogue_scenario

BITS, STEP = 400, 1e-30
PRECISION = 2e-10  # of a quantity's derivatives by a number
CANCELLED = 1e-3  # of a quantity over the number's scale: slopes below have lost digits
DIRECTIONS = 45


def along(step):
    """Balls at a step along the direction that the leading axis of a field holds."""

    class Along(type(ball_arithmetic(flint))):
        def at(self, x, axes):
            x = np.asarray(x, float)
            if x.ndim == axes:
                return [flint.arb(float(value)) for value in np.ravel(x)]
            slopes = np.ravel(x[1, 0]) if len(x) > 1 else np.zeros(x[0, 0].size)
            pairs = zip(np.ravel(x[0, 0]), slopes, strict=True)
            return [flint.arb(float(value)) + step * flint.arb(float(slope)) for value, slope in pairs]

        def scalar(self, x):
            return self.at(x, 0)[0]

        def vector(self, x):
            return self.mat(3, 1, self.at(x, 1))

        def matrix(self, x):
            return self.mat(3, 3, self.at(x, 2))

    return Along(flint)


def evaluated(num, model, states, *joined):
    tree = Tree(num, model, states)
    return tree.quantities(tree.solve_joined(*joined)) | {"mass_matrix": tree.mass_matrix()}


def check_jets(model, state, seed, *joined):
    """Every direction's derivatives of every quantity, over the largest of that quantity by that number."""
    every = [one for one in list_parameters(model, state) if one.scale]
    chosen = np.random.default_rng(seed).permutation(len(every))[:DIRECTIONS]
    parameters, states = [every[i] for i in sorted(chosen)], stack_states([state])
    directions = [derivative(model, state, one) for one in parameters]
    found = evaluated(jets(), *with_slopes(model, states, directions), *joined)
    with flint.ctx.workprec(BITS):
        h = flint.arb(STEP)
        for i, direction in enumerate(directions):
            moved = with_slopes(model, states, [direction])
            plus, minus = (evaluated(along(sign * h), *moved, *joined) for sign in (1, -1))
            for quantity in found:
                own, a, b = (listed(some[quantity]) for some in (found, plus, minus))
                true = [midpoints((x - y) / (2 * h)) for x, y in zip(a, b, strict=True)]
                slopes = [
                    np.zeros(x.value.shape[-2:]).ravel() if x.slope is None else np.ravel(x.slope[i, 0])
                    for x in own
                ]
                value = max(np.max(np.abs(x.value)) for x in own)
                size = max(np.max(np.abs(true)), CANCELLED * value / parameters[i].scale)
                np.testing.assert_allclose(
                    slopes, true, rtol=0, atol=PRECISION * size, err_msg=f"{parameters[i]}, {quantity}"
                )


def listed(quantity):
    return quantity if isinstance(quantity, list) else [quantity]


def midpoints(change):
    balls = change.entries() if hasattr(change, "entries") else [change]
    return [float(x.mid()) for x in balls]


@pytest.mark.parametrize("kinds", [("rod", "ball"), tuple(KINDS)], ids=len)
@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.full) for n in range(2, 12))])
def test_derivatives_of_trees_with_every_element(kinds, seed):
    model = sprung_tree(seed, kinds)
    check_jets(model, random_states(model, 1, seed)[0], seed, (), ())


@pytest.mark.parametrize("name", ["chain-5-mixed", "loaded-tree", "point-mass-arm", "sprung-ball-on-slide"])
def test_derivatives_of_catalogue_mechanisms(name):
    scenario = catalogue_scenario(name)
    check_jets(scenario.model, scenario.state, 1, (), ())


@pytest.mark.parametrize("name", ["squeezer", "crowded-loops-bare"])
def test_derivatives_where_loops_are_cut(name):
    scenario = catalogue_scenario(name)
    cut = cut_open(scenario.model)
    state = cut.state(scenario.state)
    check_jets(cut.model, state, 1, cut.ends, [*independent_rows(cut.jacobian(state), cut.row_scale)])


def test_a_batch_of_states_is_its_states():
    scenario = catalogue_scenario("tree-of-seven-sprung")
    model, states = scenario.model, random_states(scenario.model, 3, 1)
    some = [one for one in list_parameters(model, states[0])[::9] if one.kind in vars(model)]
    directions = [derivative(model, states[0], one) for one in some]
    together = evaluated(jets(), *with_slopes(model, stack_states(states), directions), (), ())
    for i, state in enumerate(states):
        alone = evaluated(jets(), *with_slopes(model, stack_states([state]), directions), (), ())
        for a, b in zip(together["acceleration"], alone["acceleration"], strict=True):
            np.testing.assert_allclose(
                a.slope[:, i], b.slope[:, 0], rtol=0, atol=1e-12 * np.max(np.abs(b.slope))
            )


def test_the_spring_of_an_untwisted_ball_has_the_slope_of_its_stiffness():
    """Where the angle is 0 its norm has no derivative, but the moment has."""
    scenario = catalogue_scenario("sprung-ball")
    model, state = scenario.model, scenario.state
    k = int(np.argmax(model.stiffness[:, 0]))
    model = model.changed(turn=np.tile([1.0, 0.0, 0.0, 0.0], (model.n, 2, 1)), damping=0 * model.damping)
    p = np.tile([1.0, 0.0, 0.0, 0.0], (model.n, 1))
    still = {name: 0 * getattr(state, name) for name in ("omega", "udot", "x", "xdot")}
    states = stack_states([replace(state, p=p, **still)])
    turned = np.zeros_like(p)
    turned[k, 3] = 0.5  # about z, per rad
    tree = Tree(jets(), *with_slopes(model, states, [{"p": turned}]))
    (effort,) = (block.effort for block in tree.blocks[k])
    np.testing.assert_allclose(effort.slope[0, 0, :, 0], [0, 0, -model.stiffness[k, 0]], atol=1e-12)


def test_the_root_of_zero_has_no_slope():
    root = jets().sqrt(Jet(np.array([0.0, 4.0] * 1000), np.ones(2000)))
    np.testing.assert_array_equal(root.slope, [0.0, 0.25] * 1000)
