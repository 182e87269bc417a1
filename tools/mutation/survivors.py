"""The mutants that no test notices, as `survivors.yaml` lists them by file and reason."""

from __future__ import annotations

from pathlib import Path

from ruamel.yaml import YAML

FILE = Path(__file__).with_suffix(".yaml")
Key = tuple[str, str, str]  # file, what stands there, what the mutant has


def listed() -> dict[Key, str]:
    """Each with its reason; ValueError where one is listed twice."""
    found: dict[Key, str] = {}
    for entry in YAML(typ="safe").load(FILE) or ():
        for mutant in entry["mutants"]:
            for now in [mutant["now"]] if isinstance(mutant["now"], str) else mutant["now"]:
                key = entry["file"], mutant["was"], now
                if key in found:
                    raise ValueError(f"{FILE.name} lists twice: {key}")
                found[key] = entry["why"]
    return found
