"""Validity of the dipole model: by the body's length, or by the residuals of a fix.

The residual patterns of quadrupole and octupole are derived in docs/theory/extended-sources.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, fdtrc

from arrays.array import SensorArray
from arrays.io.errors import _vector
from arrays.typing import BoolArray, FloatArray
from magloc.chi_square import exceeds
from magloc.fields.multipole import multipole_field_matrix
from magloc.levels import EXTENDED_BODY, NO_OTHER_MISFIT, SECOND_LOOK
from magloc.localization.fit.fixes import Fixes
from magloc.measurement.differences import channel_jacobian, fields_at_sensors, predicted_channels
from magloc.measurement.rows import whitenings_of

BODY_LENGTHS = 3.0
_ORDERS = (2, 3)
# Smallest relative part of a column outside the earlier ones that the array sees.
_UNSEEN_RTOL = 1e-6


@dataclass(frozen=True)
class MultipoleGain:
    """Decrease of χ² by one more order of the multipole expansion.

    Attributes
    ----------
    order : int
        2 for the quadrupole, 3 for the octupole.
    gain : float
        Decrease of χ².
    n_parameters : int
        Number of further parameters that the array sees.
    noise_probability : float
        Probability that noise of the stated size gives the same decrease (χ² test).
    misfit_probability : float
        Probability that a misfit without any pattern gives the same decrease (F test against the remaining χ²). 1 if no
        degree of freedom remains.
    """

    order: int
    gain: float
    n_parameters: int
    noise_probability: float
    misfit_probability: float


@dataclass(frozen=True)
class NearnessTest:
    """Result of the test for residuals with the pattern of an extended source.

    Attributes
    ----------
    misfit : bool
        True if χ² is larger than noise explains.
    extended : bool
        True if a quadrupole or an octupole explains significantly more than noise and more than another kind of misfit:
        the source is too near or too large for a dipole. With few sensors, or so near that the multipole expansion
        fails, only `misfit` is true.
    chi2 : float
        χ² of the dipole after one linearised step.
    dof : int
        Number of differences minus the unknowns of a dipole that the array sees.
    gains : tuple of MultipoleGain
        Gain of each order beyond the orders before it.
    """

    misfit: bool
    extended: bool
    chi2: float
    dof: int
    gains: tuple[MultipoleGain, ...]


def dipole_validity(distance_m: ArrayLike, body_length_m: ArrayLike) -> BoolArray:
    """Return True if a body is at least three lengths away, so that it counts as a dipole.

    The length is the longest side. At three lengths the field of a uniformly magnetised body differs from that
    of a dipole by at most 0.3 % for a cube, 1.3 % for a cylinder as long as it is wide, 5 % for a flat brick and 6 %
    for a thin rod. On the axis of the rod the ratio of the two fields is ``1/(1 - (L/2r)²)²``.

    ``distance_m``: distance from the body's centre to the sensors [m]. ``body_length_m``: greatest extent of the body
    [m]. Both broadcast; the result is False if either is NaN. Raises ValueError: a distance or a length is negative.
    """
    distance, length = np.asarray(distance_m, dtype=np.float64), np.asarray(body_length_m, dtype=np.float64)
    for name, values in (("distance_m", distance), ("body_length_m", length)):
        if np.any(values < 0.0):
            raise ValueError(f"Input {name} must not be negative; instead received {values.min()}.")
    return np.asarray(distance >= BODY_LENGTHS * length)


def nearness_test(
    array: SensorArray,
    position_m: ArrayLike,
    moment_Am2: ArrayLike,
    readings_T: ArrayLike,
    *,
    false_alarm: float = EXTENDED_BODY,
) -> NearnessTest:
    """Test the residuals of a fix for the pattern of an extended or too near source.

    A quadrupole and then an octupole at the solution are added to the linearised dipole. Either is significant if χ²
    decreases by more than noise explains, and by more per parameter than the remaining misfit (F test at 5 %). The
    octupole is omitted if it would leave no degree of freedom. A too large χ² is a separate finding. Each of the
    three tests has a third of the false-alarm rate.

    ``array``: array with the noise that decides what is significant. ``position_m``, ``moment_Am2`` (3,): solution of a
    fix in the array's frame [m], [A·m²]. ``readings_T`` (C,): readings of that fix [T]; NaN where missing.
    ``false_alarm``: largest probability of any finding for a dipole with noise of the stated size. Raises ValueError:
    the shapes do not agree, or the false-alarm rate is not between 0 and 1.
    """
    position, moment = _vector("position_m", position_m), _vector("moment_Am2", moment_Am2)
    readings = np.asarray(readings_T, dtype=np.float64)
    if readings.shape != (array.n_channels,):
        raise ValueError(f"Input readings_T must have shape ({array.n_channels},); instead received {readings.shape}.")
    if not 0.0 < false_alarm < 1.0:
        raise ValueError(f"Input false_alarm must be between 0 and 1; instead received {false_alarm}.")
    available = np.isfinite(readings)
    whitening = whitenings_of(array, available, readings)
    left_T = readings - array.channel_offset_T - predicted_channels(array, position, moment)
    residual = whitening.apply(np.where(available, left_T, 0.0))
    by_dipole = whitening.apply(channel_jacobian(array, position, moment).T).T
    known = _orthonormal(by_dipole, np.zeros((residual.size, 0)))
    residual = residual - known @ (known.T @ residual)
    chi2, dof = float(residual @ residual), whitening.n_differences - known.shape[1]
    rows = array.linear_gain(fields_at_sensors(array, position, moment))
    steps: list[tuple[int, float, int]] = []
    left = dof
    for order in _ORDERS:
        fields = multipole_field_matrix(array.positions, position, order)[array.channel_sensor]
        columns = np.einsum("ci,cij->cj", rows, fields)
        new = _orthonormal(whitening.apply(columns.T).T, known)
        if new.shape[1] == 0 or (steps and left - new.shape[1] <= 0):
            break
        steps.append((order, float(np.sum((new.T @ residual) ** 2)), new.shape[1]))
        known, left = np.concatenate([known, new], axis=1), left - new.shape[1]
    rest = max(chi2 - sum(gain for _, gain, _ in steps), 0.0)
    gains = tuple(_test_pattern(order, gain, n, rest, left) for order, gain, n in steps)
    level = false_alarm / 3.0
    misfit = dof > 0 and bool(chdtrc(dof, chi2) < level)
    extended = any(gain.noise_probability < level and gain.misfit_probability < NO_OTHER_MISFIT for gain in gains)
    return NearnessTest(misfit, extended, chi2, dof, gains)


def _test_pattern(order: int, gain: float, n_parameters: int, rest: float, left: int) -> MultipoleGain:
    comparable = left > 0 and rest > 0.0
    ratio = (gain / n_parameters) / (rest / left) if comparable else 0.0
    return MultipoleGain(
        order=order,
        gain=gain,
        n_parameters=n_parameters,
        noise_probability=float(chdtrc(n_parameters, gain)),
        misfit_probability=float(fdtrc(n_parameters, left, ratio)) if comparable else 1.0,
    )


def _orthonormal(columns: FloatArray, known: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the part of columns (k, n) outside a known basis."""
    length = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(length > 0.0, length, 1.0)
    new = unit - known @ (known.T @ unit)
    basis, size, _ = np.linalg.svd(new, full_matrices=False)
    return basis[:, size > _UNSEEN_RTOL]


def is_too_near(
    array: SensorArray,
    fixes: Fixes,
    readings_T: FloatArray,
    ambient_T: FloatArray | None = None,
    body_length_m: float | None = None,
) -> BoolArray:
    """Return which rows have a source too near for a dipole, by its length or its misfit.

    Fixes are in the array's frame.
    """
    near = np.zeros(len(fixes), dtype=bool)
    best, solutions = fixes.first[fixes.solved], fixes.solutions
    if solutions.position_m.shape[1] > 1:
        best = best[solutions.n_sources[best] == 1]
    alone, dof = solutions.of_row[best], solutions.dof[best]
    if body_length_m:
        place = solutions.position_m[best, 0]
        nearest = np.min([np.linalg.norm(place - sensor, axis=1) for sensor in array.positions], axis=0)
        near[alone] = ~dipole_validity(nearest, body_length_m)
    doubtful = ~near[alone] & exceeds(solutions.chi2[best], dof, SECOND_LOOK)
    used_T = fixes.used_readings(array, readings_T)
    for i in doubtful.nonzero()[0].tolist():
        row, place, moment = alone[i], solutions.position_m[best[i], 0], solutions.moment_Am2[best[i], 0]
        of_row = array if ambient_T is None else array.in_ambient_field(ambient_T[row])
        near[row] = nearness_test(of_row, place, moment, used_T[row]).extended
    return near
