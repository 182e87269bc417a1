"""The drift table: what is measured, what is left out for its cost, and what the report shows of it."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from click.testing import CliRunner

from plumbline.cli.main import main
from plumbline.scenario import loader as scenarios
from plumbline.storage.results_store import DRIFT_TABLE
from plumbline.studies import drift
from reference_impl.stabilised import VARIANTS


def measure_drift(names, longest, **options):
    found: list[dict[str, Any]] = drift.measure_drift(
        scenarios.load_scenarios(names), longest, rtols=(1e-6,), **options
    ).to_pylist()
    return found


def test_every_variant_and_time_has_a_row_and_the_drift_is_the_raw_one(tmp_path):
    reported: list[str] = []
    rows = measure_drift(["tumbling-ball"], 60, times=(1.0, 10.0), log=reported.append)
    assert [(row["variant"], row["time"]) for row in rows] == [(v, t) for v in VARIANTS for t in (1.0, 10.0)]
    late = {row["variant"]: row for row in rows if row["time"] == 10.0}
    assert late["raw"]["gap"] > 10 * late["baumgarte"]["gap"] > 1e-11
    assert late["projected"]["gap"] < 1e-14
    assert all(0 < row["energy"] < 1e-5 and row["cpu_seconds"] > 0 and not row["reason"] for row in rows)
    assert len(reported) == len(VARIANTS)
    assert all("to 10 s, about" in sentence for sentence in reported)


def test_a_time_that_costs_too_much_is_left_out_with_a_reason():
    rows = measure_drift(["tumbling-ball"], 0.001, times=(1.0, 10.0))
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        assert first["gap"] is not None
        assert first["reason"] == ""
        assert second["gap"] is None
        assert "left out: would cost" in second["reason"]


def test_a_run_that_fails_is_a_row_with_its_reason():
    (s,) = scenarios.load_scenarios(["tumbling-ball"])
    massless = replace(s, model=replace(s.model, mass=np.zeros(1)))
    rows = drift.measure_drift([massless], 60, times=(1.0, 10.0), rtols=(1e-6,)).to_pylist()
    assert len(rows) == 2 * len(VARIANTS)
    assert all(row["gap"] is None and "failed: the mass of body 1" in row["reason"] for row in rows)


def test_the_command_writes_the_table(tmp_path, monkeypatch):
    quick = functools.partial(drift.measure_drift, times=(0.5, 1.0))
    monkeypatch.setattr(drift, "measure_drift", quick)
    ran = CliRunner().invoke(main, ["drift", "tumbling-rod", "--rtol", "1e-6", "--out", str(tmp_path)])
    assert ran.exit_code == 0, ran.output
    kept = pq.read_table(tmp_path / "drift.parquet")
    assert kept.schema.names == DRIFT_TABLE.names
    assert {(row["time"], row["rtol"]) for row in kept.to_pylist()} == {(0.5, 1e-6), (1.0, 1e-6)}
    assert "baumgarte" in ran.output
    assert CliRunner().invoke(main, ["drift", "no-such-thing", "--out", str(tmp_path)]).exit_code == 2
