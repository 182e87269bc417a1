"""The history of runs: DuckDB over the summary tables of a folder of complete runs.

A night is a folder with results.json and summary.parquet, which `plumbline nightly` and every `plumbline run`
write.  A row is bad where it does not agree and no known issue expects that.  Random scenarios are new every
night, so only their counts are compared.  The command `history` and the report both read this history.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plumbline.scenario.generator import RANDOM_FAMILY
from plumbline.scenario.line_and_column_errors import shorten
from plumbline.storage.results_schema import VERDICT_WORDS, DamagedResults
from plumbline.storage.results_store import Record, read_results, read_table

UNEXPECTED_VERDICT_SQL = "verdict NOT IN ('agrees', 'information') AND known_issue IS NULL"
MAX_REASON = 500  # letters of what is wrong with a damaged night
_ROW_COLUMNS = {
    "key": "VARCHAR", "scenario": "VARCHAR", "family": "VARCHAR", "engine": "VARCHAR", "level": "VARCHAR",
    "quantity": "VARCHAR", "unit": "VARCHAR", "value": "DOUBLE", "tolerance": "DOUBLE", "ratio": "DOUBLE",
    "verdict": "VARCHAR", "known_issue": "VARCHAR", "reason": "VARCHAR",
}  # fmt: skip


@dataclass(frozen=True)
class StoredRun:
    """One complete run of a history."""

    folder: Path
    metadata: Record  # the entry ``run`` of results.json
    findings: list[Record] = field(default_factory=list)

    @property
    def id(self) -> str:
        """Identifier of the run."""
        return str(self.metadata["id"])

    @property
    def has_passed(self) -> bool:
        """Whether the run ended with exit code 0."""
        return bool(self.metadata["exit_code"] == 0)

    @property
    def order(self) -> tuple[int, str]:
        """Sort key: the night's number, which the clock does not change; only runs without one go by time."""
        return int(self.metadata.get("night", 0)), str(self.metadata["started"])


def night_folders(folder: Path) -> list[Path]:
    """List the folders of the stored runs of a history, readable or not.

    Args:
        folder: folder of runs, or a nightly's output folder, whose runs are in ``history``.

    Returns:
        The folders, by name.

    """
    inside = folder / "history"
    return sorted(path.parent for path in (inside if inside.is_dir() else folder).glob("*/results.json"))


class History:
    """The nights of a folder, oldest first, and queries over them.

    Attributes:
        nights: the readable runs, in the order in which they were completed.
        damaged: reason by folder name of each run that was left out.

    """

    def __init__(self, folder: Path) -> None:
        """Read a history.

        Args:
            folder: folder of runs, or a nightly's output folder, whose runs are in ``history``.

        """
        import duckdb  # of the group `history`: the report of a run does without

        self.nights: list[StoredRun] = []
        self.damaged: dict[str, str] = {}
        self._database = duckdb.connect()
        for path in night_folders(folder):
            try:
                self.nights.append(_read_complete_run(path))
            except (OSError, DamagedResults) as error:
                self.damaged[path.name] = shorten(" ".join(str(error).split()), MAX_REASON)
        self.nights.sort(key=lambda night: night.order)
        self._load_tables()

    def before(self, run_id: str) -> list[tuple[int, StoredRun]]:
        """List the nights before a run; all of them where the run is not in this history.

        Returns:
            Index in ``nights`` and run, oldest first.

        """
        ids = [night.id for night in self.nights]
        end = ids.index(run_id) if run_id in ids else len(ids)
        return list(enumerate(self.nights[:end]))

    def rows_by_key(self, night: int, keys: Sequence[str]) -> dict[str, Record]:
        """Look rows of one night up.

        Args:
            night: index in ``nights``.

        Returns:
            Value, tolerance, ratio, verdict and known issue by key, of the keys that the night has.

        """
        found = self.query(
            "SELECT key, value, tolerance, ratio, verdict, known_issue FROM rows"
            " WHERE night = ? AND key IN (SELECT unnest(?::VARCHAR[]))",
            [night, list(keys)],
        )
        return {row["key"]: row for row in found}

    def _load_tables(self) -> None:
        self._database.execute(
            "CREATE TABLE nights (night INTEGER, id VARCHAR, started VARCHAR, exit_code INTEGER)"
        )
        columns = ", ".join(f"{name} {kind}" for name, kind in _ROW_COLUMNS.items())
        self._database.execute(f"CREATE TABLE rows (night INTEGER, {columns})")
        for index, night in enumerate(self.nights):
            about = night.metadata
            self._database.execute(
                "INSERT INTO nights VALUES (?, ?, ?, ?)",
                [index, night.id, about["started"], about["exit_code"]],
            )
            self._database.register("summary", read_table(night.folder, "summary"))
            self._database.execute(f"INSERT INTO rows SELECT {index}, {', '.join(_ROW_COLUMNS)} FROM summary")
            self._database.unregister("summary")

    def query(self, query: str, parameters: list[Any] | None = None) -> list[Record]:
        """Run a query over the tables ``nights`` and ``rows``.

        Args:
            parameters: values of the question marks in the query.

        Returns:
            One record per row of the answer.

        """
        answer = self._database.execute(query, parameters or [])
        names = [column[0] for column in answer.description or ()]
        return [dict(zip(names, row, strict=True)) for row in answer.fetchall()]

    def overview(self) -> list[Record]:
        """Count the rows of every night.

        Returns:
            One record per night: its id, start and exit code, the number of rows, of those that agree
            (``agree``), are implied by others (``information``), are unexpectedly bad (``bad``), or are as a
            known issue expects (``as_recorded``), and the number of random scenarios.

        """
        return self.query(
            f"""
            SELECT id, started, exit_code, count(key) AS rows,
                   count(*) FILTER (verdict = 'agrees') AS agree,
                   count(*) FILTER (verdict = 'information') AS information,
                   count(*) FILTER ({UNEXPECTED_VERDICT_SQL}) AS bad,
                   count(*) FILTER (known_issue IS NOT NULL) AS as_recorded,
                   count(DISTINCT scenario) FILTER (family = '{RANDOM_FAMILY}') AS random
            FROM nights LEFT JOIN rows USING (night) GROUP BY night, id, started, exit_code ORDER BY night
            """
        )

    def trend(self, pattern: str) -> list[Record]:
        """Follow rows over the nights.

        Args:
            pattern: pattern of row keys, with * and ?.

        Returns:
            One record per key and night: value, tolerance, unit, ratio and verdict.

        """
        return self.query(
            """
            SELECT key, id, started, value, tolerance, unit, ratio, verdict
            FROM rows JOIN nights USING (night) WHERE key GLOB ? ORDER BY key, night
            """,
            [pattern.encode("utf-8", "replace").decode()],  # what is no UTF-8 text matches no key
        )

    def first_bad(self) -> list[Record]:
        """Find since when the rows that are bad in the last night are bad.

        Returns:
            One record per key: verdict, reason, the id of the first bad night since the last good one
            (``first_bad``) and of that good one (``last_good``, None where there is none).

        """
        return self.query(
            f"""
            WITH known_keys AS (
                     SELECT *, ({UNEXPECTED_VERDICT_SQL}) AS bad FROM rows WHERE family <> '{RANDOM_FAMILY}'
                 ),
                 good AS (SELECT key, max(night) AS last_good FROM known_keys WHERE NOT bad GROUP BY key),
                 streak AS (
                     SELECT key, min(night) AS first, any_value(last_good) AS last_good
                     FROM known_keys LEFT JOIN good USING (key)
                     WHERE bad AND night > coalesce(last_good, -1) GROUP BY key
                 ),
                 now AS (SELECT * FROM known_keys WHERE bad AND night = (SELECT max(night) FROM nights))
            SELECT now.key, now.verdict, now.reason, first.id AS first_bad, good_night.id AS last_good
            FROM now JOIN streak USING (key) JOIN nights AS first ON first.night = streak.first
            LEFT JOIN nights AS good_night ON good_night.night = streak.last_good ORDER BY now.key
            """
        )

    def changes_since_green(self) -> tuple[str | None, list[Record]]:
        """Compare the last night with the last night before it that passed.

        Returns:
            The id of the night that passed (None where there is none), and one record per key whose verdict
            differs: both verdicts (``was``, ``is``), both values, and the reason now.

        """
        green = self.query(
            "SELECT night, id FROM nights WHERE exit_code = 0 AND night < (SELECT max(night) FROM nights)"
            " ORDER BY night DESC LIMIT 1"
        )
        if not green:
            return None, []
        changes = self.query(
            f"""
            WITH before AS (SELECT * FROM rows WHERE night = ? AND family <> '{RANDOM_FAMILY}'),
                 now AS (
                     SELECT * FROM rows
                     WHERE night = (SELECT max(night) FROM nights) AND family <> '{RANDOM_FAMILY}'
                 )
            SELECT key, before.verdict AS was, now.verdict AS "is", before.value AS value_was,
                   now.value AS value_is, now.reason
            FROM before FULL JOIN now USING (key)
            WHERE before.verdict IS DISTINCT FROM now.verdict ORDER BY key
            """,
            [green[0]["night"]],
        )
        return green[0]["id"], changes

    def findings(self) -> list[Record]:
        """Follow the findings over the nights.

        Returns:
            One record per finding, present ones first: ``state`` in the last night (new, present, recorded or
            gone), ids of the nights in which it was ``first_seen`` and ``last_seen``, in how many ``nights``,
            the ``versions`` that showed it, and of the last sight its sentence.

        """
        lives: dict[str, Record] = {}
        for index, night in enumerate(self.nights):
            for finding in night.findings:
                life = lives.setdefault(
                    finding["name"],
                    {
                        "finding": finding["name"],
                        "state": "",
                        "first_seen": night.id,
                        "nights": 0,
                        "versions": [],
                    },
                )
                life["versions"] = list(dict.fromkeys([*life["versions"], *finding["versions"]]))
                life |= {"last_seen": night.id, "nights": life["nights"] + 1, "sentence": finding["sentence"]}
                life["state"] = "gone" if index < len(self.nights) - 1 else _state(finding, life)
        order = ("new", "present", "recorded", "gone")
        return sorted(lives.values(), key=lambda life: order.index(life["state"]))

    def version_changes(self) -> list[str]:
        """List the changes of the engines' versions from one night to the next.

        Returns:
            One sentence per change.

        """
        found = []
        for before, now in itertools.pairwise(self.nights):
            for engine, version in now.metadata["versions"].items():
                old = before.metadata["versions"].get(engine)
                if old not in (None, version):
                    found.append(f"{now.id}: {engine} {old} → {version}")
        return found

    def to_document(self, pattern: str | None = None) -> Record:
        """Collect everything that the command `history` reports.

        Args:
            pattern: pattern of row keys to follow over the nights; None for no trend.

        Returns:
            Plain data that JSON can hold.

        """
        green, changes = self.changes_since_green()
        document: Record = {
            "nights": self.overview(),
            "damaged": [f"{name}: {reason}" for name, reason in self.damaged.items()],
            "versions": self.version_changes(),
            "findings": self.findings(),
            "first_bad": self.first_bad(),
            "last_green": green,
            "since_green": changes,
        }
        if pattern is not None:
            document["trend"] = self.trend(pattern)
        return json.loads(json.dumps(document, default=str))  # type: ignore[no-any-return]


def stored_runs(folder: Path, log: Callable[[str], None] = lambda _: None) -> Iterator[StoredRun]:
    """Read the runs of a folder whose results.json is readable.

    Args:
        folder: as of `night_folders`.
        log: gets a line for each run that is left out.

    Yields:
        One run at a time, in the order of the folders' names.

    """
    for path in night_folders(folder):
        try:
            document = read_results(path)
        except (OSError, DamagedResults) as error:
            log(f"damaged, left out: {path.name}: {shorten(' '.join(str(error).split()), MAX_REASON)}")
        else:
            yield StoredRun(path, document["run"], document["findings"])


def next_night_number(folder: Path) -> int:
    """Return the number of a new night: nights are ordered by it, whatever the clock shows.

    Returns:
        One more than the highest number there.

    """
    return 1 + max((int(run.metadata.get("night", 0)) for run in stored_runs(folder)), default=0)


def _read_complete_run(folder: Path) -> StoredRun:
    """Read a run's metadata; raise DamagedResults where results.json or the summary is damaged."""
    document = read_results(folder)
    run = StoredRun(folder, document["run"], document["findings"])
    table = read_table(folder, "summary")
    expected = len(document["rows"])
    expected += sum((run.metadata["random_batch"] or {}).get("counts_by_verdict", {}).values())
    if len(table) != expected:
        raise DamagedResults(f"summary.parquet has {len(table)} rows, results.json expects {expected}")
    if unknown := set(table["verdict"].unique().to_pylist()) - VERDICT_WORDS:
        raise DamagedResults(
            f"summary.parquet has the verdict {shorten(repr(min(unknown)))}, which no run gives"
        )
    return run


def last_findings(folder: Path, log: Callable[[str], None] = lambda _: None) -> frozenset[str]:
    """Return the names of the findings of the last night of a folder; none where it has no night."""
    last = max(stored_runs(folder, log), key=lambda run: run.order, default=None)
    return frozenset() if last is None else frozenset(finding["name"] for finding in last.findings)


def _state(finding: Record, life: Record) -> str:
    """What a finding of the last night is."""
    if finding["known_issue"] is not None:
        return "recorded"
    return "new" if life["nights"] == 1 else "present"
