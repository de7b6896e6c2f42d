"""Compiled twin of :func:`magloc.fields.multipole.finite_body_errors`, for one body and one sensor."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import internal
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.fields.multipole import BODY_SIGMA, traceless_basis

# Tensors of both ranks by pairs of indices (rows, 9, 9): those that the field keeps, and those contracted with n. A
# tensor of rank 2 is contracted with nothing.
_QUADRATIC = traceless_basis(2).reshape(5, 9)
_QUARTIC = traceless_basis(4).reshape(9, 9, 9)
_SIGMA_2, _SIGMA_4 = BODY_SIGMA[2], BODY_SIGMA[4]


@internal
def fill_finite_body_errors(separation_m: FloatArray, length_m: float, out: FloatArray) -> None:
    """Symmetric matrices by which the moment's field errs, of one σ, into out (14, 6): xx, xy, xz, yy, yz, zz."""
    x, y, z = separation_m[0], separation_m[1], separation_m[2]
    r = math.sqrt(x * x + y * y + z * z)
    n = (x / r, y / r, z / r)
    kept = np.empty(9)
    for k in range(_QUADRATIC.shape[0] + _QUARTIC.shape[0]):
        if k < _QUADRATIC.shape[0]:
            rank = 2
            scale = MU0_OVER_4PI * _SIGMA_2 * 1.5 * (length_m / r) ** 2 / r**3
            for t in range(9):
                kept[t] = _QUADRATIC[k, t]
        else:
            rank = 4
            scale = MU0_OVER_4PI * _SIGMA_4 * 4.375 * (length_m / r) ** 4 / r**3
            for t in range(9):
                kept[t] = 0.0
                for i in range(3):
                    for j in range(3):
                        kept[t] += _QUARTIC[k - _QUADRATIC.shape[0], t, 3 * i + j] * n[i] * n[j]
        a = 2 * rank + 1
        vx = kept[0] * n[0] + kept[1] * n[1] + kept[2] * n[2]
        vy = kept[3] * n[0] + kept[4] * n[1] + kept[5] * n[2]
        vz = kept[6] * n[0] + kept[7] * n[1] + kept[8] * n[2]
        v = (vx, vy, vz)
        number = vx * n[0] + vy * n[1] + vz * n[2]
        entry = 0
        for i in range(3):
            for j in range(i, 3):
                value = rank * (rank - 1) * kept[3 * i + j] - rank * a * (v[i] * n[j] + n[i] * v[j])
                value += a * number * ((a + 2) * n[i] * n[j] - (1.0 if i == j else 0.0))
                out[k, entry] = scale * value
                entry += 1
