"""Optima of rows: their order, their covariances in other coordinates, and other poses whose readings are nearly alike.

Where readings are few, a pose has near twins: magnets change places, the body turns about its total moment, which alone
counts far away, or it moves on along the direction that the readings determine least. These are starts of a second
search.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.search import KEEP_WITHIN, N_KEPT, PoseOptima, refine_dipoles
from magloc.measurement.rows import WhitenedRows
from magloc.navigation.rotations import rotation_matrix


@dataclass(frozen=True, eq=False)
class RowOptima:
    """Optima of b rows, W places each; χ² is NaN where there is none."""

    position_m: FloatArray
    R: FloatArray
    chi2: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, found: PoseOptima) -> RowOptima:
        """Return what a search found."""
        return cls(found.position_m, found.R, found.chi2, found.covariance)

    def put(self, rows: IntArray | BoolArray, others: RowOptima) -> None:
        """Write the optima of some rows; they have at most as many places as these."""
        width = others.chi2.shape[1]
        for values, of_others in zip(vars(self).values(), vars(others).values(), strict=True):
            values[rows] = np.nan
            values[rows, :width] = of_others


def with_places(optima: RowOptima, width: int) -> RowOptima:
    """Return optima with more places."""
    more = width - optima.chi2.shape[1]
    return RowOptima(
        *(np.concatenate([v, np.full((len(v), more, *v.shape[2:]), np.nan)], axis=1) for v in vars(optima).values())
    )


def ranked(optima: RowOptima, length_m: float) -> RowOptima:
    """Return distinct optima within Δχ² 20 of the best, in order of χ²."""
    if optima.chi2.shape[1] == 1 and np.isfinite(optima.chi2).all():
        return optima
    several: BoolArray = np.asarray(np.isfinite(optima.chi2[:, 1:]).any(axis=1))
    if several.all():
        return _ranked(optima, length_m)
    # Most rows have one optimum, in its place.
    result = RowOptima(*(values.copy() for values in vars(optima).values()))
    if several.any():
        result.put(several, _ranked(RowOptima(*(values[several] for values in vars(optima).values())), length_m))
    known = np.isfinite(result.chi2)
    for values in vars(result).values():
        values[~known] = np.nan
    most = max(int(known.sum(axis=1).max()), 1)
    return RowOptima(*(values[:, :most] for values in vars(result).values()))


def _ranked(optima: RowOptima, length_m: float) -> RowOptima:
    """Return :func:`ranked` of rows with several optima."""
    optima = _in_order(optima)
    position, R, chi2 = optima.position_m, optima.R.reshape(*optima.chi2.shape, 9), optima.chi2
    chi2[~(chi2 <= chi2[:, :1] + KEEP_WITHIN)] = np.nan
    for k in range(1, chi2.shape[1]):
        way, turn = position[:, :k] - position[:, k : k + 1], R[:, :k] - R[:, k : k + 1]
        apart = np.sqrt(np.vecdot(way, way)) / length_m + np.sqrt(np.vecdot(turn, turn))
        chi2[((apart < 1e-3) & np.isfinite(chi2[:, :k])).any(axis=1), k] = np.nan
    return without_gaps(optima)


def without_gaps(optima: RowOptima) -> RowOptima:
    """Return optima in order of χ² in as few places as they need, NaN in the others."""
    most = max(int(np.isfinite(optima.chi2).sum(axis=1).max(initial=0)), 1)
    result = RowOptima(*(values[:, :most] for values in vars(_in_order(optima)).values()))
    gone = ~np.isfinite(result.chi2)
    for values in vars(result).values():
        values[gone] = np.nan
    return result


def _in_order(optima: RowOptima) -> RowOptima:
    """Return a copy of optima in order of χ², those without one last."""
    order, row = np.argsort(optima.chi2, axis=1, kind="stable"), np.arange(len(optima.chi2))[:, None]
    return RowOptima(*(values[row, order] for values in vars(optima).values()))


def turned_covariances(covariance: FloatArray, lead: FloatArray) -> FloatArray:
    """Return covariances (..., 6, 6) in a body's frame that is rotated by matrices (..., 3, 3)."""
    change = np.zeros((*lead.shape[:-2], 6, 6))
    change[..., :3, :3] = np.eye(3)
    change[..., 3:, 3:] = np.swapaxes(lead, -1, -2)
    return np.asarray(change @ covariance @ np.swapaxes(change, -1, -2))


def inverses(jacobian: FloatArray) -> FloatArray:
    """Return the inverses (b, 6, 6) of the information of Jacobians (b, C, 6), NaN where it is singular."""
    information = jacobian.mT @ jacobian
    scale = 1.0 / np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    system = scale[:, :, None] * information * scale[:, None]
    valid: BoolArray = np.asarray(np.isfinite(system).all(axis=(1, 2)))
    valid[valid] = np.linalg.cond(system[valid]) < 1e13
    inverse = np.full(system.shape, np.nan)
    inverse[valid] = np.linalg.inv(system[valid])
    return np.asarray(scale[:, :, None] * inverse * scale[:, None])


_ROLLS_RAD = np.radians([60.0, 120.0, 180.0, 240.0, 300.0])
_MOST_PERMUTED = 3  # magnets; of more only neighbours change places in turn
_STEPS = (-0.5, -0.2, 0.2, 0.5)  # along the least determined direction, in radians or radii of the body
_SAME = 1e-3


def with_alternatives(rows: WhitenedRows, body: MagnetBody, optima: RowOptima) -> RowOptima:
    """Return the distinct optima of rows, with those that the other poses lead to."""
    n, width = optima.chi2.shape
    row, place = np.nonzero(np.isfinite(optima.chi2))
    position, R = alternative_poses(
        body, optima.position_m[row, place], optima.R[row, place], optima.covariance[row, place]
    )
    m = R.shape[1]
    fits, covariance = refine_dipoles(
        rows.model, rows.y, body, position.reshape(-1, 3), R.reshape(-1, 3, 3), row=np.repeat(row, m)
    )
    found = (fits.position_m, fits.R, np.where(fits.converged, fits.chi2, np.nan), covariance)
    together = []
    for before, after in zip(vars(optima).values(), found, strict=True):
        values = np.full((n, width * m, *before.shape[2:]), np.nan)
        values.reshape(n, width, m, *before.shape[2:])[row, place] = after.reshape(len(row), m, *before.shape[2:])
        together.append(np.concatenate([before, values], axis=1))
    return _best(RowOptima(*together), body.radius_m)


def alternative_poses(
    body: MagnetBody, position_m: FloatArray, R: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return other poses (b, m, 3) and (b, m, 3, 3) of poses (b, 3) and (b, 3, 3) with covariances (b, 6, 6)."""
    turns = _turns(body)
    turned = R[:, None] @ turns
    places = position_m[:, None] + (R[:, None] - turned) @ body.centre_m
    unit = np.repeat([1.0 / body.radius_m, 1.0], 3)
    softest = np.linalg.eigh(np.nan_to_num(unit[:, None] * covariance * unit))[1][..., -1] / unit
    steps = np.array(_STEPS)[:, None] * softest[:, None]
    stepped = R[:, None] @ rotation_matrix(steps[..., 3:])
    along = position_m[:, None] + steps[..., :3]
    return np.concatenate([places, along], axis=1), np.concatenate([turned, stepped], axis=1)


def _turns(body: MagnetBody) -> FloatArray:
    """Return rotations (m, 3, 3) about the centre of the magnets whose fields are like that of the body."""
    total = body.moments_Am2.sum(axis=0)
    length = np.linalg.norm(total)
    axis = total / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    arms = (body.positions_m - body.centre_m) / body.radius_m
    vectors = np.concatenate([arms, body.moments_Am2 / np.linalg.norm(body.moments_Am2, axis=1).max()])
    n = len(arms)
    turns = list(rotation_matrix(_ROLLS_RAD[:, None] * axis))
    if n <= _MOST_PERMUTED:
        orders = list(permutations(range(n)))[1:]
    else:
        orders = [tuple(np.roll(np.arange(n), k).tolist()) for k in range(1, n)]
    for order in orders:
        index = np.array(order)
        turn, _ = Rotation.align_vectors(vectors[np.concatenate([index, n + index])], vectors)
        turns.append(turn.as_matrix())
    return np.array(turns)


def _best(optima: RowOptima, length_m: float) -> RowOptima:
    """Return the optima with the least χ² that differ from the ones before."""
    optima = _in_order(optima)
    way = np.linalg.norm(np.diff(optima.position_m, axis=1), axis=-1) / length_m
    turn = np.linalg.norm(np.diff(optima.R, axis=1), axis=(-2, -1))
    later = optima.chi2[:, 1:]
    later[(way + turn < _SAME) & (np.diff(optima.chi2, axis=1) < _SAME * (1.0 + later))] = np.nan
    return RowOptima(*(values[:, :N_KEPT] for values in vars(without_gaps(optima)).values()))
