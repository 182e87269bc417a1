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

from plumbline.engines.calls import Climb, Rung
from plumbline.judging.convergence import (
    DRIFTS,
    ORDER_MARGIN,
    Limit,
    Order,
    observed_order,
    romberg,
    tightest,
)
from plumbline.judging.rows import Columns, Findings, Subject
from plumbline.model.datatypes import Array, Integrator, Model, Row, Trajectory, Verdict
from plumbline.model.invariants import UNITS, Invariants, attitude_error, invariants, position_error, scales
from plumbline.truth.ground_truth import PART, ROUNDING, MotionTruth

EPS = 2.0**-52
PER_STEP = 8 * EPS  # rounding of an invariant in one step, of its scale: a handful of operations


@dataclass(frozen=True)
class Comparison:
    """What a limit says in one window of time."""

    verdict: Verdict
    reason: str
    at: int  # index of the window's last sample


def judge_motion(
    who: Subject, model: Model, truth: MotionTruth, integrator: Integrator, climb: Climb, horizon: float
) -> Findings:
    """Verdicts on order, limits and invariants of one integrator's ladder, up to the horizon."""
    found = Findings()
    if climb.unsupported is not None:
        found.rows.append(who.row("trajectory", integrator.name, "all", "unsupported", climb.unsupported))
        return found
    finest = climb.rungs[-1]
    if finest.trajectory is None:
        reason = f"at the finest resolution {finest.resolution:g}: {finest.failure}"
        found.rows.append(who.row("trajectory", integrator.name, "all", "failed", reason))
        return found
    ladder = Ladder(who, model, truth, integrator, climb.rungs, horizon)
    found.rows += [*ladder.motion(), *ladder.drifts()]
    names: Columns = {"scenario": who.scenario, "engine": who.engine, "integrator": integrator.name}
    found.tables.append(("convergence", names | ladder.convergence()))
    names["resolution"] = finest.resolution
    found.tables.append(("curves", names | ladder.curves()))
    found.tables.append(("trajectories", names | poses(finest.trajectory)))
    return found


@dataclass
class Ladder:
    """One integrator's runs on one scenario, coarse to fine, and what they say together."""

    who: Subject
    model: Model
    truth: MotionTruth
    integrator: Integrator
    rungs: Sequence[Rung]
    horizon: float  # s, up to which positions may be compared
    finest: Trajectory = field(init=False)
    positions: list[Array] = field(init=False)  # per rung (T, N, 3)
    attitudes: list[Array] = field(init=False)  # per rung (T, N, 4)
    phases: list[Array] = field(init=False)  # per rung (T, N, 6): r and ṙ over their scales
    drift: list[Invariants | None] = field(init=False)
    rounding: Array = field(init=False)  # (T,) of a whole run and of its solver, grown, for a scale of 1

    def __post_init__(self) -> None:
        last = self.rungs[-1].trajectory
        assert last is not None
        self.finest = last
        self.positions = [self.samples(rung, "r") for rung in self.rungs]
        self.attitudes = [self.samples(rung, "p") for rung in self.rungs]
        # Positions alone may converge faster than the method: symplectic Euler from a state without
        # torque is a leapfrog in r, and shows its order 1 in ṙ only.
        sizes = self.truth.length, self.scales()["gap_rate"]
        self.phases = [
            np.concatenate([y / sizes[0], self.samples(rung, "v") / sizes[1]], axis=-1)
            for y, rung in zip(self.positions, self.rungs, strict=True)
        ]
        runs = [rung.trajectory for rung in self.rungs]
        self.drift = [None if run is None else invariants(self.model, run) for run in runs]
        # An implicit step is solved to a tolerance: so many independent mistakes add up like a random walk.
        solved = self.integrator.solver * np.sqrt(self.finest.steps)
        self.rounding = (ROUNDING + solved) * self.truth.growth
        self.shown, self.shown_until = self.seen_order()

    @property
    def times(self) -> Array:
        """(T,) s."""
        return self.truth.trajectory.t

    @property
    def common(self) -> dict[str, Any]:
        """What every row of this ladder says besides its quantity."""
        alias = None if self.model.has_drag else self.integrator.alias_of  # drag is where they part
        return {"alias_of": alias, "wall_time": sum(rung.cost for rung in self.rungs)}

    def samples(self, rung: Rung, name: str) -> Array:
        """(T, N, width), NaN where the rung did not stay finite; quaternions signed like the finest run's."""
        fine: Array = getattr(self.finest, name)
        if rung.trajectory is None:
            return np.full_like(fine, np.nan)
        y: Array = getattr(rung.trajectory, name)
        if name == "p":
            y = y * np.where(np.sum(y * fine, axis=-1, keepdims=True) < 0, -1.0, 1.0)
        return y

    def words(self) -> str:
        """What `rounding` is made of."""
        if not self.integrator.solver:
            return "10³ ε G(t)"
        return f"(10³ ε + {self.integrator.solver:g} of the step's solver × √{self.finest.steps}) G(t)"

    def limit(self, ys: Sequence[Array]) -> Limit:
        """The motion at step zero (or at the tightest tolerance), with its uncertainty."""
        if self.integrator.kind == "tolerance":
            return tightest(ys)
        return romberg(ys, self.integrator.powers)

    def windows(self, until: float) -> list[int]:
        """Numbers of samples to compare: up to ``until``, then a half, a quarter, an eighth of it."""
        end = min(until, float(self.times[-1]))
        ends = [end / 2**k * (1 + 1e-12) for k in range(4)]
        numbers = [int(np.searchsorted(self.times, e, side="right")) for e in ends]
        return [number for number in dict.fromkeys(numbers) if number >= 3] or [min(3, len(self.times))]

    # order

    def seen_order(self) -> tuple[Order, float]:
        """The order of the longest window that shows one, and that window's end in s."""
        tried = []
        for number in self.windows(self.horizon):
            floor = float(self.rounding[number - 1] / 8)  # trials saw 115 ε G at most, an eighth of it
            order = observed_order([y[:number] for y in self.phases], floor, self.integrator.order)
            tried.append((order, float(self.times[number - 1])))
            if order.asymptotic or order.at_floor:
                return tried[-1]
        return tried[0]

    def order_row(self) -> Row:
        """Does the integrator show the order of its name?"""
        order, declared = self.shown, self.integrator.order
        coarse, fine = self.rungs[0].resolution, self.rungs[-1].resolution
        steps = f"steps {coarse:g} … {fine:g} s, t ≤ {self.shown_until:g} s"
        listed = ", ".join(f"{o:.2f}" for o in order.orders)
        off = None if order.value is None else abs(order.value - declared)
        verdict: Verdict = "agrees"
        if order.at_floor:
            off, reason = None, f"order not observable: differences are rounding at every step ({steps})"
        elif not order.asymptotic or off is None:
            verdict, reason = "unresolved", f"not in the asymptotic range: orders {listed} over {steps}"
        else:
            verdict = "agrees" if off <= ORDER_MARGIN else "disagrees"
            reason = f"shows order {order.value:.2f}, declared {declared} ({steps})"
        return self.who.row(
            "trajectory",
            self.integrator.name,
            "order",
            verdict,
            reason,
            value=off,
            tolerance=ORDER_MARGIN,
            order=order.value,
            declared_order=declared,
            horizon=self.shown_until,
            derivation=f"log2 of ratios of consecutive differences of (r, ṙ) over {steps}: {listed}; "
            f"two consecutive ones within {ORDER_MARGIN} of {declared} show it"
            f", three that stay away from it by {DRIFTS:g} times their changes another",
            **self.common,
        )

    # positions and attitudes

    def motion(self) -> list[Row]:
        """Order, and positions and attitudes against the truth."""
        truth = self.truth
        true = truth.trajectory
        rows = [self.order_row()] if self.integrator.kind == "step" else []
        rows += self.against_truth(
            "position", "m", self.positions, true.r, position_error,
            truth.position_uncertainty, truth.visible_position, truth.length, 1.0,
        )  # fmt: skip
        # |δp| of a unit quaternion is half the rotation angle
        rows += self.against_truth(
            "attitude", "rad", self.attitudes, true.p, attitude_error,
            truth.attitude_uncertainty, truth.visible_attitude, 2.0, 2.0,
        )  # fmt: skip
        return rows

    def against_truth(
        self,
        name: str,
        unit: str,
        ys: Sequence[Array],
        true: Array,
        distance: Callable[[Array, Array], Array],
        uncertain: Array,
        visible: Array,
        scale: float,
        factor: float,
    ) -> list[Row]:
        """Two rows: the limit against the truth; the finest run, within the ladder's own estimate of it."""
        who, method = self.who, self.integrator.name
        try:
            limit = self.limit(ys)
        except ValueError as error:
            return [who.row("trajectory", method, f"{name}_limit", "unresolved", str(error), unit)]
        off = np.maximum.accumulate(distance(limit.y, true))
        ladder, rounding = factor * limit.uncertainty, scale * self.rounding
        tolerance = ladder + uncertain + rounding
        found = self.compare(name, unit, off, tolerance, visible)
        at, end = found.at, float(self.times[found.at])
        how = (
            f"{limit.column} powers of h from {self.integrator.powers} eliminated over {len(ys)} steps"
            if self.integrator.kind == "step"
            else f"tightest of {len(ys)} tolerances"
        )
        common = {**self.common, "uncertainty": float(ladder[at] + uncertain[at]), "horizon": end}
        own = np.maximum.accumulate(distance(ys[-1], true))[at]
        estimate = float(np.max(distance(ys[-1], limit.y)[: at + 1]) + tolerance[at])
        ratio = float(off[at] / tolerance[at])  # what the verdict hangs on, in both rows
        step = self.rungs[-1].resolution
        what = "step" if self.integrator.kind == "step" else "tolerance"
        return [
            who.row(
                "trajectory",
                method,
                f"{name}_limit",
                found.verdict,
                found.reason,
                unit,
                value=float(off[at]),
                tolerance=float(tolerance[at]),
                derivation=f"up to t = {end:g} s: limit ({how}) ± {ladder[at]:.2g}, "
                f"truth ({self.truth.method}) ± {uncertain[at]:.2g}, "
                f"rounding {self.words()} × {scale:.3g} {unit} = {rounding[at]:.2g}; "
                f"a mistake of {PART:g} in a parameter makes {visible[at]:.2g}",
                extra={
                    "ratio": ratio,
                    "visible": float(min(visible[at], 1e308)),
                    "growth": float(self.truth.growth[at]),
                },
                **common,
            ),
            who.row(
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
                extra={"ratio": ratio, "resolution": step},
                **common,
            ),
        ]

    def compare(self, name: str, unit: str, off: Array, tolerance: Array, visible: Array) -> Comparison:
        """The longest window that can tell; where none can, the longest one and why."""
        show = self.shown
        trusted = self.integrator.kind == "tolerance" or show.asymptotic or show.at_floor
        unresolved: Comparison | None = None
        for number in self.windows(self.horizon):
            at = number - 1
            until = f"up to t = {self.times[at]:g} s"
            if off[at] <= tolerance[at] <= visible[at]:
                return Comparison(
                    "agrees", f"{name} limit within {off[at]:.2g} {unit} of the truth {until}", at
                )
            if off[at] > tolerance[at] and trusted:
                reason = (
                    f"the {name} at step zero is {off[at]:.3g} {unit} from the truth {until}, "
                    f"{off[at] / tolerance[at]:.3g} times the uncertainties"
                )
                return Comparison("disagrees", reason, at)
            if off[at] > tolerance[at]:
                reason = f"{name} limit {off[at]:.2g} {unit} off {until}, but the ladder shows no order"
            else:
                reason = (
                    f"uncertainty {tolerance[at]:.2g} {unit} {until} is above the {visible[at]:.2g} {unit} "
                    f"that a mistake of {PART:g} would make"
                )
            unresolved = unresolved or Comparison("unresolved", reason, at)
        assert unresolved is not None
        return unresolved

    # invariants

    def drifts(self) -> list[Row]:
        """Every invariant that is conserved here: its drift in the finest run, and at step zero."""
        rows = []
        for quantity, unit in UNITS.items():
            series = [None if d is None else getattr(d, quantity) for d in self.drift]
            if series[-1] is not None:
                ys = [np.full_like(series[-1], np.nan) if s is None else s for s in series]
                rows.append(self.drift_row(quantity, unit, ys))
        return rows

    def drift_row(self, quantity: str, unit: str, ys: Sequence[Array]) -> Row:
        """The limit of a drift is zero, within its uncertainty and the rounding of so many steps."""
        name, scale, last = quantity.replace("_", " "), self.scales()[quantity], self.drift[-1]
        assert last is not None
        each = PER_STEP
        if self.integrator.kind == "tolerance":
            each += self.rungs[-1].resolution  # what the step control lets pass in every step
        floor = each * max(self.finest.steps, 64) * scale
        by_quadrature = last.work_uncertainty if quantity == "energy_drift" else 0.0
        drift = np.maximum.accumulate(np.max(np.linalg.norm(ys[-1], axis=-1), axis=1))
        base = f"{self.finest.steps} steps, {each:.1g} × {scale:.3g} {unit} each: {floor:.2g}"

        def row(verdict: Verdict, reason: str, at: int, tolerance: float, why: str, **extra: float) -> Row:
            return self.who.row(
                "invariants",
                self.integrator.name,
                quantity,
                verdict,
                reason,
                unit,
                value=float(drift[at]),
                tolerance=tolerance,
                derivation=why,
                horizon=float(self.times[at]),
                extra={"scale": scale, "whole": float(drift[-1]), **extra},
                **self.common,
            )

        end = len(self.times) - 1
        if drift[end] <= floor:
            reason = f"{name} {drift[end]:.2g} {unit}: rounding"
            return row("agrees", reason, end, floor, base, ratio=float(drift[end] / floor))
        try:
            limit = self.limit(ys)
        except ValueError as error:
            return row("unresolved", str(error), end, floor, base)
        left = np.maximum.accumulate(np.max(np.linalg.norm(limit.y, axis=-1), axis=1))
        tolerance = limit.uncertainty + floor + by_quadrature
        trusted = (
            self.integrator.kind == "tolerance" or observed_order(ys, floor, self.integrator.order).asymptotic
        )
        unresolved: Row | None = None
        for number in self.windows(float(self.times[-1])):
            at = number - 1
            own = float(np.max(np.linalg.norm((ys[-1] - limit.y)[:number], axis=-1)))
            allowed = own + float(tolerance[at])
            zero = f"{left[at]:.2g} ± {tolerance[at]:.2g} {unit} at step zero, t ≤ {self.times[at]:g} s"
            about = {"limit": float(left[at]), "ratio": float(left[at] / tolerance[at])}
            why = (
                f"{own:.2g} from the finest step to step zero, itself ± {limit.uncertainty[at]:.2g}; "
                f"{base}; the work by quadrature ± {by_quadrature:.2g}"
            )
            if left[at] <= tolerance[at] <= PART * scale:
                reason = f"{name} {drift[at]:.2g} {unit} at the finest step, {zero}"
                return row("agrees", reason, at, allowed, why, **about)
            if left[at] > tolerance[at] and trusted:
                reason = f"{name} does not vanish with the step: {zero}"
                return row("disagrees", reason, at, float(tolerance[at]), why, **about)
            reason = f"{name} {drift[at]:.2g} {unit}: {zero} cannot tell"
            unresolved = unresolved or row("unresolved", reason, at, allowed, why, **about)
        assert unresolved is not None
        return unresolved

    def scales(self) -> dict[str, float]:
        """Sizes of what the invariants of the true motion are made of."""
        return scales(self.model, self.truth.trajectory, self.truth.length)

    # tables

    def convergence(self) -> Columns:
        """Error against the truth up to the horizon, cost and order at every resolution."""
        end = self.windows(self.horizon)[0]
        true = self.truth.trajectory
        orders = [np.nan] * 2 + list(self.shown.orders)
        records = []
        for i, rung in enumerate(self.rungs):
            steps = rung.trajectory.steps if rung.trajectory else 0
            for name, error in (
                ("position", position_error(self.positions[i][:end], true.r[:end])),
                ("attitude", attitude_error(self.attitudes[i][:end], true.p[:end])),
            ):
                records.append((rung.resolution, name, np.max(error), rung.cost, steps, orders[i]))
        names = ("resolution", "quantity", "error", "cost", "steps", "order")
        return dict(zip(names, map(list, zip(*records, strict=True)), strict=True))

    def curves(self) -> Columns:
        """Series of the finest run: errors and drifts over time, with the tolerance on positions."""
        last, true = self.drift[-1], self.truth.trajectory
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
            limit = self.limit(self.positions)
        except ValueError:
            pass
        else:
            columns["limit_error"] = position_error(limit.y, true.r)
            rounding = self.truth.length * self.rounding
            columns["tolerance"] = limit.uncertainty + self.truth.position_uncertainty + rounding
        for name in UNITS:
            series = getattr(last, name)
            columns[name] = nothing if series is None else np.max(np.linalg.norm(series, axis=-1), axis=1)
        return columns


def poses(run: Trajectory) -> Columns:
    """Sampled poses, one record per time and body."""
    samples, bodies = run.r.shape[:2]
    values = np.concatenate([run.r, run.p], axis=-1).reshape(-1, 7).T
    return {
        "t": np.repeat(run.t, bodies),
        "body": np.tile(np.arange(bodies), samples),
        **dict(zip(("rx", "ry", "rz", "p0", "p1", "p2", "p3"), values, strict=True)),
    }
