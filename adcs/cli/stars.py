"""``adcs stars``: which stars of the real sky images show, and where the camera looked."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import adcs
from arrays.io.arguments import Flag
from arrays.io.errors import InputError
from magloc.cli.framework import QuietOptions, print_json, progress

if TYPE_CHECKING:
    from adcs.stars.files import StarFrame
    from adcs.stars.identification import NoFix, StarCatalogue, StarFix


_LARGEST_NOISE = 0.1
"""Of the shorter side of an image."""


def stars(
    frames: Path,
    /,
    *,
    catalogue: Path,
    noise_px: float = 1.0,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Identify the stars of images by a catalogue, without knowing where the camera looked.

    With the true numbers of the stars (result.csv) it says how many were found and how many were wrong.

    Parameters
    ----------
    frames : Path
        Folder with calibration.txt (IMG_X, IMG_Y, PIXSCALE in arc seconds), input.csv (a line for each frame: x, y up,
        magnitude of each star) and, if known, result.csv (the stars' numbers, -1 for none).
    catalogue : Path
        CSV file with the columns hip, ra_deg, dec_deg and mag, at the date of the frames.
    noise_px : float
        Standard deviation of a star's place, per axis. Up to a tenth of the image's shorter side: stars that may be
        anywhere in it cannot be told apart.
    json : bool
        Print one JSON object.
    common : QuietOptions
        Common options.
    """
    from adcs.stars.files import read_star_catalogue, read_star_frames

    if not 0.0 < noise_px < math.inf:
        raise InputError(f"--noise-px: found {noise_px:g}, expected a positive number.")
    camera, images = read_star_frames(frames)
    most_px = _LARGEST_NOISE * min(camera.width_px, camera.height_px)
    if noise_px > most_px:
        raise InputError(
            f"--noise-px: found {noise_px:g}, expected at most {most_px:g}, a tenth of the image's shorter side: "
            "beyond it, stars cannot be told apart."
        )
    known = read_star_catalogue(catalogue)
    frames_of = [(image.points_px, image.magnitudes) for image in images]
    with progress(len(images), "frames", quiet=common.quiet) as advance:
        fixes = adcs.identify_stars(known, camera, frames_of, noise_px=noise_px, progress=advance)
    rows = [_row(known, image, fix) for image, fix in zip(images, fixes, strict=True)]
    totals = _totals(known, images, rows)
    if json:
        print_json({"frames": rows, **totals})
        return
    for number, row in enumerate(rows):
        print(_line(number, row))
    print(_in_words(totals))


def _row(catalogue: StarCatalogue, image: StarFrame, fix: StarFix | NoFix) -> dict[str, Any]:
    """What was found in one frame."""
    from adcs.stars.files import NO_STAR
    from adcs.stars.identification import NoFix

    numbers = np.full(len(image.points_px), NO_STAR)
    row: dict[str, Any] = {"stars": len(numbers), "ra_deg": None, "dec_deg": None, "roll_deg": None, "rms_arcsec": None}
    if isinstance(fix, NoFix):
        return {**row, "reason": fix.reason, "hip": numbers}
    numbers[fix.stars[:, 0]] = catalogue.numbers[fix.stars[:, 1]]
    right, up, back = fix.R_catalogue_from_frame.T
    # Roll is the angle of the image's y from north, towards east.
    north = np.array([0.0, 0.0, 1.0])
    row["ra_deg"] = float(np.degrees(np.arctan2(-back[1], -back[0])) % 360.0)
    row["dec_deg"] = float(np.degrees(np.arcsin(np.clip(-back[2], -1.0, 1.0))))
    row["roll_deg"] = float(np.degrees(np.arctan2(right @ north, up @ north)))
    row["rms_arcsec"] = float(np.degrees(fix.rms_rad) * 3600.0)
    return {**row, "reason": "", "hip": numbers}


def _totals(catalogue: StarCatalogue, images: list[StarFrame], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over all frames, and rates where the true numbers are known."""
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
    """One frame in words."""
    if row["reason"]:
        return f"frame {number}: no fix, {row['reason']}"
    identified = sum(int(hip) >= 0 for hip in row["hip"])
    return (
        f"frame {number}: RA {row['ra_deg']:.3f}°, Dec {row['dec_deg']:+.3f}°, roll {row['roll_deg']:+.2f}°; "
        f"{identified} of {row['stars']} stars, {row['rms_arcsec']:.1f} arcsec rms"
    )


def _in_words(totals: dict[str, Any]) -> str:
    """All frames in words."""
    text = f"{totals['fixes']} fixes, {totals['identified']} stars identified"
    if totals["identification_rate"] is None:
        return text
    found, false = 100.0 * totals["identification_rate"], 100.0 * totals["false_rate"]
    return f"{text}: {found:.2f} % of the {totals['in_catalogue']} that the catalogue has; {false:.2f} % are wrong"
