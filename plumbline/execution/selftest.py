"""The instrument's own test: mistakes planted in the engines must be reported, and named by their own term.

The tests of the checkout (`tests/execution/test_planted_defects.py`) run in a process of their own, which dies with this one.
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
TIMEOUT = 1800.0  # s
_CHILD_SCRIPT = (
    "import sys; from plumbline.processes.isolation import die_with_parent; "
    "die_with_parent(int(sys.argv[1])); "
    "import pytest; sys.exit(pytest.main(sys.argv[2:]))"
)


@dataclass(frozen=True)
class SelfTestResult:
    """What became of the planted mistakes; ``trouble`` is empty where all was as it must be."""

    counts: dict[str, int] = field(default_factory=dict)  # planted, reported, named, false namings, …
    failure: str = ""

    @property
    def summary(self) -> str:
        """The answer in words."""
        if self.failure:
            return f"the instrument's own test failed: {self.failure}"
        return "the instrument's own test: " + ", ".join(f"{n} {what}" for what, n in self.counts.items())


def run_self_test(report: Path, tests: str = TEST_FILE, timeout: float = TIMEOUT) -> SelfTestResult:
    """Run the tests, their JUnit file written to ``report``."""
    arguments = ["-q", "-p", "no:cacheprovider", f"--rootdir={ROOT}", f"--junitxml={report}", tests]
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
    """The answer that a JUnit file gives."""
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
