"""The table of docs/platforms.md, from the markers of pyproject.toml and what the code asks of a platform.

`python -m tools.platform_table` prints it.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

from plumbline.truth.step_formulas import MAX_EXTENDED_EPSILON

ROOT = Path(__file__).resolve().parents[1]
YES = "yes"


class Platform(NamedTuple):
    """A system on a processor."""

    system: str  # as people call it
    processor: str
    sys_platform: str  # of Python
    long_double_bits: int  # of the significand of C's long double
    is_tested: bool = False


PLATFORMS = (
    Platform("Linux", "x86-64", "linux", 64, is_tested=True),
    Platform("Linux", "arm64", "linux", 113),
    Platform("macOS", "x86-64", "darwin", 64),
    Platform("macOS", "arm64", "darwin", 53),
    Platform("Windows", "x86-64", "win32", 53),
)


def absent_packages(extra: str, platform: Platform, python: str) -> list[str]:
    """List the packages of an extra that its markers leave out.

    Args:
        python: version of Python, as "3.11".

    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    where = {"sys_platform": platform.sys_platform, "python_version": python}
    requirements = map(Requirement, project["optional-dependencies"][extra])
    return [one.name for one in requirements if one.marker and not one.marker.evaluate(where)]


def table() -> list[str]:
    """Return the lines of the table."""
    lines = [
        "| system, processor | state, trajectory, invariants, relations | step | Taylor's method, proofs "
        "| engines | a worker that dies takes its engine along | runs in CI |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in PLATFORMS:
        has_extended = 2.0 ** (1 - one.long_double_bits) < MAX_EXTENDED_EPSILON
        without = absent_packages("all", one, "3.11")
        cells = [
            f"{one.system}, {one.processor}",
            YES,
            YES if has_extended else "unsupported here: no extended precision",
            "without heyoka: DOP853 and collocation" if absent_packages("truth", one, "3.11") else YES,
            f"all but {', '.join(without)}" if without else "all",
            YES if one.sys_platform == "linux" else "at its end only",  # die_with_parent, adopt_orphans
            YES if one.is_tested else "no",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    print("\n".join(table()))
