"""How far away an array finds a source, in all directions: beside how far it knows its range as well as required."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magloc.bounds.maps import ANGLES, CASES_IN_WORDS, BoundScenario, sphere_grid
from magloc.bounds.over_moments import spread_over
from magloc.chi_square import Detector
from magloc.detection.detection_range import detection_range

if TYPE_CHECKING:
    import xarray as xr


def with_detection_ranges(
    spheres: xr.Dataset, scenario: BoundScenario, detector: Detector, probability: float = 0.9
) -> xr.Dataset:
    """Spheres with the distances at which a source is found.

    Parameters
    ----------
    spheres : xarray.Dataset
        Made by :func:`magloc.bounds.maps.bound_spheres`.
    scenario : BoundScenario
        That they were made for.
    detector : Detector
        With its false-alarm rate.
    probability : float
        Of detection.

    Returns
    -------
    xarray.Dataset
        The same with ``detection_range`` over (elevation, azimuth) for each of :data:`magloc.bounds.maps.CASES`: the
        greatest distance from the centroid [m] at which the given moment is found, a half and 95 % of the directions of
        the moment are, and the worst of them is; 0 where none is beside the array.

    Raises
    ------
    ValueError
        The array has no such detector, see :class:`magloc.detection.dipole_filter.DipoleFilter`.
    """
    directions = sphere_grid(spheres["elevation"].to_numpy(), spheres["azimuth"].to_numpy())
    once = directions[:, :-1]  # the last azimuth is the first one again
    moments = np.vstack([np.asarray(scenario.moment_Am2), scenario.moments_Am2])
    found = detection_range(scenario.array, once.reshape(-1, 3), moments, detector, probability=probability)
    # The quantiles of a distance are those of its opposite, as large is good.
    over_moments = spread_over(-found[:, 1:])
    cases = (found[:, 0], -over_moments.median, -over_moments.q95, -over_moments.worst)
    variables = {}
    for (case, in_words), distance in zip(CASES_IN_WORDS.items(), cases, strict=True):
        around = distance.reshape(once.shape[:2])
        attributes = {"long_name": f"greatest distance at which a source is found, {in_words}", "units": "m"}
        variables[f"detection_range{case}"] = (ANGLES, np.concatenate([around, around[:, :1]], axis=1), attributes)
    return spheres.assign(variables).assign_attrs(detection_probability=probability)
