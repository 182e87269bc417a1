"""Entries of known-issue files as text: of a finding that is not recorded, and of older files by finding."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from plumbline.judging.findings import CLASSES, Finding
from plumbline.judging.known_issues import DIAGNOSED_LEVELS, FOLLOWING_LEVELS, Selector
from plumbline.judging.rows import Row, Verdict
from plumbline.model.grouping import grouped

MATCHED_BY_CAUSE = (*DIAGNOSED_LEVELS, *FOLLOWING_LEVELS)
MARGIN = 3.0  # of the largest error seen: what a new entry covers
LINE = 118  # characters
LARGE = 1e5  # a number that is easier to read with an exponent
SELECTING = [name for name in Selector.model_fields if name != "engine"]  # some rows of an engine
Entry = dict[str, Any]


def entry_of(finding: Finding) -> Entry:
    """Make the entry that would record a finding; evidence and reason are to be written."""
    entry: Entry = {"id": finding.name, "engine": finding.engine}
    if versions := [version for version in finding.versions if version]:
        entry["versions"] = f">={versions[0]},<={versions[-1]}"
    has_cause = finding.cause is not None and finding.verdict == Verdict.DISAGREES
    if has_cause:
        assert finding.cause is not None
        kind, term, change = finding.cause.identity
        if kind == "unexplained":
            entry["needs"] = list(finding.cause.needs)
        else:
            one_half = set(finding.cause.quantities) <= set(CLASSES["joint forces"]) and kind == "output"
            words = {"kind": kind, "term": "" if one_half else term, "change": change}
            kept = ("kind",) if kind == "rounding" else words
            entry["cause"] = {name: words[name] for name in kept if words[name]}
    elif finding.verdict == Verdict.DISAGREES:
        entry["mechanism"] = "equations"
    entry |= {"evidence": "…", "reason": "…"}
    groups = grouped(finding.rows, lambda row: (row.level, row.integrator, row.verdict))
    entry["rows"] = [
        _selection(rows, *names, is_about_scenarios=not (has_cause and names[0] in MATCHED_BY_CAUSE))
        for names, rows in groups.items()
    ]
    return entry


def _selection(
    rows: Sequence[Row], level: str, integrator: str, verdict: str, *, is_about_scenarios: bool
) -> Entry:
    """Select some rows."""
    found: Entry = {"level": level}
    if is_about_scenarios:
        found["scenario"] = _one_or_list(row.scenario for row in rows)
    if integrator != "-":
        found["integrator"] = integrator
    found["quantity"] = _one_or_list(row.quantity for row in rows)
    if verdict != Verdict.DISAGREES:
        found["verdict"] = str(verdict)
    elif ratios := [row.ratio for row in rows if row.ratio is not None]:
        found["max_ratio"] = float(f"{MARGIN * max(ratios):.2g}")
    return found


def _one_or_list(names: Iterator[str]) -> str | list[str]:
    every = list(dict.fromkeys(names))
    return every[0] if len(every) == 1 else every


def merge_entries(entries: Sequence[Entry]) -> list[Entry]:
    """Merge the entries of one engine that have one reason: an entry each, with the rows that it covers."""

    def common(entry: Entry) -> tuple[Any, ...]:
        names = "engine", "versions", "since", "mechanism", "reason"
        return (*map(entry.get, names), entry["id"] if "rows" in entry else "")

    groups = grouped(entries, common).values()
    return [some[0] if len(some) == 1 else _merged(some) for some in groups]


def _merged(entries: Sequence[Entry]) -> Entry:
    first = {name: value for name, value in entries[0].items() if name not in SELECTING}
    evidence = " ".join(dict.fromkeys(entry["evidence"].strip() for entry in entries))
    rows = [{name: entry[name] for name in SELECTING if name in entry} for entry in entries]
    return first | {"evidence": evidence, "rows": rows}


def entry_lines(entry: Mapping[str, Any], width: int = LINE) -> Iterator[str]:
    """Write an entry as YAML, in lines of a width where words are not longer."""
    for place, (name, value) in enumerate(entry.items()):
        lead = "- " if place == 0 else "  "
        if name == "rows":
            yield f"{lead}rows:"
            for one in value:
                yield from _wrapped(_flow(one), "    - ", 8, width)
        elif isinstance(value, str) and len(value) > width - 20:
            yield f"{lead}{name}: >-"
            yield from _wrapped(value, "    ", 4, width)
        else:
            yield from _wrapped(f"{name}: {_flow(value)}", lead, 4, width)


def _wrapped(text: str, lead: str, indent: int, width: int) -> list[str]:
    return textwrap.wrap(
        text,
        width,
        initial_indent=lead,
        subsequent_indent=" " * indent,
        break_on_hyphens=False,
        break_long_words=False,
    )


def _flow(value: Any) -> str:
    """Write a value in one line; JSON is YAML, but keys need no quotes."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {_flow(one)}" for name, one in value.items()) + "}"
    if isinstance(value, float) and value >= LARGE:
        return f"{value:.2g}" if "." in f"{value:.2g}" else f"{value:.1e}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return json.dumps(value, ensure_ascii=False)
