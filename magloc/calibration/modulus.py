"""Calibration of one vector sensor that is turned in a field of known modulus.

The readings lie on an ellipsoid :math:`r = o + M P u + n`, :math:`|u| = 1`. The offset o and the symmetric P are
estimated by maximum likelihood with every direction u unknown. The curvatures κ bias the distance by
:math:`σ^2 (κ_1 + κ_2) / 2`, which is subtracted. A rotation of the sensor's axes is not observable. See
docs/theory/calibration.md, also for the relation to TWOSTEP.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from arrays.array import SensorArray
from arrays.io.errors import check_positive
from arrays.io.values import fields
from arrays.sensor import Calibration
from arrays.typing import FloatArray
from magloc.least_squares import minimise
from magloc.levels import MISFIT
from magloc.measurement.rows import check_rows

N_PARAMETERS = 9
"""Three numbers of the offset and six of the symmetric scale matrix."""
_ROW, _COLUMN = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
# A step that changes the fit by less than this, in standard deviations or relative to the rounding of the readings.
_SETTLED = 1e-9
_SETTLED_RTOL = 1e-13
_NEAREST_ITERATIONS = 50
# Search range of the algebraic fit: squared distance of the mean reading from the offset, in squared mean moduli.
_LARGEST_SHIFT = 2.0
_SHIFTS = 81
_BISECTIONS = 40
# Relative standard deviation beyond which a linearised covariance is not valid.
_LARGEST_UNCERTAINTY = 0.02
# Allowed factor between χ² and its parabola, two standard deviations along the least known direction.
_LARGEST_RISE_RATIO = 2.0
# Noise over the least radius of curvature beyond which the second-order bias of the distance is not valid.
_LARGEST_NOISE = 0.2
_NEARLY_ALL, _OUTLYING = 0.9, 3.0  # share of the readings, and factor beyond them at which others are wild
# Noise spreads the readings by σ/M, which looks like information about directions that they do not cover.
_FEIGNED = 4.0


@dataclass(frozen=True, eq=False)
class EllipsoidCalibration:
    """Scale and offset of a sensor, as far as the modulus of the field determines them.

    If `converged` is false, `reason` says why, and all numbers are NaN.

    Attributes
    ----------
    scale : ndarray, shape (3, 3)
        Symmetric positive definite P; the sensor's scale matrix is P Q with an unknown rotation Q.
    offset_T : ndarray, shape (3,)
        Reading in zero field [T].
    covariance : ndarray, shape (9, 9)
        Covariance of (offset x y z [T], scale xx yy zz xy xz yz), for the stated noise and an exact modulus.
    chi2 : float
        Sum of squared distances from the ellipsoid, bias removed, over the noise squared.
    dof : int
        Readings minus nine.
    reason : str
        Empty string if it converged.
    """

    scale: FloatArray
    offset_T: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    iterations: int
    converged: bool
    reason: str = ""

    @property
    def misfit(self) -> bool:
        """True if χ² is beyond noise; then the covariance is wrong too.

        The modulus, its noise or the sensor are not as stated.
        """
        return self.converged and self.dof > 0 and bool(chdtrc(self.dof, self.chi2) < MISFIT)


@dataclass(frozen=True, eq=False)
class _EllipsoidProblem:
    """Readings and moduli divided by their typical size, so that P is about 1."""

    readings: FloatArray
    modulus: FloatArray
    noise: float


@dataclass(frozen=True, eq=False)
class _EllipsoidIterate:
    problem: _EllipsoidProblem
    offset: FloatArray
    scale: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    cost: float

    @cached_property
    def _factors(self) -> tuple[FloatArray, FloatArray]:
        return np.linalg.qr(self.jacobian)

    def retract(self, step: FloatArray) -> _EllipsoidIterate:
        """Return the fit after a step (9,) of offset and scale."""
        return _linearise(self.problem, self.offset + step[:3], self.scale + symmetric(step[3:]))

    def step(self, damping: float) -> tuple[_EllipsoidIterate, float]:
        """Return the fit after a damped step, and the decrease of χ² that it promises.

        The step uses orthogonal transformations: normal equations would square the condition number.
        """
        q, triangle = self._factors
        weights = np.diag(np.sqrt(damping) * np.linalg.norm(triangle, axis=0))
        right = np.concatenate([q.T @ self.residual, np.zeros(N_PARAMETERS)])
        step = -np.linalg.lstsq(np.concatenate([triangle, weights]), right, rcond=None)[0]
        return self.retract(step), float(np.sum((triangle @ step) ** 2))


def ellipsoid_calibration(readings_T: ArrayLike, modulus_T: ArrayLike, noise_T: float) -> EllipsoidCalibration:
    """Calibrate a vector sensor that was turned in a field of known modulus.

    ``readings_T`` (n, 3): raw readings [T]; rows with a NaN are ignored. ``modulus_T`` () or (n,): modulus of
    the field in every row [T]. ``noise_T``: standard deviation of the readings per axis [T].
    Not converged where there are fewer than nine complete readings, or where they do not determine all nine
    parameters: readings in one plane, in one small cap or along a few directions. Raises ValueError: the shapes do not
    agree, or a modulus or the noise is not positive and finite.
    """
    readings, modulus = _check_inputs(readings_T, modulus_T, noise_T)
    if len(readings) < N_PARAMETERS:
        return _failure(f"{len(readings)} complete readings are fewer than the nine unknowns", len(readings), 0)
    centre, field_unit = readings.mean(axis=0), float(np.sqrt(np.mean(modulus**2)))
    unit = float(np.sqrt(np.mean(np.sum((readings - centre) ** 2, axis=1))))
    if unit == 0.0:
        return _failure("all readings are the same", len(readings), 0)
    problem = _EllipsoidProblem((readings - centre) / unit, modulus / field_unit, noise_T / unit)
    least = max(_SETTLED, _SETTLED_RTOL * np.sqrt(len(readings)) / problem.noise) ** 2
    optima = [minimise(_linearise(problem, *start), lambda _: least) for start in _starts(problem)]
    best = min(optima, key=lambda optimum: (not optimum.converged, optimum.point.cost))
    fit, iterations = best.point, best.iterations
    if not best.converged:
        return _failure("the iteration did not converge", len(readings), iterations)
    if problem.noise > _LARGEST_NOISE * _least_radius_of_curvature(problem, fit):
        return _failure("the noise is not small against the ellipsoid's radii of curvature", len(readings), iterations)
    root = _root_covariance(problem, fit)
    if root is None:
        return _failure("the readings do not determine all nine parameters", len(readings), iterations)
    to_si = np.repeat([unit, unit / field_unit], [3, 6])
    root = to_si[:, None] * root
    return EllipsoidCalibration(
        scale=fit.scale * (unit / field_unit),
        offset_T=centre + unit * fit.offset,
        covariance=root @ root.T,
        chi2=fit.cost,
        dof=len(readings) - N_PARAMETERS,
        iterations=iterations,
        converged=True,
    )


def calibrate_in_modulus(
    array: SensorArray, readings_T: ArrayLike, modulus_T: ArrayLike
) -> tuple[SensorArray, dict[str, EllipsoidCalibration]]:
    """Calibrate every vector sensor of an array that was turned in a field of known modulus.

    The readings do not determine the rotation Q of the sensor's axes. Of all scale matrices P Q that they allow, the
    result is the one nearest to the sensor's previous scale matrix. State the uncertainty of the rotation as the
    sensor's ``misalignment_rad``.

    ``array``: states the noise of the readings. ``readings_T`` (n, C): raw readings in channel order [T]; NaN
    where missing. ``modulus_T`` () or (n,): modulus of the field in every row, the same at all sensors [T].
    Returns the array with the calibrations of the sensors whose fit converged, and the fits by the sensors' ids.
    Raises ValueError: the shapes do not agree, a modulus is not positive and finite, or the array has no vector sensor.
    """
    readings = check_rows(array, readings_T)
    if array.channel_is_scalar.all():
        raise ValueError("Input array must have a vector sensor; instead received scalar sensors only.")
    sensors, results = list(array.sensors), {}
    for i, sensor in enumerate(array.sensors):
        if sensor.kind != "vector":
            continue
        result = ellipsoid_calibration(readings[:, array.sensor_channels[i]], modulus_T, sensor.noise_T)
        results[sensor.id] = result
        if result.converged:
            # The rotation Q that brings P Q nearest to the previous scale matrix: orthogonal Procrustes.
            left, _, right = np.linalg.svd(result.scale @ np.asarray(sensor.calibration.scale))
            calibration = Calibration.of("vector", result.scale @ left @ right, result.offset_T)
            sensors[i] = replace(sensor, calibration=calibration)
    return replace(array, sensors=tuple(sensors)), results


def wild_limit_T(readings_T: FloatArray) -> float:
    """Return the size beyond which readings are far larger than nearly all others [T]; infinity without readings."""
    size = np.abs(readings_T[np.isfinite(readings_T)])
    return _OUTLYING * float(np.quantile(size, _NEARLY_ALL, method="lower")) if size.size else np.inf


def _check_inputs(readings_T: ArrayLike, modulus_T: ArrayLike, noise_T: float) -> tuple[FloatArray, FloatArray]:
    readings = fields(readings_T)
    if readings.ndim != 2 or readings.shape[1] != 3:
        raise ValueError(f"Input readings_T must have shape (n, 3); instead received {readings.shape}.")
    modulus = np.asarray(modulus_T, dtype=np.float64)
    if modulus.shape not in ((), (len(readings),)):
        raise ValueError(
            f"Input modulus_T must be a number or have shape ({len(readings)},); instead received {modulus.shape}."
        )
    if not (np.isfinite(modulus).all() and (modulus > 0.0).all()):
        raise ValueError(
            f"Input modulus_T must be positive and finite; instead received {modulus.min(initial=np.inf)}."
        )
    check_positive(noise_T=noise_T)
    complete = np.isfinite(readings).all(axis=1)
    return readings[complete], np.broadcast_to(modulus, len(readings))[complete]


def _failure(reason: str, n_readings: int, iterations: int) -> EllipsoidCalibration:
    return EllipsoidCalibration(
        scale=np.full((3, 3), np.nan),
        offset_T=np.full(3, np.nan),
        covariance=np.full((N_PARAMETERS, N_PARAMETERS), np.nan),
        chi2=np.nan,
        dof=n_readings - N_PARAMETERS,
        iterations=iterations,
        converged=False,
        reason=reason,
    )


def _starts(problem: _EllipsoidProblem) -> list[tuple[FloatArray, FloatArray]]:
    """Return a sphere about the mean reading, and every algebraic fit that is an ellipsoid.

    ``rᵀ A r - 2 bᵀ r = M² - c`` is linear in A = P⁻² and b = A o except for c = oᵀ A o, which is found by bisection.
    """
    r = problem.readings
    columns = np.concatenate([r[:, _ROW] * r[:, _COLUMN] * np.where(_ROW == _COLUMN, 1.0, 2.0), -2.0 * r], axis=1)
    right = np.stack([problem.modulus**2, np.ones(len(r))], axis=1)
    of_modulus, of_one = np.linalg.lstsq(columns, right, rcond=None)[0].T

    def algebraic(c: float) -> tuple[FloatArray, FloatArray, float] | None:
        x = of_modulus - c * of_one
        value, vector = np.linalg.eigh(symmetric(x[:6]))
        if value[0] <= 0.0:
            return None
        offset = (vector / value) @ vector.T @ x[6:]
        return offset, (vector / np.sqrt(value)) @ vector.T, float(offset @ x[6:]) - c

    starts = [(np.zeros(3), np.eye(3))]
    grid = np.linspace(0.0, _LARGEST_SHIFT, _SHIFTS)
    for low, high in pairwise(grid.tolist()):
        first, last = algebraic(low), algebraic(high)
        if first is None or last is None or first[2] * last[2] > 0.0:
            continue
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            between = algebraic(middle)
            if between is None:
                break
            low, high = (middle, high) if between[2] * first[2] > 0.0 else (low, middle)
            last = between
        starts.append(last[:2])
    return starts


def _linearise(problem: _EllipsoidProblem, offset: FloatArray, scale: FloatArray) -> _EllipsoidIterate:
    """Linearise the distances from an ellipsoid by (offset, P).

    Distances are in units of the noise, with the bias removed; χ² is infinite unless P is positive definite.
    """
    size, axes = np.linalg.eigh(scale)
    if size[0] <= 0.0:
        return _EllipsoidIterate(problem, offset, scale, np.empty(0), np.empty((0, N_PARAMETERS)), np.inf)
    semi_axes = problem.modulus[:, None] * size
    points = (problem.readings - offset) @ axes
    nearest = _nearest(points, semi_axes)
    normal = nearest / semi_axes**2
    steepness = np.linalg.norm(normal, axis=1)
    normal /= steepness[:, None]
    # Sum of the principal curvatures of x²/a² + y²/b² + z²/c² = 1: the divergence of its unit normal.
    curvature = (np.sum(semi_axes**-2, axis=1) - np.sum((normal / semi_axes) ** 2, axis=1)) / steepness
    distance = np.sum((points - nearest) * normal, axis=1)
    residual = distance / problem.noise - 0.5 * problem.noise * curvature
    # The foot point is stationary: only the normal's product with the change of o + M P u counts.
    normal = normal @ axes.T
    moved = problem.modulus[:, None] * ((nearest / semi_axes) @ axes.T)
    by_scale = np.where(
        _ROW == _COLUMN,
        normal[:, _ROW] * moved[:, _COLUMN],
        normal[:, _ROW] * moved[:, _COLUMN] + normal[:, _COLUMN] * moved[:, _ROW],
    )
    jacobian = -np.concatenate([normal, by_scale], axis=1) / problem.noise
    return _EllipsoidIterate(problem, offset, scale, residual, jacobian, float(residual @ residual))


def _nearest(points: FloatArray, semi_axes: FloatArray) -> FloatArray:
    """Return the nearest points of the ellipsoid Σ (x_i/a_i)² = 1 to points, both (n, 3).

    ``x_i = a_i² q_i / (a_i² + t)``, where t is the largest root of ``|s(t)| = 1``, ``s_i = a_i q_i / (a_i² + t)``. The
    function 1/|s| is concave in t, so that Newton's method from below climbs to the root.
    """
    product = semi_axes * points
    square = semi_axes**2
    # A component of zero would leave a pole without a residue, where the iteration may start.
    product = np.where(np.abs(product) > 1e-12 * square, product, 1e-12 * square)
    t = np.max(np.abs(product) - square, axis=1)
    for _ in range(_NEAREST_ITERATIONS):
        s = product / (square + t[:, None])
        length = np.linalg.norm(s, axis=1)
        step = (length - 1.0) * length**2 / np.sum(s**2 / (square + t[:, None]), axis=1)
        t = t + step
        if np.all(np.abs(step) <= 1e-12 * square.min(axis=1)):
            break
    return semi_axes * product / (square + t[:, None])


def _least_radius_of_curvature(problem: _EllipsoidProblem, fit: _EllipsoidIterate) -> float:
    size = np.linalg.eigvalsh(fit.scale)
    return float(problem.modulus.min() * size[0] ** 2 / size[-1])


def _root_covariance(problem: _EllipsoidProblem, fit: _EllipsoidIterate) -> FloatArray | None:
    """Return a square root of the covariance of (offset, P).

    None if the readings do not determine it.
    """
    # In units in which every parameter shifts a reading by about the radius of the ellipsoid.
    radius = float(np.linalg.det(fit.scale)) ** (1.0 / 3.0)
    _, singular, right = np.linalg.svd(fit.jacobian * (radius * problem.noise), full_matrices=False)
    sensitivity = float(singular[-1]) / np.sqrt(len(problem.readings))
    relative_noise = problem.noise / radius
    if sensitivity <= max(_FEIGNED * relative_noise, 1e-7):
        return None
    if relative_noise / float(singular[-1]) > _LARGEST_UNCERTAINTY:
        return None
    root: FloatArray = right.T / singular * (radius * problem.noise)
    for deviations in (-2.0, 2.0):
        # χ² must rise by four there, or the uncertainty is bent and no covariance describes it.
        step = deviations * root[:, -1]
        rise = fit.retract(step).cost - fit.cost
        if not 4.0 / _LARGEST_RISE_RATIO < rise < 4.0 * _LARGEST_RISE_RATIO:
            return None
    return root


def symmetric(entries: FloatArray) -> FloatArray:
    """Return the symmetric matrix with entries xx yy zz xy xz yz."""
    matrix = np.zeros((3, 3))
    matrix[_ROW, _COLUMN] = matrix[_COLUMN, _ROW] = entries
    return matrix
