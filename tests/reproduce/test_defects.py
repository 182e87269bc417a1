"""A defect in an engine is shown by a small script, which finds nothing without the defect.

An engine with a defect is one whose own module was changed: the same few lines are executed before the
harness calls it and before the script runs, so that both meet the same engine.
"""

import re
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.engines import environments
from plumbline.engines.registry import load_adapter
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.measure import Disagreement, StateMeasure
from plumbline.reproduce.shrink import ReproductionCase, starting_cases
from plumbline.reproduce.write import make_script
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.planted_defects import STATE_DEFECTS
from tests.helpers.planting import plant
from tests.helpers.reproduction import defective, execute, run_alone, script_of, state_case, stored_row

for name in ("mujoco", "pinocchio", "exudyn", "flint"):
    pytest.importorskip(name)

HEAVY_MUJOCO = """import mujoco
real = mujoco.mj_setConst
def heavy(m, d):
    m.body_mass[-1] *= 1.0001
    real(m, d)
mujoco.mj_setConst = heavy
"""
MUJOCO_EULER = """import mujoco, types
mujoco.mjtIntegrator = types.SimpleNamespace(mjINT_RK4=mujoco.mjtIntegrator.mjINT_EULER)
"""
PINOCCHIO_NO_DEXP = """import pinocchio, numpy
pinocchio.dIntegrate = lambda m, q, v, arg: numpy.eye(m.nv)
"""
DAMPED_PINOCCHIO = """import pinocchio
real = pinocchio.aba
pinocchio.aba = lambda m, d, q, v, *more: real(m, d, q, v, *more) - 1e-3 * v
"""
BIASED_PINOCCHIO = """import pinocchio
real = pinocchio.crba
pinocchio.crba = lambda *all: real(*all) * 1.0001
"""
STRONG = """import exudyn
def strong(mbs):
    for i in range(mbs.systemData.NumberOfLoads()):
        if mbs.GetLoad(i)["loadType"] == "MassProportional":
            mbs.SetLoadParameter(i, "loadVector", [1.0001 * x for x in mbs.GetLoad(i)["loadVector"]])
    for i in range(mbs.systemData.NumberOfObjects()):
        if mbs.GetObject(i)["objectType"] == "KinematicTree":
            mbs.SetObjectParameter(i, "gravity", [1.001 * x for x in mbs.GetObject(i)["gravity"]])
class Strong(exudyn.SOLVER):
    def SolveSystem(self, mbs, settings):
        strong(mbs)
        return super().SolveSystem(mbs, settings)
    def InitializeSolver(self, mbs, settings):
        strong(mbs)
        return super().InitializeSolver(mbs, settings)
exudyn.SOLVER = Strong
"""
STRONG_EXUDYN = STRONG.replace("SOLVER", "MainSolverImplicitSecondOrder")
STRONG_TREE = STRONG.replace("SOLVER", "MainSolverExplicit")
FAST_PINOCCHIO = """import pinocchio
for name in ("constraintDynamics", "forwardDynamics"):
    def fast(m, d, q, v, tau, *more, real=getattr(pinocchio, name)):
        return real(m, d, q, 1.0001 * v, tau, *more)
    setattr(pinocchio, name, fast)
"""
FULL = pytest.mark.full
DEFECTS = [  # engine, level, integrator, what must disagree, the defect
    ("mujoco", "state", "-", "joint_reaction", HEAVY_MUJOCO),
    ("exudyn-tree", "state", "-", "acceleration", STRONG_TREE),
    ("mujoco", "trajectory", "RK4", "order", MUJOCO_EULER),
    ("exudyn", "trajectory", "trapezoidal", "attitude_limit", STRONG_EXUDYN),
    ("mujoco", "step", "RK4", "step_rate", MUJOCO_EULER),
    ("pinocchio", "step", "rkmk4", "step_attitude", PINOCCHIO_NO_DEXP),
    ("exudyn-tree", "step", "RK44", "step_velocity", STRONG_TREE),
    ("pinocchio", "invariants", "semi-implicit-euler", "energy_drift", DAMPED_PINOCCHIO),
    ("pinocchio-aba", "relations", "-", "by crba", DAMPED_PINOCCHIO),
    pytest.param("pinocchio", "state", "-", "mass_matrix", BIASED_PINOCCHIO, marks=FULL),
    pytest.param("pinocchio-maximal", "state", "-", "acceleration", FAST_PINOCCHIO, marks=FULL),
    pytest.param("exudyn", "state", "-", "acceleration", STRONG_EXUDYN, marks=FULL),
    pytest.param("mujoco", "trajectory", "RK4", "position_limit", HEAVY_MUJOCO, marks=FULL),
    pytest.param("pinocchio", "trajectory", "rkmk4", "order", PINOCCHIO_NO_DEXP, marks=FULL),
    pytest.param("exudyn-tree", "trajectory", "RK44", "position_limit", STRONG_TREE, marks=FULL),
    pytest.param("mujoco", "invariants", "RK4", "energy_drift", HEAVY_MUJOCO, marks=FULL),
    pytest.param("exudyn", "invariants", "generalized-alpha", "energy_drift", STRONG_EXUDYN, marks=FULL),
    pytest.param("pinocchio", "relations", "-", "as pinocchio-maximal", FAST_PINOCCHIO, marks=FULL),
]


def study(engine, integrator, case, until):
    """The refinement study that a run makes of a case."""
    steps = refinement_resolutions(load_adapter(engine).integrator(integrator), case.model.n, 1.0)
    return replace(case, until=until, steps=tuple(steps[:6]))


def disagreement(engine, quantities, case, **more):
    given = {"level": "state", "integrator": "-", "ratio": 50.0, "seconds": 60.0} | more
    return Disagreement(EngineClient(engine), quantities=quantities, case=case, **given)


@pytest.mark.parametrize(
    ("engine", "level", "integrator", "wanted", "lines"),
    DEFECTS,
    ids=lambda value: "" if "\n" in value else value,
)
def test_a_defect_in_an_engine_is_shown_by_its_script(engine, level, integrator, wanted, lines, tmp_path):
    """The script is run in a process of its own; without the defect the same script finds nothing."""
    case = state_case("balls", rate=1.0)
    if level == "step":
        case = replace(case, until=0.1, steps=(0.01,))
    elif integrator != "-":
        case = study(engine, integrator, case, 0.25)
    found = disagreement(engine, (wanted,), case, level=level, integrator=integrator, seconds=1.5)
    with defective(lines):
        script, reason = make_script(found, stored_row(engine, level=level))
    assert script, reason
    head = script.replace("\n# ", " ")
    assert "of 1 body" in head, "one body shows it"
    shown = run_alone(script, tmp_path, before=lines)
    stated = re.search(r"off by (\S+) times what is allowed", head)[1]
    assert max(shown) > 1 and max(shown) == pytest.approx(float(stated), rel=0.1)
    assert max(execute(script)[0]) < 1, "without the defect all is right"


FAST_SITES = """import mujoco
real = mujoco.mj_objectVelocity
def fast(m, d, kind, number, found, is_local):
    real(m, d, kind, number, found, is_local)
    found[3:] *= 1.0001
mujoco.mj_objectVelocity = fast
"""
HEAVY_REGRESSOR = """import pinocchio
real = pinocchio.computeJointTorqueRegressor
pinocchio.computeJointTorqueRegressor = lambda *all: 1.0001 * real(*all)
"""
LONG_LINKS = """import exudyn.rigidBodyUtilities as utilities
real = utilities.HTtranslateZ
utilities.HTtranslateZ = lambda z: real(1.0001 * z)
"""
FAR_MIDDLES = """import pinocchio
real = pinocchio.interpolate
pinocchio.interpolate = lambda model, q, then, share: real(model, q, then, 1.0001 * share)
"""
HEAVY_STEP = """import mujoco
real = mujoco.mj_step2
def heavy(m, d):
    d.qfrc_applied += 1e-3
    real(m, d)
mujoco.mj_step2 = heavy
"""
SURFACE_DEFECTS = [  # engine, scenario, quantity, call, the defect; none: one of the engine itself, on record
    ("mujoco", "furuta", "frame_velocity", "mj_objectVelocity, mjtObj.mjOBJ_SITE", FAST_SITES),
    ("pinocchio", "furuta", "inverse_dynamics",
     "computeJointTorqueRegressor, Data.jointTorqueRegressor", HEAVY_REGRESSOR),
    ("exudyn", "furuta", "body_position", "rigidBodyUtilities.HTtranslateZ", LONG_LINKS),
    # one of several parts that a function is called for
    ("pinocchio", "furuta", "frame_position", "interpolate", FAR_MIDDLES),
    ("pinocchio", "universal-pendulum", "frame_acceleration_of_composite_joints",
     "frameJacobianTimeVariation, ReferenceFrame.LOCAL_WORLD_ALIGNED, JointModelComposite", ""),
    ("exudyn-tree", "light-cart-pole", "mass_matrix_by_vectors",
     "kinematicTree.KinematicTree33, kinematicTree.JointTransformMotionSubspace", ""),
    pytest.param("mujoco", "furuta", "acceleration_by_option", "mj_step2", HEAVY_STEP, marks=FULL),
    pytest.param("exudyn", "furuta", "body_velocity_by_tangent_operator", "lieGroupBasics.TExpSE3", "",
                 marks=FULL),
]  # fmt: skip


@pytest.mark.parametrize(
    ("engine", "scenario", "quantity", "call", "lines"),
    SURFACE_DEFECTS,
    ids=lambda value: "" if "\n" in value else value,
)
def test_a_defect_of_the_surface_is_shown_by_the_source_of_its_adapter(
    engine, scenario, quantity, call, lines, tmp_path
):
    """The script is run in a process of its own; without a planted defect the same script finds nothing."""
    s = catalogue_scenario(scenario)
    case = ReproductionCase(s.model, s.state)
    found = disagreement(engine, (quantity,), case, level="surface", call=call, seconds=0.0)
    with defective(lines):
        script, reason = make_script(found, stored_row(engine, level="surface"))
    assert script, reason
    assert not re.search("^(import|from) (plumbline|adapters|reference_impl)", script, re.M)
    assert max(run_alone(script, tmp_path, before=lines)) > 1
    if lines:
        assert max(execute(script)[0]) < 1


# --- shrinking ------------------------------------------------------------------------------------------


def test_the_smallest_chain_on_which_aba_loses_its_digits(tmp_path):
    """A real one: Pinocchio's aba on thirty balls, with simpler numbers, and still disagreeing alone."""
    scenario = catalogue_scenario("chain-30-balls")
    case = ReproductionCase(scenario.model, scenario.state)
    wanted = ("acceleration", "angular_acceleration", "joint_reaction")
    small = disagreement("pinocchio-aba", wanted, case).shrink()
    assert small.case.model.n < 30 and small.ratio >= 10
    assert not small.case.model.has_loads and np.all(small.case.state.omega == 0)
    assert np.all(small.case.model.mass == 1)
    script = script_of(small)
    assert len(script) < len(script_of(StateMeasure(EngineClient("pinocchio-aba"), wanted)(case)))
    assert max(run_alone(script, tmp_path)) >= 5, (
        "rounding differs between script and adapter, next to a bound"
    )
    aba = "pin.aba(model, data, q, v, torque, fext).copy()"
    assert script.count(aba) == 1
    bias = "pin.rnea(model, data, q, v, 0 * v, fext)"
    right, _ = execute(script.replace(aba, f"np.linalg.solve(pin.crba(model, data, q), torque - {bias})"))
    assert max(right) < 1, "the model is the same: crba is right where aba is not"


PLANTED = next(d for d in STATE_DEFECTS if d.name == "inertia-xx-1e-6")


def with_planted_defect():
    engine = plant(PLANTED)
    return patch("plumbline.reproduce.engine_client.load_adapter", lambda _: engine)


def test_a_defect_in_one_number_shrinks_to_one_body():
    found = disagreement(PLANTED.engine, ("acceleration",), state_case("mixed", loads=True, drag=True))
    with with_planted_defect():
        small = found.shrink()
    assert small.case.model.n == 1 and not small.case.model.has_loads and not small.case.model.has_drag
    assert small.case.model.mass.tolist() == [1.0]


def test_a_search_without_time_returns_a_state_as_it_is_and_begins_no_study():
    case = state_case("balls")
    with with_planted_defect():
        small = disagreement(PLANTED.engine, ("acceleration",), case, seconds=0.0).shrink()
    assert small is not None and small.case.model.n == 2
    late = {"level": "trajectory", "integrator": "RK4", "seconds": 0.0}
    found = disagreement("mujoco", ("order",), study("mujoco", "RK4", case, 1.0), **late)
    script, reason = make_script(found, stored_row("mujoco"))
    assert not script and "within 0 s" in reason


def test_studies_begin_with_short_runs_of_few_bodies():
    case = replace(state_case("balls"), until=1.0, steps=(2.0**-7,))
    tried = [(c.until, c.model.n) for c in starting_cases(case)]
    assert tried[0] == (0.0625, 1) and tried[-1] == (1.0, 2)


def test_where_the_engine_agrees_there_is_no_script():
    script, reason = make_script(
        disagreement("mujoco", ("acceleration",), state_case("ball")), stored_row("mujoco")
    )
    assert not script and "agrees" in reason


@pytest.mark.full
def test_the_order_of_an_older_mujoco_is_shown_in_its_environment(tmp_path):
    """A real one: RK4 of 3.12 is of order 2."""
    try:
        python = environments.ensure_interpreter("mujoco@3.12.0")
    except environments.EnvironmentUnavailable as error:
        pytest.skip(str(error))
    case = study("mujoco", "RK4", state_case("balls", rate=1.0), 1.0)
    found = disagreement("mujoco", ("order",), case, level="trajectory", integrator="RK4", seconds=20.0)
    found = replace(found, engine=EngineClient("mujoco", python))
    row = stored_row("mujoco") | {"engine": "mujoco@3.12.0", "engine_version": "3.12.0"}
    script, reason = make_script(found, row)
    assert "'mujoco@3.12.0' '3.12.0'" in script, reason
    assert max(run_alone(script, tmp_path, python=python)) == pytest.approx(20, rel=0.1)
    assert run_alone(script, tmp_path)[0] < 1, "the installed version is of order 4"
