"""Search for the smallest case that still shows a disagreement: greedy deletion of parts (delta debugging).

The search knows nothing of engines: a predicate says whether a case shows the disagreement.  Cases are
mechanisms, whose parts are bodies, time and numbers, and model files (`plumbline.model_files.xml_shrink`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import islice
from typing import Generic, Protocol, TypeVar

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, Array, Model, State
from plumbline.model.equivalent import bodies_between
from plumbline.model.kinematics import complete_state
from plumbline.processes.exceptions import PlumblineError

CLEAR_RATIO = 10.0  # a shrunk case exceeds its tolerance this many times, or half as often as the original
MIN_RUNS = 3  # of a refinement study: an extrapolation and its uncertainty need three
Case = TypeVar("Case")


def shrink(
    best: Case,
    passes: Iterable[Callable[[Case], Iterator[Case]]],
    shows: Callable[[Case], bool],
    is_over: Callable[[], bool],
) -> Case:
    """Take smaller cases as long as they show what the first one shows.

    Args:
        best: a case that shows it.
        passes: each lists smaller cases of a case. After one that shows it, the pass goes on at the same
            place of the new list: what was tried before stays as it was.
        shows: whether a case shows it.
        is_over: whether the best case so far has to do.

    """
    for smaller_cases in passes:
        place, cases = 0, smaller_cases(best)
        while not is_over() and (case := next(cases, None)) is not None:
            if shows(case):
                best, cases = case, islice(smaller_cases(case), place, None)
            else:
                place += 1
    return best


@dataclass(frozen=True, eq=False)
class ReproductionCase:
    """One state of a mechanism, or a refinement study that starts there."""

    model: Model
    state: State
    until: float = 0.0  # s, end of the runs
    steps: tuple[float, ...] = ()  # s, coarse to fine; empty where only the state is evaluated

    @property
    def content(self) -> tuple[object, ...]:
        """Every number of the case, hashable: equal for equal cases."""
        fields = (*self.model.fields.values(), *vars(self.state).values())
        numbers = tuple(np.asarray(x).tobytes() for x in fields)
        return (*numbers, self.until, self.steps)


class Measurement(Protocol):
    """By how much a case shows the disagreement."""

    @property
    def ratio(self) -> float:
        """Error over tolerance: above 1 the engine disagrees."""


class OutOfTime(PlumblineError):
    """No case was found in the time that was given."""


M = TypeVar("M", bound=Measurement)


@dataclass
class _Search(Generic[M]):
    """The best case so far, and every measurement."""

    measure: Callable[[ReproductionCase], M | None]
    clock: Callable[[], float]
    deadline: float
    required_ratio: float = 1.0
    case: ReproductionCase | None = None
    best: M | None = None
    is_late: bool = False  # whether a candidate was skipped for want of time; the first state never is
    measured: dict[tuple[object, ...], M | None] = field(default_factory=dict)
    # that were the best: a change that rounding undoes leads back to one, and the search would not end
    accepted: set[tuple[object, ...]] = field(default_factory=set)

    def accepts(self, case: ReproductionCase) -> bool:
        """Measure a case; where it shows enough, it becomes the best, once."""
        content = case.content
        if content in self.accepted:
            return False
        if content not in self.measured:
            if self.clock() > self.deadline and (self.best is not None or case.steps):
                self.is_late = True
                return False
            self.measured[content] = self.measure(case)
        found = self.measured[content]
        if found is None or found.ratio <= 1 or found.ratio < self.required_ratio:
            return False
        self.case, self.best = case, found
        self.accepted.add(content)
        return True


def smallest_case(
    case: ReproductionCase,
    measure: Callable[[ReproductionCase], M | None],
    ratio: float,
    seconds: float,
    clock: Callable[[], float] = time.process_time,
) -> M | None:
    """Find the smallest case that shows what a given case shows.

    Args:
        measure: returns a case's measurement, or None for a case that cannot be measured.
        ratio: by how much the given case exceeds its tolerance.
        seconds: time for the search [s], on the clock below.
        clock: returns the time [s]; by default CPU time, so that a busy machine finds the same cases.

    Returns:
        The measurement of the smallest case found, or None where no case shows the disagreement.

    Raises:
        OutOfTime: nothing was found before the time was over, and not every candidate was measured.

    """
    search: _Search[M] = _Search(measure, clock, clock() + seconds)
    # in two rounds: each simplification may cost some of what is shown
    for clear in (100 * CLEAR_RATIO, CLEAR_RATIO):
        search.required_ratio = max(min(ratio / 2, clear), 1.0)
        if search.case is None and not any(map(search.accepts, starting_cases(case))):
            continue
        assert search.case is not None
        runs = 2 * [_shorter_run, _fewer_steps] if case.steps else []
        numbers = [partial(_changed_once, change) for change in _simplifications(search.case.model)]
        shrink(search.case, [fewer_bodies, *runs, *numbers], search.accepts, lambda: False)
    if search.best is None:
        search.required_ratio = 1.0
        search.accepts(case)
    if search.best is None and search.is_late:
        raise OutOfTime
    return search.best


def starting_cases(case: ReproductionCase) -> Iterator[ReproductionCase]:
    """List cases to begin with.

    Yields:
        Shorter runs of fewer bodies from cheap to expensive, the whole case last; a single state as it is.

    """
    n = case.model.n
    if not case.steps:
        yield case
        return
    counts = [2**k for k in range(n.bit_length()) if 2**k < n] + [n]
    spans = [case.until / 4**k for k in range(3) if case.until / 4**k >= case.steps[0]]
    for span, count in sorted(((s, c) for s in spans for c in counts), key=lambda x: x[0] * x[1]):
        yield from _parts(replace(case, until=span), count)


def _parts(case: ReproductionCase, count: int) -> Iterator[ReproductionCase]:
    """Yield the first bodies, and the last ones hung from the pivot."""
    for first in sorted({0, case.model.n - count}):
        model, state = bodies_between(case.model, case.state, first, first + count)
        yield replace(case, model=model, state=complete_state(model, state))


def fewer_bodies(case: ReproductionCase) -> Iterator[ReproductionCase]:
    """List parts of a mechanism, its first bodies and its last ones.

    Yields:
        One body, two, four …, then all but … four, two, one: a quick way to few, and between them.

    """
    n = case.model.n
    powers = [2**k for k in range(n.bit_length()) if 2**k < n]
    for count in sorted({*powers, *(n - power for power in powers)}):
        yield from _parts(case, count)


def _shorter_run(case: ReproductionCase) -> Iterator[ReproductionCase]:
    """Half the time, down to one of the coarsest steps."""
    if case.until / 2 >= case.steps[0]:
        yield replace(case, until=case.until / 2)


def _fewer_steps(case: ReproductionCase) -> Iterator[ReproductionCase]:
    """Without the finest steps, or the coarsest."""
    if len(case.steps) > MIN_RUNS:
        yield from (replace(case, steps=part) for part in (case.steps[:-1], case.steps[1:]))


_Change = Callable[[ReproductionCase], ReproductionCase]


def _changed_once(change: _Change, case: ReproductionCase) -> Iterator[ReproductionCase]:
    if (changed := change(case)).content != case.content:
        yield changed


def _changed(case: ReproductionCase, model: Model | None = None, **coordinates: Array) -> ReproductionCase:
    """Return a case with another model or other minimal coordinates, on its constraint manifold."""
    new, state = model or case.model, replace(case.state, **coordinates)
    rods = new.rods[: new.n, None]
    state = replace(state, u=state.u * rods, udot=state.udot * rods)
    return replace(case, model=new, state=complete_state(new, state))


def _with_fields(**make: Callable[[Array], Array]) -> _Change:
    """Change fields of the model."""
    return lambda case: _changed(
        case, case.model.changed(**{name: of(getattr(case.model, name)) for name, of in make.items()})
    )


def _with_rates(make: Callable[[Array], Array]) -> _Change:
    """Change the rates of bodies and rods."""
    names = ("omega", "udot", "xdot", "v")
    return lambda case: _changed(case, None, **{name: make(getattr(case.state, name)) for name in names})


def _with_attitudes(*quaternions: list[float]) -> _Change:
    """Give the bodies these attitudes, in turn."""
    return lambda case: _changed(case, p=np.resize(quaternions, (case.model.n, 4)))


def _with_directions(u: list[float]) -> _Change:
    """Point all rods in one direction (world frame)."""

    def change(case: ReproductionCase) -> ReproductionCase:
        udot = case.state.udot
        return _changed(case, u=np.tile(u, (case.model.n, 1)), udot=udot - np.outer(udot @ u, u))

    return change


def _simplifications(model: Model) -> Iterator[_Change]:
    """Yield simplifications to try one after the other, the boldest first."""
    zero, offsets = np.zeros_like, ("proximal", "distal")
    numbers = [
        _with_fields(force=zero, moment=zero),
        _with_fields(drag_force=zero, drag_moment=zero),
        *(_with_fields(**{name: zero}) for name in JOINT_ELEMENTS),
        _with_fields(gravity=lambda g: np.array([0.0, 0.0, -10.0])),
        *(
            _with_fields(**{name: lambda x: np.repeat(x[:1], len(x), 0)})
            for name in ("mass", "inertia", *offsets, "length")
        ),
        _with_fields(mass=np.ones_like),
        _with_fields(inertia=lambda x: np.repeat((0.1 * np.diag([1.0, 2.0, 2.0]))[None], len(x), 0)),
        *(
            _with_fields(**{name: lambda x: x * (np.abs(x) == np.max(np.abs(x), axis=-1, keepdims=True))})
            for name in offsets
        ),
        *(_with_fields(**{name: partial(_rounded, places=1)}) for name in (*offsets, "length")),
    ]
    yield lambda case: reduce(lambda so_far, change: change(so_far), numbers, case)  # all at once
    yield _with_fields(length=zero)
    yield _with_rates(zero)
    tilted = [0.6, 0.8, 0.0, 0.0]
    yield from (_with_attitudes([1.0, 0.0, 0.0, 0.0]), _with_attitudes(tilted))
    yield _with_attitudes(tilted, [0.6, 0.0, 0.8, 0.0])
    if np.any(model.rods):
        yield from (_with_directions([0.0, 0.0, -1.0]), _with_directions([0.6, 0.0, -0.8]))
    yield from numbers
    yield _with_fields(inertia=lambda x: x * np.eye(3))
    for name in ("mass", "length", *offsets, "inertia", "gravity", "moment", "force"):
        for places in (1, 2, 3):
            yield _with_fields(**{name: partial(_rounded, places=places)})
    yield _with_rates(lambda x: x if np.any(model.rods) else _rounded(x, 1))


def _rounded(x: Array, places: int) -> Array:
    """Round every number to so many digits of the largest in its array."""
    largest = float(np.max(np.abs(x), initial=0.0))
    return x if largest == 0 else np.round(x, places - 1 - int(np.floor(np.log10(largest)))) + 0.0
