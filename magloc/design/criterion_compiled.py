"""Compiled σ of the range of many sources, and its slope as the sensors move; :mod:`magloc.bounds.crlb` is the twin.

The sensors are of one kind and have one noise, so that the differences are the readings less their mean over the
sensors. Every source has a moment of its own, other than in :mod:`magloc.bounds.table_compiled`.
"""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import compiled
from magloc.fields.dipole import MU0_OVER_4PI

# Pivots of the information's Cholesky factor, its diagonal scaled to one, below which the range has no bound.
_SINGULAR = 1e-14


@compiled
def range_deviation_rows(
    begin: int,
    end: int,
    sensors: FloatArray,
    scalar: bool,
    ambient: FloatArray,
    noise: float,
    positions: FloatArray,
    moments: FloatArray,
    deviation: FloatArray,
    slope: FloatArray,
) -> None:
    """Range deviations of sources begin to end, and their slopes; for :func:`magloc.compilation.over_rows`.

    sensors (N, 3) [m], whether they read moduli, then in the ambient field (3,) [T]; noise [T], positions (n, 3) [m],
    moments (n, 3) [A·m²]; into deviation (n,) [m], infinite where the information is singular, and slope (n, N, 3) or
    (0, N, 3): d log(deviation) / d sensor [1/m].

    With the information F = Hᵀ P H/σ², P the removal of the mean, u the unit vector from the centroid to the source and
    w = F⁻¹ (u, 0), the variance is v = (u, 0)·w, and dv = 2 w·(du, 0) - wᵀ dF w. The latter needs no more than the
    change, as a sensor moves, of the field H w that the combination w of sources would have there; a modulus also turns
    its direction.
    """
    n_sensors, n_channels = sensors.shape[0], 1 if scalar else 3
    gain = np.zeros((n_sensors, n_channels, 3))
    for j in range(n_sensors):
        for c in range(n_channels):
            gain[j, c, c] = 1.0
    modulus_here = np.ones(n_sensors)
    jacobian = np.empty((n_sensors, n_channels, 6))
    mean = np.empty((n_channels, 6))
    factor = np.empty((6, 6))
    scale = np.empty(6)
    w = np.empty(6)
    y = np.empty(3)
    centre = np.zeros(3)
    for j in range(n_sensors):
        for k in range(3):
            centre[k] += sensors[j, k] / n_sensors
    for i in range(begin, end):
        p0, p1, p2 = positions[i, 0], positions[i, 1], positions[i, 2]
        modulus = math.sqrt(moments[i, 0] ** 2 + moments[i, 1] ** 2 + moments[i, 2] ** 2)
        m0, m1, m2 = moments[i, 0] / modulus, moments[i, 1] / modulus, moments[i, 2] / modulus
        u0, u1, u2 = p0 - centre[0], p1 - centre[1], p2 - centre[2]
        reach = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
        u0, u1, u2 = u0 / reach, u1 / reach, u2 / reach
        per_field = reach**3 / (MU0_OVER_4PI * modulus)
        # Lengths in units of the range, moments in units of the source's: every number is about one.
        for c in range(n_channels):
            for a in range(6):
                mean[c, a] = 0.0
        for j in range(n_sensors):
            d0, d1, d2 = sensors[j, 0] - p0, sensors[j, 1] - p1, sensors[j, 2] - p2
            inverse = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            n0, n1, n2 = d0 * inverse, d1 * inverse, d2 * inverse
            t = reach * inverse
            k3 = t * t * t
            k4 = 3.0 * k3 * t
            nm = n0 * m0 + n1 * m1 + n2 * m2
            if scalar:
                b0 = k3 * (3.0 * nm * n0 - m0) + ambient[0] * per_field
                b1 = k3 * (3.0 * nm * n1 - m1) + ambient[1] * per_field
                b2 = k3 * (3.0 * nm * n2 - m2) + ambient[2] * per_field
                modulus_here[j] = math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
                gain[j, 0, 0] = b0 / modulus_here[j]
                gain[j, 0, 1] = b1 / modulus_here[j]
                gain[j, 0, 2] = b2 / modulus_here[j]
            for c in range(n_channels):
                g0, g1, g2 = gain[j, c, 0], gain[j, c, 1], gain[j, c, 2]
                ng = n0 * g0 + n1 * g1 + n2 * g2
                along = m0 * g0 + m1 * g1 + m2 * g2 - 5.0 * nm * ng
                row = jacobian[j, c]
                row[0] = -k4 * (nm * g0 + along * n0 + ng * m0)
                row[1] = -k4 * (nm * g1 + along * n1 + ng * m1)
                row[2] = -k4 * (nm * g2 + along * n2 + ng * m2)
                row[3] = k3 * (3.0 * ng * n0 - g0)
                row[4] = k3 * (3.0 * ng * n1 - g1)
                row[5] = k3 * (3.0 * ng * n2 - g2)
                for a in range(6):
                    mean[c, a] += row[a] / n_sensors
        for j in range(n_sensors):
            for c in range(n_channels):
                for a in range(6):
                    jacobian[j, c, a] -= mean[c, a]
        for a in range(6):
            for b in range(a + 1):
                t = 0.0
                for j in range(n_sensors):
                    for c in range(n_channels):
                        t += jacobian[j, c, a] * jacobian[j, c, b]
                factor[a, b] = t
        regular = True
        for a in range(6):
            scale[a] = 1.0 / math.sqrt(factor[a, a])
        for a in range(6):
            for b in range(a + 1):
                t = factor[a, b] * scale[a] * scale[b]
                for k in range(b):
                    t -= factor[a, k] * factor[b, k]
                if a == b:
                    regular = regular and t > _SINGULAR
                    factor[a, a] = math.sqrt(t)
                else:
                    factor[a, b] = t / factor[b, b]
        variance = 0.0
        for a in range(6):
            t = scale[a] * (u0 if a == 0 else u1 if a == 1 else u2 if a == 2 else 0.0)
            for k in range(a):
                t -= factor[a, k] * w[k]
            w[a] = t / factor[a, a]
            variance += w[a] * w[a]
        unit = noise * reach**4 / (MU0_OVER_4PI * modulus)
        deviation[i] = math.sqrt(variance) * unit if regular else math.inf
        if slope.shape[0] == 0 or not regular:
            continue
        for a in range(5, -1, -1):
            t = w[a]
            for k in range(a + 1, 6):
                t -= factor[k, a] * w[k]
            w[a] = t / factor[a, a]
        for a in range(6):
            w[a] *= scale[a]
        nu = u0 * w[0] + u1 * w[1] + u2 * w[2]
        mp = m0 * w[0] + m1 * w[1] + m2 * w[2]
        for j in range(n_sensors):
            y[0] = y[1] = y[2] = 0.0
            for c in range(n_channels):
                t = 0.0
                for a in range(6):
                    t += jacobian[j, c, a] * w[a]
                y[0] += t * gain[j, c, 0]
                y[1] += t * gain[j, c, 1]
                y[2] += t * gain[j, c, 2]
            d0, d1, d2 = sensors[j, 0] - p0, sensors[j, 1] - p1, sensors[j, 2] - p2
            inverse = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            n0, n1, n2 = d0 * inverse, d1 * inverse, d2 * inverse
            t = reach * inverse
            k4 = 3.0 * t * t * t * t / reach
            k5 = k4 * t
            nm = n0 * m0 + n1 * m1 + n2 * m2
            nw = n0 * w[3] + n1 * w[4] + n2 * w[5]
            n_p = n0 * w[0] + n1 * w[1] + n2 * w[2]
            ny = n0 * y[0] + n1 * y[1] + n2 * y[2]
            yw = y[0] * w[3] + y[1] * w[4] + y[2] * w[5]
            ym = y[0] * m0 + y[1] * m1 + y[2] * m2
            yp = y[0] * w[0] + y[1] * w[1] + y[2] * w[2]
            along = 35.0 * nm * n_p * ny - 5.0 * (mp * ny + ym * n_p + yp * nm)
            if scalar:
                k3 = t * t * t
                # The field H w across the direction of the modulus, and how much it weighs.
                f0 = k3 * (3.0 * nw * n0 - w[3])
                f1 = k3 * (3.0 * nw * n1 - w[4])
                f2 = k3 * (3.0 * nw * n2 - w[5])
                f0 -= k4 * reach * (nm * w[0] + mp * n0 + n_p * m0 - 5.0 * nm * n_p * n0)
                f1 -= k4 * reach * (nm * w[1] + mp * n1 + n_p * m1 - 5.0 * nm * n_p * n1)
                f2 -= k4 * reach * (nm * w[2] + mp * n2 + n_p * m2 - 5.0 * nm * n_p * n2)
                g0, g1, g2 = gain[j, 0, 0], gain[j, 0, 1], gain[j, 0, 2]
                fg = f0 * g0 + f1 * g1 + f2 * g2
                weight = (y[0] * g0 + y[1] * g1 + y[2] * g2) / modulus_here[j]
                f0, f1, f2 = weight * (f0 - fg * g0), weight * (f1 - fg * g1), weight * (f2 - fg * g2)
                nf = n0 * f0 + n1 * f1 + n2 * f2
                mf = m0 * f0 + m1 * f1 + m2 * f2
            for k in range(3):
                nk = n0 if k == 0 else n1 if k == 1 else n2
                mk = m0 if k == 0 else m1 if k == 1 else m2
                uk = u0 if k == 0 else u1 if k == 1 else u2
                # Gradient of the field of the moment part, less the second derivative of the source's along p's part.
                first = k4 * (nw * y[k] + nk * yw + w[3 + k] * ny - 5.0 * nw * nk * ny)
                second = k5 * (
                    mp * y[k] + ym * w[k] + yp * mk - 5.0 * (nm * n_p * y[k] + nm * ny * w[k] + n_p * ny * mk)
                    + along * nk
                )  # fmt: skip
                if scalar:
                    fk = f0 if k == 0 else f1 if k == 1 else f2
                    first += k4 * (nm * fk + nk * mf + mk * nf - 5.0 * nm * nk * nf)
                turn = (w[k] - nu * uk) / (reach * n_sensors)
                slope[i, j, k] = -(first - second + turn) / variance
