"""Every number of a mechanism and its initial state that an engine could have wrong, one at a time.

A mistake is stated as a fraction of ``scale``: of the parameter's own size, or where that is zero (no load,
no drag, a product of inertia of a principal frame, an angle) of a natural size of the same unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, KINDS, SPRING_FIELDS, Array, Model, State
from plumbline.model.kinematics import complete_state, quaternion_product, stretched_length

AXES = ("x", "y", "z")
INERTIA_ENTRIES = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
UNITS = {
    "gravity": "m/s²", "mass": "kg", "inertia": "kg m²", "proximal": "m", "anchor": "m", "length": "m",
    "pitch": "m/rad",
    "force": "N", "moment": "N m", "drag_force": "N s/m", "drag_moment": "N m s", "attitude": "rad",
    "omega": "rad/s", "direction": "rad", "rod_rate": "1/s",
    # a joint's axes in both bodies; elements of turns; springs between points
    "frame": "rad", "body_frame": "rad", "armature": "kg m²", "damping": "N m s",
    "stiffness": "N m", "rest": "rad", "effort": "N m", "coordinate": "rad", "rate": "rad/s",
    "position": "m", "velocity": "m/s", "spring_point": "m", "spring_stiffness": "N/m",
    "spring_damping": "N s/m", "spring_length": "m",
}  # fmt: skip
SLIDE_UNITS = {
    "armature": "kg", "damping": "N s/m", "stiffness": "N/m", "rest": "m", "effort": "N",
    "coordinate": "m", "rate": "m/s",
}  # fmt: skip
# of the initial state; the others are the model's
STATE_KINDS = (
    "attitude", "omega", "direction", "rod_rate", "coordinate", "rate", "position", "velocity",
)  # fmt: skip
FRAME_KINDS = ("frame", "body_frame")  # turns of a joint's axes
NEGLIGIBLE = 1e-9  # of the natural size: a value below is a rounded zero
SLIDES = {  # names of motions
    name
    for kind in KINDS.values()
    for (motion, _), name in zip(kind.motions, kind.motion_names, strict=True)
    if motion == "slide"
}


@dataclass(frozen=True)
class Parameter:
    """One number of a model or of its initial state."""

    kind: str  # a key of `UNITS`: a field of `Model` or a part of one, or one of `STATE_KINDS`
    body: int  # 0 … N − 1, and its joint, or a closing joint; −1: gravity; of "spring_…" the spring's number
    entry: str  # component: x, y, z, or xx … yz of the inertia; turn or slide of a joint; empty for scalars
    value: float  # in the unit of the kind; 0 for the angles of attitudes and directions
    # what a relative mistake is relative to, same unit: |value|, or a natural size where that is 0
    scale: float

    @property
    def name(self) -> str:
        """Kind and component, as tables show them."""
        return f"{self.kind} {self.entry}".strip()

    @property
    def unit(self) -> str:
        """Unit of value and scale."""
        return (SLIDE_UNITS if self.entry in SLIDES else UNITS)[self.kind]


def list_parameters(model: Model, state: State) -> list[Parameter]:
    """List every parameter of a model and of its initial state.

    Attitudes and directions of rods count as small rotations: about the body's axes, and about two axes
    across the rod.

    Returns:
        Gravity's components, then body by body its model parameters, those of its joint and its initial
        state; those of joints that close loops; then those of springs.

    """
    g = max(float(np.linalg.norm(model.gravity)), 1e-3)
    length = float(np.sum(stretched_length(model.tree)))
    rate = float(np.sqrt(g / length))
    found = list(_components("gravity", -1, model.gravity, g))
    for k in range(model.n):
        mass, trace, span = model.mass[k], float(np.trace(model.inertia[k])), _span(model, k)
        spin = max(rate, float(np.linalg.norm(state.omega[k])), float(np.linalg.norm(state.udot[k])))
        found.append(Parameter("mass", k, "", float(mass), float(mass)))
        for entry, at in INERTIA_ENTRIES.items():
            found.append(_parameter("inertia", k, entry, model.inertia[k][at], trace / 3))
        found += _geometry(model, k, span)
        found += _components("force", k, model.force[k], mass * g)
        found += _components("moment", k, model.moment[k], mass * g * span)
        found.append(_parameter("drag_force", k, "", model.drag_force[k], mass * rate))
        found.append(_parameter("drag_moment", k, "", model.drag_moment[k], trace / 3 * rate))
        found += _joint_elements(model, k, rate)
        found += _initial_state(model, state, k, span, spin)
    for k in range(model.n, len(model.kind)):  # joints that close loops
        found += _geometry(model, k, _span(model, int(model.body[k, 1])))
        found += _joint_elements(model, k, rate)
    found += _springs(model, length, rate)
    return found


def _span(model: Model, k: int) -> float:
    """A body's size: distance of its near point and of those on which others hang, and radius of gyration."""
    sizes = [model.proximal[k], *model.point[model.body[:, 0] == k, 0]]
    gyration = np.sqrt(np.trace(model.inertia[k]) / (2 * model.mass[k]))
    return max(float(gyration), *(float(np.linalg.norm(x)) for x in sizes))


def _geometry(model: Model, k: int, span: float) -> Iterator[Parameter]:
    """Points and axes of a joint; ``span`` is the size of its near body."""
    kind = model.kinds[k]
    if kind.holds_nothing:
        return
    yield from _components("proximal", k, model.proximal[k], span)
    yield from _components("anchor", k, model.point[k, 0], span)
    if kind.own_number:
        yield _parameter(kind.own_number, k, "", model.length[k], span)
    if not kind.has_attitude or (kind.is_spherical and model.stiffness[k, 0]):
        for frame in FRAME_KINDS:
            yield from (Parameter(frame, k, axis, 0.0, 1.0) for axis in AXES)


def _joint_elements(model: Model, k: int, rate: float) -> Iterator[Parameter]:
    """Rotor, damper, spring and effort of each coordinate of a joint; of a ball's about all axes."""
    if not model.has_joint_elements:
        return
    near = model.body[k, 1]
    inertia = float(np.trace(model.inertia[near])) / 3, float(model.mass[near])
    is_ball = model.kinds[k].is_spherical
    for i, what in enumerate(["turn"] if is_ball else model.kinds[k].motion_names):
        is_slide = what in SLIDES
        size, arm = inertia[is_slide], float(np.sqrt(3 * inertia[0] / inertia[1]))
        natural = (size, size * rate, size * rate**2, arm if is_slide else 1.0, size * rate**2)
        for name, own in zip(JOINT_ELEMENTS, natural, strict=True):
            if (name in ("rest", "effort") and is_ball) or (name == "rest" and not model.stiffness[k, i]):
                continue
            yield _parameter(name, k, what, getattr(model, name)[k, i], own)


def _initial_state(model: Model, state: State, k: int, span: float, spin: float) -> Iterator[Parameter]:
    """Minimal coordinates and rates of a body."""
    if model.kinds[k].has_attitude:
        yield from (Parameter("attitude", k, axis, 0.0, 1.0) for axis in AXES)
        yield from _components("omega", k, state.omega[k], spin)
    if model.rods[k]:
        yield from (Parameter("direction", k, axis, 0.0, 1.0) for axis in AXES[:2])
        across = rod_axes(state.u[k]) @ state.udot[k]
        yield from (_parameter("rod_rate", k, AXES[i], across[i], spin) for i in range(2))
    if model.free[k]:
        yield from _components("position", k, state.r[k], span)
        yield from _components("velocity", k, state.v[k], span * spin)
    for i, what in enumerate(model.kinds[k].motion_names):
        is_slide = what in SLIDES
        angle = Parameter("coordinate", k, what, 0.0, 1.0)
        yield _parameter("coordinate", k, what, state.x[k, i], span) if is_slide else angle
        yield _parameter("rate", k, what, state.xdot[k, i], span * spin if is_slide else spin)


def _springs(model: Model, length: float, rate: float) -> Iterator[Parameter]:
    """Points and numbers of springs between points."""
    for i, pair in enumerate(model.spring_body):
        mass = float(np.max(model.mass[pair[pair >= 0]]))
        for side, words in enumerate(("first", "second")):
            for axis, value in zip(AXES, model.spring_point[i, side], strict=True):
                yield _parameter("spring_point", i, f"{words} {axis}", value, length)
        for name, own in zip(SPRING_FIELDS[2:], (mass * rate**2, mass * rate, length), strict=True):
            if name != "spring_length" or model.spring_stiffness[i]:
                yield _parameter(name, i, "", getattr(model, name)[i], own)


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
        state: a state of it, of which the minimal coordinates count.
        parameter: of `list_parameters` for this model.
        size: the change, as a fraction of the parameter's scale.

    Returns:
        The changed model, and the changed state of the same minimal coordinates.

    """
    model = perturb_model(model, parameter, size)
    if parameter.kind not in STATE_KINDS:
        return model, complete_state(model, state)
    rate, k = derivative(model, state, parameter), parameter.body
    fields = {
        name: value + size * parameter.scale * rate.get(name, 0.0) for name, value in vars(state).items()
    }
    if parameter.kind == "attitude":
        fields["p"][k] /= np.linalg.norm(fields["p"][k])
    if parameter.kind == "direction":
        u, udot = fields["u"], fields["udot"]
        u[k] /= np.linalg.norm(u[k])
        udot[k] -= (udot[k] @ u[k]) * u[k]
    return model, complete_state(model, State(**fields))


def perturb_model(model: Model, parameter: Parameter, size: float) -> Model:
    """Change one parameter of a model; those of a state leave it as it is.

    Args:
        parameter: of `list_parameters` for this model.
        size: the change, as a fraction of the parameter's scale.

    """
    if parameter.kind in STATE_KINDS:
        return model
    ((name, rate),) = _model_derivative(model, parameter).items()
    value = getattr(model, name) + size * parameter.scale * rate
    if name == "turn":
        value[parameter.body] /= np.linalg.norm(value[parameter.body], axis=-1, keepdims=True)
    return model.changed(**{name: value})


def derivative(model: Model, state: State, parameter: Parameter) -> dict[str, Array]:
    """Differentiate the fields of a model and its state by a parameter.

    Args:
        state: a state of it, of which the minimal coordinates count.
        parameter: of `list_parameters` for this model.

    Returns:
        By the name of the field an array of its shape, per unit of the parameter; the other fields keep
        their values, but for positions and velocities that follow from the minimal coordinates.

    """
    kind, k = parameter.kind, parameter.body
    if kind not in STATE_KINDS:
        return _model_derivative(model, parameter)
    if kind in ("coordinate", "rate"):
        name = "x" if kind == "coordinate" else "xdot"
        return {name: _unit(getattr(state, name), k, _column(model, parameter))}
    i = AXES.index(parameter.entry)
    if kind == "attitude":
        return {"p": _placed(state.p, _turning(state.p[k], i), k)}
    if kind in _FIELDS:
        return {_FIELDS[kind]: _unit(state.r, k, i)}
    axis = rod_axes(state.u[k])[i]
    if kind == "rod_rate":
        return {"udot": _placed(state.udot, axis, k)}
    return {name: _placed(x, np.cross(axis, x[k]), k) for name, x in (("u", state.u), ("udot", state.udot))}


_FIELDS = {  # where they are not named as the kind
    "proximal": "point", "anchor": "point", "frame": "turn", "body_frame": "turn",
    "pitch": "length",
    "omega": "omega", "position": "r", "velocity": "v",
}  # fmt: skip


def _model_derivative(model: Model, parameter: Parameter) -> dict[str, Array]:
    """As `derivative`, of a parameter of the model."""
    kind, k, entry = parameter.kind, parameter.body, parameter.entry
    name = _FIELDS.get(kind, kind)
    array = getattr(model, name)
    if kind == "inertia":
        i, j = INERTIA_ENTRIES[entry]
        return {name: np.maximum(_unit(array, k, i, j), _unit(array, k, j, i))}
    if name == "turn":
        side = int(kind == "body_frame")
        return {name: _placed(array, _turning(array[k, side], AXES.index(entry)), k, side)}
    if kind in JOINT_ELEMENTS:
        return {name: _unit(array, k, _column(model, parameter))}
    *where, axis = entry.split() or [""]
    place: list[int] = [] if kind == "gravity" else [k]
    if name == "point":
        place.append(int(kind == "proximal"))
    elif where:
        place.append(int(where == ["second"]))
    return {name: _unit(array, *place, *([AXES.index(axis)] if axis else []))}


def _unit(array: Array, *place: int) -> Array:
    """Zeros but for a 1."""
    return _placed(array, np.array(1.0), *place)


def _placed(array: Array, value: Array, *place: int) -> Array:
    """Zeros but for a value."""
    found = np.zeros_like(array)
    found[place] = value
    return found


def _turning(p: Array, axis: int) -> Array:
    """The derivative of a quaternion (4,) that turns about one of its own axes, per rad."""
    return quaternion_product(p, np.concatenate([[0.0], np.eye(3)[axis] / 2]))


def _column(model: Model, parameter: Parameter) -> int:
    """Which coordinate of its joint a parameter belongs to."""
    motions = model.kinds[parameter.body].motion_names
    return motions.index(parameter.entry) if motions else 0
