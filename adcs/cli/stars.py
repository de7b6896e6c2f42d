"""``adcs stars``: stars in images of the sky, and the direction of the camera."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import adcs
from adcs.cli.options import ReportOptions
from arrays.io.errors import InputError, naming
from arrays.typing import FloatArray
from magloc.cli.framework import ABOVE_ZERO, Flag, progress, refuse_outside

if TYPE_CHECKING:
    from adcs.stars.catalogue import SkyCap, StarCatalogue
    from adcs.stars.files import StarFrame
    from adcs.stars.identification import NoFix, StarFix


_LARGEST_NOISE = 0.1
"""Largest noise, over the shorter side of an image."""


def stars(
    *images: Path,
    catalogue: Path,
    noise_px: float | None = None,
    scale_arcsec: float | None = None,
    scale_tolerance: float | None = None,
    year: float = 2015.0,
    aberration: Flag = False,
    dark: Path | None = None,
    near: tuple[float, float, float] | None = None,
    wcs: Path | None = None,
    lens: Path | None = None,
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Identify the stars of images by a catalogue, without knowing where the camera looked.

    For frames with the true numbers of the stars (result.csv) the command counts correct and wrong ones. It also solves
    mirrored images, and says so. --out writes the photographs with the names of their stars.

    Parameters
    ----------
    images : Path
        Photographs of the sky: PNG, TIFF or JPEG with 8 or 16 bits, or FITS. Or one folder with calibration.txt (IMG_X,
        IMG_Y, PIXSCALE in arc seconds at the centre), input.csv (one line for each frame: x, y up, magnitude of each
        star) and, if known, result.csv (numbers of the stars, -1 for none).
    catalogue : Path
        "hipparcos", which needs the extra "stars", or a CSV file with the columns hip, ra_deg, dec_deg and mag at the
        date of the images.
    noise_px : float, optional
        Standard deviation of a star's position, per axis [px]; 1 in frames, 0.5 in photographs by default. At most a
        tenth of the image's shorter side.
    scale_arcsec : float, optional
        Size of a pixel at the centre [arcsec]. Without it the command tries fields of 3 to 100° for photographs.
    scale_tolerance : float, optional
        Relative error of the scale, at most 0.1; by default 0.05 for photographs, 0 for frames.
    year : float
        Date of the images; the proper motions of Hipparcos are applied up to it.
    aberration : bool
        Apply the annual aberration at that date, up to 20.5 arc seconds. An error of one day (0.0027 years) makes 0.35
        arc seconds. Needs the extra "satellites".
    dark : Path, optional
        Dark frame: a photograph without sky, which is subtracted.
    near : tuple, optional
        Right ascension and declination near which the centre of each image is, and the radius [deg]. It makes the
        search fast. A centre outside the radius is not found.
    wcs : Path, optional
        Folder for a FITS header with the world coordinates of each solved photograph, NAME.wcs.
    lens : Path, optional
        TOML file with the lens of the camera, instead of --scale-arcsec. If it does not exist, it is written, with the
        lens of the photograph with most stars.
    report : ReportOptions
        Outputs.
    """
    from adcs.stars.files import read_star_catalogue
    from adcs.stars.hipparcos import hipparcos_catalogue
    from adcs.stars.pictures import SUFFIXES

    largest = sys.float_info.max  # how large they may be depends on the images
    refuse_outside(ABOVE_ZERO, largest, "a positive number", noise_px=noise_px, scale_arcsec=scale_arcsec)
    refuse_outside(ABOVE_ZERO, 0.1, "a positive number, 0.1 at most", scale_tolerance=scale_tolerance)
    refuse_outside(1900.0, 2100.0, "1900 to 2100", year=year)
    if not images:
        raise InputError("IMAGES: found none, expected photographs, or a folder of frames.")
    of_pictures = images[0].suffix.lower() in SUFFIXES
    if lens is not None and scale_arcsec is not None and lens.exists():
        raise InputError(f"--scale-arcsec: found together with the lens {lens}, expected one of them.")
    if len(images) > 1 and not of_pictures:
        raise InputError(f"{images[1]}: found more than one folder of frames, expected one.")
    known = hipparcos_catalogue(year) if str(catalogue) == "hipparcos" else read_star_catalogue(catalogue)
    if aberration:
        from adcs.environment.sun import earth_velocity_m_s
        from adcs.frames import of_julian_year

        known = known.aberrated(earth_velocity_m_s(of_julian_year(year)))
    rad_per_px = None if scale_arcsec is None else math.radians(scale_arcsec / 3600.0)
    hint = _cap(near)
    if of_pictures:
        _pictures(images, known, rad_per_px, scale_tolerance or 0.05, noise_px or 0.5, hint, dark, report, wcs, lens)
    elif wcs is not None or lens is not None:
        named = f"--lens {lens}" if wcs is None else f"--wcs {wcs}"
        raise InputError(f"{named}: found a folder of frames, expected photographs.")
    else:
        _frames(images[0], known, rad_per_px, scale_tolerance, noise_px or 1.0, hint, report)


def _cap(near: tuple[float, float, float] | None) -> SkyCap:
    """Return the part of the sky that the option ``--near`` states."""
    from adcs.stars.catalogue import WHOLE_SKY, SkyCap

    if near is None:
        return WHOLE_SKY
    ra_deg, dec_deg, radius_deg = near
    for name, value, low, high in (
        ("right ascension", ra_deg, -360.0, 360.0),
        ("declination", dec_deg, -90.0, 90.0),
        ("radius", radius_deg, ABOVE_ZERO, 180.0),
    ):
        if not low <= value <= high:
            expected = "above 0, at most 180°" if name == "radius" else f"{low:g} to {high:g}°"
            raise InputError(f"--near: found the {name} {value:g}°, expected {expected}.")
    return SkyCap.of(*(math.radians(value) for value in near))


def _pictures(
    paths: tuple[Path, ...],
    known: StarCatalogue,
    rad_per_px: float | None,
    tolerance: float,
    noise_px: float,
    near: SkyCap,
    dark: Path | None,
    report: ReportOptions,
    wcs: Path | None,
    lens: Path | None,
) -> None:
    from adcs.plots.stars import picture_figure
    from adcs.stars.identification import NoFix, StarFix
    from adcs.stars.lens import calibrate_lens, lens_text, read_lens
    from adcs.stars.wcs import wcs_header
    from arrays.io.outputs import refuse_file, write_files

    report.check()
    known_lens = read_lens(lens) if lens is not None and lens.exists() else None
    refuse_file(wcs, "--wcs")
    off = None if dark is None else adcs.read_picture(dark)
    rows, solved = [], []
    last: StarFix | None = None
    for path in paths:
        picture = adcs.read_picture(path)
        if known_lens is not None:
            known_lens.check(path, picture.shape)
        began = time.perf_counter()
        with naming(str(path)):
            lights, found = adcs.solve_photograph(
                picture,
                known,
                rad_per_px=rad_per_px,
                tolerance=tolerance,
                noise_px=noise_px,
                near=near,
                lens=known_lens,
                dark=off,
                last=last,
            )
        last = found if isinstance(found, StarFix) else last
        took_ms = 1e3 * (time.perf_counter() - began)
        row: dict[str, Any] = {"file": str(path), "solved": not isinstance(found, NoFix)}
        if isinstance(found, NoFix):
            row |= dict.fromkeys(("ra_deg", "dec_deg", "roll_deg", "scale_arcsec", "scale_sigma_arcsec"))
            row |= dict.fromkeys(("corner_px", "corner_sigma_px", "lens", "field_deg"))
            row |= {"mirrored": None, "matched": 0, "residual_arcsec": None, "reason": found.reason}
        else:
            row |= _direction(found.R_catalogue_from_frame)
            camera, sigma = found.pose.camera, np.sqrt(np.diag(found.pose.covariance))
            sides = camera.directions([[0.0, 0.5 * camera.height_px], [camera.width_px, 0.5 * camera.height_px]])
            half_diagonal_px = 0.5 * math.hypot(camera.width_px, camera.height_px)
            row |= {
                "scale_arcsec": _arcsec(camera.rad_per_px),
                "scale_sigma_arcsec": _arcsec(camera.rad_per_px * sigma[3]),
                "corner_px": camera.corner_shift_px,
                "corner_sigma_px": found.pose.corner_sigma * half_diagonal_px,
                "lens": camera.projection,
                "field_deg": math.degrees(math.acos(sides[0] @ sides[1])),
                "mirrored": found.mirrored,
                "matched": len(found.stars),
                "residual_arcsec": _arcsec(found.rms_rad),
                "reason": "",
            }
        rows.append({**row, "milliseconds": took_ms})
        solved.append((path, picture, lights, None if isinstance(found, NoFix) else found))
    # Only after all photographs are read, because one of them may be refused.
    report.write(
        (f"{path.stem}-stars.png", picture_figure(path.name, picture, lights, fix, known))
        for path, picture, lights, fix in solved
    )
    headers = [(f"{path.stem}.wcs", wcs_header(fix)) for path, _, _, fix in solved if fix is not None]
    if headers:
        write_files(wcs, headers, "--wcs")
    fixes = [(lights, fix) for *_, lights, fix in solved if fix is not None]
    if lens is not None and known_lens is None and fixes:
        lights, fix = max(fixes, key=lambda solved: len(solved[1].stars))
        pose = calibrate_lens(fix, lights.points_px, known, noise_px)
        write_files(lens.parent, [(lens.name, lens_text(pose))], "--lens")
    report.print({"pictures": rows}, [_picture_line(row) for row in rows])


def _mirror_note(row: dict[str, Any]) -> str:
    return "; mirrored: solved with left and right exchanged" if row["mirrored"] else ""


def _arcsec(angle_rad: float) -> float:
    return math.degrees(angle_rad) * 3600.0


def _picture_line(row: dict[str, Any]) -> str:
    """Return the text of one photograph."""
    if not row["solved"]:
        return f"{row['file']}: no fix, {row['reason']}"
    kind = "equidistant lens, " if row["lens"] == "equidistant" else ""
    return (
        f"{row['file']}: RA {row['ra_deg']:.3f}°, Dec {row['dec_deg']:+.3f}°, roll {row['roll_deg']:+.2f}°; "
        f"{row['scale_arcsec']:.3f} ± {row['scale_sigma_arcsec']:.3f} arcsec/px, {row['field_deg']:.2f}° wide, "
        f"{kind}corners bent by {row['corner_px']:+.1f} ± {row['corner_sigma_px']:.1f} px; "
        f"{row['matched']} stars, {row['residual_arcsec']:.1f} arcsec rms{_mirror_note(row)}"
    )


def _frames(
    folder: Path,
    known: StarCatalogue,
    rad_per_px: float | None,
    tolerance: float | None,
    noise_px: float,
    near: SkyCap,
    report: ReportOptions,
) -> None:
    from adcs.stars.files import read_star_frames
    from adcs.stars.pose import UNKNOWN_LENS, LensPrior

    camera, images = read_star_frames(folder)
    most_px = _LARGEST_NOISE * min(camera.width_px, camera.height_px)
    if noise_px > most_px:
        raise InputError(
            f"--noise-px: found {noise_px:g}, expected at most {most_px:g}, a tenth of the image's shorter side: "
            "beyond it, stars cannot be distinguished."
        )
    if rad_per_px is not None:
        with naming("--scale-arcsec"):
            camera = replace(camera, rad_per_px=rad_per_px)
    ended = [time.perf_counter()]
    with progress(len(images), "frames") as advance:

        def done(frames: int) -> None:
            ended.append(time.perf_counter())
            advance(frames)

        prior = LensPrior() if tolerance is None else replace(UNKNOWN_LENS, scale=tolerance)
        frames_of = [(image.points_px, image.magnitudes) for image in images]
        fixes = adcs.identify_stars(known, camera, frames_of, noise_px=noise_px, lens=prior, near=near, progress=done)
    rows = [_row(known, image, fix) for image, fix in zip(images, fixes, strict=True)]
    # The time of the first frame includes the triangles of the catalogue.
    milliseconds = 1e3 * np.diff(ended)[min(1, len(images) - 1) :]
    totals = _totals(known, images, rows) | {
        "milliseconds_median": float(np.median(milliseconds)),
        "milliseconds_max": float(milliseconds.max()),
    }
    words = [*(_line(number, row) for number, row in enumerate(rows)), _totals_line(totals)]
    report.print({"frames": rows, **totals}, words)


def _row(catalogue: StarCatalogue, image: StarFrame, fix: StarFix | NoFix) -> dict[str, Any]:
    """Return the JSON entry of one frame."""
    from adcs.stars.files import NO_STAR
    from adcs.stars.identification import NoFix

    numbers = np.full(len(image.points_px), NO_STAR)
    row: dict[str, Any] = {"stars": len(numbers)}
    row |= dict.fromkeys(("ra_deg", "dec_deg", "roll_deg", "rms_arcsec", "mirrored"))
    if isinstance(fix, NoFix):
        return {**row, "reason": fix.reason, "hip": numbers}
    numbers[fix.stars[:, 0]] = catalogue.numbers[fix.stars[:, 1]]
    row |= _direction(fix.R_catalogue_from_frame)
    row |= {"rms_arcsec": _arcsec(fix.rms_rad), "mirrored": fix.mirrored}
    return {**row, "reason": "", "hip": numbers}


def _direction(R_catalogue_from_frame: FloatArray) -> dict[str, float]:
    """Return right ascension and declination of the centre, and the roll of y from north to east.

    They do not change in a mirrored image, which exchanges left and right.
    """
    right, up, back = R_catalogue_from_frame.T
    north = np.array([0.0, 0.0, 1.0])
    return {
        "ra_deg": float(np.degrees(np.arctan2(-back[1], -back[0])) % 360.0),
        "dec_deg": float(np.degrees(np.arcsin(np.clip(-back[2], -1.0, 1.0)))),
        "roll_deg": float(np.degrees(np.arctan2(right @ north, up @ north))),
    }


def _totals(catalogue: StarCatalogue, images: list[StarFrame], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return counts over all frames, and rates where the true numbers are known."""
    found = np.concatenate([row["hip"] for row in rows])
    totals: dict[str, Any] = {
        "fixes": sum(not row["reason"] for row in rows),
        "identified": int(np.count_nonzero(found >= 0)),
        "identification_rate": None,
        "false_rate": None,
        "in_catalogue": None,
    }
    if any(image.numbers is None for image in images):
        return totals
    true = np.concatenate([image.numbers for image in images if image.numbers is not None])
    is_known = np.isin(true, catalogue.numbers) & (true >= 0)
    right = (found == true) & (found >= 0)
    totals["in_catalogue"] = int(is_known.sum())
    totals["identification_rate"] = float(right.sum() / max(is_known.sum(), 1))
    totals["false_rate"] = float(1.0 - right.sum() / max(totals["identified"], 1)) if totals["identified"] else 0.0
    return totals


def _line(number: int, row: dict[str, Any]) -> str:
    """Return the text of one frame."""
    if row["reason"]:
        return f"frame {number}: no fix, {row['reason']}"
    identified = sum(int(hip) >= 0 for hip in row["hip"])
    return (
        f"frame {number}: RA {row['ra_deg']:.3f}°, Dec {row['dec_deg']:+.3f}°, roll {row['roll_deg']:+.2f}°; "
        f"{identified} of {row['stars']} stars, {row['rms_arcsec']:.1f} arcsec rms{_mirror_note(row)}"
    )


def _totals_line(totals: dict[str, Any]) -> str:
    """Return the text of all frames."""
    text = f"{totals['fixes']} fixes, {totals['identified']} stars identified"
    if totals["identification_rate"] is None:
        return text
    found, false = 100.0 * totals["identification_rate"], 100.0 * totals["false_rate"]
    return f"{text}: {found:.2f} % of the {totals['in_catalogue']} that the catalogue has; {false:.2f} % are wrong"
