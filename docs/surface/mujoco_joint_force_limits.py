"""MuJoCo: implicit steps with an actuator whose force a limit of the joint makes zero.

A damper acts on a pendulum, at its joint or by a tendon; the joint lets no force of actuators pass.  The
velocity after a step is that without the damper only where the derivatives of its force are zero too.
"""

import mujoco

MODEL = """
<mujoco>
  <option timestep="0.01" integrator="{integrator}"/>
  <worldbody>
    <site name="anchor" pos="1 0 -0.5"/>
    <body>
      <joint name="joint" axis="0 1 0" actuatorfrcrange="-1e-30 1e-30"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0 0 -0.5" contype="0" conaffinity="0"/>
      <site name="end" pos="0 0 -1"/>
    </body>
  </worldbody>
  <tendon><spatial name="tendon"><site site="anchor"/><site site="end"/></spatial></tendon>
  <actuator><general {on} biastype="affine" biasprm="0 0 {damping}"/></actuator>
</mujoco>
"""


def velocity(integrator, on, damping):
    """Return the velocity [rad/s] after a step from 1 rad/s."""
    own = {"integrator": integrator, "on": on, "damping": damping}
    model = mujoco.MjModel.from_xml_string(MODEL.format(**own))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = 0.4, 1.0
    mujoco.mj_step(model, data)
    return data.qvel[0]


for integrator in ("implicit", "implicitfast"):
    for on in ('joint="joint"', 'tendon="tendon"'):
        off = velocity(integrator, on, -500) - velocity(integrator, on, 0)
        print(f"{mujoco.__version__}, {integrator}, {on}: off by {off:.1e} rad/s")
