"""Tests of the C++ headers of adcs, compiled by the compiler of this machine; skipped where there is none.

The oracles: the readable references.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from adcs import quaternion
from adcs.satellite import dynamics
from magloc import core
from tests.adcs.attitudes import random_attitudes
from tests.adcs.kalman import readable

Array = NDArray[np.float64]
COMPILER = shutil.which(os.environ.get("CXX", "c++"))
FLAGS = ("-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", "-Wno-psabi", "-fno-exceptions", "-fno-rtti")
SAFE = ("-fno-math-errno", f"-I{core.include_dir()}")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")


def compiled(output: Path, *flags: str) -> Path:
    source = Path(__file__).with_name("headers.cpp")
    subprocess.run([str(COMPILER), *FLAGS, *SAFE, *flags, source, "-o", output], check=True)
    return output


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return ctypes.CDLL(str(compiled(tmp_path_factory.mktemp("headers") / "headers.so", "-shared", "-fPIC")))


def called(function: Callable[..., object], *inputs: object, shape: tuple[int, ...]) -> Array:
    """Call a function that writes its result to the last pointer."""
    out = np.empty(shape)
    arrays = [one if isinstance(one, float) else np.ascontiguousarray(one, dtype=np.float64) for one in (*inputs, out)]
    function(*(ctypes.c_double(one) if isinstance(one, float) else ctypes.c_void_p(one.ctypes.data) for one in arrays))
    return arrays[-1] if isinstance(arrays[-1], np.ndarray) else out


class TestReferences:
    def test_turns(self, library: ctypes.CDLL) -> None:
        rng = np.random.default_rng(0)
        vectors, turns = rng.standard_normal((40, 4, 3)), random_attitudes(40, rng)
        turns[0] = quaternion.IDENTITY
        vectors[0, 1] = -3.0 * vectors[0, 0]  # half a turn
        for q, (one, one_there, two, two_there) in zip(turns, vectors, strict=True):
            axis = one / np.linalg.norm(one)
            onto = quaternion.turned_onto(q[None], one[None], one_there[None])
            about = readable.turned_about(onto, axis[None], two[None], two_there[None])[0]
            first = called(library.turn_onto, q, one, one_there, shape=(4,))
            second = called(library.turn_about, first, axis, two, two_there, shape=(4,))
            np.testing.assert_allclose(first, onto[0], rtol=0, atol=1e-12)
            assert min(np.abs(second - about).max(), np.abs(second + about).max()) < 1e-12

    def test_no_turn_about_a_direction_along_the_axis(self, library: ctypes.CDLL) -> None:
        z = np.array([0.0, 0.0, 1.0])
        found = called(library.turn_about, quaternion.IDENTITY, z, z, z, shape=(4,))
        np.testing.assert_array_equal(found, quaternion.IDENTITY)

    def test_error_jacobian(self, library: ctypes.CDLL) -> None:
        rng = np.random.default_rng(25)
        body = dynamics.RigidBody(np.array([[0.519, 0.002, 0.005], [0.002, 0.579, 0.009], [0.005, 0.009, 0.71]]))
        for q in random_attitudes(20, rng):
            w, momentum = 0.02 * rng.standard_normal((2, 3))
            dipole, b = rng.standard_normal(3), 3e-5 * rng.standard_normal(3)
            expected = dynamics.error_jacobian(body, q, w, momentum, 1.2e-6, b, dipole)
            known = body.inertia_kgm2, body.inverse, dipole, q, w, momentum, 1.2e-6, b
            found = called(library.jacobian, *known, shape=(6, 6))
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-16)

    def test_closed_loop_jacobian(self, library: ctypes.CDLL) -> None:
        rng = np.random.default_rng(26)
        body = dynamics.RigidBody(np.array([[0.519, 0.002, 0.005], [0.002, 0.579, 0.009], [0.005, 0.009, 0.71]]))
        control = dynamics.wheel_control(body)
        for q in random_attitudes(20, rng):
            w = 0.02 * rng.standard_normal(3)
            known = body.inertia_kgm2, body.inverse, control.attitude_gain_Nm, control.rate_gain_Nms, q, w, 1.2e-6
            found = called(library.closed_loop_jacobian, *known, shape=(6, 6))
            expected = readable.closed_loop_error_jacobian(body, control, q, w, 1.2e-6)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)

    def test_the_gate_has_the_same_numbers(self) -> None:
        header = (core.include_dir() / "adcs/gate.hpp").read_text(encoding="utf-8")
        rules = re.search(r"struct ContestRules \{(.*?)\};", header, re.DOTALL)
        assert rules is not None
        found = {name.upper(): float(value) for name, value in re.findall(r"(\w+) = (-?[\d.]+)", rules[1])}
        assert found == {name: getattr(readable, name) for name in found}
        assert len(found) == 8


def test_a_microcontroller_needs_no_library(tmp_path: Path) -> None:
    """Without a C library the code needs nothing but what copies and clears memory."""
    if (nm := shutil.which("nm")) is None:
        pytest.skip("no nm")
    built = compiled(tmp_path / "headers.o", "-c", "-ffreestanding", "-fno-threadsafe-statics")
    listed = subprocess.run([nm, "-u", built], check=True, capture_output=True, text=True).stdout
    assert set(re.findall(r"U _?(\w+)", listed)) <= {"memcpy", "memset", "memmove", "GLOBAL_OFFSET_TABLE_"}
