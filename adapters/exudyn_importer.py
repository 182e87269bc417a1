"""Exudyn's URDF loader, LoadURDFrobot and GetURDFrobotData, which use the Robotics Toolbox for Python.

The loader returns a list of links with joints; as its documentation shows, each becomes a `RobotLink` of a
`Robot`, its parent the link of that name, and the robot an `ObjectKinematicTree`.  A parent that is not in
the list (it has no joint) is the ground.

    hinge, slide    q = x;  v_e = v
    M, f of M q̈ = f by the implicit solver's ComputeMassMatrix and ComputeODE2RHS;  h = −f
    poses   Robot.JointHT
    damping   motorViscousFriction of the list, which the caller may apply; the toolbox fills it with the
              URDF's friction and reads no damping

Exudyn 1.13 calls functions of the Robotics Toolbox that version 1.5 no longer has, and 1.1 needs NumPy 1: the
loader has an environment of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import exudyn as exudyn_module
import exudyn.robotics as robotics_module
import exudyn.robotics.utilities as loader_module
import numpy as np

from adapters.exudyn_common import initialized_solver, make_evaluation_settings, mass_matrix_and_force
from adapters.importer_common import Layout, LoadingImporter, Refused, joint_from_screw, make_body, pose
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import CanonicalState, ModelQuantities, NeutralBody
from plumbline.model.datatypes import Array

exudyn: Any = exudyn_module  # the stubs of these modules lack types and attributes
robotics: Any = robotics_module
loader: Any = loader_module
GRAVITY = (0.0, 0.0, -9.81)  # m/s²: the caller of the loader sets it
AXES = {"x": np.eye(3)[0], "y": np.eye(3)[1], "z": np.eye(3)[2]}


class _Layout(Layout):
    """A kinematic tree of the links, in the loader's order; T is 1."""

    def _gravity(self) -> Any:
        return GRAVITY

    def _bodies(self) -> Iterator[NeutralBody]:
        for link in self.loaded:
            kind, axis = link["jointType"][0], AXES[link["jointType"][1]]
            turning, shift = (axis, np.zeros(3)) if kind == "R" else (np.zeros(3), axis)
            joint = joint_from_screw(link["joint"], turning, shift, damping=link["motorViscousFriction"])
            yield make_body(
                link["name"], link["parent"], np.array(link["preHT"], float), [joint],
                link["mass"], link["com"], link["inertiaCOM"],
            )  # fmt: skip

    @cached_property
    def robot(self) -> Any:
        robot = robotics.Robot(gravity=list(GRAVITY), referenceConfiguration=[0.0] * len(self.loaded))
        for link in self.loaded:
            robot.AddLink(
                robotics.RobotLink(
                    mass=link["mass"], COM=link["com"], inertia=link["inertiaCOM"],
                    preHT=link["preHT"], jointType=link["jointType"], parent=link["parent"],
                )
            )  # fmt: skip
        return robot

    @cached_property
    def system(self) -> Any:
        system = exudyn.SystemContainer().AddSystem()
        self.robot.CreateKinematicTree(system)
        system.Assemble()
        return system

    def _mass_and_bias(self, q: Array, v: Array) -> tuple[Array, Array]:
        initial = exudyn.ConfigurationType.Initial
        self.system.systemData.SetODE2Coordinates(q.tolist(), initial)
        self.system.systemData.SetODE2Coordinates_t(v.tolist(), initial)
        solver = exudyn.MainSolverImplicitSecondOrder()
        with initialized_solver(solver, self.system, make_evaluation_settings()):
            M, force = mass_matrix_and_force(solver, self.system)
        return M, -force

    def quantities(self, state: CanonicalState) -> ModelQuantities:
        """Evaluate Exudyn's routines at one state."""
        if not self.loaded:
            return ModelQuantities({})
        q, v = state.coordinates, state.velocities
        M, bias = self._mass_and_bias(q, v)
        gravity = self._mass_and_bias(q, np.zeros(len(v)))[1]
        frames = zip(self.loaded, self.robot.JointHT(list(q)), strict=True)
        poses = {link["name"]: pose(np.array(H.rotation), np.array(H.translation)) for link, H in frames}
        return ModelQuantities(poses, M, bias, gravity)


class ExudynImporter(LoadingImporter):
    """Exudyn's URDF loader."""

    name = "exudyn"
    title = "Exudyn"
    package = "exudyn"
    formats = ("urdf",)
    environment = ".importers-exudyn"
    extra_requirements = (  # as the group exudyn-importer in pyproject.toml
        (">=0", "roboticstoolbox-python>=1.1,<1.2"),
        (">=0", "spatialgeometry<1.2"),
        (">=0", "spatialmath-python<1.1.15"),
        (">=0", "numpy<2"),
        (">=0", "scipy<1.14"),
    )
    unsupported: ClassVar[dict[str, str]] = {
        "passive_force": "the loader returns friction and leaves it to the caller to apply it",
        "acceleration": "Exudyn's initial accelerations are finite differences",
        "kinetic_energy": "a kinematic tree does not return its energies",
        "potential_energy": "a kinematic tree does not return its energies",
    }
    layout = _Layout

    def _load(self, file: ModelFile) -> Any:
        if file.base == "free":
            raise Refused("the loader fixes the root link")
        try:
            return _loaded(file)
        except Exception as error:  # of the loader, the toolbox or the parser
            raise Refused(f"{type(error).__name__}: {error}") from None


def _loaded(file: ModelFile) -> list[dict[str, Any]]:
    path = Path(file.path)
    loaded = loader.LoadURDFrobot(path.name, str(path.parent))
    links: list[dict[str, Any]] = loader.GetURDFrobotData(loaded["robot"], loaded["urdf"], verbose=0)[
        "linkList"
    ]
    names = {link["name"]: k for k, link in enumerate(links)}
    for link in links:
        link["parent"] = names.get(link["parentName"], -1)
        link["joint"] = _joint_name(loaded["urdf"], link["name"])
    return links


def _joint_name(urdf: Any, link: str) -> str:
    """The loader returns names of links only: a joint is named after its child in the toolbox's file."""
    return next((str(joint.name) for joint in urdf.joints if joint.child == link), link)
