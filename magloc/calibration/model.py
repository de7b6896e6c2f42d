r"""Model of the readings of an array of vector sensors when a source moves past it.

In row t (one instant) sensor i reads, with the names of docs/theory/calibration.md,

.. math:: y_{ti} = (I + E_i) K_i \left( B(s_i + d_i;\, p_t, m_t) + c_t \right) + o_i + h_i.

The unit of the sensors' unknowns is their prior standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.fields import dipole

MomentKind = Literal["constant", "free", "known", "axis"]
"""The moment in the world frame: one unknown vector for all rows, one for every row, known, or of known directions and
one unknown strength."""
PER_SENSOR = 15
POSITION, GAINS, AXES, OFFSET = slice(0, 3), slice(3, 6), slice(6, 12), slice(12, 15)
AXIS_PAIRS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Channel and component of the six axis unknowns."""
_EXACT_M = 1e-7  # least standard deviation of a measured position
_CHANNEL, _COMPONENT = (list(places) for places in zip(*AXIS_PAIRS, strict=True))


@dataclass(frozen=True, eq=False)
class CalibrationState:
    """Values of all unknowns.

    Attributes
    ----------
    sensors : ndarray, shape (N, 15)
        Displacement [m], relative gains, axes [rad], offset [T] of every sensor, as deviations from the nominal array.
    position_m : ndarray, shape (T, 3)
        Source in the array's frame, without the unknown height.
    height_m : float
        Height to add along the world's z.
    moment_Am2 : ndarray, shape (T, 3)
        Moment in the world frame; equal rows if it is constant.
    common_T : ndarray, shape (T, 3)
        Field common to all sensors, in the array's frame.
    """

    sensors: FloatArray
    position_m: FloatArray
    height_m: float
    moment_Am2: FloatArray
    common_T: FloatArray


@dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """Readings, and which quantities of sensors, source and rows are unknown.

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
    world_from_array : ndarray, shape (T, 3, 3)
        Attitude of the array in every row.
    unknown_position : bool
        True if the rows' positions are unknown.
    unknown_height : bool
        True if one height of all rows, along the world's z, is unknown.
    moment : {"constant", "free", "known", "axis"}
    path_m : ndarray, shape (T, 3), optional
        Measured positions of the rows in the array's frame; with `path_sigma_m` unknown positions have a prior.
    path_sigma_m : ndarray, shape (T,), optional
        Standard deviations of the measured positions.
    axis : ndarray, shape (T, 3), optional
        Directions of the moment in the world frame.
    noise_scale : float
        Factor by which residuals exceed the stated noise.
    """

    array: SensorArray
    readings_T: FloatArray
    noise_T: FloatArray
    prior: FloatArray
    free: BoolArray
    world_from_array: FloatArray
    unknown_position: bool
    unknown_height: bool
    moment: MomentKind
    path_m: FloatArray | None = None
    path_sigma_m: FloatArray | None = None
    axis: FloatArray | None = None
    noise_scale: float = 1.0

    @property
    def is_on_path(self) -> bool:
        """True if the positions of the rows are known or measured."""
        return not self.unknown_position or self.path_sigma_m is not None

    @property
    def n_globals(self) -> int:
        """Number of unknowns that all rows share."""
        return 3 * (self.moment == "constant") + (self.moment == "axis") + self.unknown_height

    @property
    def n_numbers(self) -> int:
        """Number of readings and priors of the rows, minus the unknowns of the rows."""
        return int(np.isfinite(self.readings_T).sum()) + (self.n_row_priors - self.n_row_unknowns) * len(self.noise_T)

    @property
    def n_row_priors(self) -> int:
        """Number of unknowns of one row that have a prior."""
        return 3 * (self.path_sigma_m is not None) + 3 * (self.array.common_field_T is not None)

    @property
    def n_row_unknowns(self) -> int:
        """Number of unknowns of one row."""
        return 3 * self.unknown_position + 3 * (self.moment == "free") + 3

    @property
    def estimated_indices(self) -> NDArray[np.intp]:
        """Indices of the estimated unknowns among the 15 N of the sensors and the g of the source."""
        n = self.free.size
        return np.concatenate([np.flatnonzero(self.free.ravel()), np.arange(n, n + self.n_globals)])


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
        Derivatives by the constant moment and the height.
    by_row : ndarray, shape (T, C, n)
        Derivatives by the row's position, moment and common field.
    """

    residual: FloatArray
    by_sensor: FloatArray
    by_source: FloatArray
    by_row: FloatArray


def responses(problem: CalibrationProblem, state: CalibrationState) -> FloatArray:
    """Return (I + E) K of every sensor, (N, 3, 3): from fields in the array's frame to readings."""
    return response_factors(state.sensors) @ problem.array.channel_gain.reshape(-1, 3, 3)


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


def prediction_T(problem: CalibrationProblem, state: CalibrationState) -> FloatArray:
    """Return the predicted readings, shape (T, C) [T]."""
    points, sources, moments = _geometry(problem, state)
    fields = dipole.field(points, sources, moments) + state.common_T[:, None, :]
    readings = np.einsum("iab,tib->tia", responses(problem, state), fields) + state.sensors[:, OFFSET]
    return readings.reshape(len(fields), -1) + problem.array.channel_offset_T


def residuals(problem: CalibrationProblem, state: CalibrationState) -> FloatArray:
    """Return the whitened residuals of all readings, (T, C); zero where a reading is missing."""
    difference = prediction_T(problem, state) - problem.readings_T
    return np.where(np.isfinite(problem.readings_T), difference / (problem.noise_scale * problem.noise_T), 0.0)


def chi2(problem: CalibrationProblem, state: CalibrationState) -> float:
    """Return χ² of the readings, and of the priors of the common field and of the path if there are some."""
    weight, deviation = row_priors(problem, state)
    return float(np.sum(residuals(problem, state) ** 2) + np.sum((weight * deviation) ** 2))


def cost(problem: CalibrationProblem, state: CalibrationState) -> float:
    """Return χ² of the readings and of all priors."""
    return chi2(problem, state) + float(np.sum((state.sensors / problem.prior)[problem.free] ** 2))


def linearise(problem: CalibrationProblem, state: CalibrationState) -> Linearisation:
    """Return the residuals of a state and their derivatives by every unknown."""
    array = problem.array
    n_rows, n_sensors = len(state.position_m), array.n_sensors
    points, sources, moments = _geometry(problem, state)
    weight = np.where(np.isfinite(problem.readings_T), 1.0 / (problem.noise_scale * problem.noise_T), 0.0)
    weight = weight.reshape(n_rows, n_sensors, 3, 1)
    response = weight * responses(problem, state)
    gradient = response @ dipole.gradient_tensor(points, sources, moments)
    by_moment = response @ dipole.field_matrix(points, sources)
    fields = dipole.field(points, sources, moments) + state.common_T[:, None, :]
    nominal = np.einsum("iab,tib->tia", array.channel_gain.reshape(-1, 3, 3), fields)

    by_sensor = np.zeros((n_rows, n_sensors, 3, PER_SENSOR))
    by_sensor[..., POSITION] = gradient
    by_sensor[..., GAINS] = nominal[..., None] * np.eye(3)
    by_sensor[..., _CHANNEL, range(AXES.start, AXES.stop)] = nominal[..., _COMPONENT]
    by_sensor[..., OFFSET] = np.eye(3)
    by_sensor[..., GAINS.start :] *= weight
    by_sensor *= np.where(problem.free, problem.prior, 0.0)[:, None, :]

    array_from_world = np.swapaxes(problem.world_from_array, -1, -2)[:, None]
    by_world_moment = by_moment @ array_from_world
    up = -gradient @ array_from_world[..., 2:]
    none = np.empty((n_rows, n_sensors, 3, 0))
    by_moments = {"constant": by_world_moment}
    if problem.axis is not None:
        by_moments["axis"] = np.einsum("tnab,tb->tna", by_world_moment, problem.axis)[..., None]
    by_source = [
        by_moments.get(problem.moment, none),
        up if problem.unknown_height else none,
    ]
    by_row = [
        -gradient if problem.unknown_position else none,
        by_world_moment if problem.moment == "free" else none,
        response,
    ]
    shape = (n_rows, array.n_channels)
    return Linearisation(
        residual=residuals(problem, state),
        by_sensor=by_sensor,
        by_source=np.concatenate(by_source, axis=-1).reshape(*shape, problem.n_globals),
        by_row=np.concatenate(by_row, axis=-1).reshape(*shape, problem.n_row_unknowns),
    )


def _geometry(problem: CalibrationProblem, state: CalibrationState) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return sensors (N, 3), sources and moments (T, 1, 3), all in the array's frame."""
    points = problem.array.positions + state.sensors[:, POSITION]
    array_from_world = np.swapaxes(problem.world_from_array, -1, -2)
    sources = state.position_m + state.height_m * array_from_world[..., 2]
    moments = np.einsum("tab,tb->ta", array_from_world, state.moment_Am2)
    return points, sources[:, None, :], moments[:, None, :]


def row_priors(problem: CalibrationProblem, state: CalibrationState) -> tuple[FloatArray, FloatArray]:
    """Return 1/σ (T, n) of the prior of the rows' unknowns, 0 without a prior, and their deviations (T, n) from it."""
    weight, deviation = np.zeros((2, len(state.position_m), problem.n_row_unknowns))
    sigma_T = problem.array.common_field_T
    weight[:, -3:] = 0.0 if sigma_T is None else 1.0 / max(sigma_T, 1e-15)
    deviation[:, -3:] = state.common_T
    if problem.path_m is not None and problem.path_sigma_m is not None:
        weight[:, :3] = 1.0 / np.maximum(problem.path_sigma_m, _EXACT_M)[:, None]
        deviation[:, :3] = state.position_m - problem.path_m
    return weight, deviation
