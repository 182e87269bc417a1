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

from plumbline.judging.rows import Row

RowKind = tuple[str, str, str, str, str]  # of a row: engine, its version, level, integrator, quantity
KNOWN_ISSUES_FILE = Path(__file__).with_name("known_issues.yaml")


class KnownIssue(BaseModel):
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
    intermittent: bool = False  # of random scenarios, which may or may not show it
    extra_refinements_only: bool = False  # of the nightly's finer ladders alone
    evidence: str  # what shows it: a measurement, a script, a document
    reason: str  # why it is so

    @field_validator("versions")
    @classmethod
    def _check_version_range(cls, text: str) -> str:
        try:
            SpecifierSet(text)
        except InvalidSpecifier as error:
            raise ValueError(f"{error}; a version range is written like '>=1.13,<2'") from None
        return text

    @model_validator(mode="after")
    def _check_intermittent(self) -> KnownIssue:
        if self.intermittent and not self.scenario.startswith("random-"):
            raise ValueError("`sometimes` is for random scenarios (random-*): others show it or do not")
        return self

    def matches_kind(self, kind: RowKind) -> bool:
        """Whether the entry speaks of that kind of row in its scenarios; of an engine in any version."""
        engine, version, *others = kind
        here = fnmatchcase(engine.partition("@")[0], self.engine)
        patterns = self.level, self.integrator, self.quantity
        return here and all(map(fnmatchcase, others, patterns)) and self.matches_version(version)

    def matches_version(self, version: str) -> bool:
        """Whether an engine's version is in the entry's range; pre-releases count."""
        if not self.versions:
            return True
        try:
            return SpecifierSet(self.versions).contains(Version(version), prereleases=True)
        except InvalidVersion:
            return False


def load_known_issues(path: Path = KNOWN_ISSUES_FILE) -> list[KnownIssue]:
    """The entries of a file; ValueError naming file and entry where it is not valid."""
    try:
        raw = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        entries = TypeAdapter(list[KnownIssue]).validate_python(
            [one for item in raw or [] for one in expand_lists(item)]
        )
    except (OSError, YAMLError, ValidationError) as error:
        raise ValueError(f"{path}: {error}") from None
    twice = [e.id for i, e in enumerate(entries) if any(e.id == other.id for other in entries[:i])]
    if twice:
        raise ValueError(f"{path}: ids used twice: {', '.join(twice)}")
    return entries


def expand_lists(item: object) -> list[object]:
    """One entry for each scenario, integrator or quantity of a list, each with an id: each must occur."""
    for field in ("scenario", "integrator", "quantity"):
        if isinstance(item, dict) and isinstance(item.get(field), list):
            each = [{**item, field: name, "id": f"{item.get('id')}: {name}"} for name in item[field]]
            return [one for entry in each for one in expand_lists(entry)]
    return [item]


class KnownIssues:
    """Entries as they are used: rows come by and by, and at the end an entry may have excused nothing."""

    def __init__(self, entries: Sequence[KnownIssue], has_extra_refinements: bool) -> None:
        """``finer``: the rows come from finer ladders than `run`'s."""
        self.issues = [e for e in entries if has_extra_refinements or not e.extra_refinements_only]
        self.finer = has_extra_refinements
        self._by_kind: dict[RowKind, list[KnownIssue]] = {}  # there are many rows, of few kinds
        self.used_ids: set[str] = set()
        self.matched_ids: set[str] = set()

    def issues_for(self, row: Row) -> list[KnownIssue]:
        """The entries that speak of that row's cell, whatever its verdict."""
        kind = row.engine, row.engine_version, row.level, row.integrator, row.quantity
        if kind not in self._by_kind:
            self._by_kind[kind] = [e for e in self.issues if e.matches_kind(kind)]
        return [e for e in self._by_kind[kind] if fnmatchcase(row.scenario, e.scenario)]

    def mark_known(self, rows: Iterable[Row]) -> list[Row]:
        """The rows, with the entry that expects their verdict where there is one."""
        marked = []
        for row in rows:
            about = self.issues_for(row)
            self.matched_ids.update(e.id for e in about)
            match = next((e for e in about if e.verdict == row.verdict), None)
            if match:
                self.used_ids.add(match.id)
            marked.append(replace(row, known_issue=match.id) if match else row)
        return marked

    def stale_issues(self, *, is_full_matrix: bool) -> list[KnownIssue]:
        """Entries that have had their day; with ``whole`` (a run of the full matrix) all that excused none.

        Where only a part of the matrix ran, an entry is stale if it covers rows that ran and excuses none
        and has no pattern in its scenario: a pattern may have its case among the cells that did not run.
        Finer ladders than the usual ones may resolve what is recorded as unresolved.
        """
        return [
            e
            for e in self.issues
            if e.id not in self.used_ids
            and not e.intermittent
            and e.id in self.matched_ids
            and not (self.finer and e.verdict == "unresolved")
            and (is_full_matrix or not set("*?[") & set(e.scenario))
        ]
