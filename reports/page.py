"""report.html: one file that makes no request, from the stored results of one run."""

from __future__ import annotations

import base64
import hashlib
import math
import os
import re
import time
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from reports import fast_reference, payload
from reports.history import History
from reports.results import Record, Results
from reports.verdicts import MARKS, needs_attention, number, ratio, severity, tally, worst

HERE = Path(__file__).parent
MODULES = ("chunks", "text", "route", "plot", "matrix", "curves", "motion", "detail", "cost", "trend", "main")
BUDGET = 2_000_000  # bytes, for the default catalogue
NIGHTLY_BUDGET = 8_000_000  # bytes, with a history or more than 60 scenarios
POINTS = (360, 240, 160, 100, 60)  # samples per curve, tried in turn until the page is within its budget
LINES = 500  # scenarios in the page at most
LISTED = 60  # findings written out in the static page


def write(results: Results, history: Path | None = None) -> Path:
    """Render report.html beside the stored results (and earlier runs in ``history``); returns its path.

    Raises OSError where the page cannot be written.
    """
    return put(results.folder / "report.html", render(results, History.load(history, results)))


def put(path: Path, html: str) -> Path:
    """Write a page under a temporary name, then rename it."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.html")
    try:
        temporary.write_text(html, encoding="utf-8")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def render(results: Results, history: History) -> str:
    """The page as text, with as many points per curve as its budget allows."""
    budget = NIGHTLY_BUDGET if history.nights or len(results.scenarios) > 60 else BUDGET
    shown = results.only(_shown(results))
    tables = {k: shown.by_scenario(k) for k in ("states", "curves", "trajectories")}
    chunks = {
        "index": payload.index_chunk(shown, history),
        "convergence": payload.convergence_chunk(shown),
    }
    if history.nights:
        chunks["history"] = payload.history_chunk(shown, history)
    for points in (*POINTS, 0):
        for k, name in enumerate(shown.scenarios):
            chunks[f"scenario-{k}"] = payload.scenario_chunk(name, shown, tables, points)
        html = _fill(results, shown, history, chunks, points)
        if len(html.encode()) <= budget:
            break
    return html


def _shown(results: Results) -> set[str]:
    """The scenarios that the page has room for: those with anything unexpected first, then as they come."""
    worrying = dict.fromkeys(row["scenario"] for row in results.rows if needs_attention(row))
    return set([*worrying, *(name for name in results.scenarios if name not in worrying)][:LINES])


def _fill(results: Results, shown: Results, history: History, chunks: dict[str, str], points: int) -> str:
    script, style = bundle(), stylesheet()
    attention = _attention(results.rows)
    unshown = results.scenarios.keys() - shown.scenarios.keys()
    return (
        environment()
        .get_template("report.html")
        .render(
            run=results.run,
            policy=policy(style, script),
            script=Markup(script),
            style=Markup(style),
            chunks=chunks,
            marks=MARKS,
            counts=tally(results),
            total=tally(results).total(),
            probes=_probes(results),
            engines=results.engines,
            families=_families(shown),
            unshown=len(unshown),
            unshown_fine=not any(entry["row"]["scenario"] in unshown for entry in attention),
            attention=attention[:LISTED],
            unlisted=len(attention) - LISTED,
            expected=_expected(results.rows),
            ratio=ratio,
            link=lambda row: cell_link(row["scenario"], row["engine"], row),
            comparison=_comparison(results, history),
            damaged=history.damaged,
            nights=len(history.nights),
            drifts=fast_reference.drifts(results.folder),
            benchmarks=fast_reference.benchmarks(results.folder),
            decimated=points,
            notice=(HERE / "assets" / "vendor" / "uPlot.LICENSE").read_text(encoding="utf-8"),
            rendered=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        )
    )


def cell_link(scenario: str, engine: str, row: Record | None = None) -> str:
    """The link to a cell (and to one row in it), as the page's ``route.js`` reads it."""
    fields = {"scenario": scenario, "engine": engine}
    if row:
        fields["row"] = "/".join((row["level"], row["integrator"], row["quantity"]))
    return "#" + urlencode(fields)


def _families(results: Results) -> dict[str, Any]:
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
                speaker = worst(rows)
                line[engine] = {
                    "row": speaker,
                    "mark": MARKS[speaker["verdict"]],
                    "ratio": ratio(speaker),
                    "count": len(rows),
                    "known": sum(r.get("known") is not None for r in rows),
                    "link": cell_link(name, engine),
                    "track": track(ratio(speaker)),
                }
        family = families.setdefault(scenario["family"], {"lines": [], "summary": {}})
        family["lines"].append({"name": name, "scenario": scenario, "cells": line, "place": place})
    for family in families.values():
        for engine in results.engines:
            family["summary"][engine] = Counter(
                line["cells"][engine]["row"]["verdict"] for line in family["lines"] if engine in line["cells"]
            )
    return families


def track(quotient: float | None) -> float | None:
    """Where error over tolerance stands on a cell's log scale, 0 (≤ 1e-4) … 96 (≥ 1e4), 48 the tolerance."""
    if quotient is None:
        return None
    return round(min(max((math.log10(max(quotient, 1e-30)) + 4) * 12, 0), 96), 1)


def _attention(rows: list[Record]) -> list[Record]:
    """What nobody expected, worst first: an entry per cell and verdict, gaps of one reason together.

    Each has its worst row, how many more rows there are and the other scenarios they are in.
    """
    found: dict[tuple[str, ...], Record] = {}
    for row in sorted(filter(needs_attention, rows), key=lambda r: (-severity(r), -(ratio(r) or 0.0))):
        gap = row["verdict"] == "unsupported"
        key = (row["engine"], row["verdict"], row["reason"] if gap else row["scenario"])
        entry = found.setdefault(key, {"row": row, "more": -1, "scenarios": {}})
        entry["more"] += 1
        entry["scenarios"][row["scenario"]] = None
    for entry in found.values():
        del entry["scenarios"][entry["row"]["scenario"]]
        entry["more"] -= len(entry["scenarios"])
    return list(found.values())


def _expected(rows: list[Record]) -> list[Record]:
    """Recorded discrepancies and gaps by entry of known.yaml: how many rows, and one of them as example."""
    found: dict[str, Record] = {}
    for row in rows:
        if row.get("known"):
            entry = found.setdefault(
                row["known"],
                {
                    "id": row["known"],
                    "row": row,
                    "count": 0,
                    "engines": {},
                    "scenarios": {},
                    "mark": MARKS[row["verdict"]],
                },
            )
            entry["count"] += 1
            entry["engines"][row["engine"]] = entry["scenarios"][row["scenario"]] = None
    return sorted(found.values(), key=lambda e: (-severity(e["row"]), -e["count"]))


def _comparison(results: Results, history: History) -> Record | None:
    """What changed since the last green run; None without a history."""
    green = history.last_green
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


def _probes(results: Results) -> Record | None:
    """What the random scenarios came to: how many, and the worst error over bound by quantity and engine."""
    said = results.run["probes"]
    if not said:
        return None
    worst: dict[str, dict[str, Record]] = {}
    for cell in said["worst"]:
        worst.setdefault(cell["quantity"], {})[cell["engine"]] = cell
    return {"scenarios": said["scenarios"], "worst": worst}


def bundle() -> str:
    """The page's own modules and uPlot as one classic script: import lines dropped, ``export`` taken off."""
    parts = [(HERE / "assets" / "vendor" / "uPlot.iife.min.js").read_text(encoding="utf-8")]
    names: list[str] = []  # they share one scope, so each must be there once
    for name in MODULES:
        text = (HERE / "assets" / f"{name}.js").read_text(encoding="utf-8")
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


def environment() -> Environment:
    """The templates, with everything escaped and nothing undefined let through."""
    made = Environment(
        loader=FileSystemLoader(HERE / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"number": number, "when": _when, "seconds": _seconds}
    return made


def policy(style: str, script: str | None = None) -> str:
    """The Content-Security-Policy of a page with this style and at most this script: no request, no other."""
    sources = ["default-src 'none'", f"style-src {_hash(style)}", "img-src data:"]
    if script is not None:
        sources.insert(1, f"script-src {_hash(script)}")
    return "; ".join([*sources, "base-uri 'none'", "form-action 'none'"])


def stylesheet() -> str:
    """The style of uPlot and the pages' own."""
    vendor = (HERE / "assets" / "vendor" / "uPlot.min.css").read_text(encoding="utf-8")
    return vendor + (HERE / "assets" / "style.css").read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _when(iso: str) -> str:
    return str(iso)[:16].replace("T", " ")


def _seconds(duration: Any) -> str:
    total = float(duration)
    return f"{total:.1f} s" if total < 60 else f"{int(total // 60)} min {int(total % 60)} s"
