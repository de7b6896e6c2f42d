"""Long tracks over sensors whose gains err by a stated constant: what they claim against the truth.

Row after row, the noise of a reading looks like a field with another gain, so that gains whose effect is taken from the
readings seem to be known, and are wrong. The oracles: magpylib's field, and χ².
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

import magloc
from arrays.array import SensorArray
from arrays.sensor import Sensor
from magloc.chi_square import normalised_square
from magloc.levels import SENSOR_FALSE_ALARM
from magloc.measurement.nuisances import SensorErrors
from magloc.tracking.measurement import RowMeasurements
from magloc.tracking.rows import Row
from tests.oracles import magpylib_field

GAIN, NOISE_T, HZ = 0.02, 30e-6, 25.0
PLACES_M = [(x, y, 0.0) for y in (0.0, 0.03) for x in (-0.03, 0.0, 0.03)]
MOTION = magloc.OrnsteinUhlenbeck(0.12, 1.0, 1.0)


def board(**errors: float) -> SensorArray:
    return SensorArray(tuple(Sensor(f"s{i}", "vector", at, noise_T=NOISE_T, **errors) for i, at in enumerate(PLACES_M)))


def hand(seed: int, n: int) -> tuple[magloc.Readings, np.ndarray]:
    """Readings of a magnet of 1 A·m² that a hand moves by centimetres above the board, and its states (n, 6)."""
    rng = np.random.default_rng(seed)

    def smooth(width_s: float) -> np.ndarray:
        values = gaussian_filter1d(rng.normal(size=(n, 3)), width_s * HZ, axis=0, mode="wrap")
        return values / values.std(axis=0)

    position = np.array([0.0, 0.015, 0.055]) + smooth(0.8) * np.array([0.025, 0.02, 0.008])
    moment = Rotation.from_rotvec(0.5 * smooth(1.2)).apply([0.0, 0.0, 1.03])
    array, states = board(), np.concatenate([position, moment], axis=1)
    fields = np.array([magpylib_field(array.positions, state[:3], state[3:]) for state in states])
    values = array.readings_of(fields) * (1.0 + GAIN * rng.normal(size=18)) + NOISE_T * rng.normal(size=(n, 18))
    return magloc.Readings(values, time_s=np.arange(n) / HZ), states


def mean_nees(seeds: range, n: int) -> float:
    """NEES per dimension over the second half of some tracks, none of which may be flagged or start anew."""
    found = []
    for seed in seeds:
        readings, states = hand(seed, n)
        track = magloc.track(board(gain_uncertainty=GAIN), readings, motion=MOTION)
        assert track.tracked.all()
        assert not track.innovations.flagged
        assert track.status.count("outlier") <= SENSOR_FALSE_ALARM * n  # good rows that are excluded
        covariance = np.array([point.covariance for point in track])
        error = np.concatenate([track.position_m, track.moment_Am2], axis=1) - states
        found.append(normalised_square(error, covariance)[n // 2 :].mean() / 6.0)
    return float(np.mean(found))


class TestNees:
    """A track has one error for all rows, of its scale: four tracks are below 2 but for a chance of 1e-5."""

    def test_of_tracks(self) -> None:
        # With the effect taken from the readings it is above 4.
        assert 0.5 < mean_nees(range(31_000, 31_004), 400) < 2.0

    @pytest.mark.slow
    def test_of_long_tracks(self) -> None:
        assert 0.5 < mean_nees(range(31_200, 31_220), 1500) < 2.0


class TestEffect:
    def test_is_that_of_the_source(self) -> None:
        """Against differences of the readings by each gain."""
        array, (_, states) = board(gain_uncertainty=GAIN), hand(31_300, 2)
        fields = magpylib_field(array.positions, states[0, :3], states[0, 3:])
        measurement = RowMeasurements(array, 6).of(Row(0.0, array.readings_of(fields)), states[0])
        each = measurement.transform * array.readings_of(fields)
        np.testing.assert_allclose(measurement.effect, each, rtol=1e-9, atol=1e-9 * np.abs(each).max())

    @pytest.mark.parametrize(
        ("errors", "expected"),
        [
            ({"gain_uncertainty": 0.01}, True),
            ({"misalignment_rad": 0.01}, True),
            ({"offset_uncertainty_T": 1e-9}, False),
        ],
    )
    def test_depends_on_the_field(self, errors: dict[str, float], expected: bool) -> None:
        assert SensorErrors.of(board(**errors)).depends_on_field is expected
