"""Prove and verify as a user types them, and runs that use what was proved."""

import gzip
import json
from importlib.util import find_spec

import numpy as np
import pytest
from click.testing import CliRunner

from plumbline.cli.main import main
from plumbline.execution.plan import Plan, TaskKey, TaskKind
from plumbline.execution.scenario_run import ScenarioRun
from plumbline.scenario.loader import find_scenario_file, load_scenario
from plumbline.truth import enclosure, proved_motion
from plumbline.truth.trajectory import trajectory_truth

pytestmark = pytest.mark.skipif(
    not all(find_spec(module) for module in ("heyoka", "mpmath", "flint")),
    reason="the truth tools are not installed",
)


def type_command(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Path of a certificate of 0.25 s, and what `prove` printed."""
    folder = tmp_path_factory.mktemp("certificates")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PLUMBLINE_CACHE", str(folder / "cache"))
        result = type_command("prove", "tumbling-ball", "--duration", 0.25, "--out", folder)
    assert result.exit_code == 0, result.output
    return folder / "tumbling-ball.json.gz", result.output


def test_prove_writes_a_certificate_and_prints_radii(certificate):
    path, printed = certificate
    assert "proved" in printed and "position_radius" in printed
    document = json.loads(gzip.decompress(path.read_bytes()))
    scenario = load_scenario(find_scenario_file("tumbling-ball"))
    assert document["scenario"] == scenario.digest
    assert float.fromhex(document["mass"][0]) == scenario.model.mass[0]
    assert len(document["times"]) == round(0.25 / scenario.sample_interval) + 1


@pytest.mark.parametrize("name", ["../../evil", "/ABSOLUTE/evil", "sub/evil", "..\\evil", ".evil"])
def test_a_name_never_leads_out_of_the_folder(tmp_path, name):
    source = find_scenario_file("tumbling-ball").read_text()
    text = json.dumps(name.replace("/ABSOLUTE", str(tmp_path)))
    (tmp_path / "x.yaml").write_text(source.replace("\ntitle", f"\nname: {text}\ntitle", 1))
    before = sorted(tmp_path.rglob("*"))
    result = type_command("prove", tmp_path / "x.yaml", "--duration", 0.125, "--out", tmp_path / "a" / "b")
    assert result.exit_code == 2, result.output
    assert f"{tmp_path / 'x.yaml'}:" in result.stderr and ": name: " in result.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_verify_proves_it_again_without_heyoka(certificate, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "heyoka", None)
    result = type_command("verify", certificate[0], "--json")
    assert result.exit_code == 0, result.output
    (record,) = json.loads(result.stdout)
    assert record["verdict"] == "proved" and record["until"] == 0.25
    assert 0 < record["position_radius"] < 1e-24


def test_a_certificate_that_proves_nothing_exits_with_1(certificate, tmp_path):
    document = json.loads(gzip.decompress(certificate[0].read_bytes()))
    document["steps"][0][1][1] += 1 << 109
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(document))
    result = type_command("verify", path, certificate[0])
    assert result.exit_code == 1
    assert f"{path}: rejected: step 1 of {len(document['steps'])}: inequality (5)" in result.stderr
    assert "tumbling-ball.json.gz" in result.stdout


def test_a_malformed_file_exits_with_2_and_names_what_is_wrong(certificate, tmp_path):
    path = tmp_path / "cut.json.gz"
    path.write_bytes(certificate[0].read_bytes()[:500])
    result = type_command("verify", path, tmp_path / "none")
    assert result.exit_code == 2
    assert f"{path}: malformed: not a complete gzip or JSON file" in result.stderr
    assert "none: malformed: cannot be read: No such file" in result.stderr


@pytest.mark.parametrize(
    "words, message",
    [
        (["prove"], "Missing argument 'SCENARIO...'"),
        (["prove", "no-such-scenario"], "no-such-scenario"),
        (["prove", "tumbling-ball", "--duration", "-1"], "--duration"),
        (["prove", "tumbling-ball", "--precision", "half"], "--precision"),
        (["verify"], "Missing argument 'FILE...'"),
    ],
)
def test_bad_usage_exits_with_2(words, message):
    result = type_command(*words)
    assert result.exit_code == 2 and message in result.stderr


def test_a_run_uses_the_proof_of_its_own_numbers_only():
    scenario = load_scenario(find_scenario_file("tumbling-ball"))
    times = scenario.times
    found = proved_motion.find_proof(scenario.model, scenario.state, times)
    assert found is None
    _, balls = enclosure.prove_motion(scenario.model, scenario.state, times)
    proof = proved_motion.round_enclosure(balls)
    proved_motion.store_proof(scenario.model, scenario.state, times, proof)

    run = ScenarioRun(Plan([scenario], []), scenario, {})
    key = TaskKey(TaskKind.MOTION_TRUTH, scenario.name)
    task = run.truth_task(key)
    truth = task.function(*task.arguments)
    assert truth.method.startswith("proved: enclosed in ball arithmetic within ") and not truth.conflict
    assert np.array_equal(truth.trajectory.r, proof.trajectory.r)
    assert 0 < truth.position_uncertainty[-1] < 1e-15
    usual = trajectory_truth(scenario.model, scenario.state, times)
    distance = np.linalg.norm(usual.trajectory.r - proof.trajectory.r, axis=-1).max()
    assert distance <= usual.position_uncertainty[-1] + truth.position_uncertainty[-1]

    assert proved_motion.find_proof(scenario.model, scenario.state, times[:-1]) is None
    mass = np.nextafter(scenario.model.mass, np.inf)
    other = scenario.model.changed(mass=mass)
    assert proved_motion.find_proof(other, scenario.state, times) is None


def test_the_rounded_motion_is_within_its_radius():
    """Against the balls, at every sample."""
    scenario = load_scenario(find_scenario_file("lagrange-top"))
    times = np.arange(5) * 0.02
    _, balls = enclosure.prove_motion(scenario.model, scenario.state, times)
    proof = proved_motion.round_enclosure(balls)
    for k in range(len(times)):
        for exact, rounded in zip(balls.r[k], proof.trajectory.r[k], strict=True):
            error = [abs(ball - float(x)) for ball, x in zip(exact, rounded, strict=True)]
            assert np.linalg.norm([float(x.upper()) for x in error]) <= proof.position_radius[k]
    assert np.all(np.diff(proof.position_radius) >= 0) and proof.position_radius[-1] < 1e-15
    assert 0 < proof.attitude_radius[-1] < 1e-15


def test_motions_of_loops_are_refused_with_a_reason():
    result = type_command("prove", "tumbling-ball", "four-bar")
    assert result.exit_code == 2 and "closed loops are not proved" in " ".join(result.stderr.split())
