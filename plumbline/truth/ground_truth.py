"""What engines are measured with: the truth of a scenario, how sure it is, and how sharp it must be.

Runs inside a worker.  State level: rigorous enclosures in ball arithmetic.  Along trajectories: the closed
form where the scenario has one, else Taylor's method in minimal coordinates; uncertain by the difference
from a method of another kind (`plumbline.truth.trajectory`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Model, State, StateQuantities, Trajectory
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import state_from_minimal
from plumbline.model.sampling import derive_seed
from plumbline.truth import TruthUnavailable
from plumbline.truth.certified import certify_state
from plumbline.truth.rounding_bound import RoundingBound, state_rounding_bound
from plumbline.truth.sensitivity import perturbation_growth_and_runs, predictability_horizon
from plumbline.truth.trajectory import MAX_COMPILED_BODIES, ClosedFormSamples, trajectory_truth

RUN_ROUNDING = 1e3 * 2.0**-52  # of a whole run, before growth: trials saw at most 115 ε G (verification.md)
TRUTHS_DIFFER = "; they part by more than rounding explains: one of the two is wrong, or at its limits"
DETECTABLE_PARAMETER_ERROR = (
    1e-4  # a mistake of this relative size in a parameter must be visible, or the verdict is unresolved
)


@dataclass(frozen=True, eq=False)
class StateTruth:
    """True quantities at a list of states, and the tolerance of each."""

    states: list[State]
    quantities: list[StateQuantities]
    bounds: list[RoundingBound]
    method: str


@dataclass(frozen=True, eq=False)
class MotionTruth:
    """The true motion at the sample times, and what may be concluded from it."""

    trajectory: Trajectory
    position_uncertainty: Array  # (T,) m, running maximum
    attitude_uncertainty: Array  # (T,) rad, running maximum
    growth: Array  # (T,) –: of a small perturbation, running maximum
    detectable_position: Array  # (T,) m: the least that a mistake of one part in 10⁴ does, up to t
    detectable_attitude: Array  # (T,) rad
    length: float  # m: the stretched chain, the scale of rounding in positions
    method: str

    @property
    def horizon(self) -> float:
        """Predictability horizon T_h [s], from the rounding of a run and the truth's uncertainty."""
        rounding = self.length * RUN_ROUNDING
        return predictability_horizon(self.trajectory.t, self.growth, rounding, self.position_uncertainty)


def state_truth(model: Model, states: Sequence[State]) -> StateTruth:
    """True state quantities and their rounding bounds; certified where the truth tools are installed."""
    bounds = [state_rounding_bound(model, state) for state in states]
    try:
        certified = [certify_state(model, state, mass_matrix=True) for state in states]
    except TruthUnavailable:
        said = load_adapter("reference").evaluate(model, states)
        method = "the notes' direct system in double precision (truth tools are not installed)"
        return StateTruth(list(states), said, bounds, method)
    bits = max(answer.bits for answer in certified)
    method = f"certified: enclosed in ball arithmetic of {bits} bits"
    return StateTruth(list(states), [answer.quantities for answer in certified], bounds, method)


def motion_truth(
    model: Model,
    state: State,
    times: Array,
    closed_form: ClosedFormSamples | None,
    max_compiled_bodies: int = MAX_COMPILED_BODIES,
) -> MotionTruth:
    """True motion from ``state`` at ``times``; ``exact`` is a closed form's (r, p, source), if any.

    Taylor's method is asked of up to ``compiled`` bodies: of none by 0, for where it brought a worker down.
    """
    found = trajectory_truth(model, state, times, closed_form, max_compiled_bodies)
    grown, r, p = perturbation_growth_and_runs(model, state, times, perturbed_models(model, state))
    grown, length = np.maximum.accumulate(grown), float(np.sum(stretched_length(model)))
    apart = (found.position_uncertainty > length * RUN_ROUNDING * grown) | (
        found.attitude_uncertainty > 2 * RUN_ROUNDING * grown
    )
    return MotionTruth(
        found.trajectory,
        found.position_uncertainty,
        found.attitude_uncertainty,
        grown,
        *detectable_effect(model, r, p),
        length=length,
        method=found.method + (TRUTHS_DIFFER if apart.any() else ""),
    )


def stretched_length(model: Model) -> Array:
    """(N,) m: from where body k hangs to where the next one does, stretched; at least to its centre.

    And at least the body's radius of gyration: a body that hangs at its centre of mass has a size too.
    """
    span = np.linalg.norm(model.proximal - model.distal, axis=1)
    span[-1] = 0.0
    gyration = np.sqrt(np.trace(model.inertia, axis1=1, axis2=2) / (2 * model.mass))
    sizes = [span, np.linalg.norm(model.proximal, axis=1), gyration]
    return np.asarray(model.length + np.max(sizes, axis=0))


def perturbed_models(model: Model, state: State) -> list[tuple[Model, State]]:
    """The model with mistakes of one part in 10⁴, and the same minimal state lifted onto each of them.

    Gravity, the masses, the inertias, the attachments are wrong in turn, each entry by ±1e-4 of itself with
    random signs.
    """
    rng = np.random.default_rng(derive_seed("visible"))

    def off(x: Array) -> Array:
        return np.asarray(x * (1 + DETECTABLE_PARAMETER_ERROR * rng.choice([-1.0, 1.0], size=x.shape)))

    entries = off(np.ones((model.n, 3, 3)))
    lopsided = model.inertia * (entries + entries.mT) / 2  # scaled as a whole a free body would not show it
    models = [
        replace(model, gravity=model.gravity * (1 + DETECTABLE_PARAMETER_ERROR)),
        replace(model, mass=off(model.mass)),
        replace(model, inertia=lopsided),
        replace(model, proximal=off(model.proximal), distal=off(model.distal)),
    ]
    return [(m, state_from_minimal(m, state.p, state.omega, state.u, state.udot)) for m in models]


def detectable_effect(model: Model, r: Array, p: Array) -> tuple[Array, Array]:
    """Least effects (T,) m and rad, up to each time, of mistakes: r and p of the right motion, then theirs.

    Mistakes that no motion of this scenario shows (mass of a single body, anything of a body at rest) do not
    count.
    """
    scale = DETECTABLE_PARAMETER_ERROR * float(np.sum(stretched_length(model)))
    return (
        least_detectable_effect([position_error(r[0], wrong) for wrong in r[1:]], 1e-3 * scale),
        least_detectable_effect(
            [attitude_error(p[0], wrong) for wrong in p[1:]], 1e-3 * DETECTABLE_PARAMETER_ERROR
        ),
    )


def least_detectable_effect(effects: Sequence[Array], threshold: float) -> Array:
    """(T,) running maximum of the smallest effect that passes the threshold at all; inf if none does."""
    seen = [np.maximum.accumulate(e) for e in effects if np.max(e) > threshold]
    if not seen:
        return np.full(len(effects[0]), np.inf)
    return np.asarray(np.min(seen, axis=0))
