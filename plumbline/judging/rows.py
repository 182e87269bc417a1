"""Verdicts, rows and the tables behind them: what judging returns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import numpy as np

from plumbline.engines.no_answer import NoAnswer
from plumbline.model.datatypes import Array, Float

Level = Literal["state", "surface", "step", "invariants", "trajectory", "relations", "model"]
# by level of rows that of a run which compares them; a run of all levels compares the others
LEVEL_OF_RUN: dict[str, Literal["state", "step", "trajectory"]] = {
    "state": "state", "surface": "state", "step": "step",
    "trajectory": "trajectory", "invariants": "trajectory",
}  # fmt: skip
# hash of an answer's bits, by integrator ("-" at states), quantity and resolution ("" at states)
Fingerprints = dict[tuple[str, str, str], bytes]
Columns = dict[str, Any]  # column name → its values (n,), or the one value of all n records


class Verdict(StrEnum):
    """What became of one judged quantity; the values are the words that users read."""

    AGREES = "agrees"
    DISAGREES = "disagrees"
    UNRESOLVED = "unresolved"
    UNSUPPORTED = "unsupported"
    NOT_INSTALLED = "not installed"
    FAILED = "failed"
    HARNESS_FAILED = "harness failed"
    INFORMATION = "information"  # implied by other rows, or not compared: it cannot fail by itself

    @property
    def is_comparison(self) -> bool:
        """Whether a row with this verdict compared something and could have disagreed by itself."""
        return self in (Verdict.AGREES, Verdict.DISAGREES, Verdict.UNRESOLVED)

    @property
    def needs_attention(self) -> bool:
        """Whether a row with this verdict needs attention where no known issue expects it."""
        return self.style.severity >= ATTENTION_SEVERITY

    @property
    def style(self) -> VerdictStyle:
        """How terminal and report show this verdict."""
        return VERDICT_STYLES[self]


def most_wrong_call(ratios: Mapping[str, float]) -> str:
    """Return the first by name of the calls that are off by about as much as the worst: of one cause."""
    worst = max(ratios.values())
    return min(call for call, ratio in ratios.items() if ratio >= SAME_SIZE * worst)


def with_unit(size: float, unit: str, digits: int = 2) -> str:
    """Return a size in its unit, in words; a number without a dimension has none."""
    return f"{size:.{digits}g}" if unit == "1" else f"{size:.{digits}g} {unit}"


class VerdictStyle(NamedTuple):
    """How a verdict is shown and ranked."""

    glyph: str
    plural: str  # the word after a count: "3 disagree"
    meaning: str  # short, for legends
    severity: int  # 10 (worst) … 0, where no known issue expects the verdict; from 6 on it needs attention
    known_severity: int  # the same where a known issue expects the verdict
    singular: str = ""  # the word after a count of one, where it is another one: "1 disagrees"

    def counted(self, count: int) -> str:
        """Return the word after a count."""
        return self.singular if self.singular and count == 1 else self.plural


VERDICT_STYLES = {
    Verdict.HARNESS_FAILED: VerdictStyle(
        "☒", "without a truth", "the truth is in doubt or missing: the engine is not judged", 10, 10
    ),
    Verdict.DISAGREES: VerdictStyle(
        "✗", "disagree", "the error is above its derived tolerance", 8, 5, "disagrees"
    ),
    Verdict.FAILED: VerdictStyle(
        "!", "failed", "raised, crashed, timed out, ran out of memory or was not finite", 9, 5
    ),
    Verdict.UNRESOLVED: VerdictStyle("?", "unresolved", "the data cannot decide", 7, 3),
    Verdict.UNSUPPORTED: VerdictStyle("–", "unsupported", "the engine cannot do this", 6, 2),
    Verdict.NOT_INSTALLED: VerdictStyle("∅", "not installed", "the engine is not on this machine", 1, 1),
    Verdict.AGREES: VerdictStyle("✓", "agree", "the error is within its derived tolerance", 4, 4, "agrees"),
    Verdict.INFORMATION: VerdictStyle(
        "i", "are information", "implied by other rows, or not compared: not a check", 0, 0, "is information"
    ),
}
SAME_SIZE = 0.1  # of the worst call's error: within a decade
WRONG_CALL = "wrong_call"  # in ``extra`` of a row: of the engine's calls, that of `most_wrong_call`
FAILED_CALLS = "failed_calls"  # the same: all that failed or are off, one per line
OWN_UNCERTAINTY = "own_uncertainty"  # the same, of one that is unresolved by what the engine states itself
PLACE = "place"  # the same, of one that failed or was refused: class and place of what was raised
CHECKED = "checked"  # the same: what was checked of it where its diagnosis is a record's; may be empty
RUN_FAMILY = "run"  # of a row that is about the whole run, in place of a scenario's family
RECORDED = "recorded"  # what terminal and report show for a disagreement or failure that is recorded
SHOWN_STYLES: dict[str, VerdictStyle] = {
    **{str(verdict): style for verdict, style in VERDICT_STYLES.items()},
    RECORDED: VerdictStyle(
        "≠", "recorded", "a disagreement or failure as known_issues.yaml records it", 5, 5
    ),
}
ATTENTION_SEVERITY = 6  # from here on a verdict needs attention


def shown_verdict(verdict: str, known_issue: str | None) -> str:
    """Return what a row is shown as: a recorded disagreement is neither agreement nor a new disagreement.

    Args:
        verdict: a value of `Verdict`.
        known_issue: id of the entry of known_issues.yaml that expects the verdict, or None.

    Returns:
        A key of `SHOWN_STYLES`: the verdict, or `RECORDED`.

    """
    return RECORDED if known_issue and verdict in (Verdict.DISAGREES, Verdict.FAILED) else str(verdict)


def severity(verdict: str, known_issue: str | None) -> int:
    """Rank a verdict for the summary of several rows in one cell.

    Unexpected failures come first, then recorded disagreements, then agreement, then expected gaps.

    Args:
        verdict: a value of `Verdict`.
        known_issue: id of the entry of known_issues.yaml that expects the verdict, or None.

    Returns:
        10 (the harness failed) … 0 (information); from `ATTENTION_SEVERITY` on nothing expects it.

    """
    style = VERDICT_STYLES[Verdict(verdict)]
    return style.known_severity if known_issue else style.severity


def cell_rank(verdict: str, known_issue: str | None, ratio: float | None) -> tuple[int, float]:
    """Return the sort key whose maximum over a cell's rows is the row that stands for the cell.

    Args:
        verdict: a value of `Verdict`.
        known_issue: id of the entry of known_issues.yaml that expects the verdict, or None.
        ratio: error over tolerance; None where the row has none.

    Returns:
        The severity, then the ratio.

    """
    return severity(verdict, known_issue), -1.0 if ratio is None else ratio


def error_ratio(value: float | None, tolerance: float | None) -> float | None:
    """Divide an error by its tolerance.

    Args:
        value: the error, in the row's unit.
        tolerance: the tolerance, in the same unit.

    Returns:
        The quotient; None where either is missing or not finite, or the tolerance is not positive.

    """
    if value is None or tolerance is None or not (math.isfinite(value) and tolerance > 0):
        return None
    return value / tolerance


@dataclass(frozen=True)
class Row:
    """One judged quantity: the unit of results.json, the pytest ids and the report."""

    scenario: str
    family: str
    engine: str
    engine_version: str
    level: Level
    integrator: str  # "-" for levels without an integrator
    quantity: str
    unit: str
    value: float | None  # the measured error or drift, worst over bodies, states and samples
    tolerance: float | None  # the limit of ``value``, same unit
    verdict: Verdict
    reason: str  # one sentence
    ratio: float | None = None  # error over tolerance, worst over all comparisons of the row
    derivation: str = ""  # of the tolerance, in words and numbers
    uncertainty: float | None = None  # of the truth and of the limit together, same unit
    compared_until: float | None = None  # s, up to which positions were compared
    order: float | None = None  # observed order
    declared_order: int | None = None
    alias_of: str | None = None
    # what expects this verdict: id of an entry of known_issues.yaml, or a gap that the column declares
    known_issue: str | None = None
    is_declared: bool = False  # whether it is such a gap
    diagnosis: str | None = None  # the wrong term, in a sentence
    causes: tuple[dict[str, Any], ...] = ()  # the same as data: of each cause its fields
    user_rtol: float | None = None  # the user's own tolerance, shown beside the verdict
    cpu_time: float = 0.0  # s, of the work behind this row
    extra: dict[str, float | str] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """The row's identity across runs."""
        return "/".join((self.scenario, self.engine, self.level, self.integrator, self.quantity))

    @property
    def engine_name(self) -> str:
        """The engine without a version."""
        return self.engine.partition("@")[0]

    @property
    def style(self) -> VerdictStyle:
        """How the row is shown."""
        return SHOWN_STYLES[shown_verdict(self.verdict, self.known_issue)]

    @property
    def rank(self) -> tuple[int, float]:
        """The row's `cell_rank`."""
        return cell_rank(self.verdict, self.known_issue, self.ratio)


@dataclass(frozen=True)
class RowContext:
    """Scenario and engine of the rows of one cell."""

    scenario: str
    family: str
    engine: str
    title: str
    version: str

    def make_row(
        self,
        level: Level,
        integrator: str,
        quantity: str,
        verdict: Verdict,
        reason: str,
        unit: str = "1",
        gap: str = "",
        place: str = "",
        **more: Any,
    ) -> Row:
        """Make a row about this scenario and engine.

        Args:
            integrator: name of the integrator, "-" for none.
            verdict: one of `Verdict`.
            reason: the verdict's reason, one sentence.
            unit: unit of ``value`` and ``tolerance``.
            gap: declared by the engine's column, from which a refusal follows; it is expected then.
            place: of the exception behind a failure or refusal.
            **more: other fields of `Row`; numbers may be numpy's, and those of ``extra`` integers. ``ratio``
                is the quotient of ``value`` and ``tolerance`` unless given: of many comparisons the worst
                ratio need not belong to the largest error.

        """
        more = {"value": None, "tolerance": None, "extra": {}} | more
        more |= {name: x.item() for name, x in more.items() if isinstance(x, np.generic)}
        more["extra"] = {name: x if isinstance(x, str) else float(x) for name, x in more["extra"].items()}
        if gap and verdict == Verdict.UNSUPPORTED:
            more |= {"known_issue": gap, "is_declared": True}
        if place and verdict in (Verdict.FAILED, Verdict.UNSUPPORTED):
            more["extra"][PLACE] = place
        if more.get("ratio") is None:
            more["ratio"] = error_ratio(more["value"], more["tolerance"])
        return Row(
            self.scenario, self.family, self.engine, self.version, level, integrator, quantity, unit,
            verdict=verdict, reason=reason, **more,
        )  # fmt: skip

    def make_no_answer_row(
        self, level: Level, integrator: str, quantity: str, found: NoAnswer, before: str = "", **more: Any
    ) -> Row:
        """Make a row of what an engine refused or failed at.

        Args:
            before: words before the engine's own.
            **more: as of `make_row`.

        """
        verdict = Verdict.UNSUPPORTED if found.is_refusal else Verdict.FAILED
        reason, more = before + found.message, more | {"gap": found.gap, "place": found.place}
        return self.make_row(level, integrator, quantity, verdict, reason, **more)


def mark_aliases(rows: Iterable[Row]) -> list[Row]:
    """Turn the agreement of an integrator that equals another one into information.

    Returns:
        The rows in the same order. Only agreement changes: an alias that disagrees or is unresolved where
        the other integrator agrees is not the alias that it was declared to be.

    """
    return [
        replace(
            row, verdict=Verdict.INFORMATION, reason=f"{row.integrator} is {row.alias_of} here: {row.reason}"
        )
        if row.alias_of is not None and row.verdict == Verdict.AGREES
        else row
        for row in rows
    ]


class _Decidable(Protocol):
    @property
    def verdict(self) -> Verdict: ...


_DecidableT = TypeVar("_DecidableT", bound=_Decidable)


def first_decided(candidates: Iterable[_DecidableT]) -> _DecidableT:
    """Return the first of several verdicts on one quantity that is not unresolved.

    Args:
        candidates: at least one; the preferred one, such as that of the longest window of time, comes first.

    Returns:
        The first that is decided; the first of all where none is.

    """
    first: _DecidableT | None = None
    for candidate in candidates:
        if candidate.verdict != Verdict.UNRESOLVED:
            return candidate
        first = first or candidate
    assert first is not None
    return first


@dataclass(frozen=True, eq=False)
class Deviation:
    """By how much an answer that disagrees is off the truth, state by state or sample by sample."""

    vectors: Float[Array, "states n d"]  # answer − truth, in the quantity's unit
    tolerance: Float[Array, "states n"]  # same unit

    def is_like(self, other: Deviation) -> bool:
        """Return whether the two answers agree with each other within the sum of their tolerances.

        Args:
            other: of another engine, for the same quantity.

        Returns:
            Whether they do, wherever both were compared.

        """
        count = min(len(self.vectors), len(other.vectors))
        apart = np.linalg.norm(self.vectors[:count] - other.vectors[:count], axis=-1)
        return bool(np.all(apart <= self.tolerance[:count] + other.tolerance[:count]))


@dataclass
class JudgingResult:
    """Rows, parts of the stored tables behind them, and what identifies the judged answers."""

    rows: list[Row] = field(default_factory=list)
    tables: list[tuple[str, Columns]] = field(default_factory=list)  # name of the stored table, its columns
    fingerprints: Fingerprints = field(default_factory=dict)
    deviations: dict[str, Deviation] = field(default_factory=dict)  # by the key of a row that disagrees

    def has_disagreement(self) -> bool:
        """Find out whether a row disagrees that is diagnosed: those of the surface name a call and are not.

        Returns:
            Whether there is such a row.

        """
        return any(row.verdict == Verdict.DISAGREES and row.level != "surface" for row in self.rows)
