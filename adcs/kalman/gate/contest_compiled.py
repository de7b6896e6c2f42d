"""Compiled rules of :mod:`adcs.kalman.gate.contest`, which is the readable twin and says why they are as they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs.kalman.gate.contest import (
    AGREE,
    BETTER,
    CLIP,
    FAR,
    FIELD,
    GYRO,
    OPEN,
    PATIENT_READINGS,
    STAR,
    STRAIN,
    SUN,
    WORSE,
)
from adcs.satellite.dynamics_compiled import Quaternion, Vector, cross, dot, multiply, normalised, rotate_back
from magloc.compilation import compiled, internal

Array = NDArray[np.float64]
# Places of the counts of a contest.
BEGAN, ROW, AGREED, MAIN_AGREED, MISSED, AFTER_GAP = range(6)
TAKEN, LAST_TAKEN, LAST_READ, INTERVAL, STRAINED = range(5)
_AGREE, _CLIP, _BETTER, _WORSE, _FAR, _PATIENT_READINGS = AGREE, CLIP, BETTER, WORSE, FAR, PATIENT_READINGS
_STRAIN, _OPEN = STRAIN, OPEN
_STAR, _GYRO, _FIELD, _SUN = STAR, GYRO, FIELD, SUN

Fit = tuple[float, float, float]
"""NIS, the same eased, and log|S|: :class:`adcs.kalman.gate.contest.Fit`."""


class Contest(NamedTuple):
    """Counts (6,), of every sensor (5, 4), patience (4,), and the score (1,)."""

    counts: NDArray[np.int64]
    of_sensor: NDArray[np.int64]
    patience: NDArray[np.int64]
    score: Array


@internal
def reset(contest: Contest) -> None:
    """Nothing has been read."""
    contest.counts[:] = 0
    contest.counts[BEGAN] = -1
    contest.of_sensor[:] = 0
    contest.of_sensor[INTERVAL] = 1


@internal
def decided(contest: Contest, sensor: int, limit: float, main: Fit, second: Fit) -> tuple[bool, bool]:
    """Who takes a reading, main and second; without a second one its fit is NaN."""
    counts = contest.counts
    fits, use_second = main[1] <= limit, second[1] <= limit
    strain = contest.of_sensor[STRAINED]
    use = fits or strain[sensor] >= _OPEN
    if fits:
        strain[sensor] = max(strain[sensor] - 1, 0)
    elif sensor != counts[BEGAN] or counts[AGREED] < _PATIENT_READINGS:
        strain[sensor] = min(strain[sensor] + _STRAIN, 2 * _OPEN)
    if counts[BEGAN] >= 0:
        if sensor == counts[BEGAN]:
            if use and use_second and counts[AGREED] >= _AGREE:
                use = main[1] + main[2] <= second[1] + second[2] + _FAR
                use_second = not use
            counts[AGREED] += use_second
            counts[MAIN_AGREED] += use
            counts[MISSED] = 0 if use_second else counts[MISSED] + 1
        elif counts[AGREED] > 1:
            contest.score[0] += 0.5 * (min(main[1], _CLIP) - min(second[1], _CLIP))
    if use:
        contest.of_sensor[TAKEN, sensor] += 1
        contest.of_sensor[LAST_TAKEN, sensor] = counts[ROW]
    return use, use_second


@internal
def may_begin(contest: Contest, sensor: int, biased: bool, both: bool) -> bool:
    """Whether a rejected reading can begin a second hypothesis."""
    if contest.counts[BEGAN] >= 0 or (sensor == _GYRO and not biased):
        return False
    return sensor in (_STAR, _GYRO) or both or _waited(contest, sensor)


@internal
def begin(contest: Contest, sensor: int) -> None:
    """Count from a reading that begins a second hypothesis."""
    counts, of_sensor = contest.counts, contest.of_sensor
    counts[BEGAN], counts[AGREED], counts[MAIN_AGREED], counts[MISSED] = sensor, 1, 0, 0
    gap = counts[ROW] - of_sensor[LAST_READ, sensor]
    counts[AFTER_GAP] = gap > _PATIENT_READINGS * of_sensor[INTERVAL, sensor]
    contest.score[0] = 0.0


@internal
def read(contest: Contest, sensor: int) -> None:
    """Count a reading, after it has been decided on."""
    row, of_sensor = contest.counts[ROW], contest.of_sensor
    gap = row - of_sensor[LAST_READ, sensor]
    if gap > 0:
        if gap <= _PATIENT_READINGS * of_sensor[INTERVAL, sensor] or of_sensor[LAST_READ, sensor] == 0:
            of_sensor[INTERVAL, sensor] = gap
        of_sensor[LAST_READ, sensor] = row


@internal
def verdict(contest: Contest) -> int:
    """1 where the second hypothesis is believed, -1 where it is dropped, else 0; what is decided ends the contest."""
    counts, score, of_sensor = contest.counts, contest.score[0], contest.of_sensor
    began, found = counts[BEGAN], 0
    if score < _WORSE:
        of_sensor[STRAINED, began] = 0
        found = -1
    elif counts[MISSED] >= _AGREE or counts[MAIN_AGREED] >= _PATIENT_READINGS:
        found = -1
    elif counts[AGREED] >= _AGREE:
        unsupported = counts[AFTER_GAP] > 0 or of_sensor[TAKEN, began] < _AGREE or _waited(contest, began)
        if score > _BETTER or (unsupported and score > -_BETTER):
            found = 1
            of_sensor[TAKEN, began], of_sensor[LAST_TAKEN, began] = counts[AGREED], counts[ROW]
    if found != 0:
        counts[BEGAN] = -1
    return found


@internal
def _waited(contest: Contest, sensor: int) -> bool:
    return contest.counts[ROW] - contest.of_sensor[LAST_TAKEN, sensor] >= contest.patience[sensor]


@internal
def begun(
    q: Quaternion, sensor: int, star: Quaternion, field: Vector, sun: Vector, model: Vector, sun_model: Vector
) -> Quaternion:
    """Attitude of a hypothesis in which a reading is right; NaN of a direction that is not read or not in use."""
    if sensor == _STAR:
        return normalised(star)
    if sensor == _GYRO:
        return q
    if not np.isfinite(sun[0]):
        return turned_onto(q, field, model)
    q = turned_onto(q, sun, sun_model)
    return turned_about(q, sun, field, model) if np.isfinite(field[0]) else q


@compiled
def turned_onto(q: Quaternion, body: Vector, reference: Vector) -> Quaternion:
    """Attitude after the shortest turn that makes a direction in body axes that of the reference frame."""
    there = rotate_back(q, reference)
    length = np.sqrt(dot(body, body) * dot(reference, reference))
    cosine, turn = dot(body, there) / length, cross(body, there)
    if 1.0 + cosine < 1e-12:
        least = np.argmin(np.abs(np.array(body)))
        across = cross(body, (1.0 if least == 0 else 0.0, 1.0 if least == 1 else 0.0, 1.0 if least == 2 else 0.0))
        return normalised(multiply(q, (0.0, across[0], across[1], across[2])))
    by = (1.0 + cosine, turn[0] / length, turn[1] / length, turn[2] / length)
    return normalised(multiply(q, by))


@compiled
def turned_about(q: Quaternion, axis: Vector, body: Vector, reference: Vector) -> Quaternion:
    """Attitude after the turn about a unit axis that brings a direction nearest to that of the frame."""
    there = rotate_back(q, reference)
    sine = dot(axis, cross(body, there))
    half = 0.5 * np.arctan2(sine, dot(body, there) - dot(axis, body) * dot(axis, there))
    s = np.sin(half)
    return normalised(multiply(q, (np.cos(half), s * axis[0], s * axis[1], s * axis[2])))


@internal
def eased(nis: float, variance: float, length: float, attitude_variance: float) -> float:
    """NIS of a direction of some length, at least, with the error of linearising it."""
    return nis * variance / (variance + (2.0 * attitude_variance * length) ** 2)
