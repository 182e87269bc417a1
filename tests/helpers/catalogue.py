"""The scenarios of the catalogue, each read once in a process; not to be changed."""

from functools import cache

from plumbline.model.datatypes import State
from plumbline.model.sampling import compared_states
from plumbline.scenario.loader import Scenario, catalogue, find_scenario_file, load_scenario


@cache
def catalogue_scenario(name: str) -> Scenario:
    """A scenario by its name."""
    return load_scenario(find_scenario_file(name))


def catalogue_scenarios() -> dict[str, Scenario]:
    """Every scenario by its name."""
    return {name: catalogue_scenario(name) for name in catalogue()}


def states_of(scenario: Scenario, random_count: int) -> list[State]:
    """The states at which a run compares a scenario: its own and random ones."""
    return compared_states(scenario.model, scenario.state, scenario.seed, random_count)
