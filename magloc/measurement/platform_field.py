r"""Field of a platform at its sensors, after Tolles and Lawson.

A carrier that turns in the ambient field b, in its own axes, adds

.. math:: h = p + A b + E \dot b

at a sensor: a permanent field p, a field that b induces in soft iron, and a field of eddy currents. All constants are
linear, and iron has no reason to make the matrices A and E symmetric.

Sources: W. E. Tolles and J. D. Lawson, "Magnetic compensation of MAD equipped aircraft" (1950); P. Leliak,
"Identification and evaluation of magnetic-field sources of magnetic airborne detector equipped aircraft", IRE Trans.
ANE-8 (1961).
"""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray


def matrix_effects(by_field: FloatArray, field_T: FloatArray) -> FloatArray:
    """Return the derivatives (..., 9) of a measurement by the elements of A in the field A b, row by row.

    ``by_field`` (..., 3) is the derivative by the field at the sensor; ``field_T`` (..., 3) is b or its rate.
    """
    outer = by_field[..., :, None] * field_T[..., None, :]
    return np.asarray(outer.reshape(*outer.shape[:-2], 9))
