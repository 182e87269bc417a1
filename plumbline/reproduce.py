"""A disagreement as a short script that an engine's maintainer can run: the engine and numpy, nothing else.

The model and state that disagree are shrunk first, to the fewest bodies and the simplest numbers that
still show it, each try asked of the engine again and measured with the certified truth.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from plumbline import store
from plumbline.bound import state_bound
from plumbline.kinematics import lift
from plumbline.records import Array, Model, State, StateQuantities
from plumbline.registry import ENGINES, adapter
from plumbline.sampling import random_states, seed_of
from plumbline.truth.certified import certify
from plumbline.workers import Limits, Task, Workers

TEMPLATES = Path(__file__).parent / "scripts"
ENGINE_LINES = {
    "mujoco": ("mujoco", ["import mujoco"]),
    "pinocchio": ("pinocchio", ["import pinocchio as pin"]),
    "pinocchio-aba": ("pinocchio", ["import pinocchio as pin"]),
    "exudyn": ("exudyn", ["import exudyn as exu", "import exudyn.itemInterface as items"]),
}
PLAIN = 10.0  # rounding bounds: a shrunk case shows at least this, or half of what it showed
SCRIPTED = (
    "acceleration", "angular_acceleration", "joint_reaction", "kinetic_energy", "potential_energy",
    "angular_momentum",
)  # fmt: skip


class NotReproducible(ValueError):
    """No script can be made of that row; the message says why."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A case that shows the disagreement: what to write into a script."""

    model: Model
    state: State
    truth: StateQuantities
    bound: dict[str, Array]
    ratio: float  # worst error over its bound


def disputed(document: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows a script may be asked for: those that disagree."""
    return [row for row in document["rows"] if row["verdict"] == "disagrees"]


def write(
    folder: Path, keys: Sequence[str] | None = None, limits: Limits | None = None, jobs: int = 1
) -> dict[str, str]:
    """Scripts of rows (all that disagree by default) in folder/scripts; key → file name or why there is none.

    One script serves all rows of a cell.  index.json there lists the files by row key.
    """
    document = store.read(folder)
    rows = [row for row in disputed(document) if keys is None or row["key"] in keys]
    for key in set(keys or ()) - {row["key"] for row in rows}:
        near = get_close_matches(key, [row["key"] for row in disputed(document)], 1)
        raise NotReproducible(
            f"no row {key!r} disagrees here{f'; did you mean {near[0]!r}?' if near else ''}"
        )
    scripts = folder / "scripts"
    if keys is None and scripts.is_dir():  # of an earlier run in the same folder
        for old in (*scripts.glob("*.py"), *scripts.glob("index.json")):
            old.unlink()
    told: dict[str, str] = {}
    tasks: list[Task] = []
    cells: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        try:
            case = found(document, row)
        except NotReproducible as why:
            told[row["key"]] = str(why)
            continue
        cell = (row["scenario"], row["engine"])
        cells.setdefault(cell, []).append(row)
        if len(cells[cell]) == 1:
            tasks.append(Task(cell, shrunk, (row["engine"], *case), limits or Limits()))
    if not tasks:
        return told
    scripts.mkdir(exist_ok=True)
    with Workers(jobs, limits) as workers:
        for outcome in workers.run(tasks):
            for row in cells[outcome.key]:
                if not isinstance(outcome.value, Shown):
                    told[row["key"]] = outcome.lost or "asked again, the engine agrees: nothing to show"
                    continue
                name = file_name(cells[outcome.key][0]["key"])
                text = script(row["engine"], outcome.value, cells[outcome.key][0])
                store.write_atomically(scripts / name, text.encode())
                told[row["key"]] = name
    index = {key: name for key, name in told.items() if (scripts / name).is_file()}
    before = scripts / "index.json"
    if before.exists():
        index = json.loads(before.read_text(encoding="utf-8")) | index
    store.write_atomically(before, json.dumps(index, indent=1).encode())
    return told


def found(document: dict[str, Any], row: dict[str, Any]) -> tuple[Model, State]:
    """Model and state of a row of results.json; NotReproducible where there is no single state to show."""
    engine = row["engine"]
    if "@" in engine:
        raise NotReproducible(f"{engine} runs in an environment of its own, which scripts are not made in")
    if row["level"] != "state":
        raise NotReproducible("only state-level rows have a script: there is no single state in a trajectory")
    if engine not in ENGINE_LINES:
        offered = ", ".join(e for e in ENGINES if e in ENGINE_LINES)
        raise NotReproducible(f"no script template for {engine}; there are: {offered}")
    about = document["scenarios"][row["scenario"]]
    model = Model(**{name: np.array(value, float) for name, value in about["model"].items()})
    index = int(row["extra"]["state"])
    if index == 0:
        start = {name: np.array(value, float) for name, value in about["state"].items()}
        return model, lift(model, **start)
    return model, random_states(model, index, seed_of("states", about["digest"]))[-1]


# --- shrinking ----------------------------------------------------------------------------------


def shown(engine: str, model: Model, state: State) -> Shown | None:
    """What an engine makes of a state, measured; None where it cannot be measured."""
    try:
        (said,) = adapter(engine).evaluate(model, [state])
        truth, allowed = certify(model, state).quantities, state_bound(model, state)
    except Exception:  # a candidate that the engine, the truth or the bound refuses shows nothing
        return None
    bounds = {q: np.asarray(allowed.tolerance(q), float) for q in SCRIPTED}
    ratios = [
        np.max(length_of(np.asarray(getattr(said, q) - getattr(truth, q))) / np.maximum(bounds[q], 1e-300))
        for q in SCRIPTED
        if getattr(said, q) is not None
    ]
    return Shown(model, state, truth, bounds, float(max(ratios)))


def length_of(difference: Array) -> Array:
    """Euclidean length along the last axis of a vector, size of a number."""
    return np.asarray(np.abs(difference) if difference.ndim == 0 else np.linalg.norm(difference, axis=-1))


def shrunk(engine: str, model: Model, state: State) -> Shown | None:
    """The smallest case found that shows the disagreement; None where the engine agrees."""
    best = shown(engine, model, state)
    if best is None or best.ratio <= 1:
        return None
    most = enough = best.ratio

    def take(candidate: tuple[Model, State]) -> bool:
        nonlocal best
        case = shown(engine, *candidate)
        if case is None or case.ratio < enough:
            return False
        best = case
        return True

    for goal in (100 * PLAIN, PLAIN):  # in two rounds: each simplification may cost some of what is shown
        enough = max(min(most / 2, goal), 1.0)
        any(take(part) for part in fewer(best.model, best.state))
        for change in simpler(best.model):
            take(change(best.model, best.state))
    return best


def fewer(model: Model, state: State) -> Iterator[tuple[Model, State]]:
    """The first bodies, then the last ones hung from the pivot, in growing number."""
    for count in range(1, model.n):
        for part in (slice(0, count), slice(model.n - count, model.n)):
            lone = replace(model, **{k: v[part] for k, v in vars(model).items() if k != "gravity"})
            yield lone, lift(lone, state.p[part], state.omega[part], state.u[part], state.udot[part])


Change = Callable[[Model, State], tuple[Model, State]]


def simpler(model: Model) -> Iterator[Change]:
    """Simplifications to try one after the other, the boldest first."""

    def numbers(**fields: Array) -> Change:
        def change(m: Model, s: State) -> tuple[Model, State]:
            new = replace(m, **fields)
            return new, lift(new, s.p, s.omega, s.u, s.udot)

        return change

    def field(name: str, make: Callable[[Array], Array]) -> Change:
        def change(m: Model, s: State) -> tuple[Model, State]:
            new = replace(m, **{name: make(getattr(m, name))})
            return new, lift(new, s.p, s.omega, s.u, s.udot)

        return change

    def rates(make: Callable[[Array], Array]) -> Change:
        return lambda m, s: (m, lift(m, s.p, make(s.omega), s.u, make(s.udot)))

    def attitudes(make: Callable[[int], list[float]]) -> Change:
        return lambda m, s: (m, lift(m, np.array([make(k) for k in range(m.n)]), s.omega, s.u, s.udot))

    n = model.n
    yield numbers(force=np.zeros((n, 3)), moment=np.zeros((n, 3)))
    yield numbers(drag_force=np.zeros(n), drag_moment=np.zeros(n))
    yield rates(np.zeros_like)
    yield field("gravity", lambda g: np.array([0.0, 0.0, -10.0]))
    yield attitudes(lambda k: [1.0, 0.0, 0.0, 0.0])
    yield attitudes(lambda k: [0.6, 0.8, 0.0, 0.0])
    yield attitudes(lambda k: [[0.6, 0.8, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0]][k % 2])
    for name in ("mass", "inertia", "proximal", "distal", "length"):
        yield field(name, lambda x: np.repeat(x[:1], len(x), 0))
    yield field("mass", np.ones_like)
    yield field("inertia", lambda x: np.repeat((0.1 * np.diag([1.0, 2.0, 2.0]))[None], len(x), 0))
    yield field("inertia", lambda x: x * np.eye(3))
    for name in ("proximal", "distal"):
        yield field(name, lambda x: x * (np.abs(x) == np.max(np.abs(x), axis=-1, keepdims=True)))
    for name in ("mass", "length", "proximal", "distal", "inertia", "gravity", "moment", "force"):
        for places in (1, 2, 3):
            yield field(name, lambda x, places=places: rounded(x, places))  # type: ignore[misc]
    yield lambda m, s: (m, lift(m, s.p, rounded(s.omega, 1), s.u, s.udot))


def rounded(x: Array, places: int) -> Array:
    """Every number to so many digits of the largest in its array."""
    largest = float(np.max(np.abs(x), initial=0.0))
    return x if largest == 0 else np.round(x, places - 1 - int(np.floor(np.log10(largest)))) + 0.0


# --- writing ------------------------------------------------------------------------------------


def script(engine: str, case: Shown, row: dict[str, Any]) -> str:
    """The stand-alone script; texts of the row stay text, whatever characters they hold."""
    template, imports = ENGINE_LINES[engine]
    about = [
        f"{row['engine']!a} {row['engine_version']!a} against certified truth: {case.ratio:.3g} times",
        f"what rounding explains. Shrunk from state {int(row['extra']['state'])} of scenario",
        f"{row['scenario']!a}.",
        "",
        "An open chain of rigid bodies hung from the world origin. SI units, world z up; quaternions",
        "scalar first, body to world; joint k is a ball joint (length 0) or a massless rod with a ball",
        "joint at both ends.",
    ]
    lines = [f"# {line}".rstrip() for line in about] + ["", *imports, "import numpy as np", ""]
    if template == "pinocchio":
        lines += [f"ALGORITHM = {'aba' if engine.endswith('aba') else 'crba'!r}", ""]
    lines += [literal(name, getattr(case.model, name), about) for name, about in MODEL_WORDS.items()]
    lines += [literal(name, getattr(case.state, name), about) for name, about in STATE_WORDS.items()]
    lines += ["", "# certified: enclosed in ball arithmetic, rounded to double once", "certified = {"]
    for q in SCRIPTED:
        lines.append(f"    {q!r}: {nested(np.asarray(getattr(case.truth, q)), '    ')},")
    lines += [
        "}",
        "# largest Euclidean norm of the difference (per body) that rounding in double explains",
        "bound = {",
    ]
    lines += [f"    {q!r}: {nested(case.bound[q], '    ')}," for q in SCRIPTED]
    lines += ["}", "", ""]
    parts = [(TEMPLATES / f"{name}.txt").read_text(encoding="utf-8") for name in ("common", template, "end")]
    return "\n".join(lines) + "\n\n\n".join(part.strip("\n") for part in parts) + "\n"


MODEL_WORDS = {
    "mass": "kg",
    "inertia": "kg m², about the centre of mass, body frame",
    "proximal": "m, body frame, from the centre of mass: where the body hangs",
    "distal": "m, body frame: where the next body hangs",
    "length": "m, of the rod above each body; 0 for a ball joint",
    "gravity": "m/s²",
    "force": "N, at the centre of mass, world frame",
    "moment": "N m, body frame",
    "drag_force": "N s/m",
    "drag_moment": "N m s",
}
STATE_WORDS = {
    "p": "attitudes",
    "omega": "rad/s, angular velocity, body frame",
    "u": "direction of the rods, world frame",
    "udot": "1/s, their rate",
}


def literal(name: str, value: Array, about: str) -> str:
    """One array as an assignment that reads back to the same doubles."""
    return f"{name} = np.array({nested(value)})  # {about}"


def nested(value: Array, indent: str = "") -> str:
    """A list literal, equal rows once and others one a line; floats by repr, so that nothing is rounded."""
    if value.ndim and len(value) > 1 and np.all(value == value[0]):
        return f"[{nested(value[0], indent)}] * {len(value)}"
    if value.ndim < 2:
        return repr(value.tolist())
    inner = "".join(f"{indent}    {nested(row, indent + '    ')},\n" for row in value)
    return f"[\n{inner}{indent}]"


def file_name(key: str) -> str:
    """A file name of safe characters, unique to the key."""
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", key).strip("-.")[:80]
    return f"{safe}-{hashlib.sha256(key.encode()).hexdigest()[:8]}.py"
