"""How a verdict looks and which one speaks for a cell; shared by the page, JUnit and the step summary."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

from reports.results import Record, Results


class VerdictStyle(NamedTuple):
    """Glyph, CSS class, the verb of "3 …" and what it means."""

    glyph: str
    css_class: str
    plural: str
    meaning: str


VERDICT_STYLES = {
    "disagrees": VerdictStyle("≠", "disagrees", "disagree", "the error is above its derived tolerance"),
    "failed": VerdictStyle(
        "✕", "failed", "failed", "raised, crashed, hung, ran out of memory or was not finite"
    ),
    "unresolved": VerdictStyle("?", "unresolved", "unresolved", "the data cannot tell"),
    "unsupported": VerdictStyle("–", "unsupported", "unsupported", "the engine cannot do this"),
    "not installed": VerdictStyle("○", "absent", "not installed", "the engine is not on this machine"),
    "agrees": VerdictStyle("✓", "agrees", "agree", "the error is within its derived tolerance"),
}

# Whose voice a cell speaks with: what nobody expected first, then recorded disagreements, then
# agreement, then expected gaps.
_UNEXPECTED_SEVERITY = {
    "failed": 9,
    "disagrees": 8,
    "unresolved": 7,
    "unsupported": 6,
    "agrees": 4,
    "not installed": 1,
}
_KNOWN_SEVERITY = {
    "failed": 5,
    "disagrees": 5,
    "unresolved": 3,
    "unsupported": 2,
    "agrees": 4,
    "not installed": 1,
}


def severity(row: Record) -> int:
    """9 (failed) … 1 (not installed); from 6 on it was not expected and needs attention."""
    return (_KNOWN_SEVERITY if row.get("known") else _UNEXPECTED_SEVERITY)[row["verdict"]]


def needs_attention(row: Record) -> bool:
    """A disagreement, failure or gap that no entry of known.yaml expects."""
    return severity(row) >= 6


def error_ratio(row: Record) -> float | None:
    """Error over tolerance; None where either is missing or the quotient says nothing.

    Where the worst of many comparisons, each with a tolerance of its own, is not the largest error,
    the row says so in ``extra["ratio"]``.
    """
    told = (row.get("extra") or {}).get("ratio")
    if told is not None and math.isfinite(told):
        return float(told)
    value, tolerance = row.get("value"), row.get("tolerance")
    if value is None or tolerance is None or not math.isfinite(value) or not tolerance > 0:
        return None
    return float(value) / float(tolerance)


def worst_row(rows: Iterable[Record]) -> Record:
    """The row that speaks for a cell: the most severe, among those the largest error over tolerance."""
    return max(
        rows, key=lambda row: (severity(row), error_ratio(row) if error_ratio(row) is not None else -1.0)
    )


def count_verdicts(rows: Iterable[Record]) -> Counter[str]:
    """Number of rows by verdict."""
    return Counter(row["verdict"] for row in rows)


def count_all_verdicts(results: Results) -> Counter[str]:
    """Number of a run's rows by verdict, those of random scenarios that are only counted among them."""
    return count_verdicts(results.rows) + Counter(results.run["probes"].get("folded", {}))


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_number(x: Any, digits: int = 2) -> str:
    """A number as people write it: 0.031, 4.2×10⁻⁶; "–" for none."""
    if x is None:
        return "–"
    x = float(x)
    if not math.isfinite(x):
        return "not finite"
    if x == 0:
        return "0"
    mantissa, exponent = f"{x:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -3 < power < 4:
        return f"{float(f'{x:.{digits}g}'):.{max(0, digits - 1 - power)}f}"
    return f"{mantissa}×10{str(power).translate(_SUPERSCRIPT)}".replace("-", "−")
