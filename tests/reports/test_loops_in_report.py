"""Loops in the report: the initial state drawn, closing joints marked, what of wrenches is determinate."""

import numpy as np
import pytest

import reports
from plumbline.execution.runner import save
from reports.stored_results import Results
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.runs import run_scenarios
from tests.reports.test_report import decoded_chunks

NAMES = ("bricard", "flyball-governor")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    result = run_scenarios(NAMES, ["reference"], "state", random_state_count=1)
    place = tmp_path_factory.mktemp("loops") / "run"
    save(result, place, "-")
    reports.write(place)
    return place


@pytest.fixture(scope="module")
def shown(folder):
    chunks = decoded_chunks((folder / "report.html").read_text(encoding="utf-8"))
    order = list(Results.load(folder).scenarios)
    return {name: chunks[f"scenario-{order.index(name)}"] for name in NAMES}


def test_the_initial_state_is_drawn_with_every_joint(shown):
    for name in NAMES:
        scenario, motion = catalogue_scenario(name), shown[name]["motion"]
        model = scenario.model
        assert motion["bodies"] == model.n and motion["base"] == ["", "t = 0"]
        drawn = motion["r"].reshape(-1, 3) * motion["span"] / 32767
        np.testing.assert_allclose(drawn, scenario.state.r, atol=motion["span"] / 32767)
        assert [shape["is_free"] for shape in motion["shape"]] == model.free.tolist()
        assert all(
            shape["is_apart"] for shape, is_rod in zip(motion["shape"], model.rods, strict=True) if is_rod
        )
        ends = [[shape["far"], shape["body"]] for shape in motion["shape"]]
        assert np.array_equal(ends, model.body)
        assert [bool(shape["half"]) for shape in motion["shape"]] == [k < model.n for k in range(len(ends))]


def test_rows_that_close_and_determinate_wrenches_are_told(shown):
    bricard, governor = (shown[name]["scenario"]["loops"] for name in NAMES)
    assert bricard == {"closing": ["hinge"], "rows": 6, "independent": 5, "determinate": [5] * 6}
    assert governor == {"closing": ["rod", "rod"], "rows": 12, "independent": 12, "determinate": [6] * 6}


@pytest.mark.timeout(60)
def test_the_page_shows_the_mechanism(open_file, folder):
    page = open_file(folder / "report.html", "#scenario=bricard&engine=reference")
    page.wait_for_selector("html[data-shown]")
    text = page.inner_text("main")
    assert "6, 5 of them independent" in text and "5 of 6 components" in text
    assert "Squares are the joints that close loops" in text
    assert page.locator(".stage canvas").count() == 1 and page.locator("input[type=range]").count() == 0
    assert page.evaluate(
        "(() => { const c = document.querySelector('.stage canvas');"
        " return c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some((v) => v > 0); })()"
    )
