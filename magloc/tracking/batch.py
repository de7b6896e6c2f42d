"""The track of a long record: :class:`magloc.tracking.tracker.Tracker` with compiled steps between its starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from arrays.typing import FloatArray
from magloc.compilation import own
from magloc.levels import CONTRADICTION
from magloc.measurement.rows import ambient_fields
from magloc.tracking import batch_compiled as kernels
from magloc.tracking.chart.coordinates import FIRM
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.update import LEAST_GAIN, LEAST_SHARE, MOST_ITERATIONS, ROUNDING, TOLERANCE
from magloc.tracking.motion import LinearMotion
from magloc.tracking.results import Row, Step, TrackPoint
from magloc.tracking.tracker import LARGEST_GROWTH, LARGEST_WIDTH, ROWS_TO_LOSE, Tracker, track_point

_STATUS = {kernels.TRACKED: "tracked", kernels.PREDICTED: "predicted", kernels.OUTLIER: "outlier"}


def track_record(
    tracker: Tracker, rows: Sequence[Row], progress: Callable[[int], None] | None = None
) -> list[TrackPoint]:
    """Points of a whole record: as :meth:`Tracker.run`, with compiled steps where the motion is linear.

    Sensors with lasting errors, and a source that may be at several places, are tracked by the readable steps.
    """
    points: list[TrackPoint] = []
    motion, compiled = tracker.motion, None
    if isinstance(motion, LinearMotion) and rows and not tracker.errors.n_states + tracker.pose_errors.n_states:
        compiled = _CompiledSteps(tracker, motion, rows)
    while len(points) < len(rows):
        before = len(points)
        known = tracker.known
        if compiled is not None and known is not None and len(known.mixture) == 1 and not known.young:
            points += compiled.follow(before)
        if len(points) < len(rows):
            points.append(tracker.update(rows[len(points)]))
        if progress is not None:
            progress(len(points) - before)
    return points


class _CompiledSteps:
    """A record in the layout of :func:`magloc.tracking.batch_compiled.follow`."""

    def __init__(self, tracker: Tracker, motion: LinearMotion, rows: Sequence[Row]) -> None:
        array = tracker.array
        self.tracker = tracker
        self.times = [row.time_s for row in rows]
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
        lengths, step_of_row = np.unique(np.diff(self.times, prepend=self.times[0]), return_inverse=True)
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
            rounding=ROUNDING,
            least_gain=LEAST_GAIN,
            least_share=LEAST_SHARE,
            firm=FIRM,
            full=tracker.measurements.n_differences,
            largest_growth=LARGEST_GROWTH,
            rows_to_lose=ROWS_TO_LOSE,
            largest_width=LARGEST_WIDTH,
            radius=array.circumradius,
        )
        n, m = motion.n_states, len(rows)
        self.out = kernels.Followed(
            np.empty((m, n)),
            np.empty((m, n, n)),
            np.empty((m, n)),
            np.empty((m, n, n)),
            np.empty((m, n, n)),
            np.empty((m, n)),
            np.full(m, np.nan),
            *np.zeros((2, m), dtype=np.int64),
        )

    def follow(self, begin: int) -> list[TrackPoint]:
        """Points from a row to the one before the first that a track must start from, or that goes back in time."""
        tracker, times, given, out = self.tracker, self.times, self.given, self.out
        known = tracker.known
        assert known is not None
        mixture = known.mixture
        state = kernels.State(
            mixture.x[0].copy(), mixture.S[0].copy(), mixture.centroid_m.copy(), known.open_loop.copy()
        )
        end, contradictions = kernels.follow(
            begin,
            next((i for i in range(max(begin, 1), len(times)) if times[i] <= times[i - 1]), len(times)),
            state,
            known.contradictions,
            self.channels,
            given,
            self.steps,
            self.rules,
            out,
        )
        if end == begin:
            return []
        centroids = given.origins + given.rotations @ tracker.array.centroid

        def single(row: int, x: FloatArray, S: FloatArray) -> Mixture:
            return replace(mixture, x=x[row][None], S=S[row][None], centroid_m=centroids[row])

        points, steps = [], []
        for i in range(begin, end):
            after = single(i, out.x, out.S)
            if tracker.keep_steps:
                steps.append(Step(i, after, single(i, out.predicted_x, out.predicted_S), out.transition[i]))
            point = track_point(times[i], after, out.open_loop[i])
            points.append(
                replace(
                    point,
                    iterations=int(out.iterations[i]),
                    nis=float(out.nis[i]),
                    nis_dof=int(given.n_differences[i]),
                    status=_STATUS[int(out.status[i])],
                )
            )
        after = replace(mixture, x=state.x[None], S=state.S[None], centroid_m=state.centroid)
        resumed = replace(known, mixture=after, open_loop=state.open_loop, contradictions=contradictions)
        tracker.resume(resumed, times[end - 1], end - begin, steps)
        return points
