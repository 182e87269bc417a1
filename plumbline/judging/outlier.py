"""Who stands alone: in a scenario's state level, which engines disagree with what all the others say.

No answer is compared again: two engines that are each within their bound of one truth are within both
bounds of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from plumbline.judging.rows import Row, Verdict


def annotate_outliers(rows: Sequence[Row]) -> list[Row]:
    """A scenario's rows, those that disagree at state level with the outlier named after their diagnosis."""
    sentence = describe_outliers(rows)
    return [
        replace(row, diagnosis="; ".join(filter(None, (row.diagnosis, sentence))))
        if is_state_disagreement(row)
        else row
        for row in rows
    ]


def describe_outliers(rows: Sequence[Row]) -> str:
    """The outliers among a scenario's rows, in what, and who agrees; "" where nothing disagrees."""
    wrong: dict[str, list[str]] = {}
    for row in filter(is_state_disagreement, rows):
        wrong.setdefault(row.engine, []).append(row.quantity.replace("_", " "))
    if not wrong:
        return ""
    disputed = {row.quantity for row in rows if is_state_disagreement(row)}
    right = [row for row in rows if row.level == "state" and row.verdict == Verdict.AGREES]
    agree = list(dict.fromkeys(r.engine for r in right if r.quantity in disputed and r.engine not in wrong))
    certified = any("truth: certified" in row.derivation for row in rows)
    truth = "the certified truth" if certified else "the reference, which is the truth here"
    who = "; ".join(f"{engine} in {join_words(quantities)}" for engine, quantities in wrong.items())
    if not any(certified or not engine.startswith("reference") for engine in agree):  # the notes' columns
        doubt = "" if certified else ", so that it may be the one that is wrong"
        return f"no one to side with: {who}; no other engine agrees with {truth}{doubt}"
    each = " and, within both their bounds, with each other" if len(agree) > 1 else ""
    verb = "agree" if len(agree) > 1 else "agrees"
    return f"outlier{'s' if len(wrong) > 1 else ''}: {who}; {join_words(agree)} {verb} with {truth}{each}"


def is_state_disagreement(row: Row) -> bool:
    """Whether a row disagrees at state level."""
    return row.level == "state" and row.verdict == Verdict.DISAGREES


def join_words(words: Sequence[str]) -> str:
    """Words in a row: a, b and c."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
