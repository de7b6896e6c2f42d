"""Tests of a magnet beside the path: made-up readings from magpylib, and a trial of the BROAD benchmark."""

import math

import magpylib
import numpy as np
import pytest

from adcs import quaternion
from adcs.complementary.inertial_magnetic import Prepared, inertial_magnetic_track, prepare, undisturbed
from adcs.complementary.standing_magnet import locate_standing_magnet, standing_field
from tests.adcs.broad import orientation_errors, read_broad

POSITION_M, MOMENT_AM2 = np.array([0.1, -0.05, 0.9]), np.array([0.01, 0.03, -0.05])


def made_up(n=2000):
    t = np.linspace(0.0, 20.0, n)
    position = np.stack([0.4 * np.sin(0.7 * t), 0.3 * np.cos(1.1 * t), 1.0 + 0.05 * np.sin(0.3 * t)], axis=-1)
    position[: n // 10] = [3.0, 3.0, 1.0]
    q = quaternion.exp(np.stack([np.sin(t), 0.5 * np.cos(t), 0.3 * t], axis=-1))
    magnet = magpylib.misc.Dipole(moment=MOMENT_AM2, position=POSITION_M)
    field = quaternion.rotate_back(q, magnet.getB(position) + np.array([0.0, 18e-6, -45e-6]))
    field = field + 0.3e-6 * np.random.default_rng(0).standard_normal(field.shape)
    still = np.zeros_like(field)
    return Prepared(t, still, still, still, field, q, 0.0), q, position


class TestMadeUp:
    def test_found(self):
        prepared, q, position = made_up()
        magnet = locate_standing_magnet(prepared, q, position)
        np.testing.assert_allclose(magnet.position_m, POSITION_M, atol=2e-3)
        np.testing.assert_allclose(magnet.moment_Am2, MOMENT_AM2, atol=2e-3)

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


class TestBroad:
    def test_found(self, data_folder):
        """A magnet 7 cm beside the path, passed twice: near it, half of the disturbance goes, and the heading stays."""
        trial = read_broad(data_folder / "broad" / "30_disturbed_stationary_magnet_C.mat")
        prepared = prepare(trial.record)
        rejected = inertial_magnetic_track(prepared, undisturbed(prepared))
        magnet = locate_standing_magnet(prepared, rejected, trial.position_m)
        distances = np.linalg.norm(trial.position_m - magnet.position_m, axis=1)
        assert 0.05 < np.nanmin(distances) < 0.1
        assert 0.03 < np.linalg.norm(magnet.moment_Am2) < 0.08
        field = prepared.field_T - standing_field(magnet, rejected, trial.position_m)
        left = []
        for values in (prepared.field_T, field):
            steady = quaternion.rotate(rejected, values)
            left.append(steady[distances < 0.3] - quaternion.rotate(rejected, prepared.field_T)[:285].mean(axis=0))
        assert np.linalg.norm(left[1]) < 0.6 * np.linalg.norm(left[0])
        totals = [
            math.degrees(orientation_errors(q, trial.q_true, trial.moving).total)
            for q in (rejected, inertial_magnetic_track(prepared, field))
        ]
        assert totals[1] == pytest.approx(totals[0], abs=0.2)
