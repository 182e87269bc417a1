"""report.html: one file that makes no request, from the stored results of one run."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import time
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from plumbline.storage.results_store import write_atomically
from reports import reference_tables, report_data
from reports.history import History
from reports.results import Record, Results
from reports.verdicts import (
    VERDICT_STYLES,
    count_all_verdicts,
    error_ratio,
    format_number,
    needs_attention,
    severity,
    worst_row,
)

REPORTS_FOLDER = Path(__file__).parent
SCRIPT_MODULES = (
    "chunks",
    "text",
    "route",
    "plot",
    "matrix",
    "curves",
    "motion",
    "detail",
    "cost",
    "trend",
    "main",
)
MAX_PAGE_BYTES = 2_000_000  # bytes, for the default catalogue
MAX_NIGHTLY_PAGE_BYTES = 8_000_000  # bytes, with a history or more than 60 scenarios
CURVE_POINTS = (
    360,
    240,
    160,
    100,
    60,
)  # samples per curve, tried in turn until the page is within its budget
MAX_SCENARIOS = 500  # scenarios in the page at most
MAX_FINDINGS = 60  # findings written out in the static page


def write(results: Results, history: Path | None = None) -> Path:
    """Render report.html beside the stored results (and earlier runs in ``history``); returns its path.

    Raises OSError where the page cannot be written.
    """
    return write_page(results.folder / "report.html", render(results, History.load(history, results)))


def write_page(path: Path, html: str) -> Path:
    """Write a page whole or not at all."""
    write_atomically(path, html.encode())
    return path


def render(results: Results, history: History) -> str:
    """The page as text, with as many points per curve as its budget allows."""
    budget = MAX_NIGHTLY_PAGE_BYTES if history.nights or len(results.scenarios) > 60 else MAX_PAGE_BYTES
    shown = results.restricted_to(_scenarios_to_show(results))
    tables = {k: shown.table_by_scenario(k) for k in ("states", "curves", "trajectories")}
    chunks = {
        "index": report_data.index_chunk(shown, history),
        "convergence": report_data.convergence_chunk(shown),
    }
    if history.nights:
        chunks["history"] = report_data.history_chunk(shown, history)
    for points in (*CURVE_POINTS, 0):
        for k, name in enumerate(shown.scenarios):
            chunks[f"scenario-{k}"] = report_data.scenario_chunk(name, shown, tables, points)
        html = _render_template(results, shown, history, chunks, points)
        if len(html.encode()) <= budget:
            break
    return html


def _scenarios_to_show(results: Results) -> set[str]:
    """The scenarios that the page has room for: those with anything unexpected first, then as they come."""
    worrying = dict.fromkeys(row["scenario"] for row in results.rows if needs_attention(row))
    return set([*worrying, *(name for name in results.scenarios if name not in worrying)][:MAX_SCENARIOS])


def _render_template(
    results: Results, shown: Results, history: History, chunks: dict[str, str], points: int
) -> str:
    script, style = bundle_script(), stylesheet()
    attention = _unexpected_findings(results.rows)
    unshown = results.scenarios.keys() - shown.scenarios.keys()
    return (
        template_environment()
        .get_template("report.html")
        .render(
            run=results.run,
            policy=content_security_policy(style, script),
            script=Markup(script),
            style=Markup(style),
            chunks=chunks,
            marks=VERDICT_STYLES,
            counts=count_all_verdicts(results),
            total=count_all_verdicts(results).total(),
            probes=_random_scenario_summary(results),
            engines=results.engines,
            families=_matrix_by_family(shown),
            unshown=len(unshown),
            unshown_fine=not any(entry["row"]["scenario"] in unshown for entry in attention),
            attention=attention[:MAX_FINDINGS],
            unlisted=len(attention) - MAX_FINDINGS,
            expected=_known_findings(results.rows),
            ratio=error_ratio,
            link=lambda row: cell_link(row["scenario"], row["engine"], row),
            comparison=_changes_since_last_passed(results, history),
            damaged=history.unreadable,
            nights=len(history.nights),
            drifts=reference_tables.drift_table(results.folder),
            benchmarks=reference_tables.benchmark_table(results.folder),
            decimated=points,
            notice=(REPORTS_FOLDER / "assets" / "vendor" / "uPlot.LICENSE").read_text(encoding="utf-8"),
            rendered=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        )
    )


def cell_link(scenario: str, engine: str, row: Record | None = None) -> str:
    """The link to a cell (and to one row in it), as the page's ``route.js`` reads it."""
    fields = {"scenario": scenario, "engine": engine}
    if row:
        fields["row"] = "/".join((row["level"], row["integrator"], row["quantity"]))
    return "#" + urlencode(fields)


def _matrix_by_family(results: Results) -> dict[str, Any]:
    """Matrix by family: per scenario and engine the row that speaks for the cell, and how many there are."""
    cells: dict[tuple[str, str], list[Record]] = {}
    for row in results.rows:
        cells.setdefault((row["scenario"], row["engine"]), []).append(row)
    families: dict[str, Any] = {}
    for place, (name, scenario) in enumerate(results.scenarios.items()):
        line = {}
        for engine in results.engines:
            rows = cells.get((name, engine))
            if rows:
                speaker = worst_row(rows)
                line[engine] = {
                    "row": speaker,
                    "mark": VERDICT_STYLES[speaker["verdict"]],
                    "ratio": error_ratio(speaker),
                    "count": len(rows),
                    "known": sum(r.get("known_issue") is not None for r in rows),
                    "link": cell_link(name, engine),
                    "track": ratio_position(error_ratio(speaker)),
                }
        family = families.setdefault(scenario["family"], {"lines": [], "summary": {}})
        family["lines"].append({"name": name, "scenario": scenario, "cells": line, "place": place})
    for family in families.values():
        for engine in results.engines:
            family["summary"][engine] = Counter(
                line["cells"][engine]["row"]["verdict"] for line in family["lines"] if engine in line["cells"]
            )
    return families


def ratio_position(quotient: float | None) -> float | None:
    """Where error over tolerance stands on a cell's log scale, 0 (≤ 1e-4) … 96 (≥ 1e4), 48 the tolerance."""
    if quotient is None:
        return None
    return round(min(max((math.log10(max(quotient, 1e-30)) + 4) * 12, 0), 96), 1)


def _unexpected_findings(rows: list[Record]) -> list[Record]:
    """What nobody expected, worst first: an entry per cell and verdict, gaps of one reason together.

    Each has its worst row, how many more rows there are and the other scenarios they are in.
    """
    found: dict[tuple[str, ...], Record] = {}
    for row in sorted(filter(needs_attention, rows), key=lambda r: (-severity(r), -(error_ratio(r) or 0.0))):
        gap = row["verdict"] == "unsupported"
        key = (row["engine"], row["verdict"], row["reason"] if gap else row["scenario"])
        entry = found.setdefault(key, {"row": row, "more": -1, "scenarios": {}})
        entry["more"] += 1
        entry["scenarios"][row["scenario"]] = None
    for entry in found.values():
        del entry["scenarios"][entry["row"]["scenario"]]
        entry["more"] -= len(entry["scenarios"])
    return list(found.values())


def _known_findings(rows: list[Record]) -> list[Record]:
    """Recorded discrepancies and gaps by entry of known.yaml: how many rows, and one of them as example."""
    found: dict[str, Record] = {}
    for row in rows:
        if row.get("known_issue"):
            entry = found.setdefault(
                row["known_issue"],
                {
                    "id": row["known_issue"],
                    "row": row,
                    "count": 0,
                    "engines": {},
                    "scenarios": {},
                    "mark": VERDICT_STYLES[row["verdict"]],
                },
            )
            entry["count"] += 1
            entry["engines"][row["engine"]] = entry["scenarios"][row["scenario"]] = None
    return sorted(found.values(), key=lambda e: (-severity(e["row"]), -e["count"]))


def _changes_since_last_passed(results: Results, history: History) -> Record | None:
    """What changed since the last green run; None without a history."""
    green = history.last_passed
    if not history.nights:
        return None
    if green is None:
        return {"green": None}
    keys = {row["key"] for row in results.rows}
    before, now = green.run.get("versions") or {}, results.run.get("versions") or {}
    return {
        "green": green.run,
        "fresh": sum(history.is_new(row) for row in results.rows),
        "healed": sum(
            row["verdict"] == "agrees" and green.rows.get(row["key"], row)["verdict"] != "agrees"
            for row in results.rows
        ),
        "gone": len(green.rows.keys() - keys),
        "added": len(keys - green.rows.keys()),
        "versions": [(e, before.get(e, "–"), v) for e, v in now.items() if before.get(e) != v],
    }


def _random_scenario_summary(results: Results) -> Record | None:
    """What the random scenarios came to: how many, and the worst error over bound by quantity and engine."""
    said = results.run["random_batch"]
    if not said:
        return None
    worst: dict[str, dict[str, Record]] = {}
    for cell in said["worst_ratios"]:
        worst.setdefault(cell["quantity"], {})[cell["engine"]] = cell
    return {"scenarios": said["scenarios"], "worst": worst}


def bundle_script() -> str:
    """The page's own modules and uPlot as one classic script: import lines dropped, ``export`` taken off."""
    parts = [(REPORTS_FOLDER / "assets" / "vendor" / "uPlot.iife.min.js").read_text(encoding="utf-8")]
    names: list[str] = []  # they share one scope, so each must be there once
    for name in SCRIPT_MODULES:
        text = (REPORTS_FOLDER / "assets" / f"{name}.js").read_text(encoding="utf-8")
        text = re.sub(r"^import\b[^;]*;\n", "", text, flags=re.MULTILINE)
        text = re.sub(r"^export (?=async|function|const|class|let)", "", text, flags=re.MULTILINE)
        names += re.findall(r"^(?:async function|function|const|class|let) (\w+)", text, flags=re.MULTILINE)
        parts.append(text)
    if len(names) != len(set(names)):
        raise ValueError(f"names used by two modules: {sorted(n for n in set(names) if names.count(n) > 1)}")
    script = parts[0] + '\n(() => {\n"use strict";\n' + "\n".join(parts[1:]) + "\n})();\n"
    if re.search(r"</script|<!--", script, re.IGNORECASE):
        raise ValueError("the page's script would end its own element")
    return script


def template_environment() -> Environment:
    """The templates, with everything escaped and nothing undefined let through."""
    made = Environment(
        loader=FileSystemLoader(REPORTS_FOLDER / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"number": format_number, "when": _format_time, "seconds": _format_duration}
    return made


def content_security_policy(style: str, script: str | None = None) -> str:
    """The Content-Security-Policy of a page with this style and at most this script: no request, no other."""
    sources = ["default-src 'none'", f"style-src {_csp_hash(style)}", "img-src data:"]
    if script is not None:
        sources.insert(1, f"script-src {_csp_hash(script)}")
    return "; ".join([*sources, "base-uri 'none'", "form-action 'none'"])


def stylesheet() -> str:
    """The style of uPlot and the pages' own."""
    vendor = (REPORTS_FOLDER / "assets" / "vendor" / "uPlot.min.css").read_text(encoding="utf-8")
    return vendor + (REPORTS_FOLDER / "assets" / "style.css").read_text(encoding="utf-8")


def _csp_hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _format_time(iso: str) -> str:
    return str(iso)[:16].replace("T", " ")


def _format_duration(duration: Any) -> str:
    total = float(duration)
    return f"{total:.1f} s" if total < 60 else f"{int(total // 60)} min {int(total % 60)} s"
