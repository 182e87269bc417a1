"""The truth of a scenario, its uncertainty, and the smallest error that must be detectable.

Runs inside a worker.  State level: rigorous enclosures in ball arithmetic (`certified_state`).  Trajectories:
the closed form where the scenario has one, else Taylor's method in minimal coordinates; the uncertainty is
the difference from a method of another kind (`trajectory_truth`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from plumbline.engines.engine_calls import SURFACE_STATES
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, EngineFailure, Model, State, StateQuantities, Trajectory
from plumbline.model.invariants import MOTION_UNITS, motion_errors, motion_scales
from plumbline.model.kinematics import complete_state, sliding_coordinates, stretched_length
from plumbline.model.loops import MIN_MOTION_SINGULAR_VALUE, assembled
from plumbline.model.sampling import derive_seed
from plumbline.truth import TruthUnavailable
from plumbline.truth.certificate_proof import ProvedMotion
from plumbline.truth.certified_state import certify_state
from plumbline.truth.predictability_horizon import perturbation_growth_and_runs, predictability_horizon
from plumbline.truth.rounding_bound import RoundingBound, rounding_bounds
from plumbline.truth.surface_truth import SurfaceTruth, surface_truth

if TYPE_CHECKING:
    from plumbline.truth.trajectory_truth import ClosedFormSamples

RUN_ROUNDING = 1e3 * 2.0**-52  # error of a whole run over its growth G; the largest measured is 115 ε
TRUTHS_DIFFER = "the two truth methods differ by more than rounding explains: one is wrong, or at its limits"
# an error of this relative size in a parameter must be detectable, or the verdict is "unresolved"
DETECTABLE_PARAMETER_ERROR = 1e-4
MIN_SAMPLES = 3  # of a motion that is compared


@dataclass(frozen=True, eq=False)
class StateTruth:
    """True quantities at S states, and the tolerances at each."""

    states: list[State]
    quantities: list[StateQuantities]
    bounds: list[RoundingBound]
    method: str
    is_certified: bool = True  # else the answers of the reference are the truth
    # at the first states, by quantity; none of mechanisms with loops
    surface: Mapping[str, SurfaceTruth] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class MotionTruth:
    """The true motion at T sample times, and what a comparison with it can resolve."""

    trajectory: Trajectory
    uncertainty: Mapping[str, Array]  # by the names of `MOTION_UNITS` (T,) in its unit, running maximum
    growth: Array  # (T,) of a small perturbation, running maximum
    # by the same names (T,) in its unit: smallest effect up to t of a parameter that is wrong by 1e-4
    detectable: Mapping[str, Array]
    length: float  # m, of the stretched chain: the scale of rounding in positions
    method: str
    conflict: str = ""  # how the two methods differ by more than rounding explains; empty where they do not
    singular: str = ""  # why the motion ends before the scenario does: a pose that is singular, or nearly so
    is_proved: bool = False  # whether a certificate encloses it

    @property
    def horizon(self) -> float:
        """Predictability horizon T_h [s], from the rounding of a run and the truth's uncertainty."""
        rounding = self.length * RUN_ROUNDING
        return predictability_horizon(self.trajectory.t, self.growth, rounding, self.uncertainty["position"])

    @property
    def wanted_time(self) -> float:
        """How long a run should be compared [s]: the duration, up to the horizon of rounding alone."""
        return predictability_horizon(self.trajectory.t, self.growth, self.length * RUN_ROUNDING)


def state_truth(model: Model, states: Sequence[State]) -> StateTruth:
    """Compute true state quantities and their rounding bounds.

    Args:
        states: S states on the constraint manifold.

    Returns:
        The quantities: certified where the truth tools are installed, else those of the reference in double
        precision; ``method`` states which.

    Raises:
        CertificationFailure: the system is singular at a state, or nearly so.

    """
    bounds = rounding_bounds(model, states)
    try:
        certified = [certify_state(model, state, mass_matrix=True) for state in states]
    except TruthUnavailable:
        quantities = load_adapter("reference").evaluate(model, states)
        method = "the notes' direct system in double precision (truth tools are not installed)"
        return StateTruth(list(states), quantities, bounds, method, is_certified=False)
    bits = max(answer.bits for answer in certified)
    method = f"certified: enclosed in ball arithmetic of {bits} bits"
    quantities = [answer.quantities for answer in certified]
    surface = surface_truth(model, states[:SURFACE_STATES], quantities, bounds)
    return StateTruth(list(states), quantities, bounds, method, surface=surface)


def motion_truth(
    model: Model,
    state: State,
    times: Array,
    closed_form: ClosedFormSamples | None,
    max_compiled_bodies: int | None = None,
    proof: ProvedMotion | None = None,
) -> MotionTruth:
    """Compute the true motion, the growth of perturbations and the effects of small parameter errors.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        closed_form: samples of a closed form at ``times``, if the scenario has one.
        max_compiled_bodies: longest chain for Taylor's method, None for `MAX_COMPILED_BODIES` of
            `plumbline.truth.trajectory_truth`; 0 after it has crashed a worker.
        proof: the motion as a certificate proves it; it takes the place of the two methods.

    Returns:
        The motion with all that `MotionTruth` holds.

    Raises:
        EngineFailure: the integrator of the notes' form stops early, or the motion of a loop is singular from
            the start.

    """
    # with SciPy: not in a run's own process, which needs the classes of this module
    from plumbline.truth import trajectory_truth

    singular = ""
    if model.has_loops:
        times, singular = _regular_times(model, state, times)
        closed_form = closed_form and (
            closed_form[0][: len(times)],
            closed_form[1][: len(times)],
            closed_form[2],
        )
    if max_compiled_bodies is None:
        max_compiled_bodies = trajectory_truth.MAX_COMPILED_BODIES
    truth = trajectory_truth.trajectory_truth(model, state, times, closed_form, max_compiled_bodies, proof)
    growth, runs = perturbation_growth_and_runs(model, state, times, perturbed_models(model, state))
    growth, length = np.maximum.accumulate(growth), float(np.sum(stretched_length(model)))
    # what is free or slides leaves the stretched mechanism
    length = max(length, float(np.max(np.linalg.norm(truth.trajectory.r, axis=-1))))
    scales = motion_scales(model, truth.trajectory, length)
    off = np.array([truth.uncertainty[q] for q in scales])
    explained = np.array([scales[q] * RUN_ROUNDING * growth for q in scales])
    with np.errstate(divide="ignore"):  # where nothing moves nothing is explained, and 0 need not be
        excess = np.max(np.divide(off, explained, out=np.zeros_like(off), where=off != 0), axis=0)
    # not a number: one of them is not finite
    worst, differ = int(np.argmax(excess)), not np.all(excess <= 1)
    return MotionTruth(
        truth.trajectory,
        truth.uncertainty,
        growth,
        detectable_effect(model, runs),
        length=length,
        method=truth.method,
        conflict=f"{TRUTHS_DIFFER}; at t = {times[worst]:g} s they differ by "
        f"{', '.join(f'{truth.uncertainty[q][worst]:.2g} {unit}' for q, unit in MOTION_UNITS.items())}; "
        f"up to {excess[worst]:.2g} times what rounding explains; methods: {truth.method}"
        if differ
        else "",
        singular=singular,
        is_proved=proof is not None,
    )


def _regular_times(model: Model, state: State, times: Array) -> tuple[Array, str]:
    """The sample times while the motion is regular, and why it ends before the last one."""
    from plumbline.truth.trajectory_truth import regular_motion

    regular = regular_motion(model, state, times)
    if not regular.is_singular:
        return times, ""
    kept = times[times <= regular.end]
    if len(kept) < MIN_SAMPLES:
        raise EngineFailure(f"the motion comes to a singular pose at t = {regular.end:.3g} s")
    return kept, singular_note(regular.end)


def singular_note(end: float) -> str:
    """Say why a motion is compared no further.

    Args:
        end: time [s] up to which the motion is regular.

    """
    return (
        f"singular: from t = {end:.4g} s on the smallest singular value of the rows that close the "
        f"loops is below {MIN_MOTION_SINGULAR_VALUE:g}; at a singular pose accelerations are not unique"
    )


def perturbed_models(model: Model, state: State) -> list[tuple[Model, State]]:
    """Create models with parameter errors of one part in 10⁴.

    Gravity, the masses, the inertias and the attachment points are changed in turn, each entry by ±1e-4 of
    itself with random signs (gravity as a whole; the points of mechanisms with loops too, which could not
    move otherwise where rows depend on others).

    Returns:
        Four models, each with the state of the same minimal coordinates.

    """
    rng = np.random.default_rng(derive_seed("visible"))

    def perturbed(x: Array) -> Array:
        return np.asarray(x * (1 + DETECTABLE_PARAMETER_ERROR * rng.choice([-1.0, 1.0], size=x.shape)))

    # entry by entry: a common factor does not affect a free body
    factors = perturbed(np.ones((model.n, 3, 3)))
    models = [
        replace(model, gravity=model.gravity * (1 + DETECTABLE_PARAMETER_ERROR)),
        replace(model, mass=perturbed(model.mass)),
        replace(model, inertia=model.inertia * (factors + factors.mT) / 2),
    ]
    if model.has_loops:
        size = 1 + DETECTABLE_PARAMETER_ERROR
        larger = replace(model, point=size * model.point, length=size * model.length)
        longer = np.where(sliding_coordinates(model)[: model.n], size, 1.0)  # shifts
        x, xdot = longer * state.x, longer * state.xdot
        grown = replace(state, r=size * state.r, v=size * state.v, x=x, xdot=xdot)
        return [*((m, state) for m in models), (larger, assembled(larger, complete_state(larger, grown)))]
    models.append(replace(model, point=perturbed(model.point)))
    return [(m, complete_state(m, state)) for m in models]


def detectable_effect(model: Model, runs: Sequence[Trajectory]) -> dict[str, Array]:
    """Measure the smallest effect of the parameter errors on a motion.

    Errors without effect in this scenario (the mass of a single body, any parameter of a body at rest) are
    ignored; where all are, an error of the same part of the motion's scale must be detectable.

    Args:
        runs: the true motion, then those of K perturbed models.

    Returns:
        Effects (T,), running maxima, for each name of `MOTION_UNITS` in its unit.

    """
    scales = motion_scales(model, runs[0], float(np.sum(stretched_length(model)))) | {"attitude": 1.0}
    effects = [motion_errors(runs[0], wrong) for wrong in runs[1:]]
    return {
        q: least_detectable_effect([e[q] for e in effects], DETECTABLE_PARAMETER_ERROR * scale)
        for q, scale in scales.items()
    }


def least_detectable_effect(effects: Sequence[Array], usual: float) -> Array:
    """Take the smallest of several effects, without those that stay below a thousandth of the usual one.

    Args:
        effects: arrays (T,) in one unit.
        usual: effect that the error has where it has one.

    Returns:
        (T,) smallest running maximum; the usual effect where all are ignored.

    """
    visible = [np.maximum.accumulate(e) for e in effects if np.max(e) > 1e-3 * usual]
    return np.asarray(np.min(visible, axis=0)) if visible else np.full(len(effects[0]), usual)
