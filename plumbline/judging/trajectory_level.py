"""Trajectories: an integrator's refinement study against the truth.

The limit of the study (step zero) is compared with the truth, within the uncertainties of both and the growth
of rounding; the observed order with the declared one; and every invariant's drift must vanish with the step.
Where a window of time does not decide, its half is tried, down to an eighth; a disagreement in a longer
window is never overruled by a shorter one.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from plumbline.engines.engine_calls import RefinementStudy
from plumbline.judging.identity import run_fingerprints
from plumbline.judging.invariant_drift import invariant_rows
from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.rows import (
    Columns,
    Deviation,
    JudgingResult,
    Level,
    Row,
    RowContext,
    Verdict,
    with_unit,
)
from plumbline.judging.state_level import SINGULAR_POSE
from plumbline.measurements.order_and_limit import ORDER_CHANGE_FACTOR, ORDER_MARGIN
from plumbline.model.datatypes import Integrator, Model, Trajectory
from plumbline.model.invariants import (
    INVARIANT_UNITS,
    LIMITS,
    MOTION_UNITS,
    attitude_error,
    motion_error,
    position_error,
)
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR, MotionTruth

FINEST_RUN_SHOWN = ("position", "attitude")  # quantities with a row of information on the finest run


def judge_trajectory(
    context: RowContext, model: Model, truth: MotionTruth, integrator: Integrator, study: RefinementStudy
) -> JudgingResult:
    """Judge one integrator's refinement study: order, limits and invariants, up to the truth's horizon.

    Args:
        study: the runs, coarse to fine.

    Returns:
        The rows, and the tables of convergence, curves over time and poses.

    """
    missing = partial(context.make_no_answer_row, "trajectory", integrator.name, "all")
    if study.refusal:
        return JudgingResult([missing(study.refusal)])
    finest = study.runs[-1]
    if finest.trajectory is None:
        assert finest.failure is not None
        return JudgingResult([missing(finest.failure, f"at the finest resolution {finest.resolution:g}: ")])
    analysis = RefinementAnalysis(context, model, truth, integrator, study.runs, truth.horizon)
    rows = [*trajectory_rows(analysis), *invariant_rows(analysis)]
    deviations = {
        row.key: _limit_deviation(analysis, row)
        for row in rows
        if row.verdict == Verdict.DISAGREES and row.quantity in LIMITS
    }
    if truth.singular:
        end = float(truth.trajectory.t[-1])
        rows.append(singular_motion_row(context, "trajectory", integrator.name, truth.singular, end))
    names: Columns = {"scenario": context.scenario, "engine": context.engine, "integrator": integrator.name}
    of_finest = names | {"resolution": finest.resolution}
    tables = [
        ("convergence", names | _convergence_columns(analysis)),
        ("curves", of_finest | _time_series_columns(analysis)),
        ("trajectories", of_finest | pose_columns(finest.trajectory)),
    ]
    finished = {run.resolution: run.trajectory for run in study.runs if run.trajectory is not None}
    return JudgingResult(rows, tables, run_fingerprints(integrator.name, finished), deviations)


def _limit_deviation(study: RefinementAnalysis, row: Row) -> Deviation:
    """By how much a limit that disagrees is off the truth, in the window of its row."""
    count = int(np.searchsorted(study.times, row.compared_until or 0.0, side="right"))
    quantity = LIMITS[row.quantity]
    true = study.true_samples[quantity]
    limit = study.extrapolated_limit(study.samples[quantity]).y
    if quantity == "attitude":
        limit = limit / (np.linalg.norm(limit, axis=-1) * np.sign(np.sum(limit * true, axis=-1)))[..., None]
    vectors = (limit - true) * _per_component(quantity)
    tolerance = np.full(vectors.shape[:-1], row.tolerance)  # at the window's end, where it is largest
    return Deviation(vectors[:count], tolerance[:count])


def singular_motion_row(context: RowContext, level: Level, integrator: str, note: str, end: float) -> Row:
    """Report that a motion is compared only up to a singular pose.

    Args:
        note: why the motion is compared no further.
        end: time [s] up to which it is compared.

    Returns:
        The row, unresolved.

    """
    reason = f"{note}; compared up to t = {end:g} s"
    return context.make_row(level, integrator, SINGULAR_POSE, Verdict.UNRESOLVED, reason, compared_until=end)


def trajectory_rows(study: RefinementAnalysis) -> list[Row]:
    """Judge the order of an integrator, and its positions, attitudes and velocities against the truth.

    Args:
        study: the refinement study.

    Returns:
        A row on the order, for fixed steps; then per quantity one on the limit, and of positions and
        attitudes for information one on the finest run.  Velocities of methods with step control are not
        compared: where samples are so close that they limit the steps, the last two tolerances give nearly
        the same run, and what their difference leaves out of the accepted errors is not known.

    """
    rows = [_order_row(study)] if study.has_steps else []
    for name in MOTION_UNITS:
        if study.has_steps or name in FINEST_RUN_SHOWN:
            found = _rows_against_truth(study, name)
            rows += found if name in FINEST_RUN_SHOWN else found[:1]
    return rows


def _per_component(quantity: str) -> float:
    """Unit of a quantity per unit of its samples: |δp| of a unit quaternion is half the rotation angle."""
    return 2.0 if quantity == "attitude" else 1.0


def _order_row(study: RefinementAnalysis) -> Row:
    """The observed order against the declared one."""
    order, declared = study.observed, study.integrator.order
    coarse, fine = study.runs[0].resolution, study.runs[-1].resolution
    steps = f"steps {coarse:g} … {fine:g} s, t ≤ {study.observed_until:g} s"
    listed = ", ".join(f"{o:.2f}" if np.isfinite(o) else "–" for o in order.orders)
    error = None if order.value is None else abs(order.value - declared)
    if order.is_at_rounding_floor:
        verdict, error = Verdict.INFORMATION, None  # the limits are compared, of attitudes too
        reason = f"order not observable: differences are rounding at every step ({steps})"
    elif not order.is_asymptotic or error is None:
        verdict, reason = Verdict.UNRESOLVED, f"not in the asymptotic range: orders {listed} over {steps}"
    else:
        verdict = Verdict.AGREES if error <= ORDER_MARGIN else Verdict.DISAGREES
        reason = f"observed order {order.value:.2f}, declared {declared} ({steps})"
    return study.context.make_row(
        "trajectory",
        study.integrator.name,
        "order",
        verdict,
        reason + study.failures,
        value=error,
        tolerance=ORDER_MARGIN,
        order=order.value,
        declared_order=declared,
        compared_until=study.observed_until,
        derivation=f"log2 of ratios of consecutive differences of (r, ṙ) over {steps}: {listed}; "
        f"two consecutive ones within {ORDER_MARGIN} of {declared} show it, three that differ from it by "
        f"{ORDER_CHANGE_FACTOR:g} times their changes show another",
        **study.common_fields,
    )


def _rows_against_truth(study: RefinementAnalysis, name: str) -> list[Row]:
    """Two rows: the limit against the truth; for information the finest run and the study's estimate.

    Args:
        name: of `MOTION_UNITS`.

    """
    unit, samples, true = MOTION_UNITS[name], study.samples[name], study.true_samples[name]
    make_row = partial(study.context.make_row, "trajectory", study.integrator.name, unit=unit)
    try:
        limit = study.extrapolated_limit(samples)
    except ValueError as error:
        return [make_row(f"{name}_limit", Verdict.UNRESOLVED, str(error))]
    off = np.maximum.accumulate(motion_error(name, limit.y, true))
    # the finest run may itself be the limit of softer ones
    limit_uncertainty = _per_component(name) * limit.uncertainty + study.limit_error[name]
    truth_uncertainty, detectable = study.truth.uncertainty[name], study.truth.detectable[name]
    rounding = study.motion_scales[name] * study.rounding
    tolerance = limit_uncertainty + truth_uncertainty + rounding
    is_trusted = not study.has_steps or study.observed.is_asymptotic or study.observed.is_at_rounding_floor
    words = name.replace("_", " ")

    def judge_window(at: int) -> tuple[Verdict, str]:
        until = f"up to t = {study.times[at]:g} s"
        if off[at] <= tolerance[at] <= detectable[at]:
            return Verdict.AGREES, f"{words} limit within {with_unit(off[at], unit)} of the truth {until}"
        if off[at] <= tolerance[at]:
            return Verdict.UNRESOLVED, (
                f"uncertainty {with_unit(tolerance[at], unit)} {until} is above the "
                f"{with_unit(detectable[at], unit)} that a mistake of {DETECTABLE_PARAMETER_ERROR:g} "
                "would make"
            )
        if is_trusted:
            return Verdict.DISAGREES, (
                f"the {words} at step zero is {with_unit(off[at], unit, 3)} from the truth {until}, "
                f"{off[at] / tolerance[at]:.3g} times the uncertainties"
            )
        reason = f"{words} limit {with_unit(off[at], unit)} off {until}, but no order is observed"
        return Verdict.UNRESOLVED, reason

    verdict, reason, at, remark = study.decide(
        judge_window,
        [motion_error(name, y, true) for y in samples],
        truth_uncertainty + rounding,
        study.horizon,
        study.truth.wanted_time,
    )
    end = float(study.times[at])
    if study.has_steps:
        resolution = "step"
        how = (
            f"{limit.eliminated_powers} powers of h from {study.integrator.error_exponents} eliminated "
            f"over {len(samples)} steps{study.failures}"
        )
    else:
        resolution, how = "tolerance", f"tightest of {len(samples)} tolerances{study.failures}"
    common = {
        "compared_until": end,
        "uncertainty": limit_uncertainty[at] + truth_uncertainty[at],
        **study.common_fields,
    }
    own = np.max(motion_error(name, samples[-1], true)[: at + 1])
    estimate = np.max(motion_error(name, samples[-1], limit.y)[: at + 1]) + tolerance[at]
    finest = study.runs[-1].resolution
    limit_row = make_row(
        f"{name}_limit",
        verdict,
        reason,
        value=off[at],
        tolerance=tolerance[at],
        ratio=off[at] / tolerance[at] if tolerance[at] > 0 else None,  # 0 of what nothing moves
        derivation=f"up to t = {end:g} s: limit ({how}) ± {limit_uncertainty[at]:.2g}, "
        f"truth ({study.truth.method}) ± {truth_uncertainty[at]:.2g}, "
        f"rounding {study.rounding_description} × {with_unit(study.motion_scales[name], unit, 3)} = "
        f"{rounding[at]:.2g}; a mistake of {DETECTABLE_PARAMETER_ERROR:g} in a parameter changes it by "
        f"{detectable[at]:.2g}",
        extra={"visible": detectable[at], "growth": study.truth.growth[at]},
        **common,
    )
    finest_row = make_row(
        name,
        Verdict.INFORMATION,  # own ≤ estimate where the limit agrees, by the triangle inequality
        f"{name} at {resolution} {finest:g} is {with_unit(own, unit)} from the truth, "
        f"the refinement study estimates {estimate:.2g}{remark}",
        value=own,
        tolerance=estimate,
        derivation=f"from the finest run to the limit, plus the limit's tolerance, t ≤ {end:g} s",
        extra={"resolution": finest},
        **common,
    )
    return [limit_row, finest_row]


def _convergence_columns(study: RefinementAnalysis) -> Columns:
    """Error against the truth up to the horizon, cost and order at every resolution."""
    end = study.window_lengths(study.horizon)[0]
    true = study.truth.trajectory
    orders = [np.nan] * 2 + list(study.observed.orders)
    records = []
    for i, run in enumerate(study.runs):
        steps = run.trajectory.steps if run.trajectory else 0
        for name, error in (
            ("position", position_error(study.samples["position"][i][:end], true.r[:end])),
            ("attitude", attitude_error(study.samples["attitude"][i][:end], true.p[:end])),
        ):
            records.append((run.resolution, name, np.max(error), run.cpu_time, steps, orders[i]))
    names = ("resolution", "quantity", "error", "cost", "steps", "order")
    return dict(zip(names, map(list, zip(*records, strict=True)), strict=True))


def _time_series_columns(study: RefinementAnalysis) -> Columns:
    """The finest run over time: errors and drifts, with the tolerance on positions."""
    last, true = study.invariant_drifts[-1], study.truth.trajectory
    assert last is not None
    missing = np.full(len(study.times), np.nan)
    columns = {
        "t": study.times,
        "position_error": position_error(study.finest.r, true.r),
        "attitude_error": attitude_error(study.finest.p, true.p),
        "limit_error": missing,
        "tolerance": missing,
    }
    try:
        limit = study.extrapolated_limit(study.samples["position"])
    except ValueError:
        pass
    else:
        columns["limit_error"] = position_error(limit.y, true.r)
        rounding = study.truth.length * study.rounding
        columns["tolerance"] = limit.uncertainty + study.truth.uncertainty["position"] + rounding
    for name in INVARIANT_UNITS:
        series = getattr(last, name)
        columns[name] = missing if series is None else np.max(np.linalg.norm(series, axis=-1), axis=1)
    return columns


def pose_columns(run: Trajectory) -> Columns:
    """Return the sampled poses of a run as a table.

    Args:
        run: a run with T samples of N bodies.

    Returns:
        Columns t [s], body, rx, ry, rz [m] and p0 … p3, one record per time and body.

    """
    samples, bodies = run.r.shape[:2]
    values = np.concatenate([run.r, run.p], axis=-1).reshape(-1, 7).T
    return {
        "t": np.repeat(run.t, bodies),
        "body": np.tile(np.arange(bodies), samples),
        **dict(zip(("rx", "ry", "rz", "p0", "p1", "p2", "p3"), values, strict=True)),
    }
