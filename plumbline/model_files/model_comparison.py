"""An importer's quantities against the certified ones: the same states and order, the worst entries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from plumbline.importers.neutral_model import CanonicalState, ModelQuantities, NeutralModel
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import quaternion_product, rotation_matrix
from plumbline.model_files.certified_model import FORCES, CertifiedModelQuantities, certify_model

TINY = float(np.finfo(float).tiny)  # replaces a tolerance of zero, so that an error of zero has the ratio 0
_SPREAD = 0.5  # m: random displacements are up to this
VECTORS = (*FORCES, "acceleration")
MAX_JOINTS = 1000  # whose values are kept


@dataclass(frozen=True)
class Mismatch:
    """The worst entry of one quantity."""

    error: float
    tolerance: float
    ratio: float
    state: int
    where: str  # body or joints
    place: tuple[int, ...] = ()  # of the entry in the array
    value: float = 0.0  # the importer's
    expected: float = 0.0


def model_states(
    model: NeutralModel, count: int, seed: int, at: Mapping[str, float] | None = None
) -> tuple[CanonicalState, ...]:
    """Draw states; a joint of one name and kind gets the same values in every model.

    Args:
        model: whose joints.
        at: coordinates of hinges and slides by name, instead of random states; the others are at their
            reference and nothing moves.

    """
    if at is not None:
        return (_given_state(model, at),)
    drawn = [_joint_values(name, kind, count, seed) for name, kind in joint_keys(model)]
    coordinates = np.hstack([np.zeros((count, 0)), *(x for x, _ in drawn)])
    velocities = np.hstack([np.zeros((count, 0)), *(v for _, v in drawn)])
    return tuple(map(CanonicalState, coordinates, velocities))


@lru_cache(MAX_JOINTS)
def _joint_values(name: str, kind: str, count: int, seed: int) -> tuple[Array, Array]:
    """Coordinates and velocities of one joint; the search for causes asks for the same ones many times."""
    rng = np.random.default_rng([seed, *f"{kind} {name}".encode()])
    v = rng.normal(size=(count, {"ball": 3, "free": 6}.get(kind, 1)))
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    place = rng.uniform(-_SPREAD, _SPREAD, (count, 3))
    x = {
        "hinge": rng.uniform(-np.pi, np.pi, (count, 1)),
        "slide": place[:, :1],
        "ball": q,
        "free": np.hstack([place, q]),
    }[kind]
    return x, v


def _given_state(model: NeutralModel, at: Mapping[str, float]) -> CanonicalState:
    parts: list[Array] = []
    places: list[tuple[Array, Array]] = []  # of the bodies in the world, at the joints' reference
    for body in model.bodies:
        position, attitude = body.position, body.attitude
        if body.parent >= 0:
            above, turn_above = places[body.parent]
            position = above + rotation_matrix(turn_above) @ position
            attitude = quaternion_product(turn_above, attitude)
        places.append((position, attitude))
        for joint in body.joints:
            turn = np.array([1.0, 0.0, 0.0, 0.0])
            parts.append(
                {
                    "ball": turn,
                    "free": np.concatenate([position, attitude]),
                }.get(joint.kind, np.array([at.get(joint.name, joint.reference)]))
            )
    return CanonicalState(np.concatenate([*parts, np.zeros(0)]), np.zeros(model.velocity_count))


def joint_keys(model: NeutralModel) -> list[tuple[str, str]]:
    """Identify joints across readings: free ones by their body, since importers name them otherwise.

    Args:
        model: any model.

    Returns:
        Name and kind of each joint, in canonical order.

    """
    return [
        (f"{body.name}/free" if joint.kind == "free" else joint.name, joint.kind)
        for body in model.bodies
        for joint in body.joints
    ]


def with_names_of(model: NeutralModel, reading: NeutralModel) -> NeutralModel:
    """Name an importer's parts of a planar joint as the model does: a URDF gives one name for all three.

    Args:
        model: the neutral model, whose parts are called "<joint>/x", "<joint>/y" and "<joint>/angle".

    Returns:
        The reading with the model's names where the kinds of the parts are the same; else unchanged.

    """
    named = {body.name: body.joints for body in model.bodies}
    bodies = []
    for body in reading.bodies:
        own = named.get(body.name, ())
        is_planar = len(own) == 3 and own[0].name.endswith("/x")
        if is_planar and [j.kind for j in own] == [j.kind for j in body.joints]:
            joints = tuple(replace(j, name=k.name) for j, k in zip(body.joints, own, strict=True))
            body = replace(body, joints=joints)
        bodies.append(body)
    return replace(reading, bodies=tuple(bodies))


def joint_permutation(model: NeutralModel, reading: NeutralModel) -> list[int] | None:
    """Find the velocities of a model among those of an importer's reading.

    Returns:
        For each velocity of the model its index in the reading; None where the joints differ in name or kind.

    """
    places = {key: v for key, (_, _, v) in zip(joint_keys(reading), reading.joint_slices(), strict=True)}
    wanted = joint_keys(model)
    if sorted(places) != sorted(wanted):
        return None
    return [i for key in wanted for i in range(places[key].start, places[key].stop)]


def permuted(answer: ModelQuantities, order: Sequence[int]) -> ModelQuantities:
    """Bring an importer's quantities into the order of the model's velocities.

    Args:
        answer: in the order of its reading.
        order: of `joint_permutation`.

    Returns:
        The quantities in the model's order.

    """
    index = np.array(order, int)
    changed: dict[str, Any] = {
        name: getattr(answer, name)[index] for name in VECTORS if getattr(answer, name) is not None
    }
    if answer.mass_matrix is not None:
        changed["mass_matrix"] = answer.mass_matrix[np.ix_(index, index)]
    return replace(answer, **changed)


def mismatches(
    model: NeutralModel,
    truths: Sequence[CertifiedModelQuantities],
    answers: Sequence[ModelQuantities],
) -> dict[str, Mismatch]:
    """Find the worst entry of every quantity that both sides have.

    Args:
        answers: an importer's at the same states, in the model's order.

    Returns:
        By quantity; potential energies as differences to that of the first state.

    """
    names = [j.name for j, _, v in model.joint_slices() for _ in range(v.start, v.stop)]
    found: dict[str, Mismatch] = {}

    def note(quantity: str, theirs: Any, own: Any, tolerance: Any, state: int, labels: Sequence[str]) -> None:
        values, expected = np.atleast_1d(theirs), np.atleast_1d(own)
        if not values.size:
            return
        errors, tolerances = np.abs(values - expected), np.broadcast_to(tolerance, values.shape)
        with np.errstate(over="ignore"):  # an error where there are no terms at all
            ratios = errors / np.maximum(tolerances, TINY)
        at = tuple(map(int, np.unravel_index(int(np.argmax(ratios)), ratios.shape)))
        if quantity not in found or ratios[at] > found[quantity].ratio:
            where = " and ".join(dict.fromkeys(labels[i] for i in at)) if labels else ""
            error, limit, ratio = (float(x[at]) for x in (errors, tolerances, ratios))
            entry = float(values[at]), float(expected[at])
            found[quantity] = Mismatch(error, limit, ratio, state, where, at, *entry)

    for state, (truth, answer) in enumerate(zip(truths, answers, strict=True)):
        own, tolerance = truth.quantities, truth.tolerance
        for body, pose in own.poses.items():
            if (other := answer.poses.get(body)) is not None:
                limit, labels = tolerance["poses"][body], [f"body {body}"] * 3
                note("position", other[:, 3], pose[:, 3], limit[:, 3], state, labels)
                note("attitude", other[:, :3], pose[:, :3], limit[0, 0], state, labels)
        for quantity in (*VECTORS, "mass_matrix", "kinetic_energy"):
            theirs, true = getattr(answer, quantity), getattr(own, quantity)
            if theirs is not None and true is not None:
                labels = names if np.ndim(theirs) else []
                note(quantity, theirs, true, tolerance[quantity], state, labels)
        four = (answers[0], truths[0].quantities, answer, own)
        energies = [one.potential_energy for one in four if one.potential_energy is not None]
        if state and len(energies) == 4:
            theirs, true = np.subtract(energies[2:], energies[:2])
            note("potential_energy", theirs, true, tolerance["potential_energy"], state, ())
    return found


def mismatches_as_read(
    reading: NeutralModel,
    truth: CertifiedModelQuantities,
    read: CertifiedModelQuantities,
    answer: ModelQuantities,
    order: Sequence[int],
) -> dict[str, Mismatch]:
    """Find the worst entries of one state in the importer's own order.

    The tolerance is the larger one of what the file says and of what the importer reads, so that the engine's
    rounding of large terms beside an expected zero is no evidence.

    Args:
        truth: of the file, in the model's order.
        read: of the reading.
        answer: of the importer.
        order: of `joint_permutation`.

    """
    back = np.argsort(np.array(order, int))

    def widened(name: str, limit: Any) -> Any:
        other = read.tolerance.get(name, 0.0)
        if name == "poses":
            return {body: np.maximum(x, other.get(body, 0.0)) for body, x in limit.items()}
        limit = np.asarray(limit)[np.ix_(*[back] * np.ndim(limit))]
        return limit if getattr(read.quantities, name) is None else np.maximum(limit, other)

    tolerance = {name: widened(name, limit) for name, limit in truth.tolerance.items()}
    own = CertifiedModelQuantities(permuted(truth.quantities, back.tolist()), tolerance)
    return mismatches(reading, [own], [answer])


def certify_states(model: NeutralModel, states: Sequence[CanonicalState]) -> list[CertifiedModelQuantities]:
    """Certify a model at several states.

    Returns:
        One record per state.

    """
    return [certify_model(model, state) for state in states]
