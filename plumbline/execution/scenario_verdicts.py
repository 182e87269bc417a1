"""One scenario on all engines: makes its tasks and judges their outcomes once the truth is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from plumbline.diagnosis.cause import Cause, Diagnosis
from plumbline.engines import engine_calls, environments
from plumbline.engines.adapter import EngineInfo
from plumbline.engines.engine_calls import APART, BESIDES
from plumbline.engines.specifications import task_engine
from plumbline.engines.surface import SURFACES
from plumbline.execution.plan import (
    STATES_PER_RANDOM_SCENARIO,
    LevelSelection,
    Plan,
    TaskKey,
    TaskKind,
    scenario_level,
    task_keys,
)
from plumbline.execution.result_cache import returned_type
from plumbline.judging import outlier, relation_rows
from plumbline.judging.known_issues import KnownIssues
from plumbline.judging.long_runs import judge_long_runs
from plumbline.judging.rows import Fingerprints, JudgingResult, Level, Row, RowContext, Verdict, mark_aliases
from plumbline.judging.state_level import SINGULAR_POSE, judge_states, singular_pose_row
from plumbline.judging.step_level import all_steps_agree, compares_every_step, judge_steps
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements.long_run_study import plan_long_run, run_long_run_study
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.measurements.refinement_study import run_refinement_study
from plumbline.measurements.relations import RelationBounds, check_relations, relation_bounds
from plumbline.measurements.single_steps import STEP_STATES, run_step_study
from plumbline.model.datatypes import Integrator, State
from plumbline.model.invariants import inertia_ratio
from plumbline.model.loops import MIN_MOTION_SINGULAR_VALUE, is_singular, smallest_singular_value
from plumbline.model.sampling import compared_states
from plumbline.processes.record_encoding import EncodedRecord
from plumbline.processes.worker_pool import Outcome, Packed, Task
from plumbline.scenario.loader import Scenario
from plumbline.truth import ground_truth, has_independent_truth
from plumbline.truth.certificate_proof import find_proof
from plumbline.truth.closed_form import exact_samples
from plumbline.truth.ground_truth import MotionTruth, StateTruth

_LEVELS: dict[TaskKind, Level] = {
    TaskKind.STATE: "state",
    TaskKind.STEP: "step",
    TaskKind.RELATIONS: "relations",
    TaskKind.TRAJECTORY: "trajectory",
    TaskKind.LONG_RUN: "invariants",
}
LOW_ORDER = 2  # studies up to it cost most and see least
LEFT_TO_THE_NIGHT = (
    "not run: every step of a run is compared with the declared formula, and the study of {} runs; of this "
    "family all run on {}, and a nightly or `run --level trajectory` runs all"
)
STEPS_AGREE = "every step of a run is that of the declared formula"
# of bodies; computed here where an engine returns those of its joints
ACCELERATIONS = ("acceleration", "angular_acceleration")
NO_INDEPENDENT_TRUTH = "no independent truth: python-flint is not installed, and the reference is no judge"
NO_REGULAR_POSE = (
    "every pose that the loops allow is singular, as of a truss with its bars in one line: forces have no "
    "unique values"
)

# a function and its arguments, after the engine; what judges its answer and the arguments before that
_Calls = tuple[Callable[..., Any], tuple[Any, ...], Callable[..., JudgingResult] | None, tuple[Any, ...]]


@dataclass(frozen=True)
class TruthFailure:
    """The truth could not be computed."""

    reason: str


@cache
def _family(engine: str) -> str:
    """What an engine is a formulation or version of: its distribution."""
    base = environments.split_version(engine)[0]
    return environments.declared_attribute(base, "package") or base


class ScenarioRun:
    """The cells of one scenario, from tasks to rows.

    Attributes:
        scenario: the scenario.
        truths: truth by the kind of its task, as far as it has arrived.

    """

    def __init__(
        self,
        plan: Plan,
        scenario: Scenario,
        engines: Mapping[str, EngineInfo],
        is_random: bool = False,
        known: KnownIssues | None = None,
        level: LevelSelection | None = None,
    ) -> None:
        """Draw the states of the scenario and list its tasks.

        Args:
            is_random: whether it is a random scenario, which is compared at few states and without long runs.
            known: discrepancies whose cause is on record, so that it is not searched again.
            level: levels to compare at; None for the plan's, or for those of its random scenarios.

        """
        self.scenario = scenario
        self.truths: dict[TaskKind, StateTruth | MotionTruth | RelationBounds | TruthFailure] = {}
        self._plan, self._engines, self._known, self._is_random = plan, engines, known, is_random
        levels = scenario_level(scenario, level or (plan.random_level if is_random else plan.level))
        has_long_runs = plan.long_run_seconds > 0 and not is_random
        # how near the initial pose is to a singular one
        self._singular_value = np.inf
        if scenario.model.has_loops:
            arguments = scenario.model, scenario.state
            self._singular_value = self._kept("singular value", smallest_singular_value, *arguments).load()
        self._left_out = dict[TaskKind, str]()
        if self._singular_value < MIN_MOTION_SINGULAR_VALUE:
            singular = (
                f"singular: at the initial pose the smallest singular value is {self._singular_value:.2g}"
            )
            self._left_out |= dict.fromkeys(
                (TaskKind.MOTION_TRUTH, TaskKind.TRAJECTORY, TaskKind.STEP, TaskKind.LONG_RUN), singular
            )
        count = plan.random_state_count
        has_few_states = is_random or scenario.level == "state"
        count = min(count, STATES_PER_RANDOM_SCENARIO) if has_few_states else count
        drawn = scenario.model, scenario.state, scenario.seed, count
        self._states = self._kept("states", compared_states, *drawn)  # argument of many tasks
        if scenario.model.has_loops and not self._states.load():
            kinds = TaskKind.STATE_TRUTH, TaskKind.RELATION_BOUNDS, *_LEVELS
            self._left_out |= dict.fromkeys(kinds, NO_REGULAR_POSE)
        has_other_steps = not is_random and plan.has_other_steps(scenario)
        every = list(task_keys(scenario.name, engines, levels, has_long_runs, has_other_steps))
        self._keys = [key for key in every if key.kind not in self._left_out]
        self._gaps = dict.fromkeys((key.engine, key.kind) for key in every if key.kind in _LEVELS)
        self._pending = set(self._keys)  # without an outcome
        self._findings: dict[TaskKey, JudgingResult] = {}
        self._has_retried_truth = False
        self._failures_besides = dict[TaskKey, list[str]]()  # how the workers of states ended
        self._awaiting_states = dict[str, list[Outcome]]()  # steps, by engine
        self.left_to_the_night = 0  # number of tasks
        self._packed_truths: dict[TaskKind, Packed] = {}  # for judges and diagnoses in workers

    def _kept(self, what: str, function: Callable[..., Any], *arguments: Any) -> EncodedRecord:
        """Call a function that takes long for loops; named scenarios keep its value."""
        cache = self._plan.result_cache
        task = Task((what, self.scenario.name), function, arguments)
        if not self._is_random and (known := cache.get(task)):
            return known.raw_value  # type: ignore[no-any-return]
        value = function(*arguments)
        if not self._is_random:
            cache.put(task, Outcome(task.key, value))
        return EncodedRecord.of(value, returned_type(function))

    @cached_property
    def _step_states(self) -> list[State]:
        states: list[State] = self._states.load()[:STEP_STATES]
        return states

    def tasks(self) -> Iterator[Task]:
        """Make the tasks that can start: the truths that are missing, and the cells that need none.

        Yields:
            The tasks. Other cells follow their truth, because the worker judges them.

        """
        for key in self._keys:
            if key.is_truth and key.kind not in self.truths:
                yield self.truth_task(key)
            elif not key.is_truth and key.needed_truth is None:
                yield self._cell_task(key)

    def truth_task(self, key: TaskKey, *compiled_bodies: int) -> Task:
        """Make the task of a truth.

        Args:
            compiled_bodies: 0 to compute the motion without compiled code.

        """
        s = self.scenario
        if key.kind == TaskKind.STATE_TRUTH:
            return Task(key, ground_truth.state_truth, (s.model, self._states), self._plan.limits)
        if key.kind == TaskKind.RELATION_BOUNDS:
            return Task(key, relation_bounds, (s.model, self._states), self._plan.limits)
        arguments = (s.model, s.state, s.times, exact_samples(s, s.times), *(compiled_bodies or (None,)))
        proof = find_proof(s.model, s.state, s.times)
        arguments += () if proof is None else (proof,)
        return Task(key, ground_truth.motion_truth, arguments, self._plan.limits)

    @property
    def is_done(self) -> bool:
        """Whether every task has its outcome."""
        return not self._pending

    def findings(self) -> JudgingResult:
        """Collect what was found on the scenario.

        Returns:
            The rows and tables in the order of the tasks, whichever finished first.

        """
        found = JudgingResult()
        for name, info in self._engines.items():
            if info.missing is not None:
                verdict = Verdict.UNSUPPORTED if info.version else Verdict.NOT_INSTALLED
                verdict = Verdict.FAILED if info.has_failed else verdict
                found.rows.append(self._context(name).make_row("state", "-", "all", verdict, info.missing))
            for key in self._keys:
                if key.engine == name and key in self._findings:
                    found.rows += self._rows(key)
                    found.tables += self._findings[key].tables
                    found.deviations |= self._findings[key].deviations
            for engine, kind in self._gaps:
                if engine == name and kind in self._left_out:
                    reason = f"not compared: {self._left_out[kind]}"
                    row = self._context(name).make_row
                    found.rows.append(row(_LEVELS[kind], "-", "all", Verdict.INFORMATION, reason))
        found.rows = outlier.annotate_outliers(found.rows, self._is_certified)
        return found

    def _rows(self, key: TaskKey) -> list[Row]:
        """The rows of a cell; what a study leaves open is information where every step of a run agrees."""
        rows = mark_aliases(self._findings[key].rows)
        steps = self._findings.get(replace(key, kind=TaskKind.STEP))
        if key.kind != TaskKind.TRAJECTORY or steps is None or not all_steps_agree(steps.rows):
            return rows
        return [
            replace(row, verdict=Verdict.INFORMATION, reason=f"{row.reason}; {STEPS_AGREE}")
            if row.verdict == Verdict.UNRESOLVED and row.quantity != SINGULAR_POSE
            else row
            for row in rows
        ]

    @property
    def _is_certified(self) -> bool:
        truth = self.truths.get(TaskKind.STATE_TRUTH)
        return not isinstance(truth, StateTruth) or truth.is_certified

    def judged_rows(self, found: JudgingResult, known: KnownIssues) -> list[Row]:
        """Mark what is recorded, where all engines stand against the truth, and what lacks a truth.

        Args:
            found: of `findings`.

        Returns:
            The rows in the same order.

        """
        model, is_certified = self.scenario.model, self._is_certified
        rows = known.mark_known(found.rows, model.n, inertia_ratio(model), model.kind)
        defines_truth = "" if is_certified else _family("reference")
        rows = outlier.doubt_truth(rows, found.deviations, _family, defines_truth)
        if is_certified and has_independent_truth():
            return rows
        return [
            replace(row, verdict=Verdict.UNRESOLVED, reason=NO_INDEPENDENT_TRUTH)
            if row.verdict == Verdict.AGREES
            else row
            for row in rows
        ]

    def on_outcome(self, outcome: Outcome) -> list[Task]:
        """Take the outcome of a task: keep a truth or what the judge found.

        Returns:
            The tasks that follow from it.

        """
        key: TaskKey = outcome.key
        if outcome.failure and key.kind == TaskKind.MOTION_TRUTH and not self._has_retried_truth:
            self._has_retried_truth = True  # the worker may have crashed in compiled code
            return [self.truth_task(key, 0)]
        has_besides = key.kind == TaskKind.STATE and environments.split_version(key.engine)[0] in SURFACES
        failures = self._failures_besides.setdefault(key, []) if has_besides else []
        if outcome.failure and has_besides and len(failures) < len(BESIDES):
            # What is asked for besides may have ended the worker; one that hung is asked for the states only.
            failures += [outcome.failure] * (len(BESIDES) if outcome.is_overdue else 1)
            return [self._cell_task(key)]
        self._pending.discard(key)
        following = []
        if key.kind == TaskKind.DIAGNOSIS:
            self._add_diagnosis(outcome)
        elif key.is_truth:
            self.truths[key.kind] = TruthFailure(outcome.failure) if outcome.failure else outcome.value
            if not outcome.failure:
                self._packed_truths[key.kind] = outcome.packed
            following = [
                self._cell_task(k) for k in self._keys if k.needed_truth == key.kind and self._is_due(k)
            ]
        else:
            found = self._findings[key] = self._judged(outcome)
            if key.kind == TaskKind.STATE:
                answers = [outcome, *self._awaiting_states.pop(key.engine, ())]
                following = [task for answer in answers for task in self._diagnosis_tasks(answer)]
            elif key.kind == TaskKind.STEP and self._states_of(key) in self._pending:
                self._awaiting_states.setdefault(key.engine, []).append(outcome)
            elif key.kind == TaskKind.STEP:
                following = self._diagnosis_tasks(outcome)
            if key.kind == TaskKind.STEP:
                following += self._study_tasks(key, found.rows)
        self._pending |= {task.key for task in following}
        return following

    def _awaited_steps(self, key: TaskKey) -> TaskKey | None:
        """The steps that decide whether a refinement study runs; None where it always does."""
        if key.kind != TaskKind.TRAJECTORY or self._plan.has_all_studies:
            return None
        steps, is_studied = replace(key, kind=TaskKind.STEP), self._studied == self.scenario.name
        return steps if self._sharper(key) and not is_studied and steps in self._keys else None

    def _sharper(self, key: TaskKey) -> str | None:
        """The integrator of the engine whose study always runs, instead of that of another of low order."""
        own, every = self._integrator(key), self._engines[key.engine].integrators
        first = max((one for one in every if one.has_motions), key=lambda one: one.order)
        is_low = own.kind == "step" and own.order <= LOW_ORDER
        return first.name if is_low and first.name != own.name else None

    @property
    def _studied(self) -> str:
        """The scenario of this family whose studies always run."""
        return self._plan.studied(self.scenario)

    def _is_due(self, key: TaskKey) -> bool:
        """Whether a cell need not wait for steps, and is not left to the night."""
        steps = self._awaited_steps(key)
        return key in self._pending and (steps is None or steps in self._findings)

    def _study_tasks(self, steps: TaskKey, rows: Sequence[Row]) -> list[Task]:
        """The refinement study that waited for steps, unless they decide without it."""
        study = replace(steps, kind=TaskKind.TRAJECTORY)
        if study not in self._keys or self._awaited_steps(study) is None:
            return []
        if not compares_every_step(rows):
            return [self._cell_task(study)] if study.needed_truth in self.truths else []
        reason = LEFT_TO_THE_NIGHT.format(self._sharper(study), self._studied)
        row = self._context(study.engine).make_row(
            "trajectory", study.integrator, "all", Verdict.INFORMATION, reason
        )
        self._findings[study] = JudgingResult([row])
        self._pending.discard(study)
        self.left_to_the_night += 1
        return []

    def new_rows(self, outcome: Outcome) -> list[Row]:
        """Return what was found by an outcome.

        Args:
            outcome: that `on_outcome` has taken.

        Returns:
            The rows; none of a truth or a diagnosis.

        """
        return self._rows(outcome.key) if outcome.key in self._findings else []

    def fingerprints(self) -> dict[str, Fingerprints]:
        """Collect what identifies the answers of each engine.

        Returns:
            By engine the hashes of its answers' bits; empty for a scenario with a closed form, in which
            different computations may give equal bits, as at rest.

        """
        found: dict[str, Fingerprints] = {}
        if self.scenario.closed_form is None:
            for key, judged in self._findings.items():
                found.setdefault(key.engine, {}).update(judged.fingerprints)
        return found

    def summary(self) -> dict[str, Any]:
        """Describe the scenario for results.json.

        Returns:
            Its texts, model, initial state, and of its motion the truth and the horizon [s].

        """
        s, truth = self.scenario, self.truths.get(TaskKind.MOTION_TRUTH)
        about = {
            "family": s.family,
            "title": s.title,
            "purpose": s.purpose,
            "file": s.origin,
            "own": not s.is_in_catalogue,
            "bodies": s.model.n,
            "joints": list(s.model.kind),
            "duration": s.duration,
            "sample": s.sample_interval,
            "exact": s.closed_form,
            "digest": s.digest,
            "seed": s.seed,
            "model": {key: np.asarray(value).tolist() for key, value in s.model.fields.items()},
            "state": {key: value.tolist() for key, value in vars(s.state).items()},
        }
        if isinstance(truth, MotionTruth):
            about |= {
                "horizon": truth.horizon,
                "growth": float(truth.growth[-1]),
                "truth": truth.method,
                "is_proved": truth.is_proved,
                "truth_uncertainty": float(truth.uncertainty["position"][-1]),
            }
        return about

    def truth_methods(self) -> list[str]:
        """Describe how each truth was computed.

        Returns:
            One phrase per level with a truth.

        """
        levels = {TaskKind.STATE_TRUTH: "state", TaskKind.MOTION_TRUTH: "trajectory"}
        return [
            f"{levels[kind]} level: {truth.method}"
            for kind, truth in self.truths.items()
            if isinstance(truth, StateTruth | MotionTruth)
        ]

    def _context(self, engine: str) -> RowContext:
        info = self._engines[engine]
        return RowContext(self.scenario.name, self.scenario.family, engine, info.title, info.version)

    def _integrator(self, key: TaskKey) -> Integrator:
        return next(i for i in self._engines[key.engine].integrators if i.name == key.integrator)

    def _cell_task(self, key: TaskKey) -> Task:
        call, arguments, judge, judge_arguments = self._calls(key)
        engine, version, python = self._task_engine(key)
        return Task(
            key, call, (engine, *arguments), self._plan.limits, version, python, key.engine, judge,
            judge_arguments, JudgingResult.has_disagreement,  # only a diagnosis needs the answer
        )  # fmt: skip

    def _task_engine(self, key: TaskKey) -> tuple[str, str, str]:
        """What workers load the engine by, its version and files as a text, and its interpreter."""
        engine, digest = task_engine(environments.split_version(key.engine)[0])
        info = self._engines[key.engine]
        return engine, info.version + digest, info.python

    def _calls(self, key: TaskKey) -> _Calls:
        """What computes a cell, and what judges its answer in the worker."""
        s, plan, context = self.scenario, self._plan, self._context(key.engine)
        asked: tuple[Any, ...]
        judging: tuple[Any, ...]
        truth = self._packed_truths.get(key.needed_truth) if key.needed_truth else None
        if key.kind == TaskKind.STATE:
            by_failures: list[tuple[str, ...]] = [BESIDES, (*BESIDES, APART), ()]
            asked = s.model, self._states, by_failures[len(self._failures_besides.get(key, ()))]
            return engine_calls.evaluate_states, asked, judge_states if truth else None, (context, truth)
        if key.kind == TaskKind.RELATIONS:  # without bounds the cell has failed
            asked = s.model, self._states, truth
            return check_relations, asked, relation_rows.judge_relations, (context,)
        integrator = self._integrator(key)
        if key.kind == TaskKind.STEP:
            asked = integrator, s.model, self._step_states
            return run_step_study, asked, judge_steps, (context, *asked)
        if key.kind == TaskKind.TRAJECTORY:
            finer = plan.extra_refinements
            steps = refinement_resolutions(integrator, s.model.n, s.duration, finer, s.sample_interval)
            motion = self.truths.get(TaskKind.MOTION_TRUTH)  # ends before a singular pose
            times = motion.trajectory.t if isinstance(motion, MotionTruth) else s.times
            judging = context, s.model, truth, integrator
            asked = integrator.name, s.model, s.state, times, steps
            return run_refinement_study, asked, judge_trajectory if truth else None, judging
        length = plan_long_run(integrator, s.model.n, plan.long_run_seconds, s.sample_interval, s.duration)
        asked = integrator.name, s.model, s.state, s.sample_interval, length
        judging = context, s.model, integrator, s.closed_form is not None
        return run_long_run_study, asked, judge_long_runs, judging

    def _judged(self, outcome: Outcome) -> JudgingResult:
        """What the judge of a cell found, or why there is none."""
        key: TaskKey = outcome.key
        truth = self.truths.get(key.needed_truth) if key.needed_truth else None
        doubt = f"the answer cannot be judged: {outcome.judge_failure}" if outcome.judge_failure else ""
        if isinstance(truth, TruthFailure):
            doubt = f"{self.scenario.name} has no truth to judge by: {truth.reason}"
        elif isinstance(truth, MotionTruth) and truth.conflict:
            doubt = f"{self.scenario.name}: {truth.conflict}"
        if outcome.failure or doubt:
            verdict, lost = (
                (Verdict.HARNESS_FAILED, doubt) if doubt else (Verdict.FAILED, outcome.failure or "")
            )
            quantity = "all_long" if key.kind == TaskKind.LONG_RUN else "all"
            row = self._context(key.engine).make_row(
                _LEVELS[key.kind], key.integrator or "-", quantity, verdict, lost
            )
            return JudgingResult(rows=[row])
        found: JudgingResult = outcome.judge_result
        failures = self._failures_besides.get(key, [])
        for what in BESIDES if len(failures) == len(BESIDES) else ():  # else each part says how it ended
            quantity = "all" if what == "surface" else f"all_{what}"
            row = self._context(key.engine).make_row("surface", "-", quantity, Verdict.FAILED, failures[-1])
            found.rows.append(row)
        is_refused = any(row.verdict == Verdict.UNSUPPORTED and row.quantity == "all" for row in found.rows)
        if key.kind == TaskKind.STATE and is_singular(self._singular_value) and not is_refused:
            found.rows.append(singular_pose_row(self._context(key.engine), self._singular_value))
        if key.kind == TaskKind.STATE and self._engines[key.engine].is_lifted:
            found.rows = [
                replace(row, extra=row.extra | {"lifted": 1.0}) if row.quantity in ACCELERATIONS else row
                for row in found.rows
            ]
        if self._plan.user_rtol is not None:
            found.rows = [replace(row, user_rtol=self._plan.user_rtol) for row in found.rows]
        return found

    @staticmethod
    def _states_of(steps: TaskKey) -> TaskKey:
        return replace(steps, kind=TaskKind.STATE, integrator="")

    def _disputed(self, key: TaskKey) -> list[Row]:
        """The rows of a cell's level that disagree, those on record marked."""
        rows = self._findings[key].rows if key in self._findings else ()
        level, model = _LEVELS[key.kind], self.scenario.model  # rows of the surface name the wrong call
        disputed = [row for row in rows if row.verdict == Verdict.DISAGREES and row.level == level]
        if not self._known or not disputed:
            return disputed
        return self._known.mark_known(disputed, model.n, inertia_ratio(model), model.kind)

    def _diagnosis_tasks(self, answer: Outcome) -> list[Task]:
        """The task that searches the cause of a cell's disagreement, or measures how the error scatters.

        A mechanism that is on record is not searched again: the scatter is measured, by which it is checked.
        Nor are steps where the accelerations of states disagree, of which they are made.
        """
        key: TaskKey = answer.key
        disputed, model = self._disputed(key), self.scenario.model
        is_known = all(row.known_issue is not None for row in disputed)
        if not disputed:
            return []
        if key.kind == TaskKind.STEP and not is_known:
            of_states = self._disputed(self._states_of(key))
            if any(row.quantity in ACCELERATIONS and row.known_issue is None for row in of_states):
                return []
        from plumbline.diagnosis.diagnose import explain_disagreement  # few runs need them
        from plumbline.diagnosis.integrator_search import explain_disagreeing_steps

        engine, version, python = self._task_engine(key)
        subject = TaskKey(TaskKind.DIAGNOSIS, self.scenario.name, key.engine, key.integrator)
        call: Callable[..., Diagnosis] = explain_disagreement
        arguments: tuple[Any, ...] = ()
        if key.kind == TaskKind.STATE:
            truth = self._packed_truths[TaskKind.STATE_TRUTH]
            arguments = (engine, model, answer.value.quantities, truth, is_known)
        else:
            call = explain_disagreeing_steps
            arguments = (engine, key.integrator, model, self._step_states, answer.value, is_known)
        return [Task(subject, call, arguments, self._plan.limits, version, python, key.engine)]

    def _add_diagnosis(self, outcome: Outcome) -> None:
        diagnosis: Diagnosis = outcome.value or Diagnosis(
            (Cause("refusal", "diagnosis", "", outcome.failure or ""),)
        )
        kind = TaskKind.STEP if outcome.key.integrator else TaskKind.STATE
        cell = self._findings[replace(outcome.key, kind=kind)]
        extra: dict[str, float | str] = {} if diagnosis.scatter is None else {"scatter": diagnosis.scatter}
        causes = tuple(asdict(cause) for cause in diagnosis.causes)
        cell.rows = [
            replace(row, diagnosis=diagnosis.text or None, causes=causes, extra=row.extra | extra)
            if row.verdict == Verdict.DISAGREES and row.level == _LEVELS[kind]
            else row
            for row in cell.rows
        ]
