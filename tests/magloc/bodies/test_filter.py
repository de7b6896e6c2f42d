"""Tracks of bodies: consistency, start, loss and gaps, and the compiled filter against the readable one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.filter import BodyTracker, track_body
from magloc.bodies.locator import locate_body
from magloc.bodies.poses import BodyPoses
from magloc.bodies.track import BodyMotion
from magloc.chi_square import normalised_square
from magloc.fields.shapes import Shape
from magloc.readings import Readings
from tests.magloc.bodies.devices import hall_ring, knob, readings_of

RATE_HZ = 200.0


def moving(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (n,), positions (n, 3) and rotations (n, 3, 3) of a hand that plays with a knob."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE_HZ
    hz, phase = rng.uniform(0.3, 1.5, (6, 2)), rng.uniform(0.0, 2.0 * math.pi, (6, 2))
    waves = np.sin(2.0 * math.pi * hz[..., None] * t + phase[..., None]).mean(axis=1)
    position_m = 0.0028 * waves[:3].T + [0.0, 0.0, 0.015]
    return t, position_m, Rotation.from_rotvec(0.2 * waves[3:].T).as_matrix()


def record(array: SensorArray, body: MagnetBody, n: int, seed: int) -> tuple[Readings, np.ndarray, np.ndarray]:
    """Return readings in a constant ambient field, and the true poses."""
    t, position_m, R = moving(n, seed)
    rng = np.random.default_rng(seed + 1)
    steady = replace(array, common_field_T=None)
    ambient = array.readings_of(np.broadcast_to([2e-5, 0.0, 4e-5], (array.n_sensors, 3)))
    return Readings(readings_of(steady, body, position_m, R, rng) + ambient, time_s=t), position_m, R


def nees(track: BodyPoses, position_m: np.ndarray, R: np.ndarray) -> np.ndarray:
    turn = (Rotation.from_matrix(R).inv() * track.rotation).inv().as_rotvec()
    error = np.concatenate([position_m - track.position_m[:, 0], turn], axis=1)
    return np.where(track.solved, normalised_square(error, track.covariance[:, 0]) / 6.0, np.nan)


def test_a_track_is_consistent_and_better_than_single_rows() -> None:
    # Errors last several rows, so about 100 of 1000 rows are independent: the band is four standard deviations.
    array, body = hall_ring(4, noise_T=5e-6, common_field_T=None), knob()
    readings, position_m, R = record(array, body, 1000, 60_20)
    track = track_body(array, body, readings)
    assert set(track.status) == {"tracked"}
    assert np.nanmean(nees(track, position_m, R)[20:]) == pytest.approx(1.0, abs=0.25)
    assert np.mean(track.nis[1:] / track.dof[1:]) < 1.1  # less than 1, as the hand is slower than the model
    alone = BodyTracker(array, body).locator.fit_rows(readings.values_T[20:])
    errors = [
        np.linalg.norm(found - position_m[20:], axis=1) for found in (track.position_m[20:, 0], alone.position_m[:, 0])
    ]
    assert np.sqrt(np.mean(errors[0] ** 2)) < 0.9 * np.sqrt(np.mean(errors[1] ** 2))


@pytest.mark.parametrize("shaped", [False, True])
def test_the_compiled_filter_is_the_readable_one(shaped: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    array = hall_ring(4)
    array = replace(
        array, sensors=tuple(replace(s, offset_uncertainty_T=1e-5, gain_uncertainty=0.01) for s in array.sensors)
    )
    body = knob(moment_sigma_Am2=0.002)
    readings, *_ = record(array, body, 60, 60_21)
    compiled = track_body(array, body, readings)
    if shaped:  # a sphere has the field of a dipole
        body = replace(body, magnets=[replace(m, shape=Shape("sphere", (0.005,))) for m in body.magnets])
    monkeypatch.setattr(MagnetBody, "has_shapes", property(lambda _: True))
    readable = track_body(array, body, readings)
    assert readable.status == compiled.status
    sigma = np.sqrt(np.diagonal(compiled.covariance[:, 0], axis1=1, axis2=2))
    assert (np.abs(readable.position_m - compiled.position_m)[:, 0] < 0.02 * sigma[:, :3]).all()
    unit = 1.0 / (sigma[:, None, :, None] * sigma[:, None, None, :])
    np.testing.assert_allclose(unit * readable.covariance, unit * compiled.covariance, atol=0.02)


def test_errors_of_magnets_and_sensors_are_estimated() -> None:
    rng = np.random.default_rng(60_22)
    array = hall_ring(4, common_field_T=None)
    stated = replace(array, sensors=tuple(replace(s, gain_uncertainty=0.02) for s in array.sensors))
    squares = []
    for seed in range(8):
        body = knob(moment_sigma_Am2=0.0025)
        true = replace(
            body,
            magnets=[
                replace(m, moment_Am2=tuple((1.0 + 0.05 * rng.normal()) * np.array(m.moment_Am2))) for m in body.magnets
            ],
        )
        readings, position_m, R = record(array, true, 300, 60_23 + seed)
        gains = 1.0 + 0.02 * rng.normal(size=array.n_channels)
        track = track_body(stated, body, Readings(gains * readings.values_T, time_s=readings.time_s))
        assert track.solved.all()
        squares.append(np.nanmean(nees(track, position_m, R)[-50:]))
    # Eight devices: constant errors make rows of one device alike; the mean of 8 values of χ²/6 is within 0.4 to 2.
    assert 0.4 < np.mean(squares) < 2.0


def test_three_sensors_do_not_learn_the_moments_from_rows_without_a_check() -> None:
    # Nine readings less three of the common field are as many as a pose has numbers.
    rng = np.random.default_rng(60_24)
    array, body = hall_ring(), knob(moment_sigma_Am2=0.0005)
    squares = []
    for seed in range(8):
        scales = 1.0 + 0.01 * rng.normal(size=3)
        moments = [tuple(s * np.array(m.moment_Am2)) for s, m in zip(scales, body.magnets, strict=True)]
        true = replace(body, magnets=[replace(m, moment_Am2=new) for m, new in zip(body.magnets, moments, strict=True)])
        readings, position_m, R = record(array, true, 300, 60_40 + seed)
        squares.append(np.nanmean(nees(track_body(array, body, readings), position_m, R)))
    # Eight devices, as above: within 0.4 to 2.
    assert 0.4 < np.mean(squares) < 2.0


def test_a_gap_and_a_missing_sensor_do_not_end_a_track() -> None:
    array, body = hall_ring(4), knob()
    readings, position_m, R = record(array, body, 200, 60_24)
    values = readings.values_T.copy()
    values[50:56, :3] = np.nan
    values[100:103] = np.nan
    track = track_body(array, body, Readings(values, time_s=readings.time_s))
    assert set(track.status) == {"tracked"}
    assert np.nanmax(nees(track, position_m, R)) < 6.0
    late = np.where(np.arange(200) < 120, readings.time_s, readings.time_s + 10.0)
    assert set(track_body(array, body, Readings(values, time_s=late)).status) == {"tracked"}


def test_a_jump_starts_a_new_track() -> None:
    array, body = hall_ring(4), knob()
    readings, position_m, R = record(array, body, 100, 60_25)
    _, other_m, other_R = moving(100, 60_26)
    values = readings.values_T.copy()
    values[50:] = readings_of(array, body, other_m[50:], other_R[50:], np.random.default_rng(60_27))
    track = track_body(array, body, Readings(values, time_s=readings.time_s))
    squares = nees(track, np.concatenate([position_m[:50], other_m[50:]]), np.concatenate([R[:50], other_R[50:]]))
    assert np.nanmean(squares[56:]) < 2.0
    assert track.solved[56:].all()


def test_rows_one_by_one_give_the_same_track() -> None:
    array, body = hall_ring(4), knob()
    readings, _, _ = record(array, body, 40, 60_28)
    together = track_body(array, body, readings)
    tracker = BodyTracker(array, body)
    for i in range(40):
        point = tracker.follow(readings.values_T[i : i + 1], readings.time_s[i : i + 1])
        np.testing.assert_allclose(point.position_m[0], together.position_m[i], rtol=1e-9, atol=1e-12)


def test_a_step_has_the_variance_of_the_process() -> None:
    motion = BodyMotion(speed_m_s=0.2, turn_rad_s=3.0, correlation_s=0.5)
    (*x,) = motion.step(0.1, 1.0)
    assert x[1] == pytest.approx(math.exp(-0.2))
    assert (x[1] * 0.2) ** 2 + x[3] ** 2 + x[4] ** 2 == pytest.approx(0.04)  # the speed stays what it is


def misplaced(body: MagnetBody, rng: np.random.Generator) -> MagnetBody:
    """Return a body whose magnets stand 0.2 mm beside their drawing, per axis, and point 2° beside it."""
    magnets = []
    for magnet in body.magnets:
        turn = Rotation.from_rotvec(math.radians(2.0) * rng.normal(size=3))
        place = np.array(magnet.position_m) + 2e-4 * rng.normal(size=3)
        magnets.append(replace(magnet, position_m=tuple(place), moment_Am2=tuple(turn.apply(magnet.moment_Am2))))
    return replace(body, magnets=magnets)


@pytest.mark.parametrize("noise_T", [1e-6, 1e-5])
def test_stated_errors_of_placement_are_in_the_covariance(noise_T: float) -> None:
    # Each device has constant errors, so its NEES is one value of χ²/6: the mean of 4 is above 3 once in 100,000.
    rng = np.random.default_rng(60_30)
    array, drawn = hall_ring(4, noise_T=noise_T), knob(position_sigma_m=2e-4, direction_sigma_rad=math.radians(2.0))
    squares = []
    for seed in range(4):
        readings, position_m, R = record(array, misplaced(knob(), rng), 150, 60_31 + seed)
        track = track_body(array, drawn, readings)
        assert set(track.status) == {"tracked"}
        squares.append(np.nanmean(nees(track, position_m, R)))
    assert np.mean(squares) < 3.0


def test_errors_of_placement_that_nobody_states_are_flagged() -> None:
    # 0.2 mm and 2° are a hundred times this noise; of errors near the noise most look like another pose.
    rng = np.random.default_rng(60_36)
    array = hall_ring(4)
    for seed in range(3):
        readings, position_m, R = record(array, misplaced(knob(), rng), 150, 60_37 + seed)
        track = track_body(array, knob(), readings)
        flagged = [bool(flags) or status != "tracked" for flags, status in zip(track.flags, track.status, strict=True)]
        wrong = nees(track, position_m, R) > 5.0
        assert (wrong & ~np.array(flagged)).mean() < 0.03  # the first rows of a track are too few to judge it


def test_a_noise_that_is_larger_than_stated_is_flagged() -> None:
    array, body = hall_ring(4), knob()
    readings, position_m, R = record(replace(array, sensors=hall_ring(4, noise_T=3e-6).sensors), body, 300, 60_39)
    track = track_body(array, body, readings)
    late = np.arange(300) >= 50
    flagged = np.array(
        [bool(flags) or status != "tracked" for flags, status in zip(track.flags, track.status, strict=True)]
    )
    assert flagged[late].mean() > 0.95
    assert np.nanmean(nees(track, position_m, R)[late]) < 3.0


def test_rows_one_by_one_give_the_same_track_with_errors_of_placement() -> None:
    array, body = hall_ring(4), knob(position_sigma_m=1e-4)
    readings, _, _ = record(array, body, 30, 60_28)
    together = track_body(array, body, readings)
    tracker = BodyTracker(array, body)
    for i in range(30):
        point = tracker.follow(readings.values_T[i : i + 1], readings.time_s[i : i + 1])
        np.testing.assert_allclose(point.position_m[0], together.position_m[i], rtol=1e-9, atol=1e-12)


def reversed_magnets(body: MagnetBody, *ids: str) -> MagnetBody:
    magnets = [replace(m, moment_Am2=tuple(-np.array(m.moment_Am2))) if m.id in ids else m for m in body.magnets]
    return replace(body, magnets=magnets)


def exchanged(body: MagnetBody) -> MagnetBody:
    """The first two magnets in each other's place."""
    one, other, *rest = body.magnets
    places = (replace(one, position_m=other.position_m), replace(other, position_m=one.position_m))
    return replace(body, magnets=[*places, *rest])


HOSTILE = {
    "all reversed": (lambda body: reversed_magnets(body, *body.ids), lambda values, rng: values),
    "one reversed": (lambda body: reversed_magnets(body, "m1"), lambda values, rng: values),
    "exchanged": (exchanged, lambda values, rng: values),
    "left-handed axes": (lambda body: body, lambda values, rng: values * np.tile([1.0, -1.0, 1.0], 5)),
    "gain of -1": (lambda body: body, lambda values, rng: np.where(np.arange(15) == 4, -values, values)),
    "noise ten times larger": (lambda body: body, lambda values, rng: values + 1e-5 * rng.normal(size=values.shape)),
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize("follow", [locate_body, track_body])
def test_hostile_input_is_flagged_or_consistent(case: str, follow: Callable[..., BodyPoses]) -> None:
    array, body = hall_ring(5), knob()
    readings, position_m, R = record(array, body, 8, 60_60)
    of_body, of_values = HOSTILE[case]
    values = of_values(readings.values_T, np.random.default_rng(60_61))
    found = follow(array, of_body(body), Readings(values, time_s=readings.time_s))
    squares = nees(found, position_m, R)
    flagged = np.array([bool(flags or reason) for flags, reason in zip(found.flags, found.reason, strict=True)])
    assert (flagged | (squares < 3.0)).all()
