"""Pages of `plumbline model`: model.html, junit.xml and model.sarif beside the stored model.json.

Input: the document that the command prints with --json.  Output: files in the same folder; nothing runs.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections import Counter
from operator import itemgetter
from pathlib import Path

from plumbline.model.grouping import grouped
from plumbline.storage.results_store import write_atomically
from reports import html_report, junit, robot_drawing
from reports.sarif import sarif
from reports.stored_results import Record, replace_unprintable
from reports.verdicts import count_verdicts, needs_attention, rank

MADE = {"Plumbline": "version", "commit": "commit", "date": "started", "command": "command"}


def write(folder: Path, document: Record) -> Path:
    """Write model.json, model.html, junit.xml and model.sarif in place of the results of a run.

    Args:
        document: result of a run, as the command prints it with --json.

    Raises:
        OSError: a file cannot be written.

    """
    document = replace_unprintable(document)
    text = json.dumps(document, ensure_ascii=False, indent=1)
    (folder / "results.json").unlink(missing_ok=True)
    write_atomically(folder / "model.json", text.encode())
    path = folder / "model.html"
    write_atomically(path, render(document).encode())
    suites = ET.Element("testsuites", name="plumbline model")
    for file in document["files"]:
        junit.add_suite(suites, file["file"], file["rows"], {"robot": str(file["name"])})
    write_atomically(folder / "junit.xml", ET.tostring(suites, encoding="utf-8", xml_declaration=True))
    write_atomically(folder / "model.sarif", json.dumps(sarif(document), indent=1).encode())
    return path


def render(document: Record) -> str:
    """Render the page.

    Returns:
        HTML, one file without a script.

    """
    files = []
    for file in document["files"]:
        engines = grouped(file["rows"], itemgetter("engine"))
        files.append(
            {
                **file,
                "columns": {name: {row["quantity"]: row for row in rows} for name, rows in engines.items()},
                "worst": {name: max(rows, key=rank) for name, rows in engines.items()},
                # what no cause explains; the table has the words of whole columns
                "findings": [
                    row
                    for row in file["rows"]
                    if row["quantity"] != "all" and needs_attention(row) and not row["diagnosis"]
                ],
                "errors": [row for row in file["rows"] if row["verdict"] == "disagrees"],
                "drawing": robot_drawing.draw(file["drawing"], _marked(file)),
                "counts_not_compared": Counter(feature["what"] for feature in file["not_compared"]),
                "counts_ambiguous": Counter(feature["what"] for feature in file["ambiguous"]),
            }
        )
    return html_report.render_page(
        "model.html",
        sentence=_sentence(document),
        engines=document["engines"],
        made=[(name, document[key]) for name, key in MADE.items() if document.get(key)],
        problems=document["problems"],
        files=files,
        counts=count_verdicts(row for file in document["files"] for row in file["rows"]),
        is_state_given=document["options"]["at"] is not None,
    )


def _sentence(document: Record) -> str:
    causes = sum(len(file["causes"]) for file in document["files"])
    bad = sum(any(needs_attention(row) for row in file["rows"]) for file in document["files"])
    count = len(document["files"])
    what = f"{count} model file{'s' * (count != 1)}"
    if not bad:
        return f"{what}: every importer that reads {'it' if count == 1 else 'them'} reads the same robot"
    return f"{what}, {bad} read differently: {causes} cause{'s' * (causes != 1)} named and proved"


def _marked(file: Record) -> dict[str, list[str]]:
    """What differs in each body, an entry per importer."""
    fields: dict[str, dict[str, list[str]]] = {}
    for cause in file["causes"]:
        for body in cause["bodies"]:
            fields.setdefault(body, {}).setdefault(cause["engine"], []).append(cause["field"])
    return {
        body: [f"{engine}: {', '.join(dict.fromkeys(found))}" for engine, found in by_engine.items()]
        for body, by_engine in fields.items()
    }
