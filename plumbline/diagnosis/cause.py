"""What a diagnosis returns: causes as records, and the one place where sentences are made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

CauseKind = Literal["number", "term", "output", "frame", "method", "rounding", "refusal", "unexplained"]
FACTORS = {0.0: "missing", 2.0: "doubled", 0.5: "halved", -1.0: "reversed"}
CHANGES = {"missing": "were missing", "doubled": "were doubled", "halved": "were halved",
           "reversed": "had the opposite sign"}  # fmt: skip


@dataclass(frozen=True)
class Condition:
    """What steps of a run that differ have in common: bounds of a quantity, or a period of their numbers."""

    quantity: str  # step, angle of joint 2, turn of joint 1, angular velocity of body 3, …
    unit: str = ""
    least: float | None = None
    most: float | None = None
    period: int = 0  # 1: every step


@dataclass(frozen=True)
class Occurrence:
    """Which steps of a run differ from the declared one."""

    first_step: int  # from 1
    time: float  # s, where it starts
    steps: int  # that differ
    compared: int
    # each describes all steps that differ and, but for exceptions among those that agree, no others; several
    # that the motion does not distinguish
    conditions: tuple[Condition, ...] = ()
    exceptions: int = 0


@dataclass(frozen=True)
class Cause:
    """One change by which an engine would return what it returned.

    A number has an amount in place of the nominal one, in a unit, or a factor where the unit is "×"; terms,
    outputs and frames have a change in words, and an amount where it is not 0, 1, 2 or −1 times.
    """

    kind: CauseKind
    term: str  # mass, velocity term, joint reaction, attitude, …
    place: str = ""  # body 2, joint 3 x, all springs, bodies 3 to 8; empty where there is one only
    change: str = ""  # missing, doubled, reversed, "in the body frame", …
    amount: tuple[float, ...] = ()
    nominal: tuple[float, ...] = ()
    unit: str = ""
    uncertainty: float = 0.0  # of the amount, by what the evidence leaves
    left: float | None = None  # evidence: largest difference that is left, in rounding bounds
    states: int = 0  # at so many states
    quantities: tuple[str, ...] = ()  # that it is about; empty: all that are wrong
    needs: tuple[str, ...] = ()  # of what is unexplained: without one of them the difference vanishes
    general: str = ""  # the term, or of an output the change, without a place that is in its words
    equal: tuple[Cause, ...] = ()  # causes from which the data cannot distinguish it
    occurrence: Occurrence | None = None  # in a run that is compared step by step

    @property
    def is_explained(self) -> bool:
        """Whether it says what the engine does."""
        return self.kind not in ("unexplained", "rounding", "refusal")

    @property
    def is_in_words(self) -> bool:
        """Whether it is a change without a fitted amount, which explains nothing by chance."""
        return bool(self.change) and (self.kind != "output" or not self.amount)

    @property
    def identity(self) -> tuple[str, str, str]:
        """What two rows with the same cause have in common: all but place, digits and evidence."""
        if self.kind == "output":
            return self.kind, self.term, self.general or self.change
        return self.kind, self.general or self.term, self.change

    def with_amount(self, amount: np.ndarray, uncertainty: float) -> Cause:
        """State a fitted amount: as a factor in words where it is one, else with the digits that it has.

        Of what has a change in words it stands there in place of braces.
        """
        given = tuple(float(x) for x in amount)
        if not self.change and len(given) == 1 and (self.unit == "×" or self.nominal[0]):
            size = abs(self.nominal[0])
            for factor, change in FACTORS.items():
                if abs(given[0] - factor * self.nominal[0]) <= max(uncertainty, 1e-9 * size):
                    return replace(self, change=change, amount=(factor * self.nominal[0],))
        digits = [significant(x, near, uncertainty) for x, near in zip(given, self.nominal, strict=True)]
        change = self.change.format(*(f"{x:.15g}" for x in digits))
        return replace(self, change=change, amount=tuple(digits), uncertainty=uncertainty)


@dataclass(frozen=True)
class Diagnosis:
    """What is known about the cause of a disagreement."""

    causes: tuple[Cause, ...] = ()  # together they explain it
    scatter: float | None = None  # of the error over its size, where it was measured

    @property
    def text(self) -> str:
        """The sentence."""
        return describe(self.causes)


def significant(x: float, near: float, uncertainty: float) -> float:
    """Round to the fewest digits within the uncertainty, but three of the difference from another number."""
    allowed = max(min(uncertainty, 1e-3 * abs(x - near)), 1e-15 * abs(x))
    if abs(x) <= uncertainty:
        return 0.0
    for digits in range(1, 16):
        if abs(float(f"{x:.{digits}g}") - x) <= allowed:
            return float(f"{x:.{digits}g}")
    return x


def describe(causes: Sequence[Cause]) -> str:
    """Make the sentence of causes that act together."""
    named = [cause for cause in causes if cause.is_explained]
    parts = ["behaves as if " + "; and ".join(_with_equal(cause) for cause in named)] if named else []
    parts += [_describe_other(cause) for cause in causes if not cause.is_explained]
    left = [cause.left for cause in named if cause.left is not None]
    if left and not parts[1:]:
        parts.append(f"this explains the difference to {max(left):.2g} of the rounding bound")
    where = [cause.occurrence for cause in causes if cause.occurrence is not None]
    return "; ".join(parts + [_describe_occurrence(one) for one in where[:1]])


def _describe_occurrence(where: Occurrence) -> str:
    words = f"first in step {where.first_step} of a run (t = {where.time:.6g} s), in {where.steps} of "
    words += f"{where.compared} steps"
    if not where.conditions:
        return f"{words}, which no range of time, position or rate separates from the others"
    conditions = [_describe_condition(one) for one in where.conditions]
    return f"{words}: {' or, which the data cannot distinguish, '.join(conditions)}"


def _describe_condition(one: Condition) -> str:
    if one.period:
        return "every step" if one.period == 1 else f"one in {one.period}"
    if one.quantity == "step":
        if one.least == one.most:
            return f"step {one.least:.0f}"
        upto = "on" if one.most is None else f"to step {one.most:.0f}"
        return f"from step {one.least:.0f} {upto}"
    above = "" if one.least is None else f" above {one.least:.15g}{one.unit}"
    below = "" if one.most is None else f" below {one.most:.15g}{one.unit}"
    return f"{one.quantity}{above}{' and' * bool(above and below)}{below}"


def _with_equal(cause: Cause) -> str:
    others = "; ".join(describe_cause(one) for one in cause.equal)
    return describe_cause(cause) + (f"; the data cannot distinguish this from: {others}" if others else "")


def _describe_other(cause: Cause) -> str:
    if cause.kind == "rounding":
        return f"the {cause.term} {cause.change}"
    if cause.kind == "refusal":
        return f"no diagnosis: {cause.change}"
    if cause.change == "close":
        return f"the difference of the {cause.term} is too close to the rounding bound to name a cause"
    tried = cause.change or "no number, term, frame or output, and no two of them,"
    needs = f"; its difference vanishes without {join_words(cause.needs, 'or')}" if cause.needs else ""
    return f"{tried} explains the {cause.term}{needs}"


def quantity_words(quantities: Sequence[str]) -> str:
    """Name quantities in a sentence."""
    return " and ".join(quantity.replace("_", " ") for quantity in quantities)


def join_words(words: Sequence[str], last: str = "and") -> str:
    """Join words to a list in a sentence."""
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def describe_cause(cause: Cause) -> str:
    """Complete "behaves as if …"."""
    if cause.kind == "method":
        return cause.change + (f" in the {cause.term}" if cause.term == "quadrature alone" else "")
    subject = f"the {cause.term}" + (f" of {cause.place}" if cause.place else "")
    if cause.kind == "output":
        return f"it returned {subject} {cause.change}{_amount(cause)}".rstrip()
    if cause.change:
        return f"{subject} {CHANGES.get(cause.change) or 'were ' + cause.change}{_amount(cause)}"
    if cause.unit == "×":
        return f"{subject} were {_vector(cause.amount)} times as large"
    nominal = [significant(x, y, cause.uncertainty) for x, y in zip(cause.nominal, cause.amount, strict=True)]
    return f"{subject} were {_vector(cause.amount)}{cause.unit} instead of {_vector(nominal)}{cause.unit}"


def _amount(cause: Cause) -> str:
    """The amount of what has a change in words."""
    if not cause.amount or cause.change in CHANGES:
        return ""
    return f" {_vector(cause.amount)}{cause.unit}"


def _vector(x: Sequence[float]) -> str:
    numbers = [f"{value:.15g}" for value in x]
    return numbers[0] if len(numbers) == 1 else f"({', '.join(numbers)})"
