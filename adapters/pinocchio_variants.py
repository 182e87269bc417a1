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

from adapters.pinocchio_common import composite
from plumbline.engines.variants import Variant
from plumbline.model.datatypes import Array, Call, Float, Model

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
    at_angles: bool = False  # whether its coordinates are `ANGLES`, and its frame is turned
    has_own_rates: bool = False  # whether its rates are others, of which elements would be matrices


@dataclass(frozen=True)
class Change:
    """What is done otherwise; as it stands nothing."""

    algorithm: str = ""
    remake: Callable[[pin.Model], pin.Model] = lambda model: model
    joints: Mapping[str, Spelling] = field(default_factory=dict)  # by the short name of the usual joint


def _axis(joint: Any) -> Float[Array, "3"]:
    """The axis of a joint that is named after it."""
    return np.asarray(np.eye(3)["XYZ".index(joint.shortname()[-1])])


def _of_axes(kinds: str, spelling: Spelling) -> dict[str, Spelling]:
    """By the short names of joints about or along each axis."""
    return {f"JointModel{kind}{axis}": spelling for kind in kinds for axis in "XYZ"}


def _parts(joint: Any) -> list[Any]:
    """The joints of a composite one."""
    own = joint.extract() if hasattr(joint, "extract") else joint
    return list(own.joints)


def _universal(joint: Any) -> Any:
    """The engine's own joint in place of a composite one of two turns."""
    parts = _parts(joint)
    is_meant = all(part.shortname().startswith("JointModelR") for part in parts)
    return pin.JointModelUniversal(*map(_axis, parts)) if is_meant else joint


def _about_axes(*kinds: str) -> Any:
    """Three turns; screws are given a pitch of 0, which is arbitrary by default."""
    given = {kind: (0.0,) if kind.startswith("H") else () for kind in kinds}
    return composite(*(getattr(pin, f"JointModel{kind}")(*pitch) for kind, pitch in given.items()))


def _planar(joint: Any) -> Any:
    """The engine's own joint in place of a composite one of two slides and a turn."""
    return pin.JointModelPlanar() if len(_parts(joint)) == len(ANGLES) else joint


def _planar_coordinates(q: Array) -> Array:
    return _unbounded(q) if len(q) == len(ANGLES) else q


def _unbounded(q: Array) -> Array:
    """Give the last coordinate, an angle, by its cosine and sine."""
    return np.array([*q[:-1], np.cos(q[-1]), np.sin(q[-1])])


def _names(*models: str) -> Call:
    """The names of joint models and of their data."""
    return tuple(f"Joint{what}{model}" for model in models for what in ("Model", "Data"))


def _spelled(names: Call, joints: Mapping[str, Spelling], is_meant: Callable[[Model], bool]) -> Variant:
    def suits(model: Model) -> bool:
        has_own_rates = any(spelling.has_own_rates for spelling in joints.values())
        return not (model.has_loops or (has_own_rates and model.has_elements)) and is_meant(model)

    return Variant("spelling", names, Change(joints=joints), suits)


def _moves(*motions: str) -> Callable[[Model], bool]:
    """Whether a joint of the mechanism has these motions in turn, and no pitch."""
    return lambda model: any(
        tuple(what for what, _ in kind.motions) == motions and not kind.has_pitch for kind in model.kinds
    )


def _is_tree(model: Model) -> bool:
    return not model.has_loops


def _saved(form: str, end: str) -> Callable[[pin.Model], pin.Model]:
    """Write a model and read it again."""

    def remake(model: pin.Model) -> pin.Model:
        other = pin.Model()
        if form == "String":
            other.loadFromString(model.saveToString())
            return other
        with tempfile.TemporaryDirectory() as folder:
            given = (str(Path(folder) / f"model{end}"), *(["model"] if form == "XML" else []))
            getattr(model, f"saveTo{form}")(*given)
            getattr(other, f"loadFrom{form}")(*given)
        return other

    return remake


def _with_locked_joint(model: pin.Model) -> pin.Model:
    """Add a joint that carries nothing, and lock it."""
    other = model.copy()
    joint = other.addJoint(other.njoints - 1, pin.JointModelRY(), pin.SE3.Identity(), "locked")
    other.addJointFrame(joint, 0)
    return pin.buildReducedModel(other, [joint], pin.neutral(other))


def _appended(model: pin.Model) -> pin.Model:
    """Append the model to one without joints."""
    other = pin.appendModel(pin.Model(), model, 0, pin.SE3.Identity())
    other.gravity = model.gravity  # which it does not take over (docs/surface/pinocchio_append_model.py)
    return other


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


def _constant(q: Array) -> Callable[[Array], Array]:
    """The same coordinates whatever the usual ones are."""
    return lambda _: q


def _cosines(q: Array) -> Array:
    """Give angles by their cosines and sines."""
    return np.stack([np.cos(q), np.sin(q)], axis=1).ravel()


def _of_all_trees(names: Call, **change: Any) -> Variant:
    return Variant("option", names, Change(**change), _is_tree)


def _is_short(model: Model) -> bool:
    """Whether `aba` keeps its digits; where it loses them is recorded of the column pinocchio-aba."""
    return _is_tree(model) and model.n <= 3


VARIANTS = (
    _of_all_trees(("cholesky.solve",), algorithm="cholesky"),
    _of_all_trees(("forwardDynamics",), algorithm="forwardDynamics"),
    _of_all_trees(("constraintDynamics", "initConstraintDynamics"), algorithm="constraintDynamics"),
    Variant("option", ("aba", "Convention.LOCAL"), Change("aba"), _is_short),
    _of_all_trees(("Model.copy",), remake=lambda model: model.copy()),
    _of_all_trees(("Model",), remake=lambda model: pickle.loads(pickle.dumps(model))),
    *(
        _of_all_trees((f"Model.saveTo{form}", f"Model.loadFrom{form}"), remake=_saved(form, end))
        for form, end in (("XML", ".xml"), ("Text", ".txt"), ("String", ""), ("Binary", ".bin"))
    ),
    _of_all_trees(("buildReducedModel", "Model.addJointFrame"), remake=_with_locked_joint),
    _of_all_trees(("appendModel",), remake=_appended),
    _of_all_trees(
        (*(f"Model.{name}" for name in LIMITS), "Model.referenceConfigurations"), remake=_with_limits
    ),
    Variant("spelling", ("PseudoInertia", "Symmetric3"), Change(remake=_with_other_inertias), _is_tree),
    Variant(
        "spelling",
        (
            "Model.addBodyFrame",
            *(f"FrameType.{kind}" for kind in ("BODY", "JOINT", "FIXED_JOINT", "SENSOR")),
        ),
        Change(remake=_as_frames),
        _is_tree,
    ),
    _spelled(
        _names("RevoluteUnaligned"),
        _of_axes("R", Spelling(lambda joint: pin.JointModelRevoluteUnaligned(_axis(joint)))),
        _moves("turn"),
    ),
    _spelled(
        _names("RUBZ"), {"JointModelRZ": Spelling(lambda _: pin.JointModelRUBZ(), _unbounded)}, _moves("turn")
    ),
    _spelled(
        _names("PrismaticUnaligned"),
        _of_axes("P", Spelling(lambda joint: pin.JointModelPrismaticUnaligned(_axis(joint)))),
        _moves("slide"),
    ),
    _spelled(
        _names("HelicalUnaligned"),
        _of_axes("H", Spelling(lambda joint: pin.JointModelHelicalUnaligned(_axis(joint), joint.pitch))),
        lambda model: any(kind.has_pitch for kind in model.kinds),
    ),
    _spelled(
        _names("Universal"), {"JointModelComposite": Spelling(_universal)}, _moves("turn", "turn")
    ),
    _spelled(
        _names("Planar"),
        {"JointModelComposite": Spelling(_planar, _planar_coordinates, has_own_rates=True)},
        _moves("slide", "slide", "turn"),
    ),
    _spelled(
        _names("Composite"),
        _of_axes("RP", Spelling(lambda joint: composite(joint))),
        lambda model: _moves("turn")(model) or _moves("slide")(model),
    ),
    _spelled(
        _names("PX", "PY"),
        {
            "JointModelFreeFlyer": Spelling(
                lambda _: composite(
                    pin.JointModelPX(), pin.JointModelPY(), pin.JointModelPZ(), pin.JointModelSpherical()
                )
            )
        },
        lambda model: bool(np.any(model.free)),
    ),
    _spelled(
        _names("Translation"),
        {
            "JointModelFreeFlyer": Spelling(
                lambda _: composite(pin.JointModelTranslation(), pin.JointModelSpherical())
            )
        },
        lambda model: bool(np.any(model.free)),
    ),
    *(
        _spelled(
            names,
            {"JointModelSpherical": Spelling(make, _constant(q), at_angles=True, has_own_rates=True)},
            lambda model: any(kind.holds_no_turn for kind in model.kinds),
        )
        for names, make, q in (
            (_names("SphericalZYX"), lambda _: pin.JointModelSphericalZYX(), ANGLES),
            (_names("Ellipsoid"), lambda _: pin.JointModelEllipsoid(0.0, 0.0, 0.0), ANGLES),
            (_names("RX", "RY"), lambda _: _about_axes("RX", "RY", "RZ"), ANGLES),
            (_names("HX", "HY", "HZ"), lambda _: _about_axes("HX", "HY", "HZ"), ANGLES),
            (_names("RUBX", "RUBY"), lambda _: _about_axes("RUBX", "RUBY", "RUBZ"), _cosines(ANGLES)),
            (
                ("JointModelRevoluteUnboundedUnaligned", "JointDataRevoluteUnboundedUnalignedTpl"),
                lambda _: _about_axes("RevoluteUnboundedUnaligned", "RUBY", "RUBZ"),
                _cosines(ANGLES),
            ),
        )
    ),
)  # fmt: skip
