"""`python -m bench.classics [PROBLEM[/ENGINE]…]`: published problems on every engine, docs/benchmarks.md.

Runs the named problems, or all, and keeps the figures of the others in bench/results/classics.json; with an
engine only its motions are measured again, with PROBLEM/values only what needs no motion.  With --page it
writes the page of the stored figures.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.classic_motions import four_bar_angle, light_cart_pole, squeezer_motion
from bench.classics_page import write_page
from bench.classics_values import (
    VALUES,
    find_problem_scenario,
    free_body_rates,
    true_rod_end,
    true_slider_height,
)
from plumbline.engines.engine_calls import RefinementRun, describe_engine, evaluate_states, run_refinement
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.measurements.order_and_limit import romberg, tightest_tolerance_limit
from plumbline.model.datatypes import Array, Model, Trajectory
from plumbline.model.kinematics import angular_velocity, rotation_matrix
from plumbline.model.sampling import random_loop_states
from plumbline.processes.processor import processor_name
from plumbline.scenario.loader import Scenario
from plumbline.storage.results_store import write_atomically
from plumbline.truth.closed_form import exact_samples
from plumbline.truth.ground_truth import state_truth

ROOT = Path(__file__).resolve().parents[1]
STORED = ROOT / "bench" / "results" / "classics.json"
PAGE = ROOT / "docs" / "benchmarks.md"
RANDOM_STATES = 3
NO_ENGINE = "values"  # in the place of an engine: values and states, no motion
Runs = Sequence[tuple[str, str, Sequence[float]]]  # engine, integrator, steps [s] or tolerances


@dataclass(frozen=True)
class Problem:
    """A published problem: what is measured, its true value, and which runs measure it."""

    scenario: str
    duration: float  # s
    sample: float  # s
    quantity: Callable[[Model, Trajectory], Array]  # (T, K), what the benchmark measures
    exact: Callable[[Scenario, Array], Array]  # (T, K) at the times (T,)
    threshold: float  # error that the benchmark asks for, in the quantity's unit
    runs: Runs
    is_rms: bool = False  # whether the error is the root of the mean square, else the maximum


def _steps(unit: float, coarse: int, fine: int) -> list[float]:
    return [unit * 2.0**-k for k in range(coarse, fine + 1)]


def _pendulum_position(_: Model, run: Trajectory) -> Array:
    return run.r[:, 0, [0, 2]]


def _closed_form_position(scenario: Scenario, times: Array) -> Array:
    samples = exact_samples(scenario, times)
    assert samples is not None
    return samples[0][:, 0, [0, 2]]


def _cart_pole(_: Model, run: Trajectory) -> Array:
    pole = run.r[:, 1] - run.r[:, 0]
    return np.stack([run.r[:, 0, 0], np.arctan2(pole[:, 0], -pole[:, 2])], 1)


def _body_rates(_: Model, run: Trajectory) -> Array:
    return angular_velocity(run.p, run.pdot)[:, 0]


def _slider_height(_: Model, run: Trajectory) -> Array:
    return run.r[:, 3, 2:]


def _first_bar_end(_: Model, run: Trajectory) -> Array:
    return 2 * run.r[:, 0, [0, 2]]


def _true_bar_end(windows: int) -> Callable[[Scenario, Array], Array]:
    def exact(_: Scenario, times: Array) -> Array:
        angle = four_bar_angle(windows, 0.05, times)
        return np.stack([np.cos(angle), np.sin(angle)], 1)

    return exact


def _third_rod_end(model: Model, run: Trajectory) -> Array:
    near = np.matvec(rotation_matrix(run.p[:, 2]), model.proximal[2])
    return run.r[:, 2] - near  # the far end: the rod's centre is in its middle


def _crank_direction(model: Model, run: Trajectory) -> Array:
    return run.r[-1:, 0, :2] / np.linalg.norm(model.proximal[0])


def _true_crank_direction(_: Scenario, times: Array) -> Array:
    beta = squeezer_motion(f"{times[-1]:g}").angles["beta"]
    return np.array([[np.cos(beta), np.sin(beta)]])


PROBLEMS = {
    "A01": Problem(
        "a01-simple-pendulum", 2000.0, 0.5, _pendulum_position, _closed_form_position, 1e-3,
        [
            ("reference", "collocation", [1e-13, 1e-14]),
            ("mujoco", "RK4", _steps(1, 6, 9)),
            ("exudyn-tree", "RK44", _steps(1, 6, 9)),
            ("exudyn", "trapezoidal", _steps(1, 5, 9)),
            ("pinocchio", "dop853", [1e-11, 1e-13]),
            ("pinocchio", "rkmk4", _steps(1, 4, 4)),
            ("pinocchio", "semi-implicit-euler", _steps(1, 5, 5)),
            ("exudyn", "generalized-alpha", _steps(1, 7, 7)),
            ("mujoco", "Euler", _steps(1, 8, 8)),
            ("mujoco", "implicit", _steps(1, 8, 8)),
        ],
    ),
    "A02": Problem(
        "four-bars-2", 0.5, 0.03125, _first_bar_end, _true_bar_end(2), 1e-3,
        [("reference", "collocation", [1e-10, 1e-12]), ("mujoco", "RK4", _steps(1, 6, 9)),
         ("exudyn", "trapezoidal", _steps(1, 6, 10)), ("pinocchio", "dop853", [1e-10, 1e-12])],
    ),
    "A03": Problem(
        "squeezer", 0.03, 0.03, _crank_direction, _true_crank_direction, 1e-3,
        [("reference", "collocation", [1e-10, 1e-12]), ("mujoco", "RK4", _steps(0.03, 8, 11)),
         ("exudyn", "trapezoidal", _steps(0.03, 8, 11)), ("pinocchio", "dop853", [1e-10, 1e-12])],
    ),
    "A04": Problem(
        "bricard", 1.0, 0.0625, _third_rod_end, true_rod_end, 1e-3,
        [("reference", "collocation", [1e-10, 1e-12]), ("mujoco", "RK4", _steps(1, 7, 10)),
         ("exudyn", "trapezoidal", _steps(1, 7, 10)), ("pinocchio", "dop853", [1e-10, 1e-12])],
    ),
    "A05": Problem(
        "a05-stiff-governor", 10.0, 0.0625, _slider_height, true_slider_height, 1e-3,
        [
            ("mujoco", "RK4", _steps(1, 13, 15)),
            ("mujoco", "implicitfast", _steps(1, 9, 12)),
            ("exudyn-tree", "RK44", _steps(1, 13, 15)),
            ("exudyn", "trapezoidal", _steps(1, 7, 11)),
        ],
    ),
    "cart-pole": Problem(
        "light-cart-pole-rod", 10.0, 0.01, _cart_pole, lambda _, t: np.stack(light_cart_pole(t), 1), 1e-6,
        [
            ("reference", "collocation", [1e-12, 1e-13]),
            ("pinocchio", "dop853", [1e-10, 1e-12]),
            ("mujoco", "RK4", _steps(0.01, 5, 8)),
            ("exudyn-tree", "RK44", _steps(0.01, 5, 7)),
            ("exudyn", "trapezoidal", _steps(0.01, 5, 7)),
        ],
        is_rms=True,
    ),
    "NESC-2": Problem(
        "nesc-tumbling-brick", 30.0, 0.125, _body_rates, free_body_rates, 1e-6,
        [
            ("reference", "collocation", [1e-8, 1e-12, 1e-14]),
            ("mujoco", "RK4", _steps(1, 3, 8)),
            ("exudyn-tree", "RK44", _steps(1, 3, 8)),
            ("exudyn", "trapezoidal", _steps(1, 4, 9)),
            ("pinocchio", "dop853", [1e-8, 1e-10, 1e-12]),
            ("pinocchio", "rkmk4", _steps(1, 3, 6)),
        ],
    ),
}  # fmt: skip
STATE_PROBLEMS = {"A02": "four-bars-2", "A03": "squeezer", "A04": "bricard"}


def measure_motion(problem: Problem) -> list[dict[str, Any]]:
    """Run a problem on its engines.

    Args:
        problem: with its runs.

    Returns:
        One record per engine and integrator: its runs, each with error and CPU time [s], the error and the
        uncertainty of their limit; or the reason why there are none.

    """
    scenario = find_problem_scenario(problem.scenario)
    times = np.arange(round(problem.duration / problem.sample) + 1) * problem.sample
    exact = problem.exact(scenario, times)
    return [_measure_integrator(problem, scenario, times, exact, *run) for run in problem.runs]


def _measure_integrator(
    problem: Problem, scenario: Scenario, times: Array, exact: Array, engine: str, name: str,
    resolutions: Sequence[float],
) -> dict[str, Any]:  # fmt: skip
    study = run_refinement(engine, name, scenario.model, scenario.state, times, resolutions)
    record: dict[str, Any] = {"engine": engine, "integrator": name}
    if study.refusal:
        return record | {"unsupported": study.refusal.message}
    integrator = load_adapter(engine).integrator(name)

    def error(y: Array) -> float:
        size = np.linalg.norm(y - exact, axis=-1)
        return float(np.sqrt(np.mean(size**2)) if problem.is_rms else np.max(size))

    def measured(run: RefinementRun) -> Array | None:
        return None if run.trajectory is None else problem.quantity(scenario.model, run.trajectory)

    values = [measured(run) for run in study.runs]
    record["runs"] = [
        {"resolution": run.resolution, "cpu": run.cpu_time, "failure": run.failure and run.failure.message}
        | ({} if y is None else {"error": error(y)})
        for run, y in zip(study.runs, values, strict=True)
    ]
    found = [y[:, None] for y in values if y is not None]
    if len(found) > 1:
        limit = (
            romberg(found, integrator.error_exponents)
            if integrator.kind == "step"
            else tightest_tolerance_limit(found)
        )
        record |= {
            "limit_error": error(limit.y[:, 0]),
            "limit_uncertainty": float(limit.uncertainty[-1]),
            "final": limit.y[-1, 0].tolist(),
        }
    return record


def measure_states(name: str) -> list[dict[str, Any]]:
    """Compare accelerations of a mechanism with loops, at its initial state and at random ones.

    Returns:
        One record per engine: the largest error of r̈ and of ω̇′ over the largest true value at that state, or
        the reason why there is none.

    """
    scenario = find_problem_scenario(name)
    model, state = scenario.model, scenario.state
    states = [state, *random_loop_states(model, state, RANDOM_STATES, 1)]
    truth = state_truth(model, states).quantities
    return [_measure_engine_states(engine, model, states, truth) for engine in ENGINES]


def _measure_engine_states(engine: str, model: Model, states: Any, truth: Any) -> dict[str, Any]:
    answer = evaluate_states(engine, model, states)
    if answer.no_answer:
        return {"engine": engine, "unsupported": answer.no_answer.message}

    def worst(name: str) -> float:
        pairs = [
            (getattr(got, name), getattr(true, name))
            for got, true in zip(answer.quantities, truth, strict=True)
        ]
        scale = [max(9.81, float(np.max(np.linalg.norm(true, axis=-1)))) for _, true in pairs]
        return max(
            float(np.max(np.linalg.norm(a - b, axis=-1))) / s for (a, b), s in zip(pairs, scale, strict=True)
        )

    return {
        "engine": engine,
        "acceleration": worst("acceleration"),
        "angular_acceleration": worst("angular_acceleration"),
        "cpu": answer.cpu_time,
    }


def measure(name: str, engine: str, stored: dict[str, Any]) -> dict[str, Any]:
    """Measure a problem.

    Args:
        engine: the only one whose motions are measured, or `NO_ENGINE`; empty for everything.

    Returns:
        Its figures: values, motions and states.

    """
    versions = {one: describe_engine(one).version for one in ENGINES}
    found = stored | {"processor": processor_name(), "versions": versions}
    if name in VALUES and engine in ("", NO_ENGINE):
        found["values"] = [asdict(value) for value in VALUES[name]()]
    if name in STATE_PROBLEMS and engine in ("", NO_ENGINE):
        found["states"] = measure_states(STATE_PROBLEMS[name])
    if name in PROBLEMS:
        problem = PROBLEMS[name]
        chosen = [run for run in problem.runs if engine in ("", run[0])]
        measured = measure_motion(replace(problem, runs=chosen))
        known = {(m["engine"], m["integrator"]): m for m in [*stored.get("motions", []), *measured]}
        found["motions"] = [known[run[:2]] for run in problem.runs if run[:2] in known]
    return found


def main() -> None:
    """Measure the named problems, store their figures and write the page."""
    known = list(dict.fromkeys([*PROBLEMS, *STATE_PROBLEMS]))
    names = [name for name in sys.argv[1:] if name != "--page"]
    if unknown := {name.partition("/")[0] for name in names} - set(known):
        sys.exit(f"no problem {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.is_file() else {}
    for name in [] if "--page" in sys.argv else names or known:
        problem, _, engine = name.partition("/")
        stored[problem] = measure(problem, engine, stored.get(problem, {}) if engine else {})
        write_atomically(STORED, (json.dumps(stored, indent=1) + "\n").encode())
        print(f"{name}: measured")
    write_atomically(PAGE, write_page(stored).encode())
    print(f"page: {PAGE}")


if __name__ == "__main__":
    main()
