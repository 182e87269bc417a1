"""Repeatability: the same question gives the same bits, whatever an engine was asked before.

At states: each alone, all in one call, all in reverse order, and one again after another question. In time: a
short run of every integrator, and the same run after another one. An engine's answer that depends on the
order of the questions is no function of model and state, and nothing that is concluded from it can be
repeated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace

import numpy as np

from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.engines.no_answer import NoAnswer
from plumbline.measurements.relation_result import REPEATABILITY, RelationResult
from plumbline.measurements.run_relations import (
    RUN_STEPS,
    refused_result,
    run_or_refusal,
    short_steps,
    with_shorter_steps,
)
from plumbline.measurements.state_relations import compared_states, evaluate_or_refusal
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
    Unsupported,
)
from plumbline.model.kinematics import complete_state

Difference = tuple[float, str]  # relative to the largest entry of the quantity, and a description


def check_repeatability(
    engine: MetamorphicHooks, model: Model, states: Sequence[State]
) -> Iterator[RelationResult]:
    """Ask one engine the same questions again, at states and for a short run of every integrator.

    Args:
        engine: the adapter; the same instance answers all questions.
        states: states of it; the first few are used, and runs start from the first.

    Yields:
        One result for states, and one per integrator whose run the engine does not refuse. Their ratio is the
        largest relative difference, 0 where every bit is the same.

    """
    yield _check_states(engine, model, compared_states(model, states))
    yield from with_shorter_steps(
        engine,
        short_steps(model, states[0]),
        lambda integrator, step: _check_run(engine, integrator, model, states[0], step),
    )


def _check_states(engine: MetamorphicHooks, model: Model, states: Sequence[State]) -> RelationResult:
    """Compare the answers at states that are asked alone, together, in reverse order, after another one."""
    alone = [evaluate_or_refusal(engine.evaluate, model, state) for state in states]
    used = [k for k, answer in enumerate(alone) if not isinstance(answer, Unsupported)]
    if not used:
        (refused, *_) = (answer for answer in alone if isinstance(answer, Unsupported))
        return RelationResult(REPEATABILITY, None, no_answer=NoAnswer.by(refused))
    asked = [states[k] for k in used]
    try:
        together = engine.evaluate(model, asked)
        backwards = engine.evaluate(model, asked[::-1])[::-1]
        other_model, other_state = _other_question(model, asked[0])
        evaluate_or_refusal(engine.evaluate, other_model, other_state)
        later = engine.evaluate(model, asked[:1])
    except Unsupported as refusal:
        note = f"refused after it had been answered: {refusal}"
        return RelationResult(REPEATABILITY, np.inf, "", used[0], len(used), note=note)
    worst: tuple[float, str, int] = (0.0, "", 0)
    for way, answers in (
        ("in one call with other states", together),
        ("in reverse order", backwards),
        ("after another question", later),
    ):
        for k, answer in zip(used, answers, strict=False):
            size, name = _largest_difference(alone[k], answer)
            if name and (not worst[1] or size > worst[0]):
                worst = size, f"{name} at state {k}, asked {way}", k
    return RelationResult(REPEATABILITY, worst[0], worst[1], worst[2], len(used))


def _check_run(
    engine: MetamorphicHooks, integrator: Integrator, model: Model, state: State, step: float
) -> Iterator[RelationResult]:
    """Compare a short run with the same run after another one; nothing where the engine refuses both."""
    resolution = step if integrator.kind == "step" else integrator.min_rtol
    times = np.array([0.0, RUN_STEPS // 2 * step, RUN_STEPS * step])

    def simulate(of: Model, start: State) -> Trajectory | Unsupported | EngineFailure:
        return run_or_refusal(engine, of, start, times, integrator.name, resolution)

    def run_result(size: float, where: str, note: str = "") -> RelationResult:
        return RelationResult(
            REPEATABILITY, size, where, 0, 1, note=note, integrator=integrator.name, steps=RUN_STEPS,
            resolution=resolution, end_time=float(times[-1]),
        )  # fmt: skip

    first = simulate(model, state)
    simulate(*_other_question(model, state))
    again = simulate(model, state)
    if isinstance(first, Trajectory) and isinstance(again, Trajectory):
        size, name = _largest_difference(first, again)
        yield run_result(size, f"{name} of a run, asked after another run" if name else "")
    elif isinstance(first, EngineFailure) and isinstance(again, EngineFailure):
        yield refused_result(REPEATABILITY, integrator, again)
    elif not (isinstance(first, Unsupported) and isinstance(again, Unsupported)):
        refusal = first if not isinstance(first, Trajectory) else again
        yield run_result(np.inf, "", f"one of two equal runs was refused or failed: {refusal}")


def _other_question(model: Model, state: State) -> tuple[Model, State]:
    """Another pendulum of as many bodies in another motion, so that nothing kept from it can be right."""
    other = replace(
        model, mass=1.5 * model.mass, inertia=1.25 * model.inertia, gravity=model.gravity[[1, 2, 0]] + 0.5
    )
    slower = {name: -0.75 * getattr(state, name) for name in ("omega", "udot", "v", "xdot")}
    return other, complete_state(other, replace(state, **slower))


def _largest_difference(
    one: StateQuantities | Trajectory | Unsupported, other: StateQuantities | Trajectory
) -> Difference:
    """The largest difference of any quantity, relative to the quantity's largest entry; "" for equal bits."""
    worst: Difference = (0.0, "")
    for field in fields(other):
        a, b = (getattr(answer, field.name) for answer in (one, other))
        if isinstance(b, Mapping):  # uncertainties by quantity
            a, b = (list(errors.values()) for errors in (a, b))
        if a is None and b is None:
            continue
        name = field.name.replace("_", " ")
        if a is None or b is None:
            return np.inf, f"the {name}, which one of two answers lacks,"
        if isinstance(b, Trajectory):
            found = _largest_difference(a, b)
        else:
            x, y = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
            is_same = x.shape == y.shape and x.tobytes() == y.tobytes()
            found = (0.0, "") if is_same else (_relative_size(x, y), f"the {name}")
        if found[1] and (not worst[1] or found[0] > worst[0]):
            worst = found
    return worst


def _relative_size(x: Array, y: Array) -> float:
    """The largest difference of two arrays over their largest entry; 0 for zeros of different sign."""
    if x.shape != y.shape:
        return np.inf
    scale = float(np.max(np.abs(x), initial=0.0)) or 1.0
    return float(np.max(np.abs(x - y), initial=0.0)) / scale
