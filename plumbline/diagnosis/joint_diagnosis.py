"""Find the cause of how an engine differs on a mechanism of any joints: a number, or a misreading.

The effect of a cause is that of the changed mechanism on accelerations and joint wrenches, in doubles, added
to the truth; the amount is fitted by least squares in units of the rounding bound.  Every cause that explains
the difference is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from plumbline.diagnosis.force_location import is_spanned, locate_force
from plumbline.diagnosis.joint_causes import ACCEPTED_SHARE, FACTORS, JointCause, joint_causes, vector_causes
from plumbline.diagnosis.joint_prediction import VECTORS, Predictor, Seen
from plumbline.diagnosis.misreadings import Misreading, misreadings, other_branches
from plumbline.diagnosis.row_defects import missing_gammas, row_defects, velocity_terms
from plumbline.equations.responses import EndRows
from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import (
    JointFrame,
    complete_state,
    elastic_energy,
    kinetic_energy_of_rotors,
    rotation_matrix,
)
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.parameter_effects import evaluate_models, evaluate_to_first_order, stack_states
from reference_impl.singular_system import SingularSystem

MAX_STATES = 2  # at which causes are fitted: those of the largest difference
STEP = 1e-4  # of a cause's scale, in differences
MAX_CHECKED = 5  # states at which a cause has to explain what is seen, those of the fit included
MAX_STEPS = 8  # of the least squares
MAX_VECTOR_STEPS = 15  # of those of three numbers
MAX_HALVINGS = 4  # of such a step
MIN_PROGRESS = 0.9  # of what is left, in such a step
MAX_STARTS = 6  # of such fits from small changes, and from large turns: those that explain most
RANK_TOLERANCE = 1e-9  # of slopes: a direction that changes nothing
MIN_SIMILARITY = 0.3  # cosine between the difference and a cause's effect, to be fitted at all
ACCEPTED_RATIO = 4.0  # in bounds
MIN_RATIO_OF_VECTORS = 100.0  # in bounds: three numbers explain a smaller difference by chance
CHECKED_SHARE = 10.0  # of what is accepted, at the states that nothing was fitted to
ELEMENT_MOMENTS = "those of their springs, dampers and efforts"
ENERGIES = ("kinetic_energy", "potential_energy")
QUANTITIES = (*VECTORS, *ENERGIES)
TINY = float(np.finfo(float).tiny)
QUARTER_TURNS = [  # rotation vectors of the turns of a cube, half turns twice
    angle * np.array(axis) / np.linalg.norm(axis)
    for axis in product((-1, 0, 1), repeat=3)
    for angle in ((), (np.pi / 2, np.pi), (np.pi,), (2 * np.pi / 3,))[np.count_nonzero(axis)]
]
LENGTHS = (" m", " rad")  # units of a mechanism's geometry, by which loops may open
UNEXPLAINED = "no single number of a body, a joint, its elements or a spring explains the difference"


class _View(NamedTuple):
    """Which quantities are explained, and how an engine with another mechanism takes a state."""

    quantities: tuple[str, ...]
    are_bodies_kept: bool = False
    end_rows: EndRows = "accelerations"  # of loops that are not closed there


class _Difference:
    """How an engine differs from the truth at some states, and changes of the mechanism, in bounds."""

    def __init__(
        self,
        model: Model,
        reported: Sequence[StateQuantities],
        truth: StateTruth,
        view: _View,
        places: Sequence[int],
    ) -> None:
        names = [q for q in view.quantities if getattr(reported[0], q) is not None]
        weights, off = [], []
        for q, i in ((q, i) for q in names for i in places):
            wrong = np.asarray(getattr(reported[i], q) - getattr(truth.quantities[i], q))
            off.append(wrong.ravel())
            weights.append(np.repeat(truth.bounds[i].tolerance(q), 3 if q in VECTORS else 1))
        self.model, self.names, self.states = model, names, [truth.states[i] for i in places]
        bounds = np.concatenate(weights)
        self.weight, self.view = np.where(bounds > 0, bounds, np.inf), view  # 0 explains nothing
        self.values = np.concatenate(off) / self.weight
        energies = len([q for q in names if q in ENERGIES]) * len(places)
        self.vectors = slice(len(self.values) - energies)  # the energies are the last
        self.accepted = max(ACCEPTED_RATIO, ACCEPTED_SHARE * float(np.max(np.abs(self.values))))
        self.predictor = Predictor(model, self.states, view.are_bodies_kept, view.end_rows)
        self.right = _predict(self.predictor, [Seen(model, state) for state in self.states], names)

    def effect(self, misread: Misreading) -> Array:
        """What an engine that sees another mechanism, or state, returns besides the truth."""
        try:
            seen = [misread(self.model, state) for state in self.states]
            found = _predict(self.predictor, seen, self.names)
        except (np.linalg.LinAlgError, SingularSystem, ValueError):  # no such mechanism
            return np.full(len(self.values), np.inf)
        return np.asarray((found - self.right) / self.weight)

    def left_by(self, misread: Misreading) -> float:
        """What a misreading leaves, in bounds; in loops energies may be right, found from other numbers."""
        left = np.abs(self.values - self.effect(misread))
        energies = slice(self.vectors.stop, None)
        if self.model.has_loops and np.all(np.abs(self.values[energies]) <= ACCEPTED_RATIO):
            left = left[self.vectors]
        return float(np.max(left))

    def of_cause(self, cause: JointCause, x: Array) -> Array:
        """The effect of a cause of one number or three."""
        amount = x if len(x) > 1 else float(x[0])
        return self.effect(lambda model, state: Seen(cause.change(model, amount), state))

    def slopes(self, cause: JointCause, x: Array, there: Array) -> Array:
        """Derivatives (numbers, m) of an effect that is ``there`` at x."""
        steps = STEP * cause.scale * np.eye(len(x))
        return np.stack([(self.of_cause(cause, x + step) - there) / step.sum() for step in steps], axis=1)


def diagnose_joints(model: Model, reported: Sequence[StateQuantities], truth: StateTruth) -> str:
    """Name what explains how an engine differs from the truth on a mechanism of any joints.

    Args:
        reported: what the engine returned at the states of ``truth``.

    Returns:
        A sentence: "behaves as if …" or that no single change explains the difference.

    """
    ratios = {q: _ratios(reported, truth, q) for q in (*QUANTITIES, "angular_momentum", "mass_matrix")}
    wrong = [q.replace("_", " ") for q, values in ratios.items() if np.max(values) > 1]
    order = np.argsort(-np.max([values for q, values in ratios.items() if q in QUANTITIES], axis=0))
    fitted, checked = order[:MAX_STATES].tolist(), _spread(order[MAX_STATES:].tolist())
    every = _Difference(model, reported, truth, _View(QUANTITIES), fitted)
    of_vectors = max(float(np.max(ratios[q])) for q in VECTORS)
    if of_vectors <= 1:
        return _energy_cause(every, reported, truth) or (
            f"accelerations and joint wrenches are right; nothing known explains the {' and '.join(wrong)}"
        )
    if of_vectors <= ACCEPTED_RATIO:
        return (
            f"the difference of the {' and '.join(wrong)} is too close to the rounding bound to name a cause"
        )
    views = [_View(QUANTITIES)]
    if model.has_loops:
        views.append(_View(QUANTITIES, are_bodies_kept=True))
        # an engine's forces that close an open loop act on both ends, its own wrenches count them at one
        views.append(_View((*VECTORS[:2], *ENERGIES), end_rows="twists"))
    elif np.all(np.abs(every.values[every.vectors.stop :]) <= ACCEPTED_RATIO):
        views.append(_View(VECTORS))  # energies that are right may be found from other numbers
    # A fit may fail at the worst states, where causes act least linearly: the first states are tried then.
    first = list(range(len(fitted)))
    fits = [(fitted, checked), (first, _spread([k for k in order.tolist() if k not in first]))]
    for view, fit in product(views, fits if {*first} != {*fitted} else fits[:1]):
        found = _explanations(model, reported, truth, view, *fit)
        if found:
            named, *equal = found
            return f"behaves as if {named}" + (
                f"; the data cannot distinguish this from: {'; '.join(equal)}" if equal else ""
            )
    if model.has_loops:
        return UNEXPLAINED
    return (
        _moment_cause(model, reported, truth)
        or _force_cause(every, reported, truth, [*fitted, *checked])
        or UNEXPLAINED
    )


def _ratios(reported: Sequence[StateQuantities], truth: StateTruth, quantity: str) -> Array:
    """Errors (S,) of a quantity in bounds, of the worst body of each state; 0 where there is none."""
    found = np.zeros(len(reported))
    for i, (answer, true, bound) in enumerate(zip(reported, truth.quantities, truth.bounds, strict=True)):
        value, right = getattr(answer, quantity), getattr(true, quantity)
        if value is None or right is None:
            continue
        off = np.abs(np.asarray(value) - right)
        if quantity in (*VECTORS, "angular_momentum"):
            off = np.linalg.norm(off, axis=-1)
        limit = bound.tolerance(quantity) + (answer.limit_error or {}).get(quantity, 0.0)
        found[i] = np.max(off / np.maximum(limit, TINY))
    return found


def _spread(places: Sequence[int]) -> list[int]:
    """States besides those of the fit, at most `MAX_CHECKED` in all, from the worst to the best."""
    count = min(len(places), MAX_CHECKED - MAX_STATES)
    return [places[i] for i in np.linspace(0, len(places) - 1, count).round().astype(int)] if count else []


def _force_cause(
    every: _Difference, reported: Sequence[StateQuantities], truth: StateTruth, places: Sequence[int]
) -> str:
    """Name the place of unknown forces; only where the energies are right and accelerations are not."""
    if np.any(np.abs(every.values[every.vectors.stop :]) > ACCEPTED_RATIO):
        return ""
    view = _View(tuple(q for q in VECTORS if q in every.names))
    several = _Difference(every.model, reported, truth, view, places)
    accelerations = _Difference(every.model, reported, truth, _View(VECTORS[:2]), places)
    if np.max(np.abs(accelerations.values)) <= ACCEPTED_RATIO:
        return ""
    states = np.tile(np.repeat(np.arange(len(places)), 3 * every.model.n), len(view.quantities))
    found = locate_force(
        every.model, lambda models: _vectors_at(several, models), several.values, states, several.accepted
    )
    if not found:
        values, free = several.values, every.model.free
        rows = {k: [several.effect(one) for one in velocity_terms(k)] for k in np.flatnonzero(~free).tolist()}
        found = [
            f"the velocity term of joint {k + 1} were another"
            for k, some in rows.items()
            if is_spanned(np.stack(some, axis=1), values, states, several.accepted)
        ]
    return f"behaves as if {found[0]}" if len(found) == 1 else ""


def _explanations(
    model: Model,
    reported: Sequence[StateQuantities],
    truth: StateTruth,
    view: _View,
    fitted: Sequence[int],
    checked: Sequence[int],
) -> list[str]:
    """Every cause that explains the quantities of a view, fitted at some states and checked at others."""

    def at(*places: int) -> _Difference:
        return _Difference(model, reported, truth, view, places)

    difference, found = at(*fitted), list[str]()
    others = at(*checked) if checked else difference
    if np.max(np.abs(difference.values[difference.vectors])) <= ACCEPTED_RATIO:
        return []
    is_open = view.end_rows == "twists"  # by a number of the geometry
    causes = [cause for cause in joint_causes(model) if not is_open or cause.unit in LENGTHS]
    for cause in _similar(difference, causes):
        x = _fitted(cause, np.array([cause.nominal]), difference)
        if x is not None and _holds(cause, x, others):
            found.append(cause.describe(float(x[0])))
    first, rows = at(fitted[0]), dict[str, str]()
    is_plain = not view.are_bodies_kept and not is_open
    without_numbers = (*misreadings(model), *row_defects(model)) if is_plain else ()
    for words, misread in missing_gammas(model) if view.are_bodies_kept else without_numbers:
        if first.left_by(misread) > difference.accepted:
            continue  # at half the cost
        if all(one.left_by(misread) <= one.accepted for one in (difference, others)):
            rows.setdefault(words.partition(" along ")[0], words)  # of a joint's rows one is enough
    found += rows.values()
    if not found and model.has_loops and view == _View(QUANTITIES):
        alone = [at(place) for place in fitted]
        found += [
            words for words, poses in other_branches(model) if all(_is_one_of(one, poses) for one in alone)
        ]
    is_large = np.max(np.abs(difference.values)) >= MIN_RATIO_OF_VECTORS
    if not found and is_large and view != _View(VECTORS):  # three numbers explain fewer quantities by chance
        found = _fitted_vectors(difference, others)
    return found


def _is_one_of(difference: _Difference, poses: Sequence[Misreading]) -> bool:
    """Whether nothing, or one of several misreadings, explains the difference."""
    effects = (np.zeros_like(difference.values), *map(difference.effect, poses))
    return any(np.max(np.abs(difference.values - effect)) <= difference.accepted for effect in effects)


def _fitted_vectors(difference: _Difference, others: _Difference) -> list[str]:
    """Causes of three numbers that explain the difference, and that of other states."""
    found: dict[str, str] = {}
    for starts in (_small_changes,) if difference.model.has_loops else (_small_changes, _large_turns):
        for cause, start in starts(difference) if not found else ():
            x = None if cause.subject in found else _fitted(cause, start, difference)
            if x is not None and _holds(cause, x, others):
                found[cause.subject] = cause.describe(x)
    return list(found.values())


def _holds(cause: JointCause, x: Array, others: _Difference) -> bool:
    """Whether a cause with fitted numbers explains the vectors at the states that nothing was fitted to."""
    left = (others.values - others.of_cause(cause, x))[others.vectors]
    return bool(np.all(np.abs(left) <= CHECKED_SHARE * others.accepted))


def _small_changes(difference: _Difference) -> list[tuple[JointCause, Array]]:
    """The causes of three numbers that explain most to first order, from the right numbers on."""
    causes, wanted = list(vector_causes(difference.model)), difference.values[difference.vectors]
    changed = [
        cause.change(difference.model, np.array(cause.nominal) + STEP * cause.scale * e)
        for cause in causes
        for e in np.eye(3)
    ]
    slopes = _vectors_at(difference, changed).reshape(len(causes), 3, -1).mT
    shares = np.matvec(np.linalg.pinv(slopes, RANK_TOLERANCE), wanted)
    left = np.linalg.norm(np.matvec(slopes, shares) - wanted, axis=1)
    return [(causes[i], np.array(causes[i].nominal)) for i in np.argsort(left)[:MAX_STARTS]]


def _large_turns(difference: _Difference) -> list[tuple[JointCause, Array]]:
    """The quarter turns of axes that explain most."""
    turns = [(one, x) for one in vector_causes(difference.model) if one.unit == " rad" for x in QUARTER_TURNS]
    effects = _vectors_at(difference, [cause.change(difference.model, x) for cause, x in turns])
    left = np.linalg.norm(effects - difference.values[difference.vectors], axis=1)
    return [turns[i] for i in np.argsort(left)[:MAX_STARTS]]


def _vectors_at(difference: _Difference, models: Sequence[Model]) -> Array:
    """Effects (models, ·) on accelerations and wrenches, in bounds; all in one batch."""
    if not models:
        return np.zeros((0, difference.vectors.stop))
    stacked, model = stack_states(difference.states), difference.model
    is_kept = difference.view.are_bodies_kept
    cases = [(one, stacked if is_kept else complete_state(one, stacked)) for one in (model, *models)]
    found = (
        evaluate_to_first_order(model, difference.states, cases)
        if model.has_loops
        else evaluate_models(cases)
    )
    parts = [found[q].reshape(len(models) + 1, -1) for q in difference.names if q in VECTORS]
    flat = np.concatenate(parts, axis=1)
    return np.asarray((flat[1:] - flat[0]) / difference.weight[difference.vectors])


def _similar(difference: _Difference, causes: Sequence[JointCause]) -> list[JointCause]:
    """The causes whose effects on the vectors point in the direction of the difference."""
    amounts = [float(np.sum(cause.nominal)) + STEP * cause.scale for cause in causes]
    models = [one.change(difference.model, x) for one, x in zip(causes, amounts, strict=True)]
    slopes = _vectors_at(difference, models)
    if difference.model.has_loops and not difference.view.are_bodies_kept:
        for i, (cause, x) in enumerate(zip(causes, amounts, strict=True)):
            if cause.unit in LENGTHS:  # to first order loops stay closed
                slopes[i] = difference.of_cause(cause, np.array([x]))[difference.vectors]
    wanted = difference.values[difference.vectors]
    sizes = np.linalg.norm(slopes, axis=1) * np.linalg.norm(wanted)
    near = np.abs(slopes @ wanted) > MIN_SIMILARITY * sizes
    return [cause for cause, is_near in zip(causes, near, strict=True) if is_near]


def _fitted(cause: JointCause, start: Array, difference: _Difference) -> Array | None:
    """The x (m,) at which a cause explains the difference; None where it does not.

    It is fitted by Gauss and Newton's method to the vectors.  Of energies more may be left, by what one bound
    in each of the others changes x.
    """
    wanted, vectors, x = difference.values, difference.vectors, start
    there = difference.of_cause(cause, x) if np.any(x != cause.nominal) else np.zeros_like(wanted)
    slopes, left = difference.slopes(cause, x, there), wanted - there
    length = float(np.linalg.norm(left[vectors]))
    inverse: Array = np.asarray(np.linalg.pinv(slopes[vectors], RANK_TOLERANCE), float)
    if np.linalg.norm(slopes[vectors] @ (inverse @ left[vectors])) <= MIN_SIMILARITY * length:
        return None
    if len(x) == 1 and x[0] and cause.can_vanish:
        most = _accepted(difference, slopes, inverse)
        for factor in FACTORS:
            if np.all(np.abs(wanted - difference.of_cause(cause, factor * x)) <= most):
                return np.asarray(factor * x)
    for _ in range(MAX_STEPS if len(x) == 1 else MAX_VECTOR_STEPS):
        step, before = inverse @ left[vectors], length
        for _ in range(1 if len(x) == 1 else MAX_HALVINGS):
            with np.errstate(all="ignore"):
                there = difference.of_cause(cause, x + step)
            left = wanted - there
            length = float(np.linalg.norm(left[vectors]))
            if np.all(np.abs(left) <= _accepted(difference, slopes, inverse)):
                return np.asarray(x + step)
            if length < before / 2 or (len(x) > 1 and length < MIN_PROGRESS * before):
                break
            step = step / 2
        else:  # it converges quadratically near the amount, or the cause is another one
            return None
        x = x + step
        slopes = difference.slopes(cause, x, there)
        inverse = np.asarray(np.linalg.pinv(slopes[vectors], RANK_TOLERANCE), float)
    return None


def _accepted(difference: _Difference, slopes: Array, inverse: Array) -> Array:
    """What may be left of each number, in bounds."""
    most = np.full(len(slopes), difference.accepted)
    energies = slopes[difference.vectors.stop :]
    most[difference.vectors.stop :] += np.abs(energies) @ np.sum(np.abs(inverse), axis=1)
    return most


def _energy_cause(every: _Difference, reported: Sequence[StateQuantities], truth: StateTruth) -> str:
    """Name what an energy leaves out or misreads, where accelerations and wrenches are right; or nothing."""
    model = every.model
    parts: list[tuple[str, str, Callable[[Model, State], float]]] = [
        ("kinetic_energy", "the rotors", kinetic_energy_of_rotors),
        ("potential_energy", "the springs", elastic_energy),
    ]
    for name, what, energy in parts:
        if getattr(reported[0], name) is None:
            continue
        pairs = list(zip(reported, truth.quantities, truth.states, truth.bounds, strict=True))
        off = [getattr(a, name) - getattr(b, name) for a, b, _, _ in pairs]
        bounds = [ACCEPTED_RATIO * float(np.max(bound.tolerance(name))) for *_, bound in pairs]
        if all(abs(x) <= bound for x, bound in zip(off, bounds, strict=True)):
            continue
        shares = [energy(model, state) for _, _, state, _ in pairs]
        for factor, words in ((-1.0, "without"), (1.0, "with twice")):
            if all(abs(x - factor * y) <= b for x, y, b in zip(off, shares, bounds, strict=True)):
                return f"behaves as if it returned the {name.replace('_', ' ')} {words} that of {what}"
    found = _misread_alone(every)
    return f"behaves as if {found}" if found else ""


def _misread_alone(difference: _Difference) -> str:
    """Name the only misreading that explains a difference which is more than rounding, or none."""
    if np.max(np.abs(difference.values)) <= ACCEPTED_RATIO:
        return ""
    found = [
        words
        for words, misread in misreadings(difference.model)
        if np.max(np.abs(difference.values - difference.effect(misread))) <= difference.accepted
    ]
    return found[0] if len(found) == 1 else ""


def _moment_cause(model: Model, reported: Sequence[StateQuantities], truth: StateTruth) -> str:
    """Name the point about which moments of joints are, where nothing else is wrong: λ (near − P) × F."""
    off, sizes, arms = [], [], dict[tuple[str, str], list[Array]]()
    for answer, true, state, bound in zip(
        reported, truth.quantities, truth.states, truth.bounds, strict=True
    ):
        for name in VECTORS:
            wrong = getattr(answer, name)
            if wrong is None:
                return ""
            ratio = np.linalg.norm(wrong - getattr(true, name), axis=1) / bound.tolerance(name)
            if name != "joint_moment" and np.max(ratio) > ACCEPTED_RATIO:
                return ""
        assert true.joint_reaction is not None and true.joint_moment is not None
        near = state.r + np.matvec(rotation_matrix(state.p), model.proximal)
        tree = model.mass @ state.r / np.sum(model.mass)
        points = {"the centres of mass": state.r, "the world's origin": 0 * near,
                  "the centre of mass of the whole": np.broadcast_to(tree, near.shape),
                  "the far points": _far_points(model, state),
                  "the points of the joints that carry welds": _carrying_points(model, near)}  # fmt: skip
        for words, point in points.items():
            lever = np.cross(near - point, true.joint_reaction)
            for kind in ("joint", *dict.fromkeys(model.kind)):
                part = lever * np.array([kind in ("joint", own) for own in model.kind])[:, None]
                arms.setdefault((kind, words), []).append(part.ravel())
        arms.setdefault(("joint", ELEMENT_MOMENTS), []).append(_element_moments(model, state).ravel())
        off.append(np.ravel(np.asarray(answer.joint_moment) - true.joint_moment))
        sizes.append(np.repeat(bound.tolerance("joint_moment"), 3))
    difference, size = np.concatenate(off), np.concatenate(sizes)
    accepted = max(ACCEPTED_RATIO, ACCEPTED_SHARE * float(np.max(np.abs(difference / size))))
    for (kind, words), parts in arms.items():
        lever = np.concatenate(parts)
        factor = float(lever @ difference) / max(float(lever @ lever), 1e-300)
        if np.max(np.abs(difference - factor * lever) / size) <= accepted:
            if words == ELEMENT_MOMENTS:
                kept = "without" if abs(factor + 1) < ACCEPTED_SHARE else f"with {1 + factor:.6g} times"
                return f"behaves as if it returned the moments of joints {kept} {words}"
            if abs(factor - 1) < ACCEPTED_SHARE:
                return f"behaves as if the moments of {kind}s were about {words}"
            return f"behaves as if the arm of {kind} moments to {words} counted {1 - factor:.6g} times"
    return ""


def _carrying_points(model: Model, near: Array) -> Array:
    """Of each weld the near point (N, 3) of the joint within its branch that moves, of others their own."""
    points = near.copy()
    for k, far in enumerate(model.body[:, 0]):
        if model.kinds[k].is_rigid and far >= 0:
            points[k] = points[far]
    return points


def _far_points(model: Model, state: State) -> Array:
    """Where the joints' far points are (N, 3), world frame."""
    far = model.body[:, 0]
    place = state.r[far] + np.matvec(rotation_matrix(state.p[far]), model.point[:, 0])
    return np.where(far[:, None] < 0, model.point[:, 0], place)


def _element_moments(model: Model, state: State) -> Array:
    """Moments (N, 3) of springs, dampers and efforts of the joints' turns; of ball joints none."""
    found, turns = np.zeros((model.n, 3)), rotation_matrix(state.p)
    torque = model.effort - model.stiffness * (state.x - model.rest) - model.damping * state.xdot
    for k, far in enumerate(model.body[:, 0]):
        axes = JointFrame(model, k, turns[far] if far >= 0 else np.eye(3)).axes(state.x[k])
        for i, (what, axis) in enumerate(axes):
            if what == "turn":
                found[k] += torque[k, i] * axis
    return found


def _predict(predictor: Predictor, seen: Sequence[Seen], names: Sequence[str]) -> Array:
    return predictor.predict(seen, names)
