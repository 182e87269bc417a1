"""The harness as a measuring instrument: every planted defect is reported, and named by its own term.

The list, its sizes and the words a diagnosis must use are in `planted`, committed before any diagnosis
was written; the defects here that must *not* be named came after it.
"""

import zlib
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.diagnosis.diagnose import diagnose
from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.measurements.refinement_study import run_refinement_study
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import motion_truth, state_truth
from tests.helpers import pendulums
from tests.helpers.nightly_tests import slow, some_fast
from tests.helpers.pendulums import JOINT_PATTERNS
from tests.helpers.planted_defects import (
    BODY_DEFECTS,
    CONTROLS,
    DEFECTS,
    INDISTINGUISHABLE,
    MOTION_DEFECTS,
    STATE_DEFECTS,
    Defect,
    WrongGammaSystem,
    answer_change,
    model_change,
    plant,
    with_coordinates,
)
from tests.helpers.shared_answers import sharing

for engine in ("mujoco", "pinocchio", "exudyn", "flint"):
    pytest.importorskip(engine)


@pytest.fixture(scope="module", autouse=True)
def shared_predictions():
    """Most hypotheses predict the same for every defect of a pendulum."""
    with sharing("plumbline.diagnosis.fit", "evaluate_case", "state_rounding_bound"):
        yield


STATES = 10
TIMES = np.linspace(0, 2, 17)


@cache
def subject(joints, loaded):
    """A generic pendulum, random states of it and their certified truth."""
    model = pendulums.make_model(JOINT_PATTERNS[joints], loads=loaded, drag=loaded)
    return model, state_truth(model, [*random_states(model, STATES, seed=1), *identity_states(model)])


def identity_states(model):
    """Two states with the identity attitude: of one body, and of all."""
    *_, first, second = random_states(model, 2, seed=3)
    identity = np.array([1.0, 0, 0, 0])
    odd = np.where(np.arange(model.n)[:, None] % 2, second.p, identity)
    return [
        with_coordinates(model, first, p=odd),
        with_coordinates(model, second, p=np.tile(identity, (model.n, 1))),
    ]


@cache
def motion(loaded=False):
    """A slow tumble whose every mistake shows within two seconds."""
    model = pendulums.make_model(JOINT_PATTERNS["balls"], loads=loaded, drag=loaded)
    state = pendulums.state_from_seed(model, seed=2, rate=0.5)
    return model, state, motion_truth(model, state, TIMES, None)


@contextmanager
def planted(defect, model):
    """The real engine with the defect in it."""
    engine = plant(type(load_adapter(defect.engine)), defect)
    if defect.gamma is None:
        with defect.engine_patch() if defect.engine_patch else nullcontext():
            yield engine
        return
    system = type("BentHere", (WrongGammaSystem,), {"model": model, "defect": staticmethod(defect.gamma)})
    with patch("adapters.reference_engine.DirectSystem", system):
        yield engine


@cache
def evaluated(defect):
    """What the engine with the defect returns, and the quantities that disagree at state level."""
    model, truth = subject(defect.joints, defect.loaded)
    with planted(defect, model) as engine:
        reported = engine.evaluate(model, truth.states)
    context = RowContext("planted", "planted", defect.name, defect.name, "0")
    rows = judge_states(context, truth, Evaluation(reported, None, None, 0.0)).rows
    return reported, [row.quantity for row in rows if row.verdict == "disagrees"]


@cache
def state_report(defect):
    """Quantities that disagree at state level, and the diagnosis."""
    model, truth = subject(defect.joints, defect.loaded)
    reported, wrong = evaluated(defect)
    with planted(defect, model) as engine:
        return wrong, diagnose(model, reported, truth, engine.evaluate) if wrong else ""


@cache
def motion_report(defect):
    """Rows about motion that do not agree; an unresolved cell that no file excuses fails a run, too."""
    model, state, truth = motion(defect.loaded)
    with (
        planted(defect, model) as engine,
        patch("plumbline.engines.engine_calls.load_adapter", lambda _: engine),
    ):
        integrator = engine.integrator(defect.integrator)
        steps = refinement_resolutions(integrator, model.n, float(TIMES[-1]))
        runs = run_refinement_study(defect.engine, integrator.name, model, state, TIMES, steps)
    context = RowContext("planted", "planted", defect.name, defect.name, "0")
    rows = judge_trajectory(context, model, truth, integrator, runs).rows
    return [f"{row.verdict}: {row.quantity}: {row.reason}" for row in rows if row.verdict.needs_attention]


def ids(defects):
    return {"argvalues": defects, "ids": [d.name for d in defects]}


def test_the_list_is_long_enough_and_each_defect_has_its_own_name():
    assert len(DEFECTS) >= 134 and len(CONTROLS) >= 20 and len({d.name for d in DEFECTS}) == len(DEFECTS)
    assert sum(bool(d.expected) for d in DEFECTS) >= 100


@pytest.mark.parametrize("defect", **ids(STATE_DEFECTS))
def test_every_state_defect_is_reported(defect):
    assert evaluated(defect)[1], f"nothing reports {defect.description}"


@pytest.mark.parametrize("defect", some_fast([d for d in STATE_DEFECTS if d.expected], 4))
def test_every_state_defect_is_named(defect):
    text = state_report(defect)[1]
    assert any(words in text for words in defect.expected), f"{defect.description}: {text!r}"


@pytest.mark.parametrize("defect", **ids(MOTION_DEFECTS))
def test_every_motion_defect_is_reported(defect):
    assert motion_report(defect), f"nothing reports {defect.description}"


def test_the_same_engine_without_defect_is_not_reported():
    clean = Defect("clean", "nothing")
    assert not motion_report(clean), motion_report(clean)
    for joints, loaded in {(d.joints, d.loaded) for d in STATE_DEFECTS}:
        for engine in ("mujoco", "pinocchio", "exudyn", "reference"):
            wrong, text = state_report(replace(clean, joints=joints, loaded=loaded, engine=engine))
            assert not wrong, f"{engine} on {joints}: {wrong}, {text}"


@pytest.mark.parametrize("defect", **ids(CONTROLS))
def test_an_equivalent_implementation_is_not_accused(defect):
    wrong, text = state_report(defect)
    assert not wrong, text


@pytest.mark.parametrize("name", ["frames-turned", "world-permuted"])
def test_answers_that_stay_in_other_axes_are_reported(name):
    control = next(control for control in CONTROLS if control.name == name)
    wrong, text = state_report(replace(control, name=f"{name}-for-good", answers=None))
    assert wrong and text


@pytest.mark.parametrize(("defect", "both"), INDISTINGUISHABLE, ids=[d.name for d, _ in INDISTINGUISHABLE])
def test_causes_with_the_same_effect_are_named_together(defect, both):
    wrong, text = state_report(defect)
    assert bool(wrong) == bool(both)
    assert all(words in text for words in both) and ("cannot distinguish" in text) == bool(both), text


def test_scaled_mass_and_inertia_are_invisible_to_accelerations_alone():
    defect = next(d for d in STATE_DEFECTS if d.name == "mass-and-inertia-together")
    wrong, _ = state_report(defect)
    assert "joint_reaction" in wrong and not {"acceleration", "angular_acceleration"} & set(wrong)


def noisy(_, state, a):
    rng = np.random.default_rng(zlib.crc32(state.p.tobytes()))
    return a * (1 + 1e-9 * rng.normal(size=a.shape))


UNNAMEABLE = (
    Defect("noise", "r̈ × (1 + 1e-9 noise)", answers=answer_change("acceleration", noisy)),
    Defect("cubed", "ω̇′ + 1e-6 ω̇′³", engine="pinocchio",
           answers=answer_change("angular_acceleration", lambda _, __, a: a + 1e-6 * a**3)),
    Defect("two-at-once", "mass of body 1 and inertia xx of body 2 × (1 + 1e-4)",
           inputs=model_change(lambda m, _: {
               "mass": m.mass * [1 + 1e-4, 1], "inertia": m.inertia * [[[1]], [[1 + 1e-4]]]})),
    Defect("friction", "Coulomb friction of 1e-3 N m on every body", engine="exudyn",
           inputs=model_change(lambda m, s: {"moment": m.moment - 1e-3 * np.sign(s.omega)})),
)  # fmt: skip


@pytest.mark.parametrize("defect", **ids(UNNAMEABLE))
def test_a_difference_without_single_cause_is_not_named(defect):
    wrong, text = state_report(defect)
    assert wrong and text.startswith("no single change"), text


def test_a_difference_next_to_the_bound_is_not_named():
    model, truth = subject("balls", False)
    reported = list(truth.quantities)
    shift = 1.8 * truth.bounds[3].acceleration[:, None] * np.array([[0.6, -0.48, 0.64]])
    reported[3] = replace(reported[3], acceleration=reported[3].acceleration + shift)
    assert diagnose(model, reported, truth).startswith("the difference is too close to the rounding bound")


def test_the_diagnosis_states_where_the_difference_persists():
    names = ("gyroscopic-dropped", "gravity-1e-5", "loads-ignored")
    at = {d.name: state_report(d)[1] for d in STATE_DEFECTS if d.name in names}
    assert "vanishes at rest, persists without gravity" in at["gyroscopic-dropped"]
    assert "persists at rest, vanishes without gravity" in at["gravity-1e-5"]
    assert "vanishes without loads and drag" in at["loads-ignored"]


WITHOUT_NAME = "no single change of a parameter, term or convention explains the "
BRANCHES = [
    d for d in STATE_DEFECTS if d.name.startswith(("identity-", "fast-", "rod-upward", "stale-rates"))
]


@pytest.mark.parametrize("defect", **ids(BRANCHES))
def test_a_defect_in_a_rare_branch_gets_no_wrong_name(defect):
    assert WITHOUT_NAME in state_report(defect)[1]


@slow
@pytest.mark.timeout(900)
def test_rates(record_property, capsys):
    """Kill rate, naming rate and false namings, as the nightly report gives them."""
    killed = [d for d in DEFECTS if (motion_report(d) if d.level == "motion" else state_report(d)[0])]
    nameable = [d for d in DEFECTS if d.expected]
    named = [d for d in nameable if any(words in state_report(d)[1] for words in d.expected)]
    reported = [d for d in (*STATE_DEFECTS, *UNNAMEABLE) if "behaves as if" in state_report(d)[1]]
    reported += [d for d in UNNAMEABLE if not state_report(d)[1].startswith("no single change")]
    false = [d.name for d in reported if (d.expected and d not in named) or d in UNNAMEABLE]
    false += [d.name for d in BRANCHES if WITHOUT_NAME not in state_report(d)[1]]
    figures = {
        "planted": len(DEFECTS),
        "reported": len(killed),
        "of them as unresolved": sum(
            all(words.startswith("unresolved") for words in motion_report(d)) for d in MOTION_DEFECTS
        ),
        "nameable": len(nameable),
        "named": len(named),
        "false namings": len(false),
        "controls": len(CONTROLS),
        "controls accused": sum(bool(state_report(d)[0]) for d in CONTROLS),
    }
    for name, number in figures.items():
        record_property(name, number)
    with capsys.disabled():
        print(f"\nplanted defects: {figures}")
    assert len(killed) == len(DEFECTS) and named == nameable and not false, (figures, false)
    assert not figures["controls accused"]


def applicable(defect, joints):
    """Whether the pendulum has what the defect alters: a second joint that is a rod, a rod at all."""
    if defect.name == "rod-length-1e-5":
        return joints[1] == "r"
    return "r" in joints or not defect.name.startswith("rod")


@pytest.mark.full
@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "exudyn", "reference"])
@pytest.mark.parametrize("joints", ["balls", "rods", "rod-ball", "mixed"])
def test_defects_are_named_on_every_engine_and_joint(engine, joints):
    """The long form: every defect of numbers, conventions and answers, wherever it makes a difference."""
    missed = {}
    for defect in STATE_DEFECTS:
        if defect.gamma or defect.engine_patch or not defect.expected:
            continue
        if defect in BODY_DEFECTS:
            if joints != defect.joints:  # its body, joint or load is one of its own pendulum
                continue
        elif not applicable(defect, JOINT_PATTERNS[joints]):
            continue
        moved = replace(defect, engine=engine, joints=joints)
        wrong, text = state_report(moved)
        if not wrong or not any(words in text for words in defect.expected):
            missed[defect.name] = text
    assert not missed
