"""The track of a long record: :class:`magloc.tracking.tracker.Tracker` with compiled steps between its starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import chdtri

from magloc.compilation import own
from magloc.kalman import estimability
from magloc.levels import CONTRADICTION
from magloc.measurement.rows import ambient_fields
from magloc.tracking import batch_compiled as kernels
from magloc.tracking.measurement import LEAST_SINGULAR
from magloc.tracking.motion import N_SOURCE, LinearMotion
from magloc.tracking.results import Prediction, Row, Step, TrackPoint
from magloc.tracking.tracker import (
    LARGEST_GROWTH,
    LARGEST_RANGE_ERROR,
    MOST_ITERATIONS,
    REFIX_RANGE_ERROR,
    ROWS_TO_LOSE,
    SHRINK,
    TOLERANCE,
    Tracker,
)

_MOST_AT_ONCE = 64
_STATUS = {kernels.TRACKED: "tracked", kernels.PREDICTED: "predicted", kernels.OUTLIER: "outlier"}


def track_record(
    tracker: Tracker, rows: Sequence[Row], progress: Callable[[int], None] | None = None
) -> list[TrackPoint]:
    """Points of a whole record, or of the next rows of one: as :meth:`Tracker.run`, with compiled steps if there are.

    Sensors with lasting errors are tracked by the readable steps.
    """
    points: list[TrackPoint] = []
    motion = compiled_motion(tracker)
    compiled = _CompiledSteps(tracker, motion, rows) if motion is not None and rows else None
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
    many = tracker.is_tracking and compiled_motion(tracker) is not None
    return track_record(tracker, rows[begin : begin + (_MOST_AT_ONCE if many else 1)])


def compiled_motion(tracker: Tracker) -> LinearMotion | None:
    """The motion of a tracker whose steps are compiled, None where they are not."""
    motion = tracker.motion
    return motion if isinstance(motion, LinearMotion) and not tracker.n_errors else None


class _CompiledSteps:
    """A record in the layout of :func:`magloc.tracking.batch_compiled.follow`."""

    def __init__(self, tracker: Tracker, motion: LinearMotion, rows: Sequence[Row]) -> None:
        array = tracker.array
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
        channels = np.nan_to_num(np.stack([row.readings_T for row in rows]) - array.channel_offset_T)
        ambients, ambient_of_row = own(array.ambient_fields[None]), np.zeros(len(rows), dtype=np.int64)
        if any(row.ambient_T is not None for row in rows):
            usual = np.zeros(3) if array.ambient_T is None else np.asarray(array.ambient_T)
            of_rows = np.stack([usual if row.ambient_T is None else row.ambient_T for row in rows])
            ambients, ambient_of_row = ambient_fields(array, len(rows), of_rows), np.arange(len(rows))
        self.given = kernels.Rows(
            z=(transforms[transform_of_row] @ channels[..., None])[..., 0],
            n_differences=np.array([of_row.n_differences for of_row in differences]),
            transforms=transforms,
            transform_of_row=transform_of_row,
            origins=np.stack([row.origin_m for row in rows]),
            rotations=np.stack([row.R_world_from_array for row in rows]),
            ambients=ambients,
            ambient_of_row=ambient_of_row,
        )
        since_before = np.nan_to_num(np.subtract(self.times, self.times_before))  # NaN of the first of all
        lengths, step_of_row = np.unique(since_before, return_inverse=True)
        steps = [motion.linear_step(max(length, 0.0)) for length in lengths.tolist()]
        F, A, B = (np.stack(part) for part in zip(*steps, strict=True))
        self.steps = kernels.Steps(F, A, B, step_of_row)
        self.channels = kernels.Channels(
            array.positions, array.centroid, array.channel_sensor, array.channel_is_scalar, array.channel_gain
        )
        self.rules = kernels.Rules(
            nis_limits=np.asarray(chdtri(np.maximum(np.arange(k + 1), 1), CONTRADICTION), dtype=np.float64),
            tolerance=TOLERANCE,
            max_iterations=MOST_ITERATIONS,
            step_shrink=SHRINK,
            least_singular=LEAST_SINGULAR,
            largest_growth=LARGEST_GROWTH,
            rows_to_lose=ROWS_TO_LOSE,
            start_range_error=REFIX_RANGE_ERROR,
            largest_range_error=LARGEST_RANGE_ERROR,
        )
        n = motion.n_states
        self.out = kernels.Followed(
            np.empty((len(rows), n)),
            np.empty((len(rows), n, n)),
            np.empty((len(rows), n)),
            np.empty((len(rows), n, n)),
            np.full(len(rows), np.nan),
            *np.zeros((2, len(rows)), dtype=np.int64),
        )

    def follow(self, begin: int) -> list[TrackPoint]:
        """Points from a row to the one before the first that has to be acquired, or that goes back in time."""
        tracker, array, times, before = self.tracker, self.tracker.array, self.times, self.times_before
        x, S, contradictions = tracker.state()
        end, contradictions = kernels.follow(
            begin,
            next((i for i in range(begin, len(times)) if times[i] <= before[i]), len(times)),
            x,
            S,
            contradictions,
            self.channels,
            self.given,
            self.steps,
            self.rules,
            self.out,
        )
        if end == begin:
            return []
        given, out = self.given, self.out
        steps = [
            Step(
                i,
                Prediction(out.predicted_x[i], out.predicted_S[i], self.steps.F[self.steps.of_row[i]]),
                out.x[i],
                out.S[i],
            )
            for i in range(begin, end)
        ]
        tracker.resume(x, S, times[end - 1], contradictions, steps)
        roots, predicted = out.S[begin:end], out.predicted_S[begin:end]
        covariance = (roots @ roots.swapaxes(-1, -2))[:, :N_SOURCE, :N_SOURCE]
        learned = estimability(roots, predicted)[:, :N_SOURCE]
        centroids = given.origins[begin:end] + given.rotations[begin:end] @ array.centroid
        return [
            TrackPoint(
                times[i],
                out.x[i, :3],
                out.x[i, 3:6],
                covariance[i - begin],
                learned[i - begin],
                int(out.iterations[i]),
                float(out.nis[i]),
                int(given.n_differences[i]),
                status=_STATUS[int(out.status[i])],
                weight=tracker.weight,
                centroid_m=centroids[i - begin],
                radius_m=array.circumradius,
            )
            for i in range(begin, end)
        ]
