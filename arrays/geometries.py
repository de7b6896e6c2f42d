"""Arrays of equal sensors in common shapes.

All are centred on the origin of the array's frame, with the sensors' axes along the frame's and ids s1, s2, …
Each takes one size, under the name that an array file gives it. The last sensor is the base of the paper's differences.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np

from arrays.array import SensorArray
from arrays.sensor import Sensor, SensorKind
from arrays.typing import FloatArray


def tetrahedron(edge_m: float, kind: SensorKind = "vector", noise_T: float = 1e-9) -> SensorArray:
    """Four sensors on a regular tetrahedron, the shape in Pavlov, Karshakov and Goldin.

    The base s1, s2, s3 is parallel to the x-y plane and lies edge/√24 below it, with s1 towards +x and s2 at y > 0; the
    apex s4 stands on +z. The circumradius is edge·√(3/8).

    Parameters
    ----------
    edge_m : float
        Distance between any two sensors [m].
    kind : {"vector", "scalar"}
        Kind of the sensors.
    noise_T : float
        Standard deviation of a reading [T].

    Returns
    -------
    SensorArray
        Array centred on the origin, with sensors s1, s2, … whose axes are parallel to the array's.

    Examples
    --------
    >>> import arrays
    >>> array = arrays.tetrahedron(1.5, noise_T=1e-10)
    >>> array.ids, round(array.circumradius, 3)
    (('s1', 's2', 's3', 's4'), 0.919)
    """
    edge = _size("edge_m", edge_m)
    base = _ring(3, edge / np.sqrt(3.0))
    base[:, 2] = -edge / np.sqrt(24.0)
    apex = [[0.0, 0.0, edge * np.sqrt(3.0 / 8.0)]]
    return _array("tetrahedron", np.concatenate([base, apex]), kind, noise_T)


def square(edge_m: float, kind: SensorKind = "vector", noise_T: float = 1e-9) -> SensorArray:
    """Four sensors on a square in the x-y plane with sides along x and y, counter-clockwise from the first quadrant.

    Parameters
    ----------
    edge_m : float
        Side of the square [m].
    kind : {"vector", "scalar"}
        Kind of the sensors.
    noise_T : float
        Standard deviation of a reading [T].

    Returns
    -------
    SensorArray
        Array centred on the origin, with sensors s1, s2, … whose axes are parallel to the array's.

    Examples
    --------
    >>> import arrays
    >>> arrays.square(2.0).positions[0]
    array([1., 1., 0.])
    """
    half = _size("edge_m", edge_m) / 2.0
    return _array("square", half * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]), kind, noise_T)


def cross(arm_m: float, kind: SensorKind = "vector", noise_T: float = 1e-9) -> SensorArray:
    """Four sensors on the axes of the x-y plane: at +x, +y, -x, -y.

    Parameters
    ----------
    arm_m : float
        Distance of each sensor from the centre [m].
    kind : {"vector", "scalar"}
        Kind of the sensors.
    noise_T : float
        Standard deviation of a reading [T].

    Returns
    -------
    SensorArray
        Array centred on the origin, with sensors s1, s2, … whose axes are parallel to the array's.

    Examples
    --------
    >>> import arrays
    >>> arrays.cross(0.5, "scalar", noise_T=1e-11).positions[0]
    array([0.5, 0. , 0. ])
    """
    arm = _size("arm_m", arm_m)
    return _array("cross", arm * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]), kind, noise_T)


def cube(edge_m: float, kind: SensorKind = "vector", noise_T: float = 1e-9) -> SensorArray:
    """Eight sensors on the corners of a cube with edges along the axes; z changes fastest, then y.

    Parameters
    ----------
    edge_m : float
        Edge of the cube [m].
    kind : {"vector", "scalar"}
        Kind of the sensors.
    noise_T : float
        Standard deviation of a reading [T].

    Returns
    -------
    SensorArray
        Array centred on the origin, with sensors s1, s2, … whose axes are parallel to the array's.

    Examples
    --------
    >>> import arrays
    >>> arrays.cube(2.0).positions[:2]
    array([[-1., -1., -1.],
           [-1., -1.,  1.]])
    """
    half = _size("edge_m", edge_m) / 2.0
    signs = (-1, 1)
    return _array("cube", half * np.array([[x, y, z] for x in signs for y in signs for z in signs]), kind, noise_T)


def hexagon(radius_m: float, kind: SensorKind = "vector", noise_T: float = 1e-9) -> SensorArray:
    """Six sensors on a regular hexagon in the x-y plane, counter-clockwise from +x.

    Parameters
    ----------
    radius_m : float
        Distance of each sensor from the centre, and from its neighbours [m].
    kind : {"vector", "scalar"}
        Kind of the sensors.
    noise_T : float
        Standard deviation of a reading [T].

    Returns
    -------
    SensorArray
        Array centred on the origin, with sensors s1, s2, … whose axes are parallel to the array's.

    Examples
    --------
    >>> import arrays
    >>> arrays.hexagon(0.3).ids
    ('s1', 's2', 's3', 's4', 's5', 's6')
    """
    return _array("hexagon", _ring(6, _size("radius_m", radius_m)), kind, noise_T)


def axial(baseline_m: float, kind: SensorKind = "vector", noise_T: float = 1e-9) -> SensorArray:
    """Two sensors on the z axis, the upper one first: an axial gradiometer.

    Parameters
    ----------
    baseline_m : float
        Distance between the sensors [m].
    kind : {"vector", "scalar"}
        Kind of the sensors.
    noise_T : float
        Standard deviation of a reading [T].

    Returns
    -------
    SensorArray
        Array centred on the origin, with sensors s1, s2, … whose axes are parallel to the array's.

    Examples
    --------
    >>> import arrays
    >>> arrays.axial(0.5).positions
    array([[ 0.  ,  0.  ,  0.25],
           [ 0.  ,  0.  , -0.25]])
    """
    half = _size("baseline_m", baseline_m) / 2.0
    return _array("axial", half * np.array([[0, 0, 1], [0, 0, -1]]), kind, noise_T)


def grid(nx: int, ny: int, pitch_m: float, kind: SensorKind = "vector", noise_T: float = 1e-9) -> SensorArray:
    """Board of sensors: a grid in the x-y plane with rows along x; x changes fastest.

    Parameters
    ----------
    nx, ny : int
        Sensors along x and y, at least 1 and together at least 2.
    pitch_m : float
        Distance between neighbours [m].
    kind : {"vector", "scalar"}
        Kind of the sensors.
    noise_T : float
        Standard deviation of a reading [T].

    Returns
    -------
    SensorArray
        Array centred on the origin, with sensors s1, s2, … whose axes are parallel to the array's.

    Examples
    --------
    >>> import arrays
    >>> board = arrays.grid(5, 6, 0.016, noise_T=15e-9)
    >>> board.n_sensors, board.n_channels
    (30, 90)
    """
    if min(nx, ny) < 1 or nx * ny < 2:
        raise ValueError(f"Inputs nx and ny must be at least 1, together at least 2; instead received {nx} and {ny}.")
    pitch = _size("pitch_m", pitch_m)
    y, x = np.meshgrid(np.arange(ny) - 0.5 * (ny - 1), np.arange(nx) - 0.5 * (nx - 1), indexing="ij")
    return _array("grid", pitch * np.stack([x.ravel(), y.ravel(), np.zeros(nx * ny)], axis=1), kind, noise_T)


class _Maker(Protocol):
    def __call__(self, size_m: float, /, kind: SensorKind = ..., noise_T: float = ...) -> SensorArray: ...


class Geometry(NamedTuple):
    """A shape that an array file can name.

    Attributes
    ----------
    make : callable
        ``make(size, kind, noise_T)`` returns the array.
    size_key : str
        Key of the size in the file, and name of the function's first parameter.
    """

    make: _Maker
    size_key: str


GEOMETRIES: Mapping[str, Geometry] = MappingProxyType(
    {
        "tetrahedron": Geometry(tetrahedron, "edge_m"),
        "square": Geometry(square, "edge_m"),
        "cross": Geometry(cross, "arm_m"),
        "cube": Geometry(cube, "edge_m"),
        "hexagon": Geometry(hexagon, "radius_m"),
        "axial": Geometry(axial, "baseline_m"),
    }
)
"""Geometries by the name that an array file gives them."""


def _array(name: str, positions: FloatArray, kind: SensorKind, noise_T: float) -> SensorArray:
    sensors = (Sensor(f"s{i}", kind, tuple(p), noise_T) for i, p in enumerate(positions.tolist(), start=1))
    return SensorArray(tuple(sensors), name)


def _ring(n: int, radius: float) -> FloatArray:
    """Return points on a circle in the x-y plane, counter-clockwise from +x."""
    angle = 2.0 * np.pi / n * np.arange(n)
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)


def _size(name: str, value: float) -> float:
    if not (np.ndim(value) == 0 and 0.0 < value < np.inf):
        raise ValueError(f"Input {name} must be a positive finite number; instead received {value}.")
    return float(value)
