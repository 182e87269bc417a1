"""Turn pydantic's validation errors into problems with the field, its position and what would be valid."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from plumbline.model.datatypes import KINDS as JOINT_KINDS
from plumbline.scenario.line_and_column_errors import (
    Problem,
    closest_match,
    did_you_mean,
    in_brackets,
    shorten,
)
from plumbline.scenario.schema import SCHEMA_VERSION, Body, BodySequence, Document
from plumbline.scenario.yaml_source import FieldPath, YamlSource, dotted_path

MAX_NUMBER_LENGTH = 100  # characters; a longer text is not taken for a mistyped number
KEY_OF_MAPPING = "[key]"  # pydantic's word in the place of an error about a key
BOUNDS = {"greater_than": "above", "greater_than_equal": "at least", "less_than": "below"} | {
    "less_than_equal": "at most"
}
_Places = dict[str, list[tuple[tuple[str, ...], type[BaseModel]]]]


@dataclass(frozen=True)
class _Location:
    """Where an error is, in the file and in the schema."""

    path: FieldPath  # in the file, which has no union tags
    fields: tuple[str, ...]  # those of the schema on the path, without indices and keys of mappings
    model: type[BaseModel]  # the innermost one
    info: FieldInfo | None  # of the last field


def problems_from_validation(
    source: YamlSource, errors: Iterable[ErrorDetails], root: type[BaseModel] = Document
) -> list[Problem]:
    """Make one problem of each validation error; a misspelt field is not reported as missing too.

    Args:
        root: the model of the file, or of the items of a file that is a list.

    Returns:
        The problems, in the order of the errors.

    """
    located = [(error, _locate(error["loc"], root)) for error in errors]
    misspelt = {
        (*at.path[:-1], closest_match(str(at.path[-1]), list(_fields(at.model))))
        for error, at in located
        if error["type"] == "extra_forbidden"
    }
    return [
        _problem_from_error(source, error, at, root)
        for error, at in located
        if error["type"] != "missing" or at.path not in misspelt
    ]


def _problem_from_error(
    source: YamlSource, error: ErrorDetails, at: _Location, root: type[BaseModel]
) -> Problem:
    path = at.path
    conflicting = error.get("ctx", {}).get("default_conflicts_with")
    if conflicting and path not in source.value_positions:
        path = (*path[:-1], conflicting)
    place = source.key_positions.get(path) if error["type"] == "extra_forbidden" else None
    found = place or source.position(path)
    return Problem(source.file, *found, dotted_path(path), *_message_and_valid(error, at, root))


def _fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields by the names that the file has for them."""
    return {info.alias or name: info for name, info in model.model_fields.items()}


def _kinds(model: type[BaseModel]) -> tuple[str, ...]:
    """Kinds of joints that a model describes."""
    return get_args(model.model_fields["kind"].annotation) if "kind" in model.model_fields else ()


def _kinds_phrase(info: FieldInfo | None) -> str:
    """Write the kinds of joints that a field may have."""
    found = {tag for model in _models_in_annotation(info and info.annotation) for tag in _kinds(model)}
    return "one of kind: " + ", ".join(kind for kind in JOINT_KINDS if kind in found)


def _tags(model: type[BaseModel]) -> tuple[str, ...]:
    """Names that pydantic gives the models of a union."""
    return {Body: ("body",), BodySequence: ("sequence",)}.get(model) or _kinds(model)


def _locate(loc: FieldPath, root: type[BaseModel]) -> _Location:
    path: FieldPath = ()
    fields: tuple[str, ...] = ()
    choices, info, is_mapping = [root], None, False
    for key in loc:
        if isinstance(key, int) or is_mapping or not choices:
            path, is_mapping = (*path, key), False
        elif len(choices) > 1:
            choices = [model for model in choices if key in _tags(model)] or choices[:1]
        else:
            path, info = (*path, key), _fields(choices[0]).get(key)
            if info is not None:
                fields, is_mapping = (*fields, key), get_origin(info.annotation) is dict
                inner = _models_in_annotation(info.annotation)
                choices = inner or choices
    while path and path[-1] == KEY_OF_MAPPING:
        path = path[:-1]
    return _Location(path, fields, choices[0], info)


def _models_in_annotation(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in_annotation(inner)]


@cache
def _places(root: type[BaseModel]) -> _Places:
    """Where each field may stand: by its name the fields that lead to it, and the model that has it."""
    found: _Places = {}

    def walk(model: type[BaseModel], fields: tuple[str, ...]) -> None:
        for name, info in _fields(model).items():
            found.setdefault(name, []).append((fields, model))
            for inner in _models_in_annotation(info.annotation):
                walk(inner, (*fields, name))

    walk(root, ())
    return found


def _unknown_field(name: str, at: _Location, root: type[BaseModel]) -> str:
    """Say where a field belongs that stands elsewhere, or which one may be meant."""
    own, elsewhere = list(_fields(at.model)), _places(root)
    if name in elsewhere:
        own_hint = "; " + did_you_mean(name, own) if closest_match(name, own, cutoff=0.75) else ""
        return f"`{name}` is a field of {_belongs(name, at, root)}{own_hint}"
    near = closest_match(name, [*own, *elsewhere])
    if near in own or not near:
        return did_you_mean(name, own)
    return f"did you mean {near!r}, a field of {_belongs(near, at, root)}?"


def _belongs(name: str, at: _Location, root: type[BaseModel]) -> str:
    """Write the nearest places of a field: inside of where it stands, else around it, else anywhere."""
    if inside := _places(at.model).get(name):
        return _places_phrase(inside, at.model, ())
    places = _places(root)[name]
    around = {model: (fields, model) for fields, model in places if fields == at.fields[: len(fields)]}
    if around:
        innermost_first = sorted(around.values(), key=lambda place: -len(place[0]))
        return _places_phrase(innermost_first, root, at.fields)
    return _places_phrase(places, root, ())


def _places_phrase(
    places: list[tuple[tuple[str, ...], type[BaseModel]]], root: type[BaseModel], here: tuple[str, ...]
) -> str:
    """Write places; of joints the kinds that have the field, where they are few or the place is right."""
    nearest = min(len(fields) for fields, _ in places)
    words = []
    for fields in dict.fromkeys(fields for fields, _ in places if here or len(fields) == nearest):
        kinds = [tag for where, model in places if where == fields for tag in _kinds(model)]
        every = [model for some in _places(root).values() for at, model in some if at == fields]
        of_all = {tag for model in every for tag in _kinds(model)}
        is_shown = len(kinds) < len(of_all) and (fields == here or len(kinds) == 1)
        shown = fields[-1:] if fields == here else fields
        words.append(f"`{'.'.join(shown)}:`" if fields else "the file's top level")
        words[-1] += f" of kind {', '.join(kinds)}" if is_shown else ""
    return " or ".join(words)


def _message_and_valid(error: ErrorDetails, at: _Location, root: type[BaseModel]) -> tuple[str, str]:
    """What is wrong and what would be valid, in words of this project for every type of error."""
    kind, given, context, info = error["type"], error.get("input"), error.get("ctx", {}), at.info
    match kind:
        case "plumbline":
            return str(context["message"]), str(context["valid"])
        case "missing":
            return "is missing", _field_description(info)
        case "extra_forbidden":
            words = _unknown_field(str(error["loc"][-1]), at, root)
            return "unknown field" + in_brackets(words), "one of " + ", ".join(_fields(at.model))
        case "literal_error" if error["loc"][-1:] == ("schema_version",):
            words = f"is {_quote(given)}; this version of Plumbline reads {SCHEMA_VERSION}"
            return words, str(SCHEMA_VERSION)
        case "literal_error":
            options = [str(o) for o in _literals(info.annotation if info else None)]
            hint = did_you_mean(str(given), options)
            return f"is {_quote(given)}" + in_brackets(hint), "one of " + ", ".join(options)
        case "union_tag_not_found":
            close = [k for k in given if did_you_mean(k, ["kind"])] if isinstance(given, dict) else []
            hint = f" ({_quote(close[0])} is not a field of it)" if close else ""
            return f"has no kind{hint}", _kinds_phrase(info)
        case "union_tag_invalid":
            return f"has the kind {_quote(context.get('tag'))}", _kinds_phrase(info)
        case "int_type" | "int_from_float" | "int_parsing" | "int_parsing_size":
            return f"is {_describe_value(given)}, not a whole number", "a whole number"
        case "bool_type" | "bool_parsing":
            return f"is {_describe_value(given)}, neither true nor false", "true or false"
        case "float_type" | "float_parsing":
            return _describe_non_number(given), _number_phrase(info)
        case "finite_number":
            return f"is {_quote(given)}, not a finite number", _number_phrase(info)
        case _ if kind in BOUNDS:
            bound = next((context[name] for name in ("gt", "ge", "lt", "le") if name in context), math.nan)
            return f"is {_quote(given)}", f"a number {BOUNDS[kind]} {bound:g}"
        case "model_type" | "model_attributes_type" | "dict_type" if not error["loc"]:
            return f"is {_describe_value(given)}", "a mapping that starts with schema_version: 1"
        case "model_type" | "model_attributes_type" if info is None:  # an item of a file that is a list
            return f"is {_describe_value(given)}", "a mapping with " + ", ".join(_fields(at.model))
        case "too_short" | "too_long":
            bound = context.get("min_length", context.get("max_length"))
            # pairs, vectors, quaternions, six, matrix
            fixed = isinstance(given, list) and bound in (2, 3, 4, 6)
            few = "exactly" if fixed else "at least" if kind == "too_short" else "at most"
            return f"has {context.get('actual_length')} entries", f"{few} {bound}"
        case "string_too_short" | "string_too_long":
            length = context.get("min_length", context.get("max_length"))
            few = "at least" if "min_length" in context else "at most"
            return f"has {len(str(given))} characters", f"{few} {length}"
        case "string_pattern_mismatch":
            return f"is {_quote(given)}", "intrinsic or extrinsic and three axes, as 'intrinsic zxz'"
        case _:  # list_type, model_type, string_type, …: pydantic's own words never reach a user
            return f"is {_describe_value(given)}", _field_description(info, kind)


def _literals(annotation: Any) -> Iterator[Any]:
    """The values of all Literal parts of an annotation."""
    for part in get_args(annotation):
        inner = list(_literals(part))
        yield from inner or ([part] if isinstance(part, str | int) else [])


def _quote(given: Any) -> str:
    return shorten(repr(given))


def _describe_non_number(given: Any) -> str:
    if not isinstance(given, str) or len(given) > MAX_NUMBER_LENGTH:
        return f"is {_describe_value(given)}, not a number"
    if re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", given):
        return f"is the text {_quote(given)}, not a number: leave out the quotes"
    if re.fullmatch(r"[-+]?\d+,\d+", given):
        return f"is the text {_quote(given)}: write {given.replace(',', '.')}, with a point"
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
    shapes = {"list_type": "a list: ", "string_type": "text: "}
    shape = shapes.get(kind, "a mapping: " if "model" in kind else "")
    return shape + sentence[:1].lower() + sentence[1:] + _unit_suffix(info)
