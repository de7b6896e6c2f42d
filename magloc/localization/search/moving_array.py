"""Search for one source at rest from several rows of a moving array.

A few scalar sensors do not locate a source in one row, but they do while they pass it. Every row has its own common
field, so that changes of the ambient field between rows do not matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.directions import fibonacci_directions
from magloc.localization.fit.gauss_newton import refine
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN
from magloc.localization.search.beam_search import BeamSearch
from magloc.measurement.pose import PosesOfRows
from magloc.measurement.rows import WhitenedRows, ambient_fields, channels_above_ambient, whitenings_of
from magloc.measurement.whitened import WhitenedModel

_N_DIRECTIONS = 200
_N_RANGES = 10
_WIDTH = 8
# Number of linearisations of the errors of poses.
_ROUNDS = 3
_UNSEEN = "the rows together do not determine the source"


def optima_at_rest(
    rows: WhitenedRows, prior: SourcePrior = NOTHING_KNOWN, errors: Callable[[FloatArray], FloatArray] | None = None
) -> Optima:
    """Return distinct optima of a source at rest, by :func:`stacked_rows`.

    `prior` bounds its position in the world frame.

    `errors` returns columns (b, C, n) in units of the noise for a source (6,), which count as noise. They are
    linearised at the best optimum, first for a new search, then until they no longer change.
    """
    rows = rows.with_known_moment(prior.known_moment)
    optima = _search(rows, prior)
    for step in range(_ROUNDS if errors is not None else 0):
        if errors is None or not np.isfinite(optima.fits.chi2[:1]).any():
            break
        best = optima.fits.rows(np.zeros(1, dtype=np.intp))
        place = [rows.model.position(best.q)[0, 0], rows.model.moment(best.q, best.mu)[0, 0]]
        noisy = rows.marginalise(errors(np.concatenate(place)))
        if step == 0:
            optima = _search(noisy, prior)
            continue
        start = optima.fits
        every = np.zeros(len(start.chi2), dtype=np.intp)
        fits = refine(noisy.model.rows(every), noisy.y[every], start.q, start.mu)
        optima = replace(optima, rows=noisy, fits=fits.rows(np.argsort(fits.chi2, kind="stable")))
    return optima


def _search(rows: WhitenedRows, prior: SourcePrior) -> Optima:
    """Return the optima of one search."""
    model, allowed = rows.model, partial(prior.allows, rows.model)
    beam = BeamSearch(model.homogeneous(_candidates(model)), allowed, width=_WIDTH).first_sources(model, rows.y)
    fits = beam.rows(0)
    listed = np.flatnonzero(np.isfinite(fits.chi2) & (fits.chi2 <= fits.chi2[0] + DISTINCT_WITHIN))
    of_row = np.zeros(len(listed), dtype=np.intp)
    return Optima(rows, fits.rows(listed), of_row, [""], undetermined=_UNSEEN)


def stacked_errors(
    poses: PosesOfRows, readings_T: FloatArray, ambient_T: FloatArray | None
) -> Callable[[FloatArray], FloatArray]:
    """Return a function of a source for the effect (1, C n, k) of pose errors on :func:`stacked_rows`.

    The effect is in units of the noise.
    """
    array = poses.array
    fields = ambient_fields(array, len(readings_T), ambient_T)
    masks = np.isfinite(readings_T)
    roots = [whitenings_of(array, mask, row).root for mask, row in zip(masks, readings_T, strict=True)]

    def errors(source: FloatArray) -> FloatArray:
        columns = poses.channel_errors(source, fields)
        return np.concatenate([root @ of_row for root, of_row in zip(roots, columns, strict=True)])[None]

    return errors


def stacked_rows(
    array: SensorArray,
    readings_T: FloatArray,
    origins_m: FloatArray,
    R_world_from_array: FloatArray,
    ambient_T: FloatArray | None = None,
) -> WhitenedRows:
    """Return rows (n, C) of a moving array as one row of a large array in the world frame."""
    n, available = len(readings_T), np.isfinite(readings_T)
    whitenings = [whitenings_of(array, mask, row) for mask, row in zip(available, readings_T, strict=True)]
    fields = ambient_fields(array, n, ambient_T)
    channels = channels_above_ambient(array, available, readings_T, fields)
    raw = np.concatenate([w.root @ row for w, row in zip(whitenings, channels, strict=True)])
    # A vector channel reads a · Rᵀ B of the world's field B; a modulus does not depend on the attitude.
    turned = np.where(
        array.channel_is_scalar[:, None],
        array.channel_gain,
        array.channel_gain @ np.swapaxes(R_world_from_array, 1, 2),
    )
    gain = np.concatenate([w.root @ row for w, row in zip(whitenings, turned, strict=True)])
    places = (origins_m[:, None] + np.einsum("nij,sj->nsi", R_world_from_array, array.positions)).reshape(-1, 3)
    centroid = places.mean(axis=0)
    radius = float(np.linalg.norm(places - centroid, axis=1).max())
    sensor = array.channel_sensor.astype(np.intp)
    model = WhitenedModel(
        centroid=centroid,
        radius=radius,
        sensors=(places - centroid) / radius,
        channel_sensor=np.concatenate([sensor + i * array.n_sensors for i in range(n)]),
        channel_is_scalar=np.tile(array.channel_is_scalar, n),
        gain=gain[None],
        ambient=np.einsum("nij,nsj->nsi", R_world_from_array, fields).reshape(1, -1, 3),
        basis=block_diag(*(w.basis for w in whitenings))[None],
        shrinkage=np.concatenate([w.shrinkage for w in whitenings])[None],
    )
    return WhitenedRows(
        np.zeros(1, dtype=np.intp),
        available.ravel(),
        readings_T.reshape(1, -1),
        model,
        raw[None],
        model.whiten(raw[None]),
        sum(w.n_differences for w in whitenings),
    )


def _candidates(problem: WhitenedModel) -> FloatArray:
    """Return positions along the array's track: by direction, and near every place."""
    ranges = problem.radius * np.geomspace(0.3, 20.0, _N_RANGES)
    outer = problem.centroid + (ranges[:, None, None] * fibonacci_directions(_N_DIRECTIONS)).reshape(-1, 3)
    places = problem.centroid + problem.radius * problem.sensors
    step = max(1, len(places) // 24)
    shells = problem.radius * np.array([0.1, 0.2, 0.4])
    near = (places[::step, None, None] + shells[:, None, None] * fibonacci_directions(12)).reshape(-1, 3)
    return np.concatenate([outer, near])
