"""Rotation of a rigid satellite with reaction wheels, its wheel control, and the Jacobians of its error.

See docs/theory/satellite-dynamics-and-sensors.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute
preprint 64, 2014. Ours: the orbital rate in the kinematics, which is missing there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.frames import turned
from adcs.quaternion import rotate_back
from arrays.io.errors import check_positive
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

_E2 = np.array([0.0, 1.0, 0.0])
_E3 = np.array([0.0, 0.0, 1.0])
ZERO = np.zeros(3)


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Rigid satellite with a residual dipole.

    Attributes
    ----------
    inertia_kgm2 : ndarray, shape (3, 3)
        J, wheels included, body axes.
    residual_dipole_Am2 : ndarray, shape (3,)
        Magnetic moment that stays with the satellite, body axes.
    inverse : ndarray, shape (3, 3)
        J⁻¹.

    Raises
    ------
    ValueError
        The inertia is not symmetric and positive definite, or one principal moment is larger than the sum of the other
        two, which no body has.
    """

    inertia_kgm2: FloatArray
    residual_dipole_Am2: FloatArray = field(default_factory=lambda: np.zeros(3))
    inverse: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        J = np.array(self.inertia_kgm2, dtype=np.float64)
        dipole = np.array(self.residual_dipole_Am2, dtype=np.float64)
        if J.shape != (3, 3) or not np.isfinite(J).all():
            raise ValueError(
                "Input inertia_kgm2 must be 3×3 finite numbers, numpy.diag(moments) for principal axes; "
                f"instead received shape {J.shape}."
            )
        if not np.allclose(J, J.T, rtol=0.0, atol=1e-9 * np.abs(J).max()):
            raise ValueError("Input inertia_kgm2 must be symmetric; instead received a matrix that is not.")
        J = 0.5 * (J + J.T)
        moments = np.linalg.eigvalsh(J)
        listed = ", ".join(f"{moment:.6g}" for moment in moments)
        if moments[0] <= 1e-12 * moments[2]:
            raise ValueError(
                f"Input inertia_kgm2 must be positive definite; instead received principal moments {listed}."
            )
        if moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-9):
            raise ValueError(
                "Input inertia_kgm2 must satisfy the triangle inequality, no principal moment larger than the other "
                f"two together; instead received principal moments {listed}."
            )
        if dipole.shape != (3,) or not np.isfinite(dipole).all():
            raise ValueError(f"Input residual_dipole_Am2 must be 3 finite numbers; instead received {dipole.tolist()}.")
        object.__setattr__(self, "inertia_kgm2", J)
        object.__setattr__(self, "residual_dipole_Am2", dipole)
        object.__setattr__(self, "inverse", np.linalg.inv(J))


@dataclass(frozen=True, eq=False)
class WheelControl:
    """Proportional-derivative control by wheels on the three axes.

    Attributes
    ----------
    attitude_gain_Nm : ndarray, shape (3,)
        K_λ, torque per vector part of the quaternion.
    rate_gain_Nms : ndarray, shape (3,)
        K_ω.
    torque_limit_Nm, momentum_limit_Nms : float
        Limits of each wheel.

    Raises
    ------
    ValueError
        A gain is negative, or a limit is not positive.
    """

    attitude_gain_Nm: FloatArray
    rate_gain_Nms: FloatArray
    torque_limit_Nm: float = 5e-3
    momentum_limit_Nms: float = 0.17

    def __post_init__(self) -> None:
        for name in ("attitude_gain_Nm", "rate_gain_Nms"):
            gain = np.array(getattr(self, name), dtype=np.float64)
            if gain.shape != (3,) or not np.isfinite(gain).all() or (gain < 0.0).any():
                raise ValueError(f"Input {name} must be 3 finite numbers from 0 up; instead received {gain.tolist()}.")
            object.__setattr__(self, name, gain)
        check_positive(torque_limit_Nm=self.torque_limit_Nm, momentum_limit_Nms=self.momentum_limit_Nms)


def wheel_control(body: RigidBody, natural_rad_s: float = 0.03, damping: float = 0.8) -> WheelControl:
    """Return the gains K_λ = 2 ω² J_ii and K_ω = 2 ζ ω J_ii for small angles.

    ``natural_rad_s``: natural frequency ω. ``damping``: damping ratio ζ.
    """
    moments = np.diagonal(body.inertia_kgm2)
    return WheelControl(2.0 * natural_rad_s**2 * moments, 2.0 * damping * natural_rad_s * moments)


def relative_rate(q: ArrayLike, w: ArrayLike, orbital_rate_rad_s: ArrayLike) -> FloatArray:
    """Return the rate ω - Aω_o of the body against the orbital frame, body axes [rad/s].

    ``q`` (..., 4): attitude, orbital from body. ``w`` (..., 3): rate against inertial space, body axes [rad/s].
    ``orbital_rate_rad_s`` (...): n. Returns shape (..., 3).
    """
    return np.asarray(w, dtype=np.float64) - rotate_back(q, np.asarray(orbital_rate_rad_s)[..., None] * _E2)


def absolute_rate(q: ArrayLike, w_relative: ArrayLike, orbital_rate_rad_s: ArrayLike) -> FloatArray:
    """Return the rate ω of the body against inertial space; inverse of :func:`relative_rate`."""
    return np.asarray(w_relative, dtype=np.float64) + rotate_back(q, np.asarray(orbital_rate_rad_s)[..., None] * _E2)


def environment_torque(
    body: RigidBody, q: ArrayLike, gravity_s2: ArrayLike, b_orbital_T: ArrayLike, dipole_Am2: ArrayLike = ZERO
) -> FloatArray:
    """Return the torques of gravity gradient, 3(μ/r³) η×Jη, and magnetic dipole, m×B, body axes [N·m].

    ``q`` (..., 4): attitude, orbital from body. ``gravity_s2`` (...): μ/r³. ``b_orbital_T`` (..., 3): field in the
    orbital frame. ``dipole_Am2`` (..., 3): dipole in addition to the residual one of the body. Returns (..., 3).
    """
    eta = rotate_back(q, _E3)
    gradient = 3.0 * np.asarray(gravity_s2)[..., None] * np.cross(eta, eta @ body.inertia_kgm2)
    return gradient + np.cross(body.residual_dipole_Am2 + np.asarray(dipole_Am2), rotate_back(q, b_orbital_T))


def angular_acceleration(
    body: RigidBody, w: ArrayLike, momentum_Nms: ArrayLike, wheel_torque_Nm: ArrayLike, torque_Nm: ArrayLike
) -> FloatArray:
    r"""Return :math:`\dot\omega = J^{-1}(M - \dot k - \omega\times(J\omega + k))`, body axes [rad/s²].

    ``w`` (..., 3): ω [rad/s]. ``momentum_Nms``, ``wheel_torque_Nm`` (..., 3): k and its rate of change. ``torque_Nm``
    (..., 3): M, all external torques. Returns (..., 3).
    """
    w = np.asarray(w, dtype=np.float64)
    gyroscopic = np.cross(w, w @ body.inertia_kgm2 + np.asarray(momentum_Nms, dtype=np.float64))
    net = np.asarray(torque_Nm, dtype=np.float64) - np.asarray(wheel_torque_Nm, dtype=np.float64) - gyroscopic
    return net @ body.inverse


def step(
    body: RigidBody,
    q: ArrayLike,
    w: ArrayLike,
    momentum_Nms: ArrayLike,
    wheel_torque_Nm: ArrayLike,
    torque_Nm: ArrayLike,
    orbital_rate_rad_s: ArrayLike,
    gravity_s2: ArrayLike,
    b_orbital_T: ArrayLike,
    dt_s: float,
    dipole_Am2: ArrayLike = ZERO,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the state after one step of the classical Runge-Kutta method of order four.

    Torque, wheel torque and environment are constant over the step, the momentum of the wheels is linear in time. The
    attitude is normalised after the step.
    ``q`` (..., 4), ``w``, ``momentum_Nms`` (..., 3): attitude (orbital from body), rate against inertial space [rad/s],
    momentum of the wheels, body axes. ``wheel_torque_Nm``, ``torque_Nm`` (..., 3): rate of change of that momentum, and
    torque of the disturbances, body axes. ``orbital_rate_rad_s``, ``gravity_s2`` (...). ``b_orbital_T`` (..., 3): field
    that acts on dipoles. ``dipole_Am2`` (..., 3): dipole in addition to the residual one.
    """
    q, w, k = (np.asarray(one, dtype=np.float64) for one in (q, w, momentum_Nms))
    k_dot, disturbance = (np.asarray(one, dtype=np.float64) for one in (wheel_torque_Nm, torque_Nm))

    def slope(q_at: FloatArray, w_at: FloatArray, after_s: float) -> tuple[FloatArray, FloatArray]:
        outside = disturbance + environment_torque(body, q_at, gravity_s2, b_orbital_T, dipole_Am2)
        return (
            quaternion.derivative(q_at, relative_rate(q_at, w_at, orbital_rate_rad_s)),
            angular_acceleration(body, w_at, k + k_dot * after_s, k_dot, outside),
        )

    half = 0.5 * dt_s
    q1, w1 = slope(q, w, 0.0)
    q2, w2 = slope(q + half * q1, w + half * w1, half)
    q3, w3 = slope(q + half * q2, w + half * w2, half)
    q4, w4 = slope(q + dt_s * q3, w + dt_s * w3, dt_s)
    return (
        quaternion.normalised(q + dt_s / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4)),
        w + dt_s / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4),
        k + k_dot * dt_s,
    )


def error_jacobian(
    body: RigidBody,
    q: ArrayLike,
    w: ArrayLike,
    momentum_Nms: ArrayLike,
    gravity_s2: ArrayLike,
    b_orbital_T: ArrayLike,
    dipole_Am2: ArrayLike = ZERO,
) -> FloatArray:
    r"""Return F of the error for a known wheel torque: d/dt (δq, δω) = F (δq, δω), shape (..., 6, 6).

    .. math::

        F_{11} = -W(\omega), \quad F_{12} = \tfrac12 E, \quad
        F_{21} = J^{-1}\left(6\frac{\mu}{r^3}(W(\eta)JW(\eta) - W(J\eta)W(\eta)) + 2W(m)W(AB)\right), \quad
        F_{22} = J^{-1}(W(J\omega + k) - W(\omega)J)

    :func:`adcs.quaternion.error_vector` defines δq. The rate ω in F11 is that against inertial space, although q is
    against the orbital frame.

    ``q`` (..., 4). ``w``, ``momentum_Nms`` (..., 3). ``gravity_s2`` (...). ``b_orbital_T`` (..., 3). ``dipole_Am2``
    (..., 3): dipole in addition to the residual one of the body.
    """
    w = np.asarray(w, dtype=np.float64)
    J, eta, b_body = body.inertia_kgm2, rotate_back(q, _E3), rotate_back(q, b_orbital_T)
    W = cross_matrix(eta)
    gradient = 6.0 * np.asarray(gravity_s2)[..., None, None] * (W @ J @ W - cross_matrix(turned(J, eta)) @ W)
    dipole: FloatArray = 2.0 * cross_matrix(body.residual_dipole_Am2 + np.asarray(dipole_Am2)) @ cross_matrix(b_body)
    total = w @ J + np.asarray(momentum_Nms, dtype=np.float64)
    F = np.zeros((*np.broadcast_shapes(w.shape[:-1], gradient.shape[:-2], dipole.shape[:-2]), 6, 6))
    F[..., :3, :3] = -cross_matrix(w)
    F[..., :3, 3:] = 0.5 * np.eye(3)
    F[..., 3:, :3] = body.inverse @ (gradient + dipole)
    F[..., 3:, 3:] = body.inverse @ (cross_matrix(total) - cross_matrix(w) @ J)
    return F
