r"""Errors of a track against its covariance and the posterior Cramér-Rao bound.

The normalised estimation error squared, NEES, of an estimate of n numbers with covariance P is
:math:`e^T P^{-1} e`; over independent rows its mean times their number is a χ² of n numbers each. The posterior
Cramér-Rao bound is the least covariance of any estimator with a motion model. That of a filter follows from the
recursion of Tichavský, Muravchik and Nehorai (1998), for linear motion
:math:`J_{j+1} = (Q + F J_j^{-1} F^T)^{-1} + H^T R^{-1} H` at the truth. That of a smoother, which uses later rows too,
follows from the same information by a backward recursion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.special import chdtri

from arrays.typing import FloatArray, IntArray
from magloc.chi_square import mean_bounds, normalised_square
from magloc.levels import CONTRADICTION
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.results import TrackPoint, track_column
from magloc.tracking.row_filter import LEAST_SHARE
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker

THRESHOLD = 3.3
"""Largest statistic of a right track, in standard deviations above its mean; 1 track in 2,000 exceeds it."""

MATTERS = 2.0
"""Ratio of errors to their standard deviations, by unstated causes, above which a caution is given."""

FEWEST_STARTS = 3
"""Fewest starts of tracks for which a record counts as disjoint; fewer may be due to its end."""


@dataclass(frozen=True, eq=False)
class Consistency:
    """Errors of a track against a truth.

    Attributes
    ----------
    rows, tracked_rows : int
        Number of rows with truth, and of those that have a position too.
    position_rms_m : float
        Root of the mean squared distance from the truth.
    position_bound_m : float
        Root mean square of the posterior Cramér-Rao bound over the same rows, for a filter or, if the track is
        smoothed, a smoother. NaN if the true moment is not known.
    nees_per_dimension : float
        Mean NEES over its number of dimensions: 1 if the covariance is right. See :func:`nees_of` for the coordinates.
    nees_bounds : tuple of 2 floats
        Two-sided 99 % bounds of `nees_per_dimension` for independent rows. Rows of a track are not independent: one
        record may well lie outside.
    nis_per_dimension : float
        Mean NIS over its degrees of freedom.
    nis_bounds : tuple of 2 floats
        Two-sided 99 % bounds of `nis_per_dimension`; the innovations of a right filter are independent.
    nees, nees_dof : ndarray, shape (n,)
        NEES of each row and its number of dimensions. NaN without a track or a truth.
    true_position_m : ndarray, shape (n, 3)
        NaN where it is not known.
    bound_m : ndarray, shape (n,), optional
        Posterior Cramér-Rao bound of each row.
    """

    rows: int
    tracked_rows: int
    position_rms_m: float
    position_bound_m: float
    nees_per_dimension: float
    nees_bounds: tuple[float, float]
    nis_per_dimension: float
    nis_bounds: tuple[float, float]
    nees: FloatArray
    nees_dof: IntArray
    true_position_m: FloatArray
    bound_m: FloatArray | None

    @property
    def json(self) -> dict[str, object]:
        """Entries of ``magloc track --json``."""
        return {key: value for key, value in vars(self).items() if not isinstance(value, np.ndarray | None)}

    def lines(self) -> list[str]:
        """Return lines that state the errors and their expected values."""
        lines = [
            f"against the truth, {self.tracked_rows} of {self.rows} rows answered:",
            f"  position rms {self.position_rms_m:.4g} m",
        ]
        if np.isfinite(self.position_bound_m):
            ratio = self.position_rms_m / self.position_bound_m
            lines[-1] += (
                f", least possible {self.position_bound_m:.4g} m on average over such motions (posterior Cramér-Rao"
                f" bound), ratio {ratio:.2f}"
            )
        return [*lines, *consistency_lines(self.nees_per_dimension, self.nis_per_dimension, self.nis_bounds)]


def consistency_lines(nees: float, nis: float, nis_bounds: tuple[float, float]) -> list[str]:
    """Return lines that state the mean NEES and NIS per dimension and their expected values."""
    low, high = nis_bounds
    return [
        # Errors of neighbouring rows are correlated, so that only many seeds show the spread about 1.
        f"  NEES per dimension {nees:.3f}, 1 on average over many records of a right filter",
        f"  NIS per dimension {nis:.3f}, 99 % bounds {low:.3f} to {high:.3f}",
    ]


def consistency(
    points: Sequence[TrackPoint],
    tracker: Tracker,
    rows: Sequence[Row],
    position_m: FloatArray,
    moment_Am2: FloatArray | None,
    bound_m: FloatArray | None = None,
    sigma_m: FloatArray | None = None,
) -> Consistency:
    """Return the errors of a track against true positions of `sigma_m` (n,) and moments, NaN if unknown."""
    error = track_column(points, "position_m", 3) - position_m
    answered = np.isfinite(error).any(axis=1)
    moments = np.full_like(position_m, np.nan) if moment_Am2 is None else moment_Am2
    sigma_m = np.zeros(len(position_m)) if sigma_m is None else sigma_m
    measurements = map(tracker.measurements.of, rows)
    states = np.hstack([position_m, moments])
    nees = [nees_of(*row) for row in zip(points, states, measurements, sigma_m, strict=True)]
    square, dof = np.array([value for value, _ in nees]), np.array([n for _, n in nees], dtype=np.intp)
    nis_per_dimension, nis_bounds = mean_nis(points)
    return Consistency(
        rows=int(np.isfinite(position_m).any(axis=1).sum()),
        tracked_rows=int(answered.sum()),
        position_rms_m=root_mean(np.nansum(error[answered] ** 2, axis=1)),
        position_bound_m=math.nan if bound_m is None else root_mean(np.square(bound_m[answered])),
        nees_per_dimension=float(np.nansum(square)) / int(dof.sum()) if dof.any() else math.nan,
        nees_bounds=mean_bounds(int(dof.sum())),
        nis_per_dimension=nis_per_dimension,
        nis_bounds=nis_bounds,
        nees=square,
        nees_dof=dof,
        true_position_m=position_m,
        bound_m=bound_m,
    )


def root_mean(squares: FloatArray) -> float:
    """Return the root of the mean of squares, NaN without any."""
    return math.sqrt(float(np.mean(squares))) if len(squares) else math.nan


def mean_nis(points: Sequence[TrackPoint]) -> tuple[float, tuple[float, float]]:
    """Return the mean NIS of tracked rows per degree of freedom, and its two-sided 99 % bounds."""
    used = [point for point in points if point.tracks and point.status == "tracked" and math.isfinite(point.nis)]
    dof = sum(point.nis_dof for point in used)
    return sum(point.nis for point in used) / dof if dof else math.nan, mean_bounds(dof)


def nees_of(
    point: TrackPoint, truth: FloatArray, measurement: RowMeasurement, sigma_m: float = 0.0
) -> tuple[float, int]:
    """Return the normalised estimation error squared of a point, and its number of dimensions.

    Unknown numbers of the truth (6,) are NaN and do not count. With all six known, the error is in coordinates in which
    it is Gaussian: those of the chart, as nonlinear as the row's readings, or, without a mixture, those of
    :mod:`magloc.tracking.measurement`. An uncertain position of the truth adds to the covariance, and the error is that
    of position and moment themselves.
    """
    if point.position_m is None or point.moment_Am2 is None or point.covariance is None:
        return math.nan, 0
    known = np.isfinite(truth)
    known[3:] &= known[3:].all()
    if not known.any():
        return math.nan, 0
    if known[:3].all() and point.mixture is not None and not sigma_m > 0.0:
        return _young_nees(point.mixture.source_marginal().match_moments(), truth, measurement)
    estimate = np.concatenate([point.position_m, point.moment_Am2])
    error, covariance = truth - estimate, point.covariance + np.diag([sigma_m**2] * 3 + [0.0] * 3)
    if known.all() and not sigma_m > 0.0:
        # Errors of the pose may dominate the covariance, and the readings are linear in them.
        posed = measurement.pose_effect.shape[1] > 0
        coordinates = measurement.coordinates(
            measurement.without_errors(estimate), np.sqrt(np.diagonal(covariance)), of_readings=not posed
        )
        error, _ = coordinates.at(measurement.without_errors(truth))
    error, covariance = error[known], covariance[np.ix_(known, known)]
    return float(normalised_square(error, covariance)), int(known.sum())


def _young_nees(source: Mixture, truth: FloatArray, row: RowMeasurement) -> tuple[float, int]:
    """Return NEES and dimensions of a single component, whose true moment may not be known."""
    known = np.isfinite(truth)
    error = source.chart.coordinates(np.where(known, truth, source.x[0])[None])[0]
    if known.all():
        return float(np.sum(standard_error(source, truth, row) ** 2)), truth.size
    P = (source.S[0] @ source.S[0].T)[np.ix_(known, known)]
    return float(normalised_square(error[known], P)), int(known.sum())


def standard_error(source: Mixture, truth: FloatArray, row: RowMeasurement) -> FloatArray:
    """Return the standardised error (6,) of a component, as nonlinear as a row's readings."""
    L = source.chart.jacobian(np.zeros((1, truth.size)))[0]
    J = row.directional_derivative(source.x[0], L @ source.S[0])
    standard = np.linalg.solve(source.S[0], source.chart.coordinates(truth[None])[0])
    difference = row.predict_source(truth) - row.predict_source(source.x[0])
    # Nonlinear in directions in which the readings change by more than LEAST_SHARE over one σ.
    Q, R = np.linalg.qr(np.concatenate([J, LEAST_SHARE * np.eye(J.shape[1])]))
    return np.asarray(standard + np.linalg.solve(R, Q[: len(J)].T @ (difference - J @ standard)))


@dataclass(frozen=True)
class InnovationTest:
    """Test statistics of a track's innovations, standard normal for a right model.

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
        """True if tracks start in more rows than they continue, so that no row predicts the next."""
        return self.starts >= FEWEST_STARTS and self.starts > self.rows

    @property
    def _sums(self) -> tuple[float, ...]:
        z_lag1 = math.nan if self.excess < 0.0 else self.z_lag1
        return self.z_chi2, z_lag1, self.z_constants, self.z_ambient

    @property
    def flagged(self) -> bool:
        """True if a statistic exceeds the threshold, or if no row predicts the next."""
        return self.is_disjoint or any(z > THRESHOLD for z in self._sums)

    @property
    def reason(self) -> str:
        """Sentence that names the fault; empty without one."""
        if not self.flagged:
            return ""
        if self.is_disjoint:
            return (
                f"a track begins in {self.starts} rows and goes on in {self.rows}, no row predicts the next: with"
                " these times, speed and rate of turn the source may be anywhere after a step (are times in seconds?)"
            )
        if self.z_constants > THRESHOLD:
            z, what = self.z_constants, "the rows fit another mounting or lever arm than the stated one"
            why = "position_constant_m and attitude_constant_deg of the pose are stated too small"
        elif self.z_ambient > THRESHOLD:
            z, what = self.z_ambient, "the rows fit another ambient field than the stated one"
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
        """Sentence that names a possible fault that no test shows; empty if it would not matter."""
        cautions = []
        if self.ambient_factor > MATTERS:
            cautions.append(
                "the ambient field counts as exact: if it is wrong by 300 nT, errors are about"
                f" {self.ambient_factor:.2g} times their standard deviations; state ambient_uncertainty_nT"
            )
        if self.body_factor > MATTERS:
            cautions.append(
                "the source counts as a point: for a body as long as a quarter of its distance, errors would be about"
                f" {self.body_factor:.2g} times their standard deviations"
            )
        return "; ".join(cautions)

    @property
    def json(self) -> dict[str, object]:
        """Entries of ``magloc track --json``."""
        return {**asdict(self), "flagged": self.flagged, "reason": self.reason, "caution": self.caution}


def innovation_test(points: Sequence[TrackPoint]) -> InnovationTest:
    """Return the test of a track; contradicting rows count with χ² at the limit."""
    of_rows = [(p.nis, p.nis_dof, p.lag1, p.correction) for p in points]
    nis, dof, lag1, correction = np.array(of_rows, dtype=np.float64).reshape(-1, 4).T
    known = np.isfinite(nis) & (dof > 0.0)
    limited = np.minimum(nis[known], chdtri(np.maximum(dof[known], 1.0), CONTRADICTION))
    paired, corrected = np.isfinite(lag1), np.isfinite(lag1 + correction)
    return InnovationTest(
        int(known.sum()),
        _standard_score(float(np.sum(limited - dof[known])), 2.0 * float(dof[known].sum())),
        _standard_score(float(lag1[paired].sum()), float(dof[paired].sum())),
        excess=float((lag1 + correction)[corrected].sum()) if corrected.any() else math.nan,
        starts=sum(point.status == "acquired" for point in points),
    )


def _standard_score(total: float, variance: float) -> float:
    return total / math.sqrt(variance) if variance > 0.0 else math.nan
