"""Named problems of attitude determination, found in a record and what a filter made of it.

Each is one sentence that says what is degraded or cannot be observed, and for how long. The covariance of the estimates
tells how much, except where the model itself is wrong: there the readings must be compared with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from adcs.kalman.error_state import AttitudeTracks, FilterSettings, SensorSet, State
from adcs.kalman.mekf import deviations, residuals
from adcs.quaternion import rotate_back
from adcs.satellite.sensors import NIS_SIZES, SENSOR_WORDS
from adcs.satellite.telemetry import Record, instants_as_runs, is_read
from arrays.typing import BoolArray, FloatArray
from magloc.navigation.rotations import cross_matrix

COLLINEAR = "Sun and field on one line"
COLLINEAR_RAD = math.radians(20.0)
"""Sun and field nearer to one line than this leave the turn about it badly known: its noise is three times as large."""
GROWS = 1.5
"""Growth of the attitude's deviation, with one direction left, of which it is worth while to speak."""
FALSE_ALARM = 1e-6
"""Probability with which readings that fit their model are called wrong."""
BLOCK = 64
"""Readings over which residuals are summed: what lasts as long as that does not average out."""
SEEN = 0.7
"""Amplitude of an attitude, in deviations of one instant's readings, from which on a filter can tell what moves it."""
PERIODS_S = (100.0, 300.0, 1000.0)
"""Of torques, for which the filter is asked what it would not see."""


class Problem(NamedTuple):
    """What is degraded or cannot be observed, and the instants (n,) at which it is."""

    text: str
    rows: BoolArray


def problems_of(record: Record, estimates: AttitudeTracks) -> tuple[tuple[Problem, ...], ...]:
    """Problems of every run, in the order of the list below; none where nothing is wrong.

    - eclipse, no star tracker reading (over-rate or blinded),
    - Sun and field on one line,
    - one direction with a biased gyro,
    - readings that contradict the rest,
    - a field that does not fit its model: an error of the model, or the satellite's own field,
    - an error of the field's model that is stated, and taken for noise of single readings,
    - innovations that the covariance does not explain,
    - residuals that last: something turns the satellite that is not in the model.
    """
    used = estimates.settings.sensors
    always = np.ones(estimates.q.shape[1], dtype=np.bool_)
    return tuple(
        (
            *_lost_sun(record, used, run),
            *_lost_stars(record, estimates, run),
            *_collinear(record, used, run),
            *_one_vector(record, estimates, run),
            # The estimate is none the worse for a reading that is left out.
            *(Problem(text, ~always) for text in _rejected(estimates, run)),
            *(Problem(text, always) for text in _field_model(record, estimates, run)),
            *(Problem(text, ~always) for text in _error_as_noise(estimates.settings)),
            *(Problem(text, always) for text in _innovations(estimates, run)),
            *(Problem(text, always) for text in _lasting(record, estimates, run)),
        )
        for run in range(len(estimates.q))
    )


def warnings_of(record: Record, estimates: AttitudeTracks) -> tuple[tuple[str, ...], ...]:
    """Sentences of the problems of every run."""
    return tuple(tuple(problem.text for problem in of_run) for of_run in problems_of(record, estimates))


def collinear_rows(record: Record, used: SensorSet, run: int) -> BoolArray:
    """Where Sun and field, which alone tell the attitude, are on one line, shape (n,)."""
    if used.star or not (used.magnetometer and used.sun):
        return np.zeros(record.momentum_Nms.shape[1], dtype=np.bool_)
    near = record.environment.separation_rad[run] < COLLINEAR_RAD
    return np.asarray(near & is_read(record.readings.sun[run]))


def _lost_sun(record: Record, used: SensorSet, run: int) -> list[Problem]:
    if not used.sun:
        return []
    missing = ~is_read(record.readings.sun[run])
    dark = missing & ~record.environment.sunlit[run]
    problems = []
    if dark.any():
        problems.append(Problem(f"eclipse: no Sun for {_seconds(dark, record)}; attitude is degraded", dark))
    if (missing & ~dark).any():
        outside = missing & ~dark
        problems.append(Problem(f"Sun outside of all heads' fields for {_seconds(outside, record)}", outside))
    return problems


def _lost_stars(record: Record, estimates: AttitudeTracks, run: int) -> list[Problem]:
    if not estimates.settings.sensors.star:
        return []
    missing = ~is_read(record.readings.star[run])
    limit = record.satellite.star_tracker.rate_limit_rad_s
    fast = missing & (np.linalg.norm(estimates.w[run], axis=-1) > limit)
    blind = missing & ~fast
    problems = []
    if fast.any():
        text = f"star tracker over-rate: above {math.degrees(limit):g}°/s for {_seconds(fast, record)}"
        problems.append(Problem(text, fast))
    if blind.any():
        problems.append(Problem(f"star tracker blinded by Sun or Earth for {_seconds(blind, record)}", blind))
    return problems


def _collinear(record: Record, used: SensorSet, run: int) -> list[Problem]:
    near = collinear_rows(record, used, run)
    if not near.any():
        return []
    least = math.degrees(float(record.environment.separation_rad[run, near].min()))
    known = "known by the gyro only" if used.gyro else "not observable there"
    text = f"{COLLINEAR} within {least:.0f}° for {_seconds(near, record)}: the turn about it is {known}"
    return [Problem(text, near)]


def _one_vector(record: Record, estimates: AttitudeTracks, run: int) -> list[Problem]:
    """Compare the deviation of the attitude where one direction is left with that before, if its bias is a state."""
    used = estimates.settings.sensors
    if used.star or not used.gyro:
        return []
    readings = record.readings
    seen = np.zeros(readings.sun.shape[1], dtype=np.int64)
    if used.magnetometer:
        seen += is_read(readings.field_T[run])
    if used.sun:
        seen += is_read(readings.sun[run])
    alone = seen < 2
    if not alone.any():
        return []
    begins = f"one direction and a gyro for {_seconds(alone, record)}"
    if "gyro-bias" not in used.states:
        return [Problem(f"{begins}: a bias of the gyro is not in the state and would accumulate", alone)]
    sigma_deg = np.degrees(2.0 * estimates.sigma[run, :, :3].max(axis=-1))
    firsts = np.flatnonzero(alone & ~np.concatenate([[False], alone[:-1]]))
    growth = [(_next_largest(sigma_deg, alone, first), sigma_deg[max(first - 1, 0)]) for first in firsts.tolist()]
    largest, before = max(growth, key=lambda pair: pair[0] / pair[1])
    if largest < GROWS * before:
        return []
    text = f"{begins}: the turn about it is known by the gyro only, 1σ grows from {before:.2g}° to {largest:.2g}°"
    return [Problem(text, alone)]


def _next_largest(sigma: FloatArray, alone: BoolArray, first: int) -> float:
    """Largest deviation from an instant to the last of its gap."""
    ends = np.flatnonzero(~alone[first:])
    return float(sigma[first : first + ends[0] if ends.size else None].max())


def _rejected(estimates: AttitudeTracks, run: int) -> list[str]:
    sentences = []
    for rejected, nis, word in zip(estimates.rejected[run].T, estimates.nis[run].T, SENSOR_WORDS.values(), strict=True):
        if rejected.any():
            of_all = int(np.isfinite(nis).sum())
            sentences.append(
                f"{rejected.sum()} of {of_all} readings of the {word} contradict the rest and are not used"
            )
    return sentences


def _field_model(record: Record, estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare what does not depend on the attitude: the field's modulus, and its angle with the Sun."""
    settings = estimates.settings
    used = settings.sensors
    if not used.magnetometer or {"field-bias", "field-model", "field-gain"} & set(used.states):
        return []
    around, readings = record.environment, record.readings
    sigma = deviations(record, settings)
    rejected = estimates.rejected[run, :, 2:]
    b = np.where(rejected[:, :1], np.nan, readings.field_T[run])
    sun = np.where(rejected[:, 1:], np.nan, readings.sun[run])
    model = around.b_orbital_T[run]
    length_T = np.linalg.norm(model, axis=-1)
    checks = [(np.linalg.norm(b, axis=-1) - length_T, np.full(len(b), sigma[2]))]
    if used.sun:
        along = np.sum(model * around.sun_orbital[run], axis=-1)
        across_T = np.sqrt(np.maximum(length_T**2 - along**2, 0.0))
        checks.append((np.sum(b * sun, axis=-1) - along, np.hypot(sigma[2], sigma[3] * across_T)))
    total, numbers, largest_T = 0.0, 0, 0.0
    for residual, deviation in checks:
        seen = np.isfinite(residual)
        if seen.any():
            mean_T = float(residual[seen].mean())
            total += mean_T**2 / float(np.mean(deviation[seen] ** 2)) * int(seen.sum())
            numbers += 1
            largest_T = max(largest_T, abs(mean_T))
    if numbers == 0 or total <= chi2.isf(FALSE_ALARM, numbers):
        return []
    effect = "the star tracker keeps the attitude" if used.star else "attitude is degraded"
    return [
        f"field differs from its model by {1e9 * largest_T:.0f} nT in modulus or angle with the Sun: error of the "
        f"model or of the orbit, bias or the satellite's own field; {effect}"
    ]


def _error_as_noise(settings: FilterSettings) -> list[str]:
    used = settings.sensors
    if not (used.magnetometer and settings.field_error_T > 0.0) or used.star or "field-model" in used.states:
        return []
    return [
        f"an error of the field's model of {1e9 * settings.field_error_T:.0f} nT is taken for noise, which averages "
        "out: the deviations are too small for one that lasts, which the state field-model is for"
    ]


def _innovations(estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare the sum of NIS of what is used over the second half of the run, after the start, with its χ²."""
    used = np.where(estimates.rejected[run], np.nan, estimates.nis[run])
    nis = used[len(used) // 2 :]
    numbers = int((np.isfinite(nis) * list(NIS_SIZES.values())).sum())
    total = float(np.nansum(nis))
    if numbers == 0 or total <= chi2.isf(FALSE_ALARM, numbers):
        return []
    return [f"innovations are {math.sqrt(total / numbers):.1f} times what the covariance explains: the model is wrong"]


def _lasting(record: Record, estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare sums of residuals over blocks of readings with what white ones would have.

    After its update a filter's residual is RS⁻¹ times the innovation, as white as that; a torque that the process noise
    does not allow leaves a part that lasts, far below the noise of one reading, where NIS is blind to it.
    """
    total, numbers = 0.0, 0
    for sensor, of_sensor in residuals_after(record, estimates, run).items():
        rows = of_sensor[len(of_sensor) // 2 :]
        rows = rows[~(np.isnan(rows[:, 0]) | estimates.rejected[run, -len(rows) :, sensor])]
        blocks = rows[: len(rows) // BLOCK * BLOCK].reshape(-1, BLOCK, 3)
        if len(blocks) < 2:
            continue
        # What is constant throughout, process noise can allow for.
        sums = blocks.sum(axis=1) - blocks.sum(axis=1).mean(axis=0)
        variance = np.var(blocks, axis=(0, 1))
        told = variance > 0.0
        total += float(np.sum(sums[:, told] ** 2 / (BLOCK * variance[told])))
        numbers += (len(blocks) - 1) * int(told.sum())
    if numbers == 0 or total <= chi2.isf(FALSE_ALARM, numbers):
        return []
    return [
        f"residuals last for minutes ({math.sqrt(total / numbers):.1f} times white noise over {BLOCK} readings): "
        "a torque or an error that is not in the model; the deviations may be too small"
    ]


def residuals_after(record: Record, estimates: AttitudeTracks, run: int) -> dict[int, FloatArray]:
    """Residuals (n, 3) of a run's readings from its estimates, by the sensor's place; NaN without a reading."""
    each = instants_as_runs(record, run)
    optional = {name: values[run] for name, values in estimates.optional.items()}
    state = State(estimates.q[run], estimates.w[run], optional, estimates.covariance[run])
    return {sensor: residual for sensor, residual, _ in residuals(each, 0, state, estimates.settings.sensors)}


def unseen_torque_Nm(record: Record, estimates: AttitudeTracks, run: int) -> Mapping[float, float]:
    """Largest amplitude [N·m] of a torque of each of some periods that the readings do not show.

    A torque of amplitude J·d and period T moves the attitude by d (T/2π)² and the rate by d T/2π. Below 0.7 deviations
    of one instant's readings, about the axis that they tell worst, no filter can say what moves the satellite, and
    none can know how wrong it is.
    """
    sigma, used = deviations(record, estimates.settings), estimates.settings.sensors
    q, around = estimates.q[run], record.environment
    star = record.readings.star_whitening[run] / (2.0 * sigma[0])
    information = used.star * np.mean(star.mT @ star, axis=0)
    for is_used, model, deviation in (
        (used.magnetometer, around.b_orbital_T[run], sigma[2]),
        (used.sun, around.sun_orbital[run], sigma[3]),
    ):
        if is_used:
            W = cross_matrix(rotate_back(q, model)) / deviation
            information = information + np.mean(W.mT @ W, axis=0)
    largest = float(np.linalg.eigvalsh(record.satellite.body.inertia_kgm2)[-1])
    torque = {}
    for period_s in PERIODS_S:
        w = 2.0 * math.pi / period_s
        of_period = information + np.eye(3) * (used.gyro * (w / sigma[1]) ** 2)
        exact = not np.isfinite(of_period).all()
        sigma_rad = 0.0 if exact else 1.0 / math.sqrt(float(np.linalg.eigvalsh(of_period)[0]))
        torque[period_s] = SEEN * sigma_rad * w**2 * largest
    return torque


def _seconds(rows: BoolArray, record: Record) -> str:
    return f"{rows.sum() * record.dt_s:.0f} s"
