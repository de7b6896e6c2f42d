"""The TOML file of a body of several magnets.

::

    name = "knob"                       # optional
    temperature_sigma_K = 10.0          # optional, 1 sigma of the magnets' temperature, common to all
    remanence_percent_K = -0.11         # optional, change of all moments per kelvin (NdFeB)

    [[magnet]]                          # two or more
    id = "m1"
    position_m = [0.006, 0.0, 0.0]      # body frame
    moment_Am2 = [0.0, 0.0, 0.05]       # or a number, with
    direction = [0.0, 0.0, 1.0]         # of any length
    moment_sigma_Am2 = 0.002            # optional, 1 sigma of the modulus
    position_sigma_m = 0.0001           # optional, 1 sigma per axis
    direction_sigma_deg = 1.0           # optional, 1 sigma about each axis across the moment
    shape = "cylinder"                  # optional: cuboid, cylinder, ring, sphere; without it a dipole
    size_m = [0.004, 0.003]             # cuboid: edges; cylinder: diameter, height; ring: inner and outer diameter,
                                        # height; sphere: diameter
    rotation_xyzw = [0, 0, 0, 1]        # optional, axes of the shape -> body; by default a cylinder or ring has its
                                        # axis along the moment, a cuboid its edges along the body's axes
    [range]                             # optional, limits of the pose in the array's frame
    position_m = [[-0.003, 0.003], [-0.003, 0.003], [0.010, 0.014]]  # inf and -inf: no limit
    angle_deg = 20.0                    # largest rotation from rest, where the axes of body and array agree
"""

from __future__ import annotations

import math
from os import PathLike
from typing import Annotated, Any, ClassVar

import numpy as np

from arrays.io.errors import InputError, naming
from arrays.io.text import write_text
from arrays.io.toml import (
    FORMAT_VERSION,
    File,
    NotNegative,
    RefusalError,
    Table,
    check_keys,
    item_place,
    one_of,
    read_toml,
    section_of,
    toml_value,
)
from arrays.typing import Vector
from magloc.bodies.body import NDFEB_PER_K, Magnet, MagnetBody, PoseLimits
from magloc.fields.shapes import KINDS, Shape

_PERCENT = 100.0
_LARGEST_M = 100.0


class _MagnetTable(Table, kw_only=True):
    id: str
    position_m: Vector
    moment_Am2: float | Vector
    direction: Vector | None = None
    moment_sigma_Am2: NotNegative = 0.0
    position_sigma_m: NotNegative = 0.0
    direction_sigma_deg: NotNegative = 0.0
    shape: Annotated[str, one_of(KINDS)] | None = None
    size_m: float | list[float] | None = None
    rotation_xyzw: tuple[float, float, float, float] | None = None

    def check(self) -> None:
        is_number = isinstance(self.moment_Am2, float)
        if is_number and self.direction is None:
            raise RefusalError("moment_Am2", "found a number without a direction, expected 3 numbers, or both keys")
        if not is_number and self.direction is not None:
            raise RefusalError("direction", "found it with a moment of 3 numbers, expected moment_Am2 as a number")
        if isinstance(self.moment_Am2, float) and not self.moment_Am2 > 0.0:
            raise RefusalError("moment_Am2", f"found {self.moment_Am2:g}, expected a positive number")
        if self.direction is not None and not any(self.direction):
            raise RefusalError("direction", "found zero, expected a vector of any length")

        if (self.shape is None) != (self.size_m is None):
            present, missing = ("size_m", "shape") if self.shape is None else ("shape", "size_m")
            raise RefusalError(present, f"found it without {missing}, expected both keys, or none for a dipole")
        if self.rotation_xyzw is not None and self.shape is None:
            raise RefusalError("rotation_xyzw", "found it without a shape, expected the direction of the moment alone")

    def magnet(self) -> Magnet:
        """Return the magnet of the table."""
        moment = self.moment_Am2
        if isinstance(moment, float):
            direction = np.array(self.direction)
            moment = tuple((moment / np.linalg.norm(direction) * direction).tolist())
        return Magnet(
            self.id,
            self.position_m,
            moment,
            self.moment_sigma_Am2,
            self.position_sigma_m,
            math.radians(self.direction_sigma_deg),
            self._shape(),
            self.rotation_xyzw,
        )

    def _shape(self) -> Shape | None:
        if self.shape is None or self.size_m is None:
            return None
        return Shape(self.shape, tuple(self.size_m) if isinstance(self.size_m, list) else (self.size_m,))


class _RangeTable(Table, kw_only=True):
    floats_may_be_infinite: ClassVar[bool] = True

    position_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] | None = None
    angle_deg: float = 180.0

    def limits(self) -> PoseLimits:
        """Return the limits of the table."""
        angle_rad = math.radians(self.angle_deg)
        if self.position_m is None:
            return PoseLimits(angle_rad=angle_rad)
        low, high = zip(*self.position_m, strict=True)
        return PoseLimits(low, high, angle_rad)


class _BodyFile(File, kw_only=True):
    magnet: list[_MagnetTable]
    name: str = ""
    temperature_sigma_K: NotNegative = 0.0
    remanence_percent_K: float = _PERCENT * NDFEB_PER_K
    range: _RangeTable | None = None


def read_body(path: str | PathLike[str]) -> MagnetBody:
    """Read a body of several magnets from its TOML file.

    Parameters
    ----------
    path : str or path-like
        Body file (TOML).

    Returns
    -------
    MagnetBody
        Body of two or more magnets.

    Raises
    ------
    InputError
        The file cannot be read or describes no body; the text states the place and the reason.
    """
    table = read_toml(path, "a TOML file of a body")
    return body_of_table(str(path), table)


def body_of_table(place: str, table: dict[str, Any]) -> MagnetBody:
    """Return a body from the keys of a body file; `place` is for errors."""
    if "magnet" not in table:
        check_keys(place, table, _BodyFile.__struct_fields__)
        raise InputError(f"{place}: found no [[magnet]] tables, expected two or more.")
    file = section_of(place, table, _BodyFile)
    magnets = []
    for i, (raw, magnet) in enumerate(zip(table["magnet"], file.magnet, strict=True)):
        where = item_place(place, "magnet", i, raw, _MagnetTable)
        if max(map(abs, magnet.position_m)) > _LARGEST_M:
            farthest = max(map(abs, magnet.position_m))
            raise InputError(f"{where}, key position_m: found {farthest:g}, expected metres, {_LARGEST_M:g} at most.")
        with naming(where):
            magnets.append(magnet.magnet())
    with naming(f"{place}, table range"):
        limits = PoseLimits() if file.range is None else file.range.limits()
    with naming(place):
        return MagnetBody(
            tuple(magnets), file.name, limits, file.temperature_sigma_K, file.remanence_percent_K / _PERCENT
        )


def write_body(path: str | PathLike[str], body: MagnetBody) -> None:
    """Write a body's TOML file, from which :func:`read_body` makes an equal body.

    Parameters
    ----------
    path : path-like
        File to write; an existing file is replaced in one step.
    body : MagnetBody
        Body of two or more magnets.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    write_text(body_toml(body), path)


def body_toml(body: MagnetBody) -> str:
    """Return the text of a body's TOML file."""
    lines = [f"format_version = {FORMAT_VERSION}"]
    if body.name:
        lines.append(f"name = {toml_value(body.name)}")
    if body.temperature_sigma_K:
        lines.append(f"temperature_sigma_K = {toml_value(body.temperature_sigma_K)}")
    if body.remanence_per_K != NDFEB_PER_K:
        lines.append(f"remanence_percent_K = {toml_value(_PERCENT * body.remanence_per_K)}")
    for magnet in body.magnets:
        lines += ["", "[[magnet]]", f"id = {toml_value(magnet.id)}"]
        lines += [f"{key} = {toml_value(list(getattr(magnet, key)))}" for key in ("position_m", "moment_Am2")]
        for key in ("moment_sigma_Am2", "position_sigma_m"):
            if getattr(magnet, key):
                lines.append(f"{key} = {toml_value(getattr(magnet, key))}")
        if magnet.direction_sigma_rad:
            lines.append(f"direction_sigma_deg = {toml_value(math.degrees(magnet.direction_sigma_rad))}")
        if magnet.shape is not None:
            lines += [f"shape = {toml_value(magnet.shape.kind)}", f"size_m = {toml_value(list(magnet.shape.size_m))}"]
        if magnet.rotation_xyzw is not None:
            lines.append(f"rotation_xyzw = {toml_value(list(magnet.rotation_xyzw))}")
    if body.limits != PoseLimits():
        lines += ["", "[range]"]
        if any(map(math.isfinite, (*body.limits.low_m, *body.limits.high_m))):
            box = [list(pair) for pair in zip(body.limits.low_m, body.limits.high_m, strict=True)]
            lines.append(f"position_m = {toml_value(box)}")
        lines.append(f"angle_deg = {toml_value(math.degrees(body.limits.angle_rad))}")
    return "\n".join(lines) + "\n"
