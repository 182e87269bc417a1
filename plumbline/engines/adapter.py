"""The adapter contract: describe an engine, evaluate states, simulate; every call is checked on both sides.

An adapter file subclasses `Adapter` and translates between the project's model and the engine's calls.
The checks in this module run around every call of every adapter: no engine receives a NaN or a quaternion
that is not of unit length (most engines accept both silently), and an early stop, a silent reset, a
repeated row or a number that is not finite is reported as a failure.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, ClassVar, Self

import numpy as np

from plumbline.engines.answers import (
    check_declarations,
    check_evaluation,
    check_numbers,
    check_record,
    check_version,
)
from plumbline.engines.missing_names import missing_name
from plumbline.engines.variants import Variant
from plumbline.model.datatypes import (
    Array,
    BadInput,
    Call,
    EngineFailure,
    Float,
    Integrator,
    JointKind,
    Model,
    State,
    StateQuantities,
    StepRun,
    SurfaceAnswer,
    Trajectory,
    Unsupported,
)
from plumbline.model.loops import determinate_part

UNIT_NORM_TOLERANCE = 8 * np.finfo(float).eps  # a quaternion normalised in double is this close to |p| = 1
MINIMAL_CHANGE = 128 * np.finfo(float).eps  # by a step, that is not lost in rounding: angles up to 128 rad

# What an adapter may declare as unsupported, and what each entry covers.
UNSUPPORTED_KINDS = {
    "joint_reaction": "the engine does not return the forces at the joints",
    "kinetic_energy": "the engine does not return the kinetic energy",
    "potential_energy": "the engine does not return the potential energy",
    "angular_momentum": "the engine does not return the angular momentum about the pivot",
    "mass_matrix": "the engine does not return a joint-space mass matrix",
    "rods": "the engine refuses models in which a body hangs by a massless rod, or some of them",
    "balls": "the engine refuses models in which a body hangs by a ball joint, or some of them",
    "chains": "the engine refuses models of more than one body, or some of them",
    "loads": "the engine refuses models with applied forces, moments and drag, or some of them",
    "integrators": "the engine evaluates states and does not simulate",
}
_BALLS: Callable[[JointKind], bool] = attrgetter("is_spherical")
_TWO_SLIDES: Callable[[JointKind], bool] = lambda kind: len(kind.slide_axes) > 1  # noqa: E731
_TWO_TURNS: Callable[[JointKind], bool] = attrgetter("exchanges_axes")
# Mechanisms that an adapter may declare as gaps: it is not asked about them, and must not refuse others so.
MODEL_GAPS: Mapping[str, Callable[[Model], bool]] = {
    "rods": lambda model: bool(np.any(model.rods)),
    "balls": lambda model: any(kind.is_spherical for kind in model.kinds),
    "chains": lambda model: model.n > 1,
    "loads": lambda model: model.has_loads or model.has_drag,
    "rotors": lambda model: bool(np.any(model.armature)),
    "ball elements": lambda model: _has_elements(model, _BALLS, "armature", "damping", "stiffness"),
    "ball springs": lambda model: _has_elements(model, _BALLS, "damping", "stiffness"),
    "planar elements": lambda model: _has_elements(model, _TWO_SLIDES, "damping", "stiffness", "effort"),
    "pitches": lambda model: any(kind.has_pitch for kind in model.kinds),
    "universal springs": lambda model: _has_elements(model, _TWO_TURNS, "stiffness"),
    "point masses": lambda model: model.lacks_inertia,
    "turns without inertia": lambda model: model.lacks_inertia,
    "bodies": lambda model: model.n > 1,
    "angles": lambda model: any(kind.has_attitude for kind in model.kinds),
    "elements": lambda model: model.has_elements,
    "other joints": lambda model: not all(kind.holds_no_turn for kind in model.kinds),
    "branches": lambda model: not np.array_equal(model.body[:, 0], np.arange(len(model.kind)) - 1),
    "pivots": lambda model: bool(np.any(model.point[model.body[:, 0] < 0, 0])),
}
# What columns without `builds_trees` cannot express.
TREE_GAPS = "point masses", "elements", "other joints", "branches", "pivots"
# Of some such mechanisms, which the adapter refuses itself.
PARTIAL_GAPS = {"bodies", "angles", "turns without inertia"}


@dataclass(frozen=True)
class EngineInfo:
    """An engine as it is installed here (or in the environment of ``python``), or why it does not run."""

    name: str
    title: str
    version: str
    integrators: tuple[Integrator, ...]
    missing: str | None = None
    python: str = ""
    has_failed: bool = False  # the engine is missing for another reason than that it is not installed
    is_lifted: bool = False  # whether accelerations of bodies are computed here from those of coordinates


class Adapter(ABC):
    """One formulation of one engine, translated to the project's model and back.

    Everything that another package needs to know of an engine is a class attribute here.
    """

    name: ClassVar[str]  # as typed on the command line
    title: ClassVar[str]  # as shown in the report
    package: ClassVar[str]  # distribution whose version is reported
    integrators: ClassVar[tuple[Integrator, ...]]
    # What the engine does not do (a key of `UNSUPPORTED_KINDS`), and why, in a sentence.
    unsupported: ClassVar[Mapping[str, str]] = {}
    # What some mechanisms have that the engine cannot express, and why: a key of `MODEL_GAPS`, or a quantity
    # that it does not return for them.  Like all declared gaps these are shown and fail no run.
    gaps: ClassVar[Mapping[str, str]] = {}
    is_lifted: ClassVar[bool] = False  # whether it returns accelerations of joint coordinates, not of bodies
    supported_versions: ClassVar[str] = ""  # PEP 440 range of versions that the adapter works with
    # Requirements of environments with another version: (range of versions, additional requirement).
    extra_requirements: ClassVar[tuple[tuple[str, str], ...]] = ()
    other_formulation: ClassVar[str] = ""  # the same engine's column in other coordinates
    builds_trees: ClassVar[bool] = False  # whether states of trees with any joints are evaluated
    builds_elements: ClassVar[bool] = False  # … and of mechanisms with rotors, springs, dampers and efforts
    loops_unsupported_reason: ClassVar[str] = ""  # why states of mechanisms with loops are not, if so
    moves_loops: ClassVar[bool] = False  # whether motions of mechanisms with loops are simulated
    reproduction_template: ClassVar[str] = ""  # template of stand-alone scripts; without one there are none
    variants: ClassVar[Sequence[Variant]] = ()  # other ways to ask the engine
    variant: Variant | None = None  # the one in use
    # Names of the engine that the column itself uses, each with the mechanisms on which it does.
    column_names: ClassVar[Sequence[tuple[Call, Callable[[Model], bool]]]] = ()

    @abstractmethod
    def version(self) -> str:
        """Return the version of the engine that is loaded.

        Returns:
            A PEP 440 version, as the engine itself reports it.

        """

    @abstractmethod
    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        """Return the state quantities at each state; raise Unsupported with a sentence to refuse."""

    def _surface(self, model: Model, states: Sequence[State]) -> Sequence[SurfaceAnswer]:
        """Return what the engine reports besides the state quantities, at each state; none where nothing."""
        return []

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        """Run from ``state`` and sample at ``times`` (times[0] = 0), each of which ends a step exactly."""
        raise Unsupported(f"the adapter does not simulate with {integrator.name}")

    def _step(self, model: Model, state: State, times: Array, integrator: Integrator, step: float) -> StepRun:
        """Take consecutive steps; ``times`` (T,) are 0, step, 2 step, …."""
        return StepRun(self._simulate(model, state, times, integrator, step))

    def describe(self) -> EngineInfo:
        """Describe the engine as it is loaded.

        Returns:
            Its names, version and integrators; ``missing`` is a sentence where the adapter does not support
            the loaded version.

        """
        check_declarations(self)
        version, missing = check_version(self, "adapter")
        return EngineInfo(self.name, self.title, version, self.integrators, missing, is_lifted=self.is_lifted)

    def integrator(self, name: str) -> Integrator:
        """Look up one of the engine's integrators.

        Args:
            name: its name, as in `integrators`.

        Raises:
            KeyError: the engine has none of that name; the message lists those it has.

        """
        for candidate in self.integrators:
            if candidate.name == name:
                return candidate
        raise KeyError(f"{self.name} has no integrator {name!r}; it has {[i.name for i in self.integrators]}")

    def evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        """Evaluate the state quantities at each state.

        Args:
            states: states of it on the constraint manifold, double precision, unit quaternions.

        Returns:
            One record per state; quantities that the engine does not offer are None.

        Raises:
            EngineFailure: the answers have the wrong number or shape, or are not finite.

        `BadInput` (the input was refused before the engine received it) and `Unsupported` (the engine
        cannot do this; the message is the reason) pass through.

        """
        with self._checked_call(model, *states):
            answers = self._evaluate(model, states)
        check_evaluation(answers, model, len(states), f"{self.name}._evaluate")
        if model.has_loops:
            pairs = zip(states, answers, strict=True)
            answers = [determinate_part(model, state, answer) for state, answer in pairs]
        if not model.has_joint_moments:
            answers = [replace(answer, joint_moment=None) for answer in answers]
        return answers

    def written(self, model: Model, state: State, moves: bool = False) -> dict[str, Any]:
        """Write what the engine itself holds of a mechanism at a state, for a stand-alone script.

        Args:
            moves: whether the script runs from there; else it evaluates the state.

        Returns:
            What the template of the engine's scripts takes; ``fields`` are its arrays by name.

        Raises:
            Unsupported: with a sentence that says what is missing.

        """
        raise Unsupported(f"the adapter of {self.title} writes no mechanisms for scripts")

    def with_variant(self, variant: Variant) -> Self:
        """Copy the adapter, set to one of its `variants`."""
        other = copy(self)
        other.variant = variant
        return other

    def surface(self, model: Model, states: Sequence[State]) -> Sequence[SurfaceAnswer]:
        """Evaluate what the engine reports besides the state quantities; errors are those of `evaluate`.

        Args:
            states: as of `evaluate`.

        Returns:
            One record per state; none where the adapter offers nothing of the mechanism.

        """
        with self._checked_call(model):
            answers = self._surface(model, states)
        if len(answers) not in (0, len(states)):
            raise EngineFailure(f"{self.name}._surface answered {len(answers)} of {len(states)} states")
        for answer in answers:
            for quantity, by_call in answer.items():
                for call, value in by_call.items():
                    label = f"{self.name}._surface: {quantity} by {', '.join(call)}"
                    # the row of that call says what is not finite
                    check_numbers(value, "R D", {}, label, must_be_finite=False)
        return answers

    def simulate(
        self, model: Model, state: State, times: Float[Array, "samples"], integrator: str, resolution: float
    ) -> Trajectory:
        """Simulate from a state and sample at given times; errors are those of `evaluate`.

        Args:
            times: sample times [s], ascending from 0; multiples of the step for fixed-step methods.
            integrator: name of one of `integrators`.
            resolution: step [s], or relative tolerance, by the integrator's ``kind``.

        Returns:
            The trajectory at ``times``, not normalised and not projected.

        """
        with self._checked_call(model, state, moves=True):
            method = self.integrator(integrator)
            if method.kind == "step":
                check_times(times, resolution)
            trajectory = self._simulate(model, state, times, method, resolution)
        _check_trajectory(model, times, trajectory, f"{self.name}._simulate, {integrator}")
        if method.kind == "step" and trajectory.steps != (count := round(float(times[-1] / resolution))):
            raise EngineFailure(  # tolerances grow with the number of steps
                f"{self.name}._simulate, {integrator}: steps is {trajectory.steps!r}, but {count} steps of "
                f"{resolution:g} s lead to t = {times[-1]:g} s"
            )
        softer = trajectory.softer and replace(trajectory.softer, initial_x=state.x)
        solved = max(method.solver_rtol, trajectory.solver_rtol)
        # Only steps are judged by coordinates and velocities, runs by their poses.
        return replace(
            trajectory,
            initial_x=state.x,
            coordinates=None,
            velocities=None,
            softer=softer,
            solver_rtol=solved,
        )

    def step(self, model: Model, state: State, integrator: str, step: float, count: int) -> StepRun:
        """Take a few steps from a state and sample after each; errors are those of `evaluate`.

        Args:
            integrator: name of a fixed-step integrator of `integrators` with a declared method.
            step: step [s].

        Returns:
            The samples, not normalised and not projected.

        Raises:
            EngineFailure: a sample, acceleration or multiplier is missing, not finite or of another shape.
            Unsupported: also where single steps of the mechanism have no formula.

        """
        times = np.asarray(step * np.arange(count + 1), float)
        with self._checked_call(model, state, moves=True):
            run = self._step(model, state, times, self.integrator(integrator), step)
        label = f"{self.name}._step, {integrator}"
        check_record(run, StepRun, {"bodies": model.n, "samples": len(times)}, label)
        _check_trajectory(model, times, run.trajectory, label)
        return run

    def is_soft(self, model: Model) -> bool:
        """Whether the engine holds a part of the mechanism by constraints of its own solver."""
        return model.has_loops

    def _check_motion(self, model: Model) -> None:
        self._check_mechanism(model)
        if model.has_loops and not self.moves_loops:
            reason = f"the adapter of {self.title} covers no motions of mechanisms with loops"
            raise Unsupported(reason, "motions of loops")

    def _check_mechanism(self, model: Model) -> None:
        """Refuse what the adapter does not build, and elements unless it evaluates states with them."""
        if self.builds_trees and model.has_loops and self.loops_unsupported_reason:
            raise Unsupported(self.loops_unsupported_reason, "loops")
        if not self.builds_trees and any(MODEL_GAPS[gap](model) for gap in TREE_GAPS):
            reason = f"the adapter of {self.title} covers chains of rods and balls from the origin"
            raise Unsupported(reason, "trees")
        for gap, reason in self.gaps.items():
            if gap not in PARTIAL_GAPS and gap in MODEL_GAPS and MODEL_GAPS[gap](model):
                raise Unsupported(reason, gap)
        if model.has_elements and not self.builds_elements:
            what = "joints with rotors, springs, dampers and efforts"
            raise Unsupported(f"the adapter of {self.title} covers no {what}", "elements")

    def _gaps_of_calls(self, model: Model, moves: bool) -> dict[str, bool]:
        """Whether the mechanism has each declared gap for which a call may be refused: no quantity is one."""
        declared = {*self.unsupported, *self.gaps}
        found = {gap: is_met(model) for gap, is_met in MODEL_GAPS.items() if gap in declared}
        return found | ({"integrators": True} if moves and "integrators" in declared else {})

    @contextmanager
    def _checked_call(self, model: Model, *states: State, moves: bool = False) -> Iterator[None]:
        """Check what the engine is to receive, and hold the adapter's own refusals to what it declares.

        Refusals that it does not declare count, false ones are failures.
        """
        (self._check_motion if moves else self._check_mechanism)(model)
        check_state(model, *states)
        try:
            yield
        except Unsupported as refusal:
            gaps = self._gaps_of_calls(model, moves)
            if refusal.gap not in gaps:
                raise Unsupported(str(refusal)) from None
            if not gaps[refusal.gap]:
                raise EngineFailure(
                    f"{self.name} refuses a mechanism for its {refusal.gap}, and it has none that the gap is "
                    f"about: {refusal}"
                ) from None
            raise
        except (AttributeError, ModuleNotFoundError) as error:
            name = missing_name(error, type(self).__module__)
            if name is None:
                raise
            raise Unsupported(f"this version of {self.title} has no {name}", missing=name) from error


def _has_elements(model: Model, is_meant: Callable[[JointKind], bool], *elements: str) -> bool:
    joints = [k for k, kind in enumerate(model.kinds) if is_meant(kind)]
    return any(bool(np.any(getattr(model, element)[joints])) for element in elements)


def check_state(model: Model, *states: State) -> None:
    """Refuse input that engines accept silently.

    Args:
        model: the pendulum; every array must be finite.
        *states: arrays must have the model's shapes, be float64 and finite, and ``p`` of unit length.

    Raises:
        BadInput: one of these does not hold; the message names the array.

    """
    widths = {"p": 4, "x": model.columns, "xdot": model.columns}
    for state in states:
        for name, array in vars(state).items():
            shape = model.n, widths.get(name, 3)
            if np.shape(array) != shape:
                raise BadInput(f"state.{name} has shape {np.shape(array)}, expected {shape}")
            if array.dtype != np.float64:
                raise BadInput(f"state.{name} is {array.dtype}, expected float64")
            if not np.isfinite(array).all():
                raise BadInput(f"state.{name} is not finite")
        norms = np.linalg.norm(state.p, axis=-1)
        if np.any(np.abs(norms - 1) > UNIT_NORM_TOLERANCE):
            raise BadInput(f"state.p is not normalised: |p| = {norms.tolist()}")
    for name, values in vars(model).items():
        if name != "kind" and not np.isfinite(values).all():
            raise BadInput(f"model.{name} is not finite")


def check_times(times: Float[Array, "samples"], step: float) -> None:
    """Check that every sample time is a whole number of steps, to rounding.

    Args:
        times: sample times [s].
        step: step [s].

    Raises:
        BadInput: the step is not a positive number, the times do not ascend from 0, or one is no multiple.

    """
    if not np.isfinite(step) or step <= 0:
        raise BadInput(f"step {step} is not a positive number")
    if times[0] != 0 or np.any(np.diff(times) <= 0):
        raise BadInput("sample times must start at 0 and increase")
    count = times / step
    if np.any(np.abs(count - np.round(count)) > 1e-9 * np.maximum(count, 1)):
        raise BadInput(f"sample times are not multiples of the step {step}")


def check_samples(model: Model, times: Float[Array, "samples"], run: Trajectory, label: str) -> None:
    """Check that a run was sampled at the given times, with finite rows of the right shapes.

    Args:
        times: sample times [s] that the engine was given.
        run: the trajectory that the engine returned.
        label: engine and integrator, for the message.

    Raises:
        EngineFailure: the run stopped early, or a row has another shape or is not finite.

    """
    check_record(run, Trajectory, {"bodies": model.n}, label)
    common = min(len(run.t), len(times))
    with np.errstate(invalid="ignore"):
        wrong = np.flatnonzero(~(np.abs(run.t[:common] - times[:common]) <= 1e-9 * max(1.0, times[-1])))
    if len(wrong) or len(run.t) != len(times):
        first = wrong[0] if len(wrong) else common
        text = f"{label}: sampled {len(run.t)} of {len(times)} times"
        if len(run.t):
            text += f", last at t = {run.t[-1]:.9g} s, asked for up to t = {times[-1]:.9g} s"
        if len(wrong):
            text += f"; sample {first} is at t = {run.t[first]:.9g} s, asked for t = {times[first]:.9g} s"
        raise EngineFailure(text)
    for name in ("r", "p", "v", "pdot", "coordinates", "velocities"):
        array = getattr(run, name)
        if array is None:
            continue
        if len(array) != len(times):
            raise EngineFailure(f"{label}: {name} has {len(array)} samples, expected {len(times)}")
        finite = np.all(np.isfinite(array.reshape(len(times), -1)), axis=1)
        if not np.all(finite):
            raise EngineFailure(f"{label}: {name} is not finite from t = {times[np.argmin(finite)]} s")


def _check_trajectory(model: Model, times: Array, run: Trajectory, label: str) -> None:
    """Check the samples of a run, and that no row repeats the one before or the initial state."""
    check_samples(model, times, run, label)
    if run.softer is not None:
        check_samples(model, times, run.softer, f"{label}: softer")
    rows = np.concatenate([getattr(run, k).reshape(len(times), -1) for k in ("r", "p", "v", "pdot")], axis=1)
    moving = np.any(run.v != 0, axis=(1, 2)) | np.any(run.pdot != 0, axis=(1, 2))
    # A motion that dampers bring to rest stands still once a step changes no digit of a coordinate, which may
    # be an angle after some turns: MINIMAL_CHANGE of lengths, and of 1.
    smallest = MINIMAL_CHANGE / (times[-1] / max(run.steps, 1))
    visible = (np.max(np.abs(run.v), axis=(1, 2)) > smallest * np.max(np.abs(run.r))) | (
        np.max(np.abs(run.pdot), axis=(1, 2)) > smallest
    )
    repeated = np.all(rows[1:] == rows[:-1], axis=1) & visible[1:]
    # A return to the exact initial row (which may be at rest) of a pendulum that moved is a reset, not a
    # period: no integrator closes an orbit to the last bit of every coordinate and rate.
    reset = np.all(rows[1:] == rows[0], axis=1) & np.logical_or.accumulate(moving)[1:]
    faults = {"repeats the one before while moving": repeated,
              "is the initial state again (a silent reset)": reset}  # fmt: skip
    for what, wrong in faults.items():
        if np.any(wrong):
            raise EngineFailure(f"{label}: the row at t = {times[1 + int(np.argmax(wrong))]} s {what}")
