"""Input of the attitude filters: readings, wheels and environment of one or several runs.

:class:`sims.attitude.simulation.AttitudeRuns` is a :class:`Record` with the truth. A log, :class:`Telemetry`, gives one
without it. In all arrays the first axis is the run, the second the instant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adcs import quaternion
from adcs.environment.environment import Environment, environment
from adcs.satellite.satellite import Satellite
from adcs.satellite.sensors import SENSORS
from arrays.io.errors import check_positive
from arrays.io.values import numbers, seconds
from arrays.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_MOST_STEPS = 2.0**53  # whole numbers in double precision
_STEP_TOLERANCE = 1e-3
_SAME_STEP = 1e-6
MOST_INSTANTS = 500_000
"""Largest number of instants of a log, gaps included."""


@dataclass(frozen=True, eq=False)
class AttitudeReadings:
    """Readings of the sensors at the instants of some runs, in body axes; NaN where missing.

    Attributes
    ----------
    star : ndarray, shape (runs, n, 4)
        Attitude, orbital from body, scalar first, of either sign.
    gyro_rad_s : ndarray, shape (runs, n, 3)
        Rate against inertial space.
    field_T : ndarray, shape (runs, n, 3)
        Field at the magnetometer.
    sun : ndarray, shape (runs, n, 3)
        Unit vector to the Sun.
    star_whitening : ndarray, shape (runs, n, 3, 3)
        W of each attitude: each component of W δq has the star tracker's standard deviation.
    """

    star: FloatArray
    gyro_rad_s: FloatArray
    field_T: FloatArray
    sun: FloatArray
    star_whitening: FloatArray = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        """Set one whitening for each attitude, by default E."""
        each = np.broadcast_to(self.star_whitening, (*self.star.shape[:2], 3, 3))
        object.__setattr__(self, "star_whitening", each)

    @property
    def seen(self) -> dict[str, BoolArray]:
        """Masks (runs, n) of the readings by the sensor's name: st, gyro, mag, sun."""
        values = (self.star, self.gyro_rad_s, self.field_T, self.sun)
        return dict(zip(SENSORS, map(is_read, values), strict=True))


def is_read(values: FloatArray) -> BoolArray:
    """Return whether there is a reading, (..., k) -> (...)."""
    return ~np.isnan(values[..., 0])


@dataclass(frozen=True, eq=False)
class Record:
    """Complete input of a filter for some runs, or for a log.

    There are readings at each instant; the torque of the wheels acts from an instant to the next.

    Attributes
    ----------
    satellite : Satellite
        Satellite and sensors as their user knows them.
    dt_s : float
        Usual time between instants.
    environment : Environment
        Instants, field and Sun.
    readings : AttitudeReadings
        Readings at each instant.
    momentum_Nms, wheel_torque_Nm : ndarray, shape (runs, n, 3)
        Momentum of the wheels, and its rate of change from each instant to the next.
    torquers_Am2 : ndarray, shape (runs, n, 3)
        Commanded magnetic moment of the torquers from each instant to the next, body axes.
    """

    satellite: Satellite
    dt_s: float
    environment: Environment
    readings: AttitudeReadings
    momentum_Nms: FloatArray
    wheel_torque_Nm: FloatArray
    torquers_Am2: FloatArray

    @cached_property
    def steps_s(self) -> FloatArray:
        """Steps (n - 1,) between instants; equal to the usual step within rounding errors."""
        steps = np.diff(self.environment.time_s)
        return np.where(np.abs(steps - self.dt_s) < _SAME_STEP * self.dt_s, self.dt_s, steps)


def part(record: Record, runs: NDArray[np.intp], rows: slice = slice(None)) -> Record:
    """Return runs of a record, with indices that may repeat, and consecutive instants."""
    return _take(record, record.environment.time_s[rows], lambda values: values[runs, rows])


def instants_as_runs(record: Record, run: int) -> Record:
    """Return each instant of a run as a separate run."""
    return _take(record, record.environment.time_s[:1], lambda values: values[run][:, None])


def _take(record: Record, time_s: FloatArray, take: Callable[[Any], Any]) -> Record:
    """Apply a selection to all values (runs, n, …) of a record."""
    around, readings = record.environment, record.readings
    of_around = {one.name: take(getattr(around, one.name)) for one in fields(around) if one.name != "time_s"}
    return Record(
        record.satellite,
        record.dt_s,
        Environment(time_s=time_s, **of_around),
        AttitudeReadings(*(take(getattr(readings, one.name)) for one in fields(readings))),
        *map(take, (record.momentum_Nms, record.wheel_torque_Nm, record.torquers_Am2)),
    )


@dataclass(frozen=True, eq=False, init=False)
class Telemetry:
    """Log of a satellite's attitude sensors, in body axes; missing values are NaN, missing sensors None.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Seconds or durations since :attr:`adcs.Satellite.start`, ascending in any steps; rows may be missing.
    star : Rotation, or ndarray, shape (n, 4)
        Attitude of the star tracker, inertial (J2000) from body; quaternions, scalar last, if some are missing.
    gyro_rad_s : ndarray, shape (n, 3)
        Rate against inertial space.
    field_T : ndarray, shape (n, 3)
        Field at the magnetometer.
    sun : ndarray, shape (n, 3)
        Direction to the Sun, of any length.
    wheels_Nms : ndarray, shape (n, 3)
        Total momentum of the wheels; missing values are interpolated linearly.
    torquers_Am2 : ndarray, shape (n, 3)
        Commanded magnetic moment, held until the next command; zero before the first.
    star_covariance_rad2 : ndarray, shape (n, 3, 3)
        Covariance of the star tracker's attitude, as a small rotation about the body's axes, for example from
        :func:`adcs.combined_star_fixes`. Where it is NaN, the noise of the satellite's star tracker applies.
    step_s : float
        Usual time between instants, to which the process noise refers; by default the shortest time between two rows,
        or the median if times are not multiples of it.

    Raises
    ------
    ValueError
        A shape does not match, a direction has no length, or the times do not ascend.

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> telemetry = adcs.Telemetry([0.0, 0.5, 1.5], gyro_rad_s=np.zeros((3, 3)))
    >>> telemetry.step_s, telemetry.rows
    (0.5, array([0, 1, 3]))
    """

    time_s: FloatArray
    star: FloatArray
    gyro_rad_s: FloatArray
    field_T: FloatArray
    sun: FloatArray
    wheels_Nms: FloatArray
    torquers_Am2: FloatArray
    star_covariance_rad2: FloatArray
    step_s: float

    def __init__(
        self,
        time_s: ArrayLike,
        *,
        star: Rotation | ArrayLike | None = None,
        gyro_rad_s: ArrayLike | None = None,
        field_T: ArrayLike | None = None,
        sun: ArrayLike | None = None,
        wheels_Nms: ArrayLike | None = None,
        torquers_Am2: ArrayLike | None = None,
        star_covariance_rad2: ArrayLike | None = None,
        step_s: float | None = None,
    ) -> None:
        times = seconds(time_s, dates=False).copy()
        if times.ndim != 1 or not times.size or not np.isfinite(times).all():
            raise ValueError(f"Input time_s must be finite with shape (n,); instead received shape {times.shape}.")
        back = np.diff(times) <= 0.0
        if back.any():
            raise ValueError(f"Input time_s must ascend; instead received {times[1:][back][0]:g}.")
        if step_s is None:
            step_s = usual_step_s(times)
        check_positive(step_s=step_s)
        steps = steps_within(times, step_s)
        if steps >= MOST_INSTANTS:
            raise ValueError(f"Input time_s must have fewer than {MOST_INSTANTS} steps; instead received {steps:.6g}.")
        quaternions = star if star is None or not hasattr(star, "as_quat") else np.atleast_2d(star.as_quat())
        given = {"star": quaternions, "gyro_rad_s": gyro_rad_s, "field_T": field_T, "sun": sun}
        given |= {"wheels_Nms": wheels_Nms, "torquers_Am2": torquers_Am2}
        checked = {name: _columns(name, values, len(times)) for name, values in given.items()}
        checked["star_covariance_rad2"] = _covariances(star_covariance_rad2, len(times))
        for name, value in ({"time_s": times, "step_s": step_s} | checked).items():
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, record: Record, start: np.datetime64, run: int = 0) -> Telemetry:
        """Return the log of a run of a record.

        Parameters
        ----------
        record : Record
            Readings with wheels and torquers.
        start : datetime64
            Zero of the log's times, UTC.
        run : int
            Index of the run.

        Returns
        -------
        Telemetry
            Log with the record's usual step.
        """
        around, readings = record.environment, record.readings
        eci_from_orbital = quaternion.conjugate(orbital_from_eci(around)[run])
        return cls(
            (around.utc[run] - start).astype(np.float64) / 1e6,
            star=quaternion.multiply(eci_from_orbital, readings.star[run])[:, [1, 2, 3, 0]],
            gyro_rad_s=readings.gyro_rad_s[run],
            field_T=readings.field_T[run],
            sun=readings.sun[run],
            wheels_Nms=record.momentum_Nms[run],
            torquers_Am2=record.torquers_Am2[run] if record.torquers_Am2[run].any() else None,
            step_s=record.dt_s,
        )

    @property
    def rows(self) -> NDArray[np.int64]:
        """Index of each row in :attr:`instants_s`, shape (n,)."""
        return _filter_instants(self.time_s, self.step_s)[1]

    def pieces(self, longest_gap_s: float) -> list[Telemetry]:
        """Split the log at gaps that are longer than a limit.

        Parameters
        ----------
        longest_gap_s : float
            Longest gap within a piece; a usual step is never a gap.

        Returns
        -------
        list of Telemetry
            Pieces in order of time; the log itself without such gaps.
        """
        cuts = np.flatnonzero(np.diff(self.time_s) > max(longest_gap_s, self.step_s)) + 1
        return [
            Telemetry(**{name: values if name == "step_s" else values[rows] for name, values in vars(self).items()})
            for rows in np.split(np.arange(len(self.time_s)), cuts)
        ]

    def record(self, satellite: Satellite, since_s: float | None = None) -> Record:
        """Return the input of the filters: readings at each instant, field and Sun along the orbit.

        Parameters
        ----------
        satellite : Satellite
            Orbit, field model and noise of the star tracker.
        since_s : float, optional
            Time from which instants are rounded to microseconds; by default the first of the log.

        Returns
        -------
        Record
            Record of one run, with all instants.
        """
        instants_s, rows = _filter_instants(self.time_s, self.step_s)
        n, start_s = len(instants_s), self.time_s[0] if since_s is None else since_s

        def spread(values: FloatArray) -> FloatArray:
            """Return values at all instants, NaN in gaps."""
            all_of = np.full((n, values.shape[1]), np.nan)
            all_of[rows] = values
            return all_of

        around = environment(
            satellite.orbit,
            np.array([satellite.start + np.timedelta64(round(1e6 * start_s), "us")]),
            instants_s - start_s,
            model=satellite.field_model,
        )
        momentum = _interpolate_gaps(spread(self.wheels_Nms), instants_s)
        torque = np.zeros_like(momentum)
        torque[:-1] = np.diff(momentum, axis=0) / np.diff(instants_s)[:, None]
        star, sun = spread(self.star[:, [3, 0, 1, 2]]), spread(self.sun)
        readings = AttitudeReadings(
            star=quaternion.multiply(orbital_from_eci(around)[0], quaternion.normalised(star))[None],
            gyro_rad_s=spread(self.gyro_rad_s)[None],
            field_T=spread(self.field_T)[None],
            sun=(sun / np.linalg.norm(sun, axis=1, keepdims=True))[None],
            star_whitening=_whitening(
                spread(self.star_covariance_rad2.reshape(-1, 9)).reshape(-1, 3, 3), satellite.star_tracker.sigma_rad
            )[None],
        )
        torquers = _hold(spread(self.torquers_Am2))
        return Record(satellite, self.step_s, around, readings, momentum[None], torque[None], torquers[None])

    @property
    def instants_s(self) -> FloatArray:
        """Times of all instants, missing rows included: multiples of the step, or similar steps in gaps."""
        return _filter_instants(self.time_s, self.step_s)[0]


def single_reading(name: str, value: ArrayLike | None, shape: tuple[int, ...] = (3,)) -> FloatArray:
    """Return a reading of a caller, NaN where it is missing; ValueError if it has another shape."""
    if value is None:
        return np.full(shape, np.nan)
    found = numbers(value)
    if found.shape != shape:
        raise ValueError(f"Input {name} must have shape {shape}; instead received {found.shape}.")
    return found


def _columns(name: str, given: ArrayLike | None, n: int) -> FloatArray:
    """Return the readings of a sensor, NaN where one of their components is missing."""
    shape = (n, 4 if name == "star" else 3)
    values = np.full(shape, np.nan) if given is None else numbers(given)
    if values.shape != shape:
        raise ValueError(f"Input {name} must have shape {shape}; instead received {values.shape}.")
    infinite = values[np.isinf(values).any(axis=1)]
    if len(infinite):
        raise ValueError(f"Input {name} must have no infinity; instead received {infinite[0].tolist()}.")
    if name in ("star", "sun") and (values == 0.0).all(axis=1).any():
        raise ValueError(f"Input {name} must have a direction; instead received a reading of length 0.")
    return np.where(np.isnan(values).any(axis=1, keepdims=True), np.nan, values)


def _covariances(given: ArrayLike | None, n: int) -> FloatArray:
    """Check covariances (n, 3, 3): symmetric and positive definite, or NaN."""
    values = np.full((n, 3, 3), np.nan) if given is None else np.array(given, dtype=np.float64)
    if values.shape != (n, 3, 3):
        raise ValueError(
            f"Input star_covariance_rad2 must have shape ({n}, 3, 3); instead received shape {values.shape}."
        )
    known = values[~np.isnan(values).any(axis=(1, 2))]
    if not np.isfinite(known).all() or not (np.linalg.eigvalsh(known) > 0.0).all():
        raise ValueError("Input star_covariance_rad2 must be positive definite; instead received one that is not.")
    return values


def _whitening(covariance_rad2: FloatArray, sigma: float) -> FloatArray:
    """Return W (n, 3, 3) for covariances of rotations: W δq has covariance σ²E, δq being half the angle."""
    W = np.tile(np.eye(3), (len(covariance_rad2), 1, 1))
    known = ~np.isnan(covariance_rad2).any(axis=(1, 2))
    W[known] = 2.0 * sigma * np.linalg.inv(np.linalg.cholesky(covariance_rad2[known]))
    return W


def steps_of(time_s: FloatArray, step_s: float) -> tuple[NDArray[np.int64], BoolArray]:
    """Return the number (n,) of steps since the first time, and which times are not a multiple of the step."""
    with np.errstate(over="ignore"):
        steps = (time_s - time_s[0]) / step_s
    rows = np.round(np.clip(steps, -_MOST_STEPS, _MOST_STEPS)).astype(np.int64)
    return rows, np.abs(steps - rows) > _STEP_TOLERANCE


def steps_within(time_s: FloatArray, step_s: float) -> float:
    """Return the number of instants from the first time to the last, one at least for each row."""
    return float(np.clip(np.maximum(np.diff(time_s) / step_s, 1.0).sum(), 0.0, _MOST_STEPS))


def usual_step_s(time_s: FloatArray) -> float:
    """Return the shortest step if all times are multiples of it, else the median; 1 for one time."""
    if len(time_s) < 2:
        return 1.0
    steps = np.diff(time_s)
    shortest = float(steps.min())
    return float(np.median(steps)) if steps_of(time_s, shortest)[1].any() else shortest


def _filter_instants(time_s: FloatArray, step_s: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the instants of a filter, and the indices of the n times among them."""
    rows, off = steps_of(time_s, step_s)
    # Two times alone show no grid; a filter of single readings keeps them as they are.
    if len(time_s) > 2 and not off.any() and (np.diff(rows) > 0).all():
        return time_s[0] + step_s * np.arange(int(rows[-1]) + 1), rows
    counts = np.maximum(np.ceil(np.diff(time_s) / step_s - 0.5), 1.0).astype(np.int64)
    rows = np.concatenate([[0], np.cumsum(counts)])
    return np.interp(np.arange(rows[-1] + 1), rows, time_s), rows


def _interpolate_gaps(momentum: FloatArray, instants_s: FloatArray) -> FloatArray:
    """Interpolate the momentum linearly in gaps; zero if there is none at all."""
    known = np.flatnonzero(~np.isnan(momentum[:, 0]))
    if not known.size:
        return np.zeros_like(momentum)
    return np.stack([np.interp(instants_s, instants_s[known], column[known]) for column in momentum.T], axis=1)


def _hold(values: FloatArray) -> FloatArray:
    """Hold values (n, 3) until the next one; zero before the first."""
    last = np.maximum.accumulate(np.where(is_read(values), np.arange(len(values)), -1))
    return np.where(last[:, None] >= 0, values[last], 0.0)


def orbital_from_eci(around: Environment) -> FloatArray:
    """Return the quaternions (runs, n, 4), orbital from inertial frame."""
    from scipy.spatial.transform import Rotation

    matrices = around.R_orbital_from_eci
    rotations = Rotation.from_matrix(matrices.reshape(-1, 3, 3))
    return quaternion.from_rotation(rotations).reshape(*matrices.shape[:-2], 4)
