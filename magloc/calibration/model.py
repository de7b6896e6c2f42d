r"""Model of the readings of an array of vector sensors when a source moves past it.

In row t (one instant) sensor i reads, with the names of docs/theory/calibration.md,

.. math:: y_{ti} = (I + E_i) K_i \left( B(s_i + d_i;\, p_t, m_t) + c_t \right) + o_i + h_i.

The unit of the sensors' unknowns is their prior standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from arrays.typing import FloatArray
from magloc.calibration.sensors import (
    POSITION,
    Linearisation,
    SensorProblem,
    readings_of_fields,
    sensor_derivatives,
    whitened_responses,
)
from magloc.fields import dipole

MomentKind = Literal["constant", "free", "known", "axis"]
"""The moment in the world frame: one unknown vector for all rows, one for every row, known, or of known directions and
one unknown strength."""
_EXACT_M = 1e-7  # least standard deviation of a measured position


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


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationProblem(SensorProblem[CalibrationState]):
    """Readings of a moving source, and which quantities of sensors, source and rows are unknown.

    Attributes
    ----------
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
    """

    world_from_array: FloatArray
    unknown_position: bool
    unknown_height: bool
    moment: MomentKind
    path_m: FloatArray | None = None
    path_sigma_m: FloatArray | None = None
    axis: FloatArray | None = None

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

    def prediction_T(self, state: CalibrationState) -> FloatArray:
        """Return the predicted readings, shape (T, C) [T]."""
        points, sources, moments = self._geometry(state)
        fields = dipole.field(points, sources, moments) + state.common_T[:, None, :]
        return readings_of_fields(self.array, state.sensors, fields)

    def linearise(self, state: CalibrationState) -> Linearisation:
        """Return the residuals of a state and their derivatives by every unknown."""
        array = self.array
        n_rows, n_sensors = len(state.position_m), array.n_sensors
        points, sources, moments = self._geometry(state)
        response = whitened_responses(self, state.sensors)
        field_gradient = dipole.gradient_tensor(points, sources, moments)
        gradient = response @ field_gradient
        by_moment = response @ dipole.field_matrix(points, sources)
        fields = dipole.field(points, sources, moments) + state.common_T[:, None, :]

        array_from_world = np.swapaxes(self.world_from_array, -1, -2)[:, None]
        by_world_moment = by_moment @ array_from_world
        up = -gradient @ array_from_world[..., 2:]
        none = np.empty((n_rows, n_sensors, 3, 0))
        by_moments = {"constant": by_world_moment}
        if self.axis is not None:
            by_moments["axis"] = np.einsum("tnab,tb->tna", by_world_moment, self.axis)[..., None]
        by_source = [
            by_moments.get(self.moment, none),
            up if self.unknown_height else none,
        ]
        by_row = [
            -gradient if self.unknown_position else none,
            by_world_moment if self.moment == "free" else none,
            response,
        ]
        shape = (n_rows, array.n_channels)
        return Linearisation(
            residual=self.residuals(self.prediction_T(state)),
            by_sensor=sensor_derivatives(self, state.sensors, fields, field_gradient),
            by_source=np.concatenate(by_source, axis=-1).reshape(*shape, self.n_globals),
            by_row=np.concatenate(by_row, axis=-1).reshape(*shape, self.n_row_unknowns),
        )

    def _geometry(self, state: CalibrationState) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return sensors (N, 3), sources and moments (T, 1, 3), all in the array's frame."""
        points = self.array.positions + state.sensors[:, POSITION]
        array_from_world = np.swapaxes(self.world_from_array, -1, -2)
        sources = state.position_m + state.height_m * array_from_world[..., 2]
        moments = np.einsum("tab,tb->ta", array_from_world, state.moment_Am2)
        return points, sources[:, None, :], moments[:, None, :]

    def row_priors(self, state: CalibrationState) -> tuple[FloatArray, FloatArray]:
        """Return 1/σ (T, n) of the prior of the rows' unknowns, 0 without one, and their deviations (T, n) from it."""
        weight, deviation = np.zeros((2, len(state.position_m), self.n_row_unknowns))
        weight[:, -3:] = self.common_weight
        deviation[:, -3:] = state.common_T
        if self.path_m is not None and self.path_sigma_m is not None:
            weight[:, :3] = 1.0 / np.maximum(self.path_sigma_m, _EXACT_M)[:, None]
            deviation[:, :3] = state.position_m - self.path_m
        return weight, deviation

    def after_step(self, state: CalibrationState, step: FloatArray, of_rows: FloatArray) -> CalibrationState:
        """Return a state after a step (P,) of sensors and source, and (T, n) of the rows."""
        sensors, of_source = self.sensors_after_step(state, step)
        position, height, moment = state.position_m, state.height_m, state.moment_Am2
        if self.unknown_position:
            # A source that jumps far away would not return, because its field and all derivatives vanish.
            length = np.linalg.norm(of_rows[:, :3], axis=1, keepdims=True)
            radius = self.array.circumradius
            of_rows = of_rows * (radius / np.maximum(length, radius))
            position = position + of_rows[:, :3]
        if self.unknown_height:
            height = height + float(of_source[-1])
        if self.moment == "free":
            moment = moment + of_rows[:, -6:-3]
        elif self.moment == "constant":
            moment = moment + of_source[:3]
        elif self.axis is not None:
            moment = moment + of_source[0] * self.axis
        return CalibrationState(sensors, position, height, moment, state.common_T + of_rows[:, -3:])
