"""What an adapter may declare and return, checked for every adapter, method and field."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import fields
from functools import cache
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

import numpy as np
from packaging.specifiers import InvalidSpecifier, SpecifierSet
from packaging.version import InvalidVersion, Version
from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

from plumbline.model.datatypes import (
    STEP_ORDERS,
    EngineFailure,
    Model,
    StateQuantities,
    Trajectory,
    shape_words,
)
from plumbline.model.kinematics import rate_count
from plumbline.processes.exceptions import MAX_TEXT, one_line

MAX_NAME = 200  # characters of names, titles and versions
COUNT = "count"  # a whole number


@cache
def _fields(kind: type) -> Mapping[str, tuple[str, bool]]:
    """Fields that are arrays or numbers: the shape, "" for a number, and whether the field may be None."""
    found = {}
    for one in fields(kind):
        annotation = str(one.type)
        shape = {"int": COUNT, "float": ""}.get(annotation.partition(" ")[0], shape_words(annotation))
        if shape is not None:
            found[one.name] = shape, annotation.endswith("None")
    return found


def check_record(
    record: Any, kind: type, sizes: Mapping[str, int], label: str, may_be_infinite: Container[str] = ()
) -> None:
    """Check that a record is of its class and its fields of the types and shapes of their annotations.

    Of a trajectory another check names the first sample that is missing or not finite.

    Args:
        kind: the class that it must be of.
        sizes: the sizes that the shapes name; others are any.
        label: adapter and method, for the message.
        may_be_infinite: fields whose numbers need not be finite.

    Raises:
        EngineFailure: it is not; the message names the field, what came and what is valid.

    """
    if not isinstance(record, kind):
        raise EngineFailure(f"{label} returned {describe_value(record)}, must be a {kind.__name__}")
    for name, (shape, is_optional) in _fields(kind).items():
        value = getattr(record, name)
        if value is not None or not is_optional:
            is_finite = kind is not Trajectory and name not in may_be_infinite
            check_numbers(
                value, shape, sizes, f"{label}: {name}", is_optional=is_optional, must_be_finite=is_finite
            )


def check_evaluation(answers: Any, model: Model, count: int, label: str) -> None:
    """Check the answers of an evaluation: one record per state, of quantities that the mechanism has.

    Args:
        label: adapter and method, for the message.

    Raises:
        EngineFailure: a record is missing, or something in it is not valid.

    """
    if not isinstance(answers, list | tuple):
        raise EngineFailure(f"{label} returned {describe_value(answers)}, must be a list of StateQuantities")
    if len(answers) != count:
        raise EngineFailure(f"{label} answered {len(answers)} of {count} states")
    sizes = {"bodies": model.n, "joints": len(model.kind)}
    if not model.has_loops:  # there the mass matrix is not compared
        sizes["nu"] = rate_count(model)
    for index, answer in enumerate(answers):
        at = f"{label}, state {index}"
        check_record(answer, StateQuantities, sizes, at)
        limits = {} if answer.limit_error is None else answer.limit_error
        if not isinstance(limits, Mapping) or not limits.keys() <= _fields(StateQuantities).keys():
            found = describe_value(limits)
            raise EngineFailure(f"{at}: limit_error is {found}, must be numbers by quantity, or None")
        for name, value in limits.items():
            check_numbers(value, "", sizes, f"{at}: limit_error[{name}]")


def check_numbers(
    value: Any,
    shape: str,
    sizes: Mapping[str, int],
    label: str,
    *,
    is_optional: bool = False,
    must_be_finite: bool = True,
) -> None:
    """Check that a value is a number, a count, or an array of doubles of a shape.

    Args:
        shape: sizes and their names, "" for a number, or `COUNT`.
        sizes: the sizes that the shape names.
        label: adapter, method and field, for the message.
        is_optional: whether None is valid too, for the message.

    Raises:
        EngineFailure: it is not.

    """
    if shape in ("", COUNT):
        kinds = (int, np.integer) if shape else (int, float, np.integer, np.floating)
        is_valid = isinstance(value, kinds) and not isinstance(value, bool)
        is_valid = is_valid and not (shape and value < 0)
    else:
        is_valid = type(value) is np.ndarray and value.dtype == np.float64
    expected = () if shape == COUNT else _dimensions(shape, sizes)
    if not is_valid:
        wanted = "a whole number, 0 or more" if shape else "a real number"
        wanted = f"an array of float64 of shape {_words(expected)}" if expected else wanted
        more = ", or None" if is_optional else ""
        raise EngineFailure(f"{label} is {describe_value(value)}, must be {wanted}{more}")
    found = np.shape(value)
    is_fitting = all(isinstance(size, str) or size == n for n, size in zip(found, expected, strict=False))
    if len(found) != len(expected) or not is_fitting:
        raise EngineFailure(f"{label} has shape {found}, expected {_words(expected)}")
    if must_be_finite and not np.isfinite(value).all():
        raise EngineFailure(f"{label} is not finite")


def _dimensions(shape: str, sizes: Mapping[str, int]) -> tuple[int | str, ...]:
    """The sizes of a shape; a name for any size."""
    return tuple(int(s) if s.isdigit() else sizes.get(s, s) for s in shape.split())


def _words(dimensions: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, dimensions))}{',' * (len(dimensions) == 1)})"


def check_text(value: Any, label: str) -> str:
    """Check a name, a title or a version.

    Args:
        label: adapter and field, for the message.

    Raises:
        EngineFailure: it is not a text, or an empty or a very long one.

    """
    if not isinstance(value, str) or not 0 < len(value) <= MAX_NAME or not value.isprintable():
        found = describe_value(value)
        raise EngineFailure(f"{label} is {found}, must be a line of 1 to {MAX_NAME} characters")
    return value


def check_version(column: Any, subject: str) -> tuple[str, str | None]:
    """Check the version of the engine that is loaded.

    Args:
        subject: what it is called: "adapter" or "column".

    Returns:
        The version, and a sentence where the column does not support it.

    Raises:
        EngineFailure: it is not a PEP 440 version.

    """
    version, supported = check_text(column.version(), f"{column.name}: version()"), column.supported_versions
    try:
        if supported and not SpecifierSet(supported).contains(Version(version), prereleases=True):
            words = f"supports versions {supported} of {column.package}, this is {version}"
            return version, f"the {subject} {words}"
    except InvalidVersion:
        raise EngineFailure(f"{column.name}: version() is {version!r}, must be a PEP 440 version") from None
    return version, None


def check_declarations(adapter: Any) -> None:
    """Check an adapter's class attributes against the annotations of the classes of this project.

    Args:
        adapter: any adapter.

    Raises:
        EngineFailure: an attribute is missing, or of another type; the message names it and what is valid.

    """
    label = one_line(type(adapter).__name__)
    for base in type(adapter).__mro__:
        if base.__module__.startswith("plumbline."):
            _check_fields(adapter, base, label)
    for name in ("name", "title", "package"):
        check_text(getattr(adapter, name), f"{label}.{name}")
    for one in adapter.integrators:
        _check_fields(one, type(one), f"{label}.integrators")
        check_text(one.name, f"{label}.integrators: name")
        if one.order < 1 or any(np.diff(one.error_exponents) <= 0):
            raise EngineFailure(f"{label}.integrators: {one.name} has order {one.order} and error exponents "
                                f"{one.error_exponents}, must be at least 1 and ascend")  # fmt: skip
        if one.kind == "step" and one.has_motions and one.order not in STEP_ORDERS:
            raise EngineFailure(f"{label}.integrators: {one.name} has fixed steps of order {one.order}, "
                                f"must be one of {', '.join(map(str, STEP_ORDERS))}")  # fmt: skip
    names = [one.name for one in adapter.integrators]
    if len({*names}) < len(names):
        raise EngineFailure(f"{label}.integrators has a name twice: {', '.join(names)}")
    try:
        SpecifierSet(adapter.supported_versions)
    except InvalidSpecifier as error:
        raise EngineFailure(
            f"{label}.supported_versions is no range of versions: {one_line(str(error))}"
        ) from None


def _check_fields(subject: Any, annotated: type, label: str) -> None:
    for name, (hint, validator) in _validators(annotated).items():
        if not hasattr(subject, name):
            raise EngineFailure(f"{label}.{name} is missing, must be {hint}")
        value = getattr(subject, name)
        try:
            validator.validate_python(dict(value) if isinstance(value, Mapping) else value, strict=True)
        except ValidationError as error:
            where = "".join(f"[{one_line(repr(key))}]" for key in error.errors()[0]["loc"])
            found = describe_value(value)
            raise EngineFailure(f"{label}.{name}{where} is {found}, must be {hint}") from None
        if isinstance(value, str) and len(value) > MAX_TEXT:
            raise EngineFailure(f"{label}.{name} is {describe_value(value)}, must be of at most {MAX_TEXT}")


@cache
def _validators(annotated: type) -> dict[str, tuple[str, TypeAdapter[Any]]]:
    """By annotated attribute its type in words, and what validates it."""
    found = {}
    names = vars(annotated).get("__annotations__", {})
    for name, hint in get_type_hints(annotated).items():
        if name not in names:
            continue
        kind = get_args(hint)[0] if get_origin(hint) is ClassVar else hint
        config = ConfigDict(arbitrary_types_allowed=True)
        try:
            validator: TypeAdapter[Any] = TypeAdapter(kind, config=config)
        except PydanticUserError:  # a dataclass has a configuration of its own
            validator = TypeAdapter(kind)
        found[name] = str(names[name]).removeprefix("ClassVar[").removesuffix("]"), validator
    return found


def describe_value(value: Any) -> str:
    """Describe what came instead of a valid value."""
    if value is None or isinstance(value, bool):
        return str(value)
    if isinstance(value, np.ndarray):
        name = "an array" if type(value) is np.ndarray else f"a {type(value).__name__}"
        return f"{name} of {value.dtype} of shape {value.shape}"
    if isinstance(value, str):
        return f"a text of {len(value):,} characters" if len(value) > 60 else f"the text {value!r}"
    if isinstance(value, int | float | complex):
        return f"the {type(value).__name__} {value!r:.60}"
    count = f" of {len(value)}" if isinstance(value, list | tuple | dict) else ""
    return f"a value of type {one_line(type(value).__name__)}{count}"
