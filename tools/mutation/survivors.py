"""Mutants that no test notices, as `survivors.yaml` lists them by file, function, change and reason."""

from __future__ import annotations

from pathlib import Path

from ruamel.yaml import YAML

SURVIVORS_FILE = Path(__file__).with_suffix(".yaml")
MutantKey = tuple[str, str, str, int]  # file, function, change, occurrence of that change in the function


def load_survivors() -> dict[MutantKey, str]:
    """Return the reason for every listed survivor; raise ValueError if one is listed twice."""
    found: dict[MutantKey, str] = {}
    for entry in YAML(typ="safe").load(SURVIVORS_FILE) or ():
        for mutant in entry["mutants"]:
            for occurrence in mutant["occurrences"]:
                key = entry["file"], mutant["function"], mutant["change"], occurrence
                if key in found:
                    raise ValueError(f"{SURVIVORS_FILE.name} lists twice: {key}")
                found[key] = entry["reason"]
    return found
