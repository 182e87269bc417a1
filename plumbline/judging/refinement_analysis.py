"""One integrator's refinement study on one scenario: samples, order, limit and windows of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from plumbline.engines.engine_calls import RefinementRun
from plumbline.judging.rows import RowContext, Verdict, first_decided
from plumbline.measurements.order_and_limit import (
    ORDER_MARGIN,
    ROUNDING_FLOOR_FACTOR,
    ExtrapolatedLimit,
    ObservedOrder,
    falls_with_resolution,
    max_norm,
    observed_order,
    romberg,
    tightest_tolerance_limit,
)
from plumbline.measurements.refinement_study import run_samples, scaled_states
from plumbline.model.datatypes import Array, Float, Integrator, Model, Trajectory
from plumbline.model.invariants import (
    MOTION_UNITS,
    compute_invariants,
    invariant_scales,
    motion_errors,
    motion_samples,
    motion_scales,
)
from plumbline.model.kinematics import angular_velocity
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR, RUN_ROUNDING, MotionTruth


class WindowVerdict(NamedTuple):
    """The verdict on a limit in one window of time."""

    verdict: Verdict
    reason: str
    last_sample: int  # index of the window's last sample
    remark: str = ""  # on the time that the window does not cover


class RefinementAnalysis:
    """The runs of a refinement study, coarse to fine, and what follows from all of them together.

    Attributes:
        horizon: up to which positions may be compared [s].
        samples: by the names of `MOTION_UNITS`, per run (T, N, ·); NaN where the run failed.
        true_samples: of the truth, by the same names.
        limit_error: (T,) of the finest run in its unit, by the same names; 0 where it is not itself a limit.
        motion_scales: of rounding in them.
        scaled_states: per run r and ṙ (T, N, 6) over their scales.
        invariant_scales: of the true motion, units as `INVARIANT_UNITS`.
        rounding: (T,) of a run and its steps' solver, grown, for a scale of 1.
        observed_until: end of the window in which the order was observed [s].

    """

    def __init__(
        self, context: RowContext, model: Model, truth: MotionTruth, integrator: Integrator,
        runs: Sequence[RefinementRun], horizon: float,
    ) -> None:  # fmt: skip
        """Measure samples, scales, invariants and the order."""
        self.context, self.model, self.truth, self.integrator = context, model, truth, integrator
        self.runs, self.horizon = runs, horizon
        trajectories = [run.trajectory for run in runs]
        assert trajectories[-1] is not None
        self.finest: Trajectory = trajectories[-1]
        r, p, v, pdot = (run_samples(runs, name) for name in ("r", "p", "v", "pdot"))
        omega = [angular_velocity(*pair) for pair in zip(p, pdot, strict=True)]
        self.samples = dict(zip(MOTION_UNITS, (r, p, v, omega), strict=True))
        self.true_samples = motion_samples(truth.trajectory)
        self.limit_error = motion_errors(self.finest, self.finest.softer or self.finest)
        self.motion_scales = motion_scales(model, truth.trajectory, truth.length)
        self.invariant_scales = invariant_scales(model, truth.trajectory, truth.length)
        # Positions alone may converge faster than the method: symplectic Euler from a state without
        # torque is a leapfrog in r, and shows its order 1 in ṙ only.
        self.scaled_states = scaled_states(r, v, truth.length, self.invariant_scales["gap_rate"])
        self.invariant_drifts = [None if t is None else compute_invariants(model, t) for t in trajectories]
        # The equations of an implicit step are solved to a tolerance: independent errors of so many steps add
        # up like a random walk.
        solved = self.finest.solver_rtol * np.sqrt(self.finest.steps)
        self.rounding = (RUN_ROUNDING + solved) * truth.growth
        self.observed, self.observed_until = self._observe_order()

    @property
    def times(self) -> Float[Array, "samples"]:
        """(T,) sample times [s]."""
        return self.truth.trajectory.t

    @property
    def has_steps(self) -> bool:
        """Whether the integrator has fixed steps; else a tolerance controls them."""
        return self.integrator.kind == "step"

    @property
    def common_fields(self) -> dict[str, Any]:
        """Fields that all rows of this study share."""
        alias = None if self.model.has_drag else self.integrator.alias_of  # with drag the two methods differ
        return {"alias_of": alias, "cpu_time": sum(run.cpu_time for run in self.runs)}

    @property
    def failures(self) -> str:
        """Words on the runs that failed, of which the limit makes nothing; empty where all went through."""
        failed = [(run.resolution, run.failure.message) for run in self.runs if run.failure]
        if not failed:
            return ""
        at, message = failed[-1]
        return f"; {len(failed)} of {len(self.runs)} runs failed, the finest of these at {at:g}: {message}"

    @property
    def rounding_description(self) -> str:
        """The formula of `rounding`, for derivations."""
        if not self.finest.solver_rtol:
            return "10³ ε G(t)"
        return f"(10³ ε + {self.finest.solver_rtol:g} of the step's solver × √{self.finest.steps}) G(t)"

    def invariant_uncertainty(self, quantity: str) -> float:
        """Return the uncertainty of an invariant of the finest run, in its unit.

        The work of loads is a quadrature over the samples.  The energy of the true motion, with its work over
        the same samples, should not drift: where it does, the quadrature is off by so much at least.
        """
        finest = self.invariant_drifts[-1]
        assert finest is not None
        uncertainty = finest.uncertainty[quantity]
        if quantity != "energy_drift" or not uncertainty:
            return uncertainty
        return max(uncertainty, max_norm(compute_invariants(self.model, self.truth.trajectory).energy_drift))

    def extrapolated_limit(
        self, samples: Sequence[Float[Array, "samples bodies width"]]
    ) -> ExtrapolatedLimit:
        """Return the limit at step zero, or the run with the tightest tolerance.

        Args:
            samples: per run of one quantity.

        Raises:
            ValueError: fewer than two runs are finite.

        """
        if self.has_steps:
            return romberg(samples, self.integrator.error_exponents)
        return tightest_tolerance_limit(samples)

    def window_lengths(self, until: float) -> list[int]:
        """Return the windows of time to try, longest first.

        Args:
            until: end of the longest window [s].

        Returns:
            Numbers of samples up to ``until``, and to a half, a quarter and an eighth of it.

        """
        end = min(until, float(self.times[-1]))
        ends = [end / 2**k * (1 + 1e-12) for k in range(4)]
        numbers = [int(np.searchsorted(self.times, e, side="right")) for e in ends]
        return [number for number in dict.fromkeys(numbers) if number >= 3] or [min(3, len(self.times))]

    def decide(
        self,
        judge: Callable[[int], tuple[Verdict, str]],
        errors: Sequence[Float[Array, "samples"]],
        floor: Float[Array, "samples"],
        until: float,
        wanted: float,
    ) -> WindowVerdict:
        """Return the verdict in the longest window that decides; where none does, in the longest one.

        Args:
            judge: from the index of a window's last sample to verdict and reason.
            errors: of each run.  Where they do not fall from run to run in a window, no shorter one decides:
                what happens later is then no matter of the step.
            floor: what rounding explains of them.
            until: end of the longest window [s].
            wanted: how much of the scenario can be compared at best [s]; a decision needs half of it.

        """

        def windows() -> Iterator[WindowVerdict]:
            for number in self.window_lengths(until):
                yield WindowVerdict(*judge(number - 1), number - 1)
                largest = [float(np.max(error[:number])) for error in errors]
                if not falls_with_resolution(largest, float(np.max(floor[:number]))):
                    return

        verdict, reason, at, _ = first_decided(windows())
        if verdict != Verdict.UNRESOLVED and self.is_too_short(at, wanted):
            verdict, reason = Verdict.UNRESOLVED, f"too short a time to decide: {reason}"
        remark, duration = "", self.times[-1] * (1 - 1e-12)
        if self.times[at] < duration:
            remark = f"; covers {self.times[at]:g} s of the scenario's {self.times[-1]:g} s"
            remark += f", which can be predicted for {wanted:g} s" if wanted < duration else ""
        return WindowVerdict(verdict, reason + remark, at, remark)

    def is_too_short(self, at: int, wanted: float) -> bool:
        """Whether a comparison up to a sample covers less than half of the wanted time.

        Args:
            at: index of the last sample that was compared.
            wanted: how much can be compared at best [s].

        Returns:
            Whether the next sample, too, is before half of ``wanted``: windows end at whole samples.

        """
        following = self.times[min(at + 1, len(self.times) - 1)]
        return bool(following <= wanted / 2 * (1 + 1e-12) and self.times[at] < wanted / 2 * (1 - 1e-12))

    def _observe_order(self) -> tuple[ObservedOrder, float]:
        """The order in the longest window that shows one, and that window's end [s].

        An order above the declared one counts only where no shorter window shows the declared one: late in a
        sensitive motion the next power of the step may outgrow the leading one down to the finest step.
        """
        tried = []
        for number in self.window_lengths(self.horizon):
            floor = float(self.rounding[number - 1] / 8)  # trials found 115 ε G at most, an eighth of it
            order = observed_order([y[:number] for y in self.scaled_states], floor, self.integrator.order)
            if ROUNDING_FLOOR_FACTOR * floor > DETECTABLE_PARAMETER_ERROR:  # it hides mistakes too
                order = replace(order, is_at_rounding_floor=False)
            tried.append((order, float(self.times[number - 1])))
            is_high = order.value is not None and order.value > self.integrator.order + ORDER_MARGIN
            if order.is_at_rounding_floor or (order.is_asymptotic and not is_high):
                return tried[-1]
        return next((found for found in tried if found[0].is_asymptotic), tried[0])
