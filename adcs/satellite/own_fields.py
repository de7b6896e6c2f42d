"""Fields of a satellite's own loads, magnets and torquers at each of its magnetometers.

Around a switch the ambient field in fixed axes is a smooth function of time, and the load adds a step. The gyro turns
(D_i) the fields y_i of a magnetometer from body axes into the axes at the switch:

    D_i y_i = quadratic(t_i) + D_i (Σ_k s_k(t_i) V_k + o),

with the states s_k of the loads, the field V_k of each load and an offset o. The polynomial is projected out, and all
switches together give one regression for V. It needs neither a field model nor an attitude. V_k has the same errors of
gain and axes as the readings, so it can be subtracted from them. A dipole fit to the V_k at all magnetometers locates
the load.

States and readings may have different clocks. The lag in whole rows is the one for which the switches explain the jumps
between rows best. Rows beside the switches that fit neither state are then excluded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.special import chdtri

from adcs import quaternion
from arrays.array import SensorArray
from arrays.io.errors import check_positive
from arrays.io.results import Drawn
from arrays.typing import BoolArray, FloatArray
from magloc.levels import SIGMA_OF_MAD
from magloc.localization.fit.results import Fix
from magloc.localization.locator import Locator

WINDOW_S = 8.0
"""Time before and after a switch; over a longer time the ambient field is no parabola."""
_DEGREE, _LEAST_ROWS, _LARGEST_STATE = 2, 6, 1e9
_AMBIENT_T = 30e-6
_PRIOR_T = 100e-6  # prior standard deviation of a component of V and o
LONGEST_LAG_S = 30.0  # largest lag between states and readings that is searched, in both directions
_Fitted = tuple[FloatArray, FloatArray, FloatArray, int]
_FALSE_ALARM, _MISFIT, _UNKNOWN = 1e-6, 2.0, 0.5
_OTHERS = 12  # further unknowns of each magnetometer: its offset, and nine errors of gains and axes


@dataclass(frozen=True)
class StateLag:
    """Time by which the field changes later than the states.

    Attributes
    ----------
    least_rows, most_rows : int
        Bounds in rows; equal unless the lag is between two rows, and 0 if the readings do not determine it.
    step_s : float
        Median time from row to row.
    is_known : bool
        Whether the readings determine it.
    """

    least_rows: int
    most_rows: int
    step_s: float
    is_known: bool

    @property
    def rows(self) -> float:
        """Lag in rows."""
        return 0.5 * (self.least_rows + self.most_rows)

    @property
    def seconds(self) -> float:
        """Lag in seconds; negative where the field changes earlier than the states."""
        return self.rows * self.step_s

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return sentences on an unknown lag, or on one that is corrected."""
        if not self.is_known:
            return (
                "the switches do not tell whether states and readings have the same clock: they are too few, too "
                "alike or too weak; the fields are wrong if the states are a row early or late",
            )
        if self.least_rows == self.most_rows == 0:
            return ()
        least, most = sorted(map(abs, (self.least_rows, self.most_rows)))
        by = f"{most} row{'s' * (most != 1)}" if least == most and self.rows else f"{least} to {most} rows"
        way = "later" if self.rows > 0.0 else "earlier" if self.rows < 0.0 else "earlier or later"
        return (
            f"states and readings do not have the same clock: the field changes {by} ({abs(self.seconds):.3g} s) "
            f"{way} than the states; the fields are corrected for it",
        )

    def delay(self, time_s: FloatArray, s: FloatArray) -> FloatArray:
        """Delay the states (n, K) to the rows at which they act; NaN between the bounds of a change."""
        tolerance = 1e-3 * self.step_s
        first = np.searchsorted(time_s, time_s - self.most_rows * self.step_s + tolerance, side="right") - 1
        last = np.searchsorted(time_s, time_s - self.least_rows * self.step_s - tolerance)
        inside = (first >= 0) & (last < len(s))
        changes = np.concatenate([[0], np.cumsum((np.diff(s, axis=0) != 0.0).any(axis=1))])
        first, last = np.maximum(first, 0), np.minimum(last, len(s) - 1)
        return np.where((inside & (changes[first] == changes[last]))[:, None], s[last], np.nan)


@dataclass(frozen=True, eq=False)
class OwnFields(Drawn):
    """Fields of K loads at the M vector magnetometers of a satellite.

    Attributes
    ----------
    names : tuple of str
        Names of the loads.
    array : SensorArray
        The magnetometers, in body axes.
    vectors_T : ndarray, shape (K, M, 3)
        Field of each load per unit of its state at each magnetometer, body axes.
    sigma_T : ndarray, shape (K, M, 3)
        Standard deviations of these fields.
    switches : ndarray of int, shape (K,)
        Number of changes of each load's state.
    noise_T : ndarray, shape (M,)
        Standard deviation of a component of the regression's residual.
    chi2_per_dof : float
        Mean square of the residuals over the array's stated noise; 1 if the model is right.
    lag : StateLag
        Lag between states and readings, for which the fields are corrected.

    Examples
    --------
    >>> import adcs
    >>> from sims import experiments
    >>> run = experiments.switching_loads(rng=0, duration_s=600.0)
    >>> own = adcs.find_own_fields(run.array, run.readings_T, run.time_s, run.gyro_rad_s, run.states)
    >>> own.names, own.vectors_T.shape
    (('heater', 'radio'), (2, 4, 3))
    """

    figure = "adcs.plots.magnetometers:own_fields_figure"

    names: tuple[str, ...]
    array: SensorArray
    vectors_T: FloatArray
    sigma_T: FloatArray
    switches: NDArray[np.int64]
    noise_T: FloatArray
    chi2_per_dof: float
    lag: StateLag

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return sentences on doubts about the fields, and on corrections."""
        texts = self.lag.warnings
        if self.chi2_per_dof > _MISFIT:
            texts += (
                f"χ² per degree of freedom is {self.chi2_per_dof:.1f}: the noise is larger than stated, or a load is "
                "missing or late in the log; the standard deviations follow the residuals",
            )
        return texts

    def subtracted(
        self, readings_T: ArrayLike, states: Mapping[str, ArrayLike], time_s: ArrayLike | None = None
    ) -> FloatArray:
        """Subtract the fields of the loads from readings.

        Parameters
        ----------
        readings_T : array_like, shape (n, C)
            Readings of the array's channels.
        states : mapping of str to array_like, shape (n,)
            State of each load at each row.
        time_s : array_like, shape (n,), optional
            Times of the rows, used for the lag; by default equal steps.

        Returns
        -------
        ndarray, shape (n, C)
            Corrected readings; NaN where the lag leaves a state open.
        """
        s = _states(states, self.names, len(np.asarray(readings_T)))
        times = np.asarray(self.lag.step_s * np.arange(len(s)) if time_s is None else time_s, dtype=np.float64)
        s = self.lag.delay(times, s)
        fields = np.einsum("nk,kmi->nmi", s, self.vectors_T)
        return np.asarray(readings_T) - self.array.readings_of(fields) + self.array.channel_offset_T

    def located(self) -> dict[str, Fix]:
        """Locate each load as a dipole from its fields at all magnetometers.

        The array's ``noise_fraction`` covers errors of the magnetometers' positions and the extent of the loads.

        Returns
        -------
        dict of str to Fix
            Fix of each load by its name, body axes.

        Raises
        ------
        ValueError
            There are fewer than three magnetometers.
        """
        if self.array.n_sensors < 3:
            raise ValueError(
                f"Input array must have 3 magnetometers to locate a load; instead received {self.array.n_sensors}."
            )
        fixes = {}
        for name, vectors, sigma in zip(self.names, self.vectors_T, self.sigma_T, strict=True):
            noise = np.sqrt(np.mean(sigma**2, axis=1))
            sensors = (replace(one, noise_T=float(s)) for one, s in zip(self.array.sensors, noise, strict=True))
            array = replace(self.array, sensors=tuple(sensors), common_field_T=float(noise.max()), ambient_T=None)
            fixes[name] = Locator(array, exclude_faulty=False).fit(array.readings_of(vectors))
        return fixes


def find_own_fields(
    array: SensorArray,
    readings_T: ArrayLike,
    time_s: ArrayLike,
    gyro_rad_s: ArrayLike,
    states: Mapping[str, ArrayLike],
    *,
    window_s: float = WINDOW_S,
) -> OwnFields:
    r"""Estimate the fields of a satellite's own loads at each magnetometer from the steps of its readings.

    Parameters
    ----------
    array : SensorArray
        Vector magnetometers in body axes; one gives the fields of the loads, three also locate them.
    readings_T : array_like, shape (n, C)
        Readings of the array's channels; NaN where missing.
    time_s : array_like, shape (n,)
        Ascending times.
    gyro_rad_s : array_like, shape (n, 3)
        Rate against inertial space, body axes; a constant bias of some 0.01 °/s does no harm.
    states : mapping of str to array_like, shape (n,)
        State of each load by its name: 0 and 1, a current, or a commanded moment.
    window_s : float
        Time before and after a switch in which the ambient field is a parabola in time.

    Returns
    -------
    OwnFields
        Field of each load per unit of its state, corrected for a lag of up to 30 s between states and readings.

    Raises
    ------
    ValueError
        A shape does not match, the array has a scalar sensor, or a load never switches without others.

    Examples
    --------
    >>> import adcs
    >>> from sims import experiments
    >>> run = experiments.switching_loads(rng=0, duration_s=600.0)
    >>> own = adcs.find_own_fields(run.array, run.readings_T, run.time_s, run.gyro_rad_s, run.states)
    >>> bool(own.sigma_T.max() < 15e-9)
    True
    """
    check_positive(window_s=window_s)
    times = np.asarray(time_s, dtype=np.float64)
    n = len(times)
    if times.ndim != 1 or n < 2 or not (np.diff(times) > 0.0).all():
        raise ValueError("Input time_s must ascend and have at least two instants; instead it does not.")
    readings, gyro = np.asarray(readings_T, dtype=np.float64), np.asarray(gyro_rad_s, dtype=np.float64)
    if array.channel_is_scalar.any():
        raise ValueError("Input array must have vector magnetometers only; instead received a scalar one.")
    for name, values, shape in (("readings_T", readings, (n, array.n_channels)), ("gyro_rad_s", gyro, (n, 3))):
        if values.shape != shape:
            raise ValueError(f"Input {name} must have shape {shape}; instead received {values.shape}.")
    names = tuple(states)
    s = _states(states, names, n)
    fields = array.calibrated_field(readings)
    used: BoolArray = np.isfinite(np.concatenate([readings, gyro], axis=1)).all(axis=1)
    turns = _turns(times, gyro)
    whole = _whole_lag(times, fields, turns, s)
    lag, fit = _lag_between_rows(whole, lambda lag: _fit(times, lag.delay(times, s), fields, used, turns, window_s))
    vectors, deviations, noise, _ = fit
    for name, deviation in zip(names, deviations, strict=True):
        if deviation.max() > _UNKNOWN * _PRIOR_T:
            raise ValueError(
                "Input states must have switches of each load apart from those of others; instead received "
                f"{name}, whose field the readings do not determine."
            )
    switches = np.sum(np.diff(s, axis=0) != 0.0, axis=0)
    stated = np.mean(array.channel_noise_T.reshape(-1, 3) ** 2, axis=1)
    return OwnFields(names, array, vectors, deviations, switches, noise, float(np.mean(noise**2 / stated)), lag)


def _fit(
    times: FloatArray, s: FloatArray, fields: FloatArray, used: BoolArray, turns: FloatArray, window_s: float
) -> _Fitted:
    """Fit fields, deviations, noise and degrees of freedom by all switches of states (n, K)."""
    known = np.flatnonzero(np.isfinite(s).all(axis=1))
    windows = [known[rows] for rows in _windows(times[known], s[known], used[known], window_s)]
    if 3 * sum(len(rows) - _DEGREE - 1 for rows in windows) <= 3 * s.shape[1] + _OTHERS:
        raise ValueError(
            f"Input states must change where there are readings; instead received {len(windows)} switches."
        )
    D = [_attitudes(turns, rows) for rows in windows]
    fitted = np.zeros((s.shape[1], fields.shape[1], 3)), np.zeros(0), np.zeros(0), 0
    for _ in range(2):
        # The second round removes the steps: errors of the gains would absorb a hundredth of them.
        ambient = np.mean(fields - np.einsum("nk,kmi->nmi", s, fitted[0]), axis=1)
        fitted = _regression(
            [_project_ambient(times[i], R, s[i], fields[i], ambient[i]) for i, R in zip(windows, D, strict=True)],
            s.shape[1],
        )
    return fitted


@np.errstate(over="ignore", invalid="ignore")
def _whole_lag(times: FloatArray, fields: FloatArray, turns: FloatArray, s: FloatArray) -> StateLag:
    """Return the lag in whole rows for which switches best explain the jumps between two rows."""
    steps, changes = np.diff(times), np.diff(s / np.maximum(np.abs(s).max(axis=0), np.finfo(float).tiny), axis=0)
    step_s, switches = float(np.median(steps)), np.flatnonzero((changes != 0.0).any(axis=1))
    jumps = np.einsum("nij,nmj->nmi", quaternion.matrix(turns[1:]), fields[1:]) - fields[:-1]
    # Subtract the mean slope before and after, and divide by the deviation.
    slopes = (jumps[:-2] + jumps[2:]) / (steps[:-2] + steps[2:])[:, None, None]
    jumps = (jumps[1:-1] - steps[1:-1, None, None] * slopes).reshape(len(slopes), 3 * fields.shape[1])
    jumps = jumps[:, np.isfinite(jumps).any(axis=0)]
    if not jumps.size:
        return StateLag(0, 0, step_s, is_known=False)
    jumps /= np.maximum(SIGMA_OF_MAD * np.nanmedian(np.abs(jumps), axis=0), 1e-12)
    longest = int(min(LONGEST_LAG_S / step_s, len(times)))
    lags = np.arange(-longest, longest + 1)
    explained = np.zeros(len(lags))
    for place, lag in enumerate(lags):
        rows = np.searchsorted(times, 0.5 * (times[switches] + times[switches + 1]) + lag * step_s) - 2
        there = (rows >= 0) & (rows < len(jumps))
        there[there] = np.isfinite(jumps[rows[there]]).all(axis=1)
        A, y = changes[switches[there]], jumps[rows[there]]
        across = A.T @ y
        explained[place] = np.sum(across * (np.linalg.pinv(A.T @ A) @ across))
    limit = chdtri(jumps.shape[1] * s.shape[1], _FALSE_ALARM / len(lags))
    alike = lags[explained >= explained.max(initial=0.0) - limit]
    best = 0 if not alike.size or 0 in alike else int(lags[np.argmax(explained)])
    is_known = bool(explained.max(initial=0.0) > limit and (np.abs(alike - best) <= 1).all())
    return StateLag(best if is_known else 0, best if is_known else 0, step_s, is_known)


def _lag_between_rows(whole: StateLag, fit: Callable[[StateLag], _Fitted]) -> tuple[StateLag, _Fitted]:
    """Return the narrowest bounds of the lag that fit the rows next to the switches, and their fit."""
    first = fit(whole)
    if not whole.is_known:
        return whole, first
    wide = replace(whole, least_rows=whole.least_rows - 1, most_rows=whole.most_rows + 1)
    try:
        without = fit(wide)
    except ValueError:
        return whole, first
    for lag in (whole, replace(whole, least_rows=wide.least_rows), replace(whole, most_rows=wide.most_rows)):
        fitted = first if lag is whole else fit(lag)
        numbers = len(fitted[2]) * max(fitted[3] - without[3], 1)
        if np.sum((fitted[3] * fitted[2] ** 2) / without[2] ** 2 - without[3]) <= chdtri(numbers, _FALSE_ALARM):
            return lag, fitted
    return wide, without


def _states(states: Mapping[str, ArrayLike], names: tuple[str, ...], n: int) -> FloatArray:
    """Return the states (n, K) of the loads."""
    if not names or set(names) - set(states):
        raise ValueError(
            f"Input states must have {', '.join(names) or 'a load'}; instead received {', '.join(states)}."
        )
    each = [np.asarray(states[name], dtype=np.float64) for name in names]
    for name, values in zip(names, each, strict=True):
        if values.shape != (n,) or not (np.abs(values) <= _LARGEST_STATE).all():
            raise ValueError(
                f"Input states must be within ±{_LARGEST_STATE:g} with shape ({n},); instead received {name} with "
                f"shape {values.shape} and up to {np.abs(values).max():g}. Leave dummy values empty."
            )
    return np.stack(each, axis=1)


def _windows(time_s: FloatArray, s: FloatArray, used: BoolArray, window_s: float) -> list[NDArray[np.intp]]:
    """Return the rows of each switch: within the window, and nearest to this switch."""
    switches = np.flatnonzero((np.diff(s, axis=0) != 0.0).any(axis=1))
    if not switches.size:
        return []
    at = 0.5 * (time_s[switches] + time_s[switches + 1])
    nearest = np.searchsorted(0.5 * (at[:-1] + at[1:]), time_s)
    rows = np.flatnonzero(used & (np.abs(time_s - at[nearest]) <= window_s))
    of_switches = np.split(rows, np.searchsorted(nearest[rows], np.arange(1, len(at))))
    return [of_switch for of_switch in of_switches if len(of_switch) >= _LEAST_ROWS]


def _turns(time_s: FloatArray, gyro_rad_s: FloatArray) -> FloatArray:
    """Return the rotations (n, 4) of the steps to each instant, by a spline of the rates with coning."""
    read = np.isfinite(gyro_rad_s).all(axis=1)
    if read.sum() < 2:
        raise ValueError(f"Input gyro_rad_s must have two readings at least; instead received {read.sum()}.")
    spline = CubicSpline(time_s[read], gyro_rad_s[read])
    angles, rates, steps = np.diff(spline.antiderivative()(time_s), axis=0), spline(time_s), np.diff(time_s)
    angles += np.cross(rates[:-1], rates[1:]) * steps[:, None] ** 2 / 12.0
    return np.concatenate([[quaternion.IDENTITY], quaternion.exp(angles)])


def _attitudes(turns: FloatArray, rows: NDArray[np.intp]) -> FloatArray:
    """Return attitudes (len(rows), 3, 3) relative to the first row, from the rotations (n, 4) of steps."""
    q = [quaternion.IDENTITY]
    for turn in turns[rows[0] + 1 : rows[-1] + 1]:
        q.append(quaternion.multiply(q[-1], turn))
    return quaternion.matrix(np.array(q)[rows - rows[0]])


def _project_ambient(
    time_s: FloatArray, D: FloatArray, s: FloatArray, fields: FloatArray, ambient: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Project the parabola in time out of design (3n, 3K + 12) and fields (3n, M) of a window.

    ``ambient`` (n, 3): approximate ambient field, for the columns of errors of gains and axes.
    """
    n = len(time_s)
    regressors = np.concatenate([s, np.ones((n, 1))], axis=1)
    turned = np.einsum("nij,nmj->nim", D, fields)
    polynomial, _ = np.linalg.qr(np.vander((time_s - time_s.mean()) / np.ptp(time_s), _DEGREE + 1))
    smooth = polynomial @ (polynomial.T @ np.einsum("nij,nj->ni", D, ambient))
    by_gain = np.einsum("nij,nk->nijk", D, np.einsum("nij,ni->nj", D, smooth / _AMBIENT_T))
    design = np.concatenate(
        [np.einsum("nij,nk->nikj", D, regressors).reshape(n, 3, -1), by_gain.reshape(n, 3, 9)], axis=2
    )
    without = np.eye(n) - polynomial @ polynomial.T
    A, y = (np.einsum("np,pij->nij", without, one).reshape(3 * n, -1) for one in (design, turned))
    return A, y


def _inverse(normal: FloatArray) -> FloatArray:
    """Return the positive definite inverse of a normal matrix, robust to rounding of small eigenvalues."""
    scale = 1.0 / np.sqrt(np.diagonal(normal))
    values, vectors = np.linalg.eigh(scale[:, None] * normal * scale)
    root = scale[:, None] * vectors / np.sqrt(np.maximum(values, np.finfo(float).eps * values[-1]))
    return np.asarray(root @ root.T)


def _regression(windows: Sequence[tuple[FloatArray, FloatArray]], loads: int) -> _Fitted:
    """Solve M least squares of one design with a weak prior.

    Returns fields (K, M, 3), deviations, noise (M,) and degrees of freedom.
    """
    A, y = (np.concatenate(parts) for parts in zip(*windows, strict=True))
    dof = len(A) - 3 * (_DEGREE + 1) * len(windows) - A.shape[1]
    normal = A.T @ A
    # The weight of the prior depends on the noise, which the first round estimates.
    noise = np.full(y.shape[1], np.sqrt(np.mean(y**2)))
    for _ in range(2):
        inverse = [_inverse(normal + np.eye(len(normal)) * (one / _PRIOR_T) ** 2) for one in noise]
        x = np.stack([of_one @ (A.T @ column) for of_one, column in zip(inverse, y.T, strict=True)], axis=1)
        noise = np.sqrt(np.sum((y - A @ x) ** 2, axis=0) / dof)
    sigma = np.stack([one * np.sqrt(np.diagonal(of_one)) for one, of_one in zip(noise, inverse, strict=True)], axis=1)
    fields, deviations = (v[: 3 * loads].reshape(loads, 3, -1).transpose(0, 2, 1) for v in (x, sigma))
    return fields, deviations, noise, dof
