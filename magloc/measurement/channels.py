"""Whitened channels for the kernels of fits: the C struct ``magloc_channels``.

A prior of the common field becomes additional readings of it. So the common field is always removed from the channels
by a projection, with or without a prior.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc import core

if TYPE_CHECKING:
    from magloc.measurement.whitened import WhitenedModel

# Largest difference of the weights of a sensor's axes.
_SAME_WEIGHT = 1e-12


def channels_of(model: WhitenedModel) -> core.Problem:
    """Return the channels of all rows of a model."""
    sets = slice(0, 1) if model.shares_whitening else slice(None)
    gain, basis, shrinkage = model.gain[sets], model.basis[sets], model.shrinkage[sets]
    known = _known_columns(model)
    n_sets, n_channels, n_common = basis.shape
    every_gain = np.zeros((n_sets, n_channels + known.size, 3))
    every_gain[:, :n_channels] = gain
    columns = np.zeros((n_sets, n_channels + known.size, n_common))
    columns[:, :n_channels] = basis * np.sqrt(shrinkage * (2.0 - shrinkage))[:, None]
    columns[:, n_channels + np.arange(known.size), known] = 1.0 - shrinkage[:, known]
    return problem(model, every_gain, columns, moduli=model.sees_moduli)


def problem(model: WhitenedModel, gain: FloatArray, columns: FloatArray, *, moduli: bool = False) -> core.Problem:
    """Return the channels of a model with gains (sets, C, 3) and columns (sets, C, c) to project out.

    Channels after those of the sensors are known parts of the common field. Without moduli all channels are linear.
    """
    n_sets, n_channels, n_common = columns.shape
    is_modulus = np.zeros(n_channels, dtype=np.uint8)
    is_modulus[: model.channel_is_scalar.size] = model.channel_is_scalar
    fields = model.ambient[:1] if model.shares_ambient else model.ambient
    n_known = n_channels - model.channel_sensor.size
    return core.problem(
        "channels",
        n_sensors=len(model.sensors),
        n_channels=n_channels,
        n_common=n_common,
        n_sets=n_sets,
        n_fields=len(fields),
        sensors=np.ascontiguousarray(model.sensors),
        first_channel=np.searchsorted(model.channel_sensor, np.arange(len(model.sensors) + 1)),
        gain=np.ascontiguousarray(gain),
        common=np.ascontiguousarray(columns.transpose(0, 2, 1)),
        is_modulus=is_modulus if moduli else None,
        ambient=np.ascontiguousarray(fields) if moduli else None,
        is_isotropic=n_sets == 1 and n_common == 3 and n_known == 0 and not moduli and _is_isotropic(model, gain[0]),
    )


def signals_of(model: WhitenedModel, y: FloatArray) -> FloatArray:
    """Return whitened readings (b, C), followed by those of known parts of the common field."""
    if len(model) and model.shares_whitening:
        if model.signal_matrix is None:
            return np.ascontiguousarray(y)
        return np.asarray((y[:, None] @ model.signal_matrix)[:, 0])  # one by one: the same for a row in any batch
    known = _known_columns(model)
    if not known.size:
        return np.ascontiguousarray(y)
    basis, shrinkage = model.basis[..., known], model.shrinkage[:, known]
    along = (y[:, None] @ basis)[:, 0]
    of_channels = y - (basis @ (shrinkage * along)[..., None])[..., 0]
    return np.concatenate([of_channels, -np.sqrt(shrinkage * (2.0 - shrinkage)) * along], axis=1)


def signal_matrix_of(model: WhitenedModel) -> FloatArray | None:
    """Return the matrix (C, C + k) of :func:`signals_of` of rows that share a whitening; None if nothing is known."""
    known = _known_columns(model)
    if not known.size:
        return None
    basis, shrinkage = model.basis[0][:, known], model.shrinkage[0, known]
    free = np.eye(len(basis)) - (shrinkage * basis) @ basis.T
    return np.concatenate([free, -np.sqrt(shrinkage * (2.0 - shrinkage)) * basis], axis=1)


def _known_columns(model: WhitenedModel) -> NDArray[np.intp]:
    """Return the columns of the common field that have a prior."""
    return np.flatnonzero((model.shrinkage < 1.0).any(axis=0))


def _is_isotropic(model: WhitenedModel, gain: FloatArray) -> bool:
    """Return whether all gains (C, 3) of vector sensors are scaled rotations."""
    n_sensors = len(model.sensors)
    if not np.array_equal(model.channel_sensor, np.arange(3 * n_sensors) // 3):
        return False
    of_sensors = gain.reshape(n_sensors, 3, 3)
    squares = of_sensors.transpose(0, 2, 1) @ of_sensors
    weight = squares[:, :1, :1]
    return bool(np.all(np.abs(squares - weight * np.eye(3)) <= _SAME_WEIGHT * weight))
