"""Targets of a survey."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np
from scipy.spatial import Delaunay
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.results import Result
from arrays.io.tables import align, by_sigma
from arrays.typing import FloatArray, IntArray, Vector
from magloc.localization.fit.table import cells_of_strength
from magloc.navigation.flight_lines import FlightLine, flight_lines
from magloc.surveying.fit.levelling import FEWEST_LINES, line_levels
from magloc.surveying.review.decisions import Decision
from magloc.terrain.surface import Terrain
from magloc.truth import state_columns

if TYPE_CHECKING:
    from magloc.surveying.review.state import SurveyState

IRON_Am2_PER_KG = (0.05, 0.3)
"""Moment of a kilogram of iron in the ground: a range, as its remanence and shape are not known."""
SIZE_CLASSES_Am2 = {"small": 0.0, "medium": 0.3, "large": 3.0}
"""Least moment of each class of size. 0.3 A·m² are 1 to 6 kg of iron, 3 A·m² are 10 to 60 kg."""
_POOR_FITS = ("misfit", "merged", "near", "edge", "weak")  # flags that make a fit worse than good, the worst first
_MOST_POINTS = 20_000
_MOST, _LEAST_LINEAR = 0.8, 1e-3
_FLAT = 1e-6  # largest ratio of width to length of a line
_GAP = 3.0  # shortest gap, in usual steps between places, across which nothing is known


@dataclass(frozen=True, eq=False)
class Target:
    """A buried dipole.

    Attributes
    ----------
    id : str
    position_m, moment_Am2 : ndarray, shape (3,)
        Position [m] and moment [A·m²] in the world frame.
    covariance : ndarray, shape (6, 6)
        Covariance of position and moment, with all other unknowns of the survey eliminated.
    depth_m : float
        Depth below the ground.
    depth_interval95_m : tuple of 2 floats
        95 % interval of the depth; for a weak target from the profile of χ², because its depth is not Gaussian.
    significance : float
        Increase of χ² without the target, with 3 degrees of freedom.
    flags : tuple of str
        ``weak``: the ellipse is not Gaussian. ``near``: another target is so near that one of the two may be spurious.
        ``merged``: there is more than one target, too near to be separated. ``edge``: at the edge of the searched
        volume. ``misfit``: the rows above it do not fit a dipole within the stated errors of noise and pose, so that
        its errors are larger than its covariance says.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
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
    def size_class(self) -> str:
        """Class of size by the moment: small, medium or large, with the bounds ``SIZE_CLASSES_Am2``."""
        return [name for name, least in SIZE_CLASSES_Am2.items() if self.strength_Am2 >= least][-1]

    @property
    def fit_quality(self) -> str:
        """Quality of the dipole fit: ``good``, or the first of the flags misfit, merged, near, edge, weak."""
        return next((flag for flag in _POOR_FITS if flag in self.flags), "good")

    @property
    def ellipse95(self) -> tuple[float, float, float]:
        """Half axes [m] of the 95 % ellipse on the map, and bearing of the longer one.

        The bearing counts clockwise from north.
        """
        values, vectors = np.linalg.eigh(self.covariance[:2, :2])
        minor, major = np.sqrt(chdtri(2, 0.05) * values)
        return float(major), float(minor), math.degrees(math.atan2(vectors[0, 1], vectors[1, 1])) % 180.0


class SurveyRows(NamedTuple):
    """Time, place (n, 3), anomaly along the ambient field, and residual of n rows.

    Anomaly and residual are means over the sensors.
    """

    time_s: FloatArray
    place_m: FloatArray
    anomaly_T: FloatArray
    residual_T: FloatArray

    def decimate(self) -> SurveyRows:
        """Return evenly spaced rows, as many as a picture shows."""
        return SurveyRows(*(column[:: -(-len(self.time_s) // _MOST_POINTS)] for column in self))


def linear_and_most(values: FloatArray) -> tuple[float, float]:
    """Return the linear threshold and the largest value of a symmetric logarithmic scale.

    Most values lie in the linear range.
    """
    size = np.abs(values)
    most = float(size.max()) or 1.0
    return max(float(np.quantile(size, _MOST)), _LEAST_LINEAR * most), most


class Reach(NamedTuple):
    """Places (k, 3), and the least moments (k,) that are found there with 95 %.

    The moments hold for the worst direction.
    """

    place_m: FloatArray
    moment_Am2: FloatArray


def neighbour_triangles(xy_m: FloatArray) -> IntArray:
    """Return triangles (k, 3) of places (n, 2) that are neighbours; none where all lie on one line."""
    if len(xy_m) < 3 or np.linalg.matrix_rank(xy_m - xy_m.mean(axis=0), rtol=_FLAT) < 2:
        return np.zeros((0, 3), dtype=np.int64)
    corners = Delaunay(xy_m).simplices
    sides = np.linalg.norm(xy_m[corners] - xy_m[np.roll(corners, 1, axis=1)], axis=2)
    return np.asarray(corners[(sides <= _GAP * np.median(sides)).all(axis=1)], dtype=np.int64)


@dataclass(frozen=True, eq=False, repr=False)
class Survey(Result):
    """Targets, rows and reach of a survey.

    Attributes
    ----------
    targets : tuple of Target
        Targets, the most significant one first.
    array : SensorArray
        Array of the sensors that were used, with the assumed pose errors.
    rows : SurveyRows
        Anomaly and residual of every row.
    reach : Reach
        Least moments that the lines as flown detect, 0.5, 1 and 2 m below the ground.
    terrain : Terrain
        Ground in the world frame.
    threshold : float
        χ² with 3 degrees of freedom that a target exceeds.
    chi2_per_dof : float
        χ² of all white residuals per degree of freedom: 1 if the stated errors are right.
    pose_assumed : bool
        True if the pose errors (`array.pose`) are estimated from the rows because none were stated.
    lag_s : float
        Delay of the readings after their poses, estimated from the targets and corrected; 0 if the targets show none.
    seconds : float
    named_lines : tuple of (float, str)
        Times [s] at which the lines of the log begin, and their names; empty if the log names none.
    state : SurveyState, optional
        Rows and sources, for a :class:`magloc.Review`.
    decisions : tuple
        Decisions of a review that led to this result.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
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
    terrain: Terrain
    threshold: float
    chi2_per_dof: float
    pose_assumed: bool
    lag_s: float
    seconds: float
    named_lines: tuple[tuple[float, str], ...] = ()
    state: SurveyState | None = None
    decisions: tuple[Decision, ...] = ()

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

    @property
    def ground_m(self) -> float:
        """Height of the ground in the world frame; of uneven ground the median."""
        return self.terrain.height_m

    @cached_property
    def position_m(self) -> FloatArray:
        """Positions of all targets (K, 3)."""
        return np.array([target.position_m for target in self]).reshape(-1, 3)

    @cached_property
    def flight_lines(self) -> list[FlightLine]:
        """Lines as flown, in the order of time."""
        height_m = -self.terrain.depth_of(self.rows.place_m)
        return flight_lines(self.rows.time_s, self.rows.place_m, height_m, self.named_lines)

    @cached_property
    def levelled_rows(self) -> SurveyRows:
        """Rows for maps, without the level of their line (:func:`magloc.surveying.fit.levelling.line_levels`).

        The levels are estimated from the residual, so that targets do not affect them. The median of the rest is
        removed from both maps too, because the offset of the anomaly is not that of the ground without targets.
        """
        level_T = self._levels_T
        level_T = level_T + float(np.median(self.rows.residual_T - level_T))
        return self.rows._replace(anomaly_T=self.rows.anomaly_T - level_T, residual_T=self.rows.residual_T - level_T)

    @cached_property
    def _levels_T(self) -> FloatArray:
        return line_levels(self.rows.place_m, self.rows.residual_T, self.flight_lines)

    @property
    def levelling(self) -> str:
        """Levelling of the maps in words."""
        if not self._levels_T.any():
            return f"lines not levelled: fewer than {FEWEST_LINES}, or on one line"
        return f"offset and drift of each line removed, {1e9 * float(np.std(self._levels_T)):.2g} nT rms"

    @property
    def reach_by_depth(self) -> dict[float, Reach]:
        """Least moments at each depth below the ground [m], the shallowest first."""
        depths = np.round(self.terrain.depth_of(self.reach.place_m), 6)
        return {float(depth): Reach(*(column[depths == depth] for column in self.reach)) for depth in np.unique(depths)}

    @property
    def entries(self) -> list[dict[str, Any]]:
        """Targets as JSON and GeoJSON write them."""
        return [
            {
                "id": target.id,
                "position_m": target.position_m.tolist(),
                "moment_Am2": target.moment_Am2.tolist(),
                "covariance": target.covariance.tolist(),
                "depth_m": target.depth_m,
                "depth_interval95_m": list(target.depth_interval95_m),
                "ellipse95_m": list(target.ellipse95[:2]),
                "ellipse95_bearing_deg": target.ellipse95[2],
                "iron_kg": list(target.iron_kg),
                "significance": target.significance,
                "flags": list(target.flags),
                "size_class": target.size_class,
                "fit_quality": target.fit_quality,
            }
            for target in self
        ]

    def columns(self) -> dict[str, Column]:
        """Return the columns of targets.csv."""
        covariance = np.array([t.covariance for t in self]).reshape(-1, 6, 6)
        moment = np.array([t.moment_Am2 for t in self]).reshape(-1, 3)
        low, high = np.array([t.depth_interval95_m for t in self]).reshape(-1, 2).T
        columns: dict[str, Column] = {"id": [t.id for t in self]}
        columns |= state_columns(self.position_m, moment, covariance)
        columns |= {"depth_m": np.array([t.depth_m for t in self]), "depth_low_m": low, "depth_high_m": high}
        columns |= {"strength_Am2": np.array([t.strength_Am2 for t in self])}
        columns |= {"significance": np.array([t.significance for t in self])}
        columns["flags"] = [" ".join(t.flags) for t in self]
        columns["size_class"] = [t.size_class for t in self]
        columns["fit_quality"] = [t.fit_quality for t in self]
        return columns

    def to_geojson(self, place: Vector) -> dict[str, Any]:
        """Return a FeatureCollection with a point for every target (RFC 7946).

        Parameters
        ----------
        place : tuple of 3 floats
            Latitude, longitude [deg] and height [m] of the origin of the world frame, which is east, north, up.
        """
        from arrays.io.world_maps import feature, feature_collection, world_place

        return feature_collection(
            feature("Point", world_place(target.position_m, place), entry)
            for target, entry in zip(self, self.entries, strict=True)
        )

    def to_kml(self, place: Vector) -> str:
        """Return a placemark for every target as KML; ``place`` as in :meth:`to_geojson`."""
        from arrays.io.world_maps import kml, placemark, world_place

        marks = []
        for target in self:
            low, high = target.depth_interval95_m
            least, most = target.iron_kg
            words = (
                f"{target.depth_m:.2f} m below ground (95 %: {low:.2f} to {high:.2f} m),"
                f" {target.strength_Am2:.3g} A·m²: {least:.2g} to {most:.2g} kg of iron, if a kilogram has"
                f" {IRON_Am2_PER_KG[0]:g} to {IRON_Am2_PER_KG[1]:g} A·m². {' '.join(target.flags)}"
            )
            marks.append(placemark(target.id, words, [world_place(target.position_m, place)]))
        return kml(marks)

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
        return align(rows)
