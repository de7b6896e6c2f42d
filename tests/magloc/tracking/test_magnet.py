"""Tracks of a magnet of known shape near the sensors, whose field is magpylib's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from magloc.fields.shapes import Shape
from magloc.readings import Readings
from tests.magloc.localization.test_magnet_fit import SHAPES, board, nees_per_dimension, simulate

SPEED_M_S, TURN_rad_s, DT_S = 0.05, 1.0, 0.01


@pytest.mark.parametrize("shape", SHAPES[:3], ids=lambda shape: f"{shape.kind}-{shape.size_m}")
@pytest.mark.parametrize("smooth", [False, True])
def test_nees_at_a_gap_of_half_a_length(shape: Shape, smooth: bool) -> None:
    """States drawn from the motion: 0.8 to 1.3, where neighbouring rows are nearly independent (200 rows)."""
    array, rng = board(), np.random.default_rng(41)
    place = array.centroid + np.array([0.0, 0.0, 1.1 * shape.length_m])
    turn = Rotation.from_euler("xy", [0.4, 0.7])
    states = []
    for _ in range(200):
        states.append((place, turn))
        place = place + SPEED_M_S * DT_S * rng.normal(size=3)
        place[2] = max(place[2], array.centroid[2] + shape.length_m)
        turn = Rotation.from_rotvec(TURN_rad_s * DT_S * rng.normal(size=3)) * turn
    truth, values = simulate(array, shape, states, 42)
    motion = magloc.RandomWalk(SPEED_M_S, TURN_rad_s)
    track = magloc.track(
        array, Readings(values, time_s=DT_S * np.arange(200)), motion=motion, magnet=shape, smooth=smooth
    )
    assert track.tracked.all()
    assert track.innovations.body_factor == 1.0
    off = np.concatenate([track.position_m, track.moment_Am2], axis=1) - truth
    assert 0.8 < nees_per_dimension(off, track.covariance[:, :6, :6]).mean() < 1.3
    assert np.linalg.norm(off[:, :3].mean(axis=0)) < 0.02e-3


def test_a_dipole_does_not_start_there() -> None:
    array, shape = board(), SHAPES[1]
    states = [(array.centroid + np.array([0.0, 0.0, shape.length_m]), Rotation.from_euler("x", 0.4))] * 5
    _, values = simulate(array, shape, states, 43)
    assert not magloc.track(array, values).tracked.any()


def test_a_cuboid_is_refused() -> None:
    with pytest.raises(ValueError, match=r"a ring or a sphere in a track.* size_m \[0\.01128, 0\.01\]"):
        magloc.Tracker(board(), magloc.RandomWalk(1.0, 1.0), magnet=Shape("cuboid", (0.01, 0.01, 0.01)))
