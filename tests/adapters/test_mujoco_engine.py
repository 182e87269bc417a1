"""What MuJoCo alone must show: orders and limits at 2 s, long chains, its alias, its way of blowing up."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from plumbline.model import kinematics
from plumbline.model.datatypes import EngineFailure
from tests.helpers import engine_process as worker
from tests.helpers import newton_euler, pendulums
from tests.helpers.refinement import extrapolated, observed_orders

pytest.importorskip("mujoco")

TIMES = np.linspace(0, 2, 5)


def simulate(subject, at, integrator, step, times=TIMES):
    return worker.call_adapter("mujoco", "simulate", subject, at, times, integrator, step)


def swinging_pendulum(joints, loaded=False):
    """A generic pendulum let go about a radian from rest's position with slow rates."""
    subject = pendulums.make_model(joints, loads=loaded, drag=loaded)
    upright = subject.proximal / np.linalg.norm(subject.proximal, axis=1, keepdims=True)
    p = np.column_stack([1 + upright[:, 2], upright[:, 1], -upright[:, 0], 0 * upright[:, 0]])
    p /= np.linalg.norm(p, axis=1, keepdims=True)  # turns s_prox upwards
    rng = np.random.default_rng(len(joints))
    turn = np.hstack([np.ones((subject.n, 1)), 0.4 * rng.normal(size=(subject.n, 3))])
    p = kinematics.quaternion_product(turn / np.linalg.norm(turn, axis=1, keepdims=True), p)
    u = np.where(subject.rods[:, None], [0, 0, -1.0] + 0.4 * rng.normal(size=(subject.n, 3)), 0.0)
    u /= np.where(subject.rods, np.linalg.norm(u, axis=1), 1)[:, None]
    udot = np.cross(rng.normal(size=(subject.n, 3)), u)
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    return subject, kinematics.state_from_minimal(subject, p, rng.normal(size=(subject.n, 3)), u, udot)


def orders_and_limit_error(joints, integrator, coarsest, levels, powers, loaded=False):
    """Orders seen (levels − 2,), error of the extrapolated limit in r (m) at the sample times."""
    subject, at = swinging_pendulum(joints, loaded)
    runs = np.array([simulate(subject, at, integrator, coarsest / 2**level).r for level in range(levels)])
    error = np.max(np.abs(extrapolated(runs, powers) - true_positions(joints, loaded)))
    return observed_orders(runs), error


@cache
def true_positions(joints, loaded):
    """r at TIMES (T, N, 3) of the swinging pendulum."""
    return np.array([s.r for s in newton_euler.integrate(*swinging_pendulum(joints, loaded), TIMES)])


@pytest.mark.parametrize(
    ("joints", "coarsest", "bound"),
    [
        ("b", 2**-7, 1e-11),
        pytest.param("bb", 2**-8, 1e-11, marks=pytest.mark.full),
        ("r", 2**-8, 1e-11),
        pytest.param("rr", 2**-9, 1e-9, marks=pytest.mark.full),
    ],
)
def test_rk4_is_order_4_and_its_limit_is_the_truth(joints, coarsest, bound):
    orders, error = orders_and_limit_error(joints, "RK4", coarsest, 5, (4, 5, 6, 7))
    assert np.all(np.abs(orders[:2] - 4) < 0.1), orders
    assert error < bound


def test_rk4_with_loads_and_drag():
    orders, error = orders_and_limit_error("br", "RK4", 2**-8, 5, (4, 5, 6, 7), loaded=True)
    assert np.all(np.abs(orders[:2] - 4) < 0.1), orders
    assert error < 1e-11


@pytest.mark.parametrize("integrator", ["Euler", "implicit"])
def test_euler_is_order_1(integrator):
    orders, error = orders_and_limit_error("b", integrator, 2**-9, 7, (1, 2, 3, 4, 5, 6))
    assert np.all(np.abs(orders[-3:] - 1) < 0.1), orders
    assert error < 1e-11


def test_implicitfast_is_euler_without_damping():
    subject, at = swinging_pendulum("rb")
    fast, euler, implicit = (
        simulate(subject, at, name, 2**-9).r for name in ("implicitfast", "Euler", "implicit")
    )
    assert np.array_equal(fast, euler)
    assert np.max(np.abs(implicit - euler)) > 1e-4


def test_long_chains():
    """50 balls and 10 rods: the state level against Newton and Euler, and energy along RK4."""
    for joints in ("b" * 50, "r" * 10):
        subject, at = swinging_pendulum(joints)
        (got,) = worker.call_adapter("mujoco", "evaluate", subject, [at])
        true = newton_euler.solve(subject, at)
        for one, other in (
            (got.acceleration, true.acceleration),
            (got.joint_reaction, true.joint_reaction),
        ):
            assert np.max(np.abs(one - other)) < 1e-11 * np.max(np.abs(other))
        run = simulate(subject, at, "RK4", 2**-11, np.array([0, 0.25]))
        energy = [
            newton_euler.kinetic_energy(
                subject, replace(at, v=run.v[k], omega=kinematics.angular_velocity(run.p[k], run.pdot[k]))
            )
            + newton_euler.potential_energy(subject, replace(at, r=run.r[k]))
            for k in (0, 1)
        ]
        assert abs(energy[1] - energy[0]) < 1e-8 * abs(energy[0])


def test_flat_bodies_and_points_on_the_joint():
    """A lamina (J_x + J_y = J_z to the last bit), a pivot at the centre of mass, a mass of a microgram."""
    subject, at = swinging_pendulum("rb")
    J = np.array([np.diag([0.01, 0.02, 0.03]), np.diag([1e-11, 2e-11, 2e-11])])
    subject = subject.changed(
        inertia=J, mass=np.array([1.0, 1e-9]), proximal=np.array([[0, 0, 0.0], [0.1, 0, 0]])
    )
    at = kinematics.state_from_minimal(subject, at.p, at.omega, at.u, at.udot)
    (got,) = worker.call_adapter("mujoco", "evaluate", subject, [at])
    true = newton_euler.solve(subject, at)
    np.testing.assert_allclose(got.acceleration, true.acceleration, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(got.joint_reaction[1], true.joint_reaction[1], rtol=1e-8, atol=1e-18)


def test_a_step_too_coarse_is_a_failure_with_a_sentence(tmp_path):
    """No autoreset, no finite-looking row, and no log file in the working directory."""
    subject, at = pendulums.make_model("rr"), pendulums.state_from_seed(pendulums.make_model("rr"), rate=10.0)
    before = worker.run_in_engine_process("mujoco", Path.cwd)
    with pytest.raises(EngineFailure, match=r"MuJoCo warned by t = .* huge value"):
        simulate(subject, at, "Euler", 0.5, np.arange(41) * 0.5)
    assert not (before / "MUJOCO_LOG.TXT").exists()
