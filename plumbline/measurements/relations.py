"""Metamorphic relations: one engine compared with itself on equivalent problems; no truth is needed."""

from __future__ import annotations

from collections.abc import Sequence

from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.measurements.relation_result import RelationResult
from plumbline.measurements.repeatability import check_repeatability
from plumbline.measurements.run_relations import check_run_relations
from plumbline.measurements.state_relations import check_state_relations
from plumbline.model.datatypes import Model, State


def check_relations(engine: str, model: Model, states: Sequence[State]) -> list[RelationResult]:
    """Check every relation on one engine; runs inside a worker.

    Args:
        states: states of it; runs start from the first.

    Returns:
        The results of repeatability, of the relations at states, and of those of runs.

    """
    adapter = metamorphic_hooks(load_adapter(engine))
    return [
        *check_repeatability(adapter, model, states),  # first: the adapter has not been asked before
        *check_state_relations(adapter, model, states),
        *check_run_relations(adapter, model, states[0]),
    ]
