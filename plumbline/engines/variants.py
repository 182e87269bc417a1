"""Variants: other ways in which an engine is asked about the same mechanism at the same states.

A variant is an option of the engine (a solver, another sequence of calls, data that are copied or used
again), a spelling of the mechanism (other joints, frames, forms of an inertia), or the engine's tree that
computes with vectors where its others have spatial ones, which is wrong by itself.  An adapter lists its own
in one table; its build hook reads what each changes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from plumbline.layout import ROOT
from plumbline.model.datatypes import Call, Model

VariantKind = Literal["option", "spelling", "vectors"]
Suits = Callable[[Model], bool]


@dataclass(frozen=True)
class Variant:
    """One of them."""

    kind: VariantKind
    names: Call  # of the engine, that only this one uses
    change: Any  # what the adapter's build does otherwise
    suits: Suits  # the mechanisms that it is compared on


def every(_: Model) -> bool:
    """Whether a mechanism is one."""
    return True


def both(*suits: Suits) -> Suits:
    """Whether a mechanism is of all these."""
    return lambda model: all(one(model) for one in suits)


def has(*names: str) -> Suits:
    """Whether any of these arrays of a model has a number that is not 0."""
    return lambda model: any(np.any(getattr(model, name)) for name in names)


def variants_of(kind: VariantKind, change: Callable[..., Any], usual: Suits) -> Callable[..., Variant]:
    """Return what makes the entries of a table: of names in one text, the mechanisms, and what is changed.

    Args:
        change: makes the adapter's own record of that.
        usual: the mechanisms of all entries, some of which have a further condition.

    """

    def make(names: str, suits: Suits = every, **changed: Any) -> Variant:
        return Variant(kind, tuple(names.split()), change(**changed), both(usual, suits))

    return make


def names_of_column(column: str, mechanisms: Mapping[str, Suits]) -> Sequence[tuple[Call, Suits]]:
    """Read the names of its engine that a column itself uses, as `Adapter.column_names` has them.

    Args:
        mechanisms: by word of `adapters/surface/column_names.json` those on which it does; "all" is given.

    """
    suits: Mapping[str, Suits] = {"all": every, **mechanisms}
    return [(tuple(names), suits[word]) for word, names in _column_names()[column].items()]


def names_of_steps(column: str) -> Mapping[str, Call]:
    """Read by integrator of a column the names of its engine that steps are by, as `Integrator.names`."""
    found = _column_names()[f"steps of {column}"]
    return {integrator: (*names, *found["all"]) for integrator, names in found.items()}


def _column_names() -> Mapping[str, Mapping[str, Sequence[str]]]:
    text = (ROOT / "adapters" / "surface" / "column_names.json").read_text(encoding="utf-8")
    found: Mapping[str, Mapping[str, Sequence[str]]] = json.loads(text)
    return found
