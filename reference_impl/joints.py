"""The constraints of N bodies: C, C_r, C_p, γ of every joint, each row a product of two vectors.

A joint touches its near body (in the tree joint k body k) and its far body or the world.  With d from the
far to the near point, f = (x, y, z) the joint's axes fixed in the far body, h = (X, Y, Z) the same in the
near body, and e = (i, j, k) the world's, every row is C = uᵀw with u and w out of these (`KINDS` lists them).
Exact for every p,

    (L1)  (A s)_p = 2 H(p,s),   (A s)˙ = 2 H(p,s) ṗ,   (A s)¨ = 2 H(p,s) p̈ + 2 H(ṗ,s) ṗ               (N8)
          A s = H(p,s) p − s,   H(p,s) = Σ pᵢ H(eᵢ,s) with the unit vectors eᵢ: all of it from one product
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

from reference_impl.arrays import AnyArray, Indices, Int, Motion, Shaped
from reference_impl.euler_parameters import I3, A, G, H, L, dot
from reference_impl.mechanism import Mechanism

VECTORS = "XYZxyzijkd"  # what rows are products of: axes of the near and the far body and of the world, and d
Z_FAR, IS_D = 5, 9  # places of the last axis of a body, and of d
PITCH_AXES = "yxX"  # in which the angle of a joint with a pitch is found


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
    # vectors fixed in bodies, first the points `s`, then the axes that rows are made of: their bodies; the
    # vectors in these, 0 for the world; and their H(eᵢ, ·), see (L1)
    vector_body: Int[Indices, "vectors"]
    vectors: Shaped[AnyArray, "vectors 3"]
    H_of_units: Shaped[AnyArray, "vectors 4 12"]
    world_point: Shaped[AnyArray, "joints 3"]  # m, the far point where the far body is the world, else 0
    point_squares: Shaped[AnyArray, "joints"]  # m²: sᵀs of both points less ℓ²
    rods: NDArray[np.intp] | slice  # joints that are rods; all of them as a slice, which copies nothing
    rod_rows: NDArray[np.intp]  # their rows
    joint: Int[Indices, "c"]  # the joint of each row
    near: Int[Indices, "c"]  # its near body
    far: Int[Indices, "c"]  # its far body, −1 the world
    # rows that are a component of d: their numbers, and joint and component of each
    point_rows: NDArray[np.intp]
    point_at: tuple[NDArray[np.intp], NDArray[np.intp]]
    world_axes: Shaped[AnyArray, "a 3"]  # axes where the far body is the world, else 0
    # rows that are products of two axes, or of an axis and d: their numbers, joints and places in the axes
    axis_rows: NDArray[np.intp]
    axis_pairs: Int[Indices, "2 k"]
    slide_rows: NDArray[np.intp]
    slide_joint: NDArray[np.intp]
    slide_axis: NDArray[np.intp]
    pitch_rows: NDArray[np.intp]  # of joints with a pitch their rows zᵀd
    pitch_axes: Int[Indices, "3 h"]  # places of their axes y, x and X
    pitch: Shaped[AnyArray, "h"]  # m/rad


@lru_cache(maxsize=64)  # mechanisms are never changed, and a run uses the same one ten thousand times
def _row_layout(mechanism: Mechanism) -> _RowLayout:
    far, near = mechanism.body.T
    world = far < 0
    s = np.stack([mechanism.point[:, 1], np.where(world[:, None], 0, mechanism.point[:, 0])])
    joint = joint_of_rows(mechanism)
    codes = [(VECTORS.index(u), VECTORS.index(w)) for kind in mechanism.kinds for u, w in kind.rows]
    u, w = np.array(codes, np.intp).reshape(-1, 2).T
    rod_rows, points, slides, turns = (
        np.flatnonzero(where)
        for where in (u == IS_D, (u > Z_FAR) & (u < IS_D), (u <= Z_FAR) & (w == IS_D), w <= Z_FAR)
    )
    has_pitch = np.array([kind.has_pitch for kind in mechanism.kinds], bool)
    helical = slides[(u[slides] == Z_FAR) & has_pitch[joint[slides]]]
    # each row's axes, and those in which a pitch's angle is found, by joint and place in VECTORS
    used = [(slides, u[slides]), (turns, u[turns]), (turns, w[turns])]
    used += [(helical, np.full(len(helical), VECTORS.index(name))) for name in PITCH_AXES]
    keys, place = np.unique(
        np.concatenate([(Z_FAR + 1) * joint[rows] + code for rows, code in used]), return_inverse=True
    )
    slide_axis, of_turns, of_pitch = np.split(place, np.cumsum([len(slides), 2 * len(turns)]))
    k, code = np.divmod(keys, Z_FAR + 1)
    side, number = np.divmod(code, 3)
    turned = A(mechanism.turn[k, 1 - side])[np.arange(len(k)), :, number]
    is_world = ((side == 1) & world[k])[:, None]
    vectors, rods = np.concatenate([*s, np.where(is_world, 0, turned)]), joint[rod_rows]
    bodies = np.stack([near, np.maximum(far, 0)])
    return _RowLayout(
        bodies=bodies,
        s=s,
        vector_body=np.concatenate([*bodies, bodies[side, k]]),
        vectors=vectors,
        H_of_units=H(np.eye(4, dtype=int), vectors[:, None]).reshape(-1, 4, 12),
        world_point=np.where(world[:, None], mechanism.point[:, 0], 0),
        point_squares=dot(s, s).sum(0) - mechanism.length**2,
        rods=slice(None) if len(rods) == len(mechanism.kind) else rods,
        rod_rows=rod_rows,
        joint=joint,
        near=near[joint],
        far=far[joint],
        point_rows=points,
        point_at=(joint[points], u[points] - Z_FAR - 1),
        world_axes=np.where(is_world, turned, 0),
        axis_rows=turns,
        axis_pairs=of_turns.reshape(2, -1),
        slide_rows=slides,
        slide_joint=joint[slides],
        slide_axis=slide_axis,
        pitch_rows=helical,
        pitch_axes=of_pitch.reshape(3, -1),
        pitch=mechanism.length[joint[helical]],
    )


def constraint_rows(mechanism: Mechanism, *motion: *Motion) -> ConstraintRows:
    """Evaluate C, C_r, C_p and γ of every joint (S1–S4, D2–D6 for rods; L1–L3 for the others).

    Args:
        motion: r, p, ṙ and ṗ.

    Returns:
        The rows in the order of the joints, on or off the constraints.

    """
    r, p, v, pdot = motion
    fixed = _row_layout(mechanism)
    s, (far, near) = fixed.s, mechanism.body.T
    x = r[near] - of_far_body(r, far) - fixed.world_point  # from the far body (the far point) to the near one
    xdot = v[near] - of_far_body(v, far)
    points, axes = _turning_vectors(fixed, p, pdot)
    ((H_near, H_far), (H_near_rate, H_far_rate)), (b, a), swing, bend = points  # H, Ḣ (D4), (L1)
    d = x + b - a

    c = len(fixed.joint)
    C, gamma, r_near, p_near, p_far = (
        np.zeros(shape, d.dtype) for shape in ((c,), (c,), (c, 3), (c, 4), (c, 4))
    )
    if len(fixed.rod_rows):
        k, row = fixed.rods, fixed.rod_rows
        q, qdot = p[fixed.bodies[:, k]], pdot[fixed.bodies[:, k]]  # near and far
        # Ȧ s, Ȧ = 2 G L̇ᵀ (N10)
        bdot, adot = 2 * _matrix_vector(G(q), _vector_matrix(s[:, k], L(qdot)))
        y, ydot, z, zdot = x[k] - a[k], xdot[k] - adot, x[k] + b[k], xdot[k] + bdot
        C[row] = dot(x[k], x[k]) + 2 * dot(x[k], b[k] - a[k]) - 2 * dot(a[k], b[k]) + fixed.point_squares[k]
        near_rate = _vector_matrix(ydot, H_near[k]) + _vector_matrix(y, H_near_rate[k])
        far_rate = _vector_matrix(zdot, H_far[k]) + _vector_matrix(z, H_far_rate[k])
        gamma[row] = -2 * dot(zdot - adot, xdot[k]) - 4 * dot(near_rate, qdot[0]) + 4 * dot(far_rate, qdot[1])
        r_near[row] = 2 * d[k]
        p_near[row], p_far[row] = 4 * _vector_matrix(y, H_near[k]), -4 * _vector_matrix(z, H_far[k])
    d_bias = bend[0] - bend[1]
    if len(fixed.point_rows):
        row, at = fixed.point_rows, fixed.point_at
        C[row], gamma[row], r_near[row] = d[at], -d_bias[at], I3[at[1]]
        p_near[row], p_far[row] = 2 * H_near[at], -2 * H_far[at]
    if len(fixed.axis_rows):
        row = fixed.axis_rows
        C[row], gamma[row], p_near[row], p_far[row] = _axis_products(axes, *fixed.axis_pairs)
    if len(fixed.slide_rows):
        row, k, i = fixed.slide_rows, fixed.slide_joint, fixed.slide_axis
        u, of_p, rate, bias = (x[i] for x in axes)
        d_rate = (xdot + swing[0] - swing[1])[k]
        C[row], r_near[row] = dot(u, d[k]), u
        gamma[row] = -(dot(u, d_bias[k]) + dot(d[k], bias) + 2 * dot(rate, d_rate))
        p_near[row] = _vector_matrix(u, 2 * H_near[k])
        p_far[row] = _vector_matrix(u, -2 * H_far[k]) + _vector_matrix(d[k], of_p)
    if len(fixed.pitch_rows):
        row, h = fixed.pitch_rows, fixed.pitch
        angle, *parts = _turns_about_z(fixed.pitch_axes, axes, C[row], h)
        C[row] -= h * angle
        for found, part in zip((gamma, p_near, p_far), parts, strict=True):
            found[row] -= (h * part.T).T
    return ConstraintRows(fixed.joint, fixed.near, fixed.far, C, r_near, p_near, p_far, gamma, d)


def _turning_vectors(
    fixed: _RowLayout, p: AnyArray, pdot: AnyArray
) -> tuple[tuple[AnyArray, ...], tuple[AnyArray, ...]]:
    """The vectors that rows are made of (L1), and what follows of them.

    Returns:
        H(p, s) and H(ṗ, s) of the points, A s, their rates and (A s)¨ at p̈ = 0, shaped as `_RowLayout.s`;
        and of the axes their values (a, 3), ∂/∂p of their bodies, rates and ũ.

    """
    p, pdot = both = np.array([p, pdot])[:, fixed.vector_body]
    H = (both[..., None, :] @ fixed.H_of_units).reshape(*both.shape[:-1], 3, 4)  # H(p, ·), H(ṗ, ·)
    value = _matrix_vector(H[0], p) - fixed.vectors
    rate, bias = 2 * _matrix_vector(H, pdot)
    shape, count = fixed.s.shape, fixed.bodies.size
    of_points = (y[:count].reshape(shape) for y in (value, rate, bias))
    points = H[:, :count].reshape(2, *shape, 4), *of_points
    axes = value[count:] + fixed.world_axes, 2 * H[0, count:], rate[count:], bias[count:]
    return points, axes


def _turns_about_z(
    places: NDArray[np.intp], axes: tuple[AnyArray, ...], shift: AnyArray, pitch: AnyArray
) -> tuple[AnyArray, ...]:
    """φ, −φ̈₀, φ_p near and φ_p far of joints, with full turns that are nearest to their shifts."""
    y, x, X = places
    s, c = (_axis_products(axes, i, X) for i in (y, x))
    square = s[0] ** 2 + c[0] ** 2
    value, _, rates, _ = axes
    s_rate, c_rate = (dot(rates[i], value[X]) + dot(value[i], rates[X]) for i in (y, x))
    rate = (c[0] * s_rate - s[0] * c_rate) / square
    bend = (c[0] * s[1] - s[0] * c[1] + 2 * rate * (s[0] * s_rate + c[0] * c_rate)) / square
    near, far = (((c[0] * s[i].T - s[0] * c[i].T) / square).T for i in (2, 3))
    angle, full = np.arctan2(s[0].real, c[0].real), 2 * np.pi
    turns = np.divide(shift.real, pitch, out=angle.copy(), where=pitch != 0) - angle
    angle = angle + full * np.round(turns / full)
    if np.iscomplexobj(shift):  # a step along i
        angle = angle + 1j * (c[0].real * s[0].imag - s[0].real * c[0].imag) / square.real
    return angle, bend, near, far


def _axis_products(
    axes: tuple[AnyArray, ...], far: NDArray[np.intp], near: NDArray[np.intp]
) -> tuple[AnyArray, ...]:
    """C, γ, C_p near and C_p far of products of a far and a near axis (L2, L3)."""
    value, of_p, rate, bias = axes
    u, w = value[far], value[near]
    gamma = -(dot(u, bias[near]) + dot(w, bias[far]) + 2 * dot(rate[far], rate[near]))
    return dot(u, w), gamma, _vector_matrix(u, of_p[near]), _vector_matrix(w, of_p[far])


def _matrix_vector(matrix: AnyArray, vector: AnyArray) -> AnyArray:
    """Matrix times vector, batched."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _vector_matrix(vector: AnyArray, matrix: AnyArray) -> AnyArray:
    """Row vector times matrix, batched."""
    return np.asarray((vector[..., None, :] @ matrix)[..., 0, :])
