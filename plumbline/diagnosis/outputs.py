"""Table of what an engine or its adapter may return in place of a quantity, with right equations behind it.

A quantity may be of another frame, point, time, body or precision, or a multiple; or it lacks, doubles or
reverses the part that a load, an element, a closing joint or a body has in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from plumbline.diagnosis.cause import Cause, quantity_words, significant
from plumbline.diagnosis.edits import WORDS, gyroscopic_moment
from plumbline.diagnosis.prediction import (
    WRENCHES,
    Answers,
    Case,
    determinate,
    error_ratio,
    per_entry,
    projectors_at,
    single_states,
)
from plumbline.diagnosis.terms import is_spanned, open_end_rows
from plumbline.equations.arithmetic import floats, stacked
from plumbline.equations.responses import EndRows, Responses
from plumbline.equations.tree import SUMS, Tree
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import JointFrame, cross, rotate_vectors, rotation_matrix
from plumbline.model.loops import CutMechanism, cut_open
from plumbline.truth.rounding_bound import TINY

Choose = Callable[[Array], Array]  # of the rows of some bodies or joints
Causes = tuple[Cause, ...]  # that act together; none where nothing explains
MakeCause = Callable[..., Cause]  # of words and amounts
SINGLE_ROUNDING = 1e-5  # of the largest value: what computing in single precision may cost
MAX_RATIO = 2.0  # in bounds: of what is returned and of the right quantity
FACTOR_ROUNDING = 1e-6  # of a fitted share of a part: a word for 0, 1, 2 or −1 times
LOADS = ("force", "moment", "drag_force", "drag_moment")
SPRINGS, CLOSING_JOINTS = "the springs between points", "those of the closing joints"
VANISHING = 1e-9  # of a unit wrench: what rounding leaves of one
MAX_PARTS = 1000  # of which every two are tried
SHARES = {-1.0: "without {}", 1.0: "with twice {}", -2.0: "with {} of the opposite sign"}


@dataclass(frozen=True, eq=False)
class Part:
    """What has a part in a quantity, and how large it is."""

    what: str
    value: Array
    about: str = ""  # of the moment that a joint's force has about another point: the point
    every: str = ""  # the same of all bodies, joints or springs, where it is of one of them
    free: Array | None = None  # (…, m) what besides may be in it, by unknown amounts at each state

    @property
    def sort(self) -> str:
        """What it is called wherever it is."""
        return self.every or self.what


@dataclass(frozen=True, eq=False)
class Outputs:
    """The right quantities of S states, and what an engine might return instead."""

    case: Case  # states with attitudes, velocities and positions of all bodies
    right: Answers
    previous: Answers  # those of the state before each
    bounds: Answers  # (S,) or (S, N)

    def name(self, quantity: str, reported: Array) -> Causes:
        """Find what was returned in place of one quantity; nothing where nothing known explains it."""
        whole = self._of_places(quantity, reported, None)
        bound, off = self.bounds[quantity], reported - self.right[quantity]
        if whole or bound.ndim == 1:
            return whole
        wrong = [k for k in range(bound.shape[1]) if not error_ratio(off[:, k], bound[:, k]) <= 1]
        some = self._of_places(quantity, reported, wrong) if 0 < len(wrong) < bound.shape[1] else ()
        return some or self._exchanged(quantity, reported, wrong)

    def _exchanged(self, quantity: str, reported: Array, wrong: list[int]) -> Causes:
        """Rows that are those of other bodies."""
        source, count = {}, reported.shape[1]
        for k in wrong:
            others = (j for j in range(count) if j != k and self._is_that_of(quantity, reported, k, j))
            source[k] = next(others, -1)
        if not source or -1 in source.values():
            return ()
        thing = _thing(quantity)
        of = " and ".join(f"{thing} {k + 1}" for k in wrong)
        as_that = " and ".join(f"{thing} {source[k] + 1}" for k in wrong)
        is_swap = len(wrong) == 2 and source == {wrong[0]: wrong[1], wrong[1]: wrong[0]}
        place, change = (of, "exchanged") if is_swap else (as_that, f"as that of {of}")
        words = quantity_words([quantity])
        return (Cause("output", words, place, change, general=f"of another {thing}"),)

    def _is_that_of(self, quantity: str, reported: Array, k: int, j: int) -> bool:
        """Whether row k is what row j should be."""
        bound, right = self.bounds[quantity], self.right[quantity]
        return error_ratio(reported[:, k] - right[:, j], MAX_RATIO * (bound[:, k] + bound[:, j])) <= 1

    def _of_places(self, quantity: str, reported: Array, places: list[int] | None) -> Causes:
        """What was returned in place of a quantity of all bodies or joints, or of some."""

        def chosen(x: Array) -> Array:
            return x if places is None else x[:, places]

        bound, right, given = chosen(self.bounds[quantity]), chosen(self.right[quantity]), chosen(reported)
        thing = _thing(quantity)
        place = "" if places is None else " and ".join(f"{thing} {k + 1}" for k in places)

        def cause(change: str, *amount: float) -> Cause:
            return Cause("output", quantity_words([quantity]), place, change, amount, states=len(given))

        def matches(x: Array, rows: slice = slice(None)) -> bool:
            """Whether x is what was reported, and differs from what is right by more than both bounds."""
            if not error_ratio((given - x)[rows], (MAX_RATIO * bound)[rows]) <= 1:
                return False
            return error_ratio((x - right)[rows], (MAX_RATIO * bound)[rows]) > MAX_RATIO

        if len(given) > 2 and matches(chosen(self.previous[quantity]), slice(1, None)):
            return (cause("of the previous state (a stale field)"),)
        for change, value in self._whole(quantity):
            if matches(chosen(value)):
                return (cause(change),)
        weight = 1 / per_entry(bound, given)
        square = max(float(np.sum((right * weight) ** 2)), TINY)
        factor = float(np.sum(given * right * weight**2) / square)
        uncertainty = 1 / np.sqrt(square)
        if matches(factor * right):
            if abs(factor + 1) <= max(1e-9, 10 * uncertainty):
                return (cause("with the opposite sign"),)
            amount = (significant(factor, 1.0, uncertainty),)
            return (replace(cause("multiplied by"), nominal=(1.0,), amount=amount),)
        found = self._lacking(quantity, given, chosen, cause)
        if found:
            return found
        is_near = np.max(np.abs(given - right)) <= SINGLE_ROUNDING * np.max(np.abs(right))
        if is_near and np.any(given) and np.all(given == np.asarray(given, np.float32)):
            return (cause("rounded to single precision"),)
        offset = np.mean(given - right, axis=0)
        if len(given) > 2 and matches(right + offset):
            if quantity == "potential_energy":
                words = "with another origin, at every state larger by"
                return (cause(words, float(f"{offset:.6g}")),)
            return (cause("with a constant added at every state"),)
        return ()

    # -- whole quantities --------------------------------------------------------------------------

    def _whole(self, quantity: str) -> Iterator[tuple[str, Array]]:
        """What a quantity may be as a whole, in words, with its value."""
        model, state = self.case.model, self.case.state
        right = self.right[quantity]
        turns = self._turns
        if quantity == "acceleration":
            omega = np.matvec(turns, state.omega)
            g, point = model.gravity[..., None, :], model.proximal[: model.n]
            swing = np.cross(state.omega, np.cross(state.omega, point))
            arm = np.matvec(turns, np.cross(self.right["angular_acceleration"], point) + swing)
            words = "as the spatial acceleration (r̈ − ω × ṙ) instead of the classical one"
            yield words, right - cross(omega, state.v)
            yield "minus gravity", right - g
            yield "plus gravity", right + g
            yield "of the joint's point", right + arm
        if quantity in ("acceleration", *WRENCHES):
            far, near = model.body[: right.shape[1]].T
            yield "in the body frame", np.matvec(turns[:, near].mT, right)
            if np.any(far >= 0):
                above = np.where((far >= 0)[:, None, None], turns[:, far].mT, np.eye(3))
                yield "in the frame of the body before", np.matvec(above, right)
        if quantity == "angular_acceleration":
            yield "in the world frame", np.matvec(turns, right)
            axes = rotation_matrix(model.turn[: model.n, 1]).mT
            yield "in the axes of its joint", np.matvec(axes, right)
        if right.ndim == 3 and right.shape[1] > 1:
            thing, hangs = _thing(quantity), np.maximum(model.body[: right.shape[1], 0], 0)
            yield f"of another {thing}, the next one", np.roll(right, -1, 1)
            yield f"of another {thing}, the previous one", np.roll(right, 1, 1)
            yield f"of another {thing}, the one counted from the other end", right[:, ::-1]
            yield f"of another {thing}, the one on which it hangs", right[:, hangs]
        if quantity == "angular_momentum":
            momentum = np.sum(model.mass[..., None] * state.v, axis=1)
            spin = rotate_vectors(model.inertia, state.omega)
            yield "about the centre of mass", right - cross(self._centre, momentum)
            turned = right - np.sum(np.matvec(turns, spin) - spin, axis=1)
            yield "with the spin in body axes of all bodies", turned

    @cached_property
    def _centre(self) -> Array:
        """(S, 3) centre of mass of the whole."""
        mass, r = self.case.model.mass, self.case.state.r
        return np.asarray(np.sum(mass[..., None] * r, axis=1) / np.sum(mass, axis=-1)[..., None])

    @cached_property
    def _turns(self) -> Array:
        return rotation_matrix(self.case.state.p)

    # -- parts -------------------------------------------------------------------------------------

    def _lacking(self, quantity: str, given: Array, chosen: Choose, cause: MakeCause) -> Causes:
        """One part that has another share in a quantity, or two."""
        bound, right = chosen(self.bounds[quantity]), chosen(self.right[quantity])
        weight = 1 / per_entry(bound, given)
        off = ((given - right) * weight).ravel()
        if not np.all(np.isfinite(off)):
            return ()
        parts = self._parts(quantity)
        columns = [(chosen(part.value) * weight).ravel() for part in parts]
        visible = [i for i, x in enumerate(columns) if np.max(np.abs(x), initial=0.0) > MAX_RATIO]
        if not visible:
            return ()
        A = np.array([columns[i] for i in visible])
        square = np.sum(A * A, axis=1)
        shares = A @ off / square
        limit = 2 * MAX_RATIO
        left = np.max(np.abs(off - shares[:, None] * A), axis=1)
        named: list[Cause] = []
        for i in np.flatnonzero(left <= limit):
            if abs(shares[i]) * np.max(np.abs(A[i])) > limit:
                part = parts[visible[i]]
                words, amount = _share_words(float(shares[i]), part)
                general, _ = _share_words(float(shares[i]), replace(part, what=part.sort))
                named.append(replace(cause(words, *amount), general=general))
        states = np.repeat(range(len(given)), off.size // len(given))
        for k, x in zip(visible, A, strict=True):
            free = parts[k].free
            # at some joints alone any moment has the direction of what is indeterminate there
            if free is not None and not named and given.shape == self.right[quantity].shape:
                basis = (free * weight[..., None]).reshape(off.size, -1)
                unknowns = basis.shape[1] * len(given)
                is_telling = np.count_nonzero(np.abs(off) > limit) > 2 * unknowns
                if is_telling and is_spanned(basis, off - x, states, limit):
                    named.append(cause(parts[k].about))
        if named:
            exact = [one for one in named if not one.amount] or named
            return (replace(exact[0], equal=tuple(exact[1:])),)
        return self._two_parts(off, A, [parts[i] for i in visible], cause, limit)

    @staticmethod
    def _two_parts(off: Array, A: Array, parts: list[Part], cause: MakeCause, limit: float) -> Causes:
        """Two parts of shares in words: each lacks, counts twice or has the opposite sign."""
        if len(A) > MAX_PARTS:
            return ()

        def stated(share: float, part: Part) -> Cause:
            words = [part.about if part.about and share == 1 else SHARES[share].format(of)
                     for of in (part.what, part.sort)]  # fmt: skip
            return replace(cause(words[0]), general=words[1])

        gram, along, square = A @ A.T, A @ off, float(off @ off)
        size = np.diag(gram)
        found = list[Causes]()
        for a in SHARES:
            for b in SHARES:
                norm = square - 2 * (a * along[:, None] + b * along)
                norm = norm + a * a * size[:, None] + b * b * size + 2 * a * b * gram
                for i, j in zip(*np.nonzero(norm <= len(off) * limit**2 + 1e-9 * square), strict=True):
                    if i < j and np.max(np.abs(off - a * A[i] - b * A[j])) <= limit:
                        found.append((stated(a, parts[i]), stated(b, parts[j])))
        if not found:
            return ()
        first, *others = found
        equal: dict[Cause, list[Cause]] = {one: [] for one in first}
        for other in others[:2]:
            replaced, new = ([c for c in x if c not in y] for x, y in ((first, other), (other, first)))
            for one, instead in zip(replaced, new, strict=True):
                equal[one].append(instead)
        return tuple(replace(one, equal=tuple(own)) for one, own in equal.items())

    def _parts(self, quantity: str) -> list[Part]:
        if quantity in WRENCHES:
            i = WRENCHES.index(quantity)
            own = [
                replace(part, value=part.value[i], free=None if part.free is None else part.free[i])
                for part in self._wrench_parts
            ]
            return own + (self._levers if quantity == "joint_moment" else [])
        names = dict(zip(SUMS, ("_kinetic", "_potential", "_momentum"), strict=True))
        return getattr(self, names[quantity]) if quantity in names else []

    @cached_property
    def _kinetic(self) -> list[Part]:
        model, state = self.case.model, self.case.state
        moving = 0.5 * model.mass * np.sum(state.v**2, -1)
        turning = 0.5 * np.sum(state.omega * rotate_vectors(model.inertia, state.omega), -1)
        parts = {"{}": moving + turning, "the rotation of {}": turning, "the translation of {}": moving}
        return _of_bodies(parts) + self._energies(0, "rotor", "armature")

    @cached_property
    def _potential(self) -> list[Part]:
        model, state = self.case.model, self.case.state
        weight = -model.mass * np.sum(state.r * model.gravity[..., None, :], -1)
        between = self._energies(1, "", "spring_stiffness")
        if between:
            between.append(Part("all springs", self._energy(1, "stiffness", "spring_stiffness")))
        return _of_bodies({"the weight of {}": weight}) + self._energies(1, "spring", "stiffness") + between

    @cached_property
    def _momentum(self) -> list[Part]:
        model, state = self.case.model, self.case.state
        orbital = cross(state.r, model.mass[..., None] * state.v)
        spin = np.matvec(self._turns, rotate_vectors(model.inertia, state.omega))
        return _of_bodies({"{}": orbital + spin, "the spin of {}": spin, "the translation of {}": orbital})

    def _energies(self, which: int, word: str, name: str) -> list[Part]:
        """The parts of elements in kinetic (0) or potential energy (1): of the numbers of a field."""
        values, each = getattr(self.case.model, name), list[tuple[str, Array]]()
        for at in map(tuple, np.argwhere(values).tolist()):
            several = f" {at[1] + 1}" if len(at) > 1 and np.count_nonzero(values[at[0]]) > 1 else ""
            what = f"the {word} of joint {at[0] + 1}{several}" if word else f"spring {at[0] + 1}"
            each.append((what, self._energy(which, name, at=at)))
        return _each_and_all(f"that of the {word}s" if word else SPRINGS, each)

    def _energy(self, which: int, *names: str, at: tuple[int, ...] = ()) -> Array:
        """How much kinetic (0) or potential energy (1) a number, or whole fields, add."""
        found = self._added(lambda tree: tree.totals()[which], names, at)
        return np.broadcast_to(found, (len(self.case.state.p), 1, 1))[:, 0, 0]

    def _added(self, of: Callable[[Tree], Array], names: Sequence[str], at: tuple[int, ...] = ()) -> Array:
        """What numbers of some fields add to what is found of the mechanism, loops cut open."""
        state = self._cut.state(self.case.state)
        changes = {name: getattr(self.case.model, name).copy() for name in names}
        for values in changes.values():
            values[(..., *at)] = 0.0
        less = self._cut.with_numbers(replace(self.case.model, **changes)).model
        full, without = (of(Tree(floats(), one, state)) for one in (self._cut.model, less))
        return np.asarray(full - without)

    @cached_property
    def _cut(self) -> CutMechanism:
        return cut_open(self.case.model)

    # -- wrenches of joints ------------------------------------------------------------------------

    @cached_property
    def _near(self) -> Array:
        """(S, J, 3) near points, world frame."""
        body = self.case.model.body[:, 1]
        arm = np.matvec(self._turns[:, body], self.case.model.proximal)
        return np.asarray(self.case.state.r[:, body] + arm)

    @cached_property
    def _projectors(self) -> list[Array | None]:
        return projectors_at(self.case.model, single_states(self.case.state))

    def _determinate(self, wrenches: Array) -> Array:
        """What is determinate in loops of wrenches (2, S, J, 3)."""
        both = determinate(self.case.model, dict(zip(WRENCHES, wrenches, strict=True)), self._projectors)
        return np.array([both[name] for name in WRENCHES])

    def _carried(self, loads: Array, own: Array | float = 0.0) -> Array:
        """What joints carry (2, S, J, 3) of forces and moments (2, S, N, 3) at the centres of mass."""
        model, state = self.case.model, self.case.state
        carried = np.zeros((2, *self._near.shape)) + own
        for body in range(model.n):
            force, moment = loads[:, :, body]
            k = body
            while k >= 0:
                carried[0, :, k] -= force
                carried[1, :, k] -= moment + cross(state.r[:, body] - self._near[:, k], force)
                k = int(model.body[k, 0])
        return self._determinate(carried)

    @cached_property
    def _wrench_parts(self) -> list[Part]:
        model, state = self.case.model, self.case.state
        weight = np.zeros((2, *state.v.shape))
        weight[0] = model.mass[..., None] * model.gravity[..., None, :]
        loads = {"weight": weight}
        for name in LOADS:
            loads[WORDS[name]] = self._added(self._loads, [name])
        parts, bodies = list[Part](), np.arange(model.n)
        for what, load in loads.items():
            each = [load * (bodies == k)[:, None] for k in bodies]
            parts += self._carried_parts(f"the {what} of body {{}}", f"the {what}s", each)
        springs = ["spring_stiffness", "spring_damping"]
        are_damped = all(np.any(getattr(model, name)) for name in springs)
        for words, names in ("{}", springs), *((("the damping of {}", springs[1:]),) * are_damped):
            each = [self._added(self._loads, names, (i,)) for i in range(len(model.spring_body))]
            parts += self._carried_parts(words.format("spring {}"), words.format(SPRINGS), each)
        return parts + self._element_parts() + self._joint_parts()

    def _loads(self, tree: Tree) -> Array:
        """Forces and moments (2, S, N, 3) of the bodies by loads, drag and springs between points."""
        every = [stacked(some, (len(tree.state.p),)) for some in zip(*tree.loads(), strict=True)]
        return np.array(every)[:, :, self._cut.place[: self.case.model.n]]

    def _carried_parts(self, words: str, every: str, loads: Sequence[Array], first: int = 0) -> list[Part]:
        """What joints carry of each of some loads (2, S, N, 3), which are of places from the first on."""
        named = [(words.format(k), one) for k, one in enumerate(loads, first + 1) if np.any(one)]
        return _each_and_all(every, [(what, self._carried(one)) for what, one in named])

    def _element_parts(self) -> list[Part]:
        """Parts along the joints' own motions, which their elements have."""
        model, state = self.case.model, self.case.state
        efforts = {"springs": -model.stiffness[: model.n] * (state.x - model.rest[: model.n]),
                   "dampers": -model.damping[: model.n] * state.xdot,
                   "efforts": np.broadcast_to(model.effort[: model.n], state.x.shape)}  # fmt: skip
        values = {name: np.zeros((2, *self._near.shape)) for name in (*efforts, "rotors")}
        for k in range(model.n):
            far = int(model.body[k, 0])
            above = self._turns[:, far] if far >= 0 else np.eye(3)
            for i, (axis, *pair) in enumerate(JointFrame(model, k, above).axes(state.x[:, k])):
                row = int(pair[1] is not None)
                for name, amounts in efforts.items():
                    values[name][row, :, k] += amounts[:, k, i, None] * axis
                if np.any(model.armature[k]):
                    pairs = zip(WRENCHES, pair, strict=True)
                    held = sum(np.vecdot(e, self.right[name][:, k]) for name, e in pairs if e is not None)
                    total = sum(amounts[:, k, i] for amounts in efforts.values())
                    values["rotors"][row, :, k] += (held - total)[:, None] * axis
        parts, joints = list[Part](), np.arange(self._near.shape[1])[:, None]
        for name, value in values.items():
            each = [
                (f"that of the {name} of joint {k + 1}", self._determinate(value * (joints == k)))
                for k in np.flatnonzero(np.any(value, axis=(0, 1, 3)))
            ]
            parts += _each_and_all(f"those of the {name} of joints", each)
        everything = np.sum([values[name] for name in efforts], axis=0)
        if np.any(everything):
            parts.append(Part("those of their springs, dampers and efforts", self._determinate(everything)))
        return parts

    def _applied(self, k: int, force: Array, moment: Array) -> Array:
        """What joint k applies to its bodies (2, S, N, 3) by a force and a moment about its near point."""
        r, near = self.case.state.r, self._near[:, k]
        loads = np.zeros((2, *r.shape))
        for body, sign in zip(self.case.model.body[k], (-1.0, 1.0), strict=True):
            if body >= 0:
                loads[0, :, body] += sign * force
                loads[1, :, body] += sign * (moment + cross(near - r[:, body], force))
        return loads

    def _joint_parts(self) -> list[Part]:
        """What closing joints and children have in the wrenches of the joints before."""
        model, parts = self.case.model, list[Part]()
        force, moment = (self.right.get(name, np.zeros(self._near.shape)) for name in WRENCHES)
        for what, every, has_force in (
            ("that of", CLOSING_JOINTS, True),
            ("the moment of", "the moments of the closing joints", False),
        ):
            closing = range(model.n, len(model.kind))
            loads = [self._applied(k, has_force * force[:, k], moment[:, k]) for k in closing]
            parts += self._carried_parts(f"{what} the closing joint {{}}", every, loads, model.n)
        parts += self._welds_of_cuts()
        carried = np.zeros((2, *self._near.shape))
        for k in np.flatnonzero(model.body[: model.n, 0] >= 0).tolist():
            far = int(model.body[k, 0])
            carried[0, :, far] += force[:, k]
            carried[1, :, far] += moment[:, k] + cross(self._near[:, k] - self._near[:, far], force[:, k])
        if np.any(carried):
            parts.append(Part("what the bodies beyond apply", self._determinate(carried)))
        return parts

    @cached_property
    def _motion_of_cuts(self) -> Responses:
        """The tree of the loops cut open, by the rows of its ends that give the accelerations, if any do."""
        cut, state = self._cut, self._cut.state(self.case.state)
        ways: list[EndRows] = [*open_end_rows(cut.model), "accelerations"]
        bound, bodies = MAX_RATIO * self.bounds["angular_acceleration"], cut.place[: self.case.model.n]
        for way in ways:
            found = Responses(cut.model, state, cut.ends, cut.row_scale, way)
            turning = np.matvec(self._turns.mT, found.solution[:, bodies, 1])
            if error_ratio(turning - self.right["angular_acceleration"], bound) <= 1:
                break
        return found

    def _welds_of_cuts(self) -> list[Part]:
        """Moments of the welds that hold the parts of bodies that are cut so that loops are open.

        A part has a share of its body's mass and inertia, and its own acceleration where the weld's rows are
        wrong; on it act the closing joint, gravity and the weld.  What loops leave indeterminate of the
        closing joint's wrench is in the weld's moment, by an unknown amount.
        """
        model, state = self.case.model, self.case.state
        if not model.has_loops or not self.right.keys() >= {"acceleration", *WRENCHES}:
            return []
        motion, cut, number = self._motion_of_cuts, self._cut, np.arange(len(model.kind))[:, None]
        gyroscopic, each = gyroscopic_moment(self.case), list[tuple[str, Array]]()
        total, free = 0.0 * self._near, list[Array]()

        def carried(k: int, weld: Array) -> Array:
            own = np.array([0.0, 1.0])[:, None, None, None] * weld[:, None] * (number == k)
            return -self._carried(self._applied(k, 0 * weld, weld), own)

        def of_multipliers(k: int, weld: Array) -> Array:  # a quaternion's rows have 2 Aᵀ N
            return carried(k, 2 * np.matvec(self._turns[:, int(model.body[k, 1])].mT, weld) - weld)

        for k in range(model.n, len(model.kind)):
            body, place = int(model.body[k, 1]), int(cut.place[k])
            turn, arm = self._turns[:, body], self._near[:, k] - state.r[:, body]
            turning = np.matvec(turn.mT, motion.solution[:, place, 1])
            inertial = np.matvec(model.inertia[..., body, :, :], turning) + gyroscopic[:, body]
            force, moment = (self.right[name][:, k] for name in WRENCHES)
            weld = float(cut.share[place]) * np.matvec(turn, inertial) - moment - cross(arm, force)
            each.append((f"the moment of the weld in body {body + 1}", carried(k, weld)))
            total = total + of_multipliers(k, weld)
            for force, moment in motion.indeterminate_wrenches(place):
                value = of_multipliers(k, -moment - cross(arm, force))
                if np.max(np.abs(value)) > VANISHING:
                    free.append(np.where(np.abs(value) > VANISHING, value, 0.0))
        what = "the moments of the welds in cut bodies"
        multipliers = Part(f"the multipliers of {what}", total, f"with {what} doubled and in body axes",
                           free=np.stack(free, -1) if free else None)  # fmt: skip
        return [multipliers, *_each_and_all(what, each)]

    @cached_property
    def _levers(self) -> list[Part]:
        """Moments that joints' forces have about other points, of all joints or of those of one kind."""
        model, state = self.case.model, self.case.state
        far = model.body[:, 0]
        hung = np.where((far < 0)[:, None], model.point[:, 0],
                        state.r[:, far] + np.matvec(self._turns[:, far], model.point[:, 0]))  # fmt: skip
        carrying = self._near.copy()
        for k in range(model.n):
            if model.kinds[k].is_rigid and far[k] >= 0:
                carrying[:, k] = carrying[:, far[k]]
        points = {"the centres of mass": state.r[:, model.body[:, 1]], "the world's origin": 0 * self._near,
                  "the centre of mass of the whole": np.broadcast_to(self._centre[:, None], self._near.shape),
                  "the far points": hung, "the points of the joints that carry welds": carrying}  # fmt: skip
        parts = list[Part]()
        for what, point in points.items():
            lever, known = cross(self._near - point, self.right["joint_reaction"]), list[Array]()
            for kind in ("joint", *dict.fromkeys(model.kind)):
                moment = lever * np.array([kind in ("joint", own) for own in model.kind])[:, None]
                if any(np.array_equal(moment, one) for one in known):
                    continue  # no other joints have such an arm: it has the name of all
                known.append(moment)
                moment = self._determinate(np.array([0 * lever, moment]))[1]
                parts.append(Part(f"the arm of {kind}s to {what}", moment, f"of {kind}s about {what}"))
        return parts


def _share_words(share: float, part: Part) -> tuple[str, tuple[float, ...]]:
    """Words where a part is counted 1 + share times, and the number; of arms 1 − share."""
    if part.about:
        if abs(share - 1) < FACTOR_ROUNDING:
            return part.about, ()
        return f"with {part.what} multiplied by", (float(f"{1 - share:.6g}"),)
    for value, words in SHARES.items():
        if abs(share - value) < FACTOR_ROUNDING:
            return words.format(part.what), ()
    return f"with {part.what} multiplied by", (float(f"{1 + share:.6g}"),)


def _of_bodies(values: dict[str, Array]) -> list[Part]:
    """Parts (S, N[, 3]) of each body, and of all but where that is the whole."""
    parts = list[Part]()
    for words, x in values.items():
        each = [(words.format(f"body {k + 1}"), x[:, k]) for k in range(x.shape[1])]
        found = _each_and_all(words.format("all bodies"), each)
        parts += found if words != "{}" else found[1:]
    return parts


def _each_and_all(every: str, each: Sequence[tuple[str, Array]]) -> list[Part]:
    """A part of all places, where there are several, and one of each."""
    total = [Part(every, np.sum([value for _, value in each], axis=0))] if len(each) > 1 else []
    return total + [Part(what, value, every=every) for what, value in each]


def _thing(quantity: str) -> str:
    return "joint" if quantity in WRENCHES else "body"
