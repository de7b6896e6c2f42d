r"""Fits with weights of whole sensors: without some sensors, or by Student-t scores.

A sensor whose squared residual is :math:`\rho_s` has the weight :math:`(\nu + n_s)/(\nu + \rho_s)`, iterated.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from arrays.typing import FloatArray, IntArray
from magloc.levels import SENSOR_FALSE_ALARM
from magloc.localization.fit.gauss_newton import JointFits, first_equal, refine
from magloc.localization.leave_one_out import Weighted, chi2_falls_without_sensors, weight_channels
from magloc.measurement.whitened import WhitenedModel

DEGREES_OF_FREEDOM = 4.0
LEAST_WEIGHT = 1e-16
# Ratio of estimated to stated variance above which the noise counts as understated.
_UNDERSTATED = 2.0
_N_REWEIGHTINGS = 30
# Fits of a row that differ less in position and (relatively) in weights are merged.
_SAME_PLACE, _SAME_WEIGHT = 0.01, 0.05
_FITS_AT_ONCE = 64  # fit in the processor's cache
# Median of χ²/n of three degrees of freedom.
_MEDIAN_RATIO = 0.789


@dataclass(frozen=True, eq=False)
class WeightedFits:
    """Fits of rows with weights of sensors (f, N); the readings (b, C) are raw.

    Attributes
    ----------
    sensor_channels : ndarray of int, shape (N, 3)
        Channels of every sensor; negative if it has no such channel.
    count : ndarray of int, shape (N,)
        Number of readings of every sensor.
    limits : ndarray, shape (N,)
        Limit of the squared residual of every sensor.
    free_position : bool
        True if the positions of sources are unknown.
    """

    problem: WhitenedModel
    raw: FloatArray
    sensor_channels: IntArray
    count: IntArray
    limits: FloatArray
    free_position: bool

    @property
    def n_sensors(self) -> int:
        """Number of sensors N."""
        return len(self.count)

    def weights_without(self, sensors: Sequence[Collection[int]]) -> FloatArray:
        """Return weights (f, N) of fits without some sensors."""
        weight = np.ones((len(sensors), self.n_sensors))
        for of_fit, some in zip(weight, sensors, strict=True):
            of_fit[list(some)] = LEAST_WEIGHT
        return weight

    def _weight(self, row: IntArray, weight: FloatArray) -> Weighted:
        return weight_channels(self.problem.rows(row), self.raw[row], weight[:, self.problem.channel_sensor])

    def refine(self, row: IntArray, q: FloatArray, mu: FloatArray, weight: FloatArray) -> JointFits:
        """Return weighted fits of rows (f,) from sources (f, K, …)."""
        return self._refine_rows(self._weight(row, weight), q, mu, max_iterations=60)

    def _refine_rows(self, lighter: Weighted, q: FloatArray, mu: FloatArray, max_iterations: int) -> JointFits:
        """Return fits of weighted rows (f,) from sources (f, K, …)."""
        problem, raw = lighter
        free = np.full((q.shape[1], 3), self.free_position)
        return refine(problem, problem.whiten(raw), q, mu, free=free, max_iterations=max_iterations)

    def chi2_falls(
        self, row: IntArray, q: FloatArray, mu: FloatArray, weight: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return :func:`chi2_falls_without_sensors` of fits of rows (f,)."""
        at = (self.problem.rows(row), self.raw[row]) if weight is None else self._weight(row, weight)
        return chi2_falls_without_sensors(*at, q, mu, self.sensor_channels, free_position=self.free_position)

    def misfit(self, row: IntArray, q: FloatArray, mu: FloatArray, weight: FloatArray) -> FloatArray:
        """Return squared residuals (f, N) of the sensors of some rows.

        The common field comes from the weighted fit.
        """
        return self._squares(self._weight(row, weight), q, mu, weight)

    def _squares(self, lighter: Weighted, q: FloatArray, mu: FloatArray, weight: FloatArray) -> FloatArray:
        """Return squared residuals (f, N) of the sensors of some weighted rows."""
        owner, (problem, raw) = self.problem.channel_sensor, lighter
        residual = problem.whiten(raw) - problem.predict(problem.source_fields(q, mu))
        of_sensor = owner[:, None] == np.arange(self.n_sensors)
        squares: FloatArray = (residual**2 / weight[:, owner]) @ of_sensor
        return squares

    def scale2(self, misfit: FloatArray) -> FloatArray:
        """Return the ratio (f,) of the noise variance to the stated one, at least one.

        It is estimated from the median sensor. If all sensors fit badly, the model or the stated noise is wrong, and
        not a sensor.
        """
        standing = self.count > 0
        ratio = np.median(misfit[:, standing] / self.count[standing], axis=1) / _MEDIAN_RATIO
        return np.maximum(1.0, ratio)

    def square_limits(self, scale2: float, n_sources: int) -> FloatArray:
        """Return limits (N,) of squared residuals divided by the noise variance.

        They are wider if the variance is an estimate.
        """
        if scale2 < _UNDERSTATED:
            return self.limits
        count = np.maximum(self.count, 1)
        # A median is about as accurate as the mean of half as many values.
        spare = 0.5 * max(2.0, self.count.sum() - 6.0 * n_sources - 6.0)
        quantile: FloatArray = fdtri(count, spare, 1.0 - SENSOR_FALSE_ALARM / self.n_sensors)
        return np.array(count * quantile, dtype=np.float64)

    def reweight(
        self, row: IntArray, q: FloatArray, mu: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return squared residuals (f, N) of the sensors after reweighting, and the noise scale."""
        q, mu, weight = q.copy(), mu.copy(), weight.copy()
        misfit, scale2 = np.empty(weight.shape), np.empty(len(row))
        live = twin = np.arange(len(row))
        for n in range(_N_REWEIGHTINGS + 1):
            for some in np.array_split(live, -(-live.size // _FITS_AT_ONCE)):
                lighter = self._weight(row[some], weight[some])
                if n:
                    fits = self._refine_rows(lighter, q[some], mu[some], max_iterations=8)
                    q[some], mu[some] = fits.q, fits.mu
                misfit[some] = self._squares(lighter, q[some], mu[some], weight[some])
            scale2[live] = self.scale2(misfit[live])
            new = (DEGREES_OF_FREEDOM + self.count) / (DEGREES_OF_FREEDOM + misfit[live] / scale2[live, None])
            new = np.clip(new, LEAST_WEIGHT, None)
            moved = np.any(np.abs(new - weight[live]) >= 1e-3 * weight[live], axis=1)
            live = live[moved]
            weight[live] = new[moved]
            twin = np.minimum(twin, first_equal(row, q, weight, _SAME_PLACE, _SAME_WEIGHT))
            live = live[twin[live] == live]
            if not live.size:
                break
        while not np.array_equal(twin[twin], twin):
            twin = twin[twin]
        return misfit[twin], scale2[twin]
