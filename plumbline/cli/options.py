"""What a command line asks for, checked before any work is done; a mistake ends with exit code 2."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

import click

from plumbline.engines import environments
from plumbline.engines.registry import ENGINES
from plumbline.processes.workers import ExecutorUnavailable
from plumbline.scenario import loader as scenarios
from plumbline.scenario.errors import Problem, ScenarioError
from plumbline.truth.closed_form import ClosedFormMismatch, closed_form_motion


def read_scenarios(names: Iterable[str | Path]) -> list[scenarios.Scenario]:
    """Scenarios by name or path; every problem goes to stderr and ends with exit code 2."""
    try:
        found = scenarios.load_scenarios(names)
        for s in found:
            try:
                closed_form_motion(s)
            except ClosedFormMismatch as error:
                raise ScenarioError(
                    [Problem(str(s.path), 0, 0, "exact", str(error), "no exact, or another")]
                ) from None
    except ScenarioError as error:
        click.echo(str(error), err=True)
        sys.exit(2)
    return found


def choose_scenarios(names: tuple[str, ...], families: tuple[str, ...]) -> list[scenarios.Scenario]:
    """The asked scenarios, or the catalogue; narrowed to the asked families."""
    found = read_scenarios(names or tuple(scenarios.catalogue()))
    known_families = {s.family for s in found}
    for family in families:
        if family not in known_families:
            raise click.BadParameter(
                f"no family {family!r}{suggestion(family, known_families)}", param_hint="--family"
            )
    return [s for s in found if not families or s.family in families]


def choose_engines(engines: tuple[str, ...]) -> list[str]:
    """The asked engines in the registry's order, then as they were asked; or all of them."""
    for engine in engines:
        base, _ = environments.split_version(engine)
        if base not in ENGINES:
            raise click.BadParameter(f"no engine {base!r}{suggestion(base, ENGINES)}", param_hint="--engine")
        problem = environments.version_problem(engine)
        if problem:
            raise click.BadParameter(f"{engine}: {problem}", param_hint="--engine")
    order = list(ENGINES)
    return (
        sorted(dict.fromkeys(engines), key=lambda e: order.index(environments.split_version(e)[0])) or order
    )


def suggestion(name: str, names: Iterable[str]) -> str:
    """A suggestion: the nearest name, or the list of them."""
    names = list(names)
    near = get_close_matches(name, names, 1)
    return f"; did you mean {near[0]!r}?" if near else f"; there are: {', '.join(sorted(names))}"


def ensure_writable(folder: Path) -> Path:
    """The output folder, made and tried before any work is done; exit code 2 where it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise click.BadParameter(f"cannot write to {folder}: {error.strerror}", param_hint="--out") from None
    return folder


@contextmanager
def exit_on_io_error() -> Iterator[None]:
    """A write that fails ends the run with exit code 4 and says how to go on; finished cells are kept."""
    try:
        yield
    except ExecutorUnavailable as error:
        raise click.BadParameter(str(error), param_hint="--scheduler") from None
    except OSError as error:
        click.echo(f"stopped by the machine: {error}", err=True)
        click.echo("What is finished is kept: the same command goes on from there.", err=True)
        sys.exit(4)
