"""The text of a stand-alone script: the literals of a shrunk case in the Jinja2 template of the engine.

`templates/script.py.j2` is the frame; the template that an adapter names as its `reproduction_template`
extends it with the engine's calls, and `state`, `relation` and `motion` follow with what is expected and
compared. Floats are written by repr, so that the script gets the same bits.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from packaging.version import InvalidVersion, Version

from plumbline.engines.declared_names import declared_texts
from plumbline.engines.environments import declared_attribute
from plumbline.engines.registry import ENGINES
from plumbline.measurements.order_and_limit import ORDER_MARGIN
from plumbline.measurements.relation_result import OPTION_PREFIX, OTHER_FORMULATIONS
from plumbline.measurements.state_relations import WELDED_HALVES
from plumbline.model.datatypes import Array, Model, Unsupported
from plumbline.model.invariants import LONG_RUN_QUANTITIES
from plumbline.model.kinematics import rotation_matrix
from plumbline.reproduce.measure import (
    TRANSFORMS,
    Evidence,
    MotionEvidence,
    StateEvidence,
    StepEvidence,
    SurfaceEvidence,
)
from plumbline.reproduce.surface_source import given
from plumbline.truth.step_comparison import CONSTRAINED_QUANTITIES, RUN_QUANTITIES

TEMPLATES = Path(__file__).parent / "templates"
LINE = 100  # characters
FIELD_COMMENTS = {  # of the literals, in the order of the script
    "mass": "kg",
    "inertia": "kg m², about the centre of mass, body frame",
    "gravity": "m/s²",
    "force": "N, at the centre of mass, world frame",
    "moment": "N m, body frame",
    "drag_force": "N s/m",
    "drag_moment": "N m s",
    "link_force": "N, at the centres of mass of the engine's bodies, world frame",
    "link_moment": "N m, body frame",
    "link_drag_force": "N s/m",
    "link_drag_moment": "N m s",
    "link_proximal": "m, body frame: where the bodies hang",
    "proximal": "m, body frame, from the centre of mass: where the body hangs",
    "p": "attitudes",
    "omega": "rad/s, angular velocity, body frame",
    "r": "m, centres of mass, world frame",
    "A": "attitudes as rotation matrices, body to world",
    "q": "coordinates of the engine's joints",
    "v": "their rates",
    "torque": "N m or N, on them",
    "effort": "N m or N, on them",
    "damping": "N m s or N s/m",
    "stiffness": "N m or N/m",
    "rest": "rad or m, of the coordinates with a spring",
    "of_q": "which they are",
    "of_v": "and their rates",
    "joint_rates": "rates of the engine's coordinates at unit rates of the mechanism's",
    "bodies": "which of the engine's bodies, for each of the mechanism's",
    "joints": "which of the engine's joints",
    "tied": "joints that are tendons of constant length",
    "along": "their directions, world frame",
    "elastic": "J, energy of springs",
    "unique": "projectors: the part of each joint's force and moment / arm that is unique",
    "arm": "m",
    "link": "MuJoCo's numbers of the bodies",
    "scales": "of MuJoCo's own regularisation",
    "qdot": "m/s and 1/s, rates of positions and quaternions",
    "near": "the body that hangs by each joint",
    "used": "rows of constraints that do not depend on others",
    "rates": "of the engine's coordinates",
    "frames": "rotations, engine's link to body",
}


def render_script(row: dict[str, Any], evidence: Evidence, system: dict[str, Any]) -> str:
    """Render the script that shows a disagreement.

    Args:
        row: the stored row; its texts are written as escaped comments, whatever characters they hold.
        evidence: the shrunk case, with what is expected there.
        system: what the engine holds of the mechanism, by `Evidence.written`.

    Raises:
        Unsupported: the script cannot show what is in dispute; the message is the reason.

    """
    missing = system.get("missing", {})
    shown = {q: x for q, x in evidence.expected.items() if q not in missing}
    if evidence.expected and not shown:
        raise Unsupported(missing[next(iter(evidence.expected))])
    evidence = replace(evidence, expected=shown)
    try:
        version = Version(str(row["engine_version"]))
    except InvalidVersion:
        version = Version("9999")
    model, state, shows = evidence.case.model, evidence.case.state, _KINDS[type(evidence)]
    if isinstance(evidence, MotionEvidence):
        _check_drifts(model, evidence.drifts)
    context = {
        "system": system,
        "comments": FIELD_COMMENTS,
        "fields": {**vars(model), "r": state.r, "p": state.p, **system.get("fields", {})},
        "row": row,
        "evidence": evidence,
        "shows": shows,  # the template of what is compared
        "evaluates": shows == "state",  # how the engine is called; else it runs
        "joints": list(_joint_literals(model)),
        "loads": model.has_loads or model.has_drag,
        "powered": model.has_drag or bool(np.any(model.moment)),
        "mass_matrix": "mass_matrix" in evidence.bound,
        "steps": list(evidence.case.steps),
        "integrator": getattr(evidence, "integrator", None),
        "margin": ORDER_MARGIN,
        "older": lambda than: version < Version(than),
    }
    if isinstance(evidence, SurfaceEvidence):
        source = system["source"]
        context["source"] = source
        context["given"] = [("model", source.model, given(model)), ("state", source.state, given(state))]
        return template_environment().get_template("surface.py.j2").render(context)
    return _space_functions(_template(evidence.engine).render(context))


def _check_drifts(model: Model, drifts: Sequence[str]) -> None:
    """Raise Unsupported for drifts that the scripts do not measure."""
    if "energy_drift" in drifts and model.has_elements:
        raise Unsupported("scripts do not measure the energy of rotors, springs, dampers and efforts")
    if {"joint_gap", "gap_rate"} & {*drifts} and any(kind.has_pitch for kind in model.kinds):
        raise Unsupported("scripts do not measure gaps of joints with a pitch")


def _joint_literals(model: Model) -> Iterator[tuple[list[int], Any, Any, float]]:
    """Yield of each joint its bodies, the points in them, axes of slides in the first, length of a rod."""
    for k, kind in enumerate(model.kinds):
        free = range(3) if kind.holds_nothing else kind.slide_axes
        slides = rotation_matrix(model.turn[k, 0]).T[list(free)]
        length = float(model.length[k]) if kind.holds_distance else 0.0
        yield model.body[k].tolist(), model.point[k].tolist(), slides.tolist(), length


def no_script_reason(engine: str, row: dict[str, Any]) -> str:
    """Explain why a row has no script.

    Args:
        engine: registered name of the engine, without a version.

    Returns:
        A sentence, or an empty string where the row has a script.

    """
    relation = row["quantity"]
    other = OTHER_FORMULATIONS.get(relation)
    if engine not in ENGINES:
        return f"engine {engine} is not registered here: a script would need its adapter"
    for name in (engine, other or engine):
        if not declared_attribute(name, "reproduction_template"):
            return f"engine {name} has no template of scripts"
    if row["level"] == "step" and row["quantity"] in CONSTRAINED_QUANTITIES:
        return "rows of single steps with constraints have no script"
    if row["level"] == "step" and row["quantity"] in RUN_QUANTITIES:
        return "rows on every step of a run have no script: what single steps show has one"
    if relation in LONG_RUN_QUANTITIES:
        return "rows of long runs have no script"
    if row["level"] != "relations":
        return ""
    if row["integrator"] != "-":
        return "relations of runs have no script"
    if relation in TRANSFORMS or other:
        return ""
    unwritten = declared_attribute(engine, "unwritten_ways") or ()
    ways = {OPTION_PREFIX + text for text in declared_texts()} | {WELDED_HALVES}
    is_known = relation in ways and relation.removeprefix(OPTION_PREFIX) not in unwritten
    return "" if is_known else f"scripts of {engine} cannot show {relation!r}"


_KINDS: dict[type, str] = {
    StateEvidence: "state", MotionEvidence: "motion", StepEvidence: "step", SurfaceEvidence: "surface",
}  # fmt: skip


def _template(engine: str) -> Template:
    """The template that the engine's adapter names."""
    name = f"{declared_attribute(engine, 'reproduction_template')}.py.j2"
    return template_environment().get_template(name)


@cache
def template_environment() -> Environment:
    """Return the templates of all scripts, of mechanisms and of model files."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )  # no escaping of HTML: the result is Python, and every text in it passes `ascii`
    environment.filters |= {
        "ascii": ascii,
        "comment": _comment,
        "wrap": partial(textwrap.fill, width=LINE, break_long_words=False, break_on_hyphens=False),
        "namespace": _namespace,
        "literal": lambda value: _literal(np.asarray(value)),
        "table": _table,
    }
    return environment


def _comment(text: str) -> str:
    """Wrap text as a comment."""
    return textwrap.fill(" ".join(text.split()), LINE, initial_indent="# ", subsequent_indent="# ")


def _space_functions(code: str) -> str:
    """Put two blank lines around top-level functions, and at most one elsewhere."""
    lines: list[str] = []
    in_function = False
    for line in re.sub(r"\n{3,}", "\n\n", code.strip() + "\n").splitlines():
        starts = line.startswith("def ")
        if starts or (in_function and line and line[0] not in " )]}"):
            while lines[-1] == "":
                lines.pop()
            lines += ["", ""]
            in_function = starts
        lines.append(line)
    return "\n".join(lines) + "\n"


def _namespace(values: dict[str, Array], name: str, code: str, comments: dict[str, str]) -> str:
    """Write the fields that the code uses."""
    used = [f for f in {**comments, **values} if f in values and re.search(rf"\bc\.{f}\b", code)]
    lines = []
    for f in used:
        before, after = f"    {f}=np.array(", "),  # " + comments[f] if f in comments else "),"
        lines.append(before + _literal(np.asarray(values[f]), "    ", LINE - len(before + after)) + after)
    return "\n".join([f"{name} = SimpleNamespace(", *lines, ")"])


def _table(values: dict[str, Array], name: str) -> str:
    """Write a dictionary of arrays."""
    lines = [f'    "{q}": {_literal(np.asarray(x), "    ")},' for q, x in values.items()]
    return "\n".join([f"{name} = {{", *lines, "}"])


def _literal(value: Array, indent: str = "", room: int = LINE - 20) -> str:
    """Write a list, equal rows once, by repr; on one line if it fits into so many characters."""
    if value.ndim and len(value) > 1 and np.all(value == value[0]):
        return f"[{_literal(value[0], indent, room)}] * {len(value)}"
    text = repr(value.tolist())
    if not value.ndim or len(text) <= room:
        return text
    inner = indent + "    "
    if value.ndim == 1:
        rows = [", ".join(map(repr, value[i : i + 4].tolist())) for i in range(0, len(value), 4)]
    else:
        rows = [_literal(row, inner) for row in value]
    return "[\n" + "".join(f"{inner}{row},\n" for row in rows) + f"{indent}]"
