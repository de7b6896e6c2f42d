"""The bank of filters: picks the filter that is asked for, and runs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adcs.kalman.error_state import Estimates, Start
from adcs.kalman.mekf import closed_loop_jacobian, run_filter, run_readable
from adcs.satellite.telemetry import Record
from arrays.io.errors import InputError, naming

if TYPE_CHECKING:
    pass
from typing import Literal, get_args

from adcs.kalman.error_state import FilterSettings


def start_of(record: Record, estimate: Estimate) -> Start:
    """Where the filter starts when it is told nothing: from the readings."""
    from adcs.kalman.initialisation import any_start, vector_start

    if estimate.start == "vectors":
        return vector_start(record, estimate.settings)
    return any_start(record, estimate.settings)


def estimated(record: Record, estimate: Estimate, start: Start) -> Estimates:
    """Estimates of the filter that is wanted.

    Raises
    ------
    InputError
        It cannot estimate from this record.
    """
    try:
        with naming(f"filter {estimate.filter}"):
            return _estimated(record, estimate, start)
    except np.linalg.LinAlgError:
        raise InputError(
            f"filter {estimate.filter}: found a covariance that grows without end, expected a shorter duration or "
            "another filter: a constant gain holds only near the geometry that it was computed for."
        ) from None


def _estimated(record: Record, estimate: Estimate, start: Start) -> Estimates:
    settings = estimate.settings
    if estimate.filter == "constant-gain":
        from adcs.kalman.constant_gain import run_constant_gain

        return run_constant_gain(record, settings, start)
    if estimate.filter == "parallel-disturbance":
        from adcs.kalman.separate_bias import run_parallel

        return run_parallel(record, settings, start, forgetting=estimate.forgetting)
    if estimate.filter == "reduced":
        from adcs.kalman.gyro_driven import run_reduced

        return run_reduced(record, settings, start)
    if estimate.closed_loop_F:
        return run_readable(record, settings, start, jacobian=closed_loop_jacobian)
    estimates = run_filter(record, settings, start)
    if estimate.filter == "smoother":
        from adcs.kalman.smoother import smoothed

        return smoothed(record, estimates)
    return estimates


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is estimated, from what, and how.

    Attributes
    ----------
    settings : FilterSettings
        Sensors, states and what the filter believes of their noise.
    filter : str
        One of :data:`adcs.kalman.bank.FILTERS`.
    start : str
        One of :data:`adcs.kalman.bank.STARTS`.
    start_attitude_rad, start_rate_rad_s : float
        Standard deviations per axis of what it starts from.
    forgetting : float
        Of the parallel filter of the disturbance.
    closed_loop_F : bool
        The source paper's Jacobian.
    """

    settings: FilterSettings
    filter: Filter
    start: StartKind
    start_attitude_rad: float
    start_rate_rad_s: float
    forgetting: float
    closed_loop_F: bool

    @property
    def in_words(self) -> str:
        """Sensors, states and filter."""
        used = self.settings.sensors
        states = f", estimating {', '.join(used.states)}" if used.states else ""
        return f"{used.sensors}{states}; filter {self.filter}"


Filter = Literal["mekf", "constant-gain", "parallel-disturbance", "reduced", "smoother"]
Noise = Literal["tuned", "paper"]
FILTERS: tuple[str, ...] = get_args(Filter)
NOISES: tuple[str, ...] = get_args(Noise)
StartKind = Literal["near", "vectors", "any"]
STARTS: tuple[str, ...] = get_args(StartKind)
