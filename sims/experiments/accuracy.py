"""Errors of estimates against the truth of a simulation."""

from __future__ import annotations

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import AttitudeTracks
from arrays.typing import FloatArray
from magloc.chi_square import normalised_square
from sims.attitude.simulation import AttitudeRuns

LAST_S = 60.0
"""Duration at the end of a run over which errors are evaluated [s]."""
DIVERGED_DEG = 10.0
"""Error in the last minute beyond which a run has diverged."""


def errors(runs: AttitudeRuns, estimates: AttitudeTracks) -> FloatArray:
    """Return the error state of truth against estimate, shape (runs, n, N)."""
    true = runs.states
    others = (true[state] - values for state, values in estimates.states.items())
    return np.concatenate([quaternion.error_vector(estimates.q, runs.q), *others], axis=-1)


def normalised_error_squared(runs: AttitudeRuns, estimates: AttitudeTracks) -> FloatArray:
    """Return the NEES, shape (runs, n); χ² with N degrees of freedom for a consistent filter."""
    return normalised_square(errors(runs, estimates), estimates.covariance)


def last_rows(runs: AttitudeRuns) -> slice:
    """Return the instants of the last minute."""
    return slice(-max(1, round(LAST_S / runs.dt_s)), None)


def error_norm_deg(runs: AttitudeRuns, estimates: AttitudeTracks) -> FloatArray:
    """Return the angle between truth and estimate, shape (runs, n) [°]."""
    return np.degrees(quaternion.angle_between(estimates.q, runs.q))
