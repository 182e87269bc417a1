"""The list of engines: adding one is adding a file in `adapters` and a line here, or naming one of yours."""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from plumbline.engines.adapter import Adapter
from plumbline.engines.answers import describe_value
from plumbline.importers.importer import Importer
from plumbline.layout import PREFIX
from plumbline.model.datatypes import EngineFailure
from plumbline.processes.line_process import COMMAND_PREFIX, split_command

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

REFERENCE_ENGINES = ("reference", "reference-printed")

# Engines of the user by name: specifications, as `plumbline.engines.specifications` has them. Workers get the
# specification, not the name.
USER_ENGINES: dict[str, str] = {}

# Importers of model files, by the name as typed; an engine may have one without an adapter.
IMPORTERS = {
    "mujoco": "adapters.mujoco_importer:MujocoImporter",
    "pinocchio": "adapters.pinocchio_importer:PinocchioImporter",
    "exudyn": "adapters.exudyn_importer:ExudynImporter",
    "drake": "adapters.drake_importer:DrakeImporter",
    "dart": "adapters.dart_importer:DartImporter",
    "pybullet": "adapters.pybullet_importer:PybulletImporter",
}
SCRIPTED_IMPORTERS = ("mujoco", "pinocchio", "exudyn", "drake", "dart")  # in whose calls scripts are written


def load_adapter(name: str) -> Adapter:
    """Import an adapter, and with it its engine; ImportError means that the engine is not installed.

    Args:
        name: a key of `ENGINES`, or a specification of `USER_ENGINES`.

    Returns:
        A new instance of the adapter.

    Raises:
        EngineFailure: the name leads to something else than an adapter, or a program does not answer.

    """
    if name.startswith(COMMAND_PREFIX):
        from plumbline.engines.protocol import served_engine

        return served_engine(*split_command(name))
    place, _, class_name = (PREFIX + ENGINES[name] if name in ENGINES else name).rpartition(":")
    module = _load_file(place) if place.endswith(".py") else import_module(place)
    found: type[Adapter] = getattr(module, class_name)
    if not isinstance(found, type) or not issubclass(found, Adapter):
        raise EngineFailure(
            f"{place}:{class_name} is {describe_value(found)}, must be a class derived from Adapter"
        )
    return found()


@cache
def _load_file(path: str) -> ModuleType:
    """Load a file that is in no package; its folder is not searched for further modules."""
    name = f"plumbline_engine_{Path(path).stem}"
    spec = spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
