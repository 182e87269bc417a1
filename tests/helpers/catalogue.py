"""The scenarios of the catalogue, read once in a process."""

from functools import cache

from plumbline.scenario.loader import Scenario, catalogue, load_scenario


@cache
def catalogue_scenarios() -> dict[str, Scenario]:
    """Every scenario by its name; not to be changed."""
    return {name: load_scenario(path) for name, path in catalogue().items()}
