"""Drift of constraints and energy over 10, 100 and 1000 s, for raw, Baumgarte and projected runs.

A run to 10 s predicts the cost of longer ones (1000 s cost a hundred times as much).  Times that would cost
too much are left out, and their rows give the predicted cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from time import process_time
from typing import Any

import pyarrow as pa

from plumbline.model.kinematics import quaternion_rate
from plumbline.scenario.loader import Scenario
from plumbline.storage.results_store import DRIFT_TABLE
from plumbline.studies.tables import make_table
from reference_impl.stabilised import VARIANTS, drift_table

TIMES = (10.0, 100.0, 1000.0)  # s


def measure_drift(
    selected_scenarios: Sequence[Scenario],
    max_cpu_seconds: float,
    rtols: Sequence[float],
    times: Sequence[float] = TIMES,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
    log: Callable[[str], None] = lambda sentence: None,
) -> pa.Table:
    """Measure the drift of the reference's variants.

    Args:
        selected_scenarios: what to run; each with every variant and tolerance.
        max_cpu_seconds: most CPU time of one run [s].
        rtols: relative tolerances of the integrator.
        times: ends of the intervals to measure, ascending [s].
        progress: called with runs done, runs in all and the current run.
        log: called with the predicted cost of each long run.

    Returns:
        One row per scenario, variant, tolerance and time, with the columns of `DRIFT_TABLE`.

    """
    planned = [(s, variant, rtol) for s in selected_scenarios for rtol in rtols for variant in VARIANTS]
    records: list[dict[str, Any]] = []
    for done, (s, variant, rtol) in enumerate(planned):
        progress(done, len(planned), f"{s.name}, {variant}, rtol {rtol:g}")
        records += _measure_variant(s, variant, rtol, max_cpu_seconds, times, log)
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
    start = s.model, s.state.r, s.state.p, s.state.v, quaternion_rate(s.state.p, s.state.omega)
    within: Sequence[float] = times[:1]
    reasons = dict.fromkeys(times, "")
    try:
        began = process_time()
        found = drift_table(*start, rtols=(rtol,), times=within, variants=(variant,))
        spent = process_time() - began
        predicted = {time: spent * time / times[0] for time in times}
        affordable = [time for time in times if predicted[time] <= max_cpu_seconds] or times[:1]
        for time in times[len(affordable) :]:
            reasons[time] = (
                f"left out: would cost {predicted[time]:.0f} s, more than the {max_cpu_seconds:g} s allowed"
            )
        if len(affordable) > 1:
            what = f"{s.name}, {variant}, rtol {rtol:g}"
            log(f"{what}: to {affordable[-1]:g} s, about {predicted[affordable[-1]]:.0f} s of CPU time")
            began, within = process_time(), affordable
            found = drift_table(*start, rtols=(rtol,), times=within, variants=(variant,))
            spent = process_time() - began
    except ArithmeticError as error:
        found, reasons = [], dict.fromkeys(times, f"failed: {error}")
    for row in found:
        yield key | {
            "time": row.time,
            "gap": row.gap,
            "gap_rate": row.gap_rate,
            "norm": row.norm,
            "energy": row.energy,
            "steps": row.steps,
            "cpu_seconds": spent * row.time / within[-1],
            "reason": "",
        }
    for time in times[len(found) :]:
        yield key | {"time": time, "reason": reasons[time]}
