"""The direct form of mechanisms with loops: rows that are kept, planted defects of γ, corrected solutions."""

import numpy as np
import pytest

from plumbline.model.kinematics import quaternion_rate
from plumbline.model.random_mechanisms import random_tree
from plumbline.model.sampling import random_states
from plumbline.scenario.loader import find_scenario_file, load_scenario
from reference_impl.direct import DirectSystem, solve_dense
from reference_impl.elements import Elements
from reference_impl.mechanism import Mechanism

LOOPS = ("four-bar", "slider-crank", "bricard")  # the last is overconstrained: one row depends on the others


def loop_state(name):
    s = load_scenario(find_scenario_file(name))
    return s.model, (s.state.r, s.state.p, s.state.v, quaternion_rate(s.state.p, s.state.omega))


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


def test_a_correction_ends_at_the_solution():
    """With S₀ = S one correction takes any unknowns there; of a loop whose rows are independent."""
    model, parts = loop_state("slider-crank")
    system = DirectSystem(model)
    S, kept = system.assemble(*parts)[0], system.solve(*parts).kept
    used = np.r_[np.ones(7 * model.n, bool), kept, np.ones(model.n, bool)]
    expected, (unknowns, *_) = system.solve(*parts), system.solve_unknowns(*parts)

    def correction(lack):
        found = np.zeros(len(lack))
        found[used] = solve_dense(S[np.ix_(used, used)], lack[used])
        return found

    off = np.where(used, unknowns + 1.0, 0.0)
    found, elements = system.corrected(*parts, None, off, correction)
    assert elements is None
    for name in ("acceleration", "pddot", "joint_moment"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["four-bar", "double-loaded-balls"])
def test_a_mechanism_is_made_again_of_its_fields(name):
    model = load_scenario(find_scenario_file(name)).model
    again = Mechanism.from_fields({key: np.asarray(x).tolist() for key, x in model.fields.items()})
    assert vars(again).keys() == vars(model).keys()
    for key, value in vars(model).items():
        assert np.array_equal(getattr(again, key), value), key
    assert again.body.dtype == model.body.dtype


def test_angles_go_on_beyond_half_a_turn():
    """A coordinate is taken near the given one, not as its principal value."""
    model = random_tree(np.random.default_rng(2), 3, ("hinge", "cylindrical"), elements=("stiffness",))
    elements, (state,) = Elements(model), random_states(model, 1, 5)
    assert elements.has_winding_angles
    parts = state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    principal, rate = elements.coordinates(*parts)
    turns = np.zeros_like(principal)
    turns[elements.joint[~elements.is_slide], elements.column[~elements.is_slide]] = 3.0
    found, same = elements.coordinates(*parts, principal + 2 * np.pi * turns + 0.4)
    np.testing.assert_allclose(found, principal + 2 * np.pi * turns, rtol=1e-15)
    assert np.array_equal(same, rate)
    assert np.any(turns)


def test_angles_of_balls_and_coordinates_of_slides_do_not_wind():
    for kind in ("ball", "slide"):
        model = random_tree(np.random.default_rng(2), 2, (kind,), elements=("stiffness",))
        assert np.any(model.stiffness)
        assert not Elements(model).has_winding_angles
