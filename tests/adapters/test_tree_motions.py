"""Every integrator of every engine on trees: the samples are in the project's frames and converge."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Unsupported
from plumbline.model.invariants import attitude_error, compute_invariants
from plumbline.model.kinematics import complete_state
from plumbline.model.sampling import random_states
from plumbline.truth.trajectory_truth import simulate_notes_form
from tests.helpers.nightly_tests import SLOW
from tests.helpers.random_chains import tree_from_seed
from tests.helpers.shared_answers import sharing
from tests.helpers.true_answers import converging_runs

TIMES = np.arange(5) / 32
ORDER_MARGIN = 0.3  # orders are 1, 2 or 4; the next term of the error moves the slope less
ENGINES = ["reference", "mujoco", "pinocchio", "exudyn", "exudyn-tree"]
MIXES = {
    "jointed": ("hinge", "universal", "slide", "cylindrical", "weld"),
    "planar": ("hinge", "planar"),
    "all": ("rod", "ball", "hinge", "universal", "slide", "cylindrical", "weld", "free"),
}


def methods(adapter):
    """Its integrators that make motions."""
    return [one for one in adapter.integrators if one.has_motions]


def calm_state(model, seed):
    """A random state whose fastest rate is 2, so that errors are small at the steps of the test."""
    (state,) = random_states(model, 1, seed)
    rates = {name: getattr(state, name) for name in ("omega", "udot", "v", "xdot")}
    fastest = max(np.max(np.abs(rate)) for rate in rates.values())
    return complete_state(model, replace(state, **{k: 2 / fastest * x for k, x in rates.items()}))


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """True motions are the same for every engine."""
    with sharing(__name__, "simulate_notes_form"):
        yield


@pytest.mark.parametrize("seed", [3, pytest.param(5, marks=SLOW)])
@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("engine", ENGINES)
def test_motions_of_random_trees_converge_to_the_truth(engine, mix, seed):
    adapter, compared = load_adapter(engine), 0
    model = tree_from_seed(seed, 6, MIXES[mix])
    state = calm_state(model, seed)
    true = simulate_notes_form(model, state, TIMES, 1e-12)
    for method in methods(adapter):
        resolutions = (2.0**-9, 2.0**-10) if method.kind == "step" else (1e-8, 1e-11)
        try:
            runs, errors = converging_runs(
                adapter, method, model, state, true, resolutions, ORDER_MARGIN, 1e-12
            )
        except Unsupported as reason:  # angles near their singularity
            assert engine == "exudyn-tree" and "singularity" in str(reason)
            continue
        compared += 1
        assert errors[1] < (1e-9 if method.kind == "tolerance" else 2e-7 if method.order == 4 else 5e-2)
        found = compute_invariants(model, runs[1])
        assert np.max(np.abs(found.joint_gap)) < 1e-4, method.name
        assert np.max(np.abs(found.gap_rate)) < 1e-2, method.name
        assert np.all(np.sum(runs[1].p[1:] * runs[1].p[:-1], axis=-1) > 0)
        np.testing.assert_allclose(runs[1].v[0], state.v, atol=1e-12)  # the initial state, only converted
    assert compared


ELEMENTS = ("armature", "damping", "stiffness", "effort", "springs")


@pytest.mark.parametrize(
    "kinds",
    [("hinge", "slide", "universal", "cylindrical", "rod"), pytest.param(("ball", "hinge"), marks=SLOW)],
)
@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("engine", ENGINES)
def test_motions_with_elements_converge_to_the_truth_and_conserve_energy(engine, element, kinds):
    adapter, compared = load_adapter(engine), 0
    model = tree_from_seed(3, 4, kinds, loads=False, elements=(element,))
    state, times = calm_state(model, 3), np.arange(17) / 128
    true = simulate_notes_form(model, state, times, 1e-12)
    for method in methods(adapter):
        coarse = 2.0**-12 if method.order == 1 else 2.0**-9  # dampers have transients of 1e-3 s
        resolutions = (coarse, coarse / 2) if method.kind == "step" else (1e-8, 1e-11)
        try:
            runs, errors = converging_runs(adapter, method, model, state, true, resolutions, ORDER_MARGIN)
        except Unsupported as reason:
            assert engine.startswith("exudyn") and any(x in str(reason) for x in ("rotor", "rotation vector"))
            continue
        compared += 1
        assert errors[1] < (1e-8 if method.kind == "tolerance" or method.order == 4 else 5e-2)
        found = [compute_invariants(model, run) for run in runs]
        drift = [np.max(np.abs(x.energy_drift)) for x in found]
        uncertainty = found[1].uncertainty["energy_drift"]
        assert drift[1] < 0.6 * drift[0] or drift[1] < 1e-6 + uncertainty, (method.name, drift)
    assert compared or engine.startswith("exudyn")  # which build no rotors, or no elements of balls


INERTIA, STIFFNESS, AMPLITUDE = 0.02, 0.7, 8.0  # kg m², N m/rad, rad


def torsional_oscillator():
    """Model, state, times and attitudes of φ = φ₀ + a cos √(k/I) t: beyond half a turn both ways."""
    rest, rate = 0.5, np.sqrt(STIFFNESS / INERTIA)
    model = replace(
        tree_from_seed(0, 1, ("hinge",), loads=False),
        inertia=INERTIA * np.eye(3)[None], point=np.zeros((1, 2, 3)), stiffness=np.array([[STIFFNESS, 0.0]]),
        rest=np.array([[rest, 0.0]]), turn=np.tile([1.0, 0, 0, 0], (1, 2, 1)),
    )  # fmt: skip
    x = np.array([[rest + AMPLITUDE, 0.0]])
    (state,) = random_states(model, 1, 0)
    state = complete_state(model, replace(state, x=x, xdot=0 * x))
    times = np.arange(33) / 16  # two periods, up to 2.9 rad from sample to sample
    angle = rest + AMPLITUDE * np.cos(rate * times)
    truth = np.zeros((len(times), 1, 4))
    truth[:, 0, 0], truth[:, 0, 3] = np.cos(angle / 2), np.sin(angle / 2)
    return model, state, times, truth


@pytest.mark.parametrize("engine", ENGINES)
def test_a_spring_on_an_angle_counts_full_turns(engine):
    model, state, times, truth = torsional_oscillator()
    adapter = load_adapter(engine)
    for method in methods(adapter):
        sizes = (2.0**-9, 2.0**-10) if method.kind == "step" else (1e-11,)
        runs = [adapter.simulate(model, state, times, method.name, size) for size in sizes]
        run, errors = runs[-1], [np.max(attitude_error(x.p, truth)) for x in runs]
        # a lost turn changes the spring's moment by 2π k, whatever the step: the error would not fall
        if method.kind == "step":
            assert np.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=ORDER_MARGIN), (
                method.name
            )
        else:
            assert errors[0] < 1e-7, method.name
        drift = compute_invariants(model, run).energy_drift
        allowed = 1e-6 if method.order > 2 else 0.05
        assert np.max(np.abs(drift)) < allowed * STIFFNESS * AMPLITUDE**2, method.name


def test_a_spring_on_an_angle_counts_full_turns_in_the_truth():
    model, state, times, truth = torsional_oscillator()
    notes = simulate_notes_form(model, state, times, 1e-12, "dop853")
    assert np.max(attitude_error(notes.p, truth)) < 1e-8
    assert np.max(attitude_error(simulate_notes_form(model, state, times, 1e-12).p, truth)) < 1e-10
