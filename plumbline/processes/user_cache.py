"""The user's cache folder."""

from __future__ import annotations

import os
from pathlib import Path


def user_cache_folder() -> Path:
    """Locate the folder of what can be made again.

    Returns:
        The folder of the variable PLUMBLINE_CACHE, else ``plumbline`` in the platform's cache folder; it need
        not exist.

    """
    if given := os.environ.get("PLUMBLINE_CACHE"):
        return Path(given)
    if os.name == "nt":
        home = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    else:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "plumbline"
