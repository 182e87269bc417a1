"""The text of a stand-alone script: literals of a shrunk case between the parts in scripts/*.txt.

A part's lines between ``#if A B`` and ``#end`` stand in the script where all of A, B hold of the case.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from packaging.version import InvalidVersion, Version

from plumbline.engines.environments import split_version
from plumbline.judging.convergence import ORDER_MARGIN
from plumbline.judging.long_run_study import BLOCK_COUNT
from plumbline.judging.long_runs import MAX_SYMMETRIC_GROWTH, SIGMA_FACTOR
from plumbline.judging.relation_result import OPTION_PREFIX, OTHER_FORMULATION_PREFIX
from plumbline.judging.run_relations import REVERSED_IN_TIME
from plumbline.judging.state_relations import STATE_RELATIONS, WELDED_HALVES
from plumbline.model.datatypes import Array
from plumbline.model.welding import split_bodies, undivided_bodies
from plumbline.reproduce.measure import Shown, ShownRelation, ShownRun, ShownState
from plumbline.reproduce.measure_long_run import ShownLong
from plumbline.reproduce.measure_round_trip import ShownTwice
from plumbline.reproduce.shrink import Case

PARTS = Path(__file__).parent / "templates"
PIN = ["import pinocchio as pin"]
EXUDYN = ["import exudyn as exu", "import exudyn.itemInterface as items"]
# engine: the parts that hold its calls, and its imports
ENGINE_LINES = {
    "mujoco": (["mujoco"], ["import mujoco"]),
    "pinocchio": (["pinocchio"], PIN),
    "pinocchio-aba": (["pinocchio"], PIN),
    "pinocchio-maximal": (["pinocchio-maximal"], PIN),
    "exudyn": (["exudyn-common", "exudyn"], EXUDYN),
    "exudyn-tree": (["exudyn-common", "exudyn-tree"], EXUDYN),
    "reference": (
        ["reference"],
        [
            "from reference_impl import collocation",
            "from reference_impl.chain import Chain",
            "from reference_impl.integrate import integrate",
            "from reference_impl.direct import System",
        ],
    ),
}
WELDERS = ("mujoco", "pinocchio", "pinocchio-aba", "pinocchio-maximal")  # that can be of two halves
SWITCHED = ("reference", "mujoco", "pinocchio", "pinocchio-aba")  # that know the engine's options
TURNED = ("reference", "exudyn")  # whose runs go there and back
SOLVERS = {"exudyn": "EigenSparse", "exudyn-tree": "EXUdense"}  # linear, usual; the other ones are named
Moving = ShownRun | ShownTwice | ShownLong
SHORT = 80  # characters of a literal that stays on a line
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
ENDS: dict[type, str] = {
    ShownState: "end-state",
    ShownRelation: "end-relations",
    ShownTwice: "end-twice",
    ShownRun: "end-motion",
    ShownLong: "end-long",
}
STATE_WORDS = {
    "p": "attitudes",
    "omega": "rad/s, angular velocity, body frame",
    "u": "direction of the rods, world frame",
    "udot": "1/s, their rate",
}


def script(row: dict[str, Any], shown: Shown) -> str:
    """The stand-alone script; texts of the row stay text, whatever characters they hold."""
    engine, version = split_version(row["engine"])[0], str(row["engine_version"])
    second = shown.second if isinstance(shown, ShownRelation) and shown.second != engine else ""
    flags = flags_of(shown, engine, version)
    lines = [f"# {line}".rstrip() for line in [*head(row, shown), *CONVENTIONS, *needs(engine, shown)]]
    lines += ["", "from types import SimpleNamespace", ""]
    lines += dict.fromkeys([*ENGINE_LINES[engine][1], *(ENGINE_LINES[second][1] if second else ())])
    lines += ["import numpy as np"]
    if "dop853" in flags and engine.startswith("pinocchio"):
        lines += ["from scipy.integrate import DOP853"]
    lines += ["", "np.set_printoptions(precision=17)"]
    lines += ["", *settings(engine, shown), *described("c", shown.case)]
    lines += evidence(shown)
    text = "\n".join(lines) + "\n\n\n" + part("common", flags | {"joints"} if jointed(engine) else flags)
    if second and jointed(second) and not jointed(engine):
        text = "\n".join(lines) + "\n\n\n" + part("common", flags | {"joints"})
    for name in ENGINE_LINES[engine][0]:
        text += "\n\n" + part(name, flags)
    if second:
        for name in ENGINE_LINES[second][0]:
            if name not in ENGINE_LINES[engine][0]:
                again = part(name, flags_of(shown, second, version))
                text += "\n\n" + re.sub(r"\b(built|evaluate)\(", r"other_\1(", again)
    ends = ["invariants"] if isinstance(shown, ShownRun | ShownLong) and shown.drifts else []
    return text + "".join("\n\n" + part(name, flags) for name in [*ends, ENDS[type(shown)]])


def unscripted(engine: str, row: dict[str, Any]) -> str:
    """Why a row has no script, in a sentence; empty where it has one."""
    relation = row["quantity"]
    if engine not in ENGINE_LINES:
        return f"no script template for {engine}; there are: {', '.join(ENGINE_LINES)}"
    if row["level"] != "relations":
        return ""
    unknown = f"the script of {engine} does not know the relation {relation!r}"
    if row["integrator"] != "-":
        knows = (
            engine in TURNED
            if relation == REVERSED_IN_TIME
            else relation.startswith(OPTION_PREFIX) and engine in SOLVERS
        )
        return "" if knows else f"{unknown} of runs"
    if relation.startswith(OTHER_FORMULATION_PREFIX) or relation in (r.name for r in STATE_RELATIONS):
        return ""
    if not (relation == WELDED_HALVES or relation.startswith(OPTION_PREFIX)):
        return f"the relation {relation!r} is not of one state described or asked about in two ways"
    able = WELDERS if relation == WELDED_HALVES else SWITCHED
    return "" if engine in able else unknown


def jointed(engine: str) -> bool:
    """Whether the engine's coordinates are relative to the body before."""
    return engine in ("mujoco", "pinocchio", "pinocchio-aba")


def part(name: str, flags: set[str]) -> str:
    """One file of scripts/ with the lines that these flags leave."""
    kept: list[str] = []
    open_ifs: list[bool] = []
    for line in (PARTS / f"{name}.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("#if "):
            open_ifs.append(set(line.split()[1:]) <= flags)
        elif line == "#end":
            open_ifs.pop()
        elif all(open_ifs):
            kept.append(line)
    return "\n".join(kept).strip("\n") + "\n"


def flags_of(shown: Shown, engine: str, version: str) -> set[str]:
    """What holds of a case on an engine."""
    model = shown.case.model
    flags = {"rods" if np.any(model.rods) else "balls"}
    if model.has_loads or model.has_drag:
        flags.add("loads")
    if model.has_drag or np.any(model.moment):
        flags.add("powered")
    if isinstance(shown, Moving):
        kind = "fixed" if shown.integrator.kind == "step" else "adaptive"
        flags |= {"motion", kind, shown.integrator.name, *flags_of_moving(shown)}
        if flags & {"joint_gap", "gap_rate"}:
            flags.add("gaps")
    else:
        flags.add("state")
        if isinstance(shown, ShownRelation):
            kinds = {WELDED_HALVES: "welded", "": "described" if shown.second == engine else "two"}
            flags.add(kinds.get(shown.way, "switched"))
        if "mass_matrix" in (shown.bound if isinstance(shown, ShownState) else ()):
            flags.add("mass_matrix")
    flags |= {word for word, other in (("whole", "welded"), ("usual", "switched")) if other not in flags}
    try:
        old = engine.startswith("exudyn") and Version(version) < Version("1.12")
    except InvalidVersion:
        old = False
    return flags | {"before-1.12" if old else "since-1.12"}


def flags_of_moving(shown: Moving) -> set[str]:
    """What holds of runs."""
    if isinstance(shown, ShownTwice):
        return {"resolved" if shown.solver else "retraced"}
    if isinstance(shown, ShownLong):
        return {"long", "growth" if shown.growth else "falling", *shown.drifts}
    flags = {"closing", *shown.drifts}
    flags |= {"ordered"} if shown.ordered else set()
    flags |= {"limited"} if shown.limited else set()
    flags |= {"invariants"} if shown.drifts else set()
    return flags | ({"extrapolated"} if shown.limited or shown.drifts else set())


CONVENTIONS = [
    "",
    "An open chain of rigid bodies hung from the world origin. SI units, world z up; quaternions",
    "scalar first, body to world; joint k is a ball joint (length 0) or a massless rod with a ball",
    "joint at both ends.",
]


def head(row: dict[str, Any], shown: Shown) -> list[str]:
    """What the script shows, of whom."""
    who, about = f"{row['engine']!a} {row['engine_version']!a}", f"scenario {row['scenario']!a}"
    if isinstance(shown, ShownTwice):
        return [
            f"{who}, integrator {row['integrator']!a}, disagrees with itself:",
            f"two ends that should be the same ({shown.name!a}) are {shown.ratio:.3g} times what",
            "rounding and the step's solver explain apart. No truth is needed.",
            f"Shrunk from {about}: a run of {shown.case.until} s.",
        ]
    if isinstance(shown, ShownRun | ShownLong):
        return [
            f"{who}, integrator {row['integrator']!a}:",
            f"{row['quantity']!a} off by {shown.ratio:.3g} times the tolerance.",
            f"Shrunk from {about}: a run of {shown.case.until} s at {len(shown.case.steps)} resolutions.",
        ]
    state = int(row["extra"]["state"])
    if isinstance(shown, ShownRelation):
        other = "described otherwise"
        if shown.way or shown.second != split_version(row["engine"])[0]:
            other = "asked otherwise"
        return [
            f"{who} disagrees with itself: the same state, {other} ({shown.name!a}),",
            f"is answered {shown.ratio:.3g} times what rounding explains apart. No truth is needed.",
            f"Shrunk from state {state} of {about}.",
        ]
    against = "certified truth" if shown.certified else "the notes' equations in double precision"
    return [
        f"{who} against {against}: {shown.ratio:.3g} times",
        f"what rounding explains. Shrunk from state {state} of {about}.",
    ]


def needs(engine: str, shown: Shown) -> list[str]:
    """What has to be there besides the engine and numpy."""
    if engine == "reference":
        return ["", "The engine is the package reference_impl: run it with the checkout in PYTHONPATH."]
    if isinstance(shown, Moving) and shown.integrator.name == "dop853":
        return ["", "Pinocchio has no integrator: SciPy's DOP853 takes the steps, on its accelerations."]
    return []


def settings(engine: str, shown: Shown) -> list[str]:
    """Choices that are one word."""
    lines = []
    if engine.startswith("pinocchio"):
        stepped = isinstance(shown, Moving) and shown.integrator.kind == "step"
        lines.append(f"ALGORITHM = {'aba' if engine == 'pinocchio-aba' or stepped else 'crba'!r}")
    elif isinstance(shown, ShownRelation) and shown.way.startswith(OPTION_PREFIX):
        lines.append('ALGORITHM = "usual"')
    if isinstance(shown, Moving):
        lines.append(f"INTEGRATOR = {shown.integrator.name!r}")
        if engine in SOLVERS:
            lines.append(f"SOLVER = {SOLVERS[engine]!r}  # of the linear equations")
    return [*lines, ""] if lines else []


def described(name: str, case: Case, indent: str = "    ") -> list[str]:
    """Model and state of a case as a namespace of that name."""
    lines = [f"{name} = SimpleNamespace("]
    for owner, words in ((case.model, MODEL_WORDS), (case.state, STATE_WORDS)):
        for field, about in words.items():
            lines.append(f"{indent}{field}=np.array({nested(getattr(owner, field), indent)}),  # {about}")
    return [*lines, ")"]


def evidence(shown: Shown) -> list[str]:
    """What is true, or the second description, and what is allowed."""
    if isinstance(shown, ShownRun):
        return run_evidence(shown)
    if isinstance(shown, ShownTwice):
        return twice_evidence(shown)
    if isinstance(shown, ShownLong):
        return long_evidence(shown)
    explained = "# largest Euclidean norm of the difference (per body) that rounding in double explains"
    if isinstance(shown, ShownState):
        exact = "enclosed in ball arithmetic, rounded to double once" if shown.certified else "not certified"
        return ["", f"# true: {exact}", *table("certified", shown.truth), explained,
                *table("bound", shown.bound)]  # fmt: skip
    lines = [""]
    if shown.way == WELDED_HALVES:
        lines += pieces(shown.case)
    elif shown.way:
        lines += [f"OTHER_ALGORITHM = {shown.way.removeprefix(OPTION_PREFIX)!r}", ""]
    elif shown.case.content != shown.other.content:
        lines += [f"# the other description: {shown.name!a}", *described("other", shown.other)]
    lines += ["# the way back of each answer: a factor, or a matrix"]
    lines += [*table("back", shown.back), f"{explained},", "# on both sides"]
    return [*lines, *table("bound", shown.bound)]


def pieces(case: Case) -> list[str]:
    """Every body in one piece, and in two."""
    lines = []
    for name, parts in (("whole", undivided_bodies(case.model)), ("halves", split_bodies(case.model))):
        lines += [f"{name} = [  # of each body: mass, centre from the body's, inertia about its own"]
        for body in parts:
            each = (f"({p.mass!r}, {p.centre.tolist()!r}, {p.inertia.tolist()!r})" for p in body)
            lines.append(f"    [{', '.join(each)}],")
        lines.append("]")
    return lines


def twice_evidence(shown: ShownTwice) -> list[str]:
    """The run, and how far apart its two ends may be."""
    unit = "s" if shown.integrator.kind == "step" else "relative tolerance"
    return [
        "",
        f"times = np.array([0.0, {shown.case.until!r}])  # s",
        f"step = {shown.case.steps[0]!r}  # {unit}",
        *([f"OTHER_SOLVER = {shown.solver!r}"] if shown.solver else []),
        "# largest difference of a body (m, rad, m/s, rad/s): by rounding and the step's solver, grown",
        f"allowed = {shown.allowed!r}",
    ]


def long_evidence(shown: ShownLong) -> list[str]:
    """Times and steps, and what is due."""
    fixed = shown.integrator.kind == "step"
    words = ("step", "steps") if fixed else ("tolerance", "relative tolerances")
    lines = [
        "",
        f"times = np.linspace(0.0, {float(shown.times[-1])!r}, {len(shown.times)})  # s",
        f"steps = {list(shown.case.steps)!r}  # {'s' if fixed else words[1]}",
        f"drifts = {shown.drifts!r}",
    ]
    if shown.growth:
        return [*lines, f"limit = {MAX_SYMMETRIC_GROWTH!r}  # of log2 of the growth: 0 is bounded, 1 secular"]
    passed = "rounding" if fixed else "rounding and every step's tolerance"
    return [
        *lines,
        f"step_word, blocks, sigmas = {words[0]!r}, {BLOCK_COUNT!r}, {SIGMA_FACTOR!r}",
        f"due = {shown.due!r}  # order in the {words[0]}, at least",
        "# of rounding and the step's solver, in one block of time",
        f"rounding = {shown.rounding!r}",
        f"# of {passed}, in the whole run",
        f"passed = {shown.passed!r}",
    ]


def run_evidence(shown: ShownRun) -> list[str]:
    """Times and steps, the true end, and the uncertainties."""
    fixed = shown.integrator.kind == "step"
    count, until = len(shown.times) - 1, float(shown.times[-1])
    times = f"np.linspace(0.0, {until!r}, {count + 1})" if count > 1 else f"np.array([0.0, {until!r}])"
    words = ("step", "at step zero") if fixed else ("tolerance", "at the tightest tolerance")
    lines = [
        "",
        f"times = {times}  # s",
        f"steps = {list(shown.case.steps)!r}  # {'s' if fixed else 'relative tolerances'}",
    ]
    if shown.ordered:
        lines += [
            f"declared, margin = {shown.integrator.order!r}, {ORDER_MARGIN!r}  # order",
            f"sizes = {tuple(map(float, shown.sizes))!r}  # m and m/s, of the chain",
        ]
    if shown.limited or shown.drifts:
        lines += [
            f"step_word, limit_words = {words!r}",
            f"powers = {list(shown.integrator.error_exponents)!r}  # of the step, in the error",
            f"eliminated = {shown.eliminated!r}  # so many of them",
            "# of the limit, of the truth and of rounding together",
            f"uncertain = {shown.uncertain!r}",
        ]
    if shown.limited:
        lines += ["# at the end, by two integrators on the notes' equations", "true = {"]
        for name, value in (("position", shown.true_r), ("attitude", shown.true_p)):
            lines.append(f'    "{name}": np.array({nested(value, "    ")}),')
        lines.append("}")
    return lines


def table(name: str, values: dict[str, Array]) -> list[str]:
    """A dictionary of arrays as literals."""
    return [f"{name} = {{", *(f"    {q!r}: {nested(np.asarray(x), '    ')}," for q, x in values.items()), "}"]


def nested(value: Array, indent: str = "") -> str:
    """A list literal, equal rows once; floats by repr, so that nothing is rounded; on one line if it fits."""
    if value.ndim and len(value) > 1 and np.all(value == value[0]):
        return f"[{nested(value[0], indent)}] * {len(value)}"
    if value.ndim < 2 or len(repr(value.tolist())) <= SHORT:
        return repr(value.tolist())
    inner = "".join(f"{indent}    {nested(row, indent + '    ')},\n" for row in value)
    return f"[\n{inner}{indent}]"
