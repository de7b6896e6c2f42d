"""Complementary filters of a gyro and two measured vectors, such as field and Sun.

See docs/theory/complementary-filters.md. Source: a Ukrainian paper on the attitude of a magnetically stabilised
satellite. Ours: the rate of the frame, unit vectors, gains, and the frozen integral.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.complementary.names import Method
from adcs.complementary.outage import NO_SUBSTITUTE, Substitution, delay_steps
from adcs.satellite.vector_record import VectorRecord
from arrays.typing import FloatArray
from magloc import core

LARGEST_EIGENVALUE = 2.0
"""Largest eigenvalue of e against the error angle, for unit vectors; the others are 1 ± |cos| of their angle."""
WARNING_FRACTION = 0.9
"""Fraction of the stability limit above which there is a warning."""
_MU = 1e-6  # added to the diagonal of the normal equations of the measured quaternion
BLOCK = 20_000
"""Number of instants per call of a kernel: some milliseconds."""


@dataclass(frozen=True)
class Gains:
    """Gains of a complementary filter.

    Attributes
    ----------
    kp_per_s, ki_per_s2 : float
        K_P, which sets the crossover between vectors and gyro, and K_I, which removes the gyro's bias.
    outage_kp_per_s, outage_ki_per_s2 : float
        Gains while the second vector is missing; by default K_P is unchanged and the integral is frozen.
    boost, boost_level_rad, boost_memory : float
        Factor of K_I while the smoothed error is longer than the level, that level, and the factor of the exponential
        mean. A level of three times the noise of the error detects a step of the bias soon.
    first_weight, second_weight : float
        Weights of the two vectors in the error e of the explicit filter.

    Raises
    ------
    ValueError
        A number is negative or NaN.

    Examples
    --------
    >>> import adcs
    >>> adcs.Gains(0.2, 0.01).ki_per_s2
    0.01
    """

    kp_per_s: float = 0.02
    ki_per_s2: float = 1e-4
    outage_kp_per_s: float | None = None
    outage_ki_per_s2: float = 0.0
    boost: float = 1.0
    boost_level_rad: float = math.inf
    boost_memory: float = 0.95
    first_weight: float = 1.0
    second_weight: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not value >= 0.0:
                raise ValueError(f"Input {name} must be 0 or more; instead received {value}.")

    def during(self, outage: bool) -> tuple[float, float]:
        """Return the gains with or without the second vector.

        Parameters
        ----------
        outage : bool
            Whether the second vector is missing.

        Returns
        -------
        kp_per_s : float
            Proportional gain K_P.
        ki_per_s2 : float
            Integral gain K_I.
        """
        if not outage:
            return self.kp_per_s, self.ki_per_s2
        kp = self.kp_per_s if self.outage_kp_per_s is None else self.outage_kp_per_s
        return kp, self.outage_ki_per_s2

    @property
    def largest_kp_per_s(self) -> float:
        """The larger K_P times the larger weight."""
        return max(self.kp_per_s, self.during(outage=True)[0]) * max(self.first_weight, self.second_weight)

    def check(self, dt_s: float) -> None:
        """Raise ValueError beyond the stability limit K_P·h·2 = 2.

        Parameters
        ----------
        dt_s : float
            Usual step h of the filter.

        Raises
        ------
        ValueError
            The filter would be unstable.
        """
        limit = 2.0 / (LARGEST_EIGENVALUE * dt_s)
        if not self.largest_kp_per_s <= limit:
            raise ValueError(
                f"Input kp_per_s must be {limit:g} 1/s at most, because with steps of {dt_s:g} s a filter is unstable "
                f"where K_P·h·2 exceeds 2; instead received {self.largest_kp_per_s:g}."
            )

    def warnings(self, dt_s: float) -> tuple[str, ...]:
        """Return a sentence if the gains are within a tenth of the stability limit.

        Parameters
        ----------
        dt_s : float
            Usual step h of the filter.

        Returns
        -------
        tuple of str
            One sentence, or none.
        """
        limit = 2.0 / (LARGEST_EIGENVALUE * dt_s)
        if self.largest_kp_per_s < WARNING_FRACTION * limit:
            return ()
        return (
            f"K_P = {self.largest_kp_per_s:g} 1/s is close to {limit:g} 1/s, where a filter with steps of {dt_s:g} s "
            "becomes unstable: it amplifies noise.",
        )


BEST_GAINS = Gains()
"""Best gains for a magnetometer of 1000 nT."""


@dataclass(frozen=True, eq=False)
class ComplementaryTrack:
    """Estimates of each run at each instant, with its readings."""

    q: FloatArray  # (R, n, 4): reference from body
    integral_rad_s: FloatArray  # (R, n, 3): I, minus the bias of the gyro
    q_measured: FloatArray  # (R, n, 4): measured quaternions of each instant's readings; NaN for the explicit filter


def complementary_track(
    record: VectorRecord,
    gains: Gains = BEST_GAINS,
    *,
    method: Method = "explicit",
    q_start: ArrayLike = quaternion.IDENTITY,
    substitution: Substitution = NO_SUBSTITUTE,
) -> ComplementaryTrack:
    """Filter whole records with fixed gains in compiled code.

    ``method``: ``explicit``, by the error angle Σ weight · v × A(q̂) v_reference, or ``gauss-newton``, by the angle to a
    measured quaternion, which does not use the weights. ``q_start`` (4,): first estimate, also the initial value of the
    first measured quaternion. ``substitution``: replacement of a missing second vector. Raises ValueError if the gains
    are beyond the stability limit, or if the first estimate has no length.
    """
    gains.check(record.usual_dt_s)
    shape = (record.n_runs, len(record))
    q, integral, measured = np.empty((*shape, 4)), np.zeros((*shape, 3)), np.full((*shape, 4), np.nan)
    if len(record) == 0:
        return ComplementaryTrack(q, integral, measured)
    q[:, 0] = first_attitude(q_start)
    work = core.problem(
        "complementary",
        record=record_problem(record),
        is_gauss_newton=method == "gauss-newton",
        mu=_MU,
        weights=(gains.first_weight, gains.second_weight),
        gains=gains.during(False),
        outage_gains=gains.during(True),
        boost=gains.boost,
        boost_level=gains.boost_level_rad,
        boost_memory=gains.boost_memory,
        is_substituted=substitution.rule != "magnetometer-only",
        is_transported=substitution.rule == "transported",
        delay=delay_steps(substitution, record.usual_dt_s),
        counted=correction_times_s(record, gains),
        q=q,
        integral=integral,
        q_measured=measured,
    )
    core.run("complementary_filter", work, q.size // 4, block=BLOCK, chain=len(record))
    return ComplementaryTrack(q, integral, measured)


def record_problem(record: VectorRecord) -> core.Problem:
    """Return the fields of a record for a kernel."""
    return core.problem(
        "vector_record",
        n_runs=record.n_runs,
        n_steps=len(record),
        n_references=len(record.first_reference),
        dt=np.ascontiguousarray(record.dt_s),
        rate=record.rate_rad_s,
        first=record.first_body,
        second=record.second_body,
        first_reference=record.first_reference,
        second_reference=record.second_reference,
        frame_turn=quaternion.exp(record.frame_rate_rad_s * record.dt_s[:, None]),
    )


def correction_times_s(record: VectorRecord, gains: Gains) -> FloatArray:
    """Return the time (n,) for which the vectors of each instant correct.

    It is the step before the instant, but after a gap at most the time with K_P·h·2 = 1.
    """
    after_gap = 0.5 / gains.largest_kp_per_s if gains.largest_kp_per_s else math.inf
    return np.minimum(record.dt_s, max(record.usual_dt_s, after_gap))


def first_attitude(q_start: ArrayLike) -> FloatArray:
    """Return unit quaternions (..., 4); raise ValueError if one is not finite or has no length."""
    q = quaternion.normalised(q_start)
    if not np.isfinite(q).all():
        raise ValueError("Input q_start must be quaternions with a length; instead received one without.")
    return q
