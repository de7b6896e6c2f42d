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
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from arrays.differences import decorrelated_differences, reading_covariance, reading_errors
from arrays.geometries import tetrahedron
from arrays.sensor import SensorArray
from magloc.cubes import Box, MapSummary, Tally, Values, Variable, histogram, in_memory
from magloc.fix import Solution
from magloc.kalman import IteratedUpdate, iterated_update, predict_square_root, scalar_update, sequential_update
from magloc.kernels import lanes
from magloc.kernels.starts import relinearised_map
from magloc.locate import Locator
from magloc.measurement import DifferenceMeasurement, predicted_channels

if TYPE_CHECKING:
    import xarray as xr

FloatArray = NDArray[np.float64]

# χ² above the maximum-likelihood χ² within which a stop counts as having reached it.
CHI2_REACHED = 0.05
# Distance from the maximum-likelihood position that a filter with a prior may keep.
PRIOR_REACHED_M = 0.5


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
        run_all = relinearised_map if self.relinearise_every_scalar else lanes.repeated_map
        return Ends(
            *run_all(
                starts,
                _of_source(measurement, z),
                measurement.variance,
                measurement.array.positions,
                field_weights(measurement),
                self.noise_inflation,
                self.position_step_m,
                self.moment_step_Am2,
                self.tolerance_T,
                self.max_iterations,
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
            *lanes.iekf_map(
                starts,
                _of_source(measurement, z),
                measurement.variance,
                measurement.array.positions,
                field_weights(measurement),
                self.position_sigma_m,
                self.moment_sigma_Am2,
                self.tolerance_T,
                self.max_iterations,
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


@dataclass(frozen=True)
class DampedFilter:
    r"""Levenberg-Marquardt iteration on the cost of :class:`IekfFilter`: no accepted step raises it.

    A step solves :math:`(M + \lambda\,\mathrm{diag} M)\,\delta = -\nabla` with :math:`M = H^T R^{-1} H + P_0^{-1}` and
    the gradient of half the cost. One that lowers the cost is taken and divides the damping λ by 5; any other is not,
    and multiplies it by 4. Where Gauss-Newton steps wander without end, this one stops at an optimum; a wide prior
    makes it one of the likelihood.

    Attributes
    ----------
    position_sigma_m, moment_sigma_Am2 : float
        Standard deviations of the prior around the start, per axis.
    first_damping : float
        λ of the first step, positive.
    tolerance_T : float
        A step that changes the predicted differences by less than this [T] is followed by one without damping; if that
        changes them by less as well, stop.
    max_iterations : int
        Linearisations at most, at states that are not taken as well.

    Notes
    -----
    D. W. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11 (1963).
    """

    position_sigma_m: float = 3.0
    moment_sigma_Am2: float = 300.0
    first_damping: float = 1.0
    tolerance_T: float = 1e-12
    max_iterations: int = 200

    @property
    def name(self) -> str:
        """Name on the command line."""
        return "damped"

    @property
    def s_0(self) -> FloatArray:
        """Diagonal of the square root of the prior covariance, shape (6,)."""
        return np.repeat([self.position_sigma_m, self.moment_sigma_Am2], 3)

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> Ends:
        """End of every start (n, 6), compiled; :meth:`run_one` is the readable twin."""
        return Ends(
            *lanes.damped_map(
                starts,
                _of_source(measurement, z),
                measurement.variance,
                measurement.array.positions,
                field_weights(measurement),
                self.position_sigma_m,
                self.moment_sigma_Am2,
                self.first_damping,
                self.tolerance_T,
                self.max_iterations,
            )
        )

    def run_one(self, measurement: DifferenceMeasurement, z: FloatArray, start: FloatArray) -> IteratedUpdate:
        """End of one start (6,), in units of the standard deviations of readings and prior."""
        sigma = np.sqrt(measurement.variance)

        def linearised(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """Predicted differences; residuals of readings and prior, and minus their Jacobian."""
            predicted = measurement.predicted(x[:3], x[3:])
            residual = np.concatenate([(z - predicted) / sigma, (start - x) / self.s_0])
            jacobian = measurement.jacobian(x[:3], x[3:]) * self.s_0 / sigma[:, None]
            return predicted, residual, np.concatenate([jacobian, np.eye(6)])

        x, damping, kept = start, self.first_damping, self.first_damping
        predicted, residual, J = linearised(x)
        innovation = z - predicted
        iteration, ended = 0, False
        while not ended:
            iteration += 1
            # The normal equations of M + λ diag M, without M: its diagonal is the columns' square norm.
            Q, R = np.linalg.qr(np.concatenate([J, np.diag(np.sqrt(damping) * np.linalg.norm(J, axis=0))]))
            trial = x + self.s_0 * np.linalg.solve(R, Q[: residual.size].T @ residual)
            at_trial = linearised(trial)
            change = float(np.linalg.norm(at_trial[0] - predicted))
            small = change < self.tolerance_T
            stopped = small and damping == 0.0
            if at_trial[1] @ at_trial[1] < residual @ residual:
                x, kept = trial, kept / lanes.DAMPING_DECREASE
                predicted, residual, J = at_trial
            else:
                kept *= lanes.DAMPING_INCREASE
            # Damping alone can make a step small: the stop rule is left to the step without it.
            damping = 0.0 if small else kept
            ended = stopped or iteration >= self.max_iterations or not np.all(np.isfinite(residual))
        S: FloatArray = self.s_0[:, None] * np.linalg.inv(np.linalg.qr(J, mode="r"))
        return IteratedUpdate(x, S, iteration, stopped, innovation, np.nan)

    def reached(self, ends: Ends, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """As :meth:`IekfFilter.reached`."""
        distance = np.linalg.norm(ends.states[:, :3] - position_optimum, axis=1)
        return ends.stopped & (distance < PRIOR_REACHED_M)


@dataclass(frozen=True)
class GlobalFilter:
    """The start-free search of :class:`magloc.locate.Locator`, with the map's start refined before its candidates.

    Attributes
    ----------
    max_iterations : int
        Linearisations of one refinement at most. The map counts those of all refinements of a start together.
    """

    max_iterations: int = 100

    @property
    def name(self) -> str:
        """Name on the command line."""
        return "global"

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> Ends:
        """Best end of every start (n, 6), compiled; the readable twin of its cost is :mod:`magloc.separable`."""
        array = measurement.array
        # Any readings with these differences have the same likelihood.
        readings = np.linalg.lstsq(measurement.differences.transform, z, rcond=None)[0] + array.channel_offset_T
        ends = Locator(array, max_iterations=self.max_iterations).fit_from(readings, starts[:, :3])
        return Ends(
            states=np.concatenate([ends.position_m, ends.moment_Am2], axis=1),
            chi2=ends.chi2,
            iterations=ends.linearisations,
            stopped=np.isfinite(ends.chi2),
        )

    def reached(self, ends: Ends, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """Stopped with the χ² of the maximum-likelihood optimum."""
        return ends.stopped & (ends.chi2 < chi2_optimum + CHI2_REACHED)


# Every method of a map by its name, with its default settings; scenario files and the command line take them from here.
FILTERS: dict[str, Filter] = {
    method.name: method for method in (RepeatedFilter(), IekfFilter(), DampedFilter(), GlobalFilter())
}


def _of_source(measurement: DifferenceMeasurement, z: FloatArray) -> FloatArray:
    """Differences (k,) without those of the known ambient field, which the compiled filters do not model."""
    array = measurement.array
    return z - measurement.measured(array.readings_of(array.ambient_fields))


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
    """Map of a filter's ends over a cube of starts, as :class:`magloc.cubes.CubeMap`.

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
        locator = Locator(scenario.array)
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
        from arrays.files import array_toml

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
        Starts along every axis, at least 2. For maps that do not fit into memory see :mod:`magloc.sweep`.
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
