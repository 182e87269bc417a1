"""Write the tables of docs/scenario-files.md from the schema: python -m plumbline.scenario.field_docs."""

from __future__ import annotations

from typing import Any

from plumbline.layout import ROOT, generated_page
from plumbline.scenario.loader import json_schema

PAGE = "scenario-files.md"

SECTION_HEADINGS = {  # in the page's order
    "Document": "The file",
    "Body": "`bodies[]`: a body",
    "BodySequence": "`bodies[]`: repeated bodies",
    "Ball": "`joint`, kind ball",
    "Rod": "`joint`, kind rod",
    "Articulated": "`joint`, with axes",
    "Free": "`joint`, kind free",
    "Attitude": "`attitude`",
    "AxisAngle": "`axis_angle`, `turn`",
    "Euler": "`euler`",
    "Inertia": "`inertia`",
    "Load": "`load`",
    "Drag": "`drag`",
    "Spring": "`springs[]`: a spring between two points",
    "ClosingJoint": "`closes[]`: a joint that closes a loop",
    "ClosingRod": "`closes[].joint`, kind rod",
}
BOUND_FORMATS = {
    "exclusiveMinimum": "> {}",
    "minimum": "≥ {}",
    "maximum": "≤ {}",
    "maxLength": "≤ {} characters",
}


def field_reference() -> str:
    """Return the page with tables of all fields."""
    whole = json_schema()
    parts = {"Document": whole, **whole["$defs"]}
    tables = (_render_section(parts[name], heading) for name, heading in SECTION_HEADINGS.items())
    return generated_page(PAGE, "\n".join(tables))


def _render_section(part: dict[str, Any], heading: str) -> str:
    """Write one part of the file: what it is, and its fields."""
    lines = [f"## {heading}", "", part["description"], ""]
    lines += ["| field | type | unit | default | meaning |", "|---|---|---|---|---|"]
    for name, field in part["properties"].items():
        default = "required" if name in part.get("required", ()) else _format_default(field.get("default"))
        meaning = field["description"] + "".join(f" Example: `{e}`." for e in field.get("examples", ()))
        cells = (f"`{name}`", _field_type(field), field.get("unit", ""), default, meaning)
        lines.append(("| " + " | ".join(cells) + " |").replace("|  |", "| |"))
    return "\n".join([*lines, ""])


def _format_default(default: Any) -> str:
    """Write a default as a user would type it; a dash where the field may be absent."""
    return "–" if default is None else f"`{default}`"


def _field_type(field: dict[str, Any]) -> str:
    """Write the type of a field with its bounds."""
    bounds = [text.format(field[name]) for name, text in BOUND_FORMATS.items() if name in field]
    return ", ".join([_base_type(field), *bounds])


def _base_type(field: dict[str, Any]) -> str:
    """Write the type of a field without its bounds."""
    if alternatives := field.get("anyOf") or field.get("oneOf"):
        return " or ".join(_field_type(option) for option in alternatives if option.get("type") != "null")
    if "$ref" in field:
        name = str(field["$ref"]).rpartition("/")[2]
        return {"AxisAngle": "axis_angle", "BodySequence": "repeated bodies"}.get(name, name.lower())
    if options := field.get("enum") or ([field["const"]] if "const" in field else []):
        return ", ".join(f"`{option}`" for option in options)
    if field["type"] == "array":
        if field.get("minItems", 0) == field.get("maxItems"):
            inner = _field_type(field["items"])
            return f"{field['minItems']} " + (f"× {inner}" if inner[0].isdigit() else f"{inner}s")
        return f"list of {_field_type(field['items'])}"
    return {"integer": "whole number", "string": "text"}.get(field["type"], str(field["type"]))


if __name__ == "__main__":
    (ROOT / "docs" / PAGE).write_text(field_reference(), encoding="utf-8")
