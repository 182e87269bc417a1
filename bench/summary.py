"""`python -m bench.summary [FILE.json [FOLDER]]`: the goals with what was measured, and the picture.

Reads what pytest-benchmark stored, or runs it where no file is given (several minutes; then the folder is
reports/out, where `python -m plumbline report` shows the figures).  Writes figures.json and the pictures into
the folder (the file's own where none is given) and prints the table.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from plumbline.processes.processor import processor_name
from plumbline.storage.results_store import write_atomically

COLOURS = ("#0b6e99", "#7a4fa3", "#b85c00", "#2e7d32", "#b3261e", "#5d6b7a", "#8a6d00", "#c2185b", "#00796b")


def measured_goals(measurements: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Select the goals that were measured.

    Args:
        measurements: records of the benchmarks, as pytest-benchmark stores them in ``extra_info``.

    Returns:
        One row per goal: what, goal and measured value, each a ratio or an exponent.

    """

    def pick(kind: str, **where: Any) -> dict[str, Any] | None:
        fits = (r for r in measurements if r["kind"] == kind and all(r.get(k) == v for k, v in where.items()))
        return next(fits, None)

    table: list[tuple[str, float, dict[str, Any] | None, tuple[str, str]]] = [
        ("right-hand side over SuperLU's solve of the same S, N = 1000", 0.3,
         pick("single", bodies=1000, joints="balls"), ("ratio", "superlu")),
        ("right-hand side over MuJoCo's forward, N = 100", 0.25,
         pick("single", bodies=100, joints="balls"), ("ratio", "mujoco")),
        ("right-hand side over Pinocchio's aba, N = 100", 4,
         pick("single", bodies=100, joints="balls"), ("ratio", "pinocchio")),
        ("per state in a batch of 256, one body, over MuJoCo's forward", 1,
         pick("batch", bodies=1, batch=256), ("ratio", "mujoco")),
        ("per state in a batch of 256, one body, over Pinocchio's aba", 2.5,
         pick("batch", bodies=1, batch=256), ("ratio", "pinocchio")),
        ("error 1e-10 at 2 s, two balls: CPU time over the best engine's own integrator", 1,
         pick("work-precision", batch=1), ("ratio to the best engine", "1e-10")),
        ("the same in a batch of 64 at 1e-9", 0.4,
         pick("work-precision", batch=64), ("ratio to the best engine", "1e-09")),
    ]  # fmt: skip
    rows = [
        {"what": what, "goal": goal, "measured": record[group][name]}
        for what, goal, record, (group, name) in table
        if record is not None
    ]
    for joints in ("balls", "rods"):
        if record := pick("growth", joints=joints):
            what = f"growth exponent of the right-hand side, N = 100 → 10,000, {joints}"
            rows.append({"what": what, "goal": 1.05, "measured": record["exponent"]})
    return rows


def work_precision_svg(curves: dict[str, list[dict[str, float]]], title: str) -> str:
    """Draw work–precision curves: error falls to the right, CPU time rises; both axes are logarithmic.

    Args:
        curves: points with ``error`` [m] and ``seconds`` (CPU time [s]), by name of the integrator.

    """
    points = [p for curve in curves.values() for p in curve if 0 < p["error"] < 1 and p["seconds"] > 0]
    errors, seconds = ([np.log10(p[k]) for p in points] for k in ("error", "seconds"))
    left, right = int(np.ceil(max(errors))), int(np.floor(min(errors)))
    low, high = int(np.floor(min(seconds))), int(np.ceil(max(seconds)))
    width, height, margin, legend = 760, 440, 56, 250

    def x(error: float) -> float:
        return margin + (left - np.log10(error)) / (left - right) * (width - margin - legend)

    def y(spent: float) -> float:
        return height - margin - (np.log10(spent) - low) / (high - low) * (height - 2 * margin)

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'font-family="system-ui, sans-serif" font-size="12"><title>{escape(title)}</title>',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
        f'<text x="{margin}" y="24" font-size="14">{escape(title)}</text>',
    ]
    for k in range(right, left + 1, 2):
        at = x(10.0**k)
        out.append(f'<path d="M{at:.1f} {margin}V{height - margin}" stroke="#ddd"/>')
        out.append(f'<text x="{at:.1f}" y="{height - margin + 18}" text-anchor="middle">1e{k}</text>')
    for k in range(low, high + 1):
        at = y(10.0**k)
        out.append(f'<path d="M{margin} {at:.1f}H{width - legend}" stroke="#ddd"/>')
        out.append(f'<text x="{margin - 6}" y="{at + 4:.1f}" text-anchor="end">1e{k}</text>')
    out.append(
        f'<text x="{(margin + width - legend) / 2}" y="{height - 14}" text-anchor="middle">'
        "error at 2 s (m)</text>"
    )
    out.append(f'<text x="14" y="{margin - 14}">CPU time (s)</text>')
    for index, (name, curve) in enumerate(curves.items()):
        colour = COLOURS[index % len(COLOURS)]
        kept = [p for p in curve if 0 < p["error"] < 1 and p["seconds"] > 0]
        line = " ".join(f"{x(p['error']):.1f},{y(p['seconds']):.1f}" for p in kept)
        thick = 3 if name.startswith("reference coll") else 1.5
        out.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="{thick}"/>')
        out += [
            f'<circle cx="{x(p["error"]):.1f}" cy="{y(p["seconds"]):.1f}" r="3" fill="{colour}"/>'
            for p in kept
        ]
        at = margin + 20 * index
        out.append(f'<path d="M{width - legend + 16} {at}h22" stroke="{colour}" stroke-width="{thick}"/>')
        out.append(f'<text x="{width - legend + 44}" y="{at + 4}">{escape(name)}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


def describe_machine() -> dict[str, str]:
    """Describe what the figures depend on besides the code.

    Returns:
        Processor, operating system, NumPy's BLAS, and the kernel that it chose for this processor.

    """
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    kernel = "unknown"
    for path in Path(np.__file__).parents[1].glob("numpy.libs/libscipy_openblas*"):
        core_name = ctypes.CDLL(str(path)).scipy_openblas_get_corename64_
        core_name.restype = ctypes.c_char_p
        kernel = core_name().decode()
    return {
        "processor": processor_name(),
        "system": platform.platform(),
        "BLAS": f"{blas['name']} {blas['version']}",
        "BLAS kernel": kernel,
    }


def run_benchmarks(folder: Path) -> Path:
    """Run all benchmarks with one BLAS thread.

    Args:
        folder: where pytest-benchmark stores its results; created where it is missing.

    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "benchmarks.json"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "bench", f"--benchmark-json={path}"]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    subprocess.run(command, env=os.environ | threads, check=True)
    return path


def main(arguments: list[str]) -> None:
    """Write and print the figures of a stored run, or of one made now.

    Args:
        arguments: path of stored results and folder to write to; both may be left out.

    """
    stored = Path(arguments[0]) if arguments else run_benchmarks(Path("reports") / "out")
    folder = Path(arguments[1]) if len(arguments) > 1 else stored.parent
    found = [b["extra_info"] for b in json.loads(stored.read_text())["benchmarks"] if b["extra_info"]]
    rows = measured_goals(found)
    for row in rows:
        met = "met" if row["measured"] <= row["goal"] else "not met"
        print(f"{row['what']}: {row['measured']:.3g} (goal {row['goal']:g}, {met})")
    figures = json.dumps({"machine": describe_machine(), "goals": rows, "records": found}, indent=1) + "\n"
    write_atomically(folder / "figures.json", figures.encode())
    for record in found:
        if record["kind"] == "work-precision":
            batch = record["batch"]
            name = "work-precision.svg" if batch == 1 else f"work-precision-{batch}.svg"
            many = f"a batch of {batch}" if batch > 1 else "one pendulum"
            title = f"Two bodies on ball joints, {many}: CPU time to an error"
            write_atomically(folder / name, work_precision_svg(record["curves"], title).encode())


if __name__ == "__main__":
    main(sys.argv[1:])
