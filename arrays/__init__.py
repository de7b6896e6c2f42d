"""Arrays of magnetometers: what the sensors are, where they stand, and how they differ.

The names below are loaded when they are first used, so that a program which needs only its errors starts quickly. The
meshes of an array are in :mod:`arrays.meshes`, which needs trimesh.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from arrays.errors import InputError
    from arrays.files import array_toml, read_array, write_array
    from arrays.geometries import GEOMETRIES, axial, cross, cube, hexagon, square, tetrahedron
    from arrays.sensor import Calibration, Sensor, SensorArray, SensorKind

__all__ = [
    "GEOMETRIES",
    "Calibration",
    "InputError",
    "Sensor",
    "SensorArray",
    "SensorKind",
    "array_toml",
    "axial",
    "cross",
    "cube",
    "hexagon",
    "read_array",
    "square",
    "tetrahedron",
    "write_array",
]

_MODULES = ("errors", "sensor", "geometries", "files")


def __getattr__(name: str) -> object:
    if name in __all__:
        for module in _MODULES:
            contents = vars(import_module(f"{__name__}.{module}"))
            if name in contents:
                return contents[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
