"""The page of licences: every package of base, extras and servers, with what its metadata says."""

import json
import re
import shutil
import subprocess
import tomllib
from importlib.metadata import Distribution, distributions

import pytest

from tests.helpers import ROOT
from tools.engine_servers import ENGINE_SERVERS, IMPORTERS_PYTHON

PAGE = (ROOT / "docs/licences.md").read_text(encoding="utf-8")
LISTED = dict(re.findall(r"^\| ([\w.-]+) \| [^|]+ \| ([^|]+) \|$", PAGE, re.MULTILINE))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def names(requirements):
    return {re.match(r"[\w.-]+", one)[0] for one in requirements}


def licence(found: Distribution):
    """What the metadata says: the expression, else a short licence field, else the classifier."""
    about = found.metadata
    field = about.get("License") or ""
    classifiers = [
        c.rpartition(" :: ")[2] for c in about.get_all("Classifier") or [] if c.startswith("License")
    ]
    return about.get("License-Expression") or (field if 0 < len(field) < 40 else (classifiers or [""])[-1])


def test_every_package_of_base_and_extras_is_listed():
    wanted = names(PROJECT["dependencies"]).union(*map(names, PROJECT["optional-dependencies"].values()))
    assert wanted | {"drake", "dartpy"} == {*LISTED} - {"package"}


def test_licences_are_those_of_the_metadata():
    folders = [None, *IMPORTERS_PYTHON.parents[1].glob("lib/python3.*/site-packages")]
    seen = {}
    for folder in folders:
        for found in distributions() if folder is None else distributions(path=[str(folder)]):
            seen.setdefault((found.metadata["Name"] or "").lower(), licence(found))
    compared = {name: seen[name] for name in LISTED if name in seen}
    assert len(compared) >= len(PROJECT["dependencies"])
    assert compared == {name: LISTED[name] for name in compared}


@pytest.mark.skipif(shutil.which("cargo") is None, reason="cargo is not installed")
def test_licences_of_rapiers_crates_are_listed():
    command = ["cargo", "metadata", "--offline", "--format-version", "1"]
    done = subprocess.run(command, cwd=ROOT / "servers/rapier", capture_output=True, text=True)
    if done.returncode:
        pytest.skip("its crates are not on this machine; `make engines` fetches them")
    line = next(row for row in PAGE.splitlines() if row.startswith("| Rapier"))
    for package in json.loads(done.stdout)["packages"]:
        for one in re.findall(r"[\w.-]+", re.sub(r"\b(OR|AND)\b", "", package["license"])):
            assert one in line or one.endswith("LLVM-exception") or one == "WITH", (package["name"], one)


def test_the_list_of_servers_agrees_with_the_page():
    for server in ENGINE_SERVERS:
        row = next(
            r for r in PAGE.splitlines() if f"servers/{server.name}" in r or f"{server.name}_server" in r
        )
        assert server.licence in row or server.licence in PAGE or "Various" in row
