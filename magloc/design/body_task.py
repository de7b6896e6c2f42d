"""Tasks of a body's design: where its magnets may stand, and how its pose is judged.

A task file (TOML)::

    format_version = 1              # optional
    name = "knob"                   # optional, by default that of the file

    [magnets]
    least_spacing_m = 0.004         # between the centres of two magnets
    directions = "free"             # of the moments, by default; or "fixed"
    lever_m = 0.01                  # optional, by default the radius of the volume: a rotation counts as the
                                    # displacement of a point at this distance
    [volume]                        # allowed positions of the magnets in the body's frame, as in a task of an array
    shape = "cylinder"              # ball, box, cylinder or surface
    radius_m = 0.008
    height_m = 0.0                  # a disc

    [sensors]                       # optional: sensors move too
    least_spacing_m = 0.005         # optional, 0 by default

    [sensor_volume]                 # with [sensors]: their allowed positions in the array's frame
    shape = "box"
    size_m = [0.03, 0.03, 0.0]

    [criterion]                     # optional, as in a task of an array
    quantity = "quantile"
    level = 0.95

    [search]                        # optional
    starts = 8                      # the given body, and random places
    refined = 2                     # best starts, which descend again on all poses
    poses = 512                     # a power of two; the starts descend on a quarter of them
    iterations = 240                # at most, of a refined descent; a third of them for the starts
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from arrays.io.errors import InputError
from arrays.io.toml import File, NotNegative, Positive, RefusalError, Table, one_of, read_toml, section_of
from arrays.typing import FloatArray
from magloc.bounds.bodies import BodyBounds
from magloc.design.regions import Criterion
from magloc.design.task import CriterionTable, DesignSearch, StartsTable, at_least, volume_of_table
from magloc.design.volumes import Volume

_LEAST_POSES, _MOST_POSES = 64, 65_536


@dataclass(frozen=True, eq=False)
class DesignVolume:
    """Volume of magnets or sensors, and their least distance [m]."""

    volume: Volume
    least_spacing_m: float


@dataclass(frozen=True, eq=False)
class BodyTask:
    """Task of a body's design.

    Attributes
    ----------
    name : str
    magnets : DesignVolume
        Allowed positions of the magnets in the body's frame.
    directions_are_free : bool
        True if the moments may turn.
    lever_m : float
        Distance at which a rotation counts as a displacement.
    criterion : Criterion
    sensors : DesignVolume, optional
        Allowed positions of the sensors in the array's frame; None if they do not move.
    search : DesignSearch
        Effort; the sizes of the samples are numbers of poses.
    """

    name: str
    magnets: DesignVolume
    directions_are_free: bool
    lever_m: float
    criterion: Criterion
    sensors: DesignVolume | None
    search: DesignSearch

    def deviations(self, bounds: BodyBounds) -> FloatArray:
        """Return the standard deviation of position and rotation together (n,) [m]."""
        return np.hypot(bounds.sigma_position_m, self.lever_m * bounds.sigma_rotation_rad)


class _Magnets(Table, kw_only=True):
    least_spacing_m: Positive
    directions: Annotated[str, one_of(("free", "fixed"), "free or fixed")] = "free"
    lever_m: Positive | None = None


class _Sensors(Table, kw_only=True):
    least_spacing_m: NotNegative = 0.0


class _Search(StartsTable, kw_only=True):
    starts: int = 8
    refined: int = 2
    poses: int = 512
    iterations: Annotated[int, at_least(1)] = 240

    def check(self) -> None:
        super().check()
        if not (_LEAST_POSES <= self.poses <= _MOST_POSES and self.poses.bit_count() == 1):
            expected = f"a power of two from {_LEAST_POSES} to {_MOST_POSES}"
            raise RefusalError("poses", f"found {self.poses}, expected {expected}")

    def search(self) -> DesignSearch:
        """Return the effort of the table."""
        log2 = self.poses.bit_length() - 1
        return DesignSearch(self.starts, self.refined, log2 - 2, log2, -(-self.iterations // 3), self.iterations)


class _BodyTaskFile(File, kw_only=True):
    magnets: _Magnets
    volume: dict[str, Any]
    sensors: _Sensors | None = None
    sensor_volume: dict[str, Any] | None = None
    criterion: CriterionTable = msgspec.field(default_factory=CriterionTable)
    search: _Search = msgspec.field(default_factory=_Search)
    name: str | None = None


def read_body_task(path: str) -> BodyTask:
    """Read the task of a body's design from its TOML file.

    Raises
    ------
    InputError
        The file cannot be read or does not describe a task; the text says where and why.
    """
    file = section_of(path, read_toml(path, "a TOML file of a body's design"), _BodyTaskFile)
    folder = Path(path).parent
    volume = volume_of_table(f"{path}, table volume", file.volume, folder)
    if (file.sensors is None) != (file.sensor_volume is None):
        present, missing = ("sensors", "sensor_volume") if file.sensors else ("sensor_volume", "sensors")
        raise InputError(f"{path}: found table {present} without {missing}, expected both, or none for a fixed array.")
    sensors = None
    if file.sensors is not None and file.sensor_volume is not None:
        place = volume_of_table(f"{path}, table sensor_volume", file.sensor_volume, folder)
        sensors = DesignVolume(place, file.sensors.least_spacing_m)
    return BodyTask(
        name=file.name or Path(path).stem,
        magnets=DesignVolume(volume, file.magnets.least_spacing_m),
        directions_are_free=file.magnets.directions == "free",
        lever_m=file.magnets.lever_m or volume.radius,
        criterion=file.criterion.criterion(),
        sensors=sensors,
        search=file.search.search(),
    )
