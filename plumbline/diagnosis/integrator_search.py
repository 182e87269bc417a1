"""Find what explains steps that differ from the declared formula: an integrator, numbers, samples.

The engine's steps are compared with those of other formulas, of the declared one with another parameter, and
of mechanisms with one number wrong (`edits`), as states are; amounts are fitted to the first steps.  What
explains the steps from all states, of all sizes and numbers, to rounding is named: all formulas that do; else
the first parameter that does; else all numbers that do.  Of a run it has to explain every step that differs,
and `occurrence` finds what these have in common.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from plumbline.diagnosis.cause import Cause, Diagnosis, significant
from plumbline.diagnosis.digit_loss import MIN_SCATTER, measure_step_scatter, scatter_cause
from plumbline.diagnosis.edits import Edit, number_edits
from plumbline.diagnosis.occurrence import occurrence_in_run
from plumbline.diagnosis.prediction import Case
from plumbline.engines.engine_calls import StepEvaluation
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Model, State, StepRun
from plumbline.model.kinematics import angular_velocity, quaternion_rate, rotation_matrix, stack_states
from plumbline.model.step_methods import (
    TABLEAUS,
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
    StepDeviations,
    compare_parts,
    constrained_deviations,
    joined,
    quadrature_residuals,
)

MIN_DIAGNOSABLE_RATIO = 8.0  # in bounds: a smaller difference may be explained by chance
SCREENING_RATIO = 4.0  # of first steps, in bounds of the declared formula
STEPS_OF_A_RUN = 4  # that are screened, the worst
FIT_ITERATIONS = 15
FIT_STEP = 1e-6
SIMPLE_VALUES = (0.0, 0.25, 0.5, 1.0, 2.0, -1.0, 1 / 3, 1 / 6)
MIN_SIMILARITY, MAX_NUMBERS = 0.5, 12  # cosine of a number's effect and the difference; so many are fitted
UNEXPLAINED = Cause("unexplained", "steps", "", "no other integrator, parameter of this one or number")
CLOSE = Cause("unexplained", "steps", "", "close")

Read = Callable[[StepRun], StepRun]  # samples as an engine may hold them → right ones


@dataclass(frozen=True)
class Alternative:
    """A formula, mechanism or reading of samples, or a family of them with one parameter x that is fitted."""

    cause: Callable[[float, float], Cause]  # of x and its resolution
    method: Callable[[float], StepMethod]
    declared: float | None = None  # x of what is declared; None: nothing is fitted
    start: float = 0.0  # x where the fit starts
    model: Callable[[float], Model] | None = None
    read: Callable[[float], Read] | None = None


class Evidence(Protocol):
    """Steps of an engine, and how far they are from those of an alternative."""

    def residuals(self, alternative: Alternative, x: float) -> Array:
        """Return the differences of first or worst steps, in rounding bounds of the declared formula."""

    def left(self, alternative: Alternative, x: float) -> float:
        """Return the largest difference of all steps, in rounding bounds."""


class _SingleSteps:
    """Steps from given states."""

    def __init__(
        self, model: Model, states: Sequence[State], method: JointSpaceMethod, answer: StepEvaluation
    ) -> None:
        found = [(a.state, a.step, a.run) for a in answer.attempts if a.run is not None]
        self.model, self.states, self.runs = model, states, [run for *_, run in found]
        self.starts = [(index, h, run.angle_axes) for index, h, run in found]
        self.steps = FormulaSteps(method, model, states, self.starts)
        compared = self.steps.compare(self.runs).values()
        pairs = [pair for c in compared for pair in zip(c.ratios, c.places, strict=True)]
        self.ratios = [ratio for ratio, _ in pairs]
        first = Place(*found[0][:2], 1)
        _, self.worst = max(pairs, key=lambda pair: pair[0], default=(0.0, first))
        wrong = {(at.state, at.step) for ratio, at in pairs if not ratio <= 1}
        self.differing = [a for a in answer.attempts if (a.state, a.step) in wrong]

    def _ratios(self, steps: FormulaSteps, runs: Sequence[StepRun]) -> list[float]:
        return [ratio for c in steps.compare(runs).values() for ratio in c.ratios]

    def _runs(self, alternative: Alternative, x: float) -> list[StepRun]:
        return [alternative.read(x)(run) for run in self.runs] if alternative.read else self.runs

    def residuals(self, alternative: Alternative, x: float) -> Array:
        method, model = alternative.method(x), alternative.model
        assert isinstance(method, JointSpaceMethod)
        return self.steps.residuals(method, self._runs(alternative, x), model(x) if model else self.model)

    def left(self, alternative: Alternative, x: float) -> float:
        method, runs, steps = alternative.method(x), self._runs(alternative, x), self.steps
        assert isinstance(method, JointSpaceMethod)
        if alternative.read is None:
            model = alternative.model(x) if alternative.model else self.model
            steps = FormulaSteps(method, model, self.states, self.starts)
        ratios = self._ratios(steps, runs)
        # a step that leads another formula into a singularity is compared with nothing: not explained
        return max(ratios) if len(ratios) and len(ratios) >= len(self.ratios) else np.inf


class _StepsOfRun:
    """The steps of a run that differ, each from the engine's sample before."""

    def __init__(self, steps: RunSteps, run: StepRun) -> None:
        self.steps, self.run = steps, run
        found = steps.compare()
        self.deviations = [found[name] for name in found if name not in ("run_mean", "run_samples")]
        self.ratios = _ratios_of_steps(self.deviations)
        self.differs = np.flatnonzero(self.ratios > 1)
        self.worst = np.sort(np.argsort(self.ratios)[-STEPS_OF_A_RUN:])

    def residuals(self, alternative: Alternative, x: float) -> Array:
        return self._vectors(alternative, x, self.worst[self.ratios[self.worst] > 1]).ravel()

    def left(self, alternative: Alternative, x: float) -> float:
        vectors = self._vectors(alternative, x, self.differs)
        return float(np.max(np.linalg.norm(vectors, axis=-1), initial=0.0))

    def _vectors(self, alternative: Alternative, x: float, at: NDArray[np.intp]) -> Array:
        method, model = alternative.method(x), alternative.model
        run = alternative.read(x)(self.run) if alternative.read else self.run
        assert isinstance(method, JointSpaceMethod)
        return self.steps.differences_from(method, model(x) if model else self.steps.model, run, at)


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
        The causes by `explain_steps`, of a run with the steps that differ; where it names nothing with the
        scatter of the steps' error.

    """
    adapter = load_adapter(engine)
    method = adapter.integrator(integrator).method
    assert method is not None
    causes = explain_steps(model, states, method, answer) if answer.attempts and not is_known else ()
    run = answer.run.run if answer.run is not None else None
    if isinstance(method, ConstrainedMethod):
        if answer.run is None or run is None or is_known:
            return Diagnosis(causes)
        if causes in ((), (CLOSE,)):
            causes = _explain_constrained_steps(model, states, method, [(0, answer.run.step, run)])
        parts = constrained_deviations(method, model, run, answer.run.step)
        return Diagnosis(_with_occurrence(causes, model, run, [joined(some) for some in parts.values()]))
    of_run: _StepsOfRun | None = None
    if answer.run is not None and run is not None and run.trajectory.coordinates is not None:
        of_run = _StepsOfRun(RunSteps(method, model, states[0], answer.run.step, run), run)
        if not is_known and not any(cause.is_explained for cause in causes):
            found = _explained(of_run, float(np.max(of_run.ratios)), model, states[:1], method)
            causes = found if causes in ((), (CLOSE,)) or found[0].is_explained else causes
    is_named = causes not in ((), (UNEXPLAINED,))
    if of_run is not None:
        causes = _with_occurrence(causes, model, of_run.run, of_run.deviations)
    if is_named:
        return Diagnosis(causes)
    if answer.attempts:
        worst = _SingleSteps(model, states, method, answer).worst
        state, h = states[worst.state], worst.step
    else:
        assert of_run is not None
        state, h = of_run.steps.states[int(np.argmax(of_run.ratios))], of_run.steps.h

    def step(model: Model, state: State) -> StepRun:
        return adapter.step(model, state, integrator, h, RESIDUAL_STEPS)

    scatter = measure_step_scatter(model, state, h, method, step)
    if scatter is None or (causes and scatter < MIN_SCATTER):
        return Diagnosis(causes)
    return Diagnosis((scatter_cause(["steps"], scatter),), scatter=scatter)


def _ratios_of_steps(parts: Sequence[StepDeviations]) -> Array:
    """The largest ratio of each step (steps,)."""
    ratios = np.array([np.max(x.ratios, axis=1) for x in parts])
    return np.asarray(np.nan_to_num(np.max(ratios, axis=0), nan=np.inf))


def _with_occurrence(
    causes: tuple[Cause, ...], model: Model, run: StepRun, parts: Sequence[StepDeviations]
) -> tuple[Cause, ...]:
    """The causes with the steps of a run that differ."""
    differs, is_left_out = _ratios_of_steps(parts) > 1, np.any([x.is_left_out for x in parts], axis=0)
    if not np.any(differs):
        return causes
    where = occurrence_in_run(model, run.trajectory, differs, ~is_left_out)
    return tuple(replace(cause, occurrence=where) for cause in causes)


def explain_steps(
    model: Model, states: Sequence[State], method: StepMethod, answer: StepEvaluation
) -> tuple[Cause, ...]:
    """Name what explains an engine's steps.

    Args:
        states: states that the steps start from.
        method: the declared formula, from which the steps differ.

    Returns:
        The causes: another formula, parameter or number, or that none explains the steps.

    """
    if isinstance(method, ConstrainedMethod):
        found = [(a.state, a.step, a.run) for a in answer.attempts if a.run is not None]
        return _explain_constrained_steps(model, states, method, found)
    steps = _SingleSteps(model, states, method, answer)
    causes = _explained(steps, max(steps.ratios, default=0.0), model, states, method)
    if causes == (UNEXPLAINED,) and len(steps.differing) < len(steps.runs):
        steps = _SingleSteps(model, states, method, replace(answer, attempts=steps.differing))
        causes = _explained(steps, max(steps.ratios), model, states, method)
    return causes


def _explained(
    steps: Evidence, worst: float, model: Model, states: Sequence[State], method: JointSpaceMethod
) -> tuple[Cause, ...]:
    """The causes of steps in joint coordinates that are off by so many bounds."""
    if worst <= MIN_DIAGNOSABLE_RATIO:
        return (CLOSE,)
    read = [cause for cause in sample_readings(method, model) if steps.left(cause, 0.0) <= 1.0]
    if read:
        first, *others = [one.cause(0.0, 0.0) for one in read]
        return (replace(first, equal=tuple(others)),)
    if method.implicit_forces == "joint dampers" and not np.any(model.damping):
        method = replace(method, implicit_forces="none")  # the same step
    found = _best(_joint_space_alternatives(method, model), steps)
    if not found.is_explained:
        found = _best(_similar(_wrong_numbers(method, model, states), steps), steps, are_all_named=True)
    return (found,)


def sample_readings(method: StepMethod, model: Model) -> Iterator[Alternative]:
    """List in which other frames, or at which other points, an engine's samples may hold the velocities."""
    frames, arms = rotation_matrix(model.turn[: model.n, 1]), model.proximal[: model.n]

    def reading(term: str, words: str, change: Callable[[Array, Array, Array], Any]) -> Alternative:
        def correct(run: StepRun) -> StepRun:
            motion = run.trajectory
            v, omega = change(rotation_matrix(motion.p), motion.v, angular_velocity(motion.p, motion.pdot))
            return replace(run, trajectory=replace(motion, v=v, pdot=quaternion_rate(motion.p, omega)))

        cause = Cause("frame", f"{term} of samples", "", words)
        return Alternative(lambda *_: cause, lambda _: method, read=lambda _: correct)

    of_points, angular = "those of the joints' points", "angular velocities"
    yield reading("velocities", "in the body frame", lambda a, v, w: (np.matvec(a, v), w))
    yield reading("velocities", of_points, lambda a, v, w: (v - np.matvec(a, np.cross(w, arms)), w))
    yield reading(angular, "in the world frame", lambda a, v, w: (v, np.matvec(a.mT, w)))
    yield reading(angular, "in the joints' axes", lambda a, v, w: (v, np.matvec(frames, w)))


def _wrong_numbers(method: JointSpaceMethod, model: Model, states: Sequence[State]) -> Iterator[Alternative]:
    """The declared step of a mechanism with another number, and samples that are multiplied by a factor."""
    case = Case(model, stack_states(states[:1]))

    def of_edit(edit: Edit, change: Callable[[Case, Array], Case]) -> Alternative:
        def amount(x: float) -> Array:
            return edit.nominal + x * edit.scale

        def cause(x: float, resolution: float) -> Cause:
            return edit.cause.with_amount(amount(x), resolution * edit.scale)

        return Alternative(cause, lambda _: method, 0.0, 0.0, lambda x: change(case, amount(x)).model)

    yield _parameter(method, "acceleration_factor", "all accelerations were multiplied by {}", 1.0)
    yield _parameter(method, "rate_factor", "it multiplied the velocities after the step by {}", 1.0)
    for edit in number_edits(case):
        if edit.change is not None and edit.change(case, edit.nominal).state is case.state:
            yield of_edit(edit, edit.change)
    for name, what in {"r": "positions", "v": "velocities", "pdot": "rates of quaternions"}.items():
        cause = Cause("output", f"{what} of samples", "", "multiplied by", (), (1.0,))

        def read(x: float, name: str = name) -> Read:
            def correct(run: StepRun) -> StepRun:
                motion = run.trajectory
                return replace(run, trajectory=replace(motion, **{name: getattr(motion, name) / (1 + x)}))

            return correct

        yield Alternative(
            lambda x, resolution, cause=cause: replace(  # type: ignore[misc]
                cause, amount=(significant(1 + x, 1.0, resolution),), uncertainty=resolution
            ),
            lambda _: method, 0.0, 0.0, read=read,
        )  # fmt: skip


def _similar(alternatives: Iterable[Alternative], steps: Evidence) -> Iterator[Alternative]:
    """Those whose effect points along the difference, the most similar ones first."""
    found = list[tuple[float, int, Alternative]]()
    with np.errstate(all="ignore"):
        for one in alternatives:
            here = steps.residuals(one, 0.0)
            slope = steps.residuals(one, FIT_STEP) - here
            cosine = abs(float(slope @ here)) / max(
                float(np.linalg.norm(slope) * np.linalg.norm(here)), 1e-300
            )
            if cosine > MIN_SIMILARITY:  # not where it is no number
                found.append((-cosine, len(found), one))
    for _, _, one in sorted(found)[:MAX_NUMBERS]:
        yield one


def _best(
    alternatives: Iterable[Alternative], steps: Evidence, term: str = "steps", *, are_all_named: bool = False
) -> Cause:
    """The alternatives that explain all steps, as one cause; formulas come before families."""
    found: list[Cause] = []
    for alternative in alternatives:
        if found and alternative.declared is not None and not are_all_named:
            continue
        x, resolution = _fit(alternative, steps)
        with np.errstate(all="ignore"):
            if not np.max(np.abs(steps.residuals(alternative, x))) <= SCREENING_RATIO:
                continue
            left = steps.left(alternative, x)
        if left <= 1.0:
            cause = replace(alternative.cause(x, resolution), left=left)
            found.append(replace(cause, term=term) if cause.kind == "method" else cause)
    return replace(found[0], equal=tuple(found[1:])) if found else replace(UNEXPLAINED, term=term)


def _fit(alternative: Alternative, steps: Evidence) -> tuple[float, float]:
    """Parameter and its resolution, by Gauss–Newton iterations; a simple value where it is as good."""
    if alternative.declared is None:
        return 0.0, 0.0
    x, resolution = alternative.start, 0.0
    with np.errstate(all="ignore"):
        for _ in range(FIT_ITERATIONS):
            here = steps.residuals(alternative, x)
            slope = (steps.residuals(alternative, x + FIT_STEP) - here) / FIT_STEP
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
    return Alternative(lambda *_: Cause("method", "steps", "", words), lambda _: method)


def _family(
    describe: Callable[[float, float], str],
    method: Callable[[float], StepMethod],
    declared: float,
    start: float,
) -> Alternative:
    """Formulas with a parameter: from it and its resolution to the completion of "behaves as if"."""

    def cause(x: float, resolution: float) -> Cause:
        return Cause("method", "steps", "", describe(x, resolution), (x,), (declared,), "", resolution)

    return Alternative(cause, method, declared, start)


def _parameter(
    declared: StepMethod, name: str, words: str, value: float, start: float | None = None
) -> Alternative:
    """The declared formula with another value of one field."""
    return _family(
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

    return _family(describe, method, 0.0, 0.0)


# -- constraints -------------------------------------------------------------------------------------


class _ConstrainedSteps:
    """Steps of an iterative engine, compared in parts."""

    def __init__(self, model: Model, states: Sequence[State], runs: Runs, parts: Collection[str]) -> None:
        self.model, self.states, self.runs, self.parts = model, states, runs, parts

    def residuals(self, alternative: Alternative, x: float) -> Array:
        method = alternative.method(x)
        assert isinstance(method, ConstrainedMethod)
        return quadrature_residuals(method, self.runs, self.model.has_loops)

    def left(self, alternative: Alternative, x: float) -> float:
        method = alternative.method(x)
        assert isinstance(method, ConstrainedMethod)
        found = compare_parts(method, self.model, self.states, self.runs)
        return max(max(found[name].ratios) for name in self.parts)


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
        steps = _ConstrainedSteps(model, states, runs, ratios)
        cause = _best(_constrained_alternatives(declared), steps)
        if not cause.is_explained and ratios["step_quadrature"] > MIN_DIAGNOSABLE_RATIO:
            same_level = _constrained_alternatives(declared, is_level_fixed=True)
            of_quadrature = _ConstrainedSteps(model, states, runs, ["step_quadrature"])
            alone = _best(same_level, of_quadrature, "quadrature alone")
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

    return _family(describe, method, declared, 0.95)
