"""Other versions of an engine: names, the other environment's process, and what is supported."""

import ctypes
import importlib
import operator
import os
import re
import sys
import time
import zipfile
from dataclasses import replace
from importlib import metadata

import numpy as np
import psutil
import pytest
from packaging.version import Version

from plumbline.engines import engine_calls, environments
from plumbline.engines.registry import ENGINES
from plumbline.judging import known_issues
from plumbline.judging.rows import WRONG_CALL, RowContext
from plumbline.processes.remote_python import call_fresh, call_remote
from plumbline.processes.worker_pool import Limits, Task, WorkerPool
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.commands import invoke
from tests.helpers.exudyn_initial_accelerations import initial_accelerations
from tests.helpers.requirements import needs_uv, refuse_packages, require_package_index
from tests.helpers.runs import run_scenarios

PYTHON = (
    sys.executable
)  # the installed environment stands for another one: the way there and back is the same


def quiet(*_):
    pass


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mujoco", None),
        ("mujoco@3.12.0", None),
        ("mujoco@4.0.0rc1", None),
        ("pinocchio-aba@latest", None),
        ("exudyn@pre", None),
        ("mujoco@", "is not a version"),
        ("mujoco@newest", "is not a version"),
        ("mujoco@" + 5000 * "9", "is not a version"),
        ("mujoco@mujoco-9.9-py3-none-any.whl", "there is no file"),
        ("mujoco@elsewhere/absent-1.0-py3-none-any.whl", "is a wheel of absent, not of mujoco"),
        ("pinocchio-aba@pinocchio-4.0-py3-none-any.whl", "is a wheel of pinocchio, not of pin"),
        ("mujoco@some.whl", "Invalid wheel filename"),
    ],
)
def test_the_version_part_of_a_name(name, words):
    found = environments.version_problem(name)
    assert found is None if words is None else words in found


@pytest.mark.parametrize("engine", [e for e in ENGINES if e != "reference"])
def test_what_an_adapter_declares_is_read_without_importing_it(engine):
    from plumbline.engines.registry import load_adapter

    found = load_adapter(engine)
    assert environments.declared_attribute(engine, "package") == found.package
    for name in ("extra_requirements", "other_formulation", "reproduction_template"):
        assert environments.declared_attribute(engine, name) == getattr(found, name)
    assert engine_calls.describe_engine(engine).missing is None, (
        "the installed version is in the declared range"
    )


def test_a_version_out_of_range_is_reported(monkeypatch):
    from adapters.mujoco_engine import Mujoco

    monkeypatch.setattr(Mujoco, "supported_versions", "<1")
    assert "supports versions <1 of mujoco, this is" in engine_calls.describe_engine("mujoco").missing


def test_known_entries_hold_for_an_engine_in_any_version_of_their_range():
    entry = known_issues.KnownIssue(
        id="a", scenario="*", engine="mujoco", versions="<4", verdict="disagrees", evidence="e", reason="r"
    )
    row = RowContext("s", "f", "mujoco@3.12.0", "MuJoCo", "3.12.0").make_row(
        "trajectory", "RK4", "order", "disagrees", ""
    )
    about = known_issues.KnownIssues([entry], has_extra_refinements=False).issues_for
    assert about(row) and not about(replace(row, engine_version="4.0.0"))
    assert not about(replace(row, engine="mujocox"))


# --- the other environment's process -----------------------------------------------------------


def remote_task(key, call, *arguments, limits=None):
    return Task(key, call, arguments, limits or Limits(30, 4), python=PYTHON)


def test_losses_in_another_environment_are_reported_like_local_ones():
    tasks = [
        remote_task("a", operator.mul, 1, 2), remote_task("pid", os.getpid),
        remote_task("noise", print, "x" * 100_000),
        remote_task("segfault", ctypes.string_at, 0), remote_task("b", operator.mul, 2, 2),
        remote_task("devour", bytearray, 64 * 2**30),
        remote_task("complain", operator.getitem, {}, "no"),
        remote_task("hang", time.sleep, 600, limits=Limits(3, 4)),
        remote_task("c", operator.mul, 3, 2), remote_task("pid2", os.getpid),
    ]  # fmt: skip
    with WorkerPool(1, Limits(30, 4)) as workers:
        found = {o.key: o for o in workers.run(tasks)}
    lost = {key: o.failure for key, o in found.items() if o.failure}
    assert lost.pop("segfault") == "crashed: the worker died of SIGSEGV"
    assert lost.pop("complain") == "KeyError: 'no'"
    assert "out of memory" in lost.pop("devour")
    assert "timeout" in lost.pop("hang")
    assert not lost
    assert [found[key].value for key in "abc"] == [2, 4, 6]
    alive = [psutil.Process(p) for p in (found["pid"].value, found["pid2"].value) if psutil.pid_exists(p)]
    assert not psutil.wait_procs(alive, timeout=10)[1], "a child outlived its worker"


def test_an_engine_gives_the_same_answer_in_another_environment():
    s = catalogue_scenario("double-tumbling-balls")
    with WorkerPool(1) as workers:
        here, away = (
            o.value.quantities[0]
            for python in ("", PYTHON)
            for o in workers.run(
                [Task("k", engine_calls.evaluate_states, ("mujoco", s.model, [s.state]), python=python)]
            )
        )
    assert np.array_equal(here.acceleration, away.acceleration)
    assert np.array_equal(here.mass_matrix, away.mass_matrix)


LATER_NAMES = {  # of an engine's module, which adapters use and the oldest version that they take lacks
    "mujoco": (
        "MjSpec.attach MjsBody.joints mj_copyData mj_copyState mj_extractState mjtCtrlInput mjtMeshInertia "
        "mjtSameFrame mjtSleepPolicy"
    ),
    "pinocchio": (
        "ConstraintCholeskyDecomposition ConstraintModel ContactType Convention FrameAnchorConstraintModel "
        "Inertia.FromPseudoInertia JointModelHelicalUnaligned JointModelUniversal ModelPool ProximalSettings "
        "PointAnchorConstraintModel PseudoInertia RigidConstraintModel StdVec_ConstraintData Symmetric3 "
        "StdVec_ConstraintModel StdVec_RigidConstraintData StdVec_RigidConstraintModel abaInParallel "
        "buildModelFromMJCF classicAcceleration compactTangentMap computeConstraintDynamicsDerivatives "
        "computeJointKinematicHessians computeKineticEnergyRegressor computeMechanicalEnergy "
        "computePotentialEnergyRegressor constraintDynamics convertToRigidConstraintModel lieGroup "
        "getConstraintJacobian getConstraintsJacobian getPointClassicAccelerationDerivatives "
        "getPointVelocityDerivatives getTangentToConfigurationSparsitySegment initConstraintDynamics "
        "rneaInParallel tangentMap tangentMapProduct tangentMapTransposeProduct transformJointIntoMimic"
    ),
    "exudyn": "ComputeItemType MainSystem.CreateCoordinateConstraint config graphics",
}


def acceleration_without(engine, names, column, model, state):
    """Evaluate a state in a process where these names of the engine's module are missing."""
    module = importlib.import_module(engine)
    for name in names.split():
        owner, _, last = name.rpartition(".")
        delattr(getattr(module, owner) if owner else module, last)
        if f"{engine}.{name}" in sys.modules:
            sys.modules[f"{engine}.{name}"] = None  # or it would be imported again
    found = engine_calls.evaluate_states(column, model, [state], [])
    assert not found.no_answer, found.no_answer.message
    return found.quantities[0].acceleration


@pytest.mark.parametrize(
    ("engine", "column", "scenario"),
    [("mujoco", "mujoco", "helical-screw"), ("pinocchio", "pinocchio", "tumbling-ball"),
     ("pinocchio", "pinocchio-aba", "tumbling-ball"), ("exudyn", "exudyn", "tumbling-ball"),
     ("exudyn", "exudyn-tree", "tumbling-ball")],
)  # fmt: skip
def test_columns_load_without_the_names_of_later_versions(engine, column, scenario):
    s = catalogue_scenario(scenario)
    asked = engine, LATER_NAMES[engine], column, s.model, s.state
    found = call_fresh(PYTHON, acceleration_without, *asked)
    off = np.linalg.norm(found - certify_state(s.model, s.state).quantities.acceleration, axis=1)
    assert np.all(off <= state_rounding_bound(s.model, s.state).acceleration)


# --- real versions: fetched once, then from the cache ------------------------------------------

OLDER_VERSIONS = [
    "mujoco@3.2.0", "mujoco@3.3.0", "mujoco@3.12.0", "pinocchio@3.3.1", "pinocchio@3.9.0", "pinocchio@4.0.0",
    "pinocchio-aba@3.3.1", "pinocchio-maximal@3.9.0", "exudyn@1.9.0", "exudyn@1.10.0", "exudyn@1.11.0",
    "exudyn-tree@1.9.0",
]  # fmt: skip
FULL_INERTIA = "MjsBody, mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE"  # its axes to 1e-9 before 4.0


@pytest.mark.full
@pytest.mark.timeout(1800)
def test_the_supported_versions_work_beside_the_installed_ones(tmp_path):
    result = run_scenarios(["tumbling-ball", "tumbling-rod"], ["mujoco", *OLDER_VERSIONS], limits=Limits(600))
    for name in OLDER_VERSIONS:
        assert result.engines[name].missing is None
        assert Version(result.engines[name].version) == Version(name.partition("@")[2])
    wrong = [r for r in result.rows if r.verdict in ("disagrees", "failed") and r.known_issue is None]
    found = {}
    for r in wrong:
        what = r.integrator if r.level in ("step", "trajectory") else str(r.extra.get(WRONG_CALL, r.quantity))
        found.setdefault(r.engine, set()).add((r.level, what))
    of_rk4 = {("step", "RK4"), ("trajectory", "RK4")}  # of order 2 before 4.0
    of_names = {("surface", "MjData.jnt"), ("surface", FULL_INERTIA)}
    clamped = "mj_implicit, mjtIntegrator.mjINT_IMPLICIT, mjtBias.mjBIAS_AFFINE"
    sparse = {("relations", "by EXUdense"), ("relations", "by EigenDense")}  # its sparse start before 1.11
    sparse |= {("step", "trapezoidal"), ("step", "generalized-alpha")}
    no_rates = {("surface", "itemInterface.NodeRigidBodyRotVecLG"), ("surface", "all")}  # add equations
    lie_group = "GeneralizedAlphaSettings.lieGroup"
    turned = {("surface", f"{lie_group}SimplifiedKinematicRelations, {lie_group}AddTangentOperator")}
    assert found == {
        "mujoco@3.2.0": of_rk4 | {("surface", "MjModel"), ("surface", "MjSpec"), ("relations", "root moved")},
        "mujoco@3.3.0": of_rk4
        | of_names
        | {
            ("surface", "mj_jacDot"),
            ("surface", f"{clamped}, mjtTrn.mjTRN_TENDON"),
            ("relations", "root moved"),
        },
        "mujoco@3.12.0": of_rk4
        | of_names
        | {
            ("surface", f"{clamped}, mjtObj.mjOBJ_TENDON"),
            ("surface", "mj_objectAcceleration, mjtObj.mjOBJ_SITE"),
        },
        "pinocchio@3.3.1": {
            ("surface", "appendModel, FrameType.BODY"),
            ("surface", "buildReducedModel, Model.addJointFrame"),
            ("surface", "Model"),
        },
        "pinocchio@3.9.0": {("surface", "Model")},  # stored with infinite limits
        "pinocchio@4.0.0": {("surface", "Model")},
        "exudyn@1.9.0": sparse | no_rates,
        "exudyn@1.10.0": sparse | no_rates | turned,
        "exudyn@1.11.0": no_rates,
    }
    orders = [r.order for r in wrong if (r.level, r.integrator, r.quantity) == ("trajectory", "RK4", "order")]
    assert len(orders) == 6 and all(1.9 < order < 2.1 for order in orders)


@pytest.mark.full
@pytest.mark.timeout(600)
def test_state_quantities_of_the_oldest_versions_agree():
    oldest = ["mujoco@3.2.0", "pinocchio@2.6.21", "pinocchio-aba@2.6.21", "exudyn@1.7.0", "exudyn-tree@1.7.0"]
    names = ["tumbling-ball", "furuta", "double-tumbling-rods", "helical-screw"]
    result = run_scenarios(names, oldest, "state", limits=Limits(600))
    for name in oldest:
        assert result.engines[name].missing is None
        agree = [r for r in result.rows if (r.engine, r.level, r.verdict) == (name, "state", "agrees")]
        assert len(agree) >= 10, name
    assert not [r.key for r in result.rows if r.level == "state" and r.verdict in ("disagrees", "failed")]
    assert [r for r in result.rows if (r.engine, r.scenario, r.verdict) == (oldest[0], names[-1], "agrees")]
    failed = "; ".join(r.reason for r in result.rows if r.verdict == "failed")
    # by arguments and types that these versions do not have
    assert not re.search("bodyNumbers|started bodies|body forces", failed)


# What the engines' changelogs say to be mended since: scenario, version before, words of the call, rows.
TENDON_SPRING = "mjtWrap.mjWRAP_JOINT, mjtTendon, mjtObj.mjOBJ_TENDON"
MOTION = ("acceleration", "angular_acceleration")
FORCES = ("joint_reaction", "joint_moment")
BODIES = ("kinetic_energy", "potential_energy", "angular_momentum", "mass_matrix")


def by(kind, *names):
    return [f"{name}_by_{kind}" for name in names]


MENDED = [
    ("sprung-universal", "mujoco@3.2.6", "by mj_mulM2", ["kinetic_energy"]),
    ("sprung-universal", "mujoco@3.3.0", "by mj_jacDot", ["frame_acceleration"]),
    ("sprung-universal", "mujoco@3.3.3", TENDON_SPRING, by("spelling", *MOTION, *FORCES)),
    ("hand-on-welds", "mujoco@3.4.0", "by MjsBody, MjData.qfrc_gravcomp", by("spelling", *MOTION)),
    ("sprung-universal", "mujoco@3.4.0", "mjtBias.mjBIAS_AFFINE, mjtTrn.mjTRN_TENDON", ["inverse_dynamics"]),
    ("sprung-universal", "mujoco@3.17.0", "mjtBias.mjBIAS_AFFINE, mjtObj.mjOBJ_TENDON", ["inverse_dynamics"]),
    ("sprung-universal", "mujoco@3.17.0", "mjtSensor.mjSENS_ACCELEROMETER", ["frame_acceleration"]),
    ("sprung-hinge", "mujoco@3.4.0", "mjtGain.mjGAIN_AFFINE, mjtDyn.mjDYN_INTEGRATOR", ["inverse_dynamics"]),
    ("sprung-hinge", "mujoco@3.17.0", "mjtBias.mjBIAS_AFFINE, mjtTrn.mjTRN_JOINT", ["inverse_dynamics"]),
    ("sprung-hinge", "mujoco@3.17.0", "mj_energyPos, mjtSleepPolicy", ["potential_energy"]),
    ("tumbling-ball", "pinocchio@4.0.0", "by Model: RuntimeError", ["all_by_option"]),
    ("tumbling-ball", "pinocchio@2.7.0", "getFrameJacobian", ["frame_acceleration_by_jacobian_rate"]),
    ("tumbling-ball", "pinocchio@2.7.0", "appendModel, FrameType.BODY",
     by("spelling", "joint_reaction", *BODIES)),
    ("helical-screw", "pinocchio@3.7.0", "buildReducedModel",
     by("option", *MOTION, *FORCES, "kinetic_energy", "mass_matrix")),
    ("helical-screw", "pinocchio@3.7.0", "add mimic momenta: crashed", ["all"]),
    ("helical-screw", "pinocchio@3.8.0", "appendModel, FrameType.BODY",
     by("spelling", *MOTION, *FORCES, *BODIES)),
    ("tumbling-ball", "exudyn@1.8.0", "the frame axes by MainSystem.CreateRigidBody", ["frame_axes"]),
    ("sprung-hinge", "exudyn@1.10.0", "MainSystem.CreateTorsionalSpringDamper", ["all_by_spelling"]),
    ("tree-of-seven", "exudyn-tree@1.11.0", "",
     [*MOTION, *by("option", *MOTION), *by("spelling", *MOTION)]),
]  # fmt: skip


@pytest.mark.full
@pytest.mark.timeout(1800)
def test_defects_of_older_versions_are_reported_by_quantity_and_call():
    """Each row that a defect names is there and names the call; the installed version has none that does."""
    reasons: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for scenario in sorted({one[0] for one in MENDED}):
        names = sorted({one[1] for one in MENDED if one[0] == scenario})
        sound = sorted({name.partition("@")[0] for name in names})
        result = run_scenarios([scenario], [*sound, *names], "state", limits=Limits(600))
        for r in result.rows:
            if r.verdict in ("disagrees", "failed"):
                reasons.setdefault((scenario, r.engine), []).append((r.quantity, r.reason))
    for scenario, engine, words, quantities in MENDED:
        told = {quantity for quantity, reason in reasons[scenario, engine] if words in reason}
        assert told >= set(quantities), (scenario, engine, words)
        since = reasons.get((scenario, engine.partition("@")[0]), [])
        assert not [quantity for quantity, reason in since if words in reason], (scenario, engine, words)


@pytest.mark.full
@pytest.mark.timeout(900)
def test_each_cause_in_loops_of_older_versions_is_one_finding_with_its_versions():
    """On rods, in whose coordinates the velocity terms are missing, and in a loop with redundant rows."""
    result = run_scenarios(
        ["bricard", "flyball-governor"], ["mujoco@3.6.0", "mujoco@3.13.0"], "state", limits=Limits(600)
    )
    found = {f.title: (f.version_range, f.scenarios) for f in result.findings if f.verdict == "disagrees"}
    assert found == {
        "joint forces with the moments of the welds in cut bodies doubled and in body axes": (
            "3.6.0 to 3.13.0", ["flyball-governor", "bricard"],
        ),
        "velocity terms of the rows that close loops missing": (
            "3.6.0 (not 3.13.0)", ["flyball-governor", "bricard"],
        ),
    }  # fmt: skip


@pytest.mark.full
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("version", "sound"), [("1.9.0", False), ("1.10.0", False), ("1.11.0", True)])
def test_exudyn_started_from_wrong_accelerations_with_its_sparse_solver(version, sound):
    """The relation says that two solvers of one engine differ; this shows which is wrong, and where."""
    chosen = catalogue_scenario("double-tumbling-balls")
    true = certify_state(chosen.model, chosen.state).quantities.acceleration
    python = environments.ensure_interpreter(f"exudyn@{version}")
    off = {
        solver: np.max(
            np.abs(call_remote(python, initial_accelerations, chosen.model, chosen.state, solver) - true)
        )
        for solver in ("EigenSparse", "EXUdense", "EigenDense")
    }
    assert max(off["EXUdense"], off["EigenDense"]) < 1e-4, "m/s²; by finite differences"
    assert off["EigenSparse"] < 1e-4 if sound else off["EigenSparse"] > 0.1


@pytest.mark.full
@pytest.mark.timeout(900)
def test_a_version_that_cannot_be_had_is_a_verdict():
    result = run_scenarios(["rest"], ["mujoco@99.0.0", "mujoco@3.1.6"], "state")
    absent, refused = result.rows
    assert absent.verdict == "failed" and "99.0.0" in absent.reason
    assert refused.verdict == "unsupported" and "supports versions >=3.2" in refused.reason


# --- what is no version, no wheel, or cannot be fetched ------------------------------------------


def build_wheel(folder, package="mujoco"):
    """The installed distribution packed again as the wheel that it came from."""
    found = metadata.distribution(package)
    (tag,) = [line[5:] for line in found.read_text("WHEEL").splitlines() if line.startswith("Tag: ")][:1]
    path = folder / f"{package}-{found.version}-{tag}.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for file in found.files or ():
            if ".." not in file.parts and "__pycache__" not in file.parts:
                archive.write(found.locate_file(file), file.as_posix())
    return path


def test_a_file_that_is_no_wheel_is_bad_usage(tmp_path):
    path = tmp_path / "mujoco-4.0.0-py3-none-any.whl"
    path.write_text("no zip")
    assert "is not a wheel: it is no zip file" in environments.version_problem(f"mujoco@{path}")
    done = invoke("run", "rest", "--engine", f"exudyn@{path}", code=2)
    assert "is a wheel of mujoco, not of exudyn" in " ".join(done.stderr.split())


def test_without_uv_the_reason_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(environments, "ROOT", tmp_path)
    monkeypatch.setattr("sys.prefix", str(tmp_path / ".venv"))
    with pytest.raises(environments.EnvironmentUnavailable, match="uv is not on PATH; install it"):
        environments.newest_requirement("packaging", pre=False)


@pytest.mark.parametrize("place", ["checkout", "environment"])
def test_the_uv_that_make_installed_is_found(tmp_path, monkeypatch, place):
    """In the checkout, or beside the environment that a second checkout has a link to."""
    checkout, other = tmp_path / "checkout", tmp_path / "other"
    for folder in (checkout, other / ".venv"):
        folder.mkdir(parents=True)
    (checkout / ".venv").symlink_to(other / ".venv")
    program = (checkout if place == "checkout" else other) / ".uv" / "bin" / "uv"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\necho packaging==1.2.3\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(environments, "ROOT", checkout)
    monkeypatch.setattr("sys.prefix", str(checkout / ".venv"))
    assert environments.newest_requirement("packaging", pre=False) == "packaging==1.2.3"


@needs_uv
@pytest.mark.parametrize("version", ["9.9.9", "latest"])
def test_an_index_that_does_not_answer_is_reported(tmp_path, monkeypatch, version):
    refuse_packages(monkeypatch, tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    result = run_scenarios(["rest"], [f"mujoco@{version}"], "state")
    (row,) = result.rows
    assert row.verdict == "failed" and result.metadata["exit_code"] == 3
    assert "uv cannot make an environment" in row.reason and "http://127.0.0.1:9/simple/mujoco" in row.reason
    assert not list((tmp_path / "plumbline").rglob("*.py")), "half an environment is left"


@pytest.mark.full
@needs_uv
@pytest.mark.timeout(1800)
def test_latest_pre_and_a_wheel_run_beside_the_installed_one(tmp_path):
    require_package_index()
    names = ["mujoco", "mujoco@latest", "mujoco@pre", f"mujoco@{build_wheel(tmp_path)}"]
    result = run_scenarios(["tumbling-ball"], names, "state", limits=Limits(600))
    found = {name: result.engines[name] for name in names}
    assert [info.missing for info in found.values()] == [None] * 4
    latest, newest = (Version(found[f"mujoco@{which}"].version) for which in ("latest", "pre"))
    assert not latest.is_prerelease and newest >= latest >= Version("4.0.0")
    assert found[names[3]].version == found["mujoco"].version
    values = {name: [row.value for row in result.rows if row.engine == name] for name in ("mujoco", names[3])}
    assert values["mujoco"] == values[names[3]], "the same wheel gives the same answer"
    assert {row.verdict for row in result.rows} == {"agrees"}


@pytest.mark.full
@needs_uv
@pytest.mark.timeout(900)
def test_an_empty_wheel_is_reported(tmp_path):
    require_package_index()
    path = tmp_path / "mujoco-4.0.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mujoco/__init__.py", "")
    result = run_scenarios(["rest"], [f"mujoco@{path}"], "state")
    (row,) = result.rows
    assert row.verdict == "failed" and "uv cannot make an environment" in row.reason


def test_a_bad_version_is_bad_usage():
    done = invoke("run", "rest", "--engine", "mujoco@three", code=2)
    assert "'three' is not a version" in done.stderr


def test_importers_of_the_main_environment_and_of_their_own(monkeypatch, tmp_path):
    assert environments.importer_interpreter("mujoco") == ""
    monkeypatch.setattr(environments, "ROOT", tmp_path)
    monkeypatch.setattr(environments, "_read_attribute", lambda module, name, attribute: ".importers")
    with pytest.raises(environments.EnvironmentUnavailable, match="make importers"):
        environments.importer_interpreter("drake")


def test_environments_of_importers_have_what_the_core_imports_in_their_workers():
    """`make importers` installs these locks; without one of the packages every call of an importer fails."""
    for group in ("importers", "exudyn-importer"):
        lock = (environments.ROOT / "locks" / f"{group}.lock").read_text(encoding="utf-8")
        locked = set(re.findall(r"^([\w-]+)==", lock, re.M))
        assert locked.issuperset(environments.BASE_REQUIREMENTS), group
