"""Responses to wrenches and accelerations of joints, against changed mechanisms."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.equations.responses import DEPENDENT, Responses
from plumbline.model.datatypes import State
from plumbline.model.kinematics import (
    complete_state,
    mass_matrix,
    normalised,
    rotation_matrix,
    stack_states,
    velocity_jacobian,
)
from plumbline.model.loops import cut_open
from plumbline.model.random_mechanisms import random_tree
from plumbline.model.sampling import compared_states, random_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import EPS, ROUNDING_FACTOR, state_rounding_bound
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.random_chains import tree_from_seed

NAMES = (
    "chain-5-mixed", "tree-of-seven-sprung", "free-body-with-rotors", "point-mass-arm", "flyball-governor",
    "crowded-loops-1", "helical-screw",
)  # fmt: skip


def cut(name, count=2):
    """A scenario's mechanism, cut open, with its states and the arguments of its ends."""
    scenario = catalogue_scenario(name)
    model, states = scenario.model, states_of(scenario, count)
    if not model.has_loops:
        return model, states, ()
    opened = cut_open(model)
    return opened.model, [opened.state(state) for state in states], (opened.ends, opened.row_scale)


@pytest.mark.parametrize("name", (*NAMES, "bricard", "squeezer", "four-bars-2-flat"))
def test_solutions_are_true(name):
    scenario = catalogue_scenario(name)
    states = states_of(scenario, 3)
    model, opened, ends = cut(name, 3)
    place = cut_open(scenario.model).place[: scenario.model.n] if ends else np.arange(model.n)
    found = Responses(model, opened, *ends).solution
    np.testing.assert_array_equal(Responses(model, stack_states(opened), *ends).solution, found)
    for solution, state in zip(found, states, strict=True):
        true, bound = (
            certify_state(scenario.model, state).quantities,
            state_rounding_bound(scenario.model, state),
        )
        error = np.linalg.norm(solution[place, 0] - true.acceleration, axis=1)
        assert np.all(error <= 0.1 * bound.acceleration)


@pytest.mark.parametrize("name", NAMES)
def test_responses_to_wrenches_are_differences_between_loads(name):
    model, states, ends = cut(name)
    right, scale = Responses(model, states, *ends), 1e3
    force, moment = np.random.default_rng(3).normal(size=(2, model.n, 3)) * scale
    turned = model.changed(force=model.force + force)
    body_axes = [np.matvec(rotation_matrix(state.p).mT, moment) for state in states]
    answer = np.einsum("snqikcj,kcj->snqi", right.to_wrenches(), np.stack([force, moment], 1))
    for s, state in enumerate(states):
        other = turned.changed(moment=turned.moment + body_axes[s])
        change = Responses(other, [state], *ends).solution[0] - right.solution[s]
        np.testing.assert_allclose(answer[s], change, rtol=0, atol=1e-8 * np.max(np.abs(change)))


@pytest.mark.parametrize("name", [name for name in NAMES if "rotors" not in name and "loops" not in name])
def test_wrenches_and_accelerations_of_joints_are_reciprocal(name):
    """Without rotors: what a wrench at a body does to a joint, the joint does to the body."""
    model, states, ends = cut(name)
    found = Responses(model, states, *ends)
    of_bodies, of_joints, first = found.to_wrenches(), found.to_joints(), 0
    for k, held in enumerate(found.held):
        wrench = np.moveaxis(of_bodies[:, k, 2:], (1, 2), (-2, -1)).reshape(len(states), model.n, 2, 3, 6)
        expected = -wrench @ held[:, None, None]
        last = first + held.shape[-1]
        np.testing.assert_allclose(
            of_joints[:, :, :2, :, first:last],
            expected,
            rtol=0,
            atol=1e-9 * np.max(np.abs(expected), initial=1.0),
        )
        first = last


def rounding(model):
    """Of some ten sums over all coordinates of the bodies, one after another: over the largest term."""
    return 10 * 6 * model.n * np.finfo(float).eps


def forces_of_ends(model, found):
    """Forces and moments (S, N, 3) that the bodies lack to move as they do: those of the ends."""
    inertia = rotation_matrix(found.state.p) @ model.inertia @ rotation_matrix(found.state.p).mT
    (acceleration, turning, force, moment), w = np.moveaxis(found.solution, 2, 0), found.omega
    weight = model.mass[:, None] * model.gravity
    forces = model.mass[:, None] * acceleration - found.load - weight - force
    moments = np.matvec(inertia, turning) + np.cross(w, np.matvec(inertia, w)) - found.torque
    moments -= moment + np.cross(found.arm, force)
    for k, far in enumerate(found.far):
        if far >= 0:
            forces[:, far] += force[:, k]
            moments[:, far] += moment[:, k] + np.cross(found.far_arm[:, k], force[:, k])
    return forces, moments


@pytest.mark.parametrize("name", ["flyball-governor", "crowded-loops-1", "bricard"])
def test_ends_that_are_apart_keep_their_twists_and_push_each_other_at_one_point(name):
    """V̇_b − V̇_c + (V_b − V_c) × V_c = 0 with spatial twists at r_b; in these states the loops are open."""
    scenario = catalogue_scenario(name)
    opened = cut_open(scenario.model)
    model, start = opened.model, opened.state(scenario.state)
    states = compared_states(model, start, "open", 4)[1:]
    found = Responses(model, states, opened.ends, opened.row_scale, "twists")
    r, v, w = found.state.r, found.state.v, found.omega
    forces, moments = forces_of_ends(model, found)
    allowed = rounding(model) * np.max(np.abs(found.solution))

    def twist_with_rate(body, point):
        arm = point - r[:, body]
        rate = found.solution[:, body, 0] + np.cross(found.solution[:, body, 1], arm)
        return v[:, body] + np.cross(w[:, body], arm), rate - np.cross(w[:, body], v[:, body])

    for b, c in opened.ends:
        apart = r[:, b] - r[:, c]
        assert np.all(np.linalg.norm(apart, axis=1) > 0.01)
        (of_b, rate_b), (of_c, rate_c) = (twist_with_rate(body, r[:, b]) for body in (b, c))
        spin, turning = w[:, b] - w[:, c], found.solution[:, b, 1] - found.solution[:, c, 1]
        linear = rate_b - rate_c + np.cross(spin, of_c) + np.cross(of_b - of_c, w[:, c])
        assert np.max(np.abs(turning + np.cross(spin, w[:, c]))) <= allowed
        assert np.max(np.abs(linear)) <= allowed
        assert np.min(np.max(np.abs(forces[:, b]), axis=1)) > 0.1
        assert np.max(np.abs(forces[:, b] + forces[:, c])) <= allowed
        around_b = moments[:, b] + moments[:, c] - np.cross(apart, forces[:, c])
        assert np.max(np.abs(around_b)) <= allowed


@pytest.mark.parametrize("name", ["bricard", "squeezer"])
def test_responses_to_errors_of_the_equations_are_differences_between_efforts(name):
    """All joints are hinges: the unit of an error is its own, by which the rate of its hinge is given too."""
    model, states, ends = cut(name)
    found = Responses(model, states, *ends)
    response, unknowns = found.to_factors()
    for k, far in enumerate(found.far):
        axis = np.cross(*np.moveaxis(found.held[k][:, 3:, 3:], -1, 0))  # across the two turns that it holds
        turning = found.solution[:, k, 1] - (found.solution[:, far, 1] if far >= 0 else 0.0)
        unit = np.abs(np.vecdot(axis, turning) / unknowns[:, k])
        effort = model.effort.copy()
        effort[k, 0] += 1e3
        pushed = Responses(model.changed(effort=effort), states, *ends).solution
        expected = found.solution + 1e3 * unit[:, None, None, None] * response[..., k]
        np.testing.assert_allclose(pushed, expected, rtol=0, atol=rounding(model) * np.max(np.abs(pushed)))


def test_responses_to_errors_of_rows_move_the_ends_apart_and_multipliers_are_their_forces():
    model, states, ends = cut("crowded-loops-1")
    found = Responses(model, states, *ends)
    response, unknowns = found.to_factors()
    gaps, first = found.to_gaps(), len(unknowns[0]) - 6 * len(found.ends)
    units = response[..., first:]
    forces, moments = forces_of_ends(model, found)
    given = np.zeros((len(states), model.n, 6))
    for loop, (b, c) in enumerate(found.ends):
        apart = (gaps[:, b, :2] - gaps[:, c, :2]).reshape(len(states), 6, -1)
        own = slice(6 * loop, 6 * loop + 6)
        expected = np.zeros((6, gaps.shape[-1]))
        expected[:, own] = np.eye(6)
        allowed = rounding(model) * np.max(np.abs(gaps[:, :, :2]))
        np.testing.assert_allclose(apart, np.broadcast_to(expected, apart.shape), rtol=0, atol=allowed)
        squares = (np.sum(some[..., own] ** 2, axis=(1, 2, 3)) for some in (units, gaps))
        size = np.sqrt(np.divide(*squares))
        scaled = gaps[..., own] * size[:, None, None, None, :]
        np.testing.assert_allclose(units[..., own], scaled, rtol=rounding(model))
        multipliers = unknowns[:, first:][:, own] / size
        given[:, b] += multipliers
        given[:, c] -= multipliers
    pushed = np.concatenate([forces, moments], -1)
    np.testing.assert_allclose(given, pushed, rtol=0, atol=rounding(model) * np.max(np.abs(found.solution)))


@pytest.mark.parametrize("name", NAMES)
def test_velocities_alone_accelerate_a_joint_along_what_it_holds(name):
    """Along the held directions nothing else does: neither rates of the joint's coordinates nor wrenches."""
    model, states, ends = cut(name)
    found = Responses(model, states, *ends)
    acceleration, turning = found.solution[:, :, 0], found.solution[:, :, 1]
    carried = acceleration + np.cross(turning, found.arm), turning
    expected = np.concatenate(carried, -1)
    for k, far in enumerate(found.far):
        if far >= 0:
            point = acceleration[:, far] + np.cross(turning[:, far], found.far_arm[:, k])
            expected[:, k] -= np.concatenate([point, turning[:, far]], -1)
    apart = expected - found.velocity_terms()
    allowed = rounding(model) * np.max(np.abs(expected))
    for k, held in enumerate(found.held):
        one = np.broadcast_to(np.eye(held.shape[-1]), (len(states), *held.shape[-1:] * 2))
        np.testing.assert_allclose(held.mT @ held, one, rtol=0, atol=36 * np.finfo(float).eps)
        along = np.matvec(held.mT, apart[:, k])
        assert np.max(np.abs(along), initial=0.0) <= allowed
    assert np.max(np.abs(found.velocity_terms())) > 0.1


def test_errors_of_an_inverse_are_those_of_one_in_single_precision():
    """Of trees at rest with bodies of 10 g to 100 kg; a solution without an inverse loses less."""
    by_inverse, by_solution = list[float](), list[float]()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        tree = random_tree(rng, 4, kinds=("hinge", "slide"))
        size = 10 ** rng.uniform(-2, 2, tree.n)
        model = tree.changed(mass=tree.mass * size, inertia=tree.inertia * size[:, None, None])
        (drawn,) = random_states(model, 1, seed)
        state = complete_state(model, replace(drawn, omega=0 * drawn.omega, xdot=0 * drawn.xdot))
        responses = Responses(model, [state])
        jacobian = velocity_jacobian(model, state).reshape(6 * model.n, -1)
        accelerations = responses.solution[0, :, :2].copy()
        accelerations[:, 1] = np.matvec(rotation_matrix(state.p).mT, accelerations[:, 1])
        M = mass_matrix(model, state).astype(np.float32)
        f = M @ np.linalg.lstsq(jacobian, accelerations.ravel())[0].astype(np.float32)
        true = np.linalg.solve(M.astype(float), f.astype(float))
        bound = np.finfo(np.float32).eps / 2 * responses.errors_of_inverse()[0]
        for found, ratios in ((np.linalg.inv(M) @ f, by_inverse), (np.linalg.solve(M, f), by_solution)):
            off = np.linalg.norm((jacobian @ (found - true)).reshape(-1, 2, 3), axis=-1)
            ratios.append(np.max(off[bound > 0] / bound[bound > 0]))
    assert 0.02 <= min(by_inverse) <= max(by_inverse) <= 1  # measured: 0.046 and 0.39, and 0.018 below
    assert min(np.divide(by_solution, by_inverse)) <= 0.05  # an inverse loses what a solution does not


@pytest.mark.parametrize("far", [0, -1])
def test_ends_without_the_velocity_terms_of_rods_as_bodies(far):
    """Of a body on a rod, below another or the world, joined to a free one; with a light body as the rod."""
    tree = replace(
        tree_from_seed(5, 3, kinds=("ball",)), kind=("universal", "rod", "free"),
        body=np.array([[-1, 0], [far, 1], [-1, 2]]), length=np.array([0.0, 0.7, 0.0]),
    )  # fmt: skip
    (state,) = random_states(tree, 1, 3)
    fields = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
    light = {name: np.insert(getattr(tree, name), 1, 0.0, axis=0) for name in fields}
    slender = 1e-9  # kg and kg m²
    light["mass"][1], light["inertia"][1] = slender, slender * np.eye(3)
    point = np.insert(tree.point, 1, [tree.point[1, 0], [0.0, 0.0, -tree.length[1]]], axis=0)
    point[2, 0] = 0.0  # the centre of the light body is at the far end
    with_body = replace(
        tree, kind=("universal", "ball", "ball", "free"), body=np.array([[-1, 0], [far, 1], [1, 2], [-1, 3]]),
        length=np.zeros(4), point=point, turn=np.insert(tree.turn, 1, tree.turn[1], axis=0), **light,
    )  # fmt: skip
    x, y, z = state.u[1]
    along = normalised(np.array([1 + z, -y, x, 0.0]))  # turns z to u
    spin = rotation_matrix(along).T @ np.cross(state.u[1], state.udot[1])
    given = {n: np.insert(getattr(state, n), 1, 0.0, axis=0) for n in ("p", "omega", "r", "v", "x", "xdot")}
    given["p"][1], given["omega"][1] = along, spin
    same = complete_state(with_body, State(**given))
    np.testing.assert_allclose(
        same.r[[0, 2, 3]], state.r, atol=ROUNDING_FACTOR * EPS * np.max(np.abs(state.r))
    )
    by_rod, expected = (
        Responses(mechanism, [there], ends, end_rows=rows).solution[0, places, :2]
        for mechanism, there, ends, rows, places in (
            (tree, state, [(1, 2)], "without those of rods as bodies", [0, 1, 2]),
            (with_body, same, [(2, 3)], "without velocity terms", [0, 2, 3]),
        )
    )
    size = np.max(np.abs(expected))
    share = slender / np.min(np.linalg.eigvalsh(tree.inertia))  # what the light body changes
    np.testing.assert_allclose(by_rod, expected, atol=share * size)
    plain = Responses(tree, [state], [(1, 2)], end_rows="without velocity terms").solution[0, :, :2]
    assert np.max(np.abs(plain - expected)) > 1e-3 * size


def test_an_inverse_loses_nothing_of_a_body_that_an_effort_holds():
    """As nothing is multiplied by it then."""
    tree = tree_from_seed(2, 1, kinds=("slide",), loads=False)
    at_rest = State(np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)))
    state = complete_state(tree, at_rest)
    falls = Responses(tree, [state])
    force = tree.mass[0] * np.linalg.norm(falls.solution[0, 0, 0])
    either = [Responses(tree.changed(effort=np.array([[x, 0.0]])), [state]) for x in (force, -force)]
    held, pulled = sorted(either, key=lambda found: float(np.linalg.norm(found.solution[0, 0, 0])))
    lost = [found.errors_of_inverse()[0, 0, 0] for found in (held, falls, pulled)]
    assert lost[0] <= ROUNDING_FACTOR * EPS * lost[1] and lost[2] == pytest.approx(2 * lost[1])


def test_errors_of_the_equations_are_the_same_whatever_the_unit_of_mass():
    model, states, ends = cut("bricard")
    sizes = []
    for unit in (1.0, 4.0**-10, 4.0**10):  # whose roots are powers of two, so that nothing else is rounded
        other = model.changed(mass=unit * model.mass, inertia=unit * model.inertia)
        response, unknowns = Responses(other, states, *ends).to_factors()
        size = np.sum(np.linalg.norm(response[:, :, :2], axis=3), axis=-1)
        sizes.append(size * np.linalg.norm(unknowns, axis=-1)[:, None, None])
    np.testing.assert_array_equal(sizes[1:], np.broadcast_to(sizes[0], (2, *sizes[0].shape)))


@pytest.mark.parametrize("name", ["bricard", "four-bar"])
def test_what_is_indeterminate_of_a_joints_wrench_is_spanned_by_unit_wrenches(name):
    model, states, ends = cut(name, 3)
    found = Responses(model, states, *ends)
    for k in range(model.n):
        own = found.indeterminate[:, 6 * k : 6 * k + 6]
        pairs = [np.concatenate(pair, -1) for pair in found.indeterminate_wrenches(k)]
        span = np.array(pairs).reshape(len(pairs), len(states), 6).transpose(1, 2, 0)
        assert np.max(np.abs(span.mT @ span - np.eye(len(pairs))), initial=0.0) < 1e-12
        left_out = DEPENDENT * np.linalg.norm(own, axis=(1, 2), keepdims=True)  # singular values below it
        assert np.all(np.abs(span @ (span.mT @ own) - own) <= left_out)
    assert len(found.indeterminate_wrenches(0)) > 0


@pytest.mark.parametrize("field", ["x", "xdot"])
def test_errors_of_an_inverse_have_no_bound_where_a_run_has_become_infinite(field):
    """A slide at infinity makes inertias infinite, an infinite speed forces; neither raises an error."""
    tree = random_tree(np.random.default_rng(1), 2, kinds=("slide", "hinge"))
    (state,) = random_states(tree, 1, 0)
    with np.errstate(invalid="ignore"):
        there = complete_state(tree, replace(state, **{field: np.inf * np.ones_like(state.x)}))
        assert not np.any(np.isfinite(Responses(tree, [there]).errors_of_inverse()))
