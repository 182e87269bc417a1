"""Which parameter an importer reads otherwise than the file says, proved.

Candidates are the differences between the importer's own description and the neutral model, fixed bodies
lumped in both, and terms that the description has but the dynamics may leave out.  A set of changes is a
cause only where the changed neutral model reproduces every quantity of the importer within its tolerance;
then groups of changes (one field of several joints or bodies) and single changes that are not needed are
dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from plumbline.importers.lumping import Part, fixed_parts, lump_fixed_bodies, merge_bodies
from plumbline.importers.neutral_model import CanonicalState, ModelQuantities, NeutralBody, NeutralModel
from plumbline.model.datatypes import Array
from plumbline.model.grouping import grouped
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
from plumbline.model_files.parameter_changes import (
    ARMATURE_ENERGY,
    ASSUMED_INERTIAL,
    DEFAULT_INERTIAL,
    FRAME,
    MISSING,
    ORIGIN,
    RELATIVE_CHANGE,
    SLIDE_SCALE,
    TURNED_ARMATURE,
    Change,
    apply_changes,
    change_of,
    describe_changes,
    differences,
    differs,
    energy_omissions,
    joint_kinds,
    omissions,
)

FRAME_FIELDS = ("position", "attitude", "anchor", "reference")  # which may describe one pose in several ways
INERTIAL_FIELDS = ("mass", "center", "inertia")
POSES = {"position", "attitude"}  # quantities
MAX_OMISSIONS = 4
FAR = 1e4  # times the bound of rounding: changes that leave so much are not worth a certificate
MAX_SINGLE_TRIALS = 40  # changes of one field that are tried one by one
PRUNING_STATES = 3
OTHER_JOINTS = {"joints": Mismatch(np.inf, 0.0, np.inf, 0, "")}
States = Callable[[NeutralModel], Sequence[CanonicalState]]


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
    if without is model or (found.is_proved and len(found.causes) == 1 and not _is_gone(found, answers)):
        return found
    left_out = _explain(title, without, model, reading, answers, states)
    is_simpler = len(left_out.causes) <= len(found.causes)  # of one length: the importer has no such body
    return left_out if left_out.is_proved and (is_simpler or not found.is_proved) else found


def _is_gone(found: Explanation, answers: Sequence[ModelQuantities]) -> bool:
    """Whether bodies that a cause says to be fixed are nowhere among the importer's."""
    changes = [change for cause in found.causes if cause.field == "joints" for change in cause.changes]
    return any(change.body not in answers[0].poses for change in changes)


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
        structure += [change_of(MISSING, body, None, body, None) for body in left_out]
    own, theirs = lump_fixed_bodies(moved), lump_fixed_bodies(reading)
    trial = _Trial(own, theirs, reading, answers, states, moved, bool(structure))
    changes = _single_parts(differences(own, theirs), moved, theirs)
    found = trial.first_that_explains(changes)
    if found is None:
        found = trial.smallest([*changes, *_finer(changes, differences(own, theirs, 0.0))])
    masses = [change for change in changes if change.field in ("mass", "inertial")]
    if found is None and masses and trial.fits(masses, len(answers)):
        found = masses  # which no quantity depends on, as on an upright axis through the centre of mass
    if found is None and len(own.bodies) < len(moved.bodies):
        # a fixed body that is elsewhere, though everything moves alike
        trial = _Trial(moved, reading, reading, answers, states, moved, bool(structure))
        found = trial.smallest(differences(moved, reading))
    if found is None:
        return Explanation(differences=(*structure, *changes))
    causes = _causes(title, [*structure, *found], trial.remaining(found, len(answers)))
    return Explanation(causes, is_proved=True)


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
        change_of("damping", body, joint, joint.damping, read[joint.name])
        for body in model.bodies
        for joint in body.joints
        if joint.name in read and differs(joint.damping, read[joint.name])
    ]
    if not changes:
        return None
    phrase = describe_changes(changes)
    return Cause("damping", tuple(changes), phrase, f"{title} {phrase}; its equations do not use it.")


def _with_joints_of(model: NeutralModel, reading: NeutralModel) -> tuple[list[Change], NeutralModel]:
    """Give each body the joints that the importer gives it; a body that it does not have is fixed."""
    read = {body.name: body.joints for body in reading.bodies}
    changes, bodies = [], []
    for body in model.bodies:
        theirs = read.get(body.name, ())
        kinds = [joint_kinds(joints) for joints in (body.joints, theirs)]
        are_free = all([kind for _, kind in one] == ["free"] for one in kinds)
        if kinds[0] != kinds[1] and not are_free:
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
        inertial = [c for c in found if c.body == name and c.field in INERTIAL_FIELDS]
        single = _single_part(parts, named[name]) if inertial else None
        if single is not None:
            found = [single, *(c for c in found if c not in inertial)]
    return found


def _single_part(parts: Sequence[Part], read: NeutralBody) -> Change | None:
    """The parts whose mass, centre or whole inertial explains a lumped body; None: there are none."""
    also = {name: getattr(read, name) for name in INERTIAL_FIELDS}
    for field, changed, own, theirs, bodies in _part_changes(parts, read):
        if bodies is None or _is_same_inertial(_merge(bodies), read):
            source = changed[0].fields.get(field, changed[0].source)
            names, carrier = ", ".join(part.name for part in changed), parts[0][0].name
            return Change(field, names, "", own, theirs, source, also=also, carrier=carrier)
    return None


def _part_changes(
    parts: Sequence[Part], read: NeutralBody
) -> Iterator[tuple[str, list[NeutralBody], Any, Any, Sequence[Part] | None]]:
    """What may have been read of the parts: field, parts, both values, and the parts then (None: any)."""
    lumped, bodies = _merge(parts), [part for part, _, _ in parts]

    def with_values(chosen: Sequence[NeutralBody], **values: Any) -> list[Part]:
        return [(replace(p, **values) if p in chosen else p, place, A) for p, place, A in parts]

    empty = {"mass": 0.0, "center": np.zeros(3), "inertia": np.zeros((3, 3))}
    fixed = [part for part in bodies[1:] if part.mass]
    if len(parts) > 2 and fixed and lumped.mass > bodies[0].mass:
        yield "inertial", fixed, sum(part.mass for part in fixed), 0.0, parts[:1]
    for part, _, A in parts:
        mass = part.mass + read.mass - lumped.mass
        if mass > 0:
            yield "mass", [part], part.mass, mass, with_values([part], mass=mass)
        if part.mass:
            moment = read.mass * read.center - lumped.mass * lumped.center
            center = part.center + A.T @ moment / part.mass
            yield "center", [part], part.center, center, with_values([part], center=center)
        yield "inertial", [part], part.mass, 0.0, with_values([part], **empty)
    massless = [part for part in bodies if part.mass == 0 and not np.any(part.inertia)]
    unsaid = [part for part in massless if "mass" not in part.fields]  # without <inertial>
    for chosen in (massless, unsaid):
        if chosen:
            yield DEFAULT_INERTIAL, chosen, 0.0, 1.0, with_values(chosen, mass=1.0, inertia=np.eye(3))
    if unsaid and read.mass > lumped.mass and differs(read.mass, lumped.mass):
        yield ASSUMED_INERTIAL, unsaid, 0.0, read.mass - lumped.mass, None
    turning = [part for part in bodies[1:] if part.mass == 0 and np.any(part.inertia)]
    if turning:
        yield "inertial", turning, 0.0, 0.0, [place for place in parts if place[0] not in turning]


def _is_same_inertial(one: NeutralBody, read: NeutralBody) -> bool:
    """Whether mass, centre of mass and inertia of two bodies are the same, but for rounding."""
    scales = zip(INERTIAL_FIELDS, (0.0, float(np.linalg.norm(one.center)), 0.0), strict=True)
    return not any(differs(getattr(one, field), getattr(read, field), scale) for field, scale in scales)


def _merge(parts: Sequence[Part]) -> NeutralBody:
    body = parts[0][0]
    for added in parts[1:]:
        body = merge_bodies(body, *added)
    return body


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
        # what was certified, by the changes themselves: two with the same content are two
        self.tried: dict[tuple[Change, ...], tuple[NeutralModel, list[CertifiedModelQuantities]]] = {}
        self.tolerance: Mapping[str, Any] = {}  # at the first state, of the first changes that were certified
        self.few = min(PRUNING_STATES, len(answers))

    def certified(
        self, changes: Sequence[Change], count: int
    ) -> tuple[NeutralModel, list[CertifiedModelQuantities]]:
        """Make changes and certify states, each once; poses within the bounds before bodies were lumped."""
        key = tuple(changes)
        if key not in self.tried:
            self.tried[key] = apply_changes(self.own, self.theirs, changes), []
        changed, truths = self.tried[key]
        if joint_permutation(changed, self.reading) is not None:
            new = slice(len(truths), count)
            pairs = zip(certify_states(changed, self.states(changed)[new]), self.placed[new], strict=True)
            truths += [_widened(*pair) for pair in pairs]
            if truths and not self.tolerance:
                self.tolerance = truths[0].tolerance
        return changed, truths[:count]

    def worst(
        self, changes: Sequence[Change], count: int, truths: Sequence[CertifiedModelQuantities] | None = None
    ) -> Mapping[str, Mismatch]:
        """Worst entries with the changes made, by default against certified values."""
        changed, certified = self.certified(changes, 0 if truths else count)
        order = joint_permutation(changed, self.reading)
        if order is None:
            return OTHER_JOINTS
        pairs = list(zip(self.states(changed)[:count], truths or certified, strict=True))
        shown = [_as_shown(changed, changes, state, truth) for state, truth in pairs]
        return mismatches(changed, shown, [permuted(one, order) for one in self.answers[:count]])

    def remaining(self, changes: Sequence[Change], count: int) -> float:
        """Largest ratio of error and tolerance with the changes made."""
        return max((m.ratio for m in self.worst(changes, count).values()), default=0.0)

    def wrong(self, changes: Sequence[Change], count: int) -> set[str]:
        """Quantities that are not reproduced with the changes made."""
        return {name for name, m in self.worst(changes, count).items() if m.ratio > 1}

    def is_far(self, changes: Sequence[Change], with_poses: bool = True) -> bool:
        """Whether M, or a pose, at the first state is so far off that no certificate is needed."""
        if not self.tolerance:
            self.certified((), 1)
        changed, _ = self.certified(changes, 0)
        if not self.tolerance or self.tried[tuple(changes)][1]:
            return False
        order = joint_permutation(changed, self.reading)
        if order is None or len(order) != len(self.tolerance["mass_matrix"]):
            return False
        rough = rough_quantities(changed, self.states(changed)[0])
        found = self.worst(changes, 1, [CertifiedModelQuantities(rough, self.tolerance)])
        return any(m.ratio > FAR for name, m in found.items() if with_poses or name == "mass_matrix")

    def fits(self, changes: Sequence[Change], count: int) -> bool:
        """Whether the changes reproduce everything; roughly at the first state alone first: most do not."""
        return not self.is_far(changes) and all(self.remaining(changes, n) <= 1 for n in {1, count})

    def first_that_explains(self, changes: Sequence[Change]) -> list[Change] | None:
        """Try all changes, then without those of frames, then with the frames that are needed."""
        without_frames = [change for change in changes if change.field not in FRAME_FIELDS]
        bases = [changes]
        if len(without_frames) < len(changes):
            bases += [without_frames, self.with_needed_frames(changes)]
        return next((f for f in map(self.smallest_with_omissions, bases) if f is not None), None)

    def with_needed_frames(self, changes: Sequence[Change]) -> list[Change]:
        """Keep the changes of frames that put a body where the importer has it."""
        kept = [change for change in changes if change.field not in FRAME_FIELDS]
        count = self.misplaced(kept)
        for frames in _by_body(changes):
            if (fewer := self.misplaced([*kept, *frames])) < count:
                kept, count = [*kept, *frames], fewer
        return kept

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

    def smallest_with_omissions(self, changes: Sequence[Change]) -> list[Change] | None:
        """Try the changes alone, then with terms that the dynamics may leave out."""
        (changed, _), wrong = self.certified(changes, 0), self.wrong(changes, self.few)
        is_energy_only = "kinetic_energy" in wrong and wrong <= {"kinetic_energy", *POSES}
        omitted = energy_omissions(changed) if is_energy_only else omissions(changed)
        for size in range(MAX_OMISSIONS + 1):
            for chosen in combinations(omitted, size):
                found = self.smallest([*changes, *(change for group in chosen for change in group)])
                if found is not None:
                    return found
        return None

    def smallest(self, changes: Sequence[Change]) -> list[Change] | None:
        """Drop the changes that are not needed; None where all together do not reproduce the quantities."""
        if self.is_far(changes, with_poses=False) or self.wrong(changes, 1) - POSES:
            return None
        counts = dict.fromkeys((self.few, len(self.answers)))
        found = (self._pruned(changes, count) for count in counts)  # what few states do not need, others may
        return next((one for one in found if one is not None), None)

    def _pruned(self, changes: Sequence[Change], count: int) -> list[Change] | None:
        """Drop the changes that ``count`` states do not need; None where the rest does not fit all states."""
        needed = list(changes)
        wrong = self.wrong(needed, count)
        if wrong and wrong <= POSES:
            needed = self.with_placings(needed, count)
        if not self.is_enough(needed, count):
            return None
        for groups in (_by_body(changes), grouped(changes, _field).values()):
            needed = self.without_unneeded(needed, groups, count)
        several = [g for g in grouped(needed, _field).values() if 1 < len(g) <= MAX_SINGLE_TRIALS]
        needed = self.without_unneeded(needed, ([change] for group in several for change in group), count)
        return needed if self.is_enough(needed, len(self.answers)) else None

    def is_enough(self, changes: Sequence[Change], count: int) -> bool:
        """Whether there is a change, of structure or another one, and everything is reproduced."""
        return (bool(changes) or self.has_structure) and self.fits(changes, count)

    def without_unneeded(
        self, changes: list[Change], groups: Iterable[Sequence[Change]], count: int
    ) -> list[Change]:
        """Drop each group of changes without which everything is still reproduced."""
        for group in groups:
            rest = [change for change in changes if change not in group]
            if len(rest) < len(changes) and self.fits(rest, count):
                changes = rest
        return changes

    def with_placings(self, changes: list[Change], count: int) -> list[Change]:
        """Add what changes poses alone: scaled slides or displaced free bodies, else frames elsewhere."""
        changed, truths = self.certified(changes, count)
        pairs = [(t.quantities.poses, a.poses) for t, a in zip(truths, self.answers, strict=False)]
        for found in (self._slides(changed, pairs), _origins(changed, pairs)):
            if found and self.remaining([*changes, *found], count) <= 1:
                return [*changes, *found]
        return [*changes, *_frames(changed, pairs)]

    def _slides(self, model: NeutralModel, pairs: Sequence[_Poses]) -> list[Change]:
        """Slides that put bodies at a multiple of their coordinates, as with an axis not of length one."""
        states, found = self.states(model)[: len(pairs)], []
        slices = {joint.name: x for joint, x, _ in model.joint_slices()}
        for body in model.bodies:
            if [joint.kind for joint in body.joints] != ["slide"]:
                continue
            (joint,) = body.joints
            axis = rotation_matrix(body.attitude) @ joint.axis
            moved = [float(state.coordinates[slices[joint.name]][0]) - joint.reference for state in states]
            places = [[_in_parent(model, body, poses) for poses in pair] for pair in pairs]
            shifts = [float(axis @ (theirs - own)) for own, theirs in places]
            scale = 1 + float(np.dot(shifts, moved)) / max(float(np.dot(moved, moved)), TINY)
            if abs(scale - 1) > RELATIVE_CHANGE:
                found.append(change_of(SLIDE_SCALE, body, joint, 1.0, scale, "axis"))
        return found


_Poses = tuple[Mapping[str, Array], Mapping[str, Array]]  # at one state: as changed, and the importer's


def _origins(model: NeutralModel, pairs: Sequence[_Poses]) -> list[Change]:
    """Free bodies that are displaced by the same vector at every state, with all that they carry."""
    own, theirs = pairs[0]
    found = []
    for body in model.bodies:
        if [joint.kind for joint in body.joints] == ["free"] and body.name in theirs:
            shift, name = theirs[body.name][:, 3] - own[body.name][:, 3], body.joints[0].name
            change = change_of(ORIGIN, body, None, np.zeros(3), shift, "position")
            found.append(replace(change, joint=name))
    return found


def _frames(model: NeutralModel, pairs: Sequence[_Poses]) -> list[Change]:
    """Frames that lie elsewhere in their bodies."""
    found = []
    for body in model.bodies:
        both = [(own[body.name], theirs[body.name]) for own, theirs in pairs if body.name in theirs]
        if not both:
            continue
        R, p = both[0][0][:, :3], both[0][0][:, 3]
        offset = _composed(np.column_stack([R.T, -R.T @ p]), both[0][1])
        if np.max(np.abs(offset - np.eye(3, 4))) > RELATIVE_CHANGE:
            found.append(change_of(FRAME, body, None, np.eye(3, 4), offset, "position"))
    return found


def _field(change: Change) -> str:
    return change.field


def _by_body(changes: Sequence[Change]) -> list[list[Change]]:
    """Changes of frames, by body."""
    frames = [change for change in changes if change.field in FRAME_FIELDS]
    return list(grouped(frames, lambda change: change.body).values())


def _widened(truth: CertifiedModelQuantities, placed: Mapping[str, Array]) -> CertifiedModelQuantities:
    poses = {
        body: np.maximum(bound, placed[body]) if body in placed else bound
        for body, bound in truth.tolerance["poses"].items()
    }
    return replace(truth, tolerance={**truth.tolerance, "poses": poses})


def _as_shown(
    model: NeutralModel, changes: Sequence[Change], state: CanonicalState, truth: CertifiedModelQuantities
) -> CertifiedModelQuantities:
    """Quantities with the changes that are not in the model.

    Armatures left out of the kinetic energy or turned with free bodies, slides scaled, free bodies displaced,
    and frames elsewhere in their bodies: X → X Y.
    """
    kinds = grouped(changes, _field)
    offsets = {change.body: change.theirs for change in kinds.get(FRAME, ())}
    scales = {change.joint: change.theirs for change in kinds.get(SLIDE_SCALE, ())}
    shifts = {change.body: change.theirs for change in kinds.get(ORIGIN, ())}
    still = {change.joint for change in kinds.get(ARMATURE_ENERGY, ())}
    turned = {change.joint for change in kinds.get(TURNED_ARMATURE, ())}
    if turned:
        truth = _with_turned_armature(model, turned, state, truth)
    if not (offsets or scales or shifts or still):
        return truth
    poses, energy = truth.quantities.poses, truth.quantities.kinetic_energy
    for joint, _, v in model.joint_slices():
        if joint.name in still and energy is not None:
            energy -= joint.armature * float(state.velocities[v] @ state.velocities[v]) / 2
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
    return replace(truth, quantities=replace(truth.quantities, poses=poses, kinetic_energy=energy))


def _with_turned_armature(
    model: NeutralModel, joints: Collection[str], state: CanonicalState, truth: CertifiedModelQuantities
) -> CertifiedModelQuantities:
    """Armatures a of free joints on d(Rᵀv)/dt in place of v̇: h changes by −a ω × v, in world axes."""
    own, change = truth.quantities, np.zeros(len(state.velocities))
    for joint, x, v in model.joint_slices():
        if joint.name in joints:
            velocity, rate = np.split(state.velocities[v], 2)
            turn = rotation_matrix(state.coordinates[x][3:]) @ rate
            change[v.start : v.start + 3] = -joint.armature * np.cross(turn, velocity)
    if own.bias_force is None or own.mass_matrix is None or own.acceleration is None:
        return truth
    bias, acceleration = own.bias_force + change, own.acceleration - np.linalg.solve(own.mass_matrix, change)
    return replace(truth, quantities=replace(own, bias_force=bias, acceleration=acceleration))


def _in_parent(model: NeutralModel, body: NeutralBody, poses: Mapping[str, Array]) -> Array:
    """Where a body's origin is in its parent; zero where a pose is missing."""
    parent = poses.get(model.bodies[body.parent].name) if body.parent >= 0 else np.eye(3, 4)
    if parent is None or body.name not in poses:
        return np.zeros(3)
    return np.asarray(parent[:, :3].T @ (poses[body.name][:, 3] - parent[:, 3]), float)


def _composed(pose: Array, offset: Array) -> Array:
    R, p = pose[:, :3], pose[:, 3]
    return np.column_stack([R @ offset[:, :3], p + R @ offset[:, 3]])


def _causes(title: str, changes: Sequence[Change], remaining: float) -> tuple[Cause, ...]:
    """Group the changes by field and write a sentence about each group."""
    groups = grouped(changes, lambda change: (change.field, change.is_omitted))
    alone = len(groups) == 1
    found = []
    for (field, _), members in groups.items():
        proof = "this alone explains" if alone else f"with the other {len(groups) - 1} it explains"
        phrase = describe_changes(members)
        sentence = f"{title} {phrase}; {proof} every quantity (worst {remaining:.2g} of the rounding)."
        found.append(Cause(field, tuple(members), phrase, sentence))
    return tuple(found)
