"""Defects as edits of an adapter's or the reference's text, and what a run of the catalogue makes of them."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.execution.plan import Plan
from plumbline.execution.scenario_verdicts import ScenarioRun
from plumbline.judging.known_issues import KnownIssues, project_known_issues
from plumbline.judging.rows import Row
from plumbline.processes.worker_pool import run_task
from plumbline.scenario.generator import RandomScenarios
from tests.helpers import ROOT
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.tables import table

BETWEEN = {  # modules that hold parts of the edited one and are loaded between it and the adapter
    "reference_impl.elements": ("reference_impl.direct",),
    "reference_impl.joints": ("reference_impl.direct",),
    "adapters.exudyn_common": ("adapters.exudyn_variants",),
}


@dataclass(frozen=True)
class Edit:
    """One mistake, and where a run of the catalogue would compare it."""

    name: str
    engine: str
    file: str
    old: str
    new: str
    runs: list[tuple[str, str]]  # scenario and level
    expected: str = ""  # words of the diagnosis; empty: it need only be reported
    is_control: bool = False  # another computation of the same numbers

    @property
    def fits(self) -> bool:
        """Whether the file has the text once, and is a module with the other one too."""
        source = (ROOT / self.file).read_text(encoding="utf-8")
        with suppress(SyntaxError):
            return source.count(self.old) == 1 and bool(ast.parse(source.replace(self.old, self.new)).body)
        return False


EDITS = [Edit(**entry) for entry in table(__file__)]


@contextmanager
def edited(edit: Edit) -> Iterator[None]:
    """Give every caller the engine whose text is edited."""
    assert edit.fits, f"the edit {edit.name!r} does not fit {edit.file}"
    first = edit.file.removesuffix(".py").replace("/", ".")
    adapter = ENGINES[edit.engine].partition(":")[0]
    import_module(adapter)
    names = dict.fromkeys((first, *BETWEEN.get(first, ()), adapter))
    right = {name: sys.modules[name] for name in names}
    try:  # `load_adapter` finds the module by its name, wherever it is called
        for name in names:
            source = (ROOT / (name.replace(".", "/") + ".py")).read_text(encoding="utf-8")
            module = sys.modules[name] = ModuleType(name)
            exec(source.replace(edit.old, edit.new) if name == first else source, vars(module))
        yield
    finally:
        sys.modules.update(right)


def rows_of_run(edit: Edit, scenario_name: str, level: str, states: int) -> list[Row]:
    """Run a scenario on the edited engine in this process, with the diagnosis of what disagrees."""
    is_random = scenario_name.startswith("random-")
    seed = int(scenario_name.split("-")[-2]) if is_random else 0
    night = RandomScenarios(seed, 0)
    scenario = night.named(scenario_name) if is_random else catalogue_scenario(scenario_name)
    plan = Plan([scenario], [edit.engine], level, random_state_count=states)  # type: ignore[arg-type]
    run = ScenarioRun(plan, scenario, {edit.engine: load_adapter(edit.engine).describe()})
    with edited(edit):
        waiting = list(run.tasks())
        while waiting:
            waiting += run.on_outcome(run_task(waiting.pop(0)))
    known = KnownIssues(project_known_issues(), has_extra_refinements=False)
    return run.judged_rows(run.findings(), known)
