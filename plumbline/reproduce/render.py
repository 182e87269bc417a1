"""The text of a stand-alone script: the literals of a shrunk case in the Jinja2 template of the engine.

`templates/script.py.j2` is the frame; the template that an adapter names as its `reproduction_template`
extends it with the engine's calls, and `state`, `relation` and `motion` follow with what is expected and
compared. Floats are written by repr, so that the script gets the same bits.
"""

from __future__ import annotations

import re
import textwrap
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from packaging.version import InvalidVersion, Version

from plumbline.engines.declared_names import declared_texts
from plumbline.engines.environments import declared_attribute
from plumbline.measurements.order_and_limit import ORDER_MARGIN
from plumbline.measurements.relation_result import OPTION_PREFIX, OTHER_FORMULATIONS
from plumbline.measurements.state_relations import WELDED_HALVES
from plumbline.model.datatypes import Array, Model, State, Unsupported
from plumbline.model.invariants import LONG_RUN_QUANTITIES
from plumbline.model.kinematics import (
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    rotation_matrix,
    turn_of_z,
    velocity_jacobian,
)
from plumbline.model.welding import split_bodies
from plumbline.reproduce.measure import (
    TRANSFORMS,
    Evidence,
    MotionEvidence,
    StateEvidence,
    StepEvidence,
)
from plumbline.truth.step_comparison import CONSTRAINED_QUANTITIES, RUN_QUANTITIES

TEMPLATES = Path(__file__).parent / "templates"
LINE = 100  # characters
FIELD_COMMENTS = {  # of a chain's literals, in the order of the script
    "mass": "kg",
    "inertia": "kg m², about the centre of mass, body frame",
    "proximal": "m, body frame, from the centre of mass: where the body hangs",
    "distal": "m, body frame: where the next body hangs",
    "length": "m, of the rod above each body; 0 for a ball joint",
    "gravity": "m/s²",
    "force": "N, at the centre of mass, world frame",
    "moment": "N m, body frame",
    "drag_force": "N s/m",
    "drag_moment": "N m s",
    "p": "attitudes",
    "omega": "rad/s, angular velocity, body frame",
    "u": "direction of the rods, world frame",
    "udot": "1/s, their rate",
    "r": "m, centres of mass, world frame",
    "v": "m/s, their velocities",
    "A": "attitudes as rotation matrices, body to world",
    "pdot": "1/s, rate of the attitudes",
    "q": "rotation of every rod and body against the one before it",
    "w": "rad/s, its angular velocity, own frame",
    "joint_rates": "w of unit rates: of the rods' directions, then of the bodies",
    "local_rates": "velocity and angular velocity of the bodies in their frames, of unit rates",
    "euler_rates": "v and pdot of unit rates",
    "unit_udot": "unit rates: of the rods' directions",
    "unit_omega": "and of the bodies",
}

SYSTEM_COMMENTS = FIELD_COMMENTS | {  # of what an engine holds, where it is not a chain's literal
    "q": "coordinates of the engine's joints",
    "v": "their rates",
    "torque": "N m or N, on them",
    "loads": "N and N m, force and moment on each of the engine's joints, in its frame",
    "joint_rates": "rates of the engine's coordinates at unit rates of the mechanism's",
    "bodies": "which of the engine's bodies, for each of the mechanism's",
    "joints": "which of the engine's joints",
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


def render_script(row: dict[str, Any], evidence: Evidence, system: dict[str, Any] | None = None) -> str:
    """Render the script that shows a disagreement.

    Args:
        system: what the engine holds of the mechanism at the state, by `Adapter.written`; None where the
            script builds a chain of rods and balls itself.
        row: the stored row; its texts are written as escaped comments, whatever characters they hold.
        evidence: the shrunk case, with what is expected there.

    Raises:
        Unsupported: the script cannot show what is in dispute; the message is the reason.

    """
    missing = system.get("missing", {}) if system else {}
    shown = {q: x for q, x in evidence.expected.items() if q not in missing}
    if evidence.expected and not shown:
        raise Unsupported(missing[next(iter(evidence.expected))])
    evidence = replace(evidence, expected=shown)
    try:
        version = Version(str(row["engine_version"]))
    except InvalidVersion:
        version = Version("9999")
    model, shows, variant = evidence.case.model, _KINDS[type(evidence)], getattr(evidence, "variant", "")
    derived = {} if system else vars(evidence.case.state) | _derived_fields(model, evidence.case.state)
    context = {
        "system": system,
        "comments": SYSTEM_COMMENTS if system else FIELD_COMMENTS,
        "fields": system["fields"] if system else {**vars(model), **derived},
        "row": row,
        "evidence": evidence,
        "shows": shows,  # the template of what is compared
        "evaluates": shows == "state",  # how the engine is called; else it runs
        "engine": evidence.engine,
        "welded": variant == WELDED_HALVES,
        "option": {OPTION_PREFIX + text: text for text in declared_texts()}.get(variant, ""),
        "ties": variant == f"{OPTION_PREFIX}tendon equalities",
        "rods": bool(np.any(model.rods)),
        "loads": model.has_loads or model.has_drag,
        "powered": model.has_drag or bool(np.any(model.moment)),
        "mass_matrix": "mass_matrix" in evidence.bound,
        "steps": list(evidence.case.steps),
        "integrator": getattr(evidence, "integrator", None),
        "margin": ORDER_MARGIN,
        "older": lambda than: version < Version(than),
    }
    return _space_functions(_template(evidence.engine, "-system" if system else "").render(context))


def no_script_reason(engine: str, row: dict[str, Any]) -> str:
    """Explain why a row has no script.

    Args:
        engine: registered name of the engine, without a version.

    Returns:
        A sentence, or an empty string where the row has a script.

    """
    relation = row["quantity"]
    other = OTHER_FORMULATIONS.get(relation)
    for name in (engine, other or engine):
        if not declared_attribute(name, "reproduction_template"):
            return f"engine {name} has no template of scripts"
    if row["level"] == "surface":
        return "rows of the surface have no script: their reason names the call that is wrong"
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
    is_known = ("welded" if relation == WELDED_HALVES else "option") in _template(engine).blocks
    return "" if is_known else f"scripts of {engine} cannot show {relation!r}"


def is_at_state(row: dict[str, Any]) -> bool:
    """Whether a row compares the usual answers of an engine at a state."""
    return row["level"] == "state" or row["quantity"] in {*TRANSFORMS, *OTHER_FORMULATIONS}


_KINDS: dict[type, str] = {StateEvidence: "state", MotionEvidence: "motion", StepEvidence: "step"}


def _template(engine: str, of: str = "") -> Template:
    """The template that the engine's adapter names."""
    name = f"{declared_attribute(engine, 'reproduction_template')}{of}.py.j2"
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
        "halves": _halves,
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


def _halves(model: Model) -> str:
    """Write the two parts of every body: mass, centre of mass from the body's, inertia about its own."""
    lines = ["c.pieces = ["]
    for parts in split_bodies(model):
        each = ((f"{part.mass!r}", _literal(part.centre), _literal(part.inertia, "    ")) for part in parts)
        lines += [
            "    [",
            *(f"    ({mass}, {centre}, {inertia})," for mass, centre, inertia in each),
            "    ],",
        ]
    return "\n".join([*lines, "]"])


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


def _derived_fields(model: Model, state: State) -> dict[str, Array]:
    """Coordinates and rates that engines take, from the minimal ones.

    Unit rates are those of ν = (udot of the rods, omega of the bodies), as in `velocity_jacobian`.
    """
    n, rods = model.n, np.flatnonzero(model.rods)
    size, A = 3 * (len(rods) + n), rotation_matrix(state.p)
    unit_udot, unit_omega = np.zeros((size, n, 3)), np.zeros((size, n, 3))
    for i, k in enumerate(rods.tolist()):
        unit_udot[3 * i : 3 * i + 3, k] = np.eye(3) - np.outer(state.u[k], state.u[k])
    unit_omega[size - 3 * n :] = np.eye(3 * n).reshape(-1, n, 3)
    rates = velocity_jacobian(model, state).reshape(n, 6, -1)
    omega_of_rates = rates[:, 3:].transpose(2, 0, 1)
    pdot_rates = quaternion_rate(np.broadcast_to(state.p, (size, n, 4)), omega_of_rates).transpose(1, 2, 0)
    omega, udot = (np.concatenate(pair) for pair in (([state.omega], unit_omega), ([state.udot], unit_udot)))
    # of every link its attitude, and its angular velocities (own frame) of the state and of every unit rate
    links: list[tuple[Array, Array]] = []
    for k in range(n):
        if model.rods[k]:
            x = turn_of_z(state.u[k])
            x = x / np.linalg.norm(x)
            own = rotation_matrix(x) * np.array([1.0, 1.0, 0.0])  # the rod does not spin about its axis
            links.append((x, np.cross(state.u[k], udot[:, k]) @ own))
        links.append((state.p[k], omega[:, k]))
    q, w = [links[0][0]], [links[0][1]]
    for (above, spins_above), (x, spins) in pairwise(links):
        q.append(quaternion_product(quaternion_conjugate(above), x))
        w.append(spins - spins_above @ rotation_matrix(q[-1]))
    return {
        "proximal": model.proximal,
        "distal": model.distal,
        "A": A,
        "pdot": quaternion_rate(state.p, state.omega),
        "q": np.array(q),
        "w": np.array(w)[:, 0],
        "joint_rates": np.concatenate(w, axis=1)[1:].T,
        "local_rates": np.concatenate([A.mT @ rates[:, :3], rates[:, 3:]], axis=1).reshape(6 * n, -1),
        "euler_rates": np.concatenate([rates[:, :3], pdot_rates], axis=1).reshape(7 * n, -1),
        "unit_udot": unit_udot,
        "unit_omega": unit_omega,
    }
