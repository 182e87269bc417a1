"""Damaged files, stored or of users, end a command with exit code 2 and a place, never a traceback."""

import itertools
import json
import random
import re
import shutil
from collections import Counter
from unittest.mock import patch

import pytest

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.registry import load_adapter
from plumbline.judging.known_issues import KNOWN_ISSUES_FILE
from plumbline.scenario.loader import find_scenario_file
from plumbline.scenario.yaml_parser import parse_yaml
from plumbline.scenario.yaml_source import YamlSource
from plumbline.studies import sweep_file
from reports.reference_tables import STORED_RESULTS
from tests.helpers import example_results
from tests.helpers.commands import invoke
from tests.helpers.mutations import damaged_bytes, damaged_document, limited_time
from tests.helpers.scenario_mutations import mutated

STORED_FILES = (
    "results.json", "results.json", "results.json", "scripts/index.json", "summary.parquet", "states.parquet",
    "convergence.parquet", "curves.parquet", "trajectories.parquet", "drift.parquet", "figures.json",
)  # fmt: skip
TEXT_SIZE = 700  # letters; a longer message is no sentence


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A small complete results folder, in a history."""
    folder = tmp_path_factory.mktemp("stored") / "history" / "20260101T000000Z"
    example_results.build_small(folder)
    for name in ("drift.parquet", "figures.json"):
        shutil.copy(STORED_RESULTS / name, folder)
    return folder


def damage(stored, folder, draw):
    """Copy a results folder and damage one of its files; return the file's name."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(stored, folder)
    name = draw.choice([name for name in STORED_FILES if (folder / name).is_file()])
    path = folder / name
    path.write_bytes(damaged(path.read_bytes(), json.loads if name.endswith(".json") else None, draw))
    return name


def damaged(data, load, draw):
    """Damage a file's bytes or, where it can be loaded, the document in it."""
    if load is None or draw.random() < 0.3:
        return damaged_bytes(data, draw)
    return json.dumps(damaged_document(load(data), draw)).encode("utf-8", "surrogatepass")


THOUSANDS = pytest.param(5000, 2, marks=[pytest.mark.full, pytest.mark.timeout(3600)])


@pytest.mark.parametrize(("count", "seed"), [(60, 1), THOUSANDS])
@pytest.mark.parametrize("command", ["report", "report --history", "history", "reproduce"])
def test_damaged_results_are_bad_files(stored, tmp_path, command, count, seed, record_testsuite_property):
    draw, outcomes = random.Random(seed), Counter()
    folder = tmp_path / "history" / stored.name
    for number in range(count):
        name = damage(stored, folder, draw)
        words = {
            "report": ["report", str(folder)],
            "report --history": ["report", str(stored), "--history", str(tmp_path)],
            "history": ["history", str(tmp_path), "--key", "*/order"],
            "reproduce": ["reproduce", str(folder)],
        }[command]
        with limited_time():
            result = invoke(*words)
        about = f"example {number} of seed {seed}, {name}: {result.output[-2000:]}"
        assert result.exit_code in (0, 2), about
        assert "Traceback" not in result.output, about
        if result.exit_code == 2:
            message = result.stderr.split("Error: ", 1)[-1]
            assert name.rsplit("/")[-1] in message, about
            assert max(map(len, message.splitlines())) < TEXT_SIZE + len(str(folder)), about
        outcomes[result.exit_code] += 1
    assert command in ("history", "report --history") or min(outcomes[0], outcomes[2]) > 5, outcomes
    record_testsuite_property(f"damaged stores, {command}: by exit code", dict(outcomes))


SWEEP = b"""\
schema_version: 1
scenario: double-tumbling-balls
vary:
  bodies[0].mass: {from: 0.5, to: 2.0, points: 3, log: true}
  bodies[1].angular_velocity[2]: {values: [-1, 0, 1]}
  bodies[0].proximal[0]: {uniform: [0.05, 0.09]}
  bodies[1].mass: {normal: [0.9, 0.05]}
count: 4
seed: 7
duration: 1.0
engines: {mujoco: RK4, exudyn: trapezoidal}
step: 0.002
"""
READING_SECONDS = 2.0  # s of CPU time for one file
PYDANTIC = re.compile(
    r"Input should|Extra inputs|Value error|Assertion failed|validat|pydantic|valid (boolean|integer|dict)"
)
MAX_CELLS = 30  # of an example: more of them show nothing new


class Accepted(BaseException):
    """Raised where the work of a command would begin."""


@pytest.fixture(scope="module")
def no_work():
    """Cut off what a sweep does once its file has been accepted."""
    engines = {"mujoco", "exudyn", "pinocchio", "reference"}
    found = {name: EngineInfo(name, name, "1", load_adapter(name).integrators) for name in engines}
    missing = EngineInfo("", "", "", (), "not described in this test")
    make_cells = sweep_file._make_cells
    with (
        patch("plumbline.studies.sweep.run", side_effect=Accepted),
        patch("plumbline.cli.study_commands.WorkerPool"),
        patch(
            "plumbline.execution.runner.describe_engines",
            lambda _, names: {name: found.get(name, missing) for name in names},
        ),
        patch.object(sweep_file, "_make_cells", lambda *a: itertools.islice(make_cells(*a), MAX_CELLS)),
    ):
        yield


def damaged_yaml(data):
    """Make files of a valid one by random damage."""
    return lambda draw: (
        "any",
        damaged(data, lambda text: parse_yaml(YamlSource("x"), text.decode()).data, draw),
    )


def check_user_files(tmp_path, make, words, count, seed):
    """Damage a user's file again and again; count how often the command that reads it goes on.

    Every problem has a line and a column, no problem has words of pydantic, and no file takes long.
    """
    draw, path, outcomes = random.Random(seed), tmp_path / "mine.yaml", Counter()
    for number in range(count):
        name, content = make(draw)
        path.write_bytes(content)
        about = f"example {number} of seed {seed}, {name}"
        try:
            with limited_time(READING_SECONDS):
                result = invoke(*words, path)
        except Accepted:
            outcomes["accepted"] += 1
            continue
        about = f"{about}: {result.output[-2000:]} {result.exception!r}"
        if result.exit_code == 0:
            outcomes["accepted"] += 1
            continue
        assert result.exit_code == 2, about
        problems = result.stderr.splitlines()
        assert problems, about
        for problem in problems:
            assert re.match(rf"{re.escape(str(path))}:[1-9]\d*:[1-9]\d*: |… and \d+ more", problem), about
            assert not PYDANTIC.search(problem), about
        assert max(map(len, problems)) < TEXT_SIZE + len(str(path)), about
        outcomes["refused"] += 1
    return dict(outcomes)


def check_scenarios(tmp_path, count, seed):
    names = (
        "tumbling-rod", "double-loaded-rods", "chain-5-mixed", "chain-10-balls", "sprung-universal",
        "tree-of-seven-sprung", "free-body-with-rotors", "robot-arm", "four-bar", "bricard", "squeezer",
    )  # fmt: skip
    bases = [parse_yaml(YamlSource(n), find_scenario_file(n).read_text()).data for n in names]
    return check_user_files(tmp_path, lambda draw: mutated(draw.choice(bases), draw), ["check"], count, seed)


def check_sweeps(tmp_path, count, seed):
    out = ["--out", str(tmp_path / "out")]
    return check_user_files(tmp_path, damaged_yaml(SWEEP), ["sweep", *out], count, seed)


def check_known(tmp_path, count, seed):
    text = KNOWN_ISSUES_FILE.read_bytes().split(b"\n- id: ")
    data = b"\n".join(b"- id: my-" + entry for entry in text[1:8])
    (tmp_path / "project.yaml").write_text("")  # the project's own file, without its entries
    with (
        patch("plumbline.cli.run_commands.run_plan", side_effect=Accepted),
        patch("plumbline.cli.options.KNOWN_ISSUES_FILE", tmp_path / "project.yaml"),
    ):
        words = ["run", "rest", "--out", str(tmp_path / "out"), "--known"]
        return check_user_files(tmp_path, damaged_yaml(data), words, count, seed)


@pytest.mark.parametrize(("count", "seed"), [(60, 1), THOUSANDS])
@pytest.mark.parametrize("check", [check_scenarios, check_sweeps, check_known])
def test_damaged_files_of_users_are_bad_files(
    no_work, tmp_path, check, count, seed, record_testsuite_property
):
    outcomes = check(tmp_path, count, seed)
    assert min(outcomes.values()) > 5 and len(outcomes) == 2, outcomes
    record_testsuite_property(f"damaged files, {check.__name__}", outcomes)
