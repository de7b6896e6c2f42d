"""The satellite filter of the C++ headers. The oracle is adcs.SatelliteFilter, with the same surroundings."""

from __future__ import annotations

import math
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import adcs
from adcs import quaternion
from adcs.environment.environment import environment, field_eci
from adcs.environment.sun import sun_position_eci
from adcs.frames import instants
from adcs.kalman.config_header import satellite_header
from adcs.kalman.satellite_filter import SatelliteEstimate
from adcs.satellite.sensors import SENSORS
from magloc import core
from tests.adcs.kalman.test_satellite_filter import (
    SATELLITE,
    SETS,
    filter_of,
    log_of,
    log_with_a_turned_star_tracker,
    updates,
)
from tests.sanitized import check_random_updates
from tests.test_core_examples import COMPILER

Array = NDArray[np.float64]
HERE = Path(__file__).parent


def rows_of(log: adcs.Telemetry, step_s: float = math.inf) -> Array:
    """Rows of the program: time, orbit, readings; in gaps rows without readings, each at most about a step later."""
    counts = np.maximum(np.ceil(np.diff(log.time_s) / step_s - 0.5), 1.0).astype(int)
    places = np.concatenate([[0], np.cumsum(counts)])
    time_s = np.interp(np.arange(places[-1] + 1), places, log.time_s)
    utc = instants(np.array([SATELLITE.start]), time_s)[0]
    around = environment(SATELLITE.orbit, np.array([SATELLITE.start]), time_s)
    position = around.position_eci_m[0]
    surroundings = [position, around.velocity_eci_m_s[0], field_eci(position, utc), sun_position_eci(utc) - position]
    names = ("star", "star_covariance_rad2", "gyro_rad_s", "field_T", "sun", "wheels_Nms", "torquers_Am2")
    readings = []
    for name in names:
        values = np.array(getattr(log, name)).reshape(len(log.time_s), -1)
        spread = np.full((len(time_s), values.shape[1]), np.nan)
        spread[places] = values[:, [3, 0, 1, 2]] if name == "star" else values
        if name == "wheels_Nms":
            spread = np.stack([np.interp(time_s, log.time_s, column) for column in values.T], axis=1)
        readings.append(spread)
    return np.column_stack([time_s, *surroundings, *readings])


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of compiled programs, one for each header and precision."""
    return tmp_path_factory.mktemp("programs")


def run_rows(rows: Array, filter_: adcs.SatelliteFilter, programs: Path, real: str = "double") -> Array:
    """What the program prints."""
    if COMPILER is None:
        pytest.skip("needs a compiler")
    header = satellite_header("test", filter_)
    folder = programs / f"{real}-{zlib.crc32(header.encode()):08x}"
    program = folder / "rows"
    if not program.exists():
        folder.mkdir()
        (folder / "satellite.hpp").write_text(header, encoding="utf-8")
        optimisation = "-O2" if real == "double" else "-O0"  # twice as fast to compile
        flags = ["-std=c++17", optimisation, "-Wall", "-Wextra", "-Werror", f"-I{core.include_dir()}", f"-I{folder}"]
        command = [COMPILER, *flags, f"-DREAL={real}", str(HERE / "satellite_rows.cpp"), "-o", str(program)]
        subprocess.run(command, check=True)
    text = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in rows)
    done = subprocess.run([program], input=text, check=True, capture_output=True, encoding="utf-8")
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=np.float64)


def numbers_of(estimate: SatelliteEstimate) -> Array:
    """An estimate as the program prints it."""
    flags = [("starting" in estimate.flags) + 2 * ("restarted" in estimate.flags)]
    flags += [16 << i for i, name in enumerate(SENSORS) if f"{name}-rejected" in estimate.flags]
    flags += [256 << i for i, name in enumerate(SENSORS) if f"{name}-silent" in estimate.flags]
    nis = [estimate.nis[name] for name in SENSORS]
    states, sigma = ([*values.values()] for values in (estimate.states, estimate.sigma))
    numbers = [[0, sum(flags)], estimate.q, estimate.rate_rad_s, *states, *sigma, nis, estimate.covariance.ravel()]
    return np.concatenate(numbers)


def assert_equal(found: Array, estimates: list[SatelliteEstimate], n: int) -> None:
    """Attitude and rate to 1e-12, other states to 1e-9 of their σ, σ and NIS to 9 digits, and the same flags.

    The first good reading after a long search lowers σ a thousandfold, which loses three digits. Rounding
    depends on the processor: states differ by up to 1.1e-10 of their σ on some.
    """
    expected = np.stack([numbers_of(one) for one in estimates])
    np.testing.assert_array_equal(found[:, :2], expected[:, :2])
    started = (expected[:, 1].astype(int) & 1) == 0
    found, expected = found[started], expected[started]
    np.testing.assert_allclose(found[:, 2:9], expected[:, 2:9], rtol=0, atol=1e-12)
    states, sigma, nis = slice(9, 3 + n), slice(3 + n, 3 + 2 * n), slice(3 + 2 * n, 7 + 2 * n)
    assert (np.abs(found[:, states] - expected[:, states]) <= 1e-9 * expected[:, sigma].max(axis=0)[6:]).all()
    np.testing.assert_allclose(found[:, sigma], expected[:, sigma], rtol=1e-9)
    np.testing.assert_allclose(found[:, nis], expected[:, nis], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        np.sqrt(found[:, 7 + 2 * n :: n + 1]), found[:, sigma], rtol=1e-14
    )  # the covariance's diagonal


def size_of(filter_: adcs.SatelliteFilter) -> int:
    return filter_.settings.sensors.size


@pytest.mark.slow_after(3)
@pytest.mark.parametrize(("sensors", "states"), [("st+mag+sun", ("field-model",)), *SETS, ("mag+sun", ())])
def test_as_python(sensors: str, states: tuple[str, ...], programs: Path) -> None:
    """With missing and wild readings, commands, and the covariance of some fixes; in float within 0.3 σ."""
    log, filter_ = log_of(), filter_of(sensors, states)
    rows, n = rows_of(log), size_of(filter_)
    found = run_rows(rows, filter_, programs)
    estimates = updates(filter_, log)
    assert sum("rejected" in flag for one in estimates for flag in one.flags) > 2
    assert_equal(found, estimates, n)
    single = run_rows(rows, filter_, programs, "float")
    np.testing.assert_array_equal(single[:, :2], found[:, :2])
    started, sigma = (found[:, 1].astype(int) & 1) == 0, found[:, 3 + n : 3 + 2 * n]
    apart = quaternion.angle_between(single[:, 2:6], found[:, 2:6])
    assert (apart < 0.3 * sigma[:, :3].min(axis=1))[started].all()
    assert (np.abs(single[:, 9 : 3 + n] - found[:, 9 : 3 + n]) < 0.3 * sigma[:, 6:])[started].all()


def test_where_a_second_hypothesis_wins(programs: Path) -> None:
    log, filter_ = log_with_a_turned_star_tracker(), filter_of("st+gyro", ("gyro-bias",))
    found = run_rows(rows_of(log), filter_, programs)
    assert_equal(found, updates(filter_, log), size_of(filter_))
    rejected = (found[:, 1].astype(int) & 16) > 0
    assert rejected[60:100].all()
    assert not rejected[-50:].any()


def test_at_any_times_and_after_gaps(programs: Path) -> None:
    """Python divides long steps into usual ones; here rows without readings do."""
    rng = np.random.default_rng(5)
    some = np.flatnonzero(rng.random(241) < 0.7)
    log, filter_ = (
        log_of(some, np.round(0.3 * rng.random(241), 6) + np.where(np.arange(241) < 120, 0.0, 700.0)),
        filter_of(*SETS[0]),
    )
    rows = rows_of(log, filter_.step_s)
    late = np.diff(log.time_s, prepend=log.time_s[0]).argmax()
    between = (rows[:, 0] > log.time_s[late - 1]) & (rows[:, 0] < log.time_s[late])
    rows = rows[~between]  # the filter starts anew after so long a gap
    found = run_rows(rows, filter_, programs)
    estimates = updates(filter_, log)
    assert "restarted" in estimates[late].flags
    assert_equal(found[np.isin(rows[:, 0], log.time_s)], estimates, size_of(filter_))


def test_a_gap_is_divided_into_usual_steps(programs: Path) -> None:
    """Surroundings are interpolated linearly in it, which is nearly the same."""
    log = log_of(np.flatnonzero((np.arange(241) < 100) | (np.arange(241) >= 130)))
    filter_ = filter_of("mag+sun+gyro", ("gyro-bias",))
    n = size_of(filter_)
    at_once, in_steps = (run_rows(rows_of(log, step_s), filter_, programs) for step_s in (math.inf, 1.0))
    in_steps = in_steps[np.isin(rows_of(log, 1.0)[:, 0], log.time_s)]
    started = (at_once[:, 1].astype(int) & 1) == 0
    np.testing.assert_array_equal(at_once[:, 1], in_steps[:, 1])
    assert quaternion.angle_between(at_once[:, 2:6], in_steps[:, 2:6])[started].max() < 1e-6
    np.testing.assert_allclose(at_once[started, 3 + n : 9 + n], in_steps[started, 3 + n : 9 + n], rtol=1e-3)


BAD = {
    "time that goes back": ({0: -1.0}, 1),
    "time": ({0: math.nan}, 1),
    "gyro": ({26: math.inf}, 2),
    "field": ({30: 20.0}, 4),
    "star": ({13: 0.0, 14: 0.0, 15: 0.0, 16: 0.0}, 5),
    "covariance": ({17: -1e-9, 21: 1e-9, 25: 1e-9} | dict.fromkeys((18, 19, 20, 22, 23, 24), 0.0), 5),
    "Sun": ({32: 0.0, 33: 0.0, 34: 0.0}, 6),
    "momentum": ({35: math.inf}, 7),
    "orbit": ({1: 0.0, 2: 0.0, 3: 0.0}, 8),
    "field of the orbit": ({7: math.nan}, 8),
}


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_row_changes_nothing(bad: str, programs: Path) -> None:
    """It has a status, and the rows after it are those without it."""
    changes, status = BAD[bad]
    rows, filter_ = rows_of(log_of(slice(60))), filter_of(*SETS[1])
    rows[:, 13:17], rows[:, 26:35] = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2e-5, 0.0, 0.0, 0.0, 0.0, 1.0]
    wrong = rows[30:31].copy()
    wrong[0, 0] -= 0.5
    for column, value in changes.items():
        wrong[0, column] = value
    found = run_rows(np.concatenate([rows[:30], wrong, rows[30:]]), filter_, programs)
    assert found[30, 0] == status
    np.testing.assert_array_equal(np.delete(found, 30, axis=0), run_rows(rows, filter_, programs))


@pytest.mark.parametrize(
    ("count", "flags"), [(20_000, ["-DQUICK"]), pytest.param(1_000_000, [], marks=pytest.mark.slow)]
)
def test_random_updates_never_crash(count: int, flags: list[str], tmp_path: Path) -> None:
    """NaN, infinities, numbers of any size, bad orbits and times that go back, in double and float."""
    check_random_updates(HERE / "random_updates.cpp", count, tmp_path, *flags)
