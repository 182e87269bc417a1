"""A folder that somebody else made: nothing in it is executed, and nothing outside is read for its files."""

import json
import os
import sys

import pytest

from tests.helpers import ROOT
from tests.helpers.commands import invoke, run_plumbline
from tests.helpers.terminal_counts import agreed

SECRET = "TOP-SECRET-4711"
LINK = """<link name="{name}"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>"""
HINGE = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
BODY = '<body name="b"><joint axis="0 1 0"/>{inside}</body>'
INERTIAL = '<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/>'


def urdf(mesh, head=""):
    links = "".join(LINK.format(name=name, mesh=mesh) for name in "ab")
    return f'<?xml version="1.0"?>{head}<robot name="r">{links}{HINGE}</robot>'


def mjcf(assets="", inside=INERTIAL, world=""):
    return f"<mujoco>{assets}<worldbody>{BODY.format(inside=inside)}{world}</worldbody></mujoco>"


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """(folder, file that something executed would write, the secret outside)."""
    top = tmp_path_factory.mktemp("hostile")
    folder, outside, mark = top / "folder", top / "outside", top / "executed"
    folder.mkdir(), outside.mkdir()
    secret = outside / "secret.xml"
    secret.write_text(f"<mujocoinclude><!-- {SECRET} --><body name='{SECRET}'/></mujocoinclude>")
    os.mkfifo(outside / "mesh.stl")  # whoever opens it hangs
    code = f"open({str(mark)!r}, 'a').write(__name__ + '\\n')\n"
    for name in [
        "engine",
        "numpy",
        "mujoco",
        "yaml",
        "sitecustomize",
        "usercustomize",
        "conftest",
        "json",
        "setup",
    ]:
        (folder / f"{name}.py").write_text(code)
    for name in ("plumbline", "adapters", "reference_impl", "reports"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(code)
        (folder / name / "mujoco_engine.py").write_text(code)
    engines = {
        "program": f"cmd:{sys.executable} engine.py",
        "file": "engine.py:Engine",
        "module": "engine:Engine",
        "shell": f"cmd:sh -c 'touch {mark}'",
    }
    lines = [f"{name} = {json.dumps(text)}" for name, text in engines.items()]
    (folder / "plumbline.toml").write_text("[engines]\n" + "\n".join(lines) + "\n")
    (folder / "pyproject.toml").write_text('[tool.pytest.ini_options]\naddopts = "-p engine"\n')
    (folder / "link.xml").symlink_to(secret)
    (folder / "robots").mkdir()
    files = {
        "include.xml": mjcf(world='<include file="../outside/secret.xml"/>'),
        "absolute.xml": mjcf(world=f'<include file="{secret}"/>'),
        "through-link.xml": mjcf(world='<include file="link.xml"/>'),
        "mesh.xml": mjcf(
            '<asset><mesh name="m" file="../outside/mesh.stl"/></asset>', '<geom type="mesh" mesh="m"/>'
        ),
        "meshdir.xml": mjcf(
            '<compiler meshdir="../outside"/><asset><mesh name="m" file="mesh.stl"/></asset>',
            '<geom type="mesh" mesh="m"/>',
        ),
        "plugin.xml": mjcf('<extension><plugin plugin="../outside/evil.so"/></extension>'),
        "up.urdf": urdf("../outside/mesh.stl"),
        "file.urdf": urdf(f"file://{outside}/mesh.stl"),
        "package.urdf": urdf("package://../outside/mesh.stl"),
        "entity.urdf": urdf("x", f'<!DOCTYPE r [<!ENTITY s SYSTEM "file://{secret}">]>').replace(
            '"r"', '"&s;"', 1
        ),
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    scenario = (ROOT / "scenarios/single/rest.yaml").read_text(encoding="utf-8")
    (folder / "scenario.yaml").write_text(
        scenario + f"\nseed: !!python/object/apply:os.system ['touch {mark}']\n"
    )
    return folder, mark, files


def check(hostile, done):
    folder, mark, _ = hostile
    assert not mark.exists(), f"executed: {mark.read_text()}"
    written = [path for path in folder.rglob("plumbline-out/**/*") if path.is_file()]
    everything = done.stdout + done.stderr + "".join(p.read_text(errors="replace") for p in written)
    assert SECRET not in everything


def test_no_engine_of_the_folder_is_started_and_no_module_imported(hostile, monkeypatch):
    folder = hostile[0]
    run = "run", "tumbling-ball", "--level", "state", "--jobs", 1, "--out", "plumbline-out"
    done = run_plumbline(*run, "--engine", "mujoco", cwd=folder, code=0)
    assert agreed(done.stdout) >= 7, done.stdout + done.stderr
    check(hostile, done)
    done = run_plumbline(*run, "--engine", "program", cwd=folder, code=2)
    assert "--trust allows it" in done.stderr, done.stderr
    check(hostile, done)
    monkeypatch.chdir(folder)  # the same without processes of their own
    for name in ("file", "module", "shell"):
        done = invoke(*run, "--engine", name, code=2)
        assert "--trust allows it" in done.stderr, done.stderr
        check(hostile, done)


def test_no_file_outside_is_read_for_a_model_file(hostile):
    folder, _, files = hostile
    for words in (("run", "--level", "state", "--engine", "mujoco"), ("model", "--engine", "mujoco")):
        done = run_plumbline(
            *words, *files, "scenario.yaml", "--jobs", 1, "--out", "plumbline-out", cwd=folder
        )
        assert done.returncode == 2, (words, done.stdout, done.stderr)
        check(hostile, done)
        for name in ("include.xml", "absolute.xml", "through-link.xml", "mesh.xml", "meshdir.xml"):
            assert f"{name}:" in done.stderr and "is outside" in done.stderr, (name, done.stderr)
        assert "entity.urdf:" in done.stderr and "scenario.yaml" in done.stderr


def test_meshes_outside_do_not_matter_to_a_mechanism_and_are_not_opened(hostile):
    for name in ("up.urdf", "file.urdf", "package.urdf"):
        done = run_plumbline("model", name, "--to-scenario", "arm.yaml", cwd=hostile[0], code=0)
        check(hostile, done)
