"""What the track of a point would be if its source were a body, drawn from the prior of bodies or by magpylib."""

from __future__ import annotations

import math

import magpylib
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import magloc
from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from magloc.fields.multipole import finite_body_errors

PLACE, MOMENT = np.array([0.3, 3.0, -0.4]), np.array([30.0, -20.0, 40.0])
ARRAY = tetrahedron(1.2, noise_T=2e-9)
REST = magloc.RandomWalk(speed_m_s=1e-5, turn_rad_s=1e-5)
N_ROWS = 40


def flown(array: SensorArray) -> tuple[NDArray[np.float64], NDArray[np.float64], Rotation]:
    """Places (rows, N, 3) of the sensors of an array that passes the source and turns, and its pose."""
    origins = np.stack([np.linspace(-1.5, 1.5, N_ROWS), np.zeros(N_ROWS), np.zeros(N_ROWS)], axis=1)
    turns = Rotation.from_rotvec(np.linspace([0.0, 0.0, -0.3], [0.2, 0.0, 0.5], N_ROWS))
    return origins[:, None] + np.einsum("nij,sj->nsi", turns.as_matrix(), array.positions), origins, turns


def track_of(fields: NDArray[np.float64], rng: np.random.Generator, array: SensorArray = ARRAY) -> magloc.Track:
    """The track of fields (rows, N, 3) in the world at the sensors."""
    _, origins, turns = flown(array)
    seen = np.einsum("nji,nsj->nsi", turns.as_matrix(), fields).reshape(N_ROWS, -1)
    noise = array.channel_noise_T * rng.normal(size=seen.shape)
    pose = {"array_position_m": origins, "array_rotation": turns}
    readings = magloc.Readings(seen + noise, time_s=0.2 * np.arange(N_ROWS), **pose)
    return magloc.track(array, readings, motion=REST)


def nees(track: magloc.Track) -> float:
    """Per dimension, of the last row."""
    off = np.concatenate([track.position_m[-1] - PLACE, track.moment_Am2[-1] - MOMENT])
    return float(off @ np.linalg.solve(track.covariance[-1], off)) / 6.0


class TestBodyFactor:
    def test_draws_of_bodies_err_as_told(self) -> None:
        """Of ten tracks of 14 normal numbers each, of which some four count: the mean is within 2.2 at 1 in 500."""
        rng = np.random.default_rng(8)
        sensors, _, _ = flown(ARRAY)
        exact, separation = magloc.dipole.field(sensors, PLACE, MOMENT), sensors - PLACE
        length_m = 0.25 * float(np.linalg.norm(separation, axis=-1).min())
        errors = finite_body_errors(separation, MOMENT, length_m)
        tracks = [track_of(exact + errors @ rng.normal(size=14), rng) for _ in range(10)]
        told = [track.innovations.body_factor for track in tracks]
        assert max(told) < 1.2 * min(told)
        assert 1.0 / 2.2 < np.mean([nees(track) for track in tracks]) / np.mean(np.square(told)) < 2.2

    def test_a_bar_is_told_of_below_the_table(self) -> None:
        """magpylib's, a quarter of its distance long, as the array sees it."""
        sensors, _, _ = flown(ARRAY)
        along = MOMENT / np.linalg.norm(MOMENT)
        bar = magpylib.magnet.Cuboid(
            magnetization=np.array([0.0, 0.0, np.linalg.norm(MOMENT)]) / (0.6 * 0.1 * 0.1),
            dimension=(0.1, 0.1, 0.6),
            position=PLACE,
            orientation=Rotation.align_vectors([along], [[0.0, 0.0, 1.0]])[0],
        )
        track = track_of(bar.getB(sensors.reshape(-1, 3)).reshape(sensors.shape), np.random.default_rng(1))
        test = track.innovations
        assert not test.flagged  # it looks like a point
        assert 4.0 < nees(track) < 4.0 * test.body_factor**2
        assert f"about {test.body_factor:.2g} times their standard deviations" in track.table()
        assert test.json["body_factor"] == test.body_factor

    def test_weak_sources_have_none(self) -> None:
        noisy = tetrahedron(1.2, noise_T=3e-8)
        sensors, _, _ = flown(noisy)
        test = track_of(magloc.dipole.field(sensors, PLACE, MOMENT), np.random.default_rng(2), noisy).innovations
        assert test.body_factor == pytest.approx(1.0, abs=0.2)
        assert not test.caution

    def test_without_a_track_nothing_is_told(self) -> None:
        readings = 1e-10 * np.random.default_rng(3).normal(size=(5, 12))
        assert math.isnan(magloc.track(ARRAY, readings).innovations.body_factor)
