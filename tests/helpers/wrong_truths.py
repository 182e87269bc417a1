"""Truths with a planted mistake: the parent process passes a function as the initialiser of its workers."""

from __future__ import annotations

from typing import Any

from plumbline.model.datatypes import Model
from plumbline.processes import workers
from plumbline.truth import certified, trajectory

GRAVITY_ERROR = 1e-7  # relative


def prepare(*arguments: Any) -> None:
    """Initialise a worker, and give Taylor's method a gravity that is wrong by 1e-7."""
    initialize_worker(*arguments)
    right = trajectory.simulate_taylor

    def wrong(model: Model, *rest: Any) -> Any:
        return right(model.changed(gravity=model.gravity * (1 + GRAVITY_ERROR)), *rest)

    trajectory.simulate_taylor = wrong  # type: ignore[assignment]


def prepare_states(*arguments: Any) -> None:
    """Initialise a worker, and certify states with a gravity that is wrong by 1e-7."""
    initialize_worker(*arguments)
    right = certified.enclose_quantities

    def wrong(model: Model, *rest: Any) -> Any:
        return right(model.changed(gravity=model.gravity * (1 + GRAVITY_ERROR)), *rest)

    certified.enclose_quantities = wrong  # type: ignore[assignment]


initialize_worker = workers.initialize_worker
