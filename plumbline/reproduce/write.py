"""Write stand-alone scripts of the disagreements in a results folder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from plumbline.engines import environments
from plumbline.judging.known_issues import project_known_issues
from plumbline.judging.rows import WRONG_CALL, Verdict
from plumbline.layout import ROOT
from plumbline.measurements.order_and_limit import STEP_EXPONENTS
from plumbline.model.datatypes import BadInput, Model, State, Unsupported
from plumbline.model.invariants import LONG_RUN_QUANTITIES
from plumbline.model.kinematics import complete_state
from plumbline.model.sampling import compared_states
from plumbline.processes.exceptions import PlumblineError
from plumbline.processes.worker_pool import Outcome, ResultCache, Task, WorkerPool
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.measure import Disagreement
from plumbline.reproduce.render import no_script_reason, render_script
from plumbline.reproduce.shrink import OutOfTime, ReproductionCase
from plumbline.scenario.line_and_column_errors import did_you_mean
from plumbline.storage.results_store import Record, read_results, write_atomically
from plumbline.storage.script_index import read_script_index, script_name, scripts_folder, write_script_index
from plumbline.storage.version_changes import read_version_changes
from plumbline.truth.step_comparison import RUN_QUANTITIES

REQUESTED_SECONDS, UNREQUESTED_SECONDS = 60.0, 3.0  # of shrinking: a script by its key, at the end of a run
MAX_TRIED = 3  # cells of a finding and level for which a script is tried at the end of a run
MIN_CANDIDATES = 6  # shrinking needs at least so many; where they would take too long, it is not begun
HINT = "request this row by its key"


class NotReproducible(PlumblineError, ValueError):
    """No script can be made of a row, or the request is wrong; the message says why."""


@dataclass
class WrittenScripts:
    """What became of the requested rows."""

    files: dict[str, Path] = field(default_factory=dict)  # script of each row key that has one
    reasons: dict[str, str] = field(default_factory=dict)  # why there is none, for the others
    cpu_time: float = 0.0  # s of the workers


def list_disagreements(folder: Path) -> dict[str, str]:
    """List the rows that disagree.

    Returns:
        Diagnosis, or else the verdict's reason, by the key of the row.

    Raises:
        ValueError: results.json is missing or damaged; the message names it.

    """
    document = read_results(folder)
    with _checked(folder):
        return {row["key"]: row["diagnosis"] or row["reason"] for row in _disagreements(document)}


def write_scripts(
    folder: Path,
    keys: Sequence[str] | None = None,
    results: ResultCache | None = None,
    document: Record | None = None,
) -> WrittenScripts:
    """Write scripts of rows into the results folder, and list them in scripts/index.json.

    All rows of a cell and level (of one relation) share a script. Engines run in worker processes.

    Args:
        keys: the wanted rows; by default one cell of each finding and level, where that has no script the
            next: less time is spent on each, rows of a known issue that has a script get that, and scripts of
            an earlier run are removed.
        results: scripts of earlier runs, used where nothing that they depend on has changed.
        document: content of the folder's results.json, where it has been read already.

    Returns:
        The files, and for rows without one the reason.

    Raises:
        NotReproducible: a key names no row that disagrees.
        ValueError: results.json or scripts/index.json is missing or damaged; the message names it.

    """
    document = document or read_results(folder)
    scripts, written = scripts_folder(folder), WrittenScripts()
    with _checked(folder):
        disagreeing = _disagreements(document)
        for key in keys or ():
            if key not in (known := [row["key"] for row in disagreeing]):
                hint = f"; {near}" if (near := did_you_mean(key, known)) else ""
                raise NotReproducible(f"no row {key!r} disagrees here{hint}")
        cells: dict[tuple[str, ...], list[Record]] = {}
        for row in disagreeing:
            cells.setdefault(_cell(row), []).append(row)
        wanted = {cell: [r for r in rows if keys is None or r["key"] in keys] for cell, rows in cells.items()}
        wanted = {cell: rows for cell, rows in wanted.items() if rows}
        recorded = _recorded_scripts() if keys is None else {}
        changes = read_version_changes(folder)
        jobs = int(document.get("run", {}).get("machine", {}).get("jobs", 1))
        # by row key the place in its finding, which begins with the smallest mechanism, and the name of that
        found = {row: (place, f["name"]) for f in document["findings"] for place, row in enumerate(f["rows"])}

        def place_of(cell: tuple[str, ...]) -> int:
            return min(found.get(row["key"], (0, ""))[0] for row in wanted[cell])

        def shown_by(cell: tuple[str, ...]) -> set[tuple[str, str]]:
            """The findings of a cell, at its level."""
            every = wanted[cell]
            return {(str(found.get(row["key"], (0, row["key"]))[1]), str(row["level"])) for row in every}

        pending = sorted(wanted, key=place_of)
        for cell in list(pending):
            if all(row["known_issue"] in recorded for row in wanted[cell]):
                written.files |= {row["key"]: recorded[row["known_issue"]] for row in wanted[cell]}
                pending.remove(cell)
    tried: dict[tuple[str, str], list[str]] = {}  # of findings at a level the first rows of the cells
    scripted: set[tuple[str, str]] = set()  # those that have a script

    @_checked(folder)
    def next_tasks() -> list[Task]:
        """Take one pending cell of each finding and level that has no script; by keys all of them."""
        tasks, begun = list[Task](), set(scripted)
        for cell in list(pending):
            rows = wanted[cell]
            wanting = {x for x in shown_by(cell) - begun if len(tried.get(x, ())) < MAX_TRIED}
            if keys is None and not wanting:
                continue
            pending.remove(cell)
            try:
                if keys is None:
                    _check_worthwhile(cell, rows, cells)
                seconds = UNREQUESTED_SECONDS if keys is None else REQUESTED_SECONDS
                disagreement = find_disagreement(document, cells[cell], seconds)
            except NotReproducible as error:
                written.reasons |= {row["key"]: str(error) for row in rows}
                continue
            begun |= wanting
            for one in wanting:
                tried.setdefault(one, []).append(str(rows[0]["key"]))
            quantities = ", ".join(row["quantity"] for row in rows)
            head = rows[0] | {"quantity": quantities, "since": _version_sentence(rows, changes)}
            tasks.append(Task(cell, make_script, (disagreement, head)))
        return tasks

    index = {} if keys is None else read_script_index(folder)
    if keys is None and scripts.is_dir():  # of an earlier run in the same folder
        for old in (*scripts.glob("*.py"), *scripts.glob("index.json")):
            old.unlink()
    tasks = next_tasks()
    if not tasks and not written.files:
        return written
    scripts.mkdir(exist_ok=True)
    for recorded_script in set(written.files.values()):
        write_atomically(scripts / recorded_script.name, recorded_script.read_bytes())
    written.files = {key: scripts / path.name for key, path in written.files.items()}
    while tasks:
        for outcome in _outcomes(tasks, results or ResultCache(), jobs):
            if not outcome.is_cached:
                written.cpu_time += outcome.cpu_time + outcome.overhead_cpu_time
            text, reason = outcome.value or ("", outcome.failure)
            if text:
                path = scripts / _file_name("/".join(outcome.key))
                write_atomically(path, text.encode())
                written.files |= {row["key"]: path for row in wanted[outcome.key]}
                scripted |= shown_by(outcome.key)
            else:
                written.reasons |= {row["key"]: reason for row in wanted[outcome.key]}
        tasks = next_tasks()
    for cell in pending:
        other = tried[min(shown_by(cell))][-1]
        reason = written.reasons.get(other)
        what = f"has none ({reason})" if reason else "has a script"
        reason = f"{other} shows the same finding and {what}; {HINT}"
        written.reasons |= {row["key"]: reason for row in wanted[cell]}
    write_script_index(folder, index | {key: path.name for key, path in written.files.items()})
    return written


def _outcomes(tasks: Sequence[Task], results: ResultCache, jobs: int) -> Iterator[Outcome]:
    """Take scripts from the cache, and make the others in workers.

    What the environment of another version answers is not in a task's hash, and a script that was not found
    in time may be found the next time: neither is kept.
    """
    kept = {task.key: task for task in tasks if not task.arguments[0].engine.python}
    found = [outcome for task in kept.values() if (outcome := results.get(task)) is not None]
    yield from found
    missing = [task for task in tasks if task.key not in {outcome.key for outcome in found}]
    if missing:
        with WorkerPool(min(jobs, len(missing))) as workers:
            for outcome in workers.run(missing):
                if outcome.key in kept and outcome.failure is None and outcome.value[0]:
                    results.put(kept[outcome.key], outcome)
                yield outcome


def make_script(disagreement: Disagreement, row: Record) -> tuple[str, str]:
    """Shrink a disagreement, render its script and run it once (to be called in a worker).

    Where the script of the smallest case does not show the disagreement, that of the whole case is tried: a
    script rounds differently from an adapter, which can matter next to a bound.

    Args:
        row: the stored row that the script's head describes.

    Returns:
        The script's text and an empty string, or an empty text and the reason why there is none.

    """
    try:
        for find in (disagreement.shrink, lambda: disagreement.measure(disagreement.case)):
            if (evidence := find()) is not None:
                text = render_script(row, evidence, evidence.written(disagreement.engine))
                if _largest_printed_ratio(disagreement.engine.run_script(text)) > 1:
                    return text, ""
    except OutOfTime:
        return "", f"no small case within {disagreement.seconds:g} s of computing; {HINT}"
    except Unsupported as refusal:
        return "", str(refusal)
    return "", "called again, the engine agrees: nothing to show"


def find_disagreement(document: Record, rows: list[Record], seconds: float) -> Disagreement:
    """Find what to measure again for the rows of one cell.

    Args:
        rows: rows of one cell that disagree.
        seconds: time for shrinking [s].

    Raises:
        NotReproducible: there is no script for such rows, or the results do not hold what is needed.

    """
    if rows[0]["level"] == "step":  # single steps have scripts
        rows = [row for row in rows if row["quantity"] not in RUN_QUANTITIES] or rows
    row = max(rows, key=_ratio) if rows[0]["level"] == "step" else rows[0]
    ratio = max(_ratio(row) for row in rows)
    base, version = environments.split_version(row["engine"])
    if reason := no_script_reason(base, row):
        raise NotReproducible(reason)
    try:
        engine = EngineClient(base, environments.ensure_interpreter(row["engine"]) if version else "")
    except environments.EnvironmentUnavailable as error:
        raise NotReproducible(str(error)) from None
    scenario = document["scenarios"].get(row["scenario"])
    if scenario is None:
        raise NotReproducible(f"the results do not hold the scenario {row['scenario']!r}")
    model = Model.from_fields(scenario["model"])
    start = State(**{name: np.array(value, float) for name, value in scenario["state"].items()})
    state = complete_state(model, start)
    if row["level"] in ("trajectory", "invariants"):
        case = _refinement_study(document, rows, model, state)
    else:
        index = int(row["extra"]["state"])
        seed = scenario["seed"] or scenario["digest"]  # results of earlier versions have no seed
        case = ReproductionCase(model, compared_states(model, state, seed, index)[-1])
        if row["level"] == "step":
            h = float(row["extra"]["step"])
            case = replace(case, until=h * row["extra"]["steps"], steps=(h,))
    quantities = tuple(row["quantity"] for row in rows)
    call = row["extra"].get(WRONG_CALL, "")
    return Disagreement(engine, row["level"], quantities, row["integrator"], case, ratio, seconds, call)


def _disagreements(document: Record) -> list[Record]:
    return [row for row in document["rows"] if row["verdict"] == Verdict.DISAGREES]


@contextmanager
def _checked(folder: Path) -> Iterator[None]:
    """Turn what damaged results raise into a sentence."""
    try:
        yield
    except PlumblineError as error:
        if isinstance(error, BadInput):
            raise NotReproducible(f"{folder / 'results.json'}: {error}") from None
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        found = f"{type(error).__name__}: {error}"
        raise NotReproducible(f"{folder / 'results.json'}: damaged results ({found})") from None


def _recorded_scripts() -> dict[str, Path]:
    """The scripts of known issues by their names; an installed package comes without them."""
    folder = ROOT / "docs" / "surface"
    every = {issue.name: folder / issue.script for issue in project_known_issues() if issue.script}
    return {name: path for name, path in every.items() if path.is_file()}


def _version_sentence(rows: list[Record], changes: dict[str, Record]) -> str:
    """Since which version the rows are so, where `bisect` or a known issue says it; else empty."""
    for row in rows:
        if row["key"] in changes:
            return str(changes[row["key"]]["note"])
    ids = {row["known_issue"] for row in rows}
    since = next((issue.since for issue in project_known_issues() if issue.name in ids and issue.since), "")
    return f"Since version {since}." if since else ""


def _check_worthwhile(
    cell: tuple[str, ...], rows: list[Record], cells: dict[tuple[str, ...], list[Record]]
) -> None:
    """Raise NotReproducible for a cell whose script can wait until somebody requests it."""
    scenario, engine, level, integrator, *_ = cell
    if (level, integrator) == ("relations", "-") and (scenario, engine, "state", "-") in cells:
        raise NotReproducible(f"the state-level script of this engine and scenario shows it; {HINT}")
    seconds = rows[0].get("cpu_time", 0.0) if level in ("trajectory", "invariants") else 0.0
    if seconds > UNREQUESTED_SECONDS / MIN_CANDIDATES:
        raise NotReproducible(f"one candidate takes {seconds:.1f} s, too long at the end of a run; {HINT}")


def _largest_printed_ratio(printed: str) -> float:
    return max(map(float, re.findall(r"^  off by (\S+) times", printed, re.M)), default=0.0)


def _cell(row: Record) -> tuple[str, ...]:
    """Return what rows share a script: scenario, engine, level and integrator, or one relation or call."""
    relation = (row["quantity"],) if row["level"] in ("relations", "surface") else ()
    if row["quantity"] in LONG_RUN_QUANTITIES:
        relation = ("long run",)
    return row["scenario"], row["engine"], row["level"], row["integrator"], *relation


def _refinement_study(document: Record, rows: list[Record], model: Model, state: State) -> ReproductionCase:
    """The study behind rows: up to the latest time they compared, with the steps of the run."""
    cell = _cell(rows[0])[:2], rows[0]["integrator"]
    every = [
        row
        for row in document["rows"]
        if (_cell(row)[:2], row["integrator"]) == cell
        and row["level"] in ("trajectory", "invariants")
        and row["quantity"] not in LONG_RUN_QUANTITIES
    ]
    finest = min((row["extra"]["resolution"] for row in every if "resolution" in row["extra"]), default=None)
    declared = next((row["declared_order"] for row in every if row["declared_order"]), None)
    if declared is None:  # only a step's order is observed
        raise NotReproducible("runs of integrators with adaptive steps have no script")
    if finest is None:
        raise NotReproducible("the steps of the refinement study behind this row are not in the results")
    coarsest = 2.0 ** -STEP_EXPONENTS[declared][0]
    steps = tuple(coarsest / 2**k for k in range(round(np.log2(coarsest / finest)) + 1))
    # the longest run, within the compared time, of a power of two of coarsest steps: it can be halved
    until = max(row["compared_until"] for row in rows)
    span = coarsest * 2.0 ** np.floor(np.log2(max(until / coarsest, 1.0)))
    return ReproductionCase(model, state, float(span), steps)


def _ratio(row: Record) -> float:
    """Error over tolerance of a stored row."""
    return float(row["ratio"] or 0.0)


def _file_name(key: str) -> str:
    """Return a file name of safe characters, unique to the key."""
    return script_name(f"{key[:80]}-{hashlib.sha256(key.encode()).hexdigest()[:8]}")
