"""Damaged files of results folders end commands with exit code 2 and the file's name, never a traceback."""

import json
import random
import shutil
from collections import Counter

import pytest
from click.testing import CliRunner

from plumbline.cli.main import main
from reports.reference_tables import STORED_RESULTS
from tests.helpers import example_results
from tests.helpers.mutations import damaged_bytes, damaged_document, limited_time

STORED_FILES = (
    "results.json", "results.json", "results.json", "scripts/index.json", "summary.parquet", "states.parquet",
    "convergence.parquet", "curves.parquet", "trajectories.parquet", "drift.parquet", "figures.json",
)  # fmt: skip
TEXT_SIZE = 400  # letters; a longer message is no sentence


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
    if name.endswith(".json") and draw.random() < 0.7:
        path.write_bytes(json.dumps(damaged_document(json.loads(path.read_bytes()), draw)).encode())
    else:
        path.write_bytes(damaged_bytes(path.read_bytes(), draw))
    return name


def check_examples(stored, tmp_path, command, count, seed):
    draw, outcomes = random.Random(seed), Counter()
    folder = tmp_path / "history" / stored.name
    for number in range(count):
        name = damage(stored, folder, draw)
        words = {
            "report": ["report", str(folder)],
            "report --history": ["report", str(stored), "--history", str(tmp_path)],
            "history": ["history", str(tmp_path), "--key", "*"],
            "reproduce": ["reproduce", str(folder)],
        }[command]
        with limited_time():
            result = CliRunner().invoke(main, words)
        about = f"example {number} of seed {seed}, {name}: {result.output[-2000:]}"
        assert result.exit_code in (0, 2), about
        assert "Traceback" not in result.output, about
        if result.exit_code == 2:
            message = result.stderr.split("Error: ", 1)[-1]
            assert name.rsplit("/")[-1] in message, about
            assert max(map(len, message.splitlines())) < TEXT_SIZE + len(str(folder)), about
        outcomes[result.exit_code] += 1
    return outcomes


COMMANDS = ("report", "report --history", "history", "reproduce")


@pytest.mark.parametrize("command", COMMANDS)
def test_damaged_results_are_bad_files(stored, tmp_path, command):
    outcomes = check_examples(stored, tmp_path, command, 100, seed=1)
    assert command in ("history", "report --history") or min(outcomes[0], outcomes[2]) > 10, outcomes


@pytest.mark.full
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("command", COMMANDS)
def test_thousands_of_damaged_results_are_bad_files(stored, tmp_path, command, record_testsuite_property):
    outcomes = check_examples(stored, tmp_path, command, 5000, seed=2)
    record_testsuite_property(f"damaged stores, {command}: by exit code", dict(outcomes))
