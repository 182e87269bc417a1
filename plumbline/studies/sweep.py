"""Parameter sweeps: the reference runs cells in batches, engines run them cell by cell, all in workers.

An engine's cell is judged as a run judges it: the same refinement study, compared with the same truth up to
the same horizon (`plumbline.judging.trajectory_level`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import pyarrow as pa

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.engine_calls import RefinementStudy, run_refinement
from plumbline.execution.plan import ProgressCallback, no_progress
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.model.datatypes import Integrator, Trajectory
from plumbline.model.grouping import grouped
from plumbline.model.invariants import compute_invariants, position_error
from plumbline.processes.worker_pool import Outcome, Task, WorkerPool
from plumbline.scenario.loader import Scenario
from plumbline.studies.parquet_files import make_table
from plumbline.studies.sweep_file import REFINEMENT_LEVELS, Sweep, SweepCell
from plumbline.truth.ground_truth import MotionTruth, motion_truth
from plumbline.truth.notes_motion import integrate_batch, trajectories

REFERENCE_RTOLS = (1e-9, 1e-11)  # of the reference: a run, and the tighter run that gives its uncertainty
MAX_REFERENCE_STEPS = 1e6  # about 20 min
BATCH_SIZE = 256  # cells that the reference integrates together; more take as long per cell

COLUMNS: dict[str, pa.DataType] = {
    "cell": pa.int32(),
    "implementation": pa.string(),
    "integrator": pa.string(),
    "verdict": pa.string(),  # the worst of a run's verdicts on this motion
    "reason": pa.string(),  # of that verdict
    "position_error": pa.float64(),  # m, of the limit at step zero, largest as long as it is compared
    "attitude_error": pa.float64(),  # rad, of the run with the smallest step
    "uncertainty": pa.float64(),  # m, of the limit and of the truth together; of the reference: its own
    "finest_error": pa.float64(),  # m, of the run with the smallest step
    "energy_drift": pa.float64(),  # J, largest |E − E(0) − W|
    "joint_gap": pa.float64(),  # m
    "reach": pa.float64(),  # m, largest distance of the last body's centre of mass from the pivot
    "x": pa.float64(),  # m, the last body's centre of mass at the end
    "y": pa.float64(),
    "z": pa.float64(),
    "steps": pa.int64(),
}
Record = dict[str, Any]  # column name → value


def run(
    sweep: Sweep,
    cells: Sequence[SweepCell],
    workers: WorkerPool,
    engines: Mapping[str, EngineInfo],
    progress: ProgressCallback = no_progress,
) -> pa.Table:
    """Run and judge all cells of a sweep.

    Args:
        cells: its cells, from `plumbline.studies.sweep_file.load`.
        workers: run the reference, the truths and the engines.
        progress: called after every task with tasks done, tasks in all and the task's name.

    Returns:
        One row per cell and implementation: the cell's values, then `COLUMNS`.

    """
    by_index = {cell.index: cell for cell in cells}
    valid = {cell.index: cell.scenario for cell in cells if cell.scenario is not None}
    records: list[Record] = [
        _reference_record(cell.index, Verdict.UNSUPPORTED, cell.invalid_reason)
        for cell in cells
        if cell.scenario is None
    ]
    counted = _Progress(workers, progress)
    references = list(_run_references(counted, valid))
    lost = {record["cell"]: record["reason"] for record in references if record["verdict"] == Verdict.FAILED}
    records += references
    if sweep.engines:
        records += _run_engines(counted, sweep, engines, valid, lost)
    for record in records:
        record |= by_index[record["cell"]].values
    order = ["reference", *sweep.engines]
    records.sort(key=lambda record: (record["cell"], order.index(record["implementation"])))
    names = [*cells[0].values, *(name for name in COLUMNS if name not in cells[0].values)]
    schema = pa.schema(
        [(name, COLUMNS.get(name, pa.float64())) for name in names],
        metadata={"sweep": sweep.model_dump_json(by_alias=True)},
    )
    return make_table(records, schema)


class _Progress:
    """Runs tasks and counts them."""

    def __init__(self, workers: WorkerPool, progress: ProgressCallback) -> None:
        self.limits, self._workers, self._progress = workers.limits, workers, progress
        self._done, self._total = 0, 0

    def run(self, tasks: Sequence[Task], what: str) -> Iterator[Outcome]:
        self._total += len(tasks)
        for outcome in self._workers.run(tasks):
            self._done += 1
            self._progress(self._done, self._total, what)
            yield outcome


def _batches(valid: Mapping[int, Scenario]) -> list[list[int]]:
    """Indices of cells that have the same duration and sample interval, in batches of limited size."""
    groups = grouped(valid, lambda index: (valid[index].duration, valid[index].sample_interval)).values()
    return [group[k : k + BATCH_SIZE] for group in groups for k in range(0, len(group), BATCH_SIZE)]


def _reference_record(index: int, verdict: Verdict, reason: str) -> Record:
    return {"cell": index, "implementation": "reference", "verdict": verdict, "reason": reason}


def _run_references(counted: _Progress, valid: Mapping[int, Scenario]) -> Iterator[Record]:
    """The reference's rows; the cells of a batch that fails run one by one, so that only one cell is lost."""
    batches = _batches(valid)
    while batches:
        tasks = [
            Task(
                k, _run_reference_batch, ([(i, valid[i]) for i in batch],), counted.limits, engine="reference"
            )
            for k, batch in enumerate(batches)
        ]
        failed: list[list[int]] = []
        for outcome in counted.run(tasks, "reference"):
            batch = batches[outcome.key]
            if outcome.failure is None:
                yield from outcome.value
            elif len(batch) > 1:
                failed += [[index] for index in batch]
            else:
                yield _reference_record(batch[0], Verdict.FAILED, outcome.failure)
        batches = failed


def _run_reference_batch(group: Sequence[tuple[int, Scenario]]) -> list[Record]:
    """The reference's rows of one batch, in a worker; raise ArithmeticError where a cell fails."""
    cases, times = [(s.model, s.state) for _, s in group], group[0][1].times
    runs = (
        trajectories(integrate_batch(cases, times, rtol, max_steps=MAX_REFERENCE_STEPS), cases)
        for rtol in REFERENCE_RTOLS
    )
    reason = "the reference; its uncertainty is the change to the tighter tolerance"
    return [
        {
            **_reference_record(index, Verdict.AGREES, reason),
            "integrator": "collocation",
            "uncertainty": float(np.max(position_error(coarse.r, motion.r))),
            **_measure_motion(scenario, motion),
        }
        for (index, scenario), coarse, motion in zip(group, *runs, strict=True)
    ]


def _measure_motion(scenario: Scenario, motion: Trajectory) -> Record:
    """The columns that need no truth."""
    invariants = compute_invariants(scenario.model, motion)
    return {
        "energy_drift": float(np.max(np.abs(invariants.energy_drift))),
        "joint_gap": float(np.max(np.linalg.norm(invariants.joint_gap, axis=-1))),
        "reach": float(np.max(np.linalg.norm(motion.r[:, -1], axis=-1))),
        **dict(zip("xyz", motion.r[-1, -1].tolist(), strict=True)),
        "steps": motion.steps,
    }


def _run_engines(
    counted: _Progress,
    sweep: Sweep,
    engines: Mapping[str, EngineInfo],
    scenarios: Mapping[int, Scenario],
    lost: Mapping[int, str],
) -> Iterator[Record]:
    """The engines' rows, in the order in which the workers finish them; ``lost`` cells have no truth."""

    def record(index: int, engine: str, verdict: Verdict, reason: str | None) -> Record:
        names = {"cell": index, "implementation": engine, "integrator": sweep.engines[engine]}
        return names | {"verdict": verdict, "reason": reason}

    installed = {name: info for name, info in engines.items() if info.missing is None}
    for name in engines.keys() - installed.keys():
        verdict = Verdict.FAILED if engines[name].has_failed else Verdict.NOT_INSTALLED
        for index in scenarios:
            yield record(index, name, verdict, engines[name].missing)
    solvable = {index: s for index, s in scenarios.items() if index not in lost}
    truths: dict[int, MotionTruth | str] = dict(lost)
    truths |= _compute_truths(counted, solvable if installed else {})
    for name, index in product(installed, lost):
        reason = f"no truth to judge by: the reference failed: {lost[index]}"
        yield record(index, name, Verdict.HARNESS_FAILED, reason)
    integrators = {
        name: next(one for one in info.integrators if one.name == sweep.engines[name])
        for name, info in installed.items()
    }
    tasks = [
        Task(
            (index, name),
            run_refinement,
            (name, integrator.name, s.model, s.state, s.times, _resolutions(integrator, s, sweep.step)),
            counted.limits,
            engine=name,
        )
        for name, integrator in integrators.items()
        for index, s in solvable.items()
    ]
    for outcome in counted.run(tasks, "engines"):
        index, name = outcome.key
        truth = truths[index]
        doubt = f"no truth to judge by: {truth}" if isinstance(truth, str) else truth.conflict
        if outcome.failure or isinstance(truth, str) or doubt:
            verdict = Verdict.HARNESS_FAILED if doubt else Verdict.FAILED
            yield record(index, name, verdict, doubt or outcome.failure)
            continue
        row, errors = _judge_cell(installed[name], integrators[name], scenarios[index], outcome.value, truth)
        yield record(index, name, row.verdict, row.reason) | errors


def _compute_truths(counted: _Progress, scenarios: Mapping[int, Scenario]) -> dict[int, MotionTruth | str]:
    """By cell its true motion, or the reason why there is none.

    A task that fails, as where compiled code crashes its worker, is repeated without compiled code.
    """
    truths: dict[int, MotionTruth | str] = {}
    for without_compiler in ((), (0,)):
        tasks = [
            Task(index, motion_truth, (s.model, s.state, s.times, None, *without_compiler), counted.limits)
            for index, s in scenarios.items()
            if not isinstance(truths.get(index), MotionTruth)
        ]
        outcomes = counted.run(tasks, "truth")
        truths |= {outcome.key: outcome.failure or outcome.value for outcome in outcomes}
    return truths


def _resolutions(integrator: Integrator, scenario: Scenario, step: float | None) -> list[float]:
    """Resolutions of a run, or halvings of ``step``; coarse steps are shortened to hit every sample."""
    resolutions = refinement_resolutions(integrator, scenario.model.n, scenario.duration)
    if integrator.kind == "tolerance":
        return resolutions
    levels = len(resolutions) if step is None else REFINEMENT_LEVELS
    interval = scenario.sample_interval
    coarse = interval / np.ceil(interval / (step or resolutions[0]) * (1 - 1e-12))
    return [float(coarse / 2**k) for k in range(levels)]


def _judge_cell(
    info: EngineInfo, integrator: Integrator, scenario: Scenario, study: RefinementStudy, truth: MotionTruth
) -> tuple[Row, Record]:
    """The row with the worst verdict of a run on this motion, and the columns of errors."""
    who = RowContext(scenario.name, scenario.family, info.name, info.title, info.version)
    rows = judge_trajectory(who, scenario.model, truth, integrator, study).rows
    by_quantity = {row.quantity: row for row in rows}
    errors: Record = {
        column: getattr(by_quantity.get(quantity), field, None)
        for column, quantity, field in (
            ("position_error", "position_limit", "value"),
            ("attitude_error", "attitude", "value"),
            ("uncertainty", "position_limit", "uncertainty"),
            ("finest_error", "position", "value"),
        )
    }
    finest = study.runs[-1].trajectory if study.runs else None
    if finest is not None:
        errors |= _measure_motion(scenario, finest)
    return max(rows, key=lambda row: row.rank), errors
