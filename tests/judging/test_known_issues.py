"""The only file that may excuse a verdict, and how an entry loses its place."""

import json
import math
import re
from dataclasses import FrozenInstanceError, asdict, replace
from types import SimpleNamespace

import pytest

from plumbline.cli.terminal_output import print_result
from plumbline.diagnosis.cause import Cause
from plumbline.engines.declared_names import declared_integrators
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.execution.random_batch import RandomBatch
from plumbline.execution.runner import RunResult
from plumbline.judging import known_issues
from plumbline.judging.rows import FAILED_CALLS, RowContext
from plumbline.processes.cpu_time import CpuTimes
from plumbline.storage.results_store import ResultTables
from tests.helpers import ROOT
from tests.helpers.refusals import refusal
from tests.helpers.tables import table

CONTEXT = RowContext("tumbling-ball", "single", "mujoco", "MuJoCo", "4.0.0")
ENTRY = {
    "id": "a", "scenario": "tumbling-ball", "engine": "mujoco", "quantity": "acceleration",
    "verdict": "disagrees", "evidence": "seen", "reason": "because",
}  # fmt: skip


def entry(**changes):
    return known_issues.KnownIssue(**{**ENTRY, **changes})


def row(verdict="disagrees", quantity="acceleration", context=CONTEXT):
    return context.make_row("state", "-", quantity, verdict, "why")


def judged_by(rows, entries, *, whole=True, finer=False, bodies=1):
    """Rows with their excuses, and what is stale then."""
    excuses = known_issues.KnownIssues(entries, finer)
    return SimpleNamespace(
        rows=excuses.mark_known(rows, bodies), stale=excuses.stale_issues(is_full_matrix=whole)
    )


def covers(an_entry, of):
    """Whether an entry covers the cell of a row."""
    return known_issues.KnownIssues([an_entry], has_extra_refinements=False).issues_for(of) == [an_entry]


def test_an_entry_marks_its_row_and_no_other():
    rows = [row(), row(quantity="joint_reaction"), row("unresolved")]
    judged = judged_by(rows, [entry()])
    assert [r.known_issue for r in judged.rows] == ["a", None, None]
    assert judged.stale == []


def test_a_recorded_disagreement_carries_its_mechanism_as_diagnosis():
    known = [entry(mechanism="rounding"), entry(id="b", quantity="joint_reaction")]
    explained = replace(row(), diagnosis="the mass is doubled")
    rows = [row(), row(quantity="joint_reaction"), explained, row(quantity="position")]
    recorded = f"recorded: {known_issues.MECHANISMS['rounding']}. because"
    found = [r.diagnosis for r in judged_by(rows, known).rows]
    assert found == [recorded, None, "the mass is doubled", None]


def test_an_entry_that_no_longer_occurs_is_stale():
    judged = judged_by([row("agrees")], [entry()], whole=False)
    assert [e.id for e in judged.stale] == ["a"]


def test_what_did_not_run_is_not_stale():
    assert judged_by([], [entry()], whole=False).stale == []


@pytest.mark.parametrize(
    ("versions", "excused"), [(">=4", True), ("<4", False), ("", True), ("==4.0.*", True)]
)
def test_version_ranges(versions, excused):
    judged = judged_by([row()], [entry(versions=versions)], whole=False)
    assert (judged.rows[0].known_issue == "a") is excused
    assert judged.stale == [], "an entry about another version is not about this run"


GOOD = {
    "id": "a", "scenario": "rest", "engine": "mujoco", "verdict": "failed", "evidence": "e", "reason": "r",
}  # fmt: skip
OFF = {"verdict": "disagrees", "max_ratio": 3, "mechanism": "rounding"}


def text_of(*entries):
    return "".join(f"- {json.dumps(GOOD | e)}\n" for e in entries)


def loaded(tmp_path, *entries, **more):
    path = tmp_path / "known.yaml"
    path.write_text(text_of(*entries))
    return known_issues.load_known_issues(path, **more)


def problems(path, text, *more):
    """The problems for which a file with the text is refused."""
    path.write_text(text)
    return refusal(known_issues.load_known_issues, path, *more).problems


@pytest.mark.parametrize(
    ("text", "at", "words"),
    [
        ("- {id: a}", "1:3", "[0].engine: is missing; valid would be name or pattern of engines"),
        ("id: a", "1:1", "is not a list; valid would be a list of entries"),
        ("- 3", "1:3", "[0]: is the number 3; valid would be a mapping with scenario,"),
        ("- [", "1:4", "expected the node content"),
        ("- &a [*a]", "1:3", "is nested too deeply"),
        ("\n- id: !!python/x y\n", "2:7", "has the tag"),
    ],
)
def test_a_malformed_file_is_a_problem_with_a_position(tmp_path, text, at, words):
    path = tmp_path / "known.yaml"
    found = "\n".join(map(str, problems(path, text)))
    assert f"{path}:{at}: " in found and words in found


@pytest.mark.parametrize(
    ("changes", "words"),
    table(__file__),
)
def test_a_mistake_in_an_entry_is_a_problem_of_its_field(tmp_path, changes, words):
    found = problems(tmp_path / "known.yaml", text_of({"id": "b"}, changes))
    (problem,) = [p for p in found if words in str(p)]
    assert problem.line == 2 and problem.column >= 3


@pytest.mark.parametrize(
    "changes",
    [
        {"scenario": "mine"}, {"scenario": "beside"}, {"scenario": "random-*", "intermittent": "some"},
        {"verdict": "unresolved", "intermittent": "by the processor"}, OFF, OFF | {"intermittent": "x"},
        {"quantity": "as exudyn"}, {"quantity": "energy_drift_long"}, {"integrator": ["RK4", "-"]},
    ],
)  # fmt: skip
def test_what_an_entry_may_name(tmp_path, changes):
    (tmp_path / "beside.yaml").write_text("")
    assert loaded(tmp_path, changes, other_scenarios=["mine"])


def ratio_row(ratio, level="state", quantity="acceleration", engine="mujoco", verdict="disagrees"):
    context = RowContext("tumbling-ball", "single", engine, "MuJoCo", "4.0.0")
    return context.make_row(level, "-", quantity, verdict, "why", ratio=ratio)


@pytest.mark.parametrize(
    ("max_ratio", "bodies", "ratio", "covered"),
    [
        (3, 1, 2.9, True), (3, 999, 3.1, False), (3, 1, None, False), (3, 1, math.nan, False),
        ({"2": 10, "5": 1000}, 1, 9, True), ({"2": 10, "5": 1000}, 2, 11, False),
        ({"2": 10, "5": 1000}, 3, 900, True), ({"2": 10, "5": 1000}, 6, 2, False),
    ],
)  # fmt: skip
def test_an_entry_covers_no_larger_error_than_it_states(tmp_path, max_ratio, bodies, ratio, covered):
    entries = loaded(tmp_path, OFF | {"scenario": "tumbling-ball", "max_ratio": max_ratio})
    judged = judged_by([ratio_row(ratio)], entries, bodies=bodies)
    assert (judged.rows[0].known_issue == "a") is covered
    assert ("the entry a covers" in judged.rows[0].reason) is not covered
    assert judged.stale == [], "what exceeds an entry is no sign that the entry is stale"


@pytest.mark.parametrize("left", [0.5, 1.5, math.nan, None])
def test_a_missing_term_covers_what_its_effect_explains(tmp_path, left):
    changes = OFF | {"scenario": "tumbling-ball", "mechanism": "missing term"}
    entries = loaded(tmp_path, {x: value for x, value in changes.items() if x != "max_ratio"})
    extra = {} if left is None else {"unexplained": left}
    row = replace(ratio_row(1e12), extra=extra)
    judged = judged_by([row], entries).rows[0]
    assert (judged.known_issue == "a") is (left == 0.5)
    assert ("× tolerance unexplained" in judged.reason) is (left != 0.5)
    assert ("does not explain is 0.5 × tolerance" in (judged.diagnosis or "")) is (left == 0.5)


@pytest.mark.parametrize(
    ("mechanism", "scatter", "shown_by", "covered"),
    [
        ("rounding", None, "", True), ("rounding", 6.0, "", True), ("rounding", 4.0, "", False),
        ("rounding", 0.0, "pinocchio", True), ("equations", 0.5, "", True), ("equations", 60.0, "", False),
        ("method", 60.0, "", True),
    ],
)  # fmt: skip
def test_the_mechanism_is_checked_by_the_relations(mechanism, scatter, shown_by, covered):
    rows = [ratio_row(100.0)]
    if scatter is not None:
        verdict = "disagrees" if scatter > 1 else "agrees"
        rows.append(ratio_row(scatter, "relations", "rotated world", verdict=verdict))
    known = entry(mechanism=mechanism, max_ratio={10: 1e3}, shown_by=shown_by)
    judged = judged_by(rows, [known])
    assert (judged.rows[0].known_issue == "a") is covered, judged.rows[0].reason
    assert covered or "equivalent descriptions" in judged.rows[0].reason


def test_the_mechanism_may_be_shown_by_another_column_of_the_engine():
    known = entry(mechanism="rounding", shown_by="pinocchio-aba", engine="pinocchio")
    rows = [ratio_row(10.0, engine="pinocchio"), ratio_row(0.01, "relations", "rotated world", "pinocchio")]
    for scatter, covered in ((0.02, False), (2.0, True)):
        shown = ratio_row(scatter, "relations", "re-chosen body frame", "pinocchio-aba")
        judged = judged_by([*rows, shown], [known])
        assert (judged.rows[0].known_issue == "a") is covered


def test_the_example_of_the_page_is_valid_and_the_page_has_every_mechanism(tmp_path):
    page = (ROOT / "docs" / "reading-a-disagreement.md").read_text()
    path = tmp_path / "mine.yaml"
    path.write_text(re.search(r"```yaml\n(- id: .*?)```", page, re.S)[1])
    assert len(known_issues.load_known_issues(path)) == 5
    assert all(f"`{mechanism}`: " in page for mechanism in known_issues.MECHANISMS)
    assert f"at least {known_issues.MIN_SCATTER} of" in page


def test_integrators_read_from_the_source_are_those_that_adapters_have():
    found = {one.name for engine in ENGINES for one in load_adapter(engine).integrators}
    assert declared_integrators() == found


def test_an_id_with_markup_stays_text_on_the_terminal(capsys):
    stale = [entry(id="[red]x[/nope]")]
    metadata = {"sentence": "none"}
    result = RunResult([], stale, {}, {}, RandomBatch(), ResultTables(), CpuTimes(), metadata)
    print_result(result)
    assert "[red]x[/nope]" in capsys.readouterr().out


def test_information_needs_no_entry_and_matches_none():
    any_row = entry(level="*", integrator="*", quantity="*")
    found = judged_by([row("information")], [any_row])
    assert found.rows[0].known_issue is None and found.stale == []


def test_only_random_scenarios_may_show_it_sometimes():
    chance = entry(scenario="random-*", intermittent="at times")
    context = RowContext("random-1-2", "random", "mujoco", "MuJoCo", "4.0.0")
    assert judged_by([row("agrees", context=context)], [chance]).stale == []
    assert judged_by([row(context=context)], [chance]).rows[0].known_issue == "a"


def test_a_size_may_be_in_proportion_to_the_chains_ratio_of_inertias():
    recorded = entry(max_ratio_by_inertia=2.0, mechanism="rounding")
    at = replace(row(), ratio=50.0)
    excuses = known_issues.KnownIssues([recorded], has_extra_refinements=False)
    assert excuses.mark_known([at], 2, 26.0)[0].known_issue == "a"
    (found,) = excuses.mark_known([at], 2, 24.0)
    assert found.known_issue is None and "covers 48 times the tolerance at most" in found.reason


def test_the_scatter_of_a_row_itself_shows_its_mechanism():
    """Of a random scenario, which has no relations: measured by the diagnosis."""
    recorded = entry(max_ratio={10: 100.0}, mechanism="rounding")
    scattering, steady, unknown = (
        replace(row(), ratio=50.0, extra=extra) for extra in ({"scatter": 0.9}, {"scatter": 1e-4}, {})
    )
    assert judged_by([scattering], [recorded]).rows[0].known_issue == "a"
    assert judged_by([unknown], [recorded]).rows[0].known_issue == "a"
    (found,) = judged_by([steady], [recorded]).rows
    assert found.known_issue is None and "differ by only" in found.reason


def test_a_checked_mechanism_is_in_the_rows_diagnosis():
    recorded = entry(level="*", quantity="*", max_ratio={10: 100.0}, mechanism="rounding")
    turned = replace(CONTEXT.make_row("relations", "-", "rotated world", "agrees", "why"), ratio=20.0)
    found = judged_by([replace(row(), ratio=50.0), turned], [recorded]).rows
    assert "Checked: they differ by 20 × tolerance." in found[0].diagnosis


def test_an_unresolved_row_has_the_size_of_its_entry():
    """What the data decide of it agrees: an entry may require that."""
    recorded = entry(verdict="unresolved", max_ratio={10: 1.0})
    for ratio, known in ((0.3, "a"), (1.5, None), (None, None)):
        found = judged_by([replace(row("unresolved"), ratio=ratio)], [recorded])
        assert found.rows[0].known_issue == known


def test_smaller_steps_may_resolve_what_was_unresolved():
    open_ = entry(verdict="unresolved")
    assert judged_by([row("agrees")], [open_]).stale == [open_]
    assert judged_by([row("agrees")], [open_], finer=True).stale == []


def test_an_id_twice_is_refused(tmp_path):
    path = tmp_path / "known.yaml"
    line = "- {id: a, scenario: rest, engine: mujoco, verdict: failed, evidence: e, reason: r}\n"
    other = line.replace("a,", "b,", 1)
    found = problems(path, line * 2 + other * 2)
    assert [(p.line, p.column, p.message) for p in found] == [
        (2, 8, f"the id 'a' is used twice, first at {path}:1"),
        (4, 8, f"the id 'b' is used twice, first at {path}:3"),
    ]


@pytest.mark.parametrize("text", ["- {id: a, ", "- {id: 'a: state', ", "# a comment\n- {id: a, "])
def test_an_id_of_another_file_is_refused_with_both_places(tmp_path, text):
    rest = "scenario: rest, engine: mujoco, verdict: failed, evidence: e, reason: r}\n"
    first, second, places = tmp_path / "first.yaml", tmp_path / "second.yaml", {}
    first.write_text("- {id: a, " + rest.replace("rest", "[rest, state, conical]"))
    (tmp_path / "state.yaml").write_text("")
    assert len(known_issues.load_known_issues(first, (), places)) == 3
    (problem,) = problems(second, text + rest, (), places)
    line = text.count("\n") + 1
    assert str(problem).startswith(f"{second}:{line}:8: [0].id: the id 'a")
    assert f" is used twice, first at {first}:1; valid would be an id of its own" in str(problem)


def test_two_entries_of_one_line_are_two(tmp_path):
    entry = "{id: a, scenario: rest, engine: mujoco, verdict: failed, evidence: e, reason: r}"
    (problem,) = problems(tmp_path / "known.yaml", f"[{entry}, {entry}]")
    assert re.search(r"known.yaml:1:\d+: \[1\].id: the id 'a' is used twice, first at .*:1;", str(problem))


def test_the_projects_own_file_is_valid_and_gives_evidence():
    for e in known_issues.load_known_issues():
        assert len(e.evidence) > 20
        assert len(e.reason) > 20
        has_size = e.max_ratio or e.max_ratio_by_inertia or e.mechanism == "missing term"
        assert e.verdict != "disagrees" or (has_size and (e.mechanism or e.cause))


@pytest.mark.parametrize(
    ("changes", "is_covered"),
    [
        ({}, True),
        ({"scenario": "tumbling-*"}, True),
        ({"scenario": "tumbling"}, False),
        ({"engine": "mujoc?"}, True),
        ({"engine": "pinocchio"}, False),
        ({"level": "state"}, True),
        ({"level": "trajectory"}, False),
        ({"integrator": "-"}, True),
        ({"integrator": "RK4"}, False),
        ({"quantity": "acc*"}, True),
        ({"quantity": "ACCELERATION"}, False),
    ],
)
@pytest.mark.parametrize("engine", ["mujoco", "mujoco@3.12.0"])
def test_an_entry_covers_what_all_its_patterns_match(changes, is_covered, engine):
    context = RowContext("tumbling-ball", "single", engine, "MuJoCo", "4.0.0")
    assert covers(entry(**changes), row(context=context)) is is_covered


@pytest.mark.parametrize(
    ("version", "versions", "inside"),
    [
        ("4.1.0rc1", ">=4", True),
        ("3.9", ">=4", False),
        ("built here", ">=4", False),
        ("built here", "", True),
    ],
)
def test_versions_that_are_none_and_those_before_a_release(version, versions, inside):
    context = RowContext("tumbling-ball", "single", "mujoco", "MuJoCo", version)
    assert covers(entry(versions=versions), row(context=context)) is inside


def test_the_entry_with_the_rows_verdict_excuses_it_and_the_other_is_stale():
    both = [entry(id="open", verdict="unresolved"), entry(id="off")]
    judged = judged_by([row()], both)
    assert judged.rows[0].known_issue == "off"
    assert [e.id for e in judged.stale] == ["open"]


@pytest.mark.parametrize("pattern", ["*", "tumbling-*", "tumbling-bal?", "tumbling-[b]all"])
def test_every_kind_of_pattern_waits_for_the_whole_matrix(pattern):
    wide = entry(scenario=pattern)
    assert judged_by([row("agrees")], [wide], whole=False).stale == []
    assert judged_by([row("agrees")], [wide]).stale == [wide]


def test_lists_of_several_fields_are_an_entry_for_each_pair(tmp_path):
    found = loaded(tmp_path, {"integrator": ["RK4", "Euler"], "quantity": ["order", "position_limit"]})
    assert [(e.integrator, e.quantity) for e in found] == [
        ("RK4", "order"), ("RK4", "position_limit"), ("Euler", "order"), ("Euler", "position_limit"),
    ]  # fmt: skip
    assert [e.id for e in found][:2] == ["a: RK4: order", "a: RK4: position_limit"]
    assert loaded(tmp_path) == []


def test_what_an_entry_does_not_say_is_anything():
    bare = {name: ENTRY[name] for name in ("id", "scenario", "engine", "verdict", "evidence", "reason")}
    about = known_issues.KnownIssue(**bare)
    for level, integrator, quantity in (("state", "-", "energy"), ("trajectory", "RK4", "position_limit")):
        assert covers(about, CONTEXT.make_row(level, integrator, quantity, "disagrees", "why"))
    assert not about.intermittent and about.versions == ""
    with pytest.raises(FrozenInstanceError):
        about.quantity = "energy"


def test_an_issue_of_smaller_steps_alone_is_expected_only_there():
    nightly = entry(extra_refinements_only=True)
    usual, finer = (judged_by([row()], [nightly], finer=f) for f in (False, True))
    assert usual.rows[0].known_issue is None and usual.stale == []
    assert finer.rows[0].known_issue == "a" and finer.stale == []
    assert judged_by([row("agrees")], [nightly], finer=True).stale == [nightly]


def test_an_entry_that_covers_far_more_than_the_run_saw_is_named():
    excuses = known_issues.KnownIssues([entry(max_ratio={1: 1e19}, mechanism="method")], False)
    for ratio in (5e12, 2e3):
        (found,) = excuses.mark_known([ratio_row(ratio, engine="mujoco")], bodies=1)
        assert found.known_issue == "a"
    (sentence,) = excuses.wide_issues()
    assert sentence.startswith("known entry a covers 5e+12 × tolerance of at most 1e+19: ")
    near = known_issues.KnownIssues([entry(max_ratio={1: 50.0}, mechanism="method")], False)
    near.mark_known([ratio_row(5.0, engine="mujoco")], bodies=1)
    assert near.wide_issues() == []


CAUSE = {"kind": "output", "term": "joint reaction", "change": "without the springs between points"}


def with_cause(level="state", **changes):
    cause = asdict(Cause("output", "joint reaction", "", "without spring 1", general=CAUSE["change"]))
    return replace(ratio_row(10.0, level), causes=(cause | changes,))


@pytest.mark.parametrize(
    ("found", "is_known"),
    [
        (with_cause(), True),
        (with_cause(general="", change=CAUSE["change"]), True),
        (with_cause(general="", change="reversed"), False),
        (with_cause(general="", change="x", equal=[with_cause().causes[0]]), True),
        (with_cause(term="joint moment"), False),
        (replace(with_cause(), causes=()), False),
        (replace(with_cause(), ratio=40.0), False),
        (replace(with_cause(), engine_version="9.0"), False),
        (replace(with_cause(), quantity="kinetic_energy"), False),
        (replace(with_cause(), scenario="any-other"), True),
    ],
)
def test_an_entry_is_matched_by_cause_size_and_version_in_any_scenario(tmp_path, found, is_known):
    rows = [{"level": "state", "quantity": ["acceleration", "joint_reaction"], "max_ratio": 30}]
    changes = {"scenario": "*", "verdict": "disagrees", "versions": "<5", "cause": CAUSE, "rows": rows}
    judged = judged_by([found], loaded(tmp_path, changes)).rows[0]
    assert (judged.known_issue == "a") is is_known, judged.reason


NEW_CAUSE = asdict(Cause("number", "gravity", "z", amount=(-9.80999,), nominal=(-9.81,)))
CLOSE = asdict(Cause("unexplained", "acceleration", change="close", quantities=("acceleration",)))


@pytest.mark.parametrize(
    ("others", "quantities", "is_known"),
    [
        ([NEW_CAUSE], (), False),
        ([NEW_CAUSE | {"quantities": ("acceleration",)}], ("joint_reaction",), False),
        ([NEW_CAUSE | {"quantities": ("joint_reaction",)}], ("acceleration",), True),
        ([], ("joint_reaction",), False),
        ([CLOSE], ("joint_reaction",), True),
        ([CLOSE, NEW_CAUSE], ("joint_reaction",), False),
    ],
)
def test_every_cause_of_a_row_must_be_recorded(tmp_path, others, quantities, is_known):
    changes = {"scenario": "*", "verdict": "disagrees", "cause": CAUSE, "max_ratio": 30}
    found = replace(with_cause(), causes=(with_cause(quantities=quantities).causes[0], *others))
    judged = judged_by([found], loaded(tmp_path, changes)).rows[0]
    assert (judged.known_issue == "a") is is_known, judged.reason


def test_an_entry_of_what_no_cause_explains_is_matched_by_needs(tmp_path):
    changes = {"scenario": "*", "verdict": "disagrees", "max_ratio": 30, "needs": ["motion"]}
    entries = loaded(tmp_path, changes)
    for needs, known in ((("motion",), "a"), (("motion", "gravity"), None), ((), None)):
        row_ = with_cause(kind="unexplained", needs=list(needs))
        assert judged_by([row_], entries).rows[0].known_issue == known


@pytest.mark.parametrize(
    ("states", "is_known"),
    [
        ([with_cause()], True),
        ([with_cause(term="joint moment")], False),
        ([ratio_row(0.5, verdict="agrees")], False),
        ([], True),  # as far as the run compares states
    ],
)
@pytest.mark.parametrize(
    ("level", "quantity"), [("trajectory", "position_limit"), ("surface", "mass_matrix_by_spelling")]
)
def test_a_row_follows_from_the_states_that_show_the_finding(tmp_path, level, quantity, states, is_known):
    rows = [{"level": "state", "max_ratio": 30}, {"level": level, "max_ratio": 30}]
    changes = {"scenario": "*", "verdict": "disagrees", "cause": CAUSE, "rows": rows}
    following = ratio_row(10.0, level, quantity)
    found, *_ = judged_by([following, *states], loaded(tmp_path, changes)).rows
    assert (found.known_issue == "a") is is_known, found.reason
    assert is_known or found.reason == following.reason, "the record is about another mechanism"


@pytest.mark.parametrize(
    ("needs", "is_known"),
    [({"min_bodies": 3}, True), ({"min_bodies": 4}, False), ({"joints": "ball"}, True),
     ({"joints": ["slide", "rod"]}, True), ({"joints": ["slide"]}, False),
     ({"min_loops": 1}, True), ({"min_loops": 2}, False)],
)  # fmt: skip
def test_an_entry_is_about_mechanisms_that_have_what_it_needs(tmp_path, needs, is_known):
    entries = loaded(tmp_path, {"scenario": "*", **OFF, "max_ratio": 30, **needs})
    excuses = known_issues.KnownIssues(entries, has_extra_refinements=False)
    (found,) = excuses.mark_known([ratio_row(10.0)], 3, joints=("ball", "rod", "rod", "rod"))
    assert (found.known_issue == "a") is is_known


@pytest.mark.parametrize(
    ("calls", "is_known"),
    [("mj_island, MjData.iacc", True), ("mj_island, MjData.iacc\nSPARSE", True), ("SPARSE\nDENSE", False),
     (None, False)],
)  # fmt: skip
def test_an_entry_covers_no_other_call_that_fails(tmp_path, calls, is_known):
    failed_calls = {"failed_calls": ["mj_island,*", "SPARSE"]}
    entries = loaded(tmp_path, {"scenario": "*", "verdict": "failed", **failed_calls})
    excuses = known_issues.KnownIssues(entries, has_extra_refinements=False)
    extra = {} if calls is None else {FAILED_CALLS: calls}
    row = replace(ratio_row(None, "surface", "all_by_option", verdict="failed"), extra=extra)
    (found,) = excuses.mark_known([row], 3)
    assert (found.known_issue == "a") is is_known, found.reason
    assert is_known or "does not record that" in found.reason


@pytest.mark.parametrize(("joint", "is_known"), [("RevoluteUnaligned", True), ("Spherical", False)])
def test_spellings_without_rotors_excuse_no_other_spelling(joint, is_known):
    entries = known_issues.KnownIssues(known_issues.project_known_issues(), has_extra_refinements=False)
    context = RowContext("furuta-motor", "joint", "pinocchio", "Pinocchio", "4.1.0")
    extra = {FAILED_CALLS: f"JointModel{joint}, JointData{joint}"}
    row = context.make_row(
        "surface", "-", "kinetic_energy_by_spelling", "disagrees", "why", value=9e13, tolerance=1.0,
        extra=extra,
    )  # fmt: skip
    (found,) = entries.mark_known([row], 2, joints=("hinge", "hinge"))
    assert (found.known_issue is not None) is is_known, found.reason


def test_each_row_of_an_entry_must_occur(tmp_path):
    rows = [{"level": "state", "max_ratio": 30}, {"level": "relations", "max_ratio": 30}]
    changes = {"scenario": "*", "verdict": "disagrees", "mechanism": "rounding", "rows": rows}
    agreeing = ratio_row(0.5, "relations", "rotated world", verdict="agrees")
    stale = judged_by([ratio_row(10.0), agreeing], loaded(tmp_path, changes)).stale
    assert [(issue.name, issue.level) for issue in stale] == [("a", "relations")]
