"""Stand-alone scripts of importers' differences: the smallest file, one number, and what it has to be.

A script imports the engine, and NumPy where it has to, and prints the engine's version, its number and the
certified one.  It is run before it is handed out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.engines.engine_calls import run_script
from plumbline.engines.environments import split_version
from plumbline.engines.importer_calls import evaluate_model_file
from plumbline.engines.registry import SCRIPTED_IMPORTERS
from plumbline.importers.neutral_model import CanonicalState, NeutralModel, without_passive_forces
from plumbline.importers.xml_tree import Element, write_xml
from plumbline.judging.rows import Verdict
from plumbline.model_files.importer_cause import Explanation
from plumbline.model_files.model_comparison import certify_states, joint_permutation, mismatches_as_read
from plumbline.model_files.model_rows import FileResult
from plumbline.model_files.model_run import FileRun, ModelPlan, describe_importers, run_files
from plumbline.model_files.xml_shrink import shrink_tree
from plumbline.processes.exceptions import PlumblineError
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.worker_pool import Limits, Task, WorkerPool
from plumbline.reproduce.render import template_environment
from plumbline.scenario.line_and_column_errors import Problem

SHRINKING_SECONDS = 60.0
SHRINKING_STATES = 2
TASK_SECONDS = 30.0
SHOWN_QUANTITIES = (  # in the order in which they are preferred: the simplest to understand first
    "position", "mass_matrix", "gravity_force", "passive_force", "bias_force", "acceleration",
)  # fmt: skip
PRINTED = ("joints", "damping", *SHOWN_QUANTITIES)
MAX_LINES = 40
XML_WIDTH = 110  # characters of a line of the file
EXPECTED = "The expected number follows from the file alone, in interval arithmetic."
# Coordinates of free and ball joints where nothing is moved, as an engine's calls take them; else zeros.
NEUTRAL = {
    "mujoco": {"free": (0, 0, 0, 1, 0, 0, 0), "ball": (1, 0, 0, 0)},
    "drake": {"free": (1, 0, 0, 0, 0, 0, 0), "ball": (0, 0, 0)},
}
PRINTED_PRECISION = 1e-9  # relative: a script that prints another number is not handed out


def stored_differences(document: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """List the differences of a stored run of `plumbline model`.

    Args:
        document: content of model.json.

    Returns:
        By the key of a row the row: of each file and importer the first that disagrees.

    """
    found: dict[tuple[str, str], Mapping[str, Any]] = {}
    for file in document["files"]:
        for row in file["rows"]:
            if row["verdict"] == Verdict.DISAGREES:
                found.setdefault((file["file"], row["engine"]), row)
    return {row["key"]: row for row in found.values()}


class NoModelScript(PlumblineError, ValueError):
    """There is no script of a difference; the message is the reason."""


@dataclass(frozen=True, eq=False)
class ModelScript:
    """A script and what it shows."""

    text: str
    file: str  # the shrunk model file
    number: Shown


@dataclass(frozen=True, eq=False)
class Shown:
    """One number of the shrunk file at which engine and truth differ."""

    quantity: str
    index: tuple[int, ...]  # into the engine's array
    label: str
    state: CanonicalState  # of the engine's reading
    engine_value: float
    expected: float
    allowed: float


def write_model_script(
    plan: ModelPlan, form: str, seconds: float = SHRINKING_SECONDS, since: str = ""
) -> ModelScript:
    """Shrink a model file and write the script of its difference.

    Args:
        plan: of one file and the importer that differs, with or without a version.
        form: engine whose calls the script uses, one of `SCRIPTED_IMPORTERS`.
        seconds: time for the search for a smaller file.
        since: a sentence about the versions that show it.

    Returns:
        The script, which printed its numbers when it was run.

    Raises:
        NoModelScript: nothing differs, or there is no script in that form.

    """
    ((shown,), (importer,)) = plan.files, plan.importers
    if form not in SCRIPTED_IMPORTERS:
        raise NoModelScript(f"there are scripts for {', '.join(SCRIPTED_IMPORTERS)}, not for {form}")
    if split_version(importer)[0] != form:
        raise NoModelScript(f"{importer} differs; a script for {form} cannot show that")
    plan = replace(plan, state_count=SHRINKING_STATES, limits=Limits(TASK_SECONDS))
    with ScratchFolder("plumbline-script-") as scratch, WorkerPool(1, plan.limits) as workers:
        bench = _Bench(plan, scratch, workers)
        original = bench.judged(Path(shown))
        if original is None:
            problems = [str(problem) for problem in bench.problems]
            raise NoModelScript("; ".join(problems) or f"{importer} gives no answer on {shown}")
        if not _differs(original):
            raise NoModelScript(f"{importer} does not differ on {shown}")
        wanted = _signature(original.explanations.get(importer))

        def shows(tree: Element) -> bool:
            found = bench.judged(bench.write(tree))
            return found is not None and _shows(found, importer, wanted) and bench.shown(found) is not None

        tree = bench.run.prepared.tree
        if shows(tree):
            tree = shrink_tree(tree, shows, seconds)
        path = bench.write(tree)
        result = bench.judged(path)
        if result is None:
            raise NoModelScript(
                f"a copy of {shown} outside of its folder cannot be compared; --strip-geometry of `model` "
                "leaves meshes out"
            )
        return _write(bench, form, result, write_xml(tree, XML_WIDTH), since)


def _differs(result: FileResult) -> bool:
    return any(row.verdict == Verdict.DISAGREES for row in result.rows)


def _signature(explanation: Explanation | None) -> frozenset[tuple[str, bool]]:
    """Fields of the causes; of several, one is enough for a smaller file."""
    causes = explanation.causes if explanation else ()
    return frozenset((cause.field, cause.changes[0].is_omitted) for cause in causes)


def _shows(result: FileResult, importer: str, wanted: frozenset[tuple[str, bool]]) -> bool:
    """Whether a file shows one of the causes and nothing else; without one: an unexplained difference.

    The number that a script prints has to differ too.
    """
    if not any(row.verdict == Verdict.DISAGREES and row.quantity in PRINTED for row in result.rows):
        return False
    found = _signature(result.explanations.get(importer))
    return bool(found) and found <= wanted if wanted else not found


class _Bench:
    """Compares changed files on one importer."""

    def __init__(self, plan: ModelPlan, scratch: Path, workers: WorkerPool) -> None:
        self.plan, self.scratch, self.workers = plan, scratch, workers
        (self.importer,) = plan.importers
        self.name = split_version(self.importer)[0]
        self.engines = describe_importers(plan, workers)
        self.info = self.engines[self.importer]
        self.run: FileRun
        self.problems = list[Problem]()  # of the file that was judged last
        self.folders = itertools.count()

    def call(self, function: Any, *arguments: Any) -> Any:
        """Make a call in a worker; None where it is lost."""
        task = Task(0, function, arguments, self.plan.limits, python=self.info.python, engine=self.importer)
        (outcome,) = self.workers.run([task])
        return outcome.value

    def write(self, tree: Element) -> Path:
        """Write a changed file."""
        suffix = ".urdf" if tree.tag == "robot" else ".xml"
        path = self.scratch / f"changed{suffix}"
        path.write_text(write_xml(tree, XML_WIDTH), encoding="utf-8")
        return path

    def judged(self, path: Path) -> FileResult | None:
        """Judge the importer about a file; None where the file is bad or the importer has no answer."""
        is_inside = path.is_relative_to(self.scratch)
        plan = replace(self.plan, root=None) if is_inside else self.plan
        run = FileRun(plan, self.engines, str(path), self.scratch / str(next(self.folders)))
        run_files([run], self.workers, lambda *_: None)
        found, self.problems = run.follow(run.result), run.problems
        if not found or not run.answers[self.importer].quantities or not found[0].model.joints:
            return None
        self.run = run
        result: FileResult = found[0]
        return result

    @property
    def reading(self) -> NeutralModel:
        """The importer's reading of the file that was judged last."""
        model = self.run.answers[self.importer].model
        assert model is not None
        return model

    def shown(self, result: FileResult) -> Shown | None:
        """The first number that a script of the file that was judged last can print."""
        explanation = result.explanations.get(self.importer)
        return next(_shown_numbers(self, result.model, self.reading, explanation), None)


def _write(bench: _Bench, form: str, result: FileResult, text: str, since: str) -> ModelScript:
    """Write the script about the first quantity that differs at a simple state and that it prints."""
    explanation = result.explanations.get(bench.importer)
    for number in _shown_numbers(bench, result.model, bench.reading, explanation):
        script = _render(bench, form, result, text, since, number)
        value = _printed_number(bench.call(run_script, bench.name, script) or "")
        if math.isclose(value, number.engine_value, rel_tol=PRINTED_PRECISION):
            return ModelScript(script, text, number)
    raise NoModelScript("the difference does not show at a state with round numbers")


def _printed_number(printed: str) -> float:
    """The engine's number in what a script printed."""
    words = printed.rpartition(" expected: ")[0].split()
    try:
        return float(words[-1])
    except (ValueError, IndexError):
        return math.nan


def _render(bench: _Bench, form: str, result: FileResult, text: str, since: str, number: Shown) -> str:
    explanation = result.explanations.get(bench.importer)
    title = f"{bench.info.title} {bench.info.version}"
    phrases = [cause.phrase for cause in explanation.causes] if explanation else []
    phrases = phrases or ["reads another robot than the file says"]
    file = bench.run.prepared.file
    template = template_environment().get_template("model-file.py.j2")
    moves = bool(np.any(number.state.velocities))
    script = template.render(
        form=form,
        format=file.format,
        is_fixed=file.base == "fixed",
        root_body=result.model.bodies[0].name,
        title=bench.info.title,
        why=" ".join([*(f"{title} {phrase}." for phrase in phrases), EXPECTED, since]),
        xml=text.rstrip(),
        number=number,
        x=_coordinates(form, bench.reading, number.state),
        v=_literal(number.state.velocities) if moves else None,
    )
    return f"{script}\n"


def _coordinates(form: str, reading: NeutralModel, state: CanonicalState) -> str | None:
    """The coordinates as an engine's calls take them; None where nothing is moved."""
    values: list[float] = []
    is_moved = False
    for joint, x, _ in reading.joint_slices():
        count = {"ball": 3, "free": 6}.get(joint.kind)
        values.extend(NEUTRAL.get(form, {}).get(joint.kind, (0,) * count) if count else state.coordinates[x])
        is_moved |= count is None and bool(np.any(state.coordinates[x]))
    return _literal(values) if is_moved else None


def _literal(values: Any) -> str:
    return "[" + ", ".join(f"{float(value):.17g}" for value in values) + "]"


def _simple_states(model: NeutralModel) -> list[CanonicalState]:
    """At rest and moving, with round numbers: the same of all joints of a kind, whatever their order."""
    rows = []
    for angle, rate in ((0.0, 0.0), (0.5, 0.0), (0.5, 1.0)):
        x: list[float] = []
        v: list[float] = []
        for joint in model.joints:
            x += {"ball": [1.0, 0, 0, 0], "free": [0.0, 0, 0, 1, 0, 0, 0]}.get(joint.kind, [angle])
            v += {"ball": [0.0] * 3, "free": [0.0] * 6}.get(joint.kind, [rate])
        rows.append(CanonicalState(np.array(x), np.array(v)))
    return rows


def _shown_numbers(
    bench: _Bench, model: NeutralModel, reading: NeutralModel, explanation: Explanation | None
) -> Iterator[Shown]:
    """Go through the numbers that a script can print, the simplest to understand first."""
    order = joint_permutation(model, reading)
    if order is None:
        count = float(reading.velocity_count)
        if count != model.velocity_count:
            state = CanonicalState(np.zeros(0), np.zeros(0))
            yield Shown("freedom", (), "degrees of freedom", state, count, float(model.velocity_count), 0.0)
        return
    states = _simple_states(reading)
    answers = bench.call(evaluate_model_file, bench.name, bench.run.prepared.file, tuple(states))
    if answers is None:
        return
    applied = all(answer.passive_force is not None for answer in answers)
    judged, theirs = (m if applied else without_passive_forces(m) for m in (model, reading))
    truths = certify_states(judged, _simple_states(model))
    pairs = zip(truths, certify_states(theirs, states), answers, strict=True)
    worst = [mismatches_as_read(reading, *pair, order) for pair in pairs]
    for quantity in SHOWN_QUANTITIES:
        for state, found in zip(states, worst, strict=True):
            is_shown = quantity != "passive_force" or bench.name == "mujoco"
            if is_shown and (number := found.get(quantity)) and number.ratio > 1:
                body = f" of {number.where}" if quantity == "position" else ""
                label, numbers = f"{quantity.replace('_', ' ')}{body}", (number.value, number.expected)
                yield Shown(quantity, tuple(sorted(number.place)), label, state, *numbers, number.tolerance)
    if bench.name == "exudyn":
        yield from _shown_damping(explanation, reading)


def _shown_damping(explanation: Explanation | None, reading: NeutralModel) -> Iterator[Shown]:
    """The damping that Exudyn's loader returns for the caller's use: no quantity of the engine shows it."""
    changes = [c for cause in explanation.causes for c in cause.changes] if explanation else []
    names = [joint.name for joint in reading.joints]
    for change in changes:
        if change.field == "damping" and change.joint in names:
            index, label = (names.index(change.joint),), f"damping of joint {change.joint}"
            yield Shown("damping", index, label, _simple_states(reading)[0], change.theirs, change.own, 0.0)
