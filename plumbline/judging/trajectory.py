"""Trajectories and invariants: what one integrator's ladder of steps says, against the truth.

The limit of the ladder (step zero) is compared with the truth within the uncertainties of both and
the growth of rounding; the order that the ladder shows with the declared one; and every invariant's
drift must vanish with the step.  Where a window of time cannot tell, its half is tried, down to an
eighth; a disagreement in a longer window is never overruled by a shorter one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plumbline.engines.calls import RefinementRun, RefinementStudy
from plumbline.judging.convergence import (
    ORDER_CHANGE_FACTOR,
    ORDER_MARGIN,
    ExtrapolatedLimit,
    ObservedOrder,
    observed_order,
    romberg,
    tightest_tolerance_limit,
)
from plumbline.judging.rows import Columns, JudgingResult, Row, RowContext, Verdict
from plumbline.model.datatypes import Array, Integrator, Model, Trajectory
from plumbline.model.invariants import (
    INVARIANT_UNITS,
    Invariants,
    attitude_error,
    compute_invariants,
    invariant_scales,
    position_error,
)
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR, RUN_ROUNDING, MotionTruth

EPS = 2.0**-52
ROUNDING_PER_STEP = 8 * EPS  # rounding of an invariant in one step, of its scale: a handful of operations


@dataclass(frozen=True)
class WindowVerdict:
    """What a limit says in one window of time."""

    verdict: Verdict
    reason: str
    last_sample: int  # index of the window's last sample


def judge_trajectory(
    who: RowContext,
    model: Model,
    truth: MotionTruth,
    integrator: Integrator,
    study: RefinementStudy,
) -> JudgingResult:
    """Verdicts on order, limits and invariants of one integrator's ladder, up to the horizon."""
    found = JudgingResult()
    if study.unsupported is not None:
        found.rows.append(
            who.make_row("trajectory", integrator.name, "all", Verdict.UNSUPPORTED, study.unsupported)
        )
        return found
    finest = study.runs[-1]
    if finest.trajectory is None:
        reason = f"at the finest resolution {finest.resolution:g}: {finest.failure}"
        found.rows.append(who.make_row("trajectory", integrator.name, "all", Verdict.FAILED, reason))
        return found
    ladder = RefinementAnalysis(who, model, truth, integrator, study.runs, truth.horizon)
    found.rows += [*ladder.trajectory_rows(), *ladder.invariant_rows()]
    names: Columns = {"scenario": who.scenario, "engine": who.engine, "integrator": integrator.name}
    found.tables.append(("convergence", names | ladder.convergence_columns()))
    names["resolution"] = finest.resolution
    found.tables.append(("curves", names | ladder.time_series_columns()))
    found.tables.append(("trajectories", names | pose_columns(finest.trajectory)))
    return found


@dataclass
class RefinementAnalysis:
    """One integrator's runs on one scenario, coarse to fine, and what they say together."""

    context: RowContext
    model: Model
    truth: MotionTruth
    integrator: Integrator
    runs: Sequence[RefinementRun]
    horizon: float  # s, up to which positions may be compared
    finest: Trajectory = field(init=False)
    positions: list[Array] = field(init=False)  # per rung (T, N, 3)
    attitudes: list[Array] = field(init=False)  # per rung (T, N, 4)
    scaled_states: list[Array] = field(init=False)  # per rung (T, N, 6): r and ṙ over their scales
    invariant_drifts: list[Invariants | None] = field(init=False)
    rounding: Array = field(init=False)  # (T,) of a whole run and of its solver, grown, for a scale of 1

    def __post_init__(self) -> None:
        last = self.runs[-1].trajectory
        assert last is not None
        self.finest = last
        self.positions = [self.samples(rung, "r") for rung in self.runs]
        self.attitudes = [self.samples(rung, "p") for rung in self.runs]
        # Positions alone may converge faster than the method: symplectic Euler from a state without
        # torque is a leapfrog in r, and shows its order 1 in ṙ only.
        sizes = self.truth.length, self.invariant_scales()["gap_rate"]
        self.scaled_states = [
            np.concatenate([y / sizes[0], self.samples(rung, "v") / sizes[1]], axis=-1)
            for y, rung in zip(self.positions, self.runs, strict=True)
        ]
        runs = [rung.trajectory for rung in self.runs]
        self.invariant_drifts = [None if run is None else compute_invariants(self.model, run) for run in runs]
        # An implicit step is solved to a tolerance: so many independent mistakes add up like a random walk.
        solved = self.integrator.solver_rtol * np.sqrt(self.finest.steps)
        self.rounding = (RUN_ROUNDING + solved) * self.truth.growth
        self.observed, self.observed_until = self.find_observed_order()

    @property
    def times(self) -> Array:
        """(T,) s."""
        return self.truth.trajectory.t

    @property
    def common_fields(self) -> dict[str, Any]:
        """What every row of this ladder says besides its quantity."""
        alias = None if self.model.has_drag else self.integrator.alias_of  # drag is where they part
        return {"alias_of": alias, "cpu_time": sum(rung.cpu_time for rung in self.runs)}

    def samples(self, run: RefinementRun, name: str) -> Array:
        """(T, N, width), NaN where the rung did not stay finite; quaternions signed like the finest run's."""
        fine: Array = getattr(self.finest, name)
        if run.trajectory is None:
            return np.full_like(fine, np.nan)
        y: Array = getattr(run.trajectory, name)
        if name == "p":
            y = y * np.where(np.sum(y * fine, axis=-1, keepdims=True) < 0, -1.0, 1.0)
        return y

    def rounding_description(self) -> str:
        """What `rounding` is made of."""
        if not self.integrator.solver_rtol:
            return "10³ ε G(t)"
        return f"(10³ ε + {self.integrator.solver_rtol:g} of the step's solver × √{self.finest.steps}) G(t)"

    def extrapolated_limit(self, samples: Sequence[Array]) -> ExtrapolatedLimit:
        """The motion at step zero (or at the tightest tolerance), with its uncertainty."""
        if self.integrator.kind == "tolerance":
            return tightest_tolerance_limit(samples)
        return romberg(samples, self.integrator.error_exponents)

    def window_lengths(self, until: float) -> list[int]:
        """Numbers of samples to compare: up to ``until``, then a half, a quarter, an eighth of it."""
        end = min(until, float(self.times[-1]))
        ends = [end / 2**k * (1 + 1e-12) for k in range(4)]
        numbers = [int(np.searchsorted(self.times, e, side="right")) for e in ends]
        return [number for number in dict.fromkeys(numbers) if number >= 3] or [min(3, len(self.times))]

    # order

    def find_observed_order(self) -> tuple[ObservedOrder, float]:
        """The order of the longest window that shows one, and that window's end in s."""
        tried = []
        for number in self.window_lengths(self.horizon):
            floor = float(self.rounding[number - 1] / 8)  # trials saw 115 ε G at most, an eighth of it
            order = observed_order([y[:number] for y in self.scaled_states], floor, self.integrator.order)
            tried.append((order, float(self.times[number - 1])))
            if order.is_asymptotic or order.is_at_rounding_floor:
                return tried[-1]
        return tried[0]

    def order_row(self) -> Row:
        """Does the integrator show the order of its name?"""
        order, declared = self.observed, self.integrator.order
        coarse, fine = self.runs[0].resolution, self.runs[-1].resolution
        steps = f"steps {coarse:g} … {fine:g} s, t ≤ {self.observed_until:g} s"
        listed = ", ".join(f"{o:.2f}" for o in order.orders)
        off = None if order.value is None else abs(order.value - declared)
        verdict: Verdict = Verdict.AGREES
        if order.is_at_rounding_floor:
            off, reason = None, f"order not observable: differences are rounding at every step ({steps})"
        elif not order.is_asymptotic or off is None:
            verdict, reason = Verdict.UNRESOLVED, f"not in the asymptotic range: orders {listed} over {steps}"
        else:
            verdict = Verdict.AGREES if off <= ORDER_MARGIN else Verdict.DISAGREES
            reason = f"shows order {order.value:.2f}, declared {declared} ({steps})"
        return self.context.make_row(
            "trajectory",
            self.integrator.name,
            "order",
            verdict,
            reason,
            value=off,
            tolerance=ORDER_MARGIN,
            order=order.value,
            declared_order=declared,
            compared_until=self.observed_until,
            derivation=f"log2 of ratios of consecutive differences of (r, ṙ) over {steps}: {listed}; "
            f"two consecutive ones within {ORDER_MARGIN} of {declared} show it"
            f", three that stay away from it by {ORDER_CHANGE_FACTOR:g} times their changes another",
            **self.common_fields,
        )

    # positions and attitudes

    def trajectory_rows(self) -> list[Row]:
        """Order, and positions and attitudes against the truth."""
        truth = self.truth
        true = truth.trajectory
        rows = [self.order_row()] if self.integrator.kind == "step" else []
        rows += self.rows_against_truth(
            "position", "m", self.positions, true.r, position_error,
            truth.position_uncertainty, truth.detectable_position, truth.length, 1.0,
        )  # fmt: skip
        # |δp| of a unit quaternion is half the rotation angle
        rows += self.rows_against_truth(
            "attitude", "rad", self.attitudes, true.p, attitude_error,
            truth.attitude_uncertainty, truth.detectable_attitude, 2.0, 2.0,
        )  # fmt: skip
        return rows

    def rows_against_truth(
        self,
        name: str,
        unit: str,
        samples: Sequence[Array],
        true: Array,
        distance: Callable[[Array, Array], Array],
        truth_uncertainty: Array,
        detectable: Array,
        scale: float,
        uncertainty_factor: float,
    ) -> list[Row]:
        """Two rows: the limit against the truth; the finest run, within the ladder's own estimate of it."""
        who, method = self.context, self.integrator.name
        try:
            limit = self.extrapolated_limit(samples)
        except ValueError as error:
            return [who.make_row("trajectory", method, f"{name}_limit", Verdict.UNRESOLVED, str(error), unit)]
        off = np.maximum.accumulate(distance(limit.y, true))
        ladder, rounding = uncertainty_factor * limit.uncertainty, scale * self.rounding
        tolerance = ladder + truth_uncertainty + rounding
        found = self.judge_windows(name, unit, off, tolerance, detectable)
        at, end = found.last_sample, float(self.times[found.last_sample])
        how = (
            f"{limit.eliminated_powers} powers of h from {self.integrator.error_exponents} eliminated over {len(samples)} steps"
            if self.integrator.kind == "step"
            else f"tightest of {len(samples)} tolerances"
        )
        common = {
            **self.common_fields,
            "uncertainty": float(ladder[at] + truth_uncertainty[at]),
            "compared_until": end,
        }
        own = np.maximum.accumulate(distance(samples[-1], true))[at]
        estimate = float(np.max(distance(samples[-1], limit.y)[: at + 1]) + tolerance[at])
        ratio = float(off[at] / tolerance[at])  # what the verdict hangs on, in both rows
        step = self.runs[-1].resolution
        what = "step" if self.integrator.kind == "step" else "tolerance"
        return [
            who.make_row(
                "trajectory",
                method,
                f"{name}_limit",
                found.verdict,
                found.reason,
                unit,
                value=float(off[at]),
                tolerance=float(tolerance[at]),
                derivation=f"up to t = {end:g} s: limit ({how}) ± {ladder[at]:.2g}, "
                f"truth ({self.truth.method}) ± {truth_uncertainty[at]:.2g}, "
                f"rounding {self.rounding_description()} × {scale:.3g} {unit} = {rounding[at]:.2g}; "
                f"a mistake of {DETECTABLE_PARAMETER_ERROR:g} in a parameter makes {detectable[at]:.2g}",
                ratio=ratio,
                extra={
                    "visible": float(min(detectable[at], 1e308)),
                    "growth": float(self.truth.growth[at]),
                },
                **common,
            ),
            who.make_row(
                "trajectory",
                method,
                name,
                found.verdict,  # own ≤ estimate where the limit agrees: the triangle inequality
                f"{name} at {what} {step:g} is {own:.2g} {unit} from the truth, "
                f"the ladder says {estimate:.2g}",
                unit,
                value=float(own),
                tolerance=estimate,
                derivation=f"from the finest run to the limit, plus the limit's tolerance, t ≤ {end:g} s",
                ratio=ratio,
                extra={"resolution": step},
                **common,
            ),
        ]

    def judge_windows(
        self, name: str, unit: str, deviation: Array, tolerance: Array, detectable: Array
    ) -> WindowVerdict:
        """The longest window that can tell; where none can, the longest one and why."""
        show = self.observed
        trusted = self.integrator.kind == "tolerance" or show.is_asymptotic or show.is_at_rounding_floor
        unresolved: WindowVerdict | None = None
        for number in self.window_lengths(self.horizon):
            at = number - 1
            until = f"up to t = {self.times[at]:g} s"
            if deviation[at] <= tolerance[at] <= detectable[at]:
                return WindowVerdict(
                    Verdict.AGREES, f"{name} limit within {deviation[at]:.2g} {unit} of the truth {until}", at
                )
            if deviation[at] > tolerance[at] and trusted:
                reason = (
                    f"the {name} at step zero is {deviation[at]:.3g} {unit} from the truth {until}, "
                    f"{deviation[at] / tolerance[at]:.3g} times the uncertainties"
                )
                return WindowVerdict(Verdict.DISAGREES, reason, at)
            if deviation[at] > tolerance[at]:
                reason = f"{name} limit {deviation[at]:.2g} {unit} off {until}, but the ladder shows no order"
            else:
                reason = (
                    f"uncertainty {tolerance[at]:.2g} {unit} {until} is above the {detectable[at]:.2g} {unit} "
                    f"that a mistake of {DETECTABLE_PARAMETER_ERROR:g} would make"
                )
            unresolved = unresolved or WindowVerdict(Verdict.UNRESOLVED, reason, at)
        assert unresolved is not None
        return unresolved

    # invariants

    def invariant_rows(self) -> list[Row]:
        """Every invariant that is conserved here: its drift in the finest run, and at step zero."""
        rows = []
        for quantity, unit in INVARIANT_UNITS.items():
            series = [None if d is None else getattr(d, quantity) for d in self.invariant_drifts]
            if series[-1] is not None:
                ys = [np.full_like(series[-1], np.nan) if s is None else s for s in series]
                rows.append(self.invariant_row(quantity, unit, ys))
        return rows

    def invariant_row(self, quantity: str, unit: str, samples: Sequence[Array]) -> Row:
        """The limit of a drift is zero, within its uncertainty and the rounding of so many steps."""
        name, scale, last = (
            quantity.replace("_", " "),
            self.invariant_scales()[quantity],
            self.invariant_drifts[-1],
        )
        assert last is not None
        each = ROUNDING_PER_STEP
        if self.integrator.kind == "tolerance":
            each += self.runs[-1].resolution  # what the step control lets pass in every step
        floor = each * max(self.finest.steps, 64) * scale
        by_quadrature = last.work_uncertainty if quantity == "energy_drift" else 0.0
        drift = np.maximum.accumulate(np.max(np.linalg.norm(samples[-1], axis=-1), axis=1))
        base = f"{self.finest.steps} steps, {each:.1g} × {scale:.3g} {unit} each: {floor:.2g}"

        def row(
            verdict: Verdict, reason: str, at: int, tolerance: float, why: str, ratio: float, **extra: float
        ) -> Row:
            return self.context.make_row(
                "invariants",
                self.integrator.name,
                quantity,
                verdict,
                reason,
                unit,
                value=float(drift[at]),
                tolerance=tolerance,
                ratio=ratio,
                derivation=why,
                compared_until=float(self.times[at]),
                extra={"scale": scale, "whole": float(drift[-1]), **extra},
                **self.common_fields,
            )

        end = len(self.times) - 1
        if drift[end] <= floor:
            reason = f"{name} {drift[end]:.2g} {unit}: rounding"
            return row(Verdict.AGREES, reason, end, floor, base, float(drift[end] / floor))
        try:
            limit = self.extrapolated_limit(samples)
        except ValueError as error:
            return row(Verdict.UNRESOLVED, str(error), end, floor, base, float(drift[end] / floor))
        left = np.maximum.accumulate(np.max(np.linalg.norm(limit.y, axis=-1), axis=1))
        tolerance = limit.uncertainty + floor + by_quadrature
        trusted = (
            self.integrator.kind == "tolerance"
            or observed_order(samples, floor, self.integrator.order).is_asymptotic
        )
        unresolved: Row | None = None
        for number in self.window_lengths(float(self.times[-1])):
            at = number - 1
            own = float(np.max(np.linalg.norm((samples[-1] - limit.y)[:number], axis=-1)))
            allowed = own + float(tolerance[at])
            zero = f"{left[at]:.2g} ± {tolerance[at]:.2g} {unit} at step zero, t ≤ {self.times[at]:g} s"
            ratio = float(left[at] / tolerance[at])
            remainder = float(left[at])
            why = (
                f"{own:.2g} from the finest step to step zero, itself ± {limit.uncertainty[at]:.2g}; "
                f"{base}; the work by quadrature ± {by_quadrature:.2g}"
            )
            if left[at] <= tolerance[at] <= DETECTABLE_PARAMETER_ERROR * scale:
                reason = f"{name} {drift[at]:.2g} {unit} at the finest step, {zero}"
                return row(Verdict.AGREES, reason, at, allowed, why, ratio, limit=remainder)
            if left[at] > tolerance[at] and trusted:
                reason = f"{name} does not vanish with the step: {zero}"
                return row(Verdict.DISAGREES, reason, at, float(tolerance[at]), why, ratio, limit=remainder)
            reason = f"{name} {drift[at]:.2g} {unit}: {zero} cannot tell"
            unresolved = unresolved or row(
                Verdict.UNRESOLVED, reason, at, allowed, why, ratio, limit=remainder
            )
        assert unresolved is not None
        return unresolved

    def invariant_scales(self) -> dict[str, float]:
        """Sizes of what the invariants of the true motion are made of."""
        return invariant_scales(self.model, self.truth.trajectory, self.truth.length)

    # tables

    def convergence_columns(self) -> Columns:
        """Error against the truth up to the horizon, cost and order at every resolution."""
        end = self.window_lengths(self.horizon)[0]
        true = self.truth.trajectory
        orders = [np.nan] * 2 + list(self.observed.orders)
        records = []
        for i, rung in enumerate(self.runs):
            steps = rung.trajectory.steps if rung.trajectory else 0
            for name, error in (
                ("position", position_error(self.positions[i][:end], true.r[:end])),
                ("attitude", attitude_error(self.attitudes[i][:end], true.p[:end])),
            ):
                records.append((rung.resolution, name, np.max(error), rung.cpu_time, steps, orders[i]))
        names = ("resolution", "quantity", "error", "cost", "steps", "order")
        return dict(zip(names, map(list, zip(*records, strict=True)), strict=True))

    def time_series_columns(self) -> Columns:
        """Series of the finest run: errors and drifts over time, with the tolerance on positions."""
        last, true = self.invariant_drifts[-1], self.truth.trajectory
        assert last is not None
        nothing = np.full(len(self.times), np.nan)
        columns = {
            "t": self.times,
            "position_error": position_error(self.finest.r, true.r),
            "attitude_error": attitude_error(self.finest.p, true.p),
            "limit_error": nothing,
            "tolerance": nothing,
        }
        try:
            limit = self.extrapolated_limit(self.positions)
        except ValueError:
            pass
        else:
            columns["limit_error"] = position_error(limit.y, true.r)
            rounding = self.truth.length * self.rounding
            columns["tolerance"] = limit.uncertainty + self.truth.position_uncertainty + rounding
        for name in INVARIANT_UNITS:
            series = getattr(last, name)
            columns[name] = nothing if series is None else np.max(np.linalg.norm(series, axis=-1), axis=1)
        return columns


def pose_columns(run: Trajectory) -> Columns:
    """Sampled poses, one record per time and body."""
    samples, bodies = run.r.shape[:2]
    values = np.concatenate([run.r, run.p], axis=-1).reshape(-1, 7).T
    return {
        "t": np.repeat(run.t, bodies),
        "body": np.tile(np.arange(bodies), samples),
        **dict(zip(("rx", "ry", "rz", "p0", "p1", "p2", "p3"), values, strict=True)),
    }
