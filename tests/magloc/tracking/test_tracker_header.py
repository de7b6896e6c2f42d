"""The tracker of the C++ headers. The oracles are magloc.Tracker, and the truth of simulated rows."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

import arrays
import magloc
from magloc import core
from magloc.fields.dipole import field
from magloc.tracking.rows import Row
from tests.sanitized import check_random_updates
from tests.test_core_examples import COMPILER, EXAMPLES

Array = NDArray[np.float64]
HERE = Path(__file__).parent
PLACES = ((0.0, 0.0, 0.1), (0.08, 0.0, 0.0), (-0.04, 0.07, 0.0), (-0.04, -0.07, 0.0))
NOISE_T, EARTH_T, MOMENT = 2e-9, np.array([2e-5, 1e-6, -4.3e-5]), np.array([0.3, -0.2, 0.4])
DETECTOR = arrays.SensorArray(tuple(arrays.Sensor(f"s{i}", "vector", at, NOISE_T) for i, at in enumerate(PLACES)))
OK, BAD_TIME, BAD_READINGS, NO_SIGNAL, NO_READINGS, NO_SOURCE, CONTRADICTS, LOST = range(8)


def passage(seed: int, n: int = 150) -> tuple[Array, Array, Array]:
    """Times, readings (n, 12) and places of a magnet that passes in front of the sensors."""
    rng = np.random.default_rng(seed)
    time_s = 0.1 * np.arange(n)
    places = np.stack([-0.3 + 0.04 * time_s, np.full(n, rng.uniform(-0.2, 0.2)), np.full(n, 0.35)], axis=1)
    clean = np.stack([[field(np.array(at), place, MOMENT) for at in PLACES] for place in places]) + EARTH_T
    return time_s, clean.reshape(n, 12) + NOISE_T * rng.standard_normal((n, 12)), places


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if COMPILER is None:
        pytest.skip("needs a compiler")
    built = tmp_path_factory.mktemp("tracker") / "rows"
    flags = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{core.include_dir()}", f"-I{EXAMPLES}"]
    subprocess.run([COMPILER, *flags, str(HERE / "tracker_rows.cpp"), "-o", str(built)], check=True)
    return built


def run_rows(program: Path, time_s: Array, readings_T: Array) -> Array:
    text = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in np.column_stack([time_s, readings_T]))
    done = subprocess.run([program], input=text, check=True, capture_output=True, encoding="utf-8")
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=np.float64)


def python_track(time_s: Array, readings_T: Array) -> list[magloc.tracking.results.TrackPoint]:
    tracker = magloc.Tracker(DETECTOR, magloc.RandomWalk(speed_m_s=0.1, turn_rad_s=0.1))
    return [tracker.update(Row(t, row)) for t, row in zip(time_s.tolist(), readings_T, strict=True)]


@pytest.mark.parametrize("seed", range(3))
def test_as_python(program: Path, seed: int) -> None:
    """The starts differ, by 0.3 σ at most. The random walk forgets them: after eight seconds by ten digits."""
    time_s, readings_T, _ = passage(seed)
    found, points = run_rows(program, time_s, readings_T), python_track(time_s, readings_T)
    assert (found[:, :2] == [OK, 1]).all()
    position = np.stack([point.position_m for point in points])
    sigma = np.stack([np.sqrt(np.diagonal(point.covariance))[:6] for point in points])
    apart = (np.abs(found[:, 2:5] - position) / sigma[:, :3]).max(axis=1)
    assert apart[0] < 0.3
    assert (apart[30:] < 1e-2).all()
    assert (apart[80:] < 1e-9).all()
    np.testing.assert_allclose(found[80:, 8:14], sigma[80:], rtol=1e-10)
    np.testing.assert_allclose(found[80:, 14], [point.nis for point in points[80:]], rtol=1e-9)


def test_errors_are_those_that_it_states(program: Path) -> None:
    """χ² of the places of 30 passages; false alarms once in a million."""
    total = 0.0
    for seed in range(100, 130):
        time_s, readings_T, places = passage(seed, 80)
        found = run_rows(program, time_s, readings_T)
        total += (((found[79, 2:5] - places[79]) / found[79, 8:11]) ** 2).max()
    assert total < chi2.ppf(1.0 - 1e-6, 3 * 30)


def test_a_silent_sensor_and_three_silent_ones(program: Path) -> None:
    """One is left out, as in Python; with two alone the track goes on without readings."""
    time_s, readings_T, places = passage(5)
    readings_T[100:110, 9:12] = np.nan
    found, points = run_rows(program, time_s, readings_T), python_track(time_s, readings_T)
    assert (found[:, 0] == OK).all()
    position = np.stack([point.position_m for point in points])
    np.testing.assert_allclose(found[90:, 2:5], position[90:], rtol=0, atol=1e-9)
    readings_T[100:110, 6] = np.nan  # one component of a sensor: it is left out
    found = run_rows(program, time_s, readings_T)
    assert (found[100:110, 0] == NO_READINGS).all()
    assert found[109, 8] > 5.0 * found[99, 8]
    assert (np.abs(found[110:, 2:5] - places[110:]) < 5.0 * found[110:, 8:11]).all()


def test_contradictions(program: Path) -> None:
    """Two rows are not used; after the third the track is lost, and the next row starts another."""
    time_s, readings_T, places = passage(6)
    for wrong, after in ((2, [CONTRADICTS] * 2), (3, [CONTRADICTS] * 2 + [LOST])):
        disturbed = readings_T.copy()
        disturbed[100 : 100 + wrong, 2] += 1e-6
        found = run_rows(program, time_s, disturbed)
        assert (found[100 : 100 + wrong, 0] == after).all()
        assert (found[100 + wrong :, 0] == OK).all()
        assert (np.abs(found[-1, 2:5] - places[-1]) < 5.0 * found[-1, 8:11]).all()


def test_without_a_magnet(program: Path) -> None:
    rng = np.random.default_rng(7)
    noise = np.tile(EARTH_T, 4) + NOISE_T * rng.standard_normal((50, 12))
    assert (run_rows(program, np.arange(50.0), noise)[:, :2] == [NO_SIGNAL, 0]).all()
    wild = np.tile(EARTH_T, 4) + 1e-6 * rng.standard_normal((50, 12))
    assert (run_rows(program, np.arange(50.0), wild)[:, :2] == [NO_SOURCE, 0]).all()


@pytest.mark.parametrize(
    ("time_s", "reading_T", "status"),
    [(4.9, 0.0, BAD_TIME), (np.nan, 0.0, BAD_TIME), (5.05, np.inf, BAD_READINGS), (5.05, 2.0, BAD_READINGS)],
)
def test_a_bad_row_changes_nothing(program: Path, time_s: float, reading_T: float, status: int) -> None:
    times, readings_T, _ = passage(8, 60)
    wrong = readings_T[50].copy()
    wrong[4] += reading_T
    found = run_rows(program, np.insert(times, 51, time_s), np.insert(readings_T, 51, wrong, axis=0))
    assert found[51, 0] == status
    np.testing.assert_array_equal(np.delete(found, 51, axis=0), run_rows(program, times, readings_T))


@pytest.mark.parametrize(
    ("count", "flags"), [(2_000, ["-DQUICK"]), pytest.param(500_000, [], marks=pytest.mark.slow)]
)  # half a millisecond each
def test_random_updates_never_crash(count: int, flags: list[str], tmp_path: Path) -> None:
    """NaN, infinities, numbers of any size, times that go back, and magnets that jump."""
    check_random_updates(HERE / "random_updates.cpp", count, tmp_path, *flags)
