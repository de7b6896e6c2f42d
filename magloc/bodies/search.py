"""Search for a body's pose without a start.

The readings of a table of candidate poses are known before any reading comes. Those most like the readings start
damped Gauss-Newton fits; all distinct optima near the best one are kept. ``body.hpp`` does this in compiled form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.bodies.body import MagnetBody
from magloc.bodies.field import body_fields, placed_magnets
from magloc.bodies.fit import MAX_ITERATIONS, RELATIVE_TOLERANCE, TOLERANCE, PoseFits
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.measurement.channels import signals_of
from magloc.measurement.whitened import WhitenedModel
from magloc.navigation.rotations import rotation_matrix

N_CANDIDATES, N_STARTS, N_KEPT = 4096, 16, 8
"""Poses of the table, starts of a row, and largest number of optima that are kept."""
KEEP_WITHIN = 20.0
"""Rise of χ² above the best optimum within which others are kept."""
_APART = 0.15  # least distance of two starts, in radii of the array and radians together
_NEAREST = 0.15  # least distance of a magnet from a sensor in the table, in radii
_FARTHEST = 6.0  # range of the table for a body without limits, in radii of array and body together
_ROWS_A_BLOCK = 256
_TINY = 1e-300  # square of readings that are all zero
_GOLDEN = 1.1127756842787055  # root of x^7 = x + 1: a lattice of six dimensions


class PoseOptima(NamedTuple):
    """Distinct optima of n rows, best first, W places a row; NaN where there is none.

    Positions (n, W, 3), rotation matrices (n, W, 3, 3), χ² (n, W), covariances (n, W, 6, 6) of (δx, δθ) with δθ in the
    body's frame, and counts (n, 3): optima, starts that did not converge, linearisations. The bend (n,) is that of the
    readings over one standard deviation of the best pose, in units of the noise. Plain rows (n,) have a best χ² below
    that of :func:`pose_table`, and all their optima are apart and within the limits of the body.
    """

    position_m: FloatArray
    R: FloatArray
    chi2: FloatArray
    covariance: FloatArray
    counts: NDArray[np.int64]
    bend: FloatArray
    is_plain: BoolArray


def spread_poses(body: MagnetBody, array: SensorArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Return n poses spread evenly over the limits of a body: positions (n, 3) and rotation matrices (n, 3, 3).

    Without limits of the position they are at all distances that are of interest, in equal steps of its logarithm.
    """
    lattice = (0.5 + np.arange(1, n + 1)[:, None] * _GOLDEN ** -np.arange(1.0, 7.0)) % 1.0
    R = rotation_matrix(_turns(lattice[:, 3:], body.limits.angle_rad))
    limits = body.limits
    if limits.is_bounded:
        return np.array(limits.low_m) + lattice[:, :3] * np.subtract(limits.high_m, limits.low_m), R
    size = array.circumradius + body.radius_m
    distance = 0.3 * size * (_FARTHEST / 0.3) ** lattice[:, :1]
    middle = array.centroid + distance * _directions(lattice[:, 1:3])
    position = middle - R @ body.centre_m
    return np.clip(position, limits.low_m, limits.high_m), R


def _directions(uniform: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) of uniform numbers (n, 2)."""
    z, azimuth = 2.0 * uniform[:, 0] - 1.0, 2.0 * math.pi * uniform[:, 1]
    across = np.sqrt(1.0 - z * z)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])


def _turns(uniform: FloatArray, largest_rad: float) -> FloatArray:
    """Return rotation vectors (n, 3), uniform among the rotations up to an angle, of uniform numbers (n, 3)."""
    angles = np.linspace(0.0, largest_rad, 2001)
    angle = np.interp(uniform[:, 2] * (largest_rad - math.sin(largest_rad)), angles - np.sin(angles), angles)
    return np.asarray(angle[:, None] * _directions(uniform))


def features_of(y: FloatArray) -> NDArray[np.float32]:
    """Return readings (n, C) as points whose distances tell how far poses are apart.

    The field falls with the third power of the distance, so the length of a reading is replaced by its cubic root.
    """
    features = np.ones((len(y), y.shape[1] + 1), dtype=np.float32)
    features[:, :-1] = y / np.cbrt(np.vecdot(y, y) + _TINY)[:, None]
    return features


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Candidate poses under one whitening, for the kernel.

    Attributes
    ----------
    candidates : ndarray, shape (M, 12)
        Position in radii from the array's centroid, and rotation matrix.
    table : ndarray of float32, shape (C + 1, M)
        Features of their readings; with the last row, the nearest candidate has the largest product.
    fit, search : Problem
        What the kernel needs to know of all rows.
    """

    candidates: FloatArray
    table: NDArray[np.float32]
    fit: core.Problem
    search: core.Problem


def pose_table(
    model: WhitenedModel,
    array: SensorArray,
    body: MagnetBody,
    n: int = N_CANDIDATES,
    *,
    n_starts: int = N_STARTS,
    keep_within: float = KEEP_WITHIN,
    most_chi2: float = -math.inf,
) -> PoseTable:
    """Return the table of candidates for rows that share a whitening, and how they are searched.

    Only the first row of the model counts. The χ² is that of plain rows at most.
    """
    position, R = spread_poses(body, array, n)
    usable = _is_clear(body, array, position, R)
    position, R = position[usable], R[usable]
    one = model.rows(np.zeros(len(position), dtype=np.intp))
    features = features_of(one.predict(body_fields(body, array.positions, position, R)) - one.ambient_signals)
    features[:, -1] = -0.5 * np.vecdot(features[:, :-1], features[:, :-1])
    candidates, table = packed(model, position, R), np.ascontiguousarray(features.T)
    limits, fit = body.limits, fit_problem(model, body, None, None, MAX_ITERATIONS)
    of_rows = ("features", "bend", "is_plain", "pose", "chi2", "covariance", "counts")
    search = core.problem(
        "pose_search",
        fit=fit,
        n_candidates=len(candidates),
        n_features=len(table),
        n_starts=n_starts,
        n_kept=N_KEPT,
        keep_within=keep_within,
        apart=_APART,
        candidates=candidates,
        table=table,
        low=tuple((limits.low_m - model.centroid) / model.radius),
        high=tuple((limits.high_m - model.centroid) / model.radius),
        least_trace=1.0 + 2.0 * math.cos(limits.angle_rad),
        most_chi2=most_chi2,
        **dict.fromkeys(of_rows),
    )
    return PoseTable(candidates, table, fit, search)


def _is_clear(body: MagnetBody, array: SensorArray, position: FloatArray, R: FloatArray) -> BoolArray:
    """Return whether all magnets of poses (n,) are clear of all sensors; all poses if none is."""
    magnets, _ = placed_magnets(body, position, R)
    apart = np.linalg.norm(magnets[:, :, None] - array.positions, axis=-1).min(axis=(1, 2))
    clear = apart > _NEAREST * array.circumradius
    return clear if clear.any() else np.ones(len(clear), dtype=np.bool_)


def packed(model: WhitenedModel, position_m: FloatArray, R: FloatArray) -> FloatArray:
    """Return poses (..., 12) for the kernels."""
    in_radii = (position_m - model.centroid) / model.radius
    return np.ascontiguousarray(np.concatenate([in_radii, R.reshape(*R.shape[:-2], 9)], axis=-1))


def unpacked(model: WhitenedModel, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions [m] and rotation matrices of poses (..., 12) of the kernels."""
    return model.centroid + model.radius * pose[..., :3], pose[..., 3:].reshape(*pose.shape[:-1], 3, 3)


def signals_of_rows(model: WhitenedModel, y: FloatArray) -> FloatArray:
    """Return whitened readings (b, C) for the kernels, moduli above that of the ambient field."""
    return signals_of(model, y - model.ambient_signals if model.sees_moduli else y)


def fit_problem(
    model: WhitenedModel,
    body: MagnetBody,
    signals: FloatArray | None,
    row: IntArray | None,
    max_iterations: int,
    **results: object,
) -> core.Problem:
    """Return the fits of poses for the kernels, with signals of :func:`signals_of_rows`."""
    of_results = dict.fromkeys(("start", "pose", "chi2", "covariance", "iterations", "converged")) | results
    return core.problem(
        "pose_refinement",
        channels=model.channels,
        n_magnets=len(body.magnets),
        max_iterations=max_iterations,
        radius=model.radius,
        tolerance=TOLERANCE,
        relative_tolerance=RELATIVE_TOLERANCE,
        places=np.ascontiguousarray(body.positions_m / model.radius),
        moments=np.ascontiguousarray(body.moments_Am2 * (MU0_OVER_4PI / model.radius**3)),
        signals=signals,
        row=row,
        **of_results,
    )


def refine_dipoles(
    model: WhitenedModel,
    y: FloatArray,
    body: MagnetBody,
    position_m: FloatArray,
    R: FloatArray,
    *,
    row: IntArray | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> tuple[PoseFits, FloatArray]:
    """Return :func:`magloc.bodies.fit.refine_poses` of a body of dipoles, compiled, and its covariances (b, 6, 6).

    `row` has the row of the model for each start; by default there is one start a row.
    """
    n = len(position_m)
    pose, chi2, covariance = np.empty((n, 12)), np.empty(n), np.full((n, 6, 6), np.nan)
    iterations, converged = np.empty(n, np.int64), np.empty(n, np.uint8)
    start = packed(model, position_m, R)
    results: dict[str, object] = {"start": start, "pose": pose, "chi2": chi2, "covariance": covariance}
    results |= {"iterations": iterations, "converged": converged}
    rows = np.arange(n) if row is None else row
    work = fit_problem(model, body, signals_of_rows(model, y), rows, max_iterations, **results)
    core.run("refine_poses", work, n, block=_ROWS_A_BLOCK)
    position, rotation = unpacked(model, pose)
    fits = PoseFits(position, rotation, np.where(converged, chi2, np.inf), iterations.astype(np.intp))
    return fits, covariance


def search_poses(model: WhitenedModel, y: FloatArray, table: PoseTable) -> PoseOptima:
    """Return the distinct optima of whitened rows (n, C) of the table's body of dipoles."""
    n = len(y)
    pose, chi2 = np.empty((n, N_KEPT, 12)), np.empty((n, N_KEPT))
    covariance, counts = np.empty((n, N_KEPT, 6, 6)), np.empty((n, 3), np.int64)
    bend, is_plain = np.empty(n), np.empty(n, np.bool_)
    work = table.search.with_fields(
        fit=table.fit.with_fields(channels=model.channels, signals=signals_of_rows(model, y), row=np.arange(n)),
        features=features_of(y - model.ambient_signals if model.sees_moduli else y),
        bend=bend,
        is_plain=is_plain.view(np.uint8),
        pose=pose,
        chi2=chi2,
        covariance=covariance,
        counts=counts,
    )
    core.run("search_poses", work, n, block=_ROWS_A_BLOCK)
    most = max(int(counts[:, 0].max(initial=0)), 1)
    return PoseOptima(*unpacked(model, pose[:, :most]), chi2[:, :most], covariance[:, :most], counts, bend, is_plain)
