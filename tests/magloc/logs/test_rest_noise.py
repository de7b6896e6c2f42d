"""Allan deviation against allantools; amounts of noise that a simulation put in."""

from __future__ import annotations

from pathlib import Path

import allantools
import numpy as np
import pytest

import arrays
from arrays.typing import FloatArray
from magloc.logs.rest_noise import RestNoise, allan_deviation, rest_noise
from magloc.logs.sensors import VectorReadings
from sims.noise import coloured_noise, random_walk
from tests.robot_flights import Flight

RATE_Hz, N = 50.0, 100_000
DENSITY = np.sqrt(2.0 / RATE_Hz)  # white noise of 1 in each sample


def noise_of(values: FloatArray) -> RestNoise:
    return rest_noise(VectorReadings("b.x", np.arange(len(values)) / RATE_Hz, values), "T")


def white(seed: int, n: int = N) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(n, 3))


def test_the_deviation_is_that_of_allantools() -> None:
    values = white(0, 5000)
    tau_s, deviation = allan_deviation(values, RATE_Hz)
    for axis in range(3):
        expected = allantools.oadev(values[:, axis], rate=RATE_Hz, data_type="freq", taus=tau_s)[1]
        np.testing.assert_allclose(deviation[:, axis], expected, rtol=1e-12)


def test_white_noise_has_no_other_part() -> None:
    """Thirty records; a part is stated from 3 of its standard deviations on."""
    found = [noise_of(white(seed, 10_000)) for seed in range(30)]
    assert np.median([noise.white for noise in found]) == pytest.approx(1.0, abs=0.02)
    assert sum(noise.flicker > 0.0 or noise.walk > 0.0 for noise in found) <= 1


@pytest.mark.parametrize(("flicker", "walk"), [(0.3, 0.0), (0.0, 20.0), (0.3, 20.0)])
def test_flicker_and_walk_are_those_of_the_simulation(flicker: float, walk: float) -> None:
    corner_Hz = flicker**2 / np.log(10.0) / DENSITY**2
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        values = coloured_noise(N, 3, RATE_Hz, DENSITY, corner_Hz, np.inf, rng) + random_walk(N, 3, RATE_Hz, walk, rng)
        found.append(noise_of(values))
    assert np.median([noise.white for noise in found]) == pytest.approx(1.0, abs=0.05)
    assert np.median([noise.flicker for noise in found]) == pytest.approx(flicker, rel=0.1)
    assert np.median([noise.walk for noise in found]) == pytest.approx(walk, rel=0.15)


def test_a_low_pass_does_not_hide_the_white_noise() -> None:
    """A mean of ten samples has a tenth of the variance; averages over longer times stay the same."""
    values = np.apply_along_axis(np.convolve, 0, white(3), np.full(10, 0.1), "valid")
    assert noise_of(values).white == pytest.approx(1.0, abs=0.1)


def test_a_gap_ends_the_record() -> None:
    values, time_s = white(4, 3000), np.arange(3000) / RATE_Hz
    values[:1000] += 100.0
    time_s[1000:] += 60.0
    assert rest_noise(VectorReadings("b.x", time_s, values), "T").white == pytest.approx(1.0, abs=0.1)


def test_few_readings_are_refused() -> None:
    with pytest.raises(ValueError, match="must have 200 readings or more without a gap, at rest; instead received 150"):
        noise_of(white(5, 150))


def test_readings_that_do_not_vary_are_refused() -> None:
    """Steps of the sensor are ten times its noise, so that it reads one value at rest."""
    with pytest.raises(ValueError, match=r"Input b\.x must have readings that vary at rest.*0\.0\] in all rows"):
        noise_of(10.0 * np.round(0.1 * white(8, 300)))


def test_the_noise_goes_into_array_and_scenario_file(run, tmp_path: Path) -> None:
    flight = Flight(6, duration_s=60.0, swing_rad=0.0)
    path, out = tmp_path / "rest.ulg", tmp_path / "a.toml"
    path.write_bytes(flight.px4())
    assert run("columns", path, "--rest", tmp_path / "rest", "--out", out).status == 0
    assert {file.name for file in (tmp_path / "rest").iterdir()} == {"allan.csv", "allan.png", "sensors.toml"}
    assert arrays.read_sensors(out).sensors[0].noise_T == pytest.approx(flight.noise_T, rel=0.05)
    scenario = (tmp_path / "rest" / "sensors.toml").read_text()
    gyro = float(scenario.partition("noise_deg_s = ")[2].partition("\n")[0])
    assert gyro == pytest.approx(np.degrees(1e-3), rel=0.05)


def test_the_longest_rest_of_a_flight_is_used(run, data_folder: Path, tmp_path: Path) -> None:
    said = run("columns", data_folder / "flight-logs" / "sample.ulg", "--rest", tmp_path / "rest")
    assert "the robot turns; the noise is from 119.3 to 181.5 s" in said.err


def test_a_short_rest_is_refused(run, tmp_path: Path) -> None:
    path = tmp_path / "short.ulg"
    path.write_bytes(Flight(7, duration_s=2.0).px4())
    said = run("columns", path, "--rest", tmp_path / "rest")
    assert said.status == 2
    assert "short.ulg: vehicle_magnetometer.magnetometer_ga[0] must have 200 readings" in said.err
    assert not (tmp_path / "rest").exists()


def test_a_text_is_refused(run, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time_s,a\n0,1\n")
    said = run("columns", path, "--rest", tmp_path / "rest")
    assert (said.status, "expected the log of an autopilot" in said.err) == (2, True)
