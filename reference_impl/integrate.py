"""The notes' first-order form (N6), raw: no stabilisation, so that its drift is a result (E4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import DOP853

from reference_impl.chain import Array, Chain
from reference_impl.direct import DirectSystem
from reference_impl.euler_parameters import angular_velocity
from reference_impl.structured import StructuredSystem, component_first


@dataclass(frozen=True, eq=False)
class IntegrationResult:
    """Samples at the asked times, as integrated: p is neither normalised nor projected."""

    t: Array  # (T,) s
    r: Array  # (T, N, 3) m
    p: Array  # (T, N, 4) –
    v: Array  # (T, N, 3) m/s, ṙ
    pdot: Array  # (T, N, 4) 1/s
    steps: int  # steps taken
    evaluations: int  # of the right-hand side


def pack_state(r: Array, p: Array, v: Array, pdot: Array) -> Array:
    """(N6) y = (r, p, ṙ, ṗ), (14 N,)."""
    return np.concatenate([x.ravel() for x in (r, p, v, pdot)])


def unpack_state(y: Array, n: int) -> tuple[Array, Array, Array, Array]:
    """Parts r (..., N, 3), p (..., N, 4), ṙ, ṗ of y (..., 14 N)."""
    lead = y.shape[:-1]
    r, p = y[..., : 3 * n].reshape(*lead, n, 3), y[..., 3 * n : 7 * n].reshape(*lead, n, 4)
    v, pdot = y[..., 7 * n : 10 * n].reshape(*lead, n, 3), y[..., 10 * n :].reshape(*lead, n, 4)
    return r, p, v, pdot


def state_rate(system: DirectSystem, y: Array, gamma_defect: float | Array = 0.0) -> Array:
    """(N6) ẏ = (ṙ, ṗ, r̈, p̈), (14 N,); ``gamma_defect`` as `System.solve`."""
    r, p, v, pdot = unpack_state(y, system.chain.n)
    x, _ = system.solve_unknowns(r, p, v, pdot, gamma_defect)
    return np.concatenate([v.ravel(), pdot.ravel(), x[: 7 * system.chain.n]])  # r̈, p̈ come first


def structured_state_rate(forest: StructuredSystem, y: Array) -> Array:
    """(N6) ẏ (14 N,) from the structured form: equal to `rate` to rounding, in less time."""
    r, p, v, pdot = unpack_state(y, forest.body_count)
    a = forest.acceleration(component_first(r, p), component_first(v, pdot))
    return pack_state(v, pdot, a[:3].T, a[3:].T)


def state_scales(chain: Chain, r: Array, p: Array, v: Array, pdot: Array) -> Array:
    """(14 N,) the size that each part of y has in this motion: what an absolute tolerance is relative to.

    A coordinate that passes through zero needs no more digits there than the motion as a whole: the
    stretched chain for r, 1 for p, and for the rates what is there at the start or what falling through the
    chain's own length reaches, whichever is larger.
    """
    reach = float(np.sum(chain.length + np.linalg.norm(chain.proximal, axis=1)))
    reach += float(np.sum(np.linalg.norm(chain.distal[:-1], axis=1)))
    reach = max(reach, float(np.max(np.abs(r)))) or 1.0
    fall = float(np.sqrt(np.linalg.norm(chain.gravity) * reach))
    omega = float(np.max(np.abs(angular_velocity(p, pdot))))
    speed = max(fall, float(np.max(np.abs(v))), omega * reach)
    sizes = (reach, 1.0, speed, max(speed / reach, omega) / 2)
    return np.repeat(sizes, np.array([3, 4, 3, 4]) * chain.n)


def integrate_dop853(
    chain: Chain,
    r: Array,
    p: Array,
    v: Array,
    pdot: Array,
    times: Array,
    rtol: float,
    gamma_defect: float | Array = 0.0,
    structured: bool = False,
) -> IntegrationResult:
    """(N6) by DOP853, sampled at ``times`` (T,) from its dense output; times[0] is the initial time.

    Initial r, ṙ (N, 3) m, m/s and p, ṗ (N, 4) –, 1/s.  The absolute tolerance is ``rtol`` times
    `natural_sizes`.  scipy holds rtol at 2.2e-14 at least.  ``structured`` takes the right-hand side from
    `forest` in place of the direct form, for long chains; γ has no defect there.

    Raises SingularSystem where S is singular on the way, ArithmeticError where the step size vanishes.
    """
    system, n = DirectSystem(chain), chain.n
    start = pack_state(r, p, v, pdot)
    atol = rtol * state_scales(chain, r, p, v, pdot)
    samples = np.empty((len(times), 14 * n))
    samples[0], done, steps = start, 1, 0
    if structured and np.any(gamma_defect):
        raise ValueError("a defect of γ is planted in the direct form only")
    forest = StructuredSystem([chain]) if structured else None

    def right(_: float, y: Array) -> Array:
        return state_rate(system, y, gamma_defect) if forest is None else structured_state_rate(forest, y)

    solver = DOP853(right, times[0], start, times[-1], rtol=rtol, atol=atol)
    while done < len(times):
        message = solver.step()
        if solver.status == "failed":
            raise ArithmeticError(f"DOP853 stopped at t = {solver.t} s: {message}")
        steps += 1
        reached = int(np.searchsorted(times, solver.t, side="right"))
        if reached > done:
            samples[done:reached] = solver.dense_output()(times[done:reached]).T
            if times[reached - 1] == solver.t:
                samples[reached - 1] = solver.y
            done = reached
    r_, p_, v_, pdot_ = unpack_state(samples, n)
    return IntegrationResult(t=times, r=r_, p=p_, v=v_, pdot=pdot_, steps=steps, evaluations=solver.nfev)
