"""State level: each engine's quantities against the truth, per body, within the rounding bound.

The tolerance is `plumbline.truth.rounding_bound`; `MAX_RELATIVE_BOUND` limits how loose it may be.
"""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np

from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.variants import VariantKind
from plumbline.judging.identity import state_fingerprints
from plumbline.judging.rows import (
    FAILED_CALLS,
    OWN_UNCERTAINTY,
    WRONG_CALL,
    Columns,
    Deviation,
    JudgingResult,
    Row,
    RowContext,
    Verdict,
    cell_rank,
    most_wrong_call,
    with_unit,
)
from plumbline.judging.surface_rows import judge_surface
from plumbline.model.datatypes import Array
from plumbline.model.grouping import grouped
from plumbline.model.loops import MIN_SINGULAR_VALUE
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND, TINY, bound_over_scale

STATE_UNITS = {
    "acceleration": "m/s²",
    "angular_acceleration": "rad/s²",
    "joint_reaction": "N",
    "joint_moment": "N m",
    "kinetic_energy": "J",
    "potential_energy": "J",
    "angular_momentum": "kg m²/s",
    "mass_matrix": "kg m²",
}
VARIANT_QUANTITIES = {  # and the quantity whose truth is theirs
    f"{quantity}_by_{kind}": quantity for kind in get_args(VariantKind) for quantity in ("all", *STATE_UNITS)
}
SINGULAR_POSE = "singular_pose"  # quantity of the row of an initial pose that is not compared


def judge_states(context: RowContext, truth: StateTruth, evaluation: Evaluation) -> JudgingResult:
    """Judge every state quantity of one engine, by the worst of all bodies and states.

    Args:
        truth: true quantities and rounding bounds at S states.
        evaluation: the engine's quantities at the same states, or why there are none.

    Returns:
        One row per quantity, and per state the worst body (table "states").

    """
    if evaluation.no_answer:
        return JudgingResult([context.make_no_answer_row("state", "-", "all", evaluation.no_answer)])
    result = JudgingResult(fingerprints=state_fingerprints(evaluation.quantities))
    for quantity, unit in STATE_UNITS.items():
        if all(getattr(true, quantity) is None for true in truth.quantities):
            continue  # a chain of rods and balls has no joint moments
        if any(getattr(answer, quantity) is None for answer in evaluation.quantities):
            gap = quantity if quantity in evaluation.declared else ""
            reason = f"{context.title} offers no {quantity.replace('_', ' ')} of its own"
            result.rows.append(
                context.make_row("state", "-", quantity, Verdict.UNSUPPORTED, reason, unit, gap)
            )
            continue
        row, worst, deviation = _judge_quantity(context, quantity, truth, evaluation)
        names = {"scenario": context.scenario, "engine": context.engine, "quantity": quantity}
        result.tables.append(("states", names | worst))
        result.rows.append(row)
        if row.verdict == Verdict.DISAGREES:
            result.deviations[row.key] = deviation
    result.rows += judge_surface(context, truth, evaluation)
    result.rows += judge_variants(context, truth, evaluation)
    return result


def judge_variants(context: RowContext, truth: StateTruth, evaluation: Evaluation) -> list[Row]:
    """Judge the state quantities of an engine by its variants, against the same truth.

    Returns:
        One row of the level surface per kind of variants and quantity, that of the variant which is off most;
        one more per kind where variants failed or were refused.

    """
    rows = list[Row]()
    for kind, answers in evaluation.variants.items():
        found, missing = list[tuple[Row, str]](), list[tuple[NoAnswer, str]]()
        for call, answer in answers.items():
            names = ", ".join(call)
            if isinstance(answer, NoAnswer):
                missing.append((answer, names))
                continue
            first = slice(len(answer))
            true = replace(truth, quantities=truth.quantities[first], bounds=truth.bounds[first])
            other = replace(evaluation, quantities=answer)
            for quantity in STATE_UNITS:
                if getattr(true.quantities[0], quantity) is None:
                    continue
                if all(getattr(one, quantity) is not None for one in answer):
                    found.append((_judge_quantity(context, quantity, true, other)[0], names))
                elif any(getattr(one, quantity) is not None for one in evaluation.quantities):
                    lacks = f"it returns no {quantity.replace('_', ' ')}"
                    missing.append((NoAnswer(lacks, is_refusal=True), names))
        for quantity, judged in grouped(found, lambda one: one[0].quantity).items():
            judged.sort(key=lambda one: cell_rank(one[0].verdict, None, one[0].ratio))
            row, names = judged[-1]
            ratios = {by: one.ratio or 0.0 for one, by in judged if one.verdict == Verdict.DISAGREES}
            others = " and by ".join(by for by in ratios if by != names)
            reason = f"by {names}: {row.reason}" + (f"; by {others} too" if others else "")
            extra = row.extra | {"calls": float(len(judged))}
            if ratios:
                extra |= {WRONG_CALL: most_wrong_call(ratios), FAILED_CALLS: "\n".join(sorted(ratios))}
            name = f"{quantity}_by_{kind}"
            rows.append(replace(row, level="surface", quantity=name, reason=reason, extra=extra))
        if missing:  # refusals are shown too: what was not compared is no agreement
            failed = [names for answer, names in missing if not answer.is_refusal]
            refused = [names for answer, names in missing if not (answer.gap or answer.missing)]
            verdict = Verdict.FAILED if failed else Verdict.UNSUPPORTED if refused else Verdict.INFORMATION
            reason = "; ".join(f"by {names}: {answer.message}" for answer, names in missing)
            calls = sorted({*(failed or refused)})
            extra = {WRONG_CALL: calls[0], FAILED_CALLS: "\n".join(calls)} if calls else {}
            rows.append(context.make_row("surface", "-", f"all_by_{kind}", verdict, reason, extra=extra))
    return rows


def _judge_quantity(
    context: RowContext, quantity: str, truth: StateTruth, evaluation: Evaluation
) -> tuple[Row, Columns, Deviation]:
    """The row of one quantity, per state the worst body, and the deviations.

    A disagreement in any state decides. A state does not count as compared where the bound of its worst body
    is too loose to detect an error, or that of another one unless its error is as small as a sharp bound, or
    any bound is not a number; of fewer than half of the states no agreement follows. The reason counts the
    bodies with a loose bound in any case.
    """
    deviation, unit = _deviation(quantity, truth, evaluation), STATE_UNITS[quantity]
    worst, looseness, is_small = _worst_error_per_state(quantity, truth, deviation)
    error, bound, scale = worst["error"], worst["bound"], worst["scale"]
    known, has_scale = np.isfinite(bound), scale > 0
    ratios = np.where(known, error / np.maximum(bound, TINY), 0.0)
    at, ratio, count = np.argmax(ratios), np.max(ratios), len(ratios)
    own = looseness[worst["state"], worst["body"]]
    is_decided = (looseness <= MAX_RELATIVE_BOUND) | (np.isfinite(looseness) & is_small)
    sharp = (own <= MAX_RELATIVE_BOUND) & np.all(is_decided, axis=1)
    compared, loosest = np.sum(sharp), np.max(looseness)
    loose_count = np.sum(looseness > MAX_RELATIVE_BOUND)
    state, body = worst["state"][at], worst["body"][at] + 1
    name, where = quantity.replace("_", " "), f"state {state}, body {body}"
    loose = (
        f"the rounding bound is up to {loosest:.1g} of the quantity's scale (limit {MAX_RELATIVE_BOUND:g}) "
        f"at {count - compared} of {count} states and in {loose_count} of {looseness.size} comparisons, too "
        "loose to detect an error"
    )
    limit_error = np.max(_limit_errors(quantity, evaluation))
    share = f"; of it up to {with_unit(limit_error, unit)} is the uncertainty of the engine's limit"
    if ratio > 1:
        verdict = Verdict.DISAGREES
        reason = (
            f"the {name} of {context.title} is off by {with_unit(error[at], unit, 3)} at {where}, "
            f"{ratio:.3g} times the rounding bound; {np.sum(ratios > 1)} of {count} states disagree"
        )
    elif compared and 2 * compared >= count:
        verdict = Verdict.AGREES
        reason = f"{name} within {ratio:.2g} of the rounding bound at {compared} states"
        reason += f"; {loose}" if loose_count else ""
    else:
        verdict, reason = Verdict.UNRESOLVED, f"inconclusive: {loose}"
    extra: dict[str, float] = {"limit_error": float(limit_error)} if limit_error else {}
    if extra and verdict == Verdict.UNRESOLVED:
        exact = [replace(answer, limit_error=None) for answer in evaluation.quantities]
        other, *_ = _judge_quantity(context, quantity, truth, replace(evaluation, quantities=exact))
        extra |= {} if other.verdict == Verdict.UNRESOLVED else {OWN_UNCERTAINTY: 1.0}
    row = context.make_row(
        "state",
        "-",
        quantity,
        verdict,
        reason,
        unit,
        value=error[at],
        tolerance=bound[at],
        ratio=ratio,
        derivation=f"first-order rounding bound per body and state, {with_unit(bound[at], unit)} at {where}, "
        f"and at most {loosest:.1g} of the scale at {count} states, {MAX_RELATIVE_BOUND:g} at {compared} of "
        f"them; truth: {truth.method}" + share * bool(limit_error),
        cpu_time=evaluation.cpu_time,
        extra={
            "relative": np.max(error[has_scale] / scale[has_scale], initial=0.0),
            "states": count,
            "compared_states": compared,
            "bound_relative": loosest,
            "state": state,
            "body": body,
        }
        | extra,
    )
    return row, worst, deviation


def singular_pose_row(context: RowContext, value: float) -> Row:
    """Make the row of an initial state whose pose is singular, at which no engine can be judged.

    Args:
        value: the smallest singular value of the loops' rows that hold at poses nearby.

    """
    reason = (
        f"singular: at t = 0 the smallest singular value of the loops' rows that hold elsewhere is "
        f"{value:.2g} (limit {MIN_SINGULAR_VALUE:g}); accelerations and forces are not unique there, "
        "and are not compared"
    )
    return context.make_row("state", "-", SINGULAR_POSE, Verdict.UNRESOLVED, reason, value=value)


def _limit_errors(quantity: str, evaluation: Evaluation) -> Array:
    """(S,) uncertainty of the limit that the engine's answers were extrapolated to; 0 where they were not."""
    return np.array([(answer.limit_error or {}).get(quantity, 0.0) for answer in evaluation.quantities])


def _deviation(quantity: str, truth: StateTruth, evaluation: Evaluation) -> Deviation:
    """Answer − truth: vectors (S, N, 3), of scalars (S, 1, 1), of the matrix each entry (S, nu², 1)."""
    pairs = zip(evaluation.quantities, truth.quantities, strict=True)
    differences = np.array([getattr(answer, quantity) - getattr(true, quantity) for answer, true in pairs])
    count, has_entries = len(differences), quantity == "mass_matrix"
    components = 1 if differences.ndim == 1 or has_entries else 3
    vectors = differences.reshape(count, -1, components)
    bound = np.array([bound.tolerance(quantity) for bound in truth.bounds]).reshape(count, -1)
    bound = bound + _limit_errors(quantity, evaluation)[:, None]
    return Deviation(vectors, np.broadcast_to(bound, vectors.shape[:2]) if has_entries else bound)


def _worst_error_per_state(
    quantity: str, truth: StateTruth, deviation: Deviation
) -> tuple[Columns, Array, Array]:
    """Per state (S,): error, bound and scale of the body with the largest ratio of error and bound.

    Besides them of every body (S, N) the ratio of bound and scale, inf where a bound is not a number, and
    whether the error is within the loosest sharp bound.
    """
    error, bound = np.linalg.norm(deviation.vectors, axis=-1), deviation.tolerance
    if quantity == "mass_matrix":
        error, bound = np.max(error, axis=1, keepdims=True), bound[:, :1]
    scale = np.array([bound.scale[quantity] for bound in truth.bounds]).reshape(error.shape)
    known = np.isfinite(bound)
    ratio = np.where(known, error / np.maximum(bound, TINY), -1.0)  # without a bound nothing is compared
    state, body = np.arange(len(error)), np.argmax(ratio, axis=1)
    at = state, body
    is_small: Array = error <= MAX_RELATIVE_BOUND * scale
    worst = {"state": state, "body": body, "error": error[at], "bound": bound[at], "scale": scale[at]}
    return worst, bound_over_scale(bound, scale), is_small
