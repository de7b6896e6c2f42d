"""A body that is followed live: the poses of a track, its magnets, and a rest."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from magloc.bodies.field import placed_magnets
from magloc.bodies.filter import track_body
from magloc.live.body import BodyPoint, body_points
from magloc.live.follower import Follower, LivePoint
from magloc.readings import Readings
from tests.magloc.bodies.devices import hall_ring, knob
from tests.magloc.bodies.test_filter import RATE_HZ, record

BODY, ARRAY = knob(), hall_ring(4, common_field_T=None)


def body_of(point: LivePoint) -> BodyPoint:
    assert isinstance(point.sources, BodyPoint)
    return point.sources


def test_points_are_those_of_a_track() -> None:
    readings, *_ = record(ARRAY, BODY, 40, 60_50)
    track = track_body(ARRAY, BODY, readings)
    points = [body_of(point) for point in Follower(ARRAY, body=BODY).follow(readings)]
    assert [point.status for point in points] == track.status == ["tracked"] * 40
    np.testing.assert_allclose([p.poses.position_m[0] for p in points], track.position_m, atol=1e-12)
    np.testing.assert_allclose([p.poses.covariance[0] for p in points], track.covariance, rtol=1e-6)


def test_magnets_have_the_covariance_of_the_pose() -> None:
    """Oracle: central differences of the magnets by the pose."""
    readings, *_ = record(ARRAY, BODY, 3, 60_51)
    track = track_body(ARRAY, BODY, readings)
    point = body_points(BODY, track)[-1]
    x, R, step = track.position_m[-1, 0], track.R[-1, 0], 1e-6

    def magnets(change: np.ndarray) -> np.ndarray:
        places, moments = placed_magnets(BODY, x + change[:3], R @ Rotation.from_rotvec(change[3:]).as_matrix())
        return np.concatenate([places, moments], axis=1)

    by_pose = np.stack([(magnets(c) - magnets(-c)) / (2.0 * step) for c in step * np.eye(6)], axis=-1)
    for magnet, J in zip(point.tracks, by_pose, strict=True):
        expected = J @ track.covariance[-1, 0] @ J.T
        np.testing.assert_allclose(magnet.covariance, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_a_rest_takes_offsets_away() -> None:
    """Offsets of 1 mT, as large as the field, would end every track; 6 sigma of 6 numbers in 60 rows: 1e-6."""
    readings, position_m, _ = record(ARRAY, BODY, 60, 60_52)
    rng = np.random.default_rng(60_53)
    ambient = ARRAY.readings_of(np.broadcast_to([2e-5, 0.0, 4e-5], (ARRAY.n_sensors, 3)))
    offset = 1e-3 * rng.normal(size=ARRAY.n_channels)
    rest = ambient + ARRAY.channel_noise_T * rng.normal(size=(40, ARRAY.n_channels))
    values = offset + np.concatenate([rest, readings.values_T])
    rows = Readings(values, time_s=np.arange(100) / RATE_HZ)
    points = [body_of(point) for point in Follower(ARRAY, body=BODY, rest_s=40 / RATE_HZ - 1e-6).follow(rows)]
    assert all(point.status.startswith("rest") and not point.tracks for point in points[:40])
    assert {point.status for point in points[40:]} == {"tracked"}
    error = np.array([point.poses.position_m[0, 0] for point in points[40:]]) - position_m
    sigma = np.sqrt([np.diagonal(point.poses.covariance[0, 0])[:3] for point in points[40:]])
    assert (np.abs(error) < 6.0 * sigma).all()
    assert not any(body_of(point).tracks for point in Follower(ARRAY, body=BODY).follow(rows[40:]))


def test_stop_and_start() -> None:
    readings, *_ = record(ARRAY, BODY, 30, 60_54)
    follower = Follower(ARRAY, body=BODY)
    assert next(follower.follow(readings[:1])).tally.tracked == 1
    follower.stop()
    assert {body_of(point).status for point in follower.follow(readings[1:10])} == {"stopped"}
    follower.start()
    assert {body_of(point).status for point in follower.follow(readings[10:])} == {"tracked"}


def test_refuses_the_motion_of_a_source() -> None:
    with pytest.raises(ValueError, match="must be a BodyMotion"):
        Follower(ARRAY, magloc.RandomWalk(1.0, 1.0), body=BODY)
