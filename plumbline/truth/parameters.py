"""Every number of a mechanism and its initial state that an engine could have wrong, one at a time.

A mistake is stated as a fraction of ``scale``: of the parameter's own size, or where that is zero (no load,
no drag, a product of inertia of a principal frame, an angle) of a natural size of the same unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_product, state_from_minimal
from plumbline.truth.ground_truth import stretched_length

AXES = ("x", "y", "z")
INERTIA_ENTRIES = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
UNITS = {
    "gravity": "m/s²", "mass": "kg", "inertia": "kg m²", "proximal": "m", "distal": "m", "length": "m",
    "force": "N", "moment": "N m", "drag_force": "N s/m", "drag_moment": "N m s", "attitude": "rad",
    "omega": "rad/s", "direction": "rad", "rod_rate": "1/s",
}  # fmt: skip
STATE_KINDS = (
    "attitude",
    "omega",
    "direction",
    "rod_rate",
)  # of the initial state; the others are the model's
NEGLIGIBLE = 1e-9  # of the natural size: a value below is a rounded zero


@dataclass(frozen=True)
class Parameter:
    """One number of a model or of its initial state."""

    kind: str  # a key of `UNITS`: a field of `Model`, or one of `STATE_KINDS`
    body: int  # 0 … N − 1; −1 for gravity
    entry: str  # component: x, y, z, or xx … yz of the inertia; empty for scalars
    value: float  # in the unit of the kind; 0 for the angles of attitudes and directions
    scale: (
        float  # what a relative mistake is relative to, same unit: |value|, or a natural size where that is 0
    )

    @property
    def name(self) -> str:
        """Kind and component, as tables show them."""
        return f"{self.kind} {self.entry}".strip()

    @property
    def unit(self) -> str:
        """Unit of value and scale."""
        return UNITS[self.kind]


def list_parameters(model: Model, state: State) -> list[Parameter]:
    """List every parameter of a model and of its initial state.

    The distal point of the last body is no parameter, because nothing hangs there. Attitudes and directions
    of rods count as small rotations: about the body's axes, and about two axes across the rod.

    Args:
        model: the mechanism.
        state: its initial state.

    Returns:
        Gravity's components, then body by body its model parameters and its initial state.

    """
    g = max(float(np.linalg.norm(model.gravity)), 1e-3)
    length = float(np.sum(stretched_length(model)))
    rate = float(np.sqrt(g / length))
    found = list(_components("gravity", -1, model.gravity, g))
    for k in range(model.n):
        mass, trace = model.mass[k], float(np.trace(model.inertia[k]))
        span = max(
            float(np.linalg.norm(model.proximal[k])),
            float(np.linalg.norm(model.distal[k])) if k + 1 < model.n else 0.0,
            float(np.sqrt(trace / (2 * mass))),
        )
        spin = max(rate, float(np.linalg.norm(state.omega[k])), float(np.linalg.norm(state.udot[k])))
        found.append(Parameter("mass", k, "", float(mass), float(mass)))
        for entry, at in INERTIA_ENTRIES.items():
            found.append(_parameter("inertia", k, entry, model.inertia[k][at], trace / 3))
        found += _components("proximal", k, model.proximal[k], span)
        if k + 1 < model.n:
            found += _components("distal", k, model.distal[k], span)
        if model.rods[k]:
            found.append(_parameter("length", k, "", model.length[k], model.length[k]))
        found += _components("force", k, model.force[k], mass * g)
        found += _components("moment", k, model.moment[k], mass * g * span)
        found.append(_parameter("drag_force", k, "", model.drag_force[k], mass * rate))
        found.append(_parameter("drag_moment", k, "", model.drag_moment[k], trace / 3 * rate))
        found += [Parameter("attitude", k, axis, 0.0, 1.0) for axis in AXES]
        found += _components("omega", k, state.omega[k], spin)
        if model.rods[k]:
            found += [Parameter("direction", k, axis, 0.0, 1.0) for axis in AXES[:2]]
            across = rod_axes(state.u[k]) @ state.udot[k]
            found += [_parameter("rod_rate", k, AXES[i], across[i], spin) for i in range(2)]
    return found


def _components(kind: str, body: int, vector: Array, natural: float) -> Iterator[Parameter]:
    for axis, value in zip(AXES, vector, strict=True):
        yield _parameter(kind, body, axis, value, natural)


def _parameter(kind: str, body: int, entry: str, value: float, natural: float) -> Parameter:
    own = abs(value) > NEGLIGIBLE * natural
    return Parameter(kind, body, entry, float(value), float(abs(value) if own else natural))


def rod_axes(u: Array) -> Array:
    """Return two unit vectors across a rod, the axes of its `direction` and `rod_rate` parameters.

    Args:
        u: unit direction (3,) of the rod, world frame.

    Returns:
        (2, 3), world frame.

    """
    first = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(u, first)])


def perturb(model: Model, state: State, parameter: Parameter, size: float) -> tuple[Model, State]:
    """Change one parameter.

    Args:
        model: the mechanism.
        state: a state of it, of which the minimal coordinates count.
        parameter: of `list_parameters` for this model.
        size: the change, as a fraction of the parameter's scale.

    Returns:
        The changed model, and the changed state of the same minimal coordinates.

    """
    kind, k, change = parameter.kind, parameter.body, size * parameter.scale
    if kind in STATE_KINDS:
        return model, _perturb_state(model, state, parameter, change)
    array = getattr(model, kind).copy()
    if kind == "gravity":
        array[AXES.index(parameter.entry)] += change
    elif kind == "inertia":
        i, j = INERTIA_ENTRIES[parameter.entry]
        array[k, i, j] += change
        array[k, j, i] = array[k, i, j]
    elif parameter.entry:
        array[k, AXES.index(parameter.entry)] += change
    else:
        array[k] += change
    changed = model.changed(**{kind: array})
    return changed, state_from_minimal(changed, state.p, state.omega, state.u, state.udot)


def _perturb_state(model: Model, state: State, parameter: Parameter, change: float) -> State:
    """The state with one of its minimal coordinates or rates changed."""
    k, i = parameter.body, AXES.index(parameter.entry)
    p, omega, u, udot = (getattr(state, name).copy() for name in ("p", "omega", "u", "udot"))
    if parameter.kind == "attitude":
        turn = np.concatenate([[1.0], change / 2 * np.eye(3)[i]])
        p[k] = quaternion_product(p[k], turn / np.linalg.norm(turn))
        p[k] /= np.linalg.norm(p[k])
    elif parameter.kind == "omega":
        omega[k, i] += change
    elif parameter.kind == "rod_rate":
        udot[k] += change * rod_axes(u[k])[i]
    else:
        axis = rod_axes(u[k])[i]
        u[k], udot[k] = u[k] + change * np.cross(axis, u[k]), udot[k] + change * np.cross(axis, udot[k])
        u[k] /= np.linalg.norm(u[k])
        udot[k] -= (udot[k] @ u[k]) * u[k]
    return state_from_minimal(model, p, omega, u, udot)
