"""Stand-alone scripts of importers' differences: the smallest file, one number, and what it has to be.

A script imports the engine, and NumPy where it has to, and prints the engine's version, its number and the
certified one.  It is run before it is handed out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from plumbline.engines.environments import importer_interpreter, split_version
from plumbline.engines.importer_calls import (
    describe_importer,
    evaluate_model_file,
    read_model_file,
    run_script,
)
from plumbline.importers.importer import Reading
from plumbline.importers.neutral_model import (
    CanonicalState,
    ModelQuantities,
    NeutralModel,
    without_passive_forces,
)
from plumbline.importers.xml_tree import Element, ModelFileError, write_xml
from plumbline.judging.rows import Verdict
from plumbline.model_files.certified_model import CertifiedModelQuantities
from plumbline.model_files.importer_cause import Explanation
from plumbline.model_files.model_comparison import (
    TINY,
    certify_states,
    joint_keys,
    joint_permutation,
    model_states,
    with_names_of,
)
from plumbline.model_files.model_rows import Answer, FileResult, judge_file, state_seed
from plumbline.model_files.prepared_file import BaseChoice, PreparedFile, prepare_file
from plumbline.model_files.xml_shrink import shrink_tree
from plumbline.processes.errors import PlumblineError
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.workers import Limits, Task, WorkerPool

FORMS = ("mujoco", "pinocchio", "exudyn", "drake", "dart")
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
PRINTED_PRECISION = (
    1e-9  # relative: a script that prints another number than the comparison is not handed out
)


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
    engine_value: float
    expected: float


@dataclass(frozen=True, eq=False)
class _Shown:
    """One number of the shrunk file at which engine and truth differ."""

    quantity: str
    index: tuple[int, ...]  # into the engine's array
    label: str
    state: CanonicalState  # of the engine's reading
    engine_value: float
    expected: float


def write_model_script(
    shown: str,
    importer: str,
    form: str,
    base: BaseChoice = "auto",
    root: Path | None = None,
    strip: bool = False,
    seconds: float = SHRINKING_SECONDS,
    since: str = "",
) -> ModelScript:
    """Shrink a model file and write the script of its difference.

    Args:
        importer: the one that differs, with or without a version.
        form: engine whose calls the script uses, one of `FORMS`.
        base: as for the run.
        root: as for the run.
        strip: as for the run.
        seconds: time for the search for a smaller file.
        since: a sentence about the versions that show it.

    Returns:
        The script, which printed its numbers when it was run.

    Raises:
        NoModelScript: nothing differs, or there is no script in that form.

    """
    if form not in FORMS:
        raise NoModelScript(f"there are scripts for {', '.join(FORMS)}, not for {form}")
    if split_version(importer)[0] != form:
        raise NoModelScript(f"{importer} differs; a script for {form} cannot show that")
    with ScratchFolder("plumbline-script-") as scratch, WorkerPool(1, Limits(TASK_SECONDS)) as workers:
        bench = _Bench(importer, base, root, strip, scratch, workers)
        original = bench.judged(Path(shown))
        if original is None or not _differs(original):
            raise NoModelScript(f"{importer} does not differ on {shown}")
        wanted = _signature(original.explanations.get(importer))

        def shows(tree: Element) -> bool:
            found = bench.judged(bench.write(tree))
            return found is not None and _shows(found, importer, wanted) and bench.shown(found) is not None

        tree = bench.prepared.tree
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
    """Loads changed files with one importer and judges it."""

    def __init__(
        self,
        importer: str,
        base: BaseChoice,
        root: Path | None,
        strip: bool,
        scratch: Path,
        workers: WorkerPool,
    ) -> None:
        self.importer, self.base, self.root, self.strip = importer, base, root, strip
        self.scratch, self.workers, self.count = scratch, workers, 0
        self.name, self.python = split_version(importer)[0], importer_interpreter(importer)
        self.info = replace(self.call(describe_importer, self.name), name=importer)
        self.prepared: PreparedFile
        self.answer = Answer()
        self.folder = scratch

    def call(self, function: Any, *arguments: Any, python: str | None = None) -> Any:
        """Make a call in a worker; None where it is lost."""
        python = self.python if python is None else python
        task = Task(0, function, arguments, Limits(TASK_SECONDS), python=python, engine=self.importer)
        (outcome,) = self.workers.run([task])
        return outcome.value

    def write(self, tree: Element) -> Path:
        """Write a changed file."""
        suffix = ".urdf" if tree.tag == "robot" else ".xml"
        path = self.folder / f"changed{suffix}"
        path.write_text(write_xml(tree, XML_WIDTH), encoding="utf-8")
        return path

    def judged(self, path: Path) -> FileResult | None:
        """Judge the importer about a file; None where the file is bad or the importer refuses it."""
        inside = path.is_relative_to(self.scratch)
        try:
            prepared = prepare_file(
                str(path), self.scratch, None if inside else self.root, self.base, self.strip
            )
            model = prepared.neutral_model(self.mjcf_reading(prepared))
        except ModelFileError:
            return None
        reading: Reading | None = self.call(read_model_file, self.name, prepared.file)
        if reading is None or reading.model is None or not model.joints:
            return None
        reading = replace(reading, model=with_names_of(model, reading.model))
        assert reading.model is not None
        states = model_states(reading.model, SHRINKING_STATES, state_seed(str(path)))
        quantities = self.call(evaluate_model_file, self.name, prepared.file, states)
        if quantities is None:
            return None
        self.prepared, self.answer = prepared, Answer(reading, states, tuple(quantities))
        column = (self.importer, self.info, self.answer)
        return judge_file(str(path), model, [column], SHRINKING_STATES, None)

    def shown(self, result: FileResult) -> _Shown | None:
        """The first number that a script of the file that was judged last can print."""
        reading = self.answer.reading
        assert reading is not None and reading.model is not None
        explanation = result.explanations.get(self.importer)
        return next(_shown_numbers(self, result.model, reading.model, explanation), None)

    def mjcf_reading(self, prepared: PreparedFile) -> Reading | None:
        """MuJoCo's reading of an MJCF file."""
        if prepared.file.format != "mjcf":
            return None
        found: Reading | None = self.call(read_model_file, "mujoco", prepared.file, python="")
        return found

    def evaluate(self, states: Sequence[CanonicalState]) -> list[ModelQuantities]:
        """The importer's quantities of the file that was judged last."""
        found: list[ModelQuantities] = self.call(
            evaluate_model_file, self.name, self.prepared.file, tuple(states)
        )
        return found


def _write(bench: _Bench, form: str, result: FileResult, text: str, since: str) -> ModelScript:
    """Write the script about the first quantity that differs at a simple state and that it prints."""
    explanation = result.explanations.get(bench.importer)
    reading = bench.answer.reading
    assert reading is not None and reading.model is not None
    for number in _shown_numbers(bench, result.model, reading.model, explanation):
        script = _render(bench, form, result, text, since, number)
        value = _printed_number(bench.call(run_script, script) or "")
        if math.isclose(value, number.engine_value, rel_tol=PRINTED_PRECISION):
            return ModelScript(script, text, number.engine_value, number.expected)
    raise NoModelScript("the difference does not show at a state with round numbers")


def _printed_number(printed: str) -> float:
    """The engine's number in what a script printed."""
    words = printed.rpartition(" expected: ")[0].split()
    try:
        return float(words[-1])
    except (ValueError, IndexError):
        return math.nan


def _render(bench: _Bench, form: str, result: FileResult, text: str, since: str, number: _Shown) -> str:
    explanation = result.explanations.get(bench.importer)
    title = f"{bench.info.title} {bench.info.version}"
    phrases = [cause.phrase for cause in explanation.causes] if explanation else []
    phrases = phrases or ["reads another robot than the file says"]
    why = " ".join([*(f"{title} {phrase}." for phrase in phrases), EXPECTED, since])
    moves = bool(np.any(number.state.velocities))
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    return environment.get_template("model_script.py.j2").render(
        form=form,
        format=bench.prepared.file.format,
        is_fixed=bench.prepared.file.base == "fixed",
        root_body=result.model.bodies[0].name,
        title=title,
        why=_wrapped(why),
        xml=text.rstrip(),
        number=number,
        x=_coordinates(form, bench, number.state),
        v=_literal(number.state.velocities) if moves else None,
    )


def _coordinates(form: str, bench: _Bench, state: CanonicalState) -> str | None:
    """The coordinates as an engine's calls take them; None where nothing is moved."""
    reading = bench.answer.reading
    assert reading is not None and reading.model is not None
    values: list[float] = []
    is_moved = False
    for joint, x, _ in reading.model.joint_slices():
        count = {"ball": 3, "free": 6}.get(joint.kind)
        own = NEUTRAL.get(form, {}).get(joint.kind, (0,) * (count or 1)) if count else state.coordinates[x]
        values.extend(own)
        is_moved |= count is None and bool(np.any(state.coordinates[x]))
    return _literal(values) if is_moved else None


def _wrapped(text: str, width: int = 108) -> str:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) + 1 > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def _literal(values: Any) -> str:
    return "[" + ", ".join(f"{float(value):.17g}" for value in values) + "]"


def _simple_states(model: NeutralModel) -> list[CanonicalState]:
    """At rest and moving, with round numbers."""
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
) -> Iterator[_Shown]:
    """Go through the numbers that a script can print, the simplest to understand first."""
    order = joint_permutation(model, reading)
    if order is None:
        count = float(reading.velocity_count)
        if count != model.velocity_count:
            state = CanonicalState(np.zeros(0), np.zeros(0))
            yield _Shown("freedom", (), "degrees of freedom", state, count, float(model.velocity_count))
        return
    states = _simple_states(reading)
    answers = bench.evaluate(states)
    applied = all(answer.passive_force is not None for answer in answers)
    judged, theirs = (m if applied else without_passive_forces(m) for m in (model, reading))
    truths = [certify_states(judged, [_reordered(state, reading, model)])[0] for state in states]
    read = certify_states(theirs, states)
    for quantity in SHOWN_QUANTITIES:
        if quantity == "passive_force" and bench.name != "mujoco":
            continue
        for state, answer, truth, other in zip(states, answers, truths, read, strict=True):
            found = _worst_entry(quantity, answer, truth, other, order)
            if found is not None:
                yield _Shown(quantity, found[1], found[0], state, *found[2:])
    if bench.name == "exudyn":
        yield from _shown_damping(explanation, reading)


def _worst_entry(
    quantity: str,
    answer: ModelQuantities,
    truth: CertifiedModelQuantities,
    read: CertifiedModelQuantities,
    order: Sequence[int],
) -> tuple[str, tuple[int, ...], float, float] | None:
    """The entry that differs most beyond rounding: label, index, the engine's number, the expected one.

    The bound is the larger one of what the file says and of what the importer reads, so that the engine's
    rounding of large terms beside an expected zero is no evidence.
    """
    if quantity == "position":
        triples = {
            f"position of body {body}": (
                answer.poses[body][:, 3],
                pose[:, 3],
                np.maximum(truth.tolerance["poses"][body], read.tolerance["poses"].get(body, 0.0))[:, 3],
            )
            for body, pose in truth.quantities.poses.items()
            if body in answer.poses
        }
    else:
        values, own = getattr(answer, quantity), getattr(truth.quantities, quantity)
        if values is None or own is None:
            return None
        index = np.ix_(*[np.argsort(order)] * own.ndim)
        limit = truth.tolerance[quantity][index]
        if getattr(read.quantities, quantity) is not None:
            limit = np.maximum(limit, read.tolerance[quantity])
        triples = {quantity.replace("_", " "): (values, own[index], limit)}
    worst = 1.0
    found = None
    for label, (values, expected, limit) in triples.items():
        if not np.size(values):
            continue
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            ratios = np.nan_to_num(np.abs(values - expected) / np.maximum(limit, TINY), nan=0.0)
        place = tuple(sorted(int(i) for i in np.unravel_index(int(np.argmax(ratios)), ratios.shape)))
        if ratios[place] > worst:
            worst = ratios[place]
            found = label, place, float(values[place]), float(expected[place])
    return found


def _shown_damping(explanation: Explanation | None, reading: NeutralModel) -> Iterator[_Shown]:
    """The damping that Exudyn's loader returns for the caller's use: no quantity of the engine shows it."""
    changes = [c for cause in explanation.causes for c in cause.changes] if explanation else []
    names = [joint.name for joint in reading.joints]
    for change in changes:
        if change.field == "damping" and change.joint in names:
            index, label = (names.index(change.joint),), f"damping of joint {change.joint}"
            yield _Shown("damping", index, label, _simple_states(reading)[0], change.theirs, change.own)


def _reordered(state: CanonicalState, reading: NeutralModel, model: NeutralModel) -> CanonicalState:
    """The state of a reading in the order of the model's joints."""
    parts = {
        key: (state.coordinates[x], state.velocities[v])
        for key, (_, x, v) in zip(joint_keys(reading), reading.joint_slices(), strict=True)
    }
    chosen = [parts[key] for key in joint_keys(model)]
    return CanonicalState(
        np.concatenate([x for x, _ in chosen] or [np.zeros(0)]),
        np.concatenate([v for _, v in chosen] or [np.zeros(0)]),
    )
