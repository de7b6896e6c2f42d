r"""The background of an array at rest: what its channels read while no source is there, and how well that is known.

The mean of n rows is subtracted from all later ones, and with it offsets, the field of the Earth and of iron nearby.
Its own error, of variance :math:`σ^2/n`, is the same in every later row: an uncertain offset.
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
from magloc.readings import Readings, without_saturated
from magloc.tracking.rows import Row, rows_of

_LOG = logging.getLogger(__name__)
_OUTLIER = 5.0
_MAD_TO_SIGMA = 1.4826
_TOO_NOISY = 3.0
# Scatter of a rest that no field at rest has: twenty times the Earth's.
_LARGEST_SCATTER_T = 1e-3


@dataclass(frozen=True, eq=False)
class Background:
    """What is subtracted.

    Attributes
    ----------
    mean_T : ndarray, shape (C,)
        Raw readings at rest, less the offsets that the calibration knows; NaN of a channel without readings.
    sigma_T : ndarray, shape (C,)
        Standard deviation of the mean's error.
    n_rows : int
    restless : tuple of str
        Ids of sensors whose readings scattered by more than three times their noise.
    """

    mean_T: FloatArray
    sigma_T: FloatArray
    n_rows: int
    restless: tuple[str, ...]

    @classmethod
    def of(cls, array: SensorArray, rows: Sequence[Row]) -> Background:
        """Return the background of the rows of a rest; readings far from their channel's median do not count.

        Raises
        ------
        InputError
            Readings of a channel scatter by more than a millitesla.
        """
        values = np.array([row.readings_T for row in rows])
        stated = np.array([sensor.noise_T for sensor in array.sensors])[array.channel_sensor]
        known = np.isfinite(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = _median(values)
            scatter = np.maximum(stated, _MAD_TO_SIGMA * np.nan_to_num(_median(np.abs(values - middle))))
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
        restless = tuple(name for i, name in enumerate(array.ids) if noisy[array.channel_sensor == i].any())
        _LOG.info(f"the background is taken from {len(rows)} rows")
        if restless:
            _LOG.warning(
                f"the readings of {', '.join(restless)} changed by more than their noise: was the array at rest?"
            )
        return cls(mean - array.channel_offset_T, sigma, len(rows), restless)

    def subtracted(self, row: Row) -> Row:
        """A row without it."""
        return replace(row, readings_T=row.readings_T - self.mean_T)

    def array(self, array: SensorArray) -> SensorArray:
        """The array whose offsets are as uncertain as the background, in place of what was said of them before."""
        sigma = [float(np.nanmax(self.sigma_T[array.channel_sensor == i], initial=0.0)) for i in range(array.n_sensors)]
        sensors = tuple(
            replace(sensor, offset_uncertainty_T=value if math.isfinite(value) else 0.0)
            for sensor, value in zip(array.sensors, sigma, strict=True)
        )
        return replace(array, sensors=sensors)


def subtract_rest(array: SensorArray, readings: Readings, rest_s: float) -> tuple[SensorArray, Readings]:
    """Subtract what an array reads at rest: the mean of a record's first seconds, in which no source is near.

    With it go the offsets of the sensors, the field of the Earth and that of iron nearby. The mean of n rows has an
    error of variance :math:`σ^2/n`, the same in all rows, which the returned array states as offset uncertainties.

    Parameters
    ----------
    array : SensorArray
        Vector sensors alone.
    readings : Readings
        Of an array that stands still. Readings that saturate become NaN.
    rest_s : float
        Length of the rest, from the first row on [s].

    Returns
    -------
    array : SensorArray
        The array with the offset uncertainties that are left.
    readings : Readings
        All rows, less the mean.

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
    refuse_rest(array, moves=readings.pose is not None)
    used = without_saturated(readings, array)
    rests = used.time_s - used.time_s[0] < rest_s
    if rests.all():
        last_s = float(used.time_s[-1] - used.time_s[0])
        raise InputError(f"a rest of {rest_s:g} s: found {last_s:g} s of readings, expected rows after the rest.")
    background = Background.of(array, list(rows_of(used[rests])))
    return background.array(array), replace(used, values_T=used.values_T - background.mean_T)


def refuse_rest(array: SensorArray, *, moves: bool) -> None:
    """Raise an InputError where a rest says nothing of later rows: an array that moves, a modulus."""
    if moves:
        raise InputError("a rest: found rows with the array's pose, expected an array that stands.")
    scalar = [sensor.id for sensor in array.sensors if sensor.kind == "scalar"]
    if scalar:
        raise InputError(f"a rest: found scalar sensor {scalar[0]}, expected vector sensors alone.")


def _median(values: FloatArray) -> FloatArray:
    """Of every column, NaN of one without a number."""
    columns = (column[np.isfinite(column)] for column in values.T)
    return np.array([np.median(column) if column.size else math.nan for column in columns])
