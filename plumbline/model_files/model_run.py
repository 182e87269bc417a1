"""Run `plumbline model`: files × importers through workers to judged rows, causes and one result per file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.environments import (
    EnvironmentUnavailable,
    declared_importer_attribute,
    importer_interpreter,
    split_version,
)
from plumbline.engines.importer_calls import (
    describe_importer,
    evaluate_model_file,
    read_model_file,
    read_model_files,
)
from plumbline.engines.registry import IMPORTERS
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.runner import exit_code_of_rows
from plumbline.importers.neutral_model import CanonicalState, NeutralModel, extreme_numbers
from plumbline.importers.xml_tree import ModelFileError
from plumbline.judging.known_issues import KnownIssue, KnownIssues
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.model_files.importer_cause import Explanation
from plumbline.model_files.model_comparison import model_states, with_names_of
from plumbline.model_files.model_rows import (
    MODEL_FAMILY,
    Answer,
    FileResult,
    FileTruth,
    certify_file,
    file_result,
    judge_importer,
    state_seed,
)
from plumbline.model_files.prepared_file import BaseChoice, PreparedFile, prepare_file
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.workers import Executor, Limits, Outcome, Packed, Task, WorkerPool
from plumbline.scenario.errors import Problem, did_you_mean, shorten

MJCF_READER = "mujoco"  # whose compiled model is the neutral reading of MJCF
T = TypeVar("T")
ProgressCallback = Callable[[int, int, str], None]


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
    """Compare files across importers.

    Args:
        progress: called after every task.

    Returns:
        The result; a file with mistakes is in its problems and does not stop the others.

    """
    with ScratchFolder("plumbline-model-") as scratch, WorkerPool(plan.jobs, plan.limits) as workers:
        return _ModelRun(plan, scratch, workers, progress).execute()


class _ModelRun:
    """The phases of one run: describe, read, evaluate, judge."""

    def __init__(self, plan: ModelPlan, scratch: Path, workers: Executor, progress: ProgressCallback) -> None:
        self.plan, self.scratch, self.workers, self.progress = plan, scratch, workers, progress
        self.done = 0
        self.pythons: dict[str, str] = {}
        self.engines: dict[str, EngineInfo] = {}
        self.problems: list[Problem] = []
        self.has_internal_error = False
        self.truths: dict[str, Packed | tuple[Verdict, str]] = {}  # of each file, or why there is none

    def execute(self) -> ModelRunResult:
        """Run the phases."""
        prepared = self.prepare()
        self.describe()
        readings = self.read(prepared)
        models = self.neutral_models(prepared, readings)
        answers = self.evaluate(prepared, models, readings)
        answers = self.rewrite(prepared, answers)
        files = list(self.judge(models, answers))
        known = KnownIssues(self.plan.known_issues, False)
        files = [
            replace(f, rows=tuple(known.mark_known(list(map(self.answered, f.rows)), len(f.model.bodies))))
            for f in files
        ]
        stale = known.stale_issues(is_full_matrix=False)
        return ModelRunResult(
            self.plan, tuple(files), self.engines, tuple(self.problems), tuple(stale), self.has_internal_error
        )

    def outcomes(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Run tasks and report the progress."""
        total = self.done + len(tasks)
        for outcome in self.workers.run(tasks):
            self.done += 1
            self.progress(self.done, total, " ".join(map(str, outcome.key)))
            yield outcome

    def of_file(self, shown: str, call: Callable[[], T]) -> T | None:
        """Call what handles one file: its problems, and a mistake of this program, do not stop the others."""
        try:
            return call()
        except ModelFileError as error:
            self.problems += error.problems
        except Exception as error:
            words = shorten(" ".join(f"{type(error).__name__}: {error}".split()), 400)
            self.problems.append(
                Problem(shown, 0, 0, "", f"internal error: {words}", hint="please report it")
            )
            self.has_internal_error = True
        return None

    def limit_words(self, outcome: Outcome, what: str) -> str:
        """Why there is no answer, with the option that sets the limit; empty where there is an answer."""
        seconds, gigabytes = self.plan.limits.seconds, self.plan.limits.gigabytes
        if outcome.is_overdue:
            return f"{what} within the time limit of {seconds:g} s (--timeout)"
        if outcome.is_out_of_memory:
            return f"{what} within the memory limit of {gigabytes:g} GB (--memory)"
        return outcome.failure or ""

    def prepare(self) -> dict[str, PreparedFile]:
        """Check the files."""
        found: dict[str, PreparedFile] = {}
        for number, shown in enumerate(dict.fromkeys(self.plan.files)):
            folder = self.scratch / str(number)
            folder.mkdir()
            how = folder, self.plan.root, self.plan.base, self.plan.strip_geometry
            if (file := self.of_file(shown, partial(prepare_file, shown, *how))) is not None:
                found[shown] = file
        return found

    def describe(self) -> None:
        """Ask the importers for their versions."""
        wanted = dict.fromkeys((*self.plan.importers, MJCF_READER))
        tasks = []
        for name in wanted:
            base = split_version(name)[0]
            try:
                self.pythons[name] = importer_interpreter(name)
            except EnvironmentUnavailable as error:
                self.engines[name] = self.missing(EngineInfo(name, name, "", (), str(error)))
                continue
            key = ("version", name)
            tasks.append(
                Task(
                    key, describe_importer, (base,), self.plan.limits, python=self.pythons[name], engine=name
                )
            )
        for outcome in self.outcomes(tasks):
            name = outcome.key[1]
            info = outcome.value or EngineInfo(
                name, name, "", (), f"cannot be loaded: {outcome.failure}", has_failed=True
            )
            self.engines[name] = self.missing(replace(info, name=name))
        self.engines = {name: self.engines[name] for name in wanted}

    def missing(self, info: EngineInfo) -> EngineInfo:
        """A missing importer that the user named has failed."""
        if info.missing and self.plan.are_importers_required and info.name in self.plan.importers:
            return replace(info, has_failed=True)
        return info

    def answered(self, row: Row) -> Row:
        """A refusal is an answer: it counts as a gap only where the user named the importer."""
        if row.verdict == Verdict.UNSUPPORTED and not self.plan.are_importers_required:
            return replace(row, verdict=Verdict.INFORMATION)
        return row

    def usable(self) -> list[str]:
        """The importers that can run."""
        return [name for name, info in self.engines.items() if info.missing is None]

    def task(self, kind: str, shown: str, name: str, function: Any, *arguments: Any) -> Task:
        """A call of an importer."""
        base = split_version(name)[0]
        key = (kind, shown, name)
        return Task(
            key, function, (base, *arguments), self.plan.limits, python=self.pythons[name], engine=name
        )

    def read(self, prepared: Mapping[str, PreparedFile]) -> dict[tuple[str, str], Answer]:
        """Have every importer read every file of a format that it reads; MuJoCo always reads MJCF."""
        tasks = [
            self.task("read", shown, name, read_model_file, file.file)
            for shown, file in prepared.items()
            for name in self.usable()
            if file.file.format in declared_formats(name)
            and (name in self.plan.importers or file.file.format == "mjcf")
        ]
        known = {shown: file.urdf_model for shown, file in prepared.items() if file.urdf_model is not None}
        tasks += self.certificates(known)
        found = {}
        for outcome in self.outcomes(tasks):
            if self.is_certificate(outcome):
                continue
            failure = self.limit_words(outcome, "did not load the file")
            found[outcome.key[1:]] = Answer(outcome.value, failure=failure)
        return found

    def neutral_models(
        self, prepared: Mapping[str, PreparedFile], readings: Mapping[tuple[str, str], Answer]
    ) -> dict[str, NeutralModel]:
        """What the files say."""
        found = {}
        for shown, file in prepared.items():
            answer = readings.get((shown, MJCF_READER), Answer(failure="is missing or failed to load"))
            described = partial(file.neutral_model, answer.reading, answer.failure)
            if (model := self.of_file(shown, described)) is None:
                continue
            names = [joint.name for joint in model.joints if joint.kind in ("hinge", "slide")]
            unknown = [name for name in self.plan.at or () if name not in names]
            for name in unknown:
                hint = did_you_mean(name, names) or f"there are: {', '.join(names[:20])}"
                message = f"no hinge or slide {shorten(repr(name))}, which --at names"
                self.problems.append(Problem(shown, 0, 0, "", message, hint=hint))
            if not unknown:
                found[shown] = model
        return found

    def evaluate(
        self,
        prepared: Mapping[str, PreparedFile],
        models: Mapping[str, NeutralModel],
        readings: Mapping[tuple[str, str], Answer],
    ) -> dict[tuple[str, str], Answer]:
        """Evaluate the quantities at the states of each reading."""
        answers = {
            key: answer
            for key, answer in readings.items()
            if key[0] in models and key[1] in self.plan.importers
        }
        tasks = []
        for (shown, name), answer in answers.items():
            if answer.reading is not None and answer.reading.model is None:
                words = prepared[shown].in_users_words(answer.reading.refusal)
                answers[shown, name] = replace(answer, reading=replace(answer.reading, refusal=words))
            elif answer.reading is not None and answer.reading.model is not None:
                if extreme := next(extreme_numbers(answer.reading.model), None):
                    failure = f"no engine can compute with what it read: {extreme[0]} is {extreme[1]:g}"
                    answers[shown, name] = Answer(failure=failure)
                    continue
                model = with_names_of(models[shown], answer.reading.model)
                states = self.states(shown, model)
                answers[shown, name] = replace(
                    answer, reading=replace(answer.reading, model=model), states=states
                )
                file = prepared[shown].file
                tasks.append(self.task("evaluate", shown, name, evaluate_model_file, file, states))
        tasks += self.certificates({s: model for s, model in models.items() if s not in self.truths})
        for outcome in self.outcomes(tasks):
            key = outcome.key[1:]
            if self.is_certificate(outcome):
                continue
            if outcome.failure:
                failure = self.limit_words(outcome, "did not compute the quantities")
                answers[key] = replace(answers[key], failure=failure)
            else:
                answers[key] = replace(answers[key], quantities=tuple(outcome.value))
        return answers

    def rewrite(
        self, prepared: Mapping[str, PreparedFile], answers: dict[tuple[str, str], Answer]
    ) -> dict[tuple[str, str], Answer]:
        """Have MuJoCo read equivalent rewritings of the MJCF files, which judge its compiler."""
        tasks = []
        for (shown, name), answer in answers.items():
            file, is_read = prepared[shown].file, answer.reading is not None and answer.reading.model
            if split_version(name)[0] == MJCF_READER and file.format == "mjcf" and is_read:
                written = self.of_file(shown, partial(prepared[shown].write_rewritings, self.scratch))
                tasks.append(self.task("rewritten", shown, name, read_model_files, written or {}))
        for outcome in self.outcomes(tasks):
            key = outcome.key[1:]
            answers[key] = replace(answers[key], rewritten=outcome.value or {})
        return answers

    def certificates(self, models: Mapping[str, NeutralModel]) -> list[Task]:
        """Certify files' models: of URDF files while importers read them, of MJCF files afterwards."""
        state = self.plan.state_count, self.plan.at
        return [
            Task(("certify", shown), certify_file, (shown, model, *state), self.plan.limits)
            for shown, model in models.items()
        ]

    def is_certificate(self, outcome: Outcome) -> bool:
        """Keep a certificate; False for other outcomes."""
        if outcome.key[0] != "certify":
            return False
        what = "the certified values of the file were not computed"
        self.truths[outcome.key[1]] = self.unjudged(outcome, what) if outcome.failure else outcome.packed
        return True

    def unjudged(self, outcome: Outcome, what: str) -> tuple[Verdict, str]:
        """The verdict where an importer cannot be judged: at a limit it is open, else the harness failed."""
        if outcome.is_overdue or outcome.is_out_of_memory:
            return Verdict.UNRESOLVED, f"not judged: {self.limit_words(outcome, what)}"
        return Verdict.HARNESS_FAILED, f"the judging failed: {outcome.failure}"

    def states(self, shown: str, model: NeutralModel) -> tuple[CanonicalState, ...]:
        """The states of one file; the same values for joints of one name and kind in every reading."""
        return model_states(model, self.plan.state_count, state_seed(shown), self.plan.at)

    def judge(
        self, models: Mapping[str, NeutralModel], answers: Mapping[tuple[str, str], Answer]
    ) -> Iterator[FileResult]:
        """Judge each file and importer in a worker, in the order in which the files were named."""
        columns = {
            (shown, name): (name, info, answers.get((shown, name)) or Answer(failure=info.missing or ""))
            for shown in models
            for name, info in ((name, self.engines[name]) for name in self.plan.importers)
        }
        tasks: list[Task] = []
        judged: dict[tuple[str, str], tuple[list[Row], Explanation | None]] = {}
        for (shown, name), column in columns.items():
            truth, model = self.truths[shown], models[shown]
            arguments = (shown, model, column, self.plan.state_count, self.plan.at)
            if isinstance(truth, tuple):
                judged[shown, name] = self.lost(shown, column, *truth)
            elif column[2].quantities:  # where it says which causes a difference has, which takes time
                key = ("judge", shown, name)
                tasks.append(Task(key, judge_importer, (*arguments, truth), self.plan.limits))
            else:
                judged[shown, name] = judge_importer(*arguments, truth.load())
        for outcome in self.outcomes(tasks):
            _, shown, name = outcome.key
            what = "its differences were not explained"
            judged[shown, name] = (
                self.lost(shown, columns[shown, name], *self.unjudged(outcome, what))
                if outcome.failure
                else outcome.value
            )
        for shown, model in models.items():
            truth = self.truths[shown]
            known = FileTruth((), (), {}) if isinstance(truth, tuple) else truth.load()
            named = [(shown, name) for name in self.plan.importers]
            yield file_result(shown, model, [columns[n] for n in named], [judged[n] for n in named], known)

    def lost(
        self, shown: str, column: tuple[str, EngineInfo, Answer], verdict: Verdict, reason: str
    ) -> tuple[list[Row], None]:
        """The row of an importer that is not judged."""
        name, info, _ = column
        context = RowContext(shown, MODEL_FAMILY, name, info.title, info.version)
        return [context.make_row("model", "-", "all", verdict, reason)], None


def declared_formats(name: str) -> tuple[str, ...]:
    """Read which formats an importer reads, without importing it.

    Args:
        name: its name, with or without a version.

    """
    return tuple(declared_importer_attribute(split_version(name)[0], "formats") or ())
