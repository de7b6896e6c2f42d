"""Latency of the camera: delay of time stamps against exposures.

See docs/theory/tabletop-navigation.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats

from adcs.mockup.navigation.fixes import FixRecord
from adcs.mockup.navigation.strapdown import ImuRecord, wrapped
from arrays.typing import FloatArray

_HALF_WINDOW_S = 0.25  # half of the time over which the rate at an exposure is a mean
_GRID_S = 0.02
_FALSE_ALARM = 1e-6  # probability that a constant rate counts as a changing one
_LARGEST_SIGMA = 0.1  # largest standard deviation over the range that is searched


@dataclass(frozen=True)
class LatencyEstimate:
    """Latency of the camera.

    Attributes
    ----------
    latency_s : float
        Time stamp minus exposure; NaN if it is not observable.
    sigma_s : float
        Standard deviation of the latency; infinite if it is not observable.
    gyro_zero_rad_s : float
        Zero of the gyro; NaN if the latency is not observable.
    observable : bool
        Whether the record determines the latency.
    reason : str
        Reason for which the latency is not observable; empty if it is.
    used : int
        Number of the differences of fixes in use.
    """

    latency_s: float
    sigma_s: float
    gyro_zero_rad_s: float
    observable: bool
    reason: str
    used: int


def camera_latency(
    imu: ImuRecord,
    fixes: FixRecord,
    *,
    lowest_s: float = 0.0,
    highest_s: float = 1.5,
    gyro_sigma_rad_s: float = math.radians(0.1),
    heading_sigma_rad: float = math.radians(0.05),
) -> LatencyEstimate:
    """Estimate the latency between exposure and time stamp from the headings of gyro and camera.

    Parameters
    ----------
    imu : ImuRecord
        Samples of one run without missing readings.
    fixes : FixRecord
        Fixes; those whose exposures may be outside of the record are ignored.
    lowest_s, highest_s : float
        Range of latencies that is searched.
    gyro_sigma_rad_s : float
        Standard deviation of a sample of the gyro.
    heading_sigma_rad : float
        Standard deviation of a fix's heading.

    Returns
    -------
    LatencyEstimate
        Latency with its standard deviation, or the reason for which it is not observable.

    Raises
    ------
    ValueError
        The range is empty, a noise is not positive, or readings are missing.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> camera = sims.CameraErrors(latency_s=0.1)
    >>> run = sims.table_run(sims.TableScenario(duration_s=60.0, camera=camera), rng=0)
    >>> round(mockup.camera_latency(run.imu, run.fixes).latency_s, 1)
    0.1
    """
    if not lowest_s < highest_s:
        raise ValueError(f"Input lowest_s must be below highest_s; instead received {lowest_s} and {highest_s}.")
    if not (gyro_sigma_rad_s > 0.0 and heading_sigma_rad > 0.0):
        raise ValueError(
            "Input gyro_sigma_rad_s and heading_sigma_rad must be positive; "
            f"instead received {gyro_sigma_rad_s} and {heading_sigma_rad}."
        )
    if not np.isfinite(imu.rate_rad_s).all():
        raise ValueError(
            "Input imu must have all rates; instead received missing ones. Fill them by "
            "adcs.mockup.navigation.strapdown.hold."
        )
    edges = np.concatenate([[imu.begin_s], imu.time_s])
    angle = np.concatenate([[0.0], np.cumsum(imu.rate_rad_s * imu.steps_s)])
    order = np.argsort(fixes.time_s, kind="stable")
    inside = fixes.time_s[order] - highest_s - _HALF_WINDOW_S >= imu.begin_s
    inside &= fixes.time_s[order] - lowest_s + _HALF_WINDOW_S <= imu.end_s
    inside[1:] &= np.diff(fixes.time_s[order]) > 0.0
    time_s, heading = fixes.time_s[order][inside], fixes.heading_rad[order][inside]
    if time_s.size < 4:
        return _unobservable(f"{time_s.size} fixes are within the samples for every latency, 4 are needed", 0)
    step_s = np.diff(time_s)
    turned_by = np.diff(heading)
    density = gyro_sigma_rad_s**2 * float(np.median(imu.steps_s))

    def residuals(latency_s: float) -> FloatArray:
        return wrapped(turned_by - np.diff(np.interp(time_s - latency_s, edges, angle)))

    def rates(latency_s: float) -> FloatArray:
        ahead = np.interp(time_s - latency_s + _HALF_WINDOW_S, edges, angle)
        rate: FloatArray = (ahead - np.interp(time_s - latency_s - _HALF_WINDOW_S, edges, angle)) / (
            2.0 * _HALF_WINDOW_S
        )
        return rate

    def zero_at(latency_s: float) -> float:
        return -float(np.median(residuals(latency_s) / step_s))

    def misfit(latency_s: float) -> float:
        # Half a step of the grid changes a residual by this much; one false fix counts at most 25.
        allowed = variance + (0.5 * _GRID_S * np.diff(rates(latency_s))) ** 2
        r = residuals(latency_s) + zero_at(latency_s) * step_s
        return float(np.minimum(r**2 / allowed, 25.0).sum())

    variance = 2.0 * heading_sigma_rad**2 + density * step_s
    grid = np.arange(lowest_s, highest_s + 0.5 * _GRID_S, _GRID_S)
    latency_s = float(grid[int(np.argmin([misfit(float(value)) for value in grid]))])
    zero, slack_s = zero_at(latency_s), _GRID_S
    estimate_variance, scale, used = math.inf, 1.0, np.arange(0)
    for _ in range(20):
        r = residuals(latency_s) + zero * step_s
        by_latency = np.diff(rates(latency_s))
        used = np.flatnonzero(r**2 <= 25.0 * (variance + (slack_s * by_latency) ** 2))
        # ∂r/∂L and ∂r/∂b; neighbouring differences share a fix, so that their covariance is tridiagonal.
        J = np.stack([by_latency, step_s], axis=1)[used]
        band = np.zeros((2, used.size))
        band[1] = variance[used]
        band[0, 1:] = np.where(np.diff(used) == 1, -(heading_sigma_rad**2), 0.0)
        weighted = linalg.solveh_banded(band, np.column_stack([J, r[used]]))
        normal, gradient = J.T @ weighted[:, :2], J.T @ weighted[:, 2]
        if not np.linalg.cond(normal * np.outer(*[1.0 / np.sqrt(np.diagonal(normal) + 1e-300)] * 2)) < 1e12:
            return _unobservable("the rate does not change", used.size)
        change = -np.linalg.solve(normal, gradient)
        estimate_variance = float(np.linalg.inv(normal)[0, 0])
        scale = max(1.0, float(r[used] @ weighted[:, 2]) / max(1, used.size - 2))
        moved_s = float(np.clip(latency_s + change[0], lowest_s, highest_s)) - latency_s
        latency_s, zero = latency_s + moved_s, zero + float(change[1])
        slack_s = abs(moved_s)
        if slack_s < 1e-7:
            break
    rate = rates(latency_s)
    noise = density / (2.0 * _HALF_WINDOW_S)
    shown = float(np.sum((rate - rate.mean()) ** 2)) / noise
    free = rate.size - 1
    if not shown > stats.chi2.isf(_FALSE_ALARM, free):
        return _unobservable("the rate changes by no more than its noise", used.size)
    sigma_s = math.sqrt(scale * estimate_variance / (1.0 - free / shown))
    if sigma_s > _LARGEST_SIGMA * (highest_s - lowest_s):
        return _unobservable("the rate changes too little", used.size)
    return LatencyEstimate(latency_s, sigma_s, zero, True, "", used.size)


def _unobservable(reason: str, used: int) -> LatencyEstimate:
    return LatencyEstimate(math.nan, math.inf, math.nan, False, reason, used)
