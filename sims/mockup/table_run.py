"""Simulated runs of the table-top satellite: motion, inertial unit and camera fixes.

See docs/theory/tabletop-navigation.md.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from adcs.mockup.navigation.fixes import FixRecord
from adcs.mockup.navigation.imu import Inclinometer, RateGyro
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarState, PlanarTrack, strapdown
from arrays.io.values import accept_seed, seed_of
from arrays.typing import BoolArray, FloatArray, Rng
from sims.noise import stream

DriveName = Literal["perimeter", "two-firings"]
POLL_S = 1e-3
THRUST_M_S2 = 0.04
SPEED_M_S = 0.085
"""Speed of the point that the perimeter drive follows."""
_CONTROL_S = 0.1
_STRAIGHT_M = (1.4, 0.9)
_CORNER_M = 0.2
_SPRING_S2, _DAMPER_S, _DEADBAND_M_S2 = 0.15, 0.8, 0.02


@dataclass(frozen=True)
class ImuErrors:
    """Errors of the inertial unit after its calibration.

    Attributes
    ----------
    acceleration_m_s2, rate_rad_s : float
        Noise of a sample, per axis.
    spikes_Hz, spike_m_s2 : float
        About one sample per second has a parasitic spike on each axis, uniform within ± its size.
    calibration_m_s2 : float
        Standard deviation of each zero after the calibration.
    zero_m_s2 : tuple
        Additional constant zeros.
    drift_m_s2 : tuple
        Linear drift of the zeros over the run.
    warming_K : float
        Warming of the sensor during the run; drift over warming is the temperature coefficient.
    zero_rad_s : float
        Zero of the gyro.
    """

    acceleration_m_s2: float = 0.002
    rate_rad_s: float = math.radians(0.1)
    spikes_Hz: float = 1.0
    spike_m_s2: float = 0.07
    calibration_m_s2: float = 0.001
    zero_m_s2: tuple[float, float] = (0.0, 0.0)
    drift_m_s2: tuple[float, float] = (0.002, -0.0015)
    warming_K: float = 20.0 / 3.0
    zero_rad_s: float = math.radians(0.02)


@dataclass(frozen=True)
class CameraErrors:
    """Errors and delays of the camera's fixes.

    Attributes
    ----------
    period_s, delay_s : float
        Between exposures, and from exposure to arrival.
    position_m, heading_rad : float
        Noise of a fix, each axis.
    failed : float
        Fraction of the frames that give no fix.
    false : float
        Fraction of false fixes, at random positions and headings under the sky.
    overtaken : float
        Fraction of the fixes that arrive up to three periods later than the others.
    repeated : float
        Fraction of the fixes that arrive twice.
    outages_s : tuple of (float, float)
        Begin and end of periods without exposures.
    latency_s : float
        Delay of the time stamps after the exposure.

    Raises
    ------
    ValueError
        A fraction is not between 0 and 1.

    Examples
    --------
    >>> import sims
    >>> sims.CameraErrors(failed=0.1).failed
    0.1
    """

    period_s: float = 0.6
    delay_s: float = 0.6
    position_m: float = 1e-3
    heading_rad: float = math.radians(0.05)
    failed: float = 0.12
    false: float = 0.0
    overtaken: float = 0.0
    repeated: float = 0.0
    outages_s: tuple[tuple[float, float], ...] = ()
    latency_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("failed", "false", "overtaken", "repeated"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(
                    f"Input {name} must be a fraction between 0 and 1; instead received {getattr(self, name):g}."
                )


@dataclass(frozen=True)
class TableScenario:
    """Settings of :func:`table_run`.

    Attributes
    ----------
    drive : {'perimeter', 'two-firings'}
    duration_s : float
    sample_s : float
        Interval of the samples of the inertial unit, a multiple of :data:`POLL_S`.
    imu : ImuErrors
        Errors of the inertial unit.
    camera : CameraErrors
        Errors of the fixes.

    Raises
    ------
    ValueError
        The drive is unknown, or a time is not positive.

    Examples
    --------
    >>> import sims
    >>> sims.TableScenario(duration_s=20.0).n_samples
    2000
    """

    drive: DriveName = "perimeter"
    duration_s: float = 180.0
    sample_s: float = 0.01
    imu: ImuErrors = field(default_factory=ImuErrors)
    camera: CameraErrors = field(default_factory=CameraErrors)

    def __post_init__(self) -> None:
        if self.drive not in get_args(DriveName):
            raise ValueError(f"Input drive must be one of {get_args(DriveName)}; instead received {self.drive!r}.")
        if not self.duration_s >= self.sample_s > 0.0 or not math.isfinite(self.duration_s):
            raise ValueError(
                "Input duration_s must be finite and not shorter than sample_s, which must be positive; "
                f"instead received {self.duration_s} and {self.sample_s}."
            )
        if abs(self.polls * POLL_S - self.sample_s) > 1e-9:
            raise ValueError(f"Input sample_s must be a multiple of {POLL_S}; instead received {self.sample_s}.")

    @property
    def polls(self) -> int:
        """Number of polls in a sample."""
        return max(1, round(self.sample_s / POLL_S))

    @property
    def n_samples(self) -> int:
        """Number of samples in the run."""
        return int(self.duration_s / self.sample_s + 1e-9)


@dataclass(frozen=True, eq=False)
class TableRun:
    """Truth and readings of a run.

    ``true_start``, ``start``: state at 0 s, and its estimate with the error of a fix and the true velocity.
    """

    truth: PlanarTrack  # at the end of each sample
    true_start: PlanarState
    start: PlanarState
    imu: ImuRecord
    temperature_C: FloatArray  # (n,)
    zero_m_s2: FloatArray  # (n, 2): true zeros of the accelerometer in each sample
    zero_rad_s: float  # true zero of the gyro
    fixes: FixRecord  # as they arrive
    exposure_s: FloatArray  # (k,): when the images were taken: their time stamps less the latency
    false: BoolArray  # (k,): which of them are false


@accept_seed
def table_run(scenario: TableScenario, rng: Rng) -> TableRun:
    """Simulate one run of the table-top satellite.

    Parameters
    ----------
    scenario : TableScenario
        The drive, and the errors of the sensors.
    rng : int or numpy.random.Generator
        Seed or generator of all random numbers.

    Returns
    -------
    TableRun
        True motion, samples of the inertial unit and fixes of the camera.

    Examples
    --------
    >>> import sims
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> run.truth.position_m.shape
    (500, 2)
    """
    seed = seed_of(rng)
    camera, n, polls = scenario.camera, scenario.n_samples, scenario.polls
    drive = perimeter_drive if scenario.drive == "perimeter" else two_firings_drive
    polled, true_start = drive(n * polls, stream(seed, "drive"))
    flown = strapdown(polled, true_start)
    rows = slice(polls - 1, None, polls)
    truth = flown.rows(rows)
    ideal = ImuRecord(
        0.0,
        flown.time_s[rows],
        polled.acceleration_m_s2.reshape(n, polls, 2).mean(axis=1),
        polled.rate_rad_s.reshape(n, polls).mean(axis=1),
    )
    imu, temperature_C, zero = _readings(ideal, scenario, seed)
    known = stream(seed, "start").standard_normal(3)
    start = PlanarState(
        true_start.position_m + camera.position_m * known[:2],
        true_start.velocity_m_s,
        float(true_start.heading_rad) + camera.heading_rad * float(known[2]),
    )
    fixes, exposure_s, false = _fixes(flown, camera, seed)
    zero_rate = scenario.imu.zero_rad_s
    return TableRun(truth, true_start, start, imu, temperature_C, zero, zero_rate, fixes, exposure_s, false)


def _readings(ideal: ImuRecord, scenario: TableScenario, seed: int) -> tuple[ImuRecord, FloatArray, FloatArray]:
    """Return readings, temperatures and true zeros of the accelerometer."""
    errors, n = scenario.imu, len(ideal)
    left = errors.calibration_m_s2 * stream(seed, "calibration").standard_normal(2)
    slope = np.array(errors.drift_m_s2) / errors.warming_K
    gyro = RateGyro(errors.rate_rad_s, zero_rad_s=errors.zero_rad_s)
    accelerometer = Inclinometer(
        errors.acceleration_m_s2, zero_m_s2=np.array(errors.zero_m_s2) + left, zero_slope_m_s2_K=slope
    )
    temperature_C = accelerometer.reference_C + errors.warming_K * ideal.time_s / scenario.duration_s
    acceleration = accelerometer.readings(
        ideal.acceleration_m_s2, stream(seed, "accelerometer").standard_normal((n, 2)), temperature_C
    )
    rate = gyro.readings(ideal.rate_rad_s, stream(seed, "gyro").standard_normal(n))
    spikes = stream(seed, "spikes")
    struck = spikes.random((n, 2)) < errors.spikes_Hz * scenario.sample_s
    acceleration = acceleration + np.where(struck, spikes.uniform(-errors.spike_m_s2, errors.spike_m_s2, (n, 2)), 0.0)
    zero = accelerometer.zero_m_s2 + slope * (temperature_C - accelerometer.reference_C)[:, None]
    return ImuRecord(0.0, ideal.time_s, acceleration, rate), temperature_C, zero


def _fixes(flown: PlanarTrack, camera: CameraErrors, seed: int) -> tuple[FixRecord, FloatArray, BoolArray]:
    """Return fixes in order of arrival, their exposures, and which of them are false."""
    phase = stream(seed, "camera").uniform(0.0, camera.period_s)
    time_s = np.arange(phase, flown.time_s[-1], camera.period_s)
    k = len(time_s)
    seen = flown.at(time_s)
    true = np.column_stack([seen.position_m, seen.heading_rad])
    noise = stream(seed, "fixes").standard_normal((k, 3))
    measured = true + noise * [camera.position_m, camera.position_m, camera.heading_rad]
    false = stream(seed, "false fixes").random(k) < camera.false
    anywhere = stream(seed, "false fixes", "where").uniform([-1.5, -1.2, -math.pi], [1.5, 1.2, math.pi], (k, 3))
    measured = np.where(false[:, None], anywhere, measured)
    lateness = stream(seed, "overtaken")
    late = np.where(lateness.random(k) < camera.overtaken, 3.0 * camera.period_s * lateness.random(k), 0.0)
    stamp_s = time_s + camera.latency_s
    arrival_s = np.maximum(time_s + camera.delay_s + late, stamp_s)
    kept = stream(seed, "failed frames").random(k) >= camera.failed
    for begin_s, end_s in camera.outages_s:
        kept &= (time_s < begin_s) | (time_s >= end_s)
    row = np.flatnonzero(kept)
    again = row[stream(seed, "repeated").random(k)[row] < camera.repeated]
    row, arrival_s = np.concatenate([row, again]), np.concatenate([arrival_s[row], arrival_s[again] + 0.1])
    order = np.argsort(arrival_s, kind="stable")
    row = row[order]
    heading = np.asarray(math.pi - np.mod(math.pi - measured[row, 2], 2.0 * math.pi))
    return FixRecord(stamp_s[row], arrival_s[order], measured[row, :2], heading), time_s[row], false[row]


def perimeter_drive(n_polls: int, rng: np.random.Generator) -> tuple[ImuRecord, PlanarState]:
    """Return the true readings of every poll around the table, and the start, at rest.

    ``rng``: draws the start, the sense of the circle, the heading and the turns.
    """
    time_s = POLL_S * np.arange(1.0, n_polls + 1.0)
    middle_s = time_s - 0.5 * POLL_S
    way, turn = rng.choice([-1.0, 1.0], 2).tolist()
    along_m, heading, phase = rng.uniform(0.0, 6.0), rng.uniform(-math.pi, math.pi), rng.uniform(-math.pi, math.pi)
    turning = turn * (15.0 + 25.0 * np.sin(2.0 * math.pi / 17.0 * middle_s + phase))
    rate = np.radians(turning) * np.minimum(1.0, middle_s / 3.0)
    per_control = round(_CONTROL_S / POLL_S)
    firings = _firings(way, along_m, heading, POLL_S * np.add.reduceat(rate, np.arange(0, n_polls, per_control)))
    acceleration = np.repeat(firings, per_control, axis=0)[:n_polls]
    point = _on_perimeter(along_m)[0]
    start = PlanarState(np.array([point.real, point.imag]), np.zeros(2), heading)
    return ImuRecord(0.0, time_s, acceleration, rate), start


def _firings(way: float, along_m: float, heading: float, turns: FloatArray) -> FloatArray:
    """Return accelerations along body x and y in every step, in which the satellite turns by ``turns``.

    Table axes are complex numbers. The controller knows the true state, except changes of the rates within its step.
    """
    position, velocity = _on_perimeter(along_m)[0], 0j
    firings = np.zeros((len(turns), 2))
    for step, turn in enumerate(turns.tolist()):
        target, direction = _on_perimeter(along_m + way * SPEED_M_S * _CONTROL_S * step)
        wanted = _SPRING_S2 * (target - position) + _DAMPER_S * (way * SPEED_M_S * direction - velocity)
        in_body = wanted * cmath.rect(1.0, -heading)
        fired = [
            math.copysign(THRUST_M_S2, part) if abs(part) > _DEADBAND_M_S2 else 0.0
            for part in (in_body.real, in_body.imag)
        ]
        firings[step] = fired
        shrunk = math.sin(0.5 * turn) / (0.5 * turn) if turn else 1.0  # the mean of a vector that turns
        gained = complex(*fired) * cmath.rect(shrunk * _CONTROL_S, heading + 0.5 * turn)
        position += (velocity + 0.5 * gained) * _CONTROL_S
        velocity += gained
        heading += turn
    return firings


def _on_perimeter(along_m: float) -> tuple[complex, complex]:
    """Return point and direction of the rounded rectangle after a length, as complex numbers."""
    arc = 0.5 * math.pi * _CORNER_M
    rest = along_m % (2.0 * sum(_STRAIGHT_M) + 4.0 * arc)
    position = complex(-0.5 * _STRAIGHT_M[0], -0.5 * _STRAIGHT_M[1] - _CORNER_M)
    direction = 1.0 + 0j
    for straight in (*_STRAIGHT_M, *_STRAIGHT_M):
        if rest <= straight:
            return position + rest * direction, direction
        rest -= straight
        position += straight * direction
        if rest <= arc:
            turned_to = direction * cmath.rect(1.0, rest / _CORNER_M)
            return position + _CORNER_M * 1j * (direction - turned_to), turned_to
        rest -= arc
        position += _CORNER_M * (1.0 + 1j) * direction
        direction *= 1j
    return position, direction


def two_firings_drive(n_polls: int, rng: np.random.Generator) -> tuple[ImuRecord, PlanarState]:
    """Return the true readings of every poll with two firings, and the start; not random."""
    time_s = POLL_S * np.arange(1.0, n_polls + 1.0)
    middle_s = time_s - 0.5 * POLL_S
    knots_s = [2.0, 2.6, 4.5, 5.2, 9.0, 9.5, 11.8, 12.2]
    rate = np.radians(np.interp(middle_s, knots_s, [0.0, 105.0, 105.0, -12.0, -12.0, 60.0, 60.0, 5.0]))
    acceleration = np.zeros((n_polls, 2))
    for begin_s, end_s, x, y in ((2.0, 4.5, -1, 1), (5.2, 9.0, 0, -1), (9.5, 11.5, -1, 1), (12.2, 14.5, 1, 1)):
        acceleration[(middle_s > begin_s) & (middle_s < end_s)] = THRUST_M_S2 * np.array([x, y])
    start = PlanarState(np.array([-0.1, 0.0]), np.array([0.1, 0.0]), 0.3)
    return ImuRecord(0.0, time_s, acceleration, rate), start
