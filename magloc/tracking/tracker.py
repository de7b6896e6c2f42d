r"""One dipole through time: an iterated extended Kalman filter from the first row in which the source is seen.

What is known of the source is a mixture of Gaussians in the coordinates of :mod:`magloc.tracking.coordinates`,
soon a single one (:mod:`magloc.tracking.chart.steps`), moved by a :class:`magloc.tracking.motion.MotionModel`. A track
ends when the readings contradict it or its place is no longer known; then it starts anew. The state is in the world
frame where the array's pose is known, else in the array's. Behind the states of the motion stand the lasting errors
of the array's pose (:mod:`magloc.measurement.pose`) and those of its sensors (:mod:`magloc.measurement.nuisances`).
Errors of the pose that are new in every row are states, too: the readings are modelled at the pose that they tell of.
Positions, moments and steps for smoothing are Cartesian.

Rows of a settled track are stepped by :mod:`magloc.tracking.settled` in one compiled call, all others here; a test
holds the two together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.nuisances import Drift
from magloc.readings import Readings
from magloc.tracking.acquisition import STACKED_POSITION_ERROR, Acquisition, CartesianFilter
from magloc.tracking.acquisition import Start as RowsStart
from magloc.tracking.chart.known_moment import KeptModulus
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.start import NO_DIPOLE, prior_root
from magloc.tracking.chart.steps import LARGEST_WIDTH, ChartFilter, Known, RowUpdate, cartesian, charted, width_of
from magloc.tracking.chart.undetermined import Undetermined
from magloc.tracking.measurement import RowMeasurement, RowMeasurements
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.results import UNDETERMINED, Innovation, Prediction, Step, TrackPoint, point_of_mixture
from magloc.tracking.rows import Row, next_row, with_array_motion
from magloc.tracking.sensor_health import SENSOR_LIMIT, SensorHealth, Suspects
from magloc.tracking.settled import MOST_AT_ONCE, SettledTrack

ROWS_TO_LOSE = 3
"""Contradicting rows in a row that end a track."""
LARGEST_RANGE_ERROR = LARGEST_WIDTH
"""A track whose range is less certain, σ over range, is lost."""


class Tracker(CartesianFilter):
    """Follows one dipole, row by row.

    Parameters
    ----------
    array : SensorArray
    motion : MotionModel
    prior : SourcePrior
        Bounds of the first row's source, and what its moment is known to be, in the array's frame.
    keep_steps : bool
        Keep what a smoother needs, in `steps`.
    background : Drift, optional
        States of every channel beside the source; rows do not start a track then, but :func:`magloc.track` does.

    Attributes
    ----------
    measurements : RowMeasurements
        What rows say of the state.
    errors : SensorErrors
        The lasting errors of the array's sensors: the last states.
    pose_errors : PoseErrors
        Those of its pose, between the states of the motion and them.
    steps : list of Step
        Of all tracks so far, if `keep_steps`.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> motion = magloc.RandomWalk(speed_m_s=0.1, turn_rad_s=0.01)
    >>> tracker = magloc.Tracker(diver.array, motion)
    >>> tracker.update(diver.readings[0]).status
    'not acquired: no signal stands out of noise'
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
        self.array, self.prior, self.background, self.keep_steps = array, prior, background, keep_steps
        self.measurements = RowMeasurements(array, motion.n_states, background)
        self.errors, self.pose_errors = self.measurements.errors, self.measurements.pose_errors
        self.steps: list[Step] = []
        self._acquisition = Acquisition(array, prior)
        self.filter = ChartFilter(array, self.errors, self.pose_errors, prior)
        self.motion = motion
        self._undetermined = Undetermined(self.filter)
        self._known: Known | None = None
        self._time_s, self._n_rows = math.nan, 0
        self._last: Innovation | None = None
        self._row_before: Row | None = None
        self._health, self._suspects = SensorHealth.of(array.n_sensors), Suspects.of(array.n_sensors)

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
        return self.advance([row])[0]

    def run(
        self, rows: Iterable[Row | Readings], progress: Callable[[int], None] | None = None
    ) -> Iterator[TrackPoint]:
        """Points of successive rows; those of a sequence some at once, see :meth:`advance`."""
        for part in [rows] if isinstance(rows, Sequence) else ([row] for row in rows):
            done = 0
            while done < len(part):
                points = self.advance(part[done : done + MOST_AT_ONCE])
                done += len(points)
                yield from points
                if progress is not None:
                    progress(len(points))

    def advance(self, rows: Sequence[Row | Readings]) -> list[TrackPoint]:
        """Points of the first of some rows: of as many as one compiled call takes, else of one; see :meth:`update`."""
        row = next_row(rows[0], self.array, self._time_s)
        if self._known is not None and self.is_compiled:
            assert self._settled is not None
            index = self._n_rows if self.keep_steps else None
            found = self._settled.follow(self._known, self._time_s, self._last, [row, *rows[1:]], index)
            if found is not None:
                points = found.points
                self.resume(found.known, points[-1].time_s, len(points), found.steps)
                self._last, self._row_before = found.innovation, found.last
                if found.innovation is not None:
                    self._suspects = self._suspects.forgotten(len(points))
                return points
        return [self._advanced(row)]

    def _advanced(self, row: Row) -> TrackPoint:
        """The point of a row by the readable steps."""
        if self.n_errors:
            row, self._row_before = with_array_motion(row, self._row_before), row
        dt_s, self._time_s = row.time_s - self._time_s, row.time_s
        index, self._n_rows = self._n_rows, self._n_rows + 1
        if self._known is None:
            out, point = self._started(row, index)
        else:
            out, point = self._followed(self._known, row, index, dt_s)
        return replace(point, dropped_sensors=tuple(np.array(self.array.ids)[out].tolist())) if out.any() else point

    @property
    def motion(self) -> MotionModel:
        """How the source moves: a modulus that is known stays."""
        return self._motion

    @motion.setter
    def motion(self, motion: MotionModel) -> None:
        self._motion = KeptModulus.of(motion, self.prior)
        self._settled = SettledTrack.of(self.array, self._motion, self.measurements, self.filter.n_differences)

    @property
    def known(self) -> Known | None:
        """What is known of the source before the next row; None without a track."""
        return self._known

    @property
    def time_s(self) -> float:
        """Of the last row, NaN before the first."""
        return self._time_s

    @property
    def is_tracking(self) -> bool:
        """Whether the next row continues a track that is no longer young, of one place and with all sensors."""
        return (known := self._known) is not None and known.is_settled and self._health.is_well

    @property
    def is_compiled(self) -> bool:
        """Whether the next row is stepped by compiled code, if it continues the track."""
        return self.is_tracking and self._settled is not None and not (self.keep_steps and self.n_errors)

    def resume(self, known: Known, time_s: float, n_rows: int = 0, steps: Sequence[Step] = ()) -> None:
        """Go on from what is known at a time, after so many rows more."""
        self._known, self._time_s, self._last = known, time_s, None
        self._n_rows += n_rows
        self.steps += steps

    def known_before(self, seen: RowMeasurement, x: FloatArray) -> FloatArray:
        """Covariance (n, n) of the motion's states of a source at x before its first row."""
        _, S = self.motion.start(x[:N_SOURCE], prior_root(seen.chart(x[:N_SOURCE])))
        return S @ S.T

    def open_loop(self, covariance: FloatArray, x: FloatArray, dt_s: float) -> FloatArray:
        """What becomes of it in a step from a state x in which no readings are taken."""
        _, F, S_q = self.motion.step(x[: self.motion.n_states], dt_s)
        return F @ covariance @ F.T + S_q @ S_q.T

    def _lost(self, row: Row, reason: str) -> TrackPoint:
        """What is known of a row without a track."""
        centroid_m = row.origin_m + row.R_world_from_array @ self.array.centroid
        return TrackPoint(row.time_s, status=reason, centroid_m=centroid_m, radius_m=self.array.circumradius)

    def _started(self, row: Row, index: int, near: Mixture | None = None) -> tuple[BoolArray, TrackPoint]:
        """A new track, if one can be started, and the sensors (N,) that were left out of the row."""
        self._known, out = None, self._health.dead
        seen = self._seen(row, out)
        if seen.z.size < N_SOURCE:
            return out, self._acquired(seen, index)
        mixture, reason = self.filter.started(seen, self.motion, near)
        if reason == NO_DIPOLE and (faulty := self.filter.faulty(seen)).sum() == 1:
            seen = self._seen(row, out | faulty)
            mixture, _ = self.filter.started(seen, self.motion, near)
            out = out if mixture is None else out | faulty
        if mixture is None:
            return out, self._lost(seen.row, reason)
        self._judge(row, out, lambda row: math.inf if self.filter.of_row(row, self.motion)[0] is None else 0.0)
        open_loop = self.known_before(seen, mixture.x[np.argmax(mixture.log_weight)])
        young = ((seen, self.motion),) if self.filter.has_lasting_errors else ()
        known = self.filter.refitted(Known(mixture, open_loop, young=young))
        return out, self._kept(seen.row, index, known, None, status="acquired")

    def _seen(self, row: Row, out: BoolArray) -> RowMeasurement:
        """What a row says without some of its sensors (N,)."""
        readings = np.where(out[self.array.channel_sensor], np.nan, row.readings_T)
        return self.measurements.of(replace(row, readings_T=readings) if out.any() else row)

    def _followed(self, before: Known, row: Row, index: int, dt_s: float) -> tuple[BoolArray, TrackPoint]:
        """A track after one more row, and the sensors (N,) that were left out of it."""
        dead = self._health.dead
        seen = self._seen(row, dead)
        predicted = self.filter.predict(before.mixture, self.motion, dt_s, seen)
        x = before.mixture.x[np.argmax(before.mixture.log_weight)]
        open_loop = self.open_loop(before.open_loop, x, dt_s)
        known = replace(before, mixture=predicted, open_loop=open_loop, used=before.used or before.mixture)
        prediction = self.predict(*cartesian(before.mixture), dt_s) if self.keep_steps else None
        if not seen.z.size:
            return dead, self._kept(seen.row, index, known, prediction, status="predicted")
        if width_of(predicted) > LARGEST_WIDTH:
            # The prediction says too little for an iteration to start from it.
            if self.filter.is_detected(seen):
                return self._started(row, index, predicted.matched())
            return dead, self._kept(seen.row, index, known, prediction, status="predicted")

        def updated(of_row: RowMeasurement) -> RowUpdate:
            return self.filter.updated(before, predicted, dt_s, of_row)

        update, out, of_sensor = updated(seen), dead, False
        if update.mixture is None:
            out, update, of_sensor = self._without_one(update, lambda out: updated(self._seen(row, out)))
            seen = self._seen(row, out)
        else:
            self._suspects = self._suspects.forgotten(1)
        innovation = Innovation(seen.row.available, update.innovation, update.correction)
        if update.mixture is None:
            contradictions = before.contradictions + (not of_sensor)
            if contradictions >= ROWS_TO_LOSE:
                return self._started(row, index)
            known = replace(known, contradictions=contradictions)
            point = self._kept(seen.row, index, known, prediction, status="outlier", innovation=innovation)
            return dead, replace(point, nis=update.nis)
        self._judge(row, out, lambda with_it: updated(with_it).nis - update.nis)
        known = replace(known, mixture=update.mixture, contradictions=0, used=None)
        if before.young:
            young = (*before.young, (seen, self.motion))
            known = self.filter.refitted(replace(known, young=young, nis=before.nis + update.nis))
        # A range that was known may be open again although every component is narrow.
        is_wide, is_open = width_of(known.mixture) > LARGEST_WIDTH, known.mixture.log_range_sigma > LARGEST_WIDTH
        is_detected = (is_wide or (is_open and known.has_range)) and self.filter.is_detected(seen)
        if is_wide and is_detected:
            return self._started(row, index, predicted.matched())
        known = replace(known, has_range=known.has_range or not is_open)
        return out, self._kept(
            seen.row,
            index,
            known,
            prediction,
            status="tracked",
            innovation=innovation,
            iterations=update.iterations,
            is_lost=is_open and known.has_range and not is_detected,
        )

    def _judge(self, row: Row, out: BoolArray, excess: Callable[[RowMeasurement], float]) -> None:
        """Count a row without some sensors (N,), and the χ² that each dead one with readings would add to it."""
        if self._health.is_well and not out.any():
            return
        of_dead, read = np.full(len(out), np.inf), np.unique(self.array.channel_sensor[row.available])
        for sensor in np.intersect1d(np.flatnonzero(self._health.dead), read):
            of_dead[sensor] = excess(self._seen(row, out & (np.arange(len(out)) != sensor)))
        self._health = self._health.after(np.full((len(out), 3), np.nan), out, of_dead)

    def _without_one(
        self, update: RowUpdate, updated: Callable[[BoolArray], RowUpdate]
    ) -> tuple[BoolArray, RowUpdate, bool]:
        """A row that contradicts a track without the one sensor that is at fault, and whether one may be."""
        dead, own = self._health.dead, np.eye(self.array.n_sensors, dtype=bool)
        found = {sensor: updated(dead | own[sensor]) for sensor in np.flatnonzero(~dead).tolist()}
        if all(one.mixture is None for one in found.values()):
            return dead, update, False
        chi2 = np.array([found[sensor].nis if sensor in found else np.inf for sensor in range(len(dead))])
        self._suspects = self._suspects.after(chi2)
        sensor = self._suspects.culprit
        if sensor is None or found[sensor].mixture is None or found[sensor].nis > update.nis - SENSOR_LIMIT:
            return dead, update, True
        return dead | own[sensor], found[sensor], True

    def _kept(
        self,
        row: Row,
        index: int,
        known: Known,
        prediction: Prediction | None,
        *,
        status: str,
        innovation: Innovation | None = None,
        iterations: int = 0,
        is_lost: bool = False,
    ) -> TrackPoint:
        mixture = known.mixture
        tracked = status == "tracked"
        told = {} if innovation is None else innovation.after(self._last if tracked else None)
        self._last = innovation if tracked else None
        if is_lost or (status != "acquired" and width_of(mixture) > LARGEST_WIDTH):
            self._known = None
            return replace(self._lost(row, "lost: the place is no longer known"), **told)
        self._known = known
        if self.keep_steps:
            self.steps.append(Step(index, prediction, *cartesian(mixture)))
        point = point_of_mixture(row.time_s, mixture, np.diagonal(known.open_loop))
        return replace(point, status=status, iterations=iterations, **told)

    def _acquired(self, seen: RowMeasurement, index: int) -> TrackPoint:
        """A new track from several rows of which one alone does not determine the source; else what this one says."""
        mixture, reason = self._undetermined.after(seen, self.motion)
        start = self._acquisition.start(seen.row, self._undetermined.position_error)
        known = None if start is None else self._found(start, seen)
        if start is None or known is None:
            return self._of_rows(mixture, reason, seen)
        self._acquisition.forget()
        self._undetermined.forget()
        point = self._kept(seen.row, index, known, None, status="acquired", iterations=start.solution.iterations)
        return replace(point, weight=start.solution.weight, rivals=start.rivals)

    def _found(self, start: RowsStart, seen: RowMeasurement) -> Known | None:
        """What is known of a source that several rows show, the last of them as it is seen, if it is known well."""
        source = np.concatenate([start.solution.position_m, start.solution.moment_Am2])
        found = self.start(source, start.solution.covariance, start.rows)
        if found is None:
            return None
        offset, root = seen.place_in_array(found.x, found.S)
        if float(np.linalg.norm(root)) > STACKED_POSITION_ERROR * float(np.linalg.norm(offset)):
            return None
        return Known(charted(found.x, found.S, seen), self.known_before(seen, found.x))

    def _of_rows(self, mixture: Mixture | None, reason: str, seen: RowMeasurement) -> TrackPoint:
        """What rows say that show a source, of which one alone does not determine it."""
        if mixture is None:
            return self._lost(seen.row, reason)
        heaviest = mixture.x[np.argmax(mixture.log_weight)]
        point = point_of_mixture(seen.row.time_s, mixture, np.diagonal(self.known_before(seen, heaviest)))
        return replace(point, status=UNDETERMINED)
