"""Write docs/importers.md from a survey's document."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tools.model_survey.examined import EXAMINED, SINCE, UNPROVED, Examined
from tools.model_survey.run import ALIKE_COUNT, ALIKE_FOLDER, STATES

TITLES = {
    "mujoco": "MuJoCo", "pinocchio": "Pinocchio", "exudyn": "Exudyn", "drake": "Drake", "dart": "DART",
    "pybullet": "PyBullet",
}  # fmt: skip
OUTCOMES = ("right", "explained", "unexplained", "refused", "failed")
HEADINGS = ("right", "different, causes named", "different, no cause proved", "refused", "failed")
MAX_REFUSAL = 100  # characters of a refusal
Cause = tuple[str, str, Mapping[str, Any], str]  # importer, format, cause, file


def format_of(file: str) -> str:
    """Tell the format by the file's name.

    Returns:
        urdf or mjcf.

    """
    return "urdf" if file.endswith(".urdf") else "mjcf"


def outcomes(document: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """Sum up each file's rows of each importer.

    Yields:
        Importer, format, file, one of `OUTCOMES`; nothing where the importer does not read the format.

    """
    for entry in document["files"]:
        verdicts: dict[str, set[str]] = defaultdict(set)
        for row in entry["rows"]:
            verdicts[row["engine"]].add(row["verdict"])
        explained = {cause["engine"] for cause in entry["causes"]} - set(entry.get("unproved", ()))
        for importer, found in verdicts.items():
            if found == {"information"}:
                continue
            if found & {"failed", "harness failed", "not installed"}:
                outcome = "failed"
            elif "unsupported" in found:
                outcome = "refused"
            elif "disagrees" in found:
                outcome = "explained" if importer in explained else "unexplained"
            else:
                outcome = "right"
            yield importer, format_of(entry["file"]), entry["file"], outcome


def causes(document: Mapping[str, Any]) -> Iterator[Cause]:
    """Go through the causes of all files.

    Yields:
        Importer, format, cause, file.

    """
    for entry in document["files"]:
        for cause in entry["causes"]:
            yield cause["engine"], format_of(entry["file"]), cause, entry["file"]


def write_page(document: Mapping[str, Any], packages: Mapping[str, str]) -> str:
    """Write the page.

    Args:
        packages: versions of the robots' packages by name.

    """
    found = list(outcomes(document))
    parts = [
        _introduction(document, packages),
        _summary(found),
        _differences(list(causes(document))),
        _refusals(document),
        _unexplained(document),
        _unusable(document),
    ]
    return "\n\n".join(parts) + "\n"


def _introduction(document: Mapping[str, Any], packages: Mapping[str, str]) -> str:
    engines = document["engines"]
    importers = ", ".join(f"{TITLES[name]} {info['version']}" for name, info in engines.items())
    corpora = ", ".join(f"{name} {version}" for name, version in packages.items())
    counts = Counter(format_of(entry["file"]) for entry in document["files"])
    template = (Path(__file__).parent / "introduction.md").read_text(encoding="utf-8")
    return template.strip().format(
        urdf=counts["urdf"], mjcf=counts["mjcf"], states=STATES,
        unusable=len({problem["file"] for problem in document["problems"]}), alike_folder=ALIKE_FOLDER,
        alike_count=ALIKE_COUNT, importers=importers, packages=corpora,
    )  # fmt: skip


def _summary(found: Iterable[tuple[str, str, str, str]]) -> str:
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for importer, form, _, outcome in found:
        counts[form, importer][outcome] += 1
    lines = [
        "## Files",
        "",
        f"| format | importer | files | {' | '.join(HEADINGS)} |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for form in ("urdf", "mjcf"):
        for importer in TITLES:
            own = counts[form, importer]
            if own:
                cells = " | ".join(str(own[outcome]) for outcome in OUTCOMES)
                lines.append(f"| {form.upper()} | {TITLES[importer]} | {own.total()} | {cells} |")
    lines += [
        "",
        "*Refused*: the importer gives a reason and no model, which is an answer. *Failed*: it crashed, or a",
        "routine of the engine raised or returned NaN, on massless links for example.",
    ]
    return "\n".join(lines)


def _differences(found: list[Cause]) -> str:
    by_entry: dict[Examined, list[Cause]] = defaultdict(list)
    others: dict[tuple[str, str, str], list[Cause]] = defaultdict(list)
    for cause in found:
        importer, form, record, file = cause
        said = f"{file}: {record['sentence']}"
        entry = next((e for e in EXAMINED if e.fits(importer, form, record["field"], said)), None)
        if entry is not None:
            by_entry[entry].append(cause)
        else:
            others[importer, form, record["field"]].append(cause)
    lines = [
        "## Differences that were examined by hand",
        "",
        "The command named each. A script shows it without Plumbline, with the number that",
        "the format's definition gives. *Left open by the file*: the format does not say what holds.",
        "*Since*: the first version that does so; *or earlier*: the oldest that was tried.",
        "",
        "| importer | format | it | kind | since | files | for example | script |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for entry in (e for e in EXAMINED if e in by_entry):
        own = by_entry[entry]
        files = list(dict.fromkeys(file for *_, file in own))
        script = f"[{entry.script}](importers/{entry.script})" if entry.script else "–"
        lines.append(
            f"| {TITLES[entry.importer]} | {entry.format.upper()} | {entry.title} | {entry.kind} | "
            f"{SINCE[entry.importer, entry.format]} | {len(files)} | {_place(own[0])} | {script} |"
        )
    lines += [
        "",
        "## Other differences that the command names",
        "",
        "Their parameters are proved to explain all quantities; why they are read so was not examined.",
        "",
        "| importer | format | parameter | files | for example |",
        "|---|---|---|---|---|",
    ]
    for (importer, form, field), own in sorted(others.items()):
        files = {file for *_, file in own}
        lines.append(f"| {TITLES[importer]} | {form.upper()} | {field} | {len(files)} | {_place(own[0])} |")
    return "\n".join(lines)


def _place(cause: Cause) -> str:
    *_, record, file = cause
    line = record["source"]["line"]
    owner = record["joint"] or record["body"]
    return f"{_short(file)}{f':{line}' if line else ''} {f'`{owner}`' if owner else ''}".strip()


def _short(file: str) -> str:
    """The package's folder and the file's name."""
    parts = [part for part in file.split("/") if part not in ("cmeel.prefix", "share")]
    return f"{parts[0]}/…/{parts[-1]}" if len(parts) > 2 else "/".join(parts)


def _refusals(document: Mapping[str, Any]) -> str:
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for entry in document["files"]:
        for row in entry["rows"]:
            if row["verdict"] in ("unsupported", "failed"):
                counts[row["engine"], format_of(entry["file"])][_pattern(row["reason"])] += 1
    lines = ["## Refusals and failures", "", "| importer | format | files | its words |", "|---|---|---|---|"]
    for (importer, form), own in sorted(counts.items()):
        for words, count in own.most_common():
            lines.append(f"| {TITLES[importer]} | {form.upper()} | {count} | {words} |")
    return "\n".join(lines)


def _pattern(reason: str) -> str:
    """An importer's words without what is of one file only."""
    text = re.sub(r"\x1b?\[[0-9;]*m", "", reason.removeprefix("refused: "))
    text = re.sub(r"/\S+", "…", " ".join(text.split()))
    text = re.sub(r"'[^']*'|\"[^\"]*\"", "'…'", text)
    text = re.sub(r"connects body \S+ to body \S+", "connects two bodies", text)
    text = re.sub(r"\d+", "N", text).replace("|", "/").replace("<", "‹").replace(">", "›")
    return text[:MAX_REFUSAL] + ("…" if len(text) > MAX_REFUSAL else "")


def _unexplained(document: Mapping[str, Any]) -> str:
    lines = [
        "## Differences without a proved cause",
        "",
        "Looked into by hand, where the last column says what was found.",
        "",
        "| importer | file | the first quantity that differs | by hand |",
        "|---|---|---|---|",
    ]
    for importer, _, file, outcome in outcomes(document):
        if outcome == "unexplained":
            entry = next(one for one in document["files"] if one["file"] == file)
            row = next(r for r in entry["rows"] if r["engine"] == importer and r["verdict"] == "disagrees")
            reason = re.sub(r"<|>|\|", " ", row["reason"]).partition(";")[0]
            note = UNPROVED.get((importer, Path(file).name), "–")
            lines.append(f"| {TITLES[importer]} | {_short(file)} | {reason} | {note} |")
    return "\n".join(lines)


def _unusable(document: Mapping[str, Any]) -> str:
    first: dict[str, Mapping[str, Any]] = {}
    for problem in document["problems"]:
        first.setdefault(problem["file"], problem)
    lines = ["## Files that cannot be compared", ""]
    for file, problem in sorted(first.items()):
        text = re.sub(r"/\S+/", "…/", problem["text"].removeprefix(file).lstrip(":0123456789 "))
        text = text.replace("<", "‹").replace(">", "›").replace("|", "/").replace("\n", " ")[:160]
        lines.append(f"- {_short(file)}:{problem['line']}: {text}")
    return "\n".join(lines)
