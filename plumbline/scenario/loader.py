"""Scenario files → `Scenario`: a checked model, an exact initial state and sample times."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from os.path import isfile
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from plumbline.layout import ROOT
from plumbline.model.datatypes import FREE, JOINT_ELEMENTS, KINDS, Array, Float, Model, State, column_count
from plumbline.model.kinematics import (
    complete_state,
    own_rates,
    quaternion_product,
    rate_count,
    rotation_matrix,
    spring_vectors,
    turn_of_z,
)
from plumbline.model.loops import assembled, loop_gaps, motion_without_inertia, without_still_rates
from plumbline.scenario.line_and_column_errors import (
    Problem,
    ScenarioError,
    closest_match,
    did_you_mean,
    in_brackets,
    shorten,
)
from plumbline.scenario.schema import (
    INPUT_ROUNDING,
    MAX_BODIES,
    MIN_INERTIA,
    VALID_NAME,
    Articulated,
    Body,
    Document,
    Free,
    Rod,
    attitude_quaternion,
    inertia_matrix,
    name_error,
    unit_vector,
)
from plumbline.scenario.validation_messages import problems_from_validation
from plumbline.scenario.yaml_reader import read_yaml
from plumbline.scenario.yaml_source import FieldPath, YamlSource

CATALOGUE_FOLDER = ROOT / "scenarios"
LOOP_TOLERANCE = 1e-9  # of a loop's gap at t = 0 [m, rad], and of its rate over the largest speed
MAX_MAGNITUDE = 1e30  # beyond it squares and products leave the range where engines can compute
MODEL_FILE_SUFFIXES = (".urdf", ".xml", ".mjcf")  # of robots, which other modules read
# Of the catalogue; beside each its plainest scenario, whose refinement studies all run by day.
FAMILIES = {
    "single": "drag-rod",
    "double": "double-loaded-rods",
    "chain": "chain-3-rods",
    "joint": "long-hinge",
    "tree": "loaded-tree",
    "loop": "four-bar",
    "classic": "a01-simple-pendulum",
}


@dataclass(frozen=True, eq=False)
class Scenario:
    """One pendulum, its loads and its exact initial state.

    ``state`` holds the minimal coordinates (p, omega, u, udot) that the truth in high precision starts from:
    p and u are unit to rounding, udot is perpendicular to u to rounding.  ``name``, ``title`` and the other
    texts are the file's own and may hold any printable character: escape them in HTML, XML and shells. The
    name has no slash and can name a file.
    """

    name: str
    family: str
    title: str
    purpose: str  # which mistakes this scenario reveals
    schema_version: int
    model: Model
    state: State
    duration: float  # s
    sample_interval: float  # s, between compared samples
    closed_form: str | None  # id of its closed-form solution
    level: Literal["state", "all"]  # "state": its motion is not compared
    body_names: tuple[str, ...]  # N names, for the reader
    path: Path
    digest: str  # sha256 of the checked content: layout and comments do not count
    seed: str  # of the random states that it is compared at
    document: dict[str, Any] = field(repr=False, default_factory=dict)  # the checked content as plain data

    @property
    def is_in_catalogue(self) -> bool:
        """Whether it comes with the project."""
        return CATALOGUE_FOLDER in self.path.parents

    @property
    def is_from_model_file(self) -> bool:
        """Whether it was read from a URDF or MJCF file."""
        return self.path.suffix in MODEL_FILE_SUFFIXES

    @property
    def origin(self) -> str:
        """The file: its name where it is of the catalogue, else its path as given, which has a slash."""
        if self.is_in_catalogue:
            return self.path.name
        path = self.path.as_posix()
        return path if "/" in path else f"./{path}"

    @property
    def times(self) -> Float[Array, "samples"]:
        """(T,) s, the sample times from 0 to the duration."""
        count = round(self.duration / self.sample_interval) + 1
        return np.arange(count, dtype=np.float64) * self.sample_interval


def load_scenario(path: str | Path) -> Scenario:
    """Read and check a scenario file.

    Returns:
        The scenario, named after the file unless the file has a name.

    Raises:
        ScenarioError: the file has problems; the error holds all of them.

    """
    return build_scenario(read_yaml(Path(path)), Path(path))


def load_scenario_text(content: str, name: str = "scenario") -> Scenario:
    """Check the text of a scenario file.

    Raises:
        ScenarioError: the text has problems; the error holds all of them.

    """
    from plumbline.scenario.yaml_parser import parse_yaml

    return build_scenario(parse_yaml(YamlSource(name), content), Path(name))


def scenario_from_dict(content: dict[str, Any], name: str) -> Scenario:
    """Check plain data that a program made, as the content of a file is checked.

    Raises:
        ScenarioError: the data have problems; the error holds all of them.

    """
    return build_scenario(YamlSource(name, content, value_positions=defaultdict(lambda: (1, 1))), Path(name))


def load_scenarios(
    names: Iterable[str | Path], load: Callable[[Path], Scenario] = load_scenario
) -> list[Scenario]:
    """Read and check several scenarios.

    Args:
        names: names of the catalogue, or paths of files.
        load: reads and checks one file.

    Returns:
        The scenarios in this order, each once.

    Raises:
        ScenarioError: files have problems, or two different scenarios have one name.

    """
    found: dict[str, Scenario] = {}
    problems: list[Problem] = []
    for name in names:
        try:
            scenario = load(find_scenario_file(name))
        except ScenarioError as error:
            problems += error.problems
            continue
        other = found.setdefault(scenario.name, scenario)
        if other.digest != scenario.digest:
            message = f"is named {scenario.name!r} like {other.path}"
            problems.append(Problem(str(scenario.path), 0, 0, "name", message, "a name of its own"))
    if problems:
        raise ScenarioError(dict.fromkeys(problems))
    return list(found.values())


@cache
def catalogue() -> Mapping[str, Path]:
    """List the scenarios that come with the project, as they were when this process first asked.

    Returns:
        Name → file, family by family.

    """
    files = (
        path
        for family in FAMILIES
        for path in sorted((CATALOGUE_FOLDER / family).glob("*.yaml"), key=lambda path: path.stem)
    )
    return MappingProxyType({path.stem: path for path in files})


def find_scenario_file(name: str | Path) -> Path:
    """Look a name up in the catalogue; a path is returned as it is.

    Args:
        name: a name of the catalogue, or a path.

    Returns:
        The file, which need not exist.

    Raises:
        ScenarioError: the name is neither; suggests the nearest name.

    """
    known = catalogue()
    if str(name) in known:
        return known[str(name)]
    path = Path(name)
    if path.suffix in (".yaml", ".yml", *MODEL_FILE_SUFFIXES) or len(path.parts) > 1 or isfile(path):
        return path
    valid = "a path of a YAML, URDF or MJCF file, or a name that `plumbline list scenarios` shows"
    near = closest_match(str(name), [*known, *FAMILIES], cutoff=0.6)
    hint = f"did you mean {f'`--family {near}`' if near in FAMILIES else repr(near)}?" if near else ""
    message = f"unknown scenario{in_brackets(hint)}"
    raise ScenarioError([Problem(shorten(str(name)), 0, 0, "", message, valid)])


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of scenario files, for editors.

    Returns:
        A schema of draft 2020-12, as plain data.

    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Document.model_json_schema()}


def build_scenario(source: YamlSource, path: Path) -> Scenario:
    """Check parsed data and build the model and the initial state from them.

    Args:
        source: the data of a file with their positions.
        path: the file; its stem is the scenario's name unless the data have a name.

    Raises:
        ScenarioError: the data have problems; the error holds all of them.

    """
    problems = list(source.problems)
    document = None
    try:
        with np.errstate(all="ignore"):  # numbers that overflow are refused below
            document = Document.model_validate(source.data)
    except ValidationError as error:
        version = [
            e for e in error.errors() if e["loc"] == ("schema_version",) and e["type"] == "literal_error"
        ]
        if version:  # the fields of another version are not this one's to judge
            raise ScenarioError(problems_from_validation(source, version)) from None
        problems += problems_from_validation(source, error.errors())
    problems += _missing_distal_problems(source)
    if document is not None and document.name is None and (wrong := name_error(path.stem)):
        hint = "give the file another name, or a `name:`"
        problems.append(
            Problem(source.file, 1, 1, "name", f"is the file's name, which {wrong}", VALID_NAME, hint)
        )
    if problems or document is None:
        raise ScenarioError(problems)
    places, bodies, turns = map(list, zip(*_expand_repeats(document), strict=True))
    _refuse_repeated_names(source, places, bodies)
    far = _resolve_parents(source, places, bodies)
    springs = _resolve_springs(source, document, bodies)
    closed = _resolve_closes(source, document, bodies)
    if len(bodies) > MAX_BODIES:
        raise source.fatal_error(
            f"has {len(bodies)} bodies", f"at most {MAX_BODIES}", source.value_positions[("bodies",)]
        )
    with np.errstate(all="ignore"):
        model = _build_model(document, bodies, far, springs, closed)
        state = complete_state(model, _minimal_coordinates(bodies, turns, model.columns))
        state = _closed_state(source, model, state, bodies)
        distances = np.linalg.norm(spring_vectors(model, state.r, state.p), axis=-1)
    for k in np.flatnonzero(distances <= INPUT_ROUNDING * np.max(np.abs(model.spring_point), initial=0.0)):
        place = source.value_positions[("springs", int(k))]
        what = f"has spring {k + 1} between two points that coincide at t = 0, where it has no direction"
        raise source.fatal_error(what, "points that are apart", place)
    for name, array in {**model.fields, **vars(state)}.items():
        if name != "kind" and not np.all(np.abs(array) <= MAX_MAGNITUDE):
            what = f"has numbers that make {name} larger than {MAX_MAGNITUDE:g}"
            raise source.fatal_error(what, "numbers in SI units", (1, 1))
    sizes = np.linalg.norm(model.inertia, axis=(1, 2))
    for body in np.flatnonzero((sizes > 0) & (sizes < MIN_INERTIA)):
        raise source.fatal_error(
            f"has a body, number {body + 1}, with an inertia too small to divide by",
            f"principal moments of 0, or at least {MIN_INERTIA:g} kg m²",
            source.position((*places[body], "inertia")),
        )
    turning = motion_without_inertia(model, state)
    if turning is not None:
        place = source.position((*places[turning], "inertia"))
        raise source.fatal_error(
            f"has a body, number {turning + 1}, that can turn without inertia: how fast is not determinate",
            "principal moments above 0, or joints that hold that turn or carry it at a distance",
            place,
        )
    content = document.model_dump(mode="json")
    content["name"] = document.name or path.stem
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    digest = hashlib.sha256(canonical.encode()).hexdigest()
    if model.has_loops:  # rates that the file does not give follow from the others
        for given, at in zip(bodies, places, strict=True):
            if "angular_velocity" not in given.model_fields_set:
                written: Any = content
                for key in at:
                    written = written[key]
                written.pop("angular_velocity", None)
    return Scenario(
        name=content["name"],
        family=document.family,
        title=document.title,
        purpose=" ".join(document.purpose.split()),
        schema_version=document.schema_version,
        model=model,
        state=state,
        duration=document.duration,
        sample_interval=document.sample,
        closed_form=document.exact,
        level=document.level,
        body_names=tuple(body.name or f"body {k + 1}" for k, body in enumerate(bodies)),
        path=path,
        digest=digest,
        seed=document.seed or digest,
        document=content,
    )


def _missing_distal_problems(source: YamlSource) -> Iterator[Problem]:
    """Bodies that carry another one without saying where; found in the raw data, so beside other problems."""
    valid = "the point, in the frame of this body, from which the next one hangs, as [0, 0, -0.2] (m)"
    items = source.data.get("bodies") if isinstance(source.data, dict) else None
    items = items if isinstance(items, list) else []
    for index, item in enumerate(items):
        written: list[tuple[FieldPath, Any]] = [(("bodies", index), item)]
        count = 1
        if isinstance(item, dict) and isinstance(item.get("cycle"), list):
            written = [(("bodies", index, "cycle", k), body) for k, body in enumerate(item["cycle"])]
            count = item.get("repeat", 0)
        for place, (path, body) in enumerate(written):
            ends = index == len(items) - 1 and count == place + 1  # the chain's last body, copied once
            if ends or not isinstance(body, dict) or body.get("distal") is not None:
                continue
            last_of_item = place == len(written) - 1 and len(written) == count
            follower = items[index + 1] if last_of_item and index + 1 < len(items) else None
            if isinstance(follower, dict) and ({"parent", "anchor"} & set(follower) or _is_free(follower)):
                continue  # hangs elsewhere, or is checked with its parent
            if any(closest_match(key, ["distal"]) for key in body if key not in Body.model_fields):
                continue  # misspelt, and named as such
            yield source.problem((*path, "distal"), "is missing: a body follows", valid)


def _expand_repeats(document: Document) -> Iterator[tuple[FieldPath, Body, Array]]:
    """Every body of the chain: where the file has it, and the quaternion (4,) that it is turned by."""
    for index, item in enumerate(document.bodies):
        if isinstance(item, Body):
            yield ("bodies", index), item, np.array([1.0, 0.0, 0.0, 0.0])
            continue
        for j in range(item.repeat):
            k = j % len(item.cycle)
            turn = item.turn.quaternion(j) if item.turn and j else np.array([1.0, 0.0, 0.0, 0.0])
            yield ("bodies", index, "cycle", k), item.cycle[k], turn


def _is_free(item: dict[str, Any]) -> bool:
    joint = item.get("joint")
    return isinstance(joint, dict) and joint.get("kind") == FREE


def _refuse_repeated_names(source: YamlSource, paths: list[FieldPath], bodies: list[Body]) -> None:
    """Refuse a name that the file gives to two bodies; copies by ``repeat`` share theirs."""
    owners: dict[str | None, str] = {"world": "the world"}
    problems = []
    for path, body in dict(zip(paths, bodies, strict=True)).items():
        place = (*path, "name")
        if body.name in owners:
            message = f"is {body.name!r}, the name of {owners[body.name]} too"
            problems.append(source.problem(place, message, "a name that nothing else has"))
        elif body.name is not None:
            owners[body.name] = f"the body in line {source.position(place)[0]}"
    if problems:
        raise ScenarioError(problems)


def _resolve_parents(source: YamlSource, paths: list[FieldPath], bodies: list[Body]) -> list[int]:
    """The far body of each body, −1 the world; refuses parents that do not exist or come too late."""
    far: list[int] = []
    problems: list[Problem] = []
    for k, body in enumerate(bodies):
        parent, field_name, message, valid = _parent_of(bodies, k, far)
        far.append(parent)
        if message:
            path = (*paths[k], field_name)
            problems.append(source.problem(path, message, valid))
        elif parent >= 0 and body.anchor is None and bodies[parent].distal is None:
            path, valid = (*paths[k], "anchor"), "the point of the parent, as [0, 0, -0.2] (m)"
            message = "is missing: the parent has no distal"
            problems.append(source.problem(path, message, valid))
    if problems:
        raise ScenarioError(problems)
    return far


def _parent_of(bodies: list[Body], k: int, far: list[int]) -> tuple[int, str, str, str]:
    """The parent of body k, or a field, what is wrong with it, and what would be valid."""
    body, names = bodies[k], [body.name for body in bodies]
    parent = -1 if body.parent == "world" or body.joint.kind == FREE else k - 1
    if body.parent not in (None, "world"):
        given, earlier = repr(body.parent), [i for i, name in enumerate(names[:k]) if name == body.parent]
        if not earlier:
            hint = did_you_mean(str(body.parent), [name for name in names[:k] if name])
            unknown = f"no body's name{in_brackets(hint)}"
            why = "which is not above this body" if body.parent in names else unknown
            valid = "the name of a body above this one, or world"
            return -1, "parent", f"is {given}, {why}", valid
        if len(earlier) > 1:
            return -1, "parent", f"is {given}, the name of {len(earlier)} bodies", "a name that one body has"
        parent = earlier[0]
        branch = [k - 1]  # where body k may hang: on the body before, or on one that leads to it
        while branch[-1] >= 0:
            branch.append(far[branch[-1]])
        if parent not in branch:
            valid = f"this body inside the branch of {given}: the bodies of a branch follow each other"
            return -1, "parent", f"is {given}, whose branch ended above", valid
    if KINDS[body.joint.kind].is_rigid and parent < 0:
        message = "welds a body to the world, where it never moves"
        return parent, "joint", message, "another joint, or a parent"
    return parent, "", "", ""


def _resolve_springs(source: YamlSource, document: Document, bodies: list[Body]) -> NDArray[np.intp]:
    """The bodies (K, 2) of the springs, −1 the world."""
    problems: list[Problem] = []
    found = np.full((len(document.springs), 2), -1, np.intp)
    for k, spring in enumerate(document.springs):
        for side, name in enumerate(spring.bodies):
            found[k, side], message = _body_named(name, bodies, may_be_world=True)
            valid = "the name of a body, or world"
            if side and not message and found[k, 0] == found[k, 1]:
                message, valid = f"is {name!r} like the other end", "two different bodies"
            if message:
                problems.append(source.problem(("springs", k, "bodies", side), message, valid))
    if problems:
        raise ScenarioError(problems)
    return found


def _resolve_closes(source: YamlSource, document: Document, bodies: list[Body]) -> NDArray[np.intp]:
    """The far and near bodies (L, 2) of the closing joints, −1 the world."""
    problems: list[Problem] = []
    found = np.full((len(document.closes), 2), -1, np.intp)
    for k, joint in enumerate(document.closes):
        for side, name in enumerate((joint.parent, joint.body)):
            found[k, side], message = _body_named(name, bodies, may_be_world=not side)
            valid = "the name of a body"
            if side and not message and found[k, 0] == found[k, 1]:
                message, valid = f"is {name!r} like the parent", "two different bodies"
            if side and not message and KINDS[joint.joint.kind].is_rigid and found[k, 0] < 0:
                message, valid = f"is {name!r}, welded to the world, where it never moves", "another joint"
            if message:
                problems.append(source.problem(("closes", k, ("parent", "body")[side]), message, valid))
    if problems:
        raise ScenarioError(problems)
    return found


def _body_named(name: str, bodies: list[Body], *, may_be_world: bool) -> tuple[int, str]:
    """The number of a body, −1 the world, and what is wrong with its name."""
    names = [body.name for body in bodies]
    if names.count(name) > 1:
        return -1, f"is {name!r}, the name of {names.count(name)} bodies"
    if name in names:
        return names.index(name), ""
    if name == "world" and may_be_world:
        return -1, ""
    hint = did_you_mean(name, [other for other in names if other])
    return -1, f"is {name!r}, no body's name{in_brackets(hint)}"


def _closed_state(source: YamlSource, model: Model, state: State, bodies: list[Body]) -> State:
    """Close the loops to rounding; refuse gaps and rates that do not fit."""
    if not model.has_loops:
        return state
    movable = np.zeros(rate_count(model), bool)
    rods = [body.joint for body in bodies if isinstance(body.joint, Rod)]
    for i, rod in enumerate(rods):
        movable[3 * i : 3 * i + 3] = rod.rate is None and rod.angular_velocity is None
    for own, body in zip(own_rates(model), bodies, strict=True):
        given = isinstance(body.joint, Articulated) and body.joint.rates is not None
        movable[own] = not given and "angular_velocity" not in body.model_fields_set
    gaps = loop_gaps(model, state)[0]
    found = assembled(model, state, movable)
    rates = loop_gaps(model, found)[1] / max(1.0, float(np.max(np.abs(found.v))))
    reasons = {"does not close: points or axes are apart": gaps, "opens: rates differ": rates}
    for what, sizes in reasons.items():
        for k in np.flatnonzero(~(sizes <= LOOP_TOLERANCE)):
            place = source.position(("closes", int(k)))
            valid = f"a state at t = 0 that fits the joint within {LOOP_TOLERANCE:g} (m, rad, m/s, rad/s)"
            raise source.fatal_error(
                f"has a loop, joint {k + 1} of closes, that {what} by {sizes[k]:.3g}", valid, place
            )
    return without_still_rates(model, found)


def _own_number(joint: Any) -> float:
    """The number that only its kind has, 0 where that has none."""
    own = KINDS[joint.kind].own_number
    return float(getattr(joint, own)) if own else 0.0


def _joint_elements(joints: Sequence[Any], columns: int) -> dict[str, Array]:
    """The elements of all joints, zeros where there are none."""
    found = {name: np.zeros((len(joints), columns)) for name in JOINT_ELEMENTS}
    for name, values in found.items():
        for k, joint in enumerate(joints):
            given = getattr(joint, name, None) or []
            values[k, : len(given)] = given
    return found


def _far_point(bodies: list[Body], k: int, far: int) -> list[float]:
    """Where body k hangs, in the frame of its parent."""
    return bodies[k].anchor or (bodies[far].distal if far >= 0 else None) or [0.0, 0.0, 0.0]


def _joint_turns(joint: Any) -> tuple[Array, Array]:
    """Quaternions of the joint's axes in the parent and in the body."""
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    if not isinstance(joint, Articulated):
        return identity, identity
    if joint.axis is not None:
        turn = unit_vector(turn_of_z(unit_vector(joint.axis)).tolist())
        return turn, turn
    frame = attitude_quaternion(joint.frame) if joint.frame else identity
    return frame, attitude_quaternion(joint.body_frame) if joint.body_frame else frame


def _build_model(
    document: Document,
    bodies: list[Body],
    far: list[int],
    springs: NDArray[np.intp],
    closed: NDArray[np.intp],
) -> Model:
    """The tree of the bodies, and after its joints those that close loops."""
    ends = document.closes
    joints = [*(body.joint for body in bodies), *(end.joint for end in ends)]
    points = [[_far_point(bodies, k, far[k]), body.proximal] for k, body in enumerate(bodies)]
    points += [[end.anchor, end.proximal] for end in ends]
    free = np.array([joint.kind == FREE for joint in joints])
    return Model(
        kind=tuple(joint.kind for joint in joints),
        body=np.concatenate([np.stack([far, np.arange(len(bodies))], axis=1), closed]),
        point=np.where(free[:, None, None], 0.0, np.array(points, dtype=float)),
        turn=np.array([_joint_turns(joint) for joint in joints]),
        mass=np.array([body.mass for body in bodies], dtype=float),
        inertia=np.array([inertia_matrix(body.inertia) for body in bodies]),
        length=np.array([_own_number(joint) for joint in joints]),
        gravity=np.array(document.gravity, dtype=float),
        force=np.array([body.load.force for body in bodies], dtype=float),
        moment=np.array([body.load.moment for body in bodies], dtype=float),
        drag_force=np.array([body.drag.force for body in bodies], dtype=float),
        drag_moment=np.array([body.drag.moment for body in bodies], dtype=float),
        **_joint_elements(joints, column_count(joint.kind for joint in joints)),
        spring_body=springs,
        spring_point=np.array([spring.points for spring in document.springs], dtype=float).reshape(-1, 2, 3),
        spring_stiffness=np.array([spring.stiffness for spring in document.springs], dtype=float),
        spring_damping=np.array([spring.damping for spring in document.springs], dtype=float),
        spring_length=np.array([spring.length for spring in document.springs], dtype=float),
    )


def _minimal_coordinates(bodies: list[Body], turns: list[Array], columns: int) -> State:
    """A state of which the minimal coordinates count: unit and perpendicular to rounding."""
    n = len(bodies)
    p, u, udot, r, v = np.empty((n, 4)), *np.zeros((4, n, 3))
    x, xdot = np.zeros((2, n, columns))
    for k, (body, turn) in enumerate(zip(bodies, turns, strict=True)):
        if body.attitude is None:
            p[k] = 1.0, 0.0, 0.0, 0.0
            assert isinstance(body.joint, Articulated)
            for target, values in ((x, body.joint.coordinates), (xdot, body.joint.rates)):
                target[k, : len(values or [])] = values or []
            continue
        p[k] = unit_vector(quaternion_product(turn, attitude_quaternion(body.attitude)).tolist())
        if isinstance(body.joint, Rod):
            world = rotation_matrix(turn)
            u[k] = unit_vector((world @ unit_vector(body.joint.direction)).tolist())
            if body.joint.angular_velocity is not None:
                rate = np.cross(world @ np.array(body.joint.angular_velocity), u[k])
            else:
                rate = world @ np.array(body.joint.rate or [0.0, 0.0, 0.0])
            for _ in range(2):  # the second pass removes what rounding left of the first
                rate = rate - (rate @ u[k]) * u[k]
            udot[k] = rate
        if isinstance(body.joint, Free):
            r[k] = np.array(body.joint.position) - rotation_matrix(p[k]) @ np.array(body.proximal)
            v[k] = body.joint.velocity
    omega = np.array([body.angular_velocity for body in bodies], dtype=float)
    return State(p, omega, u, udot, r, v, x, xdot)
