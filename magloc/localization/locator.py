"""Fixes of the rows of readings, whatever is asked for, and whether their source is near enough to matter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from arrays.array import SensorArray
from arrays.typing import FloatArray, Vector
from magloc.localization.fault_exclusion import robust_fixes
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import Fix, JointFix, Solution
from magloc.localization.search.known_position import MomentLocator
from magloc.localization.search.multi_source import SeveralLocator, in_stable_order
from magloc.localization.search.single_source import Locator
from magloc.readings import Readings

AnyFix = Fix | JointFix
_ROWS_AT_ONCE = 256
# Probability of a χ² under noise below which what is left is looked at.
_MISFIT = 1e-3


class RowFixes:
    """The fixes of all rows, whatever is asked for."""

    def __init__(
        self,
        array: SensorArray,
        rows: Readings,
        ambient_T: FloatArray | None,
        knowledge: SourcePrior,
        n_sources: int | Literal["auto"] | None,
        position: Vector | None,
        keep_sensors: bool,
        seed: int,
    ) -> None:
        self.array, self.rows, self.ambient_T, self.keep_sensors = array, rows, ambient_T, keep_sensors
        self.position_known = position is not None
        self.at_once = _ROWS_AT_ONCE
        self.fit_rows: list[Callable[..., list[Any]]]
        if position is not None:
            places = _in_array_frame(position, rows)
            if len(places) > 1:
                # The known place moves in the frame of an array that moves.
                self.at_once = 1
            self.fit_rows = [MomentLocator(array, place, knowledge=knowledge).fit_rows for place in places]
            return
        if n_sources is not None:
            number = None if n_sources == "auto" else n_sources
            self.fit_rows = [SeveralLocator(array, n_sources=number, knowledge=knowledge, seed=seed).fit_rows]
        elif array.channel_is_scalar.any():
            self.fit_rows = [ExactLocator(array, knowledge=knowledge).fit_rows]
        else:
            self.fit_rows = [Locator(array, knowledge=knowledge).fit_rows]

    def fixes(self, advance: Callable[[int], None]) -> list[AnyFix]:
        """Fixes of all rows, without the sensors that contradict all others."""
        fixes: list[Any] = []
        for begin in range(0, len(self.rows), self.at_once):
            fit = self.fit_rows[min(begin, len(self.fit_rows) - 1)]
            readings = self.rows.values_T[begin : begin + self.at_once]
            ambient = None if self.ambient_T is None else self.ambient_T[begin : begin + self.at_once]
            if self.keep_sensors:
                fixes += fit(readings, ambient)
            else:
                fixes += robust_fixes(self.array, fit, readings, ambient, free_position=not self.position_known)
            advance(len(readings))
        if any(isinstance(fix, JointFix) for fix in fixes):
            fixes = list(in_stable_order(fixes))
        return fixes

    def too_near(self, fixes: Sequence[AnyFix], body_length_m: float | None) -> list[bool]:
        """Whether the source of each row is too near for a dipole: by its length, or by the pattern of what is left."""
        from magloc.localization.dipole_validity import (
            dipole_validity,
            nearness_test,
        )  # trimesh takes a while to import

        near = []
        for i, fix in enumerate(fixes):
            if not isinstance(fix, Fix) or not fix.solutions:
                near.append(False)
                continue
            best = fix.solutions[0]
            found = False
            if body_length_m is not None:
                nearest = np.linalg.norm(self.array.positions - best.position_m, axis=1).min()
                found = not dipole_validity(nearest, body_length_m)
            if not found and best.dof > 0 and chdtrc(best.dof, best.chi2) < _MISFIT:
                readings = self.rows.values_T[i].copy()
                left_out = [self.array.ids[sensor] in fix.dropped for sensor in self.array.channel_sensor]
                readings[left_out] = np.nan
                array = self.array
                if self.ambient_T is not None:
                    array = replace(array, ambient_T=tuple(self.ambient_T[i].tolist()))
                test = nearness_test(array, best.position_m, best.moment_Am2, readings)
                found = test.extended
            near.append(found)
        return near


def _in_array_frame(position: Vector, readings: Readings) -> FloatArray:
    """A place in the frame of the results in that of the array: one for all rows (1, 3), or one for each (n, 3)."""
    if readings.array_position_m is None or readings.array_rotation_xyzw is None:
        return np.array([position])
    array_from_world = Rotation.from_quat(readings.array_rotation_xyzw).inv()
    place: FloatArray = array_from_world.apply(np.array(position) - readings.array_position_m)
    return place


class ExactLocator:
    """Start-free fixes of one dipole with vector sensors, scalar sensors or both.

    For vector sensors alone :class:`magloc.localization.search.single_source.Locator` gives the same, much faster.

    Parameters
    ----------
    array : SensorArray
        At least seven scalar sensors, or as many differences from sensors of both kinds.
    knowledge : SourcePrior
        Bounds of the source's position and moment.

    Raises
    ------
    ValueError
        The array has fewer than six independent differences.
    """

    def __init__(self, array: SensorArray, *, knowledge: SourcePrior = NOTHING_KNOWN) -> None:
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
        """Fixes of many sets of readings, as :meth:`magloc.localization.search.multi_source.SeveralLocator.fit_rows`.

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
