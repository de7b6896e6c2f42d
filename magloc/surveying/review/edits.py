"""Edits of a survey: drop, split and add targets, exclude rows. Each returns another state; a fit follows later."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.piece import Piece
from magloc.surveying.rounds import AT_LAST, WHILE_SEARCHING
from magloc.surveying.search import N_DISTANCES, Candidates, SearchGrid, search, sources_at
from magloc.surveying.tiled import TiledSurvey

_N_DEPTHS = 24  # of a target that was added without a depth
_WITHIN, _N_BESIDE, _DEEPER = 1.0, 9, 1.6  # places of a second source, over the distance to the first one
_STARTS, _DISTINCT = 4, 0.5  # most places from which the fit of a pair starts, and their least gap over the distance
_OUTSIDE_M = 1.0  # largest distance of a target from the rows on the map


@dataclass(frozen=True, eq=False)
class SurveyEdit:
    """Survey with names of its sources (K,)."""

    tiled: TiledSurvey
    ids: tuple[str, ...]

    def index(self, target: str) -> int:
        """Return the index of a source by its name."""
        if target not in self.ids:
            raise ValueError(f"Input target must be one of {', '.join(self.ids) or 'none'}; instead received {target}.")
        return self.ids.index(target)


def row_places(tiled: TiledSurvey) -> FloatArray:
    """Return the mean places of the sensors (n, 3) in all rows."""
    readings = tiled.readings
    assert readings.array_position_m is not None
    assert readings.array_rotation is not None
    return np.asarray(readings.array_position_m + readings.array_rotation.apply(tiled.array.positions.mean(axis=0)))


def inside_polygon(xy_m: FloatArray, corners_m: FloatArray) -> BoolArray:
    """Return which points (n, 2) are inside a polygon of corners (k, 2), by the even-odd rule."""
    x, y = xy_m.T
    inside = np.zeros(len(xy_m), np.bool_)
    for (x0, y0), (x1, y1) in zip(corners_m, np.roll(corners_m, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def exclude_rows(edit: SurveyEdit, rows: BoolArray) -> SurveyEdit:
    """Return the survey without some rows (n,)."""
    tiled = edit.tiled
    reduced = TiledSurvey.of(tiled.array, tiled.readings[np.flatnonzero(~rows)], tiled.ground)
    return replace(edit, tiled=reduced.with_sources(tiled.sources))


def drop(edit: SurveyEdit, target: str) -> SurveyEdit:
    """Return the survey without a target."""
    kept = np.arange(len(edit.ids)) != edit.index(target)
    ids = tuple(name for name in edit.ids if name != target)
    return SurveyEdit(edit.tiled.with_sources(edit.tiled.sources.some(kept)), ids)


def add(edit: SurveyEdit, place_m: Sequence[float], name: str) -> SurveyEdit:
    """Return the survey with one more target, with the likeliest moment, and depth if none is given."""
    piece = _piece_at(edit.tiled, place_m)
    source = _source_at(piece, place_m)
    return SurveyEdit(edit.tiled.with_sources(edit.tiled.sources.with_more(source)), (*edit.ids, name))


def split(edit: SurveyEdit, target: str, places_m: Sequence[Sequence[float]], names: tuple[str, str]) -> SurveyEdit:
    """Return the survey with two targets instead of one, at given places, or where they are likeliest."""
    if places_m:
        edit = drop(edit, target)
        for place_m, name in zip(places_m, names, strict=True):
            edit = add(edit, place_m, name)
        return edit
    which, sources = edit.index(target), edit.tiled.sources
    pair = _likeliest_pair(_piece_at(edit.tiled, sources.position_m[which].tolist()), sources.position_m[which])
    others = drop(edit, target)
    return SurveyEdit(others.tiled.with_sources(others.tiled.sources.with_more(pair)), (*others.ids, *names))


def check_place(tiled: TiledSurvey, place_m: Sequence[float]) -> None:
    """Refuse a place (x, y) that is far from all rows on the map, and a place (x, y, z) above the ground."""
    apart_m = np.linalg.norm(row_places(tiled)[:, :2] - place_m[:2], axis=1)
    reach_m = _OUTSIDE_M + tiled.nearest_m
    if apart_m.min() > reach_m:
        raise ValueError(
            f"Input place must be within {reach_m:.2g} m of a row on the map; instead received"
            f" ({place_m[0]:g}, {place_m[1]:g}), {apart_m.min():.3g} m from the nearest row."
        )
    terrain = tiled.ground.terrain
    if len(place_m) > 2 and (above_m := -float(terrain.depth_of(np.array(place_m)))) > 0.0:
        raise ValueError(f"Input place must be below the ground; instead received one {above_m:.3g} m above it.")


def _piece_at(tiled: TiledSurvey, place_m: Sequence[float]) -> Piece:
    """Return the tile at a place (x, y)."""
    place = np.array([[*place_m[:2], 0.0]])
    return tiled.piece(int(np.argmax([tile.inside_m(place)[0] for tile in tiled.tiles])))


def _source_at(piece: Piece, place_m: Sequence[float]) -> Sources:
    """Return the likeliest source at a place (x, y) or (x, y, z), in addition to the known ones."""
    model = piece.model()
    height, bounds, terrain = model.record.height_m, model.bounds, model.record.terrain
    x, y = np.clip(place_m[:2], bounds.low_m[:2], bounds.high_m[:2])
    depths = np.geomspace(height - bounds.high_m[2], height - bounds.low_m[2], _N_DEPTHS)
    if len(place_m) > 2:
        depths = height - np.clip(terrain.flatten(np.array([place_m]))[:, 2], bounds.low_m[2], bounds.high_m[2])
    # All depths explain the same rows, or the deepest would win by their number.
    places = terrain.drape(np.array([[x, y, height - below] for below in depths]))
    grid = SearchGrid([(float(depths[-1]), places)])
    background = model.background(piece.known, piece.groups(model.record, WHILE_SEARCHING * float(depths[0])))
    found = Candidates.concatenate(search(model.record, background, piece.known, grid))
    return sources_at(found, np.array([int(np.argmax(found.chi2))]))


def _likeliest_pair(piece: Piece, position_m: FloatArray) -> Sources:
    """Return the likeliest two sources instead of the known one nearest to a position."""
    model, known = piece.model(), piece.known
    which = int(np.argmin(np.linalg.norm(known.position_m - position_m, axis=1)))
    height, bounds, terrain = model.record.height_m, model.bounds, model.record.terrain
    distance = height - float(terrain.flatten(position_m)[2])
    beside = distance * np.linspace(-_WITHIN, _WITHIN, _N_BESIDE)
    below = height - distance * np.geomspace(1.0 / _DEEPER, _DEEPER, N_DISTANCES)
    below = np.clip(below, bounds.low_m[2], bounds.high_m[2])
    levels = [
        (float(height - z), np.stack(np.meshgrid(position_m[0] + beside, position_m[1] + beside, [z]), axis=-1))
        for z in np.unique(below)
    ]
    groups = partial(piece.groups, model.record)
    background = model.background(known, groups(WHILE_SEARCHING * distance))
    grid = SearchGrid([(at, terrain.drape(places.reshape(-1, 3))) for at, places in levels])
    found = Candidates.concatenate(search(model.record, background, known, grid))
    best, least = known, math.inf
    group = groups(AT_LAST * model.nearest_m)
    for start in _strongest(found, _DISTINCT * distance):
        fit, _ = model.refit(known.with_more(sources_at(found, np.array([start]))), group)
        cost = model.misfit(fit.sources, group)
        if cost < least:
            best, least = fit.sources, cost
    return best.some(np.array([which, len(known)]))


def _strongest(found: Candidates, apart_m: float) -> list[int]:
    """Return the strongest candidates that are some distance apart."""
    chosen: list[int] = []
    for i in np.argsort(-found.chi2).tolist():
        if all(math.dist(found.place_m[i], found.place_m[k]) > apart_m for k in chosen):
            chosen.append(i)
        if len(chosen) == _STARTS:
            break
    return chosen
