"""From stored results to HTML, JUnit and Markdown."""

from __future__ import annotations

from pathlib import Path


def write(folder: Path, history: Path | None = None) -> Path:
    """Write report.html, junit.xml and summary.md of the results in ``folder``; returns the report's path.

    Raises OSError or ValueError where results.json cannot be read or a file cannot be written.
    """
    from reports import html_report, junit, step_summary
    from reports.results import Results

    results = Results.load(folder)
    junit.write(results)
    step_summary.write(results)
    return html_report.write(results, history)
