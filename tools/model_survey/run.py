"""Run every URDF and MJCF file of the robots' packages through `plumbline model`.

URDF files are loaded without geometry, which defines no inertia in them, with a fixed base, or a free one
where nothing else moves.  Of the 1,000 objects of pybullet's random_urdfs ten are taken: they are alike.  Of
mujoco-mjx's crowds of one to ten humanoids the first is taken.
"""

from __future__ import annotations

import os
import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from plumbline.cli.model_commands import model_document
from plumbline.importers.importer import Base
from plumbline.importers.xml_tree import ModelFileError
from plumbline.model_files.model_run import ModelPlan, run_model_files
from plumbline.model_files.prepared_file import prepare_file
from plumbline.processes.isolation import ScratchFolder

STATES = 5  # random states of each file
PROGRESS_STEP = 100  # tasks
ALIKE_FOLDER, ALIKE_COUNT = "random_urdfs", 10
CROWD = re.compile(r"\d\d_humanoids\.xml")


def robot_files(folder: Path) -> list[Path]:
    """Find the model files of the installed packages.

    Args:
        folder: their site-packages.

    Returns:
        URDF files, then XML files with a <mujoco> root element, each sorted by path.

    """
    urdf = [p for p in folder.rglob("*.urdf") if ALIKE_FOLDER not in p.parts]
    urdf += sorted(folder.rglob(f"{ALIKE_FOLDER}/*/*.urdf"))[:ALIKE_COUNT]
    mjcf = [p for p in folder.rglob("*.xml") if b"<mujoco" in p.read_bytes() and _is_whole(p)]
    mjcf = [p for p in mjcf if not CROWD.fullmatch(p.name) or p.name.startswith("01")]
    return sorted(urdf) + sorted(mjcf)


def _is_whole(path: Path) -> bool:
    """Whether an XML file is a model and not a part that others include."""
    return b"<mujocoinclude" not in path.read_bytes()


def survey(folder: Path) -> dict[str, Any]:
    """Compare all files in as many workers as there are cores.

    Args:
        folder: site-packages of the robots' packages.

    Returns:
        The document of `plumbline model --json`, paths relative to the folder, and ``bases``: the base that
        was chosen for each URDF file.

    """
    os.chdir(folder)
    groups: dict[tuple[str, Base], list[str]] = defaultdict(list)
    for path in robot_files(Path()):
        kind = "urdf" if path.suffix == ".urdf" else "mjcf"
        groups[kind, _base_for(path) if kind == "urdf" else "fixed"].append(str(path))
    merged: dict[str, Any] = {"engines": {}, "files": [], "problems": [], "bases": {}}
    for (kind, base), files in groups.items():
        is_urdf = kind == "urdf"
        plan = ModelPlan(
            tuple(files), base=base if is_urdf else "auto", root=Path(), strip_geometry=is_urdf,
            state_count=STATES, are_importers_required=True, jobs=len(os.sched_getaffinity(0)),
        )  # fmt: skip
        document = model_document(run_model_files(plan, _print_progress))
        merged["engines"] |= document["engines"]
        merged["files"] += document["files"]
        merged["problems"] += document["problems"]
        merged["bases"] |= dict.fromkeys(files, base) if is_urdf else {}
        merged |= {name: document[name] for name in ("version", "options")}
        merged["exit_code"] = max(merged.get("exit_code", 0), document["exit_code"])
    return merged


def _print_progress(done: int, total: int, task: str) -> None:
    if done % PROGRESS_STEP == 0:
        print(f"{done} of {total} tasks known so far: {task}", file=sys.stderr, flush=True)


def _base_for(path: Path) -> Base:
    """Fixed, or free where a body with mass would not move else; a root link called world is the world."""
    with ScratchFolder("plumbline-survey-") as scratch:
        try:
            model = prepare_file(str(path), scratch, Path(), "fixed", True).urdf_model
        except ModelFileError:
            return "fixed"
    is_still = model is not None and model.velocity_count == 0 and model.bodies[0].name != "world"
    return "free" if model and is_still and sum(body.mass for body in model.bodies) > 0 else "fixed"
