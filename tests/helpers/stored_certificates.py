"""Small certificates with what they prove, stored beside the tests of the checker.

``python -m tests.helpers.stored_certificates`` writes them again, which a change of the file's format needs.
Midpoints are those of an enclosure in octuple precision from another certificate; radii are the checker's.
"""

from __future__ import annotations

import gzip
import json
from functools import cache
from itertools import cycle, islice
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from plumbline.model.datatypes import Model, State
from plumbline.model.random_mechanisms import ELEMENTS
from plumbline.model.sampling import random_states
from plumbline.truth import certificate_proof
from plumbline.truth.certificate_file import JOINTS, SHAPES, parse_certificate
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.random_chains import random_chain, tree_from_seed

FOLDER = Path(__file__).parents[1] / "truth" / "certificates"
QUANTITIES = ("r", "p", "v", "omega")
BITS = 60  # of the coefficients: less than any that `prove` writes, for short files and quick tests
TIMES = np.array([0.0, 0.03, 0.04, 0.1])
SCENARIOS = ("lagrange-top",)
TREES: dict[str, tuple[int, tuple[Any, ...]]] = {  # seed, and kinds of joints to draw from
    "rod-hinge-ball": (2, ("hinge", "ball", "universal", "rod")),
    "hinge-with-rod-and-universal": (11, ("hinge", "ball", "universal", "rod")),
    "slide-cylinder-weld": (2, ("free", "cylindrical", "weld", "slide")),
    "free-with-slide-and-weld": (11, ("free", "cylindrical", "weld", "slide")),
}
CHAINS: dict[str, tuple[int, ...]] = {"one-ball": (0,), "one-rod": (1,), "rod-and-ball": (1, 0)}
NAMES = (*CHAINS, *TREES, *SCENARIOS)


def stored_mechanism(name: str) -> tuple[Model, State]:
    """Return the mechanism of a stored certificate, and its initial state."""
    if name in CHAINS:
        return random_chain(1, CHAINS[name], loads=True, drag=True)
    if name in SCENARIOS:
        scenario = catalogue_scenario(name)
        return scenario.model, scenario.state
    seed, kinds = TREES[name]
    model = tree_from_seed(seed, 3, kinds, elements=ELEMENTS)
    (state,) = random_states(model, 1, 2)
    return model, state


@cache
def _read(name: str) -> tuple[str, dict[str, Any]]:
    """The document of a certificate as text, and what it proves."""
    expected = json.loads((FOLDER / "proved.json").read_text(encoding="utf-8"))[name]
    return gzip.decompress((FOLDER / f"{name}.json.gz").read_bytes()).decode(), expected


def stored_document(name: str) -> dict[str, Any]:
    """Return a new copy of a certificate's document."""
    document: dict[str, Any] = json.loads(_read(name)[0])
    return document


def proved(name: str) -> dict[str, Any]:
    """Return what a certificate proves: texts of the midpoints and numbers, the radii, by quantity."""
    return _read(name)[1]


def many_joints(count: int, springs: int, terms: int) -> dict[str, Any]:
    """Make a document with joints of all kinds and springs between points, all numbers zero or the least."""
    document = {name: stored_document("one-ball")[name] for name in ("format", "version", "bits", "times")}
    kinds: list[Any] = [*islice(cycle(JOINTS), count)]
    document |= {"time_exponent": 0, "kind": kinds, "far": [-1] * count, "springs": [[0, -1]] * springs}
    first: tuple[int, ...]
    for name, (shape, _) in SHAPES.items():
        first = () if name == "gravity" else (springs if name.startswith("spring") else count,)
        values = np.full(first + shape, 1e-100 if name == "mass" else 0.0)
        document[name] = np.frompyfunc(float.hex, 1, 1)(values).tolist()
    entries = (7 * p + 6 * u + 2 * slides + 4 * len(t) for u, p, slides, t in map(JOINTS.__getitem__, kinds))
    return document | {"steps": [[1, *[[0] * terms] * (sum(entries) + springs)]]}


def write_certificates() -> None:
    """Make every certificate and what it proves again."""
    FOLDER.mkdir(exist_ok=True)
    found: dict[str, Any] = {}
    for name in NAMES:
        mechanism = stored_mechanism(name)
        with mock.patch.dict(certificate_proof.BITS, quad=BITS):
            raw, wide = certificate_proof.prove_motion(*mechanism, TIMES)
        (FOLDER / f"{name}.json.gz").write_bytes(raw)
        _, narrow = certificate_proof.prove_motion(*mechanism, TIMES, precision="octuple")
        digits = np.frompyfunc(lambda ball: ball.mid().str(35, radius=False), 1, 1)
        radius = np.frompyfunc(lambda ball: float(f"{float(ball.rad()):.8e}"), 1, 1)
        found[name] = {
            key: {
                "midpoint": digits(getattr(narrow, key)).tolist(),
                "radius": radius(getattr(wide, key)).tolist(),
            }
            for key in QUANTITIES
        }
        print(name, mechanism[0].kind, len(parse_certificate(raw).steps), len(raw), wide.radius("r"))
    (FOLDER / "proved.json").write_text(json.dumps(found) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_certificates()
