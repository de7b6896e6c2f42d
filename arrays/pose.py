"""Errors of the pose of a moving array, and their table in an array file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec

from arrays.io.errors import naming
from arrays.io.toml import NotNegative, Rule, Table
from arrays.sensor import _finite, _not_negative
from arrays.typing import Vector

_LARGEST_RAD = math.radians(30.0)
_BELOW_30 = Rule(lambda value: 0.0 <= value < 30.0, "a number from 0 to below 30")


@dataclass(frozen=True)
class PoseUncertainty:
    """Standard deviations of the errors of an array's pose, along or about each axis.

    The true attitude is the stated one, rotated by a small vector in the array's axes about the reference point
    of the pose. The true position is the stated one, moved along the axes of the world. Different clocks make the
    pose that of another time.

    Attributes
    ----------
    position_m, attitude_rad, time_s : float
        Standard deviations of errors that vary between rows.
    correlation_s : float
        Correlation time of these errors, first-order Markov processes [s]. 0: new errors in every row.
    position_white_m : float
        Standard deviation of an additional error of the position, new in every row.
    position_constant_m : float
        Standard deviation of an error of the lever arm, constant in the array's axes.
    attitude_constant_rad : float
        Standard deviation of a constant rotation of the array in its mounting.
    time_constant_s : float
        Standard deviation of a constant difference of the clocks.
    lever_arm_m : tuple of 3 floats
        Vector from the reference point of the pose to the origin of the array, in the array's axes; errors of the
        attitude rotate about the reference point. The pose in the readings refers to the origin.

    Raises
    ------
    ValueError
        A standard deviation is negative or not finite, or one of an angle is 30° or more.

    Examples
    --------
    >>> import math
    >>> import arrays
    >>> pose = arrays.PoseUncertainty(position_m=0.02, attitude_rad=math.radians(0.3), correlation_s=10.0)
    >>> array = arrays.SensorArray(arrays.tetrahedron(0.6).sensors, pose=pose)
    >>> array.pose.position_constant_m
    0.05
    """

    position_m: float = 0.0
    attitude_rad: float = 0.0
    time_s: float = 0.0
    correlation_s: float = 0.0
    position_constant_m: float = 0.05
    attitude_constant_rad: float = math.radians(0.5)
    time_constant_s: float = 0.0
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    position_white_m: float = 0.0

    def __post_init__(self) -> None:
        for name in _SIGMAS:
            value = _not_negative(name, getattr(self, name))
            object.__setattr__(self, name, value)
            if name.startswith("attitude") and not value < _LARGEST_RAD:
                raise ValueError(f"Input {name} must be below 30°; instead received {math.degrees(value):g}°.")
        object.__setattr__(self, "lever_arm_m", tuple(_finite("lever_arm_m", self.lever_arm_m, (3,)).tolist()))


_SIGMAS = tuple(name for name in PoseUncertainty.__dataclass_fields__ if name != "lever_arm_m")
_DEFAULT = PoseUncertainty()


class PoseTable(Table, kw_only=True):
    """The table ``pose`` of an array file; the default constants describe an ordinary mounting."""

    position_m: NotNegative = 0.0
    attitude_deg: Annotated[float, _BELOW_30] = 0.0
    time_s: NotNegative = 0.0
    correlation_s: NotNegative = 0.0
    position_constant_m: NotNegative = _DEFAULT.position_constant_m
    attitude_constant_deg: Annotated[float, _BELOW_30] = 0.5
    time_constant_s: NotNegative = 0.0
    lever_arm_m: Vector = _DEFAULT.lever_arm_m
    position_white_m: NotNegative = 0.0

    def uncertainty(self, place: str) -> PoseUncertainty:
        """Return the errors that the table states; `place` is for errors."""
        values = msgspec.structs.asdict(self)
        for key in ("attitude", "attitude_constant"):
            values[f"{key}_rad"] = math.radians(values.pop(f"{key}_deg"))
        with naming(place):
            return PoseUncertainty(**values)


def pose_toml(pose: PoseUncertainty) -> list[str]:
    """Return the lines of the table in an array file, with all keys."""
    lines = ["", "[pose]"]
    for key in PoseTable.__struct_fields__:
        value = getattr(pose, key.replace("_deg", "_rad"))
        if key == "lever_arm_m":
            value = list(value)
        lines.append(f"{key} = {_degrees(value) if key.endswith('_deg') else value}")
    return lines


def _degrees(angle_rad: float) -> float:
    """Return an angle in degrees that converts back exactly."""
    angle = math.degrees(angle_rad)
    near = (float(f"{angle:.12g}"), angle, math.nextafter(angle, math.inf), math.nextafter(angle, 0.0))
    return next((value for value in near if math.radians(value) == angle_rad), angle)
