"""Validation errors in the project's words: the user's field, its position, and what would be valid."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from plumbline.scenario.errors import Problem, closest, nearest
from plumbline.scenario.schema import SCHEMA_VERSION, Ball, Body, Document, Rod, Run
from plumbline.scenario.yaml_source import Key, Source, dotted

TAGS: dict[str, type[BaseModel]] = {"ball": Ball, "rod": Rod, "body": Body, "run": Run}


def translate(source: Source, errors: Iterable[ErrorDetails]) -> list[Problem]:
    """One Problem for each of pydantic's errors; a field that is only misspelt is not missing besides."""
    resolved = [(error, *_resolve(source, error["loc"])[:2]) for error in errors]
    meant = {
        (*path[:-1], closest(str(path[-1]), list(model.model_fields)))
        for error, path, model in resolved
        if error["type"] == "extra_forbidden"
    }
    return [_problem(source, e) for e, path, _ in resolved if e["type"] != "missing" or path not in meant]


def _problem(source: Source, error: ErrorDetails) -> Problem:
    path, model, info = _resolve(source, error["loc"])
    extra = error["type"] == "extra_forbidden"
    place = source.keys.get(path) if extra else source.values.get(path)
    place = place or source.values.get(path[:-1]) or (1, 1)
    message, valid = _words(error, model, info)
    return Problem(source.file, *place, dotted(path), message, valid)


def _resolve(
    source: Source, loc: tuple[Key, ...]
) -> tuple[tuple[Key, ...], type[BaseModel], FieldInfo | None]:
    """The path in the file, the model it lies in and the field; union tags are no part of it."""
    path: tuple[Key, ...] = ()
    model: type[BaseModel] = Document
    info: FieldInfo | None = None
    for key in loc:
        if isinstance(key, str) and key in TAGS and (*path, key) not in source.values:
            model = TAGS[key]
            continue
        path = (*path, key)
        if isinstance(key, str):
            info = model.model_fields.get(key)
            for inner in _models(info.annotation if info else None):
                if inner not in TAGS.values() or inner is Body:
                    model = inner
    return path, model, info


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models(inner)]


def _words(error: ErrorDetails, model: type[BaseModel], info: FieldInfo | None) -> tuple[str, str]:
    """What is wrong and what would be valid."""
    kind, given, context = error["type"], error.get("input"), error.get("ctx", {})
    name = str(error["loc"][-1]) if error["loc"] else ""
    match kind:
        case "plumbline":
            return str(context["message"]), str(context["valid"])
        case "missing":
            return "is missing", _described(info)
        case "extra_forbidden":
            fields = list(model.model_fields)
            return f"unknown field. {nearest(name, fields)}".strip(" ."), "one of " + ", ".join(fields)
        case "literal_error" if name == "schema_version":
            return f"is {given!r}; this version of Plumbline reads {SCHEMA_VERSION}", str(SCHEMA_VERSION)
        case "literal_error":
            options = (
                [o for arg in get_args(info.annotation) for o in (get_args(arg) or (arg,))] if info else []
            )
            words = [str(o) for o in options if isinstance(o, str)]
            return f"is {given!r}. {nearest(str(given), words)}".strip(" ."), str(context.get("expected"))
        case "union_tag_not_found":
            close = [k for k in given if nearest(k, ["kind"])] if isinstance(given, dict) else []
            hint = f" ({close[0]!r} is not a field of it)" if close else ""
            return f"has no kind{hint}", "kind: ball or kind: rod"
        case "union_tag_invalid":
            return f"has the kind {context.get('tag')!r}", "kind: ball or kind: rod"
        case "int_type" | "int_from_float":
            return f"is {_what(given)}, not a whole number", "a whole number"
        case "float_type":
            return _not_a_number(given), _number(info)
        case "finite_number":
            return f"is {given!r}, not a finite number", _number(info)
        case "greater_than" | "greater_than_equal" | "less_than_equal":
            sign = {"greater_than": "above", "greater_than_equal": "at least", "less_than_equal": "at most"}[
                kind
            ]
            bound = context.get("gt", context.get("ge", context.get("le")))
            return f"is {given!r}", f"a number {sign} {bound:g}"
        case "model_type" | "model_attributes_type" | "dict_type" if not error["loc"]:
            return f"is {_what(given)}", "a mapping that starts with schema_version: 1"
        case "list_type" | "model_type" | "model_attributes_type" | "dict_type" | "string_type":
            return f"is {_what(given)}", _described(info, kind)
        case "too_short" | "too_long":
            bound = context.get("min_length", context.get("max_length"))
            fixed = isinstance(given, list) and bound in (3, 4, 6)  # vectors, quaternions, six, matrix
            few = "exactly" if fixed else "at least" if kind == "too_short" else "at most"
            return f"has {context.get('actual_length')} entries", f"{few} {bound}"
        case "string_too_short" | "string_too_long":
            length = context.get("min_length", context.get("max_length"))
            return (
                f"has {len(str(given))} characters",
                f"{'at least' if 'min_length' in context else 'at most'} {length}",
            )
        case "string_pattern_mismatch":
            return f"is {given!r}", "intrinsic or extrinsic and three axes, as 'intrinsic zxz'"
        case _:
            return error["msg"], _described(info)


def _not_a_number(given: Any) -> str:
    if isinstance(given, str) and re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", given):
        return f"is the text {given!r}, not a number: leave out the quotes"
    if isinstance(given, str) and (match := re.fullmatch(r"\s*([-+.\deE]*\d)\s*([^\d\s].*)", given)):
        return f"is the text {given!r}: write the number alone, {match[1]}, without {match[2]!r}"
    return f"is {_what(given)}, not a number"


def _what(given: Any) -> str:
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
            return f"the text {given[:40]!r}"
        case _:
            return f"the number {given!r}"


def _unit(info: FieldInfo | None) -> str:
    extra = info.json_schema_extra if info and isinstance(info.json_schema_extra, dict) else {}
    return f" in {extra['unit']}" if "unit" in extra else ""


def _number(info: FieldInfo | None) -> str:
    return f"a number{_unit(info)}"


def _described(info: FieldInfo | None, kind: str = "") -> str:
    """The first sentence of the field's description, with its unit."""
    if info is None:
        return ""
    sentence = (info.description or "").partition(". ")[0].rstrip(".")
    shape = {"list_type": "a list: ", "string_type": "text: "}.get(
        kind, "a mapping: " if "model" in kind else ""
    )
    return shape + sentence[:1].lower() + sentence[1:] + _unit(info)
