"""Terms of the equations whose effect is linear: velocity terms, rows of joints, loops, unknown forces.

Their effects follow from the responses of the right mechanism to unit wrenches and unit accelerations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plumbline.diagnosis.cause import Cause
from plumbline.diagnosis.edits import Edit, at_place, coordinate_place
from plumbline.diagnosis.prediction import VECTORS, Answers, Predictor
from plumbline.equations.responses import EndRows, Responses
from plumbline.model.datatypes import Array, Model
from plumbline.model.kinematics import cross, rotation_matrix
from plumbline.model.loops import cut_open

NOT_HELD = 1e-9  # of a direction: what the joint holds of it
MAX_CONDITION = 1e14  # of the inertia that released directions have
RANK_TOLERANCE = 1e-9  # of effects: a force that changes nothing


class Terms:
    """Effects of terms at the states of a predictor."""

    def __init__(self, predictor: Predictor) -> None:
        """Solve the right mechanism and its responses."""
        self.predictor, self.model = predictor, predictor.case.model
        cut = cut_open(self.model)
        self.joints = cut.place  # where joint k is in the tree
        self.ends, self.scale = cut.ends, cut.row_scale
        self.tree, self.state = cut.model, cut.state(predictor.case.state)
        self.found = self._solved(self.ends, "accelerations")
        self._responses = self.found.to_joints()  # (S, N, 4, 3, c)
        first = np.cumsum([0, *(held.shape[-1] for held in self.found.held)])
        self._columns = [slice(first[k], first[k + 1]) for k in range(len(first) - 1)]

    def _solved(self, ends: Sequence[tuple[int, int]], end_rows: EndRows) -> Responses:
        return Responses(self.tree, self.state, ends, self.scale[: 6 * len(ends)], end_rows)

    def answers(self, change: Array) -> Answers:
        """Turn changes (S, N, 4, 3) of the solution into those of the mechanism's vectors."""
        return self.predictor.vectors(change, self.found.tree, self.joints, self.predictor.projectors)

    def linear(self) -> Iterator[tuple[Cause, Answers]]:
        """List velocity terms, with the effect of one more of each."""
        own = self.found.velocity_terms()  # (S, N, 6)
        near, far = np.zeros_like(own), np.zeros_like(own)
        omega, arm, far_arm = self.found.omega, self.found.arm, self.found.far_arm
        near[..., :3] = -cross(omega, cross(omega, arm))
        for k, body in enumerate(self.found.far):
            if body >= 0:
                w = omega[:, body]
                far[:, k, :3] = cross(w, cross(w, far_arm[:, k]))
        parts = {
            "velocity term": own,
            "velocity term of the near body": near,
            "velocity term of the far body": far,
            "velocity term of the joint's own motion": own - near - far,
        }
        for term, part in parts.items():
            effects = {}
            for k in range(len(self.model.kind)):
                at = self.joints[k]
                along = np.matvec(self.found.held[at].mT, part[:, at])
                if np.max(np.abs(along), initial=0.0) > NOT_HELD * max(float(np.max(np.abs(own))), 1e-300):
                    effects[k] = np.matvec(self._responses[..., self._columns[at]], along[:, None, None])
            yield from self._of_joints(effects, Cause("term", term, nominal=(1.0,), unit="×"))

    def _of_joints(self, effects: dict[int, Array], cause: Cause) -> Iterator[tuple[Cause, Answers]]:
        """One cause at each joint, and at all where there are several, with the effects."""
        places = {f"joint {k + 1}": effect for k, effect in effects.items()}
        if len(effects) > 1:
            places["all joints"] = np.sum(list(effects.values()), axis=0)
        for place, effect in places.items():
            yield replace(cause, place=place), self.answers(effect)

    def _dampers_about_one_axis(self) -> Iterator[tuple[Cause, Answers]]:
        """Dampers of joints with all turns that act about one axis of the body alone."""
        kinds, damping = self.model.kinds, self.model.damping[:, 0]
        damped = [k for k, kind in enumerate(kinds) if kind.is_spherical and damping[k]]
        turns, omega = rotation_matrix(self.state.p), self.found.omega
        for i, axis in enumerate("xyz" if damped else ""):
            effects = {}
            for k in damped:
                at = int(self.joints[k])
                far, along = self.found.far[at], turns[:, at, :, i]
                spin = omega[:, at] - (omega[:, far] if far >= 0 else 0.0)
                lost = damping[k] * (spin - np.vecdot(spin, along)[:, None] * along)
                effects[k] = np.matvec(self._moments_between(k), lost[:, None, None])
            yield from self._of_joints(effects, Cause("term", "damping", "", f"about the {axis} axis alone"))

    def fixed(self) -> Iterator[tuple[Cause, Answers]]:
        """List rows, joints, loops and parts of dampers that may be left out, with the effect."""
        yield from self._dampers_about_one_axis()
        for k, kind in enumerate(self.model.kinds):
            if kind.holds_nothing:
                continue
            for term, directions in self._rows(k):
                change = self._released(int(self.joints[k]), directions)
                if change is not None:
                    yield Cause("term", term, f"joint {k + 1}", "left out"), self.answers(change)
        for loop in range(len(self.ends)):
            ends = [pair for i, pair in enumerate(self.ends) if i != loop]
            change = self._solved(ends, "accelerations").solution - self.found.solution
            place = f"joint {self.model.n + loop + 1}"
            yield Cause("term", "loop", place, "left open"), self.answers(change)
        for way in open_end_rows(self.tree) if self.ends else ():
            change = self._solved(self.ends, way).solution - self.found.solution
            place = "the rows that close loops"
            cause = Cause("term", "velocity terms", place, "missing", general=f"velocity terms of {place}")
            yield cause, self.answers(change)

    def _rows(self, k: int) -> Iterator[tuple[str, Array]]:
        """Rows of the table of kinds: of points along axes of several frames, of attitudes about u × w."""
        model, S = self.model, self.predictor.count
        far, near = model.body[k]
        turns = rotation_matrix(self.predictor.case.state.p)
        above = turns[:, far] if far >= 0 else np.broadcast_to(np.eye(3), (S, 3, 3))
        joint = rotation_matrix(model.turn[k])
        frames = {
            "ijk": np.broadcast_to(np.eye(3), (S, 3, 3)),
            "xyz": above @ joint[0],
            "XYZ": turns[:, near] @ joint[1],
        }
        axes = {name: frame[..., i] for names, frame in frames.items() for i, name in enumerate(names)}
        yield "rows", np.broadcast_to(np.eye(6), (S, 6, 6))
        for u, w in model.kinds[k].rows:
            if u == "d":
                continue
            if w == "d":
                names = ("xyz"["ijk".index(u)], u, "XYZ"["ijk".index(u)]) if u in "ijk" else (u,)
                for name in names:
                    yield f"row along {name}", np.concatenate([axes[name], 0 * axes[name]], -1)[..., None]
            else:
                about = np.cross(axes[u], axes[w])
                yield f"row along {u} × {w}", np.concatenate([0 * about, about], -1)[..., None]

    def _released(self, joint: int, directions: Array) -> Array | None:
        """Let a joint move in directions (S, 6, m): by as much as makes its wrench there 0."""
        solution = self.found.solution.copy()
        for s, own in enumerate(self.found.held[joint]):
            lost, sizes, _ = np.linalg.svd(own.T @ directions[s])
            free = lost[:, : int(np.sum(sizes > NOT_HELD))]
            if not free.shape[1]:
                return None
            along = np.zeros((self._responses.shape[-1], free.shape[1]))
            along[self._columns[joint]] = free
            wrench = np.zeros((free.shape[1], 6 * self.tree.n))
            wrench[:, 6 * joint : 6 * joint + 6] = (own @ free).T
            indeterminate = self.found.indeterminate[s]
            left = wrench @ indeterminate  # released where others hold as well, a joint does not move
            _, sizes, rows = np.linalg.svd(left.T)
            moving = rows[int(np.sum(sizes > NOT_HELD)) :].T
            responses = self._responses[s]
            of_joints = responses[:, 2:].reshape(6 * self.tree.n, -1) @ along
            inertia = moving.T @ wrench @ of_joints @ moving
            if inertia.size and (not np.all(np.isfinite(inertia)) or np.linalg.cond(inertia) > MAX_CONDITION):
                return None  # a body can turn without inertia
            amounts = np.linalg.solve(inertia, -moving.T @ (wrench @ solution[s, :, 2:].ravel()))
            solution[s] += responses @ (along @ moving @ amounts)
            balance = np.linalg.lstsq(left, -(wrench @ solution[s, :, 2:].ravel()), NOT_HELD)[0]
            solution[s, :, 2:] += (indeterminate @ balance).reshape(-1, 2, 3)
        return np.asarray(solution - self.found.solution)

    @cached_property
    def _moments(self) -> Array:
        """Responses (S, N, 4, 3, N, 3) to unit moments on the bodies."""
        return self.found.to_wrenches()[..., 1, :]

    def _moments_between(self, k: int) -> Array:
        """Responses (S, N, 4, 3, 3) to unit moments that a joint applies to its bodies, world axes."""
        at = int(self.joints[k])
        far = self.found.far[at]
        units = self._moments[..., at, :] - (self._moments[..., far, :] if far >= 0 else 0.0)
        units[:, at, 3] += np.eye(3)  # they are a part of the joint's moment
        return units

    def unit_moments(self, k: int) -> list[Answers]:
        """Return the effects of unit moments that a joint applies to its bodies."""
        return [self.answers(one) for one in np.moveaxis(self._moments_between(k), -1, 0)]

    def unit_velocity_terms(self, k: int) -> list[Answers]:
        """Return the effects of unit accelerations that velocities might cause at a joint."""
        at = self._columns[self.joints[k]]
        return [self.answers(self._responses[..., i]) for i in range(at.start, at.stop)]


def open_end_rows(tree: Model) -> list[EndRows]:
    """Return how rows that close loops may lack their velocity terms, which depend on the coordinates."""
    has_rods = any(kind.holds_distance for kind in tree.kinds)
    return ["without velocity terms", *(("without those of rods as bodies",) if has_rods else ())]


def missing_gammas(predictor: Predictor) -> Iterator[tuple[Cause, Answers]]:
    """List γ of rows of joints that an engine in maximal coordinates may leave out, with the effect."""
    at = list(predictor.each_state(predictor.case))
    joints = [k for k, is_free in enumerate(predictor.case.model.free) if not is_free]
    places = {f"joint {k + 1}": [k] for k in joints} | ({"all joints": joints} if joints[1:] else {})
    for place, some in places.items():
        answers = predictor.of_bodies(at, some)
        change = {name: answers[name] - predictor.right[name] for name in VECTORS}
        yield Cause("term", "γ of the rows", place, "missing"), change


# -- unknown forces ------------------------------------------------------------------------------------


def force_places(
    model: Model, moments_in: Callable[[int], list[Edit]]
) -> Iterator[list[tuple[Cause, list[Edit]]]]:
    """List the places of forces by the number of amounts that are unknown at a state.

    Args:
        model: a tree.
        moments_in: lists edits by unit moments between the bodies of a joint.

    Yields:
        Causes, each with edits by a unit of its forces: of one amount, of all springs together, of two
        amounts, of three and of six.

    """

    def unit(name: str, at: tuple[int, ...]) -> Edit:
        value = float(getattr(model, name)[at])
        return Edit(Cause("number", name), lambda case, _: at_place(name, at)(case, np.array([value + 1.0])))

    def another(term: str, place: str) -> Cause:
        return Cause("term", term, place, "another at each state")

    single, joints, balls = (list[tuple[Cause, list[Edit]]]() for _ in range(3))
    for k, kind in enumerate(model.kinds):
        for i, (what, _) in enumerate(kind.motions):
            term = "force" if what == "slide" else "torque"
            single.append((another(term, coordinate_place(model, k, i)), [unit("effort", (k, i))]))
        if kind.is_spherical:
            balls.append((another("moment", f"joint {k + 1}"), moments_in(k)))
        if len(kind.motions) > 1:
            efforts = [edit for _, (edit,) in single[-len(kind.motions) :]]
            joints.append((another("efforts", f"joint {k + 1}"), efforts))
    springs = [unit("spring_stiffness", (i,)) for i in range(len(model.spring_body))]
    single += [(another("force", f"spring {i + 1}"), [one]) for i, one in enumerate(springs)]
    yield single
    if len(springs) > 1:
        yield [(another("forces", "the springs between points"), springs)]
    yield joints
    loads = {
        name: [[unit(name, (k, i)) for i in range(3)] for k in range(model.n)] for name in ("force", "moment")
    }
    on_bodies = [(another(name, f"body {k + 1}"), loads[name][k]) for name in loads for k in range(model.n)]
    if model.n == 1:  # a force and a moment on the only body explain any accelerations and wrenches
        if balls:
            yield on_bodies[1:] + balls
        return
    yield on_bodies + balls
    if 1 < len(balls) < model.n:  # moments in all joints are moments on all bodies
        yield [(another("moments", "the ball joints"), [one for _, some in balls for one in some])]
    both = [loads["force"][k] + loads["moment"][k] for k in range(model.n)]
    yield [(another("force and moment", f"body {k + 1}"), some) for k, some in enumerate(both)]


def is_spanned(basis: Array, wanted: Array, states: NDArray[np.intp], accepted: float) -> bool:
    """Decide whether some amounts at each state leave nothing of a difference.

    Args:
        basis: effects (m, amounts), in bounds.
        wanted: the difference (m,) in bounds.
        states: (m,) the state of each of its numbers.
        accepted: what may be left of it, in bounds.

    """
    for state in np.unique(states):
        here, there = basis[states == state], wanted[states == state]
        size = np.max(np.abs(here), axis=0)
        here = here[:, size > 0] / size[size > 0]
        amounts = np.linalg.lstsq(here, there, rcond=RANK_TOLERANCE)[0]
        if np.max(np.abs(there - here @ amounts)) > accepted:
            return False
    return True
