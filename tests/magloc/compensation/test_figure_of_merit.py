"""The figure of merit: sines of known amplitudes on four headings."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray
from magloc.compensation.figure_of_merit import Manoeuvres
from tests.magloc.compensation.flights import WORLD_T

TIME = np.arange(0.0, 480.0, 0.2)
PART = (TIME // 40.0).astype(int)  # heading times 3 plus axis
AMPLITUDES = np.random.default_rng(4).uniform(1e-9, 9e-9, 12)
SINE = np.sin(2.0 * np.pi * TIME / 5.0)


def turn_about_z(angle_rad: FloatArray) -> Rotation:
    return Rotation.from_rotvec(angle_rad[:, None] * [0.0, 0.0, 1.0])


def directions(size_rad: float) -> FloatArray:
    """Return the direction of the field in a platform that rolls, pitches and yaws on four headings."""
    angles = np.zeros((len(TIME), 3))
    angles[np.arange(len(TIME)), PART % 3] = size_rad * SINE
    heading = turn_about_z(0.4 + (PART // 3) * np.pi / 2.0)
    return (heading * Rotation.from_rotvec(angles)).inv().apply(WORLD_T / np.linalg.norm(WORLD_T))


def test_twelve_manoeuvres_are_found_and_summed() -> None:
    found = Manoeuvres.of(TIME, directions(0.1))
    assert found.n_found == 12
    inside = found.cell >= 0
    assert inside.mean() > 0.9
    relative = (found.cell[inside] // 3 + PART[inside] // 3) % 4  # the field turns against the platform
    assert (relative == relative[0]).all()  # which of the four headings is the first is free
    assert (found.cell[inside] % 3 == PART[inside] % 3).all()
    # Peak to peak is twice the amplitude of a sine; each of the twelve parts begins and ends in full swing.
    assert found.figure_T(50e-6 + AMPLITUDES[PART] * SINE) == pytest.approx(2.0 * AMPLITUDES.sum(), rel=0.05)


def test_rates_tell_roll_from_yaw() -> None:
    """On a heading along the field both move its direction sideways."""
    swing, part = 0.1 * SINE[:400], TIME[:400] >= 40.0
    angles = np.zeros((400, 3))
    angles[~part, 0], angles[part, 2] = swing[~part], swing[part]
    field = np.array([20.0, 0.0, -44.0]) / np.hypot(20.0, 44.0)
    unit = Rotation.from_rotvec(angles).inv().apply(field)
    found = Manoeuvres.of(TIME[:400], unit, np.gradient(angles, TIME[:400], axis=0))
    inside = (found.cell >= 0) & (np.abs(TIME[:400] - 40.0) > 5.0)
    assert (found.cell[inside] % 3 == np.where(part[inside], 2, 0)).all()


def test_slow_changes_do_not_count() -> None:
    found = Manoeuvres.of(TIME, directions(0.1))
    slow = 50e-6 + 1e-6 * np.cos(2.0 * np.pi * TIME / 480.0)
    assert found.figure_T(slow) < 1e-3 * 12 * 2e-6


def test_without_manoeuvres_it_is_the_whole_record() -> None:
    found = Manoeuvres.of(TIME, directions(1e-4))
    assert found.n_found == 0
    assert found.figure_T(50e-6 + 3e-9 * SINE) == pytest.approx(6e-9, rel=0.02)


def test_turns_between_lines_are_none() -> None:
    heading = 0.05 * TIME + 0.1 * SINE
    turning = turn_about_z(heading).inv().apply(WORLD_T / np.linalg.norm(WORLD_T))
    steep = np.linalg.norm(WORLD_T[:2]) / np.linalg.norm(WORLD_T)
    assert 0.05 * steep < 0.03  # slow enough to be a line
    assert Manoeuvres.of(TIME, turning).n_found > 0
    fast = turn_about_z(0.2 * TIME + 0.1 * SINE).inv().apply(WORLD_T / np.linalg.norm(WORLD_T))
    assert Manoeuvres.of(TIME, fast).n_found == 0
