"""Drift of constraints and energy over 10, 100 and 1000 s, for raw, Baumgarte and projected runs.

Baumgarte (Comput. Methods Appl. Mech. Eng. 1, 1972) takes γ − 2 a Ċ − a² C for γ, so that constraint errors
die as e^{−a t} in place of growing; projection moves the end of every step, and every sample, onto C = 0 and
Ċ = 0 in the metric of the mass matrix.  Neither replaces the raw form: its drift is a result (E4).

A run to 10 s predicts the cost of longer ones (1000 s cost a hundred times as much).  Times that would cost
too much are left out, and their rows give the predicted cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from time import process_time
from typing import Any

import numpy as np
import pyarrow as pa

from plumbline.execution.plan import ProgressCallback, no_progress
from plumbline.model.datatypes import Array, Float, Model, Trajectory
from plumbline.model.invariants import compute_invariants
from plumbline.scenario.loader import Scenario
from plumbline.storage.results_store import DRIFT_TABLE
from plumbline.studies.parquet_files import make_table
from plumbline.truth.notes_motion import integrate_batch
from reference_impl.fast.collocation import BatchIntegrationResult

BAUMGARTE_RATE = 10.0  # 1/s
VARIANTS: dict[str, dict[str, Any]] = {  # by name the options of the integration
    "raw": {}, "baumgarte": {"baumgarte": BAUMGARTE_RATE}, "projected": {"project": True},
}  # fmt: skip
TIMES = (10.0, 100.0, 1000.0)  # s
SAMPLES = 40  # in each interval, of which the maxima are taken


def measure_drift(
    selected_scenarios: Sequence[Scenario],
    max_cpu_seconds: float,
    rtols: Sequence[float],
    times: Sequence[float] | None = None,
    progress: ProgressCallback = no_progress,
    log: Callable[[str], None] = lambda sentence: None,
) -> pa.Table:
    """Measure the drift of the reference's variants.

    Args:
        selected_scenarios: what to run; each with every variant and tolerance.
        max_cpu_seconds: most CPU time of one run [s].
        rtols: relative tolerances of the integrator.
        times: ends of the intervals to measure, ascending [s]; by default `TIMES`.
        progress: called with runs done, runs in all and the current run.
        log: called with the predicted cost of each long run.

    Returns:
        One row per scenario, variant, tolerance and time, with the columns of `DRIFT_TABLE`.

    """
    planned = [(s, variant, rtol) for s in selected_scenarios for rtol in rtols for variant in VARIANTS]
    records: list[dict[str, Any]] = []
    for done, (s, variant, rtol) in enumerate(planned):
        progress(done, len(planned), f"{s.name}, {variant}, rtol {rtol:g}")
        records += _measure_variant(s, variant, rtol, max_cpu_seconds, times or TIMES, log)
    progress(len(planned), len(planned), "done")
    return make_table(records, DRIFT_TABLE)


def _measure_variant(
    s: Scenario,
    variant: str,
    rtol: float,
    max_cpu_seconds: float,
    times: Sequence[float],
    log: Callable[[str], None],
) -> Iterator[dict[str, Any]]:
    """The rows of one variant at one tolerance: runs to the first and to the last affordable time."""
    key = {"scenario": s.name, "variant": variant, "rtol": rtol}
    reasons = dict.fromkeys(times, "")

    def measured(within: Sequence[float]) -> tuple[list[dict[str, Any]], float]:
        began = process_time()
        rows = _drifts(s, variant, rtol, within)
        spent = process_time() - began
        return [row | {"cpu_seconds": spent * row["time"] / within[-1], "reason": ""} for row in rows], spent

    try:
        found, spent = measured(times[:1])
        predicted = {time: spent * time / times[0] for time in times}
        affordable = [time for time in times if predicted[time] <= max_cpu_seconds] or times[:1]
        for time in times[len(affordable) :]:
            reasons[time] = (
                f"left out: would cost {predicted[time]:.0f} s, more than the {max_cpu_seconds:g} s allowed"
            )
        if len(affordable) > 1:
            what = f"{s.name}, {variant}, rtol {rtol:g}"
            log(f"{what}: to {affordable[-1]:g} s, about {predicted[affordable[-1]]:.0f} s of CPU time")
            found, _ = measured(affordable)
    except ArithmeticError as error:
        found, reasons = [], dict.fromkeys(times, f"failed: {error}")
    yield from (key | row for row in found)
    for time in times[len(found) :]:
        yield key | {"time": time, "reason": reasons[time]}


def _drifts(s: Scenario, variant: str, rtol: float, times: Sequence[float]) -> list[dict[str, Any]]:
    """By the end of each interval the largest errors until then, and the share of the steps."""
    grid = np.unique(np.concatenate([np.linspace(0, end, SAMPLES + 1) for end in times]))
    run = integrate_batch([(s.model, s.state)], grid, rtol, **VARIANTS[variant])
    errors = drift_errors(s.model, run, s.state.x)
    return [
        {"time": end, "steps": round(run.steps * end / times[-1])}
        | {name: float(np.max(error[grid <= end])) for name, error in errors.items()}
        for end in times
    ]


def drift_errors(
    model: Model, run: BatchIntegrationResult, x: Float[Array, "bodies coordinates"] | None = None
) -> dict[str, Array]:
    """Measure the errors of a motion, of the worst joint or body at each sample.

    Args:
        x: joint coordinates at the start, angles unwrapped.

    Returns:
        (T,) each: "gap" [m], "gap_rate" [m/s], "norm" |‖p‖ − 1|, and "energy" |E − E(0)| over Σ m g (reach
        of the stretched mechanism), NaN without weight, and with loads, drag, dampers or efforts, whose work
        so few samples do not give.

    """
    drifts = compute_invariants(model, Trajectory(run.t, run.r, run.p, run.v, run.pdot, run.steps, x))
    far, near = np.moveaxis(np.linalg.norm(model.point, axis=-1), -1, 0)
    reach = np.zeros(model.n)
    for k, body in enumerate(model.body[: model.n, 0]):
        reach[k] = (reach[body] if body >= 0 else 0.0) + far[k] + model.length[k] + near[k]
    weight = float(np.sum(model.mass * reach) * np.linalg.norm(model.gravity))
    series = {"gap": drifts.joint_gap, "gap_rate": drifts.gap_rate, "norm": drifts.norm_drift}
    errors = {name: np.max(np.linalg.norm(x, axis=-1), axis=1) for name, x in series.items()}
    does_work = model.has_loads or model.is_dissipative or bool(np.any(model.effort))
    scale = np.nan if does_work or weight == 0 else weight
    return errors | {"energy": np.abs(drifts.energy_drift[:, 0, 0]) / scale}
