"""Refit of all rows of a young track together, from every component.

A filter linearises each row at its estimate of that time, which is far from the source while the source emerges from
noise. A Gauss-Newton iteration over the whole track in the chart is a filter and a smoother linearised along the last
trajectory, repeated until it converges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.measurement.nuisances import SensorErrors
from magloc.measurement.pose import PoseErrors
from magloc.state_space import update
from magloc.tracking.chart.known_moment import KnownInWorld
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.start import first_root
from magloc.tracking.coordinates import Chart
from magloc.tracking.measurement import RowMeasurement, stack_rows, step_of_errors
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.row_filter import Gaussians, SmootherPass, smooth, steps_problem
from magloc.tracking.rows import Rows

_MOST_PASSES = 15
# Passes after which a component is dropped if its log-evidence is less than the best by the second number.
_LEAST_PASSES, _HOPELESS = 4, 30.0
# Change of the last state, in its standard deviations, at convergence.
_TOLERANCE = 0.05
# Bounds of the step length over that of Gauss-Newton.
_SHARES = (0.1, 4.0)
# Largest step of log-range and direction in a pass.
_LONGEST = 0.5


@dataclass(frozen=True, eq=False)
class RangeCells:
    """Prior of the components' log-range: mean and standard deviation (K,)."""

    log_range: FloatArray
    sigma: FloatArray

    def about(self, chart: Chart) -> RangeCells:
        """Return the prior with means relative to the components' ranges in the first row."""
        return replace(self, log_range=self.log_range + np.log(chart.length))

    def take(self, index: BoolArray) -> RangeCells:
        """Return the prior of some of the components."""
        return RangeCells(self.log_range[index], self.sigma[index])


@dataclass(frozen=True, eq=False)
class RefitResult:
    """Components fitted to all rows of a track.

    Attributes
    ----------
    mixture : Mixture
        Components that converged, after the last row; the weights are the evidence, not normalised.
    nis : ndarray, shape (K,)
        χ² of all rows but the first, for each component.
    origin : ndarray of int, shape (K,)
        Index of each among the components given.
    decided : ndarray of bool, shape (n,)
        True for each component given that converged or was dropped as far less likely than one that did.
    """

    mixture: Mixture
    nis: FloatArray
    origin: IntArray
    decided: BoolArray


def refit_components(
    mixture: Mixture,
    measurements: Sequence[RowMeasurement],
    motions: Sequence[MotionModel],
    errors: SensorErrors,
    pose_errors: PoseErrors,
    cells: RangeCells | None = None,
    known: KnownInWorld | None = None,
) -> RefitResult:
    """Fit each component to all rows; drop those that are far less likely than the best one."""
    rows, K, N = _YoungRows(measurements, motions, errors, pose_errors, known), len(mixture), mixture.x.shape[1]
    n = measurements[0].n_charted
    x, S = np.zeros((K, N)), np.zeros((K, N, N))
    nis, log_evidence = np.full(K, np.inf), np.full(K, -np.inf)
    converged, decided = np.zeros((2, K), dtype=bool)
    live, track = np.arange(K), rows.propagate_backward(mixture.x)
    prior = None if cells is None else cells.about(measurements[0].chart(track[0]))
    share, last = np.ones(K), np.zeros((K, n))
    for passes in range(_MOST_PASSES):
        with np.errstate(all="ignore"):  # a trajectory may overflow: it is dropped
            found = rows.smooth_rows(track, prior)
            offset = np.swapaxes(found.offsets, 0, 1)
            largest = np.abs(offset[:, :, :3]).max(axis=(0, 2))
            length = np.minimum(1.0, _LONGEST / np.maximum(largest, _LONGEST))
            before, last = last, offset[-1] / np.linalg.norm(found.last.S[:, :n], axis=2)
            change = np.max(np.abs(last), axis=1)
            alive = np.isfinite(found.log_evidence) & np.isfinite(change)
            # Barzilai-Borwein step length: shorter if steps alternate, longer if they are alike.
            square, bent = np.sum(before * before, axis=1), np.sum(before * (before - last), axis=1)
            share = np.clip(np.divide(share * square, bent, out=np.ones_like(share), where=bent > 0.0), *_SHARES)
        step = np.where(alive, share * length, 0.0)[:, None] * np.nan_to_num(offset)
        track = rows.chart(track).retract(step)
        ends = (change < _TOLERANCE) & alive
        at = live[ends]
        x[at], S[at] = np.concatenate([track[-1], found.last.x[:, n:]], axis=1)[ends], found.last.S[ends]
        nis[at], log_evidence[at], converged[at] = found.nis[ends], found.log_evidence[ends], True
        left = ~ends
        if passes >= _LEAST_PASSES:
            behind = left & ~(found.log_evidence > log_evidence.max() - _HOPELESS)
            decided[live[behind]] = True
            left &= ~behind
        live, track, share, last = live[left], track[:, left], share[left], last[left]
        prior = None if prior is None else prior.take(left)
        if not live.size:
            break
    end = measurements[-1]
    after = Mixture(x[converged], S[converged], log_evidence[converged], n, end.centroid_m, end.radius_m, end.n_pose)
    return RefitResult(after, nis[converged], np.flatnonzero(converged), converged | decided)


@dataclass(frozen=True, eq=False)
class _YoungRows:
    """Rows of a track, and the motion of the source between them."""

    measurements: Sequence[RowMeasurement]
    motions: Sequence[MotionModel]
    errors: SensorErrors
    pose_errors: PoseErrors
    known: KnownInWorld | None = None

    @cached_property
    def _compiled(self) -> Rows:
        return stack_rows(self.measurements)

    @cached_property
    def _steps_s(self) -> list[float]:
        """Time step to each row."""
        time_s = [one.row.time_s for one in self.measurements]
        return np.diff(time_s, prepend=time_s[0]).tolist()

    @cached_property
    def _centroids_m(self) -> FloatArray:
        return np.stack([one.centroid_m for one in self.measurements])[:, None]

    def chart(self, track: FloatArray) -> Chart:
        """Return the charts about the states of trajectories (rows, K, n)."""
        first = self.measurements[0]
        return Chart.at(track, self._centroids_m, first.radius_m, first.n_pose)

    def propagate_backward(self, x: FloatArray) -> FloatArray:
        """Return trajectories (rows, K, n) without noise that end at states (K, N)."""
        m, track = self.motions[0].n_states, np.zeros((len(self.motions), len(x), self.measurements[0].n_charted))
        track[-1] = x[:, : track.shape[2]]
        for row in range(len(track) - 1, 0, -1):
            after = track[row, :, :m]
            steps = [self.motions[row].step(state, self._steps_s[row]) for state in after]
            x_next, F = np.stack([step[0] for step in steps]), np.stack([step[1] for step in steps])
            track[row - 1, :, :m] = after - np.linalg.solve(F, (x_next - after)[..., None])[..., 0]
        return track

    def smooth_rows(self, track: FloatArray, prior: RangeCells | None) -> SmootherPass:
        """Filter and smooth with rows and motion linearised along trajectories (rows, K, n)."""
        m, before = self.motions[0].n_states, self._prior(self.measurements[0].chart(track[0]), prior)
        trajectories, evidence = np.ascontiguousarray(np.swapaxes(track, 0, 1)), np.zeros(track.shape[1])
        if self.known is not None:
            before, evidence = self._with_known(trajectories[:, 0], before, self.known)
        every = (step_of_errors(self.pose_errors, self.errors, dt_s) for dt_s in self._steps_s)
        of_errors = [np.stack(part) for part in zip(*every, strict=True)]
        states = np.roll(trajectories, 1, axis=1)[:, :, :m].reshape(-1, m)
        order = np.arange(len(track))
        steps = steps_problem(self.motions, self._steps_s, order, (of_errors[0], of_errors[1]), states)
        found = smooth(trajectories, before, steps, self._compiled)
        return replace(found, log_evidence=found.log_evidence + evidence)

    def _prior(self, chart: Chart, cells: RangeCells | None) -> Gaussians:
        """Return the prior of the first row, in charts about states (K, n) there."""
        motion, n, n_errors = self.motions[0], chart.x.shape[1], self.errors.n_states
        m = motion.n_states
        mean, root = np.zeros((len(chart.x), n + n_errors)), np.zeros((len(chart.x), n + n_errors, n + n_errors))
        root[:, :n, :n] = chart.inverse_jacobian() @ first_root(chart, motion, None if cells is None else cells.sigma)
        root[:, np.arange(n, n + n_errors), np.arange(n, n + n_errors)] = self.errors.sigma
        # The prior of the source is flat about the states; that of velocity and rates has the motion's mean.
        before = np.zeros_like(chart.x)
        before[:, :m] = [motion.start(x[:N_SOURCE], np.zeros((N_SOURCE, N_SOURCE)))[0] for x in chart.x]
        mean[:, N_SOURCE:n] = chart.coordinates(before)[:, N_SOURCE:]
        if cells is not None:
            mean[:, 0] = cells.log_range - np.log(chart.length)
        return Gaussians(mean, root, n_nuisances=n - m + n_errors)

    def _with_known(self, x: FloatArray, before: Gaussians, known: KnownInWorld) -> tuple[Gaussians, FloatArray]:
        """Return a prior about states (K, n) updated by the known moment, and its evidence (K,)."""
        n, n_known = x.shape[1], known.n_known
        chart = self.measurements[0].chart(x)
        H = np.zeros((len(x), n_known, before.x.shape[1]))
        H[..., :n] = known.directional_derivative(x, chart.jacobian(np.zeros_like(x)))
        left = known.residual(x) - (H @ before.x[..., None])[..., 0]
        after, evidence = before.empty_like(), np.empty(len(x))
        for k, given in enumerate(zip(before.x, before.S, H, left, strict=True)):
            after.x[k], after.S[k] = update(*given)[:2]
            covariance = np.eye(n_known) + (H[k] @ before.S[k]) @ (H[k] @ before.S[k]).T
            evidence[k] = -0.5 * (left[k] @ np.linalg.solve(covariance, left[k]) + np.linalg.slogdet(covariance)[1])
        return after, evidence
