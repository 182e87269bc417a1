"""junit.xml: one test case per judged quantity, for the services that read it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from plumbline.storage.results_store import write_atomically
from reports.stored_results import Record, Results
from reports.verdicts import finding_by_row, format_number, needs_attention, shown_verdict

OWN = "an own scenario"
COUNTED = ("tests", "failures", "errors", "skipped")


def write(results: Results) -> Path:
    """Write junit.xml beside the stored results: a suite per scenario, a test case per check.

    An unexpected row is a failure (a disagreement, a gap) or an error (the engine failed). A row that a known
    issue expects, and one of an engine that is not installed, is skipped with its reason.
    Rows that are information are only counted, in a property of the suite.
    """
    suites = ET.Element("testsuites", name="plumbline", time=f"{float(results.run['duration']):.3f}")
    totals = Counter(dict.fromkeys(COUNTED, 0))
    names = finding_by_row(results)
    for name, scenario in results.scenarios.items():
        found = [results.rows[place] for place in results.row_indices[name]]
        if scenario["own"]:  # unresolved rows are shown, and fail no run
            found = [row | {"known_issue": OWN} if row["verdict"] == "unresolved" else row for row in found]
        about = {"family": scenario["family"], "run": str(results.run["sentence"])}
        suite, counted = add_suite(suites, name, found, about, names)
        suite.set("timestamp", str(results.run["started"])[:19])
        totals.update(counted)
    suites.attrib |= {k: str(v) for k, v in totals.items()}
    path = results.folder / "junit.xml"
    write_atomically(path, ET.tostring(suites, encoding="utf-8", xml_declaration=True))
    return path


def add_suite(
    suites: ET.Element,
    name: str,
    found: Sequence[Record],
    properties: Mapping[str, str],
    findings: Mapping[str, str] = MappingProxyType({}),
) -> tuple[ET.Element, dict[str, int]]:
    """Add a suite with a test case per check.

    Args:
        found: all rows; those that are information are only counted, in a property.
        properties: further properties of the suite.
        findings: name of its finding by key of a row, for the message.

    Returns:
        The suite, and how many tests, failures, errors and skipped tests it has.

    """
    rows = [row for row in found if row["verdict"] != "information"]
    suite = ET.SubElement(suites, "testsuite", name=name)
    element = ET.SubElement(suite, "properties")
    for key, value in {**properties, "information": str(len(found) - len(rows))}.items():
        ET.SubElement(element, "property", name=key, value=value)
    counted = dict.fromkeys(COUNTED, 0)
    for row in rows:
        outcome = _add_test_case(suite, row, findings.get(row["key"], ""))
        counted["tests"] += 1
        if outcome:
            counted[outcome] += 1
    suite.attrib |= {k: str(v) for k, v in counted.items()}
    suite.set("time", f"{sum(row['cpu_time'] for row in rows):.3f}")
    return suite, counted


def _add_test_case(suite: ET.Element, row: Record, finding: str) -> str | None:
    """Add the row's test case; return the total that it counts in besides "tests"."""
    what = row["quantity"] if row["integrator"] == "-" else f"{row['quantity']}[{row['integrator']}]"
    case = ET.SubElement(
        suite,
        "testcase",
        classname=f"{row['scenario']}.{row['engine']}.{row['level']}",
        name=what,
        time=f"{row['cpu_time']:.3f}",
    )
    message = f"{row['verdict']}: {row['reason']}"
    if needs_attention(row):
        kind = "error" if row["verdict"] in ("failed", "harness failed") else "failure"
        message = f"{finding}: {message}" if finding else message
        ET.SubElement(case, kind, message=message, type=row["verdict"]).text = _failure_text(row)
        return "errors" if kind == "error" else "failures"
    if row["verdict"] != "agrees":
        entry = row.get("known_issue")
        kind = "declared: " if row.get("is_declared") else "known issue " if entry != OWN else ""
        expected = f"{kind}{entry}; " if entry else ""
        ET.SubElement(case, "skipped", message=expected + message, type=shown_verdict(row))
        return "skipped"
    return None


def _failure_text(row: Record) -> str:
    value, tolerance = format_number(row["value"], 4), format_number(row["tolerance"], 4)
    lines = [
        f"error {value}, tolerance {tolerance} [{row['unit']}]",
        row["derivation"],
        row["diagnosis"] or "",
        f"engine version {row['engine_version']}, key {row['key']}",
    ]
    return "\n".join(line for line in lines if line)
