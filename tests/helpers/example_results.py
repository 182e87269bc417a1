"""An output folder as a run leaves it, from small pendulums integrated here.

`build` has every verdict, hostile names in every text field, a diverging run, a crossing of the
tolerance and a raw drift; `catalogue` has the size of the default catalogue.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from plumbline.judging.rows import error_ratio

G = 9.81
HOSTILE = "<img src=x onerror=alert(1)>"
NASTY = "a'\"`${1}&amp;</script><script>alert(2)</script>]]>|*_#-- \x00\x1b\u202e end"
METHODS = {  # name: (tableau order, title)
    "Euler": 1,
    "midpoint": 2,
    "RK4": 4,
}
ENGINES = {
    "reference": ("The notes", "0.1.0", ["RK4"]),
    "mujoco": ("MuJoCo", "4.0.0", ["Euler", "RK4"]),
    "pinocchio": ("Pinocchio", "4.1.0", ["Euler", "RK4"]),
    "exudyn": ("Exudyn", "1.13.6", ["midpoint"]),
    "exudyn-tree": ("Exudyn, kinematic tree", "1.13.6", ["RK4"]),
    "pinocchio-maximal": ("Pinocchio, maximal", "4.1.0", []),
}


def links(n: int) -> Callable[[np.ndarray], np.ndarray]:
    """θ̈ of n equal point masses on massless links of length 1/n, in a plane: y = (θ, θ̇)."""
    ell = 1.0 / n
    c = n - np.maximum.outer(np.arange(n), np.arange(n)).astype(float)

    def rate(y: np.ndarray) -> np.ndarray:
        th, w = y[:n], y[n:]
        d = np.subtract.outer(th, th)
        rhs = -(c * np.sin(d)) @ w**2 * ell - G * np.diag(c) * np.sin(th)
        return np.concatenate([w, np.linalg.solve(c * np.cos(d) * ell, rhs)])

    return rate


def step(rate: Callable[[np.ndarray], np.ndarray], y: np.ndarray, h: float, method: str) -> np.ndarray:
    k1 = rate(y)
    if method == "Euler":
        return y + h * k1
    k2 = rate(y + h / 2 * k1)
    if method == "midpoint":
        return y + h * k2
    k3 = rate(y + h / 2 * k2)
    k4 = rate(y + h * k3)
    return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def integrate(n: int, y0: np.ndarray, times: np.ndarray, h: float, method: str) -> np.ndarray:
    rate, y, out = links(n), y0.copy(), [y0]
    with np.errstate(over="ignore", invalid="ignore"):  # Euler on the chain blows up, as it is meant to
        for a, b in pairwise(times):
            for _ in range(round((b - a) / h)):
                y = step(rate, y, h, method)
            out.append(y)
    return np.array(out)


def poses(n: int, y: np.ndarray, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """r (T, n, 3) and p (T, n, 4) of the links' bodies, the plane of motion turned by the azimuth."""
    th = y[:, :n]
    joint = np.cumsum(np.stack([np.sin(th), np.zeros_like(th), -np.cos(th)], -1) / n, axis=1)
    ca, sa = np.cos(azimuth), np.sin(azimuth)
    r = joint @ np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1.0]]).T
    # attitude: about z by the azimuth, then about y by -θ (body -z along the link)
    cz, sz, cy, sy = np.cos(azimuth / 2), np.sin(azimuth / 2), np.cos(th / 2), -np.sin(th / 2)
    p = np.stack([cz * cy, -sz * sy, cz * sy, sz * cy], -1)
    return r, p


def energy(n: int, y: np.ndarray) -> np.ndarray:
    th, w, ell = y[:, :n], y[:, n:], 1.0 / n
    v = np.cumsum(np.stack([np.cos(th) * w, np.sin(th) * w], -1) * ell, axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        return 0.5 * np.sum(v**2, (1, 2)) - G * np.sum(np.cumsum(np.cos(th) * ell, axis=1), 1)


def build(
    out: Path,
    *,
    hostile: bool = True,
    scenarios: int | None = None,
    samples: int = 120,
    duration: float = 4.0,
) -> Path:
    """Write a whole OUT folder; returns it."""
    rng = np.random.default_rng(4)
    out.mkdir(parents=True, exist_ok=True)
    plan = [
        ("single", "planar-small", 1, 0.05),
        ("single", "planar-large", 1, 2.9),
        ("double", "double-tumbling", 2, 1.9),
        ("double", "double-two-rods", 2, 2.4),
        ("chain", "chain-10", 10, 0.9),
    ]
    if scenarios:
        plan = [(f, f"{name}-{k:02d}", n, a) for k in range(-(-scenarios // 5)) for f, name, n, a in plan][
            :scenarios
        ]
    if hostile:
        plan.append(("odd & <b>names</b>", HOSTILE, 1, 1.0))
        plan.append(("odd & <b>names</b>", NASTY, 1, 1.2))
    tables: dict[str, list[dict[str, Any]]] = {k: [] for k in ("states", "convergence")}
    curves: list[dict[str, np.ndarray]] = []
    motion: list[dict[str, np.ndarray]] = []
    catalogue: dict[str, Any] = {}
    rows: list[dict[str, Any]] = []
    cache: dict[Any, Any] = {}
    times = np.linspace(0, duration, samples + 1)
    sample = duration / samples

    def run(n: int, angle: float, h: float, method: str) -> np.ndarray:
        key = n, angle, h, method
        if key not in cache:
            y0 = np.concatenate([angle * (1 + 0.1 * np.arange(n)), np.zeros(n)])
            cache[key] = integrate(n, y0, times, h, method)
        return cache[key]

    for family, name, n, angle in plan:
        rod = "rod" in name
        inertia = np.array([np.diag([0.002, 0.0015, 0.0008]) / n**2] * n)
        catalogue[name] = {
            "family": family,
            "title": NASTY
            if name == HOSTILE
            else f"{n} {'rods' if rod else 'balls'}, released from {angle} rad",
            "purpose": HOSTILE if hostile else "Catches a wrong sign in the velocity terms.",
            "file": HOSTILE + ".yaml" if name == HOSTILE else "chain-3-balls.yaml",
            "bodies": n,
            "joints": ["rod" if rod else "ball"] * n,
            "duration": duration,
            "sample": sample,
            "exact": "Jacobi elliptic functions" if n == 1 else None,
            "horizon": 2.6 if n == 2 else duration,
            "truth_uncertainty": 3e-14,
            "model": {
                "mass": [1.0] * n,
                "inertia": inertia.tolist(),
                "proximal": [[0.0, 0.0, 0.4 / n if rod else 1.0 / n]] * n,
                "distal": [[0.0, 0.0, 0.0]] * n,
                "length": [0.6 / n if rod else 0.0] * n,
                "gravity": [0.0, 0.0, -G],
                "force": [[0.0] * 3] * n,
                "moment": [[0.0] * 3] * n,
                "drag_force": [0.0] * n,
                "drag_moment": [0.0] * n,
            },
            "digest": f"{abs(hash((family, name))):x}"[:16],
        }
        best = run(n, angle, sample / 16, "RK4")
        truth, attitude = poses(n, best, 0.6)
        for engine, (_, version, methods) in ENGINES.items():
            base = {
                "scenario": name,
                "family": family,
                "engine": engine,
                "engine_version": version,
                "level": "state",
                "integrator": "-",
                "quantity": "",
                "unit": "",
                "value": None,
                "tolerance": None,
                "verdict": "agrees",
                "reason": "",
                "derivation": "",
                "uncertainty": None,
                "ratio": None,
                "compared_until": None,
                "order": None,
                "declared_order": None,
                "alias_of": None,
                "known_issue": None,
                "diagnosis": None,
                "user_rtol": None,
                "cpu_time": float(rng.uniform(0.01, 2)),
                "extra": {},
            }

            def row(base: dict[str, Any] = base, **of: Any) -> None:
                rows.append({**base, **of})

            if engine == "pinocchio-maximal":
                row(
                    quantity="acceleration",
                    unit="m/s²",
                    verdict="not installed",
                    reason="no module named pinocchio",
                )
                continue
            for quantity, unit, scale in (
                ("acceleration", "m/s²", G),
                ("angular_acceleration", "rad/s²", 30.0),
                ("joint_reaction", "N", G * n),
            ):
                bound = 64 * 1.1e-16 * scale * n * 10 ** rng.uniform(0.3, 1.6, 51)
                error = bound * 10 ** rng.normal(-1.9, 0.35, 51)
                wrong = engine == "pinocchio" and name in ("chain-10", HOSTILE) and quantity == "acceleration"
                if wrong:
                    error *= 3e4
                worst = int(np.argmax(error / bound))
                tables["states"] += [
                    {
                        "scenario": name,
                        "engine": engine,
                        "quantity": quantity,
                        "state": k,
                        "body": int(k % n),
                        "error": error[k],
                        "bound": bound[k],
                        "scale": scale,
                    }
                    for k in range(51)
                ]
                row(
                    quantity=quantity,
                    unit=unit,
                    value=error[worst],
                    tolerance=bound[worst],
                    verdict="disagrees" if wrong else "agrees",
                    reason=f"worst of 51 states: state {worst}, body {worst % n + 1}",
                    derivation="64 ε (tB + tX + tS + tJ + d), the rounding of one evaluation at this state",
                    diagnosis="behaves as if gravity were 9.8103 m/s² instead of 9.81 "
                    + (NASTY if hostile else "")
                    if wrong
                    else None,
                    extra={"states": 51.0, "kappa": 3.2e4},
                )
            row(
                quantity="mass_matrix",
                verdict="unsupported",
                known_issue="no-mass-matrix",
                reason="this formulation has no joint-space mass matrix",
            )
            if engine == "exudyn" and name == "chain-10":
                row(
                    level="trajectory",
                    integrator="midpoint",
                    quantity="position",
                    verdict="failed",
                    reason="killed by signal 11 (SIGSEGV) after 3.1 s " + (HOSTILE if hostile else ""),
                )
                continue
            for method in methods:
                order = METHODS[method]
                # the reference goes on to a finer step, so that the others differ from it
                steps = [sample / 2**k for k in range(5 if engine == "reference" else 4)]
                points = []
                for h in steps:
                    r, _ = poses(n, run(n, angle, h, method), 0.6)
                    e = float(np.linalg.norm(r[-1] - truth[-1], axis=-1).max()) + 1e-16
                    points.append(e)
                    observed = np.log2(points[-2] / e) if len(points) > 1 else np.nan
                    for quantity, factor in (("position", 1.0), ("attitude", 2.1)):
                        tables["convergence"].append(
                            {
                                "scenario": name,
                                "engine": engine,
                                "integrator": method,
                                "resolution": h,
                                "quantity": quantity,
                                "error": e * factor if np.isfinite(e) else np.nan,
                                "cost": duration / h * order * 3e-6 * (1 + 4 * (engine == "exudyn")),
                                "steps": round(duration / h),
                                "order": observed,
                            }
                        )
                h = steps[-1]
                y = run(n, angle, h, method)
                r, p = poses(n, y, 0.6)
                wobble = 1 + 1e-9 * rng.standard_normal()
                error = np.linalg.norm(r - truth, axis=-1).max(1) * wobble + 1e-17
                dot = np.abs(np.sum(p * attitude, -1)).clip(0, 1)
                turn = (2 * np.arccos(dot)).max(1)
                tolerance = 1e-13 + 2e-6 * (times / duration) ** 2
                drift = np.abs(energy(n, y) - energy(n, y[:1]))
                gap = (
                    1e-15
                    * (1 + times**2 * 40)
                    * rng.uniform(0.3, 1, len(times))
                    * (engine in ("reference", "exudyn"))
                )
                t = times
                same = {"scenario": name, "engine": engine, "integrator": method, "resolution": h}
                curves.append(
                    {
                        **same,
                        "t": t,
                        "position_error": error,
                        "attitude_error": turn,
                        "energy_drift": drift,
                        "momentum_drift": drift * 0.05,
                        "joint_gap": gap,
                        "gap_rate": gap * 7,
                        "norm_drift": gap / 3,
                        "tolerance": tolerance,
                    }
                )
                for body in range(n):
                    motion.append(
                        {
                            **same,
                            "t": t,
                            "body": np.full(len(t), body),
                            **{f"r{a}": r[:, body, i] for i, a in enumerate("xyz")},
                            **{f"p{i}": p[:, body, i] for i in range(4)},
                        }
                    )
                finite = bool(np.isfinite(error).all())
                common = {
                    "level": "trajectory",
                    "integrator": method,
                    "order": float(np.log2(points[-2] / points[-1])),
                    "declared_order": order,
                    "compared_until": catalogue[name]["horizon"],
                    "uncertainty": 4e-13,
                }
                limit = min(points) * 1e-3
                row(
                    **common,
                    quantity="position",
                    unit="m",
                    value=limit,
                    tolerance=max(limit * 30, 1e-12),
                    verdict="agrees" if finite else "unresolved",
                    reason="the extrapolated limit is the truth" if finite else "beyond the horizon",
                    derivation="sum of the uncertainties of truth (3e-14 m) and limit (4e-13 m), times 10",
                )
                row(
                    **common,
                    quantity="order",
                    unit="–",
                    value=abs(common["order"] - order),
                    tolerance=0.1,
                    verdict="agrees" if abs(common["order"] - order) < 0.1 else "unresolved",
                    known_issue=None if abs(common["order"] - order) < 0.1 else "coarse-steps",
                    reason=f"shows order {common['order']:.2f}, declared {order}",
                    alias_of="Euler" if method == "midpoint" else None,
                )
                row(
                    level="invariants",
                    integrator=method,
                    quantity="energy",
                    unit="J",
                    value=float(drift.max()),
                    tolerance=float(drift.max() * 8 + 1e-13),
                    reason="falls with the step as order says",
                    user_rtol=1e-6,
                )
    for row_ in rows:
        for field in ("value", "tolerance", "order"):  # as the store writes what JSON cannot say
            if row_[field] is not None and not np.isfinite(row_[field]):
                row_[field] = None
        row_["ratio"] = error_ratio(row_["value"], row_["tolerance"])
        row_["key"] = "/".join(row_[k] for k in ("scenario", "engine", "level", "integrator", "quantity"))
    bad = [r for r in rows if r["verdict"] == "disagrees"]
    counts = {v: sum(r["verdict"] == v for r in rows) for v in dict.fromkeys(r["verdict"] for r in rows)}
    results = {
        "schema_version": 2,
        "run": {
            "id": "20261121-020000-6d61634",
            "started": "2026-11-21T02:00:00+00:00",
            "duration": 214.6,
            "command": "python -m plumbline run",
            "commit": "6d61634",
            "python": "3.11.9",
            "machine": {"cpu": "4-core laptop", "memory": "16 GiB"},
            "platform": "Linux-6.1-x86_64",
            "versions": {k: v for k, (_, v, _) in ENGINES.items()},
            "truth": "DOP853 at two tolerances; ten times their difference is its uncertainty.",
            "exit_code": 1 if bad else 0,
            "sentence": ", ".join(f"{n} {v}" for v, n in counts.items()),
        },
        "scenarios": catalogue,
        "engines": {
            name: {
                "title": title,
                "version": version,
                "installed": name != "pinocchio-maximal",
                "integrators": [
                    {"name": m, "kind": "step", "order": METHODS[m], "alias_of": None, "note": ""}
                    for m in methods
                ],
            }
            for name, (title, version, methods) in ENGINES.items()
        },
        "rows": rows,
    }
    (out / "results.json").write_text(json.dumps(results))
    for name_, records in (
        ("states", tables["states"]),
        ("convergence", tables["convergence"]),
        ("summary", rows),
    ):
        flat = [{k: (v if not isinstance(v, dict) else json.dumps(v)) for k, v in r.items()} for r in records]
        _write(
            pa.Table.from_pylist([{k: _utf8(v) for k, v in r.items()} for r in flat]),
            out / f"{name_}.parquet",
        )
    for name_, parts in (("curves", curves), ("trajectories", motion)):
        tables_ = []
        for part in parts:
            size = len(part["t"])
            tables_.append(
                pa.table(
                    {
                        k: v if isinstance(v, np.ndarray) else pa.array([_utf8(v)] * size)
                        for k, v in part.items()
                    }
                )
            )
        _write(pa.concat_tables(tables_), out / f"{name_}.parquet")
    if bad:
        (out / "scripts").mkdir(exist_ok=True)
        index = {}
        for k, r in enumerate(bad):
            index[r["key"]] = f"reproduce-{k}.py"
            text = f'"""{_utf8(r["scenario"])}"""\nimport numpy as np\n\nprint(np.pi)\n'
            (out / "scripts" / f"reproduce-{k}.py").write_text(text)
        (out / "scripts" / "index.json").write_text(json.dumps(index))
    return out


def nights(out: Path, history: Path, count: int = 12) -> Path:
    """Earlier nights of the run in OUT: all green but the last, with a version change in the middle."""
    stored = json.loads((out / "results.json").read_text())
    rng = np.random.default_rng(7)
    for k in range(count):
        night = copy.deepcopy(stored)
        green = k < count - 1
        night["run"] |= {
            "id": f"night-{k}",
            "started": f"2026-11-{20 - count + k + 1:02d}T02:00:00+00:00",
            "exit_code": int(not green),
            "versions": stored["run"]["versions"] | {"mujoco": "3.12.0" if k < count // 2 else "4.0.0"},
        }
        for row in night["rows"]:
            if row["value"] is not None:
                row["value"] *= float(10 ** rng.normal(0, 0.1))
            if green and row["verdict"] in ("disagrees", "failed"):
                row["verdict"] = "agrees"
                if row["value"] is not None:
                    row["value"] = row["tolerance"] * 0.01
            row["ratio"] = error_ratio(row["value"], row["tolerance"])
        folder = history / f"2026-11-{20 - count + k + 1:02d}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "results.json").write_text(json.dumps(night))
        flat = [
            {k: _utf8(v) if not isinstance(v, dict) else json.dumps(v) for k, v in r.items()}
            for r in night["rows"]
        ]
        _write(pa.Table.from_pylist(flat), folder / "summary.parquet")
    (history / "2026-11-02").mkdir(exist_ok=True)
    (history / "2026-11-02" / "results.json").write_text('{"run": {"id": "cut off in the mid')
    return history


def _utf8(value: Any) -> Any:
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else value


def _write(table: pa.Table, path: Path) -> None:
    pq.write_table(table, path, compression="zstd")
