"""The examples for a microcontroller on the host and on an emulated Cortex-M7: the same numbers.

The Cortex-M7 needs gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm, packages of Debian.
"""

from __future__ import annotations

import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import adcs
from adcs import quaternion
from tests.test_core_examples import COMPILER, EXAMPLES, PLAIN, compiled, printed

Array = NDArray[np.float64]
PROCESSOR = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16")
EXACT = "-ffp-contract=off"  # no fused multiply-add, so that all processors round alike
MOST_FLASH = {"drone_heading": 18_500, "satellite_3u": 25_000, "hand_held_detector": 40_000}
MOST_RAM = 16_384
REALS = pytest.mark.parametrize("real", ["double", "float"])


@cache
def flight() -> tuple[Array, Array, Array, Array, Array]:
    """The flight of the example: times, rates, accelerations, fields and true attitudes."""
    dt = 0.01
    time_s = dt * np.arange(6000)
    v = np.maximum(time_s - 2.0, 0.0)
    rates = np.stack([0.3 * np.sin(1.3 * v), 0.2 * np.sin(0.9 * v), 0.8 * np.sin(0.5 * v)], axis=1)
    before = np.concatenate([np.zeros((1, 3)), rates[:-1]])
    q = [quaternion.exp([0.05, -0.03, 0.9])]
    for turn in dt * before[1:]:
        q.append(quaternion.normalised(quaternion.multiply(q[-1], quaternion.exp(turn))))
    shake = np.stack([0.3 * np.sin(40.0 * v), 0.2 * np.sin(31.0 * v), 0.4 * np.sin(53.0 * v)], axis=1)
    attitudes = np.array(q)
    field = quaternion.rotate_back(attitudes, [0.0, 20e-6, -43e-6])
    field[time_s >= 25.0] += [8e-6, -6e-6, 10e-6]
    field[(time_s >= 45.0) & (time_s < 48.0)] = np.nan
    acceleration = quaternion.rotate_back(attitudes, [0.0, 0.0, 9.81]) + shake
    return time_s, before + np.array([0.004, -0.003, 0.002]), acceleration, field, attitudes


@cache
def expected() -> tuple[Array, int]:
    """Every 200th estimate of adcs.AttitudeFilter, and the number of good headings."""
    drone, rows, good = adcs.AttitudeFilter(), [], 0
    for i, row in enumerate(zip(*flight()[:4], strict=True)):
        now = drone.update(*row)
        good += now.sigma_heading_rad < 0.17
        if i % 200 == 199:
            rows.append([row[0], *now.q, now.sigma_tilt_rad, now.sigma_heading_rad, now.bits])
    return np.array(rows), good


def parts(lines: list[list[str]]) -> tuple[Array, int]:
    return np.array(lines[:-1], dtype=np.float64), int(lines[-1][1])


def check(lines: list[list[str]], real: str) -> None:
    """Double: Python's numbers to 1e-9. Float: the attitude to 1e-4 rad, σ to 1 %."""
    found, good = parts(lines)
    of_python, good_of_python = expected()
    assert abs(good - good_of_python) <= (0 if real == "double" else 5)
    np.testing.assert_array_equal(found[:, 7], of_python[:, 7])
    if real == "double":
        np.testing.assert_allclose(found[:, 1:7], of_python[:, 1:7], rtol=0, atol=1e-9)
    else:
        assert quaternion.angle_between(found[:, 1:5], of_python[:, 1:5]).max() < 1e-4
        np.testing.assert_allclose(found[:, 5:7], of_python[:, 5:7], rtol=0.01)


def test_the_heading_is_honest() -> None:
    """Within 4 σ of the truth; the motors' field is left out, and then subtracted."""
    rows, good = expected()
    error = quaternion.multiply(rows[:, 1:5], quaternion.conjugate(flight()[4][199::200]))
    heading = 2.0 * np.arctan2(error[:, 3], error[:, 0])
    assert (np.abs(np.angle(np.exp(1j * heading))) < 4.0 * rows[:, 6]).all()
    assert good > 5900
    assert (rows[rows[:, 0] > 40.0, 7].astype(int) & 4).all()


@REALS
def test_a_drone_on_the_host(real: str, tmp_path: Path) -> None:
    check(on_the_host("drone_heading", real, tmp_path), real)


@REALS
def test_a_drone_on_a_cortex_m7(real: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check(on_a_cortex_m7("drone_heading", real, tmp_path, capsys), real)


@REALS
def test_a_satellite_on_the_host(real: str, tmp_path: Path) -> None:
    """The attitude is within 5 σ of the truth at all 15 times; the wrong fix is rejected."""
    rows, good = parts(on_the_host("satellite_3u", real, tmp_path))
    angle, sigma = quaternion.angle_between(rows[:, 1:5], rows[:, 18:22]), rows[:, 8:11].max(axis=1)
    assert (angle < 5.0 * sigma).all()  # by chance in one of 40,000 such flights
    assert (sigma < 1e-3).all()
    assert 700 < good < 900
    assert {row[0] for row in rows if int(row[17]) & 16} == {600}
    assert {row[0] for row in rows if int(row[17]) & 256} == {360, 420}


@REALS
def test_a_satellite_on_a_cortex_m7(real: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The host's numbers to 1e-9; in float to 1e-5 rad, and σ to 1 %."""
    host, good_of_host = parts(on_the_host("satellite_3u", "double", tmp_path))
    found, good = parts(on_a_cortex_m7("satellite_3u", real, tmp_path, capsys))
    np.testing.assert_array_equal(found[:, 17], host[:, 17])
    assert abs(good - good_of_host) <= (0 if real == "double" else 5)
    if real == "double":
        np.testing.assert_allclose(found, host, rtol=0, atol=1e-9)
    else:
        assert quaternion.angle_between(found[:, 1:5], host[:, 1:5]).max() < 1e-5
        np.testing.assert_allclose(found[:, 8:17], host[:, 8:17], rtol=0.01)


def test_a_detector_on_the_host(tmp_path: Path) -> None:
    """The place is within 5 σ of the truth every second; the disturbed row is not used."""
    rows, found = parts(on_the_host("hand_held_detector", "double", tmp_path))
    assert (np.abs(rows[:, 2:5] - rows[:, 14:17]) < 5.0 * rows[:, 8:11]).all()
    np.testing.assert_array_equal(np.isnan(rows[:, 17]), rows[:, 0] == 10.0)
    assert found == 149


def test_a_detector_on_a_cortex_m7(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The host's numbers to 1e-9, NIS to 1e-6."""
    host, found_on_host = parts(on_the_host("hand_held_detector", "double", tmp_path))
    rows, found = parts(on_a_cortex_m7("hand_held_detector", "double", tmp_path, capsys))
    assert found == found_on_host
    np.testing.assert_allclose(rows[:, :17], host[:, :17], rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows[:, 17], host[:, 17], rtol=0, atol=1e-6)


def on_the_host(example: str, real: str, folder: Path) -> list[list[str]]:
    """What an example prints."""
    return printed(compiled(COMPILER, f"{example}.cpp", folder / example, *PLAIN, EXACT, f"-DREAL={real}"))


def on_a_cortex_m7(example: str, real: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    """What an example prints on an emulated processor; also print its flash and RAM, and check them."""
    if missing := [name for name in ("arm-none-eabi-g++", "qemu-system-arm") if shutil.which(name) is None]:
        pytest.skip(f"needs {' and '.join(missing)}")
    small = ("-std=c++17", "-Os", *PROCESSOR, EXACT, "-fno-exceptions", "-fno-rtti", "-fno-math-errno")
    flags = (*small, "-fno-threadsafe-statics", f"-DREAL={real}")
    folder, program, source = EXAMPLES / "cortex_m7", tmp_path / "example.elf", f"{example}.cpp"
    start, built = tmp_path / "start.o", tmp_path / "example.o"
    subprocess.run(["arm-none-eabi-gcc", *PROCESSOR, "-Os", "-c", folder / "start.c", "-o", start], check=True)
    compiled("arm-none-eabi-g++", source, built, "-c", *flags)
    link = ["--specs=rdimon.specs", "-nostartfiles", "-T", str(folder / "link.ld"), str(start), str(built)]
    done = subprocess.run(
        ["arm-none-eabi-g++", *flags, *link, "-o", program], check=False, capture_output=True, encoding="utf-8"
    )
    if "rdimon" in done.stderr and done.returncode:
        pytest.skip("needs libnewlib-arm-none-eabi")
    assert done.returncode == 0, done.stderr
    machine = ["qemu-system-arm", "-M", "mps2-an500", "-cpu", "cortex-m7", "-nographic"]
    console = ["-semihosting-config", "enable=on,target=native", "-kernel", str(program)]
    output = subprocess.run([*machine, *console], check=True, capture_output=True, encoding="utf-8", timeout=300).stdout
    alone = compiled("arm-none-eabi-g++", source, tmp_path / "alone.o", "-c", "-ffreestanding", *flags)
    sizes = subprocess.run(["arm-none-eabi-size", alone], check=True, capture_output=True, encoding="utf-8").stdout
    flash, data, bss = map(int, sizes.splitlines()[1].split()[:3])
    with capsys.disabled():
        print(f"\n{example} in {real} on a Cortex-M7: {flash} bytes of flash, {data + bss} bytes of RAM")
    assert flash < MOST_FLASH[example]
    assert data + bss < MOST_RAM
    return [line.split() for line in output.splitlines()]
