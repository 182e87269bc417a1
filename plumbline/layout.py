"""Where the project's folders are: beside this package in a checkout, in this package where it is installed.

The build of the wheel (`hatch_build.py`) moves these folders into `plumbline` and renames their imports.
"""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
IS_INSTALLED = (_PACKAGE / "adapters").is_dir()
ROOT = _PACKAGE if IS_INSTALLED else _PACKAGE.parent  # has adapters, reference_impl, scenarios and reports
PREFIX = "plumbline." if IS_INSTALLED else ""  # of the names of their modules
DEFAULT_OUT = Path("plumbline-out") if IS_INSTALLED else Path("reports") / "out"
_GENERATED = "\n<!-- What follows is generated. -->\n\n"  # in pages of docs, after what is written by hand


def output_folder(name: str) -> Path:
    """Return the folder that a command writes to by default, below the current folder.

    Args:
        name: the folder in a checkout; elsewhere it is in `DEFAULT_OUT`, the only one in the user's folder.

    """
    return DEFAULT_OUT / name if IS_INSTALLED else Path(name)


def generated_page(path: str, part: str) -> str:
    """Return a page of the documentation with another generated part.

    Args:
        path: of the page, relative to the folder of the documentation.
        part: Markdown, all that follows what is written by hand.

    """
    by_hand, mark, _ = (ROOT / "docs" / path).read_text(encoding="utf-8").partition(_GENERATED)
    return by_hand + mark + part
