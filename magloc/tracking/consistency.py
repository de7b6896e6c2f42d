r"""Consistency of a track: its errors beside its covariance and beside the posterior Cramér-Rao bound.

The normalised estimation error squared, NEES, of an estimate of n numbers with covariance P is
:math:`e^T P^{-1} e`; over independent rows its mean times their number is a χ² of n numbers each. The posterior
Cramér-Rao bound is the least covariance that any estimator can reach with a motion model: of a filter by the recursion
of Tichavský, Muravchik and Nehorai (1998), for linear motion
:math:`J_{j+1} = (Q + F J_j^{-1} F^T)^{-1} + H^T R^{-1} H` at the truth, and of a smoother, which knows later rows too,
by the same information carried backwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.chi_square import mean_bounds, normalised_square
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.results import Row, TrackPoint, stacked
from magloc.tracking.row_filter import LEAST_SHARE
from magloc.tracking.tracker import Tracker


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
        # Errors of neighbouring rows are alike: how far from 1 one record may be by chance, many seeds tell.
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
) -> Consistency:
    """Return the errors of a track against true positions and moments (n, 3), NaN where not known."""
    error = stacked(points, "position_m", 3) - position_m
    answered = np.isfinite(error).any(axis=1)
    moments = np.full_like(position_m, np.nan) if moment_Am2 is None else moment_Am2
    measurements = map(tracker.measurements.of, rows)
    nees = [nees_of(*row) for row in zip(points, np.hstack([position_m, moments]), measurements, strict=True)]
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
    """Return the root of the mean of squares, NaN of none."""
    return math.sqrt(float(np.mean(squares))) if len(squares) else math.nan


def mean_nis(points: Sequence[TrackPoint]) -> tuple[float, tuple[float, float]]:
    """Return the mean NIS of the tracked rows over its degrees of freedom, and two-sided 99 % bounds of it."""
    used = [point for point in points if point.tracks and point.status == "tracked" and math.isfinite(point.nis)]
    dof = sum(point.nis_dof for point in used)
    return sum(point.nis for point in used) / dof if dof else math.nan, mean_bounds(dof)


def nees_of(point: TrackPoint, truth: FloatArray, measurement: RowMeasurement) -> tuple[float, int]:
    """Return the normalised estimation error squared of a point, and its number of dimensions.

    The truth (6,) is NaN where it is not known, and these numbers do not count. With all six known, the error counts
    in coordinates in which it is Gaussian: those of the chart, bent as the row's readings bend, or, without a mixture,
    those of :mod:`magloc.tracking.measurement`.
    """
    if point.position_m is None or point.moment_Am2 is None or point.covariance is None:
        return math.nan, 0
    known = np.isfinite(truth)
    known[3:] &= known[3:].all()
    if not known.any():
        return math.nan, 0
    if known[:3].all() and point.mixture is not None:
        return _young_nees(point.mixture.of_source().matched(), truth, measurement)
    estimate = np.concatenate([point.position_m, point.moment_Am2])
    error, covariance = truth - estimate, point.covariance
    if known.all():
        # Where poses have errors, most of the covariance may be of them, which the readings do not bend.
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
    """Return the error (6,) of a component in standard numbers, bent as a row's readings bend."""
    L = source.chart.jacobian(np.zeros((1, truth.size)))[0]
    J = row.along(source.x[0], L @ source.S[0])
    standard = np.linalg.solve(source.S[0], source.chart.coordinates(truth[None])[0])
    difference = row.of_source(truth) - row.of_source(source.x[0])
    # Bent numbers along what J tells of, in standard deviations of the prediction, more than a share.
    Q, R = np.linalg.qr(np.concatenate([J, LEAST_SHARE * np.eye(J.shape[1])]))
    return np.asarray(standard + np.linalg.solve(R, Q[: len(J)].T @ (difference - J @ standard)))
