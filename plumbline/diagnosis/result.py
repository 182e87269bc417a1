"""What a diagnosis returns."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Diagnosis:
    """What is known about the cause of a disagreement."""

    text: str
    scatter: float | None = None  # of the error over its size, where it was measured
