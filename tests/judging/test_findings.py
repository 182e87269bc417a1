"""Rows grouped to findings: one engine, one cause, whatever the scenarios."""

from dataclasses import asdict, replace

import pytest

from plumbline.diagnosis.cause import Cause
from plumbline.judging.findings import MAX_NAME, find_findings
from plumbline.judging.rows import Row, Verdict

SPRINGS = "without the springs between points"
BODIES = {"small": 1, "middle": 2, "large": 3}


def row(
    scenario="small", *causes, engine="mujoco", quantity="joint_reaction", verdict=Verdict.DISAGREES, **more
):
    return Row(
        scenario, "test", engine, engine.partition("@")[2] or "4.0.0", more.pop("level", "state"),
        more.pop("integrator", "-"), quantity, "N", 1.0, 0.1, verdict, f"reason of {quantity}", ratio=10.0,
        causes=tuple(map(asdict, causes)), **more,
    )  # fmt: skip


def output(change, general="", **more):
    more = {"quantities": ("joint_reaction",)} | more
    return Cause("output", "joint reaction", "", change, general=general, **more)


def number(term, amount, nominal=1.0, **more):
    return Cause("number", term, "body 2", "", (amount,), (nominal,), **more)


def missing(term, place, general=""):
    return Cause("number", term, place, "missing", (0.0,), (1.0,), general=general)


def names(*rows):
    return {f.name: sorted(r.scenario for r in f.rows) for f in find_findings(rows, BODIES)}


def test_one_cause_at_several_places_is_one_finding_with_the_smallest_scenario_first():
    rows = [row("large", output(SPRINGS, SPRINGS)), row("middle", output("without spring 1", SPRINGS))]
    (found,) = find_findings(rows, BODIES)
    assert found.name == "mujoco-joint-forces-without-springs-between-points"
    assert found.scenarios == ["middle", "large"] and "spring 1" in found.sentence


def test_another_scenario_renames_nothing():
    rows = [
        row("middle", output("without spring 1", SPRINGS)),
        row("middle", number("mass", 1.1), quantity="acceleration"),
    ]
    before = names(*rows)
    after = names(
        *rows,
        row("small", output(SPRINGS, SPRINGS)),
        row("large", number("mass", 2.2, 2.0), quantity="acceleration"),
    )
    assert before.keys() == after.keys() and len(before) == 2


APART = {
    "another change": (
        output(SPRINGS),
        output("with twice spring 1", "with twice the springs between points"),
    ),
    "another part": (
        output(SPRINGS),
        output("without that of joint 6", "without those of the closing joints"),
    ),
    "missing and wrong": (
        missing("damping", "joint 1"),
        Cause("number", "damping", "joint 2", "", (0.3,), (0.2,)),
    ),
    "missing and reversed": (
        missing("damping", "joint 1"),
        Cause("number", "damping", "", "reversed", (-1.0,), (1.0,)),
    ),
    "two factors": (number("mass", 1.1), number("mass", 2.4, 2.0)),
    "number and term": (number("drag", 1.5), Cause("term", "drag", "all bodies", "", (1.5,), (1.0,), "×")),
    "two elements": (
        missing("stiffness", "joint 1"),
        missing("stiffness", "spring 1", "stiffness of springs"),
    ),
    "frame and point": (output("in the body frame"), output("of the joint's point")),
    "two needs": (
        Cause("unexplained", "acceleration", quantities=("joint_reaction",), needs=("gravity",)),
        Cause("unexplained", "acceleration", quantities=("joint_reaction",), needs=("motion", "gravity")),
    ),
    "rounding": (
        Cause("rounding", "joint reaction", "", "lose", quantities=("joint_reaction",)),
        output(SPRINGS),
    ),
}


@pytest.mark.parametrize("what", APART)
def test_two_mistakes_in_one_term_or_quantity_stay_apart(what):
    one, other = APART[what]
    found = find_findings([row("small", one), row("large", other)], BODIES)
    assert len(found) == 2 and len({f.name for f in found}) == 2
    assert [len(f.rows) for f in found] == [1, 1]


@pytest.mark.parametrize(
    "pair", [((1.1, 1.0), (2.2, 2.0)), ((1.1, 1.0), (2.1, 2.0)), ((9.8, 9.81), (9.8, 1.6))]
)
def test_one_factor_one_difference_or_one_number_is_one_mistake(pair):
    assert len(names(*(row(s, number("mass", *p)) for s, p in zip(BODIES, pair, strict=False)))) == 1


def test_what_the_data_cannot_distinguish_joins_the_finding_that_explains_both():
    ambiguous = replace(missing("effort", "joint 1"), equal=(missing("rest position", "joint 1"),))
    rows = [row("small", ambiguous), row("large", missing("rest position", "joint 3"))]
    (found,) = find_findings(rows, BODIES)
    assert found.name == "mujoco-rest-position-missing" and "rest position" in found.sentence


def test_versions_are_one_finding_with_a_range_and_the_version_that_is_right():
    rows = [row("small", output(SPRINGS), engine=f"mujoco@{v}") for v in ("3.10.0", "3.2.0")]
    right = row("small", engine="mujoco@4.0.0", verdict=Verdict.AGREES)
    (found,) = find_findings([*rows, right], BODIES)
    assert found.version_range == "3.2.0 to 3.10.0 (not 4.0.0)"


def test_rows_without_a_diagnosis_follow_from_the_causes_of_their_cell():
    motion = row("small", quantity="order", level="trajectory", integrator="RK4")
    elsewhere = row("large", quantity="order", level="trajectory", integrator="RK4")
    found = find_findings([row("small", output(SPRINGS)), motion, elsewhere], BODIES)
    of_elsewhere, with_cause = sorted(([r.key for r in f.rows] for f in found), key=len)
    assert of_elsewhere == [elsewhere.key]
    assert with_cause == ["small/mujoco/state/-/joint_reaction", motion.key]


def called(quantity, unit, call="mj_rne", level="surface"):
    return replace(row("small", quantity=quantity, level=level, extra={"wrong_call": call}), unit=unit)


@pytest.mark.parametrize("call", [called("joint_force_local", "N"), called("joint_moment_by_option", "N m")])
def test_a_wrong_call_of_the_class_of_a_cause_follows_from_it(call):
    (found,) = find_findings([row("small", output(SPRINGS)), call], BODIES)
    assert found.identity[0] == "mujoco" and [r.key for r in found.rows][1] == call.key


@pytest.mark.parametrize("call", [called("frame_acceleration", "m/s²"), called("frame_axes", "1")])
def test_a_wrong_call_of_another_class_is_a_finding_by_its_name(call):
    found = find_findings([row("small", output(SPRINGS)), call], BODIES)
    assert {f.title: f.quantities for f in found} == {
        f"joint forces {SPRINGS}": ["joint_reaction"], "wrong by mj_rne": [call.quantity],
    }  # fmt: skip


def test_a_wrong_call_follows_from_what_is_wrong_in_the_mechanism_and_from_one_of_two_causes():
    unknown = Cause("unexplained", "kinetic energy", quantities=("kinetic_energy",), needs=("motion",))
    rows = [row("small", output(SPRINGS), unknown), row("small", unknown, quantity="kinetic_energy")]
    energy, axes = called("mechanical_energy", "J"), called("frame_axes", "1")
    assert {f.title: f.quantities for f in find_findings([*rows, energy, axes], BODIES)} == {
        f"joint forces {SPRINGS}": ["joint_reaction"],
        "wrong energies with motion": ["kinetic_energy", "mechanical_energy"],
        "wrong by mj_rne": ["frame_axes"],
    }
    wrong_mass = row("small", number("mass", 1.1), quantity="acceleration")
    (found,) = find_findings([wrong_mass, energy, axes], BODIES)
    assert len(found.rows) == 3


def test_a_cause_is_about_its_own_quantities():
    causes = (
        output(SPRINGS, quantities=("joint_reaction",)),
        Cause("unexplained", "kinetic energy", quantities=("kinetic_energy",), needs=("motion",)),
    )
    rows = [row("small", *causes), row("small", *causes, quantity="kinetic_energy")]
    found = find_findings(rows, BODIES)
    assert {f.name: f.quantities for f in found} == {
        f"mujoco-joint-forces-{SPRINGS.replace('the ', '').replace(' ', '-')}": ["joint_reaction"],
        "mujoco-wrong-energies-with-motion": ["kinetic_energy"],
    }


def test_a_row_with_two_causes_belongs_to_two_findings():
    both = output("without spring 1", SPRINGS), output("with twice the weights")
    rows = [row("small", output(SPRINGS, SPRINGS)), row("large", *both)]
    found = find_findings(rows, BODIES)
    assert sorted(f.scenarios for f in found) == [["large"], ["small", "large"]]


def test_a_long_name_is_cut_and_has_the_same_digits_whatever_else_is_found():
    long = row("small", quantity="q", extra={"wrong_call": "call, " * 40})
    (alone,) = names(long)
    assert len(alone) <= MAX_NAME and alone in names(long, row("large", output(SPRINGS)))


def failure(scenario, reason, place="ValueError in adapter.evaluate", **more):
    extra = {"place": place} if place else {}
    failed = row(scenario, quantity="all", verdict=Verdict.FAILED, extra=extra, **more)
    return replace(failed, reason=reason)


SHAPES = "ValueError: could not broadcast input array from shape {} into shape {}"


def test_a_failure_is_one_finding_whatever_numbers_it_says():
    rows = [failure(s, SHAPES.format(*x)) for s, x in (("small", ("(21,)", 6)), ("large", ("(106,)", 91)))]
    (found,) = find_findings(rows, BODIES)
    assert found.sentence == rows[0].reason and len(found.rows) == 2
    (alone,) = find_findings(rows[1:], BODIES)
    assert (alone.identity, alone.name) == (found.identity, found.name)
    (refused,) = find_findings([replace(one, verdict=Verdict.UNSUPPORTED) for one in rows], BODIES)
    assert len(refused.rows) == 2


@pytest.mark.parametrize(
    "other",
    [
        failure("large", SHAPES.format(106, 91), "ValueError in adapter.step"),
        failure("large", SHAPES.format(106, 91), "TypeError in adapter.evaluate"),
        failure("large", SHAPES.format(106, 91), ""),
        failure("large", SHAPES.format(21, 6), engine="exudyn"),
        failure("large", SHAPES.format(21, 6) + " of ODE23"),
    ],
)
def test_failures_of_other_places_classes_engines_or_words_stay_apart(other):
    assert len(find_findings([failure("small", SHAPES.format(21, 6)), other], BODIES)) == 2


@pytest.mark.parametrize("words", ["joint1 is no hinge", "version 3.1.1 is too old", "no mj_step1"])
def test_digits_of_names_and_versions_are_no_numbers(words):
    other = words.replace("1", "2")
    assert len(find_findings([failure("small", words), failure("large", other)], BODIES)) == 2


def test_recorded_rows_are_one_finding_by_entry_and_declared_gaps_are_none():
    rows = [
        row("small", known_issue="known"), row("large", known_issue="known", quantity="acceleration"),
        row("small", verdict=Verdict.UNSUPPORTED, known_issue="joints", is_declared=True, quantity="all"),
        row("small", verdict=Verdict.UNSUPPORTED, quantity="order"),
    ]  # fmt: skip
    new, known = find_findings(rows, BODIES)
    assert (known.name, len(known.rows), known.needs_attention) == ("known", 2, False)
    assert new.verdict == Verdict.UNSUPPORTED and new.needs_attention
