r"""Figure of merit of a compensation.

The aircraft pitches, rolls and yaws on four headings. The figure is the sum of the peak-to-peak amplitudes of the
readings in these twelve manoeuvres. An amplitude is :math:`2 \sqrt 2` standard deviations of the readings in the band
of the manoeuvres, as of a sine.

Source: Geological Survey of Canada, "Guide to aeromagnetic specifications and contracts", Open File 2349 (1991).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.compensation.signals import band_passed

AXES = ("roll", "pitch", "yaw")
"""Turns about x, y and z of the array's frame."""
HEADINGS = 4
BAND_S = 2.5
"""Width of the Gaussian filter whose result is subtracted: periods above 20 s are no manoeuvres."""
_WINDOW_S = 5.0
_LEAST_RAD = 0.008  # least standard deviation of the direction of the field in a manoeuvre
_STEADY_RAD_S = 0.03  # largest rate of the direction beside manoeuvres; faster ones are turns between lines


@dataclass(frozen=True, eq=False)
class Manoeuvres:
    """Manoeuvres in a record.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    cell : ndarray of int, shape (n,)
        Heading times 3 plus axis; -1 outside manoeuvres.
    """

    time_s: FloatArray
    cell: IntArray

    @classmethod
    def of(cls, time_s: FloatArray, unit: FloatArray, turning: FloatArray | None = None) -> Manoeuvres:
        """Return the manoeuvres of directions (n, 3) of the ambient field in the array's frame.

        Rates (n, 3) of the array about its axes distinguish roll from yaw on headings along the field, where the
        direction alone does not.
        """
        fast = band_passed(time_s, unit, BAND_S)
        slow = unit - fast
        window = np.floor((time_s - time_s[0]) / _WINDOW_S).astype(np.intp)
        index = np.unique(window, return_inverse=True)[1]
        count = np.bincount(index)

        def mean(values: FloatArray) -> FloatArray:
            return np.stack([np.bincount(index, column) / count for column in values.T], axis=1)

        middle, size = mean(slow), np.sqrt(mean(fast**2).sum(axis=1))
        drift = np.linalg.norm(np.gradient(slow, time_s, axis=0), axis=1)
        steady = mean(drift[:, None])[:, 0] < _STEADY_RAD_S
        if turning is None:
            energy = np.stack([_explained(fast, slow, k, index) for k in range(3)], axis=1)
        else:
            energy = mean(band_passed(time_s, turning, BAND_S) ** 2)
        axis = np.argmax(energy, axis=1)
        cell = 3 * _headings(middle, (size > _LEAST_RAD) & steady) + axis
        cell[(size <= _LEAST_RAD) | ~steady] = -1
        return cls(time_s, cell[index])

    @property
    def n_found(self) -> int:
        """Number of different manoeuvres, of twelve."""
        return len(set(self.cell[self.cell >= 0].tolist()))

    def fast(self, values: FloatArray) -> FloatArray:
        """Return values (n, ...) in the band of the manoeuvres."""
        return band_passed(self.time_s, values, BAND_S)

    def figure_T(self, values_T: FloatArray) -> float:
        """Return the figure of merit of readings (n,).

        Without manoeuvres it is the amplitude of the whole record.
        """
        fast = self.fast(values_T)
        cells = [self.cell == cell for cell in np.unique(self.cell[self.cell >= 0])] or [np.ones(len(fast), np.bool_)]
        return 2.0 * math.sqrt(2.0) * float(sum(np.sqrt(np.mean(fast[of] ** 2)) for of in cells))


def _explained(fast: FloatArray, slow: FloatArray, axis: int, index: IntArray) -> FloatArray:
    """Return the part of the changes of a direction that turns about an axis explain, window by window."""
    by_turn = np.cross(slow, np.eye(3)[axis])
    along = np.sum(fast * by_turn, axis=1) ** 2 / np.maximum(np.sum(by_turn**2, axis=1), 1e-9)
    return np.asarray(np.bincount(index, along), np.float64)


def _headings(directions: FloatArray, used: BoolArray) -> IntArray:
    """Return headings 0 to 3 of directions (n, 3), relative to the grid of four headings that fits best."""
    heading = np.arctan2(directions[:, 1], directions[:, 0])
    grid = np.angle(np.exp(4j * heading[used]).sum()) / 4.0
    return np.asarray(np.round((heading - grid) / (np.pi / 2.0)).astype(np.intp) % HEADINGS)
