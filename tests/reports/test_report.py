"""The report from stored results, without a browser."""

from __future__ import annotations

import ast
import base64
import gzip
import hashlib
import html
import json
import os
import re
import shlex
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from rich.markup import render

from plumbline.cli import verdict_matrix
from plumbline.judging.rows import VERDICT_STYLES, Row, Verdict
from plumbline.model.kinematics import quaternion_conjugate, quaternion_product, rotation_vector
from reports import chunks, html_report, junit, report_data, sarif, step_summary
from reports.earlier_runs import History
from reports.findings_list import declared_gaps, findings_for_page
from reports.issue_text import issue_text
from reports.stored_results import Results, replace_unprintable
from reports.verdicts import css_class, error_ratio, format_number, needs_attention, rank
from tests.helpers import example_results as fixture
from tests.helpers.commands import invoke

REPORTS = Path(html_report.__file__).parent


@pytest.fixture(scope="module")
def out(example_run):
    return example_run


@pytest.fixture
def results(out):
    return Results.load(out)


@pytest.fixture(scope="module")
def text(out):
    return html_report.render(Results.load(out), History())


class Parsed(HTMLParser):
    """Tags with attributes, and all text outside scripts and styles."""

    def __init__(self, source):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.raw = False
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.raw = tag in ("script", "style")

    def handle_endtag(self, tag):
        self.raw = False

    def handle_data(self, data):
        self.words += "" if self.raw else data


def decode_chunk(chunk, texts=()):
    """The header of a chunk with its arrays and tables, as `chunks.js` decodes it in the page."""
    count, _, characters = chunk.partition(":")
    digits = np.searchsorted(chunks.ALPHABET, np.frombuffer(characters.encode(), np.uint8)).reshape(-1, 2)
    bits = (digits @ [len(chunks.ALPHABET), 1])[:, None] >> np.arange(12, -1, -1) & 1
    body = gzip.decompress(np.packbits(bits.astype(np.uint8)).tobytes()[: int(count)])
    length = int.from_bytes(body[:4], "little")
    packed, arrays, offset = json.loads(body[4 : 4 + length]), [], 4 + length
    for kind, size in zip(packed["kinds"].split(), packed["sizes"], strict=True):
        planes = np.frombuffer(body, np.uint8, int(kind[1]) * size, offset).reshape(int(kind[1]), size)
        arrays.append(np.frombuffer(planes.T.tobytes(), dtype="<" + kind))
        offset += planes.size

    def fill(value):
        if isinstance(value, list):
            return [fill(v) for v in value]
        if not isinstance(value, dict):
            return value
        if "$texts" in value:
            return [texts[code - 1] if code else None for code in fill(value["$texts"])]
        if "$numbers" in value:
            numbers = zip(*map(fill, value["$numbers"]), strict=True)
            return [None if digits == chunks.NO_NUMBER else float(f"{digits}e{e}") for digits, e in numbers]
        if "$lists" in value:
            counts, values = map(fill, value["$lists"])
            return [list(x) for x in np.split(np.array(values), np.cumsum(counts)[:-1])]
        if "$rows" in value:
            found = [{} for _ in range(value["$rows"])]
            for name, column in value["columns"].items():
                for record, x in zip(found, fill(column), strict=True):
                    record |= {} if x is None else {name: x}
            return found
        return arrays[value["$"]] if "$" in value else {k: fill(v) for k, v in value.items()}

    return fill(packed["header"])


def decode_texts(chunk):
    packed, used = decode_chunk(chunk), Counter()
    found = []
    for code in packed["codes"].tolist():
        numbers = iter([slot.split(" ")[used[code]] for slot in packed["numbers"][code]])
        used[code] += 1
        found.append(re.sub("\0", lambda _, numbers=numbers: next(numbers), packed["templates"][code]))
    return found


def decoded_chunks(text):
    found = re.findall(r'<script type="application/octet-stream" id="chunk-([\w-]+)">([^<]*)</script>', text)
    texts = decode_texts(dict(found)["texts"])
    return {name: decode_chunk(body, texts) for name, body in found}


def test_the_sentence_counts_and_versions_come_first(results, text):
    parsed = Parsed(text)
    before_matrix = parsed.words[: parsed.words.index("Worst error over its tolerance")]
    assert results.run["sentence"] in before_matrix
    for verdict, mark in VERDICT_STYLES.items():
        count = sum(row["verdict"] == verdict for row in results.rows)
        assert re.search(rf"{count}\s*{mark.plural}", before_matrix), verdict
    assert "6d61634" in before_matrix
    for engine in results.engines.values():
        assert engine["version"] in parsed.words


def test_every_cell_is_in_the_static_matrix_with_glyph_text_and_class(results, text):
    start = text.index('<table class="matrix"')
    table = text[start : text.index("</table>", start)]
    lines = table.split('<tr class="line"')[1:]
    assert len(lines) == len(results.scenarios)
    for line, name in zip(lines, results.scenarios, strict=True):
        cells = re.findall(r'<td class="cell[^>]*>.*?</td>', line, re.DOTALL)
        assert len(cells) == len(results.engines)
        for cell, engine in zip(cells, results.engines, strict=True):
            rows = [r for r in results.rows if r["scenario"] == name and r["engine"] == engine]
            worst = max(rows, key=rank)
            assert f'class="cell {css_class(worst["verdict"])}' in cell
            assert VERDICT_STYLES[worst["verdict"]].glyph in cell
            ratio = error_ratio(worst)
            assert (format_number(ratio) if ratio is not None else worst["verdict"]) in cell


def test_terminal_and_report_show_the_same_row_of_each_cell(results, text):
    """The report's link names the row; glyph and ratio of the terminal's cell are those of the same row."""
    shown = re.findall(r'<td class="cell [^>]*><a title="([^"]*)">(.*?)</a></td>', text, re.DOTALL)
    cells: dict[tuple[str, str], list[Row]] = {
        (s, e): [] for s, e in product(results.scenarios, results.engines)
    }
    for record in results.rows:
        row = Row(**{k: v for k, v in record.items() if k != "key"} | {"verdict": Verdict(record["verdict"])})
        cells[row.scenario, row.engine].append(row)
    assert len(shown) == len(cells)
    for (title, cell), rows in zip(shown, cells.values(), strict=True):
        parts = {
            f"{r.level}, {r.quantity}" + (f", {r.integrator}" if r.integrator != "-" else ""): r for r in rows
        }
        row = parts[html.unescape(title).split(": ")[0]]
        ratio = "" if row.ratio is None else f" {row.ratio:.1g}".replace("e+0", "e").replace("e+", "e")
        in_terminal = render(verdict_matrix._format_cell(rows)).plain
        assert in_terminal == f"{row.verdict.style.glyph}{ratio}"
        in_report = Parsed(f"<p>{cell}</p>").words
        assert in_report.startswith(row.verdict.style.glyph)
        assert (str(row.verdict) if row.ratio is None else format_number(row.ratio)) in in_report


def test_the_worst_row_stands_for_its_cell():
    def worst_row(rows):
        return max(rows, key=rank)

    def row(verdict, value, known=None):
        return {"verdict": verdict, "ratio": value, "known_issue": known}

    agree, disagree = row("agrees", 0.9), row("disagrees", 2.0)
    gap, known_gap = row("unsupported", None), row("unsupported", None, "gap")
    assert worst_row([agree, row("agrees", 0.1), known_gap]) is agree
    assert worst_row([agree, gap]) is gap
    assert worst_row([agree, disagree, gap]) is disagree
    assert worst_row([row("disagrees", 50.0, "old"), disagree]) is disagree
    assert worst_row([row("failed", None), disagree])["verdict"] == "failed"
    assert needs_attention(gap) and not needs_attention(known_gap)
    assert error_ratio({"verdict": "agrees", "value": 3.0, "tolerance": 4.0, "ratio": 0.2}) == 0.2


def test_no_hostile_text_becomes_markup(text):
    parsed = Parsed(text)
    kinds = {tag for tag, _ in parsed.tags}
    assert "img" not in kinds
    assert not [k for _, attributes in parsed.tags for k in attributes if k.startswith("on") or k == "style"]
    assert fixture.HOSTILE in parsed.words
    assert "a'\"`${1}&amp;</script><script>alert(2)</script>]]>" in parsed.words
    scripts = [attributes for tag, attributes in parsed.tags if tag == "script"]
    assert [a.get("type") for a in scripts] == ["application/octet-stream"] * (len(scripts) - 1) + [None]
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f\u202e]", text)


def test_hostile_names_survive_in_the_data_and_in_links(out, text):
    data = decoded_chunks(text)
    assert fixture.HOSTILE in data["index"]["scenarios"]
    links = [
        a["href"] for tag, a in Parsed(text).tags if tag == "a" and (a.get("href") or "").startswith("#")
    ]
    assert any("scenario=%3Cimg+src%3Dx+onerror%3Dalert%281%29%3E" in (link or "") for link in links)
    rows = [c["rows"] for name, c in data.items() if name.startswith("scenario-")]
    scripts = [row["script"] for group in rows for row in group if "script" in row]
    assert any(fixture.HOSTILE in script for script in scripts)


def test_unprintable_characters_become_visible_ones_everywhere():
    bad = "a\x00b\x1bc\u202ed\ud800e\ufffff\x85g\rh\ni"
    assert replace_unprintable({bad: [bad]}) == {"a�b�c�d�e�f�g�h\ni": ["a�b�c�d�e�f�g�h\ni"]}


def test_the_page_allows_only_its_own_script_and_style(text):
    policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy and "http" not in policy
    for tag in ("script", "style"):
        body = re.search(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    loading = [a for _, a in Parsed(text).tags if "src" in a or (a.get("href") or "#")[0] not in "#d"]
    assert loading == []


def test_decimation_keeps_every_peak_and_every_gap():
    rng = np.random.default_rng(1)
    y = rng.random(10_001)
    spikes = rng.choice(len(y), 20, replace=False)
    y[spikes[:10]] = 1e3 * (1 + rng.random(10))
    y[spikes[10:]] = 1e-9 * (1 + rng.random(10))
    y[7777] = np.nan
    t = np.linspace(0, 10, len(y))
    small, times = chunks.decimate(y, 300), chunks.decimate_times(t, 300)
    assert len(small) == len(times) <= 300
    assert np.nanmax(small) == np.nanmax(y) and np.nanmin(small) == np.nanmin(y)
    edges = chunks.bucket_edges(len(y), 300)
    for k, (a, b) in enumerate(pairwise(edges)):
        part = y[a:b]
        assert np.nanmax(small[2 * k : 2 * k + 2]) == np.nanmax(part)
        assert np.isnan(part).any() == np.isnan(small[2 * k : 2 * k + 2]).any()
        assert times[2 * k] == t[a] and times[2 * k + 1] == t[b - 1]
    assert chunks.decimate(y[:300], 300) is not None and len(chunks.decimate(y[:300], 300)) == 300


def test_log_codes_keep_half_a_percent_and_tell_zero_from_nothing():
    y = np.array([0.0, np.nan, np.inf, 1e-300, 1e-17, 3.3e-9, -2.5, 1e80])
    codes = chunks.log_scale_codes(y).astype(float)
    assert codes[:4].tolist() == [1, 0, 0, 2]
    back = 10 ** ((codes[4:] - 2) / chunks.STEPS_PER_DECADE + chunks.LOWEST_DECADE)
    assert np.allclose(back, np.abs(y[4:]), rtol=0.0024)


def test_an_error_of_zero_is_within_a_bound_of_zero():
    """The kinetic energy of bodies at rest; without a bound there is no ratio."""
    states = {
        "engine": np.array(["e"] * 3), "quantity": np.array(["kinetic_energy"] * 3), "state": np.arange(3),
        "body": np.zeros(3, int), "error": np.array([0.0, 1.0, 0.0]), "bound": np.array([0.0, 2.0, np.nan]),
    }  # fmt: skip
    packer = chunks.ChunkBuilder()
    (spread,) = report_data._state_errors("s", {"states": {"s": states}}, packer)
    (back,) = decode_chunk(packer.encode({"a": [spread["ratio"]]}))["a"]
    codes = chunks.log_scale_codes(np.array([0.0, 0.5, np.nan]), chunks.COARSE)
    assert back.tolist() == sorted(codes.tolist())


def test_chunks_come_back_as_they_went_in():
    packer = chunks.ChunkBuilder()
    arrays = [
        np.arange(7, dtype=np.uint8),
        np.linspace(-1, 1, 5, dtype=np.float32),
        np.array([-300, 299], dtype=np.int16),
        np.array([65535, 1], dtype=np.uint16),
        np.array([-128, 127], dtype=np.int8),
    ]
    header = {"a": [packer.add(a) for a in arrays], "text": "</script>ä", "none": None}
    chunk = packer.encode(header)
    assert re.fullmatch(r"\d+:[!-~]+", chunk) and not set(chunk) & set('<&"')
    back = decode_chunk(chunk)
    assert back["text"] == "</script>ä" and back["none"] is None
    for found, array in zip(back["a"], arrays, strict=True):
        assert np.array_equal(found, array)


def test_texts_come_back_as_they_went_in():
    texts = ["within 0.0091 at 51", "within 1e-17 at 3", "7", "", "no number", "8", "a 1.5e+3 b", "12.5.3"]
    assert decode_texts(chunks.encode_texts(texts)) == texts


def test_tables_keep_three_digits_and_leave_out_what_is_no_number():
    texts = {}
    packer = chunks.ChunkBuilder(texts)
    records = [
        {"x": 1.23456e-17, "n": 7, "word": "ä", "extra": {"a": -2.5}},
        {"x": 0.0, "n": 1_234_567, "word": None, "extra": {}},
        {"x": float("nan"), "word": "ä", "more": ["b"]},
        {"x": 1e308, "extra": {"a": 1e-300}},
    ]
    chunk = packer.encode({"table": packer.add_table(records)})
    assert decode_chunk(chunk, list(texts))["table"] == [
        {"x": 1.23e-17, "n": 7, "word": "ä", "extra": {"a": -2.5}},
        {"x": 0.0, "n": 1_234_567, "extra": {}},
        {"word": "ä", "extra": {}, "more": ["b"]},
        {"x": 1e308, "extra": {"a": 1e-300}},
    ]  # fmt: skip


def test_a_difference_of_1e_9_survives_in_the_motion(results, text):
    poses, name = results.table("trajectories"), "double-tumbling"
    motion = decoded_chunks(text)[f"scenario-{list(results.scenarios).index(name)}"]["motion"]
    frames = len(motion["t"])

    def r(engine, integrator):
        mine = (poses["scenario"] == name) & (poses["engine"] == engine) & (poses["integrator"] == integrator)
        order = np.lexsort((poses["body"][mine], poses["t"][mine]))
        return np.stack([poses[k][mine][order] for k in ("rx", "ry", "rz")], -1).reshape(-1, 2, 3)

    run = next(x for x in motion["runs"] if x["engine"] == "exudyn-tree")
    exact = r("exudyn-tree", run["integrator"]) - r("reference", "RK4")
    pick = np.unique(np.linspace(0, len(exact) - 1, frames).round().astype(int))
    drawn = (run["scale"][:, None, None] * run["d"].reshape(frames, 2, 6) / 127)[..., :3]
    rounding = 1 / (2 * report_data.DIFFERENCE_LEVELS) + 2**-6  # of the difference, and of its scale
    assert np.all(np.abs(drawn - exact[pick]) <= run["scale"][:, None, None] * rounding + 1e-30)


def test_rotation_vectors_are_exact_for_tiny_and_large_angles():
    axis = np.array([2, -3, 6]) / 7
    base = np.array([0.5, 0.5, -0.5, 0.5])
    for angle in (1e-14, 1e-9, 0.3, 3.0):
        turned = quaternion_product(np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)]), base)
        for sign in (1, -1):
            assert np.allclose(
                rotation_vector(quaternion_product(sign * turned, quaternion_conjugate(base))),
                angle * axis,
                rtol=1e-6,
                atol=2e-16,
            )


def test_the_first_crossing_is_of_the_undecimated_curve(results, text):
    curves = results.table("curves")
    seen = 0
    for k, name in enumerate(results.scenarios):
        for one in decoded_chunks(text)[f"scenario-{k}"]["curves"]:
            mine = (
                (curves["scenario"] == name)
                & (curves["engine"] == one["engine"])
                & (curves["integrator"] == one["integrator"])
            )
            above = [
                t
                for t, e, tol in zip(
                    *(curves[c][mine] for c in ("t", "position_error", "tolerance")), strict=True
                )
                if not e <= tol
            ]
            assert one.get("crossing") == (pytest.approx(above[0], rel=1e-5, abs=1e-9) if above else None)
            seen += bool(above)
    assert seen > 3


def test_commands_are_quoted_for_a_shell():
    row = {"scenario": "x'; rm -rf ~ #", "engine": "mujoco", "level": "invariants", "quantity": "order"}
    assert shlex.split(report_data.rerun_command(row, {"file": ""}))[4:] == [
        "x'; rm -rf ~ #",
        "--engine",
        "mujoco",
        "--level",
        "trajectory",
        "--out",
        "repeated",
    ]
    row["scenario"] = "--out"
    assert shlex.split(report_data.rerun_command(row, {"file": ""}))[-2:] == ["--", "--out"]
    assert "'./my own.yaml'" in report_data.rerun_command(row, {"file": "./my own.yaml"})
    assert " run rest " in report_data.rerun_command(row | {"scenario": "rest"}, {"file": "rest.yaml"})
    mine = report_data.rerun_command(row | {"scenario": "rest"}, {"file": "./rest.yaml"})
    assert " run ./rest.yaml " in mine, "a file of the user that is named like one of the catalogue"
    whole = report_data.rerun_command(row | {"level": "relations"}, {"file": "", "family": "run"})
    assert whole == "python -m plumbline run --engine mujoco --level all --out repeated"
    row |= {"scenario": "rest", "quantity": "energy_drift_long", "extra": {"asked": 100.0}}
    nightly = "python -m plumbline nightly rest --engine mujoco --random 0 --no-self-test"
    out = " --out repeated"
    assert report_data.rerun_command(row, {"file": ""}) == nightly + out
    row["extra"] = {"asked": 12.5}
    assert report_data.rerun_command(row, {"file": ""}) == f"{nightly} --long-run-seconds 12.5{out}"


def test_numbers_read_as_people_write_them():
    shown = [format_number(x) for x in (0.0, 1.0, 0.0314, 4.2e-6, -1.5e7, 123.4, 9.99, float("nan"), None)]
    assert shown == ["0", "1.0", "0.031", "4.2×10⁻⁶", "−1.5×10⁷", "120", "10", "not finite", "–"]


def test_the_default_catalogue_stays_under_2_megabytes(catalogue_page):
    size = catalogue_page.stat().st_size
    print(f"30 scenarios: {size:,} bytes")
    assert size <= html_report.MAX_PAGE_BYTES


def test_a_night_of_thousands_of_scenarios_stays_under_8_megabytes(out, tmp_path):
    stored, name = Results.load(out), "double-tumbling"
    rows = [row for row in stored.rows if row["scenario"] == name]
    scenarios = {f"random-{k}": stored.scenarios[name] for k in range(2500)}
    copies = [
        row | {"scenario": scenario, "key": row["key"].replace(name, scenario)}
        for scenario in scenarios
        for row in rows
    ]
    copies[-1] |= {"verdict": "disagrees", "known_issue": None, "reason": "the needle"}
    night = Results(tmp_path, stored.run, scenarios, stored.engines, copies)
    text = html_report.render(night, History())
    print(f"{len(copies):,} rows: {len(text):,} bytes")
    assert len(text.encode()) <= html_report.MAX_NIGHTLY_PAGE_BYTES
    assert "random-2499" in text and "the needle" in text
    assert "2000 more scenarios are not in this page" in text
    assert "none of them has an unexpected verdict" in text
    assert f"<b>{sum(row['verdict'] == 'agrees' for row in copies)}</b><span>agree" in text


def test_a_page_above_its_budget_has_fewer_points(results, text, monkeypatch):
    monkeypatch.setattr(html_report, "MAX_PAGE_BYTES", len(text.encode()) - 30_000)
    smaller = html_report.render(results, History())
    assert len(smaller.encode()) <= html_report.MAX_PAGE_BYTES
    few, many = (decoded_chunks(page)["scenario-0"]["curves"][0]["t"] for page in (smaller, text))
    assert len(few) < len(many)


def test_a_history_shows_what_is_new_and_skips_a_damaged_night(out, results, tmp_path):
    past = fixture.nights(out, tmp_path / "history", count=4)
    history = History.load(past, results)
    assert len(history.nights) == 4 and history.unreadable == ["2026-11-02"]
    assert history.last_passed is history.nights[-2]
    fresh = {row["key"] for row in results.rows if history.is_new(row)}
    assert fresh == {row["key"] for row in results.rows if row["verdict"] in ("disagrees", "failed")}
    page = html_report.render(results, history)
    data = decoded_chunks(page)
    table = data["history"]["verdict"].reshape(len(results.rows), 5)
    for line, row in zip(table, results.rows, strict=True):
        assert list(VERDICT_STYLES)[line[-1] - 1] == row["verdict"]
        if row["key"] in fresh:
            assert list(VERDICT_STYLES)[line[0] - 1] == "agrees"
    words = Parsed(page).words
    assert history.missing_keys == 0
    states = replace(results, rows=[row for row in results.rows if row["level"] == "state"])
    assert History.load(past, states).missing_keys == len(results.rows) - len(states.rows)
    assert re.search(rf"{len(fresh)}\s+newly failing", words) and "Skipped as damaged: 2026-11-02" in words


def test_a_run_of_the_state_level_alone_has_a_page(out, tmp_path):
    few = tmp_path / "few"
    few.mkdir()
    stored = json.loads((out / "results.json").read_text())
    stored["rows"] = [row for row in stored["rows"] if row["level"] == "state"]
    for about in stored["scenarios"].values():
        del about["horizon"], about["truth_uncertainty"]
    del stored["run"]["truth"]
    (few / "results.json").write_text(json.dumps(stored))
    shutil.copy(out / "states.parquet", few)
    data = decoded_chunks(html_report.write(Results.load(few)).read_text())
    assert data["scenario-0"]["curves"] == [] and data["scenario-0"]["motion"] is None


def test_gaps_of_one_reason_are_one_finding_and_declared_ones_have_a_page(results):
    gap = next(row for row in results.rows if row["verdict"] == "unsupported")
    names = list(results.scenarios)
    gap |= {"known_issue": None, "is_declared": False}
    rows = [{**gap, "scenario": name, "key": f"{name}/a"} for name in names]
    rows += [{**gap, "reason": "another"}]
    declared = [
        {**gap, "known_issue": "x", "is_declared": True, "scenario": n, "key": f"{n}/b"} for n in names
    ]
    shown = replace(results, rows=[*rows, *declared])
    first, second = findings_for_page(shown, History())
    assert {len(first["scenarios"]), len(second["scenarios"])} == {len(names), 1}
    (group,) = declared_gaps(shown)
    assert (group["count"], list(group["scenarios"])) == (len(names), names)
    words = Parsed(html_report.render(shown, History())).words
    assert "Declared gaps" in words and "2 findings need attention" in words


def test_a_finding_has_its_mechanism_with_the_worst_body_marked_a_plot_and_its_numbers(results):
    first = next(f for f in results.findings if f["verdict"] == "disagrees")
    row = next(row for row in results.rows if row["key"] == first["rows"][0])
    row["extra"] = {"body": 1.0}
    scenario = results.scenarios[row["scenario"]]
    start = {"p": [1.0, 0, 0, 0], "omega": [0.0] * 3, "u": [0.0, 0, 1], "udot": [0.0] * 3}
    start["r"] = [0.0, 0, -1]
    scenario["state"] = {name: [x] * scenario["bodies"] for name, x in start.items()}
    found = findings_for_page(results, History())
    assert [f["name"] for f in found] == [f["name"] for f in results.findings]
    (finding,) = (f for f in found if f["row"] is row)
    points = finding["drawing"]["points"]
    assert len(points) == scenario["bodies"]
    assert [p["name"] for p in points if p["is_marked"]] == ["body 1"]
    assert len(finding["plot"]["dots"]) == sum(
        bool(r["ratio"]) for r in results.rows if r["key"] in finding["rows"]
    )
    page = html_report.render(results, History())
    assert all(html.escape(f["name"]) in page for f in found) and 'class="robot"' in page


def test_a_run_that_compared_nothing_is_not_shown_as_agreement(results):
    gaps = [row for row in results.rows if row["verdict"] in ("unsupported", "not installed")]
    words = Parsed(html_report.render(replace(results, rows=gaps), History())).words
    assert "Nothing was compared" in words and "Nothing needs attention" not in words
    assert "Every cell agrees" not in words


def test_a_report_that_cannot_be_written_leaves_the_old_one(out, tmp_path, monkeypatch):
    copy = shutil.copytree(out, tmp_path / "copy")
    old = html_report.write(Results.load(copy)).read_bytes()

    def full(descriptor):
        os.ftruncate(descriptor, 1000)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        html_report.write(Results.load(copy))
    assert (copy / "report.html").read_bytes() == old
    assert [p.name for p in copy.iterdir() if p.name.startswith(".")] == []


def test_junit_counts_what_it_holds_and_survives_every_text(results):
    root = ET.parse(junit.write(results)).getroot()
    cases = root.findall("./testsuite/testcase")
    assert len(cases) == len(results.rows) == int(root.get("tests", ""))
    for tag, total in (("failure", "failures"), ("error", "errors"), ("skipped", "skipped")):
        assert len(root.findall(f".//{tag}")) == int(root.get(total, "")) > 0
    expected = {row["key"] for row in results.rows if needs_attention(row)}
    assert len(root.findall(".//failure")) + len(root.findall(".//error")) == len(expected)
    assert {s.get("name") for s in root.findall("testsuite")} == set(results.scenarios)
    assert any("behaves as if gravity" in (failure.text or "") for failure in root.findall(".//failure"))


def test_sarif_has_a_result_per_finding_and_suppresses_recorded_ones(results):
    log = json.loads(sarif.write(results).read_text())
    found = log["runs"][0]["results"]
    assert [one["ruleId"] for one in found] == [finding["name"] for finding in results.findings]
    for one, finding in zip(found, results.findings, strict=True):
        assert ("suppressions" in one) == (finding["known_issue"] is not None)


def test_junit_and_the_summary_name_the_finding(results):
    root = ET.parse(junit.write(results)).getroot()
    messages = [f.get("message") for f in (*root.iter("failure"), *root.iter("error"))]
    names = [f["name"] for f in results.findings if f["known_issue"] is None]
    assert all(any(message.startswith(f"{name}: ") for name in names) for message in messages)
    summary = html.unescape(step_summary.render(results))
    assert all(finding["name"] in summary for finding in results.findings)


def test_the_text_of_an_issue_has_script_versions_and_the_expected_number(results):
    finding = next(f for f in results.findings if f["verdict"] == "disagrees")
    text = issue_text(results, finding)
    assert "## Reproduction steps" in text and finding["sentence"][1:] in text
    assert "times what rounding explains" in text and f"Wrong in {finding['versions'][0]}" in text
    scripts = [results.scripts[key] for key in finding["rows"] if key in results.scripts]
    assert not scripts or scripts[0].rstrip() in text


def test_a_finding_is_explained_and_reported_by_the_beginning_of_its_name(out, results, tmp_path):
    scripted = next(f for f in results.findings if not results.scripts.keys().isdisjoint(f["rows"]))
    printed = invoke("report", out, "--issue", scripted["name"][:-1])
    assert (printed.exit_code, printed.stdout) == (0, issue_text(results, scripted) + "\n")
    assert "no finding has this name" in invoke("report", out, "--issue", "nothing").stderr
    assert "findings begin so" in invoke("explain", "pinocchio", "--results", out).stderr
    entry = {"id": "coarse-steps", "engine": "mujoco", "verdict": "unresolved"}
    entry |= {"evidence": "measured", "reason": "short"}
    own = tmp_path / "own.yaml"
    own.write_text(json.dumps([entry]))
    assert "--known FILE prints the entry" in invoke("explain", "coarse-steps", "--results", out).stdout
    explained = invoke("explain", "coarse-steps", "--results", out, "--known", own).stdout
    assert "Evidence: measured" in explained and "short" in explained


def test_the_step_summary_shows_text_as_text_and_keeps_its_limit(out, results):
    text = step_summary.write(Results.load(out)).read_text(encoding="utf-8")
    assert "<" not in text and "`" not in text
    assert html.unescape(step_summary.escape_markdown(fixture.HOSTILE)) == fixture.HOSTILE
    assert not re.search(r"(?<!&)[|*_#\[\]`<>@]", step_summary.escape_markdown("|*_#[]`<>@me"))
    bad = next(row for row in results.rows if row["verdict"] == "disagrees")
    results.rows.extend(
        {**bad, "quantity": f"q{k}", "key": f"k{k}", "reason": "long " * 60} for k in range(5000)
    )
    summary = step_summary.render(results)
    assert len(summary.encode()) <= 1024 * 1024
    assert re.search(r"… and \d{3,} more", summary)
    assert "report.html has every cell" in summary


def tool(name):
    found = REPORTS / "node_modules" / ".bin" / name
    if not found.exists():
        pytest.skip(f"{name} is not installed: run `npm ci` in reports/ first")
    return str(found)


@pytest.mark.parametrize(
    "words", ["tsc --noEmit -p .", "eslint --max-warnings 0 assets"], ids=["types", "lint"]
)
def test_the_pages_own_script_is_checked(words):
    name, *options = words.split()
    done = subprocess.run([tool(name), *options], cwd=REPORTS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_vendored_uplot_comes_with_its_licence(text):
    assert "uPlot" in html_report.bundle_script() and "Copyright (c) 2022 Leon Sorokin" in Parsed(text).words
    assert not re.search(
        r"\bfetch\(|XMLHttpRequest|WebSocket|EventSource|sendBeacon", html_report.bundle_script()
    )


def further_numbers():
    """Keys of ``extra`` that the judging code writes, by file."""
    found = set()
    for path in sorted((REPORTS.parent / "plumbline" / "judging").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_argument = isinstance(node, ast.keyword) and node.arg == "extra"
            targets = getattr(node, "targets", None) or [getattr(node, "target", None)]
            is_variable = isinstance(node, ast.Assign | ast.AugAssign) and any(
                isinstance(target, ast.Name) and target.id == "extra" for target in targets
            )
            if is_argument or is_variable:
                dicts = [x for x in ast.walk(node.value) if isinstance(x, ast.Dict)]
                keys = [key.value for x in dicts for key in x.keys if isinstance(key, ast.Constant)]
                found |= {(path.name, key) for key in keys}
    return found


def test_every_further_number_of_a_row_has_a_label():
    """Apart from those by time, "by 10 s", which are their own label."""
    script = (REPORTS / "assets" / "detail.js").read_text(encoding="utf-8")
    table = re.search(r"^const EXTRA = \{(.*?)^\};", script, re.MULTILINE | re.DOTALL)[1]
    labels = set(re.findall(r"(\w+): \[\"", table))
    written = further_numbers()
    assert {file for file, _ in written} >= {
        "state_level.py",
        "step_level.py",
        "trajectory_level.py",
        "relation_rows.py",
    }
    assert not {(file, key) for file, key in written if key not in labels}
