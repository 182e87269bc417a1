"""model.sarif: the findings about model files as a SARIF log, for code scanning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reports.stored_results import Record
from reports.verdicts import needs_attention

SARIF_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"


def sarif(document: Record) -> dict[str, Any]:
    """Write the findings for code scanning.

    Returns:
        A SARIF 2.1.0 log: a result per cause at the line of the file, per other finding, and per bad file.

    """
    results = [
        _sarif_result(
            f"importer/{cause['field'].replace(' ', '-')}", cause["sentence"], source, cause["engine"]
        )
        for file in document["files"]
        for cause in file["causes"]
        if not cause["known"]
        for source in [cause["source"] if cause["source"]["line"] else {"file": file["file"], "line": 1}]
    ]
    for file in document["files"]:
        for row in file["rows"]:
            if needs_attention(row) and not row["diagnosis"]:
                source = {"file": file["file"], "line": 1}
                text = f"{row['engine']}: {row['reason']}"
                results.append(_sarif_result(f"importer/{row['verdict']}", text, source, row["engine"]))
    for problem in document["problems"]:
        place = {name: max(1, problem.get(name, 1)) for name in ("line", "column")}
        source = {"file": problem["file"], **place}
        results.append(_sarif_result("file/bad", problem["text"], source, ""))
    rules = [{"id": name} for name in dict.fromkeys(result["ruleId"] for result in results)]
    driver = {"name": "Plumbline", "version": document["version"], "rules": rules}
    return {
        "$schema": SARIF_SCHEMA,
        "version": "2.1.0",
        "runs": [{"tool": {"driver": driver}, "results": results}],
    }


def _sarif_result(rule: str, text: str, source: Record, engine: str) -> Record:
    place = {
        "artifactLocation": {"uri": Path(source["file"]).as_posix()},
        "region": {"startLine": source["line"], "startColumn": source.get("column", 1)},
    }
    return {
        "ruleId": rule,
        "level": "error",
        "message": {"text": text},
        "locations": [{"physicalLocation": place}],
        "partialFingerprints": {"plumbline/v1": f"{rule} {engine} {source['file']}"},
    }
