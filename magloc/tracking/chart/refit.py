"""All rows of a young track together, fitted anew from every component that is left.

A filter linearises every row where it stood then, and while a source comes out of the noise it stood elsewhere. Gauss
and Newton's iteration over the whole track, in the chart, is a filter and a smoother that linearise along the last
trajectory, until that stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.measurement.nuisances import SensorErrors
from magloc.tracking.chart.coordinates import Chart
from magloc.tracking.chart.known_moment import KnownInWorld
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.row import ChartRow
from magloc.tracking.chart.start import first_root
from magloc.tracking.motion import N_SOURCE, MotionModel

_MOST_PASSES = 15
# After how many passes a component is given up whose evidence is so much less, as a logarithm, than that of another.
_LEAST_PASSES, _HOPELESS = 4, 30.0
# Change of the last state, in its standard deviations, below which the trajectory stays.
_TOLERANCE = 0.05
# Shortest and longest part of Gauss and Newton's step that is taken.
_SHARES = (0.1, 4.0)
# Longest step of log-range and direction in a pass.
_LONGEST = 0.5


@dataclass(frozen=True, eq=False)
class Cells:
    """What is known of the log-range of components before the first row: mean and standard deviation (K,)."""

    log_range: FloatArray
    sigma: FloatArray

    def about(self, chart: Chart) -> Cells:
        """Means counted from the ranges of components in the first row."""
        return replace(self, log_range=self.log_range + np.log(chart.length))

    def take(self, index: BoolArray) -> Cells:
        """Of some of the components."""
        return Cells(self.log_range[index], self.sigma[index])


@dataclass(frozen=True, eq=False)
class Refitted:
    """Components fitted to all rows of a track.

    Attributes
    ----------
    mixture : Mixture
        Those that converged, after the last row, not yet weighed against each other.
    nis : ndarray, shape (K,)
        χ² of all rows but the first, of each of them.
    origin : ndarray of int, shape (K,)
        Which of the components that were to be fitted each of them was.
    decided : ndarray of bool, shape (n,)
        Which of the components that were to be fitted converged, or are far less likely than one that did.
    """

    mixture: Mixture
    nis: FloatArray
    origin: IntArray
    decided: BoolArray


def refitted(
    mixture: Mixture,
    measurements: Sequence[ChartRow],
    motions: Sequence[MotionModel],
    errors: SensorErrors,
    cells: Cells | None = None,
    known: KnownInWorld | None = None,
) -> Refitted:
    """Components fitted to the rows, each on its own, and given up where it is far less likely than the best one."""
    rows, K, N = _Rows(measurements, motions, errors, known), len(mixture), mixture.x.shape[1]
    n = rows.n
    x, P = np.zeros((K, N)), np.zeros((K, N, N))
    nis, log_evidence = np.full(K, np.inf), np.full(K, -np.inf)
    converged, decided = np.zeros((2, K), dtype=bool)
    live, track = np.arange(K), rows.backwards(mixture.x)
    prior = None if cells is None else cells.about(rows.chart(track, 0))
    share, last = np.ones(K), np.zeros((K, n))
    for passes in range(_MOST_PASSES):
        with np.errstate(all="ignore"):  # a trajectory may lead out of double precision: it is not kept
            found = rows.passed(track, prior)
            largest = np.abs(found.offset[:, :, :3]).max(axis=(0, 2))
            length = np.minimum(1.0, _LONGEST / np.maximum(largest, _LONGEST))
            sigma = np.sqrt(np.diagonal(found.P, axis1=1, axis2=2))[:, :n]
            before, last = last, found.offset[-1] / sigma
            change = np.max(np.abs(last), axis=1)
            alive = np.isfinite(found.log_evidence) & np.isfinite(change)
            # Barzilai and Borwein's length: steps that lead back are made shorter, those that creep longer.
            square, bent = np.sum(before * before, axis=1), np.sum(before * (before - last), axis=1)
            share = np.clip(np.divide(share * square, bent, out=np.ones_like(share), where=bent > 0.0), *_SHARES)
        track = rows.moved(track, np.where(alive, share * length, 0.0)[:, None] * np.nan_to_num(found.offset))
        there = (change < _TOLERANCE) & alive
        ended = live[there]
        x[ended], P[ended] = np.concatenate([track[-1], found.errors], axis=1)[there], found.P[there]
        nis[ended], log_evidence[ended], converged[ended] = found.nis[there], found.log_evidence[there], True
        left = ~there
        if passes >= _LEAST_PASSES:
            behind = left & ~(found.log_evidence > log_evidence.max() - _HOPELESS)
            decided[live[behind]] = True
            left &= ~behind
        live, track, share, last = live[left], track[:, left], share[left], last[left]
        prior = None if prior is None else prior.take(left)
        if not live.size:
            break
    # Where nothing is known along some number, rounding may leave less than nothing: that is no fit.
    roots, sound = _roots(P[converged][:, ::-1, ::-1])
    converged[converged] = sound
    S = roots[sound][:, ::-1, ::-1]
    end = measurements[-1]
    after = Mixture(x[converged], S, log_evidence[converged], n, end.centroid_m, end.radius_m, end.n_pose)
    return Refitted(after, nis[converged], np.flatnonzero(converged), converged | decided)


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

    measurements: Sequence[ChartRow]
    motions: Sequence[MotionModel]
    errors: SensorErrors
    known: KnownInWorld | None = None

    @property
    def n(self) -> int:
        return self.motions[0].n_states

    def _dt_s(self, row: int) -> float:
        return self.measurements[row].row.time_s - self.measurements[row - 1].row.time_s

    def chart(self, track: FloatArray, row: int) -> Chart:
        """About the states at a row."""
        return self.measurements[row].chart(track[row])

    def backwards(self, x: FloatArray) -> FloatArray:
        """Trajectories (rows, K, n) without noise, and without errors of the pose, that end at states (K, N)."""
        m, track = self.n - self.measurements[0].n_pose, [x[:, : self.n]]
        for row in range(len(self.measurements) - 1, 0, -1):
            steps = [self.motions[row].step(state, self._dt_s(row)) for state in track[-1]]
            back = np.zeros_like(track[-1])
            for k, (moved, F, _) in enumerate(steps):
                back[k, :m] = track[-1][k, :m] - np.linalg.solve(F[:m, :m], (moved - track[-1][k])[:m])
            track.append(back)
        return np.array(track[::-1])

    def moved(self, track: FloatArray, offset: FloatArray) -> FloatArray:
        """Trajectories at offsets (rows, K, n) in the charts about others."""
        return np.array([self.chart(track, row).retracted(offset[row]) for row in range(len(track))])

    def passed(self, track: FloatArray, prior: Cells | None) -> _Passed:
        """A filter and a smoother that linearise along trajectories (rows, K, n).

        The smoother is Bryson and Frazier's: it carries the gradient of what later rows cost, and inverts nothing.
        """
        n, n_errors, K = self.n, self.errors.n_states, track.shape[1]
        N = n + n_errors
        chart = self.chart(track, 0)
        root = chart.inverse_jacobian() @ first_root(chart, self.motions[0], None if prior is None else prior.sigma)
        mean, P = np.zeros((K, N)), np.zeros((K, N, N))
        # Where the source is, the first row alone says; what else moves is known by the prior.
        before = np.stack([self.motions[0].start(x[:N_SOURCE], np.zeros((N_SOURCE, N_SOURCE)))[0] for x in chart.x])
        mean[:, N_SOURCE:n] = chart.coordinates(before)[:, N_SOURCE:]
        P[:, :n, :n] = root @ _T(root)
        P[:, np.arange(n, N), np.arange(n, N)] = self.errors.sigma**2
        if prior is not None:
            mean[:, 0] = prior.log_range - np.log(chart.length)
        nis, log_evidence = np.zeros(K), np.zeros(K)
        steps: list[_FilteredRow] = []
        transition = np.zeros((K, n, n))
        for row, measurement in enumerate(self.measurements):
            if row:
                mean, P, transition = self._step(track, row, mean, P)
            chart = self.chart(track, row)
            L = chart.jacobian(np.zeros_like(chart.x))
            effect = np.broadcast_to(measurement.effect, (K, *measurement.effect.shape))
            J = np.concatenate([measurement.along(chart.x, L), effect], axis=2)
            left = measurement.z - measurement.of_source(chart.x)
            if not row and self.known is not None:
                of_known = np.zeros((K, self.known.n_known, N))
                of_known[..., :n] = self.known.along(chart.x, L)
                J = np.concatenate([J, of_known], axis=1)
                left = np.concatenate([left, self.known.residual(chart.x)], axis=1)
            left = left[..., None] - J @ mean[..., None]
            PJ = P @ _T(J)
            L_S, sound = _roots(np.eye(J.shape[1]) + J @ PJ)
            log_evidence[~sound] = -np.inf
            white = np.linalg.solve(L_S, np.concatenate([J, _T(PJ), left], axis=2))
            J, gain, left = white[..., :N], white[..., N:-1], white[..., -1:]
            steps.append(_FilteredRow(mean, P[:, :n], transition, J, gain, left))
            square = np.sum(left[..., 0] ** 2, axis=1)
            nis = nis + (square if row else 0.0)
            log_evidence -= 0.5 * square + np.sum(np.log(np.diagonal(L_S, axis1=1, axis2=2)), axis=1)
            mean = mean + (_T(gain) @ left)[..., 0]
            P = P - _T(gain) @ gain
        return _Passed(self._offsets(steps), mean[:, n:], P, nis, log_evidence)

    def _offsets(self, steps: Sequence[_FilteredRow]) -> FloatArray:
        """Smoothed offsets (rows, K, n)."""
        n = self.n
        offsets, slope = [], np.zeros((*steps[0].mean.shape, 1))
        for row in range(len(steps) - 1, -1, -1):
            step = steps[row]
            slope = slope - _T(step.J) @ (step.left + step.gain @ slope)
            offsets.append(step.mean[:, :n] - (step.P @ slope)[..., 0])
            kept, _ = self.errors.step(self._dt_s(row) if row else 0.0)
            slope = np.concatenate([_T(step.transition) @ slope[:, :n], kept[:, None] * slope[:, n:]], axis=1)
        return np.array(offsets[::-1])

    def _step(
        self, track: FloatArray, row: int, mean: FloatArray, P: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean and covariance predicted to a row, in the charts about the trajectory, and the transition there."""
        n, before, after = self.n, self.chart(track, row - 1), self.chart(track, row)
        steps = [self.motions[row].step(state, self._dt_s(row)) for state in track[row - 1]]
        F, S_q = np.stack([step[1] for step in steps]), np.stack([step[2] for step in steps])
        kept, added = self.errors.step(self._dt_s(row))
        inverse = after.inverse_jacobian()
        A, noise = inverse @ F @ before.jacobian(np.zeros_like(before.x)), inverse @ S_q
        moved = np.empty_like(mean)
        moved[:, :n] = (A @ mean[:, :n, None])[..., 0] + after.coordinates(np.stack([step[0] for step in steps]))
        moved[:, n:] = kept * mean[:, n:]
        predicted = P.copy()
        predicted[:, :n, :n] = A @ P[:, :n, :n] @ _T(A) + noise @ _T(noise)
        predicted[:, :n, n:] = (A @ P[:, :n, n:]) * kept
        predicted[:, n:, :n] = _T(predicted[:, :n, n:])
        predicted[:, n:, n:] = P[:, n:, n:] * np.outer(kept, kept) + np.diag(added**2)
        return moved, predicted, A


@dataclass(frozen=True, eq=False)
class _FilteredRow:
    """Mean and covariance (K, n, N) before a row, the source's transition that led there, and what it adds."""

    mean: FloatArray
    P: FloatArray
    transition: FloatArray
    J: FloatArray
    gain: FloatArray
    left: FloatArray


def _roots(C: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Lower roots of (K, k, k), and which of them there are: a trajectory may lead through a sensor."""
    try:
        return np.asarray(np.linalg.cholesky(C)), np.ones(len(C), dtype=np.bool_)
    except np.linalg.LinAlgError:
        roots, sound = np.tile(np.eye(C.shape[1]), (len(C), 1, 1)), np.zeros(len(C), dtype=np.bool_)
        for k, of_one in enumerate(C):
            with suppress(np.linalg.LinAlgError):
                roots[k], sound[k] = np.linalg.cholesky(of_one), True
        return roots, sound


def _T(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)
