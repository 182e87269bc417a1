"""The system S x = b of the notes for many chains at once, in O(bodies): the structured form.

`reference_impl.direct` is the specification; this form gives the same r̈, p̈, λ, λ_E without assembling
S.  A forest is any number of chains laid end to end, and a batch is just more chains.  Inside, arrays
are component first and body last, (3, M) for M bodies, so that every line works on all bodies at once.

What makes it short, exact for every p ≠ 0 (with π = pᵀp, σ = pᵀṗ, ω = 2 L ṗ, R the rotation matrix of p/√π):

    W(p,s) := ∂(A s)/∂p,   W Lᵀ = −2 π R s̃,   W p = 2 π (R s + s),   L L̇ᵀ = σ I + ½ ω̃
    p̈ = Lᵀα / 2π − p ṗᵀṗ/π,   J α = n′ − ω×Jω/π − 2 (σ/π) Jω + Σ s×Rᵀf          (N2) and (N4) solved
    point of the body:  W p̈ + Ẇ ṗ = R [ (α + 2 (σ/π) ω)×s + ω×(ω×s)/π ]          the σ terms cancel

so with J⁻¹ = K Kᵀ and X = −R s̃ K (3, 3) a world force f at s accelerates the point by (I/m + X Xᵀ) f.
Joint k has the rows U_kᵀ(…) of `joints`, c = 1 (rod, U = 2d) or 3 (ball, U = I); the force on body k
is U_k μ_k with μ = −λ.  Rows couple neighbours only: one symmetric positive definite block-tridiagonal
system D μ = −h for λ, solved by banded Cholesky; the rest is back-substitution.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from reference_impl.arrays import Array, Float, Motion
from reference_impl.direct import EPS, Solution, check_state_solvable, joint_forces
from reference_impl.elements import Elements
from reference_impl.euler_parameters import G, L, tilde
from reference_impl.joints import constraint_rows
from reference_impl.mechanism import Mechanism, side_by_side
from reference_impl.singular_system import SingularSystem

# Constants that turn flattened outer products of p with another vector into what is needed of them.
_L, _G = L(np.eye(4)), G(np.eye(4))  # (4, 3, 4) each: L(p) = Σ pᵢ Lᵢ
_TO_OMEGA = 2 * _L.transpose(1, 0, 2).reshape(3, 16)  # p ṗᵀ → ω′ = 2 L(p) ṗ
_HALF_LT = _L.transpose(2, 0, 1).reshape(4, 12) / 2  # p αᵀ → ½ L(p)ᵀ α
_TO_NORM = np.eye(4).reshape(1, 16)  # p bᵀ → pᵀb
_GLT = np.einsum("iak,jbk->abij", _G, _L).reshape(9, 4, 4)  # p pᵀ → π R = G Lᵀ (N10), row by row
_TO_ROTATION = np.concatenate([_TO_NORM, (_GLT + _GLT.mT).reshape(9, 16) / 2])  # p pᵀ → π, then π R
_TO_TILDE = tilde(np.eye(3)).reshape(3, 9).T  # ω → ω̃, row by row
_FIRST_FACTORS, _SECOND_FACTORS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # the six products ωᵢ ωⱼ
_TO_RATE_PRODUCTS = np.concatenate([_TO_NORM, _TO_OMEGA[_FIRST_FACTORS], _TO_OMEGA[_SECOND_FACTORS]])
# The lower band of D: column 3k+j holds rows j, j+1 … of its own block and then the next block's, 6 in all.
_BAND_INDICES = np.array(
    [
        *(0, 3, 6, 9, 12, 15),  # cells 3 i + j of the own block, 9 + 3 i + j of the next
        *(4, 7, 10, 13, 16, 18),  # 18: zeros
        *(8, 11, 14, 17, 18, 18),
    ]
)


def _matrix_vector(matrix: Array, vector: Array) -> Array:
    """Matrix (i, j, M) times vector (j, M), or (c, j, M) of several points."""
    return np.asarray(np.einsum("ijm,...jm->...im", matrix, vector))


def _dot(a: Array, b: Array) -> Array:
    """Sum over the first axis of a b."""
    return np.asarray(np.vecdot(a, b, axis=0))  # type: ignore[call-overload]  # its stubs do not have axis


class FactoredJoints(NamedTuple):
    """The joints' rows at one configuration and the factor of D, for any right-hand side.

    For balls only, c = 3 and U is the identity (``U`` None); for rods only, c = 1; mixed, c = 3 with a
    rod's rows 2 and 3 empty.
    """

    d: Float[Array, "3 bodies"] | None  # m, world frame, joint k's gap or rod; None for balls only
    U: Float[Array, "3 c bodies"] | None  # force on body k per μ_k
    # U_nearᵀ X of body k's proximal, U_farᵀ X of body k−1's distal point (pivot: 0)
    lever_rows: Float[Array, "2 c 3 bodies"]
    U_near: Float[Array, "3 c bodies"] | None  # as U, with the notes' own lever off pᵀp = 1 (E2)
    U_far: Float[Array, "3 c bodies"] | None
    factor: tuple[Float[Array, "..."], ...]
    Rs: Float[Array, "2 3 bodies"] | None  # m, the points turned; None for balls only


class StructuredSystem:
    """Chains laid end to end; M bodies in all.

    Raises SingularSystem for a mass or inertia that is not positive.  Public methods take and
    return body-first arrays (M, ·), the bodies of all chains in order; `acceleration`, `project` and
    what they call take the component-first q = (r; p), v = (ṙ; ṗ), (7, M) each.
    """

    # as of `TreeSystem`: there are no springs on angles
    x: Float[Array, "joints coordinates"] | None = None
    winding: Elements | None = None

    def __init__(self, chains: Sequence[Mechanism]) -> None:
        self.chains = tuple(chains)
        if not all(chain.has_chain_joints for chain in chains):
            raise ValueError("the structured form covers chains of rods and balls")
        forest = side_by_side(self.chains)
        mass, inertia, length, drag_moment = forest.mass, forest.inertia, forest.length, forest.drag_moment
        weight = np.concatenate([c.mass[:, None] * c.gravity + c.force for c in chains])
        self.body_count = len(mass)
        self.first_body = np.cumsum([0, *(chain.n for chain in chains)])
        if np.any(mass <= 0):
            raise SingularSystem(f"the mass of body {int(np.argmin(mass)) + 1} is {np.min(mass)} kg")
        principal = np.linalg.eigvalsh(inertia)
        if np.any(principal[:, 0] <= EPS * principal[:, 2]):
            body = int(np.argmin(principal[:, 0] - EPS * principal[:, 2]))
            raise SingularSystem(
                f"the inertia of body {body + 1} is singular, principal values "
                f"{principal[body].tolist()} kg m², so 4 LᵀJL has rank 2 or less (E7)"
            )
        K = np.linalg.inv(np.linalg.cholesky(inertia)).swapaxes(-1, -2)  # J⁻¹ = K Kᵀ
        distal = np.concatenate([chain.distal for chain in chains])
        points = np.stack([forest.proximal, distal], 1)  # (M, 2, 3)

        def last(x: Array) -> Array:
            return np.ascontiguousarray(np.moveaxis(x, 0, -1))

        self.inverse_mass = 1 / mass  # (M,) 1/kg
        self.J, self.K = last(inertia), last(K)  # (3, 3, M)
        self.s = last(points)  # (2, 3, M) m, proximal and distal point, body frame
        # (3, M) m, of the first bodies; 0 of the others
        self.pivot = last(forest.point[:, 0] * (forest.body[:, :1] < 0))
        self.lever = float(np.abs(points).max())  # m
        self.free_acceleration = last(weight / mass[:, None])  # (3, M) m/s²
        self.drag_rate = forest.drag_force / mass  # (M,) 1/s
        self.has_drag = forest.has_drag
        # β = K⁻¹ J⁻¹ (n′ − ω×Jω/π) and, in the body frame, the points about the centre, B β + ω×(ω×s)/π:
        # (9, M) constant, and (9, 6, M) of the ωᵢ ωⱼ/π; with drag or rods (·, 9, M), the last three of ω.
        cross, one = _TO_TILDE.reshape(3, 3, 3), np.eye(3)
        gyro = -np.einsum("mki,kja,mjd->miad", K, cross, inertia)
        pull = np.einsum("ia,mcd->mciad", one, points) - np.einsum("ad,mci->mciad", one, points)
        B = -tilde(points) @ K[:, None]  # (M, 2, 3, 3)
        self.B, self.B_and_s = last(B), last(np.concatenate([B, points[..., None]], -1))  # (2, 3, 3 or 4, M)
        spin = np.concatenate([gyro, (np.einsum("mcik,mkad->mciad", B, gyro) + pull).reshape(-1, 6, 3, 3)], 1)
        spin = spin[..., _FIRST_FACTORS, _SECOND_FACTORS] + spin[..., _SECOND_FACTORS, _FIRST_FACTORS] * (
            np.arange(6) > 2
        )
        turned = np.concatenate([K.mT, (B @ K.mT[:, None]).reshape(-1, 6, 3)], 1)  # from a moment
        constant = np.matvec(turned, forest.moment)
        self.rods = length > 0
        self.has_only_balls = not np.any(self.rods)
        if self.has_drag:
            spin = np.concatenate([spin, -turned * drag_moment[:, None, None]], -1)
        if not self.has_only_balls:  # and (6, M) ω×s
            spin = np.pad(spin, ((0, 0), (0, 6), (0, 0 if self.has_drag else 3)))
            spin[:, 9:, 6:] = -tilde(points).reshape(-1, 6, 3)
            constant = np.pad(constant, ((0, 0), (0, 6)))
        self.spin_terms, self.moment_terms = last(spin), last(constant)
        self.length = length
        self.is_linked = np.ones(self.body_count)  # 0 where a body is attached to the pivot
        self.is_linked[self.first_body[:-1]] = 0
        self.slack = np.where(self.rods, 0, np.inf)  # of d, which may be 0 at a ball
        self.pair_inverse_mass = self.inverse_mass + self._at_parent(self.inverse_mass)  # (M,) 1/kg
        # 0 where nothing is attached to a body
        self.child_inverse_mass = self.inverse_mass * self._at_child(np.ones(self.body_count))
        self.rows_per_joint = 1 if np.all(self.rods) else 3  # c
        # D's blocks, see _joints
        self.constant_blocks = np.zeros((2 * self.rows_per_joint**2 + 1, self.body_count))
        if self.has_only_balls:  # I/m, the part that never changes
            self.constant_blocks[0:9:4], self.constant_blocks[9:18:4] = (
                self.pair_inverse_mass,
                -self.child_inverse_mass,
            )

    def repeated(self, count: int) -> StructuredSystem:
        """Repeat the chains: all of them, then all again.

        Returns:
            A system of ``count`` times as many chains.

        """
        tiled = object.__new__(StructuredSystem)
        tiled.__dict__.update(self.__dict__)
        tiled.chains, tiled.body_count = self.chains * count, self.body_count * count
        tiled.first_body = np.cumsum([0, *(chain.n for chain in tiled.chains)])
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray) and name != "first_body":  # the last axis counts bodies
                setattr(tiled, name, np.tile(value, count))
        return tiled

    # -- kinematics ---------------------------------------------------------------------------------

    def _at_parent(self, x: Array) -> Array:
        """(..., M): the value at the parent of body k, 0 for the pivot."""
        moved = np.empty_like(x)
        moved[..., 0] = 0
        np.multiply(x[..., :-1], self.is_linked[1:], out=moved[..., 1:])
        return moved

    def _at_child(self, x: Array) -> Array:
        """(..., M): the value at the child of body k, 0 for the last of a chain."""
        moved = np.empty_like(x)
        moved[..., -1] = 0
        np.multiply(x[..., 1:], self.is_linked[1:], out=moved[..., :-1])
        return moved

    def _norm_and_rotation(self, q: Array) -> tuple[Array, Array]:
        """Return π (M,) and R (3, 3, M)."""
        squares = _TO_ROTATION @ (q[3:, None] * q[3:]).reshape(16, -1)
        with np.errstate(all="ignore"):  # p = 0 and what is not finite is named where D is factored
            return squares[0], (squares[1:] / squares[0]).reshape(3, 3, -1)

    def _attachment_points(self, norm: Array, R: Array) -> tuple[Array, Array]:
        """Return R s (2, 3, M) and A s (2, 3, M) = π R s + (π − 1) s."""
        Rs = _matrix_vector(R, self.s)
        return Rs, norm * Rs + (norm - 1) * self.s

    def joint_gaps(
        self, q: Float[Array, "7 bodies"], v: Float[Array, "7 bodies"]
    ) -> tuple[Float[Array, "3 bodies"], Float[Array, "3 bodies"]]:
        """Return the vectors d from where joint k hangs to body k's proximal point, and their rates.

        Args:
            q: (r; p) [m, –].
            v: (ṙ; ṗ) [m/s, 1/s].

        Returns:
            d [m] and ḋ [m/s], world frame.

        """
        norm, R = self._norm_and_rotation(q)
        Rs, As = self._attachment_points(norm, R)
        rates = self._rate_products(q, v)
        sigma, omega = rates[0], rates[1:4]
        velocity = _matrix_vector(R, _matrix_vector((_TO_TILDE @ omega).reshape(3, 3, -1), self.s))
        velocity += 2 * sigma * (Rs + self.s)
        d = q[:3] + As[0] - self._at_parent(q[:3] + As[1]) - self.pivot
        return d, v[:3] + velocity[0] - self._at_parent(v[:3] + velocity[1])

    def constraints(
        self, q: Float[Array, "7 bodies"], v: Float[Array, "7 bodies"]
    ) -> tuple[Float[Array, "c bodies"], Float[Array, "c bodies"]]:
        """Evaluate the constraints: d of a ball joint, dᵀd − ℓ² of a rod (E1).

        Args:
            q: (r; p) [m, –].
            v: (ṙ; ṗ) [m/s, 1/s].

        Returns:
            C and Ċ; where c = 3, rows 2 and 3 of a rod are 0.

        """
        d, rate = self.joint_gaps(q, v)
        rod = np.stack([_dot(d, d) - self.length**2, 2 * _dot(d, rate)])
        if self.rows_per_joint == 1:
            return rod[0][None], rod[1][None]
        first = np.array([[1.0], [0], [0]])
        return np.where(self.rods, rod[0] * first, d), np.where(self.rods, rod[1] * first, rate)

    def _rate_products(self, q: Array, v: Array) -> Array:
        """(13, M): σ = pᵀṗ; ω = 2 L ṗ and then the rest of the first, then the second factors of ωᵢ ωⱼ."""
        return np.asarray(_TO_RATE_PRODUCTS @ (q[3:, None] * v[3:]).reshape(16, -1))

    # -- the joint system ---------------------------------------------------------------------------

    def _factor_joints(self, q: Array, norm: Array, R: Array) -> FactoredJoints:
        """The joints' rows and D factored. SingularSystem with the cause."""
        c = self.rows_per_joint
        d = U = U_near = U_far = Rs = None
        # D's blocks: (c, c, M) on the diagonal, (c, c, M) of joint k + 1 with joint k, and zeros to fill up.
        cells = self.constant_blocks.copy()
        own, after = cells[:-1].reshape(2, c, c, -1)
        if self.has_only_balls:
            rows = np.einsum("ijm,cjkm->cikm", R, self.B)
            rows[1] = self._at_parent(rows[1])
        else:
            turned = np.einsum("ijm,cjkm->cikm", R, self.B_and_s)
            X, Rs = turned[:, :, :3], turned[:, :, 3]
            excess = (norm - 1) * self.s
            As, off = norm * Rs + excess, 2 * excess
            far = self._at_parent(np.concatenate([q[:3] + As[1], off[1]]))
            d = q[:3] + As[0] - far[:3] - self.pivot
            self._check_rods(q, d)
            U, U_near, U_far = (self._padded_rows(w) for w in (2 * d, 2 * d - off[0], 2 * d + far[3:]))
            rows = np.empty((2, c, 3, self.body_count))
            np.einsum("icm,ijm->cjm", U_near, X[0], out=rows[0])
            np.einsum("icm,ijm->cjm", U_far, self._at_parent(X[1]), out=rows[1])
            np.multiply(np.einsum("icm,iem->cem", U, U), self.pair_inverse_mass, out=own)
            np.multiply(np.einsum("icm,iem->cem", self._at_child(U), U), -self.child_inverse_mass, out=after)
            if c == 3:
                own[[1, 2], [1, 2]] += self.rods  # the empty rows
        own += np.einsum("kcim,keim->cem", rows, rows)
        after[..., :-1] -= np.einsum("cim,eim->cem", rows[1, ..., 1:], rows[0, ..., :-1])
        if c == 1:
            beside = after[0, 0, :-1] if self.body_count > 1 else np.zeros(1)  # LAPACK's wrapper wants one
            pivots, coupling, info = lapack.dpttrf(own[0, 0], beside)
            factor: tuple[Array, ...] = (pivots, coupling)
            largest = own[0, 0]
        else:
            band = np.ascontiguousarray(cells.take(_BAND_INDICES, axis=0).T).reshape(-1, 6)
            cholesky, info = lapack.dpbtrf(band.T, lower=1)
            factor = (cholesky,)
            pivots, largest = cholesky[0] ** 2, band[:, 0]
        if info != 0 or not (pivots > 8 * EPS * largest).all():
            self._raise_singular(q, d)
        return FactoredJoints(d=d, U=U, lever_rows=rows, U_near=U_near, U_far=U_far, factor=factor, Rs=Rs)

    def _padded_rows(self, w: Array) -> Array:
        """U (3, c, M): w of rods, the identity of balls."""
        if self.rows_per_joint == 1:
            return w[:, None]
        U = np.where(self.rods, 0.0, np.eye(3)[:, :, None])
        U[:, 0] = np.where(self.rods, w, U[:, 0])
        return U

    def _check_rods(self, q: Array, d: Array) -> None:
        """Raise SingularSystem where a rod has length 0 to rounding."""
        shortest = (_dot(d, d) + self.slack).min()
        span = max(np.abs(q[:3]).max(), self.lever)
        if not shortest > (16 * EPS * span) ** 2:
            self._raise_singular(q, d, certain=False)

    def _raise_singular(self, q: Array, d: Array | None, certain: bool = True) -> None:
        """Raise SingularSystem that names the chain's body and the cause (E1, E7)."""
        # R is not, where p = 0
        d = np.ones((3, self.body_count)) if d is None else np.where(np.isfinite(d), d, 1.0)
        for chain, at in zip(self.chains, self.first_body, strict=False):
            part = slice(at, at + chain.n)
            check_state_solvable(
                chain, q[:3, part].T, q[3:7, part].T, d[:, part].T, chain.rods, (q[:, part],)
            )
        if certain:
            raise SingularSystem(
                "the joint rows are not independent at this state: S is singular to rounding"
            )

    def _back_substitute(self, joints: FactoredJoints, h: Array) -> tuple[Array, Array, Array]:
        """μ = −D⁻¹ h (c, M); what it adds to r̈, (3, M), and to β = K⁻¹ α, (3, M)."""
        if self.rows_per_joint == 1:
            mu = lapack.dpttrs(*joints.factor, -h[0])[0][None]
        else:
            mu = lapack.dpbtrs(*joints.factor, -h.T.reshape(-1, 1), lower=1)[0].reshape(-1, 3).T
        f = self._joint_force(joints, mu)
        linear = (f - self._at_child(f)) * self.inverse_mass
        near, far = np.einsum("kcjm,cm->kjm", joints.lever_rows, mu)
        return mu, linear, near - self._at_child(far)

    @staticmethod
    def _joint_force(joints: FactoredJoints, mu: Array) -> Array:
        """U μ (3, M) N, world frame: the force on body k at its proximal point."""
        return mu if joints.U is None else np.asarray(np.einsum("icm,cm->im", joints.U, mu))

    # -- accelerations ------------------------------------------------------------------------------

    @property
    def joint_count(self) -> int:
        """Number of joints: one holds each body."""
        return self.body_count

    def acceleration(
        self,
        q: Float[Array, "7 bodies"],
        v: Float[Array, "7 bodies"],
        baumgarte: float = 0.0,
        x: Float[Array, "joints coordinates"] | None = None,
    ) -> Float[Array, "7 bodies"]:
        """Return the accelerations, on or off the constraints.

        Args:
            q: (r; p) [m, –].
            v: (ṙ; ṗ) [m/s, 1/s].
            baumgarte: a [1/s]; adds −2 a Ċ − a² C to γ and likewise to γ_E.  0 is the notes' raw form.

        Returns:
            (r̈; p̈) [m/s², 1/s²].

        Raises:
            SingularSystem: S is singular.

        """
        return self._solve_motion(q, v, baumgarte)[0]

    def _solve_motion(self, q: Array, v: Array, a: float) -> tuple[Array, Array, FactoredJoints, Array]:
        """(r̈; p̈), μ, the joints and ω."""
        norm, R = self._norm_and_rotation(q)
        joints = self._factor_joints(q, norm, R)
        rates = self._rate_products(q, v)
        sigma, omega = rates[0], rates[1:4]
        terms = rates[1:7] * rates[7:] / norm
        linear = self.free_acceleration
        if self.has_drag:
            linear = linear - self.drag_rate * v[:3]
        if self.has_drag or not self.has_only_balls:
            terms = np.concatenate([terms, omega])
        moved = self.moment_terms + _matrix_vector(self.spin_terms, terms)
        beta, turned = moved[:3], _matrix_vector(R, moved[3:].reshape(-1, 3, self.body_count))
        if self.has_only_balls:
            turned += linear
            h = turned[0] - self._at_parent(turned[1])
        else:
            h = self._rod_rows(joints, linear, turned[:2], v, sigma, turned[2:])
        if a:
            C, rate = self.constraints(q, v)
            h = h + 2 * a * rate + a * a * C
        mu, pulled, turning = self._back_substitute(joints, h)

        alpha = _matrix_vector(self.K, beta + turning) - 2 * (sigma / norm) * omega
        p, pdot = q[3:], v[3:]
        stretch = _dot(pdot, pdot)  # −pᵀp̈, from (N4)
        if a:
            stretch = stretch + 2 * a * sigma + 0.5 * a * a * (norm - 1)
        out = np.empty_like(q)
        np.add(linear, pulled, out=out[:3])
        np.subtract(_HALF_LT @ (p[:, None] * alpha).reshape(12, -1), p * stretch, out=out[3:])
        out[3:] /= norm
        if not np.isfinite(out.sum()):  # an overflow, or a rate or load that is not a number
            self._raise_singular(np.concatenate([q, v]), joints.d)
        return out, mu, joints, omega

    def _rod_rows(
        self, joints: FactoredJoints, linear: Array, relative: Array, v: Array, sigma: Array, swing: Array
    ) -> Array:
        """H (c, M) where there are rods: C̈ without the joints' forces, with the notes' E2 and E3.

        ``linear`` r̈ and ``relative`` the points' accelerations about the centres without joints, ``swing``
        R(ω×s).
        """
        assert joints.U is not None and joints.U_near is not None and joints.U_far is not None
        assert joints.Rs is not None
        terms = np.empty((2, 13, self.body_count))  # of both points
        velocity, excess, centre, point, product = (
            terms[:, rows] for rows in (slice(3), slice(3, 6), slice(6, 9), slice(9, 12), 12)
        )
        double = 2 * sigma
        np.multiply(double, self.s, out=excess)  # d_t(A s) − 2 G L̇ᵀ s (E3)
        turning = swing + double * joints.Rs + excess  # d_t(A s)
        np.add(v[:3], turning, out=velocity)
        centre[:], point[:] = linear, relative
        np.einsum("cim,cim->cm", excess, turning, out=product)
        np.negative(product[1], out=product[1])
        near, far = terms[0], self._at_parent(terms[1])
        difference = near - far
        ddot = difference[:3]
        row = _dot(joints.U[:, 0], difference[6:9]) + _dot(joints.U_near[:, 0], near[9:12])
        row -= _dot(joints.U_far[:, 0], far[9:12])
        row += 2 * (_dot(ddot, ddot - difference[3:6]) - difference[12])
        if self.rows_per_joint == 1:
            return np.asarray(row[None])
        rows = np.where(self.rods, 0.0, difference[6:9] + difference[9:12])
        rows[0] = np.where(self.rods, row, rows[0])
        return rows

    def solve(self, *motion: *Motion) -> Solution:
        """Solve (N5) for every chain.

        Args:
            motion: r, p, ṙ and ṗ.

        Returns:
            r̈, p̈, λ, λ_E and the forces at the joints; its ``joint`` counts the bodies of all chains.

        Raises:
            SingularSystem: S is singular; the message names the body of its chain and the cause (E1, E7).

        """
        r, p, v, pdot = motion
        q, qdot = component_first(r, p), component_first(v, pdot)
        if not np.isfinite(q).all():
            self._raise_singular(q, None)
        found, mu, joints, omega = self._solve_motion(q, qdot, 0.0)
        Rs, As = self._attachment_points(*self._norm_and_rotation(q))
        reaction = self._joint_force(joints, mu)
        turn_near, turn_far = reaction, self._at_child(reaction)  # C_pᵀμ = Wᵀ of these
        if joints.d is not None:
            rods, d = self.rods, joints.d
            turn_near = np.where(rods, 2 * mu[0] * (d - As[0]), turn_near)
            hung = np.append(rods[1:], False)
            turn_far = np.where(hung, 2 * self._at_child(mu[0]) * (self._at_child(d) + As[1]), turn_far)
        spin = _dot(omega, _matrix_vector(self.J, omega)) / _dot(q[3:], q[3:])
        kept = np.ones((self.body_count, self.rows_per_joint), dtype=bool)
        kept[self.rods, 1:] = False
        forest, multiplier = side_by_side(self.chains), -mu.T[kept]
        rows = constraint_rows(forest, *motion)
        return Solution(
            acceleration=found[:3].T,
            pddot=found[3:].T,
            multiplier=multiplier,
            norm_multiplier=spin + _dot(Rs[0] + self.s[0], turn_near) - _dot(Rs[1] + self.s[1], turn_far),
            joint=rows.joint,
            **joint_forces(forest, p, rows, multiplier),
        )

    # -- the manifold -------------------------------------------------------------------------------

    def project(
        self, q: Float[Array, "7 bodies"], v: Float[Array, "7 bodies"]
    ) -> tuple[Float[Array, "7 bodies"], Float[Array, "7 bodies"]]:
        """Project onto C = 0, pᵀp = 1, Ċ = 0, pᵀṗ = 0 by Newton steps in the metric of M and 4 LᵀJL.

        Two steps at position level: the first leaves the square of the gap, which for the drift of one
        integration step is below rounding.

        Args:
            q: (r; p) [m, –].
            v: (ṙ; ṗ) [m/s, 1/s].

        Returns:
            q and v on the constraints.

        Raises:
            SingularSystem: S is singular.

        """
        q, v = q.copy(), v.copy()
        for _ in range(2):
            q[3:] /= np.sqrt(_dot(q[3:], q[3:]))
            q += self._projection_step(q, self.constraints(q, v)[0])
        q[3:] /= np.sqrt(_dot(q[3:], q[3:]))
        v[3:] -= q[3:] * _dot(q[3:], v[3:])
        v += self._projection_step(q, self.constraints(q, v)[1])
        return q, v

    def _projection_step(self, q: Array, h: Array) -> Array:
        """(7, M) −M⁻¹ Cᵀ D⁻¹ h, tangent to pᵀp = const."""
        norm, R = self._norm_and_rotation(q)
        joints = self._factor_joints(q, norm, R)
        _, linear, turned = self._back_substitute(joints, h)
        turn = _HALF_LT @ (q[3:, None] * _matrix_vector(self.K, turned)).reshape(12, -1) / norm
        return np.concatenate([linear, turn])


def component_first(a: Float[Array, "bodies 3"], b: Float[Array, "bodies 4"]) -> Float[Array, "7 bodies"]:
    """Stack body-first arrays into one component-first array.

    Args:
        a: r or ṙ.
        b: p or ṗ.

    """
    return np.ascontiguousarray(np.concatenate([a.T, b.T]))
