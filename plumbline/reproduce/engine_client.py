"""Whom a script is about: a registered engine, here or in the environment of another version."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from typing import Any

from plumbline.engines import calls
from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.judging.relation_result import OPTION_PREFIX
from plumbline.judging.state_relations import WELDED_HALVES
from plumbline.model.datatypes import Integrator, Model, State, StateQuantities
from plumbline.processes.remote_python import call_remote


@dataclass(frozen=True)
class Engine:
    """Whom to ask: a registered name and, for another version, the interpreter of its environment."""

    name: str
    python: str = ""

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """``function(name, *arguments)``, here or there."""
        if self.python:
            return call_remote(self.python, function, self.name, *arguments)
        return function(self.name, *arguments)

    def evaluate(self, model: Model, state: State, way: str = "") -> StateQuantities:
        """What it says of a state, by another of its ways where one is named."""
        found: StateQuantities = self.ask(answer, way, model, state)
        return found

    def integrator(self, name: str) -> Integrator:
        """One of its integrators, as it declares it."""
        every = self.ask(calls.describe_engine).integrators
        found: Integrator = next(i for i in every if i.name == name)
        return found

    def say(self, script: str) -> str:
        """What a script prints."""
        said: str = self.ask(printed, script)
        return said


@dataclass
class OfRuns:
    """What is measured of runs by one of an engine's integrators."""

    engine: Engine
    method: str

    @cached_property
    def integrator(self) -> Integrator:
        """As the engine declares it."""
        return self.engine.integrator(self.method)


def printed(_: str, script: str) -> str:
    """The output of a script, run in this process; empty where it fails."""
    with redirect_stdout(StringIO()) as output, suppress(Exception):
        exec(compile(script, "script", "exec"), {"__name__": "__main__"})  # it is ours, written from numbers
    return output.getvalue()


def answer(engine: str, way: str, model: Model, state: State) -> StateQuantities:
    """What an engine says of a state: as usual, by one of its options, or of welded halves."""
    chosen = metamorphic_hooks(load_adapter(engine))
    if way:
        chosen = (
            chosen.with_welded_halves()
            if way == WELDED_HALVES
            else chosen.with_option(way.removeprefix(OPTION_PREFIX))
        )
    (said,) = chosen.evaluate(model, [state])
    return said
