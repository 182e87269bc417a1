"""Calls made in worker processes: one engine, one task, numbers or a reason back.

Nothing here judges.  Every function takes and returns small picklable records, so that the same task runs
in a local process, in another environment or on another machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import metadata
from io import StringIO

import numpy as np

from plumbline.engines.adapter import Adapter, EngineInfo
from plumbline.engines.environments import declared_attribute
from plumbline.engines.missing_names import FAILED_PARTS, IS_APART, LATER_CALLS, MISSING_NAMES, OWN_PACKAGES
from plumbline.engines.no_answer import NoAnswer, attempt
from plumbline.engines.registry import load_adapter
from plumbline.engines.variants import VariantKind
from plumbline.model.datatypes import (
    Array,
    Call,
    Float,
    Integrator,
    Model,
    State,
    StateQuantities,
    StepRun,
    SurfaceAnswer,
    Trajectory,
)
from plumbline.processes.isolation import EndedEarly, call_in_fork

BESIDES = ("surface", "variants")  # what an engine is asked for after the state quantities
APART = "apart"  # the same, each part and variant in a process of its own
SURFACE_STATES = 8  # of a scenario, at which what engines report besides the state quantities is compared

VariantAnswers = dict[VariantKind, dict[Call, list[StateQuantities] | NoAnswer]]  # by kind and names


@dataclass(frozen=True, eq=False)
class Evaluation:
    """State quantities of an engine at a list of states, or the reason why there are none."""

    quantities: list[StateQuantities]
    cpu_time: float = 0.0  # CPU s inside the engine's calls
    no_answer: NoAnswer | None = None  # in place of them
    declared: tuple[str, ...] = ()  # all gaps that the adapter declares
    # what the engine reports besides: `SurfaceAnswer` with all of the first states in one array
    surface: SurfaceAnswer = field(default_factory=dict)
    surface_failure: NoAnswer | None = None  # in place of that
    # by kind and names of a variant the quantities at the first states, or what the engine did instead
    variants: VariantAnswers = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RefinementRun:
    """One run of a refinement study: a trajectory, or what the engine did instead."""

    resolution: float  # step in s, or relative tolerance
    trajectory: Trajectory | None
    cpu_time: float = 0.0  # CPU s
    failure: NoAnswer | None = None


@dataclass(frozen=True, eq=False)
class RefinementStudy:
    """The runs of one integrator at all resolutions, coarse to fine."""

    runs: list[RefinementRun]
    refusal: NoAnswer | None = None


@dataclass(frozen=True, eq=False)
class StepAttempt:
    """A few steps of one size from one state."""

    state: int  # index of the state
    step: float  # s
    run: StepRun | None = None  # the steps, fewer where more were refused or failed
    refusal: NoAnswer | None = None  # of more steps
    failure: NoAnswer | None = None  # of more steps


@dataclass(frozen=True, eq=False)
class StepEvaluation:
    """Single steps of one integrator from several states."""

    attempts: list[StepAttempt]
    cpu_time: float  # CPU s
    run: StepAttempt | None = None  # many steps from the first state
    larger: tuple[StepAttempt, ...] = ()  # of larger steps, which failed, so that ``run`` was made

    @property
    def runs(self) -> list[tuple[int, float, StepRun]]:
        """Index of the state, step [s] and the steps of the attempts that have some."""
        return [(one.state, one.step, one.run) for one in self.attempts if one.run is not None]


def describe_engine(engine: str) -> EngineInfo:
    """Load an engine and describe it.

    Returns:
        Its description; ``missing`` holds a sentence where the engine is not installed here, or in a
        version that the adapter cannot use.

    Raises:
        ImportError: another module than the engine's is missing, or the engine is installed but broken.

    """
    try:
        return load_adapter(engine).describe()
    except (ModuleNotFoundError, AttributeError) as error:
        return describe_missing(engine, error, "adapter")


def describe_missing(name: str, error: ModuleNotFoundError | AttributeError, subject: str) -> EngineInfo:
    """Describe an engine that cannot be loaded, or raise the error again where it is not the engine's.

    Args:
        name: of an engine or an importer, in the registry.
        error: a module or an interface that is missing.
        subject: what translates to the engine: "adapter" or "column".

    Returns:
        A description whose ``missing`` is a sentence.

    """
    if isinstance(error, ModuleNotFoundError):
        if (error.name or "").partition(".")[0] in OWN_PACKAGES:
            raise error
        return EngineInfo(name, name, "", (), f"{name} is not installed here: {error}")
    package = declared_attribute(name, "package")
    if not isinstance(package, str):  # no class of that name
        raise error
    version = metadata.version(package)
    return EngineInfo(name, name, version, (), f"the {subject} cannot use version {version}: {error}")


def evaluate_states(
    engine: str, model: Model, states: Sequence[State], besides: Sequence[str] = BESIDES
) -> Evaluation:
    """Evaluate the state quantities of one engine; errors are those of `attempt`.

    Args:
        besides: which of `BESIDES` to ask for, too, and `APART` where an engine has crashed by them.

    Returns:
        The quantities at each state, or the reason why there are none.

    """
    begin = time.process_time()
    adapter = attempt(load_adapter, engine)
    if isinstance(adapter, NoAnswer):
        return Evaluation([], time.process_time() - begin, adapter)
    declared = (*adapter.unsupported, *adapter.gaps)
    found = attempt(adapter.evaluate, model, states)
    if isinstance(found, NoAnswer):
        return Evaluation([], time.process_time() - begin, found, declared)
    for name in adapter.unsupported:
        if any(getattr(one, name, None) is not None for one in found):
            words = f"{engine} returns the {name} that its adapter declares as unsupported"
            return Evaluation([], time.process_time() - begin, NoAnswer(words, False), declared)
    surface, failure, variants = dict[str, dict[Call, Array]](), None, VariantAnswers()
    IS_APART.set(APART in besides)
    if found and "surface" in besides:
        stacked = attempt(lambda: stack_answers(adapter.surface(model, states[:SURFACE_STATES])))
        if not isinstance(stacked, NoAnswer):
            surface = stacked
        elif stacked.missing:
            surface = {MISSING_NAMES: {(stacked.missing,): np.zeros((1, 1, 1))}}
        else:
            failure = stacked
    if found and "variants" in besides:
        variants = evaluate_variants(adapter, model, states[:SURFACE_STATES])
    return Evaluation(found, time.process_time() - begin, None, declared, surface, failure, variants)


def evaluate_variants(adapter: Adapter, model: Model, states: Sequence[State]) -> VariantAnswers:
    """Evaluate the state quantities by all variants of an engine that suit the mechanism.

    Returns:
        By kind and names the quantities, or what the engine raised.

    """
    found: VariantAnswers = {}
    for variant in adapter.variants:
        if variant.suits(model):
            by_names = found.setdefault(variant.kind, {})
            ask = partial(attempt, adapter.with_variant(variant).evaluate, model, states)
            try:
                by_names[variant.names] = call_in_fork(ask) if IS_APART.get() else ask()
            except EndedEarly as error:
                by_names[variant.names] = NoAnswer(str(error), is_refusal=False)
    return found


def stack_answers(answers: Sequence[SurfaceAnswer]) -> dict[str, dict[Call, Array]]:
    """Put the answers at all states into one array per call, up to the first state that lacks it.

    Args:
        answers: of the surface, one per state; later states may lack calls of the first.

    """
    found, later = dict[str, dict[Call, list[Array]]](), dict[Call, Array]()
    for place, one in enumerate(answers):
        for quantity, by_call in one.items():
            for call, value in by_call.items():
                stacked = found.setdefault(quantity, {}).setdefault(call, [])
                without = answers[len(stacked) : place]
                if not without or quantity in (FAILED_PARTS, MISSING_NAMES):
                    stacked.append(value)
                elif not any(FAILED_PARTS in other for other in without):
                    later[call] = np.zeros((1, 1, 1))
    return ({LATER_CALLS: later} if later else {}) | {
        quantity: {call: np.array(values) for call, values in calls.items() if values}
        for quantity, calls in found.items()
    }


def run_refinement(
    engine: str,
    integrator: str,
    model: Model,
    state: State,
    times: Float[Array, "samples"],
    resolutions: Sequence[float],
    is_enough: Callable[[Model, Integrator, Sequence[RefinementRun]], bool] | None = None,
) -> RefinementStudy:
    """Simulate the same motion at each resolution; a run that fails is kept with its reason, as of `attempt`.

    Args:
        times: sample times [s].
        resolutions: steps [s] or relative tolerances, coarse to fine.
        is_enough: asked after every run whether those so far will do; None to run at all resolutions.

    Returns:
        The runs; up to the first refusal where the engine does not support the motion.

    """
    adapter = load_adapter(engine)
    runs: list[RefinementRun] = []
    for resolution in resolutions:
        begin = time.process_time()
        found = attempt(adapter.simulate, model, state, times, integrator, resolution)
        if isinstance(found, NoAnswer) and found.is_refusal:
            return RefinementStudy(runs, found)
        trajectory, failure = (None, found) if isinstance(found, NoAnswer) else (found, None)
        runs.append(RefinementRun(resolution, trajectory, time.process_time() - begin, failure))
        if is_enough is not None and is_enough(model, adapter.integrator(integrator), runs):
            break
    return RefinementStudy(runs)


def run_steps(
    engine: str,
    integrator: str,
    model: Model,
    states: Sequence[State],
    steps: Sequence[Sequence[float]],
    counts: Sequence[int],
) -> StepEvaluation:
    """Take a few steps of each size from each state; errors are those of `attempt`.

    Args:
        steps: steps [s] from each state.
        counts: numbers of steps, ascending; where the engine refuses the largest or fails, the next
            smaller is tried: angles may become singular on the way, and an explicit method unstable.

    """
    begin = time.process_time()
    adapter, attempts = load_adapter(engine), []
    for index, (state, sizes) in enumerate(zip(states, steps, strict=True)):
        for step in sizes:
            record = StepAttempt(index, step)
            for count in reversed(counts):
                found = attempt(adapter.step, model, state, integrator, step, count)
                if not isinstance(found, NoAnswer):
                    record = replace(record, run=found)
                    break
                if found.is_refusal:
                    record = replace(record, refusal=record.refusal or found)
                else:
                    record = replace(record, failure=record.failure or found)
            attempts.append(record)
    return StepEvaluation(attempts, time.process_time() - begin)


def run_script(_: str, text: str) -> str:
    """Run a script of this project, made of numbers, as a user would; return what it prints."""
    with redirect_stdout(StringIO()) as printed, suppress(Exception, SystemExit):
        exec(compile(text, "script", "exec"), {"__name__": "__main__"})
    return printed.getvalue()
