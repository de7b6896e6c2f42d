"""Fits without some sensors: weighted least squares, and first-order deletion of sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.localization.fit.gauss_newton import scaled_jacobian
from magloc.measurement.whitened import WhitenedModel

# Relative square below which a column of the common field counts as zero.
_UNSEEN = 1e-13
# Share of a direction of a sensor's readings that the others must check.
_CHECKED = 1e-6

Weighted = tuple[WhitenedModel, FloatArray]


def chi2_falls_without_sensors(
    problem: WhitenedModel,
    raw: FloatArray,
    q: FloatArray,
    mu: FloatArray,
    sensor_channels: IntArray,
    *,
    free_position: bool = True,
) -> tuple[FloatArray, FloatArray]:
    r"""Return the first-order decrease of χ² without each sensor, and the share of it that others check.

    Both are (b, N), for fits (b, K, …).

    Deleting channels adds their readings to the unknowns. With the readings' whitening W, residuals r and an
    orthonormal basis Q of the derivatives, sensor s takes :math:`g^T (I - H)^{-1} g`, where :math:`g = (W r)_s` and
    :math:`I - H = [W (I - Q Q^T) W]_{ss}`. Its least eigenvalue is the share that the other sensors check, 0 if they
    do not check it. Channels (N, 3) are negative if a sensor has none.
    """
    y = problem.whiten(raw)
    residual = problem.residual(y, q, mu, problem.source_fields(q, mu))
    jacobian = scaled_jacobian(problem, q, mu)
    if not free_position:
        jacobian = jacobian.reshape(*jacobian.shape[:2], -1, 2, 3)[..., 1, :].reshape(*jacobian.shape[:2], -1)
    norm = np.linalg.norm(jacobian, axis=1, keepdims=True)
    explained, _ = np.linalg.qr(jacobian / np.where(norm > 0.0, norm, 1.0))
    n_channels = y.shape[1]
    seen = problem.basis * np.sqrt(problem.shrinkage * (2.0 - problem.shrinkage))[:, None]
    taken = np.concatenate([seen, problem.whiten(explained[:, :n_channels])], axis=2)
    used = sensor_channels >= 0
    taken = np.where(used[..., None], taken[:, sensor_channels], 0.0)
    gradient = np.where(used, problem.whiten(residual[:, :n_channels])[:, sensor_channels], 0.0)
    checked, axes = np.linalg.eigh(np.eye(3) - taken @ taken.swapaxes(-1, -2))
    along = (axes.swapaxes(-1, -2) @ gradient[..., None])[..., 0]
    falls: FloatArray = np.sum(np.where(checked > _CHECKED, along**2 / np.maximum(checked, _CHECKED), 0.0), axis=-1)
    return falls, checked[..., 0]


def weight_channels(problem: WhitenedModel, raw: FloatArray, weight: FloatArray) -> Weighted:
    """Return a problem and its raw readings (b, C) with variances divided by weights (b, C)."""
    root = np.sqrt(weight)[..., None]
    flat = problem.shrinkage >= 1.0
    # A flat prior needs only the span of its columns; other priors need the variance along each of them too.
    some, known = flat.any(axis=0), ~flat.all(axis=0)
    span = root * (problem.basis * flat[:, None])[..., some]
    for _ in range(2):  # a second pass restores the digits that squares lose
        square, axes = np.linalg.eigh(span.transpose(0, 2, 1) @ span)
        seen = square > _UNSEEN * square[:, -1:]
        span = span @ (axes * np.where(seen, 1.0 / np.sqrt(np.where(seen, square, 1.0)), 0.0)[:, None])
    lighter = replace(problem, gain=root * problem.gain, basis=span, shrinkage=seen.astype(np.float64))
    if not flat.all():
        with np.errstate(divide="ignore"):
            deviation = np.where(flat, 0.0, np.sqrt(1.0 / (1.0 - problem.shrinkage) ** 2 - 1.0))
        lighter = lighter.marginalise(root * (problem.basis * deviation[:, None])[..., known])
    return lighter, root[..., 0] * raw
