r"""Magnetic control: B-dot detumbling by torquers, and passive hysteresis rods.

When the body rotates, the field in body axes changes, dB/dt ≈ B×ω. A moment against that change, m = -k Ḃ/B², causes
the torque m×B ≈ -k ω⊥, which brakes the rotation across the field. The field changes its direction along the orbit, so
all components of the rate decay. With k = 4 n I they decay within a quarter of a radian of the orbit; torquers saturate
at much smaller gains. Rods of soft iron are magnetised with a delay. Each rotation in the field costs the energy of one
hysteresis loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import check_positive
from arrays.typing import FloatArray
from magloc.fields.dipole import MU0_OVER_4PI

MU0 = 4.0 * np.pi * MU0_OVER_4PI
_MEAN_OF_A_CUBE = 1.2
"""Largest moment of three limited torquers across a field, averaged over directions, over one torquer's limit."""


@dataclass(frozen=True)
class BDot:
    """Control law B-dot and its torquers.

    Attributes
    ----------
    gain_Nms : float
        Gain k: torque over rate while no torquer is at its limit; see :func:`b_dot_gain`.
    largest_Am2 : float
        Largest moment of each of three torquers along the body axes.
    duty : float
        Share of each cycle in which the torquers are on. The magnetometer is read while they are off.

    Raises
    ------
    ValueError
        A number is not positive, or the duty above 1.

    Examples
    --------
    >>> import adcs
    >>> law = adcs.BDot(gain_Nms=2e-4)
    >>> law.moment_Am2([30e-6, 0.0, 0.0], [30e-6, 1e-6, 0.0], step_s=1.0).round(3)
    array([-0. , -0.2, -0. ])
    """

    gain_Nms: float
    largest_Am2: float = 0.2
    duty: float = 0.8

    def __post_init__(self) -> None:
        check_positive(gain_Nms=self.gain_Nms, largest_Am2=self.largest_Am2, duty=self.duty)
        if self.duty > 1.0:
            raise ValueError(f"Input duty must be at most 1; instead received {self.duty}.")

    def moment_Am2(self, before_T: ArrayLike, now_T: ArrayLike, step_s: float) -> FloatArray:
        """Return the moment that the torquers command until the next reading, from the last two readings.

        Parameters
        ----------
        before_T, now_T : array_like, shape (..., 3)
            Last two readings of the magnetometer, body axes [T].
        step_s : float
            Time between them [s].

        Returns
        -------
        ndarray, shape (..., 3)
            Moment while the torquers are on, body axes [A·m²]; zero without both readings.
        """
        now = np.asarray(now_T, dtype=np.float64)
        return self._limit(now, (now - np.asarray(before_T, dtype=np.float64)) / step_s)

    def moment_by_rate_Am2(self, field_T: ArrayLike, rate_rad_s: ArrayLike) -> FloatArray:
        """Return the moment from an estimated rate, dB/dt = B×ω.

        It has neither the noise of two readings nor the rotation of the field along the orbit.

        Parameters
        ----------
        field_T : array_like, shape (..., 3)
            Field in body axes [T]: the last reading, or the field model at the estimated attitude.
        rate_rad_s : array_like, shape (..., 3)
            Rate to brake, body axes [rad/s]: against inertial space, or against the orbital frame.

        Returns
        -------
        ndarray, shape (..., 3)
            Moment while the torquers are on, body axes [A·m²].
        """
        b = np.asarray(field_T, dtype=np.float64)
        return self._limit(b, np.cross(b, np.asarray(rate_rad_s, dtype=np.float64)))

    def _limit(self, b: FloatArray, change_T_s: FloatArray) -> FloatArray:
        wanted = -self.gain_Nms * change_T_s / np.sum(b * b, axis=-1, keepdims=True)
        return np.clip(np.nan_to_num(wanted), -self.largest_Am2, self.largest_Am2)


@dataclass(frozen=True, eq=False)
class HysteresisRods:
    r"""Rods of soft iron across a satellite's magnet, which damp its rotation without power.

    The model of Flatley and Henretty, solved: the flux is :math:`B = \frac{2 B_s}{\pi} \arctan(k z)` with
    :math:`k = \tan(\pi B_r / 2 B_s) / H_c`, of a field z that lags behind H by up to H_c:

    .. math::

        \frac{dz}{dH} = s^2, \quad s = \frac12 \pm \frac{H - z}{2 H_c} \quad\Rightarrow\quad
        s = \tanh\left(\operatorname{artanh} s_0 + \frac{|H - H_0|}{2 H_c}\right),

    \+ where H rises and - where it falls, valid from each turning point of H to the next. A loop to saturation costs
    :math:`4 H_c B_s`; the cost of a small loop falls with the cube of its size. The parameters are apparent values of
    mounted rods: a rod demagnetises itself, so it differs much from a closed ring of the same material. The defaults
    are in use for rods of HyMu-80 of 95 mm by 1 mm on satellites of three units; 1 cm³ is thirteen such rods.

    Attributes
    ----------
    axes : ndarray, shape (K, 3)
        Unit vectors along the rods, body axes.
    volume_m3 : float
        Total volume of the rods along each axis.
    coercivity_A_m, remanence_T, saturation_T : float
        Apparent H_c, B_r and B_s.

    Raises
    ------
    ValueError
        An axis has no direction, a number is not positive, or the remanence is not below the saturation.

    Examples
    --------
    >>> import adcs
    >>> rods = adcs.HysteresisRods(volume_m3=1e-6)
    >>> state = rods.followed(rods.demagnetised(), [30e-6, 0.0, 0.0])
    >>> rods.moment_Am2(state).round(5)
    array([0.00368, 0.     , 0.     ])
    """

    axes: FloatArray = field(default_factory=lambda: np.eye(3)[:2])
    volume_m3: float = 1e-6
    coercivity_A_m: float = 12.0
    remanence_T: float = 0.004
    saturation_T: float = 0.027

    def __post_init__(self) -> None:
        axes = np.atleast_2d(np.asarray(self.axes, dtype=np.float64))
        lengths = np.linalg.norm(axes, axis=-1, keepdims=True)
        if axes.shape[1:] != (3,) or not (np.isfinite(lengths).all() and (lengths > 0.0).all()):
            raise ValueError(f"Input axes must be directions, shape (K, 3); instead received {axes.tolist()}.")
        object.__setattr__(self, "axes", axes / lengths)
        check_positive(
            volume_m3=self.volume_m3,
            coercivity_A_m=self.coercivity_A_m,
            remanence_T=self.remanence_T,
            saturation_T=self.saturation_T,
        )
        if not self.remanence_T < self.saturation_T:
            raise ValueError(
                f"Input remanence_T must be below saturation_T, {self.saturation_T:g}; "
                f"instead received {self.remanence_T:g}."
            )

    def demagnetised(self) -> FloatArray:
        """Return the state of demagnetised rods.

        Returns
        -------
        ndarray, shape (2, K)
            Zero field H and zero lagging field z of each rod [A/m].
        """
        return np.zeros((2, len(self.axes)))

    def followed(self, state_A_m: ArrayLike, field_T: ArrayLike) -> FloatArray:
        """Return the state of the rods after a monotonic change of the field.

        Parameters
        ----------
        state_A_m : array_like, shape (..., 2, K)
            State before the change, H and z along each rod [A/m].
        field_T : array_like, shape (..., 3)
            External field after the change, body axes [T].

        Returns
        -------
        ndarray, shape (..., 2, K)
            State after the change, H and z along each rod [A/m].
        """
        before, z = np.moveaxis(np.asarray(state_A_m, dtype=np.float64), -2, 0)
        H = np.asarray(field_T, dtype=np.float64) @ self.axes.T / MU0
        way = np.where(before > H, -1.0, 1.0)
        s, t = (
            0.5 + 0.5 * way * (before - z) / self.coercivity_A_m,
            np.tanh(0.5 * np.abs(H - before) / self.coercivity_A_m),
        )
        return np.stack([H, H - way * self.coercivity_A_m * (2.0 * (s + t) / (1.0 + s * t) - 1.0)], axis=-2)

    def moment_Am2(self, state_A_m: ArrayLike) -> FloatArray:
        """Return the moment of all rods, B V/μ₀ along each.

        Parameters
        ----------
        state_A_m : array_like, shape (..., 2, K)
            State from :meth:`followed` [A/m].

        Returns
        -------
        ndarray, shape (..., 3)
            Moment in body axes [A·m²].
        """
        z = np.asarray(state_A_m, dtype=np.float64)[..., 1, :]
        flux_T = 2.0 / np.pi * self.saturation_T * np.arctan(self.steepness_m_A * z)
        return self.volume_m3 / MU0 * (flux_T @ self.axes)

    @property
    def steepness_m_A(self) -> float:
        """Coefficient k of the arc tangent of the loop."""
        return float(np.tan(0.5 * np.pi * self.remanence_T / self.saturation_T) / self.coercivity_A_m)


def b_dot_gain(inertia_kgm2: ArrayLike, orbital_rate_rad_s: float) -> float:
    """Return the gain k = 4 n I of B-dot.

    I is the largest moment of inertia. With the smallest one, detumbling takes six times as long.

    Parameters
    ----------
    inertia_kgm2 : array_like, shape (3, 3)
        Inertia of the satellite.
    orbital_rate_rad_s : float
        Rate n of the orbit.

    Returns
    -------
    float
        Gain k for :class:`BDot` [N·m·s].

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> round(adcs.b_dot_gain(np.diag([0.041, 0.041, 0.007]), 0.0011), 7)
    0.0001804
    """
    return 4.0 * orbital_rate_rad_s * float(np.linalg.eigvalsh(np.asarray(inertia_kgm2, dtype=np.float64))[-1])


def detumbled(
    law: BDot, momentum_Nms: ArrayLike, b_inertial_T: ArrayLike, inertia_kgm2: ArrayLike, step_s: float
) -> FloatArray:
    r"""Return the momentum of a satellite under B-dot, predicted by the mean torque alone.

    .. math::

        \dot H = -\min\left(\frac{k d |H_\perp|}{I}, 1.2\, m d |B|\right) \hat H_\perp

    :math:`H_\perp` is the component of H across the field along the orbit. The attitude does not matter. The simple
    estimate I Δω over the mean torque is wrong by factors, because the component along the field does not decay.

    Parameters
    ----------
    law : BDot
        Gain, largest moment and duty.
    momentum_Nms : array_like, shape (..., 3)
        Momentum at the start, inertial axes [N·m·s].
    b_inertial_T : array_like, shape (..., n, 3)
        Field along the orbit, inertial axes.
    inertia_kgm2 : array_like, shape (3, 3)
        Inertia of the satellite; I is its largest moment.
    step_s : float
        Time between the n instants.

    Returns
    -------
    ndarray, shape (..., n)
        Modulus of the momentum [N·m·s].

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> field = np.tile([0.0, 0.0, 30e-6], (200, 1))
    >>> law, J = adcs.BDot(gain_Nms=2e-4), np.diag([0.04, 0.04, 0.01])
    >>> adcs.detumbled(law, [1e-3, 0.0, 0.0], field, J, step_s=1.0)[[0, -1]].round(5)
    array([0.001  , 0.00045])
    """
    H = np.array(momentum_Nms, dtype=np.float64)
    b = np.asarray(b_inertial_T, dtype=np.float64)
    inertia = float(np.linalg.eigvalsh(np.asarray(inertia_kgm2, dtype=np.float64))[-1])
    modulus = np.empty(np.broadcast_shapes(H.shape[:-1], b.shape[:-2]) + b.shape[-2:-1])
    for i in range(b.shape[-2]):
        modulus[..., i] = np.linalg.norm(H, axis=-1)
        length = np.linalg.norm(b[..., i, :], axis=-1, keepdims=True)
        n = b[..., i, :] / length
        across = H - n * np.sum(H * n, axis=-1, keepdims=True)
        size = np.linalg.norm(across, axis=-1, keepdims=True)
        linear = law.gain_Nms * law.duty * size / inertia
        torque = np.minimum(linear, _MEAN_OF_A_CUBE * law.largest_Am2 * law.duty * length)
        H = H - np.minimum(torque * step_s / np.maximum(size, 1e-300), 1.0) * across
    return modulus
