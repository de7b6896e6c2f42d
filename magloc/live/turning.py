"""Calibration of vector sensors while they are turned: directions covered, what turn is missing, and when it is enough.

The modulus of the field is the only truth: see :mod:`magloc.calibration.modulus`.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from arrays.array import SensorArray
from arrays.io.errors import InputError, check_positive
from arrays.sensor import Sensor
from arrays.typing import BoolArray, FloatArray
from magloc.calibration.modulus import EllipsoidCalibration, calibrate_in_modulus, ellipsoid_calibration, wild_limit_T
from magloc.directions import sphere_directions
from magloc.levels import SIGMA_OF_MAD
from magloc.live.rows import RowParser, rows_of_stream
from magloc.live.tally import Clock, Tally
from magloc.live.transports import STANDARD_INPUT, open_stream, sender_waits
from magloc.readings import Readings, log_format, without_saturated

_DIRECTIONS = 60  # evenly spread directions, whose covered share is the coverage
_NEAR = math.cos(math.radians(30.0))  # a direction is covered by a reading within this angle
_COVERED = 0.9
_LEAST_TURN = 0.05  # change of the calibrated reading, over the modulus, from one row in use to the next
_FEWEST, _MOST = 12, 2000  # rows in use
_FIT_S, _GROWTH = 1.0, 1.05  # time of the stream, and growth of the rows in use, between two fits
_GOAL = 1e-3  # standard deviation of the offsets, over the modulus
_OUTLYING = 6.0  # residual beyond which a row is disturbed, in standard deviations of the other rows
_ROUNDS = 3  # of the fit and the search for disturbed rows
_RECENT, _DISTURBED = 40, 0.25  # last rows in use, and the share of disturbed ones that tells of a magnet nearby
_SPOILT = 0.02  # residual of the modulus, over it, of a field that is not uniform


@dataclass(frozen=True, eq=False)
class SensorTurning:
    """Progress of one sensor.

    Attributes
    ----------
    id : str
    directions : ndarray, shape (k, 3)
        Directions of the field in the sensor's axes, of the rows in use.
    coverage : float
        Share of all directions that the rows cover.
    missing : ndarray, shape (3,)
        Direction farthest from all rows.
    fit : EllipsoidCalibration
        Fit of the rows that are not disturbed.
    inflation : float
        Factor on the standard deviations by which the residuals exceed the stated noise, 1 at least.
    disturbed : ndarray of bool, shape (k,)
        Rows that contradict the others.
    """

    id: str
    directions: FloatArray
    coverage: float
    missing: FloatArray
    fit: EllipsoidCalibration
    inflation: float
    disturbed: BoolArray

    @property
    def offset_sigma_T(self) -> float:
        """Largest standard deviation of the offset; NaN without a fit."""
        return self.inflation * math.sqrt(float(np.max(np.diagonal(self.fit.covariance)[:3])))

    @property
    def gain_sigma(self) -> float:
        """Largest standard deviation of the scale matrix; NaN without a fit."""
        return self.inflation * math.sqrt(float(np.max(np.diagonal(self.fit.covariance)[3:])))

    def is_uniform(self, noise_T: float, modulus_T: float) -> bool:
        """Return True if there is a fit whose residuals agree with a uniform field."""
        return self.fit.converged and self.inflation * noise_T <= _SPOILT * modulus_T

    @property
    def turn(self) -> str:
        """Description of the missing direction by the sensor's axes, such as "+x -z"."""
        signs = ((f"{'+' if c > 0 else '-'}{axis}", abs(c)) for axis, c in zip("xyz", self.missing, strict=True))
        return " ".join(name for name, size in signs if size > 0.38)


@dataclass(frozen=True, eq=False)
class TurningProgress:
    """Progress of a calibration by turning.

    Attributes
    ----------
    time_s : float
        Time of the last row [s].
    rows : int
        Rows in use.
    sensors : tuple of SensorTurning
    modulus_T : float
        Modulus of the field, stated or from the gains of the array [T].
    goal_T : float
        Standard deviation of the offsets that is enough [T].
    flags : tuple of str
        Sentences about readings that are not those of a uniform field.
    enough : bool
        Whether all sensors reach the goal, and their rows cover the directions.
    """

    time_s: float
    rows: int
    sensors: tuple[SensorTurning, ...]
    modulus_T: float
    goal_T: float
    flags: tuple[str, ...]
    enough: bool

    @property
    def least_covered(self) -> SensorTurning:
        """Sensor with the smallest coverage."""
        return min(self.sensors, key=lambda sensor: sensor.coverage)

    @property
    def advice(self) -> str:
        """Sentence on what to do next."""
        if self.enough:
            return "enough: all directions are covered, and the goal is reached"
        if self.flags:
            return self.flags[0]
        least = self.least_covered
        if least.coverage < _COVERED:
            return f"turn until the field points along {least.turn} of sensor {least.id}"
        return "go on turning slowly in all directions"


class TurningCalibrator:
    """Calibrator of the vector sensors of an array while they are turned in a uniform field.

    Parameters
    ----------
    array : SensorArray
        Array with nominal calibrations; their mean gain counts where the modulus is unknown.
    modulus_T : float, optional
        Modulus of the field [T].
    goal_T : float, optional
        Standard deviation of the offsets that is enough [T]; by default a thousandth of the modulus.

    Raises
    ------
    ValueError
        The array has no vector sensor, or a number is not positive.
    """

    def __init__(self, array: SensorArray, modulus_T: float | None = None, goal_T: float | None = None) -> None:
        if array.channel_is_scalar.all():
            raise ValueError("Input array must have a vector sensor; instead received scalar sensors only.")
        stated = {"modulus_T": modulus_T, "goal_T": goal_T}
        check_positive(**{name: value for name, value in stated.items() if value is not None})
        self.nominal, self._stated_T, self._goal_T = array, modulus_T, goal_T
        self._sensors = [(i, s) for i, s in enumerate(array.sensors) if s.kind == "vector"]
        self.restart()

    def restart(self) -> None:
        """Forget all rows."""
        self._rows = np.zeros((0, self.nominal.n_channels))
        self._times = np.zeros(0)
        self._last: FloatArray | None = None
        self._fitted, self._fitted_s = self._rows, -math.inf
        self.progress: TurningProgress | None = None

    def newest_directions(self, values_T: FloatArray) -> dict[str, FloatArray]:
        """Return the directions of the field in the sensors' axes of one row of readings (C,), by the last fit."""
        fits = {} if self.progress is None else {sensor.id: sensor.fit for sensor in self.progress.sensors}
        return {
            s.id: _unit(_fields(values_T[None, self.nominal.sensor_channels[i]], s, fits.get(s.id)))[0]
            for i, s in self._sensors
        }

    def add(self, readings: Readings) -> TurningProgress | None:
        """Use new rows; return the progress if it was fitted anew."""
        rows = without_saturated(readings, self.nominal)
        fitted = None
        for time_s, values in zip(rows.time_s.tolist(), rows.values_T, strict=True):
            if not self._turns(values):
                continue
            self._rows, self._times = np.vstack([self._rows, values]), np.append(self._times, time_s)
            if len(self._rows) > _MOST:
                self._rows, self._times = self._rows[::2], self._times[::2]
            due_s = self._fitted_s + _FIT_S
            if len(self._rows) >= max(_FEWEST, _GROWTH * len(self._fitted)) and time_s >= due_s:
                fitted = self.fit()
        return fitted

    def fit(self) -> TurningProgress | None:
        """Fit all rows so far, unless there are no new ones; None if they are too few."""
        if self._fitted is self._rows:
            return self.progress
        if len(self._rows) < _FEWEST:
            return None
        self._fitted, self._fitted_s = self._rows, float(self._times[-1])
        modulus_T = self._modulus_T()
        sensors = tuple(self._sensor_progress(i, sensor, modulus_T) for i, sensor in self._sensors)
        goal_T = self._goal_T or _GOAL * modulus_T
        is_covered = any(sensor.coverage >= _COVERED for sensor in sensors)
        flags = [
            flag
            for (_, sensor), turning in zip(self._sensors, sensors, strict=True)
            for flag in _flags(turning, sensor.noise_T, modulus_T, is_covered=is_covered)
        ]
        enough = not flags and all(s.coverage >= _COVERED and s.offset_sigma_T <= goal_T for s in sensors)
        self.progress = TurningProgress(
            self._fitted_s, len(self._rows), sensors, modulus_T, goal_T, tuple(flags), enough
        )
        return self.progress

    def array(self) -> SensorArray:
        """Return the array with the calibrations of the last fit."""
        if self.progress is None:
            return self.nominal
        rows = self._fitted.copy()
        for (i, _), sensor in zip(self._sensors, self.progress.sensors, strict=True):
            rows[np.ix_(np.flatnonzero(sensor.disturbed), self.nominal.sensor_channels[i])] = np.nan
        return calibrate_in_modulus(self.nominal, rows, self.progress.modulus_T)[0]

    def _turns(self, values: FloatArray) -> bool:
        """Return whether a row differs enough from the last row in use."""
        fields = np.concatenate(
            [_fields(values[None, self.nominal.sensor_channels[i]], s, None) for i, s in self._sensors]
        )
        if not np.isfinite(fields).any():
            return False
        size = np.linalg.norm(fields, axis=1)
        if self._last is not None:
            change = np.linalg.norm(fields - self._last, axis=1) / np.maximum(size, 1e-30)
            if not np.nanmax(change, initial=0.0) > _LEAST_TURN:
                return False
        self._last = fields
        return True

    def _robust_fit(self, rows: FloatArray, sensor: Sensor, modulus_T: float) -> tuple[EllipsoidCalibration, BoolArray]:
        """Return the fit of the rows that agree, and those that do not.

        Wild readings and rows that contradict the previous fit are excluded first: a magnet nearby would bend a
        fit of all rows.
        """
        disturbed = _is_wild(rows)
        before = next((s for s in self.progress.sensors if s.id == sensor.id), None) if self.progress else None
        if before is not None and before.is_uniform(sensor.noise_T, modulus_T):
            disturbed = np.abs(_residual_T(rows, sensor, before.fit, modulus_T)) > _SPOILT * modulus_T
            disturbed &= disturbed.mean() < 0.5
        for _ in range(_ROUNDS):
            fit = ellipsoid_calibration(rows[~disturbed], modulus_T, sensor.noise_T)
            if not fit.converged:
                return fit, np.zeros(len(rows), dtype=bool)
            residual_T = np.abs(_residual_T(rows, sensor, fit, modulus_T))
            spread_T = max(SIGMA_OF_MAD * float(np.nanmedian(residual_T[~disturbed])), sensor.noise_T)
            again = residual_T > _OUTLYING * spread_T
            if np.array_equal(again, disturbed):
                break
            disturbed = again
        return fit, disturbed

    def _modulus_T(self) -> float:
        """Return the stated modulus, or that for which the fit keeps the mean gain of the sensors."""
        if self._stated_T is not None:
            return self._stated_T
        start_T = 0.0
        ratios = []
        for i, sensor in self._sensors:
            rows = self._rows[:, self.nominal.sensor_channels[i]]
            fields = _fields(rows, sensor, None)
            start_T = start_T or float(np.nanmedian(np.linalg.norm(fields - np.nanmedian(fields, axis=0), axis=1)))
            fit = ellipsoid_calibration(rows[~_is_wild(rows)], start_T, sensor.noise_T)
            if fit.converged:
                nominal = float(np.linalg.det(np.asarray(sensor.calibration.scale)))
                ratios.append(float(np.cbrt(np.linalg.det(fit.scale) / abs(nominal))))
        return start_T * float(np.exp(np.mean(np.log(ratios)))) if ratios else start_T

    def _sensor_progress(self, i: int, sensor: Sensor, modulus_T: float) -> SensorTurning:
        rows = self._rows[:, self.nominal.sensor_channels[i]]
        fit, disturbed = self._robust_fit(rows, sensor, modulus_T)
        inflation = math.sqrt(max(fit.chi2 / max(fit.dof, 1), 1.0)) if fit.converged else math.nan
        fields = _fields(rows, sensor, fit if fit.converged else None)
        directions = _unit(fields[np.isfinite(fields).all(axis=1)])
        nearest = _nearest_cosines(directions)
        missing = SPREAD[int(np.argmin(nearest))]
        return SensorTurning(sensor.id, directions, float(np.mean(nearest > _NEAR)), missing, fit, inflation, disturbed)


def turn(
    source: str,
    calibrator: TurningCalibrator,
    tally: Tally,
    *,
    replay_speed: float = 1.0,
) -> Generator[tuple[Readings, TurningProgress | None]]:
    """Yield the rows of a stream and, after each new fit, the progress; see :func:`magloc.live.track` for sources."""
    array, waits = calibrator.nominal, sender_waits(source)
    clock = Clock(tally, calibrator.restart)
    with open_stream(source, replay_speed=replay_speed, form=log_format(array, None)) as stream:
        parser = RowParser(array, stream.name, tally, is_file=source != STANDARD_INPUT and waits)
        for readings, _ in rows_of_stream(stream, parser, tally):
            new = np.array([clock.accepts(time_s) for time_s in readings.time_s.tolist()], dtype=bool)
            if new.any():
                rows = readings[new]
                yield rows, calibrator.add(rows)
    if tally.rows:
        last = calibrator.fit()
        if last is not None:
            yield rows, last


def refuse_unfinished(progress: TurningProgress | None, source: str) -> None:
    """Raise an error if a stream ended before the calibration was enough."""
    if progress is None:
        raise InputError(
            f"{source}: found fewer than {_FEWEST} directions of the field, expected sensors that are turned."
        )
    if not progress.enough:
        covered = progress.least_covered.coverage
        why = "; ".join(progress.flags) or f"{100 * covered:.0f} % of the directions are covered; {progress.advice}"
        raise InputError(f"{source}: the rows ended before the calibration was enough: {why}.")


def _is_wild(rows: FloatArray) -> BoolArray:
    """Return which rows (n,) have a reading far larger than nearly all others."""
    return np.asarray((np.abs(rows) > wild_limit_T(rows)).any(axis=1))


def _residual_T(rows: FloatArray, sensor: Sensor, fit: EllipsoidCalibration, modulus_T: float) -> FloatArray:
    """Return the moduli (n,) of the calibrated readings less that of the field."""
    moduli_T: FloatArray = np.linalg.norm(_fields(rows, sensor, fit), axis=1)
    return moduli_T - modulus_T


def _flags(sensor: SensorTurning, noise_T: float, modulus_T: float, *, is_covered: bool) -> list[str]:
    """Return sentences about a field that is not uniform, or a sensor without a fit although others are turned."""
    if not sensor.fit.converged:
        why = f"sensor {sensor.id} cannot be calibrated, although the directions are covered: {sensor.fit.reason}"
        return [f"{why}; check its wiring, its unit and its noise_nT"] if is_covered else []
    if sensor.disturbed[-_RECENT:].mean() > _DISTURBED:
        return [f"sensor {sensor.id}: a magnet or iron is near, because the modulus changes; go away from it"]
    if not sensor.is_uniform(noise_T, modulus_T):
        return [f"sensor {sensor.id}: the modulus is not that of a uniform field; go away from iron and start again"]
    return []


def _fields(rows: FloatArray, sensor: Sensor, fit: EllipsoidCalibration | None) -> FloatArray:
    """Return the fields (n, 3) of raw readings (n, 3) of a sensor, by its nominal calibration if there is no fit."""
    if fit is not None and fit.converged:
        scale, offset_T = fit.scale, fit.offset_T
    else:
        scale, offset_T = np.asarray(sensor.calibration.scale), np.asarray(sensor.calibration.offset_T)
    return np.asarray(np.linalg.solve(scale, (rows - offset_T).T).T)


def _unit(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
    return unit


SPREAD = sphere_directions(_DIRECTIONS)
"""Evenly spread directions (60, 3), whose covered share is the coverage."""


def covered_directions(directions: FloatArray) -> BoolArray:
    """Return which of :data:`SPREAD` are within 30° of directions (k, 3)."""
    return np.asarray(_nearest_cosines(directions) > _NEAR)


def _nearest_cosines(directions: FloatArray) -> FloatArray:
    return (SPREAD @ directions.T).max(axis=1, initial=-1.0)
