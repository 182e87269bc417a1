"""Exudyn: KinematicTree33 gives a slide the mass of the last link, not of all links that it carries.

The kinetic energy of two slides along x, which carry 2 kg and 3 kg, by the mass matrix of the class, by that
of KinematicTree66 and by the speeds of the two bodies.  `ComputeMassMatrixAndForceTerms` of the first has `m`
in its last loop, which is what a loop before left there, for the composite mass `ICm[i]`.
"""

import numpy as np
from exudyn import kinematicTree

masses, rates, zero, one = [2.0, 3.0], np.array([0.5, 0.25]), [0.0] * 3, np.eye(3)
inertias = [m * 0.1 * one for m in masses]
vectors = kinematicTree.KinematicTree33(
    ["Px", "Px"], [one] * 2, [np.zeros(3)] * 2, inertias, [np.zeros(3)] * 2, masses
)
spatial = kinematicTree.KinematicTree66(
    ["Px", "Px"], [np.eye(6)] * 2,
    [kinematicTree.MassCOMinertia2T66(m, zero, J) for m, J in zip(masses, inertias, strict=True)],
)  # fmt: skip
print("by the speeds of the bodies:", np.sum(masses * np.cumsum(rates) ** 2) / 2, "J")
for tree in (spatial, vectors):
    M, _ = tree.ComputeMassMatrixAndForceTerms(np.zeros(2), rates)
    print(f"by {type(tree).__name__}: {rates @ M @ rates / 2} J, M = {M.tolist()}")
