"""A disagreement as a short script that an engine's maintainer can run: the engine and numpy, nothing else.

The case that disagrees is shrunk first (`shrink`), to the fewest bodies, the shortest run and the simplest
numbers that still show it, each try asked of the engine again and measured with the truth (`shown`).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.engines import environments
from plumbline.judging.convergence import RTOL_FACTORS, STEP_EXPONENTS
from plumbline.judging.long_run_study import MIN_WINDOW_SECONDS
from plumbline.model.datatypes import Model, State
from plumbline.model.kinematics import state_from_minimal
from plumbline.model.sampling import derive_seed, random_states
from plumbline.processes.errors import PlumblineError
from plumbline.processes.workers import Limits, Task, WorkerPool
from plumbline.reproduce.engine_client import Engine
from plumbline.reproduce.measure import Question, measure_of, shrunk, whole
from plumbline.reproduce.measure_long_run import GROWTH, LONG
from plumbline.reproduce.render import script, unscripted
from plumbline.reproduce.shrink import Case, OutOfTime
from plumbline.storage import results_store

ASKED, UNASKED = 60.0, 3.0  # s of computing for a script that was asked for, and at the end of a run
TRIES = 6  # at least so many make a case smaller: where they take longer than `UNASKED`, none is begun
ASK = "ask for this row by its key"


class NotReproducible(PlumblineError, ValueError):
    """No script can be made of that row; the message says why."""


def disputed(document: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows a script may be asked for: those that disagree."""
    return [row for row in document["rows"] if row["verdict"] == "disagrees"]


def write(
    folder: Path, keys: Sequence[str] | None = None, limits: Limits | None = None, jobs: int | None = None
) -> dict[str, str]:
    """Scripts of rows (all that disagree by default) in folder/scripts; key → file name or why there is none.

    One script serves all rows of a cell and level (of one relation).  index.json there lists the files by
    row key.  ``jobs`` workers shrink at once, as many as the run had by default.
    """
    document = results_store.read_results(folder)
    rows = [row for row in disputed(document) if keys is None or row["key"] in keys]
    for key in set(keys or ()) - {row["key"] for row in rows}:
        near = get_close_matches(key, [row["key"] for row in disputed(document)], 1)
        raise NotReproducible(
            f"no row {key!r} disagrees here{f'; did you mean {near[0]!r}?' if near else ''}"
        )
    scripts = folder / "scripts"
    if keys is None and scripts.is_dir():  # of an earlier run in the same folder
        for old in (*scripts.glob("*.py"), *scripts.glob("index.json")):
            old.unlink()
    told: dict[str, str] = {}
    tasks: list[Task] = []
    cells: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows:
        cells.setdefault(cell_of(row), []).append(row)
    at_state = {cell[:2] for cell in cells if cell[2] == "state"}
    for cell, its in cells.items():
        if keys is None and cell[2:4] == ("relations", "-") and cell[:2] in at_state:
            why = f"the state-level script of this engine and scenario shows it; {ASK}"
            told |= {row["key"]: why for row in its}
            continue
        cost = its[0].get("cpu_time", 0.0) if cell[2] in ("trajectory", "invariants") else 0.0
        if long(its[0]):  # the first tries are as short as that
            cost *= min(MIN_WINDOW_SECONDS / its[0]["compared_until"], 1.0)
        if keys is None and cost > UNASKED / TRIES:
            why = f"one try takes {cost:.1f} s of computing, too long at the end of a run; {ASK}"
            told |= {row["key"]: why for row in its}
            continue
        every = [row for row in disputed(document) if cell_of(row) == cell]
        try:
            question = asked(document, every, UNASKED if keys is None else ASKED)
        except NotReproducible as why:
            told |= {row["key"]: str(why) for row in its}
        else:
            about = its[0] | {"quantity": ", ".join(row["quantity"] for row in its)}
            tasks.append(Task(cell, shown_by_script, (question, about), limits or Limits()))
    if not tasks:
        return told
    scripts.mkdir(exist_ok=True)
    jobs = jobs or int(document.get("run", {}).get("machine", {}).get("jobs", 1))
    with WorkerPool(min(jobs, len(tasks)), limits) as workers:
        for outcome in workers.run(tasks):
            its = cells[outcome.key]
            text, nothing = outcome.value or ("", outcome.failure)
            if nothing:
                told |= {row["key"]: nothing for row in its}
                continue
            name = file_name("/".join(outcome.key))
            results_store.write_atomically(scripts / name, text.encode())
            told |= {row["key"]: name for row in its}
    index = {key: name for key, name in told.items() if (scripts / name).is_file()}
    before = scripts / "index.json"
    if before.exists():
        index = json.loads(before.read_text(encoding="utf-8")) | index
    results_store.write_atomically(before, json.dumps(index, indent=1).encode())
    return told


def shown_by_script(question: Question, row: dict[str, Any]) -> tuple[str, str]:
    """The script of the smallest case, which was seen to show the disagreement; or none, and why.

    The same state is rounded otherwise by a script than by an adapter, which can matter next to a bound.
    """
    try:
        for find in (shrunk, lambda q: measure_of(q)(whole(q))):
            if (found := find(question)) is not None:
                text = script(row, found)
                if disagreement(question.engine.say(text)) > 1:
                    return text, ""
    except OutOfTime:
        return "", f"no small case within {question.seconds:g} s of computing; {ASK}"
    return "", "asked again, the engine agrees: nothing to show"


def disagreement(said: str) -> float:
    """The largest excess over a tolerance in the output of a script."""
    return max(map(float, re.findall(r"^  over (?:what|the) .*: (\S+)$", said, re.M)), default=0.0)


def cell_of(row: dict[str, Any]) -> tuple[str, ...]:
    """What rows share a script: scenario, engine, level and integrator, or relation."""
    apart = (row["quantity"],) if row["level"] == "relations" else ()
    if long(row):
        apart = ("long growth" if row["quantity"].endswith(GROWTH) else "long",)
    return row["scenario"], row["engine"], row["level"], row["integrator"], *apart


def long(row: dict[str, Any]) -> bool:
    """Whether a row is about the nightly's long runs (`endurance`)."""
    return str(row["quantity"]).endswith((LONG, GROWTH))


def asked(document: dict[str, Any], rows: list[dict[str, Any]], seconds: float) -> Question:
    """What to shrink for the rows of one cell; NotReproducible where there is nothing to ask again."""
    row = rows[0]
    base, version = environments.split_version(row["engine"])
    if why := unscripted(base, row):
        raise NotReproducible(why)
    try:
        engine = Engine(base, environments.ensure_interpreter(row["engine"]) if version else "")
    except environments.EnvironmentUnavailable as error:
        raise NotReproducible(str(error)) from None
    about = document["scenarios"].get(row["scenario"])
    if about is None:
        raise NotReproducible(f"the results do not hold the scenario {row['scenario']!r}")
    model = Model(**{name: np.array(value, float) for name, value in about["model"].items()})
    if long(row):
        case = Case(model, start(model, about), max(rows, key=ratio)["compared_until"])
    elif row["level"] in ("trajectory", "invariants"):
        case = runs_of(document, rows, model, start(model, about))
    elif row["integrator"] != "-":
        if "resolution" not in row["extra"]:
            raise NotReproducible("the step of this run is not in the results")
        case = Case(model, start(model, about), row["extra"]["end"], (row["extra"]["resolution"],))
    else:
        index = int(row["extra"]["state"])
        states = random_states(model, index, derive_seed("states", about["digest"])) if index else []
        case = Case(model, states[-1] if states else start(model, about))
    most = max(ratio(row) for row in rows)
    wanted = tuple(row["quantity"] for row in rows)
    return Question(
        engine, row["level"], wanted, row["integrator"], case, most, seconds, about.get("sample", 0.0)
    )


def start(model: Model, about: dict[str, Any]) -> State:
    """The initial state of a scenario."""
    return state_from_minimal(
        model, **{name: np.array(value, float) for name, value in about["state"].items()}
    )


def runs_of(document: dict[str, Any], rows: list[dict[str, Any]], model: Model, state: State) -> Case:
    """The runs behind rows: up to the time of the longest of them, at the resolutions of the ladder."""
    cell = {k: rows[0][k] for k in ("scenario", "engine", "integrator")}
    every = [row for row in document["rows"] if all(row[k] == cell[k] for k in cell) and of_ladder(row)]
    finest = min((row["extra"]["resolution"] for row in every if "resolution" in row["extra"]), default=None)
    declared = next((row["declared_order"] for row in every if row["declared_order"]), None)
    until = max(row["compared_until"] for row in rows)
    if finest is None:
        raise NotReproducible("the ladder of steps behind this row is not in the results")
    if declared is None:  # an adaptive integrator: tolerances from a million times the tightest
        return Case(model, state, until, tuple(finest * factor for factor in RTOL_FACTORS))
    coarsest = 2.0 ** -STEP_EXPONENTS[declared][0]
    steps = [coarsest / 2**k for k in range(round(np.log2(coarsest / finest)) + 1)]
    # the longest run of a number of coarsest steps that halves well, within the row's time
    span = coarsest * 2.0 ** np.floor(np.log2(max(until / coarsest, 1.0)))
    return Case(model, state, float(span), tuple(steps))


def of_ladder(row: dict[str, Any]) -> bool:
    """Whether a row is about the runs of a ladder of steps."""
    return row["level"] in ("trajectory", "invariants") and not long(row)


def ratio(row: dict[str, Any]) -> float:
    """By how much a row disagrees, in tolerances."""
    return float(row["ratio"] or 0.0)


def file_name(key: str) -> str:
    """A file name of safe characters, unique to the key."""
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", key).strip("-.")[:80]
    return f"{safe}-{hashlib.sha256(key.encode()).hexdigest()[:8]}.py"
