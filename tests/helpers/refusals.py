"""Files of users that are refused."""

import pytest

from plumbline.scenario.line_and_column_errors import ScenarioError


def refusal(read, *arguments):
    """The error with the problems for which a call refuses what it reads."""
    with pytest.raises(ScenarioError) as caught:
        read(*arguments)
    return caught.value
