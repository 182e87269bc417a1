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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict, first_decided
from plumbline.judging.trajectory_level import singular_motion_row
from plumbline.measurements.long_run_study import (
    BLOCK_COUNT,
    MAX_RELATIVE_DRIFT,
    MIN_WINDOW,
    DriftWindow,
    LongRun,
    LongRunStudy,
    leaves_range,
)
from plumbline.measurements.order_and_limit import ORDER_MARGIN
from plumbline.measurements.refinement_study import ROUNDING_PER_STEP
from plumbline.model.datatypes import Array, Float, Integrator, Model
from plumbline.model.invariants import ALL_LONG, INVARIANT_UNITS
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR

MIN_ORDER_IN_TOLERANCE = 0.5  # order of a drift in the tolerance of a method with step control, at least
SIGMA_FACTOR = 3.0
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
        row = context.make_row(
            "invariants", integrator.name, ALL_LONG, *missing, gap=study.gap,
            cpu_time=cost, extra={"asked": study.plan.requested_seconds},
        )  # fmt: skip
        return JudgingResult([row])
    rows = []
    for quantity, unit in INVARIANT_UNITS.items():
        if quantity in study.runs[-1].windows:
            judge = _DriftJudge(context, integrator, study, quantity, unit)
            rows.append(judge.window_row())
            has_bound = integrator.is_symmetric and integrator.kind == "step" and is_regular
            if quantity == "energy_drift" and has_bound:
                rows.append(judge.growth_row())
    if study.singular:
        end = study.runs[-1].reached_time
        rows.append(singular_motion_row(context, "invariants", integrator.name, study.singular, end))
    alias = None if model.has_drag else integrator.alias_of  # with drag the two methods differ
    return JudgingResult([replace(row, cpu_time=cost, alias_of=alias) for row in rows])


def _missing_runs(study: LongRunStudy) -> tuple[Verdict, str] | None:
    """Verdict and reason where there is no finest run to judge."""
    if study.unsupported is not None:
        return Verdict.UNSUPPORTED, study.unsupported
    finest = study.runs[-1]
    if not finest.windows:
        return Verdict.FAILED, f"at the finest resolution {finest.resolution:g}: {finest.failure}"
    if finest.failure is not None and not leaves_range(finest, study.plan.seconds):
        return Verdict.FAILED, f"within {study.plan.seconds:g} s at {finest.resolution:g}: {finest.failure}"
    return None


@dataclass(frozen=True)
class _DriftJudge:
    """One invariant of one integrator's long runs."""

    context: RowContext
    integrator: Integrator
    study: LongRunStudy
    quantity: str
    unit: str

    @property
    def name(self) -> str:
        """The quantity in words."""
        return self.quantity.replace("_", " ")

    @property
    def finest(self) -> LongRun:
        """The run that is judged."""
        return self.study.runs[-1]

    @property
    def shortest(self) -> float:
        """The shortest window that decides [s]."""
        return MIN_WINDOW * self.study.plan.time_unit

    @property
    def windows(self) -> dict[float, DriftWindow]:
        """The finest run's drifts of this invariant, by window."""
        return self.finest.windows[self.quantity]

    @property
    def required_order(self) -> float:
        """Least order of the drift in the step; in the tolerance where that controls the step.

        Conserved quantities often drift with a higher one.  Step control holds the error of a step below
        the tolerance, not at it: with the notes' collocation on a free top, the energy's drift vanishes with
        orders of 0.74 … 1.15 in the tolerance from decade to decade, down to 2e-10 J.
        """
        if self.integrator.kind == "step":
            return self.integrator.order - ORDER_MARGIN
        return MIN_ORDER_IN_TOLERANCE

    def scale(self, end: float) -> float:
        """Scale of the invariant in the window up to ``end``."""
        return self.finest.invariant_scales[end][self.quantity]

    def rounding_floor(self, end: float, parts: int = 1) -> float:
        """Drift in a part of a window by rounding, by the steps' solver and by the quadrature of work."""
        steps = max(self.finest.steps * end / self.finest.reached_time / parts, 64.0)
        # The solver's errors are independent from step to step: they add up like a random walk.
        relative = steps * ROUNDING_PER_STEP + np.sqrt(steps) * self.integrator.solver_rtol
        work_uncertainty = self.finest.work_uncertainty[end] if self.quantity == "energy_drift" else 0.0
        return float(relative * self.scale(end)) + work_uncertainty

    def allowed_drift(self, end: float) -> float:
        """Drift that needs no order: rounding, and the error that step control accepts."""
        floor = self.rounding_floor(end)
        if self.integrator.kind == "tolerance":
            steps = self.finest.steps * end / self.finest.reached_time
            floor += steps * self.finest.resolution * self.scale(end)
        return floor

    def window_row(self) -> Row:
        """The row of the longest window that decides; a shorter one never overrules its disagreement."""
        ends = [end for end in sorted(self.windows, reverse=True) if end >= self.shortest]
        return first_decided(self.judge_window(end) for end in ends or [self.finest.reached_time])

    def judge_window(self, end: float) -> Row:
        """The verdict in one window."""
        drift, floor = self.windows[end].max_drift, self.allowed_drift(end)
        summary = f"{self.name} {drift:.2g} {self.unit} within {end:g} s"
        if drift > floor:
            return self.judge_order(end, summary)
        cause = "rounding"
        if self.integrator.kind == "tolerance":
            cause = f"the error that the tolerance {self.finest.resolution:g} accepts in every step"
        steps = f"{self.finest.steps} steps in {self.finest.reached_time:g} s"
        derivation = f"{steps}, a scale of {self.scale(end):.3g} {self.unit}"
        if floor <= DETECTABLE_PARAMETER_ERROR * self.scale(end):
            return self.verdict_row(Verdict.AGREES, f"{summary}: {cause}", end, floor, derivation)
        reason = f"{summary}: {floor:.2g} {self.unit} may be {cause}"
        return self.verdict_row(Verdict.UNRESOLVED, reason, end, floor, derivation)

    def judge_order(self, end: float, summary: str) -> Row:
        """Whether the drift falls with the step (or the tolerance) as the method's order requires."""
        usable = [run for run in self.study.runs if self.is_usable(run, end)]
        if len(usable) < 2 or usable[-1] is not self.finest:
            reason = (
                f"{summary}; of {len(self.study.runs)} runs {len(usable)} reached it with every drift below "
                f"{MAX_RELATIVE_DRIFT:g} of its scale: too coarse a step"
            )
            return self.verdict_row(Verdict.UNRESOLVED, reason, end, MAX_RELATIVE_DRIFT * self.scale(end), "")
        floor, required = self.rounding_floor(end, BLOCK_COUNT), self.required_order
        whole = DriftOrder.from_runs(usable[0], self.finest, self.quantity, end)
        allowed = whole.max_fine_mean(required, floor)
        tolerance = self.windows[end].max_drift * allowed / whole.fine_mean
        which = "steps" if self.integrator.kind == "step" else "tolerances"
        observed = (
            f"order {whole.order:.1f} ± {SIGMA_FACTOR * whole.order_error:.1f} over {which} "
            f"{usable[0].resolution:g} … {self.finest.resolution:g}"
        )
        derivation = (
            f"mean drift within {BLOCK_COUNT} blocks of time {whole.fine_mean:.2g} {self.unit}, "
            f"{whole.coarse_mean:.2g} at the coarsest: {observed} ({SIGMA_FACTOR:g} σ of the blocks), "
            f"required {required:.3g}, rounding {floor:.2g}"
        )
        pairs = [DriftOrder.from_runs(a, b, self.quantity, end) for a, b in itertools.pairwise(usable)]
        if whole.fine_mean <= allowed and whole.order > SIGMA_FACTOR * whole.order_error:
            verdict, reason = Verdict.AGREES, f"{summary}, vanishing: {observed}"
        elif len(usable) == len(self.study.runs) and all(
            pair.fine_mean > pair.max_fine_mean(required, floor) for pair in [whole, *pairs]
        ):
            # where a coarser step leaves the motion's range, the others may still be too coarse for an order
            verdict = Verdict.DISAGREES
            reason = f"{summary} does not vanish: {observed}, required {required:.3g}"
        else:
            verdict, reason = Verdict.UNRESOLVED, f"{summary}: {observed} does not decide"
        return self.verdict_row(verdict, reason, end, tolerance, derivation, whole.order)

    def is_usable(self, run: LongRun, end: float) -> bool:
        """Whether a run reached the window's end with every invariant in the range of the same motion."""
        scales = self.finest.invariant_scales[end]
        return end in run.windows.get(self.quantity, {}) and all(
            windows[end].max_drift <= MAX_RELATIVE_DRIFT * scales[name]
            for name, windows in run.windows.items()
        )

    def growth_row(self) -> Row:
        """Whether a symmetric method's drift is bounded: the second half of the time adds little to it."""
        end = self.finest.reached_time
        window, first_half = self.windows[end], self.windows[end].max_drift_first_half
        growth = float(np.log2(window.max_drift / first_half)) if first_half > 0 else 0.0
        derivation, common = "", {"value": growth, "tolerance": MAX_SYMMETRIC_GROWTH}
        long_enough = [t for t in sorted(self.windows) if t >= self.shortest]
        unstable = [
            (a, b)
            for a, b in itertools.pairwise(long_enough)
            if self.windows[b].max_drift > UNSTABLE_GROWTH_FACTOR * b / a * self.windows[a].max_drift
        ]
        if window.max_drift <= self.rounding_floor(end):
            verdict, common = Verdict.AGREES, {}
            reason = f"{self.name} is rounding: its growth has no meaning"
        elif unstable:
            (a, b), verdict = unstable[0], Verdict.UNRESOLVED
            reason = (
                f"an unstable motion: {self.name} {self.windows[a].max_drift:.2g} {self.unit} by {a:g} s, "
                f"{self.windows[b].max_drift:.2g} by {b:g} s, faster than a bounded drift or a leak grows"
            )
        else:
            is_bounded = growth < MAX_SYMMETRIC_GROWTH
            verdict = Verdict.AGREES if is_bounded else Verdict.DISAGREES
            outcome = "bounded" if is_bounded else "it grows with time, although the method is symmetric"
            reason = (
                f"{self.name} {first_half:.2g} {self.unit} by {end / 2:g} s, {window.max_drift:.2g} by "
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
        end: float,
        tolerance: float,
        derivation: str,
        order: float | None = None,
    ) -> Row:
        """The row of this invariant; its extra fields hold the largest drift up to each decade."""
        if self.finest.failure is not None:
            reason += f"; in {self.study.plan.seconds:g} s {self.finest.failure}"
        elif end < self.finest.reached_time:
            last = self.windows[self.finest.reached_time].max_drift
            reason += f"; {last:.2g} {self.unit} within {self.finest.reached_time:g} s, which does not decide"
        if self.integrator.kind == "tolerance":
            order = None
        return self.make_row(
            f"{self.quantity}_long",
            verdict,
            reason,
            self.unit,
            value=self.windows[end].max_drift,
            tolerance=tolerance,
            derivation=derivation + self.study.plan.shortening_note,
            compared_until=end,
            order=order,
            declared_order=self.integrator.order if order else None,
            extra={
                "scale": self.scale(end),
                "asked": self.study.plan.requested_seconds,
                **{f"by {t:g} s": self.windows[t].max_drift for t in sorted(self.windows)},
            },
        )

    def make_row(self, quantity: str, verdict: Verdict, reason: str, unit: str, **more: Any) -> Row:
        """A row about this integrator."""
        return self.context.make_row(
            "invariants", self.integrator.name, quantity, verdict, reason, unit, **more
        )


@dataclass(frozen=True)
class DriftOrder:
    """The fall of the mean block drift from a coarse run to a fine one."""

    coarse_mean: float
    fine_mean: float
    halvings: float  # of the step or the tolerance, from one run to the other
    order: float
    order_error: float  # standard error of the order

    @classmethod
    def from_blocks(
        cls, coarse: Float[Array, "blocks"], fine: Float[Array, "blocks"], halvings: float
    ) -> DriftOrder:
        """Fit the order to the drifts of paired blocks.

        Its error is the jackknife's: small where the runs follow one motion and their blocks agree.

        Args:
            coarse: drifts of the coarse run's blocks.
            fine: drifts of the fine run's blocks, same unit.
            halvings: how many times the resolution halves from one to the other.

        Returns:
            The order with its error; NaN where a single block drifts at all.

        """
        number = len(coarse)
        with np.errstate(divide="ignore", invalid="ignore"):
            left_out = np.log2((np.sum(coarse) - coarse) / (np.sum(fine) - fine)) / halvings
            order = np.log2(np.sum(coarse) / np.sum(fine)) / halvings
            scatter = (number - 1) / number * np.sum((left_out - np.mean(left_out)) ** 2)
        means = float(np.mean(coarse)), float(np.mean(fine))
        return cls(*means, halvings, float(order), float(np.sqrt(scatter)))

    @classmethod
    def from_runs(cls, coarse: LongRun, fine: LongRun, quantity: str, end: float) -> DriftOrder:
        """Fit the order to one invariant in one window of two runs.

        Args:
            coarse: the run with the larger step or tolerance.
            end: end of the window [s].

        Returns:
            The order with its error.

        """
        a, b = (run.windows[quantity][end].block_drifts for run in (coarse, fine))
        return cls.from_blocks(a, b, float(np.log2(coarse.resolution / fine.resolution)))

    def max_fine_mean(self, required_order: float, floor: float) -> float:
        """Return the largest mean of the fine blocks that the required order allows.

        Args:
            required_order: least order of the fall.
            floor: drift of a block by rounding, in the invariant's unit.

        Returns:
            The mean, in the invariant's unit; the order's error widens it.

        """
        exponent = self.halvings * (SIGMA_FACTOR * self.order_error - required_order)
        return self.coarse_mean * 2**exponent + floor
