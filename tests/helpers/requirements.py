"""What tests need of this machine; without it they are skipped."""

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


def require_engines():
    """For a whole file: MuJoCo, Pinocchio, Exudyn and the library of certified truth."""
    for package in ("mujoco", "pinocchio", "exudyn", "flint"):
        pytest.importorskip(package)


def require_extended_precision():
    """For a whole file: numbers with more digits than doubles."""
    if not HAS_EXTENDED_PRECISION:
        pytest.skip("no extended precision on this machine", allow_module_level=True)
