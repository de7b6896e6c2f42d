"""Detection statistics of readings: energy, known position, and the matched filter.

The matched filter is the generalised likelihood ratio: the largest energy that a dipole at any position explains, with
the best moment. Signals are linear in the moment. For moduli this holds if the ambient field is large compared with the
field of the source, so moduli need an ambient field. Distributions: docs/theory/detection.md.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from arrays.whitening import Whitening, whitening
from magloc.chi_square import check_differences
from magloc.fields import dipole
from magloc.localization.search.candidates import (
    SingleArray,
    best_candidates,
    candidate_positions,
    linear_bases,
    linear_scores,
)
from magloc.localization.search.kernels import search_optima
from magloc.measurement.channels import signals_of
from magloc.measurement.whitened import WhitenedModel

# Number of refinements, least angle between their starts, and most linearisations, as in the search of Locator.
_N_STARTS, _APART_RAD, _MOST_ITERATIONS = 12, 0.25, 100
_ROWS_AT_ONCE = 512


class DipoleFilter:
    """Detection statistics of one array's readings.

    Parameters
    ----------
    array : SensorArray
        Array with its noise, and with an ambient field for scalar sensors. `noise_fraction` does not count, because
        the noise is that without a source.

    Raises
    ------
    ValueError
        The array gives fewer than three differences, or has scalar sensors without an ambient field.
    """

    def __init__(self, array: SensorArray) -> None:
        self.array = array
        self.whitening: Whitening = whitening(array)
        check_differences(self.whitening.n_differences, 3, "the three components of a moment")
        self._problem = WhitenedModel.of(array, self.whitening, array.ambient_fields[None])
        self._gain: FloatArray = self._problem.linear_gain(np.zeros((1, array.n_sensors, 3)))[0]
        if not np.any(self._gain[array.channel_is_scalar]) and array.channel_is_scalar.any():
            raise ValueError("Input array must have an ambient field for its scalar sensors; instead it has none.")
        self._without_source: FloatArray = array.readings_of(array.ambient_fields)

    @property
    def n_differences(self) -> int:
        """Number of independent differences."""
        return self.whitening.n_differences

    @cached_property
    def _candidates(self) -> FloatArray:
        return self._problem.homogeneous(candidate_positions(self.array))

    @cached_property
    def _bases(self) -> SingleArray:
        return linear_bases(self._problem, self._gain, 0, self._candidates)

    def whitened(self, readings_T: ArrayLike) -> FloatArray:
        """Return an orthogonal transform of the whitened differences of raw readings (n, C) [T], none missing."""
        readings = np.asarray(readings_T, dtype=np.float64)
        if readings.ndim != 2 or readings.shape[1] != self.array.n_channels or not np.isfinite(readings).all():
            raise ValueError(
                f"Input readings_T must be finite numbers of shape (n, {self.array.n_channels}); instead received shape"
                f" {readings.shape}, of which {int(np.isfinite(readings).sum())} numbers are finite."
            )
        return self.whitening.apply(readings - self._without_source)

    def noise(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw the whitened noise of n sets of readings, shape (n, C)."""
        w = self.whitening
        unknown = w.basis[:, w.shrinkage == 1.0]
        draws = rng.normal(size=(n, self.array.n_channels))
        return draws - draws @ unknown @ unknown.T

    def signal(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
        """Return the whitened signals (..., C) of sources (..., 3), without noise."""
        return np.einsum("...cj,...j->...c", self.unit_signals(position_m), np.asarray(moment_Am2))

    def unit_signals(self, position_m: ArrayLike) -> FloatArray:
        """Return the whitened signals (..., C, 3) [1/(A·m²)] of the three unit moments at positions (..., 3) [m].

        For signals S the eigenvalues of SᵀS are the energies of the best, the middle and the worst moment of 1 A·m².
        """
        position = np.asarray(position_m, dtype=np.float64)[..., None, :]
        fields = dipole.field_matrix(self.array.positions, position)[..., self.array.channel_sensor, :, :]
        rows = np.einsum("cj,...cjk->...ck", self._gain, fields)
        w = self.whitening
        return rows - (w.basis * w.shrinkage) @ (w.basis.T @ rows)

    def energy(self, whitened: FloatArray) -> FloatArray:
        """Return the energy (n,) of whitened readings (n, C); it follows χ² without a source."""
        return np.einsum("nc,nc->n", whitened, whitened)

    def candidate_energy(self, whitened: FloatArray) -> FloatArray:
        """Return the energy (n,) of whitened readings (n, C) that the best candidate position explains.

        It is slightly below :meth:`largest_energy`, which refines the candidates, and a hundred times faster.
        """
        parts = np.array_split(whitened, -(-len(whitened) // _ROWS_AT_ONCE) or 1)
        return np.concatenate([linear_scores(self._bases, part).max(axis=1) for part in parts])

    def largest_energy(self, whitened: FloatArray) -> FloatArray:
        """Return the largest energy (n,) of whitened readings (n, C) that a single source explains.

        This matched-filter statistic is the generalised likelihood ratio: χ² without a source minus χ² of the best
        source at any position.
        """
        # If no refinement converged, the best candidate counts.
        return np.maximum(self.refined_energy(whitened), self.candidate_energy(whitened))

    def refined_energy(self, whitened: FloatArray) -> FloatArray:
        """Return the largest energy (n,) of refined candidates alone; minus infinity if none converged."""
        n = len(whitened)
        # The filter treats all channels as linear.
        problem = replace(
            self._problem.rows(np.zeros(n, dtype=np.intp)),
            gain=np.broadcast_to(self._gain, (n, *self._gain.shape)),
            channel_is_scalar=np.zeros_like(self.array.channel_is_scalar),
        )
        chosen = best_candidates(self._bases, whitened, self._candidates, _N_STARTS, _APART_RAD)
        signals, starts = signals_of(problem, whitened), self._candidates[chosen]
        found = search_optima(problem, signals, np.arange(n), starts, None, np.inf, _MOST_ITERATIONS)
        return self.energy(whitened) - np.where(found.counts[:, 0] > 0, found.chi2[:, 0], np.inf)
