"""Scripts of disagreements: they run with the engine and numpy alone, and show what the harness saw.

An engine with a defect is one whose own module was changed: the same few lines are executed before the
harness asks it and before the script runs, so that both meet the same engine.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from click.testing import CliRunner

from plumbline.cli.main import main
from plumbline.engines import environments
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.judging import metamorphic, run_relations, state_relations
from plumbline.judging.convergence import refinement_resolutions
from plumbline.judging.long_run_study import LongRunPlan, plan_long_run, run_long_run_study
from plumbline.judging.long_runs import judge_long_runs
from plumbline.processes.workers import Outcome
from plumbline.reproduce.engine_client import Engine
from plumbline.reproduce.measure import AlongRuns, AtState, Question, Related, shrunk
from plumbline.reproduce.measure_long_run import OverLong
from plumbline.reproduce.measure_round_trip import Twice, both_ends
from plumbline.reproduce.render import ENGINE_LINES, PARTS, part, script, unscripted
from plumbline.reproduce.shrink import Case, growing
from plumbline.reproduce.write import (
    NotReproducible,
    disagreement,
    file_name,
    measure,
    shown_by_script,
    write,
)
from plumbline.storage import results_store
from tests.helpers import pendulums
from tests.helpers.pendulums import JOINTS
from tests.helpers.planted_defects import STATE_DEFECTS, plant

for engine in ("mujoco", "pinocchio", "exudyn", "flint"):
    pytest.importorskip(engine)

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = '<img src=x onerror="alert(1)">\n"""\nimport os; os.abort()  # \\ \'\'\' \r ; # ünï'
QUANTITIES = (*state_relations.QUANTITIES, "mass_matrix")
DRIFTS = ("energy_drift", "momentum_drift", "joint_gap", "gap_rate", "norm_drift")
ROW = {"scenario": HOSTILE, "quantity": HOSTILE, "engine_version": "4", "integrator": HOSTILE,
       "extra": {"state": 3.0}}  # fmt: skip
INTEGRATORS = [(name, i.name) for name in ENGINES for i in load_adapter(name).integrators]


def run(text: str, tmp_path, before: str = "", python: str = sys.executable) -> str:
    """The output of a script in a process of its own; ``before`` is executed first."""
    path = tmp_path / "shown.py"
    path.write_text(text, encoding="utf-8")
    first = f"{before}\nimport runpy\nrunpy.run_path({str(path)!r}, run_name='__main__')"
    ours = str(ROOT) if "from reference_impl" in text else ""
    done = subprocess.run(
        [python, "-P", "-c", first] if before else [python, "-P", path],
        cwd=tmp_path, capture_output=True, text=True, timeout=120, encoding="utf-8",
        env={**os.environ, "PYTHONPATH": ours, "PYTHONIOENCODING": "utf-8", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def executed(text: str) -> tuple[str, dict]:
    """The output of a script and its names, in this process: many of them, quickly."""
    names = {"__name__": "__main__"}
    with redirect_stdout(StringIO()) as said:
        exec(compile(text, "script", "exec"), names)
    return said.getvalue(), names


@contextmanager
def defective(lines: str):
    """The engines' modules after these lines; as they were afterwards."""
    import exudyn.itemInterface
    import mujoco
    import pinocchio

    from reference_impl import collocation
    from reference_impl.direct import DirectSystem

    places = (exudyn, exudyn.itemInterface, mujoco, pinocchio, collocation, DirectSystem)
    before = [dict(vars(place)) for place in places]
    try:
        exec(lines, {})
        yield
    finally:
        for place, names in zip(places, before, strict=True):
            for name, value in names.items():
                if vars(place).get(name) is not value:
                    setattr(place, name, value)


def ratios(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"^  over (?:what|the) .*: (\S+)$", text, re.M)]


def row(engine: str, **more):
    return ROW | {"engine": engine} | more


def at_state(engine: str, joints: str) -> measure.ShownState:
    model = pendulums.model(JOINTS[joints], loads=True, drag=True)
    found = AtState(Engine(engine), QUANTITIES)(Case(model, pendulums.state(model, seed=3)))
    assert found is not None
    return found


def runs(engine: str, integrator: str, joints: str, level: str, loads: bool, until: float = 0.25):
    """A measure of runs of a slow tumble, and the case."""
    method = load_adapter(engine).integrator(integrator)
    model = pendulums.model(JOINTS[joints], loads=loads, drag=loads)
    steps = tuple(2.0**-k for k in (6, 7, 8)) if method.kind == "step" else (1e-8, 1e-10, method.min_rtol)
    case = Case(model, pendulums.state(model, seed=3, rate=1.0), until, steps)
    wanted = DRIFTS if level == "invariants" else ("order", "position_limit", "attitude_limit")
    return AlongRuns(Engine(engine), integrator, level, wanted), case


# --- a script asks the engine as the adapter does: it has no mistake of its own ----------------------


@pytest.mark.parametrize(
    ("engine", "joints"), [("pinocchio-maximal", "balls"), *((name, "rod-ball") for name in ENGINE_LINES)]
)
def test_a_script_of_a_state_asks_as_the_adapter_does(engine, joints):
    text = script(row(engine), at_state(engine, joints))
    found = ratios(executed(text)[0])
    assert len(found) >= 6 and max(found) < 1, found
    assert "plumbline" not in text


@pytest.mark.parametrize(
    ("engine", "integrator"), INTEGRATORS, ids=["-".join(names) for names in INTEGRATORS]
)
def test_a_script_of_runs_steps_as_the_adapter_does(engine, integrator):
    """To rounding, or to the tolerance of an implicit step's solver, on balls and rods with every load."""
    measure, case = runs(engine, integrator, "rod-ball", "trajectory", loads=True, until=0.0625)
    found = measure(case)
    text = script(row(engine), found)
    assert ("scipy" in text) == (integrator == "dop853" and engine != "reference") and "plumbline" not in text
    said, names = executed(text)
    assert max(ratios(said)[-2:]) < 1
    _, rungs = measure.runs(case, measure.times(case))
    for rung, mine in zip(rungs, names["runs"], strict=True):
        for name, values in zip(("r", "p", "v"), mine, strict=False):
            assert np.max(np.abs(values - getattr(rung.trajectory, name))) < 1e-10, (name, rung.resolution)


@pytest.mark.parametrize(("engine", "loads", "count"), [("exudyn", False, 5), ("pinocchio", True, 4)])
def test_a_script_measures_drifts_as_the_harness_does(engine, loads, count):
    """Momentum is not conserved under loads; the work of moments and drag is integrated without SciPy."""
    measure, case = runs(engine, {"pinocchio": "rkmk4", "exudyn": "trapezoidal"}[engine],
                         "rod-ball", "invariants", loads, until=1.0)  # fmt: skip
    found = measure(case)
    said, _ = executed(script(row(engine), found))
    assert len(ratios(said)) == count and max(ratios(said)) < 1
    truth, rungs = measure.runs(case, measure.times(case))
    who = measure.Subject("", "", "", "", "")
    ladder_ = measure.Ladder(who, case.model, truth, measure.integrator, rungs, 1.0)
    for quantity in found.drifts:
        printed = re.search(rf"{quantity} by(?:.*\n)+?  step {case.steps[-1]}: (\S+)", said)[1]
        harness = np.max(np.linalg.norm(getattr(ladder_.invariant_drifts[-1], quantity)[-1], axis=-1))
        by_quadrature = ladder_.invariant_drifts[-1].work_uncertainty * (quantity == "energy_drift")
        assert float(printed) == pytest.approx(harness, rel=0.01, abs=1e-13 + 2 * by_quadrature), quantity


@pytest.mark.parametrize(
    ("engine", "integrator", "loads", "count"),
    [
        ("exudyn", "trapezoidal", False, 5),
        ("pinocchio", "rkmk4", True, 4),
        pytest.param("reference", "dop853", True, 4, marks=pytest.mark.full),
    ],
)
def test_a_script_of_long_runs_measures_as_the_nightly_does(engine, integrator, loads, count):
    """Every sample of every invariant; the work of moments and drag is integrated without SciPy."""
    model = pendulums.model(JOINTS["rod-ball"], loads=loads, drag=loads)
    case = Case(model, pendulums.state(model, seed=3, rate=1.0), 1.0)
    measure = OverLong(Engine(engine), integrator, tuple(f"{name}_long" for name in DRIFTS), 2.0**-7)
    found = measure(measure.whole(case))
    said, names = executed(script(row(engine), found))
    assert len(found.drifts) == len(ratios(said)) == count and max(ratios(said)) < 1
    assert len(names["times"]) == 129
    plan = LongRunPlan(1.0, found.case.steps, 1.0)
    nightly = run_long_run_study(engine, integrator, model, case.state, 2.0**-7, plan).runs[-1]
    for quantity in found.drifts:
        window = nightly.windows[quantity][1.0]
        allowed = 1e-13 + 2 * nightly.work_uncertainty[1.0] * (quantity == "energy_drift")
        last = rf"{quantity} within(?:.*\n)+?  \w+ {found.case.steps[-1]}: (\S+), (\S+)"
        largest, mean = map(float, re.search(last, said).groups())
        assert largest == pytest.approx(window.max_drift, rel=0.01, abs=allowed), quantity
        assert mean == pytest.approx(np.mean(window.block_drifts), rel=0.01, abs=allowed), quantity


@pytest.mark.parametrize(
    ("engine", "integrator", "relation"),
    [("exudyn", "trapezoidal", "reversed in time"), ("reference", "collocation", "reversed in time")]
    + [("exudyn", "generalized-alpha", f"by {way}") for way in load_adapter("exudyn").linear_solvers]
    + [("exudyn-tree", "RK44", f"by {way}") for way in load_adapter("exudyn-tree").linear_solvers],
)
def test_a_script_runs_twice_as_the_harness_does(engine, integrator, relation):
    model = pendulums.model(JOINTS["rod-ball"], loads=True, drag=relation.startswith("by"))
    measure = Twice(Engine(engine), integrator, relation)
    step = 2.0**-8 if measure.integrator.kind == "step" else measure.integrator.min_rtol
    found = measure(Case(model, pendulums.state(model, seed=3, rate=1.0), 2.0**-5, (step,)))
    text = script(row(engine, level="relations"), found)
    said, names = executed(text)
    assert len(ratios(said)) == 4 and max(ratios(said)) < 0.1 and found.ratio < 0.1
    assert names.get("OTHER_SOLVER", "") == found.solver
    one, _, _ = both_ends(engine, relation, integrator, model, found.case.state, 2.0**-5, step)
    for mine, theirs in zip(names["one"], (one.r, one.p, one.v, one.omega), strict=True):
        assert np.max(np.abs(mine - theirs)) < 1e-11
    other = re.search(r"^(one, )?other = .*", text, re.M)[0]
    spoilt = text.replace(other, f"{other}\nother[0][-1] += 1e-3")
    assert max(ratios(executed(spoilt)[0])) > 1, "blind"


@pytest.mark.parametrize("engine", ["pinocchio", "exudyn"])
@pytest.mark.parametrize("relation", [r.name for r in state_relations.STATE_RELATIONS])
def test_a_script_of_a_relation_finds_what_the_harness_finds(engine, relation):
    model = pendulums.model(JOINTS["rod-ball"], loads=True, drag=relation != "time reversed")
    found = Related(Engine(engine), relation)(Case(model, pendulums.state(model, seed=3)))
    assert found.ratio < 1
    seen = ratios(executed(script(row(engine, level="relations"), found))[0])
    assert len(seen) == 6 and max(seen) < 1
    wrong = replace(found, back={q: way * 1.001 for q, way in found.back.items()})
    assert min(ratios(executed(script(row(engine, level="relations"), wrong))[0])) > 1, "blind"


@pytest.mark.parametrize(
    ("engine", "relation"),
    [(name, f"as {other}") for name in ENGINES if (other := load_adapter(name).other_formulation)]
    + [("pinocchio", f"by {way}") for way in load_adapter("pinocchio").options]
    + [(name, f"by {way}") for name in ("mujoco", "reference") for way in load_adapter(name).options]
    + [("pinocchio-aba", "by crba")]
    + [(name, "two welded halves") for name in ("mujoco", "pinocchio", "pinocchio-maximal")],
)
def test_a_script_asks_the_engine_in_its_other_way(engine, relation):
    model = pendulums.model(JOINTS["rod-ball"], loads=True, drag=True)
    found = Related(Engine(engine), relation)(Case(model, pendulums.state(model, seed=3)))
    text = script(row(engine, level="relations"), found)
    assert max(ratios(executed(text)[0])) < 1
    second = re.search(r"second = .*", text)[0]
    spoilt = text.replace(second, f"c.mass = c.mass * 1.001\n{second}\n")
    heavier = "[[(m * 1.001, s, J) for m, s, J in x] for x in halves]"
    spoilt = spoilt.replace("c.pieces = halves", f"c.pieces = {heavier}")
    assert max(ratios(executed(spoilt)[0])) > 1, "the second answer is not asked for"


# --- defects in the engines themselves ----------------------------------------------------------------

HEAVY = """import mujoco
real = mujoco.mj_setConst
def heavy(m, d):
    m.body_mass[-1] *= 1.0001
    real(m, d)
mujoco.mj_setConst = heavy
"""
EULER = """import mujoco, types
mujoco.mjtIntegrator = types.SimpleNamespace(mjINT_RK4=mujoco.mjtIntegrator.mjINT_EULER)
"""
NO_DEXP = """import pinocchio, numpy
pinocchio.dIntegrate = lambda m, q, v, arg: numpy.eye(m.nv)
"""
SYRUP = """import pinocchio
real = pinocchio.aba
pinocchio.aba = lambda m, d, q, v, *more: real(m, d, q, v, *more) - 1e-3 * v
"""
BIASED = """import pinocchio
real = pinocchio.crba
pinocchio.crba = lambda *all: real(*all) * 1.0001
"""
STRONG = """import exudyn.itemInterface as items
real = items.LoadMassProportional
def strong(markerNumber, loadVector):
    return real(markerNumber=markerNumber, loadVector=[1.0001 * x for x in loadVector])
items.LoadMassProportional = strong
"""
TREE = """import exudyn.itemInterface as items
real = items.ObjectKinematicTree
def strong(**given):
    return real(**{**given, "gravity": [1.001 * x for x in given["gravity"]]})
items.ObjectKinematicTree = strong
"""
NOTES = """from reference_impl.direct import System
real = System.solve
System.solve = lambda self, *given: real(self, *given, 1e-6)
"""
FLYER = """import pinocchio
for name in ("constraintDynamics", "forwardDynamics"):
    def fast(m, d, q, v, tau, *more, real=getattr(pinocchio, name)):
        return real(m, d, q, 1.0001 * v, tau, *more)
    setattr(pinocchio, name, fast)
"""
SOLVER = """import exudyn
class Spoilt:
    def __init__(self):
        self.real = made()
    def __getattr__(self, name):
        return getattr(self.real, name)
    def SolveSystem(self, mbs, chosen):
        spoil(chosen, chosen.timeIntegration.generalizedAlpha)
        return self.real.SolveSystem(mbs, chosen)
"""
LOSSY = f"""{SOLVER}made, exudyn.MainSolverImplicitSecondOrder = exudyn.MainSolverImplicitSecondOrder, Spoilt
def spoil(chosen, method):
    method.useNewmark = method.useIndex2Constraints = False
    method.spectralRadius = 0.9
"""
DENSE = f"""{SOLVER}made, exudyn.MainSolverImplicitSecondOrder = exudyn.MainSolverImplicitSecondOrder, Spoilt
def spoil(chosen, method):
    if chosen.linearSolver.solverType == exudyn.LinearSolverType.EXUdense:
        method.useNewmark = method.useIndex2Constraints = False
        method.spectralRadius = 0.5
"""
SPARSE = f"""{SOLVER}made, exudyn.MainSolverExplicit = exudyn.MainSolverExplicit, Spoilt
def spoil(chosen, method):
    if chosen.linearSolver.solverType == exudyn.LinearSolverType.EigenSparse:
        chosen.timeIntegration.solverType = exudyn.DynamicSolverType.ExplicitMidpoint
"""
FASTER = """from reference_impl import collocation
real = collocation.integrate
def faster(chains, r, p, v, pdot, *more, **named):
    return real(chains, r, p, v * (1 + 1e-9), pdot * (1 + 1e-9), *more, **named)
collocation.integrate = faster
"""
DAMPED = """import mujoco
real = mujoco.mj_setConst
def damped(m, d):
    m.dof_damping[:] = 1e-5
    real(m, d)
mujoco.mj_setConst = damped
"""
FULL = pytest.mark.full
DEFECTS = [  # engine, level, integrator, what must disagree, the defect
    ("mujoco", "state", "-", "joint_reaction", HEAVY),
    ("exudyn-tree", "state", "-", "acceleration", TREE),
    ("mujoco", "trajectory", "RK4", "order", EULER),
    ("exudyn", "trajectory", "trapezoidal", "attitude_limit", STRONG),
    ("pinocchio", "invariants", "semi-implicit-euler", "energy_drift", SYRUP),
    ("pinocchio-aba", "relations", "-", "by crba", SYRUP),
    ("exudyn", "relations", "trapezoidal", "reversed in time", LOSSY),
    ("exudyn-tree", "relations", "RK44", "by EigenSparse", SPARSE),
    ("mujoco", "invariants", "RK4", "energy_drift_long", DAMPED),
    ("pinocchio", "invariants", "rkmk4", "energy_drift_long", SYRUP),
    pytest.param("pinocchio", "state", "-", "mass_matrix", BIASED, marks=FULL),
    pytest.param("pinocchio-maximal", "state", "-", "acceleration", FLYER, marks=FULL),
    pytest.param("exudyn", "state", "-", "acceleration", STRONG, marks=FULL),
    pytest.param("reference", "state", "-", "acceleration", NOTES, marks=FULL),
    pytest.param("mujoco", "trajectory", "RK4", "position_limit", HEAVY, marks=FULL),
    pytest.param("pinocchio", "trajectory", "rkmk4", "order", NO_DEXP, marks=FULL),
    pytest.param("exudyn-tree", "trajectory", "RK44", "position_limit", TREE, marks=FULL),
    pytest.param("pinocchio", "trajectory", "dop853", "position_limit", BIASED, marks=FULL),
    pytest.param("mujoco", "invariants", "RK4", "energy_drift", HEAVY, marks=FULL),
    pytest.param("exudyn", "invariants", "generalized-alpha", "energy_drift", STRONG, marks=FULL),
    pytest.param("pinocchio", "relations", "-", "as pinocchio-maximal", FLYER, marks=FULL),
    pytest.param("exudyn", "relations", "trapezoidal", "by EXUdense", DENSE, marks=FULL),
    pytest.param("exudyn", "relations", "generalized-alpha", "by EXUdense", DENSE, marks=FULL),
    pytest.param("reference", "relations", "collocation", "reversed in time", FASTER, marks=FULL),
    pytest.param("exudyn", "invariants", "trapezoidal", "energy_drift_long", STRONG, marks=FULL),
    pytest.param("pinocchio", "invariants", "dop853", "energy_drift_long", BIASED, marks=FULL),
]


@pytest.mark.parametrize(
    ("engine", "level", "integrator", "wanted", "lines"),
    DEFECTS,
    ids=lambda value: "" if "\n" in value else value,
)
def test_a_defect_in_an_engine_is_shown_by_its_script(engine, level, integrator, wanted, lines, tmp_path):
    """The script is run in a process of its own; without the defect the same script finds nothing."""
    model = pendulums.model(JOINTS["balls"])
    case, most = Case(model, pendulums.state(model, seed=3, rate=1.0)), 50.0
    if integrator != "-":
        method = load_adapter(engine).integrator(integrator)
        case = replace(case, until=0.25, steps=tuple(refinement_resolutions(method, 2, 1.0))[:6])
        if level == "relations":
            step = 2.0**-7 if method.kind == "step" else method.min_rtol
            case = replace(case, until=0.125, steps=(step,))
        elif wanted.endswith("_long"):
            case, most = replace(case, until=12.5, steps=()), 4.0  # not falling, it is over by little
    question = Question(Engine(engine), level, (wanted,), integrator, case, most, 1.5, 2.0**-5)
    with defective(lines):
        text, why = shown_by_script(question, row(engine, level=level))
    assert text, why
    assert len(re.search(r"mass=np\.array\(\[(.*?)\]\)", text)[1].split(",")) == 1, "one body shows it"
    said = run(text, tmp_path, before=lines)
    assert max(ratios(said)) > 1 and disagreement(said) == max(ratios(said))
    right, _ = executed(text)
    assert max(ratios(right)) < 1, "without the defect all is right"
    differences = [re.findall(r"^  difference.*", text, re.M) for text in (said, right)]
    assert differences[0] != differences[1]


def test_a_drift_that_grows_is_shown_in_a_shorter_time_of_the_same_motion(tmp_path):
    """A symmetric method's energy: with fewer bodies or simpler numbers the motion may not be regular."""
    from plumbline.scenario.loader import find_scenario_file, load_scenario

    scenario, lossy = load_scenario(find_scenario_file("lagrange-top")), LOSSY.replace("0.9", "0.0")
    case, wanted = Case(scenario.model, scenario.state, 50.0), ("energy_drift_long_growth",)
    question = Question(
        Engine("exudyn"), "invariants", wanted, "trapezoidal", case, 1.9, 20.0, scenario.sample_interval
    )
    with defective(lossy):
        text, why = shown_by_script(question, row("exudyn", level="invariants"))
    assert text, why
    assert "np.linspace(0.0, 12.5, 401)" in text, "not shorter: a drift that swings may be on its way out"
    assert "steps = [0.001953125]" in text and f"mass=np.array({scenario.model.mass.tolist()})" in text
    assert max(ratios(run(text, tmp_path, before=lossy))) > 1.5
    assert max(ratios(executed(text)[0])) < 0.2, "the trapezoidal rule keeps it bounded"


# --- shrinking ------------------------------------------------------------------------------------------


def test_the_smallest_chain_on_which_aba_loses_its_digits(tmp_path):
    """The real one: Pinocchio's aba on thirty balls, with simpler numbers, and still disagreeing alone."""
    from plumbline.scenario.loader import find_scenario_file, load_scenario

    scenario = load_scenario(find_scenario_file("chain-30-balls"))
    case = Case(scenario.model, scenario.state)
    wanted = ("acceleration", "angular_acceleration", "joint_reaction")
    question = Question(Engine("pinocchio-aba"), "state", wanted, "-", case, 0.0, 60.0)
    small = shrunk(question)
    assert small.case.model.n < 30 and small.ratio >= 10
    assert not small.case.model.has_loads and np.all(small.case.state.omega == 0)
    assert np.all(small.case.model.mass == 1)
    text = script(row("pinocchio-aba"), small)
    assert len(text) < len(script(row("pinocchio-aba"), AtState(Engine("pinocchio-aba"), wanted)(case)))
    found = ratios(run(text, tmp_path))
    assert max(found) >= 5, "next to the bound rounding decides: the script's is another than the adapter's"
    right = ratios(executed(text.replace("ALGORITHM = 'aba'", "ALGORITHM = 'crba'"))[0])
    assert max(right) < 1, "the model is the same: crba is right where aba is not"


def test_a_defect_in_one_number_shrinks_to_one_body():
    defect = next(d for d in STATE_DEFECTS if d.name == "inertia-xx-1e-6")
    engine = plant(type(load_adapter(defect.engine)), defect)
    model = pendulums.model(JOINTS["mixed"], loads=True, drag=True)
    case = Case(model, pendulums.state(model, seed=3))
    with patch("plumbline.reproduce.engine_client.load_adapter", lambda _: engine):
        small = shrunk(Question(Engine(defect.engine), "state", ("acceleration",), "-", case, 0.0, 60.0))
    assert small.case.model.n == 1 and not small.case.model.has_loads and not small.case.model.has_drag
    assert small.case.model.mass.tolist() == [1.0]


def test_a_busy_search_gives_what_it_has():
    """Out of time it is the case itself, unshrunk."""
    defect = next(d for d in STATE_DEFECTS if d.name == "inertia-xx-1e-6")
    model = pendulums.model(JOINTS["balls"])
    case = Case(model, pendulums.state(model, seed=3))
    question = Question(Engine(defect.engine), "state", ("acceleration",), "-", case, 0.0, 0.0)
    with patch(
        "plumbline.reproduce.engine_client.load_adapter",
        lambda _: plant(type(load_adapter(defect.engine)), defect),
    ):
        small = shrunk(question)
    assert small is not None and small.case.model.n == 2
    runs = replace(
        case, until=1.0, steps=tuple(refinement_resolutions(load_adapter("mujoco").integrator("RK4"), 2, 1.0))
    )
    late = replace(question, engine=Engine("mujoco"), level="trajectory", integrator="RK4", case=runs)
    text, why = shown_by_script(late, row("mujoco"))
    assert not text and "within 0 s" in why, "a whole ladder of runs is not begun out of time"


def test_long_runs_are_tried_from_a_few_seconds_up():
    model = pendulums.model(JOINTS["balls"])
    case = Case(model, pendulums.state(model), 100.0, (2.0**-7,))
    tried = [(c.until, c.model.n) for c in growing(case)]
    assert tried[0] == (1.5625, 1) and tried[-1] == (100.0, 2)
    assert [c.until for c in growing(case, plainer=False)] == [1.5625, 6.25, 25.0, 100.0]
    assert min(c.until for c in growing(replace(case, until=1.0))) == 0.0625


def test_where_the_engine_agrees_there_is_nothing_to_show():
    model = pendulums.model(JOINTS["ball"])
    case = Case(model, pendulums.state(model))
    question = Question(Engine("mujoco"), "state", ("acceleration",), "-", case, 0.0, 60.0)
    text, why = shown_by_script(question, row("mujoco"))
    assert not text and "agrees" in why


def test_another_environment_is_asked_and_runs_the_script(tmp_path):
    """This interpreter stands for that of another version: the way there and back is the same."""
    model = pendulums.model(JOINTS["ball"])
    case = Case(model, pendulums.state(model))
    there = AtState(Engine("mujoco", sys.executable), QUANTITIES)(case)
    assert there.ratio == AtState(Engine("mujoco"), QUANTITIES)(case).ratio
    said = Engine("mujoco", sys.executable).say(script(row("mujoco@4"), there))
    assert said == executed(script(row("mujoco@4"), there))[0] and len(ratios(said)) == len(QUANTITIES)
    twice, long_ = replace(case, until=0.125, steps=(2.0**-7,)), replace(case, until=0.5)
    for name, ask, what in (
        ("exudyn", lambda engine: Twice(engine, "trapezoidal", "reversed in time"), twice),
        ("mujoco", lambda engine: OverLong(engine, "RK4", ("joint_gap_long",), 2.0**-5), long_),
    ):
        found = [ask(Engine(name, python)) for python in ("", sys.executable)]
        found = [measure(getattr(measure, "whole", lambda x: x)(what)) for measure in found]
        assert script(row(name), found[0]) == script(row(name), found[1])


def interpreter_of(engine):
    """That of an engine's other version; skips with the reason where it cannot be had."""
    try:
        return environments.ensure_interpreter(engine)
    except environments.EnvironmentUnavailable as error:
        pytest.skip(str(error))


@pytest.mark.full
def test_the_order_of_an_older_mujoco_is_shown_in_its_environment(tmp_path):
    """The real one: RK4 of 3.12 is of order 2."""
    python = interpreter_of("mujoco@3.12.0")
    model = pendulums.model(JOINTS["balls"])
    steps = tuple(refinement_resolutions(load_adapter("mujoco").integrator("RK4"), 2, 1.0))
    case = Case(model, pendulums.state(model, seed=3, rate=1.0), 1.0, steps)
    question = Question(Engine("mujoco", python), "trajectory", ("order",), "RK4", case, 20.0, 20.0)
    text, _ = shown_by_script(question, row("mujoco@3.12.0", engine_version="3.12.0"))
    assert "'mujoco@3.12.0' '3.12.0'" in text
    assert max(ratios(run(text, tmp_path, python=python))) == pytest.approx(20, rel=0.1)
    assert ratios(run(text, tmp_path))[0] < 1, "the installed one is of order 4"


@pytest.mark.full
def test_the_start_of_an_older_exudyn_is_shown_in_its_environment(tmp_path):
    """The real one: before 1.11 the first accelerations are wrong with the sparse solver."""
    python = interpreter_of("exudyn@1.10.0")
    model = pendulums.model(JOINTS["balls"])
    case = Case(model, pendulums.state(model, seed=3), 2.0**-4, (2.0**-8,))
    question = Question(
        Engine("exudyn", python), "relations", ("by EXUdense",), "trapezoidal", case, 1e4, 20.0
    )
    told = row("exudyn@1.10.0", engine_version="1.10.0", level="relations")
    text, why = shown_by_script(question, told)
    assert text, why
    assert "times = np.array([0.0, 0.00390625])" in text and "mass=np.array([1.0])" in text
    assert max(ratios(run(text, tmp_path, python=python))) > 1e3
    assert max(ratios(run(text, tmp_path))) < 1, "the installed one starts right"


# --- texts ------------------------------------------------------------------------------------------------


def test_hostile_names_stay_text(tmp_path):
    state = at_state("mujoco", "ball")
    model = pendulums.model(JOINTS["ball"])
    relation = Related(Engine("mujoco"), "masses doubled")(Case(model, pendulums.state(model)))
    along, case = runs("mujoco", "RK4", "ball", "trajectory", loads=False)
    hostile = row("mujoco", engine_version=HOSTILE, level=HOSTILE)
    for found in (state, replace(relation, name=HOSTILE), along(case)):
        text = script(hostile, found)
        head = text.split("from types")[0]
        assert all(line.startswith("#") or not line for line in head.splitlines())
        assert "os.abort" in head
        executed(text)
    run(script(hostile, state), tmp_path)
    assert re.fullmatch(r"[A-Za-z0-9._-]+\.py", file_name(HOSTILE))
    assert file_name("a/b") != file_name("a-b")


@pytest.mark.parametrize("name", [path.stem for path in PARTS.glob("*.txt")])
def test_conditions_in_the_parts_are_closed(name):
    lines = (PARTS / f"{name}.txt").read_text(encoding="utf-8").splitlines()
    assert sum(line.startswith("#if ") for line in lines) == lines.count("#end")
    assert not part(name, set()).count("#if")


def test_every_engine_has_a_script_and_what_has_none_says_why():
    assert set(ENGINE_LINES) == set(ENGINES)
    for level, quantity, integrator, words in (
        ("relations", "reversed in time", "trapezoidal", ""),
        ("relations", "by EigenDense", "generalized-alpha", ""),
        ("relations", "something new", "trapezoidal", "does not know the relation 'something new' of runs"),
        ("relations", "two welded halves", "-", "does not know the relation"),
        ("relations", "something new", "-", "not of one state"),
        ("state", "acceleration", "-", ""),
        ("relations", "rotated world", "-", ""),
    ):
        said = unscripted("exudyn", {"level": level, "quantity": quantity, "integrator": integrator})
        assert words in said and bool(words) == bool(said)
    for name in ENGINES:  # no relation of runs that the harness tries is left without a script
        chosen = load_adapter(name)
        for integrator in chosen.integrators:
            tried = ["reversed in time"] * integrator.is_symmetric
            tried += [f"by {solver}" for solver in chosen.linear_solvers if integrator.kind == "step"]
            for relation in tried:
                cell = {"level": "relations", "quantity": relation, "integrator": integrator.name}
                assert unscripted(name, cell) == ""
    assert "no script template" in unscripted("other", {"level": "state", "quantity": "", "integrator": "-"})


# --- a results folder ---------------------------------------------------------------------------------------


@pytest.fixture
def results(tmp_path):
    """A results folder with disagreements that the harness recorded of aba, and one without a script."""
    from plumbline.scenario.loader import find_scenario_file, load_scenario

    scenario = load_scenario(find_scenario_file("chain-30-balls"))
    about = {
        "digest": scenario.digest,
        "model": {k: np.asarray(v).tolist() for k, v in vars(scenario.model).items()},
        "state": {k: getattr(scenario.state, k).tolist() for k in ("p", "omega", "u", "udot")},
    }
    rows = [
        ROW | {"scenario": "chain", "engine": "pinocchio-aba", "level": level, "verdict": verdict,
               "key": key, "reason": "off", "diagnosis": None, "quantity": quantity, "integrator": integrator,
               "value": 400.0, "tolerance": 1.0, "extra": {"state": 0.0}}
        for key, level, integrator, quantity, verdict in (
            ("a", "state", "-", "acceleration", "disagrees"),
            ("b", "relations", "rkmk4", "reversed in time", "disagrees"),
            ("c", "state", "-", "joint_reaction", "agrees"),
            ("d", "relations", "-", "re-chosen body frame", "disagrees"))
    ]  # fmt: skip
    document = {"schema_version": results_store.SCHEMA_VERSION, "scenarios": {"chain": about}, "rows": rows}
    (tmp_path / "results.json").write_text(json.dumps(document))
    return tmp_path


def test_the_command_lists_and_writes(results):
    command = CliRunner()
    listed = command.invoke(main, ["reproduce", str(results)])
    assert listed.exit_code == 0 and "a: off" in listed.output and "c:" not in listed.output
    with patch("plumbline.reproduce.write.ASKED", 0.0):
        done = command.invoke(main, ["reproduce", str(results / "results.json"), "a", "d"])
    assert done.exit_code == 0, done.output
    index = json.loads((results / "scripts" / "index.json").read_text())
    assert set(index) == {"a", "d"}
    for name in index.values():
        path = results / "scripts" / name
        assert str(path) in done.output and path.is_file()
        assert max(ratios(run(path.read_text(encoding="utf-8"), results))) > 1
    assert command.invoke(main, ["reproduce", str(results), "nothing"]).exit_code == 2
    refused = command.invoke(main, ["reproduce", str(results), "b"])
    assert refused.exit_code == 1 and "of runs" in refused.output


def test_the_runs_behind_a_row_are_those_of_its_ladder(results):
    document = results_store.read_results(results)
    found = {"scenario": "chain", "engine": "mujoco", "integrator": "RK4", "level": "trajectory",
             "verdict": "disagrees", "declared_order": 4, "compared_until": 1.7, "value": 2.0, "tolerance": 0.1, "ratio": 20.0,
             "quantity": "order", "extra": {}}  # fmt: skip
    finest = found | {"quantity": "position", "verdict": "agrees", "extra": {"resolution": 2.0**-8}}
    others = ({"level": "relations"}, {"level": "invariants", "quantity": "energy_drift_long"})
    apart = [finest | other | {"extra": {"resolution": 2.0**-12}} for other in others]
    document["rows"] = [found, finest, *apart]
    question = write.asked(document, [found], 1.0)
    assert question.case.steps == (2.0**-5, 2.0**-6, 2.0**-7, 2.0**-8)
    assert question.case.until == 1.0 and question.most == 20 and question.wanted == ("order",)
    document["rows"] = [found]
    with pytest.raises(NotReproducible, match="ladder"):
        write.asked(document, [found], 1.0)


def document_of(name: str, rows: list) -> dict:
    """Results as a run stores them: one scenario, and these rows."""
    from plumbline.scenario.loader import find_scenario_file, load_scenario

    scenario = load_scenario(find_scenario_file(name))
    about = {
        "digest": scenario.digest, "sample": scenario.sample_interval,
        "model": {k: np.asarray(v).tolist() for k, v in vars(scenario.model).items()},
        "state": {k: getattr(scenario.state, k).tolist() for k in ("p", "omega", "u", "udot")},
    }  # fmt: skip
    return {"scenarios": {name: about}, "rows": [results_store.row_record(row) for row in rows]}


@pytest.mark.parametrize(
    ("engine", "relation", "lines"),
    [("exudyn", "reversed in time", LOSSY), ("exudyn-tree", "by EigenSparse", SPARSE)],
)
def test_the_run_behind_a_relation_of_runs_is_asked_for_again(engine, relation, lines):
    from plumbline.scenario.loader import find_scenario_file, load_scenario

    scenario = load_scenario(find_scenario_file("double-tumbling-balls"))
    with defective(lines):
        found = list(run_relations.check_run_relations(load_adapter(engine), scenario.model, scenario.state))
        rows = metamorphic.judge_relations(
            measure.Subject(scenario.name, "", engine, engine, "1"), found
        ).rows
        row = next(row for row in rows if row.quantity == relation)
        document = document_of(scenario.name, rows)
        question = write.asked(document, [results_store.row_record(row)], 1.0)
        assert question.case.until == 16 * question.case.steps[0] == row.extra["end"]
        again = measure.measure_of(question)(question.case)
    assert row.verdict == "disagrees" and again.ratio == pytest.approx(row.value) == question.most
    without = results_store.row_record(row) | {"extra": {"state": 0.0}}
    with pytest.raises(NotReproducible, match="step of this run"):
        write.asked(document, [without], 1.0)


def test_the_long_runs_behind_a_row_are_asked_for_again():
    from plumbline.scenario.loader import find_scenario_file, load_scenario

    scenario, method = (
        load_scenario(find_scenario_file("tumbling-ball")),
        load_adapter("mujoco").integrator("RK4"),
    )
    with defective(DAMPED):
        plan = plan_long_run(method, 1, 6.25)
        runs = run_long_run_study(
            "mujoco", "RK4", scenario.model, scenario.state, scenario.sample_interval, plan
        )
        who = measure.Subject(scenario.name, "", "mujoco", "MuJoCo", "1")
        rows = judge_long_runs(who, scenario.model, method, runs, False).rows
        document = document_of(scenario.name, rows)
        off = write.disputed(document)
        question = write.asked(document, off, 1.0)
        again = measure.measure_of(question)(measure.whole(question))
    assert {row["quantity"] for row in off} >= {"energy_drift_long"} and question.case.until == 6.25
    assert again.ratio == pytest.approx(question.most) and again.case.steps == plan.resolutions
    cells = {write.cell_of(row | {"quantity": q}) for row in off for q in
             ("energy_drift", "energy_drift_long", "energy_drift_long_growth")}  # fmt: skip
    assert len(cells) == 3, "a script shows one kind of them"


def test_a_lost_engine_is_told_and_leaves_no_script(results):
    with patch(
        "plumbline.reproduce.write.WorkerPool.run",
        lambda _, tasks: [Outcome(t.key, failure="hung") for t in tasks],
    ):
        told = write.write(results)
        assert write.write(results, ["d"]) == {"d": "hung"}
    assert told["a"] == "hung" and "of runs" in told["b"] and "the state-level script" in told["d"]
    assert not list((results / "scripts").glob("*.py"))


def test_at_the_end_of_a_run_nothing_long_is_begun(results):
    document = results_store.read_results(results)
    slow = {
        "key": "s",
        "level": "trajectory",
        "integrator": "rkmk4",
        "quantity": "attitude",
        "cpu_time": 2.0,
    }
    document["rows"] = [document["rows"][0] | slow]
    (results / "results.json").write_text(json.dumps(document))
    with patch("plumbline.reproduce.write.WorkerPool", side_effect=AssertionError("began")):
        told = write.write(results)
    assert told == {
        "s": "one try takes 2.0 s of computing, too long at the end of a run; ask for this row by its key"
    }
    with patch("plumbline.reproduce.write.asked", side_effect=NotReproducible("began")):
        assert write.write(results, ["s"]) == {"s": "began"}


def test_a_row_that_is_not_there_is_refused(results):
    with pytest.raises(NotReproducible, match="no row 'x'"):
        write.write(results, ["x"])
