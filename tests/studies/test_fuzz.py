"""The search for new findings: what it draws, keeps, makes smaller and finds."""

import json

import pytest

from plumbline.execution.exit_codes import ExitCode
from plumbline.judging.findings import Finding
from plumbline.judging.rows import Row, Verdict
from plumbline.processes.exceptions import PlumblineError
from plumbline.scenario.generator import random_mechanism
from plumbline.scenario.loader import load_scenarios, scenario_from_dict
from plumbline.storage.results_store import read_results
from plumbline.studies.fuzz import (
    BATCH,
    Corpus,
    FuzzResult,
    _fewer_bodies,
    _shrink,
    _smaller,
    scenario_of,
    write_findings,
)
from tests.helpers.commands import invoke

PLANTED = """
from dataclasses import replace
import numpy as np
from adapters.mujoco_engine import Mujoco

def has(model, kind, field):
    return any(np.any(x) for own, x in zip(model.kind, getattr(model, field)) if own == kind)

class Planted(Mujoco):
    name = "planted"

    def _evaluate(self, model, states):
        found = super()._evaluate(model, states)
        if has(model, "cylindrical", "armature"):
            found = [replace(a, kinetic_energy=1.5 * a.kinetic_energy) for a in found]
        if "weld" in model.kind and np.any(model.moment):
            found = [replace(a, joint_moment=-a.joint_moment) for a in found]
        if "planar" in model.kind and "hinge" in model.kind:
            found = [replace(a, acceleration=a.acceleration - model.gravity) for a in found]
        if has(model, "universal", "effort"):
            found = [replace(a, angular_momentum=2 * a.angular_momentum) for a in found]
        if any(np.any(b < 0) and d for b, d in zip(model.spring_body, model.spring_damping)):
            found = [replace(a, potential_energy=-a.potential_energy) for a in found]
        return found
"""
FIVE = {
    "planted-kinetic-energy-multiplied-by", "planted-joint-forces-with-opposite-sign",
    "planted-acceleration-minus-gravity", "planted-angular-momentum-multiplied-by",
    "planted-potential-energy-with-opposite-sign",
}  # fmt: skip


def test_a_seed_gives_the_same_mechanisms():
    names = [scenario_of(7, k).name for k in range(4)]
    assert names == ["random-7-0", "random-mechanism-7-0", "random-7-1", "random-mechanism-7-1"]
    assert scenario_of(7, 3).document == scenario_of(7, 3).document != scenario_of(8, 3).document


def test_what_is_made_smaller_has_one_thing_less_and_most_of_it_is_a_mechanism():
    document = random_mechanism(5, 3).document
    size = len(json.dumps(document))
    smaller = list(_smaller(document))
    assert len(smaller) > 20 and all(len(json.dumps(one)) < size for one in smaller)
    legal = 0
    for one in smaller:
        try:
            legal += bool(scenario_from_dict(one, "x.yaml"))
        except PlumblineError:
            continue
    assert legal > len(smaller) / 2


def test_few_bodies_are_tried_first_from_either_end():
    document = scenario_of(3, 41).document
    models = [scenario_from_dict(one, "x.yaml").model for one in _fewer_bodies(document)]
    whole = scenario_from_dict(document, "x.yaml").model
    assert whole.n > 8 and len(whole.spring_body)
    assert [model.n for model in models[:6]] == [1, 1, 2, 2, 4, 4] and models[-1].n == whole.n - 1
    assert [model.kind[0] for model in models[::2]] == [whole.kind[0]] * (len(models) // 2)
    assert [model.mass[-1] for model in models[1::2]] == [whole.mass[-1]] * (len(models) // 2)


@pytest.mark.parametrize("name", ["planted-wrong-energies", "..-planted.py-wrong-energies"])
def test_what_is_made_smaller_has_the_name_of_its_finding_and_the_states_that_showed_it(name, tmp_path):
    start, smallest, compared = scenario_of(3, 5), {}, []

    def compare(scenarios, result, engines):
        """Nothing shows the finding."""
        compared.extend(scenarios)

    row = Row("s", "f", "planted", "0", "state", "-", "q", "J", 1.0, 0.1, Verdict.DISAGREES, "wrong")
    finding = Finding(name, "planted", Verdict.DISAGREES, "wrong", "wrong", None, (row,))
    _shrink(compare, start, finding, smallest)
    assert {(s.name, s.seed) for s in (*compared, smallest[name])} == {(name.lstrip("."), start.seed)}
    result = FuzzResult(3, smallest=smallest)
    (path,) = write_findings(result, tmp_path, "fuzz")
    (stored,) = load_scenarios([path])
    assert stored.seed == start.seed and stored.model.n == start.model.n


def test_a_corpus_keeps_new_combinations_up_to_its_size_and_where_a_search_ended(tmp_path):
    corpus = Corpus(tmp_path / "corpus", 2)
    kept = [corpus.add(scenario_of(7, k)) for k in (1, 1, 3, 5)]
    assert kept == [True, False, True, False]
    indices = corpus.first_indices(7)
    assert [next(indices), next(indices)] == [0, BATCH]
    again = Corpus(tmp_path / "corpus", 9)
    assert next(again.first_indices(7)) == BATCH and next(again.first_indices(8)) == 0
    assert not again.add(scenario_of(7, 3))  # its combinations were seen
    assert len(load_scenarios([str(path) for path in (tmp_path / "corpus").glob("*.yaml")])) == 2


def test_a_batch_that_is_not_finished_in_time_does_not_count_and_explain_reads_the_folder(tmp_path):
    words = ["--minutes", "0", "--corpus", str(tmp_path / "corpus"), "--out", str(tmp_path / "out")]
    done = invoke("fuzz", "--engine", "reference", *words, code=ExitCode.DISAGREEMENT)
    assert "0 mechanisms, 0 new findings: nothing was compared in time" in done.stderr
    assert not (tmp_path / "corpus").exists()
    explained = invoke("explain", "--results", tmp_path / "out")
    assert (explained.exit_code, explained.stderr) == (0, "no finding\n"), explained.output


@pytest.mark.timeout(1800)
def test_a_planted_defect_is_found_named_and_shown_by_the_smallest_mechanism(tmp_path):
    """Five of them, each active under a rare condition."""
    planted, out = tmp_path / "planted.py", tmp_path / "out"
    planted.write_text(PLANTED)
    words = ["--adapter", f"{planted}:Planted", "--seed", "3", "--findings", "5", "--jobs", "1", "--json"]
    done = invoke("fuzz", *words, "--minutes", "60", "--out", out, code=ExitCode.DISAGREEMENT)
    assert {found["name"] for found in json.loads(done.stdout)} == FIVE
    smallest = load_scenarios([str(path) for path in out.glob("*.yaml")])
    assert len(smallest) == 5 and all(scenario.model.n <= 3 for scenario in smallest)
    words = [*out.glob("*.yaml"), *words[:2], "--engine", "planted", "--level", "state"]
    invoke("run", *words, "--out", tmp_path / "again", code=ExitCode.DISAGREEMENT)
    assert {found["name"] for found in read_results(tmp_path / "again")["findings"]} == FIVE
    explained = invoke("explain", "--results", out)
    assert {line.split(":")[0] for line in explained.stdout.splitlines()} == FIVE
