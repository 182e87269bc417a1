"""An engine as the reproduction code calls it: in this process, or in the environment of another version."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from plumbline.engines import engine_calls
from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.measurements.relation_result import OPTION_PREFIX
from plumbline.measurements.state_relations import WELDED_HALVES
from plumbline.model.datatypes import Integrator, Model, State, StateQuantities
from plumbline.processes.remote_python import call_remote


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
                halves"); empty for the engine's usual answer.

        Returns:
            The engine's quantities at that state.

        """
        found: StateQuantities = self.call(_evaluate_variant, variant, model, state)
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


def _evaluate_variant(engine: str, variant: str, model: Model, state: State) -> StateQuantities:
    adapter = metamorphic_hooks(load_adapter(engine))
    if variant == WELDED_HALVES:
        adapter = adapter.with_welded_halves()
    elif variant:
        adapter = adapter.with_option({OPTION_PREFIX + way: way for way in adapter.ways}[variant])
    (found,) = adapter.evaluate(model, [state])
    return found
