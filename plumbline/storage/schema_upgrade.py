"""Results of earlier schema versions, renamed to the present names when they are read."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import pyarrow as pa

from plumbline.judging.findings import Finding, find_findings
from plumbline.judging.rows import Row, Verdict, error_ratio
from plumbline.model.datatypes import Model, State
from plumbline.model.kinematics import complete_state

Record = dict[str, Any]  # plain data, as JSON holds them

# Names of schema version 1 and their present names.
_ROW_NAMES = {
    "horizon": "compared_until",
    "known": "known_issue",
    "accept": "user_rtol",
    "wall_time": "cpu_time",
}
_INTEGRATOR_NAMES = {
    "powers": "error_exponents",
    "symmetric": "is_symmetric",
    "solver": "solver_rtol",
    "tightest": "min_rtol",
}
_DECLARED, _PROVED = "declared: ", "proved: "  # how gaps and truths of certificates began before version 6
_RUN_NAMES = {"probes": "random_batch", "instrument": "self_test", "stale": "stale_issues"}
_RANDOM_BATCH_NAMES = {"folded": "counts_by_verdict", "worst": "worst_ratios"}


def upgrade_document(document: Record) -> Record:
    """Bring the document of a results.json of an earlier version to the present one.

    Returns:
        The document with the present names.  In version 1 the ratio of a row was in its ``extra``, or
        followed from its value and tolerance; before version 3 causes were sentences only, before 4 nothing
        was grouped by cause, before 5 chains had fields of their own, and before 6 only the
        first words of a text told whether a gap is declared and a motion proved.

    """
    if document["schema_version"] == 1:
        document = _upgrade_first(document)
    if document["schema_version"] == 2:
        rows = [row | {"causes": []} for row in document["rows"]]
        document = document | {"schema_version": 3, "rows": rows}
    if document["schema_version"] < 6:
        rows = [row | _expected_by(row["known_issue"]) for row in document["rows"]]
        document = document | {"rows": rows}
    if document["schema_version"] == 3:
        found = findings_of_records(document["rows"], document["scenarios"])
        document = document | {"schema_version": 4, "findings": [finding.record() for finding in found]}
    if document["schema_version"] == 4:
        scenarios = {name: _with_joints(about) for name, about in document["scenarios"].items()}
        document = document | {"schema_version": 5, "scenarios": scenarios}
    if document["schema_version"] == 5:
        scenarios = {
            name: about | {"is_proved": (about.get("truth") or "").startswith(_PROVED)}
            for name, about in document["scenarios"].items()
        }
        document = document | {"schema_version": 6, "scenarios": scenarios}
    return document


def _expected_by(known_issue: str | None) -> Record:
    """What expects a verdict, and whether it is a gap that the engine's column declares."""
    text = known_issue or ""
    is_declared = text.startswith(_DECLARED)
    return {"known_issue": text.removeprefix(_DECLARED) or None, "is_declared": is_declared}


def _with_joints(about: Record) -> Record:
    """A scenario whose chain has the fields that all mechanisms have."""
    old = about.get("model")
    if old is None or "kind" in old:
        return about
    arrays = {name: np.array(value, float) for name, value in {**old, **about["state"]}.items()}
    model = Model.chain(**{name: arrays[name] for name in old})
    state = complete_state(model, State(**{name: arrays[name] for name in ("p", "omega", "u", "udot")}))
    fields = {name: np.asarray(value).tolist() for name, value in model.fields.items()}
    return about | {"model": fields, "state": {name: x.tolist() for name, x in vars(state).items()}}


def findings_of_records(rows: Iterable[Record], scenarios: Mapping[str, Record]) -> list[Finding]:
    """Find the findings of stored rows.

    Args:
        rows: of results.json.
        scenarios: of results.json.

    """
    names = [one.name for one in fields(Row)]
    every = [
        Row(**{name: row[name] for name in names} | {"verdict": Verdict(row["verdict"])})
        for row in rows
        if row["verdict"] not in (Verdict.AGREES, Verdict.INFORMATION) or "@" in row["engine"]
    ]
    return find_findings(every, {name: about["bodies"] for name, about in scenarios.items()})


def _upgrade_first(document: Record) -> Record:
    """The names of version 2."""
    run = _rename(document["run"], _RUN_NAMES)
    if "random_batch" in run:
        run["random_batch"] = _rename(run["random_batch"], _RANDOM_BATCH_NAMES)
    engines = {
        name: engine
        | {"integrators": [_rename(one, _INTEGRATOR_NAMES) for one in engine.get("integrators", [])]}
        for name, engine in document["engines"].items()
    }
    rows = []
    for stored in document["rows"]:
        row = _rename(stored, _ROW_NAMES)
        row["extra"], row["ratio"] = _split_ratio(row)
        rows.append(row)
    return document | {"schema_version": 2, "run": run, "engines": engines, "rows": rows}


def upgrade_summary(table: pa.Table) -> pa.Table:
    """Bring a summary table of an earlier version to the present one.

    Args:
        table: the content of summary.parquet, all columns.

    Returns:
        The table with the present names and the columns ``ratio``, ``causes`` and ``is_declared``.

    """
    if "ratio" not in table.column_names:
        table = _upgrade_first_summary(table)
    if "causes" not in table.column_names:
        table = table.append_column("causes", pa.array(["[]"] * len(table), pa.string()))
    if "is_declared" not in table.column_names:
        split = [_expected_by(text) for text in table.column("known_issue").to_pylist()]
        names = pa.array([one["known_issue"] for one in split], pa.string())
        table = table.set_column(table.column_names.index("known_issue"), "known_issue", names)
        are_declared = pa.array([one["is_declared"] for one in split], pa.bool_())
        table = table.append_column("is_declared", are_declared)
    return table


def _upgrade_first_summary(table: pa.Table) -> pa.Table:
    """The names of version 2."""
    table = table.rename_columns([_ROW_NAMES.get(name, name) for name in table.column_names])
    records = table.select(["value", "tolerance", "extra"]).to_pylist()
    split = [_split_ratio(record | {"extra": json.loads(record["extra"])}) for record in records]
    extra = pa.array([json.dumps(extra) for extra, _ in split], pa.string())
    table = table.set_column(table.column_names.index("extra"), "extra", extra)
    return table.append_column("ratio", pa.array([ratio for _, ratio in split], pa.float64()))


def _split_ratio(row: Record) -> tuple[Record, float | None]:
    """The ``extra`` of a row of version 1 without its ratio, and the ratio."""
    extra = dict(row["extra"])
    ratio = extra.pop("ratio", None)
    return extra, error_ratio(row["value"], row["tolerance"]) if ratio is None else ratio


def _rename(record: Record, names: dict[str, str]) -> Record:
    return {names.get(key, key): value for key, value in record.items()}
