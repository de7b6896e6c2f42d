"""One fix from one set of readings: where the dipole is, what its moment is, and how well both are known.

No start is needed. The moment is eliminated (:mod:`magloc.measurement.whitened`), a grid of positions is scored by how
much of the readings' energy they explain, the best distinct ones are refined by a damped Gauss-Newton iteration that
only accepts steps which decrease χ², and every distinct optimum near the best one is returned with its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.noise import reading_covariance
from arrays.typing import FloatArray
from arrays.whitening import Whitening, whitening, whitenings
from magloc.compilation import over_rows
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN, SILENT, Fix, Solution
from magloc.localization.search import single_source_compiled as kernels
from magloc.localization.search.candidates import candidate_positions
from magloc.localization.uncertainty import covariance_compiled, range_profile_compiled
from magloc.localization.uncertainty.ambiguity import Rivals
from magloc.localization.uncertainty.covariance import covariance_is_valid
from magloc.localization.uncertainty.range_interval import is_detected
from magloc.measurement import whitened_compiled
from magloc.measurement.rows import NO_SIGNAL, ambient_fields, checked_rows, rows_of_equal_mask
from magloc.measurement.whitened import SeparableProblem, WhitenedModel

N_UNKNOWNS = 6
_ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class BestFits:
    """The best optima found from many starts, without their uncertainty.

    Attributes
    ----------
    position_m, moment_Am2 : ndarray, shape (n, 3)
        NaN where no start converged.
    chi2 : ndarray, shape (n,)
    linearisations : ndarray of int, shape (n,)
        Of all refinements together.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    chi2: FloatArray
    linearisations: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Optima:
    """Outputs of the compiled search, (rows, starts, ...), and the arguments of its model."""

    model: tuple[NDArray[Any], ...]
    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    counts: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Kernel:
    """A whitening in the layout of the compiled search, with the bases of all candidates."""

    whitening: Whitening
    problem: SeparableProblem
    bases: NDArray[np.float32]


class Locator:
    """Start-free fixes with one array of vector sensors.

    Parameters
    ----------
    array : SensorArray
        Vector sensors only.
    n_starts : int
        Distinct candidates that are refined.
    apart_rad : float
        Least distance of two candidates, as an angle of their homogeneous coordinates.
    max_iterations : int
        Linearisations of one refinement at most; a refinement that needs more did not converge.
    knowledge : SourcePrior
        Bounds of the source's position and moment.

    Raises
    ------
    ValueError
        The array has scalar sensors, or the known region is out of its reach.
    """

    def __init__(
        self,
        array: SensorArray,
        *,
        n_starts: int = 6,
        apart_rad: float = 0.3,
        max_iterations: int = 100,
        knowledge: SourcePrior = NOTHING_KNOWN,
    ) -> None:
        if array.channel_is_scalar.any():
            raise ValueError("Input array must have vector sensors only; instead received one with scalar sensors.")
        _check_magnitudes(array)
        self.array = array
        self.n_starts = n_starts
        self.apart_rad = apart_rad
        self.max_iterations = max_iterations
        self.knowledge = knowledge
        candidates = candidate_positions(array)
        self._candidates = candidates[knowledge.allows_position(candidates)]
        if not len(self._candidates):
            raise ValueError(
                "Input knowledge must leave some of the space around the array; instead it leaves nothing."
            )
        self._of_mask: dict[bytes, _Kernel] = {}
        self._without_source = array.readings_of(array.ambient_fields)

    def fit(self, readings_T: ArrayLike) -> Fix:
        """Fix from one set of readings.

        Parameters
        ----------
        readings_T : array_like, shape (C,)
            Raw readings in channel order [T]; NaN where missing.

        Returns
        -------
        Fix
        """
        return self.fit_rows(np.asarray(readings_T, dtype=np.float64)[None])[0]

    def fit_rows(
        self,
        readings_T: ArrayLike,
        ambient_T: ArrayLike | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> list[Fix]:
        """Fixes of many sets of readings, each on its own.

        Parameters
        ----------
        readings_T : array_like, shape (n, C)
            Raw readings in channel order [T]; NaN where missing.
        ambient_T : array_like, shape (n, 3), optional
            Ambient field of every row in the array's frame [T], in place of the array's own. It only matters with a
            prior of the common field.
        progress : callable, optional
            Called with the number of rows finished since the last call.

        Returns
        -------
        list of Fix
            In the order of the rows.
        """
        readings = checked_rows(self.array, readings_T)
        without_source = np.broadcast_to(self._without_source, readings.shape)
        if ambient_T is not None:
            ambient = np.asarray(ambient_T, dtype=np.float64)
            without_source = self.array.readings_of(ambient_fields(self.array, len(readings), ambient))
        fixes: list[Fix] = [Fix(())] * len(readings)
        for mask, rows in rows_of_equal_mask(np.isfinite(readings)):
            kernel = self._kernel(mask)
            k = kernel.whitening.n_differences
            for start in range(0, rows.size, _ROWS_AT_ONCE):
                block = rows[start : start + _ROWS_AT_ONCE]
                if k < N_UNKNOWNS:
                    reason = f"{int(mask.sum())} readings give {k} independent differences, {N_UNKNOWNS} are needed"
                    found = [Fix((), reason, detected=False)] * block.size
                else:
                    found = self._fit_block(kernel, mask, readings[block], without_source[block])
                for row, fix in zip(block, found, strict=True):
                    fixes[row] = fix
                if progress is not None:
                    progress(block.size)
        return fixes

    def _kernel(self, mask: NDArray[np.bool_]) -> _Kernel:
        key = mask.tobytes()
        if key not in self._of_mask:
            self._of_mask.clear()  # bases are large, and rows come sorted by their mask
            white = whitening(self.array, mask)
            problem = SeparableProblem.of(self.array, white)
            candidates = problem.homogeneous(self._candidates)
            bases = np.empty((len(candidates), 3, self.array.n_channels))
            over_rows(
                whitened_compiled.candidate_bases,
                len(candidates),
                candidates,
                problem.sensors,
                problem.channel_sensor,
                problem.gain,
                np.ascontiguousarray(white.basis.T),
                white.shrinkage,
                bases,
            )
            single = bases.transpose(2, 1, 0).astype(np.float32, order="C").reshape(self.array.n_channels, -1)
            self._of_mask[key] = _Kernel(white, problem, single)
        return self._of_mask[key]

    def fit_from(self, readings_T: ArrayLike, starts_m: ArrayLike) -> BestFits:
        """Best optimum that the search finds when a start is refined before the best candidates, for many starts.

        Parameters
        ----------
        readings_T : array_like, shape (C,)
            Raw readings in channel order [T]; NaN where missing.
        starts_m : array_like, shape (n, 3)
            Positions in the array's frame [m].

        Returns
        -------
        BestFits
            Of every start; `knowledge` is not used.
        """
        readings = np.asarray(readings_T, dtype=np.float64)[None]
        starts = np.asarray(starts_m, dtype=np.float64)
        mask = np.isfinite(readings[0])
        kernel = self._kernel(mask)
        y, ranked, of_rows = self._whitened(kernel, mask, readings, self._without_source)
        n = len(starts)
        found = self._search(
            kernel,
            y,
            ranked,
            np.zeros(n, dtype=np.intp),
            of_rows,
            np.zeros(n, dtype=np.intp),
            kernel.problem.homogeneous(starts)[:, None],
            DISTINCT_WITHIN,
        )
        return BestFits(
            position_m=kernel.problem.position(found.q[:, 0]),
            moment_Am2=kernel.problem.moment(found.q[:, 0], found.mu[:, 0]),
            chi2=found.chi2[:, 0],
            linearisations=found.counts[:, 2],
        )

    def _whitened(
        self, kernel: _Kernel, mask: NDArray[np.bool_], readings: FloatArray, without_source: FloatArray
    ) -> tuple[FloatArray, FloatArray, list[Whitening]]:
        """Whitened readings, the same as the candidates are ranked by, and the whitenings: one, or one a row."""
        channels = np.where(mask, readings - without_source, 0.0)
        ranked = kernel.whitening.apply(channels)
        if not self.array.noise_depends_on_reading:
            return ranked, ranked, [kernel.whitening]
        of_rows = whitenings(self.array, mask, reading_covariance(self.array, readings))
        y = np.stack([w.apply(row) for w, row in zip(of_rows, channels, strict=True)])
        return y, ranked, of_rows

    def _search(
        self,
        kernel: _Kernel,
        y: FloatArray,
        ranked: FloatArray,
        reading_of_row: NDArray[np.intp],
        of_rows: list[Whitening],
        set_of_row: NDArray[np.intp],
        first: FloatArray,
        keep_within: float,
    ) -> _Optima:
        problem = kernel.problem
        shape = (len(reading_of_row), self.n_starts + first.shape[1])
        found = _Optima(
            model=(
                problem.sensors,
                problem.channel_sensor,
                np.stack([w.root @ self.array.channel_gain for w in of_rows]),
                np.ascontiguousarray(np.stack([w.basis.T for w in of_rows])),
                np.stack([w.shrinkage for w in of_rows]),
                set_of_row,
            ),
            q=np.full((*shape, 4), np.nan),
            mu=np.full((*shape, 3), np.nan),
            chi2=np.full(shape, np.nan),
            iterations=np.zeros(shape, dtype=np.int64),
            counts=np.zeros((shape[0], 3), dtype=np.int64),
        )
        over_rows(
            kernels.search_rows,
            shape[0],
            y,
            ranked,
            reading_of_row,
            kernel.bases,
            problem.homogeneous(self._candidates),
            first,
            np.cos(self.apart_rad),
            keep_within,
            self.max_iterations,
            *found.model,
            found.q,
            found.mu,
            found.chi2,
            found.iterations,
            found.counts,
        )
        return found

    def _known(self, kernel: _Kernel, found: _Optima) -> _Optima:
        """Optima that agree with what is known, again those within Δχ² of the best of them."""
        position, moment = kernel.problem.position(found.q), kernel.problem.moment(found.q, found.mu)
        with np.errstate(invalid="ignore"):
            allowed = self.knowledge.allows_position(position) & self.knowledge.allows_moment(moment)
        chi2 = np.where(allowed, found.chi2, np.inf)
        order = np.argsort(chi2, axis=1, kind="stable")
        chi2 = np.take_along_axis(chi2, order, axis=1)
        counts = found.counts.copy()
        counts[:, 0] = (np.isfinite(chi2) & (chi2 <= chi2[:, :1] + DISTINCT_WITHIN)).sum(axis=1)
        return _Optima(
            found.model,
            np.take_along_axis(found.q, order[..., None], axis=1),
            np.take_along_axis(found.mu, order[..., None], axis=1),
            chi2,
            np.take_along_axis(found.iterations, order, axis=1),
            counts,
        )

    def _fit_block(
        self, kernel: _Kernel, mask: NDArray[np.bool_], readings: FloatArray, without_source: FloatArray
    ) -> list[Fix]:
        problem, n_rows = kernel.problem, len(readings)
        y, ranked, of_rows = self._whitened(kernel, mask, readings, without_source)
        every = np.arange(n_rows, dtype=np.intp)
        found = self._search(
            kernel,
            y,
            ranked,
            every,
            of_rows,
            every if len(of_rows) > 1 else np.zeros(n_rows, dtype=np.intp),
            np.empty((n_rows, 0, 4)),
            DISTINCT_WITHIN if self.knowledge == NOTHING_KNOWN else math.inf,
        )
        unknown = found.counts[:, 0]
        if self.knowledge != NOTHING_KNOWN:
            found = self._known(kernel, found)
        q, mu, chi2, counts = found.q, found.mu, found.chi2, found.counts
        kept, failed, _ = counts.T
        n_differences = kernel.whitening.n_differences
        energy = np.einsum("ic,ic->i", y, y)
        scaled, alpha = np.full((*chi2.shape, 6, 6), np.nan), np.full((*chi2.shape, 2), np.nan)
        over_rows(covariance_compiled.covariance_rows, n_rows, *found.model, q, mu, counts, scaled)
        position, moment = problem.position(q), problem.moment(q, mu)
        unit = np.repeat([problem.radius, problem.radius**3 / MU0_OVER_4PI], 3)
        covariance = scaled * np.outer(unit, unit)
        rivals = Rivals.of(chi2, covariance, position - problem.centroid, moment, energy, n_differences)
        over_rows(
            range_profile_compiled.profile_rows, n_rows, y, rivals.rise, *found.model, q, chi2, counts, scaled, alpha
        )
        ranges = rivals.ranges(alpha, problem.radius)
        determined, silent = np.isfinite(rivals.chi2), energy < SILENT * n_differences
        chi2_, iterations_, dof = chi2.tolist(), found.iterations.tolist(), n_differences - N_UNKNOWNS
        gaussian, claimed = ranges.gaussian.copy(), np.nonzero(ranges.gaussian)
        if claimed[0].size:
            without_ambient = np.zeros((len(of_rows), self.array.n_sensors, 3))
            same = WhitenedModel.of(self.array, of_rows, without_ambient).rows(found.model[-1][claimed[0]])
            gaussian[claimed] = covariance_is_valid(
                same,
                y[claimed[0]],
                position[claimed][:, None],
                moment[claimed][:, None],
                chi2[claimed],
                dof,
                covariance[claimed],
            )
        weight_, gaussian_, observable_ = rivals.weight.tolist(), gaussian.tolist(), ranges.observable.tolist()
        detected_ = is_detected(energy, n_differences).tolist()
        fixes = []
        for i, n in enumerate(kept.tolist()):
            if silent[i]:
                fixes.append(Fix((), NO_SIGNAL, detected=False))
                continue
            solutions = tuple(
                Solution(
                    position_m=position[i, j],
                    moment_Am2=moment[i, j],
                    covariance=ranges.covariance[i, j],
                    chi2=chi2_[i][j],
                    dof=dof,
                    iterations=iterations_[i][j],
                    converged=True,
                    range_observable=observable_[i],
                    range_interval95_m=ranges.sets[i],
                    weight=weight_[i][j],
                    gaussian=gaussian_[i][j],
                )
                for j in range(n)
                if determined[i, j]
            )
            reason = "" if solutions else _why_unsolved(int(unknown[i]), n)
            fixes.append(Fix(solutions, reason, int(failed[i]), detected=detected_[i]))
        return fixes


def _check_magnitudes(array: SensorArray) -> None:
    """Refuse what double precision cannot square."""
    noise = array.channel_noise_T
    if noise.min() < 1e-20 or noise.max() > 1e3:
        raise ValueError(
            f"Input array must have a noise between 1e-11 and 1e12 nT; instead received {1e9 * noise.min():g} nT"
            f" to {1e9 * noise.max():g} nT."
        )
    if np.abs(array.positions).max() > 1e9 or array.circumradius < 1e-9:
        raise ValueError(
            "Input array must span 1e-9 m at least and lie within 1e9 m of its origin; instead it does not."
        )
    if array.common_field_T is not None and array.common_field_T > 1e3:
        common_nT = 1e9 * array.common_field_T
        raise ValueError(f"Input array must have a common field of 1e12 nT at most; instead received {common_nT:g} nT.")
    if not np.abs(array.ambient_fields).max() <= 1e3:
        raise ValueError("Input array must have an ambient field of 1e12 nT at most; instead received a larger one.")
    if array.noise_fraction > 10.0:
        raise ValueError(f"Input array must have a noise_fraction of 10 at most; instead: {array.noise_fraction:g}.")


def _why_unsolved(n_optima: int, n_allowed: int) -> str:
    if n_allowed:
        return "the differences between the sensors do not determine the source: no signal, or a degenerate array"
    if n_optima:
        return "no solution lies within the known region and largest moment"
    return "the search did not converge from any of its starts"
