"""The track of a long record: :class:`magloc.tracking.tracker.Tracker` with compiled steps between its starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from arrays.typing import FloatArray
from magloc import core
from magloc.levels import CONTRADICTION
from magloc.measurement.rows import ambient_fields
from magloc.tracking.chart.coordinates import Chart
from magloc.tracking.chart.mixture import Mixture, component_moments, root_of
from magloc.tracking.chart.row import Rows
from magloc.tracking.chart.split import LARGEST_BEND, MOST_ROWS
from magloc.tracking.chart.steps import LARGEST_GROWTH, LARGEST_WIDTH
from magloc.tracking.chart.update import LEAST_SHARE
from magloc.tracking.motion import N_SOURCE, OrnsteinUhlenbeck
from magloc.tracking.results import Prediction, Row, Step, TrackPoint, learned
from magloc.tracking.row_filter import Gaussians, convergence, steps_problem
from magloc.tracking.tracker import Tracker

_MOST_AT_ONCE = 64
_TERMS_A_CALL = 10_000_000
"""Approximate number of products that one call of the kernel computes: some 50 ms."""
_TERMS_OF_STEPS = 3000
"""Products of a row that do not depend on the number of its differences."""


def track_record(
    tracker: Tracker,
    rows: Sequence[Row],
    progress: Callable[[int], None] | None = None,
) -> list[TrackPoint]:
    """Points of a whole record, or of the next rows of one: as :meth:`Tracker.run`, with compiled steps if there are.

    Sensors with lasting errors, and a source that may be at several places or whose component a row divides, are
    tracked by the readable steps.
    """
    points: list[TrackPoint] = []
    compiled = _CompiledSteps(tracker, rows) if rows and is_compiled(tracker) else None
    while len(points) < len(rows):
        before = len(points)
        if compiled is not None and tracker.is_tracking:
            points += compiled.follow(before)
        if len(points) < len(rows):
            points.append(tracker.update(rows[len(points)]))
        if progress is not None:
            progress(len(points) - before)
    return points


def next_points(tracker: Tracker, rows: Sequence[Row], begin: int = 0) -> list[TrackPoint]:
    """Points of the rows from one on: of as many as compiled steps take in a moment, else of one."""
    many = tracker.is_tracking and is_compiled(tracker)
    return track_record(tracker, rows[begin : begin + (_MOST_AT_ONCE if many else 1)])


def is_compiled(tracker: Tracker) -> bool:
    """Whether the steps of a tracker are compiled."""
    # Not by isinstance of a protocol, which looks through all of its attributes in every row.
    motion = tracker.motion
    is_known = isinstance(motion, OrnsteinUhlenbeck) or hasattr(motion, "linear_step")
    return is_known and not tracker.n_errors


class _CompiledSteps:
    """A record with the arrays that the kernel reads and fills."""

    def __init__(self, tracker: Tracker, rows: Sequence[Row]) -> None:
        array, motion = tracker.array, tracker.motion
        self.tracker = tracker
        self.times = [row.time_s for row in rows]
        self.times_before = [tracker.time_s, *self.times[:-1]]
        differences = [tracker.measurements.differences(row) for row in rows]
        distinct = {id(of_row): of_row for of_row in differences}
        index = {key: i for i, key in enumerate(distinct)}
        k = max(1, *(of_row.n_differences for of_row in distinct.values()))
        transforms = np.zeros((len(distinct), k, array.n_channels))
        for i, of_row in enumerate(distinct.values()):
            transforms[i, : of_row.n_differences] = of_row.transform / np.sqrt(of_row.variance)[:, None]
        transform_of_row = np.array([index[id(of_row)] for of_row in differences])
        channels = _without_nan(np.stack([row.readings_T for row in rows]) - array.channel_offset_T)
        ambients = array.ambient_fields[None]
        if any(row.ambient_T is not None for row in rows):
            usual = np.zeros(3) if array.ambient_T is None else np.asarray(array.ambient_T)
            of_rows = np.stack([usual if row.ambient_T is None else row.ambient_T for row in rows])
            ambients = ambient_fields(array, len(rows), of_rows)
        since_before = _without_nan(np.subtract(self.times, self.times_before))  # NaN of the first of all
        lengths, step_of_row = np.unique(since_before, return_inverse=True)
        self.steps_s = np.maximum(lengths, 0.0)[step_of_row]
        n, m = motion.n_states, len(rows)
        self.origins, self.rotations = (
            np.stack([row.origin_m for row in rows]),
            np.stack([row.R_world_from_array for row in rows]),
        )
        self.n_differences = np.array([of_row.n_differences for of_row in differences])
        self.centroid, self.open_loop = np.empty(3), np.empty((n, n))
        self.progress = np.zeros(3, dtype=np.int64)
        self.block = max(1, _TERMS_A_CALL // (_TERMS_OF_STEPS + transforms[0].size))
        self.state = Gaussians(np.empty((1, n)), np.empty((1, n, n)))
        self.predicted, self.updated = (Gaussians(np.empty((m, n)), np.empty((m, n, n))) for _ in range(2))
        self.open_loop_variances, self.nis = np.empty((m, n)), np.empty(m)
        self.iterations = np.empty(m, dtype=np.int64)
        given = Rows(
            array,
            (transforms[transform_of_row] @ channels[..., None])[..., 0],
            self.n_differences,
            transforms,
            transform_of_row,
            np.empty((m, k, 0)),
            self.origins,
            self.rotations,
            ambients,
        )
        self.work = core.problem(
            "track",
            rows=given.problem,
            motion=steps_problem(motion, np.maximum(lengths, 0.0).tolist(), step_of_row),
            convergence=convergence(),
            nis_limits=np.asarray(chdtri(np.maximum(np.arange(k + 1), 1), CONTRADICTION), dtype=np.float64),
            largest_width=LARGEST_WIDTH,
            largest_bend=LARGEST_BEND,
            longest_memory=MOST_ROWS,
            largest_growth=LARGEST_GROWTH,
            full_count=tracker.filter.n_differences,
            least_share=LEAST_SHARE,
            state=self.state.problem,
            centroid=self.centroid,
            open_loop=self.open_loop,
            progress=self.progress,
            predicted=self.predicted.problem,
            updated=self.updated.problem,
            open_loop_variances=self.open_loop_variances,
            nis=self.nis,
            iterations=self.iterations,
        )

    def follow(self, begin: int) -> list[TrackPoint]:
        """Points from a row to the one before the first that they do not explain, or that goes back in time."""
        tracker, times, before = self.tracker, self.times, self.times_before
        known = tracker.known
        assert known is not None
        mixture = known.mixture
        self.state.x[:], self.state.S[:], self.centroid[:] = mixture.x, mixture.S, mixture.centroid_m
        self.open_loop[:], self.progress[:] = known.open_loop, (begin, 1, mixture.n_rows)
        n_later = next((i for i in range(begin, len(times)) if times[i] <= before[i]), len(times)) - begin
        core.run("follow_sources", self.work, n_later, block=self.block, chain=n_later or None)
        end = int(self.progress[0])
        if end == begin:
            return []
        rows = slice(begin, end)
        centroids = self.origins[rows] + self.rotations[rows] @ tracker.array.centroid
        steps = self._steps(rows, centroids, mixture.x[0]) if tracker.keep_steps else []
        after = replace(
            mixture,
            x=self.state.x.copy(),
            S=self.state.S.copy(),
            centroid_m=self.centroid.copy(),
            n_rows=int(self.progress[2]),
        )
        explained = bool(self.n_differences[rows].any())
        resumed = replace(known, mixture=after, open_loop=self.open_loop.copy())
        if explained:
            resumed = replace(resumed, contradictions=0, has_range=True)
        tracker.resume(resumed, times[end - 1], end - begin, steps)
        means, covariances = component_moments(
            Chart.at(self.updated.x[rows, :N_SOURCE], centroids, mixture.radius_m), self.updated.S[rows]
        )
        estimability = learned(np.diagonal(covariances, axis1=1, axis2=2), self.open_loop_variances[rows, :N_SOURCE])
        of_source, single, radius_m = self.updated.S[rows, :N_SOURCE], np.zeros(1), mixture.radius_m
        roots = of_source if of_source.shape[2] == N_SOURCE else root_of(of_source)
        sources = zip(self.updated.x[rows, None, :N_SOURCE], roots[:, None], centroids, strict=True)
        told = (of_row[rows].tolist() for of_row in (self.iterations, self.nis, self.n_differences))
        return [
            TrackPoint(
                time_s,
                mean[:3],
                mean[3:],
                covariance,
                estimable,
                iterations,
                nis,
                dof,
                status="tracked" if dof else "predicted",
                weight=1.0,
                centroid_m=centroid_m,
                radius_m=radius_m,
                mixture=Mixture(x, S, single, N_SOURCE, centroid_m, radius_m),
            )
            for time_s, mean, covariance, estimable, (x, S, centroid_m), iterations, nis, dof in zip(
                times[rows], means, covariances, estimability, sources, *told, strict=True
            )
        ]

    def _steps(self, rows: slice, centroids: FloatArray, x_before: FloatArray) -> list[Step]:
        """Steps for a smoother of some rows, from the state (n,) before them."""
        radius_m, steps = self.tracker.array.circumradius, []
        before, after = (
            Chart.at(some.x[rows], centroids, radius_m).jacobian(np.zeros_like(some.x[rows])) @ some.S[rows]
            for some in (self.predicted, self.updated)
        )
        for j, i in enumerate(range(rows.start, rows.stop)):
            _, F, _ = self.tracker.motion.step(x_before, float(self.steps_s[i]))
            x_before = self.updated.x[i]
            steps.append(Step(i, Prediction(self.predicted.x[i], before[j], F), x_before, after[j]))
        return steps


def _without_nan(values: FloatArray) -> FloatArray:
    """Zeros in the place of NaN; nan_to_num takes a noticeable part of a single row's time."""
    return np.where(np.isnan(values), 0.0, values)
