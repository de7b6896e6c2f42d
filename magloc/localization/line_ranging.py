"""Distance of a source on a straight line, from one vector sensor.

The source keeps its moment and its attitude, and does not pass the sensor. The field of a dipole is the same on
opposite sides, so a line inverted through the sensor fits equally well. Distances are not affected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares, minimize_scalar

from arrays.io.errors import _vectors, check_positive
from arrays.typing import FloatArray
from magloc.directions import hemisphere
from magloc.fields import dipole
from magloc.fields.coil import loop_field

_N_UNKNOWNS = 8
_N_DIRECTIONS = 24
_GRID = 4000
# Start values of a coil's radius, relative to the distance of the start.
_RADII = (0.3, 0.8)


@dataclass(frozen=True, eq=False)
class SourceLine:
    """Source on a straight line near a vector sensor at the origin.

    Attributes
    ----------
    start_m : ndarray, shape (3,)
        Position of the source at distance zero, in the sensor's axes [m]. The common sign of start and direction is not
        determined.
    direction : ndarray, shape (3,)
        Unit vector in which the distance grows.
    moment_Am2 : ndarray, shape (3,)
        Moment [A·m²].
    radius_m : float
        Radius of the source if it is a current loop; 0 for a dipole.
    chi2 : float
        Sum of squared residuals divided by the noise.
    dof : int
        Number of readings minus number of unknowns.
    converged : bool
        True if the iteration ended at an optimum. Otherwise no number here is a result.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> start_m, along, moment_Am2 = np.array([0.2, 0.0, 0.1]), np.eye(3)[0], np.eye(3)[2]
    >>> line = magloc.SourceLine(start_m, along, moment_Am2, 0.0, 0.0, 0, True)
    >>> line.field([0.0, 0.1]).shape
    (2, 3)
    """

    start_m: FloatArray
    direction: FloatArray
    moment_Am2: FloatArray
    radius_m: float
    chi2: float
    dof: int
    converged: bool

    def field(self, distance_m: ArrayLike) -> FloatArray:
        """Return the field at the sensor, (..., 3) [T], for distances (...) [m]."""
        distance = np.asarray(distance_m, dtype=np.float64)
        source = self.start_m + distance[..., None] * self.direction
        return loop_field(np.zeros(3), source, self.moment_Am2, self.radius_m)


def fit_source_line(
    distance_m: ArrayLike, field_T: ArrayLike, noise_T: float, *, noise_fraction: float = 0.0, coil: bool = False
) -> SourceLine:
    """Find the line and the moment of a source from fields at known distances along the line.

    Parameters
    ----------
    distance_m : array_like, shape (n,)
        Distances along the line from its unknown start [m].
    field_T : array_like, shape (n, 3)
        Field of the source alone, in the sensor's axes [T].
    noise_T : float
        Standard deviation per axis [T].
    noise_fraction : float
        Noise proportional to the field, as for an array: variance = noise² + (fraction · |B|)².
    coil : bool
        Fit a single loop with its radius instead of a dipole.

    Returns
    -------
    SourceLine
        Best of the fits from many directions of the line. With it :func:`distance_along_line` gives a distance for
        every single reading.

    Raises
    ------
    ValueError
        The shapes do not agree, a number is not finite, the noise is not positive, or there are fewer readings than
        unknowns.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> start_m, along, moment_Am2 = np.array([0.2, 0.0, 0.1]), np.eye(3)[0], np.eye(3)[2]
    >>> truth = magloc.SourceLine(start_m, along, moment_Am2, 0.0, 0.0, 0, True)
    >>> distance_m = np.arange(0.0, 0.5, 0.05)
    >>> line = magloc.fit_source_line(distance_m, truth.field(distance_m), 1e-9)
    >>> round(float(np.linalg.norm(line.moment_Am2)), 3), line.converged
    (1.0, True)
    """
    distance, field, sigma = _check_readings(distance_m, field_T, noise_T, noise_fraction)
    starts = _starts(distance, field)
    if coil:
        starts = [np.append(start, share * np.linalg.norm(start[:3])) for start in starts for share in _RADII]
    return _best_line(distance, field, sigma, starts)


def distance_along_line(
    line: SourceLine,
    field_T: ArrayLike,
    noise_T: float,
    *,
    noise_fraction: float = 0.0,
    within_m: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """Return the distance of the source along its line for every reading.

    Parameters
    ----------
    line : SourceLine
        Result of :func:`fit_source_line`.
    field_T : array_like, shape (..., 3)
        Field of the source alone, in the sensor's axes [T].
    noise_T : float
        Standard deviation per axis [T].
    noise_fraction : float
        Noise proportional to the field, as for :func:`fit_source_line`.
    within_m : tuple of 2 floats
        Bounds of the distance [m].

    Returns
    -------
    distance_m : ndarray, shape (...)
        Distance [m] at which the field of the line is nearest to the reading; it may be one of the bounds.
    standard_deviation_m : ndarray, shape (...)
        Standard deviation [m] by the noise alone, for an exactly known line.

    Raises
    ------
    ValueError
        The shapes do not agree, or the bounds are invalid.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> start_m, along, moment_Am2 = np.array([0.2, 0.0, 0.1]), np.eye(3)[0], np.eye(3)[2]
    >>> line = magloc.SourceLine(start_m, along, moment_Am2, 0.0, 0.0, 0, True)
    >>> field_T = line.field([0.1, 0.3])
    >>> found = magloc.distance_along_line(line, field_T, 1e-9, within_m=(0.0, 1.0))
    >>> distance_m, sigma_m = found
    >>> distance_m.round(3)
    array([0.1, 0.3])
    """
    field = _vectors("field_T", field_T)
    low, high = within_m
    if not -np.inf < low < high < np.inf:
        raise ValueError(f"Input within_m must be two finite bounds, the lower first; instead received {within_m}.")
    grid = np.linspace(low, high, _GRID)
    on_grid = line.field(grid)
    found = np.empty(field.shape[:-1])
    for index in np.ndindex(found.shape):
        reading = field[index]
        nearest = int(np.argmin(np.sum((on_grid - reading) ** 2, axis=1)))
        around = grid[max(nearest - 1, 0)], grid[min(nearest + 1, _GRID - 1)]
        found[index] = minimize_scalar(
            lambda s, reading=reading: float(np.sum((line.field(s) - reading) ** 2)) / float(reading @ reading),
            bounds=around,
            method="bounded",
            options={"xatol": 1e-9 * (high - low)},
        ).x
    step = 1e-5 * (high - low)
    slope = np.linalg.norm(line.field(found + step) - line.field(found - step), axis=-1) / (2.0 * step)
    sigma = np.hypot(noise_T, noise_fraction * np.linalg.norm(field, axis=-1))
    return found, sigma / slope


def _check_readings(
    distance_m: ArrayLike, field_T: ArrayLike, noise_T: float, noise_fraction: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    distance, field = np.asarray(distance_m, dtype=np.float64), np.asarray(field_T, dtype=np.float64)
    if distance.ndim != 1 or field.shape != (distance.size, 3):
        raise ValueError(
            "Inputs distance_m and field_T must have shapes (n,) and (n, 3); "
            f"instead received {distance.shape} and {field.shape}."
        )
    if not (np.isfinite(distance).all() and np.isfinite(field).all() and field.any(axis=1).all()):
        raise ValueError("Inputs distance_m and field_T must be finite, and no field zero; instead received others.")
    check_positive(noise_T=noise_T)
    if field.size < _N_UNKNOWNS:
        raise ValueError(
            f"Input field_T must have more numbers than the {_N_UNKNOWNS} unknowns; instead received {field.size}."
        )
    return distance, field, np.hypot(noise_T, noise_fraction * np.linalg.norm(field, axis=1))


def _starts(distance: FloatArray, field: FloatArray) -> list[FloatArray]:
    """Return start lines near the sensor in directions of a hemisphere, at a range from the field's decay.

    Along a line through the sensor |B|^(-1/3) is linear in the distance, and zero at the sensor.
    """
    size = np.linalg.norm(field, axis=1)
    slope, intercept = np.polyfit(distance, size ** (-1.0 / 3.0), 1)
    at_zero = intercept / slope if slope != 0.0 else np.ptp(distance)
    lines = []
    for direction in hemisphere(_N_DIRECTIONS):
        source = (at_zero + distance[:, None]) * direction
        matrix = dipole.field_matrix(np.zeros(3), source) / size[:, None, None]
        relative = field / size[:, None]
        moment = np.linalg.lstsq(matrix.reshape(-1, 3), relative.ravel(), rcond=None)[0]
        elevation, azimuth = np.arcsin(direction[2]), np.arctan2(direction[1], direction[0])
        lines.append(np.concatenate([at_zero * direction, [elevation, azimuth], moment]))
    return lines


def _best_line(distance: FloatArray, field: FloatArray, sigma: FloatArray, starts: list[FloatArray]) -> SourceLine:
    """Return the best fit of (start, angles of the direction, moment[, radius])."""

    def residuals(x: FloatArray) -> FloatArray:
        return ((_line(x, np.nan, 0, False).field(distance) - field) / sigma[:, None]).ravel()

    fits = []
    for start in starts:
        length, size = float(np.linalg.norm(start[:3])), float(np.linalg.norm(start[5:8]))
        x_scale = np.concatenate(
            [np.full(3, length), np.full(2, 1.0), np.full(3, size), np.full(len(start) - 8, length)]
        )
        fits.append(least_squares(residuals, start, x_scale=x_scale, max_nfev=200))
    best = min(fits, key=lambda fit: float(fit.cost))
    return _line(best.x, 2.0 * float(best.cost), field.size - len(best.x), bool(best.status > 0))


def _line(x: FloatArray, chi2: float, dof: int, converged: bool) -> SourceLine:
    elevation, azimuth = x[3:5]
    across = np.cos(elevation)
    direction = np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])
    # The field of a loop is even in its radius.
    radius = float(abs(x[8])) if len(x) > 8 else 0.0
    return SourceLine(x[:3], direction, x[5:8], radius, chi2, dof, converged)
