"""Model files: each importer's reading and quantities against the certified values of the neutral model.

A quantity agrees where its largest ratio of error and tolerance over all states and entries is at most 1; the
tolerance is made of the magnitudes of the terms (`plumbline.model_files.certified_model`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.environments import declared_importer_attribute
from plumbline.importers.importer import Reading
from plumbline.importers.mjcf_rewriting import names_as_written
from plumbline.importers.neutral_model import (
    MODEL_UNITS,
    CanonicalState,
    ModelQuantities,
    NeutralModel,
    without_passive_forces,
)
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.model.datatypes import Array
from plumbline.model_files.certified_model import CertifiedModelQuantities
from plumbline.model_files.importer_cause import Cause, Explanation, damping_cause, explain_importer
from plumbline.model_files.model_comparison import (
    TINY,
    Mismatch,
    certify_states,
    joint_keys,
    joint_permutation,
    mismatches,
    model_states,
    permuted,
)
from plumbline.model_files.parameter_changes import describe_difference
from plumbline.scenario.line_and_column_errors import first_words, shorten

MODEL_FAMILY = "model file"  # of the rows, in place of a scenario's family
REFUSED = "refused: "  # before an importer's words
IS_REFUSED = "refused"  # in ``Row.extra`` where an importer refuses the file, or a rewriting of it
SEED = 17
MASS_ROUNDING = 2.0**-48  # relative, of the sum of the masses


@dataclass(frozen=True, eq=False)
class FileResult:
    """One file's result."""

    file: str  # as typed
    model: NeutralModel
    rows: tuple[Row, ...]
    explanations: Mapping[str, Explanation]  # by importer
    poses: Mapping[str, Array]  # of the bodies at the reference, or at the one state, for the drawing
    answers: Mapping[str, Answer]  # by importer


@dataclass(frozen=True, eq=False)
class Answer:
    """What an importer made of a file and of the states, or why there is nothing."""

    reading: Reading | None = None
    states: tuple[CanonicalState, ...] = ()  # of the reading's joints
    quantities: tuple[ModelQuantities, ...] = ()
    failure: str = ""
    rewritten: Mapping[str, Reading] = field(default_factory=dict)  # of equivalent rewritings of the file

    @property
    def model(self) -> NeutralModel | None:
        """The importer's reading of the file; None where it refused or failed."""
        return None if self.reading is None else self.reading.model


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


def _row(context: RowContext, quantity: str, *arguments: Any, **more: Any) -> Row:
    return context.make_row("model", "-", quantity, *arguments, **more)


def _compared(context: RowContext, quantity: str, agrees: bool, *arguments: Any, **more: Any) -> Row:
    return _row(context, quantity, Verdict.AGREES if agrees else Verdict.DISAGREES, *arguments, **more)


def judge_answer(
    context: RowContext,
    model: NeutralModel,
    truths: Sequence[CertifiedModelQuantities],
    answer: Answer,
    unsupported: Mapping[str, str],
) -> list[Row]:
    """Judge one importer's reading of a file.

    Args:
        unsupported: quantities that the engine does not compute, and why.

    Returns:
        A row per quantity; only one where the importer refused or failed.

    """
    reading = answer.model
    if answer.reading is not None and reading is None:
        reason = f"{REFUSED}{answer.reading.refusal}"
        return [replace(_row(context, "all", Verdict.UNSUPPORTED, reason), extra={IS_REFUSED: 1.0})]
    if answer.failure or reading is None:
        return [_row(context, "all", Verdict.FAILED, answer.failure or "no answer")]
    order = joint_permutation(model, reading)
    rows = [_joints_row(context, model, reading, order), _mass_row(context, model, reading)]
    if order is None:
        return rows
    worst = mismatches(model, truths, [permuted(one, order) for one in answer.quantities])
    is_singular = bool(model.joints) and any(truth.quantities.acceleration is None for truth in truths)
    for quantity, unit in MODEL_UNITS.items():
        if quantity in worst and quantity not in unsupported:
            rows.append(_quantity_row(context, quantity, unit, worst[quantity], len(truths)))
            continue
        reason = unsupported.get(quantity, "")
        if not reason and quantity == "acceleration" and is_singular:
            reason = (
                "no acceleration is determined: the mass matrix is singular in double precision, as where a "
                "joint moves no mass, or where masses or lengths differ by many orders of magnitude"
            )
        elif not reason and any(getattr(one, quantity, 0.0) is None for one in answer.quantities):
            reason = "the importer's engine computes it of other files, not of this one"
        elif not reason and quantity == "potential_energy" and len(truths) == 1:
            reason = "compared as differences between states; there is one"
        if reason:
            rows.append(_row(context, quantity, Verdict.INFORMATION, reason, unit))
    return rows


def _joints_row(
    context: RowContext, model: NeutralModel, reading: NeutralModel, order: list[int] | None
) -> Row:
    reason = f"the same {len(model.joints)} joints with {model.velocity_count} degrees of freedom"
    own, theirs = (set(joint_keys(m)) for m in (model, reading))
    parts = [
        f"{what} {first_words([f'{name} ({kind})' for name, kind in sorted(joints)], 6)}"
        for what, joints in (("it lacks", own - theirs), ("it adds", theirs - own))
        if joints
    ]
    if order is None:
        reason = f"other joints than the file: {'; '.join(parts)}; the other quantities are not comparable"
    number = float(len(own ^ theirs))
    return _compared(context, "joints", order is not None, reason, value=number, tolerance=0.0)


def _mass_row(context: RowContext, model: NeutralModel, reading: NeutralModel) -> Row:
    own, theirs = moving_mass(model), moving_mass(reading)
    error, tolerance = abs(own - theirs), max(MASS_ROUNDING * own, TINY)
    agrees = error <= tolerance
    reason = (
        f"the moving bodies have {own:.6g} kg"
        if agrees
        else f"the moving bodies have {theirs:.9g} kg, in the file {own:.9g} kg"
    )
    return _compared(context, "total_mass", agrees, reason, "kg", value=error, tolerance=tolerance)


def _damping_row(context: RowContext, cause: Cause | None) -> Row:
    """The damping that an importer holds and whose engine does not apply: for the user's own forces."""
    if cause is None:
        reason, error = "the damping of every joint is read as the file says", 0.0
    else:
        reason, error = cause.sentence, max(abs(change.theirs - change.own) for change in cause.changes)
    diagnosis = reason if cause else None
    return _compared(
        context, "damping", cause is None, reason, "SI", value=error, tolerance=0.0, diagnosis=diagnosis
    )


def rewriting_row(context: RowContext, model: NeutralModel, rewritten: Mapping[str, Reading]) -> Row:
    """Judge MuJoCo's compiler by equivalent rewritings of an MJCF file.

    Args:
        rewritten: its readings of the rewritings, by what was done to the file.

    Returns:
        A row that agrees where all are the same model, up to `RELATIVE_CHANGE` of each number: MuJoCo
        diagonalises inertias up to 1e-12.  Information where it refuses some and the others are the same.

    """
    wrong, refused, same = [], [], []
    for name, reading in rewritten.items():
        if reading.model is None:
            refused.append(f"it refuses the file with {name}: {shorten(reading.refusal)}")
            continue
        other = replace(reading.model, bodies=tuple(names_as_written(reading.model.bodies)))
        if words := describe_difference(model, other):
            wrong.append(f"with {name}, {words}")
        else:
            same.append(name)
    agreement = [f"the same model of {len(same)} equivalent rewritings ({', '.join(same)})"] if same else []
    reason = "; ".join([*(wrong or agreement), *refused])
    verdict = Verdict.DISAGREES if wrong else Verdict.INFORMATION if refused else Verdict.AGREES
    if wrong:
        reason = f"{context.title} {context.version} compiles equivalent files to different models: {reason}"
    row = _row(context, "rewritings", verdict, reason, "1", value=float(len(wrong)), tolerance=0.0)
    return replace(row, extra={IS_REFUSED: 1.0}) if refused else row


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
    return _compared(
        context, quantity, agrees, reason, unit,
        value=worst.error, tolerance=worst.tolerance, ratio=worst.ratio,
        derivation="magnitudes of the terms × rounding (plumbline/model_files/certified_model.py)",
    )  # fmt: skip


def state_seed(shown: str) -> int:
    """Derive the seed of a file's random states from its name, so that its folder does not matter."""
    return int.from_bytes(hashlib.sha256(Path(shown).name.encode()).digest()[:4], "big") + SEED


@dataclass(frozen=True, eq=False)
class FileTruth:
    """Certified quantities of a file's model at its states."""

    states: Sequence[CertifiedModelQuantities]
    without_passive: Sequence[CertifiedModelQuantities]  # for engines whose dynamics have no passive forces
    poses: Mapping[str, Array]  # of the bodies at the reference, or at the one state, for the drawing


def certify_file(
    shown: str, model: NeutralModel, state_count: int, at: Mapping[str, float] | None
) -> FileTruth:
    """Certify a file's model at the states of a comparison."""
    states = model_states(model, state_count, state_seed(shown), at)
    truths, bare = certify_states(model, states), without_passive_forces(model)
    bare_truths = certify_states(bare, states) if bare is not model else truths
    (drawn,) = certify_states(model, model_states(model, 1, 0, at or {}))
    return FileTruth(truths, bare_truths, drawn.quantities.poses)


def judge_importer(
    shown: str,
    model: NeutralModel,
    column: tuple[str, EngineInfo, Answer],
    state_count: int,
    at: Mapping[str, float] | None,
    truth: FileTruth,
) -> tuple[list[Row], Explanation | None]:
    """Judge one importer's answer about a file, and look for the causes of its differences.

    Args:
        column: name and description of the importer, and its answer.
        truth: of `certify_file`.

    Returns:
        The rows, and what explains the differences, if there are any.

    """

    def states(one: NeutralModel) -> tuple[CanonicalState, ...]:
        return model_states(one, state_count, state_seed(shown), at)

    name, info, answer = column
    reading, title = answer.model, f"{info.title} {info.version}"
    context = RowContext(shown, MODEL_FAMILY, name, info.title, info.version)
    if answer.reading is None and not answer.failure:
        formats = declared_importer_attribute(name, "formats")
        reason = f"{info.title} reads {' and '.join(formats).upper()} files only"
        return [_row(context, "all", Verdict.INFORMATION, reason)], None
    if info.missing is not None:
        verdict = Verdict.FAILED if info.has_failed else Verdict.NOT_INSTALLED
        return [_row(context, "all", verdict, info.missing)], None
    unsupported = declared_importer_attribute(name, "unsupported") or {}
    applies = "passive_force" not in unsupported
    judged = (model, truth.states) if applies else (without_passive_forces(model), truth.without_passive)
    found = judge_answer(context, *judged, answer, unsupported)
    explanation = None
    if reading is not None and any(row.verdict == Verdict.DISAGREES for row in found):
        read = reading if applies else without_passive_forces(reading)
        explanation = explain_importer(title, judged[0], read, answer.quantities, states)
        causes = tuple(cause.within(shown) for cause in explanation.causes)
        explanation = replace(explanation, causes=causes)
        found = [_with_diagnosis(row, explanation) for row in found]
    if not applies and reading is not None:
        cause = damping_cause(title, model, reading)
        cause = cause and cause.within(shown)
        found.append(_damping_row(context, cause))
        if cause is not None:
            known = explanation or Explanation(is_proved=True)
            explanation = replace(known, causes=(*known.causes, cause))
    if answer.rewritten and reading is not None:
        found.append(rewriting_row(context, reading, answer.rewritten))
    return found, explanation


def _with_diagnosis(row: Row, explanation: Explanation) -> Row:
    if row.verdict != Verdict.DISAGREES:
        return row
    if explanation.is_proved:
        return replace(row, diagnosis=explanation.sentence)
    return replace(row, reason=f"{row.reason}; no change of the model's parameters reproduces it")
