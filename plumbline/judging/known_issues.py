"""Known discrepancies and expected gaps: the only files that may excuse a verdict.

An entry of known_issues.yaml records a finding: engine, cause or needs, version range, evidence and reason,
and the rows that it covers, with their largest ratio of error and tolerance.  Rows of states and steps are
matched by the cause that the diagnosis names, or, where a mechanism is recorded, as far as the run can check
it.  Rows of the surface and of motions follow from those: where states of the same mechanism are compared
and none shows the finding, their entry does not cover them.  All are matched by what the mechanism has: so
many bodies, a kind of joint.  A scenario's name is for what nothing else explains.  What exceeds the entry
is a new disagreement.  Of a missing term the effect is computed; the entry covers that, and nothing that is
left above the tolerance.  An entry that matches cells of the run but none of their verdicts is stale and
fails the run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from packaging.specifiers import SpecifierSet
from packaging.version import InvalidVersion, Version
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveFloat,
    PositiveInt,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from plumbline.diagnosis.cause import CauseKind
from plumbline.engines.declared_names import declared_integrators, declared_texts
from plumbline.engines.registry import ENGINES, IMPORTERS, USER_ENGINES
from plumbline.importers.neutral_model import MODEL_UNITS
from plumbline.judging.rows import CHECKED, FAILED_CALLS, OWN_UNCERTAINTY, Level, Row, Verdict
from plumbline.judging.state_level import SINGULAR_POSE, STATE_UNITS, VARIANT_QUANTITIES
from plumbline.measurements.relation_result import OTHER_FORMULATIONS, REPEATABILITY, UNEXPLAINED
from plumbline.measurements.run_relations import REVERSED_IN_TIME
from plumbline.measurements.state_relations import REDESCRIPTIONS, STATE_RELATIONS, WELDED_HALVES
from plumbline.model.invariants import INVARIANT_UNITS, LIMITS, LONG_RUN_QUANTITIES
from plumbline.scenario.generator import MECHANISM_PREFIX, MOTION_PREFIX, RANDOM_FAMILY
from plumbline.scenario.line_and_column_errors import Problem, ScenarioError, did_you_mean, shorten
from plumbline.scenario.loader import catalogue
from plumbline.scenario.schema import invalid_value_error
from plumbline.scenario.validation_messages import problems_from_validation
from plumbline.scenario.yaml_reader import read_yaml
from plumbline.scenario.yaml_source import PathKey, YamlSource, dotted_path
from plumbline.truth.step_comparison import CONSTRAINED_QUANTITIES, RUN_QUANTITIES, STEP_QUANTITIES
from plumbline.truth.surface_truth import SURFACE_QUANTITIES

RowKind = tuple[str, str, str, str, str]  # of a row: engine, its version, level, integrator, quantity
KNOWN_ISSUES_FILE = Path(__file__).with_name("known_issues.yaml")
DIAGNOSED_LEVELS = ("state", "step")  # whose rows have causes
FOLLOWING_LEVELS = ("surface", "trajectory", "invariants")  # whose rows follow from those
ANY_LENGTH = 10**9  # bodies
# Bounds are 64 roundings of the largest term and more: an answer that is off by a million times the quantity
# is 1e20 bounds off.
MAX_RATIO = 1e20
WIDE_FACTOR = 1e3  # an entry covers 3 … 10 times the worst case of its scenarios; this is two decades beyond
OR_EARLIER = " or earlier"  # after a version that is the oldest that the column supports

# Relations that give the same problem to the same algorithm in other numbers: only rounding can differ.
SCATTER_RELATIONS = ("rotated world", "re-chosen body frame")
MIN_SCATTER = 0.05  # of the error's ratio: the least scatter that shows rounding; measured 0.12 … 0.6
MIN_OWN_SCATTER = 0.3  # the same of the row's own error in a random scenario; measured 0.56 … 1.6
Mechanism = Literal["rounding", "equations", "method", "missing term"]
MECHANISMS: dict[Mechanism, str] = {
    "rounding": "the result loses digits: results for equivalent descriptions of the problem scatter as much",
    "equations": "the engine solves other equations: the error is the same for equivalent descriptions",
    "method": "the integrator is another one than declared: its accelerations at given states are right",
    "missing term": "the engine leaves out a term: with the term's computed effect the results agree",
}


@dataclass(frozen=True)
class KnownIssue:
    """One expected verdict that is not "agrees"."""

    id: str  # of these rows of an entry, unique
    scenario: str
    engine: str
    verdict: str
    evidence: str  # a measurement, a script, a document
    reason: str  # the cause
    versions: str = ""  # PEP 440 range; empty: any
    level: str = "*"
    integrator: str = "*"
    quantity: str = "*"
    max_ratio: Mapping[int, float] = field(
        default_factory=dict
    )  # by the number of bodies up to which it holds
    max_ratio_by_inertia: float | None = None  # the same, over `plumbline.model.invariants.inertia_ratio`
    min_bodies: int = 0  # with fewer it does not occur
    min_loops: int = 0  # the same of loops
    joints: tuple[str, ...] = ()  # kinds, of which the mechanism has one; empty: any
    failed_calls: tuple[str, ...] = ()  # names or patterns: no other call failed or is off; empty: any
    mechanism: Mechanism | None = None
    shown_by: str = ""  # the engine whose rows show the mechanism; empty: the row's own
    intermittent: str = ""  # why the verdict may or may not occur; empty: it must
    extra_refinements_only: bool = False  # only with the additional smaller steps of the nightly
    since: str = ""  # the first version that shows it, as `plumbline bisect` finds it; empty: not searched
    cause: Mapping[str, str] = field(default_factory=dict)  # fields of a cause that rows must have
    needs: tuple[str, ...] | None = None  # of what no cause explains; None: not recorded
    entry: str = ""  # id of the entry; empty: its own
    script: str = ""  # file of docs/surface that shows it; empty: none

    @property
    def name(self) -> str:
        """The finding's name: the id of the entry."""
        return self.entry or self.id

    @property
    def diagnosis(self) -> str | None:
        """The recorded mechanism and cause, for rows without a diagnosis; None where none is stated."""
        if not (self.mechanism or self.cause or self.needs is not None):
            return None
        since = f" Since version {self.since}." if self.since else ""
        return f"recorded: {self.explanation}{since}"

    @property
    def explanation(self) -> str:
        """The recorded mechanism, if any, and the reason."""
        return f"{MECHANISMS[self.mechanism]}. {self.reason}" if self.mechanism else self.reason

    def has_cause(self, row: Row) -> bool:
        """Return whether the diagnosis of a row's cell names what is recorded of it, and nothing else."""
        if row.level not in DIAGNOSED_LEVELS or not (self.cause or self.needs is not None):
            return True
        about = [cause for cause in row.causes if row.quantity in (cause["quantities"] or (row.quantity,))]
        if any(
            map(_is_close, about)
        ):  # too small a difference for a cause of its own follows from the others
            about = [cause for cause in row.causes if not _is_close(cause)]
        return bool(about) and all(map(self._records, about))

    def _records(self, cause: Mapping[str, Any]) -> bool:
        return any(
            all(wanted in (one[name], one["general"]) for name, wanted in self.cause.items())
            and self.needs in (None, tuple(one["needs"]))
            for one in (cause, *cause["equal"])
        )

    def matches_kind(self, kind: RowKind) -> bool:
        """Return whether the entry is about rows of this kind, in its scenarios.

        Args:
            kind: engine (without ``@version``), its version, level, integrator and quantity of a row.

        Returns:
            True where all patterns match and the version is in range; pre-releases count.

        """
        engine, version, *others = kind
        patterns = self.engine, self.level, self.integrator, self.quantity
        try:
            return all(map(fnmatchcase, (engine, *others), patterns)) and (
                not self.versions or SpecifierSet(self.versions).contains(Version(version), prereleases=True)
            )
        except InvalidVersion:
            return False

    def needs_of_mechanism_are_met(self, bodies: int, joints: Collection[str]) -> bool:
        """Return whether a mechanism has what the entry needs; each joint beyond its bodies closes a loop."""
        has_enough = bodies >= self.min_bodies and max(len(joints) - bodies, 0) >= self.min_loops
        return has_enough and (not self.joints or not set(self.joints).isdisjoint(joints))

    def covered_ratio(self, bodies: int, inertia_ratio: float) -> float:
        """Return the largest ratio of error and tolerance that the entry covers.

        Args:
            bodies: length of the chain.
            inertia_ratio: its `plumbline.model.invariants.inertia_ratio`.

        Returns:
            The ratio; 0 for a longer chain than any of the entry, infinity where the entry states none.

        """
        if self.max_ratio_by_inertia is not None:
            return self.max_ratio_by_inertia * inertia_ratio
        fitting = [limit for limit in self.max_ratio if bodies <= limit]
        return self.max_ratio[min(fitting)] if fitting else 0.0 if self.max_ratio else math.inf

    def scatter_of(self, row: Row, scatter: Mapping[tuple[str, str], float]) -> float | None:
        """Return how far results for equivalent descriptions of a row's problem differ.

        Args:
            scatter: of `objection`.

        Returns:
            In tolerances: the row's own, or that of the engine which shows the mechanism; None: not measured.

        """
        own = None if self.shown_by else _scatter_of(row)
        shown_by = self.shown_by or row.engine_name
        return scatter.get((shown_by, row.engine_version)) if own is None else own

    def objection(self, row: Row, covered: float, scatter: Mapping[tuple[str, str], float]) -> str:
        """Find out whether a row of the expected verdict exceeds what the entry describes.

        Args:
            row: a row that the entry's patterns and verdict match.
            covered: the entry's `covered_ratio` for the scenario.
            scatter: by engine and version how far its results for equivalent descriptions of the problem
                differ, in tolerances, in this scenario.

        Returns:
            Why the entry does not cover the row; empty where it does.

        """
        if not self.has_cause(row):
            return f"the entry {self.name} records another cause"
        if self.engine == "*" and OWN_UNCERTAINTY in row.extra:
            return f"the entry {self.name} records no uncertainty that an engine states itself"
        failed = str(row.extra.get(FAILED_CALLS, "")).split("\n") if self.failed_calls else []
        for call in failed:
            if not any(fnmatchcase(call, pattern) for pattern in self.failed_calls):
                return f"the entry {self.name} does not record that {call or 'no call by name'} fails"
        ratio = math.inf if row.ratio is None else row.ratio
        if not ratio <= covered and covered < math.inf:
            return f"the entry {self.name} covers {covered:g} times the tolerance at most"
        if (
            self.mechanism == "missing term"
            and not (left := float(row.extra.get(UNEXPLAINED, math.inf))) <= 1
        ):
            return (
                f"the entry {self.name} records a missing term; it leaves {left:.3g} × tolerance unexplained"
            )
        shown = self.scatter_of(row, scatter)
        least = MIN_OWN_SCATTER if "scatter" in row.extra else MIN_SCATTER
        if self.mechanism == "rounding" and shown is not None and shown < least * ratio:
            return (
                f"the entry {self.name} records rounding, but equivalent descriptions of the problem differ "
                f"by only {shown:.2g} times their tolerance"
            )
        if self.mechanism == "equations" and shown is not None and shown > max(1.0, MIN_SCATTER * ratio):
            return (
                f"the entry {self.name} records other equations, but equivalent descriptions of the problem "
                f"differ by {shown:.2g} times their tolerance"
            )
        return ""


def _is_close(cause: Mapping[str, Any]) -> bool:
    return (cause["kind"], cause["change"]) == ("unexplained", "close")


def _scatter_of(row: Row) -> float | None:
    """How far results for equivalent descriptions differ, in the row's tolerance; None if not measured."""
    if row.ratio is None:
        return None
    if row.level == "relations" and row.quantity in SCATTER_RELATIONS:
        return row.ratio
    return row.ratio * float(row.extra["scatter"]) if "scatter" in row.extra else None


def _check_ratio(value: float) -> float:
    if value > MAX_RATIO:
        valid = f"a number up to {MAX_RATIO:g}: beyond it is no error that an engine's cause explains"
        raise invalid_value_error(f"is {value:g}", valid)
    return value


def _valid_text(valid: str, check: Callable[[str], object]) -> AfterValidator:
    """A text of which a check is true; it may raise, as of a version or a number of thousands of digits."""

    def checked(text: str) -> str:
        with suppress(ValueError):
            if check(text):
                return text
        raise invalid_value_error(f"is {shorten(repr(text))}" if text.strip() else "is empty", valid)

    return AfterValidator(checked)


_Name = Annotated[str, _valid_text("one line of printable text", lambda text: text and text.isprintable())]
_Sentence = Annotated[str, _valid_text("a sentence", str.strip)]
_Versions = Annotated[
    str,
    _valid_text(
        "a version range, written like '>=1.13,<2'",
        lambda text: SpecifierSet(text).contains("1.0") is not None,
    ),
]
_Since = Annotated[
    str,
    _valid_text(
        f"a version, written like '4.1.0' or '3.3.1{OR_EARLIER}'",
        lambda text: Version(text.removesuffix(OR_EARLIER) or "0"),
    ),
]
_Ratio = Annotated[PositiveFloat, AfterValidator(_check_ratio)]
_Texts = Annotated[
    list[str], BeforeValidator(lambda x: x if isinstance(x, list) else [x]), Field(min_length=1)
]
_Ratios = Annotated[
    dict[PositiveInt, _Ratio], BeforeValidator(lambda x: x if isinstance(x, dict) else {ANY_LENGTH: x})
]


def _field(description: str, default: Any = ...) -> Any:
    return Field(default, description=description)


class Selector(BaseModel):
    """Rows that an entry covers: lists stand for each name, of which each must occur."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    scenario: _Texts = _field("Name or pattern of scenarios, or a list of them.", ["*"])
    engine: str = _field("Name or pattern of engines; of the entry by default.", "")
    level: str = _field("A level, or *.", "*")
    integrator: _Texts = _field("Name or pattern of integrators, or a list of them.", ["*"])
    quantity: _Texts = _field("Name or pattern of quantities, or a list of them.", ["*"])
    verdict: Literal["disagrees", "unresolved", "unsupported", "failed"] = _field(
        "The expected verdict.", "disagrees"
    )
    max_ratio: _Ratios = _field(
        "The largest ratio of error and tolerance, or a mapping from numbers of bodies to it.", {}
    )
    max_ratio_by_inertia: _Ratio | None = _field(
        "The largest ratio of error and tolerance, over the chain's largest ratio of inertias.", None
    )
    min_bodies: PositiveInt | None = _field("The smallest number of bodies with which it occurs.", None)
    min_loops: PositiveInt | None = _field("The smallest number of loops with which it occurs.", None)
    joints: _Texts | None = _field("A kind of joint, or a list: the mechanism has one of them.", None)
    failed_calls: _Texts | None = _field("The calls that fail or are off, or patterns: no other does.", None)
    shown_by: str = _field("The engine whose rows show the mechanism.", "")
    intermittent: str = _field("Why the verdict may or may not occur.", "")
    extra_refinements_only: bool = _field("Whether the nightly's smaller steps alone show it.", False)

    def check(self, engine: str, mechanism: Mechanism | None, cause: str) -> None:
        """Raise the validation error of what an entry with a mechanism or kind of cause may not expect."""
        is_size_computed = mechanism == "missing term"
        missing = [] if self.max_ratio or self.max_ratio_by_inertia or is_size_computed else ["max_ratio"]
        missing += [] if mechanism or cause else ["cause or mechanism"]
        if self.verdict == "disagrees" and missing:
            raise invalid_value_error(
                f"expects a disagreement without {' and '.join(missing)}",
                "max_ratio: the largest error over tolerance, and cause: fields of the cause that `explain` "
                "prints, or mechanism: " + ", ".join(MECHANISMS),
            )
        if self.verdict == "disagrees" and "*" in (self.engine or engine):
            raise invalid_value_error("expects a disagreement of every engine", "the engine that is wrong")
        is_random = all(name.startswith(f"{RANDOM_FAMILY}-") for name in self.scenario)
        is_rounding = "rounding" in (mechanism, cause)
        if self.intermittent and not (self.verdict == "unresolved" or is_rounding or is_random):
            raise invalid_value_error(
                "is intermittent",
                "`intermittent` for the verdict unresolved, the mechanism rounding, or random scenarios "
                f"({RANDOM_FAMILY}-*)",
            )

    def issues(self, name: str, common: Mapping[str, Any]) -> Iterator[KnownIssue]:
        """Make an issue of each name of the lists, with its own id: each must occur.

        Args:
            name: of these rows.
            common: fields of the entry.

        """
        own = {one: getattr(self, one) for one in Selector.model_fields}
        own["engine"] = self.engine or common["engine"]
        own |= {"min_bodies": self.min_bodies or 0, "min_loops": self.min_loops or 0}
        own |= {"joints": tuple(self.joints or ()), "failed_calls": tuple(self.failed_calls or ())}
        lists = {one: own[one] for one in ("scenario", "integrator", "quantity")}
        for names in product(*lists.values()):
            varied = [one for one, given in zip(names, lists.values(), strict=True) if len(given) > 1]
            chosen = dict(zip(lists, names, strict=True))
            yield KnownIssue(**{**common, **own, **chosen, "id": ": ".join([name, *varied])})


class _Cause(BaseModel):
    """Fields of `plumbline.diagnosis.cause.Cause` that those of the rows must have."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: CauseKind = _field("number, term, output, frame, method, rounding or unexplained.")
    term: str = _field("The number, term or quantity.", "")
    change: str = _field("missing, doubled, reversed, in the body frame, …", "")


class Entry(Selector):
    """An entry as the file has it: a finding, and the rows that it covers."""

    id: _Name = _field("A name of the entry, unique in all files: the finding's.")
    engine: str = _field("Name or pattern of engines.")
    versions: _Versions = _field("A version range, as '>=1.13,<2'.", "")
    cause: _Cause | None = _field(
        "The cause that the diagnosis names, as `plumbline explain` prints it.", None
    )
    needs: list[str] | None = _field("What a difference without a cause needs.", None)
    mechanism: Mechanism | None = _field("The mechanism of a disagreement.", None)
    since: _Since = _field("The first version that shows it, as '4.1.0' or '3.3.1 or earlier'.", "")
    evidence: _Sentence = _field("A measurement, a script, a document.")
    reason: _Sentence = _field("The cause.")
    script: str = _field("A file of docs/surface that shows it.", "")
    rows: list[Selector] | None = _field(
        "Rows that it covers, by default those of the entry's own patterns; an empty list: none, because the "
        "adapter goes around it.",
        None,
    )

    @model_validator(mode="after")
    def _check_rows(self) -> Entry:
        for selector in self._selectors:
            cause = self.cause.kind if self.cause else "unexplained" if self.needs is not None else ""
            selector.check(self.engine, self.mechanism, cause)
        return self

    @property
    def _selectors(self) -> Sequence[Selector]:
        return [self] if self.rows is None else self.rows

    @property
    def is_wrong(self) -> bool:
        """Whether the engine is wrong or fails, in rows or where no row shows it."""
        return not self._selectors or any(one.verdict in ("disagrees", "failed") for one in self._selectors)

    def every_issue(self) -> Iterator[KnownIssue]:
        """Make the issues of all rows."""
        common = {
            name: getattr(self, name) for name in Entry.model_fields.keys() - {"rows", "cause", "needs"}
        }
        cause = {} if self.cause is None else self.cause.model_dump()
        common["cause"] = {name: value for name, value in cause.items() if value}
        common["needs"] = None if self.needs is None else tuple(self.needs)
        common["entry"] = self.id
        for number, selector in enumerate(self._selectors, 1):
            yield from selector.issues(self.id if self.rows is None else f"{self.id} ({number})", common)


def load_known_issues(
    path: Path = KNOWN_ISSUES_FILE,
    other_scenarios: Iterable[str] = (),
    places: dict[str, str] | None = None,
) -> list[KnownIssue]:
    """Read a file of known issues.

    Args:
        other_scenarios: names of scenarios that entries may be about, besides the catalogue, the random ones
            and the files beside ``path``.
        places: of each id that other files have used, file and line; receives those of this file.

    Returns:
        One entry for each scenario, integrator and quantity of the file's lists.

    Raises:
        ScenarioError: the file is not valid; its problems have file, line and column.

    """
    return [issue for entry in _load_entries(path, other_scenarios, places) for issue in entry.every_issue()]


def _load_entries(
    path: Path, other_scenarios: Iterable[str] = (), places: dict[str, str] | None = None
) -> list[Entry]:
    try:
        source = read_yaml(path)
    except ScenarioError as error:
        if [problem.message for problem in error.problems] == ["is empty"]:
            return []
        raise
    if not isinstance(source.data, list):
        raise source.fatal_error("is not a list", "a list of entries, each as `- id: …`", (1, 1))
    try:
        entries = TypeAdapter(list[Entry]).validate_python(source.data)
    except ValidationError as error:
        found = error.errors()
        for one in found:  # `_Ratios` adds a key that the file does not have
            one["loc"] = tuple(key for key in one["loc"] if key != ANY_LENGTH)
        problems = problems_from_validation(source, found, Entry)
        raise ScenarioError([*source.problems, *problems]) from None
    beside = (file.stem for file in path.parent.glob("*.yaml")) if path != KNOWN_ISSUES_FILE else ()
    problems = [*source.problems, *_id_problems(source, entries, {} if places is None else places)]
    problems += _name_problems(source, entries, {*other_scenarios, *beside})
    if problems:
        raise ScenarioError(problems)
    return entries


def recorded_mistakes() -> list[Entry]:
    """Read the engines' mistakes that the project's own file records, those that no row shows included."""
    return [one for one in _load_entries(KNOWN_ISSUES_FILE) if one.is_wrong]


@cache
def project_known_issues() -> tuple[KnownIssue, ...]:
    """Read the project's own file of known issues, once in a process.

    Returns:
        The entries of `KNOWN_ISSUES_FILE`.

    Raises:
        ScenarioError: the file is not valid.

    """
    return tuple(load_known_issues())


def _id_problems(source: YamlSource, entries: Sequence[Entry], places: dict[str, str]) -> Iterator[Problem]:
    """Problems of ids that are used twice, in one file or in two."""
    for number, entry in enumerate(entries):
        path = (number, "id")
        ids = {entry.id, *(issue.id for issue in entry.every_issue())}
        if twice := sorted(ids & places.keys()):
            message = f"the id {shorten(repr(twice[0]))} is used twice, first at {places[twice[0]]}"
            yield _problem(source, path, message, "an id of its own")
        places.update(dict.fromkeys(ids - places.keys(), f"{source.file}:{source.value_positions[path][0]}"))


def _name_problems(source: YamlSource, entries: Sequence[Entry], others: set[str]) -> Iterator[Problem]:
    """Problems of names that nothing has."""
    known: dict[str, set[str]] = {
        "scenario": {
            *catalogue(),
            *others,
            f"{RANDOM_FAMILY}-1-1",
            *(f"{prefix}1-1" for prefix in (MOTION_PREFIX, MECHANISM_PREFIX)),
        },
        "engine": {*ENGINES, *IMPORTERS, *USER_ENGINES},
        "shown_by": set(ENGINES),
        "level": set(get_args(Level)),
        "integrator": {"-", *declared_integrators()},
        "quantity": _quantities(),
    }
    for number, entry in enumerate(entries):
        places: list[tuple[tuple[PathKey, ...], Selector]] = [((number,), entry)]
        places += [((number, "rows", i), selector) for i, selector in enumerate(entry.rows or ())]
        for (at, selector), (name, words) in product(places, known.items()):
            given = getattr(selector, name)
            for place, pattern in enumerate(given if isinstance(given, list) else [given]):
                if not pattern or pattern in words:
                    continue
                if not any(fnmatchcase(word, pattern) for word in words):
                    path: tuple[PathKey, ...] = (*at, name)
                    if (*path, place) in source.value_positions:
                        path = (*path, place)
                    hint = did_you_mean(pattern, sorted(words)) or f"`list` and the docs have every {name}"
                    yield _problem(source, path, f"no {name} matches {shorten(repr(pattern))}", hint=hint)


def _problem(
    source: YamlSource, path: tuple[PathKey, ...], message: str, valid: str = "", hint: str = ""
) -> Problem:
    place = source.value_positions.get(path) or source.value_positions[path[:1]]
    return Problem(source.file, *place, dotted_path(path), message, valid, hint)


def _quantities() -> set[str]:
    """Every quantity that a row may have, except of information."""
    return {
        "all", "order", SINGULAR_POSE, WELDED_HALVES, REVERSED_IN_TIME, REPEATABILITY,
        *STATE_UNITS, *SURFACE_QUANTITIES, *VARIANT_QUANTITIES, *MODEL_UNITS,
        *STEP_QUANTITIES, *CONSTRAINED_QUANTITIES, *RUN_QUANTITIES,
        *LIMITS, *INVARIANT_UNITS, *LONG_RUN_QUANTITIES,
        *REDESCRIPTIONS, *OTHER_FORMULATIONS, *(relation.name for relation in STATE_RELATIONS),
        *(f"by {text}" for text in declared_texts()),
    }  # fmt: skip


class KnownIssues:
    """The entries that apply to one run, and which of them its rows have used so far."""

    def __init__(self, entries: Sequence[KnownIssue], has_extra_refinements: bool) -> None:
        """Select the entries.

        Args:
            has_extra_refinements: whether the run takes smaller steps than usual.

        """
        self.issues = [e for e in entries if has_extra_refinements or not e.extra_refinements_only]
        self.has_extra_refinements = has_extra_refinements
        # entries that record what rows of states or steps show
        self._shown_by_states = {
            e.name for e in self.issues if e.level in DIAGNOSED_LEVELS and e.diagnosis is not None
        }
        self._by_engine: dict[str, list[KnownIssue]] = {}
        self._by_kind: dict[RowKind, list[KnownIssue]] = {}  # a cache: rows are many, kinds few
        self.used_ids: set[str] = set()
        self.matched_ids: set[str] = set()
        self.worst_ratios: dict[str, tuple[float, float]] = {}  # by id: worst ratio over covered, and covered

    def issues_for(self, row: Row) -> list[KnownIssue]:
        """Find the entries about a row's cell, whatever its verdict.

        Returns:
            The entries, in the order of the file; none for information, which needs no excuse.

        """
        if row.verdict == Verdict.INFORMATION:
            return []
        engine = row.engine_name
        kind = engine, row.engine_version, row.level, row.integrator, row.quantity
        if kind not in self._by_kind:
            if engine not in self._by_engine:
                self._by_engine[engine] = [e for e in self.issues if fnmatchcase(engine, e.engine)]
            self._by_kind[kind] = [e for e in self._by_engine[engine] if e.matches_kind(kind)]
        return [e for e in self._by_kind[kind] if fnmatchcase(row.scenario, e.scenario)]

    def mark_known(
        self, rows: Sequence[Row], bodies: int, inertia_ratio: float = 1.0, joints: Collection[str] = ()
    ) -> list[Row]:
        """Mark the rows whose verdict an entry expects.

        A row that is larger than its entry covers, or whose mechanism is another one, stays unmarked; its
        reason then says so.

        Args:
            rows: of one mechanism.
            bodies: their number.
            inertia_ratio: its `plumbline.model.invariants.inertia_ratio`.
            joints: kinds of its joints.

        Returns:
            The rows in the same order, with the entry's id as ``known_issue``; the entry's mechanism is their
            diagnosis where they have none.

        """
        scatter: dict[tuple[str, str], float] = {}
        for row in rows:
            if (size := _scatter_of(row)) is not None:
                engine = row.engine_name, row.engine_version
                scatter[engine] = max(size, scatter.get(engine, 0.0))
        chain = bodies, inertia_ratio
        marked = dict[int, Row]()
        compared, shown = set[tuple[str, str]](), set[tuple[str, str, str]]()  # engines at states and steps
        for place, row in sorted(enumerate(rows), key=lambda one: one[1].level in FOLLOWING_LEVELS):
            entries = [e for e in self.issues_for(row) if e.needs_of_mechanism_are_met(bodies, joints)]
            found = marked[place] = self._mark(
                row,
                entries,
                {e.id for e in entries if not self._is_shown(e, row, compared, shown)},
                chain,
                scatter,
            )
            if row.level in DIAGNOSED_LEVELS and Verdict(row.verdict).is_comparison:
                engine = row.engine_name, row.engine_version
                compared.add(engine)
                shown.add((*engine, found.known_issue or ""))
        return [marked[place] for place in range(len(rows))]

    def _is_shown(
        self, entry: KnownIssue, row: Row, compared: Set[tuple[str, str]], shown: Set[tuple[str, str, str]]
    ) -> bool:
        """Whether states or steps show what a row of a motion follows from, if the run compares them."""
        if row.level not in FOLLOWING_LEVELS or entry.name not in self._shown_by_states:
            return True
        engine = entry.shown_by or row.engine_name, row.engine_version
        return engine not in compared or (*engine, entry.name) in shown

    def _mark(
        self, row: Row, entries: Sequence[KnownIssue], unshown: Set[str], chain: tuple[int, float],
        scatter: Mapping[tuple[str, str], float],
    ) -> Row:  # fmt: skip
        self.matched_ids.update(e.id for e in entries)
        expecting = [e for e in entries if e.verdict == row.verdict]
        self.used_ids.update(e.id for e in expecting[:1])
        applicable = [e for e in expecting if e.id not in unshown]
        objections = [e.objection(row, e.covered_ratio(*chain), scatter) for e in applicable]
        if "" in objections:
            match = applicable[objections.index("")]
            self.used_ids.add(match.id)
            covered = match.covered_ratio(*chain)
            if row.ratio is not None and covered < math.inf:
                known = self.worst_ratios.get(match.id, (0.0, covered))
                self.worst_ratios[match.id] = max(known, (row.ratio / covered, covered))
            is_measured = bool(row.causes) and all(cause["kind"] == "rounding" for cause in row.causes)
            row = replace(row, known_issue=match.name, is_declared=False)
            if (row.diagnosis and not is_measured) or match.diagnosis is None:
                return replace(row, diagnosis=None if is_measured else row.diagnosis)
            checked, shown = "", match.scatter_of(row, scatter)
            if match.mechanism == "rounding" and shown is not None:
                checked = f"Checked: they differ by {shown:.2g} × tolerance."
            if match.mechanism == "missing term":
                left = row.extra[UNEXPLAINED]
                checked = f"Checked: what the term does not explain is {left:.2g} × tolerance."
            diagnosis = f"{match.diagnosis} {checked}".rstrip()
            return replace(row, diagnosis=diagnosis, extra=row.extra | {CHECKED: checked})
        return replace(row, reason=f"{row.reason}; {objections[0]}") if objections else row

    def wide_issues(self) -> list[str]:
        """Describe the entries that cover far more than the run has seen, and might hide another mistake.

        Returns:
            A sentence each, where the worst ratio is more than `WIDE_FACTOR` times below what is covered.

        """
        return [
            f"known entry {name} covers {share * covered:.2g} × tolerance of at most {covered:.2g}: "
            "a max_ratio nearer to what occurs hides less"
            for name, (share, covered) in self.worst_ratios.items()
            if share * WIDE_FACTOR < 1
        ]

    def stale_issues(self, *, is_full_matrix: bool) -> list[KnownIssue]:
        """Find the entries that match rows of the run and none of their verdicts.

        Smaller steps than usual may resolve what is recorded as unresolved: this is not stale.

        Args:
            is_full_matrix: whether all scenarios ran on all engines. If not, an entry with a pattern for its
                scenario is not stale: its case may be among the cells that did not run.

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
