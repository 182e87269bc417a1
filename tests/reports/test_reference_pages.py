"""The report's sections on the reference (drift, cost) and the sweep's map: static, escaped, accessible."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
from dataclasses import replace
from typing import Any

import pyarrow as pa
import pytest

from plumbline.judging.smallest_detectable_mistake import CoverageEntry
from plumbline.storage.results_store import DRIFT_TABLE
from plumbline.studies import sweep
from plumbline.studies.coverage_study import coverage_table
from plumbline.studies.parquet_files import write_table
from reports import coverage_table as coverage_page
from reports import html_report, reference_tables, sweep_page
from reports.stored_results import Results, replace_unprintable
from tests.helpers.commands import invoke
from tests.helpers.example_results import HOSTILE, NASTY

MEASURED: dict[str, Any] = {
    "rtol": 1e-9,
    "gap_rate": 4.5e-9,
    "norm": 6.7e-10,
    "energy": None,
    "steps": 100,
    "cpu_seconds": 2.5,
}
DRIFT = [
    MEASURED | {"scenario": name, "variant": variant, "time": time, "gap": 3.21e-7 * time, "reason": ""}
    for name in ("tumbling-ball", HOSTILE)
    for variant in ("raw", "projected")
    for time in (10.0, 100.0)
]
SEEN = CoverageEntry(
    "tumbling-ball", "state", 1, "ball", "mass", "mass", 1.3, "kg", 1.3, 3.2e-14, "reference", "acceleration"
)  # fmt: skip
COVERAGE = [
    SEEN,
    replace(SEEN, scenario=HOSTILE, smallest=4.5e-13, body=2),
    replace(SEEN, level="step", smallest=None, proof=NASTY),
    replace(SEEN, level="step", smallest=7.1e-12, scenario=HOSTILE),
]
LEFT_OUT = {"scenario": "tumbling-ball", "variant": "raw", "rtol": 1e-9, "time": 1000.0, "reason": NASTY}


def sweep_rows():
    """Two parameters, one of them with more values than are shown one by one; every verdict."""
    rows, verdicts = [], ["agrees", "disagrees", "failed", "unresolved", "unsupported", "not installed"]
    for cell in range(90):
        values = {"bodies[0].mass": 0.5 + cell % 3, f"initial{HOSTILE}": 10.0 ** (cell // 3 / 9)}
        shared = {"cell": cell, "reason": NASTY, "reach": 1.0 + cell, "uncertainty": 1e-12 * (cell + 1)}
        rows.append(values | shared | {"implementation": "reference", "verdict": "agrees"})
        if cell:
            error = 0.0 if cell == 1 else 1e-9 * cell
            verdict = verdicts[cell % 6] if cell < 12 else "agrees"
            rows.append(
                values | shared | {"implementation": "mujoco", "verdict": verdict, "integrator": "RK4"}
                | {"position_error": error if verdict in verdicts[:2] else None}
            )  # fmt: skip
    return rows


@pytest.fixture(scope="module")
def out(example_run, tmp_path_factory):
    folder = shutil.copytree(example_run, tmp_path_factory.mktemp("pages") / "a run & more")
    write_table(pa.Table.from_pylist([*DRIFT, LEFT_OUT], schema=DRIFT_TABLE), folder / "drift.parquet")
    write_table(coverage_table(COVERAGE), folder / "coverage.parquet")
    goals = [
        {"what": HOSTILE, "goal": 0.3, "measured": 0.12},
        {"what": NASTY, "goal": 4, "measured": 5.5},
    ]
    (folder / "figures.json").write_text(json.dumps({"goals": goals, "records": []}))
    svg = (reference_tables.STORED_RESULTS / "work-precision.svg").read_text(encoding="utf-8")
    trap = '<script>alert(3)</script><image href="https://example.org/x.png"/></svg>'
    (folder / "work-precision.svg").write_text(svg.replace("</svg>", trap))
    html_report.write(Results.load(folder))
    names = [*list(sweep_rows()[0])[:2], *sweep.COLUMNS]
    schema = pa.schema(
        [(name, sweep.COLUMNS.get(name, pa.float64())) for name in names],
        metadata={
            "sweep": json.dumps({"scenario": HOSTILE, "count": 1, "seed": 0, "duration": None, "step": 0.1})
        },
    )
    write_table(pa.Table.from_pylist(sweep_rows(), schema=schema), folder / "sweep.parquet")
    sweep_page.write(folder)
    return folder


def section(text, name):
    found = re.search(rf'<section class="fast" id="{name}".*?</section>', text, re.DOTALL)
    assert found, name
    return found[0]


def words(markup):
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", markup)).split())


def test_the_report_has_the_drift_of_every_variant(out):
    found = section((out / "report.html").read_text(encoding="utf-8"), "drift")
    lines = [words(line) for line in re.findall(r"<tr>.*?</tr>", found, re.DOTALL)]
    raw = next(line for line in lines if line.startswith("raw"))
    assert replace_unprintable(" ".join(NASTY.split()))[:12] in raw
    assert "3.2×10⁻⁶ 3.2×10⁻⁵ – 4.5×10⁻⁹ 4.5×10⁻⁹ – 6.7×10⁻¹⁰ 6.7×10⁻¹⁰ – – – – 2.5" in raw
    assert sum(line.startswith("projected") for line in lines) == 2
    assert "10 s 100 s 1000 s" in words(found)
    assert "not made in this run" not in found
    assert HOSTILE in words(found)
    assert HOSTILE not in found


def test_the_report_has_the_goals_and_the_pictures_as_inert_images(out):
    found = section((out / "report.html").read_text(encoding="utf-8"), "benchmarks")
    assert f"{HOSTILE} 0.3 0.120 ✓ yes" in words(found)
    assert re.search(r"4 5\.50 ✗ no", words(found))
    (uri,) = re.findall(r'<image href="data:image/svg\+xml;base64,([^"]*)"', found)
    assert base64.b64decode(uri) == (out / "work-precision.svg").read_bytes()
    assert "example.org" not in found
    assert "<script" not in found
    assert HOSTILE not in found


def test_the_report_has_the_coverage_and_the_reasons(out):
    found = section((out / "report.html").read_text(encoding="utf-8"), "coverage")
    assert "mass 3×10⁻¹⁴ … 5×10⁻¹³ 7×10⁻¹² … 7×10⁻¹² (1 of 2)" in words(found).replace("−", "⁻")
    assert "none of 1" in words(found)
    assert "step mass" in words(found) and replace_unprintable(NASTY).split()[0] in words(found)
    assert HOSTILE in words(found)
    assert HOSTILE not in found


def test_without_coverage_the_report_has_no_such_section(tmp_path):
    assert coverage_page.coverage_tables(tmp_path) is None


def test_stored_measurements_stand_in_and_say_so(tmp_path):
    kept = reference_tables.benchmark_table(tmp_path)
    assert kept is not None
    assert kept["stored"]
    assert len(kept["pictures"]) == 2
    assert "shared two-core machine" in kept["note"]
    assert reference_tables.benchmark_table(tmp_path, tmp_path) is None
    assert reference_tables.drift_table(tmp_path, tmp_path) is None


def test_the_map_has_every_place_and_the_worst_speaks(out):
    text = (out / "sweep.html").read_text(encoding="utf-8")
    tables = re.findall(r'<table class="map">.*?</table>', text, re.DOTALL)
    assert len(tables) == 3  # two of the reference, one of the engine
    for table in tables:
        lines = re.findall(r"<tr>.*?</tr>", table, re.DOTALL)[1:]
        assert len(lines) == sweep_page.AXIS_INTERVALS
        assert all(len(re.findall(r"<td", line)) == 3 for line in lines)
    rows = [row for row in sweep_rows() if row["implementation"] == "mujoco"]
    places = re.findall(r'<td class="([^"]*)".*?</td>', tables[2], re.DOTALL)
    assert sum(place.startswith("none") for place in places) == 0
    poor = [row for row in rows if row["verdict"] not in ("agrees", "not installed")]
    first = re.search(r"<tbody>.*?</tr>", tables[2], re.DOTALL)
    assert first
    cells = [words(cell) for cell in re.findall(r"<td.*?</td>", first[0], re.DOTALL)]
    assert cells == ["? unresolved", "✗ disagrees, 0 of 2", "! failed of 2"]
    listed = re.findall(r'<tr class="(?:disagrees|failed|unresolved|unsupported)"', text)
    assert len(listed) == len(poor) == 8
    assert HOSTILE not in text
    assert HOSTILE in words(text)
    assert "<script" not in text


def test_intervals_cover_every_value_and_follow_ratios():
    name = list(sweep_rows()[0])[1]
    axis = sweep_page.make_axis(name, sweep_rows())
    assert axis.edges is not None
    assert axis.edges[1] / axis.edges[0] == pytest.approx(axis.edges[-1] / axis.edges[-2])
    for row in sweep_rows():
        k = axis.index_of(row[name])
        assert axis.edges[k] * (1 - 1e-12) <= row[name] <= axis.edges[k + 1] * (1 + 1e-12)
    few = sweep_page.make_axis("bodies[0].mass", sweep_rows())
    assert few.edges is None
    assert [few.index_of(v) for v in (0.5, 1.5, 2.5)] == [0, 1, 2]


@pytest.mark.browser
@pytest.mark.parametrize("name", ["report.html", "sweep.html"])
def test_no_request_no_violation_no_script_needed(open_file, out, name):
    page = open_file(out / name, java_script_enabled=False, offline=True)
    for part in ("#drift", "#benchmarks svg.wp") if name == "report.html" else (".map >> nth=2", "#poor"):
        assert page.locator(part).is_visible(), part
    page.wait_for_timeout(200)


@pytest.mark.browser
@pytest.mark.parametrize("name", ["report.html", "sweep.html"])
def test_axe_finds_no_violation_here_either(open_file, out, name, violations):
    assert violations(open_file(out / name, bypass_csp=True, offline=True)) == []


def test_a_sweep_of_one_parameter_is_one_line(tmp_path):
    rows = [row for row in sweep_rows() if row["bodies[0].mass"] == 0.5 and row["cell"] < 30]
    text = sweep_page.render(["bodies[0].mass", list(rows[0])[1]], _whole(rows), {})
    assert [
        len(re.findall("<tr>", t)) for t in re.findall(r'<table class="map">.*?</table>', text, re.DOTALL)
    ] == [2] * 3


def test_the_command_writes_the_map(tmp_path):
    vary = ("bodies[0].mass: {values: [0.5, 1]}", "bodies[0].angular_velocity[0]: {values: [0, 1]}")
    head = "schema_version: 1\nscenario: tumbling-ball\nduration: 0.25\nvary:\n  "
    (tmp_path / "sweep.yaml").write_text(head + "\n  ".join(vary))
    invoke("sweep", tmp_path / "sweep.yaml", "--out", tmp_path / "out", code=0)
    reported = words((tmp_path / "out" / "sweep.html").read_text(encoding="utf-8"))
    assert "4 cells: reference agrees 4" in reported
    assert "bodies[0].angular_velocity[0] ↓" in reported
    assert "Scenario tumbling-ball Count 1 Seed 0 Duration 0.25" in reported


def _whole(rows):
    return [dict.fromkeys(sweep.COLUMNS) | row for row in rows]
