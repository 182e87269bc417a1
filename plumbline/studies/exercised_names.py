"""Which names of an engine's surface are exercised: a change of 1e-6 in what a name returns turns a row red.

    python -m plumbline.studies.exercised_names > adapters/surface/exercised.json

computes it for all engines with a surface, on `MECHANISMS`; docs/surface.md is made from it.
"""

from __future__ import annotations

import json
from collections import defaultdict

from plumbline.engines.engine_calls import SURFACE_STATES, Evaluation, evaluate_states
from plumbline.engines.surface import SURFACES
from plumbline.judging.rows import RowContext, Verdict
from plumbline.judging.surface_rows import judge_surface
from plumbline.model.datatypes import SurfaceAnswer
from plumbline.model.sampling import compared_states
from plumbline.scenario.loader import load_scenarios
from plumbline.truth.ground_truth import StateTruth, state_truth

CHANGE = 1e-6  # relative
MECHANISMS = ("rest", "double-rod-then-ball", "furuta", "sprung-slider-on-arm", "free-body-with-rotors")
_CONTEXT = RowContext("", "", "", "the engine", "")


def exercised_names(truth: StateTruth, answer: SurfaceAnswer) -> dict[str, set[str]]:
    """Change what each call returned, one call at a time, and see which rows turn red.

    Args:
        truth: with the truth of the surface.
        answer: of the engine at the same states.

    Returns:
        By name of the engine the quantities of these rows.

    """
    found = defaultdict[str, set[str]](set)
    for quantity, calls in answer.items():
        for call, value in calls.items():
            before, after = (
                judge_surface(_CONTEXT, truth, Evaluation([], None, None, 0.0, surface={quantity: {call: x}}))
                for x in (value, value * (1 + CHANGE))
            )
            if (before[0].verdict, after[0].verdict) == (Verdict.AGREES, Verdict.DISAGREES):
                for name in call:
                    found[name].add(quantity)
    return found


def main() -> None:
    """Print the names of all engines."""
    scenarios = load_scenarios(MECHANISMS)
    found: dict[str, dict[str, set[str]]] = {engine: defaultdict(set) for engine in SURFACES}
    for s in scenarios:
        states = compared_states(s.model, s.state, s.seed, SURFACE_STATES)[:SURFACE_STATES]
        truth = state_truth(s.model, states)
        for engine, names in found.items():
            answer = evaluate_states(engine, s.model, states).surface
            for name, quantities in exercised_names(truth, answer).items():
                names[name] |= quantities
    written = {
        engine: {name: sorted(names[name]) for name in sorted(names)} for engine, names in found.items()
    }
    print(json.dumps(written, indent=1))


if __name__ == "__main__":
    main()
