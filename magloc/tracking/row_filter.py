"""Steps of a filter of several sources, compiled: predict, update by a row of readings, and how far readings bend.

:mod:`magloc.tracking.chart` explains the chart and is the reference for one source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.tracking.chart.coordinates import FIRM
from magloc.tracking.chart.row import Rows
from magloc.tracking.chart.update import LEAST_GAIN, LEAST_SHARE, MOST_ITERATIONS, ROUNDING, TOLERANCE
from magloc.tracking.motion import N_SOURCE, MotionModel, OrnsteinUhlenbeck

_ROWS_A_CALL = 1000
"""Rows of trajectories that one call of the kernel smooths: some 10 ms."""
_FOLLOWED = 1e-3
"""Variance of readings beside their noise in the test of sensors: one that the fit follows wholly tells nothing."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussian states of several sources.

    Attributes
    ----------
    x : ndarray, shape (C, N)
        Means: the Cartesian state of every source, and behind them nuisances that are linear in the readings.
    S : ndarray, shape (C, N, N)
        Roots of the covariances, in the charts about the means.
    n_sources, n_nuisances : int
    power : int
        Power of the range with which readings fall: 4, or 3 where a common field is a nuisance.
    firm : float
        Share of a moment that is open, below which its strength and direction are its coordinates.
    """

    x: FloatArray
    S: FloatArray
    n_sources: int = 1
    n_nuisances: int = 0
    power: int = 4
    firm: float = FIRM

    @property
    def problem(self) -> core.Problem:
        """Return the arguments of kernels."""
        return core.problem(
            "sources",
            n_sources=self.n_sources,
            n_states=(self.x.shape[1] - self.n_nuisances) // self.n_sources,
            n_nuisances=self.n_nuisances,
            power=self.power,
            firm=self.firm,
            x=np.ascontiguousarray(self.x),
            roots=np.ascontiguousarray(self.S),
        )

    def unfilled(self) -> Gaussians:
        """Return as many, to be filled."""
        return replace(self, x=np.empty_like(self.x, order="C"), S=np.empty_like(self.S, order="C"))


@dataclass(frozen=True, eq=False)
class RowUpdates:
    """Gaussians after a row's readings; see :class:`magloc.tracking.chart.update.Updated`.

    `sensor_chi2` (C, n_sensors) is by how much less `nis` would be if the readings of a sensor were free.
    """

    after: Gaussians
    nis: FloatArray
    chi2: FloatArray
    log_evidence: FloatArray
    iterations: IntArray
    converged: BoolArray
    innovation: FloatArray | None
    sensor_chi2: FloatArray | None

    @property
    def x(self) -> FloatArray:
        """Return the means (C, N)."""
        return self.after.x

    @property
    def S(self) -> FloatArray:
        """Return the roots (C, N, N)."""
        return self.after.S

    def whitened_innovation(self, index: int) -> FloatArray:
        """Return the innovation of one of them."""
        assert self.innovation is not None
        return np.asarray(self.innovation[index])


@cache
def convergence() -> core.Problem:
    """Return when an iterated update ends."""
    return core.problem(
        "convergence", tolerance=TOLERANCE, least_gain=LEAST_GAIN, rounding=ROUNDING, max_iterations=MOST_ITERATIONS
    )


def steps_problem(
    motion: MotionModel,
    steps_s: Sequence[float],
    step_of_row: IntArray,
    nuisances: tuple[FloatArray, FloatArray] | None = None,
    states: FloatArray | None = None,
) -> core.Problem:
    """Return how sources move in steps of some lengths.

    Parameters
    ----------
    motion : MotionModel
    steps_s : sequence of float
    step_of_row : ndarray of int, shape (n_rows,)
        Index of the step that leads to each row.
    nuisances : tuple of ndarray, optional
        Part of nuisances that each step keeps, and standard deviation of what it adds, (n_steps, n_nuisances) each.
    states : ndarray, shape (n, n_states), optional
        States of all sources of all Gaussians, for a motion that is neither linear nor a lasting rate of turn; then
        there is one step.
    """
    F = A = B = moved = turning = None
    n_noise = 15
    if isinstance(motion, OrnsteinUhlenbeck):
        turning = np.stack([motion.turning_step(length_s) for length_s in steps_s])
    elif (linear_step := getattr(motion, "linear_step", None)) is not None:
        F, A, B = (np.stack(part) for part in zip(*map(linear_step, steps_s), strict=True))
        n_noise = A.shape[2]
    else:
        assert states is not None
        taken = [motion.step(x, steps_s[0]) for x in states]
        moved, F, A = (np.stack(part) for part in zip(*taken, strict=True))
        n_noise = A.shape[2]
    kept, added = (None, None) if nuisances is None else map(np.ascontiguousarray, nuisances)
    return core.problem(
        "motion",
        n_noise=n_noise,
        F=F,
        A=A,
        B=B,
        moved=moved,
        turning=turning,
        kept=kept,
        added=added,
        step_of_row=np.ascontiguousarray(step_of_row, dtype=np.int64),
    )


def predict(before: Gaussians, centroid_m: FloatArray, steps: core.Problem, rows: Rows, row: int = 0) -> Gaussians:
    """Return Gaussians after the step to a row; the sensors' centroid stood at `centroid_m` before."""
    after = before.unfilled()
    work = core.problem(
        "row_prediction",
        before=before.problem,
        after=after.problem,
        motion=steps,
        rows=rows.problem,
        row=row,
        centroid=tuple(centroid_m),
    )
    core.run("predict_row", work, len(before.x), block=len(before.x))
    return after


def update(
    before: Gaussians,
    rows: Rows,
    row: int = 0,
    *,
    bends: BoolArray | None = None,
    innovation: bool = False,
    sensors: bool = False,
) -> RowUpdates:
    """Return Gaussians after a row's readings, each by an iterated update of its own.

    Parameters
    ----------
    before : Gaussians
        Predictions.
    rows : Rows
    row : int
        Index of the row.
    bends : ndarray of bool, shape (C,), optional
        Predictions that bend as the readings do; those of nuisances cannot.
    innovation, sensors : bool
        Whether to find the whitened innovations, and what each sensor's readings would explain if they were free.
    """
    if bends is not None and before.n_nuisances:
        raise ValueError("Predictions of nuisances do not bend.")
    after, n = before.unfilled(), len(before.x)
    nis, chi2, log_evidence = np.empty((3, n))
    iterations, converged = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.uint8)
    whitened = np.empty((n, rows.readings.shape[1])) if innovation else None
    sensor_chi2 = np.empty((n, rows.array.n_sensors)) if sensors else None
    work = core.problem(
        "row_update",
        before=before.problem,
        after=after.problem,
        rows=rows.problem,
        convergence=convergence(),
        row=row,
        bends=None if bends is None else bends.astype(np.uint8),
        least_share=LEAST_SHARE,
        followed=_FOLLOWED,
        nis=nis,
        chi2=chi2,
        log_evidence=log_evidence,
        iterations=iterations,
        converged=converged,
        innovation=whitened,
        sensor_chi2=sensor_chi2,
    )
    core.run("update_row", work, n, block=n)
    return RowUpdates(after, nis, chi2, log_evidence, iterations, converged.astype(np.bool_), whitened, sensor_chi2)


def bends(gaussians: Gaussians, rows: Rows, memory: float, row: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return how far readings bend over one σ along axes of position and moment of the sources.

    Parameters
    ----------
    gaussians : Gaussians
        Predictions.
    rows : Rows
    memory : float
        Number of rows in whose readings the bend is counted, as far as these made the σ as small as it is.
    row : int
        Index of the row.

    Returns
    -------
    bends : ndarray, shape (C, 6 n_sources)
        In σ of the readings.
    directions : ndarray, shape (C, 6 n_sources, N)
        One σ of the whole state along each axis, a right singular vector of the readings, in its chart.
    """
    n, axes = len(gaussians.x), N_SOURCE * gaussians.n_sources
    found, directions = np.empty((n, axes)), np.empty((n, axes, gaussians.x.shape[1]))
    work = core.problem(
        "row_bends",
        sources=gaussians.problem,
        rows=rows.problem,
        row=row,
        memory=memory,
        bends=found,
        directions=directions,
    )
    core.run("bend_row", work, n, block=n)
    return found, directions


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A pass of a filter and a smoother along trajectories.

    Attributes
    ----------
    offsets : ndarray, shape (C, n_rows, n)
        From the trajectories to the smoothed ones, in the charts about the former.
    last : Gaussians
        After the last row; means are offsets, too, and those of nuisances behind them.
    nis, log_evidence : ndarray, shape (C,)
        NIS of all rows but the first, and the evidence of all rows.
    """

    offsets: FloatArray
    last: Gaussians
    nis: FloatArray
    log_evidence: FloatArray


def smooth(trajectories: FloatArray, prior: Gaussians, steps: core.Problem, rows: Rows) -> Smoothed:
    """Return a pass along trajectories, at which motion and readings are linearised.

    Parameters
    ----------
    trajectories : ndarray, shape (C, n_rows, n)
        States of all sources, without nuisances.
    prior : Gaussians
        State before the first row, in the charts about the trajectories: its means are offsets.
    steps : core.Problem
        Steps of the motion, from :func:`steps_problem`.
    rows : Rows
    """
    n, last, offsets = len(trajectories), prior.unfilled(), np.empty_like(trajectories, order="C")
    nis, log_evidence = np.empty((2, n))
    work = core.problem(
        "smoothing",
        n_rows=trajectories.shape[1],
        trajectories=np.ascontiguousarray(trajectories),
        prior=replace(prior, firm=0.0).problem,
        rows=rows.problem,
        motion=steps,
        offsets=offsets,
        last=last.problem,
        nis=nis,
        log_evidence=log_evidence,
    )
    core.run("smooth_rows", work, n, block=max(1, _ROWS_A_CALL // trajectories.shape[1]))
    return Smoothed(offsets, last, nis, log_evidence)
