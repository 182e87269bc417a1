"""Engines as programs: honest ones are adapters like any other, each lie is the program's own failure."""

import contextlib
import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from plumbline.engines import protocol
from plumbline.engines.engine_calls import describe_engine, evaluate_states
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import EngineFailure, Model, State, Unsupported
from plumbline.model.kinematics import angular_velocity
from plumbline.processes.line_process import LineProcess
from plumbline.processes.worker_pool import Limits, Task, WorkerPool
from tests.helpers import ROOT, pendulums
from tests.helpers.tables import table

SERVER = ROOT / "tests" / "helpers" / "lying_server.py"
TRANSCRIPTS = ROOT / "tests" / "engines" / "transcripts"  # question, answer, question, …
MODEL = pendulums.make_model("bb")
STATES = [pendulums.state_from_seed(MODEL, seed=k, rate=0.5) for k in (2, 3)]
TIMES = np.linspace(0.0, 0.2, 3)


def specification(lie):
    return "cmd:" + shlex.join([sys.executable, "-I", "-S", str(SERVER), *([lie] if lie else [])])


def processes(words):
    """Command lines of this machine's processes that have these words."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if words.encode() in (line := path.read_bytes()):
                found.append(line)
    return found


@pytest.fixture(autouse=True)
def nothing_is_left():
    yield
    for program in protocol._running.values():
        program._lines.end()
    protocol._running.clear()
    assert not processes(str(SERVER))


def test_an_honest_program_is_an_adapter_like_any_other():
    adapter = load_adapter(specification(""))
    assert (adapter.name, adapter.title, adapter.version()) == ("liar", "Liar", "1")
    assert not adapter.describe().missing and adapter.builds_trees and not adapter.builds_elements
    for found in adapter.evaluate(MODEL, STATES):
        assert np.array_equal(found.acceleration, np.zeros((2, 3))) and found.joint_reaction is None
    run = adapter.simulate(MODEL, STATES[0], TIMES, "still", 0.1)
    assert run.steps == 2 and np.allclose(run.r[1] - run.r[0], 0.1)
    sprung = pendulums.make_model("bb").changed(damping=np.full((2, 2), 0.1))
    with pytest.raises(Unsupported, match="covers no joints with rotors, springs"):
        adapter.evaluate(sprung, STATES)


LIES = table(__file__)


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_the_program_s_own_failure(lie):
    with pytest.raises((EngineFailure, Unsupported), match=LIES[lie]) as failure:
        adapter = load_adapter(specification(lie))
        adapter.describe()
        adapter.evaluate(MODEL, STATES)
        adapter.simulate(MODEL, STATES[0], TIMES, "still", 0.1)
    assert len(str(failure.value)) < 2500
    if lie in ("an undeclared refusal", "a refusal for a quantity"):
        assert failure.value.gap == ""


def test_a_second_answer_to_one_question_is_a_fault_of_the_next():
    adapter = load_adapter(specification("twice"))
    adapter.evaluate(MODEL, STATES)
    with pytest.raises(EngineFailure, match="which is no answer with the id 5"):
        adapter.evaluate(MODEL, STATES)
    assert len(adapter.evaluate(MODEL, STATES)) == 2, "it was started again"


def test_a_program_that_keeps_a_mechanism_which_it_refuses_is_sent_the_next_one():
    adapter = load_adapter(specification("refusal of one body"))
    adapter.evaluate(MODEL, STATES)
    one = pendulums.make_model("b")
    with pytest.raises(Unsupported, match="not one body"):
        adapter.evaluate(one, [pendulums.state_from_seed(one, seed=2)])
    assert len(adapter.evaluate(MODEL, STATES)) == 2


def test_a_program_that_is_another_at_its_next_start_has_failed():
    adapter = load_adapter(specification("other at every start"))
    adapter.evaluate(MODEL, STATES)
    protocol._running.popitem()[1]._lines.end()
    with pytest.raises(EngineFailure, match="hello is not what it was at first"):
        adapter.evaluate(MODEL, STATES)


def test_much_on_standard_error_stops_nothing():
    assert len(load_adapter(specification("chatter")).evaluate(MODEL, STATES)) == 2


def test_a_hanging_program_and_its_grandchild_end_at_the_time_limit():
    with WorkerPool(1) as pool:
        limits = Limits(seconds=8.0)  # within which the program has started the other, on a busy machine too
        task = Task("hang", evaluate_states, (specification("grandchild"), MODEL, STATES), limits)
        (outcome,) = pool.run([task])
        assert outcome.is_overdue and outcome.failure
    assert not processes("SIG_IGN); time.sleep(600)")


def test_memory_has_a_limit_of_its_own():
    limits = Limits(seconds=100.0, gigabytes=1.0)
    with WorkerPool(1, limits) as pool:
        task = Task("memory", evaluate_states, (specification("memory"), MODEL, STATES), limits)
        (outcome,) = pool.run([task])
    assert "MemoryError" in (said := outcome.value.no_answer.message) and "exited with code 1" in said


def test_a_program_that_does_not_exist_cannot_be_loaded():
    with pytest.raises(EngineFailure, match="cannot be started"):
        describe_engine("cmd:/nowhere/engine")


def test_only_declared_variables_reach_the_program(monkeypatch):
    monkeypatch.setenv("SECRET_TOKEN", "x")
    script = "import os, json; input(); print(json.dumps({'id': 1, 'names': sorted(os.environ)}))"
    lines = LineProcess([sys.executable, "-I", "-c", script], {"MY_LIBRARY": "/opt/x"})
    names = lines.ask({"ask": "names"})["names"]
    lines.end()
    assert "MY_LIBRARY" in names and "PATH" in names and "SECRET_TOKEN" not in names


def test_questions_are_shortest_decimals_of_doubles():
    value = {"r": np.array([0.1, 1 / 3, 5e-324])}
    text = json.dumps(protocol.to_json([value["r"]]))
    assert text == "[[0.1, 0.3333333333333333, 5e-324]]"


def served_adapter(name):
    command = [sys.executable, "-m", "plumbline", "serve", name]
    return load_adapter(f"cmd:PYTHONPATH={ROOT} {shlex.join(command)}")


@pytest.mark.parametrize(
    ("engine", "name", "gap"),
    [
        ("mujoco", "adapters.mujoco_engine:Mujoco", "mass_matrix"),
        ("exudyn-tree", "adapters.exudyn_tree_engine:ExudynTree", "joint_moment"),
    ],
)
def test_a_quantity_that_some_mechanisms_lack_stays_a_gap_over_the_protocol(engine, name, gap):
    served, own = served_adapter(name), load_adapter(engine)
    assert served.gaps[gap] == own.gaps[gap] and gap not in served.unsupported
    found, expected = (one.evaluate(MODEL, STATES[:1])[0] for one in (served, own))
    assert np.array_equal(found.mass_matrix, expected.mass_matrix)


def test_an_adapter_served_over_the_protocol_answers_bit_for_bit_as_in_this_process():
    """The reference, as a program: a tree with loads, and a motion."""
    served = served_adapter("adapters.reference_engine:Reference")
    own = load_adapter("reference")
    assert served.describe().version == own.version() and served.builds_trees == own.builds_trees
    for found, expected in zip(served.evaluate(MODEL, STATES), own.evaluate(MODEL, STATES), strict=True):
        for name, value in vars(expected).items():
            assert np.array_equal(getattr(found, name), value), name
    method = own.integrators[0]
    runs = [one.simulate(MODEL, STATES[0], TIMES, method.name, 1e-8) for one in (served, own)]
    for name in ("t", "r", "p", "v"):
        assert np.array_equal(*(getattr(run, name) for run in runs)), name
    omega = [angular_velocity(run.p, run.pdot) for run in runs]  # ṗ along p is drift, which is not sent
    assert np.allclose(*omega, rtol=0, atol=1e-13)


@pytest.mark.parametrize("transcript", sorted(TRANSCRIPTS.glob("*.jsonl")), ids=lambda path: path.stem)
def test_a_stored_transcript_is_what_is_asked_and_answered_today(transcript):
    """Servers that were written for a version of the protocol are asked in the same words."""
    lines = [json.loads(line) for line in transcript.read_text(encoding="utf-8").splitlines()]
    asked, answers = lines[::2], lines[1::2]
    questions = {question["ask"]: question for question in asked}  # their numbers, on every processor
    model = Model.from_fields({name: x for name, x in questions["model"]["model"].items() if x != []})
    states = [
        State(**{name: np.array(x) for name, x in one.items()}) for one in questions["evaluate"]["states"]
    ]

    class Replay:
        has_ended = False

        def ask(self, question):
            number = len(seen)
            seen.append(json.loads(json.dumps({"id": number + 1, **question})))
            return {**answers[number]}

        def end(self):
            pass

    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "LineProcess", lambda command, variables: Replay())
        adapter = protocol.served_engine(["transcript"], {})
        adapter.evaluate(model, states)
        adapter.simulate(model, states[0], TIMES, "still", 0.1)
    assert seen == asked


def test_the_schemas_of_the_records_describe_what_servers_answer():
    schemas = protocol.protocol_schema()
    assert set(schemas["hello"]["required"]) == {
        "protocol",
        "name",
        "title",
        "version",
        "joints",
        "quantities",
    }
    assert set(schemas["simulate"]["required"]) == {"t", "r", "p", "v", "omega", "steps"}
    assert not schemas["evaluate: each of answers"].get("required")
