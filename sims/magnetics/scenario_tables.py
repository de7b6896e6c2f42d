"""Tables of a scenario file: their keys, types, defaults and bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import msgspec

from arrays.io.toml import Table
from sims.magnetics.paths import Lawnmower, Path, Steered, Vector, Waypoints, circle

FORMAT_VERSION = 1
Quaternion = tuple[float, float, float, float]


class FileTable(Table, kw_only=True):
    """The whole file."""

    positive = frozenset({"duration_s", "rate_Hz"})

    duration_s: float
    rate_Hz: float
    array: dict[str, Any] | str
    format_version: int = FORMAT_VERSION
    name: str | None = None
    sensors: dict[str, Any] = msgspec.field(default_factory=dict)
    carrier: dict[str, Any] = msgspec.field(default_factory=dict)
    source: list[dict[str, Any]] = msgspec.field(default_factory=list)
    ambient: dict[str, Any] | None = None
    pulsation: list[dict[str, Any]] = msgspec.field(default_factory=list)
    platform: dict[str, Any] = msgspec.field(default_factory=dict)
    missing: dict[str, Any] = msgspec.field(default_factory=dict)


class SensorsTable(Table, kw_only=True):
    """What is known of all sensors, or of one."""

    positive = frozenset({"noise_nT", "noise_nT_rtHz", "bandwidth_Hz", "range_nT"})
    not_negative = frozenset(
        {"corner_Hz", "resolution_nT", "misalignment_mrad", "gain_error", "drift_nT_rth", "offset_error_nT"}
    )
    may_be_infinite = frozenset({"bandwidth_Hz", "range_nT"})

    kind: str | None = None
    noise_nT: float | None = None
    noise_nT_rtHz: float | None = None
    corner_Hz: float | None = None
    bandwidth_Hz: float | None = None
    range_nT: float | None = None
    resolution_nT: float | None = None
    misalignment_mrad: float | None = None
    gain_error: float | None = None
    drift_nT_rth: float | None = None
    offset_error_nT: float | None = None
    of: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)


class CarrierTable(Table, kw_only=True):
    """How the array moves."""

    positive = frozenset({"wobble_period_s"})
    not_negative = frozenset({"wobble_deg"})

    path: dict[str, Any] = msgspec.field(default_factory=dict)
    attitude: str = "fixed"
    rotation_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    rate_deg_s: Vector = (0.0, 0.0, 0.0)
    wobble_deg: Vector = (0.0, 0.0, 0.0)
    wobble_period_s: float | Vector = 4.0


class SourceTable(CarrierTable, kw_only=True):
    """A source, and how it moves."""

    not_negative = frozenset({"wobble_deg", "radius_m"})

    moment_Am2: Vector = (0.0, 0.0, 0.0)
    polarisability_m3: float | list[float | list[float]] = 0.0
    radius_m: float = 0.0


class AmbientTable(Table, kw_only=True):
    """The geomagnetic field: given, or that of a place and date."""

    field_nT: Vector | None = None
    place: Vector | None = None
    date: str | None = None
    model: str = "IGRF-14"


class PulsationTable(Table, kw_only=True):
    """A sinusoid in the ambient field."""

    positive = frozenset({"period_s"})
    not_negative = frozenset({"amplitude_nT"})

    amplitude_nT: float
    period_s: float
    direction: Vector


class PlatformTable(Table, kw_only=True):
    """Noise of what carries the array."""

    not_negative = frozenset({"frequency_Hz", "noise_nT"})

    position_m: Vector = (0.0, 0.0, 0.0)
    moment_Am2: Vector = (0.0, 0.0, 0.0)
    frequency_Hz: float = 0.0
    noise_nT: float = 0.0


class MissingTable(Table, kw_only=True):
    """Readings that are not there."""

    not_negative = frozenset({"dropout"})

    dropout: float = 0.0
    gaps_s: list[tuple[float, float]] = msgspec.field(default_factory=list)


class PathTable(Table, kw_only=True):
    """A path of some kind; every one makes its path with ``path()``."""

    kind: str


class FixedPath(PathTable, kw_only=True):
    """At rest."""

    position_m: Vector = (0.0, 0.0, 0.0)

    def path(self) -> Path:
        """The path that the table describes."""
        return Steered(self.position_m)


class LinePath(PathTable, kw_only=True):
    """Constant speed and course."""

    not_negative = frozenset({"speed_m_s"})

    start_m: Vector
    course_deg: float
    speed_m_s: float
    climb_m_s: float = 0.0

    def path(self) -> Steered:
        """The path that the table describes."""
        return Steered(self.start_m, math.radians(self.course_deg), self.speed_m_s, climb_m_s=self.climb_m_s)


class CoursePath(LinePath, kw_only=True):
    """Constant speed, and a course that turns."""

    turn_deg_s: float

    def path(self) -> Steered:
        """The path that the table describes."""
        return replace(super().path(), turn_rad_s=math.radians(self.turn_deg_s))


class WeavingPath(LinePath, kw_only=True):
    """Constant speed, and a course that swings."""

    positive = frozenset({"weave_period_s"})

    weave_deg: float
    weave_period_s: float
    turn_deg_s: float = 0.0

    def path(self) -> Steered:
        """The path that the table describes."""
        return replace(
            super().path(),
            turn_rad_s=math.radians(self.turn_deg_s),
            weave_rad=math.radians(self.weave_deg),
            weave_period_s=self.weave_period_s,
        )


class CirclePath(PathTable, kw_only=True):
    """A horizontal circle."""

    positive = frozenset({"radius_m"})
    not_negative = frozenset({"speed_m_s"})

    centre_m: Vector
    radius_m: float
    speed_m_s: float
    start_deg: float = 0.0
    clockwise: bool = True

    def path(self) -> Path:
        """The path that the table describes."""
        return circle(
            self.centre_m, self.radius_m, self.speed_m_s, math.radians(self.start_deg), clockwise=self.clockwise
        )


class WaypointsPath(PathTable, kw_only=True):
    """Straight from point to point."""

    positive = frozenset({"speed_m_s"})

    points_m: list[Vector]
    speed_m_s: float

    def path(self) -> Path:
        """The path that the table describes."""
        return Waypoints(tuple(self.points_m), self.speed_m_s)


class LawnmowerPath(PathTable, kw_only=True):
    """Parallel lines joined by half circles."""

    positive = frozenset({"length_m", "spacing_m", "lines", "speed_m_s"})

    start_m: Vector
    course_deg: float
    length_m: float
    spacing_m: float
    lines: int
    speed_m_s: float

    def path(self) -> Path:
        """The path that the table describes."""
        return Lawnmower(
            self.start_m, math.radians(self.course_deg), self.length_m, self.spacing_m, self.lines, self.speed_m_s
        )


PATH_TABLES: dict[str, Any] = {
    "fixed": FixedPath,
    "line": LinePath,
    "course": CoursePath,
    "weaving": WeavingPath,
    "circle": CirclePath,
    "waypoints": WaypointsPath,
    "lawnmower": LawnmowerPath,
}
"""Tables of the paths by their kind."""
