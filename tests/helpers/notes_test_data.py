"""What the tests of the notes share: states on and off the manifold, and exact symbols.

The functions of `reference_impl` are algebra of +, − and ×, so the tests run those very functions on
polynomials over the rationals: an identity that holds there holds for all values.
"""

import numpy as np

from plumbline.model.kinematics import maximal_coordinates
from reference_impl.fast.chain_elimination import component_first
from tests.helpers.random_chains import random_model, random_state


def state_on_manifold(chain, rng):
    """r, p, ṙ, ṗ that satisfy every constraint and its rate to rounding."""
    state = random_state(rng, chain, rate=1.0)
    return maximal_coordinates(state)


def components(r, p, v, pdot):
    """q and q̇ component first, as the eliminated forms take them."""
    return component_first(r, p), component_first(v, pdot)


def body_first(q, v):
    """r, p, ṙ, ṗ of q and q̇ component first."""
    return q[:3].T, q[3:].T, v[:3].T, v[3:].T


def state_off_manifold(chain, rng):
    """r, p, ṙ, ṗ that satisfy nothing: no joint, no norm, pᵀṗ ≠ 0."""
    return tuple(x + 0.2 * rng.normal(size=x.shape) for x in state_on_manifold(chain, rng))


def loaded_chain(rods, seed, states=state_on_manifold):
    """A random chain with loads and drag, and r, p, ṙ, ṗ of it."""
    rng = np.random.default_rng(seed)
    chain = random_model(rng, rods, loads=True, drag=True)
    return chain, states(chain, rng)


class Symbols:
    """Symbols r, p, ṙ, ṗ, s of N bodies and ℓ, and differentiation of what is built of them."""

    def __init__(self, bodies, attachments):
        from sympy import QQ  # takes longer than to collect all tests of a folder
        from sympy.polys.rings import ring

        n, counts = bodies, {"r": 3 * bodies, "p": 4 * bodies, "v": 3 * bodies, "w": 4 * bodies}
        names = [
            f"{k}{i}" for k, m in {**counts, "s": 3 * attachments, "l": bodies}.items() for i in range(m)
        ]
        self.ring, *generators = ring(names, QQ)
        parts = np.split(np.array(generators, object), np.cumsum([*counts.values(), 3 * attachments]))
        self.q = np.concatenate(parts[:2])
        self.qdot = np.concatenate(parts[2:4])
        shapes = [(n, 3), (n, 4), (n, 3), (n, 4), (attachments, 3), (n,)]
        self.r, self.p, self.v, self.pdot, self.s, self.length = map(np.reshape, parts, shapes)

    def gradient(self, x, variables):
        """∂x/∂variables, shape of x + shape of variables."""
        flat = [self.ring(entry).diff(v) for entry in np.ravel(x) for v in np.ravel(variables)]
        return np.array(flat, object).reshape(*np.shape(x), *np.shape(variables))

    def time_derivative(self, x):
        """d_t x along (ṙ, ṗ)."""
        return self.gradient(x, self.q) @ self.qdot

    def is_zero(self, x):
        """Whether every entry is the polynomial 0."""
        return all(self.ring(entry) == 0 for entry in np.ravel(x))
