"""Several rows that are individually insufficient, as one measurement with correlated noise.

Before a track starts there is no prediction, and similar rows are nonlinear over a cell of the start by more than their
noise, so that a recursive filter becomes overconfident. Here the state is the source in the last row. Its earlier
motion, the errors of the pose and those of the sensors are noise that is correlated between rows, linearised at every
component. Successive rows are averaged, so that the number of means is bounded.
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
"""Least number of means of successive rows, and largest number of rows in one mean."""
MOST_CHANGES = 32
"""Largest number of changes of the missing channels, each of which begins a new mean; earlier rows are dropped."""


@dataclass(frozen=True, eq=False)
class Stack:
    """Rows as one measurement, with the interface of :class:`RowMeasurement`.

    Attributes
    ----------
    rows : sequence of RowMeasurement
        Rows with equally many differences, see :meth:`of`.
    errors, pose_errors : SensorErrors, PoseErrors
        Errors of the rows, and their correlation times.
    motion : MotionModel
        Motion of the source between rows.
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
        """Return the stack of the latest rows, each with any number of differences."""
        changes = _changes(rows)
        latest = rows[changes[-MOST_CHANGES] :] if changes.size >= MOST_CHANGES else rows
        k = max(row.n_differences for row in latest)
        return cls(tuple(row.pad(k) for row in latest), errors, pose_errors, motion)

    @cached_property
    def n_differences(self) -> int:
        """Number of differences without padding."""
        return int(self._transform[self._first_rows].any(axis=2).sum())

    @property
    def row(self) -> Row:
        """Last row."""
        return self.rows[-1].row

    @property
    def model(self) -> DifferenceMeasurement:
        """Measurement model of the last row."""
        return self.rows[-1].model

    @property
    def centroid_m(self) -> FloatArray:
        """Centroid of the sensors in the world frame, in the last row."""
        return self.rows[-1].centroid_m

    @property
    def radius_m(self) -> float:
        """Largest distance of a sensor from the centroid."""
        return self.rows[-1].radius_m

    @property
    def effect(self) -> FloatArray:
        """Empty effect (k, 0), because errors of sensors are part of the noise."""
        return np.zeros((self.z.size, 0))

    def chart(self, x: FloatArray) -> Chart:
        """Return the charts about states (..., 6)."""
        return Chart.at(x, self.centroid_m, self.radius_m)

    def with_errors_as_noise(self, sigma: FloatArray) -> Stack:
        """Return the stack unchanged, because the errors are already part of the noise."""
        return self

    @cached_property
    def _first_rows(self) -> IntArray:
        """Index of the first row of each mean."""
        n = len(self.rows)
        n_means = min(n, max(FEWEST_MEANS, -(-n // MOST_ROWS_OF_ONE)))
        even = np.linspace(0, n, n_means, endpoint=False).astype(np.intp)
        return np.union1d(even, _changes(self.rows))

    @cached_property
    def _row_counts(self) -> IntArray:
        """Number of rows of each mean."""
        return np.diff(np.append(self._first_rows, len(self.rows)))

    @cached_property
    def _middle_rows(self) -> list[RowMeasurement]:
        """Middle row of each mean."""
        return [self.rows[i] for i in (self._first_rows + self._row_counts // 2).tolist()]

    def _means(self, values: FloatArray) -> FloatArray:
        """Return the means (..., k means) of rows (n, ..., k), scaled to unit noise."""
        means = np.add.reduceat(values, self._first_rows, axis=0)
        means /= np.sqrt(self._row_counts).reshape(-1, *[1] * (values.ndim - 1))
        means = np.moveaxis(means, 0, -2)
        return means.reshape(*means.shape[:-2], means.shape[-2] * means.shape[-1])

    def _middle_derivatives(self, values: Sequence[FloatArray]) -> FloatArray:
        """Return derivatives (..., k, m) of the middle rows as those of the means (..., k means, m)."""
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
        """Positions (n, 1, 3) and rotations (n, 3, 3) of the array."""
        poses = [row.pose for row in self.rows]
        origins = np.stack([pose.origin_m for pose in poses])
        return origins[:, None], np.stack([pose.R_world_from_array for pose in poses])

    @cached_property
    def _ambient_T(self) -> FloatArray:
        """Ambient fields (n, 1, N, 3)."""
        return np.stack([row.model.array.ambient_fields for row in self.rows])[:, None]

    @cached_property
    def _transform(self) -> FloatArray:
        """Matrices (n, k, C) from channels to differences of unit noise."""
        return np.stack([row.transform for row in self.rows])

    def _in_arrays(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and moments (n, K, 1, 3) of sources in the array's axes of each row."""
        origin, R = self._pose
        place, moment = (state[:, :3] - origin) @ R, state[:, 3:6] @ R
        return place[:, :, None], moment[:, :, None]

    def predict_source(self, state: FloatArray) -> FloatArray:
        """Return the predicted differences (..., k) of sources (..., 6)."""
        states = state.reshape(-1, N_SOURCE)
        array = self.model.array
        fields = dipole.field(array.positions, *self._in_arrays(states)) + self._ambient_T
        channels = array.readings_of(fields) - array.channel_offset_T
        predicted = self._means(channels @ np.swapaxes(self._transform, -1, -2))
        return predicted.reshape(*state.shape[:-1], predicted.shape[-1])

    def directional_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """Return the derivative (K, k, m) of :meth:`predict_source` along directions (K, 6, m)."""
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
        """Return predicted differences (K, k), and their derivative (K, k, 3) by the moments."""
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
        """Return the derivative (K, k, 3) of the middle rows by the moment of a weak source."""
        return self._middle_derivatives([row.moment_columns(position_m) for row in self._middle_rows])

    @cached_property
    def without_source(self) -> FloatArray:
        """Measured differences (k,) minus those of the ambient field."""
        return self._means(np.stack([row.without_source for row in self.rows]))

    @cached_property
    def whitening(self) -> FloatArray:
        """``C^{-1/2}`` (k, k) of rows without a source."""
        nowhere = np.zeros((1, N_SOURCE))
        return np.linalg.inv(np.linalg.cholesky(self.covariance(nowhere, far=True)[0]))

    def is_detected(self, sigma_errors: FloatArray) -> bool:
        """Return True if the differences exceed noise and the effects of all errors."""
        left = self.whitening @ self.without_source
        return bool(left @ left > energy_threshold(self.n_differences))

    def covariance(self, state: FloatArray, *, far: bool = False) -> FloatArray:
        """Return the covariance (K, k, k) for states (K, 6), or without a source if `far`."""
        k = self.z.size
        C = np.eye(k) + self._sensor_covariance
        parts = []
        by_source, by_pose, error = [], [], np.zeros((len(state), N_POSE))
        for row in self._middle_rows:
            in_array = row.pose.to_array(state)
            by_array = np.zeros((len(state), row.z.size, N_SOURCE))
            if not far:
                by_array = row.model.jacobian(in_array[:, :3], in_array[:, 3:])
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
        """Return columns (K, k, m means) of errors with an effect E and a root `share`."""
        n_means, m = len(share), E.shape[-1]
        columns = E.reshape(len(E), n_means, -1, m)[..., None] * share[:, None, None, :]
        return columns.reshape(len(E), E.shape[1], -1)

    @cached_property
    def _time_s(self) -> FloatArray:
        return np.array([row.row.time_s for row in self.rows])

    def _root_of_means(self, T: FloatArray) -> FloatArray:
        """Return the root (means, means) of the means' covariance, from the rows' root (n, n)."""
        covariance = np.add.reduceat(np.add.reduceat(T, self._first_rows, axis=0), self._first_rows, axis=1)
        covariance /= np.outer(self._row_counts, self._row_counts)
        value, axes = np.linalg.eigh(covariance)
        return np.asarray(axes * np.sqrt(np.maximum(value, 0.0)))

    @cached_property
    def _pose_roots(self) -> dict[float, FloatArray]:
        """Roots over the means of errors of the pose, by their correlation time."""
        apart_s = np.abs(self._time_s[:, None] - self._time_s)
        lasting = np.unique(self.pose_errors.lasts_s).tolist()
        return {
            lasts_s: self._root_of_means(np.exp(-apart_s / lasts_s) if lasts_s else np.eye(len(apart_s)))
            for lasts_s in lasting
        }

    @cached_property
    def _sensor_covariance(self) -> FloatArray:
        """Covariance (k, k) of the differences by the sensors' errors."""
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
            for i, (decay, noise) in enumerate(steps, start=1):
                T[i, :i] = decay[s] * T[i - 1, :i]
                T[:i, i] = T[i, :i]
                T[i, i] = decay[s] ** 2 * T[i - 1, i - 1] + noise[s] ** 2
            part = self._error_columns(E[..., states], self._root_of_means(T))[0]
            added += part @ part.T
        return added

    @cached_property
    def _motion_roots(self) -> tuple[FloatArray, FloatArray]:
        """Roots of the covariance of displacements [m] and of relative changes of the moment.

        A stationary motion is the same backwards in time.
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
    """Return the indices of rows that miss other channels than the row before."""
    available = np.stack([row.row.available for row in rows])
    return 1 + np.flatnonzero((available[1:] != available[:-1]).any(axis=1))


def _unit_moment_state(motion: MotionModel) -> tuple[FloatArray, FloatArray]:
    """Return the state of a unit moment at a known place, and its prior covariance."""
    x, S = motion.start(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), np.zeros((N_SOURCE, N_SOURCE)))
    return x, S @ S.T


def displacement(motion: MotionModel, dt_s: float) -> tuple[float, float]:
    """Return σ of displacement along each axis [m], and of relative change of the moment."""
    x, P = _unit_moment_state(motion)
    _, F, S_q = motion.step(x, dt_s)
    variance = np.diagonal(F @ P @ F.T + S_q @ S_q.T)
    return float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:6].max()))


RowOrStack = RowMeasurement | Stack
"""Measurement that updates a mixture: one row, or several together."""
