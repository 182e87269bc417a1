"""`python -m bench.proved_horizons SCENARIO [DURATION [STEP]]`: when engines provably leave the true motion.

Needs `plumbline prove SCENARIO --duration DURATION` before.  An engine has left where a
position is more than 1e-3 m, and the proved radius, from the midpoint of the enclosure.  Steps are STEP
(default 1/1024 s), tolerances 1e-12.  Prints a table of docs/enclosures.md.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.model.datatypes import EngineFailure, Unsupported
from plumbline.model.invariants import first_departure, position_error
from plumbline.scenario.loader import Scenario, find_scenario_file, load_scenario
from plumbline.truth.certificate_proof import ProvedMotion, find_proof

TOLERANCE = 1e-12


def departure(
    scenario: Scenario, proof: ProvedMotion, engine: str, integrator: str, resolution: float
) -> str:
    """Run an engine up to the end of a proof.

    Args:
        engine: a key of `ENGINES`.
        resolution: step [s] or tolerance.

    Returns:
        The first sample time [s] at which the engine's motion is provably off, or why there is none.

    """
    times = proof.trajectory.t
    try:
        run = load_adapter(engine).simulate(scenario.model, scenario.state, times, integrator, resolution)
    except (Unsupported, EngineFailure) as error:
        return str(error)
    left = first_departure(times, position_error(run.r, proof.trajectory.r), proof.radius["position"])
    return f"not within {times[-1]:g}" if left is None else f"{left:.2f}"


def main(name: str, duration: float = 30.0, step: float = 2.0**-10) -> None:
    """Print the table of a scenario.

    Args:
        duration: of the proof [s].
        step: of the engines [s].

    """
    scenario = load_scenario(find_scenario_file(name))
    count = round(duration / scenario.sample_interval)
    times = scenario.sample_interval * np.arange(count + 1.0)
    proof = find_proof(scenario.model, scenario.state, times)
    if proof is None:
        sys.exit(f"not proved yet: plumbline prove {name} --duration {duration:g}")
    print("| engine | integrator | step or tolerance | leaves the true motion at, s |\n|---|---|---|---|")
    for engine in ENGINES:
        try:
            integrators = load_adapter(engine).integrators
        except ImportError:
            continue
        for method in integrators:
            resolution = step if method.kind == "step" else TOLERANCE
            began = time.process_time()
            found = departure(scenario, proof, engine, method.name, resolution)
            print(f"| {engine} | {method.name} | {resolution:.3g} | {found} |", flush=True)
            print(f"{time.process_time() - began:.1f} CPU s", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1], *map(float, sys.argv[2:]))
