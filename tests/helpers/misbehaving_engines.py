"""The reference as an engine that misbehaves at its import, in `version`, or while it evaluates states.

Each kind has the words of its failure, `RED` where its numbers must be found wrong, or `HARMLESS`.
"""

from __future__ import annotations

import gc
import locale
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from adapters.reference_engine import Reference
from plumbline.engines import registry
from plumbline.model.datatypes import EngineFailure, Model, State, StateQuantities, Unsupported
from plumbline.processes import worker_process
from tests.helpers import faults

RED, HARMLESS, REFUSED = "red", "harmless", "refused"
TIMEOUT = "timeout: no answer within"
Answers = list[StateQuantities]


class ManyArguments(Exception):
    """Cannot be loaded from its pickle."""

    def __init__(self, _: int, __: int) -> None:
        super().__init__("two arguments")


def throw(error: BaseException | type[BaseException]) -> Callable[..., Any]:
    def act(*_: Any) -> Any:
        raise error

    return act


def signal_itself(number: int) -> Callable[..., Any]:
    def act(*_: Any) -> Any:
        os.kill(os.getpid(), number)
        time.sleep(600)

    return act


def hang_deaf(*_: Any) -> None:
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGALRM):
        signal.signal(number, signal.SIG_IGN)
    while True:
        time.sleep(1)


def recurse(*arguments: Any) -> None:
    recurse(*arguments)


# -- what is done before the right answer ---------------------------------------------------------


def flood_without_newline() -> None:
    for _ in range(200):
        os.write(1, bytes(range(256)).replace(b"\n", b"") * 400)
        os.write(2, b"x" * 100_000)


def read_stdin() -> None:
    assert os.read(0, 100) == b""


def fork_child() -> None:
    if not os.fork():
        time.sleep(600)
        os._exit(0)


def start_daemon() -> None:
    if not os.fork():
        os.setsid()
        if os.fork():
            os._exit(0)
        time.sleep(600)
        os._exit(0)


def spoil_numpy() -> None:
    for name in ("cross", "sum", "max", "abs", "linalg"):
        setattr(np, name, None)


def change_process() -> None:
    os.environ.clear()
    sys.path.clear()
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002 (engines use it)
    np.seterr(all="raise")
    np.set_printoptions(precision=1)
    os.umask(0o777)
    locale.setlocale(locale.LC_ALL, "C")
    warnings.simplefilter("error")
    sys.setrecursionlimit(200)
    sys.stdout = sys.stderr = None
    gc.disable()
    for number in (signal.SIGTERM, signal.SIGCHLD, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)


BEFORE: dict[str, tuple[Callable[[], Any], str]] = {
    "close_standard_descriptors": (lambda: os.closerange(0, 3), HARMLESS),
    "flood_without_newline": (flood_without_newline, HARMLESS),
    "read_stdin": (read_stdin, HARMLESS),
    "use_a_gigabyte": (lambda: np.ones(2**27), HARMLESS),
    "fork_and_return": (lambda: os.fork(), HARMLESS),
    "fork_child": (fork_child, HARMLESS),
    "start_daemon": (start_daemon, HARMLESS),
    "start_program": (lambda: subprocess.Popen(["sleep", "600"], start_new_session=True), HARMLESS),
    "leave_thread": (
        lambda: threading.Thread(target=time.sleep, args=(600,), daemon=False).start(), HARMLESS,
    ),
    "change_process": (change_process, HARMLESS),
    "change_folder": (lambda: os.chdir("/"), HARMLESS),
    "lower_limits": (lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3)), HARMLESS),
    "spoil_numpy": (spoil_numpy, HARMLESS),
}  # fmt: skip

# -- what is done instead of the answer -----------------------------------------------------------

INSTEAD: dict[str, tuple[Callable[..., Any], str]] = {
    "raises": (throw(RuntimeError("own words\nin two lines")), "RuntimeError: own words in two lines"),
    "long_message": (throw(RuntimeError("x" * 1_000_000)), "(cut: 1,000,000 characters)"),
    "long_failure": (throw(EngineFailure("x" * 1_000_000)), "(cut: 1,000,000 characters)"),
    "odd_message": (throw(RuntimeError("\x1b[2J\ud800\0<b>")), r"\x1b[2J\ud800\x00<b>"),
    "long_refusal": (throw(Unsupported("y" * 1_000_000)), REFUSED),
    "refusal_of_no_text": (throw(Unsupported(None)), REFUSED),
    "interrupt": (throw(KeyboardInterrupt), "KeyboardInterrupt: no message"),
    "system_exit": (throw(SystemExit(0)), "SystemExit: 0"),
    "generator_exit": (throw(GeneratorExit), "GeneratorExit: no message"),
    "stop_iteration": (throw(StopIteration), "StopIteration: no message"),
    "base_exception": (throw(BaseException("base")), "BaseException: base"),
    "unprintable": (throw(faults.Unprintable), "Unprintable: no readable message"),
    "many_arguments": (throw(ManyArguments(1, 2)), "ManyArguments: two arguments"),
    "exception_group": (throw(BaseExceptionGroup("g", [KeyboardInterrupt()])), "BaseExceptionGroup: g"),
    "memory_error": (throw(MemoryError), "out of memory"),
    "timeout_error": (throw(TimeoutError), "TimeoutError: no message"),
    "end_of_file": (throw(EOFError), "EOFError: no message"),
    "broken_pipe": (throw(BrokenPipeError), "BrokenPipeError: no message"),
    "exit_0": (faults.exit_0, "crashed: the worker exited with code 0"),
    "exit_7": (faults.exit_7, "crashed: the worker exited with code 7"),
    "exit_by_c": (faults.exit_by_c, "crashed: the worker exited with code 0"),
    "exit_by_thread": (faults.exit_by_thread, "crashed: the worker exited with code 0"),
    "segfault": (faults.segfault, "crashed: the worker died of SIGSEGV"),
    "abort": (faults.abort, "crashed: the worker died of SIGABRT"),
    "sigint": (faults.interrupt_by_signal, "KeyboardInterrupt: no message"),
    "sigterm": (signal_itself(signal.SIGTERM), "crashed: the worker died of SIGTERM"),
    "sigkill": (signal_itself(signal.SIGKILL), "crashed: the worker died of SIGKILL"),
    "sigstop": (faults.stop_itself, TIMEOUT),
    "end_its_group": (faults.end_its_group, "crashed: the worker died of SIGKILL"),
    "hang": (faults.hang, TIMEOUT),
    "hang_in_c": (faults.hang_in_c, TIMEOUT),
    "hang_deaf": (hang_deaf, TIMEOUT),
    "fill_memory": (lambda *_: bytearray(2**34), "out of memory"),
    "recurse": (recurse, "RecursionError"),
    "close_descriptors": (faults.close_descriptors, "crashed: the worker"),
    "write_everywhere": (faults.write_everywhere, "crashed: the worker did not reply"),
}

# -- wrong answers --------------------------------------------------------------------------------


def with_field(**changes: Callable[[Any], Any]) -> Callable[[Answers], Any]:
    """Change fields of the first answer."""

    def change(right: Answers) -> Answers:
        values = {name: make(getattr(right[0], name)) for name, make in changes.items()}
        return [replace(right[0], **values), *right[1:]]

    return change


def each_field(make: Callable[[Any], Any]) -> Callable[[Answers], Any]:
    return with_field(acceleration=make)


ARRAY = "state 0: acceleration is {}, must be an array of float64 of shape (1, 3)"
NUMBER = "state 0: kinetic_energy is {}, must be a real number, or None"
ANSWERS: dict[str, tuple[Callable[[Answers], Any], str]] = {
    "list": (each_field(lambda a: a.tolist()), ARRAY.format("a value of type list of 1")),
    "tuple": (each_field(lambda a: tuple(a[0])), ARRAY.format("a value of type tuple of 3")),
    "text": (each_field(lambda a: "fast"), ARRAY.format("the text 'fast'")),
    "none": (each_field(lambda a: None), ARRAY.format("None")),
    "number": (each_field(lambda a: 1.0), ARRAY.format("the float 1.0")),
    "complex": (each_field(lambda a: a + 0j), ARRAY.format("an array of complex128 of shape (1, 3)")),
    "float32": (each_field(np.float32), ARRAY.format("an array of float32 of shape (1, 3)")),
    "integers": (each_field(lambda a: a.astype(int)), ARRAY.format("an array of int64 of shape (1, 3)")),
    "objects": (each_field(lambda a: a.astype(object)), ARRAY.format("an array of object of shape (1, 3)")),
    "big_endian": (each_field(lambda a: a.astype(">f8")), ARRAY.format("an array of >f8 of shape (1, 3)")),
    "matrix": (each_field(np.matrix), ARRAY.format("a matrix of float64 of shape (1, 3)")),
    "masked": (each_field(np.ma.masked_array), ARRAY.format("a MaskedArray of float64 of shape (1, 3)")),
    "flat": (each_field(np.ravel), "acceleration has shape (3,), expected (1, 3)"),
    "transposed": (each_field(np.transpose), "acceleration has shape (3, 1), expected (1, 3)"),
    "padded": (each_field(lambda a: np.pad(a, 1)), "acceleration has shape (3, 5), expected (1, 3)"),
    "empty": (each_field(lambda a: a[:0]), "acceleration has shape (0, 3), expected (1, 3)"),
    "nan": (each_field(lambda a: a * np.nan), "acceleration is not finite"),
    "infinite": (each_field(lambda a: a + np.inf), "acceleration is not finite"),
    "energy_text": (with_field(kinetic_energy=str), "kinetic_energy is the text"),
    "energy_array": (with_field(kinetic_energy=np.array), NUMBER.format("an array of float64 of shape ()")),
    "energy_complex": (with_field(kinetic_energy=complex), "kinetic_energy is the complex"),
    "energy_bool": (with_field(kinetic_energy=bool), NUMBER.format("True")),
    "energy_overflow": (with_field(kinetic_energy=lambda e: 1e308 * 10), "kinetic_energy is not finite"),
    "momentum_list": (with_field(angular_momentum=list), "angular_momentum is a value of type list of 3"),
    "mass_matrix_flat": (with_field(mass_matrix=np.ravel), "mass_matrix has shape (9,), expected (3, 3)"),
    "reaction_dict": (with_field(joint_reaction=lambda f: {"f": f}), "joint_reaction is a value"),
    "limits_list": (with_field(limit_error=lambda _: [1.0]), "limit_error is a value of type list of 1"),
    "limits_of_nothing": (with_field(limit_error=lambda _: {"speed": 1.0}), "limit_error is a value"),
    "records_dict": (lambda right: [vars(one) for one in right], "must be a StateQuantities"),
    "no_list": (lambda right: None, "returned None, must be a list of StateQuantities"),
    "generator": (lambda right: (one for one in right), "returned a value of type generator"),
    "too_few": (lambda right: right[1:], "answered 10 of 11 states"),
    "nothing": (lambda right: [], "answered 0 of 11 states"),
    "one_many_times": (lambda right: right[:1] * len(right), RED),
    "reversed": (lambda right: right[::-1], RED),
    "scaled": (lambda right: [replace(a, acceleration=1.000001 * a.acceleration) for a in right], RED),
}  # fmt: skip


# -- declarations ---------------------------------------------------------------------------------

VERSION = "version() is {}, must be a line of 1 to 200 characters"
DECLARED: dict[str, tuple[dict[str, Any], str]] = {
    "version_none": ({"version": lambda _: None}, VERSION.format("None")),
    "version_empty": ({"version": lambda _: ""}, VERSION.format("the text ''")),
    "version_tuple": ({"version": lambda _: (1, 2)}, VERSION.format("a value of type tuple of 2")),
    "version_bytes": ({"version": lambda _: b"1.0"}, VERSION.format("a value of type bytes")),
    "version_long": ({"version": lambda _: "1" * 100_000}, VERSION.format("a text of 100,000 characters")),
    "version_lines": ({"version": lambda _: "1\n2"}, VERSION.format("the text '1\\n2'")),
    "version_raises": ({"version": throw(KeyboardInterrupt)}, "KeyboardInterrupt: no message"),
    "version_exits": ({"version": faults.exit_0}, "crashed: the worker exited with code 0"),
    "version_odd": ({"version": lambda _: "new", "supported_versions": ">=1"}, "must be a PEP 440 version"),
    "title_none": ({"title": None}, "title is None, must be str"),
    "name_number": ({"name": 3}, "name is the int 3, must be str"),
    "integrators_none": ({"integrators": None}, "integrators is None, must be tuple[Integrator, ...]"),
    "integrators_texts": ({"integrators": ("rk4",)}, "integrators[0] is a value of type tuple of 1"),
    "order_text": ({"integrators": (replace(Reference.integrators[0], order="4"),)}, "order is the text '4'"),
    "order_none": ({"integrators": (replace(Reference.integrators[0], order=0),)}, "has order 0"),
    "kind_odd": ({"integrators": (replace(Reference.integrators[0], kind="x"),)}, "kind is the text 'x'"),
    "twice": ({"integrators": Reference.integrators[:1] * 2}, "has a name twice"),
    "unsupported_list": ({"unsupported": ["rods"]}, "unsupported is a value of type list"),
    "flag_text": ({"builds_trees": "yes"}, "builds_trees is the text 'yes', must be bool"),
    "range_odd": ({"supported_versions": "new"}, "supported_versions is no range of versions"),
}  # fmt: skip

AT_IMPORT: dict[str, tuple[Callable[..., Any], str]] = {
    **{name: INSTEAD[name] for name in (
        "raises", "interrupt", "system_exit", "unprintable", "exit_0", "exit_by_c", "exit_by_thread", "abort",
        "segfault", "hang", "memory_error", "sigint", "write_everywhere", "close_descriptors",
    )},
    "broken_library": (throw(ImportError("libengine.so: no symbol")), "libengine.so: no symbol"),
    "syntax_error": (lambda *_: compile("(", "engine.py", "exec"), "SyntaxError"),
}  # fmt: skip


def _before(act: Callable[[], None]) -> Callable[..., Any]:
    def _evaluate(self: Any, model: Model, states: list[State]) -> Answers:
        right = Reference()._evaluate(model, states)
        act()
        return right

    return _evaluate


def _after(change: Callable[[Answers], Any]) -> Callable[..., Any]:
    return lambda self, model, states: change(Reference()._evaluate(model, states))


def _spoil_arguments(self: Any, model: Model, states: list[State]) -> Answers:
    right = Reference()._evaluate(model, states)
    for array in (*vars(model).values(), *(value for state in states for value in vars(state).values())):
        if isinstance(array, np.ndarray):
            array.setflags(write=True)
            array[...] = 0
    return right


EXPECTED: dict[str, str] = {
    "arguments_changed": HARMLESS,
    "NOT_AN_ADAPTER": "must be a class derived from Adapter",
    "misspelt": "has no attribute 'misspelt'",
}
_METHODS: dict[str, dict[str, Any]] = {"arguments_changed": {"_evaluate": _spoil_arguments}}
_WAYS: dict[str, tuple[dict[str, tuple[Any, str]], Callable[[Any], dict[str, Any]]]] = {
    "after": (BEFORE, lambda act: {"_evaluate": _before(act)}),
    "evaluation": (INSTEAD, lambda act: {"_evaluate": act}),
    "answers": (ANSWERS, lambda change: {"_evaluate": _after(change)}),
    "declared": (DECLARED, lambda members: members),
}
for _way, (_table, _members) in _WAYS.items():
    for _name, (_what, _words) in _table.items():
        EXPECTED[f"{_way}_{_name}"], _METHODS[f"{_way}_{_name}"] = _words, _members(_what)
for _name, (_, _words) in AT_IMPORT.items():
    EXPECTED[f"import_{_name}"] = _words

FAST = (
    "import_exit_0", "evaluation_interrupt", "evaluation_unprintable", "declared_version_none",
    "answers_list", "after_start_daemon",
)  # fmt: skip
NOT_AN_ADAPTER = dict


def __getattr__(name: str) -> Any:
    """Make an adapter when the registry imports it, which is when some misbehave."""
    if name in _METHODS:
        return type("Misbehaving", (Reference,), {"name": name, "title": name} | _METHODS[name])
    if name.removeprefix("import_") in AT_IMPORT:
        return AT_IMPORT[name.removeprefix("import_")][0]()
    raise AttributeError(f"the file has no attribute {name!r}")


def places() -> dict[str, str]:
    """The engines as the registry names them."""
    return {name: f"{__name__}:{name}" for name in EXPECTED}


def prepare_worker(*arguments: Any) -> None:
    """Initialise a worker and register the engines there."""
    worker_process.initialize_worker(*arguments)
    registry.ENGINES.update(places())
