"""Known discrepancies and expected gaps: the only file that may excuse a verdict.

Each entry of known_issues.yaml has scenario, engine, version range, level, integrator, quantity (patterns
with *; scenario, integrator and quantity may be lists), the expected verdict, its evidence and its reason.
An entry that matches cells of the run but none of their verdicts is stale and fails the run.
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
    intermittent: bool = False  # only in some of the random scenarios
    extra_refinements_only: bool = False  # only with the additional smaller steps of the nightly
    evidence: str  # a measurement, a script, a document
    reason: str  # the cause

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
            raise ValueError("`intermittent` is for random scenarios (random-*) only")
        return self

    def matches_kind(self, kind: RowKind) -> bool:
        """Return whether the entry is about rows of this kind, in its scenarios.

        Args:
            kind: engine (with or without ``@version``), its version, level, integrator and quantity of a row.

        Returns:
            True where all patterns match and the version is in range.

        """
        engine, version, *others = kind
        names = engine.partition("@")[0], *others
        patterns = self.engine, self.level, self.integrator, self.quantity
        return all(map(fnmatchcase, names, patterns)) and self._matches_version(version)

    def _matches_version(self, version: str) -> bool:
        """Whether an engine's version is in the entry's range; pre-releases count."""
        if not self.versions:
            return True
        try:
            return SpecifierSet(self.versions).contains(Version(version), prereleases=True)
        except InvalidVersion:
            return False


def load_known_issues(path: Path = KNOWN_ISSUES_FILE) -> list[KnownIssue]:
    """Read a file of known issues.

    Args:
        path: the file.

    Returns:
        One entry for each scenario, integrator and quantity of the file's lists.

    Raises:
        ValueError: the file is not valid; the message names file and entry.

    """
    try:
        raw = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        entries = TypeAdapter(list[KnownIssue]).validate_python(
            [entry for item in raw or [] for entry in _expand_lists(item)]
        )
    except (OSError, YAMLError, ValidationError) as error:
        raise ValueError(f"{path}: {error}") from None
    twice = [e.id for i, e in enumerate(entries) if any(e.id == other.id for other in entries[:i])]
    if twice:
        raise ValueError(f"{path}: ids used twice: {', '.join(twice)}")
    return entries


def _expand_lists(item: object) -> list[object]:
    """One entry for each scenario, integrator or quantity of a list, with its own id: each must occur."""
    for field in ("scenario", "integrator", "quantity"):
        if isinstance(item, dict) and isinstance(item.get(field), list):
            each = [{**item, field: name, "id": f"{item.get('id')}: {name}"} for name in item[field]]
            return [one for entry in each for one in _expand_lists(entry)]
    return [item]


class KnownIssues:
    """The entries that apply to one run, and which of them its rows have used so far."""

    def __init__(self, entries: Sequence[KnownIssue], has_extra_refinements: bool) -> None:
        """Select the entries.

        Args:
            entries: all entries of the file.
            has_extra_refinements: whether the run takes smaller steps than usual.

        """
        self.issues = [e for e in entries if has_extra_refinements or not e.extra_refinements_only]
        self.has_extra_refinements = has_extra_refinements
        self._by_kind: dict[RowKind, list[KnownIssue]] = {}  # a cache: rows are many, kinds few
        self.used_ids: set[str] = set()
        self.matched_ids: set[str] = set()

    def issues_for(self, row: Row) -> list[KnownIssue]:
        """Find the entries about a row's cell, whatever its verdict.

        Args:
            row: a judged row.

        Returns:
            The entries, in the order of the file.

        """
        kind = row.engine, row.engine_version, row.level, row.integrator, row.quantity
        if kind not in self._by_kind:
            self._by_kind[kind] = [e for e in self.issues if e.matches_kind(kind)]
        return [e for e in self._by_kind[kind] if fnmatchcase(row.scenario, e.scenario)]

    def mark_known(self, rows: Iterable[Row]) -> list[Row]:
        """Mark the rows whose verdict an entry expects.

        Args:
            rows: judged rows.

        Returns:
            The rows in the same order, with the entry's id as ``known_issue``.

        """
        marked = []
        for row in rows:
            entries = self.issues_for(row)
            self.matched_ids.update(e.id for e in entries)
            match = next((e for e in entries if e.verdict == row.verdict), None)
            if match:
                self.used_ids.add(match.id)
            marked.append(replace(row, known_issue=match.id) if match else row)
        return marked

    def stale_issues(self, *, is_full_matrix: bool) -> list[KnownIssue]:
        """Find the entries that match rows of the run and none of their verdicts.

        Smaller steps than usual may resolve what is recorded as unresolved: this is not stale.

        Args:
            is_full_matrix: whether all scenarios ran on all engines. If not, an entry with a pattern for its
                scenario is not stale: its case may be among the cells that did not run.

        Returns:
            The stale entries.

        """
        return [
            e
            for e in self.issues
            if e.id not in self.used_ids
            and not e.intermittent
            and e.id in self.matched_ids
            and not (self.has_extra_refinements and e.verdict == "unresolved")
            and (is_full_matrix or not set("*?[") & set(e.scenario))
        ]
