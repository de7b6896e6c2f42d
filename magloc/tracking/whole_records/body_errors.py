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
from magloc.chi_square import error_factor
from magloc.fields.multipole import DEFAULT_LENGTH, N_BODY_ERRORS, finite_body_errors
from magloc.measurement.differences import fields_at_sensors
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import steps_of
from magloc.tracking.whole_records.constants import placed_rows

# Largest number of rows, the latest: more rows change the error little.
_MOST_ROWS = 200
# Sum of squares of the body's readings, in units of the noise, below which it does not matter.
_NEGLIGIBLE = 1e-2


def body_factor(tracker: Tracker, rows: Sequence[Row], points: Sequence[TrackPoint]) -> float:
    """Return the ratio of the rms error of the last row, for a body, to its standard deviation.

    It is NaN if the range is not known. The body does not turn. Its length is a quarter of the least distance of the
    source from a sensor.
    """
    used = placed_rows(points)[-_MOST_ROWS:]
    source = {i: np.concatenate([points[i].position_m, points[i].moment_Am2]) for i, _ in used}
    measured = {i: tracker.measurements.of(rows[i]) for i in source}
    seen = {i: measurement for i, measurement in measured.items() if measurement.z.size}
    if not seen:
        return math.nan
    length_m = DEFAULT_LENGTH * min(_nearest_m(measurement, source[i]) for i, measurement in seen.items())
    errors = {i: _errors(measurement, source[i], length_m) for i, measurement in seen.items()}
    if not any(np.sum(columns**2) * len(errors) > _NEGLIGIBLE for columns in errors.values()):
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
    steps = steps_of(
        wider,
        [replace(seen[i], effect=np.concatenate([seen[i].effect, errors[i]], axis=1)) for i in seen],
        [np.concatenate([source[i], rest]) for i in seen],
    )
    S = steps[-1].S
    shift = S[:N_SOURCE] @ np.linalg.pinv(S[n : n + N_BODY_ERRORS])  # by errors that are taken for zero
    return float(error_factor(used[-1][1], shift @ shift.T))


def _nearest_m(measurement: RowMeasurement, source: FloatArray) -> float:
    """Return the distance of a source from the nearest sensor."""
    in_array = measurement.pose.to_array(source)
    return float(np.linalg.norm(measurement.model.array.positions - in_array[:3], axis=1).min())


def _errors(measurement: RowMeasurement, source: FloatArray, length_m: float) -> FloatArray:
    """Return the effect (k, 14) of a body's errors of one σ on a row, in units of the noise.

    The axes of the body are those of the world.
    """
    array, R = measurement.model.array, measurement.pose.R_world_from_array
    in_array = measurement.pose.to_array(source)
    fields = finite_body_errors((array.positions - in_array[:3]) @ R.T, source[3:], length_m)
    gain = array.linear_gain(fields_at_sensors(array, in_array[:3], in_array[3:]))
    columns = np.einsum("cj,ij,cin->cn", gain, R, fields[array.channel_sensor])
    return np.asarray(measurement.transform @ columns)
