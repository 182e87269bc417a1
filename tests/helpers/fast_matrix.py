"""The cells of scenario × engine × level that the fast tests run; `-m full` runs the others.

Every scenario is compared at state level.  At the other levels the scenarios are taken from small to large,
of one size from generic (few zeros among their numbers) to special, those with a closed form last: a scenario
of at most `MAX_BODIES` bodies is kept if it has a feature that none before it has.
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
    """What a comparison on the scenario exercises: size, joints, of chains also neighbours and loads."""
    model = scenario.model
    found = {f"{min(model.n, 3)} bodies", *(["closed form"] if scenario.closed_form else [])}
    if not model.is_chain:
        return found | set(model.kind)
    above = ("the world", *model.kind[:-1])
    found |= {f"{kind} on {other}" for kind, other in zip(model.kind, above, strict=True)}
    for name in LOADS:
        size = np.abs(getattr(model, name)).reshape(model.n, -1).max(1)
        found |= {f"{name} on {kind}" for kind, x in zip(model.kind, size, strict=True) if x}
    return found


@cache
def representatives(level: str) -> dict[str, set[str]]:
    """Scenarios of a level in the fast tests, each with the features that it adds."""
    chosen: dict[str, set[str]] = {}
    by_size = sorted(
        (s for s in catalogue_scenarios().values() if s.model.n <= MAX_BODIES),
        key=lambda s: (s.closed_form is not None, s.model.n, _zeros(s), s.name),
    )
    for scenario in by_size:
        new = features(scenario).difference(*chosen.values())
        if new and KINDS[level] not in uncompared_kinds(scenario.model):
            chosen[scenario.name] = new
    return chosen


def _zeros(scenario: Scenario) -> int:
    """How many numbers of the model and its initial state are zero."""
    arrays = [np.asarray(x) for x in (*scenario.model.fields.values(), *vars(scenario.state).values())]
    return sum(int(np.sum(x == 0)) for x in arrays if x.dtype.kind == "f")
