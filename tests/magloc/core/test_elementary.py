"""Tests of the core's elementary functions: NumPy's, to a few units in the last place."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from scipy.special import erfc

from magloc import core

COMPILER = next(filter(shutil.which, ("c++", "g++", "clang++")), None)
SOURCE = """
#include <magloc/elementary.hpp>
extern "C" double logarithm(double x) { return magloc::logarithm(x); }
extern "C" double arctangent(double y, double x) { return magloc::arctangent(y, x); }
extern "C" double exponential(double x) { return magloc::exponential(x); }
extern "C" double complementary_error(double x) { return magloc::complementary_error(x); }
extern "C" double sine(double x) { double s, c; magloc::fill_sine_and_cosine(x, s, c); return s; }
extern "C" double cosine(double x) { double s, c; magloc::fill_sine_and_cosine(x, s, c); return c; }
"""
EPS = float(np.finfo(np.float64).eps)


@pytest.fixture(scope="module")
def functions(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """Compile the functions alone."""
    if COMPILER is None:
        pytest.skip("needs a C++ compiler")
    folder = tmp_path_factory.mktemp("elementary")
    (folder / "functions.cpp").write_text(SOURCE, encoding="utf-8")
    command = [COMPILER, "-std=c++17", "-O2", "-shared", "-fPIC", f"-I{core.include_dir()}", "functions.cpp"]
    subprocess.run([*command, "-o", "functions.so"], cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "functions.so"))
    for name in ("logarithm", "arctangent", "exponential", "complementary_error", "sine", "cosine"):
        count = 2 if name == "arctangent" else 1
        function = getattr(library, name)
        function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double] * count
    return library


class TestElementary:
    def test_logarithm(self, functions: ctypes.CDLL) -> None:
        rng = np.random.default_rng(0)
        x = np.concatenate([2.0 ** rng.uniform(-1022, 1023, 2000), 1.0 + rng.uniform(-0.5, 1.0, 2000)])
        found = np.array([functions.logarithm(value) for value in [*x, 1.0, np.sqrt(2.0), 1e-36]])
        expected = np.log([*x, 1.0, np.sqrt(2.0), 1e-36])
        assert (np.abs(found - expected) <= 3.0 * EPS * np.abs(expected)).all()
        assert all(np.isnan(functions.logarithm(value)) for value in (-1.0, 0.0, np.nan, np.inf))

    def test_arctangent(self, functions: ctypes.CDLL) -> None:
        rng = np.random.default_rng(1)
        pairs = rng.standard_normal((4000, 2)) * 10.0 ** rng.uniform(-12, 12, (4000, 2))
        axes = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0), (0.0, -1.0), (1.0, -1.0), (-1.0, -1.0)]
        y, x = np.concatenate([pairs, axes]).T
        found = np.array([functions.arctangent(*pair) for pair in zip(y, x, strict=True)])
        expected = np.arctan2(y, x)
        assert (np.abs(found - expected) <= 4.0 * EPS * np.abs(expected)).all()
        assert np.isnan(functions.arctangent(np.nan, 1.0))

    def test_exponential(self, functions: ctypes.CDLL) -> None:
        x = np.concatenate([np.random.default_rng(2).uniform(-700, 700, 4000), np.linspace(-2.0, 2.0, 401)])
        found, expected = np.array([functions.exponential(value) for value in x]), np.exp(x)
        assert (np.abs(found - expected) <= 4.0 * EPS * expected).all()
        assert functions.exponential(-1e4) == 0.0

    def test_complementary_error(self, functions: ctypes.CDLL) -> None:
        x = np.linspace(0.0, 25.0, 5001)
        found, expected = np.array([functions.complementary_error(value) for value in x]), erfc(x)
        assert (np.abs(found - expected) <= 1e-12 * expected).all()

    def test_sine_and_cosine(self, functions: ctypes.CDLL) -> None:
        x = np.concatenate([np.linspace(-0.5 * np.pi, 0.5 * np.pi, 4001), [1e-5, -1e-9]])
        sine, cosine = (np.array([getattr(functions, name)(value) for value in x]) for name in ("sine", "cosine"))
        assert (np.abs(sine - np.sin(x)) <= 4.0 * EPS * np.abs(np.sin(x))).all()
        assert (np.abs(cosine - np.cos(x)) <= 4.0 * EPS).all()
