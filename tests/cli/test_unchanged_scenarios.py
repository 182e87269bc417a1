"""Scenario files that have not changed are neither built nor checked again, and changed ones always are."""

import os

import numpy as np
import pytest

from plumbline.cli import options
from plumbline.scenario import loader
from tests.helpers.commands import invoke


@pytest.fixture
def built(tmp_path, monkeypatch):
    """A file of the user's own, and the paths of the scenarios that are built."""
    monkeypatch.setenv("PLUMBLINE_CACHE", str(tmp_path / "cache"))
    paths, build = [], loader.load_scenario
    monkeypatch.setattr(loader, "load_scenario", lambda path: paths.append(path) or build(path))
    mine = tmp_path / "mine.yaml"
    mine.write_text(loader.find_scenario_file("slider-crank").read_text())
    return mine, paths


def chosen(path):
    (found,) = options.choose_scenarios([str(path)], ())
    return found


def test_an_unchanged_file_is_built_once(built):
    mine, paths = built
    first, second = chosen(mine), chosen(mine)
    assert paths == [mine]
    assert second.document == first.document and second.digest == first.digest and second.path == mine
    for one, other in ((first.model, second.model), (first.state, second.state)):
        for name, value in vars(one).items():
            assert np.array_equal(value, getattr(other, name)), name


def test_a_changed_file_or_environment_is_built_again(built, monkeypatch):
    mine, paths = built
    chosen(mine)
    mine.write_text(mine.read_text().replace("duration: ", "duration: 0.5  # "))
    assert chosen(mine).duration == 0.5 and len(paths) == 2
    monkeypatch.setattr(options, "environment_fingerprint", lambda _: "another")
    chosen(mine)
    assert len(paths) == 3
    mine.rename(mine.with_name("other.yaml"))
    assert chosen(mine.with_name("other.yaml")).name == "other" and len(paths) == 4


def test_a_closed_form_that_does_not_fit_is_reported_each_time(built):
    mine, _ = built
    text = loader.find_scenario_file("spherical").read_text()
    mine.write_text(text.replace("exact: spherical-pendulum", "exact: planar-pendulum"))
    for _ in range(2):
        done = invoke("run", mine, "--out", mine.parent / "out", code=2)
        assert "exact" in done.output, done.output


def test_the_command_computes_with_one_thread(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "4")
    invoke("--version")
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
