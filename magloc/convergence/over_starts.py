r"""Convergence maps: from which starts does a dipole filter find the source?

One source, one set of readings, a cube of starts (the moment always starts at zero). Two filters of the source paper's
kind, one that takes no step uphill and one that needs no start, and a map of how they end:

* :class:`RepeatedFilter`: the same readings are processed again and again by an extended Kalman filter whose covariance
  grows by :math:`S_q S_q^T` before every pass. It forgets its start, so where it stops is a maximum of the likelihood.
* :class:`IekfFilter`: the iterated extended Kalman filter with the start as the mean of a prior.
* :class:`DampedFilter`: the same cost as the latter's, by Levenberg-Marquardt steps.
* :class:`GlobalFilter`: the start-free search.

Source: Pavlov, Karshakov, Goldin, "Determination of the magnetic field parameters of an object from remote
magnetogradient measurements", the function table, equations (19), (30), and the figure of the convergence region.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.geometries import tetrahedron
from arrays.noise import reading_covariance, reading_errors
from magloc.grids.cube import Box, MapSummary, Tally, Values, Variable, histogram, in_memory
from magloc.localization.fit.results import Solution
from magloc.localization.locator import Locator
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels

if TYPE_CHECKING:
    import xarray as xr
from arrays.typing import FloatArray
from magloc.convergence.filters import Ends, Filter, RepeatedFilter


class Status(IntEnum):
    """How a start ended."""

    CONVERGED = 0
    OTHER_OPTIMUM = 1
    NOT_STOPPED = 2
    DIVERGED = 3


@dataclass(frozen=True)
class StartsScenario:
    """One source in front of an array, and a cube of starts around it.

    The defaults are the paper's figure, completed where the paper prints no number.

    Attributes
    ----------
    array : SensorArray
        Vector sensors.
    position_m, moment_Am2 : tuple of 3 floats
        The source.
    half_width_m : float
        The cube reaches from -half_width to +half_width along every axis, around the origin of the array's frame.
    method : Filter
    noise_seed : int, optional
        Of one realisation of the sensors' noise that all starts share; noise-free readings without it.
    """

    array: SensorArray = field(default_factory=lambda: tetrahedron(1.5, noise_T=1e-9))
    position_m: tuple[float, float, float] = (5.0, 0.0, 0.306)
    moment_Am2: tuple[float, float, float] = (100.0, 0.0, 0.0)
    half_width_m: float = 20.0
    method: Filter = field(default_factory=RepeatedFilter)
    noise_seed: int | None = None


def simulated_measurement(scenario: StartsScenario) -> tuple[FloatArray, DifferenceMeasurement, FloatArray]:
    """Readings of a scenario, and what the filters make of them.

    Parameters
    ----------
    scenario : StartsScenario

    Returns
    -------
    readings : ndarray, shape (C,)
        [T]
    measurement : DifferenceMeasurement
        With the noise that goes with these readings.
    z : ndarray, shape (k,)
        Their decorrelated differences [T].
    """
    array = scenario.array
    readings = predicted_channels(array, scenario.position_m, scenario.moment_Am2) + array.channel_offset_T
    if scenario.noise_seed is not None:
        normal = np.random.default_rng(scenario.noise_seed).standard_normal(array.n_channels)
        readings = readings + reading_errors(array, readings, normal)
    differences = decorrelated_differences(array, covariance_T2=reading_covariance(array, readings))
    measurement = DifferenceMeasurement(array, differences)
    return readings, measurement, measurement.measured(readings)


@dataclass(frozen=True, eq=False)
class StartsMap:
    """Map of a filter's ends over a cube of starts, as :class:`magloc.grids.cube.CubeMap`.

    Attributes
    ----------
    scenario : StartsScenario
    grid : int
        Starts along every axis.
    measurement : DifferenceMeasurement
    z : ndarray, shape (k,)
        Decorrelated differences that every start is given [T].
    optimum : Solution
        The best one for them.
    """

    scenario: StartsScenario
    grid: int
    measurement: DifferenceMeasurement
    z: FloatArray
    optimum: Solution

    @classmethod
    def of(cls, scenario: StartsScenario, grid: int) -> StartsMap:
        """Map of a scenario; the arguments and errors of :func:`convergence_map`."""
        if grid < 2:
            raise ValueError(f"Input grid must be at least 2; instead received {grid}.")
        locator = Locator(scenario.array, exclude_faulty=False)
        readings, measurement, z = simulated_measurement(scenario)
        fix = locator.fit(readings)
        if not fix.solutions:
            raise ValueError(f"The scenario's readings have no maximum-likelihood solution: {fix.reason}.")
        return cls(scenario, grid, measurement, z, fix.solutions[0])

    @property
    def edge(self) -> int:
        """Starts along the edges of a box."""
        if self.grid <= 48:  # a second's work at most: a chunk would cost more to write than to compute
            return self.grid
        return 32 if self.grid <= 128 else 64

    @property
    def axis(self) -> FloatArray:
        """Coordinates of the starts [m], shape (grid,)."""
        return np.linspace(-self.scenario.half_width_m, self.scenario.half_width_m, self.grid)

    @property
    def point(self) -> str:
        """What a point is."""
        return "start"

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Variables over the cube."""
        return _VARIABLES

    @property
    def attributes(self) -> Mapping[str, Any]:
        """All that determines the map."""
        from arrays.array_file import array_toml

        scenario = self.scenario
        return {
            "Conventions": "CF-1.10",
            "title": "Convergence of a dipole filter over its starts",
            "source": f"magloc {version('magloc')}",
            "grid": self.grid,
            "method": scenario.method.name,
            **{f"method_{key}": _attribute(value) for key, value in vars(scenario.method).items()},
            "array": array_toml(scenario.array),
            "position_m": np.asarray(scenario.position_m),
            "moment_Am2": np.asarray(scenario.moment_Am2),
            "centroid_m": scenario.array.centroid,
            "half_width_m": scenario.half_width_m,
            "noise_seed": -1 if scenario.noise_seed is None else scenario.noise_seed,
        }

    @property
    def findings(self) -> Mapping[str, Any]:
        """The maximum-likelihood solution that the ends are compared with."""
        return {
            "optimum_position_m": self.optimum.position_m,
            "optimum_moment_Am2": self.optimum.moment_Am2,
            "optimum_chi2": self.optimum.chi2,
        }

    def warm_up(self) -> None:
        """Compile, or load what was compiled."""
        self.scenario.method.run(self.measurement, self.z, np.full((1, 6), self.scenario.half_width_m))

    def values(self, box: Box) -> Values:
        """Ends of the starts of a box."""
        scenario, centroid = self.scenario, self.scenario.array.centroid
        positions = box.points(self.axis)
        starts = np.concatenate([positions, np.zeros_like(positions)], axis=1)
        ends = scenario.method.run(self.measurement, self.z, starts)
        # On a grid the plane itself is hit to rounding only.
        depth = (positions - centroid) @ (np.asarray(scenario.position_m) - centroid)
        half = np.sign(np.where(np.abs(depth) < 1e-9 * scenario.half_width_m**2, 0.0, depth))
        values = {
            "iterations": ends.iterations,
            "chi2": ends.chi2,
            "distance": np.linalg.norm(ends.states[:, :3] - self.optimum.position_m, axis=1),
            "status": _status(ends, scenario.method.reached(ends, self.optimum.chi2, self.optimum.position_m)),
            "half": half,
        }
        return {name: values[name].reshape(box.shape).astype(_VARIABLES[name].dtype) for name in _VARIABLES}

    def tally(self, values: Values) -> Tally:
        """Counts of a part's values."""
        return starts_tally(values)

    def summary(self, tally: Tally, seconds: float) -> MapSummary:
        """Summary of the whole cube."""
        return starts_summary(tally, seconds)


def starts_tally(values: Values) -> Tally:
    """Counts of ``status``, ``half`` and ``iterations`` of a part of a map over starts."""
    converged = values["status"] == Status.CONVERGED
    front, back = values["half"] == 1, values["half"] == -1
    counts = {
        "starts": converged.size,
        "converged": converged.sum(),
        "front": front.sum(),
        "converged front": (converged & front).sum(),
        "back": back.sum(),
        "converged back": (converged & back).sum(),
        "iterations": values["iterations"].sum(dtype=np.int64),
    }
    return Tally(
        Counter({name: int(count) for name, count in counts.items()}), histogram(values["iterations"][converged])
    )


def starts_summary(tally: Tally, seconds: float) -> MapSummary:
    """Summary of a map over starts from its tally."""
    return MapSummary(
        starts=tally.counts["starts"],
        converged=tally.counts["converged"],
        fraction=tally.fraction("converged", "starts"),
        front_fraction=tally.fraction("converged front", "front"),
        back_fraction=tally.fraction("converged back", "back"),
        median_iterations=tally.median_iterations(),
        iterations_total=tally.counts["iterations"],
        seconds=seconds,
    )


def convergence_map(
    scenario: StartsScenario, grid: int = 41, progress: Callable[[int], None] | None = None
) -> xr.Dataset:
    """Run the filter from every start of a cube.

    Parameters
    ----------
    scenario : StartsScenario
    grid : int
        Starts along every axis, at least 2. For maps that do not fit into memory see :mod:`magloc.grids.store`.
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
        The array has scalar sensors or too few of them, or its readings have no unique best fit.
    """
    return in_memory(StartsMap.of(scenario, grid), progress)


def _status(ends: Ends, reached: NDArray[np.bool_]) -> NDArray[np.int8]:
    status = np.where(ends.stopped, Status.OTHER_OPTIMUM, Status.NOT_STOPPED)
    status = np.where(np.isfinite(ends.chi2), status, Status.DIVERGED)
    return np.where(reached, Status.CONVERGED, status).astype(np.int8)


_VARIABLES = {
    "iterations": Variable(np.int32, {"long_name": "passes over the readings", "units": "1"}),
    "chi2": Variable(np.float64, {"long_name": "chi-square at the end", "units": "1"}),
    "distance": Variable(np.float64, {"long_name": "distance from the maximum-likelihood position", "units": "m"}),
    "status": Variable(
        np.int8,
        {
            "long_name": "how the start ended",
            "flag_values": np.array([s.value for s in Status], dtype=np.int8),
            "flag_meanings": " ".join(s.name.lower() for s in Status),
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


def _attribute(value: Any) -> Any:
    return int(value) if isinstance(value, bool) else value  # netCDF has no booleans


def summary(dataset: xr.Dataset) -> MapSummary:
    """Counts of a map made by :func:`convergence_map`."""
    values = {name: dataset[name].to_numpy() for name in ("status", "half", "iterations")}
    return starts_summary(starts_tally(values), float(dataset.attrs["seconds"]))
