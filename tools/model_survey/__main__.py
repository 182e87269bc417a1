"""`python -m tools.model_survey`: run the survey, write the page and the report."""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import distributions
from pathlib import Path

from reports import model_page
from tools.model_survey.page import write_page
from tools.model_survey.run import survey

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "reports" / "out" / "importers"
PAGE = ROOT / "docs" / "importers.md"


def main() -> None:
    """Run everything; with --page write the page of the last survey again."""
    (folder,) = (ROOT / ".corpora" / "lib").glob("python*/site-packages")
    stored = OUT / "survey.json"
    if "--page" not in sys.argv:
        begin = time.monotonic()
        document = survey(folder)
        document["seconds"] = time.monotonic() - begin
        OUT.mkdir(parents=True, exist_ok=True)
        stored.write_text(json.dumps(document), encoding="utf-8")
        print(f"{len(document['files'])} files in {document['seconds']:.0f} s")
        print(f"report: {model_page.write(OUT, document)}")
    document = json.loads(stored.read_text(encoding="utf-8"))
    packages = {d.name: d.version for d in distributions(path=[str(folder)])}
    PAGE.write_text(write_page(document, dict(sorted(packages.items()))), encoding="utf-8")
    print(f"page: {PAGE}")


if __name__ == "__main__":
    main()
