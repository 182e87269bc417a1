"""Nights of few scenarios, which say nothing of their progress."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from plumbline.cli import nightly
from plumbline.execution.runner import RunResult
from plumbline.processes.worker_pool import Limits
from plumbline.scenario import loader
from plumbline.scenario.loader import Scenario


def run_night(
    out: Path, *engines: str, scenarios: Sequence[Scenario] = (), **more: Any
) -> tuple[RunResult, Path]:
    """A night of "rest" and no random scenarios on MuJoCo, unless options say otherwise."""
    options = {
        "random_count": 0, "seed": 11, "jobs": 1, "limits": Limits(), "is_full_catalogue": False,
        "extra_refinements": 0, "progress": lambda *_: None,
    }  # fmt: skip
    return nightly.run_nightly(
        out, scenarios or loader.load_scenarios(["rest"]), engines or ["mujoco"],
        command="-", log=lambda _: None, **options | more,
    )  # fmt: skip
