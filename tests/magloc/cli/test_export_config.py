"""``magloc export-config``: a compiler reads the numbers of the array, and of the satellite."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import adcs
import arrays
from adcs.io.scenario_files import scenario_text
from magloc import core
from tests.command_line import Run

COMPILER = next(filter(shutil.which, ("c++", "g++", "clang++")), None)
MAIN = """#include "array.hpp"
#include <stdio.h>
int main() {
  using namespace sensor_array;
  for (int i = 0; i < n_channels; ++i) {
    for (double x : position_m[sensor[i]]) printf("%.17g ", x);
    for (double x : gain[i]) printf("%.17g ", x);
    printf("%.17g %.17g %d\\n", offset_T[i], noise_T[i], is_scalar[i]);
  }
}
"""


def calibrated() -> arrays.SensorArray:
    """Four vector sensors with gains, offsets and rotated axes, and a scalar one."""
    vectors = [
        arrays.Sensor(
            f"s{i}",
            "vector",
            tuple(place),
            noise_T=(1.0 + i) * 1e-9,
            calibration=arrays.Calibration(
                scale=((1.01, 0.02, 0.0), (0.0, 0.98, 0.01), (0.03, 0.0, 1.0)), offset_T=(1e-7, -2e-7 * i, 3e-7)
            ),
        )
        for i, place in enumerate(np.random.default_rng(0).standard_normal((4, 3)))
    ]
    return arrays.SensorArray((*vectors, arrays.Sensor("m", "scalar", (0.1, 0.2, -0.3), noise_T=2e-9)), name="own ??/")


def test_a_compiler_reads_the_same_numbers(run: Run, tmp_path: Path) -> None:
    if COMPILER is None:
        pytest.skip("needs a compiler")
    array = calibrated()
    arrays.write_array(tmp_path / "array.toml", array)
    outcome = run("export-config", tmp_path / "array.toml", "--to", "header", "--out", tmp_path / "array.hpp")
    assert outcome.status == 0, outcome.err
    printed = run("export-config", tmp_path / "array.toml")
    assert printed.out == (tmp_path / "array.hpp").read_text(encoding="utf-8")
    (tmp_path / "main.cpp").write_text(MAIN, encoding="utf-8")
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([COMPILER, *flags, tmp_path / "main.cpp", "-o", tmp_path / "main"], check=True)
    done = subprocess.run([tmp_path / "main"], check=True, capture_output=True, encoding="utf-8")
    found = np.array([line.split() for line in done.stdout.splitlines()], dtype=np.float64)
    array = arrays.read_array(tmp_path / "array.toml")
    position_m = np.array([sensor.position_m for sensor in array.sensors])[array.channel_sensor]
    np.testing.assert_array_equal(found[:, :3], position_m)
    np.testing.assert_array_equal(found[:, 3:6], array.channel_gain)
    others = (array.channel_offset_T, array.channel_noise_T, array.channel_is_scalar)
    np.testing.assert_array_equal(found[:, 6:], np.stack(others, axis=1))


SATELLITE_MAIN = """#include "satellite.hpp"
#include <stdio.h>
int main() {
  const auto c = satellite::config<double>();
  const adcs::SatelliteConfig<float> single = satellite::config<float>();
  for (auto &row : c.inertia_kgm2) for (double x : row) printf("%.17g ", x);
  for (bool used : c.uses) printf("%d ", used);
  printf("%.17g %.17g %.17g %.17g %.17g ", c.step_s, c.sigma_star, c.sigma_gyro_rad_s, c.sigma_field_T, c.sigma_sun);
  printf("%.17g %.17g ", c.noise_attitude, c.noise_rate_rad_s);
  for (int i = 0; i < 6; ++i) printf("%.17g %.17g %.17g ", c.noise[i], c.start_sigma[i], c.lasts_s[i]);
  printf("%.17g %d %d\\n", c.gate_limit, satellite::Filter<>::n, single.uses[0]);
}
"""


def test_a_compiler_reads_the_filter_of_a_satellite(run: Run, tmp_path: Path) -> None:
    """The numbers are those of the scenario's estimator."""
    if COMPILER is None:
        pytest.skip("needs a compiler")
    scenario = adcs.read_scenario("tabletsat").changed(
        {"estimate": {"sensors": "st+gyro+mag", "states": ["gyro-bias", "field-gain"], "gyro_bias_deg_s": 0.1}}
    )
    (tmp_path / "satellite.toml").write_text(scenario_text(scenario), encoding="utf-8")
    outcome = run("export-config", tmp_path / "satellite.toml", "--to", "header", "--out", tmp_path / "satellite.hpp")
    assert outcome.status == 0, outcome.err
    (tmp_path / "main.cpp").write_text(SATELLITE_MAIN, encoding="utf-8")
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{core.include_dir()}"]
    subprocess.run([COMPILER, *flags, tmp_path / "main.cpp", "-o", tmp_path / "main"], check=True)
    done = subprocess.run([tmp_path / "main"], check=True, capture_output=True, encoding="utf-8")
    satellite, settings = scenario.satellite, scenario.estimator().settings
    noise, nothing = settings.noise, 0.0
    sigma = [
        satellite.star_tracker.sigma_rad,
        satellite.gyro.sigma_rad_s,
        satellite.magnetometer.sigma_T,
        satellite.sun_sensor.sigma_rad,
    ]
    states = [
        (noise.field_bias_T, settings.field_bias_sigma_T, nothing),
        (noise.gyro_bias_rad_s, math.radians(0.1), nothing),
        (noise.disturbance_s2, settings.disturbance_sigma_s2, nothing),
        (nothing, settings.field_model_sigma_T, settings.field_correlation_s),
        (noise.dipole_Am2, settings.dipole_sigma_Am2, nothing),
        (noise.field_gain, settings.field_gain_sigma, nothing),
    ]
    expected = [*satellite.body.inertia_kgm2.ravel(), 1, 1, 1, 0, scenario.step_s, *sigma]
    expected += [noise.attitude, noise.rate_rad_s, *np.ravel(states), settings.gate_limit, 18, 1]
    np.testing.assert_array_equal(np.array(done.stdout.split(), dtype=np.float64), expected)


def test_a_built_in_scenario_and_refusals(run: Run, tmp_path: Path) -> None:
    assert "adcs::SatelliteConfig<Real> config()" in run("export-config", "tabletsat").out
    for changes, words in (
        ({"filter": "smoother"}, "must be settings of the filter mekf; instead received smoother"),
        ({"sensors": "gyro+mag"}, "must be st or mag+sun, or more; instead received gyro+mag"),
    ):
        path = tmp_path / "satellite.toml"
        path.write_text(scenario_text(adcs.read_scenario("tabletsat").changed({"estimate": changes})), encoding="utf-8")
        outcome = run("export-config", path)
        assert outcome.status == 2
        assert words in outcome.err
    assert run("export-config", tmp_path / "nothing.toml").status == 2
    assert run("export-config", "nothing").status == 2
