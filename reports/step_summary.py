"""summary.md: what a GitHub Actions step shows of a run, below its limit of 1 MiB."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

from plumbline.storage.results_store import write_atomically
from reports.results import Record, Results
from reports.verdicts import (
    VERDICT_STYLES,
    count_all_verdicts,
    error_ratio,
    format_number,
    needs_attention,
    severity,
)

MAX_SUMMARY_BYTES = 1_000_000  # bytes; GitHub drops a step's summary above 1 MiB = 1,048,576 bytes
_MARKDOWN_SPECIAL = re.compile(r"[^0-9A-Za-z .,;:()/+%=\u0080-\uffff-]")


def write(results: Results) -> Path:
    """Write summary.md beside the stored results; returns its path."""
    path = results.folder / "summary.md"
    write_atomically(path, render(results).encode())
    return path


def escape_markdown(text: Any, max_length: int = 400) -> str:
    """Text that Markdown and its HTML show as it is: every special character as a numeric reference.

    One line of at most ``longest`` characters; a "-" or number at the start cannot open a list either.
    """
    line = " ".join(str(text).split())
    line = line if len(line) <= max_length else line[: max_length - 1] + "…"
    line = _MARKDOWN_SPECIAL.sub(lambda match: f"&#{ord(match[0])};", line)
    return re.sub(r"https?:|www\.", lambda match: match[0].replace(":", "&#58;").replace(".", "&#46;"), line)


def render(results: Results) -> str:
    """The summary as Markdown: sentence, counts, engines by family, then as many findings as fit."""
    run = results.run
    told = count_all_verdicts(results)
    lines = [
        f"## {escape_markdown(run['sentence'], 2000)}",
        "",
        " · ".join(
            f"{mark.glyph} **{told[v]}** {mark.plural}" for v, mark in VERDICT_STYLES.items() if told[v]
        ),
        "",
        *_verdict_table(results),
        *_random_scenario_summary(results),
        "",
    ]
    attention = sorted(
        (row for row in results.rows if needs_attention(row)),
        key=lambda r: (-severity(r), -(error_ratio(r) or 0.0)),
    )
    tail = [
        "",
        f"Run {escape_markdown(run['id'])}, {escape_markdown(run['started'])}, {float(run['duration']):.0f} s, "
        f"commit {escape_markdown(run['commit'] or '–')}, Python {escape_markdown(run['python'])}, {escape_markdown(run['platform'])}. "
        "The artefact report.html has every cell.",
        "",
    ]
    if attention:
        lines += ["### What needs attention", "", "| | scenario | engine | what | error / tolerance | why |"]
        lines += ["|---|---|---|---|---|---|"]
    room = MAX_SUMMARY_BYTES - len("\n".join(lines + tail).encode()) - 200
    for place, row in enumerate(attention):
        line = _finding_line(row)
        room -= len(line.encode()) + 1
        if room < 0:
            lines += ["", f"… and {len(attention) - place} more."]
            break
        lines.append(line)
    return "\n".join(lines + tail)


def _verdict_table(results: Results) -> list[str]:
    """Counts of each verdict by family and engine; the first hundred families where there are more."""
    cells: dict[tuple[str, str], Counter[str]] = {}
    for row in results.rows:
        cells.setdefault((row["family"], row["engine"]), Counter())[row["verdict"]] += 1
    families = list(dict.fromkeys(row["family"] for row in results.rows))
    heads = [
        f"{escape_markdown(e['title'])} {escape_markdown(e['version'] or '')}"
        for e in results.engines.values()
    ]
    lines = ["| family | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for family in families[:100]:
        said = []
        for engine in results.engines:
            found = cells.get((family, engine), Counter())
            said.append(" ".join(f"{m.glyph}&nbsp;{found[v]}" for v, m in VERDICT_STYLES.items() if found[v]))
        lines.append(f"| {escape_markdown(family)} | " + " | ".join(said) + " |")
    return lines + ([f"\n… and {len(families) - 100} more families."] if len(families) > 100 else [])


def _random_scenario_summary(results: Results) -> list[str]:
    """A line on the random scenarios: how many, and the worst error over its bound of those that agree."""
    said = results.run["random_batch"]
    if not said:
        return []
    worst = max(said["worst_ratios"], key=lambda cell: cell["ratio"], default=None)
    text = f"{said['scenarios']} random scenarios at state level"
    if worst:
        text += (
            f"; of those that agree the worst error is {format_number(worst['ratio'])} of its bound "
            f"({escape_markdown(worst['engine'])}, {escape_markdown(worst['quantity'])}, {escape_markdown(worst['scenario'])})"
        )
    return ["", text + "."]


def _finding_line(row: Record) -> str:
    mark = VERDICT_STYLES[row["verdict"]]
    what = ", ".join(row[k] for k in ("level", "integrator", "quantity") if row[k] != "-")
    why = escape_markdown(row["reason"]) + (
        f" *{escape_markdown(row['diagnosis'])}*" if row.get("diagnosis") else ""
    )
    cells = (
        f"{mark.glyph} {row['verdict']}",
        escape_markdown(row["scenario"], 120),
        escape_markdown(row["engine"]),
        escape_markdown(what),
        format_number(error_ratio(row)),
        why,
    )
    return "| " + " | ".join(cells) + " |"
