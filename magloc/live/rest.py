r"""Background of an array at rest: the mean reading of every channel while no source is near, and its uncertainty.

The mean of n rows is subtracted from all later rows. This removes offsets, the field of the Earth and that of iron
nearby. The error of the mean has variance :math:`σ^2/n` and is the same in all later rows: an uncertain offset.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from arrays.array import SensorArray
from arrays.io.errors import InputError, check_positive
from arrays.typing import FloatArray
from magloc.levels import SIGMA_OF_MAD
from magloc.readings import Readings, without_saturated
from magloc.tracking.rows import Row, rows_of

_LOG = logging.getLogger(__name__)
_OUTLIER = 5.0
_TOO_NOISY = 3.0
_MORE_NOISE = 1.2  # times the stated one
_MAD_EFFICIENCY = 0.37  # of a standard deviation by the median absolute deviation, beside the rms
# Twenty times the Earth's field: no array at rest scatters so much.
_LARGEST_SCATTER_T = 1e-3


@dataclass(frozen=True, eq=False)
class RestBackground:
    """Mean reading of every channel at rest.

    Attributes
    ----------
    mean_T : ndarray, shape (C,)
        Raw readings minus the offsets of the calibration; NaN for a channel without readings.
    sigma_T : ndarray, shape (C,)
        Standard deviation of the error of the mean.
    n_rows : int
    unsteady_sensors : tuple of str
        Ids of the sensors whose readings scattered by more than three times their noise.
    """

    mean_T: FloatArray
    sigma_T: FloatArray
    n_rows: int
    unsteady_sensors: tuple[str, ...]

    @classmethod
    def from_rows(cls, array: SensorArray, rows: Sequence[Row]) -> RestBackground:
        """Return the background of the rows of a rest, without outliers of each channel.

        Raises
        ------
        InputError
            Readings of a channel scatter by more than a millitesla.
        """
        values = np.array([row.readings_T for row in rows])
        stated = np.array([sensor.noise_T for sensor in array.sensors])[array.channel_sensor]
        known = np.isfinite(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = _column_medians(values)
            seen = SIGMA_OF_MAD * np.nan_to_num(_column_medians(np.abs(values - middle)))
            scatter = np.maximum(stated, seen)
            used = known & (np.abs(values - middle) <= _OUTLIER * scatter)
            count = used.sum(axis=0)
            mean = np.where(used, values, 0.0).sum(axis=0) / count
            sigma = scatter / np.sqrt(count)
        wild = (scatter > _LARGEST_SCATTER_T) & (scatter > stated)
        if wild.any():
            channel = int(np.argmax(wild))
            raise InputError(
                f"a rest: found readings of {array.ids[array.channel_sensor[channel]]} that scatter by"
                f" {1e9 * scatter[channel]:.3g} nT, expected an array at rest; leave wild readings empty."
            )
        noisy = scatter > _TOO_NOISY * stated
        unsteady = tuple(name for i, name in enumerate(array.ids) if noisy[array.channel_sensor == i].any())
        ratio = float(np.sqrt(np.mean((seen / stated)[known.any(axis=0)] ** 2))) if known.any() else 1.0
        ratio_sigma = 1.0 / math.sqrt(2.0 * _MAD_EFFICIENCY * max(1, int(known.sum())))
        _LOG.info(f"the background is taken from {len(rows)} rows")
        if unsteady:
            _LOG.warning(
                f"the readings of {', '.join(unsteady)} changed by more than three times their noise during the rest,"
                " expected an array that does not move; take the rest again."
            )
        elif ratio > max(_MORE_NOISE, 1.0 + 5.0 * ratio_sigma):
            _LOG.warning(
                f"the readings scatter during the rest by {ratio:.2g} times their noise, expected once; multiply"
                f" noise_nT of the array file by {ratio:.2g}."
            )
        return cls(mean - array.channel_offset_T, sigma, len(rows), unsteady)

    def subtract_from(self, row: Row) -> Row:
        """Return a row minus the background."""
        return replace(row, readings_T=row.readings_T - self.mean_T)

    def with_offset_uncertainty(self, array: SensorArray) -> SensorArray:
        """Return the array with the uncertainty of the background as its offset uncertainties."""
        sigma = [float(np.nanmax(self.sigma_T[array.channel_sensor == i], initial=0.0)) for i in range(array.n_sensors)]
        sensors = tuple(
            replace(sensor, offset_uncertainty_T=value if math.isfinite(value) else 0.0)
            for sensor, value in zip(array.sensors, sigma, strict=True)
        )
        return replace(array, sensors=sensors)


def subtract_rest(array: SensorArray, readings: Readings, rest_s: float) -> tuple[SensorArray, Readings]:
    """Subtract the mean of the first seconds of a record, in which no source is near.

    This removes the offsets of the sensors, the field of the Earth and that of iron nearby. The mean of n rows has an
    error of variance :math:`σ^2/n`, the same in all rows. The returned array states it as offset uncertainties.

    Parameters
    ----------
    array : SensorArray
        It must have vector sensors only.
    readings : Readings
        Rows of an array that stands still. Saturated readings become NaN.
    rest_s : float
        Duration of the rest, from the first row on [s].

    Returns
    -------
    array : SensorArray
        The array with the offset uncertainties that remain.
    readings : Readings
        All rows minus the mean.

    Raises
    ------
    InputError
        The array moves or has a scalar sensor, or no row is later than the rest.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> array, readings = magloc.subtract_rest(board.array, board.readings, 0.2)
    >>> len(readings) == len(board.readings)
    True
    """
    check_positive(rest_s=rest_s)
    check_rest(array, moves=readings.pose is not None)
    used = without_saturated(readings, array)
    rests = used.time_s - used.time_s[0] < rest_s
    if rests.all():
        last_s = float(used.time_s[-1] - used.time_s[0])
        raise InputError(f"a rest of {rest_s:g} s: found {last_s:g} s of readings, expected rows after the rest.")
    background = RestBackground.from_rows(array, list(rows_of(used[rests])))
    return background.with_offset_uncertainty(array), replace(used, values_T=used.values_T - background.mean_T)


def check_rest(array: SensorArray, *, moves: bool) -> None:
    """Raise InputError if the array moves or has scalar sensors: its background varies."""
    if moves:
        raise InputError("a rest: found rows with the array's pose, expected an array that does not move.")
    scalar = [sensor.id for sensor in array.sensors if sensor.kind == "scalar"]
    if scalar:
        raise InputError(f"a rest: found scalar sensor {scalar[0]}, expected vector sensors only.")


def _column_medians(values: FloatArray) -> FloatArray:
    """Return the median of every column without its NaNs; NaN for a column without a number."""
    columns = (column[np.isfinite(column)] for column in values.T)
    return np.array([np.median(column) if column.size else math.nan for column in columns])
