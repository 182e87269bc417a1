"""Exudyn's rotation vectors lose digits near zero: of two turns that leave 1e-7 rad a hundredth is lost.

A body that is turned by 0.6 rad about an axis turns back about it, so that an angle is left, known exactly:
once as the composition of the two rotation vectors, once by a node on rotation vectors that is integrated for
1 s at a constant rate.
"""

import exudyn
import numpy as np
from exudyn.itemInterface import NodeRigidBodyRotVecLG, ObjectRigidBody
from exudyn.lieGroupBasics import CompositionRuleForRotationVectors

axis = np.array([2.0, -1.0, 2.0]) / 3
for left in (1e-3, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
    before, back = 0.6 * axis, (left - 0.6) * axis
    composed = np.array(CompositionRuleForRotationVectors(before, back))
    mbs = exudyn.SystemContainer().AddSystem()
    node = mbs.AddNode(
        NodeRigidBodyRotVecLG(referenceCoordinates=[0, 0, 0, *before], initialVelocities=[0, 0, 0, *back])
    )
    mbs.AddObject(ObjectRigidBody(mass=1, inertia=[1, 1, 1, 0, 0, 0], nodeNumber=node))
    mbs.Assemble()
    settings = exudyn.SimulationSettings()
    settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = 10, 1.0
    settings.timeIntegration.verboseMode, settings.solution.file.write = 0, False
    mbs.SolveDynamic(settings, solverType=exudyn.DynamicSolverType.RK44)
    turn = np.reshape(mbs.GetNodeOutput(node, exudyn.OutputVariableType.RotationMatrix), (3, 3))
    found = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    off = [np.linalg.norm(composed - left * axis), np.linalg.norm(found - np.sin(left) * axis)]
    print(f"{exudyn.config.Version()}: {left:g} rad: composed off by {off[0]:.1g}, node by {off[1]:.1g} rad")
