"""Runs of the simulated joystick: calibrated in several ways, then followed at 1 kHz; beside it a fitted matrix.

A matrix of 6 by 9, with a constant, is what makers of such devices fit on the same jig poses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import magloc
from arrays.array import SensorArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.filter import track_body
from magloc.bodies.locator import locate_body
from magloc.calibration.bodies.results import BodyCalibration
from magloc.readings import Readings
from magloc.truth import Truth
from sims.magnetics import joystick
from sims.magnetics.joystick import Joystick

FloatArray = NDArray[np.float64]
JIG_POSES, REST_S, FREE_S = 60, 0.1, 4.0
SWEEP_ROWS = 500
WAYS = ("jig", "rest and free turns", "unknown motion")
_THINNED = 10  # rows of a free motion that calibrate: every tenth


@dataclass(frozen=True)
class Figures:
    """Errors of a motion: rms of the position [mm] and of the rotation [°], both over all axes, and cross-talk.

    `in_frame` is without a constant pose of array and body, which unknown motions cannot show. Cross-talk is the
    largest excursion of another axis while one axis passes through its range, over that axis's own range. `lost` is the
    share of rows without a pose.
    """

    mm: float
    deg: float
    in_frame_mm: float
    in_frame_deg: float
    cross_talk: float
    lost: float


def calibrate(device: Joystick, way: str, rng: np.random.Generator) -> tuple[BodyCalibration, Readings, FloatArray]:
    """Return the calibration of a device, the readings that it had, and their poses (n, 6), NaN where unknown."""
    if way == "jig":
        poses = joystick.random_poses(rng, JIG_POSES)
        readings = device.read(*poses, rng)
        truth = joystick.jig_truth(readings, *poses, rng)
        assert truth.rotation is not None
        stated = np.concatenate([truth.position_m, truth.rotation.as_rotvec()], axis=1)
    else:
        position, rotation = (each[::_THINNED] for each in joystick.motion(rng, FREE_S))
        rest = round(REST_S * joystick.RATE_HZ) if way != WAYS[-1] else 0
        position = np.concatenate([np.tile([0.0, 0.0, joystick.HEIGHT_M], (rest, 1)), position])
        rotation = Rotation.concatenate([Rotation.identity(rest), rotation]) if rest else rotation
        readings = device.read(position, rotation, rng)
        truth = Truth(readings.time_s[:rest], position[:rest], rotation=rotation[:rest]) if rest else None
        stated = np.full((len(readings), 6), np.nan)
    result = magloc.calibrate_body(
        joystick.nominal_array(), joystick.nominal_knob(), readings, truth=truth, free_rows=way != "jig", validate=False
    )
    return result, readings, stated


def follow(array: SensorArray, body: MagnetBody, readings: Readings, *, tracked: bool = False) -> FloatArray:
    """Return the poses (n, 6) of all rows, each by itself or tracked: positions and rotation vectors."""
    found = (track_body if tracked else locate_body)(array, body, readings)
    return np.concatenate([found.position_m[:, 0], found.rotation.as_rotvec()], axis=1)


def fitted_matrix(readings_T: FloatArray, poses: FloatArray) -> FloatArray:
    """Return the matrix (10, 6) from readings and a constant to poses, by least squares."""
    columns = np.column_stack([readings_T, np.ones(len(readings_T))])
    return np.asarray(np.linalg.lstsq(columns, poses, rcond=None)[0])


def apply_matrix(matrix: FloatArray, readings: Readings) -> FloatArray:
    """Return the poses (n, 6) by a fitted matrix."""
    return np.column_stack([readings.values_T, np.ones(len(readings))]) @ matrix


def sweep(device: Joystick, axis: int, rng: np.random.Generator) -> tuple[FloatArray, Readings]:
    """Return poses (n, 6) through the range of one axis, and their readings."""
    limits = joystick.nominal_knob().limits
    half = np.append(0.5 * np.subtract(limits.high_m, limits.low_m), [limits.angle_rad] * 3)
    poses = np.tile([0.0, 0.0, joystick.HEIGHT_M, 0.0, 0.0, 0.0], (SWEEP_ROWS, 1))
    poses[:, axis] += half[axis] * np.linspace(-1.0, 1.0, SWEEP_ROWS)
    return poses, device.read(poses[:, :3], Rotation.from_rotvec(poses[:, 3:]), rng)


def cross_talk(found: list[FloatArray], half: FloatArray) -> float:
    """Return the largest excursion of another axis, over its range, from sweeps (n, 6) of the six axes.

    A cubic through the rows of a sweep takes the noise away; the rest pose is subtracted.
    """
    worst, course = 0.0, np.linspace(-1.0, 1.0, SWEEP_ROWS)
    for axis, poses in enumerate(found):
        smooth = np.polynomial.Polynomial
        for other in range(6):
            if other != axis:
                known = np.isfinite(poses[:, other])
                fit = smooth.fit(course[known], poses[known, other], 3)
                worst = max(worst, float(np.ptp(fit(course)) / (2.0 * half[other])))
    return worst


def figures(found: FloatArray, true: FloatArray, talk: float) -> Figures:
    """Return the figures of poses (n, 6) against the true ones."""
    known = np.isfinite(found).all(axis=1)
    found, true = found[known], true[known]
    shift = found[:, :3] - true[:, :3]
    turn = (Rotation.from_rotvec(true[:, 3:]).inv() * Rotation.from_rotvec(found[:, 3:])).as_rotvec()
    values = []
    for shifts, turns in ((shift, turn), _in_frame(found, true)):
        values += [1e3 * float(np.sqrt(np.mean(np.sum(shifts**2, axis=1))))]
        values += [float(np.degrees(np.sqrt(np.mean(np.sum(turns**2, axis=1)))))]
    return Figures(*values, talk, 1.0 - float(known.mean()))


def _in_frame(found: FloatArray, true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the errors left by the best constant changes of the array's frame, the body's frame and the scale."""
    R_found, R_true = (Rotation.from_rotvec(each[:, 3:]).as_matrix() for each in (found, true))
    shift = found[:, :3] - true[:, :3]
    turn = Rotation.from_matrix(np.swapaxes(R_true, -1, -2) @ R_found).as_rotvec()
    # Array: rotation a, translation t; body: rotation b, translation u; scale: all small, hence linear.
    n, one = len(found), np.eye(3)
    cross = np.zeros((n, 3, 3))
    for axis in range(3):
        cross[:, :, axis] = np.cross(one[axis], true[:, :3])
    of_shift = np.concatenate([cross, np.tile(one, (n, 1, 1)), np.zeros((n, 3, 3)), R_true, true[:, :3, None]], axis=2)
    of_turn = np.concatenate(
        [np.swapaxes(R_true, -1, -2), np.zeros((n, 3, 3)), np.tile(one, (n, 1, 1)), np.zeros((n, 3, 4))], axis=2
    )
    weight = np.array([1e-2, 1.0])  # metres against radians: 10 mm a radian
    columns = np.concatenate([of_shift.reshape(3 * n, -1), weight[0] * of_turn.reshape(3 * n, -1)])
    right = np.concatenate([shift.ravel(), weight[0] * turn.ravel()])
    best = np.linalg.lstsq(columns, right, rcond=None)[0]
    return shift - of_shift @ best, turn - of_turn @ best


def run(seed: int, seconds: float = 2.0) -> dict[str, Figures]:
    """Return the figures of one device for every way of calibration, the true device, and the matrix of the jig."""
    rng = np.random.default_rng([1960, seed])
    device = joystick.draw_joystick(rng)
    limits = joystick.nominal_knob().limits
    half = np.append(0.5 * np.subtract(limits.high_m, limits.low_m), [limits.angle_rad] * 3)
    position, rotation = joystick.motion(rng, seconds)
    true = np.concatenate([position, rotation.as_rotvec()], axis=1)
    moving = device.read(position, rotation, rng)
    sweeps = [sweep(device, axis, rng) for axis in range(6)]

    def of(follower: Callable[[Readings], FloatArray]) -> Figures:
        found = [follower(readings) for _, readings in sweeps]
        return figures(follower(moving), true, cross_talk(found, half))

    results = {}
    for way in WAYS:
        result, readings, stated = calibrate(device, way, rng)
        for name, tracked in ((way, False), (f"{way}, tracked", True)):
            results[name] = of(partial(follow, result.array, result.body, tracked=tracked))
        if way == "jig":
            matrix = fitted_matrix(readings.values_T, stated)
            results["matrix 6×9"] = of(partial(apply_matrix, matrix))
    for name, tracked in (("as drawn", False), ("as drawn, tracked", True)):
        results[name] = of(partial(follow, joystick.nominal_array(), joystick.nominal_knob(), tracked=tracked))
    return results
