"""summary.md: the summary of a run for a GitHub Actions step, below its limit of 1 MiB."""

from __future__ import annotations

import re
from operator import itemgetter
from pathlib import Path
from typing import Any

from plumbline.judging.rows import SHOWN_STYLES
from plumbline.model.grouping import grouped
from plumbline.storage.results_store import write_atomically
from reports.stored_results import Record, Results
from reports.verdicts import count_all_verdicts, count_verdicts, format_number, shown_verdict

MAX_SUMMARY_BYTES = 1_000_000  # bytes; GitHub drops a step's summary above 1 MiB = 1,048,576 bytes
_MARKDOWN_SPECIAL = re.compile(r"[^0-9A-Za-z .,;:()/+%=\u0080-\uffff-]")


def write(results: Results) -> Path:
    """Write summary.md beside the stored results."""
    path = results.folder / "summary.md"
    write_atomically(path, render(results).encode())
    return path


def escape_markdown(text: Any, max_length: int = 400) -> str:
    """Escape a text so that Markdown shows it literally: every special character as a numeric reference.

    Args:
        text: any value.
        max_length: characters that are kept.

    Returns:
        One line. A "-" or a number at its start does not open a list.

    """
    line = " ".join(str(text).split())
    line = line if len(line) <= max_length else line[: max_length - 1] + "…"
    line = _MARKDOWN_SPECIAL.sub(lambda match: f"&#{ord(match[0])};", line)
    return re.sub(r"https?:|www\.", lambda match: match[0].replace(":", "&#58;").replace(".", "&#46;"), line)


def render(results: Results) -> str:
    """Render the summary: sentence, counts, engines by family, then as many findings as fit, new ones first.

    Returns:
        Markdown of at most `MAX_SUMMARY_BYTES`.

    """
    run = results.run
    counts = count_all_verdicts(results)
    lines = [
        f"## {escape_markdown(run['sentence'], 2000)}",
        "",
        " · ".join(
            f"{style.glyph} **{counts[v]}** {style.counted(counts[v])}"
            for v, style in SHOWN_STYLES.items()
            if counts[v]
        ),
        "",
        *_verdict_table(results),
        *_random_scenario_summary(results),
        "",
    ]
    about = (
        f"Run {run['id']}, {run['started']}, {float(run['duration']):.0f} s, commit {run['commit'] or '–'}, "
        f"Python {run['python']}, {run['platform']}. The artefact report.html has every cell."
    )
    tail = ["", escape_markdown(about, 2000), ""]
    new = [finding for finding in results.findings if finding["known_issue"] is None]
    recorded = [finding for finding in results.findings if finding["known_issue"] is not None]
    room = MAX_SUMMARY_BYTES - len("\n".join(lines + tail).encode()) - 1000
    for title, findings in (("What needs attention", new), ("Recorded", recorded)):
        if findings:
            lines += [
                f"### {title}",
                "",
                "| | finding | versions | rows | up to | cause |",
                "|---|---|---|---|---|---|",
            ]
        for place, finding in enumerate(findings):
            line = _finding_line(finding)
            room -= len(line.encode()) + 1
            if room < 0:
                lines += ["", f"… and {len(findings) - place} more."]
                break
            lines.append(line)
        lines.append("")
    return "\n".join(lines + tail)


def _verdict_table(results: Results) -> list[str]:
    """Counts of each verdict by family and engine; the first hundred families where there are more."""
    cells = grouped(results.rows, itemgetter("family", "engine"))
    families = list(dict.fromkeys(row["family"] for row in results.rows))
    heads = [
        f"{escape_markdown(e['title'])} {escape_markdown(e['version'] or '')}"
        for e in results.engines.values()
    ]
    lines = ["| family | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for family in families[:100]:
        texts = []
        for engine in results.engines:
            counts = count_verdicts(cells.get((family, engine), ()))
            texts.append(
                " ".join(f"{s.glyph}&nbsp;{counts[v]}" for v, s in SHOWN_STYLES.items() if counts[v])
            )
        lines.append(f"| {escape_markdown(family)} | " + " | ".join(texts) + " |")
    return lines + ([f"\n… and {len(families) - 100} more families."] if len(families) > 100 else [])


def _random_scenario_summary(results: Results) -> list[str]:
    """Summarise the random scenarios: how many, and the worst error over its bound of those that agree."""
    batch = results.run["random_batch"]
    if not batch:
        return []
    worst = max(batch["worst_ratios"], key=lambda cell: cell["ratio"], default=None)
    text = f"{batch['scenarios']} random scenarios at state level"
    if count := batch.get("trajectories"):
        text += f", {count} of them (motions) at every level"
    if worst:
        place = escape_markdown(f"{worst['engine']}, {worst['quantity']}, {worst['scenario']}")
        text += (
            f"; the worst error of those that agree is {format_number(worst['ratio'])} of its bound ({place})"
        )
    return ["", text + "."]


def _finding_line(finding: Record) -> str:
    verdict = shown_verdict(finding)
    where = f"{len(finding['rows'])} in {', '.join(finding['scenarios'][:3])}"
    more = len(finding["scenarios"]) - 3
    versions = ", ".join(finding["versions"])
    right = f"; not {', '.join(finding['right_versions'])}" if finding["right_versions"] else ""
    cells = (
        f"{SHOWN_STYLES[verdict].glyph} {verdict}",
        escape_markdown(finding["name"], 200),
        escape_markdown(f"{finding['engine']} {versions}{right}", 120),
        escape_markdown(where + (f" and {more} more" if more > 0 else ""), 200),
        format_number(finding["largest_ratio"]),
        escape_markdown(finding["sentence"]),
    )
    return "| " + " | ".join(cells) + " |"
