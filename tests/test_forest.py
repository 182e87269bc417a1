"""The structured form against the direct form it stands in for, on and off the manifold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapters.reference_engine import chain
from plumbline.bound import state_bound
from plumbline.kinematics import rate
from reference_impl.chain import Chain
from reference_impl.errors import SingularSystem
from reference_impl.euler_parameters import L
from reference_impl.forest import Forest, lay
from reference_impl.system import Solution, System
from tests.random_chains import random_chain

MIXES = {
    "balls": lambda rng, n: [False] * n,
    "rods": lambda rng, n: [True] * n,
    "mixed": lambda rng, n: list(rng.random(n) < 0.5),
}
KINDS = pytest.mark.parametrize("mix", MIXES)


def parts(solution: Solution, forest: Forest) -> list[Solution]:
    """The forest's answer chain by chain."""
    out = []
    for index, one in enumerate(forest.chains):
        rows = (solution.joint >= forest.start[index]) & (solution.joint < forest.start[index + 1])
        body = slice(forest.start[index], forest.start[index + 1])
        out.append(
            Solution(
                acceleration=solution.acceleration[body],
                pddot=solution.pddot[body],
                multiplier=solution.multiplier[rows],
                norm_multiplier=solution.norm_multiplier[body],
                joint=solution.joint[rows] - forest.start[index],
                tension=solution.tension[body],
                joint_reaction=solution.joint_reaction[body],
            )
        )
        assert len(out[-1].pddot) == one.n
    return out


@KINDS
def test_equals_the_direct_form_within_the_derived_bound(mix: str) -> None:
    rng = np.random.default_rng(20)
    for _ in range(12):
        drawn = [
            random_chain(rng, MIXES[mix](rng, n), decades=1.0, loads=True, drag=True)
            for n in rng.integers(1, 11, size=4)
        ]
        forest = Forest([chain(model) for model, _ in drawn])
        held = [np.concatenate([getattr(state, name) for _, state in drawn]) for name in ("r", "p", "v")]
        pdot = np.concatenate([rate(state.p, state.omega) for _, state in drawn])
        together = parts(forest.solve(*held, pdot), forest)
        for (model, state), ours in zip(drawn, together, strict=True):
            direct = System(chain(model)).solve(state.r, state.p, state.v, rate(state.p, state.omega))
            bound = state_bound(model, state)
            turned = [2 * (L(state.p) @ x.pddot[..., None])[..., 0] for x in (ours, direct)]
            for ours_, direct_, allowed in (
                (ours.acceleration, direct.acceleration, bound.acceleration),
                (turned[0], turned[1], bound.angular_acceleration),
                (ours.joint_reaction, direct.joint_reaction, bound.joint_reaction),
            ):
                assert np.all(np.linalg.norm(ours_ - direct_, axis=-1) <= allowed)


@KINDS
@pytest.mark.parametrize("off", [0.0, 0.05, 1.0])
def test_all_unknowns_equal_the_direct_forms_on_and_off_the_manifold(mix: str, off: float) -> None:
    """r, p and the rates anywhere: the printed rows' own behaviour (E2, E3) is part of what is equal.

    Off the manifold there is no derived bound.  Masses within a factor 10 and rods of 0.2 m and more keep
    the equilibrated S at condition 1e4 … 1e5 for these chains, so 1e-11 of the largest entry is rounding;
    a term of E2 or E3 left out shows at ``off``, nine orders above.
    """
    rng = np.random.default_rng(21)
    for _ in range(12):
        drawn = [random_chain(rng, MIXES[mix](rng, n), 0.5, loads=True, drag=True) for n in (1, 2, 2, 5, 8)]
        forest = Forest([chain(model) for model, _ in drawn])
        r, p, v = (np.concatenate([getattr(s, name) for _, s in drawn]) for name in ("r", "p", "v"))
        pdot = np.concatenate([rate(s.p, s.omega) for _, s in drawn])
        r, p, v, pdot = (x + off * rng.normal(size=x.shape) for x in (r, p, v, pdot))
        for index, ours in enumerate(parts(forest.solve(r, p, v, pdot), forest)):
            body = slice(forest.start[index], forest.start[index + 1])
            direct = System(forest.chains[index]).solve(r[body], p[body], v[body], pdot[body])
            for name in (
                "acceleration",
                "pddot",
                "multiplier",
                "norm_multiplier",
                "joint_reaction",
                "tension",
            ):
                a, b = getattr(ours, name), getattr(direct, name)
                assert np.array_equal(np.isnan(a), np.isnan(b))
                scale = np.max(np.abs(b), initial=1.0, where=~np.isnan(b))
                assert np.nanmax(np.abs(a - b), initial=0.0) <= 1e-11 * scale, name


def test_a_batch_is_more_chains() -> None:
    """A chain's answer does not depend on its neighbours in the forest, to the last bit of a sum."""
    rng = np.random.default_rng(22)
    model, state = random_chain(rng, [True, False, True])
    other, elsewhere = random_chain(rng, [False, False])
    alone = Forest([chain(model)])
    q, v = lay(state.r, state.p), lay(state.v, rate(state.p, state.omega))
    q2, v2 = lay(elsewhere.r, elsewhere.p), lay(elsewhere.v, rate(elsewhere.p, elsewhere.omega))
    answer = alone.acceleration(q, v)
    both = Forest([chain(other), chain(model)]).acceleration(np.hstack([q2, q]), np.hstack([v2, v]))
    tiled = alone.tile(3).acceleration(np.tile(q, 3), np.tile(v, 3))
    scale = np.max(np.abs(answer))
    assert np.max(np.abs(both[:, 2:] - answer)) <= 1e-13 * scale
    assert np.max(np.abs(tiled - np.tile(answer, 3))) <= 1e-13 * scale


@KINDS
def test_singular_configurations_are_reported(mix: str) -> None:
    rng = np.random.default_rng(23)
    model, state = random_chain(rng, MIXES[mix](rng, 4))
    forest, pdot = Forest([chain(model)]), rate(state.p, state.omega)
    zero = state.p.copy()
    zero[2] = 0
    with pytest.raises(SingularSystem, match=r"p of body 3"):
        forest.solve(state.r, zero, state.v, pdot)
    nan = state.r.copy()
    nan[1] = np.nan
    with pytest.raises(SingularSystem, match=r"body 2"):
        forest.solve(nan, state.p, state.v, pdot)
    for change, words in (
        ({"mass": model.mass * [1, 0, 1, 1]}, "mass of body 2"),
        ({"inertia": model.inertia * np.array([1, 1, 1, 0])[:, None, None]}, "inertia of body 4"),
    ):
        with pytest.raises(SingularSystem, match=words):
            Forest([chain(replace(model, **change))])


def test_a_rod_of_length_zero_is_singular() -> None:
    """Read literally, C = dᵀd on a ball joint has no gradient (E1)."""
    rng = np.random.default_rng(24)
    model, state = random_chain(rng, [False, False, True])
    literal: Chain = chain(replace(model, length=np.array([0.0, 0.0, 0.4])))
    gap = state.u[2] * model.length[2]
    r = state.r.copy()
    r[2] -= gap
    with pytest.raises(SingularSystem, match="rod above body 3 has length 0"):
        Forest([literal]).solve(r, state.p, state.v, rate(state.p, state.omega))
