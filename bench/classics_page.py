"""Write docs/benchmarks.md from the stored figures of `bench.classics`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

TEXTS = Path(__file__).with_name("classics.md")
THRESHOLDS = {
    "A01": 1e-3,
    "A02": 1e-3,
    "A03": 1e-3,
    "A04": 1e-3,
    "A05": 1e-3,
    "cart-pole": 1e-6,
    "NESC-2": 1e-6,
}


def write_page(stored: Mapping[str, Mapping[str, Any]]) -> str:
    """Fill the texts of classics.md with the tables of what was measured.

    Args:
        stored: by problem, what `bench.classics` measured.

    Returns:
        The page: each section followed by the tables of its problem.

    """
    head, *sections = TEXTS.read_text(encoding="utf-8").split("\n## ")
    processors = sorted({str(found["processor"]) for found in stored.values()})
    versions = {name: v for found in stored.values() for name, v in found["versions"].items()}
    known = "; ".join(
        f"{name} {versions[name]}" for name in ("mujoco", "pinocchio", "exudyn") if name in versions
    )
    page = [head.format(processors=", ".join(processors), versions=known), _summary(stored)]
    for section in sections:
        title, _, text = section.partition("\n")
        found = stored.get(title.partition(":")[0], {})
        page.append(f"## {title}\n{text.rstrip()}")
        page += [table for table in (_values(found), _motions(title, found), _states(found)) if table]
    return "\n\n".join(part.strip() for part in page) + "\n"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2g}"


def _summary(stored: Mapping[str, Mapping[str, Any]]) -> str:
    """The best limit of each engine, by problem."""
    rows = []
    for name, threshold in THRESHOLDS.items():
        motions = stored.get(name, {}).get("motions", [])
        best: dict[str, float] = {}
        for motion in motions:
            engine = motion["engine"].partition("-")[0]
            errors = [run["error"] for run in motion.get("runs", []) if "error" in run]
            errors += [motion["limit_error"]] if "limit_error" in motion else []
            best[engine] = min([*errors, best.get(engine, float("inf"))])
        engines = ("reference", "mujoco", "pinocchio", "exudyn")
        cells = [_number(best[e]) if best.get(e, float("inf")) < float("inf") else "–" for e in engines]
        rows.append([name, f"{threshold:g}", *cells])
    return _table(("problem", "error asked for", "reference", "MuJoCo", "Pinocchio", "Exudyn"), rows)


def _values(found: Mapping[str, Any]) -> str:
    rows = []
    for value in found.get("values", []):
        published, ours = value["published"], value["ours"]
        gap = "–" if published is None else f"{published - ours:.1e}"
        shown = "–" if published is None else f"{published!r}"
        rows.append([value["name"], shown, f"{ours!r}", f"{value['uncertainty']:.0e}", gap, value["unit"]])
    head = ("quantity", "published", "here", "uncertainty", "published − here", "unit")
    return _table(head, rows) if rows else ""


def _motions(title: str, found: Mapping[str, Any]) -> str:
    """Errors of the finest runs, of their limits, and the cost of the error that is asked for."""
    threshold = THRESHOLDS.get(title.partition(":")[0], 0.0)
    motions = found.get("motions", [])
    reached = {id(m): _cheapest(m, threshold) for m in motions}
    least = min((run["cpu"] for run in reached.values() if run), default=1.0)
    rows = []
    for motion in motions:
        name = [motion["engine"], motion["integrator"]]
        if "unsupported" in motion:
            rows.append([*name, f"not compared: {motion['unsupported']}", *["–"] * 4])
            continue
        finest = motion["runs"][-1]
        failure = finest.get("failure")
        run = reached[id(motion)]
        rows.append([
            *name,
            f"failed: {failure}" if failure else f"{_number(finest['error'])} at {finest['resolution']:.3g}",
            f"{finest['cpu']:.2g}",
            _number(motion.get("limit_error")),
            _number(motion.get("limit_uncertainty")),
            f"{run['cpu'] / least:.2g} (at {run['resolution']:.3g})" if run else "not reached",
        ])  # fmt: skip
    head = (
        "engine", "integrator", "error of the finest run", "its CPU s", "error of the limit", "uncertainty",
        f"cost of {threshold:g}",
    )  # fmt: skip
    return _table(head, rows) if rows else ""


def _cheapest(motion: Mapping[str, Any], threshold: float) -> dict[str, Any] | None:
    runs = [run for run in motion.get("runs", []) if run.get("error", float("inf")) <= threshold]
    return min(runs, key=lambda run: float(run["cpu"])) if runs else None


def _states(found: Mapping[str, Any]) -> str:
    rows = []
    for answer in found.get("states", []):
        reason = answer.get("unsupported")
        cells = [f"not compared: {reason}", "–"] if reason else [
            _number(answer["acceleration"]), _number(answer["angular_acceleration"])
        ]  # fmt: skip
        rows.append([answer["engine"], *cells])
    head = ("engine", "r̈ at four states, relative error", "ω̇′, relative error")
    return _table(head, rows) if rows else ""
