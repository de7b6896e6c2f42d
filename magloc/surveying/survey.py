"""Surveys: static sources located by moving sensors, from all rows together."""

from __future__ import annotations

import logging
import math
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc import core
from magloc.grids.work import workers
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.plausibility import warn_of_doubts
from magloc.measurement.rows import concatenate_readings
from magloc.navigation.crossovers import clock_shift
from magloc.navigation.flight_lines import FlightLine
from magloc.readings import Readings
from magloc.surveying.clock import lag_of_lines
from magloc.surveying.fit.sensor_order import exchanged_beside, size_of_anomalies, weaker_sensors_below
from magloc.surveying.piece import Ground, significant_sources, strongest_sources
from magloc.surveying.preparation import variations_of_lines, whole_rows, with_places_between_fixes
from magloc.surveying.results import Survey
from magloc.surveying.review.state import SurveyState
from magloc.surveying.review.wrong_positions import doubt_of_positions
from magloc.surveying.tiled import Tell, TiledSurvey
from magloc.terrain.surface import Terrain

_LOG = logging.getLogger(__name__)
_TRIALS = 1.25  # independent trials per area of a map, in squared distances to the shallowest sources: 1.0 to 1.4
_HECTARE_M2 = 1e4
_MOST_DOUBTED = 1_000_000  # rows
_LONGEST_BODY_M = 10.0


def survey(
    array: SensorArray,
    readings: Readings | Sequence[Readings],
    *,
    base: Readings | None = None,
    prior: SourcePrior = NOTHING_KNOWN,
    ground_m: float | Terrain = 0.0,
    shortest_geology_m: float = 15.0,
    false_per_hectare: float = 0.1,
    body_length_m: float = 0.0,
    processes: int | None = None,
    scheduler: str | None = None,
    unfinished: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Survey:
    r"""Find all dipoles at rest in the ground that sensors moved over.

    The number of sources is unknown, and all rows are used together: a matched filter over places below the sensors
    with everything else projected out, greedy rounds with joint fits, and a significance test. Projected out are slow
    changes of the ambient field and of the sensors' offsets (a Kalman filter along time, with the errors of the pose as
    states), and the geology, as an equivalent layer of poles at the depth λ/2.5. One moving sensor, of either kind, is
    enough.

    A large survey is cut into tiles with margins, which are surveys of their own. The field of sources in one tile is
    subtracted from the readings of others that it reaches, and these are searched again, until nothing changes.

    Parameters
    ----------
    array : SensorArray
        States the noise and the uncertainty of the pose (:class:`arrays.PoseUncertainty`). Without the latter, size and
        correlation time of the pose errors are estimated from the targets' own fields.
    readings : Readings or sequence of them
        In order of time, with the pose of the array, and for scalar sensors with the ambient field.
    base : Readings, optional
        Modulus of the field at a base station: one channel, with the same clock, during the whole survey. The ambient
        field varies like it. Without it slow variations are estimated from the survey itself.
    prior : SourcePrior
        Limits of positions in the world frame and of moments; by default from 5 cm to 4 m below the ground, up to 1 m
        beside the sensors, and up to 300 A·m². With terrain, limits of heights are measured from the ground.
    ground_m : float or Terrain
        Height of the ground in the world frame [m], or terrain: depths are then measured from the ground above the
        target.
    shortest_geology_m : float
        Shortest wavelength in the field of the ground itself [m]; shorter ones count as targets.
    false_per_hectare : float
        Mean number of false targets per hectare by noise alone; it sets the threshold of significance.
    body_length_m : float
        Longest edge of buried bodies [m]; the deviation of their field from a dipole counts as noise. 0 for points.
    processes : int, optional
        Number of processes for tiles; by default the number of threads of compiled code.
    scheduler : str, optional
        Address of a dask scheduler, ``tcp://HOST:PORT``, whose workers process the tiles instead.
    unfinished : str or path-like, optional
        Folder for finished tiles; after an interruption the same call continues from it.
    progress : callable, optional
        Called with a sentence after every tile.

    Returns
    -------
    Survey
        Targets, the most significant first, with residuals and the least moments that would have been found.

    Raises
    ------
    ValueError
        The readings have no pose or no ambient field, there are too few, sensors are below the ground, or the base
        station does not read as long as they do.
    InputError
        The scheduler cannot be used, or a process died.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
    >>> found = magloc.survey(field.array, field.readings)
    >>> found[0].position_m.round(1).tolist(), [round(depth, 1) for depth in found[0].depth_interval95_m]
    ([12.7, 12.5, -0.4], [0.4, 0.4])
    """
    began = time.monotonic()
    if not false_per_hectare > 0.0:
        raise ValueError(f"Input false_per_hectare must be positive; instead received {false_per_hectare:g}.")
    if not shortest_geology_m > 0.0:
        raise ValueError(f"Input shortest_geology_m must be positive; instead received {shortest_geology_m:g}.")
    if processes is not None and processes < 1:
        raise ValueError(f"Input processes must be positive; instead received {processes}.")
    if not 0.0 <= body_length_m <= _LONGEST_BODY_M:
        raise ValueError(
            f"Input body_length_m must be from 0 to {_LONGEST_BODY_M:g} m; instead received {body_length_m:g}."
        )
    rows = readings if isinstance(readings, Readings) else concatenate_readings(readings)
    warn_of_doubts(array, rows[:_MOST_DOUBTED])
    assumed = array.pose is None and rows.pose_sigma is None
    terrain = ground_m if isinstance(ground_m, Terrain) else Terrain(ground_m)
    if not terrain.is_flat:
        low_m, high_m = ((x, y, z + terrain.height_m) for x, y, z in (prior.low_m, prior.high_m))
        prior = replace(prior, low_m=low_m, high_m=high_m)
    ground = Ground(prior, terrain, shortest_geology_m, math.inf, body_length_m)
    tiled = tile_rows(array, rows, ground, base, false_per_hectare)
    tell: Tell = progress or (lambda _: None)
    folder = None if unfinished is None else Path(unfinished)
    at_once = min(core.threads() if processes is None else processes, len(tiled.tiles))
    with workers(at_once, scheduler, folder) as each:
        # Strong sources beside a tile mask all others until they are known.
        tiled = tiled.search(strongest_sources, range(len(tiled.tiles)), each, tell)
        with_offsets = tiled.with_likeliest_offsets()
        again = tiled.changes() if with_offsets is tiled else range(len(tiled.tiles))
        tiled, _ = with_offsets.settle(strongest_sources, each, tell, again)
        rows = tiled.readings
        assert rows.array_position_m is not None
        variations_T, lines = variations_of_lines(tiled.array, rows)
        _warn_of_order(tiled.array, rows, variations_T, lines)
        clock = clock_shift(rows.time_s, rows.array_position_m, variations_T.mean(axis=1), lines)
        tiled, lag = tiled.correct_lag(assumed, lag_of_lines(clock))
        if clock is not None and clock.is_significant and (clock.is_leap or not lag.is_significant):
            _LOG.warning(clock.warning)
        if lag.doubt:
            _LOG.warning(f"the lag between readings and poses is doubtful: {lag.doubt}")
        if lag.is_significant:
            _LOG.warning(
                f"the readings are {lag.s:.3f} ± {lag.sigma_s:.3f} s later than their poses; this is corrected"
            )
            tiled, _ = tiled.settle(strongest_sources, each, tell)
        tiled, due = tiled.settle(significant_sources, each, tell)
        if due:
            _LOG.warning(
                f"{len(due)} of {len(tiled.tiles)} tiles differ from their neighbours in the sources at their edges"
            )
        found = SurveyState(tiled, assumed, lag.s if lag.is_significant else 0.0).measure(each, tell)
        if doubt := doubt_of_positions(found, tiled, each):
            _LOG.warning(doubt)
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
    return replace(found, seconds=time.monotonic() - began)


def _warn_of_order(array: SensorArray, rows: Readings, variations_T: FloatArray, lines: Sequence[FlightLine]) -> None:
    """Warn of sensors that appear exchanged, with one below them or beside them."""
    weaker = weaker_sensors_below(array, rows, size_of_anomalies(variations_T, lines))
    for upper, lower in zip(array.ids, weaker, strict=True):
        if lower:
            _LOG.warning(
                f"sensor {upper} shows larger anomalies than sensor {lower} below it, expected smaller ones: are their"
                " columns or positions exchanged?"
            )
    pair = exchanged_beside(array, rows, variations_T, lines)
    if pair is not None:
        _LOG.warning(
            f"sensors {pair[0]} and {pair[1]} appear exchanged: lines of opposite directions agree better the other way"
            " round. Check their columns, their positions and the sense of the course"
        )


def tile_rows(
    array: SensorArray, rows: Readings, ground: Ground, base: Readings | None = None, false_per_hectare: float = 0.1
) -> TiledSurvey:
    """Return whole rows in tiles, with the threshold of χ² for a number of false targets."""
    array, rows = with_places_between_fixes(array, rows)
    tiled = TiledSurvey.of(*whole_rows(array, rows, base, ground.shallowest_m, ground.terrain), ground)
    trials = _TRIALS * _HECTARE_M2 / tiled.nearest_m**2
    threshold = float(chdtri(3, min(0.5, false_per_hectare / trials)))
    return replace(tiled, ground=replace(ground, threshold=threshold))
