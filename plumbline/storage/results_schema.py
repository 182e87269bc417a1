"""What results.json must hold: types, ranges, array sizes, and rows of scenarios and engines of the run.

Some fields may be missing and unknown fields are ignored, so that results of earlier versions stay readable.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from plumbline.diagnosis.cause import Cause, Condition, Occurrence
from plumbline.judging.rows import Row
from plumbline.model.datatypes import (
    JOINT_ELEMENTS,
    JOINT_FIELDS,
    KINDS,
    SPRING_FIELDS,
    VALUE_SHAPES,
    Model,
    State,
    column_count,
)
from plumbline.processes.exceptions import PlumblineError
from plumbline.scenario.line_and_column_errors import shorten
from plumbline.scenario.schema import MAX_BODIES, invalid_value_error
from plumbline.scenario.validation_messages import problems_from_validation
from plumbline.scenario.yaml_source import YamlSource

MAX_LISTED_PROBLEMS = 5
MAX_MAGNITUDE = 1e30  # of the model's numbers, as in scenario files

_Count = Annotated[int, Field(ge=0, le=2**53)]
_Duration = Annotated[float, Field(ge=0, le=1e15)]  # s
_VerdictWord = Literal[
    "agrees", "disagrees", "unresolved", "unsupported", "not installed", "failed", "harness failed",
    "information",
]  # fmt: skip
VERDICT_WORDS: frozenset[str] = frozenset(get_args(_VerdictWord))


class DamagedResults(PlumblineError, ValueError):
    """A file of a results folder is not what a run writes; the message names the file and what is wrong."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False, defer_build=True)


class _Scenario(_Part):
    family: str
    title: str
    purpose: str = ""
    file: str = ""
    own: bool = False  # of a file of the user's, whose unresolved rows fail no run
    bodies: int = Field(ge=0, le=MAX_BODIES)
    joints: list[str] = []
    duration: _Duration = 0.0
    sample: _Duration = 0.0
    exact: str | None = None
    digest: str = ""
    seed: str = ""
    horizon: float | None = None
    growth: float | None = None
    truth: str | None = None
    truth_uncertainty: float | None = None
    is_proved: bool = False
    model: dict[str, Any] | None = None
    state: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _check_arrays(self) -> _Scenario:
        model, counts = self.model or {}, dict.fromkeys(SPRING_FIELDS, 0)
        if isinstance(model.get("spring_body"), list):
            counts = dict.fromkeys(SPRING_FIELDS, len(model["spring_body"]))
        absent = {name for name in (*JOINT_ELEMENTS, *SPRING_FIELDS) if name not in model}
        absent -= set(SPRING_FIELDS) if "spring_body" in model else set()
        names = [f.name for f in fields(Model) if f.name not in {"kind", *absent}]
        joints = self._joint_count(model)
        counts |= dict.fromkeys(JOINT_FIELDS, joints)
        if self.model is not None and not _are_kinds(model.get("kind"), joints):
            raise invalid_value_error("model.kind does not fit the bodies", f"{self.bodies} kinds of joints")
        columns = column_count(model.get("kind", ()))

        def shape(name: str) -> tuple[int, ...]:
            sizes = (int(size) if size.isdigit() else columns for size in VALUE_SHAPES[name])
            return counts.get(name, self.bodies), *sizes

        _check_shapes("model", self.model, {name: shape(name) for name in names} | {"gravity": (3,)})
        _check_shapes("state", self.state, {one.name: shape(one.name) for one in fields(State)})
        if self.model is not None and min(self.model["mass"], default=1.0) <= 0:
            raise invalid_value_error("has a mass that is not positive", "masses above 0 kg")
        return self

    def _joint_count(self, model: dict[str, Any]) -> int:
        """As many joints as bodies, and those that close loops."""
        kinds = model.get("kind")
        return max(self.bodies, len(kinds)) if isinstance(kinds, list) else self.bodies


def _are_kinds(given: Any, count: int) -> bool:
    if not isinstance(given, list) or len(given) != count:
        return False
    return all(isinstance(kind, str) and kind in KINDS for kind in given)


def _check_shapes(what: str, given: dict[str, Any] | None, shapes: dict[str, tuple[int, ...]]) -> None:
    """Raise the validation error of an array that is missing, of another shape or not finite."""
    for name, shape in shapes.items() if given is not None else ():
        try:
            array = np.array(given.get(name))  # type: ignore[union-attr]
        except ValueError:  # rows of several lengths
            array = np.array(None)
        is_finite = array.dtype.kind in "if" and bool(np.all(np.abs(array.astype(float)) <= MAX_MAGNITUDE))
        if array.shape != shape or not is_finite:
            size = " × ".join(map(str, shape))
            raise invalid_value_error(f"{what}.{name} does not fit the bodies", f"{size} finite numbers")


class _Integrator(_Part):
    name: str
    kind: Literal["step", "tolerance"] = "step"
    order: _Count = 0
    note: str = ""
    alias_of: str | None = None


class _Engine(_Part):
    title: str
    version: str
    missing: str | None = None
    has_failed: bool = False
    integrators: list[_Integrator] = []


class _WorstRatio(_Part):
    engine: str
    quantity: str
    scenario: str
    ratio: float


class _RandomBatch(_Part):
    scenarios: _Count
    trajectories: _Count = 0
    counts_by_verdict: dict[_VerdictWord, _Count] = {}
    worst_ratios: list[_WorstRatio]


class _Run(_Part):
    id: str
    started: str
    duration: _Duration
    sentence: str
    exit_code: int = Field(ge=0, le=255)
    python: str = ""
    platform: str = ""
    command: str = ""
    commit: str | None = None
    truth: str = ""
    machine: dict[str, str] = {}
    versions: dict[str, str] = {}
    random_batch: _RandomBatch | None = None
    night: _Count = 0
    random: _Count | None = None
    seed: int | None = None


_TYPES_IN_JSON: dict[Any, Any] = {  # of fields of records; numbers that are not finite are stored as null
    int: _Count, float: float | None, tuple[float, ...]: list[float | None], tuple[str, ...]: list[str],
}  # fmt: skip


def _part_of(record: type, **others: Any) -> Any:
    """The fields of a record as JSON has them; some of another type, or with a default."""
    kinds = {name: (_TYPES_IN_JSON.get(kind, kind), ...) for name, kind in get_type_hints(record).items()}
    return create_model(f"_{record.__name__}", __base__=_Part, __module__=__name__, **kinds | others)


_Condition: Any = _part_of(Condition)
_Occurrence: Any = _part_of(Occurrence, time=(float, ...), conditions=(list[_Condition], ...))
_Cause: Any = _part_of(
    Cause, quantities=(list[str], []), needs=(list[str], []), general=(str, ""),
    equal=("list[_Cause]", ...), occurrence=(_Occurrence | None, None),
)  # fmt: skip
_Row: Any = _part_of(
    Row, key=(str, ...), verdict=(_VerdictWord, ...), declared_order=(_Count | None, ...),
    causes=(list[_Cause], ...), cpu_time=(_Duration, ...), extra=(dict[str, float | str | None], ...),
)  # fmt: skip


class _Finding(_Part):
    name: str
    engine: str
    verdict: _VerdictWord
    title: str
    sentence: str
    known_issue: str | None
    versions: list[str]
    right_versions: list[str]
    scenarios: list[str]
    quantities: list[str]
    largest_ratio: float | None
    identity: list[str]
    rows: list[str]


class _Results(_Part):
    run: _Run
    scenarios: dict[str, _Scenario]
    engines: dict[str, _Engine]
    findings: list[_Finding] = []
    rows: list[_Row]

    @model_validator(mode="after")
    def _check_names(self) -> _Results:
        for index, row in enumerate(self.rows):
            for what, known in (("scenario", self.scenarios), ("engine", self.engines)):
                if (name := getattr(row, what)) not in known:
                    raise invalid_value_error(
                        f"rows[{index}].{what} is {shorten(repr(name))}", f"one of the {what}s of the file"
                    )
        return self


def check_results(path: Path, document: Any) -> None:
    """Check the content of a results.json of the present schema version; fill in fields that may be missing.

    Args:
        path: the file, for the message.
        document: its content, as plain data; missing fields of its run, scenarios and engines are added.

    Raises:
        DamagedResults: the content is not what a run writes.

    """
    try:
        _Results.model_validate(document)
    except ValidationError as error:
        details = error.errors(include_url=False)
        source = YamlSource(str(path), document)
        problems = problems_from_validation(source, details[:MAX_LISTED_PROBLEMS], _Results)
        lines = [str(replace(problem, line=0, valid=problem.valid.rstrip(": "))) for problem in problems]
        if len(details) > MAX_LISTED_PROBLEMS:
            lines.append(f"… and {len(details) - MAX_LISTED_PROBLEMS} more problems")
        raise DamagedResults("\n".join(lines)) from None
    document.setdefault("findings", [])
    parts: list[tuple[type[_Part], dict[str, Any]]] = [(_Run, document["run"])]
    parts += [(_Scenario, about) for about in document["scenarios"].values()]
    parts += [(_Engine, about) for about in document["engines"].values()]
    for model, part in parts:
        for name, info in model.model_fields.items():
            if name not in part and not info.is_required():
                part[name] = info.get_default(call_default_factory=True)
