"""Other ways to ask Pinocchio about the same mechanism: its algorithms, copies of models, other joint models.

A `Change` is what the build and the evaluation of a tree do otherwise; `VARIANTS` lists them with the names
that each exercises.  A joint model in place of another stands in the same frame: where its coordinates are
angles that can be singular, that frame is turned at every state so that they are `ANGLES`, as users choose
frames.  Its velocity is that of the usual one through both motion subspaces S: v = S⁺ S₀ v₀.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from adapters.pinocchio_common import armature, axis_of, composite, joint_of, parts_of
from plumbline.engines.variants import Suits, Variant, has, variants_of
from plumbline.model.datatypes import Array, Float, Model

LIMITS = (
    "damping", "effortLimit", "friction", "lowerDryFrictionLimit", "lowerEffortLimit", "lowerPositionLimit",
    "lowerVelocityLimit", "positionLimitMargin", "rotorGearRatio", "rotorInertia", "upperDryFrictionLimit",
    "upperEffortLimit", "upperPositionLimit", "upperVelocityLimit", "velocityLimit",
)  # fmt: skip
ANGLES = np.array([0.4, -0.7, 1.1])  # rad, far from singular ones


@dataclass(frozen=True)
class Spelling:
    """A joint model in place of another."""

    make: Callable[[Any], Any] = lambda joint: joint  # the usual one → this one
    coordinates: Callable[[Array], Array] = np.array  # q of the usual one → q
    angles: Float[Array, "nq"] | None = None  # q of one whose frame is turned so that it is this
    has_own_rates: bool = False  # whether its rates are others, of which elements would be matrices


@dataclass(frozen=True)
class Change:
    """What is done otherwise; as it stands nothing."""

    algorithm: str = ""
    remake: Callable[[pin.Model], pin.Model] = lambda model: model
    joints: Mapping[str, Spelling] = field(default_factory=dict)  # by the short name of the usual joint


def _is_tree(model: Model) -> bool:
    return not model.has_loops


_option = variants_of("option", Change, _is_tree)
_spelling = variants_of("spelling", Change, _is_tree)


def _of_axes(kinds: str, spelling: Spelling) -> dict[str, Spelling]:
    """By the short names of joints about or along each axis."""
    return {f"JointModel{kind}{axis}": spelling for kind in kinds for axis in "XYZ"}


def _universal(joint: Any) -> Any:
    """The engine's own joint in place of a composite one of two turns."""
    parts = parts_of(joint)
    is_meant = all(part.shortname().startswith("JointModelR") for part in parts)
    return pin.JointModelUniversal(*map(axis_of, parts)) if is_meant else joint


def _made(*kinds: str) -> Callable[[Any], Any]:
    """A joint of this kind, or of several in turn; pitches and radii are 0, and arbitrary by default."""

    def make(_: Any) -> Any:
        sizes = [(0.0,) * (3 if kind == "Ellipsoid" else kind.startswith("H")) for kind in kinds]
        parts = [getattr(pin, f"JointModel{kind}")(*own) for kind, own in zip(kinds, sizes, strict=True)]
        return composite(*parts) if len(parts) > 1 else parts[0]

    return make


def _planar(joint: Any) -> Any:
    """The engine's own joint in place of a composite one of two slides and a turn."""
    return pin.JointModelPlanar() if len(parts_of(joint)) == len(ANGLES) else joint


def _planar_coordinates(q: Array) -> Array:
    return _unbounded(q) if len(q) == len(ANGLES) else q


def _unbounded(q: Array) -> Array:
    """Give the last coordinate, an angle, by its cosine and sine."""
    return np.array([*q[:-1], np.cos(q[-1]), np.sin(q[-1])])


def _spelled(kinds: str, joints: Mapping[str, Spelling], is_meant: Suits, names: str = "") -> Variant:
    """Describe joints by models of these kinds, whose names and those of their data are the engine's."""

    def suits(model: Model) -> bool:
        has_own_rates = any(spelling.has_own_rates for spelling in joints.values())
        return not (has_own_rates and model.has_elements) and is_meant(model)

    every = [f"Joint{what}{kind}" for kind in kinds.split() for what in ("Model", "Data")]
    return _spelling(names or " ".join(every), suits, joints=joints)


def _moves(*motions: str) -> Suits:
    """Whether a joint of the mechanism has these motions in turn, and no pitch."""
    return lambda model: any(
        tuple(what for what, _ in kind.motions) == motions and not kind.has_pitch for kind in model.kinds
    )


def _unlimited(model: pin.Model) -> pin.Model:
    """Give infinite limits of positions."""
    other = model.copy()
    for name, limit in (("lowerPositionLimit", -np.inf), ("upperPositionLimit", np.inf)):
        setattr(other, name, np.full(model.nq, limit))
    return other


def _saved(form: str, end: str) -> Callable[[pin.Model], pin.Model]:
    """Write a model and read it again."""

    def remake(model: pin.Model) -> pin.Model:
        other = pin.Model()
        if form == "String":
            other.loadFromString(_unlimited(model).saveToString())
            return other
        with tempfile.TemporaryDirectory() as folder:
            given = (str(Path(folder) / f"model{end}"), *(["model"] if form == "XML" else []))
            getattr(model, f"saveTo{form}")(*given)
            getattr(other, f"loadFrom{form}")(*given)
        return other

    return remake


def _with_locked_joint(model: pin.Model) -> pin.Model:
    """Add a joint that carries nothing, and lock it; the others keep larger rotors, which are taken off."""
    other = model.copy()
    joint = other.addJoint(other.njoints - 1, pin.JointModelRY(), pin.SE3.Identity(), "locked")
    other.addJointFrame(joint, 0)
    rotors = model.armature + 1.0 + np.arange(model.nv)
    other.armature = np.append(rotors, 0.0)
    reduced = pin.buildReducedModel(other, [joint], pin.neutral(other))
    reduced.armature = (reduced.armature - rotors) + model.armature  # without rounding where all are kept
    return reduced


def _appended(model: pin.Model) -> pin.Model:
    """Append the model to one without joints."""
    other = pin.appendModel(pin.Model(), model, 0, pin.SE3.Identity())
    # which it does not take over (docs/surface/pinocchio_append_model.py)
    other.gravity, other.armature = model.gravity, armature(model)
    return other


def _appended_to_first(model: pin.Model) -> pin.Model:
    """Append all that the first joint carries to it, its own inertia as that of two frames away from it."""
    first, rest = pin.Model(), pin.Model()
    joint = first.addJoint(0, model.joints[1], model.jointPlacements[1], model.names[1])
    place, own = first.addJointFrame(joint), model.inertias[1]
    # there and back without rounding, which would give a body at the origin a potential energy
    away = pin.SE3(
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([0.125, 0.25, -0.375])
    )
    for k, share in enumerate((0.25, 0.75)):
        part = away.actInv(pin.Inertia(share * own.mass, own.lever, share * own.inertia))
        rest.addFrame(pin.Frame(f"part {k}", 0, 0, away, pin.FrameType.BODY, part))
    for j in range(2, model.njoints):
        number = rest.addJoint(
            model.parents[j] - 1, model.joints[j], model.jointPlacements[j], model.names[j]
        )
        rest.addJointFrame(number)
        rest.appendBodyToJoint(number, model.inertias[j], pin.SE3.Identity())
    for frame in list(model.frames)[1:]:
        rest.addFrame(pin.Frame(frame.name, joint_of(frame) - 1, 0, frame.placement, frame.type))
    whole = pin.appendModel(first, rest, place, pin.SE3.Identity())
    whole.gravity, whole.armature = model.gravity, armature(model)  # as above
    return whole


def _with_limits(model: pin.Model) -> pin.Model:
    """Give limits that are not reached, and what no algorithm for motions reads."""
    other = model.copy()
    for name in LIMITS:
        values = np.array(getattr(other, name), float)
        values[:] = np.linspace(2.0, 3.0, len(values)) * 1e6 * (-1 if name.startswith("lower") else 1)
        setattr(other, name, values)
    other.referenceConfigurations["home"] = pin.neutral(other)
    return other


def _with_other_inertias(model: pin.Model) -> pin.Model:
    """Give each inertia that has a mass by its parameters, by its pseudo-inertia and by six numbers."""
    other = model.copy()
    for j in range(1, other.njoints):
        given = other.inertias[j]
        if given.mass and np.min(np.linalg.eigvalsh(given.inertia)) > 0:  # else it refuses
            own = pin.Inertia.FromDynamicParameters(given.toDynamicParameters())
            again = pin.Inertia.FromPseudoInertia(pin.PseudoInertia.FromInertia(own))
            other.inertias[j] = pin.Inertia(again.mass, again.lever, pin.Symmetric3(again.inertia).matrix())
    return other


def _as_frames(model: pin.Model) -> pin.Model:
    """Give each inertia with a frame of a body on a frame of its joint."""
    other = model.copy()
    for j in range(1, other.njoints):
        joint = other.addJointFrame(j, 0)
        body = other.addBodyFrame(f"body of {j}", j, pin.SE3.Identity(), joint)
        inertia, other.inertias[j] = other.inertias[j].copy(), pin.Inertia.Zero()
        kinds = pin.FrameType.FIXED_JOINT, pin.FrameType.SENSOR
        for kind, share in zip(kinds, (0.25, 0.75), strict=True):
            part = pin.Inertia(share * inertia.mass, inertia.lever, share * inertia.inertia)
            frame = pin.Frame(f"{kind} of {j}", j, body, pin.SE3.Identity(), kind, part)
            other.addFrame(frame, True)
    return other


def _cosines(q: Array) -> Array:
    """Give angles by their cosines and sines."""
    return np.stack([np.cos(q), np.sin(q)], axis=1).ravel()


def _has_one_root(model: Model) -> bool:
    """Whether one joint carries all, and has an inertia that can be shared."""
    return int(np.sum(model.body[:, 0] < 0)) == 1 and not model.kinds[0].holds_distance


def _is_short(model: Model) -> bool:
    """Whether `aba` keeps its digits; where it loses them is recorded of the column pinocchio-aba."""
    return model.n <= 3


VARIANTS = (
    _option("cholesky.solve", algorithm="cholesky"),
    _option("forwardDynamics", algorithm="forwardDynamics"),
    _option("constraintDynamics initConstraintDynamics", algorithm="constraintDynamics"),
    _option("aba Convention.LOCAL", _is_short, algorithm="aba"),
    _option("Model.copy", remake=lambda model: model.copy()),
    _option("Model", remake=lambda model: pickle.loads(pickle.dumps(_unlimited(model)))),
    *(
        _option(f"Model.saveTo{form} Model.loadFrom{form}", remake=_saved(form, end))
        for form, end in (("XML", ".xml"), ("Text", ".txt"), ("String", ""), ("Binary", ".bin"))
    ),
    _option("buildReducedModel Model.addJointFrame", remake=_with_locked_joint),
    _option("appendModel", remake=_appended),
    _spelling("appendModel FrameType.BODY", _has_one_root, remake=_appended_to_first),
    _option(" ".join(f"Model.{name}" for name in (*LIMITS, "referenceConfigurations")), remake=_with_limits),
    _spelling("PseudoInertia Symmetric3", remake=_with_other_inertias),
    _spelling(
        "Model.addBodyFrame FrameType.BODY FrameType.JOINT FrameType.FIXED_JOINT FrameType.SENSOR",
        remake=_as_frames,
    ),
    _spelled(
        "RevoluteUnaligned",
        _of_axes("R", Spelling(lambda joint: pin.JointModelRevoluteUnaligned(axis_of(joint)))),
        _moves("turn"),
    ),
    _spelled("RUBZ", {"JointModelRZ": Spelling(_made("RUBZ"), _unbounded)}, _moves("turn")),
    _spelled(
        "PrismaticUnaligned",
        _of_axes("P", Spelling(lambda joint: pin.JointModelPrismaticUnaligned(axis_of(joint)))),
        _moves("slide"),
    ),
    _spelled(
        "HelicalUnaligned",
        _of_axes("H", Spelling(lambda joint: pin.JointModelHelicalUnaligned(axis_of(joint), joint.pitch))),
        lambda model: any(kind.has_pitch for kind in model.kinds),
    ),
    _spelled("Universal", {"JointModelComposite": Spelling(_universal)}, _moves("turn", "turn")),
    _spelled(
        "Planar",
        {"JointModelComposite": Spelling(_planar, _planar_coordinates, has_own_rates=True)},
        _moves("slide", "slide", "turn"),
    ),
    _spelled(
        "Composite",
        _of_axes("RP", Spelling(lambda joint: composite(joint))),
        lambda model: _moves("turn")(model) or _moves("slide")(model),
    ),
    *(
        _spelled(names, {"JointModelFreeFlyer": Spelling(_made(*parts, "Spherical"))}, has("free"))
        for names, parts in (("PX PY", ("PX", "PY", "PZ")), ("Translation", ("Translation",)))
    ),
    *(
        _spelled(
            kinds,
            {"JointModelSpherical": Spelling(_made(*parts.split()), angles=q, has_own_rates=True)},
            lambda model: any(kind.holds_no_turn for kind in model.kinds),
            names,
        )
        for kinds, parts, q, names in (
            ("SphericalZYX", "SphericalZYX", ANGLES, ""),
            ("Ellipsoid", "Ellipsoid", ANGLES, ""),
            ("RX RY", "RX RY RZ", ANGLES, ""),
            ("HX HY HZ", "HX HY HZ", ANGLES, ""),
            ("RUBX RUBY", "RUBX RUBY RUBZ", _cosines(ANGLES), ""),
            ("", "RevoluteUnboundedUnaligned RUBY RUBZ", _cosines(ANGLES),
             "JointModelRevoluteUnboundedUnaligned JointDataRevoluteUnboundedUnalignedTpl"),
        )
    ),
)  # fmt: skip
