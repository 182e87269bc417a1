"""MuJoCo with a planted fault: it crashes, hangs, exhausts memory … in the cell of one of its integrators.

The parent process passes `prepare` as the initialiser of its workers, so that they load these engines too.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adapters.mujoco_engine import Mujoco
from plumbline.engines import registry
from plumbline.model.datatypes import Array, Integrator, Model, State, Trajectory
from plumbline.processes import worker_process
from tests.helpers import faults

SimulateCall = Callable[[], Trajectory]


def exhaust_memory(run: SimulateCall) -> Trajectory:
    kept = []
    while True:
        kept.append(np.empty(2**25))  # 256 MB of address space, never touched


def return_nan(run: SimulateCall) -> Trajectory:
    done = run()
    r = done.r.copy()
    r[-1] = np.nan
    return replace(done, r=r)


def silent_reset(run: SimulateCall) -> Trajectory:
    done = run()
    rows = [*range(len(done.t) - 3), 0, 1, 2]
    return Trajectory(done.t, *(getattr(done, k)[rows] for k in ("r", "p", "v", "pdot")), done.steps)


def early_stop(run: SimulateCall) -> Trajectory:
    done = run()
    return Trajectory(*(getattr(done, k)[:-3] for k in ("t", "r", "p", "v", "pdot")), done.steps)


def raise_error(run: SimulateCall) -> Trajectory:
    raise RuntimeError("the engine's own words\nover two lines")


def flood_output(run: SimulateCall) -> Trajectory:
    Path("MUJOCO_LOG.TXT").write_text("dropped")
    for _ in range(100):
        os.write(1, b"noise " * 10_000)
        os.write(2, b"noise " * 10_000)
    return run()


# Per fault, the words that the reason of its row must contain; none where the cell is not lost.
ERROR_BY_FAULT: dict[Callable[[SimulateCall], Trajectory], str] = {
    faults.segfault: "crashed: the worker died of SIGSEGV",
    faults.abort: "crashed: the worker died of SIGABRT",
    faults.exit_7: "crashed: the worker exited with code 7",
    faults.hang: "timeout: no answer within",
    faults.hang_in_c: "timeout: no answer within",
    exhaust_memory: "out of memory: over",
    return_nan: "r is not finite from t =",
    silent_reset: "is the initial state again (a silent reset)",
    early_stop: "sampled 14 of 17 times",
    raise_error: "RuntimeError: the engine's own words over two lines",
    flood_output: "",
}
FAULTY_INTEGRATOR = "implicit"  # the integrator whose cell has the fault; the cell of Euler has none


def make_faulty_engine(fault: Callable[[SimulateCall], Trajectory]) -> type[Mujoco]:
    """MuJoCo with two integrators and the fault in one of them."""

    class Faulty(Mujoco):
        name = fault.__name__
        title = f"MuJoCo ({fault.__name__})"
        integrators = tuple(i for i in Mujoco.integrators if i.name in ("Euler", FAULTY_INTEGRATOR))

        def _simulate(
            self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
        ) -> Trajectory:
            def run() -> Trajectory:
                return super(Faulty, self)._simulate(model, state, times, integrator, resolution)

            return fault(run) if integrator.name == FAULTY_INTEGRATOR else run()

    return Faulty


def register_faulty_engines() -> None:
    """Add the faulty engines to the registry of this process."""
    for fault in ERROR_BY_FAULT:
        globals()[f"Faulty_{fault.__name__}"] = make_faulty_engine(fault)
        registry.ENGINES[fault.__name__] = f"tests.helpers.faulty_engines:Faulty_{fault.__name__}"


def prepare_worker(*arguments: Any) -> None:
    """Initialise a worker and register the faulty engines there."""
    worker_process.initialize_worker(*arguments)
    register_faulty_engines()
