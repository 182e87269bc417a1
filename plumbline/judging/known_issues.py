"""Known discrepancies and expected gaps: the one file that may excuse a verdict, entry by entry.

known.yaml lists scenario, engine, version range, level, integrator, quantity (patterns with *;
scenario, integrator and quantity may be lists), the expected verdict, its evidence and its reason.
An entry that covers cells of a run and explains none of them has had its day and fails.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

from packaging.specifiers import InvalidSpecifier, SpecifierSet
from packaging.version import InvalidVersion, Version
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, field_validator, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from plumbline.model.datatypes import Row

Kind = tuple[str, str, str, str, str]  # of a row: engine, its version, level, integrator, quantity
FILE = Path(__file__).with_name("known_issues.yaml")


class Entry(BaseModel):
    """One expected verdict that is not "agrees"."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str
    scenario: str
    engine: str
    versions: str = ""  # PEP 440 range; empty: any
    level: str = "*"
    integrator: str = "*"
    quantity: str = "*"
    verdict: Literal["disagrees", "unresolved", "unsupported", "failed"]
    sometimes: bool = False  # of random scenarios, which may or may not show it
    finer: bool = False  # of the nightly's finer ladders alone
    evidence: str  # what shows it: a measurement, a script, a document
    reason: str  # why it is so

    @field_validator("versions")
    @classmethod
    def _is_a_range(cls, text: str) -> str:
        try:
            SpecifierSet(text)
        except InvalidSpecifier as error:
            raise ValueError(f"{error}; a version range is written like '>=1.13,<2'") from None
        return text

    @model_validator(mode="after")
    def _only_chance_is_excused(self) -> Entry:
        if self.sometimes and not self.scenario.startswith("random-"):
            raise ValueError("`sometimes` is for random scenarios (random-*): others show it or do not")
        return self

    def covers(self, kind: Kind) -> bool:
        """Whether the entry speaks of that kind of row in its scenarios; of an engine in any version."""
        engine, version, *others = kind
        here = fnmatchcase(engine.partition("@")[0], self.engine)
        patterns = self.level, self.integrator, self.quantity
        return here and all(map(fnmatchcase, others, patterns)) and self.in_range(version)

    def in_range(self, version: str) -> bool:
        """Whether an engine's version is in the entry's range; pre-releases count."""
        if not self.versions:
            return True
        try:
            return SpecifierSet(self.versions).contains(Version(version), prereleases=True)
        except InvalidVersion:
            return False


def load(path: Path = FILE) -> list[Entry]:
    """The entries of a file; ValueError naming file and entry where it is not valid."""
    try:
        raw = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        entries = TypeAdapter(list[Entry]).validate_python(
            [one for item in raw or [] for one in spread(item)]
        )
    except (OSError, YAMLError, ValidationError) as error:
        raise ValueError(f"{path}: {error}") from None
    twice = [e.id for i, e in enumerate(entries) if any(e.id == other.id for other in entries[:i])]
    if twice:
        raise ValueError(f"{path}: ids used twice: {', '.join(twice)}")
    return entries


def spread(item: object) -> list[object]:
    """One entry for each scenario, integrator or quantity of a list, each with an id: each must occur."""
    for field in ("scenario", "integrator", "quantity"):
        if isinstance(item, dict) and isinstance(item.get(field), list):
            each = [{**item, field: name, "id": f"{item.get('id')}: {name}"} for name in item[field]]
            return [one for entry in each for one in spread(entry)]
    return [item]


class Excuses:
    """Entries as they are used: rows come by and by, and at the end an entry may have excused nothing."""

    def __init__(self, entries: Sequence[Entry], finer: bool) -> None:
        """``finer``: the rows come from finer ladders than `run`'s."""
        self.entries = [e for e in entries if finer or not e.finer]
        self.finer = finer
        self._of_kind: dict[Kind, list[Entry]] = {}  # there are many rows, of few kinds
        self.used: set[str] = set()
        self.covered: set[str] = set()

    def about(self, row: Row) -> list[Entry]:
        """The entries that speak of that row's cell, whatever its verdict."""
        kind = row.engine, row.engine_version, row.level, row.integrator, row.quantity
        if kind not in self._of_kind:
            self._of_kind[kind] = [e for e in self.entries if e.covers(kind)]
        return [e for e in self._of_kind[kind] if fnmatchcase(row.scenario, e.scenario)]

    def mark(self, rows: Iterable[Row]) -> list[Row]:
        """The rows, with the entry that expects their verdict where there is one."""
        marked = []
        for row in rows:
            about = self.about(row)
            self.covered.update(e.id for e in about)
            match = next((e for e in about if e.verdict == row.verdict), None)
            if match:
                self.used.add(match.id)
            marked.append(replace(row, known=match.id) if match else row)
        return marked

    def stale(self, *, whole: bool) -> list[Entry]:
        """Entries that have had their day; with ``whole`` (a run of the full matrix) all that excused none.

        Where only a part of the matrix ran, an entry is stale if it covers rows that ran and excuses none
        and has no pattern in its scenario: a pattern may have its case among the cells that did not run.
        Finer ladders than the usual ones may resolve what is recorded as unresolved.
        """
        return [
            e
            for e in self.entries
            if e.id not in self.used
            and not e.sometimes
            and e.id in self.covered
            and not (self.finer and e.verdict == "unresolved")
            and (whole or not set("*?[") & set(e.scenario))
        ]
