"""CPU time to reach an error at t = 2 s, two bodies on balls: one pendulum, and a batch of 64."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from adapters.exudyn_engine import Exudyn
from adapters.mujoco_engine import Mujoco
from adapters.pinocchio_engine import Pinocchio
from bench import precision
from bench.test_right_hand_side import store
from plumbline.model.datatypes import Model, State
from plumbline.model.kinematics import lift
from plumbline.scenario.loader import find, load

ERRORS = (1e-4, 1e-6, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
OWN = (
    (Mujoco, "RK4", 1.0),
    (Mujoco, "Euler", 0.5),
    (Pinocchio, "rkmk4", 3.0),
    (Pinocchio, "semi-implicit-euler", 1.0),
    (Exudyn, "trapezoidal", 1.0),
    (Exudyn, "generalized-alpha", 1.0),
)


def pendulums(count: int) -> tuple[Model, list[State]]:
    """The catalogue's tumbling two-ball pendulum; in a batch its rates vary by a fifth, body by body."""
    scenario = load(find("double-tumbling-balls"))
    model, state = scenario.model, scenario.state
    rng = np.random.default_rng(64)
    varied = [state.omega * (1 + 0.2 * rng.normal(size=state.omega.shape)) for _ in range(count - 1)]
    return model, [state, *(lift(model, state.p, omega, state.u, state.udot) for omega in varied)]


@pytest.mark.parametrize("batch", [1, 64])
@pytest.mark.timeout(900)
def test_work_precision(benchmark: Any, batch: int) -> None:
    """The reference's curve beside every integrator of the engines."""
    model, states = pendulums(batch)
    expected = precision.truth(model, states)

    def everyone() -> dict[str, list[precision.Point]]:
        curves = {"reference collocation": precision.collocation(model, states, expected)}
        if batch == 1:
            curves["reference DOP853, structured"] = precision.dop853(model, states, expected, True)
            curves["reference DOP853, direct"] = precision.dop853(model, states, expected, False)
        for engine, integrator, longest in OWN if batch == 1 else OWN[:1]:
            name = f"{engine.name} {integrator}"
            curves[name] = precision.fixed_step(
                engine(), integrator, model, states, expected, longest if batch == 1 else 20.0
            )
        return curves

    curves = benchmark.pedantic(everyone, rounds=1, iterations=1)
    costs = {name: {f"{e:g}": precision.cost(points, e) for e in ERRORS} for name, points in curves.items()}
    engines = [name for name in curves if not name.startswith("reference")]
    ours = costs["reference collocation"]
    ratio = {}
    for error in ours:
        theirs = [costs[name][error] for name in engines if np.isfinite(costs[name][error])]
        ratio[error] = ours[error] / min(theirs) if theirs else float("nan")
    store(
        benchmark,
        {
            "kind": "work-precision",
            "batch": batch,
            "curves": {name: [asdict(point) for point in points] for name, points in curves.items()},
            "seconds": costs,
            "ratio to the best engine": ratio,
        },
    )
