"""Tests of the core's elementary functions: NumPy's, to a few units in the last place."""

import ctypes
import shutil
import subprocess
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erfc

from magloc import core

Array = NDArray[np.float64]
COMPILER = next(filter(shutil.which, ("c++", "g++", "clang++")), None)
SOURCE = """
#include <magloc/elementary.hpp>
using namespace magloc;

template <class Function> void map(const double *x, double *y, int n, Function f) {
  for (int i = 0; i < n; i += n_lanes<Lanes>) {
    Lanes lanes{};
    for (int lane = 0; lane < n_lanes<Lanes>; ++lane) set_lane(lanes, lane, x[i + lane < n ? i + lane : n - 1]);
    lanes = f(lanes);
    for (int lane = 0; lane < n_lanes<Lanes> && i + lane < n; ++lane) y[i + lane] = get_lane(lanes, lane);
  }
}
extern "C" {
void arc_tangents(const double *x, double *y, int n) {
  map(x, y, n, [](Lanes lanes) { return arc_tangent(lanes); });
}
void hyperbolic_tangents(const double *x, double *y, int n) {
  map(x, y, n, [](Lanes lanes) { return hyperbolic_tangent(lanes); });
}
void logarithms(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) y[i] = logarithm(x[i]);
}
void angles(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) y[i] = arc_tangent(x[2 * i], x[2 * i + 1]);
}
void exponentials(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) y[i] = exponential(x[i]);
}
void complementary_errors(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) y[i] = complementary_error(x[i]);
}
void sines_and_cosines(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) fill_sine_and_cosine(x[i], y[2 * i], y[2 * i + 1]);
}
}
"""
SIZES = np.concatenate([[0.0], np.geomspace(1e-300, 1e-3, 1001), np.geomspace(1e-3, 1e3, 10_001)])
EPS = float(np.finfo(np.float64).eps)


@pytest.fixture(scope="module", params=[1, 4], ids=["double", "four lanes"])
def functions(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """Compile the functions alone."""
    if COMPILER is None:
        pytest.skip("needs a C++ compiler")
    folder = tmp_path_factory.mktemp("elementary")
    (folder / "functions.cpp").write_text(SOURCE, encoding="utf-8")
    flags = ["-std=c++17", "-O2", "-Wno-psabi", "-fno-math-errno", f"-DMAGLOC_LANES={request.param}"]
    command = [COMPILER, *flags, "-shared", "-fPIC", f"-I{core.include_dir()}", "functions.cpp"]
    subprocess.run([*command, "-o", "functions.so"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "functions.so"))


def mapped(function: Callable[..., object], x: Array) -> Array:
    """Return the function of each row of x."""
    y = np.empty(len(x))
    function(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(y.ctypes.data), len(x))
    return y


class TestElementary:
    def test_arc_tangent(self, functions: ctypes.CDLL) -> None:
        x = np.concatenate([-SIZES[::-1], SIZES, [1e300, np.inf, -np.inf, np.nan]])
        np.testing.assert_allclose(mapped(functions.arc_tangents, x), np.arctan(x), rtol=1e-15, atol=0)

    def test_angle_of_a_vector(self, functions: ctypes.CDLL) -> None:
        rng = np.random.default_rng(1)
        pairs = rng.standard_normal((4000, 2)) * 10.0 ** rng.uniform(-12, 12, (4000, 2))
        axes = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (-1.0, 1.0), (-1.0, -1.0)]
        yx = np.concatenate([pairs, axes])
        expected = np.arctan2(*yx.T)
        assert (np.abs(mapped(functions.angles, yx) - expected) <= 4.0 * EPS * np.abs(expected)).all()
        assert np.isnan(mapped(functions.angles, np.array([[np.nan, 1.0], [0.0, np.nan]]))).all()

    def test_hyperbolic_tangent(self, functions: ctypes.CDLL) -> None:
        x = np.concatenate([SIZES, [1e300, np.inf, np.nan]])
        np.testing.assert_allclose(mapped(functions.hyperbolic_tangents, x), np.tanh(x), rtol=2e-15, atol=0)

    def test_logarithm(self, functions: ctypes.CDLL) -> None:
        rng = np.random.default_rng(0)
        near_one = 1.0 + np.concatenate([np.geomspace(1e-16, 1.0, 1001), rng.uniform(-0.5, 1.0, 2000)])
        ends = [np.sqrt(2.0), 1e-36, 5e-324, 1e-310, 1e300, np.inf, np.nan]
        x = np.concatenate([SIZES, 2.0 ** rng.uniform(-1022, 1023, 2000), near_one, 1.0 / near_one, ends])
        with np.errstate(divide="ignore"):
            expected = np.log(x)
        np.testing.assert_allclose(mapped(functions.logarithms, x), expected, rtol=3.0 * EPS, atol=0)
        assert np.isnan(mapped(functions.logarithms, np.array([-1.0, -np.inf]))).all()

    def test_exponential(self, functions: ctypes.CDLL) -> None:
        x = np.concatenate([np.random.default_rng(2).uniform(-700, 700, 4000), np.linspace(-2.0, 2.0, 401)])
        np.testing.assert_allclose(mapped(functions.exponentials, x), np.exp(x), rtol=4.0 * EPS, atol=0)
        ends = np.array([709.0, 710.0, 1e300, np.inf, -1e300, -np.inf, np.nan])
        with np.errstate(over="ignore"):
            np.testing.assert_allclose(mapped(functions.exponentials, ends), np.exp(ends), rtol=4.0 * EPS, atol=0)
        assert mapped(functions.exponentials, np.array([-1e4])) == 0.0

    def test_complementary_error(self, functions: ctypes.CDLL) -> None:
        x = np.linspace(0.0, 25.0, 5001)
        np.testing.assert_allclose(mapped(functions.complementary_errors, x), erfc(x), rtol=1e-12, atol=0)

    def test_sine_and_cosine(self, functions: ctypes.CDLL) -> None:
        x = np.concatenate([np.linspace(-0.5 * np.pi, 0.5 * np.pi, 4001), [1e-5, -1e-9]])
        found = np.empty((len(x), 2))
        functions.sines_and_cosines(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(found.ctypes.data), len(x))
        assert (np.abs(found[:, 0] - np.sin(x)) <= 4.0 * EPS * np.abs(np.sin(x))).all()
        assert (np.abs(found[:, 1] - np.cos(x)) <= 4.0 * EPS).all()
