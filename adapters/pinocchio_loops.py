"""Accelerations of mechanisms with loops by Pinocchio's other ways to close them.

Rows J v̇ + γ = 0 hold the ends of each loop together, γ their acceleration at v̇ = 0.  With what solves

    [−μ  J; Jᵀ M] (−λ, v̇) = (−γ, f),        f = τ − h,

the right side −γ + μ λ in turn leads to the solution for μ = 0, also where rows depend on others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import starmap
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from adapters.pinocchio_common import Place, init_constraint_dynamics, rigid_constraints, translation
from plumbline.model.datatypes import Array, Float

# μ over the largest entry of J M⁻¹ Jᵀ, and how often the step is taken.  Measured on squeezer: with 1e-5 the
# twelve steps do not converge (771 rad/s² off), with 1e-7 they end 5e-7 off, with 1e-8 within the bound.
DAMPING, STEPS = 1e-8, 12
# Singular values of rows over the largest, below which a row depends on others: between what rounding leaves,
# 1e-15, and the 1e-6 of poses that are singular and not compared.
DEPENDENT = 1e-10
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # m, points that hold a frame


def welded(m: pin.Model, pairs: Iterable[tuple[Place, Place]]) -> tuple[Any, Any]:
    """Weld places of joints; the name of the kind is missing in version 2, which has no constraints."""
    return rigid_constraints(pin.ContactType.CONTACT_6D, m, pairs)


class Loops(NamedTuple):
    """A tree with the constraints that close its loops, and what moves it."""

    m: pin.Model
    welds: Any
    data: Any  # of the welds
    push: Float[Array, "nv"]  # τ with loads

    def on(self, m: pin.Model, numbers: Sequence[int]) -> Loops:
        """Return the same on another model with the same velocities, in which joints have these numbers."""
        ends = (((numbers[j], here), (numbers[k], there)) for (j, here), (k, there) in map(_ends, self.welds))
        return Loops(m, *welded(m, ends), self.push)


class _Rows:
    """The rows of a state, and what solves them densely."""

    def __init__(self, loops: Loops, q: Array, v: Array) -> None:
        m = loops.m
        self.loops, self.m, self.q, self.v = loops, m, q, v
        self.still, self.solved = _still(m, q, v), m.createData()
        init_constraint_dynamics(m, self.solved, loops.welds, loops.data)
        # the larger one for rows that depend on others but for rounding
        for mu in (1e-14, 1e-8):
            self.settings = pin.ProximalSettings(1e-15, mu, 50)
            pin.constraintDynamics(m, self.solved, q, v, loops.push, loops.welds, loops.data, self.settings)
            self.J = np.array(pin.getConstraintsJacobian(m, self.still, loops.welds, loops.data))
            self.are_independent = np.linalg.matrix_rank(self.J) == np.sum(np.any(self.J != 0, axis=1))
            if self.are_independent:
                break
        self.mass = np.reshape(pin.crba(m, m.createData(), q), (m.nv, m.nv))
        self.force = loops.push - pin.nonLinearEffects(m, m.createData(), q, v)
        self.bias = _bias(self.still, loops.welds)
        inverse = np.linalg.solve(self.mass, self.J.T)
        self.damping = DAMPING * float(np.max(np.sum(self.J.T * inverse, axis=0)))

    def by_rows(self, rows: Array, bias: Array) -> Array:
        """Return v̇ by other rows; those that depend on others, but for rounding, are left out."""
        U, sizes, V = np.linalg.svd(rows, full_matrices=False)
        kept = sizes > DEPENDENT * sizes[0]
        independent = sizes[kept, None] * V[kept]
        count = len(independent)
        system = np.block([[np.zeros((count, count)), independent], [independent.T, self.mass]])
        given = np.concatenate([-U.T[kept] @ bias, self.force])
        return np.linalg.solve(system, given)[count:]

    def by_force(self, multipliers: Array) -> Array:
        """Return v̇ by the forces of the rows."""
        return np.linalg.solve(self.mass, self.force + self.J.T @ multipliers)

    def by(self, solve: Callable[[Array], Array], bias: Array, damping: float) -> Array:
        """Return v̇ by what solves the damped system."""
        count = len(bias)
        found, multipliers = self.force, np.zeros(count)
        for _ in range(STEPS):
            found = solve(np.concatenate([damping * multipliers - bias, self.force]))
            multipliers = -found[:count]
        return np.asarray(found[count:])


def closed_accelerations(
    loops: Loops, q: Float[Array, "nq"], v: Float[Array, "nv"]
) -> Iterator[tuple[bool, str, Any]]:
    """Return by names of the engine the accelerations, and whether they come from analytical derivatives."""
    rows = _Rows(loops, q, v)
    m, J, solved, by = rows.m, rows.J, rows.solved, "constraintDynamics"
    each = zip(loops.welds, loops.data, strict=True)
    one_by_one = np.vstack(list(starmap(lambda w, d: pin.getConstraintJacobian(m, rows.still, w, d), each)))
    yield False, "getConstraintsJacobian", rows.by_rows(J, rows.bias)
    yield False, "getConstraintJacobian", rows.by_rows(one_by_one, rows.bias)
    yield False, f"{by} Data.primal_rhs_contact", rows.by_rows(J, -np.array(solved.primal_rhs_contact))
    solution = np.array(solved.primal_dual_contact_solution)
    yield False, f"{by} Data.primal_dual_contact_solution", solution[len(J) :]
    yield False, f"{by} Data.lambda_c", rows.by_force(np.array(solved.lambda_c))
    yield False, f"{by} Data.lambda_c_prox", rows.by_force(np.array(solved.lambda_c_prox))
    yield from _by_derivatives(rows)
    # of version 3, with another name
    factors = solved.constraint_chol if hasattr(solved, "constraint_chol") else solved.contact_chol
    a = rows.by(lambda b: np.ravel(factors.solve(b[:, None])), rows.bias, rows.settings.mu)
    yield False, f"{by} Data.constraint_chol", a
    yield from _by_anchors(rows)


def _by_derivatives(rows: _Rows) -> Iterator[tuple[bool, str, Any]]:
    loops, m, v, J, solved = rows.loops, rows.m, rows.v, rows.J, rows.solved
    derivatives = pin.computeConstraintDynamicsDerivatives(m, solved, loops.welds, loops.data, rows.settings)
    _, a_v, a_tau, _, f_v, f_tau = (np.array(x) for x in derivatives)
    pushed = loops.push - pin.computeGeneralizedGravity(m, m.createData(), rows.q)
    by = "computeConstraintDynamicsDerivatives"
    if rows.are_independent:  # they have no proximal iterations
        yield True, f"{by} Data.ddq_dv Data.ddq_dtau", a_v @ v / 2 + a_tau @ pushed
        force = f_v @ v / 2 + f_tau @ pushed
        yield True, f"{by} Data.dlambda_dv Data.dlambda_dtau", rows.by_force(force)
        pin.computeAllTerms(m, rows.still, rows.q, v)
        pin.forwardDynamics(m, rows.still, rows.q, v, loops.push, J, rows.bias, rows.damping)
        inverse, nv = np.array(pin.getKKTContactDynamicMatrixInverse(m, rows.still, J)), m.nv

        def by_inverse(b: Array) -> Array:
            return np.roll(inverse @ np.roll(b, nv), -nv)  # it has v̇ first

        a = rows.by(by_inverse, rows.bias, rows.damping)
        yield False, "forwardDynamics getKKTContactDynamicMatrixInverse", a
    of_a, of_v, of_q = (np.array(x) for x in (solved.dac_da, solved.dac_dv, solved.dvc_dq))
    yield True, f"{by} Data.dac_da Data.dac_dv", rows.by_rows(of_a, of_v @ v / 2)
    yield True, f"{by} Data.dvc_dq", rows.by_rows(of_a, of_q @ v)


def _still(m: pin.Model, q: Array, v: Array) -> pin.Data:
    """Data with Jacobians and the motion at v̇ = 0."""
    data = m.createData()
    pin.crba(m, data, q, pin.Convention.WORLD)
    pin.computeJointJacobians(m, data, q)
    pin.forwardKinematics(m, data, q, v, 0 * v)
    return data


def _ends(weld: Any) -> tuple[Place, Place]:
    """Joint and place in its frame of both ends."""
    return (weld.joint1_id, weld.joint1_placement), (weld.joint2_id, weld.joint2_placement)


def _bias(data: pin.Data, welds: Any) -> Array:
    """γ, in the axes of each weld's first end."""
    rows = []
    for weld in welds:
        first, second = (data.oMi[j] * place for j, place in _ends(weld))
        near, far = (place.actInv(data.a[j]) for j, place in _ends(weld))
        rows.append((near - first.actInv(second).act(far)).vector)
    return np.concatenate(rows)


def _by_anchors(rows: _Rows) -> Iterator[tuple[bool, str, Any]]:
    """Close the loops by the constraints of version 4: frames, and three points of each."""
    loops, m, still = rows.loops, rows.m, _still(rows.m, rows.q, rows.v)
    frames, data = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    rigid, rigid_data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    points, of_points = list[Array](), list[Array]()
    size = max(np.linalg.norm(place.translation) for place in still.oMi)
    for weld in loops.welds:
        ends = weld.joint1_id, weld.joint1_placement, weld.joint2_id, weld.joint2_placement
        frame = pin.FrameAnchorConstraintModel(m, *ends)
        frames.append(pin.ConstraintModel(frame))
        data.append(frames[-1].createData())
        frames[-1].calc(m, still, data[-1])
        rigid.append(pin.convertToRigidConstraintModel(m, frame))
        rigid_data.append(rigid[-1].createData())
        for corner in size * CORNERS:
            at = translation(corner)
            point = pin.PointAnchorConstraintModel(m, ends[0], ends[1] * at, ends[2], ends[3] * at)
            own = point.createData()
            point.calc(m, still, own)
            points.append(np.array(point.jacobian(m, still, own)))
            of_points.append(_of_point(still, point))
    names = "FrameAnchorConstraintModel FrameAnchorConstraintData ConstraintModel ConstraintData"
    J = -np.array(pin.getConstraintsJacobian(m, still, frames, data))
    yield False, f"getConstraintsJacobian {names}", rows.by_rows(J, rows.bias)
    by = "PointAnchorConstraintModel PointAnchorConstraintData"
    yield False, by, rows.by_rows(np.vstack(points), np.concatenate(of_points))
    solved = m.createData()
    init_constraint_dynamics(m, solved, rigid, rigid_data)
    a = pin.constraintDynamics(m, solved, rows.q, rows.v, loops.push, rigid, rigid_data, rows.settings).copy()
    yield False, "convertToRigidConstraintModel", a
    yield from _by_factors(rows, still, frames, data)


def _by_factors(rows: _Rows, still: pin.Data, frames: Any, data: Any) -> Iterator[tuple[bool, str, Any]]:
    """Solve with factors of the whole matrix, and with those of J M⁻¹ Jᵀ."""
    factors = pin.ConstraintCholeskyDecomposition(rows.m, still, frames, data)
    factors.compute(rows.m, still, frames, data, rows.damping)
    signs = np.concatenate([np.full(len(rows.bias), -1.0), np.ones(rows.m.nv)])

    def solve(b: Array) -> Array:
        return np.asarray(signs * np.ravel(factors.solve((signs * b)[:, None])))

    yield False, "ConstraintCholeskyDecomposition", rows.by(solve, rows.bias, rows.damping)
    delassus, multipliers = factors.getDelassusOperatorCholeskyExpression(), np.zeros(len(rows.bias))
    free = rows.J @ np.linalg.solve(rows.mass, rows.force) + rows.bias
    for _ in range(STEPS):
        multipliers = -np.ravel(delassus.solve((free - rows.damping * multipliers)[:, None]))
    yield False, "DelassusOperatorCholeskyExpression", rows.by_force(multipliers)


def _of_point(data: pin.Data, point: Any) -> Array:
    """γ of a point, in the axes of its first end, as its Jacobian has it."""
    turn = (data.oMi[point.joint1_id] * point.joint1_placement).rotation
    near, far = (
        data.oMi[j].rotation @ pin.classicAcceleration(data.v[j], data.a[j], translation(place.translation))
        for j, place in _ends(point)
    )
    return np.asarray(turn.T @ (far - near))
