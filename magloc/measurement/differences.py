r"""Measurement model of an array: decorrelated differences of a dipole and their Jacobian.

All channels are predicted first: vector sensors as components of the field in their own axes, scalar sensors as the
exact modulus :math:`|B_a + B|`. Then they are combined to the independent differences of :mod:`arrays.differences`. The
state is (p, m): the source's position [m] in the array's frame and its moment [A·m²].

The source paper's ForwardMT and ForwardMV are :meth:`DifferenceMeasurement.predicted` here. Its JacobianH is
:meth:`DifferenceMeasurement.jacobian`, which is analytic; the paper's (11) takes central differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.io.values import numbers
from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.measurement.magnet import source_field, source_jacobian

_NICE_SIGNAL = 300.0
_NICE_RANGE = 3.0


def predicted_channels(
    array: SensorArray, position_m: ArrayLike, moment_Am2: ArrayLike, ambient_T: FloatArray | None = None
) -> FloatArray:
    """Return noise-free readings (..., C) [T] of a source in the array's frame, without offset.

    A component is ``a_c · (B_a + B)``, a modulus ``g |B_a + B|``. The ambient field B_a at each sensor follows from the
    array's ``ambient_T`` and ``ambient_gradient_T_m``; differences of both kinds contain the gradient. The argument
    `ambient_T` (N, 3) replaces it.
    """
    fields = fields_at_sensors(array, position_m, moment_Am2, ambient_T)
    return array.readings_of(fields) - array.channel_offset_T


def channel_jacobian(
    array: SensorArray, position_m: ArrayLike, moment_Am2: ArrayLike, ambient_T: FloatArray | None = None
) -> FloatArray:
    """Return the Jacobian (..., C, 6) of the channels by (p, m) [T/m], [T/(A·m²)].

    A modulus has the gradient of its field along the direction of the sum: equation (4) of the source paper.
    """
    p, m = np.asarray(position_m, dtype=np.float64), np.asarray(moment_Am2, dtype=np.float64)
    jacobian = source_jacobian(array, p, m)
    rows = array.channel_gain
    if array.channel_is_scalar.any():
        rows = array.linear_gain(fields_at_sensors(array, position_m, moment_Am2, ambient_T))
    return np.einsum("...ci,...cij->...cj", rows, jacobian[..., array.channel_sensor, :, :])


def fields_at_sensors(
    array: SensorArray, position_m: ArrayLike, moment_Am2: ArrayLike, ambient_T: FloatArray | None = None
) -> FloatArray:
    """Return the field at every sensor (..., N, 3) [T], the ambient field included."""
    p, m = np.asarray(position_m, dtype=np.float64), np.asarray(moment_Am2, dtype=np.float64)
    return source_field(array, p, m) + (array.ambient_fields if ambient_T is None else ambient_T)


@dataclass(frozen=True, eq=False)
class DifferenceMeasurement:
    """Measurement model of the decorrelated differences of one array.

    Attributes
    ----------
    differences : Differences
        Combinations of channels; see :func:`arrays.differences.decorrelated_differences` for missing readings, another
        base sensor or another noise.
    """

    array: SensorArray
    differences: Differences

    @classmethod
    def of(cls, array: SensorArray) -> DifferenceMeasurement:
        """Return the measurement of all channels of an array with its own noise."""
        return cls(array, decorrelated_differences(array))

    @property
    def variance(self) -> FloatArray:
        """Variances of the differences [T²], shape (k,)."""
        return self.differences.variance

    def measured(self, readings_T: ArrayLike) -> FloatArray:
        """Return decorrelated differences (..., k) [T] of raw readings (..., C).

        Equations (16) and (28) of the source paper.

        Channels that the differences do not use may be NaN.
        """
        transform = self.differences.transform
        used = np.any(transform != 0.0, axis=0)
        channels = numbers(readings_T) - self.array.channel_offset_T
        return channels[..., used] @ transform[:, used].T

    def predicted(
        self, position_m: ArrayLike, moment_Am2: ArrayLike, ambient_T: FloatArray | None = None
    ) -> FloatArray:
        """Return the predicted decorrelated differences (..., k) [T] of a source.

        The source is in the array's frame (ForwardMT, ForwardMV).
        """
        return predicted_channels(self.array, position_m, moment_Am2, ambient_T) @ self.differences.transform.T

    def jacobian(self, position_m: ArrayLike, moment_Am2: ArrayLike, ambient_T: FloatArray | None = None) -> FloatArray:
        """Return the Jacobian (..., k, 6) by (p, m) [T/m], [T/(A·m²)] (JacobianH)."""
        return self.differences.transform @ channel_jacobian(self.array, position_m, moment_Am2, ambient_T)


def suitable_dipole(array: SensorArray) -> tuple[FloatArray, FloatArray]:
    """Return position and moment of a dipole that an array locates well.

    It is three radii away, and its field a few hundred times the noise.
    """
    direction = np.array([2.0, 1.0, 2.0]) / 3.0
    distance = _NICE_RANGE * array.circumradius
    field_T = _NICE_SIGNAL * float(np.median(array.channel_noise_T))
    moment = one_digit(field_T * distance**3 / dipole.MU0_OVER_4PI)
    step = 10.0 ** np.floor(np.log10(array.circumradius) - 1.0)
    position = np.round((array.centroid + distance * direction) / step) * step
    return position, np.array([0.0, 0.0, moment])


def one_digit(value: float) -> float:
    """Round a positive number to one significant digit."""
    return float(f"{value:.0e}")
