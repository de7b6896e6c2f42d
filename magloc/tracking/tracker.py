r"""One dipole through time: an iterated extended Kalman filter that starts by itself, and says when it is lost.

A track is acquired from a start-free fix (:mod:`magloc.tracking.acquisition`), followed by
:func:`magloc.kalman.iterated_update` with a :class:`magloc.tracking.motion.MotionModel`, and given up when the readings
contradict it or the range is no longer known; then it is acquired anew. The state is in the world frame where the
array's pose is known, else in the array's. Behind the states of the motion stand the lasting errors that the array
states of its sensors (:mod:`magloc.measurement.nuisances`), and those of its pose (:mod:`magloc.measurement.pose`):
also those that are new in every row, so that the readings are modelled at the pose that they tell of.

This module is the readable form; :mod:`magloc.tracking.batch` steps long records, and a test holds the two together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.ambient import in_world_field
from magloc.blas_threads import one_blas_thread
from magloc.kalman import (
    block_update,
    estimability,
    iterated_update,
    normalised_innovation_squared,
    predict_square_root,
    symmetric_square_root,
)
from magloc.levels import CONTRADICTION
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import Solution
from magloc.measurement.nuisances import Drift
from magloc.readings import Readings, without_saturated
from magloc.tracking.acquisition import CONFIRMED_RANGE_ERROR, STACKED_POSITION_ERROR, Acquisition
from magloc.tracking.measurement import RowMeasurement, RowMeasurements
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.results import Innovation, Prediction, Row, Step, TrackPoint, moving, rows_of

Prior = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
ROWS_TO_LOSE = 3
"""Contradicting rows in a row that end a track."""
REFIX_RANGE_ERROR = 0.15
"""A prediction whose range is less certain, σ over range, is replaced by a fix, if there is one."""
LARGEST_RANGE_ERROR = 0.4
"""A track whose range is less certain is lost."""
TOLERANCE = 1e-4
"""Stop of the iteration, in standard deviations of the differences: equation (19)."""
MOST_ITERATIONS = 50
SHRINK = 0.5
"""Of steps that swing: see :func:`magloc.kalman.iterated_update`."""
LARGEST_GROWTH = 1.5
"""A prediction bends as the readings do while no standard deviation grows by more in the step: beyond that it is the
motion that it is uncertain of, which is Gaussian in Cartesian coordinates."""
# How often the rows that a track starts from are linearised anew, until they move it by less than a share of its σ.
_MOST_START_STEPS = 30
_START_TOLERANCE = 1e-3
# How much less is known of a source before them than after, in standard deviations.
_UNKNOWN = 1e4


@dataclass(frozen=True, eq=False)
class FilteredStart:
    """State at the start of a track, square root of its covariance, χ² of the rows, and the state at each of them."""

    x: FloatArray
    S: FloatArray
    chi2: float
    of_rows: Sequence[FloatArray] = ()


class Tracker:
    """Follows one dipole, row by row.

    Parameters
    ----------
    array : SensorArray
    motion : MotionModel
    prior : SourcePrior
        Bounds for the fixes that start a track, in the array's frame.
    keep_steps : bool
        Keep what a smoother needs, in `steps`.
    background : Drift, optional
        States of every channel beside the source; rows do not start a track then, but :func:`magloc.track` does.

    Attributes
    ----------
    measurements : RowMeasurements
        What rows say of the state.
    errors : SensorErrors
        The lasting errors of the array's sensors, whose states follow those of the motion.
    pose_errors : PoseErrors
        Those of its pose, behind them.
    steps : list of Step
        Of all tracks so far, if `keep_steps`.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> motion = magloc.RandomWalk(speed_m_s=0.1, turn_rad_s=0.01)
    >>> tracker = magloc.Tracker(diver.array, motion)
    >>> tracker.update(diver.readings[0]).status
    'not acquired: the range is not observable'
    """

    def __init__(
        self,
        array: SensorArray,
        motion: MotionModel,
        *,
        prior: SourcePrior = NOTHING_KNOWN,
        keep_steps: bool = False,
        background: Drift | None = None,
    ) -> None:
        self.array = array
        self.motion = motion
        self.prior = prior
        self.background = background
        self.measurements = RowMeasurements(array, motion.n_states, background)
        self.errors, self.pose_errors = self.measurements.errors, self.measurements.pose_errors
        self.keep_steps = keep_steps
        self.steps: list[Step] = []
        self._acquisition = Acquisition(array, prior, motion.speed_m_s)
        self._x: FloatArray | None = None
        self._S: FloatArray = np.zeros((0, 0))
        self._time_s = math.nan
        self._contradictions = 0
        self._n_rows = 0
        self._weight = math.nan
        self._last: Innovation | None = None
        self._row_before: Row | None = None

    @one_blas_thread
    def update(self, row: Row | Readings) -> TrackPoint:
        """What is known of the source after one more row.

        Parameters
        ----------
        row : Row or Readings of length one
            Later than the one before. Of readings those that saturate are not used.

        Raises
        ------
        ValueError
            Time goes backwards, or the readings are not one row.
        """
        if isinstance(row, Readings):
            if len(row) != 1:
                raise ValueError(f"Input row must be readings of length one; instead received {len(row)} rows.")
            row = next(rows_of(in_world_field(without_saturated(row, self.array), self.array)))
        if row.time_s <= self._time_s:
            raise ValueError(f"Input time_s must increase; instead {row.time_s} s follows {self._time_s} s.")
        if self.pose_errors.n_states:
            row, self._row_before = moving(row, self._row_before), row
        dt_s, self._time_s = row.time_s - self._time_s, row.time_s
        index, self._n_rows = self._n_rows, self._n_rows + 1
        if self._x is None:
            return self._acquired(row, index)
        prediction = self.predicted(self._x, self._S, dt_s)
        x, S = prediction.x, prediction.S
        measurement = self.measurements.of(row)
        if not measurement.z.size:
            return self._kept(measurement, index, x, S, prediction, status="predicted")
        if self._range_error(x, S, measurement) > REFIX_RANGE_ERROR:
            # The prediction says too little for an iteration to start from it.
            self._x = None
            point = self._acquired(row, index, near=(x, S))
            if point.position_m is None and self._range_error(x, S, measurement) <= LARGEST_RANGE_ERROR:
                return self._kept(measurement, index, x, S, prediction, status="predicted")
            return point
        k = measurement.z.size
        update = iterated_update(
            x,
            S,
            measurement.z,
            np.ones(k),
            measurement.predicted,
            measurement.jacobian,
            tolerance=TOLERANCE,
            max_iterations=MOST_ITERATIONS,
            shrink=SHRINK,
            prior=self.curved_prior(measurement, x, S, dt_s),
        )
        innovation = Innovation(row.available, update.whitened)
        if not update.converged or update.nis > chdtri(k, CONTRADICTION):
            self._contradictions += 1
            if self._contradictions >= ROWS_TO_LOSE:
                self._x = None
                return self._acquired(row, index)
            return self._kept(measurement, index, x, S, prediction, status="outlier", innovation=innovation)
        self._contradictions = 0
        return self._kept(
            measurement,
            index,
            update.x,
            update.S,
            prediction,
            status="tracked",
            innovation=innovation,
            iterations=update.iterations,
        )

    def run(
        self, rows: Iterable[Row | Readings], progress: Callable[[int], None] | None = None
    ) -> Iterator[TrackPoint]:
        """Points of successive rows."""
        for row in rows:
            yield self.update(row)
            if progress is not None:
                progress(1)

    @property
    def weight(self) -> float:
        """How likely the present track is among those that could have been started."""
        return self._weight

    @property
    def time_s(self) -> float:
        """Of the last row, NaN before the first."""
        return self._time_s

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

    @property
    def n_errors(self) -> int:
        """States behind those of the motion: errors of sensors and of the pose."""
        return self.errors.n_states + self.pose_errors.n_states

    @property
    def error_sigma(self) -> FloatArray:
        """Their standard deviations before anything is known (n_errors,)."""
        return np.concatenate([self.errors.sigma, np.ones(self.pose_errors.n_states)])

    def error_step(self, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """What remains of every error after a step, and the standard deviation of what is added: (n_errors,) each."""
        of_sensors, of_pose = self.errors.step(dt_s), self.pose_errors.step(dt_s)
        return np.concatenate([of_sensors[0], of_pose[0]]), np.concatenate([of_sensors[1], of_pose[1]])

    def predicted(self, x: FloatArray, S: FloatArray, dt_s: float) -> Prediction:
        """State, square root of its covariance and transition after a step without readings."""
        n, n_errors = self.motion.n_states, self.n_errors
        moved, F_motion, S_q_motion = self.motion.step(x[:n], dt_s)
        kept, added = self.error_step(dt_s)
        noisy = np.flatnonzero(added)
        F, S_q = np.zeros((n + n_errors,) * 2), np.zeros((n + n_errors, S_q_motion.shape[1] + noisy.size))
        F[:n, :n], S_q[:n, : S_q_motion.shape[1]] = F_motion, S_q_motion
        F[n + np.arange(n_errors), n + np.arange(n_errors)] = kept
        S_q[n + noisy, S_q_motion.shape[1] + np.arange(noisy.size)] = added[noisy]
        return Prediction(np.concatenate([moved, kept * x[n:]]), predict_square_root(S, F, S_q), F)

    def curved_prior(self, measurement: RowMeasurement, x: FloatArray, S: FloatArray, dt_s: float) -> Prior | None:
        """What a prediction (x, S) is Gaussian in; None: in Cartesian coordinates.

        Errors of the pose bend them by what has lasted of them since the row before: place and moment are known with
        those, and independently of what is new.
        """
        of_readings = _is_of_readings(self._S, S)
        if self.pose_errors.n_states:
            measurement = measurement.with_lasting_errors(self.pose_errors.step(dt_s)[0] ** 2)
        elif not of_readings:
            return None
        return measurement.curved_prior(x, S, of_readings=of_readings)

    def start(self, source: FloatArray, covariance: FloatArray, rows: Sequence[Row]) -> FilteredStart | None:
        """State at the last of the rows that a source (6,) was found from, as if at rest, with a covariance (6, 6).

        The rows are filtered once more, from a source that is hardly known, until they are linearised where they lead:
        what moves between them, and the errors of sensors that they have in common, are counted as in the rows to come.
        None where that does not converge, or they contradict each other then.
        """
        if len(rows) == 1 and not self.n_errors:
            return FilteredStart(*self.motion.start(source, symmetric_square_root(covariance)), 0.0)
        measurements = [self.measurements.of(row) for row in rows]
        dof = sum(measurement.z.size for measurement in measurements) - N_SOURCE
        n, n_errors = self.motion.n_states, self.n_errors
        centres = [np.concatenate([source, np.zeros(n - N_SOURCE + n_errors)])] * len(rows)
        # Errors of the pose that change are linearised as each row knows them, everything else as all rows together.
        own = np.concatenate([np.zeros(n + self.errors.n_states, dtype=bool), self.pose_errors.changes])
        for _ in range(_MOST_START_STEPS):
            found = self.filtered_start(centres, covariance, measurements)
            step = (found.x - centres[-1])[:N_SOURCE]
            centres = [np.where(own, of_row, found.x) for of_row in found.of_rows]
            if np.all(np.abs(step) < _START_TOLERANCE * np.linalg.norm(found.S[:N_SOURCE], axis=1)):
                return found if dof <= 0 or found.chi2 < chdtri(dof, CONTRADICTION) else None
        return None

    def filtered_start(
        self, centres: Sequence[FloatArray], covariance: FloatArray, measurements: Sequence[RowMeasurement]
    ) -> FilteredStart:
        """One pass of :meth:`start`, with the readings of every row linearised at a state (n,)."""
        n, n_errors = self.motion.n_states, self.n_errors
        x, S = np.zeros(n + n_errors), np.zeros((n + n_errors,) * 2)
        unknown = np.diag(_UNKNOWN * np.sqrt(np.diagonal(covariance)))
        x[:n], S[:n, :n] = self.motion.start(centres[0][:N_SOURCE], unknown)
        S[n + np.arange(n_errors), n + np.arange(n_errors)] = self.error_sigma
        chi2, of_rows = 0.0, []
        for j, (measurement, centre) in enumerate(zip(measurements, centres, strict=True)):
            if j:
                prediction = self.predicted(x, S, measurement.row.time_s - measurements[j - 1].row.time_s)
                x, S = prediction.x, prediction.S
            H, ones = measurement.jacobian(centre), np.ones(measurement.z.size)
            innovation = measurement.z - measurement.predicted(centre) - H @ (x - centre)
            chi2 += normalised_innovation_squared(S, H, innovation, ones)
            x, S = block_update(x, S, H, innovation, ones)
            of_rows.append(x)
        return FilteredStart(x, S, chi2, of_rows)

    def _kept(
        self,
        measurement: RowMeasurement,
        index: int,
        x: FloatArray,
        S: FloatArray,
        prediction: Prediction,
        *,
        status: str,
        innovation: Innovation | None = None,
        iterations: int = 0,
    ) -> TrackPoint:
        row = measurement.row
        tracked = status == "tracked"
        told = {} if innovation is None else innovation.after(self._last if tracked else None)
        self._last = innovation if tracked else None
        if self._range_error(x, S, measurement) > LARGEST_RANGE_ERROR:
            self._x = None
            return replace(self._lost(row, "lost: the range is no longer known"), **told)
        self._x, self._S = x, S
        if self.keep_steps:
            self.steps.append(Step(index, prediction, x, S))
        learned = estimability(S, prediction.S)[:N_SOURCE]
        return replace(self._tracked(row, x, S, learned, iterations, status), **told)

    def _tracked(
        self, row: Row, x: FloatArray, S: FloatArray, learned: FloatArray, iterations: int, status: str
    ) -> TrackPoint:
        """What is known of a row with a track."""
        covariance = S[:N_SOURCE] @ S[:N_SOURCE].T
        return TrackPoint(
            row.time_s,
            x[:3].copy(),
            x[3:6].copy(),
            covariance,
            learned,
            iterations,
            status=status,
            weight=self._weight,
            centroid_m=self.centroid(row),
            radius_m=self.array.circumradius,
        )

    def centroid(self, row: Row) -> FloatArray:
        """Of the sensors in the world frame, shape (3,)."""
        return row.origin_m + row.R_world_from_array @ self.array.centroid

    def _lost(self, row: Row, reason: str, rivals: tuple[Solution, ...] = ()) -> TrackPoint:
        """What is known of a row without a track."""
        return TrackPoint(
            row.time_s,
            status=reason,
            rivals=rivals,
            centroid_m=self.centroid(row),
            radius_m=self.array.circumradius,
        )

    def _acquired(self, row: Row, index: int, near: tuple[FloatArray, FloatArray] | None = None) -> TrackPoint:
        """A new track, if one can be started."""
        start, reason = self._acquisition.start(row, near)
        alone = self._acquisition.of_last_row.solutions
        if start is None:
            return self._lost(row, reason, alone)
        solution = start.solution
        source = np.concatenate([solution.position_m, solution.moment_Am2])
        found = self.start(source, solution.covariance, start.rows)
        if found is None:
            return self._lost(row, "not acquired: no dipole fits the latest rows together", alone)
        x, S = found.x, found.S
        measurement = self.measurements.of(row)
        certain = self._range_error(x, S, measurement) <= CONFIRMED_RANGE_ERROR
        if len(start.rows) > 1:
            offset, root = measurement.place_in_array(x, S)
            certain = float(np.linalg.norm(root)) <= STACKED_POSITION_ERROR * float(np.linalg.norm(offset))
        if not certain:
            return self._lost(row, "not acquired: the range is not certain enough", alone)
        self._acquisition.forget()
        self._x, self._S, self._last = x, S, None
        self._contradictions = 0
        self._weight = solution.weight
        if self.keep_steps:
            self.steps.append(Step(index, None, x, S))
        learned = np.ones(N_SOURCE)
        return replace(self._tracked(row, x, S, learned, solution.iterations, "acquired"), rivals=start.rivals)

    def _range_error(self, x: FloatArray, S: FloatArray, measurement: RowMeasurement) -> float:
        """Standard deviation of the range over the range."""
        offset, root = measurement.place_in_array(x, S)
        square = float(offset @ offset)
        along = offset @ root
        return math.sqrt(float(along @ along)) / square if square > 0.0 else math.inf


def _is_of_readings(S: FloatArray, S_predicted: FloatArray) -> bool:
    """Whether what a prediction knows of a source is mostly what readings told, not what the motion leaves of it."""
    before, after = (np.linalg.norm(root[:N_SOURCE], axis=1) for root in (S, S_predicted))
    return bool(np.all(after <= LARGEST_GROWTH * before))
