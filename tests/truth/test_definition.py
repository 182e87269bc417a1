"""The check of certified solutions by definition: right ones are accepted, every planted mistake rejected."""

from dataclasses import replace

import flint
import numpy as np
import pytest

from plumbline.model.equivalent import rotate_body_frames, rotate_world
from plumbline.scenario.generator import random_mechanism, random_scenario
from plumbline.truth.certified_state import certify_state, enclose_quantities
from plumbline.truth.definition import DefinitionViolated, definition_holds
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios, states_of
from tests.helpers.nightly_tests import slow

BITS, MISTAKE = 200, 1e-9  # relative to the size of the quantity's terms
PLANTED_IN = ("double-loaded-rods", "chain-3-rods", "sprung-without-rotors", "free-body-with-rotors",
              "tree-of-seven-sprung", "four-bar", "flyball-governor", "squeezer", "bricard")  # fmt: skip
# what a solution says, besides the mass matrix, which is checked at the state's rates only
CHECKED = (
    "acceleration", "angular_acceleration", "joint_reaction", "joint_moment", "kinetic_energy",
    "potential_energy", "angular_momentum", "r", "v", "attitude", "angular_velocity",
)  # fmt: skip


def solved(scenario, index=1):
    state = states_of(scenario, 4)[index]
    return scenario.model, state, enclose_quantities(scenario.model, state, BITS, mass_matrix=True)


def holds(model, state, balls):
    with flint.ctx.workprec(BITS):
        return definition_holds(flint, model, state, balls)


@pytest.mark.parametrize("name", PLANTED_IN)
def test_a_right_solution_is_accepted(name):
    assert holds(*solved(catalogue_scenario(name)))


def turned(name, seed):
    """A loop whose geometry is rounded, since it is turned in the world and in the axes of its bodies."""
    scenario, rng = catalogue_scenario(name), np.random.default_rng(seed)
    model, state = scenario.model, states_of(scenario, 1)[1]
    for turn in (rotate_world, rotate_body_frames):
        q = rng.normal(size=4)
        model, state = turn(model, state, q / np.linalg.norm(q))
    return model, state, enclose_quantities(model, state, BITS)


REDUNDANT = ("bricard", "squeezer", "four-bar", "slider-crank", "four-bars-2")


@pytest.mark.parametrize("name", REDUNDANT)
@pytest.mark.parametrize("seed", range(4))
def test_redundant_loops_of_rounded_geometry_are_accepted(name, seed):
    model, state, balls = turned(name, seed)
    assert 0 < balls["scale"]["gap"] < 1e-15
    assert holds(model, state, balls)
    assert np.all(np.isfinite(certify_state(model, state).quantities.acceleration))


@pytest.mark.parametrize("name", REDUNDANT)
def test_a_mistake_in_a_solution_of_rounded_geometry_is_rejected(name):
    """Also one of 1e-11, ten times what may be left open; joints of the tree leave nothing open."""
    model, state, balls = turned(name, 1)
    assert not accepted_mistakes(model, state, balls)[0]
    rows = {"r", "v", "kinetic_energy", "potential_energy", "angular_momentum"}
    assert not {quantity for quantity, *_ in accepted_mistakes(model, state, balls, 1e-11)[0]} & rows
    assert "r" not in {quantity for quantity, *_ in accepted_mistakes(model, state, balls, 1e-14)[0]}


@pytest.mark.parametrize("name", ["squeezer", "bricard"])
@pytest.mark.parametrize("field", ["x", "xdot"])
def test_a_solution_of_another_pose_of_a_loop_is_rejected(name, field):
    """Coordinates of loops are proved where they close, which is near those of the state."""
    model, state, balls = solved(catalogue_scenario(name))
    values, scale = getattr(state, field), balls["scale"]
    size = max(1.0, scale["r"], scale["v"], scale["angular_velocity"])
    for k in range(model.n):
        one = np.zeros_like(values)
        one[k, 0] = size
        assert holds(model, replace(state, **{field: values + 1e-10 * one}), balls)
        with pytest.raises(DefinitionViolated, match=r"coordinate|rate"):
            holds(model, replace(state, **{field: values + 1e-6 * one}), balls)


@slow
def test_every_right_solution_of_the_catalogue_is_accepted():
    for scenario in catalogue_scenarios().values():
        for state in states_of(scenario, 5):
            certify_state(scenario.model, state, mass_matrix=True)


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(10, 30))])
def test_right_solutions_of_random_mechanisms_are_accepted(seed):
    for make in (random_mechanism, random_scenario):
        for index in range(6):
            scenario = make(seed, index)
            for state in states_of(scenario, 2):
                certify_state(scenario.model, state, mass_matrix=True)


def entries(balls, name):
    """The places of a quantity's balls, as (row, column); column None where it is a list of balls."""
    rows = balls.get(name) or []
    return [
        (i, j) for i, row in enumerate(rows) for j in (range(len(row)) if isinstance(row, list) else [None])
    ]


def with_mistake(balls, name, i, j, size=MISTAKE):
    """The solution with one ball moved."""
    changed = [list(row) if isinstance(row, list) else row for row in balls[name]]
    move = size * (balls["scale"][name] or 1.0)
    if j is None:
        changed[i] += move
    else:
        changed[i][j] += move
    return balls | {name: changed}


def accepted_mistakes(model, state, balls, size=MISTAKE):
    """The numbers of a solution that may be off, and how many were tried."""
    accepted, tried = [], 0
    for quantity in CHECKED:
        for i, j in entries(balls, quantity):
            tried += 1
            try:
                holds(model, state, with_mistake(balls, quantity, i, j, size))
            except DefinitionViolated:
                continue
            accepted.append((quantity, i, j))
    return accepted, tried


@pytest.mark.parametrize("name", PLANTED_IN)
def test_a_mistake_in_any_number_of_a_solution_is_rejected(name):
    model, state, balls = solved(catalogue_scenario(name))
    accepted, tried = accepted_mistakes(model, state, balls)
    assert not accepted
    assert tried > 20 * model.n


def test_a_mass_matrix_of_another_mechanism_is_rejected():
    model, state, balls = solved(catalogue_scenario("tree-of-seven-sprung"))
    for k in range(model.n):
        heavier = replace(model, mass=model.mass * (1 + MISTAKE * (np.arange(model.n) == k)))
        other = enclose_quantities(heavier, state, BITS, mass_matrix=True)
        with pytest.raises(DefinitionViolated, match="mass matrix"):
            holds(model, state, balls | {"mass_matrix": other["mass_matrix"]})


PARAMETERS = (
    "mass", "inertia", "point", "turn", "length", "gravity", "force", "moment", "drag_force", "drag_moment",
    "armature", "damping", "stiffness", "rest", "effort", "spring_point", "spring_stiffness",
    "spring_damping", "spring_length",
)  # fmt: skip
COORDINATES = ("p", "omega", "u", "udot", "x", "xdot", "r", "v")


def is_another(balls, other):
    """Whether two solutions differ for certain; none is another too."""
    if other is None:
        return True
    return any(
        not x.overlaps(y)
        for name in CHECKED
        for (i, j) in entries(balls, name)
        for x, y in [(b[name][i] if j is None else b[name][i][j] for b in (balls, other))]
    )


OF_LOOPS = ("mass", "moment", "spring_stiffness", "spring_length")


@pytest.mark.parametrize(
    ("name", "is_of_state", "fields", "least"),
    [
        ("double-loaded-rods", False, PARAMETERS, 10),
        ("sprung-without-rotors", False, PARAMETERS, 10),
        ("tree-of-seven-sprung", False, PARAMETERS, 10),
        ("squeezer", False, OF_LOOPS, 1),
        ("double-loaded-rods", True, COORDINATES, 2),
        ("tree-of-seven-sprung", True, COORDINATES, 2),
        ("free-body-with-rotors", True, COORDINATES, 2),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_solution_of_another_mechanism_or_state_is_rejected(name, is_of_state, fields, least):
    """Each number of a body, joint, rotor, damper, spring, motor or load, or of the state, off by 1e-9.

    Where that changes the solution, the old one is rejected.
    """
    model, state, balls = solved(catalogue_scenario(name))
    accepted, rejected = [], 0
    for field in fields:
        value = np.asarray(getattr(state if is_of_state else model, field), float)
        for at in np.argwhere(value):
            other = value.copy()
            other[tuple(at)] *= 1 + MISTAKE
            changed = {field: other}
            pair = (model, replace(state, **changed)) if is_of_state else (replace(model, **changed), state)
            try:
                holds(*pair, balls)
            except DefinitionViolated:
                rejected += 1
                continue
            if is_another(balls, enclose_quantities(*pair, BITS)):
                accepted.append((field, *at))
    assert not accepted
    assert rejected > least * model.n
