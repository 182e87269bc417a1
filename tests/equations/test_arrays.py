"""Quantities of many states as arrays."""

import numpy as np

from plumbline.equations.arithmetic import quantity_arrays


def test_vectors_keep_their_components_and_scalars_have_none():
    states, vector, scalar = 5, np.arange(15.0).reshape(5, 3, 1), np.arange(5.0).reshape(5, 1, 1)
    found = quantity_arrays(
        {"vector": vector, "scalar": scalar, "of bodies": [vector, 2 * vector]}, (states,)
    )
    np.testing.assert_array_equal(found["vector"], vector[..., 0])
    np.testing.assert_array_equal(found["scalar"], scalar[:, 0, 0])
    np.testing.assert_array_equal(found["of bodies"][:, 1], 2 * vector[..., 0])
    assert quantity_arrays({"scalar": scalar[:1]}, (1,))["scalar"].shape == (1,)
