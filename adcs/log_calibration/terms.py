"""Terms of a calibration in the units of a user, with σ, and the limits beyond which a term is not determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from adcs.log_calibration.parameters import (
    AXES,
    FORCE,
    GYRO_BIAS,
    FieldPrior,
    Layout,
)
from arrays.typing import BoolArray, FloatArray

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
LARGEST_FIELD_uT, LARGEST_PART, LARGEST_ANGLE_DEG, LARGEST_LAG_S = 1.0, 0.05, 2.0, 0.02
"""Largest σ of a determined term: field [µT], part of a field, angle of the axes [°], lag [s]."""
_USUAL_A = 20.0  # range of the current of a flight
LARGEST_RATE_DEG_S, LARGEST_FORCE_M_S2 = 0.25, 0.15
LEAST_KNOWN = 0.5
"""Largest σ of a determined term, in units of its prior's σ."""


@dataclass(frozen=True, eq=False)
class Terms:
    """Terms of a calibration.

    Attributes
    ----------
    names, units, kinds : tuple of str
    values, sigma, prior_sigma, largest : ndarray, shape (q,)
        Values, posterior and prior standard deviations, and the largest σ of a determined term.
    jacobian : ndarray, shape (q, p)
        Derivatives by the parameters of the fit.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kinds: tuple[str, ...]
    values: FloatArray
    sigma: FloatArray
    prior_sigma: FloatArray
    largest: FloatArray
    jacobian: FloatArray

    @property
    def determined(self) -> BoolArray:
        """Terms that the log determines."""
        return self.are_determined(self.sigma)

    def are_known(self, magnetometer: str, *kinds: str) -> bool:
        """Return True if all terms of some kinds of a magnetometer are determined."""
        rows = zip(self.names, self.kinds, self.determined, strict=True)
        return all(known for name, kind, known in rows if name.startswith(f"{magnetometer} ") and kind in kinds)

    def without(self, magnetometers: Sequence[str] | None = None) -> Terms:
        """Return the terms, those of some or all magnetometers marked as not determined by any motion."""
        ends = None if magnetometers is None else tuple(f"{name} " for name in magnetometers)
        gone = np.array([ends is None or name.startswith(ends) for name in self.names])
        return replace(self, largest=np.where(gone, 0.0, self.largest))

    def are_determined(self, sigma: FloatArray) -> BoolArray:
        """Return True for the terms whose σ would be small enough."""
        return np.asarray((sigma <= self.largest) & (sigma <= LEAST_KNOWN * self.prior_sigma))


def terms_of(
    layout: Layout,
    parameters: FloatArray,
    covariance: FloatArray,
    prior_sigma: FloatArray,
    mountings: FloatArray,
    field: FieldPrior,
    current_range: FloatArray,
) -> Terms:
    """Return the terms of a fit."""
    names, units, kinds, largest = _labels(layout, current_range)
    values = term_values(layout, parameters, mountings)
    jacobian = np.empty((len(values), layout.size))
    for i in range(layout.size):
        step = np.zeros(layout.size)
        step[i] = 1e-4 * max(prior_sigma[i], 1e-9)
        sides = (term_values(layout, parameters + sign * step, mountings) for sign in (1.0, -1.0))
        jacobian[:, i] = np.subtract(*sides) / (2.0 * step[i])
    sigma = np.sqrt(np.einsum("qi,ij,qj->q", jacobian, covariance, jacobian))
    prior = np.sqrt(np.sum((jacobian * prior_sigma) ** 2, axis=1))
    return Terms(names, units, kinds, values, sigma, prior, largest, jacobian)


def is_throttle(name: str) -> bool:
    """Return True for the name of a throttle, which is 1 at most; other channels are currents [A]."""
    return "throttle" in name.lower() or "control[" in name or name.endswith("ThO")


def soft_iron(matrix: FloatArray, mounting: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return scale, symmetric soft iron of trace 3 (sensor axes) and turn of the axes of a matrix, sensor from body."""
    turn, symmetric = polar(matrix, side="left")
    scale = float(np.trace(symmetric)) / 3.0
    return scale, symmetric / scale, Rotation.from_matrix(turn @ mounting.T).as_rotvec()


def term_values(layout: Layout, parameters: FloatArray, mountings: FloatArray) -> FloatArray:
    """Return the values of all terms."""
    values = []
    for m, mounting in enumerate(mountings):
        scale, symmetric, turn = soft_iron(parameters[layout.matrix(m)].reshape(3, 3), mounting)
        values += [*(1e3 * parameters[layout.offset(m)]), scale, *(symmetric[i, j] for i, j in _PAIRS)]
        values += [*np.degrees(turn), 1e3 * parameters[layout.lag(m)], *(1e3 * parameters[layout.current(m)])]
    return np.array([*values, *np.degrees(parameters[GYRO_BIAS]), *parameters[FORCE]])


def _labels(
    layout: Layout, current_range: FloatArray
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...], FloatArray]:
    """Return names, units, kinds and largest σ of the terms."""
    rows: list[tuple[str, str, str, float]] = []
    for name in layout.magnetometers:
        rows += [(f"{name} offset {axis}", "nT", "offset", 1e3 * LARGEST_FIELD_uT) for axis in AXES]
        rows += [(f"{name} scale", "1", "scale", LARGEST_PART)]
        rows += [(f"{name} soft iron {AXES[i]}{AXES[j]}", "1", "soft iron", LARGEST_PART) for i, j in _PAIRS]
        rows += [(f"{name} axes about {axis}", "deg", "axes", LARGEST_ANGLE_DEG) for axis in AXES]
        rows += [(f"{name} lag", "ms", "lag", 1e3 * LARGEST_LAG_S)]
        for current, size in zip(layout.currents, current_range, strict=True):
            limit = 1e3 * LARGEST_FIELD_uT / max(size, 1.0 if is_throttle(current) else _USUAL_A)
            rows += [(f"{name} {current} {axis}", "nT per unit", "current", limit) for axis in AXES]
    rows += [(f"gyro bias {axis}", "deg/s", "gyro", LARGEST_RATE_DEG_S) for axis in AXES]
    rows += [(f"accelerometer offset {axis}", "m/s2", "accelerometer", LARGEST_FORCE_M_S2) for axis in AXES]
    names, units, kinds, largest = zip(*rows, strict=True)
    return names, units, kinds, np.array(largest)
