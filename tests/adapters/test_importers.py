"""Importer columns: a pendulum in closed form, agreement of the columns, refusals, losses of the worker."""

import os

import numpy as np
import pytest

from plumbline.engines.environments import EnvironmentUnavailable, importer_interpreter
from plumbline.engines.importer_calls import describe_importer, evaluate_model_file, read_model_file
from plumbline.engines.registry import IMPORTERS
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import CanonicalState
from plumbline.processes.worker_pool import Limits, Task, WorkerPool
from tests.helpers.model_mutations import FOLDER

GRAVITY = 9.81
# Tolerances of these files of one to four bodies are some fifty roundings of numbers of size 1: 1e-14.
MASS, ARM, INERTIA = 2.0, 0.5, 0.375  # of the pendulum files: kg, m, kg m²
CASES = [
    ("pendulum.urdf", "fixed"), ("arm.urdf", "fixed"), ("arm.urdf", "free"),
    ("chain.xml", "fixed"), ("tree.xml", "fixed"), ("turned.xml", "fixed"),
]  # fmt: skip
# Differences from MuJoCo, which defines MJCF: examined by hand; the test fails when one ends.
NO_INERTIA = "an <inertial> element without geometry: other masses or inertias than the file's"
READ_OTHERWISE = {
    ("exudyn", "arm.urdf"): "axes askew turn the link; links on fixed joints lose their mass",
    ("drake", "tree.xml"): "a body with several joints: its pose is applied after the first of them",
    ("pinocchio", "turned.xml"): "the pose of a turned free body moves its world frame",
    ("dart", "turned.xml"): "<freejoint> is not read",
    ("pybullet", "turned.xml"): "<freejoint> is not read",
    ("dart", "pendulum.xml"): NO_INERTIA,
    ("dart", "chain.xml"): NO_INERTIA,
    ("dart", "tree.xml"): NO_INERTIA,
    ("pybullet", "pendulum.xml"): NO_INERTIA,
    ("pybullet", "chain.xml"): NO_INERTIA,
    ("pybullet", "tree.xml"): "joints without a type are not read",
}
REFUSED = {("exudyn", f"{name}.xml") for name in ("pendulum", "chain", "tree", "turned")}  # no MJCF
# Larger than rounding: PyBullet diagonalises inertias to a limited accuracy.
ACCURACY = {"pybullet": 1e-8}


def file_of(name, base="fixed"):
    form = "urdf" if name.endswith(".urdf") else "mjcf"
    return ModelFile(str(FOLDER / name), form, base, str(FOLDER))


@pytest.fixture(scope="module")
def pool():
    with WorkerPool(1) as workers:
        yield workers


def optional_python(importer):
    try:
        return importer_interpreter(importer)
    except EnvironmentUnavailable as error:
        pytest.skip(str(error))


def call(pool, importer, function, *arguments, seconds=60.0):
    """Call in a worker, as the command does: an importer may end its process."""
    limits, python = Limits(seconds=seconds), optional_python(importer)
    (outcome,) = pool.run([Task(0, function, (importer, *arguments), limits, python=python)])
    assert outcome.failure is None, outcome.failure
    return outcome.value


def random_state(model, seed):
    generator = np.random.default_rng(seed)
    coordinates, velocities = [], []
    for joint, _, rates in model.joint_slices():
        turn = generator.normal(size=4)
        turn /= np.linalg.norm(turn)
        coordinates += {
            "free": [*generator.normal(size=3), *turn], "ball": list(turn),
        }.get(joint.kind, [generator.uniform(-1, 1)])  # fmt: skip
        velocities += list(generator.normal(size=rates.stop - rates.start))
    return CanonicalState(np.array(coordinates), np.array(velocities))


@pytest.mark.parametrize("name", ["pendulum.urdf", "pendulum.xml"])
@pytest.mark.parametrize("importer", IMPORTERS)
def test_a_pendulum_has_its_closed_form(pool, importer, name):
    if (importer, name) in REFUSED:
        check_refusal(pool, importer, file_of(name))
    elif (importer, name) in READ_OTHERWISE:
        with pytest.raises(AssertionError):
            check_pendulum(pool, importer, name)
    else:
        check_pendulum(pool, importer, name)


def check_refusal(pool, importer, file):
    reading = call(pool, importer, read_model_file, file)
    assert reading.model is None and reading.refusal


def check_pendulum(pool, importer, name):
    reading = call(pool, importer, read_model_file, file_of(name))
    (joint,) = reading.model.joints
    assert (joint.name, joint.kind) == ("pivot", "hinge")
    angle, rate = 0.7, 1.3
    state = CanonicalState(np.array([angle]), np.array([rate]))
    (found,) = call(pool, importer, evaluate_model_file, file_of(name), [state])
    M, torque = INERTIA + MASS * ARM**2, MASS * GRAVITY * ARM * np.sin(angle)
    expected = {
        "mass_matrix": [[M]], "bias_force": [torque], "gravity_force": [torque], "passive_force": [0.0],
        "acceleration": [-torque / M], "kinetic_energy": M * rate**2 / 2,
        "potential_energy": -MASS * GRAVITY * ARM * np.cos(angle),
    }  # fmt: skip
    for quantity, value in expected.items():
        answer = getattr(found, quantity)
        if answer is not None:
            np.testing.assert_allclose(answer, value, rtol=1e-14, err_msg=quantity)
    c, s = np.cos(angle), np.sin(angle)
    turned = [[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0]]
    np.testing.assert_allclose(found.poses["bob"], turned, atol=1e-15)


@pytest.mark.parametrize("name, base", CASES)
@pytest.mark.parametrize("importer", [name for name in IMPORTERS if name != "mujoco"])
def test_columns_agree_where_files_are_read_alike(pool, importer, name, base):
    if (importer, name) in REFUSED or (importer, base) == ("exudyn", "free"):
        check_refusal(pool, importer, file_of(name, base))
    elif (importer, name) in READ_OTHERWISE:
        with pytest.raises(AssertionError):
            check_agreement(pool, importer, name, base)
    else:
        check_agreement(pool, importer, name, base)


def check_agreement(pool, importer, name, base):
    file = file_of(name, base)
    readings = [call(pool, column, read_model_file, file) for column in ("mujoco", importer)]
    names = [[(joint.name, joint.kind) for joint in reading.model.joints] for reading in readings]
    assert names[0] == names[1]
    states = [random_state(readings[0].model, seed) for seed in range(3)]
    answers = [call(pool, column, evaluate_model_file, file, states) for column in ("mujoco", importer)]
    first, found_first = (column[0] for column in answers)
    for expected, found in zip(*answers, strict=True):
        for quantity in vars(found):
            value, answer = getattr(expected, quantity), getattr(found, quantity)
            if quantity == "poses":
                assert len(answer) >= len(readings[1].model.bodies)
                for body in value.keys() & answer.keys():
                    np.testing.assert_allclose(answer[body], value[body], atol=1e-14, err_msg=body)
            elif answer is not None:
                if quantity == "potential_energy":  # links that are fused with the world may count or not
                    answer, value = answer - found_first.potential_energy, value - first.potential_energy
                tolerance = ACCURACY.get(importer, 1e-13) * (np.max(np.abs(value)) + 1)
                np.testing.assert_allclose(answer, value, atol=tolerance, err_msg=quantity)


@pytest.mark.parametrize("parent", ["base", "bob"])
def test_drake_leaves_the_child_of_a_floating_joint_free_with_a_fixed_base(pool, tmp_path, parent):
    path, more = tmp_path / "floating.urdf", '<link name="ball"/><joint name="f" type="floating">'
    more += f'<parent link="{parent}"/><child link="ball"/></joint></robot>'
    text = (FOLDER / "pendulum.urdf").read_text(encoding="utf-8")
    path.write_text(text.replace("</robot>", more), encoding="utf-8")
    reading = call(pool, "drake", read_model_file, ModelFile(str(path), "urdf", root=str(tmp_path)))
    kinds = {body.name: [joint.kind for joint in body.joints] for body in reading.model.bodies}
    assert kinds == {"base": [], "bob": ["hinge"], "ball": ["free"]}


@pytest.mark.parametrize("importer", IMPORTERS)
@pytest.mark.parametrize("text", ["", "<robot", "\0\1\2"])
def test_a_bad_file_is_refused_in_the_importers_words(pool, tmp_path, importer, text):
    path = tmp_path / "bad.urdf"
    path.write_text(text)
    reading = call(pool, importer, read_model_file, ModelFile(str(path), "urdf", root=str(tmp_path)))
    assert reading.model is None and reading.refusal and reading.version


@pytest.mark.parametrize("importer", IMPORTERS)
def test_an_importer_describes_itself(pool, importer):
    info = call(pool, importer, describe_importer)
    assert info.missing is None and info.version and info.name == importer


def test_an_importer_that_ends_its_process_is_survived(pool, tmp_path):
    python = optional_python("drake")
    path = tmp_path / "limits.urdf"
    text = (FOLDER / "pendulum.urdf").read_text(encoding="utf-8")
    path.write_text(text.replace('lower="-2" upper="2"', 'lower="2" upper="-2"'), encoding="utf-8")
    file = ModelFile(str(path), "urdf", root=str(tmp_path))
    (outcome,) = pool.run([Task(0, read_model_file, ("drake", file), Limits(60.0), python=python)])
    assert outcome.failure is not None and outcome.failure.startswith("SystemExit: Failure at ")
    assert call(pool, "drake", read_model_file, file_of("pendulum.urdf")).model is not None


@pytest.mark.parametrize("importer", ["mujoco", "drake"])
def test_an_importer_that_hangs_is_killed(importer, tmp_path):
    python = optional_python(importer)
    pipe = tmp_path / "pipe.urdf"
    os.mkfifo(pipe)  # nobody writes to it: opening it blocks
    with WorkerPool(1) as own:
        file = ModelFile(str(pipe), "urdf", root=str(tmp_path))
        (outcome,) = own.run([Task(0, read_model_file, (importer, file), Limits(2.0), python=python)])
        assert outcome.failure == "timeout: no answer within 2 s, worker killed"
        task = Task(1, read_model_file, (importer, file_of("arm.urdf")), Limits(60.0), python=python)
        (outcome,) = own.run([task])
        assert outcome.value.model is not None
