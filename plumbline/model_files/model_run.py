"""Run `plumbline model`: files × importers through workers to judged rows, causes and one result per file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.environments import declared_importer_attribute, split_version
from plumbline.engines.importer_calls import evaluate_model_file, read_model_file, read_model_files
from plumbline.engines.registry import IMPORTERS
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import ProgressCallback
from plumbline.execution.runner import describe_engines, exit_code_of_rows
from plumbline.importers.neutral_model import NeutralModel, extreme_numbers
from plumbline.importers.xml_tree import ModelFileError
from plumbline.judging.known_issues import KnownIssue, KnownIssues
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.model_files.importer_cause import Explanation
from plumbline.model_files.model_comparison import model_states, with_names_of
from plumbline.model_files.model_rows import (
    MODEL_FAMILY,
    Answer,
    FileResult,
    certify_file,
    judge_importer,
    state_seed,
)
from plumbline.model_files.prepared_file import MJCF_READER, BaseChoice, PreparedFile, prepare_file
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.worker_pool import Executor, Limits, Outcome, Packed, Scheduler, Task, WorkerPool
from plumbline.scenario.line_and_column_errors import Problem, did_you_mean, shorten


@dataclass(frozen=True)
class ModelPlan:
    """What `plumbline model` compares."""

    files: tuple[str, ...]
    importers: tuple[str, ...] = tuple(IMPORTERS)
    are_importers_required: bool = False  # named by the user: missing is failed, a refusal is a gap
    base: BaseChoice = "auto"
    root: Path | None = None
    strip_geometry: bool = False
    state_count: int = 20
    at: Mapping[str, float] | None = None  # one state instead of random ones
    jobs: int = 1
    limits: Limits = field(default_factory=lambda: Limits(120.0))
    known_issues: tuple[KnownIssue, ...] = ()

    @classmethod
    def of_row(cls, row: Mapping[str, Any], options: Mapping[str, Any], **more: Any) -> ModelPlan:
        """Plan to compare again what a row of model.json is about.

        Args:
            options: those of the run, as stored.
            **more: other fields of the plan.

        """
        about = {name: options[name] for name in ("base", "strip_geometry")}
        root = None if options["root"] is None else Path(options["root"])
        return cls((row["scenario"],), (row["engine"],), root=root, **about, **more)


@dataclass(frozen=True, eq=False)
class ModelRunResult:
    """All files' results."""

    plan: ModelPlan
    files: tuple[FileResult, ...]
    engines: Mapping[str, EngineInfo]
    problems: tuple[Problem, ...]  # of files that cannot be used
    stale_issues: tuple[KnownIssue, ...]
    has_internal_error: bool = False  # a mistake of this program about one of the files

    @property
    def rows(self) -> list[Row]:
        """The rows of all files."""
        return [row for file in self.files for row in file.rows]

    @property
    def exit_code(self) -> ExitCode:
        """5 where the harness failed, else 2 where a file cannot be used, else as everywhere."""
        has_comparison = any(row.verdict.is_comparison for row in self.rows)
        code = exit_code_of_rows(
            self.rows, has_stale_issues=bool(self.stale_issues), has_comparison=has_comparison
        )
        if self.has_internal_error or code == ExitCode.HARNESS_FAILED:
            return ExitCode.HARNESS_FAILED
        return ExitCode.BAD_USAGE if self.problems else code


def run_model_files(plan: ModelPlan, progress: ProgressCallback) -> ModelRunResult:
    """Compare files across importers; a file with mistakes is in the problems and does not stop the others.

    Args:
        progress: called after every task.

    """
    with ScratchFolder("plumbline-model-") as scratch, WorkerPool(plan.jobs, plan.limits) as workers:
        engines = describe_importers(plan, workers)
        files = enumerate(dict.fromkeys(plan.files))
        runs = [FileRun(plan, engines, shown, scratch / str(k)) for k, shown in files]
        run_files(runs, workers, progress)
        return _collect(plan, engines, runs)


def describe_importers(plan: ModelPlan, executor: Executor) -> dict[str, EngineInfo]:
    """Describe the importers of a plan, and MuJoCo's; a missing one that the user named has failed."""
    names = tuple(dict.fromkeys((*plan.importers, MJCF_READER)))
    found = describe_engines(executor, names, are_importers=True)
    required = plan.importers if plan.are_importers_required else ()
    return {
        name: replace(info, has_failed=True) if info.missing and name in required else info
        for name, info in found.items()
    }


def run_files(runs: list[FileRun], executor: Executor, progress: ProgressCallback) -> None:
    """Make the tasks of files until none is left."""
    by_file = {run.shown: run for run in runs}
    tasks = [task for run in runs for task in run.follow(run.start)]
    total, scheduler = len(tasks), Scheduler(executor)
    for done, outcome in enumerate(scheduler.run(tasks), start=1):
        run = by_file[outcome.key.file]
        following = run.follow(run.on_outcome, outcome)
        for task in following:
            scheduler.submit(task)
        total += len(following)
        progress(done, total, " ".join(outcome.key))


def _collect(plan: ModelPlan, engines: Mapping[str, EngineInfo], runs: list[FileRun]) -> ModelRunResult:
    known = KnownIssues(plan.known_issues, False)

    def answered(row: Row) -> Row:
        """A refusal is an answer: it counts as a gap only where the user named the importer."""
        is_gap = row.verdict == Verdict.UNSUPPORTED and not plan.are_importers_required
        return replace(row, verdict=Verdict.INFORMATION) if is_gap else row

    files = []
    for run in runs:
        for file in run.follow(run.result):
            rows = known.mark_known(list(map(answered, file.rows)), len(file.model.bodies))
            files.append(replace(file, rows=tuple(rows)))
    return ModelRunResult(
        plan, tuple(files), engines, tuple(problem for run in runs for problem in run.problems),
        tuple(known.stale_issues(is_full_matrix=False)), any(run.has_internal_error for run in runs),
    )  # fmt: skip


class FileTask(NamedTuple):
    """The identity of a task."""

    kind: str  # certify, read, evaluate, rewritten or judge
    file: str
    importer: str = ""


class FileRun:
    """One file on all importers: makes its tasks, and judges the answers once the file's truth is known."""

    def __init__(self, plan: ModelPlan, engines: Mapping[str, EngineInfo], shown: str, scratch: Path) -> None:
        self.plan, self.engines, self.shown, self.scratch = plan, engines, shown, scratch
        self.problems: list[Problem] = []
        self.has_internal_error = False
        self.prepared: PreparedFile
        self.model: NeutralModel | None = None  # what the file says, once that is known
        self.truth: Packed | None = None
        self.doubt: tuple[Verdict, str] | None = None  # why there is no truth
        self.answers: dict[str, Answer] = {}
        self.complete: list[str] = []  # importers whose answer is complete and not judged yet
        self.judged: dict[str, tuple[list[Row], Explanation | None]] = {}

    def follow(self, make: Callable[..., list[Any]], *arguments: Any) -> list[Any]:
        """Call a step of this file: its problems, and a mistake of this program, do not stop other files."""
        try:
            return make(*arguments)
        except ModelFileError as error:
            self.problems += error.problems
        except OSError:  # the machine's, as a full disk
            raise
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())
            words = f"internal error: {shorten(text, 400)}"
            self.problems.append(Problem(self.shown, 0, 0, "", words, hint="please report it"))
            self.has_internal_error = True
        self.model = None
        return []

    def start(self) -> list[Task]:
        """Check the file; have every importer read it that reads its format, and MuJoCo any MJCF file."""
        plan = self.plan
        self.scratch.mkdir()
        self.prepared = prepare_file(self.shown, self.scratch, plan.root, plan.base, plan.strip_geometry)
        file = self.prepared.file
        tasks = [
            self._task("read", name, read_model_file, file)
            for name, info in self.engines.items()
            if info.missing is None
            and file.format in (declared_importer_attribute(name, "formats") or ())
            and (name in plan.importers or file.format == "mjcf")
        ]
        if file.format == "urdf":
            return self._know(self.prepared.neutral_model(None)) + tasks
        if self.engines[MJCF_READER].missing is not None:
            self.prepared.neutral_model(None, "is missing or failed to load")
        return tasks

    def on_outcome(self, outcome: Outcome) -> list[Task]:
        """Take the outcome of a task; return the tasks that follow from it."""
        kind, name = outcome.key.kind, outcome.key.importer
        if kind == "certify":
            what = "the certified values of the file were not computed"
            self.doubt = self._doubt(outcome, what) if outcome.failure else None
            self.truth = None if outcome.failure else outcome.packed
            return self._judge()
        if kind == "judge":
            doubt = self._doubt(outcome, "its differences were not explained")
            self.judged[name] = self._lost(name, *doubt) if outcome.failure else outcome.value
            return []
        if kind == "read":
            failure = self._failure(outcome, "did not load the file")
            self.answers[name] = Answer(outcome.value, failure=failure)
            if self.prepared.file.format == "mjcf" and name == MJCF_READER:
                model = self.prepared.neutral_model(outcome.value, failure)
                read = [other for other in self.answers if other != name]
                return self._know(model) + [t for other in (*read, name) for t in self._evaluate(other)]
            return self._evaluate(name) if self.model is not None else []
        if kind == "evaluate":
            failure = self._failure(outcome, "did not compute the quantities")
            quantities = () if outcome.failure else tuple(outcome.value)
            self.answers[name] = replace(self.answers[name], quantities=quantities, failure=failure)
            if split_version(name)[0] == MJCF_READER and self.prepared.file.format == "mjcf":
                # equivalent rewritings judge MuJoCo's compiler
                written = self.prepared.write_rewritings(self.scratch)
                return [self._task("rewritten", name, read_model_files, written)]
        else:
            self.answers[name] = replace(self.answers[name], rewritten=outcome.value or {})
        self.complete.append(name)
        return self._judge()

    def result(self) -> list[FileResult]:
        """Collect what the importers were judged to do; nothing of a file with mistakes."""
        if self.model is None:
            return []
        for name in self.plan.importers:
            if name not in self.judged:  # it has read nothing
                self._judge_at_once(name)
        rows = [row for name in self.plan.importers for row in self.judged[name][0]]
        found = {name: self.judged[name][1] for name in self.plan.importers}
        explanations = {name: e for name, e in found.items() if e is not None}
        poses = {} if self.truth is None else self.truth.load().poses
        return [FileResult(self.shown, self.model, tuple(rows), explanations, poses, self.answers)]

    def _task(self, kind: str, name: str, function: Any, *arguments: Any) -> Task:
        key, arguments = FileTask(kind, self.shown, name), (split_version(name)[0], *arguments)
        python = self.engines[name].python
        return Task(key, function, arguments, self.plan.limits, python=python, engine=name)

    def _know(self, model: NeutralModel) -> list[Task]:
        """Take what the file says, and certify it."""
        names = [joint.name for joint in model.joints if joint.kind in ("hinge", "slide")]
        if unknown := [name for name in self.plan.at or () if name not in names]:
            listed = f"there are: {', '.join(names[:20])}"
            raise ModelFileError([
                Problem(
                    self.shown, 0, 0, "", f"no hinge or slide {shorten(repr(name))}, which --at names",
                    hint=did_you_mean(name, names) or listed,
                )
                for name in unknown
            ])  # fmt: skip
        self.model = model
        arguments = (self.shown, model, self.plan.state_count, self.plan.at)
        return [Task(FileTask("certify", self.shown), certify_file, arguments, self.plan.limits)]

    def _evaluate(self, name: str) -> list[Task]:
        """Have an importer's engine compute the quantities at the states of its reading."""
        answer, model = self.answers[name], self.model
        assert model is not None
        if name not in self.plan.importers:
            return []
        reading, read = answer.reading, answer.model
        if reading is not None and read is None:
            words = self.prepared.in_users_words(reading.refusal)
            self.answers[name] = replace(answer, reading=replace(reading, refusal=words))
        elif reading is not None and read is not None:
            if (extreme := next(extreme_numbers(read), None)) is None:
                named = with_names_of(model, read)
                states = model_states(named, self.plan.state_count, state_seed(self.shown), self.plan.at)
                self.answers[name] = replace(answer, reading=replace(reading, model=named), states=states)
                return [self._task("evaluate", name, evaluate_model_file, self.prepared.file, states)]
            failure = f"no engine can compute with what it read: {extreme[0]} is {extreme[1]:g}"
            self.answers[name] = Answer(failure=failure)
        self.complete.append(name)
        return self._judge()

    def _judge(self) -> list[Task]:
        """Judge the complete answers, once the truth is known; the search for causes takes time."""
        tasks = []
        while self.complete and (self.truth or self.doubt):
            name = self.complete.pop(0)
            if self.truth is not None and self.answers[name].quantities:
                arguments = (*self._judge_arguments(name), self.truth)
                key = FileTask("judge", self.shown, name)
                tasks.append(Task(key, judge_importer, arguments, self.plan.limits))
            else:
                self._judge_at_once(name)
        return tasks

    def _judge_at_once(self, name: str) -> None:
        if self.truth is None:
            assert self.doubt is not None
            self.judged[name] = self._lost(name, *self.doubt)
            return
        arguments = (*self._judge_arguments(name), self.truth.load())
        self.judged[name] = judge_importer(*arguments)

    def _judge_arguments(self, name: str) -> tuple[Any, ...]:
        info = self.engines[name]
        column = name, info, self.answers.get(name) or Answer(failure=info.missing or "")
        return self.shown, self.model, column, self.plan.state_count, self.plan.at

    def _lost(self, name: str, verdict: Verdict, reason: str) -> tuple[list[Row], None]:
        """The row of an importer that is not judged."""
        info = self.engines[name]
        context = RowContext(self.shown, MODEL_FAMILY, name, info.title, info.version)
        return [context.make_row("model", "-", "all", verdict, reason)], None

    def _failure(self, outcome: Outcome, what: str) -> str:
        """Why there is no answer, with the option that sets the limit; empty where there is an answer."""
        limits = self.plan.limits
        if outcome.is_overdue:
            return f"{what} within the time limit of {limits.seconds:g} s (--timeout)"
        if outcome.is_out_of_memory:
            return f"{what} within the memory limit of {limits.gigabytes:g} GB (--memory)"
        return outcome.failure or ""

    def _doubt(self, outcome: Outcome, what: str) -> tuple[Verdict, str]:
        """The verdict where an importer cannot be judged: at a limit it is open, else the harness failed."""
        if outcome.is_overdue or outcome.is_out_of_memory:
            return Verdict.UNRESOLVED, f"not judged: {self._failure(outcome, what)}"
        return Verdict.HARNESS_FAILED, f"the judging failed: {outcome.failure}"
