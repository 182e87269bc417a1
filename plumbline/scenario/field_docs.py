"""Write docs/scenario-files.md from the schema: python -m plumbline.scenario.field_docs."""

from __future__ import annotations

from typing import Any

from plumbline.scenario.loader import json_schema
from plumbline.scenario.schema import SCHEMA_VERSION

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
INTRODUCTION = f"""\
# Scenario files

`python -m plumbline.scenario.field_docs` writes this page from the schema that reads the files.
[Add a scenario](add-a-scenario.md) is a worked example.

A scenario file is YAML 1.2 (UTF-8, no tabs for indentation) of schema version {SCHEMA_VERSION}.
It describes rigid bodies on joints (a chain, a tree, loops), their state at t = 0 and their loads. Everything
is in SI units; angles are in rad unless the field is called `degrees`; the world's z axis points up; a body's
frame has its origin at the centre of mass. Write numbers without a unit. Unknown fields are errors.

`python -m plumbline check FILE…` reports every mistake of every file with line and column;
`python -m plumbline schema` prints the JSON Schema for editors.

The initial state is given by attitudes, rod directions, joint coordinates and rates; positions and velocities
follow, so every state satisfies the joints. Quaternions and directions are normalised; the part of a rod's
rate along the rod that rounding left is removed.

A body hangs from the one before it unless it names another `parent`. This tree has an arm that turns about
the world's vertical, and on it a pendulum on a hinge with a damper and a rotor, and a slider with a spring of
its own and one to the pendulum. Trees are compared at every level but that of steps; with rotors, springs,
dampers or efforts a run compares states only:

```yaml
schema_version: 1
title: An arm with a pendulum and a slider
purpose: Two bodies that hang from one, on joints with axes.
bodies:
  - name: arm
    mass: 0.5
    inertia: {{principal: [0.001, 0.01, 0.01]}}
    joint: {{kind: hinge, axis: [0, 0, 1], rates: [2.0]}}
    proximal: [-0.2, 0, 0]
    distal: [0.2, 0, 0]
  - name: pendulum
    mass: 0.2
    inertia: {{principal: [0.002, 0.002, 0.0001]}}
    joint: {{kind: hinge, axis: [1, 0, 0], coordinates: [0.5], damping: 0.01, armature: 0.0005}}
    proximal: [0, 0, 0.15]
  - name: slider
    parent: arm
    anchor: [0.05, 0, 0]
    mass: 0.1
    inertia: {{principal: [0.0001, 0.0001, 0.0001]}}
    joint: {{kind: slide, axis: [1, 0, 0], coordinates: [0.02], stiffness: 20, rest: 0.01}}
    proximal: [0, 0, 0]
springs:
  - bodies: [pendulum, slider]
    points: [[0, 0, -0.1], [0, 0, 0]]
    stiffness: 5
    length: 0.2
```

Joints beyond those of the tree close loops. This is a slider-crank: a crank on the world, a rod of 0.3 m on
its end, and a slider that moves along x and on which the rod's other end is held. Of the rates only the
crank's is given, the others follow. States, single steps, motions, long runs and relations of loops are
compared; a motion or long run that comes to a singular pose is compared up to it, and `plumbline check`
names the joints that the loops keep from moving, and says where every pose is singular, so that nothing can
be compared:

```yaml
schema_version: 1
title: A slider-crank
purpose: One loop of three hinges and a slide in a plane, with rows that depend on others.
bodies:
  - name: crank
    mass: 0.4
    inertia: {{principal: [0.0002, 0.002, 0.002]}}
    joint: {{kind: hinge, axis: [0, 1, 0], coordinates: [0], rates: [3.0]}}
    proximal: [-0.05, 0, 0]
    distal: [0.05, 0, 0]
  - name: rod
    mass: 0.5
    inertia: {{principal: [0.0003, 0.004, 0.004]}}
    joint: {{kind: hinge, axis: [0, 1, 0]}}
    proximal: [-0.15, 0, 0]
  - name: slider
    parent: world
    mass: 0.3
    inertia: {{principal: [0.0001, 0.0001, 0.0001]}}
    joint: {{kind: slide, axis: [1, 0, 0], coordinates: [0.4]}}
    proximal: [0, 0, 0]
closes:
  - body: slider
    parent: rod
    anchor: [0.15, 0, 0]
    proximal: [0, 0, 0]
    joint: {{kind: hinge, axis: [0, 1, 0]}}
```
"""


def field_reference() -> str:
    """Write the page.

    Returns:
        The text of docs/scenario-files.md, Markdown.

    """
    whole = json_schema()
    parts = {"Document": whole, **whole["$defs"]}
    return "\n".join(
        [INTRODUCTION, *(_render_section(parts[name], heading) for name, heading in SECTION_HEADINGS.items())]
    )


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
    print(field_reference(), end="")
