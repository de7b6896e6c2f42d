"""Independent answers for the tests: libraries we did not write, and arithmetic we cannot get wrong by rounding.

Each wrapper converts to our conventions (SI units, vectors in the last axis, k = mu_0/4 pi = 1e-7) and does no more.
"""

import datetime
from collections.abc import Callable
from decimal import Decimal, localcontext

import choclo
import magpylib
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.differentiate import jacobian
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import StateVector
from stonesoup.updater.kalman import IteratedKalmanUpdater

from magloc.measurement.differences import DifferenceMeasurement

Array = NDArray[np.float64]
K = 1e-7
CHOCLO_K: float = choclo.constants.VACUUM_MAGNETIC_PERMEABILITY / (4.0 * np.pi)


def magpylib_field(points: Array, source: Array, moment: Array) -> Array:
    """Dipole field in T at points (N, 3), by magpylib.

    magpylib gives the H-field in A/m of a dipole at the origin; B = mu_0 H with mu_0 = 4 pi 1e-7, not magpylib's own.
    """
    moments = np.broadcast_to(moment, points.shape)
    return 4.0 * np.pi * K * np.asarray(magpylib.core.dipole_Hfield(points - source, moments))


def choclo_field(points: Array, source: Array, moment: Array) -> Array:
    """Dipole field in T at points (N, 3), by choclo.

    choclo works in T but with the mu_0 of CODATA 2018, 5.4e-10 above 4 pi 1e-7: the result is scaled by the ratio.
    """
    fields = [choclo.dipole.magnetic_field(*point, *source, *moment) for point in points]
    return np.array(fields) * (K / CHOCLO_K)


def choclo_field_matrix(points: Array, source: Array) -> Array:
    """Matrices A with B = A m at points (N, 3), in T/(A m^2), by choclo.

    Poisson's relation: A/k and the gravity gradient tensor of a unit mass over the gravitational constant are both the
    second derivatives of 1/r.
    """
    point = choclo.point
    components = [
        [point.gravity_ee, point.gravity_en, point.gravity_eu],
        [point.gravity_en, point.gravity_nn, point.gravity_nu],
        [point.gravity_eu, point.gravity_nu, point.gravity_uu],
    ]
    tensors = [[[component(*s, *source, 1.0) for component in row] for row in components] for s in points]
    gravitational_constant: float = choclo.constants.GRAVITATIONAL_CONST
    return np.array(tensors) * (K / gravitational_constant)


def derivative(function: Callable[[Array], Array], at: ArrayLike, step: float, atol: float | None = None) -> Array:
    """Jacobian J[i, j] = df_i/dx_j at one vector, by scipy.differentiate: differences of order 8, refined to converge.

    function maps (..., m) to (..., n); step is the first step, in the unit of x; atol the error to stop at.
    """
    result = jacobian(
        lambda x: np.moveaxis(function(np.moveaxis(x, 0, -1)), -1, 0),
        np.asarray(at),
        initial_step=step,
        tolerances={"atol": atol},
    )
    if not np.all(result.success):
        raise ArithmeticError(f"scipy.differentiate did not converge: status {result.status}.")
    return np.asarray(result.df)


def decimal_field(point: ArrayLike, source: ArrayLike, moment: ArrayLike) -> Array:
    """Dipole field in T at one point, k [3 (m.d) d/r^5 - m/r^3] in 120-digit decimal arithmetic, rounded once."""
    with localcontext(prec=120):
        return np.array([float(b) for b in _decimal_field(_decimals(point), _decimals(source), _decimals(moment))])


def decimal_gradient_tensor(point: ArrayLike, source: ArrayLike, moment: ArrayLike) -> Array:
    """Gradient tensor in T/m at one point, by differences of the 120-digit field: no formula of its own.

    The steps are 1e-40 of the distance, so central differences are wrong by 1e-80, and lose 40 digits of 120.
    """
    with localcontext(prec=120):
        s, p, m = _decimals(point), _decimals(source), _decimals(moment)
        h = sum(((a - b) ** 2 for a, b in zip(s, p, strict=True)), Decimal(0)).sqrt() * Decimal("1e-40")
        columns = []
        for j in range(3):
            plus = _decimal_field([a + h * (i == j) for i, a in enumerate(s)], p, m)
            minus = _decimal_field([a - h * (i == j) for i, a in enumerate(s)], p, m)
            columns.append([float((a - b) / (2 * h)) for a, b in zip(plus, minus, strict=True)])
        return np.array(columns).T


def _decimal_field(s: list[Decimal], p: list[Decimal], m: list[Decimal]) -> list[Decimal]:
    d = [a - b for a, b in zip(s, p, strict=True)]
    r2 = sum((c * c for c in d), Decimal(0))
    r = r2.sqrt()
    radial = 3 * sum((a * b for a, b in zip(m, d, strict=True)), Decimal(0)) / r2
    return [Decimal("1e-7") * (radial * a - b) / (r2 * r) for a, b in zip(d, m, strict=True)]


def _decimals(vector: ArrayLike) -> list[Decimal]:
    """The components of a vector, exactly: every float is a finite decimal."""
    return [Decimal(float(c)) for c in np.asarray(vector)]


def stonesoup_iterated_update(x, P, z, R, h, H, max_iterations=100):
    """Mean and covariance after Stone Soup's IteratedKalmanUpdater, for callables h and H of a state."""
    time = datetime.datetime(2026, 1, 1)

    class Model(NonLinearGaussianMeasurement):
        """The callables in Stone Soup's shape."""

        ndim_meas = len(z)

        def function(self, state, noise=False, **kwargs):
            return StateVector(h(np.asarray(state.state_vector, dtype=float).ravel()))

        def jacobian(self, state, **kwargs):
            return H(np.asarray(state.state_vector, dtype=float).ravel())

    model = Model(ndim_state=len(x), mapping=tuple(range(len(x))), noise_covar=R)
    prediction = GaussianStatePrediction(StateVector(x), P, timestamp=time)
    detection = Detection(StateVector(z), timestamp=time, measurement_model=model)
    updater = IteratedKalmanUpdater(model, max_iterations=max_iterations, tolerance=1e-8)
    posterior = updater.update(SingleHypothesis(prediction, detection))
    return np.asarray(posterior.mean, dtype=float).ravel(), np.asarray(posterior.covar, dtype=float)


def fisher_information(measurement: DifferenceMeasurement, position: ArrayLike, moment: ArrayLike) -> Array:
    """Information (..., 6, 6) about (p, m) of a set of differences: HᵀR⁻¹H, in which R is diagonal."""
    whitened = measurement.jacobian(position, moment) / np.sqrt(measurement.variance)[:, None]
    return whitened.mT @ whitened
