r"""What an array measures of a dipole: predicted decorrelated differences and their Jacobian.

The predictions of all channels are formed first, vector sensors as components of the field in their own axes, scalar
sensors as the exact modulus :math:`|B_a + B|`, then combined to the independent differences of
:mod:`arrays.differences`. The state is (p, m): the source's position in the array's frame [m], its moment [A·m²].

The names of the source paper and ours: ForwardMT and ForwardMV are :meth:`DifferenceMeasurement.predicted`, JacobianH
is :meth:`DifferenceMeasurement.jacobian` (analytic; the paper's (11) takes central differences).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.typing import FloatArray
from magloc.fields import dipole


def predicted_channels(array: SensorArray, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
    """Noise-free readings of all channels, offset removed.

    Parameters
    ----------
    array : SensorArray
        With ``ambient_T`` where scalar sensors stand in an ambient field, and with ``ambient_gradient_T_m`` where it is
        not uniform, which differences between sensors of either kind see.
    position_m, moment_Am2 : array_like, shape (..., 3)
        Source in the array's frame [m], its moment [A·m²].

    Returns
    -------
    ndarray, shape (..., C)
        Readings minus offsets [T]: ``a_c · (B_a + B)`` for a component, ``g |B_a + B|`` for a modulus, with the ambient
        field B_a at each sensor.
    """
    fields = _fields(array, position_m, moment_Am2)
    return array.readings_of(fields) - array.channel_offset_T


def channel_jacobian(array: SensorArray, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
    """Derivative of :func:`predicted_channels` with respect to (p, m).

    Parameters
    ----------
    array : SensorArray
    position_m, moment_Am2 : array_like, shape (..., 3)
        Source in the array's frame [m], its moment [A·m²].

    Returns
    -------
    ndarray, shape (..., C, 6)
        [T/m] and [T/(A·m²)]. A modulus has the gradient of its field along the direction of the sum, equation (4).
    """
    p = np.asarray(position_m, dtype=np.float64)[..., None, :]
    m = np.asarray(moment_Am2, dtype=np.float64)[..., None, :]
    jacobian = dipole.field_jacobian(array.positions, p, m)
    rows = array.channel_gain
    if array.channel_is_scalar.any():
        fields = _fields(array, position_m, moment_Am2)
        with np.errstate(invalid="ignore", divide="ignore"):
            direction = fields / np.linalg.norm(fields, axis=-1, keepdims=True)
        rows = np.where(
            array.channel_is_scalar[:, None],
            array.channel_gain[:, :1] * direction[..., array.channel_sensor, :],
            array.channel_gain,
        )
    result: FloatArray = np.einsum("...ci,...cij->...cj", rows, jacobian[..., array.channel_sensor, :, :])
    return result


def _fields(array: SensorArray, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
    """Field at every sensor, the ambient field included: (..., N, 3) [T]."""
    p = np.asarray(position_m, dtype=np.float64)[..., None, :]
    m = np.asarray(moment_Am2, dtype=np.float64)[..., None, :]
    fields = dipole.field(array.positions, p, m)
    return fields + array.ambient_fields


@dataclass(frozen=True, eq=False)
class DifferenceMeasurement:
    """The decorrelated differences of one array, as a measurement model.

    Attributes
    ----------
    array : SensorArray
    differences : Differences
        Which combinations of channels are measured; see :func:`arrays.differences.decorrelated_differences` for missing
        readings, another base sensor or another noise.
    """

    array: SensorArray
    differences: Differences

    @classmethod
    def of(cls, array: SensorArray) -> DifferenceMeasurement:
        """All channels of an array, with its own noise."""
        return cls(array, decorrelated_differences(array))

    @property
    def variance(self) -> FloatArray:
        """Variances of the differences [T²], shape (k,)."""
        return self.differences.variance

    def measured(self, readings_T: ArrayLike) -> FloatArray:
        """Decorrelated differences of raw readings, equations (16) and (28).

        Parameters
        ----------
        readings_T : array_like, shape (..., C)
            Raw readings [T]. Entries of channels that the differences leave out may be NaN.

        Returns
        -------
        ndarray, shape (..., k)
            [T]
        """
        transform = self.differences.transform
        used = np.any(transform != 0.0, axis=0)
        channels = np.asarray(readings_T, dtype=np.float64) - self.array.channel_offset_T
        result: FloatArray = channels[..., used] @ transform[:, used].T
        return result

    def predicted(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
        """Predicted decorrelated differences (ForwardMT, ForwardMV).

        Parameters
        ----------
        position_m, moment_Am2 : array_like, shape (..., 3)
            Source in the array's frame [m], its moment [A·m²].

        Returns
        -------
        ndarray, shape (..., k)
            [T]
        """
        result: FloatArray = predicted_channels(self.array, position_m, moment_Am2) @ self.differences.transform.T
        return result

    def jacobian(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
        """Jacobian of :meth:`predicted` (JacobianH).

        Parameters
        ----------
        position_m, moment_Am2 : array_like, shape (..., 3)
            Source in the array's frame [m], its moment [A·m²].

        Returns
        -------
        ndarray, shape (..., k, 6)
            Columns (p, m): [T/m] and [T/(A·m²)].
        """
        result: FloatArray = self.differences.transform @ channel_jacobian(self.array, position_m, moment_Am2)
        return result

    def fisher_information(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
        """Information that one set of readings holds about (p, m): ``Hᵀ R⁻¹ H``.

        Parameters
        ----------
        position_m, moment_Am2 : array_like, shape (..., 3)
            Source in the array's frame [m], its moment [A·m²].

        Returns
        -------
        ndarray, shape (..., 6, 6)
            Its inverse is the Cramér-Rao bound.
        """
        w = self.jacobian(position_m, moment_Am2) / np.sqrt(self.variance)[:, None]
        information: FloatArray = np.swapaxes(w, -1, -2) @ w
        return information
