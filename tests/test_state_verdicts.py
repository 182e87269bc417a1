"""What decides a row at state level, on answers made for it."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.bench import horizon_of
from plumbline.bound import state_bound
from plumbline.findings import Subject
from plumbline.motion_verdicts import judge_motion
from plumbline.registry import adapter
from plumbline.sampling import random_states
from plumbline.state_verdicts import judge_states
from plumbline.work import Evaluation, climb
from plumbline.yardstick import StateTruth, motion_truth
from tests import pendulums

MODEL = pendulums.model("bb")
STATES = random_states(MODEL, 3, 1)
WHO = Subject("s", "f", "reference", "Reference", "0")


def verdict(scale_of_bound, shift=0.0):
    """The verdict on acceleration of the reference against itself, its bound and answer changed."""
    said = adapter("reference").evaluate(MODEL, STATES)
    bounds = [state_bound(MODEL, s) for s in STATES]
    bounds = [replace(b, acceleration=b.acceleration * scale_of_bound) for b in bounds]
    truth = StateTruth(STATES, said, bounds, "itself")
    off = [
        replace(a, acceleration=a.acceleration + shift * b.acceleration[:, None])
        for a, b in zip(said, bounds, strict=True)
    ]
    rows = judge_states(WHO, truth, Evaluation(off, None, None, 0.0)).rows
    return next(row.verdict for row in rows if row.quantity == "acceleration")


@pytest.mark.parametrize(
    ("scale", "shift", "expected"),
    [(1, 0.5, "agrees"), (1, 2.0, "disagrees"), (1e6, 0.0, "unresolved"), (np.nan, 0.0, "unresolved")],
)
def test_a_bound_decides_only_where_it_is_sharp(scale, shift, expected):
    assert verdict(scale, shift) == expected


@pytest.mark.parametrize("drag", [False, True])
def test_implicitfast_is_an_alias_of_euler_only_without_drag(drag):
    """And where it is called one, it is Euler to the last bit."""
    model, times = pendulums.model("b", drag=drag), np.linspace(0, 0.5, 9)
    state = pendulums.state(model, seed=2, rate=0.5)
    truth, mujoco = motion_truth(model, state, times, None), adapter("mujoco")
    steps = [2.0**-k for k in range(9, 13)]
    runs = {name: climb("mujoco", name, model, state, times, steps) for name in ("Euler", "implicitfast")}
    same = np.array_equal(*(c.rungs[-1].trajectory.r for c in runs.values()))
    fast = mujoco.integrator("implicitfast")
    rows = judge_motion(WHO, model, truth, fast, runs["implicitfast"], horizon_of(truth)).rows
    assert {row.alias_of for row in rows} == ({None} if drag else {"Euler"})
    assert same is not drag
