"""Other solvers of star images: tetra3rs, cedar-solve, and astrometry.net where ``solve-field`` is installed."""

from __future__ import annotations

import importlib
import math
import re
import resource
import subprocess
import time
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from arrays.typing import FloatArray
from tests.conftest import REPOSITORY

CARD, BLOCK = 80, 2880
LIMIT_S = 20
DATABASES = REPOSITORY / "build" / "proof"


class StarImage(NamedTuple):
    """Stars of an image as a tool needs them: a picture, first row on top, or lights, x to the right and y down."""

    width_px: int
    height_px: int
    field_deg: float
    error_deg: float
    """Width of the field and its largest error."""
    lights: FloatArray | None = None
    """Columns x, y, brightness."""
    picture: FloatArray | None = None


class Centre(NamedTuple):
    """Where an image's centre points [deg], the residual of its stars [arcsec], and the processor time."""

    ra_deg: float
    dec_deg: float
    residual_arcsec: float
    seconds: float
    sigma_arcsec: float | None = None


def direction(ra_deg: float, dec_deg: float) -> FloatArray:
    """Return the unit vector of a place in the sky."""
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


def apart_arcsec(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two directions."""
    return math.degrees(2.0 * math.asin(0.5 * float(np.linalg.norm(a - b)))) * 3600.0


@cache
def tetra3rs_database(field_deg: float, year: float) -> Any:
    """Return a database for one width of the field, made in a minute or two, and kept in ``build``."""
    import tetra3rs

    path = DATABASES / f"tetra3rs-{field_deg:g}-{year:g}.bin"
    if path.exists():
        return tetra3rs.SolverDatabase.load_from_file(str(path))
    database = tetra3rs.SolverDatabase.generate_from_gaia(max_fov_deg=field_deg, epoch_proper_motion_year=year)
    path.parent.mkdir(parents=True, exist_ok=True)
    database.save_to_file(str(path))
    return database


def by_tetra3rs(database: Any, image: StarImage) -> Centre | None:
    """Solve by tetra3rs, which finds the lights of a picture itself."""
    import tetra3rs

    began = time.process_time()
    if image.lights is None:
        assert image.picture is not None
        lights: Any = tetra3rs.extract_centroids(np.asarray(image.picture, dtype=np.float32)).centroids
    else:
        centred = image.lights - [0.5 * image.width_px, 0.5 * image.height_px, 0.0]
        lights = centred[np.argsort(-centred[:, 2])]
    found = database.solve_from_centroids(
        lights,
        fov_estimate_deg=image.field_deg,
        fov_max_error_deg=image.error_deg,
        image_width=image.width_px,
        image_height=image.height_px,
        # As its documentation says for pictures in which many bright lights are no stars of the catalogue.
        pattern_checking_stars=24 if image.picture is None else 40,
    )
    took = time.process_time() - began
    if not found:
        return None
    sigma = math.degrees(float(np.max(np.asarray(found.attitude_sigma_rad)[1:]))) * 3600.0
    ra, dec = found.pixel_to_world(0.0, 0.0)
    return Centre(ra, dec, found.rmse_arcsec, took, sigma)


def cedar_solve() -> Any:
    """Return the module of cedar-solve, which no group of ours can have: it asks for the numpy before 2."""
    return importlib.import_module("tetra3")


def by_cedar(solver: Any, image: StarImage) -> Centre | None:
    """Solve by cedar-solve, a Tetra3 with the pattern database that it ships and made for the numpy before 2."""
    vars(np).setdefault("math", math)
    began = time.process_time()
    if image.lights is None:
        assert image.picture is not None
        points = np.asarray(cedar_solve().get_centroids_from_image(image.picture))
    else:
        points = image.lights[np.argsort(-image.lights[:, 2])][:, [1, 0]]
    found = solver.solve_from_centroids(
        points,
        (image.height_px, image.width_px),
        fov_estimate=image.field_deg,
        fov_max_error=image.error_deg,
        pattern_checking_stars=8 if image.picture is None else 20,
    )
    took = time.process_time() - began
    return None if found["RA"] is None else Centre(found["RA"], found["Dec"], found["RMSE"], took)


def by_astrometry_net(image: StarImage) -> Centre | None:
    """Solve by astrometry.net with the index files that are installed, lights from its own search in a picture."""
    with TemporaryDirectory() as name:
        path = Path(name) / "image.fits"
        path.write_bytes(fits_of(image))
        low, high = image.field_deg - image.error_deg, image.field_deg + image.error_deg
        options = [
            "-p",
            "-O",
            "-N",
            "none",
            "-l",
            str(LIMIT_S),
            "-L",
            f"{low}",
            "-H",
            f"{high}",
            "-u",
            "dw",
            "-D",
            name,
        ]
        if image.lights is not None:
            size = ["-w", str(image.width_px), "-e", str(image.height_px)]
            options += [*size, "-X", "X", "-Y", "Y", "-s", "FLUX"]
        else:
            options += ["--fits-image"]
        # Both steps left out need Python modules of their own.
        options += ["-9", "--uniformize", "0"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(["solve-field", *options, str(path)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        wcs = path.with_suffix(".wcs")
        if not wcs.exists():
            return None
        text = subprocess.run(["wcsinfo", str(wcs)], capture_output=True, text=True, check=True).stdout
    numbers = {key: float(value) for key, value in re.findall(r"^(ra_center|dec_center) (\S+)$", text, re.MULTILINE)}
    return Centre(numbers["ra_center"], numbers["dec_center"], math.nan, took)


def fits_of(image: StarImage) -> bytes:
    """Return a FITS file with the picture, or with a table of the lights."""
    if image.lights is None:
        assert image.picture is not None
        values = np.asarray(image.picture, dtype=">f4")
        head = {"SIMPLE": True, "BITPIX": -32, "NAXIS": 2, "NAXIS1": values.shape[1], "NAXIS2": values.shape[0]}
        return _header(head) + _pad(values.tobytes())
    values = np.asarray(image.lights, dtype=">f4")
    table: dict[str, str | int | bool] = {"XTENSION": "BINTABLE", "BITPIX": 8, "NAXIS": 2, "NAXIS1": 12}
    table |= {"NAXIS2": len(values), "PCOUNT": 0, "GCOUNT": 1, "TFIELDS": 3}
    for i, column in enumerate(("X", "Y", "FLUX"), 1):
        table |= {f"TTYPE{i}": column, f"TFORM{i}": "E"}
    return _header({"SIMPLE": True, "BITPIX": 8, "NAXIS": 0, "EXTEND": True}) + _header(table) + _pad(values.tobytes())


def _header(cards: dict[str, Any]) -> bytes:
    lines = []
    for name, value in cards.items():
        text = (
            f"'{value:<8}'"
            if isinstance(value, str)
            else f"{('T' if value else 'F') if isinstance(value, bool) else value:>20}"
        )
        lines.append(f"{name:<8}= {text}".ljust(CARD))
    text = "".join(lines) + "END".ljust(CARD)
    return text.ljust(-(-len(text) // BLOCK) * BLOCK).encode("ascii")


def _pad(data: bytes) -> bytes:
    return data + bytes(-len(data) % BLOCK)
