"""Relative equilibria by root finding: chains that turn steadily about the vertical as one rigid whole.

The numbers of `scenarios/single/conical.yaml` and `scenarios/double/double-conical.yaml` come from
here (a test recomputes them).  The residual is evaluated in extended precision where the platform
has it, so that the root is right to the last digits of a double.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from plumbline.model.datatypes import Array, Model


def relative_equilibrium(model: Model, rate: float, p: Array, u: Array) -> tuple[Array, Array, Array]:
    """The steady rotation at ``rate`` (rad/s) about the world's z near the guess p (N, 4), u (N, 3).

    Returns p (N, 4), omega (N, 3) rad/s body frame, u (N, 3): with these every body obeys
    ω = rate ẑ and every rod u̇ = rate ẑ × u for all time.  Turning about z is free, and so is a
    symmetric body's angle about its own axis: the root nearest to the guess is taken.
    Raises ValueError where Newton's method does not come down to rounding.
    """
    p, u = np.array(p, dtype=np.longdouble), np.array(u, dtype=np.longdouble)
    best, last = np.inf, (p, u)
    for _ in range(60):
        residual = _residual(model, rate, p, u)
        size = float(np.max(np.abs(residual)))
        if not np.isfinite(size):
            raise ValueError("no relative equilibrium found near the guess: the residual is not finite")
        if size >= best / 2 and best < 1e-12:
            break
        best, last = size, (p, u)
        columns = [
            _residual(model, rate, *_apply_step(p, u, +1e-6 * e))
            - _residual(model, rate, *_apply_step(p, u, -1e-6 * e))
            for e in np.eye(6 * model.n)
        ]
        jacobian = np.array(columns, dtype=float).T / 2e-6
        step = np.linalg.lstsq(jacobian, -residual.astype(float), rcond=1e-7)[0]
        p, u = _apply_step(p, u, step * min(1.0, 0.3 / max(float(np.max(np.abs(step))), 1e-300)))
    else:
        raise ValueError(f"no relative equilibrium found near the guess: residual {best:.3g}")
    p, u = last
    omega = _rotate_vectors(p * np.array([1, -1, -1, -1]), np.array([0, 0, rate], dtype=np.longdouble))
    return p.astype(float), omega.astype(float), np.where(model.rods[:, None], u, 0).astype(float)


def _rotate_vectors(p: Any, s: Any) -> Any:
    """A(p) s (N, 3) of unit quaternions, in the precision of its arguments."""
    e = p[..., 1:]
    t = 2 * np.cross(e, s)
    return s + p[..., :1] * t + np.cross(e, t)


def _apply_step(p: Any, u: Any, step: Any) -> tuple[Any, Any]:
    """(p, u) after a small step (6 N): turns of the bodies, shifts of the rods' directions."""
    turn, shift = step.reshape(2, -1, 3)
    w, e = p[:, :1], p[:, 1:]
    new = np.concatenate(
        [w - np.sum(turn * e, 1, keepdims=True) / 2, e + (w * turn + np.cross(turn, e)) / 2], 1
    )
    return new / np.sqrt(np.sum(new * new, 1, keepdims=True)), u + shift


def _residual(model: Model, rate: float, p: Any, u: Any) -> Any:
    """(6 N,) moments about the centres of mass that steady rotation leaves unbalanced, and rods askew."""
    near, far = (
        _rotate_vectors(p, model.proximal.astype(p.dtype)),
        _rotate_vectors(p, model.distal.astype(p.dtype)),
    )
    lever = model.length[:, None] * u - near  # from where joint k hangs to the centre of mass
    hang = np.concatenate([np.zeros_like(u[:1]), np.cumsum(lever + far, 0)[:-1]])
    r = hang + lever
    spin = np.array([0, 0, rate], dtype=p.dtype)
    a = np.cross(spin, np.cross(spin, r))
    force_needed = model.mass[:, None] * (a - model.gravity)
    force = np.cumsum(force_needed[::-1], 0)[::-1]  # on body k at its proximal point
    below = np.concatenate([force[1:], np.zeros_like(u[:1])])
    omega = _rotate_vectors(p * np.array([1, -1, -1, -1]), spin)
    gyro = _rotate_vectors(p, np.cross(omega, np.einsum("kij,kj->ki", model.inertia.astype(p.dtype), omega)))
    moment = np.cross(near, force) - np.cross(far, below) - gyro
    size = np.sqrt(np.sum(force * force, 1, keepdims=True))
    askew = np.where(model.rods[:, None], u + force / size, u)  # a massless rod points along its force
    return np.concatenate([moment.ravel(), askew.ravel()])
