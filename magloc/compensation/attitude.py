"""Ambient field in the axes of the platform: its direction from a vector sensor or a pose, and its modulus."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from arrays.sensor import Sensor
from arrays.typing import FloatArray
from magloc.compensation.signals import Signal, smooth_in_stretches
from magloc.compensation.terms import MATRICES, PlatformTerms

_SLOW_S = 10.0  # the modulus of the ambient field changes more slowly
_ITERATIONS = 3  # the field of a platform is small beside the ambient one
_SIGNIFICANT = 5.0  # least variance of a direction that turns, in units of its noise


@dataclass(frozen=True, eq=False)
class AttitudeErrors:
    """Lasting errors of a direction, as fields at the sensor that it comes from.

    Attributes
    ----------
    terms : PlatformTerms
    root : ndarray, shape (q, m)
        Square root of the covariance of their coefficients, in units of their priors.
    """

    terms: PlatformTerms
    root: FloatArray

    @classmethod
    def of_turn(cls, sigma_rad: float) -> AttitudeErrors:
        """Return the errors of axes that are turned by a constant small angle about each axis."""
        terms = PlatformTerms.of(Sensor("turn", "vector", (0.0, 0.0, 0.0), 1.0, induced_uncertainty=sigma_rad), (), 0.0)
        return cls(terms, math.sqrt(2.0) * np.eye(len(terms.names))[:, terms.turns])

    def columns(self, field_T: FloatArray, rate_T_s: FloatArray, currents: FloatArray) -> FloatArray:
        """Return the errors (n, 3, m) of the ambient field, of unit variance and across it."""
        errors = -self.terms.fields(field_T, rate_T_s, currents) @ self.root
        along = np.einsum("ni,nim->nm", field_T, errors) / np.sum(field_T**2, axis=1)[:, None]
        return np.asarray(errors - field_T[..., None] * along[:, None])


@dataclass(frozen=True, eq=False)
class Attitude:
    """Direction of the ambient field in the axes of the platform.

    Attributes
    ----------
    signal : Signal
        A field along it, of any modulus.
    kept : ndarray, shape (3, 3)
        Projection of its changes onto the axes along which it turns by more than its noise.
    mean : ndarray, shape (3,)
        Mean direction.
    errors : AttitudeErrors, optional
    """

    signal: Signal
    kept: FloatArray
    mean: FloatArray
    errors: AttitudeErrors | None = None

    @classmethod
    def of(cls, signal: Signal, noise: float) -> Attitude:
        """Return the attitude of a field with some relative noise in every row.

        Changes within the noise are ignored, because they would seem to determine coefficients.
        """
        values = signal.samples()[1]
        unit = values / np.linalg.norm(values, axis=1, keepdims=True)
        mean = unit.mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov(unit.T))
        turns = axes[:, spread > _SIGNIFICANT * noise**2 * signal.noise_share()]
        return cls(signal, turns @ turns.T, mean)

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return unit vectors and their rates (n, 3) at some times; NaN in gaps."""
        value, rate = self.signal.at(time_s), self.signal.at(time_s, rate=True)
        modulus = np.linalg.norm(value, axis=1, keepdims=True)
        unit = value / modulus
        turning = (rate - unit * np.sum(unit * rate, axis=1, keepdims=True)) / modulus
        return self.mean + (unit - self.mean) @ self.kept, turning @ self.kept

    def without(
        self,
        terms: PlatformTerms,
        coefficients: FloatArray,
        currents: Signal | None,
        covariance: FloatArray | None = None,
    ) -> Attitude:
        """Return the attitude without the field of the platform at its own vector sensor.

        The coefficients are in units of their priors, and so is their covariance, if they have errors.
        """
        stretches = []
        for spline in self.signal.stretches:
            time, read = spline.x, spline(spline.x)
            flowing, cleaned = currents_at(currents, time), spline
            for _ in range(_ITERATIONS):
                own = terms.fields(cleaned(time), cleaned(time, 1), flowing) @ coefficients
                cleaned = CubicSpline(time, read - np.nan_to_num(own))
            stretches.append(cleaned)
        errors = None if covariance is None else AttitudeErrors(terms, root_of(covariance))
        return replace(self, signal=replace(self.signal, stretches=tuple(stretches)), errors=errors)


def root_of(covariance: FloatArray) -> FloatArray:
    """Return a square root (q, q) of a covariance, whose smallest eigenvalues may be negative by rounding."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(values, 0.0)))


def currents_at(currents: Signal | None, time_s: FloatArray) -> FloatArray:
    """Return the currents (n, K) at some times; none without a signal."""
    return np.zeros((len(time_s), 0)) if currents is None else currents.at(time_s)


def platform_moduli(
    terms: PlatformTerms,
    coefficients: FloatArray,
    field_T: FloatArray,
    rate_T_s: FloatArray,
    currents: FloatArray,
    own_time_s: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the effect (n,) of a platform on the modulus of the ambient field, and its derivatives (n, q).

    Coefficients are in units of their priors. With times, the ambient field is the sensor's own reading without the
    platform's field, and changes with the coefficients.
    """
    fields = terms.fields(field_T, rate_T_s, currents)
    total = field_T + fields @ coefficients
    modulus = np.linalg.norm(total, axis=1)
    if own_time_s is None:
        columns = np.einsum("ni,niq->nq", total / modulus[:, None], fields)
    else:
        induced, eddy = terms.matrices(coefficients)
        by_field = induced @ fields + eddy @ np.gradient(fields, own_time_s, axis=0)
        columns = np.einsum("ni,niq->nq", field_T / np.linalg.norm(field_T, axis=1)[:, None], fields - by_field)
    # A gain is part of the modulus that is read; the ambient field that magnetises the platform is smaller by it.
    from_ambient = slice(3, 3 + 2 * len(MATRICES))
    magnetised = columns[:, from_ambient] @ coefficients[from_ambient]
    columns[:, terms.gain] = -math.sqrt(1.0 / 3.0) * terms.sigma[terms.gain] * magnetised
    return modulus - np.linalg.norm(field_T, axis=1), columns


def ambient_at(
    attitude: Attitude, time_s: FloatArray, modulus_T: FloatArray, lag_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return the ambient field and the rate of its turning (n, 3) in the platform's axes.

    The modulus (n,) is from the readings without the platform; its fast changes are noise and sources.
    """
    unit, turning = attitude.at(time_s + lag_s)
    slow = smooth_in_stretches(time_s, modulus_T, _SLOW_S)[:, None]
    return unit * slow, turning * slow


def attitude_effects(
    attitude: Attitude,
    time_s: FloatArray,
    terms: PlatformTerms,
    coefficients: FloatArray,
    field_T: FloatArray,
    rate_T_s: FloatArray,
    currents: FloatArray,
) -> FloatArray:
    """Return changes (n, m) of a platform's effect on the modulus by attitude errors of unit variance."""
    if attitude.errors is None:
        return np.zeros((len(time_s), 0))
    errors = attitude.errors.columns(field_T, rate_T_s, currents)
    turnings = np.nan_to_num(np.gradient(errors, time_s, axis=0))
    total = field_T + terms.fields(field_T, rate_T_s, currents) @ coefficients
    before, after = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (field_T, total))
    induced, eddy = terms.matrices(coefficients)
    along = np.einsum("ni,nim->nm", after - before, errors)
    return np.asarray(along + np.einsum("ni,nim->nm", after, induced @ errors + eddy @ turnings))
