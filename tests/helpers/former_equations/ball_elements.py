"""Rotors, springs, dampers and efforts of a tree in balls, by Lagrange's equations in its coordinates.

With the relative rates ν of `tree`, T gains ½ a ν², so M gains a on its diagonal,
and h loses e − k (x − x₀) − c ν.  The rates of a ball joint are Ω = ω − ω_far along the world's axes; its
rotors have the momentum a Ω as the far body sees it, so that h gains a (Ω̇ − ω_far × Ω) at ν̇ = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from plumbline.equations.balls import entries


@dataclass(frozen=True, eq=False)
class BallElements:
    """The elements' terms, joint by joint and body by body."""

    armature: list[list[Any]]  # of the rates of each joint: on the diagonal of M
    effort: list[list[Any]]  # of the same: −h of springs, dampers, efforts and of ball joints' rotors
    wrench: list[Any]  # on each body from springs between points, about the world's origin, moment first
    kinetic: Any
    potential: Any


def ball_elements(c: Any) -> BallElements:
    """Evaluate all elements of a tree.

    Args:
        c: the tree in balls, with its model and state.

    Returns:
        Their terms.

    """
    model, zero = c.model, c.arb(0)
    armature = [[zero] * S.ncols() for S in c.S]
    effort = [[zero] * S.ncols() for S in c.S]
    kinetic = potential = zero
    for k, kind in enumerate(model.kind):
        a, d, stiffness = (
            [c.arb(float(x)) for x in y[k]] for y in (model.armature, model.damping, model.stiffness)
        )
        if kind == "ball":
            ratio, spin = _rotation_vector(c, k), c.w[k]
            bend = c.twist[k]
            if c.far[k] >= 0:
                spin = spin - c.w[c.far[k]]
                bend = bend - c.twist[c.far[k]] - c.cross_matrix(c.w[c.far[k]]) * spin
            armature[k] = [a[0]] * 3
            effort[k] = entries(ratio * -stiffness[0] - spin * d[0] - bend * a[0])
            kinetic += a[0] * c.dot(spin, spin) / 2
            potential += stiffness[0] * c.dot(ratio, ratio) / 2
            continue
        if kind in ("rod", "free"):
            continue
        for i in range(c.S[k].ncols()):
            (x, rate), rest, push = (
                c.coordinate(k, i),
                c.arb(float(model.rest[k, i])),
                c.arb(float(model.effort[k, i])),
            )
            armature[k][i] = a[i]
            effort[k][i] = push - stiffness[i] * (x - rest) - d[i] * rate
            kinetic += a[i] * rate * rate / 2
            stretch = x - rest  # a ball that contains 0 has no square by `**` in python-flint
            potential += stiffness[i] * stretch * stretch / 2
    wrench = [c.mat(6, 1, [0] * 6) for _ in range(c.n)]
    for number in range(len(model.spring_body)):
        potential += _add_spring(c, number, wrench)
    return BallElements(armature, effort, wrench, kinetic, potential)


def _rotation_vector(c: Any, k: int) -> Any:
    """θ u, world axes, of the turn from the far to the near body's axes of ball joint k."""
    far = c.rotation(c.model.turn[k, 0])
    if c.far[k] >= 0:
        far = c.A[c.far[k]] * far
    R = far.transpose() * c.A[k] * c.rotation(c.model.turn[k, 1])
    sine = c.mat(3, 1, [(R[2, 1] - R[1, 2]) / 2, (R[0, 2] - R[2, 0]) / 2, (R[1, 0] - R[0, 1]) / 2])
    size = c.dot(sine, sine).nonnegative_part().sqrt()
    theta = c.arb.atan2(size, (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2)
    return far * sine * (1 / theta.sinc())


def _add_spring(c: Any, number: int, wrench: list[Any]) -> Any:
    """Add what a spring does to both bodies; returns its potential energy."""
    model = c.model
    ends, rates = [], []
    for body, point in zip(model.spring_body[number], model.spring_point[number], strict=True):
        at, rate = c.vector(point), c.zero
        if body >= 0:
            arm = c.A[body] * at
            at, rate = c.r[body] + arm, c.v[body] + c.cross_matrix(c.w[body]) * arm
        ends.append(at)
        rates.append(rate)
    d, d_rate = ends[1] - ends[0], rates[1] - rates[0]
    length = c.dot(d, d).sqrt()
    stiffness, damping, rest = (
        c.arb(float(x[number])) for x in (model.spring_stiffness, model.spring_damping, model.spring_length)
    )
    tension = stiffness * (length - rest) + damping * c.dot(d, d_rate) / length
    pull = d * (tension / length)
    for body, at, force in zip(model.spring_body[number], ends, (pull, -pull), strict=True):
        if body >= 0:
            wrench[body] = wrench[body] + c.mat(6, 1, [*entries(c.cross_matrix(at) * force), *entries(force)])
    stretch = length - rest  # a ball that contains 0 has no square by `**` in python-flint
    return stiffness * stretch * stretch / 2
