"""Fit the amounts of edits to the difference between an engine and the truth, and prove what they explain.

Edits are screened in the lanes of one batch: by their slopes, and at the amounts of words (missing, doubled,
reversed).  Amounts of those that point along the difference are found by Newton's method, all in one batch,
in units of the rounding bounds.  What is left is evaluated at every state of the difference.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.diagnosis.cause import FACTORS, Cause
from plumbline.diagnosis.edits import LENGTHS, Edit, number_edits
from plumbline.diagnosis.prediction import Answers, Case, Predictor, View, per_entry, tolerances, values_of
from plumbline.diagnosis.readings import change_key, reading_edits
from plumbline.diagnosis.terms import Terms, missing_gammas
from plumbline.model.datatypes import Array, Model, StateQuantities
from plumbline.truth.ground_truth import StateTruth

MIN_DIAGNOSABLE_RATIO = 8.0  # in bounds: of hundreds of fitted causes, some explain less by chance
ACCEPTED_RATIO = 4.0  # in bounds
ACCEPTED_PART = 0.25  # of the difference, where it is small
ACCEPTED_SHARE = 1e-9  # of the difference; evaluating in doubles leaves 1e-10 of it and less
STEP = 1e-5  # of an edit's scale, in slopes
MIN_SIMILARITY = 0.3  # cosine between the difference and an edit's slope, to be fitted at all
MAX_CANDIDATES = 24
MAX_PAIRS = 48
MAX_STEPS = 12
MIN_SIGNIFICANT = 3.0  # an amount must differ from its nominal by this many times its resolution
MIN_PROGRESS = 0.9  # of what is left, in a step
MAX_HALVINGS = 4
MAX_STARTS = 8
RANK_TOLERANCE = 1e-9  # of slopes: a direction that changes nothing
MIN_RATIO_OF_VECTORS = 100.0  # in bounds: three numbers explain a smaller difference by chance
QUARTER_TURNS = [  # rotation vectors of the turns of a cube, half turns twice
    angle * np.array(axis) / np.linalg.norm(axis)
    for axis in itertools.product((-1, 0, 1), repeat=3)
    for angle in ((), (np.pi / 2, np.pi), (np.pi,), (2 * np.pi / 3,))[np.count_nonzero(axis)]
]
Mask = NDArray[np.bool_]


Combination = tuple[Edit, ...]
Lane = tuple[Combination, Array]  # edits with their amounts


class Difference:
    """How an engine differs from the truth at some states, and effects of edits, in bounds."""

    def __init__(
        self,
        model: Model,
        reported: Sequence[StateQuantities],
        truth: StateTruth,
        view: View,
        places: Sequence[int],
    ) -> None:
        """Compare at the states of some places."""
        given, true = ([x[i] for i in places] for x in (reported, truth.quantities))
        self.names = [q for q in view.quantities if all(getattr(x, q) is not None for x in (*given, *true))]
        self.true = {q: values_of(true, q) for q in self.names}
        self.quantity = np.repeat(self.names, [x.size for x in self.true.values()])
        states = [np.repeat(range(len(places)), x.size // len(places)) for x in self.true.values()]
        self.state = np.concatenate(states)
        self.given = {q: values_of(given, q) for q in self.names}
        self.bounds = {q: tolerances([truth.bounds[i] for i in places], q, given) for q in self.names}
        each = {q: np.broadcast_to(per_entry(self.bounds[q], x), x.shape) for q, x in self.true.items()}
        self.weight = self._flat(each)
        self.values = self.off(self.given)
        self.view, self.model = view, model
        self.predictor = Predictor(model, [truth.states[i] for i in places], view)

    @property
    def is_predictable(self) -> bool:
        """Whether the prediction without a mistake is the truth: else it says nothing of other numbers.

        An engine in maximal coordinates is predicted by the reference's rows, which may be what is wrong;
        what a term of them would change it says all the same.
        """
        return bool(np.all(np.abs(self.off(self.predictor.right)) <= self.accepted(self.everything)))

    @property
    def everything(self) -> Mask:
        """A mask of all quantities."""
        return np.ones(len(self.values), bool)

    def of(self, quantities: Iterable[str]) -> Mask:
        """Return the mask of some quantities."""
        return np.isin(self.quantity, list(quantities))

    def accepted(self, mask: Mask) -> float:
        """Return what may be left of the difference, in bounds."""
        size = float(np.max(np.abs(self.values[mask]), initial=0.0))
        return max(min(ACCEPTED_RATIO, ACCEPTED_PART * size), ACCEPTED_SHARE * size)

    def off(self, answers: Answers) -> Array:
        """Return how quantities (S, …) differ from the truth, (m,) in bounds."""
        return np.asarray((self._flat(answers) - self._flat(self.true)) / self.weight)

    def _flat(self, answers: Answers, lead: int = 0) -> Array:
        """(…, m) of quantities (…, S, …), of so many axes before that of the states."""
        each = [answers[q].reshape(*answers[q].shape[:lead], -1) for q in self.names]
        return np.concatenate(each, axis=-1)

    def flat_vectors(self, answers: Answers) -> Array:
        """Return changes of vectors (S, …) as an effect (m,); the sums do not change."""
        zeros = {name: 0 * x for name, x in self.predictor.right.items()}
        return self._flat(zeros | answers)

    @cached_property
    def terms(self) -> list[Edit]:
        """Edits of terms of the equations."""
        changes = list[tuple[Cause, Answers]]()
        if self.view == View():
            terms = Terms(self.predictor)
            changes += [*terms.linear(), *terms.fixed()]
        elif self.view.are_bodies_kept:
            changes += missing_gammas(self.predictor)
        return [Edit(cause, effect=self.flat_vectors(change)) for cause, change in changes]

    def evaluate(self, lanes: Sequence[Lane]) -> Array:
        """Return the effects of combinations of candidates with their amounts, (lanes, m) in bounds."""
        return self.effects(lanes) / self.weight

    def effects(self, lanes: Sequence[Lane]) -> Array:
        """Return the same in the units of the quantities, also of those whose bound is 0."""
        linear = np.zeros((len(lanes), len(self.values)))
        with np.errstate(all="ignore"):
            cases = [changed(self.predictor.case, *lane) for lane in lanes]
        for i, lane in enumerate(lanes):
            for one, own in _split(*lane):
                if one.effect is not None:
                    linear[i] += one.effect * (own[0] - one.nominal[0] if len(own) else 1.0)
        others = [i for i, case in enumerate(cases) if case is not self.predictor.case]
        if others:
            answers = self.predictor.predict([cases[i] for i in others])
            linear[others] += self._flat(answers, 1) - self._flat(self.predictor.right)
        return linear


@dataclass(frozen=True, eq=False)
class Explanation:
    """Edits with amounts that leave little of a difference."""

    combination: Combination
    amounts: Array
    uncertainty: Array
    left: float

    def causes(self, states: int) -> tuple[Cause, ...]:
        """State the causes with their amounts and evidence."""
        found = list[Cause]()
        for one, x, uncertainty in _split(self.combination, self.amounts, self.uncertainty):
            cause = one.cause.with_amount(x, float(np.max(uncertainty))) if len(x) else one.cause
            found.append(replace(cause, left=self.left, states=states))
        return tuple(found)

    def mechanism(self, right: Case) -> object:
        """Return a key that is equal for explanations by the same mechanism; linear terms describe none."""
        if any(one.change is None for one in self.combination):
            return id(self)
        return change_key(changed(right, self.combination, self.amounts), right)


def _split(combination: Combination, *arrays: Array) -> Iterator[tuple[Any, ...]]:
    """Edits with their own numbers of each array."""
    ends = np.cumsum([len(one.cause.nominal) for one in combination])
    for one, end in zip(combination, ends, strict=True):
        yield one, *(x[end - len(one.cause.nominal) : end] for x in arrays)


def changed(case: Case, combination: Combination, x: Array) -> Case:
    """Return a case with the changes of edits; those that have an effect alone change nothing of it."""
    for one, own in _split(combination, x):
        if one.change is not None:
            case = one.change(case, own)
    return case


def most_similar(slopes: Array, wanted: Array, least: float, most: int) -> list[int]:
    """Return which slopes (k, m) point along a difference (m,): the most similar ones first."""
    with np.errstate(all="ignore"):
        size = np.linalg.norm(slopes, axis=1) * np.linalg.norm(wanted)
        cosine = np.nan_to_num(np.abs(slopes @ wanted) / np.maximum(size, 1e-300))
    return [int(i) for i in np.argsort(-cosine, kind="stable")[:most] if cosine[i] > least]


def fit_amounts(
    evaluate: Callable[[Sequence[Lane]], Array],
    wanted: Array | float,
    accepted: float,
    starts: Sequence[Lane],
) -> list[Explanation]:
    """Fit amounts by Newton's method in one batch; keep combinations that leave what is accepted."""
    fits = [_Fit(*start) for start in starts]
    for _ in range(MAX_STEPS):
        active = [one for one in fits if one.is_active]
        if not active:
            break
        lanes = [lane for one in active for lane in one.lanes()]
        effects, first = evaluate(lanes), 0
        for one in active:
            count = 1 + len(one.x)
            one.advance(wanted, effects[first : first + count], accepted)
            first += count
    return [found for one in fits if (found := one.result(accepted)) is not None]


def _edits(difference: Difference) -> Iterator[Edit]:
    """The table of numbers and readings of a view."""
    model, case = difference.model, difference.predictor.case
    if difference.view == View():
        yield from number_edits(case)
        yield from reading_edits(case)
    else:  # other numbers act as in joint coordinates, and without loops all do
        lengths = (one for one in number_edits(case) if one.cause.unit in LENGTHS)
        yield from (one for one in lengths if model.has_loops or len(one.nominal) > 1)


class Search:
    """All candidates of a view, screened against a difference."""

    def __init__(self, difference: Difference, *, of_terms_alone: bool = False) -> None:
        """List the candidates, or terms alone, and evaluate their slopes and whole effects."""
        self.difference = difference
        every = [*(() if of_terms_alone else _edits(difference)), *difference.terms]
        self.fixed, self.numbers, self.vectors = (
            [one for one in every if len(one.nominal) == count] for count in (0, 1, 3)
        )
        steps = [one.nominal + STEP * one.scale for one in self.numbers]
        slopes = difference.evaluate([((one,), x) for one, x in zip(self.numbers, steps, strict=True)])
        scales = np.array([STEP * one.scale for one in self.numbers]).reshape(-1, 1)
        self.slopes = np.where(np.isfinite(slopes), slopes, 0.0) / scales
        # of numbers that may vanish the amounts of words
        words = [factor for factor in FACTORS if factor != 0.5 and difference.view == View()]
        can_vanish = [one for one in self.numbers if one.can_vanish and one.nominal[0]]
        self.whole = [((one,), factor * one.nominal) for one in can_vanish for factor in words]
        self.whole += [((one,), one.nominal) for one in self.fixed]
        self.effects = difference.evaluate(self.whole)

    def explain(self, mask: Mask) -> list[Explanation]:
        """Return every single cause that explains the difference of some quantities."""
        wanted, accepted = self.difference.values[mask], self.difference.accepted(mask)
        with np.errstate(all="ignore"):
            left = np.max(np.abs(self.effects[:, mask] - wanted), axis=1)
        found = [
            Explanation(*self.whole[i], np.zeros(len(self.whole[i][1])), float(left[i]))
            for i in np.flatnonzero(left <= accepted)
        ]
        known = {id(one.combination[0]) for one in found}
        order = most_similar(self.slopes[:, mask], wanted, MIN_SIMILARITY, MAX_CANDIDATES)
        starts = [
            ((self.numbers[i],), self.numbers[i].start) for i in order if id(self.numbers[i]) not in known
        ]
        fits = self.fit(starts, mask)
        order_of = {id(one): i for i, one in enumerate((*self.numbers, *self.fixed))}
        # what has words, as missing, before fitted amounts
        key = lambda one: (bool(np.any(one.uncertainty)), order_of[id(one.combination[0])])  # noqa: E731
        right, every = self.difference.predictor.case, sorted(found + fits, key=key)
        by_numbers = {one.mechanism(right) for one in every if one.amounts.size}
        # a reading that makes the same mechanism as a number is no other cause
        return [one for one in every if one.amounts.size or one.mechanism(right) not in by_numbers]

    def fit(self, starts: Sequence[Lane], mask: Mask) -> list[Explanation]:
        """Fit amounts to the difference of some quantities."""
        wanted, accepted = self.difference.values[mask], self.difference.accepted(mask)
        return fit_amounts(lambda lanes: self.difference.evaluate(lanes)[:, mask], wanted, accepted, starts)

    def explain_by_vectors(self, mask: Mask) -> list[Explanation]:
        """Return every cause of three numbers that explains the difference of some quantities."""
        difference, wanted = self.difference, self.difference.values[mask]
        if np.max(np.abs(wanted), initial=0.0) < MIN_RATIO_OF_VECTORS:
            return []
        if not (every := self.vectors):
            return []
        lanes = [((one,), one.nominal + STEP * one.scale * e) for one in every for e in np.eye(3)]
        slopes = difference.evaluate(lanes)[:, mask].reshape(len(every), 3, -1).mT
        slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        shares = np.matvec(np.linalg.pinv(slopes, RANK_TOLERANCE), wanted)
        left = np.linalg.norm(np.matvec(slopes, shares) - wanted, axis=1)
        starts = [((every[i],), every[i].nominal) for i in np.argsort(left)[:MAX_STARTS]]
        found = self.fit(starts, mask)
        if not found and not difference.model.has_loops:
            turns = [((one,), x) for one in every if one.cause.unit == " rad" for x in QUARTER_TURNS]
            effects = difference.evaluate(turns)[:, mask]
            left = np.nan_to_num(np.linalg.norm(effects - wanted, axis=1), nan=np.inf)
            found = self.fit([turns[i] for i in np.argsort(left)[: 2 * MAX_STARTS]], mask)
        return list({id(one.combination[0]): one for one in found}.values())

    def explain_by_pairs(self, mask: Mask) -> list[Explanation]:
        """Return pairs that explain the difference together, of those whose effects span most of it."""
        wanted = self.difference.values[mask]
        every = [*(((one,), one.nominal) for one in self.numbers), *self.whole]
        columns = np.concatenate([self.slopes, self.effects])[:, mask]
        size = np.linalg.norm(columns, axis=1)
        scales = np.array([*(one.scale for one in self.numbers), *(1.0 for _ in self.whole)])
        seen = np.flatnonzero(np.isfinite(size) & (size * scales > 1.0))
        units = columns[seen] / size[seen, None]
        along, gram = units @ wanted, units @ units.T
        with np.errstate(all="ignore"):
            gain = (along[:, None] ** 2 + along**2 - 2 * gram * along[:, None] * along) / (1 - gram**2)
        gain = np.triu(np.where(np.abs(gram) < 1 - 1e-9, gain, 0.0), 1)
        starts = list[Lane]()
        for i, j in zip(*np.unravel_index(np.argsort(-gain, axis=None)[:MAX_PAIRS], gain.shape), strict=True):
            (one, x), (other, y) = every[seen[i]], every[seen[j]]
            if one != other:
                starts.append((one + other, np.concatenate([x, y])))
        return self.fit(starts, mask)


class _Fit:
    """Newton's method for the amounts of one combination."""

    def __init__(self, combination: Combination, start: Array) -> None:
        self.combination, self.x, self.is_active = combination, np.asarray(start, float), True
        scales = [np.full(len(one.cause.nominal), one.scale) for one in combination]
        self.scale: Array = np.concatenate(scales)
        self.length, self.left, self.halvings = np.inf, np.inf, 0
        self.step = np.zeros_like(self.x)
        self.resolution = np.full(len(self.x), np.inf)

    def lanes(self) -> list[Lane]:
        """The amounts, and those beside them for slopes."""
        beside = self.x + STEP * np.diag(self.scale)
        return [(self.combination, self.x), *((self.combination, x) for x in beside)]

    def advance(self, wanted: Array | float, effects: Array, accepted: float) -> None:
        """Go one step on, or half of the last step back."""
        with np.errstate(all="ignore"):
            off = wanted - effects[0]
            length = float(np.linalg.norm(off))
        if not len(self.x):
            self.left, self.is_active = float(np.max(np.abs(off))), False
            return
        if not np.isfinite(length) or (length > MIN_PROGRESS * self.length and self.left > accepted):
            self.halvings += 1
            self.x = self.x - self.step / 2
            self.step = self.step / 2
            self.is_active = self.halvings <= MAX_HALVINGS and np.isfinite(self.length)
            return
        if length >= self.length:  # it explains already, and rounding is left
            self.x, self.is_active = self.x - self.step, False
            return
        self.length, self.left, self.halvings = length, float(np.max(np.abs(off))), 0
        slopes = (effects[1:] - effects[0]).T / (STEP * self.scale)
        size = np.linalg.norm(slopes, axis=0)
        if not np.all((size > 0) & np.isfinite(size)):
            self.is_active = False
            return
        inverse = np.linalg.pinv(slopes / size, RANK_TOLERANCE) / size[:, None]
        self.resolution = np.linalg.norm(inverse, axis=1)
        self.step = inverse @ off
        if np.all(np.abs(self.step) < 0.1 * self.resolution):
            self.is_active = False
            return
        self.x = self.x + self.step
        first = self.combination[0]  # of two that have opposite signs the other one goes on
        self.is_active = bool(first.can_vanish or first.nominal[0] or self.x[0] > 0)

    def result(self, accepted: float) -> Explanation | None:
        """What was found, if it explains the difference by amounts that differ from the right ones."""
        if not self.left <= accepted:
            return None
        uncertainty = self.resolution * max(1.0, self.left)
        for one, x, resolution in _split(self.combination, self.x, uncertainty):
            if len(x) and np.max(np.abs(x - one.nominal) / resolution) < MIN_SIGNIFICANT:
                return None
            if not one.can_vanish and np.any(x * np.where(one.nominal, one.nominal, 1.0) <= 0):
                return None  # no mass or length
        return Explanation(self.combination, self.x, uncertainty, self.left)
