"""Outliers: which engines of a scenario disagree at state level, and which others agree with the truth.

Answers are not compared again: two engines that are each within their bound of one truth are within the sum
of both bounds of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from plumbline.judging.rows import Row, Verdict


def annotate_outliers(rows: Sequence[Row]) -> list[Row]:
    """Append the outliers to the diagnosis of every row that disagrees at state level.

    Args:
        rows: all rows of one scenario.

    Returns:
        The rows, in the same order.

    """
    sentence = describe_outliers(rows)
    return [
        replace(row, diagnosis="; ".join(filter(None, (row.diagnosis, sentence))))
        if _is_state_disagreement(row)
        else row
        for row in rows
    ]


def describe_outliers(rows: Sequence[Row]) -> str:
    """Describe the engines that disagree at state level, in which quantities, and those that agree.

    Args:
        rows: all rows of one scenario.

    Returns:
        The end of a sentence; "" where nothing disagrees.

    """
    wrong: dict[str, list[str]] = {}
    for row in filter(_is_state_disagreement, rows):
        wrong.setdefault(row.engine, []).append(row.quantity.replace("_", " "))
    if not wrong:
        return ""
    disputed = {row.quantity for row in rows if _is_state_disagreement(row)}
    right = [row for row in rows if row.level == "state" and row.verdict == Verdict.AGREES]
    agree = list(dict.fromkeys(r.engine for r in right if r.quantity in disputed and r.engine not in wrong))
    is_certified = any("truth: certified" in row.derivation for row in rows)
    truth = "the certified truth" if is_certified else "the reference, which is the truth here"
    outliers = "; ".join(f"{engine} in {_join_words(quantities)}" for engine, quantities in wrong.items())
    if not set(agree) - (set() if is_certified else {"reference"}):
        doubt = "" if is_certified else ", and the truth is not certified: it may itself be wrong"
        return f"{outliers}: no other engine agrees with {truth}{doubt}"
    noun, verb, each = ("outliers" if len(wrong) > 1 else "outlier"), "agrees", ""
    if len(agree) > 1:
        verb, each = "agree", " and, within the sum of their bounds, with each other"
    return f"{noun}: {outliers}; {_join_words(agree)} {verb} with {truth}{each}"


def _is_state_disagreement(row: Row) -> bool:
    return row.level == "state" and row.verdict == Verdict.DISAGREES


def _join_words(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
