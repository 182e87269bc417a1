"""Model files with random damage, extreme numbers and hostile references, compared as `model` does."""

import os
import random
from collections import Counter
from pathlib import Path

import pytest

from plumbline.execution.exit_codes import ExitCode
from plumbline.judging.rows import Verdict
from plumbline.model_files.model_run import ModelPlan, run_model_files
from plumbline.processes.worker_pool import Limits
from tests.helpers.model_mutations import damaged_model, extreme_model, robots
from tests.helpers.tables import table

# All files of a test are compared by one command, which also tests that a bad file hides no other.
IMPORTERS = ("mujoco", "pinocchio")
BATCH = 25
OPEN = (Verdict.HARNESS_FAILED, Verdict.UNRESOLVED)


def compare(*paths, **options):
    usual = {"importers": IMPORTERS, "state_count": 2, "limits": Limits(60.0)}
    plan = ModelPlan(tuple(map(str, paths)), **usual | options)
    return run_model_files(plan, lambda *_: None)


def try_mutants(folder, count, make, seed):
    """Count what becomes of damaged files: each is compared, or refused in words with a line of the file."""
    draw, named, outcomes, paths = random.Random(seed), list(robots().items()), Counter(), []
    for k in range(count):
        name, text = named[k % len(named)]
        path = folder / f"{k}-{name}"
        path.write_bytes(make(text, draw))
        paths.append(path)
    for start in range(0, count, BATCH):
        batch = paths[start : start + BATCH]
        result = compare(*batch)
        assert result.exit_code != ExitCode.HARNESS_FAILED, [
            *result.problems, *(row for row in result.rows if row.verdict == Verdict.HARNESS_FAILED)
        ]  # fmt: skip
        refused = {problem.file for problem in result.problems}
        assert refused.isdisjoint(file.file for file in result.files)
        assert refused | {file.file for file in result.files} == {*map(str, batch)}
        for problem in result.problems:
            lines = Path(problem.file).read_bytes().count(b"\n") + 1
            assert 1 <= problem.line <= lines and problem.column >= 1 and problem.message, problem
        for row in result.rows:
            assert row.verdict not in OPEN, row
            outcomes[str(row.verdict)] += row.verdict == Verdict.FAILED
        outcomes["refused"] += len(refused)
        outcomes["compared"] += len(result.files)
    return outcomes


def test_damaged_and_extreme_files_are_compared_or_refused(tmp_path):
    outcomes = try_mutants(tmp_path, 11, damaged_model, 5) + try_mutants(tmp_path, 11, extreme_model, 6)
    assert outcomes["refused"] and outcomes["compared"], outcomes


@pytest.mark.full
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("make", [damaged_model, extreme_model])
def test_four_hundred_damaged_files_are_compared_or_refused(tmp_path, make):
    outcomes = try_mutants(tmp_path, 400, make, 7)
    assert min(outcomes["refused"], outcomes["compared"]) > 50, outcomes
    print(dict(outcomes))


INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
PENDULUM = f"""<robot name="r"><link name="base"/>
<link name="bob">{INERTIAL}</link>
<joint name="pivot" type="continuous"><parent link="base"/><child link="bob"/>
<axis xyz="0 1 0"/><dynamics damping="0.1"/></joint></robot>
"""
MJCF = """<mujoco model="m">
<worldbody>
<body name="b"><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/></body>
</worldbody></mujoco>
"""
EXTREMES = [({"PENDULUM": PENDULUM, "MJCF": MJCF}[text], *change) for text, *change in table(__file__)]


def test_extreme_numbers_are_refused_at_their_place_or_compared(tmp_path):
    expected = {}
    for k, (text, old, new, words) in enumerate(EXTREMES):
        path = tmp_path / f"{k}.xml"
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        expected[str(path)] = words
    result = compare(*expected)
    assert result.exit_code == ExitCode.BAD_USAGE
    problems = {problem.file: str(problem) for problem in result.problems}
    for path, words in expected.items():
        if words:
            assert f"{path}:{words}" in problems[path]
    assert [file.file for file in result.files] == [path for path, words in expected.items() if not words]
    for row in result.rows:  # what importers make of axes whose square is not in range is theirs
        assert row.verdict in (Verdict.AGREES, Verdict.INFORMATION) or "xyz" in EXTREMES[
            int(Path(row.scenario).stem)][1], row  # fmt: skip


def test_accelerations_that_rounding_does_not_determine_are_not_judged(tmp_path):
    path = tmp_path / "robot.xml"
    far = '<body pos="1e30 0 0"><joint/><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body>'
    path.write_text(MJCF.replace("</body>", f"{far}</body>"), encoding="utf-8")
    (row,) = (r for r in compare(path).rows if r.engine == "mujoco" and r.quantity == "acceleration")
    assert row.verdict == Verdict.INFORMATION and "singular in double precision" in row.reason


def test_a_full_disk_is_the_machines_failure_and_names_the_file(tmp_path, monkeypatch):
    path = tmp_path / "robot.xml"
    path.write_text(MJCF.replace(' name="b"', ""), encoding="utf-8")  # a copy gets the name

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*/robot\.xml'"):
        compare(path)


def mesh(name):
    visual = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    return PENDULUM.replace('<link name="base"/>', f'<link name="base">{visual}</link>')


def inside(part, text=MJCF):
    return text.replace("<worldbody>", part, 1)


SECRET = "/etc/passwd"
ENTITIES = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 9))
OUTSIDE = (
    "../secret.stl", SECRET, "file:///etc/passwd", "package://../../etc/passwd", "package:///etc/passwd",
    "model://x/../../secret.stl", "%2e%2e/secret.stl", "file://%2Fetc%2Fpasswd", "http://x/y.stl",
    "https://x/y.stl", "ftp://x/y.stl", "//host/y.stl", "link.stl", "folder/../../secret.stl", "\\\\x\\y",
    "~/x.stl", "$HOME/x.stl", "package://p/link.stl", "file:/etc/passwd", "data:,x", "a" * 5000,
)  # fmt: skip
INCLUDED = (
    "../secret.xml", SECRET, "link.xml", "folder", "", ".", "%2e%2e/secret.xml", "robot.xml", "a" * 5000
)  # fmt: skip
ASSETS = (
    '<asset><mesh name="m" file="../secret.stl"/></asset>',
    f'<asset><mesh name="m" file="{SECRET}"/></asset>',
    '<compiler meshdir=".."/><asset><mesh name="m" file="secret.stl"/></asset>',
    '<compiler meshdir="/etc"/><asset><mesh name="m" file="passwd"/></asset>',
    '<compiler assetdir="/etc"/><asset><mesh name="m" file="passwd"/></asset>',
    f'<asset><texture name="t" type="2d" file="{SECRET}"/></asset>',
    '<asset><texture name="t" type="cube" fileright="../secret.png"/></asset>',
    f'<asset><hfield name="h" file="{SECRET}"/></asset>', f'<asset><skin name="s" file="{SECRET}"/></asset>',
    f'<asset><model name="m" file="{SECRET}"/></asset>',
    f'<worldbody><flexcomp name="f" type="mesh" file="{SECRET}"/></worldbody>',
)  # fmt: skip
SPECIAL = [  # all are refused
    *map(mesh, OUTSIDE),
    *(inside(f'<include file="{name}"/><worldbody>') for name in INCLUDED),
    *(inside(f"{part}<worldbody>") for part in ASSETS),
    f'<!DOCTYPE r [<!ENTITY e0 "x">{ENTITIES}]><robot name="&e8;"/>',
    f'<!DOCTYPE r [<!ENTITY x SYSTEM "file://{SECRET}">]><robot name="r">&x;</robot>',
    f"<mujoco><worldbody>{'<body>' * 100_000}{'</body>' * 100_000}</worldbody></mujoco>",
    '<robot name="r"><link name="a"/>' * 2,
    "",
]
MANY = '<replicate count="100000000" offset="1 0 0"><body><joint/><geom size="1"/></body></replicate>'


def special_files(folder):
    """Each in a folder of its own beside a file that is not to be read, a pipe, and a file that is good."""
    for k, text in enumerate(SPECIAL):
        root = folder / str(k) / "root"
        (root / "folder").mkdir(parents=True)
        for end in ("stl", "xml", "png"):
            (folder / str(k) / f"secret.{end}").write_text("<mujocoinclude/>", encoding="utf-8")
        for end in ("stl", "xml"):
            (root / f"link.{end}").symlink_to(folder / str(k) / f"secret.{end}")
        (root / "robot.xml").write_text(text, encoding="utf-8")
        yield root / "robot.xml"
    os.mkfifo(folder / "pipe.xml")
    yield folder / "pipe.xml"


def test_special_files_are_refused_without_reading_outside_of_their_root(tmp_path):
    paths, good = list(special_files(tmp_path)), tmp_path / "good.xml"
    good.write_text(MJCF, encoding="utf-8")
    result = compare(*paths, good, tmp_path / "none.xml", tmp_path)
    assert result.exit_code == ExitCode.BAD_USAGE
    assert [file.file for file in result.files] == [str(good)], "one bad file hides no other"
    refused = {problem.file: problem for problem in result.problems}
    for path in (*paths, tmp_path / "none.xml", tmp_path):
        assert refused[str(path)].message and "internal error" not in refused[str(path)].message
        assert refused[str(path)].line or path.name != "robot.xml"
    assert "root:x" not in "".join(map(str, result.problems)), "the content of a file outside"


def test_a_file_that_mujoco_does_not_compile_in_time_has_a_sentence(tmp_path):
    path = tmp_path / "many.xml"
    path.write_text(inside(f"<worldbody>{MANY}"), encoding="utf-8")
    result = compare(path, importers=("mujoco",), limits=Limits(1.0))
    assert result.exit_code == ExitCode.BAD_USAGE
    words = "MuJoCo, which defines MJCF, did not load the file within the time limit of 1 s (--timeout)"
    assert [str(problem) for problem in result.problems] == [f"{path}:1:1: {words}"]


@pytest.mark.full
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("count", "seconds"), [(150, 3.0), (600, 20.0)])
def test_a_robot_whose_values_take_too_long_is_left_open(tmp_path, count, seconds):
    """Its importers are fast enough, the certified values are not."""
    bodies = "".join(f'<body name="b{k}"><joint name="j{k}"/><geom size="0.1"/>' for k in range(count))
    path = tmp_path / "chain.xml"
    path.write_text(inside(f"<worldbody>{bodies}{'</body>' * count}", MJCF), encoding="utf-8")
    result = compare(path, limits=Limits(seconds), state_count=200)
    assert result.exit_code in (ExitCode.DISAGREEMENT, ExitCode.ENGINE_FAILED, ExitCode.BAD_USAGE)
    assert all(row.verdict in (Verdict.UNRESOLVED, Verdict.FAILED) for row in result.rows)
    words = f"within the time limit of {seconds:g} s (--timeout)"
    assert all(words in row.reason for row in result.rows)


PARTS = """<mujocoinclude>
  <body name="a">
    <joint name="j"
           axis="0 1 0"/>
    <inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/>
  </body>
</mujocoinclude>
"""
WHOLE = """<mujoco model="m">
  <worldbody>
    <include file="parts/arm.xml"/>
    <body>
      <geom size="0.1"/> <joint axis="0 0 1"/>
      <inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("options", [{}, {"strip_geometry": True}])
def test_refusals_of_mujoco_have_the_place_in_the_users_file(tmp_path, options):
    """Also of files that are read as a copy: with included parts, with names, without geometry."""
    cases = {
        ('axis="0 1 0"', 'axis="0 1"', 1): "parts/arm.xml:3:5",
        ('diaginertia="1 1 1"', 'diaginertia="1 1 9"', 1): "parts/arm.xml:2:3",
        ('axis="0 0 1"', 'axis="0 1"', 0): "robot.xml:5:26",
        ("<body>", '<body name="a">', 0): "robot.xml:4:5",
    }
    places, files = [], []
    for k, ((old, new, is_part), place) in enumerate(cases.items()):
        folder = tmp_path / str(k)
        (folder / "parts").mkdir(parents=True)
        texts = [WHOLE, PARTS]
        assert old in texts[is_part]
        texts[is_part] = texts[is_part].replace(old, new, 1)
        (folder / "robot.xml").write_text(texts[0], encoding="utf-8")
        (folder / "parts" / "arm.xml").write_text(texts[1], encoding="utf-8")
        files.append(folder / "robot.xml")
        places.append(f"{folder}/{place}: MuJoCo, which defines MJCF, refuses it: ")
    result = compare(*files, importers=("mujoco",), **options)
    found = sorted(map(str, result.problems))
    assert len(found) == len(places)
    for words, place in zip(found, sorted(places), strict=True):
        assert words.startswith(place) and "\n" not in words
        line = place.split(":")[1]
        assert f"line {line}" in words, "the words name the line of the user's file"
