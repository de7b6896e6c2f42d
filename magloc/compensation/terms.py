"""Terms of the field of a platform at one sensor, with their priors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arrays.sensor import Sensor
from arrays.typing import FloatArray, IntArray
from magloc.measurement.platform_field import matrix_effects

PERMANENT_T, INDUCED, EDDY_S = 2e-6, 0.05, 0.05
"""Prior standard deviations of a sensor whose array file states none."""
CURRENT_T = 1e-6
"""Prior standard deviation of the field per unit of a current's column."""
# Orthonormal 3×3 matrices, so that equal priors of all elements stay equal and independent.
_SYMMETRIC = {
    "trace": np.eye(3) / math.sqrt(3.0),
    "xx-yy": np.diag([1.0, -1.0, 0.0]) / math.sqrt(2.0),
    "2zz-xx-yy": np.diag([-1.0, -1.0, 2.0]) / math.sqrt(6.0),
}
_PAIRS = {"yz": (1, 2), "xz": (0, 2), "xy": (0, 1)}


def _matrices() -> dict[str, FloatArray]:
    """Return the matrices by their names: three on the diagonal, three symmetric and three antisymmetric ones."""
    named, half = dict(_SYMMETRIC), math.sqrt(0.5)
    for sign, word in ((1.0, "+"), (-1.0, "-")):
        for name, (i, j) in _PAIRS.items():
            matrix = np.zeros((3, 3))
            matrix[i, j], matrix[j, i] = half, sign * half
            named[f"{name}{word}{name[::-1]}"] = matrix
    return named


MATRICES = _matrices()
"""Orthonormal basis of the matrices of induced fields and of eddy currents."""
_BASIS = np.stack([matrix.ravel() for matrix in MATRICES.values()], axis=1)


@dataclass(frozen=True, eq=False)
class PlatformTerms:
    """Terms of the field of a platform at one sensor.

    Attributes
    ----------
    names, units : tuple of str
        Names, and the units of printed coefficients.
    printed : ndarray, shape (q,)
        Printed value of a coefficient of 1 in SI units.
    sigma : ndarray, shape (q,)
        Prior standard deviations.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    printed: FloatArray
    sigma: FloatArray

    @classmethod
    def of(cls, sensor: Sensor, currents: Sequence[str], current_T: float) -> PlatformTerms:
        """Return the terms of a sensor; the platform's priors are those that the sensor states, or wide ones."""
        stated = (sensor.offset_uncertainty_T, sensor.induced_uncertainty, sensor.eddy_uncertainty_s)
        sizes = stated if any(stated) else (PERMANENT_T, INDUCED, EDDY_S)
        names = [f"permanent {axis}" for axis in "xyz"]
        names += [f"{kind} {name}" for kind in ("induced", "eddy") for name in MATRICES]
        names += [f"{current} {axis}" for current in currents for axis in "xyz"]
        n = 3 * len(currents)
        units = ["nT"] * 3 + ["1"] * 9 + ["s"] * 9 + ["nT per unit"] * n
        sigma = np.concatenate([np.repeat(sizes, (3, 9, 9)), np.full(n, current_T)])
        printed = np.array([1e9 if unit.startswith("nT") else 1.0 for unit in units])
        return cls(tuple(names), tuple(units), printed, sigma)

    @property
    def gain(self) -> int:
        """Index of the trace of the induced field, which is a change of the gain that no manoeuvre shows."""
        return self.names.index("induced trace")

    @property
    def turns(self) -> IntArray:
        """Indices of the antisymmetric induced terms, which turn the axes."""
        return np.array([self.names.index(f"induced {name}") for name in MATRICES if "-" in name and "xx" not in name])

    @property
    def stretches(self) -> IntArray:
        """Indices of the symmetric induced terms without the trace."""
        return np.setdiff1d(np.arange(3, 3 + len(MATRICES)), [self.gain, *self.turns])

    def matrices(self, coefficients: FloatArray) -> FloatArray:
        """Return the matrices (2, 3, 3) of induced fields and of eddy currents, for coefficients in their priors."""
        n = len(MATRICES)
        own = (coefficients * self.sigma)[3 : 3 + 2 * n].reshape(2, n)
        return np.asarray((own @ _BASIS.T).reshape(2, 3, 3))

    def fields(self, field_T: FloatArray, rate_T_s: FloatArray, currents: FloatArray) -> FloatArray:
        """Return the fields (n, 3, q) of the terms, each of the size of its prior.

        Ambient field and rate (n, 3) are those in the platform's axes, and ``currents`` is (n, K).
        """
        n, unit = len(field_T), np.eye(3)
        parts = [np.broadcast_to(unit, (n, 3, 3))]
        parts += [matrix_effects(unit, each[:, None]) @ _BASIS for each in (field_T, rate_T_s)]
        parts += [current[:, None, None] * unit for current in currents.T]
        return np.concatenate(parts, axis=2) * self.sigma
