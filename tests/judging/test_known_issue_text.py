"""Entries of known-issue files as text: what is written can be read, and covers what it was made of."""

import json
from dataclasses import asdict

import pytest

from plumbline.diagnosis.cause import Cause
from plumbline.judging.findings import find_findings
from plumbline.judging.known_issue_text import entry_lines, entry_of, merge_entries
from plumbline.judging.known_issues import KNOWN_ISSUES_FILE, KnownIssues, load_known_issues
from plumbline.judging.rows import RowContext, Verdict
from plumbline.scenario.yaml_reader import read_yaml

CAUSES = [
    Cause("output", "joint reaction", "", "without spring 1", quantities=("joint_reaction",), general="x: y"),
    Cause("number", "force x", "body 1", "missing", (0.0,), (1.0,), general="applied force"),
    Cause("number", "mass", "body 1", "", (1.1,), (1.0,)),
    Cause("unexplained", "acceleration", quantities=("joint_reaction",), needs=("motion", "a damper")),
    Cause("unexplained", "acceleration", quantities=("joint_reaction",)),
    Cause("rounding", "acceleration", "", "lose digits", quantities=("joint_reaction",)),
]


def row(scenario, verdict=Verdict.DISAGREES, level="state", **more):
    context = RowContext(scenario, "single", "mujoco", "MuJoCo", "4.0.0")
    return context.make_row(level, "-", "joint_reaction", verdict, "why", ratio=12.0, **more)


def marked_by(finding, rows, folder):
    """Rows marked by the entry of a finding, written to a file and read again."""
    path = folder / "known.yaml"
    path.write_text("\n".join(entry_lines(entry_of(finding))))
    return KnownIssues(load_known_issues(path), False).mark_known(rows, 1)


@pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: f"{cause.kind} {cause.term} {cause.needs}")
def test_the_entry_of_a_finding_covers_its_rows_and_a_new_scenarios(tmp_path, cause):
    rows = [row("rest", causes=(asdict(cause),)), row("rest", level="relations")]
    (finding,) = find_findings(rows, {"rest": 1})
    marked = marked_by(finding, [*rows, row("conical", causes=(asdict(cause),))], tmp_path)
    assert [r.known_issue for r in marked] == [finding.name] * 3, [r.reason for r in marked]


def test_gaps_and_failures_have_an_entry_too(tmp_path):
    rows = [row("rest", Verdict.UNSUPPORTED), row("conical", Verdict.UNSUPPORTED)]
    (finding,) = find_findings(rows, {})
    marked = marked_by(finding, rows, tmp_path)
    assert [r.known_issue for r in marked] == [finding.name] * 2


def test_entries_with_one_reason_become_one_that_covers_the_same(tmp_path):
    common = {"engine": "mujoco", "versions": ">=4", "reason": "it's: so", "verdict": "failed"}
    old = [
        {"id": "a", "scenario": "rest", "level": "state", **common, "evidence": "e " * 100},
        {"id": "b", "scenario": ["conical", "spherical"], **common, "evidence": "f"},
        {"id": "c", "scenario": "rest", **common, "reason": "other", "evidence": "g"},
    ]
    new = merge_entries(old)
    assert [entry["id"] for entry in new] == ["a", "c"] and len(new[0]["rows"]) == 2
    found = []
    for name, entries in (("old", old), ("new", new)):
        path = tmp_path / f"{name}.yaml"
        path.write_text("\n".join(line for entry in entries for line in entry_lines(entry)))
        assert json.loads(json.dumps(read_yaml(path).data)) == [
            {k: v.strip() if isinstance(v, str) else v for k, v in entry.items()} for entry in entries
        ]
        issues = load_known_issues(path)
        found.append(sorted((i.scenario, i.engine, i.level, i.verdict, i.versions, i.reason) for i in issues))
    assert found[0] == found[1]


def test_the_projects_own_entries_are_by_finding_already():
    entries = read_yaml(KNOWN_ISSUES_FILE).data
    assert merge_entries(entries) == entries
