"""Tests of adcs.environment.orbit, adcs.environment.sun and adcs.environment.environment.

The oracles: the verification values that come with sgp4, published equinoxes, the Astronomical Almanac's formulas of
the Sun, rays from points of the Sun's disc, and the official values of IGRF-14.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import erfa
import numpy as np
import pytest
import sgp4
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pymap3d import ecef2geodetic

from adcs.environment.environment import Environment, environment, field_eci
from adcs.environment.orbit import EARTH_RADIUS_M, MU_M3_S2, CircularOrbit, Sgp4Orbit, node_of_local_time
from adcs.environment.sun import ASTRONOMICAL_UNIT_M, SUN_RADIUS_M, illuminated_fraction, sun_position_eci
from adcs.frames import DAY_S, Instants, R_ecef_from_eci, instants, julian_dates, rotation_about_z, turned
from magloc.fields.geomagnetic import field_ned

Array = NDArray[np.float64]
DAY = np.datetime64("2014-09-01", "us")
ORBIT = CircularOrbit(600e3, np.radians(97.8), node_of_local_time(15.0, DAY), DAY)
NT = 1e-9
# Two-line elements of the files that come with sgp4.
VANGUARD = (
    "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753",
    "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667",
)


@dataclass(frozen=True)
class Resting:
    """An "orbit" that rests above a place of the Earth, so that its axes are east, north, up (geocentric)."""

    position_ecef_m: tuple[float, float, float]

    def position_velocity_eci(self, utc: Instants) -> tuple[Array, Array]:
        R = R_ecef_from_eci(utc)
        position = turned(R.mT, np.broadcast_to(self.position_ecef_m, (*utc.shape, 3)))
        return position, np.cross(turned(R.mT, np.broadcast_to([0.0, 0.0, 7.3e-5], position.shape)), position)


class TestCircularOrbit:
    def test_kepler(self) -> None:
        assert ORBIT.period_s == pytest.approx(2 * np.pi * np.sqrt((EARTH_RADIUS_M + 600e3) ** 3 / MU_M3_S2), rel=1e-14)
        # The ellipsoidal-estimation paper's orbit of 6878 km (within 0.1 s, its constants).
        assert CircularOrbit(6878e3 - EARTH_RADIUS_M, 1.0, 0.0, DAY).period_s == pytest.approx(5676.8, abs=0.1)

    def test_obeys_newton(self) -> None:
        h = 1.0
        (before, now, after), velocity = ORBIT.position_velocity_eci(instants(DAY, [999.0, 1000.0, 1001.0]))
        np.testing.assert_allclose((after - before) / (2 * h), velocity[1], rtol=0, atol=2e-3)
        gravity = -MU_M3_S2 * now / np.linalg.norm(now) ** 3
        np.testing.assert_allclose((after - 2 * now + before) / h**2, gravity, rtol=0, atol=1e-5)

    def test_elements(self) -> None:
        at_node, high = ORBIT.position_velocity_eci(instants(DAY, [0.0, ORBIT.period_s / 4]))[0]
        assert np.arctan2(at_node[1], at_node[0]) % (2 * np.pi) == pytest.approx(ORBIT.node_rad, abs=1e-12)
        assert at_node[2] == pytest.approx(0.0, abs=1e-6)
        assert np.arcsin(high[2] / ORBIT.radius_m) == pytest.approx(np.pi - ORBIT.inclination_rad, abs=1e-9)

    def test_local_time_of_the_node(self) -> None:
        # At an instant when the mean Sun is over the node's meridian plus 45° the node has 15 h. The true Sun is within
        # 16.5 min (4.1°) of the mean one.
        for date in ("2008-03-01", "2014-09-01T05:00", "2026-11-21T23:00"):
            sun = sun_position_eci(instants(date))
            behind = (node_of_local_time(15.0, date) - np.arctan2(sun[1], sun[0]) - np.radians(45.0)) % (2 * np.pi)
            assert min(behind, 2 * np.pi - behind) < np.radians(4.6)

    @pytest.mark.parametrize(("altitude", "inclination"), [(0.0, 1.0), (-5.0, 1.0), (np.inf, 1.0), (6e5, np.nan)])
    def test_bad_elements(self, altitude: float, inclination: float) -> None:
        with pytest.raises(ValueError, match=r"Input (altitude_m|inclination_rad) must be .*; instead received"):
            CircularOrbit(altitude, inclination, 0.0, DAY)


class TestSgp4Orbit:
    def test_verification_values(self) -> None:
        # tcppver.out: minutes since the epoch, position [km], velocity [km/s]; the first block is that of satellite 5.
        text = (Path(sgp4.__file__).parent / "tcppver.out").read_text().splitlines()
        assert text[0].split()[0] == "5"
        table = np.array([[float(word) for word in line.split()[:7]] for line in text[1:14]])
        orbit = Sgp4Orbit(*VANGUARD)
        position, velocity = orbit.position_velocity_teme(instants(orbit.epoch, 60.0 * table[:, 0]))
        # Instants are rounded to a microsecond, in which the satellite moves by 7 mm.
        np.testing.assert_allclose(position, 1e3 * table[:, 1:4], rtol=0, atol=0.02)
        np.testing.assert_allclose(velocity, 1e3 * table[:, 4:7], rtol=0, atol=1e-4)

    def test_inertial_frame(self) -> None:
        orbit = Sgp4Orbit(*VANGUARD)
        position, velocity = orbit.position_velocity_eci(instants(orbit.epoch, [4320 * 60.0]))
        # Vallado et al., AIAA 2006-6753, appendix C; see test_frames.
        np.testing.assert_allclose(position[0], [-9059941.3786, 4659697.2000, 813958.8875], rtol=0, atol=3.0)
        np.testing.assert_allclose(velocity[0], [-2233.348094, -4110.136162, -3157.394074], rtol=0, atol=2e-3)

    def test_wrong_checksum(self) -> None:
        with pytest.raises(ValueError, match=r"Input line1 must be line 1 of two-line elements with a right checksum"):
            Sgp4Orbit(VANGUARD[0][:-1] + "4", VANGUARD[1])
        with pytest.raises(ValueError, match=r"Input line2 must be line 2"):
            Sgp4Orbit(VANGUARD[0], VANGUARD[0])

    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    def test_age(self, caplog: pytest.LogCaptureFixture, sign: float) -> None:
        """Silent in the first week, one warning in the first month, refused later, before the epoch as after it."""
        orbit = Sgp4Orbit(*VANGUARD)
        days = sign * DAY_S * np.array([6.9, 7.1, 29.9, 30.1])
        orbit.position_velocity_eci(instants(orbit.epoch, days[:1]))
        assert not caplog.messages
        for _ in range(2):
            orbit.position_velocity_eci(instants(orbit.epoch, days[:2]))
        (message,) = caplog.messages
        assert message.startswith("found instants 7.1 days from the epoch 2000-06-27T18:50:19 of the two-line elements")
        orbit.position_velocity_eci(instants(orbit.epoch, days[2:3]))
        with pytest.raises(ValueError, match=r"Input utc must be less than 30 days .* 30\.1 days from the epoch"):
            orbit.position_velocity_eci(instants(orbit.epoch, days))
        Sgp4Orbit(*VANGUARD, allow_old_elements=True).position_velocity_eci(instants(orbit.epoch, days))

    def test_error_grows_with_age_and_drag(self) -> None:
        """As stated: 1 km, 2 km a day, a fifth of the way that drag makes; and never beyond the orbit."""
        low = "2 99017  97.4000 210.7000 0008000  80.0000 280.0000 15.24000000 12346"
        calm, dragged = (
            Sgp4Orbit(line, low)
            for line in (
                "1 99017U 23999A   24080.50000000  .00000000  00000-0  00000-0 0  9997",
                "1 99017U 23999A   24080.50000000  .00020000  00000-0  65000-3 0  9993",
            )
        )
        days = np.array([[1.0], [7.0], [20.0], [800.0]])
        radius_m = 6.86e6
        errors = [
            [radius_m * orbit.relative_error(instants(orbit.epoch, DAY_S * day)) for day in days]
            for orbit in (calm, dragged)
        ]
        np.testing.assert_allclose(errors[0], 1e3 + 2e3 * days[:, 0], rtol=0.01)
        # The mean motion's drift of 0.0002 revolutions a day, squared days, along the orbit.
        way_m = 0.0002 * days[:, 0] ** 2 * 2.0 * np.pi * radius_m
        np.testing.assert_allclose(np.subtract(errors[1], errors[0])[:3], 0.2 * way_m[:3], rtol=0.25)
        assert errors[1][3] == pytest.approx(2.0 * radius_m, rel=0.01)

    def test_decayed(self) -> None:
        # A satellite that falls within days; from the same file of test elements.
        orbit = Sgp4Orbit(
            "1 28872U 05037B   05333.02012661  .25992681  00000-0  24476-3 0  1534",
            "2 28872  96.4736 157.9986 0303955 244.0492 110.6523 16.46015938 10708",
        )
        with pytest.raises(ValueError, match=r"Input utc must be instants that SGP4 reaches; .*decayed"):
            orbit.position_velocity_teme(instants(orbit.epoch, [0.0, 60 * 60.0]))


class TestSun:
    @pytest.mark.parametrize("date", ["2000-03-20T07:35", "2008-03-20T05:48", "2014-09-23T02:29", "2020-03-20T03:50"])
    def test_is_in_the_equator_at_published_equinoxes(self, date: str) -> None:
        # To the minute, in which the declination changes by 1″. The aberration alone is 8″ of declination.
        x, y, z = R_ecef_from_eci(instants(date)) @ sun_position_eci(instants(date))
        assert abs(np.degrees(np.arctan2(z, np.hypot(x, y)))) * 3600.0 < 0.6

    def test_against_the_almanac(self) -> None:
        # The Astronomical Almanac, page C5: 0.01° between 1950 and 2050, mean equator of date.
        utc = instants(np.arange("1995-01-03T07:00", "2030-01-01", 1000, dtype="datetime64[h]"))
        day, fraction = julian_dates(utc)
        n = (day - 2_451_545.0) + fraction
        g = np.radians(357.528 + 0.9856003 * n)
        ecliptic = np.radians(280.460 + 0.9856474 * n + 1.915 * np.sin(g) + 0.020 * np.sin(2 * g))
        oblique = np.radians(23.439 - 4e-7 * n)
        distance = 1.00014 - 0.01671 * np.cos(g) - 0.00014 * np.cos(2 * g)
        almanac = np.stack(
            [np.cos(ecliptic), np.cos(oblique) * np.sin(ecliptic), np.sin(oblique) * np.sin(ecliptic)], axis=-1
        )
        sun = sun_position_eci(utc)
        of_date = turned(rotation_about_z(-erfa.gmst82(day, fraction)) @ R_ecef_from_eci(utc), sun)
        size = np.linalg.norm(of_date, axis=-1)
        away = np.linalg.norm(np.cross(of_date / size[:, None], almanac), axis=-1)
        assert np.degrees(away).max() < 0.013  # with 17″ of nutation, which the almanac's formula leaves out
        np.testing.assert_allclose(size / ASTRONOMICAL_UNIT_M, distance, rtol=0, atol=3e-4)


def seen_by_rays(position: Array, sun: Array, n: int = 400) -> float:
    """Part of a grid of points on the Sun's disc from which a straight line to the position misses the Earth."""
    axis = (sun - position) / np.linalg.norm(sun - position)
    x = np.cross(axis, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    grid = np.linspace(-1.0, 1.0, n)
    u, v = (one.ravel() for one in np.meshgrid(grid, grid))
    inside = u * u + v * v < 1.0
    points = sun + SUN_RADIUS_M * (u[inside, None] * x + v[inside, None] * np.cross(axis, x))
    along = (points - position) / np.linalg.norm(points - position, axis=-1, keepdims=True)
    nearest = -(along @ position)
    missed = np.linalg.norm(position + nearest[:, None] * along, axis=-1) > EARTH_RADIUS_M
    return float(np.mean(missed | (nearest < 0.0)))


class TestEclipse:
    SUN = np.array([ASTRONOMICAL_UNIT_M, 0.0, 0.0])

    def at(self, degrees_from_the_sun: float, radius_m: float = 6_978_137.0) -> Array:
        angle = np.radians(degrees_from_the_sun)
        return radius_m * np.array([np.cos(angle), np.sin(angle), 0.0])

    def test_against_rays(self) -> None:
        # The Earth's limb passes the Sun's disc, 0.53°, at 180° - asin(R/r) = 113.9°.
        edge = 180.0 - np.degrees(np.arcsin(EARTH_RADIUS_M / 6_978_137.0))
        for degrees in (0.0, 90.0, *(edge + np.array([-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3])), 150.0, 180.0):
            position = self.at(degrees)
            # The grid resolves 1/400 of the disc; the Earth's limb is taken as a circle on a plane sky.
            assert float(illuminated_fraction(position, self.SUN)) == pytest.approx(
                seen_by_rays(position, self.SUN), abs=5e-3
            )

    def test_far_behind_the_earth_a_ring_is_left(self) -> None:
        position = self.at(180.0, 3e9)
        assert float(illuminated_fraction(position, self.SUN)) == pytest.approx(
            seen_by_rays(position, self.SUN, 1000), abs=5e-3
        )

    def test_falls_all_the_way(self) -> None:
        fraction = illuminated_fraction(np.stack([self.at(d) for d in np.linspace(113.0, 115.0, 500)]), self.SUN)
        assert (np.diff(fraction) <= 0.0).all()
        assert (fraction[0], fraction[-1]) == (1.0, 0.0)

    def test_longest_night_of_a_plane_through_the_sun(self) -> None:
        # Closed form, Sun at infinity: the part 2 asin(R/r)/2π of the orbit; the Sun's centre sets and rises.
        orbit = CircularOrbit(600e3, 0.0, 0.0, DAY)
        angle = orbit.rate_rad_s * np.arange(0.0, orbit.period_s, 0.25)
        position = orbit.radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        dark_s = 0.25 * np.sum(illuminated_fraction(position, self.SUN) < 0.5)
        night_s = 2 * np.arcsin(EARTH_RADIUS_M / orbit.radius_m) / orbit.rate_rad_s
        assert dark_s == pytest.approx(night_s, abs=1.0)

    def test_night_of_the_spec(self) -> None:
        # 1829 s, by an independent prototype for 2014-09-01 with the node at about 15 h.
        lit = environment(ORBIT, DAY, np.arange(0.0, 12_000.0)).sunlit
        sunset, sunrise = (
            np.flatnonzero(np.diff(lit.astype(int)) < 0)[0],
            np.flatnonzero(np.diff(lit.astype(int)) > 0)[0],
        )
        assert (sunrise - sunset) % ORBIT.period_s == pytest.approx(1829.0, abs=10.0)


class TestField:
    def test_official_values(self, data_folder: Path) -> None:
        rows = np.genfromtxt(data_folder / "geomag" / "IGRF14_BGS_test_values.csv", delimiter=",", skip_header=2)
        for year, colatitude, longitude, radius_km, north, east, down in rows:
            if year != int(year):
                continue
            theta, phi = np.radians(colatitude), np.radians(longitude)
            place = (
                1e3 * radius_km * np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
            )
            around = environment(Resting(tuple(place)), f"{int(year)}-01-01", [0.0])
            np.testing.assert_allclose(around.b_orbital_T[0] / NT, [east, north, -down], rtol=0, atol=0.06)

    def test_modulus_is_that_of_the_geodetic_position(self) -> None:
        around = environment(ORBIT, DAY, np.arange(0.0, 6000.0, 100.0))
        place = ecef2geodetic(*np.moveaxis(turned(R_ecef_from_eci(around.utc), around.position_eci_m), -1, 0))
        modulus = np.linalg.norm(field_ned(*place, around.utc), axis=-1)
        np.testing.assert_allclose(np.linalg.norm(around.b_orbital_T, axis=-1), modulus, rtol=0, atol=0.05 * NT)

    def test_spline(self) -> None:
        around = environment(ORBIT, DAY, np.arange(0.0, 6000.0, 7.0))
        direct = turned(around.R_orbital_from_eci, field_eci(around.position_eci_m, around.utc))
        np.testing.assert_allclose(around.b_orbital_T, direct, rtol=0, atol=0.05 * NT)
        to_sun = sun_position_eci(around.utc) - around.position_eci_m
        to_sun /= np.linalg.norm(to_sun, axis=-1, keepdims=True)
        np.testing.assert_allclose(around.sun_orbital, turned(around.R_orbital_from_eci, to_sun), rtol=0, atol=1e-7)

    @pytest.mark.parametrize("date", ["1899-12-31", "2031-01-01"])
    def test_dates_outside_of_the_model(self, date: str) -> None:
        with pytest.raises(ValueError, match=r"Input date must lie within the validity of IGRF-14, 1900\.0 to 2030\.0"):
            environment(ORBIT, date, [0.0, 1.0])

    def test_a_run_may_end_with_the_model(self) -> None:
        assert environment(ORBIT, "2029-12-31T23:58:00", np.arange(121.0)).utc[-1] == np.datetime64("2030-01-01")


class TestEnvironment:
    def test_axes(self) -> None:
        around = environment(ORBIT, DAY, np.arange(10.0))
        self.check(around, ())
        np.testing.assert_allclose(around.orbital_rate_rad_s, ORBIT.rate_rad_s, rtol=1e-12)
        np.testing.assert_allclose(around.gravity_s2, ORBIT.rate_rad_s**2, rtol=1e-12)

    def test_runs_are_those_of_each_start(self) -> None:
        starts = DAY + np.array([0, 5000, 70_000]).astype("timedelta64[s]")
        together = environment(ORBIT, starts, np.arange(100.0))
        self.check(together, (3,), 100)
        alone = environment(ORBIT, starts[2], np.arange(100.0))
        for name in ("b_orbital_T", "sun_orbital", "illuminated", "position_eci_m", "gravity_s2", "separation_rad"):
            np.testing.assert_allclose(getattr(together, name)[2], getattr(alone, name), rtol=1e-12, atol=0)

    @staticmethod
    def check(around: Environment, lead: tuple[int, ...], n: int = 10) -> None:
        for name in ("b_orbital_T", "sun_orbital", "position_eci_m", "velocity_eci_m_s"):
            assert getattr(around, name).shape == (*lead, n, 3)
        for name in ("utc", "illuminated", "sunlit", "orbital_rate_rad_s", "gravity_s2", "separation_rad"):
            assert getattr(around, name).shape == (*lead, n)
        np.testing.assert_allclose(np.linalg.norm(around.sun_orbital, axis=-1), 1.0, rtol=1e-12)

    @given(st.floats(0.0, 86_000.0))
    def test_separation_is_between_lines(self, start_s: float) -> None:
        around = environment(ORBIT, instants(DAY, start_s), [0.0])
        b = around.b_orbital_T[0] / np.linalg.norm(around.b_orbital_T[0])
        angle = np.arccos(abs(float(b @ around.sun_orbital[0])))
        assert around.separation_rad[0] == pytest.approx(angle, abs=1e-7)

    @pytest.mark.parametrize("time_s", [[], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan], [[0.0, 1.0]]])
    def test_bad_times(self, time_s: list[float]) -> None:
        with pytest.raises(ValueError, match=r"Input time_s must be finite numbers that ascend; instead received"):
            environment(ORBIT, DAY, time_s)
