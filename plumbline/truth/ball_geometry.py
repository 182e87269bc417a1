"""Vectors, rotations and inertias of a mechanism in ball arithmetic (python-flint)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from plumbline.equations.tree import Solution, Tree
from plumbline.model.datatypes import Array, Model, State
from plumbline.truth.element_terms import joint_elements, spring_terms


class BallVectors:
    """Vectors and rotations in balls; vectors are 3×1 ``arb_mat``."""

    def __init__(self, flint: Any) -> None:
        self.flint, self.mat, self.arb = flint, flint.arb_mat, flint.arb
        self.zero = self.vector((0.0, 0.0, 0.0))
        self.eye = self.matrix(np.eye(3))
        self.units = [self.vector(e) for e in np.eye(3)]

    def vector(self, v: Iterable[float]) -> Any:
        """A vector of doubles.

        Args:
            v: three doubles.

        Returns:
            A 3×1 matrix.

        """
        return self.mat(3, 1, [self.arb(float(x)) for x in v])

    def matrix(self, m: Array) -> Any:
        """A 3×3 matrix of doubles.

        Args:
            m: (3, 3) doubles.

        Returns:
            A 3×3 matrix.

        """
        return self.mat(3, 3, [self.arb(float(x)) for x in np.ravel(m)])

    def cross_matrix(self, a: Any) -> Any:
        """ã: ã b = a × b.

        Returns:
            A 3×3 matrix.

        """
        x, y, z = a[0, 0], a[1, 0], a[2, 0]
        return self.mat(3, 3, [0, -z, y, z, 0, -x, -y, x, 0])

    @staticmethod
    def dot(a: Any, b: Any) -> Any:
        """aᵀb."""
        return a[0, 0] * b[0, 0] + a[1, 0] * b[1, 0] + a[2, 0] * b[2, 0]

    def rotation(self, p: Array) -> Any:
        """A (N7) of the normalised quaternion: the homogeneous quadratic form over pᵀp.

        Args:
            p: (4,) a quaternion of doubles, scalar first, of any length but 0.

        Returns:
            A 3×3 matrix, body → world.

        """
        return self.rotation_of([self.arb(float(c)) for c in p])

    def rotation_of(self, q: list[Any]) -> Any:
        """A of a quaternion of balls, as `rotation`.

        Args:
            q: four balls, scalar first.

        Returns:
            A 3×3 matrix, body → world.

        """
        w, x, y, z = q
        ww, xx, yy, zz = w * w, x * x, y * y, z * z
        entries_ = [
            [ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz],
        ]
        return self.mat(entries_) * (1 / (ww + xx + yy + zz))


def entries(v: Any) -> list[Any]:
    """List the balls of a matrix of one column.

    Args:
        v: an ``arb_mat`` (m, 1).

    """
    return list(v.entries())


def flatten(ball: list[Any]) -> list[Any]:
    """List all balls of a list or of a list of lists.

    Args:
        ball: balls, or lists of them.

    """
    return [x for row in ball for x in row] if isinstance(ball[0], list) else ball


def midpoints(ball: list[Any]) -> Array:
    """Return midpoints rounded to double.

    Args:
        ball: balls, or lists of them.

    Returns:
        An array of the list's shape.

    """
    return np.array(
        [[float(x.mid()) for x in row] if isinstance(row, list) else float(row.mid()) for row in ball]
    )


def term_scales(
    model: Model,
    balls: dict[str, Any],
    lever: float,
    rate: float,
    element_sizes: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> dict[str, float]:
    """Estimate the sizes of the terms of each quantity.

    Radii are compared with them, because a quantity itself may be zero.

    Args:
        balls: entries of each quantity, by name.
        lever: largest distance of a body from the world's origin [m].
        rate: largest rate of rotation [rad/s].
        element_sizes: forces [N], moments [N m] and potential energy [J] of springs and their like, before
            they cancel.

    Returns:
        By quantity the size, in its unit.

    """
    size = {name: float(np.max(np.abs(midpoints(ball)), initial=0.0)) for name, ball in balls.items()}
    g = float(np.linalg.norm(model.gravity))
    mass, inertia = float(np.sum(model.mass)), float(np.sum(np.linalg.norm(model.inertia, axis=(1, 2))))
    push = float(np.sum(np.linalg.norm(model.force, axis=1))) + element_sizes[0]
    torque = float(np.sum(np.linalg.norm(model.moment, axis=1))) + element_sizes[1]
    a = max(size["acceleration"], g, rate**2 * lever, push / mass)
    a = max(a, torque / (mass * lever) if lever else 0.0)
    force = max(size["joint_reaction"], mass * a)
    scales = {
        "acceleration": a,
        "angular_acceleration": max(
            size["angular_acceleration"], rate**2, a / lever if lever else torque / inertia
        ),
        "joint_reaction": force,
        "joint_moment": max(size.get("joint_moment", 0.0), force * lever),
        "kinetic_energy": size["kinetic_energy"],
        "potential_energy": max(size["potential_energy"], mass * g * lever + element_sizes[2]),
        "angular_momentum": max(size["angular_momentum"], (mass * lever**2 + inertia) * rate),
        "r": max(size["r"], lever),
        "v": max(size["v"], lever * rate),
        "mass_matrix": size.get("mass_matrix", 0.0),
        "attitude": 1.0,
        "angular_velocity": max(size["angular_velocity"], rate),
    }
    return {name: scale for name, scale in scales.items() if name in balls}


def tree_quantities(tree: Tree, solution: Solution) -> dict[str, Any]:
    """List the balls of a solved tree.

    Args:
        tree: in balls.

    Returns:
        By quantity, as `plumbline.truth.certified_state.enclose_quantities`, without mass matrix and scales.

    """
    vectors = tree.quantities(solution)
    found: dict[str, Any] = {name: [vectors.pop(name)] for name in ("kinetic_energy", "potential_energy")}
    found["angular_momentum"] = entries(vectors.pop("angular_momentum"))
    vectors |= {"r": tree.r, "v": tree.v, "attitude": tree.A, "angular_velocity": tree.in_bodies(tree.w)}
    return found | {name: [entries(x) for x in each] for name, each in vectors.items()}


def quantity_scales(c: Any, balls: dict[str, Any]) -> dict[str, float]:
    """Estimate the sizes of the terms of each quantity, see `term_scales`.

    Args:
        c: the tree.

    Returns:
        Sizes by quantity.

    """
    norm, model = np.linalg.norm, c.model
    lever = float(np.sum(norm(model.point, axis=2)) + np.sum(model.length) + np.sum(np.abs(c.state.x)))
    lever = max(lever, float(np.max(np.abs(midpoints(balls["r"])))))
    rate = float(np.max(norm(midpoints([entries(w) for w in c.w]), axis=1)))
    rate = max(rate, float(np.max(np.abs(c.state.xdot))), float(np.max(np.abs(c.state.udot))))
    sizes = (0.0, 0.0, 0.0)
    if model.has_elements:
        state = State(**{name: value[None] for name, value in vars(c.state).items()})
        elements, springs = joint_elements(model, state, np.zeros((1, model.n))), spring_terms(model, state)
        push, turn = (
            float(sum(np.sum(e.size) for e in elements if e.is_slide == is_slide))
            for is_slide in (True, False)
        )
        potential = float(sum((np.sum(e.potential) for e in elements), np.sum(springs.potential)))
        sizes = push + float(np.sum(springs.size)), turn + float(np.sum(springs.moment_size)), potential
    return term_scales(model, balls, lever, rate, sizes)
