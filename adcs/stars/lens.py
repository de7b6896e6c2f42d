"""Lens of a star camera as a file: fitted from one photograph, used for others.

A TOML file with ``projection`` ("pinhole" or "equidistant"), ``width_px``, ``height_px``, ``scale_arcsec`` (of a pixel
at the centre) and ``radial``, as in :class:`adcs.stars.camera.StarCamera`, and the standard deviations
``scale_sigma_arcsec`` and ``radial_sigma``.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from os import PathLike

from adcs.stars.camera import Projection, StarCamera
from adcs.stars.pose import CameraPose, LensPrior
from arrays.io.errors import InputError
from arrays.io.text import read_text

_ARCSEC = math.radians(1.0 / 3600.0)
_SCALE, _BENT = 1e-3, 1e-3
"""Least standard deviations of a reused lens, whose heat and focus may have changed: see LensPrior."""
_KEYS = ("width_px", "height_px", "scale_arcsec", "radial", "scale_sigma_arcsec", "radial_sigma")


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


def lens_text(pose: CameraPose) -> str:
    """Return the lens of a fitted pose as the text of a TOML file."""
    camera, covariance = pose.camera, pose.covariance
    values = {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "scale_arcsec": float(camera.rad_per_px) / _ARCSEC,
        "radial": float(camera.radial),
        "scale_sigma_arcsec": camera.rad_per_px * math.sqrt(covariance[3, 3]) / _ARCSEC,
        "radial_sigma": math.sqrt(covariance[4, 4]),
    }
    return f'projection = "{camera.projection}"\n' + "".join(f"{key} = {value!r}\n" for key, value in values.items())


def read_lens(path: str | PathLike[str]) -> KnownLens:
    """Read the lens of a camera from a TOML file; see :mod:`adcs.stars.lens`.

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
    try:
        values = tomllib.loads(read_text(path, "a lens as --lens writes it"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: found no TOML ({error}), expected a lens as --lens writes it.") from None
    named = values.get("projection")
    projection: Projection = "equidistant" if named == "equidistant" else "pinhole"
    if named != projection:
        raise InputError(f'{path}: found projection = {named!r}, expected "pinhole" or "equidistant".')
    for key in _KEYS:
        value = values.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{path}: found {key} = {value!r}, expected a finite number.")
        if (key.endswith("_px") and not isinstance(value, int)) or (key.startswith(("scale", "w", "h")) and value <= 0):
            raise InputError(f"{path}: found {key} = {value!r}, expected a positive number, in pixels a whole one.")
    try:
        camera = StarCamera(
            values["width_px"], values["height_px"], values["scale_arcsec"] * _ARCSEC, values["radial"], projection
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    scale = max(values["scale_sigma_arcsec"] / values["scale_arcsec"], _SCALE)
    return KnownLens(camera, LensPrior(scale, max(abs(values["radial_sigma"]) * camera.corner**2, _BENT)))
