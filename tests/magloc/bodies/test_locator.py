"""Poses of single rows: consistency, ambiguity, limits, and causes that are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magloc.bodies.body import Magnet, MagnetBody, PoseLimits
from magloc.bodies.field import body_fields
from magloc.bodies.locator import BodyLocator, locate_body
from magloc.bodies.poses import BodyPoses
from magloc.chi_square import normalised_square
from magloc.fields.shapes import Shape
from tests.magloc.bodies.devices import hall_ring, knob, random_poses, readings_of


def nees(poses: BodyPoses, position_m: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the normalised squared errors (n,) of the best poses, per dimension."""
    turn = (Rotation.from_matrix(R).inv() * poses.rotation).inv().as_rotvec()
    error = np.concatenate([position_m - poses.position_m[:, 0], turn], axis=1)
    return np.where(poses.solved, normalised_square(error, poses.covariance[:, 0]) / 6.0, np.nan)


def drawn(body: MagnetBody, rng: np.random.Generator) -> MagnetBody:
    """Return a body whose moments have errors of the stated size."""
    factors = 1.0 + body.moment_root @ rng.normal(size=body.moment_root.shape[1])
    magnets = zip(body.magnets, factors, strict=True)
    return replace(body, magnets=[replace(m, moment_Am2=tuple(f * np.array(m.moment_Am2))) for m, f in magnets])


def test_errors_are_those_that_are_stated() -> None:
    # False alarm 1 in 1000: the mean of 400 NEES with 6 degrees of freedom has a standard deviation of 0.029.
    rng = np.random.default_rng(60_10)
    array, body = hall_ring(4), knob()
    position_m, R = random_poses(body, 400, rng)
    poses = locate_body(array, body, readings_of(array, body, position_m, R, rng))
    assert poses.solved.all()
    assert not any({"misfit", "unknown"} & set(flags) for flags in poses.flags)
    assert nees(poses, position_m, R).mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    "stated", [{"moment_sigma_Am2": 0.0015}, {"position_sigma_m": 2e-4, "direction_sigma_rad": 0.02}]
)
def test_stated_errors_of_magnets_widen_the_covariance(stated: dict[str, float]) -> None:
    # Every row has magnets of its own, so that rows are independent; the band is 4 standard deviations of the mean.
    rng = np.random.default_rng(60_11)
    array, body = hall_ring(4), knob(**stated)
    position_m, R = random_poses(body, 300, rng)
    readings = []
    for x, turn in zip(position_m, R, strict=True):
        magnets = []
        for magnet in body.magnets:
            size = 1.0 + magnet.moment_sigma_Am2 / magnet.modulus_Am2 * rng.normal()
            moment = Rotation.from_rotvec(magnet.direction_sigma_rad * rng.normal(size=3)).apply(magnet.moment_Am2)
            place = np.array(magnet.position_m) + magnet.position_sigma_m * rng.normal(size=3)
            magnets.append(replace(magnet, position_m=tuple(place), moment_Am2=tuple(size * moment)))
        readings.append(readings_of(array, replace(body, magnets=magnets), x[None], turn[None], rng)[0])
    poses = locate_body(array, body, np.array(readings))
    squares = nees(poses, position_m, R)
    assert poses.solved.mean() > 0.99
    assert np.nanmean(squares) == pytest.approx(1.0, abs=0.25)


def test_large_errors_of_moments_are_consistent_or_flagged() -> None:
    rng = np.random.default_rng(60_18)
    array, body = hall_ring(4), knob(moment_sigma_Am2=0.005)
    position_m, R = random_poses(body, 200, rng)
    readings = [
        readings_of(array, drawn(body, rng), x[None], turn[None], rng)[0] for x, turn in zip(position_m, R, strict=True)
    ]
    poses = locate_body(array, body, np.array(readings))
    plain = np.array([not flags for flags in poses.flags]) & (poses.n_poses == 1)
    assert plain.mean() > 0.3
    assert nees(poses, position_m, R)[plain].mean() < 3.0


def test_a_temperature_that_is_stated_does_not_bias() -> None:
    rng = np.random.default_rng(60_12)
    array = hall_ring(4)
    warm = replace(knob(), temperature_sigma_K=30.0)
    position_m, R = random_poses(warm, 200, rng)
    readings = np.array(
        [
            readings_of(array, drawn(warm, rng), x[None], turn[None], rng)[0]
            for x, turn in zip(position_m, R, strict=True)
        ]
    )
    assert nees(locate_body(array, warm, readings), position_m, R).mean() == pytest.approx(1.0, abs=0.2)


def test_shapes_are_exact_where_dipoles_are_wrong() -> None:
    rng = np.random.default_rng(60_13)
    array, dipoles = hall_ring(4), knob()
    body = replace(dipoles, magnets=[replace(m, shape=Shape("cylinder", (0.005, 0.006))) for m in dipoles.magnets])
    position_m, R = random_poses(body, 60, rng)
    readings = readings_of(array, body, position_m, R, rng)
    exact, point = locate_body(array, body, readings), locate_body(array, dipoles, readings)
    assert nees(exact, position_m, R).mean() == pytest.approx(1.0, abs=0.25)
    # A dipole's error is far above the noise here: its poses are flagged, or there are none.
    assert sum(bool(flags or reason) for flags, reason in zip(point.flags, point.reason, strict=True)) > 50


def test_rows_of_three_sensors_are_consistent_or_flagged() -> None:
    # 500 rows: the mean of their NEES has a standard deviation of 0.03.
    rng = np.random.default_rng(60_17)
    array, body = hall_ring(3), knob()
    position_m, R = random_poses(body, 600, rng)
    poses = locate_body(array, body, readings_of(array, body, position_m, R, rng))
    plain = np.array([not flags for flags in poses.flags]) & (poses.n_poses == 1)
    assert plain.mean() > 0.75
    assert nees(poses, position_m, R)[plain].mean() == pytest.approx(1.0, abs=0.12)


class TestCauses:
    array = hall_ring(5)
    rng = np.random.default_rng(60_14)
    position_m, R = random_poses(knob(), 20, rng)

    def test_a_missing_magnet_is_named(self) -> None:
        lost = replace(knob(), magnets=knob().magnets[:2])
        poses = locate_body(self.array, knob(), readings_of(self.array, lost, self.position_m, self.R, self.rng))
        assert all("missing m3" in flags for flags in poses.flags)
        assert nees(poses, self.position_m, self.R).mean() < 2.0

    def test_a_dead_sensor_is_named(self) -> None:
        readings = readings_of(self.array, knob(), self.position_m, self.R, self.rng)
        readings[:, 3:6] = 0.0
        poses = locate_body(self.array, knob(), readings)
        assert sum("sensor s2" in flags for flags in poses.flags) >= 19

    def test_a_moment_that_is_wrong_is_a_misfit(self) -> None:
        wrong = knob().magnets[0]
        body = replace(knob(), magnets=(replace(wrong, moment_Am2=(0.0, 0.0, 0.055)), *knob().magnets[1:]))
        poses = locate_body(self.array, knob(), readings_of(self.array, body, self.position_m, self.R, self.rng))
        flagged = [bool(flags or reason) for flags, reason in zip(poses.flags, poses.reason, strict=True)]
        assert np.mean(np.array(flagged) | (nees(poses, self.position_m, self.R) < 3.0)) == 1.0

    def test_another_magnet_nearby_is_a_misfit(self) -> None:
        readings = readings_of(self.array, knob(), self.position_m, self.R, self.rng)
        other = MagnetBody(
            (Magnet("a", (0.04, 0.0, 0.0), (0.0, 0.0, 0.5)), Magnet("b", (0.05, 0.0, 0.0), (0.0, 0.0, 0.5)))
        )
        fields = body_fields(other, self.array.positions, np.zeros(3), np.eye(3))
        poses = locate_body(self.array, knob(), readings + self.array.readings_of(fields))
        squares = nees(poses, self.position_m, self.R)
        flagged = [bool(flags or reason) for flags, reason in zip(poses.flags, poses.reason, strict=True)]
        assert (np.array(flagged) | (squares < 3.0)).all()

    def test_a_gap_and_a_silent_row_have_their_reasons(self) -> None:
        readings = readings_of(self.array, knob(), self.position_m[:3], self.R[:3], self.rng)
        readings[0, :12] = np.nan
        readings[1] = 0.0
        poses = locate_body(self.array, knob(), readings)
        assert poses.solved.tolist() == [False, False, True]
        assert "independent differences" in poses.reason[0]
        assert "no signal" in poses.reason[1]

    def test_a_pose_outside_its_limits_is_named(self) -> None:
        outside = self.position_m[:5] + np.array([0.008, 0.0, 0.0])
        poses = locate_body(self.array, knob(), readings_of(self.array, knob(), outside, self.R[:5], self.rng))
        assert not poses.solved.any()
        assert all("outside the limits of the body: x" in reason for reason in poses.reason)
        for values in (poses.position_m, poses.R, poses.covariance):
            assert np.isnan(values).all()

    def test_a_sensor_inside_a_magnet_is_a_warning(self, caplog: pytest.LogCaptureFixture) -> None:
        body = replace(knob(), limits=PoseLimits())
        sensor = self.array.positions[0] + np.array([0.0, 0.0, 0.0015])
        x = (sensor - np.array(body.magnets[0].position_m))[None]
        locate_body(self.array, body, readings_of(self.array, body, x, np.eye(3)[None], self.rng))
        assert "s1 in m1" in caplog.text


class TestSymmetry:
    def test_poses_of_an_orbit_are_one_solution(self) -> None:
        rng = np.random.default_rng(60_15)
        magnets = []
        for k in range(3):
            turn = Rotation.from_euler("z", 120.0 * k, degrees=True)
            magnets.append(Magnet(f"m{k}", tuple(turn.apply((0.006, 0.0, 0.0))), tuple(turn.apply((0.03, 0.0, 0.04)))))
        limits = PoseLimits((-0.003, -0.003, 0.012), (0.003, 0.003, 0.018))
        body, array = MagnetBody(tuple(magnets), limits=limits), hall_ring(5)
        position_m, R = random_poses(body, 50, rng)
        locator = BodyLocator(array, body)
        poses = locator.fit_rows(readings_of(array, body, position_m, R, rng))
        assert "3 poses" in poses.symmetry
        assert (poses.n_poses == 1).mean() > 0.9
        place, turn, _ = locator.symmetry.nearest_to_rest(position_m, R)
        squares = nees(poses, place, turn)
        assert np.median(squares) < 1.5

    def test_an_angle_about_an_axis_stays_open(self) -> None:
        rng = np.random.default_rng(60_16)
        magnets = (Magnet("a", (0.0, 0.0, 0.0), (0.0, 0.0, 0.05)), Magnet("b", (0.0, 0.0, 0.008), (0.0, 0.0, 0.05)))
        limits = PoseLimits((-0.003, -0.003, 0.012), (0.003, 0.003, 0.018), 0.5)
        body, array = MagnetBody(magnets, limits=limits), hall_ring(5)
        position_m, R = random_poses(body, 20, rng)
        poses = locate_body(array, body, readings_of(array, body, position_m, R, rng))
        assert "every rotation about its axis" in poses.symmetry
        assert poses.solved.all()
        assert (np.sqrt(poses.covariance[:, 0, 5, 5]) > 1.0).all()
        assert (np.sqrt(poses.covariance[:, 0, 3, 3]) < 0.1).all()
