"""Steps of the mixture filter: start, predict, update, and refit of young tracks.

The first row that shows a source gives a mixture (:mod:`magloc.tracking.chart.start`). Every later row predicts the
components, divides those over which the readings are nonlinear (:mod:`magloc.tracking.chart.split`), updates them
(:mod:`magloc.tracking.row_filter`, compiled) and merges those that are nearly equal.

The states of the motion are followed by the errors of the array's pose and those of its sensors. With such lasting
errors the posterior after a row has many curved valleys, which would need too many components. Then none is divided.
All rows of a young track are fitted together at growing intervals (:mod:`magloc.tracking.chart.refit`): each component
is linear about the place where it was updated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.typing import BoolArray, FloatArray
from magloc.levels import CONTRADICTION
from magloc.localization.fit.prior import SourcePrior
from magloc.measurement.nuisances import SensorErrors
from magloc.measurement.pose import PoseErrors
from magloc.tracking import row_filter
from magloc.tracking.chart.known_moment import UNIFORM_IN_SPACE, KnownInWorld
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.refit import RangeCells, RefitResult, refit_components
from magloc.tracking.chart.split import split
from magloc.tracking.chart.stack import Stack
from magloc.tracking.chart.start import NO_DIPOLE, OF_PITCH, TrackStarter, unique_components, with_errors
from magloc.tracking.coordinates import mirror_images
from magloc.tracking.measurement import RowMeasurement, step_of_errors
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.row_filter import Gaussians, steps_problem
from magloc.tracking.sensor_health import OFFSETS, Misfits

LARGEST_GROWTH = 1.5
"""Largest growth of σ in a step for a prediction that is as nonlinear as the readings.

With more growth, the motion, which is linear, dominates its uncertainty. A row with missing readings is more nonlinear
than its prediction, because earlier rows had these readings.
"""
LARGEST_WIDTH = 0.4
"""Largest standard deviation of log-range and direction of a component that counts as one place."""
SETTLED = 0.05
"""Change of a young track's state by a refit, in squared σ per number, below which a narrow track is settled."""
WIDER = 1.2
"""Ratio of widths of a refit and the filter's component above which the filter is overconfident."""
NARROWER = 0.5
"""Ratio of a refit's σ of the log-range to the filter's below which the refit is overconfident. With errors of sensors,
the curvature at a mode does not describe a curved valley."""
OLD_WIDTH = 0.03
"""Largest standard deviation of log-range and direction of a settled track."""
SEEDS = 6
"""Number of components of a young track that are refitted, the first time each with its mirror images."""
LARGEST_REFIT_WIDTH = 0.25
"""Largest width of a component that is refitted."""
MOST_YOUNG_ROWS = 100
"""Largest number of rows of a young track."""
BENT_RANGE = 0.02
"""Standard deviation of the log-range above which a mode and its curvature do not describe the valley."""
N_CELLS, CELL_PITCH = 9, 0.7
"""Number of ranges at which it is refitted then, and their spacing in that standard deviation."""
FIRST_REFIT, REFITS_GROW = 3, 1.6
"""Number of rows of the first refit, and its growth until the next one."""


@dataclass(frozen=True, eq=False)
class TrackState:
    """State of a track between rows.

    Attributes
    ----------
    mixture : Mixture
    open_loop : ndarray, shape (n, n)
        Cartesian covariance of the motion's states without any readings since the start of the track.
    contradictions : int
        Number of successive contradicting rows before the next one.
    has_range : bool
        Whether the range was known at some time since the start of the track.
    young : tuple of (RowMeasurement, MotionModel)
        Rows of a young track, and the motion to each.
    next_refit : int
        Number of rows of the next refit.
    nis : float
        Sum of the filter's NIS over `young` without the first row.
    used : Mixture, optional
        State after the last row whose readings were used, if later rows were not.
    """

    mixture: Mixture
    open_loop: FloatArray
    contradictions: int = 0
    has_range: bool = False
    young: tuple[tuple[RowMeasurement, MotionModel], ...] = ()
    next_refit: int = FIRST_REFIT
    nis: float = 0.0
    used: Mixture | None = None

    @property
    def is_settled(self) -> bool:
        """True if the track is no longer young, and a single Gaussian."""
        return not self.young and len(self.mixture) == 1


@dataclass(frozen=True, eq=False)
class RowUpdate:
    """Update of a prediction by a row's readings.

    Attributes
    ----------
    mixture : Mixture, optional
        None if the readings contradict the prediction.
    nis : float
    innovation : ndarray, shape (k,)
        Whitened innovation of the most probable component.
    iterations : int
    correction : float
        Squared correction of that component, in its standard deviations, minus its mean; NaN if errors of sensors or
        pose are states, since those that are new in every row count as noise.
    """

    mixture: Mixture | None
    nis: float
    innovation: FloatArray
    iterations: int = 0
    correction: float = math.nan


class ChartFilter:
    """Mixture filter of one array: starts tracks, and steps them."""

    def __init__(self, array: SensorArray, errors: SensorErrors, pose_errors: PoseErrors, prior: SourcePrior) -> None:
        self.errors, self.pose_errors, self.prior = errors, pose_errors, prior
        self._start = TrackStarter(array, errors, prior)
        self.n_differences = decorrelated_differences(array).n_differences
        self.has_lasting_errors = errors.n_states + pose_errors.n_states > 0
        self._noise_T = float(np.median(array.channel_noise_T))
        self._misfits = Misfits()

    def start(
        self, row: RowMeasurement, motion: MotionModel, near: Mixture | None = None
    ) -> tuple[Mixture | None, str]:
        """Return a new track's mixture by one row, or None and the reason."""
        if self._misfits.waits:
            self._misfits = self._misfits.skip_row()
            return None, OFFSETS
        mixture, reason = self.row_mixture(row, motion)
        if mixture is None:
            if reason == NO_DIPOLE:
                self._misfits = self._misfits.after(self._start.misfit, self._noise_T)
            return None, reason
        self._misfits = Misfits(pause=self._misfits.pause)
        mixture = with_errors(mixture.drop_unlikely(), row, self.errors.sigma)
        return (mixture if near is None else _reweight(mixture.reduce(), near)).reduce(), ""

    def row_mixture(self, row: RowMeasurement, motion: MotionModel) -> tuple[Mixture | None, str]:
        """Return the mixture of source and pose by one row alone, or None and the reason."""
        return self._start.mixture(row, motion)

    def stack_mixture(self, stack: Stack, at_rest: MotionModel) -> tuple[Mixture | None, str]:
        """Return the mixture of the source by several rows, or None and the reason."""
        return self._start.mixture(stack, at_rest)

    def faulty_sensors(self, row: RowMeasurement) -> BoolArray:
        """Return the sensors (N,) that contradict the others; none if the misfit lasts over rows."""
        if self._misfits.are_alike:
            return np.zeros(self.errors.array.n_sensors, dtype=bool)
        return self._start.faulty_sensors(row.row)

    def refits(self, motion: MotionModel) -> bool:
        """Return True if the rows of a young track are refitted together.

        Without lasting errors the components suffice for a source with a velocity: its first rows determine no mode.
        """
        return self.has_lasting_errors or motion.n_states == N_SOURCE

    def is_detected(self, row: RowMeasurement) -> bool:
        """Return True if a row shows a source."""
        return row.is_detected(self.errors.sigma)

    def predict(self, mixture: Mixture, motion: MotionModel, dt_s: float, row: RowMeasurement) -> Mixture:
        """Return the mixture after a time without readings, in charts about the centroid of a row."""
        decay, noise = step_of_errors(self.pose_errors, self.errors, dt_s)
        nuisances = (decay[None], noise[None]) if decay.size else None
        step = steps_problem(motion, [dt_s], np.zeros(1, dtype=np.int64), nuisances, mixture.x[:, : motion.n_states])
        found = row_filter.predict(self._gaussians(mixture), mixture.centroid_m, step, row.kernel_rows)
        return replace(mixture, x=found.x, S=found.S, centroid_m=row.centroid_m)

    def _gaussians(self, mixture: Mixture) -> Gaussians:
        """Return components as an argument of kernels."""
        return Gaussians(mixture.x, mixture.S, n_nuisances=self.errors.n_states + self.pose_errors.n_states)

    def update(self, known: TrackState, predicted: Mixture, dt_s: float, row: RowMeasurement) -> RowUpdate:
        """Return the update of a prediction by a row, given the state before the step."""
        # With nonlinear errors, rows that were not used count as part of the step.
        before = known.used if self.has_lasting_errors and known.used is not None else known.mixture
        sigma, sigma_before = (np.linalg.norm(m.S[:, :N_SOURCE], axis=2) for m in (predicted, before))
        k = row.z.size
        bends = (sigma <= LARGEST_GROWTH * sigma_before).all(axis=1) & (k >= self.n_differences)
        if not self.has_lasting_errors:
            predicted, origin = split(predicted, row)
            bends = bends[origin]
        lasts = self.pose_errors.step(dt_s)[0] ** 2
        after = row_filter.update(
            self._gaussians(predicted),
            row.kernel_rows,
            bends=bends,
            pose_lasts=lasts if (lasts < 1.0).any() else None,
            innovation=True,
        )
        sound = after.converged & np.isfinite(after.log_evidence)
        if not np.where(sound, after.nis, np.inf).min() <= chdtri(k, CONTRADICTION):
            best = int(np.argmin(after.nis))
            return RowUpdate(None, float(after.nis[best]), after.whitened_innovation(best))
        log_weight = predicted.log_weight + np.where(sound, after.log_evidence, -np.inf)
        best = int(np.argmax(log_weight))
        found = replace(predicted, x=after.x, S=after.S, log_weight=log_weight, n_rows=predicted.n_rows + 1)
        mixture = found.take(sound).reduce()
        correction = None if self.has_lasting_errors else after.correction
        return RowUpdate(
            mixture,
            float(after.nis[best]),
            after.whitened_innovation(best),
            int(after.iterations[best]),
            math.nan if correction is None else float(correction[best]),
        )

    def refit(self, known: TrackState) -> TrackState:
        """Refit all rows of a young track together if due, and return the state."""
        mixture, n_rows = known.mixture, len(known.young)
        if not n_rows:
            return known
        is_narrow = len(mixture) == 1 and mixture.widths[0] < OLD_WIDTH
        if n_rows > MOST_YOUNG_ROWS or (n_rows < FIRST_REFIT and is_narrow):
            return replace(known, young=())
        if n_rows < known.next_refit or mixture.widths.max() > LARGEST_REFIT_WIDTH:
            return known
        seeds = mixture.take(unique_components(mixture)[:SEEDS])
        n_seeds = len(seeds)
        if known.next_refit == FIRST_REFIT:
            x = mirror_images(seeds.x, seeds.centroid_m).reshape(-1, seeds.x.shape[1])
            seeds = replace(seeds, x=x, S=np.tile(seeds.S, (4, 1, 1)), log_weight=np.zeros(len(x)))
        rows = [row for row, _ in known.young]
        motions = [motion for _, motion in known.young]
        known = replace(known, next_refit=int(REFITS_GROW * n_rows))
        fit = self._fit_rows(seeds, rows, motions)
        # A component whose refit did not converge may be the true one: then the filter goes on with all of them.
        if not fit.decided[:n_seeds].all() or not _is_credible(fit.mixture, fit.nis, rows):
            return known
        found = fit.mixture.take(unique_components(fit.mixture)).reduce()
        n = mixture.n_charted
        heaviest = mixture.x[np.argmax(mixture.log_weight)]
        elsewhere = found.square_distance(heaviest).min() > chdtri(n, CONTRADICTION)
        if elsewhere and fit.nis.min() > known.nis:
            # The refit moved to another place that explains the rows less well.
            return known
        # The mode of all states is biased towards the array, by several σ if the source moves at random by more. Keep
        # the filter's result unless the mode is elsewhere.
        is_moving = not self.has_lasting_errors and (_range_motion(found, rows, motions) > found.log_range_sigma).all()
        near = chdtri(n, CONTRADICTION) if is_moving else n
        if not self.has_lasting_errors and len(mixture) > 1:
            # The components describe a curved valley better than a mode.
            best = found.x[np.argmax(found.log_weight)]
            if mixture.square_distance(best).min() < near:
                return known
        if len(found) == 1 and len(mixture) == 1:
            change = mixture.square_distance(found.x)[0]
            if change < SETTLED * n and found.widths[0] < OLD_WIDTH:
                known = replace(known, young=())
            if change < near and found.widths[0] < WIDER * mixture.widths[0]:
                # The filter is not overconfident.
                return known
        found = self._refit_by_range(found, rows, motions)
        if self.errors.n_states and found.log_range_sigma < NARROWER * mixture.log_range_sigma:
            return known
        return replace(known, mixture=found)

    def _fit_rows(
        self,
        seeds: Mixture,
        rows: Sequence[RowMeasurement],
        motions: Sequence[MotionModel],
        cells: RangeCells | None = None,
    ) -> RefitResult:
        """Return components fitted to all rows, with the prior of the source."""
        known = KnownInWorld.of(self.prior, rows[0].row.R_world_from_array)
        fit = refit_components(seeds, rows, motions, self.errors, self.pose_errors, cells, known)
        if known is None:
            return fit
        of_space = UNIFORM_IN_SPACE * np.log(fit.mixture.chart.length)
        return replace(fit, mixture=replace(fit.mixture, log_weight=fit.mixture.log_weight + of_space))

    def _refit_by_range(
        self, found: Mixture, rows: Sequence[RowMeasurement], motions: Sequence[MotionModel]
    ) -> Mixture:
        """Refit components of uncertain range in several cells of the range.

        The valley of ranges is curved, and its width varies along it, so that its mode is biased towards the array.
        This does not apply to a source that moves by more than the σ of its range: then each row has another valley.
        """
        sigma = np.linalg.norm(found.S[:, 0], axis=1)
        if not ((sigma > BENT_RANGE) & (sigma > _range_motion(found, rows, motions))).any():
            return found
        k, cell = np.divmod(np.arange(len(sigma) * N_CELLS), N_CELLS)
        pitch = CELL_PITCH * sigma[k]
        cells = RangeCells((cell - N_CELLS // 2) * pitch, OF_PITCH * pitch)
        fit = self._fit_rows(found.take(k), rows, motions, cells)
        if not fit.decided.all() or not len(fit.mixture):
            return found
        spread = replace(fit.mixture, log_weight=fit.mixture.log_weight + np.log(pitch[fit.origin]))
        return spread.take(unique_components(spread, cell[fit.origin])).reduce()


def _range_motion(found: Mixture, rows: Sequence[RowMeasurement], motions: Sequence[MotionModel]) -> FloatArray:
    """Return σ (K,) of the components' change of log-range over all rows, by the noise of the motion."""
    n, span_s = motions[-1].n_states, rows[-1].row.time_s - rows[0].row.time_s
    S_q = np.stack([motions[-1].step(x, span_s)[2] for x in found.x[:, :n]])
    return np.linalg.norm((found.chart.inverse_jacobian()[:, :1, :n] @ S_q)[:, 0], axis=1)


def _is_credible(found: Mixture, nis: FloatArray, rows: Sequence[RowMeasurement]) -> bool:
    """Return True if the best refitted source explains the rows and is determined by them."""
    if not len(found):
        return False
    dof = sum(row.z.size for row in rows[1:])
    best = int(np.argmax(found.log_weight))
    return bool(dof > 0 and nis[best] <= chdtri(dof, CONTRADICTION) and found.widths[best] < LARGEST_REFIT_WIDTH)


def width_of(mixture: Mixture) -> float:
    """Return the largest σ of log-range and direction of the heaviest component."""
    return float(mixture.widths[np.argmax(mixture.log_weight)])


def to_cartesian(mixture: Mixture) -> tuple[FloatArray, FloatArray]:
    """Return the Cartesian state (N,) and root (N, N) that match a mixture's moments."""
    one = mixture.match_moments()
    n, root = one.n_charted, one.S[0].copy()
    root[:n] = one.chart.jacobian(np.zeros((1, n)))[0] @ root[:n]
    return one.x[0], root


def from_cartesian(x: FloatArray, S: FloatArray, row: RowMeasurement) -> Mixture:
    """Return the mixture of a Cartesian state and root: the inverse of :func:`to_cartesian`."""
    n, root = row.n_charted, S.copy()
    root[:n] = row.chart(x[None, :n]).inverse_jacobian()[0] @ root[:n]
    return Mixture(x[None], root[None], np.zeros(1), n, row.centroid_m, row.radius_m, row.n_pose)


def _reweight(mixture: Mixture, prediction: Mixture) -> Mixture:
    """Return components with weights multiplied by a prediction's density of their places."""
    mean, covariance = prediction.moments()
    offset, log_density = mixture.x[:, :3] - mean[:3], np.empty(len(mixture))
    for k in range(len(mixture)):
        _, own = mixture.take(np.array([k])).moments()
        both = covariance[:3, :3] + own[:3, :3]
        log_density[k] = -0.5 * (offset[k] @ np.linalg.solve(both, offset[k]) + np.linalg.slogdet(both)[1])
    return replace(mixture, log_weight=mixture.log_weight + log_density)
