"""Turn pydantic's validation errors into problems with the field, its position and what would be valid."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from plumbline.model.datatypes import KINDS as JOINT_KINDS
from plumbline.scenario.errors import Problem, closest_match, did_you_mean, shorten
from plumbline.scenario.schema import (
    SCHEMA_VERSION,
    Articulated,
    Ball,
    Body,
    BodySequence,
    Document,
    Free,
    Rod,
)
from plumbline.scenario.yaml_source import PathKey, YamlSource, dotted_path

UNION_TAGS: dict[str, type[BaseModel]] = {
    **dict.fromkeys(JOINT_KINDS, Articulated),
    "ball": Ball,
    "rod": Rod,
    "free": Free,
    "body": Body,
    "sequence": BodySequence,
}
KINDS = "one of kind: " + ", ".join(JOINT_KINDS)
MAX_NUMBER_LENGTH = 100  # characters; a longer text is not taken for a mistyped number


def problems_from_validation(
    source: YamlSource, errors: Iterable[ErrorDetails], root: type[BaseModel] = Document
) -> list[Problem]:
    """Make one problem of each validation error; a misspelt field is not reported as missing too.

    Args:
        source: the file's positions.
        errors: pydantic's errors.
        root: the model of the file, or of the items of a file that is a list.

    Returns:
        The problems, in the order of the errors.

    """
    located = [(error, *_locate_field(source, error["loc"], root)) for error in errors]
    misspelt = {
        (*path[:-1], closest_match(str(path[-1]), list(model.model_fields)))
        for error, path, model, _ in located
        if error["type"] == "extra_forbidden"
    }
    return [
        _problem_from_error(source, error, path, model, info)
        for error, path, model, info in located
        if error["type"] != "missing" or path not in misspelt
    ]


def _problem_from_error(
    source: YamlSource,
    error: ErrorDetails,
    path: tuple[PathKey, ...],
    model: type[BaseModel],
    info: FieldInfo | None,
) -> Problem:
    conflicting = error.get("ctx", {}).get("default_conflicts_with")
    if conflicting and path not in source.value_positions:
        path = (*path[:-1], conflicting)
    extra = error["type"] == "extra_forbidden"
    place = source.key_positions.get(path) if extra else source.value_positions.get(path)
    place = place or source.value_positions.get(path[:-1]) or (1, 1)
    message, valid = _message_and_valid(error, model, info)
    return Problem(source.file, *place, dotted_path(path), message, valid)


def _locate_field(
    source: YamlSource, loc: tuple[PathKey, ...], root: type[BaseModel]
) -> tuple[tuple[PathKey, ...], type[BaseModel], FieldInfo | None]:
    """Find the path in the file, which has no union tags, the model that the field is in, and the field."""
    path: tuple[PathKey, ...] = ()
    model = root
    info: FieldInfo | None = None
    for key in loc:
        if isinstance(key, str) and key in UNION_TAGS and (*path, key) not in source.value_positions:
            model = UNION_TAGS[key]
            continue
        path = (*path, key)
        if isinstance(key, str):
            info = model.model_fields.get(key)
            for inner in _models_in_annotation(info.annotation if info else None):
                if inner not in UNION_TAGS.values() or inner is Body:
                    model = inner
    return path, model, info


def _models_in_annotation(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in_annotation(inner)]


def _message_and_valid(
    error: ErrorDetails, model: type[BaseModel], info: FieldInfo | None
) -> tuple[str, str]:
    kind, given, context = error["type"], error.get("input"), error.get("ctx", {})
    name = str(error["loc"][-1]) if error["loc"] else ""
    match kind:
        case "plumbline":
            return str(context["message"]), str(context["valid"])
        case "missing":
            return "is missing", _field_description(info)
        case "extra_forbidden":
            fields = list(model.model_fields)
            return f"unknown field. {did_you_mean(name, fields)}".strip(" ."), "one of " + ", ".join(fields)
        case "literal_error" if name == "schema_version":
            return f"is {_quote(given)}; this version of Plumbline reads {SCHEMA_VERSION}", str(
                SCHEMA_VERSION
            )
        case "literal_error":
            options = (
                [o for arg in get_args(info.annotation) for o in (get_args(arg) or (arg,))] if info else []
            )
            words = [str(o) for o in options if isinstance(o, str)]
            hint = did_you_mean(str(given), words)
            return f"is {_quote(given)}. {hint}".strip(" ."), str(context.get("expected"))
        case "union_tag_not_found":
            close = [k for k in given if did_you_mean(k, ["kind"])] if isinstance(given, dict) else []
            hint = f" ({_quote(close[0])} is not a field of it)" if close else ""
            return f"has no kind{hint}", KINDS
        case "union_tag_invalid":
            return f"has the kind {_quote(context.get('tag'))}", KINDS
        case "int_type" | "int_from_float":
            return f"is {_describe_value(given)}, not a whole number", "a whole number"
        case "float_type":
            return _describe_non_number(given), _number_phrase(info)
        case "finite_number":
            return f"is {_quote(given)}, not a finite number", _number_phrase(info)
        case "greater_than" | "greater_than_equal" | "less_than_equal":
            sign = {"greater_than": "above", "greater_than_equal": "at least", "less_than_equal": "at most"}[
                kind
            ]
            bound = context.get("gt", context.get("ge", context.get("le")))
            return f"is {_quote(given)}", f"a number {sign} {bound:g}"
        case "model_type" | "model_attributes_type" | "dict_type" if not error["loc"]:
            return f"is {_describe_value(given)}", "a mapping that starts with schema_version: 1"
        case "list_type" | "model_type" | "model_attributes_type" | "dict_type" | "string_type":
            return f"is {_describe_value(given)}", _field_description(info, kind)
        case "too_short" | "too_long":
            bound = context.get("min_length", context.get("max_length"))
            fixed = isinstance(given, list) and bound in (
                2,
                3,
                4,
                6,
            )  # pairs, vectors, quaternions, six, matrix
            few = "exactly" if fixed else "at least" if kind == "too_short" else "at most"
            return f"has {context.get('actual_length')} entries", f"{few} {bound}"
        case "string_too_short" | "string_too_long":
            length = context.get("min_length", context.get("max_length"))
            few = "at least" if "min_length" in context else "at most"
            return f"has {len(str(given))} characters", f"{few} {length}"
        case "string_pattern_mismatch":
            return f"is {_quote(given)}", "intrinsic or extrinsic and three axes, as 'intrinsic zxz'"
        case _:
            return error["msg"], _field_description(info)


def _quote(given: Any) -> str:
    return shorten(repr(given))


def _describe_non_number(given: Any) -> str:
    if not isinstance(given, str) or len(given) > MAX_NUMBER_LENGTH:
        return f"is {_describe_value(given)}, not a number"
    if re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", given):
        return f"is the text {_quote(given)}, not a number: leave out the quotes"
    if match := re.fullmatch(r"\s*([-+.\deE]*\d)\s*([^\d\s].*)", given):
        return f"is the text {_quote(given)}: write the number alone, {match[1]}, without {match[2]!r}"
    return f"is {_describe_value(given)}, not a number"


def _describe_value(given: Any) -> str:
    match given:
        case None:
            return "empty"
        case bool():
            return f"the word {str(given).lower()}"
        case dict():
            return "a mapping"
        case list():
            return "a list"
        case str():
            return f"the text {_quote(given)}"
        case _:
            return f"the number {_quote(given)}"


def _unit_suffix(info: FieldInfo | None) -> str:
    extra = info.json_schema_extra if info and isinstance(info.json_schema_extra, dict) else {}
    return f" in {extra['unit']}" if "unit" in extra else ""


def _number_phrase(info: FieldInfo | None) -> str:
    return f"a number{_unit_suffix(info)}"


def _field_description(info: FieldInfo | None, kind: str = "") -> str:
    """Return the first sentence of the field's description, with its unit."""
    if info is None:
        return ""
    sentence = (info.description or "").partition(". ")[0].rstrip(".")
    shape = {"list_type": "a list: ", "string_type": "text: "}.get(
        kind, "a mapping: " if "model" in kind else ""
    )
    return shape + sentence[:1].lower() + sentence[1:] + _unit_suffix(info)
