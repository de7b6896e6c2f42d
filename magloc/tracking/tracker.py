r"""One dipole through time: an iterated extended Kalman filter from the first row in which the source is seen.

What is known of the source is a mixture of Gaussians in the coordinates of :mod:`magloc.tracking.chart.coordinates`.
The first row makes it (:mod:`magloc.tracking.chart.start`); every later one moves its components by a
:class:`magloc.tracking.motion.MotionModel`, updates them (:mod:`magloc.tracking.chart.update`), and leaves fewer of
them, soon a single one; while the track is young, all its rows are fitted together now and then
(:mod:`magloc.tracking.chart.refit`). A track ends when the readings contradict it or its place is no longer known; then
it starts anew. The state is in the world frame where the array's pose is known, else in the array's. Behind the states
of the motion stand the errors of the array's pose (:mod:`magloc.measurement.pose`), also those that are new in every
row, so that the readings are modelled at the pose that they tell of, and behind them the lasting errors that the array
states of its sensors (:mod:`magloc.measurement.nuisances`).

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
from magloc.blas_threads import one_blas_thread
from magloc.levels import CONTRADICTION, DISAGREEMENT
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.locator import fit_at_rest
from magloc.readings import Readings, without_saturated
from magloc.tracking.chart.coordinates import mirrored
from magloc.tracking.chart.mixture import Mixture, root_of
from magloc.tracking.chart.refit import curvature, refitted
from magloc.tracking.chart.start import Start, once, prior_root
from magloc.tracking.chart.update import Move, predicted_root, updated
from magloc.tracking.measurement import RowMeasurement, RowMeasurements
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.posed_motion import PosedMotion
from magloc.tracking.results import Innovation, Row, Step, TrackPoint, moving, rows_of

ROWS_TO_LOSE = 3
"""Contradicting rows in a row that end a track."""
LARGEST_GROWTH = 1.5
"""A prediction bends as the readings do while no standard deviation grows by more in the step: beyond that it is the
motion that it is uncertain of, which does not. Nor does it bend as a row does in which readings are missing: the rows
that made it had them."""
SETTLED = 0.05
"""A young track is old when fitting it as a whole changes its state by less, in squares of σ per number, and it is
narrow."""
SEEDS = 6
"""Components of a young track that are fitted anew, each with its mirror images."""
LARGEST_ALONE_WIDTH = 0.03
"""The same of a component with which a track grows old, or begins if its rows do not determine a source one by one:
the posterior of several rows is bent beyond that."""
LARGEST_CURVATURE = 0.25
"""Square of σ by which the posterior of a young track bends at most, one σ away, where the filter goes on alone."""
LARGEST_REFIT_WIDTH = 0.25
"""The same of a component that is fitted to all rows of a young track."""
MOST_YOUNG_ROWS = 240
"""Rows up to which a track is fitted anew as a whole."""
LARGEST_WIDTH = 0.4
"""Standard deviation of the log-range, or of the direction, beyond which a component is no place any more."""


@dataclass(frozen=True, eq=False)
class Known:
    """What a tracker knows between rows.

    Attributes
    ----------
    mixture : Mixture
    open_loop : ndarray, shape (n, n)
        Cartesian covariance of source and motion had no readings been taken since the track began.
    contradictions : int
        Contradicting rows before the next one.
    young : tuple of RowMeasurement
        Rows of a track that are still fitted together, and `next_refit`, after how many of them.
    alone : bool
        Whether no row determines a source, nor all of them so far: then what is known is what the last row says;
        `proposed` is what all of them said at the last attempt: a wrong optimum seldom stays as rows come in.
    """

    mixture: Mixture
    open_loop: FloatArray
    contradictions: int = 0
    young: tuple[RowMeasurement, ...] = ()
    next_refit: int = 3
    alone: bool = False
    proposed: Mixture | None = None


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

    Attributes
    ----------
    measurements : RowMeasurements
        What rows say of the state.
    errors : SensorErrors
        The lasting errors of the array's sensors, whose states are the last.
    pose_errors : PoseErrors
        Those of its pose, whose states follow those of the motion.
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
    ) -> None:
        self.array = array
        self.motion = motion
        self.measurements = RowMeasurements(array, motion.n_states)
        self.errors, self.pose_errors = self.measurements.errors, self.measurements.pose_errors
        self.keep_steps = keep_steps
        self.steps: list[Step] = []
        self._start = Start(array, self.moved, self.errors, prior)
        self._known: Known | None = None
        self._time_s = math.nan
        self._n_rows = 0
        self._last: Innovation | None = None
        self._row_before: Row | None = None

    @property
    def moved(self) -> MotionModel:
        """The motion, with the errors of the pose behind it."""
        return PosedMotion.of(self.motion, self.pose_errors)

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
            row = next(rows_of(without_saturated(row, self.array)))
        if row.time_s <= self._time_s:
            raise ValueError(f"Input time_s must increase; instead {row.time_s} s follows {self._time_s} s.")
        if self.pose_errors.n_states:
            row, self._row_before = moving(row, self._row_before), row
        dt_s, self._time_s = row.time_s - self._time_s, row.time_s
        self._n_rows += 1
        measurement = self.measurements.of(row)
        if self._known is None:
            return self._started(measurement)
        before = self._known
        predicted, transition = self.predicted(before.mixture, dt_s, measurement)
        known = replace(before, mixture=predicted, open_loop=self._open_loop(before, dt_s))
        step = None
        if self.keep_steps:
            step = (predicted, transition)
            if len(predicted) > 1:
                step = self.predicted(before.mixture.matched(), dt_s, measurement)
        if not measurement.z.size:
            return self._kept(measurement, known, step, status="predicted")
        if before.alone:
            return self._kept(measurement, self._with_row_alone(known, measurement), step, status="acquired")
        wide = predicted.widths > LARGEST_WIDTH
        if wide[np.argmax(predicted.log_weight)]:
            # The prediction says too little for an iteration to start from it.
            near = predicted.matched() if measurement.is_detected(self.errors.sigma) else None
            if near is None:
                return self._kept(measurement, known, step, status="predicted")
            self._known = None
            return self._started(measurement, near)
        sigma, sigma_before = (np.linalg.norm(m.S[:, :N_SOURCE], axis=2) for m in (predicted, before.mixture))
        k = measurement.z.size
        bends = (sigma <= LARGEST_GROWTH * sigma_before).all(axis=1) & (k >= self.measurements.n_differences)
        lasting = measurement.with_lasting_errors(self.pose_errors.step(dt_s)[0] ** 2)
        after = updated(predicted.x, predicted.S, measurement, bends, lasting)
        sound = after.converged & np.isfinite(after.log_evidence)
        if not np.where(sound, after.nis, np.inf).min() <= chdtri(k, CONTRADICTION):
            innovation = Innovation(row.available, after.whitened_innovation(int(np.argmin(after.nis))))
            if before.contradictions + 1 >= ROWS_TO_LOSE:
                self._known = None
                return self._started(measurement)
            known = replace(known, contradictions=before.contradictions + 1)
            point = self._kept(measurement, known, step, status="outlier", innovation=innovation)
            return replace(point, nis=float(after.nis.min()))
        log_weight = predicted.log_weight + np.where(sound, after.log_evidence, -np.inf)
        best = int(np.argmax(log_weight))
        mixture = replace(predicted, x=after.x, S=after.S, log_weight=log_weight)
        known = replace(known, mixture=mixture.take(sound).reduced(), contradictions=0)
        if before.young:
            known = self._refitted(replace(known, young=(*before.young, measurement)))
        return self._kept(
            measurement,
            known,
            step,
            status="tracked",
            innovation=Innovation(row.available, after.whitened_innovation(best)),
            iterations=int(after.iterations[best]),
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
    def known(self) -> Known | None:
        """What is known of the source before the next row; None without a track."""
        return self._known

    def resume(self, known: Known, time_s: float, n_rows: int, steps: Sequence[Step] = ()) -> None:
        """Go on from what is known at a time, after so many rows more."""
        self._known, self._time_s, self._last = known, time_s, None
        self._n_rows += n_rows
        if self.keep_steps:
            self.steps += steps

    def predicted(self, mixture: Mixture, dt_s: float, measurement: RowMeasurement) -> tuple[Mixture, FloatArray]:
        """What is known after a time without readings, as seen from a row's array, and the transitions (K, n, n)."""
        n, errors, motion = mixture.n_motion, self.errors, self.moved
        steps = [motion.step(x, dt_s) for x in mixture.x[:, :n]]
        kept, added = errors.step(dt_s)
        x = mixture.x.copy()
        x[:, :n] = [step[0] for step in steps]
        x[:, n:] *= kept
        move = Move(np.stack([step[1] for step in steps]), np.stack([step[2] for step in steps]), kept, added)
        after = replace(mixture, x=x, centroid_m=measurement.centroid_m)
        S, transition = predicted_root(mixture.chart, after.chart, mixture.S, move)
        return replace(after, S=S), transition

    def _started(self, measurement: RowMeasurement, near: Mixture | None = None) -> TrackPoint:
        """A new track, if the row shows a source."""
        mixture, reason = self._start.mixture(measurement)
        if mixture is None:
            return _nothing_known(measurement, reason)
        if near is not None:
            mixture = _near(mixture, near).reduced()
        chart = measurement.chart(mixture.matched().x[0, : mixture.n_motion])
        root = prior_root(chart, self.moved)
        known = Known(mixture, root @ root.T, young=(measurement,), alone=measurement.z.size < N_SOURCE)
        return self._kept(measurement, known, None, status="acquired")

    def _with_row_alone(self, known: Known, measurement: RowMeasurement) -> Known:
        """What is known after a row that does not determine a source, until all rows together do."""
        rows = (*known.young, measurement)[-MOST_YOUNG_ROWS:]
        mixture, _ = self._start.mixture(measurement)
        known = replace(known, young=rows, mixture=known.mixture if mixture is None else mixture)
        if len(rows) < known.next_refit:
            return known
        known = replace(known, next_refit=len(rows) + max(2, len(rows) // 8))
        seeds = self._at_rest(rows, known.proposed)
        if seeds is None:
            return known
        found, nis, _ = refitted(seeds, rows, self.moved, self.errors)
        if not self._believed(found, nis, rows):
            return replace(known, proposed=None)
        found = found.take(once(found, np.zeros((len(found), 2), dtype=np.intp))).reduced()
        before = known.proposed
        known = replace(known, proposed=found)
        if len(found) > 1 or found.widths[0] > LARGEST_ALONE_WIDTH or before is None or not _agree(before, found):
            return known
        if curvature(found, rows, self.moved, self.errors) > LARGEST_CURVATURE:
            return known
        return replace(known, mixture=found, alone=False, proposed=None)

    def _at_rest(self, rows: Sequence[RowMeasurement], proposed: Mixture | None) -> Mixture | None:
        """Sources at rest that explain several rows together, and those proposed before, as seeds."""
        recent = rows[-64:]
        measurements = recent[:: -max(1, len(recent) // 16)]
        chosen = [m.row for m in measurements]
        known = [row.ambient_T for row in chosen if row.ambient_T is not None]
        fix = fit_at_rest(
            self.array,
            np.stack([row.readings_T for row in chosen]),
            np.stack([row.origin_m for row in chosen]),
            np.stack([row.R_world_from_array for row in chosen]),
            np.stack(known) if len(known) == len(chosen) else None,
            poses=self.pose_errors.of_rows(
                self.array,
                np.array([row.time_s for row in chosen]),
                [m.pose for m in measurements],
                [row.pose_sigma for row in chosen],
            ),
        )
        places = [np.hstack([solution.position_m, solution.moment_Am2]) for solution in fix.solutions]
        if proposed is not None:
            places += list(proposed.x[:, :N_SOURCE])
        if not places:
            return None
        n, n_errors, motion = rows[-1].n_motion, self.errors.n_states, self.moved
        x = np.zeros((len(places), n + n_errors))
        x[:, :n] = [motion.start(place, np.zeros((N_SOURCE, N_SOURCE)))[0] for place in places]
        last = rows[-1]
        S = np.zeros((len(x), n + n_errors, n + n_errors))
        return Mixture(x, S, np.zeros(len(x)), n, last.centroid_m, last.radius_m, last.n_pose)

    def _believed(self, found: Mixture, nis: FloatArray, rows: Sequence[RowMeasurement]) -> bool:
        """Whether sources that were fitted to rows explain them, and are determined by them."""
        if not len(found):
            return False
        dof = sum(m.z.size for m in rows) - N_SOURCE
        best = int(np.argmax(found.log_weight))
        return bool(dof > 0 and nis[best] <= chdtri(dof, CONTRADICTION) and found.widths[best] < LARGEST_REFIT_WIDTH)

    def _refitted(self, known: Known) -> Known:
        """What is known when all rows of a young track are fitted together."""
        mixture, n_rows = known.mixture, len(known.young)
        if n_rows > MOST_YOUNG_ROWS:
            return replace(known, young=())
        if n_rows < known.next_refit or mixture.widths.max() > LARGEST_REFIT_WIDTH:
            return known
        known = replace(known, next_refit=max(n_rows + 2, int(1.5 * n_rows)))
        seeds = mixture.take(once(mixture, np.zeros((len(mixture), 2), dtype=np.intp))[:SEEDS])
        n_seeds = len(seeds)
        x = mirrored(seeds.x, seeds.centroid_m).reshape(-1, seeds.x.shape[1])
        seeds = replace(seeds, x=x, S=np.tile(seeds.S, (4, 1, 1)), log_weight=np.zeros(len(x)))
        found, nis, kept = refitted(seeds, known.young, self.moved, self.errors)
        # A component that is not fitted to its end may be the true one: then the filter goes on with all of them.
        if not np.isin(np.arange(n_seeds), kept).all() or not self._believed(found, nis, known.young):
            return known
        found = found.take(once(found, np.zeros((len(found), 2), dtype=np.intp))).reduced()
        if len(found) == 1 and len(mixture) == 1:
            n = mixture.n_motion
            e = mixture.chart.coordinates(found.x[:, :n])[0]
            change = np.sum(np.linalg.solve(root_of(mixture.S[0, :n]), e) ** 2)
            if change < SETTLED * n and found.widths[0] < LARGEST_ALONE_WIDTH:
                known = replace(known, young=())
            if change < n:
                # The mode of all states together stands nearer than the source does on average: the filter's own stays.
                return known
        return replace(known, mixture=found)

    def _open_loop(self, known: Known, dt_s: float) -> FloatArray:
        """Covariance (n, n) of a source of which no readings were taken."""
        n = known.mixture.n_motion
        best = int(np.argmax(known.mixture.log_weight))
        _, F, S_q = self.moved.step(known.mixture.x[best, :n], dt_s)
        return F @ known.open_loop @ F.T + S_q @ S_q.T

    def _kept(
        self,
        measurement: RowMeasurement,
        known: Known,
        step: tuple[Mixture, FloatArray] | None,
        *,
        status: str,
        innovation: Innovation | None = None,
        iterations: int = 0,
    ) -> TrackPoint:
        mixture, tracked = known.mixture, status == "tracked"
        told = {} if innovation is None else innovation.after(self._last if tracked else None)
        self._last = innovation if tracked else None
        if status != "acquired" and mixture.widths[np.argmax(mixture.log_weight)] > LARGEST_WIDTH:
            self._known = None
            return replace(_nothing_known(measurement, "lost: the place is no longer known"), **told)
        self._known = known
        if self.keep_steps:
            prediction, transition = (None, None) if step is None else (step[0], step[1][0])
            self.steps.append(Step(self._n_rows - 1, mixture.matched(), prediction, transition))
        point = track_point(measurement.row.time_s, mixture, np.diagonal(known.open_loop))
        return replace(point, status=status, iterations=iterations, **told)


def _nothing_known(measurement: RowMeasurement, status: str) -> TrackPoint:
    return TrackPoint(
        measurement.row.time_s, status=status, centroid_m=measurement.centroid_m, radius_m=measurement.radius_m
    )


def track_point(time_s: float, mixture: Mixture, open_loop: FloatArray) -> TrackPoint:
    """What is known at an instant, for a user; open_loop (n,) are the variances had no readings been taken."""
    source = mixture.of_source()
    mean, covariance = source.moments()
    return TrackPoint(
        time_s,
        mean[:3],
        mean[3:],
        covariance,
        1.0 - np.sqrt(np.diagonal(covariance) / open_loop[:N_SOURCE]),
        weight=float(source.weight.max()),
        centroid_m=source.centroid_m,
        radius_m=source.radius_m,
        mixture=source,
    )


def _agree(before: Mixture, after: Mixture) -> bool:
    """Whether two single sources stand at one place."""
    (mean, covariance), (mean_after, covariance_after) = before.moments(), after.moments()
    offset, both = (mean_after - mean)[:3], (covariance + covariance_after)[:3, :3]
    return bool(offset @ np.linalg.solve(both, offset) < chdtri(3, DISAGREEMENT))


def _near(mixture: Mixture, prediction: Mixture) -> Mixture:
    """Components weighed by what a prediction says of their places."""
    mean, covariance = prediction.moments()
    offset, log_density = mixture.x[:, :3] - mean[:3], np.empty(len(mixture))
    for k in range(len(mixture)):
        _, own = mixture.take(np.array([k])).moments()
        both = covariance[:3, :3] + own[:3, :3]
        log_density[k] = -0.5 * (offset[k] @ np.linalg.solve(both, offset[k]) + np.linalg.slogdet(both)[1])
    return replace(mixture, log_weight=mixture.log_weight + log_density)
