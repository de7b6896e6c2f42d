r"""One dipole through time: an iterated extended Kalman filter from the first row in which the source is seen.

What is known of the source is a mixture of Gaussians in the coordinates of :mod:`magloc.tracking.chart`. The first row
makes it (:mod:`magloc.tracking.start`); every later one moves its components by a
:class:`magloc.tracking.motion.MotionModel`, updates them (:mod:`magloc.tracking.update`), and leaves fewer of them, soon
a single one. A track ends when the readings contradict it or its place is no longer known; then it starts anew. The
state is in the world frame where the array's pose is known, else in the array's. Behind the states of the motion stand
the lasting errors that the array states of its sensors (:mod:`magloc.measurement.nuisances`).

This module is the readable form; :mod:`magloc.tracking.batch` steps long records, and a test holds the two together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.noise import reading_covariance
from arrays.typing import FloatArray
from magloc.levels import CONTRADICTION
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.nuisances import SensorErrors, without_lasting_errors
from magloc.readings import Readings, without_saturated
from magloc.tracking.chart import Chart
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.mixture import Mixture
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.results import Row, Step, TrackPoint, rows_of
from magloc.tracking.refit import refitted
from magloc.tracking.start import Start, once, prior_root
from magloc.tracking.update import Move, predicted_root, updated

ROWS_TO_LOSE = 3
"""Contradicting rows in a row that end a track."""
LARGEST_GROWTH = 1.5
"""A prediction bends as the readings do while no standard deviation grows by more in the step: beyond that it is the
motion that it is uncertain of, which does not."""
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
    """

    mixture: Mixture
    open_loop: FloatArray
    contradictions: int = 0
    young: tuple[RowMeasurement, ...] = ()
    next_refit: int = 3


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
    errors : SensorErrors
        The lasting errors of the array's sensors, whose states follow those of the motion.
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
        self.errors = SensorErrors.of(array)
        self.keep_steps = keep_steps
        self.steps: list[Step] = []
        self._noisy_array = without_lasting_errors(array)
        self._start = Start(array, motion, self.errors, prior)
        self._differences: dict[bytes, Differences] = {}
        self._known: Known | None = None
        self._time_s = math.nan
        self._n_rows = 0

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
        dt_s, self._time_s = row.time_s - self._time_s, row.time_s
        self._n_rows += 1
        measurement = self.measurement(row)
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
        wide = predicted.widths > LARGEST_WIDTH
        if wide[np.argmax(predicted.log_weight)]:
            # The prediction says too little for an iteration to start from it.
            near = predicted.matched() if measurement.is_detected(self.errors.sigma) else None
            if near is None:
                return self._kept(measurement, known, step, status="predicted")
            self._known = None
            return self._started(measurement, near)
        sigma, sigma_before = (np.linalg.norm(m.S[:, :N_SOURCE], axis=2) for m in (predicted, before.mixture))
        bends = (sigma <= LARGEST_GROWTH * sigma_before).all(axis=1)
        after = updated(predicted.x, predicted.S, measurement, bends)
        k = measurement.z.size
        sound = after.converged & np.isfinite(after.log_evidence)
        nis = float(np.where(sound, after.nis, np.inf).min())
        if not nis <= chdtri(k, CONTRADICTION):
            nis = float(np.min(after.nis))
            if before.contradictions + 1 >= ROWS_TO_LOSE:
                self._known = None
                return self._started(measurement)
            known = replace(known, contradictions=before.contradictions + 1)
            return self._kept(measurement, known, step, status="outlier", nis=nis, nis_dof=k)
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
            nis=float(after.nis[best]),
            nis_dof=k,
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
        self._known, self._time_s = known, time_s
        self._n_rows += n_rows
        if self.keep_steps:
            self.steps += steps

    def predicted(self, mixture: Mixture, dt_s: float, measurement: RowMeasurement) -> tuple[Mixture, FloatArray]:
        """What is known after a time without readings, as seen from a row's array, and the transitions (K, n, n)."""
        n, errors = mixture.n_motion, self.errors
        steps = [self.motion.step(x, dt_s) for x in mixture.x[:, :n]]
        kept, added = errors.step(dt_s)
        x = mixture.x.copy()
        x[:, :n] = [step[0] for step in steps]
        x[:, n:] *= kept
        move = Move(np.stack([step[1] for step in steps]), np.stack([step[2] for step in steps]), kept, added)
        after = replace(mixture, x=x, centroid_m=measurement.centroid_m)
        S, transition = predicted_root(mixture.chart, after.chart, mixture.S, move)
        return replace(after, S=S), transition

    def measurement(self, row: Row) -> RowMeasurement:
        """What a row's readings say of the state."""
        array = self._noisy_array
        if row.ambient_T is not None:
            x, y, z = row.ambient_T.tolist()
            array = replace(array, ambient_T=(x, y, z))
        differences = self.differences_of(row)
        effect = self.errors.effect(array, row.readings_T)
        sigma = np.sqrt(differences.variance)
        return RowMeasurement(DifferenceMeasurement(array, differences), sigma, row, self.motion.n_states, effect)

    def differences_of(self, row: Row) -> Differences:
        """The independent differences that a row's readings give, without the lasting errors."""
        available, array = np.isfinite(row.readings_T), self._noisy_array
        if array.noise_depends_on_reading:
            covariance = reading_covariance(array, row.readings_T)
            return decorrelated_differences(array, available, covariance_T2=covariance)
        key = available.tobytes()
        if key not in self._differences:
            self._differences[key] = decorrelated_differences(array, available)
        return self._differences[key]

    def _started(self, measurement: RowMeasurement, near: Mixture | None = None) -> TrackPoint:
        """A new track, if the row shows a source."""
        mixture, reason = self._start.mixture(measurement)
        if mixture is None:
            return TrackPoint(
                measurement.row.time_s,
                status=reason,
                centroid_m=measurement.centroid_m,
                radius_m=measurement.radius_m,
            )
        if near is not None:
            mixture = _near(mixture, near).reduced()
        n = mixture.n_motion
        single = mixture.matched()
        chart = Chart.at(single.x[0, :n], single.centroid_m, single.radius_m)
        root = prior_root(chart, self.motion)
        return self._kept(measurement, Known(mixture, root @ root.T, young=(measurement,)), None, status="acquired")

    def _refitted(self, known: Known) -> Known:
        """What is known when all rows of a young track are fitted together."""
        mixture, n_rows = known.mixture, len(known.young)
        if n_rows > MOST_YOUNG_ROWS:
            return replace(known, young=())
        if n_rows < known.next_refit or len(mixture) > 12 or mixture.widths.max() > 0.25:
            return known
        known = replace(known, next_refit=max(n_rows + 2, int(1.5 * n_rows)))
        found, nis = refitted(mixture, known.young, self.motion, self.errors)
        dof = sum(m.z.size for m in known.young) - N_SOURCE
        if not len(found) or (dof > 0 and nis.min() > chdtri(dof, CONTRADICTION)):
            return known
        found = found.take(once(found, np.zeros((len(found), 2), dtype=np.intp))).reduced()
        if len(found) == 1 and len(mixture) == 1:
            n = mixture.n_motion
            e = mixture.chart.coordinates(found.x[:, :n])[0]
            A = np.linalg.qr(mixture.S[0, :n].T, mode="r").T
            if np.sum(np.linalg.solve(A, e) ** 2) < 0.05 * n:
                known = replace(known, young=())
        return replace(known, mixture=found)

    def _open_loop(self, known: Known, dt_s: float) -> FloatArray:
        """Covariance (n, n) of a source of which no readings were taken."""
        n = known.mixture.n_motion
        best = int(np.argmax(known.mixture.log_weight))
        _, F, S_q = self.motion.step(known.mixture.x[best, :n], dt_s)
        return F @ known.open_loop @ F.T + S_q @ S_q.T

    def _kept(
        self,
        measurement: RowMeasurement,
        known: Known,
        step: tuple[Mixture, FloatArray] | None,
        *,
        status: str,
        nis: float = math.nan,
        nis_dof: int = 0,
        iterations: int = 0,
    ) -> TrackPoint:
        mixture = known.mixture
        if status != "acquired" and mixture.widths[np.argmax(mixture.log_weight)] > LARGEST_WIDTH:
            self._known = None
            return TrackPoint(
                measurement.row.time_s,
                nis=nis,
                nis_dof=nis_dof,
                status="lost: the place is no longer known",
                centroid_m=measurement.centroid_m,
                radius_m=measurement.radius_m,
            )
        self._known = known
        if self.keep_steps:
            prediction, transition = (None, None) if step is None else (step[0], step[1][0])
            self.steps.append(Step(self._n_rows - 1, mixture.matched(), prediction, transition))
        point = track_point(measurement.row.time_s, mixture, np.diagonal(known.open_loop))
        return replace(point, status=status, nis=nis, nis_dof=nis_dof, iterations=iterations)


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


def _near(mixture: Mixture, prediction: Mixture) -> Mixture:
    """Components weighed by what a prediction says of their places."""
    mean, covariance = prediction.moments()
    offset, log_density = mixture.x[:, :3] - mean[:3], np.empty(len(mixture))
    for k in range(len(mixture)):
        _, own = mixture.take(np.array([k])).moments()
        both = covariance[:3, :3] + own[:3, :3]
        log_density[k] = -0.5 * (offset[k] @ np.linalg.solve(both, offset[k]) + np.linalg.slogdet(both)[1])
    return replace(mixture, log_weight=mixture.log_weight + log_density)
