"""Runs of complementary filters on a satellite: ``adcs run complementary``."""

from __future__ import annotations

import math

import numpy as np

from adcs import quaternion
from adcs.complementary.adaptive import AdaptiveTuning, adaptive_track
from adcs.complementary.explicit import Gains, complementary_track
from adcs.complementary.names import Method, Rule
from adcs.complementary.outage import Substitution
from arrays.typing import BoolArray, FloatArray
from sims.attitude.complementary import SatelliteRuns, SatelliteScenario

RMS_ORBITS = (0.5, 3.0)
OUTAGE_MAX_FROM_ORBITS = 2.0


def errors_deg(runs: SatelliteRuns, method: Method, gains: Gains, outage: Rule | None) -> FloatArray:
    """Return errors of roll, pitch and yaw (R, n, 3) [°] of a filter, in body axes."""
    if method == "adaptive":
        q = adaptive_track(runs.record, AdaptiveTuning(first_sigma=runs.scenario.sigma_T)).q
    else:
        substitution = Substitution(outage or "magnetometer-only")
        q = complementary_track(runs.record, gains, method=method, substitution=substitution).q
    return np.degrees(2.0 * quaternion.error_vector(q, runs.q))


OUTAGE_COLUMNS = ("outage_max_roll_deg", "outage_max_pitch_deg", "outage_max_yaw_deg")


def run_columns(scenario: SatelliteScenario, errors: FloatArray) -> dict[str, FloatArray]:
    """Return statistics (R,) of every run with errors (R, n, 3) [°]; NaN where a run has none."""
    orbits, step, outage = scenario.orbits, scenario.step_orbits, scenario.outage_orbits
    late = math.inf if outage is None else outage
    pooled = (orbits >= RMS_ORBITS[0]) & (orbits < RMS_ORBITS[1])
    steady = (orbits >= RMS_ORBITS[0]) & (orbits < step) if outage is None else (orbits >= 1.0) & (orbits < late)
    after = (orbits >= step) & (orbits < late)
    in_outage = orbits >= (math.inf if outage is None else OUTAGE_MAX_FROM_ORBITS)

    def largest(rows: BoolArray, axis: tuple[int, ...]) -> FloatArray:
        found: FloatArray = np.abs(errors[:, rows]).max(axis=axis, initial=-1.0)
        return np.where(found < 0.0, np.nan, found)

    return {
        "rms_deg": np.sqrt(np.mean(errors[:, pooled] ** 2, axis=(1, 2))),
        "steady_rms_deg": np.sqrt(np.mean(errors[:, steady] ** 2, axis=(1, 2))),
        "peak_deg": largest(after, (1, 2)),
        **dict(zip(OUTAGE_COLUMNS, largest(in_outage, (1,)).T, strict=True)),
    }
