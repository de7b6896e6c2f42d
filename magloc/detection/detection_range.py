"""How far an array detects a source, in every direction and for every moment that it may have."""

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

# Ratio of neighbouring distances of the search: the energy is a power of the distance to 1e-5 between two of them.
_STEP = 1.03
# Nearer than this many circumradii a distance from the centroid says little about that from the sensors.
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
    """Distance up to which the matched filter finds a source, over directions of the source and of its moment.

    Parameters
    ----------
    array : SensorArray
        Whose noise counts.
    moment_Am2 : float
        Size of the moment [A·m²].
    probability : float
        Of detection.
    false_alarm_rate : float
        Share of the rows without a source in which one is found.
    share : float
        Of the directions for which that distance suffices: 0.5 gives the median, 0.95 what is nearly sure.
    rng : int or numpy.random.Generator
        Seed or generator of the noise that sets the threshold.

    Returns
    -------
    float
        From the sensors' centroid [m]; 0 where a source is not even found beside the array.

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
    """Largest distance at which a source is detected with a probability, along given directions.

    ``directions`` (d, 3): from the sensors' centroid, array frame, of any length. ``moments_Am2`` (n, 3): moments
    that the source may have [A·m²]: :func:`magloc.directions.moments_on_sphere`, say. ``detector``: with its
    false-alarm rate: :class:`magloc.chi_square.ChiSquareDetector` or
    :class:`magloc.detection.matched_filter.MatchedFilterDetector`. ``probability``: of detection. Returns (d, n):
    distance from the sensors' centroid [m], for every moment; its quantiles over the last axis are what to expect
    of a moment of unknown direction. Zero where the source is not even detected beside the array, at 1.1
    circumradii from the centroid. Raises ValueError: a direction has no length, or an input is out of range.
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
    """Largest distances (d, n) at which moments (n, 3) have the required energy."""
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
    """Logarithm of the energy of moments (n, 3) at one distance along directions (d, 3): (d, n)."""
    signals = matched.unit_signals(matched.array.centroid + distance * directions)
    normal = np.swapaxes(signals, -1, -2) @ signals
    energies = np.einsum("nj,djk,nk->dn", moments, normal, moments, optimize=True)
    with np.errstate(divide="ignore"):
        result: FloatArray = np.log(energies)
    return result
