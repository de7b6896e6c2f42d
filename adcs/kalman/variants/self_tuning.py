r"""Multiple-model adaptive estimation: a bank of MEKFs with different standard deviations of the disturbance.

The disturbance is an Ornstein-Uhlenbeck process with a time constant of 300 s and a standard deviation of 1e-8 to 1e-4
s⁻², in steps of half a decade. With the innovations ν of each filter and their covariance S, the weights are

.. math:: w \propto \exp\left(-\tfrac12 \sum (\nu^T S^{-1} \nu + \ln |S|)\, e^{-\mathrm{age} / 1000\,\mathrm{s}}\right)

and the estimate is the mean of the mixture, with its covariance. The source proposes to estimate elements of Q: Ivanov,
Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64, 2014.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import softmax

from adcs import quaternion
from adcs.kalman.error_state import ALWAYS, AttitudeTracks, FilterSettings, FilterStart
from adcs.kalman.mekf import run_filter
from adcs.kalman.smoother import error_between
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray

DISTURBANCES_S2 = 10.0 ** np.arange(-8.0, -3.75, 0.5)
CORRELATION_S = 300.0
MEMORY_S = 1000.0
_RATE_NOISE_RAD_S = 1e-8  # per step: small, as the disturbance is a state


def run_self_tuned(record: Record, settings: FilterSettings, start: FilterStart) -> AttitudeTracks:
    """Run the bank over whole runs and return its mixture.

    ``settings``: a set with the state ``disturbance``, whose deviation and process noise the bank replaces. In the
    result ``nis`` is the weighted mean, and ``rejected`` that of the filter with the largest weight.
    """
    if "disturbance" not in settings.sensors.states:
        raise ValueError("Input settings must have the state disturbance; instead received a set without it.")
    noise = replace(settings.noise, rate_rad_s=_RATE_NOISE_RAD_S, disturbance_s2=0.0)
    one = replace(settings, noise=noise, disturbance_correlation_s=CORRELATION_S)
    bank = [run_filter(record, replace(one, disturbance_sigma_s2=float(sigma)), start) for sigma in DISTURBANCES_S2]
    return mixture(bank, weights(bank, record), DISTURBANCES_S2)


def weights(bank: list[AttitudeTracks], record: Record) -> FloatArray:
    """Return the weights (filters, runs, n) after the readings of each instant; equal before the first."""
    limit = bank[0].settings.gate_limit
    fits = np.stack([np.nansum(np.minimum(one.nis, limit) + one.log_det, axis=-1) for one in bank])
    log_weight = -0.5 * fits
    for row, step_s in enumerate(record.steps_s):
        log_weight[..., row + 1] += np.exp(-step_s / MEMORY_S) * log_weight[..., row]
    return np.asarray(softmax(log_weight, axis=0))


def mixture(bank: list[AttitudeTracks], weight: FloatArray, deviations_s2: FloatArray) -> AttitudeTracks:
    """Return mean and covariance of the mixture of filters with weights (filters, runs, n).

    ``deviations_s2`` (filters,): standard deviation of the disturbance in each filter.
    """
    settings, first = bank[0].settings, bank[len(bank) // 2]
    names = settings.sensors.states
    off = np.stack([error_between(one, first, settings.sensors) for one in bank])
    mean = np.sum(weight[..., None] * off, axis=0)
    covariance = np.zeros_like(first.covariance)
    for one, each, share in zip(bank, off - mean, weight, strict=True):
        covariance += share[..., None, None] * (one.covariance + each[..., :, None] * each[..., None, :])
    best = np.argmax(weight, axis=0)[None, ..., None]
    q = quaternion.multiply(first.q, quaternion.from_error_vector(mean[..., :3]))
    nis = np.stack([one.nis for one in bank])
    return AttitudeTracks(
        settings,
        quaternion.normalised(q),
        first.w + mean[..., 3:ALWAYS],
        {name: first.optional[name] + mean[..., settings.sensors.slice_of(name)] for name in names},
        covariance,
        np.sum(weight[..., None] * nis, axis=0),
        np.take_along_axis(np.stack([one.rejected for one in bank]), best, axis=0)[0],
        np.full(nis.shape[1:], np.nan),
        # The mean of logarithms, as the deviations of the bank are equally spaced in them.
        np.exp(np.tensordot(np.log(deviations_s2), weight, axes=1)),
    )
