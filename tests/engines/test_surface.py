"""The inventory of the engines' public names: complete, and each declared once."""

import sys
from types import ModuleType

import pytest

from plumbline.engines.surface import (
    SURFACE_ROWS,
    SURFACES,
    SurfaceChanges,
    declared_surface,
    exercised_rows,
    installed_names,
)
from plumbline.execution.runner import compare_surfaces
from plumbline.judging.known_issues import recorded_mistakes
from plumbline.model.datatypes import EngineFailure
from plumbline.processes.worker_pool import WorkerPool
from plumbline.studies.exercised_names import names_of_engine
from plumbline.studies.surface_page import surface_pages
from tests.helpers import ROOT


def test_every_public_name_of_the_installed_engines_is_declared():
    with WorkerPool(1) as workers:
        found = compare_surfaces(workers)
    assert [one.engine for one in found] == list(SURFACES)
    for one in found:
        assert (one.version, one.new, one.vanished) == (declared_surface(one.engine).version, (), ())


@pytest.mark.parametrize("engine", SURFACES)
def test_what_is_compared_by_rows_of_the_surface_is_exercised(engine):
    names = {one.name for one in declared_surface(engine).names if one.detail == SURFACE_ROWS}
    assert names == set(exercised_rows(engine)) and len(names) >= 10


@pytest.mark.full
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("engine", SURFACES)
def test_a_change_of_what_each_exercised_name_returns_turns_a_row_red(engine):
    computed, written = set(names_of_engine(engine)), set(exercised_rows(engine))
    assert computed == written, "run: python -m plumbline.studies.exercised_names"


def test_new_and_vanished_names_are_found(monkeypatch):
    engine = ModuleType("an_engine")
    engine._hidden = lambda: 0
    engine.mj_new, engine.mj_old = (lambda: 0), (lambda: 0)
    engine.Kind = type("Kind", (), {"__module__": "an_engine"})
    engine.other = type("Other", (), {"__module__": "another_package"})
    for function in (engine.mj_new, engine.mj_old):
        function.__module__ = "an_engine"
    monkeypatch.setitem(sys.modules, "an_engine", engine)
    found = installed_names(["an_engine functions", "an_engine classes", "an_engine.vanished members"])
    assert found == {
        ("an_engine functions", "mj_new"), ("an_engine functions", "mj_old"), ("an_engine classes", "Kind"),
    }  # fmt: skip
    sentence = SurfaceChanges("mujoco", "4.1.0", ("a", "b", "c"), ("d",)).sentence
    assert sentence == "mujoco 4.1.0 has 3 new names about motion (a, b, c) and 1 names fewer (d)"
    assert SurfaceChanges("mujoco", "4.1.0", (), ()).sentence == ""


@pytest.mark.parametrize(
    ("places", "message"),
    [
        ("{m functions: {compared: {rows: [f]}, not yet: {reason: [f]}}}", "declares f twice"),
        ("{m functions: {outside: {too much work: [f]}}}", "f: outside, too much work is no declaration"),
        ("{m functions: {forgotten: {reason: [f]}}}", "f: forgotten, reason is no declaration"),
    ],
)
def test_a_wrong_declaration_is_refused(places, message, tmp_path, monkeypatch):
    folder = tmp_path / "adapters" / "surface"
    folder.mkdir(parents=True)
    (folder / "m.yaml").write_text(f"package: m\nversion: 1\nplaces: {places}\n")
    monkeypatch.setattr("plumbline.engines.surface.ROOT", tmp_path)
    with pytest.raises(EngineFailure, match=message):
        declared_surface.__wrapped__("m")


@pytest.mark.parametrize("path", sorted(surface_pages()))
def test_the_pages_are_up_to_date(path):
    written = (ROOT / "docs" / path).read_text(encoding="utf-8")
    assert written == surface_pages()[path], "run: python -m plumbline.studies.surface_page"


def test_the_scripts_of_mistakes_are_those_that_are_recorded():
    written = {path.name for path in (ROOT / "docs" / "surface").glob("*.py")}
    assert written == {one.script for one in recorded_mistakes() if one.script}


@pytest.mark.parametrize("engine", SURFACES)
def test_an_engine_s_page_has_each_name_once_under_its_place(engine):
    page, surface = surface_pages()[f"surface/{engine}.md"], declared_surface(engine)
    sections = dict(part.partition("\n")[::2] for part in page.split("\n## ")[1:])
    for one in surface.names:
        words = f"`{one.name.rpartition('.')[2]}`"
        expected = int(one.status != "not about motion")
        assert sections[one.place].count(words) == expected, f"{one.place}: {words}"


def test_each_engine_exercises_most_of_what_is_not_outside():
    for engine in SURFACES:
        counts = declared_surface(engine).counts()
        assert len(exercised_rows(engine)) >= 0.9 * (counts["compared"] + counts["not yet"]), engine
