"""Whitened rows of readings that miss the same channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.io.values import fields
from arrays.noise import covariance_blocks
from arrays.typing import BoolArray, FloatArray, IntArray
from arrays.whitening import Whitening, whitening, whitenings
from magloc.measurement.channels import signals_of
from magloc.measurement.known_moment import KnownMoment
from magloc.measurement.whitened import WhitenedModel
from magloc.readings import Readings

NO_SIGNAL = "the sensors' readings do not differ: no signal"
# Mean square of whitened differences below which they are rounding errors rather than noise.
_SILENT = 1e-9


@dataclass(frozen=True, eq=False)
class WhitenedRows:
    """Whitened rows of readings that miss the same channels.

    Attributes
    ----------
    index : ndarray of int, shape (b,)
        Indices of the rows in the readings.
    mask : ndarray of bool, shape (C,)
        Channels that have a reading.
    readings_T : ndarray, shape (b, C)
    raw : ndarray, shape (b, C)
        Readings divided by their noise.
    y : ndarray, shape (b, C)
        Readings divided by their noise, without the common field.
    """

    index: IntArray
    mask: BoolArray
    readings_T: FloatArray
    model: WhitenedModel
    raw: FloatArray
    y: FloatArray
    n_differences: int

    def __len__(self) -> int:
        return len(self.index)

    def select(self, rows: IntArray | BoolArray) -> WhitenedRows:
        """Return some of the rows."""
        at = np.arange(len(self))[rows]
        return replace(
            self,
            index=self.index[at],
            readings_T=self.readings_T[at],
            model=self.model.rows(at),
            raw=self.raw[at],
            y=self.y[at],
        )

    def marginalise(self, columns: FloatArray) -> WhitenedRows:
        """Return the rows with errors along columns (b, C, n) counted as noise.

        The errors have unit variance, the columns are in units of the noise.
        """
        model = self.model.marginalise(columns)
        return replace(self, model=model, y=model.whiten(self.raw))

    def with_known_moment(self, moment: KnownMoment | None) -> WhitenedRows:
        """Return the rows with a prior of the moment of every source."""
        return replace(self, model=replace(self.model, known=moment)) if moment is not None else self

    @cached_property
    def signals(self) -> FloatArray:
        """Whitened readings for the kernels of fits (b, C + k)."""
        return signals_of(self.model, self.y)

    @property
    def is_silent(self) -> BoolArray:
        """Rows (b,) whose differences are rounding errors."""
        squares = np.vecdot(self.y, self.y) if self.model.sees_moduli else self.energy
        return np.asarray(squares < _SILENT * self.n_differences)

    @cached_property
    def energy(self) -> FloatArray:
        """Sums of squared differences (b,): χ² without a source."""
        without = self.y - self.model.ambient_signals if self.model.sees_moduli else self.y
        return np.asarray(np.vecdot(without, without))


def whitened_rows(
    array: SensorArray, readings_T: FloatArray, ambient_T: FloatArray | None, at_once: int
) -> Iterator[WhitenedRows]:
    """Yield whitened rows of readings (n, C), grouped by missing channels.

    A group has at most `at_once` rows.
    """
    for mask, rows in rows_of_equal_mask(np.isfinite(readings_T)):
        for begin in range(0, rows.size, at_once):
            index = rows[begin : begin + at_once]
            readings, ambient = readings_T[index], None if ambient_T is None else ambient_T[index]
            of_rows = whitenings_of(array, mask, readings)
            model, raw = whitened_model(array, mask, readings, of_rows, ambient)
            yield WhitenedRows(index, mask, readings, model, raw, model.whiten(raw), of_rows.n_differences)


def check_rows(array: SensorArray, readings_T: ArrayLike) -> FloatArray:
    """Return raw readings (n, C) [T] as numbers; raise ValueError for another shape."""
    readings = fields(readings_T)
    if readings.ndim != 2 or readings.shape[1] != array.n_channels:
        raise ValueError(
            f"Input readings_T must have shape (n, {array.n_channels}); instead received {readings.shape}."
        )
    return readings


def rows_of_equal_mask(available: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.intp]]]:
    """Yield every distinct row of available channels (n, C), and the rows that have it."""
    if len(available) == 1 or (len(available) and (available == available[0]).all()):
        yield available[0], np.arange(len(available))
        return
    masks, of_row = np.unique(available, axis=0, return_inverse=True)
    for i, mask in enumerate(masks):
        yield mask, np.flatnonzero(of_row.ravel() == i)


def whitenings_of(array: SensorArray, mask: NDArray[np.bool_], readings_T: FloatArray) -> Whitening:
    """Return the whitening of rows (..., C) with the channels of a mask.

    All rows share one where the noise is constant.
    """
    if not array.noise_depends_on_reading:
        return whitening(array, mask)
    return whitenings(array, mask, covariance_blocks(array, readings_T))


def ambient_fields(array: SensorArray, n_rows: int, ambient_T: FloatArray | None) -> FloatArray:
    """Return the ambient field at every sensor in every row, (n, N, 3) [T].

    Fields of rows (n, 3) replace the array's own.
    """
    fields = np.broadcast_to(array.ambient_fields, (n_rows, array.n_sensors, 3))
    if ambient_T is None:
        return fields
    uniform = np.zeros(3) if array.ambient_T is None else np.asarray(array.ambient_T)
    return fields - uniform + ambient_T[:, None]


def channels_above_ambient(
    array: SensorArray, mask: BoolArray, readings_T: FloatArray, ambient_T: FloatArray | None
) -> FloatArray:
    """Return readings (n, C) minus the ambient field (n, N, 3); readings of scalar sensors do not change.

    None means the array's own field. Channels outside the mask (n, C) or (C,) are zero.
    """
    if ambient_T is None:
        above = readings_T - array.channel_ambient_T
    else:
        vector = ~array.channel_is_scalar
        ambient = np.einsum("ncj,cj->nc", ambient_T[:, array.channel_sensor], array.channel_gain) * vector
        above = readings_T - array.channel_offset_T - ambient
    return above if np.count_nonzero(mask) == mask.size else np.where(mask, above, 0.0)


def whitened_model(
    array: SensorArray,
    mask: BoolArray,
    readings_T: FloatArray,
    whitening: Whitening,
    ambient_T: FloatArray | None,
) -> tuple[WhitenedModel, FloatArray]:
    """Return the exact model of rows of readings (n, C), and their channels over the noise.

    :meth:`WhitenedModel.whiten` removes the common field from these channels. The whitening is one for all rows or one
    for each, and `ambient_T` (n, 3) replaces the array's ambient field.
    """
    if len(readings_T) == 1 and ambient_T is None and whitening.roots.ndim == 3:
        model = _model_of_one_row(array, whitening)
    else:
        model = WhitenedModel.of(array, whitening, ambient_fields(array, len(readings_T), ambient_T))
    above = None if ambient_T is None else model.ambient
    channels = channels_above_ambient(array, mask, readings_T, above)
    return model, whitening.of_unit_noise(channels)


@lru_cache(maxsize=16)  # rows that are fitted one by one share a model and its kernel structs
def _model_of_one_row(array: SensorArray, whitening: Whitening) -> WhitenedModel:
    return WhitenedModel.of(array, whitening, array.ambient_fields[None])


def concatenate_readings(parts: Sequence[Readings]) -> Readings:
    """Concatenate readings of several files.

    Raises ValueError if some have columns that others lack.
    """
    from scipy.spatial.transform import Rotation

    rotations = [part.array_rotation for part in parts if part.array_rotation is not None]
    return Readings(
        np.concatenate([part.values_T for part in parts]),
        time_s=np.concatenate([part.time_s for part in parts]),
        array_position_m=_concatenate_columns([part.array_position_m for part in parts]),
        array_rotation=Rotation.concatenate(rotations) if rotations else None,
        ambient_T=_concatenate_columns([part.ambient_T for part in parts]),
        pose_sigma=_concatenate_columns([part.pose_sigma for part in parts]),
        interpolated_m=_concatenate_columns([part.interpolated_m for part in parts]),
        lines=tuple(line for part in parts for line in part.lines),
    )


def _concatenate_columns(parts: Sequence[FloatArray | None]) -> FloatArray | None:
    given = [part for part in parts if part is not None]
    if given and len(given) < len(parts):
        raise ValueError("Input readings must have the same columns; instead received some with more than others.")
    return np.concatenate(given) if given else None


def check_spans(array: SensorArray) -> None:
    """Raise ValueError for a single sensor, which cannot determine a position."""
    if array.n_sensors < 2:
        raise ValueError("Input array must have at least two sensors if no position is known; instead received one.")


def check_order(readings: Readings) -> None:
    """Raise ValueError for rows that are not in order of time."""
    if not (np.diff(readings.time_s) > 0.0).all():
        raise ValueError("Input readings must be in order of time; instead received others.")


def check_magnitudes(array: SensorArray) -> None:
    """Raise ValueError for numbers whose squares exceed the range of double precision."""
    noise = array.channel_noise_T
    if noise.min() < 1e-20 or noise.max() > 1e3:
        raise ValueError(
            f"Input array must have a noise between 1e-11 and 1e12 nT; instead received {1e9 * noise.min():g} nT"
            f" to {1e9 * noise.max():g} nT."
        )
    if array.common_field_T is not None and array.common_field_T > 1e3:
        common_nT = 1e9 * array.common_field_T
        raise ValueError(f"Input array must have a common field of at most 1e12 nT; instead received {common_nT:g} nT.")
    if not np.abs(array.ambient_fields).max() <= 1e3:
        raise ValueError("Input array must have an ambient field of at most 1e12 nT; instead received a larger one.")
    fraction = float(array.noise_fractions.max())
    if fraction > 10.0:
        raise ValueError(f"Input array must have a noise_fraction of at most 10; instead received {fraction:g}.")
