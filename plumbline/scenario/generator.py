"""Random scenarios: full inertias, masses over decades, slow to fast, loads and drag.

Chains on rods and balls, some of them compared along their motion, and mechanisms: trees and loops on any mix
of joints, free bodies, rotors, springs, dampers and efforts.  Scenario k of a seed depends on the seed and k
alone, so one of ten thousand can be made without the others.  Each is the content of a scenario file and
passes the checks of one.  Two of five chains have special values in place of generic ones: rare branches of
an engine are taken at exact zeros, identities and equalities.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import overload

import numpy as np

from plumbline.model.datatypes import BALL, FREE, KINDS, ROD, WELD
from plumbline.model.features import ROLES, Place
from plumbline.model.random_mechanisms import (
    ELEMENTS,
    LOOP_KINDS,
    mechanism_with_places,
    random_loop_mechanism,
    random_tree,
)
from plumbline.model.sampling import derive_seed, random_states
from plumbline.scenario.loader import Scenario, scenario_from_dict
from plumbline.scenario.mechanism_document import Content, mechanism_document

RANDOM_FAMILY = "random"
MAX_RANDOM_BODIES = 10
MASS_DECADES = 3.0  # masses in a wild scenario reach from 1e-3 to 1e3 kg; in a tame one 0.1 to 10 kg
MAX_MOTION_BODIES = 3
MOTION_MOMENT = 0.02  # moments of loads and drag in a random motion, over those of other random scenarios
MOTION_PREFIX = "random-motion-"
MECHANISM_PREFIX = "random-mechanism-"
# of joints in random mechanisms
PLACES = [Place(kind, role) for role in ROLES for kind in KINDS if (kind, role) != (FREE, "closing")]
MAX_PLACES = 12  # of a random mechanism; it has a few joints more
MAX_LOOP_BODIES = 8  # of random mechanisms with loops
SPECIAL_INDICES = (0, 2)  # modulo 5: of scenarios with special values
SPECIAL_CHANCE = 0.4  # of each kind of special value in such a scenario
MOTION_SAMPLE = 2.0**-5  # s, the coarsest step of an order-4 method; the work of loads is a quadrature
RANDOM_PURPOSE = (
    "Nobody chose it, so nobody's blind spot shaped it: generic geometry, full inertia, rates and loads "
    "shows any mistake that a symmetric or planar case hides."
)


class RandomScenarios(Sequence[Scenario]):
    """The first scenarios of a seed: ``motion_count`` random motions, ``count`` chains, then mechanisms.

    Each is made when it is accessed.
    """

    def __init__(self, seed: int, count: int, motion_count: int = 0, mechanism_count: int = 0) -> None:
        self.seed = seed
        counts = {random_motion: motion_count, random_scenario: count, random_mechanism: mechanism_count}
        self._drawn = [(make, k) for make, some in counts.items() for k in range(some)]

    def __len__(self) -> int:
        """How many."""
        return len(self._drawn)

    @overload
    def __getitem__(self, index: int) -> Scenario: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scenario]: ...
    def __getitem__(self, index: int | slice) -> Scenario | list[Scenario]:
        """Scenario k."""
        if isinstance(index, slice):
            return [make(self.seed, k) for make, k in self._drawn[index]]
        make, k = self._drawn[index]
        return make(self.seed, k)

    @property
    def mechanisms(self) -> list[Scenario]:
        """Those on any mix of joints."""
        return [make(self.seed, k) for make, k in self._drawn if make is random_mechanism]

    def named(self, name: str) -> Scenario:
        """Make the scenario of a name.

        Args:
            name: ``random-SEED-INDEX``, ``random-motion-SEED-INDEX`` or ``random-mechanism-SEED-INDEX``, of
                this seed.

        """
        makers = {MOTION_PREFIX: random_motion, MECHANISM_PREFIX: random_mechanism}
        make = next((make for prefix, make in makers.items() if name.startswith(prefix)), random_scenario)
        return make(self.seed, int(name.rpartition("-")[2]))


def random_seed(name: str) -> int | None:
    """Find the seed in the name of a random scenario.

    Args:
        name: name of any scenario.

    Returns:
        The seed; None where the name is not one that `RandomScenarios` gives.

    """
    found = re.fullmatch(rf"({MOTION_PREFIX}|{MECHANISM_PREFIX}|{RANDOM_FAMILY}-)(\d+)-\d+", name, re.ASCII)
    return int(found[2]) if found else None


def random_scenario(seed: int, index: int) -> Scenario:
    """Make one scenario of a seed.

    Args:
        index: the scenario's place in the batch, from 0; other scenarios need not be made first.

    Returns:
        The scenario, named ``random-SEED-INDEX``.

    """
    content = random_document(seed, index)
    return scenario_from_dict(content, f"{content['name']}.yaml")


def random_motion(seed: int, index: int) -> Scenario:
    """Make one random scenario whose motion can be resolved in time: short, moderate rates, similar masses.

    Args:
        index: the scenario's place among the batch's motions, from 0.

    Returns:
        The scenario, named ``random-motion-SEED-INDEX``.

    """
    rng = np.random.default_rng(derive_seed("random motion", str(seed), str(index)))
    n = int(rng.integers(1, MAX_MOTION_BODIES + 1))
    rate, gravity = 10 ** rng.uniform(-0.5, 0.3, 2)  # rad/s, m/s²
    direction = rng.normal(size=3)
    loaded, dragged = rng.random(2) < 0.5
    bodies = [_random_body(rng, 0.3, rate, bool(loaded), bool(dragged), i == n - 1) for i in range(n)]
    for body in bodies:  # moments that turn a body in a second, not in the time between two samples
        if "load" in body:
            body["load"]["moment"] = [MOTION_MOMENT * x for x in body["load"]["moment"]]
        if "drag" in body:
            body["drag"]["moment"] *= MOTION_MOMENT
    content = _document(MOTION_PREFIX, seed, index, n, "", 0.5) | {
        "sample": MOTION_SAMPLE,
        "gravity": (gravity / np.linalg.norm(direction) * direction).tolist(),
        "bodies": bodies,
    }
    _specialize(content, "random motion", seed, index, MOTION_MOMENT)
    return scenario_from_dict(content, f"{content['name']}.yaml")


def random_mechanism(seed: int, index: int) -> Scenario:
    """Make one random mechanism of a seed.

    Of four, one is a tree, one has one or two loops, and two have joints of random kinds in random roles: any
    three features of mechanisms come together in some of them.

    Args:
        index: the scenario's place among the batch's mechanisms, from 0.

    Returns:
        The scenario, named ``random-mechanism-SEED-INDEX``.

    """
    own = derive_seed("random mechanism", str(seed), str(index))
    rng = np.random.default_rng(own)
    # half of them bare, the others with some of the elements, or all
    elements = tuple(name for name in ELEMENTS if rng.random() < 0.6) if rng.random() < 0.5 else ()
    kinds = [kind for kind in KINDS if rng.random() < 0.7] or list(KINDS)
    if index % 4 > 1:
        places = rng.choice(len(PLACES), size=int(rng.integers(6, MAX_PLACES + 1)), replace=False)
        few = tuple(name for name in ELEMENTS if rng.random() < 0.8)
        model, state = mechanism_with_places(own, [PLACES[i] for i in places], few, rng.random() < 0.3)
        n = model.n
    elif index % 4 == 1:
        n = int(np.clip(1 + rng.geometric(0.3), 2, MAX_LOOP_BODIES))
        closing = (*LOOP_KINDS, WELD)
        count = 1 if n < 4 else int(rng.integers(1, 3))
        chosen = [closing[i] for i in rng.integers(len(closing), size=count)]
        model, state = random_loop_mechanism(own, n, chosen, tuple(KINDS), elements)
    else:
        n = int(np.clip(rng.geometric(0.2), 1, MAX_RANDOM_BODIES))
        model = random_tree(rng, n, kinds, bool(rng.random() < 0.5), elements)
        (state,) = random_states(model, 1, own)
    joints = ", ".join(dict.fromkeys(model.kind))
    content = _document(MECHANISM_PREFIX, seed, index, n, f", {joints}", 1.0)
    content |= mechanism_document(model, state)
    return scenario_from_dict(content, f"{content['name']}.yaml")


def random_document(seed: int, index: int) -> Content:
    """Make the content of the file of one random scenario.

    Args:
        index: the scenario's place in the batch, from 0.

    Returns:
        Plain data; every number is finite and survives a round trip through JSON.

    """
    rng = np.random.default_rng(derive_seed("random scenario", str(seed), str(index)))
    n = int(np.clip(rng.geometric(0.3), 1, MAX_RANDOM_BODIES))  # short chains most often
    wild = bool(rng.random() < 0.25)
    decades = MASS_DECADES if wild else 1.0
    rate = 10 ** rng.uniform(-1.0, 1.0)  # rad/s
    loaded, dragged = rng.random(2) < 0.3
    content = _document("random-", seed, index, n, ", wild masses" * wild, 1.0)
    content["bodies"] = [
        _random_body(rng, decades, rate, bool(loaded), bool(dragged), i == n - 1) for i in range(n)
    ]
    _specialize(content, "random scenario", seed, index, 1.0)
    return content


def _document(prefix: str, seed: int, index: int, n: int, more: str, duration: float) -> Content:
    """The texts and the duration [s] of a scenario of n bodies; its title ends with ``more``."""
    what = prefix.replace("-", " ").capitalize() + f"{index} of seed {seed}"
    return {
        "schema_version": 1,
        "name": f"{prefix}{seed}-{index}",
        "family": RANDOM_FAMILY,
        "title": f"{what}: {n} {'body' if n == 1 else 'bodies'}{more}",
        "purpose": RANDOM_PURPOSE,
        "duration": duration,
    }


def _random_body(
    rng: np.random.Generator, decades: float, rate: float, has_load: bool, has_drag: bool, is_last: bool
) -> Content:
    """Make one body of a chain; its inertia is that of a turned ellipsoid, so always physical."""
    mass = 10 ** rng.uniform(-decades, decades)
    squares = rng.uniform(0.05, 0.5, 3) ** 2  # m², semi-axes
    found: Content = {
        "mass": mass,
        "inertia": {
            "principal": (mass / 5 * (squares.sum() - squares)).tolist(),
            "axes": {"quaternion": rng.normal(size=4).tolist()},
        },
        "proximal": (0.3 * rng.normal(size=3)).tolist(),
        "attitude": {"quaternion": rng.normal(size=4).tolist()},
        "angular_velocity": (rate * rng.normal(size=3)).tolist(),
        "joint": {"kind": BALL},
    }
    if rng.random() < 0.4:
        found["joint"] = {
            "kind": ROD,
            "length": 10 ** rng.uniform(-1.0, 0.3),
            "direction": rng.normal(size=3).tolist(),
            "angular_velocity": (rate * rng.normal(size=3)).tolist(),
        }
    if not is_last:
        found["distal"] = (0.3 * rng.normal(size=3)).tolist()
    if has_load:
        found["load"] = {
            "force": (mass * rng.normal(size=3)).tolist(),
            "moment": (mass * rng.normal(size=3)).tolist(),
        }
    if has_drag:
        found["drag"] = {"force": mass * rng.uniform(0.0, 1.0), "moment": mass * rng.uniform(0.0, 0.1)}
    return found


# --- special values -------------------------------------------------------------------------------


def _specialize(content: Content, kind: str, seed: int, index: int, moment: float) -> None:
    """Give a scenario special values, where its turn has come; ``moment`` is a factor on moments of loads.

    They come from random numbers of their own: all other scenarios are what they would be without.
    """
    if index % 5 not in SPECIAL_INDICES:
        return
    rng = np.random.default_rng(derive_seed(f"special values of a {kind}", str(seed), str(index)))
    changes: dict[str, Callable[[np.random.Generator, Content], None]] = {
        "an attitude": _set_attitude,
        "zeros": _set_zeros,
        "an inertia": _set_inertia,
        "loads": partial(_set_loads, moment=moment),
    }
    made = [what for what in changes if rng.random() < SPECIAL_CHANCE] or [str(rng.choice(list(changes)))]
    for what in made:
        some = rng.random(len(content["bodies"])) < 0.6
        for body, is_changed in zip(content["bodies"], some, strict=True):
            if is_changed or len(some) == 1:
                changes[what](rng, body)
    if rng.random() < SPECIAL_CHANCE / 2:
        made.append("equal masses")
        for body in content["bodies"]:
            _scale_mass(body, content["bodies"][0]["mass"] / body["mass"])
    if rng.random() < SPECIAL_CHANCE:
        made.append("gravity")
        direction = rng.choice([0.0, 1.0], 3) * rng.normal(size=3)
        content["gravity"] = (10 ** rng.uniform(-1.0, 1.0) * direction).tolist()
    if rng.random() < SPECIAL_CHANCE / 4:
        made.append("all attitudes the identity")
        for body in content["bodies"]:
            body["attitude"] = {"quaternion": [1.0, 0.0, 0.0, 0.0]}
    content["title"] += f"; special: {', '.join(made)}"


def _set_attitude(rng: np.random.Generator, body: Content) -> None:
    """Make the attitude the identity, a turn about one axis, or one with a negative scalar or none."""
    axis = np.eye(3)[rng.integers(3)] * rng.normal()
    turn = np.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0], [rng.normal(), *axis], [0, *axis],
                     [-abs(rng.normal()), *rng.normal(size=3)]])  # fmt: skip
    body["attitude"] = {"quaternion": turn[rng.choice(5, p=[0.5, 0.1, 0.2, 0.1, 0.1])].tolist()}


def _set_zeros(rng: np.random.Generator, body: Content) -> None:
    """Set components of offsets and rates to zero; a rod along a coordinate axis, a body at rest."""
    for name in ("proximal", "distal", "angular_velocity"):
        if name in body:
            kept = np.eye(3, dtype=bool)[rng.integers(3)] | (rng.random(3) < 0.4)
            body[name] = np.where(kept, body[name], 0.0).tolist()
    if rng.random() < 0.3:
        body["angular_velocity"] = [0.0, 0.0, 0.0]
    if body["joint"]["kind"] == ROD:
        axis = np.eye(3)[rng.integers(3)] * rng.choice([-1.0, 1.0])
        body["joint"] |= {"direction": axis.tolist()}
        if rng.random() < 0.3:
            body["joint"] |= {"angular_velocity": [0.0, 0.0, 0.0]}


def _set_inertia(rng: np.random.Generator, body: Content) -> None:
    """Make the inertia that of a ball, of a body of revolution, or diagonal."""
    first, second, third = body["inertia"]["principal"]
    values = [[first] * 3, [first, first, min(third, 1.9 * first)], [first, second, third]]
    turned = body["inertia"]["axes"] if rng.random() < 0.3 else {"quaternion": [1.0, 0.0, 0.0, 0.0]}
    body["inertia"] = {"principal": values[rng.integers(3)], "axes": turned}


def _set_loads(rng: np.random.Generator, body: Content, moment: float) -> None:
    """Give the body loads and drag of its own, of forces or moments or both."""
    mass, zero = body["mass"], [0.0, 0.0, 0.0]
    force, torque = mass * rng.normal(size=(2, 3)) * [[1.0], [moment]]
    if rng.random() < 0.7:
        has = rng.random(2) < 0.6
        body["load"] = {"force": force.tolist() if has[0] else zero,
                        "moment": torque.tolist() if has[1] or not has[0] else zero}  # fmt: skip
    if rng.random() < 0.7:
        drag = mass * rng.uniform(size=2) * [1.0, 0.1 * moment] * [rng.random() < 0.7, rng.random() < 0.7]
        body["drag"] = {"force": float(drag[0]), "moment": float(drag[1])}


def _scale_mass(body: Content, factor: float) -> None:
    """Multiply the mass and what is in proportion to it."""
    body["mass"] *= factor
    body["inertia"]["principal"] = [factor * x for x in body["inertia"]["principal"]]
    for what in ("load", "drag"):
        for name, value in body.get(what, {}).items():
            body[what][name] = [factor * x for x in value] if isinstance(value, list) else factor * value
