"""Random states do not depend on how many are drawn."""

import numpy as np
import pytest

from plumbline.model.sampling import RANDOM_STATES
from plumbline.scenario.generator import random_mechanism, random_scenario
from tests.helpers.catalogue import catalogue_scenario, states_of

CASES = (
    random_scenario(1, 0),
    random_mechanism(1, 0),
    random_mechanism(1, 1),
    catalogue_scenario("four-bar"),
)


@pytest.mark.parametrize("scenario", CASES, ids=lambda scenario: scenario.name)
def test_a_run_of_its_file_has_the_states_of_a_night_among_others(scenario):
    """A night compares nine states of a random scenario, a run of its file fifty."""
    few, many = (states_of(scenario, n) for n in (4, 12 if scenario.model.has_loops else RANDOM_STATES))
    assert len(few) == 5 < len(many)
    for one, other in zip(few, many, strict=False):
        for name, values in vars(one).items():
            np.testing.assert_array_equal(values, getattr(other, name), err_msg=name)


@pytest.mark.parametrize("scenario", CASES, ids=lambda scenario: scenario.name)
def test_joints_have_no_coordinates_or_rates_beyond_their_own(scenario):
    """Rounding bounds take every number of a state for a coordinate or a rate."""
    for state in states_of(scenario, 3):
        for k, kind in enumerate(scenario.model.kinds[: scenario.model.n]):
            beyond = slice(len(kind.motions), None)
            assert not np.any(state.x[k, beyond])
            assert not np.any(state.xdot[k, beyond])
