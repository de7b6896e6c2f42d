"""Optima of the likelihood, the common result of all searches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.localization.fit.gauss_newton import JointFits
from magloc.measurement.rows import WhitenedRows

UNDETERMINED = "the differences between the sensors do not determine the source: no signal, or a degenerate array"


@dataclass(frozen=True, eq=False)
class Optima:
    """Optima of b rows: f fits of K sources, sorted by row and then by χ².

    Attributes
    ----------
    of_row : ndarray of int, shape (f,)
        Index of a fit's row among the b rows.
    reason : list of str
        Reason why each row has no optimum, or fewer sources than requested; empty otherwise.
    merged : ndarray of bool, shape (f, K)
        True if a source represents two that the array cannot separate.
    failed_starts : ndarray of int, shape (b,)
    position_m : ndarray, shape (b, K, 3), optional
        Known positions of the sources; the unknowns are then the moments alone.
    undetermined : str
        Reason for rows without a solution because their optima have no finite covariance.
    bent : ndarray of bool, shape (f,)
        True if errors are not Gaussian, because nonlinear effects exceed the noise.
    """

    rows: WhitenedRows
    fits: JointFits
    of_row: IntArray
    reason: list[str]
    merged: BoolArray | bool = False
    failed_starts: IntArray | int = 0
    position_m: FloatArray | None = None
    undetermined: str = UNDETERMINED
    bent: BoolArray | bool = False

    def select(self, which: BoolArray) -> Optima:
        """Return the optima of some of the rows (b,)."""
        kept = which[self.of_row]
        return replace(
            self,
            rows=self.rows.select(which),
            fits=self.fits.rows(kept),
            of_row=(np.cumsum(which) - 1)[self.of_row[kept]],
            reason=[reason for reason, chosen in zip(self.reason, which, strict=True) if chosen],
            merged=np.broadcast_to(self.merged, self.fits.mu.shape[:2])[kept],
            failed_starts=np.broadcast_to(self.failed_starts, which.shape)[which],
            bent=np.broadcast_to(self.bent, self.of_row.shape)[kept],
            position_m=None if self.position_m is None else self.position_m[which],
        )

    @property
    def dof(self) -> int:
        """Degrees of freedom of a fit."""
        return self.rows.n_differences - (3 if self.position_m is not None else 6) * self.fits.n_sources
