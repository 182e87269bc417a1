"""The tolerance of the state level for trees with any joints: the parts of `rounding_bound`, joint by joint.

Joint k holds its body with a force F and a moment M about its near point in the directions that its motions
leave, E_k (6, c).  With x = (r̈, α) per body, world axes, C the held rows of a_near − a_far, α_near − α_far,

    M x − Cᵀ λ = f,    C x = γ,    K = C M⁻¹ Cᵀ

Where a body has no inertia about some axis, M has no inverse and the whole matrix of (x, λ) is inverted.

Loops are cut open (`plumbline.model.loops`); rows a_b − a_c, α_b − α_c join the two parts of a body, and K
has a pseudo-inverse where rows depend on others.  The dependent coordinates of a state are known only to
rounding over the smallest singular value σ of these rows, which changes every term of the equations by as
much: the answer to their roundings (tB, and that of the rows that join parts) counts 1 + 1/σ times.

Roundings of the terms of each body's equations and of each joint's are propagated through the inverse (tB),
those of the elimination C M⁻¹ f likewise (tS); a joint-space engine rounds the terms of M q̈ + h, which act as
torque pairs at turns and as force pairs at slides (tJ); d is the accumulation along the branches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from plumbline.model.datatypes import ZERO_INERTIA, Array, Model, State
from plumbline.model.kinematics import (
    JointFrame,
    cross,
    cross_matrix,
    joint_vectors,
    rotate_vectors,
    rotation_matrix,
)
from plumbline.model.loops import cut_open, smallest_singular_value, wrench_length
from plumbline.truth.element_terms import joint_elements, spring_terms

POSITION_SHARE = 1 / 32  # positions are rounded once or twice, where the bound counts 64 roundings of a term

EndRows = Literal["accelerations", "twists", "without velocity terms"]
RowChange = Callable[[int, Array, Array], tuple[Array, Array]]


class _TreeTerms:
    """The Newton–Euler system of a tree at one state, its solution, and the sizes of all that is rounded.

    Norms (N,) are named as their vectors: a, alpha, F, moment (of the joint), arm (centre to near point).
    """

    def __init__(
        self,
        model: Model,
        state: State,
        ends: Sequence[tuple[int, int]] = (),
        rows: RowChange | None = None,
        end_rows: EndRows = "accelerations",
    ) -> None:
        self.ends, self.rows, self.end_rows = ends, rows, end_rows
        self.model, self.state, self.n, self.far = model, state, model.n, model.body[:, 0]
        self.A = rotation_matrix(state.p)
        self.inertia = self.A @ model.inertia @ self.A.mT
        self.omega = rotate_vectors(self.A, state.omega)
        self.near = rotate_vectors(self.A, model.proximal)  # centre to near point, world axes
        self.d = joint_vectors(model, state.r, state.p)
        has_far = self.far >= 0
        # centre of the far body to its point where the near point is
        self.far_arm = np.where(has_far[:, None], state.r + self.near - state.r[self.far], 0.0)
        self.below = np.eye(self.n, dtype=bool)  # [k, b]: body b is k or beyond it
        for k in reversed(range(self.n)):
            if self.far[k] >= 0:
                self.below[self.far[k]] |= self.below[k]
        self.springs = spring_terms(model, state)
        self.load = model.force - model.drag_force[:, None] * state.v + self.springs.force
        self.torque = rotate_vectors(self.A, model.moment) - model.drag_moment[:, None] * self.omega
        self.torque = self.torque + self.springs.moment
        self._solve()
        self._measure()

    def _held_and_bend(self, k: int) -> tuple[Array, Array]:
        """E (6, c) of joint k, and the relative acceleration (6,) that the velocities alone cause."""
        model, state, kind, far = self.model, self.state, self.model.kinds[k], self.far[k]
        bend = np.zeros(6)
        spin = self.omega[far] if far >= 0 else np.zeros(3)
        bend[:3] = cross(self.omega[k], cross(self.omega[k], self.near[k])) - cross(
            spin, cross(spin, self.far_arm[k])
        )
        if kind.holds_distance:
            bend[:3] += cross(spin, cross(spin, self.d[k]))  # the far point is not where the near point is
            bend[:3] += model.length[k] * state.udot[k] @ state.udot[k] * state.u[k]
            return np.concatenate([state.u[k], np.zeros(3)])[:, None], bend
        if kind.has_attitude:
            return np.eye(6, 3 if kind.is_spherical else 0), bend
        axes = JointFrame(model, k, self.A[far] if far >= 0 else np.eye(3)).axes(state.x[k])
        carried = spin
        for (what, axis), rate in zip(axes, state.xdot[k], strict=False):
            if what == "slide":
                bend[:3] -= 2 * cross(spin, axis * rate)
            else:
                bend[3:] -= cross(carried, axis * rate)
                carried = carried + axis * rate
        free = [
            np.array([axis for what, axis in axes if what == name]).reshape(-1, 3)
            for name in ("slide", "turn")
        ]
        push, turn = (np.linalg.svd(some)[2][len(some) :].T for some in free)
        held = np.zeros((6, push.shape[1] + turn.shape[1]))
        held[:3, : push.shape[1]], held[3:, push.shape[1] :] = push, turn
        return held, bend

    def _solve(self) -> None:
        n, model = self.n, self.model
        true_rows = [self._held_and_bend(k) for k in range(n)]
        held = [self.rows(k, *true_rows[k]) for k in range(n)] if self.rows else true_rows
        first = np.cumsum([0, *(E.shape[1] for E, _ in held)])
        C = np.zeros((first[-1] + 6 * len(self.ends), n, 6))
        E_rows = np.zeros((n, 6, len(C)))
        gamma = np.zeros(len(C))
        for loop, (b, c) in enumerate(self.ends):
            rows = slice(first[-1] + 6 * loop, first[-1] + 6 * loop + 6)
            C[rows, b], C[rows, c] = np.eye(6), -np.eye(6)
            if self.end_rows == "twists":
                C[rows.start : rows.start + 3, c, 3:], gamma[rows] = self._twist_terms(b, c)
        for k, (E, bend) in enumerate(held):
            rows = slice(first[k], first[k + 1])
            C[rows] = self._relative_rows(k, E)
            E_rows[k, :, rows] = E
            gamma[rows] = -E.T @ bend
        if self.end_rows == "without velocity terms":
            gamma[first[-1] :] = C.reshape(-1, 6 * n)[first[-1] :] @ self._resting_joints(true_rows)
        self.elements = joint_elements(model, self.state, [bend for _, bend in true_rows])
        armature, bias, torque = (
            np.array([getattr(e, name) for e in self.elements]) for name in ("armature", "bias", "torque")
        )
        J, directions = self._element_rows()
        x_rows, K_inverse = self._inverse(C.reshape(-1, 6 * n), J, armature)
        X = x_rows[:, 6 * n :]
        wrench_rows = E_rows @ np.concatenate([-X.T, K_inverse], 1)
        if len(armature):  # the joint's whole wrench: its elements' too
            wrench_rows -= directions @ (armature[:, None] * (J @ x_rows))
        x_rows, wrench_rows = (some.reshape(n, 2, 3, -1) for some in (x_rows, wrench_rows))
        weld_x, weld_wrench = X[:, first[-1] :], E_rows @ K_inverse[:, first[-1] :]
        welds = [some.reshape(n, 2, 3, -1) for some in (weld_x, weld_wrench)]
        self.of_weld = np.concatenate(welds, 1)
        inverse = np.concatenate([x_rows, wrench_rows], 1)  # (N, 4, 3, 6 N + c): r̈, α, F, M of each body
        self.of_body = inverse[..., : 6 * n].reshape(n, 4, 3, n, 2, 3)
        # per joint the response to errors of its six relative accelerations
        self.of_joint = np.einsum("nqir,kjr->nqikj", inverse[..., 6 * n :], E_rows).reshape(n, 4, 3, n, 2, 3)
        force = model.mass[:, None] * model.gravity + self.load
        moment = self.torque - cross(self.omega, rotate_vectors(self.inertia, self.omega))
        body_terms = np.concatenate([force, moment], -1).ravel() + (torque - armature * bias) @ J
        own = (directions @ (torque - armature * bias)).reshape(n, 2, 3)
        self.solution = np.moveaxis(inverse @ np.concatenate([body_terms, gamma]), 1, 0)  # (4, N, 3)
        self.solution[2:] += np.moveaxis(own, 1, 0)

    def _twist_terms(self, b: int, c: int) -> tuple[Array, Array]:
        """What the rows of V̇_b − V̇_c + (V_b − V_c) × V_c = 0, at r_b, have besides accelerations of centres.

        Returns:
            (3, 3) of α_c in the linear rows, and (6,) on the right; both 0 where the ends are together.

        """
        d, v, w = self.state.r[b] - self.state.r[c], self.state.v, self.omega
        apart = v[b] - v[c]
        linear = cross(w[b], apart - cross(w[c], d)) + cross(w[c], apart)
        return cross_matrix(d), np.concatenate([linear, cross(w[c], w[b])])

    def _resting_joints(self, rows: Sequence[tuple[Array, Array]]) -> Array:
        """(6 N,) accelerations by the velocities alone, where no joint's coordinate accelerates."""
        n = self.n
        C = np.concatenate([self._relative_rows(k, np.eye(6)) for k in range(n)]).reshape(6 * n, 6 * n)
        return np.linalg.solve(C, -np.concatenate([bend for _, bend in rows]))

    def _relative_rows(self, k: int, E: Array) -> Array:
        """Rows (c, N, 6) of the relative acceleration of joint k along the columns of E (6, c)."""
        rows = np.zeros((E.shape[1], self.n, 6))
        rows[:, k, :3], rows[:, k, 3:] = E[:3].T, E[3:].T - E[:3].T @ cross_matrix(self.near[k])
        if self.far[k] >= 0:
            arm = self.far_arm[k] - (self.d[k] if self.model.rods[k] else 0.0)
            rows[:, self.far[k], :3] = -E[:3].T
            rows[:, self.far[k], 3:] = E[:3].T @ cross_matrix(arm) - E[3:].T
        return rows

    def _inverse(self, C: Array, J: Array, armature: Array) -> tuple[Array, Array]:
        """Rows (6N, 6N + c) of x of the inverse of (M, −Cᵀ; C, 0), rotors in M, and its block K⁻¹ (c, c)."""
        n, body = self.n, np.arange(self.n)
        masses = np.eye(3) * self.model.mass[:, None, None]
        if self.model.lacks_inertia:
            M = np.zeros((n, 6, n, 6))
            M[body, :3, body, :3], M[body, 3:, body, 3:] = masses, self.inertia
            S = np.block([[M.reshape(6 * n, -1) + (J.T * armature) @ J, C.T], [C, np.zeros((len(C),) * 2)]])
            sizes = np.max(np.abs(S), axis=1)
            if not np.all(sizes):  # where the rows of a joint are left out
                raise np.linalg.LinAlgError("a body can turn without inertia")
            inverse = self._equilibrated_inverse(S, 1 / np.sqrt(sizes))
            return inverse[: 6 * n], -inverse[6 * n :, 6 * n :]
        M_inverse = np.zeros((n, 6, n, 6))
        M_inverse[body, :3, body, :3] = np.eye(3) / self.model.mass[:, None, None]
        M_inverse[body, 3:, body, 3:] = np.linalg.inv(self.inertia)
        M_flat = M_inverse.reshape(6 * n, 6 * n)
        rotors = armature > 0
        if np.any(rotors):
            MJ = M_flat @ J[rotors].T
            M_flat = M_flat - MJ @ np.linalg.inv(np.diag(1 / armature[rotors]) + J[rotors] @ MJ) @ MJ.T
        CM = C @ M_flat
        K = CM @ C.T
        K_inverse = self._equilibrated_inverse(K, 1 / np.sqrt(np.diag(K)))
        X = CM.T @ K_inverse
        return np.concatenate([M_flat - X @ CM, X], 1), K_inverse

    def _equilibrated_inverse(self, matrix: Array, s: Array) -> Array:
        """The inverse, of loops the pseudo-inverse: pivots must not depend on the units."""
        scaled = matrix * s * s[:, None]
        found = np.linalg.pinv(scaled, 1e-13, hermitian=True) if self.ends else np.linalg.inv(scaled)
        return np.asarray(found * s * s[:, None])

    def _element_rows(self) -> tuple[Array, Array]:
        """Rows J (e, 6N) of the elements, and their directions (N, 6, e)."""
        J = np.zeros((len(self.elements), 6 * self.n))
        directions = np.zeros((self.n, 6, len(self.elements)))
        for i, element in enumerate(self.elements):
            J[i] = self._relative_rows(element.k, element.direction[:, None]).ravel()
            directions[element.k, :, i] = element.direction
        return J, directions

    def _measure(self) -> None:
        norm, model = np.linalg.norm, self.model
        self.g, self.m, self.J = float(norm(model.gravity)), model.mass, norm(model.inertia, axis=(1, 2))
        self.a, self.alpha, self.F, self.moment = norm(self.solution, axis=-1)
        self.arm, self.reach = norm(self.near, axis=1), norm(self.far_arm, axis=1) + norm(self.d, axis=1)
        # arms that are differences of positions far from the origin, which some engines use
        self.place = POSITION_SHARE * norm(self.state.r, axis=1)
        own = norm(self.omega, axis=1) + norm(self.state.udot, axis=1) + norm(self.state.xdot, axis=1)
        # largest rate of any body or joint between the world and here, per body
        self.W = np.max(np.where(self.below.T, own, 0.0), axis=1)
        self.transport = norm(self.omega, axis=1) * norm(self.state.v, axis=1)
        self.load_size = norm(self.load, axis=1) + self.springs.size
        self.torque_size = norm(self.torque, axis=1) + self.springs.moment_size
        self.element_size = np.zeros(self.n)  # of each joint
        for element in self.elements:
            self.element_size[element.k] += element.size
        self.spin = self.J * norm(self.omega, axis=1) * self.W
        slides = [bool(kind.slide_axes) for kind in model.kinds]
        self.slide_rate = np.sum(np.abs(self.state.xdot), axis=1) * slides
        children = [np.flatnonzero(self.far == k) for k in range(self.n)]
        self.F_children = np.array([np.sum(self.F[kids]) for kids in children])
        self.moment_children = np.array(
            [np.sum(self.moment[kids] + self.reach[kids] * self.F[kids]) for kids in children]
        )

    def of_far(self, x: Array) -> Array:
        """Value (N,) at the far body of each joint, 0 at the world."""
        return np.where(self.far >= 0, x[self.far], 0.0)

    def propagate(self, force: Array, moment: Array, linear: Array, angular: Array) -> Array:
        """First-order change (N, 4) of r̈, α, F, M for errors (N,) in the equations of bodies and joints."""
        errors = np.stack([force, moment, linear, angular], 1)
        norms = np.concatenate(
            [np.linalg.norm(part, axis=(2, 5)) for part in (self.of_body, self.of_joint)], axis=-1
        )  # (N, 4, N, 4)
        return np.asarray(np.einsum("nqkc,kc->nq", norms, errors))

    def body_errors(self) -> tuple[Array, Array, Array, Array]:
        """Largest term of each Newton and Euler equation, and of each joint's relative accelerations."""
        # spatial algebra in a body's axes holds ω × ṙ and ṙ × m ṙ, which a moving free body makes large
        weights = [
            self.m * self.a,
            self.m * self.g,
            self.m * self.transport,
            self.F,
            self.F_children,
            self.load_size,
        ]
        moments = [
            self.m * np.linalg.norm(self.state.v, axis=1) ** 2,
            self.J * self.alpha,
            self.spin,
            self.arm * self.F,
            self.torque_size,
            self.moment,
            self.place * self.F,
            self.place * self.F_children,
        ]
        far_a, far_alpha = self.of_far(self.a), self.of_far(self.alpha)
        linear = [self.a, self.arm * self.alpha, self.arm * self.W**2, far_a, self.reach * far_alpha,
                  self.reach * self.W**2, self.W * self.slide_rate,
                  self.place * self.alpha, self.place * self.W**2]  # fmt: skip
        angular = [self.alpha, far_alpha, self.W**2]
        sizes = (weights, [*moments, self.moment_children], linear, angular)
        force, moment, linear_size, angular_size = (np.max(terms, 0) for terms in sizes)
        return force, moment, linear_size, angular_size

    def weld_errors(self) -> Array:
        """First-order change (N, 4) of r̈, α, F, M by errors in the rows that join parts of a body."""
        total = np.zeros((self.n, 4))
        for loop, pair in enumerate(self.ends):
            around = np.any([self.below[:, k] for k in pair], axis=0)
            reach = np.sum((self.reach + self.arm)[around])
            sizes = [
                np.max(self.a[around]) + reach * np.max(self.W[around] ** 2 + self.alpha[around]),
                np.max(self.alpha[around] + self.W[around] ** 2),
            ]
            response = self.of_weld[..., 6 * loop : 6 * loop + 6].reshape(self.n, 4, 3, 2, 3)
            total += np.linalg.norm(response, axis=(2, 4)) @ sizes
        return total

    def elimination_errors(self) -> tuple[Array, Array]:
        """Terms of C M⁻¹ f in the linear and angular rows of each joint; of a body with an M⁻¹."""
        principal = np.linalg.eigvalsh(self.model.inertia)
        least = np.where(principal[:, 0] > ZERO_INERTIA * principal[:, 2], principal[:, 0], np.inf)
        free = (self.F + self.F_children + self.m * self.g + self.load_size) / self.m
        turn = self.arm * self.F + self.moment + self.moment_children + self.spin + self.torque_size
        turn = turn / least
        far_free, far_turn = self.of_far(free), self.of_far(turn)
        return free + self.arm * turn + far_free + self.reach * far_turn, turn + far_turn


class _JointSpace:
    """Joint coordinates of a tree: turns at near points (a rod's also at its far point), and slides.

    Per coordinate and body: ``lever`` [m or 1] the size of the velocity of the centre per unit rate,
    ``turns`` 1 where the body turns with it.
    """

    def __init__(self, terms: _TreeTerms) -> None:
        self.terms, model, state = terms, terms.model, terms.state
        omega, alpha = terms.omega, terms.solution[1]
        self.pairs: list[tuple[str, int]] = []
        lever: list[Any] = []
        turns: list[Any] = []
        rates: list[Any] = []
        accelerations: list[Any] = []
        for k, kind in enumerate(model.kinds):
            far = terms.far[k]
            below = terms.below[k].astype(float)
            tip = state.r[k] + terms.near[k]
            above_w, above_a = (omega[far], alpha[far]) if far >= 0 else (np.zeros(3), np.zeros(3))
            if kind.holds_distance:
                spin = cross(state.u[k], state.udot[k])
                swing = self._rod_acceleration(k)
                self._add(
                    lever,
                    turns,
                    rates,
                    accelerations,
                    tip - terms.d[k],
                    below,
                    spin - above_w,
                    swing - above_a,
                )
                self.pairs.append(("upper", k))
                self._add(lever, turns, rates, accelerations, tip, below, omega[k] - spin, alpha[k] - swing)
                self.pairs.append(("lower", k))
                continue
            if kind.has_attitude or kind.turn_axes:
                self._add(
                    lever, turns, rates, accelerations, tip, below, omega[k] - above_w, alpha[k] - above_a
                )
                self.pairs.append(("turn", k))
            if kind.holds_nothing or kind.slide_axes:
                lever.append(below)
                turns.append(0 * below)
                rates.append(np.linalg.norm(state.v[k]) if kind.holds_nothing else terms.slide_rate[k])
                accelerations.append(np.linalg.norm(self._slide_acceleration(k)))
                self.pairs.append(("slide", k))
        shape = (len(lever), terms.n)
        self.lever, self.turns = np.reshape(lever, shape), np.reshape(turns, shape)
        self.rate, self.acceleration = np.array(rates), np.array(accelerations)
        m, J = terms.m, terms.J
        self.mass_matrix = (self.lever * m) @ self.lever.T + (self.turns * J) @ self.turns.T
        h = self.turns @ (J * terms.W**2 + terms.torque_size)
        h += self.lever @ (m * (terms.g + terms.a) + terms.load_size)
        for element in terms.elements:
            row = self.pairs.index(("slide" if element.is_slide else "turn", element.k))
            self.mass_matrix[row, row] += element.armature
            h[row] += element.size
        self.load = self.mass_matrix @ self.acceleration + h  # N m or N

    def _add(
        self, lever: list[Any], turns: list[Any], rates: list[Any], accelerations: list[Any],
        at: Array, below: Array, rate: Array, acceleration: Array,
    ) -> None:  # fmt: skip
        """Add a turn at a point of the world."""
        lever.append(below * np.linalg.norm(self.terms.state.r - at, axis=1))
        turns.append(below)
        rates.append(np.linalg.norm(rate))
        accelerations.append(np.linalg.norm(acceleration))

    def _point_acceleration(self, body: int, arm: Array) -> Array:
        if body < 0:
            return np.zeros(3)
        t = self.terms
        w, alpha = t.omega[body], t.solution[1, body]
        return np.asarray(t.solution[0, body] + cross(alpha, arm) + cross(w, cross(w, arm)))

    def _slide_acceleration(self, k: int) -> Array:
        t = self.terms
        near = self._point_acceleration(k, t.near[k])
        return near - self._point_acceleration(t.far[k], t.far_arm[k])

    def _rod_acceleration(self, k: int) -> Array:
        """Angular acceleration of a rod without axial spin, u × d̈/ℓ."""
        t = self.terms
        near = self._point_acceleration(k, t.near[k])
        far = self._point_acceleration(t.far[k], t.far_arm[k] - t.d[k])
        return np.asarray(cross(t.state.u[k], near - far) / t.model.length[k])

    def responses(self) -> Array:
        """Norms (coordinates, N, 4) of the response to a unit torque or force pair at each coordinate."""
        t = self.terms
        force, moment = np.moveaxis(t.of_body, 3, 0)[..., 0, :], np.moveaxis(t.of_body, 3, 0)[..., 1, :]
        none = np.zeros_like(force[0])

        def push(body: int, arm: Array) -> Array:
            return np.asarray(force[body] + moment[body] @ cross_matrix(arm)) if body >= 0 else none

        found = []
        for what, k in self.pairs:
            far = t.far[k]
            above = moment[far] if far >= 0 else none
            if what == "turn":
                found.append(moment[k] - above)
            elif what == "slide":
                found.append(push(k, t.near[k]) - push(far, t.far_arm[k]))
            else:  # a torque on a massless rod is balanced by forces ∓(τ × u)/ℓ at its ends
                ends = push(k, t.near[k]) - push(far, t.far_arm[k] - t.d[k])
                through = -ends @ cross_matrix(t.state.u[k]) / t.model.length[k]
                found.append(through - above if what == "upper" else moment[k] - through)
        return np.asarray(np.linalg.norm(np.reshape(found, (len(found), t.n, 4, 3, 3)), axis=(3, 4)))


def _directions_used(t: _TreeTerms) -> Array:
    """(N, 2): 1 where elements of a joint pull, and where they turn."""
    used = np.zeros((t.n, 2))
    for element in t.elements:
        used[element.k, int(not element.is_slide)] = 1.0
    return used


def tree_solution(
    model: Model,
    state: State,
    ends: Sequence[tuple[int, int]] = (),
    rows: RowChange | None = None,
    end_rows: EndRows = "accelerations",
) -> Array:
    """Solve the Newton–Euler system of a tree in doubles.

    Args:
        model: the mechanism; masses > 0, inertias positive definite.
        ends: pairs of bodies that are joined besides, parts of one body.
        rows: changes what joints hold, as a defect does: of joint k the directions E (6, c) and the relative
            acceleration (6,) that velocities cause.
        end_rows: what the rows of ``ends`` make equal: accelerations of the bodies, or rates of their twists,
            which is another law where the ends are apart; or accelerations, without what velocities cause.

    Returns:
        (4, N, 3): r̈ [m/s²], ω̇ [rad/s²], and force [N] and moment [N m] of the joints; world axes.

    """
    return np.asarray(_TreeTerms(model, state, ends, rows, end_rows).solution)


def tree_tolerances(
    model: Model, state: State
) -> tuple[Array, dict[str, Array | float], dict[str, float], Array]:
    """Compute the sizes of all roundings of a tree at one state.

    Args:
        model: the mechanism; masses > 0, inertias positive definite.
        state: the state at which quantities are compared.

    Returns:
        tB + tS + tJ + d (N, 4) of r̈ [m/s²], α [rad/s²], F [N] and M [N m]; the scales of all quantities; the
        sums behind the energies [J], the angular momentum and the mass matrix; torques of rods (N,) [N m].

    """
    if model.has_loops:
        return _loop_tolerances(model, state)
    return _tolerances(_TreeTerms(model, state))


def _loop_tolerances(
    model: Model, state: State
) -> tuple[Array, dict[str, Array | float], dict[str, float], Array]:
    """`tree_tolerances` of a mechanism with loops: rows of joints where the tree has rows of bodies."""
    cut = cut_open(model)
    terms = _TreeTerms(cut.model, cut.state(state), cut.ends)
    total, scale, sums, _ = _tolerances(terms)
    spread = 1 + 1 / smallest_singular_value(model, state)
    # what one body or joint has is found together with what all others of the loop have
    largest = {name: float(np.max(value)) for name, value in scale.items() if isinstance(value, np.ndarray)}
    largest["joint_moment"] = max(largest["joint_moment"], wrench_length(model) * largest["joint_reaction"])
    of_terms = terms.propagate(*terms.body_errors()) + terms.weld_errors() + list(largest.values())
    total += terms.weld_errors() + list(largest.values()) + of_terms * (spread - 1)
    sums = {name: size * spread for name, size in sums.items()}
    for name, value in largest.items():
        scale[name] = np.full(len(model.kind) if name.startswith("joint") else model.n, value)
    return total[cut.place], scale, sums, np.zeros(model.n)


def _tolerances(t: _TreeTerms) -> tuple[Array, dict[str, Array | float], dict[str, float], Array]:
    model, state = t.model, t.state
    joints = _JointSpace(t)
    force, moment, linear, angular = t.body_errors()
    total = t.propagate(force, moment, linear, angular)
    total += t.propagate(0 * force, 0 * moment, *t.elimination_errors())
    total += np.einsum("jnq,j->nq", joints.responses(), joints.load)
    swing, turning = joints.lever.T @ joints.acceleration, joints.turns.T @ joints.acceleration
    tip = state.r + t.near
    carried = t.m * (t.a + swing + t.g + t.transport) + t.load_size
    lever = np.linalg.norm(state.r - tip[:, None], axis=2) * t.below
    carried_moment = t.below @ (t.J * (t.alpha + turning) + t.spin + t.torque_size) + lever @ carried
    result = np.stack([np.maximum(t.a, t.g), t.alpha, t.F, t.moment], 1)
    total += result
    free = model.free  # its wrench is what rounding leaves
    total[free, 2:] += np.stack([t.below @ force, t.below @ moment], 1)[free]
    total[:, 2:] += t.element_size[:, None] * _directions_used(t)
    total += np.stack([swing + t.a + t.transport, turning, t.below @ carried, carried_moment], 1)

    rate, speed = joints.turns.T @ joints.rate, joints.lever.T @ joints.rate
    with_place = np.maximum(speed, t.place * rate)
    steps = np.linalg.norm(model.point, axis=2).sum(1) + np.linalg.norm(t.d, axis=1)
    steps += np.linalg.norm(state.r, axis=1) * model.free
    height = t.below.T @ steps
    sums = {
        "kinetic_energy": float(0.5 * np.sum(t.m * speed * with_place + t.J * rate**2))
        + sum(element.kinetic for element in t.elements),
        "potential_energy": float(t.g * np.sum(t.m * height))
        + sum((element.potential for element in t.elements), t.springs.potential),
        "angular_momentum": float(np.sum(t.m * height * with_place + t.J * rate)),
        "mass_matrix": float(np.max(joints.mass_matrix, initial=0.0)),
    }
    scale: dict[str, Array | float] = {
        "acceleration": result[:, 0],
        "angular_acceleration": np.max([t.alpha, moment / np.where(t.J > 0, t.J, np.inf), turning], 0),
        "joint_reaction": np.max([t.F, t.m * t.g, t.m * t.a], 0),
        "joint_moment": np.max(
            [t.moment, t.arm * t.F, t.J * t.alpha, t.element_size, lever @ (t.m * t.g)], 0
        ),
        **sums,
    }
    rods = np.zeros(t.n)
    for (what, k), load in zip(joints.pairs, joints.load, strict=True):
        rods[k] += load * (what in ("upper", "lower"))
    return total, scale, sums, rods
