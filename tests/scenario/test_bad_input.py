"""Every mistake in a scenario file is named with file, line, column, field and what would be valid."""

from __future__ import annotations

import math
import os
import pickle
import re
import time
from functools import reduce
from itertools import product
from pathlib import Path
from typing import get_args

import pytest
from pydantic_core.core_schema import ErrorType

from plumbline.scenario.line_and_column_errors import Problem, ScenarioError, did_you_mean
from plumbline.scenario.loader import (
    find_scenario_file,
    json_schema,
    load_scenario,
    load_scenario_text,
    load_scenarios,
)
from plumbline.scenario.schema import Document
from plumbline.scenario.validation_messages import problems_from_validation
from plumbline.scenario.yaml_source import YamlSource
from plumbline.studies.sweep_file import Sweep
from tests.helpers.refusals import refusal
from tests.helpers.requirements import needs_pipes
from tests.helpers.tables import table

VALID_SCENARIO = """\
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
PRINCIPAL = "{principal: [0.02, 0.03, 0.04]}"
ERROR_CASES = table(Path(__file__).with_name("mistakes"))
VALID_BODY = (
    "{mass: 1, inertia: {principal: [1, 1, 1]}, joint: {kind: ball}, proximal: [0, 0, 1], distal: [0, 0, 0], "
    "attitude: {quaternion: [1, 0, 0, 0]}}"
)
BODY_WITHOUT_DISTAL = VALID_BODY.replace("distal: [0, 0, 0], ", "")
MARKS = {
    "FILE": VALID_SCENARIO, "CHAIN": VALID_SCENARIO[VALID_SCENARIO.index("bodies") :],
    "BODY": VALID_BODY, "BARE": BODY_WITHOUT_DISTAL, "DEEP": "[" * 200_000
}  # fmt: skip


def errors_in(text):
    found = refusal(load_scenario_text, text, "x.yaml").problems
    return [str(problem).removeprefix("x.yaml:") for problem in found]


def test_the_undamaged_file_is_valid():
    assert load_scenario_text(VALID_SCENARIO).model.n >= 1


@pytest.mark.timeout(20)
@pytest.mark.parametrize("case", ERROR_CASES)
def test_one_mistake_gives_one_problem_at_its_place(case):
    old, new = (
        reduce(lambda text, mark: text.replace(*mark), MARKS.items(), ERROR_CASES[case][key])
        for key in ("replace", "by")
    )
    assert old in VALID_SCENARIO
    found, expected = errors_in(VALID_SCENARIO.replace(old, new, 1)), ERROR_CASES[case]["problem"]
    assert [p.startswith(expected) for p in found] == [True], f"got {found}, expected {expected!r}"


def all_fields():
    """Every field of the schema."""
    parts = [json_schema(), *json_schema()["$defs"].values()]
    return sorted({name for part in parts for name in part.get("properties", ())})


@pytest.mark.parametrize("holder", ["title", "mass", "kind", "principal", "quaternion"])
def test_each_field_in_a_wrong_place_gets_its_right_ones(holder):
    def unknown(name):
        block = {"title": f"{name}: 1\n", "mass": f"{name}: 1\n    "}.get(holder, f"{name}: 1, ")
        found = errors_in(VALID_SCENARIO.replace(f"{holder}:", f"{block}{holder}:", 1))
        return [problem for problem in found if ": unknown field" in problem]

    own = unknown("zzzzz")[0].rpartition("one of ")[2].split(", ")
    for name in {*all_fields()} - {*own, "repeat", "cycle"}:  # these two make a body a sequence
        (problem,) = unknown(name)
        belongs = rf": unknown field \(`{name}` is a field of (`[\w.]+:`|the file's top level)"
        assert re.search(belongs, problem), problem


INPUTS = (3, "x", None, [], {}, True, math.inf, [1, 2])
LOCATIONS = (
    (Document, ()), (Document, ("duration",)), (Document, ("nothing", "like", 3, "it")),
    (Document, ("bodies", 0, "body", "joint", "hinge", "axis", 1)),
    (Document, ("bodies", 0, "sequence", "cycle", 0, "name")),
    (Sweep, ("vary", "bodies[0].mass", "log")), (Sweep, ("engines", "mujoco", "[key]")),
)  # fmt: skip


def test_no_words_of_pydantic_reach_the_user():
    words = "Input should be a valid thing"
    context = {"message": "m", "valid": "v", "expected": words, "error": words, "gt": 1.0, "min_length": 3}
    for kind, (model, loc), given in product(get_args(ErrorType), LOCATIONS, INPUTS):
        if kind == "extra_forbidden" and not loc:
            continue  # a file is no field
        source = YamlSource("x.yaml", {}, {loc[:1]: (2, 3), (): (1, 1)})
        details = {"type": kind, "loc": loc, "msg": words, "input": given, "ctx": context}
        for problem in problems_from_validation(source, [details], model):
            assert words not in str(problem) and problem.message and "[key]" not in problem.field, kind
            assert (problem.line, problem.column) == ((2, 3) if loc else (1, 1)), kind


def test_all_mistakes_of_a_file_come_at_once():
    text = (
        VALID_SCENARIO.replace("1.5", "-1")
        .replace("title", "headline")
        .replace("length: 0.4", "length: 0")
        .replace("0.04]", "9]")
    )
    places = [problem.split(": ")[:2] for problem in errors_in(text)]
    assert places == [
        ["1:1", "title"],
        ["2:1", "headline"],
        ["5:11", "bodies[0].mass"],
        ["6:26", "bodies[0].inertia.principal"],
        ["7:32", "bodies[0].joint.length"],
    ]


def test_all_mistakes_of_all_files_come_at_once(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.yaml").write_text(VALID_SCENARIO.replace("1.5", "-1"))
    error = refusal(load_scenarios, [tmp_path / "a.yaml", tmp_path / "b.yaml", "no-such-scenario"])
    assert [Path(p.file).name for p in error.problems] == ["a.yaml", "b.yaml", "no-such-scenario"]
    assert f"{tmp_path / 'a.yaml'}:5:11: bodies[0].mass: is -1" in str(error)


def test_a_body_in_a_run_is_placed_too():
    head = VALID_SCENARIO[: VALID_SCENARIO.index("  - mass")]
    load_scenario_text(head + f"  - repeat: 2\n    cycle:\n      - {VALID_BODY}\n")
    bare = BODY_WITHOUT_DISTAL.replace("mass: 1", "mass: -1")
    assert [p[:40] for p in errors_in(head + f"  - repeat: 2\n    cycle:\n      - {bare}\n")] == [
        "7:9: bodies[0].cycle[0].distal: is missi",
        "7:16: bodies[0].cycle[0].mass: is -1; va",
    ]
    load_scenario_text(head + f"  - repeat: 1\n    cycle:\n      - {BODY_WITHOUT_DISTAL}\n")


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
    assert "has more than 50000 values (aliases followed)" in errors_in(bomb)[0]


@pytest.mark.parametrize(
    "text",
    [
        "!" * 900_000,
        f"title: !<{'a' * 900_000}>",
        f"a: !{',' * 900_000} b",
        f"a: *{'b' * 900_000}",
        f"schema_version: 0x{'f' * 900_000}",
        VALID_SCENARIO.replace("1.5", "'" + "1" * 900_000 + "x'"),
        VALID_SCENARIO.replace("mass", "m" * 900_000),
        VALID_SCENARIO.replace("A pendulum", "!" + "a" * 900 + " pendulum"),
        VALID_SCENARIO.replace("kind: rod", "kind: " + "r" * 900_000),
    ],
    ids=["tag", "verbatim tag", "tag of commas", "alias", "number", "text", "field", "short tag", "kind"],
)
def test_long_words_are_read_soon_and_quoted_in_part(text):
    begin = time.process_time()
    found = errors_in(text)
    assert time.process_time() - begin < 5
    assert max(map(len, found)) < 500


def test_reading_prints_no_warnings(recwarn):
    anchors = VALID_SCENARIO.replace("mass: 1.5", "mass: &a 1.5").replace("[0, 0, 0.4]", "&a [0, 0, 0.4]")
    load_scenario_text(anchors)
    huge = "{matrix: [[1e308, 1e308, 1e308], [1e308, 1e308, 1e308], [1e308, 1e308, 1e308]]}"
    (problem,) = errors_in(VALID_SCENARIO.replace(PRINCIPAL, huge))
    assert problem.startswith("6:23: bodies[0].inertia.matrix: ")
    assert not recwarn.list


@pytest.mark.parametrize("loop", ["a: &a [*a]", "a: &a {b: *a}"])
def test_an_alias_of_itself_ends(loop):
    assert errors_in(loop)[0].startswith("1:4: is nested too deeply")


def test_many_problems_are_counted_rather_than_listed():
    error = refusal(load_scenario_text, VALID_SCENARIO + "".join(f"x{i}: 1\n" for i in range(300)))
    assert len(error.problems) == 300
    assert str(error).endswith("… and 200 more problems")


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
    assert str(refusal(load_scenario, path)).startswith(f"{path}{expected}")


def test_files_that_cannot_be_read(tmp_path):
    for path, expected in (
        (tmp_path / "none.yaml", "cannot be read: No such file or directory"),
        (tmp_path, "is not a regular file"),
        (Path("a\0b.yaml"), "cannot be read: "),
        (Path("/dev/zero"), "is not a regular file"),
    ):
        if path.name == "zero" and not path.exists():
            continue  # not on this system
        assert expected in str(refusal(load_scenario, path))


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission(tmp_path):
    path = tmp_path / "locked.yaml"
    path.write_text(VALID_SCENARIO)
    path.chmod(0)
    with pytest.raises(ScenarioError, match="cannot be read: Permission denied"):
        load_scenario(path)


@needs_pipes
@pytest.mark.timeout(20)
def test_a_pipe_does_not_hang(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(ScenarioError, match="is not a regular file"):
        load_scenario(tmp_path / "pipe.yaml")


def test_byte_order_mark_and_carriage_returns_are_fine(tmp_path):
    path = tmp_path / "windows.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + VALID_SCENARIO.replace("\n", "\r\n").encode())
    assert load_scenario(path).digest == load_scenario_text(VALID_SCENARIO, "windows.yaml").digest
    path.write_bytes(b"\xef\xbb\xbf" + VALID_SCENARIO.replace("\n", "\r\n").replace("1.5", "-1").encode())
    with pytest.raises(ScenarioError, match=r":5:11: bodies\[0\].mass: is -1"):
        load_scenario(path)


def test_an_unknown_name_suggests_the_nearest():
    with pytest.raises(
        ScenarioError, match=r"tumbling-bal: unknown scenario \(did you mean 'tumbling-ball'\?\)"
    ):
        find_scenario_file("tumbling-bal")
    with pytest.raises(
        ScenarioError,
        match=r"unknown scenario; valid would be a path .*, or a name that .*list scenarios",
    ):
        find_scenario_file("qqqqqq")
    assert did_you_mean("Distl", ["mass", "distal"]) == "did you mean 'distal'?"


def test_two_scenarios_of_one_name_are_refused(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.yaml").write_text(
            "name: same\n" + VALID_SCENARIO.replace("1.5", "1" if name == "a" else "2")
        )
    with pytest.raises(ScenarioError, match="name: is named 'same' like"):
        load_scenarios([tmp_path / "a.yaml", tmp_path / "b.yaml"])
    assert len(load_scenarios([tmp_path / "a.yaml", tmp_path / "a.yaml"])) == 1


def test_a_problem_is_one_line_of_printable_text():
    (problem,) = errors_in(VALID_SCENARIO.replace("mass:", '"mass\\e[2J\\u202e\\L\\n": 2\n    mass:'))
    assert problem.startswith(
        r"5:5: bodies[0].mass\x1b[2J\u202e  : unknown field (did you mean 'mass'?); valid"
    )
    assert problem.isprintable()
    two_lines = Problem("a\nb.xml", 3, 1, "", "refused:\n\nbad\udcff")
    assert str(two_lines) == "a\nb.xml:3:1: refused:  bad\\udcff"


def test_errors_cross_processes():
    error = ScenarioError([Problem("a.yaml", 1, 2, "mass", "is -1", "more")])
    assert (
        str(pickle.loads(pickle.dumps(error))) == str(error) == "a.yaml:1:2: mass: is -1; valid would be more"
    )
