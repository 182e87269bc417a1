"""Data of the page's script: an index of all rows, a chunk per scenario, convergence studies and history."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.judging.rows import LEVEL_OF_RUN, RUN_FAMILY, SHOWN_STYLES
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.invariants import DEPARTURE, LONG_RUN_QUANTITIES, first_departure
from plumbline.model.kinematics import (
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    rotation_vector,
)
from plumbline.model.loops import cut_open, determinate_projectors, singular_values
from plumbline.storage.results_schema import DamagedResults
from reports.chunks import COARSE, ChunkBuilder, decimate, decimate_times, log_scale_codes
from reports.earlier_runs import History
from reports.stored_results import Columns, Record, Results, group_rows
from reports.verdicts import css_class, error_ratio, severity, shown_verdict

CURVE_COLUMNS = (
    "position_error",
    "limit_error",
    "attitude_error",
    "energy_drift",
    "momentum_drift",
    "joint_gap",
    "gap_rate",
    "norm_drift",
)
STUDY_COLUMNS = ("resolution", "error", "cost", "order")
DEFAULT_LONG_RUN_SECONDS = 100.0  # s: the default of the nightly's --long-run-seconds
CATALOGUE_FOLDER = Path(__file__).parent.parent / "scenarios"
RERUN_FOLDER = "repeated"
MAX_MOTION_BYTES = 90_000  # of one scenario's motion, before compression
POSE_LEVELS, DIFFERENCE_LEVELS = 1000, 24  # either side of 0: a pixel, and of magnified differences two
SCALE_BITS = np.uint32(0xFFFE0000)  # of float32: 7 binary digits
_NUMBER_FIELDS = ("value", "tolerance", "uncertainty", "compared_until", "order", "user_rtol", "cpu_time")
_TEXT_FIELDS = (
    "unit",
    "declared_order",
    "alias_of",
    "known_issue",
    "is_declared",
    "diagnosis",
    "derivation",
    "engine_version",
)
_SCENARIO_FIELDS = (
    "family", "title", "purpose", "file", "bodies", "joints", "duration", "sample", "exact", "digest",
    "horizon", "truth", "truth_uncertainty",
)  # fmt: skip

ScenarioTables = dict[str, dict[str, Columns]]  # by table, then scenario


@cache
def _catalogue_files() -> frozenset[str]:
    return frozenset(path.name for path in CATALOGUE_FOLDER.glob("*/*"))


def rerun_command(row: Record, scenario: Record) -> str:
    """Return the command that repeats one cell, in a folder of its own: the run that it explains is kept.

    Args:
        row: a stored row of the cell; long runs are repeated by ``nightly``, all others by ``run``.

    Returns:
        The command line, quoted for a POSIX shell.

    """
    file = str(scenario.get("file") or "")
    ours = not file or file in _catalogue_files()
    what = row["scenario"] if ours else file
    words = ["python", "-m", "plumbline", "run", "--engine", row["engine"]]
    if row["quantity"] in LONG_RUN_QUANTITIES:
        words[3:] = ["nightly", "--engine", row["engine"], "--random", "0", "--no-self-test"]
        asked = (row.get("extra") or {}).get("asked", DEFAULT_LONG_RUN_SECONDS)
        words += [] if asked == DEFAULT_LONG_RUN_SECONDS else ["--long-run-seconds", f"{asked:g}"]
    else:
        words += ["--level", LEVEL_OF_RUN.get(row["level"], "all")]
    words += ["--out", RERUN_FOLDER]
    if scenario.get("family") == RUN_FAMILY:  # a row about the whole run
        return shlex.join(words)
    words[4:4] = [] if what.startswith("-") else [what]
    return shlex.join(words + (["--", what] if what.startswith("-") else []))


def _json_number(value: Any, digits: int = 6) -> Any:
    """Round to a few digits; None where the number is not finite."""
    if value is None or isinstance(value, str):
        return value
    return float(f"{float(value):.{digits}g}") if np.isfinite(float(value)) else None


def index_chunk(results: Results, history: History, texts: dict[str, int]) -> str:
    """Encode every row as a small integer per field, with the lists that the integers index.

    Args:
        results: the run, restricted to the scenarios of the page.
        texts: places of the texts that all chunks share; new ones are added.

    Returns:
        The chunk, see `reports.chunks`; its header is ``Index`` in report_data.d.ts.

    """
    packer = ChunkBuilder(texts)
    lists = {
        "scenario": list(results.scenarios),
        "engine": list(results.engines),
        "verdict": list(SHOWN_STYLES),
        **{
            name: list(dict.fromkeys(row[name] for row in results.rows))
            for name in ("level", "integrator", "quantity")
        },
    }
    header: dict[str, Any] = {f"{name}s": values for name, values in lists.items()} | {
        "families": [s["family"] for s in results.scenarios.values()],
        "titles": [s["title"] for s in results.scenarios.values()],
        "engine_titles": [e["title"] for e in results.engines.values()],
        "glyphs": [style.glyph for style in SHOWN_STYLES.values()],
        "slugs": [css_class(verdict) for verdict in SHOWN_STYLES],
        "reasons": packer.add_texts([row["reason"] for row in results.rows]),
        "commit": results.run.get("commit"),
        "passed": history.last_passed.run["started"] if history.last_passed else None,
    }
    rows: dict[str, Any] = {}
    for name, values in lists.items():
        place = {value: k for k, value in enumerate(values)}
        given = [place[shown_verdict(row) if name == "verdict" else row[name]] for row in results.rows]
        rows[name] = packer.add(np.array(given, np.uint16 if name in ("scenario", "quantity") else np.uint8))
    rows["severity"] = packer.add(np.array([severity(row) for row in results.rows], dtype=np.uint8))
    rows["fresh"] = packer.add(np.array([history.is_new(row) for row in results.rows], dtype=np.uint8))
    rows["ratio"] = packer.add(log_scale_codes(np.array([error_ratio(row) for row in results.rows], float)))
    header["rows"] = rows
    return packer.encode(header)


def scenario_chunk(
    name: str, results: Results, tables: ScenarioTables, texts: dict[str, int]
) -> Callable[[int], str]:
    """Encode everything that the cells of one scenario show.

    Args:
        tables: states, curves and trajectories by scenario.
        texts: places of the texts that all chunks share; new ones are added.

    Returns:
        What makes the chunk, see `reports.chunks`, of the largest number of values per curve, 0 for no curves
        and no motion; its header is ``PackedScenario`` in report_data.d.ts.

    """
    packer = ChunkBuilder(texts)
    scenario = results.scenarios[name]
    details: list[Record] = []
    commands: dict[str, str] = {}
    for index in results.row_indices[name]:
        row = results.rows[index]
        detail: Record = {k: row[k] for k in _TEXT_FIELDS if row.get(k) not in (None, "", False)}
        detail |= {k: row[k] for k in _NUMBER_FIELDS if row.get(k) is not None}
        details.append(detail | {"extra": row.get("extra"), "script": results.scripts.get(row["key"])})
        level = "long" if row["quantity"] in LONG_RUN_QUANTITIES else row["level"]
        if (cell := f"{row['engine']}/{level}") not in commands:  # the same for all rows of a cell
            commands[cell] = rerun_command(row, scenario)
    header = {
        "scenario": {
            k: _json_number(scenario[k]) if isinstance(scenario[k], float) else scenario[k]
            for k in _SCENARIO_FIELDS
            if k in scenario
        }
        | {"loops": _loop_facts(scenario)},
        "places": np.diff(results.row_indices[name], prepend=0).tolist(),
        "rows": packer.add_table(details),
        "commands": commands,
        "departures": _departures(name, results, tables),
        "states": packer.add_table(_state_errors(name, tables, packer)),
    }

    def chunk(points: int) -> str:
        if not points:
            return packer.encode(header | {"curves": None, "motion": None})
        own = packer.continued()
        curves = own.add_table(_error_curves(name, tables, own, points), ["crossing"])
        motion = _motion_frames(name, scenario, tables, own, points)
        return own.encode(header | {"curves": curves, "motion": motion})

    return chunk


def _state_errors(name: str, tables: ScenarioTables, packer: ChunkBuilder) -> list[Record]:
    states = tables["states"].get(name)
    if states is None:
        return []
    error, bound = (states[column].astype(float) for column in ("error", "bound"))
    with np.errstate(divide="ignore", invalid="ignore"):
        quotient = np.where((error == 0) & (bound == 0), 0.0, error / bound)  # both of a body at rest
    codes, sizes = log_scale_codes(quotient, COARSE), np.where(np.isfinite(quotient), quotient, np.inf)
    found = []
    for (engine, quantity), rows in group_rows(states, "engine", "quantity"):
        top = rows[int(np.argmax(sizes[rows]))]
        found.append(
            {
                "engine": engine,
                "quantity": quantity,
                "ratio": packer.add(np.sort(codes[rows])),
                "worst": [int(states["state"][top]), int(states["body"][top]) + 1],
                "bound": _json_number(np.median(bound[rows]), 3),
                "error": _json_number(error[top], 3),
            }
        )
    return found


def _error_curves(name: str, tables: ScenarioTables, packer: ChunkBuilder, points: int) -> list[Record]:
    curves = tables["curves"].get(name, {})
    found: list[Record] = []
    times: dict[bytes, Any] = {}
    for (engine, integrator), rows in group_rows(curves, "engine", "integrator"):
        t = curves["t"][rows].astype(float)
        tolerance = curves["tolerance"][rows].astype(float)
        # the tolerance applies to the error of the limit of the steps, if there is one
        is_limited = "limit_error" in curves and np.isfinite(curves["limit_error"][rows]).any()
        judged = "limit_error" if is_limited else "position_error"
        above = ~(curves[judged][rows] <= tolerance) & np.isfinite(tolerance)
        shared = t.tobytes()
        if shared not in times:
            times[shared] = packer.add(decimate_times(t, points).astype(np.float32))
        one: Record = {
            "engine": engine,
            "integrator": integrator,
            "resolution": _json_number(curves["resolution"][rows][0]),
            "t": times[shared],
            "crossing": _json_number(t[int(np.argmax(above))]) if above.any() else None,
        }
        if np.isfinite(tolerance).any():
            one["judged"] = judged
            one["tolerance"] = packer.add(log_scale_codes(decimate(tolerance, points), COARSE))
        for curve in CURVE_COLUMNS:
            if curve in curves and np.any(np.isfinite(curves[curve][rows]) & (curves[curve][rows] != 0)):
                values = decimate(curves[curve][rows].astype(float), points)
                one[curve] = packer.add(log_scale_codes(values, COARSE))
        found.append(one)
    return found


def _departures(name: str, results: Results, tables: ScenarioTables) -> Record | None:
    """Find when each run leaves a motion that is proved; None where the truth is not proved."""
    scenario, curves = results.scenarios[name], tables["curves"].get(name, {})
    radius = scenario.get("truth_uncertainty")
    if not curves or radius is None or not scenario["is_proved"]:
        return None
    found: list[Record] = []
    for (engine, integrator), rows in group_rows(curves, "engine", "integrator"):
        order = rows[np.argsort(curves["t"][rows], kind="stable")]
        t, error = (curves[k][order].astype(float) for k in ("t", "position_error"))
        kinds = {i["name"]: i["kind"] for i in results.engines[engine]["integrators"]}
        found.append(
            {
                "engine": engine,
                "integrator": integrator,
                "kind": kinds.get(integrator, "step"),
                "resolution": _json_number(curves["resolution"][order][0]),
                "left": first_departure(t, error, radius),
                "until": _json_number(t[-1]),
            }
        )
    return {"distance": DEPARTURE, "runs": found}


def _motion_frames(
    name: str, scenario: Record, tables: ScenarioTables, packer: ChunkBuilder, points: int
) -> Record | None:
    """Encode the poses of the reference, and the differences of every other run from them, scaled per frame.

    A run's pose is r = r_ref + scale·d/127, attitude = exp(scale·w/127) attitude_ref; a difference of 1e-9 m
    keeps two digits that way.
    """
    poses = tables["trajectories"].get(name, {})
    runs = dict(group_rows(poses, "engine", "integrator"))
    if scenario["model"] is None:
        return None
    if not runs:
        return _still(scenario, packer)
    n = int(scenario["bodies"])
    curves = tables["curves"].get(name, {})
    errors = {
        key: np.nan_to_num(np.max(curves["position_error"][rows]), nan=np.inf, posinf=np.inf)
        for key, rows in group_rows(curves, "engine", "integrator")
    }
    engines = dict.fromkeys(engine for engine, _ in runs)
    best = [min((k for k in runs if k[0] == e), key=lambda k: errors.get(k, np.inf)) for e in engines]
    base = next((k for k in best if k[0] == "reference"), best[0])
    r0, p0, t = _run_poses(poses, runs[base], n)
    frames = int(np.clip(MAX_MOTION_BYTES * points / 300 / (n * (14 + 6 * len(best))), 24, points))
    pick = np.unique(np.linspace(0, len(t) - 1, min(frames, len(t))).round().astype(int))
    span = float(np.max(np.abs(r0))) or 1.0
    header = _poses(scenario, packer, base, t[pick], r0[pick] / span, p0[pick], POSE_LEVELS)
    header |= {"span": span, "runs": []}
    for key in best:
        r, p, times = _run_poses(poses, runs[key], n)
        if len(times) != len(t) or np.any(np.abs(times - t) > 1e-9 * max(1.0, t[-1])):
            continue
        difference = np.concatenate(
            [r - r0, rotation_vector(quaternion_product(p, quaternion_conjugate(p0)))], -1
        )[pick]
        usable = np.isfinite(difference).all((1, 2))
        scale = np.abs(np.where(usable[:, None, None], difference, 0)).max((1, 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(scale[:, None, None] > 0, difference / scale[:, None, None], 0)
        share = np.where(usable[:, None, None], share, 0)
        sizes = np.where(usable, scale, np.nan).astype(np.float32)
        header["runs"].append(
            {
                "engine": key[0],
                "integrator": key[1],
                "scale": packer.add((sizes.view(np.uint32) & SCALE_BITS).view(np.float32)),
                "d": packer.add(_few_levels(share, 127, DIFFERENCE_LEVELS).astype(np.int8)),
            }
        )
    return header


def _poses(
    scenario: Record, packer: ChunkBuilder, base: Sequence[str], t: Array, r: Array, p: Array, levels: int
) -> Record:
    """Encode the poses of one run, positions and quaternions in −1 … 1."""
    return {
        "t": packer.add(t.astype(np.float32)),
        "bodies": int(scenario["bodies"]),
        "base": list(base),
        "r": packer.add(_few_levels(r, 32767, levels).astype(np.int16)),
        "p": packer.add(_few_levels(p, 32767, levels).astype(np.int16)),
        "shape": _body_shapes(scenario),
    }


def _few_levels(x: Array, most: int, levels: int) -> Array:
    """Round −1 … 1 to multiples of −most … most that a picture distinguishes; fewer compress better."""
    return np.round(np.round(x * levels) * (most / levels))


def _still(scenario: Record, packer: ChunkBuilder) -> Record | None:
    """Encode the initial state as a motion of one frame; None where the results do not hold it."""
    if scenario["state"] is None:
        return None
    r, p = (np.array(scenario["state"][name], float) for name in ("r", "p"))
    span = float(np.max(np.abs(r))) or 1.0
    none = {"scale": packer.add(np.zeros(1, np.float32)), "d": packer.add(np.zeros(6 * len(r), np.int8))}
    runs = [{"engine": "", "integrator": "t = 0", **none}]
    poses = _poses(scenario, packer, ("", "t = 0"), np.zeros(1), r / span, p, 32767)
    return poses | {"span": span, "runs": runs}


def _loop_facts(scenario: Record) -> Record | None:
    """Count the rows that close loops, and what they leave determinate of each joint's wrench."""
    model = None if scenario["model"] is None else Model.from_fields(scenario["model"])
    if model is None or not model.has_loops or scenario["state"] is None:
        return None
    state = State(**{name: np.array(value, float) for name, value in scenario["state"].items()})
    cut = cut_open(model)
    projectors = determinate_projectors(model, state)
    whole = np.full(len(model.kind), 6)
    return {
        "closing": list(model.kind[model.n :]),
        "rows": 6 * len(cut.ends),
        "independent": len(singular_values(cut, cut.state(state))[1]),
        "determinate": (whole if projectors is None else np.rint(np.trace(projectors, axis1=1, axis2=2)))
        .astype(int)
        .tolist(),
    }


def _run_poses(poses: Columns, rows: np.ndarray, n: int) -> tuple[Array, Array, Array]:
    """Return r (T, n, 3), unit p (T, n, 4) and t (T,) of one run; its records may be in any order."""
    order = rows[np.lexsort((poses["body"][rows], poses["t"][rows]))]
    if len(order) % n or np.any(poses["body"][order].reshape(-1, n) != np.arange(n)):
        raise DamagedResults(f"trajectories.parquet: has not the {n} bodies of results.json at every time")
    r = np.stack([poses[k][order] for k in ("rx", "ry", "rz")], -1).reshape(-1, n, 3).astype(float)
    p = np.stack([poses[k][order] for k in ("p0", "p1", "p2", "p3")], -1).reshape(-1, n, 4).astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        return r, p / np.linalg.norm(p, axis=-1, keepdims=True), poses["t"][order][::n].astype(float)


def _body_shapes(scenario: Record) -> list[Record]:
    """Return each joint's bodies, points and axes, and the box with its body's principal moments.

    Joints that close loops follow those of the bodies, and have no box.
    """
    model = Model.from_fields(scenario["model"])
    shapes: list[Record] = []

    def rounded(rows: Array) -> list[list[float | None]]:
        return [[_json_number(x, 4) for x in row] for row in rows]

    for k, kind in enumerate(model.kinds):
        moving = [axis for _, axis in kind.motions]  # the last in the near body, the others in the far one
        (hang, near), (far_axes, near_axes) = rounded(model.point[k]), rotation_matrix(model.turn[k]).mT
        shapes.append(
            {
                "is_free": kind.holds_nothing,
                "is_apart": kind.holds_distance or (kind.is_unbounded and not kind.holds_nothing),
                "far": int(model.body[k, 0]),
                "body": int(model.body[k, 1]),
                "hang": hang,
                "near": near,
                "far_axes": rounded(far_axes[moving[:-1]]),
                "near_axes": rounded(near_axes[moving[-1:]]),
                "axes": [],
                "half": [],
            }
        )
        if k < model.n:
            moments, axes = np.linalg.eigh(model.inertia[k])
            half = np.sqrt(np.clip(1.5 / model.mass[k] * (moments.sum() - 2 * moments), 0, None))
            shapes[k]["axes"], (shapes[k]["half"],) = rounded(axes.T), rounded(half[None])
    return shapes


def convergence_chunk(results: Results, texts: dict[str, int]) -> str:
    """Encode every convergence study: error, cost and observed order at each resolution, coarse to fine.

    Args:
        texts: places of the texts that all chunks share; new ones are added.

    Returns:
        The chunk, see `reports.chunks`; its header is a list of ``Study`` in report_data.d.ts.

    """
    columns = results.table("convergence")
    kinds = {(e, i["name"]): i for e, engine in results.engines.items() for i in engine["integrators"]}
    studies = []
    for (scenario, engine, integrator, quantity), rows in group_rows(
        columns, "scenario", "engine", "integrator", "quantity"
    ):
        if scenario not in results.scenarios:
            continue
        order = rows[np.argsort(-columns["resolution"][rows].astype(float), kind="stable")]
        method = kinds.get((engine, integrator), {})
        studies.append(
            {
                "scenario": scenario,
                "engine": engine,
                "integrator": integrator,
                "quantity": quantity,
                "kind": method.get("kind", "step"),
                "declared": method.get("order"),
                "alias": method.get("alias_of"),
                **{k: columns[k][order].astype(float).tolist() for k in STUDY_COLUMNS},
            }
        )
    packer = ChunkBuilder(texts)
    return packer.encode(packer.add_table(studies))


def history_chunk(results: Results, history: History) -> str:
    """Encode value, error over tolerance and verdict of each row's key over the nights, this run last.

    Args:
        history: earlier runs, at least one.

    Returns:
        The chunk, see `reports.chunks`; its header is ``HistoryChunk`` in report_data.d.ts.

    """
    packer = ChunkBuilder()
    verdicts = {verdict: k + 1 for k, verdict in enumerate(SHOWN_STYLES)}
    nights: Sequence[dict[str, Record]] = [
        *(night.rows for night in history.nights),
        {row["key"]: row for row in results.rows},
    ]
    found = [[night.get(row["key"]) for night in nights] for row in results.rows]

    def table(of: Any) -> np.ndarray:
        return np.array([[None if r is None else of(r) for r in line] for line in found], float)

    header = {
        "nights": [
            {k: run.get(k) for k in ("id", "started", "commit", "versions", "exit_code", "sentence")}
            for run in (*(night.run for night in history.nights), results.run)
        ],
        "damaged": history.unreadable,
        "value": packer.add(log_scale_codes(table(lambda r: r.get("value")))),
        "ratio": packer.add(log_scale_codes(table(error_ratio))),
        "verdict": packer.add(
            np.nan_to_num(table(lambda r: verdicts.get(shown_verdict(r), 0))).astype(np.uint8)
        ),
    }
    return packer.encode(header)
