"""Locator of sources: the sequence of steps that make a fix.

Detection → search → uncertainty → exclusion of faulty sensors → validity of the dipole → result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.values import accept_seed, numbers, seed_of
from arrays.typing import FloatArray, IntArray, Rng
from magloc.ambient import in_world_field
from magloc.averages import average as averaged
from magloc.averages import averaging_array, complete_rows
from magloc.conditioning import NO_BACKGROUND
from magloc.fields.multipole import check_body_length
from magloc.fields.shapes import Shape
from magloc.localization.body_errors import body_covariances
from magloc.localization.dipole_validity import is_too_near
from magloc.localization.fault_exclusion import exclude_faulty_sensors
from magloc.localization.fit.columns import Solutions, in_stable_order
from magloc.localization.fit.fixes import Fixes
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import Fix
from magloc.localization.magnet_fit import fit_magnet
from magloc.localization.model_errors import with_model_errors
from magloc.localization.search.known_position import MomentSearch, places_in_array
from magloc.localization.search.moving_array import optima_at_rest, stacked_errors, stacked_rows
from magloc.localization.search.multi_source import NOISE_ALONE, MultiSourceSearch
from magloc.localization.search.single_source import N_UNKNOWNS, SingleSourceSearch, cached_search
from magloc.localization.uncertainty.covariance import solutions_of
from magloc.localization.uncertainty.pose_covariance import pose_covariances
from magloc.localization.uncertainty.range_interval import is_detected
from magloc.measurement.magnet import array_near
from magloc.measurement.nuisances import ambient_in_array, with_eddies_as_offsets
from magloc.measurement.plausibility import warn_of_doubts, warn_of_moments
from magloc.measurement.pose import PosesOfRows, rates_of, with_attitude_as_field_error, with_stated_pose
from magloc.measurement.rows import NO_SIGNAL, WhitenedRows, check_rows, whitened_rows
from magloc.readings import Readings, as_readings, without_saturated

_LOG = logging.getLogger(__name__)
# Rows per block; a search for several sources, or with known moments, has smaller blocks.
_ROWS_AT_ONCE, _ROWS_OF_SEVERAL = 1024, 64
# Largest size of the whitenings of a block if each row has its own.
_MOST_NUMBERS = 8_000_000


class Locator:
    """Locator of sources by one array of any sensors, without a start value.

    Parameters
    ----------
    array : SensorArray
        Array of vector sensors, scalar sensors or both, with at least six differences.
    sources : int or "auto"
        Number of sources in every row. "auto" finds as many as the readings support, at most five.
    position_m : array_like, shape (3,), (n, 3) or (n, K, 3), optional
        Known position of the source in the array's frame [m], for all rows or for each row; only its moment is fitted.
        With several sources, n is 1 for all rows.
    prior : SourcePrior
        Bounds of position and moment for every source; solutions outside of them are rejected.
    body_length_m : float, optional
        Length of the object. The deviation of its field from a dipole counts as noise, and fixes nearer than three
        lengths are flagged `too_near`. By default the length is a quarter of the distance if four sensors are nearer
        than 0.6 of the array's circumradius. 0 for a point.
    magnet : Shape, optional
        Shape of the source, a magnet that is magnetised along its axis; its field is then exact at any distance. A
        cuboid has equal edges across its last one, along which it is magnetised.
    exclude_faulty : bool
        Exclude sensors that contradict all others, and name them.
    rng : int or numpy.random.Generator
        Seed or generator of random restarts and of the draws for the threshold of another source.

    Raises
    ------
    ValueError
        The array cannot separate that many sources, the prior leaves no source, or the position is not valid.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> locator = magloc.Locator(board.array)
    >>> locator.fit(board.readings.values_T[0]).best.position_m.round(3)
    array([-0.06, -0.05,  0.12])
    """

    @accept_seed
    def __init__(
        self,
        array: SensorArray,
        *,
        sources: int | Literal["auto"] = 1,
        position_m: ArrayLike | None = None,
        prior: SourcePrior = NOTHING_KNOWN,
        body_length_m: float | None = None,
        magnet: Shape | None = None,
        exclude_faulty: bool = True,
        rng: Rng = 0,
    ) -> None:
        check_body_length(body_length_m or 0.0)
        if position_m is not None and sources != 1:
            raise ValueError(f"Input sources must be 1 where position_m is known; instead received {sources}.")
        if magnet is not None:
            magnet.check_aligned()
            if sources == "auto" or (sources != 1 and magnet.kind == "cuboid"):
                raise ValueError(
                    f"Input sources must be 1, or with magnets that do not roll a number; instead received {sources}."
                )
            if position_m is not None or body_length_m is not None:
                raise ValueError(
                    "Input magnet must come without position_m and body_length_m; instead they came together."
                )
            body_length_m = 0.0
        self.array = array
        self.body_length_m, self.magnet, self._prior = body_length_m, magnet, prior
        self.exclude_faulty = exclude_faulty
        self._at_once = min(_ROWS_AT_ONCE, max(_ROWS_OF_SEVERAL, _MOST_NUMBERS // array.n_channels**2))
        free = sources == 1 and position_m is None and prior.known_moment_Am2 is None
        self._searched_at_once = self._at_once if free else _ROWS_OF_SEVERAL
        self._search: SingleSourceSearch | MultiSourceSearch | MomentSearch
        if position_m is not None:
            self._search = MomentSearch(array, position_m, prior=prior)
            self._fewest = 3 * self._search.position_m.shape[1]
        elif free and not array.channel_is_scalar.any():
            alike = prior == NOTHING_KNOWN
            self._search, self._fewest = cached_search(array) if alike else SingleSourceSearch(array, prior=prior), 6
        else:
            number = None if sources == "auto" else int(sources)
            self._search = MultiSourceSearch(array, n_sources=number, prior=prior, seed=seed_of(rng))
            self._fewest = 6 * (number or 1)

    def fit(self, readings_T: ArrayLike, ambient_T: ArrayLike | None = None) -> Fix:
        """Return the fix of one set of readings (C,) [T], NaN where missing, in an ambient field (3,) [T]."""
        ambient = None if ambient_T is None else np.asarray(ambient_T, dtype=np.float64)[None]
        return self.fit_rows(numbers(readings_T)[None], ambient)[0]

    def fit_rows(
        self,
        readings_T: ArrayLike,
        ambient_T: ArrayLike | None = None,
        *,
        time_s: FloatArray | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> Fixes:
        """Return the fixes of many sets of readings, each independent of the others.

        Parameters
        ----------
        readings_T : array_like, shape (n, C)
            Raw readings in channel order [T]; NaN where missing.
        ambient_T : array_like, shape (n, 3), optional
            Ambient field of every row in the array's frame [T], instead of the array's own.
        time_s : ndarray, shape (n,), optional
            Times of the rows [s]; 0, 1, 2 … by default.
        progress : callable, optional
            Called with the number of rows finished since the last call.

        Returns
        -------
        Fixes
            Fixes in the order of the rows, in the array's frame. Several sources keep their number from row to row if
            they can be followed. In the first row the strongest comes first.
        """
        readings = check_rows(self.array, readings_T)
        ambient = None if ambient_T is None else np.asarray(ambient_T, dtype=np.float64)
        times = np.arange(len(readings), dtype=np.float64) if time_s is None else time_s
        parts = []
        for begin in range(0, len(readings), self._at_once):
            some = slice(begin, begin + self._at_once)
            index = np.arange(len(readings))[some]
            parts.append(self._fit_without_faults(index, readings[some], None if ambient is None else ambient[some]))
            if progress is not None:
                progress(len(index))
        fixes = Fixes.joined(parts)
        if fixes.solutions.position_m.shape[1] > 1 and not isinstance(self._search, MomentSearch):
            fixes = replace(fixes, solutions=in_stable_order(fixes.solutions))
        near, bodies = np.zeros(len(fixes), dtype=bool), None
        if self.magnet is None:
            near = is_too_near(self.array, fixes, readings, ambient, self.body_length_m)
        if self.body_length_m is None:
            known_place = isinstance(self._search, MomentSearch)
            bodies = partial(body_covariances, self.array, fixes, readings, ambient, known_place=known_place)
        return replace(fixes, time_s=times, too_near=near, bodies=bodies)

    def _fit_without_faults(self, index: IntArray, readings: FloatArray, ambient: FloatArray | None) -> Fixes:
        """Return fixes of some rows without the sensors that contradict all others."""

        def refit(rows: IntArray, other: FloatArray) -> Fixes:
            return self._fit_with_all_sensors(index[rows], other, None if ambient is None else ambient[rows])

        fixes = self._fit_with_all_sensors(index, readings, ambient)
        if not self.exclude_faulty:
            return fixes
        free = not isinstance(self._search, MomentSearch)
        near = array_near(self.array, self.magnet)
        return exclude_faulty_sensors(near, fixes, refit, readings, ambient, free_position=free)

    def _fit_with_all_sensors(self, index: IntArray, readings: FloatArray, ambient: FloatArray | None) -> Fixes:
        """Return fixes of some rows with all sensors, by detection, search and uncertainty."""
        search = self._search
        if isinstance(search, MomentSearch):
            search = search.select(index)
        found = _FixCollector(len(readings), self.body_length_m, self.array.row_ambient_uncertainty_T)
        for rows in whitened_rows(self.array, readings, ambient, self._searched_at_once):
            if rows.n_differences < self._fewest:
                found.refuse(
                    rows.index,
                    f"{int(rows.mask.sum())} readings give {rows.n_differences} independent differences,"
                    f" {self._fewest} are needed",
                )
            else:
                found.fill(rows, search.optima if self.magnet is None else partial(self._magnets, search.optima))
        return found.fixes()

    def _magnets(self, search: Callable[[WhitenedRows], list[Optima]], rows: WhitenedRows) -> list[Optima]:
        assert self.magnet is not None
        return [fit_magnet(optima, self.magnet, self._prior) for optima in search(rows)]


class _FixCollector:
    """Collect the results of n rows, block by block."""

    def __init__(self, n: int, body_length_m: float | None = 0.0, ambient_sigma_T: float = 0.0) -> None:
        self.body_length_m, self.ambient_sigma_T = body_length_m, ambient_sigma_T
        self.assumed_length_m = np.zeros(n)
        self.detected = np.zeros(n, dtype=bool)
        self.reason = [""] * n
        self.failed_starts = np.zeros(n, dtype=np.intp)
        self.parts: list[Solutions] = []

    def refuse(self, rows: IntArray, reason: str) -> None:
        """Record the reason why some rows have no solution."""
        for row in rows.tolist():
            self.reason[row] = reason

    def fill(self, rows: WhitenedRows, search: Callable[[WhitenedRows], list[Optima]]) -> None:
        """Detect, search and estimate uncertainty in a block of rows."""
        loud, silent = rows, rows.is_silent
        if np.count_nonzero(silent):
            self.refuse(rows.index[silent], NO_SIGNAL)
            loud = rows.select(~silent)
            if not len(loud):
                return
        self.detected[loud.index] = is_detected(loud.energy, loud.n_differences)
        pieces = [
            piece
            for optima in search(loud)
            for piece in with_model_errors(optima, self.body_length_m, self.ambient_sigma_T)
        ]
        for optima, lengths in pieces:
            of_all = optima.rows.index
            self.assumed_length_m[of_all] = lengths
            found = solutions_of(optima, self.detected[of_all])
            unsolved = np.ones(len(self.reason), dtype=bool)
            unsolved[found.of_row] = False
            self.refuse(of_all[unsolved[of_all]], optima.undetermined)
            if any(optima.reason):
                for row, reason in zip(of_all.tolist(), optima.reason, strict=True):
                    self.reason[row] = reason or self.reason[row]
                    if reason == NOISE_ALONE:
                        self.detected[row] = False
            self.failed_starts[of_all] = optima.failed_starts
            self.parts.append(found)

    def fixes(self) -> Fixes:
        """Return the fixes of all rows."""
        n = len(self.reason)
        solutions = Solutions.concatenate(self.parts)
        return Fixes(
            solutions,
            np.arange(n, dtype=np.float64),
            self.detected,
            self.reason,
            self.failed_starts,
            [()] * n,
            body_length_m=self.assumed_length_m,
        )


def fit_at_rest(
    array: SensorArray,
    readings_T: FloatArray,
    origins_m: FloatArray,
    R_world_from_array: FloatArray,
    ambient_T: FloatArray | None = None,
    *,
    prior: SourcePrior = NOTHING_KNOWN,
    poses: PosesOfRows | None = None,
) -> Fix:
    """Fit one source at rest to several rows of a moving array, in the world frame.

    A few scalar sensors do not locate a source in one row, but they do while they pass it. Every row has its own common
    field. Parameters: see :func:`magloc.localization.search.moving_array.stacked_rows`, and a prior in the
    world frame. Errors of `poses` count as noise.
    """
    rows = stacked_rows(array, readings_T, origins_m, R_world_from_array, ambient_T)
    found = _FixCollector(1)
    if rows.n_differences < N_UNKNOWNS:
        reason = f"{len(readings_T)} rows give {rows.n_differences} independent differences, {N_UNKNOWNS} are needed"
        found.refuse(rows.index, reason)
    elif not is_detected(rows.energy, rows.n_differences).all():
        found.refuse(rows.index, NOISE_ALONE)
    else:
        errors = None if poses is None else stacked_errors(poses, readings_T, ambient_T)
        found.fill(rows, lambda loud: [optima_at_rest(loud, prior, errors)])
    return found.fixes()[0]


@accept_seed
def locate(
    array: SensorArray,
    readings: Readings | ArrayLike,
    *,
    sources: int | Literal["auto"] = 1,
    position_m: ArrayLike | None = None,
    prior: SourcePrior = NOTHING_KNOWN,
    ambient_T: ArrayLike | None = None,
    body_length_m: float | None = None,
    magnet: Shape | None = None,
    exclude_faulty: bool = True,
    average: bool = False,
    rng: Rng = 0,
    progress: Callable[[int], None] | None = None,
) -> Fixes:
    """Find the sources in every row of readings, each row independent of the others.

    Parameters
    ----------
    array : SensorArray
        Array with the positions, noise and calibration of its sensors.
    readings : Readings or array_like, shape (n, C) or (C,)
        Raw readings [T], NaN where missing. Saturated readings are not used, and their channels are named.
    sources : int or "auto"
        Number of sources in every row. "auto" finds as many as the readings support, at most five.
    position_m : array_like, shape (3,) or (K, 3), optional
        Known position of the source, or of K sources [m], in the frame of the results; only moments are fitted.
    prior : SourcePrior
        Bounds of position and moment for every source; solutions outside of them are rejected.
    ambient_T : array_like, shape (n, 3) or (3,), optional
        Ambient field in the array's frame [T], instead of that of the readings or the array.
    body_length_m : float, optional
        Length of the object [m], 0 for a point; by default as for :class:`Locator`.
    magnet : Shape, optional
        Shape of the source, as for :class:`Locator`.
    exclude_faulty, average : bool
        Exclude sensors that contradict all others. Average all rows to one fix; array and source must stand still.
    rng : int or numpy.random.Generator
        Seed or generator of random restarts and of the draws for the threshold of another source.
    progress : callable, optional
        Called with the number of rows finished since the last call.

    Returns
    -------
    Fixes
        Fixes in the world frame if the readings have the array's pose, otherwise in the array's frame.

    Raises
    ------
    InputError
        The rows cannot be averaged.
    ValueError
        For the same reasons as :class:`Locator`.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fixes = magloc.locate(board.array, board.readings[:2])
    >>> fixes.position_m[0].round(2)
    array([-0.06, -0.05,  0.12])
    """
    measured = as_readings(readings)
    if ambient_T is not None:
        of_rows = np.broadcast_to(np.asarray(ambient_T, dtype=np.float64), (len(measured), 3))
        measured = replace(measured, ambient_T=of_rows)
    warn_of_doubts(array, measured)
    n_complete = int(complete_rows(without_saturated(measured, array)).sum()) if average else 0
    if 0 < n_complete < len(measured):
        _LOG.info(f"note: {n_complete} of {len(measured)} rows are averaged, the others miss some readings")
    rows, array, saturated = used_rows(measured, array, average=average)
    ambient = rows.ambient_T
    pose = rows.pose
    place = None if position_m is None else places_in_array(position_m, pose)
    stated = with_stated_pose(array, rows).pose
    array = _with_eddies(array, rows)
    locator = Locator(
        array if stated is None else with_attitude_as_field_error(array, stated, rows, ambient),
        sources=sources,
        position_m=place,
        prior=prior,
        body_length_m=body_length_m,
        magnet=magnet,
        exclude_faulty=exclude_faulty,
        rng=rng,
    )
    fixes = locator.fit_rows(rows.values_T, ambient, time_s=rows.time_s, progress=progress)
    fixes = replace(fixes, saturated_channels=saturated)
    best = fixes.best[fixes.solved & fixes.detected]
    distance_m = np.linalg.norm(fixes.solutions.position_m[best, 0] - array.centroid, axis=-1)
    warn_of_moments(distance_m, fixes.solutions.moment_Am2[best, 0])
    if pose is None:
        return fixes
    added = 0.0 if stated is None else pose_covariances(stated, rows, fixes.solutions)
    return fixes.moved(*pose, frame="world", added_covariance=added)


def _with_eddies(array: SensorArray, rows: Readings) -> SensorArray:
    """Return the array with eddy currents as errors of its offsets.

    Their size follows from the rotation between the rows.
    """
    if rows.pose is None or not any(sensor.eddy_uncertainty_s for sensor in array.sensors):
        return array
    _, rate_rad_s = rates_of(rows.time_s, rows.pose[0], rows.pose[1].as_matrix())
    return with_eddies_as_offsets(array, ambient_in_array(array, rows.values_T, rows.ambient_T), rate_rad_s)


def used_rows(
    readings: Readings, array: SensorArray, *, average: bool = False
) -> tuple[Readings, SensorArray, list[tuple[str, ...]]]:
    """Return the rows to fit, the array with their noise, and saturated channels of each row."""
    rows = in_world_field(without_saturated(readings, array), array)
    if rows.background:
        _LOG.warning("fits of single rows do not model a background: filters remove it, with some of the signal")
        values_T = rows.background.taken_out(rows.time_s, rows.values_T)
        rows = replace(rows, values_T=values_T, background=NO_BACKGROUND)
    if not average:
        return rows, array, _saturated_channels(readings, rows, array)
    return averaged(rows), averaging_array(array, rows), [()]


def _saturated_channels(measured: Readings, rows: Readings, array: SensorArray) -> list[tuple[str, ...]]:
    """Return names of the saturated channels of every row."""
    lost = np.isfinite(measured.values_T) & ~np.isfinite(rows.values_T)
    names: list[tuple[str, ...]] = [()] * len(lost)
    for row in np.flatnonzero(lost.any(axis=1)).tolist():
        names[row] = tuple(array.channel_names[channel] for channel in np.flatnonzero(lost[row]))
    return names
