"""How what is known of a source changes from row to row: started, predicted, updated, and fitted anew while young.

The first row that shows a source makes a mixture (:mod:`magloc.tracking.chart.start`); every later one moves its
components, divides those over which the readings bend (:mod:`magloc.tracking.chart.split`), updates them
(:mod:`magloc.tracking.row_filter`, compiled) and merges those that are one.

Behind the states of the motion stand the errors of the array's pose, and behind them those of its sensors. Where there
are such lasting errors, a row leaves many numbers open in curved valleys, which would take more components than can be
followed. Then none is divided, and all rows of a young track are fitted together now and then
(:mod:`magloc.tracking.chart.refit`).
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
from magloc.tracking.chart.mixture import Mixture, root_of
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
"""A prediction bends as the readings do while no standard deviation grows by more in the step: beyond that it is the
motion that it is uncertain of, which does not. Nor does it bend as a row does in which readings are missing: the rows
that made it had them."""
LARGEST_WIDTH = 0.4
"""Standard deviation of the log-range, or of the direction, beyond which a component is no place any more."""
SETTLED = 0.05
"""A young track is old when fitting it as a whole changes its state by less, in squares of σ per number, and it is
narrow."""
WIDER = 1.2
"""A filter's own component knows too much if a fit to all of its rows is wider by more."""
NARROWER = 0.5
"""A fit knows too much of the range beside errors of sensors if it is narrower by more: the curvature at a mode does
not tell of a bent valley."""
OLD_WIDTH = 0.03
"""Standard deviation of log-range or direction with which a track grows old."""
SEEDS = 6
"""Components of a young track that are fitted anew, the first time each with its mirror images."""
LARGEST_REFIT_WIDTH = 0.25
"""Width of a component that is fitted to all rows of a young track."""
MOST_YOUNG_ROWS = 100
"""Rows up to which a track is fitted anew as a whole."""
BENT_RANGE = 0.02
"""Standard deviation of the log-range above which a mode and its curvature do not tell of the rows' whole valley."""
N_CELLS, CELL_PITCH = 9, 0.7
"""Ranges at which it is fitted then, and how far they are apart, in that standard deviation."""
FIRST_REFIT, REFITS_GROW = 3, 1.6
"""Number of rows of the first such fit, and how much larger it is each time."""


@dataclass(frozen=True, eq=False)
class TrackState:
    """What a tracker knows between rows.

    Attributes
    ----------
    mixture : Mixture
    open_loop : ndarray, shape (n, n)
        Cartesian covariance of the motion's states had no readings been taken since the track began.
    contradictions : int
        Contradicting rows before the next one.
    has_range : bool
        Whether the range was once known since the track began.
    young : tuple of (RowMeasurement, MotionModel)
        Rows of a track that are still fitted together, and the motion that led to each; `next_refit`, after how many.
    nis : float
        Of all of them but the first, as the filter found it row by row.
    used : Mixture, optional
        After the last row whose readings were used, if later rows were not.
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
        """Whether the track is no longer young, and of one place."""
        return not self.young and len(self.mixture) == 1


@dataclass(frozen=True, eq=False)
class RowUpdate:
    """What a row's readings make of a prediction.

    Attributes
    ----------
    mixture : Mixture, optional
        None where they contradict it.
    nis : float
    innovation : ndarray, shape (k,)
        Whitened, of the component that explains them best.
    iterations : int
    correction : float
        Of the same: square by which the readings move it, in its standard deviations, less its mean; NaN where errors
        of sensors or pose are states, since those that are new in every row count as noise.
    """

    mixture: Mixture | None
    nis: float
    innovation: FloatArray
    iterations: int = 0
    correction: float = math.nan


class ChartFilter:
    """Starts tracks of one array, and steps them."""

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
        """What one row says of a source, weighed by a prediction of its place if there is one, or why there is none."""
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
        """What one row alone says of a source and the pose, by every cell that explains it, or why it says nothing."""
        return self._start.mixture(row, motion)

    def stack_mixture(self, stack: Stack, at_rest: MotionModel) -> tuple[Mixture | None, str]:
        """What rows say together of a source alone, that is where it is in the last of them."""
        return self._start.mixture(stack, at_rest)

    def faulty_sensors(self, row: RowMeasurement) -> BoolArray:
        """Sensors (N,) that contradict all others in a row that no dipole fits; none where rows misfit alike."""
        if self._misfits.are_alike:
            return np.zeros(self.errors.array.n_sensors, dtype=bool)
        return self._start.faulty_sensors(row.row)

    def is_detected(self, row: RowMeasurement) -> bool:
        """Whether a row shows that there is a source."""
        return row.is_detected(self.errors.sigma)

    def predict(self, mixture: Mixture, motion: MotionModel, dt_s: float, row: RowMeasurement) -> Mixture:
        """What is known after a time without readings, as seen from a row's array."""
        kept, added = step_of_errors(self.pose_errors, self.errors, dt_s)
        nuisances = (kept[None], added[None]) if kept.size else None
        step = steps_problem(motion, [dt_s], np.zeros(1, dtype=np.int64), nuisances, mixture.x[:, : motion.n_states])
        found = row_filter.predict(self._gaussians(mixture), mixture.centroid_m, step, row.kernel_rows)
        return replace(mixture, x=found.x, S=found.S, centroid_m=row.centroid_m)

    def _gaussians(self, mixture: Mixture) -> Gaussians:
        """Return components as kernels take them."""
        return Gaussians(mixture.x, mixture.S, n_nuisances=self.errors.n_states + self.pose_errors.n_states)

    def update(self, known: TrackState, predicted: Mixture, dt_s: float, row: RowMeasurement) -> RowUpdate:
        """Return what a row makes of a prediction from what was known before it."""
        # Where errors of sensors bend as well, rows that were not used count as a part of the step.
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
        """What is known when all rows of a young track are fitted together, if it is time to."""
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
        # A component that is not fitted to its end may be the true one: then the filter goes on with all of them.
        if not fit.decided[:n_seeds].all() or not _is_credible(fit.mixture, fit.nis, rows):
            return known
        found = fit.mixture.take(unique_components(fit.mixture)).reduce()
        n, heaviest = mixture.n_charted, np.repeat(np.argmax(mixture.log_weight), len(found))
        elsewhere = _offset(found, mixture.x[heaviest]).min() > chdtri(n, CONTRADICTION)
        if elsewhere and fit.nis.min() > known.nis:
            # The iteration has left the filter's place for one that explains the rows less well.
            return known
        if len(found) == 1 and len(mixture) == 1:
            change = _offset(mixture, found.x)[0]
            if change < SETTLED * n and found.widths[0] < OLD_WIDTH:
                known = replace(known, young=())
            if change < n and found.widths[0] < WIDER * mixture.widths[0]:
                # The mode of all states together stands nearer than the source does on average: the filter's own stays,
                # unless it claims to know more than all rows together tell.
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
        """Components fitted to all rows, with what was known before them."""
        known = KnownInWorld.of(self.prior, rows[0].row.R_world_from_array)
        fit = refit_components(seeds, rows, motions, self.errors, self.pose_errors, cells, known)
        if known is None:
            return fit
        of_space = UNIFORM_IN_SPACE * np.log(fit.mixture.chart.length)
        return replace(fit, mixture=replace(fit.mixture, log_weight=fit.mixture.log_weight + of_space))

    def _refit_by_range(
        self, found: Mixture, rows: Sequence[RowMeasurement], motions: Sequence[MotionModel]
    ) -> Mixture:
        """Where ranges are open, components fitted anew in cells of the range, as at the start, each with its evidence.

        The valley of ranges is bent, and how much room there is beside it differs along it: one mode would be too near.
        A source that moves by more than its range is open makes every row a valley of its own.
        """
        sigma, span_s = np.linalg.norm(found.S[:, 0], axis=1), rows[-1].row.time_s - rows[0].row.time_s
        n = motions[-1].n_states
        S_q = np.stack([motions[-1].step(x, span_s)[2] for x in found.x[:, :n]])
        added = np.linalg.norm((found.chart.inverse_jacobian()[:, :1, :n] @ S_q)[:, 0], axis=1)
        if not ((sigma > BENT_RANGE) & (sigma > added)).any():
            return found
        k, cell = np.divmod(np.arange(len(sigma) * N_CELLS), N_CELLS)
        pitch = CELL_PITCH * sigma[k]
        cells = RangeCells((cell - N_CELLS // 2) * pitch, OF_PITCH * pitch)
        fit = self._fit_rows(found.take(k), rows, motions, cells)
        if not fit.decided.all() or not len(fit.mixture):
            return found
        spread = replace(fit.mixture, log_weight=fit.mixture.log_weight + np.log(pitch[fit.origin]))
        return spread.take(unique_components(spread, cell[fit.origin])).reduce()


def _offset(mixture: Mixture, x: FloatArray) -> FloatArray:
    """Squared distances (K,) of states (K, N) from components, each of its own, in units of their covariances."""
    n = mixture.n_charted
    e = mixture.chart.coordinates(x[:, :n])
    return np.asarray(np.sum(np.linalg.solve(root_of(mixture.S[:, :n]), e[..., None])[..., 0] ** 2, axis=1))


def _is_credible(found: Mixture, nis: FloatArray, rows: Sequence[RowMeasurement]) -> bool:
    """Whether sources that were fitted to rows explain them, and are determined by them."""
    if not len(found):
        return False
    dof = sum(row.z.size for row in rows[1:])
    best = int(np.argmax(found.log_weight))
    return bool(dof > 0 and nis[best] <= chdtri(dof, CONTRADICTION) and found.widths[best] < LARGEST_REFIT_WIDTH)


def width_of(mixture: Mixture) -> float:
    """Standard deviation of log-range or direction of the likeliest place."""
    return float(mixture.widths[np.argmax(mixture.log_weight)])


def to_cartesian(mixture: Mixture) -> tuple[FloatArray, FloatArray]:
    """Return the state (N,) and root (N, N) of a Gaussian of the same mean and covariance."""
    one = mixture.match_moments()
    n, root = one.n_charted, one.S[0].copy()
    root[:n] = one.chart.jacobian(np.zeros((1, n)))[0] @ root[:n]
    return one.x[0], root


def from_cartesian(x: FloatArray, S: FloatArray, row: RowMeasurement) -> Mixture:
    """The inverse of :func:`to_cartesian`, as seen from a row's array."""
    n, root = row.n_charted, S.copy()
    root[:n] = row.chart(x[None, :n]).inverse_jacobian()[0] @ root[:n]
    return Mixture(x[None], root[None], np.zeros(1), n, row.centroid_m, row.radius_m, row.n_pose)


def _reweight(mixture: Mixture, prediction: Mixture) -> Mixture:
    """Components weighed by what a prediction says of their places."""
    mean, covariance = prediction.moments()
    offset, log_density = mixture.x[:, :3] - mean[:3], np.empty(len(mixture))
    for k in range(len(mixture)):
        _, own = mixture.take(np.array([k])).moments()
        both = covariance[:3, :3] + own[:3, :3]
        log_density[k] = -0.5 * (offset[k] @ np.linalg.solve(both, offset[k]) + np.linalg.slogdet(both)[1])
    return replace(mixture, log_weight=mixture.log_weight + log_density)
