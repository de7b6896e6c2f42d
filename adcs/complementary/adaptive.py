"""Adaptive error-state filter of field, Sun and gyro, which detects steps of the gyro's bias.

See docs/theory/complementary-filters.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.complementary.explicit import BLOCK, first_attitude, record_problem
from adcs.satellite.vector_record import VectorRecord
from arrays.io.errors import check_positive
from arrays.typing import FloatArray
from magloc import core
from magloc.chi_square import normalised_square


@dataclass(frozen=True)
class AdaptiveTuning:
    """Noise and limits of the adaptive filter.

    Attributes
    ----------
    first_sigma : float
        Noise of the first vector per axis, in its unit: tesla for a field.
    second_sigma_rad : float
        Noise of the direction of the second vector.
    attitude_noise_rad, bias_noise_rad_s : float
        Random walk of attitude and bias in a usual step.
    memory : float
        Factor of the exponential mean of NIS.
    threshold : float
        Smoothed NIS per degree of freedom, 1 on average, above which the bias is assumed to change.
    growth_rad_s : float
        Random walk of the bias in a usual step while it is assumed to change.
    start_attitude_rad, start_bias_rad_s : float
        Initial standard deviations per axis.

    Raises
    ------
    ValueError
        A number is not positive and finite (the attitude's noise may be zero), or the memory is 1 or more.
    """

    first_sigma: float = 1000e-9
    second_sigma_rad: float = 1e-3
    attitude_noise_rad: float = 0.0
    bias_noise_rad_s: float = 3e-10
    memory: float = 0.95
    threshold: float = 2.3
    growth_rad_s: float = math.radians(0.004)
    start_attitude_rad: float = math.radians(10.0)
    start_bias_rad_s: float = math.radians(0.02)

    def __post_init__(self) -> None:
        check_positive(
            **{name: value for name, value in vars(self).items() if (name, value) != ("attitude_noise_rad", 0)}
        )
        if not self.memory < 1.0:
            raise ValueError(f"Input memory must be less than 1; instead received {self.memory}.")

    @property
    def start_covariance(self) -> FloatArray:
        """Initial covariance of attitude and bias, shape (6, 6)."""
        return np.diag(np.repeat([self.start_attitude_rad, self.start_bias_rad_s], 3) ** 2)


@dataclass(frozen=True, eq=False)
class AdaptiveTrack:
    """Estimates of each run at each instant, with its readings."""

    q: FloatArray  # (R, n, 4): reference from body
    bias_rad_s: FloatArray  # (R, n, 3): of the gyro
    covariance: FloatArray  # (R, n, 6, 6): of the error angle in body axes and the bias [rad, rad/s]
    smoothed_nis: FloatArray  # (R, n): for each degree of freedom

    def nees(self, q_true: ArrayLike, bias_true_rad_s: ArrayLike) -> FloatArray:
        """Return the normalised estimation error squared (R, n), 6 on average if consistent.

        Shape ``q_true`` (R, n, 4). ``bias_true_rad_s``: broadcasts to (R, n, 3).
        """
        angle = 2.0 * quaternion.error_vector(self.q, q_true)
        x = np.concatenate([angle, np.broadcast_to(bias_true_rad_s, angle.shape) - self.bias_rad_s], axis=-1)
        return normalised_square(x, self.covariance)


def adaptive_track(
    record: VectorRecord, tuning: AdaptiveTuning = AdaptiveTuning(), *, q_start: ArrayLike = quaternion.IDENTITY
) -> AdaptiveTrack:
    """Run the adaptive filter over whole records in compiled code.

    ``q_start`` (4,): first estimate. Raises ValueError if it has no length.
    """
    shape = (record.n_runs, len(record))
    track = AdaptiveTrack(np.empty((*shape, 4)), np.zeros((*shape, 3)), np.empty((*shape, 6, 6)), np.empty(shape))
    if len(record) == 0:
        return track
    track.q[:, 0] = first_attitude(q_start)
    track.covariance[:, 0] = tuning.start_covariance
    work = core.problem(
        "adaptive",
        record=record_problem(record),
        first_sigma=tuning.first_sigma,
        second_sigma=tuning.second_sigma_rad,
        attitude_growth=tuning.attitude_noise_rad**2 / record.usual_dt_s,
        bias_growth=tuning.bias_noise_rad_s**2 / record.usual_dt_s,
        memory=tuning.memory,
        threshold=tuning.threshold,
        changed_growth=tuning.growth_rad_s**2 / record.usual_dt_s,
        q=track.q,
        bias=track.bias_rad_s,
        covariance=track.covariance,
        smoothed_nis=track.smoothed_nis,
    )
    core.run("adaptive_filter", work, track.smoothed_nis.size, block=BLOCK, chain=len(record))
    return track
