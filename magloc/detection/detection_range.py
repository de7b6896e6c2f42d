"""Distance at which an array detects a source, over directions and moments."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.values import accept_seed
from arrays.typing import FloatArray, Rng
from magloc.chi_square import Detector
from magloc.detection.dipole_filter import DipoleFilter
from magloc.detection.matched_filter import MatchedFilterDetector
from magloc.directions import moments_on_sphere, sphere_directions
from magloc.levels import FALSE_ALARM

# Ratio of neighbouring distances of the search: between two of them a power law describes the energy to 1e-5.
_STEP = 1.03
# Least distance in circumradii: nearer, the distance from the centroid says little about that from the sensors.
_NEAREST = 1.1
_DIRECTIONS_AT_ONCE = 32
_FARTHEST_M = 1e6
_N_DIRECTIONS, _N_MOMENTS = 100, 50
# They know the threshold to 2 %, and the range, which falls with its eighth root, to a quarter of a per cent.
_EXCEEDANCES = 20


@accept_seed
def detection_range(
    array: SensorArray,
    moment_Am2: float,
    *,
    probability: float = 0.9,
    false_alarm_rate: float = FALSE_ALARM,
    share: float = 0.5,
    rng: Rng = 0,
) -> float:
    """Return the distance up to which the matched filter finds a source of any direction and moment direction.

    Parameters
    ----------
    array : SensorArray
        Array with its noise.
    moment_Am2 : float
        Size of the moment [A·m²].
    probability : float
        Probability of detection.
    false_alarm_rate : float
        Share of the rows without a source in which one is found.
    share : float
        Share of the directions in which a source is found at the returned distance: 0.5 gives the median, 0.95 a
        cautious value.
    rng : int or numpy.random.Generator
        Seed or generator of the noise that sets the threshold.

    Returns
    -------
    float
        Distance from the sensors' centroid [m]; 0 if a source is not found even beside the array.

    Raises
    ------
    ValueError
        The array gives fewer than six differences or has scalar sensors without an ambient field, or an input is out of
        range.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> round(magloc.detection_range(arrays.tetrahedron(1.5), 100.0, false_alarm_rate=0.01))
    10
    """
    detector = MatchedFilterDetector.of(
        array, false_alarm_rate, n_draws=round(_EXCEEDANCES / false_alarm_rate), rng=rng
    )
    moments = moments_on_sphere(moment_Am2, _N_MOMENTS)
    ranges = detection_ranges(array, sphere_directions(_N_DIRECTIONS), moments, detector, probability=probability)
    return float(np.quantile(ranges, 1.0 - share, method="inverted_cdf"))


def detection_ranges(
    array: SensorArray,
    directions: ArrayLike,
    moments_Am2: ArrayLike,
    detector: Detector,
    *,
    probability: float = 0.9,
) -> FloatArray:
    """Return the largest distances (d, n) [m] at which a source is detected with a probability.

    Distances are from the sensors' centroid, for each direction and moment; quantiles over the last axis apply to a
    moment of unknown direction. The result is zero if the source is not detected even at 1.1 circumradii.

    ``directions`` (d, 3): from the sensors' centroid in the array's frame, of any length. ``moments_Am2`` (n, 3):
    possible moments of the source [A·m²], for example :func:`magloc.directions.moments_on_sphere`. ``detector``: a
    :class:`magloc.chi_square.ChiSquareDetector` or :class:`magloc.detection.matched_filter.MatchedFilterDetector`.
    ``probability``: probability of detection. Raises ValueError: a direction is zero, or an input is out of range.
    """
    towards = np.asarray(directions, dtype=np.float64)
    lengths = np.linalg.norm(towards, axis=-1, keepdims=True)
    if towards.ndim != 2 or towards.shape[1] != 3 or not np.all(lengths > 0.0):
        raise ValueError(f"Input directions must be vectors of shape (d, 3) with a length; instead: {towards.shape}.")
    moments = np.asarray(moments_Am2, dtype=np.float64)
    if moments.ndim != 2 or moments.shape[1] != 3 or not np.isfinite(moments).all():
        raise ValueError(f"Input moments_Am2 must be finite vectors of shape (n, 3); instead received {moments.shape}.")
    required = detector.required_energy(probability)
    matched = DipoleFilter(array)
    parts = np.array_split(towards / lengths, -(-len(towards) // _DIRECTIONS_AT_ONCE))
    return np.concatenate([_ranges(matched, part, moments, required) for part in parts])


def _ranges(matched: DipoleFilter, directions: FloatArray, moments: FloatArray, required: float) -> FloatArray:
    """Return the largest distances (d, n) at which moments (n, 3) have the required energy."""
    nearest = _NEAREST * matched.array.circumradius
    farthest = 2.0 * nearest
    while farthest < _FARTHEST_M and _log_energies(matched, directions, moments, farthest).max() > np.log(required):
        farthest *= 2.0
    distances = nearest * _STEP ** np.arange(np.ceil(np.log(farthest / nearest) / np.log(_STEP)) + 1)
    levels = np.stack([_log_energies(matched, directions, moments, r) for r in distances]) - np.log(required)
    # The farthest crossing counts: near the array the energy need not fall everywhere.
    above = levels[:-1] >= 0.0
    last = above.shape[0] - 1 - np.argmax(above[::-1], axis=0)
    inside = np.take_along_axis(levels, last[None], axis=0)[0]
    outside = np.take_along_axis(levels, last[None] + 1, axis=0)[0]
    ratio = distances[1] / distances[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = distances[last] * ratio ** (inside / (inside - outside))
    return np.where(above.any(axis=0), crossing, 0.0)


def _log_energies(matched: DipoleFilter, directions: FloatArray, moments: FloatArray, distance: float) -> FloatArray:
    """Return the logarithm (d, n) of the energy of moments (n, 3) at a distance along directions (d, 3)."""
    signals = matched.unit_signals(matched.array.centroid + distance * directions)
    normal = np.swapaxes(signals, -1, -2) @ signals
    energies = np.einsum("nj,djk,nk->dn", moments, normal, moments, optimize=True)
    with np.errstate(divide="ignore"):
        result: FloatArray = np.log(energies)
    return result
