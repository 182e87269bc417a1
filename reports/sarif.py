"""SARIF logs for code scanning: model.sarif of model files, findings.sarif of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from plumbline import __version__
from plumbline.storage.results_store import write_atomically
from reports.stored_results import Record, Results
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
    return _log(results, document["version"])


def write(results: Results) -> Path:
    """Write findings.sarif beside the stored results: a result per finding, at the smallest scenario's file.

    A recorded finding is suppressed.
    """
    found = []
    for finding in results.findings:
        scenario = finding["scenarios"][0]
        file = results.scenarios[scenario]["file"] or scenario
        count = f"{len(finding['rows'])} rows in {len(finding['scenarios'])} scenarios"
        text = f"{finding['title']}: {finding['sentence']}; {count}"
        one = _sarif_result(finding["name"], text, {"file": file, "line": 1}, finding["engine"])
        one["partialFingerprints"] = {"plumbline/v2": finding["name"]}
        if finding["known_issue"] is not None:
            one |= {
                "level": "note",
                "suppressions": [{"kind": "external", "justification": finding["known_issue"]}],
            }
        found.append(one)
    path = results.folder / "findings.sarif"
    write_atomically(path, json.dumps(_log(found, __version__), ensure_ascii=False, indent=1).encode())
    return path


def _log(results: list[Record], version: str) -> Record:
    rules = [{"id": name} for name in dict.fromkeys(result["ruleId"] for result in results)]
    driver = {"name": "Plumbline", "version": version, "rules": rules}
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
