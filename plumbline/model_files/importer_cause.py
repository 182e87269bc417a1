"""Which parameter an importer reads otherwise than the file says, proved.

Candidates are the differences between the importer's own description and the neutral model, fixed bodies
lumped in both, and terms that the description has but the dynamics may leave out.  A set of changes is a
cause only where the changed neutral model reproduces every quantity of the importer within its tolerance;
then groups of changes (one field of several joints or bodies) and single changes that are not needed are
dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from plumbline.importers.lumping import fixed_parts, lump_fixed_bodies, merge_bodies
from plumbline.importers.neutral_model import (
    CanonicalState,
    ElementaryJoint,
    ModelQuantities,
    NeutralBody,
    NeutralModel,
    Source,
)
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotation_matrix
from plumbline.model_files.certified_model import CertifiedModelQuantities, pose_tolerances, rough_quantities
from plumbline.model_files.model_comparison import (
    TINY,
    Mismatch,
    certify_states,
    joint_permutation,
    mismatches,
    permuted,
)

RELATIVE_CHANGE = 1e-11  # differences of descriptions below this are rounding
JOINT_FIELDS = ("axis", "anchor", "reference", "armature", "damping", "stiffness", "spring_reference")
BODY_FIELDS = ("position", "attitude", "mass", "center", "inertia")
DEFAULT_INERTIAL = "default inertial"  # 1 kg and 1 kg m² for each body without mass
ASSUMED_INERTIAL = "assumed inertial"  # other values for bodies without <inertial>, as from geometry
FRAME = "frame"
SLIDE_SCALE = "displacement"  # of a slide, in the poses alone: its coordinate times a number
ORIGIN = "origin"  # from which a free body's coordinates count
MISSING = "missing body"
FRAME_FIELDS = ("position", "attitude", "anchor", "reference")  # which may describe one pose in several ways
MAX_OMISSIONS = 4
ARMATURE_ENERGY = "armature in the kinetic energy"
OMITTED_FIELDS = ("damping", "stiffness", "armature", "spring_reference")  # may be held and not applied
FIELD_WORDS = {
    "center": "centre of mass", "spring_reference": "spring reference", "position": "position in its parent",
    "attitude": "attitude in its parent", "reference": "reference coordinate", "joints": "joints",
}  # fmt: skip
FAR = 1e4  # times the bound of rounding: changes that leave so much are not worth a certificate
MAX_SINGLE_TRIALS = 40  # changes of one field that are tried one by one
PRUNING_STATES = 3
States = Callable[[NeutralModel], Sequence[CanonicalState]]


@dataclass(frozen=True, eq=False)
class Change:
    """One parameter that differs."""

    field: str
    body: str  # empty: the whole model
    joint: str  # empty: the body
    own: Any  # as the file says
    theirs: Any  # as the importer reads it
    source: Source
    also: Mapping[str, Any] | None = None  # what changes with it in the body that carries it
    carrier: str = ""  # the body that this one is fixed to, where it is not the body itself
    is_omitted: bool = False  # the importer's description has the file's value, its dynamics leave it out

    @property
    def owner(self) -> str:
        """What the parameter belongs to, in words."""
        if self.joint:
            return f"joint {self.joint}"
        return f"body {self.body}" if self.body else "the model"


@dataclass(frozen=True, eq=False)
class Cause:
    """Parameters of one field whose change is needed to reproduce an importer's quantities."""

    field: str
    changes: tuple[Change, ...]
    phrase: str  # what the importer does, without its name
    sentence: str

    def within(self, file: str) -> Cause:
        """Write for a reader of a file: its lines without its path.

        Args:
            file: as in the sources.

        """
        phrase, sentence = (text.replace(f"{file}:", "line ") for text in (self.phrase, self.sentence))
        return replace(self, phrase=phrase, sentence=sentence)


@dataclass(frozen=True, eq=False)
class Explanation:
    """What explains an importer's difference."""

    causes: tuple[Cause, ...] = ()
    remaining: float = 0.0  # largest ratio of error and tolerance that the causes leave
    differences: tuple[Change, ...] = ()  # of the descriptions, where no cause is proved
    is_proved: bool = False

    @property
    def sentence(self) -> str:
        """The causes in one sentence each; empty where none is proved."""
        return " ".join(cause.sentence for cause in self.causes)


def explain_importer(
    title: str,
    model: NeutralModel,
    reading: NeutralModel,
    answers: Sequence[ModelQuantities],
    states: States,
) -> Explanation:
    """Find the parameters that explain an importer's quantities.

    Args:
        title: name and version of the importer's engine, for the sentences.
        answers: the importer's quantities at the states of its reading.
        states: gives the states of a model; of joints with one name and kind the same values.

    Returns:
        The causes, each with a sentence, or the differences of the descriptions where nothing is proved.

    """
    found = _explain(title, model, model, reading, answers, states)
    without = _without_missing(model, reading)
    if without is model or (found.is_proved and len(found.causes) == 1):
        return found
    left_out = _explain(title, without, model, reading, answers, states)
    is_simpler = len(left_out.causes) <= len(found.causes)  # of one length: the importer has no such body
    return left_out if left_out.is_proved and (is_simpler or not found.is_proved) else found


def _explain(
    title: str,
    start: NeutralModel,
    model: NeutralModel,
    reading: NeutralModel,
    answers: Sequence[ModelQuantities],
    states: States,
) -> Explanation:
    """Explain from a model that lacks bodies already, or is whole."""
    structure, moved = _with_joints_of(start, reading)
    if start is not model:
        read = {body.name for body in reading.bodies}
        left_out = [body for body in model.bodies if body.joints and body.name not in read]
        structure = [c for c in structure if c.body in read]
        structure += [Change(MISSING, body.name, "", body, None, body.source) for body in left_out]
    own, theirs = lump_fixed_bodies(moved), lump_fixed_bodies(reading)
    trial = _Trial(own, theirs, reading, answers, states, moved, bool(structure))
    changes = _single_parts(differences(own, theirs), moved, theirs)
    found = trial.first_that_explains(changes)
    if found is None:
        found = trial.smallest([*changes, *_finer(changes, differences(own, theirs, 0.0))])
    if found is None and len(own.bodies) < len(moved.bodies):
        # a fixed body that is elsewhere, though everything moves alike
        trial = _Trial(moved, reading, reading, answers, states, moved, bool(structure))
        found = trial.smallest(differences(moved, reading))
    if found is None:
        return Explanation(differences=(*structure, *changes))
    remaining = trial.remaining(found, len(answers))
    causes = _causes(title, [*structure, *found], remaining)
    return Explanation(causes, remaining, is_proved=True)


def _finer(changes: Sequence[Change], all_: Sequence[Change]) -> list[Change]:
    """Differences below `RELATIVE_CHANGE`, which count where the larger ones do not explain everything."""
    known = {(change.body, change.joint, change.field) for change in changes}
    carriers = {change.carrier for change in changes if change.also is not None}
    return [c for c in all_ if (c.body, c.joint, c.field) not in known and c.body not in carriers]


def _without_missing(model: NeutralModel, reading: NeutralModel) -> NeutralModel:
    """Take the mass from moving bodies that the importer does not have; the same object where it has all."""
    read = {body.name for body in reading.bodies}
    if all(body.name in read for body in model.bodies if body.joints):
        return model
    bodies, is_left_out = [], [False] * len(model.bodies)
    for k, body in enumerate(model.bodies):
        is_below = body.parent >= 0 and is_left_out[body.parent]
        is_left_out[k] = body.name not in read and (bool(body.joints) or is_below)
        empty = replace(body, mass=0.0, center=np.zeros(3), inertia=np.zeros((3, 3)))
        bodies.append(empty if is_left_out[k] else body)
    return replace(model, bodies=tuple(bodies))


def damping_cause(title: str, model: NeutralModel, reading: NeutralModel) -> Cause | None:
    """Compare the damping that an importer holds for the user's own forces and its engine does not apply.

    It enters no quantity: the proof is the number in the importer's own model.

    Args:
        title: name and version of the importer's engine, for the sentence.

    Returns:
        The joints whose damping differs; None where there are none.

    """
    read = {joint.name: joint.damping for joint in reading.joints}
    changes = [
        Change("damping", body.name, j.name, j.damping, read[j.name], j.fields.get("damping", j.source))
        for body in model.bodies
        for j in body.joints
        if j.name in read and _differs(j.damping, read[j.name], 0.0)
    ]
    if not changes:
        return None
    phrase = _describe(changes)
    return Cause("damping", tuple(changes), phrase, f"{title} {phrase}; its equations do not use it.")


def _with_joints_of(model: NeutralModel, reading: NeutralModel) -> tuple[list[Change], NeutralModel]:
    """Give each body the joints that the importer gives it; a body that it does not have is fixed."""
    read = {body.name: body.joints for body in reading.bodies}
    changes, bodies = [], []
    for body in model.bodies:
        theirs = read.get(body.name, ())
        if _kinds(body.joints) != _kinds(theirs) and not _are_free(body.joints, theirs):
            source = body.joints[0].source if body.joints else body.source
            changes.append(Change("joints", body.name, "", body.joints, theirs, source))
            body = replace(body, joints=theirs)
        bodies.append(body)
    return changes, replace(model, bodies=tuple(bodies))


def _single_parts(changes: Sequence[Change], model: NeutralModel, theirs: NeutralModel) -> list[Change]:
    """Replace changes of a lumped body's mass, centre and inertia by the one of its parts that makes them."""
    named = {body.name: body for body in theirs.bodies}
    found = list(changes)
    for name, parts in fixed_parts(model).items():
        inertial = [c for c in found if c.body == name and c.field in ("mass", "center", "inertia")]
        if not inertial:
            continue
        single = _single_part(parts, named[name])
        if single is not None:
            found = [single, *(c for c in found if c not in inertial)]
    return found


def _single_part(parts: Sequence[tuple[NeutralBody, Array, Array]], read: NeutralBody) -> Change | None:
    """The one part whose mass, centre or whole inertial explains a lumped body; None where there is none."""
    lumped = _merge(parts)
    also = {name: getattr(read, name) for name in ("mass", "center", "inertia")}
    if len(parts) > 2 and lumped.mass > parts[0][0].mass and _is_same_inertial(parts[0][0], read):
        fixed = [part for part, _, _ in parts[1:] if part.mass]
        names, carrier, mass = ", ".join(p.name for p in fixed), parts[0][0].name, sum(p.mass for p in fixed)
        return Change("inertial", names, "", mass, 0.0, fixed[0].source, also=also, carrier=carrier)
    for place, (part, _, A) in enumerate(parts):
        mass = part.mass + read.mass - lumped.mass
        trials: list[tuple[str, dict[str, Any]]] = [("mass", {"mass": mass})] if mass > 0 else []
        if part.mass:
            moment = read.mass * read.center - lumped.mass * lumped.center
            trials.append(("center", {"center": part.center + A.T @ moment / part.mass}))
        trials.append(("inertial", {"mass": 0.0, "center": np.zeros(3), "inertia": np.zeros((3, 3))}))
        for name, values in trials:
            changed = [*parts[:place], (replace(part, **values), *parts[place][1:]), *parts[place + 1 :]]
            if _is_same_inertial(_merge(changed), read):
                own, new = (part.mass, 0.0) if name == "inertial" else (getattr(part, name), values[name])
                source = part.fields.get(name, part.source)
                carrier = parts[0][0].name
                return Change(name, part.name, "", own, new, source, also=also, carrier=carrier)
    empty = [part for part, _, _ in parts if part.mass == 0 and not np.any(part.inertia)]
    unsaid = [part for part in empty if "mass" not in part.fields]  # without <inertial>
    for chosen in (empty, unsaid):
        given = [
            (replace(part, mass=1.0, inertia=np.eye(3)) if part in chosen else part, position, A)
            for part, position, A in parts
        ]
        if chosen and _is_same_inertial(_merge(given), read):
            return _default_inertial(DEFAULT_INERTIAL, chosen, 1.0, also, parts[0][0].name)
    if unsaid and read.mass > lumped.mass and _differs(read.mass, lumped.mass, 0.0):
        added = read.mass - lumped.mass
        return _default_inertial(ASSUMED_INERTIAL, unsaid, added, also, parts[0][0].name)
    massless = [part for part, _, _ in parts[1:] if part.mass == 0 and np.any(part.inertia)]
    kept = [entry for entry in parts if entry[0] not in massless]
    if massless and not _differs(_merge(kept).inertia, read.inertia, 0.0):
        names = ", ".join(part.name for part in massless)
        source, carrier = massless[0].fields.get("inertia", massless[0].source), parts[0][0].name
        return Change("inertial", names, "", 0.0, 0.0, source, also=also, carrier=carrier)
    return None


def _default_inertial(
    field: str, parts: Sequence[NeutralBody], mass: float, also: Mapping[str, Any], carrier: str
) -> Change:
    names = ", ".join(part.name for part in parts)
    return Change(field, names, "", 0.0, mass, parts[0].source, also=also, carrier=carrier)


def _is_same_inertial(one: NeutralBody, read: NeutralBody) -> bool:
    """Whether mass, centre of mass and inertia of two bodies are the same, but for rounding."""
    size = float(np.linalg.norm(one.center))
    return not (
        _differs(one.mass, read.mass, 0.0)
        or _differs(one.center, read.center, size)
        or _differs(one.inertia, read.inertia, 0.0)
    )


def _merge(parts: Sequence[tuple[NeutralBody, Array, Array]]) -> NeutralBody:
    body = parts[0][0]
    for added in parts[1:]:
        body = merge_bodies(body, *added)
    return body


def _are_free(*joints: Sequence[ElementaryJoint]) -> bool:
    return all([joint.kind for joint in one] == ["free"] for one in joints)


def _kinds(joints: Sequence[ElementaryJoint]) -> list[tuple[str, str]]:
    return [(joint.name, joint.kind) for joint in joints]


class _Trial:
    """Tries sets of changes against an importer's quantities."""

    def __init__(
        self,
        own: NeutralModel,
        theirs: NeutralModel,
        reading: NeutralModel,
        answers: Sequence[ModelQuantities],
        states: States,
        whole: NeutralModel,
        has_structure: bool,
    ) -> None:
        self.own, self.theirs, self.reading, self.answers, self.states = own, theirs, reading, answers, states
        self.has_structure = has_structure  # whether the own model has been given other joints already
        # of the model before it was lumped: what is fixed to the world and cancels there counts too
        self.placed = [pose_tolerances(whole, state) for state in states(whole)]
        # what was certified, by the changes' identities, which stay theirs while they are kept here
        self.tried: dict[
            tuple[int, ...], tuple[NeutralModel, list[CertifiedModelQuantities], Sequence[Change]]
        ] = {}
        self.tolerance: Mapping[str, Any] = {}  # at the first state, of the first changes that were certified

    def worst(self, changes: Sequence[Change], count: int) -> Mapping[str, Mismatch] | None:
        """Worst entries with the changes made; None where the joints still differ."""
        changed, truths = self.certified(changes, count)
        order = joint_permutation(changed, self.reading)
        if order is None:
            return None
        states = self.states(changed)[:count]
        still = {change.joint for change in changes if change.field == ARMATURE_ENERGY}
        truths = [_without_armature(changed, still, *pair) for pair in zip(states, truths, strict=True)]
        truths = [_with_placing(changed, changes, *pair) for pair in zip(states, truths, strict=True)]
        return mismatches(changed, truths, [permuted(one, order) for one in self.answers[:count]])

    def certified(
        self, changes: Sequence[Change], count: int
    ) -> tuple[NeutralModel, list[CertifiedModelQuantities]]:
        """Make changes and certify states, each once; poses within the bounds before bodies were lumped."""
        key = tuple(map(id, changes))
        if key not in self.tried:
            self.tried[key] = apply_changes(self.own, self.theirs, changes), [], changes
        changed, truths, _ = self.tried[key]
        if joint_permutation(changed, self.reading) is not None:
            new = slice(len(truths), count)
            pairs = zip(certify_states(changed, self.states(changed)[new]), self.placed[new], strict=True)
            truths += [_widened(*pair) for pair in pairs]
            if truths and not self.tolerance:
                self.tolerance = truths[0].tolerance
        return changed, truths[:count]

    def is_far(self, changes: Sequence[Change], with_poses: bool = True) -> bool:
        """Whether M, or a pose, at the first state is so far off that no certificate is needed."""
        if not self.tolerance:
            self.certified((), 1)
        changed, _ = self.certified(changes, 0)
        if not self.tolerance or self.tried[tuple(map(id, changes))][1]:
            return False
        order = joint_permutation(changed, self.reading)
        if order is None or len(order) != len(self.tolerance["mass_matrix"]):
            return False
        state = self.states(changed)[0]
        truth = CertifiedModelQuantities(rough_quantities(changed, state), self.tolerance)
        truth = _with_placing(changed, changes, state, truth)
        found = mismatches(changed, [truth], [permuted(self.answers[0], order)])
        return any(m.ratio > FAR for name, m in found.items() if with_poses or name == "mass_matrix")

    def smallest_with_omissions(self, changes: Sequence[Change]) -> list[Change] | None:
        """Try the changes alone, then with terms that the dynamics may leave out."""
        (changed, _), wrong = self.certified(changes, 0), self.wrong(changes)
        is_energy_only = "kinetic_energy" in wrong and wrong <= {"kinetic_energy", "position", "attitude"}
        omitted = energy_omissions(changed) if is_energy_only else omissions(changed)
        for size in range(MAX_OMISSIONS + 1):
            for chosen in combinations(omitted, size):
                found = self.smallest([*changes, *(change for group in chosen for change in group)])
                if found is not None:
                    return found
        return None

    def first_that_explains(self, changes: Sequence[Change]) -> list[Change] | None:
        """Try all changes, then without those of frames, then with the frames that are needed."""
        without_frames = [change for change in changes if change.field not in FRAME_FIELDS]
        bases = [changes]
        if len(without_frames) < len(changes):
            bases += [without_frames, self.with_needed_frames(changes)]
        return next((f for f in map(self.smallest_with_omissions, bases) if f is not None), None)

    def misplaced(self, changes: Sequence[Change]) -> float:
        """How many bodies are elsewhere at the first state, with the changes made."""
        changed, _ = self.certified(changes, 0)
        if joint_permutation(changed, self.reading) is None:
            return np.inf
        state = self.states(changed)[0]
        own, theirs = rough_quantities(changed, state).poses, self.answers[0].poses
        bounds = {
            b: np.maximum(X, self.placed[0].get(b, X)) for b, X in pose_tolerances(changed, state).items()
        }
        return sum(bool(np.any(np.abs(own[b] - theirs[b]) > bounds[b])) for b in own if b in theirs)

    def with_needed_frames(self, changes: Sequence[Change]) -> list[Change]:
        """Keep the changes of frames that put a body where the importer has it."""
        kept = [change for change in changes if change.field not in FRAME_FIELDS]
        count = self.misplaced(kept)
        for body in dict.fromkeys(c.body for c in changes if c.field in FRAME_FIELDS):
            more = [*kept, *(c for c in changes if c.body == body and c.field in FRAME_FIELDS)]
            if (fewer := self.misplaced(more)) < count:
                kept, count = more, fewer
        return kept

    def wrong_at_first(self, changes: Sequence[Change]) -> bool:
        """Whether more than poses is wrong at the first state, which is cheap to find out."""
        if self.is_far(changes, with_poses=False):
            return True
        found = self.worst(changes, 1)
        return found is None or any(
            m.ratio > 1 for name, m in found.items() if name not in ("position", "attitude")
        )

    def wrong(self, changes: Sequence[Change]) -> set[str]:
        """Quantities that are not reproduced with the changes made."""
        found = self.worst(changes, min(PRUNING_STATES, len(self.answers)))
        return {name for name, m in (found or {}).items() if m.ratio > 1}

    def has_wrong_poses_only(self, changes: Sequence[Change], count: int) -> bool:
        """Whether poses are wrong with the changes made, and nothing else."""
        found = self.worst(changes, count)
        wrong = {name for name, m in (found or {}).items() if m.ratio > 1}
        return bool(wrong) and wrong <= {"position", "attitude"}

    def slide_changes(self, changes: Sequence[Change], count: int) -> list[Change]:
        """Slides that put bodies at a multiple of their coordinates, as with an axis not of length one."""
        if not self.has_wrong_poses_only(changes, count):
            return []
        changed, truths = self.certified(changes, count)
        states, found = self.states(changed)[:count], []
        slices = {joint.name: x for joint, x, _ in changed.joint_slices()}
        for body in changed.bodies:
            if [joint.kind for joint in body.joints] != ["slide"]:
                continue
            (joint,) = body.joints
            axis = rotation_matrix(body.attitude) @ joint.axis
            moved = [float(state.coordinates[slices[joint.name]][0]) - joint.reference for state in states]
            places = [
                [_in_parent(changed, body, poses) for poses in (answer.poses, truth.quantities.poses)]
                for answer, truth in zip(self.answers, truths, strict=False)
            ]
            shifts = [float(axis @ (theirs - own)) for theirs, own in places]
            scale = 1 + float(np.dot(shifts, moved)) / max(float(np.dot(moved, moved)), TINY)
            if abs(scale - 1) > RELATIVE_CHANGE:
                source = joint.fields.get("axis", joint.source)
                found.append(Change(SLIDE_SCALE, body.name, joint.name, 1.0, scale, source))
        return found

    def origin_changes(self, changes: Sequence[Change], count: int) -> list[Change]:
        """Free bodies that are displaced by the same vector at every state, with all that they carry."""
        if not self.has_wrong_poses_only(changes, count):
            return []
        changed, truths = self.certified(changes, 1)
        own, theirs = truths[0].quantities.poses, self.answers[0].poses
        found = []
        for body in changed.bodies:
            if [joint.kind for joint in body.joints] == ["free"] and body.name in theirs:
                shift = theirs[body.name][:, 3] - own[body.name][:, 3]
                source, name = body.fields.get("position", body.source), body.joints[0].name
                found.append(Change(ORIGIN, body.name, name, np.zeros(3), shift, source))
        return found

    def frame_changes(self, changes: Sequence[Change], count: int) -> list[Change]:
        """Frames that lie elsewhere in their bodies, where nothing but poses is wrong."""
        if not self.has_wrong_poses_only(changes, count):
            return []
        changed, truths = self.certified(changes, count)
        frames = []
        for body in changed.bodies:
            pairs = [
                (truth.quantities.poses[body.name], answer.poses[body.name])
                for truth, answer in zip(truths, self.answers, strict=False)
                if body.name in answer.poses
            ]
            offsets = [
                _composed(np.column_stack([own[:, :3].T, -own[:, :3].T @ own[:, 3]]), theirs)
                for own, theirs in pairs
            ]
            if offsets and np.max(np.abs(offsets[0] - np.eye(3, 4))) > RELATIVE_CHANGE:
                source = body.fields.get("position", body.source)
                frames.append(Change(FRAME, body.name, "", np.eye(3, 4), offsets[0], source))
        return frames

    def remaining(self, changes: Sequence[Change], count: int) -> float:
        """Largest ratio of error and tolerance with the changes made."""
        found = self.worst(changes, count)
        return np.inf if found is None else max((m.ratio for m in found.values()), default=0.0)

    def fits(self, changes: Sequence[Change], count: int) -> bool:
        """Whether the changes reproduce everything; roughly at the first state alone first: most do not."""
        if self.is_far(changes):
            return False
        return self.remaining(changes, 1) <= 1 and (count == 1 or self.remaining(changes, count) <= 1)

    def smallest(self, changes: Sequence[Change]) -> list[Change] | None:
        """Drop the changes that are not needed; None where all together do not reproduce the quantities."""
        if self.wrong_at_first(changes):
            return None
        counts = dict.fromkeys((min(PRUNING_STATES, len(self.answers)), len(self.answers)))
        found = (self._pruned(changes, count) for count in counts)  # what few states do not need, others may
        return next((one for one in found if one is not None), None)

    def _pruned(self, changes: Sequence[Change], count: int) -> list[Change] | None:
        """Drop the changes that ``count`` states do not need; None where the rest does not fit all states."""
        needed = list(changes)
        if self.remaining(needed, count) > 1:
            placed = ([*needed, *find(needed, count)] for find in (self.slide_changes, self.origin_changes))
            fitting = (p for p in placed if len(p) > len(needed) and self.remaining(p, count) <= 1)
            needed = next(fitting, []) or [*needed, *self.frame_changes(needed, count)]
        if not (needed or self.has_structure) or not self.fits(needed, count):
            return None
        for body in dict.fromkeys(change.body for change in changes if change.field in FRAME_FIELDS):
            rest = [c for c in needed if not (c.body == body and c.field in FRAME_FIELDS)]
            if self.fits(rest, count):
                needed = rest
        for field in dict.fromkeys(change.field for change in changes):
            rest = [change for change in needed if change.field != field]
            if self.fits(rest, count):
                needed = rest
        for field in dict.fromkeys(change.field for change in needed):
            members = [change for change in needed if change.field == field]
            if 1 < len(members) <= MAX_SINGLE_TRIALS:
                for member in members:
                    rest = [change for change in needed if change is not member]
                    if self.fits(rest, count):
                        needed = rest
        is_some = bool(needed) or self.has_structure
        return needed if is_some and self.fits(needed, len(self.answers)) else None


def _widened(truth: CertifiedModelQuantities, placed: Mapping[str, Array]) -> CertifiedModelQuantities:
    poses = {
        body: np.maximum(bound, placed[body]) if body in placed else bound
        for body, bound in truth.tolerance["poses"].items()
    }
    return replace(truth, tolerance={**truth.tolerance, "poses": poses})


def _with_placing(
    model: NeutralModel, changes: Sequence[Change], state: CanonicalState, truth: CertifiedModelQuantities
) -> CertifiedModelQuantities:
    """Poses with slides scaled, free bodies displaced, and frames elsewhere in their bodies: X → X Y."""
    offsets = {change.body: change.theirs for change in changes if change.field == FRAME}
    scales = {change.joint: change.theirs for change in changes if change.field == SLIDE_SCALE}
    shifts = {change.body: change.theirs for change in changes if change.field == ORIGIN}
    if not offsets and not scales and not shifts:
        return truth
    poses = truth.quantities.poses
    if scales:
        x = state.coordinates.copy()
        for joint, places, _ in model.joint_slices():
            x[places] += (scales.get(joint.name, 1.0) - 1) * (x[places] - joint.reference)
        poses = rough_quantities(model, replace(state, coordinates=x)).poses
    by: dict[str, Array] = {}
    for body in model.bodies:
        above = by[model.bodies[body.parent].name] if body.parent >= 0 else np.zeros(3)
        by[body.name] = shifts.get(body.name, above)
    poses = {name: np.column_stack([X[:, :3], X[:, 3] + by[name]]) for name, X in poses.items()}
    poses = {body: _composed(X, offsets[body]) if body in offsets else X for body, X in poses.items()}
    return replace(truth, quantities=replace(truth.quantities, poses=poses))


def _in_parent(model: NeutralModel, body: NeutralBody, poses: Mapping[str, Array]) -> Array:
    """Where a body's origin is in its parent; zero where a pose is missing."""
    parent = poses.get(model.bodies[body.parent].name) if body.parent >= 0 else np.eye(3, 4)
    if parent is None or body.name not in poses:
        return np.zeros(3)
    return np.asarray(parent[:, :3].T @ (poses[body.name][:, 3] - parent[:, 3]), float)


def _composed(pose: Array, offset: Array) -> Array:
    R, p = pose[:, :3], pose[:, 3]
    return np.column_stack([R @ offset[:, :3], p + R @ offset[:, 3]])


def _without_armature(
    model: NeutralModel, names: set[str], state: CanonicalState, truth: CertifiedModelQuantities
) -> CertifiedModelQuantities:
    """The kinetic energy without the armature of the named joints."""
    energy = truth.quantities.kinetic_energy
    assert energy is not None
    for joint, _, v in model.joint_slices():
        if joint.name in names:
            energy -= joint.armature * float(state.velocities[v] @ state.velocities[v]) / 2
    return replace(truth, quantities=replace(truth.quantities, kinetic_energy=energy))


def differences(
    own: NeutralModel, theirs: NeutralModel, least: float = RELATIVE_CHANGE, has_rest_poses: bool = False
) -> list[Change]:
    """List the parameters in which two descriptions differ by more than rounding.

    Args:
        own: the neutral model, fixed bodies lumped.
        theirs: an importer's description, fixed bodies lumped.
        least: relative difference from which on two numbers differ.
        has_rest_poses: whether poses of free bodies count, which are coordinates of their joints.

    Returns:
        The changes that turn the first into the second; the structure of bodies and joints first.

    """
    found: list[Change] = []
    if _differs(own.gravity, theirs.gravity, 0.0, least):
        found.append(Change("gravity", "", "", own.gravity, theirs.gravity, own.gravity_source))
    named = {body.name: body for body in theirs.bodies}
    size = max((float(np.linalg.norm(body.position)) for body in own.bodies), default=0.0)
    parents = [_parent_names(model) for model in (own, theirs)]
    for body in own.bodies:
        other = named.get(body.name)
        if other is None:
            continue
        if parents[0][body.name] != parents[1][body.name]:
            names = parents[0][body.name], parents[1][body.name]
            found.append(Change("parent", body.name, "", *names, body.source))
        found += _joint_changes(body, other, size, least)
        for field in BODY_FIELDS:
            values = getattr(body, field), getattr(other, field)
            scale = size if field in ("position", "center") else 0.0
            is_free = bool(body.joints) and body.joints[0].kind == "free"
            if field in ("position", "attitude") and is_free and not has_rest_poses:
                is_different = False  # a free joint's coordinates are those of the body frame
            elif field == "attitude":
                is_different = _differs(rotation_matrix(values[0]), rotation_matrix(values[1]), 0.0, least)
            else:
                is_different = _differs(*values, scale, least)
            if is_different and not (field == "center" and body.mass == 0 == other.mass):
                found.append(Change(field, body.name, "", *values, body.fields.get(field, body.source)))
    own_names = {body.name for body in own.bodies}
    extra = [body for body in theirs.bodies if body.name not in own_names]
    return [Change("additional body", b.name, "", None, b, Source("", 0)) for b in extra] + found


def describe_difference(own: NeutralModel, theirs: NeutralModel) -> str:
    """Describe the first parameter in which two readings of equivalent files differ.

    Args:
        theirs: of the rewritten file, with the names of the first.

    Returns:
        A clause; empty where they differ by rounding only.

    """
    named = {body.name: body for body in theirs.bodies}
    for body in own.bodies:
        if body.name not in named:
            return f"there is no body {body.name}"
        kinds = [_joint_words(b.joints) for b in (named[body.name], body)]
        if kinds[0] != kinds[1]:
            return f"the joints of body {body.name} are {kinds[0]}, as written {kinds[1]}"
    changes = differences(own, theirs, has_rest_poses=True)
    if not changes:
        return ""
    first, word = changes[0], FIELD_WORDS.get(changes[0].field, changes[0].field)
    if first.field == "additional body":
        return f"there is another body, {first.body}"
    values = format_value(first.theirs, first.own), format_value(first.own, first.theirs)
    more = f" ({len(changes)} parameters differ)" if len(changes) > 1 else ""
    return f"the {word} of {first.owner} is {values[0]}, as written {values[1]}{more}"


def _parent_names(model: NeutralModel) -> dict[str, str]:
    return {b.name: model.bodies[b.parent].name if b.parent >= 0 else "world" for b in model.bodies}


def _differs(own: Any, theirs: Any, scale: float, least: float = RELATIVE_CHANGE) -> bool:
    a, b = np.asarray(own, float), np.asarray(theirs, float)
    size = max(float(np.max(np.abs(a))), float(np.max(np.abs(b))), scale)
    return bool(np.max(np.abs(a - b)) > least * size)


def _joint_changes(body: NeutralBody, other: NeutralBody, size: float, least: float) -> list[Change]:
    """Differences of the joints of one body."""
    found = []
    for joint, read in zip(body.joints, other.joints, strict=True):
        for field in JOINT_FIELDS:
            values = getattr(joint, field), getattr(read, field)
            if field == "spring_reference" and joint.stiffness == 0 == read.stiffness:
                continue
            if field == "anchor":
                is_different = _differs(_across(joint), _across(read), size, least)
            else:
                is_different = _differs(*values, 0.0, least)
            if is_different:
                source = joint.fields.get(field, joint.source)
                found.append(Change(field, body.name, joint.name, *values, source))
    return found


def _across(joint: ElementaryJoint) -> Array:
    """The anchor without its part along a hinge's axis, which moves nothing."""
    if joint.kind != "hinge":
        return np.asarray(joint.anchor, float)
    return np.asarray(joint.anchor - joint.axis * float(joint.axis @ joint.anchor), float)


def omissions(model: NeutralModel) -> list[list[Change]]:
    """List terms of a model that an engine's dynamics may leave out, per field all joints together.

    Args:
        model: a model, fixed bodies lumped.

    Returns:
        Groups of changes that set the field to zero.

    """
    groups = []
    for field in OMITTED_FIELDS:
        group = [
            Change(
                field,
                body.name,
                joint.name,
                value,
                0.0,
                joint.fields.get(field, joint.source),
                is_omitted=True,
            )
            for body in model.bodies
            for joint in body.joints
            if (value := getattr(joint, field))
        ]
        groups += [group] if group else []
    if np.any(model.gravity):
        groups.append(
            [Change("gravity", "", "", model.gravity, np.zeros(3), model.gravity_source, is_omitted=True)]
        )
    return groups


def energy_omissions(model: NeutralModel) -> list[list[Change]]:
    """List armatures that a kinetic energy may leave out, by joints along coordinate axes and alone or not.

    Args:
        model: a model, fixed bodies lumped.

    Returns:
        Groups of changes, a change per joint with an armature.

    """
    groups: dict[tuple[bool, bool], list[Change]] = {}
    for body in model.bodies:
        for joint in body.joints:
            if joint.armature:
                source = joint.fields.get("armature", joint.source)
                change = Change(
                    ARMATURE_ENERGY, body.name, joint.name, joint.armature, 0.0, source, is_omitted=True
                )
                is_aligned = bool(np.max(joint.axis) == 1)  # engines have own joint types for these
                groups.setdefault((is_aligned, len(body.joints) > 1), []).append(change)
    return list(groups.values())


def apply_changes(own: NeutralModel, theirs: NeutralModel, changes: Sequence[Change]) -> NeutralModel:
    """Make changes in a model.

    Args:
        own: the neutral model, fixed bodies lumped.
        theirs: the importer's description, from which additional bodies are taken.
        changes: of `differences` and `omissions`.

    """
    bodies = {body.name: body for body in own.bodies}
    parents = _parent_names(own) | {
        c.body: _parent_names(theirs)[c.body] for c in changes if c.field == "additional body"
    }
    gravity = own.gravity
    for change in changes:
        if change.field in (ARMATURE_ENERGY, FRAME, SLIDE_SCALE, ORIGIN):
            continue
        if change.field == "gravity":
            gravity = change.theirs
        elif change.field == "additional body":
            bodies[change.body] = change.theirs
        elif change.field == "parent":
            parents[change.body] = change.theirs
        elif change.joint:
            body = bodies[change.body]
            joints = tuple(
                replace(joint, **{change.field: change.theirs}) if joint.name == change.joint else joint
                for joint in body.joints
            )
            bodies[change.body] = replace(body, joints=joints)
        else:
            name = change.carrier or change.body
            bodies[name] = replace(bodies[name], **(change.also or {change.field: change.theirs}))
    return replace(own, bodies=_ordered(bodies, parents), gravity=gravity)


def _ordered(bodies: Mapping[str, NeutralBody], parents: Mapping[str, str]) -> tuple[NeutralBody, ...]:
    """Bodies with the indices of their parents, parents first; without a parent: on the world."""
    placed: dict[str, int] = {}
    found: list[NeutralBody] = []
    waiting = list(bodies.values())
    while waiting:
        ready = [b for b in waiting if parents[b.name] in placed or parents[b.name] not in bodies]
        for body in ready or waiting[:1]:
            placed[body.name] = len(found)
            found.append(replace(body, parent=placed.get(parents[body.name], -1)))
        done = {body.name for body in found}
        waiting = [body for body in waiting if body.name not in done]
    return tuple(found)


def _causes(title: str, changes: Sequence[Change], remaining: float) -> tuple[Cause, ...]:
    """Group the changes by field and write a sentence about each group."""
    groups: dict[tuple[str, bool], list[Change]] = {}
    for change in changes:
        groups.setdefault((change.field, change.is_omitted), []).append(change)
    alone = len(groups) == 1
    found = []
    for (field, _), members in groups.items():
        proof = "this alone explains" if alone else f"with the other {len(groups) - 1} it explains"
        phrase = _describe(members)
        sentence = f"{title} {phrase}; {proof} every quantity (worst {remaining:.2g} of the rounding)."
        found.append(Cause(field, tuple(members), phrase, sentence))
    return tuple(found)


def _describe(members: Sequence[Change]) -> str:
    """What an importer does to one field, as a verb phrase."""
    first, word = members[0], FIELD_WORDS.get(members[0].field, members[0].field)
    if first.field == FRAME:
        shift = format_value(first.theirs[:, 3], np.zeros(3))
        return (
            f"puts the frame of {len(members)} bodies ({_names(members)}) elsewhere in the body, that of "
            f"{first.body} at {shift} ({first.source}), which moves no mass"
        )
    if first.field == ORIGIN:
        shift = format_value(first.theirs, np.zeros(3))
        return (
            f"counts the coordinates of the free joint of body {first.body} from {shift} and not from the "
            f"world's origin ({first.source}), so that all its bodies are displaced"
        )
    if first.field == SLIDE_SCALE:
        slides = f"slide {first.joint}" if len(members) == 1 else f"{len(members)} slides ({_names(members)})"
        return (
            f"multiplies the coordinate of {slides} by the length of its axis where it places bodies, "
            f"that of {first.joint} by {format_value(first.theirs, 1.0)} ({first.source}), but not in its "
            "equations"
        )
    if first.field == DEFAULT_INERTIAL:
        names = "; ".join(f"{change.body} ({change.source})" for change in members[:6])
        return f"gives 1 kg and an inertia of 1 kg m² to bodies without mass: {names}"
    if first.field == ASSUMED_INERTIAL:
        names = "; ".join(f"{change.body} ({change.source})" for change in members[:6])
        mass = sum(change.theirs for change in members)
        return f"gives {mass:.6g} kg in all to bodies without <inertial>: {names}"
    if first.field == MISSING:
        names = ", ".join(f"{change.body} ({change.source})" for change in members[:6])
        more = " …" if len(members) > 6 else ""
        what = "the body" if len(members) == 1 else f"{len(members)} bodies with their joints and masses:"
        return f"leaves out {what} {names}{more}"
    if first.field == "additional body":
        names = ", ".join(change.body for change in members[:6])
        return f"adds {'body' if len(members) == 1 else 'bodies'} {names}"
    if first.field == "inertial":
        names = ", ".join(f"{change.body} ({change.own:.4g} kg, {change.source})" for change in members[:6])
        what = "mass and inertia" if first.own else "inertia"
        where = "" if first.body == first.carrier else f", fixed to body {first.carrier}"
        return f"leaves out the {what} of {names}{where}"
    if first.field == "joints":
        return "; ".join(
            f"reads the joints of body {c.body} as {_joint_words(c.theirs)}; "
            f"the file says {_joint_words(c.own)} ({c.source})"
            for c in members[:3]
        )
    if first.field == ARMATURE_ENERGY:
        owners = first.owner if len(members) == 1 else f"{len(members)} joints ({_names(members)})"
        return f"leaves the armature of {owners} out of its kinetic energy ({first.source})"
    if first.is_omitted:
        owners = first.owner if len(members) == 1 else f"{len(members)} joints ({_names(members)})"
        return f"holds the {word} of {owners} but leaves it out of its equations ({first.source})"
    if len(members) == 1:
        own, theirs = format_value(first.own, first.theirs), format_value(first.theirs, first.own)
        return f"reads the {word} of {first.owner} as {theirs}; the file says {own} ({first.source})"
    values = {format_value(change.theirs, change.own) for change in members}
    as_ = f"as {values.pop()}" if len(values) == 1 else "otherwise"
    kind = "joints" if first.joint else "bodies"
    own, theirs = format_value(first.own, first.theirs), format_value(first.theirs, first.own)
    return (
        f"reads the {word} of {len(members)} {kind} {as_} ({_names(members)}); "
        f"of {first.owner} the file says {own} ({first.source}), it reads {theirs}"
    )


def _names(members: Sequence[Change]) -> str:
    names = [change.joint or change.body for change in members]
    return ", ".join(names[:4]) + (" …" if len(names) > 4 else "")


def _joint_words(joints: Sequence[ElementaryJoint]) -> str:
    return ", ".join(f"{joint.kind} {joint.name}" for joint in joints) or "none (fixed)"


def format_value(value: Any, other: Any) -> str:
    """Write a value with as many digits as it needs to differ from another one.

    Args:
        value: a number, an array or a text.
        other: the value that it is compared with.

    """
    if isinstance(value, str):
        return value
    a, b = np.asarray(value, float), np.asarray(other, float)
    for digits in (4, 7, 10, 13, 17):
        if a.shape != b.shape or _text(a, digits) != _text(b, digits):
            break
    return _text(a, digits)


def _text(a: Array, digits: int) -> str:
    if a.ndim == 0:
        return f"{float(a) + 0.0:.{digits}g}"  # no negative zero
    return "(" + ", ".join(_text(part, digits) for part in a) + ")"
