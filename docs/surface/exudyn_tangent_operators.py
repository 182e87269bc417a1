"""Exudyn: TExpSE3 and its inverse square a matrix element by element.

Both against central differences of Exudyn's own ExpSE3, for a rotation about one axis and for a general one.
With a product of matrices in place of `OmegaSkew**2`, TExpSE3 is right; of the inverse the coefficient f6 is
wrong too, which lacks a factor φ: (2 − φ cot(φ/2)) / (2 φ²).
"""

import inspect

import numpy as np
from exudyn import lieGroupBasics


def differences(x, h=1e-6):
    """Return the tangent operator of ExpSE3 at x by central differences."""
    H, columns = lieGroupBasics.ExpSE3(x), []
    for step in h * np.eye(6):
        D = np.linalg.inv(H) @ (lieGroupBasics.ExpSE3(x + step) - lieGroupBasics.ExpSE3(x - step)) / (2 * h)
        columns.append([*D[:3, 3], D[2, 1], D[0, 2], D[1, 0]])
    return np.transpose(columns)


def mended(name):
    """Return the function with products of matrices and the right coefficient."""
    source = inspect.getsource(getattr(lieGroupBasics, name))
    source = source[source.index("def ") :].replace("OmegaSkew**2", "OmegaSkew @ OmegaSkew")
    names = dict(vars(lieGroupBasics))
    exec(source.replace("(2 - Cot(phiOverTwo))", "(2 - phi * Cot(phiOverTwo))"), names)
    return names[name]


for x in (np.array([0.3, -0.2, 0.5, 0.0, 0.0, 1.2]), np.array([0.3, -0.2, 0.5, 0.8, -0.4, 0.6])):
    T = differences(x)
    for name, right in (("TExpSE3", T), ("TExpSE3Inv", np.linalg.inv(T))):
        functions = getattr(lieGroupBasics, name), mended(name)
        off = [np.abs(function(x) - right).max() for function in functions]
        print(f"{name:10s} off by {off[0]:.1e}, mended by {off[1]:.1e}")
