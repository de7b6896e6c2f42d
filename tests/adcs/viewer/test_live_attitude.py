"""The live page of an inertial unit: what it shows of an estimate, and that it follows the newest one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import adcs
from adcs import quaternion
from adcs.complementary.attitude_filter import FLAGS, AttitudeEstimate
from adcs.viewer.live_attitude import LiveAttitudeView, attitude_lines, body_sigma_rad, disturbance_lines
from magloc.live.tally import Tally
from tests.waiting import wait_for


def estimate(rotation: Rotation, *flags: str, time_s: float = 1.0) -> AttitudeEstimate:
    bits = sum(1 << FLAGS.index(flag) for flag in flags)
    q, offset_T = quaternion.from_rotation(rotation), np.array([3e-6, 0.0, 4e-6])
    return AttitudeEstimate(time_s, q, 0.01, 0.05, np.zeros(3), np.zeros(3), offset_T, bits)


def test_the_direction_of_the_body() -> None:
    """A body whose axis x points south-east and 30° up."""
    x = Rotation.from_euler("ZY", [-45.0, -30.0], degrees=True)
    assert attitude_lines(estimate(x))[1] == "axis x: <b>135.0°</b> from north, 30.0° up"


def test_sigma_about_body_axes() -> None:
    """Those of the covariance in east, north and up, in body axes."""
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1])
    R = turn.as_matrix()
    covariance = R.T @ np.diag([0.01**2, 0.01**2, 0.05**2]) @ R
    np.testing.assert_allclose(body_sigma_rad(estimate(turn)), np.sqrt(np.diagonal(covariance)), rtol=1e-12)


@pytest.mark.parametrize(
    ("flags", "lines"),
    [
        ((), ["none"]),
        (("field-left-out",), ["the field is ignored"]),
        (("magnet-subtracted", "heading-doubtful"), ["a magnet of 5 µT is subtracted", "heading-doubtful"]),
    ],
)
def test_disturbances(flags: tuple[str, ...], lines: list[str]) -> None:
    assert disturbance_lines(estimate(Rotation.identity(), *flags)) == lines


def test_the_page_follows() -> None:
    """The newest estimate is drawn, also after the clock was set back, and closing ends the thread."""
    imu, board, tally = adcs.datasets.load("imu"), adcs.AttitudeFilter(), Tally()
    rows = zip(imu.time_s, imu.gyro_rad_s, imu.acceleration_m_s2, imu.field_T, strict=True)
    found = [board.update(*row) for _, row in zip(range(300), rows, strict=False)]
    with LiveAttitudeView(port=0, open=False) as view:
        for one in found:
            view.update(one, tally)
        page = view._live
        wait_for(lambda: f"time {found[-1].time_s:.3f} s" in page._panels["Attitude"].content)
        body = page._scene._body.wxyz
        np.testing.assert_allclose(np.abs(np.dot(body, found[-1].q)), 1.0, atol=1e-9)
        view.update(estimate(Rotation.identity(), "field-left-out", time_s=-math.pi), tally)
        wait_for(lambda: "ignored" in page._panels["Disturbance"].content)
        assert len(page._window) == 1
    assert not page._thread.is_alive()
