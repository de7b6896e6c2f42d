"""All rows of a young track together, fitted anew from every component that is left.

A filter linearises every row where it stood then, and while a source comes out of the noise it stood elsewhere. Gauss
and Newton's iteration over the whole track, in the chart, is a filter and a smoother that linearise along the last
trajectory, until that stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc.measurement.nuisances import SensorErrors
from magloc.tracking.chart import Chart
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.mixture import Mixture
from magloc.tracking.motion import MotionModel
from magloc.tracking.start import first_root

_MOST_PASSES = 15
# Change of the last state, in its standard deviations, below which the trajectory stays.
_TOLERANCE = 0.02
# Longest step of log-range and direction in a pass.
_LONGEST = 0.5


def refitted(
    mixture: Mixture, measurements: Sequence[RowMeasurement], motion: MotionModel, errors: SensorErrors
) -> tuple[Mixture, FloatArray]:
    """Components after the last of the rows, not yet weighed against each other, and the χ² (K,) of all rows.

    Components that do not converge are left out.
    """
    rows = _Rows(measurements, motion, errors)
    track = rows.backwards(mixture.x)
    converged = np.zeros(len(mixture), dtype=bool)
    for _ in range(_MOST_PASSES):
        found = rows.passed(track)
        largest = np.abs(found.offset[:, :, :3]).max(axis=(0, 2))
        length = np.minimum(1.0, _LONGEST / np.maximum(largest, _LONGEST))
        sigma = np.sqrt(np.diagonal(found.P, axis1=1, axis2=2))[:, : rows.n]
        converged = np.max(np.abs(found.offset[-1]) / sigma, axis=1) < _TOLERANCE
        track = rows.moved(track, length[:, None] * found.offset)
        if converged.all():
            break
    n = rows.n
    x = np.concatenate([track[-1], found.errors], axis=1)
    S = np.zeros_like(found.P)
    for k in np.flatnonzero(converged):
        S[k] = np.linalg.cholesky(found.P[k, ::-1, ::-1])[::-1, ::-1]
    last = measurements[-1]
    after = Mixture(x, S, found.log_evidence, n, last.centroid_m, last.radius_m)
    kept = np.flatnonzero(converged)
    return replace(after, x=x[kept], S=S[kept], log_weight=found.log_evidence[kept]), found.nis[kept]


@dataclass(frozen=True, eq=False)
class _Passed:
    """One pass: smoothed offsets (rows, K, n) from the trajectory, and what is known after the last row."""

    offset: FloatArray
    errors: FloatArray
    P: FloatArray
    nis: FloatArray
    log_evidence: FloatArray


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of a track, and how the source moves between them."""

    measurements: Sequence[RowMeasurement]
    motion: MotionModel
    errors: SensorErrors

    @property
    def n(self) -> int:
        return self.motion.n_states

    def _dt_s(self, row: int) -> float:
        return self.measurements[row].row.time_s - self.measurements[row - 1].row.time_s

    def _chart(self, track: FloatArray, row: int) -> Chart:
        return Chart.at(track[row], self.measurements[row].centroid_m, self.measurements[row].radius_m)

    def backwards(self, x: FloatArray) -> FloatArray:
        """Trajectories (rows, K, n) without noise that end at states (K, N)."""
        track = [x[:, : self.n]]
        for row in range(len(self.measurements) - 1, 0, -1):
            steps = [self.motion.step(state, self._dt_s(row)) for state in track[-1]]
            back = [state - np.linalg.solve(step[1], step[0] - state) for state, step in zip(track[-1], steps, strict=True)]
            track.append(np.array(back))
        return np.array(track[::-1])

    def moved(self, track: FloatArray, offset: FloatArray) -> FloatArray:
        """Trajectories at offsets (rows, K, n) in the charts about others."""
        return np.array([self._chart(track, row).retracted(offset[row]) for row in range(len(track))])

    def passed(self, track: FloatArray) -> _Passed:
        """A filter and a smoother that linearise along trajectories (rows, K, n)."""
        n, n_errors, K = self.n, self.errors.n_states, track.shape[1]
        N = n + n_errors
        chart = self._chart(track, 0)
        root = np.zeros((K, N, N))
        root[:, :n, :n] = chart.inverse_jacobian() @ first_root(chart, self.motion)
        root[:, np.arange(n, N), np.arange(n, N)] = self.errors.sigma
        mean, P = np.zeros((K, N)), root @ _T(root)
        nis, log_evidence = np.zeros(K), np.zeros(K)
        means, covariances, predictions, transitions = [], [], [], []
        for row, measurement in enumerate(self.measurements):
            if row:
                mean, P, transition = self._step(track, row, mean, P)
                transitions.append(transition)
            predictions.append((mean, P))
            chart = self._chart(track, row)
            L = chart.jacobian(np.zeros_like(chart.x))[:, :6]
            J = np.concatenate(
                [
                    measurement.source_jacobian(track[row][:, :6]) @ L,
                    np.broadcast_to(measurement.effect, (K, *measurement.effect.shape)),
                ],
                axis=2,
            )
            left = measurement.z - measurement.of_source(track[row][:, :6]) - (J @ mean[..., None])[..., 0]
            PJ = P @ _T(J)
            L_S = np.linalg.cholesky(np.eye(J.shape[1]) + J @ PJ)
            white = np.linalg.solve(L_S, np.concatenate([_T(PJ), left[..., None]], axis=2))
            nis = nis + np.sum(white[..., -1] ** 2, axis=1)
            log_det = 2.0 * np.sum(np.log(np.diagonal(L_S, axis1=1, axis2=2)), axis=1)
            log_evidence = log_evidence - 0.5 * (np.sum(white[..., -1] ** 2, axis=1) + log_det)
            mean = mean + (_T(white[..., :-1]) @ white[..., -1:])[..., 0]
            P = P - _T(white[..., :-1]) @ white[..., :-1]
            means.append(mean)
            covariances.append(P)
        smoothed, offsets = mean, [mean[:, :n]]
        for row in range(len(self.measurements) - 1, 0, -1):
            predicted, predicted_P = predictions[row]
            change = _solved(predicted_P, smoothed - predicted)
            smoothed = means[row - 1] + (covariances[row - 1] @ (_T(transitions[row - 1]) @ change))[..., 0]
            offsets.append(smoothed[:, :n])
        return _Passed(np.array(offsets[::-1]), mean[:, n:], P, nis, log_evidence)

    def _step(
        self, track: FloatArray, row: int, mean: FloatArray, P: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean and covariance predicted to a row, in the charts about the trajectory, and the transition there."""
        n, before, after = self.n, self._chart(track, row - 1), self._chart(track, row)
        steps = [self.motion.step(state, self._dt_s(row)) for state in track[row - 1]]
        F, S_q = np.stack([step[1] for step in steps]), np.stack([step[2] for step in steps])
        kept, added = self.errors.step(self._dt_s(row))
        transition = np.zeros_like(P)
        transition[:, n:, n:] = np.diag(kept)
        inverse = after.inverse_jacobian()
        transition[:, :n, :n] = inverse @ F @ before.jacobian(np.zeros_like(before.x))
        noise = inverse @ S_q
        mean = (transition @ mean[..., None])[..., 0]
        mean[:, :n] += after.coordinates(np.stack([step[0] for step in steps]))
        P = transition @ P @ _T(transition)
        P[:, :n, :n] += noise @ _T(noise)
        P[:, np.arange(n, P.shape[1]), np.arange(n, P.shape[1])] += added**2
        return mean, 0.5 * (P + _T(P)), transition


def _solved(P: FloatArray, right: FloatArray) -> FloatArray:
    """P⁻¹ right (K, N, 1), by the correlations: states are of mixed units, and some are known for certain."""
    scale = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    scale = np.where(scale > 0.0, scale, 1.0)
    correlation = P / (scale[:, :, None] * scale[:, None, :])
    solved = np.linalg.pinv(correlation, rcond=1e-13, hermitian=True) @ (right / scale)[..., None]
    return solved / scale[..., None]


def _T(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)
