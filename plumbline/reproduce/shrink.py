"""The smallest case that still shows a disagreement: fewest bodies, shortest run, simplest numbers.

Knows nothing of engines: a measure says by how much a case shows it, and every try is measured again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Generic, Protocol, TypeVar

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import state_from_minimal
from plumbline.processes.errors import PlumblineError

PLAIN = 10.0  # times the tolerance: a shrunk case shows at least this, or half of what it showed
FEWEST = 3  # runs of a ladder: what an extrapolation and its uncertainty need
SHORTEST = 2.0**-6  # s, of a run with an adaptive step


@dataclass(frozen=True, eq=False)
class Case:
    """What is asked of an engine: a state, or a run from it to ``until`` (s) at each of ``steps``.

    ``steps``, coarse to fine, are in s or, for an adaptive integrator, relative tolerances.
    """

    model: Model
    state: State
    until: float = 0.0
    steps: tuple[float, ...] = ()

    @property
    def content(self) -> tuple[object, ...]:
        """What tells two cases apart."""
        state = (getattr(self.state, k) for k in ("p", "omega", "u", "udot"))
        numbers = tuple(np.asarray(x).tobytes() for x in (*vars(self.model).values(), *state))
        return (*numbers, self.until, self.steps)


class Measured(Protocol):
    """A case and by how much it shows the disagreement, in tolerances."""

    @property
    def case(self) -> Case:
        """What was asked."""

    @property
    def ratio(self) -> float:
        """Error over tolerance: above 1 it disagrees."""


class OutOfTime(PlumblineError):
    """No case was found in the time that was given."""


M = TypeVar("M", bound=Measured)


@dataclass
class Search(Generic[M]):
    """The best case so far.  ``measure`` gives None for a case that cannot be measured."""

    measure: Callable[[Case], M | None]
    clock: Callable[[], float]
    deadline: float
    enough: float = 1.0
    best: M | None = None
    late: bool = False  # whether something was left untried for want of time; a first state is always tried
    tried: dict[tuple[object, ...], M | None] = field(default_factory=dict)

    def take(self, case: Case) -> bool:
        """Whether a case shows enough; it is the best then."""
        content = case.content
        if content not in self.tried:
            if self.clock() > self.deadline and (self.best is not None or case.steps):
                self.late = True
                return False
            self.tried[content] = self.measure(case)
        found = self.tried[content]
        if found is None or found.ratio <= 1 or found.ratio < self.enough:
            return False
        self.best = found
        return True

    def first(self, cases: Iterable[Case]) -> bool:
        """Take the first case that shows enough."""
        return any(self.take(case) for case in cases)

    @property
    def case(self) -> Case:
        """Of the best so far."""
        assert self.best is not None
        return self.best.case


def smallest(
    case: Case,
    measure: Callable[[Case], M | None],
    most: float,
    seconds: float,
    coarsest: bool = True,
    clock: Callable[[], float] = time.process_time,
    plainer: bool = True,
) -> M | None:
    """The smallest case found within ``seconds`` that shows what ``case`` shows; None where none does.

    ``most`` is by how much it showed.  ``coarsest``: a run is at least one of its coarsest steps long.
    ``plainer``: with fewer bodies and simpler numbers; else only runs are shortened.
    The clock is that of computing by default: a busy machine finds no other cases.  OutOfTime where none
    was found before all were tried.
    """
    search: Search[M] = Search(measure, clock, clock() + seconds)
    for goal in (100 * PLAIN, PLAIN):  # in two rounds: each simplification may cost some of what is shown
        search.enough = max(min(most / 2, goal), 1.0)
        if search.best is None and not search.first(growing(case, plainer)):
            continue
        if plainer:
            fewest_bodies(search)
        for _ in range(2 if search.case.steps else 0):
            shortest_run(search, coarsest)
            fewest_steps(search)
        for change in simpler(search.case.model) if plainer else ():
            search.take(change(search.case))
    if search.best is None:
        search.enough = 1.0
        search.first([case])
    if search.best is None and search.late:
        raise OutOfTime
    return search.best


def growing(case: Case, plainer: bool = True) -> Iterator[Case]:
    """Cases of a run from cheap to dear, the whole one last; a single state as it is."""
    n = case.model.n
    counts = [2**k for k in range(n.bit_length()) if plainer and 2**k < n] + [n]
    quarters = max(3, 1 + int(np.log2(max(case.until, 1.0)) / 2))  # down to some seconds, of long runs
    spans = [case.until / 4**k for k in range(quarters)] if case.steps else [case.until]
    for span, count in sorted(((s, c) for s in spans for c in counts), key=lambda x: x[0] * x[1]):
        if case.steps and span < case.steps[0]:
            continue
        if case.steps or count == n:
            yield from parts(replace(case, until=span), count)


def parts(case: Case, count: int, ends: Iterable[bool] = (False, True)) -> Iterator[Case]:
    """The first bodies, and the last ones hung from the pivot."""
    model, state, n = case.model, case.state, case.model.n
    for last in ends if count < n else (False,):
        part = slice(n - count, n) if last else slice(0, count)
        few = replace(model, **{k: v[part] for k, v in vars(model).items() if k != "gravity"})
        at = state_from_minimal(few, state.p[part], state.omega[part], state.u[part], state.udot[part])
        yield replace(case, model=few, state=at)


def fewest_bodies(search: Search[M]) -> None:
    """Double the number of bodies until it shows, then halve the interval, at the end where it showed."""
    ends, low, count = [False, True], 0, 1

    def shows(count: int) -> bool:
        for last in ends:
            if search.first(parts(search.case, count, [last])):
                ends[:] = [last]
                return True
        return False

    while count < search.case.model.n and not shows(count):
        low, count = count, 2 * count
    while search.case.model.n - low > 1:
        middle = (low + search.case.model.n) // 2
        if not shows(middle):
            low = middle


def shortest_run(search: Search[M], coarsest: bool) -> None:
    """Halve the time while it shows."""
    while search.case.until / 2 >= (search.case.steps[0] if coarsest else SHORTEST):
        if not search.take(replace(search.case, until=search.case.until / 2)):
            return


def fewest_steps(search: Search[M]) -> None:
    """Leave out the finest steps, then the coarsest."""
    for part in (slice(None, -1), slice(1, None)):
        while len(search.case.steps) > FEWEST and search.take(
            replace(search.case, steps=search.case.steps[part])
        ):
            pass


Change = Callable[[Case], Case]


def simpler(model: Model) -> Iterator[Change]:
    """Simplifications to try one after the other, the boldest first."""

    def fields(**make: Callable[[Array], Array]) -> Change:
        def change(case: Case) -> Case:
            m, s = case.model, case.state
            new = replace(m, **{name: of(getattr(m, name)) for name, of in make.items()})
            rod = new.rods[:, None]
            return replace(
                case, model=new, state=state_from_minimal(new, s.p, s.omega, s.u * rod, s.udot * rod)
            )

        return change

    def rates(make: Callable[[Array], Array]) -> Change:
        def change(case: Case) -> Case:
            s = case.state
            return replace(case, state=state_from_minimal(case.model, s.p, make(s.omega), s.u, make(s.udot)))

        return change

    def attitudes(make: Callable[[int], list[float]]) -> Change:
        def change(case: Case) -> Case:
            m, s = case.model, case.state
            p = np.array([make(k) for k in range(m.n)])
            return replace(case, state=state_from_minimal(m, p, s.omega, s.u, s.udot))

        return change

    def directions(u: list[float]) -> Change:
        def change(case: Case) -> Case:
            m, s = case.model, case.state
            along = np.where(m.rods[:, None], u, 0.0)
            across = s.udot - np.sum(s.udot * along, axis=1, keepdims=True) * along
            return replace(case, state=state_from_minimal(m, s.p, s.omega, along, across))

        return change

    zero, offsets = np.zeros_like, ("proximal", "distal")
    numbers = [
        fields(force=zero, moment=zero),
        fields(drag_force=zero, drag_moment=zero),
        fields(gravity=lambda g: np.array([0.0, 0.0, -10.0])),
        *(
            fields(**{name: lambda x: np.repeat(x[:1], len(x), 0)})
            for name in ("mass", "inertia", *offsets, "length")
        ),
        fields(mass=np.ones_like),
        fields(inertia=lambda x: np.repeat((0.1 * np.diag([1.0, 2.0, 2.0]))[None], len(x), 0)),
        *(
            fields(**{name: lambda x: x * (np.abs(x) == np.max(np.abs(x), axis=-1, keepdims=True))})
            for name in offsets
        ),
        *(fields(**{name: partial(rounded, places=1)}) for name in (*offsets, "length")),
    ]
    yield lambda case: reduce(lambda so_far, change: change(so_far), numbers, case)  # all at once
    yield fields(length=zero)
    yield rates(zero)
    yield attitudes(lambda k: [1.0, 0.0, 0.0, 0.0])
    yield attitudes(lambda k: [0.6, 0.8, 0.0, 0.0])
    yield attitudes(lambda k: [[0.6, 0.8, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0]][k % 2])
    if np.any(model.rods):
        yield directions([0.0, 0.0, -1.0])
        yield directions([0.6, 0.0, -0.8])
    yield from numbers
    yield fields(inertia=lambda x: x * np.eye(3))
    for name in ("mass", "length", *offsets, "inertia", "gravity", "moment", "force"):
        for places in (1, 2, 3):
            yield fields(**{name: partial(rounded, places=places)})
    yield rates(lambda x: x if np.any(model.rods) else rounded(x, 1))


def rounded(x: Array, places: int) -> Array:
    """Every number to so many digits of the largest in its array."""
    largest = float(np.max(np.abs(x), initial=0.0))
    return x if largest == 0 else np.round(x, places - 1 - int(np.floor(np.log10(largest)))) + 0.0
