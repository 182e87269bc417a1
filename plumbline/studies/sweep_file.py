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
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.registry import ENGINES
from plumbline.execution.plan import ProgressCallback, no_progress
from plumbline.model.sampling import derive_seed
from plumbline.scenario import loader as scenarios
from plumbline.scenario.line_and_column_errors import Problem, ScenarioError, shorten
from plumbline.scenario.loader import Scenario
from plumbline.scenario.schema import SchemaModel
from plumbline.scenario.validation_messages import problems_from_validation
from plumbline.scenario.yaml_reader import read_yaml
from plumbline.scenario.yaml_source import PathKey, YamlSource

MAX_CELLS = 100_000
MAX_TOTAL_BODIES = 1_000_000  # of all cells: a gigabyte
REPORTED_CELLS = 500  # cells between two reports of progress
MAX_STEPS = 10_000_000  # of one run: minutes of an engine
REFINEMENT_LEVELS = 4  # step sizes of an engine where the file names the coarsest


Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


class Axis(SchemaModel):
    """How one field varies: a range or values (a grid axis), or a distribution; exactly one of them."""

    start: float | None = Field(None, alias="from", description="The first value of a range.")
    to: float | None = Field(None, description="The last value of a range.")
    points: int | None = Field(None, ge=1, le=10_000, description="Number of values of a range.")
    log: bool = Field(False, description="The word true where values of equal ratios are wanted.")
    values: list[float] | None = Field(None, min_length=1, description="The values.")
    uniform: Pair | None = Field(None, description="The lower and the upper bound, as [0.5, 2].")
    normal: Pair | None = Field(None, description="Mean and standard deviation, as [1, 0.1].")
    log_uniform: Pair | None = Field(None, description="The lower and the upper bound, as [0.5, 2].")

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

        Returns:
            The value, in the field's unit.

        """
        if self.normal is not None:
            return float(rng.normal(self.normal[0], self.normal[1]))
        if self.uniform is not None:
            return float(rng.uniform(self.uniform[0], self.uniform[1]))
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

    schema_version: Literal[1] = Field(description="Version of this format: 1.")
    scenario: str = Field(description="A name of the catalogue, or a path beside this file.", min_length=1)
    vary: dict[str, Axis] = Field(
        description="Fields of the scenario, as `bodies[0].mass: {from: 0.5, to: 2, points: 5}`.",
        min_length=1,
    )
    count: int = Field(1, ge=1, le=MAX_CELLS, description="Random values per grid point.")
    seed: int = Field(0, ge=0, lt=2**63, description="Seed of the random values.")
    duration: float | None = Field(None, gt=0, le=1000, description="Duration in s.")
    engines: dict[str, str] = Field(
        default_factory=dict, description="Engines and their integrators, as `{mujoco: RK4}`."
    )
    step: float | None = Field(None, gt=0, description="The coarsest of four steps in s.")


@dataclass(frozen=True, eq=False)
class SweepCell:
    """One combination of the varied values."""

    index: int
    values: dict[str, float]  # by varied field, in the field's unit
    scenario: Scenario | None  # None where the values make no valid scenario
    invalid_reason: str = ""  # why not


def load(path: Path, progress: ProgressCallback = no_progress) -> tuple[Sweep, list[SweepCell]]:
    """Read a sweep file and make its cells.

    Args:
        progress: called now and then with cells made and cells in all: a hundred thousand take minutes.

    Returns:
        The sweep, and one cell for each grid point and draw.

    Raises:
        ScenarioError: with every problem of the file and of its scenario.

    """
    source = read_yaml(path)
    problems = list(source.problems)

    def report(loc: Sequence[Any], field: str, message: str, valid: str = "") -> None:
        problems.append(Problem(source.file, *source.position(tuple(loc)), field, message, valid))

    try:
        sweep = Sweep.model_validate(source.data)
    except ValidationError as error:
        raise ScenarioError([*problems, *problems_from_validation(source, error.errors(), Sweep)]) from None
    for engine in sweep.engines.keys() - ENGINES.keys():
        report(("engines", engine), f"engines.{engine}", "is no engine", ", ".join(ENGINES))
    try:
        beside = path.parent / sweep.scenario
        file = beside if isfile(beside) else scenarios.find_scenario_file(sweep.scenario)
        found = "" if isfile(file) else f"is {shorten(repr(sweep.scenario))}, and there is no such file"
        valid = "a name of the catalogue, or the path of a scenario file beside this one"
    except ScenarioError as error:
        found, valid = error.problems[0].message, error.problems[0].valid
    if found:
        report(("scenario",), "scenario", found, valid)
        raise ScenarioError(problems)
    try:
        base = scenarios.load_scenario(file)
    except ScenarioError as error:
        raise ScenarioError([*problems, *error.problems]) from None
    for name, axis in sweep.vary.items():
        if not _is_number(base.document, name):
            valid = "a field as `bodies[0].mass`, written in the scenario"
            report(("vary", name), shorten(name), f"is no number of {base.name}", valid)
        if message := axis.validation_error():
            report(("vary", name), shorten(name), message)
    if not problems and (excess := _size_error(sweep, base)):
        report((), "", *excess)
    if problems:
        raise ScenarioError(problems)
    cells: list[SweepCell] = []
    for cell in _make_cells(sweep, base):
        cells.append(cell)
        if len(cells) % REPORTED_CELLS == 0:
            progress(len(cells), _cell_count(sweep), "cells of the sweep")
    longest = max((cell.scenario.duration for cell in cells if cell.scenario), default=0.0)
    shortest = longest * 2 ** (REFINEMENT_LEVELS - 1) / MAX_STEPS
    if sweep.step is not None and sweep.step < shortest:
        valid = f"at least {shortest:g}: {MAX_STEPS:.0e} of its finest steps"
        report(("step",), "step", f"is {sweep.step:g}", valid)
        raise ScenarioError(problems)
    return sweep, cells


def _cell_count(sweep: Sweep) -> int:
    grids = [axis.grid_values() for axis in sweep.vary.values()]
    return math.prod(len(grid) for grid in grids if grid is not None) * (sweep.count if None in grids else 1)


def _size_error(sweep: Sweep, base: Scenario) -> tuple[str, str] | None:
    """What is too much about the cells, and what would be valid."""
    size = _cell_count(sweep)
    if size > MAX_CELLS:
        return f"has {size} cells", f"at most {MAX_CELLS}"
    if size * base.model.n > MAX_TOTAL_BODIES:
        return f"has {size} cells of {base.model.n} bodies", f"at most {MAX_TOTAL_BODIES} bodies in all"
    return None


def check_integrators(path: Path, sweep: Sweep, engines: Mapping[str, EngineInfo]) -> None:
    """Check that each engine has the integrator that the file names for it.

    Args:
        sweep: its content.
        engines: description of each of its engines; one that is missing is not checked.

    Raises:
        ScenarioError: an engine has no such integrator.

    """
    source, problems = read_yaml(path), []
    for name, info in engines.items():
        known = [integrator.name for integrator in info.integrators]
        if info.missing is None and sweep.engines[name] not in known:
            place = source.position(("engines", name))
            message = f"has no integrator {shorten(repr(sweep.engines[name]))}"
            problems.append(Problem(source.file, *place, f"engines.{name}", message, ", ".join(known)))
    if problems:
        raise ScenarioError(problems)


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
