"""The examples of docs/guide/use-the-core.md: compiled with the installed headers alone, and Python's numbers."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import adcs
import arrays
import magloc
from adcs.environment.environment import Environment
from adcs.frames import instants
from adcs.kalman.error_state import FilterSettings, FilterStart, ProcessNoise, sensor_set
from adcs.kalman.mekf import initial_state, predict, update_state
from adcs.quaternion import IDENTITY
from adcs.satellite.satellite import Satellite
from adcs.satellite.sensors import Gyro, Magnetometer, SunSensor
from adcs.satellite.telemetry import AttitudeReadings, Record
from magloc import core
from magloc.fields.dipole import field
from tests.conftest import REPOSITORY

Array = NDArray[np.float64]
EXAMPLES = REPOSITORY / "docs" / "examples"
COMPILER = next(filter(shutil.which, ("c++", "g++", "clang++")), None)
PLAIN = ("-std=c++17", "-O2", "-fno-exceptions", "-fno-rtti", "-fno-math-errno", "-Wall", "-Wextra", "-Werror")


def compiled(compiler: str | None, source: str, output: Path, *flags: str) -> Path:
    if compiler is None or shutil.which(compiler) is None:
        pytest.skip("needs a compiler")
    command = [compiler, f"-I{core.include_dir()}", str(EXAMPLES / source), *flags, "-o", str(output)]
    subprocess.run(command, check=True)
    return output


def printed(program: Path) -> list[list[str]]:
    done = subprocess.run([program], check=True, capture_output=True, encoding="utf-8")
    return [line.split() for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def numbers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Array]:
    """What the example in C++ prints."""
    place = tmp_path_factory.mktemp("example") / "fix_and_attitude"
    lines = printed(compiled(COMPILER, "fix_and_attitude.cpp", place, *PLAIN))
    return {name: np.array(values, dtype=np.float64) for name, *values in lines}


class TestCpp:
    def test_the_fix_is_that_of_locate(self, numbers: dict[str, Array]) -> None:
        places = 0.2 * np.array([[0.0, 0.0, 1.0], [0.8, 0.0, -0.6], [-0.4, 0.6, -0.2], [-0.4, -0.6, -0.2]])
        sensors = [arrays.Sensor(f"s{i}", "vector", tuple(place), noise_T=1e-9) for i, place in enumerate(places)]
        readings = [
            [19696.7e-9, 714.6e-9, -42670.3e-9],
            [19111.9e-9, 1523.7e-9, -44556.7e-9],
            [19637.1e-9, 1116.5e-9, -43813.1e-9],
            [19412.4e-9, 1005.9e-9, -43748.2e-9],
        ]
        fix = magloc.locate(arrays.SensorArray(tuple(sensors)), np.reshape(readings, (1, 12)))[0].best
        np.testing.assert_allclose(numbers["position"], fix.position_m, rtol=0, atol=1e-7)
        np.testing.assert_allclose(numbers["moment"], fix.moment_Am2, rtol=0, atol=1e-6)

    def test_the_step_is_that_of_the_readable_filter(self, numbers: dict[str, Array]) -> None:
        satellite = Satellite(
            inertia_kgm2=np.diag([0.05, 0.06, 0.03]),
            orbit=adcs.circular_orbit(altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21"),
            gyro=Gyro(sigma_rad_s=1e-4),
            magnetometer=Magnetometer(sigma_T=2e-7),
            sun_sensor=SunSensor(sigma_rad=5e-3),
        )

        def twice(*values: float) -> Array:
            return np.array([[values, values]])

        one = twice(1.0)[..., 0]
        around = Environment(
            instants(np.datetime64("2026-11-21"), np.arange(2.0)), np.arange(2.0), twice(0, 0, 0), twice(0, 0, 0),
            twice(2e-5, 1e-6, -3e-5), twice(0.6, 0.0, 0.8), one, 1.1e-3 * one, 1.2e-6 * one,
        )  # fmt: skip
        none = np.full((1, 2, 4), np.nan)
        readings = AttitudeReadings(
            none, twice(1e-3, 2e-3, -1e-3), twice(1.9e-5, 2.1e-6, -3.1e-5), twice(0.61, 0.02, 0.79)
        )
        record = Record(satellite, 1.0, around, readings, twice(1e-3, -2e-3, 5e-4), twice(0, 0, 0), twice(0, 0, 0))
        settings = FilterSettings(sensor_set("gyro+mag+sun"), ProcessNoise(1e-6, 1e-6))
        start = FilterStart(IDENTITY[None], np.array([[0.0, 1.1e-3, 0.0]]), np.diag([1e-3] * 3 + [1e-5] * 3)[None])
        state = predict(record, 0, initial_state(settings, start), settings)[0]
        state, nis = update_state(record, 1, state, settings)
        assert np.nanmax(nis) < settings.gate_limit
        np.testing.assert_allclose(numbers["attitude"], state.q[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(numbers["rate"], state.w[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(numbers["sigma"], np.sqrt(np.diag(state.P[0])), rtol=1e-9)

    def test_a_cortex_m7_needs_nothing_but_the_compiler(self, tmp_path: Path) -> None:
        """No exceptions, no heap, no C library: only copies of memory, and the compiler's own conversions of int64."""
        processor = ("-mcpu=cortex-m7", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-nostdlib", "-ffreestanding")
        built = compiled("arm-none-eabi-g++", "fix_and_attitude.cpp", tmp_path / "example.o", "-c", *PLAIN, *processor)
        done = subprocess.run(["arm-none-eabi-nm", "-u", built], check=True, capture_output=True, encoding="utf-8")
        needed = {line.split()[-1] for line in done.stdout.splitlines()}
        assert needed <= {"memset", "memcpy", "memmove", "__aeabi_d2lz", "__aeabi_l2d"}


@pytest.mark.skipif(sys.platform == "win32", reason="the library has another name")
def test_c_calls_the_library(tmp_path: Path) -> None:
    program = compiled("cc", "fields.c", tmp_path / "fields", str(core.include_dir().parent / "kernels.so"))
    points, moment = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 0.0]]), np.array([0.0, 0.0, 5.0])
    found = np.array(printed(program), dtype=np.float64)
    np.testing.assert_allclose(found, field(points, [0.0, 0.0, 0.0], moment), rtol=1e-14, atol=1e-25)


@pytest.mark.parametrize("lanes", [1, 4])
def test_all_headers_go_together(lanes: int, tmp_path: Path) -> None:
    if COMPILER is None:
        pytest.skip("needs a compiler")
    names = [path.relative_to(core.include_dir()).as_posix() for path in core.include_dir().rglob("*.h*")]
    (tmp_path / "all.cpp").write_text("".join(f'#include "{name}"\n' for name in sorted(names)), encoding="utf-8")
    flags = (*PLAIN, "-Wno-psabi", f"-DMAGLOC_LANES={lanes}", "-fsyntax-only", f"-I{core.include_dir()}")
    subprocess.run([COMPILER, *flags, str(tmp_path / "all.cpp")], check=True)
