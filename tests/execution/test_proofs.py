"""What a night proves: motions without a proof, in bounded time; the usual truth is judged by them."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.execution import proofs
from plumbline.execution.proofs import ProofSummary, prove_changed_motions
from plumbline.processes.worker_pool import Limits
from plumbline.truth import trajectory_truth
from plumbline.truth.certificate_proof import find_proof
from plumbline.truth.closed_form import exact_samples
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.requirements import needs_truth_tools

pytestmark = needs_truth_tools
LIMITS = Limits(120.0)


def short(name):
    return replace(catalogue_scenario(name), duration=0.25)


def test_only_motions_without_a_proof_are_proved_and_short_chains_first():
    scenarios = [short("chain-30-balls"), short("tumbling-ball"), short("rest")]
    found = prove_changed_motions(scenarios, 1, LIMITS, 1e-9)
    assert (found.known, found.failed, found.exceeded) == (0, {}, {})
    assert found.proved == ["tumbling-ball", "rest"], "the pool takes two tasks before the first has ended"
    assert found.left_out == ["chain-30-balls"]
    assert found.sentence == "motions: 2 proved, 2 of them now, 1 left out"
    for s in scenarios[1:]:
        assert find_proof(s.model, s.state, s.times).radius["position"][-1] < 1e-15
    again = prove_changed_motions(scenarios, 1, LIMITS, 100.0)
    assert (again.known, again.proved) == (2, [])
    heavier = replace(scenarios[1], model=replace(scenarios[1].model, mass=2 * scenarios[1].model.mass))
    assert prove_changed_motions([heavier], 1, LIMITS, 100.0).proved == ["tumbling-ball"]


def test_a_proof_that_fails_is_reported():
    wild = short("tumbling-ball")
    without_inertia = replace(wild.model, inertia=0 * wild.model.inertia)
    wild = replace(wild, model=without_inertia, duration=wild.sample_interval)
    sentences, calls = [], []
    found = prove_changed_motions(
        [wild], 1, LIMITS, 100.0, sentences.append, lambda *call: calls.append(call)
    )
    assert list(found.failed) == ["tumbling-ball"] and "1 could not be proved" in found.sentence
    begun, failed = sentences
    assert begun == "proving motions, 1 of 1, for at most 100 CPU s" and calls == [(1, 1, "tumbling-ball")]
    assert failed.startswith("tumbling-ball: not proved: ")


@pytest.mark.parametrize("name", ["tumbling-ball", "lagrange-top", "rest", "drag-rod", "free-top"])
def test_the_usual_truth_is_within_its_claim(name):
    s = short(name)
    _, ratio = trajectory_truth.prove_and_judge_claim(s.model, s.state, s.times, exact_samples(s, s.times))
    assert 0 <= ratio <= 1


def test_a_truth_that_claims_too_much_is_noticed(monkeypatch):
    s = short("tumbling-ball")
    usual = trajectory_truth.trajectory_truth

    def wrong(*arguments):
        found = usual(*arguments)
        return replace(found, trajectory=replace(found.trajectory, r=found.trajectory.r + 1e-13))

    monkeypatch.setattr(trajectory_truth, "trajectory_truth", wrong)
    _, ratio = trajectory_truth.prove_and_judge_claim(s.model, s.state, s.times)
    assert 1 < ratio < 1e4
    summary = ProofSummary(exceeded={s.name: ratio})
    assert "tumbling-ball: the usual truth is off by" in summary.sentence


def test_without_the_truth_tools_nothing_is_proved(monkeypatch):
    monkeypatch.setattr(proofs, "TRUTH_TOOLS", ("flint", "no_such_module"))
    sentences = []
    found = prove_changed_motions([short("rest")], 1, LIMITS, 100.0, sentences.append)
    assert found.left_out == ["rest"] and np.isfinite(found.known)
    assert sentences == ["no motions are proved: no_such_module not installed"]
