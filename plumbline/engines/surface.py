"""The engines' surface: what each public name of an engine is to this project.

`adapters/surface` has one file per engine.  By place (a module, class or enumeration, and which of its names
are read) it lists every name, once, under one of

    compared           by rows, whose names are given
    outside            for one of `OUTSIDE`
    not yet            with the reason
    not about motion   what it is

There are no patterns, so a name that a new version adds is undeclared whatever it is called.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module, metadata
from typing import Any

from plumbline.layout import ROOT
from plumbline.model.datatypes import EngineFailure
from plumbline.scenario.line_and_column_errors import first_words
from plumbline.scenario.yaml_reader import read_yaml

# Beside the files of engines: by engine and name the rows that a change turns red.
EXERCISED_FILE = ROOT / "adapters" / "surface" / "exercised.json"
SURFACE_ROWS = "rows of the level surface"  # the names of these are exercised
SURFACES = ("mujoco", "pinocchio", "exudyn")  # columns whose engines are read
COMPARED, OUTSIDE_STATUS, NOT_YET, NOT_MOTION = "compared", "outside", "not yet", "not about motion"
STATUSES = (COMPARED, OUTSIDE_STATUS, NOT_YET, NOT_MOTION)
OUTSIDE = ("contact", "rendering", "input and output", "memory", "another physics")
_KINDS: Mapping[str, Callable[[Any, Any], bool]] = {
    "functions": lambda _, x: callable(x) and not isinstance(x, type),
    "classes": lambda _, x: isinstance(x, type),
    "members": lambda owner, x: isinstance(x, owner),
    "attributes": lambda _, x: True,
}


@cache
def exercised_rows(engine: str) -> Mapping[str, Sequence[str]]:
    """Read which names are exercised, as `plumbline.studies.exercised_names` found.

    Returns:
        By name the quantities whose rows turn red where what it returns changes by 1e-6.

    """
    found: dict[str, dict[str, list[str]]] = json.loads(EXERCISED_FILE.read_text(encoding="utf-8"))
    return found[engine]


@dataclass(frozen=True)
class SurfaceName:
    """A public name of an engine, and what it is to this project."""

    name: str  # without the name of the engine's package: mj_inverse, mjtSensor.mjSENS_GYRO
    place: str  # what of which module, class or enumeration was read: "mujoco.mjtSensor members"
    status: str  # one of `STATUSES`
    detail: str  # the rows, or the reason


@dataclass(frozen=True)
class Surface:
    """The declared names of an engine."""

    engine: str
    package: str  # distribution whose version is reported
    version: str  # with which the names were read last
    names: tuple[SurfaceName, ...]

    def counts(self) -> Counter[str]:
        """Count the names by status."""
        return Counter(one.status for one in self.names)


@cache
def declared_surface(engine: str) -> Surface:
    """Read the file of an engine.

    Args:
        engine: one of `SURFACES`.

    Raises:
        EngineFailure: a status or a reason is not one of those that there are, or a name is declared twice.

    """
    document: Any = read_yaml(ROOT / "adapters" / "surface" / f"{engine}.yaml").data
    names = [
        SurfaceName(_short(place, name), place, status, detail)
        for place, by_status in document["places"].items()
        for status, by_detail in by_status.items()
        for detail, listed in by_detail.items()
        for name in listed
    ]
    for one in names:
        if one.status not in STATUSES or (one.status == OUTSIDE_STATUS and one.detail not in OUTSIDE):
            raise EngineFailure(f"{engine}.yaml: {one.name}: {one.status}, {one.detail} is no declaration")
    twice = [name for (_, name), count in Counter((x.place, x.name) for x in names).items() if count > 1]
    if twice:
        raise EngineFailure(f"{engine}.yaml declares {', '.join(twice)} twice")
    return Surface(engine, str(document["package"]), str(document["version"]), tuple(names))


def installed_names(places: Sequence[str]) -> set[tuple[str, str]]:
    """Read the public names of the engine that is installed; runs in a worker, since it imports the engine.

    Args:
        places: as in the engine's file.

    Returns:
        Pairs of place and name.  A place that has vanished has no names.

    """
    found = set[tuple[str, str]]()
    for place in places:
        path, _, kind = place.partition(" ")
        owner = _resolve(path)
        for name in dir(owner) if owner is not None else ():
            value = getattr(owner, name, None)
            home = getattr(value, "__module__", None)
            is_own = not isinstance(home, str) or home.split(".")[0] in (path.split(".")[0], "Boost")
            if not name.startswith("_") and is_own and _KINDS[kind](owner, value):
                found.add((place, _short(place, name)))
    return found


@dataclass(frozen=True)
class SurfaceChanges:
    """How the installed engine differs from its declared surface."""

    engine: str
    version: str  # that is installed
    new: tuple[str, ...]
    vanished: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The changes in words; empty where there are none."""
        parts = [
            f"{len(names)} {what} ({first_words(names, 5, ', …')})"
            for names, what in ((self.new, "new names about motion"), (self.vanished, "names fewer"))
            if names
        ]
        return f"{self.engine} {self.version} has {' and '.join(parts)}" if parts else ""


def surface_changes(engine: str) -> SurfaceChanges:
    """Compare the installed engine with its declared surface; runs in a worker.

    Args:
        engine: one of `SURFACES`.

    """
    surface = declared_surface(engine)
    declared = {(one.place, one.name) for one in surface.names}
    found = installed_names(sorted({place for place, _ in declared}))
    new, vanished = (tuple(sorted(name for _, name in some)) for some in (found - declared, declared - found))
    return SurfaceChanges(engine, metadata.version(surface.package), new, vanished)


def other_names(engine: str) -> dict[str, list[str]]:
    """Find the functions and classes that have several public names; imports the engine.

    Returns:
        By name the others of the same object.

    """
    groups: dict[int, list[str]] = {}
    for one in declared_surface(engine).names:
        path, _, kind = one.place.partition(" ")
        if kind in ("functions", "classes"):
            found = getattr(_resolve(path), one.name.rpartition(".")[2], None)
            groups.setdefault(id(found), []).append(one.name)
    return {name: names for names in groups.values() for name in names if len(names) > 1}


def _short(place: str, name: str) -> str:
    """The name with its place, without the engine's package."""
    owner = place.partition(" ")[0].partition(".")[2]
    return f"{owner}.{name}" if owner else name


def _resolve(path: str) -> Any:
    """The module, class or enumeration of a dotted path; None where there is none."""
    package, *rest = path.split(".")
    owner: Any = import_module(package)
    for i, name in enumerate(rest, 1):
        if not hasattr(owner, name):
            try:
                import_module(".".join([package, *rest[:i]]))
            except ImportError:
                return None
        owner = getattr(owner, name)
    return owner
