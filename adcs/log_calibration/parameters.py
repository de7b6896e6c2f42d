"""Parameters that a log is to determine, with their priors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray

AXES = "xyz"
PRIOR_MODULUS = 0.3
PRIOR_MATRIX, PRIOR_OFFSET_uT, PRIOR_LAG_S, PRIOR_CURRENT = 0.1, 100.0, 0.1, 0.2
"""Prior σ of an element of the soft iron, the hard iron [µT], the lag and the effect of a current's range [field]."""
PRIOR_GYRO_BIAS_RAD_S, PRIOR_GYRO_MATRIX, PRIOR_FORCE_M_S2 = math.radians(2.0), 0.01, 0.3
_PRIOR_GRAVITY_M_S2, _PRIOR_THRUST = 0.02, 1.0
SYMMETRIC = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])
"""Elements of the gyro's symmetric matrix of scales and axes."""
N_SHARED = 16
MODULUS, INCLINATION, GRAVITY, THRUST = 0, 1, 2, 15
GYRO_BIAS, GYRO_MATRIX, FORCE = slice(3, 6), slice(6, 12), slice(12, 15)


@dataclass(frozen=True, eq=False)
class FieldPrior:
    """Field of the Earth at the place of the log.

    Attributes
    ----------
    modulus_uT, inclination_rad : float
        Modulus, and the angle by which the field points down.
    modulus_sigma, inclination_sigma_rad : float
        Relative σ of the modulus and σ of the inclination.
    """

    modulus_uT: float = 47.0
    inclination_rad: float = 0.0
    modulus_sigma: float = PRIOR_MODULUS
    inclination_sigma_rad: float = 1.0

    @classmethod
    def of(cls, field_T: FloatArray, sigma_T: float) -> FieldPrior:
        """Return the prior of a field (3,), with up last, whose components have an error."""
        modulus = float(np.linalg.norm(field_T))
        down = math.asin(-float(field_T[2]) / modulus)
        return cls(1e6 * modulus, down, sigma_T / modulus, sigma_T / modulus)

    @property
    def is_known(self) -> bool:
        """True if the field is known from the place."""
        return self.modulus_sigma < PRIOR_MODULUS


@dataclass(frozen=True)
class Layout:
    """Order of the parameters: shared ones, then those of each magnetometer.

    Attributes
    ----------
    magnetometers, currents : tuple of str
    """

    magnetometers: tuple[str, ...]
    currents: tuple[str, ...]

    @property
    def per_sensor(self) -> int:
        """Number of parameters of a magnetometer."""
        return 13 + 3 * len(self.currents)

    @property
    def size(self) -> int:
        """Number of all parameters."""
        return N_SHARED + self.per_sensor * len(self.magnetometers)

    def matrix(self, m: int) -> slice:
        """Return the nine elements of a magnetometer's matrix, row by row."""
        begin = N_SHARED + self.per_sensor * m
        return slice(begin, begin + 9)

    def offset(self, m: int) -> slice:
        """Return the offset of a magnetometer."""
        end = self.matrix(m).stop
        return slice(end, end + 3)

    def lag(self, m: int) -> int:
        """Return the lag of a magnetometer."""
        return self.matrix(m).stop + 3

    def current(self, m: int) -> slice:
        """Return the fields of the currents at a magnetometer, one current after another."""
        begin = self.lag(m) + 1
        return slice(begin, begin + 3 * len(self.currents))

    def prior_sigma(self, field: FieldPrior, current_range: FloatArray) -> FloatArray:
        """Return the prior standard deviations of all parameters."""
        sigma = np.empty(self.size)
        sigma[MODULUS], sigma[INCLINATION] = field.modulus_sigma, field.inclination_sigma_rad
        sigma[GRAVITY], sigma[FORCE], sigma[THRUST] = _PRIOR_GRAVITY_M_S2, PRIOR_FORCE_M_S2, _PRIOR_THRUST
        sigma[GYRO_BIAS], sigma[GYRO_MATRIX] = PRIOR_GYRO_BIAS_RAD_S, PRIOR_GYRO_MATRIX
        for m in range(len(self.magnetometers)):
            sigma[self.matrix(m)], sigma[self.offset(m)] = PRIOR_MATRIX, PRIOR_OFFSET_uT
            sigma[self.lag(m)] = PRIOR_LAG_S
            sigma[self.current(m)] = np.repeat(PRIOR_CURRENT * field.modulus_uT / current_range, 3)
        return sigma


def field_enu_uT(modulus_uT: float, inclination_rad: float) -> tuple[FloatArray, FloatArray]:
    """Return a field with no component along x, and its derivative by the inclination."""
    c, s = math.cos(inclination_rad), math.sin(inclination_rad)
    return modulus_uT * np.array([0.0, c, -s]), modulus_uT * np.array([0.0, -s, -c])
