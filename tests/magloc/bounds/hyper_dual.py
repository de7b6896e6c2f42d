"""Second derivatives without a formula of our own, and the likelihood of all readings and nuisances together.

Hyper-dual numbers ``a + b ε₁ + c ε₂ + d ε₁ε₂`` with ε₁² = ε₂² = 0 carry a function's value, two first derivatives and
the second one, exactly: Fike and Alonso, "The development of hyper-dual numbers for exact second-derivative
calculations", AIAA 2011-886.
"""

from __future__ import annotations

import numpy as np


class HyperDual:
    """Numbers of shape (n, n): entry (i, j) carries the derivatives with respect to the variables i and j."""

    def __init__(self, a, b, c, d):
        self.parts = a, b, c, d

    @classmethod
    def variables(cls, x):
        n = len(x)
        i, j = np.indices((n, n))
        return [cls(np.full((n, n), x[k]), 1.0 * (i == k), 1.0 * (j == k), np.zeros((n, n))) for k in range(n)]

    def __add__(self, other):
        if not isinstance(other, HyperDual):
            a, b, c, d = self.parts
            return HyperDual(a + other, b, c, d)
        return HyperDual(*(x + y for x, y in zip(self.parts, other.parts, strict=True)))

    __radd__ = __add__

    def __neg__(self):
        return HyperDual(*(-x for x in self.parts))

    def __sub__(self, other):
        return self + (-other)

    def __rsub__(self, other):
        return -self + other

    def __mul__(self, other):
        if not isinstance(other, HyperDual):
            return HyperDual(*(x * other for x in self.parts))
        (a, b, c, d), (e, f, g, h) = self.parts, other.parts
        return HyperDual(a * e, a * f + b * e, a * g + c * e, a * h + b * g + c * f + d * e)

    __rmul__ = __mul__

    def __pow__(self, power):
        a, b, c, d = self.parts
        first, second = power * a ** (power - 1.0), power * (power - 1.0) * a ** (power - 2.0)
        return HyperDual(a**power, first * b, first * c, first * d + second * b * c)


def dot(x, y):
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def cross(x, y):
    return [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]


class Model:
    """Readings of an array as a function of source and nuisances, in parameters that are of the order of one.

    Parameters: position and moment in units of their sizes; the common field of the vector sensors and the common
    modulus of the scalar ones [nT]; error of the ambient field, turns, gains and what the field induces in units of
    their standard deviations.
    """

    def __init__(self, array, position, moment, ambient_uncertainty_T=0.0):
        self.array, self.ambient_uncertainty_T = array, ambient_uncertainty_T
        self.units = np.repeat([np.linalg.norm(position), np.linalg.norm(moment)], 3)
        self.truth = np.concatenate([position, moment]) / self.units
        prior = 0.0 if array.common_field_T is None else (1e9 * array.common_field_T) ** -2
        self.priors = []
        self.common = self._nuisances(3, prior)
        self.common_modulus = self._nuisances(1, prior)
        self.ambient = self._nuisances(3, 1.0)
        self.calibrations = [self._nuisances(6, 1.0) for _ in array.sensors]
        self.carriers = [self._nuisances(9 if s.induced_uncertainty else 0, 1.0) for s in array.sensors]

    def _nuisances(self, n, prior):
        first = 6 + len(self.priors)
        self.priors += [prior] * n
        return slice(first, first + n)

    def readings(self, x):
        array, units = self.array, self.units
        p, m = [x[i] * units[i] for i in range(3)], [x[i] * units[i] for i in range(3, 6)]
        for sensor, ambient, calibration, carrier in zip(
            array.sensors, array.ambient_fields, self.calibrations, self.carriers, strict=True
        ):
            d = [sensor.position_m[i] - p[i] for i in range(3)]
            r2, along = dot(d, d), dot(d, m)
            B = [1e-7 * (3.0 * along * d[i] * r2**-2.5 - m[i] * r2**-1.5) for i in range(3)]
            B = [B[i] + ambient[i] + self.ambient_uncertainty_T * x[self.ambient][i] for i in range(3)]
            if sensor.induced_uncertainty:
                induced = [dot(x[carrier][3 * i : 3 * i + 3], B) for i in range(3)]
                B = [B[i] + sensor.induced_uncertainty * induced[i] for i in range(3)]
            scale = sensor.calibration.scale
            if sensor.kind == "scalar":
                gain = 1.0 + sensor.gain_uncertainty * x[calibration][3]
                yield sensor, scale[0][0] * (gain * dot(B, B) ** 0.5 + 1e-9 * x[self.common_modulus][0])
                continue
            R = array.rotation_matrices[array.ids.index(sensor.id)]
            b = [dot(R[:, i], [B[k] + 1e-9 * x[self.common][k] for k in range(3)]) for i in range(3)]
            turn = [sensor.misalignment_rad * e for e in x[calibration][:3]]
            turned = cross(turn, b)
            b = [b[i] + turned[i] + sensor.gain_uncertainty * x[calibration][3 + i] * b[i] for i in range(3)]
            for row in scale:
                yield sensor, dot(row, b)

    def negative_log_posterior(self, x, measured):
        """Up to a constant; of readings that the truth gives without noise it is the expected one."""
        total = 0.0
        for (sensor, predicted), reading in zip(self.readings(x), measured, strict=True):
            residual = (predicted - reading) * (1.0 / np.hypot(sensor.noise_T, sensor.offset_uncertainty_T))
            total = total + 0.5 * residual * residual
        for value, prior in zip(x[6:], self.priors, strict=True):
            total = total + 0.5 * prior * value * value
        return total

    def covariance(self):
        """Inverse of the expected Hessian at the truth over all parameters, its part of (p, m)."""
        x = np.concatenate([self.truth, np.zeros(len(self.priors))])
        measured = [reading for _, reading in self.readings(x)]
        hessian = self.negative_log_posterior(HyperDual.variables(x), measured).parts[3]
        used = np.diagonal(hessian) > 0.0  # nuisances that this array does not have
        return np.linalg.inv(hessian[np.ix_(used, used)])[:6, :6] * self.units * self.units[:, None]
