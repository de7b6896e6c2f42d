"""One tile of a survey, or all of a small one: the unit of work of one process."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray, IntArray
from magloc.grids.work import Arrays
from magloc.localization.fit.prior import SourcePrior
from magloc.readings import Readings
from magloc.surveying.fit.joint_fit import Layer, SourceBounds, Sources
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.whitening import SurveyDrift
from magloc.surveying.preparation import record_of
from magloc.surveying.reach import least_moments
from magloc.surveying.rounds import AT_LAST, MOST_ROUNDS, SurveyModel, find_sources
from magloc.surveying.search import PITCH, SearchGrid
from magloc.surveying.targets import targets_of
from magloc.surveying.tiles import Tile
from magloc.terrain.surface import Terrain

ROW_ENTRIES = ("place_m", "anomaly_T", "residual_T")
_FIRST_ROUNDS = 4  # before the lag is estimated
_BESIDE = 0.6  # margin of the search, over the distance to the deepest sources
_SHALLOWEST_M, _DEEPEST = 0.05, 4.0
_MARGIN_M = 1.0
_LARGEST_MOMENT_Am2 = 300.0
_SETTLED = 1e-3
_MOST_NUMBERS = 2.5e8  # largest size of the columns of the ground: 2 GB
_MOST_PLACES = 1e6


HIGHEST_M = 25.0
"""Height above the ground from which no target of a survey is visible."""


def high_above(height_m: float, ground_m: float) -> str:
    """Return the warning that sensors are far above the stated ground."""
    return (
        f"the sensors are {height_m:.3g} m above the ground, which is stated at a height of {ground_m:g} m: if their"
        " heights are above the sea, or above an ellipsoid, state the height of the ground there too (ground_m)"
    )


@dataclass(frozen=True)
class Ground:
    """Settings of the ground and of the search in it.

    Attributes
    ----------
    prior : SourcePrior
        Limits of positions; those of heights are above a flattened ground.
    terrain : Terrain
    shortest_geology_m : float
    threshold : float
        χ² with 3 degrees of freedom that a target must exceed.
    body_length_m : float
        Longest edge of buried bodies; 0 for points.
    """

    prior: SourcePrior
    terrain: Terrain
    shortest_geology_m: float
    threshold: float
    body_length_m: float = 0.0

    @property
    def shallowest_m(self) -> float:
        """Height of the highest sources above a flattened ground, in the world frame [m]."""
        given = float(self.prior.high_m[2])
        return given if math.isfinite(given) else self.terrain.height_m - _SHALLOWEST_M

    def bounds(self, record: SurveyRecord) -> SourceBounds:
        """Return limits of positions and moments of sources that the rows show."""
        low, high = record.flat_m.min(axis=(0, 1)), record.flat_m.max(axis=(0, 1))
        ground_m = self.terrain.height_m
        if low[2] <= ground_m:
            received = f"{ground_m:g} m with one at {low[2]:g} m"
            if not self.terrain.is_flat:
                above = f"{self.terrain.name or 'terrain'} that is {ground_m - low[2]:.3g} m above one"
                received = f"{above} (their heights may refer to different levels, such as sea and ellipsoid)"
            raise ValueError(f"Input ground_m must be below all sensors; instead received {received}.")
        own_low = np.array([low[0] - _MARGIN_M, low[1] - _MARGIN_M, ground_m - _DEEPEST])
        own_high = np.array([high[0] + _MARGIN_M, high[1] + _MARGIN_M, self.shallowest_m])
        low_m, high_m = (
            np.where(np.isfinite(given), given, own)
            for given, own in ((self.prior.low_m, own_low), (self.prior.high_m, own_high))
        )
        if not (low_m < high_m).all():
            raise ValueError("Input prior must leave room below the ground; instead received bounds that do not.")
        largest_Am2 = min(self.prior.largest_moment_Am2, _LARGEST_MOMENT_Am2)
        return SourceBounds(low_m, high_m, largest_Am2, self.terrain)


@dataclass(frozen=True, eq=False)
class Piece:
    """Rows of one tile, and the sources that are known.

    Attributes
    ----------
    array : SensorArray
    readings : Readings
    ground : Ground
    tile : Tile
        Tile of the rows.
    offset_T : ndarray, shape (C,)
        Offsets of the anomalies.
    geology_T : float
        Expected strength of the field of the ground.
    known, beside, outside : Sources
        Sources of the tile, of its margin, and others whose field reaches it.
    """

    array: SensorArray
    readings: Readings
    ground: Ground
    tile: Tile
    offset_T: FloatArray
    geology_T: float
    known: Sources
    beside: Sources
    outside: Sources

    def model(self) -> SurveyModel:
        """Return the model of the rows, with the field of sources outside the tile."""
        record, errors = record_of(self.array, self.readings, self.ground.terrain)
        record = replace(record, values_T=record.values_T - self.offset_T)
        others = self.beside.with_more(self.outside)
        if len(others):
            record = record.beside(others.position_m, others.moment_Am2)
        bounds = self.ground.bounds(record)
        layer = Layer.below(record, self.ground.shortest_geology_m, self.geology_T)
        x, y = (bounds.high_m - bounds.low_m)[:2]
        known = self.ground.threshold, self.ground.body_length_m, self.beside
        model = SurveyModel(record, errors, layer, SurveyDrift(), bounds, *known)
        height = model.nearest_m
        measurements = (self.groups(record, AT_LAST * height)[-1] + 1) * record.array.n_channels
        numbers = max(measurements, len(layer.places_m)) * len(layer.places_m)
        if numbers > _MOST_NUMBERS or x * y / (max(height, 0.3) / PITCH) ** 2 > _MOST_PLACES:
            cure = "a longer shortest_geology_m needs less" if numbers > _MOST_NUMBERS else ""
            cure = high_above(height, self.ground.terrain.height_m) if height > HIGHEST_M else cure
            raise ValueError(
                f"Input readings must be cut into smaller pieces; instead received {len(record)} rows over {x:.3g} m by"
                f" {y:.3g} m, {height:.2g} m above the ground{cure and f': {cure}'}."
            )
        return model

    def groups(self, record: SurveyRecord, length_m: float) -> IntArray:
        """Return the group of every row (n,): neighbours within a length count as one."""
        steps = np.linalg.norm(np.diff(record.middles_m, axis=0), axis=1)[np.diff(self.tile.rows) == 1]
        step = float(np.median(steps)) if steps.size else 0.0
        together = max(1, math.floor(length_m / step)) if step > 0.0 else 1
        return np.unique(self.tile.rows // together, return_inverse=True)[1]


def strongest_sources(piece: Piece) -> Arrays:
    """Search for the strongest sources in a few rounds."""
    return dict(vars(search_rounds(piece, _FIRST_ROUNDS)))


def significant_sources(piece: Piece) -> Arrays:
    """Search for all significant sources; neighbouring tiles report those in the margin."""
    return dict(vars(search_rounds(piece, MOST_ROUNDS)))


def search_rounds(piece: Piece, most: int) -> Sources:
    """Search for the sources of a tile in some rounds.

    The search includes the surroundings, because strong sources there disturb the tile.
    """
    model = replace(piece.model(), counts_misfits=most == MOST_ROUNDS)
    reach = _BESIDE * (model.record.height_m - model.bounds.low_m[2])
    low, high = np.append(piece.tile.low_m - reach, -math.inf), np.append(piece.tile.high_m + reach, math.inf)
    grid = SearchGrid.below(model.record, np.maximum(model.bounds.low_m, low), np.minimum(model.bounds.high_m, high))
    groups = partial(piece.groups, model.record)
    return find_sources(model, groups, grid, piece.known, most, piece.tile.contains)


def refit_sources(piece: Piece) -> Arrays:
    """Fit the known sources to all rows, and keep all of them."""
    model = piece.model()
    fit, _ = model.refit(piece.known, piece.groups(model.record, AT_LAST * model.nearest_m), _SETTLED)
    return dict(vars(fit.sources))


def measure_targets(piece: Piece, *, keep_all: bool = False) -> Arrays:
    """Fit the known sources to all rows; return targets, reach and residuals of the tile.

    Sources that are not significant are dropped, unless all are to be kept.
    """
    model = replace(piece.model(), counts_misfits=True)
    groups = partial(piece.groups, model.record)
    fit, background = (model.refit if keep_all else model.fit)(piece.known, groups(AT_LAST * model.nearest_m), _SETTLED)
    record = model.record
    left = record.values_T - record.predict(fit.sources.fields(record))
    lines = (
        record.middles_m,
        record.along_ambient(record.values_T),
        record.along_ambient(left),
    )
    own, which = piece.tile.own, piece.tile.contains(fit.sources.position_m)
    extent = piece.tile.extent_m(lines[0][own, :2])
    places, moments = least_moments(model, fit.sources, groups, *extent)
    return {
        "reach_m": places,
        "reach_Am2": moments,
        **targets_of(model, fit, background, groups, which),
        **{name: values[own] for name, values in zip(ROW_ENTRIES, lines, strict=True)},
        "chi2": np.array(fit.cost),
        "size": np.array(fit.residual.size),
    }
