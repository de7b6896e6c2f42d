"""Star images: frames of centroids with labels, photographs of a spacecraft with its attitude, and photographs."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import adcs
from adcs.stars.files import read_star_frames
from adcs.stars.pictures import read_picture
from arrays.typing import FloatArray
from tests.proof import Part, Row, Rows, Size, row_of_errors, run_command, with_nees
from tests.proof.star_peers import (
    Centre,
    StarImage,
    apart_arcsec,
    by_astrometry_net,
    by_cedar,
    by_tetra3rs,
    cedar_solve,
    direction,
    tetra3rs_database,
)

FRAME_YEAR = 1991.25
WRONG_FRAME_ARCSEC, WRONG_PICTURE_ARCSEC = 120.0, 600.0
WIDTHS = {"esa-alt40": 11.4, "openstartracker-3": 6.1, "openstartracker-6": 6.1, "openstartracker-8": 6.1}
"""Widths of the photographs [deg], as their makers state them."""
SLOW_EVERY = 5
"""Of many images tools that take seconds for each solve each fifth."""
WITHOUT_TRUTH = "distance from ours"
Solver = Callable[[StarImage], Centre | None]
Images = Sequence[tuple[str, StarImage]]
ImagesOf = Callable[[Path], tuple[Images, tuple[FloatArray, ...]]]


def centres(found: Sequence[Centre | None], true: Sequence[FloatArray]) -> FloatArray:
    """Return the angles between found and true centres [arcsec], infinite where there is none."""
    return np.array(
        [
            np.inf if c is None else apart_arcsec(direction(c.ra_deg, c.dec_deg), t)
            for c, t in zip(found, true, strict=True)
        ]
    )


def row_of_centres(
    case: str, tool: str, needs: str, found: Sequence[Centre | None], true: Sequence[FloatArray], wrong: float
) -> Row:
    """Return the row of a solver; σ is that of the centre along an axis, where it states one."""
    error = centres(found, true)
    seconds = float(np.median([c.seconds for c in found if c is not None] or [np.nan]))
    row = row_of_errors(case, tool, needs, seconds, error, wrong)
    sigma = np.array([np.nan if c is None or c.sigma_arcsec is None else c.sigma_arcsec for c in found])
    known = np.isfinite(sigma) & (error < wrong)
    if not known.any() or case.endswith(WITHOUT_TRUTH):
        return row
    return with_nees(row, np.square(error[known] / sigma[known]), 2)


def entries(text: str, key: str, milliseconds: float | None = None) -> list[Centre | None]:
    """Return the centres that ``adcs stars --json`` prints."""
    return [
        Centre(
            e["ra_deg"],
            e["dec_deg"],
            e.get("residual_arcsec", e.get("rms_arcsec")),
            1e-3 * e.get("milliseconds", milliseconds),
        )
        if e.get("solved", not e.get("reason"))
        else None
        for e in json.loads(text)[key]
    ]


# ---- frames with labels


@cache
def frame_images(data: Path) -> tuple[Images, tuple[FloatArray, ...]]:
    """Return frames, and the directions of their centres by the labels."""
    camera, frames = read_star_frames(data / "star-frames")
    catalogue = adcs.hipparcos_catalogue(FRAME_YEAR)
    place = {int(number): row for row, number in enumerate(catalogue.numbers)}
    width_deg = math.degrees(2.0 * math.atan(0.5 * camera.width_px * math.tan(camera.rad_per_px)))
    images, true = [], []
    for i, frame in enumerate(frames):
        assert frame.numbers is not None
        pairs = np.array([(j, place[int(n)]) for j, n in enumerate(frame.numbers) if int(n) in place])
        seen = camera.directions(frame.points_px[pairs[:, 0]])
        R = Rotation.align_vectors(catalogue.directions[pairs[:, 1]], seen)[0]
        true.append(R.apply([0.0, 0.0, -1.0]))
        down = np.column_stack([frame.points_px[:, 0], camera.height_px - frame.points_px[:, 1]])
        lights = np.column_stack([down, 10.0 ** (-0.4 * (frame.magnitudes - 10.0))])
        images.append((f"{i}", StarImage(camera.width_px, camera.height_px, width_deg, 0.05 * width_deg, lights)))
    return tuple(images), tuple(true)


def our_frames(data: Path, _: Size) -> Iterator[Row]:
    """Frames with the scale known to 5 %."""
    _, true = frame_images(data)
    options = ("--catalogue", "hipparcos", "--year", str(FRAME_YEAR), "--scale-tolerance", "0.05", "--json")
    text, seconds = run_command("adcs", "stars", data / "star-frames", *options)
    found = entries(text, "frames", 1e3 * seconds / len(true))
    needs = "lights, scale ± 5 %"
    yield row_of_centres("50 frames", "`adcs stars`", needs, found, true, WRONG_FRAME_ARCSEC)


# ---- photographs of a spacecraft


@cache
def space_images(data: Path) -> tuple[Images, tuple[FloatArray, ...]]:
    """Return pictures with the width of their field within 10 %, and the directions of their centres."""
    folder = data / "star-photographs-space"
    with (folder / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    images, true = [], []
    for row in rows:
        picture = read_picture(folder / f"{row['image']}.tiff")
        height, width = picture.shape
        field_deg = width * float(row["arcsec_per_px_x"]) / 3600.0
        images.append((row["image"], StarImage(width, height, field_deg, 0.1 * field_deg, picture=picture)))
        true.append(direction(float(row["centre_ra_deg"]), float(row["centre_dec_deg"])))
    return tuple(images), tuple(true)


def our_space(data: Path, _: Size) -> Iterator[Row]:
    """Pictures from the file alone, and near the true centre."""
    images, true = space_images(data)
    paths = [data / "star-photographs-space" / f"{name}.tiff" for name, _ in images]
    found, near = [], []
    for path, centre in zip(paths, true, strict=True):
        options = ("--catalogue", "hipparcos", "--year", "2018.9", "--json")
        text, seconds = run_command("adcs", "stars", path, *options)
        found += [None if c is None else c._replace(seconds=seconds) for c in entries(text, "pictures")]
        ra, dec = math.degrees(math.atan2(centre[1], centre[0])) % 360.0, math.degrees(math.asin(centre[2]))
        text, seconds = run_command("adcs", "stars", path, *options, "--near", f"{ra:.0f}", f"{dec:.0f}", "5")
        near += [None if c is None else c._replace(seconds=seconds) for c in entries(text, "pictures")]
    yield row_of_centres("3 pictures", "`adcs stars`", "picture", found, true, WRONG_PICTURE_ARCSEC)
    yield row_of_centres("3 pictures", "`adcs stars --near`", "picture, centre ± 5°", near, true, WRONG_PICTURE_ARCSEC)


# ---- photographs without truth


@cache
def photographs(data: Path) -> tuple[Images, tuple[FloatArray, ...]]:
    """Return photographs with the stated width of their field within 5 %, and no centres."""
    images = []
    for path in sorted((data / "star-photographs").iterdir()):
        picture = read_picture(path)
        height, width = picture.shape
        field_deg = WIDTHS[path.stem]
        images.append((path.stem, StarImage(width, height, field_deg, 0.05 * field_deg, picture=picture)))
    return tuple(images), _our_centres(data)


@cache
def _our_photographs(data: Path) -> tuple[Centre | None, ...]:
    found: list[Centre | None] = []
    for path in sorted((data / "star-photographs").iterdir()):
        text, seconds = run_command("adcs", "stars", path, "--catalogue", "hipparcos", "--json")
        found += [None if c is None else c._replace(seconds=seconds) for c in entries(text, "pictures")]
    return tuple(found)


def _our_centres(data: Path) -> tuple[FloatArray, ...]:
    missing = np.full(3, np.nan)
    return tuple(missing if c is None else direction(c.ra_deg, c.dec_deg) for c in _our_photographs(data))


def our_photographs(data: Path, _: Size) -> Iterator[Row]:
    """Residual of the stars; there is no truth."""
    found = _our_photographs(data)
    error = np.array([np.inf if c is None else c.residual_arcsec for c in found])
    seconds = float(np.median([c.seconds for c in found if c is not None]))
    yield row_of_errors(
        "4 photographs, residual of the stars", "`adcs stars`", "picture", seconds, error, WRONG_FRAME_ARCSEC
    )


# ---- other solvers


def _peer_rows(
    case: str,
    tool: str,
    needs: str,
    wrong: float,
    images_of: ImagesOf,
    solver_of: Callable[[Images], Solver],
    data: Path,
    size: Size,
) -> Iterator[Row]:
    """Row of a solver; without truth its error is the distance from our centres."""
    images, true = images_of(data)
    every = size.every * (SLOW_EVERY if len(images) > SLOW_EVERY and solver_of in (_astrometry_net, _cedar) else 1)
    images, true = images[::every], true[::every]
    tool = tool if every == 1 else f"{tool}, every {every}th"
    solve = solver_of(images)
    yield row_of_centres(case, tool, needs, [solve(image) for _, image in images], true, wrong)


def _tetra3rs(year: float) -> Callable[[Images], Solver]:
    def of(images: Images) -> Solver:
        widths = {round(image.field_deg) for _, image in images}
        databases = {width: tetra3rs_database(width, year) for width in widths}
        return lambda image: by_tetra3rs(databases[round(image.field_deg)], image)

    return of


def _cedar(_: Images) -> Solver:
    solver = cedar_solve().Tetra3()
    return lambda image: by_cedar(solver, image)


def _astrometry_net(_: Images) -> Solver:
    """Solver of astrometry.net, seconds an image."""
    if shutil.which("solve-field") is None:
        raise ModuleNotFoundError("solve-field", name="astrometry.net (Debian)")
    return by_astrometry_net


def _part(
    name: str,
    wrong: str,
    ours: Rows,
    images_of: ImagesOf,
    case: str,
    needs: str,
    limit: float,
    year: float,
) -> Part:
    solvers: Mapping[str, tuple[str, Callable[[Images], Solver]]] = {
        "tetra3rs": ("tetra3rs", _tetra3rs(year)),
        "tetra3": ("cedar-solve", _cedar),
        "astrometry": ("astrometry.net", _astrometry_net),
    }
    peers = {p: partial(_peer_rows, case, tool, needs, limit, images_of, of) for p, (tool, of) in solvers.items()}
    return Part(name, "″", wrong, ours, peers)


FRAMES = _part(
    "star-frames",
    "beyond 120″ or unsolved",
    our_frames,
    frame_images,
    "50 frames",
    "lights, scale ± 5 %",
    WRONG_FRAME_ARCSEC,
    FRAME_YEAR,
)
SPACE = _part(
    "star-photographs-space",
    "beyond 600″ or unsolved",
    our_space,
    space_images,
    "3 pictures",
    "picture, scale ± 10 %",
    WRONG_PICTURE_ARCSEC,
    2018.9,
)
PHOTOGRAPHS = _part(
    "star-photographs",
    "beyond 120″ or unsolved",
    our_photographs,
    photographs,
    f"4 photographs, {WITHOUT_TRUTH}",
    "picture, scale ± 5 %",
    WRONG_FRAME_ARCSEC,
    2015.0,
)
