"""What an adapter does for one quantity of the surface, as the engine part of a stand-alone script.

These functions are called in the environment of the engine.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Container
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from plumbline.engines.adapter import Adapter
from plumbline.engines.missing_names import WANTED_PARTS
from plumbline.engines.registry import load_adapter
from plumbline.engines.variants import Variant
from plumbline.model.datatypes import Array, Float, Model, State
from plumbline.processes.remote_python import call_fresh
from plumbline.reproduce.source_slice import SourceSlice, executed_lines

TABLE = "VARIANTS"  # of the modules of adapters with variants


@dataclass(frozen=True)
class SurfaceSource:
    """The engine part of a script."""

    imports: list[str]
    code: str
    model: str  # names of the classes in the script
    state: str
    value: str  # the expression of the value, of a model and a state
    package: str  # distribution of the engine


class _AllParts:
    """Every label, and a record of those that were asked for."""

    def __init__(self) -> None:
        self.labels: dict[str, None] = {}

    def __contains__(self, label: object) -> bool:
        self.labels[str(label)] = None
        return True


def variant_named(adapter: Adapter, names: str) -> Variant | None:
    """Return the variant of an adapter by its names in one text, as rows have them."""
    return next((x for x in adapter.variants if ", ".join(x.names) == names), None)


def surface_value(
    engine: str, model: Model, state: State, quantity: str, call: str, parts: Container[str] | None = None
) -> Float[Array, "..."]:
    """Return what a call says of a quantity at a state.

    Args:
        quantity: of the surface, or of states by a variant.
        call: its names or those of the variant in one text, as rows have them.
        parts: labels of the only parts of the surface that are evaluated.

    Raises:
        KeyError: the adapter does not make the call there.

    """
    adapter, token = load_adapter(engine), WANTED_PARTS.set(parts)
    try:
        if variant := variant_named(adapter, call):
            evaluate = getattr(adapter.with_variant(variant), _evaluation(model))
            return np.asarray(getattr(evaluate(model, [state])[0], _state_quantity(quantity)))
        (answer,) = adapter._surface(model, [state])
        return np.asarray(answer[quantity][tuple(call.split(", "))])
    finally:
        WANTED_PARTS.reset(token)


def surface_source(engine: str, model: Model, state: State, quantity: str, call: str) -> SurfaceSource:
    """Slice the source of what an adapter does for a row of the surface; arguments as above."""
    adapter, data, names = load_adapter(engine), "plumbline.model.datatypes", tuple(call.split(", "))
    home, own = type(adapter).__module__, type(adapter).__name__
    wanted, value = (
        [(data, "Model"), (data, "State"), (home, own)],
        f"._surface(model, [state])[0][{quantity!r}][{names!r}]",
    )
    if variant_named(adapter, call):
        wanted.append((home, TABLE))
        chosen = f"next(x for x in {TABLE} if x.names == {names!r})"
        value = f".with_variant({chosen}).{_evaluation(model)}(model, [state])[0].{_state_quantity(quantity)}"
    parts = _needed_parts(engine, model, state, quantity, call)
    arguments = pickle.dumps((engine, given(model), given(state), quantity, call, parts))
    lines = call_fresh(sys.executable, executed_lines, __name__, _value_of_given.__name__, arguments)
    part = SourceSlice(lines, wanted, names, TABLE)
    of_model, of_state, of_adapter, *_ = (part.name_of(*place) for place in wanted)
    imports = sorted({*part.imports, "import numpy as np", "from importlib import metadata"})
    return SurfaceSource(imports, part.code, of_model, of_state, f"{of_adapter}(){value}", adapter.package)


def given(one: Model | State) -> dict[str, Any]:
    """The fields of a model or a state that a script gives."""
    fields = one.fields if isinstance(one, Model) else vars(one)
    return {name: x for name, x in fields.items() if np.size(x)}


def _value_of_given(
    engine: str, model: dict[str, Any], state: dict[str, Any], quantity: str, call: str, parts: list[str]
) -> Array:
    return surface_value(engine, Model(**model), State(**state), quantity, call, parts)


def _evaluation(model: Model) -> str:
    """The method of an adapter: in loops the determinate part is what has a truth."""
    return "evaluate" if model.has_loops else "_evaluate"


def _state_quantity(quantity: str) -> str:
    return quantity.partition("_by_")[0]


def _needed_parts(engine: str, model: Model, state: State, quantity: str, call: str) -> list[str]:
    """The labels of few parts that a value needs, found by leaving out halves, quarters and so on."""
    every, value = _AllParts(), partial(surface_value, engine, model, state, quantity, call)
    value(every)
    left, size = [*every.labels], len(every.labels)
    while size:
        for first in range(0, len(left), size):
            fewer = left[:first] + left[first + size :]
            try:
                value(fewer)
            except KeyError:
                continue
            left = fewer
            break
        else:
            size //= 2
    return left
