"""Random processes of a simulation, each from its own stream.

See docs/theory/magnetic-simulation.md.
"""

from __future__ import annotations

import math
import zlib

import numpy as np
from scipy import fft
from scipy.signal import lfilter

from arrays.typing import FloatArray

HOUR_S = 3600.0


def stream(seed: int, feature: str, owner: str = "") -> np.random.Generator:
    """Return random numbers of one feature of one sensor, source or carrier.

    ``seed``: of the simulation. ``feature``: what they are for, such as ``"noise"``. ``owner``: whose they are, such as
    a sensor's id. Returns: a generator that does not depend on other names, so that the removal of a feature or a
    sensor changes no other.
    """
    key = (zlib.crc32(feature.encode()), zlib.crc32(owner.encode()))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def coloured_noise(
    n: int,
    channels: int,
    rate_Hz: float,
    density: float,
    corner_Hz: float,
    bandwidth_Hz: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return noise with a white and a 1/f part behind a first-order low-pass.

    ``n``, ``channels``: samples, and independent channels. ``rate_Hz``: sampling rate. ``density``: N, square root
    of the one-sided spectral density of the white part [unit/√Hz]. ``corner_Hz``: f_c, where both parts are equal;
    0 = none. ``bandwidth_Hz``: f_b, infinite = none. Returns (n, channels): [unit].
    """
    white = rng.standard_normal((2 * n, channels)) * (density * math.sqrt(rate_Hz / 2.0))
    if corner_Hz == 0.0 and math.isinf(bandwidth_Hz):
        return white[:n]
    f = fft.rfftfreq(2 * n, 1.0 / rate_Hz)
    shape = np.zeros_like(f)
    shape[1:] = np.sqrt((1.0 + corner_Hz / f[1:]) / (1.0 + (f[1:] / bandwidth_Hz) ** 2))
    return fft.irfft(fft.rfft(white, axis=0) * shape[:, None], 2 * n, axis=0)[:n]


def white_sigma(rate_Hz: float, density: float, bandwidth_Hz: float) -> float:
    r"""Return the standard deviation of the white part of :func:`coloured_noise` in one sample.

    :math:`σ² = N² ∫_0^{f_s/2} df/(1 + (f/f_b)²) = N² f_b \arctan(f_s/(2 f_b))`.
    ``rate_Hz``, ``density``, ``bandwidth_Hz``: as there. Returns [unit].
    """
    nyquist = rate_Hz / 2.0
    band = nyquist if math.isinf(bandwidth_Hz) else bandwidth_Hz * math.atan(nyquist / bandwidth_Hz)
    return density * math.sqrt(band)


def flicker_sigma(rate_Hz: float, density: float, corner_Hz: float, bandwidth_Hz: float, lowest_Hz: float) -> float:
    """Return the standard deviation of the 1/f part of :func:`coloured_noise` above a frequency, in one sample.

    :math:`σ² = N² f_c ∫_{f_1}^{f_s/2} df/(f (1 + (f/f_b)²))`, zero where the rate does not reach that frequency.
    ``rate_Hz``, ``density``, ``corner_Hz``, ``bandwidth_Hz``: as there. ``lowest_Hz``: f_1, positive. Returns [unit].
    """
    nyquist = rate_Hz / 2.0
    if nyquist <= lowest_Hz:
        return 0.0
    low, high = lowest_Hz / math.hypot(1.0, lowest_Hz / bandwidth_Hz), nyquist / math.hypot(1.0, nyquist / bandwidth_Hz)
    return density * math.sqrt(corner_Hz * math.log(high / low))


def lasting(random: FloatArray, correlation_s: float, rate_Hz: float) -> FloatArray:
    """Return first-order Markov processes (n, k) of unit variance; 0 s: white, ∞: constant."""
    decay = math.exp(-1.0 / (rate_Hz * correlation_s)) if correlation_s else 0.0
    added = random * math.sqrt(1.0 - decay**2)
    added[0] = random[0]
    return np.asarray(lfilter([1.0], [1.0, -decay], added, axis=0))


def random_walk(n: int, channels: int, rate_Hz: float, per_root_hour: float, rng: np.random.Generator) -> FloatArray:
    """Return a drift from zero whose variance grows by ``per_root_hour²`` in an hour.

    ``n``, ``channels``: samples, and independent channels. ``rate_Hz``: sampling rate. ``per_root_hour`` [unit/√h].
    Returns (n, channels) [unit].
    """
    steps = rng.standard_normal((n, channels)) * (per_root_hour / math.sqrt(HOUR_S * rate_Hz))
    steps[0] = 0.0
    return np.cumsum(steps, axis=0)


def low_passed(values: FloatArray, rate_Hz: float, bandwidth_Hz: float) -> FloatArray:
    """Filter a signal, linear between samples and constant before them, by a first-order low-pass.

    Shapes ``values`` (n, channels) -> (n, channels). ``rate_Hz``: sampling rate. ``bandwidth_Hz``: where the amplitude
    has fallen by 3 dB; infinite = no filter.
    """
    if math.isinf(bandwidth_Hz):
        return values
    step = 2.0 * math.pi * bandwidth_Hz / rate_Hz  # in time constants
    decay = math.exp(-step)
    mean = -math.expm1(-step) / step
    rest = mean * values[:1]  # the filter's state after a long time at the first value
    return lfilter([1.0 - mean, mean - decay], [1.0, -decay], values, axis=0, zi=rest)[0]
