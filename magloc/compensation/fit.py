r"""Fit of the platform's coefficients at one sensor.

The readings are a slow background, the platform's terms and noise,

.. math:: y_i = s_i + |b_i + h_i(c)| - |b_i| + ν_i

The background s is the sum of a random walk and of an integrated one. Their densities and the noise maximise the
evidence, so that the covariance of the coefficients accounts for residuals that are correlated in time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from arrays.typing import BoolArray, FloatArray
from magloc.compensation.attitude import Attitude, ambient_at, attitude_effects, currents_at, platform_moduli
from magloc.compensation.signals import Signal
from magloc.compensation.terms import PlatformTerms
from magloc.surveying.fit.kernels import WhiteningFilter

_NANO = 1e9
_ITERATIONS = 20
_SETTLED = 0.05  # change of an iteration, in standard deviations
_NOISE_AT = (1, 3)  # iterations that estimate the noise anew
_LARGEST_nT, _LARGEST_SLOPE = 1e4, 1e2  # priors of the background and of its slope, per second
_GRADIENT_nT_m = 0.1  # prior of a uniform gradient of the Earth's field
_LAG_S, _LARGEST_LAG_S, _LAG_STEP_S = 0.5, 1.0, 0.1
_DIFFERENCE_S = 0.02
_OUTLIER, _MOST_OUTLIERS = 5.0, 0.1
_LEAST = 1e-5  # of standard deviations and densities, in nT
FEWEST_ROWS = 60


@dataclass(frozen=True, eq=False)
class Background:
    """Noise and slow background of a record.

    Attributes
    ----------
    noise_nT : float
        Standard deviation of a sample.
    walk_nT_rts, bend_nT_s15 : float
        Densities of the random walk [nT/√s], and of the one whose integral is added [nT/s^1.5].
    """

    noise_nT: float
    walk_nT_rts: float
    bend_nT_s15: float

    @classmethod
    def usual(cls, noise_T: float) -> Background:
        """Return a background that leaves manoeuvres alone, for a stated noise."""
        return cls(max(_NANO * noise_T, 1e-3), 0.3, 0.1)

    def whitening(self, time_s: FloatArray) -> WhiteningFilter:
        """Return the filter that whitens samples at some times, in units of the noise."""
        n, dt = len(time_s), np.diff(time_s, prepend=time_s[0])
        walk, bend = (each / self.noise_nT for each in (self.walk_nT_rts, self.bend_nT_s15))
        added = np.stack([walk**2 * dt, bend**2 * dt**3 / 3.0, bend**2 * dt], axis=1)
        H = np.tile([1.0, 1.0, 0.0], (n, 1, 1))
        start = np.array([0.0, (_LARGEST_nT / self.noise_nT) ** 2, (_LARGEST_SLOPE / self.noise_nT) ** 2])
        return WhiteningFilter(H, np.ones((n, 3)), added, dt, start)


@dataclass(frozen=True, eq=False)
class CalibrationRows:
    """Samples of one sensor that a platform's coefficients are fitted to.

    Attributes
    ----------
    time_s, modulus_T : ndarray, shape (n,)
    attitude : Attitude
    is_own : bool
        True if the attitude comes from the same sensor.
    currents : Signal, optional
    place_m : ndarray, shape (n, 3), optional
    noise_T : float
        Stated noise of a sample.
    late_s : float
        Coarse estimate of the lag of the attitude.
    """

    time_s: FloatArray
    modulus_T: FloatArray
    attitude: Attitude
    is_own: bool
    currents: Signal | None
    place_m: FloatArray | None
    noise_T: float
    late_s: float = 0.0

    def __getitem__(self, which: BoolArray) -> CalibrationRows:
        """Return some of the samples."""
        place = None if self.place_m is None else self.place_m[which]
        return replace(self, time_s=self.time_s[which], modulus_T=self.modulus_T[which], place_m=place)


@dataclass(frozen=True, eq=False)
class PlatformFit:
    """Coefficients at one sensor.

    Attributes
    ----------
    terms : PlatformTerms
    mean : ndarray, shape (q + m,)
        Coefficients in units of their priors, and errors of the attitude.
    joint_covariance : ndarray, shape (q + m, q + m)
        Their covariance; the second order of undetermined turns is not in it.
    lag_s, lag_sigma_s : float
        Time by which the attitude is later than the readings.
    background : Background
    rows : CalibrationRows
        Samples that were used.
    field_T : ndarray, shape (n, 3)
        Ambient field of the samples in the platform's axes.
    effect_T : ndarray, shape (n,)
        Effect of the platform.
    problem : LinearProblem
        The last linear problem.
    outliers : int
        Samples that were excluded.
    """

    terms: PlatformTerms
    mean: FloatArray
    joint_covariance: FloatArray
    lag_s: float
    lag_sigma_s: float
    background: Background
    rows: CalibrationRows
    field_T: FloatArray
    effect_T: FloatArray
    problem: LinearProblem
    outliers: int

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients (q,) in units of their priors."""
        return self.mean[: len(self.terms.names)]

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (q, q) of the coefficients in units of their priors."""
        q = len(self.terms.names)
        return _with_squared_turns(self.joint_covariance[:q, :q], self.terms)

    @property
    def values(self) -> FloatArray:
        """Coefficients (q,) in SI units."""
        return self.coefficients * self.terms.sigma

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (q,) of the coefficients in SI units."""
        return np.sqrt(np.diagonal(self.covariance)) * self.terms.sigma


def fit_platform(rows: CalibrationRows, terms: PlatformTerms) -> PlatformFit:
    """Return the coefficients of the terms, with their covariance."""
    q, outliers = len(terms.names), 0
    background = Background.usual(rows.noise_T)
    coarse_s = 0.0 if rows.is_own else _coarse_lag(rows, terms, background)
    rows = replace(rows, late_s=coarse_s)
    point = LinearProblem.at(rows, terms, np.zeros(q), 0.0)
    for iteration in range(_ITERATIONS):
        if iteration in _NOISE_AT:
            background = _most_likely(point, background)
        solved = point.solve(background)
        if iteration in _NOISE_AT:
            good = np.abs(solved.innovations) < _OUTLIER
            if 0 < (~good).sum() < _MOST_OUTLIERS * len(good):
                outliers += int((~good).sum())
                rows = point.rows[good]
        change = (solved.mean - point.unknowns)[:q] / np.sqrt(np.diagonal(solved.covariance)[:q])
        point = LinearProblem.at(rows, terms, solved.mean[:q], 0.0 if rows.is_own else solved.mean[-1] * _LAG_S)
        if iteration > _NOISE_AT[-1] and np.abs(change).max() < _SETTLED:
            break
    solved = point.solve(background)
    joint = q + point.n_errors
    lag = (0.0, 0.0) if rows.is_own else (solved.mean[-1] * _LAG_S, np.sqrt(solved.covariance[-1, -1]) * _LAG_S)
    return PlatformFit(
        terms,
        solved.mean[:joint],
        solved.covariance[:joint, :joint],
        coarse_s + float(lag[0]),
        float(lag[1]),
        background,
        point.rows,
        point.field_T,
        point.effect_at(solved.mean),
        point,
        outliers,
    )


def _with_squared_turns(covariance: FloatArray, terms: PlatformTerms) -> FloatArray:
    r"""Return a covariance with the second order of antisymmetric induced fields, which change a modulus only there.

    A turn θ adds :math:`-θθ^T/2` to the symmetric matrix that a modulus determines. For turns with the variance τ² per
    axis its elements without the trace are independent, with the variance :math:`τ^4/2`.
    """
    variance = float(np.mean((np.diagonal(covariance) * terms.sigma**2)[terms.turns])) / 2.0
    more = np.zeros(len(covariance))
    if terms.sigma[terms.gain]:
        more[terms.stretches] = 0.5 * (variance / terms.sigma[terms.stretches]) ** 2
    return covariance + np.diag(more)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior mean and covariance of all unknowns in units of their priors, and white residuals."""

    mean: FloatArray
    covariance: FloatArray
    innovations: FloatArray
    columns: FloatArray
    minus_log_evidence: float


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """Linear problem at some coefficients: samples [nT] and their derivatives by unknowns of unit variance."""

    rows: CalibrationRows
    samples_nT: FloatArray
    columns_nT: FloatArray
    field_T: FloatArray
    effect_T: FloatArray
    n_errors: int
    unknowns: FloatArray

    @classmethod
    def at(cls, rows: CalibrationRows, terms: PlatformTerms, coefficients: FloatArray, lag_s: float) -> LinearProblem:
        """Return the problem at coefficients and a lag; samples without an attitude are ignored."""
        attitude = rows.attitude
        if rows.is_own and coefficients.any():
            attitude = attitude.without(terms, coefficients, rows.currents)
        known = np.isfinite(attitude.at(rows.time_s + rows.late_s + lag_s)[0]).all(axis=1)
        known &= np.isfinite(currents_at(rows.currents, rows.time_s)).all(axis=1)
        if known.sum() < FEWEST_ROWS:
            raise ValueError(
                f"Input readings must have {FEWEST_ROWS} samples with an attitude and all currents; instead received"
                f" {known.sum()}."
            )
        rows = rows[np.asarray(known)]
        currents, modulus = currents_at(rows.currents, rows.time_s), rows.modulus_T
        own = rows.time_s if rows.is_own else None
        for _ in range(2):
            field, rate = ambient_at(attitude, rows.time_s, modulus, rows.late_s + lag_s)
            effect, columns = platform_moduli(terms, coefficients, field, rate, currents, own)
            modulus = rows.modulus_T - effect
        errors = attitude_effects(attitude, rows.time_s, terms, coefficients, field, rate, currents)
        more = list(_nuisances(rows, attitude, terms, coefficients, lag_s, currents))
        columns = _NANO * np.column_stack([columns, errors, *more])
        unknowns = np.concatenate([coefficients, np.zeros(columns.shape[1] - len(coefficients))])
        if not rows.is_own:
            unknowns[-1] = lag_s / _LAG_S
        samples = _NANO * (modulus - np.median(modulus)) + columns @ unknowns
        return cls(rows, samples, columns, field, effect, errors.shape[1], unknowns)

    def effect_at(self, unknowns: FloatArray) -> FloatArray:
        """Return the effect [T] of the platform at some unknowns, in first order, without that of a gradient."""
        change = unknowns - self.unknowns
        if self.rows.place_m is not None:
            change[len(change) - 3 - (not self.rows.is_own) :][:3] = 0.0
        return self.effect_T + self.columns_nT @ change / _NANO

    def solve(self, background: Background) -> Posterior:
        """Return the posterior of the unknowns for a noise and a background."""
        white = background.whitening(self.rows.time_s)
        m = self.columns_nT.shape[1]
        Y = np.column_stack([self.columns_nT, self.samples_nT])[:, None] / background.noise_nT
        Y = np.ascontiguousarray(Y)
        white.whiten(Y, np.arange(len(Y)))
        A, y = Y[:, 0, :m], Y[:, 0, m]
        # Of the columns themselves: their products are singular in double precision where some are nearly equal.
        with_prior = np.concatenate([np.column_stack([A, y]), np.eye(m, m + 1)])
        triangle = np.asarray(np.linalg.qr(with_prior, mode="r"))[:m]
        root, inverse = triangle[:, :m], np.linalg.inv(triangle[:, :m])
        covariance = np.asarray(inverse @ inverse.T)
        mean = inverse @ triangle[:, m]
        residual = y - A @ mean
        evidence = float(y @ residual) + 2.0 * float(np.log(np.abs(np.diagonal(root))).sum())
        evidence -= 2.0 * float(np.log(white.gains[:, 0, -1]).sum()) - 2.0 * len(y) * float(np.log(background.noise_nT))
        return Posterior(mean, covariance, residual, A, evidence)


def _nuisances(
    rows: CalibrationRows,
    attitude: Attitude,
    terms: PlatformTerms,
    coefficients: FloatArray,
    lag_s: float,
    currents: FloatArray,
) -> Iterator[FloatArray]:
    """Yield derivatives [T] by a gradient of the Earth's field and by the lag, each of unit variance."""
    if rows.place_m is not None:
        yield _GRADIENT_nT_m / _NANO * (rows.place_m - rows.place_m.mean(axis=0))
    if not rows.is_own:
        sides = []
        for side in (-1.0, 1.0):
            later_s = rows.late_s + lag_s + side * _DIFFERENCE_S
            field, rate = ambient_at(attitude, rows.time_s, rows.modulus_T, later_s)
            sides.append(platform_moduli(terms, coefficients, field, rate, currents)[0])
        yield np.nan_to_num(sides[1] - sides[0])[:, None] * (_LAG_S / (2.0 * _DIFFERENCE_S))


def _coarse_lag(rows: CalibrationRows, terms: PlatformTerms, background: Background) -> float:
    """Return the lag with the best linear fit; 0 if no lag fits clearly better."""
    steps = round(_LARGEST_LAG_S / _LAG_STEP_S)
    lags = _LAG_STEP_S * np.array(sorted(range(-steps, steps + 1), key=abs))
    start, costs = np.zeros(len(terms.names)), []
    for lag in lags:
        points = LinearProblem.at(replace(rows, late_s=float(lag)), terms, start, 0.0)
        costs.append(points.solve(background).minus_log_evidence / len(points.samples_nT))
    best = int(np.argmin(costs))
    return float(lags[best]) if costs[best] < 0.9 * costs[0] else 0.0


def _most_likely(point: LinearProblem, start: Background) -> Background:
    """Return the noise and the background with the largest evidence."""

    def cost(logarithms: FloatArray) -> float:
        return point.solve(_background(logarithms)).minus_log_evidence

    first = np.log([start.noise_nT, start.walk_nT_rts, start.bend_nT_s15])
    simplex = first + np.vstack([np.zeros(3), 1.5 * np.eye(3)])
    found = minimize(
        cost, first, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.05}
    )
    return _background(found.x)


def _background(logarithms: FloatArray) -> Background:
    noise, walk, bend = np.exp(np.clip(logarithms, np.log(_LEAST), 10.0)).tolist()
    return Background(noise, walk, bend)
