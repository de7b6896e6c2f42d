"""The viewer's tracks of a body's magnets are where rotations by scipy put them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from magloc.bodies.poses import BodyPoses
from magloc.viewer.scene.magnet_tracks import magnet_tracks
from sims import joystick


def test_magnets_move_and_turn_with_the_body() -> None:
    rng = np.random.default_rng(7)
    knob = joystick.nominal_knob()
    position, rotation = joystick.random_poses(rng, 20)
    array = joystick.nominal_array()
    device = joystick.draw_joystick(rng)
    readings = device.read(position, rotation, rng)
    found = magloc.locate_body(array, knob, readings)
    result = magnet_tracks(knob, found)
    assert result.ids == (1, 2, 3)
    rows = np.flatnonzero(found.solved)
    for magnet, track in zip(knob.magnets, result.tracks, strict=True):
        for row, point in zip(rows, track, strict=True):
            turn = Rotation.from_matrix(found.R[row, 0])
            np.testing.assert_allclose(point.position_m, found.position_m[row, 0] + turn.apply(magnet.position_m))
            np.testing.assert_allclose(point.moment_Am2, turn.apply(magnet.moment_Am2))
            assert point.time_s == readings.time_s[row]


def test_rows_without_any_pose_are_refused() -> None:
    with pytest.raises(ValueError, match="must have a row with a pose"):
        magnet_tracks(joystick.nominal_knob(), BodyPoses.none(3, 1, ""))


def test_a_page_of_readings_shows_the_magnets(tmp_path) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(8)
    device = joystick.draw_joystick(rng)
    readings = device.read(*joystick.random_poses(rng, 8), rng)
    page = tmp_path / "joystick.html"
    magloc.view(device.true_array, readings, body=device.true_knob, html=page)
    text = page.read_text(encoding="utf-8")
    assert "magnet 3" in text
    with pytest.raises(ValueError, match="readings or poses where a body is given"):
        magloc.view(device.true_array, None, body=device.true_knob, html=page)
