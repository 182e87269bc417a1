"""Loops: the mechanism cut open at its closing joints, and what closing them requires.

Cut open it is a tree: each closing joint carries a part c of its near body b, which has to stay in that
body's place.  With the velocities of `velocity_jacobian`, and vex R the vector of R's skew part,

    F = (r_b − r_c, −vex(A_bᵀ A_c)) = 0,        J ν = (v_b − v_c, ω′_b − ω′_c) = 0.

Six rows per loop, whatever joint closes it.  Rows may depend on the others: then the forces in the loop are
not unique, and of each joint's wrench only the determinate part is (`determinate_part`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import (
    BODY_FIELDS,
    JOINT_FIELDS,
    VALUE_AXES,
    ZERO_INERTIA,
    Array,
    Bool,
    Flags,
    Float,
    Indices,
    Int,
    Model,
    State,
    StateQuantities,
    Trajectory,
)
from plumbline.model.kinematics import (
    complete_state,
    cross,
    joint_coordinates,
    mass_matrix,
    minimal_rates,
    own_rates,
    path_to_world,
    quaternion_product,
    rate_count,
    rotate_vectors,
    rotation_matrix,
    velocity_jacobian,
)

MIN_SINGULAR_VALUE = 1e-6  # of the rows that hold, below it a pose counts as singular
MIN_MOTION_SINGULAR_VALUE = 1e-2  # the same of poses that a motion is compared at: it loses digits near them
RANK_TOLERANCE = 1e-11  # of singular values of scaled rows: below it a row depends on the others
MIN_MASS_RATIO = 1e-12  # of eigenvalues of a mass matrix of unit diagonal: below it a motion has no inertia
NEARBY = 1e-2  # [rad, m]: how far a pose nearby is, where what holds at one pose alone does not
STABILISATION = 50.0  # 1/s, of engines' motions: gaps that steps open die as (1 + a t) e^{-a t}
NEWTON_STEPS, MAX_HALVINGS = 30, 6
# of a rate in unit motions of the loops, times nu and the condition
SHARE_ROUNDING = 64 * np.finfo(float).eps
NEARLY_CLOSED = 1e-11  # of a gap [m, rad]: the next step of Newton's method leaves only rounding
PER_BODY = ("acceleration", "angular_acceleration")  # quantities with one row per body
PER_JOINT = ("joint_reaction", "joint_moment")


@dataclass(frozen=True, eq=False)
class CutMechanism:
    """A mechanism cut open at its closing joints."""

    source: Model  # N bodies, J joints
    model: Model  # a tree of J bodies, depth first
    place: Int[Indices, "joints"]  # which body of the tree joint k of the source holds
    ends: tuple[tuple[int, int], ...]  # of each loop the bodies b and c of the tree that coincide
    share: Float[Array, "joints"]  # of mass and inertia of its body that a part has

    def with_numbers(self, source: Model) -> CutMechanism:
        """Cut the same mechanism with other numbers, which may be a batch."""
        parts = _fields_of_parts(source, np.argsort(self.place), self.share)
        kept = {name: getattr(self.model, name) for name in ("kind", "body", "spring_body")}
        return replace(self, source=source, model=replace(source, **kept, **parts))

    def with_whole_bodies(self) -> CutMechanism:
        """Cut the same mechanism so that parts have no mass."""
        is_body = np.isin(np.arange(len(self.place)), self.place[: self.source.n])
        return replace(self, share=is_body.astype(float))

    @property
    def row_scale(self) -> Float[Array, "loop_rows"]:
        """Factors that make the rows of F and J comparable: 1/ℓ of lengths, ℓ of `wrench_length`."""
        length = wrench_length(self.source)
        return np.tile([1 / length] * 3 + [1.0] * 3, len(self.ends))

    def state(self, state: State) -> State:
        """Describe a state of the mechanism as one of the tree.

        Args:
            state: of the mechanism, its loops closed; or many, of arrays with leading axes.

        Returns:
            The tree's state; the parts go by the closing joints' own coordinates.

        """
        return _state_of_tree(self, state) if self.ends else state

    def source_state(self, state: State) -> State:
        """Describe a state of the tree as one of the mechanism.

        Args:
            state: of the tree, its ends together.

        """
        bodies = self.place[: self.source.n]
        return complete_state(self.source, state[bodies])

    def source_quantities(self, answer: StateQuantities) -> StateQuantities:
        """Describe quantities of the tree as those of the mechanism.

        Args:
            answer: of the tree.

        Returns:
            Of the mechanism; of one with loops without a mass matrix.

        """
        if not self.ends:
            return answer
        return StateQuantities(**self.of_source(vars(answer)) | {"mass_matrix": None})

    def of_source(self, quantities: Mapping[str, Any]) -> dict[str, Any]:
        """Order lists and arrays over the tree's bodies and joints as the mechanism has them; others stay."""
        found = {**quantities}
        for name, value in quantities.items():
            places = self.place if name in PER_JOINT else self.place[: self.source.n]
            if isinstance(value, list):
                found[name] = [value[k] for k in places]
            elif value is not None and name in (*PER_JOINT, *PER_BODY):
                found[name] = value[places]
        return found

    def source_run(self, run: Trajectory) -> Trajectory:
        """Describe a run of the tree as one of the mechanism.

        Args:
            run: of the tree.

        Returns:
            The same samples of the mechanism's bodies.

        """
        bodies, names = self.place[: self.source.n], ("r", "p", "v", "pdot")
        return replace(run, **{name: getattr(run, name)[:, bodies] for name in names})

    def gap(self, state: State) -> Float[Array, "loop_rows"]:
        """Return F.

        Args:
            state: of the tree.

        Returns:
            Loop by loop [m, rad]; of opposite attitudes 1 rad or more.

        """
        a, found = rotation_matrix(state.p), []
        for b, c in self.ends:
            relative = a[b].T @ a[c]
            skew = (relative - relative.T)[[2, 0, 1], [1, 2, 0]] / 2
            if np.trace(relative) < 1:  # more than a quarter turn
                skew = skew + np.where(skew < 0, -1.0, 1.0)
            found.append(np.concatenate([state.r[b] - state.r[c], -skew]))
        return np.concatenate(found)

    def jacobian(self, state: State) -> Float[Array, "... loop_rows nu"]:
        """Return J.

        Args:
            state: of the tree; or many, of arrays with leading axes.

        Returns:
            For the rates ν of `velocity_jacobian`.

        """
        w = velocity_jacobian(self.model, state)
        w = w.reshape(*w.shape[:-2], self.model.n, 6, -1)
        return np.concatenate([w[..., b, :, :] - w[..., c, :, :] for b, c in self.ends], -2)


@lru_cache(maxsize=64)  # engines are asked for the same states in many ways
def _state_of_tree(cut: CutMechanism, state: State) -> State:
    source = cut.source
    fields = {name: value[..., source.body[:, 1], :] for name, value in vars(state).items()}
    fields |= zip(("u", "udot", "x", "xdot"), joint_coordinates(source, state), strict=True)
    order = np.argsort(cut.place)
    return complete_state(cut.model, State(**{name: value[..., order, :] for name, value in fields.items()}))


@lru_cache(maxsize=64)  # mechanisms are never changed
def cut_open(model: Model) -> CutMechanism:
    """Cut a mechanism open at its closing joints.

    A body with c of them keeps 2⁻ᶜ of its mass and inertia, and their parts get ½, ¼, …: exact in binary.

    Args:
        model: one without loops is the tree itself.

    """
    n, (far, near) = model.n, model.body.T
    if not model.has_loops:
        return CutMechanism(model, model, np.arange(n), (), np.ones(n))
    order: list[int] = []

    def visit(body: int) -> None:
        for k in [*range(n, len(far)), *range(n)]:
            if far[k] == body:
                order.append(k)
                if k < n:
                    visit(k)

    visit(-1)
    place = np.argsort(order)
    share = np.ones(len(far))
    for k in range(n, len(far)):
        share[near[k]] = share[k] = share[near[k]] / 2
    changes = _fields_of_parts(model, np.array(order), share[order])
    above = np.where(far[order] < 0, -1, place[far[order]])
    changes["body"] = np.stack([above, np.arange(len(order))], axis=1)
    changes["spring_body"] = np.where(model.spring_body < 0, -1, place[model.spring_body])
    kinds = tuple(model.kind[k] for k in order)
    ends = tuple((int(place[near[k]]), int(place[k])) for k in range(n, len(far)))
    return CutMechanism(model, replace(model, kind=kinds, **changes), place, ends, share[order])


def _fields_of_parts(model: Model, order: NDArray[np.intp], share: Array) -> dict[str, Any]:
    """Fields of the bodies and joints of a tree that holds the joints in this order."""
    is_body, near, fields = order < model.n, model.body[order, 1], dict[str, Any]()
    factors = dict.fromkeys(("mass", "inertia"), share) | dict.fromkeys(BODY_FIELDS, is_body)
    for name in (*factors, *JOINT_FIELDS[2:]):
        value, own = getattr(model, name), VALUE_AXES[name]
        taken = np.take(value, near if name in factors else order, value.ndim - 1 - own)
        fields[name] = taken * factors[name].reshape(-1, *(1,) * own) if name in factors else taken
    return fields


def displaced(model: Model, state: State, step: Float[Array, "nu"]) -> State:
    """Move a tree's coordinates.

    Args:
        model: a tree.
        state: where it is.
        step: changes in the order of the rates of `velocity_jacobian`.

    Returns:
        The state there, with the same rates.

    """
    p, r, x, u = state.p.copy(), state.r.copy(), state.x.copy(), state.u.copy()
    u[model.rods] += step[: 3 * int(model.rods.sum())].reshape(-1, 3)
    u[model.rods] /= np.linalg.norm(u[model.rods], axis=1, keepdims=True)
    for k, (kind, own) in enumerate(zip(model.kinds, own_rates(model), strict=True)):
        change = step[own]
        if kind.holds_nothing:
            r[k] += change[:3]
        if kind.has_attitude:
            p[k] = quaternion_product(p[k], np.concatenate([[1.0], change[-3:] / 2]))
            p[k] /= np.linalg.norm(p[k])
        else:
            x[k, : len(change)] += change
    return complete_state(model, replace(state, p=p, r=r, x=x, u=u))


def with_rates(model: Model, state: State, rates: Float[Array, "nu"]) -> State:
    """Give a tree other rates.

    Args:
        model: a tree.
        state: where it is.
        rates: in the order of `velocity_jacobian`.

    Returns:
        The state with these rates.

    """
    omega, v, xdot, udot = state.omega.copy(), state.v.copy(), state.xdot.copy(), state.udot.copy()
    u = state.u[model.rods]
    swing = rates[: 3 * int(model.rods.sum())].reshape(-1, 3)
    udot[model.rods] = swing - u * np.sum(u * swing, axis=1, keepdims=True)
    for k, (kind, own) in enumerate(zip(model.kinds, own_rates(model), strict=True)):
        value = rates[own]
        if kind.holds_nothing:
            v[k] = value[:3]
        if kind.has_attitude:
            omega[k] = value[-3:]
        else:
            xdot[k, : len(value)] = value
    return complete_state(model, replace(state, omega=omega, v=v, xdot=xdot, udot=udot))


def assembled(
    model: Model, state: State, movable: Bool[Flags, "nu"] | None = None, is_pose_kept: bool = False
) -> State:
    """Close a mechanism's loops to rounding: the nearest coordinates (Newton's method) and rates.

    Args:
        model: the mechanism; a tree is left alone.
        state: near an assembled state.
        movable: of the mechanism's rates, True for those that may change; absent: all.
        is_pose_kept: whether coordinates whose rates are not ``movable`` keep their values too.

    Returns:
        The state; where the loops cannot be closed from here, or the rates not, gaps remain.

    """
    if not model.has_loops:
        return state
    cut = cut_open(model)
    free = np.ones(rate_count(cut.model), bool)
    if movable is not None:  # besides the closing joints' own, which follow
        free[_rates_of_source(cut)] = movable
    best = closed_pose(cut, cut.state(state), free if is_pose_kept else None)
    rates = closed_rates(cut, best, minimal_rates(cut.model, best), free)
    return cut.source_state(with_rates(cut.model, best, rates))


def closed_pose(cut: CutMechanism, state: State, free: Bool[Flags, "nu"] | None = None) -> State:
    """Close the loops of a cut mechanism by Newton's method, with the shortest steps.

    Args:
        state: of the tree, near a pose where its ends are together.
        free: True for coordinates that may change; absent: all.

    Returns:
        That pose, with the same rates; where the loops cannot be closed from here, gaps remain.

    """
    best, gap = state, cut.gap(state)
    for _ in range(NEWTON_STEPS):
        J, before = cut.jacobian(best), np.max(np.abs(gap))
        step = _least_norm(cut, J if free is None else J * free, -gap)
        for _ in range(MAX_HALVINGS if before > NEARLY_CLOSED else 1):  # near singular poses it is too long
            tried = displaced(cut.model, best, step)
            left = cut.gap(tried)
            if (after := np.max(np.abs(left))) < before:
                break
            step = step / 2
        else:
            break
        best, gap = tried, left
        if before < NEARLY_CLOSED or after <= np.finfo(float).eps:  # what is left is rounding
            break
    return best


def closed_rates(
    cut: CutMechanism, state: State, rates: Float[Array, "nu"], free: Bool[Flags, "nu"] | None = None
) -> Float[Array, "nu"]:
    """Project rates on those that keep the loops of a cut mechanism closed.

    Args:
        state: of the tree, its ends together.
        rates: of the tree.
        free: True for those that may change; absent: all.

    Returns:
        The nearest rates with J ν = 0; where there are none, rates of ends differ.  Those that may
        change and cannot move are exactly 0, not what rounding leaves: a comparison would be relative to it.

    """
    J, found = cut.jacobian(state), rates.copy()
    chosen = np.ones(len(rates), bool) if free is None else free
    for _ in range(2):  # the second pass removes what rounding left of the first
        found[chosen] += _least_norm(cut, J[:, chosen], -J @ found)
    found[chosen & ~np.any(allowed_rates(cut, state), axis=0)] = 0.0
    return found


def allowed_rates(cut: CutMechanism, state: State) -> Float[Array, "mobility nu"]:
    """Return the rates that keep the loops of a cut mechanism closed.

    Args:
        state: of the tree, its ends together.

    Returns:
        Orthonormal rates that span them; a rate that none of them moves is exactly 0 in all.

    """
    rods = np.zeros((int(cut.model.rods.sum()), rate_count(cut.model)))
    for i, u in enumerate(state.u[cut.model.rods]):  # a rod has no rate along itself
        rods[i, 3 * i : 3 * i + 3] = u
    _, values, vectors = np.linalg.svd(np.concatenate([cut.jacobian(state) * cut.row_scale[:, None], rods]))
    rank = int(np.sum(values > RANK_TOLERANCE * values[0]))
    found = vectors[rank:]
    rounding = SHARE_ROUNDING * len(vectors) * values[0] / values[rank - 1]
    return np.where(np.linalg.norm(found, axis=0) > rounding, found, 0.0)


def immovable_joints(model: Model, state: State) -> list[int]:
    """Find the joints that the loops keep from moving.

    Args:
        state: a state of it, its loops closed.

    Returns:
        Numbers of joints, closing ones too, whose bodies do not move relative to each other, neither here nor
        at a pose nearby (at a dead point a joint rests); none of welds, which never move, and of trees.

    """
    if not model.has_loops:
        return []
    cut = cut_open(model)
    there = cut.state(state)
    rates = allowed_rates(cut, there)
    is_still = _joints_at_rest(cut, there, rates)
    step = np.random.default_rng(0).normal(size=len(rates)) @ rates
    if size := float(np.linalg.norm(step)):
        nearby = closed_pose(cut, displaced(cut.model, there, np.asarray(NEARBY * step / size)))
        is_still &= _joints_at_rest(cut, nearby, allowed_rates(cut, nearby))
    return [k for k, at in enumerate(cut.place) if is_still[at] and not model.kinds[k].is_rigid]


def _joints_at_rest(cut: CutMechanism, state: State, rates: Array) -> NDArray[np.bool_]:
    """(J,) of the tree: whether no allowed rates (mobility, nu) move a joint's bodies against each other."""
    a, tree, mobility = rotation_matrix(state.p), cut.model, len(rates)
    moving = (velocity_jacobian(tree, state) @ rates.T).reshape(tree.n, 6, mobility)
    moving[:, 3:] = a @ moving[:, 3:]
    # The world last, where body −1 is.
    motion = np.concatenate([moving.swapaxes(-1, -2), np.zeros((1, mobility, 6))])
    place = np.concatenate([state.r, np.zeros((1, 3))])
    near = state.r + rotate_vectors(a, tree.proximal)

    def at_near_points(body: NDArray[np.intp]) -> Array:
        carried = motion[body, :, :3] + cross(motion[body, :, 3:], (near - place[body])[:, None])
        return np.concatenate([carried / wrench_length(cut.source), motion[body, :, 3:]], axis=-1)

    relative = at_near_points(np.arange(tree.n)) - at_near_points(tree.body[:, 0])
    return np.asarray(np.linalg.norm(relative, axis=(1, 2)) <= NEARLY_CLOSED)


def without_still_rates(model: Model, state: State) -> State:
    """Set rates that the loops do not allow to exactly 0, where rounding or a nearly fitting file left more.

    Args:
        model: the mechanism; a tree is left alone.
        state: a state of it, its loops closed and its rates fitting.

    """
    if not model.has_loops:
        return state
    cut = cut_open(model)
    there = cut.state(state)
    rates, still = minimal_rates(cut.model, there), ~np.any(allowed_rates(cut, there), axis=0)
    if not np.any(rates[still]):
        return state
    return cut.source_state(with_rates(cut.model, there, np.where(still, 0.0, rates)))


def motion_without_inertia(model: Model, state: State) -> int | None:
    """Find a body that can turn without inertia: the mass matrix on the joints' motions is singular then.

    Args:
        state: a state of it, its loops closed.

    Returns:
        The first body without inertia about some axis that has about the largest part in such motions; None
        where there is none.

    """
    if not model.lacks_inertia:
        return None
    cut = cut_open(model)
    tree, there, null = cut.model, cut.state(state), np.eye(rate_count(cut.model))
    if cut.ends:
        held = singular_values(cut, there)[1]
        null = np.linalg.svd(held)[2][len(held) :].T
    M = mass_matrix(tree, there)
    for i, u in enumerate(there.u[tree.rods]):  # a rod has no rate along itself
        M[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += np.max(np.abs(M)) * np.outer(u, u)
    own = null.T @ M @ null
    size = np.sqrt(np.maximum(np.diag(own), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(own / size / size[:, None])
    if values[0] > MIN_MASS_RATIO:
        return None
    free = null @ (vectors[:, values <= MIN_MASS_RATIO] / size[:, None])
    turns = (velocity_jacobian(tree, there) @ free).reshape(tree.n, 6, -1)[cut.place[: model.n], 3:]
    principal = np.linalg.eigvalsh(model.inertia)
    lacking = principal[:, 0] <= ZERO_INERTIA * principal[:, 2]
    # Of several such motions any basis is as good: their norm is that of all, and equal ones are the first's.
    parts = np.where(lacking, np.linalg.norm(turns, axis=(1, 2)), -1.0)
    return int(np.argmax(parts > np.max(parts) / 2))


def loop_gaps(model: Model, state: State) -> tuple[Float[Array, "loops"], Float[Array, "loops"]]:
    """Measure how far the loops of a state are from closed.

    Args:
        model: with L loops.
        state: a state of the tree.

    Returns:
        Largest gap of each [m, rad], and of its rate [m/s, rad/s].

    """
    cut = cut_open(model)
    there = cut.state(state)
    rate = cut.jacobian(there) @ minimal_rates(cut.model, there)
    gaps, rates = (np.max(np.abs(x.reshape(-1, 6)), axis=1) for x in (cut.gap(there), rate))
    return gaps, rates


def smallest_singular_value(model: Model, state: State, rank: int | None = None) -> float:
    """Measure how near a pose is to a singular one, where rows that hold elsewhere depend on the others.

    Args:
        model: with loops.
        state: assembled.
        rank: of the rows at regular poses, as `regular_rank` finds it; absent: at a pose nearby.

    Returns:
        The smallest singular value of J (rows by `row_scale`) of those that are not 0 at regular poses.

    """
    cut = cut_open(model)
    return float(smallest_singular_values(cut, cut.state(state), rank or regular_rank(model, state)))


def smallest_singular_values(cut: CutMechanism, state: State, rank: int) -> Float[Array, "..."]:
    """Measure as `smallest_singular_value`, at states of the tree: arrays may have leading axes."""
    rows = cut.jacobian(state) * cut.row_scale[:, None]
    return np.asarray(np.linalg.svd(rows, compute_uv=False)[..., rank - 1])


def regular_rank(model: Model, state: State) -> int:
    """Count the rows that close the loops and do not depend on others, but at singular poses.

    Args:
        model: with loops.
        state: assembled.

    Returns:
        The rank of J there, or at a pose nearby where it is larger.

    """
    cut = cut_open(model)
    there = cut.state(state)
    base = singular_values(cut, there)[1]
    drawn = np.random.default_rng(0).normal(size=base.shape[1])
    step = drawn - base.T @ (base @ drawn)
    size = float(np.linalg.norm(step))
    nearby = displaced(cut.model, there, np.asarray(NEARBY * step / size)) if size > 1e-6 else there
    return max(len(base), len(singular_values(cut, closed_pose(cut, nearby))[1]))


def keeps_dependent_rows(model: Model, state: State) -> bool:
    """Find out whether rows that depend on the others do so in open poses too, as those out of a plane do.

    Args:
        state: assembled.

    Returns:
        Whether the rows' rank is the same in poses nearby at which the loops are open; True of a tree.

    """
    if not model.has_loops:
        return True
    cut = cut_open(model)
    there = cut.state(state)
    closed = singular_values(cut, there)[1]
    step = np.asarray(NEARBY * np.random.default_rng(0).normal(size=closed.shape[1]))
    return len(singular_values(cut, displaced(cut.model, there, step))[1]) == len(closed)


def is_singular(value: float) -> bool:
    """Return whether a pose counts as singular, so that its accelerations and forces are not unique.

    Args:
        value: its `smallest_singular_value`.

    Returns:
        Whether it is below `MIN_SINGULAR_VALUE`.

    """
    return value < MIN_SINGULAR_VALUE


def singular_values(cut: CutMechanism, state: State) -> tuple[Float[Array, "n"], Float[Array, "rank nu"]]:
    """Return the singular values of J with its rows by `row_scale`.

    Args:
        state: of the tree, its ends together.

    Returns:
        All of them, descending, and the rows that span J's own.

    """
    _, values, rows = np.linalg.svd(cut.jacobian(state) * cut.row_scale[:, None])
    return values, rows[: int(np.sum(values > RANK_TOLERANCE * values[0]))]


def _least_norm(cut: CutMechanism, matrix: Array, right: Array) -> Array:
    scale = cut.row_scale
    return np.asarray(np.linalg.lstsq(matrix * scale[:, None], right * scale, rcond=1e-9)[0])


def _rates_of_source(cut: CutMechanism) -> NDArray[np.intp]:
    """Where the rates of the source are in those of the tree."""
    rods, own = np.cumsum(cut.model.rods) - 1, own_rates(cut.model)
    bodies = cut.place[: cut.source.n]
    swings = [3 * rods[b] + i for b in bodies if cut.model.rods[b] for i in range(3)]
    return np.array([*swings, *(i for b in bodies for i in range(own[b].start, own[b].stop))], np.intp)


def independent_rows(
    matrix: Float[Array, "m n"], scale: Float[Array, "m"] | None = None
) -> Int[Indices, "rank"]:
    """Choose rows that do not depend on others, by a pivoted QR of the scaled rows.

    Args:
        scale: factors of the rows; absent: to unit rows.

    Returns:
        Their numbers, ascending.

    """
    from scipy.linalg import qr  # not in a run's own process

    factor = 1 / np.linalg.norm(matrix, axis=1) if scale is None else scale
    _, triangle, order = qr((matrix * factor[:, None]).T, mode="economic", pivoting=True)
    size = np.abs(np.diagonal(triangle))
    return np.sort(order[: int(np.sum(size > RANK_TOLERANCE * size[0]))])


@lru_cache(maxsize=64)  # adapters reduce many answers at the same states
def determinate_projectors(model: Model, state: State) -> Float[Array, "joints 6 6"] | None:
    """Find what dependent rows leave of each joint's wrench: forces F and moments N/ℓ about the near points.

    Args:
        model: with loops.
        state: assembled.

    Returns:
        Orthogonal projectors, with the length ℓ of `wrench_length`; None where all is determinate.

    """
    cut = cut_open(model)
    there = cut.state(state)
    scale = cut.row_scale
    J = cut.jacobian(there) * scale[:, None]
    left, values, _ = np.linalg.svd(J)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0]))
    if rank == len(J):
        return None
    held = (left[:, rank:] * scale[:, None]).reshape(len(cut.ends), 6, -1)  # λ with Jᵀ λ = 0
    a, n = rotation_matrix(there.p), cut.model.n
    near = there.r + rotate_vectors(a, cut.model.proximal)
    change = np.zeros((n, 6, held.shape[-1]))
    for (b, c), wrench in zip(cut.ends, held, strict=True):
        for body, sign in ((b, 1.0), (c, -1.0)):
            for k in path_to_world(cut.model.body[:, 0], body):
                change[k, :3] += sign * wrench[:3]
                moment = a[b] @ wrench[3:] + cross(there.r[b] - near[k], wrench[:3].T).T
                change[k, 3:] += sign * moment / wrench_length(model)
    projectors = np.tile(np.eye(6), (n, 1, 1))
    for k in range(n):
        vectors, sizes, _ = np.linalg.svd(change[k])
        lost = vectors[:, : len(sizes)][:, sizes > RANK_TOLERANCE * np.max(np.abs(change))]
        projectors[k] -= lost @ lost.T
    return projectors[cut.place]


@lru_cache(maxsize=64)
def wrench_length(model: Model) -> float:
    """Return the length that makes moments comparable with forces.

    Returns:
        ℓ [m], the mean distance of joints from centres of mass.

    """
    return float(np.mean(np.linalg.norm(model.point, axis=2))) or 1.0


def determinate_part(model: Model, state: State, answer: StateQuantities) -> StateQuantities:
    """Reduce the quantities of a mechanism with loops to what is unique.

    Args:
        model: with loops.
        state: assembled.

    Returns:
        The same without the mass matrix, and of joint forces and moments the parts that dependent rows leave
        determinate.

    """
    answer, projectors = replace(answer, mass_matrix=None), determinate_projectors(model, state)
    force, moment = answer.joint_reaction, answer.joint_moment
    if projectors is None:
        return answer
    if force is None or moment is None:
        return replace(answer, joint_reaction=None, joint_moment=None)
    force, moment = determinate_wrenches(model, state, force, moment)
    return replace(answer, joint_reaction=force, joint_moment=moment)


def determinate_wrenches(
    model: Model, state: State, force: Float[Array, "... joints 3"], moment: Float[Array, "... joints 3"]
) -> tuple[Float[Array, "... joints 3"], Float[Array, "... joints 3"]]:
    """Reduce the forces and moments of joints at a state to what is unique; those of trees are."""
    projectors = determinate_projectors(model, state) if model.has_loops else None
    if projectors is None:
        return force, moment
    length = wrench_length(model)
    wrench = rotate_vectors(projectors, np.concatenate([force, moment / length], axis=-1))
    return wrench[..., :3], wrench[..., 3:] * length
