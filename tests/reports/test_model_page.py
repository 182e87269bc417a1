"""The page of `plumbline model`: static, escaped, accessible, and complete in what does not agree."""

from __future__ import annotations

import re
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest

from plumbline.cli.model_commands import model_document
from plumbline.model_files.model_run import ModelPlan, run_model_files
from reports import model_page, robot_drawing

EVIL = "\"><img src=x onerror=alert(1)><script>alert('2')</script>"
# Pinocchio keeps its own gravity; a massless moving body is refused by MuJoCo's URDF reader
MOON = f"""<mujoco model={quoteattr(EVIL)}><option gravity="0 0 -1.62"/>
<worldbody><body name={quoteattr(EVIL)}><joint name={quoteattr(EVIL)} axis="0 1 0" range="0 1"/>
<inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/></body></worldbody></mujoco>
"""
MASSLESS = f"""<robot name="r"><link name="base"/><link name={quoteattr(EVIL)}/>
<joint name="j" type="continuous"><parent link="base"/><child link={quoteattr(EVIL)}/>
<axis xyz="0 0 1"/></joint></robot>
"""


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a file with a cause, one that is refused, and one that cannot be used."""
    folder = tmp_path_factory.mktemp("model page")
    files = {"moon.xml": MOON, f"{'massless_' * 9}.urdf": MASSLESS, "bad <b>.urdf": "<robot><link/></robot>"}
    for name, text in files.items():
        (folder / name).write_text(text)
    plan = ModelPlan(tuple(str(folder / name) for name in files), ("mujoco", "pinocchio"), state_count=2)
    document = model_document(run_model_files(plan, lambda *_: None))
    return model_page.write(folder, document)


def test_the_page_names_causes_refusals_and_bad_files_and_escapes_them(page_file):
    text = page_file.read_text(encoding="utf-8")
    assert "<script" not in text and "<img" not in text and "<b>.urdf" not in text
    assert "reads the gravity of the model as (0, 0, -9.81)" in text
    assert "1 cause named and proved" in text
    assert "Files that cannot be used" in text
    assert "largest error over what rounding explains" in text and "Rounding explains" in text
    for name in ("command", "date", "commit", "Plumbline"):
        assert f"<dt>{name}</dt>" in text
    assert re.search(r'gravity force</td><td class="r">[1-9.]', text), "the size of an error"
    assert "mjMINVAL" in text, "a refusal is an answer"


def test_the_page_gives_a_line_per_file_and_marks_the_bodies_that_differ():
    entry = {"name": "", "parent": "", "origin": [0, 0, 0]}
    bodies = [
        entry | {"name": n, "parent": p, "origin": o}
        for n, p, o in (
            ("base", "", [0, 0, 0]),
            ("upper", "base", [0, 0, 1]),
            ("lower", "upper", [0, 0, 1]),
            ("tip", "lower", [1, 0, 1]),
        )
    ]
    marked = {"upper": ["dart: mass"], "lower": ["dart: axis"], "tip": ["drake: center"]}
    drawing = robot_drawing.draw(bodies, marked)
    assert [mark["text"] for mark in drawing["numbers"]] == ["1–2", "3"], "two bodies at one point"
    assert [entry["name"] for entry in drawing["legend"]] == list(marked)
    assert len(drawing["lines"]) == 3
    assert [label["text"] for label in drawing["labels"]] == ["base", "upper", "tip"], "where there is room"
    assert max(drawing["size"]) < 300, "a small robot has a small drawing"
    assert max(robot_drawing.draw(bodies[:1], {})["size"]) < 200
    assert robot_drawing.draw([], {}) is None


def test_files_that_differ_and_files_that_agree(page_file):
    text = page_file.read_text(encoding="utf-8")
    assert text.count('href="#file-') == 2, "an overview where there are several files"
    assert "pinocchio: gravity" not in text, "gravity belongs to no body"
    assert "1 × limit" in text and "no body" not in text


@pytest.mark.browser
def test_the_page_makes_no_request_and_says_nothing_on_the_console(open_file, page_file):
    page = open_file(page_file, offline=True, viewport={"width": 320, "height": 800})
    assert page.locator("svg.robot").first.is_visible()
    for summary in page.locator("summary").all():
        summary.click()
    overflow = page.evaluate("document.documentElement.scrollWidth - innerWidth")
    page.wait_for_timeout(200)
    assert overflow <= 0, "a phone scrolls the tables, not the page"


@pytest.mark.browser
def test_axe_finds_no_violation(open_file, page_file, violations):
    page = open_file(page_file, bypass_csp=True, offline=True)
    for summary in page.locator("summary").all():
        summary.click()
    assert violations(page) == []
