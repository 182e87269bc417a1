"""Proofs of motions in worker processes: what a night proves before its runs use it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec

from plumbline.processes.workers import Limits, Task, WorkerPool
from plumbline.scenario.loader import Scenario
from plumbline.truth.closed_form import exact_samples
from plumbline.truth.enclosure import reason_not_provable
from plumbline.truth.proved_motion import find_proof, store_proof
from plumbline.truth.trajectory import prove_and_judge_claim

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
) -> ProofSummary:
    """Prove the motions that have no proof yet, short chains first, and judge the usual truth by them.

    Args:
        scenarios: scenarios of the catalogue.
        jobs: number of worker processes.
        limits: limits of each proof.
        max_cpu_seconds: when so much has been used, no further proof is begun.
        log: called with a sentence about each proof that fails.

    Returns:
        What was proved; each proof is stored.

    Raises:
        OSError: a proof cannot be stored.

    """
    found, used = ProofSummary(), 0.0
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
            s = missing[outcome.key]
            if outcome.failure:
                found.failed[s.name] = outcome.failure
                log(f"{s.name}: not proved: {outcome.failure}")
                continue
            proof, ratio = outcome.value
            store_proof(s.model, s.state, s.times, proof)
            found.proved.append(s.name)
            if not ratio <= 1:
                found.exceeded[s.name] = ratio
    return found
