"""Runs that say nothing of their progress."""

from plumbline.execution.plan import Plan
from plumbline.execution.runner import run_plan
from tests.helpers.catalogue import catalogue_scenario


def run_scenarios(scenarios, *planned, progress=lambda *_: None, **options):
    """The result of a run of scenarios or names of the catalogue; the rest is of the plan."""
    chosen = [catalogue_scenario(one) if isinstance(one, str) else one for one in scenarios]
    return run_plan(Plan(chosen, *planned, **options), progress)
