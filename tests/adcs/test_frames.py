"""Tests of adcs.frames. The oracles: Vallado's published transformations, erfa, pymap3d, and closed forms."""

from __future__ import annotations

import datetime

import erfa
import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adcs.frames import (
    R_ecef_from_eci,
    R_eci_from_teme,
    R_orbital_from_eci,
    instants,
    julian_dates,
    orbital_rate,
    rotation_about_z,
    terrestrial_dates,
    turned,
)
from magloc.fields.geomagnetic import ecef_from_geodetic

UTC = instants(["2000-01-01T12:00:00", "2008-03-01T00:00:00", "2014-09-01T17:03:21.5", "2027-06-30T23:59:59"])


class TestInstants:
    def test_one_form_for_all_dates(self) -> None:
        there = datetime.timezone(datetime.timedelta(hours=2))
        expected = np.datetime64("2014-09-01T10:00:00", "us")
        for date in (
            "2014-09-01T10:00",
            datetime.datetime(2014, 9, 1, 10),
            datetime.datetime(2014, 9, 1, 12, tzinfo=there),
            np.datetime64("2014-09-01T10"),
        ):
            assert instants(date) == expected

    def test_seconds_make_an_axis(self) -> None:
        assert instants(UTC, [0.0, 0.25]).shape == (4, 2)
        assert instants("2014-09-01", 0.25).shape == ()
        assert (instants(UTC, [0.0, 0.25])[:, 1] - UTC == np.timedelta64(250, "ms")).all()

    @pytest.mark.parametrize("date", ["yesterday", np.datetime64("NaT"), object()])
    def test_no_date(self, date: object) -> None:
        with pytest.raises(ValueError, match=r"Input date must .*; instead received"):
            instants(date)  # type: ignore[arg-type]

    def test_no_time(self) -> None:
        with pytest.raises(ValueError, match=r"Input time_s must be finite; instead received a value that is not\."):
            instants("2014-09-01", [0.0, np.nan])


class TestJulianDates:
    def test_against_erfa(self) -> None:
        for utc in UTC:
            date = utc.astype(datetime.datetime)
            seconds = date.second + 1e-6 * date.microsecond
            day, fraction = erfa.dtf2d("UTC", date.year, date.month, date.day, date.hour, date.minute, seconds)
            ours = julian_dates(utc)
            assert (ours[0] - day) + (ours[1] - fraction) == pytest.approx(0.0, abs=1e-15)

    def test_terrestrial_time_is_ahead(self) -> None:
        # 32 leap seconds until 2000, 33 in 2008, 35 in 2014, 37 from 2017 on; and 32.184 s.
        utc, tt = julian_dates(UTC), terrestrial_dates(UTC)
        ahead_s = 86_400.0 * ((tt[0] - utc[0]) + (tt[1] - utc[1]))
        np.testing.assert_allclose(ahead_s, [64.184, 65.184, 67.184, 69.184], rtol=0, atol=1e-6)


class TestEarthRotation:
    def test_published_transformation_of_a_teme_position(self) -> None:
        # Vallado et al., Revisiting Spacetrack Report #3, AIAA 2006-6753, appendix C: UT1 = UTC - 0.439961 s, and the
        # position before polar motion.
        ut1 = instants("2004-04-06T07:51:28.386009") - np.timedelta64(439_961, "us")
        teme_m = np.array([5094180.16210, 6127644.65950, 6380344.53270])
        ecef_m = R_ecef_from_eci(ut1) @ R_eci_from_teme(ut1) @ teme_m
        np.testing.assert_allclose(ecef_m, [-1033475.03130, 7901305.58560, 6380344.53270], rtol=0, atol=0.02)

    def test_published_inertial_position(self) -> None:
        # The same report: satellite 5 three days after its epoch, in TEME and J2000 (FK5, 1980 nutation: 0.05″ or 2 m).
        utc = instants("2000-06-30T18:50:19.733571")
        R = R_eci_from_teme(utc)
        position_m = R @ np.array([-9060473.73569, 4658709.52502, 813686.73153])
        velocity_m_s = R @ np.array([-2232.832783, -4110.453490, -3157.345433])
        np.testing.assert_allclose(position_m, [-9059941.3786, 4659697.2000, 813958.8875], rtol=0, atol=3.0)
        np.testing.assert_allclose(velocity_m_s, [-2233.348094, -4110.136162, -3157.394074], rtol=0, atol=2e-3)

    def test_against_the_larger_model_of_erfa(self) -> None:
        # IAU 2006/2000A; 2000B is good to 1 mas, 5e-9 rad.
        A = erfa.c2t06a(*terrestrial_dates(UTC), *julian_dates(UTC), 0.0, 0.0)
        np.testing.assert_allclose(R_ecef_from_eci(UTC), A, rtol=0, atol=2e-8)

    def test_against_pymap3d_at_j2000(self) -> None:
        # pymap3d knows no precession and no nutation: none of the first at J2000, 17″ of the second.
        x = pymap3d.eci2ecef(7e6, 1e6, 2e6, datetime.datetime(2000, 1, 1, 12), force_non_astropy=True)
        ours = R_ecef_from_eci(UTC[0]) @ np.array([7e6, 1e6, 2e6])
        assert np.linalg.norm(ours - np.array(x)) < 1e-4 * 7e6

    def test_rotations(self) -> None:
        for R in (R_ecef_from_eci(UTC), R_eci_from_teme(UTC)):
            np.testing.assert_allclose(R @ R.mT, np.broadcast_to(np.eye(3), R.shape), rtol=0, atol=1e-14)
            np.testing.assert_allclose(np.linalg.det(R), 1.0, rtol=0, atol=1e-14)

    def test_one_turn_in_a_sidereal_day(self) -> None:
        # The true pole moves by up to 0.2″ a day.
        one = R_ecef_from_eci(instants("2014-09-01", [0.0, 86_164.0905]))
        np.testing.assert_allclose(one[0], one[1], rtol=0, atol=2e-6)


class TestOrbitalFrame:
    @given(st.integers(0, 2**32 - 1))
    def test_axes(self, seed: int) -> None:
        r, v = np.random.default_rng(seed).standard_normal((2, 3))
        R = R_orbital_from_eci(r, v)
        np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-12)
        np.testing.assert_allclose(R @ r, [0.0, 0.0, np.linalg.norm(r)], rtol=0, atol=1e-12)
        along, across, _ = R @ v
        assert along > 0.0
        assert across == pytest.approx(0.0, abs=1e-12)

    def test_turns_about_e2_at_the_orbital_rate(self) -> None:
        n, r = 1.1e-3, 7e6
        angle = n * np.array([-1.0, 0.0, 1.0])
        position = r * np.stack([np.cos(angle), np.zeros(3), np.sin(angle)], axis=-1)
        velocity = n * r * np.stack([-np.sin(angle), np.zeros(3), np.cos(angle)], axis=-1)
        before, now, after = R_orbital_from_eci(position, velocity)
        w_cross = -(after - before) / 2.0 @ now.T
        np.testing.assert_allclose([w_cross[2, 1], w_cross[0, 2], w_cross[1, 0]], [0.0, n, 0.0], rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(orbital_rate(position, velocity), n, rtol=1e-14)


class TestSmallOnes:
    def test_rotation_about_z_gives_components_in_turned_axes(self) -> None:
        np.testing.assert_allclose(rotation_about_z(np.pi / 2) @ [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], atol=1e-15)
        assert rotation_about_z(np.zeros((2, 3))).shape == (2, 3, 3, 3)

    def test_turned(self) -> None:
        R = rotation_about_z([0.1, 0.2])
        v = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
        np.testing.assert_array_equal(turned(R, v)[1], R[1] @ v[1])

    def test_geodetic_positions_and_back(self) -> None:
        latitude, longitude, height = (
            np.array([-80.0, 0.0, 48.1]),
            np.array([10.0, -170.0, 11.6]),
            np.array([0, 6e5, 520]),
        )
        back = pymap3d.ecef2geodetic(*ecef_from_geodetic(latitude, longitude, height).T)
        for one, expected in zip(back, (latitude, longitude, height), strict=True):
            np.testing.assert_allclose(one, expected, rtol=0, atol=1e-6)
