"""Search for new findings: random mechanisms on engines until the time is over or enough is found.

Scenario k of a seed is the same whatever the number of jobs.  What is found is grouped at once, so that one
cause is one finding; a scenario of each new finding is made smaller as long as the finding shows, and stored
as a scenario file.  A corpus keeps the mechanisms that have a pair of features not seen before.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

from plumbline.engines.adapter import EngineInfo
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import Plan
from plumbline.execution.random_batch import RandomBatch
from plumbline.execution.runner import RunResult, make_executor, run_plan, save
from plumbline.judging.findings import Finding, find_findings
from plumbline.judging.rows import Row
from plumbline.model.datatypes import JOINT_ELEMENTS
from plumbline.model.features import features
from plumbline.processes.cpu_time import CpuTimes
from plumbline.processes.exceptions import PlumblineError
from plumbline.processes.worker_pool import Executor
from plumbline.reproduce.shrink import ReproductionCase, fewer_bodies, shrink
from plumbline.scenario.generator import random_mechanism, random_scenario
from plumbline.scenario.loader import Scenario, scenario_from_dict
from plumbline.scenario.mechanism_document import mechanism_document
from plumbline.storage.results_store import ResultTables, write_atomically

BATCH = 8  # scenarios compared together, whatever the number of jobs
MAX_SHRINKINGS = 60  # smaller scenarios that are tried of one finding
MAX_STORED = 50  # findings with a scenario file
REMOVABLE = ("load", "drag")  # fields of bodies
CONTENT = ("name", "mass", "inertia", *REMOVABLE)  # of a body, whatever joint it is on

Document = dict[str, Any]


@dataclass
class FuzzResult:
    """What a search found so far."""

    seed: int
    scenario_count: int = 0
    rows: list[Row] = field(default_factory=list)
    scenarios: dict[str, Document] = field(default_factory=dict)  # of the rows: model, title, bodies …
    engines: dict[str, EngineInfo] = field(default_factory=dict)
    metadata: Document = field(default_factory=dict)  # of the last run
    smallest: dict[str, Scenario] = field(default_factory=dict)  # by finding, made smaller
    kept: int = 0  # mechanisms added to the corpus
    started: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def findings(self) -> list[Finding]:
        """All findings, those that nothing expects first."""
        return find_findings(self.rows, {name: about["bodies"] for name, about in self.scenarios.items()})

    @property
    def new(self) -> list[Finding]:
        """Those that nothing expects."""
        return [finding for finding in self.findings if finding.needs_attention]

    @property
    def exit_code(self) -> ExitCode:
        """That of `run`: also where nothing was compared, it is not 0."""
        return ExitCode.DISAGREEMENT if self.new or not self.scenario_count else ExitCode.SUCCESS

    def as_run(self) -> RunResult:
        """The rows that need a look as those of one run."""
        tables = ResultTables()
        tables.add_rows(self.rows)
        found = RunResult(
            self.rows,
            [],
            self.engines,
            self.scenarios,
            RandomBatch(),
            tables,
            CpuTimes(),
            dict(self.metadata),
        )
        found.metadata |= {
            "id": self.started.strftime("%Y%m%dT%H%M%SZ"),
            "started": self.started.isoformat(timespec="seconds"),
            "duration": (datetime.now(UTC) - self.started).total_seconds(),
            "sentence": f"{self.scenario_count} mechanisms of seed {self.seed}, {len(self.new)} new findings",
            "exit_code": int(self.exit_code),
            "random_batch": None,
        }
        return found


class TimeOver(Exception):
    """The time of a search is over; what was not finished does not count."""


def scenario_of(seed: int, index: int) -> Scenario:
    """Return scenario k of a seed: chains of rods and balls and mechanisms of any joints take turns."""
    make = random_mechanism if index % 2 else random_scenario
    return make(seed, index // 2)


def search(
    plan: Plan,
    result: FuzzResult,
    *,
    seconds: float,
    max_findings: int,
    corpus: Corpus,
    log: Callable[[str], None],
) -> None:
    """Compare scenarios until the time is over or enough is found; an interruption leaves what was found.

    Args:
        plan: engines, level, limits and known issues; its scenarios are not used.
        result: is added to.
        log: called with a sentence about each new finding.

    """
    end = time.monotonic() + seconds
    with suppress(TimeOver), make_executor(plan) as executor:
        compare = partial(_compare, plan, executor, end)
        for index in corpus.first_indices(result.seed):
            if len(result.new) >= max_findings:
                return
            batch = [scenario_of(result.seed, k) for k in range(index, index + BATCH)]
            known = {finding.name for finding in result.new}
            compare(batch, result)
            result.scenario_count += len(batch)
            result.kept += sum(map(corpus.add, batch))
            for finding in result.new:
                if finding.name not in known and len(result.smallest) < MAX_STORED:
                    log(f"new: {finding.name} ({finding.scenarios[0]})")
                    start = next(s for name in finding.scenarios for s in batch if s.name == name)
                    _shrink(compare, start, finding, result.smallest)


def _compare(
    plan: Plan, executor: Executor, end: float, scenarios: Sequence[Scenario], result: FuzzResult,
    engines: Sequence[str] = (),
) -> None:  # fmt: skip
    """Add what engines return on scenarios; raises `TimeOver` after the monotonic time ``end``."""

    def check_clock(*_: Any) -> None:
        if time.monotonic() > end:
            raise TimeOver

    check_clock()
    plan = replace(plan, scenarios=[], random_scenarios=scenarios, engines=engines or plan.engines)
    found = run_plan(plan, check_clock, executor=executor)
    result.engines, result.metadata = found.engines, found.metadata
    rows = [row for row in found.rows if row.verdict.needs_attention]
    result.rows += rows
    result.scenarios |= {row.scenario: found.scenarios[row.scenario] for row in rows}


def _shrink(
    compare: Callable[[Sequence[Scenario], FuzzResult, Sequence[str]], None],
    scenario: Scenario,
    finding: Finding,
    smallest: dict[str, Scenario],
) -> None:
    """Make a scenario smaller as long as it shows a finding.

    Args:
        compare: adds what engines return on scenarios to a result.
        smallest: gets the smallest scenario so far, by the finding's name; it has that name, and the seed of
            the states that showed the finding.

    """
    own, tried = finding.name.lstrip("."), 0  # no scenario has a name with a dot at its start
    about = {"name": own, "title": f"Made smaller from {scenario.name}", "seed": scenario.seed}
    file = f"{own}.yaml"
    smallest[finding.name] = start = scenario_from_dict(scenario.document | about, file)

    def shows(document: Document) -> bool:
        nonlocal tried
        try:
            candidate = scenario_from_dict(document, file)
        except PlumblineError:
            return False  # no mechanism, or loops that do not close
        tried += 1
        result = FuzzResult(0)
        compare([candidate], result, [finding.rows[0].engine])
        if is_shown := any(one.identity == finding.identity for one in result.findings):
            smallest[finding.name] = candidate
        return is_shown

    passes = [_fewer_bodies, _smaller, _smaller]
    shrink(start.document, passes, shows, lambda: tried >= MAX_SHRINKINGS)


def _fewer_bodies(document: Document) -> Iterator[Document]:
    """Documents of a part of the mechanism."""
    scenario = scenario_from_dict(document, "part.yaml")
    other = {name: x for name, x in document.items() if name not in ("springs", "closes")}
    for part in fewer_bodies(ReproductionCase(scenario.model, scenario.state)):
        yield other | mechanism_document(part.model, part.state)


def _smaller(document: Document) -> Iterator[Document]:
    """Documents with one thing less: a body, whose parent carries its branches, a loop, a load and so on."""
    bodies = document["bodies"]
    for k in reversed(range(len(bodies) if len(bodies) > 1 else 0)):
        changed = _without(document, "bodies", k)
        for body in changed["bodies"]:
            if body.get("parent") is not None and body["parent"] == bodies[k].get("name"):
                body["parent"] = bodies[k].get("parent")
        yield changed
    for part in ("closes", "springs"):
        for k in range(len(document.get(part) or ())):
            yield _without(document, part, k)
    for k, closing in enumerate(document.get("closes") or ()):
        changed = _without(document, "closes", k)
        for body in changed["bodies"]:
            if body.get("name") == closing["body"]:  # the closing joint becomes its own
                kept = {name: body[name] for name in CONTENT if name in body}
                body.clear()
                body |= kept | {name: x for name, x in closing.items() if name != "body"}
        yield changed
    for k, body in enumerate(bodies):
        for name in REMOVABLE:
            if body.get(name):
                yield _without(document, "bodies", k, name)
        joint = body.get("joint")
        for name in JOINT_ELEMENTS if isinstance(joint, dict) else ():
            if joint.get(name):
                yield _without(document, "bodies", k, "joint", name)


def _without(document: Document, *path: str | int) -> Document:
    changed = copy.deepcopy(document)
    *first, last = path
    place: Any = changed
    for key in first:
        place = place[key]
    del place[last]
    return changed


class Corpus:
    """A folder of scenario files with combinations of features that no other has, up to a number."""

    def __init__(self, folder: Path | None, capacity: int) -> None:
        """Read which combinations the folder has."""
        self.folder, self.capacity = folder, capacity
        self._seen: set[tuple[Any, ...]] = set()
        self._index = folder / "corpus.json" if folder else None
        stored: Document = {}
        if self._index and self._index.is_file():
            stored = json.loads(self._index.read_text(encoding="utf-8"))
        self._seen.update(tuple(map(tuple, pair)) for pair in stored.get("seen", ()))
        self._next: dict[str, int] = stored.get("next", {})  # by seed: the first scenario that was not tried
        self._count = len(list(folder.glob("*.yaml"))) if folder else 0

    def first_indices(self, seed: int) -> Iterator[int]:
        """List the first index of each batch; a search of the same seed goes on where the last one ended."""
        index = self._next.get(str(seed), 0)
        while True:
            yield index
            index += BATCH
            self._next[str(seed)] = index
            self._save()

    def add(self, scenario: Scenario) -> bool:
        """Keep a scenario with two features that were not seen together; return whether it is kept."""
        if self.folder is None:
            return False
        own = {tuple(sorted(map(tuple, some))) for some in combinations(set(features(scenario.model)), 2)}
        if own <= self._seen:
            return False
        self._seen |= own
        if self._count >= self.capacity:
            return False
        self._count += 1
        self.folder.mkdir(parents=True, exist_ok=True)
        write_scenario(scenario, self.folder / f"{scenario.name}.yaml")
        return True

    def _save(self) -> None:
        if self._index:
            self._index.parent.mkdir(parents=True, exist_ok=True)
            text = json.dumps({"next": self._next, "seen": sorted(self._seen)})
            write_atomically(self._index, text.encode())


def write_scenario(scenario: Scenario, path: Path) -> None:
    """Write a scenario file; JSON is YAML."""
    write_atomically(path, json.dumps(scenario.document, indent=1).encode())


def write_findings(result: FuzzResult, folder: Path, command: str) -> Iterable[Path]:
    """Write the results as those of a run, and a scenario file of each new finding."""
    save(result.as_run(), folder, command)
    for scenario in result.smallest.values():
        path = folder / f"{scenario.name}.yaml"
        write_scenario(scenario, path)
        yield path
