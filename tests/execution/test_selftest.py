"""The nightly runs the self-test, and its result counts."""

import json

import pytest

from plumbline.cli import nightly
from plumbline.execution import selftest
from plumbline.execution.selftest import SelfTestResult
from plumbline.processes.workers import Limits
from plumbline.scenario import loader

PASSING_TEST = """
def test_rates(record_property):
    record_property("planted", 3)
    record_property("reported", 3)
"""
FAILING_TEST = (
    PASSING_TEST
    + """
def test_that_fails():
    assert False
"""
)
SKIPPED_TEST = """
import pytest
pytest.importorskip("no_such_module_at_all")
"""


@pytest.mark.parametrize(
    ("text", "figures", "trouble"),
    [
        (PASSING_TEST, {"planted": 3, "reported": 3}, ""),
        (FAILING_TEST, {"planted": 3, "reported": 3}, "test_that_fails"),
        (SKIPPED_TEST, {}, "skipped"),
        ("import nothing_of_that_name", {}, "cannot be read"),
        ("", {}, "empty"),
    ],
    ids=["passing", "failing", "skipped", "unreadable", "empty"],
)
def test_the_answer_is_that_of_the_tests(tmp_path, text, figures, trouble):
    (tmp_path / "test_it.py").write_text(text)
    answer = selftest.run_self_test(tmp_path / "results.xml", str(tmp_path / "test_it.py"))
    assert answer.counts == figures
    assert trouble in answer.failure and bool(trouble) == bool(answer.failure)
    assert ("failed" in answer.summary) == bool(trouble)


def test_one_that_hangs_is_ended(tmp_path):
    (tmp_path / "test_it.py").write_text("import time\ndef test_a(): time.sleep(60)\n")
    answer = selftest.run_self_test(tmp_path / "results.xml", str(tmp_path / "test_it.py"), timeout=3)
    assert answer.failure == "no answer within 3 s"


@pytest.mark.parametrize("trouble", ["", "half of them"])
def test_a_night_whose_self_test_misses_a_defect_is_not_green(tmp_path, trouble):
    pytest.importorskip("mujoco")

    def reported(report):
        report.write_text("<testsuite/>")
        return SelfTestResult({"planted": 67, "reported": 67}, trouble)

    _, place = nightly.run_nightly(
        tmp_path, loader.load_scenarios(["rest"]), ["mujoco"], random_count=0, seed=1, jobs=1,
        limits=Limits(), is_full_catalogue=False, command="-", level="state",
        self_test=reported, progress=lambda *_: None,
        log=lambda _: None,
    )  # fmt: skip
    run = json.loads((place / "results.json").read_text())["run"]
    assert run["exit_code"] == bool(trouble) and run["self_test"]["planted"] == 67
    assert ("67 planted" in run["sentence"]) == (not trouble) and trouble in run["sentence"]
    assert (place / "self_test.xml").is_file()


def test_a_night_killed_as_it_was_done_is_not_had_twice(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")

    def night():
        return nightly.run_nightly(
            tmp_path, loader.load_scenarios(["rest"]), ["mujoco"], random_count=0, seed=None, jobs=1,
            limits=Limits(), is_full_catalogue=False, command="-", level="state",
            progress=lambda *_: None, log=lambda _: None,
        )  # fmt: skip

    def killed(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(nightly.shutil, "rmtree", lambda path, **more: None if more else killed(path))
        night()
    (first,) = (tmp_path / "history").iterdir()
    assert (tmp_path / "unfinished" / "plan.json").exists()
    result, place = night()
    seeds = [json.loads((p / "results.json").read_text())["run"]["seed"] for p in (first, place)]
    assert place != first and seeds[0] != seeds[1] == result.metadata["seed"]
    assert not (tmp_path / "unfinished").exists()
