"""The pages of a stored run: report.html, junit.xml, summary.md, findings.sarif; and sweep.html of a sweep.

Input: an output folder as `plumbline.storage` writes it, and the folder of earlier nights.
Output: files in the output folder. Nothing is computed anew and no engine runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any


def write(folder: Path, history: Path | None = None, document: dict[str, Any] | None = None) -> Path:
    """Write report.html, junit.xml, summary.md and findings.sarif of a stored run.

    Args:
        history: folder of earlier nights, or None.
        document: content of the folder's results.json, where it has been read already.

    Raises:
        OSError: a file cannot be read or written.
        DamagedResults: a file of the folder is missing or damaged.

    """
    from reports import html_report, junit, sarif, step_summary
    from reports.stored_results import Results

    results = Results.load(folder, document)
    page = html_report.write(results, history)  # first: it reads every table, so nothing is half written
    junit.write(results)
    step_summary.write(results)
    sarif.write(results)
    return page
