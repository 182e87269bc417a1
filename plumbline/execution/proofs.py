"""Proofs of motions in worker processes: of what a night's runs will use, and of certificates."""

from __future__ import annotations

import re
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from plumbline.execution.plan import ProgressCallback
from plumbline.processes.worker_pool import Limits, Task, WorkerPool
from plumbline.scenario.line_and_column_errors import shorten
from plumbline.scenario.loader import Scenario, catalogue, load_scenarios
from plumbline.truth.certificate_file import MAX_BYTES, Certificate, MalformedCertificate, parse_certificate
from plumbline.truth.certificate_proof import (
    certificate_digest,
    find_proof,
    load_checker,
    numbers_digest,
    reason_not_provable,
    store_proof,
)
from plumbline.truth.closed_form import exact_samples
from plumbline.truth.trajectory_truth import prove_and_judge_claim

TRUTH_TOOLS = ("flint", "heyoka", "mpmath")
MAX_PROVED_BODIES = 10  # the cost of a step grows with the cube of the number of coordinates


@dataclass
class ProofSummary:
    """What was proved."""

    known: int = 0  # proved by earlier nights
    proved: list[str] = field(default_factory=list)  # names of scenarios
    failed: dict[str, str] = field(default_factory=dict)  # scenario → reason
    left_out: list[str] = field(default_factory=list)  # no time was left, too many bodies, or not provable
    exceeded: dict[str, float] = field(
        default_factory=dict
    )  # scenario → error of the usual truth over its claim

    @property
    def sentence(self) -> str:
        """What was proved, in words."""
        words = [f"motions: {self.known + len(self.proved)} proved, {len(self.proved)} of them now"]
        words += [f"{len(self.failed)} could not be proved"] if self.failed else []
        words += [f"{len(self.left_out)} left out"] if self.left_out else []
        words += [
            f"{name}: the usual truth is off by {x:.2g} times its claim" for name, x in self.exceeded.items()
        ]
        return ", ".join(words)


def prove_changed_motions(
    scenarios: Sequence[Scenario],
    jobs: int,
    limits: Limits,
    max_cpu_seconds: float,
    log: Callable[[str], None] = lambda _: None,
    progress: ProgressCallback = lambda done, total, name: None,
) -> ProofSummary:
    """Prove the motions that have no proof yet, short chains first, and judge the usual truth by them.

    Args:
        limits: limits of each proof.
        max_cpu_seconds: when so much has been used, no further proof is begun.
        log: called with a sentence about what is to be proved, and about each proof that fails.
        progress: called after each proof with the numbers of those done and of all, and the scenario's name.

    Returns:
        What was proved; each proof is kept for later runs, where the user's cache can be written.

    """
    found, used, number, logged = ProofSummary(), 0.0, 0, set[str]()
    if absent := [module for module in TRUTH_TOOLS if find_spec(module) is None]:
        log(f"no motions are proved: {', '.join(absent)} not installed")
        return ProofSummary(left_out=[s.name for s in scenarios])
    missing: dict[str, Scenario] = {}
    for s in sorted(scenarios, key=lambda s: s.model.n):
        if find_proof(s.model, s.state, s.times) is not None:
            found.known += 1
        elif s.model.n > MAX_PROVED_BODIES or reason_not_provable(s.model):
            found.left_out.append(s.name)
        else:
            missing[s.name] = s
    if missing:
        log(f"proving motions, {len(missing)} of {len(scenarios)}, for at most {max_cpu_seconds:g} CPU s")

    def tasks() -> Iterator[Task]:
        for s in missing.values():
            if used < max_cpu_seconds:
                arguments = (s.model, s.state, s.times, exact_samples(s, s.times))
                yield Task(s.name, prove_and_judge_claim, arguments, limits)
            else:
                found.left_out.append(s.name)

    with WorkerPool(jobs, limits) as workers:
        for outcome in workers.run(tasks()):
            used += outcome.cpu_time
            s, number = missing[outcome.key], number + 1
            progress(number, len(missing), s.name)
            if outcome.failure:
                found.failed[s.name] = outcome.failure
                log(f"{s.name}: not proved: {outcome.failure}")
                continue
            proof, ratio = outcome.value
            unkept = store_proof(s.model, s.state, s.times, proof)
            if unkept and unkept not in logged:
                log(unkept)
                logged.add(unkept)
            found.proved.append(s.name)
            if not ratio <= 1:
                found.exceeded[s.name] = ratio
    return found


def verify_certificates(
    paths: Sequence[Path],
    expected: Scenario | None,
    jobs: int,
    limits: Limits,
    progress: ProgressCallback,
) -> list[dict[str, Any]]:
    """Prove certificates again in workers, which hostile files cannot fill or hold up for ever.

    Args:
        expected: the scenario of which each has to be a proof; None: any.
        limits: limits of each proof.
        progress: called after each file with the numbers of files done and of all, and its name.

    Returns:
        A record per file in the order of the paths, each with its verdict: proved, rejected (it proves
        nothing, or not what was expected), malformed, or failed (not checked within the limits).

    """
    wanted = expected and (expected.name, numbers_digest(expected.model, expected.state))
    found: dict[int, dict[str, Any]] = {}
    tasks = [Task(k, verify_certificate, (path.absolute(), wanted), limits) for k, path in enumerate(paths)]
    with WorkerPool(min(jobs, len(paths)), limits) as workers:
        for outcome in workers.run(tasks):
            path = paths[outcome.key]
            failed = {"verdict": "failed", "reason": f"not checked: {outcome.failure}"}
            found[outcome.key] = {"file": str(path)} | (failed if outcome.failure else outcome.value)
            progress(len(found), len(paths), path.name)
    records = [found[k] for k in range(len(paths))]
    if not any("digest" in record for record in records):
        return records
    known = [s for s in load_scenarios(catalogue()) if not reason_not_provable(s.model)]
    if expected is not None:
        known = [expected, *(s for s in known if s.digest != expected.digest)]
    numbers = [numbers_digest(s.model, s.state) for s in known]
    for record in records:
        if "digest" in record:
            same = [s for s, own in zip(known, numbers, strict=True) if own == record["digest"]]
            record["scenarios"] = [s.name for s in same]
            record["duration"] = max((s.duration for s in same), default=None)
            record["warning"] = _claim_problem(record["claimed"], same, known)
    return records


def _claim_problem(claimed: str, same: Sequence[Scenario], known: Sequence[Scenario]) -> str:
    """Compare the scenario that a certificate claims with those that have its numbers."""
    if not claimed or any(claimed in (s.digest, s.name) for s in same):
        return ""
    other = next((s.name for s in known if claimed in (s.digest, s.name)), "")
    if other:
        return f"its field scenario claims {other}, whose numbers are others"
    if same or not re.fullmatch("[0-9a-f]{64}", claimed):
        names = " = ".join(s.name for s in same) or "no scenario"
        return f"its field scenario claims {shorten(repr(claimed), 30)}, which is not {names}"
    return ""


def verify_certificate(path: Path, expected: tuple[str, str] | None) -> dict[str, Any]:
    """Prove one certificate again.

    Args:
        expected: name and digest of the numbers of the scenario that it has to be about; None: any.

    Returns:
        The verdict with its reason, what the certificate is about, and the radii that it proves.

    """
    checker, began = load_checker(), time.process_time()
    try:
        certificate = parse_certificate(_content(path))
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        words = getattr(error, "strerror", None) or error
        prefix = "" if isinstance(error, MalformedCertificate) else "cannot be read: "
        return {"verdict": "malformed", "reason": f"{prefix}{words}"}
    record = certificate_subject(certificate)
    if expected is not None and record["digest"] != expected[1]:
        return record | {"verdict": "rejected", "reason": f"its numbers are not those of {expected[0]}"}
    try:
        enclosure = checker.enclose_motion(certificate)
    except checker.Rejected as error:
        return record | {"verdict": "rejected", "reason": str(error)}
    return record | proved_radii(enclosure) | {"cpu": time.process_time() - began}


def _content(path: Path) -> bytes:
    if not stat.S_ISREG(path.stat().st_mode):  # a device may have no end
        raise MalformedCertificate("not a file")
    with path.open("rb") as file:
        return file.read(MAX_BYTES + 1)


def certificate_subject(certificate: Certificate) -> dict[str, Any]:
    """Describe what a certificate is about.

    Args:
        certificate: of any motion.

    Returns:
        Numbers of bodies and of joints by kind, gravity [m/s²], time of the last sample [s], digest of the
        numbers, and the digest of the scenario that it claims to be of.

    """
    return {
        "bodies": len(certificate.far),
        "joints": dict(Counter(certificate.kind)),
        "springs": len(certificate.springs),
        "gravity": certificate.data["gravity"].tolist(),
        "until": certificate.times[-1],
        "digest": certificate_digest(certificate),
        "claimed": certificate.scenario,
    }


def proved_radii(enclosure: Any) -> dict[str, Any]:
    """Summarise a proof.

    Args:
        enclosure: the balls that a certificate proves.

    Returns:
        The verdict, the last time [s] and the largest radii [m, –, m/s, rad/s].

    """
    names = {"position": "r", "attitude": "p", "velocity": "v", "rate": "omega"}
    radii = {f"{name}_radius": enclosure.radius(field) for name, field in names.items()}
    return {"verdict": "proved", "until": enclosure.times[-1], **radii}
