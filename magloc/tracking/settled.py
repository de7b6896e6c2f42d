"""Rows of a settled track in one compiled call.

The state is one Gaussian of one source, without errors of the pose.

Offsets of sensors are further states, in which readings are linear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.differences import Differences
from arrays.typing import FloatArray
from magloc import core
from magloc.levels import CONTRADICTION
from magloc.measurement.rows import ambient_fields
from magloc.readings import Readings
from magloc.tracking.chart.mixture import Mixture, root_of
from magloc.tracking.chart.split import MOST_ROWS
from magloc.tracking.chart.steps import LARGEST_GROWTH, LARGEST_WIDTH, TrackState
from magloc.tracking.coordinates import Chart
from magloc.tracking.measurement import RowMeasurements
from magloc.tracking.motion import N_SOURCE, MotionModel, OrnsteinUhlenbeck
from magloc.tracking.results import Innovation, Prediction, Step, TrackPoint
from magloc.tracking.row_filter import LARGEST_BEND, LEAST_SHARE, Gaussians, convergence, refill_step, steps_problem
from magloc.tracking.rows import Row, Rows

MOST_AT_ONCE = 64
"""Largest number of rows of one call."""
_TERMS_A_CALL = 10_000_000
"""Approximate number of products that the kernel computes between checks for Ctrl-C: some 50 ms."""
_TERMS_OF_STEPS = 3000
"""Products of a row that do not depend on the number of its differences."""
_MOST_ERRORS, _MOST_NUMBERS = 100, 500_000
"""Largest number of errors of sensors for which the kernel is faster than NumPy, and of numbers in a call's roots."""


@dataclass(frozen=True, eq=False)
class SettledRows:
    """Points of rows, the last row, the state after it, its innovation, and smoother steps."""

    points: list[TrackPoint]
    last: Row
    known: TrackState
    innovation: Innovation | None
    steps: list[Step]


class SettledTrack:
    """Arguments of the kernel, whose arrays are filled again for every call.

    Parameters
    ----------
    array : SensorArray
    motion : MotionModel
        A linear motion, or :class:`OrnsteinUhlenbeck`.
    measurements : RowMeasurements
    full_count : int
        Number of differences of a row without missing readings.
    """

    def __init__(self, array: SensorArray, motion: MotionModel, measurements: RowMeasurements, full_count: int) -> None:
        self._array, self._motion, self._measurements = array, motion, measurements
        self._differences: Differences | None = None
        self._has_ambients = False
        errors, k, n_channels = measurements.errors, full_count, array.n_channels
        n, e = motion.n_states, errors.n_states
        N = n + e
        m = self._most = max(1, min(MOST_AT_ONCE, _MOST_NUMBERS // N**2))
        one = np.zeros(m, dtype=np.int64)
        self._rows = Rows(
            array,
            np.zeros((m, k)),
            np.zeros(m, dtype=np.int64),
            np.zeros((1, k, n_channels)),
            one,
            np.zeros((1, k, e)),
            np.zeros((m, 3)),
            np.zeros((m, 3, 3)),
            np.tile(array.ambient_fields, (m, 1, 1)),
        )
        self._slot_of_step: dict[float, int] = {}
        self._step_of_row = np.zeros(m, dtype=np.int64)
        noisy = (np.zeros((m, e)), np.zeros((m, e))) if errors.decay_Hz.any() or errors.walk.any() else None
        self._motions = steps_problem(motion, [0.0] * m, self._step_of_row, noisy)
        self._values, self._centroid, self._open_loop = np.empty((m, n_channels)), np.empty(3), np.empty((n, n))
        self._state = Gaussians(np.empty((1, N)), np.empty((1, N, N)), n_nuisances=e)
        self._predicted, self._updated = (
            Gaussians(np.empty((m, N)), np.empty((m, N, N)), n_nuisances=e) for _ in range(2)
        )
        self._means, self._estimability = np.empty((2, m, N_SOURCE))
        self._covariances = np.empty((m, N_SOURCE, N_SOURCE))
        self._nis, self._innovation, self._iterations = np.empty(m), np.empty((m, k)), np.empty(m, dtype=np.int64)
        self._correction = np.empty(m)
        self._progress = np.zeros(3, dtype=np.int64)
        self._block = max(1, _TERMS_A_CALL // (_TERMS_OF_STEPS + k * n_channels + N**3))
        self._work = core.problem(
            "track",
            rows=self._rows.problem,
            motion=self._motions,
            convergence=convergence(),
            nis_limits=np.asarray(chdtri(np.maximum(np.arange(k + 1), 1), CONTRADICTION), dtype=np.float64),
            largest_width=LARGEST_WIDTH,
            largest_bend=math.inf if e else LARGEST_BEND,  # with errors of sensors no component is divided
            longest_memory=MOST_ROWS,
            largest_growth=LARGEST_GROWTH,
            full_count=full_count,
            least_share=LEAST_SHARE,
            state=self._state.problem,
            centroid=self._centroid,
            open_loop=self._open_loop,
            progress=self._progress,
            predicted=self._predicted.problem,
            updated=self._updated.problem,
            means=self._means,
            covariances=self._covariances,
            estimability=self._estimability,
            nis=self._nis,
            innovation=self._innovation,
            correction=self._correction,
            iterations=self._iterations,
        )
        self._space = core.new_workspace("follow_sources", self._work)

    @staticmethod
    def of(
        array: SensorArray, motion: MotionModel, measurements: RowMeasurements, full_count: int
    ) -> SettledTrack | None:
        """Return the arguments, or None if the kernel lacks the motion or some of the errors."""
        errors = measurements.errors
        has_errors = not errors.is_constant or measurements.pose_errors.n_states or errors.n_states > _MOST_ERRORS
        # isinstance of a protocol is slow: it tests all of its attributes.
        if has_errors or not (isinstance(motion, OrnsteinUhlenbeck) or hasattr(motion, "linear_step")):
            return None
        return SettledTrack(array, motion, measurements, full_count)

    def follow(
        self,
        known: TrackState,
        time_s: float,
        last: Innovation | None,
        rows: Sequence[Row | Readings],
        first_index: int | None = None,
    ) -> SettledRows | None:
        """Follow the track through the first of some rows.

        Parameters
        ----------
        known : Known
            A settled track before the rows.
        time_s : float
            Time of the row before.
        last : Innovation, optional
            Innovation of the row before.
        rows : sequence of Row
            Rows after the first :class:`Readings` among them are not used.
        first_index : int, optional
            Index of the first row, if steps for a smoother are requested.

        Returns
        -------
        SettledRows or None
            Results up to the first row that misses other channels, goes back in time, or does not continue the track;
            None if that is the first one. The Python steps take that row.
        """
        if known.used is not None and self._measurements.errors.n_states:
            return None  # the step counts from the last row whose readings were used
        taken, mixture = self._fill(rows[: self._most], time_s), known.mixture
        n = len(taken)
        self._state.x[:], self._state.S[:], self._centroid[:] = mixture.x, mixture.S, mixture.centroid_m
        self._open_loop[:], self._progress[:] = known.open_loop, (0, 1, mixture.n_rows)
        core.run("follow_sources", self._work, n, block=self._block, chain=n or None, workspace=self._space)
        end = int(self._progress[0])
        if not end:
            return None
        centroids = self._rows.origins_m[:end] + self._rows.rotations[:end] @ self._array.centroid
        steps = [] if first_index is None else self._steps(first_index, end, centroids, mixture.x[0])
        x, S, open_loop, n_rows = self._state.x.copy(), self._state.S.copy(), self._open_loop.copy(), self._progress[2]
        after = replace(mixture, x=x, S=S, centroid_m=centroids[-1], n_rows=int(n_rows))
        dof = int(self._rows.counts[0])
        if dof:
            known = replace(known, mixture=after, open_loop=open_loop, contradictions=0, has_range=True, used=None)
        else:
            known = replace(known, mixture=after, open_loop=open_loop, used=known.used or known.mixture)
        lag1, innovation = self._lag1(taken[:end], dof, last)
        return SettledRows(self._points(taken[:end], dof, lag1, centroids), taken[end - 1], known, innovation, steps)

    def _fill(self, rows: Sequence[Row | Readings], time_s: float) -> list[Row]:
        """Copy rows with the first one's differences into the arguments, and return them."""
        differences, given, taken = None, self._rows, list[Row]()
        if len(self._slot_of_step) + len(rows) > self._most:
            self._slot_of_step.clear()
        for i, row in enumerate(rows):
            if not isinstance(row, Row):
                break
            dt_s, time_s, own = row.time_s - time_s, row.time_s, self._measurements.differences(row)
            differences = differences or own
            if own is not differences or not 0.0 < dt_s < math.inf:
                break
            slot = self._slot_of_step.get(dt_s)
            if slot is None:
                slot = self._slot_of_step[dt_s] = len(self._slot_of_step)
                refill_step(self._motions, slot, self._motion, self._measurements.errors, dt_s)
            self._step_of_row[i] = slot
            self._values[i], given.origins_m[i], given.rotations[i] = (
                row.readings_T,
                row.origin_m,
                row.R_world_from_array,
            )
            if row.ambient_T is not None or self._has_ambients:
                ambient_T = None if row.ambient_T is None else row.ambient_T[None]
                given.ambients_T[i] = ambient_fields(self._array, 1, ambient_T)[0]
                self._has_ambients = True
            taken.append(row)
        if differences is not None and differences is not self._differences:
            self._differences, k = differences, differences.n_differences
            given.transforms[0, :k] = differences.transform
            given.transforms[0, k:] = 0.0
            given.counts[:] = k
            errors = self._measurements.errors
            if errors.n_states:
                given.effects[0] = given.transforms[0] @ errors.effect(self._array, self._values[0])
        values = self._values[: len(taken)] - self._array.channel_offset_T
        values[np.isnan(values)] = 0.0  # of no weight
        # One product for each row, so that rounding does not depend on the number of rows.
        given.readings[: len(taken)] = (given.transforms @ values[..., None])[..., 0]
        return taken

    def _lag1(self, rows: Sequence[Row], dof: int, last: Innovation | None) -> tuple[list[float], Innovation | None]:
        """Return products of successive innovations, and the innovation of the last row."""
        if not dof:
            return [math.nan] * len(rows), None
        whitened = self._innovation[: len(rows), :dof].copy()
        if self._measurements.errors.n_states:
            self._correction[: len(rows)] = np.nan
        first = Innovation(rows[0].available, whitened[0]).statistics(last)["lag1"]
        return [first, *(whitened[1:] * whitened[:-1]).sum(axis=1).tolist()], Innovation(
            rows[-1].available, whitened[-1]
        )

    def _points(self, rows: Sequence[Row], dof: int, lag1: list[float], centroids: FloatArray) -> list[TrackPoint]:
        end, single, radius_m = len(rows), np.zeros(1), self._array.circumradius
        means, covariances, estimability = (
            some[:end].copy() for some in (self._means, self._covariances, self._estimability)
        )
        x, rows_of_S = self._updated.x[:end, None, :N_SOURCE].copy(), self._updated.S[:end, None, :N_SOURCE]
        S = root_of(rows_of_S) if self._measurements.errors.n_states else rows_of_S.copy()
        columns = (some[:end].tolist() for some in (self._iterations, self._nis, self._correction))
        statistics = zip(*columns, lag1, strict=True)
        return [
            TrackPoint(
                row.time_s,
                means[i, :3],
                means[i, 3:],
                covariances[i],
                estimability[i],
                iterations,
                nis,
                dof,
                status="tracked" if dof else "predicted",
                weight=1.0,
                centroid_m=centroids[i],
                radius_m=radius_m,
                lag1=product,
                correction=correction,
                mixture=Mixture(x[i], S[i], single, N_SOURCE, centroids[i], radius_m),
            )
            for i, (row, (iterations, nis, correction, product)) in enumerate(zip(rows, statistics, strict=True))
        ]

    def _steps(self, first_index: int, end: int, centroids: FloatArray, x_before: FloatArray) -> list[Step]:
        """Return the rows' steps for a smoother, from the state (n,) before them."""
        steps, radius_m = [], self._array.circumradius
        before, after = (
            Chart.at(some.x[:end], centroids, radius_m).jacobian(np.zeros_like(some.x[:end])) @ some.S[:end]
            for some in (self._predicted, self._updated)
        )
        length_of_slot = {slot: dt_s for dt_s, slot in self._slot_of_step.items()}
        for i, (predicted, x) in enumerate(
            zip(self._predicted.x[:end].copy(), self._updated.x[:end].copy(), strict=True)
        ):
            _, F, S_q = self._motion.step(x_before, length_of_slot[int(self._step_of_row[i])])
            steps.append(Step(first_index + i, Prediction(predicted, before[i], F, S_q), x, after[i]))
            x_before = x
        return steps
