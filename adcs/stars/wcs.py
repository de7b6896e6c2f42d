"""World coordinates of a solved photograph as a FITS header.

The header of a pinhole has the gnomonic projection TAN, with the distortion as polynomials of the convention SIP. That
of an equidistant lens has the zenithal polynomial projection ZPN. By FITS, the centre of the first pixel is (1, 1), and
the first row is at the bottom.

Sources: Calabretta and Greisen, Representations of celestial coordinates in FITS, 2002; Shupe et al., The SIP
convention for representing distortion in FITS image headers, 2005.
"""

from __future__ import annotations

import math

import numpy as np

from adcs.stars.camera import DISTORTION_DEGREES, StarCamera
from adcs.stars.identification import StarFix
from arrays.typing import FloatArray

_CARD, _BLOCK = 80, 2880
_ZPN_POWERS = 20  # limit of the powers of a polynomial by the standard


def wcs_header(fix: StarFix) -> str:
    """Return the FITS header of the world coordinates of a solved photograph.

    The frame is the catalogue's, for Hipparcos the ICRS. The projection is TAN without, and TAN-SIP with a
    distortion of a pinhole, ZPN for an equidistant lens. In a mirrored picture x is as in the file.
    """
    camera, R = fix.pose.camera, fix.R_catalogue_from_frame
    scale = math.tan(camera.rad_per_px)
    degrees = math.degrees(scale) * _plane_from_frame(R) @ np.diag([-1.0 if fix.mirrored else 1.0, 1.0])
    axis = -R[:, 2]
    cards: dict[str, str | int | float | bool] = {"SIMPLE": True, "BITPIX": 8, "NAXIS": 0, "WCSAXES": 2}
    bent = bool(camera.distortion.any())
    equidistant = camera.projection == "equidistant"
    suffix = "ZPN" if equidistant else "TAN-SIP" if bent else "TAN"
    cards |= {"CTYPE1": f"RA---{suffix}", "CTYPE2": f"DEC--{suffix}", "CUNIT1": "deg", "CUNIT2": "deg"}
    cards |= {"CRVAL1": math.degrees(math.atan2(axis[1], axis[0])) % 360.0}
    cards |= {"CRVAL2": math.degrees(math.asin(min(max(float(axis[2]), -1.0), 1.0)))}
    cards |= {"CRPIX1": 0.5 * camera.width_px + 0.5, "CRPIX2": 0.5 * camera.height_px + 0.5}
    cards |= {f"CD{i + 1}_{j + 1}": float(degrees[i, j]) for i in range(2) for j in range(2)}
    cards |= {"LONPOLE": 180.0, "RADESYS": "ICRS", "IMAGEW": camera.width_px, "IMAGEH": camera.height_px}
    if equidistant:
        cards |= {f"PV2_{m}": value for m, value in _places_of_angles(camera).items()}
    elif bent:
        cards |= _sip(camera, scale, fix.mirrored)
    text = "".join(_card(name, value) for name, value in cards.items()) + "END".ljust(_CARD)
    return text.ljust(-(-len(text) // _BLOCK) * _BLOCK)


def _sip(camera: StarCamera, scale: float, mirrored: bool) -> dict[str, int | float]:
    """Return the polynomials of the convention SIP, in pixels of the file."""
    k1, k2, p1, p2 = (
        camera.distortion * scale ** (DISTORTION_DEGREES - 1.0) * [1.0, 1.0, 1.0, -1.0 if mirrored else 1.0]
    )
    along = {"2_0": 3.0 * p2, "1_1": 2.0 * p1, "0_2": p2, "3_0": k1, "1_2": k1, "5_0": k2, "3_2": 2.0 * k2, "1_4": k2}
    across = {"2_0": p1, "1_1": 2.0 * p2, "0_2": 3.0 * p1, "0_3": k1, "2_1": k1, "0_5": k2, "2_3": 2.0 * k2, "4_1": k2}
    return {"A_ORDER": 5, "B_ORDER": 5} | {
        f"{name}_{powers}": float(value)
        for name, terms in (("A", along), ("B", across))
        for powers, value in terms.items()
    }


def _plane_from_frame(R: FloatArray) -> FloatArray:
    """Return the components (2, 2) of the frame's x and y along east and north at the axis."""
    x, y, z = -R[:, 2]
    ra, dec = math.atan2(y, x), math.asin(min(max(float(z), -1.0), 1.0))
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    north = np.array([-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec)])
    return np.stack([east, north]) @ R[:, :2]


def _places_of_angles(camera: StarCamera) -> dict[int, float]:
    """Return the coefficients of ζ, ζ³, … of the place s at the angle ζ = s (1 + k₁ s² + k₂ s⁴) from the axis."""
    place = np.linspace(0.0, 1.02 * camera.corner, 400)[1:]
    angle = place * (1.0 + camera.radial * place**2 + camera.radial2 * place**4)
    powers = np.arange(1, _ZPN_POWERS, 2)
    fitted = np.linalg.lstsq((angle / angle[-1])[:, None] ** powers, place, rcond=None)[0]
    return {int(m): float(value / angle[-1] ** m) for m, value in zip(powers, fitted, strict=True)}


def _card(name: str, value: str | float | bool) -> str:
    """Return a card of 80 characters in the fixed format of FITS."""
    if isinstance(value, bool):
        text = f"{'T' if value else 'F':>20}"
    elif isinstance(value, str):
        text = f"'{value:<8}'"
    else:
        text = f"{value:>20}" if isinstance(value, int) else f"{value:>20.13E}"
    return f"{name:<8}= {text}".ljust(_CARD)
