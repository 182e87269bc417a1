"""Random states on the constraint manifold of a scenario, and the seeds they come from."""

from __future__ import annotations

import hashlib
from functools import lru_cache

import numpy as np

from plumbline.model.datatypes import Model, State
from plumbline.model.kinematics import complete_state, cross, rate_count
from plumbline.model.loops import (
    closed_pose,
    closed_rates,
    cut_open,
    displaced,
    is_singular,
    regular_rank,
    singular_values,
    smallest_singular_value,
    with_rates,
)

RANDOM_STATES = 50  # per scenario of a run, besides the initial one
MIN_SAMPLED_SINGULAR_VALUE = 1e-2  # of a loop's rows: nearer to a singular pose bounds are loose
STEPS_BETWEEN, STEP_SIZE = 2, 0.5  # random steps between two states of a loop [rad, m]
MAX_DRAWS = 10  # draws per state that is wanted
MAX_FIRST_DRAWS = 100  # draws of the first state: a mechanism without regular poses is given up
CLOSED = 1e-12  # gap of a loop that Newton's method has closed [m, rad]


def derive_seed(*parts: str) -> int:
    """Derive a seed from words; the same on every machine and in every process.

    Args:
        *parts: the words, for example a purpose and a scenario's digest.

    Returns:
        A whole number below 2⁶⁴.

    """
    return int.from_bytes(hashlib.sha256("\0".join(parts).encode()).digest()[:8], "big")


def compared_states(model: Model, state: State, seed: str, count: int) -> list[State]:
    """Draw the states at which a scenario is compared.

    Args:
        seed: words that the draw depends on.

    Returns:
        The initial state unless its pose is singular (`is_singular`), then the random ones.

    """
    number = derive_seed("states", seed)
    if model.has_loops:
        initial = [] if is_singular(smallest_singular_value(model, state)) else [state]
        return [*initial, *random_loop_states(model, state, count, number)]
    return [state, *random_states(model, count, number)]


def random_states(model: Model, count: int, seed: int) -> list[State]:
    """Draw states of the model: attitudes and rod directions uniform, rates slow to fast.

    Angles are uniform over ±3 rad, shifts and free positions Gaussian over 1 m.
    Rates are Gaussian with a standard deviation drawn per state, log-uniform from a tenth to four times the
    pendulum's own rate √(g/ℓ), so that gravity dominates in some states and the velocity terms in others.

    Args:
        model: the chain of N bodies; only its geometry and gravity count.
        seed: the same seed gives the same states.

    Returns:
        The states, on the constraint manifold; ``u`` and ``udot`` are zero where the joint is a ball joint.

    """
    rng, own_rate = np.random.default_rng(seed), _own_rate(model)
    wanted, has_coordinates = count, not all(kind.holds_no_turn for kind in model.kinds)
    if has_coordinates:  # drawn after all attitudes: else they would depend on how many states are wanted
        count = max(count, RANDOM_STATES)
    p, omega, u, udot = (np.zeros((count, model.n, size)) for size in (4, 3, 3, 3))
    for k in range(count):
        p[k] = rng.normal(size=(model.n, 4))
        spread = own_rate * 10 ** rng.uniform(-1.0, np.log10(4.0))
        omega[k] = spread * rng.normal(size=(model.n, 3))
        u[k] = rng.normal(size=(model.n, 3))
        udot[k] = spread * rng.normal(size=(model.n, 3))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    u, udot = (np.where(model.rods[:, None], x, 0.0) for x in (u, cross(udot, u)))
    free = model.free[:, None]
    x, xdot, r, v = (np.zeros((count, model.n, size)) for size in (model.columns, model.columns, 3, 3))
    used = np.arange(model.columns) < np.array([[len(kind.motions)] for kind in model.kinds])
    for k in range(wanted if has_coordinates else 0):
        for i, kind in enumerate(model.kinds):
            for j, (motion, _) in enumerate(kind.motions):
                x[k, i, j] = rng.uniform(-3, 3) if motion == "turn" else rng.normal()
        spread = own_rate * 10 ** rng.uniform(-1.0, np.log10(4.0))
        xdot[k] = np.where(used, spread * rng.normal(size=used.shape), 0.0)
        r[k], v[k] = (np.where(free, size * rng.normal(size=r[k].shape), 0.0) for size in (1.0, spread))
    states = complete_state(model, State(p, omega, u, udot, r, v, x, xdot)[:wanted])
    return [states[k] for k in range(wanted)]


@lru_cache(maxsize=16)  # seconds for a dozen bodies, and every engine is compared at the same states
def random_loop_states(model: Model, state: State, count: int, seed: int) -> tuple[State, ...]:
    """Draw states of a mechanism with loops, along its own motions from an assembled one.

    Steps of random directions that the loops allow are followed by Newton's method.  Rates are Gaussian as in
    `random_states`, projected on those that the loops allow.  Poses nearer to a singular one than
    `MIN_SAMPLED_SINGULAR_VALUE` are drawn again, from the initial one.

    Args:
        state: assembled.
        seed: the same seed gives the same states.

    Returns:
        The states; fewer where the mechanism leaves its singular poses nowhere.

    """
    rng, own_rate = np.random.default_rng(seed), _own_rate(model)
    cut = cut_open(model)
    found, here, rank = list[State](), cut.state(state), regular_rank(model, state)
    for draw in range(MAX_DRAWS * count):
        if len(found) == count or (draw == MAX_FIRST_DRAWS and not found):
            break
        for _ in range(STEPS_BETWEEN):
            step = closed_rates(cut, here, STEP_SIZE * rng.normal(size=rate_count(cut.model)))
            moved = closed_pose(cut, displaced(cut.model, here, step))
            if np.max(np.abs(cut.gap(moved))) < CLOSED:
                here = moved
        values, rows = singular_values(cut, here)
        rank = max(rank, len(rows))  # rows that hold at one pose hold at all
        if values[rank - 1] < MIN_SAMPLED_SINGULAR_VALUE:
            here = cut.state(state)  # a branch may be singular all along
            continue
        spread = own_rate * 10 ** rng.uniform(-1.0, np.log10(4.0))
        rates = closed_rates(cut, here, spread * rng.normal(size=rate_count(cut.model)))
        found.append(cut.source_state(with_rates(cut.model, here, rates)))
    return tuple(found)


def _own_rate(model: Model) -> float:
    """√(g/ℓ) of the pendulums [rad/s]."""
    lengths = np.linalg.norm(model.proximal, axis=1) + model.length
    g = max(float(np.linalg.norm(model.gravity)), 1e-3)
    return float(np.sqrt(g / max(float(np.mean(lengths)), 1e-3)))
