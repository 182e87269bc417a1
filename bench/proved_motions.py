"""`python -m bench.proved_motions [NAME…]`: what proofs of motions cost, and how wide they are, as a table.

Proves each scenario of at most five bodies that can be proved, over its own duration, checks the certificate
once more, and compares the usual truth with it.  Prints Markdown.  All of them take ten minutes.
"""

from __future__ import annotations

import sys
import time

from plumbline.scenario.loader import Scenario, catalogue, find_scenario_file, load_scenario
from plumbline.truth.certificate_file import parse_certificate
from plumbline.truth.certificate_proof import load_checker, prove_motion, reason_not_provable
from plumbline.truth.closed_form import exact_samples
from plumbline.truth.trajectory_truth import judge_claim

MAX_BODIES = 5
TITLE = "| scenario | radius, m | `prove`, CPU s | `verify`, CPU s | steps | bits | kB | error over claim |"


def table_row(scenario: Scenario) -> str:
    """Prove a motion, check its certificate, and judge the usual truth by it.

    Args:
        scenario: what is proved, over its duration.

    """
    start = time.process_time()
    raw, enclosure = prove_motion(scenario.model, scenario.state, scenario.times)
    proved = time.process_time()
    certificate = parse_certificate(raw)
    load_checker().enclose_motion(certificate)
    verified = time.process_time()
    ratio = judge_claim(
        scenario.model, scenario.state, scenario.times, enclosure, exact_samples(scenario, scenario.times)
    )
    name = scenario.name if scenario.duration == 2 else f"{scenario.name}, {scenario.duration:g} s"
    cells = name, f"{enclosure.radius('r'):.1e}", f"{proved - start:.1f}", f"{verified - proved:.1f}"
    cells = *cells, str(len(certificate.steps)), str(certificate.bits), str(len(raw) // 1000), f"{ratio:.2g}"
    return f"| {' | '.join(cells)} |"


def main(names: list[str]) -> None:
    """Print the table.

    Args:
        names: scenarios; none: all of at most five bodies that can be proved.

    """
    found = [load_scenario(path) for path in map(find_scenario_file, names)] or [
        scenario
        for scenario in map(load_scenario, catalogue().values())
        if scenario.model.n <= MAX_BODIES and not reason_not_provable(scenario.model)
    ]
    print(f"{TITLE}\n{'|---' * (TITLE.count('|') - 1)}|")
    for scenario in sorted(found, key=lambda s: s.model.n):
        print(table_row(scenario), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
