"""Exudyn: SystemData.GetODE2CoordinatesTotal corrupts memory.

Thirty free bodies; the function is called twenty times in a process of its own, as GetODE2Coordinates is.
With glibc's checks the first process is aborted, "munmap_chunk(): invalid pointer".
"""

import os
import subprocess
import sys

CALLS = """
import exudyn
import exudyn.itemInterface as items

container = exudyn.SystemContainer()
system = container.AddSystem()
for i in range(30):
    node = system.AddNode(items.NodeRigidBodyEP(referenceCoordinates=[i, 0, 0, 1, 0, 0, 0]))
    system.AddObject(items.ObjectRigidBody(nodeNumber=node, mass=1.0, inertia=[1, 2, 3, 0, 0, 0]))
system.Assemble()
for _ in range(20):
    getattr(system.systemData, FUNCTION)()
"""
for function in ("GetODE2CoordinatesTotal", "GetODE2Coordinates"):
    code = CALLS.replace("FUNCTION", repr(function))
    checked = os.environ | {"MALLOC_CHECK_": "3", "MALLOC_PERTURB_": "99"}
    ended = subprocess.run([sys.executable, "-c", code], env=checked, capture_output=True, text=True)
    print(f"{function:24s} exit code {ended.returncode} {ended.stderr.strip()}")
