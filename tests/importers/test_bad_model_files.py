"""Bad model files: clear errors with file and line, no entity, no file outside the root, no hang."""

import time

import numpy as np
import pytest

from plumbline.importers.xml_tree import ModelFileError, parse_xml, write_xml, write_xml_in_place
from plumbline.model_files.prepared_file import prepare_file
from tests.helpers.random_robots import random_mjcf, random_urdf
from tests.helpers.refusals import refusal
from tests.helpers.tables import table

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
LINKS = f'<link name="a">{INERTIAL}</link>\n<link name="b">{INERTIAL}</link>\n'
JOINT = '<joint name="j" type="revolute"><parent link="a"/><child link="b"/></joint>'


def robot(old="", new="", more=""):
    """The robot of two links and a joint with the first occurrence of a text replaced."""
    return f"<robot>{LINKS}{JOINT}{more}</robot>".replace(old, new, 1)


BAD_FILES = {  # content, and what the message must contain
    "too deep": ["<robot>" + "<a>" * 1000 + "</a>" * 1000 + "</robot>", "nested more than 500 deep"],
    **table(__file__),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_gets_a_clear_error_with_its_line(tmp_path, name):
    content, message = BAD_FILES[name]
    path = tmp_path / "robot.xml"
    path.write_text(content)
    error = refusal(prepare_file, str(path), tmp_path)
    assert isinstance(error, ModelFileError) and message in str(error)
    assert all(str(problem).startswith(f"{path}:") for problem in error.problems), error
    assert all(f"{path}:1:1:" not in problem.message for problem in error.problems), error


MAIN = """<mujoco><asset><model name="c" file="parts/child.xml"/></asset><worldbody><body name="b">
<joint name="j"/><geom size=".1"/><attach model="c" body="k" prefix="p_"/></body></worldbody></mujoco>"""
CHILD = '<mujoco>{}<worldbody><body name="k"><joint/><geom size=".1"/></body></worldbody></mujoco>'
OUTSIDE = {  # what the model of an asset reads, and words of the problem
    "include": [
        '\n<include file="../../outside.xml"/>',
        "child.xml:2:1: <include> file: '../../outside.xml' is",
    ],
    "mesh": [
        '<asset><mesh file="../../outside.stl"/></asset>',
        "child.xml:1:16: <mesh> file: '../../outside.stl'",
    ],
    "model": [
        '<asset><model file="../../outside.xml"/></asset>',
        "child.xml:1:16: <model> file: '../../outside.xml'",
    ],
    "its own": ['<asset><model file="child.xml"/><mesh file="no.stl"/></asset>', "there is no file 'no.stl'"],
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_models_of_assets_read_no_file_outside_of_the_root(tmp_path, name):
    more, message = OUTSIDE[name]
    path, scratch = tmp_path / "robot" / "main.xml", tmp_path / "scratch"
    for folder in (scratch, path.parent / "parts"):
        folder.mkdir(parents=True)
    path.write_text(MAIN)
    (path.parent / "parts" / "child.xml").write_text(CHILD.format(more))
    (tmp_path / "outside.xml").write_text(CHILD.format(""))
    (tmp_path / "outside.stl").write_text("solid\nendsolid\n")
    assert message in str(refusal(prepare_file, str(path), scratch))
    (path.parent / "parts" / "child.xml").write_text(CHILD.format('<asset><model file="child.xml"/></asset>'))
    assert prepare_file(str(path), scratch).file.path == str(path)


def test_every_mistake_of_a_file_is_listed(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(f"<robot>{LINKS}{JOINT}</robot>".replace('value="1"', 'value="-1"').replace("ixx", "IXX"))
    assert len(refusal(prepare_file, str(path), tmp_path).problems) == 4


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<parent link="a"/>', '<parent link="c"/>'),
        ('joint name="j"', "joint"),
        ("</robot>", '<link name="c"/>' + JOINT.replace('link="b"', 'link="c"') + "</robot>"),
    ],
)
def test_links_of_a_joint_with_a_mistake_are_no_roots(tmp_path, old, new):
    path = tmp_path / "robot.urdf"
    path.write_text(robot(old, new))
    problems = refusal(prepare_file, str(path), tmp_path).problems
    assert problems and not any("no joint's child" in problem.message for problem in problems)


def test_a_free_root_is_not_the_world(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(robot().replace('"a"', '"world"'))
    assert prepare_file(str(path), tmp_path, base="fixed").urdf_model.bodies[0].name == "world"
    message = "robot.urdf:1:8: <link name='world'> name: is the root link: importers take it for the world"
    assert message in str(refusal(prepare_file, str(path), tmp_path, None, "free"))


def test_a_header_with_a_wrong_version_and_another_encoding_is_read(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_bytes(
        f'<?xml version="0.0" encoding="iso-8859-1"?>\n<robot name="é">{LINKS}{JOINT}</robot>'.encode(
            "latin-1"
        )
    )
    prepared = prepare_file(str(path), tmp_path)
    assert prepared.urdf_model.name == "é"
    assert prepared.urdf_model.bodies[1].source.line == 3


def mutated(rng, text):
    """Change a text at one to four places: bytes, words, attributes or whole lines."""
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(len(text)))
        end = min(len(text), at + int(rng.integers(1, 30)))
        words = [
            "",
            "nan",
            "-1",
            "1e999",
            '"',
            "<",
            ">",
            "&x;",
            "\0",
            "é",
            "link0",
            "0 0 0",
            text[at:end] * 2,
        ]
        text = text[:at] + words[int(rng.integers(len(words)))] + text[end:]
    return text


@pytest.mark.parametrize(
    "count", [200, pytest.param(5000, marks=[pytest.mark.full, pytest.mark.timeout(1000)])]
)
def test_mutated_files_are_read_or_refused(tmp_path, count):
    rng = np.random.default_rng(17)
    refused = 0
    for k in range(count):
        make, suffix = ((random_urdf, ".urdf"), (random_mjcf, ".xml"))[k % 2]
        path = tmp_path / f"robot{suffix}"
        path.write_text(mutated(rng, make(rng, 3)))
        begin = time.process_time()
        try:
            prepared = prepare_file(str(path), tmp_path)
        except ModelFileError as error:
            refused += 1
            assert all(problem.line > 0 or "robot" in problem.file for problem in error.problems)
            assert all(problem.message for problem in error.problems)
        else:
            for write in (write_xml, lambda tree: write_xml_in_place(tree)[0]):
                again = parse_xml(write(prepared.tree).encode(), "again")
                assert [e.attributes for e in again.walk()] == [e.attributes for e in prepared.tree.walk()]
            assert [e.source.line for e in again.walk()] == [e.source.line for e in prepared.tree.walk()]
        assert time.process_time() - begin < 2
    assert 0.5 * count < refused < count
