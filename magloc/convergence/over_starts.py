r"""Convergence maps: from which starts does a dipole filter find the source?

One source, one set of readings, a cube of starts (the moment always starts at zero). Two filters of the source paper's
kind, one that takes no step uphill and one that needs no start, and a map of how they end:

* :class:`RepeatedFilter`: the same readings are processed again and again by an extended Kalman filter whose covariance
  grows by :math:`S_q S_q^T` before every pass. It forgets its start, so where it stops is a maximum of the likelihood.
* :class:`IekfFilter`: the iterated extended Kalman filter with the start as the mean of a prior.
* :class:`DampedFilter`: the cost of that filter, by Levenberg-Marquardt steps.
* :class:`GlobalFilter`: the start-free search.

Source: Pavlov, Karshakov, Goldin, "Determination of the magnetic field parameters of an object from remote
magnetogradient measurements", the function table, equations (19), (30), and the figure of the convergence region.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.geometries import tetrahedron
from arrays.noise import reading_covariance, reading_errors
from magloc.grids.computed import computed_map
from magloc.grids.cube import (
    Box,
    CubeMap,
    Summary,
    Tally,
    Values,
    Variable,
    check_half_width,
    common_counts,
    flags,
    tallied,
)
from magloc.localization.fit.results import Solution, Source
from magloc.localization.locator import Locator
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels

if TYPE_CHECKING:
    import xarray as xr
from arrays.typing import FloatArray
from magloc.convergence.ends import FilterEnds
from magloc.convergence.filters import FILTERS, Filter, RepeatedFilter, settings


class StartStatus(IntEnum):
    """Result of a start."""

    CONVERGED = 0
    OTHER_OPTIMUM = 1
    NOT_STOPPED = 2
    DIVERGED = 3


@dataclass(frozen=True)
class StartsScenario:
    """One source in front of an array, and a cube of starts around it.

    The defaults are from the paper's figure, with our values where the paper gives none.

    Attributes
    ----------
    array : SensorArray
        Vector sensors.
    position_m, moment_Am2 : tuple of 3 floats
        The source.
    half_width_m : float
        The cube reaches from -half_width to +half_width along every axis, around the origin of the array's frame.
    noise_seed : int, optional
        Seed of one realisation of the sensors' noise, the same for all starts; without it readings are noise-free.
    """

    array: SensorArray = field(default_factory=lambda: tetrahedron(0.45, noise_T=1e-9))
    position_m: tuple[float, float, float] = (5.0, 0.0, 0.306)
    moment_Am2: tuple[float, float, float] = (100.0, 0.0, 0.0)
    half_width_m: float = 20.0
    method: Filter = field(default_factory=RepeatedFilter)
    noise_seed: int | None = None


def simulate_measurement(scenario: StartsScenario) -> tuple[FloatArray, DifferenceMeasurement, FloatArray]:
    """Return readings (C,) [T], the measurement, and z (k,) [T] of a scenario."""
    array = scenario.array
    readings = predicted_channels(array, scenario.position_m, scenario.moment_Am2) + array.channel_offset_T
    if scenario.noise_seed is not None:
        normal = np.random.default_rng(scenario.noise_seed).standard_normal(array.n_channels)
        readings = readings + reading_errors(array, readings, normal)
    differences = decorrelated_differences(array, covariance_T2=reading_covariance(array, readings))
    measurement = DifferenceMeasurement(array, differences)
    return readings, measurement, measurement.measured(readings)


_VARIABLES = {
    "iterations": Variable(np.int32, {"long_name": "passes over the readings", "units": "1"}),
    "chi2": Variable(np.float64, {"long_name": "chi-square at the end", "units": "1"}),
    "distance": Variable(np.float64, {"long_name": "distance from the maximum-likelihood position", "units": "m"}),
    "status": Variable(
        np.int8,
        {
            "long_name": "how the start ended",
            **flags(StartStatus),
        },
    ),
    "half": Variable(
        np.int8,
        {
            "long_name": "side of the plane through the centroid, orthogonal to the source's direction",
            "flag_values": np.array([-1, 0, 1], dtype=np.int8),
            "flag_meanings": "back plane front",
        },
    ),
}


@dataclass(frozen=True, eq=False)
class StartsMap(CubeMap):
    """Map of a filter's ends over a cube of starts.

    Attributes
    ----------
    z : ndarray, shape (k,)
        Decorrelated differences for every start [T].
    optimum : Solution
        Best solution for them.
    """

    title = "Convergence of a dipole filter over its starts"
    point = "start"
    variables = _VARIABLES

    scenario: StartsScenario
    measurement: DifferenceMeasurement
    z: FloatArray
    optimum: Solution

    @classmethod
    def of(cls, scenario: StartsScenario, grid: int) -> StartsMap:
        """Return the map of a scenario; errors as in :func:`convergence_map`."""
        if scenario.array.channel_is_scalar.any():
            raise ValueError("Input array must have vector sensors only; instead received one with scalar sensors.")
        locator = Locator(scenario.array, body_length_m=0.0, exclude_faulty=False)
        readings, measurement, z = simulate_measurement(scenario)
        fix = locator.fit(readings)
        if not fix.solutions:
            raise ValueError(f"Input scenario has readings with no maximum-likelihood solution: {fix.reason}.")
        return cls(scenario, grid, measurement, z, fix.solutions[0])

    @property
    def point_s(self) -> float:
        """Approximate time of one core for a start that never stops [s]."""
        method = self.scenario.method
        return method.pass_s * method.max_iterations * self.z.size / 9

    @property
    def settings(self) -> Mapping[str, Any]:
        """Filter, source and noise."""
        scenario = self.scenario
        return {
            "method": scenario.method.name,
            **{f"method_{key}": _attribute(value) for key, value in settings(scenario.method).items()},
            "position_m": np.asarray(scenario.position_m),
            "moment_Am2": np.asarray(scenario.moment_Am2),
            "centroid_m": scenario.array.centroid,
            "noise_seed": -1 if scenario.noise_seed is None else scenario.noise_seed,
        }

    @property
    def findings(self) -> Mapping[str, Any]:
        """Maximum-likelihood solution, to compare the ends with."""
        return {
            "optimum_position_m": self.optimum.position_m,
            "optimum_moment_Am2": self.optimum.moment_Am2,
            "optimum_chi2": self.optimum.chi2,
        }

    def values_at(self, box: Box) -> Mapping[str, Any]:
        """Return the ends of the starts of a box."""
        scenario, centroid = self.scenario, self.scenario.array.centroid
        positions = box.points(self.axis)
        starts = np.concatenate([positions, np.zeros_like(positions)], axis=1)
        ends = scenario.method.run(self.measurement, self.z, starts)
        # Points of the grid lie on the plane only to rounding.
        depth = (positions - centroid) @ (np.asarray(scenario.position_m) - centroid)
        half = np.sign(np.where(np.abs(depth) < 1e-9 * scenario.half_width_m**2, 0.0, depth))
        return {
            "iterations": ends.iterations,
            "chi2": ends.chi2,
            "distance": np.linalg.norm(ends.states[:, :3] - self.optimum.position_m, axis=1),
            "status": _status(ends, scenario.method.reached(ends, self.optimum.chi2, self.optimum.position_m)),
            "half": half,
        }


@dataclass(frozen=True)
class StartsSummary(Summary):
    """Counts of a map over starts, and fractions of its parts that converged.

    The fraction is NaN for a part without starts.

    Attributes
    ----------
    front_fraction, back_fraction : float
        In front of the plane through the array, and behind it.
    front_within_13m_fraction, beyond_20m_fraction : float
        By the distance from the array's centroid: the published figure is a half ball.
    """

    front_fraction: float
    back_fraction: float
    front_within_13m_fraction: float
    beyond_20m_fraction: float

    def lines(self) -> list[str]:
        """Return the counts in words."""
        fractions = {
            "front half": self.front_fraction,
            "back half": self.back_fraction,
            "in front within 13 m": self.front_within_13m_fraction,
            "beyond 20 m": self.beyond_20m_fraction,
        }
        parts = [f"{part} {fraction:.1%}" for part, fraction in fractions.items() if not np.isnan(fraction)]
        return [
            f"{self.converged} of {self.starts} starts converged ({self.fraction:.1%}): {', '.join(parts)}, "
            f"median {self.median_iterations:.0f} passes"
        ]


def _tally(centroid_m: FloatArray, values: Values) -> Tally:
    """Return the counts of a part of a map over starts."""
    converged = values["status"] == StartStatus.CONVERGED
    front = values["half"] == 1
    offsets = np.meshgrid(
        *(values[name] - centre for name, centre in zip("xyz", centroid_m, strict=True)), indexing="ij"
    )
    distance = np.linalg.norm(offsets, axis=0)
    parts = {
        "front": front,
        "back": values["half"] == -1,
        "front within 13 m": front & (distance <= 13.0),
        "beyond 20 m": distance > 20.0,
    }
    points = {"starts": np.ones_like(converged), "converged": converged, **parts}
    points |= {f"converged {name}": converged & part for name, part in parts.items()}
    return Tally.of(points, values["iterations"])


def convergence_map(
    array: SensorArray,
    source: Source,
    *,
    method: str | Filter = "repeated",
    edge_m: float = 40.0,
    n: int = 41,
    noise_seed: int | None = None,
    out: str | PathLike[str] | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Run a filter from every start of a cube around the origin of the array's frame.

    Parameters
    ----------
    array : SensorArray
        Vector sensors.
    source : Source
        Only its position and moment are used.
    method : str or Filter
        "repeated", "iekf", "damped" or "global" with their default settings, or a filter of
        :mod:`magloc.convergence.filters`.
    edge_m : float
        Edge of the cube, which is centred on the origin of the array's frame [m].
    n : int
        Starts along every axis, at least 2. The moment always starts at zero.
    noise_seed : int, optional
        Seed of one realisation of the sensors' noise, the same for all starts; without it readings are noise-free.
    out : path-like, optional
        Folder of a zarr store for the map. Finished parts that it has are not computed again.
    scheduler : str, optional
        Address of a dask scheduler, whose workers compute the map.
    progress : callable, optional
        Called with the number of starts finished since the last call.

    Returns
    -------
    xarray.Dataset
        Over the start's (x, y, z) [m]: ``iterations``, ``chi2``, ``distance`` to the maximum-likelihood position [m],
        ``status`` with flag meanings, ``half`` (1 front, -1 back, 0 on the plane through the centroid); attributes that
        reproduce the run.

    Raises
    ------
    ValueError
        The array has scalar sensors or too few of them, its readings have no unique best fit, or an input is out of
        range.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> source = magloc.Source([5.0, 0.0, 0.3], [100.0, 0.0, 0.0])
    >>> ends = magloc.convergence_map(arrays.tetrahedron(0.45), source, edge_m=20.0, n=5)
    >>> int((ends.status == 0).sum()), ends.status.size
    (58, 125)
    """
    if isinstance(method, str) and method not in FILTERS:
        raise ValueError(f"Input method must be one of {', '.join(FILTERS)}; instead received {method!r}.")
    (x, y, z), (mx, my, mz) = source.position_m.tolist(), source.moment_Am2.tolist()
    chosen = FILTERS[method] if isinstance(method, str) else method
    scenario = StartsScenario(array, (x, y, z), (mx, my, mz), check_half_width(edge_m), chosen, noise_seed)
    return computed_map(StartsMap.of(scenario, n), out, scheduler, progress)


def _status(ends: FilterEnds, reached: NDArray[np.bool_]) -> NDArray[np.int8]:
    status = np.where(ends.stopped, StartStatus.OTHER_OPTIMUM, StartStatus.NOT_STOPPED)
    status = np.where(np.isfinite(ends.chi2), status, StartStatus.DIVERGED)
    return np.where(reached, StartStatus.CONVERGED, status).astype(np.int8)


def _attribute(value: Any) -> Any:
    return int(value) if isinstance(value, bool) else value  # netCDF has no booleans


def summary(dataset: xr.Dataset) -> StartsSummary:
    """Return the counts of a map by :func:`convergence_map`, which need not fit into memory."""
    centroid_m = np.asarray(dataset.attrs["centroid_m"])
    tally = tallied(dataset, ("status", "half", "iterations", "x", "y", "z"), partial(_tally, centroid_m))
    return StartsSummary(
        **common_counts(dataset, tally),
        front_fraction=tally.fraction("converged front", "front"),
        back_fraction=tally.fraction("converged back", "back"),
        front_within_13m_fraction=tally.fraction("converged front within 13 m", "front within 13 m"),
        beyond_20m_fraction=tally.fraction("converged beyond 20 m", "beyond 20 m"),
    )
