"""One right-hand side: single chains of 1 … 10,000 bodies, batches of 1 … 4096, beside the engines."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

from bench import right_hand_sides
from bench.interleaved_timing import time_interleaved

BODIES = (1, 2, 10, 100, 1000, 10_000)


def record_table(benchmark: Any, table: dict[str, Any]) -> None:
    """Put a table beside pytest-benchmark's own figures and print it.

    Args:
        table: entries of ``extra_info``.

    """
    benchmark.extra_info.update(table)
    print(table)


@pytest.mark.parametrize("rods", [False, True], ids=["balls", "rods"])
@pytest.mark.parametrize("bodies", BODIES)
def test_single(benchmark: Any, bodies: int, rods: bool) -> None:
    """Chains of balls or rods, one state."""
    model, state = right_hand_sides.random_pendulum(bodies, rods)
    calls = {"reference": right_hand_sides.structured_call(model, state)}
    per_call = dict.fromkeys(("reference", "direct", "superlu", "dense", "mujoco", "pinocchio"), 1)
    if bodies <= 1000:
        S, b, direct = right_hand_sides.direct_call(model, state)
        calls |= {"direct": direct, "superlu": right_hand_sides.superlu_call(S, b)}
        if bodies <= 100:  # Pinocchio's data takes 7 GB at 200 bodies
            calls |= {
                "dense": right_hand_sides.dense_call(S, b),
                "pinocchio": right_hand_sides.pinocchio_aba_call(model, state),
            }
    if bodies <= 300:
        calls["mujoco"] = right_hand_sides.mujoco_forward_call(model, state)
    if bodies <= 100:
        calls["exudyn step"], per_call["exudyn step"] = right_hand_sides.exudyn_steps_call(model, state)
    timing = benchmark.pedantic(time_interleaved, args=(calls,), rounds=1, iterations=1)
    ours = timing["reference"]
    record_table(
        benchmark,
        {
            "kind": "single",
            "bodies": bodies,
            "joints": "rods" if rods else "balls",
            "microseconds": {name: 1e6 * t.best / per_call[name] for name, t in timing.items()},
            "ratio": {name: ours.ratio_to(t) * per_call[name] for name, t in timing.items() if t is not ours},
        },
    )


@pytest.mark.parametrize("batch", [1, 4, 16, 64, 256, 1024, 4096])
@pytest.mark.parametrize("bodies", [1, 2])
def test_batch(benchmark: Any, bodies: int, batch: int) -> None:
    """Many states of one pendulum in a call, per state."""
    model, state = right_hand_sides.random_pendulum(bodies)
    calls = {
        "reference": right_hand_sides.structured_call(model, state, batch),
        "mujoco": right_hand_sides.mujoco_forward_call(model, state),
        "pinocchio": right_hand_sides.pinocchio_aba_call(model, state),
    }
    timing = benchmark.pedantic(time_interleaved, args=(calls,), rounds=1, iterations=1)
    ours = timing["reference"]
    record_table(
        benchmark,
        {
            "kind": "batch",
            "bodies": bodies,
            "batch": batch,
            "microseconds": {n: 1e6 * t.best / (batch if t is ours else 1) for n, t in timing.items()},
            "ratio": {n: ours.ratio_to(t) / batch for n, t in timing.items() if t is not ours},
        },
    )


@pytest.mark.parametrize("rods", [False, True], ids=["balls", "rods"])
def test_growth(benchmark: Any, rods: bool) -> None:
    """The cost exponent between 100 and 10,000 bodies, from alternating rounds of both."""
    sizes = (100, 1000, 10_000)
    calls = {
        str(n): right_hand_sides.structured_call(*right_hand_sides.random_pendulum(n, rods)) for n in sizes
    }
    timing = benchmark.pedantic(time_interleaved, args=(calls,), rounds=1, iterations=1)
    slope = np.log(timing["10000"].ratio_to(timing["100"])) / np.log(100)
    last = np.log10(timing["10000"].ratio_to(timing["1000"]))
    record_table(
        benchmark,
        {
            "kind": "growth",
            "joints": "rods" if rods else "balls",
            "exponent": float(slope),
            "1000 to 10000": float(last),
        },
    )


@pytest.mark.parametrize("shape", ["chain", "binary tree", "star"])
def test_trees(benchmark: Any, shape: Literal["chain", "binary tree", "star"]) -> None:
    """A hundred hinges beside Pinocchio, and the cost exponent to 10,000 of them."""
    hundred = right_hand_sides.hinge_tree(shape, 100)
    calls = {
        "pinocchio": right_hand_sides.pinocchio_crba_call(*hundred),
        "100": right_hand_sides.tree_call(*hundred),
        "10000": right_hand_sides.tree_call(*right_hand_sides.hinge_tree(shape, 10_000)),
    }
    timing = benchmark.pedantic(time_interleaved, args=(calls,), rounds=1, iterations=1)
    record_table(
        benchmark,
        {
            "kind": "tree",
            "shape": shape,
            "microseconds": {name: 1e6 * t.best for name, t in timing.items()},
            "ratio": timing["100"].ratio_to(timing["pinocchio"]),
            "exponent": float(np.log(timing["10000"].ratio_to(timing["100"])) / np.log(100)),
        },
    )
