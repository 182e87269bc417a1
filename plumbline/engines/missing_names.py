"""What the installed version of an engine lacks of the names that an adapter uses."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np

from plumbline.model.datatypes import Array, Call

# Under this name an answer of the surface has the names of the engine that its version lacks.
MISSING_NAMES = "missing names"
BASE_REQUIREMENTS = ("numpy", "scipy", "packaging", "pydantic")  # imported by adapters and core in workers
# What every environment has: what is missing there is a mistake of this project or of the environment.
OWN_PACKAGES = {"plumbline", "adapters", "reference_impl", *BASE_REQUIREMENTS, ""}


def missing_name(error: Exception, adapter: str = "") -> str | None:
    """Return the name of an engine that an error says to be missing; None of another error.

    Args:
        error: whose source is an attribute of a module, class or object, or an import.
        adapter: module of the adapter, in which a name that is missing is a mistake.

    """
    if isinstance(error, ModuleNotFoundError):
        found, package = error.name, error.name
    elif isinstance(error, AttributeError):
        owner = error.obj if isinstance(error.obj, ModuleType | type) else type(error.obj)
        found = error.name if isinstance(owner, ModuleType) else f"{owner.__name__}.{error.name}"
        package = getattr(owner, "__module__", None) or getattr(owner, "__name__", "")
    else:
        return None
    own = {*OWN_PACKAGES, "builtins", adapter.partition(".")[0]}
    return found if str(package).partition(".")[0] not in own else None


def add_parts(found: dict[str, dict[Call, Array]], *parts: Callable[[], object]) -> None:
    """Let each part add to an answer of the surface, up to the first name that the engine's version lacks.

    Raises:
        AttributeError: a name is missing elsewhere than in the engine.

    """
    for part in parts:
        try:
            part()
        except (AttributeError, ModuleNotFoundError) as error:
            name = missing_name(error)
            if name is None:
                raise
            found.setdefault(MISSING_NAMES, {})[name,] = np.zeros((1, 1))
