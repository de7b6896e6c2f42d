"""Heading from gyro and magnetometer: a Kalman filter with the disturbances of the field as states.

The measured field changes when the sensor rotates, when it moves to another place, or when a magnetic object moves with
it. The first change is a rotation, the second a vector in the room, the third a vector in the sensor's axes. Only
rotations of the sensor separate them; without rotations the covariance stays large.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.complementary.inertial.gaps import HELD_VARIANCE, UNKNOWN_RAD
from adcs.satellite.telemetry import is_read
from adcs.satellite.vector_record import instants_within, steps_s
from arrays.typing import BoolArray, FloatArray
from magloc import core

_BLOCK_S = 0.035
"""Time over which readings are averaged; a hand rotates by a few degrees within it."""
_START_S = 1.0
_BLOCK = 4000
"""Number of means per call of a kernel: some milliseconds."""
_DOUBT_S = 60.0  # time over which the change of the heading is compared with the gyro's
_MORE, _DOUBT = 2.0, 9.0  # square of a change over its variance beyond which it counts in σ, and is reported
_LONG_STEP_S = 1.0  # longest time without a field in which the drift of the gyro is negligible


@dataclass(frozen=True)
class HeadingModel:
    """Standard deviations, time constants and limits of the heading filter.

    Attributes
    ----------
    noise_T : float
        Standard deviation per axis of a mean over 35 ms, with errors of lag and calibration.
    offset_T, offset_T_rts : float
        Initial standard deviation of the sensor's offset per axis, and its growth per square root of a second.
    room_T, room_s : float
        Standard deviation per axis of the difference of the room's field between places an arm's length apart, and the
        time for which a hand stays near one place.
    local_T, local_s : float
        The same over short distances, and the time in which a hand covers them. It includes the horizontal
        field due to errors of the tilt; the vertical component is half as large.
    gyro_drift_rad_s, gyro_drift_s : float
        Standard deviation of the gyro's bias in motion against that at rest, and its time constant.
    gyro_scale : float
        Standard deviation of each axis' gain.
    gyro_walk_rad_rts : float
        Growth of the heading's standard deviation per square root of a second.
    start_rad : float
        Initial standard deviation of the heading.
    turning_rad_s : float
        Smallest rate of a sensor in motion; below it, neither the room's field nor the drift changes.
    gap_rad_s, long_gap_rad_s : float
        Standard deviation of the mean rate within a gap of the gyro relative to the mean at its ends: in short gaps,
        and in gaps beyond a second. The rms rate of the whole log replaces the latter if it is higher.
    jump_T : float
        Standard deviation of the field of a magnet, each axis.
    gate, mean_nis, memory : float
        Limits of the normalised innovation squared of a reading and, per axis, of its running mean, and the memory of
        that mean.
    patience_s, trial_s : float
        Time for which readings must contradict before a change of the offset is tried, and duration of the trial.
    evidence : float
        Smallest logarithm of the odds of a changed offset against a changed room for which it is accepted.

    Examples
    --------
    >>> import adcs
    >>> adcs.HeadingModel(gyro_scale=0.01).gyro_scale
    0.01
    """

    noise_T: float = 2e-6
    offset_T: float = 0.3e-6
    offset_T_rts: float = 0.02e-6
    room_T: float = 0.4e-6
    room_s: float = 100.0
    local_T: float = 2e-6
    local_s: float = 0.3
    gyro_drift_rad_s: float = 0.0007
    gyro_drift_s: float = 20.0
    gyro_scale: float = 0.005
    gyro_walk_rad_rts: float = 0.0003
    start_rad: float = 0.01
    turning_rad_s: float = math.radians(3.0)
    gap_rad_s: float = 0.1
    long_gap_rad_s: float = 1.0
    jump_T: float = 20e-6
    gate: float = 25.0
    mean_nis: float = 2.0
    memory: float = 0.9
    patience_s: float = 0.35
    trial_s: float = 10.0
    evidence: float = 100.0

    def deviations(self) -> FloatArray:
        """Return the initial standard deviations of the states; the initial field points north.

        Returns
        -------
        ndarray, shape (14,)
            Heading [rad], drift [rad/s], three scales, offset [T], and the room's field in two parts [T].
        """
        return np.array(
            [
                self.start_rad,
                self.gyro_drift_rad_s,
                *[self.gyro_scale] * 3,
                *[self.offset_T] * 3,
                0.1 * self.offset_T,
                *[self.offset_T] * 2,
                *[self.local_T] * 2,
                0.5 * self.local_T,
            ]
        )


class Blocks(NamedTuple):
    """Means over m short times, in a level frame with the heading of the gyro."""

    field_T: FloatArray  # (m, 3)
    R_level: FloatArray  # (m, 3, 3): level from body
    rate_rad_s: FloatArray  # (m, 3): body axes
    dt_s: FloatArray  # (m,)
    gap_rad2: FloatArray  # (m,): variance of the rotation within a gap of the gyro
    turns: FloatArray  # (m,): 1 if the sensor rotates, 0 if it rests
    start_T: FloatArray  # (3,): field at the start, east, north, up


@dataclass(frozen=True, eq=False)
class HeadingTrack:
    """Heading and offset of the magnetometer at n instants."""

    heading_rad: FloatArray  # (n,): rotation about the vertical from east and north to the axes of the level frame
    sigma_rad: FloatArray  # (n,): standard deviation of the heading
    offset_T: FloatArray  # (n, 3): offset of the sensor, body axes
    offset_sigma_T: FloatArray  # (n, 3): its standard deviation
    left_out: BoolArray  # (n,): rejected readings of the field
    changes: NDArray[np.intp]  # instants at which the offset changes
    doubted: BoolArray  # (n,): the field turned the heading by more than the gyro's errors and σ allow


def heading_track(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    q_level: FloatArray,
    field_T: FloatArray,
    model: HeadingModel = HeadingModel(),
    *,
    offline: bool = False,
    hidden_rad2: FloatArray | None = None,
    start_tilt_rad: float = 0.0,
) -> HeadingTrack:
    """Estimate the heading by a filter, or a smoother, of the field in the level frame.

    ``rate_rad_s`` (n, 3): mean over the step that ends at each instant. ``q_level`` (n, 4): level from body, from gyro
    and accelerometer alone. ``field_T`` (n, 3): NaN without a reading. ``hidden_rad2`` (n,): growth of the heading's
    variance within gaps of the gyro. ``start_tilt_rad``: σ of the tilt at the first reading. Raises ValueError without
    a reading.
    """
    hidden = np.zeros(len(time_s)) if hidden_rad2 is None else hidden_rad2
    blocks, ends = _blocks(time_s, rate_rad_s, q_level, field_T, model, hidden)
    start = blocks.start_T
    x = np.zeros(14)
    x[0] = math.atan2(-start[0], start[1])
    blocks = blocks._replace(start_T=np.array([0.0, math.hypot(start[0], start[1]), start[2]]))
    P = np.diag(model.deviations() ** 2)
    # An error of the tilt mixes the vertical and the horizontal field.
    _, north, up = start_tilt_rad * blocks.start_T
    P[[0, 9, 10], [0, 9, 10]] += [min((up / blocks.start_T[1]) ** 2, UNKNOWN_RAD**2), up**2, north**2]
    told, variances, used, changed = run_heading_filter(x, P, blocks, model, offline=offline)
    m = len(ends)
    # The estimate of a block holds from its end on; before the first one, the start holds.
    ended = np.zeros(len(time_s), np.intp)
    ended[ends] = 1
    after = np.cumsum(ended)
    gap = (hidden > 0.0) & (np.append(hidden[1:], 0.0) > 0.0)
    last = np.clip(np.where(offline & ~gap, after - ended, after - 1), 0, m - 1)
    sigma = np.sqrt(variances)
    hidden = np.cumsum(hidden)
    hidden = np.abs(hidden - hidden[ends[last]]) * np.where(gap, HELD_VARIANCE, 1.0)
    since = np.maximum(time_s - time_s[ends[last]], 0.0)
    variance = variances[last, 0] + _drift_variance(time_s, rate_rad_s, ends[last], since, model) + hidden
    heading = told[last, 0]
    changed_by = _change_variance(time_s, rate_rad_s, q_level, hidden_rad2, model)
    excess, doubted = _excess_variance(time_s, heading, variance, changed_by, offline=offline)
    variance += excess
    return HeadingTrack(
        heading_rad=heading,
        sigma_rad=np.minimum(np.sqrt(variance), UNKNOWN_RAD),
        offset_T=told[last, 1:],
        offset_sigma_T=sigma[last, 1:],
        left_out=~used[last],
        changes=ends[changed],
        doubted=doubted,
    )


def _change_variance(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    q_level: FloatArray,
    hidden_rad2: FloatArray | None,
    model: HeadingModel,
) -> Callable[[NDArray[np.intp], NDArray[np.intp]], FloatArray]:
    """Return the variance of the change of the gyro's heading between instants, as a function of these."""
    turned = rate_rad_s * quaternion.rotate_back(q_level, [0.0, 0.0, 1.0]) * steps_s(time_s)[:, None]
    turned[0] = 0.0
    turned = np.cumsum(turned, axis=0)
    hidden = np.zeros(len(time_s)) if hidden_rad2 is None else np.cumsum(hidden_rad2)

    def variance(first: NDArray[np.intp], last: NDArray[np.intp]) -> FloatArray:
        scale = np.square(model.gyro_scale * (turned[last] - turned[first])).sum(axis=1)
        drifted = _drift_variance(time_s, rate_rad_s, first, time_s[last] - time_s[first], model, until=last)
        return np.asarray(scale + drifted + hidden[last] - hidden[first])

    return variance


def _excess_variance(
    time_s: FloatArray,
    heading_rad: FloatArray,
    variance_rad2: FloatArray,
    change_variance: Callable[[NDArray[np.intp], NDArray[np.intp]], FloatArray],
    *,
    offline: bool,
) -> tuple[FloatArray, BoolArray]:
    """Return the excess (n,) of the squared change of heading in a minute over its variance, and whether it is large.

    A magnet that the filter does not notice turns the heading slowly. The filter's own covariance does not show it.
    """
    rows = np.arange(len(time_s))
    excess, doubted = np.zeros(len(time_s)), np.zeros(len(time_s), np.bool_)
    for shift_s in (-_DOUBT_S, _DOUBT_S) if offline else (-_DOUBT_S,):
        other = np.clip(np.searchsorted(time_s, time_s + shift_s), 0, len(time_s) - 1)
        allowed = variance_rad2[other] + change_variance(np.minimum(rows, other), np.maximum(rows, other))
        change = (heading_rad - heading_rad[other] + np.pi) % (2.0 * np.pi) - np.pi
        excess = np.maximum(excess, np.square(change) - _MORE * allowed)
        doubted |= np.square(change) > _DOUBT * allowed
    return excess, doubted


def run_heading_filter(
    x: FloatArray, P: FloatArray, blocks: Blocks, model: HeadingModel, *, offline: bool
) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray]:
    """Return heading and offset (m, 4), their variances, the used blocks and changes of the offset.

    ``x`` (14,), ``P`` (14, 14): initial state and covariance.
    """
    m = len(blocks.dt_s)
    told, variances, used, known = np.empty((m, 4)), np.empty((m, 4)), np.zeros(m, np.int64), np.zeros(m, np.int64)
    turn, kept, growth = transitions(blocks, model)
    _, other_kept, other_growth = transitions(blocks, replace(model, room_T=model.jump_T, room_s=model.local_s))
    work = core.problem(
        "heading",
        n_blocks=m,
        field=blocks.field_T,
        level=blocks.R_level,
        dt=blocks.dt_s,
        turn=turn,
        room=core.problem("heading_room", kept=kept, growth=growth),
        other_room=core.problem("heading_room", kept=other_kept, growth=other_growth),
        x=x,
        P=P,
        start_field=tuple(blocks.start_T),
        noise=model.noise_T,
        gate=model.gate,
        mean_nis=model.mean_nis,
        memory=model.memory,
        patience=model.patience_s,
        trial=model.trial_s,
        jump=model.jump_T,
        evidence=model.evidence,
        told=told,
        variances=variances,
        used=used,
        known=known,
    )
    core.run("heading_filter", work, m, block=_BLOCK, chain=m)
    if offline:
        core.run("heading_smoother", work, 2 * m, block=_BLOCK, chain=2 * m)
    return told, variances, (known if offline else used) > 0, known == 2


def transitions(blocks: Blocks, model: HeadingModel) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the parts of Φ and Q of the state (14,) in each of m blocks.

    The Jacobian of the heading with respect to drift and scales (m, 4), and the diagonal factor and the growth of the
    variance of each state (m, 14).
    """
    h, turns = blocks.dt_s[:, None], blocks.turns[:, None]
    turn = h * np.concatenate([turns, blocks.R_level[:, 2] * blocks.rate_rad_s], axis=1)
    kept, growth = np.ones((len(h), 14)), np.zeros((len(h), 14))
    kept[:, 1:2] = np.exp(-h * turns / model.gyro_drift_s)
    kept[:, 8:11] = np.exp(-h * turns / model.room_s)
    kept[:, 11:] = np.exp(-h / model.local_s)
    local_T = model.local_T * np.array([1.0, 1.0, 0.5])
    sigma = np.concatenate([[model.gyro_drift_rad_s], np.full(3, model.room_T), local_T])
    decays = [1, *range(8, 14)]
    growth[:, decays] = np.square(sigma) * (1.0 - np.square(kept[:, decays]))
    growth[:, 0] = model.gyro_walk_rad_rts**2 * blocks.dt_s * blocks.turns + blocks.gap_rad2
    growth[:, 5:8] = model.offset_T_rts**2 * h
    return turn, kept, growth


def relative_heading(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    q_level: FloatArray,
    model: HeadingModel = HeadingModel(),
    *,
    hidden_rad2: FloatArray | None = None,
) -> HeadingTrack:
    """Return the heading of gyro and accelerometer alone, relative to the first instant.

    Arguments as of :func:`heading_track`.
    """
    n = len(time_s)
    zero, no = np.zeros(n, np.intp), np.zeros(n, np.bool_)
    variance = _change_variance(time_s, rate_rad_s, q_level, hidden_rad2, model)(zero, np.arange(n))
    none = np.full((n, 3), np.nan)
    return HeadingTrack(np.zeros(n), np.minimum(np.sqrt(variance), UNKNOWN_RAD), none, none, no, zero[:0], no)


def _blocks(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    q_level: FloatArray,
    field_T: FloatArray,
    model: HeadingModel,
    hidden_rad2: FloatArray | None = None,
) -> tuple[Blocks, NDArray[np.intp]]:
    """Return means over short times and their last instants (m,); ``start_T`` is in the level frame."""
    growth = np.zeros(len(time_s)) if hidden_rad2 is None else hidden_rad2
    level = quaternion.rotate(q_level, field_T)
    rows = np.flatnonzero(is_read(level))
    if not rows.size:
        raise ValueError("Input field_T must have a reading within the first second; instead received none.")
    start_T = level[rows[time_s[rows] < time_s[rows[0]] + _START_S]].mean(axis=0)
    size = instants_within(_BLOCK_S, time_s[rows])
    # No block extends over a gap.
    pieces = np.split(rows, np.searchsorted(rows, np.flatnonzero(growth > 0.0)))
    rows = np.concatenate([piece[: len(piece) // size * size] for piece in pieces])
    if not rows.size:
        rows, size = pieces[0], len(pieces[0])
    of_block = rows.reshape(-1, size)
    ends = of_block[:, -1]
    dt_s = steps_s(time_s)
    turned = np.cumsum(rate_rad_s * dt_s[:, None], axis=0)
    steps = np.diff(time_s[ends], prepend=time_s[0] - dt_s[0])
    rates = np.diff(turned[ends], axis=0, prepend=0.0) / steps[:, None]
    begins = np.concatenate([[0], ends[:-1]])
    long = steps > _LONG_STEP_S
    gap_rad2 = np.diff(np.cumsum(growth)[ends], prepend=0.0)
    gap_rad2[long] += _drift_variance(time_s, rate_rad_s, begins, steps, model, until=ends)[long]
    blocks = Blocks(
        field_T=level[rows].reshape(-1, size, 3).mean(axis=1),
        R_level=np.ascontiguousarray(quaternion.matrix(q_level[of_block[:, size // 2]])),
        rate_rad_s=rates,
        dt_s=np.minimum(steps, model.gyro_drift_s),
        gap_rad2=np.minimum(gap_rad2, UNKNOWN_RAD**2),
        turns=(np.linalg.norm(rates, axis=1) > model.turning_rad_s).astype(np.float64),
        start_T=start_T,
    )
    return blocks, ends


def _drift_variance(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    since: NDArray[np.intp],
    since_s: FloatArray,
    model: HeadingModel,
    until: NDArray[np.intp] | slice = slice(None),
) -> FloatArray:
    """Return the growth of the heading's variance by the gyro between instants, by default all n."""
    turning = np.linalg.norm(rate_rad_s, axis=1) > model.turning_rad_s
    turned_s = np.cumsum(turning * steps_s(time_s))
    of_drift = np.maximum(turned_s[until] - turned_s[since], 0.0) / model.gyro_drift_s
    # Variance of the integral of an Ornstein-Uhlenbeck bias.
    drift_s = 2.0 * model.gyro_drift_s**2 * (of_drift + np.expm1(-of_drift))
    variance: FloatArray = model.gyro_walk_rad_rts**2 * since_s + model.gyro_drift_rad_s**2 * drift_s
    return variance


def rotate_to_north(q_level: FloatArray, heading_rad: FloatArray) -> FloatArray:
    """Rotate level attitudes (n, 4) by the heading (n,) to east, north, up from body."""
    c, s = np.cos(0.5 * heading_rad), np.sin(0.5 * heading_rad)
    w, x, y, z = q_level.T
    return np.stack([c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w], axis=-1)
