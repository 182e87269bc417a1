"""Metamorphic relations: one engine compared with itself on equivalent problems; no truth is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.measurements.relation_result import RelationResult
from plumbline.measurements.repeatability import check_repeatability
from plumbline.measurements.run_relations import check_run_relations, run_growth
from plumbline.measurements.state_relations import StateBounds, check_state_relations, state_bounds
from plumbline.model.datatypes import Model, State


@dataclass(frozen=True)
class RelationBounds:
    """What the tolerances of relations follow from, the same for every engine."""

    states: StateBounds
    growth: list[float]  # of perturbations in runs, as `run_growth` has it


def relation_bounds(model: Model, states: Sequence[State]) -> RelationBounds:
    """Compute once for all engines what the tolerances of relations follow from."""
    return RelationBounds(state_bounds(model, states), run_growth(model, states[0]))


def check_relations(
    engine: str, model: Model, states: Sequence[State], bounds: RelationBounds
) -> list[RelationResult]:
    """Check every relation on one engine; runs inside a worker.

    Args:
        states: states of it; runs start from the first.
        bounds: of `relation_bounds` for the same states.

    Returns:
        The results of repeatability, of the relations at states, and of those of runs.

    """
    adapter = metamorphic_hooks(load_adapter(engine))
    return [
        *check_repeatability(adapter, model, states),  # first: the adapter has not been asked before
        *check_state_relations(adapter, model, states, bounds.states),
        *check_run_relations(adapter, model, states[0], bounds.growth),
    ]
