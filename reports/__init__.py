"""From stored results to HTML, JUnit and Markdown."""

from __future__ import annotations

from pathlib import Path


def write(folder: Path, history: Path | None = None) -> Path:
    """Write report.html, junit.xml and summary.md of the results in ``folder``; returns the report's path."""
    from reports import junit, page, step_summary

    junit.write(folder)
    step_summary.write(folder)
    return page.write(folder, history)
