"""The contract between the core and an engine: four duties, checked on the way in and out.

An adapter file subclasses `Adapter` and fills in the engine's calls; the checks here run
around every call of every adapter, so that no engine sees a NaN or an unnormalised
quaternion (most accept both silently) and no early stop, silent reset, repeated or
non-finite row leaves unnoticed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from typing import ClassVar, Self

import numpy as np

from plumbline.model.datatypes import (
    Array,
    BadInput,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
    Unsupported,
)
from plumbline.model.welding import BodyParts, split_bodies, undivided_bodies

UNIT_NORM_TOLERANCE = 8 * np.finfo(float).eps  # a quaternion normalised in double is this close to |p| = 1


class Adapter(ABC):
    """One engine (and one formulation of it), translated to the project's model and back."""

    name: ClassVar[str]  # as typed on the command line
    title: ClassVar[str]  # as shown in the report
    package: ClassVar[str]  # distribution whose version is reported
    integrators: ClassVar[tuple[Integrator, ...]]
    supported_versions: ClassVar[str] = ""  # PEP 440 range of versions that the adapter works with
    # Requirements of environments with another version: (range of versions, what they need besides).
    extra_requirements: ClassVar[tuple[tuple[str, str], ...]] = ()
    # Ways of the engine to the same answers other than its usual one: for evaluating states, for simulating.
    options: ClassVar[tuple[str, ...]] = ()
    linear_solvers: ClassVar[tuple[str, ...]] = ()
    welding_unsupported_reason: ClassVar[str] = "the adapter welds nothing"  # why not; empty where it does
    option: str = ""  # the one of `options` or `solvers` in use
    has_welded_halves: bool = False  # whether bodies are two welded halves

    @abstractmethod
    def version(self) -> str:
        """Version of the engine that runs."""

    @abstractmethod
    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        """State quantities at the given states; raise Unsupported with a sentence where it cannot."""

    @abstractmethod
    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        """Run from ``state`` and sample at ``times`` (times[0] = 0), every one hit by a step exactly."""

    def integrator(self, name: str) -> Integrator:
        """The integrator of that name; KeyError names the ones there are."""
        for candidate in self.integrators:
            if candidate.name == name:
                return candidate
        raise KeyError(f"{self.name} has no integrator {name!r}; it has {[i.name for i in self.integrators]}")

    def with_option(self, option: str) -> Self:
        """The same engine by another of its ways; KeyError names the ones there are."""
        if option not in (ways := (*self.options, *self.linear_solvers)):
            raise KeyError(f"{self.name} has no option {option!r}; it has {list(ways)}")
        other = copy(self)
        other.option = option
        return other

    def with_welded_halves(self) -> Self:
        """The same engine, evaluating every body as two welded halves; Unsupported where it cannot weld."""
        if self.welding_unsupported_reason:
            raise Unsupported(self.welding_unsupported_reason)
        other = copy(self)
        other.has_welded_halves = True
        return other

    def body_pieces(self, model: Model) -> BodyParts:
        """What the engine is to build every body of."""
        return split_bodies(model) if self.has_welded_halves else undivided_bodies(model)

    def _simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: Integrator, resolution: float
    ) -> Trajectory:
        """To ``end``, all that the integrator carries reversed in time, and as long back: three rows."""
        raise Unsupported(f"the adapter does not turn a run of {integrator.name} round")

    def evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        """State quantities at each state.

        Raises BadInput for states no engine should see, Unsupported with the engine's
        reason, EngineFailure where what comes back is not finite or not of the right shape.
        """
        for state in states:
            check_state(model, state)
        answers = self._evaluate(model, states)
        if len(answers) != len(states):
            raise EngineFailure(f"{self.name} answered {len(answers)} of {len(states)} states")
        for index, answer in enumerate(answers):
            check_quantities(model, answer, f"{self.name}, state {index}")
        return answers

    def simulate(
        self, model: Model, state: State, times: Array, integrator: str, resolution: float
    ) -> Trajectory:
        """Trajectory at ``times`` with the named integrator; errors as `evaluate`."""
        check_state(model, state)
        method = self.integrator(integrator)
        if method.kind == "step":
            check_times(times, resolution)
        trajectory = self._simulate(model, state, times, method, resolution)
        check_trajectory(model, state, times, trajectory, f"{self.name} {integrator}")
        return trajectory

    def simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: str, resolution: float
    ) -> Trajectory:
        """There and back by a symmetric integrator: rows at 0, ``end`` and 2 ``end``; errors as `simulate`.

        The last row is the first one with opposite rates, but for rounding and the step's solver.
        """
        check_state(model, state)
        times = np.array([0.0, end, 2 * end])
        run = self._simulate_round_trip(model, state, end, self.integrator(integrator), resolution)
        check_samples(model, times, run, f"{self.name} {integrator}")
        return run


def check_state(model: Model, state: State) -> None:
    """Refuse what engines accept silently: NaN, infinity, wrong shapes, quaternions not of unit length."""
    for name, shape in (("p", (model.n, 4)), *((k, (model.n, 3)) for k in ("omega", "u", "udot", "r", "v"))):
        array = getattr(state, name)
        if np.shape(array) != shape:
            raise BadInput(f"state.{name} has shape {np.shape(array)}, expected {shape}")
        if array.dtype != np.float64:
            raise BadInput(f"state.{name} is {array.dtype}, expected float64")
        if not np.all(np.isfinite(array)):
            raise BadInput(f"state.{name} is not finite")
    norms = np.linalg.norm(state.p, axis=-1)
    if np.any(np.abs(norms - 1) > UNIT_NORM_TOLERANCE):
        raise BadInput(f"state.p is not normalised: |p| = {norms.tolist()}")
    for array_name in vars(model):
        if not np.all(np.isfinite(getattr(model, array_name))):
            raise BadInput(f"model.{array_name} is not finite")


def check_quantities(model: Model, answer: StateQuantities, label: str) -> None:
    """Shapes and finiteness of what an engine says of a state."""
    shapes = {
        "acceleration": (model.n, 3),
        "angular_acceleration": (model.n, 3),
        "joint_reaction": (model.n, 3),
        "angular_momentum": (3,),
        "kinetic_energy": (),
        "potential_energy": (),
        "mass_matrix": (3 * (model.n + int(model.rods.sum())),) * 2,
    }
    for name, shape in shapes.items():
        value = getattr(answer, name)
        if value is None:
            continue
        if np.shape(value) != shape:
            raise EngineFailure(f"{label}: {name} has shape {np.shape(value)}, expected {shape}")
        if not np.all(np.isfinite(value)):
            raise EngineFailure(f"{label}: {name} is not finite")


def check_times(times: Array, step: float) -> None:
    """Every sample time must be a whole number of steps, to rounding."""
    if not np.isfinite(step) or step <= 0:
        raise BadInput(f"step {step} is not a positive number")
    if times[0] != 0 or np.any(np.diff(times) <= 0):
        raise BadInput("sample times must start at 0 and increase")
    count = times / step
    if np.any(np.abs(count - np.round(count)) > 1e-9 * np.maximum(count, 1)):
        raise BadInput(f"sample times are not multiples of the step {step}")


def check_samples(model: Model, times: Array, run: Trajectory, label: str) -> None:
    """An early stop and rows that are not finite are failures, never data."""
    if np.shape(run.t) != np.shape(times) or np.max(np.abs(run.t - times)) > 1e-9 * max(1.0, times[-1]):
        last = run.t[-1] if len(run.t) else float("nan")
        raise EngineFailure(f"{label}: sampled {len(run.t)} of {len(times)} times, last at t = {last} s")
    shape = (len(times), model.n)
    for name, width in (("r", 3), ("p", 4), ("v", 3), ("pdot", 4)):
        array = getattr(run, name)
        if np.shape(array) != (*shape, width):
            raise EngineFailure(f"{label}: {name} has shape {np.shape(array)}, expected {(*shape, width)}")
        finite = np.all(np.isfinite(array), axis=(1, 2))
        if not np.all(finite):
            raise EngineFailure(f"{label}: {name} is not finite from t = {times[np.argmin(finite)]} s")


def check_trajectory(model: Model, state: State, times: Array, run: Trajectory, label: str) -> None:
    """As `check_samples`; so are a silent reset and repeated rows."""
    check_samples(model, times, run, label)
    rows = np.concatenate([getattr(run, k).reshape(len(times), -1) for k in ("r", "p", "v", "pdot")], axis=1)
    moving = np.any(run.v != 0, axis=(1, 2)) | np.any(run.pdot != 0, axis=(1, 2))
    repeated = np.all(rows[1:] == rows[:-1], axis=1) & moving[1:]
    if np.any(repeated):
        at = times[1 + int(np.argmax(repeated))]
        raise EngineFailure(f"{label}: the row at t = {at} s repeats the one before while moving")
    # A return to the exact initial row (which may be at rest) of a pendulum that moved is a reset, not a
    # period: no integrator closes an orbit to the last bit of every coordinate and rate.
    reset = np.all(rows[1:] == rows[0], axis=1) & np.logical_or.accumulate(moving)[1:]
    if np.any(reset):
        at = times[1 + int(np.argmax(reset))]
        raise EngineFailure(f"{label}: the row at t = {at} s is the initial state again (a silent reset)")
