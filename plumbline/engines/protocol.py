"""Protocol 1: an engine in any language as a program that answers lines of JSON.

Each question is one line with `id` and `ask`, each answer one line with the same `id`, strictly in order;
numbers are shortest decimals of doubles. Instead of its fields an answer may have `unsupported` or `error`, a
sentence. `cpu` is optional: CPU seconds. The end of the standard input ends the program.

    hello      protocols              → the fields of `Hello`
    echo       values                 → values, the same doubles, bit for bit
    model      model_id, model        → nothing: the fields of the mechanism, of which `evaluate` speaks
    evaluate   model_id, states       → answers, a `StateAnswer` for each state
    simulate   model_id, state, times, integrator, resolution → the fields of `RunAnswer`

`ServedEngine` is the adapter of every such program.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from plumbline.engines.adapter import MODEL_GAPS, UNSUPPORTED_KINDS, Adapter
from plumbline.engines.answers import describe_value
from plumbline.model.datatypes import (
    KINDS,
    Array,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
    Unsupported,
)
from plumbline.model.kinematics import quaternion_rate
from plumbline.model.lift import BallRates, lift_acceleration
from plumbline.processes.exceptions import one_line
from plumbline.processes.line_process import LineFault, LineProcess, Message

VERSIONS = (1,)  # of the protocol that this side speaks, the best first; a new one keeps the one before
QUANTITIES = tuple(f.name for f in fields(StateQuantities) if f.name != "limit_error")
_ECHOED = (0.1, -1 / 3, 2.0**-1074, 1.7976931348623157e308, -0.0, 123456789.123456789)
_Numbers = list[Any]  # numbers, or lists of them


@dataclass(frozen=True)
class IntegratorAnswer:
    """A method of the engine: the fields of `Integrator` but for the formula of its step."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    name: str
    kind: Literal["step", "tolerance"]
    order: int
    error_exponents: tuple[int, ...] = ()
    is_symmetric: bool = False
    solver_rtol: float = 0.0
    min_rtol: float = 1e-12
    alias_of: str | None = None
    note: str = ""


@dataclass(frozen=True)
class Hello:
    """What an engine is, and what it can and cannot do."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    protocol: Literal[1]  # one of those that the question offers
    name: str
    title: str
    version: str
    joints: tuple[str, ...]  # kinds that it builds
    quantities: tuple[str, ...]  # fields of `StateAnswer` that it returns
    precision: Literal["double"] = "double"
    integrators: tuple[IntegratorAnswer, ...] = ()
    # what of these it builds; a mechanism with another is not sent
    has: tuple[Literal["trees", "loads", "elements", "loops", "loop motions"], ...] = ()
    # further gaps, each with the reason in a sentence: a key of `MODEL_GAPS` or `UNSUPPORTED_KINDS`, or a
    # quantity that some mechanisms lack
    gaps: Mapping[str, str] = field(default_factory=dict)
    # `joint_acceleration` of balls: ω̇′, or the rate of the relative angular velocity in near or far axes
    ball_rates: BallRates = "body"


@dataclass(frozen=True)
class StateAnswer:
    """What an engine computes at one state; either the first two fields or the third."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    acceleration: _Numbers | None = None  # (N, 3) m/s², of the centres of mass, world frame
    angular_acceleration: _Numbers | None = None  # (N, 3) rad/s², ω̇′, body frame
    # joint by joint: ü and ω̇′ of rods, ω̇′ of balls, r̈ and ω̇′ of free bodies, ẍ of the others
    joint_acceleration: _Numbers | None = None
    joint_reaction: _Numbers | None = None  # the others as in `StateQuantities`
    kinetic_energy: float | None = None
    potential_energy: float | None = None
    angular_momentum: _Numbers | None = None
    mass_matrix: _Numbers | None = None
    joint_moment: _Numbers | None = None
    limit_error: Mapping[str, float] | None = None


@dataclass(frozen=True)
class RunAnswer:
    """Samples of a run, row 0 the initial state."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    t: _Numbers  # (T,) s
    r: _Numbers  # (T, N, 3) m, world frame
    p: _Numbers  # (T, N, 4) body → world, scalar first
    v: _Numbers  # (T, N, 3) m/s, world frame
    omega: _Numbers  # (T, N, 3) rad/s, body frame
    steps: int


def to_json(value: Any) -> Any:
    """Convert a mechanism or a state to lists and numbers.

    Args:
        value: a dataclass or mapping of arrays, a list of such, an array, or a plain value.

    """
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [to_json(one) for one in value]
    if is_dataclass(value):
        value = vars(value)
    return {name: to_json(one) for name, one in value.items()} if isinstance(value, Mapping) else value


def read_answer(kind: type, answer: Message, label: str) -> Any:
    """Check the fields of an answer against its record.

    Args:
        kind: `Hello`, `StateAnswer` or `RunAnswer`.
        label: program and question, for the message.

    Raises:
        EngineFailure: a field is missing, unknown or of another type.

    """
    try:
        return _validator(kind).validate_json(json.dumps(answer), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the answer"
        raise EngineFailure(f"{label}: {one_line(where)}: {first['msg'].lower()}") from None


def protocol_schema() -> dict[str, Any]:
    """Return the JSON Schemas of the answers, by the question."""
    records = {"hello": Hello, "evaluate: each of answers": StateAnswer, "simulate": RunAnswer}
    return {name: _validator(kind).json_schema() for name, kind in records.items()}


@cache
def _validator(kind: type) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _array(value: _Numbers | None, label: str) -> Array | None:
    """Make an array of nested lists of numbers; of other things raise EngineFailure."""
    if value is None:
        return None
    try:
        found = np.array(value)
    except ValueError:
        raise EngineFailure(f"{label} has rows of different lengths") from None
    if found.dtype.kind not in "if":
        raise EngineFailure(f"{label} is {describe_value(found)}, must hold numbers")
    return found.astype(float)


class ServedEngine(Adapter):
    """An engine that answers protocol 1; `served_engine` makes a subclass with what its `hello` declares."""

    command: ClassVar[tuple[str, ...]]
    variables: ClassVar[Mapping[str, str]]
    hello: ClassVar[Hello]

    def version(self) -> str:
        """Return the version that the program reports."""
        return self.hello.version

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        answer = self._ask(model, {"ask": "evaluate", "states": to_json(states)})
        found = answer.get("answers")
        if not isinstance(found, list) or len(found) != len(states):
            raise EngineFailure(
                f"{self.name}: evaluate returned {describe_value(found)} as answers, must be {len(states)}"
            )
        return [self._quantities(model, state, one) for state, one in zip(states, found, strict=True)]

    def _quantities(self, model: Model, state: State, answer: Any) -> StateQuantities:
        label = f"{self.name}: evaluate"
        if not isinstance(answer, dict):
            raise EngineFailure(f"{label} returned {describe_value(answer)}, must be quantities by name")
        found: StateAnswer = read_answer(StateAnswer, answer, label)
        given = {name for name, value in vars(found).items() if value is not None} - {"limit_error"}
        if surplus := given - {*self.hello.quantities}:
            raise EngineFailure(f"{label} returns the {min(surplus)} that its hello does not declare")
        arrays: dict[str, Any] = {
            name: _array(value, f"{label}: {name}") if isinstance(value, list) else value
            for name, value in vars(found).items()
        }
        lifted = arrays.pop("joint_acceleration")
        if lifted is not None:
            if twice := given & {"acceleration", "angular_acceleration"}:
                raise EngineFailure(f"{label} returns the {min(twice)} besides the joint_acceleration")
            moved = lift_acceleration(
                model, state, lifted, self.hello.ball_rates, f"{label}: joint_acceleration"
            )
            arrays["acceleration"], arrays["angular_acceleration"] = moved
        return StateQuantities(**arrays)

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        question = {"state": to_json(state), "times": times.tolist(), "integrator": integrator.name}
        answer = self._ask(model, {"ask": "simulate", **question, "resolution": resolution})
        label = f"{self.name}: simulate"
        run: RunAnswer = read_answer(RunAnswer, answer, label)
        t, r, p, v, omega = (_array(getattr(run, n), f"{label}: {n}") for n in ("t", "r", "p", "v", "omega"))
        assert t is not None and r is not None and p is not None and v is not None and omega is not None
        if omega.shape != r.shape or p.shape != (*r.shape[:-1], 4):
            raise EngineFailure(
                f"{label}: r, p and omega have the shapes {r.shape}, {p.shape}, {omega.shape}"
            )
        return Trajectory(t, r, p, v, quaternion_rate(p, omega), run.steps)

    def _gaps_of_calls(self, model: Model, moves: bool) -> dict[str, bool]:
        lacks_joints = not {*model.kind} <= {*self.hello.joints}
        return super()._gaps_of_calls(model, moves) | {"joints": lacks_joints}

    def _ask(self, model: Model, question: Message) -> Message:
        """Ask about a mechanism, which the program gets first where it has another."""
        for kind in sorted({*model.kind} - {*self.hello.joints}):
            raise Unsupported(f"{self.title} builds no {kind} joints", "joints")
        program = _program(self.command, self.variables, self.hello)
        described = to_json(model)
        name = hashlib.sha256(json.dumps(described).encode()).hexdigest()[:16]
        if program.model_id != name:
            program.model_id = ""  # it may keep a mechanism that it refuses
            program.ask({"ask": "model", "model_id": name, "model": described})
            program.model_id = name
        return program.ask({**question, "model_id": name})


class _Program:
    """The running program of this worker; started again after a fault."""

    def __init__(self, command: Sequence[str], variables: Mapping[str, str]) -> None:
        self.label = " ".join(command)
        self.model_id = ""
        try:
            self._lines = LineProcess(command, variables)
        except LineFault as fault:
            raise EngineFailure(f"{self.label} {fault}") from None
        try:
            self.hello = self._greet()
        except BaseException:
            self._lines.end()
            raise

    def _greet(self) -> Hello:
        """Ask who the program is, and prove that it reads and writes doubles as they are."""
        answer = self.ask({"ask": "hello", "protocols": VERSIONS})
        if answer.get("protocol") not in VERSIONS:
            spoken, known = describe_value(answer.get("protocol")), ", ".join(map(str, VERSIONS))
            raise EngineFailure(f"{self.label}: hello: protocol is {spoken}, known is {known}")
        hello: Hello = read_answer(Hello, answer, f"{self.label}: hello")
        if unknown := {*hello.joints} - {*KINDS}:
            raise EngineFailure(f"{self.label}: hello: no kind of joint is called {min(unknown)}")
        if unknown := {*hello.quantities} - {*QUANTITIES, "joint_acceleration"}:
            raise EngineFailure(f"{self.label}: hello: no quantity is called {min(unknown)}")
        values = [*_ECHOED, *np.random.default_rng(1).normal(size=100)]
        echoed = self.ask({"ask": "echo", "values": values}).get("values")
        if not isinstance(echoed, list) or [_bits(x) for x in echoed] != [_bits(x) for x in values]:
            raise EngineFailure(
                f"{self.label}: echo returns other numbers: its reader or writer of JSON rounds"
            )
        return hello

    def ask(self, question: Message) -> Message:
        try:
            answer = self._lines.ask(question)
        except LineFault as fault:
            raise EngineFailure(f"{self.label} {fault}, when asked to {question['ask']}") from None
        answer.pop("id")
        answer.pop("cpu", None)
        if "unsupported" in answer:
            raise Unsupported(one_line(str(answer["unsupported"])), str(answer.get("gap", "")))
        if "error" in answer:
            raise EngineFailure(one_line(str(answer["error"])))
        return answer

    @property
    def has_ended(self) -> bool:
        return self._lines.has_ended


def _bits(value: Any) -> bytes:
    return np.float64(value).tobytes() if isinstance(value, int | float) else b""


_running: dict[tuple[str, ...], _Program] = {}  # of this worker, by command and variables


def _program(command: Sequence[str], variables: Mapping[str, str], expected: Hello | None = None) -> _Program:
    """The program of this worker: a new one where there is none or it has ended."""
    key = (*(f"{name}={value}" for name, value in variables.items()), *command)
    if key not in _running or _running[key].has_ended:
        _running[key] = _Program(command, variables)
    program = _running[key]
    if expected is not None and program.hello != expected:
        raise EngineFailure(f"{program.label}: hello is not what it was at first")
    return program


def served_engine(command: Sequence[str], variables: Mapping[str, str]) -> ServedEngine:
    """Start a program, and make its adapter of what it declares.

    Args:
        command: program and arguments.
        variables: environment variables that it gets besides the usual ones.

    Raises:
        EngineFailure: it does not start, or does not speak the protocol.

    """
    hello = _program(command, variables).hello
    title = hello.title
    absent = {*QUANTITIES} - {*hello.quantities} - {"acceleration", "angular_acceleration"}
    gaps = {name: f"{title} returns no {name.replace('_', ' ')}" for name in sorted(absent)}
    if "loads" not in hello.has:
        gaps["loads"] = f"{title} applies no loads"
    if not hello.integrators:
        gaps["integrators"] = f"{title} evaluates states and does not simulate"
    gaps |= {"joints": f"{title} builds other kinds of joints", **hello.gaps}
    # A quantity that it returns is a gap of some mechanisms only.
    never = {*UNSUPPORTED_KINDS} - {*hello.quantities}
    unsupported = {name: why for name, why in gaps.items() if name in never}
    declared = {
        "command": tuple(command),
        "variables": dict(variables),
        "hello": hello,
        "name": hello.name,
        "title": title,
        "package": hello.name,
        "integrators": tuple(Integrator(**vars(one)) for one in hello.integrators),
        "unsupported": unsupported,
        "gaps": {name: why for name, why in gaps.items() if name in MODEL_GAPS or name not in unsupported},
        "is_lifted": "joint_acceleration" in hello.quantities,
        "builds_trees": "trees" in hello.has,
        "builds_elements": "elements" in hello.has,
        "loops_unsupported_reason": "" if "loops" in hello.has else f"{title} builds no closed loops",
        "moves_loops": "loop motions" in hello.has,
    }
    found: ServedEngine = type("Served", (ServedEngine,), declared)()
    return found
