"""Tests of a magnet beside the path: made-up readings from magpylib, and a trial of the BROAD benchmark."""

import magpylib
import numpy as np
import pytest

from adcs import quaternion
from adcs.complementary.filters import inertial_magnetic_filter
from adcs.complementary.inertial_magnetic import PreparedReadings, prepare
from adcs.complementary.standing_magnet import locate_standing_magnet, standing_field
from adcs.io.imu_files import read_imu

LEVER_M = np.array([0.02, -0.01, 0.015])
POSITION_M, MOMENT_AM2 = np.array([0.1, -0.05, 0.9]), np.array([0.01, 0.03, -0.05])


def made_up(n=2000, moment_Am2=MOMENT_AM2, gradient_T_m=0.0):
    t = np.linspace(0.0, 20.0, n)
    position = np.stack([0.4 * np.sin(0.7 * t), 0.3 * np.cos(1.1 * t), 1.0 + 0.05 * np.sin(0.3 * t)], axis=-1)
    position[: n // 10] = [3.0, 3.0, 1.0]
    q = quaternion.exp(np.stack([np.sin(t), 0.5 * np.cos(t), 0.3 * t], axis=-1))
    room = np.array([0.0, 18e-6, -45e-6]) + gradient_T_m * position * [1.0, 0.0, -1.0]
    magnet = magpylib.misc.Dipole(moment=moment_Am2, position=POSITION_M)
    field = quaternion.rotate_back(q, magnet.getB(position + quaternion.rotate(q, LEVER_M)) + room)
    field = field + 0.3e-6 * np.random.default_rng(0).standard_normal(field.shape)
    still = np.zeros_like(field)
    return PreparedReadings(t, still, still, field, q, 0.0, still[:, 0]), q, position


class TestMadeUp:
    def test_found(self):
        prepared, q, position = made_up()
        magnet = locate_standing_magnet(prepared, q, position)
        np.testing.assert_allclose(magnet.position_m, POSITION_M, atol=0.01)
        np.testing.assert_allclose(magnet.moment_Am2, MOMENT_AM2, atol=3e-3)

    def test_field(self):
        prepared, q, position = made_up()
        position[5] = np.nan
        rest = prepared.field_T - standing_field(locate_standing_magnet(prepared, q, position), q, position)
        steady = quaternion.rotate(q, rest)[200:]
        np.testing.assert_allclose(steady.mean(axis=0), [0.0, 18e-6, -45e-6], atol=0.05e-6)
        assert standing_field(locate_standing_magnet(prepared, q, position), q, position)[5].tolist() == [0.0, 0.0, 0.0]

    def test_without_positions(self):
        prepared, q, position = made_up()
        with pytest.raises(ValueError, match="100 known positions"):
            locate_standing_magnet(prepared, q, np.full_like(position, np.nan))

    def test_a_room_is_no_magnet(self):
        """Its gradient makes a disturbance of several microtesla, and a far dipole would explain that."""
        prepared, q, position = made_up(moment_Am2=0.0 * MOMENT_AM2, gradient_T_m=10e-6)
        with pytest.raises(ValueError, match=r"explains .* of the disturbance near it"):
            locate_standing_magnet(prepared, q, position)

    def test_sigma_and_what_it_explains(self):
        prepared, q, position = made_up()
        magnet = locate_standing_magnet(prepared, q, position)
        assert magnet.explained > 0.95
        np.testing.assert_allclose(magnet.lever_arm_m, LEVER_M, atol=0.01)
        assert (np.abs(magnet.position_m - POSITION_M) < 4.0 * magnet.sigma_m).all()
        assert (magnet.sigma_m < 0.03).all()


class TestBroad:
    def log(self, data_folder, name):
        """Prepared readings, attitude without what is disturbed, and positions."""
        log = read_imu(data_folder / "broad" / f"{name}.mat")
        record = log.record
        readings = record.time_s, record.rate_rad_s, record.acceleration_m_s2, record.field_T
        return prepare(record), inertial_magnetic_filter(*readings, magnet="rejected").q, log.position_m

    @pytest.mark.slow
    def test_found(self, data_folder):
        """A magnet some 7 to 13 cm beside the path, passed twice: it explains most of what is disturbed near it."""
        prepared, q, position_m = self.log(data_folder, "30_disturbed_stationary_magnet_C")
        magnet = locate_standing_magnet(prepared, q, position_m)
        assert 0.05 < np.nanmin(np.linalg.norm(position_m - magnet.position_m, axis=1)) < 0.15
        assert 0.03 < np.linalg.norm(magnet.moment_Am2) < 0.08
        assert magnet.explained > 0.7
        with_magnet = np.linalg.norm(standing_field(magnet, q, position_m), axis=1)
        assert 20e-6 < with_magnet.max() < 200e-6

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "name",
        [
            "01_undisturbed_slow_rotation_A",
            "07_undisturbed_fast_rotation_B",
            "11_undisturbed_slow_translation_B",
            "15_undisturbed_fast_translation_A",
            "25_disturbed_tapping_B",
            "33_disturbed_attached_magnet_2cm",
            "34_disturbed_attached_magnet_3cm",
        ],
    )
    def test_none_where_there_is_none(self, data_folder, name):
        with pytest.raises(ValueError, match=r"explains .* of the disturbance near it"):
            locate_standing_magnet(*self.log(data_folder, name))
