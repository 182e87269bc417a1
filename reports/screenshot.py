"""Picture of a report for the README: `python -m reports.screenshot OUT/report.html FILE.png [#view]`."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

BROWSER_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
WIDTH, HEIGHT = 1400, 1000  # px, of the window


def find_chromium() -> str | None:
    """Look for a Chromium on the path.

    Returns:
        Its path, or None.

    """
    return next((found for name in BROWSER_NAMES if (found := shutil.which(name))), None)


def take_screenshot(report: Path, image_path: Path, view: str = "") -> Path:
    """Open the report in Chromium and save the visible part as PNG.

    Args:
        view: the part of the address after the file, for example "#scenario=…&engine=…"; "" for the matrix.

    Returns:
        ``image_path``.

    Raises:
        RuntimeError: no Chromium is on the path.

    """
    from playwright.sync_api import sync_playwright

    found = find_chromium()
    if not found:
        raise RuntimeError(f"no Chromium here: none of {', '.join(BROWSER_NAMES)} is on the path")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto(report.resolve().as_uri() + view)
        page.wait_for_selector("html[data-shown]")
        page.wait_for_timeout(300)  # the plots take their size in the next frames
        page.screenshot(path=image_path)
        browser.close()
    return image_path


if __name__ == "__main__":
    take_screenshot(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else "")
