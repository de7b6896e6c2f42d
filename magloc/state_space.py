r"""State-space filtering with square roots of covariances: predict, update, iterate, smooth.

The module is generic and contains no magnetics. The covariance is stored as a square root S with :math:`P = S S^T`, so
that it stays symmetric and positive semidefinite even if a measurement's noise is tiny compared with the prior.

Names in the source paper (Pavlov, Karshakov, Goldin) and here:

==============  =================================================================
PrognosisFK     :func:`predict`
ProcessingFK    :func:`update`, of all scalars at once
MeasureS        :func:`estimability`
(19), (30)      stop rule of :func:`iterated_update`
==============  =================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dgeqrf, dtrtrs

from arrays.typing import FloatArray

MeasurementFunction = Callable[[FloatArray], FloatArray]
_ones_below = cache(np.tri)


def predict(S: FloatArray, F: FloatArray, S_q: FloatArray) -> FloatArray:
    """Return the square root of ``F S Sᵀ Fᵀ + S_q S_qᵀ`` (the paper's PrognosisFK).

    Parameters
    ----------
    S : ndarray, shape (n, n)
        Square root of the covariance.
    F : ndarray, shape (n, n)
        State transition matrix.
    S_q : ndarray, shape (n, m)
        Square root of the process noise covariance.

    Returns
    -------
    ndarray, shape (n, n)
        Lower triangular matrix from an orthogonal factorisation. The covariance itself is never formed.
    """
    # Call LAPACK directly: NumPy's checks take several times longer than such a small factorisation.
    upper = dgeqrf(np.concatenate([F @ S, S_q], axis=1).T, overwrite_a=True)[0]
    return upper[: len(S)].T * _ones_below(len(S))


def update(x: FloatArray, S: FloatArray, H: FloatArray, innovation: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    r"""Update with all scalars of one linearisation at once, in units of their noise (the paper's ProcessingFK).

    Least squares in units of the prior, :math:`x^+ = x + S e`: e minimises :math:`|Φ e - ν|^2 + |e|^2` with
    :math:`Φ = H S`. The triangular factor :math:`[U, b; 0, ρ]` of the rows :math:`[Φ, ν; I, 0]` gives all results:
    :math:`S^+ = S U^{-1}`, :math:`x^+ = x + S^+ b`, NIS = :math:`ρ^2`.

    Parameters
    ----------
    x : ndarray, shape (n,)
    S : ndarray, shape (n, n)
        Square root of the covariance.
    H : ndarray, shape (k, n)
        Measurement matrix of independent scalars. Every row is divided by the standard deviation of its scalar.
    innovation : ndarray, shape (k,)
        Measured minus predicted at x, divided by the same standard deviations.

    Returns
    -------
    x, S : ndarray
        Updated copies.
    nis : float
        Normalised innovation squared: χ² with k degrees of freedom if the prediction is right.

    Notes
    -----
    The square-root information filter of Bierman, "Factorization Methods for Discrete Sequential Estimation", V.
    """
    k, n = H.shape
    if not k:
        return x, S, 0.0
    rows = np.eye(k + n, n + 1, -k, order="F")
    rows[:k, :n], rows[:k, n] = H @ S, innovation
    triangle = dgeqrf(rows, overwrite_a=True)[0]
    root = dtrtrs(triangle[:n, :n], S.T, trans=1)[0].T
    return x + root @ triangle[:n, n], root, float(triangle[n, n]) ** 2


def whitened_innovation(S: FloatArray, H: FloatArray, innovation: FloatArray) -> FloatArray:
    """Return the whitened innovation ``L⁻¹ ν`` (k,) with ``L Lᵀ = H S Sᵀ Hᵀ + I``, L lower triangular.

    H and ν are in units of the noise, as in :func:`update`.
    """
    k = len(H)
    if not k:
        return innovation
    # A root of I + Φ Φᵀ without the sum, which would lose digits if the prediction is very uncertain.
    L = predict(np.eye(k), np.eye(k), H @ S)
    return np.asarray(np.sign(L.diagonal()) * dtrtrs(L, innovation, lower=True)[0])


@dataclass(frozen=True, eq=False)
class IteratedUpdate:
    """Result of :func:`iterated_update`.

    Attributes
    ----------
    x : ndarray, shape (n,)
        Updated estimate.
    S : ndarray, shape (n, n)
        Square root of its covariance, linearised at the last iteration.
    iterations : int
        Number of linearisations.
    converged : bool
        True if the stop rule was met. Otherwise x is not an optimum and must not be used as one.
    innovation : ndarray, shape (k,)
        Measured minus predicted at the predicted state.
    nis : float
        Normalised innovation squared of the last linearisation. After convergence it is the minimum of the sum of
        squares of residual and correction, in units of their noise: χ² with k degrees of freedom, for nonlinear
        measurements too. NaN without a linearisation.
    """

    x: FloatArray
    S: FloatArray
    iterations: int
    converged: bool
    innovation: FloatArray
    nis: float


def iterated_update(
    x: FloatArray,
    S: FloatArray,
    z: FloatArray,
    variance: FloatArray,
    Hx: MeasurementFunction,
    HJacobian: MeasurementFunction,
    *,
    tolerance: float,
    max_iterations: int = 50,
    shrink: float = 1.0,
) -> IteratedUpdate:
    r"""Return the iterated extended Kalman update with the paper's stop rule.

    Every iteration linearises at :math:`x_k` and processes all scalars from the *predicted* mean and covariance again,
    with innovations :math:`z - h(x_k) - H(x_k)(x - x_k)`. This is Gauss-Newton on the maximum-a-posteriori cost, so
    each measurement counts once, no matter how many linearisations there are. The iteration stops when
    :math:`\|h(x_{k+1}) - h(x_k)\| <` `tolerance`, equations (19) and (30).

    Parameters
    ----------
    x : ndarray, shape (n,)
        Predicted mean.
    S : ndarray, shape (n, n)
        Square root of the predicted covariance.
    z : ndarray, shape (k,)
        Independent scalar measurements.
    variance : ndarray, shape (k,)
        Their variances.
    Hx : callable
        Predicted measurements of a state, (n,) -> (k,).
    HJacobian : callable
        Their Jacobian, (n,) -> (k, n).
    tolerance : float
        Tolerance of the stop rule in the unit of z, usually a fraction of the sensors' noise. With 0 all allowed
        linearisations are used.
    max_iterations : int
        Largest number of linearisations. With 1 the update equals an extended Kalman filter's; with a `tolerance` of
        0 it then needs one prediction only.
    shrink : float
        Factor for the length of the steps. It applies each time a step changes the prediction no less than the step
        before, because Gauss-Newton steps may oscillate about an optimum in a strongly curved direction. With 1 all
        steps are full steps, as in the paper.
    """
    sigma = np.sqrt(variance)
    x_k, predicted = x, Hx(x)
    innovation = z - predicted
    S_k, nis = S, np.nan
    iteration, change, length = 0, np.inf, 1.0
    while iteration < max_iterations and np.isfinite(predicted).all() and not change < tolerance:
        iteration += 1
        H = HJacobian(x_k)
        optimum, S_k, nis = update(x, S, H / sigma[:, None], (z - predicted - H @ (x - x_k)) / sigma)
        x_k = optimum if length == 1.0 else x_k + length * (optimum - x_k)
        if iteration == max_iterations and not tolerance > 0.0:
            break  # no change is below a tolerance of 0
        before, predicted = predicted, Hx(x_k)
        step = predicted - before
        change_before, change = change, math.sqrt(step @ step) / length
        if change >= change_before:
            length *= shrink
    return IteratedUpdate(x_k, S_k, iteration, change < tolerance, innovation, nis)


# Series of 2x - 3 + 4 exp(-x) - exp(-2x) over x³, from the highest power down; up to x = 1 the rest is below rounding.
_VARIANCE_OF_VALUE = tuple((4.0 - 2.0**k) * (-1.0) ** k / math.factorial(k) for k in range(22, 2, -1))


def ornstein_uhlenbeck_step(correlation_s: float, dt_s: float) -> tuple[float, float, FloatArray]:
    """Return F[0, 1] and F[1, 1] of (value, rate), and the root (2, 2) of its noise for σ = 1."""
    x = dt_s / correlation_s
    if x < 1e-100:
        return dt_s, 1.0, np.zeros((2, 2))
    lost, Q_vv = -math.expm1(-x), -math.expm1(-2.0 * x)
    if x > 1.0:
        Q_pp = 2.0 * x - 3.0 + 4.0 * math.exp(-x) - math.exp(-2.0 * x)
    else:  # the closed form cancels in short steps, its series does not
        Q_pp = 0.0
        for term in _VARIANCE_OF_VALUE:
            Q_pp = Q_pp * x + term
        Q_pp *= x**3
    root_pp = math.sqrt(Q_pp)
    root_pv = lost * lost / root_pp
    root_vv = math.sqrt(Q_vv - root_pv * root_pv)
    root = np.array([[correlation_s * root_pp, 0.0], [root_pv, root_vv]])
    return correlation_s * lost, math.exp(-x), root


def smoothing_gain(S: FloatArray, F: FloatArray, S_q: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Return the gain G of a fixed-interval smoother over one step, and a root D of the remaining covariance.

    With the filtered covariance :math:`S S^T` before a step, the smoothed state is
    :math:`x_{j|n} = x_j + G (x_{j+1|n} - x_{j+1|j})`, and its covariance
    :math:`P_{j|n} = D D^T + G P_{j+1|n} G^T` is a sum of squares without subtraction.

    Parameters
    ----------
    S : ndarray, shape (..., n, n)
        Square root of the filtered covariance.
    F : ndarray, shape (..., n, n)
        Transition matrix.
    S_q : ndarray, shape (..., n, m)
        Square root of the covariance of the step's process noise.

    Returns
    -------
    G, D : ndarray, shape (..., n, n)

    Notes
    -----
    This is Rauch, Tung and Striebel's smoother in array form: P. Park and T. Kailath, "New square-root smoothing
    algorithms", IEEE Transactions on Automatic Control 41 (1996) 727.
    """
    n = S.shape[-1]
    before = np.concatenate([S.mT @ F.mT, S.mT], axis=-1)
    noise = np.concatenate([S_q.mT, np.zeros((*S_q.shape[:-2], S_q.shape[-1], n))], axis=-1)
    upper = np.asarray(np.linalg.qr(np.concatenate([before, noise], axis=-2), mode="r"))
    return np.linalg.solve(upper[..., :n, :n], upper[..., :n, n:]).mT, upper[..., n:, n:].mT.copy()


def estimability(S: FloatArray, S_predicted: FloatArray) -> FloatArray:
    r"""Return the stochastic measure of estimability of every component (the paper's MeasureS).

    :math:`\mu_i = 1 - \sigma_i / \sigma_i^-` is 0 if the measurements have no information about a component, and 1 if
    they determine it exactly.

    Parameters
    ----------
    S : ndarray, shape (..., n, n)
        Square root of the covariance after the measurements.
    S_predicted : ndarray, shape (..., n, n)
        Square root of the covariance predicted without any measurement.

    Returns
    -------
    ndarray, shape (..., n)
    """
    return 1.0 - np.linalg.norm(S, axis=-1) / np.linalg.norm(S_predicted, axis=-1)


class IteratedExtendedKalmanFilter:
    r"""Iterated extended Kalman filter with a square-root covariance and filterpy's names.

    Call ``predict()``, then ``update(z, HJacobian, Hx)``, as in :class:`filterpy.kalman.ExtendedKalmanFilter`. The
    update is iterated (:func:`iterated_update`). A correlated `R` is first decorrelated by its eigenvectors.

    Parameters
    ----------
    dim_x, dim_z : int
        Sizes of the state and of the measurement.
    tolerance : float
        Stop rule: norm of the change of the predicted measurements between iterations, in the unit of z. 0 means no
        stop rule.
    max_iterations : int
        Largest number of linearisations, at least 1.

    Attributes
    ----------
    x : ndarray, shape (n,)
        State estimate.
    P : ndarray, shape (n, n)
        Covariance of x; an assignment factorises it. The attribute `S` is the square root.
    F, Q : ndarray, shape (n, n)
        Transition matrix and process noise covariance (positive semidefinite).
    R : ndarray, shape (k, k)
        Measurement noise covariance.
    y, nis : ndarray, float
        Innovation of the last update at the predicted state, and its normalised square.
    iterations, converged : int, bool
        Number of linearisations of the last update, and True if it met the stop rule.
    x_prior, S_prior, P_prior, x_post, S_post, P_post : ndarray
        Copies after the last `predict` and the last `update`.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> kf = magloc.IteratedExtendedKalmanFilter(dim_x=1, dim_z=1, tolerance=1e-9)
    >>> kf.x, kf.P, kf.R = np.array([2.0]), np.eye(1), 1e-4 * np.eye(1)
    >>> kf.update([9.0], lambda x: np.array([2.0 * x]), lambda x: x**2)
    >>> kf.x.round(3), kf.converged
    (array([3.]), True)
    """

    def __init__(self, dim_x: int, dim_z: int, *, tolerance: float, max_iterations: int = 50) -> None:
        if max_iterations < 1:
            raise ValueError(f"Input max_iterations must be at least 1; instead received {max_iterations}.")
        self.dim_x = dim_x
        self.dim_z = dim_z
        self.tolerance = tolerance
        self.max_iterations = max_iterations
        self.x: FloatArray = np.zeros(dim_x)
        self.S: FloatArray = np.eye(dim_x)
        self.F: FloatArray = np.eye(dim_x)
        self.Q: FloatArray = np.zeros((dim_x, dim_x))
        self._S_q, self._factored_Q = self.Q.copy(), self.Q.tobytes()
        self.R: FloatArray = np.eye(dim_z)
        self.y: FloatArray = np.zeros(dim_z)
        self.nis = np.nan
        self.iterations = 0
        self.converged = False
        self.x_prior = self.x_post = self.x.copy()
        self.S_prior = self.S_post = self.S.copy()

    @property
    def P(self) -> FloatArray:
        """Covariance ``S Sᵀ``, shape (n, n)."""
        return self.S @ self.S.T

    @P.setter
    def P(self, covariance: ArrayLike) -> None:
        self.S = symmetric_square_root(np.broadcast_to(np.asarray(covariance, dtype=np.float64), (self.dim_x,) * 2))

    @property
    def P_prior(self) -> FloatArray:
        """Covariance after the last :meth:`predict`, shape (n, n)."""
        return self.S_prior @ self.S_prior.T

    @property
    def P_post(self) -> FloatArray:
        """Covariance after the last :meth:`update`, shape (n, n)."""
        return self.S_post @ self.S_post.T

    def predict(self) -> None:
        """Time update: ``x = F x``, ``P = F P Fᵀ + Q``."""
        self.x = self.F @ self.x
        key = np.asarray(self.Q, dtype=np.float64).tobytes()
        if key != self._factored_Q:
            self._S_q, self._factored_Q = symmetric_square_root(self.Q), key
        self.S = predict(self.S, self.F, self._S_q)
        self.x_prior, self.S_prior = self.x.copy(), self.S.copy()

    def update(
        self,
        z: ArrayLike,
        HJacobian: MeasurementFunction,
        Hx: MeasurementFunction,
        R: ArrayLike | None = None,
    ) -> None:
        """Update the state with a measurement, iterating its linearisation.

        Parameters
        ----------
        z : array_like, shape (k,)
            Measurement.
        HJacobian, Hx : callable
            Jacobian (k, n) and prediction (k,) of a state (n,).
        R : array_like, optional
            Noise covariance (k, k), variances (k,) or one variance, for this update only.
        """
        z = np.atleast_1d(np.asarray(z, dtype=np.float64))
        noise = np.asarray(self.R if R is None else R, dtype=np.float64)
        covariance = noise if noise.ndim == 2 else np.diag(np.broadcast_to(noise, z.shape))
        variance = covariance.diagonal()
        update = partial(iterated_update, self.x, self.S, tolerance=self.tolerance, max_iterations=self.max_iterations)
        if np.count_nonzero(covariance) == np.count_nonzero(variance):
            result = update(z, variance, Hx, HJacobian)
            self.y = result.innovation
        else:
            variance, T = np.linalg.eigh(covariance)
            result = update(T.T @ z, variance, lambda x: T.T @ Hx(x), lambda x: T.T @ HJacobian(x))
            self.y = T @ result.innovation
        self.x, self.S, self.nis = result.x, result.S, result.nis
        self.iterations, self.converged = result.iterations, result.converged
        self.x_post, self.S_post = self.x.copy(), self.S.copy()


def symmetric_square_root(covariance: FloatArray) -> FloatArray:
    """Return S with ``S Sᵀ = covariance`` of a positive semidefinite matrix; Cholesky fails for singular ones."""
    covariance = np.asarray(covariance, dtype=np.float64)
    # States of mixed units (m, A·m²) differ by many orders of magnitude. Correlations do not, so factor those.
    deviation = np.sqrt(np.clip(np.diagonal(covariance), 0.0, None))
    scale = np.where(deviation > 0.0, deviation, 1.0)
    correlation = covariance / np.outer(scale, scale)
    if not np.abs(correlation - correlation.T).max(initial=0.0) <= 1e-9:
        raise ValueError("Input covariance must be symmetric; instead received a matrix that is not.")
    eigenvalue, eigenvector = np.linalg.eigh(correlation)
    if eigenvalue[0] < -1e-9 * max(1.0, eigenvalue[-1]):
        found = f"a matrix whose correlations have the eigenvalue {eigenvalue[0]:g}"
        raise ValueError(f"Input covariance must be positive semidefinite; instead received {found}.")
    return scale[:, None] * eigenvector * np.sqrt(np.clip(eigenvalue, 0.0, None))
