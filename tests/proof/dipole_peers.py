"""Other ways to a dipole: least squares of scipy from random starts, a cylinder of magpylib, an EKF of filterpy.

Each gets the field in the array's frame after the array file's calibration, and the noise of the array file.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.fields import dipole


@dataclass(frozen=True, eq=False)
class Fits:
    """Position and moment of every row, their covariance, and the processor time of a row."""

    state: FloatArray
    covariance: FloatArray
    seconds: float


def calibrated_fields(array: SensorArray, values_T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return fields (n, S, 3) in the array's frame and their standard deviations (n, S, 1)."""
    field = array.calibrated_field(values_T)
    noise = np.array([sensor.noise_T for sensor in array.sensors])
    sigma = np.sqrt(noise**2 + (array.noise_fraction * np.linalg.norm(field, axis=-1)) ** 2)
    return field, sigma[..., None]


def dipole_residual(places: FloatArray, field: FloatArray, sigma: FloatArray, x: FloatArray) -> FloatArray:
    """Return the whitened residuals of a state (p, m)."""
    return ((dipole.field(places, x[:3], x[3:]) - field) / sigma).ravel()


def dipole_jacobian(places: FloatArray, sigma: FloatArray, x: FloatArray) -> FloatArray:
    """Return their derivative by the state."""
    return (dipole.field_jacobian(places, x[:3], x[3:]) / sigma[..., None]).reshape(-1, 6)


def as_fits(found: list[OptimizeResult], began: float) -> Fits:
    """Return the optima with the covariance of scipy's ``curve_fit``: scaled by the residuals."""
    seconds = (time.process_time() - began) / len(found)
    covariance = []
    for fit in found:
        factor = 2.0 * fit.cost / (len(fit.fun) - fit.x.size)
        covariance.append(factor * np.linalg.pinv(fit.jac.T @ fit.jac))
    return Fits(np.array([fit.x for fit in found]), np.array(covariance), seconds)


def random_starts(array: SensorArray, values_T: FloatArray, low: FloatArray, high: FloatArray, starts: int) -> Fits:
    """Best of the optima from random places in a box, each with the moment that fits best there."""
    rng, places = np.random.default_rng(0), array.positions
    fields, sigmas = calibrated_fields(array, values_T)
    began, found = time.process_time(), []
    for field, sigma in zip(fields, sigmas, strict=True):
        fits = []
        for place in rng.uniform(low, high, (starts, 3)):
            by_moment = dipole_jacobian(places, sigma, np.array([*place, 1.0, 0.0, 0.0]))[:, 3:]
            moment = np.linalg.lstsq(by_moment, (field / sigma).ravel())[0]
            start = np.concatenate([place, moment])
            fits.append(
                least_squares(
                    lambda x, f=field, s=sigma: dipole_residual(places, f, s, x),
                    start,
                    lambda x, s=sigma: dipole_jacobian(places, s, x),
                    method="lm",
                    x_scale="jac",
                )
            )
        found.append(min(fits, key=lambda fit: fit.cost))
    return as_fits(found, began)


def cylinders(
    array: SensorArray, values_T: FloatArray, dipoles: Fits, diameter_m: float, height_m: float, starts: int
) -> Fits:
    """Refine dipoles as cylinders of magpylib, magnetised along their axis, by least squares without a Jacobian."""
    from magpylib.magnet import Cylinder

    fields, sigmas = calibrated_fields(array, values_T)
    volume = 0.25 * np.pi * diameter_m**2 * height_m

    def field_of(x: FloatArray) -> FloatArray:
        strength = float(np.linalg.norm(x[3:]))
        turn = Rotation.align_vectors(x[None, 3:] / strength, [[0.0, 0.0, 1.0]])[0]
        polarization = (0.0, 0.0, 4e-7 * np.pi * strength / volume)
        source = Cylinder(dimension=(diameter_m, height_m), polarization=polarization, position=x[:3], orientation=turn)
        return np.asarray(source.getB(array.positions))

    began, found = time.process_time(), []
    for start, field, sigma in zip(dipoles.state, fields, sigmas, strict=True):
        found.append(
            least_squares(
                lambda x, f=field, s=sigma: ((field_of(x) - f) / s).ravel(), start, method="lm", x_scale=np.abs(start)
            )
        )
    fits = as_fits(found, began)
    return Fits(fits.state, fits.covariance, fits.seconds + dipoles.seconds)


def kalman_track(array: SensorArray, values_T: FloatArray, start: FloatArray, step_m: float, step_Am2: float) -> Fits:
    """Track by the extended Kalman filter of filterpy: a random walk with the true path's steps, from a good start."""
    from filterpy.kalman import ExtendedKalmanFilter

    places = array.positions
    fields, sigmas = calibrated_fields(array, values_T)
    one = np.ones((len(places), 1))
    filter_ = ExtendedKalmanFilter(dim_x=6, dim_z=3 * len(places))
    filter_.x = start.copy()
    filter_.P = np.diag(np.repeat(np.square([5.0 * step_m, 5.0 * step_Am2]), 3))
    filter_.Q = np.diag(np.repeat(np.square([step_m, step_Am2]), 3))
    states, covariances = [], []
    began = time.process_time()
    for field, sigma in zip(fields, sigmas, strict=True):
        filter_.predict()
        filter_.R = np.diag(np.repeat(np.square(sigma[:, 0]), 3))
        filter_.update(
            field.ravel(),
            lambda x: dipole_jacobian(places, one, x),
            lambda x: dipole.field(places, x[:3], x[3:]).ravel(),
        )
        states.append(filter_.x.copy())
        covariances.append(filter_.P.copy())
    return Fits(np.array(states), np.array(covariances), (time.process_time() - began) / len(states))


def linear_calibration(
    array: SensorArray, values_T: FloatArray, position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Return matrix and offset (S, 3, 4) by which each sensor's readings become the field of a known magnet."""
    readings = values_T.reshape(len(values_T), -1, 3)
    found = []
    for place, values in zip(array.positions, np.swapaxes(readings, 0, 1), strict=True):
        true = dipole.field(place, position_m, moment_Am2)
        known = np.column_stack([values, np.full(len(values), 1e-4)])
        found.append(np.linalg.lstsq(known, true)[0].T)
    return np.array(found)
