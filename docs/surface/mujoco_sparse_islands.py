"""MuJoCo: Newton's method with sparse Jacobians and islands does not solve for the accelerations.

Two welds hold a ball and two pairs of bodies on hinges together; one more body turns freely.
Newton's method gives the same accelerations with dense Jacobians and with sparse ones without islands, and so
do the other solvers in every way; with sparse ones and islands they are others, however many iterations it
has, and their forces and M q̈ do not balance.
"""

import mujoco
import numpy as np

XML = """
<mujoco>
  <option tolerance="0" iterations="100"/>
  <worldbody>
    <body>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint type="ball"/>
      <site name="b"/>
    </body>
    <body>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint/>
    </body>
    <body>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint/>
      <site name="d"/>
      <body>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <joint/>
        <joint axis="-0.8 0.4 0.5"/>
      </body>
    </body>
    <body>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint/>
      <site name="c"/>
      <body>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <joint/>
        <joint axis="0.7 -0.4 -0.6"/>
        <site name="a"/>
      </body>
    </body>
  </worldbody>
  <equality>
    <weld site1="a" site2="b"/>
    <weld site1="c" site2="d"/>
  </equality>
</mujoco>
"""

print("MuJoCo", mujoco.__version__)
model, usual = mujoco.MjModel.from_xml_string(XML), None
for solver in ("NEWTON", "CG"):
    for jacobian in ("DENSE", "SPARSE"):
        for islands in (True, False):
            model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{solver}")
            model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{jacobian}")
            model.opt.disableflags = 0 if islands else mujoco.mjtDisableBit.mjDSBL_ISLAND
            data = mujoco.MjData(model)
            data.qvel[:] = np.cos(np.arange(model.nv))
            mujoco.mj_forward(model, data)
            usual = data.qacc.copy() if usual is None else usual
            momentum = np.zeros(model.nv)
            mujoco.mj_mulM(model, data, momentum, data.qacc)
            unbalanced = momentum - data.qfrc_smooth - data.qfrc_constraint
            name = f"{solver} {jacobian}{' with islands' if islands else ''}"
            off, left = np.max(np.abs(data.qacc - usual)), np.max(np.abs(unbalanced))
            print(f"{name:26} q̈ differs by {off:.1e} rad/s², M q̈ and forces by {left:.1e} N m")
