"""The list of engines: adding one is adding a file in `adapters` and a line here."""

from __future__ import annotations

from importlib import import_module

from plumbline.engines.adapter import Adapter
from plumbline.engines.answers import describe_value
from plumbline.importers.importer import Importer
from plumbline.layout import PREFIX
from plumbline.model.datatypes import EngineFailure

ENGINES = {
    "reference": "adapters.reference_engine:Reference",
    "reference-printed": "adapters.reference_printed:ReferencePrinted",
    "mujoco": "adapters.mujoco_engine:Mujoco",
    "pinocchio": "adapters.pinocchio_engine:Pinocchio",
    "pinocchio-aba": "adapters.pinocchio_engine:PinocchioAba",
    "pinocchio-maximal": "adapters.pinocchio_maximal_engine:PinocchioMaximal",
    "exudyn": "adapters.exudyn_engine:Exudyn",
    "exudyn-tree": "adapters.exudyn_tree_engine:ExudynTree",
}

# Importers of model files, by the name as typed; an engine may have one without an adapter.
IMPORTERS = {
    "mujoco": "adapters.mujoco_importer:MujocoImporter",
    "pinocchio": "adapters.pinocchio_importer:PinocchioImporter",
    "exudyn": "adapters.exudyn_importer:ExudynImporter",
    "drake": "adapters.drake_importer:DrakeImporter",
    "dart": "adapters.dart_importer:DartImporter",
    "pybullet": "adapters.pybullet_importer:PybulletImporter",
}


def load_adapter(name: str) -> Adapter:
    """Import an adapter, and with it its engine; ImportError means that the engine is not installed.

    Args:
        name: a key of `ENGINES`.

    Returns:
        A new instance of the adapter.

    Raises:
        EngineFailure: the registry names something else than an adapter.

    """
    module, _, class_name = ENGINES[name].partition(":")
    found: type[Adapter] = getattr(import_module(PREFIX + module), class_name)
    if not isinstance(found, type) or not issubclass(found, Adapter):
        raise EngineFailure(
            f"{ENGINES[name]} is {describe_value(found)}, must be a class derived from Adapter"
        )
    return found()


def load_importer(name: str) -> Importer:
    """Import an importer column, and with it its engine; ImportError means that the engine is not installed.

    Args:
        name: a key of `IMPORTERS`.

    Returns:
        A new instance of the column.

    """
    module, _, class_name = IMPORTERS[name].partition(":")
    found: type[Importer] = getattr(import_module(PREFIX + module), class_name)
    return found()
