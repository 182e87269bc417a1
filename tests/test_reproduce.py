"""Scripts of disagreements: they run with the engine and numpy alone, and show what the harness saw."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from unittest.mock import patch

import numpy as np
import pytest
from click.testing import CliRunner

from plumbline import reproduce, store
from plumbline.cli import main
from plumbline.registry import adapter
from plumbline.reproduce import ENGINE_LINES, NotReproducible, Shown, file_name, script, shown, shrunk
from plumbline.workers import Outcome
from tests import pendulums
from tests.pendulums import JOINTS
from tests.planted import STATE_DEFECTS, plant

for engine in ("mujoco", "pinocchio", "exudyn", "flint"):
    pytest.importorskip(engine)

HOSTILE = '<img src=x onerror="alert(1)">\n"""\nimport os; os.abort()  # \\ \'\'\' \r ; # ünï'
ROW = {"scenario": HOSTILE, "quantity": "acceleration", "engine_version": "0", "extra": {"state": 3.0}}


def run(text: str, tmp_path) -> str:
    path = tmp_path / "shown.py"
    path.write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-I", path], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def ratios(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"over what rounding explains: (\S+)", text)]


def case(engine: str, joints: str) -> Shown:
    model = pendulums.model(JOINTS[joints], loads=True, drag=True)
    found = shown(engine, model, pendulums.state(model, seed=3))
    assert found is not None
    return found


@pytest.mark.parametrize("joints", ["balls", "rod-ball"])
@pytest.mark.parametrize("engine", sorted(ENGINE_LINES))
def test_a_script_asks_the_engine_as_the_adapter_does(engine, joints, tmp_path):
    """Where nothing disagrees the script must not disagree either: no mistake of its own."""
    text = script(engine, case(engine, joints), ROW | {"engine": engine})
    imports = set(re.findall(r"^import (\w+)", text, re.M))
    assert imports <= {"numpy", "mujoco", "pinocchio", "exudyn"} and "plumbline" not in imports
    found = ratios(run(text, tmp_path))
    assert len(found) >= 4 and max(found) < 1, found


def test_hostile_names_stay_text(tmp_path):
    text = script("mujoco", case("mujoco", "ball"), ROW | {"engine": "mujoco"})
    head = text.split("import mujoco")[0]
    assert all(line.startswith("#") or not line for line in head.splitlines())
    assert "os.abort" in head
    run(text, tmp_path)
    assert re.fullmatch(r"[A-Za-z0-9._-]+\.py", file_name(HOSTILE))
    assert file_name("a/b") != file_name("a-b")


def test_the_smallest_chain_on_which_aba_loses_its_digits(tmp_path):
    """The real one: Pinocchio's aba on thirty balls, with simpler numbers, and still disagreeing alone."""
    from plumbline.scenario import find, load

    scenario = load(find("chain-30-balls"))
    before = shown("pinocchio-aba", scenario.model, scenario.state)
    small = shrunk("pinocchio-aba", scenario.model, scenario.state)
    assert small.model.n <= before.model.n
    assert not small.model.has_loads and np.all(small.state.omega == 0)
    text = script("pinocchio-aba", small, ROW | {"engine": "pinocchio-aba"})
    assert len(text) < len(script("pinocchio-aba", before, ROW | {"engine": "pinocchio-aba"}))
    assert np.all(small.model.mass == 1)
    found = ratios(run(text, tmp_path))
    assert max(found) == pytest.approx(small.ratio, rel=0.02) and max(found) >= 10
    right = ratios(run(text.replace("ALGORITHM = 'aba'", "ALGORITHM = 'crba'"), tmp_path))
    assert max(right) < 1, "the model is the same: crba is right where aba is not"


def test_a_defect_in_one_number_shrinks_to_one_body():
    defect = next(d for d in STATE_DEFECTS if d.name == "inertia-xx-1e-6")
    engine = plant(type(adapter(defect.engine)), defect)
    model = pendulums.model(JOINTS["mixed"], loads=True, drag=True)
    with patch("plumbline.reproduce.adapter", lambda _: engine):
        small = shrunk(defect.engine, model, pendulums.state(model, seed=3))
    assert small.model.n == 1 and not small.model.has_loads and not small.model.has_drag
    assert small.model.mass.tolist() == [1.0]


def test_where_the_engine_agrees_there_is_nothing_to_show():
    model = pendulums.model(JOINTS["ball"])
    assert shrunk("mujoco", model, pendulums.state(model)) is None


@pytest.fixture
def results(tmp_path):
    """A results folder with one disagreement that the harness recorded of aba, and one of a trajectory."""
    from plumbline.scenario import find, load

    scenario = load(find("chain-30-balls"))
    about = {
        "digest": scenario.digest,
        "model": {k: np.asarray(v).tolist() for k, v in vars(scenario.model).items()},
        "state": {k: getattr(scenario.state, k).tolist() for k in ("p", "omega", "u", "udot")},
    }
    rows = [
        ROW | {"scenario": "chain", "engine": "pinocchio-aba", "level": level, "verdict": verdict,
               "key": key, "reason": "off", "diagnosis": None, "extra": {"state": 0.0}}
        for key, level, verdict in (
            ("a", "state", "disagrees"), ("b", "trajectory", "disagrees"), ("c", "state", "agrees"))
    ]  # fmt: skip
    document = {"schema_version": store.SCHEMA_VERSION, "scenarios": {"chain": about}, "rows": rows}
    (tmp_path / "results.json").write_text(json.dumps(document))
    return tmp_path


def test_the_command_lists_and_writes(results):
    command = CliRunner()
    listed = command.invoke(main, ["reproduce", str(results)])
    assert listed.exit_code == 0 and "a: off" in listed.output and "c:" not in listed.output
    done = command.invoke(main, ["reproduce", str(results / "results.json"), "a"])
    assert done.exit_code == 0, done.output
    path = results / "scripts" / file_name("a")
    assert str(path) in done.output and path.is_file()
    assert json.loads((results / "scripts" / "index.json").read_text()) == {"a": path.name}
    assert max(ratios(run(path.read_text(encoding="utf-8"), results))) >= 10
    assert command.invoke(main, ["reproduce", str(results), "nothing"]).exit_code == 2
    refused = command.invoke(main, ["reproduce", str(results), "b"])
    assert refused.exit_code == 1 and "trajectory" in refused.output


def test_a_lost_engine_is_told_and_leaves_no_script(results):
    with patch(
        "plumbline.reproduce.Workers.run", lambda _, tasks: [Outcome(t.key, lost="hung") for t in tasks]
    ):
        assert reproduce.write(results)["a"] == "hung"
    assert not list((results / "scripts").glob("*.py"))


def test_a_row_that_is_not_there_is_refused(results):
    with pytest.raises(NotReproducible, match="no row 'x'"):
        reproduce.write(results, ["x"])
