r"""How true a track is: its errors against what it claims, and against what is possible.

The normalised estimation error squared, NEES, of an estimate of n numbers with covariance P is
:math:`e^T P^{-1} e`; over independent rows its mean times their number is a χ² of n numbers each. The posterior
Cramér-Rao bound is the least covariance that any filter can reach with a motion model, by the recursion of Tichavský,
Muravchik and Nehorai (1998), for linear motion :math:`J_{j+1} = (Q + F J_j^{-1} F^T)^{-1} + H^T R^{-1} H` at the truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from magloc.measurement import DifferenceMeasurement
from magloc.motion import N_SOURCE, MotionModel
from magloc.track import Row, Tracker, TrackPoint

FloatArray = NDArray[np.float64]

_LEVEL = 0.99


@dataclass(frozen=True)
class Consistency:
    """A track against the truth.

    Attributes
    ----------
    rows, tracked_rows : int
        Rows with truth, and those of them that are tracked.
    position_rms_m : float
        Root of the mean squared distance from the truth.
    position_bound_m : float
        The same of the posterior Cramér-Rao bound, over the same rows; NaN where the true moment is not known.
    nees_per_dimension : float
        Mean NEES over the number of its dimensions: 1 if the covariance is right.
    nees_bounds : tuple of 2 floats
        Two-sided 99 % bounds of it for independent rows. A track's rows are not independent: over one record it may
        well lie outside.
    nis_per_dimension : float
        Mean NIS over its degrees of freedom.
    nis_bounds : tuple of 2 floats
        Two-sided 99 % bounds of it; the innovations of a right filter are independent.
    """

    rows: int
    tracked_rows: int
    position_rms_m: float
    position_bound_m: float
    nees_per_dimension: float
    nees_bounds: tuple[float, float]
    nis_per_dimension: float
    nis_bounds: tuple[float, float]


def mean_bounds(degrees_of_freedom: int, level: float = _LEVEL) -> tuple[float, float]:
    """Two-sided bounds of a χ² over its degrees of freedom."""
    if degrees_of_freedom <= 0:
        return math.nan, math.nan
    tail = 0.5 * (1.0 - level)
    low, high = chdtri(degrees_of_freedom, 1.0 - tail), chdtri(degrees_of_freedom, tail)
    return float(low) / degrees_of_freedom, float(high) / degrees_of_freedom


def consistency(
    points: Sequence[TrackPoint],
    position_m: FloatArray,
    moment_Am2: FloatArray | None,
    bound_m: FloatArray | None = None,
) -> Consistency:
    """Errors of a track.

    Parameters
    ----------
    points : sequence of TrackPoint
    position_m, moment_Am2 : ndarray, shape (n, 3)
        Truth of every row in the track's frame; NaN where a coordinate is not known.
        With the moment NEES is that of all six numbers, else that of the position.
    bound_m : ndarray, shape (n,), optional
        Posterior Cramér-Rao bound of every row, as of :func:`posterior_bound`.

    Returns
    -------
    Consistency
    """
    squares, nees, nees_dof, nis, nis_dof, bounds = [], 0.0, 0, 0.0, 0, []
    n_rows = 0
    for i, point in enumerate(points):
        known = np.isfinite(position_m[i])
        n_rows += bool(known.any())
        if point.position_m is None or point.moment_Am2 is None or point.covariance is None:
            continue
        if math.isfinite(point.nis) and point.nis_dof and point.status == "tracked":
            nis, nis_dof = nis + point.nis, nis_dof + point.nis_dof
        if not known.any():
            continue
        error = point.position_m[known] - position_m[i][known]
        squares.append(float(error @ error))
        if bound_m is not None:
            bounds.append(float(bound_m[i]))
        index = np.flatnonzero(known)
        if moment_Am2 is not None and np.isfinite(moment_Am2[i]).all():
            error = np.concatenate([error, point.moment_Am2 - moment_Am2[i]])
            index = np.concatenate([index, [3, 4, 5]])
        covariance = point.covariance[np.ix_(index, index)]
        scale = np.sqrt(np.diagonal(covariance))
        normalised = error / scale
        nees += float(normalised @ np.linalg.solve(covariance / np.outer(scale, scale), normalised))
        nees_dof += error.size
    return Consistency(
        rows=n_rows,
        tracked_rows=len(squares),
        position_rms_m=math.sqrt(float(np.mean(squares))) if squares else math.nan,
        position_bound_m=math.sqrt(float(np.mean(np.square(bounds)))) if bounds else math.nan,
        nees_per_dimension=nees / nees_dof if nees_dof else math.nan,
        nees_bounds=mean_bounds(nees_dof),
        nis_per_dimension=nis / nis_dof if nis_dof else math.nan,
        nis_bounds=mean_bounds(nis_dof),
    )


def posterior_bound(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Posterior Cramér-Rao bound of the distance from the truth, for every row.

    Nothing is known before the first row.

    Parameters
    ----------
    tracker : Tracker
        Whose array and motion model count.
    rows : sequence of Row
    position_m, moment_Am2 : ndarray, shape (n, 3)
        Truth in the track's frame.

    Returns
    -------
    ndarray, shape (n,)
        Root of the trace of the position's bound [m]; infinite as long as the readings do not determine it.
    """
    motion: MotionModel = tracker.motion
    bounds = np.full(len(rows), np.inf)
    P: FloatArray | None = None
    for i, row in enumerate(rows):
        truth = np.concatenate([position_m[i], moment_Am2[i]])
        differences = tracker.differences_of(row)
        R = row.R_world_from_array
        model = DifferenceMeasurement(tracker.array_of(row), differences)
        H = model.jacobian(R.T @ (truth[:3] - row.origin_m), R.T @ truth[3:]) / np.sqrt(model.variance)[:, None]
        H = np.concatenate([H[:, :3] @ R.T, H[:, 3:] @ R.T], axis=1)
        if P is None:
            norm = np.linalg.norm(H, axis=0)
            scaled = H / np.where(norm > 0.0, norm, 1.0)
            singular = np.linalg.svd(scaled, compute_uv=False)
            if len(H) < N_SOURCE or singular[-1] < 1e-9 * singular[0]:
                continue
            source = np.linalg.inv(scaled.T @ scaled) / np.outer(norm, norm)
            _, root = motion.start(truth, np.asarray(np.linalg.cholesky(source), dtype=np.float64))
            P = root @ root.T
        else:
            state = np.concatenate([truth, np.zeros(motion.n_states - N_SOURCE)])
            _, F, S_q = motion.step(state, row.time_s - rows[i - 1].time_s)
            P = F @ P @ F.T + S_q @ S_q.T
            full = np.concatenate([H, np.zeros((len(H), motion.n_states - N_SOURCE))], axis=1)
            gain = P @ full.T @ np.linalg.inv(full @ P @ full.T + np.eye(len(H)))
            keep = np.eye(motion.n_states) - gain @ full
            P = keep @ P @ keep.T + gain @ gain.T
        bounds[i] = math.sqrt(float(np.trace(P[:3, :3])))
    return bounds
