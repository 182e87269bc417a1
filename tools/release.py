"""Make a release: build the wheel, check it in an empty environment, tag the commit, write the notes.

    python -m tools.release      (`make release`)

The version is that of `plumbline/__init__.py`; CHANGELOG.md must have a section of its name. Nothing is
published: the workflow `release`, which a person starts, does that with the files of `dist`.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from plumbline import __version__

ROOT = Path(__file__).resolve().parents[1]
CHECKS = ("tests/cli/test_wheel.py", "-q", "-m", "")


def release_notes(changelog: str, version: str) -> str:
    """Find the section of a version in the changelog.

    Returns:
        Its text without the heading; empty where there is none.

    """
    pattern = rf"^## {re.escape(version)}(?![\w.])[^\n]*\n(.*?)(?=^## |\Z)"
    found = re.search(pattern, changelog, re.MULTILINE | re.DOTALL)
    return found[1].strip() if found else ""


def problem(status: str, tags: str, changelog: str, version: str) -> str:
    """Find what prevents a release.

    Args:
        status: of `git status --porcelain`.
        tags: of `git tag --list`.

    Returns:
        A sentence; empty where nothing does.

    """
    if status:
        return f"files differ from the commit: {', '.join(line[3:] for line in status.splitlines()[:5])}"
    if f"v{version}" in tags.split():
        return f"v{version} is a tag already; the version is in plumbline/__init__.py"
    if release_notes(changelog, "Unreleased"):
        return f"CHANGELOG.md has changes under `## Unreleased`, which belong under `## {version}`"
    return "" if release_notes(changelog, version) else f"CHANGELOG.md has no section `## {version}`"


def main() -> int:
    """Make the release of this commit.

    Returns:
        The exit code.

    """
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    if reason := problem(_git("status", "--porcelain"), _git("tag", "--list"), changelog, __version__):
        print(f"no release: {reason}", file=sys.stderr)
        return 2
    for command in (["-m", "hatchling", "build", "-t", "wheel", "-d", "dist"], ["-m", "pytest", *CHECKS]):
        subprocess.run([sys.executable, *command], cwd=ROOT, check=True)
    (ROOT / "dist" / "notes.md").write_text(f"{release_notes(changelog, __version__)}\n", encoding="utf-8")
    _git("tag", "--annotate", f"v{__version__}", "--file", "dist/notes.md")
    print(f"tagged v{__version__}; dist has the wheel and its notes; next: git push origin v{__version__}")
    return 0


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
