"""Long runs: what conserved quantities do over 100 s, where chaos leaves no position to compare.

No truth is needed.  One motion runs at three steps; how far each invariant drifts within blocks of time is
a sample of one distribution whether or not the runs still follow each other, so the drifts' fall from
step to step shows an order, with an error of the blocks' scatter.  A drift that no step removes (a leak of
energy, a joint that creeps, a reset) does not fall.  A method with step control must keep each invariant
within what its tolerance lets pass in every step.  A symmetric method's energy, in a regular motion, must
not grow with time at all (E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, XI.3).

`endure` runs inside a worker and reduces there: no trajectory of 100 s crosses.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plumbline.engines.calls import format_exception
from plumbline.engines.registry import load_adapter
from plumbline.judging.convergence import ORDER_MARGIN
from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict
from plumbline.model.datatypes import Array, Integrator, Model, State, Trajectory, Unsupported
from plumbline.model.invariants import INVARIANT_UNITS, compute_invariants, invariant_scales
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR, stretched_length

LONG_RUN_STEP_EXPONENTS = {
    1: (9, 11),
    2: (7, 9),
    4: (7, 9),
}  # order: coarsest and finest step, as -log2 of seconds
RTOL_FACTORS = (1e6, 1e4)  # relative tolerances of a method with step control, over its tightest
MAX_BODY_STEPS = {
    1: 2**18,
    2: 2**17,
    4: 2**17,
}  # most steps × bodies of the finest run; order 1 steps cheaply
MAX_BODY_SECONDS = 100.0  # most s × bodies with step control, whose steps are not known beforehand
WINDOW_ENDS = (0.1, 1.0, 10.0, 100.0, 1000.0)  # s: largest drifts are kept up to each, and up to the end
MIN_WINDOW_SECONDS = 1.0  # s: what a run that fails falls back to, by decades
BLOCK_COUNT = 16  # of time, in each window
ADAPTIVE_SAMPLE_SPACING = 0.125  # s between samples of a method with step control, which ends a step at each
MIN_ORDER_IN_TOLERANCE = 0.5  # order of a drift in the tolerance of a method with step control, at least
MAX_RELATIVE_DRIFT = 0.1  # of an invariant's scale: a larger drift has left the range in which it is one
SIGMA_FACTOR = 3.0
ROUNDING_PER_STEP = (
    8 * 2.0**-52
)  # rounding of an invariant in one step, of its scale: a handful of operations
UNSTABLE_GROWTH_FACTOR = 2.0  # times as fast as time: neither a bounded drift nor a secular one grows so
MAX_SYMMETRIC_GROWTH = 0.5  # log2 of the drift's growth when time doubles: 0 if it is bounded, 1 if secular


@dataclass(frozen=True)
class LongRunPlan:
    """How long and how finely one integrator runs; shorter than asked where that costs too much."""

    seconds: float
    resolutions: tuple[float, ...]  # steps in s or relative tolerances, coarse to fine
    requested_seconds: float  # s

    @property
    def shortening_note(self) -> str:
        """What was left out."""
        if self.seconds == self.requested_seconds:
            return ""
        return f"; the limit of steps × bodies allows {self.seconds:g} s of {self.requested_seconds:g} s"


@dataclass(frozen=True, eq=False)
class DriftWindow:
    """One invariant up to one time."""

    max_drift: float
    max_drift_first_half: float  # largest in the first half
    block_drifts: Array  # (BLOCKS,) how far it goes from its value at the block's beginning


@dataclass(frozen=True, eq=False)
class LongRun:
    """One run, reduced; ``windows[quantity][t]`` for the windows that it reached."""

    resolution: float
    steps: int
    reached_time: float  # s
    failure: str | None  # of the longest run that was tried, where a shorter one was made instead
    work_uncertainty: dict[float, float]  # J, by window
    invariant_scales: dict[float, dict[str, float]]  # by window: sizes of what the invariants are made of
    windows: dict[str, dict[float, DriftWindow]]
    cpu_time: float  # CPU s, of what failed too


@dataclass(frozen=True, eq=False)
class LongRunStudy:
    """All runs of one integrator, coarse to fine."""

    runs: list[LongRun]
    plan: LongRunPlan
    unsupported: str | None = None


def plan_long_run(integrator: Integrator, bodies: int, seconds: float) -> LongRunPlan:
    """The affordable length: ``seconds``, halved until the finest run keeps to the limits above."""
    if integrator.kind == "tolerance":
        affordable = MAX_BODY_SECONDS / bodies
        resolutions = tuple(integrator.min_rtol * factor for factor in RTOL_FACTORS)
    else:
        coarse, fine = LONG_RUN_STEP_EXPONENTS[integrator.order]
        affordable = MAX_BODY_STEPS[integrator.order] / bodies / 2**fine
        resolutions = tuple(2.0**-k for k in range(coarse, fine + 1))
    halvings = max(0, int(np.ceil(np.log2(seconds / affordable))))
    return LongRunPlan(seconds / 2**halvings, resolutions, seconds)


def window_ends(seconds: float) -> list[float]:
    """Ends of the windows in s: the decades and ``seconds`` itself."""
    return [*(d for d in WINDOW_ENDS if d < seconds), seconds]


# --- inside a worker ----------------------------------------------------------------------------


def run_long_run_study(
    engine: str, integrator: str, model: Model, state: State, sample_interval: float, plan: LongRunPlan
) -> LongRunStudy:
    """Run at every resolution of the plan; a run that fails is made again a decade shorter."""
    chosen = load_adapter(engine)
    sample_interval = sample_spacing(chosen.integrator(integrator), model, sample_interval)
    runs: list[LongRun] = []
    for resolution in plan.resolutions:
        begin, failure, trajectory = time.process_time(), None, None
        for seconds in reversed(
            [t for t in window_ends(plan.seconds) if t >= min(MIN_WINDOW_SECONDS, plan.seconds)]
        ):
            times = np.arange(round(seconds / sample_interval) + 1, dtype=np.float64) * sample_interval
            try:
                trajectory = chosen.simulate(model, state, times, integrator, resolution)
                break
            except Unsupported as refusal:
                return LongRunStudy(runs, plan, str(refusal))
            except MemoryError:
                raise  # the worker's limit, told as such
            except Exception as error:  # an engine may raise anything: its words belong in the results
                failure = failure or format_exception(error)
        runs.append(reduce_long_run(model, trajectory, resolution, failure, begin))
    return LongRunStudy(runs, plan)


def sample_spacing(integrator: Integrator, model: Model, sample_interval: float) -> float:
    """Time in s from one sample to the next, where the scenario's is ``sample``."""
    if integrator.kind == "tolerance" and not (model.has_drag or np.any(model.moment)):
        sample_interval *= max(
            1, round(ADAPTIVE_SAMPLE_SPACING / sample_interval)
        )  # where work is by quadrature, it needs all samples
    return sample_interval


def reduce_long_run(
    model: Model, run: Trajectory | None, resolution: float, failure: str | None, begin: float
) -> LongRun:
    """What is kept of a run that began at ``begin`` (process time)."""
    if run is None:
        return LongRun(resolution, 0, 0.0, failure, {}, {}, {}, time.process_time() - begin)
    length, end = float(np.sum(stretched_length(model))), float(run.t[-1])
    kept: dict[str, dict[float, DriftWindow]] = {}
    sizes, by_quadrature = {}, {}
    for t in window_ends(end):
        number = int(np.searchsorted(run.t, t)) + 1
        t_, r, p, v, pdot = (getattr(run, name)[:number] for name in ("t", "r", "p", "v", "pdot"))
        part = Trajectory(t_, r, p, v, pdot, run.steps)
        found = compute_invariants(model, part)
        sizes[t], by_quadrature[t] = invariant_scales(model, part, length), found.work_uncertainty
        for quantity in INVARIANT_UNITS:
            series = getattr(found, quantity)
            if series is not None:
                kept.setdefault(quantity, {})[t] = reduce_window(series)
    cost = time.process_time() - begin
    return LongRun(resolution, run.steps, end, failure, by_quadrature, sizes, kept, cost)


def reduce_window(series: Array) -> DriftWindow:
    """An invariant's signed samples (T, M, width), reduced."""

    def farthest(part: Array, origin: Array | float) -> float:
        return float(np.max(np.linalg.norm(part - origin, axis=-1)))

    edges = np.linspace(0, len(series) - 1, BLOCK_COUNT + 1).astype(int)
    blocks = [farthest(series[a : b + 1], series[a]) for a, b in itertools.pairwise(edges)]
    half = farthest(series[: len(series) // 2 + 1], 0.0)
    return DriftWindow(farthest(series, 0.0), half, np.array(blocks))


# --- judging ------------------------------------------------------------------------------------


def judge_long_runs(
    who: RowContext, model: Model, integrator: Integrator, endured: LongRunStudy, is_regular: bool
) -> JudgingResult:
    """Rows of level "invariants", a quantity's being named ``*_long``; ``regular``: motion without chaos."""
    found = JudgingResult()
    cost = sum(run.cpu_time for run in endured.runs)

    def whole(verdict: Verdict, reason: str) -> JudgingResult:
        extra = {"asked": endured.plan.requested_seconds}
        row = who.make_row(
            "invariants", integrator.name, "all_long", verdict, reason, cpu_time=cost, extra=extra
        )
        return JudgingResult(rows=[row])

    if endured.unsupported is not None:
        return whole(Verdict.UNSUPPORTED, endured.unsupported)
    finest = endured.runs[-1]
    if not finest.windows:
        return whole(Verdict.FAILED, f"at the finest resolution {finest.resolution:g}: {finest.failure}")
    if finest.failure is not None and not has_blown_up(endured):
        return whole(
            Verdict.FAILED, f"within {endured.plan.seconds:g} s at {finest.resolution:g}: {finest.failure}"
        )
    for quantity, unit in INVARIANT_UNITS.items():
        if quantity in finest.windows:
            judge = DriftJudge(who, integrator, endured, quantity, unit)
            found.rows.append(judge.window_row())
            if (
                quantity == "energy_drift"
                and integrator.is_symmetric
                and integrator.kind == "step"
                and is_regular
            ):
                found.rows.append(judge.growth_row())
    alias = None if model.has_drag else integrator.alias_of  # drag is where they part
    found.rows = [replace(row, cpu_time=cost, alias_of=alias) for row in found.rows]
    return found


def has_blown_up(endured: LongRunStudy) -> bool:
    """Whether the finest run's energy, drifting on as it did, would leave its range: a step too coarse."""
    finest = endured.runs[-1]
    drift = finest.windows["energy_drift"][finest.reached_time].max_drift
    return (
        drift * endured.plan.seconds / finest.reached_time
        > MAX_RELATIVE_DRIFT * finest.invariant_scales[finest.reached_time]["energy_drift"]
    )


@dataclass(frozen=True)
class DriftJudge:
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

    def scale(self, end: float) -> float:
        """The size of what the invariant is made of, in one window."""
        return self.finest.invariant_scales[end][self.quantity]

    @property
    def finest(self) -> LongRun:
        """The run that is judged."""
        return self.study.runs[-1]

    def rounding_floor(self, end: float, parts: int = 1) -> float:
        """What rounding, an implicit step's solver and the quadrature of work leave in a part of a window."""
        steps = max(self.finest.steps * end / self.finest.reached_time / parts, 64.0)
        # solved to a tolerance: so many independent mistakes add up like a random walk
        passed = steps * ROUNDING_PER_STEP + np.sqrt(steps) * self.integrator.solver_rtol
        by_quadrature = self.finest.work_uncertainty[end] if self.quantity == "energy_drift" else 0.0
        return float(passed * self.scale(end)) + by_quadrature

    def allowed_drift(self, end: float) -> float:
        """What may drift before an order is asked for: rounding, and what step control lets pass."""
        floor = self.rounding_floor(end)
        if self.integrator.kind == "tolerance":
            steps = self.finest.steps * end / self.finest.reached_time
            floor += steps * self.finest.resolution * self.scale(end)
        return floor

    def window_row(self) -> Row:
        """The longest window that can tell; a disagreement in it is never overruled by a shorter one."""
        ends = [
            t for t in sorted(self.finest.windows[self.quantity], reverse=True) if t >= MIN_WINDOW_SECONDS
        ]
        unresolved: Row | None = None
        for end in ends or [self.finest.reached_time]:
            row = self.judge_window(end)
            if row.verdict != Verdict.UNRESOLVED:
                return row
            unresolved = unresolved or row
        assert unresolved is not None
        return unresolved

    def judge_window(self, end: float) -> Row:
        """The verdict in one window."""
        drift, floor = self.finest.windows[self.quantity][end].max_drift, self.allowed_drift(end)
        what, passed = f"{self.name} {drift:.2g} {self.unit} within {end:g} s", "rounding"
        if self.integrator.kind == "tolerance":
            passed = f"what the tolerance {self.finest.resolution:g} lets pass in every step"
        scale = self.scale(end)
        why = (
            f"{self.finest.steps} steps in {self.finest.reached_time:g} s, a scale of {scale:.3g} {self.unit}"
        )
        if drift > floor:
            return self.judge_order(end, what)
        if floor <= DETECTABLE_PARAMETER_ERROR * self.scale(end):
            return self.verdict_row(Verdict.AGREES, f"{what}: {passed}", end, floor, why)
        return self.verdict_row(
            Verdict.UNRESOLVED, f"{what}: {floor:.2g} {self.unit} may be {passed}", end, floor, why
        )

    def judge_order(self, end: float, what: str) -> Row:
        """Does the drift fall with the step (or the tolerance) as the method's order says?"""
        usable = self.usable_runs(end)
        if len(usable) < 2 or usable[-1] is not self.finest:
            reason = (
                f"{what}; of {len(self.study.runs)} runs {len(usable)} reached it with every drift below "
                f"{MAX_RELATIVE_DRIFT:g} of its scale: too coarse a step"
            )
            return self.verdict_row(Verdict.UNRESOLVED, reason, end, MAX_RELATIVE_DRIFT * self.scale(end), "")
        floor = self.rounding_floor(end, BLOCK_COUNT)
        whole = DriftOrder.from_runs(usable[0], self.finest, self.quantity, end)
        allowed = whole.max_fine_mean(self.required_order, floor)
        tolerance = self.finest.windows[self.quantity][end].max_drift * allowed / whole.fine_mean
        which = "steps" if self.integrator.kind == "step" else "tolerances"
        falls = (
            f"order {whole.order:.1f} ± {SIGMA_FACTOR * whole.order_error:.1f} over {which} {usable[0].resolution:g} … "
            f"{self.finest.resolution:g}"
        )
        why = (
            f"mean drift within {BLOCK_COUNT} blocks of time {whole.fine_mean:.2g} {self.unit}, {whole.coarse_mean:.2g} at "
            f"the coarsest: {falls} ({SIGMA_FACTOR:g} σ of the blocks), due {self.required_order:.3g}, rounding {floor:.2g}"
        )
        if whole.fine_mean <= allowed and whole.order > SIGMA_FACTOR * whole.order_error:
            return self.verdict_row(
                Verdict.AGREES, f"{what}, vanishing: {falls}", end, tolerance, why, whole.order
            )
        pairs = [DriftOrder.from_runs(a, b, self.quantity, end) for a, b in itertools.pairwise(usable)]
        if all(pair.fine_mean > pair.max_fine_mean(self.required_order, floor) for pair in [whole, *pairs]):
            reason = f"{what} does not vanish: {falls}, due {self.required_order:.3g}"
            return self.verdict_row(Verdict.DISAGREES, reason, end, tolerance, why, whole.order)
        return self.verdict_row(
            Verdict.UNRESOLVED, f"{what}: {falls} cannot tell", end, tolerance, why, whole.order
        )

    def usable_runs(self, end: float) -> list[LongRun]:
        """The runs that reached the window's end, in range."""
        return [
            run
            for run in self.study.runs
            if end in run.windows.get(self.quantity, {}) and self.is_in_range(run, end)
        ]

    def is_in_range(self, run: LongRun, end: float) -> bool:
        """Whether a run still is of the same motion: nothing that is conserved has gone far."""
        sizes = self.finest.invariant_scales[end]
        return all(
            kept[end].max_drift <= MAX_RELATIVE_DRIFT * sizes[name] for name, kept in run.windows.items()
        )

    @property
    def required_order(self) -> float:
        """The order of the drift in the step, at least; in the tolerance where that controls the step.

        Conserved quantities often drift with a higher one.  Step control holds the error of a step below
        the tolerance, not at it: of the notes' collocation on a free top the energy's drift vanishes with
        orders of 0.74 … 1.15 in the tolerance from decade to decade, down to 2e-10 J.
        """
        return (
            self.integrator.order - ORDER_MARGIN if self.integrator.kind == "step" else MIN_ORDER_IN_TOLERANCE
        )

    def growth_row(self) -> Row:
        """Whether a symmetric method's drift is bounded: the second half of the time adds little to it."""
        end = self.finest.reached_time
        window, floor = self.finest.windows[self.quantity][end], self.rounding_floor(end)
        grown = (
            float(np.log2(window.max_drift / window.max_drift_first_half))
            if window.max_drift_first_half > 0
            else 0.0
        )
        name = f"{self.quantity}_long_growth"
        extra = {"asked": self.study.plan.requested_seconds}
        common = {"value": grown, "tolerance": MAX_SYMMETRIC_GROWTH, "compared_until": end, "extra": extra}
        if window.max_drift <= floor:
            reason = f"{self.name} is rounding: its growth says nothing"
            return self.make_row(name, Verdict.AGREES, reason, "1", compared_until=end, extra=extra)
        kept = self.finest.windows[self.quantity]
        for a, b in itertools.pairwise(t for t in sorted(kept) if t >= MIN_WINDOW_SECONDS):
            if kept[b].max_drift > UNSTABLE_GROWTH_FACTOR * b / a * kept[a].max_drift:
                reason = (
                    f"an unstable motion: {self.name} {kept[a].max_drift:.2g} {self.unit} by {a:g} s, "
                    f"{kept[b].max_drift:.2g} by {b:g} s, which neither a bounded drift nor a leak does"
                )
                return self.make_row(name, Verdict.UNRESOLVED, reason, "1", **common)
        verdict: Verdict = Verdict.AGREES if grown < MAX_SYMMETRIC_GROWTH else Verdict.DISAGREES
        reason = (
            f"{self.name} {window.max_drift_first_half:.2g} {self.unit} by {end / 2:g} s, {window.max_drift:.2g} by {end:g} s: "
            f"{'bounded' if verdict == 'agrees' else 'it grows with time, of a symmetric method'}"
        )
        why = "log2 of the growth as time doubles: 0 where bounded, 1 where secular; the middle is the limit"
        return self.make_row(name, verdict, reason, "1", derivation=why, **common)

    def verdict_row(
        self,
        verdict: Verdict,
        reason: str,
        end: float,
        tolerance: float,
        why: str,
        order: float | None = None,
    ) -> Row:
        """The row of this quantity; its extra holds the largest drift up to each decade."""
        kept = self.finest.windows[self.quantity]
        beyond = ""
        if self.finest.failure is not None:
            beyond = f"; in {self.study.plan.seconds:g} s {self.finest.failure}"
        elif end < self.finest.reached_time:
            last = kept[self.finest.reached_time]
            beyond = (
                f"; {last.max_drift:.2g} {self.unit} within {self.finest.reached_time:g} s, which cannot tell"
            )
        extra = {f"by {t:g} s": kept[t].max_drift for t in sorted(kept)}
        return self.make_row(
            f"{self.quantity}_long",
            verdict,
            reason + beyond,
            self.unit,
            value=kept[end].max_drift,
            tolerance=tolerance,
            derivation=why + self.study.plan.shortening_note,
            compared_until=end,
            order=order if self.integrator.kind == "step" else None,
            declared_order=self.integrator.order if order and self.integrator.kind == "step" else None,
            extra={"scale": self.scale(end), "asked": self.study.plan.requested_seconds, **extra},
        )

    def make_row(self, quantity: str, verdict: Verdict, reason: str, unit: str, **more: Any) -> Row:
        """A row about this integrator."""
        return self.context.make_row(
            "invariants", self.integrator.name, quantity, verdict, reason, unit, **more
        )


@dataclass(frozen=True)
class DriftOrder:
    """How the mean of paired blocks falls from a coarse run to a fine one."""

    coarse_mean: float
    fine_mean: float
    halvings: float  # of the step or the tolerance, from one to the other
    order: float
    order_error: float  # standard error of the order

    @classmethod
    def from_blocks(cls, coarse: Array, fine: Array, halvings: float) -> DriftOrder:
        """Its error is by the jackknife: small where the runs follow one motion and their blocks agree."""
        number = len(coarse)
        with np.errstate(divide="ignore", invalid="ignore"):  # a single block that moves has no error: NaN
            left_out = np.log2((np.sum(coarse) - coarse) / (np.sum(fine) - fine)) / halvings
            order = np.log2(np.sum(coarse) / np.sum(fine)) / halvings
            scatter = (number - 1) / number * np.sum((left_out - np.mean(left_out)) ** 2)
        means = float(np.mean(coarse)), float(np.mean(fine))
        return cls(*means, halvings, float(order), float(np.sqrt(scatter)))

    @classmethod
    def from_runs(cls, coarse: LongRun, fine: LongRun, quantity: str, end: float) -> DriftOrder:
        """Of one quantity, in one window of two runs."""
        a, b = (run.windows[quantity][end].block_drifts for run in (coarse, fine))
        return cls.from_blocks(a, b, float(np.log2(coarse.resolution / fine.resolution)))

    def max_fine_mean(self, due: float, floor: float) -> float:
        """The mean of the fine blocks that the coarse ones and the order due foresee, at most."""
        return self.coarse_mean * 2 ** (self.halvings * (SIGMA_FACTOR * self.order_error - due)) + floor
