"""Random words for every option and argument: a command goes on, or ends with exit code 2 and a sentence."""

import os
import random
from collections import Counter
from contextlib import ExitStack
from unittest.mock import patch

import click
import pytest

from plumbline.cli.main import COMMANDS, main
from tests.helpers import ROOT, example_results
from tests.helpers.commands import invoke
from tests.helpers.mutations import limited_time

WORDS = (  # no path outside the test's folder that could be written to
    "nan", "inf", "-inf", "-1", "-0", "0", "1", "2", "7", "0.5", "1e308", "1e-308", "1e400", "0x10", "1_000",
    "٣", "9" * 30, "9" * 5000, "", " ", "x", "-", "--", "--out", "a" * 300, "a" * 5000, "\udcff",
    "\u202e", "a\nb", "[red]x[/nope]", "*", "[", "**/", "$(reboot)", ".", "~", "/dev/null", "/dev/zero",
    "/proc/self/mem",
    "rest", "REST", "tumbling-bal", "single", "mujoco", "mujoco@", "mujoco@x", "mujoco@3.12.0", "@", "state",
    "mujoco@nothing.whl", "all", "scenarios", "engines", "1e-6", "tcp://", "tcp://127.0.0.1:1", ":8786",
    "http://x/y", "rest/mujoco/state/-/acceleration",
)  # fmt: skip
VALID = {  # by option or argument, a word that is accepted
    "names": "rest", "families": "single", "engines": "mujoco", "level": "state", "jobs": "2", "out": "out",
    "scheduler": "tcp://127.0.0.1:1", "known_files": "known.yaml", "user_rtol": "1e-6", "timeout": "9",
    "memory": "2", "random_count": "3", "random_trajectories": "1", "seed": "9", "extra_refinements": "1",
    "long_run_seconds": "10", "file": "sweep.yaml", "files": "mine.yaml", "keys": "a/b",
    "folder": "history/20260101T000000Z",
    "what": "scenarios", "rtols": "1e-6", "max_cpu_seconds": "3", "history_folder": "history", "pattern": "*",
    "duration": "1", "precision": "quad", "proof_cpu_seconds": "9",
    "base": "free", "state_count": "3", "state": "hip=0.1", "root": "history", "form": "mujoco",
    "target": "mine.yaml", "key": "a/b", "engine": "mujoco", "good": "3.9.0", "bad": "4.0.0",
    "expected": "rest", "strip_geometry": "", "as_json": "", "self_test": "", "fresh": "", "help": "",
}  # fmt: skip
WORK = (  # where the work of a command begins
    "plumbline.cli.run_commands.run_plan", "plumbline.cli.nightly.run_plan", "plumbline.studies.sweep.run",
    "plumbline.execution.runner.describe_engines", "plumbline.cli.scenario_commands.describe_engines",
    "plumbline.studies.drift.measure_drift", "plumbline.cli.study_commands.run_plan",
    "plumbline.reproduce.write.make_script", "plumbline.truth.certificate_proof.prove_motion",
    "plumbline.cli.nightly.prove_changed_motions", "plumbline.cli.model_commands.run_model_files",
    "plumbline.cli.bisect_command.search_versions",
)  # fmt: skip
WORKERS = (
    "plumbline.cli.study_commands.WorkerPool", "plumbline.cli.scenario_commands.WorkerPool",
    "plumbline.reproduce.write.WorkerPool",
)  # fmt: skip
SWEEP = "schema_version: 1\nscenario: rest\nvary: {'bodies[0].mass': {values: [1, 2]}}\nduration: 0.25\n"
MESSAGE_LINES, MESSAGE_SIZE = 110, 1500


class Accepted(BaseException):
    """Raised where the work of a command would begin."""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A current folder with one path of every kind; their names."""
    monkeypatch.chdir(tmp_path)
    results = example_results.build_small(tmp_path / "history" / "20260101T000000Z")
    (tmp_path / "binary").write_bytes(os.urandom(300))
    for name in ("empty.yaml", "known.yaml"):
        (tmp_path / name).write_text("")
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    (tmp_path / "mine.yaml").write_text((ROOT / "scenarios" / "single" / "rest.yaml").read_text())
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    os.mkfifo(tmp_path / "pipe.yaml")
    for name in ("locked", "locked.yaml"):
        (tmp_path / name).write_text("x")
        (tmp_path / name).chmod(0)
    names = [path.name for path in tmp_path.iterdir()]
    return [*names, "missing", "missing.yaml", "binary/below", str(results), str(results / "results.json")]


def random_words(command, draw, places):
    """Words for a command: options and arguments, most with a valid value, the others with random ones."""

    def word(parameter):
        if draw.random() < 0.6:
            return VALID[parameter.name]
        return draw.choice(places if draw.random() < 0.4 else WORDS)

    options = [p for p in command.params if isinstance(p, click.Option)]
    arguments = [p for p in command.params if isinstance(p, click.Argument)]
    chosen = []
    for option in draw.choices(options, k=draw.choice((0, 1, 2, 3))) if options else ():
        chosen.append(draw.choice(option.opts + option.secondary_opts))
        chosen += [] if option.is_flag and draw.random() < 0.97 else [word(option)]
    if draw.random() < 0.02:
        chosen.append("--no-such-option")
    given = [word(argument) for argument in arguments if argument.required or draw.random() < 0.8]
    given += [draw.choice(WORDS)] * (draw.random() < 0.05)
    return chosen + given if draw.random() < 0.7 else given + chosen


def check_commands(places, count, seed):
    """Call every command with random words; count the outcomes of each."""
    draw, outcomes = random.Random(seed), {name: Counter() for name in COMMANDS}
    names = sorted(COMMANDS)
    with ExitStack() as stack:
        for target in WORK:
            stack.enter_context(patch(target, side_effect=Accepted))
        for target in WORKERS:
            stack.enter_context(patch(target)).return_value.__enter__.side_effect = Accepted
        for number in range(count):
            name = names[number % len(names)]
            words = [name, *random_words(main.get_command(None, name), draw, places)]
            try:
                with limited_time():
                    result = invoke(*words)
            except Accepted:
                outcomes[name]["accepted"] += 1
                continue
            about = (
                f"example {number} of seed {seed}: {[word[:300] for word in words]}: {result.output[-2000:]}"
            )
            assert result.exit_code in (0, 1, 2) and "Traceback" not in result.output, about
            assert result.exit_code != 1 or name == "reproduce", about
            if result.exit_code == 2:
                lines, typed = result.stderr.splitlines(), sum(map(len, words))
                assert lines and len(lines) < MESSAGE_LINES, about
                assert max(map(len, lines)) < MESSAGE_SIZE + typed, about
            outcomes[name][result.exit_code] += 1
    return outcomes


def test_random_words_are_accepted_or_refused_with_a_sentence(place):
    outcomes = check_commands(place, 200, seed=1)
    assert all(counts[2] > 2 for name, counts in outcomes.items() if name != "schema"), outcomes
    assert sum(counts["accepted"] + counts[0] for counts in outcomes.values()) > 40, outcomes


@pytest.mark.full
@pytest.mark.timeout(3600)
def test_thousands_of_random_words(place, record_testsuite_property):
    for name, counts in check_commands(place, 5000, seed=2).items():
        record_testsuite_property(f"random words, {name}: by exit code", dict(counts))
