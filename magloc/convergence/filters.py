"""Filters of the convergence maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.convergence.ends import DAMPED, ITERATED, RELINEARISED, REPEATED, FilterEnds, ScaledDifferences, ends
from magloc.localization.search.single_source import SingleSourceSearch
from magloc.measurement.differences import DifferenceMeasurement

# Largest excess over the maximum-likelihood χ² of an end that counts as converged.
CHI2_REACHED = 0.05
# Largest distance from the maximum-likelihood position for a filter with a prior.
PRIOR_REACHED_M = 0.5
_PASS_S = 4e-8


class Filter(Protocol):
    """Interface of a filter for convergence maps."""

    @property
    def name(self) -> str:
        """Name on the command line."""

    @property
    def max_iterations(self) -> int:
        """Largest number of passes."""

    @property
    def pass_s(self) -> float:
        """Approximate time of one core for a pass over nine differences [s]."""

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> FilterEnds:
        """Return the end of every start (n, 6) for the decorrelated differences z (k,)."""

    def reached(self, ends: FilterEnds, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """Return which ends are the maximum-likelihood optimum."""


class _PositiveSettings:
    """Dataclass with positive numbers; a tolerance of zero makes all passes."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name == "device":
                if value != "cpu":
                    raise ValueError(f"Input device must be cpu: filters run on no other; instead received {value!r}.")
            elif not (value > 0 or isinstance(value, bool) or (value == 0 and name == "tolerance_T")):
                raise ValueError(f"Input {name} must be positive; instead received {value}.")


class _LikelihoodFilter(_PositiveSettings):
    """Filter that maximises the likelihood."""

    def reached(self, ends: FilterEnds, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """Return which ends stopped with the χ² of the maximum-likelihood optimum."""
        return ends.stopped & (ends.chi2 < chi2_optimum + CHI2_REACHED)


@dataclass(frozen=True)
class _PriorFilter(_PositiveSettings):
    """Filter with a Gaussian prior around the start, with standard deviations per axis."""

    position_sigma_m: float = 3.0
    moment_sigma_Am2: float = 300.0
    pass_s: ClassVar[float] = _PASS_S

    def reached(self, ends: FilterEnds, chi2_optimum: float, position_optimum: FloatArray) -> NDArray[np.bool_]:
        """Return which ends stopped near the maximum-likelihood position.

        The prior biases its optimum, so that χ² differs.
        """
        distance = np.linalg.norm(ends.states[:, :3] - position_optimum, axis=1)
        return ends.stopped & (distance < PRIOR_REACHED_M)


@dataclass(frozen=True)
class RepeatedFilter(_LikelihoodFilter):
    r"""Extended Kalman filter that processes the same readings again and again.

    Attributes
    ----------
    position_step_m, moment_step_Am2 : float
        Diagonal of :math:`S_q`; :math:`S_q S_q^T` is the first covariance, and is added before every pass.
    noise_inflation : float
        Factor on the variances of the readings inside the filter.
    relinearise_every_scalar : bool
        Linearise before every scalar rather than once a pass.
    tolerance_T : float
        Stop when the predicted differences change by less than this between passes [T].
    max_iterations : int
        Passes at most.
    device : str
        "cpu"; the next release will not have this setting.

    Examples
    --------
    >>> import arrays, magloc
    >>> board, source = arrays.tetrahedron(1.5), magloc.Source((2.0, 0.0, 0.0), (30.0, 0.0, 0.0))
    >>> cautious = magloc.RepeatedFilter(position_step_m=0.01)
    >>> dataset = magloc.convergence_map(board, source, method=cautious, edge_m=4.0, n=3)
    >>> dataset["status"].shape
    (3, 3, 3)
    """

    name: ClassVar[str] = "repeated"
    position_step_m: float = 0.1
    moment_step_Am2: float = 100.0
    noise_inflation: float = 1.0
    relinearise_every_scalar: bool = False
    tolerance_T: float = 1e-12
    max_iterations: int = 200
    device: str = "cpu"

    @property
    def pass_s(self) -> float:
        """Approximate time of one core for a pass over nine differences [s]."""
        return 2e-6 if self.relinearise_every_scalar else _PASS_S

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> FilterEnds:
        """Return the end of every start (n, 6)."""
        z, variance, sensors, weights = _inputs(measurement, z)
        inflation = self.noise_inflation
        each = self.relinearise_every_scalar
        scaled = ScaledDifferences.from_weights if each else ScaledDifferences.of
        differences = scaled(z, inflation * variance, sensors, weights, self.position_step_m, self.moment_step_Am2)
        method = RELINEARISED if each else REPEATED
        found = ends(method, differences, starts, self.tolerance_T, self.max_iterations)
        return found._replace(chi2=inflation * found.chi2)


@dataclass(frozen=True)
class IekfFilter(_PriorFilter):
    """Iterated extended Kalman filter with the start as the mean of its prior.

    Attributes
    ----------
    position_sigma_m, moment_sigma_Am2 : float
        Standard deviations of the prior around the start, per axis.
    tolerance_T : float
        Stop when the predicted differences change by less than this between iterations [T].
    max_iterations : int
        Linearisations at most.
    device : str
        "cpu"; the next release will not have this setting.
    """

    name: ClassVar[str] = "iekf"
    tolerance_T: float = 1e-12
    max_iterations: int = 200
    device: str = "cpu"

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> FilterEnds:
        """Return the end of every start (n, 6)."""
        differences = ScaledDifferences.of(*_inputs(measurement, z), self.position_sigma_m, self.moment_sigma_Am2)
        return ends(ITERATED, differences, starts, self.tolerance_T, self.max_iterations)


@dataclass(frozen=True)
class DampedFilter(_PriorFilter):
    r"""Levenberg-Marquardt iteration that lowers the cost of :class:`IekfFilter` in each step.

    A step solves :math:`(M + \lambda\,\mathrm{diag} M)\,\delta = -\nabla` with :math:`M = H^T R^{-1} H + P_0^{-1}` and
    the gradient of half the cost. A step that lowers the cost is accepted and divides the damping λ by 5; any other
    step is rejected and multiplies λ by 4. Where Gauss-Newton steps do not converge, this iteration stops at an
    optimum; with a wide prior it is the likelihood's.

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
        Largest number of linearisations, including those at rejected states.
    device : str
        "cpu"; the next release will not have this setting.

    Notes
    -----
    D. W. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11 (1963).
    """

    name: ClassVar[str] = "damped"
    first_damping: float = 1.0
    tolerance_T: float = 1e-12
    max_iterations: int = 200
    device: str = "cpu"

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> FilterEnds:
        """Return the end of every start (n, 6)."""
        differences = ScaledDifferences.of(*_inputs(measurement, z), self.position_sigma_m, self.moment_sigma_Am2)
        return ends(DAMPED, differences, starts, self.tolerance_T, self.max_iterations, self.first_damping)


@dataclass(frozen=True)
class GlobalFilter(_LikelihoodFilter):
    """Start-free search (:class:`~magloc.localization.search.single_source.SingleSourceSearch`).

    It refines the map's start before its candidates.

    Attributes
    ----------
    max_iterations : int
        Linearisations of one refinement at most. The map counts those of all refinements of a start together.
    """

    name: ClassVar[str] = "global"
    max_iterations: int = 100
    pass_s: ClassVar[float] = 5e-7

    def run(self, measurement: DifferenceMeasurement, z: FloatArray, starts: FloatArray) -> FilterEnds:
        """Return the best end of every start (n, 6).

        :mod:`magloc.measurement.whitened` is the readable reference of its cost.
        """
        array = measurement.array
        # Any readings with these differences have the same likelihood.
        readings = np.linalg.lstsq(measurement.differences.transform, z, rcond=None)[0] + array.channel_offset_T
        ends = SingleSourceSearch(array, max_iterations=self.max_iterations).optima_from(readings, starts[:, :3])
        return FilterEnds(
            states=np.concatenate([ends.position_m, ends.moment_Am2], axis=1),
            chi2=ends.chi2,
            iterations=ends.linearisations,
            stopped=np.isfinite(ends.chi2),
        )


# Every method of a map by its name, with its default settings; scenario files and the command line take them from here.
FILTERS: dict[str, Filter] = {
    method.name: method for method in (RepeatedFilter(), IekfFilter(), DampedFilter(), GlobalFilter())
}


def settings(method: Filter) -> dict[str, Any]:
    """Return the settings of a filter that its ends depend on."""
    return {name: value for name, value in vars(method).items() if name != "device"}


def _inputs(measurement: DifferenceMeasurement, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return differences without the ambient field, variances, sensors and weights."""
    array = measurement.array
    of_source = z - measurement.measured(array.readings_of(array.ambient_fields))
    return of_source, measurement.variance, array.positions, field_weights(measurement)


def field_weights(measurement: DifferenceMeasurement) -> FloatArray:
    """Return the weights (k, N, 3) of vector sensors' fields in the decorrelated differences."""
    array = measurement.array
    weights = np.zeros((measurement.variance.size, array.n_sensors, 3))
    for c, sensor in enumerate(array.channel_sensor):
        weights[:, sensor] += measurement.differences.transform[:, c, None] * array.channel_gain[c]
    return weights
