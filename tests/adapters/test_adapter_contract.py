"""What every registered engine must do, whichever it is: one contract, in the engine's own process."""

from __future__ import annotations

import ctypes
import time
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from pebble import ProcessExpired

from plumbline.engines.registry import ENGINES
from plumbline.model import kinematics
from plumbline.model.datatypes import BadInput, EngineFailure, Integrator, Model, State, Unsupported
from tests.helpers import engine_process as worker
from tests.helpers import newton_euler, pendulums
from tests.helpers.pendulums import JOINTS

# What an engine need not deliver: quantities it leaves out, kinds of case it calls unsupported.
# Everything else it must, and an entry that it does deliver must go.
GAPS: dict[str, set[str]] = {
    "reference-printed": {joints for joints, kinds in JOINTS.items() if "b" in kinds or len(kinds) > 2},
    "exudyn-tree": {"joint_reaction"},
    # State level only: the same engine, another algorithm for the accelerations.
    "pinocchio-aba": {"integrators"},
    "pinocchio-maximal": {"integrators"},
}

STATES = 6
STEP = 2.0**-7  # s, for runs whose accuracy does not matter
TIMES = np.arange(9) / 16  # s


@pytest.fixture(scope="module", params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    """The name of an engine that is installed."""
    try:
        worker.call(request.param, "version")
    except ImportError as missing:
        pytest.skip(f"{request.param} is not installed: {missing}")
    return str(request.param)


# -- what it says of itself --------------------------------------------------------------------


def test_says_what_it_is(engine):
    assert worker.attribute(engine, "name") == engine
    assert worker.attribute(engine, "title") and worker.attribute(engine, "package")
    assert worker.call(engine, "version")[0].isdigit()
    methods: tuple[Integrator, ...] = worker.attribute(engine, "integrators")
    names = [method.name for method in methods]
    assert (not names) == ("integrators" in GAPS.get(engine, ())), "the list of gaps is wrong"
    assert len(set(names)) == len(names)
    for method in methods:
        assert method.alias_of is None or method.alias_of in names
        assert method.note, f"{method.name} has no sentence that says what it is"
        if method.kind == "step":
            assert method.error_exponents[0] == method.order and list(method.error_exponents) == sorted(
                set(method.error_exponents)
            )
    with pytest.raises(KeyError, match=names[0] if names else engine):
        worker.call(engine, "simulate", *still(), TIMES, "no such method", STEP)


# -- state level -------------------------------------------------------------------------------


@cache
def truths(joints: str, loaded: bool) -> tuple[Model, list[State], list[newton_euler.Truth]]:
    subject = pendulums.model(JOINTS[joints], loads=loaded, drag=loaded)
    states = [pendulums.state(subject, seed) for seed in range(STATES)]
    return subject, states, [newton_euler.solve(subject, at) for at in states]


def gaps_of(engine, *kinds):
    """Those of the kinds of case that are on the engine's list of gaps."""
    return GAPS.get(engine, set()) & set(kinds)


def one_body(engine):
    """A pendulum of one body that the engine supports: on a ball joint, or else on a rod."""
    return pendulums.model("r" if gaps_of(engine, "ball") else "b")


def evaluated(engine, subject, states, *kinds):
    """The engine's answers; an "unsupported" one must be on the list of gaps, and be a sentence."""
    try:
        answers = worker.call(engine, "evaluate", subject, states)
    except Unsupported as reason:
        assert gaps_of(engine, *kinds), f"{engine} does not do {kinds}: {reason}"
        assert len(str(reason).split()) > 3
        return None
    gaps = gaps_of(engine, *kinds)
    assert not gaps, f"{engine} does {gaps} after all: take it off the list of gaps"
    return answers


def close(got, expected, scale, what, relative):
    """‖got − expected‖∞ ≤ relative · scale."""
    error = np.max(np.abs(np.asarray(got) - expected))
    assert error <= relative * scale, (
        f"{what}: off by {error:.3e}, {error / scale:.1e} relative\n{got}\n{expected}"
    )


def agrees(engine, answer, name, expected, scale, relative=1e-11):
    """A state quantity is delivered, or on the list of gaps; delivered, it is close."""
    got = getattr(answer, name)
    assert (got is None) == (name in GAPS.get(engine, ())), f"{engine} and {name}: the list of gaps is wrong"
    if got is not None:
        close(got, expected, scale, name, relative)


@pytest.mark.parametrize("loaded", [False, True], ids=["free", "loads and drag"])
@pytest.mark.parametrize("joints", JOINTS)
def test_states_obey_newton_and_euler(engine, joints, loaded):
    subject, states, truth = truths(joints, loaded)
    answers = evaluated(engine, subject, states, joints, *["loads"] * loaded)
    # Conditioning allows 1e-11 of the largest acceleration or force in the chain: masses and inertias
    # are within a factor of 4.  Plain sums and products of the inputs allow more.
    g, weight = np.linalg.norm(subject.gravity), np.linalg.norm(subject.gravity) * subject.mass.sum()
    levers = np.cumsum(0.5 + subject.length)
    for at, true, got in zip(states, truth, answers or [], strict=False):
        agrees(engine, got, "acceleration", true.acceleration, max(g, np.abs(true.acceleration).max()))
        turn = max(g / 0.25, np.abs(true.angular_acceleration).max())
        agrees(engine, got, "angular_acceleration", true.angular_acceleration, turn)
        force = max(weight, np.abs(true.joint_reaction).max())
        agrees(engine, got, "joint_reaction", true.joint_reaction, force)
        energy, height = newton_euler.kinetic(subject, at), newton_euler.potential(subject, at)
        agrees(engine, got, "kinetic_energy", energy, energy, 1e-12)
        agrees(engine, got, "potential_energy", height, g * subject.mass @ levers, 1e-13)
        momentum = newton_euler.angular_momentum(subject, at)
        size = np.sum(subject.mass * levers * np.linalg.norm(at.v, axis=1))
        agrees(engine, got, "angular_momentum", momentum, size, 1e-12)
        M = newton_euler.mass_matrix(subject, at)
        agrees(engine, got, "mass_matrix", M, np.abs(M).max(), 1e-12)


def still(p=(1.0, 0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0), pivot=(0.0, 0.0, 0.2), joint=0.0, u=(0, 0, -1.0)):
    """One symmetric body without special numbers hidden: (model, state)."""
    base = pendulums.model("b")
    subject = replace(
        base,
        mass=np.array([2.0]),
        inertia=np.diag([0.03, 0.04, 0.05])[None],
        proximal=np.array([pivot], float),
        length=np.array([joint]),
        gravity=np.array([0.0, 0.0, -10.0]),
    )
    u = np.array([u], float) * (joint > 0)
    at = kinematics.state_from_minimal(
        subject, np.array([p], float), np.array([omega], float), u, np.zeros((1, 3))
    )
    return subject, at


def test_hangs_at_rest(engine):
    """By hand: nothing accelerates, the joint carries the weight; also on a rod exactly along −z or +z."""
    cases = [still(), still(joint=0.4), still(joint=0.4, u=(0, 0, 1.0))]
    for kind, (subject, at) in zip(("ball", "rod", "rod"), cases, strict=True):
        answers = evaluated(engine, subject, [at], kind)
        if answers is None:
            continue
        (got,) = answers
        agrees(engine, got, "acceleration", 0, 10, 1e-13)
        agrees(engine, got, "angular_acceleration", 0, 50, 1e-13)
        agrees(engine, got, "joint_reaction", [[0, 0, 20.0]], 20, 1e-13)
        agrees(engine, got, "potential_energy", 20 * at.r[0, 2], 20, 1e-15)


def test_frames_and_quaternion_order(engine):
    """By hand: body x, y, z point to world y, z, x; the pivot is 0.2 m along body x, the bob at −0.2 y."""
    p = (0.5, 0.5, 0.5, 0.5)
    subject, at = still(p, omega=(0.0, 2.0, 0.0), pivot=(0.2, 0.0, 0.0))
    np.testing.assert_allclose(at.r, [[0, -0.2, 0]], atol=1e-16)
    # Spin 2 rad/s about body y = world z: the centre of mass at −0.2 y moves along +x; the weight falls along
    # −z = −body y and its moment about the pivot, r × m g = (−0.2 y) × (−20 z) = 4 x = 4 body z, meets
    # J_z + m s² = 0.05 + 0.08; centripetal acceleration ω² s = 0.8 along +y.
    np.testing.assert_allclose(at.v, [[0.4, 0, 0]], atol=1e-15)
    answers = evaluated(engine, subject, [at], "ball")
    if answers is None:
        return
    (got,) = answers
    turn = 4 / 0.13
    agrees(engine, got, "angular_acceleration", [[0, 0, turn]], turn, 1e-13)
    agrees(engine, got, "acceleration", [[0, 0.8, -0.2 * turn]], 10, 1e-13)
    agrees(engine, got, "joint_reaction", [[0, 1.6, 20 - 0.4 * turn]], 20, 1e-13)
    agrees(engine, got, "kinetic_energy", 0.5 * 4 * (0.04 + 0.08), 1, 1e-13)
    agrees(engine, got, "angular_momentum", [0, 0, 2 * (0.04 + 0.08)], 1, 1e-13)
    for method in worker.attribute(engine, "integrators"):
        run = worker.call(engine, "simulate", subject, at, TIMES[:2], method.name, resolution(method))
        for name, expected in (
            ("r", at.r),
            ("v", at.v),
            ("pdot", kinematics.quaternion_rate(at.p, at.omega)),
        ):
            close(getattr(run, name)[0], expected, 1, f"{method.name}: first {name}", 1e-14)
        close(run.p[0], at.p, 1, f"{method.name}: first p", 1e-14)


@pytest.mark.parametrize("joints", ["balls", "rods"])
def test_p_and_minus_p_are_the_same_attitude(engine, joints):
    subject = pendulums.model(JOINTS[joints])
    at = pendulums.state(subject)
    one, other = evaluated(engine, subject, [at, pendulums.flipped(at)], joints) or (None, None)
    if one is None:
        return
    for name in ("acceleration", "angular_acceleration", "joint_reaction", "angular_momentum", "mass_matrix"):
        if (value := getattr(one, name)) is not None:
            close(getattr(other, name), value, np.abs(value).max(), name, 1e-12)
    for method in worker.attribute(engine, "integrators"):
        runs = [
            worker.call(engine, "simulate", subject, start, TIMES[:5], method.name, resolution(method))
            for start in (at, pendulums.flipped(at))
        ]
        close(runs[1].r, runs[0].r, 1, f"{method.name}: r", 1e-10)
        close(
            kinematics.rotation_matrix(runs[1].p),
            kinematics.rotation_matrix(runs[0].p),
            1,
            f"{method.name}: A",
            1e-10,
        )


# -- trajectories ------------------------------------------------------------------------------


def resolution(method: Integrator) -> float:
    return STEP if method.kind == "step" else 1e-10


def test_sample_times(engine):
    """Row 0 is the state given; samples are where they were asked, and asking more often changes nothing."""
    subject = one_body(engine)
    at = pendulums.state(subject)
    for method in worker.attribute(engine, "integrators"):
        fine = worker.call(engine, "simulate", subject, at, TIMES, method.name, resolution(method))
        coarse = worker.call(engine, "simulate", subject, at, TIMES[::4], method.name, resolution(method))
        np.testing.assert_allclose(fine.t, TIMES, rtol=1e-13)
        close(fine.r[0], at.r, 1, f"{method.name}: first r", 1e-14)
        # Implicit steps stop their iterations at a tolerance, dense output at another: both below this.
        close(fine.r[::4], coarse.r, 1, f"{method.name}: r at common times", 1e-10)
        if method.kind == "step":
            assert fine.steps == coarse.steps == round(TIMES[-1] / STEP)
            with pytest.raises(BadInput, match="multiples"):
                worker.call(engine, "simulate", subject, at, TIMES, method.name, 0.3 * STEP)


@pytest.mark.parametrize("joints", ["balls", "rods"])
def test_deterministic(engine, joints):
    """The same call gives the same bits, also after another model has been through."""
    subject, other = pendulums.model(JOINTS[joints]), pendulums.model("rb", loads=True, seed=1)
    at = pendulums.state(subject)
    first = evaluated(engine, subject, [at], joints)
    if first is None:
        return
    evaluated(engine, other, [pendulums.state(other)], "rod-ball", "loads")
    second = evaluated(engine, subject, [at], joints)
    assert bits(first[0]) == bits(second[0])
    for method in worker.attribute(engine, "integrators"):
        runs = [
            worker.call(engine, "simulate", subject, at, TIMES[:5], method.name, resolution(method))
            for _ in range(2)
        ]
        assert bits(runs[0]) == bits(runs[1]), f"{method.name} is not deterministic"


def bits(record):
    return {
        name: np.asarray(value, float).tobytes() for name, value in vars(record).items() if value is not None
    }


@pytest.mark.parametrize("case", ["ball", "rod", "ball, loads and drag", "rod, loads and drag"])
def test_converges_to_the_truth_with_its_declared_order(engine, case):
    """Order seen from consecutive halvings; the extrapolated limit is the truth, r, p, ṙ and ṗ alike."""
    if gaps_of(engine, case.partition(",")[0]):
        with pytest.raises(Unsupported):
            subject, at, times, _ = convergence_case(case)
            worker.call(engine, "simulate", subject, at, times, "dop853", 1e-12)
        return
    subject, at, times, true = convergence_case(case)
    for method in worker.attribute(engine, "integrators"):
        if method.kind == "tolerance":
            runs = [worker.call(engine, "simulate", subject, at, times, method.name, 1e-12)]
            close(stack(runs[0], true), stack_truth(true), 1, f"{method.name} at 1e-12", 1e-9)
            continue
        # Fine enough to be asymptotic, coarse enough to stay above rounding, by order.
        coarsest = {1: 2.0**-9, 2: 2.0**-7, 4: 2.0**-6}[method.order]
        runs = [
            worker.call(engine, "simulate", subject, at, times, method.name, coarsest / 2**level)
            for level in range(5)
        ]
        rows = [stack(run, true) for run in runs]
        change = [np.linalg.norm(b - a) for a, b in pairwise(rows)]
        orders = np.log2(np.array(change[:-1]) / change[1:])[-2:]
        assert np.all(np.abs(orders - method.order) < 0.1), f"{method.name}: orders {orders}"
        previous, limit = None, rows
        for power in method.error_exponents[: len(rows) - 1]:
            previous, limit = limit[-1], [b + (b - a) / (2**power - 1) for a, b in pairwise(limit)]
        uncertainty = 10 * np.max(np.abs(limit[-1] - previous)) + 1e-11
        assert uncertainty < 1e-5, f"{method.name}: extrapolation is uncertain by {uncertainty}"
        close(limit[-1], stack_truth(true), 1, f"{method.name}, extrapolated", uncertainty)


@cache
def convergence_case(case: str):
    joints, _, loaded = case.partition(", ")
    subject = pendulums.model(JOINTS[joints], loads=bool(loaded), drag=bool(loaded))
    at = pendulums.state(subject, rate=1.0)
    times = np.linspace(0, 0.25, 5)  # short of the singularities of an engine that counts in angles
    return subject, at, times, newton_euler.integrate(subject, at, times)


def stack(run, true):
    """All of a trajectory in one row of numbers; p and ṗ with the sign of the truth's."""
    sign = np.sign(np.sum(run.p * np.array([s.p for s in true]), -1, keepdims=True))
    return np.concatenate([np.ravel(x) for x in (run.r, sign * run.p, run.v, sign * run.pdot)])


def stack_truth(true):
    pdot = [kinematics.quaternion_rate(s.p, s.omega) for s in true]
    columns = [s.r for s in true], [s.p for s in true], [s.v for s in true], pdot
    return np.concatenate([np.ravel(column) for column in columns])


# -- what no engine may see --------------------------------------------------------------------


def reached(real, *_):
    raise AssertionError("the engine was reached")


def spoiled(name, value):
    """One body's model and state with one entry of one array replaced."""
    subject, at = pendulums.model("rb"), pendulums.state(pendulums.model("rb"))
    holder = at if hasattr(at, name) else subject
    array = np.array(getattr(holder, name))
    array.flat[-1] = value
    changed = replace(holder, **{name: array})
    return (subject, changed) if holder is at else (changed, at)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(
    "name",
    [
        *("p", "omega", "u", "udot", "r", "v"),
        *("mass", "inertia", "proximal", "distal", "length", "gravity", "force", "moment"),
        *("drag_force", "drag_moment"),
    ],
)
def test_refuses_what_is_not_finite(engine, name, value):
    refuses(engine, *spoiled(name, value), match=name)


@pytest.mark.parametrize("factor", [0.0, 1.1, 1 + 1e-13, -0.5])
def test_refuses_unnormalised_quaternions(engine, factor):
    subject, at = spoiled("p", 0.0)
    at = pendulums.state(subject)
    refuses(engine, subject, replace(at, p=at.p * [[1.0], [factor]]), match="normalised")


def test_refuses_wrong_shapes_and_types(engine):
    subject = pendulums.model("rb")
    at = pendulums.state(subject)
    refuses(engine, subject, replace(at, omega=at.omega[:1]), match="shape")
    refuses(engine, subject, replace(at, p=at.p.astype(np.float32)), match="float32")


def refuses(engine, subject, at, match):
    tamper = {"_evaluate": reached, "_simulate": reached}
    with pytest.raises(BadInput, match=match):
        worker.call(engine, "evaluate", subject, [at], tamper=tamper)
    for method in worker.attribute(engine, "integrators"):
        with pytest.raises(BadInput, match=match):
            worker.call(
                engine, "simulate", subject, at, TIMES, method.name, resolution(method), tamper=tamper
            )


# -- what must not leave unnoticed -------------------------------------------------------------


def honest(real, *args):
    return real(*args)


def early_stop(real, *args):
    run = real(*args)
    return replace(run, **{k: getattr(run, k)[:-1] for k in ("t", "r", "p", "v", "pdot")})


def early_stop_padded(real, *args):
    """Stopped early, the last row filled in again, as MuJoCo's rollout does."""
    run = real(*args)
    return replace(run, **{k: held(getattr(run, k)) for k in ("r", "p", "v", "pdot")})


def held(rows):
    return np.concatenate([rows[:-2], rows[-3:-2], rows[-3:-2]])


def stopped_clock(real, *args):
    run = real(*args)
    return replace(run, t=held(run.t))


def silent_reset(real, *args):
    """Starts over from the initial state in the middle, clock and all rows in good order."""
    run = real(*args)
    return replace(run, **{k: restarted(getattr(run, k)) for k in ("r", "p", "v", "pdot")})


def restarted(rows):
    half = len(rows) // 2
    return np.concatenate([rows[:half], rows[: len(rows) - half]])


def rewound(real, *args):
    """A reset with the engine's clock set back, as MuJoCo's autoreset does."""
    run = real(*args)
    return replace(run, t=restarted(run.t))


def not_finite(real, *args):
    run = real(*args)
    v = run.v.copy()
    v[-1, 0, 1] = np.inf
    return replace(run, v=v)


def missing_body(real, *args):
    run = real(*args)
    return replace(run, r=run.r[:, :-1])


@pytest.mark.parametrize(
    ("tampering", "message"),
    [
        (early_stop, "sampled 8 of 9"),
        (early_stop_padded, "repeats"),
        (stopped_clock, "sampled"),
        (silent_reset, "initial state again"),
        (rewound, "sampled"),
        (not_finite, "v is not finite from t = 0.5"),
        (missing_body, "shape"),
    ],
    ids=lambda x: getattr(x, "__name__", ""),
)
def test_detects_in_a_trajectory(engine, tampering, message):
    subject = one_body(engine)
    for method in worker.attribute(engine, "integrators"):
        args = (subject, pendulums.state(subject), TIMES, method.name, resolution(method))
        worker.call(engine, "simulate", *args, tamper={"_simulate": honest})
        with pytest.raises(EngineFailure, match=message):
            worker.call(engine, "simulate", *args, tamper={"_simulate": tampering})


def nan_acceleration(real, *args):
    first, *rest = real(*args)
    return [replace(first, acceleration=np.full_like(first.acceleration, np.nan)), *rest]


def infinite_energy(real, *args):
    return [replace(answer, kinetic_energy=float("inf")) for answer in real(*args)]


def flat_reaction(real, *args):
    return [replace(answer, joint_reaction=np.zeros(3)) for answer in real(*args)]


def lost_state(real, *args):
    return real(*args)[:-1]


@pytest.mark.parametrize(
    ("tampering", "message"),
    [
        (nan_acceleration, "state 0: acceleration is not finite"),
        (infinite_energy, "kinetic_energy is not finite"),
        (flat_reaction, "joint_reaction has shape"),
        (lost_state, "answered 1 of 2 states"),
    ],
    ids=lambda x: getattr(x, "__name__", ""),
)
def test_detects_in_an_evaluation(engine, tampering, message):
    subject = one_body(engine)
    args = (subject, [pendulums.state(subject), pendulums.state(subject, 1)])
    assert len(worker.call(engine, "evaluate", *args, tamper={"_evaluate": honest})) == 2
    with pytest.raises(EngineFailure, match=message):
        worker.call(engine, "evaluate", *args, tamper={"_evaluate": tampering})


# -- the worker itself -------------------------------------------------------------------------


def crash():
    ctypes.string_at(0)


def test_a_crash_or_a_hang_loses_one_call():
    name = next(iter(ENGINES))
    with pytest.raises(ProcessExpired):
        worker.run(name, crash)
    with pytest.raises(TimeoutError):
        worker.run(name, time.sleep, 60, timeout=0.5)
    assert worker.run(name, abs, -1) == 1
