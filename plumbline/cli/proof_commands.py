"""Commands about proved motions: prove, verify."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from plumbline import layout
from plumbline.cli import options
from plumbline.cli.help_texts import command
from plumbline.cli.terminal_output import ProgressDisplay, count_noun, log, print_json, print_table
from plumbline.execution.exit_codes import ExitCode
from plumbline.model.datatypes import EngineFailure
from plumbline.processes.worker_pool import Limits
from plumbline.scenario.loader import Scenario
from plumbline.truth import TruthUnavailable

PRECISIONS = ("quad", "octuple")
_SUBJECT = (  # of what a certificate is a proof: printed as a sentence
    "bodies", "joints", "springs", "gravity", "digest", "claimed", "scenarios", "duration", "warning",
)  # fmt: skip
MAX_DURATION = 1000.0  # s; two bodies take minutes for 30 s


@command(
    "prove tumbling-ball double-tumbling-balls",
    "prove tumbling-rod --duration 0.5 --out certificates",
    "prove my-pendulum.yaml --precision octuple --json",
    "verify certificates/*.json.gz",
)
@click.argument("names", nargs=-1, required=True, metavar="SCENARIO...")
@click.option(
    "--duration",
    type=options.FiniteNumber(0, MAX_DURATION, min_open=True),
    help="Seconds to enclose, rounded up to sample intervals of the scenario. Default: the scenario's own.",
)
@click.option(
    "--precision",
    type=click.Choice(PRECISIONS),
    default="quad",
    help="Of the candidate: quad for radii near 1e-25 m after 2 s, octuple for longer or chaotic motions.",
)
@options.out_option(layout.output_folder("certificates"), " of the certificates, SCENARIO.json.gz")
@options.json_option
def prove(names: tuple[str, ...], duration: float | None, precision: Any, out: Path, as_json: bool) -> None:
    """Enclose the motion of scenarios rigorously, and write certificates that `verify` proves again.

    A certificate holds the model, the initial state and a candidate motion as polynomials. The proof, in
    ball arithmetic, does not depend on how the candidate was found; it gives a ball for each position,
    attitude, velocity and rate at each sample time. Runs of these scenarios then use the balls' midpoints as
    the truth, and the report says "proved".
    """
    from plumbline.storage.results_store import write_atomically

    chosen = options.read_scenarios(names)
    _require_provable(chosen, "SCENARIO")
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


@command(
    "verify certificates/tumbling-ball.json.gz",
    "verify tumbling-ball.json.gz --scenario tumbling-ball",
    "verify certificates/*.json.gz --json",
)
@options.files_argument
@click.option(
    "--scenario",
    "expected",
    metavar="SCENARIO",
    help="Name of the catalogue or path of a scenario: certificates of other numbers are rejected.",
)
@options.jobs_option
@options.limits_options(3600.0)
@options.json_option
def verify(files: tuple[Path, ...], expected: str | None, jobs: int, limits: Limits, as_json: bool) -> None:
    """Prove certificates again, with nothing but python-flint and NumPy; print what each one proves.

    The proof is of the numbers in the certificate: it says which scenario of the catalogue has exactly
    these numbers, whatever the certificate's own field `scenario` claims. The checker is one file, which
    states its theorem at its head: plumbline/truth/certificate_checker.py.
    """
    from plumbline.execution.proofs import verify_certificates
    from plumbline.truth.certificate_proof import load_checker

    try:
        load_checker()
    except TruthUnavailable as error:
        raise click.UsageError(str(error)) from None
    wanted = options.read_scenarios([expected]) if expected is not None else []
    _require_provable(wanted, "--scenario")
    with ProgressDisplay(sys.stderr) as progress:
        records = verify_certificates(files, wanted[0] if wanted else None, jobs, limits, progress)
    _finish(records, as_json)


def _require_provable(chosen: Sequence[Scenario], option: str) -> None:
    from plumbline.truth.certificate_proof import reason_not_provable

    for s in chosen:
        if reason := reason_not_provable(s.model):
            raise click.BadParameter(f"{s.name}: {reason}", param_hint=option)


def _times(scenario: Scenario, duration: float | None) -> Any:
    if duration is None:
        return scenario.times
    count = math.ceil(round(duration / scenario.sample_interval, 9)) or 1  # 1.1 / 0.1 is 11.000000000000002
    return np.arange(count + 1) * scenario.sample_interval


def _prove(
    scenario: Scenario, times: Any, precision: Any, progress: Any
) -> tuple[dict[str, Any], bytes | None]:
    """Prove one scenario; keep the proof for runs; return its record and certificate."""
    from plumbline.execution.proofs import proved_radii
    from plumbline.truth.certificate_proof import load_checker, prove_motion, round_enclosure, store_proof

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
    if unkept := store_proof(*pair, times, round_enclosure(enclosure)):
        log(unkept)
    record |= proved_radii(enclosure) | {"cpu": time.process_time() - began, "bytes": len(certificate)}
    return record, certificate


def _finish(records: list[dict[str, Any]], as_json: bool) -> None:
    """Print the records; exit with 2 if a file is malformed, else 3 if one was not checked, 1 if rejected."""
    if as_json:
        print_json(records)
    else:
        proved = [record for record in records if record["verdict"] == "proved"]
        print_table({k: v for k, v in record.items() if k not in _SUBJECT} for record in proved)
        for record in proved:
            if "digest" in record:
                click.echo(f"{record['file']}: {_subject_words(record)}")
    for record in records:
        if record.get("warning"):
            log(f"{record['file']}: warning: {record['warning']}")
        if record["verdict"] != "proved":
            name = record.get("scenario") or record["file"]
            log(f"{name}: {record['verdict']}: {record['reason']}")
    verdicts = {record["verdict"] for record in records}
    codes = {
        "malformed": ExitCode.BAD_USAGE, "failed": ExitCode.ENGINE_FAILED, "rejected": ExitCode.DISAGREEMENT
    }  # fmt: skip
    sys.exit(next((code for verdict, code in codes.items() if verdict in verdicts), ExitCode.SUCCESS))


def _subject_words(record: dict[str, Any]) -> str:
    """Of what a certificate is a proof."""
    names, until = record["scenarios"], f"{record['until']:g} s"
    joints = ", ".join(f"{count} × {kind}" for kind, count in record["joints"].items())
    parts = [
        count_noun(record["bodies"], "body", "bodies"),
        f"joints {joints}",
        *([count_noun(record["springs"], "spring")] if record["springs"] else []),
        f"gravity ({', '.join(f'{x:g}' for x in record['gravity'])}) m/s²",
        f"numbers {record['digest'][:16]}",
    ]
    of = "no scenario of the catalogue has its numbers"
    if names:
        duration = record["duration"]
        of = f"proof of {' = '.join(names)}" + (
            f", whose {duration:g} s it covers up to {until}" if record["until"] < duration else ""
        )
    return f"{of}; 0 … {until}, {', '.join(parts)}"
