"""CPU time to reach an error at t = 2 s, two bodies on balls: one pendulum, and a batch of 64."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from adapters.exudyn_engine import Exudyn
from adapters.mujoco_engine import Mujoco
from adapters.pinocchio_engine import Pinocchio
from bench import work_precision
from bench.test_right_hand_side import record_table
from plumbline.model.datatypes import Model, State
from plumbline.model.kinematics import complete_state
from plumbline.scenario.loader import find_scenario_file, load_scenario

ERRORS = (1e-4, 1e-6, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
ENGINE_INTEGRATORS = (
    (Mujoco, "RK4", 1.0),
    (Mujoco, "Euler", 0.5),
    (Pinocchio, "rkmk4", 3.0),
    (Pinocchio, "semi-implicit-euler", 1.0),
    (Exudyn, "trapezoidal", 1.0),
    (Exudyn, "generalized-alpha", 1.0),
)


def perturbed_pendulums(count: int) -> tuple[Model, list[State]]:
    """Load the catalogue's tumbling two-ball pendulum with several initial states.

    Args:
        count: number of states; all but the first have rates that differ by about a fifth.

    """
    scenario = load_scenario(find_scenario_file("double-tumbling-balls"))
    model, state = scenario.model, scenario.state
    rng = np.random.default_rng(64)
    varied = [state.omega * (1 + 0.2 * rng.normal(size=state.omega.shape)) for _ in range(count - 1)]
    return model, [
        state,
        *(complete_state(model, State(state.p, omega, state.u, state.udot)) for omega in varied),
    ]


@pytest.mark.parametrize("batch", [1, 64])
@pytest.mark.timeout(900)
def test_work_precision(benchmark: Any, batch: int) -> None:
    """The reference's curve beside every integrator of the engines."""
    model, states = perturbed_pendulums(batch)
    expected = work_precision.reference_positions(model, states)

    def everyone() -> dict[str, list[work_precision.WorkPrecisionPoint]]:
        curves = {"reference collocation": work_precision.collocation_curve(model, states, expected)}
        if batch == 1:
            curves["reference DOP853, structured"] = work_precision.dop853_curve(
                model, states, expected, True
            )
            curves["reference DOP853, direct"] = work_precision.dop853_curve(model, states, expected, False)
        for engine, integrator, longest in ENGINE_INTEGRATORS if batch == 1 else ENGINE_INTEGRATORS[:1]:
            name = f"{engine.name} {integrator}"
            curves[name] = work_precision.fixed_step_curve(
                engine(), integrator, model, states, expected, longest if batch == 1 else 20.0
            )
        return curves

    curves = benchmark.pedantic(everyone, rounds=1, iterations=1)
    costs = {
        name: {f"{e:g}": work_precision.cost_at_error(points, e) for e in ERRORS}
        for name, points in curves.items()
    }
    engines = [name for name in curves if not name.startswith("reference")]
    ours = costs["reference collocation"]
    ratio = {}
    for error in ours:
        theirs = [costs[name][error] for name in engines if np.isfinite(costs[name][error])]
        ratio[error] = ours[error] / min(theirs) if theirs else float("nan")
    record_table(
        benchmark,
        {
            "kind": "work-precision",
            "batch": batch,
            "curves": {name: [asdict(point) for point in points] for name, points in curves.items()},
            "seconds": costs,
            "ratio to the best engine": ratio,
        },
    )
