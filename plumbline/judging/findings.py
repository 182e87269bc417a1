"""Findings: all rows of one engine that have one cause, in all its versions.

A row that disagrees belongs to the causes that the diagnosis of its cell names.  Causes are the same where
engine, term and change are, wherever in a mechanism they are; of what is unexplained, where engine, quantity
and needs are.  Rows of levels without a diagnosis follow from the causes of the same scenario and engine, at
steps of the same integrator or at states; one that names a call of the engine, only from a cause of its class
of quantities.  Recorded rows belong to their entry of known_issues.yaml.  Nothing of this depends on which
scenarios there are, so that another scenario renames no finding.
"""

from __future__ import annotations

import hashlib
import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from packaging.version import InvalidVersion, Version

from plumbline.diagnosis.cause import Cause, Condition, Occurrence, describe, join_words
from plumbline.judging.rows import PLACE, VERDICT_STYLES, WRONG_CALL, Row, Verdict
from plumbline.judging.state_level import STATE_UNITS
from plumbline.model.grouping import grouped

CLASSES = {  # of quantities, in the order in which one follows from another
    "accelerations": ("acceleration", "angular_acceleration"),
    "joint forces": ("joint_reaction", "joint_moment"),
    "energies": ("kinetic_energy", "potential_energy"),
    "momentum": ("angular_momentum",),
    "mass matrix": ("mass_matrix",),
}
MAX_NAME = 76  # characters of a name: a line of the terminal
SAME = 1e-6  # relative: amounts of one cause in two scenarios
NUMBER = re.compile(r"(?<![\w.])\d+(\.\d+)?(e[+-]?\d+)?(?!\w|\.\d)")  # no digits of a name or version
TRANSLITERATED = str.maketrans({"ω": "omega", "γ": "gamma", "×": " x "})
Identity = tuple[str, ...]


@dataclass(frozen=True)
class Finding:
    """Rows of one engine with one cause."""

    name: str  # unique in a run
    engine: str  # without a version
    verdict: Verdict  # the worst of its rows
    title: str  # half a sentence, as "joint reaction without the springs between points"
    sentence: str  # about the row of the smallest scenario
    known_issue: str | None  # the entry of known_issues.yaml that expects it
    rows: tuple[Row, ...]  # by size of the scenario, then the worst first
    cause: Cause | None = None  # of the smallest scenario
    identity: Identity = ()
    right_versions: tuple[str, ...] = ()  # compared in the same rows, which agree

    @property
    def versions(self) -> list[str]:
        """The versions that show it, in order."""
        return sorted({row.engine_version for row in self.rows}, key=version_order)

    @property
    def scenarios(self) -> list[str]:
        """Its scenarios, the smallest first."""
        return list(dict.fromkeys(row.scenario for row in self.rows))

    @property
    def quantities(self) -> list[str]:
        """The quantities of its rows."""
        return list(dict.fromkeys(row.quantity for row in self.rows))

    @property
    def largest_ratio(self) -> float | None:
        """The largest error in tolerances."""
        return max((row.ratio for row in self.rows if row.ratio is not None), default=None)

    @property
    def needs_attention(self) -> bool:
        """Whether no entry expects it."""
        return self.known_issue is None

    @property
    def version_range(self) -> str:
        """The versions in words."""
        versions = [version for version in self.versions if version]
        text = f"{versions[0]} to {versions[-1]}" if len(versions) > 1 else "".join(versions)
        return text + (f" (not {join_words(self.right_versions)})" if self.right_versions else "")

    def record(self) -> dict[str, Any]:
        """Return what results.json holds of it."""
        names = (
            "name", "engine", "verdict", "title", "sentence", "known_issue", "versions", "right_versions",
            "scenarios", "quantities", "largest_ratio", "identity",
        )  # fmt: skip
        found = {name: getattr(self, name) for name in names}
        found |= {name: list(found[name]) for name in ("right_versions", "identity")}
        return found | {"verdict": str(self.verdict), "rows": [row.key for row in self.rows]}


def version_order(text: str) -> tuple[bool, Version, str]:
    """Return a sort key of versions; what is none comes first."""
    try:
        return True, Version(text), text
    except InvalidVersion:
        return False, Version("0"), text


def quantity_class(quantities: Iterable[str]) -> str:
    """Return what is wrong first: wrong accelerations make joint forces wrong, too."""
    given = set(quantities)
    for name, members in CLASSES.items():
        if given & set(members):
            return name
    return " and ".join(sorted(given)).replace("_", " ")


def cause_of_record(record: Mapping[str, Any]) -> Cause:
    """Read a cause that a row holds as plain data."""
    plain: dict[str, Any] = {name: tuple(x) if isinstance(x, list) else x for name, x in record.items()}
    plain["equal"] = tuple(map(cause_of_record, record["equal"]))
    if where := record.get("occurrence"):
        conditions = tuple(Condition(**one) for one in where["conditions"])
        plain["occurrence"] = Occurrence(**where | {"conditions": conditions})
    return Cause(**plain)


def find_findings(rows: Iterable[Row], bodies: Mapping[str, int]) -> list[Finding]:
    """Group the rows that do not agree.

    Args:
        rows: of a run.
        bodies: number of bodies by scenario.

    Returns:
        The findings: those that nothing expects first, the worst before others.

    """
    every = list(rows)
    wrong = [row for row in every if Verdict(row.verdict).needs_attention and not row.is_declared]
    groups = _Groups()
    for row in wrong:
        if row.known_issue is not None:
            groups.add((row.known_issue,), row, known=True)
        elif row.verdict != Verdict.DISAGREES or row.level == "model":
            groups.add(_plain_identity(row), row)
    disputed = [row for row in wrong if row.known_issue is None and row.verdict == Verdict.DISAGREES]
    groups.add_causes([row for row in disputed if row.level != "model"])
    right = grouped(
        (row for row in every if row.verdict == Verdict.AGREES and "@" in row.engine), _cell_of_any_version
    )
    found = [group.finding(bodies, right) for group in groups.every()]
    found.sort(key=lambda f: (f.known_issue is not None, -VERDICT_STYLES[f.verdict].severity,
                              -(f.largest_ratio or 0.0), f.name))  # fmt: skip
    return _with_names(found)


def _cell_of_any_version(row: Row) -> tuple[str, ...]:
    return row.scenario, row.engine_name, row.level, row.integrator, row.quantity


def _plain_identity(row: Row) -> Identity:
    """Identity of what has no cause."""
    if row.verdict == Verdict.HARNESS_FAILED:
        return "", row.verdict, row.quantity
    if row.verdict in (Verdict.UNSUPPORTED, Verdict.FAILED):
        if place := row.extra.get(PLACE):  # one failure says other numbers of every mechanism
            return row.engine_name, row.verdict, str(place), NUMBER.sub("#", row.reason)
        return row.engine_name, row.verdict, str(row.extra.get(WRONG_CALL, row.reason))
    what = str(row.extra.get(WRONG_CALL, row.quantity))
    return row.engine_name, row.verdict, row.level, row.integrator, what


@dataclass
class _Group:
    """Rows with one identity while they are gathered."""

    engine: str
    identities: set[Identity]  # that explain all of its rows
    known: str | None = None
    rows: dict[str, Row] = field(default_factory=dict)  # by key
    causes: dict[str, Cause] = field(default_factory=dict)  # by key of the row

    def finding(self, bodies: Mapping[str, int], right: Mapping[tuple[str, ...], list[Row]]) -> Finding:
        """Make the finding."""

        def order_of(row: Row) -> tuple[Any, ...]:
            size = bodies.get(row.scenario, 0), row.scenario
            return row.key not in self.causes, *size, -(row.ratio or 0.0)

        order = sorted(self.rows.values(), key=order_of)
        first, shown = order[0], {row.engine_version for row in order}
        agreeing = (one for row in order for one in right.get(_cell_of_any_version(row), ()))
        versions = {one.engine_version for one in agreeing} - shown
        cause = self.causes.get(first.key)
        if cause is not None:
            cause = _candidate(cause, self.identities)
        identity = min(self.identities)
        return Finding(
            name="",
            engine=self.engine,
            verdict=max((Verdict(row.verdict) for row in order), key=lambda v: VERDICT_STYLES[v].severity),
            title=_title(identity, cause, first),
            sentence=first.reason if cause is None else describe([cause]),
            known_issue=self.known,
            rows=tuple(order),
            cause=cause,
            identity=(self.known,) if self.known else (self.engine, *identity),
            right_versions=tuple(sorted(versions, key=version_order)),
        )


def _candidate(cause: Cause, identities: set[Identity]) -> Cause:
    """The cause among those that the data cannot distinguish which all rows have in common."""
    every = (replace(cause, equal=()), *cause.equal)
    fitting = [one for one in every if _identity(one) in identities] or [every[0]]
    return replace(fitting[0], equal=tuple(fitting[1:]))


def _identity(cause: Cause) -> Identity:
    """What two rows with the same cause have in common, besides the engine."""
    if cause.kind == "rounding":
        return cause.kind, quantity_class(cause.quantities)
    if cause.kind == "unexplained":
        return cause.kind, quantity_class(cause.quantities) or cause.term, *cause.needs
    kind, term, change = cause.identity
    if kind == "output" and cause.quantities and set(cause.quantities) <= set(CLASSES["joint forces"]):
        term = "joint forces"  # one mistake in wrenches shows in both of their halves
    return kind, term, change


def _title(identity: Identity, cause: Cause | None, row: Row) -> str:
    if cause is None:
        if by := row.extra.get(WRONG_CALL):
            return f"{'wrong' if row.verdict == Verdict.DISAGREES else row.verdict} by {by}"
        what, by = row.quantity.replace("_", " "), "" if row.integrator == "-" else row.integrator
        if row.verdict == Verdict.DISAGREES:
            return f"{what}{by and f' of {by}'} at level {row.level}"
        return f"{row.verdict}: {what} at level {row.level}{by and f', {by}'}"
    kind, term, *rest = identity
    if kind == "rounding":
        return f"{term} lose digits"
    if kind == "unexplained":
        return f"wrong {term}" + (f" with {join_words(rest)}" if rest else "")
    if kind == "method":
        return f"{row.integrator}: {rest[0]}"
    return f"{term} {rest[0]}" if rest[0] else f"wrong {term}"


class _Groups:
    """The groups of a run."""

    def __init__(self) -> None:
        self._plain: dict[Identity, _Group] = {}
        self._of_causes: list[_Group] = []

    def every(self) -> list[_Group]:
        return [*self._plain.values(), *self._of_causes]

    def add(self, identity: Identity, row: Row, *, known: bool = False) -> None:
        """Add a row of a group that has no cause, or is recorded."""
        engine = "" if row.verdict == Verdict.HARNESS_FAILED and not known else row.engine_name
        group = self._plain.setdefault(
            identity, _Group(engine, {identity[1:]}, identity[0] if known else None)
        )
        group.rows[row.key] = row

    def add_causes(self, rows: Sequence[Row]) -> None:
        """Add rows that disagree: those with causes, the least ambiguous first, then those that follow."""
        named: list[tuple[Row, Cause]] = []
        left: list[Row] = []
        for row in rows:
            own = [cause for cause in map(cause_of_record, row.causes) if _is_about(cause, row)]
            named += [(row, cause) for cause in own]
            if not own:
                left.append(row)
        of_cells: dict[tuple[str, ...], list[tuple[Cause, _Group]]] = {}
        for row, cause in sorted(named, key=lambda one: len(one[1].equal)):
            group = self._group_of(row.engine_name, cause)
            group.rows[row.key], group.causes[row.key] = row, cause
            of_cells.setdefault((row.scenario, row.engine, row.integrator), []).append((cause, group))
        for row in left:
            at = row.scenario, row.engine
            causes = of_cells.get((*at, row.integrator)) or of_cells.get((*at, "-"), [])
            followed = [group for cause, group in causes if _may_follow(row, cause)]
            for group in followed:
                group.rows[row.key] = row
            if not followed:
                self.add(_plain_identity(row), row)
        self._of_causes = [part for group in self._of_causes for part in _by_amount(group)]

    def _group_of(self, engine: str, cause: Cause) -> _Group:
        identities = {_identity(one) for one in (cause, *cause.equal)}
        for group in self._of_causes:
            if group.engine == engine and group.identities & identities:
                group.identities &= identities
                return group
        group = _Group(engine, identities)
        self._of_causes.append(group)
        return group


def _is_about(cause: Cause, row: Row) -> bool:
    """Whether a cause of a cell explains one of its rows, or says that it has no explanation."""
    if cause.kind == "unexplained" and cause.change:
        return False  # too close to the bound, or not diagnosed: it may follow from another cause
    return not cause.quantities or row.quantity in cause.quantities


def _may_follow(row: Row, cause: Cause) -> bool:
    """Whether a row without a cause may follow from one of its cell; a call's, only where it is of its class.

    A quantity of the surface is in the classes of the state quantities with its unit.
    """
    if WRONG_CALL not in row.extra or not cause.quantities:
        return True
    alike = {quantity for quantity, unit in STATE_UNITS.items() if unit == row.unit}
    return any(alike & set(some) and set(cause.quantities) & set(some) for some in CLASSES.values())


def _by_amount(group: _Group) -> list[_Group]:
    """Split a group whose amounts are neither one factor, nor one difference, nor one number."""
    amounts = {
        key: (cause.amount[0], cause.nominal[0], cause.uncertainty or 0.0)
        for key, cause in group.causes.items()
        if len(cause.amount) == len(cause.nominal) == 1 and not cause.change and None not in cause.amount
    }
    factors = {key: (x / y, u / abs(y)) for key, (x, y, u) in amounts.items() if y}
    ways = [
        _classes(factors | dict.fromkeys(amounts.keys() - factors.keys(), (math.inf, 0.0))),
        _classes({key: (x - y, u) for key, (x, y, u) in amounts.items()}),
        _classes({key: (x, u) for key, (x, _, u) in amounts.items()}),
    ]
    classes = min(ways, key=len)
    if len(classes) <= 1:
        return [group]
    parts = []
    for number, keys in enumerate(classes):
        others = {key for one in classes for key in one} - set(keys)
        kept = {key: row for key, row in group.rows.items() if key not in others}
        if number:  # what has no amount follows from the first
            kept = {key: row for key, row in kept.items() if key in keys}
        causes = {key: group.causes[key] for key in kept if key in group.causes}
        parts.append(replace(group, rows=kept, causes=causes))
    return parts


def _classes(values: Mapping[str, tuple[float, float]]) -> list[list[str]]:
    """Keys of equal numbers, within their uncertainties."""
    classes: list[tuple[float, list[str]]] = []
    for key, (x, uncertainty) in sorted(values.items(), key=lambda one: one[1]):
        if classes and abs(x - classes[-1][0]) <= max(SAME * abs(x), 4 * uncertainty):
            classes[-1][1].append(key)
        else:
            classes.append((x, [key]))
    return [keys for _, keys in classes]


def _with_names(found: Sequence[Finding]) -> list[Finding]:
    """Name the findings: a recorded one as its entry, others by engine and cause."""
    wanted = [f.known_issue or _slug(f"{f.engine} {f.title}") for f in found]
    names = []
    for finding, name in zip(found, wanted, strict=True):
        is_shared, amount = wanted.count(name) > 1, finding.cause and finding.cause.amount
        if finding.known_issue is None and (is_shared or len(name) > MAX_NAME):
            digest = repr((finding.identity, amount if is_shared else None))
            name = f"{name[: MAX_NAME - 5].rstrip('-')}-{hashlib.sha256(digest.encode()).hexdigest()[:4]}"
        names.append(name)
    return [replace(finding, name=name) for finding, name in zip(found, names, strict=True)]


def _slug(text: str) -> str:
    """A name of letters, digits and hyphens."""
    plain = unicodedata.normalize("NFKD", text.translate(TRANSLITERATED)).encode("ascii", "ignore").decode()
    words = [
        word for word in re.findall(r"[a-z0-9.]+", plain.lower()) if word not in ("the", "a", "an", "it")
    ]
    return "-".join(words)
