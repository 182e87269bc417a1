"""The notes' rod of ever smaller length against the ball joint, its limit (E1)."""

import numpy as np
import pytest

from plumbline.model.kinematics import quaternion_rate
from reference_impl.direct import DirectSystem
from reference_impl.fast.collocation import integrate_collocation
from tests.helpers.random_chains import in_other_units, random_chain
from tests.helpers.short_rods import replace_balls_by_rods, slow_manifold_directions, study_rod_limit

LENGTHS = [0.4, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6]


@pytest.mark.parametrize("bodies", [1, 2, 3])
def test_short_rods_converge_to_the_ball_joint_at_first_order(bodies):
    model, state = random_chain(np.random.default_rng(40 + bodies), [False] * bodies, loads=True)
    start = state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    family = study_rod_limit(model, *start, LENGTHS, np.linspace(0, 0.05, 6), 1e-10)
    assert np.all(np.abs(family.observed_order[:2, 1:] - 1) < 0.01), family.observed_order
    assert np.all(np.abs(family.observed_order[2, 2:] - 1) < 0.1), family.observed_order
    assert family.position[-1] < 1e-4


def test_off_the_slow_manifold_the_rod_swings_fast():
    """A rod that does not point where the ball joint pulls leaves the ball's accelerations altogether."""
    model, state = random_chain(np.random.default_rng(44), [False])
    pdot = quaternion_rate(state.p, state.omega)
    rods, r, v = replace_balls_by_rods(model, state.r, state.p, state.v, pdot, 1e-4)
    slow = integrate_collocation([rods], r, state.p, v, pdot, np.linspace(0, 0.02, 21), 1e-8)
    u = (r - state.r)[0] / 1e-4
    aside = np.cross(u, [1.0, 0, 0]) / np.linalg.norm(np.cross(u, [1.0, 0, 0]))
    fast = integrate_collocation(
        [rods], state.r + 1e-4 * aside, state.p, v, pdot, np.linspace(0, 0.02, 21), 1e-8
    )
    jerk = [np.max(np.abs(np.diff(x.v, 2, axis=0))) for x in (slow, fast)]
    assert jerk[1] > 30 * jerk[0]


def test_a_family_is_what_its_fields_say():
    """Largest differences from the ball, of r̈ and F by the direct form and of the motion; their orders."""
    model, state = random_chain(np.random.default_rng(45), [False, False], loads=True)
    ball, pdot, times = model, quaternion_rate(state.p, state.omega), np.linspace(0, 0.05, 6)
    start = state.r, state.p, state.v, pdot
    lengths = [0.1, 0.02]
    family = study_rod_limit(ball, *start, lengths, times, 1e-10)
    limit, motion = DirectSystem(ball).solve(*start), integrate_collocation([ball], *start, times, 1e-10)
    for k, length in enumerate(lengths):
        rods, r, v = replace_balls_by_rods(ball, *start, length)
        x = DirectSystem(rods).solve(r, state.p, v, pdot)
        far = integrate_collocation([rods], r, state.p, v, pdot, times, 1e-10)
        for found, a, b in (
            (family.acceleration, x.acceleration, limit.acceleration),
            (family.reaction, x.joint_reaction, limit.joint_reaction),
            (family.position, far.r, motion.r),
        ):
            assert found[k] == pytest.approx(np.max(np.linalg.norm(a - b, axis=-1)), rel=1e-7)
        assert family.runs[k].r.shape == (6, 2, 3)
    assert family.length.tolist() == lengths
    errors = np.stack([family.acceleration, family.reaction, family.position])
    assert family.observed_order[:, 0] == pytest.approx(np.log(errors[:, 0] / errors[:, 1]) / np.log(5))


def test_a_rod_starts_along_the_balls_force_and_turns_with_it():
    """u = −F/‖F‖ and its rate along the ball's motion, by differences; a joint without force has none."""
    model, state = random_chain(np.random.default_rng(46), [False, False])
    ball, pdot, h = model, quaternion_rate(state.p, state.omega), 1e-3
    u, udot = slow_manifold_directions(ball, state.r, state.p, state.v, pdot)
    motion = integrate_collocation([ball], state.r, state.p, state.v, pdot, h * np.arange(5), 1e-13)
    force = [
        DirectSystem(ball).solve(*s).joint_reaction
        for s in zip(motion.r, motion.p, motion.v, motion.pdot, strict=True)
    ]
    along = [-F / np.linalg.norm(F, axis=1, keepdims=True) for F in force]
    assert u == pytest.approx(along[0], abs=1e-12)
    slope = sum(c * x for c, x in zip((-25, 48, -36, 16, -3), along, strict=True)) / (12 * h)
    assert udot == pytest.approx(slope, abs=1e-6 * np.max(np.abs(udot)))
    assert np.sum(u * udot, axis=1) == pytest.approx(np.zeros(2), abs=1e-14)
    rods, r, v = replace_balls_by_rods(ball, state.r, state.p, state.v, pdot, 0.25)
    assert rods.length.tolist() == [0.25, 0.25]
    assert r - state.r == pytest.approx(0.25 * np.cumsum(u, axis=0), abs=1e-15)
    assert v - state.v == pytest.approx(0.25 * np.cumsum(udot, axis=0), abs=1e-14)
    weightless = ball.changed(force=-ball.mass[:, None] * ball.gravity)
    with pytest.raises(ValueError, match="joint 1 carries no force"):
        slow_manifold_directions(weightless, state.r, state.p, 0 * state.v, 0 * pdot)


def test_a_small_pendulum_has_the_same_directions():
    """In units of a millimetre, moving slowly: the instant that u̇ is fitted in is of its own swing."""
    model, state = random_chain(np.random.default_rng(47), [False, False], rate=0.01)
    found = [
        slow_manifold_directions(one, at.r, at.p, at.v, quaternion_rate(at.p, at.omega))
        for one, at in ((model, state), in_other_units(model, state, 2.0**-10, 1.0, 1.0))
    ]
    for here, there in zip(*found, strict=True):
        assert there == pytest.approx(here, rel=1e-9, abs=1e-12)


def test_the_joint_without_force_is_named():
    """A body that hangs still, and below it one that its load holds."""
    model, state = random_chain(np.random.default_rng(48), [False, False])
    one = model
    still = one.changed(
        proximal=np.array([[0, 0, 0.5], [0.1, 0.2, 0.3]]),
        distal=np.array([[0, 0, -0.5], [0, 0, 0]]),
        force=np.array([[0.0, 0, 0], -one.mass[1] * one.gravity]),
    )
    p = np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]])
    r = np.array([[0, 0, -0.5], [-0.1, -0.2, -1.3]])
    with pytest.raises(ValueError, match="joint 2 carries no force"):
        slow_manifold_directions(still, r, p, 0 * state.v, 0 * p)
