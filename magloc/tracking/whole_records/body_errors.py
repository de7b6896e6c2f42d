"""Error of a track of a point source if the object is a body of the default length.

The field of a body beyond that of its dipole is similar in successive rows, so that χ² does not show it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray
from magloc.fields.multipole import DEFAULT_LENGTH, N_BODY_ERRORS, finite_body_errors
from magloc.measurement.differences import fields_at_sensors
from magloc.measurement.magnet import magnet_of
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import steps_of
from magloc.tracking.whole_records.constants import neglected_error_factor, placed_rows

# Largest number of rows, the latest: more rows change the error little.
_MOST_ROWS = 200
# Sum of squares of the body's readings, in units of the noise, below which it does not matter.
_NEGLIGIBLE = 1e-2


def body_factor(tracker: Tracker, rows: Sequence[Row], points: Sequence[TrackPoint]) -> float:
    """Return the ratio of the rms error of the last row, for a body, to its standard deviation.

    It is NaN if the range is not known, and 1 for a magnet of known shape. The body does not turn. Its length is a
    quarter of the least distance of the source from a sensor.
    """
    if magnet_of(tracker.array) is not None:
        return 1.0
    used = placed_rows(points)[-_MOST_ROWS:]
    measured = ((tracker.measurements.of(rows[row.index]), row.source) for row in used)
    seen = [(measurement, source) for measurement, source in measured if measurement.z.size]
    if not seen:
        return math.nan
    length_m = DEFAULT_LENGTH * min(_nearest_m(*of_row) for of_row in seen)
    errors = [_errors(*of_row, length_m) for of_row in seen]
    if not any(np.sum(columns**2) * len(errors) > _NEGLIGIBLE for columns in errors):
        return 1.0
    wider, own = copy.copy(tracker), tracker.errors
    none, n = np.zeros(N_BODY_ERRORS), tracker.motion.n_states + tracker.n_errors
    wider.errors = replace(
        own,
        sigma=np.concatenate([own.sigma, none + 1.0]),
        decay_Hz=np.concatenate([own.decay_Hz, none]),
        walk=np.concatenate([own.walk, none]),
    )
    rest = np.zeros(tracker.motion.n_states - N_SOURCE + wider.n_errors)
    effects = [np.concatenate([row.effect, columns], axis=1) for (row, _), columns in zip(seen, errors, strict=True)]
    with_bodies = [replace(row, effect=effect) for (row, _), effect in zip(seen, effects, strict=True)]
    S = steps_of(wider, with_bodies, [np.concatenate([source, rest]) for _, source in seen])[-1].S
    return neglected_error_factor(used[-1].covariance, S, S[n : n + N_BODY_ERRORS])


def _nearest_m(measurement: RowMeasurement, source: FloatArray) -> float:
    """Return the distance of a source from the nearest sensor."""
    in_array = measurement.pose.to_array(source)
    return float(np.linalg.norm(measurement.model.array.positions - in_array[:3], axis=1).min())


def _errors(measurement: RowMeasurement, source: FloatArray, length_m: float) -> FloatArray:
    """Return the effect (k, 14) of a body's errors of one σ on a row, in units of the noise.

    The axes of the body are parallel to the world's.
    """
    array, R = measurement.model.array, measurement.pose.R_world_from_array
    in_array = measurement.pose.to_array(source)
    fields = finite_body_errors((array.positions - in_array[:3]) @ R.T, source[3:], length_m)
    gain = array.linear_gain(fields_at_sensors(array, in_array[:3], in_array[3:]))
    columns = np.einsum("cj,ij,cin->cn", gain, R, fields[array.channel_sensor])
    return np.asarray(measurement.transform @ columns)
