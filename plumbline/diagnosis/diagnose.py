"""Find what explains how an engine differs from the truth at states of any mechanism.

Edits of numbers, terms, readings and outputs are tried together (`fit`, `outputs`).  All single causes that
explain every quantity are named, because the data cannot distinguish them.  Where there is none, quantities
are explained one by one or in groups, then pairs of causes, then the place of unknown forces.  An error that
scatters where little more than the last bits of the problem change has no such cause: `digit_loss`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from plumbline.diagnosis.cause import Cause, Diagnosis, quantity_words
from plumbline.diagnosis.digit_loss import (
    Evaluate,
    find_digit_loss,
    measure_scatter,
    scatter_cause,
    worst_difference,
)
from plumbline.diagnosis.edits import Edit
from plumbline.diagnosis.fit import (
    ACCEPTED_RATIO,
    MIN_DIAGNOSABLE_RATIO,
    Difference,
    Explanation,
    Mask,
    Search,
    changed,
)
from plumbline.diagnosis.needs import find_needs
from plumbline.diagnosis.outputs import Outputs
from plumbline.diagnosis.prediction import (
    QUANTITIES,
    VECTORS,
    WRENCHES,
    Answers,
    Case,
    View,
    error_ratio,
    error_ratios,
    values_of,
)
from plumbline.diagnosis.readings import other_branches
from plumbline.diagnosis.terms import Terms, force_places, is_spanned
from plumbline.engines.registry import load_adapter
from plumbline.equations.tree import SUMS
from plumbline.model.datatypes import Model, StateQuantities
from plumbline.model.grouping import grouped
from plumbline.model.kinematics import complete_state
from plumbline.truth.ground_truth import StateTruth

MAX_LOCATED = 4  # states at which the difference is looked for with one thing taken away
BODIES_KEPT = View(are_bodies_kept=True)
# an engine's forces that close an open loop act on both ends, its own wrenches count them at one
ENDS_BY_TWISTS = View((*VECTORS[:2], *SUMS), end_rows="twists")


def explain_disagreement(
    engine: str, model: Model, engine_quantities: list[StateQuantities], truth: StateTruth, is_known: bool
) -> Diagnosis:
    """Diagnose quantities that disagree with the truth; loads the engine, so call it in a worker.

    Args:
        engine_quantities: what the engine returned at the states of ``truth``.
        is_known: whether the cause is on record as rounding: then only the scatter of the error is measured.

    """
    evaluate = load_adapter(engine).evaluate
    if not is_known:
        return diagnose(model, engine_quantities, truth, evaluate)
    problem = worst_difference(model, engine_quantities, truth)
    scatter = measure_scatter(problem, evaluate)
    causes = () if scatter is None else (scatter_cause(problem.names, scatter),)
    return Diagnosis(causes, scatter=scatter)


def diagnose(
    model: Model, reported: Sequence[StateQuantities], truth: StateTruth, evaluate: Evaluate | None = None
) -> Diagnosis:
    """Name the causes that explain how an engine differs from the truth.

    Args:
        reported: what the engine returned at the states of ``truth``.
        evaluate: evaluates the engine again, at turned problems to find loss of digits, and with one thing
            taken away at a time to find what an unexplained difference needs; None to skip that.

    """
    search = _Diagnosing(model, reported, truth, evaluate)
    causes = search.causes()
    return Diagnosis(tuple(search.with_needs(causes)) if evaluate else causes)


def state_count(model: Model) -> int:
    """Return at how many states causes are evaluated: fewer of large mechanisms."""
    return 6 if model.n <= 6 else 4 if model.n <= 12 else 2


def _distinct(named: Mapping[str, tuple[Cause, ...]]) -> tuple[Cause, ...]:
    """The causes in quantities, each once."""
    return tuple(dict.fromkeys(cause for some in named.values() for cause in some))


class _Diagnosing:
    """One diagnosis: the difference at states that show it, and what was tried."""

    def __init__(
        self, model: Model, reported: Sequence[StateQuantities], truth: StateTruth, evaluate: Evaluate | None
    ) -> None:
        self.model, self.reported, self.truth, self.evaluate = model, reported, truth, evaluate
        self.ratios = {q: error_ratios(reported, truth, q) for q in QUANTITIES}
        self.worst = np.max(list(self.ratios.values()), axis=0)
        self.largest = float(np.max(self.worst))
        order = np.argsort(-self.worst).tolist()
        count = state_count(model)
        first = order[: (count + 1) // 2]
        rest = order[len(first) :]
        spread = np.linspace(0, len(rest) - 1, min(len(rest), count - len(first))).round().astype(int)
        self.order, self.places = order, sorted([*first, *(rest[i] for i in spread)])
        self.differences: dict[View, Difference] = {}
        self.searches: dict[View, Search] = {}
        self.loss: Cause | None = None
        self.named: dict[str, tuple[Cause, ...]] = {}

    def wrong(self, ratio: float = 1.0) -> list[str]:
        """List the quantities whose error exceeds a number of bounds."""
        return [q for q in QUANTITIES if np.max(self.ratios[q]) > ratio]

    def _places(self, view: View) -> list[int]:
        """States of the fit: of views that are evaluated one by one the two worst."""
        return self.places if view == View() else self.order[:2]

    def difference(self, view: View) -> Difference:
        """The difference at the states of a view."""
        if view not in self.differences:
            places = self._places(view)
            self.differences[view] = Difference(self.model, self.reported, self.truth, view, places)
        return self.differences[view]

    def search(self, view: View) -> Search:
        """The candidates of a view, screened once."""
        if view not in self.searches:
            difference = self.difference(view)
            is_linear = view != View() and not difference.is_predictable
            self.searches[view] = Search(difference, of_terms_alone=is_linear)
        return self.searches[view]

    def causes(self) -> tuple[Cause, ...]:
        """Find the causes, or say that there are none."""
        if self.largest <= 1:
            words = "wrong; all other quantities are right"
            return (Cause("output", "mass matrix", "", words, quantities=("mass_matrix",)),)
        if self.largest <= MIN_DIAGNOSABLE_RATIO or not np.isfinite(self.largest):
            return (self._unexplained(self.wrong(), "close" if np.isfinite(self.largest) else ""),)
        wrong = self.wrong(MIN_DIAGNOSABLE_RATIO)
        if self.evaluate and not self.model.has_loops:
            problem = worst_difference(self.model, self.reported, self.truth, wrong)
            self.loss = find_digit_loss(problem, self.evaluate)
        found = self._in_words(wrong) or self._single(View()) or self._outputs_alone(wrong)
        if not found and self.loss:
            return (*_distinct(self.named), self.loss)
        found = found or self._single(View(), are_sums_apart=True)
        beside = () if found else self._with_outputs(wrong, self.search(View()))
        if beside and all(cause.is_in_words for cause in beside):
            return beside
        return (
            found
            or self._single_of_another_kind(BODIES_KEPT, wrong)
            or self._two_or_more(beside)
            or self._single_of_another_kind(ENDS_BY_TWISTS, wrong)  # says nothing of wrenches
            or self._forces()
            or self._partly(wrong)
            or (self._unexplained(wrong),)
        )

    def _in_words(self, wrong: Sequence[str]) -> tuple[Cause, ...]:
        """Outputs of one class, beside at most one term that is left out: what is tried without a search."""
        found = self._outputs_alone(wrong) if len(wrong) == 1 or set(wrong) <= set(WRENCHES) else ()
        if not found and set(VECTORS[:2]) & set(wrong):
            found = self._with_outputs(
                wrong, Search(self.difference(View()), of_terms_alone=True), [WRENCHES]
            )
        return found if all(cause.is_in_words for cause in found) else ()

    def _two_or_more(self, beside: tuple[Cause, ...]) -> tuple[Cause, ...]:
        """Causes with others in outputs; three, or fitted amounts in them, only where no two numbers do."""
        is_simple = len(beside) <= 2 and not any(one.kind == "output" and one.amount for one in beside)
        return (beside if is_simple else ()) or self._pairs() or beside

    def _unexplained(self, quantities: Sequence[str], change: str = "") -> Cause:
        return Cause("unexplained", quantity_words(quantities), "", change, quantities=tuple(quantities))

    # -- causes in what is evaluated -----------------------------------------------------------------

    def _mask(self, difference: Difference, are_sums_apart: bool) -> Mask:
        """All quantities; or the vectors, where energies and momentum are right."""
        if not are_sums_apart:
            return difference.everything
        sums = difference.of(SUMS)
        return ~sums & np.all(np.abs(difference.values[sums]) <= ACCEPTED_RATIO)

    def _single(self, view: View, are_sums_apart: bool = False) -> tuple[Cause, ...]:
        """Every single cause of all quantities; or of the vectors alone, where the sums are right."""
        search = self.search(view)
        difference = search.difference
        mask = self._mask(difference, are_sums_apart)
        if np.max(np.abs(difference.values[mask]), initial=0.0) <= ACCEPTED_RATIO:
            return ()
        found = search.explain(mask)
        if self.loss:  # no number explains what scatters
            found = [one for one in found if not np.any(one.uncertainty)]
        elif not found and not are_sums_apart:
            branch = self._branch(difference) if self.model.has_loops and view == View() else ()
            if branch:
                return branch
            found = search.explain_by_vectors(mask)
        return self._named(self._proved(view, found, mask))

    def _single_of_another_kind(self, view: View, wrong: Sequence[str]) -> tuple[Cause, ...]:
        """The same of engines in maximal coordinates, or that take a state with loops in another way."""
        if not (view.are_bodies_kept or self.model.has_loops) or not set(VECTORS[:2]) & set(wrong):
            return ()
        return self._single(view) or self._single(view, are_sums_apart=True)

    def _named(self, found: Sequence[Explanation]) -> tuple[Cause, ...]:
        """The causes of the first explanation, with those from which the data cannot distinguish them."""
        if not found:
            return ()
        first, *others = found
        causes = dict(zip(first.combination, first.causes(len(self.places)), strict=True))
        equal: dict[Edit, dict[Edit, Cause]] = {one: {} for one in causes}
        for other in others:
            replaced, new = set(causes) - set(other.combination), set(other.combination) - set(causes)
            if len(replaced) == len(new) == 1:
                stated = dict(zip(other.combination, other.causes(len(self.places)), strict=True))
                equal[replaced.pop()].update({one: stated[one] for one in new})
        return tuple(replace(cause, equal=tuple(equal[one].values())) for one, cause in causes.items())

    def _proved(self, view: View, found: Sequence[Explanation], mask: Mask) -> list[Explanation]:
        """Those that explain the difference at further states too."""
        others = [i for i in self.order if i not in self._places(view)][: 2 * state_count(self.model)]
        if not found or not others:
            return list(found)
        there, here = Difference(self.model, self.reported, self.truth, view, others), self.difference(view)
        kept = there.of(set(here.quantity[mask]))
        accepted = max(here.accepted(mask), there.accepted(kept))
        provable = [one for one in found if all(c.change is not None for c in one.combination)]
        effects = there.evaluate([(one.combination, one.amounts) for one in provable])
        left = np.max(np.abs(there.values - effects)[:, kept], axis=1, initial=0.0)
        refuted = {id(one) for one, x in zip(provable, left, strict=True) if not x <= accepted}
        return [one for one in found if id(one) not in refuted]

    def _branch(self, difference: Difference) -> tuple[Cause, ...]:
        """Loops that are closed on another branch at some states."""
        accepted = difference.accepted(difference.everything)
        for cause, poses in other_branches(self.model):
            effects = difference.evaluate([((), np.zeros(0)), *(((one,), np.zeros(0)) for one in poses)])
            off = np.nan_to_num(np.abs(difference.values - effects), nan=np.inf)
            at_states = (off[:, difference.state == s] for s in range(difference.predictor.count))
            if all(np.min(np.max(one, axis=1)) <= accepted for one in at_states):
                return (replace(cause, states=difference.predictor.count),)
        return ()

    # -- causes in outputs ---------------------------------------------------------------------------

    def outputs(self, case: Case, right: Answers) -> Outputs:
        """The table of outputs at the states, of the mechanism or of an altered one."""
        here, before = self.difference(View()), [self.truth.quantities[i - 1] for i in self.places]
        previous = {q: values_of(before, q) for q in here.names}
        return Outputs(case, here.true | {q: right[q] for q in here.names}, previous, here.bounds)

    def _name_outputs(self, quantities: Sequence[str], outputs: Outputs) -> dict[str, tuple[Cause, ...]]:
        given, count = self.difference(View()).given, len(self.places)
        found = {q: outputs.name(q, given[q]) for q in quantities}
        return {
            q: tuple(replace(one, states=count, quantities=(q,)) for one in some)
            for q, some in found.items()
            if some
        }

    def _outputs_alone(self, wrong: Sequence[str]) -> tuple[Cause, ...]:
        """One cause in each wrong quantity; none where a quantity has no name."""
        here = self.difference(View())
        self.named = self._name_outputs(wrong, self.outputs(here.predictor.case, here.true))
        return _distinct(self.named) if len(self.named) == len(wrong) else ()

    def _with_outputs(
        self, wrong: Sequence[str], search: Search, classes: Sequence[tuple[str, ...]] = ()
    ) -> tuple[Cause, ...]:
        """One cause in what is evaluated, and others in some outputs."""
        groups = list(classes)
        if not groups:
            groups = [tuple(self.named)] if self.named else []
            groups += [(q,) for q in wrong if (q,) not in groups]
            groups += [x for x in (WRENCHES, SUMS, SUMS[:2]) if set(x) & set(wrong) and x not in groups]
        for left_out in groups:
            mask = ~search.difference.of(left_out)
            values = search.difference.values[mask]
            if np.max(np.abs(values), initial=0.0) <= ACCEPTED_RATIO:
                continue
            found = self._proved(View(), search.explain(mask), mask)
            for one in found:
                case, right = self._altered(search, one)
                here = self.difference(View())
                off = {q: here.given[q] - right[q] for q in left_out if q in right}
                remaining = [
                    q for q, x in off.items() if not error_ratio(x, here.bounds[q]) <= ACCEPTED_RATIO
                ]
                outputs = self._name_outputs(remaining, self.outputs(case, right))
                if len(outputs) == len(remaining):
                    causes = self._named(found if not remaining else [one])
                    return (*causes, *_distinct(outputs))
        return ()

    def _altered(self, search: Search, found: Explanation) -> tuple[Case, Answers]:
        """The mechanism with a cause, and the quantities that follow."""
        difference = search.difference
        (effect,) = difference.effects([(found.combination, found.amounts)])
        right = {q: x + effect[difference.quantity == q].reshape(x.shape) for q, x in difference.true.items()}
        case = changed(difference.predictor.case, found.combination, found.amounts)
        fields = vars(self.model).items()
        if any(np.ndim(getattr(case.model, name)) > np.ndim(x) for name, x in fields if name != "kind"):
            return difference.predictor.case, right  # another number at each state
        return Case(case.model, complete_state(case.model, case.state)), right

    def _pairs(self) -> tuple[Cause, ...]:
        """Two causes in what is evaluated, together."""
        search = self.search(View())
        for are_sums_apart in (False, True):
            mask = self._mask(search.difference, are_sums_apart)
            found = self._proved(View(), search.explain_by_pairs(mask), mask)
            if found:
                return self._named(found)
        return ()

    def _forces(self) -> tuple[Cause, ...]:
        """The only place of unknown forces of a tree; where sums are right and accelerations are not."""
        difference = self.difference(View())
        mask = self._mask(difference, are_sums_apart=True)
        of_motion = difference.values[mask & difference.of(VECTORS[:2])]
        if self.model.has_loops or np.max(np.abs(of_motion), initial=0.0) <= ACCEPTED_RATIO:
            return ()
        wanted, states, accepted = difference.values[mask], difference.state[mask], difference.accepted(mask)
        for places in self._places_of_unknowns(difference):
            edits = [edit for _, some in places for edit in some]
            effects = iter(difference.evaluate([((e,), e.nominal) for e in edits])[:, mask])
            found = []
            for cause, some in places:
                basis = np.stack([next(effects) for _ in some], axis=1)
                if is_spanned(basis, wanted, states, accepted):
                    found.append(cause)
            if found:
                return (found[0],) if len(found) == 1 else ()
        return ()

    def _places_of_unknowns(self, difference: Difference) -> Iterator[list[tuple[Cause, list[Edit]]]]:
        """Forces, then velocity terms of joints, that may be others at each state."""
        terms, places = Terms(difference.predictor), list[tuple[Cause, list[Edit]]]()

        def edits(cause: Cause, effects: Sequence[Answers]) -> list[Edit]:
            return [Edit(cause, effect=difference.flat_vectors(one)) for one in effects]

        yield from force_places(self.model, lambda k: edits(Cause("term", "moment"), terms.unit_moments(k)))
        for k in np.flatnonzero(~self.model.free).tolist():
            cause = Cause("term", "velocity term", f"joint {k + 1}", "another at each state")
            if some := edits(cause, terms.unit_velocity_terms(k)):
                places.append((cause, some))
        yield places

    def _partly(self, wrong: Sequence[str]) -> tuple[Cause, ...]:
        """The quantities that have a name, and the rest without one."""
        # a fitted share of a part may be what follows of a wrong number
        known = {q: some for q, some in self.named.items() if all(c.nominal or not c.amount for c in some)}
        if not known:
            return ()
        rest = [q for q in wrong if q not in known]
        close = [q for q in self.wrong() if q not in known and q not in rest]
        return (
            *_distinct(known),
            *([self._unexplained(rest)] if rest else []),
            *([self._unexplained(close, "close")] if close else []),
        )

    # -- what an unexplained difference needs --------------------------------------------------------

    def with_needs(self, causes: Sequence[Cause]) -> list[Cause]:
        """Say of what is unexplained what its difference needs; quantities with other needs apart."""
        assert self.evaluate
        count = min(MAX_LOCATED, state_count(self.model))
        states = [self.truth.states[i] for i in self.order[:count] if self.worst[i] > 1]
        found = list[Cause]()
        for cause in causes:
            if cause.kind != "unexplained" or cause.change:
                found.append(cause)
                continue
            needs = find_needs(self.model, states, cause.quantities, self.evaluate)
            groups = grouped(cause.quantities, needs.__getitem__)
            found += [replace(self._unexplained(some), needs=lacking) for lacking, some in groups.items()]
        return found
