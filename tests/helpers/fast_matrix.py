"""The cells of scenario × engine × level that the fast tests run; `-m full` runs the others."""

from __future__ import annotations

import numpy as np

from plumbline.engines.registry import load_adapter
from plumbline.scenario.loader import Scenario

MOTIONS = {  # scenario: what it adds to those above it, of the cheapest ones
    "conical": "a rod, a closed form",
    "loaded-ball": "a ball, every load",
    "nesc-tumbling-brick": "a free body",
}
STEPS = MOTIONS | {
    "double-ball-then-rod": "several bodies, a rod on a ball",
    "sprung-slider-on-arm": "a hinge, a slide, springs",
    "drag-rod": "loads on a rod",
}
STATES = STEPS | {
    "double-rod-then-ball": "a ball on a rod",
    "planar-top": "a planar joint",
    "helical-screw": "a helical joint",
    "universal-pendulum": "a universal joint",
    "wrecking-ball": "a weld",
    "double-loaded-rods": "every load on rods",
    "double-mass-ratio-1000": "masses far apart",
    "chain-5-mixed": "rods and balls in turn",
    "sprung-ball": "springs of balls",
    "sprung-without-rotors": "no rotor",
    "robot-arm": "a chain of hinges",
    "tree-of-seven-sprung": "every joint, load and element in one tree",
    "four-bar": "a loop",
}
LOADS = ("force", "moment", "drag_force", "drag_moment")


def levels(engine: str, scenario: Scenario) -> list[str]:
    """Levels at which an engine is compared on a scenario."""
    if scenario.level == "state":
        return ["state"]
    integrators = load_adapter(engine).integrators
    has = {"step": any(one.method is not None for one in integrators), "trajectory": bool(integrators)}
    return ["state", *(level for level, is_there in has.items() if is_there)]


def is_fast(scenario: Scenario, level: str) -> bool:
    """Whether the fast tests compare a scenario at a level."""
    return scenario.name in {"state": STATES, "step": STEPS, "trajectory": MOTIONS}[level]


def features(scenario: Scenario) -> set[str]:
    """What a comparison on the scenario exercises: joints, loads, elements, several bodies, a closed form."""
    model = scenario.model
    has = {name: bool(np.any(getattr(model, name))) for name in LOADS}
    has |= {"elements": model.has_elements, "several bodies": model.n > 1}
    has |= {"closed form": scenario.closed_form is not None}
    return {*model.kind, *(name for name, is_there in has.items() if is_there)}
