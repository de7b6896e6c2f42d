"""Surveys in tiles that exchange the sources they find."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.fields.points import field_at_points
from magloc.grids.work import Arrays, Each, Work
from magloc.localization.fit.prior import SourcePrior
from magloc.measurement.plausibility import robust_sigma
from magloc.readings import Readings
from magloc.surveying.clock import UNKNOWN, ClockLag, SmoothTrack, Trial, agreed_lag, estimate_lag, fit_at_lag
from magloc.surveying.error_components import with_likeliest_offsets, with_likeliest_pose
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.fit.sensor_noise import white_noise_T
from magloc.surveying.piece import HIGHEST_M, Ground, Piece, high_above
from magloc.surveying.preparation import FEWEST_ROWS, record_of
from magloc.surveying.rounds import AT_LAST, WHILE_SEARCHING
from magloc.surveying.tiles import Tile, assign_sources, tiles_of

_LOG = logging.getLogger(__name__)
_SAMPLE = 20_000  # rows for properties that all tiles share
_LEAST_GEOLOGY_T, _MOST_GEOLOGY_T = 1e-10, 5e-9
_SAME = 0.5  # distance, relative to that to the nearest sources, within which two finds at a seam are one source
_FELT, _CHANGED = 0.1, 1.0  # fields, relative to noise, that are noticeable, and that cause a new search
_MOVED_M = 0.15
_NARROW, _NEARLY_ALL = 0.2, 0.95  # width of a line relative to the distance to the nearest sources; share of rows
_BESIDE_M = 1.0
_MOST_SWEEPS = 5
_TERRAIN_MARGIN = 2.0  # of a tile's terrain, in shortest wavelengths of the geology
_POSES = 2  # alternating estimates of pose errors and lag
Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class TiledSurvey:
    """Rows of a survey in tiles, and the sources that are known so far.

    Attributes
    ----------
    array : SensorArray
    readings : Readings
    ground : Ground
    tiles : sequence of Tile
    margin_m, nearest_m : float
        Width of the tiles' margins, and distance from the sensors to the shallowest sources.
    offset_T : ndarray, shape (C,)
    geology_T : float
        Median and typical size of the anomalies.
    sources : Sources
    found, known, outside : sequence of Sources
        For each tile: sources that it found last, including its margin; sources that it started with; and sources whose
        field was subtracted from its readings.
    """

    array: SensorArray
    readings: Readings
    ground: Ground
    tiles: Sequence[Tile]
    margin_m: float
    nearest_m: float
    offset_T: FloatArray
    geology_T: float
    sources: Sources
    found: Sequence[Sources]
    known: Sequence[Sources]
    outside: Sequence[Sources]

    @classmethod
    def of(cls, array: SensorArray, readings: Readings, ground: Ground) -> TiledSurvey:
        """Return a survey in tiles without any known source."""
        sample = record_of(array, readings[:: -(-len(readings) // _SAMPLE)], ground.terrain)[0]
        bounds = ground.bounds(sample)
        offset = np.median(sample.values_T, axis=0)
        spread = robust_sigma(sample.values_T - offset)
        reach = sample.height_m - float(bounds.low_m[2])
        assert readings.array_position_m is not None
        tiles, margin_m = tiles_of(readings.array_position_m[:, :2], reach)
        alone = [tile for tile in tiles if len(tile.rows) < FEWEST_ROWS]
        if alone:
            rows = sum(int(tile.own.sum()) for tile in alone)
            _LOG.warning(f"rows that are far from all others are ignored: {rows}")
        tiles = [t for t in tiles if len(t.rows) >= FEWEST_ROWS and _narrow(ground.prior, t, margin_m) is not None]
        if not tiles:
            raise ValueError(f"Input readings must have {FEWEST_ROWS} rows near each other; instead received none.")
        nearest_m = sample.height_m - float(bounds.high_m[2])
        away_m = sample.middles_m[:, :2] - sample.middles_m[:, :2].mean(axis=0)
        across_m = np.abs(away_m @ np.linalg.svd(away_m, full_matrices=False)[2][-1])
        if nearest_m > HIGHEST_M:
            _LOG.warning(high_above(nearest_m, ground.terrain.height_m))
        elif np.quantile(across_m, _NEARLY_ALL) < _NARROW * nearest_m:
            _LOG.warning(
                "all readings lie on one line: the side and the distance of a target are poorly determined, and several"
                " targets may be found at wrong places"
            )
        return cls(
            array,
            readings,
            ground,
            tiles,
            margin_m,
            nearest_m,
            offset,
            max(min(spread, _MOST_GEOLOGY_T), _LEAST_GEOLOGY_T),
            Sources.none(),
            *[[Sources.none()] * len(tiles)] * 3,
        )

    @property
    def same_m(self) -> float:
        """Distance within which sources of two tiles count as one."""
        return _SAME * self.nearest_m

    def piece(self, number: int) -> Piece:
        """Return one tile with the sources of all."""
        tile = self.tiles[number]
        prior = _narrow(self.ground.prior, tile, self.margin_m)
        assert prior is not None
        readings, places = self.readings[tile.rows], self._places(tile)[:, :2]
        margin_m = _TERRAIN_MARGIN * self.ground.shortest_geology_m
        terrain = self.ground.terrain.crop(places.min(axis=0) - margin_m, places.max(axis=0) + margin_m)
        ground = replace(self.ground, prior=prior, terrain=terrain)
        return Piece(
            self.array, readings, ground, tile, self.offset_T, self.geology_T, *self._neighbouring_sources(tile)
        )

    def _neighbouring_sources(self, tile: Tile) -> tuple[Sources, Sources, Sources]:
        """Return sources of a tile, of its margin, and others with a noticeable field there."""
        position, strength = self.sources.position_m, np.linalg.norm(self.sources.moment_Am2, axis=1)
        own, near = tile.contains(position), tile.inside_m(position) > -self.margin_m - _BESIDE_M
        places = self._places(tile)
        apart = np.linalg.norm(position - np.clip(position, places.min(axis=0), places.max(axis=0)), axis=1)
        felt = 2e-7 * strength > _FELT * white_noise_T(self.array).min() * apart**3
        return self.sources.some(own), self.sources.some(near & ~own), self.sources.some(felt & ~near)

    def _places(self, tile: Tile) -> FloatArray:
        assert self.readings.array_position_m is not None
        return self.readings.array_position_m[tile.rows]

    def search(self, work: Work, which: Sequence[int], each: Each, tell: Tell) -> TiledSurvey:
        """Search some tiles, one colour after the other, with the sources found before."""
        tiled, done = self, 0
        for colour in sorted({self.tiles[number].colour for number in which}):
            some = [number for number in which if self.tiles[number].colour == colour]
            found, known, outside = list(tiled.found), list(tiled.known), list(tiled.outside)
            for index, result in each(work, map(tiled.piece, some)):
                number = some[index]
                found[number] = Sources(**result)
                known[number], *others = tiled._neighbouring_sources(self.tiles[number])
                outside[number] = Sources.concatenate(others)
                done += 1
                tell(f"{done} of {len(which)} tiles searched: {sum(map(len, found))} sources")
            kept = assign_sources(self.tiles, [sources.position_m for sources in found], self.same_m)
            sources = Sources.concatenate([found[number].some(np.array([k])) for number, k in kept])
            tiled = replace(tiled, sources=sources, found=found, known=known, outside=outside)
        return tiled

    def settle(
        self, work: Work, each: Each, tell: Tell, due: Sequence[int] | None = None
    ) -> tuple[TiledSurvey, Sequence[int]]:
        """Search tiles, then again those whose neighbours report changes; return also tiles that still change.

        The search begins with all tiles, or with those that are `due`.
        """
        tiled, left = self, range(len(self.tiles)) if due is None else due
        for _ in range(_MOST_SWEEPS):
            if not left:
                break
            tiled = tiled.search(work, left, each, tell)
            left = tiled.changes()
        return tiled, left

    def with_sources(self, sources: Sources) -> TiledSurvey:
        """Return the survey with given sources, as if its tiles had found them."""
        tiled = replace(self, sources=sources)
        own, beside, outside = zip(*map(tiled._neighbouring_sources, self.tiles), strict=True)
        others = [Sources.concatenate(parts) for parts in zip(beside, outside, strict=True)]
        return replace(tiled, found=own, known=own, outside=others)

    def changes(self) -> list[int]:
        """Return the tiles whose surroundings changed since their last search."""
        return [number for number in range(len(self.tiles)) if self._is_changed(number)]

    def _is_changed(self, number: int) -> bool:
        """Return whether sources that are new or gone have a noticeable field at a tile's rows."""
        tile, found = self.tiles[number], self.found[number]
        now, *others = self._neighbouring_sources(tile)
        beside, before = Sources.concatenate(others), self.outside[number]
        # Finds of two tiles at a seam are one source if they are near; outside, neighbours report sources.
        new = Sources.concatenate(
            [
                now.some(~_same(now, found.with_more(self.known[number]).with_more(before), self.same_m)),
                beside.some(~_same(beside, before, _MOVED_M) & ~_same(beside, found, self.same_m)),
            ]
        )
        gone = Sources.concatenate(
            [
                found.some(~_same(found, now.with_more(beside), self.same_m)),
                before.some(~_same(before, beside, _MOVED_M) & ~_same(before, now, self.same_m)),
            ]
        )
        change = new.with_more(Sources(gone.position_m, -gone.moment_Am2))
        field = field_at_points(self._places(tile)[tile.own], change.position_m, change.moment_Am2)
        return bool(np.linalg.norm(field, axis=1).max() > _CHANGED * white_noise_T(self.array).min())

    def _richest(self) -> int:
        """Return the tile with most sources, which determines common parameters best."""
        return int(np.argmax([len(sources) for sources in self.found]))

    def correct_lag(self, pose_assumed: bool, lines: ClockLag = UNKNOWN) -> tuple[TiledSurvey, ClockLag]:
        """Return the survey without lag, and the lag, from the targets of one tile and from opposite lines.

        If there is a lag, the sources are unknown again.
        """
        lag = agreed_lag(lines, self._lag_of_targets(pose_assumed, lines))
        if not lag.is_significant:
            return self, lag
        readings = SmoothTrack.of(self.readings).with_earlier_poses(lag.s)
        return replace(self._without_sources(), readings=readings), lag

    def _lag_of_targets(self, pose_assumed: bool, lines: ClockLag) -> ClockLag:
        """Return the lag by the targets of one tile without its margin.

        Position errors that last a whole line resemble a lag, so that assumed pose errors are estimated both with and
        without it.
        """
        number = self._richest()
        tile = self.tiles[number]
        rows = tile.rows[tile.own]
        inside = tile.inside_m(self.sources.position_m) > -_BESIDE_M
        piece = replace(
            self.piece(number),
            readings=self.readings[rows],
            tile=replace(tile, rows=rows, own=np.ones(len(rows), np.bool_)),
            known=self.sources.some(inside),
            beside=Sources.none(),
            outside=self.sources.some(~inside),
        )
        track = SmoothTrack.of(self.readings)

        def piece_at(lag_s: float) -> Piece:
            return replace(piece, readings=track.with_earlier_poses(lag_s, rows))

        def at_likeliest_pose(lag_s: float, start: Sources | None) -> tuple[Callable[[float], Piece], Trial]:
            sources = fit_at_lag(piece_at, lag_s, start).sources
            array = with_likeliest_pose(piece_at(lag_s).model(), sources).record.array
            posed = lambda lag_s: replace(piece_at(lag_s), array=array)  # noqa: E731
            return posed, fit_at_lag(posed, lag_s, sources)

        if pose_assumed and len(piece.known):
            posed, here = at_likeliest_pose(0.0, piece.known)
            pose = posed(0.0).array.pose
            assert pose is not None
            size_m = math.hypot(pose.position_m, pose.position_white_m)
            white = replace(self.array, pose=replace(pose, position_m=size_m, correlation_s=0.0, position_white_m=0.0))
            # White errors resemble no lag.
            lag = estimate_lag(lambda lag_s: replace(piece_at(lag_s), array=white), lines=lines)
            for _ in range(_POSES if lag.is_significant else 0):
                posed, near = at_likeliest_pose(lag.s, None)
                lag = estimate_lag(posed, here, near)
                if not lag.is_significant:
                    break
            return lag
        return estimate_lag(piece_at, lines=lines)

    def with_likeliest_pose(self) -> TiledSurvey:
        """Return the survey with the pose errors estimated from the sources of one tile."""
        piece = self.piece(self._richest())
        model = piece.model()
        fit, _ = model.fit(piece.known, piece.groups(model.record, AT_LAST * model.nearest_m), 1e-3)
        if not len(fit.sources):
            return self
        return replace(self, array=with_likeliest_pose(model, fit.sources).record.array)

    def with_likeliest_offsets(self) -> TiledSurvey:
        """Return the survey with heading errors that nobody stated, if it shows some; then its sources are unknown."""
        piece = self.piece(self._richest())
        model = piece.model()
        fit, _ = model.refit(piece.known, piece.groups(model.record, WHILE_SEARCHING * model.nearest_m))
        array = with_likeliest_offsets(model, fit.sources).record.array
        if array is self.array:
            return self
        size_nT = max(1e9 * sensor.offset_uncertainty_T for sensor in array.sensors)
        _LOG.warning(
            "the readings change with the attitude, as by heading errors of the sensors: taken into account. State"
            f" offset_uncertainty_nT = {size_nT:.2g}"
        )
        return replace(self._without_sources(), array=array)

    def _without_sources(self) -> TiledSurvey:
        nothing = [Sources.none()] * len(self.tiles)
        return replace(self, sources=Sources.none(), found=nothing, known=nothing, outside=nothing)

    def map_tiles(self, work: Work, each: Each, tell: Tell) -> list[Arrays]:
        """Return the results of some work on every tile."""
        results: list[Arrays] = [{}] * len(self.tiles)
        for done, (number, result) in enumerate(each(work, map(self.piece, range(len(self.tiles)))), start=1):
            results[number] = result
            tell(f"{done} of {len(self.tiles)} tiles measured")
        return results


def _same(sources: Sources, others: Sources, same_m: float) -> BoolArray:
    """Return which sources (K,) are among others, within a distance."""
    apart = np.linalg.norm(sources.position_m[:, None] - others.position_m, axis=-1)
    return np.asarray(apart.min(axis=1, initial=np.inf) < same_m)


def _narrow(prior: SourcePrior, tile: Tile, margin_m: float) -> SourcePrior | None:
    """Return the prior within a tile and its margin, None if it is empty."""
    margin = margin_m + _BESIDE_M
    low = np.maximum(prior.low_m, [*(tile.low_m - margin), -np.inf])
    high = np.minimum(prior.high_m, [*(tile.high_m + margin), np.inf])
    return replace(prior, low_m=tuple(low), high_m=tuple(high)) if (low < high).all() else None
