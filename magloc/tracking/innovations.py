"""Test of the innovations of a track: white, and of the stated size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.special import chdtri

from magloc.levels import CONTRADICTION
from magloc.tracking.results import TrackPoint

THRESHOLD = 3.3
"""Largest sum of a right track, in standard deviations above its mean; 1 track in 2,000 exceeds it."""

MATTERS = 2.0
"""Ratio of errors to their standard deviations, by unstated causes, above which a caution is given."""

FEWEST_STARTS = 3
"""Fewest starts of tracks that tell of the record, and not of its end."""


@dataclass(frozen=True)
class InnovationTest:
    """Sums over a track, each in standard deviations from its mean: standard normal for a right model.

    Attributes
    ----------
    rows : int
        Number of rows with an innovation.
    z_chi2 : float
        Sum of squares of the whitened innovations. If it is too large, there are errors that are not stated.
    z_lag1 : float
        Sum of their products with the row before. If it is too large, errors last that are stated as new in each row,
        or the readings were filtered. NaN without products. It counts unless `excess` is negative.
    excess : float
        Excess of the variance of predicted readings over the claimed one, summed over rows and readings, in units of
        the innovations' variance. With innovations ν, their covariance S and the gain K it is
        :math:`HK (νν^T - S)` plus the products with the row before, on average (Mehra 1970). If it is negative, the
        source moves more steadily than the model says, and the track is better than it claims. NaN if errors of
        sensors or pose are states.
    z_constants : float
        Lever arm and mounting that a fit of the rows finds, if a pose is stated and these count as exact. If it is too
        large, they are not exact. NaN otherwise, and with a measured motion.
    z_ambient : float
        Ambient field of scalar sensors that a fit of the rows finds, if it counts as exact.
    ambient_factor : float
        Ratio of the rms error of the last row to its standard deviation, if that field were wrong by 300 nT per axis.
    body_factor : float
        The same ratio if the source were a body as long as a quarter of its least distance from a sensor. NaN if the
        range is not known, and with a measured motion.
    starts : int
        Number of rows in which a track begins.
    """

    rows: int
    z_chi2: float
    z_lag1: float
    excess: float = math.nan
    z_constants: float = math.nan
    z_ambient: float = math.nan
    ambient_factor: float = math.nan
    body_factor: float = math.nan
    starts: int = 0

    @property
    def is_disjoint(self) -> bool:
        """True if tracks begin in more rows than they go on in, so that no row predicts the next."""
        return self.starts >= FEWEST_STARTS and self.starts > self.rows

    @property
    def _sums(self) -> tuple[float, ...]:
        z_lag1 = math.nan if self.excess < 0.0 else self.z_lag1
        return self.z_chi2, z_lag1, self.z_constants, self.z_ambient

    @property
    def flagged(self) -> bool:
        """True if a sum is beyond the threshold, or if no row predicts the next."""
        return self.is_disjoint or any(z > THRESHOLD for z in self._sums)

    @property
    def reason(self) -> str:
        """Sentence that names the fault; empty without one."""
        if not self.flagged:
            return ""
        if self.is_disjoint:
            return (
                f"a track begins in {self.starts} rows and goes on in {self.rows}, no row tells of the next: by the"
                " times, the speed and the rate of turn the source may be anywhere after a step (are times in seconds?)"
            )
        if self.z_constants > THRESHOLD:
            z, what = self.z_constants, "the rows agree on another mounting or lever arm than the exact one"
            why = "position_constant_m and attitude_constant_deg of the pose are stated too small"
        elif self.z_ambient > THRESHOLD:
            z, what = self.z_ambient, "the rows agree on another ambient field than the exact one"
            why = "ambient_uncertainty_nT is stated too small"
        elif self.z_lag1 > THRESHOLD and not self.excess < 0.0:
            z, what = self.z_lag1, "differences between readings and predictions are alike in successive rows"
            why = "the motion differs from the motion model, offsets or pose errors last, or readings were filtered"
        else:
            z, what = self.z_chi2, "differences between readings and predictions are larger than is stated"
            why = "the motion differs from the motion model, or noise and errors of the pose are larger"
        return f"{what}: {why} ({z:.1f} standard deviations from a right model, {THRESHOLD} are allowed)"

    @property
    def caution(self) -> str:
        """Sentence that names a possible fault that the tests cannot see; empty if it would not matter."""
        cautions = []
        if self.ambient_factor > MATTERS:
            cautions.append(
                "the ambient field counts as exact: were it wrong by 300 nT, errors would be about"
                f" {self.ambient_factor:.2g} times their standard deviations; state ambient_uncertainty_nT"
            )
        if self.body_factor > MATTERS:
            cautions.append(
                "the source counts as a point: were it a body of a quarter of its distance, errors would be about"
                f" {self.body_factor:.2g} times their standard deviations"
            )
        return "; ".join(cautions)

    @property
    def json(self) -> dict[str, object]:
        """Entries of ``magloc track --json``."""
        return {**asdict(self), "flagged": self.flagged, "reason": self.reason, "caution": self.caution}


def innovation_test(points: Sequence[TrackPoint]) -> InnovationTest:
    """Return the test of all rows of a track; a row that contradicts it counts as one at the limit."""
    of_rows = [(p.nis, p.nis_dof, p.lag1, p.correction) for p in points]
    nis, dof, lag1, correction = np.array(of_rows, dtype=np.float64).reshape(-1, 4).T
    known = np.isfinite(nis) & (dof > 0.0)
    limited = np.minimum(nis[known], chdtri(np.maximum(dof[known], 1.0), CONTRADICTION))
    paired, corrected = np.isfinite(lag1), np.isfinite(lag1 + correction)
    return InnovationTest(
        int(known.sum()),
        _standardised(float(np.sum(limited - dof[known])), 2.0 * float(dof[known].sum())),
        _standardised(float(lag1[paired].sum()), float(dof[paired].sum())),
        excess=float((lag1 + correction)[corrected].sum()) if corrected.any() else math.nan,
        starts=sum(point.status == "acquired" for point in points),
    )


def _standardised(total: float, variance: float) -> float:
    return total / math.sqrt(variance) if variance > 0.0 else math.nan
