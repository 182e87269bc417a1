"""The one place that knows every engine: adding an engine is adding one file and one line here."""

from __future__ import annotations

from importlib import import_module

from plumbline.engines.adapter import Adapter

ENGINES = {
    "reference": "adapters.reference_engine:Reference",
    "mujoco": "adapters.mujoco_engine:Mujoco",
    "pinocchio": "adapters.pinocchio_engine:Pinocchio",
    "pinocchio-aba": "adapters.pinocchio_engine:PinocchioAba",
    "pinocchio-maximal": "adapters.pinocchio_maximal_engine:PinocchioMaximal",
    "exudyn": "adapters.exudyn_engine:Exudyn",
    "exudyn-tree": "adapters.exudyn_tree_engine:ExudynTree",
}


def load_adapter(name: str) -> Adapter:
    """The adapter of that name; imports its engine, so ImportError means "not installed"."""
    module, _, class_name = ENGINES[name].partition(":")
    found: type[Adapter] = getattr(import_module(module), class_name)
    return found()
