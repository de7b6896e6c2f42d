r"""Convergence maps: from which starts does a dipole filter find the source?

One source, one set of readings, a cube of starts (the moment always starts at zero). Two filters of the source paper's
kind, and a map of how they end:

* :class:`RepeatedFilter`: the same readings are processed again and again by an extended Kalman filter whose covariance
  grows by :math:`S_q S_q^T` before every pass. It forgets its start, so where it stops is a maximum of the likelihood.
* :class:`IekfFilter`: the iterated extended Kalman filter with the start as the mean of a prior.

Source: Pavlov, Karshakov, Goldin, "Determination of the magnetic field parameters of an object from remote
magnetogradient measurements", the function table, equations (19), (30), and the figure of the convergence region.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from arrays.geometries import tetrahedron
from arrays.sensor import SensorArray
from magloc.kalman import IteratedUpdate, iterated_update, predict_square_root, scalar_update, sequential_update
from magloc.kernels import starts as kernels
from magloc.locate import Locator, Solution
from magloc.measurement import DifferenceMeasurement, predicted_channels

if TYPE_CHECKING:
    import xarray as xr

FloatArray = NDArray[np.float64]

# χ² above the maximum-likelihood χ² within which a stop counts as having reached it.
CHI2_REACHED = 0.05
# Distance from the maximum-likelihood position that a filter with a prior may keep.
PRIOR_REACHED_M = 0.5
_STARTS_AT_ONCE = 4096


class Status(IntEnum):
    """How a start ended."""

    CONVERGED = 0
    OTHER_OPTIMUM = 1
    NOT_STOPPED = 2
    DIVERGED = 3


@dataclass(frozen=True, eq=False)
class Ends:
    """Ends of many starts.

    Attributes
    ----------
    states : ndarray, shape (n, 6)
        (position [m], moment [A·m²]).
    chi2 : ndarray, shape (n,)
    iterations : ndarray of int, shape (n,)
        Passes over the readings.
    stopped : ndarray of bool, shape (n,)
        Whether the stop rule was met.
    """

    states: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    stopped: NDArray[np.bool_]


class Filter(Protocol):
    """What a map needs of a filter."""

    @property
    def name(self) -> str:
        """Name on the command line."""

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> Ends:
        """End of every start (n, 6) for the decorrelated differences z (k,)."""

    def reached(self, ends: Ends, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """Which of the ends are the maximum-likelihood optimum."""


@dataclass(frozen=True)
class RepeatedFilter:
    r"""Extended Kalman filter that processes the same readings again and again.

    Attributes
    ----------
    position_step_m, moment_step_Am2 : float
        Diagonal of :math:`S_q`, which is added before every pass; the first covariance is :math:`S_q S_q^T` as well.
    noise_inflation : float
        Factor on the variances of the readings inside the filter.
    relinearise_every_scalar : bool
        Linearise before every scalar rather than once a pass.
    tolerance_T : float
        Stop when the predicted differences change by less than this between passes [T].
    max_iterations : int
        Passes at most.
    """

    position_step_m: float = 0.1
    moment_step_Am2: float = 100.0
    noise_inflation: float = 1.0
    relinearise_every_scalar: bool = False
    tolerance_T: float = 1e-12
    max_iterations: int = 200

    @property
    def name(self) -> str:
        """Name on the command line."""
        return "repeated"

    @property
    def s_q(self) -> FloatArray:
        """Diagonal of the square root of the process noise, shape (6,)."""
        return np.repeat([self.position_step_m, self.moment_step_Am2], 3)

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> Ends:
        """End of every start (n, 6), compiled; :meth:`run_one` is the readable twin."""
        return Ends(
            *kernels.repeated_map(
                starts,
                z,
                measurement.variance,
                self.noise_inflation,
                self.s_q,
                self.relinearise_every_scalar,
                self.tolerance_T,
                self.max_iterations,
                measurement.array.positions,
                field_weights(measurement),
            )
        )

    def run_one(self, measurement: DifferenceMeasurement, z: FloatArray, start: FloatArray) -> IteratedUpdate:
        """End of one start (6,), by the square-root filter of :mod:`magloc.kalman`."""
        variance = self.noise_inflation * measurement.variance
        x, S, S_q = start, np.diag(self.s_q), np.diag(self.s_q)
        predicted = measurement.predicted(x[:3], x[3:])
        innovation = z - predicted
        for iteration in range(1, self.max_iterations + 1):
            S = predict_square_root(S, np.eye(6), S_q)
            if self.relinearise_every_scalar:
                for j in range(z.size):
                    nu = z[j] - measurement.predicted(x[:3], x[3:])[j]
                    x, S = scalar_update(x, S, measurement.jacobian(x[:3], x[3:])[j], float(nu), float(variance[j]))
            else:
                x, S = sequential_update(x, S, measurement.jacobian(x[:3], x[3:]), z - predicted, variance)
            predicted, before = measurement.predicted(x[:3], x[3:]), predicted
            change = float(np.linalg.norm(predicted - before))
            if not np.isfinite(change) or change < self.tolerance_T:
                return IteratedUpdate(x, S, iteration, change < self.tolerance_T, innovation, np.nan)
        return IteratedUpdate(x, S, self.max_iterations, False, innovation, np.nan)

    def reached(self, ends: Ends, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """Stopped with the χ² of the maximum-likelihood optimum."""
        return ends.stopped & (ends.chi2 < chi2_optimum + CHI2_REACHED)


@dataclass(frozen=True)
class IekfFilter:
    """Iterated extended Kalman filter with the start as the mean of its prior.

    Attributes
    ----------
    position_sigma_m, moment_sigma_Am2 : float
        Standard deviations of the prior around the start, per axis.
    tolerance_T : float
        Stop when the predicted differences change by less than this between iterations [T].
    max_iterations : int
        Linearisations at most.
    """

    position_sigma_m: float = 3.0
    moment_sigma_Am2: float = 300.0
    tolerance_T: float = 1e-12
    max_iterations: int = 200

    @property
    def name(self) -> str:
        """Name on the command line."""
        return "iekf"

    @property
    def s_0(self) -> FloatArray:
        """Diagonal of the square root of the prior covariance, shape (6,)."""
        return np.repeat([self.position_sigma_m, self.moment_sigma_Am2], 3)

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> Ends:
        """End of every start (n, 6), compiled; :meth:`run_one` is the readable twin."""
        return Ends(
            *kernels.iekf_map(
                starts,
                z,
                measurement.variance,
                self.s_0,
                self.tolerance_T,
                self.max_iterations,
                measurement.array.positions,
                field_weights(measurement),
            )
        )

    def run_one(self, measurement: DifferenceMeasurement, z: FloatArray, start: FloatArray) -> IteratedUpdate:
        """End of one start (6,), by :func:`magloc.kalman.iterated_update`."""
        return iterated_update(
            start,
            np.diag(self.s_0),
            z,
            measurement.variance,
            lambda x: measurement.predicted(x[:3], x[3:]),
            lambda x: measurement.jacobian(x[:3], x[3:]),
            tolerance=self.tolerance_T,
            max_iterations=self.max_iterations,
        )

    def reached(self, ends: Ends, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """Stopped at the prior's own optimum, near the maximum-likelihood position (the prior pulls, so χ² differs)."""
        distance = np.linalg.norm(ends.states[:, :3] - position_optimum, axis=1)
        return ends.stopped & (distance < PRIOR_REACHED_M)


def field_weights(measurement: DifferenceMeasurement) -> FloatArray:
    """Weight of the field at every sensor in every decorrelated difference, shape (k, N, 3), for vector sensors."""
    array = measurement.array
    weights = np.zeros((measurement.variance.size, array.n_sensors, 3))
    for c, sensor in enumerate(array.channel_sensor):
        weights[:, sensor] += measurement.differences.transform[:, c, None] * array.channel_gain[c]
    return weights


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


def simulated_differences(
    scenario: StartsScenario, measurement: DifferenceMeasurement
) -> tuple[FloatArray, FloatArray]:
    """Readings (C,) [T] of the scenario, and their decorrelated differences (k,) [T]."""
    array = scenario.array
    readings = predicted_channels(array, scenario.position_m, scenario.moment_Am2) + array.channel_offset_T
    if scenario.noise_seed is not None:
        readings = readings + np.random.default_rng(scenario.noise_seed).normal(scale=array.channel_noise_T)
    return readings, measurement.measured(readings)


def convergence_map(
    scenario: StartsScenario, grid: int = 41, progress: Callable[[int], None] | None = None
) -> xr.Dataset:
    """Run the filter from every start of a cube.

    Parameters
    ----------
    scenario : StartsScenario
    grid : int
        Starts along every axis, at least 2.
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
    if grid < 2:
        raise ValueError(f"Input grid must be at least 2; instead received {grid}.")
    measurement = DifferenceMeasurement.of(scenario.array)
    readings, z = simulated_differences(scenario, measurement)
    fix = Locator(scenario.array).fit(readings)
    if not fix.solutions:
        raise ValueError(f"The scenario's readings have no maximum-likelihood solution: {fix.reason}.")
    optimum = fix.solutions[0]
    axis = np.linspace(-scenario.half_width_m, scenario.half_width_m, grid)
    starts = np.zeros((grid**3, 6))
    starts[:, :3] = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    scenario.method.run(measurement, z, starts[:1])  # compiles, or loads what was compiled
    parts = []
    began = time.perf_counter()
    for begin in range(0, len(starts), _STARTS_AT_ONCE):
        parts.append(scenario.method.run(measurement, z, starts[begin : begin + _STARTS_AT_ONCE]))
        if progress is not None:
            progress(len(parts[-1].chi2))
    seconds = time.perf_counter() - began
    ends = Ends(
        states=np.concatenate([part.states for part in parts]),
        chi2=np.concatenate([part.chi2 for part in parts]),
        iterations=np.concatenate([part.iterations for part in parts]),
        stopped=np.concatenate([part.stopped for part in parts]),
    )
    return _dataset(scenario, axis, starts[:, :3], ends, optimum, seconds)


def _status(ends: Ends, reached: NDArray[np.bool_]) -> NDArray[np.int8]:
    status = np.where(ends.stopped, Status.OTHER_OPTIMUM, Status.NOT_STOPPED)
    status = np.where(np.isfinite(ends.chi2), status, Status.DIVERGED)
    return np.where(reached, Status.CONVERGED, status).astype(np.int8)


def _dataset(
    scenario: StartsScenario, axis: FloatArray, starts: FloatArray, ends: Ends, optimum: Solution, seconds: float
) -> xr.Dataset:
    import xarray as xr

    from arrays.files import array_toml

    shape = (axis.size,) * 3
    status = _status(ends, scenario.method.reached(ends, optimum.chi2, optimum.position_m))
    centroid = scenario.array.centroid
    # On a grid the plane itself is hit to rounding only.
    depth = (starts - centroid) @ (np.asarray(scenario.position_m) - centroid)
    half = np.sign(np.where(np.abs(depth) < 1e-9 * scenario.half_width_m**2, 0.0, depth)).astype(np.int8)
    distance = np.linalg.norm(ends.states[:, :3] - optimum.position_m, axis=1)

    def variable(values: NDArray[Any], **attributes: Any) -> tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]:
        return ("x", "y", "z"), values.reshape(shape), attributes

    return xr.Dataset(
        {
            "iterations": variable(ends.iterations.astype(np.int32), long_name="passes over the readings", units="1"),
            "chi2": variable(ends.chi2, long_name="chi-square at the end", units="1"),
            "distance": variable(distance, long_name="distance from the maximum-likelihood position", units="m"),
            "status": variable(
                status,
                long_name="how the start ended",
                flag_values=np.array([s.value for s in Status], dtype=np.int8),
                flag_meanings=" ".join(s.name.lower() for s in Status),
            ),
            "half": variable(
                half,
                long_name="side of the plane through the centroid, orthogonal to the source's direction",
                flag_values=np.array([-1, 0, 1], dtype=np.int8),
                flag_meanings="back plane front",
            ),
        },
        coords={
            name: (name, axis, {"long_name": f"start {name}, array frame", "units": "m", "axis": name.upper()})
            for name in ("x", "y", "z")
        },
        attrs={
            "Conventions": "CF-1.10",
            "title": "Convergence of a dipole filter over its starts",
            "source": f"magloc {version('magloc')}",
            "method": scenario.method.name,
            **{f"method_{key}": _attribute(value) for key, value in vars(scenario.method).items()},
            "array": array_toml(scenario.array),
            "position_m": np.asarray(scenario.position_m),
            "moment_Am2": np.asarray(scenario.moment_Am2),
            "centroid_m": scenario.array.centroid,
            "half_width_m": scenario.half_width_m,
            "noise_seed": -1 if scenario.noise_seed is None else scenario.noise_seed,
            "optimum_position_m": optimum.position_m,
            "optimum_moment_Am2": optimum.moment_Am2,
            "optimum_chi2": optimum.chi2,
            "seconds": seconds,
        },
    )


def _attribute(value: Any) -> Any:
    return int(value) if isinstance(value, bool) else value  # netCDF has no booleans


@dataclass(frozen=True)
class MapSummary:
    """Counts of a convergence map.

    Attributes
    ----------
    starts, converged : int
    fraction, front_fraction, back_fraction : float
        Converged starts over all starts, over those in front of the plane and over those behind it.
    median_iterations : float
        Over the converged starts; NaN if there are none.
    iterations_total : int
        Passes of all starts.
    seconds : float
        Duration of the sweep alone.
    """

    starts: int
    converged: int
    fraction: float
    front_fraction: float
    back_fraction: float
    median_iterations: float
    iterations_total: int
    seconds: float


def summary(dataset: xr.Dataset) -> MapSummary:
    """Counts of a map made by :func:`convergence_map`."""
    converged = (dataset["status"] == Status.CONVERGED).to_numpy()
    half = dataset["half"].to_numpy()
    iterations = dataset["iterations"].to_numpy()
    return MapSummary(
        starts=converged.size,
        converged=int(converged.sum()),
        fraction=float(converged.mean()),
        front_fraction=float(converged[half == 1].mean()),
        back_fraction=float(converged[half == -1].mean()),
        median_iterations=float(np.median(iterations[converged])) if converged.any() else float("nan"),
        iterations_total=int(iterations.sum()),
        seconds=float(dataset.attrs["seconds"]),
    )
