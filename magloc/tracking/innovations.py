"""Whether the innovations of a track are what they should be: white, and of the size that is stated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.special import chdtri

from magloc.levels import CONTRADICTION
from magloc.tracking.results import TrackPoint

THRESHOLD = 3.3
"""Standard deviations that a sum may be above its mean: 1 right track in 2,000 is beyond it."""

MATTERS = 2.0
"""Times their standard deviations that errors would be by what is not stated, from which on that is told."""

FEWEST_STARTS = 3
"""Rows in which tracks begin that say something of the record, and not of its end."""


@dataclass(frozen=True)
class InnovationTest:
    """Sums over a track, each in standard deviations from its mean: standard normal numbers of a right model.

    Attributes
    ----------
    rows : int
        With an innovation.
    z_chi2 : float
        Of the sum of squares of the whitened innovations: too large, there are errors that are not stated.
    z_lag1 : float
        Of the sum of their products with the row before: too large, errors last that are said to be new in every row,
        or the readings were filtered before. NaN where there are none. It counts unless `excess` is negative.
    excess : float
        By how much the variance of predicted readings is larger than is claimed, summed over rows and readings, in
        units of that of the innovations. With innovations ν, their covariance S and the gain K it is
        :math:`HK (νν^T - S)`, and the products with the row before, on average (Mehra 1970). Negative: innovations are
        alike because the source moves more steadily than the model says, and the track is better than it claims. NaN
        where errors of sensors or pose are states.
    z_constants : float
        Of the lever arm and the mounting that the rows tell of, where a pose is stated and these count as exact: too
        large, they are not. NaN elsewhere, and where the motion is measured.
    z_ambient : float
        The same of the ambient field of scalar sensors, where it counts as exact.
    ambient_factor : float
        How many times their standard deviations errors of the last row would be, rms, if that field were wrong by
        300 nT per axis.
    body_factor : float
        The same if the source, which counts as a point, were a body of a quarter of its distance from the nearest
        sensor, where it was nearest. NaN where the range is not known, and where the motion is measured.
    starts : int
        Rows in which a track begins.
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
        """Whether tracks begin in more rows than they go on in, so that no row tells of the next."""
        return self.starts >= FEWEST_STARTS and self.starts > self.rows

    @property
    def _sums(self) -> tuple[float, ...]:
        z_lag1 = math.nan if self.excess < 0.0 else self.z_lag1
        return self.z_chi2, z_lag1, self.z_constants, self.z_ambient

    @property
    def flagged(self) -> bool:
        """Whether one of them is beyond the threshold, or rows tell nothing of each other."""
        return self.is_disjoint or any(z > THRESHOLD for z in self._sums)

    @property
    def reason(self) -> str:
        """What is wrong, in a sentence; empty where nothing is."""
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
        """What may be wrong and could not be seen, in a sentence; empty where it would not matter."""
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
        """What ``magloc track --json`` prints of it."""
        return {**asdict(self), "flagged": self.flagged, "reason": self.reason, "caution": self.caution}


def innovation_test(points: Sequence[TrackPoint]) -> InnovationTest:
    """The test of all rows of a track; a row that contradicts it counts as one at the limit."""
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
