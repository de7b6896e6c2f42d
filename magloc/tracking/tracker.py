r"""Iterated extended Kalman filter of one dipole, from the first row that shows the source.

The state is a mixture of Gaussians in the coordinates of :mod:`magloc.tracking.coordinates`, soon a single one
(:mod:`magloc.tracking.chart.steps`). A :class:`magloc.tracking.motion.MotionModel` predicts it. A track ends if the
readings contradict it or its place is no longer known; then a new one starts. The state is in the world frame if the
array's pose is known, otherwise in the array's frame. The states of the motion are followed by the lasting errors of
the array's pose (:mod:`magloc.measurement.pose`) and of its sensors (:mod:`magloc.measurement.nuisances`). Errors of
the pose that are new in every row are states too, so that readings are modelled at the estimated pose. Positions,
moments and steps for smoothing are Cartesian.

Rows of a settled track are stepped by :mod:`magloc.tracking.settled` in one compiled call, all others here. A test
compares the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.fields.shapes import Shape
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.magnet import array_near, check_without_roll
from magloc.measurement.nuisances import BackgroundDrift
from magloc.readings import Readings
from magloc.tracking.acquisition import STACKED_POSITION_ERROR, AcquiredSource, Acquisition, CartesianFilter
from magloc.tracking.chart.known_moment import ConstantModulus
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.saved import saved_state, values_of_state
from magloc.tracking.chart.start import NO_DIPOLE, prior_root
from magloc.tracking.chart.steps import (
    LARGEST_WIDTH,
    ChartFilter,
    RowUpdate,
    TrackState,
    from_cartesian,
    to_cartesian,
    width_of,
)
from magloc.tracking.chart.undetermined import Undetermined
from magloc.tracking.measurement import RowMeasurement, RowMeasurements
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.results import UNDETERMINED, Innovation, Prediction, Step, TrackPoint, point_of_mixture
from magloc.tracking.rows import Row, next_row, with_array_motion
from magloc.tracking.sensor_health import SENSOR_LIMIT, SensorHealth, Suspects
from magloc.tracking.settled import MOST_AT_ONCE, SettledTrack

ROWS_TO_LOSE = 3
"""Successive contradicting rows that end a track."""
LARGEST_RANGE_ERROR = LARGEST_WIDTH
"""Largest σ of the range over the range; a track with more is lost."""


class Tracker(CartesianFilter):
    """Follows one dipole, row by row.

    Parameters
    ----------
    array : SensorArray
        Array with the positions, noise and calibration of its sensors.
    motion : MotionModel
        Motion of the source, such as :class:`magloc.RandomWalk`.
    prior : SourcePrior
        Bounds of the source where a track starts, and its known moment, in the array's frame.
    magnet : Shape, optional
        Shape of the source, a magnet that is magnetised along its axis: a cylinder, ring or sphere.
    keep_steps : bool
        Whether to collect the steps for a smoother in `steps`.
    background : Drift, optional
        Drift of every channel, as states. Then rows do not start a track, but :func:`magloc.track` does.

    Attributes
    ----------
    measurements : RowMeasurements
        Measurement models of the rows.
    errors : SensorErrors
        Lasting errors of the array's sensors: the last states.
    pose_errors : PoseErrors
        Errors of the array's pose: the states between those of the motion and `errors`.
    steps : list of Step
        Steps of all tracks so far, if `keep_steps`.

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
        magnet: Shape | None = None,
        keep_steps: bool = False,
        background: BackgroundDrift | None = None,
    ) -> None:
        array = array_near(array, magnet)
        check_without_roll(array)
        self.array, self.prior, self.background, self.keep_steps = array, prior, background, keep_steps
        self.measurements = RowMeasurements(array, motion.n_states, background)
        self.errors, self.pose_errors = self.measurements.errors, self.measurements.pose_errors
        self.steps: list[Step] = []
        self._acquisition = Acquisition(array, prior)
        self.filter = ChartFilter(array, self.errors, self.pose_errors, prior)
        self.motion = motion
        self._undetermined = Undetermined(self.filter)
        self._known: TrackState | None = None
        self._time_s, self._n_rows = math.nan, 0
        self._last: Innovation | None = None
        self._row_before: Row | None = None
        self._health, self._suspects = SensorHealth.of(array.n_sensors), Suspects.of(array.n_sensors)

    def update(self, row: Row | Readings) -> TrackPoint:
        """Update the track by one more row.

        Parameters
        ----------
        row : Row or Readings of length one
            A row later than the one before. Saturated readings are not used.

        Raises
        ------
        ValueError
            Time goes backwards, or the readings are not one row.
        """
        return self.advance([row])[0]

    def state(self) -> dict[str, Any]:
        """Return the state of the tracker, for a JSON file and :meth:`from_state`."""
        return saved_state({name: value for name, value in vars(self).items() if name != "_settled"})

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Tracker:
        """Return a tracker that resumes from a state, bit for bit.

        Raises
        ------
        ValueError
            The state has another version, or is damaged.
        """
        found = cls.__new__(cls)
        vars(found).update(values_of_state(state))
        found._settled = SettledTrack.of(found.array, found._motion, found.measurements, found.filter.n_differences)
        return found

    def run(
        self, rows: Iterable[Row | Readings], progress: Callable[[int], None] | None = None
    ) -> Iterator[TrackPoint]:
        """Yield the points of successive rows; of a sequence, several at once by :meth:`advance`."""
        for part in [rows] if isinstance(rows, Sequence) else ([row] for row in rows):
            done = 0
            while done < len(part):
                points = self.advance(part[done : done + MOST_AT_ONCE])
                done += len(points)
                yield from points
                if progress is not None:
                    progress(len(points))

    def advance(self, rows: Sequence[Row | Readings]) -> list[TrackPoint]:
        """Return the points of the first rows: as many as one compiled call takes, otherwise one.

        See :meth:`update`.
        """
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
                    self._suspects = self._suspects.decay(len(points))
                return points
        return [self._step_row(row)]

    def _step_row(self, row: Row) -> TrackPoint:
        """Return the point of one row, without compiled steps."""
        if self.n_errors:
            row, self._row_before = with_array_motion(row, self._row_before), row
        dt_s, self._time_s = row.time_s - self._time_s, row.time_s
        index, self._n_rows = self._n_rows, self._n_rows + 1
        if self._known is None:
            out, point = self._start_track(row, index)
        else:
            out, point = self._follow_track(self._known, row, index, dt_s)
        return replace(point, dropped_sensors=tuple(np.array(self.array.ids)[out].tolist())) if out.any() else point

    @property
    def motion(self) -> MotionModel:
        """Motion of the source; a known modulus of the moment stays constant."""
        return self._motion

    @motion.setter
    def motion(self, motion: MotionModel) -> None:
        self._motion = ConstantModulus.of(motion, self.prior)
        self._settled = SettledTrack.of(self.array, self._motion, self.measurements, self.filter.n_differences)

    @property
    def known(self) -> TrackState | None:
        """State of the track before the next row; None without a track."""
        return self._known

    @property
    def time_s(self) -> float:
        """Time of the last row, NaN before the first."""
        return self._time_s

    @property
    def is_tracking(self) -> bool:
        """True if the track is settled, with all sensors in use."""
        return (known := self._known) is not None and known.is_settled and self._health.is_well

    @property
    def is_compiled(self) -> bool:
        """True if compiled code steps the next row, provided that it continues the track."""
        return self.is_tracking and self._settled is not None and not (self.keep_steps and self.n_errors)

    def resume(self, known: TrackState, time_s: float, n_rows: int = 0, steps: Sequence[Step] = ()) -> None:
        """Resume from a saved state at a time, `n_rows` rows later."""
        self._known, self._time_s, self._last = known, time_s, None
        self._n_rows += n_rows
        self.steps += steps

    def prior_covariance(self, measurement: RowMeasurement, x: FloatArray) -> FloatArray:
        """Return the prior covariance (n, n) of the motion's states of a source at x."""
        _, S = self.motion.start(x[:N_SOURCE], prior_root(measurement.chart(x[:N_SOURCE])))
        return S @ S.T

    def propagate(self, covariance: FloatArray, x: FloatArray, dt_s: float) -> FloatArray:
        """Return a covariance after a step from a state x without readings."""
        _, F, S_q = self.motion.step(x[: self.motion.n_states], dt_s)
        return F @ covariance @ F.T + S_q @ S_q.T

    def untracked_point(self, row: Row, reason: str) -> TrackPoint:
        """Return the point of a row without a track."""
        centroid_m = row.origin_m + row.R_world_from_array @ self.array.centroid
        return TrackPoint(row.time_s, status=reason, centroid_m=centroid_m, radius_m=self.array.circumradius)

    def _start_track(self, row: Row, index: int, near: Mixture | None = None) -> tuple[BoolArray, TrackPoint]:
        """Start a new track if possible; return the excluded sensors (N,) and the point."""
        self._known, out = None, self._health.dead
        measurement = self._measure(row, out)
        if measurement.z.size < N_SOURCE:
            return out, self._acquire(measurement, index)
        mixture, reason = self.filter.start(measurement, self.motion, near)
        if reason == NO_DIPOLE and (faulty := self.filter.faulty_sensors(measurement)).sum() == 1:
            measurement = self._measure(row, out | faulty)
            mixture, _ = self.filter.start(measurement, self.motion, near)
            out = out if mixture is None else out | faulty
        if mixture is None:
            return out, self.untracked_point(measurement.row, reason)
        self._update_health(
            row, out, lambda row: math.inf if self.filter.row_mixture(row, self.motion)[0] is None else 0.0
        )
        open_loop = self.prior_covariance(measurement, mixture.x[np.argmax(mixture.log_weight)])
        if self.errors.depends_on_field:
            measurement = self._measure(row, out, mixture)
        young = ((measurement, self.motion),) if self.filter.refits(self.motion) else ()
        known = self.filter.refit(TrackState(mixture, open_loop, young=young))
        return out, self._tracked_point(measurement.row, index, known, None, status="acquired")

    def _measure(self, row: Row, out: BoolArray, mixture: Mixture | None = None) -> RowMeasurement:
        """Return the model of a row without some sensors (N,), whose gains act on a mixture's likeliest source."""
        source = None if mixture is None else mixture.x[np.argmax(mixture.log_weight), :N_SOURCE]
        readings = np.where(out[self.array.channel_sensor], np.nan, row.readings_T)
        return self.measurements.of(replace(row, readings_T=readings) if out.any() else row, source)

    def _follow_track(self, before: TrackState, row: Row, index: int, dt_s: float) -> tuple[BoolArray, TrackPoint]:
        """Continue a track by one row; return the excluded sensors (N,) and the point."""
        dead = self._health.dead
        measurement = self._measure(row, dead)
        predicted = self.filter.predict(before.mixture, self.motion, dt_s, measurement)
        x = before.mixture.x[np.argmax(before.mixture.log_weight)]
        open_loop = self.propagate(before.open_loop, x, dt_s)
        known = replace(before, mixture=predicted, open_loop=open_loop, used=before.used or before.mixture)
        prediction = self.predict(*to_cartesian(before.mixture), dt_s) if self.keep_steps else None
        if not measurement.z.size:
            return dead, self._tracked_point(measurement.row, index, known, prediction, status="predicted")
        if width_of(predicted) > LARGEST_WIDTH:
            # The prediction is too uncertain for an iteration to start from it.
            if self.filter.is_detected(measurement):
                return self._start_track(row, index, predicted.match_moments())
            return dead, self._tracked_point(measurement.row, index, known, prediction, status="predicted")

        def update_by(row_measurement: RowMeasurement) -> RowUpdate:
            return self.filter.update(before, predicted, dt_s, row_measurement)

        update, out, may_be_fault = update_by(measurement), dead, False
        if update.mixture is None:
            out, update, may_be_fault = self._exclude_sensor(update, lambda out: update_by(self._measure(row, out)))
            measurement = self._measure(row, out)
        else:
            self._suspects = self._suspects.decay(1)
        if update.mixture is not None and self.errors.depends_on_field:
            at_source = self._measure(row, out, update.mixture)
            again = update_by(at_source)
            if again.mixture is not None:
                measurement, update = at_source, again
        innovation = Innovation(measurement.row.available, update.innovation, update.correction)
        if update.mixture is None:
            contradictions = before.contradictions + (not may_be_fault)
            if contradictions >= ROWS_TO_LOSE:
                return self._start_track(row, index)
            known = replace(known, contradictions=contradictions)
            point = self._tracked_point(
                measurement.row, index, known, prediction, status="outlier", innovation=innovation
            )
            return dead, replace(point, nis=update.nis)
        self._update_health(row, out, lambda with_sensor: update_by(with_sensor).nis - update.nis)
        known = replace(known, mixture=update.mixture, contradictions=0, used=None)
        if before.young:
            young = (*before.young, (measurement, self.motion))
            known = self.filter.refit(replace(known, young=young, nis=before.nis + update.nis))
        # The range of all components together may be open again although every component is narrow.
        is_wide, is_open = width_of(known.mixture) > LARGEST_WIDTH, known.mixture.log_range_sigma > LARGEST_WIDTH
        is_detected = (is_wide or (is_open and known.has_range)) and self.filter.is_detected(measurement)
        if is_wide and is_detected:
            return self._start_track(row, index, predicted.match_moments())
        known = replace(known, has_range=known.has_range or not is_open)
        return out, self._tracked_point(
            measurement.row,
            index,
            known,
            prediction,
            status="tracked",
            innovation=innovation,
            iterations=update.iterations,
            is_lost=is_open and known.has_range and not is_detected,
        )

    def _update_health(self, row: Row, out: BoolArray, excess: Callable[[RowMeasurement], float]) -> None:
        """Update the sensors' health by the excluded ones (N,), and the χ² of each dead one."""
        if self._health.is_well and not out.any():
            return
        dead_chi2, available = np.full(len(out), np.inf), np.unique(self.array.channel_sensor[row.available])
        for sensor in np.intersect1d(np.flatnonzero(self._health.dead), available):
            dead_chi2[sensor] = excess(self._measure(row, out & (np.arange(len(out)) != sensor)))
        self._health = self._health.after(np.full((len(out), 3), np.nan), out, dead_chi2)

    def _exclude_sensor(
        self, update: RowUpdate, update_without: Callable[[BoolArray], RowUpdate]
    ) -> tuple[BoolArray, RowUpdate, bool]:
        """Repeat a contradicting update without the sensor at fault.

        Return the excluded sensors (N,), the update, and whether a single sensor may be at fault.
        """
        dead, own = self._health.dead, np.eye(self.array.n_sensors, dtype=bool)
        found = {sensor: update_without(dead | own[sensor]) for sensor in np.flatnonzero(~dead).tolist()}
        if all(one.mixture is None for one in found.values()):
            return dead, update, False
        chi2 = np.array([found[sensor].nis if sensor in found else np.inf for sensor in range(len(dead))])
        self._suspects = self._suspects.after(chi2)
        sensor = self._suspects.faulty_sensor
        if sensor is None or found[sensor].mixture is None or found[sensor].nis > update.nis - SENSOR_LIMIT:
            return dead, update, True
        return dead | own[sensor], found[sensor], True

    def _tracked_point(
        self,
        row: Row,
        index: int,
        known: TrackState,
        prediction: Prediction | None,
        *,
        status: str,
        innovation: Innovation | None = None,
        iterations: int = 0,
        is_lost: bool = False,
    ) -> TrackPoint:
        """Store the state after a row, and return its point."""
        mixture = known.mixture
        tracked = status == "tracked"
        statistics = {} if innovation is None else innovation.statistics(self._last if tracked else None)
        self._last = innovation if tracked else None
        if is_lost or (status != "acquired" and width_of(mixture) > LARGEST_WIDTH):
            self._known = None
            return replace(self.untracked_point(row, "lost: the place is no longer known"), **statistics)
        self._known = known
        if self.keep_steps:
            self.steps.append(Step(index, prediction, *to_cartesian(mixture)))
        point = point_of_mixture(row.time_s, mixture, np.diagonal(known.open_loop))
        return replace(point, status=status, iterations=iterations, **statistics)

    def _acquire(self, measurement: RowMeasurement, index: int) -> TrackPoint:
        """Start a track from several insufficient rows, or return an undetermined point."""
        mixture, reason = self._undetermined.after(measurement, self.motion)
        start = self._acquisition.start(measurement.row, self._undetermined.position_error)
        known = None if start is None else self._filter_acquired(start, measurement)
        if start is None or known is None:
            return self._undetermined_point(mixture, reason, measurement)
        self._acquisition.forget()
        self._undetermined.forget()
        point = self._tracked_point(
            measurement.row, index, known, None, status="acquired", iterations=start.solution.iterations
        )
        return replace(point, weight=start.solution.weight, rivals=start.rivals)

    def _filter_acquired(self, start: AcquiredSource, measurement: RowMeasurement) -> TrackState | None:
        """Return the state of a track that starts from several rows, None if uncertain."""
        source = np.concatenate([start.solution.position_m, start.solution.moment_Am2])
        found = self.start(source, start.solution.covariance, start.rows)
        if found is None:
            return None
        offset, root = measurement.place_in_array(found.x, found.S)
        if float(np.linalg.norm(root)) > STACKED_POSITION_ERROR * float(np.linalg.norm(offset)):
            return None
        return TrackState(from_cartesian(found.x, found.S, measurement), self.prior_covariance(measurement, found.x))

    def _undetermined_point(self, mixture: Mixture | None, reason: str, measurement: RowMeasurement) -> TrackPoint:
        """Return the point of a row that shows a source and does not determine it."""
        if mixture is None:
            return self.untracked_point(measurement.row, reason)
        heaviest = mixture.x[np.argmax(mixture.log_weight)]
        point = point_of_mixture(
            measurement.row.time_s, mixture, np.diagonal(self.prior_covariance(measurement, heaviest))
        )
        return replace(point, status=UNDETERMINED)
