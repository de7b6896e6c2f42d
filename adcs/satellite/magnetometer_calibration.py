r"""Calibration of a magnetometer from a log and the field along the orbit, with or without the attitude.

The magnetometer reads :math:`z = (E + D)\,b + o + n`. D has nine parameters, with the gains on its diagonal; o is the
bias. Without an attitude each row measures a modulus, :math:`|(E + D)^{-1}(z - o)| = |b|`; with an attitude it measures
all of b. All parameters have a prior, so that an unobservable one keeps its prior value and deviation. The field is
computed along the orbit at the row's time plus a shift, the last parameter. See docs/theory/attitude-kalman-filters.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from adcs.environment.environment import environment
from adcs.frames import turned
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Telemetry
from arrays.io.errors import check_not_negative, check_positive
from arrays.io.results import Drawn
from arrays.typing import BoolArray, FloatArray
from magloc.least_squares import damped_step, minimise
from magloc.levels import SIGMA_OF_MAD

Attitude = Literal["none", "orbital"]
"""Known attitude: none, or constant in the frame of the model's field."""
NAMES = (
    *(f"bias_{axis}" for axis in "xyz"),
    *(f"gain_{row}{column}" for row in "xyz" for column in "xyz"),
    "time_shift",
)
"""Parameters of the calibration, in the order of its covariance."""
OUTLIER = 5.0
"""Rows with residuals beyond this times their spread are excluded."""
_ITERATIONS, _ROUNDS, _DECIMATED, _SETTLED, _FEWEST = 60, 10, 1000, 1e-4, 20
_KNOT_S, _SHIFTS_S = 10.0, 15.0
"""Steps of the model's instants and of the trial shifts; the field changes over minutes."""
_LONGEST_SHIFT_S = 3600.0  # the field is computed along the orbit for three times as long, before and after the log


@dataclass(frozen=True)
class MagnetometerPrior:
    """Prior standard deviations of a magnetometer's noise and calibration.

    Attributes
    ----------
    noise_T, bias_T : float
        Standard deviations of a reading of an axis, and of the bias.
    gain, axes_rad : float
        Standard deviations of the gains, and of the misalignment of the axes.
    field_error_T, field_correlation_s : float
        Standard deviation of a component of the model's error, and its time constant.
    time_shift_s : float
        Standard deviation of the time of the positions against that of the readings; 0 if it is known.

    Raises
    ------
    ValueError
        A number is not positive (the model's error and the shift may be zero), or the shift is more than an hour.

    Examples
    --------
    >>> import adcs
    >>> prior = adcs.MagnetometerPrior(bias_T=20e-6, time_shift_s=300.0)
    >>> prior.gain
    0.05
    """

    noise_T: float = 250e-9
    bias_T: float = 2e-6
    gain: float = 0.05
    axes_rad: float = math.radians(1.0)
    field_error_T: float = 100e-9
    field_correlation_s: float = 132.0
    time_shift_s: float = 0.0

    def __post_init__(self) -> None:
        own = vars(self)
        may_be_zero = ("field_error_T", "time_shift_s")
        check_not_negative(**{name: own[name] for name in may_be_zero})
        check_positive(**{name: value for name, value in own.items() if name not in may_be_zero})
        if self.time_shift_s > _LONGEST_SHIFT_S:
            raise ValueError(
                f"Input time_shift_s must be at most {_LONGEST_SHIFT_S:g} s; instead received {self.time_shift_s:g}."
            )

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations of :data:`NAMES`, shape (13,)."""
        D = np.where(np.eye(3), self.gain, self.axes_rad).ravel()
        return np.concatenate([np.full(3, self.bias_T), D, [self.time_shift_s]])


@dataclass(frozen=True, eq=False)
class MagnetometerCalibration(Drawn):
    """Calibration of a magnetometer.

    Attributes
    ----------
    bias_T : ndarray, shape (3,)
        Bias o, the reading in zero field.
    gain : ndarray, shape (3, 3)
        Gains and misalignments D.
    time_shift_s : float
        Time shift of the model: the field at a row is the model's at this later time.
    covariance : ndarray, shape (13, 13)
        Posterior covariance of :data:`NAMES`.
    prior : MagnetometerPrior
        Prior of the calibration.
    residual_T : ndarray, shape (n,) or (n, 3)
        Calibrated modulus, or field, minus the model; NaN for rows that are not used.
    raw_rms_T : float
        Root mean square of the same rows without a calibration; without an attitude, of the modulus.
    chi2, dof : float, int
        Sum of squares of the whitened used rows, and their number.
    used : ndarray of bool, shape (n,)
        Rows in use: those with readings that fit the others.
    """

    figure = "adcs.plots.magnetometers:magnetometer_figure"

    bias_T: FloatArray
    gain: FloatArray
    time_shift_s: float
    covariance: FloatArray
    prior: MagnetometerPrior
    residual_T: FloatArray
    raw_rms_T: float
    chi2: float
    dof: int
    used: BoolArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of :data:`NAMES`, shape (13,)."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def misfit(self) -> float:
        """Excess of χ² over its expectation, in standard deviations."""
        return (self.chi2 - self.dof) / math.sqrt(2.0 * self.dof)

    @property
    def rms_T(self) -> float:
        """Root mean square of the used residuals."""
        return float(np.sqrt(np.nanmean(self.residual_T**2)))

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters whose variance the log reduces by less than half."""
        prior = self.prior.deviations
        return tuple(
            name
            for name, sigma, before in zip(NAMES, self.sigma, prior, strict=True)
            if before > 0.0 and sigma**2 > 0.5 * before**2
        )

    def applied(self, readings_T: ArrayLike) -> FloatArray:
        """Return the fields (..., 3) of readings (..., 3)."""
        return turned(np.linalg.inv(np.eye(3) + self.gain), np.asarray(readings_T, dtype=np.float64) - self.bias_T)


class _FieldRows(NamedTuple):
    """Rows with readings, and the model of the field over time."""

    time_s: FloatArray
    readings_T: FloatArray
    model: Callable[[FloatArray], FloatArray]
    slope: Callable[[FloatArray], FloatArray]

    def select(self, which: BoolArray | slice) -> _FieldRows:
        """Select some of the rows."""
        return self._replace(time_s=self.time_s[which], readings_T=self.readings_T[which])


_Linearised = Callable[[_FieldRows, FloatArray, MagnetometerPrior], tuple[FloatArray, FloatArray]]
"""Residuals (n,) or (n, 3) and their derivatives (..., 13) at parameters (13,)."""


def calibrate_magnetometer(
    telemetry: Telemetry,
    satellite: Satellite,
    *,
    prior: MagnetometerPrior = MagnetometerPrior(),
    attitude: Attitude = "none",
) -> MagnetometerCalibration:
    r"""Calibrate a magnetometer from a log and the field along the orbit: :math:`z = (E + D)\,b + o`.

    Parameters
    ----------
    telemetry : Telemetry
        Log, of which the magnetometer and the times are used.
    satellite : Satellite
        Orbit, and model of the field.
    prior : MagnetometerPrior
        Noise, and prior deviations of bias, gains, axes, the model's error and the time shift.
    attitude : str
        ``none``: the attitude is unknown, and only the modulus of each row is used. The modulus does not determine the
        rotation of the sensor, only (E + D)(E + D)ᵀ. ``orbital``: the attitude is constant in the orbital frame, and
        unknown there.

    Returns
    -------
    MagnetometerCalibration
        Calibration with its covariance; an unobservable parameter has the deviation of its prior.

    Raises
    ------
    ValueError
        Fewer than 20 rows can be used, or a date is outside of the field model.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> result = adcs.calibrate_magnetometer(log.telemetry, log.satellite)
    >>> "gain_xx" in result.undetermined  # 200 s tell little
    True
    """
    reach_s = 3.0 * prior.time_shift_s + 2.0 * _KNOT_S
    first_s, last_s = telemetry.time_s[0] - reach_s, telemetry.time_s[-1] + reach_s
    since_s = np.linspace(0.0, last_s - first_s, 2 + math.ceil((last_s - first_s) / _KNOT_S))
    start = satellite.start + np.timedelta64(round(1e6 * first_s), "us")
    around = environment(satellite.orbit, start, since_s, model=satellite.field_model)
    along = first_s + since_s, around.b_orbital_T
    return calibrate_readings(telemetry.time_s, telemetry.field_T, *along, prior=prior, attitude=attitude)


def calibrate_readings(
    time_s: ArrayLike,
    readings_T: ArrayLike,
    model_time_s: ArrayLike,
    model_T: ArrayLike,
    *,
    prior: MagnetometerPrior,
    attitude: Attitude,
) -> MagnetometerCalibration:
    """Calibrate readings against a model of the field over time, as :func:`calibrate_magnetometer`.

    ``time_s`` (n,), ``readings_T`` (n, 3): ascending times and readings; rows with a NaN are not used.
    ``model_time_s`` (m,), ``model_T`` (m, 3): field of the model in a frame in which a known attitude is constant. It
    must extend beyond the rows by three deviations of the shift.
    """
    times, readings = np.asarray(time_s, dtype=np.float64), np.asarray(readings_T, dtype=np.float64)
    knots = CubicSpline(np.asarray(model_time_s, dtype=np.float64), np.asarray(model_T, dtype=np.float64))
    rows = _FieldRows(times, readings, knots, knots.derivative())
    used: BoolArray = np.isfinite(readings).all(axis=1)  # type: ignore[assignment]
    _check_enough(used)
    linearised = _modulus if attitude == "none" else partial(_orbital, _orbital_frame(rows.select(used), prior))
    x = _fit_shifts(rows.select(used), prior, linearised)
    for _ in range(_ROUNDS):
        fit = _maximise_posterior(rows.select(used), prior, linearised, x)
        x = fit.x
        far = _outliers(linearised(rows.select(used), x, prior)[0], prior)
        if not far.any():
            break
        used[np.flatnonzero(used)[far]] = False
        _check_enough(used)
    kept = rows.select(used)
    residual = linearised(kept, x, prior)[0]
    whitened = _whiten(kept.time_s, residual.reshape(len(kept.time_s), -1), prior)
    all_of = np.full((len(times), *residual.shape[1:]), np.nan)
    all_of[used] = residual
    raw = linearised(kept, np.concatenate([np.zeros(12), x[12:]]), prior)[0]
    deviations = prior.deviations
    return MagnetometerCalibration(
        bias_T=x[:3],
        gain=x[3:12].reshape(3, 3),
        time_shift_s=float(x[12]),
        covariance=deviations[:, None] * np.linalg.inv(fit.information + np.eye(13)) * deviations,
        prior=prior,
        residual_T=all_of,
        raw_rms_T=float(np.sqrt(np.mean(raw**2))),
        chi2=float(np.sum(whitened**2)),
        dof=whitened.size,
        used=used,
    )


def _check_enough(used: BoolArray) -> None:
    """Raise ValueError if too few rows remain."""
    if used.sum() < _FEWEST:
        raise ValueError(
            f"Input telemetry must have {_FEWEST} rows of the magnetometer that fit each other; "
            f"instead received {used.sum()}."
        )


def _modulus(rows: _FieldRows, x: FloatArray, prior: MagnetometerPrior) -> tuple[FloatArray, FloatArray]:
    """Return the calibrated modulus minus that of the model, and its derivatives."""
    inverse = np.linalg.inv(np.eye(3) + x[3:12].reshape(3, 3))
    at = rows.time_s + x[12]
    b, slope = rows.model(at), rows.slope(at)
    length = np.linalg.norm(b, axis=1)
    field = (rows.readings_T - x[:3]) @ inverse.T
    modulus = np.linalg.norm(field, axis=1)
    n = field / modulus[:, None]
    across = n @ inverse
    # With the model's modulus, because squared noise of the readings would look like information on the gains.
    by_gain = -(across[:, :, None] * (n * length[:, None])[:, None, :]).reshape(-1, 9)
    by_shift = -np.sum(b * slope, axis=1) / length
    # The noise across the field increases the modulus.
    return modulus - length - prior.noise_T**2 / length, np.concatenate([-across, by_gain, by_shift[:, None]], axis=1)


def _orbital(
    rotation: FloatArray, rows: _FieldRows, x: FloatArray, prior: MagnetometerPrior
) -> tuple[FloatArray, FloatArray]:
    """Return the residuals for a constant attitude, body from the model's frame, and their derivatives."""
    at = rows.time_s + x[12]
    b, slope = (values @ rotation.T for values in (rows.model(at), rows.slope(at)))
    gain = np.eye(3) + x[3:12].reshape(3, 3)
    by = np.zeros((len(at), 3, 13))
    by[:, :, :3] = -np.eye(3)
    by[:, :, 3:12] = -np.einsum("ij,rk->rijk", np.eye(3), b).reshape(-1, 3, 9)
    by[:, :, 12] = -slope @ gain.T
    return rows.readings_T - b @ gain.T - x[:3], by


def _orbital_frame(rows: _FieldRows, prior: MagnetometerPrior) -> FloatArray:
    """Return the rotation, body from the model's frame, of the best affine map over shifts."""
    best, rotation = math.inf, np.eye(3)
    for shift in _grid(prior):
        b = rows.model(rows.time_s + shift)
        columns = np.column_stack([b, np.ones(len(b))])
        affine = np.linalg.lstsq(columns, rows.readings_T, rcond=None)[0]
        misfit = float(np.median(np.linalg.norm(rows.readings_T - columns @ affine, axis=1)))
        if misfit < best:
            left, _, right = np.linalg.svd(affine[:3].T)
            best, rotation = misfit, left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation


def _grid(prior: MagnetometerPrior) -> FloatArray:
    """Return shifts within three deviations."""
    reach = 3.0 * prior.time_shift_s
    return np.linspace(-reach, reach, 1 + 2 * math.ceil(reach / _SHIFTS_S))


def _fit_shifts(rows: _FieldRows, prior: MagnetometerPrior, linearised: _Linearised) -> FloatArray:
    """Return the parameters at the best shift of the grid, by a part of the rows."""
    few = rows.select(slice(None, None, 1 + len(rows.time_s) // _DECIMATED))
    starts = []
    for shift in _grid(prior):
        x = np.concatenate([np.zeros(12), [shift]])
        x = _maximise_posterior(few, replace(prior, time_shift_s=0.0), linearised, x, most=4).x
        residual = np.abs(linearised(few, x, prior)[0])
        starts.append((float(np.median(residual)), x))
    return min(starts, key=lambda start: start[0])[1]


@dataclass(frozen=True, eq=False)
class _Posterior:
    """Posterior at parameters (13,); a prior deviation of zero holds a parameter at its first value."""

    rows: _FieldRows
    prior: MagnetometerPrior
    linearised: _Linearised
    x: FloatArray
    first: FloatArray

    @cached_property
    def _white(self) -> FloatArray:
        """Whitened residuals (n,) and their derivatives (n, 13) in units of the prior's deviations."""
        residual, by = self.linearised(self.rows, self.x, self.prior)
        n = len(self.rows.time_s)
        both = np.concatenate([residual.reshape(n, -1, 1), (by * self.prior.deviations).reshape(n, -1, 13)], axis=2)
        return _whiten(self.rows.time_s, both.reshape(n, -1), self.prior).reshape(-1, 14)

    @cached_property
    def _off(self) -> FloatArray:
        """Parameters minus those of the prior, in its deviations."""
        deviations = self.prior.deviations
        return np.divide(self.x - self.first, deviations, out=np.zeros(13), where=deviations > 0.0)

    @property
    def cost(self) -> float:
        """Cost of rows and prior."""
        return float(self._white[:, 0] @ self._white[:, 0] + self._off @ self._off)

    @property
    def information(self) -> FloatArray:
        """Information H (13, 13) of the rows."""
        return np.asarray(self._white[:, 1:].T @ self._white[:, 1:])

    def step(self, damping: float) -> tuple[_Posterior, float]:
        """Return the parameters after a damped step."""
        gradient = self._white[:, 1:].T @ self._white[:, 0] + self._off
        step, promised = damped_step(self.information + np.eye(13), gradient, damping)
        return replace(self, x=self.x + self.prior.deviations * step), promised


def _maximise_posterior(
    rows: _FieldRows, prior: MagnetometerPrior, linearised: _Linearised, x: FloatArray, most: int = _ITERATIONS
) -> _Posterior:
    """Maximise the posterior."""
    start = _Posterior(rows, prior, linearised, x, x * (prior.deviations == 0.0))
    return minimise(start, lambda _: _SETTLED, max_iterations=most).point


def _outliers(residual: FloatArray, prior: MagnetometerPrior) -> BoolArray:
    """Return rows (n,) beyond :data:`OUTLIER` times the stated noise and times the spread of the rows."""
    size = np.abs(residual).reshape(len(residual), -1).max(axis=1)
    spread = SIGMA_OF_MAD * float(np.median(np.abs(residual)))
    return size > OUTLIER * max(spread, math.hypot(prior.noise_T, prior.field_error_T))


def _whiten(time_s: FloatArray, columns: FloatArray, prior: MagnetometerPrior) -> FloatArray:
    """Whiten columns (n, k) with white noise and an Ornstein-Uhlenbeck error.

    The result is the normalised innovation of a scalar Kalman filter; its gains are the same for all columns.
    """
    decay = np.exp(-np.diff(time_s, prepend=time_s[0]) / prior.field_correlation_s)
    stationary, noise = prior.field_error_T**2, prior.noise_T**2
    variance, mean, white = stationary, np.zeros(columns.shape[1]), np.empty_like(columns)
    for i in range(len(time_s)):
        mean = decay[i] * mean
        variance = stationary + decay[i] ** 2 * (variance - stationary)
        total = variance + noise
        innovation = columns[i] - mean
        white[i] = innovation / math.sqrt(total)
        gain = variance / total
        mean = mean + gain * innovation
        variance = (1.0 - gain) * variance
    return white
