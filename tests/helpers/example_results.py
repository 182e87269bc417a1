"""An output folder as a run writes it, through the real store, from small pendulums integrated here.

`build` has every verdict, hostile names in every text field, a diverging run, a crossing of the
tolerance and a raw drift; with ``scenarios=30`` it has the size of the default catalogue.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.judging.rows import Row, RowContext, Verdict, error_ratio
from plumbline.model.datatypes import Model
from plumbline.storage.results_store import ResultTables, read_results, write_results
from plumbline.storage.script_index import scripts_folder, write_script_index

G = 9.81
HOSTILE = "<img src=x onerror=alert(1)>"
NASTY = "a'\"`${1}&amp;</script><script>alert(2)</script>]]>|*_#-- \x00\x1b\u202e end"
METHODS = {  # order of each
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
    """Write a whole output folder and return it."""
    rng = np.random.default_rng(4)
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
    tables = ResultTables()
    catalogue: dict[str, Any] = {}
    rows: list[Row] = []
    cache: dict[Any, np.ndarray] = {}
    times = np.linspace(0, duration, samples + 1)
    sample = duration / samples

    def run(n: int, angle: float, h: float, method: str) -> np.ndarray:
        key = n, angle, h, method
        if key not in cache:
            y0 = np.concatenate([angle * (1 + 0.1 * np.arange(n)), np.zeros(n)])
            cache[key] = integrate(n, y0, times, h, method)
        return cache[key]

    for family, name, n, angle in plan:
        catalogue[name] = scenario_record(family, name, n, angle, hostile, duration, sample)
        best = run(n, angle, sample / 16, "RK4")
        truth, attitude = poses(n, best, 0.6)
        for engine, (title, version, methods) in ENGINES.items():
            context = RowContext(name, family, engine, title, version)
            cell = {"scenario": name, "engine": engine}
            spent = float(rng.uniform(0.01, 2))

            def row(*where: Any, context: RowContext = context, spent: float = spent, **more: Any) -> None:
                rows.append(context.make_row(*where, cpu_time=spent, **more))

            if engine == "pinocchio-maximal":
                reason = "no module named pinocchio"
                row("state", "-", "acceleration", Verdict.NOT_INSTALLED, reason, "m/s²")
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
                state = np.arange(51)
                spread = {"state": state, "body": state % n, "error": error, "bound": bound, "scale": scale}
                tables.add("states", {**cell, "quantity": quantity, **spread})
                diagnosis = "behaves as if gravity were 9.8103 m/s² instead of 9.81 "
                row(
                    "state", "-", quantity, Verdict.DISAGREES if wrong else Verdict.AGREES,
                    f"worst of 51 states: state {worst}, body {worst % n + 1}", unit,
                    value=float(error[worst]), tolerance=float(bound[worst]),
                    derivation="64 ε (tB + tX + tS + tJ + d), the rounding of one evaluation at this state",
                    diagnosis=diagnosis + (NASTY if hostile else "") if wrong else None,
                    extra={"states": 51.0, "kappa": 3.2e4},
                )  # fmt: skip
            reason = "this formulation has no joint-space mass matrix"
            gap = "no-mass-matrix"
            row("state", "-", "mass_matrix", Verdict.UNSUPPORTED, reason, known_issue=gap)
            if engine == "exudyn" and name == "chain-10":
                reason = "killed by signal 11 (SIGSEGV) after 3.1 s " + (HOSTILE if hostile else "")
                row("trajectory", "midpoint", "position", Verdict.FAILED, reason)
                continue
            for method in methods:
                order = METHODS[method]
                # the reference goes on to a finer step, so that the others differ from it
                steps = sample / 2.0 ** np.arange(5 if engine == "reference" else 4)
                ends = [poses(n, run(n, angle, h, method), 0.6)[0][-1] for h in steps]
                points = [float(np.linalg.norm(r - truth[-1], axis=-1).max()) + 1e-16 for r in ends]
                observed = np.array([np.nan, *np.log2(np.divide(points[:-1], points[1:]))])
                cost = duration / steps * order * 3e-6 * (1 + 4 * (engine == "exudyn"))
                study = {"resolution": steps, "cost": cost, "steps": np.round(duration / steps).astype(int)}
                for quantity, factor in (("position", 1.0), ("attitude", 2.1)):
                    error = np.where(np.isfinite(points), np.multiply(points, factor), np.nan)
                    measured = {"integrator": method, "quantity": quantity, "error": error, "order": observed}
                    tables.add("convergence", cell | study | measured)
                y = run(n, angle, steps[-1], method)
                r, p = poses(n, y, 0.6)
                error = np.linalg.norm(r - truth, axis=-1).max(1) * (1 + 1e-9 * rng.standard_normal()) + 1e-17
                drift = np.abs(energy(n, y) - energy(n, y[:1]))
                ragged = 1e-15 * (1 + times**2 * 40) * rng.uniform(0.3, 1, len(times))
                gap_size = ragged * (engine in ("reference", "exudyn"))
                same = {**cell, "integrator": method, "resolution": steps[-1], "t": times}
                curves = {
                    "position_error": error,
                    "attitude_error": (2 * np.arccos(np.abs(np.sum(p * attitude, -1)).clip(0, 1))).max(1),
                    "limit_error": np.full(len(times), np.nan),
                    "tolerance": 1e-13 + 2e-6 * (times / duration) ** 2,
                    "energy_drift": drift,
                    "momentum_drift": drift * 0.05,
                    "joint_gap": gap_size,
                    "gap_rate": gap_size * 7,
                    "norm_drift": gap_size / 3,
                }
                tables.add("curves", same | curves)
                for body in range(n):
                    pose = {f"r{a}": r[:, body, i] for i, a in enumerate("xyz")}
                    pose |= {f"p{i}": p[:, body, i] for i in range(4)}
                    tables.add("trajectories", {**same, "body": body, **pose})
                finite = bool(np.isfinite(error).all())
                last = float(observed[-1])
                common = {"order": last, "declared_order": order, "uncertainty": 4e-13}
                common["compared_until"] = catalogue[name]["horizon"]
                limit = min(points) * 1e-3
                row(
                    "trajectory", method, "position", Verdict.AGREES if finite else Verdict.UNRESOLVED,
                    "the extrapolated limit is the truth" if finite else "beyond the horizon", "m",
                    value=limit, tolerance=max(limit * 30, 1e-12), **common,
                    derivation="sum of the uncertainties of truth (3e-14 m) and limit (4e-13 m), times 10",
                )  # fmt: skip
                shown = abs(last - order) < 0.1
                row(
                    "trajectory", method, "order", Verdict.AGREES if shown else Verdict.UNRESOLVED,
                    f"shows order {last:.2f}, declared {order}", "–",
                    value=abs(last - order), tolerance=0.1, **common,
                    known_issue=None if shown else "coarse-steps",
                    alias_of="Euler" if method == "midpoint" else None,
                )  # fmt: skip
                row(
                    "invariants", method, "energy", Verdict.AGREES, "falls with the step as order says", "J",
                    value=float(drift.max()), tolerance=float(drift.max() * 8 + 1e-13), user_rtol=1e-6,
                )  # fmt: skip
    bad = [row for row in rows if row.verdict == Verdict.DISAGREES]
    counts = {v: sum(row.verdict == v for row in rows) for v in dict.fromkeys(row.verdict for row in rows)}
    metadata = {
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
    }
    engines = {
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
    }
    tables.add_rows(rows)
    write_results(out, metadata, catalogue, engines, rows, tables)
    if bad:
        (out / "scripts").mkdir(exist_ok=True)
        for k, row_ in enumerate(bad):
            text = f'"""{row_.scenario}"""\nimport numpy as np\n\nprint(np.pi)\n'
            (out / "scripts" / f"reproduce-{k}.py").write_text(text)
        index = {row_.key: f"reproduce-{k}.py" for k, row_ in enumerate(bad)}
        write_script_index(out, index)
    return out


def build_small(out: Path) -> Path:
    """Write a small output folder with every kind of file, and return it."""
    build(out, hostile=False, scenarios=1, samples=4, duration=0.125)
    scripts_folder(out).mkdir(exist_ok=True)
    (scripts_folder(out) / "a.py").write_text("print('a script')\n")
    write_script_index(out, {read_results(out)["rows"][0]["key"]: "a.py"})
    return out


def scenario_record(
    family: str, name: str, n: int, angle: float, hostile: bool, duration: float, sample: float
) -> dict[str, Any]:
    """Describe a scenario of n links as results.json does."""
    rod = "rod" in name
    model = Model.chain(
        mass=np.ones(n),
        inertia=np.array([np.diag([0.002, 0.0015, 0.0008]) / n**2] * n),
        proximal=np.array([[0.0, 0.0, 0.4 / n if rod else 1.0 / n]] * n),
        distal=np.zeros((n, 3)),
        length=np.full(n, 0.6 / n if rod else 0.0),
        gravity=np.array([0.0, 0.0, -G]),
        force=np.zeros((n, 3)),
        moment=np.zeros((n, 3)),
        drag_force=np.zeros(n),
        drag_moment=np.zeros(n),
    )
    return {
        "family": family,
        "title": NASTY if name == HOSTILE else f"{n} {'rods' if rod else 'balls'}, released from {angle} rad",
        "purpose": HOSTILE if hostile else "Catches a wrong sign in the velocity terms.",
        "file": HOSTILE + ".yaml" if name == HOSTILE else "chain-3-balls.yaml",
        "bodies": n,
        "joints": ["rod" if rod else "ball"] * n,
        "duration": duration,
        "sample": sample,
        "exact": "Jacobi elliptic functions" if n == 1 else None,
        "horizon": 2.6 if n == 2 else duration,
        "truth_uncertainty": 3e-14,
        "model": {key: np.asarray(value).tolist() for key, value in model.fields.items()},
        "digest": hashlib.sha256(name.encode()).hexdigest()[:16],
    }


def nights(out: Path, history: Path, count: int = 12) -> Path:
    """Write earlier nights of a run: all pass but the last, with a change of version in the middle."""
    stored = read_results(out)
    rng = np.random.default_rng(7)
    for k in range(count):
        passes = k < count - 1
        date = f"2026-11-{20 - count + k + 1:02d}"
        metadata = stored["run"] | {
            "id": f"night-{k}",
            "started": f"{date}T02:00:00+00:00",
            "exit_code": int(not passes),
            "versions": stored["run"]["versions"] | {"mujoco": "3.12.0" if k < count // 2 else "4.0.0"},
        }
        rows = []
        for record in stored["rows"]:
            row = Row(**{name: value for name, value in record.items() if name != "key"})
            value, verdict = row.value, row.verdict
            if value is not None:
                value *= float(10 ** rng.normal(0, 0.1))
            if passes and verdict in (Verdict.DISAGREES, Verdict.FAILED):
                verdict = Verdict.AGREES
                value = None if row.tolerance is None else row.tolerance * 0.01
            rows.append(replace(row, value=value, verdict=verdict, ratio=error_ratio(value, row.tolerance)))
        tables = ResultTables()
        tables.add_rows(rows)
        write_results(history / date, metadata, stored["scenarios"], stored["engines"], rows, tables)
    (history / "2026-11-02").mkdir(exist_ok=True)
    (history / "2026-11-02" / "results.json").write_text('{"run": {"id": "cut off in the mid')
    return history
