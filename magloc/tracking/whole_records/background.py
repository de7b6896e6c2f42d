r"""Tracks of readings with a drifting background: ``--detrend``, ``--high-pass-hz``.

The background is a state of every channel besides the source, for readings without a filter: a filter would remove
signal that the model still predicts. A single row does not separate source and background, so that a track cannot start
from one. It starts from a track of filtered readings, about which all rows are linearised. A Kalman filter and smoother
repeat until they converge: Gauss-Newton over the whole record. The points come from the last filter pass, so that
each depends on earlier rows only.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from arrays.typing import BoolArray, FloatArray
from magloc.levels import CONTRADICTION
from magloc.localization.uncertainty.range_interval import relative_range_sigma
from magloc.readings import Readings
from magloc.state_space import update, whitened_innovation
from magloc.tracking.chart.steps import from_cartesian
from magloc.tracking.coordinates import Chart
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Innovation, Step, TrackPoint, point_of_mixture
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.tracker import LARGEST_RANGE_ERROR, Tracker
from magloc.tracking.whole_records.smoother import smooth_points, smooth_states

_LOG = logging.getLogger(__name__)
TAKES_MUCH = 3.0
"""Factor of the position's σ by the background above which a warning is given."""
# Prior standard deviations of a source over its distance and its moment.
_UNKNOWN = 10.0
_MOST_PASSES = 30
_SETTLED = 1e-2
_MOST_AGREE = 0.9
# Largest σ of the range over the range in the first row of a track.
_FIRST_RANGE_ERROR = 0.06
# Factors of the sensors' noise for plain tracks, and their fewest rows.
_NOISIER = (1.0, 10.0, 100.0)
_FEWEST_ROWS = 5
# Difference of the log-range of trajectories that are compared.
_APART = 0.01
_NOTHING = "not acquired: no dipole on this background fits the rows"


@dataclass(frozen=True, eq=False)
class _ForwardPass:
    """Forward pass: first row, steps, innovations, rows that are consistent, rows used."""

    begin: int
    steps: list[Step]
    innovations: list[Innovation | None]
    agrees: BoolArray
    used: BoolArray

    @property
    def rows(self) -> slice:
        """Rows of the record."""
        return slice(self.begin, self.begin + len(self.steps))


def track_on_background(
    tracker: Tracker, readings: Readings, *, smooth: bool, progress: Callable[[int], None] | None = None
) -> list[TrackPoint]:
    """Return the points of a record with the background as states of the tracker."""
    rows = list(rows_of(readings))
    measurements = [tracker.measurements.of(row) for row in rows]
    points = [tracker.untracked_point(row, _NOTHING) for row in rows]
    near = (_iterate_passes(tracker, measurements, *states) for states in _plain_tracks(tracker, readings))
    passed = next((found for found in near if found is not None), None)
    if progress is not None:
        progress(len(rows))
    if passed is None:
        return points
    passed = _extend(tracker, measurements, passed)
    of_rows = _points(tracker, measurements[passed.rows], passed)
    points[passed.rows] = smooth_points(of_rows, passed.steps) if smooth else of_rows
    _warn_of_lost_information(tracker, rows[passed.rows], passed, of_rows)
    _warn_of_biased_mode(tracker, measurements[passed.rows], passed)
    return points


def _plain_tracks(tracker: Tracker, readings: Readings) -> Iterator[tuple[int, list[FloatArray]]]:
    """Yield first rows and states for the first linearisation, from tracks without a background.

    They are tracks of the raw and of the filtered readings, with increasing noise.
    """
    background, n_motion = readings.background, tracker.motion.n_states
    filtered = replace(readings, values_T=background.taken_out(readings.time_s, readings.values_T))
    for source in (readings, filtered):
        for times in _NOISIER:
            sensors = tuple(replace(sensor, noise_T=times * sensor.noise_T) for sensor in tracker.array.sensors)
            plain = Tracker(replace(tracker.array, sensors=sensors), tracker.motion, prior=tracker.prior)
            points = list(plain.run(list(rows_of(source))))
            known = np.flatnonzero([point.is_on_track for point in points])
            if len(known) < _FEWEST_ROWS:
                continue
            sources = np.array([np.concatenate([points[i].position_m, points[i].moment_Am2]) for i in known.tolist()])
            every = np.arange(known[0], known[-1] + 1)
            between = np.stack([np.interp(every, known, column) for column in sources.T], axis=1)
            rest = np.zeros(n_motion - N_SOURCE + tracker.n_errors)
            yield int(known[0]), [np.concatenate([state, rest]) for state in between]


def _warn_of_lost_information(
    tracker: Tracker, rows: Sequence[Row], passed: _ForwardPass, points: Sequence[TrackPoint]
) -> None:
    """Warn if positions would be much more certain without the background."""
    plain, n = Tracker(tracker.array, tracker.motion), tracker.motion.n_states
    states = [np.concatenate([step.x[:n], np.zeros(plain.n_errors)]) for step in passed.steps]
    alone = _forward_pass(plain, [plain.measurements.of(row) for row in rows], 0, states, passed.used)
    known = [j for j, point in enumerate(points) if point.position_m is not None]
    variance, plain_variance = (
        sum(float(np.sum(steps[j].S[:3] ** 2)) for j in known) for steps in (passed.steps, alone.steps)
    )
    if variance > TAKES_MUCH**2 * plain_variance:
        factor = math.sqrt(variance / plain_variance)
        _LOG.warning(f"the background looks like the source: positions are {factor:.0f} times as uncertain as without")


def _warn_of_biased_mode(tracker: Tracker, measurements: Sequence[RowMeasurement], passed: _ForwardPass) -> None:
    """Warn if the likeliest trajectory may be far from the mean one.

    The mode neglects the posterior's volume about it, which the determinants of the innovations' covariances give. They
    differ for a source that is farther, stronger and faster with the same readings. This matters if it would shift the
    range by more than its σ.
    """
    states = [x for x, _ in smooth_states(passed.steps)]
    sigma = [_range_error(step.x, step.S, m) for step, m in zip(passed.steps, measurements, strict=True)]
    log_number = []
    for apart in (-_APART, _APART):
        scaled = [_scale_range(state, m, apart) for state, m in zip(states, measurements, strict=True)]
        steps = _forward_pass(tracker, measurements, 0, scaled, passed.used).steps
        log_number.append(
            sum(_log_volume(step.prediction.S) - _log_volume(step.S) for step in steps if step.prediction)
        )
    pull = abs(log_number[1] - log_number[0]) / (2.0 * _APART) * float(np.median(sigma))
    if pull > 1.0:
        _LOG.warning("the motion alone determines the position: errors may be several times their standard deviations")


def _scale_range(state: FloatArray, measurement: RowMeasurement, log_range: float) -> FloatArray:
    """Return a state (n,) at another range, with moment and velocity scaled to match readings."""
    n = measurement.n_motion
    e = np.zeros(n)
    e[0] = log_range
    scaled = Chart.at(state[:n], measurement.centroid_m, measurement.radius_m).retract(e)
    return np.concatenate([scaled, state[n:]])


def _log_volume(S: FloatArray) -> float:
    """Return the logarithm of the determinant of a root."""
    return float(np.linalg.slogdet(S)[1])


def steps_of(
    tracker: Tracker,
    measurements: Sequence[RowMeasurement],
    states: Sequence[FloatArray],
    start: tuple[FloatArray, FloatArray] | None = None,
) -> list[Step]:
    """Return the steps of a forward pass with all rows linearised at given states."""
    return _forward_pass(tracker, measurements, 0, states, np.ones(len(measurements), dtype=bool), start).steps


def iterate_steps(tracker: Tracker, rows: Sequence[Row], states: Sequence[FloatArray]) -> list[Step] | None:
    """Return the steps of the last of repeated passes over rows, or None without convergence."""
    passed = _iterate_passes(tracker, [tracker.measurements.of(row) for row in rows], 0, states)
    return None if passed is None else passed.steps


def _extend(tracker: Tracker, measurements: Sequence[RowMeasurement], passed: _ForwardPass) -> _ForwardPass:
    """Extend a pass by the rows before and after it, as long as passes converge."""
    while len(passed.steps) < len(measurements):
        states = [x for x, _ in smooth_states(passed.steps)]
        more = _FEWEST_ROWS + len(states) // 4
        before, after = min(more, passed.begin), min(more, len(measurements) - passed.begin - len(states))
        states = [states[0]] * before + states + [states[-1]] * after
        wider = _iterate_passes(tracker, measurements, passed.begin - before, states)
        if wider is None:
            return passed
        passed = wider
    return passed


def _iterate_passes(
    tracker: Tracker, measurements: Sequence[RowMeasurement], begin: int, states: Sequence[FloatArray]
) -> _ForwardPass | None:
    """Repeat forward pass and smoother until they converge, and return the last pass.

    Return None without convergence, or if too many rows contradict it.
    """
    measurements = measurements[begin : begin + len(states)]
    used = np.ones(len(measurements), dtype=bool)
    for _ in range(_MOST_PASSES):
        if tracker.errors.depends_on_field:
            sources = (state[:N_SOURCE] for state in states)
            measurements = [tracker.measurements.of(m.row, at) for m, at in zip(measurements, sources, strict=True)]
        try:
            with np.errstate(all="ignore"):  # passes may overflow
                passed = _forward_pass(tracker, measurements, begin, states, used)
                later = smooth_states(passed.steps)
                sigma = np.array([np.linalg.norm(S[:N_SOURCE], axis=1) for _, S in later])
        except np.linalg.LinAlgError:
            return None
        new = [x for x, _ in later]
        if not np.isfinite(new).all():
            return None
        change = np.abs(np.array(new) - np.array(states))[:, :N_SOURCE]
        states = new
        if np.all(change <= _SETTLED * sigma):
            agrees = used & passed.agrees
            if np.mean(agrees) < _MOST_AGREE:
                return None
            if np.array_equal(agrees, used):
                return passed
            used = agrees
    return None


def _forward_pass(
    tracker: Tracker,
    measurements: Sequence[RowMeasurement],
    begin: int,
    states: Sequence[FloatArray],
    used: BoolArray,
    start: tuple[FloatArray, FloatArray] | None = None,
) -> _ForwardPass:
    """Return a forward pass over rows linearised at given states, from a flat prior by default."""
    if start is None:
        offset = measurements[0].place_in_array(states[0], np.eye(states[0].size))[0]
        sigma = _UNKNOWN * np.repeat([np.linalg.norm(offset), np.linalg.norm(states[0][3:6])], 3)
        start = tracker.initial_state(states[0], np.diag(sigma))
    x, S = start
    steps: list[Step] = []
    innovations: list[Innovation | None] = []
    agrees = np.ones(len(measurements), dtype=bool)
    for j, (measurement, state) in enumerate(zip(measurements, states, strict=True)):
        prediction = None
        if j:
            before = states[j - 1]
            at = tracker.predict(before, S, measurement.row.time_s - measurements[j - 1].row.time_s)
            prediction = replace(at, x=at.x + at.F @ (x - before))
            x, S = prediction.x, prediction.S
        k = measurement.z.size
        innovations.append(None)
        if k:
            H = measurement.jacobian(state)
            innovation = measurement.z - measurement.predict(state) - H @ (x - state)
            whitened = whitened_innovation(S, H, innovation)
            innovations[j] = Innovation(measurement.row.available, whitened)
            agrees[j] = whitened @ whitened <= chdtri(k, CONTRADICTION)
            if used[j]:
                x, S, _ = update(x, S, H, innovation)
        steps.append(Step(j, prediction, x, S))
    return _ForwardPass(begin, steps, innovations, agrees, used)


def _points(tracker: Tracker, measurements: Sequence[RowMeasurement], passed: _ForwardPass) -> list[TrackPoint]:
    """Return the points of a pass, from the first row with a known range."""
    points: list[TrackPoint] = []
    tracked, last = False, None
    open_loop = tracker.prior_covariance(measurements[0], passed.steps[0].x)
    for j, (measurement, step) in enumerate(zip(measurements, passed.steps, strict=True)):
        row, innovation = measurement.row, passed.innovations[j]
        if j:
            open_loop = tracker.propagate(open_loop, passed.steps[j - 1].x, row.time_s - measurements[j - 1].row.time_s)
        range_error = _range_error(step.x, step.S, measurement)
        if not range_error <= (LARGEST_RANGE_ERROR if tracked else _FIRST_RANGE_ERROR):
            tracked, last = False, None
            points.append(tracker.untracked_point(row, "not acquired: the range is not certain enough"))
            continue
        status = "predicted" if innovation is None else "tracked" if passed.used[j] else "outlier"
        statistics = {} if innovation is None or not tracked else innovation.statistics(last)
        last = innovation if status == "tracked" else None
        mixture = from_cartesian(step.x, step.S, measurement)
        point = point_of_mixture(row.time_s, mixture, np.diagonal(open_loop))
        points.append(replace(point, iterations=1, status=status if tracked else "acquired", **statistics))
        tracked = True
    return points


def _range_error(x: FloatArray, S: FloatArray, measurement: RowMeasurement) -> float:
    """Return the standard deviation of the range over the range."""
    offset_m, root = measurement.place_in_array(x, S)
    return float(relative_range_sigma(root @ root.T, offset_m))
