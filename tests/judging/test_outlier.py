"""The outlier among engines is named, with who agrees, on real engines with and without a defect."""

from dataclasses import replace
from functools import cache

import pytest

from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.registry import load_adapter
from plumbline.judging.outlier import annotate_outliers, describe_outliers, doubt_truth
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers import pendulums
from tests.helpers.planted_defects import STATE_DEFECTS
from tests.helpers.planting import plant
from tests.helpers.requirements import require_engines

ENGINES = "reference", "mujoco", "pinocchio", "exudyn", "exudyn-tree"
require_engines()


@cache
def model_and_truth():
    model = pendulums.make_model("bb")
    return model, state_truth(model, random_states(model, 3, seed=1))


def doubted_rows(engines, factors, *, recorded=(), defines_truth=""):
    """Rows of engines whose accelerations are each multiplied by a factor, judged by the right truth."""
    _, right = model_and_truth()
    rows, deviations = [], {}
    for name, factor in zip(engines, factors, strict=True):
        answers = [replace(a, acceleration=factor * a.acceleration) for a in sound_answers(name)]
        context = RowContext("s", "f", name, name, "0")
        found = judge_states(context, right, Evaluation(answers))
        rows += [replace(row, known_issue="entry" if name in recorded else None) for row in found.rows]
        deviations |= found.deviations
    return doubt_truth(rows, deviations, lambda name: name.partition("-")[0], defines_truth)


@cache
def sound_answers(name):
    model, right = model_and_truth()
    return load_adapter(name).evaluate(model, right.states)


WRONG = 1 + 1e-6


@pytest.mark.parametrize(
    ("engines", "factors", "options"),
    [
        (["reference", "mujoco"], [WRONG, WRONG], {}),
        (["reference", "mujoco", "exudyn", "exudyn-tree"], [WRONG] * 4, {}),
        (["reference", "mujoco", "pinocchio"], [WRONG, 1 - 1e-6, 1 + 3e-6], {}),
        (["mujoco", "reference", "pinocchio"], [WRONG, 1, WRONG], {"defines_truth": "reference"}),
    ],
)
def test_engines_that_all_stand_against_the_truth_put_it_in_doubt(engines, factors, options):
    rows = doubted_rows(engines, factors, **options)
    in_doubt = [row for row in rows if row.verdict == "harness failed"]
    wrong = [name for name, factor in zip(engines, factors, strict=True) if factor != 1]
    assert [(row.engine, row.quantity) for row in in_doubt] == [(name, "acceleration") for name in wrong]
    assert len({row.reason for row in in_doubt}) == 1 and in_doubt[0].ratio > 1
    assert all("is off by" in row.diagnosis for row in in_doubt)
    assert not [row for row in rows if row.verdict == "disagrees"]


@pytest.mark.parametrize(
    ("engines", "factors", "options"),
    [
        (["mujoco"], [WRONG], {}),
        (["exudyn", "exudyn-tree"], [WRONG, WRONG], {}),  # of one engine
        (["reference", "mujoco"], [WRONG, 1 + 3e-6], {}),  # each has a mistake of its own
        (["reference", "mujoco", "pinocchio", "exudyn"], [WRONG, WRONG, WRONG, 1], {}),  # one agrees
        (["reference", "mujoco"], [WRONG, WRONG], {"recorded": ["mujoco"]}),
        (["reference", "mujoco"], [WRONG, WRONG], {"defines_truth": "reference"}),
    ],
)
def test_others_that_disagree_leave_the_truth_alone(engines, factors, options):
    rows = doubted_rows(engines, factors, **options)
    assert {row.verdict for row in rows if row.quantity == "acceleration"} <= {"disagrees", "agrees"}
    assert [row.engine for row in rows if row.verdict == "disagrees"] == [
        name for name, factor in zip(engines, factors, strict=True) if factor != 1
    ]


def drifting_rows(quantity, verdicts):
    return [
        RowContext("s", "f", name, name, "0").make_row(
            "invariants", "method", quantity, verdict, "drifts", "J", value=2e-3, tolerance=1e-3, ratio=2.0
        )
        for name, verdict in verdicts.items()
    ]


@pytest.mark.parametrize("quantity", ["energy_drift", "energy_drift_long"])
def test_a_drift_of_all_engines_is_the_harness_s_own_first(quantity):
    """Their energies and work are computed by one function."""
    wrong = dict.fromkeys(("reference", "mujoco", "pinocchio", "exudyn"), "disagrees")

    def judged(**changes):
        rows = drifting_rows(quantity, {**wrong, **changes})
        return {row.engine: row.verdict for row in doubt_truth(rows, {}, lambda name: name)}

    assert set(judged().values()) == {"harness failed"}
    assert judged(exudyn="information") == {**dict.fromkeys(wrong, "harness failed"), "exudyn": "information"}
    assert judged(exudyn="agrees") == {**wrong, "exudyn": "agrees"}
    two = doubt_truth(drifting_rows(quantity, {"reference": "disagrees", "mujoco": "disagrees"}), {}, str)
    assert {row.verdict for row in two} == {"disagrees"}


def rows_of_engines(*defective_engines, defect="mass-1-1e-5", leave_out=()):
    """State-level rows of the real engines, some with a defect planted in them."""
    model, right = model_and_truth()
    (planted,) = (d for d in STATE_DEFECTS if d.name == defect)
    found = []
    for name in ENGINES:
        if name in leave_out:
            continue
        engine = load_adapter(name)
        if name in defective_engines:
            engine = plant(replace(planted, engine=name))
        reported = Evaluation(engine.evaluate(model, right.states))
        found += judge_states(RowContext("s", "f", name, engine.title, "0"), right, reported).rows
    return found


@pytest.mark.parametrize("name", ENGINES)
def test_one_engine_against_the_others_is_the_outlier(name):
    text = describe_outliers(rows_of_engines(name), True)
    context, others = text.split("; ")
    assert context.startswith(f"outlier: {name} in acceleration, angular acceleration")
    assert others == (
        ", ".join(sound := [e for e in ENGINES if e != name])[: -len(sound[-1]) - 2]
        + f" and {sound[-1]} agree with the certified truth and, within the sum of their bounds, "
        "with each other"
    )


def test_two_outliers_are_both_named_and_a_single_quantity_is_reported():
    text = describe_outliers(rows_of_engines("mujoco", "exudyn"), True)
    assert text.startswith("outliers: mujoco in ") and "; exudyn in " in text
    assert text.endswith(
        "; reference, pinocchio and exudyn-tree agree with the certified truth "
        "and, within the sum of their bounds, with each other"
    )
    text = describe_outliers(rows_of_engines("pinocchio", defect="reaction-sign"), True)
    assert text.startswith("outlier: pinocchio in joint reaction; reference, mujoco and exudyn agree"), text


def test_who_agrees_alone_and_where_none_does():
    alone = describe_outliers(
        rows_of_engines("mujoco", leave_out=("exudyn", "exudyn-tree", "pinocchio")), True
    )
    assert alone.endswith("; reference agrees with the certified truth")
    assert "no other engine agrees with the certified truth" in describe_outliers(
        rows_of_engines(*ENGINES), True
    )


def test_a_truth_of_the_notes_own_may_be_the_one_that_is_wrong():
    """Without the truth tools the reference is the truth, and agrees with itself."""
    others = ENGINES[1:]
    assert describe_outliers(rows_of_engines(*others), False).endswith(
        "the truth is not certified: it may itself be wrong"
    )
    assert describe_outliers(rows_of_engines("mujoco"), False).startswith("outlier: mujoco in ")


def test_it_follows_the_diagnosis_of_rows_that_disagree_and_of_no_other():
    assert (
        describe_outliers(rows_of_engines(), True) == ""
        and annotate_outliers(sound := rows_of_engines(), True) == sound
    )
    before = [replace(row, diagnosis="behaves so") for row in rows_of_engines("mujoco")]
    for was, now in zip(before, annotate_outliers(before, True), strict=True):
        if was.verdict == "disagrees":
            assert now.diagnosis.startswith("behaves so; outlier: mujoco in ")
            assert replace(now, diagnosis=was.diagnosis) == was
        else:
            assert now == was
    bare = annotate_outliers(rows_of_engines("mujoco"), True)
    assert any(row.diagnosis and row.diagnosis.startswith("outlier: mujoco") for row in bare)
