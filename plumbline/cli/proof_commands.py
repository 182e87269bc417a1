"""Commands about proved motions: prove, verify."""

from __future__ import annotations

import json
import stat
import sys
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

from plumbline.cli import options
from plumbline.cli.console import ProgressDisplay, print_table
from plumbline.cli.help_texts import EXIT_CODES, examples
from plumbline.execution.exit_codes import ExitCode
from plumbline.model.datatypes import EngineFailure
from plumbline.scenario.loader import Scenario
from plumbline.truth import TruthUnavailable

PRECISIONS = ("quad", "octuple")
MAX_DURATION = 1000.0  # s; two bodies take minutes for 30 s


@click.command(
    epilog=examples(
        "prove tumbling-ball double-tumbling-balls",
        "prove tumbling-rod --duration 0.5 --out certificates",
        "prove my-pendulum.yaml --precision octuple --json",
        "verify certificates/*.json.gz",
    )
    + EXIT_CODES
)
@click.argument("names", nargs=-1, required=True, metavar="SCENARIO...")
@click.option(
    "--duration",
    type=options.FiniteNumber(0, MAX_DURATION, min_open=True),
    help="Seconds to enclose, in the scenario's sample interval. Default: the scenario's own.",
)
@click.option(
    "--precision",
    type=click.Choice(PRECISIONS),
    default="quad",
    help="Of the candidate: quad for radii near 1e-25 m after 2 s, octuple for longer or chaotic motions.",
)
@options.out_option(Path("certificates"), " of the certificates, SCENARIO.json.gz")
@options.json_option
def prove(names: tuple[str, ...], duration: float | None, precision: Any, out: Path, as_json: bool) -> None:
    """Enclose the motion of scenarios rigorously, and write certificates that `verify` proves again.

    A certificate holds the model, the initial state and a candidate motion as polynomials. The proof, in
    ball arithmetic, does not depend on how the candidate was found; it gives a ball for each position,
    attitude, velocity and rate at each sample time. Runs of these scenarios then use the balls' midpoints as
    the truth, and the report says "proved".
    """
    from plumbline.storage.results_store import write_atomically
    from plumbline.truth.enclosure import reason_not_provable

    chosen = options.read_scenarios(names)
    for s in chosen:
        if reason := reason_not_provable(s.model):
            raise click.BadParameter(f"{s.name}: {reason}", param_hint="SCENARIO")
    folder = options.claim_folder(out)
    records = []
    with options.exit_on_io_error(), ProgressDisplay(sys.stderr) as progress:
        for s in chosen:
            record, certificate = _prove(s, _times(s, duration), precision, progress)
            if certificate is not None:
                record["file"] = str(folder / f"{s.name}.json.gz")
                write_atomically(Path(record["file"]), certificate)
            records.append(record)
    _finish(records, as_json)


@click.command(
    epilog=examples("verify certificates/tumbling-ball.json.gz", "verify certificates/*.json.gz --json")
    + EXIT_CODES
)
@click.argument("files", nargs=-1, required=True, metavar="FILE...", type=click.Path(path_type=Path))
@options.json_option
def verify(files: tuple[Path, ...], as_json: bool) -> None:
    """Prove certificates again, with nothing but python-flint and NumPy, and print the radii.

    The checker is one file, which states its theorem at its head: plumbline/truth/enclosure_checker.py.
    """
    with ProgressDisplay(sys.stderr) as progress:
        records = [_verify(path, progress) for path in files]
    _finish(records, as_json)


def _times(scenario: Scenario, duration: float | None) -> Any:
    if duration is None:
        return scenario.times
    count = max(1, round(duration / scenario.sample_interval))
    return np.arange(count + 1) * scenario.sample_interval


def _prove(
    scenario: Scenario, times: Any, precision: Any, progress: Any
) -> tuple[dict[str, Any], bytes | None]:
    """Prove one scenario; keep the proof for runs; return its record and certificate."""
    from plumbline.truth.enclosure import load_checker, prove_motion
    from plumbline.truth.proved_motion import round_enclosure, store_proof

    began, pair = time.process_time(), (scenario.model, scenario.state)
    record: dict[str, Any] = {"scenario": scenario.name}
    try:
        rejected = load_checker().Rejected
        certificate, enclosure = prove_motion(
            *pair, times, scenario.digest, precision,
            lambda done, of: progress(done, of, f"{scenario.name}: steps"),
        )  # fmt: skip
    except TruthUnavailable as error:
        raise click.UsageError(str(error)) from None
    except (rejected, EngineFailure) as error:
        return record | {"verdict": "rejected", "reason": str(error)}, None
    store_proof(*pair, times, round_enclosure(enclosure))
    record |= _radii(enclosure) | {"cpu": time.process_time() - began, "bytes": len(certificate)}
    return record, certificate


def _verify(path: Path, progress: Any) -> dict[str, Any]:
    from plumbline.truth.enclosure import load_checker
    from plumbline.truth.enclosure_file import MalformedCertificate, parse_certificate

    try:
        checker = load_checker()
    except TruthUnavailable as error:
        raise click.UsageError(str(error)) from None
    record: dict[str, Any] = {"file": str(path)}
    began = time.process_time()
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a device may have no end
            raise MalformedCertificate("not a file")
        certificate = parse_certificate(path.read_bytes())
        enclosure = checker.enclose_motion(
            certificate, lambda done, of: progress(done, of, f"{path.name}: steps")
        )
    except MalformedCertificate as error:
        return record | {"verdict": "malformed", "reason": str(error)}
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        words = getattr(error, "strerror", None) or error
        return record | {"verdict": "malformed", "reason": f"cannot be read: {words}"}
    except checker.Rejected as error:
        return record | {"verdict": "rejected", "reason": str(error)}
    return record | _radii(enclosure) | {"cpu": time.process_time() - began}


def _radii(enclosure: Any) -> dict[str, Any]:
    """What a proof gives: the last time [s] and the largest radii [m, –, m/s, rad/s]."""
    names = {"position": "r", "attitude": "p", "velocity": "v", "rate": "omega"}
    radii = {f"{name}_radius": enclosure.radius(field) for name, field in names.items()}
    return {"verdict": "proved", "until": enclosure.times[-1], **radii}


def _finish(records: list[dict[str, Any]], as_json: bool) -> None:
    """Print the records; exit with 2 if a file is malformed, else with 1 if a certificate is rejected."""
    if as_json:
        click.echo(json.dumps(records, ensure_ascii=False, indent=1))
    else:
        print_table(record for record in records if record["verdict"] == "proved")
    for record in records:
        if record["verdict"] != "proved":
            name = record.get("scenario") or record["file"]
            click.echo(f"{name}: {record['verdict']}: {record['reason']}", err=True)
    verdicts = {record["verdict"] for record in records}
    if "malformed" in verdicts:
        sys.exit(ExitCode.BAD_USAGE)
    sys.exit(ExitCode.DISAGREEMENT if "rejected" in verdicts else ExitCode.SUCCESS)
