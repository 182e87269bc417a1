"""Model files: each importer's reading and quantities against the certified values of the neutral model.

A quantity agrees where its largest ratio of error and tolerance over all states and entries is at most 1; the
tolerance is made of the magnitudes of the terms (`plumbline.truth.certified_model`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from plumbline.importers.importer import Reading
from plumbline.importers.neutral_model import CanonicalState, ModelQuantities, NeutralModel
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.truth.certified_model import CertifiedModelQuantities
from plumbline.truth.model_comparison import TINY, Mismatch, joint_permutation, mismatches, permuted

MODEL_UNITS = {
    "joints": "1",
    "total_mass": "kg",
    "position": "m",
    "attitude": "1",
    "mass_matrix": "SI",
    "gravity_force": "SI",
    "bias_force": "SI",
    "passive_force": "SI",
    "acceleration": "SI",
    "kinetic_energy": "J",
    "potential_energy": "J",
}
MASS_ROUNDING = 2.0**-48  # relative, of the sum of the masses


@dataclass(frozen=True, eq=False)
class Answer:
    """What an importer made of a file and of the states, or why there is nothing."""

    reading: Reading | None = None
    states: tuple[CanonicalState, ...] = ()  # of the reading's joints
    quantities: tuple[ModelQuantities, ...] = ()
    failure: str = ""


def moving_mass(model: NeutralModel) -> float:
    """Sum the masses of the bodies that can move.

    Args:
        model: any model.

    Returns:
        The mass [kg].

    """
    moving: list[bool] = []
    for body in model.bodies:
        moving.append(bool(body.joints) or (body.parent >= 0 and moving[body.parent]))
    return float(sum(body.mass for body, moves in zip(model.bodies, moving, strict=True) if moves))


def judge_answer(
    context: RowContext,
    model: NeutralModel,
    truths: Sequence[CertifiedModelQuantities],
    answer: Answer,
    unsupported: Mapping[str, str],
) -> list[Row]:
    """Judge one importer's reading of a file.

    Args:
        context: file and importer.
        model: the neutral model.
        truths: its certified quantities at the states.
        answer: the importer's.
        unsupported: quantities that the engine does not compute, and why.

    Returns:
        A row per quantity; only one where the importer refused or failed.

    """
    if answer.reading is not None and answer.reading.model is None:
        return [
            context.make_row("model", "-", "all", Verdict.UNSUPPORTED, f"refused: {answer.reading.refusal}")
        ]
    if answer.failure or answer.reading is None or answer.reading.model is None:
        return [context.make_row("model", "-", "all", Verdict.FAILED, answer.failure or "no answer")]
    reading = answer.reading.model
    order = joint_permutation(model, reading)
    rows = [_joints_row(context, model, reading, order), _mass_row(context, model, reading)]
    if order is None:
        return rows
    worst = mismatches(model, truths, [permuted(one, order) for one in answer.quantities])
    for quantity, unit in MODEL_UNITS.items():
        if quantity in unsupported:
            reason = unsupported[quantity]
            rows.append(context.make_row("model", "-", quantity, Verdict.INFORMATION, reason, unit))
        elif quantity in worst:
            rows.append(_quantity_row(context, quantity, unit, worst[quantity], len(truths)))
    if model.joints and any(truth.quantities.acceleration is None for truth in truths):
        reason = "the mass matrix is singular: a joint moves no mass, so that no acceleration is defined"
        rows.append(context.make_row("model", "-", "acceleration", Verdict.INFORMATION, reason, "SI"))
    return rows


def _joints_row(
    context: RowContext, model: NeutralModel, reading: NeutralModel, order: list[int] | None
) -> Row:
    count = len(model.joints)
    if order is not None:
        reason = f"the same {count} joints with {model.velocity_count} degrees of freedom"
        return context.make_row("model", "-", "joints", Verdict.AGREES, reason, value=0.0, tolerance=0.0)
    own, theirs = ({(j.name, j.kind) for j in m.joints} for m in (model, reading))
    parts = [
        f"{what} {', '.join(f'{name} ({kind})' for name, kind in sorted(joints)[:6])}"
        + (" …" if len(joints) > 6 else "")
        for what, joints in (("it lacks", own - theirs), ("it adds", theirs - own))
        if joints
    ]
    reason = f"other joints than the file: {'; '.join(parts)}; the other quantities are not comparable"
    number = float(len(own ^ theirs))
    return context.make_row("model", "-", "joints", Verdict.DISAGREES, reason, value=number, tolerance=0.0)


def _mass_row(context: RowContext, model: NeutralModel, reading: NeutralModel) -> Row:
    own, theirs = moving_mass(model), moving_mass(reading)
    error, tolerance = abs(own - theirs), max(MASS_ROUNDING * own, TINY)
    agrees = error <= tolerance
    reason = (
        f"the moving bodies have {own:.6g} kg"
        if agrees
        else f"the moving bodies have {theirs:.9g} kg, in the file {own:.9g} kg"
    )
    verdict = Verdict.AGREES if agrees else Verdict.DISAGREES
    return context.make_row(
        "model", "-", "total_mass", verdict, reason, "kg", value=error, tolerance=tolerance
    )


def _quantity_row(context: RowContext, quantity: str, unit: str, worst: Mismatch, count: int) -> Row:
    agrees = worst.ratio <= 1
    where = f" at {worst.where}" if worst.where else ""
    name = quantity.replace("_", " ")
    states = f"{count} state{'s' if count > 1 else ''}"
    reason = (
        f"{name} within rounding in {states}"
        if agrees
        else f"{name} off by {worst.error:.3g}{where}, state {worst.state}; "
        f"rounding explains {worst.tolerance:.1g}"
    )
    return context.make_row(
        "model", "-", quantity, Verdict.AGREES if agrees else Verdict.DISAGREES, reason, unit,
        value=worst.error, tolerance=worst.tolerance, ratio=worst.ratio,
        derivation="magnitudes of the terms × rounding (plumbline/truth/certified_model.py)",
    )  # fmt: skip
