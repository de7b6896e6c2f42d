"""Mountings as autopilots number them; the oracle is MAVLink's MAV_SENSOR_ROTATION, in degrees."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adcs.log_calibration.rotations import nearest_rotation
from adcs.log_calibration.start import mountings

KNOWN = {
    (0, 0, 0): (0, "ROTATION_NONE"),
    (0, 0, 90): (2, "ROTATION_YAW_90"),
    (0, 0, 315): (7, "ROTATION_YAW_315"),
    (180, 0, 0): (8, "ROTATION_ROLL_180"),
    (0, 180, 0): (12, "ROTATION_PITCH_180"),
    (180, 0, 270): (14, "ROTATION_ROLL_180_YAW_270"),
    (90, 0, 0): (16, "ROTATION_ROLL_90"),
    (270, 0, 135): (23, "ROTATION_ROLL_270_YAW_135"),
    (0, 90, 0): (24, "ROTATION_PITCH_90"),
    (90, 90, 0): (28, "ROTATION_ROLL_90_PITCH_90"),
}


@pytest.mark.parametrize(("angles", "named"), KNOWN.items())
def test_number_and_name(angles, named):
    assert nearest_rotation(Rotation.from_euler("xyz", angles, degrees=True).as_matrix()) == named


def test_each_right_angle_has_a_number():
    """The 24 rotations of a cube: permutations of the axes with signs, determinant 1."""
    for axes, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[np.arange(3), axes] = signs
        if np.linalg.det(matrix) > 0.0:
            number, name = nearest_rotation(matrix)
            angles = dict(zip(name.split("_")[1::2], map(int, name.split("_")[2::2]), strict=False))
            euler = [angles.get(axis, 0) for axis in ("ROLL", "PITCH", "YAW")]
            np.testing.assert_allclose(Rotation.from_euler("xyz", euler, degrees=True).as_matrix(), matrix, atol=1e-12)
            assert 0 <= number < 38


def test_mountings_are_distinct_rotations():
    found = mountings()
    assert len(found) == 48
    np.testing.assert_allclose(found @ found.transpose(0, 2, 1), np.broadcast_to(np.eye(3), found.shape), atol=1e-12)
    overlap = np.einsum("aij,bij->ab", found, found) - 3.0 * np.eye(48)
    assert overlap.max() < 2.5
