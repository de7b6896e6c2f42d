"""Dipole from field and gradient tensor in closed form, to compare with fits of differences.

Vector sensors at the offsets δ from their centroid see B + G δ, as long as the field is linear across the array; B and
the five numbers of the symmetric, traceless G follow by least squares. A dipole's field is homogeneous of degree -3 in
the offset d from the dipole, so Euler's theorem gives

    G d = -3 B,   m = (r³/k) (3/2 n nᵀ - I) B,   r = |d|, n = d/r.

Nonlinearity of the field across the array, of relative size edge over distance, is an error that no averaging removes.
:func:`magloc.locate` predicts the differences exactly. So it does not have this error, and it does not need the field
of the source alone.

Source: T. Nara, S. Suzuki, S. Ando, "A closed-form formula for magnetic dipole localization by measurement of its
magnetic field and spatial gradients", IEEE Transactions on Magnetics 42 (2006).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.fields.dipole import MU0_OVER_4PI

N_UNKNOWNS = 8
# Basis of the symmetric, traceless tensors: G = Σ g_i E_i with g = (xx, xy, xz, yy, yz).
_TENSORS = np.array(
    [
        [[1, 0, 0], [0, 0, 0], [0, 0, -1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, -1]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ],
    dtype=np.float64,
)


@dataclass(frozen=True, eq=False)
class GradientTensor:
    """Field and gradient tensor at the centroid of an array, and their dipole.

    Attributes
    ----------
    centroid_m : ndarray, shape (3,)
        Centroid of the sensors [m].
    field_T : ndarray, shape (..., 3)
        Field of the source at the centroid [T].
    tensor_T_m : ndarray, shape (..., 3, 3)
        Gradient of the field, symmetric and traceless [T/m].

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> here, p, m = np.zeros(3), [5.0, 0.0, 1.0], [30.0, 0.0, 100.0]
    >>> field_T, tensor_T_m = magloc.dipole.field(here, p, m), magloc.dipole.gradient_tensor(here, p, m)
    >>> magloc.GradientTensor(here, field_T, tensor_T_m).position_m.round(6)
    array([5., 0., 1.])
    """

    centroid_m: FloatArray
    field_T: FloatArray
    tensor_T_m: FloatArray

    @property
    def position_m(self) -> FloatArray:
        """Position of the dipole, shape (..., 3); not finite if the tensor is singular.

        The tensor is singular for a moment across the line of sight.
        """
        return self.centroid_m - self._offset

    @property
    def moment_Am2(self) -> FloatArray:
        """Moment of the dipole, shape (..., 3)."""
        r = np.linalg.norm(self._offset, axis=-1, keepdims=True)
        n = self._offset / r
        along = np.sum(n * self.field_T, axis=-1, keepdims=True)
        return r**3 / MU0_OVER_4PI * (1.5 * along * n - self.field_T)

    @property
    def _offset(self) -> FloatArray:
        """Centroid relative to the dipole, -3 G⁻¹ B, by Cramer's rule.

        A singular tensor raises no error.
        """
        a, b, c = np.moveaxis(self.tensor_T_m, -2, 0)
        adjugate = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
        determinant = np.sum(a * adjugate[..., 0, :], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return -3.0 * (adjugate @ self.field_T[..., None])[..., 0] / determinant[..., None]


def fit_gradient_tensor(array: SensorArray, readings_T: ArrayLike) -> GradientTensor:
    """Fit field and gradient tensor at the centroid of an array by least squares.

    A stated ambient field of the array is subtracted first: the closed form needs the field of the source alone.

    Parameters
    ----------
    array : SensorArray
        Array of vector sensors that are not in one line.
    readings_T : array_like, shape (..., C)
        Raw readings [T]. The result of a row with missing readings is NaN.

    Returns
    -------
    GradientTensor
        Result in the array's frame, with the leading axes of the readings.

    Raises
    ------
    ValueError
        The array has scalar sensors, or its sensors are in one line.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> array, p, m = arrays.tetrahedron(0.5), [5.0, 0.0, 1.0], [30.0, 0.0, 100.0]
    >>> readings = array.readings_of(magloc.dipole.field(array.positions, p, m))
    >>> magloc.fit_gradient_tensor(array, readings).position_m.round(2)
    array([4.75, 0.  , 0.94])
    """
    if array.channel_is_scalar.any():
        raise ValueError("Input array must have vector sensors only; instead received one with scalar sensors.")
    offsets = (array.positions - array.centroid) / array.circumradius
    of_field = np.broadcast_to(np.eye(3), (array.n_sensors, 3, 3))
    design = np.concatenate([of_field, np.einsum("gij,nj->nig", _TENSORS, offsets)], axis=2).reshape(-1, N_UNKNOWNS)
    weight = 1.0 / np.repeat([sensor.row_noise_T for sensor in array.sensors], 3)
    if np.linalg.matrix_rank(weight[:, None] * design) < N_UNKNOWNS:
        raise ValueError("Input array must have sensors that are not in one line; instead received some that are.")
    fields = array.calibrated_field(readings_T) - array.ambient_fields
    solved = (np.linalg.pinv(weight[:, None] * design) * weight) @ fields.reshape(*fields.shape[:-2], -1, 1)
    tensor = np.einsum("...g,gij->...ij", solved[..., 3:, 0], _TENSORS) / array.circumradius
    return GradientTensor(array.centroid, solved[..., :3, 0], tensor)
