"""Loops, elements and runs of the reference: its direct form and what surrounds it."""

import numpy as np
import pytest

from plumbline.model.kinematics import maximal_coordinates
from plumbline.model.sampling import random_states
from reference_impl.direct import DirectSystem
from reference_impl.elements import Elements
from reference_impl.euler_parameters import L
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import eliminated_system
from reference_impl.integrate import (
    direct_acceleration,
    integrate_dop853,
    notes_acceleration,
    state_scales,
)
from reference_impl.mechanism import JOINT_ELEMENTS, SPRING_FIELDS, Mechanism
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.random_chains import tree_from_seed

LOOPS = ("four-bar", "slider-crank", "bricard")  # the last is overconstrained: one row depends on the others


def loop_state(name):
    s = catalogue_scenario(name)
    return s.model, maximal_coordinates(s.state)


@pytest.mark.parametrize("name", LOOPS)
def test_the_rows_that_are_kept_have_the_rank_of_all(name):
    model, parts = loop_state(name)
    system = DirectSystem(model)
    S, kept = system.assemble(*parts)[0], system.solve(*parts).kept
    rows = S[7 * model.n :]
    rank = np.linalg.matrix_rank(rows[:, : 7 * model.n], tol=1e-9)
    constraints = np.r_[kept, np.ones(model.n, bool)]  # pᵀp = 1 of each body is kept always
    assert np.sum(constraints) == rank
    assert np.linalg.matrix_rank(rows[constraints][:, : 7 * model.n], tol=1e-9) == rank


@pytest.mark.parametrize("name", LOOPS)
def test_a_run_solves_for_the_same_accelerations_and_a_defect_of_gamma_reaches_its_rows(name):
    """S x = b + δ in the rows that are kept, δ another number in each; those of a run may be other rows."""
    model, parts = loop_state(name)
    system, n = DirectSystem(model), model.n
    one, (unknowns, *_) = system.solve(*parts), system.solve_unknowns(*parts)
    np.testing.assert_allclose(unknowns[: 3 * n].reshape(n, 3), one.acceleration, rtol=1e-11, atol=1e-11)
    S, b = system.assemble(*parts)
    defect = np.where(one.kept, np.linspace(0.5, 1.5, len(one.kept)), 0.0)
    off = system.solve(*parts, gamma_defect=defect)
    motion = np.concatenate([off.acceleration.ravel(), off.pddot.ravel()])
    lack = (S[7 * n :, : 7 * n] @ motion - b[7 * n :])[: len(defect)]
    np.testing.assert_allclose(lack[one.kept], defect[one.kept], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", LOOPS)
def test_a_run_chooses_as_many_rows_again_where_its_own_come_near_to_dependence(name):
    """As if its first rows had been ten times as independent as they are."""
    model, parts = loop_state(name)
    system = DirectSystem(model)
    (before, *_), count = system.solve_unknowns(*parts), len(system._run_rows)
    system._run_independence *= 20
    (after, *_) = system.solve_unknowns(*parts)
    assert len(system._run_rows) == count
    np.testing.assert_allclose(after[: 7 * model.n], before[: 7 * model.n], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["four-bar", "double-loaded-balls"])
def test_a_mechanism_is_made_again_of_its_fields(name):
    model = catalogue_scenario(name).model
    again = Mechanism.from_fields({key: np.asarray(x).tolist() for key, x in model.fields.items()})
    assert vars(again).keys() == vars(model).keys()
    for key, value in vars(model).items():
        assert np.array_equal(getattr(again, key), value), key
    assert again.body.dtype == model.body.dtype


def test_whole_numbers_of_fields_are_read_as_decimals():
    chain = Mechanism.chain(
        gravity=np.array([0, 0, -9.81]),
        mass=np.ones(1),
        inertia=np.eye(3)[None],
        proximal=np.array([[0.0, 0.0, 0.5]]),
        distal=np.zeros((1, 3)),
        length=np.zeros(1),
        force=np.zeros((1, 3)),
        moment=np.zeros((1, 3)),
        drag_force=np.zeros(1),
        drag_moment=np.zeros(1),
    )
    fields = chain.fields | {"mass": [2], "length": [1]}
    again = Mechanism.from_fields(fields)
    assert again.mass.dtype == again.length.dtype == float


def test_fields_that_a_mechanism_lacks_are_left_out():
    bare = tree_from_seed(1, 3, ("hinge", "slide"), loads=False)
    assert not {*JOINT_ELEMENTS, *SPRING_FIELDS} & bare.fields.keys()
    assert {"spring_body", "spring_point", "spring_stiffness", "spring_damping", "spring_length"} == {
        *SPRING_FIELDS
    }
    assert not bare.has_loads
    assert bare.changed(moment=np.ones((3, 3))).has_loads
    assert bare.changed(force=np.ones((3, 3))).has_loads


def test_without_dampers_nothing_is_lost():
    """Of the elements, only dampers dissipate, and only springs store energy."""
    for elements in (("stiffness",), ("damping",)):
        model = tree_from_seed(4, 3, ("hinge", "slide"), elements=elements)
        (state,) = random_states(model, 1, 5)
        parts = maximal_coordinates(state)
        own = Elements(model)
        found, rate = own.evaluate(*parts), own.coordinates(*parts)[1]
        assert found.dissipation == pytest.approx(np.sum(model.damping * rate**2), rel=1e-14)
        assert (found.dissipation > 0) == (elements == ("damping",))
        assert (found.potential > 0) == (elements == ("stiffness",))


def test_angles_go_on_beyond_half_a_turn():
    """A coordinate is taken near the given one, not as its principal value."""
    model = tree_from_seed(2, 3, ("hinge", "cylindrical"), elements=("stiffness",))
    elements, (state,) = Elements(model), random_states(model, 1, 5)
    assert elements.has_winding_angles
    parts = maximal_coordinates(state)
    principal, rate = elements.coordinates(*parts)
    turns = np.zeros_like(principal)
    turns[elements.joint[~elements.is_slide], elements.column[~elements.is_slide]] = 3.0
    found, same = elements.coordinates(*parts, x=principal + 2 * np.pi * turns + 0.4)
    np.testing.assert_allclose(found, principal + 2 * np.pi * turns, rtol=1e-15)
    assert np.array_equal(same, rate)
    assert np.any(turns)


def test_a_spring_that_is_wound_up_pulls_by_all_its_turns():
    """A hinge alone, I φ̈ = −k φ: the pendulum is turned by 1.3 turns and let go, by both integrators."""
    model = tree_from_seed(2, 1, ("hinge",), loads=False, elements=("stiffness",))
    model = model.changed(gravity=np.zeros(3), rest=np.zeros((1, 2)))
    (state,) = random_states(model, 1, 5)
    parts = state.r, state.p, 0 * state.v, np.zeros((1, 4))
    elements, times = Elements(model), np.linspace(0.0, 1.0, 9)
    x = elements.coordinates(*parts)[0] + 2 * np.pi * np.array([[1.0, 0.0]])
    runs = [
        integrate_dop853(model, *parts, times, 1e-12, x=x),
        integrate_collocation(eliminated_system([model], x), *parts, times, 1e-12),
    ]
    (w,) = 2 * np.matvec(L(parts[1]), DirectSystem(model).solve(*parts, x=x).pddot)
    rate = np.sqrt(np.linalg.norm(w) / abs(x[0, 0]))  # k / I of the hinge = rate²
    angle = x[0, 0] * np.cos(rate * times)
    for run in runs:
        for k, expected in enumerate(angle):
            sample = run.r[k], run.p[k], run.v[k], run.pdot[k]
            found = elements.coordinates(*sample, x=np.array([[expected, 0.0]]))[0]
            assert found[0, 0] == pytest.approx(expected, abs=1e-8)


def test_loads_alone_move_a_body_from_rest():
    """No gravity, no rate: the sizes that absolute tolerances need are those that the load reaches."""
    model = tree_from_seed(2, 1, ("slide",), loads=False)
    model = model.changed(gravity=np.zeros(3), force=np.array([[0.3, -0.2, 0.5]]))
    (state,) = random_states(model, 1, 5)
    parts = state.r, state.p, 0 * state.v, np.zeros((1, 4))
    times = np.array([0.0, 0.5, 2.0])
    run, a = integrate_dop853(model, *parts, times, 1e-11), DirectSystem(model).solve(*parts).acceleration
    np.testing.assert_allclose(run.r, state.r + 0.5 * times[:, None, None] ** 2 * a, rtol=1e-9, atol=1e-10)


def test_sizes_of_a_motion_are_those_of_the_stretched_mechanism():
    """Points on both sides count, the world's too; rates are those of a fall through the whole length."""
    model = tree_from_seed(6, 3, ("hinge",), loads=False)
    model = model.changed(gravity=np.array([0.0, 0.0, -9.0]))
    r, p, still, rates = np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1)), np.zeros((3, 3)), np.zeros((3, 4))
    span = np.sum(np.linalg.norm(model.point, axis=2))
    sizes = state_scales(model, r, p, still, rates)
    fall = np.sqrt(9.0 * span)
    np.testing.assert_allclose(sizes[[0, 9, 21, 30]], [span, 1.0, fall, fall / span / 2], rtol=1e-14)


def test_the_printed_equations_as_a_right_hand_side():
    s = catalogue_scenario("double-tumbling-rods")
    parts = maximal_coordinates(s.state)
    printed, direct = notes_acceleration(s.model)(*parts), direct_acceleration(s.model)(*parts)
    np.testing.assert_allclose(printed, direct, rtol=1e-10, atol=1e-10)


def test_angles_of_balls_and_coordinates_of_slides_do_not_wind():
    for kind in ("ball", "slide"):
        model = tree_from_seed(2, 2, (kind,), elements=("stiffness",))
        assert np.any(model.stiffness)
        assert not Elements(model).has_winding_angles
