"""Certified truth at one state: rigorous enclosures in ball arithmetic (python-flint).

The minimal coordinates as doubles are normalised, positions and velocities follow from them, and the
equations of motion of `plumbline.equations.tree` are solved in balls; mechanisms with loops are in
`certified_loop`.  Every quantity has a radius that encloses all roundings of its computation, and the whole
solution is checked by the definition of the mechanism (`definition`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from plumbline.equations.balls import balls as ball_arithmetic
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import Model, State, StateQuantities
from plumbline.model.loops import determinate_part
from plumbline.processes.exceptions import PlumblineError
from plumbline.truth import import_truth_tool
from plumbline.truth.ball_geometry import flatten, midpoints, quantity_scales, tree_quantities
from plumbline.truth.certified_loop import enclose_loop
from plumbline.truth.definition import definition_holds

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
            if _definition_holds(model, state, balls, bits):
                break
        bits = bits * 3 // 2
    else:
        raise CertificationFailure(
            f"no enclosure below {MAX_RELATIVE_RADIUS:g} relative at {MAX_BITS} bits: singular or nearly so"
        )
    quantities = {name: ball for name, ball in balls.items() if name != "scale"}
    middle = {name: midpoints(ball) for name, ball in quantities.items()}
    radius = {name: max(float(x.rad()) for x in flatten(ball)) for name, ball in quantities.items()}
    found = StateQuantities(
        acceleration=middle["acceleration"],
        angular_acceleration=middle["angular_acceleration"],
        joint_reaction=middle["joint_reaction"],
        kinetic_energy=float(middle["kinetic_energy"][0]),
        potential_energy=float(middle["potential_energy"][0]),
        angular_momentum=middle["angular_momentum"],
        joint_moment=middle.get("joint_moment"),
    )
    if model.has_loops:
        found = determinate_part(model, state, found)
    elif mass_matrix:
        found = replace(found, mass_matrix=middle["mass_matrix"])
    return CertifiedQuantities(found, radius, bits)


def _definition_holds(model: Model, state: State, balls: dict[str, Any], bits: int) -> bool:
    flint = import_truth_tool("flint")
    with flint.ctx.workprec(bits):
        return definition_holds(flint, model, state, balls)


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
            if model.has_loops:
                return enclose_loop(flint, model, state)
            return _enclose_tree(flint, model, state, mass_matrix)
        except ZeroDivisionError:
            return None


def _enclose_tree(flint: Any, model: Model, state: State, mass_matrix: bool) -> dict[str, Any]:
    """All quantities of `enclose_quantities`, of a mechanism without loops."""
    tree = Tree(ball_arithmetic(flint), model, state)
    balls = tree_quantities(tree, tree.solve())
    if model.is_chain:  # whose joints hold no moments
        del balls["joint_moment"]
    if mass_matrix:
        balls["mass_matrix"] = tree.mass_matrix().tolist()
    return balls | {"scale": quantity_scales(tree, balls)}


def _is_sharp(name: str, balls: dict[str, Any]) -> bool:
    """Whether every radius of the quantity is small enough (an infinite or NaN one is not)."""
    return all(float(x.rad()) <= MAX_RELATIVE_RADIUS * balls["scale"][name] for x in flatten(balls[name]))
