"""The self-test: defects planted in the engines must be reported, and named by their own term.

Runs `tests/execution/test_planted_defects.py` of the checkout, and of the further lists of planted defects
every `NIGHTS`-th test, others each night, in a process that dies with this one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from glob import glob
from pathlib import Path
from typing import Any, NoReturn

from plumbline.layout import ROOT
from plumbline.processes.isolation import die_with_parent

TEST_FILE = "tests/execution/test_planted_defects.py"
LISTS = ("tests/diagnosis/test_*.py", "tests/execution/test_planted_*.py")  # with the long forms
NIGHTS = 7  # in so many nights every test of the lists has run
TIMEOUT = 1800.0  # s
_CHILD_SCRIPT = "from plumbline.execution.selftest import run_child; run_child()"


@dataclass(frozen=True)
class SelfTestResult:
    """What became of the planted defects."""

    counts: dict[str, int] = field(default_factory=dict)  # of planted, reported, named, … defects
    failure: str = ""  # empty where every defect was reported and named as it must be

    @property
    def summary(self) -> str:
        """The result in a sentence."""
        if self.failure:
            return f"the self-test failed: {self.failure}"
        return "self-test: " + ", ".join(f"{n} {what}" for what, n in self.counts.items())


class _Sample:
    """A pytest plugin: all tests of the first file that `make test` has too, and a share of the others."""

    def __init__(self, first: Path, night: int) -> None:
        self.first, self.night = first, night

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        own = [item for item in items if item.path == self.first]
        further = sorted((item for item in items if item.path != self.first), key=lambda item: item.nodeid)
        chosen = [i for i in own if i.get_closest_marker("slow") or not i.get_closest_marker("full")]
        chosen += further[self.night % NIGHTS :: NIGHTS]
        config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = chosen


def run_child() -> NoReturn:
    """Run the tests in this process; its arguments are the parent, the night, the first file and pytest's."""
    import pytest

    parent, night, first, *arguments = sys.argv[1:]
    die_with_parent(int(parent))
    sys.exit(pytest.main(arguments, plugins=[_Sample(Path(first), int(night))]))


def run_self_test(
    report: Path, night: int = 0, tests: str = TEST_FILE, lists: Sequence[str] = LISTS,
    timeout: float = TIMEOUT,
) -> SelfTestResult:  # fmt: skip
    """Run the tests of the planted defects.

    Args:
        night: number of the night, which chooses the tests of the lists.
        tests: test file that runs whole, relative to the checkout.
        lists: patterns of the test files of which a share runs, relative to the checkout.
        timeout: limit of the wall time [s].

    Returns:
        The counts, or why they are not as they must be.

    """
    first = str(ROOT / tests)
    further = {path for pattern in lists for path in glob(str(ROOT / pattern))} - {first}
    pytest_options = ["-q", "-m", "", "-p", "no:cacheprovider", f"--rootdir={ROOT}", f"--junitxml={report}"]
    arguments = [str(os.getpid()), str(night), first, *pytest_options, first, *sorted(further)]
    command = [sys.executable, "-c", _CHILD_SCRIPT, *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=timeout
        )
    except subprocess.TimeoutExpired:
        return SelfTestResult(failure=f"no answer within {timeout:g} s")
    try:
        return read_junit_report(report)
    except (OSError, ET.ParseError):
        last = (done.stdout + done.stderr).strip().splitlines()[-1:] or ["no word"]
        return SelfTestResult(failure=f"pytest ended with {done.returncode}: {last[0]}")


def read_junit_report(report: Path) -> SelfTestResult:
    """Read the result of the self-test.

    Returns:
        The counts, which the tests record as properties, and the tests that failed or were skipped.

    Raises:
        OSError: the file cannot be read.
        ParseError: the file is not XML.

    """
    cases = list(ET.parse(report).iter("testcase"))
    figures = {
        p.attrib["name"]: int(p.attrib["value"])
        for case in cases
        for p in case.iterfind("properties/property")
    }
    bad = [
        case.get("name") or "the tests cannot be read"
        for case in cases
        if case.find("failure") is not None or case.find("error") is not None
    ]
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        return SelfTestResult(figures, f"{', '.join(bad[:3])}{more}")
    skipped = next((c.find("skipped") for c in cases if c.find("skipped") is not None), None)
    if skipped is not None or not cases:
        return SelfTestResult(
            figures, "it was skipped: " + (skipped.get("message", "") if skipped is not None else "empty")
        )
    return SelfTestResult(figures)
