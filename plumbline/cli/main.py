"""The command group: `python -m plumbline`."""

from __future__ import annotations

import errno
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import FrameType
from typing import Any

import click

from plumbline import __version__
from plumbline.cli.help_texts import EXIT_CODES
from plumbline.execution.exit_codes import ExitCode
from plumbline.processes.worker_environment import SINGLE_THREAD
from plumbline.scenario.line_and_column_errors import Problem, nearest_or_all, shorten

SECONDS_TO_NEXT_TRY = 0.05  # of an interruption that came during an import
FILE_COMMANDS = ("run", "nightly", "check", "sweep", "prove", "coverage")  # whose arguments are YAML files
START = """
\b
Start with:
  python -m plumbline list scenarios
  python -m plumbline run double-tumbling-balls
  python -m plumbline run                  (everything; 6 to 19 minutes)
"""


COMMANDS = {  # where each is, and its line in the list; imported when it is typed: all of them take a second
    "list": ("scenario_commands:list_", "List scenarios, engines or their surface."),
    "run": ("run_commands:run", "Compare scenarios on engines."),
    "model": ("model_commands:model", "Compare what importers make of a URDF or MJCF file."),
    "nightly": ("run_commands:nightly", "Run everything unattended and keep the history."),
    "fuzz": ("fuzz_command:fuzz", "Search for new findings with random mechanisms."),
    "sweep": ("study_commands:sweep", "Vary a scenario's parameters."),
    "drift": ("study_commands:drift", "Measure constraint and energy drift over long times."),
    "coverage": ("study_commands:coverage", "Compute the smallest mistakes that a run would report."),
    "prove": ("proof_commands:prove", "Enclose motions rigorously and write certificates."),
    "verify": ("proof_commands:verify", "Prove certificates again."),
    "history": ("result_commands:history", "Compare stored nights."),
    "explain": ("result_commands:explain", "Print everything that is known about a finding."),
    "known": ("result_commands:known", "Write files of known issues by finding."),
    "report": ("result_commands:report", "Write the report of stored results again."),
    "check": ("scenario_commands:check", "Check scenario files."),
    "contract": ("engine_commands:contract", "Test an engine of your own."),
    "serve": ("engine_commands:serve", "Offer a Python adapter as a program that answers lines."),
    "schema": ("scenario_commands:schema", "Print the JSON Schema of scenario files."),
    "bisect": ("bisect_command:bisect", "Find the version of an engine that changed an answer."),
    "reproduce": ("result_commands:reproduce", "Write a stand-alone script of a disagreement."),
}


class LazyGroup(click.Group):
    """A group that imports a command when it is used, and suggests the nearest name for an unknown one."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the names of the commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command.

        Returns:
            The command; None where there is none of that name.

        """
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name][0].partition(":")
        command: click.Command = getattr(import_module(f"plumbline.cli.{module}"), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name][1]) for name in self.list_commands(ctx)])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the first argument names.

        Returns:
            The command's name, the command and its arguments.

        Raises:
            UsageError: there is no such command.

        """
        if args and args[0] not in COMMANDS:
            raise click.UsageError(f"no command {args[0]!r}; {nearest_or_all(args[0], COMMANDS)}", ctx)
        if args and args[0] in FILE_COMMANDS and (missing := _missing_files(args[1:])):
            for word in missing:
                problem = Problem(word, 0, 0, "", "cannot be read: No such file or directory")
                click.echo(str(problem), err=True)
            sys.exit(ExitCode.BAD_USAGE)
        return super().resolve_command(ctx, args)

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run as a program; where not even an error can be written, the machine has failed.

        Args:
            *args: of `click.Group.main`.
            **extra: of `click.Group.main`.

        Returns:
            What the command returns, where click does not exit.

        """
        os.environ.update(SINGLE_THREAD)  # before a command loads NumPy: threads only wait for each other
        try:
            return super().main(*args, **extra)
        except OSError:
            sys.exit(ExitCode.MACHINE_FAILED)
        finally:
            _drop_words_that_cannot_be_written()

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; an interruption or an internal error ends with its own exit code and a sentence."""
        _make_streams_writable()
        try:
            with _termination_as_interrupt():
                return super().invoke(ctx)
        except KeyboardInterrupt as interruption:
            resume = " ".join(("run the same command", *interruption.args, "to resume"))
            # the result cache of `run` and `nightly`
            is_kept = ctx.obj is not None and ctx.obj.holds_everything
            end = f"; finished cells are kept, {resume}" if is_kept else ""
            click.echo(f"\ninterrupted{end}", err=True)
            # CPython remembers an interruption that passed through exec(), as of a dataclass being made, and
            # would end with the signal instead of the exit code; the next exec() makes it forget.
            exec("")
            sys.exit(ExitCode.INTERRUPTED)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except (OSError, MemoryError) as error:
            if getattr(error, "errno", None) == errno.EPIPE:
                raise  # click ends quietly where the reader of a pipe has gone
            what = "I/O error" if isinstance(error, OSError) else "out of memory"
            click.echo(f"{what}: {error}", err=True)
            sys.exit(ExitCode.MACHINE_FAILED)
        except Exception as error:
            words = shorten(" ".join(str(error).split()), 200)
            what = f"internal error: {type(error).__name__}: {words}"
            click.echo(f"{what}; the traceback is in {_write_traceback()}", err=True)
            sys.exit(ExitCode.HARNESS_FAILED)


def _missing_files(words: Sequence[str]) -> list[str]:
    """Name the YAML files among a command's arguments if none of its arguments exists.

    A misspelt path is so reported before the imports of the command, which take longer. What follows an
    option may be its value; where another file exists the command reports the mistakes of all files.
    """
    pairs = zip(("", *words), words, strict=False)
    arguments = [
        word
        for before, word in pairs
        if not word.startswith("-") and ("=" in before or not before.startswith("-"))
    ]
    are_missing = all(word.endswith((".yaml", ".yml")) and _is_missing(word) for word in arguments)
    return arguments if are_missing and not {"-h", "--help"} & {*words} else []


def _is_missing(path: str) -> bool:
    try:
        os.lstat(path)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):  # without permission, too long, or with a null character
        return False
    return False


def _make_streams_writable() -> None:
    """Let a closed stream take words, and one of another encoding take all letters."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the shell, as in `>&-`
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif getattr(stream, "errors", "") == "strict":
            stream.reconfigure(errors="backslashreplace")


def _drop_words_that_cannot_be_written() -> None:
    """Empty the buffers of full disks: Python would try again at its end, and exit with its own code 120."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextmanager
def _termination_as_interrupt() -> Iterator[None]:
    """Treat SIGTERM and SIGHUP like Ctrl-C, so that workers and temporary folders are removed.

    A compiled module can swallow an exception that is raised while it is loaded (numpy.random does), so an
    interruption waits until no import is under way.
    """

    def interrupt(_: int, frame: FrameType | None) -> None:
        if _is_importing(frame) and hasattr(signal, "setitimer"):  # Windows has no timer
            signal.setitimer(signal.ITIMER_REAL, SECONDS_TO_NEXT_TRY)
        else:
            raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGALRM"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            usual = signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL
            if number is not None and signal.getsignal(number) == usual:  # nohup ignores it
                before[number] = signal.signal(number, interrupt)
    try:
        yield
    finally:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_importing(frame: FrameType | None) -> bool:
    """Whether an import is under way in this frame or in one that called it."""
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            return True
        frame = frame.f_back
    return False


def _write_traceback() -> str:
    """Write the traceback of the current exception to a file; return its path, or the reason without one."""
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="plumbline-error-", suffix=".txt", delete=False, encoding="utf-8"
        ) as file:
            file.write(traceback.format_exc())
    except OSError as error:
        return f"no file: {error.strerror}"
    return file.name


@click.group(
    cls=LazyGroup,
    epilog=START + EXIT_CODES,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(__version__, prog_name="plumbline", message="%(prog)s %(version)s")
@click.pass_context
def main(context: click.Context) -> None:
    """Compare multibody engines with each other and with the notes' equations on identical mechanisms."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())
