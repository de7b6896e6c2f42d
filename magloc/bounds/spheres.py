"""Cramér-Rao bounds on spheres about an array, and its reach in every direction.

The reach is the distance at which the range is as accurate as required, or at which a source is detected.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import FloatArray
from magloc.bounds.maps import CASES, CASES_IN_WORDS, VARIABLES, BoundScenario, bounds_at
from magloc.bounds.over_moments import spread_over
from magloc.chi_square import Detector
from magloc.detection.detection_range import detection_ranges

if TYPE_CHECKING:
    import xarray as xr

ANGLES = ("elevation", "azimuth")
"""Dimensions of a sphere."""
# Distances of the search for the reach before refinement: the nearest, in circumradii, and their ratio.
_NEAREST, _STEP = 1.1, 1.12
_FARTHEST = 1e6
_REFINEMENTS = 2
_ALL_DONE = 8  # number of distances without any direction in reach that ends the search


def bound_spheres(scenario: BoundScenario, ranges_m: Sequence[float], step_deg: float = 5.0) -> xr.Dataset:
    """Compute bounds on spheres about the array's centroid, and the reach by direction.

    Parameters
    ----------
    ranges_m : sequence of float
        Radii of the spheres [m].
    step_deg : float
        Step of either angle; it divides 90.

    Returns
    -------
    xarray.Dataset
        Over (range, elevation, azimuth) the variables of :func:`bounds_at`; over (elevation, azimuth) the reach
        ``accuracy_range`` with each of :data:`CASES`, see :func:`accuracy_ranges`. Azimuth counts from +x to +y,
        elevation from the x-y plane to +z.

    Raises
    ------
    ValueError
        A range is not positive, or 90 is not a multiple of the step.
    """
    import xarray as xr

    ranges = np.asarray(ranges_m, dtype=np.float64)
    if ranges.ndim != 1 or not np.all((ranges > 0.0) & np.isfinite(ranges)):
        raise ValueError(f"Input ranges_m must be positive numbers; instead received {list(ranges_m)}.")
    n = round(90.0 / step_deg) if step_deg > 0.0 else 0
    if n < 1 or abs(n * step_deg - 90.0) > 1e-9:
        raise ValueError(f"Input step_deg must divide 90; instead received {step_deg}.")
    elevation, azimuth = np.linspace(-90.0, 90.0, 2 * n + 1), np.linspace(-180.0, 180.0, 4 * n + 1)
    directions = sphere_grid(elevation, azimuth)
    sphere = bounds_at(scenario, scenario.array.centroid + ranges[:, None, None, None] * directions)
    reach = accuracy_ranges(scenario, directions.reshape(-1, 3))
    return xr.Dataset(
        {name: (("range", *ANGLES), sigma, dict(VARIABLES[name].attributes)) for name, sigma in sphere.items()}
        | {
            f"accuracy_range{case}": (ANGLES, reach[:, i].reshape(directions.shape[:-1]), _reach_attributes(case))
            for i, case in enumerate(CASES)
        },
        coords={
            "range": ("range", ranges, {"long_name": "distance from the centroid", "units": "m"}),
            "elevation": ("elevation", elevation, {"long_name": "from the x-y plane to +z", "units": "degree"}),
            "azimuth": ("azimuth", azimuth, {"long_name": "from +x to +y", "units": "degree"}),
        },
        attrs={**scenario.attributes, "centroid_m": scenario.array.centroid},
    )


def accuracy_ranges(scenario: BoundScenario, directions: ArrayLike) -> FloatArray:
    """Return the largest distances (D, 4) [m] with the required σ of the range.

    They are along directions (D, 3), for each of :data:`CASES`.

    The result is 0 if there is none. The search starts at 1.1 circumradii with steps of 12 %, and interpolates to a
    part in 10⁴. It does not notice gaps between two distances that are both in reach.
    """
    directions = np.asarray(directions, dtype=np.float64)
    centroid, nearest = scenario.array.centroid, _NEAREST * scenario.array.circumradius

    def excess(distance_m: FloatArray) -> FloatArray:
        """Return log(σ / required σ), (D, 4); far away linear in the logarithm of distance."""
        sigma = bounds_at(scenario, centroid + distance_m[:, None] * directions)
        of_cases = np.stack([sigma[f"sigma_range{case}"] for case in CASES], axis=-1)
        return np.log(of_cases / scenario.accuracy_m)

    shape = (len(directions), len(CASES))
    low, at_low, high, at_high = np.zeros(shape), np.zeros(shape), np.full(shape, nearest), np.full(shape, np.inf)
    distance, before, misses = nearest, np.zeros(shape, dtype=np.bool_), 0
    while misses < _ALL_DONE and distance < _FARTHEST * nearest:
        value = excess(np.full(len(directions), distance))
        inside = value <= 0.0
        leaves = before & ~inside
        low, at_low = np.where(inside, distance, low), np.where(inside, value, at_low)
        high, at_high = np.where(leaves, distance, high), np.where(leaves, value, at_high)
        misses = 0 if inside.any() else misses + 1
        before, distance = inside, distance * _STEP
    for _ in range(_REFINEMENTS):
        middle = _crossing(low, at_low, high, at_high)
        value = np.stack([excess(np.maximum(middle[:, i], nearest))[:, i] for i in range(len(CASES))], axis=-1)
        inside = value <= 0.0
        low, at_low = np.where(inside, middle, low), np.where(inside, value, at_low)
        high, at_high = np.where(inside, high, middle), np.where(inside, at_high, value)
    return _crossing(low, at_low, high, at_high)


def _crossing(low: FloatArray, at_low: FloatArray, high: FloatArray, at_high: FloatArray) -> FloatArray:
    """Return the zero of a line in the logarithm of the distance; zero where low is zero."""
    present = low > 0.0
    rise = np.where(present, at_high - at_low, 1.0)
    share = np.where(np.isfinite(rise) & (rise > 0.0), -at_low / np.where(rise > 0.0, rise, 1.0), 0.0)
    ratio = np.where(present, high, 1.0) / np.where(present, low, 1.0)
    return low * ratio ** np.clip(share, 0.0, 1.0)


def sphere_grid(elevation_deg: FloatArray, azimuth_deg: FloatArray) -> FloatArray:
    """Return unit vectors (elevations, azimuths, 3) of angles [°]."""
    e, a = np.meshgrid(np.radians(elevation_deg), np.radians(azimuth_deg), indexing="ij")
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def _reach_attributes(case: str) -> dict[str, str]:
    return {
        "long_name": f"largest distance with the required accuracy of the range, {CASES_IN_WORDS[case]}",
        "units": "m",
    }


def with_detection_ranges(
    spheres: xr.Dataset, scenario: BoundScenario, detector: Detector, probability: float = 0.9
) -> xr.Dataset:
    """Return spheres of :func:`bound_spheres` with the ranges of detection.

    ``detection_range`` over (elevation, azimuth) is the greatest distance from the centroid [m] at which the source is
    found, for each of :data:`magloc.bounds.maps.CASES`: the given moment, half and 95 % of the directions of the
    moment, and the worst direction. It is 0 if the source is not found beside the array.
    """
    directions = sphere_grid(spheres["elevation"].to_numpy(), spheres["azimuth"].to_numpy())
    once = directions[:, :-1]  # the last azimuth is the first one again
    moments = np.vstack([np.asarray(scenario.moment_Am2), scenario.moments_Am2])
    found = detection_ranges(scenario.array, once.reshape(-1, 3), moments, detector, probability=probability)
    # Large distances are good, so take quantiles of the negative distance.
    over_moments = spread_over(-found[:, 1:])
    cases = (found[:, 0], -over_moments.median, -over_moments.q95, -over_moments.worst)
    variables = {}
    for (case, in_words), distance in zip(CASES_IN_WORDS.items(), cases, strict=True):
        around = distance.reshape(once.shape[:2])
        attributes = {"long_name": f"greatest distance at which a source is found, {in_words}", "units": "m"}
        variables[f"detection_range{case}"] = (ANGLES, np.concatenate([around, around[:, :1]], axis=1), attributes)
    return spheres.assign(variables).assign_attrs(detection_probability=probability)
