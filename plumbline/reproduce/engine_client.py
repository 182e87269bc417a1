"""An engine as the reproduction code calls it: in this process, or in the environment of another version."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from plumbline.engines import engine_calls
from plumbline.engines.metamorphic_hooks import MetamorphicHooks, metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.measurements.relation_result import OPTION_PREFIX
from plumbline.measurements.state_relations import WELDED_HALVES
from plumbline.model.datatypes import Integrator, Model, State, StateQuantities
from plumbline.model.loops import determinate_projectors, wrench_length
from plumbline.processes.remote_python import call_remote
from plumbline.reproduce.surface_source import variant_named


@dataclass(frozen=True)
class EngineClient:
    """A registered engine and, for another version of it, the interpreter of that version's environment."""

    name: str
    python: str = ""  # empty: this process

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of the engine's name in the engine's environment.

        Args:
            function: a module-level function whose first parameter is the engine's name.
            *arguments: its other arguments; picklable.

        """
        if self.python:
            return call_remote(self.python, function, self.name, *arguments)
        return function(self.name, *arguments)

    def evaluate(self, model: Model, state: State, variant: str = "") -> StateQuantities:
        """Evaluate one state.

        Args:
            state: a state on its constraint manifold.
            variant: name of the relation whose second answer is wanted ("by cholesky", "two welded
                halves"), or the names of one of the adapter's variants; empty for the engine's usual answer.

        Returns:
            The engine's quantities at that state.

        """
        found: StateQuantities = self.call(_evaluate_variant, variant, model, state)
        return found

    def write(self, model: Model, state: State, variant: str = "", moves: bool = False) -> dict[str, Any]:
        """Write what the engine holds of a mechanism, see `Adapter.written`.

        Args:
            variant: as of `evaluate`.
            moves: whether the engine is to run from there.

        Returns:
            The adapter's answer; of loops also which part of the wrenches is unique.

        Raises:
            Unsupported: the adapter cannot write it; the message is the reason.

        """
        found: dict[str, Any] = self.call(_write_variant, variant, model, state, moves)
        return found

    def integrator(self, name: str) -> Integrator:
        """Return the declaration of one of the engine's integrators.

        Returns:
            The integrator as this version's adapter declares it.

        """
        every = self.call(engine_calls.describe_engine).integrators
        found: Integrator = next(i for i in every if i.name == name)
        return found

    def run_script(self, script: str) -> str:
        """Run a reproduction script in the engine's environment.

        Returns:
            What it prints, up to its end or its failure.

        """
        printed: str = self.call(engine_calls.run_script, script)
        return printed


def _set_to_variant(engine: str, variant: str) -> MetamorphicHooks:
    adapter = metamorphic_hooks(load_adapter(engine))
    if variant == WELDED_HALVES:
        return adapter.with_welded_halves()
    if own := variant_named(adapter, variant):
        return adapter.with_variant(own)
    return adapter.with_option({OPTION_PREFIX + x: x for x in adapter.ways}[variant]) if variant else adapter


def _evaluate_variant(engine: str, variant: str, model: Model, state: State) -> StateQuantities:
    (found,) = _set_to_variant(engine, variant).evaluate(model, [state])
    return found


def _write_variant(engine: str, variant: str, model: Model, state: State, moves: bool) -> dict[str, Any]:
    found = _set_to_variant(engine, variant).written(model, state, moves)
    projectors = determinate_projectors(model, state) if model.has_loops else None
    if projectors is not None:
        found["fields"] |= {"unique": projectors, "arm": np.array(wrench_length(model))}
    return found
