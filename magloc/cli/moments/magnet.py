"""Options of a magnet of known shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from arrays.io.errors import InputError, naming_options

if TYPE_CHECKING:
    from magloc.fields.shapes import Shape

_LARGEST_M = 0.5


@Parameter(name="*", group="Magnet of known shape")
@dataclass(frozen=True)
class MagnetOptions:
    """A source that is a single magnet of known shape, exact also near the sensors.

    Parameters
    ----------
    kind : {"cuboid", "cylinder", "ring", "sphere"}
        Shape of the magnet, which is magnetised along its axis: the axis of a cylinder or ring, or the last edge of a
        cuboid whose other two edges are equal. Needs --size-m.
    size_m : list of float
        Sizes of --magnet [m]: three edges of a cuboid; diameter and height of a cylinder; inner and outer diameter and
        height of a ring; diameter of a sphere.
    """

    kind: Annotated[Literal["cuboid", "cylinder", "ring", "sphere"] | None, Parameter(name="--magnet")] = None
    size_m: Annotated[list[float] | None, Parameter(name="--size-m", consume_multiple=True)] = None

    def shape(self, **others: object) -> Shape | None:
        """Return the shape, or None without one; refuse other options, by their names, together with it."""
        if self.kind is None or self.size_m is None:
            if self.kind is not None or self.size_m is not None:
                found, missing = ("--magnet", "--size-m") if self.size_m is None else ("--size-m", "--magnet")
                raise InputError(f"{found}: found no {missing}, expected both.")
            return None
        for name, value in others.items():
            if value is not None:
                raise InputError(f"--{name.replace('_', '-')}: found together with --magnet, expected one of them.")
        if max(self.size_m) > _LARGEST_M:
            raise InputError(
                f"--size-m: found {max(self.size_m):g}, expected at most {_LARGEST_M:g} m; 10 mm are 0.01 m."
            )
        from magloc.fields.shapes import Shape

        with naming_options("size_m", "magnet"):
            shape = Shape(self.kind, tuple(self.size_m))
            shape.check_aligned()
        return shape
