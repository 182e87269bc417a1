"""What the nights say together: DuckDB over the summary tables of a folder of complete runs.

A night is a folder with results.json and summary.parquet (`plumbline.cli.nightly` makes them; so does every
`run`).  A row is bad where it does not agree and no known entry expects that.  Random scenarios are new
every night, so only their counts are compared.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb

from plumbline.scenario.generator import RANDOM_FAMILY
from plumbline.storage.results_store import read_results

UNEXPECTED_VERDICT_SQL = "verdict <> 'agrees' AND known IS NULL"
Record = dict[str, Any]


@dataclass(frozen=True)
class StoredRun:
    """One complete run."""

    id: str
    started: str  # ISO 8601
    exit_code: int
    sentence: str
    versions: dict[str, str]
    folder: Path
    number: int = 0  # a night's, in the order in which they were made; 0 of other runs


class History:
    """The nights of a folder, oldest first, and questions about them."""

    def __init__(self, folder: Path) -> None:
        """Read HISTORY/*/; of OUT, its folder ``history``. ``damaged`` says of each night left out why."""
        inside = folder / "history"
        self.nights: list[StoredRun] = []
        self.damaged: list[str] = []
        self.database = duckdb.connect()
        for path in sorted((inside if inside.is_dir() else folder).glob("*/results.json")):
            try:
                self.nights.append(self._read_run(path.parent))
            except (OSError, ValueError, KeyError, TypeError, duckdb.Error) as error:
                self.damaged.append(f"{path.parent.name}: {' '.join(str(error).split())}")
        self.nights.sort(key=lambda night: (night.number, night.started))
        self._load_tables()

    def _read_run(self, folder: Path) -> StoredRun:
        document = read_results(folder)
        run = document["run"]
        night = StoredRun(
            str(run["id"]), str(run["started"]), int(run["exit_code"]), str(run["sentence"]),
            {str(k): str(v) for k, v in run["versions"].items()}, folder, int(run.get("night", 0)),
        )  # fmt: skip
        table = str(folder / "summary.parquet")
        (stored,) = self._query_one("SELECT count(key) + 0 * count(verdict) FROM read_parquet(?)", [table])
        told = len(document["rows"]) + sum(run.get("probes", {}).get("folded", {}).values())
        if stored != told:
            raise ValueError(f"summary.parquet has {stored} rows, results.json tells of {told}")
        return night

    def _load_tables(self) -> None:
        self.database.execute(
            "CREATE TABLE nights (night INTEGER, id VARCHAR, started VARCHAR, exit_code INTEGER)"
        )
        columns = (
            "key, scenario, family, engine, level, quantity, unit, value, tolerance, verdict, known, reason"
        )
        self.database.execute(
            "CREATE TABLE rows (night INTEGER, key VARCHAR, scenario VARCHAR, family VARCHAR, engine VARCHAR,"
            " level VARCHAR, quantity VARCHAR, unit VARCHAR, value DOUBLE, tolerance DOUBLE, verdict VARCHAR,"
            " known VARCHAR, reason VARCHAR)"
        )
        for index, night in enumerate(self.nights):
            self.database.execute(
                "INSERT INTO nights VALUES (?, ?, ?, ?)", [index, night.id, night.started, night.exit_code]
            )
            table = str(night.folder / "summary.parquet")
            self.database.execute(
                f"INSERT INTO rows SELECT ?, {columns} FROM read_parquet(?)", [index, table]
            )

    def _query_one(self, query: str, parameters: list[Any]) -> tuple[Any, ...]:
        found = self.database.execute(query, parameters).fetchone()
        assert found is not None
        return tuple(found)

    def query(self, query: str, parameters: list[Any] | None = None) -> list[Record]:
        """Rows of a query over the tables ``nights`` and ``rows``, as records."""
        answer = self.database.execute(query, parameters or [])
        names = [column[0] for column in answer.description or ()]
        return [dict(zip(names, row, strict=True)) for row in answer.fetchall()]

    def overview(self) -> list[Record]:
        """One record per night: counts of verdicts, of what nothing expects, and how it ended."""
        return self.query(
            f"""
            SELECT id, started, exit_code, count(key) AS rows,
                   count(*) FILTER (verdict = 'agrees') AS agree,
                   count(*) FILTER ({UNEXPECTED_VERDICT_SQL}) AS bad,
                   count(*) FILTER (known IS NOT NULL) AS as_recorded,
                   count(DISTINCT scenario) FILTER (family = '{RANDOM_FAMILY}') AS random
            FROM nights LEFT JOIN rows USING (night) GROUP BY night, id, started, exit_code ORDER BY night
            """
        )

    def trend(self, pattern: str) -> list[Record]:
        """Value, tolerance and verdict of every row whose key matches ``pattern`` (* and ?), by night."""
        return self.query(
            """
            SELECT key, id, started, value, tolerance, unit, value / nullif(tolerance, 0) AS ratio, verdict
            FROM rows JOIN nights USING (night) WHERE key GLOB ? ORDER BY key, night
            """,
            [pattern],
        )

    def first_bad(self) -> list[Record]:
        """Every key that was bad in the last night: its first bad night since it was last good."""
        return self.query(
            f"""
            WITH known_keys AS (SELECT *, ({UNEXPECTED_VERDICT_SQL}) AS bad FROM rows WHERE family <> '{RANDOM_FAMILY}'),
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
        """The id of the last green night before the last one, and every key whose verdict is another now."""
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

    def version_changes(self) -> list[str]:
        """A sentence for every change of an engine's version from one night to the next."""
        found = []
        for before, now in zip(self.nights, self.nights[1:], strict=False):
            for engine, version in now.versions.items():
                old = before.versions.get(engine)
                if old not in (None, version):
                    found.append(f"{now.id}: {engine} {old} → {version}")
        return found

    def to_document(self, pattern: str | None = None) -> Record:
        """Everything as plain data."""
        green, changes = self.changes_since_green()
        document: Record = {
            "nights": self.overview(),
            "damaged": self.damaged,
            "versions": self.version_changes(),
            "first_bad": self.first_bad(),
            "last_green": green,
            "since_green": changes,
        }
        if pattern is not None:
            document["trend"] = self.trend(pattern)
        return json.loads(json.dumps(document, default=str))  # type: ignore[no-any-return]
