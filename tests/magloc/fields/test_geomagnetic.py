"""Tests of magloc.fields.geomagnetic: one class per property.

The oracles: the official test values of NCEI (WMM2025) and BGS (IGRF-14), the grid of DGRF-2010 by NCEI, ppigrf,
frames of pymap3d, the published geomagnetic poles, and the closed forms of magloc.fields.dipole.
"""

from __future__ import annotations

import datetime
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import ppigrf
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from magloc.fields import dipole
from magloc.fields.geomagnetic import (
    MODELS,
    Coefficients,
    coefficients,
    decimal_year,
    ecef_from_geodetic,
    field_ecef,
    field_enu,
    field_geocentric_ned,
    field_ned,
    gradient_enu,
    tilted_dipole_ecef,
)

Array = NDArray[np.float64]
NT = 1e-9
ORIGIN = np.zeros(3)
AXIAL = np.array([0.0, 0.0, 1.0])
# The table of test values in the technical report of WMM2025 (NCEI, public domain in the USA):
# decimal year, height [km], geodetic latitude and longitude [°], X, Y, Z [nT].
WMM_REPORT = np.array(
    [
        [2025.0, 0.0, 80.0, 0.0, 6521.6, 145.9, 54791.5],
        [2025.0, 0.0, 0.0, 120.0, 39677.8, -109.6, -10580.2],
        [2025.0, 0.0, -80.0, 240.0, 6117.5, 15751.9, -52022.5],
        [2025.0, 100.0, 80.0, 0.0, 6216.0, 92.4, 52598.8],
        [2025.0, 100.0, 0.0, 120.0, 37688.6, -96.2, -10152.1],
        [2025.0, 100.0, -80.0, 240.0, 5907.6, 14780.3, -49540.7],
        [2027.5, 0.0, 80.0, 0.0, 6500.8, 294.5, 54869.4],
        [2027.5, 0.0, 0.0, 120.0, 39701.6, -167.4, -10381.8],
        [2027.5, 0.0, -80.0, 240.0, 6200.7, 15730.3, -51783.7],
        [2027.5, 100.0, 80.0, 0.0, 6196.7, 233.8, 52670.5],
        [2027.5, 100.0, 0.0, 120.0, 37711.5, -148.7, -9969.8],
        [2027.5, 100.0, -80.0, 240.0, 5984.0, 14760.1, -49317.7],
    ]
)
# The first rows of the high-precision test values of WMM2025 (NCEI, public domain in the USA), columns as above.
WMM_PRECISE = np.array(
    [
        [2025.0, 28, 89, -121, -255.388723, -1482.460628, 56194.288771],
        [2025.0, 48, 80, -96, 1875.982280, -1079.269389, 55623.044051],
        [2025.0, 54, 82, 87, 1324.336929, 1883.428620, 56740.772059],
        [2025.0, 65, 43, 93, 24299.852822, 210.517066, 50037.923998],
        [2025.0, 51, -33, 109, 21737.778822, -2090.274098, -52710.003920],
        [2025.0, 39, -59, -8, 14358.095523, -4049.107540, -24389.086374],
        [2025.5, 6, -36, -137, 23781.930678, 8786.698927, -32577.518648],
        [2025.5, 50, -81, -67, 16132.682326, 8623.494405, -44412.283868],
        [2026.0, 74, -57, 3, 13268.119649, -5498.179626, -23576.062921],
    ]
)
RNG = np.random.default_rng(14)
LATITUDE = np.degrees(np.arcsin(RNG.uniform(-1, 1, 40)))
LONGITUDE = RNG.uniform(-180, 180, 40)
HEIGHT = RNG.uniform(0, 600e3, 40)
YEAR = RNG.uniform(2025, 2030, 40)


def first_degree(model: str) -> Coefficients:
    """A model cut after n = 1: the dipole Earth as harmonics."""
    table = coefficients(model)
    keep = table.degree == 1
    return replace(
        table,
        degree=table.degree[keep],
        order=table.order[keep],
        g_T=table.g_T[:, keep],
        h_T=table.h_T[:, keep],
    )


class TestOfficialValues:
    def test_wmm2025_report(self) -> None:
        year, height, latitude, longitude = WMM_REPORT[:, :4].T
        field = field_ned(latitude, longitude, 1e3 * height, year, "WMM2025")
        # Printed to 0.1 nT.
        np.testing.assert_allclose(field / NT, WMM_REPORT[:, 4:], rtol=0, atol=0.05)

    def test_wmm2025_precise(self) -> None:
        year, height, latitude, longitude = WMM_PRECISE[:, :4].T
        field = field_ned(latitude, longitude, 1e3 * height, year, "WMM2025")
        np.testing.assert_allclose(field / NT, WMM_PRECISE[:, 4:], rtol=0, atol=1e-3)

    def test_wmm2025_all_rows_and_rates(self, data_folder: Path) -> None:
        rows = np.loadtxt(data_folder / "geomag" / "WMM2025_FINAL_TEST_VALUES_HIGHPREC.txt")
        assert len(rows) == 100
        year, height, latitude, longitude = rows[:, :4].T
        field = field_ned(latitude, longitude, 1e3 * height, year, "WMM2025")
        np.testing.assert_allclose(field / NT, rows[:, 7:10], rtol=0, atol=1e-3)

        start, end = (field_ned(latitude, longitude, 1e3 * height, date, "WMM2025") for date in (2025.0, 2030.0))
        np.testing.assert_allclose((end - start) / 5 / NT, rows[:, 14:17], rtol=0, atol=1e-5)

    def test_igrf14_bgs(self, data_folder: Path) -> None:
        rows = np.genfromtxt(data_folder / "geomag" / "IGRF14_BGS_test_values.csv", delimiter=",", skip_header=2)
        assert len(rows) == 12
        year, colatitude, longitude, radius = rows[:, :4].T
        field = field_geocentric_ned(1e3 * radius, 90 - colatitude, longitude, year)
        np.testing.assert_allclose(field / NT, rows[:, 4:], rtol=0, atol=0.02)

    def test_dgrf2010_ncei(self, data_folder: Path) -> None:
        rows = np.genfromtxt(data_folder / "geomag" / "NCEI_dgrf-2010-01-01_sub.csv", delimiter=",", skip_header=1)
        assert len(rows) > 300
        year, latitude, longitude, height = rows[:, :4].T
        field = field_ned(latitude, longitude, 1e3 * height, year)
        # b_n, b_e, b_z, printed to 0.1 nT.
        np.testing.assert_allclose(field / NT, rows[:, [4, 6, 8]], rtol=0, atol=0.05)


class TestPeers:
    @staticmethod
    def ppigrf_ned(dates: list[datetime.datetime]) -> Array:
        """Geocentric north, east, down at points of 6,400 to 7,000 km: (dates, 40, 3) [nT]."""
        radial, south, east = ppigrf.igrf_gc(6400 + HEIGHT / 1e3, 90 - LATITUDE, LONGITUDE, dates)
        return np.stack([-south, east, -radial], axis=-1)

    @staticmethod
    def ours_ned(year: object) -> Array:
        return field_geocentric_ned(6400e3 + HEIGHT, LATITUDE, LONGITUDE, year) / NT  # type: ignore[arg-type]

    def test_ppigrf_at_the_nodes(self) -> None:
        dates = [datetime.datetime(year, 1, 1) for year in range(1900, 2031, 5)]
        ours = self.ours_ned(np.array(dates)[:, None])
        np.testing.assert_allclose(ours, self.ppigrf_ned(dates), rtol=0, atol=1e-8)

    def test_ppigrf_between_the_nodes(self) -> None:
        dates = [datetime.datetime(1903, 3, 1), datetime.datetime(1972, 8, 9, 10), datetime.datetime(2026, 11, 21, 6)]
        ours = self.ours_ned(np.array(dates)[:, None])
        year = decimal_year(dates)[:, None]
        start = 5 * np.floor(year / 5)
        # ppigrf interpolates in days: a leap year among the five moves a date by less than 0.8 days.
        rate = np.abs(self.ours_ned(start + 5) - self.ours_ned(start)) / 5
        assert np.all(np.abs(ours - self.ppigrf_ned(dates)) <= 0.8 / 365.25 * rate + 1e-8)


class TestTime:
    """Between two nodes the field is the straight line through theirs, and every point may have its own time."""

    @pytest.mark.parametrize(
        ("model", "nodes"), [("IGRF-14", (1960, 1965)), ("IGRF-14", (2020, 2025)), ("WMM2025", (2025, 2030))]
    )
    def test_is_linear_between_nodes(self, model: str, nodes: tuple[int, int]) -> None:
        part = RNG.uniform(0, 1, 40)
        start, end = (field_ned(LATITUDE, LONGITUDE, HEIGHT, node, model) for node in nodes)
        between = field_ned(LATITUDE, LONGITUDE, HEIGHT, nodes[0] + 5 * part, model)
        expected = (1 - part[:, None]) * start + part[:, None] * end
        # A decimal year is exact to 2e-13 years, in which the field changes by 1e-11 nT.
        np.testing.assert_allclose(between / NT, expected / NT, rtol=0, atol=1e-9)

    @pytest.mark.parametrize("model", MODELS)
    def test_batch_is_the_loop(self, model: str) -> None:
        batch = field_ned(LATITUDE, LONGITUDE, HEIGHT, YEAR, model)
        single = [field_ned(*one, model) for one in zip(LATITUDE, LONGITUDE, HEIGHT, YEAR, strict=True)]
        np.testing.assert_allclose(batch / NT, np.array(single) / NT, rtol=0, atol=1e-9)

    def test_ends_of_validity_belong_to_it(self) -> None:
        ends = field_ned(50, 10, 0, [1900.0, 2030.0])
        inside = field_ned(50, 10, 0, [1900.0 + 1e-9, 2030.0 - 1e-9])
        np.testing.assert_allclose(ends / NT, inside / NT, rtol=0, atol=1e-6)

    @pytest.mark.parametrize(
        ("date", "year"),
        [
            (datetime.date(2025, 1, 1), 2025.0),
            (datetime.date(2024, 7, 2), 2024.5),  # 183 of 366 days
            (datetime.datetime(2025, 7, 2, 12), 2025.5),  # 182.5 of 365 days
            (np.datetime64("2025-07-02T12"), 2025.5),
            (np.datetime64("1900-01-01"), 1900.0),
            (datetime.datetime(2025, 7, 2, 15, tzinfo=datetime.timezone(datetime.timedelta(hours=3))), 2025.5),
            (2025.5, 2025.5),
            (2025, 2025.0),
        ],
    )
    def test_decimal_years(self, date: object, year: float) -> None:
        assert decimal_year(date) == year  # type: ignore[arg-type]

    def test_decimal_years_of_sequences(self) -> None:
        dates = [datetime.date(2025, 1, 1), datetime.date(2024, 7, 2)]
        np.testing.assert_array_equal(decimal_year(dates), [2025.0, 2024.5])
        np.testing.assert_array_equal(decimal_year(np.array(dates, dtype="datetime64[ns]")), [2025.0, 2024.5])
        assert decimal_year(np.array(dates)[:, None]).shape == (2, 1)


class TestFrames:
    """Geodetic, geocentric and Cartesian are one field, seen in three frames."""

    def test_ecef_from_geodetic(self) -> None:
        # The axes of WGS-84.
        np.testing.assert_allclose(ecef_from_geodetic(0, 0, 10), [6378147, 0, 0], rtol=0, atol=1e-6)
        np.testing.assert_allclose(ecef_from_geodetic(0, 90, 0), [0, 6378137, 0], rtol=0, atol=1e-6)
        np.testing.assert_allclose(ecef_from_geodetic(-90, 0, 10), [0, 0, -6356762.314245], rtol=0, atol=1e-5)

    @pytest.mark.parametrize("model", MODELS)
    def test_geodetic_is_ecef(self, model: str) -> None:
        b_ecef = field_ecef(ecef_from_geodetic(LATITUDE, LONGITUDE, HEIGHT), YEAR, model)
        expected = np.stack(pymap3d.ecef2enuv(*b_ecef.T, LATITUDE, LONGITUDE), axis=-1)
        np.testing.assert_allclose(field_enu(LATITUDE, LONGITUDE, HEIGHT, YEAR, model) / NT, expected / NT, atol=1e-9)
        north_east_down = field_ned(LATITUDE, LONGITUDE, HEIGHT, YEAR, model)
        np.testing.assert_allclose(north_east_down / NT, expected[:, [1, 0, 2]] * [1, 1, -1] / NT, atol=1e-9)

    @pytest.mark.parametrize("model", MODELS)
    def test_geodetic_is_geocentric(self, model: str) -> None:
        x, y, z = pymap3d.geodetic2ecef(LATITUDE, LONGITUDE, HEIGHT)
        radius, geocentric_latitude = (
            np.sqrt(x**2 + y**2 + z**2),
            np.degrees(np.arcsin(z / np.sqrt(x**2 + y**2 + z**2))),
        )
        geocentric = field_geocentric_ned(radius, geocentric_latitude, LONGITUDE, YEAR, model)
        geodetic = field_ned(LATITUDE, LONGITUDE, HEIGHT, YEAR, model)
        # East is the same in both; the verticals are up to 0.2° apart.
        turn = np.radians(LATITUDE - geocentric_latitude)
        north = np.cos(turn) * geocentric[:, 0] + np.sin(turn) * geocentric[:, 2]
        down = np.cos(turn) * geocentric[:, 2] - np.sin(turn) * geocentric[:, 0]
        expected = np.stack([north, geocentric[:, 1], down], axis=-1)
        np.testing.assert_allclose(geodetic / NT, expected / NT, rtol=0, atol=1e-7)

    @pytest.mark.parametrize("model", MODELS)
    def test_dateline(self, model: str) -> None:
        east, west, again = (field_ned(LATITUDE, longitude, 0, 2026, model) for longitude in (180, -180, 540))
        np.testing.assert_allclose(east / NT, west / NT, rtol=0, atol=1e-8)
        np.testing.assert_allclose(east / NT, again / NT, rtol=0, atol=1e-8)

    @pytest.mark.parametrize("model", MODELS)
    @pytest.mark.parametrize("pole", [90.0, -90.0])
    def test_at_a_pole_all_meridians_see_one_vector(self, model: str, pole: float) -> None:
        longitude = np.arange(-180.0, 181.0, 30.0)
        b_ned = field_ned(pole, longitude, 0, 2026, model)
        b_ecef = np.stack(pymap3d.enu2uvw(*(b_ned[:, [1, 0, 2]] * [1, 1, -1]).T, pole, longitude), axis=-1)
        # The field is that of a place 0.1 mm away: 5e-6 nT at 40 pT/m.
        np.testing.assert_allclose(b_ecef / NT, np.broadcast_to(b_ecef[0], b_ecef.shape) / NT, rtol=0, atol=5e-6)
        nearby = field_ned(pole * (1 - 1e-7), longitude, 0, 2026, model)  # a metre away
        np.testing.assert_allclose(b_ned / NT, nearby / NT, rtol=0, atol=0.1)
        on_the_axis = field_ecef(ecef_from_geodetic(pole, 0, 0) * [0, 0, 1], 2026, model)
        np.testing.assert_allclose(on_the_axis / NT, b_ecef[0] / NT, rtol=0, atol=5e-6)

    @pytest.mark.parametrize("function", [field_ned, field_enu, gradient_enu])
    def test_arguments_broadcast(self, function: Callable[..., Array]) -> None:
        grid = function(LATITUDE[:3, None, None], LONGITUDE[:2, None], 100.0, YEAR[:4])
        assert grid.shape[:3] == (3, 2, 4)
        for i, j, k in np.ndindex(3, 2, 4):
            one = function(LATITUDE[i], LONGITUDE[j], 100.0, YEAR[k])
            np.testing.assert_allclose(grid[i, j, k], one, rtol=0, atol=1e-18)
        assert function(np.empty(0), 0, 0, 2026).shape[0] == 0

    def test_pieces_of_a_large_batch_join(self) -> None:
        latitude = np.linspace(-90, 90, 20_001)
        picked = [0, 8191, 8192, 16_383, 16_384, 20_000]
        large = field_ned(latitude, 30.0, 0.0, np.linspace(1900, 2030, 20_001))
        few = field_ned(latitude[picked], 30.0, 0.0, np.linspace(1900, 2030, 20_001)[picked])
        np.testing.assert_allclose(large[picked] / NT, few / NT, rtol=0, atol=1e-9)


class TestGradient:
    @given(st.floats(-90, 90), st.floats(-180, 180), st.floats(1900, 2030))
    def test_has_neither_trace_nor_curl(self, latitude: float, longitude: float, year: float) -> None:
        gradient = gradient_enu(latitude, longitude, 0.0, year)
        size = np.linalg.norm(gradient)
        assert abs(np.trace(gradient)) <= 1e-8 * size
        assert np.linalg.norm(gradient - gradient.T) <= 1e-8 * size

    def test_is_tens_of_picotesla_per_metre(self) -> None:
        # A dipole's is 3 B/r at its pole, 3 * 60 µT / 6371 km = 28 pT/m, in its largest entry.
        largest = np.abs(gradient_enu(LATITUDE, LONGITUDE, 0.0, 2026)).max(axis=(-1, -2))
        assert np.all((largest > 5e-12) & (largest < 50e-12))

    @pytest.mark.parametrize("model", MODELS)
    def test_of_a_dipole_is_the_closed_form(self, model: str) -> None:
        moment = tilted_dipole_ecef(YEAR, model)
        in_ecef = dipole.gradient_tensor(ecef_from_geodetic(LATITUDE, LONGITUDE, HEIGHT), ORIGIN, moment)
        axes = np.stack(
            [np.stack(pymap3d.enu2uvw(*axis, LATITUDE, LONGITUDE), axis=-1) for axis in np.eye(3)], axis=-2
        )  # east, north, up in ECEF
        expected = axes @ in_ecef @ axes.mT
        gradient = gradient_enu(LATITUDE, LONGITUDE, HEIGHT, YEAR, first_degree(model))
        error = np.linalg.norm(gradient - expected, axis=(-1, -2))
        assert np.all(error <= 1e-8 * np.linalg.norm(expected, axis=(-1, -2)))

    @pytest.mark.parametrize("model", MODELS)
    def test_gives_the_field_across_an_array(self, model: str) -> None:
        for latitude, longitude in zip(LATITUDE[:10], LONGITUDE[:10], strict=True):
            offsets_enu = RNG.uniform(-10, 10, (5, 3))
            there = pymap3d.enu2ecef(*offsets_enu.T, latitude, longitude, 150.0)
            b_ecef = field_ecef(np.stack(there, axis=-1), 2026, model)
            expected = np.stack(pymap3d.ecef2enuv(*b_ecef.T, latitude, longitude), axis=-1)
            place = (latitude, longitude, 150.0, 2026, model)
            across = field_enu(*place) + offsets_enu @ gradient_enu(*place).T
            # What is left is of second order, |G| x²/r ~ 40 pT/m (17 m)²/6371 km times a few.
            np.testing.assert_allclose(across / NT, expected / NT, rtol=0, atol=1e-5)
            assert np.max(np.abs(field_enu(*place) - expected)) > 1e-11


class TestDipoleEarth:
    """The degree n = 1 of a model is magloc.fields.dipole with the moment at the Earth's centre."""

    @pytest.mark.parametrize("model", MODELS)
    def test_tilted_dipole_is_the_first_degree(self, model: str) -> None:
        place = ecef_from_geodetic(LATITUDE, LONGITUDE, HEIGHT)
        expected = field_ecef(place, YEAR, first_degree(model))
        actual = dipole.field(place, ORIGIN, tilted_dipole_ecef(YEAR, model))
        np.testing.assert_allclose(actual / NT, expected / NT, rtol=0, atol=1e-8)

    def test_axial_dipole_points_south_and_its_field_north(self) -> None:
        moment = AXIAL * tilted_dipole_ecef(2026)
        assert moment[2] < 0
        assert dipole.field([7e6, 0, 0], ORIGIN, moment)[2] > 0

    @pytest.mark.parametrize(
        ("year", "latitude", "longitude"),
        # Centred dipole poles of definitive models, geocentric, printed to 0.01°: Woods Hole Oceanographic Institution,
        # deeptow.whoi.edu/cdpole.html, the rows whose two poles are opposite as printed (that of 1990, say, is not).
        [
            (1950, 78.47, -68.85),
            (1960, 78.51, -69.47),
            (1970, 78.59, -70.18),
            (1975, 78.69, -70.47),
            (1980, 78.81, -70.76),
            (1985, 78.97, -70.90),
        ],
    )
    def test_geomagnetic_pole(self, year: int, latitude: float, longitude: float) -> None:
        x, y, z = -tilted_dipole_ecef(year)
        assert np.degrees(np.arctan2(z, np.hypot(x, y))) == pytest.approx(latitude, abs=0.005)
        assert np.degrees(np.arctan2(y, x)) == pytest.approx(longitude, abs=0.005)


class TestMisuse:
    @pytest.mark.parametrize(
        ("model", "date", "validity"),
        [
            ("IGRF-14", 1899.9, "1900.0 to 2030.0"),
            ("IGRF-14", datetime.date(2030, 1, 2), "1900.0 to 2030.0"),
            ("WMM2025", datetime.date(2024, 12, 31), "2025.0 to 2030.0"),
            ("WMM2025", [2026.0, 2030.1], "2025.0 to 2030.0"),
        ],
    )
    def test_outside_the_validity(self, model: str, date: object, validity: str) -> None:
        message = f"Input date must lie within the validity of {model}, {validity}; instead received"
        for function in (field_ned, gradient_enu):
            with pytest.raises(ValueError, match=message):
                function(50, 10, 0, date, model)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=message):
            tilted_dipole_ecef(date, model)  # type: ignore[arg-type]

    @pytest.mark.parametrize("date", ["2026-11-21", None, [datetime.date(2026, 1, 1), 2026.5], datetime.time(12)])
    def test_not_a_date(self, date: object) -> None:
        with pytest.raises(ValueError, match="Input date must be dates, datetime64 or decimal years; instead received"):
            decimal_year(date)  # type: ignore[arg-type]

    @pytest.mark.parametrize("date", [np.nan, np.inf, np.datetime64("NaT")])
    def test_missing_date(self, date: object) -> None:
        with pytest.raises(ValueError, match="Input date must be finite"):
            field_ned(50, 10, 0, date)  # type: ignore[arg-type]

    @pytest.mark.parametrize("name", ["latitude_deg", "longitude_deg", "height_m"])
    @pytest.mark.parametrize("function", [field_ned, field_enu, gradient_enu])
    def test_not_finite(self, function: Callable[..., Array], name: str) -> None:
        for value in (np.nan, [0.0, np.inf]):
            arguments = {"latitude_deg": 50.0, "longitude_deg": 10.0, "height_m": 0.0, "date": 2026, name: value}
            with pytest.raises(ValueError, match=f"Input {name} must be finite"):
                function(**arguments)

    @pytest.mark.parametrize("latitude", [90.001, [0.0, -91.0]])
    def test_beyond_a_pole(self, latitude: object) -> None:
        with pytest.raises(ValueError, match="Input latitude_deg must lie between -90 and 90; instead received"):
            field_ned(latitude, 0, 0, 2026)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="Input geocentric_latitude_deg must lie between -90 and 90"):
            field_geocentric_ned(6.4e6, latitude, 0, 2026)  # type: ignore[arg-type]

    def test_inside_the_core(self) -> None:
        with pytest.raises(ValueError, match=r"outside the Earth's core, 3485 km from its centre; .* 6.4 km"):
            field_geocentric_ned(6400.0, 0, 0, 2026)  # kilometres taken for metres
        with pytest.raises(ValueError, match="outside the Earth's core"):
            field_ecef([0.0, 0.0, 0.0], 2026)

    def test_not_a_position(self) -> None:
        with pytest.raises(ValueError, match=r"Input position_ecef_m must have shape \(\.\.\., 3\)"):
            field_ecef([7e6, 0.0], 2026)

    def test_no_such_model(self) -> None:
        with pytest.raises(ValueError, match="Input model must be one of IGRF-14, WMM2025; instead received 'WMM2020'"):
            field_ned(50, 10, 0, 2026, "WMM2020")


class TestCost:
    def test_importing_loads_none_of_the_packages(self) -> None:
        code = "import sys, magloc.fields.geomagnetic; print({'pandas', 'ppigrf', 'wmm', 'pymap3d'} & set(sys.modules))"
        loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
        assert loaded.stdout.strip() == "set()"
