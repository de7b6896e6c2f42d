"""The simulated joystick: readings of ball magnets against magpylib, poses within the knob's range."""

import magpylib
import numpy as np
from scipy.spatial.transform import Rotation

from sims.magnetics import joystick


def test_readings_are_those_of_balls() -> None:
    """Noise is 10 µT; the mean of 400 readings at one pose is exact to 5 σ / 20."""
    rng = np.random.default_rng(4)
    device = joystick.draw_joystick(rng)
    place, turn = np.array([0.001, -0.0015, 0.009]), Rotation.from_rotvec([0.1, 0.2, -0.1])
    read = device.read(np.tile(place, (400, 1)), Rotation.concatenate([turn] * 400), rng)
    field = np.zeros((3, 3))
    for position, moment in zip(device.magnet_m, device.moment_Am2, strict=True):
        remanence = moment * 24e-7 / 0.005**3
        ball = magpylib.magnet.Sphere(diameter=0.005, polarization=turn.apply(remanence))
        ball.position = place + turn.apply(position)
        field += ball.getB(device.position_m)
    expected = np.einsum("iab,ib->ia", device.response, field) + device.offset_T
    np.testing.assert_allclose(read.values_T.mean(axis=0), expected.ravel(), rtol=0, atol=5 * 1.1e-5 / 20)


def test_motion_stays_in_the_range() -> None:
    limits = joystick.nominal_knob().limits
    for position, rotation in (
        joystick.motion(np.random.default_rng(1), 2.0),
        joystick.random_poses(np.random.default_rng(2), 500),
    ):
        assert (position >= np.array(limits.low_m)).all()
        assert (position <= np.array(limits.high_m)).all()
        assert rotation.magnitude().max() <= limits.angle_rad


def test_errors_are_those_of_the_tolerances() -> None:
    """Pooled over 200 devices (600 to 1,800 numbers): each standard deviation within 10 %, more than 5 σ of it."""
    rng = np.random.default_rng(8)
    devices = [joystick.draw_joystick(rng) for _ in range(200)]
    placed = np.std([device.position_m - joystick.nominal_array().positions for device in devices])
    strength = np.std([np.linalg.norm(device.moment_Am2, axis=1) for device in devices]) / np.linalg.norm(
        joystick.nominal_knob().moments_Am2[0]
    )
    assert abs(placed / joystick.TOLERANCE_M - 1.0) < 0.1
    assert abs(strength / joystick.TOLERANCE_GAIN - 1.0) < 0.15
