"""Uncertainty that a calibrated array and body state."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.bodies.body import MagnetBody
from magloc.calibration.bodies.model import DIRECTION, PLACE, STRENGTH, BodyProblem, BodyState
from magloc.calibration.observability import UNSEEN
from magloc.calibration.sensors import AXES, GAINS, OFFSET

_MOST_ROWS = 200


def with_posterior(
    problem: BodyProblem, state: BodyState, information: FloatArray, array: SensorArray, body: MagnetBody
) -> tuple[SensorArray, MagnetBody]:
    """Return the array and the body with their posterior uncertainty instead of the one that they state.

    Files state independent errors of single sensors and magnets. The posterior errors are correlated: most of them
    cancel in the readings. The stated ones are scaled by one factor, so that the variance of the readings that they
    imply is that of the posterior. Directions that the readings do not show are excluded.
    """
    value, vector = np.linalg.eigh(information)
    variance = np.where(value < UNSEEN, 0.0, 1.0 / (1.0 + np.maximum(value, 0.0)))
    covariance = (vector * variance) @ vector.T
    single = np.diagonal(covariance)
    J = _jacobian(problem, state)
    implied = float(np.sum(J**2 @ single))
    posterior = float(np.sum((J @ covariance) * J))
    factor = math.sqrt(posterior / implied) if implied > 0.0 else 0.0
    n = int(problem.free.sum())
    sensors = np.zeros(problem.prior.shape)
    sensors[problem.free] = factor * np.sqrt(single[:n])
    sensors *= problem.prior
    magnets = problem.magnet_prior * factor * np.sqrt(single[n:]).reshape(problem.magnet_prior.shape)
    return _with_sensor_errors(array, sensors), _with_magnet_errors(body, magnets)


def _jacobian(problem: BodyProblem, state: BodyState) -> FloatArray:
    """Return derivatives (m, p) of whitened readings by the estimated unknowns of sensors and magnets."""
    rows = np.unique(np.linspace(0, len(state.position_m) - 1, _MOST_ROWS).round().astype(np.intp))
    linear = problem.linearise(state)
    n_sensors = problem.array.n_sensors
    by_sensor = np.zeros((len(rows), n_sensors, 3, n_sensors, linear.by_sensor.shape[-1]))
    for i in range(n_sensors):
        by_sensor[:, i, :, i] = linear.by_sensor[rows, i]
    flat = by_sensor.reshape(len(rows) * n_sensors * 3, -1)
    both = np.concatenate([flat, linear.by_source[rows].reshape(len(flat), -1)], axis=1)
    return np.asarray(both[:, problem.estimated_indices])


def _with_sensor_errors(array: SensorArray, sigma: FloatArray) -> SensorArray:
    """Return the array whose sensors have their errors (N, 15), as far as they state some."""
    sensors = []
    for sensor, row in zip(array.sensors, sigma, strict=True):
        gain, axes, offset = (math.sqrt(float(np.mean(row[place] ** 2))) for place in (GAINS, AXES, OFFSET))
        sensors.append(
            replace(
                sensor,
                gain_uncertainty=gain if sensor.gain_uncertainty else 0.0,
                misalignment_rad=axes if sensor.misalignment_rad else 0.0,
                offset_uncertainty_T=offset if sensor.offset_uncertainty_T else 0.0,
            )
        )
    return replace(array, sensors=tuple(sensors))


def _with_magnet_errors(body: MagnetBody, sigma: FloatArray) -> MagnetBody:
    """Return the body whose magnets have their errors (K, 6)."""
    magnets = [
        replace(
            magnet,
            position_sigma_m=math.sqrt(float(np.mean(row[PLACE] ** 2))),
            moment_sigma_Am2=float(row[STRENGTH][0]) * magnet.modulus_Am2,
            direction_sigma_rad=math.sqrt(float(np.mean(row[DIRECTION] ** 2))),
        )
        for magnet, row in zip(body.magnets, sigma, strict=True)
    ]
    return replace(body, magnets=tuple(magnets))
