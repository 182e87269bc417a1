"""Every step of runs of random mechanisms: false alarms, and how much of its bounds an honest engine uses.

    python -m plumbline.studies.random_steps 300 > random_steps.jsonl

prints the rows of all engines and fixed-step integrators that have a ratio as lines of JSON; and to stderr
those that disagree or fail, and by integrator the median of error over bound.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.judging.step_level import judge_steps
from plumbline.measurements.single_steps import run_step_study
from plumbline.model.datatypes import KINDS, Model, State
from plumbline.model.random_mechanisms import ELEMENTS, random_loop_mechanism, random_tree
from plumbline.model.sampling import random_states

CLOSING = [name for name, kind in KINDS.items() if [what for what, _ in kind.motions] == ["turn", "turn"]]


def mechanism_of(seed: int) -> tuple[Model, State]:
    """Draw a tree of one to six bodies, or of every third seed a loop of three to five, and a state."""
    rng = np.random.default_rng([30, seed])
    if seed % 3 == 2:
        return random_loop_mechanism(seed, int(rng.integers(3, 6)), CLOSING[:1], elements=ELEMENTS)
    model = random_tree(rng, int(rng.integers(1, 7)), elements=ELEMENTS if seed % 2 else ())
    return model, random_states(model, 1, seed)[0]


def rows_of(seed: int) -> Iterator[Row]:
    """Compare every step of a run from its state on all engines."""
    model, state = mechanism_of(seed)
    for engine in ENGINES:
        context = RowContext(f"random-steps-{seed}", "random", engine, engine, "")
        for integrator in load_adapter(engine).integrators:
            if integrator.method is not None:
                answer = run_step_study(engine, integrator, model, [state])
                yield from judge_steps(context, integrator, model, [state], answer).rows


def main() -> None:
    """Compare on so many mechanisms, from the first or from a given one on."""
    count, first = (*map(int, sys.argv[1:3]), 0)[:2]
    ratios = defaultdict[tuple[str, str], list[float]](list)
    for seed in range(first, first + count):
        for row in rows_of(seed):
            if row.ratio is None and row.verdict != Verdict.FAILED:
                continue
            fields = (row.engine, row.integrator, row.quantity, row.verdict, row.ratio)
            print(json.dumps([seed, *fields, row.extra.get("left_out_wrong_steps", 0.0)]), flush=True)
            if row.verdict in (Verdict.DISAGREES, Verdict.FAILED):
                print(f"{row.key}: {row.reason}", file=sys.stderr, flush=True)
            elif row.ratio is not None:
                ratios[row.engine, row.integrator].append(row.ratio)
    for (engine, integrator), some in ratios.items():
        median = float(np.median(some))
        print(f"{engine} {integrator}: {len(some)} rows, median {median:.2g} of the bound", file=sys.stderr)


if __name__ == "__main__":
    main()
