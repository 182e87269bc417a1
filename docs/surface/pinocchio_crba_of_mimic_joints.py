"""Pinocchio: the mass matrix by crba is wrong where several joints hang beyond one that mimics another.

A slide mimics the turn before it, and on it hang zero to three bodies on further joints.  The columns of the
mass matrix are inverse dynamics at unit accelerations less those at none; with two bodies on turning joints
or more crba differs from them, in both conventions.
"""

import numpy as np
import pinocchio as pin

INERTIA = pin.Inertia(1.0, np.array([0.1, 0.2, 0.3]), np.diag([0.1, 0.2, 0.25]))


def build(kind, branches):
    """A turn, a slide that mimics it, and bodies on joints of a kind beyond it."""
    model, tilted = pin.Model(), pin.utils.rotate("x", 0.3)
    turn = model.addJoint(0, pin.JointModelRZ(), pin.SE3(tilted, np.array([0.0, 0.0, 0.1])), "turn")
    slide = model.addJoint(turn, pin.JointModelPZ(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(slide, INERTIA, pin.SE3.Identity())
    for k in range(branches):
        place = pin.SE3(tilted, np.array([0.3, 0.1 * k, 0.2]))
        joint = model.addJoint(slide, kind(), place, f"branch {k}")
        model.appendBodyToJoint(joint, INERTIA, pin.SE3.Identity())
    return pin.transformJointIntoMimic(model, turn, slide, 0.4, 0.0)


print("Pinocchio", pin.__version__)
for kind in (pin.JointModelRX, pin.JointModelSpherical, pin.JointModelPX):
    for branches in range(4):
        model = build(kind, branches)
        nv, data = model.nv, model.createData()
        q = pin.integrate(model, pin.neutral(model), np.linspace(0.3, 0.7, nv))
        rest = pin.rnea(model, data, q, np.zeros(nv), np.zeros(nv)).copy()
        columns = [pin.rnea(model, data, q, np.zeros(nv), unit) - rest for unit in np.eye(nv)]
        off = {}
        for convention in (pin.Convention.WORLD, pin.Convention.LOCAL):
            found = np.reshape(pin.crba(model, model.createData(), q, convention), (nv, nv))
            off[convention.name] = f"{np.max(np.abs(np.triu(found - np.transpose(columns)))):.1e}"
        print(f"{kind.__name__:22} {branches} bodies beyond: crba is off by", off)
