"""Ground of a survey: buried targets, and magnetised rock on all scales."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from sims.noise import stream

_WAVES = 60
_MOST_DRAWS = 10_000


@dataclass(frozen=True)
class Targets:
    """Targets at random positions, uniform over a rectangle, log-uniform in depth and moment.

    Attributes
    ----------
    number : int
    x_m, y_m : pair of floats
        Bounds of the rectangle, world frame.
    depth_m, moment_Am2 : pair of floats
        Least and largest depth below the ground at z = 0, and modulus of the moment.
    gap_m : float
        Least horizontal distance of two targets.
    """

    number: int
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    depth_m: tuple[float, float] = (0.3, 2.0)
    moment_Am2: tuple[float, float] = (0.1, 30.0)
    gap_m: float = 5.0

    def draw(self, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw positions and moments (k, 3) of one realisation.

        Raises ValueError where the rectangle has no room for so many.
        """
        rng = stream(seed, "targets")
        places: list[FloatArray] = []
        for _ in range(_MOST_DRAWS):
            if len(places) == self.number:
                break
            place = rng.uniform((self.x_m[0], self.y_m[0]), (self.x_m[1], self.y_m[1]))
            if all(math.dist(place, other) >= self.gap_m for other in places):
                places.append(place)
        if len(places) < self.number:
            raise ValueError(
                f"Input targets must fit into their rectangle; instead received {self.number} with gaps of "
                f"{self.gap_m:g} m, of which {len(places)} found room."
            )
        depth, size = (_log_uniform(rng, bounds, self.number) for bounds in (self.depth_m, self.moment_Am2))
        direction = rng.standard_normal((self.number, 3))
        moment = size[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return np.column_stack([np.reshape(places, (-1, 2)), -depth]), moment


@dataclass(frozen=True)
class Geology:
    """Random isotropic field of sources below the ground at z = 0, a sum of plane waves.

    Attributes
    ----------
    field_T : float
        Root mean square of each horizontal component at the ground; of the vertical one it is √2 times that.
    shortest_m, longest_m : float
        Wavelengths, log-uniform between them.
    """

    field_T: float
    shortest_m: float = 15.0
    longest_m: float = 80.0

    def at(self, points_m: FloatArray, seed: int) -> FloatArray:
        """Return the field (..., 3) at points of the world."""
        rng = stream(seed, "geology")
        k = 2.0 * math.pi / _log_uniform(rng, (self.shortest_m, self.longest_m), _WAVES)
        way, phase = rng.uniform(0.0, 2.0 * math.pi, (2, _WAVES))
        # The gradient of cos(k·x + φ) e^(-|k| z), each wave with the same share of the power.
        amplitude = 2.0 * self.field_T / math.sqrt(_WAVES)
        total = np.zeros_like(points_m)
        for number, turn, start in zip(k, way, phase, strict=True):
            angle = number * (math.cos(turn) * points_m[..., 0] + math.sin(turn) * points_m[..., 1]) + start
            size = amplitude * np.exp(-number * points_m[..., 2])
            along = -size * np.sin(angle)
            total[..., 0] += math.cos(turn) * along
            total[..., 1] += math.sin(turn) * along
            total[..., 2] -= size * np.cos(angle)
        return total


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float], number: int) -> FloatArray:
    low, high = bounds
    return np.asarray(low * (high / low) ** rng.uniform(size=number))
