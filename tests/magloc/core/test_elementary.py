"""Tests of the core's elementary functions: NumPy's, to a few units in the last place."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

from magloc import core

COMPILER = next(filter(shutil.which, ("c++", "g++", "clang++")), None)
SOURCE = """
#include <magloc/elementary.hpp>
extern "C" double logarithm(double x) { return magloc::logarithm(x); }
extern "C" double arctangent(double y, double x) { return magloc::arctangent(y, x); }
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
    for name, count in (("logarithm", 1), ("arctangent", 2)):
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
