"""Unknowns of an array's sensors, and what every problem of their calibration has.

Sensor i reads ``(I + E_i) K_i B_i + o_i + h_i`` in the field :math:`B_i` at its true position, with the names of
docs/theory/calibration.md. The unit of the unknowns is their prior standard deviation.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray

PER_SENSOR = 15
POSITION, GAINS, AXES, OFFSET = slice(0, 3), slice(3, 6), slice(6, 12), slice(12, 15)
AXIS_PAIRS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Channel and component of the six axis unknowns."""
_CHANNEL, _COMPONENT = (list(places) for places in zip(*AXIS_PAIRS, strict=True))
_EXACT_T = 1e-15  # least standard deviation of the common field


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Whitened residuals and their derivatives.

    Attributes
    ----------
    residual : ndarray, shape (T, C)
        (prediction - reading) / noise; zero where missing.
    by_sensor : ndarray, shape (T, N, 3, 15)
        Derivatives by the unknowns of the channel's sensor, in prior standard deviations.
    by_source : ndarray, shape (T, C, g)
        Derivatives by the other unknowns that all rows share, such as a constant moment.
    by_row : ndarray, shape (T, C, n)
        Derivatives by the unknowns of the row, such as position, moment and common field.
    """

    residual: FloatArray
    by_sensor: FloatArray
    by_source: FloatArray
    by_row: FloatArray


class SensorState(Protocol):
    """Values of all unknowns, among them those of the sensors."""

    @property
    def sensors(self) -> FloatArray:
        """Displacement [m], relative gains, axes [rad], offset [T] of every sensor, (N, 15), from the nominal array."""


State = TypeVar("State", bound=SensorState)


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorProblem(ABC, Generic[State]):
    """Readings of an array, and which quantities of its sensors are unknown.

    Attributes
    ----------
    array : SensorArray
        Nominal array of vector sensors.
    readings_T : ndarray, shape (T, C)
        Raw readings; NaN where missing.
    noise_T : ndarray, shape (T, C)
        Standard deviations.
    prior : ndarray, shape (N, 15)
        Standard deviations of the sensors' unknowns around the nominal array.
    free : ndarray of bool, shape (N, 15)
        True for the sensors' unknowns that are estimated.
    noise_scale : float
        Factor by which residuals exceed the stated noise.
    """

    array: SensorArray
    readings_T: FloatArray
    noise_T: FloatArray
    prior: FloatArray
    free: BoolArray
    noise_scale: float = 1.0

    @property
    def weight(self) -> FloatArray:
        """1/σ of the readings (T, C); zero where a reading is missing."""
        return np.where(np.isfinite(self.readings_T), 1.0 / (self.noise_scale * self.noise_T), 0.0)

    @property
    @abstractmethod
    def n_globals(self) -> int:
        """Number of unknowns that all rows share, besides those of the sensors."""

    @property
    @abstractmethod
    def n_numbers(self) -> int:
        """Number of readings and priors of the rows, minus the unknowns of the rows."""

    @property
    def field_doubt(self) -> float:
        """Relative error of the field that the prior allows.

        It contains wrong gains, and the change of the field between nominal and true position. At a source one
        circumradius away this change is three times the displacement over that distance.
        """
        deviations = np.where(self.free, self.prior, 0.0)
        displaced = 3.0 * deviations[:, POSITION].max() / self.array.circumradius
        return float(np.hypot(deviations[:, GAINS].max(), displaced))

    @property
    def common_weight(self) -> float:
        """1/σ of the prior of the common field, per axis [1/T]; 0 without a prior."""
        sigma_T = self.array.common_field_T
        return 0.0 if sigma_T is None else 1.0 / max(sigma_T, _EXACT_T)

    @property
    def estimated_indices(self) -> NDArray[np.intp]:
        """Indices of the estimated unknowns among the 15 N of the sensors and the g that all rows share."""
        n = self.free.size
        return np.concatenate([np.flatnonzero(self.free.ravel()), np.arange(n, n + self.n_globals)])

    @abstractmethod
    def linearise(self, state: State) -> Linearisation:
        """Return the residuals of a state and their derivatives by every unknown."""

    @abstractmethod
    def row_priors(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Return 1/σ of the prior of the rows' unknowns, 0 without a prior, and their deviations from it, (T, n)."""

    @abstractmethod
    def prediction_T(self, state: State) -> FloatArray:
        """Return the predicted readings, shape (T, C) [T]."""

    @abstractmethod
    def after_step(self, state: State, step: FloatArray, of_rows: FloatArray) -> State:
        """Return a state after a step (P,) of the estimated shared unknowns, and (T, n) of those of the rows."""

    def shared_deviations(self, state: State) -> FloatArray:
        """Return the estimated shared unknowns that have a prior (p,), in standard deviations; they come first."""
        return np.asarray((state.sensors / self.prior)[self.free])

    def sensors_after_step(self, state: State, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sensors' unknowns (N, 15) after a step (P,), and the part of the step of the other unknowns."""
        n = int(self.free.sum())
        sensors = state.sensors.copy()
        sensors[self.free] += self.prior[self.free] * step[:n]
        return sensors, step[n:]

    def residual_rms_T(self, state: State) -> FloatArray:
        """Return the root mean square (N,) of every sensor's residuals [T]."""
        residual = self.residuals(self.prediction_T(state)) * self.noise_scale * self.noise_T
        squares = (residual**2).reshape(len(residual), -1, 3)
        counts = np.isfinite(self.readings_T).reshape(squares.shape).sum(axis=(0, 2))
        return np.asarray(np.sqrt(squares.sum(axis=(0, 2)) / np.maximum(counts, 1)))

    def chi2(self, state: State) -> float:
        """Return χ² of the readings, and of the priors of the rows."""
        weight, deviation = self.row_priors(state)
        return float(np.sum(self.residuals(self.prediction_T(state)) ** 2) + np.sum((weight * deviation) ** 2))

    def cost(self, state: State) -> float:
        """Return χ² of the readings and of all priors."""
        return self.chi2(state) + float(np.sum(self.shared_deviations(state) ** 2))

    def residuals(self, prediction_T: FloatArray) -> FloatArray:
        """Return the whitened residuals (T, C) of predicted readings; zero where a reading is missing."""
        return np.where(np.isfinite(self.readings_T), self.weight * (prediction_T - self.readings_T), 0.0)


def responses(array: SensorArray, sensors: FloatArray) -> FloatArray:
    """Return (I + E) K of every sensor, (N, 3, 3), from its unknowns (N, 15).

    It maps a field in the array's frame to a reading.
    """
    return response_factors(sensors) @ array.channel_gain.reshape(-1, 3, 3)


def response_factors(sensors: FloatArray) -> FloatArray:
    """Return I + E of every sensor, shape (N, 3, 3), from its unknowns (N, 15)."""
    factors = np.tile(np.eye(3), (len(sensors), 1, 1))
    factors[:, range(3), range(3)] += sensors[:, GAINS]
    factors[:, _CHANNEL, _COMPONENT] = sensors[:, AXES]
    return factors


def unknowns(
    n_sensors: int,
    *,
    position: FloatArray | float = 0.0,
    response: FloatArray | None = None,
    offset: FloatArray | float = 0.0,
) -> FloatArray:
    """Return changes of positions (N, 3), responses E (N, 3, 3) and offsets (N, 3) as (N, 15)."""
    result = np.zeros((n_sensors, PER_SENSOR))
    result[:, POSITION], result[:, OFFSET] = position, offset
    if response is not None:
        result[:, GAINS] = np.diagonal(response, axis1=-2, axis2=-1)
        result[:, AXES] = response[..., _CHANNEL, _COMPONENT]
    return result


def readings_of_fields(array: SensorArray, sensors: FloatArray, fields_T: FloatArray) -> FloatArray:
    """Return the readings (T, C) of an array with changed sensors (N, 15) in fields (T, N, 3) [T]."""
    readings = np.einsum("iab,tib->tia", responses(array, sensors), fields_T) + sensors[:, OFFSET]
    return readings.reshape(len(fields_T), -1) + array.channel_offset_T


def whitened_responses(problem: SensorProblem[State], sensors: FloatArray) -> FloatArray:
    """Return the derivatives (T, N, 3, 3) of whitened readings by the field at each sensor."""
    return problem.weight.reshape(-1, len(sensors), 3, 1) * responses(problem.array, sensors)


def sensor_derivatives(
    problem: SensorProblem[State], sensors: FloatArray, fields_T: FloatArray, gradients_T_m: FloatArray
) -> FloatArray:
    """Return the derivatives (T, N, 3, 15) of whitened readings by the unknowns of their sensors.

    Fields (T, N, 3) contain the common field. The unit of an unknown is its prior standard deviation; the derivative
    by an unknown that is not estimated is zero.
    """
    nominal = np.einsum("iab,tib->tia", problem.array.channel_gain.reshape(-1, 3, 3), fields_T)
    by_sensor = np.zeros((*fields_T.shape, PER_SENSOR))
    by_sensor[..., POSITION] = responses(problem.array, sensors) @ gradients_T_m
    by_sensor[..., GAINS] = nominal[..., None] * np.eye(3)
    by_sensor[..., _CHANNEL, range(AXES.start, AXES.stop)] = nominal[..., _COMPONENT]
    by_sensor[..., OFFSET] = np.eye(3)
    by_sensor *= problem.weight.reshape(*fields_T.shape, 1)
    by_sensor *= np.where(problem.free, problem.prior, 0.0)[:, None, :]
    return by_sensor
