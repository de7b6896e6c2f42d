"""Filter with a measured quaternion: Gauss and Newton's method on two measured vectors, one step for each sample.

See docs/theory/complementary-filters.md. Source: as :mod:`adcs.complementary.explicit`; it has R mapping reference to
body, which its J contradicts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.complementary.explicit import BEST_GAINS, ComplementaryTrack, Gains, compiled_track
from adcs.complementary.outage import NO_SUBSTITUTE, Substitution
from adcs.satellite.vector_record import VectorRecord
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

MU = 1e-6
"""Added to the diagonal of the normal equations."""


def homogeneous_rotation(q: ArrayLike, v: ArrayLike) -> FloatArray:
    """R(q)v, |q|² times the rotated vector: shapes (4,), (3,) -> (3,)."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    scalar, p = q[0], q[1:]
    return (scalar**2 - p @ p) * v + 2.0 * p * (p @ v) + 2.0 * scalar * np.cross(p, v)


def rotation_derivative(q: ArrayLike, v: ArrayLike) -> FloatArray:
    """Derivative of :func:`homogeneous_rotation` by q. Shapes (4,), (3,) -> (3, 4)."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    scalar, p = q[0], q[1:]
    by_scalar = 2.0 * scalar * v + 2.0 * np.cross(p, v)
    by_vector = (
        -2.0 * np.outer(v, p) + 2.0 * (p @ v) * np.eye(3) + 2.0 * np.outer(p, v) - 2.0 * scalar * cross_matrix(v)
    )
    return np.column_stack([by_scalar, by_vector])


def gauss_newton_step(q: FloatArray, vectors: list[tuple[FloatArray, FloatArray]], mu: float = MU) -> FloatArray:
    """One step q - (AᵀA + μE)⁻¹Aᵀε, normalised.

    ``q`` (4,): unit quaternion, reference from body. ``vectors``: unit vectors (3,); those with NaN are left out. With
    one vector the turn around it stays as it is. Returns shape (4,).
    """
    present = [(body, reference) for body, reference in vectors if np.isfinite(body).all()]
    if not present:
        return q
    A = -np.concatenate([rotation_derivative(q, body) for body, _ in present])
    residual = np.concatenate([reference - homogeneous_rotation(q, body) for body, reference in present])
    step = np.linalg.solve(A.T @ A + mu * np.eye(4), A.T @ residual)
    return quaternion.normalised(q - step)


class MeasuredQuaternion:
    """Error angle to the measured quaternion, e = 2 vec(q̂*∘q_measured); a correction of :func:`complementary.steps`.

    ``q`` (4,): the last measured quaternion. The next one starts from it where both vectors are there, from the
    estimate else.
    """

    def __init__(self, mu: float = MU) -> None:
        self._mu = mu
        self.q: FloatArray | None = None

    def __call__(self, q: FloatArray, vectors: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
        """Error angle (3,) of an estimate."""
        both = all(np.isfinite(body).all() for body, _ in vectors)
        start = q if self.q is None or not both else self.q
        self.q = gauss_newton_step(start, vectors, self._mu)
        return 2.0 * quaternion.error_vector(q, self.q)


def gauss_newton_track(
    record: VectorRecord,
    gains: Gains = BEST_GAINS,
    *,
    q_start: ArrayLike = quaternion.IDENTITY,
    substitution: Substitution = NO_SUBSTITUTE,
    mu: float = MU,
) -> ComplementaryTrack:
    """The filter with the measured quaternion over whole records, compiled; weights of the gains are not used.

    ``q_start`` (4,): first estimate, and where the first measured quaternion starts. ``substitution``: in place of
    a second vector that is missing. ``mu``: added to the normal equations. Raises ValueError: the gains are beyond
    the stability limit.
    """
    return compiled_track(record, gains, q_start, substitution, mu)
