"""Places in the systems of surveyors: against the transverse Mercator projection by its series, written here anew."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.columns import LogColumns
from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.logs.format import LogFormat
from arrays.typing import FloatArray, Vector

pytest.importorskip("pyproj")
pymap3d = pytest.importorskip("pymap3d")
ORIGIN = (52.41, 13.12, 41.0)


def utm_33(latitude_deg: FloatArray, longitude_deg: FloatArray) -> FloatArray:
    """Easting and northing (n, 2) [m] on WGS 84, by Krüger's series to n³ (Karney 2011, eq. 7 to 11)."""
    f = 1.0 / 298.257223563
    n = f / (2.0 - f)
    e = np.sqrt(f * (2.0 - f))
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg - 15.0)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(t, np.cos(lam)))
    series = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16,
        13 * n**2 / 48 - 3 * n**3 / 5,
        61 * n**3 / 240,
    )
    north, east = xi.copy(), eta.copy()
    for j, a in enumerate(series, start=1):
        north += a * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
        east += a * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
    scale = 0.9996 * 6378137.0 / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    return np.stack([500e3 + scale * east, scale * north], axis=1)


def positions(place: FloatArray, **columns: object) -> FloatArray:
    names = ("E", "N", "H")[: place.shape[1]]
    said = {"sensors": {"a": "Mag"}, "origin": ORIGIN} | columns
    if "geodetic" not in said:
        said.setdefault("position", names)
    rows = "".join(f"{k},1,{','.join(map(repr, row))}\n" for k, row in enumerate(place.tolist()))
    form = LogFormat({"a": ["a_nT"]}, LogColumns(**said), "a header", ())  # type: ignore[arg-type]
    table: Table = form.table(f"time_s,Mag,{','.join(names)}\n{rows}", "log.csv")
    at = [table.header.index(name) for name in ("array_x_m", "array_y_m", "array_z_m")]
    return table.values[:, at]


@pytest.fixture
def true_m() -> FloatArray:
    """Places east, north, up of the origin, a kilometre about it."""
    return np.random.default_rng(1).uniform([-500.0, -500.0, 0.0], [500.0, 500.0, 30.0], (20, 3))


def geodetic(true_m: FloatArray, origin: Vector = ORIGIN) -> FloatArray:
    return np.stack(pymap3d.enu2geodetic(*true_m.T, *origin), axis=1)


class TestGrids:
    def test_convergence_and_scale_are_undone(self, true_m: FloatArray) -> None:
        """By 1.5 degrees and 0.03 %: 13 m at half a kilometre, where they are not."""
        place = geodetic(true_m)
        grid = utm_33(*place[:, :2].T)
        found = positions(np.column_stack([grid, place[:, 2]]), crs="EPSG:32633")
        np.testing.assert_allclose(found, true_m, atol=1e-3)
        as_they_are = grid - utm_33(np.array([ORIGIN[0]]), np.array([ORIGIN[1]]))
        assert np.abs(as_they_are - true_m[:, :2]).max() > 5.0

    def test_latitude_and_longitude_of_another_datum(self, true_m: FloatArray) -> None:
        """ETRS89 is WGS 84, to less than a metre."""
        place = geodetic(true_m)[:, [1, 0, 2]]
        found = positions(place, geodetic=("N", "E", "H"), crs="EPSG:4258")
        np.testing.assert_allclose(found, true_m, atol=1e-3)

    def test_heights_above_ground(self, true_m: FloatArray) -> None:
        grid = utm_33(*geodetic(true_m)[:, :2].T)
        constant = positions(grid, crs="EPSG:32633", height_m=0.4)
        np.testing.assert_array_equal(constant[:, 2], 0.4)
        np.testing.assert_allclose(constant[:, :2], true_m[:, :2], atol=5e-3)
        by_altimeter = positions(np.column_stack([grid, true_m[:, 2]]), crs="EPSG:32633", height_is="ground")
        np.testing.assert_array_equal(by_altimeter[:, 2], true_m[:, 2])

    def test_antenna(self, true_m: FloatArray) -> None:
        found = positions(true_m, origin=None, antenna_m=(0.0, 0.0, 1.5))
        np.testing.assert_allclose(found, true_m - [0.0, 0.0, 1.5])
        with pytest.raises(InputError, match="found no attitude"):
            positions(true_m, origin=None, antenna_m=(0.1, 0.0, 1.5))

    @pytest.mark.parametrize(
        ("columns", "words"),
        [
            ({"crs": "EPSG:99999"}, "crs must be a system that PROJ knows.*'EPSG:99999'"),
            ({"crs": "EPSG:5773"}, r"found EPSG:5773 \(EGM96 height\), expected a system of eastings"),
            (
                {"crs": "EPSG:32633", "position": ("N", "E", "H")},
                "longitude 12 to 18.*latitude 2.*exchange the columns",
            ),
            ({"crs": "EPSG:4326"}, r"found EPSG:4326 \(WGS 84\), expected a system of eastings and northings"),
            ({"crs": "EPSG:32633", "origin": None}, r"origin = \[52\.4\d+, 13\.1\d+, 0\.0\] in the table columns"),
            ({"crs": "EPSG:27700"}, "line 2, column E: found a place outside the area of EPSG:27700"),
            ({"crs": "EPSG:32633", "geodetic": ("E", "N", "H")}, "expected a system of latitude and longitude"),
        ],
    )
    def test_bad_systems(self, columns: dict[str, object], words: str, true_m: FloatArray) -> None:
        place = geodetic(true_m)
        grid = np.column_stack([utm_33(*place[:, :2].T), place[:, 2]])
        with pytest.raises(InputError, match=words):
            positions(grid, **columns)

    def test_zeros_are_no_place(self, true_m: FloatArray) -> None:
        """A receiver without a fix writes them."""
        grid = utm_33(*geodetic(true_m)[:, :2].T)
        grid[:3] = 0.0
        found = positions(grid, crs="EPSG:32633", height_m=0.4)
        np.testing.assert_array_equal(np.isnan(found).any(axis=1), np.arange(len(grid)) < 3)

    @pytest.mark.parametrize(
        ("names", "place", "words"),
        [
            (("E", "N", "H"), (151.2, -33.0, 0.0), "column E: found a latitude beyond 90 degrees"),
            (("Lon", "Lat", "H"), (13.1, 52.4, 0.0), r"\['Lon', 'Lat'\], expected latitude before longitude"),
        ],
    )
    def test_latitude_and_longitude_exchanged(
        self, names: tuple[str, ...], place: tuple[float, ...], words: str
    ) -> None:
        columns = LogColumns(sensors={"a": "Mag"}, origin=ORIGIN, geodetic=names)
        text = f"time_s,Mag,{','.join(names)}\n0,1,{','.join(map(repr, place))}\n"
        with pytest.raises(InputError, match=words):
            LogFormat({"a": ["a_nT"]}, columns, "a header", ()).table(text, "log.csv")
