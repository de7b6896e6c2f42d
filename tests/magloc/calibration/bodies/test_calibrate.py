"""Calibration of bodies: the truth comes back within its standard deviations, and what stays unknown is named."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2 as chi2_law

from magloc.bodies.locator import locate_body
from magloc.calibration.bodies.calibrate import BodyPrior, calibrate_body
from magloc.calibration.bodies.model import across
from magloc.calibration.bodies.results import BodyCalibration
from magloc.calibration.sensors import unknowns
from magloc.readings import Readings
from magloc.truth import Truth
from sims.magnetics import joystick
from sims.magnetics.joystick import Joystick, nominal_array, nominal_knob

FloatArray = NDArray[np.float64]
GAIN = {"common gain against the strength of the magnets"}
SIZE = {"size of array and body against the strength of the magnets"}
AXES = "xyz"
TOGETHER = {f"array and body together: translation along {axis}" for axis in AXES}
TURNED_TOGETHER = {f"array and body together: rotation about {axis}" for axis in AXES}
APART = {
    f"{what}: {how} {axis}"
    for what in ("array", "body")
    for how in ("translation along", "rotation about")
    for axis in AXES
}


@dataclass(frozen=True)
class Case:
    device: Joystick
    readings: Readings
    position_m: FloatArray
    rotation: Rotation

    def truth(self, rows: slice = slice(None)) -> Truth:
        return Truth(self.readings.time_s[rows], self.position_m[rows], rotation=self.rotation[rows])

    def calibrate(self, **options: object) -> BodyCalibration:
        return calibrate_body(nominal_array(), nominal_knob(), self.readings, **options)  # type: ignore[arg-type]


def case(seed: int, n: int, *, rest: int = 0, attitude: Rotation | None = None) -> Case:
    rng = np.random.default_rng([60, seed])
    device = joystick.draw_joystick(rng)
    position, rotation = joystick.random_poses(rng, n)
    if attitude is not None:
        rotation = attitude
    position[:rest] = [0.0, 0.0, joystick.HEIGHT_M]
    rotation = Rotation.concatenate([Rotation.identity(rest), rotation[rest:]]) if rest else rotation
    return Case(device, device.read(position, rotation, rng), position, rotation)


def names(result: BodyCalibration) -> set[str]:
    return {part.name for part in result.unobservable}


def errors(result: BodyCalibration, device: Joystick) -> FloatArray:
    """Errors of the estimated unknowns, of sensors then magnets, without the second order of the rotations."""
    nominal = np.eye(3)
    of_sensors = unknowns(
        3,
        position=device.position_m - nominal_array().positions,
        response=device.response - nominal,
        offset=device.offset_T,
    )
    knob = nominal_knob()
    strength = np.linalg.norm(device.moment_Am2, axis=1) / np.linalg.norm(knob.moments_Am2, axis=1)
    unit = device.moment_Am2 / np.linalg.norm(device.moment_Am2, axis=1, keepdims=True)
    found = result.body.moments_Am2 / np.linalg.norm(result.body.moments_Am2, axis=1, keepdims=True)
    turns = np.einsum("kda,ka->kd", across(knob), np.cross(unit, found))
    of_magnets = np.concatenate(
        [
            result.magnet_change[:, :3] - (device.magnet_m - knob.positions_m),
            result.magnet_change[:, 3:4] - (strength[:, None] - 1.0),
            turns,
        ],
        axis=1,
    )
    return np.concatenate([(result.change - of_sensors).ravel(), of_magnets.ravel()])


class TestJigs:
    def test_the_truth_comes_back_within_its_covariance(self) -> None:
        """χ² of the errors of 8 devices in the directions that the readings determine; it fails once in 10,000 runs."""
        square, dof = 0.0, 0
        for seed in range(8):
            one = case(seed, 60)
            result = one.calibrate(truth=one.truth(), validate=False)
            assert result.converged
            assert names(result) == GAIN
            wrong = errors(result, one.device)
            value, vector = np.linalg.eigh(result.covariance / np.outer(unit(result), unit(result)))
            seen = value < 0.05  # directions that the readings, not the prior, determine
            square += float(np.sum((vector.T @ (wrong / unit(result)))[seen] ** 2 / value[seen]))
            dof += int(seen.sum())
        low, high = chi2_law(dof).ppf([5e-5, 1.0 - 5e-5])
        assert low < square < high, (square / dof, dof)

    def test_errors_of_the_jig_count(self) -> None:
        rng = np.random.default_rng(5)
        one = case(9, 80)
        result = one.calibrate(truth=joystick.jig_truth(one.readings, one.position_m, one.rotation, rng))
        assert 0.8 < result.chi2 / result.dof < 1.2
        assert result.cross_validation is not None
        assert np.median(result.cross_validation.error_m) < 5e-5
        assert np.degrees(np.median(result.cross_validation.error_rad)) < 0.3
        assert (result.rms_T[1] < 0.1 * result.rms_T[0]).all()


def unit(result: BodyCalibration) -> FloatArray:
    """Prior standard deviations, for a well-scaled covariance."""
    prior = np.tile([2e-4] * 3 + [0.03] * 3 + [0.035] * 6 + [1e-4] * 3, 3)
    return np.concatenate([prior, np.tile([2e-4] * 3 + [0.03] + [0.035] * 2, 3)])


class TestUnknownTerms:
    """Each set of names is a symmetry of the physics."""

    def test_unknown_motion_leaves_array_and_body_in_their_frames(self) -> None:
        result = case(11, 250).calibrate(validate=False)
        assert names(result) == APART | SIZE | GAIN

    def test_poses_without_rotation_leave_a_common_translation(self) -> None:
        one = case(12, 120, attitude=Rotation.identity(120))
        assert names(one.calibrate(truth=one.truth(), validate=False)) == TOGETHER | GAIN

    def test_rotations_about_one_axis_leave_the_translation_along_it(self) -> None:
        rng = np.random.default_rng(1)
        turns = Rotation.from_rotvec(np.outer(rng.uniform(-0.25, 0.25, 120), [0.0, 0.0, 1.0]))
        one = case(13, 120, attitude=turns)
        assert (
            names(one.calibrate(truth=one.truth(), validate=False))
            == {"array and body together: translation along z"} | GAIN
        )

    def test_a_rest_and_free_turns_leave_a_common_motion(self) -> None:
        one = case(14, 250, rest=30)
        result = one.calibrate(truth=one.truth(slice(30)), free_rows=True, validate=False)
        assert names(result) == TOGETHER | TURNED_TOGETHER | SIZE | GAIN
        assert result.rows.all()

    def test_a_motion_to_the_limits_stays_within_those_of_the_calibrated_body(self) -> None:
        """An array that stands 0.8 mm beside its drawing, which unknown poses cannot show."""
        one = case(11, 250)
        device = replace(one.device, position_m=one.device.position_m + np.array([0.0, 8e-4, 0.0]))
        readings = device.read(one.position_m, one.rotation, np.random.default_rng(11))
        result = replace(one, device=device, readings=readings).calibrate(validate=False)
        assert locate_body(result.array, result.body, readings).solved.all()
        known = one.calibrate(truth=one.truth(), validate=False)
        assert known.body.limits == nominal_knob().limits

    def test_the_prior_of_a_gauge_is_stated(self) -> None:
        """A common translation of three sensors, 0.5 mm each: 0.5 mm / √3."""
        result = case(11, 250).calibrate(validate=False)
        prior = {part.name: part.prior for part in result.unobservable}
        assert prior["array: translation along x"] == pytest.approx(5e-4 / np.sqrt(3.0))
        assert prior["body: translation along x"] == pytest.approx(joystick.TOLERANCE_M / np.sqrt(3.0))

    def test_left_out_rows_of_an_unknown_motion_fit(self) -> None:
        result = case(15, 200).calibrate()
        assert result.cross_validation is not None
        assert result.cross_validation.chi2 / result.cross_validation.dof < 1.5
        assert result.cross_validation.error_m.size == 0


class TestRefusals:
    def test_truth_without_attitudes(self) -> None:
        one = case(1, 30)
        truth = replace(one.truth(), rotation=None)
        with pytest.raises(ValueError, match="truth must have the attitude of the body: qx, qy, qz, qw"):
            one.calibrate(truth=truth)

    def test_truth_in_millimetres(self) -> None:
        one = case(1, 30)
        truth = one.truth()
        with pytest.raises(ValueError, match="truth must have positions in metres"):
            one.calibrate(truth=replace(truth, position_m=1e3 * truth.position_m))

    def test_readings_in_nanotesla(self) -> None:
        one = case(1, 30)
        wrong = replace(one.readings, values_T=1e9 * one.readings.values_T)
        with pytest.raises(ValueError, match="another unit, or no body"):
            calibrate_body(nominal_array(), nominal_knob(), wrong, truth=one.truth())

    def test_a_reversed_magnet_leaves_hardly_any_pose(self) -> None:
        one = case(1, 200)
        first, *others = nominal_knob().magnets
        turned = replace(first, moment_Am2=tuple((-np.array(first.moment_Am2)).tolist()))
        with pytest.raises(ValueError, match="of 200 rows have a pose with the nominal array and body"):
            calibrate_body(nominal_array(), replace(nominal_knob(), magnets=(turned, *others)), one.readings)

    def test_truth_of_another_time(self) -> None:
        one = case(1, 30)
        truth = one.truth()
        with pytest.raises(ValueError, match="truth must have times of the readings"):
            one.calibrate(truth=replace(truth, time_s=truth.time_s + 10.0))

    def test_too_few_rows(self) -> None:
        one = case(1, 5)
        with pytest.raises(ValueError, match="more readings than unknowns; instead 5 usable rows leave"):
            one.calibrate()

    def test_unknown_poses_and_an_unknown_common_field_leave_nothing(self) -> None:
        one = case(1, 200)
        array = replace(nominal_array(), common_field_T=None)
        with pytest.raises(ValueError, match="state common_field_nT in the array file"):
            calibrate_body(array, nominal_knob(), one.readings)

    def test_a_prior_that_is_not_positive(self) -> None:
        with pytest.raises(ValueError, match="strength must be positive"):
            BodyPrior(strength=0.0)


def test_a_dead_sensor_is_named() -> None:
    """Gains of zero explain its readings, far beyond their tolerance."""
    one = case(17, 80)
    values_T = one.readings.values_T.copy()
    values_T[:, 3:6] = 0.0
    dead = replace(one.readings, values_T=values_T)
    result = calibrate_body(nominal_array(), nominal_knob(), dead, truth=one.truth(), validate=False)
    assert "sensor s2" in result.far_from_prior
    assert one.calibrate(truth=one.truth(), validate=False).far_from_prior == ()


def test_calibrated_files_state_what_is_left() -> None:
    """Stated errors shrink from their tolerances; the errors of a file that states none stay zero."""
    one = case(16, 100)
    result = one.calibrate(truth=one.truth(), validate=False)
    sensor, magnet = result.array.sensors[0], result.body.magnets[0]
    assert 0.0 < sensor.gain_uncertainty < 0.1 * joystick.TOLERANCE_GAIN
    assert 0.0 < sensor.misalignment_rad < 0.1 * joystick.TOLERANCE_RAD
    assert 0.0 < magnet.position_sigma_m < 0.1 * joystick.TOLERANCE_M
    exact = [replace(s, gain_uncertainty=0.0, misalignment_rad=0.0) for s in nominal_array().sensors]
    plain = replace(nominal_array(), sensors=tuple(exact))
    again = calibrate_body(plain, nominal_knob(), one.readings, truth=one.truth(), validate=False)
    assert again.array.sensors[0].gain_uncertainty == 0.0
