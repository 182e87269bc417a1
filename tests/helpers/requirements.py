"""What a test file needs of this machine; without it the file is skipped."""

import pytest

from plumbline.truth.step_formulas import HAS_EXTENDED_PRECISION


def require_engines():
    """MuJoCo, Pinocchio, Exudyn and the library of certified truth."""
    for package in ("mujoco", "pinocchio", "exudyn", "flint"):
        pytest.importorskip(package)


def require_extended_precision():
    """Numbers with more digits than doubles."""
    if not HAS_EXTENDED_PRECISION:
        pytest.skip("no extended precision on this machine", allow_module_level=True)
