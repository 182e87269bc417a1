"""Find what explains steps that differ from the declared formula: an integrator, numbers, samples.

The engine's steps are compared with those of other formulas, of the declared one with another parameter, and
of mechanisms with one number wrong: edits, as of states, whose amounts are fitted to the first steps.  What
explains the steps from all states, of all sizes and numbers, to rounding is named: all formulas that do; else
the first parameter that does; else all numbers that do.  Of a run it has to explain every step that differs,
and `occurrence` finds what these have in common.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plumbline.diagnosis.cause import Cause, Diagnosis
from plumbline.diagnosis.digit_loss import MIN_SCATTER, measure_step_scatter, scatter_cause
from plumbline.diagnosis.edits import Edit, NumberChange, number_edits
from plumbline.diagnosis.fit import MIN_DIAGNOSABLE_RATIO, STEP, Lane, changed, fit_amounts, most_similar
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

SCREENING_RATIO = 4.0  # of first steps, in bounds of the declared formula
STEPS_OF_A_RUN = 4  # that are screened, the worst
MIN_SIMILARITY, MAX_NUMBERS = 0.5, 12  # cosine of a number's effect and the difference; so many are fitted
UNEXPLAINED = Cause("unexplained", "steps", "", "no other integrator, parameter of this one or number")
CLOSE = Cause("unexplained", "steps", "", "close")


class _Steps:
    """Steps of an engine as what is explained: by cases whose first steps differ from them by nothing."""

    def __init__(self, model: Model, states: Sequence[State], method: StepMethod) -> None:
        self.case, self.states = Case(model, stack_states(states[:1]), method), states

    def residuals(self, case: Case) -> Array:
        """Return the differences of first or worst steps, in rounding bounds of the declared formula."""
        raise NotImplementedError

    def left(self, case: Case) -> float:
        """Return the largest difference of all steps, in rounding bounds."""
        raise NotImplementedError

    def evaluate(self, lanes: Sequence[Lane]) -> Array:
        """Return what edits leave of the first steps, (lanes, m)."""
        with np.errstate(all="ignore"):
            return np.array([self.residuals(changed(self.case, *lane)) for lane in lanes])


class _SingleSteps(_Steps):
    """Steps from given states."""

    def __init__(
        self, model: Model, states: Sequence[State], method: JointSpaceMethod, answer: StepEvaluation
    ) -> None:
        super().__init__(model, states, method)
        self.runs = [run for *_, run in answer.runs]
        self.starts = [(index, h, run.angle_axes) for index, h, run in answer.runs]
        self.steps = FormulaSteps(method, model, states, self.starts)
        compared = self.steps.compare(self.runs).values()
        pairs = [(x, at) for c in compared for row, at in zip(c.ratios, c.places, strict=True) for x in row]
        self.ratios = [ratio for ratio, _ in pairs]
        first = Place(*self.starts[0][:2], 1)
        _, self.worst = max(pairs, key=lambda pair: pair[0], default=(0.0, first))
        wrong = {(at.state, at.step) for ratio, at in pairs if not ratio <= 1}
        self.differing = [a for a in answer.attempts if (a.state, a.step) in wrong]

    def residuals(self, case: Case) -> Array:
        return self.steps.residuals(case.method, [case.right_samples(run) for run in self.runs], case.model)

    def left(self, case: Case) -> float:
        steps = self.steps
        if case.read is None:
            steps = FormulaSteps(case.method, case.model, self.states, self.starts)
        compared = steps.compare([case.right_samples(run) for run in self.runs])
        ratios = [ratio for c in compared.values() for ratio in c.ratios.ravel()]
        # a step that leads another formula into a singularity is compared with nothing: not explained
        return max(ratios) if len(ratios) and len(ratios) >= len(self.ratios) else np.inf


class _StepsOfRun(_Steps):
    """The steps of a run that differ, each from the engine's sample before."""

    def __init__(self, steps: RunSteps, states: Sequence[State], run: StepRun) -> None:
        super().__init__(steps.model, states, steps.method)
        self.steps, self.run = steps, run
        found = steps.compare()
        self.deviations = [found[name] for name in found if name not in ("run_mean", "run_samples")]
        self.ratios = _ratios_of_steps(self.deviations)
        self.differs = np.flatnonzero(self.ratios > 1)
        self.worst = np.sort(np.argsort(self.ratios)[-STEPS_OF_A_RUN:])

    def residuals(self, case: Case) -> Array:
        return self._vectors(case, self.worst[self.ratios[self.worst] > 1]).ravel()

    def left(self, case: Case) -> float:
        return float(np.max(np.linalg.norm(self._vectors(case, self.differs), axis=-1), initial=0.0))

    def _vectors(self, case: Case, at: NDArray[np.intp]) -> Array:
        return self.steps.differences_from(case.method, case.model, case.right_samples(self.run), at)


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
        of_run = _StepsOfRun(RunSteps(method, model, states[0], answer.run.step, run), states, run)
        if not is_known and not any(cause.is_explained for cause in causes):
            found = _explained(of_run, float(np.max(of_run.ratios)))
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
        return _explain_constrained_steps(model, states, method, answer.runs)
    steps = _SingleSteps(model, states, method, answer)
    causes = _explained(steps, max(steps.ratios, default=0.0))
    if causes == (UNEXPLAINED,) and len(steps.differing) < len(steps.runs):
        steps = _SingleSteps(model, states, method, replace(answer, attempts=steps.differing))
        causes = _explained(steps, max(steps.ratios))
    return causes


def _explained(steps: _Steps, worst: float) -> tuple[Cause, ...]:
    """The causes of steps in joint coordinates that are off by so many bounds."""
    if worst <= MIN_DIAGNOSABLE_RATIO:
        return (CLOSE,)
    model, method = steps.case.model, steps.case.method
    if method.implicit_forces == "joint dampers" and not np.any(model.damping):
        method = replace(method, implicit_forces="none")  # the same step
    for edits, are_all_named in (
        (sample_readings(model), True),
        (_joint_space_edits(method, model), False),
        (_wrong_numbers(steps), True),
    ):
        found = _best(list(edits), steps, are_all_named=are_all_named)
        if found.is_explained:
            break
    return (found,)


def _best(edits: Sequence[Edit], steps: _Steps, term: str = "steps", *, are_all_named: bool = False) -> Cause:
    """The edits that explain all steps, as one cause: all without an amount, else the first with one."""
    batches = [[edit for edit in edits if not edit.cause.nominal]]
    with_amounts = [edit for edit in edits if edit.cause.nominal]
    batches += [with_amounts] if are_all_named else [[edit] for edit in with_amounts]
    found = list[Cause]()
    for batch in batches:
        starts = [((edit,), edit.start) for edit in batch]
        for one in fit_amounts(steps.evaluate, 0.0, SCREENING_RATIO, starts) if not found else ():
            with np.errstate(all="ignore"):
                left = steps.left(changed(steps.case, one.combination, one.amounts))
            if left <= 1.0:
                (cause,) = replace(one, left=left).causes(0)
                found.append(replace(cause, term=term) if cause.kind == "method" else cause)
    return replace(found[0], equal=tuple(found[1:])) if found else replace(UNEXPLAINED, term=term)


def _sample_change(change: Callable[[StepRun, Array], dict[str, Any]]) -> NumberChange:
    """Correct the motion of an engine's samples, by amounts or by none."""

    def of_case(case: Case, x: Array) -> Case:
        def read(run: StepRun) -> StepRun:
            return replace(run, trajectory=replace(run.trajectory, **change(run, x)))

        return replace(case, read=read)

    return of_case


def sample_readings(model: Model) -> Iterator[Edit]:
    """List in which other frames, or at which other points, an engine's samples may hold the velocities."""
    frames, arms = rotation_matrix(model.turn[: model.n, 1]), model.proximal[: model.n]

    def reading(term: str, words: str, right: Callable[[Array, Array, Array], Any]) -> Edit:
        def correct(run: StepRun, _: Array) -> dict[str, Any]:
            motion = run.trajectory
            v, omega = right(rotation_matrix(motion.p), motion.v, angular_velocity(motion.p, motion.pdot))
            return {"v": v, "pdot": quaternion_rate(motion.p, omega)}

        return Edit(Cause("frame", f"{term} of samples", "", words), _sample_change(correct))

    of_points, angular = "those of the joints' points", "angular velocities"
    yield reading("velocities", "in the body frame", lambda a, v, w: (np.matvec(a, v), w))
    yield reading("velocities", of_points, lambda a, v, w: (v - np.matvec(a, np.cross(w, arms)), w))
    yield reading(angular, "in the world frame", lambda a, v, w: (v, np.matvec(a.mT, w)))
    yield reading(angular, "in the joints' axes", lambda a, v, w: (v, np.matvec(frames, w)))


def _wrong_numbers(steps: _Steps) -> list[Edit]:
    """Other numbers of the mechanism, and factors of samples, whose effect points along the difference."""
    case = steps.case
    edits = [
        _parameter(case.method, "acceleration_factor", "all accelerations were multiplied by {}"),
        _parameter(case.method, "rate_factor", "it multiplied the velocities after the step by {}"),
        *(
            e
            for e in number_edits(case)
            if len(e.nominal) == 1 and changed(case, (e,), e.nominal).state is case.state
        ),
    ]
    for name, what in {"r": "positions", "v": "velocities", "pdot": "rates of quaternions"}.items():
        cause = Cause("output", f"{what} of samples", "", "multiplied by", (), (1.0,))
        divided = _sample_change(lambda run, x, name=name: {name: getattr(run.trajectory, name) / x[0]})  # type: ignore[misc]
        edits.append(Edit(cause, divided))
    at, *beside = steps.evaluate([((), np.zeros(0)), *(((e,), e.nominal + STEP * e.scale) for e in edits)])
    chosen = most_similar(np.array(beside) - at, at, MIN_SIMILARITY, MAX_NUMBERS)
    return [edits[i] for i in chosen]


# -- joint coordinates -------------------------------------------------------------------------------


def _joint_space_edits(declared: JointSpaceMethod, model: Model) -> Iterator[Edit]:
    """Other formulas in the same coordinates, then the declared one with another parameter."""
    yield from _formulas([declared], _other_formulas(declared, model))
    has_rods = bool(model.rods.any()) and declared.coordinates == "joint rotations"
    for applies, name, words in (
        (True, "step_factor", "it took a step {} times as long as asked"),
        (has_rods, "rod_axial_inertia",
         "the axial inertia of rods were {} of the trace of the inertia that they carry"),
        (declared.implicit_forces != "none", "damping_factor",
         "the derivatives of forces in the matrix were {} times as large"),
        (declared.formula == "semi-implicit Euler", "new_velocity_share",
         "it moved positions by {} of the new velocity and the rest of the old one"),
    ):  # fmt: skip
        if applies:
            yield _parameter(declared, name, words)
    for i, j in itertools.permutations(range(len(declared.weights)), 2):
        words = f"the weight of stage {i + 1} were larger by {{}} and that of stage {j + 1} smaller"
        yield _family(words, 0.0, partial(_with_weights, declared, i, j), can_vanish=False)


def _with_weights(declared: JointSpaceMethod, i: int, j: int, x: float) -> JointSpaceMethod:
    """Weight i by x more, weight j by x less."""
    changes = x * np.eye(len(declared.weights))
    return replace(declared, weights=tuple((declared.weights + changes[i] - changes[j]).tolist()))


def _other_formulas(declared: JointSpaceMethod, model: Model) -> Iterator[tuple[str, JointSpaceMethod]]:
    names_kept = (
        "rod_axial_inertia", "free_coordinates", "gap_correction", "gap_form", "holds_pitches",
        "inverts_mass_matrix", "closed_form_turn",
    )  # fmt: skip
    kept = {name: getattr(declared, name) for name in names_kept}
    euler = JointSpaceMethod("semi-implicit Euler", declared.coordinates, **kept)
    is_euler, turns = declared.formula == "semi-implicit Euler", declared.coordinates == "joint rotations"
    is_implicit, verlet = declared.implicit_forces != "none", replace(euler, formula="velocity Verlet")
    classical = classical_runge_kutta(declared.coordinates, **kept)
    reused = "step, with the last acceleration of the step before in place of its first"
    names = [(f"rod {k + 1}",) * int(model.rods[k]) + (f"body {k + 1}",) for k in range(model.n)]
    moved = enumerate(itertools.chain.from_iterable(names) if is_euler else ())
    for applies, words, base, changes in (
        (model.has_loops, "it did not correct the gaps of loops", declared, {"gap_correction": 0.0}),
        (True, "it took explicit Euler's step: positions by the old velocity", euler,
         {"new_velocity_share": 0.0}),
        (True, "it took semi-implicit Euler's step, with all forces explicit", euler, {}),
        (True, "it exchanged the halves of semi-implicit Euler: positions first", euler,
         {"formula": "positions first"}),
        (True, "it took velocity Verlet's step", verlet, {}),
        (True, f"it took velocity Verlet's {reused}", verlet, {"reuses_acceleration": True}),
        (True, f"it took its declared {reused}", declared, {"reuses_acceleration": True}),
        (True, "it moved positions by the mean of the old and the new velocity",
         declared if is_euler else euler, {"new_velocity_share": 0.5}),
        (turns and model.has_drag,
         "it took semi-implicit Euler's step, with the drag implicit and velocity terms explicit", euler,
         {"implicit_forces": "applied"}),
        (turns, "it took semi-implicit Euler's step, with all forces implicit", euler,
         {"implicit_forces": "all"}),
        (turns, "it moved quaternions by p + h ṗ and normalised them", declared,
         {"is_rotation_exact": False}),
        (is_implicit, "it symmetrised the derivatives of forces in the matrix", declared,
         {"is_damping_symmetric": True}),
        (is_implicit, "it moved positions by the old velocity", declared, {"new_velocity_share": 0.0}),
        *((True, f"it took {count} steps of 1/{count} of the size", declared, {"substeps": count})
          for count in (2, 3, 4)),
        *((True, f"it moved the joint of {name} by the old velocity (stale)", declared, {"stale_joint": j})
          for j, name in moved),
        *((True, f"it took the step of {name}", classical, {"stages": stages, "weights": weights})
          for name, (stages, weights) in TABLEAUS.items()),
        *((turns, f"it {words}", classical, {"correction_terms": count})
          for count, words in enumerate(("left dexp⁻¹ out of Runge–Kutta's stages (θ̇ = v: order 2)",
                                         "cut dexp⁻¹ after θ×v/2", "cut dexp⁻¹ after θ×(θ×v)/12"))),
    ):  # fmt: skip
        if applies:
            yield words, replace(base, **changes)  # type: ignore[arg-type]


def _formulas(known: list[Any], others: Iterator[tuple[str, Any]]) -> Iterator[Edit]:
    """Formulas without a free parameter, each once."""
    for words, method in others:
        if method not in known:
            known.append(method)
            cause = Cause("method", "steps", "", words)
            yield Edit(cause, lambda case, _, method=method: replace(case, method=method))  # type: ignore[misc]


def _family(words: str, declared: float, method: Callable[[float], StepMethod], **more: Any) -> Edit:
    """Formulas with a parameter, that stands in words which complete "behaves as if"."""
    cause = Cause("method", "steps", "", words, nominal=(declared,))
    return Edit(cause, lambda case, x: replace(case, method=method(float(x[0]))), **more)


def _parameter(declared: StepMethod, name: str, words: str) -> Edit:
    """The declared formula with another value of one field."""
    value = getattr(declared, name)
    return _family(
        f"{words} (declared: {value:.6g})", value,
        lambda x: replace(declared, **{name: x}),  # type: ignore[arg-type]
    )  # fmt: skip


# -- constraints -------------------------------------------------------------------------------------


class _ConstrainedSteps(_Steps):
    """Steps of an iterative engine, compared in parts."""

    def __init__(
        self, model: Model, states: Sequence[State], method: StepMethod, runs: Runs, parts: Collection[str]
    ) -> None:
        super().__init__(model, states, method)
        self.runs, self.parts = runs, parts

    def residuals(self, case: Case) -> Array:
        return quadrature_residuals(case.method, self.runs, case.model.has_loops)

    def left(self, case: Case) -> float:
        found = compare_parts(case.method, case.model, self.states, self.runs)
        return max(max(found[name].ratios.ravel()) for name in self.parts)


def _explain_constrained_steps(
    model: Model, states: Sequence[State], declared: ConstrainedMethod, runs: Runs
) -> tuple[Cause, ...]:
    ratios = {name: max(c.ratios.ravel()) for name, c in compare_parts(declared, model, states, runs).items()}
    parts = []
    first = ratios.pop("step_first_acceleration", 0.0)
    if first > MIN_DIAGNOSABLE_RATIO:
        accelerations = [run.coordinate_acceleration for *_, run in runs]
        if all(a is not None and not np.any(a[0]) for a in accelerations):
            parts.append(Cause("method", "first accelerations", "", "the first accelerations were 0"))
        else:
            parts.append(Cause("unexplained", "first accelerations", "", "no other integrator"))
    if max(ratios.values()) > MIN_DIAGNOSABLE_RATIO:
        cause = _best(_constrained_edits(declared), _ConstrainedSteps(model, states, declared, runs, ratios))
        if not cause.is_explained and ratios["step_quadrature"] > MIN_DIAGNOSABLE_RATIO:
            of_quadrature = _ConstrainedSteps(model, states, declared, runs, ["step_quadrature"])
            alone = _best(
                _constrained_edits(declared, is_level_fixed=True), of_quadrature, "quadrature alone"
            )
            cause = alone if alone.is_explained else cause
        parts.append(cause)
    return tuple(parts) or (CLOSE,)


def _constrained_edits(declared: ConstrainedMethod, *, is_level_fixed: bool = False) -> list[Edit]:
    """Other formulas with constraints on both levels, then the declared one with another parameter."""
    other: Literal["position", "velocity"] = (
        "velocity" if declared.constraint_level == "position" else "position"
    )
    words = {"position": " with constraints on positions (index 3)",
             "velocity": " with constraints on velocities (index 2)"}[other]  # fmt: skip
    levels = [(declared, ""), (replace(declared, constraint_level=other), words)][: 2 - is_level_fixed]
    formulas, families = list[tuple[str, ConstrainedMethod]](), list[Edit]()
    for base, at_level in levels:
        newmark = replace(base, alpha_m=0.5, alpha_f=0.5, beta=0.25, gamma=0.5)
        formulas += [
            (text + at_level, method)
            for text, method in {
                "it took its declared step": base,
                "it took the step of the trapezoidal rule (Newmark, β = ¼, γ = ½)": newmark,
                "αm had the opposite sign": replace(base, alpha_m=-base.alpha_m),
                "αm and αf were exchanged": replace(base, alpha_m=base.alpha_f, alpha_f=base.alpha_m),
                "a were q̈ (αm = αf = 0)": replace(base, alpha_m=0.0, alpha_f=0.0),
            }.items()
            if not (base.alpha_m == base.alpha_f and "αf" in text)
        ]
        families.append(_of_spectral_radius(base, at_level))
        families += [
            _parameter(base, name, f"{symbol} were {{}}{at_level}")
            for name, symbol in (("alpha_m", "αm"), ("alpha_f", "αf"), ("beta", "β"), ("gamma", "γ"))
        ]
    return [*_formulas([declared], iter(formulas)), *families]


def _of_spectral_radius(base: ConstrainedMethod, at_level: str) -> Edit:
    names = "solver_atol", "solver_rtol", "difference_step"
    kept: dict[str, Any] = {name: getattr(base, name) for name in names}
    words = f"it took the generalised-α step with spectral radius {{}}{at_level}"
    return _family(
        words,
        base.alpha_f / (1 - base.alpha_f),
        lambda x: replace(generalized_alpha(x, **kept), constraint_level=base.constraint_level),
        begin=0.5,  # at 1 the difference hardly depends on it
    )
