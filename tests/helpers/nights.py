"""Nights of few scenarios, which say nothing of their progress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from plumbline.cli import nightly
from plumbline.execution.plan import Plan
from plumbline.execution.runner import RunResult
from plumbline.scenario import loader
from plumbline.scenario.loader import Scenario


def run_night(
    out: Path, *engines: str, scenarios: Sequence[Scenario] = (), **more: Any
) -> tuple[RunResult, Path]:
    """A night of "rest" and no random scenarios on MuJoCo, unless options say otherwise."""
    planned = {name: more.pop(name) for name in set(more) & {field.name for field in fields(Plan)}}
    plan = Plan(scenarios or loader.load_scenarios(["rest"]), engines or ["mujoco"], **planned)
    options = {"random_count": 0, "seed": 11, "progress": lambda *_: None}
    return nightly.run_nightly(out, plan, command="-", log=lambda _: None, **options | more)
