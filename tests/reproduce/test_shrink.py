"""The search for the smallest case that shows a disagreement."""

from types import SimpleNamespace

import numpy as np
import pytest

from plumbline.model.sampling import random_states
from plumbline.reproduce.shrink import ReproductionCase, smallest_case
from tests.helpers.catalogue import catalogue_scenario


@pytest.mark.timeout(60)
def test_the_search_ends_where_rounding_undoes_a_change():
    """Of these states two are projected to and fro for ever: u̇ differs by a rounding each time."""
    model = catalogue_scenario("tumbling-rod").model

    def measure(case):
        shows = len(set(np.abs(case.state.udot).round(3).ravel())) == 3
        return SimpleNamespace(ratio=1e12, case=case) if shows else None

    cases = [ReproductionCase(model, state) for state in random_states(model, 40, 1)]
    shown = [case for case in cases if measure(case)]
    assert len(shown) > 30
    for case in shown:
        found = smallest_case(case, measure, 1e12, 3.0)
        assert found is not None and found.case.content != case.content
