"""The harness as a measuring instrument: every planted defect is reported, and named by its own term.

The list, its sizes and the words a diagnosis must use are in `planted`, committed before any diagnosis
was written; the defects here that must *not* be named came after it.
"""

import zlib
from dataclasses import replace

import numpy as np
import pytest

from plumbline.diagnosis.diagnose import diagnose
from plumbline.judging.rows import Verdict
from tests.helpers.nightly_tests import fast_are, slow, some_fast
from tests.helpers.pendulums import JOINT_PATTERNS
from tests.helpers.planted_defects import (
    BODY_DEFECTS,
    CONTROLS,
    DEFECTS,
    INDISTINGUISHABLE,
    MOTION_DEFECTS,
    STATE_DEFECTS,
)
from tests.helpers.planted_joints import ELEMENT_MOTION_DEFECTS
from tests.helpers.planting import (
    Defect,
    answer_change,
    assert_named,
    diagnosis,
    evaluated,
    model_change,
    motion_report,
    subject,
)
from tests.helpers.requirements import require_engines

require_engines()

CLEAN = Defect("clean")
RUN = ("engine", "integrator", "mechanism", "loaded")  # what a run is beside its defect


# one of each kind: the method, the clock, the rows, the model, the samples, an element; the cheapest
FAST_MOTIONS = (
    "order-1-named-RK4", "one-step-late", "early-stop", "gravity-1e-5-in-time", "row-of-another-body",
    "principal angles",
)  # fmt: skip


def shown_by(defect):
    """What a run needs attention for, and the same run without the defect does not."""
    clean = replace(CLEAN, **{name: getattr(defect, name) for name in RUN})
    return motion_report(defect) - motion_report(clean)  # an honest run may leave a drift undecided


def state_report(defect):
    """Quantities that disagree at state level, and the diagnosis."""
    return evaluated(defect)[1], diagnosis(defect)


def is_named(defect):
    return bool(defect.expected) and defect.expected in diagnosis(defect)


def ids(defects):
    return {"argvalues": defects, "ids": [d.name for d in defects]}


def test_each_defect_has_its_own_name():
    assert len({d.name for d in (*DEFECTS, *CONTROLS)}) == len(DEFECTS) + len(CONTROLS)


@pytest.mark.parametrize("defect", some_fast(STATE_DEFECTS, 2))
def test_every_state_defect_is_reported(defect):
    assert evaluated(defect)[1], f"nothing reports {defect.name}"


@pytest.mark.parametrize("defect", some_fast([d for d in STATE_DEFECTS if d.expected], 8))
def test_every_state_defect_is_named(defect):
    assert_named(defect)


@pytest.mark.parametrize("defect", fast_are(FAST_MOTIONS, (*MOTION_DEFECTS, *ELEMENT_MOTION_DEFECTS)))
def test_every_motion_defect_is_reported(defect):
    assert shown_by(defect), f"nothing reports {defect.name}"


def test_the_same_engine_without_defect_is_not_reported():
    used = {tuple(getattr(d, name) for name in RUN) for d in (*MOTION_DEFECTS, *ELEMENT_MOTION_DEFECTS)}
    for run in used:
        clean = replace(CLEAN, **dict(zip(RUN, run, strict=True)))
        assert not [row for row in motion_report(clean) if row[0] != Verdict.UNRESOLVED]
    assert not motion_report(CLEAN), motion_report(CLEAN)
    for joints, loaded in {(d.mechanism, d.loaded) for d in STATE_DEFECTS}:
        for engine in ("mujoco", "pinocchio", "exudyn", "reference"):
            wrong, text = state_report(replace(CLEAN, mechanism=joints, loaded=loaded, engine=engine))
            assert not wrong, f"{engine} on {joints}: {wrong}, {text}"


@pytest.mark.parametrize("defect", **ids(CONTROLS))
def test_an_equivalent_implementation_is_not_accused(defect):
    wrong, text = state_report(defect)
    assert not wrong, text


@pytest.mark.parametrize("name", ["frames-turned", "world-permuted"])
def test_answers_that_stay_in_other_axes_are_reported(name):
    control = next(control for control in CONTROLS if control.name == name)
    assert evaluated(replace(control, name=f"{name}-for-good", answers=None))[1]


def test_causes_with_the_same_effect_are_named_together():
    assert_named(INDISTINGUISHABLE)


def test_scaled_mass_and_inertia_are_invisible_to_accelerations_alone():
    defect = next(d for d in STATE_DEFECTS if d.name == "mass-and-inertia-together")
    wrong, _ = state_report(defect)
    assert "joint_reaction" in wrong and not {"acceleration", "angular_acceleration"} & set(wrong)


WITHOUT_NAME = "no number, term, frame or output"


def noisy(_, state, a):
    rng = np.random.default_rng(zlib.crc32(state.p.tobytes()))
    return a * (1 + 1e-9 * rng.normal(size=a.shape))


UNNAMEABLE = (
    Defect("noise", answers=answer_change("acceleration", noisy)),
    Defect("cubed", engine="pinocchio",
           answers=answer_change("angular_acceleration", lambda _, __, a: a + 1e-6 * a**3)),
    Defect("three-at-once", inputs=model_change(lambda m, _: {
               "mass": m.mass * [1 + 1e-4, 1], "inertia": m.inertia * [[[1]], [[1 + 1e-4]]],
               "drag_moment": np.add(m.drag_moment, [1e-4, 0])})),
    Defect("friction", engine="exudyn",
           inputs=model_change(lambda m, s: {"moment": m.moment - 1e-3 * np.sign(s.omega)})),
)  # fmt: skip


@pytest.mark.parametrize("defect", **ids(UNNAMEABLE))
def test_a_difference_without_single_cause_is_not_named(defect):
    wrong, text = state_report(defect)
    assert wrong and text and "behaves as if" not in text, text


def test_a_difference_next_to_the_bound_is_not_named():
    model, truth = subject("balls", False)
    reported = list(truth.quantities)
    shift = 1.8 * truth.bounds[3].acceleration[:, None] * np.array([[0.6, -0.48, 0.64]])
    reported[3] = replace(reported[3], acceleration=reported[3].acceleration + shift)
    (cause,) = diagnose(model, reported, truth).causes
    assert (cause.kind, cause.change) == ("unexplained", "close")


BRANCHES = [
    d for d in STATE_DEFECTS if d.name.startswith(("identity-", "fast-", "rod-upward", "stale-rates"))
]


@pytest.mark.parametrize("defect", some_fast(BRANCHES, 6))
def test_a_defect_in_a_rare_branch_gets_no_wrong_name(defect):
    assert WITHOUT_NAME in diagnosis(defect)


@slow
@pytest.mark.timeout(900)
def test_rates(record_property, capsys):
    """Kill rate, naming rate and false namings, as the nightly report gives them."""
    killed = [d for d in STATE_DEFECTS if evaluated(d)[1]] + [d for d in MOTION_DEFECTS if shown_by(d)]
    nameable = [d for d in DEFECTS if d.expected]
    named = [d for d in nameable if is_named(d)]
    reported = [d for d in (*STATE_DEFECTS, *UNNAMEABLE) if "behaves as if" in diagnosis(d)]
    false = [d.name for d in reported if (d.expected and d not in named) or d in UNNAMEABLE]
    false += [d.name for d in BRANCHES if WITHOUT_NAME not in diagnosis(d)]
    figures = {
        "planted": len(DEFECTS),
        "reported": len(killed),
        "of them as unresolved": sum(
            all(verdict == Verdict.UNRESOLVED for verdict, _ in shown_by(d)) for d in MOTION_DEFECTS
        ),
        "nameable": len(nameable),
        "named": len(named),
        "false namings": len(false),
        "controls": len(CONTROLS),
        "controls accused": sum(bool(evaluated(d)[1]) for d in CONTROLS),
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
        if defect.patch or not defect.expected:
            continue
        if defect in BODY_DEFECTS:
            if joints != defect.mechanism:  # its body, joint or load is one of its own pendulum
                continue
        elif not applicable(defect, JOINT_PATTERNS[joints]):
            continue
        moved = replace(defect, engine=engine, mechanism=joints)
        if not is_named(moved):
            missed[defect.name] = diagnosis(moved)
    assert not missed
