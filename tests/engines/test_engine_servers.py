"""Servers of further engines: their cost is listed first, and those that are built agree with the truth."""

import subprocess
from pathlib import Path

import pytest

from plumbline.engines.registry import ENGINES, IMPORTERS
from plumbline.execution.comparison import compare
from plumbline.judging.rows import Verdict
from tests.helpers.commands import run_plumbline, run_python
from tools.engine_servers import ENGINE_SERVERS


def listed(*words, **variables):
    return run_python("-m", "tools.engine_servers", *words, code=0, **variables).stdout


def test_sizes_licences_and_missing_tools_are_listed_before_anything_is_built(tmp_path):
    lines = listed("--list", PATH=str(tmp_path)).splitlines()
    for server, line in zip(ENGINE_SERVERS, lines, strict=True):
        assert server.licence in line and " MB" in line
        assert "is built" in line or "is not installed; " in line


def test_a_night_gets_the_servers_that_are_built():
    built = [s for s in ENGINE_SERVERS if s.is_built]
    options = subprocess.run(
        ["xargs", "-n1", "echo"], input=listed("--options"), capture_output=True, text=True
    )
    words = options.stdout.splitlines()
    assert [w for w in words if w in {s.adapter for s in built}] == [s.adapter for s in built]
    assert ("--engine" in words) == bool(built)


def test_no_column_has_the_name_of_another_engine_or_importer():
    columns = {Path(str(server.command[-1])).stem for server in ENGINE_SERVERS}
    assert columns == {f"{server.name}_server" for server in ENGINE_SERVERS}
    assert not columns & {*ENGINES, *IMPORTERS}


@pytest.mark.parametrize("server", ENGINE_SERVERS, ids=lambda server: server.name)
def test_a_server_agrees_with_the_truth(server, tmp_path, monkeypatch):
    if not server.is_built:
        pytest.skip(f"{server.name} is not built here: {server.missing() or '`make engines` builds it'}")
    scenarios = ["double-hinge-skew", "slider-on-arm", "double-tumbling-balls"]
    found = compare(server.adapter, scenarios, "state")
    assert not found.problems, [f"{row.key}: {row.reason}" for row in found.problems]
    assert sum(row.verdict == Verdict.AGREES for row in found.rows) >= 6


def test_what_is_recorded_of_a_server_is_found_again(tmp_path):
    dart = next(server for server in ENGINE_SERVERS if server.name == "dart")
    if not dart.is_built:
        pytest.skip("dart is not built here: `make engines` builds it")
    words = "run", "chain-10-small", "--level", "state", "--engine", "reference", *dart.options
    done = run_plumbline(*words, "--out", tmp_path, code=0)
    assert "2 disagree as recorded" in " ".join(done.stdout.split())
