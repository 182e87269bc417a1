"""Every mistake in a scenario file is named with file, line, column, field and what would be valid."""

from __future__ import annotations

import os
import pickle
import time
from pathlib import Path

import pytest

from plumbline.scenario.errors import Problem, ScenarioError, did_you_mean
from plumbline.scenario.loader import find_scenario_file, load_scenario, load_scenario_text, load_scenarios

GOOD = """\
schema_version: 1
title: A pendulum
purpose: A case.
bodies:
  - mass: 1.5
    inertia: {principal: [0.02, 0.03, 0.04]}
    joint: {kind: rod, length: 0.4, direction: [0, 0.6, -0.8], rate: [1, 0, 0]}
    proximal: [0, 0, 0.4]
    attitude: {quaternion: [1, 0, 0, 0]}
"""
LENGTH, RATE, ATTITUDE = "length: 0.4", "rate: [1, 0, 0]", "{quaternion: [1, 0, 0, 0]}"
PRINCIPAL = "{principal: [0.02, 0.03, 0.04]}"

# what is replaced, by what, and the start of the one problem that must come of it
CASES = {
    "misspelt field": (
        "mass:",
        "mas:",
        "5:5: bodies[0].mas: unknown field. did you mean 'mass'?; valid would be one of",
    ),
    "misspelt top field": ("title:", "titel:", "2:1: titel: unknown field. did you mean 'title'?"),
    "missing field": (
        "    proximal: [0, 0, 0.4]\n",
        "",
        "5:5: bodies[0].proximal: is missing; valid would be the point",
    ),
    "duplicate key": (
        "mass: 1.5",
        "mass: 1.5\n    mass: 2",
        "6:5: bodies[0].mass: is given twice, first on line 5",
    ),
    "wrong type": (
        "[0, 0, 0.4]",
        "0.4",
        "8:15: bodies[0].proximal: is the number 0.4; valid would be a list",
    ),
    "text for number": (
        "1.5",
        "heavy",
        "5:11: bodies[0].mass: is the text 'heavy', not a number; valid would be a number in kg",
    ),
    "quoted number": ("1.5", "'1.5'", "5:11: bodies[0].mass: is the text '1.5', not a number"),
    "word for number": ("1.5", "true", "5:11: bodies[0].mass: is the word true, not a number"),
    "nothing for number": ("1.5", "", "5:5: bodies[0].mass: is empty, not a number"),
    "unit typo": (
        LENGTH,
        "length: 0.4m",
        "7:32: bodies[0].joint.length: is the text '0.4m': write the number alone, 0.4, without 'm'; "
        "valid would be a number in m",
    ),
    "unit after a blank": (
        "1.5",
        "1.5 kg",
        "5:11: bodies[0].mass: is the text '1.5 kg': write the number alone, 1.5,",
    ),
    "decimal comma": ("1.5", "1,5", "5:11: bodies[0].mass: is the text '1,5'"),
    "negative mass": ("1.5", "-1.5", "5:11: bodies[0].mass: is -1.5; valid would be a number above 0"),
    "zero mass": ("1.5", "0", "5:11: bodies[0].mass: is 0; valid would be a number above 0"),
    "NaN": (
        "0.4]",
        ".nan]",
        "8:22: bodies[0].proximal[2]: is nan, not a finite number; valid would be a number in m",
    ),
    "infinity": ("1.5", "-.inf", "5:11: bodies[0].mass: is -inf, not a finite number"),
    "beyond double": ("1.5", "1e999", "5:11: bodies[0].mass: is inf, not a finite number"),
    "overflow later": (
        "[1, 0, 0]}\n    prox",
        "[1e308, 0, 0]}\n    angular_velocity: [1e308, 1e308, 1e308]\n    prox",
        "1:1: has numbers that make omega larger than 1e+30",
    ),
    "inertia not positive": (
        "0.04]",
        "0]",
        "6:26: bodies[0].inertia.principal: has the principal moments 0, 0.02, 0.03, not all positive; valid",
    ),
    "inertia of no body": (
        "0.04]",
        "0.06]",
        "6:26: bodies[0].inertia.principal: is not a physical inertia: its principal moments 0.02, ",
    ),
    "six of no body": (
        PRINCIPAL,
        "{six: [1, 1, 1, 0.9, 0, 0]}",
        "6:20: bodies[0].inertia.six: is not a physical inertia",
    ),
    "matrix askew": (
        PRINCIPAL,
        "{matrix: [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]}",
        "6:23: bodies[0].inertia.matrix: is not symmetric",
    ),
    "matrix too small": (
        PRINCIPAL,
        "{matrix: [[1, 0, 0], [0, 1, 0]]}",
        "6:23: bodies[0].inertia.matrix: has 2 entries; valid would be exactly 3",
    ),
    "five numbers of six": (
        PRINCIPAL,
        "{six: [1, 1, 1, 0, 0]}",
        "6:20: bodies[0].inertia.six: has 5 entries; valid would be exactly 6",
    ),
    "two inertias": (
        "0.04]",
        "0.04], six: [1, 1, 1, 0, 0, 0]",
        "6:14: bodies[0].inertia: gives principal and six; valid would be exactly one",
    ),
    "no inertia": (PRINCIPAL, "{}", "6:14: bodies[0].inertia: gives none of principal, six, matrix"),
    "axes of a matrix": (
        PRINCIPAL,
        "{six: [1, 1, 1, 0, 0, 0], axes: {quaternion: [1, 0, 0, 0]}}",
        "6:14: bodies[0].inertia: gives axes without principal",
    ),
    "rod of length 0": (
        LENGTH,
        "length: 0",
        "7:32: bodies[0].joint.length: is 0: a rod without length is a ball joint; valid would be {kind",
    ),
    "rod of negative length": (LENGTH, "length: -0.4", "7:32: bodies[0].joint.length: is -0.4, below 0"),
    "rod without direction": (
        ", direction: [0, 0.6, -0.8]",
        "",
        "7:12: bodies[0].joint.direction: is missing",
    ),
    "zero direction": (
        "[0, 0.6, -0.8]",
        "[0, 0, 0]",
        "7:48: bodies[0].joint.direction: is all zeros, which has no direction",
    ),
    "rate along the rod": (
        RATE,
        "rate: [1, 0.001, 0]",
        "7:70: bodies[0].joint.rate: has a part along the direction, 0.0006 of",
    ),
    "rate twice": (
        RATE,
        RATE + ", angular_velocity: [1, 0, 0]",
        "7:12: bodies[0].joint: gives rate and angular_velocity",
    ),
    "rod's field at a ball": (
        "{kind: rod, length: 0.4, direction: [0, 0.6, -0.8], rate: [1, 0, 0]}",
        "{kind: ball, length: 0.4}",
        "7:25: bodies[0].joint.length: unknown field; valid would be one of kind",
    ),
    "unknown joint": (
        "kind: rod",
        "kind: hinge",
        "7:12: bodies[0].joint: has the kind 'hinge'; valid would be kind: ball or kind: rod",
    ),
    "joint without kind": (
        "kind: rod",
        "knd: rod",
        "7:12: bodies[0].joint: has no kind ('knd' is not a field of it)",
    ),
    "zero quaternion": (
        "[1, 0, 0, 0]}",
        "[0, 0, 0, 0]}",
        "9:28: bodies[0].attitude.quaternion: is all zeros",
    ),
    "three numbers of four": (
        "[1, 0, 0, 0]}",
        "[1, 0, 0]}",
        "9:28: bodies[0].attitude.quaternion: has 3 entries; valid would be exactly 4",
    ),
    "zero axis": (
        ATTITUDE,
        "{axis_angle: {axis: [0, 0, 0], angle: 1}}",
        "9:35: bodies[0].attitude.axis_angle.axis: is all zeros",
    ),
    "angle twice": (
        ATTITUDE,
        "{axis_angle: {axis: [0, 0, 1], angle: 1, degrees: 2}}",
        "9:28: bodies[0].attitude.axis_angle: gives angle and degrees",
    ),
    "no angle": (
        ATTITUDE,
        "{axis_angle: {axis: [0, 0, 1]}}",
        "9:28: bodies[0].attitude.axis_angle: gives none of angle, degrees",
    ),
    "unnamed convention": (
        ATTITUDE,
        "{euler: {convention: zxz, angles: [0, 0, 0]}}",
        "9:36: bodies[0].attitude.euler.convention: is 'zxz'; valid would be intrinsic",
    ),
    "no convention": (
        ATTITUDE,
        "{euler: {angles: [0, 0, 0]}}",
        "9:23: bodies[0].attitude.euler.convention: is missing",
    ),
    "impossible convention": (
        ATTITUDE,
        "{euler: {convention: intrinsic xxz, angles: [0, 0, 0]}}",
        "9:36: bodies[0].attitude.euler.convention: is 'intr",
    ),
    "negative drag": (
        "    proximal",
        "    drag: {force: -1}\n    proximal",
        "8:19: bodies[0].drag.force: is -1; valid would be a number at least 0",
    ),
    "distal missing": (
        "bodies:\n",
        "bodies:\n  - BARE\n",
        "5:5: bodies[0].distal: is missing: a body follows",
    ),
    "run of no bodies": (
        "bodies:\n",
        "bodies:\n  - {repeat: 3, cycle: []}\n",
        "5:24: bodies[0].cycle: has 0 entries; valid would be at least 1",
    ),
    "run too long": (
        "bodies:\n",
        "bodies:\n  - {repeat: 20001, cycle: [BODY]}\n",
        "5:14: bodies[0].repeat: is 20001; valid would be a number at most 20000",
    ),
    "half a repeat": (
        "bodies:\n",
        "bodies:\n  - {repeat: 2.5, cycle: [BODY]}\n",
        "5:14: bodies[0].repeat: is the number 2.5, not a whole number; valid would be a whole number",
    ),
    "no bodies": (
        GOOD[GOOD.index("bodies") :],
        "bodies: []\n",
        "4:9: bodies: has 0 entries; valid would be at least 1",
    ),
    "bodies no list": (
        GOOD[GOOD.index("bodies") :],
        "bodies: 3\n",
        "4:9: bodies: is the number 3; valid would be a list",
    ),
    "body no mapping": (
        GOOD[GOOD.index("bodies") :],
        "bodies: [3]\n",
        "4:10: bodies[0]: is the number 3; valid would be a mapping",
    ),
    "unknown version": (
        "version: 1",
        "version: 2",
        "1:17: schema_version: is 2; this version of Plumbline reads 1; valid would be 1",
    ),
    "version as text": (
        "version: 1",
        "version: one",
        "1:17: schema_version: is 'one'; this version of Plumbline reads 1",
    ),
    "no version": ("schema_version: 1\n", "", "1:1: schema_version: is missing"),
    "unknown exact solution": (
        "bodies:",
        "exact: planar\nbodies:",
        "4:8: exact: is 'planar'. did you mean 'planar-pendulum'?",
    ),
    "duration not positive": (
        "bodies:",
        "duration: 0\nbodies:",
        "4:11: duration: is 0; valid would be a number above 0",
    ),
    "sample does not divide": (
        "bodies:",
        "duration: 1\nsample: 0.3\nbodies:",
        "5:9: sample: 1 s are 3.33333333 samples of 0.3 s; valid would be a duration that is a whole number",
    ),
    "duration is no multiple of the default sample": (
        "bodies:",
        "duration: 2.01\nbodies:",
        "4:11: duration: 2.01 s are 64.32 samples of 0.03125 s; valid would be a duration that is",
    ),
    "duration below the default sample": (
        "bodies:",
        "duration: 1e-300\nbodies:",
        "4:11: duration: 1e-300 s are 3.2e-299 samples of 0.03125 s; valid",
    ),
    "duration of too many default samples": (
        "bodies:",
        "duration: 1e9\nbodies:",
        "4:11: duration: 1e+09 s are 3.2e+10 samples of 0.03125 s; valid would be at most 1000000 samples",
    ),
    "sample too fine": (
        "bodies:",
        "duration: 4\nsample: 0.000001\nbodies:",
        "5:9: sample: 4 s are 4000000 samples of 1e-06 s; valid would be at most 1000000",
    ),
    "control character": (
        "A pendulum",
        '"A\\0 pendulum"',
        "2:8: title: has the character U+0000; valid would be printable text",
    ),
    "not for XML": ("A pendulum", '"A\\uFFFF pendulum"', "2:8: title: has the character U+FFFF"),
    "title of two lines": (
        "A pendulum",
        '"A\\npendulum"',
        "2:8: title: has line breaks, tabs, or blanks at its ends",
    ),
    "title too long": ("A pendulum", "x" * 201, "2:8: title: has 201 characters; valid would be at most 200"),
    "title a number": ("A pendulum", "12", "2:8: title: is the number 12; valid would be text"),
    "object tag": (
        "1.5",
        "!!python/object/apply:os.system ['true']",
        "5:11: bodies[0].mass: is a list, not a number",
    ),
    "own tag": (
        "A pendulum",
        "!kilo pendulum",
        "2:8: title: has the tag !kilo; valid would be a plain value without a tag",
    ),
    "tag that lies": ("1.5", "!!float abc", "5:11: bodies[0].mass: is the text 'abc', not a number"),
    "tab": (
        "    proximal",
        "\tproximal",
        "8:1: found character '\\t' that cannot start any token; indent with blanks",
    ),
    "unclosed list": (
        "0, 0.4]",
        "0, 0.4",
        "9:13: expected ',' or ']', but got ':'; a bracket [ is not closed",
    ),
    "colon in a text": (
        "A case.",
        "A case: the first.",
        "3:16: mapping values are not allowed here; a colon inside a text needs quotes",
    ),
    "unclosed brace": ("0.04]}", "0.04]", "7:5: expected ',' or '}', but got '<scalar>'; a brace { is"),
    "unclosed quote": ("A case.", "'A case.", "10:1: found unexpected end of stream; a quote is not closed"),
    "line indented too little": (
        "    proximal",
        "   proximal",
        "8:4: expected <block end>, but found '<block mapping start>'; the line is not indented like",
    ),
    "line without a colon": (
        "    proximal: [0, 0, 0.4]",
        "    proximal",
        "9:5: could not find expected ':'; a colon is missing",
    ),
    "reserved character": (
        "A case.",
        "`a case`",
        "3:10: found character '`' that cannot start any token; a text that starts with this character needs",
    ),
    "undefined alias": (
        "1.5",
        "*m",
        "5:11: found undefined alias 'm'; a text that starts with * needs quotes",
    ),
    "two documents": (
        GOOD,
        GOOD + "---\n" + GOOD,
        "10:1: but found another document; write one scenario per file",
    ),
    "empty": (GOOD, "", "1:1: is empty; valid would be a mapping that starts with schema_version: 1"),
    "comments only": (GOOD, "# nothing\n", "1:1: is empty"),
    "a list": (GOOD, "- 1\n", "1:1: is a list; valid would be a mapping that starts with schema_version: 1"),
    "a sentence": (GOOD, "a pendulum\n", "1:1: is the text 'a pendulum'; valid would be a mapping"),
    "too deep": ("1.5", "[" * 200_000, "5:19: is nested too deeply; valid would be at most 20 levels"),
}


BODY = (
    "{mass: 1, inertia: {principal: [1, 1, 1]}, joint: {kind: ball}, proximal: [0, 0, 1], distal: [0, 0, 0], "
    "attitude: {quaternion: [1, 0, 0, 0]}}"
)
BARE = BODY.replace("distal: [0, 0, 0], ", "")


def problems_of(text: str) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        load_scenario_text(text, "x.yaml")
    return [str(problem).removeprefix("x.yaml:") for problem in caught.value.problems]


def test_the_unspoilt_file_is_valid():
    load_scenario_text(GOOD)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("case", CASES)
def test_one_mistake_gives_one_problem_at_its_place(case):
    old, new, expected = CASES[case]
    assert GOOD.count(old) >= 1
    found = problems_of(GOOD.replace(old, new.replace("BODY", BODY).replace("BARE", BARE), 1))
    assert [p.startswith(expected) for p in found] == [True], f"got {found}, expected {expected!r}"


def test_all_mistakes_of_a_file_come_at_once():
    text = (
        GOOD.replace("1.5", "-1")
        .replace("title", "headline")
        .replace(LENGTH, "length: 0")
        .replace("0.04]", "9]")
    )
    places = [problem.split(": ")[:2] for problem in problems_of(text)]
    assert places == [
        ["1:1", "title"],
        ["2:1", "headline"],
        ["5:11", "bodies[0].mass"],
        ["6:26", "bodies[0].inertia.principal"],
        ["7:32", "bodies[0].joint.length"],
    ]


def test_all_mistakes_of_all_files_come_at_once(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.yaml").write_text(GOOD.replace("1.5", "-1"))
    with pytest.raises(ScenarioError) as caught:
        load_scenarios([tmp_path / "a.yaml", tmp_path / "b.yaml", "no-such-scenario"])
    assert [Path(p.file).name for p in caught.value.problems] == ["a.yaml", "b.yaml", "no-such-scenario"]
    assert f"{tmp_path / 'a.yaml'}:5:11: bodies[0].mass: is -1" in str(caught.value)


def test_a_body_in_a_run_is_placed_too():
    head = GOOD[: GOOD.index("  - mass")]
    load_scenario_text(head + f"  - repeat: 2\n    cycle:\n      - {BODY}\n")
    bare = BARE.replace("mass: 1", "mass: -1")
    assert [p[:40] for p in problems_of(head + f"  - repeat: 2\n    cycle:\n      - {bare}\n")] == [
        "7:9: bodies[0].cycle[0].distal: is missi",
        "7:16: bodies[0].cycle[0].mass: is -1; va",
    ]
    load_scenario_text(head + f"  - repeat: 1\n    cycle:\n      - {BARE}\n")


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "bomb",
    [
        "a0: &a0 [1,1,1,1,1,1,1,1,1,1]\n"
        + "".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)),
        "a: [" + "1," * 490_000 + "1]",
        "".join(f"k{i}: 1\n" for i in range(80_000)),
    ],
    ids=["aliases", "list", "keys"],
)
def test_a_file_that_is_too_much_ends_soon(bomb):
    assert "has more than 50000 values (aliases followed)" in problems_of(bomb)[0]


@pytest.mark.parametrize(
    "text",
    [
        "!" * 900_000,
        f"title: !<{'a' * 900_000}>",
        f"a: !{',' * 900_000} b",
        f"a: *{'b' * 900_000}",
        f"schema_version: 0x{'f' * 900_000}",
        GOOD.replace("1.5", "'" + "1" * 900_000 + "x'"),
        GOOD.replace("mass", "m" * 900_000),
        GOOD.replace("A pendulum", "!" + "a" * 900 + " pendulum"),
        GOOD.replace("kind: rod", "kind: " + "r" * 900_000),
    ],
    ids=["tag", "verbatim tag", "tag of commas", "alias", "number", "text", "field", "short tag", "kind"],
)
def test_long_words_are_read_soon_and_quoted_in_part(text):
    begin = time.process_time()
    found = problems_of(text)
    assert time.process_time() - begin < 5
    assert max(map(len, found)) < 500


def test_reading_prints_no_warnings(recwarn):
    anchors = GOOD.replace("mass: 1.5", "mass: &a 1.5").replace("[0, 0, 0.4]", "&a [0, 0, 0.4]")
    load_scenario_text(anchors)
    huge = "{matrix: [[1e308, 1e308, 1e308], [1e308, 1e308, 1e308], [1e308, 1e308, 1e308]]}"
    (problem,) = problems_of(GOOD.replace(PRINCIPAL, huge))
    assert problem.startswith("6:23: bodies[0].inertia.matrix: ")
    assert not recwarn.list


@pytest.mark.parametrize("loop", ["a: &a [*a]", "a: &a {b: *a}"])
def test_an_alias_of_itself_ends(loop):
    assert problems_of(loop)[0].startswith("1:4: is nested too deeply")


def test_many_problems_are_counted_rather_than_listed():
    with pytest.raises(ScenarioError) as caught:
        load_scenario_text(GOOD + "".join(f"x{i}: 1\n" for i in range(300)))
    assert len(caught.value.problems) == 300
    assert str(caught.value).endswith("… and 200 more problems")


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        (b"title: \xff\xfe", ":1:8: byte 0xff is not UTF-8; valid would be UTF-8 text"),
        (b"title: a\npurpose: na\xefve", ":2:12: byte 0xef is not UTF-8"),
        ("title: überé\n".encode() + b"purpose: \xe9", ":2:10: byte 0xe9 is not UTF-8"),
        (b"title: \x00", ":1:8: the character U+0000 is not allowed in YAML"),
        (b"#" * 1_000_001, ": is larger than 1000000 bytes"),
    ],
)
def test_bytes_that_are_no_text(tmp_path, raw, expected):
    path = tmp_path / "bytes.yaml"
    path.write_bytes(raw)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert str(caught.value).startswith(f"{path}{expected}")


def test_files_that_cannot_be_read(tmp_path):
    for path, expected in (
        (tmp_path / "none.yaml", "cannot be read: No such file or directory"),
        (tmp_path, "is not a regular file"),
        (Path("a\0b.yaml"), "cannot be read: "),
        (Path("/dev/zero"), "is not a regular file"),
    ):
        if path.name == "zero" and not path.exists():
            continue  # not on this system
        with pytest.raises(ScenarioError) as caught:
            load_scenario(path)
        assert expected in str(caught.value)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission(tmp_path):
    path = tmp_path / "locked.yaml"
    path.write_text(GOOD)
    path.chmod(0)
    with pytest.raises(ScenarioError, match="cannot be read: Permission denied"):
        load_scenario(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
@pytest.mark.timeout(20)
def test_a_pipe_does_not_hang(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(ScenarioError, match="is not a regular file"):
        load_scenario(tmp_path / "pipe.yaml")


def test_byte_order_mark_and_carriage_returns_are_fine(tmp_path):
    path = tmp_path / "windows.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert load_scenario(path).digest == load_scenario_text(GOOD, "windows.yaml").digest
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").replace("1.5", "-1").encode())
    with pytest.raises(ScenarioError, match=r":5:11: bodies\[0\].mass: is -1"):
        load_scenario(path)


def test_an_unknown_name_suggests_the_nearest():
    with pytest.raises(
        ScenarioError, match=r"tumbling-bal: unknown scenario\. did you mean 'tumbling-ball'\?"
    ):
        find_scenario_file("tumbling-bal")
    with pytest.raises(
        ScenarioError, match="unknown scenario; valid would be a path of a YAML file, or one of"
    ):
        find_scenario_file("qqqqqq")
    assert did_you_mean("Distl", ["mass", "distal"]) == "did you mean 'distal'?"


def test_two_scenarios_of_one_name_are_refused(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.yaml").write_text(
            "name: same\n" + GOOD.replace("1.5", "1" if name == "a" else "2")
        )
    with pytest.raises(ScenarioError, match="name: is named 'same' like"):
        load_scenarios([tmp_path / "a.yaml", tmp_path / "b.yaml"])
    assert len(load_scenarios([tmp_path / "a.yaml", tmp_path / "a.yaml"])) == 1


def test_errors_cross_processes():
    error = ScenarioError([Problem("a.yaml", 1, 2, "mass", "is -1", "more")])
    assert (
        str(pickle.loads(pickle.dumps(error))) == str(error) == "a.yaml:1:2: mass: is -1; valid would be more"
    )
