"""The cells of scenario × engine × level that the fast tests run; `-m full` runs the others.

Every scenario is compared at state level.  At the other levels the scenarios are taken from small to large,
of one size from generic (few zeros among their numbers) to special, those with a closed form last: a scenario
of at most `MAX_BODIES` bodies is kept if it has a feature that none before it has.  Then those are dropped,
from the last to the first, whose features the others have.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from plumbline.engines.registry import load_adapter
from plumbline.execution.plan import TaskKind
from plumbline.execution.scenario_run import uncompared_kinds
from plumbline.scenario.loader import Scenario
from tests.helpers.catalogue import catalogue_scenarios

MAX_BODIES = 5  # motions of joints that only larger trees have: tests/adapters/test_tree_motions.py
LOADS = ("force", "moment", "drag_force", "drag_moment")
KINDS = {"step": TaskKind.STEP, "trajectory": TaskKind.TRAJECTORY}


def levels(engine: str, scenario: Scenario) -> list[str]:
    """Levels at which an engine is compared on a scenario."""
    integrators, left_out = load_adapter(engine).integrators, uncompared_kinds(scenario.model)
    has = {"step": any(one.method is not None for one in integrators), "trajectory": bool(integrators)}
    return ["state", *(level for level, kind in KINDS.items() if has[level] and kind not in left_out)]


def features(scenario: Scenario) -> set[str]:
    """What a comparison on the scenario exercises: joints, of chains also neighbours, loads and size."""
    model = scenario.model
    if not model.is_chain:
        return set(model.kind)
    is_loaded = any(np.any(getattr(model, name)) for name in LOADS)
    found = {f"{min(model.n, 3)} bodies{' with loads' * is_loaded}"}
    found |= {"closed form"} if scenario.closed_form else set()
    above = ("the world", *model.kind[:-1])
    found |= {f"{kind} on {other}" for kind, other in zip(model.kind, above, strict=True)}
    for name in LOADS:
        size = np.abs(getattr(model, name)).reshape(model.n, -1).max(1)
        found |= {f"{name} on {kind}" for kind, x in zip(model.kind, size, strict=True) if x}
    return found


@cache
def representatives(level: str) -> dict[str, set[str]]:
    """Scenarios of a level in the fast tests, with their features."""
    scenarios = [s for s in catalogue_scenarios().values() if s.model.n <= MAX_BODIES]
    compared = [s for s in scenarios if KINDS[level] not in uncompared_kinds(s.model)]
    chosen: dict[str, set[str]] = {}
    for scenario in sorted(compared, key=lambda s: (s.closed_form is not None, s.model.n, _zeros(s), s.name)):
        if features(scenario).difference(*chosen.values()):
            chosen[scenario.name] = features(scenario)
    for name in reversed(list(chosen)):
        if chosen[name] <= set().union(*(found for other, found in chosen.items() if other != name)):
            del chosen[name]
    return chosen


def _zeros(scenario: Scenario) -> int:
    """How many numbers of the model and its initial state are zero."""
    arrays = [np.asarray(x) for x in (*scenario.model.fields.values(), *vars(scenario.state).values())]
    return sum(int(np.sum(x == 0)) for x in arrays if x.dtype.kind == "f")
