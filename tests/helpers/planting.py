"""Defects with known names and sizes in real engines: the record, ways to alter an engine, the answers.

A defect alters what a real engine is given (mechanism, state), what it returns, how it steps in time, or a
part of its adapter; the engine itself runs.  Numbers of bodies and joints count from 1, as in the results.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pkgutil import resolve_name
from typing import Any
from unittest.mock import patch

import numpy as np

import reference_impl.direct as direct
from plumbline.diagnosis.diagnose import diagnose
from plumbline.engines.adapter import Adapter
from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import RowContext, Verdict
from plumbline.judging.state_level import judge_states
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.measurements.refinement_study import run_refinement_study
from plumbline.model.datatypes import (
    SPRING_FIELDS,
    Array,
    Integrator,
    Model,
    State,
    StateQuantities,
    StepRun,
    Trajectory,
)
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    quaternion_exponential,
    quaternion_product,
    rotation_matrix,
    with_joint_coordinates,
)
from plumbline.model.random_mechanisms import random_loop_mechanism, random_tree
from plumbline.model.sampling import compared_states, random_states
from plumbline.truth.ground_truth import MotionTruth, StateTruth, motion_truth, state_truth
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.pendulums import JOINT_PATTERNS

Inputs = Callable[[Model, State], tuple[Model, State]]
Answers = Callable[[Model, list[State], list[StateQuantities]], list[StateQuantities]]
Run = Callable[[Callable[..., Trajectory], Model, State, Array, Integrator, float], Trajectory]
Patch = Callable[[], AbstractContextManager[Any]]
Term = Callable[[Model, State], Array]
Fields = Callable[[Model, State], dict[str, Array]]
Corrections = Callable[[Model, State, StateQuantities], dict[str, Any]]
EVERY_JOINT = "every joint"  # the mechanism of `every_joint`
RANDOM_LOOP = "random loop"  # in space, closed by a universal joint
ELEMENTS = ("armature", "damping", "stiffness", "effort", "springs")


@dataclass(frozen=True)
class Defect:
    """One planted defect: what is altered in which engine, where it applies, and the cause to be named."""

    name: str
    expected: str = ""  # words that the diagnosis must use; none: it need only be reported
    engine: str = "mujoco"
    mechanism: str = "balls"  # JOINT_PATTERNS, EVERY_JOINT, RANDOM_LOOP, or a scenario
    loaded: bool = False  # a pendulum with applied loads and drag
    integrator: str = "RK4"  # the name that the motion or the step goes by
    inputs: Inputs | None = None
    answers: Answers | None = None
    run: Run | None = None
    patch: Patch | None = None  # of the adapter or the reference, while the engine is built and evaluated
    equal: str = ""  # another cause with the same effect, which the diagnosis must name too


def plant(defect: Defect) -> Adapter:
    """The real adapter with the defect's inputs, answers and run."""
    real = type(load_adapter(defect.engine))

    class Planted(real):  # type: ignore[misc, valid-type]
        is_stepping = False  # what steps simulate is altered once, by `_step`

        def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
            given = [defect.inputs(model, s) if defect.inputs else (model, s) for s in states]
            reported = [super(Planted, self)._evaluate(m, [s])[0] for m, s in given]
            return defect.answers(model, list(states), reported) if defect.answers else reported

        def _simulate(self, *given: Any) -> Trajectory:
            real_run = super()._simulate
            return real_run(*given) if self.is_stepping else altered_run(defect, real_run, *given)

        def _step(self, *given: Any) -> StepRun:
            found = list[StepRun]()

            def real_run(*given: Any) -> Trajectory:
                found.append(super(Planted, self)._step(*given))
                return found[-1].trajectory

            self.is_stepping = True
            try:
                trajectory = altered_run(defect, real_run, *given)
            finally:
                self.is_stepping = False
            return replace(found[-1], trajectory=trajectory) if found else StepRun(trajectory)

    return Planted()


def altered_run(
    defect: Defect, run: Callable[..., Trajectory], model: Model, state: State, *given: Any
) -> Trajectory:
    """A run, or steps, with the defect's inputs and changes."""
    if defect.inputs:
        model, state = defect.inputs(model, state)
    return defect.run(run, model, state, *given) if defect.run else run(model, state, *given)


@contextmanager
def planted(defect: Defect) -> Iterator[Adapter]:
    """The same with the defect's patch."""
    with defect.patch() if defect.patch else nullcontext():
        yield plant(defect)


# --- what is reported -----------------------------------------------------------------------------


@cache
def subject(mechanism: str, loaded: bool = False) -> tuple[Model, StateTruth]:
    """A mechanism, and the certified truth at some states of it."""
    if mechanism in JOINT_PATTERNS:
        model = pendulums.make_model(mechanism, loads=loaded, drag=loaded)
        states = [*random_states(model, 10, seed=1), *identity_states(model)]
    elif mechanism == EVERY_JOINT:
        model = every_joint()
        states = random_states(model, 5, seed=2)
    elif mechanism == RANDOM_LOOP:
        model, state = random_loop_mechanism(3, 6, ("universal",), elements=ELEMENTS)
        states = compared_states(model, state, mechanism, 3)
    else:
        scenario = catalogue_scenario(mechanism)
        model = scenario.model
        states = states_of(scenario, 4)
    return model, state_truth(model, states)


def identity_states(model: Model) -> list[State]:
    """Two states of a chain with the identity attitude: of one body, and of all."""
    *_, first, second = random_states(model, 2, seed=3)
    identity = np.array([1.0, 0, 0, 0])
    odd = np.where(np.arange(model.n)[:, None] % 2, second.p, identity)
    attitudes = (first, odd), (second, np.tile(identity, (model.n, 1)))
    return [complete_state(model, replace(state, p=p)) for state, p in attitudes]


def every_joint() -> Model:
    """Five bodies on every joint that moves, in one branch, with elements on every coordinate."""
    rng = np.random.default_rng(11)
    tree = random_tree(rng, 5, elements=ELEMENTS)
    kinds = ("ball", "hinge", "universal", "slide", "cylindrical")
    bare = replace(tree, kind=kinds, body=np.array([[-1, 0], [0, 1], [1, 2], [2, 3], [1, 4]]))
    used = np.array([[1, 0], [1, 0], [1, 1], [1, 0], [1, 1]])
    fields: dict[str, Array] = {
        name: np.where(used, rng.uniform(0.2, 2.0, (5, 2)), 0.0)
        for name in ("armature", "damping", "stiffness")
    }
    fields |= {name: np.where(used, rng.normal(size=(5, 2)), 0.0) for name in ("rest", "effort")}
    fields["rest"][0] = fields["effort"][0] = 0.0
    is_at_origin = np.all(bare.point == 0, axis=2, keepdims=True)
    point = np.where(is_at_origin, 0.3 * rng.normal(size=(5, 2, 3)), bare.point)
    springs = {name: getattr(bare, name)[:2] for name in SPRING_FIELDS}
    springs["spring_body"] = np.array([[-1, 3], [2, 4]])
    return bare.changed(point=point, length=np.zeros(5), **fields, **springs)


@cache
def evaluated(defect: Defect) -> tuple[list[StateQuantities], list[str]]:
    """What the engine with the defect returns, and the quantities that disagree at state level."""
    model, truth = subject(defect.mechanism, defect.loaded)
    with planted(defect) as engine:
        reported = engine.evaluate(model, truth.states)
    context = RowContext("planted", "planted", defect.name, defect.name, "0")
    rows = judge_states(context, truth, Evaluation(reported)).rows
    return reported, [row.quantity for row in rows if row.verdict == "disagrees"]


@cache
def diagnosis(defect: Defect) -> str:
    """What the diagnosis says about a defect; empty where nothing disagrees."""
    model, truth = subject(defect.mechanism, defect.loaded)
    reported, wrong = evaluated(defect)
    if not wrong:
        return ""
    with planted(defect) as engine:  # of chains with the engine, asked again for digits and where it persists
        return diagnose(model, reported, truth, engine.evaluate if model.has_chain_joints else None).text


def assert_named(defect: Defect) -> None:
    """The diagnosis names the defect, and of other causes those with the same effect alone."""
    text = diagnosis(defect)
    assert defect.expected in text and defect.equal in text, f"{defect.name}: {text!r}"
    if defect.equal or defect.mechanism not in JOINT_PATTERNS:
        assert ("cannot distinguish" in text) == bool(defect.equal), text


@cache
def motion_subject(mechanism: str, loaded: bool = False) -> tuple[Model, State, MotionTruth]:
    """A mechanism with a motion that shows every mistake within a second or two."""
    if mechanism in JOINT_PATTERNS:  # a slow tumble
        model = pendulums.make_model(mechanism, loads=loaded, drag=loaded)
        state, times = pendulums.state_from_seed(model, seed=2, rate=0.5), np.linspace(0, 2, 17)
    else:  # a quarter as many samples do not resolve the work of a damper
        scenario = catalogue_scenario(mechanism)
        model, state, times = scenario.model, scenario.state, np.arange(65) / 64
    return model, state, motion_truth(model, state, times, None)


@cache
def motion_report(defect: Defect) -> frozenset[tuple[Verdict, str]]:
    """Verdicts and quantities about motion that need attention; unresolved cells fail a run, too."""
    model, state, truth = motion_subject(defect.mechanism, defect.loaded)
    with planted(defect) as engine, patch("plumbline.engines.engine_calls.load_adapter", lambda _: engine):
        integrator = engine.integrator(defect.integrator)
        steps = refinement_resolutions(integrator, model.n, float(truth.trajectory.t[-1]))
        runs = run_refinement_study(defect.engine, integrator.name, model, state, truth.trajectory.t, steps)
    context = RowContext("planted", "planted", defect.name, defect.name, "0")
    rows = judge_trajectory(context, model, truth, integrator, runs).rows
    return frozenset((row.verdict, row.quantity) for row in rows if row.verdict.needs_attention)


# --- ways to alter what the engine is given -----------------------------------------------------------


def number_change(
    field: str,
    *at: Any,
    by: float = 0.0,
    times: float = 1.0,
    to: Callable[[Any], Any] | None = None,
    are_bodies_moved: bool = True,
) -> Inputs:
    """Some numbers of a field altered, a product of inertia on both sides; or the whole field.

    The state has the same coordinates of joints, or the same positions of bodies.
    """

    def alter(model: Model, state: State) -> tuple[Model, State]:
        value = getattr(model, field).copy()
        for place in {at, (*at[:1], *at[:0:-1])} if field == "inertia" else (at,):
            value[place] = to(value[place]) if to else value[place] * times + by
        if field == "turn":
            value = value / np.linalg.norm(value, axis=-1, keepdims=True)
        wrong = model.changed(**{field: value})
        return wrong, complete_state(wrong, state) if are_bodies_moved else state

    return alter


def model_change(change: Fields) -> Inputs:
    """Fields of the model replaced, depending on the state or not."""

    def alter(model: Model, state: State) -> tuple[Model, State]:
        wrong = model.changed(**change(model, state))
        return wrong, complete_state(wrong, state)

    return alter


def state_change(change: Fields) -> Inputs:
    """Minimal coordinates of the state replaced."""
    return lambda model, state: (model, complete_state(model, replace(state, **change(model, state))))


def with_row(k: int, right: Array, wrong: Array) -> Array:
    """Row k of the second, the other rows of the first."""
    out = np.array(right)
    out[k] = wrong[k]
    return out


def body_change(k: int, **change: Term) -> Inputs:
    """Fields of the model replaced in the row of one body."""
    return model_change(lambda m, s: rows_changed(k, m, {name: f(m, s) for name, f in change.items()}))


def body_state_change(k: int, **change: Term) -> Inputs:
    """Minimal coordinates of one body replaced."""
    return state_change(lambda m, s: rows_changed(k, s, {name: f(m, s) for name, f in change.items()}))


def rows_changed(k: int, holder: Model | State, wrong: dict[str, Array]) -> dict[str, Array]:
    """Row k of some fields replaced."""
    return {name: with_row(k, getattr(holder, name), value) for name, value in wrong.items()}


def when(condition: Callable[[Model, State], bool], change: Inputs) -> Inputs:
    """A change in a branch that is rarely taken."""
    return lambda m, s: change(m, s) if condition(m, s) else (m, s)


def added_moment(extra: Term, *bodies: int) -> Inputs:
    """A moment (N, 3) in body axes on some bodies, or on all."""

    def change(model: Model, state: State) -> dict[str, Array]:
        on = np.isin(np.arange(model.n), bodies)[:, None] if bodies else True
        return {"moment": model.moment + np.where(on, extra(model, state), 0.0)}

    return model_change(change)


def turned_by(*vector: float) -> Callable[[Array], Array]:
    """A quaternion turned by a rotation vector, in the axes themselves."""
    half = quaternion_exponential(np.array(vector) / 2)
    return lambda q: quaternion_product(q, half)


# --- ways to alter what it returns ------------------------------------------------------------------


def recomputed(change: Corrections) -> Answers:
    """Quantities recomputed from model, state and the other answers."""
    return lambda m, states, reported: [
        replace(a, **change(m, s, a)) for s, a in zip(states, reported, strict=True)
    ]


def answer_change(name: str, change: Callable[[Model, State, Any], Any]) -> Answers:
    """One quantity of each answer altered."""
    return recomputed(lambda m, s, a: {name: change(m, s, getattr(a, name))})


def body_answer_change(k: int, name: str, change: Callable[[Model, State, Array], Array]) -> Answers:
    """One quantity of one body altered in each answer."""
    return answer_change(name, lambda m, s, x: with_row(k, x, change(m, s, x)))


def stale_answers(*names: str, body: int | None = None) -> Answers:
    """Quantities, of all bodies or of one, still hold what they were at the state before."""

    def alter(_: Model, __: list[State], reported: list[StateQuantities]) -> list[StateQuantities]:
        pairs = zip(reported, [reported[-1], *reported[:-1]], strict=True)
        rows = slice(None) if body is None else body
        return [
            replace(a, **{n: with_row(rows, getattr(a, n), getattr(b, n)) for n in names}) for a, b in pairs
        ]

    return alter


def without(*names: str) -> Answers:
    """The engine does not return some quantities."""
    return recomputed(lambda *_: dict.fromkeys(names))


def noise_growing(base: float, size: float) -> Callable[[Model, State, Array], Array]:
    """Relative noise that depends on every bit of the state and grows from body to body."""

    def noisy(model: Model, state: State, x: Array) -> Array:
        bits = state.p.tobytes() + state.omega.tobytes() + model.gravity.tobytes()
        rng = np.random.default_rng(zlib.crc32(bits))
        return np.asarray(x * (1 + size * base ** np.arange(len(x))[:, None] * rng.normal(size=x.shape)))

    return noisy


# --- ways to alter a run ----------------------------------------------------------------------------


def run_as(integrator: str) -> Run:
    """Another integrator of the same engine."""
    return lambda simulate, model, state, times, i, h: simulate(
        model, state, times, replace(i, name=integrator), h
    )


def run_with_clock(factor: float) -> Run:
    """Time and steps times a factor; the sample times are the requested ones."""
    return lambda simulate, model, state, times, i, h: replace(
        simulate(model, state, times * factor, i, h * factor), t=times
    )


def rows_reordered(rows: Callable[[int], list[int]]) -> Run:
    """Rows of the trajectory taken from others, the times as requested."""
    return sample_change(lambda run: {k: getattr(run, k)[rows(len(run.t))] for k in ("r", "p", "v", "pdot")})


def sample_change(change: Callable[[Trajectory], dict[str, Array]]) -> Run:
    """Columns of the trajectory replaced."""

    def alter(simulate: Any, *arguments: Any) -> Trajectory:
        run = simulate(*arguments)
        return replace(run, **change(run))

    return alter


# --- ways to alter an adapter or the reference ----------------------------------------------------------


def built_with(owner: str, part: str, name: str, value: Any) -> Patch:
    """An array in the engine's own model replaced as soon as the adapter has built it."""

    @contextmanager
    def patched() -> Iterator[None]:
        build = resolve_name(f"{owner}.__init__")

        def altered(self: Any, *arguments: Any, **options: Any) -> None:
            build(self, *arguments, **options)
            target = getattr(self, part)
            setattr(target, name, np.broadcast_to(value, np.shape(getattr(target, name))).copy())

        with patch.object(resolve_name(owner), "__init__", altered):
            yield

    return patched


def replaced_by(name: str, make: Callable[[Any], Any]) -> Patch:
    """An attribute of a module or class, "module:attribute", replaced by what is made of it."""
    place, attribute = name.rpartition("." if "." in name.partition(":")[2] else ":")[::2]
    return lambda: patch.object(resolve_name(place), attribute, make(resolve_name(name)))


def wrong_gamma(change: Callable[[Model, State, direct.ConstraintRows], Array]) -> Patch:
    """Another γ (c,) of the reference's rows."""

    def make(right: Callable[..., direct.ConstraintRows]) -> Callable[..., direct.ConstraintRows]:
        def rows(model: Model, r: Array, p: Array, v: Array, pdot: Array) -> direct.ConstraintRows:
            found = right(model, r, p, v, pdot)
            state = State(p, angular_velocity(p, pdot), 0 * r, 0 * r, r, v)
            return replace(found, gamma=change(model, state, found))

        return rows

    return replaced_by("reference_impl.direct:constraint_rows", make)


def added_gamma(extra: Term) -> Patch:
    """Something (c,) added to γ of a chain's rows."""
    return wrong_gamma(lambda m, s, rows: rows.gamma + extra(m, with_joint_coordinates(m, s)))


def without_gamma(*joints: int) -> Patch:
    """γ of some joints is 0."""
    return wrong_gamma(lambda _, __, rows: np.where(np.isin(rows.joint, joints), 0.0, rows.gamma))


# --- quantities of a state ------------------------------------------------------------------------------


def to_world(state: State, vectors: Array) -> Array:
    """A x of each body."""
    return np.asarray((rotation_matrix(state.p) @ vectors[..., None])[..., 0])


def to_body(state: State, vectors: Array) -> Array:
    """Aᵀ x of each body."""
    return np.asarray((rotation_matrix(state.p).mT @ vectors[..., None])[..., 0])


def normalised(p: Array) -> Array:
    """Unit vectors."""
    return np.asarray(p / np.linalg.norm(p, axis=-1, keepdims=True))


def body_spins(model: Model, state: State) -> Array:
    """J ω′ of each body (N, 3)."""
    return np.asarray((model.inertia @ state.omega[..., None])[..., 0])


def gyroscopic_moment(model: Model, state: State) -> Array:
    """ω′ × J ω′ (N, 3)."""
    return np.cross(state.omega, body_spins(model, state))
