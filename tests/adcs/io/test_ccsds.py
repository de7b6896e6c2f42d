"""Orbit and attitude messages: what is written is read, the standard's own sample, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import adcs
from adcs.environment.ephemeris import EphemerisOrbit
from adcs.frames import R_eci_from_teme, instants
from adcs.io.ccsds import read_aem, read_oem, write_aem, write_oem
from arrays.io.errors import InputError

ORBIT = adcs.circular_orbit(altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21")
UTC = instants("2026-11-21", np.arange(0.0, 6000.0, 60.0))
# A quarter turn about z takes the axes of A to those of B: components of A's x axis are -y of B.
QUARTER = """CCSDS_AEM_VERS = 1.0
CREATION_DATE = 2026-11-21T00:00:00
ORIGINATOR = TEST
META_START
OBJECT_NAME = SAT
OBJECT_ID = 2026-001A
REF_FRAME_A = {a}
REF_FRAME_B = {b}
ATTITUDE_DIR = {direction}
TIME_SYSTEM = UTC
START_TIME = 2026-11-21T00:00:00
STOP_TIME = 2026-11-21T00:00:01
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = {order}
META_STOP
COMMENT a line of words
DATA_START
2026-11-21T00:00:00.000 {values}
DATA_STOP
"""


class TestOrbit:
    def test_written_is_read_and_interpolated(self, tmp_path) -> None:
        write_oem(tmp_path / "o.oem", UTC, *ORBIT.position_velocity_eci(UTC))
        between = UTC[:-1] + np.timedelta64(30, "s")
        position, velocity = read_oem(tmp_path / "o.oem").position_velocity_eci(between)
        true_position, true_velocity = ORBIT.position_velocity_eci(between)
        assert np.linalg.norm(position - true_position, axis=-1).max() < 0.5
        assert np.linalg.norm(velocity - true_velocity, axis=-1).max() < 0.05

    def test_teme_is_turned(self, tmp_path) -> None:
        position, velocity = ORBIT.position_velocity_eci(UTC)
        to_teme = R_eci_from_teme(UTC).mT
        states = [np.einsum("nij,nj->ni", to_teme, one) for one in (position, velocity)]
        write_oem(tmp_path / "o.oem", UTC, *states)
        text = (tmp_path / "o.oem").read_text().replace("EME2000", "TEME")
        (tmp_path / "o.oem").write_text(text)
        np.testing.assert_allclose(read_oem(tmp_path / "o.oem").position_m, position, atol=1e-3)

    def test_segments_follow_and_covariances_are_left(self, tmp_path) -> None:
        for name, rows in (("a", slice(0, 60)), ("b", slice(50, 100))):
            write_oem(tmp_path / name, UTC[rows], *(one[rows] for one in ORBIT.position_velocity_eci(UTC)))
        first, second = ((tmp_path / name).read_text() for name in "ab")
        covariance = "COVARIANCE_START\nEPOCH = 2026-11-21T00:00:00\n1.0\n0.5 1.0\nCOVARIANCE_STOP\n"
        (tmp_path / "both.oem").write_text(first + covariance + second[second.index("META_START") :])
        np.testing.assert_array_equal(read_oem(tmp_path / "both.oem").utc, UTC)

    def test_beyond_its_instants_is_refused(self) -> None:
        orbit = EphemerisOrbit(UTC, *ORBIT.position_velocity_eci(UTC))
        with pytest.raises(ValueError, match="must be within the ephemeris"):
            orbit.position_velocity_eci(UTC[-1:] + np.timedelta64(1, "s"))


class TestAttitude:
    def test_written_is_read(self, tmp_path) -> None:
        q = Rotation.random(100, random_state=0).as_quat()
        write_aem(tmp_path / "a.aem", UTC, q)
        utc, read = read_aem(tmp_path / "a.aem")
        np.testing.assert_array_equal(utc, UTC)
        np.testing.assert_allclose(read, q, atol=1e-12)

    @pytest.mark.parametrize(
        ("a", "b", "direction", "order", "values"),
        [
            ("EME2000", "SC_BODY_1", "A2B", "LAST", "0 0 0.70710678 0.70710678"),
            ("EME2000", "SC_BODY_1", "A2B", "FIRST", "0.70710678 0 0 0.70710678"),
            ("EME2000", "SC_BODY_1", "B2A", "LAST", "0 0 -0.70710678 0.70710678"),
            ("SC_BODY_1", "EME2000", "B2A", "LAST", "0 0 0.70710678 0.70710678"),
            ("SC_BODY_1", "ICRF", "A2B", "LAST", "0 0 -0.70710678 0.70710678"),
        ],
    )
    def test_directions_and_orders(self, tmp_path, a: str, b: str, direction: str, order: str, values: str) -> None:
        """The standard's matrix of A2B takes components from A to B, so that body x is inertial y here."""
        path = tmp_path / "a.aem"
        path.write_text(QUARTER.format(a=a, b=b, direction=direction, order=order, values=values))
        np.testing.assert_allclose(
            Rotation.from_quat(read_aem(path)[1][0]).apply([1.0, 0.0, 0.0]), [0, 1, 0], atol=1e-7
        )


class TestCommand:
    @pytest.mark.slow
    def test_estimate_of_a_message_along_an_ephemeris(self, adcs, tmp_path) -> None:
        assert adcs("run", "tabletsat", "--seeds", "1", "--duration", "60", "--out", tmp_path, "--quiet").status == 0
        config, out = tmp_path / "scenario.toml", tmp_path / "first"
        first = adcs("estimate", tmp_path / "telemetry.csv", "--config", config, "--out", out, "--quiet")
        assert first.status == 0, first.err
        text = config.read_text()
        kept = [
            line for line in text.splitlines() if not line.startswith(("altitude_", "inclination_", "local_", "latit"))
        ]
        (out / "along.toml").write_text("\n".join(kept).replace("[orbit]", '[orbit]\nephemeris = "orbit.oem"'))
        again = adcs("estimate", out / "attitude.aem", "--config", out / "along.toml", "--sensors", "st", "--quiet")
        assert again.status == 0, again.err
        assert "61 rows" in again.out

    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            ("CCSDS_AEM", "CCSDS_XYZ", "line 1"),
            ("= UTC", "= TAI", "TIME_SYSTEM: found TAI"),
            ("= QUATERNION\n", "= EULER_ANGLE\n", "ATTITUDE_TYPE: found EULER_ANGLE"),
            ("EME2000", "ITRF-97", "REF_FRAME_B"),
            ("0.7 0.7", "0.7", "line 18"),
            ("0.7 0.7", "0.7 nan", "line 18"),
            ("2026-11-21T00:00:00.000 0", "midnight 0", "line 18"),
        ],
    )
    def test_what_is_no_message(self, tmp_path, old: str, new: str, said: str) -> None:
        good = QUARTER.format(a="EME2000", b="SC_BODY_1", direction="A2B", order="LAST", values="0 0 0.7 0.7")
        assert old in good
        (tmp_path / "a.aem").write_text(good.replace(old, new))
        with pytest.raises(InputError, match=said):
            read_aem(tmp_path / "a.aem")
