"""One right-hand side: single chains of 1 … 10,000 bodies, batches of 1 … 4096, beside the engines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench import contenders
from bench.alternate import alternate

BODIES = (1, 2, 10, 100, 1000, 10_000)


def store(benchmark: Any, table: dict[str, Any]) -> None:
    """Put a table beside pytest-benchmark's own figures, and say it."""
    benchmark.extra_info.update(table)
    print(table)


@pytest.mark.parametrize("rods", [False, True], ids=["balls", "rods"])
@pytest.mark.parametrize("bodies", BODIES)
def test_single(benchmark: Any, bodies: int, rods: bool) -> None:
    """Chains of balls or rods, one state."""
    model, state = contenders.pendulum(bodies, rods)
    calls = {"reference": contenders.structured(model, state)}
    per_call = dict.fromkeys(("reference", "direct", "superlu", "dense", "mujoco", "pinocchio"), 1)
    if bodies <= 1000:
        S, b, direct = contenders.notes(model, state)
        calls |= {"direct": direct, "superlu": contenders.superlu(S, b)}
        if bodies <= 100:  # Pinocchio's data takes 7 GB at 200 bodies
            calls |= {"dense": contenders.dense(S, b), "pinocchio": contenders.pinocchio_aba(model, state)}
    if bodies <= 300:
        calls["mujoco"] = contenders.mujoco_forward(model, state)
    if bodies <= 100:
        calls["exudyn step"], per_call["exudyn step"] = contenders.exudyn_step(model, state)
    timing = benchmark.pedantic(alternate, args=(calls,), rounds=1, iterations=1)
    ours = timing["reference"]
    store(
        benchmark,
        {
            "kind": "single",
            "bodies": bodies,
            "joints": "rods" if rods else "balls",
            "microseconds": {name: 1e6 * t.best / per_call[name] for name, t in timing.items()},
            "ratio": {name: ours.over(t) * per_call[name] for name, t in timing.items() if t is not ours},
        },
    )


@pytest.mark.parametrize("batch", [1, 4, 16, 64, 256, 1024, 4096])
@pytest.mark.parametrize("bodies", [1, 2])
def test_batch(benchmark: Any, bodies: int, batch: int) -> None:
    """Many states of one pendulum in a call, per state."""
    model, state = contenders.pendulum(bodies)
    calls = {
        "reference": contenders.structured(model, state, batch),
        "mujoco": contenders.mujoco_forward(model, state),
        "pinocchio": contenders.pinocchio_aba(model, state),
    }
    timing = benchmark.pedantic(alternate, args=(calls,), rounds=1, iterations=1)
    ours = timing["reference"]
    store(
        benchmark,
        {
            "kind": "batch",
            "bodies": bodies,
            "batch": batch,
            "microseconds": {n: 1e6 * t.best / (batch if t is ours else 1) for n, t in timing.items()},
            "ratio": {n: ours.over(t) / batch for n, t in timing.items() if t is not ours},
        },
    )


@pytest.mark.parametrize("rods", [False, True], ids=["balls", "rods"])
def test_growth(benchmark: Any, rods: bool) -> None:
    """The cost exponent between 100 and 10,000 bodies, from alternating rounds of both."""
    sizes = (100, 1000, 10_000)
    calls = {str(n): contenders.structured(*contenders.pendulum(n, rods)) for n in sizes}
    timing = benchmark.pedantic(alternate, args=(calls,), rounds=1, iterations=1)
    slope = np.log(timing["10000"].over(timing["100"])) / np.log(100)
    last = np.log10(timing["10000"].over(timing["1000"]))
    store(
        benchmark,
        {
            "kind": "growth",
            "joints": "rods" if rods else "balls",
            "exponent": float(slope),
            "1000 to 10000": float(last),
        },
    )
