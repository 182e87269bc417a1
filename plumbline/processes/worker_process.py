"""A process that makes calls one at a time, and can be killed with every process that it started.

It runs in a scratch folder and a session of its own, reads nothing from the terminal, discards its output at
the level of file descriptors (engines print from C++), uses one BLAS thread and a limited address space, and
dies with its parent. Processes that an engine starts and leaves behind are adopted by the warm process.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import hashlib
import multiprocessing
import os
import pickle
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from multiprocessing import connection, forkserver, resource_tracker
from multiprocessing.context import BaseContext
from typing import Any

from plumbline.processes.exceptions import PlumblineError, describe_exception
from plumbline.processes.isolation import ScratchFolder, die_with_parent, kill_orphans, kill_tree
from plumbline.processes.record_encoding import EncodedRecord
from plumbline.processes.remote_python import RemoteCrash, call_remote, call_timed, describe_exit
from plumbline.processes.worker_environment import SINGLE_THREAD, TEMPORARY_FOLDER

_WARM_MODULE = "plumbline.processes.preloaded_libraries"
_MAX_FRAME = 2**29  # bytes of an answer; four printable characters that an engine writes are a larger number
_MAX_DESCRIPTOR = 2**16  # above those that a new process has open
_process_table = threading.Lock()  # held while processes start, are joined and are listed
_cpu_time = {"reported": 0.0}  # s of this worker that its replies account for


@dataclass(frozen=True)
class Pickled:
    """A pickled value: pickled once, and loaded only where it is used. Loading a pickle can run any code."""

    data: bytes

    @classmethod
    def of(cls, value: Any) -> Pickled:
        """Pickle a value.

        Args:
            value: any value that can be pickled.

        """
        return cls(pickle.dumps(value, protocol=5))

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 of the pickle."""
        return hashlib.sha256(self.data).digest()

    def load(self) -> Any:
        """Load the pickle.

        Returns:
            A new copy of the value.

        """
        return pickle.loads(self.data)


Packed = Pickled | EncodedRecord


def load_packed(value: Any) -> Any:
    """Load a value that may be given as bytes.

    Args:
        value: bytes of a value, or any other value.

    Returns:
        A new copy of the value, or the value itself.

    """
    return value.load() if isinstance(value, Packed) else value


@dataclass(frozen=True)
class Reply:
    """What came of a call."""

    answer: Pickled | None = None
    failure: str | None = None  # why there is no answer
    cpu_time: float = 0.0  # s of the call
    overhead_cpu_time: float = 0.0  # s of the worker besides it, since its last reply
    is_lost: bool = False  # whether the worker ended instead
    is_overdue: bool = False  # whether it was ended at the time limit
    is_out_of_memory: bool = False  # whether it reached the memory limit


class WorkerLost(PlumblineError):
    """The process ended before it replied; the message says how."""


class WorkerProcess:
    """A process that makes one call at a time. One thread uses it; any thread may kill it."""

    def __init__(
        self, context: BaseContext, initialize: Callable[..., None], arguments: Sequence[Any]
    ) -> None:
        """Start the process and wait until it is ready.

        Args:
            context: of `start_warm_process`.
            initialize: called there first, before any engine is loaded.
            arguments: of that call.

        Raises:
            WorkerLost: it ended before it was ready.

        """
        self._connection, other = context.Pipe()
        is_forked = context.get_start_method() == "forkserver"
        call = other, is_forked, initialize, tuple(arguments)
        with _process_table:
            process = context.Process(target=serve_calls, args=call)  # type: ignore[attr-defined]
            process.daemon = True  # ended by multiprocessing where its owner does not
            process.start()
        self._process: multiprocessing.process.BaseProcess = process
        other.close()
        self._reaper: int = 0  # process id of its parent, which adopts what it leaves behind
        ready = self._receive()
        if isinstance(ready, str):
            self.end()
            raise WorkerLost(f"cannot start: {ready}")
        self._reaper = ready

    def call(
        self, function: Callable[..., Any], arguments: Sequence[Any], python: str, gigabytes: float
    ) -> Reply:
        """Have the process make a call.

        Args:
            function: what to call; can be pickled.
            arguments: its arguments; pickled ones are loaded there.
            python: interpreter of another environment that makes the call; empty: the process itself.
            gigabytes: its limit of memory, for the message.

        Raises:
            WorkerLost: the process ended before it replied.

        """
        message = pickle.dumps((function, tuple(arguments), python, gigabytes), protocol=5)
        try:
            self._connection.send_bytes(message)
        except OSError:  # it ended after its last reply
            raise self._lost() from None
        reply: Reply = self._receive()
        return reply

    def _receive(self) -> Any:
        connection.wait([self._connection, self._process.sentinel])
        try:
            if self._connection.poll():  # a process may reply and end at once
                return pickle.loads(self._connection.recv_bytes(_MAX_FRAME))
        except (EOFError, ConnectionResetError):
            pass
        except Exception:  # an engine wrote into every descriptor
            self.kill()
            raise WorkerLost("did not reply, but something else was written into its pipe") from None
        raise self._lost()

    def _lost(self) -> WorkerLost:
        """How the process ended; it is killed where it has only closed its pipe."""
        connection.wait([self._process.sentinel], timeout=1.0)
        with _process_table:
            self._process.join(timeout=1.0)
        code = self._process.exitcode
        if code is None:
            self.kill()
        return WorkerLost("closed its pipe" if code is None else describe_exit(code))

    def kill(self) -> None:
        """Kill the process and its descendants; whoever waits for its reply gets `WorkerLost`."""
        assert self._process.pid is not None
        kill_tree(self._process.pid)
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(self._connection.fileno())) as other:
            other.shutdown(socket.SHUT_RDWR)  # an engine's child may hold the other end

    def end(self) -> None:
        """Kill the process, and what processes that ended have left behind."""
        self.kill()
        connection.wait([self._process.sentinel])
        self._connection.close()
        with _process_table:
            self._process.join()
            if self._reaper not in (0, os.getpid()):
                kill_orphans(
                    self._reaper, {p.pid for p in multiprocessing.active_children() if p.pid is not None}
                )


def serve_calls(
    pipe: Any, is_forked: bool, initialize: Callable[..., None], arguments: Sequence[Any]
) -> None:
    """Make the calls that arrive through a pipe until it is closed; the process ends with this function.

    Args:
        pipe: connection to the `WorkerProcess`.
        is_forked: whether no other descriptor is needed; the owner of a spawned process waits for one.
        initialize: called first.
        arguments: of that call.

    """
    own = os.getpid()
    try:
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]  # may have children
        if is_forked:
            _close_descriptors_except(pipe.fileno())
        try:
            initialize(*arguments)
            ready: int | str = os.getppid()
        except Exception as error:
            ready = describe_exception(error)
        pipe.send_bytes(pickle.dumps(ready))
        while True:
            reply = make_reply(pipe.recv_bytes())
            if os.getpid() != own:
                break  # a copy of the process that the engine made and that came back from its call
            pipe.send_bytes(pickle.dumps(reply, protocol=5))
    except EOFError:
        pass
    finally:
        os._exit(1)


def _close_descriptors_except(own: int) -> None:
    """Close what connects this process to others: an engine may write into every descriptor."""
    os.set_inheritable(own, False)
    os.closerange(3, own)
    os.closerange(own + 1, _MAX_DESCRIPTOR)
    resource_tracker._resource_tracker._fd = None  # type: ignore[attr-defined]  # an engine that needs one starts it


def make_reply(message: bytes) -> Reply:
    """Make a call; whatever it raises becomes the reason why there is no answer.

    Args:
        message: pickle of function, arguments, interpreter of another environment or "", memory limit [GB].

    """
    answer, failure, cost, python, gigabytes = None, None, 0.0, "", 0.0
    is_out_of_memory = False
    try:
        function, arguments, python, gigabytes = pickle.loads(message)
        loaded = [load_packed(one) for one in arguments]
        if python:
            value, cost = call_remote(python, call_timed, function, *loaded)
        else:
            value, cost = call_timed(function, *loaded)
        answer = Pickled.of(value)
    except MemoryError:
        is_out_of_memory = True
        failure = f"out of memory: over {gigabytes:g} GB of address space"
    except RemoteCrash as crash:
        failure = f"crashed: the worker {crash}"
    except BaseException as error:
        failure = describe_exception(error)
    if failure:
        gc.collect()  # of what filled the memory
    total = time.process_time()
    overhead = total - _cpu_time["reported"] - (0.0 if python else cost)
    _cpu_time["reported"] = total
    return Reply(answer, failure, cost, overhead, is_out_of_memory=is_out_of_memory)


def start_warm_process(modules: Sequence[str] = ()) -> BaseContext:
    """Start the process that loads the engines' libraries and from which workers are forked, if none runs.

    A command calls it first, so that the libraries are loaded while it reads its input.

    Args:
        modules: names of modules besides, that most workers will import; none that imports an engine.

    Returns:
        What starts workers: forked from that process, or anew where a platform cannot fork.

    """
    os.environ.update(SINGLE_THREAD)  # inherited by the workers, before NumPy loads there
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    _keep_sockets_in_scratch_folder()
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_WARM_MODULE, *modules])
    resource_tracker.ensure_running()  # its start unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # for the warm process: Ctrl-C is ours
    try:
        forkserver.ensure_running()  # in this thread: the warm process ends with the thread that started it
    except OSError:  # the path of its socket has at most 107 bytes, and TMPDIR may be longer
        return multiprocessing.get_context("spawn")
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


@cache
def _keep_sockets_in_scratch_folder() -> None:
    """Have multiprocessing put its sockets where the next run removes them if this process is killed."""
    folder = ScratchFolder()
    atexit.register(folder.remove)
    multiprocessing.current_process()._config["tempdir"] = str(folder.path)  # type: ignore[attr-defined]


def initialize_worker(scratch: str, gigabytes: float, parent: int, environment: Mapping[str, str]) -> None:
    """Prepare a worker process before its first task.

    Args:
        scratch: folder in which the worker makes its working folder.
        gigabytes: limit of its address space.
        environment: its environment variables; those of the warm process may be older.

    """
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(tempfile.mkdtemp(dir=scratch))
    os.environ.update(dict.fromkeys(TEMPORARY_FOLDER, os.getcwd()))  # removed with it
    tempfile.tempdir = None  # as found before
    for descriptor, mode in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        sink = os.open(os.devnull, mode)
        os.dup2(sink, descriptor)
        os.close(sink)
    for name in ("SIGINT", "SIGQUIT", "SIGHUP", "SIGTERM"):  # Windows has two of them
        # Background jobs ignore the first two, those of nohup the third; the warm process handles the last.
        usual = signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL
        if number := getattr(signal, name, None):
            signal.signal(number, usual)
    if hasattr(os, "setsid"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # blocked by `start_warm_process`
        os.setsid()  # Ctrl-C and what an engine sends to its process group stay apart
    die_with_parent(parent)
    with contextlib.suppress(ImportError, ValueError, OSError):  # no such limit on Windows
        import resource

        size = int(gigabytes * 2**30)
        # the hard limit stays: programs that answer lines get another limit
        resource.setrlimit(resource.RLIMIT_AS, (size, resource.getrlimit(resource.RLIMIT_AS)[1]))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
