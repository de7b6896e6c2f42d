"""One dipole by any sensors, moduli included: fixes without a start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from arrays.sensor import SensorArray
from magloc.fix import NOTHING_KNOWN, Fix, JointFix, Knowledge, Solution
from magloc.several import SeveralLocator


class ExactLocator:
    """Start-free fixes of one dipole with vector sensors, scalar sensors or both.

    For vector sensors alone :class:`magloc.locate.Locator` gives the same, much faster.

    Parameters
    ----------
    array : SensorArray
        At least seven scalar sensors, or as many differences from sensors of both kinds.
    knowledge : Knowledge
        Bounds of the source's position and moment.

    Raises
    ------
    ValueError
        The array has fewer than six independent differences.
    """

    def __init__(self, array: SensorArray, *, knowledge: Knowledge = NOTHING_KNOWN) -> None:
        self.array = array
        self._several = SeveralLocator(array, n_sources=1, knowledge=knowledge)

    def fit(self, readings_T: ArrayLike, ambient_T: ArrayLike | None = None) -> Fix:
        """Fix from one set of readings (C,) [T], NaN where missing, and the ambient field (3,) [T]."""
        ambient = None if ambient_T is None else np.asarray(ambient_T, dtype=np.float64)[None]
        return self.fit_rows(np.asarray(readings_T, dtype=np.float64)[None], ambient)[0]

    def fit_rows(
        self,
        readings_T: ArrayLike,
        ambient_T: ArrayLike | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> list[Fix]:
        """Fixes of many sets of readings, as :meth:`magloc.several.SeveralLocator.fit_rows`.

        Returns
        -------
        list of Fix
            Every distinct solution of every row; for moduli without an ambient field those of opposite moments too.
        """
        return [_of_one(fix) for fix in self._several.fit_rows(readings_T, ambient_T, progress)]


def _of_one(fix: JointFix) -> Fix:
    solutions = tuple(
        Solution(
            position_m=solution.sources[0].position_m,
            moment_Am2=solution.sources[0].moment_Am2,
            covariance=solution.covariance,
            chi2=solution.chi2,
            dof=solution.dof,
            iterations=solution.iterations,
            converged=solution.converged,
            range_observable=solution.sources[0].range_observable,
            range_interval95_m=solution.sources[0].range_interval95_m,
            weight=solution.weight,
            gaussian=solution.sources[0].gaussian,
        )
        for solution in fix.solutions
    )
    return Fix(solutions, "" if solutions else fix.reason, detected=fix.detected)
