"""Made-up logs of an inertial unit that is turned by hand, with their truth."""

from __future__ import annotations

import numpy as np

from adcs import quaternion

FIELD_T = np.array([0.0, 20e-6, -43e-6])


def unit_log(seed=0, seconds=30.0, dt=0.04, rate=0.8, acceleration=0.3, turn=(0.0, 0.0, 0.0), shaken_s=0.0):
    """Three seconds of rest, then smooth turns: times, rates, accelerations, fields, and the true attitudes.

    ``turn``: when a turn begins, how long it takes, and by how much it goes. ``shaken_s``: for how long the unit is
    shaken from the start on.
    """
    rng = np.random.default_rng(seed)
    time_s = dt * np.arange(round(seconds / dt))
    moving = np.clip(time_s - 3.0, 0.0, 1.0)[:, None]

    def waves(slow, fast):
        phases = 2.0 * np.pi * (rng.uniform(slow, fast, (5, 3)) * time_s[:, None, None] + rng.random((5, 3)))
        found = (rng.standard_normal((5, 3)) * np.sin(phases)).sum(axis=1)
        return found / np.sqrt(np.mean(found**2))

    rates = rate / np.sqrt(3.0) * waves(0.05, 0.8) * moving
    at, lasts, angle = turn
    axis = rng.standard_normal(3)
    rates[(time_s > at) & (time_s <= at + lasts)] += axis / np.linalg.norm(axis) * angle / max(lasts, dt)
    moves = acceleration * waves(0.3, 2.0) * moving + 3.0 * waves(1.0, 3.0) * (time_s < shaken_s)[:, None]
    q = [quaternion.exp(0.4 * rng.standard_normal(3))]
    for w in rates[1:]:
        q.append(quaternion.multiply(q[-1], quaternion.exp(w * dt)))
    q = np.array(q)
    noise = rng.standard_normal((3, len(q), 3))
    return (
        time_s,
        rates + 0.005 * rng.standard_normal(3) + 0.003 * noise[0],
        quaternion.rotate_back(q, moves + np.array([0.0, 0.0, 9.81])) + 0.05 * noise[1],
        quaternion.rotate_back(q, FIELD_T) + 1e-7 * noise[2],
        q,
    )


def squares(track, q, rows, relative=False):
    """Squares (n,) of the errors of heading and of tilt in some rows, in units of σ; heading's errors too [rad]."""
    error = quaternion.multiply(track.q, quaternion.conjugate(q))
    heading = 2.0 * np.arctan2(error[:, 3], error[:, 0])
    heading = np.angle(np.exp(1j * (heading - heading[0] if relative else heading)))
    tilt = 2.0 * np.arctan2(np.hypot(error[:, 1], error[:, 2]), np.hypot(error[:, 0], error[:, 3]))
    sigma = track.sigma["level"]
    of_heading = np.square(heading / np.maximum(sigma[:, 2], 1e-9))
    return of_heading[rows], (tilt**2 / np.square(sigma[:, :2]).sum(axis=1))[rows], heading[rows]
