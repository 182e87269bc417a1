"""MuJoCo: the energy of the springs of a body that sleeps.

A body on a hinge, with a spring on the hinge or on a tendon to the world, falls asleep where it is, since it
is slow enough: nothing moves, and the potential energy changes.
"""

import mujoco

MODEL = """
<mujoco>
  <option timestep="1e-30" sleep_tolerance="1e9"><flag energy="enable" sleep="enable"/></option>
  <worldbody>
    <site name="anchor" pos="0.3 0.2 1"/>
    <body sleep="allowed">
      <joint axis="0 1 0" {joint}/>
      <geom type="box" size="0.1 0.2 0.3" pos="0 0 -0.5" contype="0" conaffinity="0"/>
      <site name="end" pos="0 0 -1"/>
    </body>
  </worldbody>
  <tendon><spatial {tendon}><site site="anchor"/><site site="end"/></spatial></tendon>
</mujoco>
"""

for what, own in (
    ("no spring", {"joint": "", "tendon": ""}),
    ("spring on the hinge", {"joint": 'stiffness="5" springref="20"', "tendon": ""}),
    ("spring on a tendon", {"joint": "", "tendon": 'stiffness="8" springlength="1.5"'}),
):
    model = mujoco.MjModel.from_xml_string(MODEL.format(**own))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    awake = data.energy[0]
    for _ in range(20):
        mujoco.mj_step(model, data)
    asleep = data.energy[0]
    print(f"{mujoco.__version__}, {what}: {awake:.4f} J awake, {asleep:.4f} J asleep")
