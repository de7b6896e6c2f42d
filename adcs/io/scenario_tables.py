"""Tables of a scenario file: their keys, types, defaults and bounds."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from adcs.satellite.sensors import FIVE_HEADS
from arrays.io.toml import Table

FORMAT_VERSION = 1
Vector = tuple[float, float, float]
_ZERO: Vector = (0.0, 0.0, 0.0)


class FileTable(Table, kw_only=True):
    """The whole file."""

    positive = frozenset({"duration_s", "step_s"})

    satellite: dict[str, Any]
    orbit: dict[str, Any]
    format_version: int = FORMAT_VERSION
    name: str | None = None
    duration_s: float = 200.0
    step_s: float = 1.0
    start: dict[str, Any] = msgspec.field(default_factory=dict)
    disturbance: dict[str, Any] = msgspec.field(default_factory=dict)
    sensors: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    estimate: dict[str, Any] = msgspec.field(default_factory=dict)


class SatelliteTable(Table, kw_only=True):
    """The body and its wheels."""

    positive = frozenset({"torque_limit_Nm", "momentum_limit_Nms", "control_rad_s", "control_damping"})

    inertia_kgm2: tuple[Vector, Vector, Vector]
    residual_dipole_Am2: Vector = _ZERO
    control_rad_s: float = 0.03
    control_damping: float = 0.8
    torque_limit_Nm: float = 5e-3
    momentum_limit_Nms: float = 0.17


class OrbitTable(Table, kw_only=True):
    """A circle, or two-line elements; the day; the model of the field."""

    positive = frozenset({"altitude_km"})

    start: str
    altitude_km: float | None = None
    inclination_deg: float | None = None
    local_time_h: float | None = None
    node_deg: float | None = None
    latitude_argument_deg: float = 0.0
    elements: tuple[str, str] | None = None
    field_model: str = "IGRF-14"


class StartTable(Table, kw_only=True):
    """When runs start and what holds throughout, and how the satellite moves then."""

    not_negative = frozenset({"least_field_nT", "attitude_deg", "rate_deg_s", "eclipse_after_s"})

    sunlit: bool = True
    least_separation_deg: float = 45.0
    most_separation_deg: float = 90.0
    least_field_nT: float = 25_000.0
    eclipse_after_s: float | None = None
    attitude_deg: float = 1.0
    rate_deg_s: float = 0.01


class DisturbanceTable(Table, kw_only=True):
    """What the filters are not told."""

    positive = frozenset({"torque_period_s"})
    not_negative = frozenset({"torque_Nm", "gyro_bias_deg_s", "field_bias_nT", "field_error_nT"})
    may_be_infinite = frozenset({"torque_period_s"})

    torque_Nm: float = 8e-7
    torque_period_s: float = math.inf
    gyro_bias_deg_s: float = 0.0
    field_bias_nT: float = 0.0
    field_error_nT: float = 0.0


class StarTrackerTable(Table, kw_only=True):
    """Noise is that of the angle about each axis."""

    positive = frozenset({"noise_deg", "rate_limit_deg_s"})
    not_negative = frozenset({"sun_exclusion_deg", "earth_exclusion_deg"})

    noise_deg: float = 0.001
    rate_limit_deg_s: float = 2.0
    boresight: Vector = (0.0, 0.0, 1.0)
    sun_exclusion_deg: float = 0.0
    earth_exclusion_deg: float = 0.0
    misalignment_deg: Vector = _ZERO


class GyroTable(Table, kw_only=True):
    """Noise of one reading of one axis."""

    positive = frozenset({"noise_deg_s", "range_deg_s"})
    not_negative = frozenset({"bias_walk_deg_s_rts"})

    noise_deg_s: float = 0.005
    range_deg_s: float = 250.0
    bias_walk_deg_s_rts: float = 0.0
    misalignment_deg: Vector = _ZERO


class MagnetometerTable(Table, kw_only=True):
    """Noise of one reading of one axis."""

    positive = frozenset({"noise_nT", "range_nT"})
    not_negative = frozenset({"bias_walk_nT_rts"})

    noise_nT: float = 250.0
    range_nT: float = 200_000.0
    bias_walk_nT_rts: float = 0.0
    misalignment_deg: Vector = _ZERO


class SunSensorTable(Table, kw_only=True):
    """Noise of the direction along each of two axes across it."""

    positive = frozenset({"noise_deg", "half_field_deg"})

    noise_deg: float = 0.1
    half_field_deg: float = 45.0
    heads: list[Vector] = msgspec.field(default_factory=FIVE_HEADS.tolist)
    misalignment_deg: Vector = _ZERO


class EstimateTable(Table, kw_only=True):
    """The filter."""

    not_negative = frozenset({"field_model_error_nT"})
    positive = frozenset(
        {"start_error_deg", "start_rate_error_deg_s", "gyro_bias_deg_s", "field_bias_nT", "disturbance_s2"}
    )

    sensors: str = "st+gyro+mag+sun"
    states: list[str] = msgspec.field(default_factory=list)
    filter: str = "mekf"
    process_noise: str | dict[str, Any] = "tuned"
    field_model_error_nT: float = 0.0
    start: str = "near"
    start_error_deg: float = 5.0
    start_rate_error_deg_s: float = 0.1
    gyro_bias_deg_s: float = 0.06
    field_bias_nT: float = 1000.0
    disturbance_s2: float = 2e-6
    forgetting: float = 0.99
    closed_loop_F: bool = False


class ProcessNoiseTable(Table, kw_only=True):
    """What every second adds to the error state, one standard deviation.

    See :class:`adcs.kalman.error_state.ProcessNoise`.
    """

    not_negative = frozenset({"half_angle_rad", "rate_rad_s", "field_bias_nT", "gyro_bias_rad_s", "disturbance_s2"})

    half_angle_rad: float | None = None
    rate_rad_s: float | None = None
    field_bias_nT: float | None = None
    gyro_bias_rad_s: float | None = None
    disturbance_s2: float | None = None


SENSOR_TABLES: dict[str, type[Table]] = {
    "star_tracker": StarTrackerTable,
    "gyro": GyroTable,
    "magnetometer": MagnetometerTable,
    "sun_sensor": SunSensorTable,
}
