"""`python -m bench.reference_solutions [NAME…]`: enclosed motions to cite and to test against.

Proves motions to 10 s, and writes docs/reference-solutions.json: the numbers of each model
and, at 1, 2, 5 and 10 s, balls around positions, attitudes, velocities and rates.  Scenarios not named
keep what the file has.  Two bodies take minutes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.scenario.loader import find_scenario_file, load_scenario
from plumbline.storage.results_store import write_atomically
from plumbline.truth.certificate_proof import (
    CertificatePrecision,
    checked_numbers,
    checked_topology,
    prove_motion,
)

STORED = Path(__file__).resolve().parents[1] / "docs" / "reference-solutions.json"
TIMES = (1.0, 2.0, 5.0, 10.0)
DIGITS, MAX_RADIUS = 20, 1e-15  # m
PRECISIONS: tuple[CertificatePrecision, ...] = ("quad", "octuple")  # the first that gives this radius
ABOUT = (
    "Motions enclosed rigorously (docs/enclosures.md): every number [midpoint +/- radius] contains the true "
    "one, rounded here to 20 digits; radius is the largest one of r, in m, before. SI; world z up; r and v "
    "of centres of mass, world frame; p unit quaternions, scalar first, body to world; omega in body axes. "
    "Model and initial state as doubles: kind of each joint, its far body (-1 the world), point in the far "
    "and the near body, turn of the joint's axes in both; p, turn, u, udot normalised exactly; of a free "
    "body u and udot are place and velocity, and length is 1."
)


def enclosed_motion(name: str) -> dict[str, Any]:
    """Prove the motion of a scenario."""
    scenario = load_scenario(find_scenario_file(name))
    for precision in PRECISIONS:
        _, enclosure = prove_motion(scenario.model, scenario.state, np.array(TIMES), precision=precision)
        if enclosure.radius("r") < MAX_RADIUS:
            break
    text: Any = np.frompyfunc(lambda ball: ball.str(DIGITS), 1, 1)
    hexadecimal: Any = np.frompyfunc(float.hex, 1, 1)
    numbers = checked_numbers(scenario.model, scenario.state)
    return checked_topology(scenario.model) | {
        "doubles": {key: hexadecimal(x).tolist() for key, x in numbers.items()},
        "times": list(TIMES),
        "radius": [max(float(x.rad()) for x in r.ravel()) for r in enclosure.r],
        **{quantity: text(getattr(enclosure, quantity)).tolist() for quantity in ("r", "p", "v", "omega")},
    }


def main(names: list[str]) -> None:
    """Write the file.

    Args:
        names: scenarios to prove; none: those that the file has.

    """
    stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else {"motions": {}}
    for name in names or list(stored["motions"]):
        stored["motions"][name] = enclosed_motion(name)
        document = json.dumps({"about": ABOUT, "motions": stored["motions"]}, indent=1, ensure_ascii=False)
        write_atomically(STORED, document.encode() + b"\n")


if __name__ == "__main__":
    main(sys.argv[1:])
