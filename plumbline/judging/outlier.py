"""Outliers: which engines of a scenario disagree at state level, and which others agree with the truth.

Answers are not compared again: two engines that are each within their bound of one truth are within the sum
of both bounds of each other.  Where no engine agrees, the outlier may be the truth (`doubt_truth`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

from plumbline.diagnosis.cause import join_words
from plumbline.judging.rows import Deviation, Level, Row, Verdict
from plumbline.judging.state_level import STATE_UNITS, VARIANT_QUANTITIES
from plumbline.model.grouping import grouped
from plumbline.model.invariants import INVARIANT_UNITS, LIMITS, LONG_RUN_QUANTITIES

# What is compared with the truth; steps are with each method's formula, relations with the engine itself.
# The true drift of an invariant is 0; energies and work of all engines' motions are computed here.
COMPARED_WITH_TRUTH: Mapping[Level, frozenset[str]] = {
    "state": frozenset(STATE_UNITS),
    "trajectory": frozenset(LIMITS),
    "invariants": frozenset(INVARIANT_UNITS) | LONG_RUN_QUANTITIES,
}
MIN_FAMILIES = 2  # independent engines against the truth, whose answers agree with each other
ENOUGH_FAMILIES = 3  # the same, whether they agree with each other or not


def doubt_truth(
    rows: Sequence[Row],
    deviations: Mapping[str, Deviation],
    family_of: Callable[[str], str],
    defines_truth: str = "",
) -> list[Row]:
    """Find the quantities in which all engines stand on one side against the truth: the harness is in doubt.

    Of a quantity count the rows that were decided and that no known issue explains.  None may agree, and they
    are of two independent engines or more which agree with each other, or of three or more: that each has a
    mistake of its own is less likely than one in the truth, in its bound, or in what all adapters share.

    Args:
        rows: all rows of one scenario, known issues marked.
        deviations: of rows that disagree at state and trajectory level, by their keys.
        family_of: what an engine is a formulation or version of; those of one family may share a mistake.
        defines_truth: the family whose answers are the truth where nothing is certified, which is no witness.

    Returns:
        The rows in the same order; where the harness is in doubt, the verdict says so.

    """
    decided = (
        row
        for row in rows
        if row.quantity in COMPARED_WITH_TRUTH.get(row.level, ())
        and row.verdict in (Verdict.AGREES, Verdict.DISAGREES)
        and row.known_issue is None
    )
    doubtful: dict[tuple[str, str], str] = {}
    for compared, some in grouped(decided, lambda row: (row.level, row.quantity)).items():
        families = {row.engine: family_of(row.engine) for row in some}
        witnesses = [row for row in some if families[row.engine] != defines_truth]
        against = {families[row.engine] for row in witnesses}
        if len(against) < MIN_FAMILIES or any(row.verdict == Verdict.AGREES for row in witnesses):
            continue
        are_alike = all(
            one.key in deviations and deviations[one.key].is_like(deviations[other.key])
            for one, other in combinations(witnesses, 2)
            if families[one.engine] != families[other.engine]
        )
        if are_alike or len(against) >= ENOUGH_FAMILIES:
            doubtful[compared] = _describe_doubt(witnesses, are_alike)
    return [
        replace(
            row,
            verdict=Verdict.HARNESS_FAILED,
            reason=doubt,
            diagnosis="; ".join(filter(None, (row.reason, row.diagnosis))),
        )
        if (doubt := doubtful.get(_truth_of(row)))
        and row.verdict == Verdict.DISAGREES
        and row.known_issue is None
        else row
        for row in rows
    ]


def _truth_of(row: Row) -> tuple[str, str]:
    """Level and quantity of the truth that a row is compared with."""
    is_variant = row.level == "surface" and row.quantity in VARIANT_QUANTITIES
    return ("state", VARIANT_QUANTITIES[row.quantity]) if is_variant else (row.level, row.quantity)


def _describe_doubt(rows: Sequence[Row], are_alike: bool) -> str:
    names = join_words(list(dict.fromkeys(row.engine for row in rows)))
    ratios = [row.ratio or 0.0 for row in rows]
    alike = ", and agree with each other" if are_alike else ""
    return (
        f"{rows[0].scenario}, {rows[0].level}: all engines that were compared ({names}) differ from the "
        f"truth in {rows[0].quantity}, by {min(ratios):.2g} to {max(ratios):.2g} times the bound"
        f"{alike}: suspect the truth, its bound or what the adapters share first"
    )


def annotate_outliers(rows: Sequence[Row], is_certified: bool) -> list[Row]:
    """Append the outliers to the diagnosis of every row that disagrees at state level.

    Args:
        is_certified: whether the truth at the states is.

    Returns:
        The rows, in the same order.

    """
    sentence = describe_outliers(rows, is_certified)
    return [
        replace(row, diagnosis="; ".join(filter(None, (row.diagnosis, sentence))))
        if _is_state_disagreement(row)
        else row
        for row in rows
    ]


def describe_outliers(rows: Sequence[Row], is_certified: bool) -> str:
    """Describe the engines that disagree at state level, in which quantities, and those that agree.

    Args:
        is_certified: whether the truth at the states is.

    Returns:
        The end of a sentence; "" where nothing disagrees.

    """
    wrong = grouped(filter(_is_state_disagreement, rows), lambda row: row.engine)
    if not wrong:
        return ""
    disputed = {row.quantity for some in wrong.values() for row in some}
    right = [row for row in rows if row.level == "state" and row.verdict == Verdict.AGREES]
    agree = list(dict.fromkeys(r.engine for r in right if r.quantity in disputed and r.engine not in wrong))
    truth = "the certified truth" if is_certified else "the reference, which is the truth here"
    outliers = "; ".join(
        f"{engine} in {join_words([row.quantity.replace('_', ' ') for row in some])}"
        for engine, some in wrong.items()
    )
    if not set(agree) - (set() if is_certified else {"reference"}):
        doubt = "" if is_certified else ", and the truth is not certified: it may itself be wrong"
        return f"{outliers}: no other engine agrees with {truth}{doubt}"
    noun, verb, each = ("outliers" if len(wrong) > 1 else "outlier"), "agrees", ""
    if len(agree) > 1:
        verb, each = "agree", " and, within the sum of their bounds, with each other"
    return f"{noun}: {outliers}; {join_words(agree)} {verb} with {truth}{each}"


def _is_state_disagreement(row: Row) -> bool:
    return row.level == "state" and row.verdict == Verdict.DISAGREES
