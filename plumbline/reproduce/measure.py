"""What an engine makes of a case, measured: at a state, of a relation, along a run.

Runs in a worker.  Engines of another version are asked in the environment of theirs; truths and bounds
are always this one's.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from plumbline.engines import calls
from plumbline.engines.calls import RefinementRun
from plumbline.engines.registry import load_adapter
from plumbline.judging.convergence import ORDER_MARGIN
from plumbline.judging.invariant_drift import invariant_rows
from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.relation_result import OTHER_FORMULATION_PREFIX
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.judging.state_relations import (
    STATE_RELATIONS,
    WELDED_HALVES,
    Relation,
    quantity_values,
    unchanged,
)
from plumbline.judging.trajectory import trajectory_rows
from plumbline.model.datatypes import Array, Integrator, StateQuantities
from plumbline.model.welding import split_bodies
from plumbline.reproduce.engine_client import Engine, OfRuns
from plumbline.reproduce.measure_long_run import GROWTH, LONG, OverLong, ShownLong
from plumbline.reproduce.measure_round_trip import ShownTwice, Twice
from plumbline.reproduce.shrink import Case, smallest
from plumbline.truth import TruthUnavailable
from plumbline.truth.certified import certify_state
from plumbline.truth.ground_truth import MotionTruth, motion_truth
from plumbline.truth.rounding_bound import state_rounding_bound

LIMITS = ("position_limit", "position", "attitude_limit", "attitude")
FINE = 64  # samples of a run whose loads' work is integrated


@dataclass(frozen=True, eq=False)
class ShownState:
    """A state at which the engine is off, with what is true there."""

    case: Case
    ratio: float
    truth: dict[str, Array]
    bound: dict[str, Array]  # (N,) or a number: of the norm of the difference, per body; of each entry
    certified: bool


@dataclass(frozen=True, eq=False)
class ShownRelation:
    """A state that the engine answers otherwise when it is described otherwise."""

    case: Case
    ratio: float
    name: str
    way: str  # of the engine to the second answer, where it is another one
    other: Case  # the other description
    second: str  # the engine that is asked of it
    back: dict[str, Array]  # (3, 3) or a number per quantity: the second answer in terms of the first
    bound: dict[str, Array]  # of both sides


@dataclass(frozen=True, eq=False)
class ShownRun:
    """Runs whose order, limit or drift is off."""

    case: Case
    ratio: float
    times: Array  # (T,) s
    integrator: Integrator
    ordered: bool  # whether the order is in dispute
    limited: bool  # whether positions or attitudes at step zero are
    drifts: tuple[str, ...]  # invariants that drift
    true_r: Array  # (N, 3) m at the end
    true_p: Array  # (N, 4) at the end
    sizes: tuple[float, float]  # m and m/s: what r and v are measured in where orders are observed
    eliminated: dict[str, int]  # powers of the step, per quantity
    uncertain: dict[str, float]  # m, rad or the invariant's unit, per quantity


Shown = ShownState | ShownRelation | ShownTwice | ShownRun | ShownLong


@dataclass(frozen=True)
class Question:
    """What to shrink: an engine, a level and the quantities that disagree there."""

    engine: Engine
    level: str
    wanted: tuple[str, ...]
    integrator: str
    case: Case
    most: float  # by how much it disagreed, in tolerances
    seconds: float  # of computing, for shrinking
    sample: float = 0.0  # s, from one sample of a long run to the next


def measure_of(question: Question) -> AtState | Related | AlongRuns | Twice | OverLong:
    """What says by how much a case shows what is in question."""
    q = question
    if q.level == "state":
        return AtState(q.engine, q.wanted)
    if q.level == "relations":
        if q.integrator != "-":
            return Twice(q.engine, q.integrator, q.wanted[0])
        return Related(q.engine, q.wanted[0])
    if q.wanted[0].endswith((LONG, GROWTH)):
        return OverLong(q.engine, q.integrator, q.wanted, q.sample)
    return AlongRuns(q.engine, q.integrator, q.level, q.wanted)


def whole(question: Question) -> Case:
    """The case in question with its steps; those of a long run are its integrator's."""
    measure = measure_of(question)
    return measure.whole(question.case) if isinstance(measure, OverLong) else question.case


def shrunk(question: Question) -> Shown | None:
    """The smallest case found that shows the disagreement; None where the engine, asked again, agrees.

    Raises OutOfTime where none was found in time.
    """
    measure, case, most = measure_of(question), whole(question), question.most
    if not case.steps:
        found = measure(case)
        most = found.ratio if found else 0.0
    # what another environment computes is not on this process's clock
    clock = time.monotonic if question.engine.python else time.process_time
    steps_given = not isinstance(measure, OfRuns) or measure.integrator.kind == "step"
    as_it_is = isinstance(measure, OverLong) and measure.growth  # another motion need not be a regular one
    smaller = smallest(case, measure, most, question.seconds, steps_given, clock, not as_it_is)
    return cast("Shown | None", smaller)


def length_of(difference: Array, quantity: str) -> Array:
    """Size of an error as the verdicts take it: per body, of a vector, of a number, of each entry."""
    if quantity == "mass_matrix" or difference.ndim == 0:
        return np.asarray(np.max(np.abs(difference)))
    return np.asarray(np.linalg.norm(difference, axis=-1))


@dataclass(frozen=True)
class AtState:
    """By how much an engine's answers at a state are off, in rounding bounds."""

    engine: Engine
    quantities: tuple[str, ...]

    def __call__(self, case: Case) -> ShownState | None:
        """None for what the engine, the truth or the bound refuses: it shows nothing."""
        try:
            said = self.engine.evaluate(case.model, case.state)
            allowed, certified = state_rounding_bound(case.model, case.state), True
            try:
                truth = certify_state(
                    case.model, case.state, mass_matrix="mass_matrix" in self.quantities
                ).quantities
            except TruthUnavailable:
                (truth,), certified = load_adapter("reference").evaluate(case.model, [case.state]), False
        except Exception:
            return None
        offered = [q for q in self.quantities if getattr(said, q) is not None]
        bounds = {q: np.asarray(allowed.tolerance(q), float) for q in offered}
        right = {q: np.asarray(getattr(truth, q), float) for q in offered}
        ratios = [
            np.max(length_of(getattr(said, q) - right[q], q) / np.maximum(bounds[q], 1e-300)) for q in offered
        ]
        return ShownState(case, float(max(ratios, default=0.0)), right, bounds, certified)


@dataclass(frozen=True)
class Related:
    """By how much an engine disagrees with itself on a case described, or asked about, in two ways."""

    engine: Engine
    name: str
    back: dict[str, Array] = field(default_factory=dict)  # see `ways`: the same for every case

    def __call__(self, case: Case) -> ShownRelation | None:
        """None for what cannot be compared."""
        model, state, engine = case.model, case.state, self.engine
        relation = next((r for r in STATE_RELATIONS if r.name == self.name), None)
        way = "" if relation or self.name.startswith(OTHER_FORMULATION_PREFIX) else self.name
        relation = relation or Relation(self.name, unchanged, quantity_values)
        if self.name.startswith(OTHER_FORMULATION_PREFIX):
            engine = replace(engine, name=self.name.removeprefix(OTHER_FORMULATION_PREFIX))
        if model.has_drag and self.name == "time reversed":
            return None
        try:
            other = Case(*relation.transform(model, state))
            here, said = (
                self.engine.evaluate(model, state),
                engine.evaluate(other.model, other.state, way),
            )
            bounds = [state_rounding_bound(model, state)]
            bounds.append(
                state_rounding_bound(model, state, split_bodies(model)) if way == WELDED_HALVES else bounds[0]
            )
        except Exception:
            return None
        mine, theirs = quantity_values(here), relation.transform_back(said)
        if not self.back:
            self.back.update(ways(relation, said))
        both = [q for q in mine if q in theirs]
        bound = {q: np.sum([np.asarray(b.tolerance(q), float) for b in bounds], axis=0) for q in both}
        off = [np.max(length_of(mine[q] - theirs[q], q) / np.maximum(bound[q], 1e-300)) for q in both]
        return ShownRelation(
            case, float(max(off)), self.name, way, other, engine.name, {q: self.back[q] for q in both}, bound
        )


def ways(relation: Relation, said: StateQuantities) -> dict[str, Array]:
    """The way back of each quantity: a factor, or a matrix (3, 3) on its last axis, found by asking.

    NotImplementedError where it is neither: a script could not say it in numbers.
    """
    found: dict[str, Array] = {}
    for q, value in relation.transform_back(said).items():
        given = np.asarray(getattr(said, q), float)

        def back(y: Any, q: str = q) -> Array:
            return np.asarray(relation.transform_back(replace(said, **{q: y}))[q], float)

        if given.ndim == 0:
            way = back(1.0)
        else:
            way = np.stack(
                [back(np.broadcast_to(e, given.shape)).reshape(-1, 3)[0] for e in np.eye(3)], axis=1
            )
            way = way[0, 0] if np.all(way == way[0, 0] * np.eye(3)) else way
        again = given @ way.T if np.ndim(way) else way * given
        if np.shape(again) != np.shape(value) or not np.allclose(
            again, value, rtol=0, atol=1e-9 * np.max(np.abs(value))
        ):
            raise NotImplementedError(f"the way back of {relation.name!r} is not a matrix for each body")
        found[q] = way
    return found


@dataclass
class AlongRuns(OfRuns):
    """By how much a ladder of runs is off, judged as a run of the matrix judges it."""

    level: str
    wanted: tuple[str, ...]
    known: dict[tuple[object, ...], tuple[MotionTruth, dict[float, RefinementRun]]] = field(
        default_factory=dict
    )

    def times(self, case: Case) -> Array | None:
        """Start and end; more where the work of moments or drag is to be integrated, if steps allow it."""
        model = case.model
        count = 1
        if self.level == "invariants" and (model.has_drag or np.any(model.moment)):
            count = FINE
            if self.integrator.kind == "step":
                count = min(count, round(case.until / case.steps[0]))
            if count < 16:
                return None
        return np.linspace(0.0, case.until, count + 1)

    def runs(self, case: Case, times: Array) -> tuple[MotionTruth, list[RefinementRun]]:
        """Truth and rungs; those of the case before are not run again where only steps differ."""
        at = (*replace(case, steps=()).content, len(times))
        if at not in self.known:
            self.known.clear()
            self.known[at] = motion_truth(case.model, case.state, times, None), {}
        truth, rungs = self.known[at]
        missing = [h for h in case.steps if h not in rungs]
        if missing:
            climb = self.engine.ask(calls.run_refinement, self.method, case.model, case.state, times, missing)
            rungs.update({rung.resolution: rung for rung in climb.rungs})
        return truth, [rungs[h] for h in case.steps]

    def __call__(self, case: Case) -> ShownRun | None:
        """None for what the engine or the truth refuses."""
        times = self.times(case)
        if times is None:
            return None
        try:
            truth, rungs = self.runs(case, times)
        except Exception:
            return None
        if any(rung.trajectory is None for rung in rungs):
            return None
        who = RowContext("", "", self.engine.name, self.engine.name, "")
        ladder = RefinementAnalysis(who, case.model, truth, self.integrator, rungs, case.until)
        rows = {
            row.quantity: row
            for row in (invariant_rows(ladder) if self.drifting else trajectory_rows(ladder))
        }
        groups = [set(self.wanted)] if self.drifting else [{"order"}, set(LIMITS)]
        off = [
            max((excess(rows[q]) for q in group if q in rows), default=0.0)
            for group in groups
            if group & set(self.wanted)
        ]
        series: dict[str, Sequence[Array]] = {"position": ladder.positions, "attitude": ladder.attitudes}
        uncertain = {name: rows.get(f"{name}_limit") for name in series}
        if self.drifting:
            there = [q for q in self.wanted if q in rows]
            shown = [q for q in there if rows[q].verdict == Verdict.DISAGREES] or there
            series = {q: [getattr(d, q) for d in ladder.invariant_drifts] for q in shown}
            uncertain = {q: rows[q] for q in shown}
        return ShownRun(
            case, min(off, default=0.0), times, self.integrator, "order" in self.wanted and "order" in rows,
            bool(set(LIMITS) & set(self.wanted)), tuple(series) if self.drifting else (),
            truth.trajectory.r[-1], truth.trajectory.p[-1], (truth.length, ladder.invariant_scales["gap_rate"]),
            {q: ladder.extrapolated_limit(ys).eliminated_powers for q, ys in series.items()},
            {q: float(row.tolerance) for q, row in uncertain.items() if row and row.tolerance},
        )  # fmt: skip

    @property
    def drifting(self) -> bool:
        """Whether invariants are in dispute."""
        return self.level == "invariants"


def excess(row: Row) -> float:
    """Error over tolerance of a row that disagrees, else 0."""
    if row.verdict != Verdict.DISAGREES:
        return 0.0
    if row.quantity == "order":
        return float(row.value or 0.0) / ORDER_MARGIN
    assert row.ratio is not None
    return row.ratio
