r"""Control by torquers: B-dot, which takes the rate out of a tumbling satellite by its magnetometer alone.

The field in body axes changes as the body turns, dB/dt ≈ B×ω. A moment against it, m = -k Ḃ/B², has the torque
m×B ≈ -k ω⊥: it brakes what turns across the field, and the field turns along the orbit. With k = 4 n I the rate decays
within a quarter of a radian of the orbit; torquers saturate long before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import check_positive
from arrays.typing import FloatArray

_MEAN_OF_A_CUBE = 1.2
"""Largest moment across a field, of three torquers, each within its limit: its mean over directions, of that of one."""


@dataclass(frozen=True)
class BDot:
    """Law of B-dot, and the torquers.

    Attributes
    ----------
    gain_Nms : float
        k: torque over rate, while no torquer is at its limit; see :func:`b_dot_gain`.
    largest_Am2 : float
        Moment of each of three torquers along the body axes.
    duty : float
        Part of each cycle in which they are on; the magnetometer is read while they are off.

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
        """Moment (..., 3) to set until the next reading, while the torquers are on; zero without both readings.

        Parameters
        ----------
        before_T, now_T : array_like, shape (..., 3)
            Last two readings of the magnetometer, body axes.
        step_s : float
            Between them.
        """
        now = np.asarray(now_T, dtype=np.float64)
        change = (now - np.asarray(before_T, dtype=np.float64)) / step_s
        wanted = -self.gain_Nms * change / np.sum(now * now, axis=-1, keepdims=True)
        return np.clip(np.nan_to_num(wanted), -self.largest_Am2, self.largest_Am2)


def b_dot_gain(inertia_kgm2: ArrayLike, orbital_rate_rad_s: float) -> float:
    """Gain k = 4 n I of B-dot, I the largest moment of inertia: with the smallest it takes six times as long.

    Parameters
    ----------
    inertia_kgm2 : array_like, shape (3, 3)
        Of the satellite.
    orbital_rate_rad_s : float
        n.

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
    r"""Momentum of a satellite under B-dot, by its mean torque alone: what a detumbling should take.

    .. math::

        \dot H = -\min\left(\frac{k d |H_\perp|}{I}, 1.2\, m d |B|\right) \hat H_\perp

    with the part of H across the field along the orbit; no attitude is in it. I Δω over the mean torque is off by
    factors, because what is along the field waits.

    Parameters
    ----------
    law : BDot
        Gain, largest moment and duty.
    momentum_Nms : array_like, shape (..., 3)
        At the start, in the axes of the field.
    b_inertial_T : array_like, shape (..., n, 3)
        Along the orbit, inertial axes.
    inertia_kgm2 : array_like, shape (3, 3)
        I is its largest moment.
    step_s : float
        Between the n instants.

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
