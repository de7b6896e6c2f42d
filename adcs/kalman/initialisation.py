r"""Initialisation of a filter without a known attitude.

A multiplicative filter that starts tens of degrees off may never converge: its first updates are linearised at the
wrong attitude, and its covariance becomes too small. With a star tracker, or with two directions, the first readings
fix the attitude (:func:`vector_start`, Wahba's problem, :func:`adcs.attitude_of_vectors`). With one direction, or two
that nearly coincide, the rotation about it is open: filters then start at equally spaced angles, and the one with the
most likely innovations is chosen (:func:`any_start`).

A magnetometer alone also leaves the rate about the field and the torques open. A filter with a large deviation of the
rate diverges if the satellite is nearly at rest; one with a small deviation diverges if it tumbles. Both are tried.
Then all angles start again from the torques and the dipole at the end of the best filter, as long as the fit improves.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.kalman.error_state import OPEN_RAD, RATE_RAD_S, FilterSettings, FilterStart, SensorSet, concatenate_starts
from adcs.kalman.mekf import complete_start, deviations, run_filter
from adcs.quaternion import rotate_back
from adcs.satellite.dynamics import absolute_rate
from adcs.satellite.telemetry import Record, is_read, part
from adcs.satellite.wahba import attitude_of_vectors
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

AGAIN = 10.0
"""Standard deviations of a start over those of its readings; the filter uses the same readings again."""
WINDOW_S, ALONE_S = 300.0, 3000.0
"""Duration of readings that decide between hypotheses, without and with a magnetometer alone."""
RATES_ALONE = (1.0, 0.2, 0.04)
"""Competing deviations of the rate with a magnetometer alone, as parts of the largest: from tumbling to rest."""
ROUNDS = 6
"""Largest number of restarts with a magnetometer alone."""
BETTER = 10.0
"""Smallest decrease of the misfit for which a restart is used."""
KNOWN_RAD = math.radians(75.0)
"""Largest standard deviation of a known axis of a start: 10° by the readings themselves."""


def vector_start(record: Record, settings: FilterSettings, rate_rad_s: float = RATE_RAD_S) -> FilterStart:
    """Return a start from the readings of the first instant alone.

    ``rate_rad_s``: standard deviation of each component of the rate against the orbital frame; a gyro's reading is used
    instead if there is one. Returns: the standard deviation is 2 rad about an axis that the readings leave open, and
    :data:`AGAIN` times that of the readings elsewhere.
    """
    used, readings, around = settings.sensors, record.readings, record.environment
    # At one instant the error of the field model acts as noise; constant errors do not average out.
    sigma = deviations(record, replace(settings, sensors=settings.sensors.drop("field-model")))
    constant_T = _calibration_deviation(settings, np.linalg.norm(record.environment.b_orbital_T[:, 0], axis=-1))
    b_orbital, b = around.b_orbital_T[:, 0], readings.field_T[:, 0]
    length_T = np.linalg.norm(b_orbital, axis=-1)
    runs = len(b)
    seen_field = is_read(b) & used.magnetometer
    seen_sun = is_read(readings.sun[:, 0]) & used.sun
    field = np.where(seen_field[:, None], b, np.nan)
    sun = np.where(seen_sun[:, None], readings.sun[:, 0], np.nan)
    directions = [sun, field], [around.sun_orbital[:, 0], b_orbital]
    q = attitude_of_vectors(*directions, [sigma[3], np.hypot(sigma[2], constant_T) / length_T]).q
    for body, reference in zip(*directions, strict=True):  # one direction, or both on one line
        open_runs = np.isnan(q[:, 0]) & is_read(body)
        q[open_runs] = quaternion.turned_onto(quaternion.IDENTITY, body[open_runs], reference[open_runs])
    q[np.isnan(q[:, 0])] = quaternion.IDENTITY
    seen_star = is_read(readings.star[:, 0]) & used.star
    q[seen_star] = readings.star[seen_star, 0]
    information = np.tile(np.eye(3) * (2.0 / OPEN_RAD) ** 2, (runs, 1, 1))
    for seen, v, noise in (
        (seen_field, rotate_back(q, b_orbital), np.hypot(AGAIN * sigma[2], constant_T)),
        (seen_sun, rotate_back(q, around.sun_orbital[:, 0]), np.full(runs, AGAIN * sigma[3])),
    ):
        H = 2.0 * cross_matrix(v) / noise[:, None, None]
        information[seen] += (H.mT @ H)[seen]
    W = readings.star_whitening[seen_star, 0] / (AGAIN * sigma[0])
    information[seen_star] += W.mT @ W
    w = absolute_rate(q, np.zeros((runs, 3)), around.orbital_rate_rad_s[:, 0])
    rate_variance = np.full(runs, rate_rad_s**2)
    if used.gyro:
        read = is_read(readings.gyro_rad_s[:, 0])
        w[read] = readings.gyro_rad_s[read, 0]
        bias_rad_s = settings.gyro_bias_sigma_rad_s if "gyro-bias" in used.states else 0.0
        rate_variance[read] = (AGAIN * sigma[1]) ** 2 + bias_rad_s**2
    covariance = np.zeros((runs, 6, 6))
    covariance[:, :3, :3] = np.linalg.inv(information)
    covariance[:, 3:, 3:] = rate_variance[:, None, None] * np.eye(3)
    return FilterStart(quaternion.normalised(q), w, covariance)


def _calibration_deviation(settings: FilterSettings, length_T: FloatArray) -> FloatArray:
    """Return the deviation per component that the magnetometer's states add to fields of some lengths."""
    states = settings.sensors.states
    bias_T = settings.field_bias_sigma_T if "field-bias" in states else 0.0
    gain = np.hypot(settings.field_gain_sigma, settings.field_axes_sigma_rad) if "field-gain" in states else 0.0
    return np.hypot(bias_T, gain * length_T)


def first_observed_row(record: Record, used: SensorSet, *, with_gyro: bool) -> int:
    """Return the first row of the first run with a reading of the attitude, and of the gyro if asked."""
    seen = {name: there[0] for name, there in record.readings.seen.items()}
    told = np.any([seen[name] for name in used.sensors.split("+") if name != "gyro"], axis=0)
    rows = np.flatnonzero(told & seen["gyro"] if with_gyro else told)
    if not rows.size:
        raise ValueError(f"Input record must have a reading of the attitude by {used.sensors}; instead received none.")
    return int(rows[0])


def largest_deviation_rad(start: FilterStart) -> FloatArray:
    """Return the largest standard deviation of each start's attitude, as an angle, shape (runs,)."""
    return 2.0 * np.sqrt(np.linalg.eigvalsh(start.covariance[:, :3, :3])[:, -1])


class _Trial(NamedTuple):
    """Start of one run, its fit to a window, and optional states and P at the end of the window.

    ``misfit``: minus twice the log-likelihood of the readings.
    """

    start: FilterStart
    misfit: float
    optional: dict[str, FloatArray]
    P: FloatArray


def any_start(record: Record, settings: FilterSettings, turns: int = 36, rate_rad_s: float = RATE_RAD_S) -> FilterStart:
    """Return a start from any attitude: the best hypothesis where :func:`vector_start` leaves an axis open.

    ``turns``: number of hypotheses, at equal angles about the open axis. The first :data:`WINDOW_S` of the record, or
    :data:`ALONE_S` with a magnetometer alone, decide between them. ``rate_rad_s``: as in :func:`vector_start`; with a
    magnetometer alone smaller rates (:data:`RATES_ALONE`) compete too. Returns: the deviation about the open axis is
    the distance between hypotheses; with a magnetometer alone the start has the optional states too.
    """
    start = vector_start(record, settings, rate_rad_s)
    open_runs = np.flatnonzero(largest_deviation_rad(start) > KNOWN_RAD)
    # The first reading of a star tracker corrects any attitude: its residual is exact, not linearised.
    if settings.sensors.star or not open_runs.size:
        return start
    variances, axes = np.linalg.eigh(start.covariance[open_runs, :3, :3])
    if (2.0 * np.sqrt(variances[:, 1]) > KNOWN_RAD).any():
        raise ValueError("Input record must have a direction at the first instant of every run; instead one has none.")
    spacing = 2.0 * math.pi / turns
    angles = spacing * np.arange(turns)
    chosen = [start.select_runs(np.array([run])) for run in range(len(start.q))]
    for run, across in zip(open_runs, axes, strict=True):
        repeated, axis = np.full(turns, run), across[:, 2]
        narrow = _narrow(start, repeated, np.tile(axis, (turns, 1)), spacing)
        turned = quaternion.multiply(start.q[run], quaternion.exp(angles[:, None] * axis))
        search = _find_likeliest_alone if settings.sensors.sensors == "mag" else _find_likeliest
        chosen[run] = search(record, settings, replace(narrow, q=turned), repeated).start
    return concatenate_starts(chosen)


def choose_start(record: Record, settings: FilterSettings, start: FilterStart) -> FilterStart:
    """Return a given start, or with a magnetometer alone :func:`any_start` if it fits the readings better.

    Errors of some degrees and of 0.1 °/s can make such a filter diverge. It observes the rotation about the field late,
    by equations of motion that are linearised at its estimate.
    """
    if settings.sensors.sensors != "mag":
        return start
    rivals = complete_start(settings, start), any_start(record, settings)
    chosen = []
    for run in range(len(start.q)):
        only = np.array([run])
        tried = [_find_likeliest(record, settings, rival.select_runs(only), only) for rival in rivals]
        chosen.append(min(tried, key=lambda one: one.misfit).start)
    return concatenate_starts(chosen)


def _find_likeliest(
    record: Record, settings: FilterSettings, hypotheses: FilterStart, runs: NDArray[np.intp]
) -> _Trial:
    """Return the likeliest hypothesis of one run, which ``runs`` repeats for each hypothesis."""
    used = settings.sensors
    window_s = WINDOW_S if used.sun or used.gyro else ALONE_S
    n = 1 + round(min(window_s / record.dt_s, record.momentum_Nms.shape[1] - 1))
    # Without a gate, because readings that do not fit distinguish the hypotheses.
    tracks = run_filter(part(record, runs, slice(n)), replace(settings, gate=0.0), hypotheses)
    misfit = np.nansum(tracks.nis + tracks.log_det, axis=(1, 2))
    # A filter that has overflowed has no innovations, and must not win for that.
    misfit[~np.isfinite(tracks.q[:, -1]).all(axis=-1)] = np.inf
    best = np.array([np.where(np.isfinite(misfit), misfit, np.inf).argmin()])
    optional = {name: values[best, -1] for name, values in tracks.optional.items()}
    return _Trial(hypotheses.select_runs(best), float(misfit[best[0]]), optional, tracks.covariance[best, -1])


def _find_likeliest_alone(
    record: Record, settings: FilterSettings, hypotheses: FilterStart, runs: NDArray[np.intp]
) -> _Trial:
    """Return the likeliest hypothesis with a magnetometer alone.

    Several deviations of the rate compete, then restarts from the estimated torques.
    """
    used, tried = settings.sensors, []
    for share in RATES_ALONE:
        covariance = hypotheses.covariance.copy()
        covariance[:, 3:, 3:] *= share**2
        rivals = complete_start(settings, replace(hypotheses, covariance=covariance))
        tried.append((_find_likeliest(record, settings, rivals, runs), rivals))
    best, rivals = min(tried, key=lambda one: one[0].misfit)
    decay = settings.decay(record.dt_s)
    lasting = [name for name in used.states if (decay[used.slice_of(name)] == 1.0).all()]
    places = np.concatenate([np.arange(0), *(np.arange(used.size)[used.slice_of(name)] for name in lasting)])
    block = np.ix_(np.arange(len(runs)), places, places)
    for _ in range(ROUNDS if lasting else 0):
        covariance = rivals.covariance.copy()
        covariance[block] = AGAIN**2 * best.P[:, places[:, None], places]
        found = {name: np.repeat(best.optional[name], len(runs), axis=0) for name in lasting}
        rivals = replace(rivals, covariance=covariance, optional={**rivals.optional, **found})
        again = _find_likeliest(record, settings, rivals, runs)
        if not again.misfit < best.misfit - BETTER:
            break
        best = again
    return best


def _narrow(start: FilterStart, runs: NDArray[np.intp], axis: FloatArray, deviation_rad: float) -> FilterStart:
    """Return runs of a start with a new deviation about an axis (m, 3), an eigenvector of the covariance."""
    covariance = start.covariance[runs].copy()
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    along = (0.5 * deviation_rad) ** 2 * axis[:, :, None] * axis[:, None, :]
    covariance[:, :3, :3] = across @ covariance[:, :3, :3] @ across + along
    return FilterStart(start.q[runs], start.w[runs], covariance)
