"""Errors of positions that explain a survey whose targets do not fit: another unit of length, exchanged axes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magloc.grids.work import Arrays, Each
from magloc.readings import Readings
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.piece import Piece, search_rounds
from magloc.surveying.preparation import FEWEST_ROWS, variations_of_lines
from magloc.surveying.results import Survey
from magloc.surveying.rounds import AT_LAST
from magloc.surveying.tiled import TiledSurvey
from magloc.surveying.tiles import Tile

_FOOT_M = 0.3048
_MOST_ROWS, _WITHIN = 1500, 4.0  # rows around the strongest anomaly, and their distance over that to deep sources
_DEEP_M, _ROUNDS = 4.0, 4
_MISFIT, _MOST_MISFITS = 2.0, 0.5  # χ² per reading, and share of targets, above which positions are doubted
_BETTER, _FITS = 0.6, 3.0  # largest χ² per reading with an error undone: relative to that as stated, and absolute


def doubt_of_positions(found: Survey, tiled: TiledSurvey, each: Each) -> str:
    """Return a sentence on the positions of a survey that fits badly; "" if most targets fit.

    The strongest anomaly is fitted with the positions as stated, and with each likely error undone.
    """
    misfits = sum("misfit" in target.flags for target in found)
    if found.chi2_per_dof <= _MISFIT and (len(found) < 2 or misfits <= _MOST_MISFITS * len(found)):
        return ""
    error = likely_error_of_positions(tiled, each)
    if error:
        return f"the positions appear to {error}: the strongest anomaly fits much better if this is undone"
    if len(found) and misfits <= _MOST_MISFITS * len(found):
        return ""
    which = f"{misfits} of {len(found)} targets do not fit" if len(found) else "no target fits the readings"
    return (
        f"{which}: check heights, unit and axes of the positions, the attitude,"
        " the noise, and that all columns are of one instrument"
    )


def likely_error_of_positions(tiled: TiledSurvey, each: Each) -> str:
    """Return the error of positions that explains the readings around the strongest anomaly, or "" if none does."""
    rows, place_m = tiled.readings, tiled.readings.array_position_m
    assert place_m is not None
    if not tiled.ground.terrain.is_flat:
        return ""
    variations_T = variations_of_lines(tiled.array, rows)[0]
    strongest = int(np.abs(variations_T - np.median(variations_T, axis=0)).max(axis=1).argmax())
    away_m = np.linalg.norm(place_m[:, :2] - place_m[strongest, :2], axis=1)
    nearest = np.argsort(away_m, kind="stable")[:_MOST_ROWS]
    near = np.sort(nearest[away_m[nearest] < _WITHIN * (tiled.nearest_m + _DEEP_M)])
    if len(near) < FEWEST_ROWS:
        return ""
    errors, changed = zip(*_candidates(tiled, rows[near]), strict=True)
    chi2 = np.full(len(errors), math.inf)
    for number, result in each(chi2_of_strongest, [_piece(tiled, other) for other in changed]):
        chi2[number] = result["chi2"]
    best = int(chi2.argmin())
    return str(errors[best]) if chi2[best] < min(_BETTER * chi2[0], _FITS) else ""


def _candidates(tiled: TiledSurvey, rows: Readings) -> Iterator[tuple[str, Readings]]:
    """Yield errors of positions, and the rows without them; the first is none."""
    place_m, turn, ground_m = rows.array_position_m, rows.array_rotation, tiled.ground.terrain.height_m
    assert place_m is not None
    assert turn is not None
    assert rows.ambient_T is not None
    yield "", rows
    middle_m = np.append(place_m.mean(axis=0)[:2], ground_m)
    for error, factors in (
        ("be in feet", [_FOOT_M] * 3),
        ("be in feet, and their heights in metres", [_FOOT_M, _FOOT_M, 1.0]),
        ("be metres that were converted from feet", [1.0 / _FOOT_M] * 3),
    ):
        yield error, replace(rows, array_position_m=middle_m + factors * (place_m - middle_m))
    columns = tiled.array.columns
    if columns is not None and columns.course:
        ambient_T = turn.apply(rows.ambient_T)
        turn = Rotation.from_euler("z", 90.0, degrees=True) * turn.inv()
        rows = replace(rows, array_rotation=turn, ambient_T=turn.inv().apply(ambient_T))
    yield "have east and north exchanged", replace(rows, array_position_m=place_m[:, [1, 0, 2]])


def _piece(tiled: TiledSurvey, rows: Readings) -> Piece:
    """Return a piece of all rows, without sources and without limits on the map."""
    prior, everywhere = tiled.ground.prior, (-math.inf, math.inf)
    low_m, high_m = ((end, end, limit[2]) for end, limit in zip(everywhere, (prior.low_m, prior.high_m), strict=True))
    ground = replace(tiled.ground, prior=replace(prior, low_m=low_m, high_m=high_m))
    ends = [np.full(2, end) for end in everywhere]
    tile = Tile(ends[0], ends[1], np.arange(len(rows)), np.ones(len(rows), np.bool_))
    return Piece(tiled.array, rows, ground, tile, tiled.offset_T, tiled.geology_T, *[Sources.none()] * 3)


def chi2_of_strongest(piece: Piece) -> Arrays:
    """Return χ² per reading after a short search; infinite if the rows cannot be searched."""
    try:
        model = piece.model()
    except ValueError:  # sensors below the ground, or a map too large
        return {"chi2": np.array(math.inf)}
    piece = replace(piece, known=search_rounds(piece, _ROUNDS))
    fit, _ = model.refit(piece.known, piece.groups(model.record, AT_LAST * model.nearest_m))
    return {"chi2": np.array(fit.cost / fit.residual.size)}
