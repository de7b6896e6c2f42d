"""Rows of which one alone does not determine a source, all together: as one row with the errors of all as its noise.

Until a track begins nothing is known that could be predicted, and rows that are alike bend over a cell of the start by
more than their noise: a filter from row to row becomes too sure of itself. Here the source is where it is in the last
row, and how it moved before, the errors of the pose and those of the sensors are noise that rows have in common. It is
linearised at every component. Successive rows count as their mean, so that there are few however many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.chi_square import energy_threshold
from magloc.fields import dipole
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.nuisances import SensorErrors
from magloc.measurement.pose import N_POSE, PoseErrors
from magloc.tracking.coordinates import Chart
from magloc.tracking.measurement import RowMeasurement, zero_if_nan
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.rows import Row

FEWEST_MEANS, MOST_ROWS_OF_ONE = 16, 4
"""Means of successive rows that stand for them, at least, and how many rows have one at most."""
MOST_CHANGES = 32
"""Rows at most, the latest, that miss other channels than the row before: each begins a mean of its own."""


@dataclass(frozen=True, eq=False)
class Stack:
    """Rows in the order of time, as :class:`RowMeasurement` of the last one.

    Attributes
    ----------
    rows : sequence of RowMeasurement
        With equally many differences, see :meth:`of`.
    errors, pose_errors : SensorErrors, PoseErrors
        That the rows have, and how long they last.
    motion : MotionModel
        How the source moves from row to row.
    """

    rows: Sequence[RowMeasurement]
    errors: SensorErrors
    pose_errors: PoseErrors
    motion: MotionModel
    n_charted: int = N_SOURCE
    n_pose: int = 0

    @classmethod
    def of(
        cls, rows: Sequence[RowMeasurement], errors: SensorErrors, pose_errors: PoseErrors, motion: MotionModel
    ) -> Stack:
        """Return the latest of some rows, each of any number of differences."""
        changes = _changes(rows)
        latest = rows[changes[-MOST_CHANGES] :] if changes.size >= MOST_CHANGES else rows
        k = max(row.n_differences for row in latest)
        return cls(tuple(row.pad(k) for row in latest), errors, pose_errors, motion)

    @cached_property
    def n_differences(self) -> int:
        """Number of differences without those that only pad rows."""
        return int(self._transform[self._first_rows].any(axis=2).sum())

    @property
    def row(self) -> Row:
        """The last of its rows."""
        return self.rows[-1].row

    @property
    def model(self) -> DifferenceMeasurement:
        """Of the last row."""
        return self.rows[-1].model

    @property
    def centroid_m(self) -> FloatArray:
        """Of the sensors in the world frame, in the last row."""
        return self.rows[-1].centroid_m

    @property
    def radius_m(self) -> float:
        """Largest distance of a sensor from it."""
        return self.rows[-1].radius_m

    @property
    def effect(self) -> FloatArray:
        """No sensor has errors besides the noise (k, 0)."""
        return np.zeros((self.z.size, 0))

    def chart(self, x: FloatArray) -> Chart:
        """About states (..., 6)."""
        return Chart.at(x, self.centroid_m, self.radius_m)

    def with_errors_as_noise(self, sigma: FloatArray) -> Stack:
        """Itself: they are."""
        return self

    @cached_property
    def _first_rows(self) -> IntArray:
        """First rows of the means."""
        n = len(self.rows)
        n_means = min(n, max(FEWEST_MEANS, -(-n // MOST_ROWS_OF_ONE)))
        even = np.linspace(0, n, n_means, endpoint=False).astype(np.intp)
        return np.union1d(even, _changes(self.rows))

    @cached_property
    def _row_counts(self) -> IntArray:
        """Rows of each of them."""
        return np.diff(np.append(self._first_rows, len(self.rows)))

    @cached_property
    def _middle_rows(self) -> list[RowMeasurement]:
        """One row for each."""
        return [self.rows[i] for i in (self._first_rows + self._row_counts // 2).tolist()]

    def _means(self, values: FloatArray) -> FloatArray:
        """Of rows (n, ..., k), of unit noise: (..., k means)."""
        of_each = np.add.reduceat(values, self._first_rows, axis=0)
        of_each /= np.sqrt(self._row_counts).reshape(-1, *[1] * (values.ndim - 1))
        ahead = np.moveaxis(of_each, 0, -2)
        return ahead.reshape(*ahead.shape[:-2], ahead.shape[-2] * ahead.shape[-1])

    def _middle_derivatives(self, values: Sequence[FloatArray]) -> FloatArray:
        """Derivatives (..., k, m) of rows in the middle as those of means (..., k means, m), of unit noise."""
        of_each = np.stack(
            [np.sqrt(size) * value for size, value in zip(self._row_counts, values, strict=True)], axis=-3
        )
        return of_each.reshape(*of_each.shape[:-3], of_each.shape[-3] * of_each.shape[-2], of_each.shape[-1])

    @cached_property
    def z(self) -> FloatArray:
        """Measured differences, shape (k,)."""
        return self._means(np.stack([row.z for row in self.rows]))

    @cached_property
    def _pose(self) -> tuple[FloatArray, FloatArray]:
        """Places (n, 1, 3) and attitudes (n, 3, 3)."""
        poses = [row.pose for row in self.rows]
        origins = np.stack([pose.origin_m for pose in poses])
        return origins[:, None], np.stack([pose.R_world_from_array for pose in poses])

    @cached_property
    def _ambient_T(self) -> FloatArray:
        """Ambient fields (n, 1, N, 3)."""
        return np.stack([row.model.array.ambient_fields for row in self.rows])[:, None]

    @cached_property
    def _transform(self) -> FloatArray:
        """Of channels to differences of unit noise (n, k, C)."""
        return np.stack([row.model.differences.transform / row.sigma[:, None] for row in self.rows])

    def _in_arrays(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places and moments (n, K, 1, 3) of sources in every array's axes."""
        origin, R = self._pose
        place, moment = (state[:, :3] - origin) @ R, state[:, 3:6] @ R
        return place[:, :, None], moment[:, :, None]

    def predict_source(self, state: FloatArray) -> FloatArray:
        """Predicted differences (..., k) of sources (..., 6)."""
        states = state.reshape(-1, N_SOURCE)
        array = self.model.array
        fields = dipole.field(array.positions, *self._in_arrays(states)) + self._ambient_T
        channels = array.readings_of(fields) - array.channel_offset_T
        predicted = self._means(channels @ np.swapaxes(self._transform, -1, -2))
        return predicted.reshape(*state.shape[:-1], predicted.shape[-1])

    def directional_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """Their derivative (K, k, m) along directions (K, 6, m) in states (K, 6)."""
        array, (_, R) = self.model.array, self._pose
        in_arrays = self._in_arrays(state)
        gain = array.linear_gain(dipole.field(array.positions, *in_arrays) + self._ambient_T)
        of_fields = dipole.field_jacobian(array.positions, *in_arrays)[..., array.channel_sensor, :, :]
        by_array = (np.broadcast_to(gain, of_fields.shape[:-1])[..., None, :] @ of_fields)[..., 0, :]
        by_array = self._transform[:, None] @ by_array
        RT = np.swapaxes(R, -1, -2)[:, None]
        by_world = np.concatenate([by_array[..., :3] @ RT, by_array[..., 3:] @ RT], axis=-1)
        means = self._means(np.swapaxes(by_world, -1, -2))  # (K, 6, k)
        return np.asarray(np.swapaxes(means, -1, -2) @ directions)

    def linearise_in_moment(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted differences (K, k) of sources (K, 6), and their derivative (K, k, 3) by the moments."""
        array, (_, R) = self.model.array, self._pose
        place, moment = self._in_arrays(state)
        matrix = dipole.field_matrix(array.positions, place)
        fields = (matrix @ moment[..., None])[..., 0] + self._ambient_T
        channels = array.readings_of(fields) - array.channel_offset_T
        gain = np.broadcast_to(array.linear_gain(fields), (*channels.shape, 3))
        by_array = (gain[..., None, :] @ matrix[..., array.channel_sensor, :, :])[..., 0, :]
        by_world = self._transform[:, None] @ by_array @ np.swapaxes(R, -1, -2)[:, None]
        predicted = self._means(channels @ np.swapaxes(self._transform, -1, -2))
        return predicted, np.swapaxes(self._means(np.swapaxes(by_world, -1, -2)), -1, -2)

    def moment_columns(self, position_m: FloatArray) -> FloatArray:
        """Return the derivative (K, k, 3) of rows in the middle of the means by the moment of a weak source."""
        return self._middle_derivatives([row.moment_columns(position_m) for row in self._middle_rows])

    @cached_property
    def without_source(self) -> FloatArray:
        """What is left of the measured differences (k,) when the ambient field's own are taken out."""
        return self._means(np.stack([row.without_source for row in self.rows]))

    @cached_property
    def whitening(self) -> FloatArray:
        """``C^{-1/2}`` (k, k) of rows without a source."""
        nowhere = np.zeros((1, N_SOURCE))
        return np.linalg.inv(np.linalg.cholesky(self.covariance(nowhere, far=True)[0]))

    def is_detected(self, sigma_errors: FloatArray) -> bool:
        """Whether the differences stand out of noise and of what all errors may make of them."""
        left = self.whitening @ self.without_source
        return bool(left @ left > energy_threshold(self.n_differences))

    def covariance(self, state: FloatArray, *, far: bool = False) -> FloatArray:
        """Of the differences (K, k, k) where the source is at states (K, 6), or so far that there is none."""
        k = self.z.size
        C = np.eye(k) + self._sensor_covariance
        parts = []
        by_source, by_pose, error = [], [], np.zeros((len(state), N_POSE))
        for row in self._middle_rows:
            in_array = row.pose.in_array(state)
            by_array = np.zeros((len(state), row.z.size, N_SOURCE))
            if not far:
                by_array = row.model.jacobian(in_array[:, :3], in_array[:, 3:]) / row.sigma[:, None]
            by_source.append(row._by_source(by_array, None))
            if row.n_pose:
                by_pose.append(zero_if_nan(row._by_pose(by_array, in_array, error)))
        if by_pose:
            E = self._middle_derivatives(by_pose)
            for lasts_s, share in self._pose_roots.items():
                parts.append(self._error_columns(E[..., self.pose_errors.lasts_s == lasts_s], share))
        if not far:
            H = self._middle_derivatives(by_source)
            of_place, of_moment = self._motion_roots
            strength = np.linalg.norm(state[:, 3:6], axis=1)[:, None, None]
            parts += [self._error_columns(H[..., :3], of_place), self._error_columns(strength * H[..., 3:], of_moment)]
        for part in parts:
            C = C + part @ np.swapaxes(part, -1, -2)
        return np.broadcast_to(C, (len(state), k, k))

    def _error_columns(self, E: FloatArray, share: FloatArray) -> FloatArray:
        """Columns (K, k, m means) of errors with an effect E (K, k, m), whose root over the means is share."""
        n_means, m = len(share), E.shape[-1]
        of_each = E.reshape(len(E), n_means, -1, m)
        spread = of_each[..., None] * share[:, None, None, :]
        return spread.reshape(len(E), E.shape[1], -1)

    @cached_property
    def _time_s(self) -> FloatArray:
        return np.array([row.row.time_s for row in self.rows])

    def _root_of_means(self, T: FloatArray) -> FloatArray:
        """Root (means, means) of a covariance of rows (n, n)."""
        of_means = np.add.reduceat(np.add.reduceat(T, self._first_rows, axis=0), self._first_rows, axis=1)
        of_means /= np.outer(self._row_counts, self._row_counts)
        value, axes = np.linalg.eigh(of_means)
        return np.asarray(axes * np.sqrt(np.maximum(value, 0.0)))

    @cached_property
    def _pose_roots(self) -> dict[float, FloatArray]:
        """Roots over the means of the pose's errors, by how long they last."""
        apart_s = np.abs(self._time_s[:, None] - self._time_s)
        lasting = np.unique(self.pose_errors.lasts_s).tolist()
        return {
            lasts_s: self._root_of_means(np.exp(-apart_s / lasts_s) if lasts_s else np.eye(len(apart_s)))
            for lasts_s in lasting
        }

    @cached_property
    def _sensor_covariance(self) -> FloatArray:
        """What the sensors' errors add to the covariance (k, k)."""
        k, n = self.z.size, len(self.rows)
        E = self._middle_derivatives([row.effect[None] for row in self._middle_rows])
        added = np.zeros((k, k))
        if not E.shape[-1]:
            return added
        kinds = np.stack([self.errors.sigma, self.errors.decay_Hz, self.errors.walk], axis=1)
        steps = [self.errors.step(dt_s) for dt_s in np.diff(self._time_s)]
        for kind in np.unique(kinds, axis=0):
            states = np.flatnonzero((kinds == kind).all(axis=1))
            s = states[0]
            T = np.zeros((n, n))
            T[0, 0] = self.errors.sigma[s] ** 2
            for i, (kept, noise) in enumerate(steps, start=1):
                T[i, :i] = kept[s] * T[i - 1, :i]
                T[:i, i] = T[i, :i]
                T[i, i] = kept[s] ** 2 * T[i - 1, i - 1] + noise[s] ** 2
            part = self._error_columns(E[..., states], self._root_of_means(T))[0]
            added += part @ part.T
        return added

    @cached_property
    def _motion_roots(self) -> tuple[FloatArray, FloatArray]:
        """Roots over the means of how far the source was from where it is, in m, and its moment, over its modulus.

        A motion that is stationary is the same backwards.
        """
        n = len(self.rows)
        x, P = _unit_moment_state(self.motion)
        place, moment = np.zeros((2, n, n))
        crossed = np.zeros((n, len(x), len(x)))
        for j, dt_s in enumerate(np.diff(self._time_s)[::-1].tolist(), start=1):
            _, F, S_q = self.motion.step(x, dt_s)
            crossed = F @ crossed
            P = F @ P @ F.T + S_q @ S_q.T
            crossed[j] = P
            at = n - 1 - np.arange(j + 1)
            diagonal = np.diagonal(crossed[: j + 1], axis1=1, axis2=2)
            place[n - 1 - j, at] = place[at, n - 1 - j] = diagonal[:, :3].mean(axis=1)
            moment[n - 1 - j, at] = moment[at, n - 1 - j] = diagonal[:, 3:6].max(axis=1)
        return self._root_of_means(place), self._root_of_means(moment)


def _changes(rows: Sequence[RowMeasurement]) -> IntArray:
    """Rows that miss other channels than the row before."""
    available = np.stack([row.row.available for row in rows])
    return 1 + np.flatnonzero((available[1:] != available[:-1]).any(axis=1))


def _unit_moment_state(motion: MotionModel) -> tuple[FloatArray, FloatArray]:
    """State of a source of unit moment whose place is known, and the covariance of what else moves."""
    x, S = motion.start(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), np.zeros((N_SOURCE, N_SOURCE)))
    return x, S @ S.T


def displacement(motion: MotionModel, dt_s: float) -> tuple[float, float]:
    """How far a source moves in a time, along each axis [m], and its moment, over its modulus: 1 σ."""
    x, P = _unit_moment_state(motion)
    _, F, S_q = motion.step(x, dt_s)
    variance = np.diagonal(F @ P @ F.T + S_q @ S_q.T)
    return float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:6].max()))


RowOrStack = RowMeasurement | Stack
"""What a mixture is updated by: one row, or rows together."""
