"""Search for the smallest case that shows a disagreement: fewest bodies, shortest run, simplest numbers.

The search knows nothing of engines: a measure returns by how much a case shows the disagreement, and every
candidate is measured again.
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
from plumbline.processes.exceptions import PlumblineError

CLEAR_RATIO = 10.0  # a shrunk case exceeds its tolerance this many times, or half as often as the original
MIN_RUNS = 3  # of a refinement study: an extrapolation and its uncertainty need three


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
        state = (getattr(self.state, name) for name in ("p", "omega", "u", "udot"))
        numbers = tuple(np.asarray(x).tobytes() for x in (*self.model.fields.values(), *state))
        return (*numbers, self.until, self.steps)


class Measurement(Protocol):
    """A case, and by how much it shows the disagreement."""

    @property
    def case(self) -> ReproductionCase:
        """The measured case."""

    @property
    def ratio(self) -> float:
        """Error over tolerance: above 1 the engine disagrees."""


class OutOfTime(PlumblineError):
    """No case was found in the time that was given."""


M = TypeVar("M", bound=Measurement)


@dataclass
class _Search(Generic[M]):
    """The best case so far."""

    measure: Callable[[ReproductionCase], M | None]
    clock: Callable[[], float]
    deadline: float
    required_ratio: float = 1.0
    best: M | None = None
    is_late: bool = False  # whether a candidate was skipped for want of time; the first state never is
    measured: dict[tuple[object, ...], M | None] = field(default_factory=dict)

    def accepts(self, case: ReproductionCase) -> bool:
        """Measure a case; where it shows enough, it becomes the best."""
        content = case.content
        if content not in self.measured:
            if self.clock() > self.deadline and (self.best is not None or case.steps):
                self.is_late = True
                return False
            self.measured[content] = self.measure(case)
        found = self.measured[content]
        if found is None or found.ratio <= 1 or found.ratio < self.required_ratio:
            return False
        self.best = found
        return True

    def accepts_any(self, cases: Iterable[ReproductionCase]) -> bool:
        """Take the first case that shows enough."""
        return any(self.accepts(case) for case in cases)

    @property
    def case(self) -> ReproductionCase:
        """The best case so far."""
        assert self.best is not None
        return self.best.case


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
        if search.best is None and not search.accepts_any(starting_cases(case)):
            continue
        _reduce_bodies(search)
        for _ in range(2 if search.case.steps else 0):
            _shorten_run(search)
            _reduce_steps(search)
        for change in _simplifications(search.case.model):
            search.accepts(change(search.case))
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


def _parts(
    case: ReproductionCase, count: int, ends: Iterable[bool] = (False, True)
) -> Iterator[ReproductionCase]:
    """Yield the first bodies, and the last ones hung from the pivot."""
    model, state, n = case.model, case.state, case.model.n
    for is_last in ends if count < n else (False,):
        part = slice(n - count, n) if is_last else slice(0, count)
        few = Model.chain(**{k: v if k == "gravity" else v[part] for k, v in model.fields.items()})
        at = {name: getattr(state, name)[part] for name in ("p", "omega", "u", "udot")}
        yield _changed(case, few, **at)


def _reduce_bodies(search: _Search[M]) -> None:
    """Double the number of bodies until they show it, then bisect, at the end of the chain that showed it."""
    ends, low, count = [False, True], 0, 1

    def shows(count: int) -> bool:
        for is_last in ends:
            if search.accepts_any(_parts(search.case, count, [is_last])):
                ends[:] = [is_last]
                return True
        return False

    while count < search.case.model.n and not shows(count):
        low, count = count, 2 * count
    while search.case.model.n - low > 1:
        middle = (low + search.case.model.n) // 2
        if not shows(middle):
            low = middle


def _shorten_run(search: _Search[M]) -> None:
    """Halve the time, down to one of the coarsest steps."""
    while search.case.until / 2 >= search.case.steps[0]:
        if not search.accepts(replace(search.case, until=search.case.until / 2)):
            return


def _reduce_steps(search: _Search[M]) -> None:
    """Leave out the finest steps, then the coarsest."""
    for part in (slice(None, -1), slice(1, None)):
        while len(search.case.steps) > MIN_RUNS and search.accepts(
            replace(search.case, steps=search.case.steps[part])
        ):
            pass


_Change = Callable[[ReproductionCase], ReproductionCase]


def _changed(case: ReproductionCase, model: Model | None = None, **coordinates: Array) -> ReproductionCase:
    """Return a case with another model or other minimal coordinates, on its constraint manifold."""
    new, state = model or case.model, case.state
    given = {name: getattr(state, name) for name in ("p", "omega", "u", "udot")} | coordinates
    given |= {name: given[name] * new.rods[:, None] for name in ("u", "udot")}
    return replace(case, model=new, state=state_from_minimal(new, **given))


def _with_fields(**make: Callable[[Array], Array]) -> _Change:
    """Change fields of the model."""
    return lambda case: _changed(
        case, case.model.changed(**{name: of(getattr(case.model, name)) for name, of in make.items()})
    )


def _with_rates(make: Callable[[Array], Array]) -> _Change:
    """Change the rates of bodies and rods."""
    return lambda case: _changed(case, omega=make(case.state.omega), udot=make(case.state.udot))


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
