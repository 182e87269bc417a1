"""Reproduction scripts in tests: cases to render, scripts to run, and engines with a planted defect."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.rows import RowContext
from plumbline.measurements.relation_result import OPTION_PREFIX, OTHER_FORMULATION_PREFIX
from plumbline.measurements.state_relations import QUANTITIES, STATE_RELATIONS, WELDED_HALVES
from plumbline.model.step_methods import JointSpaceMethod
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.measure import ConvergenceMeasure, RelationMeasure, StateMeasure, StepMeasure
from plumbline.reproduce.render import no_script_reason, render_script
from plumbline.reproduce.shrink import ReproductionCase
from tests.helpers import pendulums

HOSTILE = '<img src=x onerror="alert(1)">\n"""\nimport os; os.abort()  # \\ \'\'\' \r ; # ünï'
DRIFTS = ("energy_drift", "momentum_drift", "joint_gap", "gap_rate", "norm_drift")
# Of chains of rods and balls, whose joints carry no moment.
ALL_QUANTITIES = (*(name for name in QUANTITIES if name != "joint_moment"), "mass_matrix")
ENGINES = ("mujoco", "pinocchio", "pinocchio-aba", "pinocchio-maximal", "exudyn", "exudyn-tree")


def stored_row(engine: str, **more):
    """A stored row about an engine of this environment; its texts are hostile."""
    row = {"scenario": HOSTILE, "quantity": HOSTILE, "integrator": HOSTILE, "extra": {"state": 3.0}}
    return row | {"engine": engine, "engine_version": load_adapter(engine).version()} | more


def script_of(evidence, **row) -> str:
    """The script that shows evidence, as `write_scripts` makes it; ``row`` are fields of the stored row."""
    system = evidence.written(EngineClient(evidence.engine))
    return render_script(stored_row(evidence.engine, **row), evidence, system)


def state_case(joints: str, loads: bool = False, drag: bool = False, rate: float = 3.0) -> ReproductionCase:
    model = pendulums.make_model(joints, loads=loads, drag=drag)
    return ReproductionCase(model, pendulums.state_from_seed(model, seed=3, rate=rate))


def state_evidence(engine: str, case: ReproductionCase):
    found = StateMeasure(EngineClient(engine), ALL_QUANTITIES)(case)
    assert found is not None
    return found


def relation_evidence(engine: str, relation: str, case: ReproductionCase):
    found = RelationMeasure(EngineClient(engine), relation)(case)
    assert found is not None
    return found


def other_answer(engine: str, relation: str, case: ReproductionCase):
    """Evidence about the second answer of a relation, right or wrong."""
    measure = RelationMeasure(EngineClient(engine), relation)
    _, found = measure.answers(case)
    assert found is not None
    return replace(found, relation=relation)


def motion_measure(engine: str, integrator: str, level: str, joints: str, loaded: bool, until: float):
    """A measure of a slow tumble at three steps, and its case."""
    case = state_case(joints, loaded, loaded, rate=1.0)
    case = ReproductionCase(case.model, case.state, until, tuple(2.0**-k for k in (6, 7, 8)))
    wanted = DRIFTS if level == "invariants" else ("order", "position_limit", "attitude_limit")
    return ConvergenceMeasure(EngineClient(engine), integrator, level, wanted), case


def step_integrators(engine: str) -> list[str]:
    return [i.name for i in load_adapter(engine).integrators if i.kind == "step" and i.has_motions]


def step_methods(engine: str) -> list[str]:
    """Integrators with a formula in joint coordinates, which a script can show."""
    return [i.name for i in load_adapter(engine).integrators if isinstance(i.method, JointSpaceMethod)]


def step_evidence(engine: str, integrator: str, case: ReproductionCase, count: int = 1, h: float = 0.0237):
    found = StepMeasure(EngineClient(engine), integrator)(replace(case, until=count * h, steps=(h,)))
    assert found is not None
    return found


def second_ways(engine: str) -> list[str]:
    """Relations in which the engine itself is set to a second way, and of which it has scripts."""
    hooks = metamorphic_hooks(load_adapter(engine))
    found = [OPTION_PREFIX + option for option in hooks.options if engine != "pinocchio-maximal"]
    found += [OTHER_FORMULATION_PREFIX + hooks.other_formulation] if hooks.other_formulation else []
    found += [] if hooks.welding_unsupported_reason else [WELDED_HALVES]
    row = {"level": "relations", "integrator": "-"}
    return [name for name in found if not no_script_reason(engine, row | {"quantity": name})]


def every_evidence(engine: str, joints: str, loaded: bool):
    """Evidence of every kind of script of an engine."""
    case = state_case(joints, loaded, loaded)
    yield state_evidence(engine, case)
    hooks = metamorphic_hooks(load_adapter(engine))
    of_joints = [OPTION_PREFIX + way for way in hooks.options_for(case.model) if way in hooks.joint_options]
    for relation in (STATE_RELATIONS[0].name, *second_ways(engine), *of_joints):
        yield relation_evidence(engine, relation, case)
        yield other_answer(engine, relation, case)
    for integrator in step_methods(engine):
        yield step_evidence(engine, integrator, case)
    for integrator in step_integrators(engine):
        for level in ("trajectory", "invariants"):
            measure, study = motion_measure(engine, integrator, level, joints, loaded, 0.25)
            yield measure(study)


def ratios(printed: str) -> list[float]:
    return [float(x) for x in re.findall(r"^  off by (\S+) times", printed, re.M)]


def execute(script: str) -> tuple[list[float], dict]:
    """Run a script in this process; its ratios and its names."""
    names = {"__name__": "__main__"}
    with redirect_stdout(StringIO()) as printed:
        try:
            exec(compile(script, "script", "exec"), names)
        except SystemExit as end:
            assert end.code == (max(ratios(printed.getvalue())) > 1), "exit status"
    return ratios(printed.getvalue()), names


def check_script(evidence, factor: float) -> list[float]:
    """The ratios of a script: none above 1, and all where what it expects is multiplied by the factor."""
    found, _ = execute(script_of(evidence))
    assert max(found) < 1, found
    wrong = replace(evidence, expected={q: x * factor for q, x in evidence.expected.items()})
    assert min(execute(script_of(wrong))[0]) > 1, "a wrong answer would not be noticed"
    return found


def measured_drifts(measure: ConvergenceMeasure, case: ReproductionCase):
    """Evidence about drifts, the names of its script, whose ratios are below 1, and the harness's drifts."""
    evidence = measure(case)
    found, names = execute(script_of(evidence))
    assert len(found) == len(evidence.drifts) and max(found) < 1
    truth, runs = measure.run(case, measure.sample_times(case))
    context = RowContext("", "", "", "", "")
    analysis = RefinementAnalysis(context, case.model, truth, measure.integrator, runs, case.until)
    return evidence, names, analysis.invariant_drifts


def run_alone(script: str, folder: Path, before: str = "", python: str = sys.executable) -> list[float]:
    """Run a script in a process of its own, without this project; ``before`` is executed first."""
    path = folder / "script.py"
    path.write_text(script, encoding="utf-8")
    code = f"{before}\nimport runpy\nrunpy.run_path({str(path)!r}, run_name='__main__')"
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [python, "-P", "-c", code] if before else [python, "-P", path],
        cwd=folder, capture_output=True, text=True, timeout=120, encoding="utf-8",
        env={**environment, "PYTHONIOENCODING": "utf-8", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    found = ratios(done.stdout)
    assert found and done.returncode == (max(found) > 1), done.stderr
    return found


@contextmanager
def defective(lines: str):
    """The engines' modules after these lines; as they were afterwards."""
    import exudyn
    import exudyn.itemInterface
    import exudyn.rigidBodyUtilities
    import mujoco
    import pinocchio

    places = (exudyn, exudyn.itemInterface, exudyn.rigidBodyUtilities, mujoco, pinocchio)
    before = [dict(vars(place)) for place in places]
    try:
        exec(lines, {})
        yield
    finally:
        for place, names in zip(places, before, strict=True):
            for name, value in names.items():
                if vars(place).get(name) is not value:
                    setattr(place, name, value)
