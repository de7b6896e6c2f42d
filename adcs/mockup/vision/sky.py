"""Sky of the table: identical lights on the ceiling, and their file.

The file is TOML::

    format_version = 1              # optional
    name = "laboratory"             # optional
    positions_m = [                 # X and Y in the table's frame, one pair for each light
        [1.485, 0.31],
        [-0.2, 0.07],
    ]
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from os import PathLike

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from arrays.io.errors import naming
from arrays.io.text import write_text
from arrays.io.toml import FORMAT_VERSION, File, read_toml, section_of, toml_value
from arrays.io.values import accept_seed, seed_of
from arrays.typing import FloatArray, IntArray, Rng

FEWEST_LIGHTS = 4
"""Least number of lights: two triangles need as many."""
SKY_SIZE_M = (3.0, 2.4)
SPACING_M = 0.07
N_LIGHTS = 180
N_BORDER_LIGHTS = 36
# Four lights are on one circle if the angles at two opposite ones sum to 180°, within rounding or within the noise of
# centroids.
_EXACTLY_RAD = 1e-9
_NEARLY_RAD = math.radians(1.0)
_NEARLY_SHARE = 0.1
_ALIKE_RAD = math.radians(0.02)
_ALIKE_SHARE = 0.5
_BULGE = 0.015  # over the half size; on straight sides rounding would decide which lights are on the hull
_MOST_DARTS = 100_000


class AmbiguousSkyWarning(UserWarning):
    """Warning of regular lights, whose images do not determine the pose."""


@dataclass(frozen=True, eq=False)
class LedSky:
    """Lights on the ceiling.

    A sky causes an :class:`AmbiguousSkyWarning` if its Delaunay triangulation is not unique (four neighbours on one
    circle, as on a square grid), or if its triangles are all similar.

    Attributes
    ----------
    positions_m : ndarray, shape (n, 2)
        X and Y of each light in the table's frame [m].
    name : str
        Name of the sky.

    Raises
    ------
    ValueError
        There are fewer than four lights, two have the same position, all are on one line, or a number is not finite.
    """

    positions_m: FloatArray
    name: str = "sky"

    def __post_init__(self) -> None:
        positions = np.array(self.positions_m, dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 2:
            raise ValueError(f"Input positions_m must have shape (n, 2); instead received shape {positions.shape}.")
        if len(positions) < FEWEST_LIGHTS:
            raise ValueError(
                f"Input positions_m must have at least {FEWEST_LIGHTS} lights; instead received {len(positions)}."
            )
        if not np.isfinite(positions).all():
            raise ValueError("Input positions_m must be finite; instead received NaN or infinity.")
        distance, neighbour = map(np.asarray, cKDTree(positions).query(positions, k=2))
        nearest = int(np.argmin(distance[:, 1]))
        if distance[nearest, 1] <= 1e-9 * np.ptp(positions):
            pair = sorted(neighbour[nearest].tolist())
            raise ValueError(
                "Input positions_m must have each light at its own place; "
                f"instead received lights {pair[0]} and {pair[1]} at the same one."
            )
        # Relative to the middle of the lights, so that rounding of large coordinates does not matter.
        singular_values = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
        if singular_values[1] <= 1e-9 * singular_values[0]:
            raise ValueError("Input positions_m must not be on one line; instead received lights that are.")
        positions.flags.writeable = False
        object.__setattr__(self, "positions_m", positions)
        doubt = self._doubt()
        if doubt:
            warnings.warn(doubt, AmbiguousSkyWarning, stacklevel=3)

    def __len__(self) -> int:
        return len(self.positions_m)

    @property
    def spacing_m(self) -> float:
        """Median distance of a light from its nearest neighbour [m]."""
        return float(np.median(np.asarray(cKDTree(self.positions_m).query(self.positions_m, k=2)[0])[:, 1]))

    @cached_property
    def hull(self) -> IntArray:
        """Lights on the convex hull, in ascending order, shape (h,)."""
        return np.unique(np.asarray(self._delaunay.convex_hull, dtype=np.intp))

    @cached_property
    def _delaunay(self) -> Delaunay:
        try:
            return Delaunay(self.positions_m)
        except QhullError:
            raise ValueError("Input positions_m must not be on one line; instead received lights that are.") from None

    @property
    def cocircular_margins_rad(self) -> FloatArray:
        """Margin of each inner edge from a cocircular case, shape (inner edges,).

        The angles opposite to an edge in its two triangles sum to less than π. If the sum is π, the four corners are on
        one circle, and the other diagonal is a Delaunay edge as well.
        """
        corners, neighbours = self._delaunay.simplices, self._delaunay.neighbors
        angles = interior_angles(self.positions_m[corners])
        triangle, corner = np.nonzero(neighbours > np.arange(len(corners))[:, None])  # each edge once
        other = neighbours[triangle, corner]
        back = np.argmax(neighbours[other] == triangle[:, None], axis=1)
        return math.pi - angles[triangle, corner] - angles[other, back]

    def _doubt(self) -> str:
        margins = self.cocircular_margins_rad
        exact, near = int(np.sum(margins < _EXACTLY_RAD)), int(np.sum(margins < _NEARLY_RAD))
        if exact or near > _NEARLY_SHARE * margins.size:
            return (
                f"The Delaunay triangles of the {len(self)} lights are not unique: {exact or near} of {margins.size} "
                f"pairs of neighbours have their corners {'' if exact else 'nearly '}on one circle, as on a regular "
                "grid; displace lights at random."
            )
        angles = np.sort(interior_angles(self.positions_m[self._delaunay.simplices]), axis=1)[:, [0, 2]]
        nearest = np.asarray(cKDTree(angles).query(angles, k=2)[0])[:, 1]
        if len(angles) > 2 and np.mean(nearest < _ALIKE_RAD) > _ALIKE_SHARE:
            return (
                f"The triangles of the {len(self)} lights are similar, as on a regular grid, and do not determine the "
                "pose of an image; displace lights at random."
            )
        return ""


def interior_angles(triangles: FloatArray) -> FloatArray:
    """Return the interior angles of triangles.

    The angle between sides s and t at a corner is atan2(|s × t|, s · t), which is accurate for flat triangles too.
    ``triangles`` (..., 3, 2): corners. Returns (..., 3): angle at each corner [rad].
    """
    s = np.roll(triangles, -1, axis=-2) - triangles
    t = np.roll(triangles, 1, axis=-2) - triangles
    across = s[..., 0] * t[..., 1] - s[..., 1] * t[..., 0]
    return np.arctan2(np.abs(across), np.sum(s * t, axis=-1))


@accept_seed
def led_sky(rng: Rng = 0) -> LedSky:
    """Return a random sky of 180 lights, 3.0 × 2.4 m, at least 7 cm apart: 322 Delaunay triangles.

    A triangulation of n points with h on the hull has 2n - 2 - h triangles. A random rectangle has about 15 points on
    its hull. Here 36 are on a convex border that bulges by 1.5 %, so that each is certainly a corner of the hull.

    Parameters
    ----------
    rng : int or numpy.random.Generator
        Seed or generator of the places.

    Returns
    -------
    LedSky
        Sky with the border lights first.

    Examples
    --------
    >>> from adcs import mockup
    >>> len(mockup.led_sky())
    180
    """
    seed = seed_of(rng)
    generator = np.random.default_rng(seed)
    half = 0.5 * np.array(SKY_SIZE_M)
    places = np.empty((N_LIGHTS, 2))
    places[:N_BORDER_LIGHTS] = _border(half, generator)
    found = N_BORDER_LIGHTS
    for _ in range(_MOST_DARTS):
        if found == N_LIGHTS:
            return LedSky(places, f"sky {seed}")
        dart = generator.uniform(-1.0, 1.0, 2) * ((1.0 - _BULGE) * half - 0.5 * SPACING_M)
        if np.min(np.sum((places[:found] - dart) ** 2, axis=1)) >= SPACING_M**2:
            places[found] = dart
            found += 1
    raise RuntimeError(f"No place was found for light {found + 1} of {N_LIGHTS}.")  # 8 % of the area are taken


def _border(half: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return lights on a rectangle with convex sides, at nearly equal distances."""
    lengths = 2.0 * np.array([half[0], half[1], half[0], half[1]])
    # Shifts of at most a quarter of the distance keep neighbours 15 cm apart, also around a corner.
    steps = np.arange(N_BORDER_LIGHTS) + rng.uniform(-0.25, 0.25, N_BORDER_LIGHTS)
    along = (steps / N_BORDER_LIGHTS % 1.0) * lengths.sum()
    corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    straight = np.stack([np.interp(along, ends, corners[:, axis]) for axis in range(2)], axis=1)
    return straight * (1.0 - _BULGE * (straight / half)[:, ::-1] ** 2)


class _SkyFile(File, kw_only=True):
    name: str = "sky"
    positions_m: list[tuple[float, float]]


def read_sky(path: str | PathLike[str]) -> LedSky:
    """Read a sky from its TOML file.

    Raises
    ------
    InputError
        The file cannot be read or is not a sky; the text names the key.
    """
    table = section_of(str(path), read_toml(path, "the TOML file of a sky"), _SkyFile)
    with naming(f"{path}, key positions_m"):
        return LedSky(np.array(table.positions_m, dtype=np.float64).reshape(-1, 2), table.name)


def write_sky(sky: LedSky, path: str | PathLike[str]) -> None:
    """Write a sky with all digits as a TOML file that :func:`read_sky` reads."""
    rows = [f"    [{x!r}, {y!r}]," for x, y in sky.positions_m.tolist()]
    lines = [
        f"format_version = {FORMAT_VERSION}",
        f"name = {toml_value(sky.name)}",
        "positions_m = [  # X and Y in the table's frame",
        *rows,
        "]",
        "",
    ]
    write_text("\n".join(lines), path)
