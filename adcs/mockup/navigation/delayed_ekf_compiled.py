"""Compiled prediction of the mock-up's delayed filter over many samples.

:func:`adcs.mockup.navigation.delayed_ekf.predicted` is the readable twin and has the formulas.
"""

import math

import numpy as np
from numpy.typing import NDArray

from magloc.compilation import compiled

Array = NDArray[np.float64]
N = 10


@compiled
def predict_rows(
    first: int, last: int, time_s: Array, readings: Array, there: NDArray[np.bool_], noise: Array, x: Array, P: Array
) -> None:
    """Predict rows first + 1 to last of ``x`` (rows, 10) and ``P`` (rows, 10, 10), each from the row before.

    ``readings`` (rows, 3) are accelerations x, y and rate of the interval that ends at each row; ``there`` (rows, 3)
    says which of them are believed. ``noise`` is that of an acceleration and a rate, of each where it is missing, of
    the walks of both kinds of zero, and of that of the drifts: squared densities.
    """
    A = np.empty((N, N))
    for i in range(first + 1, last + 1):
        h = time_s[i] - time_s[i - 1]
        phi = x[i - 1, 4]
        omega = readings[i, 2] - x[i - 1, 7]
        middle = phi + 0.5 * h * omega
        c, s = math.cos(middle), math.sin(middle)
        use_x, use_y = 1.0 if there[i, 0] else 0.0, 1.0 if there[i, 1] else 0.0
        body_x = use_x * (readings[i, 0] - x[i - 1, 5])
        body_y = use_y * (readings[i, 1] - x[i - 1, 6])
        a_X, a_Y = c * body_x - s * body_y, s * body_x + c * body_y
        half = 0.5 * h * h
        x[i, 0] = x[i - 1, 0] + h * x[i - 1, 2] + half * a_X
        x[i, 1] = x[i - 1, 1] + h * x[i - 1, 3] + half * a_Y
        x[i, 2] = x[i - 1, 2] + h * a_X
        x[i, 3] = x[i - 1, 3] + h * a_Y
        x[i, 4] = phi + h * omega
        x[i, 5] = x[i - 1, 5] + h * x[i - 1, 8]
        x[i, 6] = x[i - 1, 6] + h * x[i - 1, 9]
        x[i, 7], x[i, 8], x[i, 9] = x[i - 1, 7], x[i - 1, 8], x[i - 1, 9]
        # Rows of ∂a/∂(φ, α, β, b); F P, then (F P) Fᵀ: each row of F needs later rows only, so in place.
        X4, X5, X6, X7 = -a_Y, -c * use_x, s * use_y, 0.5 * h * a_Y
        Y4, Y5, Y6, Y7 = a_X, -s * use_x, -c * use_y, -0.5 * h * a_X
        for k in range(N):
            for j in range(N):
                A[j, k] = P[i - 1, j, k]
            along = X4 * A[4, k] + X5 * A[5, k] + X6 * A[6, k] + X7 * A[7, k]
            across = Y4 * A[4, k] + Y5 * A[5, k] + Y6 * A[6, k] + Y7 * A[7, k]
            A[0, k] += h * A[2, k] + half * along
            A[1, k] += h * A[3, k] + half * across
            A[2, k] += h * along
            A[3, k] += h * across
            A[4, k] -= h * A[7, k]
            A[5, k] += h * A[8, k]
            A[6, k] += h * A[9, k]
        for j in range(N):
            along = X4 * A[j, 4] + X5 * A[j, 5] + X6 * A[j, 6] + X7 * A[j, 7]
            across = Y4 * A[j, 4] + Y5 * A[j, 5] + Y6 * A[j, 6] + Y7 * A[j, 7]
            A[j, 0] += h * A[j, 2] + half * along
            A[j, 1] += h * A[j, 3] + half * across
            A[j, 2] += h * along
            A[j, 3] += h * across
            A[j, 4] -= h * A[j, 7]
            A[j, 5] += h * A[j, 8]
            A[j, 6] += h * A[j, 9]
        q_x = noise[0] if there[i, 0] else noise[2]
        q_y = noise[0] if there[i, 1] else noise[2]
        q_XX, q_XY, q_YY = c * c * q_x + s * s * q_y, c * s * (q_x - q_y), s * s * q_x + c * c * q_y
        third = h * h * h / 3.0
        A[0, 0] += third * q_XX
        A[1, 1] += third * q_YY
        A[0, 1] += third * q_XY
        A[0, 2] += half * q_XX
        A[1, 3] += half * q_YY
        A[0, 3] += half * q_XY
        A[1, 2] += half * q_XY
        A[2, 2] += h * q_XX
        A[3, 3] += h * q_YY
        A[2, 3] += h * q_XY
        A[4, 4] += h * (noise[1] if there[i, 2] else noise[3])
        A[5, 5] += h * noise[4] + third * noise[6]
        A[6, 6] += h * noise[4] + third * noise[6]
        A[7, 7] += h * noise[5]
        A[5, 8] += half * noise[6]
        A[6, 9] += half * noise[6]
        A[8, 8] += h * noise[6]
        A[9, 9] += h * noise[6]
        # The upper triangle counts, so that rounding leaves no asymmetry.
        for j in range(N):
            for k in range(j, N):
                P[i, j, k] = A[j, k]
                P[i, k, j] = A[j, k]
