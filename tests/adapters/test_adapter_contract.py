"""The adapter contract: what every registered engine must do, tested in the engine's own process.

An adapter declares in `Adapter.unsupported` what its engine does not do: a key of `UNSUPPORTED_KINDS` and the
reason.  A refusal is accepted where the model is of one of the declared kinds; a declared gap must be real.
"""

from __future__ import annotations

import ctypes
import time
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from plumbline.engines.adapter import UNSUPPORTED_KINDS
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.model import kinematics
from plumbline.model.datatypes import BadInput, EngineFailure, State, Unsupported
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers import engine_process as worker
from tests.helpers import pendulums
from tests.helpers.nightly_tests import SLOW
from tests.helpers.pendulums import JOINT_PATTERNS
from tests.helpers.refinement import observed_orders, romberg_columns
from tests.helpers.true_answers import true_trajectory

STATES = 6
STEP = 2.0**-7  # s, for runs whose accuracy does not matter
TIMES = np.arange(9) / 16  # s
MODEL_KINDS = {"rods", "balls", "chains", "loads"}


def installed_adapters():
    for name in ENGINES:
        try:
            yield load_adapter(name)
        except ImportError:
            continue  # the fixture `engine` skips with the reason


INTEGRATORS = [
    (adapter.name, method)
    for adapter in installed_adapters()
    for method in adapter.integrators
    if method.has_motions
]
UNSUPPORTED_BY_ENGINE = [
    (adapter.name, kind) for adapter in installed_adapters() for kind in adapter.unsupported
]
every_integrator = pytest.mark.parametrize(
    ("engine", "integrator"), INTEGRATORS, ids=[f"{engine}-{method.name}" for engine, method in INTEGRATORS]
)


@pytest.fixture(scope="module", params=ENGINES)
def engine(request):
    """The name of an engine that is installed."""
    try:
        worker.call_adapter(request.param, "version")
    except ImportError as missing:
        pytest.skip(f"{request.param} is not installed: {missing}")
    return str(request.param)


@cache
def declared_gaps(engine):
    return dict(worker.adapter_attribute(engine, "unsupported"))


def kinds_of(model):
    """The kinds of model, of those that an adapter may declare as unsupported, that a model is of."""
    kinds = {"rods": np.any(model.rods), "balls": not np.all(model.rods), "chains": model.n > 1}
    return {kind for kind, holds in kinds.items() if holds} | (
        {"loads"} if model.has_loads or model.has_drag else set()
    )


def ask(engine, method, model, *args):
    """The engine's answer; None for a refusal, which must be declared and have a sentence."""
    try:
        return worker.call_adapter(engine, method, model, *args)
    except Unsupported as reason:
        kinds = kinds_of(model)
        assert kinds & declared_gaps(engine).keys(), (
            f"{engine} refuses a model with {', '.join(sorted(kinds))} and declares none of these "
            f"as unsupported; its reason: {reason}"
        )
        assert len(str(reason).split()) > 3
        return None


def step_or_tolerance(method):
    return STEP if method.kind == "step" else 1e-10


def ask_run(engine, integrator, subject, at, times=TIMES[:5]):
    return ask(engine, "simulate", subject, at, times, integrator.name, step_or_tolerance(integrator))


def one_body(engine, **loads):
    """A pendulum of one body that the engine supports: on a ball joint, or else on a rod."""
    return pendulums.make_model("r" if "balls" in declared_gaps(engine) else "b", **loads)


# -- what it declares --------------------------------------------------------------------------


def test_describes_itself(engine):
    info = worker.call_adapter(engine, "describe")
    assert info.name == engine and info.title and info.version[0].isdigit() and info.missing is None
    assert worker.adapter_attribute(engine, "package")
    names = [method.name for method in info.integrators]
    assert (not names) == ("integrators" in declared_gaps(engine)), "the declaration of gaps is wrong"
    assert len(set(names)) == len(names)
    with pytest.raises(KeyError, match=names[0] if names else engine):
        worker.call_adapter(engine, "simulate", *single_body(), TIMES, "no such method", STEP)


@every_integrator
def test_describes_its_integrators(engine, integrator):
    assert integrator.alias_of in (None, *(method.name for name, method in INTEGRATORS if name == engine))
    assert integrator.note, f"{integrator.name} has no sentence that explains it"
    if integrator.kind == "step":
        exponents = list(integrator.error_exponents)
        assert exponents[0] == integrator.order and exponents == sorted(set(exponents))


@pytest.mark.parametrize(("engine", "kind"), UNSUPPORTED_BY_ENGINE)
def test_a_declared_gap_is_real(engine, kind):
    """A quantity is never returned; of the models of a kind at least one is refused."""
    assert kind in UNSUPPORTED_KINDS, f"{kind} is none of {', '.join(UNSUPPORTED_KINDS)}"
    assert len(declared_gaps(engine)[kind].split()) > 3, "the reason is a sentence"
    if kind == "integrators":
        assert not worker.adapter_attribute(engine, "integrators")
        return
    models = [
        pendulums.make_model(joints, loads=loaded, drag=loaded)
        for joints in JOINT_PATTERNS.values()
        for loaded in (False, True)
    ]
    if kind in MODEL_KINDS:
        refused = [ask(engine, "evaluate", model, [pendulums.state_from_seed(model)]) is None
                   for model in models if kind in kinds_of(model)]  # fmt: skip
        assert any(refused), f"{engine} refuses no model with {kind}: take {kind} out of `unsupported`"
    else:
        answers = ask(engine, "evaluate", model := one_body(engine), [pendulums.state_from_seed(model)])
        assert getattr(answers[0], kind) is None, f"{engine} returns {kind}: take it out of `unsupported`"


# -- state level -------------------------------------------------------------------------------


@cache
def expected_states(joints, loaded):
    subject = pendulums.make_model(joints, loads=loaded, drag=loaded)
    states = [pendulums.state_from_seed(subject, seed) for seed in range(STATES)]
    return subject, states, [certify_state(subject, at, mass_matrix=True).quantities for at in states]


def assert_close(got, expected, scale, quantity, relative):
    """‖got − expected‖∞ ≤ relative · scale, row by row where each has its scale."""
    error = np.abs(np.asarray(got) - expected)
    assert np.all(error <= relative * scale), (
        f"{quantity}: off by {np.max(error):.3e}, {np.max(error / scale):.1e} relative\n{got}\n{expected}"
    )


def assert_agrees(engine, answer, name, expected, scale, relative=1e-11):
    """A state quantity is returned, and close, or is declared as unsupported."""
    got = getattr(answer, name)
    assert (got is None) == (name in declared_gaps(engine)), (
        f"{engine} {'does not return' if got is None else 'returns'} {name}, unlike its `unsupported`"
    )
    if got is not None:
        assert_close(got, expected, scale, name, relative)


@pytest.mark.parametrize(
    ("joints", "loaded"),
    [
        pytest.param(joints, loaded, id=f"{joints}-{words}", marks=SLOW if joints in marked else [])
        for loaded, words, marked in (
            (False, "free", JOINT_PATTERNS.keys() - {"balls", "rods"}),
            (True, "loads and drag", ()),
        )
        for joints in JOINT_PATTERNS
    ],
)
def test_states_obey_newton_and_euler(engine, joints, loaded):
    subject, states, truth = expected_states(joints, loaded)
    answers = ask(engine, "evaluate", subject, states)
    # Conditioning allows 1e-11 of the largest acceleration or force in the chain, in joint coordinates what
    # rounded terms may change in each body's.  Plain sums and products of the inputs allow more.
    g, weight = np.linalg.norm(subject.gravity), np.linalg.norm(subject.gravity) * subject.mass.sum()
    least = {"acceleration": g, "angular_acceleration": g / 0.25, "joint_reaction": weight}
    levers = np.cumsum(0.5 + subject.length)
    for at, true, got in zip(states, truth, answers or [], strict=False):
        bound = state_rounding_bound(subject, at) if engine == "pinocchio-aba" else None
        for name, size in least.items():
            expected = getattr(true, name)
            limit = 1e-11 * max(size, np.abs(expected).max())
            if bound is not None:
                limit = getattr(bound, name)[:, None]
            assert_agrees(engine, got, name, expected, limit, 1.0)
        for name, size, relative in (
            ("kinetic_energy", true.kinetic_energy, 1e-12),
            ("potential_energy", g * subject.mass @ levers, 1e-13),
            ("angular_momentum", np.sum(subject.mass * levers * np.linalg.norm(at.v, axis=1)), 1e-12),
            ("mass_matrix", np.abs(true.mass_matrix).max(), 1e-12),
        ):
            assert_agrees(engine, got, name, getattr(true, name), size, relative)


def single_body(
    p=(1.0, 0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0), pivot=(0.0, 0.0, 0.2), joint=0.0, u=(0, 0, -1.0)
):
    """One symmetric body without special numbers hidden: (model, state)."""
    base = pendulums.make_model("b")
    subject = base.changed(
        mass=np.array([2.0]),
        inertia=np.diag([0.03, 0.04, 0.05])[None],
        proximal=np.array([pivot], float),
        length=np.array([joint]),
        gravity=np.array([0.0, 0.0, -10.0]),
    )
    u = np.array([u], float) * (joint > 0)
    at = kinematics.complete_state(
        subject, State(np.array([p], float), np.array([omega], float), u, np.zeros((1, 3)))
    )
    return subject, at


@pytest.mark.parametrize("hang", [{}, {"joint": 0.4}, {"joint": 0.4, "u": (0, 0, 1.0)}], ids=str)
def test_hangs_at_rest(engine, hang):
    """By hand: nothing accelerates, the joint carries the weight; also on a rod exactly along −z or +z."""
    subject, at = single_body(**hang)
    for got in ask(engine, "evaluate", subject, [at]) or []:
        assert_agrees(engine, got, "acceleration", 0, 10, 1e-13)
        assert_agrees(engine, got, "angular_acceleration", 0, 50, 1e-13)
        assert_agrees(engine, got, "joint_reaction", [[0, 0, 20.0]], 20, 1e-13)
        assert_agrees(engine, got, "potential_energy", 20 * at.r[0, 2], 20, 1e-15)


def turned():
    """Body x, y, z point to world y, z, x; the pivot is 0.2 m along body x; spin about world z."""
    return single_body((0.5, 0.5, 0.5, 0.5), omega=(0.0, 2.0, 0.0), pivot=(0.2, 0.0, 0.0))


def test_frames_and_quaternion_order(engine):
    """By hand: body x, y, z point to world y, z, x; the pivot is 0.2 m along body x, the bob at −0.2 y."""
    subject, at = turned()
    np.testing.assert_allclose(at.r, [[0, -0.2, 0]], atol=1e-16)
    # Spin 2 rad/s about body y = world z: the centre of mass at −0.2 y moves along +x; the weight falls along
    # −z = −body y and its moment about the pivot, r × m g = (−0.2 y) × (−20 z) = 4 x = 4 body z, meets
    # J_z + m s² = 0.05 + 0.08; centripetal acceleration ω² s = 0.8 along +y.
    np.testing.assert_allclose(at.v, [[0.4, 0, 0]], atol=1e-15)
    turn = 4 / 0.13
    for got in ask(engine, "evaluate", subject, [at]) or []:
        assert_agrees(engine, got, "angular_acceleration", [[0, 0, turn]], turn, 1e-13)
        assert_agrees(engine, got, "acceleration", [[0, 0.8, -0.2 * turn]], 10, 1e-13)
        assert_agrees(engine, got, "joint_reaction", [[0, 1.6, 20 - 0.4 * turn]], 20, 1e-13)
        assert_agrees(engine, got, "kinetic_energy", 0.5 * 4 * (0.04 + 0.08), 1, 1e-13)
        assert_agrees(engine, got, "angular_momentum", [0, 0, 2 * (0.04 + 0.08)], 1, 1e-13)


@every_integrator
def test_the_first_sample_is_the_initial_state(engine, integrator):
    subject, at = turned()
    run = ask_run(engine, integrator, subject, at, TIMES[:2])
    if run is None:
        return
    start = kinematics.maximal_coordinates(at)
    for name, expected in zip(("r", "p", "v", "pdot"), start, strict=True):
        assert_close(getattr(run, name)[0], expected, 1, f"first {name}", 1e-14)


@pytest.mark.parametrize("joints", ["balls", "rods"])
def test_p_and_minus_p_are_the_same_attitude(engine, joints):
    subject = pendulums.make_model(joints)
    at = pendulums.state_from_seed(subject)
    one, other = ask(engine, "evaluate", subject, [at, pendulums.with_negated_quaternions(at)]) or (
        None,
        None,
    )
    if one is None:
        return
    for name in ("acceleration", "angular_acceleration", "joint_reaction", "angular_momentum", "mass_matrix"):
        if (value := getattr(one, name)) is not None:
            assert_close(getattr(other, name), value, np.abs(value).max(), name, 1e-12)


@pytest.mark.parametrize("joints", ["balls", "rods"])
@every_integrator
def test_runs_from_p_and_minus_p_are_the_same_motion(engine, integrator, joints):
    subject = pendulums.make_model(joints)
    at = pendulums.state_from_seed(subject)
    starts = (at, pendulums.with_negated_quaternions(at))
    runs = [ask_run(engine, integrator, subject, start) for start in starts]
    if runs == [None, None]:
        return
    assert_close(runs[1].r, runs[0].r, 1, "r", 1e-10)
    attitudes = [kinematics.rotation_matrix(run.p) for run in runs]
    assert_close(attitudes[1], attitudes[0], 1, "A", 1e-10)


# -- trajectories ------------------------------------------------------------------------------


@every_integrator
def test_sample_times(engine, integrator):
    """Row 0 is the given state; samples are at the given times, and more of them change nothing."""
    subject = one_body(engine)
    at, size = pendulums.state_from_seed(subject), step_or_tolerance(integrator)
    fine, coarse = (
        worker.call_adapter(engine, "simulate", subject, at, times, integrator.name, size)
        for times in (TIMES, TIMES[::4])
    )
    np.testing.assert_allclose(fine.t, TIMES, rtol=1e-13)
    assert_close(fine.r[0], at.r, 1, "first r", 1e-14)
    # Implicit steps stop their iterations at a tolerance, dense output at another: both below this.
    assert_close(fine.r[::4], coarse.r, 1, "r at common times", 1e-10)
    if integrator.kind == "step":
        assert fine.steps == coarse.steps == round(TIMES[-1] / STEP)
        with pytest.raises(BadInput, match="multiples"):
            worker.call_adapter(engine, "simulate", subject, at, TIMES, integrator.name, 0.3 * STEP)


@pytest.mark.parametrize("joints", ["balls", "rods"])
def test_evaluation_is_deterministic(engine, joints):
    """The same call gives the same bits, also after another model has been through."""
    subject, other = (
        pendulums.make_model(joints),
        pendulums.make_model("rb", loads=True, seed=1),
    )
    first = ask(engine, "evaluate", subject, [pendulums.state_from_seed(subject)])
    ask(engine, "evaluate", other, [pendulums.state_from_seed(other)])
    second = ask(engine, "evaluate", subject, [pendulums.state_from_seed(subject)])
    assert (first is None) == (second is None)
    assert first is None or to_bytes(first[0]) == to_bytes(second[0])


@pytest.mark.parametrize("joints", ["balls", "rods"])
@every_integrator
def test_runs_are_deterministic(engine, integrator, joints):
    subject = pendulums.make_model(joints)
    at = pendulums.state_from_seed(subject)
    one, other = (ask_run(engine, integrator, subject, at) for _ in range(2))
    assert (one is None) == (other is None)
    assert one is None or to_bytes(one) == to_bytes(other)


def to_bytes(record):
    return {
        name: np.asarray(value, float).tobytes() for name, value in vars(record).items() if value is not None
    }


@pytest.mark.parametrize("case", ["ball", "rod", "ball, loads and drag", "rod, loads and drag"])
@every_integrator
def test_converges_to_the_truth_with_its_declared_order(engine, integrator, case):
    """Order seen from consecutive halvings; the extrapolated limit is the truth, r, p, ṙ and ṗ alike."""
    subject, at, times, true = convergence_case(case)
    # Fine enough to be asymptotic, coarse enough to stay above rounding, by order.
    coarsest = {1: 2.0**-9, 2: 2.0**-7, 4: 2.0**-6}.get(integrator.order, 0.0)
    resolutions = [1e-12] if integrator.kind == "tolerance" else [coarsest / 2**level for level in range(5)]
    runs = [ask(engine, "simulate", subject, at, times, integrator.name, size) for size in resolutions]
    if runs == [None] * len(runs):
        return
    rows = [flatten_trajectory(run, true) for run in runs]
    if integrator.kind == "tolerance":
        assert_close(rows[0], flatten_trajectory(true, true), 1, "at 1e-12", 1e-9)
        return
    orders = observed_orders(np.array(rows))[-2:]
    assert np.all(np.abs(orders - integrator.order) < 0.1), f"orders {orders}"
    *_, previous, limit = romberg_columns(np.array(rows), integrator.error_exponents)
    uncertainty = 10 * np.max(np.abs(limit[-1] - previous[-1])) + 1e-11
    assert uncertainty < 1e-5, f"extrapolation is uncertain by {uncertainty}"
    assert_close(limit[-1], flatten_trajectory(true, true), 1, "extrapolated", uncertainty)


@cache
def convergence_case(case):
    joints, _, loaded = case.partition(", ")
    subject = pendulums.make_model(joints, loads=bool(loaded), drag=bool(loaded))
    at = pendulums.state_from_seed(subject, rate=1.0)
    times = np.linspace(0, 0.25, 5)  # short of the singularities of an engine that counts in angles
    return subject, at, times, true_trajectory(subject, at, times)


def flatten_trajectory(run, true):
    """All of a trajectory in one row of numbers; p and ṗ with the sign of the truth's."""
    sign = np.sign(np.sum(run.p * true.p, -1, keepdims=True))
    return np.concatenate([np.ravel(x) for x in (run.r, sign * run.p, run.v, sign * run.pdot)])


# -- what no engine may see --------------------------------------------------------------------


def fail_if_called(real, *_):
    raise AssertionError("the engine was reached")


def replace_entry(name, value):
    """One body's model and state with one entry of one array replaced."""
    subject, at = pendulums.make_model("rb"), pendulums.state_from_seed(pendulums.make_model("rb"))
    holder = at if hasattr(at, name) else subject
    array = np.array(getattr(holder, name))
    array.flat[-1] = value
    changed = replace(at, **{name: array}) if holder is at else subject.changed(**{name: array})
    return (subject, changed) if holder is at else (changed, at)


ARRAYS = "p omega u udot r v mass inertia point length gravity force moment drag_force drag_moment"


def bad_inputs():
    """Model, state, and a word of the message that refuses them."""
    subject = pendulums.make_model("rb")
    at = pendulums.state_from_seed(subject)
    for name in ARRAYS.split():
        for value in (np.nan, np.inf):
            yield *replace_entry(name, value), name
    for factor in (0.0, 1.1, 1 + 1e-13, -0.5):
        yield subject, replace(at, p=at.p * [[1.0], [factor]]), "normalised"
    yield subject, replace(at, omega=at.omega[:1]), "shape"
    yield subject, replace(at, p=at.p.astype(np.float32)), "float32"


TAMPER = {"_evaluate": fail_if_called, "_simulate": fail_if_called}


def test_refuses_bad_states(engine):
    for subject, at, message in bad_inputs():
        with pytest.raises(BadInput, match=message):
            worker.call_adapter(engine, "evaluate", subject, [at], overrides=TAMPER)


@every_integrator
def test_refuses_runs_from_bad_states(engine, integrator):
    size = step_or_tolerance(integrator)
    for subject, at, message in bad_inputs():
        with pytest.raises(BadInput, match=message):
            args = subject, at, TIMES, integrator.name, size
            worker.call_adapter(engine, "simulate", *args, overrides=TAMPER)


# -- what must not leave unnoticed -------------------------------------------------------------


def unchanged(real, *args):
    return real(*args)


ROWS = ("r", "p", "v", "pdot")


def altered(names, change, real, *args):
    """A run, some fields of it changed."""
    run = real(*args)
    return replace(run, **{name: change(getattr(run, name)) for name in names})


def without_last(rows):
    return rows[:-1]


def without_last_body(rows):
    return rows[:, :-1]


def repeat_sample(rows):
    return np.concatenate([rows[:-2], rows[-3:-2], rows[-3:-2]])


def restart_halfway(rows):
    half = len(rows) // 2
    return np.concatenate([rows[:half], rows[: len(rows) - half]])


def infinite_at_the_end(rows):
    rows = rows.copy()
    rows[-1, 0, 1] = np.inf
    return rows


def simulated_by(simulate, engine, integrator):
    """A run of the integrator, of an adapter that simulates in another way."""
    subject = one_body(engine)
    state, size = pendulums.state_from_seed(subject), step_or_tolerance(integrator)
    arguments = subject, state, TIMES, integrator.name, size
    return worker.call_adapter(engine, "simulate", *arguments, overrides={"_simulate": simulate})


TAMPERED = {  # fields of a run, how they are changed, and what the contract reports
    "early stop": (("t", *ROWS), without_last, "sampled 8 of 9"),
    # stopped early, the last row filled in again, as MuJoCo's rollout does
    "early stop, padded": (ROWS, repeat_sample, "repeats"),
    "stopped clock": (("t",), repeat_sample, "sampled"),
    # over from the initial state in the middle, clock and all rows in good order
    "silent reset": (ROWS, restart_halfway, "initial state again"),
    "clock set back": (("t",), restart_halfway, "sampled"),  # as MuJoCo's autoreset does
    "not finite": (("v",), infinite_at_the_end, "v is not finite from t = 0.5"),
    "missing body": (("r",), without_last_body, "shape"),
}


@pytest.mark.parametrize(("names", "change", "message"), TAMPERED.values(), ids=TAMPERED)
@every_integrator
def test_detects_in_a_trajectory(engine, integrator, names, change, message):
    simulated_by(unchanged, engine, integrator)
    with pytest.raises(EngineFailure, match=message):
        simulated_by(partial(altered, names, change), engine, integrator)


def comes_to_rest(real, *args):
    """As dampers leave a motion: the last steps change no digit."""
    run = real(*args)
    rows = {k: repeat_sample(getattr(run, k)) for k in ROWS}
    for rate in (rows["v"], rows["pdot"]):
        rate[-3:] = 1e-17
    return replace(run, **rows)


@every_integrator
def test_a_motion_may_come_to_rest(engine, integrator):
    simulated_by(comes_to_rest, engine, integrator)


def one_step_more(real, *args):
    run = real(*args)
    return replace(run, steps=run.steps + 1)


@every_integrator
def test_detects_another_number_of_steps(engine, integrator):
    """Of fixed steps: those of a tolerance are the engine's own choice."""
    with pytest.raises(EngineFailure, match="steps is") if integrator.kind == "step" else nullcontext():
        simulated_by(one_step_more, engine, integrator)


def without_tolerance(real, *args):
    return replace(real(*args), solver_rtol=0.0)


@every_integrator
def test_a_run_says_how_closely_its_steps_were_solved(engine, integrator):
    assert simulated_by(without_tolerance, engine, integrator).solver_rtol == integrator.solver_rtol


def nan_acceleration(real, *args):
    first, *rest = real(*args)
    return [replace(first, acceleration=np.full_like(first.acceleration, np.nan)), *rest]


def infinite_energy(real, *args):
    return [replace(answer, kinetic_energy=float("inf")) for answer in real(*args)]


def wrong_shape_reaction(real, *args):
    return [replace(answer, joint_reaction=np.zeros(3)) for answer in real(*args)]


def missing_state(real, *args):
    return real(*args)[:-1]


@pytest.mark.parametrize(
    ("tampering", "message"),
    [
        (nan_acceleration, "state 0: acceleration is not finite"),
        (infinite_energy, "kinetic_energy is not finite"),
        (wrong_shape_reaction, "joint_reaction has shape"),
        (missing_state, "answered 1 of 2 states"),
    ],
    ids=lambda x: getattr(x, "__name__", ""),
)
def test_detects_in_an_evaluation(engine, tampering, message):
    subject = one_body(engine)
    args = (subject, [pendulums.state_from_seed(subject), pendulums.state_from_seed(subject, 1)])
    assert len(worker.call_adapter(engine, "evaluate", *args, overrides={"_evaluate": unchanged})) == 2
    with pytest.raises(EngineFailure, match=message):
        worker.call_adapter(engine, "evaluate", *args, overrides={"_evaluate": tampering})


# -- the worker itself -------------------------------------------------------------------------


def crash():
    ctypes.string_at(0)


def test_a_crash_or_a_hang_loses_one_call():
    name = next(iter(ENGINES))
    with pytest.raises(worker.ProcessLost, match="SIGSEGV"):
        worker.run_in_engine_process(name, crash)
    with pytest.raises(worker.ProcessLost, match="timeout"):
        worker.run_in_engine_process(name, time.sleep, 60, timeout=0.5)
    assert worker.run_in_engine_process(name, abs, -1) == 1
