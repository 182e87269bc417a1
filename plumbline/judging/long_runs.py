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

from plumbline.engines.calls import words
from plumbline.engines.registry import adapter
from plumbline.judging.convergence import ORDER_MARGIN
from plumbline.judging.rows import Findings, Subject
from plumbline.model.datatypes import Array, Integrator, Model, Row, State, Trajectory, Unsupported, Verdict
from plumbline.model.invariants import UNITS, invariants, scales
from plumbline.truth.ground_truth import PART, reach

STEPS = {1: (9, 11), 2: (7, 9), 4: (7, 9)}  # order: coarsest and finest step, as -log2 of seconds
RTOLS = (1e6, 1e4)  # relative tolerances of a method with step control, over its tightest
BODY_STEPS = {1: 2**18, 2: 2**17, 4: 2**17}  # most steps × bodies of the finest run; order 1 steps cheaply
BODY_SECONDS = 100.0  # most s × bodies with step control, whose steps are not known beforehand
DECADES = (0.1, 1.0, 10.0, 100.0, 1000.0)  # s: largest drifts are kept up to each, and up to the end
SHORTEST = 1.0  # s: what a run that fails falls back to, by decades
BLOCKS = 16  # of time, in each window
CONTROLLED = 0.125  # s between samples of a method with step control, which ends a step at each
IN_TOLERANCE = 0.5  # order of a drift in the tolerance of a method with step control, at least
SMALL = 0.1  # of an invariant's scale: a larger drift has left the range in which it is one
SIGMAS = 3.0
PER_STEP = 8 * 2.0**-52  # rounding of an invariant in one step, of its scale: a handful of operations
UNSTABLE = 2.0  # times as fast as time: neither a bounded drift nor a secular one grows so
SYMMETRIC_GROWTH = 0.5  # log2 of the drift's growth when time doubles: 0 if it is bounded, 1 if secular


@dataclass(frozen=True)
class Course:
    """How long and how finely one integrator runs; shorter than asked where that costs too much."""

    seconds: float
    resolutions: tuple[float, ...]  # steps in s or relative tolerances, coarse to fine
    asked: float  # s

    @property
    def words(self) -> str:
        """What was left out."""
        if self.seconds == self.asked:
            return ""
        return f"; the limit of steps × bodies allows {self.seconds:g} s of {self.asked:g} s"


@dataclass(frozen=True, eq=False)
class Window:
    """One invariant up to one time."""

    largest: float
    half: float  # largest in the first half
    blocks: Array  # (BLOCKS,) how far it goes from its value at the block's beginning


@dataclass(frozen=True, eq=False)
class LongRun:
    """One run, reduced; ``windows[quantity][t]`` for the windows that it reached."""

    resolution: float
    steps: int
    reached: float  # s
    failure: str | None  # of the longest run that was tried, where a shorter one was made instead
    work_uncertainty: dict[float, float]  # J, by window
    scales: dict[float, dict[str, float]]  # by window: sizes of what the invariants are made of
    windows: dict[str, dict[float, Window]]
    cost: float  # CPU s, of what failed too


@dataclass(frozen=True, eq=False)
class Endured:
    """All runs of one integrator, coarse to fine."""

    runs: list[LongRun]
    plan: Course
    unsupported: str | None = None


def course(integrator: Integrator, bodies: int, seconds: float) -> Course:
    """The affordable length: ``seconds``, halved until the finest run keeps to the limits above."""
    if integrator.kind == "tolerance":
        affordable = BODY_SECONDS / bodies
        resolutions = tuple(integrator.tightest * factor for factor in RTOLS)
    else:
        coarse, fine = STEPS[integrator.order]
        affordable = BODY_STEPS[integrator.order] / bodies / 2**fine
        resolutions = tuple(2.0**-k for k in range(coarse, fine + 1))
    halvings = max(0, int(np.ceil(np.log2(seconds / affordable))))
    return Course(seconds / 2**halvings, resolutions, seconds)


def windows(seconds: float) -> list[float]:
    """Ends of the windows in s: the decades and ``seconds`` itself."""
    return [*(d for d in DECADES if d < seconds), seconds]


# --- inside a worker ----------------------------------------------------------------------------


def endure(engine: str, integrator: str, model: Model, state: State, sample: float, plan: Course) -> Endured:
    """Run at every resolution of the plan; a run that fails is made again a decade shorter."""
    chosen = adapter(engine)
    sample = spacing(chosen.integrator(integrator), model, sample)
    runs: list[LongRun] = []
    for resolution in plan.resolutions:
        begin, failure, trajectory = time.process_time(), None, None
        for seconds in reversed([t for t in windows(plan.seconds) if t >= min(SHORTEST, plan.seconds)]):
            times = np.arange(round(seconds / sample) + 1, dtype=np.float64) * sample
            try:
                trajectory = chosen.simulate(model, state, times, integrator, resolution)
                break
            except Unsupported as refusal:
                return Endured(runs, plan, str(refusal))
            except MemoryError:
                raise  # the worker's limit, told as such
            except Exception as error:  # an engine may raise anything: its words belong in the results
                failure = failure or words(error)
        runs.append(reduced(model, trajectory, resolution, failure, begin))
    return Endured(runs, plan)


def spacing(integrator: Integrator, model: Model, sample: float) -> float:
    """Time in s from one sample to the next, where the scenario's is ``sample``."""
    if integrator.kind == "tolerance" and not (model.has_drag or np.any(model.moment)):
        sample *= max(1, round(CONTROLLED / sample))  # where work is by quadrature, it needs all samples
    return sample


def reduced(
    model: Model, run: Trajectory | None, resolution: float, failure: str | None, begin: float
) -> LongRun:
    """What is kept of a run that began at ``begin`` (process time)."""
    if run is None:
        return LongRun(resolution, 0, 0.0, failure, {}, {}, {}, time.process_time() - begin)
    length, end = float(np.sum(reach(model))), float(run.t[-1])
    kept: dict[str, dict[float, Window]] = {}
    sizes, by_quadrature = {}, {}
    for t in windows(end):
        number = int(np.searchsorted(run.t, t)) + 1
        t_, r, p, v, pdot = (getattr(run, name)[:number] for name in ("t", "r", "p", "v", "pdot"))
        part = Trajectory(t_, r, p, v, pdot, run.steps)
        found = invariants(model, part)
        sizes[t], by_quadrature[t] = scales(model, part, length), found.work_uncertainty
        for quantity in UNITS:
            series = getattr(found, quantity)
            if series is not None:
                kept.setdefault(quantity, {})[t] = window(series)
    cost = time.process_time() - begin
    return LongRun(resolution, run.steps, end, failure, by_quadrature, sizes, kept, cost)


def window(series: Array) -> Window:
    """An invariant's signed samples (T, M, width), reduced."""

    def farthest(part: Array, origin: Array | float) -> float:
        return float(np.max(np.linalg.norm(part - origin, axis=-1)))

    edges = np.linspace(0, len(series) - 1, BLOCKS + 1).astype(int)
    blocks = [farthest(series[a : b + 1], series[a]) for a, b in itertools.pairwise(edges)]
    half = farthest(series[: len(series) // 2 + 1], 0.0)
    return Window(farthest(series, 0.0), half, np.array(blocks))


# --- judging ------------------------------------------------------------------------------------


def judge_endurance(
    who: Subject, model: Model, integrator: Integrator, endured: Endured, regular: bool
) -> Findings:
    """Rows of level "invariants", a quantity's being named ``*_long``; ``regular``: motion without chaos."""
    found = Findings()
    cost = sum(run.cost for run in endured.runs)

    def whole(verdict: Verdict, reason: str) -> Findings:
        extra = {"asked": endured.plan.asked}
        row = who.row("invariants", integrator.name, "all_long", verdict, reason, wall_time=cost, extra=extra)
        return Findings(rows=[row])

    if endured.unsupported is not None:
        return whole("unsupported", endured.unsupported)
    finest = endured.runs[-1]
    if not finest.windows:
        return whole("failed", f"at the finest resolution {finest.resolution:g}: {finest.failure}")
    if finest.failure is not None and not blown_up(endured):
        return whole(
            "failed", f"within {endured.plan.seconds:g} s at {finest.resolution:g}: {finest.failure}"
        )
    for quantity, unit in UNITS.items():
        if quantity in finest.windows:
            judge = Judge(who, integrator, endured, quantity, unit)
            found.rows.append(judge.row())
            if quantity == "energy_drift" and integrator.symmetric and integrator.kind == "step" and regular:
                found.rows.append(judge.growth_row())
    alias = None if model.has_drag else integrator.alias_of  # drag is where they part
    found.rows = [replace(row, wall_time=cost, alias_of=alias) for row in found.rows]
    return found


def blown_up(endured: Endured) -> bool:
    """Whether the finest run's energy, drifting on as it did, would leave its range: a step too coarse."""
    finest = endured.runs[-1]
    drift = finest.windows["energy_drift"][finest.reached].largest
    return (
        drift * endured.plan.seconds / finest.reached > SMALL * finest.scales[finest.reached]["energy_drift"]
    )


@dataclass(frozen=True)
class Judge:
    """One invariant of one integrator's long runs."""

    who: Subject
    integrator: Integrator
    endured: Endured
    quantity: str
    unit: str

    @property
    def name(self) -> str:
        """The quantity in words."""
        return self.quantity.replace("_", " ")

    def scale(self, end: float) -> float:
        """The size of what the invariant is made of, in one window."""
        return self.finest.scales[end][self.quantity]

    @property
    def finest(self) -> LongRun:
        """The run that is judged."""
        return self.endured.runs[-1]

    def rounding(self, end: float, parts: int = 1) -> float:
        """What rounding, an implicit step's solver and the quadrature of work leave in a part of a window."""
        steps = max(self.finest.steps * end / self.finest.reached / parts, 64.0)
        # solved to a tolerance: so many independent mistakes add up like a random walk
        passed = steps * PER_STEP + np.sqrt(steps) * self.integrator.solver
        by_quadrature = self.finest.work_uncertainty[end] if self.quantity == "energy_drift" else 0.0
        return float(passed * self.scale(end)) + by_quadrature

    def passed(self, end: float) -> float:
        """What may drift before an order is asked for: rounding, and what step control lets pass."""
        floor = self.rounding(end)
        if self.integrator.kind == "tolerance":
            steps = self.finest.steps * end / self.finest.reached
            floor += steps * self.finest.resolution * self.scale(end)
        return floor

    def row(self) -> Row:
        """The longest window that can tell; a disagreement in it is never overruled by a shorter one."""
        ends = [t for t in sorted(self.finest.windows[self.quantity], reverse=True) if t >= SHORTEST]
        unresolved: Row | None = None
        for end in ends or [self.finest.reached]:
            row = self.judged(end)
            if row.verdict != "unresolved":
                return row
            unresolved = unresolved or row
        assert unresolved is not None
        return unresolved

    def judged(self, end: float) -> Row:
        """The verdict in one window."""
        drift, floor = self.finest.windows[self.quantity][end].largest, self.passed(end)
        what, passed = f"{self.name} {drift:.2g} {self.unit} within {end:g} s", "rounding"
        if self.integrator.kind == "tolerance":
            passed = f"what the tolerance {self.finest.resolution:g} lets pass in every step"
        scale = self.scale(end)
        why = f"{self.finest.steps} steps in {self.finest.reached:g} s, a scale of {scale:.3g} {self.unit}"
        if drift > floor:
            return self.by_order(end, what)
        if floor <= PART * self.scale(end):
            return self.verdict("agrees", f"{what}: {passed}", end, floor, why)
        return self.verdict("unresolved", f"{what}: {floor:.2g} {self.unit} may be {passed}", end, floor, why)

    def by_order(self, end: float, what: str) -> Row:
        """Does the drift fall with the step (or the tolerance) as the method's order says?"""
        usable = self.usable(end)
        if len(usable) < 2 or usable[-1] is not self.finest:
            reason = (
                f"{what}; of {len(self.endured.runs)} runs {len(usable)} reached it with every drift below "
                f"{SMALL:g} of its scale: too coarse a step"
            )
            return self.verdict("unresolved", reason, end, SMALL * self.scale(end), "")
        floor = self.rounding(end, BLOCKS)
        whole = Fall.between(usable[0], self.finest, self.quantity, end)
        allowed = whole.allowed(self.due, floor)
        tolerance = self.finest.windows[self.quantity][end].largest * allowed / whole.fine
        which = "steps" if self.integrator.kind == "step" else "tolerances"
        falls = (
            f"order {whole.order:.1f} ± {SIGMAS * whole.sigma:.1f} over {which} {usable[0].resolution:g} … "
            f"{self.finest.resolution:g}"
        )
        why = (
            f"mean drift within {BLOCKS} blocks of time {whole.fine:.2g} {self.unit}, {whole.coarse:.2g} at "
            f"the coarsest: {falls} ({SIGMAS:g} σ of the blocks), due {self.due:.3g}, rounding {floor:.2g}"
        )
        if whole.fine <= allowed and whole.order > SIGMAS * whole.sigma:
            return self.verdict("agrees", f"{what}, vanishing: {falls}", end, tolerance, why, whole.order)
        pairs = [Fall.between(a, b, self.quantity, end) for a, b in itertools.pairwise(usable)]
        if all(pair.fine > pair.allowed(self.due, floor) for pair in [whole, *pairs]):
            reason = f"{what} does not vanish: {falls}, due {self.due:.3g}"
            return self.verdict("disagrees", reason, end, tolerance, why, whole.order)
        return self.verdict("unresolved", f"{what}: {falls} cannot tell", end, tolerance, why, whole.order)

    def usable(self, end: float) -> list[LongRun]:
        """The runs that reached the window's end, in range."""
        return [
            run
            for run in self.endured.runs
            if end in run.windows.get(self.quantity, {}) and self.in_range(run, end)
        ]

    def in_range(self, run: LongRun, end: float) -> bool:
        """Whether a run still is of the same motion: nothing that is conserved has gone far."""
        sizes = self.finest.scales[end]
        return all(kept[end].largest <= SMALL * sizes[name] for name, kept in run.windows.items())

    @property
    def due(self) -> float:
        """The order of the drift in the step, at least; in the tolerance where that controls the step.

        Conserved quantities often drift with a higher one.  Step control holds the error of a step below
        the tolerance, not at it: of the notes' collocation on a free top the energy's drift vanishes with
        orders of 0.74 … 1.15 in the tolerance from decade to decade, down to 2e-10 J.
        """
        return self.integrator.order - ORDER_MARGIN if self.integrator.kind == "step" else IN_TOLERANCE

    def growth_row(self) -> Row:
        """Whether a symmetric method's drift is bounded: the second half of the time adds little to it."""
        end = self.finest.reached
        window, floor = self.finest.windows[self.quantity][end], self.rounding(end)
        grown = float(np.log2(window.largest / window.half)) if window.half > 0 else 0.0
        name = f"{self.quantity}_long_growth"
        extra = {"asked": self.endured.plan.asked}
        common = {"value": grown, "tolerance": SYMMETRIC_GROWTH, "horizon": end, "extra": extra}
        if window.largest <= floor:
            reason = f"{self.name} is rounding: its growth says nothing"
            return self.new(name, "agrees", reason, "1", horizon=end, extra=extra)
        kept = self.finest.windows[self.quantity]
        for a, b in itertools.pairwise(t for t in sorted(kept) if t >= SHORTEST):
            if kept[b].largest > UNSTABLE * b / a * kept[a].largest:
                reason = (
                    f"an unstable motion: {self.name} {kept[a].largest:.2g} {self.unit} by {a:g} s, "
                    f"{kept[b].largest:.2g} by {b:g} s, which neither a bounded drift nor a leak does"
                )
                return self.new(name, "unresolved", reason, "1", **common)
        verdict: Verdict = "agrees" if grown < SYMMETRIC_GROWTH else "disagrees"
        reason = (
            f"{self.name} {window.half:.2g} {self.unit} by {end / 2:g} s, {window.largest:.2g} by {end:g} s: "
            f"{'bounded' if verdict == 'agrees' else 'it grows with time, of a symmetric method'}"
        )
        why = "log2 of the growth as time doubles: 0 where bounded, 1 where secular; the middle is the limit"
        return self.new(name, verdict, reason, "1", derivation=why, **common)

    def verdict(
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
            beyond = f"; in {self.endured.plan.seconds:g} s {self.finest.failure}"
        elif end < self.finest.reached:
            last = kept[self.finest.reached]
            beyond = f"; {last.largest:.2g} {self.unit} within {self.finest.reached:g} s, which cannot tell"
        extra = {f"by {t:g} s": kept[t].largest for t in sorted(kept)}
        return self.new(
            f"{self.quantity}_long",
            verdict,
            reason + beyond,
            self.unit,
            value=kept[end].largest,
            tolerance=tolerance,
            derivation=why + self.endured.plan.words,
            horizon=end,
            order=order if self.integrator.kind == "step" else None,
            declared_order=self.integrator.order if order and self.integrator.kind == "step" else None,
            extra={"scale": self.scale(end), "asked": self.endured.plan.asked, **extra},
        )

    def new(self, quantity: str, verdict: Verdict, reason: str, unit: str, **more: Any) -> Row:
        """A row about this integrator."""
        return self.who.row("invariants", self.integrator.name, quantity, verdict, reason, unit, **more)


@dataclass(frozen=True)
class Fall:
    """How the mean of paired blocks falls from a coarse run to a fine one."""

    coarse: float
    fine: float
    halvings: float  # of the step or the tolerance, from one to the other
    order: float
    sigma: float  # standard error of the order

    @classmethod
    def of(cls, coarse: Array, fine: Array, halvings: float) -> Fall:
        """Its error is by the jackknife: small where the runs follow one motion and their blocks agree."""
        number = len(coarse)
        with np.errstate(divide="ignore", invalid="ignore"):  # a single block that moves has no error: NaN
            left_out = np.log2((np.sum(coarse) - coarse) / (np.sum(fine) - fine)) / halvings
            order = np.log2(np.sum(coarse) / np.sum(fine)) / halvings
            scatter = (number - 1) / number * np.sum((left_out - np.mean(left_out)) ** 2)
        means = float(np.mean(coarse)), float(np.mean(fine))
        return cls(*means, halvings, float(order), float(np.sqrt(scatter)))

    @classmethod
    def between(cls, coarse: LongRun, fine: LongRun, quantity: str, end: float) -> Fall:
        """Of one quantity, in one window of two runs."""
        a, b = (run.windows[quantity][end].blocks for run in (coarse, fine))
        return cls.of(a, b, float(np.log2(coarse.resolution / fine.resolution)))

    def allowed(self, due: float, floor: float) -> float:
        """The mean of the fine blocks that the coarse ones and the order due foresee, at most."""
        return self.coarse * 2 ** (self.halvings * (SIGMAS * self.sigma - due)) + floor
