"""A magnet that stands near the path of a magnetometer: located by what it does to the field, then subtracted.

Positions of the sensor must be known, as from cameras; they do not come from gyro and accelerometer. The attitude is
one that did without the disturbed field, such as :func:`adcs.complementary.inertial_magnetic.inertial_magnetic_track`
with :func:`adcs.complementary.inertial_magnetic.undisturbed`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.complementary.inertial_magnetic import Prepared
from arrays.typing import FloatArray
from magloc.fields.dipole import field, field_matrix

_EVERY = 3  # readings closer than a centisecond say the same
_SIGMA_T = 1e-6
_FIRST_DISTANCE_M = 0.1
_LARGEST_DISTANCE_M = 0.5


@dataclass(frozen=True, eq=False)
class StandingMagnet:
    """A dipole.

    ``position_m``, ``moment_Am2`` (3,): east, north, up.
    """

    position_m: FloatArray
    moment_Am2: FloatArray


def locate_standing_magnet(prepared: Prepared, q: FloatArray, position_m: FloatArray) -> StandingMagnet:
    """Dipole that explains best how the field differs from that of the first second.

    Its moment follows linearly from its position, which is searched from six sides of where the difference is largest.
    Differences larger than a microtesla count less than by their squares.

    ``q`` (n, 4): east, north, up from body. ``position_m`` (n, 3): of the magnetometer, NaN where unknown. Raises
    ValueError: there are fewer than 100 known positions, or no dipole within 0.5 m of the largest difference.
    """
    from scipy.optimize import least_squares

    reference = quaternion.rotate(q, prepared.field_T)
    difference = reference - reference[prepared.starting].mean(axis=0)
    known = np.flatnonzero(np.isfinite(position_m).all(axis=1))[::_EVERY]
    if len(known) < 100:
        raise ValueError(f"Input position_m must have 100 known positions; instead received {len(known)}.")
    points, values = position_m[known], difference[known]
    nearest = points[np.argmax(np.linalg.norm(values, axis=1))]

    def moment(place: FloatArray) -> tuple[FloatArray, FloatArray]:
        A = field_matrix(points, place).reshape(-1, 3)
        found: FloatArray = np.linalg.lstsq(A, values.ravel())[0]
        return found, (A @ found - values.ravel()) / _SIGMA_T

    def residuals(place: FloatArray) -> FloatArray:
        return moment(place)[1]

    starts = nearest + _FIRST_DISTANCE_M * np.concatenate([np.eye(3), -np.eye(3)])
    fits = [least_squares(residuals, start, loss="soft_l1", max_nfev=40) for start in starts]
    near = [fit for fit in fits if np.linalg.norm(fit.x - nearest) <= _LARGEST_DISTANCE_M]
    if not near:
        raise ValueError("Input prepared must have the field of a magnet; instead found none within 0.5 m of the path.")
    best = min(near, key=lambda fit: float(fit.cost))
    return StandingMagnet(best.x, moment(best.x)[0])


def standing_field(magnet: StandingMagnet, q: FloatArray, position_m: FloatArray) -> FloatArray:
    """Field of the magnet in body axes [T], zero where the position is unknown. Shapes (n, 4), (n, 3) -> (n, 3)."""
    known = np.isfinite(position_m).all(axis=1)
    found = np.zeros_like(position_m)
    there = field(position_m[known], magnet.position_m, magnet.moment_Am2)
    found[known] = quaternion.rotate_back(q[known], there)
    return found
