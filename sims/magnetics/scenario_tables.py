"""Tables of a scenario file: their keys, types, defaults and bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any

import msgspec

from arrays.io.toml import (
    MAY_BE_INFINITE,
    NOT_NEGATIVE,
    POSITIVE,
    File,
    NotNegative,
    Positive,
    Rate,
    RefusalError,
    Rule,
    Table,
    date_such_as,
    one_of,
)
from arrays.pose import PoseTable
from sims.magnetics.paths import Lawnmower, Path, Steered, Vector, Waypoints, circle
from sims.magnetics.sensors import SENSOR_KINDS

_ORIGIN: Vector = (0.0, 0.0, 0.0)
_UNIT_QUATERNION_ATOL = 1e-6
_BELOW_1 = Rule(lambda value: value < 1.0, "a number below 1")
_BELOW_30 = Rule(lambda value: value < 30.0, "a number below 30")
_BELOW_1000 = Rule(lambda value: value < 1000.0, "a number below 1000")


class SensorsTable(Table, kw_only=True):
    """Properties of all sensors, or of one."""

    kind: Annotated[str, one_of(SENSOR_KINDS)] | None = None
    noise_nT: Positive | None = None
    noise_nT_rtHz: Positive | None = None
    corner_Hz: NotNegative | None = None
    bandwidth_Hz: Annotated[Positive, MAY_BE_INFINITE] | None = None
    range_nT: Annotated[Positive, MAY_BE_INFINITE] | None = None
    resolution_nT: NotNegative | None = None
    misalignment_mrad: Annotated[NotNegative, _BELOW_1000] | None = None
    gain_error: Annotated[NotNegative, _BELOW_1] | None = None
    drift_nT_rth: NotNegative | None = None
    offset_error_nT: NotNegative | None = None
    of: dict[str, SensorsTable] = msgspec.field(default_factory=dict)

    def check(self) -> None:
        """Refuse two kinds of noise."""
        if self.noise_nT is not None and self.noise_nT_rtHz is not None:
            raise RefusalError("noise_nT and noise_nT_rtHz", "found both, expected one of them")


class CarrierTable(Table, kw_only=True):
    """Motion of the array."""

    path: dict[str, Any] = msgspec.field(default_factory=dict)
    attitude: Annotated[str, one_of(("fixed", "course"), "fixed or course")] = "fixed"
    rotation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    rate_deg_s: Vector = _ORIGIN
    wobble_deg: Annotated[Vector, NOT_NEGATIVE] = _ORIGIN
    wobble_period_s: Annotated[float | Vector, POSITIVE] = 4.0

    def check(self) -> None:
        """Refuse a quaternion that is no rotation."""
        norm = math.hypot(*self.rotation_xyzw)
        if abs(norm - 1.0) > _UNIT_QUATERNION_ATOL:
            raise RefusalError("rotation_xyzw", f"found a quaternion of norm {norm:.6g}, expected norm 1")


class SourceTable(CarrierTable, kw_only=True):
    """Source and its motion."""

    moment_Am2: Vector = _ORIGIN
    polarisability_m3: float | list[float | list[float]] = 0.0
    radius_m: NotNegative = 0.0
    body_length_m: NotNegative = 0.0
    path_sigma_m: NotNegative = 0.0
    path_correlation_s: Annotated[NotNegative, MAY_BE_INFINITE] = math.inf
    attitude_sigma_deg: NotNegative = 0.0
    attitude_correlation_s: Annotated[NotNegative, MAY_BE_INFINITE] = math.inf
    from_s: float = 0.0
    until_s: Annotated[float, MAY_BE_INFINITE] = math.inf

    def check(self) -> None:
        """Refuse a source that leaves before it arrives."""
        super().check()
        if not self.from_s < self.until_s:
            raise RefusalError("until_s", f"found {self.until_s:g}, expected a time after from_s = {self.from_s:g}")


class AmbientTable(Table, kw_only=True):
    """Geomagnetic field: a vector, or that of a place and date."""

    field_nT: Vector | None = None
    place: Vector | None = None
    date: Annotated[str, date_such_as("a date such as 2026-11-21")] | None = None
    model: str = "IGRF-14"

    def check(self) -> None:
        """Refuse a place without a date, and more or less than one field."""
        if (self.field_nT is None) == (self.place is None):
            found = "neither field_nT nor place" if self.place is None else "both field_nT and place"
            raise RefusalError("", f"found {found}, expected one of them")
        if self.place is not None and self.date is None:
            raise RefusalError("", "found no key date, expected one because there is a place")


class PulsationTable(Table, kw_only=True):
    """A sinusoid in the ambient field."""

    amplitude_nT: NotNegative
    period_s: Positive
    direction: Vector

    def check(self) -> None:
        """Refuse a zero direction."""
        if not any(self.direction):
            raise RefusalError("direction", "found zero, expected a direction")


class PlatformTable(Table, kw_only=True):
    """Noise of the platform that carries the array."""

    position_m: Vector = _ORIGIN
    moment_Am2: Vector = _ORIGIN
    frequency_Hz: NotNegative = 0.0
    noise_nT: NotNegative = 0.0
    induced: NotNegative = 0.0
    eddy_s: NotNegative = 0.0


class MissingTable(Table, kw_only=True):
    """Missing readings."""

    dropout: Annotated[NotNegative, Rule(lambda value: value < 1.0, "a probability below 1")] = 0.0
    gaps_s: list[tuple[float, float]] = msgspec.field(default_factory=list)

    def check(self) -> None:
        """Refuse a gap that ends before it starts."""
        for start, end in self.gaps_s:
            if not start < end:
                raise RefusalError("gaps_s", f"found [{start:g}, {end:g}], expected an end after its start")


class PoseErrorTable(PoseTable, kw_only=True):
    """Errors of the stated pose, as in an array file; errors that are not named are zero."""

    position_constant_m: NotNegative = 0.0
    attitude_constant_deg: Annotated[NotNegative, _BELOW_30] = 0.0


Pair = tuple[float, float]


class TargetsTable(Table, kw_only=True):
    """Targets at random places in the ground."""

    number: Annotated[int, POSITIVE]
    x_m: Pair
    y_m: Pair
    depth_m: Annotated[Pair, POSITIVE] = (0.3, 2.0)
    moment_Am2: Annotated[Pair, POSITIVE] = (0.1, 30.0)
    gap_m: NotNegative = 5.0

    def check(self) -> None:
        """Refuse bounds in the wrong order."""
        for key in ("x_m", "y_m", "depth_m", "moment_Am2"):
            low, high = getattr(self, key)
            if low > high:
                raise RefusalError(key, f"found [{low:g}, {high:g}], expected the smaller one first")


class GeologyTable(Table, kw_only=True):
    """Field of the ground itself."""

    field_nT: NotNegative
    shortest_m: Positive = 15.0
    longest_m: Positive = 80.0

    def check(self) -> None:
        """Refuse invalid wavelengths."""
        if self.shortest_m > self.longest_m:
            found = f"found {self.shortest_m:g} above longest_m = {self.longest_m:g}"
            raise RefusalError("shortest_m", f"{found}, expected the shorter one")


class FileTable(File, kw_only=True):
    """The whole file."""

    duration_s: Positive
    rate_Hz: Rate
    array: dict[str, Any] | str
    name: str | None = None
    sensors: SensorsTable = msgspec.field(default_factory=SensorsTable)
    carrier: CarrierTable = msgspec.field(default_factory=CarrierTable)
    source: list[SourceTable] = msgspec.field(default_factory=list)
    ambient: AmbientTable | None = None
    pulsation: list[PulsationTable] = msgspec.field(default_factory=list)
    platform: PlatformTable = msgspec.field(default_factory=PlatformTable)
    missing: MissingTable = msgspec.field(default_factory=MissingTable)
    pose: PoseErrorTable | None = None
    targets: TargetsTable | None = None
    geology: GeologyTable | None = None


class PathTable(Table, kw_only=True):
    """Base of all path tables; ``path()`` returns the path."""

    kind: str


class FixedPath(PathTable, kw_only=True):
    """Position at rest."""

    position_m: Vector = _ORIGIN

    def path(self) -> Path:
        """Return the path of the table."""
        return Steered(self.position_m)


class LinePath(PathTable, kw_only=True):
    """Constant speed and course."""

    start_m: Vector
    course_deg: float
    speed_m_s: NotNegative
    climb_m_s: float = 0.0

    def path(self) -> Steered:
        """Return the path of the table."""
        return Steered(self.start_m, math.radians(self.course_deg), self.speed_m_s, climb_m_s=self.climb_m_s)


class CoursePath(LinePath, kw_only=True):
    """Constant speed, and a course that may turn."""

    turn_deg_s: float = 0.0

    def path(self) -> Steered:
        """Return the path of the table."""
        return replace(super().path(), turn_rad_s=math.radians(self.turn_deg_s))


class WeavingPath(LinePath, kw_only=True):
    """Constant speed, and a course that swings."""

    weave_deg: float
    weave_period_s: Positive
    turn_deg_s: float = 0.0

    def path(self) -> Steered:
        """Return the path of the table."""
        return replace(
            super().path(),
            turn_rad_s=math.radians(self.turn_deg_s),
            weave_rad=math.radians(self.weave_deg),
            weave_period_s=self.weave_period_s,
        )


class CirclePath(PathTable, kw_only=True):
    """A horizontal circle."""

    centre_m: Vector
    radius_m: Positive
    speed_m_s: NotNegative
    start_deg: float = 0.0
    clockwise: bool = True

    def path(self) -> Path:
        """Return the path of the table."""
        return circle(
            self.centre_m, self.radius_m, self.speed_m_s, math.radians(self.start_deg), clockwise=self.clockwise
        )


class WaypointsPath(PathTable, kw_only=True):
    """Straight lines between points."""

    points_m: list[Vector]
    speed_m_s: Positive

    def path(self) -> Path:
        """Return the path of the table."""
        return Waypoints(tuple(self.points_m), self.speed_m_s)


class LawnmowerPath(PathTable, kw_only=True):
    """Parallel lines joined by half circles."""

    start_m: Vector
    course_deg: float
    length_m: Positive
    spacing_m: Positive
    lines: Annotated[int, POSITIVE]
    speed_m_s: Positive

    def path(self) -> Path:
        """Return the path of the table."""
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
