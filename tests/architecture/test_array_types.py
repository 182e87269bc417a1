"""Shapes of arrays are checked in every test, and cost nothing where no test runs."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

from plumbline.model.invariants import position_error
from plumbline.model.kinematics import quaternion_product
from tests.helpers.random_chains import tree_from_seed


@pytest.fixture(scope="module")
def model():
    return tree_from_seed(0, 3, ("ball",))


def test_an_argument_of_the_wrong_shape_is_found():
    with pytest.raises(BeartypeCallHintViolation, match="quaternion_product"):
        quaternion_product(np.ones(3), np.ones(4))


def test_integers_are_no_numbers_of_physics():
    with pytest.raises(BeartypeCallHintViolation, match="quaternion_product"):
        quaternion_product(np.ones(4, int), np.ones(4))


def test_a_word_is_one_size_in_all_arguments():
    assert position_error(np.zeros((5, 2, 3)), np.ones((5, 2, 3))).shape == (5,)
    with pytest.raises(BeartypeCallHintViolation, match="position_error"):
        position_error(np.zeros((5, 2, 3)), np.ones((5, 1, 3)))


def test_a_word_is_one_size_in_all_fields(model):
    with pytest.raises(BeartypeCallHintViolation, match="bodies is 3 which does not equal"):
        replace(model, mass=np.ones(4))


def test_a_field_of_the_wrong_shape_is_found(model):
    with pytest.raises(BeartypeCallHintViolation, match="gravity"):
        replace(model, gravity=np.zeros(4))


def test_nothing_is_loaded_where_no_test_runs():
    code = "import sys, plumbline.model.kinematics; sys.exit('jaxtyping' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
