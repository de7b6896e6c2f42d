r"""One dipole through time: an iterated extended Kalman filter that starts by itself, and says when it is lost.

A track is acquired from a start-free fix (:mod:`magloc.locate`), followed by :func:`magloc.kalman.iterated_update` with
a :class:`magloc.motion.MotionModel`, and given up when the readings contradict it or the range is no longer known; then
it is acquired anew. The state is in the world frame where the array's pose is known, else in the array's.

This module is the readable form; :mod:`magloc.kernels.tracks` steps long records, and a test holds the two together.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from arrays.differences import Differences, decorrelated_differences, reading_covariance
from arrays.sensor import SensorArray
from magloc.exact import ExactLocator
from magloc.fix import Fix, Knowledge, Solution
from magloc.kalman import estimability, iterated_update, predict_square_root, symmetric_square_root
from magloc.kernels import tracks as kernels
from magloc.locate import Locator
from magloc.measurement import DifferenceMeasurement
from magloc.motion import N_SOURCE, LinearMotion, MotionModel
from magloc.rows import ambient_fields
from magloc.stacked import stacked_fix

FloatArray = NDArray[np.float64]

# Probability under noise below which a row contradicts the track, and how many such rows in a row end it.
_CONTRADICTION = 1e-6
_ROWS_TO_LOSE = 3
# Standard deviation of the range over the range: a fix must be as certain as the first to start a track, because beyond
# it the posterior is no Gaussian in Cartesian coordinates; a prediction that is less certain than the second is
# replaced by a fix, if there is one; a track that is less certain than the third is lost.
_START_RANGE_ERROR = 0.03
_REFIX_RANGE_ERROR = 0.15
_LARGEST_RANGE_ERROR = 0.4
_MOST_ITERATIONS = 50
# Another solution within this Δχ² forbids a start.
_RIVAL_WITHIN = 9.0
# Rows that together may determine a source at rest: how far back, how many, how often it is tried.
_WINDOW_ROWS = 64
# A source is as good as at rest while it moves by less than this share of its range.
_AT_REST = 0.01
_STACKED_ROWS = 16
_TRY_EVERY = 4
# Probability under noise below which two successive proposals for a start disagree.
_DISAGREEMENT = 1e-3
# Stop of the iteration, in standard deviations of the differences: equation (19).
_TOLERANCE = 1e-4
_STATUS = {kernels.TRACKED: "tracked", kernels.PREDICTED: "predicted", kernels.OUTLIER: "outlier"}


@dataclass(frozen=True, eq=False)
class Row:
    """Readings at one instant.

    Attributes
    ----------
    time_s : float
    readings_T : ndarray, shape (C,)
        Raw readings, NaN where missing.
    origin_m, R_world_from_array : ndarray, shapes (3,) and (3, 3)
        Pose of the array.
    ambient_T : ndarray, shape (3,), optional
        Ambient field in the array's frame, in place of the array's own.
    """

    time_s: float
    readings_T: FloatArray
    origin_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    R_world_from_array: FloatArray = field(default_factory=lambda: np.eye(3))
    ambient_T: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class TrackPoint:
    """What is known of the source at one instant; None where it is not tracked.

    Attributes
    ----------
    time_s : float
    position_m, moment_Am2 : ndarray, shape (3,)
    covariance : ndarray, shape (6, 6)
        Of (position, moment).
    estimability : ndarray, shape (6,)
        What the row's readings taught of every component: 1 - σ after / σ predicted without them.
    iterations : int
        Linearisations.
    nis : float
        Normalised innovation squared, and `nis_dof` its degrees of freedom. NaN for rows that the track started from.
    status : str
        "tracked", "acquired" (a new track started here), "predicted" (no readings), "outlier" (readings that contradict
        the track, not used), or why there is no track.
    """

    time_s: float
    position_m: FloatArray | None = None
    moment_Am2: FloatArray | None = None
    covariance: FloatArray | None = None
    estimability: FloatArray | None = None
    iterations: int = 0
    nis: float = math.nan
    nis_dof: int = 0
    status: str = ""


@dataclass(frozen=True, eq=False)
class Prediction:
    """State and square root of its covariance before a row's readings, and the transition that led there."""

    x: FloatArray
    S: FloatArray
    F: FloatArray


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a track, for smoothing.

    Attributes
    ----------
    row : int
        Which row it belongs to.
    prediction : Prediction, optional
        From the step before; None at the first step of a track.
    x, S : ndarray
        State and square root of its covariance after the row's readings.
    """

    row: int
    prediction: Prediction | None
    x: FloatArray
    S: FloatArray


class Tracker:
    """Follows one dipole, row by row.

    Parameters
    ----------
    array : SensorArray
    motion : MotionModel
    knowledge : Knowledge
        Bounds for the fixes that start a track, in the array's frame.

    Attributes
    ----------
    steps : list of Step
        Of all tracks so far, if `keep_steps`.
    """

    def __init__(
        self,
        array: SensorArray,
        motion: MotionModel,
        *,
        knowledge: Knowledge | None = None,
        keep_steps: bool = False,
    ) -> None:
        self.array = array
        self.motion = motion
        known = Knowledge() if knowledge is None else knowledge
        scalar = bool(array.channel_is_scalar.any())
        self._locator: Locator | ExactLocator | None = None
        if decorrelated_differences(array).n_differences >= N_SOURCE:
            self._locator = ExactLocator(array, knowledge=known) if scalar else Locator(array, knowledge=known)
        self._knowledge = known
        self._recent: deque[Row] = deque(maxlen=_WINDOW_ROWS)
        self._rows_untracked = 0
        self._proposed: Solution | None = None
        self._differences: dict[bytes, Differences] = {}
        self._x: FloatArray | None = None
        self._S: FloatArray = np.zeros((0, 0))
        self._time_s = math.nan
        self._contradictions = 0
        self._n_rows = 0
        self.keep_steps = keep_steps
        self.steps: list[Step] = []

    def advance(self, row: Row) -> TrackPoint:
        """What is known of the source after one more row.

        Parameters
        ----------
        row : Row
            Later than the one before.

        Returns
        -------
        TrackPoint

        Raises
        ------
        ValueError
            Time goes backwards.
        """
        if row.time_s <= self._time_s:
            raise ValueError(f"Input time_s must increase; instead {row.time_s} s follows {self._time_s} s.")
        dt_s, self._time_s = row.time_s - self._time_s, row.time_s
        index, self._n_rows = self._n_rows, self._n_rows + 1
        if self._x is None:
            return self._acquired(row, index)
        x, F, S_q = self.motion.step(self._x, dt_s)
        S = predict_square_root(self._S, F, S_q)
        prediction = Prediction(x, S, F)
        differences = self.differences_of(row)
        if not differences.n_differences:
            return self._kept(row, index, x, S, prediction, status="predicted")
        if self._range_error(x, S, row) > _REFIX_RANGE_ERROR:
            # The prediction says too little for an iteration to start from it.
            self._x = None
            point = self._acquired(row, index, near=(x, S))
            if point.position_m is None and self._range_error(x, S, row) <= _LARGEST_RANGE_ERROR:
                return self._kept(row, index, x, S, prediction, status="predicted")
            return point
        measurement = _WorldMeasurement(self.array_of(row), differences, row)
        sigma = np.sqrt(differences.variance)
        update = iterated_update(
            x,
            S,
            measurement.z / sigma,
            np.ones(sigma.size),
            lambda state: measurement.predicted(state) / sigma,
            lambda state: measurement.jacobian(state) / sigma[:, None],
            tolerance=_TOLERANCE,
            max_iterations=_MOST_ITERATIONS,
        )
        if not update.converged or update.nis > chdtri(sigma.size, _CONTRADICTION):
            self._contradictions += 1
            if self._contradictions >= _ROWS_TO_LOSE:
                self._x = None
                return self._acquired(row, index)
            return self._kept(row, index, x, S, prediction, status="outlier", nis=update.nis, nis_dof=sigma.size)
        self._contradictions = 0
        return self._kept(
            row,
            index,
            update.x,
            update.S,
            prediction,
            status="tracked",
            nis=update.nis,
            nis_dof=sigma.size,
            iterations=update.iterations,
        )

    def run(self, rows: Iterable[Row], progress: Callable[[int], None] | None = None) -> Iterator[TrackPoint]:
        """Points of successive rows."""
        for row in rows:
            yield self.advance(row)
            if progress is not None:
                progress(1)

    @property
    def is_tracking(self) -> bool:
        """Whether the next row continues a track."""
        return self._x is not None

    def state(self) -> tuple[FloatArray, FloatArray, int]:
        """Copies of the state and its square root, and the number of contradicting rows before the next one."""
        if self._x is None:
            raise RuntimeError("The tracker has no track, and so no state.")
        return self._x.copy(), self._S.copy(), self._contradictions

    def resume(self, x: FloatArray, S: FloatArray, time_s: float, contradictions: int, steps: Sequence[Step]) -> None:
        """Go on from where compiled steps ended."""
        self._x, self._S, self._time_s, self._contradictions = x, S, time_s, contradictions
        self._n_rows += len(steps)
        if self.keep_steps:
            self.steps += steps

    def _kept(
        self,
        row: Row,
        index: int,
        x: FloatArray,
        S: FloatArray,
        prediction: Prediction,
        *,
        status: str,
        nis: float = math.nan,
        nis_dof: int = 0,
        iterations: int = 0,
    ) -> TrackPoint:
        if self._range_error(x, S, row) > _LARGEST_RANGE_ERROR:
            self._x = None
            return TrackPoint(row.time_s, nis=nis, nis_dof=nis_dof, status="lost: the range is no longer known")
        self._x, self._S = x, S
        if self.keep_steps:
            self.steps.append(Step(index, prediction, x, S))
        return TrackPoint(
            row.time_s,
            x[:3].copy(),
            x[3:6].copy(),
            (S @ S.T)[:N_SOURCE, :N_SOURCE],
            estimability(S, prediction.S)[:N_SOURCE],
            iterations,
            nis,
            nis_dof,
            status,
        )

    def _acquired(self, row: Row, index: int, near: tuple[FloatArray, FloatArray] | None = None) -> TrackPoint:
        """A new track from the fix of one row, if its range is known."""
        solution, reason, fix = None, "not acquired: one row does not determine the source", Fix(())
        if self._locator is not None:
            ambient = None if row.ambient_T is None else row.ambient_T[None]
            (fix,) = self._locator.fit_rows(row.readings_T[None], ambient)
            centroid = row.origin_m + row.R_world_from_array @ self.array.centroid
            solution, reason = _start(_in_world(fix, row), centroid, near)
        if solution is None:
            solution = self._start_from_recent(row, fix)
        if solution is None:
            return TrackPoint(row.time_s, status=reason)
        source = np.concatenate([solution.position_m, solution.moment_Am2])
        covariance = solution.covariance
        self._recent.clear()
        self._rows_untracked = 0
        self._proposed = None
        self._x, self._S = self.motion.start(source, symmetric_square_root(covariance))
        self._contradictions = 0
        if self.keep_steps:
            self.steps.append(Step(index, None, self._x, self._S))
        return TrackPoint(
            row.time_s,
            source[:3].copy(),
            source[3:].copy(),
            covariance,
            np.ones(N_SOURCE),
            solution.iterations,
            status="acquired",
        )

    def _start_from_recent(self, row: Row, alone: Fix) -> Solution | None:
        """A start from the latest rows together, while the source is as good as at rest in them.

        That is a matter of its characteristic speed, and of how far away it is; where the array itself moves and one
        row says nothing of that (`alone` is its fix), it is tried.
        """
        self._recent.append(row)
        self._rows_untracked += 1
        if self._rows_untracked % _TRY_EVERY:
            return None
        recent = list(self._recent)
        if alone.solutions:
            centroid = row.R_world_from_array @ self.array.centroid
            range_m = float(np.linalg.norm(row.R_world_from_array @ alone.solutions[0].position_m - centroid))
            time_s = _AT_REST * range_m / self.motion.speed_m_s
            recent = [earlier for earlier in recent if row.time_s - earlier.time_s <= time_s]
        elif np.ptp([earlier.origin_m for earlier in recent], axis=0).max() <= self.array.circumradius:
            return None
        if len(recent) < 2:
            return None
        chosen = recent[:: -max(1, len(recent) // _STACKED_ROWS)]
        known = [earlier.ambient_T for earlier in chosen if earlier.ambient_T is not None]
        fix = stacked_fix(
            self.array,
            np.stack([earlier.readings_T for earlier in chosen]),
            np.stack([earlier.origin_m for earlier in chosen]),
            np.stack([earlier.R_world_from_array for earlier in chosen]),
            np.stack(known) if len(known) == len(chosen) else None,
        )
        centroid = row.origin_m + row.R_world_from_array @ self.array.centroid
        before, self._proposed = self._proposed, _start(fix, centroid, None)[0]
        return self._proposed if _agree(before, self._proposed) else None

    def _range_error(self, x: FloatArray, S: FloatArray, row: Row) -> float:
        """Standard deviation of the range over the range."""
        offset = x[:3] - row.origin_m - row.R_world_from_array @ self.array.centroid
        square = float(offset @ offset)
        along = offset @ S[:3]
        return math.sqrt(float(along @ along)) / square if square > 0.0 else math.inf

    def array_of(self, row: Row) -> SensorArray:
        """The array with the ambient field of a row."""
        if row.ambient_T is None:
            return self.array
        x, y, z = row.ambient_T.tolist()
        return replace(self.array, ambient_T=(x, y, z))

    def differences_of(self, row: Row) -> Differences:
        """The independent differences that a row's readings give."""
        available = np.isfinite(row.readings_T)
        if self.array.noise_depends_on_reading:
            covariance = reading_covariance(self.array_of(row), row.readings_T)
            return decorrelated_differences(self.array, available, covariance_T2=covariance)
        key = available.tobytes()
        if key not in self._differences:
            self._differences[key] = decorrelated_differences(self.array, available)
        return self._differences[key]


def _in_world(fix: Fix, row: Row) -> Fix:
    """A fix of one row in the world frame."""
    R, R6 = row.R_world_from_array, np.kron(np.eye(2), row.R_world_from_array)
    solutions = (
        replace(
            solution,
            position_m=row.origin_m + R @ solution.position_m,
            moment_Am2=R @ solution.moment_Am2,
            covariance=R6 @ solution.covariance @ R6.T,
        )
        for solution in fix.solutions
    )
    return replace(fix, solutions=tuple(solutions))


def _start(fix: Fix, centroid: FloatArray, near: tuple[FloatArray, FloatArray] | None) -> tuple[Solution | None, str]:
    """The solution that a track starts from, the nearest one to a prediction, or why there is none."""
    if not fix.solutions:
        return None, f"not acquired: {fix.reason}"
    solutions = fix.solutions
    if near is not None:
        x, S = near
        inverse = np.linalg.pinv(S[:3] @ S[:3].T)
        offsets = [solution.position_m - x[:3] for solution in solutions]
        cost = [s.chi2 + float(o @ inverse @ o) for s, o in zip(solutions, offsets, strict=True)]
        solutions = tuple(solutions[i] for i in np.argsort(cost, kind="stable"))
    best = solutions[0]
    if best.dof > 0 and best.chi2 > chdtri(best.dof, _CONTRADICTION):
        return None, "not acquired: no dipole fits the readings"
    if not best.range_observable:
        return None, "not acquired: the range is not observable"
    offset = best.position_m - centroid
    variance = float(offset @ best.covariance[:3, :3] @ offset)
    if math.sqrt(variance) > _START_RANGE_ERROR * float(offset @ offset):
        return None, "not acquired: the range is not certain enough"
    if near is None and any(solution.chi2 < best.chi2 + _RIVAL_WITHIN for solution in solutions[1:]):
        return None, "not acquired: several solutions fit alike"
    return best, ""


def _agree(before: Solution | None, after: Solution | None) -> bool:
    """Whether two successive proposals for a start are one: a wrong basin seldom stays where it is as rows come in."""
    if before is None or after is None:
        return False
    offset = after.position_m - before.position_m
    both = before.covariance[:3, :3] + after.covariance[:3, :3]
    return bool(offset @ np.linalg.solve(both, offset) < chdtri(3, _DISAGREEMENT))


class _WorldMeasurement:
    """Differences of one row as a function of the state in the world frame."""

    def __init__(self, array: SensorArray, differences: Differences, row: Row) -> None:
        self._model = DifferenceMeasurement(array, differences)
        self._origin, self._R = row.origin_m, row.R_world_from_array
        self.z = self._model.measured(row.readings_T)

    def _in_array(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self._R.T @ (state[:3] - self._origin), self._R.T @ state[3:6]

    def predicted(self, state: FloatArray) -> FloatArray:
        """Predicted differences (k,) [T]."""
        return self._model.predicted(*self._in_array(state))

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Their Jacobian (k, n)."""
        H = self._model.jacobian(*self._in_array(state))
        full = np.zeros((len(H), state.size))
        full[:, :3], full[:, 3:6] = H[:, :3] @ self._R.T, H[:, 3:] @ self._R.T
        return full


def track_record(
    tracker: Tracker, rows: Sequence[Row], progress: Callable[[int], None] | None = None
) -> list[TrackPoint]:
    """Points of a whole record: as :meth:`Tracker.run`, with compiled steps wherever the motion is linear.

    Parameters
    ----------
    tracker : Tracker
    rows : sequence of Row
    progress : callable, optional
        Called with the number of rows finished since the last call.

    Returns
    -------
    list of TrackPoint
    """
    points: list[TrackPoint] = []
    compiled = _CompiledSteps(tracker, rows) if isinstance(tracker.motion, LinearMotion) and rows else None
    while len(points) < len(rows):
        before = len(points)
        if compiled is not None and tracker.is_tracking:
            points += compiled.follow(before)
        if len(points) < len(rows):
            points.append(tracker.advance(rows[len(points)]))
        if progress is not None:
            progress(len(points) - before)
    return points


class _CompiledSteps:
    """A record in the layout of :func:`magloc.kernels.tracks.follow`."""

    def __init__(self, tracker: Tracker, rows: Sequence[Row]) -> None:
        array, motion = tracker.array, tracker.motion
        if not isinstance(motion, LinearMotion):
            raise TypeError("Input tracker must have a linear motion; instead received one that is not.")
        self.tracker = tracker
        self.times = [row.time_s for row in rows]
        differences = [tracker.differences_of(row) for row in rows]
        distinct = {id(of_row): of_row for of_row in differences}
        index = {key: i for i, key in enumerate(distinct)}
        k = max(1, *(of_row.n_differences for of_row in distinct.values()))
        self.transforms = np.zeros((len(distinct), k, array.n_channels))
        for i, of_row in enumerate(distinct.values()):
            self.transforms[i, : of_row.n_differences] = of_row.transform / np.sqrt(of_row.variance)[:, None]
        self.transform_of_row = np.array([index[id(of_row)] for of_row in differences])
        self.n_differences = np.array([of_row.n_differences for of_row in differences])
        channels = np.nan_to_num(np.stack([row.readings_T for row in rows]) - array.channel_offset_T)
        self.z = (self.transforms[self.transform_of_row] @ channels[..., None])[..., 0]
        self.origins = np.stack([row.origin_m for row in rows])
        self.rotations = np.stack([row.R_world_from_array for row in rows])
        self.ambients, self.ambient_of_row = array.ambient_fields[None], np.zeros(len(rows), dtype=np.int64)
        if any(row.ambient_T is not None for row in rows):
            own = np.zeros(3) if array.ambient_T is None else np.asarray(array.ambient_T)
            of_rows = np.stack([own if row.ambient_T is None else row.ambient_T for row in rows])
            self.ambients, self.ambient_of_row = ambient_fields(array, len(rows), of_rows), np.arange(len(rows))
        lengths, self.step_of_row = np.unique(np.diff(self.times, prepend=self.times[0]), return_inverse=True)
        steps = [motion.linear_step(max(length, 0.0)) for length in lengths.tolist()]
        self.F, self.A, self.B = (np.stack(part) for part in zip(*steps, strict=True))
        self.nis_limits = np.asarray(chdtri(np.maximum(np.arange(k + 1), 1), _CONTRADICTION), dtype=np.float64)
        n = motion.n_states
        self.x, self.predicted_x = np.empty((2, len(rows), n))
        self.S, self.predicted_S = np.empty((2, len(rows), n, n))
        self.nis = np.full(len(rows), np.nan)
        self.iterations, self.status = np.zeros((2, len(rows)), dtype=np.int64)

    def follow(self, begin: int) -> list[TrackPoint]:
        """Points from a row to the one before the first that has to be acquired, or that goes back in time."""
        tracker, array, times = self.tracker, self.tracker.array, self.times
        x, S, contradictions = tracker.state()
        end, contradictions = kernels.follow(
            begin,
            next((i for i in range(max(begin, 1), len(times)) if times[i] <= times[i - 1]), len(times)),
            x,
            S,
            contradictions,
            self.z,
            self.n_differences,
            self.transforms,
            self.transform_of_row,
            self.origins,
            self.rotations,
            self.ambients,
            self.ambient_of_row,
            self.F,
            self.A,
            self.B,
            self.step_of_row,
            array.positions,
            array.centroid,
            array.channel_sensor,
            array.channel_is_scalar,
            array.channel_gain,
            self.nis_limits,
            _TOLERANCE,
            _MOST_ITERATIONS,
            _ROWS_TO_LOSE,
            _REFIX_RANGE_ERROR,
            _LARGEST_RANGE_ERROR,
            self.x,
            self.S,
            self.predicted_x,
            self.predicted_S,
            self.nis,
            self.iterations,
            self.status,
        )
        if end == begin:
            return []
        steps = [
            Step(
                i,
                Prediction(self.predicted_x[i], self.predicted_S[i], self.F[self.step_of_row[i]]),
                self.x[i],
                self.S[i],
            )
            for i in range(begin, end)
        ]
        tracker.resume(x, S, times[end - 1], contradictions, steps)
        roots, predicted = self.S[begin:end], self.predicted_S[begin:end]
        covariance = (roots @ roots.swapaxes(-1, -2))[:, :N_SOURCE, :N_SOURCE]
        learned = estimability(roots, predicted)[:, :N_SOURCE]
        return [
            TrackPoint(
                times[i],
                self.x[i, :3],
                self.x[i, 3:6],
                covariance[i - begin],
                learned[i - begin],
                int(self.iterations[i]),
                float(self.nis[i]),
                int(self.n_differences[i]),
                _STATUS[int(self.status[i])],
            )
            for i in range(begin, end)
        ]


def rows_of(
    time_s: FloatArray,
    readings_T: FloatArray,
    array_position_m: FloatArray | None = None,
    array_rotation_xyzw: FloatArray | None = None,
    ambient_T: FloatArray | None = None,
) -> Iterator[Row]:
    """Rows of readings for a tracker, from columns as :class:`magloc.readings.Readings` has them."""
    rotations = None if array_rotation_xyzw is None else Rotation.from_quat(array_rotation_xyzw).as_matrix()
    for i, time in enumerate(time_s.tolist()):
        row = Row(time, readings_T[i], ambient_T=None if ambient_T is None else ambient_T[i])
        if array_position_m is not None and rotations is not None:
            row = replace(row, origin_m=array_position_m[i], R_world_from_array=rotations[i])
        yield row


def smoothed(points: list[TrackPoint], steps: list[Step]) -> list[TrackPoint]:
    """Points of a finished record with what later rows tell as well: a fixed-interval smoother over every track.

    Rauch, Tung and Striebel's recursion on the filter's steps: its gain is :math:`P F^T P_{pred}^{-1}`.

    Parameters
    ----------
    points : list of TrackPoint
        Of every row.
    steps : list of Step
        Of the tracker that made them.

    Returns
    -------
    list of TrackPoint
    """
    result = list(points)
    x, P = np.empty(0), np.empty((0, 0))
    after: Step | None = None
    for step in reversed(steps):
        later_x, later_P = x, P
        x, P = step.x, step.S @ step.S.T
        if after is not None and after.prediction is not None:
            predicted = after.prediction
            predicted_P = predicted.S @ predicted.S.T
            # States of mixed units: solve with the correlations.
            scale = np.sqrt(np.diagonal(predicted_P))
            correlation = predicted_P / np.outer(scale, scale)
            gain = np.linalg.solve(correlation, (predicted.F @ P) / scale[:, None]).T / scale
            x = x + gain @ (later_x - predicted.x)
            P = P + gain @ (later_P - predicted_P) @ gain.T
            P = 0.5 * (P + P.T)
        after = step
        point = points[step.row]
        if point.position_m is not None:
            covariance = P[:N_SOURCE, :N_SOURCE]
            result[step.row] = replace(point, position_m=x[:3], moment_Am2=x[3:6], covariance=covariance)
    return result
