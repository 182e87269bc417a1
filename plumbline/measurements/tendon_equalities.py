"""What answers lack where rods are tendons held by J q̈ = 0, as MuJoCo's equalities of tendons require.

A rod's length ℓ is constant: 0 = ℓ̈ = J q̈ + J̇ q̇, with the coordinates q of the mechanism without its rods. An
engine that leaves out J̇ q̇ accelerates with ℓ̈ = J̇ q̇, which is ℓ̈ of the motion with q̈ = 0:

    ℓ̈ = u · (a_near − a_far) + ℓ u̇ · u̇        a: accelerations of the rod's ends at q̈ = 0

C = dᵀd − ℓ² of the rod's row in (N5) then has C̈ = 2 ℓ ℓ̈, and the rest of the equations is unchanged.
"""

from __future__ import annotations

import numpy as np

from plumbline.equations.arithmetic import floats
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import angular_velocity, joint_coordinates, maximal_coordinates
from plumbline.model.loops import cut_open, determinate_wrenches
from plumbline.model.redescription import rods_taken_out
from reference_impl.direct import DirectSystem


def effects_of_missing_terms(model: Model, state: State) -> dict[str, Array]:
    """Return what the answers change by where tendons lack their terms of velocities.

    Args:
        model: a mechanism with rods.

    Returns:
        By name of the quantity (N, 3) or, of joints, (J, 3); of wrenches in loops the determinate parts.
        Other quantities do not depend on accelerations.

    """
    system = DirectSystem(model)
    at = maximal_coordinates(state)
    u, udot, x, _ = joint_coordinates(model, state)
    defect = np.zeros(len(system.joint))
    for k, lengthening in _lengthening(model, state, u, udot).items():
        defect[system.joint == k] = 2 * model.length[k] * lengthening
    right, wrong = (system.solve(*at, gamma_defect=gamma, x=x) for gamma in (0.0, defect))
    assert right.joint_moment is not None and wrong.joint_moment is not None
    force, moment = wrong.joint_reaction - right.joint_reaction, wrong.joint_moment - right.joint_moment
    force, moment = determinate_wrenches(model, state, force, moment)
    return {
        "acceleration": wrong.acceleration - right.acceleration,
        "angular_acceleration": angular_velocity(state.p, wrong.pddot - right.pddot),
        "joint_reaction": force,
        "joint_moment": moment,
    }


def _lengthening(model: Model, state: State, u: Array, udot: Array) -> dict[int, float]:
    """Of each rod ℓ̈ [m/s²] at q̈ = 0, in the coordinates of the mechanism without rods, cut open."""
    rodless = rods_taken_out(model)
    cut = cut_open(rodless.model)
    place = np.append(cut.place, -1)[np.append(np.argsort(rodless.order), -1)]
    found, bodies = dict[int, float](), Tree(floats(), cut.model, cut.state(rodless.state(state)))
    a, alpha = bodies.coasting()  # at q̈ = 0
    for k in np.flatnonzero(model.rods):
        ends = np.zeros((2, 3))
        for side, (body, point) in enumerate(zip(model.body[k], model.point[k], strict=True)):
            if body >= 0:
                b = place[body]
                arm, num = bodies.A[b] @ point[:, None], bodies.num
                ends[side] = (a[b] + num.cross(alpha[b], arm) + bodies.centripetal(b, point, arm))[:, 0]
        found[int(k)] = float(u[k] @ (ends[1] - ends[0]) + model.length[k] * np.sum(udot[k] ** 2))
    return found
