"""Step level: the declared method's steps, against its formula in extended precision.

One step and ten from several states; and every step of a run, each from the engine's sample before.
`plumbline.truth.step_comparison` has the differences and their bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from plumbline.engines.engine_calls import StepAttempt, StepEvaluation
from plumbline.engines.no_answer import NoAnswer
from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict, with_unit
from plumbline.measurements.single_steps import run_counts
from plumbline.model.datatypes import Array, EngineFailure, Integrator, Model, State, StepRun
from plumbline.model.loops import keeps_dependent_rows
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR
from plumbline.truth.step_comparison import (
    CONSTRAINED_QUANTITIES,
    RUN_QUANTITIES,
    STEP_QUANTITIES,
    FormulaSteps,
    RunSteps,
    StepDeviations,
    compare_parts,
    constrained_deviations,
    constrained_samples,
    joined,
    resolves_steps,
    step_counts,
)
from plumbline.truth.step_formulas import HAS_EXTENDED_PRECISION

OPEN_ROWS = (
    "not compared: rows of the loops depend on others in closed poses only; where a step has opened the "
    "loops, the accelerations are those of the solver's iterations"
)
NO_EXTENDED_PRECISION = "the formulas need an extended precision that this machine does not have"
NO_COORDINATES = (
    "not compared: the adapter returns no coordinates with the samples, from which the next step could start"
)
TOTALS = ("run_energy", "run_momentum", "run_equations")  # of the whole mechanism
# rows in which every number of the mechanism shows: of formulas, and of Exudyn's implicit methods
DECISIVE = {"run_velocity", "run_rate"}, {"run_equations"}
DECIDED, UNDECIDED = (
    {Verdict.AGREES, Verdict.DISAGREES},
    {Verdict.UNRESOLVED, Verdict.FAILED, Verdict.HARNESS_FAILED},
)
MAX_STEP_BOUND = 1e-6  # of the accelerations' effect; a looser bound could hide a mistake
# of the largest first acceleration, which an engine finds by finite differences
MAX_LOOSENESS = {"step_first_acceleration": DETECTABLE_PARAMETER_ERROR}


def judge_steps(
    context: RowContext, integrator: Integrator, model: Model, states: Sequence[State], answer: StepEvaluation
) -> JudgingResult:
    """Judge the steps of one integrator by its declared formula.

    Args:
        integrator: the integrator, with a declared method.
        states: the states that the steps start from.
        answer: the engine's steps, or why there are none.

    Returns:
        One row per quantity.

    """
    rows = list[Row]()
    if answer.attempts:
        rows = _single_step_rows(context, integrator, model, states, answer)
        if any(row.quantity == "all" for row in rows):  # why nothing is compared
            return JudgingResult(rows)
    return JudgingResult([*rows, *_run_rows(context, integrator, model, states[0], answer)])


def compares_every_step(rows: Sequence[Row], decisive: Sequence[set[str]] = DECISIVE) -> bool:
    """Find out whether the steps of a run decide, so that a refinement study of low order adds little.

    Args:
        rows: of `judge_steps`, of one integrator.
        decisive: the rows of one of these sets are needed.

    Returns:
        Whether every step that differs is compared by decisive rows, and no row failed or is unresolved.

    """
    if any(row.verdict in UNDECIDED or row.extra.get("left_out_wrong_steps") for row in rows):
        return False
    compared = {row.quantity for row in rows if row.verdict in DECIDED}
    return any(compared >= some for some in decisive)


def all_steps_agree(rows: Sequence[Row]) -> bool:
    """Find out whether every step of a run, and where it starts, is that of the declared formula."""
    is_right = not any(row.verdict == Verdict.DISAGREES for row in rows)
    return is_right and compares_every_step(rows, DECISIVE[:1])


def _single_step_rows(
    context: RowContext, integrator: Integrator, model: Model, states: Sequence[State], answer: StepEvaluation
) -> list[Row]:
    method = integrator.method

    def one(verdict: Verdict, reason: str) -> list[Row]:
        return [context.make_row("step", integrator.name, "all", verdict, reason)]

    def none(found: NoAnswer) -> list[Row]:
        return [context.make_no_answer_row("step", integrator.name, "all", found)]

    attempts, runs = [attempt for attempt in answer.attempts if attempt.run is not None], answer.runs
    is_constrained = isinstance(method, ConstrainedMethod)  # where fewer steps than asked for have failed
    for attempt in answer.attempts:
        if attempt.failure and (is_constrained or attempt.run is None):
            return none(attempt.failure)
    if not runs:
        assert answer.attempts[0].refusal is not None
        return none(answer.attempts[0].refusal)
    if not HAS_EXTENDED_PRECISION:
        return one(Verdict.UNSUPPORTED, NO_EXTENDED_PRECISION)
    if isinstance(method, JointSpaceMethod) and not keeps_dependent_rows(model, states[0]):
        return one(Verdict.INFORMATION, OPEN_ROWS)
    if isinstance(method, JointSpaceMethod):
        starts = [(index, h, run.angle_axes) for index, h, run in runs]
        steps = FormulaSteps(method, model, states, starts)
        for i, attempt in enumerate(attempts):
            if attempt.failure and steps.is_stable(i):
                return none(attempt.failure)
        found, table = steps.compare([run for *_, run in runs]), STEP_QUANTITIES
        compared = [attempt for i, attempt in enumerate(attempts) if steps.is_stable(i)]
    else:
        assert isinstance(method, ConstrainedMethod)
        found, table, compared = compare_parts(method, model, states, runs), CONSTRAINED_QUANTITIES, attempts
    alias = None if model.has_drag else integrator.alias_of  # with drag the two methods differ
    complete = sum(not (attempt.refusal or attempt.failure) for attempt in compared)
    note = f"{complete} of {len(answer.attempts)} runs of {max(step_counts(method))} steps"
    if refusals := [attempt.refusal.message for attempt in answer.attempts if attempt.refusal]:
        note += f"; the engine refused {len(refusals)} of them: {refusals[0]}"
    return [
        _row(context, integrator, quantity, table[quantity], comparisons, note, alias, answer.cpu_time)
        for quantity, comparisons in found.items()
    ]


def _row(
    context: RowContext, integrator: Integrator, quantity: str, about: tuple[str, str], found: StepDeviations,
    note: str, alias: str | None, cpu_time: float,
) -> Row:  # fmt: skip
    """The row of one quantity: its worst ratio decides, unless most bounds are too loose."""
    error, bound, ratios, looseness = found.errors, found.bounds, found.ratios, found.looseness
    row, body = at = np.unravel_index(np.argmax(ratios), ratios.shape)
    worst = found.places[int(row)]
    place = f"body {body + 1}, {worst}"
    most = MAX_LOOSENESS.get(quantity, MAX_STEP_BOUND)
    ratio, is_sharp = ratios[at], looseness <= most
    name, unit = about[0].replace("_", " "), about[1]
    if ratio > 1:
        verdict = Verdict.DISAGREES
        reason = (
            f"{context.title} does not take the declared step of {integrator.name}: {name} off by "
            f"{with_unit(error[at], unit, 3)} ({place}), {ratio:.3g} times the rounding bound"
        )
    elif not ratio <= 1 or np.mean(is_sharp) < 0.5:
        verdict = Verdict.UNRESOLVED
        reason = (
            f"inconclusive: at {np.mean(~is_sharp):.0%} of the comparisons the rounding bound is above "
            f"{most:g} of the accelerations' effect, too loose to detect an error"
        )
    else:
        verdict = Verdict.AGREES
        reason = f"{name} within {ratio:.2g} of the rounding bound of the declared step in {note}"
    return context.make_row(
        "step", integrator.name, quantity, verdict, reason, unit,
        value=error[at], tolerance=bound[at], ratio=ratio, alias_of=alias, cpu_time=cpu_time,
        derivation=f"{with_unit(bound[at], unit)} at {place}; in the median {np.median(looseness):.1g} "
        "of the accelerations' effect on a step; truth: the declared formula in extended precision "
        "(docs/integrators.md)",
        extra={"comparisons": error.size, "bound_relative": np.max(looseness),
               "state": worst.state, "step": worst.step, "steps": worst.count},
    )  # fmt: skip


def _run_rows(
    context: RowContext, integrator: Integrator, model: Model, state: State, answer: StepEvaluation
) -> list[Row]:
    """The rows of every step of a run; one where it is not compared."""
    method, attempt = integrator.method, answer.run
    if attempt is None:
        return []

    def one(verdict: Verdict, reason: str) -> list[Row]:
        return [context.make_row("step", integrator.name, "run", verdict, reason)]

    def none(found: NoAnswer, before: str = "") -> list[Row]:
        return [context.make_no_answer_row("step", integrator.name, "run", found, before)]

    run, h = attempt.run, attempt.step
    failed = none(attempt.failure, f"in a run of {h:g} s per step: ") if attempt.failure else []
    if failed and not (run and isinstance(method, JointSpaceMethod)):
        return failed
    if run is None:
        assert attempt.refusal is not None
        return none(attempt.refusal)
    if not HAS_EXTENDED_PRECISION:
        return one(Verdict.UNSUPPORTED, NO_EXTENDED_PRECISION)
    if isinstance(method, ConstrainedMethod):
        parts = constrained_deviations(method, model, run, h)
        found = {f"run_{name}": joined(some) for name, some in parts.items()}
        found["run_samples"] = constrained_samples(run, state, h)
    elif not keeps_dependent_rows(model, state):
        return one(Verdict.INFORMATION, OPEN_ROWS)
    elif run.trajectory.coordinates is None:
        return one(Verdict.INFORMATION, NO_COORDINATES)
    else:
        assert method is not None
        try:
            steps = RunSteps(method, model, state, h, run)
        except EngineFailure as error:
            return one(Verdict.FAILED, str(error))
        for tried in (*answer.larger, attempt):
            if tried.failure and _should_go_on(method, model, state, tried, run.angle_axes):
                return none(tried.failure, f"in a run of {tried.step:g} s per step: ")
        found = steps.compare()
    alias = None if model.has_drag else integrator.alias_of
    remark = "".join(f"; in a run of {one.step:.4g} s per step {one.failure.message}"
                     for one in answer.larger if one.failure)  # fmt: skip
    if attempt.failure:
        remark += f"; after these {attempt.failure.message}"
    if remark and isinstance(method, JointSpaceMethod):
        remark += ": with this step the method itself does not resolve the rest"
    return [
        _run_row(context, integrator, quantity, deviations, h, run, alias, answer.cpu_time, remark)
        for quantity, deviations in found.items()
    ]


def _should_go_on(
    method: JointSpaceMethod, model: Model, state: State, attempt: StepAttempt, angle_axes: Array | None
) -> bool:
    """Whether the method itself resolves the steps of a run in which the engine has failed."""
    done = 0 if attempt.run is None else len(attempt.run.trajectory.t) - 1
    count = next(count for count in run_counts(model.n) if count > done)  # the least that failed
    return resolves_steps(method, model, state, attempt.step, count, attempt.run, angle_axes)


def _left_out_words(found: StepDeviations, unit: str) -> tuple[str, int]:
    """What a row says of the steps without a bound, and how many of them are off by more than one."""
    left_out = found.is_left_out
    reasons, numbers = np.unique(found.left_out[left_out], return_counts=True)
    causes = [f"{number} ({why})" for why, number in zip(reasons, numbers, strict=True)]
    off = found.ratios_of_all[left_out]
    is_off = ~(off <= 1)
    wrong = int(np.count_nonzero(np.any(is_off, axis=1)))
    words = f"; {np.count_nonzero(left_out)} steps have no bound: {', '.join(causes)}"
    if wrong:
        size = np.max(found.errors[left_out][is_off])
        words += (
            f", of which {wrong} differ by more than one would allow, at most by {with_unit(size, unit, 3)}"
        )
    return words, wrong


def _run_row(
    context: RowContext, integrator: Integrator, quantity: str, found: StepDeviations, h: float,
    run: StepRun, alias: str | None, cpu_time: float, remark: str,
) -> Row:  # fmt: skip
    """The row of one quantity at every step: the worst step decides, the first wrong one is named.

    Args:
        remark: on failures of the engine.

    """
    (name, unit), ratios = RUN_QUANTITIES[quantity], found.ratios
    ratios = np.where(np.isnan(ratios), np.inf, ratios)
    worst, column = at = np.unravel_index(np.argmax(ratios), ratios.shape)
    ratio, wrong = ratios[at], np.flatnonzero(np.any(ratios > 1, axis=1))
    has_bodies, count, left_out = quantity not in TOTALS, len(ratios), found.is_left_out
    body = column if has_bodies else 0
    sharp = (found.bounds <= MAX_STEP_BOUND * found.effects) | (found.effects == 0)
    sharp &= ~left_out[:, None]
    extra: dict[str, Any] = {"step": h, "worst_step": worst + 1, "comparisons": ratios.size}
    what = f"{name} of {count} steps of {h:.4g} s"
    if ratio > 1:
        first = wrong[0]
        verdict = Verdict.DISAGREES
        reason = (
            f"{context.title} does not take the declared step of {integrator.name}: {what} is off first at "
            f"step {first + 1} (t = {run.trajectory.t[first]:.6g} s), and at {len(wrong)} in all; at most by "
            f"{with_unit(found.errors[at], unit, 3)} at step {worst + 1}, {ratio:.3g} times the "
            "rounding bound"
        )
        if quantity != "run_mean":
            extra |= {"first_step": first + 1, "wrong_steps": len(wrong)}
        else:
            reason = (
                f"{context.title} does not take the declared step of {integrator.name}: over a run of steps "
                f"of {h:.4g} s the rates of body {body + 1} are off in one direction, by {ratio:.3g} times "
                "what rounding explains in the mean"
            )
    elif np.mean(sharp) < 0.5:
        # Single steps are larger, and decide.  Of long trees, which have none, a refinement study does: such
        # a row does not count in `compares_every_step`.
        verdict = Verdict.INFORMATION
        reason = (
            f"not compared: at {np.mean(~sharp):.0%} of the steps there is no bound, or it is above "
            f"{MAX_STEP_BOUND:g} of the accelerations' effect, too loose to detect an error"
        )
    else:
        verdict = Verdict.AGREES
        reason = f"{what} within {ratio:.2g} of the rounding bound, each from the sample before"
        if quantity == "run_mean":
            reason = f"no direction in the deviations of the steps: {ratio:.2g} of what rounding explains"
    if quantity != "run_mean" and (number := np.count_nonzero(left_out)):
        words, off = _left_out_words(found, unit)
        extra |= {"left_out_steps": number, "left_out_wrong_steps": off}
        reason += words
    reason += remark
    return context.make_row(
        "step", integrator.name, quantity, verdict, reason, unit,
        value=found.errors[at], tolerance=found.bounds[at], ratio=ratio,
        alias_of=alias, cpu_time=cpu_time, extra=extra,
        derivation=f"{with_unit(found.bounds[at], unit)} at step {worst + 1}"
        + f", body {body + 1}" * has_bodies + "; truth: the declared formula in extended precision, from the "
        "engine's own sample before (docs/integrators.md)",
    )  # fmt: skip
