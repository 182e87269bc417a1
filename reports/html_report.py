"""report.html: one file that makes no request, from the stored results of one run."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from bisect import bisect_left
from collections import Counter
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from plumbline.judging.rows import SHOWN_STYLES
from plumbline.model.grouping import grouped
from plumbline.storage.results_store import write_atomically
from reports import coverage_table, reference_tables, report_data
from reports.chunks import encode_texts
from reports.earlier_runs import History
from reports.findings_list import declared_gaps, findings_for_page
from reports.stored_results import Record, Results
from reports.verdicts import (
    count_all_verdicts,
    count_verdicts,
    css_class,
    error_ratio,
    format_number,
    needs_attention,
    rank,
    shown_verdict,
)

REPORTS_FOLDER = Path(__file__).parent
SCRIPT_MODULES = (
    "chunks", "text", "route", "plot", "matrix", "curves", "motion", "detail", "cost", "trend", "main"
)  # fmt: skip
MAX_PAGE_BYTES = 2_000_000  # bytes, for the default catalogue
MAX_NIGHTLY_PAGE_BYTES = 8_000_000  # bytes, with a history or more scenarios than the catalogue has
MAX_CATALOGUE = 120  # scenarios
CURVE_POINTS = (360, 160, 80, 40, 28, 20, 14, 10, 7)  # values per curve: as many as the page has room for
MAX_SCENARIOS = 500  # scenarios in the page at most
MAX_FINDINGS = 60  # findings written out in the static page


def write(results: Results, history: Path | None = None) -> Path:
    """Write report.html beside the stored results.

    Args:
        history: folder of earlier nights, or None.

    Raises:
        OSError: the page cannot be written.

    """
    path = results.folder / "report.html"
    write_atomically(path, render(results, History.load(history, results)).encode())
    return path


def render(results: Results, history: History) -> str:
    """Render the page, with as many points per curve as its size limit allows."""
    is_large = history.nights or len(results.scenarios) > MAX_CATALOGUE
    budget = MAX_NIGHTLY_PAGE_BYTES if is_large else MAX_PAGE_BYTES
    shown = results.restricted_to(_scenarios_to_show(results))
    tables = {k: shown.table_by_scenario(k) for k in ("states", "curves", "trajectories")}
    texts = dict[str, int]()
    chunks = {
        "index": report_data.index_chunk(shown, history, texts),
        "convergence": report_data.convergence_chunk(shown, texts),
    }
    if history.nights:
        chunks["history"] = report_data.history_chunk(shown, history)

    of_scenarios = [report_data.scenario_chunk(name, shown, tables, texts) for name in shown.scenarios]

    @cache
    def page(points: int) -> str:
        chunks.update({f"scenario-{k}": chunk(points) for k, chunk in enumerate(of_scenarios)})
        chunks["texts"] = encode_texts(texts)
        return _render_template(results, shown, history, chunks, points)

    def fits(points: int) -> bool:
        return len(page(points).encode()) <= budget

    # Most pages have room for all; for the others the list is bisected, since each try takes seconds.
    first = 0 if fits(CURVE_POINTS[0]) else bisect_left(CURVE_POINTS, True, key=fits)
    return page((*CURVE_POINTS, 0)[first])


def _scenarios_to_show(results: Results) -> set[str]:
    """Select the scenarios of the page: the unexpected ones first, then in the order of the run."""
    unexpected = (row["scenario"] for row in results.rows if needs_attention(row))
    return set(list(dict.fromkeys([*unexpected, *results.scenarios]))[:MAX_SCENARIOS])


def _render_template(
    results: Results, shown: Results, history: History, chunks: dict[str, str], points: int
) -> str:
    findings = findings_for_page(results, history)
    attention = [finding for finding in findings if finding["known_issue"] is None]
    unshown = results.scenarios.keys() - shown.scenarios.keys()
    return render_page(
        "report.html",
        bundle_script(),
        run=results.run,
        headline=_headline(results, attention, len(findings) - len(attention)),
        chunks=chunks,
        counts=count_all_verdicts(results),
        compared=_has_compared(results),
        total=count_all_verdicts(results).total(),
        random_batch=_random_scenario_summary(results),
        engines=results.engines,
        families=_matrix_by_family(shown),
        unshown=len(unshown),
        unshown_fine=not any(needs_attention(r) for r in results.rows if r["scenario"] in unshown),
        attention=attention[:MAX_FINDINGS],
        unlisted=len(attention) - MAX_FINDINGS,
        recorded=[finding for finding in findings if finding["known_issue"] is not None],
        gaps=declared_gaps(results),
        link=_row_link,
        comparison=_changes_since_last_passed(results, history),
        damaged=history.unreadable,
        nights=len(history.nights),
        coverage=coverage_table.coverage_tables(results.folder),
        drifts=reference_tables.drift_table(results.folder),
        benchmarks=reference_tables.benchmark_table(results.folder),
        decimated=points,
        notice=_asset("vendor/uPlot.LICENSE"),
        rendered=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    )


def _has_compared(results: Results) -> bool:
    return any(row["verdict"] in ("agrees", "disagrees") for row in results.rows)


def _headline(results: Results, attention: list[Record], recorded: int) -> str:
    """Say in one line whether anything needs attention."""
    if attention:
        return f"{len(attention)} finding{' needs' if len(attention) == 1 else 's need'} attention"
    if not _has_compared(results):
        return "Nothing was compared"
    return "Nothing needs attention" + (f"; {recorded} recorded" if recorded else "")


def _row_link(row: Record) -> str:
    """Return the link to a row in its cell, as ``route.js`` reads it."""
    place = "/".join((row["level"], row["integrator"], row["quantity"]))
    return "#" + urlencode({"scenario": row["scenario"], "engine": row["engine"], "row": place})


def _matrix_by_family(results: Results) -> dict[str, Any]:
    """Arrange the matrix by family: for each scenario and engine the row that stands for the cell."""
    cells = grouped(results.rows, itemgetter("scenario", "engine"))

    def shown(rows: list[Record]) -> Record:
        worst, known = max(rows, key=rank), sum(row.get("known_issue") is not None for row in rows)
        return {"row": worst, "ratio": error_ratio(worst), "known": known}

    lines: list[Record] = []
    for place, (name, scenario) in enumerate(results.scenarios.items()):
        own = {e: shown(cells[name, e]) for e in results.engines if (name, e) in cells}
        lines.append({"name": name, "scenario": scenario, "cells": own, "place": place})

    def summary(lines: list[Record], engine: str) -> Counter[str]:
        return count_verdicts(line["cells"][engine]["row"] for line in lines if engine in line["cells"])

    return {
        family: {"lines": some, "summary": {engine: summary(some, engine) for engine in results.engines}}
        for family, some in grouped(lines, lambda line: line["scenario"]["family"]).items()
    }


def _changes_since_last_passed(results: Results, history: History) -> Record | None:
    """Count the changes since the last run that passed; None without a history."""
    passed = history.last_passed
    if not history.nights:
        return None
    if passed is None:
        return {"passed": None}
    keys = {row["key"] for row in results.rows}
    before, now = passed.run.get("versions") or {}, results.run.get("versions") or {}
    return {
        "passed": passed.run,
        "newly_failing": sum(history.is_new(row) for row in results.rows),
        "newly_agreeing": sum(
            row["verdict"] == "agrees" and passed.rows.get(row["key"], row)["verdict"] != "agrees"
            for row in results.rows
        ),
        "gone": history.missing_keys,
        "added": len(keys - passed.rows.keys()),
        "versions": [(e, before.get(e, "–"), v) for e, v in now.items() if before.get(e) != v],
    }


def _random_scenario_summary(results: Results) -> Record | None:
    """Summarise the random scenarios: how many, and the worst error over bound by quantity and engine."""
    batch = results.run["random_batch"]
    if not batch:
        return None
    worst: dict[str, dict[str, Record]] = {}
    for cell in batch["worst_ratios"]:
        worst.setdefault(cell["quantity"], {})[cell["engine"]] = cell
    return {
        "scenarios": batch["scenarios"],
        "trajectories": batch.get("trajectories", 0),
        "worst": worst,
    }


def bundle_script() -> str:
    """Join uPlot and the page's modules into one classic script, without their import and export keywords.

    Raises:
        ValueError: two modules use a name, or the script contains the end of a script element.

    """
    parts = [_asset("vendor/uPlot.iife.min.js")]
    names: list[str] = []  # they share one scope, so each must be there once
    for name in SCRIPT_MODULES:
        text = re.sub(r"^import\b[^;]*;\n", "", _asset(f"{name}.js"), flags=re.MULTILINE)
        text = re.sub(r"^ *(?://.*|/\*\*(?:[^*]|\*(?!/))*\*/)\n", "", text, flags=re.MULTILINE)
        text = re.sub(r"^export (?=async|function|const|class|let)", "", text, flags=re.MULTILINE)
        names += re.findall(r"^(?:async function|function|const|class|let) (\w+)", text, flags=re.MULTILINE)
        parts.append(text)
    if len(names) != len(set(names)):
        raise ValueError(f"names used by two modules: {sorted(n for n in set(names) if names.count(n) > 1)}")
    script = (
        parts[0] + '\n(() => {\n"use strict";\n' + re.sub("\n +", "\n", "\n".join(parts[1:])) + "\n})();\n"
    )
    if re.search(r"</script|<!--", script, re.IGNORECASE):
        raise ValueError("the page's script would end its own element")
    return script


@cache
def template_environment() -> Environment:
    """Load the templates; every value is escaped and an undefined one is an error.

    Returns:
        The environment, with the filters and verdict styles that the templates use.

    """
    made = Environment(
        loader=FileSystemLoader(REPORTS_FOLDER / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "number": format_number,
        "when": lambda iso: str(iso)[:16].replace("T", " "),
        "seconds": _format_duration,
        "css_class": css_class,
        "shown_verdict": shown_verdict,
    }
    made.globals["verdict_styles"] = SHOWN_STYLES
    return made


def render_page(template: str, script: str = "", **values: Any) -> str:
    """Render a page that makes no request, and takes no style or script but its own.

    Args:
        template: file name of the template.
        script: content of the script element; empty for none.
        values: what the template shows.

    """
    style = _asset("vendor/uPlot.min.css") + _asset("style.css")
    scripts = [f"script-src {_csp_hash(script)}"] if script else []
    sources = ["default-src 'none'", *scripts, f"style-src {_csp_hash(style)}", "img-src data:"]
    policy = "; ".join([*sources, "base-uri 'none'", "form-action 'none'"])
    page = template_environment().get_template(template)
    return page.render(policy=policy, css=Markup(style), script=Markup(script), **values)


def _asset(name: str) -> str:
    return (REPORTS_FOLDER / "assets" / name).read_text(encoding="utf-8")


def _csp_hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _format_duration(duration: Any) -> str:
    total = float(duration)
    return f"{total:.1f} s" if total < 60 else f"{int(total // 60)} min {int(total % 60)} s"
