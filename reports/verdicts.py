"""Ranking, counting and printing of stored rows, for the page, JUnit and the step summary.

Glyphs, severities and ratios are those of `plumbline.judging.rows`, which the terminal uses as well.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any

from plumbline.judging import rows
from reports.stored_results import Record, Results


def severity(row: Record) -> int:
    """Rank the verdict of one row.

    Returns:
        10 (the harness failed) … 1 (not installed), see `plumbline.judging.rows.severity`.

    """
    return rows.severity(row["verdict"], row.get("known_issue"))


def shown_verdict(row: Record) -> str:
    """Return what one row is shown as.

    Returns:
        A key of `plumbline.judging.rows.SHOWN_STYLES`.

    """
    return rows.shown_verdict(row["verdict"], row.get("known_issue"))


def needs_attention(row: Record) -> bool:
    """Report a disagreement, failure or gap that no entry of known_issues.yaml expects.

    Returns:
        True where the row is listed as needing attention.

    """
    return severity(row) >= rows.ATTENTION_SEVERITY


def error_ratio(row: Record) -> float | None:
    """Return a row's error over its tolerance, as judged.

    Returns:
        The ratio; None where the row has none or it is not finite.

    """
    ratio = row["ratio"]
    return None if ratio is None or not math.isfinite(ratio) else float(ratio)


def rank(row: Record) -> tuple[int, float]:
    """Return the sort key whose maximum over a cell's rows is the row that stands for the cell.

    Returns:
        Severity, then ratio, see `plumbline.judging.rows.cell_rank`.

    """
    return rows.cell_rank(row["verdict"], row.get("known_issue"), error_ratio(row))


def finding_by_row(results: Results) -> dict[str, str]:
    """Look up the finding of each row that does not agree.

    Returns:
        The first finding's name by the row's key.

    """
    return {key: finding["name"] for finding in reversed(results.findings) for key in finding["rows"]}


def count_verdicts(records: Iterable[Record]) -> Counter[str]:
    """Count rows by what they are shown as: recorded disagreements apart.

    Returns:
        The number of rows of each key of `plumbline.judging.rows.SHOWN_STYLES` that occurs.

    """
    return Counter(map(shown_verdict, records))


def count_all_verdicts(results: Results) -> Counter[str]:
    """Count all rows of a run, including those of random scenarios that are stored as counts only.

    Returns:
        The number of rows of each verdict that occurs.

    """
    return count_verdicts(results.rows) + Counter(
        (results.run["random_batch"] or {}).get("counts_by_verdict", {})
    )


def css_class(verdict: str) -> str:
    """Return the class of the elements that show a verdict.

    Args:
        verdict: a key of `plumbline.judging.rows.SHOWN_STYLES`.

    Returns:
        The verdict with hyphens instead of spaces.

    """
    return str(verdict).replace(" ", "-")


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_number(x: Any, digits: int = 2) -> str:
    """Format a number in few digits, without an exponent between 0.001 and 10,000.

    Args:
        x: a number, or None.

    Returns:
        For example 0.031 or 4.2×10⁻⁶; "–" for None.

    """
    if x is None:
        return "–"
    x = float(x)
    if not math.isfinite(x):
        return "not finite"
    if x == 0:
        return "0"
    mantissa, exponent = f"{x:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -4 < power < 4:
        return f"{float(f'{x:.{digits}g}'):.{max(0, digits - 1 - power)}f}"
    return f"{mantissa}×10{str(power).translate(_SUPERSCRIPT)}".replace("-", "−")
