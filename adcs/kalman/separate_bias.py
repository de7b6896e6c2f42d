r"""Disturbance d (s⁻²) in :math:`\dot\omega = f(x) + d`, estimated by a filter of its own beside that of the state.

The other way, d in the state itself, is the optional state ``disturbance`` of :mod:`adcs.kalman.error_state`. Here a
filter without it gives H, Φ, its gain K and its innovation z̃, and

.. math::

    S^- &= \Phi S^+ + B, \quad B = (h^2/4\,E; hE), \qquad P_d^- = P_d/\lambda, \qquad H_d = H S^- \\
    K_d &= P_d^- H_d^T (H_d P_d^- H_d^T + HP^-H^T + R)^{-1}, \qquad d^+ = d^- + K_d \tilde z, \quad
    P_d^+ = (E - K_d H_d) P_d^- \\
    S^+ &= (E - KH) S^-, \qquad x^+ = x^- + K\tilde z + S^+ (d^+ - d^-)

with a forgetting factor λ. S is how the filter's state depends on d. The source paper leaves out the recursion of P_d
and S and the last term; without that term the filter goes on correcting d for errors which its state still has from the
old d, and oscillates or diverges (:func:`without_correction`).

With that term this is Friedland's separated bias (IEEE Trans. Automatic Control 14, 1969), whose covariance of the
whole is :math:`P + S P_d S^T`; it is what the estimates report.

Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64, 2014, section on the parallel filter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from adcs.kalman.error_state import AttitudeTracks, FilterSettings, Start
from adcs.kalman.mekf import check_start, collected, first_state, nis_of, predicted, stacked_residuals, with_error
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray

Correction = Callable[[FloatArray, FloatArray], FloatArray]


def by_sensitivity(S: FloatArray, change: FloatArray) -> FloatArray:
    """Correction S⁺(d⁺ - d⁻) of the state, (runs, N, 3) and (runs, 3) -> (runs, N)."""
    return (S @ change[..., None])[..., 0]


def without_correction(S: FloatArray, change: FloatArray) -> FloatArray:
    """No correction, as the source prints it: it does not work."""
    return np.zeros(S.shape[:-1])


def run_parallel(
    record: Record,
    settings: FilterSettings,
    start: Start,
    forgetting: float = 0.99,
    correction: Correction = by_sensitivity,
) -> AttitudeTracks:
    """Filter of whole runs with a parallel filter of the disturbance.

    Parameters
    ----------
    record : Record
    settings : FilterSettings
        Of a set with the state ``disturbance``; its process noise q_d is not used, forgetting takes its place.
    start : Start
    forgetting : float
        λ, above 0 and up to 1.
    correction : callable
        :func:`by_sensitivity`, or :func:`without_correction` to see the printed form fail.

    Returns
    -------
    AttitudeTracks
        Of the set with the disturbance; its covariance is that of the whole.

    Raises
    ------
    ValueError
        The set has no disturbance, λ is out of its range, or the start does not suit the record.
    """
    if not settings.sensors.disturbance:
        raise ValueError("Input settings must have the state disturbance; instead received a set without it.")
    if not 0.0 < forgetting <= 1.0:
        raise ValueError(f"Input forgetting must be above 0 and up to 1; instead received {forgetting}.")
    check_start(record, start)
    inner = replace(settings, sensors=replace(settings.sensors, disturbance=False))
    state = first_state(inner, start)
    runs, n = record.momentum_Nms.shape[:2]
    size, h = inner.sensors.size, record.dt_s
    B = np.concatenate([h * h / 4.0 * np.eye(3), h * np.eye(3), np.zeros((size - 6, 3))])
    S = np.zeros((runs, size, 3))
    P_d = np.tile(settings.disturbance_sigma_s2**2 * np.eye(3), (runs, 1, 1))
    states, nis = [], []
    for row in range(n):
        if row:
            state, Phi = predicted(record, row - 1, state, inner)
            S = Phi @ S + B
            P_d = P_d / forgetting
        H, residual = stacked_residuals(record, row, state, inner)
        HP = H @ state.P
        noise = HP @ H.mT + np.eye(H.shape[1])
        K = np.linalg.solve(noise, HP).mT
        H_d = H @ S
        of_d = H_d @ P_d
        whole = of_d @ H_d.mT + noise
        K_d = np.linalg.solve(whole, of_d).mT
        nis.append(nis_of(whole, H, residual, inner.sensors))
        rest, rest_d = np.eye(size) - K @ H, np.eye(3) - K_d @ H_d
        S = rest @ S
        # Joseph's form of both covariances.
        P = rest @ state.P @ rest.mT + K @ K.mT
        P_d = rest_d @ P_d @ rest_d.mT + K_d @ noise @ K_d.mT
        change = (K_d @ residual[..., None])[..., 0]
        dx = (K @ residual[..., None])[..., 0] + correction(S, change)
        state = with_error(state, dx, inner.sensors)
        state = replace(state, disturbance_s2=state.disturbance_s2 + change, P=P)
        states.append(replace(state, P=_whole(P, S, P_d)))
    return collected(settings, states, np.stack(nis, axis=1))


def _whole(P: FloatArray, S: FloatArray, P_d: FloatArray) -> FloatArray:
    """Covariance of the error state with the disturbance behind the others, (runs, N + 3, N + 3)."""
    across = S @ P_d
    return np.block([[P + across @ S.mT, across], [across.mT, P_d]])
