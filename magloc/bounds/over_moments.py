"""Cramér-Rao bounds of many sources with many moments: tables and statistics.

The readable reference of every entry is :func:`magloc.bounds.crlb.cramer_rao_bounds`; for when they are infinite see
docs/theory/cramer-rao-bounds.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.bounds.crlb import check_uncertainty
from magloc.bounds.sources import array_model, source_bounds
from magloc.fields.multipole import assumed_body_lengths, check_body_length
from magloc.levels import TYPICAL_AND_BAD


class Spread(NamedTuple):
    """Statistics of a σ over the directions of the moment, each of shape (...)."""

    mean: FloatArray
    median: FloatArray
    q95: FloatArray
    worst: FloatArray


class MomentBounds(NamedTuple):
    """Bounds over sampled moments of one size (:mod:`magloc.bounds.crlb`)."""

    sigma_range_m: Spread
    sigma_bearing_rad: Spread
    sigma_position_m: Spread


class SigmaTable(NamedTuple):
    """Bounds of P sources with M moments each, shape (P, M)."""

    range_m: FloatArray
    bearing_rad: FloatArray
    position_m: FloatArray


def bounds_over_moments(
    array: SensorArray,
    positions_m: ArrayLike,
    moments_Am2: ArrayLike,
    *,
    ambient_uncertainty_T: float = 0.0,
    known_moment_sigma_Am2: float = np.inf,
    body_length_m: float | None = 0.0,
) -> MomentBounds:
    """Return statistics (P,) of the bounds of positions (P, 3) over moments (M, 3) [A·m²].

    They are mean, median, 95 % quantile and worst.

    For the other parameters see :func:`magloc.bounds.crlb.cramer_rao_bounds`.
    """
    table = sigma_table(
        array,
        positions_m,
        moments_Am2,
        ambient_uncertainty_T=ambient_uncertainty_T,
        known_moment_sigma_Am2=known_moment_sigma_Am2,
        body_length_m=body_length_m,
    )
    return MomentBounds(*map(spread_over, table))


def sigma_table(
    array: SensorArray,
    positions_m: ArrayLike,
    moments_Am2: ArrayLike,
    *,
    ambient_uncertainty_T: float = 0.0,
    known_moment_sigma_Am2: float = np.inf,
    body_length_m: float | None = 0.0,
) -> SigmaTable:
    """Return bounds (P, M) for every pair of positions (P, 3) and moments (M, 3).

    Infinite where the information is singular, NaN for a source on a sensor or in the centroid.
    """
    positions, moments = _rows("positions_m", positions_m), _rows("moments_Am2", moments_Am2)
    check_uncertainty(ambient_uncertainty_T, known_moment_sigma_Am2)
    check_body_length(body_length_m)
    lengths = assumed_body_lengths(array.positions, positions, array.circumradius, body_length_m)
    table = np.empty((3, len(positions), len(moments)))
    # Points are computed without the many nuisances of bodies, which are slow.
    for is_body in (False, True):
        (places,) = np.nonzero((lengths > 0.0) == is_body)
        if not places.size:
            continue
        model = array_model(
            array,
            ambient_uncertainty_T=ambient_uncertainty_T,
            known_moment_sigma_Am2=known_moment_sigma_Am2,
            bodies=is_body,
        )
        length_m = lengths[places] if is_body else None
        table[:, places] = source_bounds(model, array.positions, positions[places], moments, length_m=length_m)
    return SigmaTable(*table)


def spread_over(sigma: ArrayLike) -> Spread:
    """Return order statistics of σ over its last axis; infinite neighbours do not matter."""
    ordered = np.sort(np.asarray(sigma, dtype=np.float64), axis=-1)
    n = ordered.shape[-1]
    median, q95 = (ordered[..., int(np.ceil(q * n)) - 1] for q in TYPICAL_AND_BAD)
    blank = np.where(np.isnan(ordered[..., -1]), np.nan, 0.0)
    return Spread(ordered.mean(axis=-1), median + blank, q95 + blank, ordered[..., -1])


def _rows(name: str, values: ArrayLike) -> FloatArray:
    rows = np.ascontiguousarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3 or not len(rows):
        raise ValueError(f"Input {name} must have shape (n, 3), n at least 1; instead received {rows.shape}.")
    return rows
