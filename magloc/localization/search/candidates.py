r"""Candidate positions on a grid, with scores of how much of the readings they explain.

Vector sensors are linear in the moment; moduli are nearly so if the ambient field is large compared with the field of
the source. Then the score of a position is the energy of the readings in the space of its three unit moments. Moduli
without an ambient field are even in the moment and linear only in its length. Then each pair of position and moment
direction has a score, the energy along one template.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.directions import fibonacci_directions
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.search.kernels import candidate_bases, choose_candidates
from magloc.measurement.whitened import WhitenedModel

SingleArray = NDArray[np.float32]
_SAME_GAIN = 0.02
_APART_RAD, _LEAST_APART_RAD = 0.25, 0.075
_CANDIDATES_AT_ONCE = 512
# Smallest square of a candidate's unit moment, along one direction, in the available channels.
_UNSEEN = 1e-7
_ROWS_AT_ONCE = 64  # rows whose components fit into the processor's cache
_LARGEST_SINGLE = 1e15  # largest residual, in units of noise, for single precision


def linear_bases(problem: WhitenedModel, gain: FloatArray, row: int, candidates: FloatArray) -> SingleArray:
    """Return whitened orthonormal bases (C, 3 n) of unit moments at candidates (n, 4), for linear channels.

    Columns are ordered by moment axis, then by candidate. The whitening is `row`'s; `gain` (C, 3) is in units of
    the noise. Single precision is enough to rank candidates.
    """
    columns = problem.basis[row] * np.sqrt(problem.shrinkage[row])
    return candidate_bases(problem, gain, columns, candidates).reshape(gain.shape[0], -1)


class LastBases:
    """Cache of bases and templates of the same candidates for the last whitening."""

    def __init__(self) -> None:
        self._kept: dict[str, tuple[bytes, SingleArray]] = {}

    def linear(self, problem: WhitenedModel, gain: FloatArray, row: int, candidates: FloatArray) -> SingleArray:
        """Return the bases of one row."""
        return self._reuse("bases", problem, gain, row, lambda: linear_bases(problem, gain, row, candidates))

    def templates(
        self, problem: WhitenedModel, row: int, candidates: FloatArray, directions: FloatArray
    ) -> SingleArray:
        """Return the templates of one row."""
        gain = problem.gain[row]
        return self._reuse(
            "templates", problem, gain, row, lambda: modulus_templates(problem, row, candidates, directions)
        )

    def _reuse(
        self, what: str, problem: WhitenedModel, gain: FloatArray, row: int, make: Callable[[], SingleArray]
    ) -> SingleArray:
        key = b"".join(values.tobytes() for values in (gain, problem.basis[row], problem.shrinkage[row]))
        if what not in self._kept or self._kept[what][0] != key:
            self._kept[what] = key, make()
        return self._kept[what][1]


def linear_scores(bases: SingleArray, residual: FloatArray) -> FloatArray:
    """Return the energy (b, n) of residuals (b, C) that moments at candidates explain."""
    components = residual.astype(np.float32) @ bases
    x, y, z = np.square(components, out=components).reshape(len(residual), 3, -1).swapaxes(0, 1)
    scores: FloatArray = np.add(x, y, dtype=np.float64)
    scores += z
    return np.nan_to_num(scores, copy=False, nan=-1.0)


def orthonormalisation_without(lost: SingleArray) -> SingleArray:
    """Return factors (6, n) that make components orthonormal after some directions are removed.

    Components are ``Qᵀ r`` of readings r along :func:`linear_bases` Q. The removed directions have the components
    `lost` (k, 3 n), B for each candidate. The remaining components, times the inverse of the lower Cholesky factor of
    ``I - Bᵀ B``, are along an orthonormal basis again. The result has the diagonal of this inverse, then the rest row
    by row. A candidate with a signal in the removed directions alone explains nothing.
    """
    x, y, z = lost.reshape(len(lost), 3, -1).astype(np.float64).swapaxes(0, 1)
    xx, yx, yy, zx, zy, zz = (-np.sum(a * b, axis=0) for a, b in ((x, x), (y, x), (y, y), (z, x), (z, y), (z, z)))
    l00 = np.sqrt(np.maximum(1.0 + xx, _UNSEEN))
    l10, l20 = yx / l00, zx / l00
    l11 = np.sqrt(np.maximum(1.0 + yy - l10 * l10, _UNSEEN))
    l21 = (zy - l20 * l10) / l11
    l22 = np.sqrt(np.maximum(1.0 + zz - l20 * l20 - l21 * l21, _UNSEEN))
    i10, i21 = -l10 / (l11 * l00), -l21 / (l22 * l11)
    i20 = -(l20 / l00 + l21 * i10) / l22
    return np.array([1.0 / l00, 1.0 / l11, 1.0 / l22, i10, i20, i21], dtype=np.float32)


def best_candidates(
    bases: SingleArray,
    residual: FloatArray,
    candidates: FloatArray,
    n_starts: int,
    apart_rad: float,
    orthonormal: SingleArray | None = None,
) -> NDArray[np.intp]:
    """Return :func:`distinct_best` of :func:`linear_scores` of residuals (b, C), compiled.

    `orthonormal` is :func:`orthonormalisation_without` the directions that the residuals lack, if any.
    """
    chosen = np.zeros((len(residual), n_starts), dtype=np.intp)
    # Scale rows so that single precision holds their squares; the ranking does not change.
    largest = np.abs(residual).max(axis=1, keepdims=True, initial=0.0)
    of_rows = (residual / np.where(largest > _LARGEST_SINGLE, largest, 1.0)).astype(np.float32)
    cos_apart = math.cos(apart_rad)
    # Reuse memory: the system clears new memory first, which takes as long as the choice.
    components = np.empty((min(_ROWS_AT_ONCE, len(residual)), bases.shape[1]), dtype=np.float32)
    for begin in range(0, len(residual), _ROWS_AT_ONCE):
        some = of_rows[begin : begin + _ROWS_AT_ONCE]
        of_some = np.matmul(some, bases, out=components[: len(some)]).reshape(len(some), 3, -1)
        if orthonormal is not None:
            x, y, z = of_some.swapaxes(0, 1)
            i00, i11, i22, i10, i20, i21 = orthonormal
            z[:] = i20 * x + i21 * y + i22 * z
            y[:] = i10 * x + i11 * y
            x *= i00
        chosen[begin : begin + _ROWS_AT_ONCE] = choose_candidates(of_some, candidates, cos_apart, n_starts)
    return chosen


def rows_of_equal_gain(gain: FloatArray) -> Iterator[NDArray[np.intp]]:
    """Yield rows whose gains (b, C, 3) are near enough to rank candidates alike."""
    scale = np.max(np.abs(gain), axis=(1, 2), keepdims=True)
    rounded = np.round(gain / np.where(scale > 0.0, scale, 1.0) / _SAME_GAIN)
    if np.all(rounded == rounded[:1]):
        yield np.arange(len(gain))
        return
    _, of_row = np.unique(rounded.reshape(len(gain), -1), axis=0, return_inverse=True)
    for i in range(int(of_row.max()) + 1):
        yield np.flatnonzero(of_row.ravel() == i)


def modulus_templates(problem: WhitenedModel, row: int, candidates: FloatArray, directions: FloatArray) -> SingleArray:
    """Return unit templates (n, d, C) of moments along directions (d, 3) at candidates (n, 4).

    Without an ambient field all channels, including moduli, are proportional to the length of the moment.
    """
    n_directions = len(directions)
    templates = np.empty((len(candidates), n_directions, problem.gain.shape[1]), dtype=np.float32)
    for begin in range(0, len(candidates), _CANDIDATES_AT_ONCE):
        block = candidates[begin : begin + _CANDIDATES_AT_ONCE]
        at = problem.rows(np.full(len(block) * n_directions, row)).without_ambient()
        q = np.repeat(block, n_directions, axis=0)[:, None]
        mu = np.tile(directions, (len(block), 1))[:, None]
        predicted = at.predict(at.source_fields(q, mu))
        norm = np.linalg.norm(predicted, axis=-1, keepdims=True)
        unit = predicted / np.where(norm > 0.0, norm, np.inf)
        templates[begin : begin + len(block)] = np.nan_to_num(unit).reshape(len(block), n_directions, -1)
    return templates


def modulus_scores(templates: SingleArray, residual: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the energy (b, n) along every candidate's best template, and its direction."""
    n, n_directions, n_channels = templates.shape
    flat = residual.astype(np.float32) @ templates.reshape(-1, n_channels).T
    along = np.maximum(flat, 0.0).reshape(len(residual), n, n_directions)
    best = np.argmax(along, axis=-1)
    return np.take_along_axis(along, best[..., None], axis=-1)[..., 0].astype(np.float64) ** 2, best


def distinct_best(scores: FloatArray, candidates: FloatArray, n_starts: int, apart_rad: float) -> NDArray[np.intp]:
    """Return the best candidates (b, n_starts) by scores (b, n), some angle apart.

    The best is repeated if none remains.
    """
    left = scores.copy()
    chosen = np.empty((len(scores), n_starts), dtype=np.intp)
    for k in range(n_starts):
        best = np.argmax(left, axis=1)
        exhausted = np.take_along_axis(left, best[:, None], axis=1)[:, 0] < 0.0
        chosen[:, k] = np.where(exhausted, chosen[:, 0] if k else best, best)
        near = np.abs(candidates[chosen[:, k]] @ candidates.T) > np.cos(apart_rad)
        left[near] = -1.0
    return chosen


def candidate_positions(
    array: SensorArray,
    *,
    n_directions: int = 150,
    ranges: ArrayLike = (0.6, 0.9, 1.4, 2.4, 6.0, 30.0),
    n_near_directions: int = 12,
    n_inner_directions: int = 60,
) -> FloatArray:
    """Return positions (n, 3) [m] that a search scores.

    Around the centroid they are directions times ranges from 0.6 to 60 circumradii, in geometric steps. Around each
    sensor there are shells of 0.35, 0.7 and 1.4 times the distance to the next sensor, for sources close to a large
    array. Inner shells of 0.2 and 0.4 circumradii serve weak rows, which have optima there.
    """
    shells = array.circumradius * np.asarray(ranges)
    outer = array.centroid + (shells[:, None, None] * fibonacci_directions(n_directions)).reshape(-1, 3)
    near_shells = _to_next_sensor(array)[:, None] * np.array([0.35, 0.7, 1.4])
    offsets = near_shells[:, :, None, None] * fibonacci_directions(n_near_directions)
    near = (array.positions[:, None, None] + offsets).reshape(-1, 3)
    inner = array.centroid + array.circumradius * np.multiply.outer(
        [0.2, 0.4], fibonacci_directions(n_inner_directions)
    )
    return np.concatenate([outer, near, inner.reshape(-1, 3)])


def start_separation(array: SensorArray) -> float:
    """Return the least angle [rad] between two starts.

    It is smaller if sensors are close together, because several starts must be near one sensor.
    """
    apart = _APART_RAD * float(np.median(_to_next_sensor(array))) / array.circumradius
    return min(max(apart, _LEAST_APART_RAD), _APART_RAD)


def _to_next_sensor(array: SensorArray) -> FloatArray:
    """Return the distance (N,) [m] of every sensor to its nearest neighbour."""
    distances: FloatArray = np.linalg.norm(array.positions[:, None] - array.positions, axis=-1)
    np.fill_diagonal(distances, np.inf)
    nearest: FloatArray = distances.min(axis=1)
    return nearest


def fine_positions(array: SensorArray) -> FloatArray:
    """Return a finer grid around the array, for a search that refines few candidates."""
    return candidate_positions(array, n_directions=200, ranges=np.geomspace(0.6, 60.0, 10), n_inner_directions=0)


def allowed_positions(array: SensorArray, prior: SourcePrior, candidates: FloatArray | None = None) -> FloatArray:
    """Return the candidates that a prior allows; raise ValueError if there are none.

    By default the candidates are :func:`candidate_positions`.
    """
    candidates = candidate_positions(array) if candidates is None else candidates
    allowed: FloatArray = candidates[prior.allows_position(candidates)]
    if not len(allowed):
        raise ValueError("Input prior must allow positions around the array; instead it excludes all of them.")
    return allowed
