"""The search for the version that changed an answer: halving, versions that cannot be used, real versions."""

import json
from importlib import metadata
from itertools import pairwise
from pathlib import Path

import pytest

from plumbline.engines.environments import PublishedVersions
from plumbline.studies import version_search
from plumbline.studies.version_search import (
    NoSearch,
    VersionAnswer,
    VersionUnusable,
    choose_versions,
    find_change,
)
from tests.helpers.commands import invoke
from tests.helpers.requirements import needs_uv, refuse_packages, require_package_index

VERSIONS = [f"1.{k}" for k in range(40)]
INSTALLED = metadata.version("mujoco")
# An inertial origin with rpy, which MuJoCo ignored before 3.14
ARM = """<robot name="arm"><link name="base"/><link name="upper"><inertial>
<origin xyz="0.1 0.02 0.3" rpy="0.3 -0.2 0.5"/><mass value="2.5"/>
<inertia ixx="0.04" ixy="0.001" ixz="-0.002" iyy="0.05" iyz="0.003" izz="0.03"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
</robot>
"""


def search(change_at, unusable=()):
    asked = []

    def ask(version):
        asked.append(version)
        if version in unusable:
            raise VersionUnusable("it cannot be imported")
        return VersionAnswer(str(VERSIONS.index(version) >= change_at), f"answer of {version}")

    return find_change("engine", VERSIONS, ask, lambda *_: None), asked


def test_neighbours_that_differ_are_found_by_halving():
    for before, after in pairwise(VERSIONS):
        change, asked = search(VERSIONS.index(after))
        assert (change.last_before, change.first_after) == (before, after)
        assert len(asked) == len(set(asked)) <= 2 + 6, "log2 of 38, rounded up"
        assert f"since {after}" in change.sentence
        assert change.note == f"{before} answers otherwise than {after}, the next version."


def test_versions_that_cannot_be_used_are_skipped_and_named():
    unusable = {"1.0", "1.39", "1.19", "1.20", "1.21"}
    change, asked = search(20, unusable)
    assert (change.last_before, change.first_after) == ("1.18", "1.22")
    assert (change.oldest, change.newest) == ("1.1", "1.38")
    assert set(change.skipped) == unusable and set(change.skipped.values()) == {"it cannot be imported"}
    assert len(asked) == len(set(asked))


def test_ends_that_answer_alike_are_no_change():
    change, asked = search(40)
    assert (change.last_before, change.first_after) == ("", "")
    assert asked == [VERSIONS[0], VERSIONS[-1]]
    assert "1.0 and 1.39 answer alike" in change.sentence
    assert change.note == "1.0, the oldest version that was tried, answers alike."


def test_two_versions_have_to_answer():
    with pytest.raises(NoSearch, match=r"fewer than two versions .* 1\.0: it cannot be imported"):
        search(3, VERSIONS[:-1])


@pytest.fixture
def published(monkeypatch):
    found = PublishedVersions(("3.1.0", "3.2.0", "3.3.0", "4.0.0"), ("2.9.0",))
    monkeypatch.setattr(version_search, "published_versions", lambda package: found)


@pytest.mark.parametrize(
    ("good", "bad", "chosen"),
    [
        ("", "", ["3.2.0", "3.3.0", "4.0.0"]),
        ("3.3", "", ["3.3.0", "4.0.0"]),
        ("", "3.3", ["3.2.0", "3.3.0"]),
        ("4.0.0", "", ["3.2.0", "3.3.0", "4.0.0"]),
        ("", "3.2.0", ["3.2.0", "3.3.0", "4.0.0"]),
        ("3.2.0", "", ["3.2.0", "3.3.0", "4.0.0"]),
        ("4.0.0", "3.3.0", ["3.3.0", "4.0.0"]),
    ],
)
def test_the_ends_may_be_given_in_any_order(published, good, bad, chosen):
    versions, notes = choose_versions("mujoco", ">=3.2", good, bad)
    assert versions == chosen
    assert notes == [
        "without a wheel for this Python and system, not tried: 2.9.0",
        "outside of >=3.2, which the column supports, not tried: 3.1.0",
    ]


@pytest.mark.parametrize(
    ("version", "reason"),
    [
        ("2.9.0", "it has no wheel"),
        ("3.1.0", "the column supports versions >=3.2"),
        ("7", "there are: 3.2.0"),
    ],
)
def test_an_end_that_cannot_be_used_is_refused_with_the_reason(published, version, reason):
    with pytest.raises(NoSearch, match=reason):
        choose_versions("mujoco", ">=3.2", version, "4.0.0")


def run(*arguments):
    return invoke("bisect", *map(str, arguments))


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "name the importer: --engine mujoco"),
        (["--engine", "mujco"], "did you mean 'mujoco'?"),
        (["--engine", "mujoco", "--good", "three"], "'three' is not a version"),
        (["--engine", "mujoco", "--bad", "latest"], "'latest' is not a version"),
        (["some/key"], "makes them"),
    ],
)
def test_bad_usage_exits_with_2(arm, options, message):
    result = run(arm, *options)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.replace("│", "").split())


def test_a_bad_model_file_exits_with_2_and_its_line(arm, monkeypatch):
    monkeypatch.setattr(version_search, "published_versions", lambda _: PublishedVersions((INSTALLED,), ()))
    arm.write_text(ARM.replace('"2.5"', '"-2.5"'))
    result = run(arm, "--engine", "mujoco")
    assert result.exit_code == 2 and "arm.urdf:2:" in result.stderr


@needs_uv
def test_without_network_the_reason_is_reported(arm, monkeypatch, tmp_path):
    refuse_packages(monkeypatch, tmp_path)
    monkeypatch.setenv("UV_TOOL_DIR", str(tmp_path / "tools"))
    result = run(arm, "--engine", "mujoco")
    assert result.exit_code == 3
    assert "uv cannot list the versions of mujoco" in result.stderr


@pytest.mark.full
@pytest.mark.timeout(900)
def test_real_versions(arm):
    """MuJoCo 3.13.0 reads a link's inertia without the rpy of its origin, 3.14.0 with it."""
    require_package_index()
    result = run(arm, "--engine", "mujoco", "--good", "3.14.0", "--bad", "3.13.0", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert (document["last_before"], document["first_after"]) == ("3.13.0", "3.14.0")
    assert "reads the inertia of body upper as ((0.04," in document["answers"]["3.13.0"]
    assert document["answers"]["3.14.0"] == "reads what the file says"
    assert Path(arm).name in document["answers"]["3.13.0"]
