"""Error-state Kalman filter of the table-top satellite with delayed camera fixes.

See docs/theory/tabletop-navigation.md.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from adcs.mockup.navigation.fixes import FixOutcome, PlanarFix
from adcs.mockup.navigation.strapdown import Gate, ImuRecord, PlanarState, PlanarTrack, hold, rotate, wrapped
from arrays.typing import FloatArray
from magloc.state_space import symmetric_square_root, update

STATES = (
    *("X_m", "Y_m", "vX_m_s", "vY_m_s", "heading_rad"),
    *("zero_x_m_s2", "zero_y_m_s2", "zero_rate_rad_s", "drift_x_m_s3", "drift_y_m_s3"),
)
N = len(STATES)
H_FIX: FloatArray = np.eye(N)[[0, 1, 4]]


@dataclass(frozen=True)
class DelayedFilterSettings:
    """Noise and limits of :class:`DelayedFilter`, all positive.

    Attributes
    ----------
    sample_s : float
        Interval of the samples for which the next two numbers hold.
    acceleration_m_s2 : float
        Noise of a sample, each axis: 0.002 of the sensor, and spikes of ±0.07 by the valves about once in a second.
    rate_rad_s : float
        Noise of a sample of the gyro.
    missing_acceleration_m_s2, missing_rate_rad_s : float
        Standard deviations of the true values in a sample that fails the gate.
    lost_after_s : float
        Time after which missing readings are lost: then the unknown motion lasts and is no white noise.
    lost_m_s_rs, lost_rad_rs : float
        Growth of the standard deviations of velocity and heading in one second without readings [unit per √s]: thrust
        of 0.04 m/s² and rates of 20°/s that last for a second or two.
    zero_walk_m_s2_rs, zero_walk_rad_s_rs : float
        Growth of the zeros' standard deviations in one second [unit per √s].
    drift_walk_m_s3_rs : float
        Growth of the drifts' standard deviations in one second: 7e-6 m/s³ in 200 s, for a sensor that warms up within
        minutes. If it warms up within one minute, errors of zeros and drifts are 1.1 and 1.4 standard deviations.
    fix_m, fix_rad : float
        Noise of a fix that does not state its own, each axis.
    fix_gate : float
        Largest normalised innovation squared of a fix, χ² with 3 degrees of freedom: 25 rejects one good fix in 65,000.
    reacquire_after : int
        Number of consecutive rejected fixes that replace the estimate if they agree with each other.
    buffer_s : float
        Largest age of a fix.
    sample_gate : Gate
        Limits of the samples.
    """

    sample_s: float = 0.01
    acceleration_m_s2: float = math.hypot(0.002, 0.0035)
    rate_rad_s: float = math.radians(0.1)
    missing_acceleration_m_s2: float = 0.1
    missing_rate_rad_s: float = math.radians(20.0)
    lost_after_s: float = 0.05
    lost_m_s_rs: float = 0.03
    lost_rad_rs: float = math.radians(30.0)
    zero_walk_m_s2_rs: float = 2e-5
    zero_walk_rad_s_rs: float = math.radians(0.002)
    drift_walk_m_s3_rs: float = 5e-7
    fix_m: float = 1.5e-3
    fix_rad: float = math.radians(0.1)
    fix_gate: float = 25.0
    reacquire_after: int = 3
    buffer_s: float = 10.0
    sample_gate: Gate = Gate()  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "sample_gate" and not value > 0.0:
                raise ValueError(f"Input {name} must be positive; instead received {value}.")

    @property
    def densities(self) -> FloatArray:
        """Noise densities, shape (7,): acceleration, rate, both if missing, walks of zeros and drifts."""
        white = np.array(
            [self.acceleration_m_s2, self.rate_rad_s, self.missing_acceleration_m_s2, self.missing_rate_rad_s]
        )
        walks = np.array([self.zero_walk_m_s2_rs, self.zero_walk_rad_s_rs, self.drift_walk_m_s3_rs])
        return np.concatenate([self.sample_s * white**2, walks**2])

    @property
    def all_densities(self) -> FloatArray:
        """Noise densities, shape (2, 2, 7), without and with loss of accelerations and of the rate."""
        densities = np.tile(self.densities, (2, 2, 1))
        densities[1, :, 2], densities[:, 1, 3] = self.lost_m_s_rs**2, self.lost_rad_rs**2
        return densities


@dataclass(frozen=True)
class StartSigma:
    """Initial standard deviations per axis.

    The accelerometer's zeros drift by up to 0.0003 m/s² per °C; 2e-5 m/s³ is the drift at 4 °C per minute.
    """

    position_m: float = 1.5e-3
    velocity_m_s: float = 0.01
    heading_rad: float = math.radians(0.1)
    zero_m_s2: float = 0.002
    zero_rad_s: float = math.radians(0.05)
    drift_m_s3: float = 2e-5

    @property
    def covariance(self) -> FloatArray:
        """Diagonal covariance, shape (10, 10)."""
        p, v, z, d = self.position_m, self.velocity_m_s, self.zero_m_s2, self.drift_m_s3
        return np.diag(np.square([p, p, v, v, self.heading_rad, z, z, self.zero_rad_s, d, d]))


LOST = StartSigma(position_m=10.0, velocity_m_s=0.5, heading_rad=math.pi)
"""Initial deviations of position, velocity and heading of a second hypothesis, before its first fix."""


@dataclass(frozen=True, eq=False)
class FilterTrack(PlanarTrack):
    """Estimates at each sample with the data available then, with all states.

    Attributes
    ----------
    zero_m_s2 : ndarray, shape (n, 2)
        Zeros of the accelerometer.
    zero_rad_s : ndarray, shape (n,)
        Zero of the gyro.
    drift_m_s3 : ndarray, shape (n, 2)
        Drifts of the accelerometer's zeros.
    sigma : ndarray, shape (n, 10)
        Standard deviations of the states in the order of :data:`STATES`.
    """

    zero_m_s2: FloatArray
    zero_rad_s: FloatArray
    drift_m_s3: FloatArray
    sigma: FloatArray


def predict(
    x: FloatArray, P: FloatArray, steps_s: ArrayLike, readings: ArrayLike, there: ArrayLike, densities: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return state and covariance after each of some samples, :math:`F P F^T + Q`.

    Shapes ``x`` (10,), ``P`` (10, 10) -> (n, 10), (n, 10, 10). ``steps_s`` (n,). ``readings`` (n, 3): accelerations
    along body x and y, and the rate. ``there`` (n, 3): mask of accepted readings. A rejected acceleration is replaced
    by zero, a rejected rate is used as given. ``densities`` (7,): see :attr:`DelayedFilterSettings.densities`.
    """
    h, z, use = np.asarray(steps_s), np.asarray(readings, dtype=np.float64), np.asarray(there, dtype=np.bool_)
    # The gyro's zero and the drifts are constant, so headings, zeros, velocities and positions are cumulative sums.
    states = np.tile(x, (len(h), 1))
    turn, passed = h * (z[:, 2] - x[7]), np.cumsum(h)
    states[:, 4] += np.cumsum(turn)
    states[:, 5:7] += passed[:, None] * x[8:10]
    middle = states[:, 4] - 0.5 * turn
    a = rotate(middle, use[:, :2] * (z[:, :2] - x[5:7] - (passed - h)[:, None] * x[8:10]))
    change = h[:, None] * a
    states[:, 2:4] += np.cumsum(change, axis=0)
    states[:, 0:2] += np.cumsum(h[:, None] * (states[:, 2:4] - 0.5 * change), axis=0)

    c, s = np.cos(middle), np.sin(middle)
    to_table = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
    by_heading = np.stack([-a[:, 1], a[:, 0]], axis=1)[:, :, None]
    da = np.concatenate(  # by φ, α, β, b
        [by_heading, -to_table * use[:, None, :2], -0.5 * h[:, None, None] * by_heading], axis=2
    )
    F = np.tile(np.eye(N), (len(h), 1, 1))
    F[:, [0, 1, 5, 6], [2, 3, 8, 9]] = h[:, None]
    F[:, 4, 7] = -h
    F[:, 2:4, 4:8] = h[:, None, None] * da
    F[:, 0:2, 4:8] = 0.5 * h[:, None, None] * F[:, 2:4, 4:8]

    q = to_table * np.where(use[:, None, :2], densities[0], densities[2]) @ to_table.mT
    h1, h2, h3 = h[:, None, None], h[:, None, None] ** 2 / 2.0, h[:, None, None] ** 3 / 3.0
    Q = np.zeros((len(h), N, N))
    Q[:, 0:2, 0:2], Q[:, 2:4, 2:4] = h3 * q, h1 * q
    Q[:, 0:2, 2:4] = Q[:, 2:4, 0:2] = h2 * q
    Q[:, 4, 4], Q[:, 7, 7] = h * np.where(use[:, 2], densities[1], densities[3]), h * densities[5]
    Q[:, [5, 6], [5, 6]] = h1[:, 0] * densities[4] + h3[:, 0] * densities[6]
    Q[:, [5, 6, 8, 9], [8, 9, 5, 6]] = h2[:, 0] * densities[6]
    Q[:, [8, 9], [8, 9]] = h1[:, 0] * densities[6]
    covariances = np.empty_like(Q)
    for after, transition, transposed, noise in zip(covariances, F, np.ascontiguousarray(F.mT), Q, strict=True):
        P = np.dot(transition.dot(P), transposed, out=after)
        P += noise
    return states, 0.5 * (covariances + covariances.mT)


@dataclass(eq=False)
class _Taken:
    """Fix in the history and its outcome."""

    fix: PlanarFix
    outcome: FixOutcome


class DelayedFilter:
    """Online filter of samples and delayed fixes.

    - A fix with the exposure of another one is ignored (duplicate), also a fix older than ``buffer_s``.
    - Without fixes the covariance grows by the noise of the samples, and the gate widens with it.
    - A rejected rate is replaced by the last accepted one, a rejected acceleration by zero. Both have a larger noise,
      and a still larger one if readings are lost.
    - :meth:`adcs.mockup.navigation.strapdown.ImuRecord.fill_gaps` must fill gaps between samples by missing readings.

    Parameters
    ----------
    start : PlanarState
        State at ``begin_s``.
    begin_s : float
        Beginning of the first sample.
    settings : DelayedFilterSettings
        Noise and limits.
    sigma : StartSigma
        Standard deviations of the start; zeros and drifts start at 0.

    Attributes
    ----------
    x, P : ndarray, shape (10,), (10, 10)
        Estimate and covariance at the last sample; ``state`` is the estimate without zeros and drifts.
    nis : list of float
        Normalised innovation squared of each usable fix at its arrival.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> method = mockup.DelayedFilter(run.start, run.imu.begin_s)
    >>> len(mockup.fuse(method, run.imu, run.fixes).track)
    500
    """

    def __init__(
        self,
        start: PlanarState,
        begin_s: float,
        settings: DelayedFilterSettings = DelayedFilterSettings(),
        sigma: StartSigma = StartSigma(),
    ) -> None:
        self.settings = settings
        self.nis: list[float] = []
        self._densities = settings.all_densities
        self._n = 1
        # Row 0 is the beginning of the history; the reading of a row belongs to the interval that ends there.
        self._time_s = np.full(1, float(begin_s))
        self._readings, self._there = np.zeros((1, 3)), np.zeros((1, 3), dtype=np.bool_)
        self._lost = np.zeros((1, 2), dtype=np.bool_)  # accelerations, rate
        self._read_s = np.full(3, float(begin_s))  # time of the last accepted reading
        self._x = np.concatenate([start.position_m, start.velocity_m_s, [float(start.heading_rad)], np.zeros(5)])[None]
        self._P = sigma.covariance[None]
        self._history: list[_Taken] = []

    @property
    def x(self) -> FloatArray:
        """Estimated state."""
        return self._x[self._n - 1].copy()

    @property
    def P(self) -> FloatArray:
        """Covariance of the estimated state."""
        return self._P[self._n - 1].copy()

    @property
    def state(self) -> PlanarState:
        """Estimated position, velocity and heading."""
        x = self.x
        return PlanarState(x[0:2], x[2:4], float(x[4]))

    def add_samples(self, imu: ImuRecord) -> FilterTrack:
        """Predict over some samples.

        Parameters
        ----------
        imu : ImuRecord
            Samples of one run, which begin at the end of the last ones.

        Returns
        -------
        FilterTrack
            Estimate at the end of each sample.

        Raises
        ------
        ValueError
            The samples begin elsewhere.
        """
        last, n = self._n - 1, len(imu)
        if imu.begin_s != self._time_s[last]:
            raise ValueError(
                f"Input imu must begin where the last samples ended, at {self._time_s[last]:.6g} s; "
                f"instead received samples that begin at {imu.begin_s:.6g} s."
            )
        there = self.settings.sample_gate.accept(imu)
        believed = hold(imu, there, self._readings[last, 2])
        self._make_room(n)
        last = self._n - 1
        rows = slice(self._n, self._n + n)
        self._time_s[rows], self._there[rows] = imu.time_s, there
        self._readings[rows, :2], self._readings[rows, 2] = believed.acceleration_m_s2, believed.rate_rad_s
        read_s = np.maximum.accumulate(
            np.concatenate([self._read_s[None], np.where(there, imu.time_s[:, None], -math.inf)]), axis=0
        )
        lost = imu.time_s[:, None] - read_s[1:] > self.settings.lost_after_s
        self._lost[rows], self._read_s = np.stack([lost[:, :2].any(axis=1), lost[:, 2]], axis=1), read_s[-1]
        self._n += n
        self._predict(last, self._n - 1)
        x, P = self._x[rows], self._P[rows]
        sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        position, velocity, heading, zeros, rate_zero, drifts = (
            x[:, k].copy() for k in (slice(0, 2), slice(2, 4), 4, slice(5, 7), 7, slice(8, 10))
        )
        return FilterTrack(imu.time_s, position, velocity, heading, zeros, rate_zero, drifts, sigma)

    def add_fix(self, fix: PlanarFix) -> FixOutcome:
        """Update the estimate at the exposure of a fix, and predict again to the present.

        Parameters
        ----------
        fix : PlanarFix
            Fix that arrives.

        Returns
        -------
        FixOutcome
            Outcome; later fixes may change it in the history.
        """
        now = float(self._time_s[self._n - 1])
        if fix.time_s > now:
            return FixOutcome.AHEAD
        if any(fix.time_s == taken.fix.time_s for taken in self._history):
            return FixOutcome.DUPLICATE
        if fix.time_s < now - self.settings.buffer_s or fix.time_s <= self._time_s[0]:
            return FixOutcome.TOO_OLD
        row = self._row_at(fix.time_s) - 1
        taken = _Taken(fix, FixOutcome.USED)
        place = bisect_left(self._history, fix.time_s, key=lambda entry: entry.fix.time_s)
        self._history.insert(place, taken)
        for later in range(place, len(self._history)):
            k = self._row_at(self._history[later].fix.time_s)
            self._predict(row, k)
            nis = self._correct(k, later)
            if later == place:
                self.nis.append(nis)
            row = k
        self._predict(row, self._n - 1)
        return taken.outcome

    def _correct(self, row: int, place: int) -> float:
        """Update the estimate of a row by a fix of the history, or reject it; return its NIS."""
        taken = self._history[place]
        x, P, nis = self._with_fix(self._x[row], self._P[row], taken.fix)
        taken.outcome = FixOutcome.USED
        if not nis <= self.settings.fix_gate:
            second = self._second(place)
            taken.outcome = FixOutcome.REJECTED if second is None else FixOutcome.REACQUIRED
            if second is None:
                return nis
            x, P = second
        self._x[row], self._P[row] = x, P
        return nis

    def _with_fix(self, x: FloatArray, P: FloatArray, fix: PlanarFix) -> tuple[FloatArray, FloatArray, float]:
        """Return estimate and covariance updated by a fix, and its NIS."""
        s = self.settings
        innovation = np.append(fix.position_m - x[0:2], wrapped(fix.heading_rad - x[4]))
        sigma = np.array([s.fix_m, s.fix_m, s.fix_rad] if fix.sigma is None else fix.sigma)
        x, S, nis = update(x, symmetric_square_root(P), H_FIX / sigma[:, None], innovation / sigma)
        return x, S @ S.T, nis

    def _second(self, place: int) -> tuple[FloatArray, FloatArray] | None:
        """Return the second hypothesis, from the last rejected fixes, if it accepts all of them; else None.

        It is computed on demand, because late fixes change the order of the rejected ones.
        """
        first = place - self.settings.reacquire_after + 1
        rejected = self._history[max(first, 0) : place]
        if first < 0 or any(entry.outcome is not FixOutcome.REJECTED for entry in rejected):
            return None
        row = self._row_at(self._history[first].fix.time_s)
        P = LOST.covariance
        P[5:, 5:] = self._P[row, 5:, 5:]
        x, P, _ = self._with_fix(self._x[row], P, self._history[first].fix)
        for taken in self._history[first + 1 : place + 1]:
            later = self._row_at(taken.fix.time_s)
            rows_x, rows_P = np.empty((later - row + 1, N)), np.empty((later - row + 1, N, N))
            rows_x[0], rows_P[0] = x, P
            self._predict(row, later, rows_x, rows_P)
            x, P, nis = self._with_fix(rows_x[-1], rows_P[-1], taken.fix)
            if not nis <= self.settings.fix_gate:
                return None
            row = later
        return x, P

    def _predict(self, first: int, last: int, x: FloatArray | None = None, P: FloatArray | None = None) -> None:
        """Predict rows from the estimate, or from another state in the first row, with noise of lost readings."""
        rows = slice(first, last + 1)
        x, P = self._x[rows] if x is None else x, self._P[rows] if P is None else P
        lost = self._lost[first + 1 : last + 1]
        changes = 1 + np.flatnonzero((lost[1:] != lost[:-1]).any(axis=1))
        steps, readings, there = np.diff(self._time_s[rows]), self._readings[rows][1:], self._there[rows][1:]
        for begin, end in pairwise([0, *changes.tolist(), last - first]):
            densities = self._densities[*self._lost[first + end].astype(np.intp)]
            part, after = slice(begin, end), slice(begin + 1, end + 1)
            x[after], P[after] = predict(x[begin], P[begin], steps[part], readings[part], there[part], densities)

    def _row_at(self, time_s: float) -> int:
        """Return the row of an instant; split the interval that contains it."""
        row = int(np.searchsorted(self._time_s[: self._n], time_s))
        if self._time_s[row] == time_s:
            return row
        self._make_room(1)
        row = int(np.searchsorted(self._time_s[: self._n], time_s))
        for values in (self._time_s, self._readings, self._there, self._lost, self._x, self._P):
            values[row + 1 : self._n + 1] = values[row : self._n].copy()
        self._time_s[row] = time_s
        self._n += 1
        return row

    def _make_room(self, rows: int) -> None:
        """Make room for more rows: drop those older than the buffer, or extend the arrays."""
        if self._n + rows <= len(self._time_s):
            return
        horizon = self._time_s[self._n - 1] - self.settings.buffer_s
        first = max(0, int(np.searchsorted(self._time_s[: self._n], horizon)) - 1)
        kept = self._n - first
        capacity = max(256, 2 * (kept + rows))
        for name in ("_time_s", "_readings", "_there", "_lost", "_x", "_P"):
            old = getattr(self, name)
            new = np.zeros((capacity, *old.shape[1:]), dtype=old.dtype)
            new[:kept] = old[first : self._n]
            setattr(self, name, new)
        self._n = kept
        forgotten = bisect_right(self._history, self._time_s[0], key=lambda entry: entry.fix.time_s)
        del self._history[:forgotten]
