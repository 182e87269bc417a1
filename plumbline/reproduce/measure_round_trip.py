"""A run that an engine makes in two ways, and ends otherwise: there and back, or by another linear solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.judging.relation_result import OPTION_PREFIX
from plumbline.judging.run_relations import (
    REVERSED_IN_TIME,
    characteristic_scales,
    relative_differences,
    run_tolerance,
    state_at_sample,
)
from plumbline.model.datatypes import Integrator, Model, State
from plumbline.reproduce.engine_client import OfRuns
from plumbline.reproduce.shrink import Case


@dataclass(frozen=True, eq=False)
class ShownTwice:
    """A run whose two ends should be the same."""

    case: Case
    ratio: float
    name: str  # of the relation
    integrator: Integrator
    solver: str  # the other one; empty where the run is there and back
    allowed: dict[str, float]  # m, rad, m/s, rad/s: the largest difference of a body


def both_ends(
    engine: str, relation: str, integrator: str, model: Model, state: State, end: float, resolution: float
) -> tuple[State, State, int]:
    """The two samples that should be the same, and the steps between (to be called in a worker)."""
    chosen = metamorphic_hooks(load_adapter(engine))
    if relation == REVERSED_IN_TIME:
        run = chosen.simulate_round_trip(model, state, end, integrator, resolution)
        return state_at_sample(run, 0), state_at_sample(run, 2, -1.0), run.steps
    times = np.array([0.0, end])
    ways = chosen, chosen.with_option(relation.removeprefix(OPTION_PREFIX))
    one, other = (way.simulate(model, state, times, integrator, resolution) for way in ways)
    return state_at_sample(one, -1), state_at_sample(other, -1), one.steps


@dataclass
class Twice(OfRuns):
    """By how much the two ends of a run differ, over what rounding and its steps' solver explain."""

    relation: str

    def __call__(self, case: Case) -> ShownTwice | None:
        """None for what the engine refuses, and for drag, which knows the direction of time."""
        model, state, until, (resolution,) = case.model, case.state, case.until, case.steps
        if model.has_drag and self.relation == REVERSED_IN_TIME:
            return None
        try:
            one, other, steps = self.engine.ask(
                both_ends, self.relation, self.method, model, state, until, resolution
            )
            limit = run_tolerance(self.integrator, model, state, until, steps)
        except Exception:
            return None
        solver = "" if self.relation == REVERSED_IN_TIME else self.relation.removeprefix(OPTION_PREFIX)
        limit *= 2 if solver else 1  # both runs are off
        length, spin, speed = characteristic_scales(model, one)
        scales = {"position": length, "attitude": 1.0, "velocity": speed, "angular velocity": spin}
        most = {name: float(limit * scale) for name, scale in scales.items()}
        ratio = max(relative_differences(model, one, other).values()) / limit
        return ShownTwice(case, ratio, self.relation, self.integrator, solver, most)
