"""A model file as a scenario: the mechanism that it describes, in motion from its reference pose.

A body's frame is parallel to the world at the reference pose, so that a joint's axis is given in world axes
there.  Consecutive joints of one body are one joint where a kind of `KINDS` has their motions about or along
one frame; else parts of the body between them carry a share of its mass each, because a mechanism has one
joint per body.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from plumbline.engines.importer_calls import read_model_file
from plumbline.importers.importer import Reading
from plumbline.importers.lumping import fixed_parts, lump_fixed_bodies
from plumbline.importers.mjcf import DefaultClasses, disabling_flag
from plumbline.importers.neutral_model import ElementaryJoint, Feature, NeutralBody, NeutralModel, Source
from plumbline.importers.xml_tree import Element, ModelFileError, parse_numbers
from plumbline.model.datatypes import BALL, FREE, KINDS, Array, Float, Kind, Model, State
from plumbline.model.kinematics import mass_matrix, own_rates, quaternion_of, rate_count, rotation_matrix
from plumbline.model.sampling import derive_seed
from plumbline.model_files.prepared_file import MJCF_READER, BaseChoice, PreparedFile, prepare_file
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.worker_pool import Limits, Scheduler, Task, WorkerPool
from plumbline.scenario.line_and_column_errors import shorten
from plumbline.scenario.loader import Scenario, build_scenario
from plumbline.scenario.mechanism_document import Content
from plumbline.scenario.schema import MIN_INERTIA
from plumbline.scenario.yaml_source import YamlSource

DURATION, SAMPLE = 0.5, 2.0**-7  # s; the work of dampers is a quadrature over samples
TURN_RATE, SLIDE_RATE = 5.0, 0.5  # rad/s and m/s at t = 0, standard deviation of each coordinate's
SHARE = 2.0**-6  # of a body's mass and inertia that each part between its joints carries
FRAME_ROUNDING = 1e-12  # of axes and anchors of joints that are one joint together
MAX_RATE = 2e4  # 1/s, of a decay by dampers: no explicit step that a run makes follows a faster one
MAX_LISTED = 700  # characters of what is left out, in the scenario's purpose
CONTACTS = "contacts, limits of motion, friction and actuators"


def load_model_file(
    path: Path, base: BaseChoice = "auto", root: Path | None = None
) -> tuple[Scenario, Content]:
    """Read a URDF or MJCF file as a scenario.

    Args:
        base: of a URDF, whether the root link is fixed; "auto" is fixed.
        root: folder outside of which no file is read; None as for `prepare_file`.

    Returns:
        The scenario, and the content of a scenario file that describes it.

    Raises:
        ScenarioError: the file has mistakes, or describes what no mechanism has; every place is listed.

    """
    shown = str(path)
    document = mechanism_of_model(*read_neutral_model(shown, base, root), shown)
    source = YamlSource(shown, document, value_positions=defaultdict(lambda: (1, 1)))
    scenario = build_scenario(source, path)
    if (rate := fastest_decay(scenario.model, scenario.state)) > MAX_RATE:
        document["level"] = "state"
        document["purpose"] += f" Only states are compared: its dampers stop motions within {1 / rate:.0e} s."
        scenario = build_scenario(source, path)
    return scenario, document


def fastest_decay(model: Model, state: State) -> float:
    """Return the fastest rate [1/s] at which dampers of scalar coordinates end motions: the largest of M⁻¹ D.

    Args:
        model: a tree without rods.

    """
    dampers = np.zeros(rate_count(model))
    for k, (kind, own) in enumerate(zip(model.tree.kinds, own_rates(model), strict=True)):
        if not kind.has_attitude:
            dampers[own] = model.damping[k, : len(kind.motions)]
    decays = np.linalg.solve(mass_matrix(model, state), np.diag(dampers))
    return float(np.max(np.abs(np.linalg.eigvals(decays)), initial=0.0))


@dataclass(frozen=True, eq=False)
class Connection:
    """An equality that holds a point of one body at one of another, as it is at the reference pose."""

    body: str
    other: str  # "" for the world
    anchor: Float[Array, "3"]  # m, in the frame of `body`
    source: Source


def read_neutral_model(
    shown: str, base: BaseChoice = "auto", root: Path | None = None
) -> tuple[NeutralModel, list[Connection]]:
    """Read what a model file says, without geometry that is not needed for it.

    Args:
        shown: the file, as the user typed it.
        base: of a URDF, whether the root link is fixed.
        root: folder outside of which no file is read.

    Raises:
        ModelFileError: the file cannot be used.

    """
    with ScratchFolder("plumbline-model-") as scratch:
        prepared = prepare_file(shown, scratch, root, base, strip=True)
        connections = list(_connections(prepared.tree))
        reading, failure = _mujoco_reading(prepared) if prepared.file.format == "mjcf" else (None, "")
        return prepared.neutral_model(reading, failure), connections


def _connections(root: Element) -> Iterator[Connection]:
    """The equalities of points that are active."""
    defaults = DefaultClasses(root)
    if disabling_flag(root, "equality") or disabling_flag(root, "constraint"):
        return
    for e in [e for equality in root.find_all("equality") for e in equality.find_all("connect")]:
        setter = defaults.setter(e, "active", "equality")
        is_active = setter is None or setter.attributes["active"] != "false"
        if is_active and {"body1", "anchor"} <= e.attributes.keys():
            anchor = np.array(parse_numbers(e, "anchor", 3, []))
            yield Connection(e.attributes["body1"], e.attributes.get("body2", ""), anchor, e.source)


def _mujoco_reading(prepared: PreparedFile) -> tuple[Reading | None, str]:
    """MuJoCo's reading, from a process of its own, or why there is none."""
    limits = Limits(120.0)
    task = Task("read", read_model_file, (MJCF_READER, prepared.file), limits, engine=MJCF_READER)
    with WorkerPool(1, limits) as workers:
        (outcome,) = Scheduler(workers).run([task])
    failure = f"did not read it: {outcome.failure}" if outcome.failure else ""
    return None if failure else outcome.value, failure


def feature_words(features: Sequence[Feature], shown: str) -> str:
    """List what a model leaves out or open: how often, and the first place of each.

    Args:
        shown: the model file, whose name is left out of places in it.

    """
    counted = Counter(feature.what for feature in features)
    first = {feature.what: feature for feature in reversed(features)}
    words = []
    for what, count in counted.items():
        source = first[what].source
        place = f"line {source.line}" if source.file == shown else str(source)
        place = ", ".join(filter(None, (first[what].name, place)))  # elements outside of bodies have no name
        words.append(f"{count} × {what} ({place}{' …' if count > 1 else ''})")
    return ", ".join(words)


def mechanism_of_model(model: NeutralModel, connections: Sequence[Connection], shown: str) -> Content:
    """Describe a model as a scenario file does, moving from its reference pose; with loops, from rest there.

    Args:
        connections: become ball joints that close loops.
        shown: the model file, after which the scenario is named.

    Returns:
        The content of the file; its purpose lists what is left out.

    Raises:
        ModelFileError: a moving body has no mass, or nothing moves.

    """
    name = Path(shown).stem
    lumped = lump_fixed_bodies(model)
    problems = [
        body.fields.get("mass", body.source).problem(
            f"body {body.name!r} moves and has no mass", "a mass above 0 of it or of what is fixed to it"
        )
        for body in lumped.bodies
        if body.mass < MIN_INERTIA
    ]
    if not lumped.bodies:
        is_urdf = Path(shown).suffix == ".urdf"
        hint = "--base free lets the root link of a URDF move" if is_urdf else ""
        problems.append(Source(shown, 1).problem("nothing in it moves", "at least one joint", hint))
    if problems:
        raise ModelFileError(problems)
    writer = _Writer(lumped, np.random.default_rng(derive_seed("model file", name)))
    closes, closing = _closing_joints(model, connections, writer)
    not_compared = [f for f in model.not_compared if f.source not in closing]
    left_out = feature_words((*not_compared, *writer.left_out), shown)
    left_open = feature_words(model.ambiguous, shown)
    purpose = f"Shows whether engines simulate {Path(shown).name} alike. Left out: {left_out or CONTACTS}."
    if left_out:
        purpose = f"{purpose[:-1]}; always {CONTACTS}."
    purpose += f" {len(closes)} of its equalities are rigid ball joints." if closes else ""
    purpose += f" Left open by the file: {left_open}." if left_open else ""
    return {
        "schema_version": 1, "name": name, "family": "model file",
        "title": shorten(f"{Path(shown).name}: {len(writer.bodies)} bodies", 200),
        "purpose": shorten(purpose, MAX_LISTED), "duration": DURATION, "sample": SAMPLE,
        "gravity": model.gravity.tolist(), "bodies": writer.bodies,
    } | ({"closes": closes} if closes else {})  # fmt: skip


def _closing_joints(
    model: NeutralModel, connections: Sequence[Connection], writer: _Writer
) -> tuple[list[Content], set[Source]]:
    """The joints that close loops, and the places of their equalities in the file; then nothing moves."""
    world: _Place = (np.eye(3), np.zeros(3), ("world", np.zeros(3)))
    places = dict.fromkeys(["", *(body.name for body in model.bodies)], world)
    for carrier, parts in fixed_parts(model).items():
        A, origin, holder = writer.places[carrier]
        places |= {part.name: (A @ R, origin + A @ at, holder) for part, at, R in parts}
    joints, sources = [], set[Source]()
    for one in connections:
        A, origin, near = places.get(one.body, world)
        far, point = places.get(one.other, world)[2], origin + A @ one.anchor
        if near[0] == far[0] or near[0] == "world":
            continue  # of a point that moves with the other body, or of one of the world
        joints.append({
            "body": near[0], "parent": far[0], "joint": {"kind": BALL},
            "anchor": (point - far[1]).tolist(), "proximal": (point - near[1]).tolist(),
        })  # fmt: skip
        sources.add(one.source)
    for body in writer.bodies if joints else ():  # random rates would open the loops
        body.pop("angular_velocity", None)
        for name in ("rates", "velocity"):
            body["joint"].pop(name, None)
    return joints, sources


# axes and origin at the reference pose, in the world; the body that it moves with, and its centre of mass
_Place = tuple[Array, Array, tuple[str, Array]]


class _Writer:
    """Writes the bodies of a model one by one; a body's origin is its centre of mass."""

    def __init__(self, model: NeutralModel, rng: np.random.Generator) -> None:
        self.rng = rng
        self.bodies: list[Content] = []
        self.left_out: list[Feature] = []  # what a mechanism does not have
        self.places: dict[str, _Place] = {}  # by body
        poses: list[tuple[Array, Array]] = []  # rotation matrix and origin at the reference pose
        carriers: list[tuple[str, Array]] = []  # name and centre of mass of a body's last part
        for body in model.bodies:
            A, origin = (np.eye(3), np.zeros(3)) if body.parent < 0 else poses[body.parent]
            A, origin = A @ rotation_matrix(body.attitude), origin + A @ body.position
            poses.append((A, origin))
            carrier = ("world", np.zeros(3)) if body.parent < 0 else carriers[body.parent]
            carriers.append(self._add(body, A, origin, carrier))
            self.places[body.name] = (A, origin, carriers[-1])

    def _add(
        self, body: NeutralBody, A: Array, origin: Array, carrier: tuple[str, Array]
    ) -> tuple[str, Array]:
        center, inertia = origin + A @ body.center, A @ self._physical(body) @ A.T
        turned = [replace(j, axis=A @ j.axis, anchor=origin + A @ j.anchor) for j in body.joints]
        groups = list(_joint_groups(turned))
        for i, (kind, joints) in enumerate(groups):
            is_last = i == len(groups) - 1
            share = 1 - SHARE * i if is_last else SHARE
            label = body.name if is_last else f"{body.name}, {joints[-1].name}"
            if not is_last:
                what = f"mass of a part between joints of one body, 1/{round(1 / SHARE)} of the body's"
                self.left_out.append(Feature(what, body.name, body.source))
            point = joints[-1].anchor
            written = {
                "name": self._name(label), "parent": carrier[0], "mass": share * body.mass,
                "inertia": {"matrix": (share * (inertia + inertia.T) / 2).tolist()},
                "joint": {"kind": kind} | self._elements(kind, joints),
                "anchor": (point - carrier[1]).tolist(), "proximal": (point - center).tolist(),
            }  # fmt: skip
            self._set_motion(written, kind, joints, point)
            self.bodies.append(written)
            carrier = written["name"], center
        return carrier

    def _name(self, wanted: str) -> str:
        used = {body["name"] for body in self.bodies} | {"world"}
        return wanted if wanted not in used and len(wanted) <= 80 else f"body {len(self.bodies) + 1}"

    def _physical(self, body: NeutralBody) -> Array:
        """The inertia; where no distribution of mass has it, the second moments that are negative are 0."""
        place = body.fields.get("inertia", body.source)
        if 0 < np.max(np.abs(body.inertia)) < MIN_INERTIA:  # engines divide by it
            what = f"inertia below {MIN_INERTIA:g} kg m², taken as 0"
            self.left_out.append(Feature(what, body.name, place))
            return np.zeros((3, 3))
        values, axes = np.linalg.eigh(np.trace(body.inertia) / 2 * np.eye(3) - body.inertia)
        if values[0] >= -FRAME_ROUNDING * abs(values[2]):
            return body.inertia
        what = "inertia that no distribution of mass has, made physical"
        self.left_out.append(Feature(what, body.name, place))
        second: Array = axes @ np.diag(np.maximum(values, 0.0)) @ axes.T
        physical: Array = np.trace(second) * np.eye(3) - second
        return physical

    def _elements(self, kind: Kind, joints: Sequence[ElementaryJoint]) -> Content:
        """Rotors, dampers and springs."""
        found = {name: [getattr(j, name) for j in joints] for name in ("armature", "damping", "stiffness")}
        if kind == FREE:
            for name, values in found.items():
                if any(values):
                    self.left_out.append(Feature(f"{name} of a free joint", joints[0].name, joints[0].source))
            return {}
        if any(found["stiffness"]) and kind != BALL:
            found["rest"] = [j.spring_reference - j.reference for j in joints]
        return {name: values for name, values in found.items() if any(values)}

    def _set_motion(
        self, written: Content, kind: Kind, joints: Sequence[ElementaryJoint], point: Array
    ) -> None:
        """Write the joint's axes, and pose and rates at t = 0."""
        joint = written["joint"]
        if KINDS[kind].has_attitude:
            written["attitude"] = {"quaternion": [1.0, 0.0, 0.0, 0.0]}
            written["angular_velocity"] = self._random(TURN_RATE, 3)
            if kind == FREE:
                del written["parent"], written["anchor"]
                joint |= {"position": point.tolist(), "velocity": self._random(SLIDE_RATE, 3)}
            return
        if KINDS[kind].is_about_z:
            joint["axis"] = joints[0].axis.tolist()
        else:
            joint["frame"] = {"quaternion": quaternion_of(_frame(kind, joints)).tolist()}
        scales = [TURN_RATE if what == "turn" else SLIDE_RATE for what, _ in KINDS[kind].motions]
        joint["rates"] = [self._random(scale, 1)[0] for scale in scales]

    def _random(self, scale: float, count: int) -> list[float]:
        found: list[float] = (scale * self.rng.normal(size=count)).tolist()
        return found


def _joint_groups(joints: Sequence[ElementaryJoint]) -> Iterator[tuple[Kind, Sequence[ElementaryJoint]]]:
    """The fewest joints of kinds that mechanisms have, each with the elementary joints that it is made of."""
    start = 0
    by_size = sorted(KINDS, key=lambda kind: -len(KINDS[kind].motions))
    while start < len(joints):
        first = joints[start]
        if first.kind in ("ball", "free"):
            yield (BALL if first.kind == "ball" else FREE), joints[start : start + 1]
            start += 1
            continue
        kind = next(k for k in by_size if _is_made_of(k, joints[start : start + len(KINDS[k].motions)]))
        count = len(KINDS[kind].motions)
        yield kind, joints[start : start + count]
        start += count


def _is_made_of(kind: Kind, joints: Sequence[ElementaryJoint]) -> bool:
    """Whether elementary joints make one joint of a kind, in the order of its motions."""
    motions, what = KINDS[kind].motions, {"hinge": "turn", "slide": "slide"}
    is_plain = len(KINDS[kind].rows) + len(motions) == 6 and motions
    if not is_plain or [w for w, _ in motions] != [what.get(j.kind) for j in joints]:
        return False
    frame, anchors = _frame(kind, joints), [j.anchor for j in joints if j.kind == "hinge"]
    errors = [frame[:, axis] - j.axis for (_, axis), j in zip(motions, joints, strict=True)]
    scale = max(1.0, *(float(np.max(np.abs(j.anchor))) for j in joints))
    return (
        bool(np.max(np.abs(frame.T @ frame - np.eye(3))) < FRAME_ROUNDING)
        and float(np.linalg.det(frame)) > 0
        and float(np.max(np.abs(errors))) < FRAME_ROUNDING
        and all(np.allclose(anchor, anchors[0], 0, FRAME_ROUNDING * scale) for anchor in anchors)
    )


def _frame(kind: Kind, joints: Sequence[ElementaryJoint]) -> Array:
    """The axes x, y, z of a joint as columns; those that none of its motions has complete them."""
    given = {axis: joint.axis for (_, axis), joint in zip(KINDS[kind].motions, joints, strict=True)}
    if len(given) == 1:
        ((axis, z),) = given.items()
        across = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
        given[(axis + 1) % 3] = across / np.linalg.norm(across)
    for axis in range(3):
        if axis not in given:
            given[axis] = np.cross(given[(axis + 1) % 3], given[(axis + 2) % 3])
    return np.stack([given[axis] for axis in range(3)], axis=1)
