"""Options that several commands share, and checks of what was typed; a mistake ends with exit code 2."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click
from click.core import ParameterSource

from plumbline.engines import environments, specifications
from plumbline.engines.registry import ENGINES, IMPORTERS, USER_ENGINES
from plumbline.execution.environment_fingerprint import environment_fingerprint
from plumbline.execution.exit_codes import ExitCode
from plumbline.judging.known_issues import KnownIssue, load_known_issues
from plumbline.processes.exceptions import PlumblineError
from plumbline.processes.isolation import FileLock, LockHeld
from plumbline.processes.line_process import BadSpecification
from plumbline.processes.user_cache import content_key, recall, remember
from plumbline.processes.worker_pool import ExecutorLost, ExecutorUnavailable, Limits
from plumbline.scenario import loader as scenarios
from plumbline.scenario.line_and_column_errors import Problem, ScenarioError, nearest_or_all, shorten
from plumbline.scenario.yaml_reader import read_bytes, read_yaml
from plumbline.truth.closed_form import ClosedFormMismatch, closed_form_motion

if TYPE_CHECKING:
    from plumbline.execution.result_cache import DiskResultCache

# what the context of a command remembers
_ADAPTERS, _TRUST = "plumbline.adapters", "plumbline.trust"
_BASE, _ROOT = "plumbline.base", "plumbline.root"
LOCK_FILE = ".lock"  # of an output folder, held by the command that writes to it
MIN_TIMEOUT, MAX_TIMEOUT = 1.0, 1e7  # s; starting an engine takes longer than less
MIN_MEMORY, MAX_MEMORY = 1.0, 1e6  # GB of address space; a worker with an engine does not start with less
MAX_JOBS = 1024  # worker processes of one machine
MAX_RANDOM_SCENARIOS = 1_000_000
MAX_SEED = 2**63 - 1
MAX_LONG_RUN = 1e5  # s
MIN_USER_RTOL = 1e-16  # below the rounding of a double no two results agree
_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class FiniteNumber(click.FloatRange):
    """A number in a range; unlike click's own type, NaN and infinity are refused."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse a number and check that it is finite and in the range.

        Args:
            value: the text of the command line, or a default.
            param: the option, for the message.
            ctx: the command's context, for the message.

        """
        if not math.isfinite(click.FLOAT.convert(value, param, ctx)):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return float(super().convert(value, param, ctx))


class FolderPath(click.Path):
    """A folder that may not exist yet; the empty text, which would mean the current folder, is refused."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Parse the path of a folder.

        Args:
            value: the text of the command line, or a default.
            param: the option or argument, for the message.
            ctx: the command's context, for the message.

        """
        if not os.fspath(value):
            self.fail("the path is empty; the current folder is written as a dot.", param, ctx)
        path = Path(os.fsdecode(value))
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            pass  # the command finds out whether it can be made
        except (OSError, ValueError) as error:  # too long, without permission, or with a null character
            self.fail(f"{shorten(repr(value))}: {getattr(error, 'strerror', None) or error}.", param, ctx)
        return path


class ResultsPath(FolderPath):
    """A results folder, named by itself or by its results.json."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Parse the path of a results folder.

        Args:
            value: the text of the command line, or a default.
            param: the option or argument, for the message.
            ctx: the command's context, for the message.

        """
        path = super().convert(value, param, ctx)
        if path.name == "results.json" and not path.is_dir():
            return path.parent
        if path.exists() and not path.is_dir():
            self.fail(f"{path} is neither a results folder nor its results.json.", param, ctx)
        return path


def out_option(default: Path, note: str = "") -> _Decorator:
    """Make the option ``--out``.

    Args:
        default: the folder where the option is not given.
        note: what else the help says of the folder.

    Returns:
        The decorator of a command; it passes ``out``.

    """
    return click.option("--out", type=FolderPath(), default=default, help=f"Output folder{note}.")


def limits_options(seconds: float) -> _Decorator:
    """Make the options ``--timeout`` and ``--memory``.

    Args:
        seconds: the time limit of a task where the option is not given [s].

    Returns:
        The decorator of a command; it passes ``limits``.

    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def with_limits(*, timeout: float, memory: float, **others: Any) -> Any:
            return command(limits=Limits(timeout, memory), **others)

        kind = FiniteNumber(MIN_TIMEOUT, MAX_TIMEOUT)
        timeout_option = click.option("--timeout", type=kind, default=seconds, help="Seconds per task.")
        return timeout_option(_memory_option(with_limits))

    return decorate


def _choose_engines(context: click.Context, __: click.Parameter, names: Sequence[str]) -> list[str]:
    """Check engine names; return them in the registry's order, then the user's; all where none is named."""
    own: list[str] = context.meta.get(_ADAPTERS, [])
    for name in names:
        base, _version = environments.split_version(name)
        if base not in ENGINES and base not in USER_ENGINES:
            _add_found_engine(base, is_trusting=context.meta.get(_TRUST, False))
        if problem := environments.version_problem(name):
            raise click.BadParameter(f"{name}: {problem}")
    order = [*ENGINES, *USER_ENGINES]
    chosen = sorted(dict.fromkeys(names), key=lambda e: order.index(environments.split_version(e)[0]))
    return [*chosen, *(name for name in own if name not in chosen)] or list(ENGINES)


def _add_adapters(context: click.Context, _: click.Parameter, texts: Sequence[str]) -> None:
    """Add the engines that the user typed; typing is consent."""
    try:
        context.meta[_ADAPTERS] = [specifications.add_engine(text, Path.cwd()) for text in texts]
    except BadSpecification as error:
        raise click.BadParameter(str(error)) from None


def check_importer(name: str) -> None:
    """Refuse what is no importer, or no version of one; suggest the nearest name."""
    base, _version = environments.split_version(name)
    if base not in IMPORTERS:
        raise click.BadParameter(f"no importer {base!r}; {nearest_or_all(base, IMPORTERS)}")
    if problem := environments.version_problem(name):
        raise click.BadParameter(f"{name}: {problem}")


def _note_value(context: click.Context, option: click.Parameter, value: Any) -> Any:
    context.meta[f"plumbline.{option.name}"] = value
    return value


def _add_found_engine(name: str, *, is_trusting: bool) -> None:
    """Add an engine that plumbline.toml or an installed package names; that file needs the user's consent."""
    try:
        found = {one: (text, path) for one, text, path in specifications.found_engines(Path.cwd())}
        if name not in found:
            raise click.BadParameter(
                f"no engine {name!r}; {nearest_or_all(name, sorted({*ENGINES, *found}))}"
            )
        text, path = found[name]
        specification = specifications.resolve(text, Path.cwd())
        if path and not specifications.is_trusted(specification, path, consent=is_trusting):
            what = f"{path.name} of this folder would start {text}"
            raise click.BadParameter(f"{what}; --trust allows it, as long as no file of it changes")
        specifications.add_engine(f"{name}={text}", Path.cwd())
    except BadSpecification as error:
        raise click.BadParameter(str(error)) from None


def _check_address(_: click.Context, __: click.Parameter, address: str | None) -> str | None:
    """Refuse what is no address of a scheduler; whether one answers there is found out later."""
    if address is not None and not re.fullmatch(r"(\w+://)?(\[[\da-fA-F:]+\]|[\w.-]+):\d{1,5}", address):
        raise click.BadParameter(f"{shorten(repr(address))} is no address such as tcp://HOST:8786")
    return address


_engine_option = click.option(
    "--engine",
    "engines",
    multiple=True,
    callback=_choose_engines,
    help="Only this engine (may be repeated); mujoco@3.12.0, @latest, @pre or @path/to.whl for another "
    "version than the installed one. Default: all, or those of --adapter.",
)
_adapter_option = click.option(
    "--adapter",
    multiple=True,
    is_eager=True,
    expose_value=False,
    callback=_add_adapters,
    metavar="[NAME=]ENGINE",
    help="An engine of your own (may be repeated): 'cmd:PROGRAM ARGUMENTS' that answers lines of JSON, "
    "FILE.py:Class or package.module:Class; see docs/test-your-engine.md.",
)
_trust_option = click.option(
    "--trust",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_note_value,
    help="Start the engines that plumbline.toml of this folder names, now and as long as it does not change.",
)


def engines_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that choose engines.

    Returns:
        The decorated command; it gets ``engines``.

    """
    return _trust_option(_adapter_option(_engine_option(command)))


def model_file_options(*, are_passed: bool) -> _Decorator:
    """Make the options ``--base`` and ``--root``, with which model files are read.

    Args:
        are_passed: whether the command gets ``base`` and ``root``.

    Returns:
        The decorator of a command.

    """
    base = click.option(
        "--base",
        type=click.Choice(["auto", "fixed", "free"]),
        default="auto",
        expose_value=are_passed,
        callback=_note_value,
        help="Of a URDF: whether its root link is fixed to the world or moves freely. The format does not "
        "say; auto is fixed. An MJCF file says it itself.",
    )
    root = click.option(
        "--root",
        type=click.Path(path_type=Path, exists=True, file_okay=False),
        expose_value=are_passed,
        callback=_note_value,
        help="Folder outside of which no file is read for a model file, and to which package:// refers. "
        "Default: the nearest folder above the file that has a package.xml, else the file's own.",
    )
    return lambda command: base(root(command))


jobs_option = click.option(
    "--jobs",
    type=click.IntRange(1, MAX_JOBS),
    default=lambda: min(os.cpu_count() or 1, MAX_JOBS),
    show_default="one per core",
    help="Worker processes.",
)
scheduler_option = click.option(
    "--scheduler",
    metavar="ADDRESS",
    callback=_check_address,
    help="A dask cluster to run on instead, as tcp://HOST:8786.",
)
known_option = click.option(
    "--known",
    "known_files",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A file of known issues of your own, besides the project's (may be repeated); see "
    "docs/reading-a-disagreement.md.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="JSON on stdout, for other programs.")
_memory_option = click.option(
    "--memory", type=FiniteNumber(MIN_MEMORY, MAX_MEMORY), default=8.0, help="GB of address space per worker."
)
files_argument = click.argument(
    "files", nargs=-1, required=True, metavar="FILE...", type=click.Path(path_type=Path)
)
names_argument = click.argument("names", nargs=-1, metavar="[SCENARIO]...")


def read_scenarios(
    names: Iterable[str | Path], load: Callable[[Path], scenarios.Scenario] | None = None
) -> list[scenarios.Scenario]:
    """Load scenarios; print every problem of every file to stderr and exit with 2 if there is one.

    Args:
        names: names of the catalogue, or paths of YAML files.
        load: loads one file; None to load and check it anew.

    Returns:
        The scenarios, each once, in the order of ``names``.

    """
    try:
        return scenarios.load_scenarios(names, load or _load_scenario)
    except ScenarioError as error:
        exit_on_bad_file(error)


def _load_scenario(path: Path) -> scenarios.Scenario:
    """Load a scenario and check that it is the motion of the closed form named in its file."""
    if path.suffix in scenarios.MODEL_FILE_SUFFIXES:
        from plumbline.model_files.mechanism_of_file import load_model_file  # few commands need it

        meta = click.get_current_context().meta
        return load_model_file(path, meta.get(_BASE, "auto"), meta.get(_ROOT))[0]
    scenario = scenarios.load_scenario(path)
    try:
        closed_form_motion(scenario)
    except ClosedFormMismatch as error:
        line, column = read_yaml(path).value_positions.get(("exact",), (1, 1))
        hint = "remove `exact`, or name the closed form that fits"
        raise ScenarioError([Problem(str(path), line, column, "exact", str(error), hint=hint)]) from None
    return scenario


def _recall_scenario(path: Path) -> scenarios.Scenario:
    """Load a scenario; one that was loaded before is neither built nor checked again.

    Its key covers the file, and all that the cells of the result cache depend on; a model file may name
    others.
    """
    if path.suffix in scenarios.MODEL_FILE_SUFFIXES:
        return _load_scenario(path)
    code = Path(__file__).read_bytes()
    key = content_key("scenario", environment_fingerprint(""), code, str(path), read_bytes(path))
    known: scenarios.Scenario | None = recall(key, lambda found: isinstance(found, scenarios.Scenario))
    if known is None:
        known = _load_scenario(path)
        remember(key, known)
    return known


def are_scenarios_found(names: Iterable[str]) -> bool:
    """Find out whether each scenario's file exists, before anything is started for them.

    Args:
        names: names of the catalogue, or paths of YAML files.

    Returns:
        False where `read_scenarios` will exit because there is no such file.

    """
    try:
        return all(os.path.isfile(scenarios.find_scenario_file(name)) for name in names)
    except ScenarioError:
        return False


def exit_on_bad_file(error: ScenarioError) -> NoReturn:
    """Print the problems of files to stderr and exit with 2.

    Args:
        error: has every problem, with file, line and column.

    """
    click.echo(str(error), err=True)
    sys.exit(ExitCode.BAD_USAGE)


def read_known_issues(files: Sequence[Path], names: Sequence[str]) -> list[KnownIssue]:
    """Load files of known issues; exit with 2 where one has a problem.

    Args:
        names: the scenarios or model files of the run, which entries of the user may name.

    """
    found: list[KnownIssue] = []
    places: dict[str, str] = {}
    for path in files:
        try:
            found += load_known_issues(path, names, places)
        except ScenarioError as error:
            exit_on_bad_file(error)
    return found


def are_engines_named() -> bool:
    """Find out whether the engines of the current command were named: one that is missing then fails.

    Returns:
        Whether ``--engine`` is on the command line.

    """
    context = click.get_current_context()
    is_named = context.get_parameter_source("engines") == ParameterSource.COMMANDLINE
    return is_named or bool(context.meta.get(_ADAPTERS))


def choose_scenarios(names: Sequence[str], families: Sequence[str]) -> list[scenarios.Scenario]:
    """Load the named scenarios, or the catalogue, narrowed to families, for commands with a result cache.

    Args:
        names: names of the catalogue or paths; empty for the whole catalogue.
        families: names of families; empty for all.

    Raises:
        BadParameter: no scenario is of one of the families.

    """
    found = read_scenarios(names or tuple(scenarios.catalogue()), _recall_scenario)
    known = {s.family for s in found}
    for family in families:
        if family not in known:
            hint = nearest_or_all(family, sorted(known))
            raise click.BadParameter(f"no family {family!r}; {hint}", param_hint="--family")
    return [s for s in found if not families or s.family in families]


def claim_folder(folder: Path, param_hint: str = "--out") -> Path:
    """Make the output folder, try to write to it and lock it until the command ends, before any work is done.

    Args:
        folder: the folder; parents are made too.
        param_hint: the parameter that names it.

    Raises:
        BadParameter: the folder cannot be made or written to, or another command uses it (exit code 2).

    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK_FILE)
    except LockHeld:
        raise click.BadParameter(
            f"another command writes to {folder} at present; wait until it has ended, or name another folder",
            param_hint=param_hint,
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise click.BadParameter(f"cannot write to {folder}: {reason}", param_hint=param_hint) from None
    click.get_current_context().with_resource(lock)
    return folder


@contextmanager
def exit_on_damaged_results() -> Iterator[None]:
    """Turn the error of stored results into bad usage (exit code 2).

    Yields:
        Nothing.

    Raises:
        UsageError: a file of a results folder is missing or damaged, or has no such row.

    """
    try:
        yield
    except PlumblineError as error:  # DamagedResults or NotReproducible, whose modules load SciPy
        raise click.UsageError(str(error)) from None


def check_history_tool() -> None:
    """Check that histories can be read.

    Raises:
        UsageError: DuckDB, of the dependency group `history`, is not installed (exit code 2).

    """
    if find_spec("duckdb") is None:
        raise click.UsageError(
            "histories are read with DuckDB, which is not installed; `pip install duckdb` installs it"
        )


def announce_result_cache(result_cache: DiskResultCache) -> None:
    """Let the messages of errors and interruptions report whether finished cells are kept.

    Args:
        result_cache: that of the command that runs.

    """
    if context := click.get_current_context(silent=True):
        context.find_root().obj = result_cache


@contextmanager
def exit_on_io_error() -> Iterator[None]:
    """Exit with 4 when a write fails.

    Yields:
        Nothing.

    Raises:
        BadParameter: the dask cluster cannot be reached (exit code 2).

    """
    try:
        yield
    except ExecutorUnavailable as error:
        raise click.BadParameter(str(error), param_hint="--scheduler") from None
    except (OSError, ExecutorLost) as error:
        what = "I/O error" if isinstance(error, OSError) else "the cluster was lost"
        result_cache = click.get_current_context().find_root().obj
        kept = "Finished cells were saved; run the same command to resume."
        if result_cache is None or not result_cache.holds_everything:
            kept = "Finished cells were not saved; the same command begins again."
        click.echo(f"{what}: {error}. {kept}", err=True)
        sys.exit(ExitCode.MACHINE_FAILED)
