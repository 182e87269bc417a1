"""What tests need of this machine, without which they are skipped, and an index of packages that refuses."""

import os
import shutil
from importlib.util import find_spec

import pytest

from plumbline.engines import environments
from plumbline.truth.step_formulas import HAS_EXTENDED_PRECISION

needs_truth_tools = pytest.mark.skipif(
    not all(map(find_spec, ("heyoka", "mpmath", "flint"))), reason="the truth tools are not installed"
)
needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
needs_uv = pytest.mark.skipif(
    not (shutil.which("uv") or (environments.ROOT / ".uv" / "bin" / "uv").exists()),
    reason="uv is not installed here",
)


def require_package_index():
    """For a test: an index of packages that answers."""
    try:
        environments.newest_requirement("packaging", pre=False)
    except environments.EnvironmentUnavailable as error:
        pytest.skip(f"no package index can be reached: {error}")


def refuse_packages(monkeypatch, folder):
    """For a test: the only index of packages is the port of discard, and uv remembers nothing of others."""
    for name in ("UV_INDEX_URL", "UV_EXTRA_INDEX_URL", "UV_INDEX", "UV_FIND_LINKS", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("UV_DEFAULT_INDEX", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("UV_HTTP_RETRIES", "0")
    monkeypatch.setenv("UV_CACHE_DIR", str(folder / "uv"))


def require_engines():
    """For a whole file: MuJoCo, Pinocchio, Exudyn and the library of certified truth."""
    for package in ("mujoco", "pinocchio", "exudyn", "flint"):
        pytest.importorskip(package)


def require_extended_precision():
    """For a whole file: numbers with more digits than doubles."""
    if not HAS_EXTENDED_PRECISION:
        pytest.skip("no extended precision on this machine", allow_module_level=True)
