"""Certified truth at one state: rigorous enclosures in ball arithmetic (python-flint).

The minimal coordinates as doubles are normalised, positions and velocities follow from them, and the
equations of motion of `plumbline.equations.tree` are solved in balls; mechanisms with loops are in
`loop_closure`.  Every quantity has a radius that encloses all roundings of its computation, and the whole
solution is checked by the definition of the mechanism (`definition`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from plumbline.equations.arithmetic import balls as ball_arithmetic
from plumbline.equations.arithmetic import entries, flatten, midpoints
from plumbline.equations.tree import Solution, Tree
from plumbline.model.datatypes import Model, State, StateQuantities
from plumbline.model.loops import CutMechanism, determinate_part
from plumbline.processes.exceptions import PlumblineError
from plumbline.truth import import_truth_tool
from plumbline.truth.definition import definition_holds
from plumbline.truth.loop_closure import solve_loop
from plumbline.truth.rounding_bound import joint_elements, spring_terms

MAX_RELATIVE_RADIUS = 1e-25  # relative to the largest magnitude of the quantity's own terms
FIRST_BITS, BITS_PER_BODY = 200, 4  # balls lose up to 4 bits from one body to the next
MAX_BITS = 20_000
MAX_GAP = 1e-13  # of rows of loops that depend on others, over lengths and speeds: more is another mechanism


class CertificationFailure(PlumblineError, ArithmeticError):
    """No sharp enclosure was found: the system is singular at this state, or nearly so."""


@dataclass(frozen=True, eq=False)
class CertifiedQuantities:
    """State quantities with a bound of their error."""

    quantities: StateQuantities  # midpoints of the enclosures, rounded to double
    radius: dict[str, float]  # per quantity: largest error of the midpoints, before rounding to double
    bits: int  # precision that was needed


def certify_state(
    model: Model, state: State, mass_matrix: bool = False, bits: int | None = None
) -> CertifiedQuantities:
    """Compute state quantities with a rigorous bound of their error.

    The precision rises until every radius is below `MAX_RELATIVE_RADIUS` of the quantity's terms.

    Args:
        state: the state, of which the minimal coordinates are used.
        bits: precision to start with; absent: `FIRST_BITS` and `BITS_PER_BODY`.

    Returns:
        The quantities, in SI units and the frames of `StateQuantities`.

    Raises:
        CertificationFailure: the system is singular at this state, or nearly so.
        DefinitionViolated: the solution contradicts the definition of the mechanism: the harness is wrong.
        TruthUnavailable: python-flint is not installed.

    """
    bits = FIRST_BITS + BITS_PER_BODY * model.n if bits is None else bits
    while bits <= MAX_BITS:
        balls = enclose_quantities(model, state, bits, mass_matrix)
        if balls is not None and all(_is_sharp(name, balls) for name in balls if name != "scale"):
            gap, size = balls["scale"].get("gap", 0.0), max(1.0, balls["scale"]["r"], balls["scale"]["v"])
            if gap > MAX_GAP * size:
                raise CertificationFailure(
                    f"a loop is not closed: rows that depend on others leave a gap of {gap:.1g}"
                )
            flint = import_truth_tool("flint")
            with flint.ctx.workprec(bits):
                if definition_holds(flint, model, state, balls):
                    break
        bits = bits * 3 // 2
    else:
        raise CertificationFailure(
            f"no enclosure below {MAX_RELATIVE_RADIUS:g} relative at {MAX_BITS} bits: singular or nearly so"
        )
    quantities = {name: ball for name, ball in balls.items() if name != "scale"}
    middle = {name: midpoints(ball) for name, ball in quantities.items()}
    radius = {name: max(float(x.rad()) for x in flatten(ball)) for name, ball in quantities.items()}
    energies = {name: float(middle[name][0]) for name in ("kinetic_energy", "potential_energy")}
    own: dict[str, Any] = middle | energies
    found = StateQuantities(**{x.name: own[x.name] for x in fields(StateQuantities) if x.name in own})
    if model.has_loops:
        found = determinate_part(model, state, found)
        if not model.has_joint_moments:  # as of trees
            found = replace(found, joint_moment=None)
    return CertifiedQuantities(found, radius, bits)


def enclose_quantities(
    model: Model, state: State, bits: int, mass_matrix: bool = False
) -> dict[str, Any] | None:
    """Enclose every quantity at one precision.

    Args:
        state: the state, of which the minimal coordinates are used.
        bits: precision of the balls.

    Returns:
        Balls (python-flint ``arb``) by quantity: N lists of 3 for vectors per body, lists of one for scalars;
        "scale" holds, as floats, the sizes that radii are compared with.  None where a block has no inverse.

    Raises:
        TruthUnavailable: python-flint is not installed.

    """
    flint = import_truth_tool("flint")
    with flint.ctx.workprec(bits):
        try:
            return _enclose(flint, model, state, mass_matrix)
        except ZeroDivisionError:
            return None


def _enclose(flint: Any, model: Model, state: State, mass_matrix: bool) -> dict[str, Any]:
    """As `enclose_quantities`; of loops "scale" has besides the largest gap of dependent rows."""
    if not model.has_loops:
        tree = Tree(ball_arithmetic(flint), model, state)
        balls = tree_quantities(tree, tree.solve())
        if not model.has_joint_moments:
            del balls["joint_moment"]
        if mass_matrix:
            balls["mass_matrix"] = tree.mass_matrix().tolist()
        return balls | {"scale": quantity_scales(tree, balls)}
    tree, solution, cut, gap = solve_loop(flint, model, state)
    balls = tree_quantities(tree, solution, cut)
    return balls | {"scale": quantity_scales(tree, balls) | {"gap": gap}}


def _is_sharp(name: str, balls: dict[str, Any]) -> bool:
    """Whether every radius of the quantity is small enough (an infinite or NaN one is not)."""
    return all(float(x.rad()) <= MAX_RELATIVE_RADIUS * balls["scale"][name] for x in flatten(balls[name]))


def tree_quantities(tree: Tree, solution: Solution, cut: CutMechanism | None = None) -> dict[str, Any]:
    """List the balls of a solved tree.

    Args:
        tree: in balls.
        cut: of which mechanism it is; absent: of itself.

    Returns:
        By quantity, as `plumbline.truth.certified_state.enclose_quantities`, without mass matrix and scales.

    """
    vectors = tree.quantities(solution)
    found: dict[str, Any] = {name: [vectors.pop(name)] for name in ("kinetic_energy", "potential_energy")}
    found["angular_momentum"] = entries(vectors.pop("angular_momentum"))
    vectors |= {"r": tree.r, "v": tree.v, "attitude": tree.A, "angular_velocity": tree.in_bodies(tree.w)}
    vectors = vectors if cut is None else cut.of_source(vectors)
    return found | {name: [entries(x) for x in each] for name, each in vectors.items()}


def quantity_scales(c: Tree, balls: dict[str, Any]) -> dict[str, float]:
    """Estimate the sizes of the terms of each quantity, in its unit.

    Radii are compared with them, because a quantity itself may be zero.

    """
    norm, model = np.linalg.norm, c.model
    lever = float(np.sum(norm(model.point, axis=2)) + np.sum(model.length) + np.sum(np.abs(c.state.x)))
    lever = max(lever, float(np.max(np.abs(midpoints(balls["r"])))))
    rate = float(np.max(norm(midpoints([entries(w) for w in c.w]), axis=1)))
    rate = max(rate, float(np.max(np.abs(c.state.xdot))), float(np.max(np.abs(c.state.udot))))
    # forces [N], moments [N m] and potential energy [J] of springs and their like, before they cancel
    pushes = turns = stored = 0.0
    if model.has_elements:
        state = c.state[None]
        elements, springs = joint_elements(model, state, np.zeros((1, model.n))), spring_terms(model, state)
        pushes, turns = (
            float(sum(np.sum(e.size) for e in elements if e.is_slide == is_slide)) + float(np.sum(own))
            for is_slide, own in ((True, springs.size), (False, springs.moment_size))
        )
        stored = float(sum((np.sum(e.potential) for e in elements), np.sum(springs.potential)))
    size = {name: float(np.max(np.abs(midpoints(ball)), initial=0.0)) for name, ball in balls.items()}
    g = float(norm(model.gravity))
    mass, inertia = float(np.sum(model.mass)), float(np.sum(norm(model.inertia, axis=(1, 2))))
    push = float(np.sum(norm(model.force, axis=1))) + pushes
    torque = float(np.sum(norm(model.moment, axis=1))) + turns
    a = max(size["acceleration"], g, rate**2 * lever, push / mass)
    a = max(a, torque / (mass * lever) if lever else 0.0)
    force = max(size["joint_reaction"], mass * a)
    turning = max(size["angular_acceleration"], rate**2, a / lever if lever else torque / inertia)
    scales = {
        "acceleration": a,
        "angular_acceleration": turning,
        "joint_reaction": force,
        "joint_moment": max(size.get("joint_moment", 0.0), force * lever),
        "kinetic_energy": size["kinetic_energy"],
        "potential_energy": max(size["potential_energy"], mass * g * lever + stored),
        "angular_momentum": max(size["angular_momentum"], (mass * lever**2 + inertia) * rate),
        "r": max(size["r"], lever),
        "v": max(size["v"], lever * rate),
        "mass_matrix": size.get("mass_matrix", 0.0),
        "attitude": 1.0,
        "angular_velocity": max(size["angular_velocity"], rate),
    }
    return {name: scale for name, scale in scales.items() if name in balls}
