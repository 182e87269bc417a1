"""Truths with a planted mistake: the parent process passes a function as the initialiser of its workers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from plumbline.model.datatypes import Model
from plumbline.processes import worker_process
from plumbline.truth import certified_state, ground_truth, trajectory_truth

GRAVITY_ERROR = 1e-7  # relative


def with_wrong_gravity(right: Any) -> Any:
    def wrong(model: Model, *rest: Any) -> Any:
        return right(model.changed(gravity=model.gravity * (1 + GRAVITY_ERROR)), *rest)

    return wrong


def prepare(*arguments: Any) -> None:
    """Initialise a worker, and give Taylor's method a gravity that is wrong by 1e-7."""
    initialize_worker(*arguments)
    trajectory_truth.simulate_taylor = with_wrong_gravity(trajectory_truth.simulate_taylor)


def prepare_states(*arguments: Any) -> None:
    """Initialise a worker, and certify states with a gravity that is wrong by 1e-7."""
    initialize_worker(*arguments)
    certified_state.enclose_quantities = with_wrong_gravity(certified_state.enclose_quantities)


def prepare_accepted(*arguments: Any) -> None:
    """Initialise a worker, and change true accelerations and positions by 1e-7 behind all their checks."""
    initialize_worker(*arguments)
    right_states, right_motion = ground_truth.state_truth, ground_truth.motion_truth
    factor = 1 + GRAVITY_ERROR

    def wrong_states(*rest: Any) -> Any:
        truth = right_states(*rest)
        changed = [replace(answer, acceleration=factor * answer.acceleration) for answer in truth.quantities]
        return replace(truth, quantities=changed)

    def wrong_motion(*rest: Any) -> Any:
        truth = right_motion(*rest)
        return replace(truth, trajectory=replace(truth.trajectory, r=factor * truth.trajectory.r))

    ground_truth.state_truth, ground_truth.motion_truth = wrong_states, wrong_motion  # type: ignore[assignment]


initialize_worker = worker_process.initialize_worker
