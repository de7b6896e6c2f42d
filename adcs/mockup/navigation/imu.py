r"""Gyro and inclinometer of the mock-up; the inclinometer serves as accelerometer.

A reading is the true value plus a zero that is linear in temperature, plus noise; it is NaN beyond the range. A tilted
inclinometer also reads g·sin(tilt), which cannot be distinguished from a zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import FloatArray

G_M_S2 = 9.80665


@dataclass(frozen=True)
class RateGyro:
    """Gyro ADIS16100: ±300 °/s, noise 0.1 °/s, a zero that is linear in temperature, -40 to 85 °C."""

    sigma_rad_s: float = math.radians(0.1)  # standard deviation of a sample
    range_rad_s: float = math.radians(300.0)
    zero_rad_s: float = 0.0  # at ``reference_C``
    zero_slope_rad_s_K: float = 0.0  # the source does not state it
    reference_C: float = 20.0
    lowest_C: float = -40.0  # lowest operating temperature
    highest_C: float = 85.0  # highest operating temperature

    def __post_init__(self) -> None:
        _check_noise_and_range(self.sigma_rad_s, self.range_rad_s)

    def readings(self, rate_rad_s: ArrayLike, noise: ArrayLike, temperature_C: ArrayLike = 20.0) -> FloatArray:
        """Return the readings, NaN beyond the range.

        Shapes ``rate_rad_s`` (...), ``temperature_C`` (...) -> (...). ``noise`` (...): standard normal numbers.
        """
        warmer_K = _check_temperature(temperature_C, self.lowest_C, self.highest_C) - self.reference_C
        zero = self.zero_rad_s + self.zero_slope_rad_s_K * warmer_K
        noise = np.asarray(noise, dtype=np.float64)
        return _within(np.asarray(rate_rad_s) + zero + self.sigma_rad_s * noise, self.range_rad_s)


@dataclass(frozen=True, eq=False)
class Inclinometer:
    """Inclinometer SCA103T-D04 as accelerometer of two axes.

    Range ±0.26 g, noise 0.002 m/s², ±0.0003 m/s² per °C, -40 to 125 °C.
    """

    sigma_m_s2: float = 0.002  # standard deviation of a sample, each axis
    range_m_s2: float = 0.26 * G_M_S2  # largest reading of each axis
    zero_m_s2: FloatArray = field(default_factory=lambda: np.zeros(2))  # (2,): at ``reference_C``
    zero_slope_m_s2_K: FloatArray = field(default_factory=lambda: np.zeros(2))  # (2,): at most 0.0003
    tilt_rad: FloatArray = field(
        default_factory=lambda: np.zeros(2)
    )  # (2,): tilt of the axes x and y above the horizontal
    reference_C: float = 20.0
    lowest_C: float = -40.0  # lowest operating temperature
    highest_C: float = 125.0  # highest operating temperature

    def __post_init__(self) -> None:
        _check_noise_and_range(self.sigma_m_s2, self.range_m_s2)
        for name in ("zero_m_s2", "zero_slope_m_s2_K", "tilt_rad"):
            vector = np.asarray(getattr(self, name), dtype=np.float64)
            if vector.shape != (2,) or not np.isfinite(vector).all():
                raise ValueError(f"Input {name} must be two finite numbers; instead received {vector.tolist()}.")
            object.__setattr__(self, name, vector)

    def readings(self, acceleration_m_s2: ArrayLike, noise: ArrayLike, temperature_C: ArrayLike = 20.0) -> FloatArray:
        """Return the readings, NaN beyond the range.

        Shapes ``temperature_C`` (...) -> (..., 2). ``acceleration_m_s2`` (..., 2): along body x and y. ``noise``
        (..., 2): standard normal numbers.
        """
        warmer_K = _check_temperature(temperature_C, self.lowest_C, self.highest_C) - self.reference_C
        zero = self.zero_m_s2 + G_M_S2 * np.sin(self.tilt_rad) + self.zero_slope_m_s2_K * warmer_K[..., None]
        noise = np.asarray(noise, dtype=np.float64)
        return _within(np.asarray(acceleration_m_s2) + zero + self.sigma_m_s2 * noise, self.range_m_s2)


def _within(readings: FloatArray, largest: float) -> FloatArray:
    return np.where(np.abs(readings) <= largest, readings, np.nan)


def _check_noise_and_range(sigma: float, largest: float) -> None:
    if not (0.0 <= sigma < math.inf and 0.0 < largest < math.inf):
        raise ValueError(
            "Input sigma must be 0 or more and range positive, both finite; "
            f"instead received {sigma:g} and {largest:g}."
        )


def _check_temperature(temperature_C: ArrayLike, lowest_C: float, highest_C: float) -> FloatArray:
    temperature = np.asarray(temperature_C, dtype=np.float64)
    outside = temperature[~((temperature >= lowest_C) & (temperature <= highest_C))]
    if outside.size:
        raise ValueError(
            f"Input temperature_C must be {lowest_C:g} to {highest_C:g}; instead received {outside.flat[0]:g}."
        )
    return temperature
