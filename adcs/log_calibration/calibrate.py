"""Calibration of all sensors of a log."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from adcs.log_calibration.fit import LogFit, fit_log
from adcs.log_calibration.manoeuvres import PLACE, advice
from adcs.log_calibration.parameters import FieldPrior
from adcs.log_calibration.record import Series, VehicleLog
from adcs.log_calibration.rotations import nearest_rotation
from adcs.log_calibration.terms import Terms, soft_iron, terms_of
from arrays.array import SensorArray
from arrays.io.results import Drawn
from arrays.io.tables import align, by_sigma
from arrays.sensor import Calibration, Sensor
from arrays.typing import FloatArray

MODEL_ERROR_T = 150e-9
"""Standard deviation of a component of the geomagnetic model: crust and storms."""
_LARGEST_FIELD_T = 70e-6
_TURNED_DEG = 20.0
_LARGE_SOFT_IRON = 0.3
_LARGE_NOISE = 0.1  # of the field
_SLOW_CURRENT_Hz = 10.0
_LARGE_LAG_S = 0.1


@dataclass(frozen=True, eq=False)
class LogCalibration(Drawn):
    """Calibration of the sensors of a log.

    Attributes
    ----------
    log : VehicleLog
    fit : LogFit
    terms : Terms
    manoeuvres : tuple of str
        Manoeuvre that would determine each term; empty where the log does.
    flags : tuple of str
        Sentences on doubts.

    Examples
    --------
    >>> import adcs
    >>> import sims
    >>> flight = sims.simulate_flight(1, sims.FlightSettings(duration_s=30.0, inertial_Hz=50.0))
    >>> found = adcs.calibrate_log(flight.log)
    >>> "mag0 scale" in found.undetermined  # neither place nor date is known
    True
    """

    figure: ClassVar[str] = "adcs.plots.vehicle_calibration:log_calibration_figure"
    log: VehicleLog
    fit: LogFit
    terms: Terms
    manoeuvres: tuple[str, ...]
    flags: tuple[str, ...]

    @property
    def undetermined(self) -> list[str]:
        """Names of the terms that the log does not determine."""
        return [name for name, known in zip(self.terms.names, self.terms.determined, strict=True) if not known]

    def is_determined(self, magnetometer: str, *kinds: str) -> bool:
        """Return True if all terms of some kinds of a magnetometer are determined."""
        return self.terms.are_known(magnetometer, *kinds)

    def matrix(self, m: int) -> FloatArray:
        """Return the matrix (3, 3) of a magnetometer: reading = matrix · field in body axes + offset."""
        return self.fit.estimate.parameters[self.fit.estimate.problem.layout.matrix(m)].reshape(3, 3)

    def offset_T(self, m: int) -> FloatArray:
        """Return the offset (3,) of a magnetometer."""
        return 1e-6 * self.fit.estimate.parameters[self.fit.estimate.problem.layout.offset(m)]

    def current_T(self, m: int) -> FloatArray:
        """Return the fields (J, 3) of the unit of each current at a magnetometer."""
        return 1e-6 * self.fit.estimate.parameters[self.fit.estimate.problem.layout.current(m)].reshape(-1, 3)

    def corrected(self, m: int) -> Series:
        """Return a magnetometer's calibrated readings [T] in body axes, at the times of the motion: without its lag."""
        rows = self.fit.estimate.sensor_rows(m, all_rows=True)
        series = self.fit.estimate.problem.magnetometers[m]
        raw = 1e-6 * series.values[rows.which] - self.offset_T(m) - rows.current @ self.current_T(m)
        lag_s = float(self.fit.estimate.parameters[self.fit.estimate.problem.layout.lag(m)])
        return replace(series, time_s=series.time_s[rows.which] - lag_s, values=raw @ np.linalg.inv(self.matrix(m)).T)

    def corrected_T(self, m: int) -> FloatArray:
        """Return the calibrated readings (n, 3) of a magnetometer during the inertial readings, body axes."""
        return self.corrected(m).values

    def array(self) -> SensorArray:
        """Return the magnetometer as an array in body axes, with its calibration.

        Raises ValueError for several magnetometers: their places are unknown.
        """
        noise = self.fit.estimate.problem.noise.white_uT
        sensors = []
        for m, series in enumerate(self.log.magnetometers):
            scale = tuple(tuple(float(x) for x in row) for row in self.matrix(m))
            x, y, z = (float(one) for one in self.offset_T(m))
            calibration = Calibration(scale, (x, y, z))
            noise_T = 1e-6 * float(noise[m])
            sensors.append(Sensor(series.name, "vector", (0.0, 0.0, 0.0), noise_T, calibration=calibration))
        # The array file of a single sensor states how large the field common to all sensors may be.
        return SensorArray(tuple(sensors), common_field_T=_LARGEST_FIELD_T if len(sensors) == 1 else None)

    @property
    def entries(self) -> list[dict[str, Any]]:
        """Terms: name, value, sigma, unit, determined, manoeuvre."""
        terms = self.terms
        return [
            {
                "name": name,
                "value": float(value),
                "sigma": float(sigma),
                "unit": unit,
                "determined": bool(known),
                "manoeuvre": words or None,
            }
            for name, value, sigma, unit, known, words in zip(
                terms.names, terms.values, terms.sigma, terms.units, terms.determined, self.manoeuvres, strict=True
            )
        ]

    def report(self) -> dict[str, Any]:
        """Return the JSON object that ``adcs calibrate-log --json`` prints."""
        estimate = self.fit.estimate
        modulus, down = np.linalg.norm(estimate.field_uT[0]), -estimate.field_uT[0][2]
        return {
            "terms": self.entries,
            "undetermined": self.undetermined,
            "flags": list(self.flags),
            "field_nT": 1e3 * float(modulus),
            "inclination_deg": math.degrees(math.asin(down / modulus)),
            "duration_s": float(np.ptp(self.log.time_s)),
            "magnetometers": [
                {
                    "id": series.name,
                    "rotation": nearest_rotation(self.fit.mountings[m].T)[1],
                    "residual_nT": 1e3 * float(np.sqrt(np.mean(estimate.rows[m].residual ** 2))),
                    "rows": len(series.time_s),
                    "rows_used": len(estimate.rows[m].which),
                }
                for m, series in enumerate(estimate.problem.magnetometers)
            ],
        }

    def table(self) -> str:
        """Return the terms with σ as text; those that are not determined come last, with their manoeuvre."""
        rows = [["term", "value", "σ", "unit"]]
        missing: dict[str, list[str]] = {}
        for entry in self.entries:
            if entry["determined"]:
                rows.append([entry["name"], *by_sigma(entry["value"], entry["sigma"]), entry["unit"]])
            else:
                missing.setdefault(str(entry["manoeuvre"]), []).append(f"{entry['name']} (σ {entry['sigma']:.2g})")
        lines = align(rows, left=1) if len(rows) > 1 else []
        for manoeuvre, names in missing.items():
            lines += [f"not determined: {', '.join(names)}", f"  to determine: {manoeuvre}"]
        return "\n".join(lines)


def calibrate_log(
    log: VehicleLog, *, field_T: ArrayLike | None = None, field_error_T: float = MODEL_ERROR_T
) -> LogCalibration:
    """Calibrate magnetometers, gyro and accelerometer jointly from a flight or drive.

    The gyro gives the attitude; its bias, scales and axes are estimated. The accelerometer gives the tilt, and
    accelerations of the vehicle are unknown. The magnetometers turn in a field that is constant in the world. Their
    noise, slow errors and the random walk of the attitude maximise the likelihood. Parts of the log that do not fit
    this model are excluded and flagged.

    Parameters
    ----------
    log : VehicleLog
        Readings of the vehicle.
    field_T : array_like, shape (3,), optional
        Field of the Earth at the place of the log: east, north, up. Without it the scale is not determined.
    field_error_T : float
        Standard deviation of a component of this field.

    Returns
    -------
    LogCalibration
        Terms with σ, those that are not determined, and doubts.

    Raises
    ------
    ValueError
        The field has another shape, or a magnetometer has fewer than ten readings during the inertial readings, equal
        readings, or a reversed axis.

    Examples
    --------
    >>> import adcs
    >>> import sims
    >>> flight = sims.simulate_flight(2, sims.FlightSettings(duration_s=30.0, inertial_Hz=50.0))
    >>> found = adcs.calibrate_log(flight.log, field_T=sims.FlightSettings().field_T)
    >>> bool(abs(found.current_T(0) - flight.current_T_A).max() < 20e-9)
    True
    """
    if field_T is not None and np.shape(field_T) != (3,):
        raise ValueError(f"Input field_T must have shape (3,); instead received {np.shape(field_T)}.")
    field = FieldPrior() if field_T is None else FieldPrior.of(np.asarray(field_T, np.float64), field_error_T)
    usable = [_usable(one, log) for one in log.magnetometers]
    try:
        fit = fit_log(replace(log, magnetometers=tuple(series for series, _ in usable)), field)
    except np.linalg.LinAlgError:
        raise ValueError(
            "Input log must have readings that fit one motion; instead received others. Check units."
        ) from None
    problem = fit.estimate.problem
    ranges = np.array([one.span for one in problem.currents])
    terms = terms_of(
        problem.layout,
        fit.estimate.parameters,
        fit.solution.covariance,
        problem.prior_sigma,
        fit.mountings,
        field,
        ranges,
    )
    names = [one.name for m, one in enumerate(problem.magnetometers) if _contradicts(fit, m)]
    terms = terms.without(names) if fit.converged else terms.without()
    doubts = [sentence for _, sentences in usable for sentence in sentences]
    return LogCalibration(log, fit, terms, tuple(advice(fit, terms)), (*doubts, *_flags(fit, terms)))


def _usable(series: Series, log: VehicleLog) -> tuple[Series, list[str]]:
    """Return a magnetometer's readings without those that are stuck, and sentences on what is missing."""
    known = series.finite()
    stuck = known.stuck_parts() if len(known.values) else []
    rest = known.outside(stuck)
    if not len(rest.values):
        return known, []
    words = "{} keeps one value from {:.1f} to {:.1f} s; these readings are ignored"
    sentences = [words.format(series.name, *part) for part in stuck]
    silent = known.silent_parts(float(log.time_s[0]), float(log.time_s[-1]))
    return rest, sentences + [f"{series.name} has no readings from {a:.1f} to {b:.1f} s" for a, b in silent]


def _contradicts(fit: LogFit, m: int) -> bool:
    """Return True for a magnetometer whose noise is far too large: it measures another motion or another field."""
    estimate = fit.estimate
    return bool(estimate.problem.noise.white_uT[m] > _LARGE_NOISE * np.linalg.norm(estimate.field_uT[0]))


def _flags(fit: LogFit, terms: Terms) -> Iterator[str]:
    """Yield sentences on doubts."""
    estimate, data = fit.estimate, fit.estimate.problem.inertial
    if not fit.converged:
        yield "the fit did not converge: check place, units and axes; no term is determined"
    if not estimate.problem.field.is_known:
        yield f"the modulus of the field is not known, so neither is the scale: {PLACE}"
    for m, series in enumerate(estimate.problem.magnetometers):
        name = series.name
        matrix = estimate.parameters[estimate.problem.layout.matrix(m)].reshape(3, 3)
        _, symmetric, turn = soft_iron(matrix, fit.mountings[m])
        if _contradicts(fit, m):
            yield (
                f"{name} contradicts gyro and accelerometer by {1e3 * estimate.problem.noise.white_uT[m]:.0f} nT,"
                " expected less than a tenth of the field: check signs, axes, units and clocks of all sensors"
            )
            continue
        lag_s = float(estimate.parameters[estimate.problem.layout.lag(m)])
        if abs(lag_s) > _LARGE_LAG_S:
            yield f"{name} lags by {1e3 * lag_s:.0f} ms, which no parameter of an autopilot corrects: check its clock"
        number, word = nearest_rotation(fit.mountings[m].T)
        if number:
            yield (
                f"{name} is turned against the gyro by {word}: set CAL_MAG{m}_ROT = {number} (PX4) or"
                f" COMPASS_ORIENT{m + 1 if m else ''} = {number} (ArduPilot)"
            )
        angle = math.degrees(float(np.linalg.norm(turn)))
        if angle > _TURNED_DEG and terms.are_known(name, "axes"):
            yield f"{name} is turned by {angle:.0f}° against the nearest usual mounting"
        if np.abs(symmetric - np.eye(3)).max() > _LARGE_SOFT_IRON and terms.are_known(name, "soft iron"):
            yield f"{name} has soft iron of more than {100.0 * _LARGE_SOFT_IRON:.0f} %: check its unit and its axes"
        parts = _parts(fit.disturbed[m])
        for begin, end in parts[:3]:
            at = data.time_s[data.knots[[begin, end]]]
            yield f"{name} is disturbed from {at[0]:.1f} to {at[1]:.1f} s, as by a magnet nearby; this part is ignored"
        if len(parts) > 3:
            yield f"{name} is disturbed in {len(parts) - 3} further parts of the log, which are ignored"
    if data.in_gap.any():
        yield f"gyro or accelerometer have gaps within {data.span_s[data.in_gap].sum():.0f} s of the log"
    if not estimate.problem.currents:
        yield (
            "the log has no current or throttle: fields of motors, if there are any, are in the offsets, and no σ"
            " counts them"
        )
    for series in estimate.problem.currents:
        if (rate := (len(series.time_s) - 1) / max(float(np.ptp(series.time_s)), 1e-9)) < _SLOW_CURRENT_Hz:
            few = f"{series.name} has {rate:.1f} readings a second, expected {_SLOW_CURRENT_Hz:g}"
            yield f"{few}: its field is less certain than σ"


def _parts(mask: Any) -> list[tuple[int, int]]:
    """Return first and last knot of each run of marked intervals."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(begin), int(end)) for begin, end in zip(edges[::2], edges[1::2], strict=True)]
