"""Compiled steps of a filter of several sources: predict, update, smooth.

:mod:`magloc.tracking.coordinates` explains the chart; tests/magloc/tracking/test_row_filter.py has the reference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import cycle
from typing import Any

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.measurement.nuisances import SensorErrors
from magloc.tracking.coordinates import FIRM
from magloc.tracking.motion import N_SOURCE, MotionModel, OrnsteinUhlenbeck
from magloc.tracking.rows import Rows

TOLERANCE = 1e-3
"""Length of the next step, in posterior standard deviations, at which the iteration stops."""
LEAST_GAIN = 0.25
"""Least share of the decrease of a linear problem; a step with less is halved, because it leads across a valley."""
MOST_ITERATIONS = 50
ROUNDING = 1e-9
"""Relative increase of the cost that counts as rounding; a step with more is halved."""
LEAST_SHARE = 0.02
"""Change of whitened readings over one σ of the prediction, above which a direction is as nonlinear as the readings of
the row. Directions with less were measured by other rows, whose nonlinearity may differ."""
LARGEST_BEND = 0.5
"""Nonlinearity of readings within one σ of a Gaussian, in σ of their noise, above which it is divided."""
_TURNING_NOISE = 15
"""Number of noises of a turning motion: acceleration, torque, velocity, rate and moment along each axis."""
_ROWS_A_CALL = 1000
"""Rows of trajectories that one call of the kernel smooths: some 10 ms."""
_FOLLOWED = 1e-3
"""Added variance of residuals in the test of sensors, so that a reading that the fit follows exactly has no weight."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussian states of several sources.

    Attributes
    ----------
    x : ndarray, shape (C, N)
        Means: the Cartesian states of the sources, then nuisances in which readings are linear.
    S : ndarray, shape (C, N, N)
        Roots of the covariances, in the charts about the means.
    n_sources, n_nuisances : int
    power : int
        Power of the range with which moments grow along the chart: 4, with which differences decrease, or 0.
    firm : float
        Relative σ of a moment below which its strength and direction are its coordinates.
    """

    x: FloatArray
    S: FloatArray
    n_sources: int = 1
    n_nuisances: int = 0
    power: int = 4
    firm: float = FIRM

    @property
    def problem(self) -> core.Problem:
        """Arguments of kernels."""
        return core.problem(
            "sources",
            n_sources=self.n_sources,
            n_states=(self.x.shape[1] - self.n_nuisances) // max(1, self.n_sources) or N_SOURCE,
            n_nuisances=self.n_nuisances,
            power=self.power,
            firm=self.firm,
            x=np.ascontiguousarray(self.x),
            roots=np.ascontiguousarray(self.S),
        )

    def empty_like(self) -> Gaussians:
        """Return as many Gaussians without values."""
        return replace(self, x=np.empty_like(self.x, order="C"), S=np.empty_like(self.S, order="C"))


@dataclass(frozen=True, eq=False)
class RowUpdates:
    """Gaussians after a row's readings; see :class:`magloc.tracking.chart.update.StateUpdates`.

    Attributes
    ----------
    correction : ndarray, shape (C,), optional
        Squared correction of the prediction by the readings, in its standard deviations, minus its mean.
    standardised : ndarray, shape (C, n_sensors, 3), optional
        Residuals of each sensor's channels, of unit covariance. Their sum of squares is the decrease of `nis` if the
        readings of the sensor are ignored.
    misfits : ndarray, shape (C, 2, k), optional
        Readings minus predicted ones, at the prediction and after the update.
    projectors : ndarray, shape (C, 2, d, k), optional
        Q at the same states: I - Qᵀ Q is the inverse of the readings' covariance in units of their noise.
    """

    after: Gaussians
    nis: FloatArray
    chi2: FloatArray
    log_evidence: FloatArray
    iterations: IntArray
    converged: BoolArray
    innovation: FloatArray | None
    correction: FloatArray | None
    standardised: FloatArray | None
    misfits: FloatArray | None
    projectors: FloatArray | None

    @property
    def x(self) -> FloatArray:
        """Means (C, N)."""
        return self.after.x

    @property
    def S(self) -> FloatArray:
        """Roots (C, N, N)."""
        return self.after.S

    def whitened_innovation(self, index: int) -> FloatArray:
        """Return the whitened innovation of one Gaussian."""
        assert self.innovation is not None
        return np.asarray(self.innovation[index])


@cache
def convergence(most: int = MOST_ITERATIONS, tolerance: float = TOLERANCE) -> core.Problem:
    """Return the stopping rule of an iterated update, with the largest number of trials."""
    return core.problem(
        "convergence", tolerance=tolerance, least_gain=LEAST_GAIN, rounding=ROUNDING, max_iterations=most
    )


def steps_problem(
    motions: MotionModel | Sequence[MotionModel],
    steps_s: Sequence[float],
    step_of_row: IntArray,
    nuisances: tuple[FloatArray, FloatArray] | None = None,
    states: FloatArray | None = None,
) -> core.Problem:
    """Return the motion of sources in steps of given lengths, as an argument of kernels.

    Parameters
    ----------
    motions : MotionModel, or sequence of them
        Motion of all steps, or of each step; of one class.
    steps_s : sequence of float
    step_of_row : ndarray of int, shape (n_rows,)
        Index of the step that leads to each row.
    nuisances : tuple of ndarray, optional
        Factor of each nuisance in each step, and σ of the added noise, (n_steps, n_nuisances) each.
    states : ndarray, shape (n, n_states), optional
        States before each step of every source of every Gaussian, for a motion that is neither linear nor
        :class:`OrnsteinUhlenbeck`.
    """
    every: Sequence[Any] = motions if isinstance(motions, Sequence) else [motions] * len(steps_s)
    of_steps = list(zip(every, steps_s, strict=True))
    if isinstance(every[0], OrnsteinUhlenbeck):
        return motion_problem(
            step_of_row, nuisances, turning=np.stack([one.turning_step(dt_s) for one, dt_s in of_steps])
        )
    if hasattr(every[0], "linear_step"):
        steps, names = [one.linear_step(dt_s) for one, dt_s in of_steps], ("F", "A", "B")
    else:
        assert states is not None
        steps = [one.step(x, dt_s) for x, (one, dt_s) in zip(states, cycle(of_steps), strict=False)]
        names = ("moved", "F", "A")
    parts = map(np.stack, zip(*steps, strict=True))
    return motion_problem(step_of_row, nuisances, **dict(zip(names, parts, strict=True)))


def motion_problem(
    step_of_row: IntArray, nuisances: tuple[FloatArray, FloatArray] | None, **steps: FloatArray
) -> core.Problem:
    """Return the steps of a motion, by the names of the C header, as an argument of kernels.

    See :func:`steps_problem`; steps of a turning motion are (n_steps, 12).
    """
    kept, added = (None, None) if nuisances is None else map(np.ascontiguousarray, nuisances)
    return core.problem(
        "motion",
        n_noise=steps["A"].shape[2] if "A" in steps else _TURNING_NOISE,
        **dict.fromkeys(("F", "A", "B", "moved", "turning")) | steps,
        kept=kept,
        added=added,
        step_of_row=np.ascontiguousarray(step_of_row, dtype=np.int64),
    )


def refill_step(steps: core.Problem, slot: int, motion: MotionModel, errors: SensorErrors, dt_s: float) -> None:
    """Replace one step of :func:`steps_problem`, made without states, by one of another length."""
    kept = steps.kept
    if kept["added"] is not None:
        kept["kept"][slot], kept["added"][slot] = errors.step(dt_s)
    if isinstance(motion, OrnsteinUhlenbeck):
        kept["turning"][slot] = motion.turning_step(dt_s)
    elif (linear_step := getattr(motion, "linear_step", None)) is not None:
        kept["F"][slot], kept["A"][slot], kept["B"][slot] = linear_step(dt_s)


def predict(before: Gaussians, centroid_m: FloatArray, steps: core.Problem, rows: Rows, row: int = 0) -> Gaussians:
    """Return Gaussians after the step to a row, from charts about `centroid_m`."""
    after = before.empty_like()
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
    pose_lasts: FloatArray | None = None,
    innovation: bool = False,
    linearisations: bool = False,
    most: int = MOST_ITERATIONS,
    tolerance: float = TOLERANCE,
) -> RowUpdates:
    """Return Gaussians after a row's readings, each by its own iterated update.

    Parameters
    ----------
    before : Gaussians
        Predictions.
    rows : Rows
    row : int
        Index of the row.
    bends : ndarray of bool, shape (C,), optional
        Predictions whose states of sources and pose are as nonlinear as the readings; nuisances absorb the remainder.
    pose_lasts : ndarray, shape (n_pose,), optional
        Share of each error of the pose for which this holds; by default 1.
    innovation, linearisations : bool
        Whether to return the whitened innovations, and the other optional attributes of the result.
    most : int
        Number of trials after which the iteration ends.
    tolerance : float
        Length of the next step, in standard deviations, below which it ends.
    """
    after, n = before.empty_like(), len(before.x)
    nis, chi2, log_evidence = np.empty((3, n))
    iterations, converged = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.uint8)
    whitened = np.empty((n, rows.readings.shape[1])) if innovation else None
    correction = np.empty(n) if innovation else None
    k, d = rows.readings.shape[1], N_SOURCE * before.n_sources + before.n_nuisances
    shapes = (n, rows.array.n_sensors, 3), (n, 2, k), (n, 2, d, k)
    standardised, misfits, projectors = (np.empty(shape) if linearisations else None for shape in shapes)
    work = core.problem(
        "row_update",
        before=before.problem,
        after=after.problem,
        rows=rows.problem,
        convergence=convergence(most, tolerance),
        row=row,
        bends=None if bends is None else bends.astype(np.uint8),
        pose_lasts=pose_lasts,
        least_share=LEAST_SHARE,
        followed=_FOLLOWED,
        nis=nis,
        chi2=chi2,
        log_evidence=log_evidence,
        iterations=iterations,
        converged=converged,
        innovation=whitened,
        correction=correction,
        standardised=standardised,
        misfits=misfits,
        projectors=projectors,
    )
    core.run("update_row", work, n, block=n)
    of_rows = (whitened, correction, standardised, misfits, projectors)
    return RowUpdates(after, nis, chi2, log_evidence, iterations, converged.astype(np.bool_), *of_rows)


def bends(gaussians: Gaussians, rows: Rows, memory: float, row: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return the nonlinearity of readings over one σ along axes of the sources.

    Parameters
    ----------
    gaussians : Gaussians
        Predictions.
    rows : Rows
    memory : float
        Largest number of rows over which the nonlinearity is counted: those that determine the σ.
    row : int
        Index of the row.

    Returns
    -------
    bends : ndarray, shape (C, 6 n_sources)
        Nonlinearity in σ of the readings.
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
class SmootherPass:
    """Result of one pass of a filter and a smoother along trajectories.

    Attributes
    ----------
    offsets : ndarray, shape (C, n_rows, n)
        Offsets of the smoothed trajectories, in the charts about the given ones.
    last : Gaussians
        State after the last row. Means are offsets, followed by the nuisances.
    nis, log_evidence : ndarray, shape (C,)
        NIS of all rows but the first, and the evidence of all rows.
    """

    offsets: FloatArray
    last: Gaussians
    nis: FloatArray
    log_evidence: FloatArray


def smooth(trajectories: FloatArray, prior: Gaussians, steps: core.Problem, rows: Rows) -> SmootherPass:
    """Filter and smooth with motion and readings linearised along trajectories.

    Parameters
    ----------
    trajectories : ndarray, shape (C, n_rows, n)
        States of all sources, without nuisances.
    prior : Gaussians
        State before the first row, in the charts about the trajectories: its means are offsets. Moments are firm in
        all charts if `firm` is infinite, else in none.
    steps : core.Problem
        Steps of the motion, from :func:`steps_problem`.
    rows : Rows
    """
    n, last, offsets = len(trajectories), prior.empty_like(), np.empty_like(trajectories, order="C")
    nis, log_evidence = np.empty((2, n))
    work = core.problem(
        "smoothing",
        n_rows=trajectories.shape[1],
        trajectories=np.ascontiguousarray(trajectories),
        prior=replace(prior, firm=prior.firm if math.isinf(prior.firm) else 0.0).problem,
        rows=rows.problem,
        motion=steps,
        offsets=offsets,
        last=last.problem,
        nis=nis,
        log_evidence=log_evidence,
    )
    core.run("smooth_rows", work, n, block=max(1, _ROWS_A_CALL // trajectories.shape[1]))
    return SmootherPass(offsets, last, nis, log_evidence)
