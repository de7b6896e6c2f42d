r"""Whitening of a survey in time: correlated pose errors, offset walks, field variation.

These disturbances are a linear model of states that change from row to row,

.. math:: y_i = H_i x_i + ν_i, \qquad x_{i+1} = F_i x_i + w_i

so that the normalised innovations of a Kalman filter are white. The filter is linear, so columns of a Jacobian pass
through it as the readings do. The result is an ordinary least-squares problem in the sources.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.measurement.pose import SHIFT, PoseErrors
from magloc.surveying.fit.kernels import MeasuredRows, WhiteningFilter
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.sensor_noise import white_noise_T

OFFSET_T = 1e-6
"""Initial standard deviation of a sensor's offset."""
_HOUR_S = 3600.0
_LONGEST_GAP_S = _HOUR_S  # after an hour the ambient field is unknown again; a longer gap would only lose digits


@dataclass(frozen=True)
class SurveyDrift:
    """Spectral densities of slow changes at all sensors.

    Attributes
    ----------
    common_T2_s3 : float
        Density of the white noise that is the second derivative of the ambient field.
    sensor_T2_s : float
        Density of the random walk of every sensor's offset.
    """

    common_T2_s3: float = (0.05e-9) ** 2
    sensor_T2_s: float = (0.005e-9) ** 2


@dataclass(frozen=True, eq=False)
class RecordWhitening:
    """Linear map that makes a record's noise white, at given fields of sources.

    Attributes
    ----------
    U : ndarray, shape (k, C)
        Matrix from channels to independent measurements, in units of their noise.
    group : ndarray of int, shape (n,)
        Group of each row; the mean of a group counts as one row.
    filter : WhiteningFilter
        Kalman filter over the groups.
    """

    U: FloatArray
    group: IntArray
    filter: WhiteningFilter

    @classmethod
    def of(
        cls,
        record: SurveyRecord,
        by_pose: FloatArray,
        by_turn: tuple[FloatArray, FloatArray],
        by_square: FloatArray,
        errors: PoseErrors,
        drift: SurveyDrift,
        group: IntArray,
    ) -> RecordWhitening:
        """Return the map for derivatives (n, C, q) of the channels by pose errors.

        ``by_turn``: derivatives (n, C, ...) by lasting attitude errors of the carrier's fields, and by those that are
        independent from row to row. ``by_square``: derivative (n, C, 5) by squares of the shift, or none.
        """
        U = independent_measurements(record)
        scale = np.sqrt(1.0 / np.bincount(group))
        time_s = np.bincount(group, record.time_s) * scale**2
        dt_s = np.diff(time_s, prepend=time_s[0])
        of_pose = errors.step(dt_s)[0]
        lasting = of_pose[:, errors.of_pose == SHIFT.start][:, :1]  # errors with the stated correlation time
        more = (
            (by_turn[0], lasting),
            (by_turn[1], 0.0 * lasting),
            (by_square, lasting**2),
        )  # the correlation time of a square is half as long
        of_pose = np.concatenate(
            [of_pose, *(np.repeat(share, columns.shape[2], axis=1) for columns, share in more)], axis=1
        )
        seen, white = U @ np.concatenate([by_pose, *by_turn, by_square], axis=2), (of_pose == 0.0).all(axis=0)
        # Errors of rates count as equal in a group, because central differences of successive rows share a step.
        white[by_pose.shape[2] + by_turn[0].shape[2] :][: by_turn[1].shape[2]] = False
        seen = np.concatenate(
            [_sum_groups(seen[..., ~white], group, scale), _mean_covariance_roots(seen[..., white], group, scale)],
            axis=2,
        )
        C, q = record.array.n_channels, seen.shape[2]
        # Offsets of the channels, and their common part along the ambient field.
        H = np.zeros((len(time_s), len(U), q + C + 2))
        H[..., :q] = seen
        H[..., q : q + C] = U / scale[:, None, None]
        H[..., q + C] = _sum_groups((record.along @ U.T)[..., None], group, scale)[..., 0]
        kept, added = np.ones((len(dt_s), q + C + 2)), np.zeros((len(dt_s), q + C + 2))
        kept[:, :q] = 0.0
        kept[:, : (~white).sum()] = of_pose[:, ~white]
        added[1:, :q] = 1.0 - kept[1:, :q] ** 2
        kept[0] = 1.0
        walk = np.array([sensor.drift_T_rth**2 / _HOUR_S for sensor in record.array.sensors]) + drift.sensor_T2_s
        added[:, q : q + C] = np.minimum(dt_s[:, None] * walk[record.array.channel_sensor], OFFSET_T**2)
        dt_s = np.minimum(dt_s, _LONGEST_GAP_S)
        added[:, -2], added[:, -1] = drift.common_T2_s3 * dt_s**3 / 3.0, drift.common_T2_s3 * dt_s
        start = np.concatenate([np.ones(q), np.full(C, OFFSET_T**2), [OFFSET_T**2, (1e-2 * OFFSET_T) ** 2]])
        return cls(U, group, WhiteningFilter(H, kept, added, dt_s, start))

    def __call__(self, channels: FloatArray) -> FloatArray:
        """Return white columns (g·k, m) of columns (n, C, m) of the channels."""
        summed = _sum_groups(self.U @ channels, self.group, np.sqrt(1.0 / np.bincount(self.group)))
        return self.of_groups(np.ascontiguousarray(summed))

    def entries(self, groups: IntArray) -> IntArray:
        """Return the indices of some groups' measurements in white columns."""
        k = len(self.U)
        return np.asarray((groups[:, None] * k + np.arange(k)).ravel())

    def of_some(self, channels: FloatArray, groups: IntArray) -> FloatArray:
        """Return white columns (g'·k, m) of columns (n', C, m) of some groups.

        The columns are zero in other groups.
        """
        count = np.diff(self.starts)[groups]
        Y = _sum_groups(self.U @ channels, np.repeat(np.arange(len(groups)), count), np.sqrt(1.0 / count))
        self.filter.whiten(Y, groups)
        return Y.reshape(-1, Y.shape[2])

    def measured_rows(self, record: SurveyRecord, directions: FloatArray) -> MeasuredRows:
        """Return a record's groups of rows, given the directions (n, C, 3) of the channels."""
        return MeasuredRows(record.sensors_m, directions, self.U, record.array.channel_sensor, self.starts)

    def of_moments(
        self, record: SurveyRecord, directions: FloatArray, places_m: FloatArray, groups: IntArray
    ) -> FloatArray:
        """Return white columns (g·k, 3 m) of unit moments at places (m, 3) in some groups.

        The columns are zero in other groups.
        """
        columns = self.measured_rows(record, directions).moment_columns(places_m, groups)
        self.filter.whiten(columns, groups)
        return columns.reshape(-1, columns.shape[2])

    @property
    def log_determinant(self) -> float:
        """Log-determinant of the noise's covariance."""
        return float(-2.0 * np.log(self.filter.gains[..., -1]).sum())

    @cached_property
    def starts(self) -> IntArray:
        """First row of every group, and the end of the last one."""
        return np.flatnonzero(np.diff(self.group, prepend=-1, append=self.group[-1] + 1))

    @property
    def n_groups(self) -> int:
        """Number of groups."""
        return len(self.filter.gains)

    def of_groups(self, Y: FloatArray) -> FloatArray:
        """Whiten columns (g, k, m) of independent measurements in place; return (g·k, m)."""
        self.filter.whiten(Y, np.arange(len(Y)))
        return Y.reshape(len(Y) * Y.shape[1], Y.shape[2])


def independent_measurements(record: SurveyRecord) -> FloatArray:
    """Return rows (k, C) that make channels independent, with unit variance.

    The directions that attitude errors change are projected out.
    """
    sigma = white_noise_T(record.array)
    unit = record.ambient_T.mean(axis=0)
    unit = unit / np.linalg.norm(unit)
    across = np.linalg.svd(unit[None])[2][1:]
    lost = np.zeros((record.array.n_channels, 2))
    lost[record.is_vector] = np.tile(across.T, (int(record.is_vector.sum()) // 3, 1))
    U, s, _ = np.linalg.svd(lost / sigma[:, None], full_matrices=True)
    kept = U[:, int((s > 0.0).sum()) :]
    return np.asarray(kept.T / sigma)


def _sum_groups(rows: FloatArray, group: IntArray, scale: FloatArray) -> FloatArray:
    """Return sums of the rows (n, ...) of every group, over the root of their number."""
    if len(scale) == len(rows):
        return rows
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    return np.add.reduceat(rows, starts, axis=0) * scale.reshape(-1, *[1] * (rows.ndim - 1))


def _mean_covariance_roots(rows: FloatArray, group: IntArray, scale: FloatArray) -> FloatArray:
    """Return roots (g, k, q) of the mean covariance of columns (n, k, q) in each group.

    The errors of the columns are independent from row to row.
    """
    if not rows.shape[2] or (len(scale) == len(rows) and rows.shape[2] <= rows.shape[1]):
        return rows[: len(scale)]
    square, axes = np.linalg.eigh(_sum_groups(rows @ rows.mT, group, scale**2))
    return np.asarray(axes * np.sqrt(np.maximum(square, 0.0))[:, None])[..., -rows.shape[2] :]
