"""Long runs: the drift of conserved quantities over 100 s, where chaos leaves no position to compare.

No truth is needed.  One motion runs at three steps.  How far each invariant drifts within blocks of time is
a sample of one distribution, whether or not the runs still follow each other; so the fall of the drifts from
step to step shows an order, whose error is the scatter of the blocks.  A drift that no step removes (a leak
of energy, a joint that creeps, a reset) does not fall.  A method with step control must keep each invariant
within the error that its tolerance accepts in every step.  The energy of a symmetric method, in a regular
motion, must not grow with time (E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, XI.3).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from plumbline.engines.no_answer import NoAnswer
from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict, first_decided, with_unit
from plumbline.judging.trajectory_level import singular_motion_row
from plumbline.measurements.drift_order import (
    BLOCK_COUNT,
    MAX_RELATIVE_DRIFT,
    SIGMA_FACTOR,
    InvariantDrift,
)
from plumbline.measurements.long_run_study import LongRunStudy, decisive_windows, leaves_range
from plumbline.model.datatypes import Integrator, Model
from plumbline.model.invariants import ALL_LONG, INVARIANT_UNITS, UNCERTAIN
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR

UNSTABLE_GROWTH_FACTOR = 2.0  # times as fast as time: neither a bounded drift nor a secular one grows so
MAX_SYMMETRIC_GROWTH = 0.5  # log2 of the drift's growth when time doubles: 0 if it is bounded, 1 if secular


def judge_long_runs(
    context: RowContext, model: Model, integrator: Integrator, is_regular: bool, study: LongRunStudy
) -> JudgingResult:
    """Judge the invariants of one integrator's long runs.

    Args:
        is_regular: whether the motion is known to be without chaos.

    Returns:
        Rows of level "invariants": ``*_long`` per invariant, ``energy_drift_long_growth`` for a symmetric
        method in a regular motion, ``singular_pose`` where the runs end at one; or ``all_long`` where they
        were refused or failed.

    """
    cost = sum(run.cpu_time for run in study.runs)
    if missing := _missing_runs(study):
        row = context.make_no_answer_row(
            "invariants", integrator.name, ALL_LONG, *missing,
            cpu_time=cost, extra={"asked": study.plan.requested_seconds},
        )  # fmt: skip
        return JudgingResult([row])
    rows = []
    for quantity in INVARIANT_UNITS:
        if quantity in study.runs[-1].windows:
            judge = _DriftJudge(context, integrator, study, quantity)
            rows.append(first_decided(judge.window_rows()))
            has_bound = integrator.is_symmetric and integrator.kind == "step" and is_regular
            if quantity == "energy_drift" and has_bound:
                rows.append(judge.growth_row())
    if study.singular:
        end = study.runs[-1].reached_time
        rows.append(singular_motion_row(context, "invariants", integrator.name, study.singular, end))
    alias = None if model.has_drag else integrator.alias_of  # with drag the two methods differ
    return JudgingResult([replace(row, cpu_time=cost, alias_of=alias) for row in rows])


def _missing_runs(study: LongRunStudy) -> tuple[NoAnswer, str] | None:
    """What the engine did where there is no finest run to judge, and when."""
    if study.refusal:
        return study.refusal, ""
    finest = study.runs[-1]
    if not finest.failure:
        return None
    if not finest.windows:
        return finest.failure, f"at the finest resolution {finest.resolution:g}: "
    if not leaves_range(finest, study.plan.seconds):
        return finest.failure, f"within {study.plan.seconds:g} s at {finest.resolution:g}: "
    return None


class _DriftJudge:
    """One invariant of one integrator's long runs."""

    def __init__(
        self, context: RowContext, integrator: Integrator, study: LongRunStudy, quantity: str
    ) -> None:
        self.integrator, self.study, self.quantity = integrator, study, quantity
        self.name, self.unit = quantity.replace("_", " "), INVARIANT_UNITS[quantity]
        self.finest = study.runs[-1]  # the run that is judged
        self.windows = self.finest.windows[quantity]
        self.window_ends = decisive_windows(self.finest, quantity, study.plan)  # s, longest first
        self.make_row = partial(context.make_row, "invariants", integrator.name)

    def drift(self, end: float) -> InvariantDrift:
        """The drift in the window up to ``end``."""
        return InvariantDrift(self.study.runs, self.integrator, self.quantity, end)

    def window_rows(self) -> Iterator[Row]:
        """The rows of all windows, longest first.

        A shorter one never overrules a longer one's disagreement; nor what the longer one leaves open where
        the drift is no matter of the step, as after one kick.
        """
        for end in self.window_ends:
            drift = self.drift(end)
            yield self.judge_window(drift)
            if not drift.is_matter_of_steps:
                return

    def judge_window(self, drift: InvariantDrift) -> Row:
        """The verdict in one window."""
        floor = drift.allowed_drift
        summary = f"{self.name} {with_unit(drift.max_drift, self.unit)} within {drift.end:g} s"
        if drift.max_drift > floor:
            return self.judge_order(drift, summary)
        cause = "rounding"
        if self.integrator.kind == "tolerance":
            cause = f"the error that the tolerance {self.finest.resolution:g} accepts in every step"
        elif drift.max_drift > floor - drift.uncertainty:
            cause = f"rounding, or the uncertainty of {UNCERTAIN}, ± {drift.uncertainty:.2g}"
        steps = f"{self.finest.steps} steps in {self.finest.reached_time:g} s"
        derivation = f"{steps}, a scale of {with_unit(drift.scale, self.unit, 3)}"
        if floor <= DETECTABLE_PARAMETER_ERROR * drift.scale:
            return self.verdict_row(Verdict.AGREES, f"{summary}: {cause}", drift, floor, derivation)
        reason = f"{summary}: {with_unit(floor, self.unit)} may be {cause}"
        return self.verdict_row(Verdict.UNRESOLVED, reason, drift, floor, derivation)

    def judge_order(self, drift: InvariantDrift, summary: str) -> Row:
        """Whether the drift falls with the step (or the tolerance) as the method's order requires."""
        usable = drift.usable_runs
        if len(usable) < 2 or usable[-1] is not self.finest:
            reason = (
                f"{summary}; of {len(self.study.runs)} runs {len(usable)} reached it with every drift below "
                f"{MAX_RELATIVE_DRIFT:g} of its scale: too coarse a step"
            )
            return self.verdict_row(Verdict.UNRESOLVED, reason, drift, MAX_RELATIVE_DRIFT * drift.scale, "")
        required = drift.required_order
        whole = drift.order_between(usable[0], self.finest)
        allowed = drift.max_fine_mean(whole)
        tolerance = drift.max_drift * allowed / whole.fine_mean
        which = "steps" if self.integrator.kind == "step" else "tolerances"
        observed = (
            f"order {whole.order:.1f} ± {SIGMA_FACTOR * whole.order_error:.1f} over {which} "
            f"{usable[0].resolution:g} … {self.finest.resolution:g}"
        )
        derivation = (
            f"mean drift within {BLOCK_COUNT} blocks of time {with_unit(whole.fine_mean, self.unit)}, "
            f"{whole.coarse_mean:.2g} at the coarsest: {observed} ({SIGMA_FACTOR:g} σ of the blocks), "
            f"required {required:.3g}, rounding {drift.rounding_floor(BLOCK_COUNT):.2g}"
        )
        if whole.fine_mean <= allowed and whole.order > SIGMA_FACTOR * whole.order_error:
            verdict, reason = Verdict.AGREES, f"{summary}, vanishing: {observed}"
        elif drift.falls_too_slowly:
            verdict = Verdict.DISAGREES
            reason = f"{summary} does not vanish: {observed}, required {required:.3g}"
        else:
            verdict, reason = Verdict.UNRESOLVED, f"{summary}: {observed} does not decide"
        return self.verdict_row(verdict, reason, drift, tolerance, derivation, whole.order)

    def growth_row(self) -> Row:
        """Whether a symmetric method's drift is bounded: the second half of the time adds little to it."""
        end = self.finest.reached_time
        window, first_half = self.windows[end], self.windows[end].max_drift_first_half
        growth = float(np.log2(window.max_drift / first_half)) if first_half > 0 else 0.0
        derivation, common = "", dict[str, Any](value=growth, tolerance=MAX_SYMMETRIC_GROWTH)
        unstable = [
            (a, b)
            for b, a in itertools.pairwise(self.window_ends)
            if self.windows[b].max_drift > UNSTABLE_GROWTH_FACTOR * b / a * self.windows[a].max_drift
        ]
        if window.max_drift <= self.drift(end).rounding_floor():
            verdict, common = Verdict.AGREES, {}
            reason = f"{self.name} is rounding: its growth has no meaning"
        elif unstable:
            (a, b), verdict = unstable[0], Verdict.UNRESOLVED
            reason = (
                f"an unstable motion: {self.name} {with_unit(self.windows[a].max_drift, self.unit)} by "
                f"{a:g} s, {self.windows[b].max_drift:.2g} by {b:g} s, faster than a bounded "
                "drift or a leak grows"
            )
        else:
            is_bounded = growth < MAX_SYMMETRIC_GROWTH
            verdict = Verdict.AGREES if is_bounded else Verdict.DISAGREES
            outcome = "bounded" if is_bounded else "it grows with time, although the method is symmetric"
            reason = (
                f"{self.name} {with_unit(first_half, self.unit)} by {end / 2:g} s, {window.max_drift:.2g} by "
                f"{end:g} s: {outcome}"
            )
            derivation = (
                "log2 of the growth as time doubles: 0 if bounded, 1 if secular; the middle is the limit"
            )
        return self.make_row(
            f"{self.quantity}_long_growth", verdict, reason, "1", derivation=derivation, compared_until=end,
            extra={"asked": self.study.plan.requested_seconds}, **common,
        )  # fmt: skip

    def verdict_row(
        self,
        verdict: Verdict,
        reason: str,
        drift: InvariantDrift,
        tolerance: float,
        derivation: str,
        order: float | None = None,
    ) -> Row:
        """The row of this invariant; its extra fields hold the largest drift up to each decade."""
        end = drift.end
        if self.finest.failure:
            reason += f"; in {self.study.plan.seconds:g} s {self.finest.failure.message}"
        elif end < self.finest.reached_time:
            last = self.windows[self.finest.reached_time].max_drift
            reason += (
                f"; {with_unit(last, self.unit)} within {self.finest.reached_time:g} s, which does not decide"
            )
        if self.integrator.kind == "tolerance":
            order = None
        if (solved := self.finest.solver_rtol) > self.integrator.solver_rtol:
            derivation += f"; steps solved to {solved:g}"  # less closely than the integrator declares
        return self.make_row(
            f"{self.quantity}_long",
            verdict,
            reason,
            self.unit,
            value=drift.max_drift,
            tolerance=tolerance,
            derivation=derivation + self.study.plan.shortening_note,
            compared_until=end,
            order=order,
            declared_order=self.integrator.order if order else None,
            extra={
                "scale": drift.scale,
                "asked": self.study.plan.requested_seconds,
                **{f"by {t:g} s": self.windows[t].max_drift for t in sorted(self.windows)},
            },
        )
