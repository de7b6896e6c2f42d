r"""Kalman filter of the moment of an object on a known path: MotionMV and MeasureS.

The moment is linear in a few parameters, :math:`m_j = M_j θ`: those of the object's axes (M turns with it, equation
(29) with its known rate), or permanent and induced parts. With the path exact and vector sensors the readings are
linear in θ, so that the filter is the linear one; an uncertain path adds its error as a state, a first-order Markov
process, and sensors the lasting errors that their array states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from arrays.io.errors import InputError
from arrays.typing import BoolArray, FloatArray
from magloc.levels import CONTRADICTION
from magloc.measurement.nuisances import SensorErrors
from magloc.signature.path import PathError
from magloc.state_space import IteratedUpdate, iterated_update, predict, update
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Prediction, Step
from magloc.tracking.whole_records.smoother import smooth_states

UNKNOWN = 1e3
"""Initial σ of the moment, in units of the moment that explains the strongest row."""
ROWS_TO_START_ANEW = 3
"""Number of successive contradicting rows after which the moment is started again."""
_TOLERANCE = 1e-4
_SHRINK = 0.5
_MOST_ITERATIONS = 50
# Largest number of passes over a record; they end when the last state changes by less than a share of its σ.
_MOST_PASSES = 20
_SETTLED = 1e-2


_OVERFLOW = "the readings: found values whose squares exceed double precision, expected fields in the unit of the file."


@dataclass(frozen=True, eq=False)
class Basis:
    """Matrices of the moment's dependence on its parameters, in every row.

    Attributes
    ----------
    M : ndarray, shape (n, 3 K, q)
        Moments of K sources in the frame of the results per parameter.
    by_turn : ndarray, shape (n, 3, 3 K, q)
        Derivative of M by a rotation of the object about each axis (second index) of that frame.
    """

    M: FloatArray
    by_turn: FloatArray


@dataclass(frozen=True, eq=False)
class MomentModel:
    """Measurement and process model of an object on a known path.

    The state is the path's error (position and attitude, without parts that are exact), θ (q), and the correlated
    errors of the sensors.

    Attributes
    ----------
    rows : tuple of RowMeasurement
    position_m : ndarray, shape (n, K, 3)
        Positions of the object, or of several sources, in the frame of the results.
    basis : Basis
    errors : SensorErrors
    path_error : PathError
    turn_rad_s : float
        Characteristic rate of change of θ, relative to its modulus; it gives S_q.
    begins : ndarray of bool, shape (n,)
        Rows at which a path begins; each path has a separate error.
    """

    rows: tuple[RowMeasurement, ...]
    position_m: FloatArray
    basis: Basis
    errors: SensorErrors
    path_error: PathError
    turn_rad_s: float
    begins: BoolArray

    @property
    def n_parameters(self) -> int:
        """Number q of parameters."""
        return int(self.basis.M.shape[2])

    @cached_property
    def moment(self) -> slice:
        """Slice of θ in the state."""
        first = self.path_error.sigma.size
        return slice(first, first + self.n_parameters)

    @property
    def is_linear(self) -> bool:
        """True if the readings are linear in the state."""
        return not (self.path_error.sigma.size or self.rows[0].model.array.channel_is_scalar.any())

    @cached_property
    def scale(self) -> float:
        """Parameter size that explains the largest signal at the object's nearest position."""
        at_rest = np.zeros(self.moment.stop + self.errors.n_states)
        strength = [np.linalg.norm(self.jacobian(i, at_rest)[:, self.moment]) for i in range(len(self.rows))]
        signal = [np.linalg.norm(row.z - self.predict(i, at_rest)) for i, row in enumerate(self.rows)]
        # Without any signal the scale has no effect.
        return max(1.0, float(np.max(signal))) / (float(np.max(strength)) or 1.0)

    def sources(self, i: int, x: FloatArray) -> FloatArray:
        """Return positions and moments (K, 6) of a state in row i."""
        p, m = self.position_m[i], (self._moment_matrix(i, x) @ x[self.moment]).reshape(-1, 3)
        return np.concatenate([p + x[:3] if self.path_error.position_m else p, m], axis=1)

    def sources_jacobian(self, i: int, x: FloatArray) -> FloatArray:
        """Return the derivative (K, 6, n) of positions and moments by the state."""
        J = np.zeros((self.position_m.shape[1], N_SOURCE, x.size))
        J[:, 3:, self.moment] = self._moment_matrix(i, x).reshape(len(J), 3, -1)
        if self.path_error.position_m:
            J[:, :3, :3] = np.eye(3)
        if self.path_error.attitude_rad:
            by_turn = (self.basis.by_turn[i] @ x[self.moment]).T
            J[:, 3:, self.moment.start - 3 : self.moment.start] = by_turn.reshape(len(J), 3, 3)
        return J

    def _moment_matrix(self, i: int, x: FloatArray) -> FloatArray:
        """Return M (3 K, q) with the attitude's error."""
        M: FloatArray = self.basis.M[i]
        if self.path_error.attitude_rad:
            M = M + np.einsum("k,kij->ij", x[self.moment.start - 3 : self.moment.start], self.basis.by_turn[i])
        return M

    def predict(self, i: int, x: FloatArray) -> FloatArray:
        """Return the differences (k,) of row i in units of their noise."""
        row, (first, *others) = self.rows[i], self.sources(i, x)
        others_T = np.sum([row.field_T(source) for source in others], axis=0) if others else None
        return row.predict_source(first, others_T=others_T) + row.effect @ x[self.moment.stop :]

    def jacobian(self, i: int, x: FloatArray) -> FloatArray:
        """Return the Jacobian (k, n) of the differences of row i."""
        row, sources = self.rows[i], self.sources(i, x)
        fields_T = [row.field_T(source) for source in sources] if len(sources) > 1 else []
        H = np.zeros((row.z.size, x.size))
        for k, J in enumerate(self.sources_jacobian(i, x)):
            others_T = np.delete(fields_T, k, axis=0).sum(axis=0) if fields_T else None
            H += row.directional_derivative(sources[k], J, others_T)
        H[:, self.moment.stop :] = row.effect
        return H

    def start(self) -> tuple[FloatArray, FloatArray]:
        """Return the state (n,) before the first row, and the square root of its covariance."""
        unknown = np.full(self.n_parameters, UNKNOWN * self.scale)
        sigma = np.concatenate([self.path_error.sigma, unknown, self.errors.sigma])
        return np.zeros(sigma.size), np.diag(sigma)

    def step(self, x: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
        """Return the diagonal F of the step to row i, and the square root S_q of its noise."""
        dt_s = self.rows[i].row.time_s - self.rows[i - 1].row.time_s
        kept_path = np.zeros(self.moment.start) if self.begins[i] else self.path_error.kept(dt_s)
        kept_errors, added = self.errors.step(dt_s)
        theta = x[self.moment]
        size = np.linalg.norm(theta.reshape(self.position_m.shape[1], -1), axis=1)
        change = np.repeat(self.turn_rad_s * dt_s * size, theta.size // size.size)
        F = np.concatenate([kept_path, np.ones(theta.size), kept_errors])
        of_path = self.path_error.sigma * np.sqrt(1.0 - kept_path**2)
        sigma = np.concatenate([of_path, change, added])
        noisy = np.flatnonzero(sigma)
        S_q = np.zeros((x.size, noisy.size))
        S_q[noisy, np.arange(noisy.size)] = sigma[noisy]
        return F, S_q


@dataclass(frozen=True, eq=False)
class MomentStep(Step):
    """One row of a filter.

    Attributes
    ----------
    nis : float
        Normalised innovation squared of the row.
    status : str
        Status as in :class:`magloc.tracking.results.TrackPoint`.
    """

    nis: float
    status: str
    iterations: int


def filter_rows(model: MomentModel, *, at: Sequence[FloatArray] | None = None, gate: bool = True) -> list[MomentStep]:
    """Return the filter's steps over all rows.

    ``at``: states at which the rows are linearised; without them each row is iterated. ``gate``: do not use rows that
    contradict the prediction; the third in succession starts the moment again.
    """
    steps: list[MomentStep] = []
    x, S = model.start()
    scale, contradictions = UNKNOWN * model.scale, 0
    for i, row in enumerate(model.rows):
        F, S_q = model.step(x, i) if i else (np.ones(x.size), np.zeros((x.size, 0)))
        x, S = F * x, predict(S, np.diag(F), S_q)
        prediction = Prediction(x, S, np.diag(F), S_q)
        if not row.z.size:
            steps.append(MomentStep(i, prediction, x, S, math.nan, "predicted", 0))
            continue
        update = _update_row(model, i, x, S, None if at is None else at[i])
        status = "tracked"
        if gate and not (update.converged and update.nis < chdtri(row.z.size, CONTRADICTION)):
            contradictions, status = contradictions + 1, "outlier"
            if contradictions == ROWS_TO_START_ANEW:
                unknown = np.zeros((x.size, model.n_parameters))
                unknown[model.moment] = scale * np.eye(model.n_parameters)
                S_q = np.concatenate([S_q, unknown], axis=1)
                S = predict(S, np.eye(x.size), unknown)
                prediction = Prediction(x, S, np.diag(F), S_q)
                update, status = _update_row(model, i, x, S, None if at is None else at[i]), "acquired"
        if status == "outlier":
            steps.append(MomentStep(i, prediction, x, S, update.nis, status, 0))
            continue
        contradictions = 0
        if not np.isfinite(update.S).all():
            raise InputError(_OVERFLOW)
        steps.append(MomentStep(i, prediction, update.x, update.S, update.nis, status, update.iterations))
        x, S = update.x, update.S
    return steps


def _update_row(model: MomentModel, i: int, x: FloatArray, S: FloatArray, at: FloatArray | None) -> IteratedUpdate:
    """Update by a row, iterated, or linearised at a given state."""
    z = model.rows[i].z
    if at is None:
        return iterated_update(
            x,
            S,
            z,
            np.ones(z.size),
            lambda state: model.predict(i, state),
            lambda state: model.jacobian(i, state),
            tolerance=_TOLERANCE,
            max_iterations=_MOST_ITERATIONS,
            shrink=_SHRINK,
        )
    H = model.jacobian(i, at)
    innovation = z - model.predict(i, at) - H @ (x - at)
    after, root, nis = update(x, S, H, innovation)
    return IteratedUpdate(after, root, 1, True, innovation, nis)


def relinearise(model: MomentModel, *, gate: bool) -> list[MomentStep]:
    """Filter with all rows linearised at the smoothed states.

    This is Gauss-Newton over the whole record.
    """
    steps = filter_rows(model, gate=gate)
    if model.is_linear:
        return steps
    for _ in range(_MOST_PASSES):
        states = smooth_states(steps)
        steps = filter_rows(model, at=[x for x, _ in states], gate=gate)
        change, S = steps[-1].x - states[-1][0], states[-1][1]
        if np.all(np.abs(change) < _SETTLED * np.linalg.norm(S, axis=1)):
            break
    return steps
