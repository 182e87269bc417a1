"""What runs inside a worker process: one engine, one task, raw numbers back.

Nothing here judges.  Every function takes and returns small picklable records, so that the same
task runs in a local process or on another machine.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING

from packaging.specifiers import SpecifierSet

from plumbline.engines.environments import declared_attribute
from plumbline.engines.registry import load_adapter
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

if TYPE_CHECKING:
    from plumbline.truth.ground_truth import StateTruth


@dataclass(frozen=True)
class EngineInfo:
    """An engine as it is installed here (or in the environment of ``python``), or why it does not run."""

    name: str
    title: str
    version: str
    integrators: tuple[Integrator, ...]
    missing: str | None = None
    python: str = ""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """An engine's answers at a list of states, or the sentence that stands in their place."""

    quantities: list[StateQuantities]
    unsupported: str | None
    failure: str | None
    cpu_time: float  # CPU s inside the engine's calls


@dataclass(frozen=True, eq=False)
class RefinementRun:
    """One run of a ladder: a trajectory, or what the engine did instead."""

    resolution: float  # step in s, or relative tolerance
    trajectory: Trajectory | None
    failure: str | None
    cpu_time: float  # CPU s


@dataclass(frozen=True, eq=False)
class RefinementStudy:
    """A whole ladder of one integrator, coarse to fine."""

    runs: list[RefinementRun]
    unsupported: str | None


def describe_engine(engine: str) -> EngineInfo:
    """Import an engine and say what it is; an ImportError means it is not installed."""
    try:
        found = load_adapter(engine)
    except ImportError as error:
        return EngineInfo(engine, engine, "", (), f"{engine} is not installed here: {error}")
    except AttributeError as error:  # an interface that this version does not have
        version = metadata.version(declared_attribute(engine, "package"))
        return EngineInfo(engine, engine, version, (), f"the adapter cannot use version {version}: {error}")
    version, missing = found.version(), None
    if found.supported_versions and not SpecifierSet(found.supported_versions).contains(
        version, prereleases=True
    ):
        missing = (
            f"the adapter supports versions {found.supported_versions} of {found.package}, this is {version}"
        )
    return EngineInfo(engine, found.title, version, found.integrators, missing)


def evaluate_states(engine: str, model: Model, states: Sequence[State]) -> Evaluation:
    """State quantities of one engine at each state."""
    begin = time.process_time()
    quantities: list[StateQuantities] = []
    unsupported = failure = None
    try:
        quantities = load_adapter(engine).evaluate(model, states)
    except Unsupported as refusal:
        unsupported = str(refusal)
    except MemoryError:
        raise  # the worker's limit, told as such
    except Exception as error:  # an engine may raise anything: its words belong in the results
        failure = format_exception(error)
    return Evaluation(quantities, unsupported, failure, time.process_time() - begin)


def run_refinement(
    engine: str, integrator: str, model: Model, state: State, times: Array, resolutions: Sequence[float]
) -> RefinementStudy:
    """The same motion at each resolution; a rung that does not stay finite is kept as such."""
    chosen = load_adapter(engine)
    rungs: list[RefinementRun] = []
    for resolution in resolutions:
        begin = time.process_time()
        trajectory, failure = None, None
        try:
            trajectory = chosen.simulate(model, state, times, integrator, resolution)
        except Unsupported as refusal:
            return RefinementStudy(rungs, str(refusal))
        except MemoryError:
            raise
        except Exception as error:  # as above
            failure = format_exception(error)
        rungs.append(RefinementRun(resolution, trajectory, failure, time.process_time() - begin))
    return RefinementStudy(rungs, None)


def explain_disagreement(
    engine: str, model: Model, engine_quantities: list[StateQuantities], truth: StateTruth
) -> str:
    """Which term is wrong in answers that disagree with the truth: a sentence."""
    from plumbline.diagnosis.diagnose import diagnose  # only a dispute needs it

    return diagnose(model, engine_quantities, truth, load_adapter(engine).evaluate)


def format_exception(error: Exception) -> str:
    """An exception as one sentence; the project's own need no class name before them."""
    text = " ".join(str(error).split()) or "no message"
    return text if isinstance(error, EngineFailure | BadInput) else f"{type(error).__name__}: {text}"
