"""The self-test: defects planted in the engines must be reported, and named by their own term.

Runs `tests/execution/test_planted_defects.py` of the checkout in a process that dies with this one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEST_FILE = "tests/execution/test_planted_defects.py"
MARKS = "slow or not full"  # with what `make test` leaves out for its time, without the long forms
TIMEOUT = 1800.0  # s
_CHILD_SCRIPT = (
    "import sys; from plumbline.processes.isolation import die_with_parent; "
    "die_with_parent(int(sys.argv[1])); "
    "import pytest; sys.exit(pytest.main(sys.argv[2:]))"
)


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


def run_self_test(report: Path, tests: str = TEST_FILE, timeout: float = TIMEOUT) -> SelfTestResult:
    """Run the tests of the planted defects.

    Args:
        report: path of the JUnit file to write.
        tests: test file, relative to the checkout.
        timeout: limit of the wall time [s].

    Returns:
        The counts, or why they are not as they must be.

    """
    arguments = [
        "-q",
        "-m",
        MARKS,
        "-p",
        "no:cacheprovider",
        f"--rootdir={ROOT}",
        f"--junitxml={report}",
        tests,
    ]
    command = [sys.executable, "-c", _CHILD_SCRIPT, str(os.getpid()), *arguments]
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

    Args:
        report: path of pytest's JUnit file.

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
