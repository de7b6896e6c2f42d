"""What an array is designed for: its sensors, where they may stand, which sources it is to locate, and what counts."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Protocol

import numpy as np
from scipy.special import betainc

from arrays.array import SensorArray
from arrays.sensor import Sensor, SensorKind
from arrays.typing import FloatArray
from magloc.design.volumes import Volume

N_UNKNOWNS = 6
# Numbers that a source is drawn from: three for its position, two for the direction of its moment.
N_DRAWN = 5


class Region(Protocol):
    """A distribution of positions."""

    def positions(self, cube: FloatArray) -> FloatArray:
        """Positions (n, 3) [m] of points (n, 3) of the unit cube."""


@dataclass(frozen=True)
class Cap:
    """Sources within some angle of a direction: a shell around the origin, half of it, or less.

    Distances are evenly distributed, directions evenly over the sphere.

    Attributes
    ----------
    nearest_m, farthest_m : float
        Distance from the origin of the array's frame.
    towards : tuple, shape (3,)
        Axis of the cap, of any length.
    half_angle_rad : float
        π for the whole shell, π/2 for a half-space.
    """

    nearest_m: float
    farthest_m: float
    towards: tuple[float, float, float] = (1.0, 0.0, 0.0)
    half_angle_rad: float = np.pi

    def positions(self, cube: FloatArray) -> FloatArray:
        """Positions (n, 3) [m] of points (n, 3) of the unit cube."""
        along = 1.0 - cube[:, :1] * (1.0 - np.cos(self.half_angle_rad))
        directions = _around(np.array(self.towards), along, cube[:, 1:2])
        return directions * (self.nearest_m + cube[:, 2:3] * (self.farthest_m - self.nearest_m))


@dataclass(frozen=True)
class Block:
    """Sources evenly distributed over a box along the axes.

    Attributes
    ----------
    low_m, high_m : tuple, shape (3,)
        Corners.
    """

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def positions(self, cube: FloatArray) -> FloatArray:
        """Positions (n, 3) [m] of points (n, 3) of the unit cube."""
        low = np.array(self.low_m)
        return low + cube * (np.array(self.high_m) - low)


class Criterion(Protocol):
    """What is made small, of the range deviations of many sources."""

    def weights(self, n: int) -> FloatArray:
        """Weights (n,) of n deviations in ascending order."""

    def of(self, deviations: FloatArray) -> float:
        """The criterion of deviations (n,), without any smoothing."""


@dataclass(frozen=True)
class Quantile:
    """The deviation that a share of the sources stays below.

    Attributes
    ----------
    level : float
        That share.
    """

    level: float = 0.95

    def weights(self, n: int) -> FloatArray:
        """Harrell and Davis' weights of the order statistics (Biometrika 69, 1982), in which the quantile is smooth."""
        edges = np.arange(n + 1) / n
        return np.diff(betainc((n + 1) * self.level, (n + 1) * (1.0 - self.level), edges))

    def of(self, deviations: FloatArray) -> float:
        """Order statistic: an infinite neighbour does not spoil it."""
        return float(np.quantile(deviations, self.level, method="inverted_cdf"))

    def __str__(self) -> str:
        return f"q{100.0 * self.level:g}"


@dataclass(frozen=True)
class Mean:
    """The mean deviation."""

    def weights(self, n: int) -> FloatArray:
        """Equal weights."""
        return np.full(n, 1.0 / n)

    def of(self, deviations: FloatArray) -> float:
        """Arithmetic mean."""
        return float(np.mean(deviations))

    def __str__(self) -> str:
        return "mean"


@dataclass(frozen=True)
class DesignSearch:
    """How hard to search.

    Attributes
    ----------
    n_starts : int
        Shapes and random places to start from.
    n_refined : int
        Best of them, which descend again on the large sample.
    log2_small, log2_large : int
        Sizes of the samples, as powers of two: scrambled Sobol points.
    small_iterations, large_iterations : int
        Steps of a descent at most.
    n_judged : int
        Independent sources that everything is judged on.
    """

    n_starts: int = 16
    n_refined: int = 4
    log2_small: int = 11
    log2_large: int = 14
    small_iterations: int = 84
    large_iterations: int = 250
    n_judged: int = 40_000

    @property
    def n_steps(self) -> int:
        """Steps of all descents together, at most."""
        return self.n_starts * self.small_iterations + self.n_refined * self.large_iterations


@dataclass(frozen=True, eq=False)
class DesignTask:
    """What an array is designed for.

    Attributes
    ----------
    name : str
        Of the task, and of the array.
    n_sensors : int
    kind : {"vector", "scalar"}
        Scalar sensors need an ambient field.
    noise_T : float
        Of every reading [T].
    volume : Volume
        Where the sensors may stand.
    region : Region
        Where the sources are.
    moment_Am2 : float
        Modulus of their moments, whose directions are evenly distributed.
    criterion : Criterion
        Of the Cramér-Rao bound of the range, the distance from the sensors' centroid.
    ambient_T : tuple, shape (3,), optional
        Uniform ambient field [T].
    least_spacing_m : float
        Least distance of two sensors.
    search : DesignSearch
        How hard to search.

    Raises
    ------
    ValueError
        The sensors give fewer than six differences, or are scalar without an ambient field.

    Examples
    --------
    >>> import magloc
    >>> task = magloc.DesignTask.read("half-space-2m")
    >>> task.n_sensors, task.kind
    (4, 'vector')
    """

    name: str
    n_sensors: int
    kind: SensorKind
    noise_T: float
    volume: Volume
    region: Region
    moment_Am2: float
    criterion: Criterion
    ambient_T: tuple[float, float, float] | None = None
    least_spacing_m: float = 0.0
    search: DesignSearch = DesignSearch()

    def __post_init__(self) -> None:
        n_differences = (self.n_sensors - 1) * (3 if self.kind == "vector" else 1)
        if n_differences < N_UNKNOWNS:
            least = 1 + N_UNKNOWNS // (3 if self.kind == "vector" else 1)
            raise ValueError(
                f"Input n_sensors must be at least {least} for {self.kind} sensors, whose differences have to give a"
                f" position and a moment; instead received {self.n_sensors}."
            )
        if self.kind == "scalar" and self.ambient_T is None:
            raise ValueError("Input ambient_T must be given for scalar sensors; instead received None.")

    @classmethod
    def read(cls, name_or_path: str | PathLike[str]) -> DesignTask:
        """Task of a built-in name, such as "half-space-2m", or a TOML file (:mod:`magloc.design.task_files`).

        Raises
        ------
        InputError
            The file cannot be read or does not describe a task; the text says where and why.
        """
        from magloc.design.task_files import read_task

        return read_task(str(name_or_path))

    def array(self, positions: FloatArray, name: str | None = None) -> SensorArray:
        """Array of the task's sensors at positions (n, 3) [m]."""
        sensors = (
            Sensor(f"s{i}", self.kind, tuple(place), self.noise_T) for i, place in enumerate(positions.tolist(), 1)
        )
        return SensorArray(tuple(sensors), self.name if name is None else name, ambient_T=self.ambient_T)

    def sources(self, cube: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions [m] and moments [A·m²], both (n, 3), of points (n, 5) of the unit cube."""
        moments = _around(np.array([0.0, 0.0, 1.0]), 1.0 - 2.0 * cube[:, 3:4], cube[:, 4:5])
        return self.region.positions(cube[:, :3]), self.moment_Am2 * moments


def _around(axis: FloatArray, along: FloatArray, turn: FloatArray) -> FloatArray:
    """Unit vectors with given cosines (n, 1) to an axis (3,), turned around it by shares (n, 1) of a revolution."""
    n = axis / np.linalg.norm(axis)
    first = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    first /= np.linalg.norm(first)
    across = np.sqrt(np.maximum(0.0, 1.0 - along * along))
    angle = 2.0 * np.pi * turn
    return along * n + across * (np.cos(angle) * first + np.sin(angle) * np.cross(n, first))
