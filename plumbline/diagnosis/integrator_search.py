"""Find the integrator whose step an engine took in place of the declared one.

The engine's steps are compared with those of other formulas, and with the declared one with another
parameter, which is fitted to the first steps.  A formula is named where it explains the steps from all
states, of all sizes and numbers, to rounding; all that do are named; parameters are fitted only where no
formula does.  Descriptions complete "behaves as if …".
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from plumbline.diagnosis.cause import Cause, Diagnosis, significant
from plumbline.diagnosis.digit_loss import MIN_SCATTER, measure_step_scatter, scatter_cause
from plumbline.engines.engine_calls import StepAttempt, StepEvaluation
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Model, State, StepRun, Trajectory
from plumbline.model.kinematics import angular_velocity, quaternion_rate, rotation_matrix
from plumbline.model.step_methods import (
    ConstrainedMethod,
    JointSpaceMethod,
    StepMethod,
    classical_runge_kutta,
    generalized_alpha,
)
from plumbline.truth.step_comparison import (
    RESIDUAL_STEPS,
    FormulaSteps,
    Place,
    Runs,
    RunSteps,
    compare_parts,
    quadrature_residuals,
    step_counts,
)

MIN_DIAGNOSABLE_RATIO = 8.0  # in bounds: a smaller difference may be explained by chance
SCREENING_RATIO = 4.0  # of first steps, in bounds of the declared formula
STEPS_OF_A_RUN = 4  # that are explained, the worst
RUN_STEP_QUANTITIES = ("run_position", "run_attitude", "run_velocity", "run_rate")
FIT_ITERATIONS = 15
FIT_STEP = 1e-6
SIMPLE_VALUES = (0.0, 0.25, 0.5, 1.0, 2.0, -1.0, 1 / 3, 1 / 6)
UNEXPLAINED = Cause("unexplained", "steps", "", "no other integrator, and no other parameter of this one")
CLOSE = Cause("unexplained", "steps", "", "close")

Residuals = Callable[[StepMethod], Array]


@dataclass(frozen=True)
class Alternative:
    """A formula, or a family of them with one parameter x that is fitted."""

    describe: Callable[[float, float], str]  # x and its resolution → the completion of "behaves as if"
    method: Callable[[float], StepMethod]
    declared: float | None = None  # x of the declared formula; None: nothing is fitted
    start: float = 0.0  # x where the fit starts


def explain_disagreeing_steps(
    engine: str, integrator: str, model: Model, states: Sequence[State], answer: StepEvaluation,
    is_known: bool,
) -> Diagnosis:  # fmt: skip
    """Diagnose steps that disagree with their formula; loads the engine, so call it in a worker.

    Args:
        integrator: name of one of its integrators, with a declared method.
        states: states that the steps start from.
        is_known: whether the cause is on record as rounding: then only the scatter of the error is measured.

    Returns:
        The sentence of `explain_steps`, where it names nothing with the scatter of the steps' error.

    """
    adapter = load_adapter(engine)
    method = adapter.integrator(integrator).method
    assert method is not None
    causes = explain_steps(model, states, method, answer) if answer.attempts and not is_known else ()
    if answer.run is not None and answer.run.run is not None and (causes == (CLOSE,) or not answer.attempts):
        if isinstance(method, ConstrainedMethod):
            return Diagnosis(causes)
        states, answer = _worst_steps(model, states[0], method, answer.run.run, answer.run.step)
        causes = () if is_known else explain_steps(model, states, method, answer)
    if isinstance(method, ConstrainedMethod) or causes not in ((), (UNEXPLAINED,)):
        return Diagnosis(causes)
    runs = [(a.state, a.step, a.run) for a in answer.attempts if a.run is not None]
    starts = [(index, h, run.angle_axes) for index, h, run in runs]
    taken = max(len(run.trajectory.t) - 1 for *_, run in runs)
    counts = [count for count in step_counts(method) if count <= taken]
    found = FormulaSteps(method, model, states, starts, counts).compare([run for *_, run in runs])
    compared = [pair for c in found.values() for pair in zip(c.ratios, c.places, strict=True)]
    _, worst = max(compared, key=lambda pair: pair[0], default=(0.0, Place(*runs[0][:2], 1)))
    index, h = worst.state, worst.step

    def step(model: Model, state: State) -> StepRun:
        return adapter.step(model, state, integrator, h, RESIDUAL_STEPS)

    scatter = measure_step_scatter(model, states[index], h, method, step)
    if scatter is None or (causes and scatter < MIN_SCATTER):
        return Diagnosis(causes)
    return Diagnosis((scatter_cause(["steps"], scatter),), scatter=scatter)


def _worst_steps(
    model: Model, state: State, method: JointSpaceMethod, run: StepRun, h: float
) -> tuple[list[State], StepEvaluation]:
    """The steps of a run that are furthest off, each as one from a state of its own."""
    steps = RunSteps(method, model, state, h, run)
    found = steps.compare()
    ratios = np.max([np.max(found[name].ratios, axis=1) for name in RUN_STEP_QUANTITIES], axis=0)
    worst = np.sort(np.argsort(ratios)[-STEPS_OF_A_RUN:])
    motion, attempts = run.trajectory, list[StepAttempt]()
    for index, n in enumerate(worst.tolist()):
        two = {name: getattr(motion, name)[n : n + 2] for name in ("r", "p", "v", "pdot")}
        piece = Trajectory(t=np.array([0.0, h]), steps=1, **two)
        attempts.append(StepAttempt(index, h, replace(run, trajectory=piece)))
    return [steps.states[n] for n in worst], StepEvaluation(attempts, 0.0)


def explain_steps(
    model: Model, states: Sequence[State], method: StepMethod, answer: StepEvaluation
) -> tuple[Cause, ...]:
    """Name the integrator that explains an engine's steps.

    Args:
        states: states that the steps start from.
        method: the declared formula, from which the steps differ.

    Returns:
        The causes: another formula or parameter, or that none explains the steps.

    """
    found = [(a.state, a.step, a.run) for a in answer.attempts if a.run is not None]
    if isinstance(method, ConstrainedMethod):
        return _explain_constrained_steps(model, states, method, found)
    runs, starts = [run for *_, run in found], [(index, h, run.angle_axes) for index, h, run in found]
    steps = FormulaSteps(method, model, states, starts)
    worst = max((max(c.ratios, default=0.0) for c in steps.compare(runs).values()), default=0.0)
    if worst <= MIN_DIAGNOSABLE_RATIO:
        return (CLOSE,)

    def residuals(other: StepMethod) -> Array:
        assert isinstance(other, JointSpaceMethod)
        return steps.residuals(other, runs)

    def remaining(other: StepMethod) -> float:
        assert isinstance(other, JointSpaceMethod)
        found = FormulaSteps(other, model, states, starts).compare(runs)
        ratios = [ratio for c in found.values() for ratio in c.ratios]
        # a step that leads another formula into a singularity is compared with nothing: not explained
        return max(ratios) if len(ratios) and len(ratios) >= comparisons else np.inf

    comparisons = sum(len(c.ratios) for c in steps.compare(runs).values())
    read = [
        cause
        for cause, correct in sample_readings(model)
        if all(max(c.ratios, default=0.0) <= 1.0 for c in steps.compare([correct(x) for x in runs]).values())
    ]
    if read:
        return (replace(read[0], equal=tuple(read[1:])),)
    if method.implicit_forces == "joint dampers" and not np.any(model.damping):
        method = replace(method, implicit_forces="none")  # the same step
    return (_best(list(_joint_space_alternatives(method, model)), residuals, remaining),)


def sample_readings(model: Model) -> Iterator[tuple[Cause, Callable[[StepRun], StepRun]]]:
    """List in which other frames, or at which other points, an engine's samples may hold the velocities.

    Yields:
        The cause, and what turns such samples into right ones.

    """
    frames, arms = rotation_matrix(model.turn[: model.n, 1]), model.proximal[: model.n]

    def corrected(change: Callable[[Array, Array, Array], Any]) -> Callable[[StepRun], StepRun]:
        def correct(run: StepRun) -> StepRun:
            motion = run.trajectory
            v, omega = change(rotation_matrix(motion.p), motion.v, angular_velocity(motion.p, motion.pdot))
            return replace(run, trajectory=replace(motion, v=v, pdot=quaternion_rate(motion.p, omega)))

        return correct

    of_points, angular = "those of the joints' points", "angular velocities"
    for term, words, change in (
        ("velocities", "in the body frame", lambda a, v, w: (np.matvec(a, v), w)),
        ("velocities", of_points, lambda a, v, w: (v - np.matvec(a, np.cross(w, arms)), w)),
        (angular, "in the world frame", lambda a, v, w: (v, np.matvec(a.mT, w))),
        (angular, "in the joints' axes", lambda a, v, w: (v, np.matvec(frames, w))),
    ):
        yield Cause("frame", f"{term} of samples", "", words), corrected(change)


def _best(
    alternatives: Sequence[Alternative],
    residuals: Residuals,
    remaining: Callable[[StepMethod], float],
    term: str = "steps",
) -> Cause:
    """The alternatives that explain all steps, as one cause; formulas come before families."""
    found: list[Cause] = []
    for alternative in alternatives:
        if found and alternative.declared is not None:
            continue
        x, resolution = _fit(alternative, residuals)
        method = alternative.method(x)
        with np.errstate(all="ignore"):
            if not np.max(np.abs(residuals(method))) <= SCREENING_RATIO:
                continue
            left = remaining(method)
        if left <= 1.0:
            words, declared = alternative.describe(x, resolution), alternative.declared
            amount, nominal = ((), ()) if declared is None else ((x,), (declared,))
            found.append(Cause("method", term, "", words, amount, nominal, "", resolution, left))
    return replace(found[0], equal=tuple(found[1:])) if found else replace(UNEXPLAINED, term=term)


def _fit(alternative: Alternative, residuals: Residuals) -> tuple[float, float]:
    """Parameter and its resolution, by Gauss–Newton iterations; a simple value where it is as good."""
    if alternative.declared is None:
        return 0.0, 0.0
    x, resolution = alternative.start, 0.0
    with np.errstate(all="ignore"):
        for _ in range(FIT_ITERATIONS):
            here = residuals(alternative.method(x))
            slope = (residuals(alternative.method(x + FIT_STEP)) - here) / FIT_STEP
            square = float(slope @ slope)
            if not 0 < square < np.inf:
                return alternative.declared, 0.0
            resolution = 1 / float(np.max(np.abs(slope)))
            change = float(slope @ here) / square
            x -= float(np.clip(change, -1.0, 1.0))
            if abs(change) < resolution / 100:
                break
    near = min(SIMPLE_VALUES, key=lambda value: abs(value - x))
    return (near if abs(near - x) <= max(2 * resolution, 1e-12) else x), resolution


# -- joint coordinates -------------------------------------------------------------------------------

CLASSICAL = classical_runge_kutta("joint rotations")
R = 5.0**0.5
TABLEAUS: dict[str, tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]] = {
    "the explicit midpoint rule (order 2)": (((), (0.5,)), (0.0, 1.0)),
    "Heun's method of order 2": (((), (1.0,)), (0.5, 0.5)),
    "Kutta's method of order 3": (((), (0.5,), (-1.0, 2.0)), (1 / 6, 2 / 3, 1 / 6)),
    "Heun's method of order 3": (((), (1 / 3,), (0.0, 2 / 3)), (0.25, 0.0, 0.75)),
    "the classical Runge–Kutta method": (CLASSICAL.stages, CLASSICAL.weights),
    "the classical Runge–Kutta method with its third stage by the first slope":
        (((), (0.5,), (0.5, 0.0), (0.0, 0.0, 1.0)), CLASSICAL.weights),
    "Kutta's 3/8 rule": (((), (1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0)), (1 / 8, 3 / 8, 3 / 8, 1 / 8)),
    "Butcher's method of order 6": (  # J. Austral. Math. Soc. 4 (1964) 179-194
        ((), (0.5 - R / 10,), (-R / 10, 0.5 + R / 5), (7 * R / 20 - 0.75, R / 4 - 0.25, 1.5 - 7 * R / 10),
         (1 / 12 - R / 60, 0.0, 1 / 6, 7 * R / 60 + 0.25),
         (1 / 12 + R / 60, 0.0, 0.75 - 5 * R / 12, 1 / 6, 3 * R / 10 - 0.5),
         (1 / 6, 0.0, 25 * R / 12 - 55 / 12, -7 * R / 12 - 25 / 12, 5 - 2 * R, 2.5 + R / 2)),
        (1 / 12, 0.0, 0.0, 0.0, 5 / 12, 5 / 12, 1 / 12)),
}  # fmt: skip


def _joint_space_alternatives(declared: JointSpaceMethod, model: Model) -> Iterator[Alternative]:
    """Other formulas in the same coordinates, then the declared one with another parameter."""
    seen = [declared]
    for words, method in _other_formulas(declared, model):
        if method not in seen:
            seen.append(method)
            yield _formula(words, method)
    yield _parameter(declared, "step_factor", "it took a step {} times as long as asked", 1.0)
    if model.rods.any() and declared.coordinates == "joint rotations":
        words = "the axial inertia of rods were {} of the trace of the inertia that they carry"
        yield _parameter(declared, "rod_axial_inertia", words, declared.rod_axial_inertia)
    if declared.implicit_forces != "none":
        words = "the derivatives of forces in the matrix were {} times as large"
        yield _parameter(declared, "damping_factor", words, 1.0)
    if declared.formula == "semi-implicit Euler":
        words = "it moved positions by {} of the new velocity and the rest of the old one"
        yield _parameter(declared, "new_velocity_share", words, 1.0)
    for i in range(len(declared.weights)):
        for j in range(i):
            yield _exchanged_weights(declared, i, j)


def _other_formulas(declared: JointSpaceMethod, model: Model) -> Iterator[tuple[str, JointSpaceMethod]]:
    if model.has_loops and declared.gap_correction:
        yield "it did not correct the gaps of loops", replace(declared, gap_correction=0.0)
    euler = JointSpaceMethod(
        "semi-implicit Euler", declared.coordinates, declared.rod_axial_inertia,
        free_coordinates=declared.free_coordinates, gap_correction=declared.gap_correction,
    )  # fmt: skip
    is_euler = declared.formula == "semi-implicit Euler"
    verlet = replace(euler, formula="velocity Verlet")
    reused = "step, with the last acceleration of the step before in place of its first"
    yield from {
        "it took explicit Euler's step: positions by the old velocity": replace(
            euler, new_velocity_share=0.0
        ),
        "it took semi-implicit Euler's step, with all forces explicit": euler,
        "it exchanged the halves of semi-implicit Euler: positions first": replace(
            euler, formula="positions first"
        ),
        "it took velocity Verlet's step": verlet,
        f"it took velocity Verlet's {reused}": replace(verlet, reuses_acceleration=True),
        f"it took its declared {reused}": replace(declared, reuses_acceleration=True),
        "it moved positions by the mean of the old and the new velocity": replace(
            declared if is_euler else euler, new_velocity_share=0.5
        ),
    }.items()
    if declared.coordinates == "joint rotations":
        if model.has_drag:
            words = "it took semi-implicit Euler's step, with the drag implicit and velocity terms explicit"
            yield words, replace(euler, implicit_forces="applied")
        words = "it took semi-implicit Euler's step, with all forces implicit"
        yield words, replace(euler, implicit_forces="all")
        words = "it moved quaternions by p + h ṗ and normalised them"
        yield words, replace(declared, is_rotation_exact=False)
    if declared.implicit_forces != "none":
        words = "it symmetrised the derivatives of forces in the matrix"
        yield words, replace(declared, is_damping_symmetric=True)
        yield "it moved positions by the old velocity", replace(declared, new_velocity_share=0.0)
    for count in (2, 3, 4):
        yield f"it took {count} steps of 1/{count} of the size", replace(declared, substeps=count)
    if is_euler:
        names = [(f"rod {k + 1}",) * int(model.rods[k]) + (f"body {k + 1}",) for k in range(model.n)]
        for j, name in enumerate(itertools.chain.from_iterable(names)):
            words = f"it moved the joint of {name} by the old velocity (stale)"
            yield words, replace(declared, stale_joint=j)
    yield from _runge_kutta_formulas(declared)


def _runge_kutta_formulas(declared: JointSpaceMethod) -> Iterator[tuple[str, JointSpaceMethod]]:
    base = classical_runge_kutta(
        declared.coordinates, declared.rod_axial_inertia, declared.free_coordinates, declared.gap_correction
    )
    for name, (stages, weights) in TABLEAUS.items():
        yield f"it took the step of {name}", replace(base, stages=stages, weights=weights)
    if declared.coordinates == "joint rotations":
        for count, words in enumerate(
            ("left dexp⁻¹ out of Runge–Kutta's stages (θ̇ = v: order 2)", "cut dexp⁻¹ after θ×v/2",
             "cut dexp⁻¹ after θ×(θ×v)/12")
        ):  # fmt: skip
            yield f"it {words}", replace(base, correction_terms=count)


def _formula(words: str, method: StepMethod) -> Alternative:
    """A formula without a free parameter."""
    return Alternative(lambda *_: words, lambda _: method)


def _parameter(
    declared: StepMethod, name: str, words: str, value: float, start: float | None = None
) -> Alternative:
    """The declared formula with another value of one field."""
    return Alternative(
        lambda x, resolution: (
            words.format(f"{significant(x, value, resolution):.15g}") + f" (declared: {value:.6g})"
        ),
        lambda x: replace(declared, **{name: x}),  # type: ignore[arg-type]
        value,
        value if start is None else start,
    )


def _exchanged_weights(declared: JointSpaceMethod, i: int, j: int) -> Alternative:
    """Weight i by x more, weight j by x less."""

    def method(x: float) -> JointSpaceMethod:
        weights = list(declared.weights)
        weights[i] += x
        weights[j] -= x
        return replace(declared, weights=tuple(weights))

    def describe(x: float, resolution: float) -> str:
        size = f"{significant(abs(x), 0.0, resolution):.15g}"
        more, less = (i, j) if x > 0 else (j, i)
        return f"the weight of stage {more + 1} were larger by {size} and that of stage {less + 1} smaller"

    return Alternative(describe, method, 0.0)


# -- constraints -------------------------------------------------------------------------------------


def _explain_constrained_steps(
    model: Model, states: Sequence[State], declared: ConstrainedMethod, runs: Runs
) -> tuple[Cause, ...]:
    ratios = {name: max(c.ratios) for name, c in compare_parts(declared, model, states, runs).items()}
    parts = []
    first = ratios.pop("step_first_acceleration", 0.0)
    if first > MIN_DIAGNOSABLE_RATIO:
        accelerations = [run.coordinate_acceleration for *_, run in runs]
        if all(a is not None and not np.any(a[0]) for a in accelerations):
            parts.append(Cause("method", "first accelerations", "", "the first accelerations were 0"))
        else:
            parts.append(Cause("unexplained", "first accelerations", "", "no other integrator"))
    if max(ratios.values()) > MIN_DIAGNOSABLE_RATIO:

        def residuals(other: StepMethod) -> Array:
            assert isinstance(other, ConstrainedMethod)
            return quadrature_residuals(other, runs, model.has_loops)

        def remaining(names: Collection[str], other: StepMethod) -> float:
            assert isinstance(other, ConstrainedMethod)
            found = compare_parts(other, model, states, runs)
            return max(max(found[name].ratios) for name in names)

        cause = _best(list(_constrained_alternatives(declared)), residuals, partial(remaining, ratios))
        if not cause.is_explained and ratios["step_quadrature"] > MIN_DIAGNOSABLE_RATIO:
            same_level = list(_constrained_alternatives(declared, is_level_fixed=True))
            of_quadrature = partial(remaining, ["step_quadrature"])
            alone = _best(same_level, residuals, of_quadrature, "quadrature alone")
            cause = alone if alone.is_explained else cause
        parts.append(cause)
    return tuple(parts) or (CLOSE,)


def _constrained_alternatives(
    declared: ConstrainedMethod, *, is_level_fixed: bool = False
) -> Iterator[Alternative]:
    """Other formulas with constraints on both levels, then the declared one with another parameter."""
    other: Literal["position", "velocity"] = (
        "velocity" if declared.constraint_level == "position" else "position"
    )
    words = {"position": " with constraints on positions (index 3)",
             "velocity": " with constraints on velocities (index 2)"}[other]  # fmt: skip
    levels = [(declared, ""), (replace(declared, constraint_level=other), words)][: 2 - is_level_fixed]
    seen = [declared]
    for base, at_level in levels:
        newmark = replace(base, alpha_m=0.5, alpha_f=0.5, beta=0.25, gamma=0.5)
        for text, method in {
            "it took its declared step": base,
            "it took the step of the trapezoidal rule (Newmark, β = ¼, γ = ½)": newmark,
            "αm had the opposite sign": replace(base, alpha_m=-base.alpha_m),
            "αm and αf were exchanged": replace(base, alpha_m=base.alpha_f, alpha_f=base.alpha_m),
            "a were q̈ (αm = αf = 0)": replace(base, alpha_m=0.0, alpha_f=0.0),
        }.items():
            if method not in seen and not (base.alpha_m == base.alpha_f and "αf" in text):
                seen.append(method)
                yield _formula(text + at_level, method)
    for base, at_level in levels:
        yield _generalized_alpha_family(base, at_level)
        for name, symbol in (("alpha_m", "αm"), ("alpha_f", "αf"), ("beta", "β"), ("gamma", "γ")):
            value = getattr(declared, name)
            yield _parameter(base, name, f"{symbol} were {{}}{at_level}", value, start=value + 0.01)


def _generalized_alpha_family(base: ConstrainedMethod, at_level: str) -> Alternative:
    declared = base.alpha_f / (1 - base.alpha_f)

    def describe(x: float, resolution: float) -> str:
        radius = f"{significant(x, declared, resolution):.15g}"
        return f"it took the generalised-α step with spectral radius {radius}{at_level}"

    def method(x: float) -> ConstrainedMethod:
        other = generalized_alpha(
            x,
            solver_atol=base.solver_atol,
            solver_rtol=base.solver_rtol,
            difference_step=base.difference_step,
        )
        return replace(other, constraint_level=base.constraint_level)

    return Alternative(describe, method, declared, 0.95)
