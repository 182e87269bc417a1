"""Build hook of the wheel: all folders lie under `plumbline`, their names are too common for site-packages.

The files are copied and their imports renamed: `from adapters.x` becomes `from plumbline.adapters.x`.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

MOVED = ("adapters", "reference_impl", "reports", "scenarios", "bench/results")
_IMPORT = re.compile(r"^(\s*)(from|import) (adapters|reference_impl|reports)\b(.*)$", re.MULTILINE)


def _renamed(match: re.Match[str]) -> str:
    indent, word, name, rest = match.groups()
    if word == "import" and not rest:
        return f"{indent}from plumbline import {name}"
    return f"{indent}{word} plumbline.{name}{rest}"


class MovedFolders(BuildHookInterface):  # type: ignore[type-arg]
    """Copies the folders into a temporary one, as the wheel has them."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the copied files to the wheel; an editable installation uses those of the checkout."""
        root, self.copy = Path(self.root), Path(tempfile.mkdtemp())
        if version == "editable":
            raise ValueError("an editable installation is a checkout: `make install` prepares it")
        for source in _project_files(root):
            name = source if source.parts[0] == "plumbline" else Path("plumbline") / source
            target = self.copy / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / source, target)
            if target.suffix == ".py":
                text = target.read_text(encoding="utf-8")
                target.write_text(_IMPORT.sub(_renamed, text), encoding="utf-8")
        build_data["force_include"] = {str(self.copy / "plumbline"): "plumbline"}

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the copy."""
        shutil.rmtree(self.copy)


def _project_files(root: Path) -> list[Path]:
    """The files of the folders: those that Git knows in a checkout, all in a source distribution."""
    folders = ("plumbline", *MOVED)
    try:
        listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", "--", *folders]
        done = subprocess.run(listing, cwd=root, capture_output=True, text=True, check=True)
        files = [Path(name) for name in done.stdout.split("\0") if name]
    except (OSError, subprocess.CalledProcessError):
        files = [path.relative_to(root) for folder in folders for path in (root / folder).rglob("*")]
    return [path for path in files if (root / path).is_file() and "__pycache__" not in path.parts]
