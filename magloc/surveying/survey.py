"""A survey: static sources from sensors that move, from all rows together."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import FloatArray, IntArray
from magloc.blas_threads import one_blas_thread
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.readings import Readings
from magloc.surveying.clock import lag_of, taken_earlier
from magloc.surveying.depth import depth_interval
from magloc.surveying.joint_fit import Background, Bounds, JointFit, Layer, Sources
from magloc.surveying.pose_components import with_likeliest_pose
from magloc.surveying.preparation import record_of, whole_rows
from magloc.surveying.record import SurveyRecord, joined
from magloc.surveying.results import Survey, Target
from magloc.surveying.rounds import MOST_ROUNDS, Model, found_in
from magloc.surveying.search import PITCH, SearchGrid
from magloc.surveying.whitening import Drift

_LOG = logging.getLogger(__name__)
_TRIALS_PER_M2 = 0.8  # independent ones of a map: 0.65 to 0.9
_HECTARE_M2 = 1e4
_FIRST_ROUNDS = 4  # until the clock is looked at
_DEEPEST = 4.0
_MARGIN_M = 1.0
_LARGEST_MOMENT_Am2 = 300.0
_WEAK = 200.0
_SETTLED = 1e-3
_GROUPS_PER_HEIGHT = 4.0
_NEAR = 1.5
_MISFIT = 1.5  # χ² per reading
_MOST_NUMBERS = 2.5e8  # of the columns of the ground: 2 GB
_MOST_PLACES = 1e6


@one_blas_thread
def survey(
    array: SensorArray,
    readings: Readings | Sequence[Readings],
    *,
    prior: SourcePrior = NOTHING_KNOWN,
    ground_m: float = 0.0,
    shortest_geology_m: float = 15.0,
    false_per_hectare: float = 0.1,
    progress: Callable[[int, int], None] | None = None,
) -> Survey:
    r"""Find all dipoles at rest in the ground that sensors moved over.

    Every row is used at once, and an unknown number of sources: a matched filter over places below the sensors with
    everything else projected out, greedy rounds with joint fits, and a significance test. Projected out are slow
    changes of the ambient field and of the sensors' offsets (a Kalman filter along time, with the errors of the pose as
    states), and the geology, as an equivalent layer of poles at the depth λ/2.5. Moving sensors do not need to be many:
    one, of either kind, is enough.

    Parameters
    ----------
    array : SensorArray
        Its noise counts, and what it states of its pose (:class:`arrays.PoseUncertainty`); if it states nothing, how
        large the errors of the pose are and how long they last is estimated from the targets' own fields.
    readings : Readings or sequence of them
        In order of time, with the pose of the array, and for scalar sensors with the ambient field.
    prior : SourcePrior
        Where sources may be, in the world frame, and how strong; by default from 5 cm to 4 m below the ground, up to
        1 m beside the sensors, and up to 300 A·m².
    ground_m : float
        Height of the ground in the world frame [m].
    shortest_geology_m : float
        Shortest wavelength in the field of the ground itself [m]: smaller ones are taken for targets.
    false_per_hectare : float
        False targets that noise alone may make in a hectare, on average: decides how significant one must be.
    progress : callable, optional
        Called with the number of every round, and with how many sources are known.

    Returns
    -------
    Survey

    Raises
    ------
    ValueError
        The readings have no pose or no ambient field, there are too few, or sensors are below the ground.

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
    rows = readings if isinstance(readings, Readings) else joined(readings)
    assumed = array.pose is None and rows.pose_sigma is None
    array, rows = whole_rows(array, rows)
    record, errors = record_of(array, rows)
    bounds = _bounds(record, prior, ground_m)
    _refuse_too_large(record, bounds, shortest_geology_m)
    threshold = float(chdtri(3, min(0.5, false_per_hectare / (_HECTARE_M2 * _TRIALS_PER_M2))))
    height = record.height_m - bounds.high_m[2]
    group = _groups(record, height / _GROUPS_PER_HEIGHT)
    spread = float(np.median(np.abs(record.values_T)) * 1.4826)
    layer = Layer.below(record, shortest_geology_m, max(min(spread, 5e-9), 1e-10))
    model = Model(record, errors, layer, Drift(), bounds, threshold)
    grid = SearchGrid.below(record, bounds.low_m, bounds.high_m)
    tell = progress or (lambda *_: None)
    strongest = found_in(model, group, grid, Sources.none(), _FIRST_ROUNDS, tell)

    def delayed(lag_s: float) -> SurveyRecord:
        return record_of(array, taken_earlier(rows, lag_s))[0]

    lag = lag_of(model, strongest, group, delayed)
    if lag.s:
        _LOG.warning(
            f"the readings are {lag.s:.3f} ± {lag.sigma_s:.3f} s later than their poses, as the targets show: taken"
            " into account"
        )
        model = replace(model, record=delayed(lag.s))
    sources = found_in(model, group, grid, strongest, MOST_ROUNDS, tell)
    every = np.arange(len(record))
    if assumed and len(sources):
        model = with_likeliest_pose(model, model.fitted(sources, every, _SETTLED)[0].sources)
    record = model.record
    fit, background = model.fitted(sources, every, _SETTLED)
    residual = record.values_T - record.predicted(record.fields(fit.sources.position_m, fit.sources.moment_Am2))
    if fit.chi2 > 2.0 * fit.residual.size:
        _LOG.warning(
            f"χ² per reading is {fit.chi2 / fit.residual.size:.1f}: noise, errors of the pose or changes of the field"
            " are larger than is stated, and so are the errors of the targets"
        )
    targets = _targets(model, fit, background, ground_m)
    return Survey(
        targets,
        record,
        residual,
        ground_m,
        threshold,
        fit.chi2 / fit.residual.size,
        assumed,
        lag.s,
        time.monotonic() - began,
    )


def _bounds(record: SurveyRecord, prior: SourcePrior, ground_m: float) -> Bounds:
    low, high = record.sensors_m.min(axis=(0, 1)), record.sensors_m.max(axis=(0, 1))
    if low[2] <= ground_m:
        raise ValueError(
            f"Input ground_m must be below all sensors; instead received {ground_m:g} m with one at {low[2]:g} m."
        )
    own_low = np.array([low[0] - _MARGIN_M, low[1] - _MARGIN_M, ground_m - _DEEPEST])
    own_high = np.array([high[0] + _MARGIN_M, high[1] + _MARGIN_M, ground_m - 0.05])
    low_m, high_m = (
        np.where(np.isfinite(given), given, own) for given, own in ((prior.low_m, own_low), (prior.high_m, own_high))
    )
    if not (low_m < high_m).all():
        raise ValueError("Input prior must leave room below the ground; instead received bounds that do not.")
    return Bounds(low_m, high_m, min(prior.largest_moment_Am2, _LARGEST_MOMENT_Am2))


def _refuse_too_large(record: SurveyRecord, bounds: Bounds, shortest_geology_m: float) -> None:
    """Raise where the ground's columns would not fit into memory, or its places not into a day."""
    height = record.height_m
    x, y = (bounds.high_m - bounds.low_m)[:2]
    pitch = max(height - bounds.high_m[2], 0.3) / PITCH
    spacing = shortest_geology_m / 3.75
    numbers = len(record) * record.array.n_channels * (x / spacing + 5.0) * (y / spacing + 5.0)
    if numbers > _MOST_NUMBERS or x * y / pitch**2 > _MOST_PLACES:
        raise ValueError(
            f"Input readings must be cut into smaller pieces; instead received {len(record)} rows over {x:.3g} m by "
            f"{y:.3g} m, {height - bounds.high_m[2]:.2g} m above the ground."
        )


def _groups(record: SurveyRecord, length_m: float) -> IntArray:
    """Group of every row (n,): rows that pass within a length count as one."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(record.sensors_m.mean(axis=1), axis=0), axis=1))])
    step = float(np.median(np.diff(way)))
    together = max(1, math.floor(length_m / step)) if step > 0.0 else 1
    return np.arange(len(record)) // together


def _targets(model: Model, fit: JointFit, background: Background, ground_m: float) -> tuple[Target, ...]:
    """Targets of a fit, the most significant one first."""
    if not len(fit.sources):
        return ()
    covariance, significance = fit.covariance, fit.significance
    left = (fit.residual - background.Q @ (background.Q.T @ fit.residual)).reshape(len(background.white.H), -1)
    order = np.argsort(-significance)
    targets = []
    for number, j in enumerate(order, start=1):
        position, own = fit.sources.position_m[j], covariance[6 * j : 6 * j + 6, 6 * j : 6 * j + 6]
        depth, sigma = ground_m - float(position[2]), math.sqrt(own[2, 2])
        interval = (max(0.0, depth - 1.96 * sigma), depth + 1.96 * sigma)
        flags = []
        if significance[j] < _WEAK:
            flags.append("weak")
            interval = depth_interval(model, fit, background, int(j), ground_m)
        apart = np.linalg.norm(fit.sources.position_m - position, axis=1)
        apart[j] = math.inf
        if apart.min() < _NEAR * depth + 0.5:
            flags.append("near")
        if _misfit(model, left, position):
            flags.append("misfit")
        rim = np.minimum(position - model.bounds.low_m, model.bounds.high_m - position)
        if (rim[:2] < 0.3).any() or rim[2] < 0.02:
            flags.append("edge")
        targets.append(
            Target(
                f"t{number}",
                position,
                fit.sources.moment_Am2[j],
                own,
                depth,
                interval,
                float(significance[j]),
                tuple(flags),
            )
        )
    return tuple(targets)


def _misfit(model: Model, left: FloatArray, position: FloatArray) -> bool:
    """Whether rows (n, k) near a target fit worse than one of ten thousand right models, and by more than a half."""
    apart = np.linalg.norm(model.record.sensors_m.mean(axis=1)[:, :2] - position[:2], axis=1)
    near = left[apart < _NEAR * (model.record.height_m - position[2])]
    return bool(np.sum(near**2) > max(float(chdtri(max(near.size, 1), 1e-4)), _MISFIT * near.size))
