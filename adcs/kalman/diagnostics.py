"""Problems of attitude determination, found in a record and its estimates.

Each problem is one sentence on a degraded or unobservable state, with its duration. The covariance of the estimates
states the size of the effect, unless the model itself is wrong. For wrong models, readings are compared with the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from adcs.environment.sun import earth_radius_rad
from adcs.kalman.error_state import AttitudeState, AttitudeTracks, FilterSettings, SensorSet
from adcs.kalman.mekf import deviations, residuals
from adcs.quaternion import rotate_back
from adcs.satellite.sensors import NIS_SIZES, SENSOR_WORDS, is_blinded, is_in_field
from adcs.satellite.telemetry import Record, instants_as_runs, is_read
from arrays.typing import BoolArray, FloatArray
from magloc.navigation.rotations import cross_matrix

COLLINEAR = "Sun and field on one line"
COLLINEAR_RAD = math.radians(20.0)
"""Angle between the lines of Sun and field below which the noise of the rotation about them is three times as large."""
GROWS = 1.5
"""Least reported growth of the attitude's standard deviation with one direction left."""
FALSE_ALARM = 1e-6
"""Probability of a report on readings that fit their model."""
BLOCK = 64
"""Number of readings per sum of residuals; white noise averages out in it, lasting errors do not."""
SEEN = 0.7
"""Smallest observable amplitude of the attitude, in standard deviations of the readings of one instant."""
_LEAST_WRONG, _RIM = 0.1, 0.05
PERIODS_S = (100.0, 300.0, 1000.0)
"""Periods of the torques for which the smallest observable amplitude is reported."""


class AttitudeProblem(NamedTuple):
    """Sentence about a degraded or unobservable quantity, and the instants (n,) concerned."""

    text: str
    rows: BoolArray


def find_problems(record: Record, estimates: AttitudeTracks) -> tuple[tuple[AttitudeProblem, ...], ...]:
    """Find the problems of each run, in the order of this list.

    - eclipse, no reading of the Sun sensor or of the star tracker, with its reason where the geometry has one,
    - Sun and field on one line,
    - one direction with a biased gyro,
    - readings that contradict the rest,
    - a field that does not fit its model: an error of the model, or the satellite's own field,
    - a stated error of the field model that is treated as white noise,
    - innovations larger than their covariance,
    - correlated residuals: a torque that is not in the model.
    """
    used = estimates.settings.sensors
    always = np.ones(estimates.q.shape[1], dtype=np.bool_)
    return tuple(
        (
            *_sun_gaps(record, estimates, run),
            *_star_gaps(record, estimates, run),
            *_collinearity(record, used, run),
            *_one_vector(record, estimates, run),
            # A rejected reading does not degrade the estimate.
            *(AttitudeProblem(text, ~always) for text in _rejections(estimates, run)),
            *(AttitudeProblem(text, always) for text in _field_model(record, estimates, run)),
            *(AttitudeProblem(text, ~always) for text in _error_as_noise(estimates.settings)),
            *(AttitudeProblem(text, always) for text in _innovations(estimates, run)),
            *(AttitudeProblem(text, always) for text in _correlated_residuals(record, estimates, run)),
        )
        for run in range(len(estimates.q))
    )


def warning_sentences(record: Record, estimates: AttitudeTracks) -> tuple[tuple[str, ...], ...]:
    """Return the sentences of the problems of each run."""
    return tuple(tuple(problem.text for problem in of_run) for of_run in find_problems(record, estimates))


def contradicts_model(record: Record, estimates: AttitudeTracks, run: int) -> bool:
    """Return whether innovations or residuals of a run are larger than the model explains."""
    return bool(_innovations(estimates, run) or _correlated_residuals(record, estimates, run))


def collinear_rows(record: Record, used: SensorSet, run: int) -> BoolArray:
    """Return the instants (n,) at which Sun and field, the only directions, are on one line."""
    if used.star or not (used.magnetometer and used.sun):
        return np.zeros(record.momentum_Nms.shape[1], dtype=np.bool_)
    near = record.environment.separation_rad[run] < COLLINEAR_RAD
    return np.asarray(near & is_read(record.readings.sun[run]))


def _sun_gaps(record: Record, estimates: AttitudeTracks, run: int) -> list[AttitudeProblem]:
    if not estimates.settings.sensors.sun:
        return []
    around, read = record.environment, is_read(record.readings.sun[run])
    missing = _logged(record, run) & ~read
    dark = missing & ~around.sunlit[run]
    sun_body = rotate_back(estimates.q[run], around.sun_orbital[run])
    beside = ~is_in_field(record.satellite.sun_sensor, sun_body).any(axis=-1) & around.sunlit[run]
    outside, unexplained = _split_gaps(missing & ~dark, beside, read)
    reasons = {
        "eclipse: no Sun for {}; attitude is degraded": dark,
        "Sun outside of all heads' fields for {}": outside,
        "no reading of the Sun sensor for {}: neither eclipse nor its heads' fields explain it": unexplained,
    }
    return [AttitudeProblem(text.format(_seconds(at, record, run)), at) for text, at in reasons.items() if at.any()]


def _star_gaps(record: Record, estimates: AttitudeTracks, run: int) -> list[AttitudeProblem]:
    if not estimates.settings.sensors.star:
        return []
    read, tracker = is_read(record.readings.star[run]), record.satellite.star_tracker
    missing = _logged(record, run) & ~read
    limit = tracker.rate_limit_rad_s
    fast = missing & (np.linalg.norm(estimates.w[run], axis=-1) > limit)
    blind, unexplained = _split_gaps(missing & ~fast, is_blinded(tracker, estimates.q[run], *_sky(record, run)), read)
    reasons = {
        f"star tracker over-rate: above {math.degrees(limit):g}°/s for {{}}": fast,
        "star tracker blinded by Sun or Earth for {}": blind,
        "no reading of the star tracker for {}: neither its rate nor Sun or Earth explain it": unexplained,
    }
    return [AttitudeProblem(text.format(_seconds(at, record, run)), at) for text, at in reasons.items() if at.any()]


def _sky(record: Record, run: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return direction to the Sun (n, 3), angular radius of the Earth (n,) and visible part of the Sun (n,)."""
    around = record.environment
    return around.sun_orbital[run], earth_radius_rad(around.position_eci_m[run]), around.illuminated[run]


def _logged(record: Record, run: int) -> BoolArray:
    """Return the instants (n,) of rows of the log, which have a reading; all with at most one sensor."""
    seen = np.stack([there[run] for there in record.readings.seen.values()])
    alone = seen.any(axis=1).sum() < 2
    return np.asarray(seen.any(axis=0) | alone)


def _split_gaps(missing: BoolArray, expected: BoolArray, read: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Split missing readings (n,) into those that the geometry explains, and others.

    The geometry explains none if readings are there where it allows none: the sensor is mounted otherwise. A few
    readings at the rim, where the attitude's error decides, belong to the rest.
    """
    contradicted = (expected & read).sum() > _LEAST_WRONG * expected.sum()
    explained = missing & expected & ~contradicted
    if (missing & ~explained).sum() <= _RIM * explained.sum():
        explained = missing
    return explained, missing & ~explained


def _collinearity(record: Record, used: SensorSet, run: int) -> list[AttitudeProblem]:
    near = collinear_rows(record, used, run)
    if not near.any():
        return []
    least = math.degrees(float(record.environment.separation_rad[run, near].min()))
    known = "known by the gyro only" if used.gyro else "not observable there"
    text = f"{COLLINEAR} within {least:.0f}° for {_seconds(near, record, run)}: the turn about it is {known}"
    return [AttitudeProblem(text, near)]


def _one_vector(record: Record, estimates: AttitudeTracks, run: int) -> list[AttitudeProblem]:
    """Compare the attitude's deviation before and during gaps that leave one direction."""
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
    begins = f"one direction and a gyro for {_seconds(alone, record, run)}"
    if "gyro-bias" not in used.states:
        return [AttitudeProblem(f"{begins}: a bias of the gyro is not in the state and would accumulate", alone)]
    sigma_deg = np.degrees(2.0 * estimates.sigma[run, :, :3].max(axis=-1))
    firsts = np.flatnonzero(alone & ~np.concatenate([[False], alone[:-1]]))
    growth = [(_largest_in_gap(sigma_deg, alone, first), sigma_deg[max(first - 1, 0)]) for first in firsts.tolist()]
    largest, before = max(growth, key=lambda pair: pair[0] / pair[1])
    if largest < GROWS * before:
        return []
    text = f"{begins}: the turn about it is known by the gyro only, 1σ grows from {before:.2g}° to {largest:.2g}°"
    return [AttitudeProblem(text, alone)]


def _largest_in_gap(sigma: FloatArray, alone: BoolArray, first: int) -> float:
    """Return the largest deviation from an instant to the end of its gap."""
    ends = np.flatnonzero(~alone[first:])
    return float(sigma[first : first + ends[0] if ends.size else None].max())


def _rejections(estimates: AttitudeTracks, run: int) -> list[str]:
    sentences = []
    for rejected, nis, word in zip(estimates.rejected[run].T, estimates.nis[run].T, SENSOR_WORDS.values(), strict=True):
        if rejected.any():
            of_all = int(np.isfinite(nis).sum())
            sentences.append(
                f"{rejected.sum()} of {of_all} readings of the {word} contradict the rest and are not used"
            )
    return sentences


def _field_model(record: Record, estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare the field's modulus and its angle with the Sun, which need no attitude, with the model."""
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
        f"model or of the orbit, bias, or the satellite's own field; {effect}"
    ]


def _error_as_noise(settings: FilterSettings) -> list[str]:
    used = settings.sensors
    if not (used.magnetometer and settings.field_error_T > 0.0) or used.star or "field-model" in used.states:
        return []
    return [
        f"an error of the field's model of {1e9 * settings.field_error_T:.0f} nT is taken for noise, which averages "
        "out: the deviations are too small for an error that lasts; add the state field-model"
    ]


def _innovations(estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare the sum of NIS over the second half of the run, after convergence, with its χ²."""
    used = np.where(estimates.rejected[run], np.nan, estimates.nis[run])
    nis = used[len(used) // 2 :]
    numbers = int((np.isfinite(nis) * list(NIS_SIZES.values())).sum())
    total = float(np.nansum(nis))
    if numbers == 0 or total <= chi2.isf(FALSE_ALARM, numbers):
        return []
    return [f"innovations are {math.sqrt(total / numbers):.1f} times what the covariance explains: the model is wrong"]


def _correlated_residuals(record: Record, estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare sums of residuals over blocks of readings with those of white noise.

    The post-fit residual is RS⁻¹ times the innovation, and as white. A torque larger than the process noise leaves a
    correlated part far below the noise of one reading, which NIS does not show.
    """
    total, numbers = 0.0, 0
    for sensor, values in postfit_residuals(record, estimates, run).items():
        rows = values[len(values) // 2 :]
        rows = rows[~(np.isnan(rows[:, 0]) | estimates.rejected[run, -len(rows) :, sensor])]
        blocks = rows[: len(rows) // BLOCK * BLOCK].reshape(-1, BLOCK, 3)
        if len(blocks) < 2:
            continue
        # Process noise explains a constant part.
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


def postfit_residuals(record: Record, estimates: AttitudeTracks, run: int) -> dict[int, FloatArray]:
    """Return post-fit residuals (n, 3) of a run by index of the sensor; NaN without a reading."""
    each = instants_as_runs(record, run)
    optional = {name: values[run] for name, values in estimates.optional.items()}
    state = AttitudeState(estimates.q[run], estimates.w[run], optional, estimates.covariance[run])
    return {sensor: residual for sensor, residual, _ in residuals(each, 0, state, estimates.settings.sensors)}


def unseen_torque_Nm(record: Record, estimates: AttitudeTracks, run: int) -> Mapping[float, float]:
    """Return the largest unobservable torque amplitude [N·m] by period [s].

    A torque of amplitude J·d and period T changes the attitude by d (T/2π)² and the rate by d T/2π. No filter can
    estimate a torque whose effect is below 0.7 standard deviations of one instant's readings about the worst axis.
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


def _seconds(at: BoolArray, record: Record, run: int) -> str:
    """Return the duration of instants (n,) in words: each row of the log lasts until the next one."""
    rows = np.flatnonzero(_logged(record, run))
    lasts = np.diff(record.environment.time_s[rows], append=record.environment.time_s[rows[-1:]] + record.dt_s)
    return f"{lasts[at[rows]].sum():.0f} s"
