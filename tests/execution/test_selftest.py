"""The nightly runs the self-test, and its result counts."""

import re
from types import SimpleNamespace

import pytest

from plumbline.cli import nightly
from plumbline.execution import selftest
from plumbline.execution.selftest import SelfTestResult
from plumbline.storage.results_store import read_results
from tests.helpers.nights import run_night

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
    answer = selftest.run_self_test(tmp_path / "results.xml", 0, str(tmp_path / "test_it.py"), ())
    assert answer.counts == figures
    assert trouble in answer.failure and bool(trouble) == bool(answer.failure)
    assert ("failed" in answer.summary) == bool(trouble)


def test_one_that_hangs_is_ended(tmp_path):
    (tmp_path / "test_it.py").write_text("import time\ndef test_a(): time.sleep(60)\n")
    answer = selftest.run_self_test(tmp_path / "results.xml", 0, str(tmp_path / "test_it.py"), (), 3)
    assert answer.failure == "no answer within 3 s"


LISTED_TESTS = """
import pytest

@pytest.mark.full
@pytest.mark.parametrize("k", range(10))
def test_defect(k):
    assert k != 9
"""


def test_the_lists_are_shared_among_nights(tmp_path):
    """Ten tests of a list: two of them in night 2, the last one among them, which fails."""
    (tmp_path / "test_it.py").write_text(PASSING_TEST)
    (tmp_path / "test_list.py").write_text(LISTED_TESTS)
    report = tmp_path / "results.xml"
    answers = [
        selftest.run_self_test(report, night, str(tmp_path / "test_it.py"), [str(tmp_path / "test_l*.py")])
        for night in (5, 9)
    ]
    assert answers[0].failure == ""
    assert answers[0].counts == {"planted": 3, "reported": 3}
    assert answers[1].failure == "test_defect[9]"
    assert report.read_text(encoding="utf-8").count("<testcase") == 1 + 2


def test_every_test_of_the_lists_runs_within_a_week_of_nights():
    mark = {"full": {"full": True}, "slow": {"full": True, "slow": True}, "fast": {}}
    first, other = selftest.ROOT / "test_first.py", selftest.ROOT / "test_other.py"

    def item(path, kind, number):
        return SimpleNamespace(
            path=path, nodeid=f"{path.name}::{kind}[{number}]", get_closest_marker=mark[kind].get
        )

    config = SimpleNamespace(hook=SimpleNamespace(pytest_deselected=lambda items: None))
    seen = []
    for night in range(3, 3 + selftest.NIGHTS):
        items = [item(path, kind, k) for k in range(8) for path in (other, first) for kind in mark]
        selftest._Sample(first, night).pytest_collection_modifyitems(config, items)
        own = {i.nodeid for i in items if i.path == first}
        assert own == {f"test_first.py::{kind}[{k}]" for kind in ("slow", "fast") for k in range(8)}
        seen += [i.nodeid for i in items if i.path == other]
    assert sorted(seen) == sorted({f"test_other.py::{kind}[{k}]" for kind in mark for k in range(8)})


def test_every_list_of_planted_defects_is_in_the_self_test():
    """A test file of engines with planted defects that no pattern names would run in no night."""
    root = selftest.ROOT
    named = {path for pattern in (*selftest.LISTS, selftest.TEST_FILE) for path in root.glob(pattern)}
    folders = ("diagnosis", "execution")
    found = {
        path
        for folder in folders
        for path in (root / "tests" / folder).glob("test_*.py")
        if re.search("^from tests.helpers.plant(ed_|ing )", path.read_text(encoding="utf-8"), re.M)
    }
    assert found and found <= named


@pytest.mark.parametrize("trouble", ["half of them", ""])
def test_a_night_whose_self_test_misses_a_defect_is_not_green(tmp_path, trouble):
    pytest.importorskip("mujoco")

    def reported(report, night):
        assert night == 1
        report.write_text("<testsuite/>")
        return SelfTestResult({"planted": 67, "reported": 67}, trouble)

    _, place = run_night(tmp_path, level="state", self_test=reported)
    run = read_results(place)["run"]
    assert run["exit_code"] == bool(trouble) and run["self_test"]["planted"] == 67
    assert ("67 planted" in run["sentence"]) == (not trouble) and trouble in run["sentence"]
    assert (place / "self_test.xml").is_file()


def test_a_night_killed_as_it_was_done_is_not_had_twice(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")

    def killed(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(nightly.shutil, "rmtree", lambda path, **more: None if more else killed(path))
        run_night(tmp_path, level="state", seed=None)
    (first,) = (tmp_path / "history").iterdir()
    assert (tmp_path / "unfinished" / "plan.json").exists()
    result, place = run_night(tmp_path, level="state", seed=None)
    seeds = [read_results(p)["run"]["seed"] for p in (first, place)]
    assert place != first and seeds[0] != seeds[1] == result.metadata["seed"]
    assert not (tmp_path / "unfinished").exists()
