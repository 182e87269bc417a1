"""The diagnosis of steps: planted integrators are named, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plumbline.diagnosis.cause import describe
from plumbline.diagnosis.integrator_search import UNEXPLAINED, explain_steps
from plumbline.engines.registry import load_adapter
from plumbline.model.kinematics import angular_velocity, quaternion_rate, rotation_matrix
from tests.helpers.nightly_tests import some_fast
from tests.helpers.planted_steps import STEP_DEFECTS
from tests.helpers.planting import planted
from tests.helpers.requirements import require_engines, require_extended_precision
from tests.helpers.shared_answers import sharing
from tests.judging.test_step_level import loop_subject, methods, stepped, subject

require_engines()
require_extended_precision()


@pytest.fixture(scope="module", autouse=True)
def shared_steps():
    """Other formulas take the same steps for every defect of a pendulum."""
    with sharing("plumbline.truth.step_comparison", "joint_space_steps"):
        yield


def explanation(adapter, integrator, joints="balls", loaded=False, change=lambda model: model):
    """Diagnosis of an adapter's steps on a model; the engine may see another one."""
    model, states = subject(joints, loaded, loaded)
    answer = stepped(adapter, integrator, change(model), states)
    return describe(explain_steps(model, states, integrator.method, answer))


@pytest.mark.parametrize("defect", some_fast(STEP_DEFECTS, 9))
def test_a_planted_integrator_is_named(defect):
    integrator = load_adapter(defect.engine).integrator(defect.integrator)
    with planted(defect) as adapter:
        text = explanation(adapter, integrator, defect.mechanism, defect.loaded)
    assert defect.expected and defect.expected in text, text
    assert "cannot distinguish" not in text, text


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "exudyn", "exudyn-tree"])
@pytest.mark.parametrize("joints", ["balls", "rods"])
def test_no_integrator_is_named_where_none_is_wrong(engine, joints):
    """The declared step; that with another number, which is named but for iterative engines."""
    adapter = load_adapter(engine)
    for integrator in methods(engine):
        assert "too close to the rounding bound" in explanation(adapter, integrator, joints)

        def heavier(model):
            return replace(model, gravity=model.gravity * (1 + 1e-5))

        text = explanation(adapter, integrator, joints, change=heavier)
        named = "behaves as if the size of gravity were 1.00001 times as large"
        assert text.startswith(named) or (engine == "exudyn" and "behaves as if" not in text), text


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio"])
def test_a_wrong_axial_inertia_of_rods_is_named(engine):
    adapter = load_adapter(engine)
    integrator = adapter.integrators[0]
    right = integrator.method.rod_axial_inertia
    wrong = replace(integrator, method=replace(integrator.method, rod_axial_inertia=2 * right))
    text = explanation(adapter, wrong, "mixed")
    assert f"axial inertia of rods were {right:.3g}"[:36] in text and "behaves as if" in text, text


def _turned_rates(answer, other):
    """The steps of an engine whose samples hold other velocities."""
    attempts = []
    for attempt in answer.attempts:
        motion = attempt.run.trajectory
        omega, turn = angular_velocity(motion.p, motion.pdot), rotation_matrix(motion.p)
        v, omega = other(turn, motion.v, omega)
        motion = replace(motion, v=v, pdot=quaternion_rate(motion.p, omega))
        attempts.append(replace(attempt, run=replace(attempt.run, trajectory=motion)))
    return replace(answer, attempts=attempts)


@pytest.mark.parametrize("words", ["in the body frame", "joints' points", "in the world frame"])
def test_samples_with_other_velocities_are_named(words):
    model, states = subject("balls")
    other = {
        "in the body frame": lambda a, v, w: (np.matvec(a.mT, v), w),
        "joints' points": lambda a, v, w: (v + np.matvec(a, np.cross(w, model.proximal)), w),
        "in the world frame": lambda a, v, w: (v, np.matvec(a, w)),
    }[words]
    adapter = load_adapter("pinocchio")
    integrator = methods("pinocchio")[0]
    answer = _turned_rates(stepped(adapter, integrator, model, states), other)
    (cause,) = explain_steps(model, states, integrator.method, answer)
    assert cause.kind == "frame" and cause.change.endswith(words) and not cause.equal, cause


def test_noise_is_not_named():
    model, states = subject("balls")
    integrator = load_adapter("mujoco").integrator("Euler")
    answer = stepped(load_adapter("mujoco"), integrator, model, states)
    rng = np.random.default_rng(1)
    for attempt in answer.attempts:
        attempt.run.trajectory.v[...] *= 1 + 1e-9 * rng.normal(size=attempt.run.trajectory.v.shape)
    assert explain_steps(model, states, integrator.method, answer) == (UNEXPLAINED,)


LOOP_STEPS = [
    d
    for d in STEP_DEFECTS
    if d.engine == "pinocchio"
    and d.name.startswith(("exchanged-halves", "stale-velocity", "mean-velocity", "verlet", "two-half"))
    and d.integrator == "semi-implicit-euler"
]


@pytest.mark.parametrize("defect", some_fast(LOOP_STEPS, 6))
def test_a_planted_integrator_is_named_on_a_loop(defect):
    """A mechanism with loops has more joints than bodies."""
    model, states = loop_subject("four-bar")
    integrator = load_adapter(defect.engine).integrator(defect.integrator)
    with planted(defect) as adapter:
        answer = stepped(adapter, integrator, model, states)
    assert defect.expected in describe(explain_steps(model, states, integrator.method, answer))


def test_samples_with_other_velocities_are_named_on_a_loop():
    model, states = loop_subject("four-bar")
    integrator = methods("pinocchio")[0]
    near = model.proximal[: model.n]
    answer = _turned_rates(
        stepped(load_adapter("pinocchio"), integrator, model, states),
        lambda a, v, w: (v + np.matvec(a, np.cross(w, near)), w),
    )
    (cause,) = explain_steps(model, states, integrator.method, answer)
    assert cause.change == "those of the joints' points"
