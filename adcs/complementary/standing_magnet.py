"""Location of a fixed magnet near the path of a magnetometer from its field.

Positions of the sensor must be known, for example from cameras; gyro and accelerometer do not give them. The attitude
must not depend on the disturbed field: use :func:`adcs.inertial_magnetic_filter` with a magnet "rejected".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.complementary.inertial_magnetic import PreparedReadings
from arrays.typing import FloatArray
from magloc.fields.dipole import field, field_matrix

_EVERY = 3  # readings closer than a centisecond are redundant
_SIGMA_T = 2e-6
_SAME_S = 0.3  # correlation time of the variation of the room's field
_FIRST_DISTANCE_M = 0.1
_LARGEST_DISTANCE_M = 0.5
_LARGEST_ROOM_M = 20.0
_LEVER_SIGMA_M, _LARGEST_LEVER_M = 0.02, 0.06
_LEAST_EXPLAINED = 0.5
_GRADIENTS = np.array(
    [
        [[1, 0, 0], [0, 0, 0], [0, 0, -1]],
        [[0, 0, 0], [0, 1, 0], [0, 0, -1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ],
    dtype=np.float64,
)  # symmetric and traceless, as the gradient outside of all sources


@dataclass(frozen=True, eq=False)
class StandingMagnet:
    """Fixed magnet as a dipole.

    ``position_m``, ``moment_Am2`` (3,): east, north, up. ``sigma_m`` (3,): standard deviation of the position.
    ``lever_arm_m`` (3,): vector from the point with known positions to the magnetometer, body axes. ``explained``:
    explained share of the squared disturbance where the magnet's own field exceeds two microtesla.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    sigma_m: FloatArray
    lever_arm_m: FloatArray
    explained: float


def locate_standing_magnet(prepared: PreparedReadings, q: FloatArray, position_m: FloatArray) -> StandingMagnet:
    """Locate the dipole that best explains the field, besides a constant and a gradient of the room.

    Moment and room are linear. Position and lever arm are searched from six starts around the largest difference of the
    field, with a robust loss for differences larger than two microtesla.

    ``q`` (n, 4): east, north, up from body. ``position_m`` (n, 3): NaN where unknown. Raises ValueError if there are
    fewer than 100 known positions, or if no dipole within 0.5 m of the largest difference explains half of the
    disturbance near it.
    """
    from scipy.optimize import least_squares

    reference = quaternion.rotate(q, prepared.field_T)
    seen = np.isfinite(position_m).all(axis=1) & np.isfinite(reference).all(axis=1)
    known = np.flatnonzero(seen)[::_EVERY]
    if len(known) < 100:
        raise ValueError(f"Input position_m must have 100 known positions; instead received {len(known)}.")
    points, q_known = position_m[known], q[known]
    values = reference[known] - np.nanmean(reference[prepared.in_first_second], axis=0)
    nearest = points[np.argmax(np.linalg.norm(values, axis=1))]
    centred = points - points.mean(axis=0)
    constant = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    room = np.concatenate([constant, np.einsum("gij,nj->nig", _GRADIENTS, centred)], axis=2).reshape(-1, 8)
    Q = np.linalg.qr(room)[0]

    def remove_room(columns: FloatArray) -> FloatArray:
        return columns - Q @ (Q.T @ columns)

    disturbance = remove_room(values.ravel())

    def fit(unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the moment, its field and the residual of the disturbance."""
        A = field_matrix(points + quaternion.rotate(q_known, unknowns[3:]), unknowns[:3]).reshape(-1, 3)
        within = remove_room(A)
        found = np.asarray(np.linalg.lstsq(within, disturbance)[0], dtype=np.float64)
        return found, A @ found, within @ found - disturbance

    def residuals(unknowns: FloatArray) -> FloatArray:
        return np.concatenate([fit(unknowns)[2] / _SIGMA_T, unknowns[3:] / _LEVER_SIGMA_M])

    largest = np.concatenate([np.abs(nearest) + _LARGEST_ROOM_M, np.full(3, _LARGEST_LEVER_M)])
    starts = nearest + _FIRST_DISTANCE_M * np.concatenate([np.eye(3), -np.eye(3)])
    fits = [
        least_squares(residuals, np.append(start, np.zeros(3)), bounds=(-largest, largest), loss="soft_l1", max_nfev=40)
        for start in starts
    ]
    best = min(fits, key=lambda found: float(found.cost))
    moment, of_magnet, left = fit(best.x)
    matters = np.linalg.norm(of_magnet.reshape(-1, 3), axis=1) > _SIGMA_T
    squares = [float(np.sum(part.reshape(-1, 3)[matters] ** 2)) for part in (left, disturbance)]
    explained = 1.0 - squares[0] / squares[1] if matters.any() else 0.0
    if explained < _LEAST_EXPLAINED or np.linalg.norm(best.x[:3] - nearest) > _LARGEST_DISTANCE_M:
        raise ValueError(
            "Input prepared must have the field of a magnet; instead the best one explains "
            f"{explained:.0%} of the disturbance near it."
        )
    steps = float(np.median(np.diff(prepared.time_s[known])))
    independent = max(_SAME_S / steps, 1.0)
    slopes: FloatArray = np.asarray(best.jac, dtype=np.float64)[:-3]
    information = slopes.T @ slopes / independent
    information[3:, 3:] += np.eye(3) / _LEVER_SIGMA_M**2
    sigma = np.sqrt(np.diagonal(np.linalg.inv(information)))
    return StandingMagnet(best.x[:3], moment, sigma[:3], best.x[3:], explained)


def standing_field(magnet: StandingMagnet, q: FloatArray, position_m: FloatArray) -> FloatArray:
    """Return the field of the magnet in body axes [T], zero where the position is unknown.

    Shapes (n, 4), (n, 3) -> (n, 3).
    """
    known = np.isfinite(position_m).all(axis=1)
    found = np.zeros_like(position_m)
    points = position_m[known] + quaternion.rotate(q[known], magnet.lever_arm_m)
    found[known] = quaternion.rotate_back(q[known], field(points, magnet.position_m, magnet.moment_Am2))
    return found
