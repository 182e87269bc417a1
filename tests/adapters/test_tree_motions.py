"""Every integrator of every engine on trees: the samples are in the project's frames and converge."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Unsupported
from plumbline.model.invariants import attitude_error, compute_invariants, position_error
from plumbline.model.kinematics import complete_state
from plumbline.model.random_mechanisms import random_tree
from plumbline.model.sampling import random_states
from plumbline.truth.notes_motion import simulate_notes_form

TIMES = np.arange(5) / 32
ORDER_MARGIN = 0.3  # orders are 1, 2 or 4; the next term of the error moves the slope less
ENGINES = ["reference", "mujoco", "pinocchio", "exudyn", "exudyn-tree"]
MIXES = {
    "jointed": ("hinge", "universal", "slide", "cylindrical", "weld"),
    "all": ("rod", "ball", "hinge", "universal", "slide", "cylindrical", "weld", "free"),
}


def calm_state(model, seed):
    """A random state whose fastest rate is 2, so that errors are small at the steps of the test."""
    (state,) = random_states(model, 1, seed)
    rates = {name: getattr(state, name) for name in ("omega", "udot", "v", "xdot")}
    fastest = max(np.max(np.abs(rate)) for rate in rates.values())
    return complete_state(model, replace(state, **{k: 2 / fastest * x for k, x in rates.items()}))


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("engine", ENGINES)
def test_motions_of_random_trees_converge_to_the_truth(engine, mix):
    adapter, compared = load_adapter(engine), 0
    for seed in (3, 5):
        model = random_tree(np.random.default_rng(seed), 6, MIXES[mix])
        state = calm_state(model, seed)
        true = simulate_notes_form(model, state, TIMES, 1e-12)
        for method in adapter.integrators:
            resolutions = (2.0**-9, 2.0**-10) if method.kind == "step" else (1e-8, 1e-11)
            try:
                runs = [adapter.simulate(model, state, TIMES, method.name, h) for h in resolutions]
            except Unsupported as reason:  # angles near their singularity
                assert engine == "exudyn-tree" and "singularity" in str(reason)
                continue
            compared += 1
            errors = [position_error(x.r, true.r)[-1] + attitude_error(x.p, true.p)[-1] for x in runs]
            if method.kind == "step":
                assert np.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=ORDER_MARGIN), (
                    method.name
                )
            assert errors[1] < (1e-9 if method.kind == "tolerance" else 2e-7 if method.order == 4 else 5e-2)
            found = compute_invariants(model, runs[1])
            assert np.max(np.abs(found.joint_gap)) < 1e-4, method.name
            assert np.max(np.abs(found.gap_rate)) < 1e-2, method.name
            assert np.all(np.sum(runs[1].p[1:] * runs[1].p[:-1], axis=-1) > 0)
            np.testing.assert_allclose(runs[1].v[0], state.v, atol=1e-12)  # the initial state, only converted
    assert compared


ELEMENTS = ("armature", "damping", "stiffness", "effort", "springs")


@pytest.mark.parametrize("kinds", [("hinge", "slide", "universal", "cylindrical", "rod"), ("ball", "hinge")])
@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("engine", ENGINES)
def test_motions_with_elements_converge_to_the_truth_and_conserve_energy(engine, element, kinds):
    adapter = load_adapter(engine)
    model = random_tree(np.random.default_rng(3), 4, kinds, loads=False, elements=(element,))
    state, times = calm_state(model, 3), np.arange(17) / 128
    true = simulate_notes_form(model, state, times, 1e-12)
    for method in adapter.integrators:
        resolutions = (2.0**-9, 2.0**-10) if method.kind == "step" else (1e-8, 1e-11)
        try:
            runs = [adapter.simulate(model, state, times, method.name, h) for h in resolutions]
        except Unsupported as reason:
            assert engine.startswith("exudyn") and any(x in str(reason) for x in ("rotor", "rotation vector"))
            continue
        errors = [position_error(x.r, true.r)[-1] + attitude_error(x.p, true.p)[-1] for x in runs]
        if method.kind == "step" and errors[1] > 1e-12:
            assert np.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=ORDER_MARGIN), (
                method.name
            )
        assert errors[1] < (1e-8 if method.kind == "tolerance" or method.order == 4 else 5e-2)
        found = [compute_invariants(model, run) for run in runs]
        drift = [np.max(np.abs(x.energy_drift)) for x in found]
        assert drift[1] < 0.6 * drift[0] or drift[1] < 1e-6 + found[1].work_uncertainty, (method.name, drift)


def test_an_engine_that_builds_no_trees_refuses_motions():
    model = random_tree(np.random.default_rng(0), 3, ("hinge",))
    (state,) = random_states(model, 1, 0)
    with pytest.raises(Unsupported, match="chains of rods and balls"):
        load_adapter("reference-printed").simulate(model, state, np.array([0.0, 0.25]), "dop853", 1e-9)
