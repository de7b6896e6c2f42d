"""Runs of complementary filters on a satellite: ``adcs run complementary``."""

from __future__ import annotations

import math

import numpy as np

from adcs import quaternion
from adcs.complementary.adaptive import AdaptiveTuning, adaptive_track
from adcs.complementary.explicit import Gains, complementary_track
from adcs.complementary.names import Method, Rule
from adcs.complementary.outage import Substitution
from arrays.typing import FloatArray
from sims.attitude.complementary import SatelliteRuns, SatelliteScenario

RMS_ORBITS = (0.5, 3.0)
OUTAGE_MAX_FROM_ORBITS = 2.0


def errors_deg(runs: SatelliteRuns, method: Method, gains: Gains, outage: Rule | None) -> FloatArray:
    """Errors of roll, pitch and yaw (R, n, 3), in body axes, of one of the filters; ``outage`` stands for the Sun."""
    if method == "adaptive":
        q = adaptive_track(runs.record, AdaptiveTuning(first_sigma=runs.scenario.sigma_T)).q
    else:
        substitution = Substitution(outage or "magnetometer-only")
        q = complementary_track(runs.record, gains, method=method, substitution=substitution).q
    return np.degrees(2.0 * quaternion.error_vector(q, runs.q))


RUN_COLUMNS = (
    "rms_deg",
    "steady_rms_deg",
    "peak_deg",
    "outage_max_roll_deg",
    "outage_max_pitch_deg",
    "outage_max_yaw_deg",
)


def row_of_each(scenario: SatelliteScenario, errors: FloatArray) -> FloatArray:
    """Columns of RUN_COLUMNS, NaN where a run has none."""
    orbits, step, outage = scenario.orbits, scenario.step_orbits, scenario.outage_orbits
    late = math.inf if outage is None else outage
    steady = (orbits >= RMS_ORBITS[0]) & (orbits < step) if outage is None else (orbits >= 1.0) & (orbits < late)
    after = (orbits >= step) & (orbits < late)
    rows = np.full((len(errors), len(RUN_COLUMNS)), np.nan)
    for row, error in zip(rows, errors, strict=True):
        pooled = error[(orbits >= RMS_ORBITS[0]) & (orbits < RMS_ORBITS[1])]
        row[0] = math.sqrt(np.mean(pooled**2))
        row[1] = math.sqrt(np.mean(error[steady] ** 2))
        if after.any():
            row[2] = np.abs(error[after]).max()
        if outage is not None:
            row[3:] = np.abs(error[orbits >= OUTAGE_MAX_FROM_ORBITS]).max(axis=0)
    return rows
