"""A long run, as short as still shows it: an invariant that does not fall with the step, or that grows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plumbline.judging.long_run_study import (
    BLOCK_COUNT,
    LongRunPlan,
    LongRunStudy,
    plan_long_run,
    run_long_run_study,
)
from plumbline.judging.long_run_study import (
    _sample_spacing as sample_spacing,
)
from plumbline.judging.long_runs import _DriftJudge as DriftJudge
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.model.datatypes import Array, Integrator
from plumbline.model.invariants import INVARIANT_UNITS
from plumbline.reproduce.engine_client import OfRuns
from plumbline.reproduce.shrink import Case

LONG, GROWTH = "_long", "_long_growth"  # how the names of such rows' quantities end
GROWN = 10.0  # s: in less, a bounded drift that swings may still be on its way out


@dataclass(frozen=True, eq=False)
class ShownLong:
    """Runs in which what is conserved drifts more than the method's order explains, or ever farther."""

    case: Case
    ratio: float
    times: Array  # (T,) s
    integrator: Integrator
    drifts: tuple[str, ...]  # invariants
    growth: bool  # whether it is the drift's growth with time that is in dispute
    due: float  # order in the step or tolerance, at least
    rounding: dict[str, float]  # of a block of time, per invariant, in its unit
    passed: dict[str, float]  # what the whole run may drift by before any order is asked for


@dataclass
class OverLong(OfRuns):
    """By how much invariants of long runs are off, judged as the nightly judges them in the whole window."""

    wanted: tuple[str, ...]
    sample: float  # s, the scenario's

    @property
    def growth(self) -> bool:
        """Whether growth with time is in dispute; it is bounded in a regular motion only."""
        return self.wanted[0].endswith(GROWTH)

    def whole(self, case: Case) -> Case:
        """A case at the resolutions of the nightly; of growth the finest is judged, alone."""
        every = plan_long_run(self.integrator, case.model.n, case.until).resolutions
        return replace(case, steps=every[-1:] if self.growth else every)

    def __call__(self, case: Case) -> ShownLong | None:
        """None for what the engine refuses, and for a run too short to be judged."""
        sample = sample_spacing(self.integrator, case.model, self.sample)
        count = round(case.until / sample)
        if (
            abs(count * sample - case.until) > 1e-9 * case.until
            or count < BLOCK_COUNT
            or (self.growth and case.until < GROWN)
        ):
            return None
        plan = LongRunPlan(case.until, case.steps, case.until)
        try:
            endured: LongRunStudy = self.engine.ask(
                run_long_run_study, self.method, case.model, case.state, sample, plan
            )
        except Exception:
            return None
        if endured.unsupported is not None or endured.runs[-1].failure is not None:
            return None
        who = RowContext("", "", self.engine.name, self.engine.name, "")
        kept, end = endured.runs[-1].windows, endured.runs[-1].reached_time
        wanted = (q.removesuffix(GROWTH).removesuffix(LONG) for q in self.wanted)
        judges = {
            q: DriftJudge(who, self.integrator, endured, q, INVARIANT_UNITS[q]) for q in wanted if q in kept
        }
        if not judges:
            return None
        off = {
            q: excess(judge.growth_row() if self.growth else judge.judge_window(end))
            for q, judge in judges.items()
        }
        judges = {q: judge for q, judge in judges.items() if off[q]} or judges
        judge = next(iter(judges.values()))
        runs = endured.runs if self.growth else [run for run in judge.study.runs if judge.is_usable(run, end)]
        return ShownLong(
            replace(case, steps=tuple(run.resolution for run in runs)),
            max(off.values()),
            np.arange(count + 1, dtype=np.float64) * sample,
            self.integrator,
            tuple(judges),
            self.growth,
            judge.required_order,
            {q: float(judge.rounding_floor(end, BLOCK_COUNT)) for q, judge in judges.items()},
            {q: float(judge.allowed_drift(end)) for q, judge in judges.items()},
        )


def excess(row: Row) -> float:
    """Drift, or its growth, over what is allowed, of a row that disagrees; else 0."""
    return (row.value or 0.0) / (row.tolerance or 1.0) if row.verdict == Verdict.DISAGREES else 0.0
