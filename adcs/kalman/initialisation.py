r"""Where a filter starts when nobody knows the attitude.

A multiplicative filter that starts tens of degrees off may never find back: its first corrections are linearised at
the wrong place, and its covariance believes them. With a star tracker, or with two directions, the first readings fix
the attitude (:func:`vector_start`, Wahba's problem, :func:`adcs.attitude_of_vectors`). With one
direction, or two that nearly coincide, the turn about it stays open: then filters start at all turns and the one whose
innovations are the most likely is taken (:func:`any_start`).

A magnetometer alone leaves the rate about the field open too, and the torques. A filter that allows for any rate goes
astray where the satellite is nearly at rest, and one that does not where it tumbles: both compete. Then all turns start
again from the torques and the dipole that the best one ended with, as long as that explains the readings better.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.kalman.error_state import OPEN_RAD, RATE_RAD_S, FilterSettings, SensorSet, Start, joined_starts
from adcs.kalman.mekf import deviations, run_filter, whole_start
from adcs.quaternion import rotate_back
from adcs.satellite.dynamics import absolute_rate
from adcs.satellite.telemetry import Record, is_read, part
from adcs.satellite.wahba import attitude_of_vectors
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

AGAIN = 10.0
"""Standard deviations of a start are those of its readings times this: the filter takes the same readings again."""
WINDOW_S, ALONE_S = 300.0, 3000.0
"""How much of a record tells which turn about the first direction is right, and with a magnetometer alone, for which
the field must turn along the orbit."""
RATES_ALONE = (1.0, 0.2, 0.04)
"""Deviations of the rate that compete with a magnetometer alone, as parts of the largest: from tumbling to rest."""
ROUNDS = 6
"""How often a magnetometer alone starts again at most."""
BETTER = 10.0
"""Misfit by which a start must be better than the one before."""
KNOWN_RAD = math.radians(75.0)
"""An attitude is known where no axis of its start has a larger standard deviation: 10° by the readings themselves."""


def vector_start(record: Record, settings: FilterSettings, rate_rad_s: float = RATE_RAD_S) -> Start:
    """Start from the readings of the first instant alone.

    ``rate_rad_s``: standard deviation of each component of the rate against the orbital frame; the gyro's reading is
    used where the set has one. Returns: the covariance tells where the readings leave a turn open: standard deviation 2
    rad about it. Elsewhere it is wider than the readings by :data:`AGAIN`.
    """
    used, readings, around = settings.sensors, record.readings, record.environment
    # An error that is a state of the filter is noise of one instant, but no more where it is constant.
    sigma = deviations(record, replace(settings, sensors=settings.sensors.without("field-model")))
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
    for body, reference in zip(*directions, strict=True):  # one of them, or both on one line
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
    return Start(quaternion.normalised(q), w, covariance)


def _calibration_deviation(settings: FilterSettings, length_T: FloatArray) -> FloatArray:
    """Standard deviation of what the states of the magnetometer may add to a component of fields of some lengths."""
    states = settings.sensors.states
    bias_T = settings.field_bias_sigma_T if "field-bias" in states else 0.0
    gain = np.hypot(settings.field_gain_sigma, settings.field_axes_sigma_rad) if "field-gain" in states else 0.0
    return np.hypot(bias_T, gain * length_T)


def first_told(record: Record, used: SensorSet, *, with_gyro: bool) -> int:
    """First instant of a record's first run that tells something of the attitude; with a reading of the gyro or not."""
    seen = {name: there[0] for name, there in record.readings.seen.items()}
    told = np.any([seen[name] for name in used.sensors.split("+") if name != "gyro"], axis=0)
    rows = np.flatnonzero(told & seen["gyro"] if with_gyro else told)
    if not rows.size:
        raise ValueError(f"Input found no reading that tells the attitude, expected one of {used.sensors}.")
    return int(rows[0])


def largest_deviation_rad(start: Start) -> FloatArray:
    """Largest standard deviation of an axis of every start's attitude, as an angle, shape (runs,)."""
    return 2.0 * np.sqrt(np.linalg.eigvalsh(start.covariance[:, :3, :3])[:, -1])


class _Tried(NamedTuple):
    """Start of one run, minus twice the log-likelihood of a window's readings, and optional states and P at its end."""

    start: Start
    misfit: float
    optional: dict[str, FloatArray]
    P: FloatArray


def any_start(record: Record, settings: FilterSettings, turns: int = 36, rate_rad_s: float = RATE_RAD_S) -> Start:
    """Start from any attitude: :func:`vector_start`, and where it leaves a turn open the best of several hypotheses.

    ``turns``: hypotheses, at equal angles about the axis that is left open; :data:`WINDOW_S` or :data:`ALONE_S` of the
    record decide between them. ``rate_rad_s``: as :func:`vector_start`; with a magnetometer alone smaller ones compete
    too (:data:`RATES_ALONE`). Returns: where a hypothesis was chosen, the deviation about the open axis is the distance
    between hypotheses; with a magnetometer alone the start has the optional states too.
    """
    start = vector_start(record, settings, rate_rad_s)
    open_runs = np.flatnonzero(largest_deviation_rad(start) > KNOWN_RAD)
    # The first reading of a star tracker corrects any attitude: its residual is exact, not linearised.
    if settings.sensors.star or not open_runs.size:
        return start
    variances, axes = np.linalg.eigh(start.covariance[open_runs, :3, :3])
    if (2.0 * np.sqrt(variances[:, 1]) > KNOWN_RAD).any():
        raise ValueError("Input record must have a direction at the first instant of every run; one has none.")
    spacing = 2.0 * math.pi / turns
    angles = spacing * np.arange(turns)
    chosen = [start.of_runs(np.array([run])) for run in range(len(start.q))]
    for run, across in zip(open_runs, axes, strict=True):
        repeated, axis = np.full(turns, run), across[:, 2]
        narrow = _narrowed(start, repeated, np.tile(axis, (turns, 1)), spacing)
        turned = quaternion.multiply(start.q[run], quaternion.exp(angles[:, None] * axis))
        search = _likeliest_alone if settings.sensors.sensors == "mag" else _likeliest
        chosen[run] = search(record, settings, replace(narrow, q=turned), repeated).start
    return joined_starts(chosen)


def checked_start(record: Record, settings: FilterSettings, start: Start) -> Start:
    """Return a given start, and with a magnetometer alone :func:`any_start` where that explains the readings better.

    Deviations of degrees and of a tenth of a degree a second are enough to lead such a filter astray: it learns of the
    turn about the field late, by equations of motion that are linearised where it believes to be.
    """
    if settings.sensors.sensors != "mag":
        return start
    rivals = whole_start(settings, start), any_start(record, settings)
    chosen = []
    for run in range(len(start.q)):
        only = np.array([run])
        tried = [_likeliest(record, settings, rival.of_runs(only), only) for rival in rivals]
        chosen.append(min(tried, key=lambda one: one.misfit).start)
    return joined_starts(chosen)


def _likeliest(record: Record, settings: FilterSettings, hypotheses: Start, runs: NDArray[np.intp]) -> _Tried:
    """Likeliest hypothesis of one run, which comes as often as there are hypotheses."""
    used = settings.sensors
    window_s = WINDOW_S if used.sun or used.gyro else ALONE_S
    n = 1 + round(min(window_s / record.dt_s, record.momentum_Nms.shape[1] - 1))
    # Without a gate: how badly a wrong turn fits is what tells it.
    tracks = run_filter(part(record, runs, slice(n)), replace(settings, gate=0.0), hypotheses)
    misfit = np.nansum(tracks.nis + tracks.log_det, axis=(1, 2))
    # A filter that left double precision has no innovations, which must not count as small ones.
    misfit[~np.isfinite(tracks.q[:, -1]).all(axis=-1)] = np.inf
    best = np.array([np.where(np.isfinite(misfit), misfit, np.inf).argmin()])
    optional = {name: values[best, -1] for name, values in tracks.optional.items()}
    return _Tried(hypotheses.of_runs(best), float(misfit[best[0]]), optional, tracks.covariance[best, -1])


def _likeliest_alone(record: Record, settings: FilterSettings, hypotheses: Start, runs: NDArray[np.intp]) -> _Tried:
    """The same with a magnetometer alone: by several deviations of the rate, and again from the torques so found."""
    used, tried = settings.sensors, []
    for share in RATES_ALONE:
        covariance = hypotheses.covariance.copy()
        covariance[:, 3:, 3:] *= share**2
        rivals = whole_start(settings, replace(hypotheses, covariance=covariance))
        tried.append((_likeliest(record, settings, rivals, runs), rivals))
    best, rivals = min(tried, key=lambda one: one[0].misfit)
    kept = settings.kept(record.dt_s)
    lasting = [name for name in used.states if (kept[used.place(name)] == 1.0).all()]
    places = np.concatenate([np.arange(0), *(np.arange(used.size)[used.place(name)] for name in lasting)])
    block = np.ix_(np.arange(len(runs)), places, places)
    for _ in range(ROUNDS if lasting else 0):
        covariance = rivals.covariance.copy()
        covariance[block] = AGAIN**2 * best.P[:, places[:, None], places]
        found = {name: np.repeat(best.optional[name], len(runs), axis=0) for name in lasting}
        rivals = replace(rivals, covariance=covariance, optional={**rivals.optional, **found})
        again = _likeliest(record, settings, rivals, runs)
        if not again.misfit < best.misfit - BETTER:
            break
        best = again
    return best


def _narrowed(start: Start, runs: NDArray[np.intp], axis: FloatArray, deviation_rad: float) -> Start:
    """Runs of a start with another standard deviation about an axis (m, 3), an eigenvector of the covariance."""
    covariance = start.covariance[runs].copy()
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    along = (0.5 * deviation_rad) ** 2 * axis[:, :, None] * axis[:, None, :]
    covariance[:, :3, :3] = across @ covariance[:, :3, :3] @ across + along
    return Start(start.q[runs], start.w[runs], covariance)
