"""The only file that may excuse a verdict, and how an entry loses its place."""

from types import SimpleNamespace

import pytest

from plumbline.judging import known_issues
from plumbline.judging.rows import RowContext

WHO = RowContext("tumbling-ball", "single", "mujoco", "MuJoCo", "4.0.0")
ENTRY = {
    "id": "a", "scenario": "tumbling-ball", "engine": "mujoco", "quantity": "acceleration",
    "verdict": "disagrees", "evidence": "seen", "reason": "because",
}  # fmt: skip


def entry(**changes):
    return known_issues.KnownIssue(**{**ENTRY, **changes})


def row(verdict="disagrees", quantity="acceleration", who=WHO):
    return who.make_row("state", "-", quantity, verdict, "why")


def judged_by(rows, entries, whole, finer=False):
    """Rows with their excuses, and what is stale then."""
    excuses = known_issues.KnownIssues(entries, finer)
    return SimpleNamespace(rows=excuses.mark_known(rows), stale=excuses.stale_issues(is_full_matrix=whole))


def covers(an_entry, of):
    """Whether an entry speaks of the cell of a row."""
    return known_issues.KnownIssues([an_entry], has_extra_refinements=False).issues_for(of) == [an_entry]


def test_an_entry_marks_its_row_and_no_other():
    rows = [row(), row(quantity="joint_reaction"), row("unresolved")]
    judged = judged_by(rows, [entry()], whole=True)
    assert [r.known_issue for r in judged.rows] == ["a", None, None]
    assert judged.stale == []


def test_an_entry_that_no_longer_occurs_is_stale():
    judged = judged_by([row("agrees")], [entry()], whole=False)
    assert [e.id for e in judged.stale] == ["a"]


def test_what_did_not_run_is_not_stale():
    assert judged_by([], [entry()], whole=False).stale == []


def test_a_pattern_is_stale_only_when_the_whole_matrix_ran():
    wide = entry(scenario="*")
    assert judged_by([row("agrees")], [wide], whole=False).stale == []
    assert judged_by([row("agrees")], [wide], whole=True).stale == [wide]


@pytest.mark.parametrize(
    ("versions", "excused"), [(">=4", True), ("<4", False), ("", True), ("==4.0.*", True)]
)
def test_version_ranges(versions, excused):
    judged = judged_by([row()], [entry(versions=versions)], whole=False)
    assert (judged.rows[0].known_issue == "a") is excused
    assert judged.stale == [], "an entry about another version is not about this run"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- {id: a}", "scenario"),
        ("- {id: a, scenario: x, engine: y, verdict: agrees, evidence: e, reason: r}", "verdict"),
        (
            "- {id: a, scenario: x, engine: y, verdict: failed, evidence: e, reason: r, quantitty: z}",
            "quantitty",
        ),
        (
            "- {id: a, scenario: x, engine: y, versions: new, verdict: failed, evidence: e, reason: r}",
            "range",
        ),
        ("- [", "known"),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path, text, words):
    path = tmp_path / "known.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=words) as caught:
        known_issues.load_known_issues(path)
    assert str(path) in str(caught.value)


def test_a_list_of_scenarios_is_an_entry_for_each(tmp_path):
    path = tmp_path / "known.yaml"
    path.write_text("- {id: a, scenario: [x, y], engine: z, verdict: failed, evidence: e, reason: r}\n")
    assert [(e.id, e.scenario) for e in known_issues.load_known_issues(path)] == [
        ("a: x", "x"),
        ("a: y", "y"),
    ]


def test_only_random_scenarios_may_show_it_sometimes():
    chance = entry(scenario="random-*", intermittent=True)
    who = RowContext("random-1-2", "random", "mujoco", "MuJoCo", "4.0.0")
    assert judged_by([row("agrees", who=who)], [chance], whole=True).stale == []
    assert judged_by([row(who=who)], [chance], whole=True).rows[0].known_issue == "a"
    with pytest.raises(ValueError, match="random"):
        entry(intermittent=True)


def test_smaller_steps_may_resolve_what_was_unresolved():
    open_ = entry(verdict="unresolved")
    assert judged_by([row("agrees")], [open_], whole=True).stale == [open_]
    assert judged_by([row("agrees")], [open_], whole=True, finer=True).stale == []


def test_an_id_twice_is_refused(tmp_path):
    path = tmp_path / "known.yaml"
    line = "- {id: a, scenario: x, engine: y, verdict: failed, evidence: e, reason: r}\n"
    other = line.replace("a,", "b,", 1)
    path.write_text(line * 2 + other * 2)
    with pytest.raises(ValueError, match=r"twice: a, b$"):
        known_issues.load_known_issues(path)


def test_the_projects_own_file_is_valid_and_gives_evidence():
    for e in known_issues.load_known_issues():
        assert len(e.evidence) > 20
        assert len(e.reason) > 20


@pytest.mark.parametrize(
    ("changes", "spoken_of"),
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
def test_an_entry_covers_what_all_its_patterns_match(changes, spoken_of, engine):
    who = RowContext("tumbling-ball", "single", engine, "MuJoCo", "4.0.0")
    assert covers(entry(**changes), row(who=who)) is spoken_of


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
    who = RowContext("tumbling-ball", "single", "mujoco", "MuJoCo", version)
    assert covers(entry(versions=versions), row(who=who)) is inside


def test_the_entry_with_the_rows_verdict_excuses_it_and_the_other_is_stale():
    both = [entry(id="open", verdict="unresolved"), entry(id="off")]
    judged = judged_by([row()], both, whole=True)
    assert judged.rows[0].known_issue == "off"
    assert [e.id for e in judged.stale] == ["open"]


@pytest.mark.parametrize("pattern", ["tumbling-*", "tumbling-bal?", "tumbling-[b]all"])
def test_every_kind_of_pattern_waits_for_the_whole_matrix(pattern):
    wide = entry(scenario=pattern)
    assert judged_by([row("agrees")], [wide], whole=False).stale == []
    assert judged_by([row("agrees")], [wide], whole=True).stale == [wide]


def test_lists_of_several_fields_are_an_entry_for_each_pair(tmp_path):
    path = tmp_path / "known.yaml"
    lists = "scenario: x, integrator: [RK4, Euler], quantity: [order, position]"
    path.write_text(f"- {{id: a, {lists}, engine: z, verdict: failed, evidence: e, reason: r}}\n")
    found = known_issues.load_known_issues(path)
    assert [(e.integrator, e.quantity) for e in found] == [
        ("RK4", "order"), ("RK4", "position"), ("Euler", "order"), ("Euler", "position"),
    ]  # fmt: skip
    assert [e.id for e in found][:2] == ["a: RK4: order", "a: RK4: position"]
    path.write_text("")
    assert known_issues.load_known_issues(path) == []


def test_what_an_entry_does_not_say_is_anything():
    bare = {name: ENTRY[name] for name in ("id", "scenario", "engine", "verdict", "evidence", "reason")}
    about = known_issues.KnownIssue(**bare)
    for level, integrator, quantity in (("state", "-", "energy"), ("trajectory", "RK4", "position_limit")):
        assert covers(about, WHO.make_row(level, integrator, quantity, "disagrees", "why"))
    assert not about.intermittent and about.versions == ""
    with pytest.raises(ValueError, match="frozen"):
        about.quantity = "energy"


def test_an_issue_of_smaller_steps_alone_is_expected_only_there():
    nightly = entry(extra_refinements_only=True)
    usual, finer = (judged_by([row()], [nightly], whole=True, finer=f) for f in (False, True))
    assert usual.rows[0].known_issue is None and usual.stale == []
    assert finer.rows[0].known_issue == "a" and finer.stale == []
    assert judged_by([row("agrees")], [nightly], whole=True, finer=True).stale == [nightly]
