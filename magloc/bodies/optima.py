"""Optima of rows: their order, and their covariances in other coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.bodies.search import KEEP_WITHIN, PoseOptima


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
        """Write the optima of some rows, of at most as many places."""
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
    if optima.chi2.shape[1] == 1:
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
