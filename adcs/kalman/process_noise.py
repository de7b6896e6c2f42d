"""Process noise of an attitude filter: tuned, and that of the source.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, Tables 3 to 5. Ours: the exponents of :func:`paper_noise`, which are missing or uncertain there. They give the
accuracy that the tables state.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from adcs.kalman.error_state import ProcessNoise, SensorSet

TUNED_KGM2 = 0.5
"""Least principal moment of inertia for which the process noise is tuned (TabletSat-Aurora's)."""


def torque_scale(inertia_kgm2: ArrayLike | None) -> float:
    """Return the acceleration of a satellite over that of :data:`TUNED_KGM2` by the same torque, at least 1."""
    if inertia_kgm2 is None:
        return 1.0
    return max(1.0, TUNED_KGM2 / float(np.linalg.eigvalsh(np.asarray(inertia_kgm2, dtype=np.float64))[0]))


def tuned_noise(used: SensorSet, inertia_kgm2: ArrayLike | None = None) -> ProcessNoise:
    """Return process noise that makes the filter accurate and consistent.

    It is tuned for a constant torque of 8e-7 N·m; with the state ``dipole`` and without ``disturbance``, for a torque
    of up to 1e-8 N·m besides the dipole's. ``inertia_kgm2`` (3, 3): small satellites accelerate more by such torques.
    """
    scale = torque_scale(inertia_kgm2)
    if "dipole" in used.states:
        # Only whole orbits separate a dipole from other torques; larger process noise would hide it.
        if "disturbance" in used.states:
            # Small satellites have smaller dipoles, too. The field's error times the dipole is what remains.
            scale = math.sqrt(scale)
            return ProcessNoise(1e-8, scale * 1e-8, disturbance_s2=scale * 3e-10)
        return ProcessNoise(1e-8, scale * 2e-7)
    if "disturbance" in used.states:
        # The torque is a state, so the rate itself needs almost no noise.
        if used.star and "gyro-bias" not in used.states:
            return ProcessNoise(1e-8, scale * 1e-8, disturbance_s2=scale * 3e-8)
        return ProcessNoise(1e-8, scale * 1e-7, disturbance_s2=scale * 1e-8)
    # The torque changes the rate by up to 1.5e-6 rad/s a step. A star tracker observes that within seconds; vectors
    # average over minutes, in which a constant torque is far from white: ten times the noise keeps NEES consistent.
    return ProcessNoise(1e-8, scale * (1.5e-6 if used.star else 1.5e-5))


PAPER_NOISE: dict[tuple[str, tuple[str, ...]], ProcessNoise] = {
    # Table 3. Mantissas are printed, exponents are ours. Field biases are printed for a field of unit length: they are
    # multiplied by 40 µT here.
    ("st+gyro+mag+sun", ()): ProcessNoise(1e-5, 1.2e-6),
    ("st+gyro+mag", ()): ProcessNoise(1e-5, 1.2e-6),
    ("st+gyro", ()): ProcessNoise(1e-5, 1.2e-6),
    ("st+mag+sun", ()): ProcessNoise(1e-5, 1.2e-6),
    ("st+mag", ("field-bias",)): ProcessNoise(1e-5, 1.2e-6, field_bias_T=40e-9),
    ("st+gyro", ("gyro-bias",)): ProcessNoise(1e-5, 1.2e-6, gyro_bias_rad_s=1e-5),
    ("gyro+mag+sun", ()): ProcessNoise(5e-6, 5e-4),
    ("gyro+mag+sun", ("gyro-bias",)): ProcessNoise(1e-6, 3e-4, gyro_bias_rad_s=1e-6),
    ("gyro+mag+sun", ("field-bias",)): ProcessNoise(5e-6, 3e-4, field_bias_T=20e-9),
    ("mag+sun", ()): ProcessNoise(5e-3, 2e-5),
    ("gyro+mag", ()): ProcessNoise(1e-4, 5e-4),
    ("st", ()): ProcessNoise(1e-5, 1.2e-6),
    # Table 4.
    ("st", ("disturbance",)): ProcessNoise(3e-7, 3e-7, disturbance_s2=5e-9),
    ("st+gyro", ("gyro-bias", "disturbance")): ProcessNoise(3e-7, 3e-7, gyro_bias_rad_s=1e-8, disturbance_s2=5e-9),
    ("mag+sun", ("disturbance",)): ProcessNoise(1e-5, 5e-6, disturbance_s2=5e-8),
    ("gyro+mag+sun", ("gyro-bias", "disturbance")): ProcessNoise(1e-6, 3e-6, gyro_bias_rad_s=1e-7, disturbance_s2=5e-8),
}


def paper_noise(used: SensorSet) -> ProcessNoise:
    """Return the process noise of the source's tables."""
    try:
        return PAPER_NOISE[used.sensors, used.states]
    except KeyError:
        raise ValueError(
            f"Input used must be a set of the source's tables; instead received {used.sensors!r} with the states "
            f"{list(used.states)}."
        ) from None
