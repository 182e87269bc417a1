"""A mechanism at a state as the content of a scenario file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, Model, State

Content = dict[str, Any]  # of a scenario file or of a part of it: plain data


def scenario_text(document: Content) -> str:
    """Write the content of a scenario file.

    Args:
        document: plain data.

    Returns:
        YAML: a line for each value, and for each vector.

    """
    return "\n".join(_lines(document, "")) + "\n"


def _lines(value: Any, indent: str) -> Iterator[str]:
    """The lines of a mapping or of a list of mappings; other values in their JSON form, which is YAML too."""
    if isinstance(value, list):
        for item in value:
            first, *others = _lines(item, indent + "  ")
            yield f"{indent}- {first.strip()}"
            yield from others
        return
    for key, item in value.items():
        if isinstance(item, dict) or (isinstance(item, list) and item and isinstance(item[0], dict)):
            yield f"{indent}{key}:"
            yield from _lines(item, indent + "  ")
        elif item is not None:
            yield f"{indent}{key}: {json.dumps(item, ensure_ascii=False)}"


def mechanism_document(model: Model, state: State) -> Content:
    """Describe a mechanism at a state as a scenario file does.

    The axes of ball joints are not part of a file; their springs are unloaded where both bodies' axes agree.

    Args:
        model: the mechanism; its loops are closed at the state.

    Returns:
        The fields ``gravity``, ``bodies``, ``springs`` and ``closes``: plain data.

    """
    found: Content = {
        "gravity": model.gravity.tolist(),
        "bodies": [_body(model, state, k) for k in range(model.n)],
    }
    if len(model.spring_body):
        found["springs"] = [
            {
                "bodies": [_name(int(body)) for body in model.spring_body[i]],
                "points": model.spring_point[i].tolist(),
                "stiffness": float(model.spring_stiffness[i]),
                "damping": float(model.spring_damping[i]),
                "length": float(model.spring_length[i]),
            }
            for i in range(len(model.spring_body))
        ]
    if model.has_loops:
        found["closes"] = [
            {
                "body": _name(int(model.body[k, 1])),
                "parent": _name(int(model.body[k, 0])),
                "joint": _joint(model, k),
                "anchor": model.point[k, 0].tolist(),
                "proximal": model.point[k, 1].tolist(),
            }
            for k in range(model.n, len(model.kind))
        ]
    return found


def _name(body: int) -> str:
    return "world" if body < 0 else f"body {body + 1}"


def _body(model: Model, state: State, k: int) -> Content:
    kind, joint = model.kinds[k], _joint(model, k)
    found: Content = {
        "name": _name(k),
        "mass": float(model.mass[k]),
        "inertia": {"matrix": model.inertia[k].tolist()},
        "joint": joint,
        "proximal": model.point[k, 1].tolist(),
    }
    if kind.holds_nothing:
        joint |= {"position": (state.r[k]).tolist(), "velocity": state.v[k].tolist()}
    else:
        found |= {"parent": _name(int(model.body[k, 0])), "anchor": model.point[k, 0].tolist()}
    if kind.holds_distance:
        spin = np.cross(state.u[k], state.udot[k])
        joint |= {"direction": state.u[k].tolist(), "angular_velocity": spin.tolist()}
    if kind.has_attitude:
        found["attitude"] = {"quaternion": state.p[k].tolist()}
        found["angular_velocity"] = state.omega[k].tolist()
    elif kind.motions:
        count = len(kind.motions)
        joint |= {"coordinates": state.x[k, :count].tolist(), "rates": state.xdot[k, :count].tolist()}
    if np.any(model.force[k]) or np.any(model.moment[k]):
        found["load"] = {"force": model.force[k].tolist(), "moment": model.moment[k].tolist()}
    if model.drag_force[k] or model.drag_moment[k]:
        found["drag"] = {"force": float(model.drag_force[k]), "moment": float(model.drag_moment[k])}
    return found


def _joint(model: Model, k: int) -> Content:
    """The joint without what depends on the state."""
    kind = model.kinds[k]
    found: Content = {"kind": model.kind[k]}
    if kind.own_number:
        found[kind.own_number] = float(model.length[k])
    if not kind.has_attitude:
        frames = ({"quaternion": turn.tolist()} for turn in model.turn[k])
        found |= zip(("frame", "body_frame"), frames, strict=True)
    for name in JOINT_ELEMENTS:
        values = getattr(model, name)[k, : kind.element_count]
        if np.any(values):
            found[name] = values.tolist()
    if "stiffness" not in found:
        found.pop("rest", None)
    return found
