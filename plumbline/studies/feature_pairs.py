"""Pairs of features of mechanisms: which are legal, and which a catalogue of scenarios covers.

A pair is legal where the scenario format accepts a mechanism with both. It is covered where a scenario has
both and rows of the state level show either one left out; docs/coverage.md has the definitions.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from plumbline.execution.plan import ProgressCallback, no_progress
from plumbline.model.datatypes import FREE, KINDS, Model, State
from plumbline.model.features import ROLES, Feature, Place, features, without_feature
from plumbline.model.kinematics import complete_state, stack_states
from plumbline.model.random_mechanisms import mechanism_with_places
from plumbline.model.sampling import compared_states
from plumbline.processes.worker_pool import Executor, Task
from plumbline.scenario.line_and_column_errors import ScenarioError
from plumbline.scenario.loader import Scenario, scenario_from_dict
from plumbline.scenario.mechanism_document import mechanism_document
from plumbline.studies.coverage_study import run_all
from plumbline.truth.parameter_effects import evaluate_models
from plumbline.truth.rounding_bound import state_rounding_bound

MIN_RATIO = 100.0  # of an effect over the tolerance, from which on it counts as shown
STATES = 2  # random ones, besides the initial one, at which a feature is left out
EXAMPLE_PLACES = 4  # of each half of an example's places
_EXAMPLE = {"schema_version": 1, "name": "example", "title": "Example", "purpose": "Any.", "level": "state"}

Pair = tuple[Feature, Feature]


def all_pairs(some: Iterable[Feature]) -> set[Pair]:
    """Return all pairs of features."""
    return set(itertools.combinations(sorted(some), 2))


def legal_places() -> list[Place]:
    """Return the kinds and roles of joints that the scenario format accepts."""
    every = [Place(kind, role) for role in ROLES for kind in KINDS]
    return [
        place
        for place in every
        if any(example_scenario([place], is_hub_world) for is_hub_world in (False, True))
    ]


def legal_pairs(size: int = EXAMPLE_PLACES) -> set[Pair]:
    """Return all pairs of features that stand together in a mechanism that the scenario format accepts.

    Args:
        size: the places are taken in groups of so many, and each two groups stand in one example; free bodies
            by themselves, as one alone on the world excludes others.

    """
    places = sorted(legal_places(), key=lambda place: (place.kind != FREE, place.role != "single"))
    free = sum(place.kind == FREE for place in places)
    groups = [places[:1], places[1:free], *(places[i : i + size] for i in range(free, len(places), size))]
    found = set[Pair]()
    for one, other in itertools.combinations_with_replacement(groups, 2):
        for is_hub_world in (False, True):
            if (example := example_scenario([*one, *other], is_hub_world)) is not None:
                found |= all_pairs(features(example.model))
    return found


def example_scenario(places: Sequence[Place], is_hub_world: bool) -> Scenario | None:
    """Make a scenario with joints in these places and all fields; None where the format has none."""
    model, state = mechanism_with_places(0, places, is_hub_world=is_hub_world)
    try:
        return scenario_from_dict(_EXAMPLE | mechanism_document(model, state), "example")
    except ScenarioError:
        return None


def shown_features(model: Model, states: Sequence[State]) -> list[Feature]:
    """Return the features of a mechanism that rows of the state level show, if an adapter leaves them out."""
    left, shown = features(model), list[Feature]()
    for state in states:
        is_shown = _is_shown(model, state, left)
        shown += [one for one, seen in zip(left, is_shown, strict=True) if seen]
        left = [one for one, seen in zip(left, is_shown, strict=True) if not seen]
    return shown


def _is_shown(model: Model, state: State, some: Sequence[Feature]) -> NDArray[np.bool_]:
    """Of each feature whether a quantity at a state differs without it."""
    stacked, seen = stack_states([state]), np.zeros(len(some), bool)
    changed = [model, *(without_feature(model, one) for one in some)]
    with np.errstate(all="ignore"):
        cases = [(one, complete_state(one, stacked)) for one in changed]
        found = evaluate_models(model, [state], cases)
    bound = state_rounding_bound(model, state)
    for name, values in found.items():
        effect, tolerance = np.abs(values[1:, 0] - values[0, 0]), np.asarray(bound.tolerance(name))
        limit = tolerance.reshape((*tolerance.shape, *[1] * (effect.ndim - 1 - tolerance.ndim)))
        seen |= ~np.all(effect <= MIN_RATIO * limit, axis=tuple(range(1, effect.ndim)))
    return seen


def measure_features(
    executor: Executor,
    scenarios: Iterable[Scenario],
    progress: ProgressCallback = no_progress,
) -> dict[str, list[Feature]]:
    """Compute which features scenarios show.

    Args:
        executor: makes the calls, one per scenario.
        scenarios: which.
        progress: called with calls done, calls in all and the scenario of the last one.

    Returns:
        By scenario the features of `shown_features`; each two of them are a covered pair.

    Raises:
        CoverageFailure: a call failed.

    """
    tasks = [
        Task(
            (s.name,),
            shown_features,
            (s.model, compared_states(s.model, s.state, s.seed, STATES)),
            executor.limits,
        )
        for s in sorted(scenarios, key=lambda s: -s.model.n)
    ]
    found = run_all(executor, tasks, "features", progress)
    return {name: shown for (name,), shown in found.items()}


def count_triples(
    mechanisms: Iterable[Sequence[Feature]], earlier: Iterable[Sequence[Feature]]
) -> tuple[int, int]:
    """Count triples of features that stand together in a mechanism.

    Returns:
        The number of triples, and of those among them that stood together in none of before.

    """
    groups = [list(mechanisms), list(earlier)]
    index = {
        one: i for i, one in enumerate(dict.fromkeys(f for group in groups for some in group for f in some))
    }
    together, before = np.zeros((2, *[len(index)] * 3), bool)
    for table, group in zip((together, before), groups, strict=True):
        for some in group:
            table[np.ix_(*[[index[one] for one in some]] * 3)] = True
    every = np.arange(len(index))
    together[every, every] = together[:, every, every] = together[every, :, every] = False  # fewer than three
    return int(np.count_nonzero(together)) // 6, int(np.count_nonzero(together & ~before)) // 6
