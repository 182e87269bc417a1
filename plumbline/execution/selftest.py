"""The instrument's own test: mistakes planted in the engines must be reported, and named by their own term.

The tests of the checkout (`tests/test_planted.py`) run in a process of their own, which dies with this one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TESTS = "tests/test_planted.py"
PATIENCE = 1800.0  # s
_CHILD = (
    "import sys; from plumbline.processes.parent_death import die_with_parent; "
    "die_with_parent(int(sys.argv[1])); "
    "import pytest; sys.exit(pytest.main(sys.argv[2:]))"
)


@dataclass(frozen=True)
class Answer:
    """What became of the planted mistakes; ``trouble`` is empty where all was as it must be."""

    figures: dict[str, int] = field(default_factory=dict)  # planted, reported, named, false namings, …
    trouble: str = ""

    @property
    def sentence(self) -> str:
        """The answer in words."""
        if self.trouble:
            return f"the instrument's own test failed: {self.trouble}"
        return "the instrument's own test: " + ", ".join(f"{n} {what}" for what, n in self.figures.items())


def check(report: Path, tests: str = TESTS, patience: float = PATIENCE) -> Answer:
    """Run the tests, their JUnit file written to ``report``."""
    arguments = ["-q", "-p", "no:cacheprovider", f"--rootdir={ROOT}", f"--junitxml={report}", tests]
    command = [sys.executable, "-c", _CHILD, str(os.getpid()), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=patience
        )
    except subprocess.TimeoutExpired:
        return Answer(trouble=f"no answer within {patience:g} s")
    try:
        return read(report)
    except (OSError, ET.ParseError):
        last = (done.stdout + done.stderr).strip().splitlines()[-1:] or ["no word"]
        return Answer(trouble=f"pytest ended with {done.returncode}: {last[0]}")


def read(report: Path) -> Answer:
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
        return Answer(figures, f"{', '.join(bad[:3])}{more}")
    skipped = next((c.find("skipped") for c in cases if c.find("skipped") is not None), None)
    if skipped is not None or not cases:
        return Answer(
            figures, "it was skipped: " + (skipped.get("message", "") if skipped is not None else "empty")
        )
    return Answer(figures)
