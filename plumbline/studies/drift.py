"""The drift table: how far raw, Baumgarte and projected runs leave constraints and energy in 10, 100, 1000 s.

A run to 1000 s costs a hundred times one to 10 s, which every run begins with; where that is more than may
be spent, the later times are left out and the row says what they would have cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import process_time
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from plumbline.model.kinematics import quaternion_rate
from plumbline.scenario.loader import Scenario
from plumbline.storage.results_store import to_json_value, write_atomically
from reference_impl.stabilised import VARIANTS, drift_table

TIMES = (10.0, 100.0, 1000.0)  # s
SCHEMA = pa.schema(
    [
        ("scenario", pa.string()),
        ("variant", pa.string()),
        ("rtol", pa.float64()),
        ("time", pa.float64()),  # s, the errors are the largest over [0, time]
        ("gap", pa.float64()),  # m; null, with a reason, where the run was not made or failed
        ("gap_rate", pa.float64()),  # m/s
        ("norm", pa.float64()),  # |‖p‖ − 1|
        ("energy", pa.float64()),  # |E − E(0)| over Σ m g reach; null with loads or drag
        ("steps", pa.int64()),
        ("cpu_seconds", pa.float64()),  # of the run, to this time in proportion
        ("reason", pa.string()),
    ]
)


def measure_drift(
    selected_scenarios: Sequence[Scenario],
    max_cpu_seconds: float,
    rtols: Sequence[float],
    times: Sequence[float] = TIMES,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
    log: Callable[[str], None] = lambda sentence: None,
) -> pa.Table:
    """One row per scenario, variant, rtol and time (columns as `SCHEMA`).

    ``longest`` CPU seconds may be spent on one run; ``tell`` hears what each will cost.
    """
    asked = [(s, variant, rtol) for s in selected_scenarios for rtol in rtols for variant in VARIANTS]
    records: list[dict[str, Any]] = []
    for done, (s, variant, rtol) in enumerate(asked):
        progress(done, len(asked), f"{s.name}, {variant}, rtol {rtol:g}")
        records += _measure_variant(s, variant, rtol, max_cpu_seconds, times, log)
    progress(len(asked), len(asked), "done")
    return pa.Table.from_pylist([to_json_value(record) for record in records], schema=SCHEMA)


def write(found: pa.Table, folder: Path) -> Path:
    """Write `drift.parquet`; its path."""
    sink = pa.BufferOutputStream()
    pq.write_table(found, sink, compression="zstd")
    path = folder / "drift.parquet"
    write_atomically(path, sink.getvalue().to_pybytes())
    return path


def _measure_variant(
    s: Scenario,
    variant: str,
    rtol: float,
    max_cpu_seconds: float,
    times: Sequence[float],
    log: Callable[[str], None],
) -> Iterator[dict[str, Any]]:
    """The rows of one variant at one tolerance: first to the first time, then to the last affordable one."""
    key = {"scenario": s.name, "variant": variant, "rtol": rtol}
    start = s.model, s.state.r, s.state.p, s.state.v, quaternion_rate(s.state.p, s.state.omega)
    within: Sequence[float] = times[:1]
    reasons = dict.fromkeys(times, "")
    try:
        began = process_time()
        found = drift_table(*start, rtols=(rtol,), times=within, variants=(variant,))
        spent = process_time() - began
        foreseen = {time: spent * time / times[0] for time in times}
        affordable = [time for time in times if foreseen[time] <= max_cpu_seconds] or times[:1]
        for time in times[len(affordable) :]:
            reasons[time] = (
                f"left out: would cost {foreseen[time]:.0f} s, more than the {max_cpu_seconds:g} s allowed"
            )
        if len(affordable) > 1:
            what = f"{s.name}, {variant}, rtol {rtol:g}"
            log(f"{what}: to {affordable[-1]:g} s, about {foreseen[affordable[-1]]:.0f} s of CPU time")
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
