"""What an answer of the surface lacks: names of the engine, and parts by which it failed."""

from __future__ import annotations

from collections.abc import Callable, Container
from contextvars import ContextVar
from types import ModuleType

import numpy as np

from plumbline.model.datatypes import Array, Call, Unsupported
from plumbline.processes.exceptions import describe_exception, place_of
from plumbline.processes.isolation import EndedEarly, call_in_fork

FoundAnswer = dict[str, dict[Call, Array]]  # a `SurfaceAnswer` while it is made
# Under these names an answer of the surface has the names of the engine that its version lacks, and what
# parts failed by, each with the place of what was raised.
MISSING_NAMES, FAILED_PARTS = "missing names", "failed parts"
# And the calls that it has at later states than one at which it lacks them, where no part failed.
LATER_CALLS = "later calls"
# Whether each part has a process of its own, that a crash ends alone.
IS_APART = ContextVar("IS_APART", default=False)
# The labels of the parts that run; None: all of them do.
WANTED_PARTS = ContextVar[Container[str] | None]("WANTED_PARTS", default=None)
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


def add_parts(found: FoundAnswer, *parts: Callable[[], object]) -> None:
    """Let each part add to an answer of the surface, up to its first failure or name that the version lacks.

    Raises:
        AttributeError: a name is missing elsewhere than in the engine.

    `MemoryError` and `Unsupported` pass through.

    """
    wanted = WANTED_PARTS.get()
    for part in parts:
        if wanted is not None and _label(part) not in wanted:
            continue
        try:
            if IS_APART.get():
                found |= call_in_fork(lambda: _add_part(found, part))  # noqa: B023
            else:
                _add_part(found, part)
        except EndedEarly as error:
            _note(found, FAILED_PARTS, f"{_words(part)}: {error}", "")


def _add_part(found: FoundAnswer, part: Callable[[], object]) -> FoundAnswer:
    try:
        part()
    except (MemoryError, Unsupported):
        raise
    except (AttributeError, ModuleNotFoundError) as error:
        name = missing_name(error)
        if name is None:
            raise
        _note(found, MISSING_NAMES, name)
    except Exception as error:  # an engine may raise anything, and other parts are to be compared
        _note(found, FAILED_PARTS, f"{_words(part)}: {describe_exception(error)}", place_of(error))
    return found


def _note(found: FoundAnswer, kind: str, *words: str) -> None:
    found.setdefault(kind, {})[words] = np.zeros((1, 1))


def _label(part: Callable[[], object]) -> str:
    """What a part does, by the name of its function, which may be partial.

    The parts of one function have one label: scripts have all of its lines, and call it for all of them.
    """
    name: str = getattr(part, "func", part).__name__
    return name.replace("_", " ").strip()


def _words(part: Callable[[], object]) -> str:
    """The label, and the texts that a partial function is given."""
    texts = [text for text in getattr(part, "args", ()) if isinstance(text, str)]
    return " ".join([_label(part), *texts])
