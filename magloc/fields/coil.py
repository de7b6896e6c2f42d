"""Field of a circular loop of current."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ellipe, ellipkm1, elliprd

from arrays.typing import FloatArray
from magloc.fields import dipole

# Parameter of the elliptic integrals below which a point counts as being on the axis.
_ON_AXIS = 1e-8


def loop_field(points_m: ArrayLike, centre_m: ArrayLike, moment_Am2: ArrayLike, radius_m: float) -> FloatArray:
    r"""Return the field of a circular current loop in closed form, or of a dipole for a radius of zero.

    With z along the moment, ρ from the axis, :math:`α^2 = (a + ρ)^2 + z^2`, :math:`β^2 = (a - ρ)^2 + z^2`,
    :math:`m_K = 1 - β^2/α^2` the parameter of the elliptic integrals and :math:`C = 2 k m/(π a^2)`,

    .. math:: B_z = \frac{C}{α β^2} [(a^2 - ρ^2 - z^2) E + β^2 K], \qquad
              B_ρ = \frac{C z}{α β^2 ρ} [(a^2 + ρ^2 + z^2) E - β^2 K].

    Source: J. Simpson et al., "Simple analytic expressions for the magnetic field of a circular current loop", NASA,
    2001.

    Parameters
    ----------
    points_m, centre_m, moment_Am2 : array_like, shape (..., 3)
        Points [m], centre of the loop [m] and its moment [A·m²], which is normal to the loop.
    radius_m : float
        Radius a of the loop [m].

    Returns
    -------
    ndarray, shape (..., 3)
        Field [T]; NaN on the wire.
    """
    if not radius_m >= 0.0:
        raise ValueError(f"Input radius_m must not be negative; instead received {radius_m}.")
    points, centre = np.asarray(points_m, dtype=np.float64), np.asarray(centre_m, dtype=np.float64)
    moment = np.asarray(moment_Am2, dtype=np.float64)
    if radius_m == 0.0:
        return dipole.field(points, centre, moment)
    separation = points - centre
    size = np.linalg.norm(moment, axis=-1, keepdims=True)
    axis = moment / np.where(size > 0.0, size, 1.0)
    z = np.sum(separation * axis, axis=-1, keepdims=True)
    across = separation - z * axis
    rho = np.linalg.norm(across, axis=-1, keepdims=True)
    alpha2, beta2 = (radius_m + rho) ** 2 + z**2, (radius_m - rho) ** 2 + z**2
    beta2 = np.where(beta2 > 0.0, beta2, np.nan)
    complement = beta2 / alpha2
    parameter = np.where(np.isnan(beta2), np.nan, 4.0 * radius_m * rho / alpha2)
    first, second = ellipkm1(complement), ellipe(parameter)
    common = 2.0 * dipole.MU0_OVER_4PI * size / (np.pi * radius_m**2 * np.sqrt(alpha2) * beta2)
    along = common * ((radius_m**2 - rho**2 - z**2) * second + beta2 * first)
    # The bracket of B_ρ over ρ², without the cancellation on the axis: 8 a² (D - C)/α² with Bulirsch's
    # D = (K - E)/m_K and C = (2 D - K)/m_K, which is π/16 on the axis.
    d = elliprd(0.0, complement, 1.0) / 3.0
    c = np.where(parameter > _ON_AXIS, (2.0 * d - first) / np.maximum(parameter, _ON_AXIS), np.pi / 16.0)
    outwards = common * z * 8.0 * radius_m**2 / alpha2 * (d - c)
    return along * axis + outwards * across
