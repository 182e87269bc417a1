"""The O(bodies) form of trees against the direct form, on and off the manifold."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.datatypes import KINDS
from plumbline.model.kinematics import maximal_coordinates
from plumbline.model.random_mechanisms import ELEMENTS, random_tree
from plumbline.model.sampling import random_states
from plumbline.truth.rounding_bound import EPS, state_rounding_bound
from reference_impl.direct import DirectSystem
from reference_impl.euler_parameters import L, dot
from reference_impl.fast.chain_elimination import StructuredSystem
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import DenseSystem, TreeSystem, eliminated_system
from reference_impl.integrate import integrate_dop853
from reference_impl.joints import constraint_rows
from reference_impl.singular_system import SingularSystem
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.notes_test_data import body_first, components
from tests.helpers.random_chains import random_model, tree_from_seed


def off_manifold(model, seed, size):
    """A state whose coordinates and rates are all off by ``size``."""
    rng = np.random.default_rng(seed)
    (state,) = random_states(model, 1, seed)
    return [x + size * rng.normal(size=x.shape) for x in maximal_coordinates(state)]


def accelerations(system, parts):
    a = system.acceleration(*components(*parts))
    return np.concatenate([a[:3].T.ravel(), a[3:].T.ravel()])


@pytest.mark.parametrize("size", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(12))
def test_accelerations_are_those_of_the_direct_form(seed, size):
    model = tree_from_seed(seed, 7)
    parts = off_manifold(model, seed, size)
    expected = DirectSystem(model).solve_unknowns(*parts)[0][: 7 * model.n]
    found = accelerations(TreeSystem([model]), parts)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.max(np.abs(expected)))


def test_trees_side_by_side_do_not_touch_each_other():
    models = [tree_from_seed(seed, n) for seed, n in enumerate((3, 1, 5))]
    models[1] = models[1].changed(gravity=np.array([1.0, 2.0, 3.0]))
    parts = [off_manifold(model, 1, 0.05) for model in models]
    together = components(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    system = TreeSystem(models)
    both = TreeSystem(models).repeated(2).acceleration(*(np.tile(x, 2) for x in together))
    once = system.acceleration(*together)
    assert np.array_equal(both, np.tile(once, 2))
    for model, own, first in zip(models, parts, system.first_body, strict=False):
        alone = TreeSystem([model]).acceleration(*components(*own))
        np.testing.assert_allclose(once[:, first : first + model.n], alone, rtol=1e-13, atol=1e-13)


def test_loops_with_rotors_side_by_side_do_not_touch_each_other():
    """The rows of rotors follow those of all constraints. Seen: an index beyond the first mechanism."""
    s = catalogue_scenario("four-bar")
    rotors = np.zeros((4, 2))
    rotors[[0, 2], 0] = 0.02, 0.05
    models = [replace(s.model, armature=factor * rotors) for factor in (1.0, 3.0)]
    parts = maximal_coordinates(s.state)
    expected = [DirectSystem(model).solve(*parts) for model in models]
    found = DenseSystem(models).solve(*(np.tile(part, (2, 1)) for part in parts))
    for at, one in zip((slice(3), slice(3, 6)), expected, strict=True):
        np.testing.assert_allclose(found.acceleration[at], one.acceleration, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found.pddot[at], one.pddot, rtol=1e-12, atol=1e-11)
    assert np.max(np.abs(expected[0].pddot - expected[1].pddot)) > 0.1
    times = np.linspace(0, 0.25, 3)
    runs = [
        integrate_collocation([models[0]], *parts, times, 1e-11),
        integrate_dop853(models[0], *parts, times, 1e-11),
    ]
    np.testing.assert_allclose(runs[0].r, runs[1].r, atol=1e-9)


def mechanism(what):
    """A tree on joints of one kind, or a chain by its letters."""
    rng = np.random.default_rng(3)
    return random_tree(rng, 5, (what,)) if what in KINDS else random_model(rng, [x == "r" for x in what])


@pytest.mark.parametrize("what", [*KINDS, "b", "r", "rbr"])
def test_projection_ends_on_the_constraints(what):
    """From 1e-5 off the manifold to rounding; a state on it stays."""
    model = mechanism(what)
    system, before = eliminated_system([model]), components(*off_manifold(model, 4, 1e-5))
    q, qdot = system.project(*before)
    r, p, v, pdot = body_first(q, qdot)
    rows = constraint_rows(model, r, p, v, pdot)
    rounding = 2e-14 if what in KINDS else 1e-14
    assert np.max(np.abs([rows.C, rows.constraint_rate(v, pdot)]), initial=0.0) < rounding
    assert np.max(np.abs(dot(p, p) - 1)) < 1e-15 and np.max(np.abs(dot(p, pdot))) < 1e-15
    assert np.max(np.abs(q - before[0])) < 1e-4
    for moved, was in zip(system.project(q, qdot), (q, qdot), strict=True):
        assert np.max(np.abs(moved - was)) < 1e-13


def test_baumgarte_damps_constraint_errors():
    """C̈ + 2 a Ċ + a² C = 0, row by row, by differences along the motion."""
    model, a, h = tree_from_seed(8, 5), 3.0, 1e-5
    q, v = components(*off_manifold(model, 2, 1e-3))
    acceleration = TreeSystem([model]).acceleration(q, v, baumgarte=a)

    def rate(t):
        at = body_first(q + t * v + t * t / 2 * acceleration, v + t * acceleration)
        rows = constraint_rows(model, *at)
        return rows.C, rows.constraint_rate(*at[2:])

    (C, first), ahead, back = rate(0.0), rate(h)[1], rate(-h)[1]
    np.testing.assert_allclose((ahead - back) / (2 * h), -2 * a * first - a * a * C, atol=1e-6)


@pytest.mark.parametrize("joints", [[0, 0, 0], [1, 0, 1], [1, 1]])
def test_chains_from_any_point_move_as_trees_do(joints):
    chain = random_model(3, joints)
    point = chain.point.copy()
    point[0, 0] = 0.3, -0.2, 0.5
    moved = chain.changed(point=point)
    parts, own = off_manifold(moved, 1, 1e-3), eliminated_system([moved])
    assert isinstance(own, StructuredSystem)
    # both are some hundred roundings; they differ by 5e-15 of the accelerations and 4e-16 in projections
    np.testing.assert_allclose(
        accelerations(own, parts), accelerations(TreeSystem([moved]), parts), rtol=256 * EPS
    )
    on = components(*off_manifold(moved, 1, 0.0))
    assert np.max(np.abs(own.constraints(*on)[0])) < 1e-14
    off = on[0] + 1e-3, on[1]
    np.testing.assert_allclose(own.project(*off), TreeSystem([moved]).project(*off), rtol=0, atol=64 * EPS)


def test_chains_keep_their_own_form():
    chain = random_model(0, [1, 0])
    tree = tree_from_seed(0, 2, ("hinge",))
    assert isinstance(eliminated_system([chain]), StructuredSystem)
    assert isinstance(eliminated_system([chain, tree]), TreeSystem)


def test_a_singular_body_is_an_error():
    model = tree_from_seed(0, 3, ("hinge",))
    flat = model.changed(mass=0 * model.mass, inertia=0 * model.inertia)
    with pytest.raises(SingularSystem):
        accelerations(TreeSystem([flat]), off_manifold(model, 0, 0.0))


def test_a_light_body_before_a_heavy_one_keeps_its_digits():
    """A cart of a milligram and a bob of a kilogram; without the refinement 12 bounds off."""
    case = catalogue_scenario("light-cart-pole")
    for state in random_states(case.model, 8, 1):
        parts = maximal_coordinates(state)
        found, bound = TreeSystem([case.model]).solve(*parts), state_rounding_bound(case.model, state)
        expected = DirectSystem(case.model).solve(*parts)
        for name in ("acceleration", "joint_reaction", "joint_moment"):
            error = np.linalg.norm(getattr(found, name) - getattr(expected, name), axis=1)
            assert np.all(error <= bound.tolerance(name)), name
        turning = 2 * np.matvec(L(state.p), found.pddot - expected.pddot)
        assert np.all(np.linalg.norm(turning, axis=1) <= bound.angular_acceleration)


@pytest.mark.parametrize("seed", range(6))
def test_elements_act_as_in_the_direct_form_on_and_off_the_manifold(seed):
    """Off it |p| differs from 1, so that a moment and the generalised force on p differ by a factor."""
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 5, elements=ELEMENTS)
    for size in (0.0, 0.1):
        parts = off_manifold(model, seed, size)
        expected, found = DirectSystem(model).solve(*parts), TreeSystem([model]).solve(*parts)
        for name in ("acceleration", "pddot", "joint_reaction", "joint_moment"):
            own, other = getattr(found, name), getattr(expected, name)
            np.testing.assert_allclose(own, other, atol=1e-11 * np.max(np.abs(other)), err_msg=name)


def test_projection_normalises_far_from_the_constraints():
    """A free body has no constraint but pᵀp = 1, which one division meets however far p is off."""
    model = tree_from_seed(3, 2, ("free",))
    r, p, v, pdot = off_manifold(model, 4, 0.0)
    q, _ = TreeSystem([model]).project(*components(r, 3.0 * p, v, pdot))
    np.testing.assert_allclose(q, components(r, p, v, pdot)[0], rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize(("what", "size"), [("hinge", 0.03), ("rbb", 0.05)])
def test_projection_far_off_ends_on_unit_quaternions(what, size):
    """Newton's steps leave the unit sphere by the square of the gap; the last division returns to it."""
    model = mechanism(what)
    far = off_manifold(model, 4, size)
    near = body_first(*eliminated_system([model]).project(*components(*far)))
    _, p, _, pdot = near
    assert np.max(np.abs(dot(p, p) - 1)) < 1e-15 and np.max(np.abs(dot(p, pdot))) < 1e-15
    left, before = (np.max(np.abs(constraint_rows(model, *parts).C)) for parts in (near, far))
    assert left < 0.02 * before


@pytest.mark.parametrize("a", [0.0, 3.0])
def test_baumgarte_damps_the_length_of_quaternions(a):
    """c = (pᵀp − 1) / 2 of every body: c̈ + 2 a ċ + a² c = 0."""
    model = tree_from_seed(8, 4)
    _, p, _, pdot = parts = off_manifold(model, 2, 0.05)
    pddot = TreeSystem([model]).acceleration(*components(*parts), baumgarte=a)[3:].T
    left = dot(p, pddot) + dot(pdot, pdot) + 2 * a * dot(p, pdot) + a * a * (dot(p, p) - 1) / 2
    np.testing.assert_allclose(left, 0.0, atol=1e-12 * np.max(np.abs(pddot)))
