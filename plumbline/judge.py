"""From raw answers to verdicts: every tolerance used here is derived, and says how.

State level: each engine's answer against the truth, per body, within the first-order rounding
bound (`plumbline.bound`).  Trajectories and invariants: the limit of a ladder of steps against the
truth, within the uncertainties of both and the growth of rounding; the order the ladder shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plumbline.bound import BLUNT, EPS
from plumbline.converge import ORDER_MARGIN, Limit, Order, observed_order, romberg, tightest
from plumbline.kinematics import angular_velocity
from plumbline.measures import (
    UNITS,
    Invariants,
    attitude_error,
    invariants,
    kinetic_energy,
    position_error,
    potential_energy,
)
from plumbline.records import Array, Integrator, Level, Model, Row, Trajectory, Verdict
from plumbline.work import Climb, Evaluation, Rung
from plumbline.yardstick import PART, MotionTruth, StateTruth

STATE_UNITS = {
    "acceleration": "m/s²",
    "angular_acceleration": "rad/s²",
    "joint_reaction": "N",
    "kinetic_energy": "J",
    "potential_energy": "J",
    "angular_momentum": "kg m²/s",
    "mass_matrix": "kg m²",
}
ROUNDING = (
    1e3 * EPS * 2
)  # of a whole run, before growth: the worst seen in trials was 115 ε G (verification.md)
PER_STEP = 16 * EPS  # rounding of an invariant in one step, of its scale: a handful of operations


@dataclass(frozen=True)
class Subject:
    """Who is judged, on what."""

    scenario: str
    family: str
    engine: str
    title: str
    version: str

    def row(
        self,
        level: Level,
        integrator: str,
        quantity: str,
        verdict: Verdict,
        reason: str,
        unit: str = "1",
        **more: Any,
    ) -> Row:
        """A row about this subject."""
        more = {"value": None, "tolerance": None} | more
        return Row(
            self.scenario, self.family, self.engine, self.version, level, integrator, quantity, unit,
            verdict=verdict, reason=reason, **more,
        )  # fmt: skip


@dataclass
class Findings:
    """Rows and the tables behind them, as the store keeps them: column name → value per record."""

    rows: list[Row] = field(default_factory=list)
    states: list[dict[str, Any]] = field(default_factory=list)
    convergence: list[dict[str, Any]] = field(default_factory=list)
    curves: list[dict[str, Any]] = field(default_factory=list)
    trajectories: list[dict[str, Any]] = field(default_factory=list)


# --- state level ------------------------------------------------------------------------------


def judge_states(who: Subject, truth: StateTruth, said: Evaluation) -> Findings:
    """Verdicts on every state quantity, worst over bodies and states."""
    found = Findings()
    if said.unsupported or said.failure:
        verdict: Verdict = "unsupported" if said.unsupported else "failed"
        found.rows.append(who.row("state", "-", "all", verdict, said.unsupported or said.failure or ""))
        return found
    for quantity, unit in STATE_UNITS.items():
        if any(getattr(answer, quantity) is None for answer in said.quantities):
            reason = f"{who.title} offers no {quantity.replace('_', ' ')} of its own"
            found.rows.append(who.row("state", "-", quantity, "unsupported", reason, unit))
            continue
        records = []
        for index, (answer, true, bound) in enumerate(
            zip(said.quantities, truth.quantities, truth.bounds, strict=True)
        ):
            if getattr(true, quantity) is None:
                continue
            error = sizes(quantity, np.asarray(getattr(answer, quantity)) - getattr(true, quantity))
            tolerance = np.broadcast_to(bound.tolerance(quantity), error.shape)
            scale = np.broadcast_to(bound.scale[quantity], error.shape)
            body = int(np.argmax(error / np.maximum(tolerance, np.finfo(float).tiny)))
            records.append(
                {
                    "scenario": who.scenario, "engine": who.engine, "quantity": quantity, "state": index,
                    "body": body, "error": float(error[body]), "bound": float(tolerance[body]),
                    "scale": float(scale[body]),
                }
            )  # fmt: skip
        found.states += records
        found.rows.append(state_row(who, quantity, unit, records, truth, said.cost))
    return found


def sizes(quantity: str, difference: Array) -> Array:
    """Per body Euclidean lengths; one number for scalars, momentum and the mass matrix's worst entry."""
    if quantity == "mass_matrix":
        return np.array([np.max(np.abs(difference))])
    return np.atleast_1d(np.linalg.norm(np.atleast_1d(difference), axis=-1))


def state_row(
    who: Subject, quantity: str, unit: str, records: Sequence[dict[str, Any]], truth: StateTruth, cost: float
) -> Row:
    """The row of one quantity: its worst error over bound decides, blunt bounds decide nothing."""
    worst = max(records, key=lambda rec: rec["error"] / max(rec["bound"], np.finfo(float).tiny))
    ratios = np.array([rec["error"] / max(rec["bound"], np.finfo(float).tiny) for rec in records])
    relative = max(rec["error"] / rec["scale"] for rec in records if rec["scale"] > 0) if records else 0.0
    bluntness = float(
        np.median([rec["bound"] / rec["scale"] for rec in records if rec["scale"] > 0] or [0.0])
    )
    where = f"state {worst['state']}, body {worst['body'] + 1}"
    common = {
        "value": worst["error"],
        "tolerance": worst["bound"],
        "derivation": (
            f"first-order rounding bound 64 ε (tB + tX + tS + tJ + d) per body and state, {worst['bound']:.2g} {unit} "
            f"at {where}, {bluntness:.1g} of the scale in the median of {len(records)} states; truth: {truth.method}"
        ),
        "wall_time": cost,
        "extra": {
            "ratio": float(np.max(ratios)), "relative": float(relative), "states": float(len(records)),
            "bound_relative": bluntness, "state": float(worst["state"]), "body": float(worst["body"] + 1),
        },
    }  # fmt: skip
    name = quantity.replace("_", " ")
    if np.max(ratios) > 1:
        bad = int(np.sum(ratios > 1))
        reason = (
            f"{who.title}'s {name} is off by {worst['error']:.3g} {unit} at {where}, {np.max(ratios):.3g} times the "
            f"rounding bound; {bad} of {len(records)} states disagree"
        )
        return who.row("state", "-", quantity, "disagrees", reason, unit, **common)
    if bluntness > BLUNT:
        reason = f"blunt: the rounding bound is {bluntness:.1g} of the scale, above {BLUNT:g}"
        return who.row("state", "-", quantity, "unresolved", reason, unit, **common)
    reason = f"{name} within {np.max(ratios):.2g} of the rounding bound at {len(records)} states"
    return who.row("state", "-", quantity, "agrees", reason, unit, **common)


# --- along trajectories -----------------------------------------------------------------------


def judge_motion(
    who: Subject, model: Model, truth: MotionTruth, integrator: Integrator, climb: Climb, horizon: float
) -> Findings:
    """Verdicts on order, limits and invariants of one integrator's ladder, up to the horizon."""
    found = Findings()
    if climb.unsupported is not None:
        row = who.row("trajectory", integrator.name, "all", "unsupported", climb.unsupported)
        found.rows.append(row)
        return found
    finest = climb.rungs[-1]
    if finest.trajectory is None:
        reason = f"at the finest resolution {finest.resolution:g}: {finest.failure}"
        found.rows.append(who.row("trajectory", integrator.name, "all", "failed", reason))
        return found
    ladder = Ladder(who, model, truth, integrator, climb.rungs)
    found.rows += ladder.motion(horizon)
    found.rows += ladder.drifts()
    found.convergence += ladder.convergence(horizon)
    found.curves += ladder.curves()
    found.trajectories += poses(who, integrator.name, finest.resolution, finest.trajectory)
    return found


def poses(who: Subject, integrator: str, resolution: float, run: Trajectory) -> list[dict[str, Any]]:
    """Sampled poses as records: one per time and body."""
    names = ("rx", "ry", "rz", "p0", "p1", "p2", "p3")
    return [
        {
            "scenario": who.scenario, "engine": who.engine, "integrator": integrator, "resolution": resolution,
            "t": float(run.t[i]), "body": k,
            **dict(zip(names, map(float, (*run.r[i, k], *run.p[i, k])), strict=True)),
        }
        for i in range(len(run.t))
        for k in range(run.r.shape[1])
    ]  # fmt: skip


class Ladder:
    """One integrator's runs on one scenario, and what they say together."""

    def __init__(
        self, who: Subject, model: Model, truth: MotionTruth, integrator: Integrator, rungs: Sequence[Rung]
    ) -> None:
        self.who, self.model, self.truth, self.integrator = who, model, truth, integrator
        self.rungs = list(rungs)
        finest = rungs[-1].trajectory
        assert finest is not None
        self.finest = finest
        self.times = truth.trajectory.t
        self.cost = sum(rung.cost for rung in rungs)
        self.positions = [self.samples(rung, "r") for rung in rungs]
        self.attitudes = [self.samples(rung, "p") for rung in rungs]
        self.drift: list[Invariants | None] = [
            None if rung.trajectory is None else invariants(model, rung.trajectory) for rung in rungs
        ]
        self.rounding = ROUNDING * truth.growth  # (T,), of a length of 1

    def samples(self, rung: Rung, name: str) -> Array:
        """(T, N, width) samples, NaN where the rung did not stay finite; quaternions with the finest run's signs."""
        fine: Array = getattr(self.finest, name)
        if rung.trajectory is None:
            return np.full_like(fine, np.nan)
        y: Array = getattr(rung.trajectory, name)
        if name == "p":
            y = y * np.where(np.sum(y * fine, axis=-1, keepdims=True) < 0, -1.0, 1.0)
        return y

    def limit(self, ys: Sequence[Array]) -> Limit:
        """The motion at step zero (or at the tightest tolerance), with its uncertainty."""
        if self.integrator.kind == "tolerance":
            return tightest([y for y in ys if np.all(np.isfinite(y))][-2:])
        return romberg(ys, self.integrator.powers)

    # motion

    def motion(self, horizon: float) -> list[Row]:
        """Order, position and attitude against the truth."""
        rows = []
        if self.integrator.kind == "step":
            rows.append(self.order_row(horizon))
        length, truth = self.truth.length, self.truth
        for name, unit, ys, error_of, uncertain, visible, scale in (
            ("position", "m", self.positions, position_error, truth.position_uncertainty, truth.visible_position, length),
            ("attitude", "rad", self.attitudes, attitude_error, truth.attitude_uncertainty, truth.visible_attitude, 2.0),
        ):  # fmt: skip
            true = truth.trajectory.r if name == "position" else truth.trajectory.p
            rows += self.limit_rows(name, unit, ys, true, error_of, uncertain, visible, scale, horizon)
        return rows

    def windows(self, horizon: float) -> list[int]:
        """Numbers of samples to compare: up to the horizon, then a half, a quarter, an eighth of it."""
        end = min(horizon, float(self.times[-1]))
        counts = [int(np.searchsorted(self.times, end / 2**k * (1 + 1e-12), side="right")) for k in range(4)]
        return [count for count in dict.fromkeys(counts) if count >= 3] or [len(self.times)]

    def seen_order(self, horizon: float) -> tuple[Order, float]:
        """The order of the longest window that shows one, and that window's end."""
        first: tuple[Order, float] | None = None
        for count in self.windows(horizon):
            floor = float(self.truth.length * self.rounding[count - 1]) / 10
            order = observed_order([y[:count] for y in self.positions], floor)
            end = float(self.times[count - 1])
            first = first or (order, end)
            if order.asymptotic or order.at_floor:
                return order, end
        assert first is not None
        return first

    def order_row(self, horizon: float) -> Row:
        """Does the integrator show the order of its name?"""
        order, end = self.seen_order(horizon)
        declared = self.integrator.order
        steps = f"steps {self.rungs[0].resolution:g} … {self.rungs[-1].resolution:g} s, t ≤ {end:g} s"
        listed = ", ".join(f"{o:.2f}" for o in order.orders)
        common = {
            "tolerance": ORDER_MARGIN, "order": order.value, "declared_order": declared, "horizon": end,
            "alias_of": self.integrator.alias_of, "wall_time": self.cost,
            "derivation": f"log2 of ratios of consecutive differences of positions over {steps}: {listed}; two "
            f"consecutive ones within {ORDER_MARGIN} show the asymptotic range",
        }  # fmt: skip

        def row(verdict: Verdict, reason: str, value: float | None = None) -> Row:
            return self.who.row(
                "trajectory", self.integrator.name, "order", verdict, reason, value=value, **common
            )

        if order.at_floor:
            return row("agrees", "order not observable: differences are rounding at every step")
        if not order.asymptotic or order.value is None:
            return row("unresolved", f"not in the asymptotic range: orders {listed} over {steps}")
        off = abs(order.value - declared)
        if off > ORDER_MARGIN:
            return row("disagrees", f"shows order {order.value:.2f}, declared {declared} ({steps})", off)
        return row("agrees", f"shows order {order.value:.2f}, declared {declared} ({steps})", off)

    def limit_rows(
        self,
        name: str,
        unit: str,
        ys: Sequence[Array],
        true: Array,
        error_of: Any,
        uncertain: Array,
        visible: Array,
        scale: float,
        horizon: float,
    ) -> list[Row]:
        """Two rows: the limit against the truth; the finest run against it, within the ladder's own estimate."""
        try:
            limit = self.limit(ys)
        except ValueError as error:
            quantity = f"{name}_limit"
            return [
                self.who.row("trajectory", self.integrator.name, quantity, "unresolved", str(error), unit)
            ]
        factor = 2.0 if unit == "rad" else 1.0  # |δp| of a unit quaternion is half the rotation angle
        off = np.maximum.accumulate(error_of(limit.y, true))
        rounding = scale * self.rounding
        tolerance = factor * limit.uncertainty + uncertain + rounding
        show, end = self.seen_order(horizon) if self.integrator.kind == "step" else (None, 0.0)
        trusted = show is None or show.asymptotic or show.at_floor
        verdict: Verdict = "unresolved"
        reason = ""
        at = 0
        for count in self.windows(horizon):
            at = count - 1
            end = float(self.times[at])
            if off[at] <= tolerance[at] <= visible[at]:
                verdict = "agrees"
                reason = f"{name} limit within {off[at]:.2g} {unit} of the truth up to t = {end:g} s"
                break
            if off[at] > tolerance[at] and trusted:
                verdict = "disagrees"
                reason = (
                    f"the {name} at step zero is {off[at]:.3g} {unit} from the truth up to t = {end:g} s, "
                    f"{off[at] / tolerance[at]:.3g} times the uncertainties"
                )
                break
            reason = (
                f"uncertainty {tolerance[at]:.2g} {unit} up to t = {end:g} s is above the {visible[at]:.2g} {unit} that "
                f"a mistake of {PART:g} would make"
                if tolerance[at] > visible[at]
                else f"{name} limit is {off[at]:.2g} {unit} off, but the ladder shows no order: not asymptotic"
            )
        combined = float(factor * limit.uncertainty[at] + uncertain[at])
        common = {
            "uncertainty": combined, "horizon": end, "alias_of": self.integrator.alias_of, "wall_time": self.cost,
        }  # fmt: skip
        how = (
            f"Romberg, {limit.column} powers of {self.integrator.powers} eliminated over {len(ys)} steps"
            if self.integrator.kind == "step"
            else f"tightest of {len(ys)} tolerances"
        )
        rows = [
            self.who.row(
                "trajectory", self.integrator.name, f"{name}_limit", verdict, reason, unit,
                value=float(off[at]), tolerance=float(tolerance[at]),
                derivation=f"limit ({how}) ± {factor * limit.uncertainty[at]:.2g}, truth ({self.truth.method}) ± "
                f"{uncertain[at]:.2g}, rounding 10³ ε G(t) × {scale:.3g} {unit} = {rounding[at]:.2g}, up to t = {end:g} s; "
                f"a mistake of {PART:g} in a parameter makes {visible[at]:.2g}",
                extra={"visible": float(min(visible[at], 1e308)), "growth": float(self.truth.growth[at])},
                **common,
            )
        ]  # fmt: skip
        own = np.maximum.accumulate(error_of(ys[-1], true))[at]
        estimate = np.maximum.accumulate(error_of(ys[-1], limit.y))[at] + tolerance[at]
        step = self.rungs[-1].resolution
        ok = own <= estimate
        kind = "step" if self.integrator.kind == "step" else "tolerance"
        rows.append(
            self.who.row(
                "trajectory", self.integrator.name, name,
                verdict if verdict != "agrees" else ("agrees" if ok else "disagrees"),
                f"{name} at {kind} {step:g} is {own:.2g} {unit} from the truth, the ladder estimates {estimate:.2g}",
                unit, value=float(own), tolerance=float(estimate),
                derivation=f"distance of the finest run to the limit, plus the limit's tolerance, up to t = {end:g} s",
                extra={"resolution": step}, **common,
            )
        )  # fmt: skip
        return rows

    # invariants

    def drifts(self) -> list[Row]:
        """Every invariant: its drift in the finest run, and whether it vanishes with the step."""
        rows = []
        for quantity, unit in UNITS.items():
            series = [None if d is None else getattr(d, quantity) for d in self.drift]
            if series[-1] is None:
                continue  # not conserved in this scenario
            ys = [np.full_like(series[-1], np.nan) if s is None else s for s in series]
            rows.append(self.drift_row(quantity, unit, ys))
        return rows

    def drift_row(self, quantity: str, unit: str, ys: Sequence[Array]) -> Row:
        """The limit of a drift is zero, within its uncertainty and the rounding of so many steps."""
        scale = self.scales()[quantity]
        finest = self.drift[-1]
        assert finest is not None
        floor = PER_STEP * max(self.finest.steps, 64) * scale
        extra_uncertainty = finest.work_uncertainty if quantity == "energy_drift" else 0.0
        value = float(np.max(np.linalg.norm(ys[-1], axis=-1)))
        common = {
            "alias_of": self.integrator.alias_of,
            "horizon": float(self.times[-1]),
            "wall_time": self.cost,
        }
        name = quantity.replace("_", " ")

        def row(verdict: Verdict, reason: str, tolerance: float, why: str, **extra: float) -> Row:
            return self.who.row(
                "invariants", self.integrator.name, quantity, verdict, reason, unit,
                value=value, tolerance=tolerance, derivation=why, extra={"scale": scale, **extra}, **common,
            )  # fmt: skip

        base = (
            f"rounding of {self.finest.steps} steps, {PER_STEP:.1g} × {scale:.3g} {unit} each, = {floor:.2g}"
        )
        if value <= floor:
            return row("agrees", f"{name} {value:.2g} {unit}: rounding", floor, base)
        try:
            limit = self.limit(ys)
        except ValueError as error:
            return row("unresolved", str(error), floor, base)
        left = np.max(np.linalg.norm(limit.y, axis=-1), axis=1)
        own = np.maximum.accumulate(np.max(np.linalg.norm(ys[-1] - limit.y, axis=-1), axis=1))
        tolerance = limit.uncertainty + floor + extra_uncertainty
        left = np.maximum.accumulate(left)
        for count in self.windows(float(self.times[-1])):
            at = count - 1
            end = float(self.times[at])
            why = (
                f"the limit of the drift at step zero is {left[at]:.2g} ± {limit.uncertainty[at]:.2g} up to t = {end:g} s; "
                f"plus {base}; plus {extra_uncertainty:.2g} of the work by quadrature; the finest run is "
                f"{own[at]:.2g} from the limit"
            )
            allowed = float(own[at] + tolerance[at])
            if left[at] <= tolerance[at] <= PART * scale:
                return row(
                    "agrees", f"{name} {value:.2g} {unit} at the finest step, and {left[at]:.1g} at step zero",
                    max(allowed, value) if end < self.times[-1] else allowed, why, limit=float(left[at]),
                )  # fmt: skip
            if left[at] > tolerance[at] and self.shows_order(ys, floor):
                return row(
                    "disagrees", f"{name} does not vanish with the step: {left[at]:.3g} {unit} at step zero",
                    allowed, why, limit=float(left[at]),
                )  # fmt: skip
        return row(
            "unresolved",
            f"{name} {value:.2g} {unit}: its limit {left[at]:.2g} ± {tolerance[at]:.2g} cannot tell",
            allowed, why, limit=float(left[at]),
        )  # fmt: skip

    def shows_order(self, ys: Sequence[Array], floor: float) -> bool:
        """Whether the ladder of this series is in an asymptotic range, so that its limit may accuse."""
        return self.integrator.kind == "tolerance" or observed_order(ys, floor).asymptotic

    def scales(self) -> dict[str, float]:
        """Sizes of what the invariants are made of: energies, momenta, lengths, speeds."""
        true, model = self.truth.trajectory, self.model
        omega = angular_velocity(true.p, true.pdot)
        kinetic = float(np.max(kinetic_energy(model, true.v, omega)))
        potential = float(np.max(np.sum(model.mass * np.abs(true.r @ model.gravity), axis=-1)))
        swing = float(np.ptp(potential_energy(model, true.r)))
        speed = float(np.max(np.linalg.norm(true.v, axis=-1), initial=0.0))
        spin = float(np.max(np.linalg.norm(omega, axis=-1), initial=0.0))
        arm = float(np.max(np.linalg.norm(true.r, axis=-1), initial=0.0))
        inertia = float(np.sum(np.linalg.norm(model.inertia, axis=(1, 2))))
        return {
            "energy_drift": max(kinetic, potential, swing),
            "momentum_drift": float(np.sum(model.mass)) * arm * speed + inertia * spin,
            "joint_gap": max(self.truth.length, arm),
            "gap_rate": max(speed, spin * self.truth.length),
            "norm_drift": 1.0,
        }

    # tables

    def convergence(self, horizon: float) -> list[dict[str, Any]]:
        """Error against the truth, cost and order at every resolution."""
        end = self.windows(horizon)[0]
        order = self.seen_order(horizon)[0].orders if self.integrator.kind == "step" else ()
        records = []
        for i, rung in enumerate(self.rungs):
            for name, error in (
                ("position", position_error(self.positions[i][:end], self.truth.trajectory.r[:end])),
                ("attitude", attitude_error(self.attitudes[i][:end], self.truth.trajectory.p[:end])),
            ):
                records.append(
                    {
                        "scenario": self.who.scenario, "engine": self.who.engine, "integrator": self.integrator.name,
                        "resolution": rung.resolution, "quantity": name, "error": float(np.max(error)),
                        "cost": rung.cost, "steps": rung.trajectory.steps if rung.trajectory else 0,
                        "order": order[i - 2] if i >= 2 and order else float("nan"),
                    }
                )  # fmt: skip
        return records

    def curves(self) -> list[dict[str, Any]]:
        """Series of the finest run: errors and drifts over time, with the tolerance on positions."""
        found = self.drift[-1]
        assert found is not None
        true = self.truth.trajectory
        limit = self.limit(self.positions)
        tolerance = limit.uncertainty + self.truth.position_uncertainty + self.truth.length * self.rounding

        def size(y: Array | None) -> Array:
            if y is None:
                return np.full(len(self.times), np.nan)
            return np.asarray(np.max(np.linalg.norm(y, axis=-1), axis=1))

        columns = {
            "t": self.times,
            "position_error": position_error(self.finest.r, true.r),
            "attitude_error": attitude_error(self.finest.p, true.p),
            "limit_error": position_error(limit.y, true.r),
            "tolerance": tolerance,
            **{name: size(getattr(found, name)) for name in UNITS},
        }
        return [
            {
                "scenario": self.who.scenario, "engine": self.who.engine, "integrator": self.integrator.name,
                "resolution": self.rungs[-1].resolution,
                **{name: float(column[i]) for name, column in columns.items()},
            }
            for i in range(len(self.times))
        ]  # fmt: skip
