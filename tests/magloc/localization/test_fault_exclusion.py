"""Fixes that a bad sensor does not ruin.

| what | who checks it |
|---|---|
| breakdown | fixes by the sensors that are left, the bad one being known |
| false drops | binomial distribution |
| recordings | positions that the robot reports |
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binom
from scipy.stats import chi2 as chi2_distribution

from arrays.array import SensorArray
from arrays.array_file import read_array
from arrays.geometries import cube, grid, tetrahedron
from arrays.sensor import Sensor
from magloc.chi_square import energy_threshold
from magloc.fields import dipole
from magloc.localization import reweighting
from magloc.localization.fault_exclusion import _Examination
from magloc.localization.locator import Locator, locate
from magloc.localization.reweighting import WeightedFits
from magloc.measurement.differences import predicted_channels
from magloc.measurement.rows import whitened_rows
from magloc.readings import Readings, read_readings
from magloc.truth import read_truth
from tests.passing_source import readings_of
from tests.plain_locator import plain_locator, random_sources

AMBIENT = np.array([2e-5, 0.0, 4.5e-5])
NOISE = 1e-9
SLOW = pytest.mark.slow
CUBE = cube(1.0, "vector", NOISE)


def readings_in_ambient_field(array, position, moment, rng):
    """Noisy readings (n, C) of sources (n, 3), the ambient field included."""
    fields = AMBIENT + dipole.field(array.positions, position[:, None], moment[:, None])
    clean = array.readings_of(fields)
    return clean + array.channel_noise_T * rng.normal(size=clean.shape)


def position_errors(fixes, position):
    found = [fix.solutions[0].position_m if fix.solutions else np.full(3, np.inf) for fix in fixes]
    return np.linalg.norm(np.array(found) - position, axis=1)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def on_cube(n, seed):
    """Readings (n, 24) of the cube, the sources' positions, and a random sensor for every row."""
    rng = np.random.default_rng(seed)
    position, moment = random_sources(rng, n, 1.5, 4.0, 200.0)
    return readings_in_ambient_field(CUBE, position, moment, rng), position, rng.integers(8, size=n)


def robust(array, readings):
    return Locator(array).fit_rows(readings)


def spikes(readings, sigmas, seed=1):
    return readings + sigmas * NOISE * np.random.default_rng(seed).normal(size=readings.shape)


FAULTS = {
    "dead": np.zeros_like,
    "stuck": lambda r: np.roll(r, 1, axis=0),
    "saturated": lambda r: np.full_like(r, 1e-4),
    **{f"spikes of {k:g} σ": lambda r, k=k: spikes(r, k) for k in (3, 5, 8, 12, 20, 100, 1e3, 1e4, 1e6)},
    **{f"one axis off by {k:g} σ": lambda r, k=k: r + k * NOISE * (np.arange(24) % 3 == 0) for k in (5, 10, 50, 1e4)},
}
GROSS = ("dead", "stuck", "saturated", "spikes of 100 σ", "spikes of 1e+06 σ", "one axis off by 10000 σ")
WORST = "one axis off by 10 σ"


def assert_breakdown(fault, n, seed):
    clean, position, which = on_cube(n, seed)
    bad = CUBE.channel_sensor == which[:, None]
    fixes = robust(CUBE, np.where(bad, FAULTS[fault](clean), clean))
    error = position_errors(fixes, position)
    remaining = position_errors(plain_locator(CUBE).fit_rows(np.where(bad, np.nan, clean)), position)
    assert np.median(error) <= 1.5 * np.median(remaining)
    assert rms(error) <= 1.5 * rms(remaining)
    if fault in GROSS:
        dropped = np.array([bool(fix.dropped_sensors) for fix in fixes])
        for fix, sensor in zip(fixes, which, strict=True):
            # A spike that a slightly different dipole explains is no contradiction.
            best = fix.solutions[0]
            credible = not fix.dropped_sensors and best.chi2 < chi2_distribution.ppf(0.999, best.dof)
            assert credible or fix.dropped_sensors == (CUBE.ids[sensor],)
        # Measured: one row of 200 with spikes of 100 σ, none with other faults. Its nearest sensor is off by 58 σ, less
        # than 0.1 % of what it reads; χ² is 28 of 15, and the error 2.2 times that of the remaining seven.
        assert np.mean(~dropped) <= (0.005 if fault == "spikes of 100 σ" else 0.0)
        assert_allclose(error[dropped], remaining[dropped], rtol=1e-3, atol=1e-6)


class TestBreakdown:
    """One of eight sensors is arbitrary: the error stays within 1.5 times that of the remaining seven."""

    @pytest.mark.parametrize(("n_gross", "n_others"), [(10, 100), pytest.param(20, 300, marks=SLOW)])
    @pytest.mark.parametrize("fault", ["dead", "stuck", "saturated", "spikes of 1e+06 σ", WORST])
    def test_one_of_eight(self, fault, n_gross, n_others):
        assert_breakdown(fault, n_gross if fault in GROSS else n_others, seed=0)

    @SLOW
    @pytest.mark.parametrize("fault", FAULTS)
    def test_one_of_eight_in_many_rows(self, fault):
        assert_breakdown(fault, 200 if fault in GROSS else 1500, seed=1)

    @pytest.mark.parametrize("n", [6, pytest.param(15, marks=SLOW)])
    @pytest.mark.parametrize("fault", ["dead", "saturated", "spikes of 1000 σ"])
    def test_two_of_eight(self, fault, n):
        """Gross faults of two sensors at once are both found."""
        clean, position, first = on_cube(n, seed=2)
        second = (first + np.random.default_rng(3).integers(1, 8, size=len(first))) % 8
        owner = CUBE.channel_sensor
        bad = (owner == first[:, None]) | (owner == second[:, None])
        fixes = robust(CUBE, np.where(bad, FAULTS[fault](clean), clean))
        error = position_errors(fixes, position)
        remaining = position_errors(plain_locator(CUBE).fit_rows(np.where(bad, np.nan, clean)), position)
        expected = [{CUBE.ids[a], CUBE.ids[b]} for a, b in zip(first, second, strict=True)]
        assert [set(fix.dropped_sensors) for fix in fixes] == expected
        assert_allclose(error, remaining, rtol=1e-3, atol=1e-6)

    @pytest.mark.parametrize("n", [10, pytest.param(25, marks=SLOW)])
    def test_with_missing_readings(self, n):
        """A sensor is silent, another one is wrong."""
        clean, position, which = on_cube(n, seed=4)
        owner = CUBE.channel_sensor
        missing = owner == ((which + 3) % 8)[:, None]
        missing[::2, 0] = True
        bad = owner == which[:, None]
        readings = np.where(missing, np.nan, np.where(bad, 0.0, clean))
        fixes = robust(CUBE, readings)
        remaining = position_errors(plain_locator(CUBE).fit_rows(np.where(bad, np.nan, readings)), position)
        assert [fix.dropped_sensors for fix in fixes] == [(CUBE.ids[sensor],) for sensor in which]
        assert_allclose(position_errors(fixes, position), remaining, rtol=1e-3, atol=1e-6)


class TestGoodSensors:
    """Nothing happens where no sensor contradicts the others."""

    @pytest.mark.parametrize("n", [3000, pytest.param(30_000, marks=SLOW)])
    def test_rows_without_a_bad_sensor_are_those_of_the_plain_fit(self, n):
        """Sensors are dropped from at most a thousandth of the rows; a false alarm in a thousand seeds."""
        clean, _, _ = on_cube(n, seed=5)
        plain = plain_locator(CUBE).fit_rows(clean)
        fixes = robust(CUBE, clean)
        dropped = [bool(fix.dropped_sensors) for fix in fixes]
        assert sum(dropped) <= binom.ppf(0.999, n, 1e-3)
        kept = ~np.array(dropped)
        assert_array_equal(fixes.position_m[kept], plain.position_m[kept])
        assert_array_equal(fixes.chi2[kept], plain.chi2[kept])

    @pytest.mark.parametrize("n", [40, pytest.param(400, marks=SLOW)])
    def test_too_small_noise_is_no_bad_sensor(self, n):
        """Everything fits badly if the noise is five times what is stated: one row in thirty loses a sensor."""
        rng = np.random.default_rng(6)
        position, moment = random_sources(rng, n, 1.5, 4.0, 200.0)
        readings = readings_in_ambient_field(cube(1.0, "vector", 5 * NOISE), position, moment, rng)
        fixes = robust(CUBE, readings)
        assert np.mean([bool(fix.dropped_sensors) for fix in fixes]) <= 0.05
        plain = position_errors(plain_locator(CUBE).fit_rows(readings), position)
        assert rms(position_errors(fixes, position)) <= 1.1 * rms(plain)

    def test_too_few_sensors_to_tell(self):
        """Three vector sensors are exactly determined: whatever they read, nothing contradicts."""
        array = CUBE.subset(["s1", "s4", "s7"])
        rng = np.random.default_rng(7)
        position, moment = random_sources(rng, 10, 1.5, 4.0, 200.0)
        readings = readings_in_ambient_field(array, position, moment, rng)
        readings[:, :3] = 0.0
        assert not any(fix.dropped_sensors for fix in robust(array, readings))

    def test_four_sensors_keep_three(self):
        """Any three of four vector sensors fit exactly: none of the four can be named."""
        array = tetrahedron(1.5, "vector", NOISE)
        rng = np.random.default_rng(8)
        position, moment = random_sources(rng, 10, 2.0, 4.0, 300.0)
        readings = readings_in_ambient_field(array, position, moment, rng)
        readings[:, 3:6] = 0.0
        for fix in robust(array, readings):
            assert not fix.dropped_sensors

    def test_no_signal(self):
        (fix,) = robust(CUBE, np.tile(AMBIENT, 8)[None])
        assert not fix.solutions
        assert not fix.dropped_sensors
        assert "no signal" in fix.reason

    def test_progress_counts_all_rows(self):
        counts: list[int] = []
        clean, _, _ = on_cube(9, seed=9)
        Locator(CUBE).fit_rows(clean, progress=counts.append)
        assert sum(counts) == 9


def scattered_scalars(rng):
    """Twelve scalar sensors within 1.5 m of the origin along every axis."""
    places = rng.uniform(-1.5, 1.5, (12, 3))
    sensors = [Sensor(f"t{i}", "scalar", tuple(place), 1e-11) for i, place in enumerate(places.tolist())]
    return SensorArray(tuple(sensors), ambient_T=tuple(AMBIENT.tolist()))


class TestOtherLocators:
    """Whatever fixes the rows, a bad sensor is found."""

    @pytest.mark.parametrize("reading_T", [0.0, pytest.param(6e-5, marks=SLOW)])
    @pytest.mark.parametrize("n", [1, pytest.param(12, marks=SLOW)])
    def test_one_of_twelve_scalar_sensors(self, n, reading_T):
        rng = np.random.default_rng(10)
        array = scattered_scalars(rng)
        position, moment = random_sources(rng, n, 2.8, 5.0, 300.0)
        readings = readings_in_ambient_field(array, position, moment, rng)
        which = rng.integers(12, size=n)
        readings[np.arange(n), which] = reading_T
        fixes = robust(array, readings)
        assert [fix.dropped_sensors for fix in fixes] == [(array.ids[sensor],) for sensor in which]
        assert np.median(position_errors(fixes, position)) <= 1e-3
        assert position_errors(fixes, position).max() <= 1e-2

    @pytest.mark.slow
    def test_the_ambient_field_of_every_row_is_used(self):
        rng = np.random.default_rng(11)
        array = scattered_scalars(rng)
        position, moment = random_sources(rng, 1, 2.8, 5.0, 300.0)
        readings = readings_in_ambient_field(array, position, moment, rng)
        readings[:, 5] = 0.0
        fixes = Locator(replace(array, ambient_T=None)).fit_rows(readings, AMBIENT[None])
        assert [fix.dropped_sensors for fix in fixes] == [("t5",)]
        assert position_errors(fixes, position).max() <= 1e-2

    @pytest.mark.parametrize("fault", ["dead", pytest.param("spikes of 1000 σ", marks=SLOW)])
    def test_two_dipoles_and_one_of_sixteen_sensors(self, fault):
        rng = np.random.default_rng(12)
        grid = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 4)]), axis=-1).reshape(-1, 2)
        sensors = [Sensor(f"s{i:02d}", "vector", (x, y, 0.0), 5e-10) for i, (x, y) in enumerate(grid.tolist())]
        array = SensorArray(tuple(sensors))
        position = np.array([[-0.6, 0.1, -1.0], [0.7, -0.3, -1.3]])
        moment = random_sources(rng, 2, 1.0, 1.0, 15.0)[1]
        fields = AMBIENT + dipole.total_field(array.positions, position, moment)
        clean = array.readings_of(fields) + 5e-10 * rng.normal(size=(2, 48))
        which = rng.integers(16, size=2)
        bad = array.channel_sensor == which[:, None]
        arbitrary = np.zeros_like(clean) if fault == "dead" else spikes(clean, 1000.0)
        fixes = Locator(array, sources="auto").fit_rows(np.where(bad, arbitrary, clean))
        assert [fix.dropped_sensors for fix in fixes] == [(array.ids[sensor],) for sensor in which]
        for fix in fixes:
            found = np.array([source.position_m for source in fix.solutions[0].sources])
            assert len(found) == 2
            assert np.linalg.norm(found[:, None] - position, axis=-1).min(axis=0).max() <= 0.02

    def test_a_moment_at_a_known_place(self):
        array = replace(cube(1.0, "scalar", 1e-11), ambient_T=tuple(AMBIENT.tolist()))
        rng = np.random.default_rng(13)
        place = np.array([3.0, 1.0, -0.5])
        moment = random_sources(rng, 10, 1.0, 1.0, 300.0)[1]
        readings = readings_in_ambient_field(array, np.tile(place, (10, 1)), moment, rng)
        which = rng.integers(8, size=10)
        readings[np.arange(10), which] += 1e-8
        fixes = Locator(array, position_m=place).fit_rows(readings)
        assert [fix.dropped_sensors for fix in fixes] == [(array.ids[sensor],) for sensor in which]
        error = [np.linalg.norm(fix.solutions[0].moment_Am2 - m) for fix, m in zip(fixes, moment, strict=True)]
        assert max(error) <= 1.0


class TestStartsThatMeet:
    """Reweighting goes on from one of the fits of a row that have come together: where all go, it goes."""

    def test_it_ends_where_all_of_them_end(self, monkeypatch):
        readings, _, which = on_cube(20, seed=18)
        readings += 1e3 * NOISE * np.isin(CUBE.channel_sensor, [0, 3]) * (1.0 + np.arange(24) % 5)
        readings += 50.0 * NOISE * (CUBE.channel_sensor == which[:, None])
        refined = Locator(CUBE).fit_rows(readings)
        plain, fits = WeightedFits._refine_rows, []
        monkeypatch.setattr(WeightedFits, "_refine_rows", lambda *of, **to: fits.append(len(of[2])) or plain(*of, **to))
        Locator(CUBE).fit_rows(readings)
        met = sum(fits)
        fits.clear()
        monkeypatch.setattr(reweighting, "_SAME_WEIGHT", 0.0)
        every = Locator(CUBE).fit_rows(readings)
        assert met < 0.8 * sum(fits)
        assert sum(map(bool, every.dropped_sensors)) >= 10
        assert refined.dropped_sensors == every.dropped_sensors
        assert_array_equal(refined.position_m, every.position_m)


class TestWithoutOneSensor:
    """Deleting a sensor moves a fit a little: one refinement of it is what a search without that sensor finds."""

    def test_refined_is_searched(self):
        clean, _, _ = on_cube(5, seed=16)
        locator = Locator(CUBE, exclude_faulty=False)
        plain, mask, rows = locator.fit_rows(clean), np.ones(24, dtype=bool), np.arange(5)
        examination = _Examination(CUBE, lambda _, other: locator.fit_rows(other), mask, rows, clean, None, True)
        for row, starts in examination._refine_without_one(list(plain), rows).items():
            assert len(starts) == 4
            assert [start.without for start in starts].count(frozenset()) == 1
            for start in starts[1:]:
                (sensor,) = start.without
                without = clean[row].copy()
                without[CUBE.channel_sensor == sensor] = np.nan
                searched = locator.fit(without).solutions[0]
                place = examination.problem.position(start.q)[0]
                assert_allclose(place, searched.position_m, rtol=1e-4)
                assert start.explains


class TestRecording:
    """A magnet over thirty sensors."""

    @pytest.fixture
    def recording(self, data_folder):
        """Array with the noise of these readings, every thirtieth set of readings, and where the magnet was in x-y."""
        folder = data_folder / "magnet-array"
        array = read_array(folder / "array.toml")
        sensors = tuple(replace(s, noise_T=2e-6) for s in array.sensors)
        array = replace(array, sensors=sensors, noise_fraction=0.03)
        readings = read_readings(folder / "readings.csv", array, sensors=array.ids).values_T[::30]
        return array, readings, read_truth(folder / "truth.csv").position_m[::30, :2]

    def test_no_sensor_is_dropped(self, recording):
        array, readings, _ = recording
        plain = plain_locator(array).fit_rows(readings)
        fixes = robust(array, readings)
        assert not any(fix.dropped_sensors for fix in fixes)
        for fix, same in zip(fixes, plain, strict=True):
            assert_allclose(fix.solutions[0].position_m, same.solutions[0].position_m, rtol=1e-12)

    @pytest.mark.parametrize("reading_T", [1e-3, *(pytest.param(value, marks=SLOW) for value in (0.0, -5e-5))])
    @pytest.mark.parametrize("sensor", [7, pytest.param(19, marks=SLOW)])
    @pytest.mark.parametrize("every", [3, pytest.param(1, marks=SLOW)])
    def test_one_sensor_that_reads_a_constant(self, recording, every, sensor, reading_T):
        array, readings, truth = recording
        readings, truth = readings[::every].copy(), truth[::every]
        readings[:, 3 * sensor : 3 * sensor + 3] = reading_T
        error = [
            np.linalg.norm(fix.solutions[0].position_m[:2] - of_row)
            for fix, of_row in zip(robust(array, readings), truth, strict=True)
        ]
        assert np.median(error) <= 0.25e-3
        assert np.max(error) <= 1.5e-3


class TestManySensors:
    """A board of 30: what every deletion would do to the fit decides which fits and searches there are."""

    BOARD = grid(6, 5, 0.08, noise_T=2e-7)

    @pytest.fixture
    def board(self):
        """Noise (n, C) of one, and clean readings of sources below the board."""
        rng = np.random.default_rng(17)
        position, moment = random_sources(rng, 12, 0.15, 0.45, 1.0)
        position[:, 2] = -np.abs(position[:, 2]) - 0.05
        clean = self.BOARD.readings_of(
            AMBIENT + dipole.field(self.BOARD.positions, (self.BOARD.centroid + position)[:, None], moment[:, None])
        )
        return clean, 2e-7 * rng.normal(size=clean.shape)

    def test_noise_twice_what_is_stated_is_searched_once(self, board, monkeypatch):
        """Each search is of all rows: no sensor stands out, and nothing is looked for without one."""
        clean, noise = board
        asked = []
        whole = Locator.__dict__["_fit_with_all_sensors"]
        monkeypatch.setattr(Locator, "_fit_with_all_sensors", lambda *args: asked.append(len(args[1])) or whole(*args))
        fixes = Locator(self.BOARD, body_length_m=0.0).fit_rows(clean + 2.0 * noise)
        assert fixes.misfit.all()
        assert not any(fixes.dropped_sensors)
        assert asked == [12]

    def test_two_gross_faults(self, board):
        """One after another: without the first the next is beyond doubt."""
        clean, noise = board
        readings = clean + noise
        which = np.random.default_rng(18).permuted(np.tile(np.arange(30), (12, 1)), axis=1)[:, :2]
        for k, sigmas in enumerate((50.0, 80.0)):
            readings[np.arange(12), 3 * which[:, k] + k] += sigmas * 2e-7
        fixes = Locator(self.BOARD, body_length_m=0.0).fit_rows(readings)
        named = [set(fix.dropped_sensors) for fix in fixes]
        assert named == [{self.BOARD.ids[sensor] for sensor in row} for row in which]

    @pytest.mark.parametrize("sigmas", [100.0, 1e4])
    def test_a_sensor_that_draws_the_source_to_itself(self, board, sigmas):
        """It has no residual, as the source beside it explains it: that nothing else checks it gives it away."""
        clean, noise = board
        readings, which = clean + noise, np.arange(12) * 7 % 30
        readings[np.arange(12), 3 * which + 2] += sigmas * 2e-7
        fixes = Locator(self.BOARD, body_length_m=0.0).fit_rows(readings)
        assert [fix.dropped_sensors for fix in fixes] == [(self.BOARD.ids[sensor],) for sensor in which]


class TestNoiseAlone:
    """Rows are decided by their energy before any sensor is left out."""

    N_DIFFERENCES = 21  # eight sensors of three axes, without a common field

    @pytest.fixture
    def unit_signal(self):
        """Readings of a source whose energy is one."""
        signal = predicted_channels(CUBE, np.array([[0.3, 1.4, -0.8]]), np.array([[1.0, 2.0, -1.0]]))
        (rows,) = whitened_rows(CUBE, signal, None, 1)
        return signal / np.sqrt(rows.energy)

    def test_no_sensor_is_left_out(self, monkeypatch):
        asked = []
        whole = Locator.__dict__["_fit_with_all_sensors"]
        monkeypatch.setattr(Locator, "_fit_with_all_sensors", lambda *args: asked.append(len(args[1])) or whole(*args))
        noise = np.random.default_rng(5).normal(size=(20, CUBE.n_channels)) * NOISE
        (rows,) = whitened_rows(CUBE, noise, None, 20)
        assert np.all(rows.energy <= energy_threshold(self.N_DIFFERENCES))
        fixes = Locator(CUBE, sources="auto").fit_rows(noise)
        assert not fixes.detected.any()
        assert not fixes.solved.any()
        assert asked == [20]

    def test_a_source_is_found_that_its_energy_alone_does_not_tell_from_noise(self, unit_signal):
        energy = 0.95 * energy_threshold(self.N_DIFFERENCES)
        fix = Locator(CUBE, sources="auto").fit_rows(unit_signal * np.sqrt(energy))[0]
        assert not fix.detected
        assert_allclose(fix.best.position_m, [0.3, 1.4, -0.8], rtol=1e-3)


@pytest.mark.parametrize("n_readings", range(7))
@pytest.mark.parametrize("sources", [1, "auto"])
def test_a_row_of_too_few_readings_has_no_fix_and_leaves_the_others(
    n_readings: int, sources: Literal[1, "auto"]
) -> None:
    """Down to none at all, or those of one sensor, which make no difference."""
    array = tetrahedron(1.0)
    readings = readings_of(array, np.tile([3.0, 1.0, -0.5], (3, 1)), np.tile([0.0, 20.0, 90.0], (3, 1)))
    readings[1, n_readings:] = np.nan
    fixes = locate(array, Readings(readings), sources=sources)
    n_differences = max(0, n_readings - 3)
    reason = f"{n_readings} readings give {n_differences} independent differences, 6 are needed"
    assert fixes.reason == ["", reason, ""]
    others = locate(array, Readings(readings[[0, 2]]), sources=sources)
    assert_array_equal(fixes.position_m[[0, 2]], others.position_m)
