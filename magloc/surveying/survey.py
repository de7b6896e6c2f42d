"""A survey: static sources from sensors that move, from all rows together."""

from __future__ import annotations

import logging
import math
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from magloc import core
from magloc.grids.work import Arrays, Work, workers
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.plausibility import warn_of_doubts
from magloc.measurement.rows import concatenate_readings
from magloc.readings import Readings
from magloc.surveying.piece import OF_ROWS, Ground, sources_in, strongest_in, targets_in
from magloc.surveying.preparation import whole_rows, with_places_between_fixes
from magloc.surveying.results import Reach, Survey, SurveyRows, Target
from magloc.surveying.targets import OF_TARGETS
from magloc.surveying.tiled import TiledSurvey
from magloc.surveying.tiles import owned

_LOG = logging.getLogger(__name__)
_TRIALS = 1.25  # independent ones of a map, over its area in distances to the shallowest sources: 1.0 to 1.4
_HECTARE_M2 = 1e4
_MOST_SWEEPS = 5
_MISFIT = 2.0
_MOST_DOUBTED = 1_000_000  # rows
_LONGEST_BODY_M = 10.0


def survey(
    array: SensorArray,
    readings: Readings | Sequence[Readings],
    *,
    base: Readings | None = None,
    prior: SourcePrior = NOTHING_KNOWN,
    ground_m: float = 0.0,
    shortest_geology_m: float = 15.0,
    false_per_hectare: float = 0.1,
    body_length_m: float = 0.0,
    processes: int | None = None,
    scheduler: str | None = None,
    unfinished: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Survey:
    r"""Find all dipoles at rest in the ground that sensors moved over.

    Every row is used at once, and an unknown number of sources: a matched filter over places below the sensors with
    everything else projected out, greedy rounds with joint fits, and a significance test. Projected out are slow
    changes of the ambient field and of the sensors' offsets (a Kalman filter along time, with the errors of the pose as
    states), and the geology, as an equivalent layer of poles at the depth λ/2.5. Moving sensors do not need to be many:
    one, of either kind, is enough.

    A large survey is cut into tiles with margins, which are surveys of their own. What is found in one is taken from
    the readings of others that it reaches, and these are searched again, until nothing changes.

    Parameters
    ----------
    array : SensorArray
        Its noise counts, and what it states of its pose (:class:`arrays.PoseUncertainty`); if it states nothing, how
        large the errors of the pose are and how long they last is estimated from the targets' own fields.
    readings : Readings or sequence of them
        In order of time, with the pose of the array, and for scalar sensors with the ambient field.
    base : Readings, optional
        The modulus of the field at a base station, one channel, at the same clock and for as long: the ambient field
        varies as it does. Without it slow variations are estimated from the survey itself.
    prior : SourcePrior
        Where sources may be, in the world frame, and how strong; by default from 5 cm to 4 m below the ground, up to
        1 m beside the sensors, and up to 300 A·m².
    ground_m : float
        Height of the ground in the world frame [m].
    shortest_geology_m : float
        Shortest wavelength in the field of the ground itself [m]: smaller ones are taken for targets.
    false_per_hectare : float
        False targets that noise alone may make in a hectare, on average: decides how significant one must be.
    body_length_m : float
        Longest edge of what may be buried [m]: what a dipole leaves out of its field counts as noise. 0 of points.
    processes : int, optional
        That work on tiles beside each other; by default as many as compiled code has threads.
    scheduler : str, optional
        Address of a dask scheduler, ``tcp://HOST:PORT``, whose workers do it instead.
    unfinished : str or path-like, optional
        Folder that keeps what is done of tiles until all are: after an interruption the same call goes on.
    progress : callable, optional
        Called with a sentence after every tile.

    Returns
    -------
    Survey

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
    >>> field = sims.simulate(scenario, seed=1)
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
    array, rows = with_places_between_fixes(array, rows)
    ground = Ground(prior, ground_m, shortest_geology_m, math.inf, body_length_m)
    tiled = TiledSurvey.of(*whole_rows(array, rows, base, ground.shallowest_m), ground)
    trials = _TRIALS * _HECTARE_M2 / tiled.nearest_m**2
    threshold = float(chdtri(3, min(0.5, false_per_hectare / trials)))
    tiled = replace(tiled, ground=replace(ground, threshold=threshold))
    tell: Callable[[str], None] = progress or (lambda _: None)
    folder = None if unfinished is None else Path(unfinished)
    every = range(len(tiled.tiles))
    at_once = min(core.threads() if processes is None else processes, len(every))
    with workers(at_once, scheduler, folder) as each:

        def settled(tiled: TiledSurvey, work: Work) -> tuple[TiledSurvey, Sequence[int]]:
            """After searches of all tiles, and again of those that differ from what others tell them."""
            due: Sequence[int] = every
            for _ in range(_MOST_SWEEPS):
                tiled = tiled.searched(work, due, each, tell)
                due = tiled.changed()
                if not due:
                    break
            return tiled, due

        # What is strong beside a tile is in the way of all else, until it is told.
        tiled, lag = settled(tiled, strongest_in)[0].on_time(assumed)
        if lag.s:
            _LOG.warning(
                f"the readings are {lag.s:.3f} ± {lag.sigma_s:.3f} s later than their poses, as the targets show: taken"
                " into account"
            )
            tiled, _ = settled(tiled, strongest_in)
        tiled, due = settled(tiled, sources_in)
        if due:
            _LOG.warning(f"{len(due)} of {len(every)} tiles do not agree with others on what lies beside them")
        if assumed:
            tiled = tiled.with_likeliest_pose()
        results = tiled.measured(targets_in, each, tell)
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
    chi2_per_dof = float(sum(result["chi2"] for result in results) / sum(result["size"] for result in results))
    if chi2_per_dof > _MISFIT:
        _LOG.warning(
            f"χ² per reading is {chi2_per_dof:.1f}: noise, errors of the pose or changes of the field are larger than"
            " is stated, and so are the errors of the targets"
        )
    return Survey(
        _targets(tiled, results),
        tiled.array,
        _rows(tiled, results),
        Reach(*(np.concatenate([result[name] for result in results]) for name in ("reach_m", "reach_Am2"))),
        ground_m,
        threshold,
        chi2_per_dof,
        assumed,
        lag.s,
        time.monotonic() - began,
    )


def _targets(tiled: TiledSurvey, results: Sequence[Arrays]) -> tuple[Target, ...]:
    """Targets of all tiles, the most significant one first."""
    kept = owned(tiled.tiles, [result["position_m"] for result in results], tiled.same_m)
    kept.sort(key=lambda where: -results[where[0]]["significance"][where[1]])
    targets = []
    for number, (t, k) in enumerate(kept, start=1):
        position, moment, covariance, interval, significance, flags = (results[t][name][k] for name in OF_TARGETS)
        depth = tiled.ground.ground_m - float(position[2])
        chi2, words = float(significance), tuple(str(flags).split())
        interval95 = (float(interval[0]), float(interval[1]))
        targets.append(Target(f"t{number}", position, moment, covariance, depth, interval95, chi2, words))
    return tuple(targets)


def _rows(tiled: TiledSurvey, results: Sequence[Arrays]) -> SurveyRows:
    """Rows of all tiles in order of time."""
    which = np.concatenate([tile.rows[tile.own] for tile in tiled.tiles])
    order = np.argsort(which)
    place, anomaly, residual = (np.concatenate([result[name] for result in results])[order] for name in OF_ROWS)
    return SurveyRows(tiled.readings.time_s[which[order]], place, anomaly, residual)
