"""Compiled Cramér-Rao bounds of range and bearing; the readable twin is :func:`magloc.bounds.crlb.cramer_rao_bounds`.

:mod:`magloc.bounds.quadratic_forms_compiled` has the information for vector sensors of constant noise,
:mod:`magloc.bounds.lanes_compiled` for all others, both in axes (u, v, n) with n along the line from the sensors'
centroid to the source: docs/theory/cramer-rao-bounds.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.bounds import lanes_compiled as bound_lanes
from magloc.bounds import quadratic_forms_compiled as bound_forms
from magloc.bounds.frame_compiled import LOST_INFORMATION, BoundModel, read_only
from magloc.compilation import compiled, internal, over_rows
from magloc.linalg_compiled import fill_frame


class _Work(NamedTuple):
    """Arrays that are written anew for every source."""

    frame: FloatArray
    entries: FloatArray
    forms: bound_forms.Forms
    block: bound_lanes.Block


def table_and_spreads(
    model: BoundModel,
    positions: FloatArray,
    lengths: FloatArray,
    alone: FloatArray,
    moments: FloatArray,
    quantiles: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """σ of range [m], bearing [rad] and position [m] of positions (P, 3), a table and statistics.

    Sources are bodies of some lengths (P,) [m] where the model has errors of bodies.

    The table (3, P, K) is that of moments that stand alone (K, 3); mean, quantiles and greatest (P, 3, 2 + quantiles)
    are those of other moments (M, 3), NaN if there are none.
    """
    table = np.empty((len(positions), len(alone), 3))
    spreads = np.full((len(positions), 3, 2 + quantiles.size), np.nan)
    ranks = np.ceil(quantiles * len(moments)).astype(np.intp) - 1
    every = np.concatenate([alone, moments])
    inputs = map(read_only, (positions, lengths, every))
    over_rows(_fill, len(positions), *inputs, model, read_only(ranks), table, spreads)
    return np.ascontiguousarray(np.moveaxis(table, -1, 0)), spreads


@compiled
def _fill(
    begin: int,
    end: int,
    positions: FloatArray,
    lengths: FloatArray,
    moments: FloatArray,
    model: BoundModel,
    ranks: NDArray[np.intp],
    table: FloatArray,
    spreads: FloatArray,
) -> None:
    """The first moments are those of the table, the others those of the spreads."""
    work = _Work(
        np.empty((3, 3)),
        np.empty((9, moments.shape[0] + bound_lanes.LANES)),
        bound_forms.new_forms(model, moments),
        bound_lanes.new_block(model, moments.shape[0]),
    )
    n_alone = table.shape[1]
    sigmas, ordered = np.empty(moments.shape), np.empty(moments.shape[0] - n_alone)
    for i in range(begin, end):
        length = fill_frame(positions[i] - model.centroid, work.frame)
        if model.varies:
            bound_lanes.fill_entries(model, positions[i], lengths[i], moments, work.frame, work.block, work.entries)
        else:
            bound_forms.fill_entries(model, positions[i], work.frame, work.forms, work.entries)
        _fill_sigmas(length, work.entries, sigmas)
        for j in range(n_alone):
            for quantity in range(3):
                table[i, j, quantity] = sigmas[j, quantity]
        if ordered.size > 0:
            _fill_spread(sigmas[n_alone:], ranks, ordered, spreads[i])


@internal
def _fill_sigmas(length: float, e: FloatArray, out: FloatArray) -> None:
    """The three σ of one position for every moment, into out (M, 3)."""
    for j in range(out.shape[0]):
        if not math.isfinite(e[6, j]):  # on a sensor, or in the centroid, where the frame is not a number
            out[j] = math.nan
            continue
        out[j, 0], out[j, 1], out[j, 2] = _sigmas(
            length, e[0, j], e[1, j], e[2, j], e[3, j], e[4, j], e[5, j], e[6, j], e[7, j], e[8, j]
        )


@internal
def _sigmas(
    length: float, uu: float, uv: float, vv: float, un: float, vn: float, nn: float, u: float, v: float, n: float
) -> tuple[float, float, float]:
    """σ of range, bearing and position from the information, and from what it would be for a known moment."""
    # LDLᵀ in this order leaves for n what it tells of the range when the bearing is not known.
    u_known = uu > LOST_INFORMATION * u
    l_vu = uv / uu if u_known else 0.0
    l_nu = un / uu if u_known else 0.0
    vv -= l_vu * uv
    v_known = vv > LOST_INFORMATION * v
    vn -= l_vu * un
    l_nv = vn / vv if v_known else 0.0
    nn -= l_nu * un + l_nv * vn
    n_known = nn > LOST_INFORMATION * n
    range_variance = 1.0 / nn if n_known else math.inf
    x_u = l_nu - l_vu * l_nv
    with_range = x_u * x_u + l_nv * l_nv  # how the bearing goes with the range
    across = 1.0 / uu + (1.0 + l_vu * l_vu) / vv if u_known and v_known else math.inf
    if n_known or with_range > LOST_INFORMATION:
        across += with_range * range_variance
    return math.sqrt(range_variance), math.sqrt(across) / length, math.sqrt(range_variance + across)


@internal
def _fill_spread(sigmas: FloatArray, ranks: NDArray[np.intp], ordered: FloatArray, out: FloatArray) -> None:
    """Mean, order statistics and greatest of every column, into out (3, 2 + ranks)."""
    n = ordered.size
    for quantity in range(3):
        total = 0.0
        for j in range(n):
            ordered[j] = sigmas[j, quantity]
            total += ordered[j]
        if math.isnan(total):
            out[quantity] = math.nan
            continue
        ordered.sort()
        out[quantity, 0] = total / n
        for k in range(ranks.size):
            out[quantity, 1 + k] = ordered[ranks[k]]
        out[quantity, 1 + ranks.size] = ordered[n - 1]
