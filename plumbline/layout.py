"""Where the project's folders are: beside this package in a checkout, in this package where it is installed.

The build of the wheel (`hatch_build.py`) moves these folders into `plumbline` and renames their imports.
"""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
IS_INSTALLED = (_PACKAGE / "adapters").is_dir()
ROOT = _PACKAGE if IS_INSTALLED else _PACKAGE.parent  # has adapters, reference_impl, scenarios and reports
PREFIX = "plumbline." if IS_INSTALLED else ""  # of the names of their modules
DEFAULT_OUT = Path("plumbline-out") if IS_INSTALLED else Path("reports") / "out"


def output_folder(name: str) -> Path:
    """Return the folder that a command writes to by default, below the current folder.

    Args:
        name: the folder in a checkout; elsewhere it is in `DEFAULT_OUT`, the only one in the user's folder.

    """
    return DEFAULT_OUT / name if IS_INSTALLED else Path(name)
