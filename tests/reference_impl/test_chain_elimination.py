"""The structured form against the direct form it stands in for, on and off the manifold."""

import numpy as np
import pytest

from plumbline.model.datatypes import State
from plumbline.model.kinematics import complete_state, maximal_coordinates, quaternion_rate
from plumbline.truth.rounding_bound import state_rounding_bound
from reference_impl.direct import EPS, DirectSystem, Solution
from reference_impl.euler_parameters import L
from reference_impl.fast.chain_elimination import StructuredSystem, component_first
from reference_impl.joints import constraint_rows
from reference_impl.singular_system import SingularSystem
from tests.helpers.notes_test_data import components
from tests.helpers.random_chains import in_other_units, norms_per_body, random_chain

JOINT_MIXES = {
    "balls": lambda rng, n: [False] * n,
    "rods": lambda rng, n: [True] * n,
    "mixed": lambda rng, n: list(rng.random(n) < 0.5),
}
for_each_mix = pytest.mark.parametrize("mix", JOINT_MIXES)


def split_by_chain(solution, forest):
    """The forest's answer chain by chain."""
    out = []
    for index, one in enumerate(forest.chains):
        mine = (solution.joint >= forest.first_body[index]) & (solution.joint < forest.first_body[index + 1])
        body = slice(forest.first_body[index], forest.first_body[index + 1])
        out.append(
            Solution(
                acceleration=solution.acceleration[body],
                pddot=solution.pddot[body],
                multiplier=solution.multiplier[mine],
                norm_multiplier=solution.norm_multiplier[body],
                joint=solution.joint[mine] - forest.first_body[index],
                tension=solution.tension[body],
                joint_reaction=solution.joint_reaction[body],
                joint_moment=solution.joint_moment[body],
            )
        )
        assert len(out[-1].pddot) == one.n
    return out


@for_each_mix
def test_equals_the_direct_form_within_the_derived_bound(mix):
    rng = np.random.default_rng(20)
    for _ in range(12):
        drawn = [
            random_chain(rng, JOINT_MIXES[mix](rng, n), mass_decades=1.0, loads=True, drag=True)
            for n in rng.integers(1, 11, size=4)
        ]
        forest = StructuredSystem([model for model, _ in drawn])
        held = maximal_coordinates(*(state for _, state in drawn))
        together = split_by_chain(forest.solve(*held), forest)
        for (model, state), ours in zip(drawn, together, strict=True):
            direct = DirectSystem(model).solve(*maximal_coordinates(state))
            bound = state_rounding_bound(model, state)
            turned = [2 * (L(state.p) @ x.pddot[..., None])[..., 0] for x in (ours, direct)]
            for ours_, direct_, allowed in (
                (ours.acceleration, direct.acceleration, bound.acceleration),
                (turned[0], turned[1], bound.angular_acceleration),
                (ours.joint_reaction, direct.joint_reaction, bound.joint_reaction),
            ):
                assert np.all(np.linalg.norm(ours_ - direct_, axis=-1) <= allowed)


@for_each_mix
@pytest.mark.parametrize("off", [0.0, 0.05, 1.0])
def test_all_unknowns_equal_the_direct_forms_on_and_off_the_manifold(mix, off):
    """r, p and the rates anywhere: the printed rows' own behaviour (E2, E3) is part of what is equal.

    Off the manifold there is no derived bound.  Masses within a factor 10 and rods of 0.2 m and more keep
    the equilibrated S at condition 1e4 … 1e5 for these chains, so 1e-11 of the largest entry is rounding;
    a term of E2 or E3 left out shows at ``off``, nine orders above.
    """
    rng = np.random.default_rng(21)
    for _ in range(12):
        drawn = [
            random_chain(rng, JOINT_MIXES[mix](rng, n), 0.5, loads=True, drag=True) for n in (1, 2, 2, 5, 8)
        ]
        forest = StructuredSystem([model for model, _ in drawn])
        held = maximal_coordinates(*(state for _, state in drawn))
        r, p, v, pdot = (x + off * rng.normal(size=x.shape) for x in held)
        for index, ours in enumerate(split_by_chain(forest.solve(r, p, v, pdot), forest)):
            body = slice(forest.first_body[index], forest.first_body[index + 1])
            direct = DirectSystem(forest.chains[index]).solve(r[body], p[body], v[body], pdot[body])
            for name in (
                "acceleration",
                "pddot",
                "multiplier",
                "norm_multiplier",
                "joint_reaction",
                "tension",
            ):
                a, b = getattr(ours, name), getattr(direct, name)
                assert np.array_equal(np.isnan(a), np.isnan(b))
                scale = np.max(np.abs(b), initial=1.0, where=~np.isnan(b))
                assert np.nanmax(np.abs(a - b), initial=0.0) <= 1e-11 * scale, name


def test_a_batch_is_more_chains():
    """A chain's answer does not depend on its neighbours in the forest, to the last bit of a sum."""
    rng = np.random.default_rng(22)
    model, state = random_chain(rng, [True, False, True])
    other, elsewhere = random_chain(rng, [False, False])
    alone = StructuredSystem([model])
    (q, v), (q2, v2) = (components(*maximal_coordinates(x)) for x in (state, elsewhere))
    answer = alone.acceleration(q, v)
    both = StructuredSystem([other, model]).acceleration(np.hstack([q2, q]), np.hstack([v2, v]))
    tiled = alone.repeated(3).acceleration(np.tile(q, 3), np.tile(v, 3))
    scale = np.max(np.abs(answer))
    assert np.max(np.abs(both[:, 2:] - answer)) <= 1e-13 * scale
    assert np.max(np.abs(tiled - np.tile(answer, 3))) <= 1e-13 * scale


@for_each_mix
def test_singular_configurations_are_reported(mix):
    rng = np.random.default_rng(23)
    model, state = random_chain(rng, JOINT_MIXES[mix](rng, 4))
    forest, (r, p, v, pdot) = StructuredSystem([model]), maximal_coordinates(state)
    zero = p.copy()
    zero[2] = 0
    with pytest.raises(SingularSystem, match=r"p of body 3"):
        forest.solve(r, zero, v, pdot)
    r[1] = np.nan
    with pytest.raises(SingularSystem, match=r"body 2"):
        forest.solve(r, p, v, pdot)
    for change, words in (
        ({"mass": model.mass * [1, 0, 1, 1]}, r"mass of body 2 is 0\.0 kg"),
        ({"inertia": model.inertia * np.array([1, 1, 1, 0])[:, None, None]}, "inertia of body 4"),
    ):
        with pytest.raises(SingularSystem, match=words):
            StructuredSystem([model.changed(**change)])


@for_each_mix
def test_constraints_are_gaps_of_balls_and_squares_of_rods(mix):
    """C and its rate along (ṙ, ṗ), where joints are open and p is a unit quaternion; a rod has one row."""
    rng = np.random.default_rng(25)
    rods = {"balls": [False] * 5, "rods": [True] * 5, "mixed": [True, False, True, True, False]}[mix]
    model, state = random_chain(rng, rods)
    r, v = state.r + 0.1 * rng.normal(size=(5, 3)), state.v + 0.1 * rng.normal(size=(5, 3))
    pdot = quaternion_rate(state.p, state.omega)
    forest, direct = StructuredSystem([model]), constraint_rows(model, r, state.p, v, pdot)
    found = forest.constraints(*components(r, state.p, v, pdot))
    for ours, theirs in zip(found, (direct.C, direct.constraint_rate(v, pdot)), strict=True):
        assert ours.shape == (1 if mix == "rods" else 3, 5)
        kept = np.array([[row == 0 or not rod for row in range(len(ours))] for rod in model.rods])
        np.testing.assert_allclose(ours.T[kept], theirs, rtol=0, atol=1e-13)
        assert not np.any(ours.T[~kept])


@pytest.mark.parametrize("at, words", [(0, "body 1"), (3, "body 2"), (6, "body 2")])
def test_a_cause_is_named_by_the_body_of_its_own_chain(at, words):
    """Chains of 2, 3 and 2 bodies; the bodies of all are counted from 0."""
    rng = np.random.default_rng(26)
    drawn = [random_chain(rng, [False] * n) for n in (2, 3, 2)]
    r, p, v, pdot = maximal_coordinates(*(state for _, state in drawn))
    forest = StructuredSystem([model for model, _ in drawn])
    for broken, what in ((p, 0.0), (r, np.nan)):
        kept = broken[at].copy()
        broken[at] = what
        with pytest.raises(SingularSystem, match=words):
            forest.solve(r, p, v, pdot)
        broken[at] = kept


@for_each_mix
@pytest.mark.parametrize("a", [0.5, 8.0])
def test_baumgarte_adds_2a_and_a_squared_to_every_constraint(mix, a):
    """C̈ + 2 a Ċ + a² C = 0 of joints that are open, and of pᵀp − 1."""
    rng = np.random.default_rng(27)
    model, state = random_chain(rng, JOINT_MIXES[mix](rng, 4), loads=True, drag=True)
    forest, h = StructuredSystem([model]), 1e-6
    q, v = components(*maximal_coordinates(state))
    q[:3] += 0.1 * rng.normal(size=(3, 4))
    v[:3] += 0.1 * rng.normal(size=(3, 4))
    acceleration = forest.acceleration(q, v, a)
    np.testing.assert_array_equal(forest.acceleration(q, v), forest.acceleration(q, v, 0.0))
    assert np.any(forest.acceleration(q, v) != acceleration)
    C, C_rate = forest.constraints(q, v)
    ends = [forest.constraints(q + s * h * v, v + s * h * acceleration)[1] for s in (1, -1)]
    second = (ends[0] - ends[1]) / (2 * h)
    np.testing.assert_allclose(second, -2 * a * C_rate - a * a * C, rtol=0, atol=1e-6 * (1 + a * a))
    q[3:], v[3:] = 1.1 * q[3:], v[3:] + 0.1 * q[3:]
    p, p_rate, p_second = q[3:], v[3:], forest.acceleration(q, v, a)[3:]
    E, E_rate = np.sum(p * p, 0) - 1, 2 * np.sum(p * p_rate, 0)
    E_second = 2 * np.sum(p_rate * p_rate + p * p_second, 0)
    np.testing.assert_allclose(E_second, -2 * a * E_rate - a * a * E, rtol=0, atol=1e-11 * (1 + a * a))


@for_each_mix
def test_a_pendulum_of_any_size_is_solved_alike(mix):
    """Micrometres and milligrams, kilometres and kilotons: no threshold has a unit."""
    rng = np.random.default_rng(28)
    model, state = random_chain(rng, JOINT_MIXES[mix](rng, 3), loads=True, drag=True)
    here = StructuredSystem([model]).solve(*maximal_coordinates(state))
    allowed = state_rounding_bound(model, state)
    for length, mass, second in ((1e-6, 1e-9, 1e-3), (1e3, 1e6, 1e2), (1.0, 1e15, 1.0)):
        small, at = in_other_units(model, state, length, mass, second)
        there = StructuredSystem([small]).solve(*maximal_coordinates(at))
        for name, unit, bound in (
            ("acceleration", length / second**2, allowed.acceleration),
            ("pddot", 1 / second**2, allowed.angular_acceleration / 2),
            ("joint_reaction", mass * length / second**2, allowed.joint_reaction),
        ):
            assert np.all(norms_per_body(getattr(there, name) / unit - getattr(here, name)) <= 2 * bound), (
                name
            )


@pytest.mark.parametrize("scale", [1.0, 1e6, 1e-6])
def test_a_collapsed_rod_is_one_of_its_own_rounding(scale):
    model, state = random_chain(24, [False, False, True])
    model, state = in_other_units(model, state, scale, 1.0, 1.0)
    r, *rest = maximal_coordinates(state)
    r[2] -= state.u[2] * model.length[2]
    with pytest.raises(SingularSystem, match="rod above body 3 has length 0"):
        StructuredSystem([model]).solve(r, *rest)


def test_a_rod_short_beside_another_chain_s_is_no_collapsed_one():
    rng = np.random.default_rng(24)
    small, large = (in_other_units(*random_chain(rng, [True]), scale, 1.0, 1.0) for scale in (1e-6, 1e12))
    models, states = zip(small, large, strict=True)
    both = StructuredSystem(models).solve(*maximal_coordinates(*states))
    model, at = small
    alone = StructuredSystem([model]).solve(*maximal_coordinates(at))
    np.testing.assert_allclose(both.acceleration[:1], alone.acceleration, rtol=64 * EPS, atol=0)


def test_a_collapsed_rod_on_a_body_that_is_not_turned_is_named_too():
    model, state = random_chain(24, [True])
    at = complete_state(model, State(np.array([[1.0, 0, 0, 0]]), state.omega, state.u, state.udot))
    r, *rest = maximal_coordinates(at)
    with pytest.raises(SingularSystem, match="rod above body 1 has length 0"):
        StructuredSystem([model]).solve(r - at.u * model.length, *rest)


def test_losses_to_rounding_or_overflow_are_reported():
    """Bodies of 1 and 1e20 kg hold each other by rows that double precision cannot tell apart."""
    model, state = random_chain(24, [False] * 3)
    heavy = np.array([1.0, 1e20, 1.0])
    uneven = model.changed(mass=heavy * model.mass, inertia=heavy[:, None, None] * model.inertia)
    with pytest.raises(SingularSystem, match="joint rows are not independent"):
        StructuredSystem([uneven]).solve(*maximal_coordinates(state))
    forest, (q, v) = StructuredSystem([model]), components(*maximal_coordinates(state))
    v[5, 1] = np.inf
    with pytest.raises(SingularSystem, match="a rate or a load is not finite"), np.errstate(all="ignore"):
        forest.acceleration(q, v)


def test_the_copies_of_a_tiled_forest_have_names_too():
    model, state = random_chain(29, [False, False, False])
    forest = StructuredSystem([model]).repeated(2)
    q, v = (np.tile(x, 2) for x in components(*maximal_coordinates(state)))
    q[3:, 4] = 0.0
    with pytest.raises(SingularSystem, match="p of body 2"):
        forest.acceleration(q, v)
    assert forest.first_body.tolist() == [0, 3, 6]


def test_a_body_without_thickness_is_named_beside_a_tiny_one():
    """A needle has no inertia about its axis; a body of 1e-20 kg m² has, however small."""
    model, _ = random_chain(30, [False, False])
    needle = model.changed(inertia=np.stack([1e-20 * np.eye(3), np.diag([1.0, 1.0, 0.0])]))
    with pytest.raises(SingularSystem, match="inertia of body 2 is singular"):
        StructuredSystem([needle])


@for_each_mix
@pytest.mark.parametrize("alone", ["drag_force", "drag_moment"])
def test_one_kind_of_drag_alone_counts(mix, alone):
    rng = np.random.default_rng(31)
    model, state = random_chain(rng, JOINT_MIXES[mix](rng, 3), drag=True)
    other = {"drag_force": "drag_moment", "drag_moment": "drag_force"}[alone]
    model = model.changed(**{other: np.zeros(3)})
    at, allowed = maximal_coordinates(state), state_rounding_bound(model, state)
    ours, direct = (form.solve(*at) for form in (StructuredSystem([model]), DirectSystem(model)))
    assert np.all(norms_per_body(ours.acceleration - direct.acceleration) <= allowed.acceleration)
    assert np.all(norms_per_body(ours.pddot - direct.pddot) <= allowed.angular_acceleration / 2)


@for_each_mix
def test_the_rate_of_a_gap_is_its_derivative_off_the_manifold_too(mix):
    """Where pᵀṗ is not 0 the matrix A of the notes stretches, and d with it."""
    rng, h = np.random.default_rng(32), 1e-6
    model, state = random_chain(rng, JOINT_MIXES[mix](rng, 4))
    forest = StructuredSystem([model])
    q, v = component_first(state.r, 1.1 * state.p), rng.normal(size=(7, 4))
    ends = [forest.joint_gaps(q + s * h * v, v)[0] for s in (1, -1)]
    # gaps of some metres, each a dozen roundings of 1e-16, over 2 h (the quadratic p(t) leaves h² some 1e-12)
    np.testing.assert_allclose(forest.joint_gaps(q, v)[1], (ends[0] - ends[1]) / (2 * h), rtol=0, atol=1e-8)
