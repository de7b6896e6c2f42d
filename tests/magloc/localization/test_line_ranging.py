"""Distance along a line: the loop's field, exact recovery, and a recording of a coil moved away from a magnetometer.

| what | who checks it |
|---|---|
| loop_field | magpylib's circular current |
| fit_source_line | the simulated line |
| distances | the stage's positions, on rows that the fit has not seen |
"""

from __future__ import annotations

from pathlib import Path

import magpylib
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from magloc import SourceLine, distance_along_line, fit_source_line
from magloc.fields import dipole
from magloc.fields.coil import loop_field
from tests import oracles

RADIUS = 0.05
STAGE = np.arange(81) * 0.01
# Of the half differences: what neighbouring rows differ by, and by how much the current falls while the coil warms up
# within one reading.
NOISE_T = 0.03e-6
NOISE_FRACTION = 0.02


def random_line(seed, radius):
    rng = np.random.default_rng(seed)
    direction = Rotation.random(random_state=seed).as_matrix()[0]
    start = 0.15 * direction + 0.03 * rng.normal(size=3)
    return SourceLine(start, direction, 1.5 * direction + 0.4 * rng.normal(size=3), radius, 0.0, 0, True)


class TestLoopField:
    @pytest.mark.parametrize("seed", range(5))
    def test_magpylib(self, seed):
        rng = np.random.default_rng(seed)
        turn = Rotation.random(random_state=seed)
        centre, moment = rng.normal(size=3), turn.apply([0.0, 0.0, 2.0])
        # On the axis, a nanometre beside it, near the wire, in the plane, far away.
        inside = np.array(
            [[0, 0, 0.1], [1e-9, 0, 0.1], [1e-5, 0, 0.1], [0.049, 0, 0.001], [0.2, 0.1, 0], [3, 2, 5], [0, 0, 0]]
        )
        points = centre + turn.apply(np.concatenate([inside, 0.2 * rng.normal(size=(50, 3))]))
        coil = magpylib.current.Circle(
            current=2.0 / (np.pi * RADIUS**2), diameter=2 * RADIUS, position=centre, orientation=turn
        )
        expected = coil.getB(points) * (oracles.K / (magpylib.mu_0 / (4.0 * np.pi)))
        found = loop_field(points, centre, moment, RADIUS)
        error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)
        assert error.max() < 1e-9

    def test_a_small_loop_is_a_dipole(self):
        points = np.array([[0.3, 0.2, 0.5], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
        moment = np.array([1.0, 2.0, 3.0])
        expected = dipole.field(points, np.zeros(3), moment)
        assert_allclose(
            loop_field(points, np.zeros(3), moment, 1e-4), expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max()
        )
        assert_allclose(loop_field(points, np.zeros(3), moment, 0.0), expected)

    def test_the_wire_is_singular(self):
        assert np.isnan(loop_field([RADIUS, 0.0, 0.0], np.zeros(3), [0.0, 0.0, 1.0], RADIUS)).all()

    def test_negative_radius(self):
        with pytest.raises(ValueError, match=r"Input radius_m must not be negative; instead received -1\.0\."):
            loop_field(np.ones(3), np.zeros(3), np.ones(3), -1.0)


class TestSimulatedLines:
    @pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3))])
    def test_dipole(self, seed):
        line = random_line(seed, 0.0)
        found = fit_source_line(STAGE[::2], line.field(STAGE[::2]), 1e-12, noise_fraction=0.01)
        sign = np.sign(found.start_m @ line.start_m)  # the line inverted through the sensor has the same field
        assert found.converged
        assert_allclose(sign * found.start_m, line.start_m, atol=1e-6)
        assert_allclose(sign * found.direction, line.direction, atol=1e-6)
        assert_allclose(found.moment_Am2, line.moment_Am2, atol=1e-5)
        distance, deviation = distance_along_line(found, line.field(STAGE[1::2]), 1e-9, within_m=(-0.05, 1.0))
        assert_allclose(distance, STAGE[1::2], atol=1e-5)
        assert np.all(np.diff(deviation) > 0.0)

    @pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
    def test_coil(self, seed):
        line = random_line(seed, 0.08)
        found = fit_source_line(STAGE, line.field(STAGE), 1e-12, noise_fraction=0.001, coil=True)
        assert found.radius_m == pytest.approx(0.08, abs=1e-4)
        distance, _ = distance_along_line(found, line.field(STAGE), 1e-9, within_m=(-0.05, 1.0))
        assert_allclose(distance, STAGE, atol=1e-4)

    def test_deviations_are_as_large_as_stated(self):
        """2,000 distances at 0.3 m: a false alarm in 1e-3 of all seeds."""
        rng = np.random.default_rng(0)
        line = random_line(0, 0.0)
        readings = line.field(0.3) + 1e-9 * rng.normal(size=(2000, 3))
        distance, deviation = distance_along_line(line, readings, 1e-9, within_m=(0.0, 1.0))
        squares = np.mean(((distance - 0.3) / deviation) ** 2)
        assert abs(squares - 1.0) < 3.29 * np.sqrt(2.0 / 2000)

    @pytest.mark.parametrize(
        ("distance", "field", "noise", "sentence"),
        [
            (STAGE, np.ones((80, 3)), 1e-9, r"must have shapes \(n,\) and \(n, 3\)"),
            (STAGE, np.zeros((81, 3)), 1e-9, "must be finite, and no field zero"),
            (STAGE, np.ones((81, 3)), 0.0, r"Input noise_T must be positive and finite; instead received 0\.0\."),
            (STAGE[:2], np.ones((2, 3)), 1e-9, "more numbers than the 8 unknowns; instead received 6"),
        ],
    )
    def test_misuse(self, distance, field, noise, sentence):
        with pytest.raises(ValueError, match=sentence):
            fit_source_line(distance, field, noise)

    def test_bounds(self):
        line = random_line(0, 0.0)
        with pytest.raises(ValueError, match="Input within_m must be two finite bounds"):
            distance_along_line(line, np.ones(3), 1e-9, within_m=(1.0, 0.0))


@pytest.fixture
def coil_field_T(data_folder: Path):
    """Field of the coil alone: half the difference of the readings with the current either way."""
    path = data_folder / "coil-range" / "exp_1_dump.mat"
    record = loadmat(path, variable_names=["forward_readings_averaged", "backward_readings_averaged"])
    return 0.5e-6 * (record["forward_readings_averaged"] - record["backward_readings_averaged"])


class TestRecording:
    """One tri-axial magnetometer, a coil moved from 0 to 800 mm; every distance is of a row that the fit has not seen.

    The second record of the set has no field of a coil in it.
    """

    def errors(self, field, coil):
        """Errors of both halves of the rows, the line fitted to the other half, and their standard deviations."""
        error, deviation = np.empty(81), np.empty(81)
        lines = []
        for first in (0, 1):
            seen, unseen = np.arange(1 - first, 81, 2), np.arange(first, 81, 2)
            line = fit_source_line(STAGE[seen], field[seen], NOISE_T, noise_fraction=NOISE_FRACTION, coil=coil)
            found, deviation[unseen] = distance_along_line(
                line, field[unseen], NOISE_T, noise_fraction=NOISE_FRACTION, within_m=(-0.05, 1.2)
            )
            error[unseen] = found - STAGE[unseen]
            lines.append(line)
        return error, deviation, lines

    def rms(self, error, rows):
        return np.sqrt(np.mean(error[rows] ** 2))

    @pytest.mark.slow
    def test_coil(self, coil_field_T):
        """6.6 mm up to 0.52 m, where noise alone allows 1 cm; 8.8 mm at 15 times the noise; 13.1 mm over all rows.

        At 0.8 m the field is 8 times the noise, which there is 3 cm of distance: over all rows noise alone makes 15 mm.
        """
        error, deviation, lines = self.errors(coil_field_T, coil=True)
        signal = np.linalg.norm(coil_field_T, axis=1)
        assert np.count_nonzero(deviation < 0.01) >= 52
        assert self.rms(error, deviation < 0.01) < 0.008
        assert self.rms(error, signal > 15.0 * NOISE_T) < 0.01
        assert self.rms(error, deviation < np.inf) < 0.015
        for line in lines:
            assert line.converged
            assert line.chi2 < 1.3 * line.dof
            assert np.linalg.norm(line.start_m) == pytest.approx(0.151, abs=0.005)
            assert line.radius_m == pytest.approx(0.121, abs=0.005)

    @pytest.mark.slow
    def test_a_dipole_does_not_describe_the_near_rows_as_well(self, coil_field_T):
        """9.1 mm where the coil's loop has 6.6, χ² of 1.8 per degree of freedom instead of 1.1."""
        error, deviation, lines = self.errors(coil_field_T, coil=False)
        assert self.rms(error, deviation < 0.01) < 0.01
        for line in lines:
            assert line.chi2 > 1.5 * line.dof
