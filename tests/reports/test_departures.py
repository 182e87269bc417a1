"""When engines provably leave the true motion: from the stored curves to the page."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.invariants import DEPARTURE
from plumbline.truth.certificate_proof import ProvedMotion
from reports import html_report
from reports.earlier_runs import History
from reports.stored_results import Results
from tests.reports.test_report import decoded_chunks

RADIUS = 2e-4  # m, so large that it matters
METHOD = ProvedMotion(None, {}, 1.9e-25).method
PLAIN, NAMES = "planar-small", ("double-tumbling", "chain-10")  # the second has a run that blows up


@pytest.fixture(scope="module")
def results(example_run, tmp_path_factory):
    folder = shutil.copytree(example_run, tmp_path_factory.mktemp("departures") / "run")
    whole = Results.load(folder).restricted_to({PLAIN, *NAMES})
    proved = {
        name: about
        | ({"truth": METHOD, "is_proved": True, "truth_uncertainty": RADIUS} if name in NAMES else {})
        for name, about in whole.scenarios.items()
    }
    return replace(whole, scenarios=proved)


@pytest.fixture(scope="module")
def shown(results):
    chunks = decoded_chunks(html_report.render(results, History()))
    return {name: chunks[f"scenario-{k}"]["departures"] for k, name in enumerate(results.scenarios)}


@pytest.mark.parametrize("name", NAMES)
def test_every_run_has_the_first_sample_beyond_distance_and_radius(results, shown, name):
    curves, found = results.table("curves"), shown[name]
    assert found["distance"] == DEPARTURE == 1e-3
    mine = curves["scenario"] == name
    pairs = dict.fromkeys(zip(curves["engine"][mine], curves["integrator"][mine], strict=True))
    assert [(run["engine"], run["integrator"]) for run in found["runs"]] == list(pairs)
    for run in found["runs"]:
        rows = mine & (curves["engine"] == run["engine"]) & (curves["integrator"] == run["integrator"])
        samples = sorted(zip(curves["t"][rows], curves["position_error"][rows], strict=True))
        left = next((t for t, error in samples if not error <= 1e-3 + RADIUS), None)
        assert run["left"] == left and run["until"] == pytest.approx(4.0)
        assert run["resolution"] == pytest.approx(curves["resolution"][rows][0], rel=1e-5)
        assert run["kind"] == "step"
    lefts = [run["left"] for run in found["runs"]]
    assert None in lefts and any(lefts), "one stays, one leaves"
    if name == "chain-10":
        blown = curves["scenario"] == name
        assert not np.isfinite(curves["position_error"][blown]).all()


def test_only_proved_motions_have_a_table(shown):
    assert shown[PLAIN] is None and all(shown[name] for name in NAMES)


@pytest.mark.browser
@pytest.mark.timeout(60)
def test_the_page_tells_step_certificate_and_time(open_file, results, shown):
    path = html_report.write(results)
    page = open_file(path, f"#scenario={NAMES[0]}&engine=mujoco", viewport={"width": 1280, "height": 900})
    page.wait_for_selector("html[data-shown]")
    lines = page.locator("table.departures tbody tr")
    runs = shown[NAMES[0]]["runs"]
    assert lines.count() == len(runs)
    for run, line in zip(runs, lines.all_inner_texts(), strict=True):
        assert run["integrator"] in line and f"step {run['resolution']:.3g}"[:7] in line
        wanted = "stays within 0.001 m up to 4.00 s" if run["left"] is None else f"at {run['left']:.4g}"
        assert wanted in line, (wanted, line)
    note = page.locator("p.why").filter(has_text="The true motion is").inner_text()
    assert METHOD in note and "0.001 m" in note and "No finished run of Pinocchio, maximal" in note
    for width in (1280, 400):
        page.set_viewport_size({"width": width, "height": 900})
        for _ in range(200):  # of 50 ms: the page is laid out again some time after; its policy forbids eval
            if fits := page.evaluate("document.documentElement.scrollWidth <= innerWidth"):
                break
            page.wait_for_timeout(50)
        assert fits
    page.goto(path.as_uri() + f"#scenario={PLAIN}&engine=mujoco")
    page.locator("h1.cell-title", has_text=PLAIN).wait_for()
    assert page.locator("table.departures").count() == 0
