"""Sweep files: which parameters of a scenario vary, and the cells they make.

A sweep file (YAML):

    schema_version: 1
    scenario: double-tumbling-balls      # a catalogue name, or a path beside this file
    vary:                                # fields of the scenario, as `bodies[0].mass`
      bodies[0].mass: {from: 0.5, to: 2.0, points: 5}          # a grid axis (log: true for ratios)
      bodies[1].angular_velocity[2]: {values: [-1, 0, 1]}      # a grid axis
      bodies[0].proximal[0]: {uniform: [0.05, 0.09]}           # random, `count` values per grid point
      bodies[1].mass: {normal: [0.9, 0.05]}                    # mean and standard deviation; also log_uniform
    count: 4                             # default: 1
    seed: 7                              # default: 0
    duration: 1.0                        # s; default: the scenario's
    engines: {mujoco: RK4, exudyn: trapezoidal}                # default: only the reference
    step: 0.002                          # s, the coarsest of four halvings; default: the steps of a run

A cell whose values make no valid scenario is kept, with the reason.
"""

from __future__ import annotations

import copy
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.model.sampling import derive_seed
from plumbline.scenario import loader as scenarios
from plumbline.scenario.errors import Problem, ScenarioError
from plumbline.scenario.loader import Scenario
from plumbline.scenario.schema import SchemaModel
from plumbline.scenario.yaml_source import PathKey, YamlSource, read_yaml

MAX_CELLS = 100_000


class Axis(SchemaModel):
    """How one field varies: a range or values (a grid axis), or a distribution; exactly one of them."""

    start: float | None = Field(None, alias="from")
    to: float | None = None
    points: int | None = Field(None, ge=1, le=10_000)
    log: bool = False
    values: list[float] | None = Field(None, min_length=1)
    uniform: tuple[float, float] | None = None
    normal: tuple[float, float] | None = None
    log_uniform: tuple[float, float] | None = None

    def grid_values(self) -> list[float] | None:
        """List the values of a grid axis.

        Returns:
            The values, in the field's unit; None for a distribution.

        """
        if self.values is not None:
            return self.values
        if self.start is None or self.to is None or self.points is None:
            return None
        spaced = np.geomspace if self.log else np.linspace
        return [float(x) for x in spaced(self.start, self.to, self.points)]

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value of the distribution.

        Args:
            rng: source of random numbers.

        Returns:
            The value, in the field's unit.

        """
        if self.normal is not None:
            return float(rng.normal(*self.normal))
        if self.uniform is not None:
            return float(rng.uniform(*self.uniform))
        assert self.log_uniform is not None
        return float(np.exp(rng.uniform(*np.log(self.log_uniform))))

    def validation_error(self) -> str:
        """Check the axis beyond its types.

        Returns:
            What is wrong, as the end of a sentence; "" where nothing is.

        """
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
    step: float | None = Field(None, gt=0)


@dataclass(frozen=True, eq=False)
class SweepCell:
    """One combination of the varied values."""

    index: int
    values: dict[str, float]  # by varied field, in the field's unit
    scenario: Scenario | None  # None where the values make no valid scenario
    invalid_reason: str = ""  # why not


def load(path: Path) -> tuple[Sweep, list[SweepCell]]:
    """Read a sweep file and make its cells.

    Args:
        path: the file.

    Returns:
        The sweep, and one cell for each grid point and draw.

    Raises:
        ScenarioError: with every problem of the file and of its scenario.

    """
    source = read_yaml(path)
    problems = list(source.problems)

    def report(loc: Sequence[Any], field: str, message: str, valid: str = "") -> None:
        problems.append(Problem(source.file, *_source_position(source, loc), field, message, valid))

    try:
        sweep = Sweep.model_validate(_coerce_types(source.data))
    except ValidationError as error:
        for e in error.errors():
            report(e["loc"], ".".join(str(key) for key in e["loc"]), e["msg"].lower())
        raise ScenarioError(problems) from None
    if sweep.schema_version != 1:
        report(("schema_version",), "schema_version", "is not 1")
    for engine, integrator in sweep.engines.items():
        if problem := _engine_problem(engine, integrator):
            report(("engines", engine), f"engines.{engine}", *problem)
    beside = path.parent / sweep.scenario
    try:
        base = scenarios.load_scenario(
            beside if beside.is_file() else scenarios.find_scenario_file(sweep.scenario)
        )
    except ScenarioError as error:
        raise ScenarioError([*problems, *error.problems]) from None
    size, has_draws = 1, False
    for name, axis in sweep.vary.items():
        if not _is_number(base.document, name):
            valid = "a field as `bodies[0].mass`, written in the scenario"
            report(("vary", name), name, f"is no number of {base.name}", valid)
        if message := axis.validation_error():
            report(("vary", name), name, message)
            continue
        grid = axis.grid_values()
        size *= len(grid or [0])
        has_draws |= grid is None
    size *= sweep.count if has_draws else 1
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
                reason = "; ".join(f"{p.field} {p.message}" for p in error.problems)
                yield SweepCell(index, values, None, reason)
            index += 1


def _parse_field_path(name: str) -> tuple[PathKey, ...]:
    """Split ``bodies[0].mass`` into ("bodies", 0, "mass"); LookupError where the syntax is another."""
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


def _is_number(document: Any, name: str) -> bool:
    """Whether a scenario's document has a number at this field."""
    try:
        return isinstance(_get_field(document, _parse_field_path(name)), int | float)
    except LookupError:
        return False


def _engine_problem(engine: str, integrator: str) -> tuple[str, str] | None:
    """What is wrong with an engine's entry and what is valid; None also where it is not installed."""
    if engine not in ENGINES:
        return "is no engine", ", ".join(ENGINES)
    try:
        known = [i.name for i in load_adapter(engine).integrators]
    except ImportError:
        return None
    return None if integrator in known else (f"has no integrator {integrator!r}", ", ".join(known))


def _source_position(source: YamlSource, loc: Sequence[Any]) -> tuple[int, int]:
    path = tuple(loc)
    while path and path not in source.value_positions:
        path = path[:-1]
    return source.value_positions.get(path, (1, 1))


def _coerce_types(data: Any) -> Any:
    """Turn the lists of distributions into the pairs that the schema expects."""
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
