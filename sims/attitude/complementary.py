"""Truth and readings of the magnetically stabilised microsatellite of the complementary filters.

The source paper leaves orbit, date, attitude motion, noise and gains open; the defaults here are ours, but for the
Sun along the normal of the orbit, noise of the magnetometer alone, the drift step of 0.02 °/s at 1.7 orbits and the
step of 1 s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.environment.environment import environment
from adcs.environment.orbit import CircularOrbit
from adcs.satellite.vector_record import VectorRecord
from arrays.typing import FloatArray
from sims.noise import stream

ORBIT = CircularOrbit(670e3, math.radians(98.0), 0.0, np.datetime64("2008-03-01"))
ANGLE_PERIODS = np.array([1.0, 0.8, 1.3])
"""Periods of roll, pitch and yaw, in orbits."""


@dataclass(frozen=True)
class SatelliteScenario:
    """Settings of :func:`satellite_runs`.

    ``amplitude_rad``: of roll, pitch and yaw against the orbital frame, sines of :data:`ANGLE_PERIODS` with random
    phases.
    """

    sigma_T: float = 1000e-9  # noise of the magnetometer, each axis
    amplitude_rad: float = math.radians(5.0)
    step_orbits: float = 1.7  # when the gyro's bias steps from zero
    drift_rad_s: float = math.radians(0.02)  # to this, on all three axes
    outage_orbits: float | None = None  # when the Sun sensor fails for good
    outage_end_orbits: float = math.inf  # when it comes back
    duration_s: float = 3.5 * ORBIT.period_s
    dt_s: float = 1.0

    @property
    def time_s(self) -> FloatArray:
        """Instants."""
        return self.dt_s * np.arange(1 + int(self.duration_s / self.dt_s), dtype=np.float64)

    @property
    def orbits(self) -> FloatArray:
        """Instants in orbits."""
        return self.time_s / ORBIT.period_s


@dataclass(frozen=True, eq=False)
class SatelliteRuns:
    """Truth and readings."""

    scenario: SatelliteScenario
    q: FloatArray  # (R, n, 4): orbital from body
    bias_rad_s: FloatArray  # (n,): of each axis of the gyro
    record: VectorRecord  # field [T] and unit vector to the Sun


def satellite_runs(scenario: SatelliteScenario, seeds: Sequence[int]) -> SatelliteRuns:
    """Simulate one run for each seed; a run does not depend on the others.

    The gyro gives the mean rate over the step that ends at each instant, plus its bias.
    """
    time_s, h = scenario.time_s, scenario.dt_s
    field_T = _field_orbital(len(time_s), h)
    phases = np.array([stream(seed, "attitude").uniform(0.0, 2.0 * math.pi, 3) for seed in seeds])
    noise = np.stack([stream(seed, "magnetometer").standard_normal((len(time_s), 3)) for seed in seeds])
    q = attitude(phases, scenario.amplitude_rad, time_s)
    frame_turn = np.array([0.0, ORBIT.rate_rad_s * h, 0.0])
    before = attitude(phases, scenario.amplitude_rad, time_s - h)
    # Body against inertial space: q(before)* ∘ (turn of the frame) ∘ q.
    inertial = quaternion.multiply(quaternion.multiply(quaternion.conjugate(before), quaternion.exp(frame_turn)), q)
    bias = np.where(scenario.orbits >= scenario.step_orbits, scenario.drift_rad_s, 0.0)
    sun = np.broadcast_to([0.0, 1.0, 0.0], (len(time_s), 3))
    sun_body = quaternion.rotate_back(q, sun)
    if scenario.outage_orbits is not None:
        out = (scenario.orbits >= scenario.outage_orbits) & (scenario.orbits < scenario.outage_end_orbits)
        sun_body[:, out] = np.nan
    record = VectorRecord(
        dt_s=np.full(len(time_s), h),
        rate_rad_s=quaternion.log(inertial) / h + bias[:, None],
        first_body=quaternion.rotate_back(q, field_T) + scenario.sigma_T * noise,
        second_body=sun_body,
        first_reference=field_T,
        second_reference=sun,
        frame_rate_rad_s=np.broadcast_to(frame_turn / h, (len(time_s), 3)),
    )
    return SatelliteRuns(scenario, q, bias, record)


def attitude(phases_rad: ArrayLike, amplitude_rad: float, time_s: ArrayLike) -> FloatArray:
    """Return the attitude of 3-2-1 Euler angles, amplitude·sin(2πt/(pT) + φ).

    Shape ``time_s`` (n,). ``phases_rad`` (R, 3): φ of roll, pitch and yaw. Returns (R, n, 4): orbital from body.
    """
    rate = 2.0 * math.pi / (ANGLE_PERIODS * ORBIT.period_s)
    angles = np.asarray(time_s, dtype=np.float64)[:, None] * rate + np.asarray(phases_rad)[:, None, :]
    roll, pitch, yaw = np.moveaxis(amplitude_rad * np.sin(angles), -1, 0)
    axes = np.eye(3)
    turns = [quaternion.exp(angle[..., None] * axes[axis]) for axis, angle in ((2, yaw), (1, pitch), (0, roll))]
    return quaternion.multiply(quaternion.multiply(turns[0], turns[1]), turns[2])


@lru_cache(maxsize=4)
def _field_orbital(n: int, dt_s: float) -> FloatArray:
    field_T = environment(ORBIT, ORBIT.epoch, dt_s * np.arange(n, dtype=np.float64)).b_orbital_T
    field_T.setflags(write=False)
    return field_T
