"""``magloc export-config``: a compiler reads the array's numbers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import arrays
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
