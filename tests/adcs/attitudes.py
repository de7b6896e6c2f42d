"""Attitudes for the tests, and the control of wheels as NumPy has it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adcs import quaternion
from adcs.satellite.dynamics import RigidBody, WheelControl, relative_rate
from arrays.typing import FloatArray


def random_attitudes(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Quaternions (n, 4), uniform over all rotations."""
    q = rng.standard_normal((n, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def commanded_torque(
    body: RigidBody,
    control: WheelControl,
    q: ArrayLike,
    w: ArrayLike,
    momentum_Nms: ArrayLike,
    q_reference: ArrayLike,
    orbital_rate_rad_s: ArrayLike,
    dt_s: float,
) -> FloatArray:
    r"""Wheel torque :math:`\dot k = K_\lambda\lambda + K_\omega\omega_{rel} - \omega\times(J\omega + k)`, limited.

    λ is the vector part of :math:`q_r^*\circ q`, with the sign of the shorter way, for a reference that rests in the
    orbital frame. The torque is limited, and then the momentum after the step.

    ``q``, ``w`` (..., 4), (..., 3): attitude and rate as the controller knows them: the estimate.
    ``momentum_Nms`` (..., 3): k. ``q_reference`` (..., 4): wanted attitude, orbital from body.
    ``orbital_rate_rad_s`` (...). ``dt_s``: how long the torque will be held. Returns (..., 3): [N·m].
    """
    k = np.asarray(momentum_Nms, dtype=np.float64)
    w = np.asarray(w, dtype=np.float64)
    wanted = (
        control.attitude_gain_Nm * quaternion.error_vector(q_reference, q)
        + control.rate_gain_Nms * relative_rate(q, w, orbital_rate_rad_s)
        - np.cross(w, w @ body.inertia_kgm2 + k)
    )
    limited = np.clip(wanted, -control.torque_limit_Nm, control.torque_limit_Nm)
    limit = control.momentum_limit_Nms
    return (np.clip(k + limited * dt_s, -limit, limit) - k) / dt_s
