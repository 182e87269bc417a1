"""Gauss–Legendre collocation of r̈, p̈ = f(r, p, ṙ, ṗ) by Picard sweeps, for one mechanism or a whole batch.

A step holds S nodes of every body in one forest, so that a sweep costs one right-hand side of S times
the bodies and no more NumPy calls than a single state.  With a the accelerations at the nodes c and A the
collocation matrix (Hairer, Nørsett, Wanner, Solving ODEs I, II.7)

    V = v₀ + h A a,  Q = q₀ + h A V,  a ← f(Q, V)  until a stops changing,
    v₁ = v₀ + h Σ bⱼ aⱼ,  q₁ = q₀ + h v₀ + h² Σ bⱼ (1 − cⱼ) aⱼ,       order 2 S, symmetric.

a starts from the last step's polynomial, extrapolated.  Inside the step a is that polynomial of degree
S − 1, and its integrals are the dense output.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from reference_impl.arrays import Array, Float, Motion
from reference_impl.fast.chain_elimination import component_first
from reference_impl.fast.tree_elimination import EliminatedSystem, eliminated_system
from reference_impl.integrate import IntegrationResult, state_scales
from reference_impl.mechanism import Mechanism

DEFAULT_NODES = 16  # a sweep of a small chain costs NumPy's calls and not its nodes: 8 … 20 were tried
MAX_SWEEPS = 14  # at most in a step; more are better spent on a shorter step
PROBED_STEPS = 50  # steps after which the length of a step no longer depends on the first guess
MAX_BODIES_AT_ONCE = 1000  # nodes × bodies of one right-hand side: larger temporary arrays leave the caches
USUAL_SWEEPS = 6  # sweeps: a step that needs more is made shorter, one that needs fewer may grow


@dataclass(frozen=True, eq=False)
class BatchIntegrationResult(IntegrationResult):
    """A run of all chains together: N counts the bodies of all, ``evaluations`` the sweeps."""

    rejected_steps: int  # steps that were repeated shorter
    stiff_steps: int  # steps whose size the sweeps' convergence decided and not the tolerance: stiffness
    note: str  # a sentence where the problem is stiff for the sweeps
    # rad or m, of joints with elements where springs act on angles; elsewhere no meaning
    x: Float[Array, "samples joints coordinates"]


@dataclass(frozen=True, eq=False)
class GaussTables:
    """Tables of the S-point Gauss–Legendre collocation on [0, 1]."""

    c: Float[Array, "nodes"]  # nodes
    b: Float[Array, "nodes"]  # weights
    A: Float[Array, "nodes nodes"]  # ∫₀^cᵢ of the polynomial through the nodes
    node_to_mode: Float[Array, "nodes nodes"]  # node values → Legendre coefficients

    def extrapolation_matrix(self, ratio: float) -> Float[Array, "nodes nodes"]:
        """Return the matrix from Legendre modes of a step to values at the nodes of the next one.

        Args:
            ratio: length of the next step over that of this one.

        """
        return _extrapolation_matrix(len(self.c), ratio)

    def mode_integrals(
        self, tau: Float[Array, "samples"]
    ) -> tuple[Float[Array, "samples nodes"], Float[Array, "samples nodes"]]:
        """Integrate each Legendre mode once and twice from the start of the step.

        Args:
            tau: upper limits, fractions of the step.

        Returns:
            The first and the second integral.

        """
        S, x = len(self.c), 2 * tau - 1
        P = np.concatenate([-np.ones((len(x), 1)), legvander(x, S + 1)], axis=1)  # P₋₁ = −1, P₀, …
        odd = 2 * np.arange(S + 1) + 1
        once = (P[:, 2:] - P[:, :-2]) / odd / 2  # τ, then ½ (P_{k+1} − P_{k−1}) / (2k + 1)
        twice = np.empty((len(x), S))
        twice[:, 0] = tau**2 / 2
        twice[:, 1:] = (once[:, 2:] - once[:, :-2]) / odd[1:S] / 2
        return once[:, :S], twice


@lru_cache(maxsize=64)
def _extrapolation_matrix(S: int, ratio: float) -> Array:
    return np.asarray(legvander(1 + 2 * ratio * gauss_tables(S).c, S - 1), dtype=float)


@cache
def gauss_tables(S: int) -> GaussTables:
    """Compute the tables of Gauss–Legendre collocation.

    Returns:
        The tables, the same object at every call.

    """
    x, w = leggauss(S)
    modes = (legvander(x, S - 1) * w[:, None]).T * (np.arange(S)[:, None] + 0.5)
    table = GaussTables(c=(1 + x) / 2, b=w / 2, A=np.empty((S, S)), node_to_mode=modes)
    np.matmul(table.mode_integrals(table.c)[0], modes, out=table.A)
    return table


def integrate_collocation(
    chains: Sequence[Mechanism] | EliminatedSystem,
    r: Float[Array, "bodies 3"],
    p: Float[Array, "bodies 4"],
    v: Float[Array, "bodies 3"],
    pdot: Float[Array, "bodies 4"],
    times: Float[Array, "samples"],
    rtol: float,
    *,
    nodes: int = DEFAULT_NODES,
    sweep_tolerance: float | None = None,
    dense: bool = True,
    baumgarte: float = 0.0,
    project: bool = False,
    max_steps: float = np.inf,
) -> BatchIntegrationResult:
    """Integrate all chains with common steps.

    Where sweeps converge only for steps shorter than the tolerance allows (stiffness: short rods, strong
    drag), the sweeps set the steps and ``note`` reports it.  DOP853 is no alternative there, being bound by
    its stability: on a rod of 1e-5 m it took twice the time of the sweeps, and on one of 1e-6 m it had not
    ended after 200 s where the sweeps took 0.3 s; only with drag of 1e4/s and more is it cheaper, 1.8 times.

    Args:
        chains: the mechanisms; M bodies in all.
        r: initial positions [m], world frame, the bodies of all chains in order.
        p: initial Euler parameters.
        v: initial velocities ṙ [m/s], world frame.
        pdot: initial rates ṗ [1/s].
        times: sample times [s], ascending from the initial time.
        rtol: tolerance of the error, relative to the `state_scales` of each chain; see ``dense``.
        nodes: S, of a step.
        sweep_tolerance: ends the sweeps of a step, relative like ``rtol``; 0.1 ``rtol`` by default.
        dense: hold ``rtol`` for the polynomial inside the step, measured by its last Legendre modes.
            Otherwise steps end on ``times`` and ``rtol`` holds there only: the ends of steps have order 2 S
            where the polynomial has S, so the square of the tail counts.
        baumgarte: a [1/s] of Baumgarte's stabilisation; 0 is the notes' raw form.
        project: move the end of every step, and every sample, onto the constraints.
        max_steps: the run ends with an error as soon as its steps show that it would need more.

    Returns:
        The motion of all chains at ``times``.

    Raises:
        ArithmeticError: the step vanishes, there would be more than ``max_steps``, or (`SingularSystem`) S is
            singular on the way.

    """
    forest = chains if isinstance(chains, EliminatedSystem) else eliminated_system(chains)
    quiet = 0.1 * rtol if sweep_tolerance is None else sweep_tolerance
    stepper = _Stepper(forest, (r, p, v, pdot), rtol, quiet, gauss_tables(nodes), dense, baumgarte)
    span = float(times[-1] - times[0])
    t, steps, rejected, hindered, done = float(times[0]), 0, 0, 0, 1
    samples = np.empty((2, len(times), 7, forest.body_count))
    samples[:, 0] = stepper.q, stepper.v
    coordinates = np.tile(stepper.x, (len(times), 1, 1))
    while done < len(times):
        goal = float(times[-1] if dense else times[done])
        h = min(stepper.h, goal - t)
        if not dense:  # equal steps to the next time, no crumb at the end
            h = (goal - t) / max(1.0, np.ceil((goal - t) / stepper.h - 0.15))
        if h < 1e-13 * max(span, abs(t)) and goal - t > h:
            raise ArithmeticError(f"collocation stopped at t = {t} s: the step vanishes")
        if steps + rejected >= PROBED_STEPS and steps + (times[-1] - t) / h > max_steps:
            raise ArithmeticError(
                f"collocation needs more than {max_steps:g} steps: at t = {t:.3g} s they are {h:.3g} s long"
            )
        ok, slow = stepper.try_step(h)
        if not ok:
            rejected += 1
            continue
        steps, hindered = steps + 1, hindered + slow
        ends = goal - (t + h) <= 1e-14 * max(abs(goal), span)
        reached_t = goal if ends else t + h
        reached = int(np.searchsorted(times, reached_t, side="right"))
        if reached > done:
            within, coordinates[done:reached] = stepper.dense_output((times[done:reached] - t) / h)
            if project:
                within = stepper.projected(within)
            samples[:, done:reached] = within
        if project:
            stepper.project()
        if reached > done and times[reached - 1] == reached_t:
            samples[:, reached - 1] = stepper.q, stepper.v
        t, done = reached_t, reached
    values = samples.swapaxes(-1, -2)
    note = f"stiff: the sweeps and not the tolerance set {hindered} of {steps} steps"
    return BatchIntegrationResult(
        t=times,
        r=values[0, ..., :3],
        p=values[0, ..., 3:],
        v=values[1, ..., :3],
        pdot=values[1, ..., 3:],
        steps=steps,
        evaluations=stepper.sweeps,
        rejected_steps=rejected,
        stiff_steps=hindered,
        note=note if 2 * hindered > steps > 2 else "",
        x=coordinates,
    )


class _Stepper:
    """The state of all chains, and one step of it."""

    h: float  # s, of the next step
    last_step: float
    new_modes: Array

    def __init__(
        self,
        forest: EliminatedSystem,
        motion: Motion,
        rtol: float,
        quiet: float,
        table: GaussTables,
        dense: bool,
        baumgarte: float,
    ) -> None:
        self.forest, self.table = forest, table
        parts = -(-len(table.c) * forest.body_count // MAX_BODIES_AT_ONCE)
        nodes = np.array_split(np.arange(len(table.c)), min(parts, len(table.c)))
        self.tiles = [(slice(at[0], at[-1] + 1), forest.repeated(len(at))) for at in nodes]
        self.q, self.v = q, v = component_first(*motion[:2]), component_first(*motion[2:])
        self.rtol, self.sweep_tolerance = rtol, quiet
        self.dense, self.baumgarte = dense, baumgarte
        # joint coordinates near which the angles of springs are taken, carried on by their rates
        self.x = np.zeros((forest.joint_count, 2))
        if forest.winding:
            self.x = forest.winding.coordinates(q[:3].T, q[3:].T, v[:3].T, v[3:].T, x=forest.x)[0]
        self.x_rate = np.zeros((len(table.c), *self.x.shape))
        # what rounding took from the sums
        self.q_compensation, self.v_compensation = (np.zeros_like(q), np.zeros_like(v))
        self.copies: dict[int, EliminatedSystem] = {}  # by number
        self.modes: Array = np.empty(0)  # (7, S, M) Legendre modes of the last step's accelerations
        self.sweeps = 0
        self._initialise_scales(motion)

    def _initialise_scales(self, motion: Motion) -> None:
        """Natural sizes (7, M) of q and v, chain by chain, and the first step from their ratio."""
        q_size, v_size = np.empty_like(self.q), np.empty_like(self.v)
        pushed = np.abs(self.forest.acceleration(self.q, self.v))
        for chain, at in zip(self.forest.chains, self.forest.first_body, strict=False):
            body = slice(at, at + chain.n)
            r, p, v, pdot = (part[body] for part in motion)
            y = state_scales(chain, r, p, v, pdot)
            first, second = y[0], y[3 * chain.n]
            q_size[:3, body], q_size[3:, body] = first, second
            v_size[:3, body], v_size[3:, body] = y[7 * chain.n], y[10 * chain.n]
            pushed[:, body] = np.max(pushed[:, body], axis=1, keepdims=True)
        v_size = np.maximum(v_size, np.sqrt(pushed * q_size))  # loads may move what neither falls nor turns
        self.q_size, self.v_size = q_size, np.where(v_size > 0, v_size, 1.0)  # nothing moves: any size
        self.h = 0.3 * float(np.min(q_size / self.v_size))

    def try_step(self, h: float) -> tuple[bool, bool]:
        """Try a step: (whether it was made, whether the sweeps were what limited it). Sets the next ``h``."""
        table, S = self.table, len(self.table.c)
        if self.modes.size:
            a = self._extrapolated_acceleration(h / self.last_step)
        else:
            here = self.forest.acceleration(self.q, self.v, self.baumgarte)
            a = np.repeat(here[:, None], S, axis=1)
        q0, v0, weight = self.q[:, None], self.v[:, None], 1 / self.v_size[:, None]
        before, rate, converged, count = np.inf, 0.0, False, 0
        hA = h * table.A
        while count < MAX_SWEEPS and not converged:
            V = hA @ a
            V += v0
            Q = hA @ V
            Q += q0
            new = self._accelerations(Q, V, hA)
            a -= new
            np.abs(a, out=a)
            a *= weight
            change = h * float(a.max())
            a, count = new, count + 1
            rate = change / before if count > 1 else 1.0
            # Quiet at the floor that rounding in a sets: no sweep improves on it.
            floor = 1e-12 * h * float(np.max(np.abs(a) * weight)) if count > 1 and rate > 0.3 else 0.0
            converged = change * min(rate, 1.0) <= self.sweep_tolerance or change <= floor
            if count > 3 and rate > 0.8 and not converged:
                break
            before = change
        self.sweeps += count
        if not converged:
            self.h = 0.6 * h
            return False, True
        tail = self._error_over_tolerance(a, h)
        grow = 0.9 * (1 / max(tail, 1e-30)) ** (1 / S)
        patience = (USUAL_SWEEPS / count) ** 0.5
        slow = grow > 1.6 and patience < 1.1
        if tail > 1:
            self.h = h * max(0.3, grow)
            return False, False
        factor = min(grow, patience, 1.6)
        if factor < 0.95 or factor > 1.15:  # a kept step length keeps its extrapolation matrix
            self.h = h * factor
        self._advance(a, h)
        return True, slow

    def _accelerations(self, Q: Array, V: Array, hA: Array) -> Array:
        """The accelerations (7, S, M) at all nodes."""
        new = np.empty_like(Q)
        if self.forest.winding:
            self._carry_angles(Q, V, hA)
        for nodes, tile in self.tiles:
            part = tile.acceleration(Q[:, nodes].reshape(7, -1), V[:, nodes].reshape(7, -1), self.baumgarte)
            new[:, nodes] = part.reshape(7, -1, self.forest.body_count)
        return new

    def _carry_angles(self, Q: Array, V: Array, hA: Array) -> None:
        """Set the coordinates near which springs take their angles at the nodes: x₀ + h A ẋ."""
        for nodes, tile in self.tiles:
            (r, p), (v, pdot) = (
                (y[:3].reshape(3, -1).T, y[3:].reshape(4, -1).T) for y in (Q[:, nodes], V[:, nodes])
            )
            if tile.winding:
                rate = tile.winding.rates(r, p, v, pdot)
                self.x_rate[nodes] = rate.reshape(-1, *self.x.shape)
        for nodes, tile in self.tiles:
            tile.x = (self.x + np.tensordot(hA[nodes], self.x_rate, 1)).reshape(-1, self.x.shape[1])

    def _extrapolated_acceleration(self, ratio: float) -> Array:
        """The last step's polynomial at the nodes of the next one, cut where its terms there are smallest.

        A Legendre mode k grows (1 + 2 ratio + …)ᵏ-fold outside its step, and the last ones are rounding and
        aliasing: beyond the smallest term each one adds more error than it takes away.
        """
        ahead = self.table.extrapolation_matrix(ratio)
        terms = np.max(np.abs(self.modes) / self.v_size[:, None], axis=(0, 2)) * ahead[-1]
        keep = 2 + int(np.argmin(terms[1:]))
        return np.asarray(ahead[:, :keep] @ self.modes[:, :keep])

    def _error_over_tolerance(self, a: Array, h: float) -> float:
        """The error of the step over the tolerance, from the last two Legendre modes of a."""
        S = len(self.table.c)
        self.new_modes = self.table.node_to_mode @ a  # (7, S, M)
        last = np.max(np.abs(self.new_modes[:, -2:]), axis=1)
        if not self.dense:
            size = np.max(np.abs(a), axis=1)
            last = last**2 / np.where(size > 0, size, 1.0)
        velocity = h / (2 * S) * last / self.v_size
        position = (h / (2 * S)) ** 2 * last / self.q_size
        return float(max(np.max(velocity), np.max(position))) / self.rtol

    def _advance(self, a: Array, h: float) -> None:
        """To the end of the step, with compensated sums (Kahan)."""
        table = self.table
        self.modes, self.last_step, self.q0, self.v0 = self.new_modes, h, self.q, self.v
        self.x0, self.x = self.x, self.x + h * np.tensordot(table.b, self.x_rate, 1)
        dv = h * np.einsum("j,ijm->im", table.b, a)
        dq = h * (self.v + h * np.einsum("j,ijm->im", table.b * (1 - table.c), a))
        self.q, self.q_compensation = _compensated_sum(self.q, dq + self.q_compensation)
        self.v, self.v_compensation = _compensated_sum(self.v, dv + self.v_compensation)

    def dense_output(self, tau: Array) -> tuple[Array, Array]:
        """(2, T, 7, M) q and v, and x (T, M, 2), at fractions ``tau`` of the last step."""
        once, twice = self.table.mode_integrals(tau)
        modes, h = self.modes, self.last_step
        v = self.v0 + h * np.einsum("tk,ikm->tim", once, modes)
        q = self.q0 + h * (tau[:, None, None] * self.v0 + h * np.einsum("tk,ikm->tim", twice, modes))
        x = self.x0 + h * np.tensordot(once @ self.table.node_to_mode, self.x_rate, 1)
        return np.stack([q, v]), x

    def projected(self, samples: Array) -> Array:
        """Samples (2, T, 7, M) of q and v, on the manifold: all together."""
        count = samples.shape[1]
        if count not in self.copies:
            self.copies[count] = self.forest.repeated(count)
        side_by_side = samples.swapaxes(1, 2).reshape(2, 7, -1)
        found = np.stack(self.copies[count].project(*side_by_side))
        return found.reshape(2, 7, count, -1).swapaxes(1, 2)

    def project(self) -> None:
        """Onto the manifold."""
        self.q, self.v = self.forest.project(self.q, self.v)
        self.q_compensation, self.v_compensation = np.zeros_like(self.q), np.zeros_like(self.v)


def _compensated_sum(total: Array, part: Array) -> tuple[Array, Array]:
    """Sum, and what its rounding lost (Kahan)."""
    out = total + part
    return out, part - (out - total)
