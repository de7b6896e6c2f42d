"""Compiled dipole field and gradient tensor.

:mod:`magloc.fields.dipole` is the readable twin and has the formulas.

One dipole and one point in scalars, from the displacement d = s - p, for the kernels that are still compiled by numba;
the others include magloc/dipole.hpp. Two of them called with the same d share one square root and one division.

The arithmetic is that of the twin with n = d/r multiplied out, which saves three multiplications; the two agree to
rounding for distances from 1e-50 m to 1e50 m. On the source both are NaN.
"""

import math

import numpy as np

from magloc.compilation import compiled
from magloc.fields.dipole import MU0_OVER_4PI

SymmetricComponents = tuple[float, float, float, float, float, float]


@compiled
def field_components(dx: float, dy: float, dz: float, mx: float, my: float, mz: float) -> tuple[float, float, float]:
    """Induction (bx, by, bz) in T at the displacement d (m) from a dipole of moment m (A m^2), equation (2)."""
    inv_r = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
    inv_r2 = inv_r * inv_r
    scale = MU0_OVER_4PI * inv_r2 * inv_r
    radial = 3.0 * (dx * mx + dy * my + dz * mz) * inv_r2
    return scale * (radial * dx - mx), scale * (radial * dy - my), scale * (radial * dz - mz)


@compiled
def field_matrix_components(dx: float, dy: float, dz: float) -> SymmetricComponents:
    """Matrix A with B = A m at the displacement d (m), in T/(A m^2), as (xx, xy, xz, yy, yz, zz), equation (2)."""
    inv_r = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    inv_r2 = inv_r * inv_r
    scale = MU0_OVER_4PI * inv_r2 * inv_r
    x = 3.0 * inv_r2 * dx
    y = 3.0 * inv_r2 * dy
    z = 3.0 * inv_r2 * dz
    return (
        scale * (x * dx - 1.0),
        scale * (x * dy),
        scale * (x * dz),
        scale * (y * dy - 1.0),
        scale * (y * dz),
        scale * (z * dz - 1.0),
    )


@compiled
def gradient_components(dx: float, dy: float, dz: float, mx: float, my: float, mz: float) -> SymmetricComponents:
    """Gradient tensor in T/m at the displacement d (m) from a dipole, as (xx, xy, xz, yy, yz, zz), equation (3)."""
    inv_r = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    inv_r2 = inv_r * inv_r
    scale = 3.0 * MU0_OVER_4PI * inv_r2 * inv_r2 * inv_r
    radial = dx * mx + dy * my + dz * mz
    five = 5.0 * radial * inv_r2
    # m - 5 (n.m) n, the vector that is multiplied by d in each component
    x = mx - five * dx
    y = my - five * dy
    z = mz - five * dz
    return (
        scale * (radial + dx * (x + mx)),
        scale * (dx * my + dy * x),
        scale * (dx * mz + dz * x),
        scale * (radial + dy * (y + my)),
        scale * (dy * mz + dz * y),
        scale * (radial + dz * (z + mz)),
    )
