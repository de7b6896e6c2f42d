"""Rows of readings that miss the same channels, whitened together."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.noise import reading_covariance
from arrays.typing import FloatArray
from arrays.whitening import Whitening, whitening, whitenings
from magloc.measurement.whitened import WhitenedModel

NO_SIGNAL = "the sensors' readings do not differ: no signal"


def checked_rows(array: SensorArray, readings_T: ArrayLike) -> FloatArray:
    """Raw readings (n, C) of an array [T] as numbers.

    Raises
    ------
    ValueError
        They have another shape.
    """
    readings = np.asarray(readings_T, dtype=np.float64)
    if readings.ndim != 2 or readings.shape[1] != array.n_channels:
        raise ValueError(
            f"Input readings_T must have shape (n, {array.n_channels}); instead received {readings.shape}."
        )
    return readings


def rows_of_equal_mask(available: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.intp]]]:
    """Every distinct row of available channels (n, C), and the rows that have it."""
    masks, of_row = np.unique(available, axis=0, return_inverse=True)
    for i, mask in enumerate(masks):
        yield mask, np.flatnonzero(of_row.ravel() == i)


def whitenings_of(array: SensorArray, mask: NDArray[np.bool_], readings_T: FloatArray) -> list[Whitening]:
    """Whitening of every row of readings (n, C) with the channels of a mask: one object where the noise is constant."""
    if not array.noise_depends_on_reading:
        return [whitening(array, mask)] * len(readings_T)
    return whitenings(array, mask, reading_covariance(array, readings_T))


def ambient_fields(array: SensorArray, n_rows: int, ambient_T: FloatArray | None) -> FloatArray:
    """Ambient field at every sensor in every row, (n, N, 3) [T]: the array's, or that of each row (n, 3) instead."""
    fields = np.broadcast_to(array.ambient_fields, (n_rows, array.n_sensors, 3))
    if ambient_T is None:
        return fields
    uniform = np.zeros(3) if array.ambient_T is None else np.asarray(array.ambient_T)
    return fields - uniform + ambient_T[:, None]


def whitened_model(
    array: SensorArray,
    mask: NDArray[np.bool_],
    readings_T: FloatArray,
    whitenings: list[Whitening],
    ambient_T: FloatArray | None,
) -> tuple[WhitenedModel, FloatArray]:
    """Exact model and whitened readings of rows that miss the same channels.

    Parameters
    ----------
    array : SensorArray
    mask : ndarray of bool, shape (C,)
        Channels that have a reading.
    readings_T : ndarray, shape (n, C)
        Raw readings [T].
    whitenings : list of Whitening
        One for every row.
    ambient_T : ndarray, shape (n, 3), optional
        Ambient field of every row [T], in place of the array's.

    Returns
    -------
    problem : WhitenedModel
    raw : ndarray, shape (n, C)
        What vector channels read above the ambient field, and all that scalar channels read, divided by the noise;
        :meth:`WhitenedModel.whitened` frees it from the common field.
    """
    fields = ambient_fields(array, len(readings_T), ambient_T)
    vector = ~array.channel_is_scalar
    ambient = np.einsum("ncj,cj->nc", fields[:, array.channel_sensor], array.channel_gain) * vector
    channels = np.where(mask, readings_T - array.channel_offset_T - ambient, 0.0)
    raw = np.stack([w.root @ row for w, row in zip(whitenings, channels, strict=True)])
    return WhitenedModel.of(array, whitenings, fields), raw
