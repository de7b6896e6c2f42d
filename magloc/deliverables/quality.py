"""Quality of a field log: sampling, gaps, lines, noise, faults of sensors, heading error, lag, coverage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.deliverables.coverage import coverage_of
from magloc.deliverables.heading import heading_error
from magloc.deliverables.lag import clock_lag
from magloc.deliverables.quality_result import GAP, Gaps, Quality
from magloc.localization.fit.prior import NOTHING_KNOWN
from magloc.measurement.plausibility import finite_median
from magloc.measurement.rows import check_magnitudes, check_order, concatenate_readings
from magloc.navigation.crossovers import clock_shift
from magloc.navigation.fixes import between_fixes
from magloc.navigation.flight_lines import flight_lines
from magloc.readings import Readings, without_saturated
from magloc.surveying.fit.sensor_order import exchanged_beside, size_of_anomalies, weaker_sensors_below
from magloc.surveying.piece import Ground
from magloc.surveying.preparation import FEWEST_ROWS, earlier_rows, field_moduli, unusable_readings, without_ambient
from magloc.terrain.surface import Terrain

_LEAST_LEVEL = 0.2  # least horizontal share of the ambient field: near the poles it is small
_FOURTH = math.sqrt(70.0)  # standard deviation of the fourth difference of white noise
_SHORTEST_GEOLOGY_M = 15.0


def check_quality(
    array: SensorArray, readings: Readings | Sequence[Readings], *, ground_m: float | Terrain = 0.0
) -> Quality:
    """Check the quality of a field log before it becomes a survey.

    Parameters
    ----------
    array : SensorArray
        States the noise of the sensors.
    readings : Readings or sequence of them
        In order of time, with the pose of the array. For the lag scalar sensors need the ambient field.
    ground_m : float or Terrain
        Height of the ground in the world frame [m], or terrain.

    Returns
    -------
    Quality
        Its ``checks`` are the rows of the table, its ``flags`` the names of faults.

    Raises
    ------
    ValueError
        The readings have no pose, are not in order of time, or are too few.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
    >>> magloc.check_quality(field.array, field.readings).flags
    []
    """
    rows = readings if isinstance(readings, Readings) else concatenate_readings(readings)
    if rows.array_position_m is None or rows.array_rotation is None:
        raise ValueError("Input readings must have the pose of the array in every row; instead received none.")
    if len(rows) < FEWEST_ROWS:
        raise ValueError(f"Input readings must have {FEWEST_ROWS} rows or more; instead received {len(rows)}.")
    check_order(rows)
    check_magnitudes(array)
    earlier = earlier_rows(rows)
    fixes = between_fixes(rows.time_s, rows.array_position_m, rows.array_rotation)
    held = 0.0 if fixes is None else fixes.held / len(rows)
    if fixes is not None:
        rows = replace(rows, array_position_m=fixes.position_m, array_rotation=fixes.rotation)
    place_m = rows.array_position_m
    assert place_m is not None
    terrain = ground_m if isinstance(ground_m, Terrain) else Terrain(ground_m)
    ground = Ground(NOTHING_KNOWN, terrain, _SHORTEST_GEOLOGY_M, math.inf)
    read_T, rows = field_moduli(array, rows.values_T), without_saturated(rows, array)
    stuck, spikes, clipped, unusable = unusable_readings(array, rows, ground.shallowest_m, terrain)
    moduli_T = np.where(unusable, np.nan, read_T)
    height_m = -terrain.depth_of(place_m)
    lines = flight_lines(rows.time_s, place_m, height_m, rows.lines)
    coverage = coverage_of(place_m[:, :2], lines)
    is_whole = ~unusable.any(axis=1)
    whole = rows[np.flatnonzero(is_whole)]
    variations_T = without_ambient(rows, moduli_T)
    of_rows_T = np.asarray(variations_T.mean(axis=1))
    anomalies_T = size_of_anomalies(variations_T, lines)
    clock = clock_shift(rows.time_s, place_m, of_rows_T, lines)
    return Quality(
        array,
        rows.time_s,
        place_m,
        height_m,
        _gaps(rows.time_s, place_m),
        lines,
        _fourth_differences(rows.time_s, moduli_T),
        unusable & ~stuck & ~spikes & ~clipped,
        stuck,
        spikes,
        [heading_error(place_m[:, :2], column, lines) for column in variations_T.T],
        None if coverage is None else clock_lag(array, whole, of_rows_T[is_whole], ground, coverage.spacing_m, clock),
        coverage,
        # Saturated readings count here: they show a wrong unit.
        np.array([finite_median(column) for column in np.where(stuck | spikes, np.nan, read_T).T]),
        held,
        _level_share(rows),
        clock,
        anomalies_T,
        weaker_sensors_below(array, whole, anomalies_T),
        exchanged_beside(array, rows, variations_T, lines) or (),
        clipped,
        earlier,
    )


def _gaps(time_s: FloatArray, place_m: FloatArray) -> Gaps:
    steps = np.diff(time_s)
    which = np.flatnonzero(steps > GAP * np.median(steps))
    return Gaps(time_s[which], steps[which], np.linalg.norm(place_m[which + 1] - place_m[which], axis=1))


def _fourth_differences(time_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return fourth differences (n, N) of rows at equal intervals, scaled to the noise of one row."""
    steps = np.diff(time_s)
    values = np.where(np.isfinite(values), values, np.nan)
    out = np.full(values.shape, np.nan)
    out[2:-2] = np.diff(values, 4, axis=0) / _FOURTH
    is_gap = steps > 0.5 * GAP * np.median(steps)
    beside = np.convolve(is_gap, np.ones(4), mode="valid") > 0.0
    out[2:-2][beside] = np.nan
    return out


def _level_share(rows: Readings) -> float:
    """Return the horizontal share of the ambient field; 1 where that is not known."""
    if rows.ambient_T is None or rows.array_rotation is None:
        return 1.0
    east, north, up = rows.array_rotation.apply(rows.ambient_T).mean(axis=0)
    return max(math.hypot(east, north) / math.hypot(east, north, up), _LEAST_LEVEL)
