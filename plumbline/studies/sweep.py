"""Parameter sweeps over a scenario: the reference in one batch, the engines cell by cell.

A sweep file (YAML):

    schema_version: 1
    scenario: double-tumbling-balls      # a catalogue name, or a path beside this file
    vary:                                # fields of the scenario, as `bodies[0].mass`
      bodies[0].mass: {from: 0.5, to: 2.0, points: 5}          # a grid axis (log: true for ratios)
      bodies[1].angular_velocity[2]: {values: [-1, 0, 1]}      # a grid axis
      bodies[0].proximal[0]: {uniform: [0.05, 0.09]}           # drawn, `count` times per grid point
      bodies[1].mass: {normal: [0.9, 0.05]}                    # mean and standard deviation; also log_uniform
    count: 4                             # absent: 1
    seed: 7                              # absent: 0
    duration: 1.0                        # s; absent: the scenario's
    engines: {mujoco: RK4, exudyn: trapezoidal}                # absent: only the reference
    step: 0.002                          # s, of the coarsest of four halvings; absent: 1/512

A cell whose values make no pendulum is kept, with the sentence that says why.
"""

from __future__ import annotations

import copy
import itertools
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, ValidationError

from plumbline.engines.calls import RefinementStudy, run_refinement
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.judging.convergence import romberg
from plumbline.model.datatypes import Array, Trajectory
from plumbline.model.invariants import attitude_error, compute_invariants, position_error
from plumbline.model.kinematics import quaternion_rate
from plumbline.model.sampling import derive_seed
from plumbline.processes.workers import Limits, Task, WorkerPool
from plumbline.scenario import loader as scenarios
from plumbline.scenario.errors import Problem, ScenarioError
from plumbline.scenario.loader import Scenario
from plumbline.scenario.schema import SchemaModel
from plumbline.scenario.yaml_source import PathKey, YamlSource, read_yaml
from plumbline.storage.results_store import to_json_value, write_atomically
from reference_impl import collocation

REFERENCE_RTOLS = (1e-9, 1e-11)  # of the reference: the run and the yardstick of its uncertainty
REFINEMENT_LEVELS = 4
MAX_CELLS = 100_000

ReferenceMotion = tuple[Trajectory, Array]  # a cell's motion, and its uncertainty (T,) in m


class Axis(SchemaModel):
    """How one field varies: exactly one of `from`/`to`/`points`, `values` (grid), or a distribution."""

    start: float | None = Field(None, alias="from")
    to: float | None = None
    points: int | None = Field(None, ge=1, le=10_000)
    log: bool = False
    values: list[float] | None = Field(None, min_length=1)
    uniform: tuple[float, float] | None = None
    normal: tuple[float, float] | None = None
    log_uniform: tuple[float, float] | None = None

    def grid_values(self) -> list[float] | None:
        """The grid's values, or None for a distribution."""
        if self.values is not None:
            return self.values
        if self.start is None or self.to is None or self.points is None:
            return None
        spaced = np.geomspace if self.log else np.linspace
        return [float(x) for x in spaced(self.start, self.to, self.points)]

    def sample(self, rng: np.random.Generator) -> float:
        """One value of the distribution."""
        if self.normal is not None:
            return float(rng.normal(*self.normal))
        if self.uniform is not None:
            return float(rng.uniform(*self.uniform))
        assert self.log_uniform is not None
        return float(np.exp(rng.uniform(*np.log(self.log_uniform))))

    def validation_error(self) -> str:
        """What is wrong with it, or an empty string."""
        ranged = [self.start, self.to, self.points]
        ways = [self.values, self.uniform, self.normal, self.log_uniform]
        given = sum(way is not None for way in ways) + any(x is not None for x in ranged)
        if given != 1:
            return f"gives {given} ways to vary; exactly one of from, values, uniform, normal, log_uniform"
        if any(x is not None for x in ranged) and None in ranged:
            return "a range needs from, to and points"
        if self.log and (self.start is None or self.to is None or self.start * self.to <= 0):
            return "log needs from and to of one sign, neither 0"
        if self.log_uniform is not None and not 0 < self.log_uniform[0] <= self.log_uniform[1]:
            return "log_uniform needs 0 < low ≤ high"
        if self.uniform is not None and self.uniform[0] > self.uniform[1]:
            return "uniform needs low ≤ high"
        if self.normal is not None and self.normal[1] < 0:
            return "normal needs a standard deviation of 0 or more"
        return ""


class Sweep(SchemaModel):
    """A sweep file."""

    schema_version: int
    scenario: str
    vary: dict[str, Axis] = Field(min_length=1)
    count: int = Field(1, ge=1, le=MAX_CELLS)
    seed: int = Field(0, ge=0)
    duration: float | None = Field(None, gt=0, le=1000)
    engines: dict[str, str] = Field(default_factory=dict)
    step: float = Field(1 / 512, gt=0)


@dataclass(frozen=True, eq=False)
class SweepCell:
    """One pendulum of the sweep; ``scenario`` None where its values make none, and ``refused`` why."""

    index: int
    values: dict[str, float]
    scenario: Scenario | None
    invalid_reason: str = ""


def load(path: Path) -> tuple[Sweep, list[SweepCell]]:
    """The sweep of a file and all its cells; ScenarioError with every problem of the file."""
    source = read_yaml(path)
    problems = list(source.problems)
    try:
        sweep = Sweep.model_validate(_coerce_types(source.data))
    except ValidationError as error:
        for e in error.errors():
            at = _source_position(source, e["loc"])
            field = ".".join(str(key) for key in e["loc"])
            problems.append(Problem(source.file, *at, field, e["msg"].lower()))
        raise ScenarioError(problems) from None
    if sweep.schema_version != 1:
        problems.append(
            Problem(source.file, *_source_position(source, ("schema_version",)), "schema_version", "is not 1")
        )
    for name, axis in sweep.vary.items():
        if axis.validation_error():
            problems.append(
                Problem(source.file, *_source_position(source, ("vary", name)), name, axis.validation_error())
            )
    problems += _engine_problems(source, sweep)
    beside = path.parent / sweep.scenario
    try:
        base = scenarios.load_scenario(
            beside if beside.is_file() else scenarios.find_scenario_file(sweep.scenario)
        )
    except ScenarioError as error:
        raise ScenarioError([*problems, *error.problems]) from None
    for name in sweep.vary:
        try:
            if not isinstance(_get_field(base.document, _parse_field_path(name)), int | float):
                raise LookupError
        except LookupError:
            at = _source_position(source, ("vary", name))
            message, valid = (
                f"is no number of {base.name}",
                "a field as `bodies[0].mass`, written in the scenario",
            )
            problems.append(Problem(source.file, *at, name, message, valid))
    size = (
        sweep.count
        if any(a.grid_values() is None for a in sweep.vary.values() if not a.validation_error())
        else 1
    )
    for axis in sweep.vary.values():
        size *= 1 if axis.validation_error() else len(axis.grid_values() or [0])
    if size > MAX_CELLS:
        problems.append(Problem(source.file, 1, 1, "", f"has {size} cells", f"at most {MAX_CELLS}"))
    if problems:
        raise ScenarioError(problems)
    return sweep, list(_make_cells(sweep, base))


def _make_cells(sweep: Sweep, base: Scenario) -> Iterator[SweepCell]:
    grids = {name: grid for name, axis in sweep.vary.items() if (grid := axis.grid_values()) is not None}
    drawn = {name: axis for name, axis in sweep.vary.items() if name not in grids}
    index = 0
    for point in itertools.product(*grids.values()):
        for _ in range(sweep.count if drawn else 1):
            rng = np.random.default_rng(derive_seed("sweep", str(sweep.seed), str(index)))
            values = dict(zip(grids, point, strict=True)) | {n: a.sample(rng) for n, a in drawn.items()}
            document = copy.deepcopy(base.document)
            for name, value in values.items():
                *keys, last = _parse_field_path(name)
                _get_field(document, tuple(keys))[last] = value
            document["name"] = f"{base.name[:60]}-{index}"
            if sweep.duration is not None:
                document["duration"] = sweep.duration
            try:
                yield SweepCell(
                    index, values, scenarios.build_scenario(YamlSource(base.path.name, document), base.path)
                )
            except ScenarioError as error:
                sentence = "; ".join(f"{p.field} {p.message}" for p in error.problems)
                yield SweepCell(index, values, None, sentence)
            index += 1


def run(
    sweep: Sweep,
    cells: Sequence[SweepCell],
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, all_: None,
) -> pa.Table:
    """All cells on the reference and, cell by cell in worker processes, on the sweep's engines.

    One row per cell and implementation: the cell's values, the largest distance from the reference
    and its uncertainty, drifts, and a verdict with its sentence.
    """
    records: list[dict[str, Any]] = []
    references: dict[int, ReferenceMotion] = {}
    for group in _group_by_sampling(cells):
        records += _run_reference_batch(group, references)
    records += [
        {"cell": c.index, "implementation": "reference", "verdict": "unsupported", "reason": c.invalid_reason}
        for c in cells
        if c.scenario is None
    ]
    tasks = [
        Task(
            (cell.index, engine, name),
            _run_engine_refinement,
            (engine, name, cell.scenario, sweep.step),
            Limits(),
        )
        for cell in cells
        if cell.scenario is not None and cell.index in references
        for engine, name in sweep.engines.items()
    ]
    by_index = {cell.index: cell for cell in cells}
    if tasks:
        with WorkerPool(jobs) as workers:
            for done, outcome in enumerate(workers.run(tasks), start=1):
                index, engine, name = outcome.key
                cell = by_index[index]
                records.append(
                    _judge_cell(cell, engine, name, outcome.value, outcome.failure, references[index])
                )
                progress(done, len(tasks))
    for record in records:
        record |= by_index[record["cell"]].values
    records.sort(key=lambda record: (record["cell"], record["implementation"] != "reference"))
    names = [*next(iter(cells)).values, *(n for n in COLUMNS if n not in next(iter(cells)).values)]
    schema = pa.schema(
        [(name, COLUMNS.get(name, pa.float64())) for name in names],
        metadata={"sweep": sweep.model_dump_json(by_alias=True)},
    )
    return pa.Table.from_pylist([to_json_value(record) for record in records], schema=schema)


COLUMNS: dict[str, pa.DataType] = {
    "cell": pa.int32(),
    "implementation": pa.string(),
    "integrator": pa.string(),
    "verdict": pa.string(),
    "reason": pa.string(),
    "position_error": pa.float64(),  # m, largest over bodies and samples, of the extrapolated limit
    "attitude_error": pa.float64(),  # rad
    "uncertainty": pa.float64(),  # m, of the limit and of the reference together
    "finest_error": pa.float64(),  # m, of the run with the smallest step itself
    "energy_drift": pa.float64(),  # J, largest |E − E(0) − W|
    "joint_gap": pa.float64(),  # m
    "reach": pa.float64(),  # m, how far the last body's centre of mass comes from the pivot at most
    "x": pa.float64(),  # m, the last body's centre of mass at the end
    "y": pa.float64(),
    "z": pa.float64(),
    "steps": pa.int64(),
}


def write(table: pa.Table, folder: Path) -> Path:
    """Write `sweep.parquet`; its path."""
    folder.mkdir(parents=True, exist_ok=True)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    path = folder / "sweep.parquet"
    write_atomically(path, sink.getvalue().to_pybytes())
    return path


def _group_by_sampling(cells: Sequence[SweepCell]) -> Iterator[list[tuple[SweepCell, Scenario]]]:
    """Cells of one sampling, which run as one batch; a varied duration or sample makes several."""
    groups: dict[tuple[float, float], list[tuple[SweepCell, Scenario]]] = defaultdict(list)
    for cell in cells:
        if cell.scenario is not None:
            groups[cell.scenario.duration, cell.scenario.sample_interval].append((cell, cell.scenario))
    yield from groups.values()


def _run_reference_batch(
    group: Sequence[tuple[SweepCell, Scenario]], references: dict[int, ReferenceMotion]
) -> list[dict[str, Any]]:
    """The reference's rows; a batch that stops is run again cell by cell, so that one cell is lost."""
    chains = [s.model for _, s in group]
    r, p, v = (np.concatenate([getattr(s.state, name) for _, s in group]) for name in ("r", "p", "v"))
    pdot = np.concatenate([quaternion_rate(s.state.p, s.state.omega) for _, s in group])
    times = group[0][1].times
    try:
        coarse, fine = (
            collocation.integrate_collocation(chains, r, p, v, pdot, times, rtol) for rtol in REFERENCE_RTOLS
        )
    except ArithmeticError as error:
        if len(group) > 1:
            return [record for one in group for record in _run_reference_batch([one], references)]
        cell = group[0][0]
        return [
            {"cell": cell.index, "implementation": "reference", "verdict": "failed", "reason": str(error)}
        ]
    records, at = [], 0
    for cell, scenario in group:
        body = slice(at, at + scenario.model.n)
        at += scenario.model.n
        held = [
            Trajectory(times, x.r[:, body], x.p[:, body], x.v[:, body], x.pdot[:, body], x.steps)
            for x in (coarse, fine)
        ]
        uncertainty = np.maximum.accumulate(position_error(held[0].r, held[1].r))
        references[cell.index] = held[1], uncertainty
        records.append(
            {
                "cell": cell.index,
                "implementation": "reference",
                "integrator": "collocation",
                "verdict": "agrees",
                "reason": "the reference; its uncertainty is the change to the tighter tolerance",
                "uncertainty": float(uncertainty[-1]),
                **_measure_motion(scenario, held[1]),
            }
        )
    return records


def _measure_motion(scenario: Scenario, motion: Trajectory) -> dict[str, Any]:
    kept = compute_invariants(scenario.model, motion)
    x, y, z = (float(c) for c in motion.r[-1, -1])
    return {
        "energy_drift": float(np.max(np.abs(kept.energy_drift))),
        "joint_gap": float(np.max(np.linalg.norm(kept.joint_gap, axis=-1))),
        "reach": float(np.max(np.linalg.norm(motion.r[:, -1], axis=-1))),
        "x": x,
        "y": y,
        "z": z,
        "steps": motion.steps,
    }


def _run_engine_refinement(
    engine: str, integrator: str, scenario: Scenario, step: float
) -> RefinementStudy | str:
    """In a worker: the engine at four halvings of the largest step up to ``step`` that hits every sample.

    A sentence where the engine is not installed.
    """
    coarse = scenario.sample_interval / np.ceil(scenario.sample_interval / step * (1 - 1e-12))
    try:
        kind = load_adapter(engine).integrator(integrator).kind
    except ImportError as error:
        return f"{engine} is not installed here: {error}"
    ladder = [coarse / 2**k for k in range(REFINEMENT_LEVELS)] if kind == "step" else [1e-7, 1e-9, 1e-11]
    return run_refinement(engine, integrator, scenario.model, scenario.state, scenario.times, ladder)


def _judge_cell(
    cell: SweepCell,
    engine: str,
    name: str,
    found: RefinementStudy | str | None,
    lost: str | None,
    truth: ReferenceMotion,
) -> dict[str, Any]:
    """The engine's row: its limit against the reference, within both uncertainties."""
    assert cell.scenario is not None
    record: dict[str, Any] = {"cell": cell.index, "implementation": engine, "integrator": name}
    if isinstance(found, str):
        return record | {"verdict": "not installed", "reason": found}
    if found is None or found.unsupported:
        verdict = "unsupported" if found else "failed"
        return record | {"verdict": verdict, "reason": found.unsupported if found else lost}
    runs = [rung.trajectory for rung in found.runs if rung.trajectory is not None]
    if len(runs) < 3 or found.runs[-1].trajectory is None:
        words = next((rung.failure for rung in found.runs if rung.failure), "fewer than three finite runs")
        return record | {"verdict": "failed", "reason": words}
    reference, own = truth
    method = load_adapter(engine).integrator(name)
    limit = romberg([motion.r for motion in runs], method.error_exponents)
    error = position_error(limit.y, reference.r)
    allowed = limit.uncertainty + own
    # A mistake of one part in 10⁴ moves the pendulum by about that part of its own way.
    seen = 1e-4 * float(np.max(np.linalg.norm(reference.r - reference.r[0], axis=-1)))
    rounding = 64 * np.finfo(float).eps * float(np.max(np.abs(reference.r))) * len(reference.t)
    worst = int(np.argmax(error / (allowed + rounding)))
    at = f"at t = {reference.t[worst]:g} s: {error[worst]:.2e} m from the reference, "
    at += f"uncertain by {allowed[worst] + rounding:.2e} m"
    if np.all(error <= allowed + rounding):
        verdict = "agrees" if allowed[-1] <= max(seen, rounding) else "unresolved"
    else:
        verdict = "disagrees"
    return record | {
        "verdict": verdict,
        "reason": f"{at}" + ("; too uncertain to see one part in 10⁴" if verdict == "unresolved" else ""),
        "position_error": float(np.max(error)),
        "attitude_error": float(np.max(attitude_error(runs[-1].p, reference.p))),
        "uncertainty": float(allowed[-1]),
        "finest_error": float(np.max(position_error(runs[-1].r, reference.r))),
        **_measure_motion(cell.scenario, runs[-1]),
    }


def _parse_field_path(name: str) -> tuple[PathKey, ...]:
    """("bodies", 0, "mass") of ``bodies[0].mass``; LookupError where it is not written so."""
    if not re.fullmatch(r"\w+(\[\d+\]|\.\w+)*", name):
        raise LookupError(name)
    return tuple(int(part) if part.isdigit() else part for part in re.findall(r"\w+", name))


def _get_field(document: Any, keys: tuple[PathKey, ...]) -> Any:
    for key in keys:
        if isinstance(document, dict) or (isinstance(document, list) and isinstance(key, int)):
            document = document[key]  # type: ignore[index]
        else:
            raise LookupError(key)
    return document


def _engine_problems(source: YamlSource, sweep: Sweep) -> Iterator[Problem]:
    for engine, name in sweep.engines.items():
        at = _source_position(source, ("engines", engine))
        if engine not in ENGINES:
            yield Problem(source.file, *at, f"engines.{engine}", "is no engine", ", ".join(ENGINES))
            continue
        try:
            known = [i.name for i in load_adapter(engine).integrators]
        except ImportError:
            continue  # a verdict, not an error
        if name not in known:
            yield Problem(
                source.file, *at, f"engines.{engine}", f"has no integrator {name!r}", ", ".join(known)
            )


def _source_position(source: YamlSource, loc: Sequence[Any]) -> tuple[int, int]:
    path = tuple(loc)
    while path and path not in source.value_positions:
        path = path[:-1]
    return source.value_positions.get(path, (1, 1))


def _coerce_types(data: Any) -> Any:
    """Whole numbers as floats where a float is meant, lists as the pairs of a distribution."""
    if not isinstance(data, dict):
        return data
    vary = data.get("vary")
    if isinstance(vary, dict):
        pairs = ("uniform", "normal", "log_uniform")
        vary = {
            name: {k: tuple(v) if k in pairs and isinstance(v, list) else v for k, v in axis.items()}
            if isinstance(axis, dict)
            else axis
            for name, axis in vary.items()
        }
        data = {**data, "vary": vary}
    return data
