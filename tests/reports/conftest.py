"""One stored run and one browser for all tests of the pages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from reports import html_report, screenshot
from reports.stored_results import Results
from tests.helpers import example_results
from tests.helpers.pages import watch
from tests.helpers.shared_answers import folder_made_once

AXE = Path(html_report.__file__).parent / "node_modules" / "axe-core" / "axe.min.js"


@pytest.fixture(scope="session")
def example_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a run with every verdict and hostile texts; copy it before changing it."""
    return folder_made_once(tmp_path_factory, "a run with spaces & more", example_results.build)


@pytest.fixture(scope="session")
def catalogue_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a run as large as the default catalogue."""
    folder = tmp_path_factory.mktemp("catalogue")
    return html_report.write(
        Results.load(example_results.build(folder, hostile=False, scenarios=30, samples=200))
    )


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """The system's own Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = screenshot.find_chromium()
    if not found:
        pytest.skip(f"no Chromium here: none of {', '.join(screenshot.BROWSER_NAMES)} is on the path")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def open_file(chromium: Any) -> Iterator[Callable[..., Any]]:
    """Open the page of a file; at the end no error, message, request or dialog may have been seen."""
    contexts, trouble = [], list[str]()

    def opened(path: Path, view: str = "", **options: Any) -> Any:
        contexts.append(chromium.new_context(**options))
        page = contexts[-1].new_page()
        watch(page, path, trouble)
        page.goto(path.as_uri() + view)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert trouble == []


@pytest.fixture
def violations() -> Callable[[Any], list[str]]:
    """Run axe on a page made with ``bypass_csp``; in the dark scheme only the rules about colours."""
    if not AXE.exists():
        pytest.skip("axe-core is not installed: run `npm ci` in reports/ first")

    def run_scheme(page: Any, scheme: str) -> list[str]:
        page.emulate_media(color_scheme=scheme)
        if not page.evaluate("'axe' in window"):
            page.add_script_tag(path=str(AXE))
        rules = ", runOnly: ['color-contrast', 'link-in-text-block']" if scheme == "dark" else ""
        found = page.evaluate(f"axe.run(document, {{resultTypes: ['violations']{rules}}})")
        assert len(found["passes"]) > (15 if scheme == "light" else 0)
        return [
            f"{scheme}: {v['id']}: {n['target']} {n['failureSummary']}"
            for v in found["violations"]
            for n in v["nodes"]
        ]

    def run(page: Any) -> list[str]:
        return [*run_scheme(page, "light"), *run_scheme(page, "dark")]

    return run
