"""Mistakes that real engines make inside runs only: in some steps, in some conditions, or on some run.

Each is a relative mistake of 1e-9 in a number of the engine's model, in its state or in what it reports; in
every other step the engine is as it is.  Steps count from 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
import pinocchio as pin

from adapters import mujoco_engine, pinocchio_engine
from plumbline.model.datatypes import Array, Integrator, Model, State, Trajectory
from tests.helpers.planting import Defect, Patch

SIZE = 1e-9
When = Callable[[int, Array, Array], bool]  # number of the step, q and v before it
Change = Callable[[Any, Any], AbstractContextManager[None]]  # of MuJoCo's model and data during a step


@dataclass(frozen=True)
class RunMistake:
    """A mistake, the step at which it shows first, and the words of its condition."""

    defect: Defect
    first_step: int | None = None  # None: where the motion meets the condition
    quantities: tuple[str, ...] = ()  # of which one must report it; none: any of every step
    # of the condition that the diagnosis names: its quantity and bound; of numbers of steps the first one
    condition: tuple[str, float] = ("step", 0.0)

    @property
    def name(self) -> str:
        return self.defect.name


@contextmanager
def _scaled_masses(m: Any, d: Any) -> Iterator[None]:
    """Mass and inertia of the last body: all masses together change no motion under gravity alone."""
    kept = m.body_mass.copy(), m.body_inertia.copy()
    m.body_mass[-1] *= 1 + SIZE
    m.body_inertia[-1] *= 1 + SIZE
    yield
    m.body_mass[:], m.body_inertia[:] = kept


@contextmanager
def _scaled_gravity(m: Any, d: Any) -> Iterator[None]:
    kept = m.opt.gravity.copy()
    m.opt.gravity *= 1 + SIZE
    yield
    m.opt.gravity = kept


@contextmanager
def _scaled_step(m: Any, d: Any) -> Iterator[None]:
    kept = m.opt.timestep
    m.opt.timestep *= 1 + SIZE
    yield
    m.opt.timestep = kept


@contextmanager
def _scaled_rates(m: Any, d: Any) -> Iterator[None]:
    """The velocity after the step."""
    yield
    d.qvel *= 1 + SIZE


def mujoco_mistake(when: When, change: Change, run: int = 0) -> Patch:
    """A change during some steps of MuJoCo; only on the given run of the adapter, from 1, or on every one."""

    @contextmanager
    def patched() -> Iterator[None]:
        real, started = mujoco.mj_step, list[int]()

        def step(m: Any, d: Any, nstep: int = 1) -> None:
            for _ in range(nstep):
                number = round(d.time / m.opt.timestep) + 1
                if number == 1:
                    started.append(1)
                is_meant = not run or len(started) == run
                with change(m, d) if is_meant and when(number, d.qpos, d.qvel) else nullcontext():
                    real(m, d)

        with patch.object(mujoco_engine.mujoco, "mj_step", step):
            yield

    return patched


def pinocchio_mistake(when: When, integrator: str, masses: bool = False) -> Patch:
    """Accelerations, or the mass of the last body, during some steps of Pinocchio."""

    @contextmanager
    def patched() -> Iterator[None]:
        real, counts = pinocchio_engine.FIXED_STEPS[integrator], dict[int, int]()

        def step(chain: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
            number = counts[id(chain)] = counts.get(id(chain), 0) + 1
            if not when(number, q, v):
                return real(chain, q, v, h)
            if masses:
                inertias, last = chain.pin_model.inertias, len(chain.pin_model.inertias) - 1
                kept = pin.Inertia(inertias[last])
                inertias[last] = pin.Inertia(kept.mass * (1 + SIZE), kept.lever, kept.inertia * (1 + SIZE))
                found = real(chain, q, v, h)
                inertias[last] = kept
                return found
            right = chain.acceleration
            with patch.object(chain, "acceleration", lambda q, v: right(q, v) * (1 + SIZE)):
                return real(chain, q, v, h)

        with patch.dict(pinocchio_engine.FIXED_STEPS, {integrator: step}):
            yield

    return patched


def wrong_samples(name: str, rows: Callable[[int], slice]) -> Callable[..., Trajectory]:
    """A field of some samples of a run."""

    def run(simulate: Any, model: Model, state: State, times: Array, i: Integrator, h: float) -> Trajectory:
        found = simulate(model, state, times, i, h)
        values = getattr(found, name).copy()
        values[rows(len(times))] *= 1 + SIZE
        return Trajectory(**vars(found) | {name: values})

    return run


def from_step(n: int) -> When:
    return lambda number, q, v: number >= n


def steps(first: int, last: int) -> When:
    return lambda number, q, v: first <= number <= last


def every(n: int) -> When:
    return lambda number, q, v: number % n == 0


def beyond_angle(at: int, angle: float) -> When:
    return lambda number, q, v: bool(abs(q[at]) > angle)


def beyond_turn(at: int, angle: float) -> When:
    """A quaternion, scalar at ``at``, further from the identity than an angle."""
    return lambda number, q, v: bool(2 * np.arccos(min(1.0, abs(q[at]))) > angle)


def faster_than(rate: float) -> When:
    return lambda number, q, v: bool(np.max(np.abs(v)) > rate)


def slower_than(rate: float) -> When:
    return lambda number, q, v: bool(number > 10 and np.max(np.abs(v)) < rate)


def _mistake(
    name: str, mechanism: str, integrator: str, patch_: Patch | None, where: int | tuple[str, float] = 0,
    engine: str = "mujoco", run: Any = None, quantities: tuple[str, ...] = (),
) -> RunMistake:  # fmt: skip
    first, condition = (where, ("step", float(where))) if isinstance(where, int) else (None, where)
    defect = Defect(name, engine=engine, mechanism=mechanism, integrator=integrator, patch=patch_, run=run)
    return RunMistake(defect, first or None, quantities, condition)


_RODS, _BALLS, _SKEW, _TREE, _LOOP = (
    "double-tumbling-rods", "double-tumbling-balls", "double-hinge-skew", "loaded-tree", "four-bar",
)  # fmt: skip
_EULER, _RATE, _ANGLE = "semi-implicit-euler", "largest rate of a coordinate", "angle of joint 2"
_OF_MUJOCO = (
    ("masses", _scaled_masses, (
        ("from step 500 on", _BALLS, "RK4", from_step(500), 500),
        ("in four steps", _RODS, "RK4", steps(300, 303), 300),
        ("every hundredth step", _SKEW, "Euler", every(100), 100),
        ("beyond half a turn", _SKEW, "RK4", beyond_angle(1, np.pi), (_ANGLE, np.pi)),
        ("at high rates", _SKEW, "implicit", faster_than(5.0), (_RATE, 5.0)),
        ("at low rates", _SKEW, "RK4", slower_than(1.5), 119),
        ("in the last step", _BALLS, "Euler", from_step(600), 600),
        ("in the first step", _RODS, "RK4", steps(1, 1), 1),
        ("beyond two radians", _BALLS, "RK4", beyond_turn(0, 2.0), ("turn of joint 1", 2.0)),
    )),
    ("gravity", _scaled_gravity, (
        ("from step 500 on", _RODS, "Euler", from_step(500), 500),
        ("in four steps", _BALLS, "implicit", steps(520, 523), 520),
        ("every hundredth step", _SKEW, "RK4", every(100), 100),
        ("beyond a quarter turn", _SKEW, "Euler", beyond_angle(1, np.pi / 2), (_ANGLE, np.pi / 2)),
    )),
    ("time step", _scaled_step, (
        ("from step 500 on", _BALLS, "Euler", from_step(500), 500),
        ("in one step", _RODS, "RK4", steps(77, 77), 77),
        ("every fiftieth step", _TREE, "RK4", every(50), 50),
    )),
    ("velocities", _scaled_rates, (
        ("after step 250", _BALLS, "RK4", steps(250, 250), 250),
        ("every hundredth step", _RODS, "implicit", every(100), 100),
        ("at high rates", _BALLS, "Euler", faster_than(6.0), (_RATE, 6.0)),
    )),
)  # fmt: skip
_OF_PINOCCHIO = (
    ("accelerations in one step", _BALLS, "rkmk4", steps(411, 411), 411),
    ("accelerations from step 500 on", _BALLS, _EULER, from_step(500), 500),
    ("accelerations in four steps", _RODS, "rkmk4", steps(300, 303), 300),
    ("accelerations every hundredth step", _SKEW, "rkmk4", every(100), 100),
    ("masses of Pinocchio from step 500 on", _SKEW, "rkmk4", from_step(500), 500),
    ("accelerations in a loop from step 500 on", _LOOP, "rkmk4", from_step(500), 500),
    ("accelerations in a loop in four steps", _LOOP, _EULER, steps(410, 413), 410),
)
_OF_SAMPLES = (
    ("positions of samples from 500 on", _BALLS, "RK4", 500, "mujoco", "r", lambda n: slice(500, n)),
    ("velocities of samples every hundredth", _SKEW, "RK44", 100, "exudyn-tree", "v",
     lambda n: slice(100, n, 100)),
    ("rates of samples from 500 on", _BALLS, "RK4", 500, "mujoco", "pdot", lambda n: slice(500, n)),
    ("velocities of Exudyn from 500 on", _BALLS, "generalized-alpha", 500, "exudyn", "v",
     lambda n: slice(500, n)),
)  # fmt: skip
RUN_MISTAKES = (
    *(
        _mistake(f"{what} {where}", mechanism, integrator, mujoco_mistake(when, change), first)
        for what, change, places in _OF_MUJOCO
        for where, mechanism, integrator, when, first in places
    ),
    _mistake(
        "masses in the second run", _BALLS, "RK4", mujoco_mistake(from_step(1), _scaled_masses, run=2),
        quantities=("step_rate", "step_velocity"),
    ),
    *(
        _mistake(name, mechanism, integrator, pinocchio_mistake(when, integrator, "masses" in name), first,
                 "pinocchio")
        for name, mechanism, integrator, when, first in _OF_PINOCCHIO
    ),
    *(
        _mistake(name, mechanism, integrator, None, first, engine, wrong_samples(field, rows))
        for name, mechanism, integrator, first, engine, field, rows in _OF_SAMPLES
    ),
)  # fmt: skip
