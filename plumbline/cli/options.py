"""Options that several commands share, and checks of what was typed; a mistake ends with exit code 2."""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from plumbline.engines import environments
from plumbline.engines.registry import ENGINES
from plumbline.processes.workers import ExecutorUnavailable
from plumbline.scenario import loader as scenarios
from plumbline.scenario.errors import Problem, ScenarioError, did_you_mean
from plumbline.scenario.yaml_source import read_yaml
from plumbline.truth.closed_form import ClosedFormMismatch, closed_form_motion

DEFAULT_OUT = Path("reports") / "out"
MIN_TIMEOUT = 1.0  # s; starting an engine takes longer than less
MIN_MEMORY = 1.0  # GB of address space; a worker with NumPy, SciPy and one engine does not start with less
MIN_USER_RTOL = 1e-16  # below the rounding of a double no two results agree
EXIT_CODES = """
\b
Exit codes:
  0  everything agrees, or differs as recorded in plumbline/judging/known_issues.yaml
  1  a disagreement, or a cell unresolved or unsupported that is not recorded
  2  bad usage or a bad scenario file
  3  an engine failed: raised, crashed, hung, ran out of memory, was not finite
  4  the machine failed: disk full, input/output error; the same command resumes
An engine that is not installed is a verdict and changes no exit code.
"""

_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class FiniteNumber(click.FloatRange):
    """A number in a range; unlike click's own type, NaN and infinity are refused."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse a number and check that it is finite and in the range.

        Args:
            value: the text of the command line, or a default.
            param: the option, for the message.
            ctx: the command's context, for the message.

        Returns:
            The number.

        """
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class FolderPath(click.Path):
    """A folder that may not exist yet; the empty text, which would mean the current folder, is refused."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse the path of a folder.

        Args:
            value: the text of the command line, or a default.
            param: the option or argument, for the message.
            ctx: the command's context, for the message.

        Returns:
            The path.

        """
        if not os.fspath(value):
            self.fail("the path is empty; the current folder is written as a dot.", param, ctx)
        return super().convert(value, param, ctx)


def examples(*lines: str) -> str:
    """Format example commands for the end of a help text.

    Args:
        *lines: what follows ``python -m plumbline``, remarks included.

    Returns:
        A paragraph whose line breaks click keeps.

    """
    return "\n".join(["\b", "Examples:", *(f"  python -m plumbline {line}" for line in lines), "", ""])


def out_option(default: Path, note: str = "") -> _Decorator:
    """Make the option ``--out``.

    Args:
        default: the folder where the option is not given.
        note: what else the help says of the folder.

    Returns:
        The decorator of a command; it passes ``out``.

    """
    return click.option("--out", type=FolderPath(), default=default, help=f"Output folder{note}.")


def timeout_option(default: float) -> _Decorator:
    """Make the option ``--timeout``.

    Args:
        default: the time limit of a task where the option is not given [s].

    Returns:
        The decorator of a command; it passes ``timeout``.

    """
    return click.option(
        "--timeout", type=FiniteNumber(MIN_TIMEOUT), default=default, help="Seconds per task."
    )


def _choose_engines(_: click.Context, __: click.Parameter, names: Sequence[str]) -> list[str]:
    """Check engine names; return them in the registry's order, or all engines where none is named."""
    for name in names:
        base, _version = environments.split_version(name)
        if base not in ENGINES:
            raise click.BadParameter(f"no engine {base!r}; {_nearest_or_all(base, ENGINES)}")
        if problem := environments.version_problem(name):
            raise click.BadParameter(f"{name}: {problem}")
    order = list(ENGINES)
    chosen = sorted(dict.fromkeys(names), key=lambda e: order.index(environments.split_version(e)[0]))
    return chosen or order


engines_option = click.option(
    "--engine",
    "engines",
    multiple=True,
    callback=_choose_engines,
    help="Only this engine (may be repeated); mujoco@3.12.0, @latest, @pre or @path/to.whl for another "
    "version than the installed one. Default: all.",
)
jobs_option = click.option(
    "--jobs",
    type=click.IntRange(1),
    default=lambda: os.cpu_count() or 1,
    show_default="one per core",
    help="Worker processes.",
)
scheduler_option = click.option(
    "--scheduler", metavar="ADDRESS", help="A dask cluster to run on instead, as tcp://HOST:8786."
)
json_option = click.option("--json", "as_json", is_flag=True, help="JSON on stdout, for other programs.")
memory_option = click.option(
    "--memory", type=FiniteNumber(MIN_MEMORY), default=8.0, help="GB of address space per worker."
)
names_argument = click.argument("names", nargs=-1, metavar="[SCENARIO]...")


def read_scenarios(names: Iterable[str | Path]) -> list[scenarios.Scenario]:
    """Load scenarios; print every problem of every file to stderr and exit with 2 if there is one.

    Args:
        names: names of the catalogue, or paths of YAML files.

    Returns:
        The scenarios, each once, in the order of ``names``.

    """
    try:
        found = scenarios.load_scenarios(names)
        error = ScenarioError(problem for s in found if (problem := _closed_form_problem(s)))
    except ScenarioError as load_error:
        error = load_error
    if error.problems:
        click.echo(str(error), err=True)
        sys.exit(2)
    return found


def _closed_form_problem(scenario: scenarios.Scenario) -> Problem | None:
    """Find out whether the scenario lacks what the closed form named in its file needs."""
    try:
        closed_form_motion(scenario)
    except ClosedFormMismatch as error:
        line, column = read_yaml(scenario.path).value_positions.get(("exact",), (1, 1))
        hint = "remove `exact`, or name the closed form that fits"
        return Problem(str(scenario.path), line, column, "exact", str(error), hint=hint)
    return None


def choose_scenarios(names: Sequence[str], families: Sequence[str]) -> list[scenarios.Scenario]:
    """Load the named scenarios, or the catalogue, narrowed to families.

    Args:
        names: names of the catalogue or paths; empty for the whole catalogue.
        families: names of families; empty for all.

    Returns:
        The scenarios.

    Raises:
        BadParameter: no scenario is of one of the families.

    """
    found = read_scenarios(names or tuple(scenarios.catalogue()))
    known = {s.family for s in found}
    for family in families:
        if family not in known:
            raise click.BadParameter(
                f"no family {family!r}; {_nearest_or_all(family, known)}", param_hint="--family"
            )
    return [s for s in found if not families or s.family in families]


def _nearest_or_all(name: str, known: Iterable[str]) -> str:
    """Suggest the nearest known name, or list all of them."""
    names = sorted(known)
    return did_you_mean(name, names) or f"there are: {', '.join(names)}"


def ensure_writable(folder: Path) -> Path:
    """Make the output folder and try to write to it, before any work is done.

    Args:
        folder: the folder; parents are made too.

    Returns:
        The folder.

    Raises:
        BadParameter: the folder cannot be made or written to (exit code 2).

    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise click.BadParameter(f"cannot write to {folder}: {error.strerror}", param_hint="--out") from None
    return folder


@contextmanager
def exit_on_io_error() -> Iterator[None]:
    """Exit with 4 when a write fails; finished cells are kept.

    Yields:
        Nothing.

    Raises:
        BadParameter: the dask cluster cannot be reached (exit code 2).

    """
    try:
        yield
    except ExecutorUnavailable as error:
        raise click.BadParameter(str(error), param_hint="--scheduler") from None
    except OSError as error:
        click.echo(
            f"I/O error: {error}. Finished cells were saved; run the same command to resume.", err=True
        )
        sys.exit(4)
