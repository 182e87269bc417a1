"""The notes' rod of ever smaller length against the ball joint, its limit (E1)."""

from __future__ import annotations

import numpy as np
import pytest

from adapters.reference_engine import chain
from plumbline.kinematics import rate
from reference_impl.collocation import integrate
from reference_impl.short_rods import converge, hang
from tests.random_chains import random_chain

LENGTHS = [0.4, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6]


@pytest.mark.parametrize("bodies", [1, 2, 3])
def test_short_rods_converge_to_the_ball_joint_at_first_order(bodies: int) -> None:
    model, state = random_chain(np.random.default_rng(40 + bodies), [False] * bodies, loads=True)
    start = state.r, state.p, state.v, rate(state.p, state.omega)
    family = converge(chain(model), *start, LENGTHS, np.linspace(0, 0.05, 6), 1e-10)
    assert np.all(np.abs(family.rate[:2, 1:] - 1) < 0.01), family.rate
    assert np.all(np.abs(family.rate[2, 2:] - 1) < 0.1), family.rate
    assert family.position[-1] < 1e-4


def test_off_the_slow_manifold_the_rod_swings_fast() -> None:
    """A rod that does not point where the ball joint pulls leaves the ball's accelerations altogether."""
    model, state = random_chain(np.random.default_rng(44), [False])
    pdot = rate(state.p, state.omega)
    rods, r, v = hang(chain(model), state.r, state.p, state.v, pdot, 1e-4)
    slow = integrate([rods], r, state.p, v, pdot, np.linspace(0, 0.02, 21), 1e-8)
    u = (r - state.r)[0] / 1e-4
    aside = np.cross(u, [1.0, 0, 0]) / np.linalg.norm(np.cross(u, [1.0, 0, 0]))
    fast = integrate([rods], state.r + 1e-4 * aside, state.p, v, pdot, np.linspace(0, 0.02, 21), 1e-8)
    jerk = [np.max(np.abs(np.diff(x.v, 2, axis=0))) for x in (slow, fast)]
    assert jerk[1] > 30 * jerk[0]
