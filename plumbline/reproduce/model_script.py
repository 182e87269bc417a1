"""Stand-alone scripts of importers' differences: the smallest file, one number, and what it has to be.

A script imports the engine and NumPy, and prints versions, the engine's number and the certified one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from plumbline.diagnosis.importer_cause import Explanation
from plumbline.engines.environments import importer_interpreter, split_version
from plumbline.engines.importer_calls import describe_importer, evaluate_model_file, read_model_file
from plumbline.importers.importer import Reading
from plumbline.importers.model_file import BaseChoice, PreparedFile, prepare_file
from plumbline.importers.neutral_model import (
    CanonicalState,
    ModelQuantities,
    NeutralModel,
    without_passive_forces,
)
from plumbline.importers.xml_tree import Element, ModelFileError, write_xml
from plumbline.judging.model_file import Answer, FileResult, judge_file, state_seed
from plumbline.judging.rows import Verdict
from plumbline.processes.errors import PlumblineError
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.workers import Limits, Task, WorkerPool
from plumbline.reproduce.model_shrink import shrink_tree
from plumbline.truth.model_comparison import (
    certify_states,
    joint_keys,
    joint_permutation,
    mismatches,
    model_states,
    permuted,
    with_names_of,
)

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
        shown: path of the file.
        importer: the one that differs, with or without a version.
        form: engine whose calls the script uses, one of `FORMS`.
        base: as for the run.
        root: as for the run.
        strip: as for the run.
        seconds: time for the search for a smaller file.
        since: a sentence about the versions that show it.

    Returns:
        The script, which has not been run.

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
            return found is not None and _shows(found, importer, wanted)

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
        return _render(bench, form, result, write_xml(tree, XML_WIDTH), since)


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
        task = Task(
            0, function, arguments, Limits(TASK_SECONDS), python=self.python if python is None else python
        )
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


def _render(bench: _Bench, form: str, result: FileResult, text: str, since: str) -> ModelScript:
    """Write the script about the first quantity that differs at a simple state."""
    explanation = result.explanations.get(bench.importer)
    reading = bench.answer.reading
    assert reading is not None and reading.model is not None
    number = _shown_number(bench, result.model, reading.model)
    if number is None:
        number = _shown_damping(form, explanation, reading.model)
    sentences = [] if explanation is None else [cause.sentence for cause in explanation.causes]
    why = " ".join(sentences)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    script = environment.get_template("model.py.j2").render(
        form=form,
        format=bench.prepared.file.format,
        is_fixed=bench.prepared.file.base == "fixed",
        root_body=result.model.bodies[0].name,
        title=f"{bench.info.title} {bench.info.version}",
        why=_wrapped(
            why or f"{bench.info.title} {bench.info.version} reads another robot than the file says."
        )
        + (f"\n{_wrapped(since)}" if since else ""),
        xml=text.rstrip(),
        number=number,
        x=_literal(number.state.coordinates),
        v=_literal(number.state.velocities),
    )
    return ModelScript(script, text, number.engine_value, number.expected)


def _wrapped(text: str, width: int = 108) -> str:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) + 1 > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def _literal(values: Any) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


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


def _shown_damping(form: str, explanation: Explanation | None, reading: NeutralModel) -> _Shown:
    """The damping that Exudyn's loader returns for the caller's use: no quantity of the engine shows it."""
    change = next((c for cause in explanation.causes for c in cause.changes), None) if explanation else None
    if form != "exudyn" or change is None or change.field != "damping":
        raise NoModelScript("the difference does not show at a state with round numbers")
    names = [joint.name for joint in reading.joints]
    place, label = names.index(change.joint), f"damping of joint {change.joint}"
    return _Shown("damping", (place,), label, _simple_states(reading)[0], change.theirs, change.own)


def _shown_number(bench: _Bench, model: NeutralModel, reading: NeutralModel) -> _Shown | None:
    """Choose the number that the script prints; None where no quantity differs at a simple state."""
    order = joint_permutation(model, reading)
    if order is None:
        count = float(reading.velocity_count)
        state = CanonicalState(np.zeros(0), np.zeros(0))
        return _Shown("freedom", (), "degrees of freedom", state, count, float(model.velocity_count))
    states = _simple_states(reading)
    answers = bench.evaluate(states)
    applied = all(answer.passive_force is not None for answer in answers)
    judged = model if applied else without_passive_forces(model)
    inverse = np.argsort(order)
    shown = [q for q in SHOWN_QUANTITIES if q != "passive_force" or bench.name == "mujoco"]
    for quantity in shown:
        for state, answer in zip(states, answers, strict=True):
            own = _reordered(state, reading, model)
            (truth,) = certify_states(judged, [own])
            worst = mismatches(judged, [truth], [permuted(answer, order)]).get(quantity)
            if worst is None or worst.ratio <= 1:
                continue
            if quantity == "position":
                body = worst.where.removeprefix("body ")
                values = answer.poses[body][:, 3], truth.quantities.poses[body][:, 3]
                label = f"position of body {body}"
            else:
                expected = getattr(truth.quantities, quantity)
                expected = expected[np.ix_(*[inverse] * expected.ndim)]
                values, label = (getattr(answer, quantity), expected), quantity.replace("_", " ")
            difference = np.abs(values[0] - values[1])
            index = tuple(int(i) for i in np.unravel_index(int(np.argmax(difference)), difference.shape))
            return _Shown(quantity, index, label, state, float(values[0][index]), float(values[1][index]))
    return None


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
