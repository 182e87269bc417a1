"""MuJoCo's importer of URDF and MJCF files.

The neutral model's conventions are MuJoCo's: ordered joints in a body, coordinates and velocities as in
`qpos` and `qvel`, so that T = 1.  A reading is the compiled `MjModel`.

    M   mj_fullM, with armature    h   qfrc_bias    h(v = 0)   the same at rest
    f   qfrc_passive               v̇   qacc_smooth
    energies   mj_energyVel, and mj_energyPos without springs

What is not compared is switched off after compiling: actuators with their armature and damping, forces of
tendons and flexes, terms of joint springs and dampers that are not linear, buoyancy and drag of a fluid,
gravity compensation.  Contacts, limits, equalities and friction loss do not enter these quantities.  A URDF's
root link is fused with the world, MuJoCo's default; with a free base links are not fused and the root link
gets a free joint.  Of MuJoCo's extension <mujoco> in a URDF only the folders of files are used: the other
importers do not read it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from adapters.importer_common import Layout, LoadingImporter, free_joint_name, make_joint, pose
from adapters.mujoco_common import compiler_of, full_mass_matrix, set_attributes, warnings_to
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import (
    CanonicalState,
    ElementaryJoint,
    JointKind,
    ModelQuantities,
    NeutralBody,
)
from plumbline.model.kinematics import rotation_matrix

KINDS: dict[int, JointKind] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
}
NOT_COMPARED = (  # arrays of a compiled model whose features are not compared
    "actuator_armature", "actuator_damping", "actuator_dampingpoly",
    "tendon_stiffness", "tendon_stiffnesspoly", "tendon_damping", "tendon_dampingpoly", "tendon_armature",
    "dof_dampingpoly", "jnt_stiffnesspoly", "jnt_springyield", "body_gravcomp",
    "flex_stiffness", "flex_bending", "flex_damping", "flex_edgestiffness", "flex_edgedamping",
)  # fmt: skip
URDF_GRAVITY = (0.0, 0.0, -9.81)  # m/s²
URDF_COMPILER = {  # MuJoCo's defaults, which a URDF's extension <mujoco> can change
    "balanceinertia": False, "boundinertia": 0.0, "boundmass": 0.0, "inertiafromgeom": 2,
    "inertiagrouprange": (0, 5), "settotalmass": -1.0, "alignfree": False,
}  # fmt: skip


class _Layout(Layout):
    """A compiled model; T is 1."""

    def __init__(self, model: Any, file: ModelFile) -> None:
        self.m, self.name = model, bytes(model.names).split(b"\0", 1)[0].decode(errors="replace")
        super().__init__(model, file)

    @cached_property
    def d(self) -> Any:
        _switch_off(self.m)
        return mujoco.MjData(self.m)

    def _gravity(self) -> Any:
        is_weightless = self.m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        return np.zeros(3) if is_weightless else self.m.opt.gravity

    def _bodies(self) -> Iterator[NeutralBody]:
        return (_body(self.m, i) for i in range(1, self.m.nbody))

    def quantities(self, state: CanonicalState) -> ModelQuantities:
        m, d = self.m, self.d
        mujoco.mj_resetData(m, d)
        d.qpos[:] = state.coordinates
        mujoco.mj_forward(m, d)
        gravity_force = np.array(d.qfrc_bias)
        d.qvel[:] = state.velocities
        mujoco.mj_forward(m, d)
        bodies = enumerate(self.model.bodies, start=1)
        poses = {body.name: pose(d.xmat[i].reshape(3, 3), d.xpos[i]) for i, body in bodies}
        mujoco.mj_energyVel(m, d)
        return ModelQuantities(
            poses=poses,
            mass_matrix=full_mass_matrix(m, d),
            bias_force=np.array(d.qfrc_bias),
            gravity_force=gravity_force,
            passive_force=np.array(d.qfrc_passive),
            acceleration=np.array(d.qacc_smooth),
            kinetic_energy=float(d.energy[1]),
            potential_energy=_gravity_potential(m, d),
        )


class MujocoImporter(LoadingImporter):
    """MuJoCo's URDF and MJCF compiler."""

    name = "mujoco"
    title = "MuJoCo"
    package = "mujoco"
    formats = ("urdf", "mjcf")
    supported_versions = ">=3.2,<5"
    layout = _Layout
    refusals = (ValueError,)

    def _load(self, file: ModelFile) -> Any:
        with warnings_to(_print):
            return _compiled(file)

    def evaluate(self, file: ModelFile, states: Sequence[CanonicalState]) -> list[ModelQuantities]:
        """Compute the quantities, with MuJoCo's warnings printed."""
        with warnings_to(_print):
            return super().evaluate(file, states)


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _compiled(file: ModelFile) -> Any:
    if file.format == "mjcf":
        return mujoco.MjModel.from_xml_path(file.path)
    spec = mujoco.MjSpec()
    spec = spec.from_file(file.path) or spec  # 3.2.0 returns nothing
    compiler = compiler_of(spec)
    set_attributes(compiler, **{name: x for name, x in URDF_COMPILER.items() if hasattr(compiler, name)})
    compiler.fusestatic = file.base == "fixed"
    root = spec.worldbody.first_body()
    if file.base == "free" and root is not None:
        name = free_joint_name(root.name, file)
        set_attributes(root.add_joint(), type=mujoco.mjtJoint.mjJNT_FREE, name=name)
    model = spec.compile()
    model.opt.gravity[:] = URDF_GRAVITY
    model.opt.disableflags = 0
    return model


def _switch_off(m: Any) -> None:
    """Switch off what is not compared."""
    for name in NOT_COMPARED:
        if hasattr(m, name):  # later versions have more of them
            getattr(m, name)[:] = 0
    m.opt.density = m.opt.viscosity = 0
    m.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY  # without it older versions return zeros
    disabled = mujoco.mjtDisableBit
    m.opt.disableflags |= disabled.mjDSBL_ACTUATION | disabled.mjDSBL_CONTACT | disabled.mjDSBL_CONSTRAINT


def _body(m: Any, i: int) -> NeutralBody:
    start = m.body_jntadr[i]
    name = m.body(i).name or f"body{i}"
    R = rotation_matrix(m.body_iquat[i])
    return NeutralBody(
        name=name,
        parent=int(m.body_parentid[i]) - 1,
        position=np.array(m.body_pos[i]),
        attitude=np.array(m.body_quat[i]),
        joints=tuple(_joint(m, j, name) for j in range(start, start + m.body_jntnum[i])),
        mass=float(m.body_mass[i]),
        center=np.array(m.body_ipos[i]),
        inertia=R @ np.diag(m.body_inertia[i]) @ R.T,
    )


def _is_disabled(m: Any, what: str) -> bool:
    """Whether a flag of the file switches springs or dampers off; in older versions one flag does both."""
    bits = (getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}", 0) for name in (what, "PASSIVE"))
    return any(int(m.opt.disableflags) & int(bit) for bit in bits)


def _joint(m: Any, j: int, body: str) -> ElementaryJoint:
    kind, dof, q = KINDS[int(m.jnt_type[j])], m.jnt_dofadr[j], m.jnt_qposadr[j]
    is_scalar = kind in ("hinge", "slide")
    return make_joint(
        name=m.joint(j).name or (f"{body}/free" if kind == "free" else f"{body}/joint{j}"),
        kind=kind,
        axis=m.jnt_axis[j] if is_scalar else (0, 0, 0),
        anchor=m.jnt_pos[j] if kind in ("hinge", "ball") else (0, 0, 0),
        reference=m.qpos0[q] if is_scalar else 0.0,
        armature=m.dof_armature[dof],
        damping=0.0 if _is_disabled(m, "DAMPER") else m.dof_damping[dof],
        stiffness=0.0 if _is_disabled(m, "SPRING") else m.jnt_stiffness[j],
        spring_reference=m.qpos_spring[q] if is_scalar else 0.0,
        friction_loss=m.dof_frictionloss[dof],
    )


def _gravity_potential(m: Any, d: Any) -> float:
    """MuJoCo's potential energy counts springs too: they are switched off for this one call."""
    kept = np.array(m.jnt_stiffness)
    m.jnt_stiffness[:] = 0
    mujoco.mj_energyPos(m, d)
    m.jnt_stiffness[:] = kept
    return float(d.energy[0])
