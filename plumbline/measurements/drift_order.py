"""The drift of an invariant in long runs, and the order by which it falls from run to run.

How far an invariant drifts within blocks of time is a sample of one distribution, whether or not the runs
still follow each other; so the fall of the drifts from step to step shows an order, whose error is the
scatter of the blocks.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from plumbline.engines.no_answer import NoAnswer
from plumbline.measurements.order_and_limit import ORDER_MARGIN, falls_with_resolution
from plumbline.measurements.refinement_study import ROUNDING_PER_STEP
from plumbline.model.datatypes import Array, Float, Integrator

MAX_RELATIVE_DRIFT = 0.1  # of an invariant's scale: beyond, the step is too coarse for this motion
BLOCK_COUNT = 16  # blocks of time in each window
MIN_ORDER_IN_TOLERANCE = 0.5  # order of a drift in the tolerance of a method with step control, at least
SIGMA_FACTOR = 3.0
SAME_DRIFT = 0.01  # relative difference of drifts that runs have in common


@dataclass(frozen=True, eq=False)
class DriftWindow:
    """The drift of one invariant up to one time, in the invariant's unit."""

    max_drift: float
    max_drift_first_half: float  # largest in the first half of the window
    block_drifts: Float[Array, "blocks"]  # largest distance from the value at the block's beginning


@dataclass(frozen=True, eq=False)
class LongRun:
    """One run, reduced; dictionaries have one entry per window that it reached, by its end [s]."""

    resolution: float  # step [s], or relative tolerance
    steps: int
    reached_time: float  # s
    failure: NoAnswer | None  # of the longest run that was tried, where a shorter one replaces it
    uncertainty: dict[float, dict[str, float]]  # `Invariants.uncertainty` by window and invariant
    invariant_scales: dict[float, dict[str, float]]  # by window and invariant
    windows: dict[str, dict[float, DriftWindow]]  # by invariant and window
    cpu_time: float  # s, failed runs included
    solver_rtol: float = 0.0  # see `Trajectory`


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


@dataclass(frozen=True)
class InvariantDrift:
    """One invariant within one window of an integrator's long runs, coarse to fine."""

    runs: Sequence[LongRun]  # the finest one reached the window's end
    integrator: Integrator
    quantity: str
    end: float  # of the window [s]

    @property
    def finest(self) -> LongRun:
        """The run that is judged."""
        return self.runs[-1]

    @property
    def max_drift(self) -> float:
        """Largest drift of the finest run, in the invariant's unit."""
        return self.finest.windows[self.quantity][self.end].max_drift

    @property
    def scale(self) -> float:
        """Scale of the invariant in this window."""
        return self.finest.invariant_scales[self.end][self.quantity]

    @property
    def steps(self) -> float:
        """Steps of the finest run in this window."""
        return self.finest.steps * self.end / self.finest.reached_time

    @property
    def uncertainty(self) -> float:
        """Drift by the quadrature of work and by the limit of softer runs."""
        return self.finest.uncertainty[self.end][self.quantity]

    def rounding_floor(self, parts: int = 1) -> float:
        """Drift in a part of the window by rounding and by the steps' solver, and its uncertainty."""
        steps = max(self.steps / parts, 64.0)
        # The solver's errors are independent from step to step: they add up like a random walk.
        relative = steps * ROUNDING_PER_STEP + np.sqrt(steps) * self.finest.solver_rtol
        return float(relative * self.scale) + self.uncertainty

    @property
    def allowed_drift(self) -> float:
        """Drift that needs no order: rounding, and the error that step control accepts."""
        accepted = self.steps * self.finest.resolution if self.integrator.kind == "tolerance" else 0.0
        return self.rounding_floor() + accepted * self.scale

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

    @cached_property
    def usable_runs(self) -> list[LongRun]:
        """The runs that reached the window's end with every invariant in the range of the same motion."""
        scales = self.finest.invariant_scales[self.end]
        return [
            run
            for run in self.runs
            if self.end in run.windows.get(self.quantity, {})
            and all(
                windows[self.end].max_drift <= MAX_RELATIVE_DRIFT * scales[name]
                for name, windows in run.windows.items()
            )
        ]

    def order_between(self, coarse: LongRun, fine: LongRun) -> DriftOrder:
        """Fit the order from one run to a finer one."""
        a, b = (run.windows[self.quantity][self.end].block_drifts for run in (coarse, fine))
        return DriftOrder.from_blocks(a, b, float(np.log2(coarse.resolution / fine.resolution)))

    def max_fine_mean(self, order: DriftOrder) -> float:
        """Return the largest mean of the finer run's blocks that the method's order allows.

        The order's error widens it, and what a block drifts by rounding is added.
        """
        exponent = order.halvings * (SIGMA_FACTOR * order.order_error - self.required_order)
        return order.coarse_mean * 2**exponent + self.rounding_floor(BLOCK_COUNT)

    @property
    def is_matter_of_steps(self) -> bool:
        """Whether the largest drift falls from the coarsest run to the finest, or is allowed.

        Where a run leaves the motion's range, drifts need not fall: unless all runs have the same one.
        """
        windows = [run.windows.get(self.quantity, {}).get(self.end) for run in self.runs]
        drifts = [np.inf if window is None else window.max_drift for window in windows]
        if len(self.usable_runs) < len(self.runs) and self.max_drift > self.allowed_drift:
            return not np.allclose(drifts, self.max_drift, rtol=SAME_DRIFT, atol=0.0)
        return falls_with_resolution([drifts[0], drifts[-1]], self.allowed_drift)

    @property
    def falls_too_slowly(self) -> bool:
        """Whether it falls slower than the method's order, from the first run to the last and in each pair.

        Where a coarser run leaves the motion's range, the others may still be too coarse for an order.
        """
        runs = self.usable_runs
        if len(runs) < max(len(self.runs), 2) or self.max_drift <= self.allowed_drift:
            return False
        orders = [self.order_between(*pair) for pair in ((runs[0], runs[-1]), *itertools.pairwise(runs))]
        return all(one.fine_mean > self.max_fine_mean(one) for one in orders)
