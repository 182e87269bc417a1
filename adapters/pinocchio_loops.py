"""Accelerations of mechanisms with loops by Pinocchio's other ways to close them.

Rows J v̇ + γ = 0 hold the ends of each loop together, γ their acceleration at v̇ = 0.  With what solves

    [−μ  J; Jᵀ M] (−λ, v̇) = (−γ, f),        f = τ − h,

the right side −γ + μ λ in turn leads to the solution for μ = 0, also where rows depend on others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import starmap
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg import lu_factor, lu_solve

from plumbline.model.datatypes import Array, Call

DAMPING, STEPS = 1e-8, 12  # μ over the largest entry of J M⁻¹ Jᵀ, and how many times
FINE = pin.ProximalSettings(1e-15, 1e-14, 50)
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # m, points that hold a frame


class Loops(NamedTuple):
    """A tree with the constraints that close its loops, and what moves it."""

    m: pin.Model
    welds: Any
    data: Any  # of the welds
    push: Array  # τ with loads, (nv,)


def closed_accelerations(loops: Loops, q: Array, v: Array) -> Iterator[tuple[bool, Call, Array]]:
    """Return by call the accelerations, and whether they come from analytical derivatives."""
    m, push = loops.m, loops.push
    solved, still = m.createData(), _still(m, q, v)
    pin.initConstraintDynamics(m, solved, loops.welds, loops.data)
    pin.constraintDynamics(m, solved, q, v, push, loops.welds, loops.data, FINE)
    solution, lambda_c, prox = (
        np.array(x) for x in (solved.primal_dual_contact_solution, solved.lambda_c, solved.lambda_c_prox)
    )
    rhs, factors = -np.array(solved.primal_rhs_contact), solved.constraint_chol
    mass = np.reshape(pin.crba(m, m.createData(), q), (m.nv, m.nv))
    force = push - pin.nonLinearEffects(m, m.createData(), q, v)
    J, bias = (
        np.array(pin.getConstraintsJacobian(m, still, loops.welds, loops.data)),
        _bias(still, loops.welds),
    )

    damping = DAMPING * float(np.max(np.sum(J.T * np.linalg.solve(mass, J.T), axis=0)))

    def by_rows(rows: Array, gamma: Array) -> Array:
        count = len(rows)
        factored = lu_factor(np.block([[-damping * np.eye(count), rows], [rows.T, mass]]))
        return _proximal(lambda b: np.asarray(lu_solve(factored, b)), gamma, force, damping)

    def by_force(multipliers: Array) -> Array:
        return np.linalg.solve(mass, force + J.T @ multipliers)

    each = zip(loops.welds, loops.data, strict=True)
    one_by_one = np.vstack(list(starmap(lambda w, d: pin.getConstraintJacobian(m, still, w, d), each)))
    yield False, ("getConstraintsJacobian",), by_rows(J, bias)
    yield False, ("getConstraintJacobian",), by_rows(one_by_one, bias)
    yield False, ("constraintDynamics", "Data.primal_rhs_contact"), by_rows(J, rhs)
    yield False, ("constraintDynamics", "Data.primal_dual_contact_solution"), solution[len(J) :]
    yield False, ("constraintDynamics", "Data.lambda_c"), by_force(lambda_c)
    yield False, ("constraintDynamics", "Data.lambda_c_prox"), by_force(prox)
    yield (
        False,
        ("constraintDynamics", "Data.constraint_chol"),
        _proximal(lambda b: np.ravel(factors.solve(b[:, None])), bias, force, FINE.mu),
    )
    derivatives = pin.computeConstraintDynamicsDerivatives(m, solved, loops.welds, loops.data, FINE)
    _, a_v, a_tau, _, f_v, f_tau = (np.array(x) for x in derivatives)
    pushed = push - pin.computeGeneralizedGravity(m, m.createData(), q)
    by = "computeConstraintDynamicsDerivatives"
    if np.linalg.matrix_rank(J) == np.sum(np.any(J != 0, axis=1)):  # they have no proximal iterations
        yield True, (by, "Data.ddq_dv", "Data.ddq_dtau"), a_v @ v / 2 + a_tau @ pushed
        yield True, (by, "Data.dlambda_dv", "Data.dlambda_dtau"), by_force(f_v @ v / 2 + f_tau @ pushed)
        pin.computeAllTerms(m, still, q, v)
        pin.forwardDynamics(m, still, q, v, push, J, bias, damping)
        inverse = np.array(pin.getKKTContactDynamicMatrixInverse(m, still, J))
        split = m.nv

        def by_inverse(b: Array) -> Array:
            x = inverse @ np.concatenate([b[-split:], b[:-split]])
            return np.concatenate([x[split:], x[:split]])

        yield (
            False,
            ("forwardDynamics", "getKKTContactDynamicMatrixInverse"),
            _proximal(by_inverse, bias, force, damping),
        )
    of_a, of_v, of_q = (np.array(x) for x in (solved.dac_da, solved.dac_dv, solved.dvc_dq))
    yield True, (by, "Data.dac_da", "Data.dac_dv"), by_rows(of_a, of_v @ v / 2)
    yield True, (by, "Data.dvc_dq"), by_rows(of_a, of_q @ v)
    yield from _by_anchors(loops, q, v, by_rows, force, damping)


def _still(m: pin.Model, q: Array, v: Array) -> pin.Data:
    """Data with Jacobians and the motion at v̇ = 0."""
    data = m.createData()
    pin.crba(m, data, q, pin.Convention.WORLD)
    pin.computeJointJacobians(m, data, q)
    pin.forwardKinematics(m, data, q, v, 0 * v)
    return data


def _bias(data: pin.Data, welds: Any) -> Array:
    """γ, in the axes of each weld's first end."""
    rows = []
    for weld in welds:
        ends = [
            (data.oMi[j] * place, place.actInv(data.a[j]))
            for j, place in (
                (weld.joint1_id, weld.joint1_placement),
                (weld.joint2_id, weld.joint2_placement),
            )
        ]
        (first, near), (second, far) = ends
        rows.append((near - first.actInv(second).act(far)).vector)
    return np.concatenate(rows)


def _proximal(solve: Callable[[Array], Array], bias: Array, force: Array, damping: float) -> Array:
    """Return v̇."""
    count = len(bias)
    found, multipliers = force, np.zeros(count)
    for _ in range(STEPS):
        found = solve(np.concatenate([damping * multipliers - bias, force]))
        multipliers = -found[:count]
    return found[count:]


def _by_anchors(
    loops: Loops,
    q: Array,
    v: Array,
    by_rows: Callable[[Array, Array], Array],
    force: Array,
    damping: float,
) -> Iterator[tuple[bool, Call, Array]]:
    """Close the loops by the constraints of version 4: frames, and three points of each."""
    if not hasattr(pin, "FrameAnchorConstraintModel"):
        return
    m, still = loops.m, _still(loops.m, q, v)
    bias = _bias(still, loops.welds)
    frames, data = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    rigid = pin.StdVec_RigidConstraintModel()
    points, of_points = list[Array](), list[Array]()
    size = max(np.linalg.norm(place.translation) for place in still.oMi)
    for weld in loops.welds:
        ends = weld.joint1_id, weld.joint1_placement, weld.joint2_id, weld.joint2_placement
        frame = pin.FrameAnchorConstraintModel(m, *ends)
        frames.append(pin.ConstraintModel(frame))
        data.append(frames[-1].createData())
        rigid.append(pin.convertToRigidConstraintModel(m, frame))
        for corner in size * CORNERS:
            at = pin.SE3(np.eye(3), corner)
            point = pin.PointAnchorConstraintModel(m, ends[0], ends[1] * at, ends[2], ends[3] * at)
            own = point.createData()
            point.calc(m, still, own)
            points.append(np.array(point.jacobian(m, still, own)))
            of_points.append(_of_point(still, point))
    for one, own in zip(frames, data, strict=True):
        one.calc(m, still, own)
    names = "FrameAnchorConstraintModel", "FrameAnchorConstraintData"
    lists = "ConstraintModel", "ConstraintData"
    rows = -np.array(pin.getConstraintsJacobian(m, still, frames, data))
    yield False, ("getConstraintsJacobian", *names, *lists), by_rows(rows, bias)
    by = "PointAnchorConstraintModel", "PointAnchorConstraintData"
    yield False, by, by_rows(np.vstack(points), np.concatenate(of_points))
    rigid_data = pin.StdVec_RigidConstraintData()
    for one in rigid:
        rigid_data.append(one.createData())
    solved = m.createData()
    pin.initConstraintDynamics(m, solved, rigid, rigid_data)
    a = pin.constraintDynamics(m, solved, q, v, loops.push, rigid, rigid_data, FINE).copy()
    yield False, ("convertToRigidConstraintModel",), a
    factors = pin.ConstraintCholeskyDecomposition(m, still, frames, data)
    factors.compute(m, still, frames, data, damping)

    def solve(b: Array) -> Array:
        given = np.concatenate([-b[: len(bias)], b[len(bias) :]])  # its rows have the other sign
        x = np.ravel(factors.solve(given[:, None]))
        return np.concatenate([-x[: len(bias)], x[len(bias) :]])

    yield False, ("ConstraintCholeskyDecomposition",), _proximal(solve, bias, force, damping)
    delassus, multipliers = factors.getDelassusOperatorCholeskyExpression(), np.zeros(len(bias))
    mass = np.reshape(pin.crba(m, m.createData(), q), (m.nv, m.nv))
    free = rows @ np.linalg.solve(mass, force) + bias
    for _ in range(STEPS):
        multipliers = -np.ravel(delassus.solve((free - damping * multipliers)[:, None]))
    a = np.asarray(np.linalg.solve(mass, force + rows.T @ multipliers))
    yield False, ("DelassusOperatorCholeskyExpression",), a


def _of_point(data: pin.Data, point: Any) -> Array:
    """γ of a point, in the axes of its first end, as its Jacobian has it."""
    turn = (data.oMi[point.joint1_id] * point.joint1_placement).rotation
    ends = [
        data.oMi[j].rotation @ pin.classicAcceleration(data.v[j], data.a[j], place_of(place))
        for j, place in (
            (point.joint1_id, point.joint1_placement),
            (point.joint2_id, point.joint2_placement),
        )
    ]
    return np.asarray(turn.T @ (ends[1] - ends[0]))


def place_of(place: pin.SE3) -> pin.SE3:
    """A placement without its turn."""
    return pin.SE3(np.eye(3), place.translation)
