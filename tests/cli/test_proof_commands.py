"""Prove and verify as a user types them, and runs that use what was proved."""

import gzip
import json
import zlib

import numpy as np
import pytest

from plumbline.execution.plan import Plan, TaskKey, TaskKind
from plumbline.execution.scenario_verdicts import ScenarioRun
from plumbline.scenario.loader import find_scenario_file
from plumbline.truth import certificate_proof
from plumbline.truth.trajectory_truth import trajectory_truth
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.commands import invoke
from tests.helpers.requirements import needs_truth_tools

pytestmark = needs_truth_tools


@pytest.fixture(autouse=True)
def small_catalogue(monkeypatch):
    """To find of which scenario a certificate is a proof, `verify` reads the whole catalogue."""
    some = {name: find_scenario_file(name) for name in ("tumbling-ball", "tumbling-rod", "four-bar")}
    monkeypatch.setattr("plumbline.execution.proofs.catalogue", lambda: some)


def prove(scenario, duration, folder):
    """Path of a certificate of a tumbling ball, proved with a cache of its own, and what was printed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PLUMBLINE_CACHE", str(folder / "cache"))
        result = invoke("prove", scenario, "--duration", duration, "--out", folder, code=0)
    return folder / "tumbling-ball.json.gz", result.output


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Path of a certificate of 0.25 s, and what `prove` printed."""
    return prove("tumbling-ball", 0.25, tmp_path_factory.mktemp("certificates"))


def test_prove_writes_a_certificate_and_prints_radii(certificate):
    path, printed = certificate
    assert "proved" in printed and "position_radius" in printed
    document = json.loads(gzip.decompress(path.read_bytes()))
    scenario = catalogue_scenario("tumbling-ball")
    assert document["scenario"] == scenario.digest
    assert float.fromhex(document["mass"][0]) == scenario.model.mass[0]
    assert len(document["times"]) == round(0.25 / scenario.sample_interval) + 1


def test_a_duration_between_samples_is_proved_to_the_sample_after_it(tmp_path):
    document = json.loads(gzip.decompress(prove("tumbling-ball", 0.1, tmp_path)[0].read_bytes()))
    assert float.fromhex(document["times"][-1]) >= 0.1


@pytest.mark.parametrize("name", ["../../evil", "/ABSOLUTE/evil", "sub/evil", "..\\evil", ".evil"])
def test_a_name_never_leads_out_of_the_folder(tmp_path, name):
    source = find_scenario_file("tumbling-ball").read_text()
    text = json.dumps(name.replace("/ABSOLUTE", str(tmp_path)))
    (tmp_path / "x.yaml").write_text(source.replace("\ntitle", f"\nname: {text}\ntitle", 1))
    before = sorted(tmp_path.rglob("*"))
    result = invoke("prove", tmp_path / "x.yaml", "--duration", 0.125, "--out", tmp_path / "a" / "b", code=2)
    assert f"{tmp_path / 'x.yaml'}:" in result.stderr and ": name: " in result.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_verify_proves_it_again_without_heyoka(certificate, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "heyoka", None)
    result = invoke("verify", certificate[0], "--json", code=0)
    (record,) = json.loads(result.stdout)
    assert record["verdict"] == "proved" and record["until"] == 0.25
    assert 0 < record["position_radius"] < 1e-24


def claiming(certificate, path, **changes):
    """A copy of a certificate with other fields."""
    document = json.loads(gzip.decompress(certificate[0].read_bytes())) | changes
    path.write_bytes(gzip.compress(json.dumps(document).encode()))
    return path


def test_verify_prints_of_what_a_certificate_is_a_proof(certificate):
    result = invoke("verify", certificate[0], code=0)
    words = "proof of tumbling-ball, whose 2 s it covers up to 0.25 s; 0 … 0.25 s, 1 body, joints 1 × ball, "
    assert f"{certificate[0]}: {words}gravity (0, 0, -9.81) m/s², numbers " in result.stdout
    assert "warning" not in result.output


@pytest.fixture(scope="module")
def lighter(tmp_path_factory):
    """A scenario with the name of one of the catalogue and another gravity, and its certificate."""
    folder = tmp_path_factory.mktemp("lighter")
    text = find_scenario_file("tumbling-ball").read_text(encoding="utf-8")
    path = folder / "lighter.yaml"
    path.write_text(f"name: tumbling-ball\ngravity: [0, 0, -9.8]\n{text}", encoding="utf-8")
    return prove(path, 0.125, folder)[0], path


def test_numbers_decide_of_which_scenario_a_certificate_is_a_proof(certificate, lighter):
    result = invoke("verify", lighter[0], certificate[0], "--json", code=0)
    other, own = json.loads(result.stdout)
    assert other["scenarios"] == [] and own["scenarios"] == ["tumbling-ball"]
    assert other["gravity"] == [0, 0, -9.8] and other["digest"] != own["digest"]
    assert other["bodies"] == 1 and other["joints"] == {"ball": 1} and other["until"] == 0.125
    assert "no scenario of the catalogue has its numbers" in invoke("verify", lighter[0]).stdout


@pytest.mark.parametrize("is_own, code", [(True, 0), (False, 1)])
def test_a_named_scenario_has_to_have_the_numbers(certificate, lighter, is_own, code):
    for path, scenario in ((certificate[0], "tumbling-ball"), lighter):
        wanted = scenario if is_own else "tumbling-rod"
        result = invoke("verify", path, "--scenario", wanted, "--json", code=code)
        assert json.loads(result.stdout)[0]["verdict"] == ("proved" if is_own else "rejected")
    result = invoke("verify", lighter[0], "--scenario", "tumbling-ball", code=1)
    assert "rejected: its numbers are not those of tumbling-ball" in result.stderr


def test_a_claim_that_the_numbers_contradict_is_a_warning(certificate, tmp_path):
    rod, ball = (catalogue_scenario(f"tumbling-{name}") for name in ("rod", "ball"))
    named = "its field scenario claims tumbling-rod, whose numbers are others"
    other = "which is not tumbling-ball"
    claims = {
        rod.digest: named,
        "tumbling-rod": named,
        "f" * 64: other,
        ball.digest: "",
        ball.name: "",
        "": "",
    }
    paths = [
        claiming(certificate, tmp_path / f"{k}.json.gz", scenario=claim) for k, claim in enumerate(claims)
    ]
    result = invoke("verify", *paths, "--json", code=0)
    for record, message in zip(json.loads(result.stdout), claims.values(), strict=True):
        assert record["scenarios"] == ["tumbling-ball"]
        assert message in record["warning"] and bool(message) == bool(record["warning"])
        assert (f"{record['file']}: warning: " in result.stderr) == bool(message)


def blanks(size):
    """A gzip file that begins with so many MB of blanks, made of one block that is repeated."""
    block = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = block.compress(b" " * 2**20) + block.flush(zlib.Z_FULL_FLUSH)
    return gzip.compress(b"")[:10] + data * size


def test_a_file_that_holds_gigabytes_is_refused_at_its_limit(tmp_path):
    path = tmp_path / "bomb.json.gz"
    path.write_bytes(blanks(6700))
    result = invoke("verify", path, "--memory", 1, code=2)
    assert f"{path}: malformed: holds more than 256 MB" in result.stderr


def test_a_proof_ends_at_its_time_limit(certificate, tmp_path):
    """Here of a certificate with many samples."""
    times = [float.hex(k * 1e-5) for k in range(20_000)]
    path = claiming(certificate, tmp_path / "slow.json.gz", times=times)
    result = invoke("verify", path, "--timeout", 1, code=3)
    assert f"{path}: failed: not checked: timeout: no answer within 1 s" in result.stderr


def test_a_certificate_that_proves_nothing_exits_with_1(certificate, tmp_path):
    document = json.loads(gzip.decompress(certificate[0].read_bytes()))
    document["steps"][0][1][1] += 1 << 109
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(document))
    result = invoke("verify", path, certificate[0], code=1)
    assert f"{path}: rejected: step 1 of {len(document['steps'])}: inequality (5)" in result.stderr
    assert "tumbling-ball.json.gz" in result.stdout


def test_a_malformed_file_exits_with_2_and_names_what_is_wrong(certificate, tmp_path):
    path = tmp_path / "cut.json.gz"
    path.write_bytes(certificate[0].read_bytes()[:500])
    result = invoke("verify", path, tmp_path / "none", code=2)
    assert f"{path}: malformed: not a complete gzip or JSON file" in result.stderr
    assert "none: malformed: cannot be read: No such file" in result.stderr


def test_a_run_uses_the_proof_of_its_own_numbers_only():
    scenario = catalogue_scenario("tumbling-ball")
    times = scenario.times
    found = certificate_proof.find_proof(scenario.model, scenario.state, times)
    assert found is None
    _, balls = certificate_proof.prove_motion(scenario.model, scenario.state, times)
    proof = certificate_proof.round_enclosure(balls)
    certificate_proof.store_proof(scenario.model, scenario.state, times, proof)

    run = ScenarioRun(Plan([scenario], []), scenario, {})
    key = TaskKey(TaskKind.MOTION_TRUTH, scenario.name)
    task = run.truth_task(key)
    truth = task.function(*task.arguments)
    assert truth.method.startswith("proved: enclosed in ball arithmetic within ") and not truth.conflict
    assert np.array_equal(truth.trajectory.r, proof.trajectory.r)
    assert 0 < truth.uncertainty["position"][-1] < 1e-15
    usual = trajectory_truth(scenario.model, scenario.state, times)
    distance = np.linalg.norm(usual.trajectory.r - proof.trajectory.r, axis=-1).max()
    assert distance <= usual.uncertainty["position"][-1] + truth.uncertainty["position"][-1]

    assert certificate_proof.find_proof(scenario.model, scenario.state, times[:-1]) is None
    mass = np.nextafter(scenario.model.mass, np.inf)
    other = scenario.model.changed(mass=mass)
    assert certificate_proof.find_proof(other, scenario.state, times) is None


def test_the_rounded_motion_is_within_its_radius():
    """Against the balls, at every sample."""
    scenario = catalogue_scenario("lagrange-top")
    times = np.arange(5) * 0.02
    _, balls = certificate_proof.prove_motion(scenario.model, scenario.state, times)
    proof = certificate_proof.round_enclosure(balls)
    for k in range(len(times)):
        for exact, rounded in zip(balls.r[k], proof.trajectory.r[k], strict=True):
            error = [abs(ball - float(x)) for ball, x in zip(exact, rounded, strict=True)]
            assert np.linalg.norm([float(x.upper()) for x in error]) <= proof.radius["position"][k]
    assert np.all(np.diff(proof.radius["position"]) >= 0) and proof.radius["position"][-1] < 1e-15
    assert 0 < proof.radius["attitude"][-1] < 1e-15


def test_motions_of_loops_are_refused_with_a_reason():
    result = invoke("prove", "tumbling-ball", "four-bar", code=2)
    assert "closed loops are not proved" in " ".join(result.stderr.split())
