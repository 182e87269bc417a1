"""The constraints of N bodies: C, C_r, C_p, γ of every joint, each row a product of two vectors.

A joint touches its near body (in the tree joint k body k) and its far body or the world.  With d from the
far to the near point, f = (x, y, z) the joint's axes fixed in the far body, h = (X, Y, Z) the same in the
near body, and e = (i, j, k) the world's, every row is C = uᵀw with u and w out of these (`KINDS` lists them).
Exact for every p,

    (L1)  (A s)_p = 2 H(p,s),   (A s)˙ = 2 H(p,s) ṗ,   (A s)¨ = 2 H(p,s) p̈ + 2 H(ṗ,s) ṗ               (N8)
    (L2)  C_q = uᵀ w_q + wᵀ u_q
    (L3)  γ   = −( uᵀ w̃ + wᵀ ũ + 2 u̇ᵀẇ ),   ũ = ü at q̈ = 0

A rod's row is C = dᵀd − ℓ² as the notes write it.  With x = r_near − r_far, a = A_far s_far and
b = A_near s_near,

    rod   C = xᵀx + 2 xᵀ(b − a) + bᵀb − 2 aᵀb + aᵀa − ℓ²,  bᵀb and aᵀa replaced by s-products (E2)
          C_r near, far =  2 dᵀ, −2 dᵀ                                                     (S2, D3)
          C_p near, far =  4 (x − a)ᵀH_near, −4 (x + b)ᵀH_far                              (S3, D4)

and γ = −d_t(C_r) ṙ − d_t(C_p) ṗ with Ȧ = 2 G L̇ᵀ, as the notes have it (E3); on the manifold it is the row
dᵀd of (L2, L3).  For one and two bodies on rods these are S1–S4 and D2–D6, which `notes` has as printed.

The row zᵀd of a joint with a pitch h is less h φ, φ = atan2(s, c) with s = yᵀX and c = xᵀX, and their
derivatives from (L2, L3):

    φ_q = (c s_q − s c_q)/(s² + c²),    φ̈₀ = (c s̈₀ − s c̈₀ − 2 φ̇ (s ṡ + c ċ))/(s² + c²)        (at q̈ = 0)

Full turns are those that make the row smallest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from reference_impl.euler_parameters import I3, A, B, G, L, dot, outer
from reference_impl.mechanism import AnyArray, Indices, Int, Mechanism, Shaped

VECTORS = "ijkxyzXYZd"  # what rows are products of


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """The joints' rows in the order of the joints, c in all."""

    joint: Int[Indices, "c"]  # the joint of the row
    near: Int[Indices, "c"]  # the near body of the row
    far: Int[Indices, "c"]  # the far body of the row, −1 the world
    C: Shaped[AnyArray, "c"]  # m² of a rod, m or 1 of the others
    r_near: Shaped[AnyArray, "c 3"]  # ∂C/∂r of the near body; of the far body it is −r_near
    p_near: Shaped[AnyArray, "c 4"]  # ∂C/∂p of the near body
    p_far: Shaped[AnyArray, "c 4"]  # ∂C/∂p of the far body; 0 for the world
    gamma: Shaped[AnyArray, "c"]  # C̈ = C_r r̈ + C_p p̈ − γ
    d: Shaped[AnyArray, "joints 3"]  # m, world frame, from the far to the near point of joint k

    def constraint_rate(
        self, v: Shaped[AnyArray, "bodies 3"], pdot: Shaped[AnyArray, "bodies 4"]
    ) -> Shaped[AnyArray, "c"]:
        """Return Ċ = C_r ṙ + C_p ṗ.

        Args:
            v: velocities ṙ [m/s], world frame.
            pdot: rates ṗ [1/s].

        Returns:
            Ċ: m²/s of a rod, m/s or 1/s of the others.

        """
        k = self.near
        moved = dot(self.r_near, v[k] - of_far_body(v, self.far))
        return np.asarray(moved + dot(self.p_near, pdot[k]) + dot(self.p_far, of_far_body(pdot, self.far)))


def of_far_body(x: Shaped[AnyArray, "bodies ..."], far: Int[Indices, "j"]) -> Shaped[AnyArray, "j ..."]:
    """Return the far bodies' values.

    Args:
        x: values of the bodies.
        far: bodies, −1 the world.

    Returns:
        : zeros for the world.

    """
    values = x[far]
    values[far < 0] = 0
    return values


def joint_of_rows(mechanism: Mechanism) -> Int[Indices, "c"]:
    """Number the rows of C by their joints.

    Args:
        mechanism: bodies and joints; a rod has one row, a ball joint three.

    Returns:
        The joint of each row, ascending.

    """
    return np.repeat(np.arange(len(mechanism.kind)), [len(kind.rows) for kind in mechanism.kinds])


@dataclass(frozen=True, eq=False)
class _RowLayout:
    """What the rows of a mechanism have in common at every state."""

    bodies: Int[Indices, "2 joints"]  # near and far body of each joint; for the world body 0, see `s`
    s: Shaped[AnyArray, "2 joints 3"]  # m, their points; 0 for the world, which takes body 0 out: H(p, 0) = 0
    B: Shaped[AnyArray, "2 joints 4 4"]  # B(s)
    world_point: Shaped[AnyArray, "joints 3"]  # m, the far point where the far body is the world, else 0
    point_squares: Shaped[AnyArray, "joints"]  # m²: sᵀs of both points less ℓ²
    rods: NDArray[np.intp] | slice  # joints that are rods; all of them as a slice, which copies nothing
    rod_rows: NDArray[np.intp]  # their rows
    joint: Int[Indices, "c"]  # the joint of each row
    near: Int[Indices, "c"]  # its near body
    far: Int[Indices, "c"]  # its far body, −1 the world
    pitched: NDArray[np.intp]  # joints with a pitch
    pitch_rows: NDArray[np.intp]  # their rows zᵀd
    pitch: Shaped[AnyArray, "h"]  # m/rad
    product_rows: Int[Indices, "k"]  # the rows that are products of `factors`
    factors: Int[Indices, "2 k"]  # u and w of these rows, places in VECTORS
    turned: Int[Indices, "t"]  # joints that have axes
    axes: Shaped[AnyArray, "2 t 3 3"]  # h and f in the near and far body, rows; 0 for the world
    B_of_axes: Shaped[AnyArray, "2 t 3 4 4"]  # B of the axes
    world_axes: Shaped[AnyArray, "t 3 3"]  # f where the far body is the world, else 0


@lru_cache(maxsize=64)  # mechanisms are never changed, and a run uses the same one ten thousand times
def _row_layout(mechanism: Mechanism) -> _RowLayout:
    far, near = mechanism.body.T
    world = far < 0
    s = np.stack([mechanism.point[:, 1], np.where(world[:, None], 0, mechanism.point[:, 0])])
    joint = joint_of_rows(mechanism)
    pairs = [pair for kind in mechanism.kinds for pair in kind.rows]
    is_rod = np.array([pair == ("d", "d") for pair in pairs], bool)
    rods = joint[is_rod]
    used = [{name for pair in kind.rows for name in pair} for kind in mechanism.kinds]
    turned = np.array([k for k, names in enumerate(used) if names & set("xyzXYZ")], np.intp)
    f, h = np.moveaxis(A(mechanism.turn[turned]).swapaxes(-1, -2), 1, 0)  # rows: the axes
    axes = np.stack([h, np.where(world[turned, None, None], 0, f)])
    factors = [[VECTORS.index(name) for name in pair] for pair in pairs if pair != ("d", "d")]
    has_pitch = np.array([kind.has_pitch for kind in mechanism.kinds], bool)
    is_along = np.array([pair == ("z", "d") for pair in pairs], bool) & has_pitch[joint]
    return _RowLayout(
        bodies=np.stack([near, np.maximum(far, 0)]),
        s=s,
        B=B(s),
        world_point=np.where(world[:, None], mechanism.point[:, 0], 0),
        point_squares=dot(s, s).sum(0) - mechanism.length**2,
        rods=slice(None) if len(rods) == len(mechanism.kind) else rods,
        rod_rows=np.flatnonzero(is_rod),
        joint=joint,
        near=near[joint],
        far=far[joint],
        pitched=joint[is_along],
        pitch_rows=np.flatnonzero(is_along),
        pitch=mechanism.length[joint[is_along]],
        product_rows=np.flatnonzero(~is_rod),
        factors=np.array(factors, np.intp).reshape(-1, 2).T,
        turned=turned,
        axes=axes,
        B_of_axes=B(axes),
        world_axes=np.where(world[turned, None, None], f, 0),
    )


def constraint_rows(
    mechanism: Mechanism,
    r: Shaped[AnyArray, "bodies 3"],
    p: Shaped[AnyArray, "bodies 4"],
    v: Shaped[AnyArray, "bodies 3"],
    pdot: Shaped[AnyArray, "bodies 4"],
) -> ConstraintRows:
    """Evaluate C, C_r, C_p and γ of every joint (S1–S4, D2–D6 for rods; L1–L3 for the others).

    Args:
        r: positions [m], world frame.
        v: velocities ṙ [m/s], world frame.
        pdot: rates ṗ [1/s].

    Returns:
        The rows in the order of the joints, on or off the constraints.

    """
    fixed = _row_layout(mechanism)
    s, (far, near) = fixed.s, mechanism.body.T
    q, qdot = p[fixed.bodies], pdot[fixed.bodies]  # (2, J, 4): near and far body of each joint
    x = r[near] - of_far_body(r, far) - fixed.world_point  # from the far body (the far point) to the near one
    xdot = v[near] - of_far_body(v, far)
    both = np.stack([q, qdot])
    turn = G(both)
    (H_near, H_far), (H_near_rate, H_far_rate) = turn @ fixed.B + outer(s, both)  # H, Ḣ (D4)
    b, a = _matrix_vector(A(q), s)
    d = x + b - a

    c = len(fixed.joint)
    C, gamma, r_near, p_near, p_far = (
        np.zeros(shape, d.dtype) for shape in ((c,), (c,), (c, 3), (c, 4), (c, 4))
    )
    if len(fixed.rod_rows):
        k, row = fixed.rods, fixed.rod_rows
        bdot, adot = 2 * _matrix_vector(
            turn[0][:, k], _vector_matrix(s[:, k], L(qdot[:, k]))
        )  # Ȧ s, Ȧ = 2 G L̇ᵀ (N10)
        y, ydot, z, zdot = x[k] - a[k], xdot[k] - adot, x[k] + b[k], xdot[k] + bdot
        C[row] = dot(x[k], x[k]) + 2 * dot(x[k], b[k] - a[k]) - 2 * dot(a[k], b[k]) + fixed.point_squares[k]
        near_rate = _vector_matrix(ydot, H_near[k]) + _vector_matrix(y, H_near_rate[k])
        far_rate = _vector_matrix(zdot, H_far[k]) + _vector_matrix(z, H_far_rate[k])
        gamma[row] = (
            -2 * dot(zdot - adot, xdot[k]) - 4 * dot(near_rate, qdot[0, k]) + 4 * dot(far_rate, qdot[1, k])
        )
        r_near[row] = 2 * d[k]
        p_near[row], p_far[row] = 4 * _vector_matrix(y, H_near[k]), -4 * _vector_matrix(z, H_far[k])
    if len(fixed.product_rows):
        row = fixed.product_rows
        H_d = np.stack([[H_near, H_far], [H_near_rate, H_far_rate]])
        vectors = _factor_vectors(fixed, d, xdot, both, H_d)
        places = fixed.joint[row], fixed.factors
        C[row], gamma[row], r_near[row], p_near[row], p_far[row] = _product_rows(places, vectors)
    if len(fixed.pitch_rows):
        row, h = fixed.pitch_rows, fixed.pitch
        angle, *parts = _turns_about_z(fixed.pitched, vectors, C[row], h)
        C[row] -= h * angle
        for found, part in zip((gamma, p_near, p_far), parts, strict=True):
            found[row] -= (h * part.T).T
    return ConstraintRows(fixed.joint, fixed.near, fixed.far, C, r_near, p_near, p_far, gamma, d)


def _factor_vectors(
    fixed: _RowLayout, d: AnyArray, xdot: AnyArray, both: AnyArray, H_d: AnyArray
) -> tuple[AnyArray, ...]:
    """The vectors of VECTORS of every joint (J, 10, 3), ∂/∂p of the near and far body, rates and ũ (L1)."""
    n, q, qdot = len(d), both[0], both[1]
    value, rate, bias = (np.zeros((n, len(VECTORS), 3), d.dtype) for _ in range(3))
    of_p = np.zeros((2, n, len(VECTORS), 3, 4), d.dtype)  # near, far
    value[:, :3] = I3
    H, H_rate = H_d
    swing, bend = (2 * _matrix_vector(h, qdot) for h in (H, H_rate))  # (2, J, 3): near, far
    value[:, 9], rate[:, 9], bias[:, 9] = d, xdot + swing[0] - swing[1], bend[0] - bend[1]
    of_p[0, :, 9], of_p[1, :, 9] = 2 * H[0], -2 * H[1]
    k = fixed.turned
    if len(k):
        t = fixed.axes
        qk, qdotk = q[:, k, None], qdot[:, k, None]  # (2, t, 1, 4)
        axis_H, axis_H_rate = (G(x) @ fixed.B_of_axes + outer(t, x) for x in (qk, qdotk))
        turned = _matrix_vector(A(qk), t)
        for side, at in ((0, slice(6, 9)), (1, slice(3, 6))):
            value[k, at] = turned[side] + (fixed.world_axes if side else 0)
            of_p[side, k, at] = 2 * axis_H[side]
            rate[k, at] = 2 * _matrix_vector(axis_H[side], qdotk[side])
            bias[k, at] = 2 * _matrix_vector(axis_H_rate[side], qdotk[side])
    return value, of_p, rate, bias


def _turns_about_z(
    joint: NDArray[np.intp], vectors: tuple[AnyArray, ...], shift: AnyArray, pitch: AnyArray
) -> tuple[AnyArray, ...]:
    """φ, −φ̈₀, φ_p near and φ_p far of joints, with full turns that are nearest to their shifts."""
    s, c = (
        _product_rows((joint, np.array([[VECTORS.index(x)] for x in pair])), vectors) for pair in ("yX", "xX")
    )
    square = s[0] ** 2 + c[0] ** 2
    value, _, rates, _ = vectors
    iy, ix, iX = (VECTORS.index(x) for x in "yxX")
    s_rate, c_rate = (
        dot(rates[joint, i], value[joint, iX]) + dot(value[joint, i], rates[joint, iX]) for i in (iy, ix)
    )
    rate = (c[0] * s_rate - s[0] * c_rate) / square
    bend = (c[0] * s[1] - s[0] * c[1] + 2 * rate * (s[0] * s_rate + c[0] * c_rate)) / square
    near, far = (((c[0] * s[i].T - s[0] * c[i].T) / square).T for i in (3, 4))
    angle, full = np.arctan2(s[0].real, c[0].real), 2 * np.pi
    turns = np.divide(shift.real, pitch, out=angle.copy(), where=pitch != 0) - angle
    angle = angle + full * np.round(turns / full)
    if np.iscomplexobj(shift):  # a step along i
        angle = angle + 1j * (c[0].real * s[0].imag - s[0].real * c[0].imag) / square.real
    return angle, bend, near, far


def _product_rows(
    places: tuple[NDArray[np.intp], NDArray[np.intp]], vectors: tuple[AnyArray, ...]
) -> tuple[AnyArray, ...]:
    """C, γ, C_r near, C_p near and C_p far of products, by their joints and factors (L2, L3)."""
    value, of_p, rate, bias = vectors
    k, (iu, iw) = places
    u, w = value[k, iu], value[k, iw]
    p_near, p_far = (_vector_matrix(u, x[k, iw]) + _vector_matrix(w, x[k, iu]) for x in of_p)
    gamma = -(dot(u, bias[k, iw]) + dot(w, bias[k, iu]) + 2 * dot(rate[k, iu], rate[k, iw]))
    return dot(u, w), gamma, u * (iw == 9)[:, None], p_near, p_far


def _matrix_vector(matrix: AnyArray, vector: AnyArray) -> AnyArray:
    """Matrix times vector, batched."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _vector_matrix(vector: AnyArray, matrix: AnyArray) -> AnyArray:
    """Row vector times matrix, batched."""
    return np.asarray((vector[..., None, :] @ matrix)[..., 0, :])
