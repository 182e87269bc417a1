"""A nightly run over engines with every fault: each loses its own cell, with its reason, and no other."""

import os
from dataclasses import replace
from pathlib import Path

import psutil

from plumbline.engines import registry
from plumbline.processes import worker_process
from plumbline.processes.worker_pool import Limits
from plumbline.storage.history_of_nights import History
from plumbline.storage.results_store import read_results
from tests.helpers import faulty_engines as faulty
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.nights import run_night

LIMITS = Limits(seconds=30, gigabytes=4)  # a sound cell beside two other test processes takes up to 10 s


def comparable_rows(rows, engine):
    """The rows of an engine without its name and their cost."""
    return [
        replace(row, engine="", cpu_time=0.0)
        for row in rows
        if row.engine == engine and row.integrator != faulty.FAULTY_INTEGRATOR
    ]


def test_every_fault_at_once_loses_exactly_its_own_cell(tmp_path, monkeypatch, capfd):
    for fault in faulty.ERROR_BY_FAULT:
        monkeypatch.setitem(registry.ENGINES, fault.__name__, "")  # registered below, removed afterwards
    monkeypatch.setattr(worker_process, "initialize_worker", faulty.prepare_worker)
    monkeypatch.chdir(tmp_path)
    faulty.register_faulty_engines()
    names = [fault.__name__ for fault in faulty.ERROR_BY_FAULT]
    workers_of_other_tests = (
        find_plumbline_workers()
    )  # the pool of the matrix test lives as long as its session
    s = catalogue_scenario("planar-small")
    short, options = [replace(s, duration=0.5)], {"jobs": 2, "limits": LIMITS, "level": "trajectory"}
    result, place = run_night(tmp_path / "out", "mujoco", *names, scenarios=short, **options)
    lost = {(row.engine, row.integrator): row.reason for row in result.rows if row.verdict == "failed"}
    expected = {
        (f.__name__, faulty.FAULTY_INTEGRATOR): words for f, words in faulty.ERROR_BY_FAULT.items() if words
    }
    assert lost.keys() == expected.keys(), {k: lost[k] for k in lost.keys() - expected.keys()}
    for cell, words in expected.items():
        assert words in lost[cell], cell
    sound = comparable_rows(result.rows, "mujoco")
    euler = [row for row in sound if row.integrator == "Euler"]
    for name in names:
        assert comparable_rows(result.rows, name) == euler, "a fault changed a cell beside it"
    assert comparable_rows(result.rows, "flood_output") and not [
        r for r in result.rows if r.verdict == "disagrees"
    ]
    # the night's results are complete, its failures are recorded, and no file is left elsewhere
    stored = read_results(place)
    assert stored["run"]["exit_code"] == 3 and len(stored["rows"]) == len(result.rows)
    assert [n["id"] for n in History(tmp_path / "out").overview()] == [place.name]
    assert [p.name for p in tmp_path.iterdir()] == ["out"], "an engine's file is in the working folder"
    assert "noise" not in "".join(capfd.readouterr())
    assert not find_plumbline_workers() - workers_of_other_tests


def find_plumbline_workers():
    """The worker processes below this process."""
    return {p for p in psutil.Process(os.getpid()).children(recursive=True) if is_plumbline_worker(p)}


def is_plumbline_worker(process):
    """Whether a process is a worker in a scratch folder."""
    try:
        return Path(process.cwd()).parent.name.startswith("plumbline-")
    except psutil.Error:
        return False
