"""Compiled filter of the convergence map that linearises before every scalar.

The readable twin is ``run_one`` of :mod:`magloc.convergence.filters`.

It has to go through the scalars in turn; the filters that do not are in :mod:`magloc.convergence.filters_compiled`.

A model of the differences is passed as ``weights`` (k, N, 3): difference j is ``Σ_i weights[j, i] · B_i``, as in
:func:`magloc.convergence.filters.field_weights`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled_parallel, internal
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.kalman_compiled import scalar_update, triangular_root


@internal
def _row(x: FloatArray, sensors: FloatArray, weights: FloatArray, j: int, h: FloatArray) -> float:
    """Difference j at the state x (p, m), and its gradient into h (6,)."""
    value = 0.0
    h[:] = 0.0
    for i in range(sensors.shape[0]):
        w0, w1, w2 = weights[j, i, 0], weights[j, i, 1], weights[j, i, 2]
        if w0 == 0.0 and w1 == 0.0 and w2 == 0.0:
            continue
        d0, d1, d2 = sensors[i, 0] - x[0], sensors[i, 1] - x[1], sensors[i, 2] - x[2]
        inverse = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        n0, n1, n2 = d0 * inverse, d1 * inverse, d2 * inverse
        k3 = MU0_OVER_4PI * inverse * inverse * inverse
        k4 = 3.0 * k3 * inverse
        nm = n0 * x[3] + n1 * x[4] + n2 * x[5]
        nw = n0 * w0 + n1 * w1 + n2 * w2
        mw = x[3] * w0 + x[4] * w1 + x[5] * w2
        along = mw - 5.0 * nm * nw
        value += k3 * (3.0 * nm * nw - mw)
        h[0] -= k4 * (nm * w0 + along * n0 + nw * x[3])
        h[1] -= k4 * (nm * w1 + along * n1 + nw * x[4])
        h[2] -= k4 * (nm * w2 + along * n2 + nw * x[5])
        h[3] += k3 * (3.0 * nw * n0 - w0)
        h[4] += k3 * (3.0 * nw * n1 - w1)
        h[5] += k3 * (3.0 * nw * n2 - w2)
    return value


@internal
def _add_process_noise(S: FloatArray, s_q: FloatArray, wide: FloatArray) -> None:
    """S becomes a lower triangular square root of ``S Sᵀ + diag(s_q²)``."""
    wide[:] = 0.0
    for r in range(6):
        for c in range(6):
            wide[r, c] = S[r, c]
        wide[r, 6 + r] = s_q[r]
    triangular_root(wide, S)


@internal
def _finish(
    x: FloatArray, z: FloatArray, chi2_variance: FloatArray, sensors: FloatArray, weights: FloatArray, h: FloatArray
) -> float:
    chi2 = 0.0
    for j in range(z.size):
        residual = z[j] - _row(x, sensors, weights, j, h)
        chi2 += residual * residual / chi2_variance[j]
    return chi2


@compiled_parallel
def relinearised_map(
    starts: FloatArray,
    z: FloatArray,
    variance: FloatArray,
    sensors: FloatArray,
    weights: FloatArray,
    inflation: float,
    position_step_m: float,
    moment_step_Am2: float,
    tolerance: float,
    max_iterations: int,
) -> tuple[FloatArray, FloatArray, NDArray[np.int64], NDArray[np.bool_]]:
    """The filter that is linearised before every scalar, from starts (n, 6): the parts of `Ends`."""
    n, k = starts.shape[0], z.size
    states = starts.copy()
    chi2 = np.empty(n)
    passes = np.zeros(n, np.int64)
    stopped = np.zeros(n, np.bool_)
    s_q = np.repeat(np.array([position_step_m, moment_step_Am2]), 3)
    for i in prange(n):
        x = states[i]
        S = np.diag(s_q)
        wide, phi, h, g = np.empty((6, 12)), np.empty(6), np.empty(6), np.empty(k)
        for j in range(k):
            g[j] = _row(x, sensors, weights, j, h)
        for iteration in range(1, max_iterations + 1):
            _add_process_noise(S, s_q, wide)
            for j in range(k):
                nu = z[j] - _row(x, sensors, weights, j, h)
                scalar_update(x, S, h, nu, inflation * variance[j], phi)
            change = 0.0
            for j in range(k):
                predicted = _row(x, sensors, weights, j, h)
                change += (predicted - g[j]) ** 2
                g[j] = predicted
            passes[i] = iteration
            if not math.isfinite(change):
                break
            if math.sqrt(change) < tolerance:
                stopped[i] = True
                break
        chi2[i] = _finish(x, z, variance, sensors, weights, h)
    return states, chi2, passes, stopped
