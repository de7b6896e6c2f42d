"""Heading from gyro and magnetometer: a Kalman filter that knows what else changes a field, and how much it may.

A field differs from that of the start because the sensor has turned, because it has come to another place, or because
something moves with it. The first is a turn, the second a vector in the room, the third one in the sensor's axes. Which
it was shows in the turns that were made, and only there: where they do not tell, the covariance says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.complementary.inertial.gaps import HELD_VARIANCE, UNKNOWN_RAD
from adcs.satellite.telemetry import is_read
from adcs.satellite.vector_record import instants_within, steps_s
from arrays.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from adcs.complementary.heading_compiled import Blocks, Noise

_BLOCK_S = 0.035
"""How long readings are averaged: within it a hand turns by a few degrees."""
_START_S = 1.0
_LONG_STEP_S = 1.0  # a longer time without a field is one of the gyro alone


@dataclass(frozen=True)
class HeadingModel:
    """What the filter takes for granted, one standard deviation each.

    Attributes
    ----------
    noise_T : float
        Of a reading, or of the mean of those within 35 ms, with what is left of lag and calibration, each axis.
    offset_T, offset_T_rts : float
        Of the sensor's own offset at the start, each axis, and by how much that grows in the root of a second.
    room_T, room_s : float
        Of the field's difference between places a reach apart, each axis, and for how long a hand stays near one.
    local_T, local_s : float
        The same between places that a hand passes at once, with the vertical field that an error of the tilt turns
        into a horizontal one; half of it upwards.
    gyro_drift_rad_s, gyro_drift_s : float
        Of the bias that turning adds to that at rest, and how long it lasts.
    gyro_scale : float
        Of each axis' gain.
    gyro_walk_rad_rts : float
        Growth of the heading's deviation.
    start_rad : float
        Of the heading at the start.
    turning_rad_s : float
        The rate from which on the sensor counts as moved: while it lies still, neither place nor drift changes.
    gap_rad_s, long_gap_rad_s : float
        Of the mean rate within a gap of the gyro, against that of its ends: in a short one, and in one beyond a second,
        which is that of the whole log where that is higher.
    jump_T : float
        Of the field of a magnet, each axis.
    gate, mean_nis, memory : float
        Limits of the normalised innovation squared of a reading and, each axis, of the mean of the last ones.
    patience_s, trial_s : float
        How long readings contradict before a change of the offset is tried, and for how long it is.
    evidence : float
        Logarithm of the odds of a changed offset, against a changed room, from which on it is believed.

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
    evidence: float = 10.0

    def deviations(self) -> FloatArray:
        """Of the state at the start (14,): nothing is known of the room but that its field there points north."""
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


@dataclass(frozen=True, eq=False)
class HeadingTrack:
    """Heading at n instants, and what the magnetometer told of it."""

    heading_rad: FloatArray  # (n,): turn about the vertical from east and north to the axes of the level frame
    sigma_rad: FloatArray  # (n,)
    offset_T: FloatArray  # (n, 3): of the sensor, body axes
    offset_sigma_T: FloatArray  # (n, 3)
    left_out: BoolArray  # (n,): where the field contradicted all of this
    changes: NDArray[np.intp]  # instants from which on the offset is another one


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
    """Filter, or smoother, of the field in the level frame.

    ``rate_rad_s`` (n, 3): mean over the step that ends at each instant. ``q_level`` (n, 4): level from body, of gyro
    and accelerometer alone. ``field_T`` (n, 3): NaN where there is no reading. ``hidden_rad2`` (n,): growth of the
    heading's variance within gaps of the gyro. ``start_tilt_rad``: error of the tilt, 1 σ, at the first reading. Raises
    ValueError: there is no reading.
    """
    from adcs.complementary.heading_compiled import Noise, Tests, run, smooth

    hidden = np.zeros(len(time_s)) if hidden_rad2 is None else hidden_rad2
    blocks, ends = _blocks(time_s, rate_rad_s, q_level, field_T, model, hidden)
    start = blocks.start_T
    x = np.zeros(14)
    x[0] = math.atan2(-start[0], start[1])
    blocks = blocks._replace(start_T=np.array([0.0, math.hypot(start[0], start[1]), start[2]]))
    P = np.diag(model.deviations() ** 2)
    # A tilt that is wrong turns the vertical field into a horizontal one, and that into a vertical one.
    _, north, up = start_tilt_rad * blocks.start_T
    P[[0, 9, 10], [0, 9, 10]] += [min((up / blocks.start_T[1]) ** 2, UNKNOWN_RAD**2), up**2, north**2]
    m = len(ends)
    told, variances, used, known = np.empty((m, 4)), np.empty((m, 4)), np.zeros(m, np.int64), np.zeros(m, np.int64)
    noise = Noise(
        model.noise_T,
        model.gyro_walk_rad_rts,
        model.gyro_drift_rad_s,
        model.gyro_drift_s,
        model.offset_T_rts,
        model.room_T,
        model.room_s,
        model.local_T,
        0.5 * model.local_T,
        model.local_s,
    )
    anywhere = noise._replace(room_T=model.jump_T, room_s=model.local_s)
    tests = Tests(
        model.gate, model.mean_nis, model.memory, model.patience_s, model.jump_T, model.evidence, model.trial_s
    )
    run(x.copy(), P.copy(), blocks, noise, anywhere, tests, told, variances, used, known)
    if offline:
        smooth(x, P, blocks, noise, model.jump_T, known, told, variances)
        used = known
    # A block is known at its end; before the first one there is the start.
    ended = np.zeros(len(time_s), np.intp)
    ended[ends] = 1
    after = np.cumsum(ended)
    gap = (hidden > 0.0) & (np.append(hidden[1:], 0.0) > 0.0)
    last = np.clip(np.where(offline & ~gap, after - ended, after - 1), 0, m - 1)
    sigma = np.sqrt(variances)
    hidden = np.cumsum(hidden)
    hidden = np.abs(hidden - hidden[ends[last]]) * np.where(gap, HELD_VARIANCE, 1.0)
    since = np.maximum(time_s - time_s[ends[last]], 0.0)
    variance = variances[last, 0] + _drifted(time_s, rate_rad_s, ends[last], since, model) + hidden
    return HeadingTrack(
        heading_rad=told[last, 0],
        sigma_rad=np.minimum(np.sqrt(variance), UNKNOWN_RAD),
        offset_T=told[last, 1:],
        offset_sigma_T=sigma[last, 1:],
        left_out=(used == 0)[last],
        changes=ends[known == 2],
    )


def relative_heading(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    q_level: FloatArray,
    model: HeadingModel = HeadingModel(),
    *,
    hidden_rad2: FloatArray | None = None,
) -> HeadingTrack:
    """Heading of gyro and accelerometer alone, against that of the first instant; arguments as of heading_track."""
    n = len(time_s)
    zero = np.zeros(n, np.intp)
    turned = rate_rad_s * quaternion.matrix(q_level)[:, 2] * steps_s(time_s)[:, None]
    turned[0] = 0.0
    scale = np.square(model.gyro_scale * np.cumsum(turned, axis=0)).sum(axis=1)
    drifted = _drifted(time_s, rate_rad_s, zero, time_s - time_s[0], model)
    hidden = 0.0 if hidden_rad2 is None else np.cumsum(hidden_rad2)
    none = np.full((n, 3), np.nan)
    sigma = np.minimum(np.sqrt(scale + drifted + hidden), UNKNOWN_RAD)
    return HeadingTrack(np.zeros(n), sigma, none, none, np.zeros(n, np.bool_), zero[:0])


def _blocks(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    q_level: FloatArray,
    field_T: FloatArray,
    model: HeadingModel,
    hidden_rad2: FloatArray | None = None,
) -> tuple[Blocks, NDArray[np.intp]]:
    """Means over short times, and the instants (m,) that end them; ``start_T`` is in the level frame still."""
    from adcs.complementary.heading_compiled import Blocks

    growth = np.zeros(len(time_s)) if hidden_rad2 is None else hidden_rad2
    level = quaternion.rotate(q_level, field_T)
    rows = np.flatnonzero(is_read(level))
    if not rows.size:
        raise ValueError("Input field_T must be there within the first second; instead received none.")
    start_T = level[rows[time_s[rows] < time_s[rows[0]] + _START_S]].mean(axis=0)
    size = instants_within(_BLOCK_S, time_s[rows])
    # No block begins before a gap and ends after it.
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
    gap_rad2[long] += _drifted(time_s, rate_rad_s, begins, steps, model, until=ends)[long]
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


def _drifted(
    time_s: FloatArray,
    rate_rad_s: FloatArray,
    since: NDArray[np.intp],
    since_s: FloatArray,
    model: HeadingModel,
    until: NDArray[np.intp] | slice = slice(None),
) -> FloatArray:
    """Return what the gyro alone adds to the heading's variance between instants, by default all n."""
    turning = np.linalg.norm(rate_rad_s, axis=1) > model.turning_rad_s
    turned_s = np.cumsum(turning * steps_s(time_s))
    of_drift = np.maximum(turned_s[until] - turned_s[since], 0.0) / model.gyro_drift_s
    # Of the integral of a bias that is forgotten.
    drift_s = 2.0 * model.gyro_drift_s**2 * (of_drift + np.expm1(-of_drift))
    variance: FloatArray = model.gyro_walk_rad_rts**2 * since_s + model.gyro_drift_rad_s**2 * drift_s
    return variance


def transition(i: int, blocks: Blocks, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Readable twin of :func:`adcs.complementary.heading_compiled.predict`: Φ (14, 14) and Q (14, 14) of a block."""
    h, turns, Phi = blocks.dt_s[i], blocks.turns[i], np.eye(14)
    lasting_s = np.repeat([noise.drift_s, noise.room_s, noise.local_s], [1, 3, 3])
    decaying = np.array([1, *range(8, 14)])
    keeps = np.exp(-h * np.array([turns] * 4 + [1.0] * 3) / lasting_s)
    Phi[decaying, decaying] = keeps
    Phi[0, 1] = h * turns
    Phi[0, 2:5] = h * blocks.R_level[i, 2] * blocks.rate_rad_s[i]
    local = [noise.local_T, noise.local_T, noise.local_up_T]
    variance = np.zeros(14)
    variance[0] = noise.walk_rad_rts**2 * h * turns + blocks.gap_rad2[i]
    variance[5:8] = noise.offset_T_rts**2 * h
    variance[decaying] = np.square([noise.drift_rad_s, *[noise.room_T] * 3, *local]) * (1.0 - keeps**2)
    return Phi, np.diag(variance)


def expected_field(x: FloatArray, i: int, blocks: Blocks) -> tuple[FloatArray, FloatArray]:
    """Readable twin of :func:`adcs.complementary.heading_compiled.innovation`: level field (3,), derivative (3, 14)."""
    c, s = np.cos(x[0]), np.sin(x[0])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    level, R = turn @ (blocks.start_T + x[8:11] + x[11:14]), blocks.R_level[i]
    of_heading = np.array([[-level[1]], [level[0]], [0.0]])
    return level + R @ x[5:8], np.hstack([of_heading, np.zeros((3, 4)), R, turn, turn])


def turned_to_north(q_level: FloatArray, heading_rad: FloatArray) -> FloatArray:
    """East, north, up from body: the level attitude (n, 4) turned back by the heading (n,)."""
    c, s = np.cos(0.5 * heading_rad), np.sin(0.5 * heading_rad)
    w, x, y, z = q_level.T
    return np.stack([c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w], axis=-1)
