"""Pinocchio: the pose of a root body of an MJCF file counts only in part.

A root body without joint stays at its pos, (0, 0, 2), and its child with it.  A free body is where qpos
says, (0, 1, 2), in whichever pose the file draws it.
"""

import tempfile

import numpy as np
import pinocchio

INERTIAL = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
CASES = (
    (f"""<body name="root" pos="0 0 2">{INERTIAL}<body name="b"><joint name="j" axis="0 1 0"/>
      {INERTIAL}</body></body>""", [0], [0, 0, 2]),
    (f'<body name="b" pos="0 1 2" quat=".5 .5 .5 .5"><freejoint/>{INERTIAL}</body>',
     [0, 1, 2, 0.5, 0.5, 0.5, 0.5], [0, 1, 2]),
)  # fmt: skip

for body, q, expected in CASES:
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
        file.flush()
        model = pinocchio.buildModelFromMJCF(file.name)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.array(q, float))
    print("expected", expected, "found", data.oMf[model.getFrameId("b")].translation)
