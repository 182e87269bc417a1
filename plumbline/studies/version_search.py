"""Which version of an engine changed an answer: a binary search over the published versions.

An answer is what an importer makes of a model file, or the verdict of a row of a run.  Each version runs in
an environment of its own, which `plumbline.engines.environments` makes once and keeps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any

from packaging.specifiers import SpecifierSet
from packaging.version import Version

from plumbline.engines.environments import declared_attribute, declared_importer_attribute, published_versions
from plumbline.execution.plan import LevelSelection, Plan, no_progress
from plumbline.execution.runner import run_plan
from plumbline.judging.rows import LEVEL_OF_RUN, Row, Verdict
from plumbline.model_files.model_rows import FileResult
from plumbline.model_files.model_run import ModelPlan, run_model_files
from plumbline.processes.exceptions import PlumblineError


class VersionUnusable(PlumblineError):
    """A version gives no answer here; the message is the reason."""


class NoSearch(PlumblineError, ValueError):
    """There is nothing to search in, or the request is wrong; the message says why."""


@dataclass(frozen=True)
class VersionAnswer:
    """What one version answers."""

    key: str  # two versions answer alike where these are equal
    text: str  # for the reader


@dataclass(frozen=True)
class VersionChange:
    """The end of a search."""

    engine: str
    oldest: str  # of the versions that were compared
    newest: str
    answers: Mapping[str, VersionAnswer]  # of the versions that were tried
    skipped: Mapping[str, str]  # why a version was not used
    last_before: str = ""  # the last version that answers otherwise than the newest; empty: none was found
    first_after: str = ""  # the first from which on the newest's answer holds

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        if not self.first_after:
            alike = self.answers[self.oldest].text
            return f"{self.engine} {self.oldest} and {self.newest} answer alike: {alike}"
        return (
            f"{self.engine} {self.last_before}: {self.answers[self.last_before].text}; "
            f"since {self.first_after}: {self.answers[self.first_after].text}"
        )

    @property
    def note(self) -> str:
        """The same without details, for the head of a script."""
        if not self.first_after:
            return f"{self.oldest}, the oldest version that was tried, answers alike."
        before, after = (self.answers[version].key for version in (self.last_before, self.first_after))
        if {before, after} <= set(Verdict):
            return f"{self.last_before}: {before}; since {self.first_after}: {after}."
        return f"{self.last_before} answers otherwise than {self.first_after}, the next version."


def find_change(
    engine: str,
    versions: Sequence[str],
    ask: Callable[[str], VersionAnswer],
    on_answer: Callable[[str, str], None],
) -> VersionChange:
    """Search for the version from which on the newest version's answer holds.

    Args:
        engine: name for the sentences.
        versions: oldest first; the first and the last that can be used are compared.
        ask: gets a version's answer, or raises `VersionUnusable`.
        on_answer: called with each version and its answer or why it was skipped.

    Returns:
        The change. Where the answer changed several times, one of the changes to the newest one's.

    Raises:
        NoSearch: fewer than two versions give an answer.

    """
    found, skipped = dict[str, VersionAnswer](), dict[str, str]()

    def first_usable(some: Sequence[str]) -> str:
        """Return the first of some versions that answers; empty where none does. Each is asked once."""
        for version in some:
            if version not in found.keys() | skipped.keys():
                try:
                    found[version] = ask(version)
                    on_answer(version, found[version].text)
                except VersionUnusable as reason:
                    skipped[version] = str(reason)
                    on_answer(version, f"skipped: {reason}")
            if version in found:
                return version
        return ""

    oldest = first_usable(versions)
    newest = first_usable([v for v in reversed(versions) if v != oldest])
    if not newest:
        reasons = "; ".join(f"{version}: {reason}" for version, reason in skipped.items())
        raise NoSearch(f"fewer than two versions of {engine} can be compared{reasons and ': ' + reasons}")
    change = VersionChange(engine, oldest, newest, found, skipped)
    wanted = found[newest].key
    if found[oldest].key == wanted:
        return change
    low, high = versions.index(oldest), versions.index(newest)
    while True:
        middle = (low + high) / 2
        between = sorted(range(low + 1, high), key=lambda k: abs(k - middle))
        version = first_usable([versions[k] for k in between])
        if not version:
            return replace(change, last_before=versions[low], first_after=versions[high])
        if found[version].key == wanted:
            high = versions.index(version)
        else:
            low = versions.index(version)


def choose_versions(
    package: str, supported: str, good: str = "", bad: str = ""
) -> tuple[list[str], list[str]]:
    """Choose the versions to search in.

    Args:
        supported: range of versions that the column works with; empty: all.
        good: one end; empty: the oldest version, or the newest if the other end is the oldest.
        bad: the other end; empty: the newest version, or the oldest if the other end is the newest.

    Returns:
        Versions, oldest first, and sentences about those left out.

    Raises:
        NoSearch: an end is no usable version.

    `EnvironmentUnavailable` passes through where the package index cannot be reached.

    """
    published = published_versions(package)
    usable = [v for v in published.usable if not supported or Version(v) in SpecifierSet(supported)]
    ends, last = list[int](), len(usable) - 1
    for text in filter(None, (good, bad)):
        same = [k for k, v in enumerate(usable) if Version(v) == Version(text)]
        if not same:
            reason = f"there are: {', '.join(usable)}"
            if any(Version(v) == Version(text) for v in published.without_wheel):
                reason = f"it has no wheel for this Python and system; {reason}"
            elif any(Version(v) == Version(text) for v in published.usable):
                reason = f"the column supports versions {supported}; {reason}"
            raise NoSearch(f"{package} {text} cannot be used: {reason}")
        ends += same
    if len(ends) == 1:
        wanted = last if good else 0
        ends.append(wanted if wanted != ends[0] else last - wanted)
    chosen = usable[min(ends, default=0) : max(ends, default=last) + 1]
    notes = []
    if published.without_wheel:
        rest = ", ".join(published.without_wheel)
        notes.append(f"without a wheel for this Python and system, not tried: {rest}")
    outside = [v for v in published.usable if v not in usable]
    if outside:
        notes.append(f"outside of {supported}, which the column supports, not tried: {', '.join(outside)}")
    return chosen, notes


def search_versions(
    plan: ModelPlan | Plan, engine: str, good: str, bad: str, on_answer: Callable[[str, str], None],
    row: Mapping[str, Any] | None = None,
) -> tuple[VersionChange, list[str]]:  # fmt: skip
    """Find the version that changed an importer's reading of a model file, or an engine's verdict of a row.

    Args:
        plan: the file and how to load it, or a run of the row's scenario; engines and level are set here.
        engine: name in the registry of importers, or of engines, without a version.
        good: one end of the search, as for `choose_versions`.
        on_answer: as for `find_change`.
        row: the stored row, where the plan is a run.

    Returns:
        The change, and sentences about versions that were left out.

    Raises:
        NoSearch: the file cannot be used, or there is nothing to search in.

    """
    declared = declared_importer_attribute if isinstance(plan, ModelPlan) else declared_attribute
    package = declared(engine, "package")
    versions, notes = choose_versions(package, declared(engine, "supported_versions") or "", good, bad)

    try:
        installed = metadata.version(package)
    except metadata.PackageNotFoundError:
        installed = ""

    def ask(version: str) -> VersionAnswer:
        name = engine if version == installed else f"{engine}@{version}"  # the one here needs no environment
        if isinstance(plan, ModelPlan):
            return _ask_reading(plan, name)
        return _ask_verdict(plan, name, row or {})

    return find_change(engine, versions, ask, on_answer), notes


def _ask_reading(plan: ModelPlan, name: str) -> VersionAnswer:
    result = run_model_files(replace(plan, importers=(name,), are_importers_required=True), no_progress)
    if result.problems:
        raise NoSearch("\n".join(map(str, result.problems)))
    if reason := result.engines[name].missing:
        raise VersionUnusable(reason)
    return reading_answer(result.files[0], name)


def _ask_verdict(plan: Plan, name: str, row: Mapping[str, Any]) -> VersionAnswer:
    level: LevelSelection = LEVEL_OF_RUN.get(row["level"], "all")
    run = run_plan(replace(plan, engines=[name], level=level), no_progress)
    if reason := run.engines[name].missing:
        raise VersionUnusable(reason)
    return _row_answer(run.rows, row)


def reading_answer(file: FileResult, name: str) -> VersionAnswer:
    """Describe how an importer reads a file, so that two versions can be compared.

    Returns:
        The causes of its differences, or the quantities that differ, or its refusal.

    """
    rows = [row for row in file.rows if row.engine == name]
    whole = next((row for row in rows if row.quantity == "all"), None)
    if whole is not None:
        return VersionAnswer(str(whole.verdict), whole.reason)
    bad = [row for row in rows if row.verdict == Verdict.DISAGREES]
    explanation = file.explanations.get(name)
    phrases = [cause.phrase for cause in explanation.causes] if explanation else []
    if not phrases:
        phrases = [f"{row.quantity.replace('_', ' ')} differs" for row in bad]
        phrases += [row.reason for row in bad[:1] if row.quantity == "joints"]
    text = "; ".join(phrases) or "reads what the file says"
    return VersionAnswer(text, text)


def _row_answer(rows: Sequence[Row], wanted: Mapping[str, Any]) -> VersionAnswer:
    fields = ("scenario", "level", "integrator", "quantity")
    same = [row for row in rows if all(getattr(row, f) == wanted[f] for f in fields)]
    if not same:
        whole = [row.reason for row in rows if row.quantity == "all" and row.level == wanted["level"]]
        text = f"there is no such row{': ' + whole[0] if whole else ''}"
        return VersionAnswer(text, text)
    return VersionAnswer(str(same[0].verdict), f"{same[0].verdict}: {same[0].reason}")
