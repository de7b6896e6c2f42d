"""Lens of a star camera as a file: fitted from one photograph, used for others.

A TOML file; :class:`LensFile` names its keys.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from os import PathLike
from typing import Annotated, cast, get_args

from adcs.stars.camera import Projection, StarCamera
from adcs.stars.catalogue import StarCatalogue
from adcs.stars.identification import StarFix
from adcs.stars.pose import CameraPose, LensPrior, fit_pose
from arrays.io.errors import InputError
from arrays.io.toml import File, NotNegative, Positive, Rule, one_of, read_toml, section_of
from arrays.typing import FloatArray

_ARCSEC = math.radians(1.0 / 3600.0)
_SCALE, _BENT = 1e-3, 1e-3
"""Least standard deviations of a reused lens, whose heat and focus may have changed: see LensPrior."""
_CALIBRATION, _STEPS = LensPrior(scale=0.1, bent=0.1, bent2=0.02, tangential=0.02), 6
_Pixels = Annotated[int, Rule(lambda value: value > 0, "a positive whole number")]


class LensFile(File, kw_only=True):
    """Lens of a camera as in :class:`adcs.stars.camera.StarCamera`, with standard deviations."""

    projection: Annotated[str, one_of(get_args(Projection))]
    width_px: _Pixels
    height_px: _Pixels
    scale_arcsec: Positive
    """Size of a pixel at the centre."""
    radial: float
    radial2: float = 0.0
    tangential: tuple[float, float] = (0.0, 0.0)
    scale_sigma_arcsec: NotNegative
    radial_sigma: NotNegative
    """Standard deviation of a corner's displacement by k₁."""


@dataclass(frozen=True)
class KnownLens:
    """Camera with a calibrated lens, and how well it is known."""

    camera: StarCamera
    prior: LensPrior

    def check(self, path: str | PathLike[str], shape: tuple[int, ...]) -> None:
        """Refuse a picture (height, width) of another size."""
        expected = (self.camera.height_px, self.camera.width_px)
        if shape != expected:
            raise InputError(
                f"{path}: found {shape[1]} × {shape[0]} pixels, expected {expected[1]} × {expected[0]} as in the lens."
            )


def calibrate_lens(fix: StarFix, points_px: FloatArray, catalogue: StarCatalogue, noise_px: float) -> CameraPose:
    """Fit the lens with all its distortions to the stars of a solved photograph, for other photographs.

    Tangential distortions are fitted here alone: with few stars they are hard to tell from the attitude.
    """
    points = points_px[fix.stars[:, 0]]
    if fix.mirrored:
        points = fix.pose.camera.exchange_sides(points)
    pose = fix.pose
    for _ in range(_STEPS):
        pose = fit_pose(points, catalogue.directions[fix.stars[:, 1]], pose, fix.pose.camera, _CALIBRATION, noise_px)
    return pose


def lens_text(pose: CameraPose) -> str:
    """Return the lens of a fitted pose as the text of a TOML file."""
    camera = pose.camera
    values = {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "scale_arcsec": float(camera.rad_per_px) / _ARCSEC,
        "radial": float(camera.radial),
        "radial2": float(camera.radial2),
        "tangential": [float(p) for p in camera.tangential],
        "scale_sigma_arcsec": camera.rad_per_px * math.sqrt(pose.covariance[3, 3]) / _ARCSEC,
        "radial_sigma": pose.corner_sigma / camera.corner**2,
    }
    return f'projection = "{camera.projection}"\n' + "".join(f"{key} = {value!r}\n" for key, value in values.items())


def read_lens(path: str | PathLike[str]) -> KnownLens:
    """Read the lens of a camera from a TOML file; see :class:`LensFile`.

    Parameters
    ----------
    path : str or path-like
        TOML file.

    Returns
    -------
    KnownLens
        Camera, and how well its lens is known.

    Raises
    ------
    InputError
        The file cannot be read, or a value is missing or out of range.
    """
    lens = section_of(str(path), read_toml(path, "a lens as --lens writes it"), LensFile)
    try:
        camera = StarCamera(
            lens.width_px,
            lens.height_px,
            lens.scale_arcsec * _ARCSEC,
            lens.radial,
            cast(Projection, lens.projection),
            lens.radial2,
            lens.tangential,
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    scale = max(lens.scale_sigma_arcsec / lens.scale_arcsec, _SCALE)
    return KnownLens(camera, LensPrior(scale, max(lens.radial_sigma * camera.corner**2, _BENT)))
