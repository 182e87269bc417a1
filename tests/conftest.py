"""Rules for every test: which process runs it, which run nightly, which skips continuous integration allows.

`pytest -n 3` keeps the tests of a file in one process, so that what they share is computed once; the
scenarios of the matrix are distributed one by one, and all of tests/architecture is in one process, which
parses the source once.  Three processes keep two cores busy while a test waits for a time limit, a cluster or
a browser.  (pytest-xdist's loadgroup has no effect with pytest 9.2: pytest-dev/pytest-xdist#1386.)
"""

import gc
import itertools
import os
import re
import sys
from unittest.mock import patch

import pytest

# Bytecode is compiled once and kept, whatever the machine's default: the tests start many processes.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

from tests.helpers import array_checks  # noqa: E402 (bytecode of the tests too)

array_checks.install()

from plumbline.processes import worker_pool  # noqa: E402 (after the checks)
from plumbline.processes.user_cache import user_cache_folder  # noqa: E402
from tests.helpers.nightly_tests import SLOW, is_nightly, stale_entries  # noqa: E402

# Ten thousand collected tests live as long as the process: looking through them for garbage after every 700
# objects, as Python does, takes half of the time of what makes many, as of syntax trees.
gc.set_threshold(50_000, 20, 20)

os.environ.pop("COLUMNS", None)  # GNU readline sets it for processes of pytest-xdist; lines would wrap

JUDGES = "plumbline.execution.scenario_verdicts"
ALLOWED_SKIPS = {  # pattern of the skip's reason: why continuous integration cannot run the test
    r"root may read everything": "the test needs a user without root's permissions",
    r"`make importers` installs it": "the other importers' wheels are large and optional",
    r"crates are not on this machine": "a server's sources are optional; `make engines` fetches them",
    r"is not built here: ": "servers of further engines are large and optional; `make engines` builds them",
}

LONGEST_FIRST = (  # begun last, one of these would keep one process busy while the others have no work;
    # dask_cluster, worker_pool, protocol and resume mostly wait, so one begins when another ends
    "report_browser", "dask_cluster", "step_level", "adapter_contract", "exit_codes", "worker_pool",
    "scenario_verdicts", "mechanisms", "certificate_proof", "planted_edits", "integrator_search", "protocol",
    "every_step", "planted_defects", "diagnose", "command_line", "tree_motions", "resume", "planted_joints",
    "wheel", "hostile_folder", "needs", "any_difference", "sweep", "smallest_detectable_mistake", "scripts",
    "coverage_table", "honest_engines", "action", "conformance", "storage_faults", "layers",
    "immovable_loops", "mechanism_of_file", "exudyn_engine", "selftest", "misbehaving_engines", "docs",
    "definition", "nightly", "damaged_files", "environments", "relations",
)  # fmt: skip
LAST = ("matrix",)  # scenario by scenario it fills what is left


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    rank = {f"test_{name}.py": place for place, name in enumerate(LONGEST_FIRST)}
    rank |= {f"test_{name}.py": len(rank) + 1 for name in LAST}
    items.sort(key=lambda item: rank.get(item.path.name, len(LONGEST_FIRST)))
    for item in items:
        if is_nightly(item.nodeid) and not item.get_closest_marker("full"):  # a long form stays one
            for mark in SLOW:
                item.add_marker(mark)
    if config.args == ["tests"] and not config.getoption("ignore"):  # all tests are there
        fast = {item.nodeid for item in items if not item.get_closest_marker("full")}
        if stale := stale_entries({item.nodeid for item in items}, fast):
            raise pytest.UsageError(f"tests/nightly_tests.txt: {'; '.join(stale)}")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid):
            if nodeid.startswith("tests/architecture/"):
                return "tests/architecture"
            return nodeid.partition(": ")[0] if "::test_cell[" in nodeid else super()._split_scope(nodeid)

    config.option.loadscopereorder = False  # else files of many short tests begin first
    return Scheduling(config, log)


@pytest.fixture(scope="session")
def cache_folders(tmp_path_factory):
    """Caches, one for each test: tmp_path_factory would look through all of them to name another.

    All tests share the environments of engines, and what is remembered by its content and the code that made
    it: parsed files and compiled integrators.
    """
    engines, remembered = user_cache_folder() / "engines", user_cache_folder() / "tests" / "remembered"
    for path in (engines, remembered):
        path.mkdir(parents=True, exist_ok=True)
    caches = tmp_path_factory.mktemp("caches")

    def make(number):
        folder = caches / str(number)
        folder.mkdir()
        (folder / "engines").symlink_to(engines)
        (folder / "remembered").symlink_to(remembered)
        return folder

    return map(make, itertools.count())


@pytest.fixture(scope="session", autouse=True)
def warm_process():
    """Workers are forked with what most of them import, whichever test starts the first one."""
    start = worker_pool.start_warm_process
    with patch.object(worker_pool, "start_warm_process", lambda *_: start([JUDGES])):
        yield


@pytest.fixture(autouse=True)
def own_cells(cache_folders, monkeypatch):
    """A test finds no cells of other runs."""
    folder = next(cache_folders)
    monkeypatch.setenv("PLUMBLINE_CACHE", str(folder))
    return folder / "cells"


@pytest.fixture
def nothing_remembered(own_cells):
    """A test finds nothing that others have read, compiled or consented to."""
    (own_cells.parent / "remembered").unlink()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    array_checks.activate(item.path.parent.name)
    return (yield)


def _is_unexpected(report):
    if not (os.environ.get("CI") and report.skipped) or hasattr(report, "wasxfail"):
        return False
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return not any(re.search(pattern, reason) for pattern in ALLOWED_SKIPS)


def _fail(report):
    report.outcome = "failed"
    report.longrepr = f"skipped without being listed in tests/conftest.py: {report.longrepr}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if _is_unexpected(report):
        _fail(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    report = yield
    if _is_unexpected(report):
        _fail(report)
    return report
