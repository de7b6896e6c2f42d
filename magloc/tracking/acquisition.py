"""Start of a track from several rows that are individually insufficient."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.chi_square import normalised_square
from magloc.levels import CONTRADICTION, DISAGREEMENT
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.fit.results import Fix, Solution
from magloc.localization.locator import fit_at_rest
from magloc.localization.uncertainty.range_interval import relative_range_sigma
from magloc.measurement.nuisances import SensorErrors, ambient_in_array, with_eddies_as_offsets
from magloc.measurement.pose import PoseErrors
from magloc.state_space import predict, symmetric_square_root, update
from magloc.tracking.chart.known_moment import KnownInWorld
from magloc.tracking.measurement import RowMeasurement, RowMeasurements, step_of_errors
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.results import Prediction
from magloc.tracking.rows import Row

START_RANGE_ERROR = 0.03
"""Largest σ of the range over the range for a start. With more, the posterior is not Gaussian in Cartesian
coordinates."""
STACKED_POSITION_ERROR = 0.01
"""Largest σ of the position over the range for a start from several rows. Its prediction is a Cartesian Gaussian, over
which readings must be nearly linear."""
# Another solution within this Δχ² forbids a start.
_RIVAL_WITHIN = 9.0
# Rows for a fit at rest: the latest considered, the number used, and the rows between two fits.
_WINDOW_ROWS = 64
_STACKED_ROWS = 16
_TRY_EVERY = 4
# A fit is not tried if the position error by all rows so far exceeds the largest one of a start by this factor.
_MOST_HOPEFUL = 1.2
# Largest number of passes that linearise the rows of a start again, and the step, over its σ, that ends them.
_MOST_START_STEPS = 30
_START_TOLERANCE = 1e-3
# Prior standard deviations of the source over the posterior ones.
_UNKNOWN = 1e4


@dataclass(frozen=True, eq=False)
class AcquiredSource:
    """A source found from several rows, from which a track starts.

    Attributes
    ----------
    solution : Solution
        Solution in the world frame, with its weight among all solutions.
    rows : sequence of Row
        All recent rows in the order of time; the solution is a fit to some of them.
    rivals : tuple of Solution
        Other solutions that explain the same readings.
    """

    solution: Solution
    rows: Sequence[Row]
    rivals: tuple[Solution, ...] = ()


class Acquisition:
    """Combine rows that are individually insufficient until they determine a source."""

    def __init__(self, array: SensorArray, prior: SourcePrior) -> None:
        self.array = array
        # Bounds, and three numbers, are known in the axes of an array that moves.
        modulus = prior.known_moment_Am2 if isinstance(prior.known_moment_Am2, float | int) else None
        sigma_Am2 = None if modulus is None else prior.known_moment_sigma_Am2
        self._prior = SourcePrior(known_moment_Am2=modulus, known_moment_sigma_Am2=sigma_Am2)
        self._pose_errors = PoseErrors.of_array(array)
        self.forget()

    def forget(self) -> None:
        """Discard all rows."""
        self._recent: deque[Row] = deque(maxlen=_WINDOW_ROWS)
        self._n_rows = 0
        self._proposed: Solution | None = None

    def start(self, row: Row, position_error: float = 0.0) -> AcquiredSource | None:
        """Return a source by one more row, if the array has moved enough and the source has not.

        `position_error` is the standard deviation of the position over the range by other estimates, 0 without any.
        """
        self._recent.append(row)
        self._n_rows += 1
        recent = list(self._recent)
        if self._n_rows % _TRY_EVERY or len(recent) < 2 or position_error > _MOST_HOPEFUL * STACKED_POSITION_ERROR:
            return None
        if np.ptp([earlier.origin_m for earlier in recent], axis=0).max() <= self.array.circumradius:
            return None
        chosen = recent[:: -max(1, len(recent) // _STACKED_ROWS)]
        known = [earlier.ambient_T for earlier in chosen if earlier.ambient_T is not None]
        errors, lever_arm_m = self._pose_errors, np.array(self._pose_errors.uncertainty.lever_arm_m)
        fix = fit_at_rest(
            self._array_of(chosen),
            np.stack([earlier.readings_T for earlier in chosen]),
            np.stack([earlier.origin_m for earlier in chosen]),
            np.stack([earlier.R_world_from_array for earlier in chosen]),
            np.stack(known) if len(known) == len(chosen) else None,
            prior=self._prior,
            poses=errors.over_rows(
                self.array,
                np.array([earlier.time_s for earlier in chosen]),
                [earlier.pose(lever_arm_m) for earlier in chosen],
                [earlier.pose_sigma for earlier in chosen],
            ),
        )
        centroid = row.origin_m + row.R_world_from_array @ self.array.centroid
        before, self._proposed = self._proposed, _certain_solution(fix, centroid)
        if self._proposed is None or not _agree(before, self._proposed):
            return None
        return AcquiredSource(self._proposed, recent, fix.solutions[1:])

    def _array_of(self, rows: Sequence[Row]) -> SensorArray:
        """Return the array with eddy currents as errors of its offsets."""
        if not any(sensor.eddy_uncertainty_s for sensor in self.array.sensors):
            return self.array
        ambient_T = [ambient_in_array(self.array, row.readings_T, row.ambient_T) for row in rows]
        rates = [row.pose(np.zeros(3)).rate_rad_s for row in rows]
        return with_eddies_as_offsets(self.array, np.stack(ambient_T), np.stack(rates))


def _certain_solution(fix: Fix, centroid: FloatArray) -> Solution | None:
    """Return the first solution if it is certain and unique enough for a start."""
    if not fix.solutions:
        return None
    best = fix.solutions[0]
    fits = best.dof <= 0 or best.chi2 <= chdtri(best.dof, CONTRADICTION)
    certain = relative_range_sigma(best.covariance, best.position_m - centroid) <= START_RANGE_ERROR
    alone = all(solution.chi2 >= best.chi2 + _RIVAL_WITHIN for solution in fix.solutions[1:])
    return best if fits and best.range_observable and certain and alone else None


def _agree(before: Solution | None, after: Solution) -> bool:
    """Return True if two successive proposals agree; wrong optima usually move with new rows."""
    if before is None:
        return False
    offset = after.position_m - before.position_m
    both = before.covariance[:3, :3] + after.covariance[:3, :3]
    return bool(normalised_square(offset, both) < chdtri(3, DISAGREEMENT))


@dataclass(frozen=True, eq=False)
class StartState:
    """State at the start of a track, root of its covariance, χ², and state after each row."""

    x: FloatArray
    S: FloatArray
    chi2: float
    of_rows: Sequence[FloatArray] = ()


class CartesianFilter:
    """Filter of Cartesian states, for starts from several rows and for smoothing.

    Attributes
    ----------
    prior : SourcePrior
        Prior knowledge of the source's moment, in the array's frame.
    measurements : RowMeasurements
        Measurement models of the rows.
    errors : SensorErrors
        Lasting errors of the array's sensors: the last states.
    pose_errors : PoseErrors
        Errors of the array's pose: the states between those of the motion and `errors`.
    """

    prior: SourcePrior
    measurements: RowMeasurements
    errors: SensorErrors
    pose_errors: PoseErrors

    @property
    @abstractmethod
    def motion(self) -> MotionModel:
        """Motion of the source."""

    @property
    def n_errors(self) -> int:
        """Number of states after those of the motion: errors of the pose and of sensors."""
        return self.errors.n_states + self.pose_errors.n_states

    @property
    def error_sigma(self) -> FloatArray:
        """Prior standard deviations (n_errors,) of the errors of the pose and of sensors."""
        return np.concatenate([np.ones(self.pose_errors.n_states), self.errors.sigma])

    def predict(self, x: FloatArray, S: FloatArray, dt_s: float) -> Prediction:
        """Return the predicted state, square root of its covariance, and transition."""
        n, n_errors = self.motion.n_states, self.n_errors
        x_motion, F_motion, S_q_motion = self.motion.step(x[:n], dt_s)
        decay, noise = step_of_errors(self.pose_errors, self.errors, dt_s)
        noisy = np.flatnonzero(noise)
        F, S_q = np.zeros((n + n_errors,) * 2), np.zeros((n + n_errors, S_q_motion.shape[1] + noisy.size))
        F[:n, :n], S_q[:n, : S_q_motion.shape[1]] = F_motion, S_q_motion
        F[n + np.arange(n_errors), n + np.arange(n_errors)] = decay
        S_q[n + noisy, S_q_motion.shape[1] + np.arange(noisy.size)] = noise[noisy]
        return Prediction(np.concatenate([x_motion, decay * x[n:]]), predict(S, F, S_q), F, S_q)

    def initial_state(
        self, centre: FloatArray, root: FloatArray, R_world_from_array: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the prior state and its root, from a root (6, 6) of position and moment.

        With the array's rotation, a known moment is a measurement, linearised at the centre.
        """
        n = self.motion.n_states
        x, S = np.zeros(centre.size), np.diag(np.concatenate([np.zeros(n), self.error_sigma]))
        x[:n], S[:n, :n] = self.motion.start(centre[:N_SOURCE], root)
        if R_world_from_array is None or (known := KnownInWorld.of(self.prior, R_world_from_array)) is None:
            return x, S
        H = known.directional_derivative(centre[None], np.eye(len(centre))[None])[0]
        return update(x, S, H, known.residual(centre[None])[0] - H @ (x - centre))[:2]

    def start(self, source: FloatArray, covariance: FloatArray, rows: Sequence[Row]) -> StartState | None:
        """Return the state at the last of the rows from which a source (6,) at rest was fitted.

        `covariance` (6, 6) comes from the fit. A filter passes over the rows from a nearly flat prior, and linearises
        them at its last result until this converges. Thus motion between the rows and lasting errors of sensors are
        treated as in later rows. Return None if it does not converge, or if the rows contradict each other.
        """
        if len(rows) == 1 and not self.n_errors:
            return StartState(*self.motion.start(source, symmetric_square_root(covariance)), 0.0)
        measurements = [self.measurements.of(row) for row in rows]
        dof = sum(measurement.z.size for measurement in measurements) - N_SOURCE
        n, n_errors = self.motion.n_states, self.n_errors
        centres = [np.concatenate([source, np.zeros(n - N_SOURCE + n_errors)])] * len(rows)
        # Errors of the pose that change are linearised at each row's estimate, all other states at the last one.
        own = np.concatenate([np.full(n, False), self.pose_errors.is_changing, np.full(self.errors.n_states, False)])
        for _ in range(_MOST_START_STEPS):
            found = self.filter_start(centres, covariance, measurements)
            step = (found.x - centres[-1])[:N_SOURCE]
            centres = [np.where(own, of_row, found.x) for of_row in found.of_rows]
            if np.all(np.abs(step) < _START_TOLERANCE * np.linalg.norm(found.S[:N_SOURCE], axis=1)):
                return found if dof <= 0 or found.chi2 < chdtri(dof, CONTRADICTION) else None
        return None

    def filter_start(
        self, centres: Sequence[FloatArray], covariance: FloatArray, measurements: Sequence[RowMeasurement]
    ) -> StartState:
        """Return one pass of :meth:`start`, with each row linearised at a given state (n,)."""
        unknown = np.diag(_UNKNOWN * np.sqrt(np.diagonal(covariance)))
        x, S = self.initial_state(centres[0], unknown, measurements[0].row.R_world_from_array)
        chi2, of_rows = 0.0, []
        for j, (measurement, centre) in enumerate(zip(measurements, centres, strict=True)):
            if j:
                prediction = self.predict(x, S, measurement.row.time_s - measurements[j - 1].row.time_s)
                x, S = prediction.x, prediction.S
            H = measurement.jacobian(centre)
            x, S, nis = update(x, S, H, measurement.z - measurement.predict(centre) - H @ (x - centre))
            chi2 += nis
            of_rows.append(x)
        return StartState(x, S, chi2, of_rows)
