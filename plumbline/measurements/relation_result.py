"""The result of one metamorphic relation, before it is judged."""

from __future__ import annotations

from dataclasses import dataclass

from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import ENGINES

OTHER_FORMULATION_PREFIX = "as "  # names of relations: "as NAME" is the engine's other formulation NAME
OTHER_FORMULATIONS = {OTHER_FORMULATION_PREFIX + name: name for name in ENGINES}
OPTION_PREFIX = "by "  # "by NAME" is another algorithm or linear solver of the same engine

UNEXPLAINED = "unexplained"  # in a row's `extra`: `RelationResult.unexplained`
REPEATABILITY = "repeatability"  # equal questions, equal bits: the ratio is the largest relative difference


@dataclass(frozen=True)
class RelationResult:
    """The worst difference between two sides of a relation, over what rounding explains."""

    relation: str
    ratio: float | None  # difference over tolerance; None where the engine refused, failed or was not asked
    quantity: str = ""  # of the worst difference
    worst_state: int = 0  # index of its state
    state_count: int = 0  # number of states that were compared
    no_answer: NoAnswer | None = None  # where the engine refused or failed
    undecided: str = ""  # why no difference within the tolerance shows that the relation holds
    remark: str = ""  # on what the engine refused or failed besides
    note: str = ""  # why it was not asked, or how two answers to one question differ but in numbers
    integrator: str = "-"  # of a relation of runs
    steps: int = 0  # of a run, there and back
    resolution: float = 0.0  # of a run: its step [s], or its relative tolerance
    end_time: float = 0.0  # [s] of a run, one way
    unexplained: float | None = None  # the ratio without the effect of a term that the engine leaves out
