"""Maps of the world, GeoJSON (RFC 7946) and KML, of positions east, north, up of an origin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from arrays.io.errors import of_extra
from arrays.typing import FloatArray, Vector

FARTHEST_M = 1e5
"""Largest distance from the origin of a local frame [m], for a plane Earth."""


def world_place(position_m: FloatArray, origin: Vector) -> list[float]:
    """Return longitude, latitude [deg] and height [m] of a position (3,).

    ``origin``: latitude, longitude [deg] and height [m]. Raises ValueError far from the origin, as for grid
    coordinates.
    """
    check_near(float(np.linalg.norm(position_m)))
    with of_extra("geo", "a map of the world"):
        from pymap3d import enu2geodetic

    latitude, longitude, height = enu2geodetic(*np.asarray(position_m).tolist(), *origin)
    return [float(longitude), float(latitude), float(height)]


def place_in_words(place: Vector) -> str:
    """Return latitude, longitude [deg] and height [m] of a place in words."""
    return f"latitude {place[0]:.7f}, longitude {place[1]:.7f}, height {place[2]:.2f} m"


def check_near(farthest_m: float) -> None:
    """Refuse positions too far from the origin of a local frame."""
    if not farthest_m <= FARTHEST_M:
        raise ValueError(
            f"Input places must lie within {FARTHEST_M / 1e3:.0f} km of the origin of their frame, which is put at one"
            f" place of the Earth; instead received one {farthest_m / 1e3:.5g} km away. If they are eastings and"
            " northings of a grid (such as UTM), name it by the key crs of the table columns, or subtract the origin's."
        )


def feature(kind: str, coordinates: Sequence[Any], properties: Mapping[str, Any]) -> dict[str, Any]:
    """Return a feature of GeoJSON: "Point" with one place, "LineString" with several."""
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": dict(properties)}


def feature_collection(features: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return a file of GeoJSON."""
    return {"type": "FeatureCollection", "features": list(features)}


def placemark(name: str, words: str, places: Sequence[Sequence[float]]) -> str:
    """Return a placemark of KML on the ground: a point, or a line through several places."""
    kind = "Point" if len(places) == 1 else "LineString"
    text = " ".join(f"{longitude:.9f},{latitude:.9f}" for longitude, latitude, *_ in places)
    return (
        f"<Placemark><name>{escape(name)}</name><description>{escape(words.strip())}</description>"
        f"<{kind}><coordinates>{text}</coordinates></{kind}></Placemark>"
    )


def kml(placemarks: Iterable[str]) -> str:
    """Return a file of KML."""
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    return "\n".join([head, *placemarks, "</Document></kml>", ""])
