"""Tables of cases, in a YAML file beside the test file that runs them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from plumbline.scenario.yaml_reader import read_yaml


def table(path: Path | str, name: str = "") -> Any:
    """The table of a test file, or one of its tables: parsed once on a machine, as YAML takes seconds."""
    source = read_yaml(Path(path).with_suffix(".yaml"))
    assert not source.problems, source.problems
    return source.data[name] if name else source.data
