"""Noise of sensors at rest by the Allan deviation: white, flicker and random walk."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arrays.io.errors import naming
from arrays.typing import FloatArray
from magloc.logs.channels import Log
from magloc.logs.sensors import VectorReadings, find_sensors, readings_vary
from magloc.logs.time_base import GAP_STEPS

_FEWEST_ROWS = 200
_FEWEST_TIMES = 5  # averaging times of a fit
_MOST_SHARE = 5  # of a record that is averaged at most: 1 / 5
_MODEL_ERROR = 0.2  # of the variance, relative, as no sensor is only white, flicker and walk
_CLOSE = 0.3  # least misfit of the logarithm of the variance
_SURE = 3.0  # standard deviations from which on a term is stated
_ROUNDS = 10
_HOUR_S = 3600.0
_REST_RAD_S, _MARGIN_S = math.radians(3.0), 0.5
_LOG = logging.getLogger(__name__)
_DECADE = math.log(10.0) / (2.0 * math.log(2.0))  # variance of flicker per decade over its Allan variance


@dataclass(frozen=True, eq=False)
class RestNoise:
    """Noise of one sensor at rest, in the unit of its readings.

    Attributes
    ----------
    name : str
        Channel of the first axis.
    unit : str
    tau_s, deviation : ndarray, shapes (m,) and (m, k)
        Averaging times, and the Allan deviation of each axis.
    white : float
        Standard deviation of a sample. After a low-pass: of white noise with the same averages.
    flicker : float
        Standard deviation of 1/f noise in every decade of frequency; 0 where the record does not show it.
    walk : float
        Random walk: standard deviation after an hour; 0 where the record does not show it.
    """

    name: str
    unit: str
    tau_s: FloatArray
    deviation: FloatArray
    white: float
    flicker: float
    walk: float

    def model(self) -> FloatArray:
        """Return the Allan deviation (m,) of the three parts."""
        white, walk = self.white**2 * self.tau_s[0] / self.tau_s, self.walk**2 / _HOUR_S * self.tau_s / 3.0
        return np.asarray(np.sqrt(white + self.flicker**2 / _DECADE + walk))


def allan_deviation(values: FloatArray, rate_Hz: float) -> tuple[FloatArray, FloatArray]:
    """Return averaging times (m,) [s] in octaves, and the overlapping Allan deviation (m, k) of samples (n, k)."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - values.mean(axis=0), axis=0)])
    lengths = 2 ** np.arange(int(math.log2(max(len(values) // _MOST_SHARE, 1))) + 1)
    found = []
    for n in lengths:
        second = sums[2 * n :] - 2.0 * sums[n:-n] + sums[: -2 * n]
        found.append(np.sqrt(0.5 * np.mean((second / n) ** 2, axis=0)))
    return lengths / rate_Hz, np.array(found)


def rest_noise(readings: VectorReadings, unit: str) -> RestNoise:
    """Return the noise of a sensor at rest; three axes count as three records of the same noise.

    The Allan variance is the sum of a part that falls with the averaging time (white), a constant one (flicker) and one
    that grows (random walk).

    Raises
    ------
    ValueError
        There are too few readings without a gap, or all are equal.
    """
    step_s = np.diff(readings.time_s)
    usual_s = float(np.median(step_s)) if len(step_s) else 0.0
    ends = np.flatnonzero(np.concatenate([step_s > GAP_STEPS * usual_s, [True]])) + 1
    begins = np.concatenate([[0], ends[:-1]])
    longest = int(np.argmax(ends - begins))
    values = readings.values[begins[longest] : ends[longest]]
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < _FEWEST_ROWS:
        expected = f"{_FEWEST_ROWS} readings or more without a gap, at rest"
        raise ValueError(f"Input {readings.name} must have {expected}; instead received {len(values)}.")
    if not readings_vary(values):
        expected = "readings that vary at rest: their steps must be finer than the noise"
        raise ValueError(
            f"Input {readings.name} must have {expected}; instead received {values[0].tolist()} in all rows."
        )
    tau_s, deviation = allan_deviation(values, 1.0 / usual_s)
    variance = np.mean(deviation**2, axis=1)
    freedoms = 1.5 * values.size * usual_s / tau_s
    parts = np.stack([usual_s / tau_s, np.ones_like(tau_s), tau_s / 3.0], axis=1)
    # A sensor with a low-pass is white from its time constant on.
    fits = [_fit_parts(parts[k:], variance[k:], freedoms[k:]) for k in range(max(len(tau_s) - _FEWEST_TIMES, 0) + 1)]
    misfits = [float(np.std(np.log(parts[k:] @ fit / variance[k:]))) for k, fit in enumerate(fits)]
    close = (k for k, misfit in enumerate(misfits) if misfit < _CLOSE)
    white, flicker, walk = fits[next(close, int(np.argmin(misfits)))]
    return RestNoise(
        readings.name,
        unit,
        tau_s,
        deviation,
        math.sqrt(white),
        math.sqrt(_DECADE * flicker),
        math.sqrt(_HOUR_S * walk),
    )


def _fit_parts(parts: FloatArray, variance: FloatArray, freedoms: FloatArray) -> FloatArray:
    """Return the amounts (3,) of three parts (m, 3) of an Allan variance (m,); 0 for one that is not significant."""
    used = [0, 1, 2]
    model = variance
    while True:
        columns = parts[:, used]
        for _ in range(_ROUNDS):
            weights = 1.0 / (np.sqrt(2.0 / freedoms + _MODEL_ERROR**2) * model)
            found = np.linalg.lstsq(columns * weights[:, None], variance * weights, rcond=None)[0]
            model = np.maximum(columns @ found, 0.1 * variance)
        covariance = np.linalg.inv((columns * weights[:, None]).T @ (columns * weights[:, None]))
        ratios = found / np.sqrt(np.diag(covariance))
        least = int(np.argmin(ratios[1:])) + 1 if len(used) > 1 else 0
        if len(used) == 1 or ratios[least] >= _SURE:
            amounts = np.zeros(3)
            amounts[used] = np.maximum(found, np.finfo(float).tiny)
            return amounts
        del used[least]
        model = variance


def array_lines(noise: RestNoise) -> list[str]:
    """Return the keys of a magnetometer in an array file."""
    values = {"noise_nT": noise.white, "flicker_nT": noise.flicker, "drift_nT_rth": noise.walk}
    return [f"{key} = {1e9 * value:.6g}" for key, value in values.items() if value]


def scenario_text(noises: Sequence[RestNoise]) -> str:
    """Return the tables of the sensors in a scenario file of attitude."""
    lines = ["# Measured at rest; tables of a scenario file of adcs."]
    for table, unit, size, keys in (
        ("gyro", "rad/s", math.degrees(1.0), ("noise_deg_s", "bias_walk_deg_s_rts")),
        ("magnetometer", "T", 1e9, ("noise_nT",)),
    ):
        found = next((noise for noise in noises if noise.unit == unit), None)
        if found is not None:
            amounts = (found.white, found.walk / math.sqrt(_HOUR_S))
            lines += ["", f"[sensors.{table}]  # {found.name}"]
            lines += [f"{key} = {size * of:.6g}" for key, of in zip(keys, amounts, strict=False)]
    return "\n".join([*lines, ""])


def log_rest_noise(log: Log) -> tuple[RestNoise, ...]:
    """Return the noise of magnetometers, gyro and accelerometer in the longest rest of a log.

    Raises
    ------
    InputError
        The log has no such sensors, or too few readings of one at rest.
    """
    sensors = find_sensors(log)
    time_s, rate = sensors.gyro.time_s, sensors.gyro.values
    turns = np.linalg.norm(rate - np.nanmedian(rate, axis=0), axis=1) > _REST_RAD_S
    ends_s = np.concatenate([time_s[:1] - _MARGIN_S, time_s[turns], time_s[-1:] + _MARGIN_S])
    longest = int(np.argmax(np.diff(ends_s)))
    begin_s, end_s = ends_s[longest] + _MARGIN_S, ends_s[longest + 1] - _MARGIN_S
    if turns.any():
        _LOG.warning(f"{log.path}: the robot turns; the noise is from {begin_s:.1f} to {end_s:.1f} s")
    named: Sequence[tuple[VectorReadings, str]] = [
        *((each, "T") for each in sensors.magnetometers),
        (sensors.gyro, "rad/s"),
        (sensors.accelerometer, "m/s2"),
    ]
    found = []
    for readings, unit in named:
        within = (readings.time_s >= begin_s) & (readings.time_s <= end_s)
        part = VectorReadings(readings.name, readings.time_s[within], readings.values[within])
        with naming(log.path):
            found.append(rest_noise(part, unit))
    return tuple(found)
