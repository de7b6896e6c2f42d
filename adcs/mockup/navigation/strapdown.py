"""Planar inertial navigation on the table: samples of the IMU, gate and integration.

See docs/theory/tabletop-navigation.md. Source: Bindel, Ivanov, Nuzhdin, Ovchinnikov, Trofimov, preprint of the Keldysh
Institute on the table-top mock-up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import BoolArray, FloatArray

GAP_STEPS = 5.0
"""Length of a gap in median intervals of a record: longer intervals are gaps."""


def rotate(heading_rad: ArrayLike, vector_body: ArrayLike) -> FloatArray:
    """Rotate a vector to table axes, ``R(φ) v``.

    Shapes ``vector_body`` (..., 2) -> (..., 2). ``heading_rad`` (...): counter-clockwise from above.
    """
    phi, vector = np.asarray(heading_rad, dtype=np.float64), np.asarray(vector_body, dtype=np.float64)
    c, s, x, y = np.cos(phi), np.sin(phi), vector[..., 0], vector[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def wrapped(angle_rad: ArrayLike) -> FloatArray:
    """Return an angle in (-π, π], any shape.

    Parameters
    ----------
    angle_rad : array_like, any shape
        Angle of any number of turns.

    Returns
    -------
    ndarray, same shape
        The same angle within half a turn of zero [rad].

    Examples
    --------
    >>> from adcs import mockup
    >>> mockup.wrapped([0.0, 4.0]).round(3)
    array([ 0.   , -2.283])
    """
    return math.pi - np.mod(math.pi - np.asarray(angle_rad, dtype=np.float64), 2.0 * math.pi)


@dataclass(frozen=True, eq=False)
class ImuRecord:
    """Samples of the IMU in body axes, of one run or, with leading axes, of several with the same time stamps.

    Attributes
    ----------
    begin_s : float
        Beginning of the first sample's interval.
    time_s : ndarray, shape (n,)
        End of each sample's interval; n may be 0.
    acceleration_m_s2 : ndarray, shape (..., n, 2)
        Acceleration along body x and y, NaN where missing.
    rate_rad_s : ndarray, shape (..., n)
        Rate of the heading, NaN where missing.

    Raises
    ------
    ValueError
        The shapes do not match, or the time stamps do not increase.
    """

    begin_s: float
    time_s: FloatArray
    acceleration_m_s2: FloatArray
    rate_rad_s: FloatArray

    def __post_init__(self) -> None:
        for name in ("time_s", "acceleration_m_s2", "rate_rad_s"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        if self.time_s.ndim != 1:
            raise ValueError(f"Input time_s must have shape (n,); instead received {self.time_s.shape}.")
        n = self.time_s.size
        if self.rate_rad_s.shape[-1:] != (n,):
            raise ValueError(f"Input rate_rad_s must have shape (..., {n}); instead received {self.rate_rad_s.shape}.")
        if self.acceleration_m_s2.shape != (*self.rate_rad_s.shape, 2):
            raise ValueError(
                f"Input acceleration_m_s2 must have shape {(*self.rate_rad_s.shape, 2)}; "
                f"instead received {self.acceleration_m_s2.shape}."
            )
        back = np.flatnonzero(~(self.steps_s > 0.0))
        if back.size:
            before = self.begin_s if back[0] == 0 else self.time_s[back[0] - 1]
            raise ValueError(
                "Input time_s must increase from sample to sample; "
                f"instead received {self.time_s[back[0]]:.6g} s after {before:.6g} s (sample {back[0]})."
            )

    def __len__(self) -> int:
        """Return the number of samples."""
        return self.time_s.size

    @property
    def end_s(self) -> float:
        """End of the last interval."""
        return float(self.time_s[-1]) if len(self) else self.begin_s

    @property
    def steps_s(self) -> FloatArray:
        """Length of each interval, shape (n,)."""
        return np.diff(self.time_s, prepend=self.begin_s)

    @property
    def usual_step_s(self) -> float:
        """Median length of the intervals of a record with samples."""
        return float(np.median(self.steps_s))

    @property
    def gaps_s(self) -> FloatArray:
        """Begin and end of the gaps, shape (k, 2): from the last sample to the interval of the next one.

        A gap is longer than :data:`GAP_STEPS` median intervals. The sample after it is the mean over one median
        interval.
        """
        if not len(self):
            return np.empty((0, 2))
        steps_s, usual_s = self.steps_s, self.usual_step_s
        long = np.flatnonzero(steps_s > GAP_STEPS * usual_s)
        return np.stack([self.time_s[long] - steps_s[long], self.time_s[long] - usual_s], axis=1)

    def fill_gaps(self) -> ImuRecord:
        """Fill gaps by samples with missing readings, so that all steps are short."""
        gaps = self.gaps_s
        if not len(gaps):
            return self
        counts = np.ceil((gaps[:, 1] - gaps[:, 0]) / self.usual_step_s - 1e-6).astype(np.intp)
        times = [np.linspace(gap[0], gap[1], count + 1)[1:] for gap, count in zip(gaps, counts, strict=True)]
        rows = np.repeat(np.searchsorted(self.time_s, gaps[:, 1]), counts)
        return ImuRecord(
            self.begin_s,
            np.insert(self.time_s, rows, np.concatenate(times)),
            np.insert(self.acceleration_m_s2, rows, np.nan, axis=-2),
            np.insert(self.rate_rad_s, rows, np.nan, axis=-1),
        )

    def between(self, first_s: float, last_s: float) -> ImuRecord:
        """Return the samples between two instants, with the first and the last interval shortened.

        Returns
        -------
        ImuRecord
            Record that ends at ``last_s``; without samples if both instants are the same.

        Raises
        ------
        ValueError
            The record does not cover that time.
        """
        if not self.begin_s <= first_s <= last_s <= self.end_s:
            raise ValueError(
                f"Input first_s and last_s must be in order within {self.begin_s:.6g} to {self.end_s:.6g} s; "
                f"instead received {first_s:.6g} and {last_s:.6g} s."
            )
        if first_s == last_s:
            return ImuRecord(first_s, np.empty(0), self.acceleration_m_s2[..., :0, :], self.rate_rad_s[..., :0])
        first = int(np.searchsorted(self.time_s, first_s, side="right"))
        rows = slice(first, int(np.searchsorted(self.time_s, last_s, side="left")) + 1)
        time_s = self.time_s[rows].copy()
        time_s[-1] = last_s
        return ImuRecord(first_s, time_s, self.acceleration_m_s2[..., rows, :], self.rate_rad_s[..., rows])

    def part(self, first: int, last: int) -> ImuRecord:
        """Return the samples from ``first`` to ``last``, exclusive."""
        begin_s = self.begin_s if first == 0 else float(self.time_s[first - 1])
        rows = slice(first, last)
        return ImuRecord(begin_s, self.time_s[rows], self.acceleration_m_s2[..., rows, :], self.rate_rad_s[..., rows])

    def concatenate(self, later: ImuRecord) -> ImuRecord:
        """Append a record that begins at the end of this one.

        Raises
        ------
        ValueError
            The later record begins elsewhere.
        """
        if later.begin_s != self.end_s:
            raise ValueError(
                f"Input later must begin where this record ends, at {self.end_s:.6g} s; "
                f"instead received one that begins at {later.begin_s:.6g} s."
            )
        return ImuRecord(
            self.begin_s,
            np.concatenate([self.time_s, later.time_s]),
            np.concatenate([self.acceleration_m_s2, later.acceleration_m_s2], axis=-2),
            np.concatenate([self.rate_rad_s, later.rate_rad_s], axis=-1),
        )

    def subtract_zeros(self, acceleration_m_s2: ArrayLike, rate_rad_s: ArrayLike) -> ImuRecord:
        """Subtract zeros: (2,) or (n, 2) of the accelerations, () or (n,) of the rates."""
        return replace(
            self,
            acceleration_m_s2=self.acceleration_m_s2 - np.asarray(acceleration_m_s2, dtype=np.float64),
            rate_rad_s=self.rate_rad_s - np.asarray(rate_rad_s, dtype=np.float64),
        )


@dataclass(frozen=True, eq=False)
class PlanarState:
    """Position, velocity and heading at one instant, of one run or of several.

    Attributes
    ----------
    position_m, velocity_m_s : ndarray, shape (..., 2)
        Position and velocity, table axes.
    heading_rad : ndarray or float, shape (...)
        Heading, counter-clockwise; counts full turns.
    """

    position_m: FloatArray
    velocity_m_s: FloatArray
    heading_rad: FloatArray | float

    def __post_init__(self) -> None:
        for name in ("position_m", "velocity_m_s"):
            vector = np.asarray(getattr(self, name), dtype=np.float64)
            if vector.shape[-1:] != (2,):
                raise ValueError(f"Input {name} must have shape (..., 2); instead received {vector.shape}.")
            object.__setattr__(self, name, vector)


@dataclass(frozen=True, eq=False)
class PlanarTrack:
    """States over time.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Times of the states.
    position_m, velocity_m_s : ndarray, shape (..., n, 2)
        Position and velocity, table axes.
    heading_rad : ndarray, shape (..., n)
        Heading, counter-clockwise; counts full turns.
    """

    time_s: FloatArray
    position_m: FloatArray
    velocity_m_s: FloatArray
    heading_rad: FloatArray

    def __len__(self) -> int:
        """Return the number of instants."""
        return self.time_s.size

    def state(self, row: int) -> PlanarState:
        """Return the state at an instant."""
        return PlanarState(self.position_m[..., row, :], self.velocity_m_s[..., row, :], self.heading_rad[..., row])

    def at(self, time_s: ArrayLike) -> PlanarTrack:
        """Interpolate the states of one run linearly at instants (k,)."""
        t = np.asarray(time_s, dtype=np.float64)
        columns = (*self.position_m.T, *self.velocity_m_s.T, self.heading_rad)
        x, y, vx, vy, heading = (np.interp(t, self.time_s, column) for column in columns)
        return PlanarTrack(t, np.stack([x, y], axis=1), np.stack([vx, vy], axis=1), heading)

    def rows(self, rows: slice) -> PlanarTrack:
        """Select some of the instants."""
        return PlanarTrack(
            self.time_s[rows],
            self.position_m[..., rows, :],
            self.velocity_m_s[..., rows, :],
            self.heading_rad[..., rows],
        )


@dataclass(frozen=True)
class Gate:
    """Largest accepted readings, for each of the three channels.

    Attributes
    ----------
    acceleration_m_s2 : float
        Limit of each axis after subtraction of its zero.
    rate_rad_s : float
        Limit of the rate. The source states 50 °/s, which the firings in its own figure 14 exceed.

    Raises
    ------
    ValueError
        A limit is not positive.
    """

    acceleration_m_s2: float = 0.5
    rate_rad_s: float = math.radians(200.0)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0.0:
                raise ValueError(f"Input {name} must be positive; instead received {value}.")

    def accept(self, imu: ImuRecord) -> BoolArray:
        """Return whether x, y and rate of each sample are accepted, (..., n, 3); missing readings are not."""
        limits = np.array([self.acceleration_m_s2, self.acceleration_m_s2, self.rate_rad_s])
        return np.abs(np.concatenate([imu.acceleration_m_s2, imu.rate_rad_s[..., None]], axis=-1)) <= limits


def hold(imu: ImuRecord, accepted: BoolArray, held_rate_rad_s: ArrayLike = 0.0) -> ImuRecord:
    """Replace rejected accelerations by zero, and rejected rates by the last accepted one.

    ``accepted`` (..., n, 3): result of :meth:`Gate.accept`. ``held_rate_rad_s`` (...): last accepted rate before the
    record.
    """
    rows = np.where(accepted[..., 2], np.arange(len(imu)), -1)
    last = np.maximum.accumulate(rows, axis=-1)
    before = np.asarray(held_rate_rad_s, dtype=np.float64)[..., None]
    if len(imu):
        rate = np.where(last >= 0, np.take_along_axis(imu.rate_rad_s, np.maximum(last, 0), axis=-1), before)
    else:
        rate = imu.rate_rad_s
    return replace(imu, acceleration_m_s2=np.where(accepted[..., :2], imu.acceleration_m_s2, 0.0), rate_rad_s=rate)


def step(state: PlanarState, step_s: float, acceleration_m_s2: ArrayLike, rate_rad_s: ArrayLike) -> PlanarState:
    r"""Return the state after one sample.

    .. math::

        a = R(φ_{i-1} + ωΔ/2)\,a_{body}, \quad X_i = X_{i-1} + v_{i-1}Δ + aΔ^2/2, \quad v_i = v_{i-1} + aΔ, \quad
        φ_i = φ_{i-1} + ωΔ

    Shapes ``acceleration_m_s2`` (..., 2), ``rate_rad_s`` (...). ``step_s``: Δ. The position uses the old velocity, as
    in the source's section on least squares.
    """
    angle = np.asarray(rate_rad_s, dtype=np.float64) * step_s
    a = rotate(state.heading_rad + 0.5 * angle, acceleration_m_s2)
    return PlanarState(
        state.position_m + state.velocity_m_s * step_s + 0.5 * step_s**2 * a,
        state.velocity_m_s + step_s * a,
        state.heading_rad + angle,
    )


def strapdown(imu: ImuRecord, start: PlanarState) -> PlanarTrack:
    """Integrate a whole record by :func:`step`, in cumulative sums.

    Parameters
    ----------
    imu : ImuRecord
        Samples without zeros and without missing readings (:func:`hold`); all states after a NaN are NaN.
    start : PlanarState
        State at ``imu.begin_s``.

    Returns
    -------
    PlanarTrack
        States after each sample.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> mockup.strapdown(run.imu, run.start).position_m.shape
    (500, 2)
    """
    dt = imu.steps_s
    angle = imu.rate_rad_s * dt
    phi0 = np.asarray(start.heading_rad, dtype=np.float64)[..., None]
    heading = phi0 + np.cumsum(angle, axis=-1)
    a = rotate(heading - 0.5 * angle, imu.acceleration_m_s2)
    h = dt[:, None]
    change = np.cumsum(a * h, axis=-2)
    v0 = start.velocity_m_s[..., None, :]
    old = v0 + change - a * h
    position = start.position_m[..., None, :] + np.cumsum(old * h + 0.5 * h**2 * a, axis=-2)
    return PlanarTrack(imu.time_s, position, v0 + change, heading)
