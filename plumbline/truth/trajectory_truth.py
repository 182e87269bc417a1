"""Truth along a trajectory; its uncertainty is the difference of two methods that share no equation.

The first is heyoka's Taylor method in minimal coordinates (`taylor`), the second the notes' equations on the
constraint manifold by collocation (`reference_motions`): other equations, coordinates and integrator. Their
difference is the rounding of the second: in extended precision the first is far more accurate, as a
comparison with quad precision shows (tests).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.invariants import motion_error, motion_errors, motion_samples
from plumbline.model.kinematics import angular_velocity, quaternion_rate
from plumbline.truth import TruthUnavailable
from plumbline.truth.certificate_proof import prove_motion
from plumbline.truth.proved_motion import ProvedMotion, round_enclosure
from plumbline.truth.reference_motions import simulate_notes_form
from plumbline.truth.taylor import Precision, simulate_taylor

if TYPE_CHECKING:
    from plumbline.truth.certificate_checker import Enclosure

NOTES_RTOL = 1e-13  # of the notes' form: at 1e-14 it is no closer to extended precision, the rest is rounding
# 2 s of ten bodies take 2.0 s in extended precision, 0.6 s in double; of fifty 14 s and 4 s
MAX_EXTENDED_PRECISION_BODIES = 5
MAX_COMPILED_BODIES = 50  # the equations of fifty bodies take 2 s to compile
NOTES_METHOD = "the notes' form by collocation"
ROUNDING = 2.0**-51  # of a motion stored in double, relative to its size
ClosedFormSamples = tuple[Array, Array, str]  # r (T, N, 3) m and p (T, N, 4) of a closed form, and its source


@dataclass(frozen=True, eq=False)
class TrajectoryTruth:
    """The true motion and its uncertainty."""

    trajectory: Trajectory
    # by the names of `MOTION_UNITS` (T,) in its unit, largest of any body up to each time
    uncertainty: Mapping[str, Array]
    method: str  # the two methods, in words


def trajectory_truth(
    model: Model,
    state: State,
    times: Array,
    closed_form: ClosedFormSamples | None = None,
    max_compiled_bodies: int = MAX_COMPILED_BODIES,
    proof: ProvedMotion | None = None,
) -> TrajectoryTruth:
    """Compute the motion by two methods, or take it from a proof.

    Where heyoka is missing, fails, or the chain has more than ``max_compiled_bodies``, DOP853 on the notes'
    equations takes its place: another integrator but the same equations, and ``method`` states that.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        closed_form: samples of a closed form at ``times``; they replace r and p of the result; velocities
            remain those of the first method, uncertain by the difference between the two.
        max_compiled_bodies: longest chain that heyoka compiles; 0 to avoid heyoka.
        proof: the motion as a certificate proves it, if there is one; nothing is computed then.

    Returns:
        The motion and the differences between the two methods, or the radii of the proof.

    Raises:
        EngineFailure: the integrator of the notes' form stops early.

    """
    if proof is not None:
        run = replace(proof.trajectory, initial_x=state.x)
        return TrajectoryTruth(run, proof.radius, proof.method)
    failure = ""
    try:
        run, method = _simulate_minimal_coordinates(model, state, times, max_compiled_bodies)
    except Exception as error:  # whatever fails in heyoka, the notes' form remains
        run, method = simulate_notes_form(model, state, times, NOTES_RTOL), NOTES_METHOD
        failure = str(error) if isinstance(error, TruthUnavailable) else f"{type(error).__name__}: {error}"
    if failure:
        other = simulate_notes_form(model, state, times, NOTES_RTOL, "dop853")
        other_method = f"the same by DOP853, no Taylor series: {failure}"
    else:
        other, other_method = simulate_notes_form(model, state, times, NOTES_RTOL), NOTES_METHOD
    uncertainty = motion_errors(run, other)
    if closed_form is not None:
        r, p, source = closed_form
        of_velocities = f"of velocities that of {method} from {other_method}"
        other, other_method, method = run, f"{method}; {of_velocities}", f"closed form: {source}"
        # rates refer to the sign of the quaternion
        run = replace(run, r=r, p=p, pdot=quaternion_rate(p, angular_velocity(run.p, run.pdot)))
        found = motion_errors(run, other)
        uncertainty |= {name: found[name] for name in ("position", "attitude")}
    return TrajectoryTruth(run, uncertainty, f"{method}; uncertainty: its difference from {other_method}")


def prove_and_judge_claim(
    model: Model, state: State, times: Array, closed_form: ClosedFormSamples | None = None
) -> tuple[ProvedMotion, float]:
    """Prove a motion, and compare the error of the truth by two methods with the uncertainty that it claims.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        closed_form: as for `trajectory_truth`.

    Returns:
        The proved motion, and the largest error over claim of any sample, as `judge_claim` has it.

    Raises:
        Rejected: no candidate could be proved.
        TruthUnavailable: a truth tool is not installed.
        EngineFailure: an integrator stops early.

    """
    _, enclosure = prove_motion(model, state, times)
    return round_enclosure(enclosure), judge_claim(model, state, times, enclosure, closed_form)


def judge_claim(
    model: Model, state: State, times: Array, enclosure: Enclosure, closed_form: ClosedFormSamples | None
) -> float:
    """Compare the error of the truth by two methods with the uncertainty that it claims.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        closed_form: as for `trajectory_truth`.

    Returns:
        The largest error over claim of any sample; the claim includes the rounding of both motions to double.

    Raises:
        EngineFailure: an integrator stops early.

    """
    proof = round_enclosure(enclosure)
    truth = trajectory_truth(model, state, times, closed_form)
    run, right = truth.trajectory, proof.trajectory
    samples, ratios = motion_samples(run), []
    for name, true in motion_samples(right).items():
        error = motion_error(name, samples[name], true)
        size = 4.0 if name == "attitude" else float(np.max(np.abs(true)))
        claim = truth.uncertainty[name] + proof.radius[name] + ROUNDING * size
        # 0 of 0 at a fixed point
        ratios.append(np.divide(error, claim, out=np.zeros_like(error), where=error != 0))
    return float(np.max(ratios))


def _simulate_minimal_coordinates(
    model: Model, state: State, times: Array, max_compiled_bodies: int
) -> tuple[Trajectory, str]:
    """The motion by Taylor's method in minimal coordinates, and the name of the method."""
    if model.n > max_compiled_bodies:
        raise TruthUnavailable(f"not used for more than {max_compiled_bodies} bodies")
    precision: Precision = "extended" if model.n <= MAX_EXTENDED_PRECISION_BODIES else "double"
    found = simulate_taylor(model, state, times, precision)
    r, p, v, omega = (np.asarray(getattr(found, name), float) for name in ("r", "p", "v", "omega"))
    run = Trajectory(times, r, p, v, quaternion_rate(p, omega), found.steps, state.x)
    coordinates = (
        "coordinates of the tree without its closing joints" if model.has_loops else "minimal coordinates"
    )
    return run, f"Taylor's method in {coordinates} and {precision} precision"
