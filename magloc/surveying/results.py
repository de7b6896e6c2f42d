"""Targets of a survey."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, overload

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.results import Result
from arrays.io.tables import aligned, by_sigma
from arrays.typing import FloatArray, Vector
from magloc.localization.fit.table import cells_of_strength
from magloc.surveying.files import columns_of_survey, geojson_of_survey, kml_of_survey

IRON_Am2_PER_KG = (0.05, 0.3)
"""Moment of a kilogram of iron in the ground: a range, as its remanence and shape are not known."""
_MOST_POINTS = 20_000
_MOST, _LEAST_LINEAR = 0.8, 1e-3


@dataclass(frozen=True, eq=False)
class Target:
    """A buried dipole.

    Attributes
    ----------
    id : str
    position_m, moment_Am2 : ndarray, shape (3,)
        World frame.
    covariance : ndarray, shape (6, 6)
        Of position and moment, everything else in the survey eliminated.
    depth_m : float
        Below the ground.
    depth_interval95_m : tuple of 2 floats
        From the profile of χ² where the target is weak, whose depth is not Gaussian.
    significance : float
        χ² that is lost without it, of 3 degrees of freedom.
    flags : tuple of str
        ``weak``: the ellipse is not Gaussian. ``near``: another target is so near that one of the two may be spurious.
        ``merged``: the rows hold more than one there, too near to be told apart. ``edge``: at the rim of what was
        searched. ``misfit``: the rows above it do not fit a dipole within what is stated of noise and pose, so that its
        errors are larger than its covariance says.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, seed=1)
    >>> target = magloc.survey(field.array, field.readings)[0]
    >>> target.id, round(target.depth_m, 1), round(target.strength_Am2)
    ('t1', 0.4, 13)
    """

    id: str
    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    depth_m: float
    depth_interval95_m: tuple[float, float]
    significance: float
    flags: tuple[str, ...] = ()

    @property
    def strength_Am2(self) -> float:
        """Modulus of the moment [A·m²]."""
        return float(np.linalg.norm(self.moment_Am2))

    @property
    def iron_kg(self) -> tuple[float, float]:
        """Mass of iron with such a moment, from the most to the least magnetic."""
        least, most = IRON_Am2_PER_KG
        return self.strength_Am2 / most, self.strength_Am2 / least

    @property
    def in_words(self) -> str:
        """Depth, strength and mass of iron in a sentence."""
        low, high = self.depth_interval95_m
        least, most = self.iron_kg
        return (
            f"{self.depth_m:.2f} m below ground (95 %: {low:.2f} to {high:.2f} m), {self.strength_Am2:.3g} A·m²: "
            f"{least:.2g} to {most:.2g} kg of iron, if a kilogram has {IRON_Am2_PER_KG[0]:g} to "
            f"{IRON_Am2_PER_KG[1]:g} A·m². {' '.join(self.flags)}"
        )

    @property
    def ellipse95(self) -> tuple[float, float, float]:
        """Half axes [m] of the 95 % ellipse on the map, and the bearing of the longer one, clockwise from north."""
        values, vectors = np.linalg.eigh(self.covariance[:2, :2])
        minor, major = np.sqrt(chdtri(2, 0.05) * values)
        return float(major), float(minor), math.degrees(math.atan2(vectors[0, 1], vectors[1, 1])) % 180.0


class SurveyRows(NamedTuple):
    """Of n rows: time, place (n, 3), anomaly along the ambient field, mean of the sensors, and what targets leave."""

    time_s: FloatArray
    place_m: FloatArray
    anomaly_T: FloatArray
    residual_T: FloatArray

    def thinned(self) -> SurveyRows:
        """Evenly as many as a picture shows."""
        return SurveyRows(*(column[:: -(-len(self.time_s) // _MOST_POINTS)] for column in self))


def linear_and_most(values: FloatArray) -> tuple[float, float]:
    """Ends of a scale of values of either sign: linear up to the first, where most of them are, logarithmic beyond."""
    size = np.abs(values)
    most = float(size.max()) or 1.0
    return max(float(np.quantile(size, _MOST)), _LEAST_LINEAR * most), most


class Reach(NamedTuple):
    """What could have been found: places (k, 3), and the moments (k,) seen there with 95 %, however they point."""

    place_m: FloatArray
    moment_Am2: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class Survey(Result):
    """What a survey found.

    Attributes
    ----------
    targets : tuple of Target
        The most significant one first.
    array : SensorArray
        The sensors that were used, and what their pose was taken for.
    rows : SurveyRows
        Every row's anomaly, and what the targets leave of it.
    reach : Reach
        The least moments that the lines as flown show, 0.5, 1 and 2 m below the ground.
    ground_m : float
        Height of the ground in the world frame.
    threshold : float
        χ² of 3 degrees of freedom that a target exceeds.
    chi2_per_dof : float
        Of all white residuals: 1 where what is stated of the errors is right.
    pose_assumed : bool
        Whether nothing was stated of the pose's errors, so that they are what the rows tell: `array.pose`.
    lag_s : float
        How much later the readings were taken for than they were, as the targets showed and as was corrected: 0 where
        they showed nothing.
    seconds : float

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, seed=1)
    >>> magloc.survey(field.array, field.readings)
    Survey: 3 targets, 1921 rows
    """

    figure = "magloc.plots.surveys:survey_figure"
    command = "survey"
    dimension = "target"
    frame = "world"

    targets: tuple[Target, ...]
    array: SensorArray
    rows: SurveyRows
    reach: Reach
    ground_m: float
    threshold: float
    chi2_per_dof: float
    pose_assumed: bool
    lag_s: float
    seconds: float

    def __len__(self) -> int:
        return len(self.targets)

    def __iter__(self) -> Iterator[Target]:
        return iter(self.targets)

    @overload
    def __getitem__(self, index: int) -> Target: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Target]: ...
    def __getitem__(self, index: int | slice) -> Target | Sequence[Target]:
        return self.targets[index]

    def __repr__(self) -> str:
        return f"Survey: {len(self)} target{'s' * (len(self) != 1)}, {len(self.rows.time_s)} rows"

    @cached_property
    def position_m(self) -> FloatArray:
        """Positions of all targets (K, 3)."""
        return np.array([target.position_m for target in self]).reshape(-1, 3)

    def columns(self) -> dict[str, Column]:
        """Return the columns of targets.csv."""
        return columns_of_survey(self)

    def to_geojson(self, place: Vector) -> dict[str, Any]:
        """A FeatureCollection with a point for every target, as RFC 7946 has it.

        Parameters
        ----------
        place : tuple of 3 floats
            Latitude, longitude [deg] and height [m] of the origin of the world frame, which is east, north, up.
        """
        return geojson_of_survey(self, place)

    def to_kml(self, place: Vector) -> str:
        """A placemark for every target, for maps of the world; ``place`` as of :meth:`to_geojson`."""
        return kml_of_survey(self, place)

    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines of the table, of at most `most` targets."""
        rows = [
            ["id", "x", "y", "depth", "95 %", "|m|", "± xy", "χ²", "flags"],
            ["", "m", "m", "m", "m", "A·m²", "cm", "", ""],
        ]
        for t in self[:most]:
            sigma = np.sqrt(np.diagonal(t.covariance)).tolist()
            x, y, depth, *interval = (
                by_sigma(float(value), s)[0]
                for value, s in zip(
                    [*t.position_m[:2], t.depth_m, *t.depth_interval95_m], [*sigma[:2], *sigma[2:3] * 3], strict=True
                )
            )
            strength, _ = cells_of_strength(t.moment_Am2, t.covariance[3:, 3:])
            across = f"{100.0 * t.ellipse95[0]:.2g}"
            size = [strength, across, f"{t.significance:.4g}"]
            rows.append([t.id, x, y, depth, "–".join(interval), *size, ", ".join(t.flags)])
        return aligned(rows)
