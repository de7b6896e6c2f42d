"""Tables of a scenario file: keys, types, defaults and bounds."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

import msgspec
import numpy as np

from adcs.io.log_layout import LogTable
from adcs.satellite.sensors import FIVE_HEADS, Gyro, Magnetometer, StarTracker, SunSensor
from arrays.io.toml import MAY_BE_INFINITE, File, NotNegative, Positive, RefusalError, Rule, Table, date_such_as, one_of
from arrays.typing import Vector
from magloc.fields.geomagnetic import MODELS
from magloc.levels import CONTRADICTION

MOST_STEPS = 200_000
"""Largest number of steps of a run, whose covariances take 230 MB."""
_ZERO: Vector = (0.0, 0.0, 0.0)
_RIGHT_ANGLE = Rule(lambda value: 0.0 <= value <= 90.0, "0 to 90")
_SHARE = Rule(lambda value: 0.0 <= value < 1.0, "0 to less than 1")
_NAME = Rule(lambda value: bool(re.fullmatch(r"[\w.-]+", value)), "letters, digits, dots and dashes")


class SatelliteTable(Table, kw_only=True):
    """Table of the body and its wheels."""

    inertia_kgm2: tuple[Vector, Vector, Vector]
    residual_dipole_Am2: Vector = _ZERO
    control_rad_s: Positive = 0.03
    control_damping: Positive = 0.8
    torque_limit_Nm: Positive = 5e-3
    momentum_limit_Nms: Positive = 0.17


class OrbitTable(Table, kw_only=True):
    """Table of the orbit: a circle, two-line elements or an ephemeris; its date, and the field model."""

    start: Annotated[str, date_such_as("an instant such as 2014-09-01T12:00:00 (UTC)")]
    altitude_km: Positive | None = None
    inclination_deg: float | None = None
    local_time_h: float | None = None
    node_deg: float | None = None
    latitude_argument_deg: float = 0.0
    elements: tuple[str, str] | None = None
    allow_old_elements: bool = False
    ephemeris: str | None = None
    field_model: Annotated[str, one_of(MODELS)] = "IGRF-14"

    def check(self) -> None:
        """Raise RefusalError unless there is exactly one orbit."""
        circle = ("altitude_km", "inclination_deg", "local_time_h", "node_deg")
        missing = [key for key in circle if getattr(self, key) is None]
        if self.elements is not None and self.ephemeris is not None:
            raise RefusalError("", "found elements and an ephemeris, expected one of them")
        if self.elements is not None or self.ephemeris is not None:
            if len(missing) < len(circle):
                given = "an ephemeris" if self.elements is None else "elements"
                raise RefusalError("", f"found {given} and a circle, expected one of them")
        elif missing and missing[0] in circle[:2]:
            raise RefusalError("", f"found no key {missing[0]}, expected one, or two-line elements")
        elif len(missing) != 1:
            found = "neither local_time_h nor node_deg" if missing else "both local_time_h and node_deg"
            raise RefusalError("", f"found {found}, expected one of them")


class StartTable(Table, kw_only=True):
    """Table of the start of runs: conditions during a run, and deviations of the initial motion."""

    sunlit: bool = True
    least_separation_deg: Annotated[float, _RIGHT_ANGLE] = 45.0
    most_separation_deg: Annotated[float, _RIGHT_ANGLE] = 90.0
    least_field_nT: NotNegative = 25_000.0
    eclipse_after_s: NotNegative | None = None
    attitude_deg: NotNegative = 1.0
    rate_deg_s: NotNegative = 0.01


class DisturbanceTable(Table, kw_only=True):
    """Table of disturbances, which the filters do not know."""

    torque_Nm: NotNegative = 8e-7
    torque_period_s: Annotated[Positive, MAY_BE_INFINITE] = math.inf
    dipole_Am2: Vector = _ZERO
    gyro_bias_deg_s: NotNegative = 0.0
    field_bias_nT: NotNegative = 0.0
    field_gain: NotNegative = 0.0
    field_axes_deg: NotNegative = 0.0
    field_error_nT: NotNegative = 0.0
    field_error_correlation_s: Annotated[Positive, MAY_BE_INFINITE] = math.inf
    wild_share: Annotated[float, _SHARE] = 0.0


class StarTrackerTable(Table, kw_only=True):
    """Table of the star tracker; its noise is stated for the angle about each axis."""

    noise_deg: Positive = 0.001
    rate_limit_deg_s: Positive = 2.0
    boresight: Vector = (0.0, 0.0, 1.0)
    sun_exclusion_deg: NotNegative = 0.0
    earth_exclusion_deg: NotNegative = 0.0
    misalignment_deg: Vector = _ZERO

    def sensor(self) -> StarTracker:
        """Return the sensor of the table."""
        return StarTracker(
            sigma_rad=0.5 * math.radians(self.noise_deg),
            rate_limit_rad_s=math.radians(self.rate_limit_deg_s),
            boresight_body=np.array(self.boresight),
            sun_exclusion_rad=math.radians(self.sun_exclusion_deg),
            earth_exclusion_rad=math.radians(self.earth_exclusion_deg),
            misalignment_rad=np.radians(self.misalignment_deg),
        )


class GyroTable(Table, kw_only=True):
    """Table of the gyro; its noise is stated for one reading of one axis."""

    noise_deg_s: Positive = 0.005
    range_deg_s: Positive = 250.0
    bias_walk_deg_s_rts: NotNegative = 0.0
    misalignment_deg: Vector = _ZERO

    def sensor(self) -> Gyro:
        """Return the sensor of the table."""
        return Gyro(
            sigma_rad_s=math.radians(self.noise_deg_s),
            range_rad_s=math.radians(self.range_deg_s),
            bias_walk_rad_s=math.radians(self.bias_walk_deg_s_rts),
            misalignment_rad=np.radians(self.misalignment_deg),
        )


class MagnetometerTable(Table, kw_only=True):
    """Table of the magnetometer; its noise is stated for one reading of one axis."""

    noise_nT: Positive = 250.0
    range_nT: Positive = 200_000.0
    bias_walk_nT_rts: NotNegative = 0.0
    misalignment_deg: Vector = _ZERO

    def sensor(self) -> Magnetometer:
        """Return the sensor of the table."""
        return Magnetometer(
            sigma_T=1e-9 * self.noise_nT,
            range_T=1e-9 * self.range_nT,
            bias_walk_T=1e-9 * self.bias_walk_nT_rts,
            misalignment_rad=np.radians(self.misalignment_deg),
        )


class SunSensorTable(Table, kw_only=True):
    """Table of the Sun sensor; its noise is stated for each of two axes across the direction."""

    noise_deg: Positive = 0.1
    half_field_deg: Positive = 45.0
    heads: list[Vector] = msgspec.field(default_factory=FIVE_HEADS.tolist)
    misalignment_deg: Vector = _ZERO

    def sensor(self) -> SunSensor:
        """Return the sensor of the table."""
        return SunSensor(
            sigma_rad=math.radians(self.noise_deg),
            heads_body=np.array(self.heads, dtype=np.float64),
            half_field_rad=math.radians(self.half_field_deg),
            misalignment_rad=np.radians(self.misalignment_deg),
        )


class EstimateTable(Table, kw_only=True):
    """Table of the filter."""

    sensors: str = "st+gyro+mag+sun"
    states: list[str] = msgspec.field(default_factory=list)
    filter: str = "mekf"
    process_noise: str | dict[str, Any] = "tuned"
    field_model_error_nT: NotNegative = 0.0
    field_model_correlation_s: Positive = 132.0
    gate: Annotated[float, _SHARE] = CONTRADICTION
    start: str = "near"
    start_error_deg: Positive = 5.0
    start_rate_error_deg_s: Positive = 0.1
    gyro_bias_deg_s: Positive = 0.06
    field_bias_nT: Positive = 1000.0
    field_gain: Positive = 0.05
    field_axes_deg: Positive = 1.0
    disturbance_s2: Positive | None = None
    dipole_Am2: Positive = 0.1
    longest_gap_s: Positive = 600.0
    forgetting: float = 0.99
    closed_loop_F: bool = False


class ProcessNoiseTable(Table, kw_only=True):
    """Table of the process noise: growth of the standard deviations of the error state in a step.

    See :class:`adcs.kalman.error_state.ProcessNoise`.
    """

    half_angle_rad: NotNegative | None = None
    rate_rad_s: NotNegative | None = None
    field_bias_nT: NotNegative | None = None
    gyro_bias_rad_s: NotNegative | None = None
    disturbance_s2: NotNegative | None = None
    dipole_Am2: NotNegative | None = None
    field_gain: NotNegative | None = None


SENSOR_TABLES: dict[str, Any] = {
    "star_tracker": StarTrackerTable,
    "gyro": GyroTable,
    "magnetometer": MagnetometerTable,
    "sun_sensor": SunSensorTable,
}


class FileTable(File, kw_only=True):
    """Scenario file."""

    satellite: SatelliteTable
    orbit: OrbitTable
    name: Annotated[str, _NAME] | None = None
    duration_s: Positive = 200.0
    step_s: Positive = 1.0
    start: StartTable = msgspec.field(default_factory=StartTable)
    disturbance: DisturbanceTable = msgspec.field(default_factory=DisturbanceTable)
    sensors: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    estimate: EstimateTable = msgspec.field(default_factory=EstimateTable)
    log: LogTable | None = None

    def check(self) -> None:
        """Raise RefusalError unless a run has 1 to :data:`MOST_STEPS` steps."""
        if not 1.0 <= self.duration_s / self.step_s <= MOST_STEPS:
            expected = f"1 to {MOST_STEPS} steps of {self.step_s:g} s"
            raise RefusalError("duration_s", f"found {self.duration_s:g} s, expected {expected}")
