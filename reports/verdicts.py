"""How a verdict looks and which one speaks for a cell; shared by the page, JUnit and the step summary."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

from plumbline.judging import rows
from plumbline.judging.rows import Verdict
from reports.results import Record, Results


class VerdictStyle(NamedTuple):
    """Glyph, CSS class, the verb of "3 …" and what it means."""

    glyph: str
    css_class: str
    plural: str
    meaning: str


VERDICT_STYLES = {
    str(verdict): VerdictStyle(
        style.glyph,
        "absent" if verdict == Verdict.NOT_INSTALLED else str(verdict),
        style.plural,
        style.meaning,
    )
    for verdict, style in rows.VERDICT_STYLES.items()
}


def severity(row: Record) -> int:
    """9 (failed) … 1 (not installed); from 6 on it was not expected and needs attention."""
    return rows.severity(row["verdict"], row.get("known_issue"))


def needs_attention(row: Record) -> bool:
    """A disagreement, failure or gap that no entry of known.yaml expects."""
    return severity(row) >= rows.ATTENTION_SEVERITY


def error_ratio(row: Record) -> float | None:
    """Error over tolerance, as judged; None where the row has none."""
    ratio = row["ratio"]
    return None if ratio is None or not math.isfinite(ratio) else float(ratio)


def worst_row(candidates: Iterable[Record]) -> Record:
    """The row that speaks for a cell: the most severe, among those the largest error over tolerance."""
    return max(
        candidates, key=lambda row: rows.cell_rank(row["verdict"], row.get("known_issue"), error_ratio(row))
    )


def count_verdicts(records: Iterable[Record]) -> Counter[str]:
    """Number of rows by verdict."""
    return Counter(row["verdict"] for row in records)


def count_all_verdicts(results: Results) -> Counter[str]:
    """Number of a run's rows by verdict, those of random scenarios that are only counted among them."""
    return count_verdicts(results.rows) + Counter(results.run["random_batch"].get("counts_by_verdict", {}))


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
