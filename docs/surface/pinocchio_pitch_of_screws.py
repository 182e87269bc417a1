"""Pinocchio's Python module: a screw joint that is made without a pitch has an arbitrary one.

The documentation of `JointModelHX()` says "Init JointModelHX with pitch 0.0", and its pitch is what
that memory held before.
"""

import numpy
import pinocchio

for kind in (pinocchio.JointModelHX, pinocchio.JointModelHY, pinocchio.JointModelHZ):
    pitches = {kind(0.0).pitch}
    for size in range(1, 9):
        memory = [numpy.full(size, 0.5) for _ in range(100)]
        del memory
        pitches |= {kind().pitch for _ in range(5)}
    for _ in range(50):
        joint = pinocchio.JointModelComposite()
        joint.addJoint(kind())
        pitches.add(joint.joints[0].extract().pitch)
    print(kind.__name__, "has the pitches", pitches)
