"""Search for one dipole by vector sensors, without a start.

The moment is eliminated (:mod:`magloc.localization.fit.refinement`). Each position of a grid has a score: the share of
the readings' energy that it explains. A damped Gauss-Newton iteration, which accepts only steps that decrease χ²,
refines the best distinct positions. The result has every distinct optimum near the best one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from arrays.whitening import Whitening, whitening
from magloc.chi_square import quantile
from magloc.levels import CREDIBLE_FIT
from magloc.localization.fit.gauss_newton import JointFits
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN
from magloc.localization.search.candidates import (
    SingleArray,
    allowed_positions,
    best_candidates,
    linear_bases,
    orthonormalisation_without,
    start_separation,
)
from magloc.localization.search.kernels import LocalOptima, search_optima
from magloc.measurement.rows import WhitenedRows, channels_above_ambient, check_magnitudes, check_spans, whitened_rows
from magloc.measurement.whitened import WhitenedModel

N_UNKNOWNS = 6
NOT_ALLOWED = "no solution lies within the known region and largest moment"
_MORE = 3  # factor on the number of starts if none of them explains a row
# Largest share of missing channels for which candidates are ranked by the bases of all channels.
_MOST_MISSING = 0.4
# Singular value below which a direction of missing channels contains only the common field.
_UNSEEN = 1e-3


@dataclass(frozen=True, eq=False)
class BestFits:
    """Best optima from many starts, without uncertainty.

    Attributes
    ----------
    position_m, moment_Am2 : ndarray, shape (n, 3)
        Position [m] and moment [A·m²]; NaN if no start converged.
    chi2 : ndarray, shape (n,)
    linearisations : ndarray of int, shape (n,)
        Number of linearisations of all refinements together.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    chi2: FloatArray
    linearisations: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Ranking:
    """Candidates and their bases (C, 3 n) under the whitening of a mask.

    If few channels are missing, the whitening and the bases contain all channels, and missing readings are
    unknowns. Then `orthonormal` (6, n) makes the candidates' components orthonormal without the directions `lost`
    (C, k).
    """

    whitening: Whitening
    candidates: FloatArray
    bases: SingleArray
    lost: FloatArray | None = None
    orthonormal: SingleArray | None = None

    def without(self, missing: BoolArray) -> _Ranking:
        """Return the ranking for rows that miss some channels (C,)."""
        basis, shrinkage, root = self.whitening.basis, self.whitening.shrinkage, self.whitening.root[:, missing]
        unit = (root / np.linalg.norm(root, axis=0)).T
        left, singular, lost = np.linalg.svd(unit - ((unit @ basis) * shrinkage) @ basis.T, full_matrices=False)
        seen = singular > _UNSEEN
        turned, touched = (left[:, seen] / singular[seen]).T @ unit, unit.any(axis=0)
        bases = turned[:, touched].astype(np.float32) @ self.bases[touched]
        if not (shrinkage >= 1.0).all():  # otherwise the bases are orthogonal to the unknown common field
            bases -= (turned @ basis * shrinkage).astype(np.float32) @ self.common
        return replace(self, lost=lost[seen].T, orthonormal=orthonormalisation_without(bases))

    @cached_property
    def common(self) -> SingleArray:
        """Components of the bases along the common field."""
        common: SingleArray = self.whitening.basis.T.astype(np.float32) @ self.bases
        return common

    def whiten(self, channels: FloatArray) -> FloatArray:
        """Whiten readings (b, C) above the ambient field for the ranking."""
        whole = self.whitening.apply(channels)
        return whole if self.lost is None else whole - (whole @ self.lost) @ self.lost.T


class SingleSourceSearch:
    """Search for one source, by an array of vector sensors.

    Parameters
    ----------
    array : SensorArray
        Array of vector sensors only.
    n_starts : int
        Number of distinct candidates that are refined; three times as many if none reaches a credible χ².
    apart_rad : float, optional
        Least distance of two candidates, as an angle of their homogeneous coordinates; by default that of
        :func:`start_separation`.
    max_iterations : int
        Largest number of linearisations of one refinement to near an optimum; three times as many are allowed from
        there. A refinement that needs more has not converged.
    prior : SourcePrior
        Bounds of the source's position and moment.

    Raises
    ------
    ValueError
        The array has scalar sensors, or the prior excludes all positions of the grid.
    """

    def __init__(
        self,
        array: SensorArray,
        *,
        n_starts: int = 12,
        apart_rad: float | None = None,
        max_iterations: int = 100,
        prior: SourcePrior = NOTHING_KNOWN,
    ) -> None:
        if array.channel_is_scalar.any():
            raise ValueError("Input array must have vector sensors only; instead received one with scalar sensors.")
        check_magnitudes(array)
        check_spans(array)
        self.array = array
        self.n_starts = n_starts
        self.apart_rad = start_separation(array) if apart_rad is None else apart_rad
        self.max_iterations = max_iterations
        self.prior = prior
        self._everything = prior == NOTHING_KNOWN
        self._candidates = allowed_positions(array, prior)
        self._of_all: _Ranking | None = None
        self._kept: tuple[bytes, _Ranking] | None = None

    def optima(self, rows: WhitenedRows) -> list[Optima]:
        """Return all allowed optima of every row within Δχ² = 20 of its best one."""
        everything = self._everything
        keep_within = DISTINCT_WITHIN if everything else math.inf
        found = self.refine_starts(rows, np.arange(len(rows)), self.starts(rows), keep_within)
        credible = found.chi2[:, 0] <= quantile(rows.n_differences - N_UNKNOWNS, 1.0 - CREDIBLE_FIT)
        if np.count_nonzero(credible) < len(rows):
            doubtful = np.flatnonzero(~credible)
            some = rows.select(doubtful)
            more = self.refine_starts(some, np.arange(len(some)), self.starts(some, _MORE * self.n_starts), keep_within)
            for values, others in zip(found, more, strict=True):
                values[doubtful] = others[:, : values.shape[1]]
            np.minimum(found.counts[:, 0], self.n_starts, out=found.counts[:, 0])
        unknown = found.counts[:, 0]
        if not everything:
            found = self._apply_prior(rows.model, found)
        kept = found.counts[:, 0].tolist()
        of_row = np.arange(len(rows)).repeat(kept)
        # A slice for a single row: the table would take longer than all the rest of this function.
        listed = np.s_[0, : kept[0]] if len(rows) == 1 else np.arange(found.chi2.shape[1]) < found.counts[:, :1]
        q, mu = found.q[listed], found.mu[listed]
        reason = [""] * len(rows)
        for i in [i for i, n in enumerate(kept) if not n]:
            reason[i] = _why_unsolved(int(unknown[i]))
        fits = JointFits(q[:, None], mu[:, None], found.chi2[listed], found.iterations[listed])
        return [Optima(rows, fits, of_row, reason, failed_starts=found.counts[:, 1])]

    def optima_from(self, readings_T: ArrayLike, starts_m: ArrayLike) -> BestFits:
        """Return the best optimum of readings (C,) for every start (n, 3) [m].

        Starts are refined in addition to the candidates, without a prior.
        """
        (rows,) = whitened_rows(self.array, np.asarray(readings_T, dtype=np.float64)[None], None, 1)
        first = rows.model.homogeneous(np.asarray(starts_m, dtype=np.float64))[:, None]
        reading_of_row = np.zeros(len(first), dtype=np.intp)
        starts = np.concatenate([first, self.starts(rows)[reading_of_row]], axis=1)
        found = self.refine_starts(rows, reading_of_row, starts, DISTINCT_WITHIN)
        return BestFits(
            position_m=rows.model.position(found.q[:, 0]),
            moment_Am2=rows.model.moment(found.q[:, 0], found.mu[:, 0]),
            chi2=found.chi2[:, 0],
            linearisations=found.counts[:, 2],
        )

    def _ranking(self, mask: BoolArray) -> _Ranking:
        """Return the ranking under a mask; the large bases are cached."""
        key, few = mask.tobytes(), np.count_nonzero(~mask) <= _MOST_MISSING * mask.size
        if few and self._of_all is None:
            self._of_all = self._ranking_by(np.ones_like(mask))
        if self._kept is None or self._kept[0] != key:
            whole = self._of_all if few else None
            found = self._ranking_by(mask) if whole is None else whole if mask.all() else whole.without(~mask)
            self._kept = key, found
        return self._kept[1]

    def _ranking_by(self, mask: BoolArray) -> _Ranking:
        of_mask = whitening(self.array, mask)
        model = WhitenedModel.of(self.array, of_mask, self.array.ambient_fields[None])
        candidates = model.homogeneous(self._candidates)
        return _Ranking(of_mask, candidates, linear_bases(model, model.gain[0], 0, candidates))

    def starts(self, rows: WhitenedRows, n_starts: int | None = None) -> FloatArray:
        """Return distinct candidates (b, n_starts, 4) that explain most of every row."""
        ranking = self._ranking(rows.mask)
        ranked = rows.y
        if self.array.noise_depends_on_reading or ranking.lost is not None:
            channels = channels_above_ambient(self.array, rows.mask, rows.readings_T, rows.model.ambient)
            ranked = ranking.whiten(channels)
        number = self.n_starts if n_starts is None else n_starts
        chosen = best_candidates(ranking.bases, ranked, ranking.candidates, number, self.apart_rad, ranking.orthonormal)
        best: FloatArray = ranking.candidates[chosen]
        return best

    def refine_starts(
        self, rows: WhitenedRows, reading_of_row: IntArray, starts: FloatArray, keep_within: float
    ) -> LocalOptima:
        """Return distinct optima from starts (n, k, 4), each for the reading of some row."""
        return search_optima(rows.model, rows.signals, reading_of_row, starts, None, keep_within, self.max_iterations)

    def _apply_prior(self, model: WhitenedModel, found: LocalOptima) -> LocalOptima:
        """Return the optima that agree with the prior, within Δχ² of the best of them."""
        chi2 = np.where(self.prior.allows(model, found.q, found.mu), found.chi2, np.inf)
        order = np.argsort(chi2, axis=1, kind="stable")
        chi2 = np.take_along_axis(chi2, order, axis=1)
        counts = found.counts.copy()
        counts[:, 0] = (np.isfinite(chi2) & (chi2 <= chi2[:, :1] + DISTINCT_WITHIN)).sum(axis=1)
        return LocalOptima(
            np.take_along_axis(found.q, order[..., None], axis=1),
            np.take_along_axis(found.mu, order[..., None], axis=1),
            chi2,
            np.take_along_axis(found.iterations, order, axis=1),
            counts,
        )


@lru_cache(maxsize=2)  # the bases of the candidates are large and take longer than a fix
def cached_search(array: SensorArray) -> SingleSourceSearch:
    """Return the cached search of a recent array without a prior, for rows that are fitted one by one."""
    return SingleSourceSearch(array)


def _why_unsolved(n_optima: int) -> str:
    if n_optima:
        return NOT_ALLOWED
    return "the search did not converge from any of its starts"
